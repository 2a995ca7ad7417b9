"""Our nodes as FMUs: simulated by FMPy they give the numbers of the rig, bit for bit."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from softrig_bringup.cli import main
from softrig_core import ByHand, RunError, ScenarioError, load_scenario, rig_of, simulate
from softrig_drives.dc_motor.plant import DcMotorPlant

fmpy = pytest.importorskip("fmpy")
pytest.importorskip("pythonfmu")
# ruff: noqa: E402
from fmpy.validation import validate_fmu
from softrig_control.fmu.export import export
from softrig_control.fmu.nodes import FmuLaw, FmuPlant
from softrig_control.fmu.slave import variable

PAGE = Path(__file__).parents[2] / "ros_pkgs" / "softrig_control" / "doc" / "fmu.md"
SHAFT = "motor.state.shaft.velocity"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    assert main(["export", "fmu", "dc_motor_smc", "dc_motor_plant", "dc_motor_smc", "--out", str(folder)]) == 0
    return folder


def test_fmpy_simulates_the_numbers_of_the_plant_as_the_page_shows(exported, tmp_path):
    """In a separate process: PythonFMU's library can be loaded only once into a Python process."""
    text = PAGE.read_text()
    command = "export fmu dc_motor_smc dc_motor_plant dc_motor_smc --out fmus"
    assert f"scripts/softrig {command}" in text  # the fixture `exported` has run this command
    (tmp_path / "fmus").symlink_to(exported)
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0] + f"print(*found[{SHAFT!r}].tolist())\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    last, every = done.stdout.strip().splitlines()
    plant = ByHand(DcMotorPlant(period=0.0001, R=0.5))
    expected = []
    for k in range(201):
        expected.append(plant.outputs(0)["state"][1])
        plant.advance(k * 100_000, command=(3.0,))
    assert [float(x) for x in every.split()] == expected
    assert float(last) == expected[-1] > 0.005


def test_the_description_has_names_units_bounds_and_texts(exported):
    for name in ("dc_motor_plant", "dc_motor_smc"):
        assert validate_fmu(str(exported / f"{name}.fmu")) == []
    model = fmpy.read_model_description(str(exported / "dc_motor_plant.fmu"))
    results = {v.name: v for v in model.modelVariables}
    command, speed, R = results["motor.command.armature.effort"], results[SHAFT], results["R"]
    assert (command.causality, command.unit, float(command.max)) == ("input", "V", 1e7)
    assert (speed.causality, speed.unit, speed.description) == ("output", "rad/s", "motor/state/shaft/velocity")
    assert (R.causality, R.unit, float(R.start), float(R.min)) == ("parameter", "ohm", 0.4, 0.0)
    assert R.description == "armature resistance R"
    assert results["rig"].type == "Boolean"
    assert "period" not in results
    assert float(model.defaultExperiment.stepSize) == 1e-4
    speed_unit = next(u for u in model.unitDefinitions if u.name == "rad/s").baseUnit
    assert (speed_unit.rad, speed_unit.s, float(speed_unit.factor)) == (1, -1, 1.0)


SOURCE = """
title: a source
system: linear
source: own example
duration: 1.0
nodes:
  source:
    package: softrig_control
    executable: command_source
    parameters: {period: 0.01, channels: [u], units: [V], times: [0.0, 0.5], values: [0.0, 100.0]}
    remap: {command: command}
  plant:
    package: softrig_control
    executable: linear_plant
    parameters: {period: 0.01, num: [1.0], den: [1.0, 1.0]}
"""
SEVERAL = """
import fmpy
from fmpy import simulate_fmu
for _ in range(2):
    found = simulate_fmu("source.fmu", start_time=0.48, stop_time=0.54, output_interval=0.01)
    print(*found["command.u.effort"].tolist())
print(*simulate_fmu("source.fmu", start_time=0.6, stop_time=0.62, output_interval=0.01)["command.u.effort"].tolist())
print(*simulate_fmu("plant.fmu", start_time=0.0, stop_time=0.01, output_interval=0.01)["output.v_dc.position"].tolist())
for step in (0.005, 0.01):
    try:
        simulate_fmu("source.fmu", start_time=0.0 if step < 0.01 else 0.003, stop_time=0.02, output_interval=step)
    except fmpy.fmi1.FMICallException as error:
        print(error)
"""


