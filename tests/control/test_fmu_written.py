"""What an exported FMU contains, and why an export is refused: with a stand-in for the packing tool."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from softrig_control.fmu import export as exports
from softrig_control.fmu.export import _can, _check, export, main
from softrig_control.nodes.policy import Policy
from softrig_core import BlockParams, ScenarioError, joint_state, load_scenario, rig_of
from softrig_drives.dc_motor.plant import DcMotorPlant

pytest.importorskip("pythonfmu")


@pytest.fixture
def asked(monkeypatch):
    """The calls of the tool; its answer can be changed."""
    result = SimpleNamespace(calls=[], answer=SimpleNamespace(returncode=0, stderr=""))

    def run(command, **about):
        assert about == {
            "stdin": exports.subprocess.DEVNULL,
            "capture_output": True,
            "text": True,
            "check": False,
        }
        script, path, what, *can = command[4:]
        result.calls.append((command[:4], Path(script).name, Path(script).read_text(), path, Path(what), can))
        result.node = json.loads(Path(what).read_text())
        Path(path).write_bytes(b"an FMU")
        return result.answer

    monkeypatch.setattr(exports.subprocess, "run", run)
    return result


@pytest.fixture(scope="module")
def motor():
    return rig_of("dc_motor_smc")


def test_a_node_is_written_with_its_script_and_its_description(asked, motor, tmp_path):
    path = export(motor, "dc_motor_plant", tmp_path / "not" / "there")
    assert path == tmp_path / "not" / "there" / "dc_motor_plant.fmu"
    assert path.parent.is_dir()
    assert export(motor, "dc_motor_smc", path.parent).name == "dc_motor_smc.fmu"
    (command, name, text, file, what, can), (_, other, _, _, _, _) = asked.calls
    assert (command[0], command[1], command[2]) == (sys.executable, "-P", "-c")
    assert "FmuBuilder.build_FMU(*sys.argv[1:3], [sys.argv[3]], **dict.fromkeys(sys.argv[4:], True))" in command[3]
    assert (name, other, Path(file).name, what.name) == (
        "softrig_dc_motor_plant.py",
        "softrig_dc_motor_smc.py",
        path.name,
        "node.json",
    )
    assert "class dc_motor_plant(Node, Fmi2Slave):" in text
    assert '"""What runs in this FMU is dc_motor_plant, softrig_drives/dc_motor_plant of softrig."""' in text
    assert can == ["canGetAndSetFMUstate", "canSerializeFMUstate"]
    assert not what.exists()
    law = asked.node
    assert (law["node"], law["package"], law["executable"], law["seed"]) == (
        "dc_motor_smc",
        "softrig_drives",
        "dc_motor_smc",
        0,
    )
    # The initial values of the scenario.
    assert law["start"] == {"state": [0.0], "sensors": [0.0, 0.0], "reference": [1.0]}
    assert law["parameters"]["period"] == motor.clock.params.period


def test_the_seed_and_the_first_values_are_those_of_the_scenario(asked, tmp_path):
    export(rig_of(load_scenario("dc_motor_smc_b2").model_copy(update={"seed": 11})), "dc_motor_plant", tmp_path)
    assert asked.node["seed"] == 11
    assert asked.node["start"].keys() == {"command"}


@pytest.mark.parametrize(
    ("stderr", "text"), [("", "no reason given"), ("first\nlast one\n", "last one"), ("  \n", "no reason given")]
)
def test_the_reason_of_a_failed_export_is_the_last_line_of_the_tool(asked, motor, tmp_path, stderr, text):
    asked.answer = SimpleNamespace(returncode=1, stderr=stderr)
    with pytest.raises(ScenarioError, match=f"^node dc_motor_plant: no FMU: {text}$"):
        export(motor, "dc_motor_plant", tmp_path)


def test_nodes_that_cannot_be_exported_are_reported(motor, tmp_path):
    with pytest.raises(
        ScenarioError,
        match=r"^dc_motor_smc has no node 'plant' \(did you mean 'dc_motor_plant'\?\); it has dc_motor_plant, ",
    ):
        export(motor, "plant", tmp_path)
    plain, late = (
        joint_state("a", "t/a", ["x"], position="m"),
        joint_state("b", "t/b", ["x"], position="m", delayed=True),
    )
    for inputs, outputs in (((late,), ()), ((plain,), (plain, late))):
        with pytest.raises(
            ScenarioError, match=r"^node n: t/b carries acquisition times of its own, which an FMU cannot$"
        ):
            _check(SimpleNamespace(name="n", inputs=inputs, outputs=outputs, external=False))
    with pytest.raises(ScenarioError, match=r"^node n is external: its code is not here$"):
        _check(SimpleNamespace(name="n", inputs=(plain,), outputs=(plain,), params=BlockParams(), external=True))
    _check(SimpleNamespace(name="n", inputs=(plain,), outputs=(plain,), params=BlockParams(), external=False))
    assert _can(SimpleNamespace(block_class=Policy)) == ()  # the state of a policy is opaque, so it is not exported
    assert _can(SimpleNamespace(block_class=DcMotorPlant)) == ("canGetAndSetFMUstate", "canSerializeFMUstate")


def test_the_verb_writes_each_fmu_and_prints_where(asked, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["fmu", "dc_motor_smc", "dc_motor_plant", "dc_motor_smc"]) == 0
    assert capsys.readouterr().out == "dc_motor_plant.fmu\ndc_motor_smc.fmu\n"
    assert main(["fmu", "dc_motor_smc", "dc_motor_plant", "--out", "there"]) == 0
    assert capsys.readouterr().out == "there/dc_motor_plant.fmu\n"
    for words in (["dll", "dc_motor_smc", "dc_motor_plant"], ["fmu", "dc_motor_smc"], ["fmu"]):
        with pytest.raises(ScenarioError):
            main(words)
    assert len(asked.calls) == 3
