"""A user's controller for each system: its package is written with the ports of the controller that it replaces."""

import subprocess

import pytest
import yaml
from conftest import few
from docs.outline import GALLERY, ROOT
from softrig_bringup.cli import main
from softrig_bringup.new.controller import replaced
from softrig_core import ScenarioError, list_scenarios, load_scenario, rig_of

# Systems whose main scenario has another name.
NAMED = {
    "tcp_aqm": "tcp_aqm_smc",
    "fault_location": "fault_location_500kv",
    "economic_dispatch": "economic_dispatch_wood",
    "optimal_control_mvim": "optimal_control_mvim_wie",
    "pwa_delay": "pwa_delay_p3",
}


@pytest.mark.parametrize("system", few(GALLERY, 7))
def test_each_system_has_a_controller_that_can_be_replaced_by_one_with_its_ports(system, tmp_path, capsys):
    scenario = NAMED.get(system, system)
    assert main(["new", "my_law", "--only", "law", "--for", scenario, "--into", str(tmp_path)]) == 0
    folder = tmp_path / "my_law"
    written = yaml.safe_load((folder / "scenarios" / "my_law.yaml").read_text())
    rig = rig_of(load_scenario(scenario))
    ((node, entry),) = written["nodes"].items()
    member = next(m for m in rig.members if m.name == node)
    space = {"__name__": "my_law.controller"}
    text = (folder / "my_law" / "controller.py").read_text()
    exec(compile(text, "controller.py", "exec"), space)
    assert issubclass(space["Controller"], member.block_class)
    assert entry.get("parameters", {}) == rig.scenario.model_dump(mode="json")["nodes"][node]["parameters"]
    for port in (*member.inputs, *member.outputs):
        assert f"- {port.name}, " in text
    again = load_scenario(str(folder / "scenarios" / "my_law.yaml"))
    assert (again.expect.keys(), again.figures.keys()) == (rig.scenario.expect.keys(), rig.scenario.figures.keys())
    compile((folder / "test" / "test_my_law.py").read_text(), "test_my_law.py", "exec")
    example = example_of(text)
    assert example.ports(member.params) == member.block_class.ports(member.params)
    block = example.seeded(member.params, node, 0)
    x, outputs = block.update(block.first(), 0, **{p.name: (0.0,) * len(p.labels) for p in member.inputs})
    assert block.update(x, 1, **{p.name: None for p in member.inputs})[0].ticks == 2
    assert {name: len(values) for name, values in outputs.items()} == {p.name: len(p.labels) for p in member.outputs}


def example_of(text):
    """Return the class that the comment at the end of a written controller describes."""
    written, _, comment = text.partition("# A controller of your own from nothing")
    lines = [line[2:] for line in comment.splitlines()[1:] if not line.startswith("# Import")]
    space = {"__name__": "my_law.controller"}
    imports = "from typing import NamedTuple\nfrom softrig_core import Block\n"
    exec(compile(imports + written + "\n".join(lines), "controller.py", "exec"), space)
    return space["Controller"]


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.timeout(900)
def test_each_written_controller_meets_the_expectations_of_the_one_it_replaces(tmp_path):
    for system in GALLERY:
        name = f"my_{system}"
        assert main(["new", name, "--only", "law", "--for", NAMED.get(system, system), "--into", str(tmp_path)]) == 0
    softrig = [ROOT / "scripts" / "softrig", "--workspace", tmp_path]
    for system in GALLERY:
        run = [*softrig, "run", f"my_{system}", "--mode", "inprocess", "--no-plots", "--no-record"]
        done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, (system, done.stdout, done.stderr)
    tests = [*softrig, "python", "-m", "pytest", "-q", tmp_path / "my_dc_motor_smc"]
    assert subprocess.run(tests, cwd=tmp_path, timeout=300).returncode == 0


@pytest.mark.parametrize(
    ("wanted", "text"),
    [
        ("pwa_delay_hayes", "it has no controller to replace"),
        (
            "dc_motor_fsfb/fsfb",
            "no controller of it (did you mean 'fsfb_controller'?); it has fsfb_controller, fieldbus_delay",
        ),
        (
            "dc_motor_fsfb/dc_axis_plant",
            "no controller of it; it has fsfb_controller, fieldbus_delay",
        ),
        ("dc_motor_sms", "scenario 'dc_motor_sms' is unknown"),
    ],
)
def test_a_node_that_cannot_be_replaced_is_refused(wanted, text):
    with pytest.raises(ScenarioError) as error:
        replaced(wanted, "my_law")
    assert text in str(error.value)


def test_the_named_node_is_the_one_that_is_replaced():
    assert replaced("lsrm_fuzzy/speed_controller", "my_law").values["class"] == "LsrmFuzzy"
    assert replaced("lsrm_fuzzy", "my_law").others == ("speed_controller",)
    assert {*NAMED.values()} <= {*list_scenarios()}