@pytest.mark.long
def test_a_source_follows_the_clock_of_the_tool_in_several_instances_and_refuses_with_an_error(tmp_path):
    """FMPy runs in a separate process, which must end normally: PythonFMU 0.7 aborted it, did not find a class a second
    time, and continued after a refused step with zeros.
    """
    (tmp_path / "source.yaml").write_text(SOURCE)
    for node in ("source", "plant"):
        export(rig_of(str(tmp_path / "source.yaml")), node, tmp_path)
    done = subprocess.run([sys.executable, "-c", SEVERAL], cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = [line for line in done.stdout.splitlines() if line[:1].isdigit() or line.startswith("fmi2")]
    assert lines == [
        "0.0 0.0 0.0 100.0 100.0 100.0 100.0",  # outputs change at the end of the step of their tick
        "0.0 0.0 0.0 100.0 100.0 100.0 100.0",
        "100.0 100.0 100.0",
        "0.0 0.0",  # another FMU in the same process
        "fmi2DoStep failed with status 4 (fatal).",
        "fmi2ExitInitializationMode failed with status 4 (fatal).",
    ]


def through_fmus(scenario, nodes, folder):
    """A scenario file in which some nodes are replaced by their exports."""
    rig = rig_of(scenario)
    entries = {}
    for member in (m for m in rig.members if m.name in nodes):
        parameters = {
            "period": member.params.period,
            "fmu": str(export(rig, member.name, folder)),
            "vectors": [],
            "trajectories": [],
        }
        for side, ports in (("inputs", member.inputs), ("outputs", member.outputs)):
            parameters[side] = []
            for port in ports:
                vector = port.msgtype.endswith("Vector3Stamped")
                parameters["vectors"] += [f"{port.topic} = {port.frame_id}"] if vector else []
                parameters["trajectories"] += [port.topic] if port.msgtype.endswith("JointTrajectory") else []
                parameters[side] += [
                    f"{port.topic}/{label}{'/vector' * vector} = {variable(port.topic, label)}" for label in port.labels
                ]
        executable = "fmu_plant" if member.is_plant else "fmu_law"
        entries[member.name] = {"package": "softrig_control", "executable": executable, "parameters": parameters}
    raw = scenario.model_dump(mode="json", exclude_unset=True)
    for name, entry in entries.items():
        raw["nodes"][name] = {k: v for k, v in raw["nodes"][name].items() if k not in ("parameters", "remap")} | entry
    raw = {k: raw[k] for k in ("title", "system", "source", "duration", "nodes", "seed") if k in raw}
    path = folder / "through.yaml"
    with path.open("w") as file:
        YAML().dump(raw, file)
    return load_scenario(str(path))


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "nodes", "overrides"),
    [
        ("dc_motor_smc_b2", ["dc_motor_plant", "dc_motor_smc"], {"dc_motor_plant.current_noise": 0.01}),
        pytest.param("induction_dtc", ["im_plant"], {}, marks=pytest.mark.long),
    ],
)
def test_a_rig_with_exports_in_it_has_the_same_numbers(name, nodes, overrides, tmp_path):
    scenario = load_scenario(name, overrides)
    expected = simulate(scenario, duration=0.05)
    result = simulate(through_fmus(scenario, nodes, tmp_path), duration=0.05)
    assert set(expected.signals) <= set(result.signals)
    moved = 0
    for signal in expected.signals:
        assert result.signals[signal].x.tolist() == expected.signals[signal].x.tolist(), signal
        moved += len(set(expected.signals[signal].x.tolist())) > 1
    assert moved > 2


def motor(exported, **keywords):
    inputs, outputs = ("u/a/effort = motor.command.armature.effort",), (f"y/shaft/velocity = {SHAFT}",)
    keywords = {
        "fmu": str(exported / "dc_motor_plant.fmu"),
        "period": 1e-4,
        "inputs": inputs,
        "outputs": outputs,
    } | keywords
    return ByHand(FmuPlant(name="motor", log=True, **keywords))


@pytest.mark.long
def test_unconnected_inputs_begin_as_in_the_scenario(tmp_path):
    rig = rig_of("rectifier_mpc", duration=0.01)
    run = simulate(rig)
    commands = run.signals["v_drop/command/v_drop/effort"].x.tolist()
    names = ["dc_link/voltage/position", "dc_link/current/position"]
    measured = list(zip(*(run.signals[n].x.tolist() for n in names), strict=True))
    export(rig, "gpc_controller", tmp_path)
    parameters = {
        "fmu": str(tmp_path / "gpc_controller.fmu"),
        "period": rig.clock.params.period,
        "outputs": ("u/v/effort = v_drop.command.v_drop.effort",),
    }
    inputs = tuple(f"y/{name.split('/')[1]}/position = {name.replace('/', '.')}" for name in names)
    law = ByHand(FmuLaw(name="law", inputs=inputs, **parameters))
    results = [law.update(0, y=row)["to_u"][0] for row in measured[: len(commands)]]
    assert results == commands  # no node publishes the reference, so the controller uses its own set point
    assert ByHand(FmuLaw(name="law", **parameters)).update(0)["to_u"] == (commands[0],)
    start = {v.name: v.start for v in fmpy.read_model_description(parameters["fmu"]).modelVariables}
    assert float(start["reference.v_dc.position"]) == float(start["dc_link.voltage.position"]) == 400.0
    values = ("reference.v_dc.position = 300",)
    set_to = ByHand(FmuLaw(name="law", values=values, inputs=inputs, **parameters))
    assert set_to.update(0, y=measured[0])["to_u"] != (commands[0],)


@pytest.mark.long
def test_a_longer_step_is_several_periods(exported):
    long, short = motor(exported, period=5e-4), motor(exported)
    long.advance(0, u=(5.0,))
    for _ in range(5):
        short.advance(0, u=(5.0,))
    assert long.outputs(0) == short.outputs(0)


@pytest.mark.long
def test_unsupported_operations_are_reported_by_name(exported, tmp_path):
    with pytest.raises(RunError, match=r"expected a whole number of periods of 0\.0001 s"):
        motor(exported, period=1.5e-4).advance(0, u=(5.0,))
    with pytest.raises(RunError, match=r"motor/command: .*2e\+07"):
        motor(exported).advance(0, u=(2e7,))
    with pytest.raises(RunError, match="parameter L = 0"):
        motor(exported, values=("L = 0",)).advance(0, u=(5.0,))
    rig = rig_of("dc_motor_smc")
    with pytest.raises(ScenarioError, match=r"has no node 'dc_motor_plan' \(did you mean 'dc_motor_plant'\?\)"):
        export(rig, "dc_motor_plan", tmp_path)


@pytest.mark.long
def test_an_export_is_rewound_with_its_state(exported):
    plant = motor(exported)
    assert plant.block.p.unit.serialises

    def go(n):
        result = []
        for k in range(n):
            plant.advance(0, u=(5.0 + k,))
            result.append(plant.outputs(0))
        return result

    go(20)
    saved = plant.save()
    remaining = go(20)
    plant.load(saved)
    assert go(20) == remaining
    other = ByHand(FmuPlant(plant.block.p, "other"))  # another process loads its state
    other.load(saved)
    other.advance(0, u=(5.0,))
    assert other.outputs(0) == remaining[0]
