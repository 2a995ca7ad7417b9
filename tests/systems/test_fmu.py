"""FMUs as plants and controllers: built here from C, run through every interface, and with every kind of error."""

import dataclasses
import hashlib
import json
import math
import multiprocessing
import random
import re
import signal
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import PATIENCE, command_lines, differences, few, in_process, make_scenario, no_process_left, until
from simulated import SimulatedRig, World
from softrig_bringup.cli import main
from softrig_core import ByHand, ParameterError, RunError, ScenarioError, Signals, load_scenario, rig_of, simulate
from softrig_core.block.change import permit
from softrig_drives.dc_motor.plant import DcMotorPlant
from softrig_nodes import run_processes
from softrig_nodes.processes.placement import Placement

pytest.importorskip("fmpy")
from fmu_build import build_fmu
from softrig_control.fmu import nodes
from softrig_control.fmu.description import Unit, Variable, _unit, conversion, describe
from softrig_control.fmu.instance import Instance
from softrig_control.fmu.mapping import Place
from softrig_control.fmu.nodes import FmuLaw, FmuPlant

PAGE = Path(__file__).parents[2] / "ros_pkgs" / "softrig_control" / "doc" / "fmu.md"
PORTS = {
    "inputs": ("motor/command/armature/effort = voltage",),
    "outputs": (
        "motor/state/shaft/position = theta",
        "motor/state/shaft/velocity = w",
        "motor/state/shaft/effort = torque",
    ),
}
BALL = ("ball/state/ball/position = height", "ball/state/ball/velocity = v", "ball/bounces/count/position = bounces")


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmus")
    for model in ("motor", "ball", "law", "strict"):
        for version in (2, 3):
            build_fmu(folder, model, version)
    build_fmu(folder, "mix", 3)
    return folder


@pytest.fixture
def page(fmus, tmp_path, monkeypatch):
    """The scenarios of the page, in a folder with their FMUs."""
    for path in fmus.glob("*.fmu"):
        (tmp_path / path.name).symlink_to(path)
    for name, text in zip(("plant", "law"), re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL), strict=True):
        (tmp_path / f"{name}.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def motor(fmus, version=2, **keywords):
    return ByHand(
        FmuPlant(name="motor", **{"fmu": str(fmus / f"motor{version}.fmu"), "period": 0.001, **PORTS} | keywords)
    )


def voltage(k):
    return (12.0 * math.sin(0.01 * k),)


def trace(plant, ticks=300):
    result = []
    for k in range(ticks):
        result.append(plant.outputs(0)["to_motor_state"])
        plant.advance(0, motor_command=voltage(k))
    return result


def block_run(ticks=300, **constants):
    plant = ByHand(DcMotorPlant(period=0.001, **constants))
    result = []
    for k in range(ticks):
        result.append(plant.outputs(k)["state"])
        plant.advance(k * 1_000_000, command=voltage(k))
    return result


def distance(a, b):
    return max(abs(x - y) for p, q in zip(a, b, strict=True) for x, y in zip(p, q, strict=True))


@pytest.mark.parametrize("version", [2, pytest.param(3, marks=pytest.mark.long)])
def test_a_motor_in_an_fmu_equals_ours(fmus, version):
    assert describe(str(fmus / f"motor{version}.fmu")).version == f"{version}.0"
    values = ("R = 0.5", "J = 0.0005")
    expected = block_run(R=0.5, J=0.0005)
    stepped = trace(motor(fmus, version, values=values))
    assert distance(stepped, expected) < 1e-12
    assert distance(expected, block_run()) > 1e-3  # the values make a difference
    assert trace(motor(fmus, version, values=values, isolated=False)) == stepped
    # With h |A| = 0.1 h/ms, a method of fourth order has errors of 1e-11, and a 16th of that with half the step.
    coarse, fine = (
        trace(motor(fmus, version, values=values, method="model_exchange", steps=n, isolated=False)) for n in (1, 2)
    )
    assert 1e-12 < distance(coarse, expected) < 1e-9
    assert distance(fine, expected) < distance(coarse, expected) / 12.0


@pytest.mark.parametrize("version", [pytest.param(2, marks=pytest.mark.long), 3])
def test_a_ball_bounces_at_the_right_times(fmus, version):
    """A drop from 1 m takes sqrt(2/g), the flight after the k-th bounce 2 e^k sqrt(2/g)."""
    first = math.sqrt(2.0 / 9.81)
    times = [first]
    for k in range(1, 3):
        times.append(times[-1] + 2.0 * 0.7**k * first)

    def counted(**keywords):
        file = str(fmus / f"ball{version}.fmu")
        plant = ByHand(FmuPlant(fmu=file, outputs=BALL, period=0.01, isolated=False, **keywords))
        rows = []
        for _ in range(math.ceil(times[-1] / 0.01) + 1):
            rows.append((*plant.outputs(0)["to_ball_state"], *plant.outputs(0)["to_ball_bounces"]))
            plant.advance(0)
        return rows

    rows = counted()
    assert [sum(t <= 0.01 * k for t in times) for k in range(len(rows))] == [int(n) for _, _, n in rows]
    for k, (height, v, n) in enumerate(rows):
        since = 0.01 * k - times[int(n) - 1] if n else 0.01 * k
        up = 0.7**n * 9.81 * first if n else 0.0
        assert height == pytest.approx((0.0 if n else 1.0) + up * since - 9.81 / 2 * since**2, abs=1e-12)
        assert v == pytest.approx(up - 9.81 * since, abs=1e-11)
    # In model exchange, an event waits for the end of its step, here 0.1 ms.
    for (height, _, n), (exchanged, _, m) in zip(rows, counted(method="model_exchange", steps=100), strict=True):
        assert n == m
        assert exchanged == pytest.approx(height, abs=5e-3)


@pytest.mark.parametrize("version", [pytest.param(2, marks=pytest.mark.long), 3])
def test_a_state_is_saved_and_restored_and_a_reset_starts_again(fmus, version):
    plant = motor(fmus, version)
    begun = trace(plant, 20)
    kept = plant.save()
    remaining = trace(plant, 20)
    plant.load(kept)
    assert trace(plant, 20) == remaining
    other = ByHand(FmuPlant(plant.block.p, "other"))  # another process loads its state
    other.load(kept)
    assert trace(other, 20) == remaining
    plant.reset(3)
    assert trace(plant, 20) == begun
    assert begun != remaining


def test_steps_inside_a_period_and_the_time_of_the_fmu(fmus):
    """The fault begins in the step that begins at 0.5 s."""
    whole, halves = (motor(fmus, period=0.2, steps=n, values=("fault = 5",)) for n in (1, 2))
    for plant, ticks in ((whole, 3), (halves, 2)):
        for _ in range(ticks):
            plant.advance(10**18, motor_command=(1.0,))  # time is that of the wall clock
        with pytest.raises(RunError, match=rf"motor2.fmu at {0.2 * ticks:g} s of its time: fmi2DoStep: error"):
            plant.advance(10**18, motor_command=(1.0,))


def test_units_are_converted_if_both_sides_declare_them(fmus):
    outputs = ("motor/a/shaft/velocity [rpm] = w", "motor/b/shaft/effort [mN m] = torque", "motor/c/shaft/velocity = w")
    plant = motor(fmus, outputs=outputs, isolated=False)
    assert [p.units for p in FmuPlant.ports(plant.block.p)[1]] == [("rpm",), ("mN m",), ("rad/s",)]
    for k in range(50):
        plant.advance(0, motor_command=voltage(k))
    (rpm,), (mNm,), (w,) = plant.outputs(0).values()
    state = block_run(51)[-1]
    assert rpm == pytest.approx(w * 30.0 / math.pi, rel=1e-15)
    assert (mNm, w) == pytest.approx((1e3 * state[2], state[1]), rel=1e-9)
    volts = motor(fmus, inputs=("motor/command/armature/effort [mV] = voltage",))
    volts.advance(0, motor_command=(12e3,))
    plain = motor(fmus)
    plain.advance(0, motor_command=(12.0,))
    assert volts.outputs(0)["to_motor_state"] == pytest.approx(plain.outputs(0)["to_motor_state"], rel=1e-14)


def test_units_with_an_offset_and_meaningless_names_are_handled():
    from fmpy.model_description import BaseUnit, Unit as Given

    celsius = _unit(Given("degC", BaseUnit(K=1, offset=273.15)), "model.fmu")
    assert celsius == Unit("degC", 1.0, 273.15, (("K", 1),))
    place = Place(
        Variable("T", 0, "Real", "output", None, None, None, celsius),
        0,
        0,
        *conversion(Variable("T", 0, "Real", "output", None, None, None, celsius), "K"),
    )
    assert place.out(20.0) == 293.15
    assert place.into(293.15) == 20.0
    assert _unit(Given("N.m/rad2", None), "model.fmu").name == "N m/rad^2"
    assert _unit(Given("torque", BaseUnit(kg=1, m=2, s=-2)), "model.fmu").base == Unit.of("N m").base
    assert _unit(Given("torque", BaseUnit(kg=1, m=2, s=-2)), "model.fmu").name == "kg m^2/s^2"
    with pytest.raises(ValueError, match="T is in 'degC', expected 'V', which is another quantity"):
        conversion(place.variable, "V")


@pytest.mark.parametrize("version", [2, 3])
def test_a_controller_answers_the_tick_with_its_inputs(fmus, version):
    law = ByHand(
        FmuLaw(
            fmu=str(fmus / f"law{version}.fmu"),
            period=0.1,
            values=("kp = 3", "ki = 2"),
            inputs=("r/shaft/velocity [rad/s] = setpoint", "y/shaft/velocity = speed", "on/switch/position = enabled"),
            outputs=("u/motor/effort = command",),
            trajectories=("r",),
        )
    )
    assert [(p.msgtype.split("/")[-1], p.units) for p in FmuLaw.ports(law.block.p)[0]] == [
        ("JointTrajectory", ("rad/s",)),
        ("JointState", ("rpm",)),
        ("JointState", ("1",)),
    ]
    rpm = 30.0 / math.pi
    for n in range(3):  # error bound of 1 rpm
        (u,) = law.update(0, r=(2.0 / rpm,), y=(1.0,), on=(1.0,))["to_u"]
        assert u == pytest.approx(3.0 + 0.2 * n, rel=1e-14)
    assert law.update(0, r=(2.0 / rpm,), y=(1.0,), on=(0.0,))["to_u"] == (0.0,)
    assert law.update(0, r=(900.0 / rpm,), y=(1.0,), on=(1.0,))["to_u"] == (12.0,)


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"values": ("falt = 1",)}, r"motor2.fmu has no variable 'falt' \(did you mean 'fault'\?\); it has theta, w"),
        ({"values": ("R = much",)}, "R = 'much', expected a number"),
        ({"values": ("R = nan",)}, "R = 'nan', expected a number"),
        ({"values": ("R",)}, "'R': expected VARIABLE = VALUE"),
        ({"inputs": ("a/b/effort [A] = voltage",)}, "voltage is in 'V', expected 'A', which is another quantity"),
        ({"inputs": ("a/b/effort = w",)}, "w is output of motor2.fmu, expected an input; it has voltage"),
        ({"outputs": ("a/b/effort = voltage",)}, "voltage is an input of motor2.fmu; its outputs are theta"),
        ({"outputs": ("a/b = w",)}, "'a/b = w': expected TOPIC/CHANNEL/FIELD"),
        ({"outputs": ("a/b/effort = w", "a/b/effort = i")}, "this place has a variable already"),
        (
            {"outputs": ("a/b/effort = w", "a/c/velocity = i")},
            "the message carries a/c/effort, a/b/velocity as well|the message carries a/b/velocity, a/c/effort as well",
        ),
        ({"outputs": ("a/b/acceleration = w",)}, "no field acceleration in its messages"),
        ({"outputs": ("motor/command/b/effort = w",)}, "motor/command is both an input and an output"),
        ({"fmu": "nowhere.fmu"}, "no FMU 'nowhere.fmu'"),
        ({"fmu": __file__}, "cannot be read as an FMU: BadZipFile"),
        ({"fmu": ""}, "parameter fmu = '': expected the file of an FMU"),
    ],
)
def test_bad_input_is_reported_by_name(fmus, parameters, says):
    with pytest.raises(ParameterError, match=says):
        motor(fmus, **parameters)


def test_an_fmu_for_another_machine_or_without_the_interface_is_reported(tmp_path):
    build_fmu(tmp_path, "motor", platform="win64", exchange=False)
    with pytest.raises(ParameterError, match=r"motor2\.fmu has no binary for this machine, .*; it has win64"):
        motor(tmp_path)
    (tmp_path / "other").mkdir()
    build_fmu(tmp_path / "other", "motor", exchange=False)
    with pytest.raises(ParameterError, match=r"motor2\.fmu has no interface model_exchange; it has co_simulation"):
        motor(tmp_path / "other", method="model_exchange")


def strict(fmus, version=2, **keywords):
    about = {
        "fmu": str(fmus / f"strict{version}.fmu"),
        "period": 0.25,
        "inputs": ("u/a/position = u", "n/a/position = n"),
        "outputs": ("y/a/position = y", "tol/a/position = tolerance", "pid/a/position = pid"),
    }
    return ByHand(FmuPlant(name="strict", **about | keywords))


@pytest.mark.parametrize("version", [2, 3])
def test_the_tolerance_of_its_experiment_is_passed_and_discrete_inputs_jump_at_events(fmus, version):
    for method in ("co_simulation", "model_exchange"):
        plant = strict(fmus, version, method=method, isolated=False)
        assert plant.outputs(0)["to_tol"] == (1e-9,)
        for k in range(3):
            plant.advance(0, u=(0.5,), n=(float(k),))
            assert plant.outputs(0)["to_y"] == (0.5 + k,)


@pytest.mark.parametrize(
    ("version", "fault", "says"),
    [
        (2, 6, r"fmi2DoStep: asks to end the simulation at 0\.25 s"),
        pytest.param(3, 6, r"fmi3DoStep: asks to end the simulation at 0\.25 s", marks=pytest.mark.long),
        (2, 7, "crashed: its process closed the pipe by which it is asked"),
    ],
)
def test_an_fmu_that_asks_to_end_or_closes_descriptors_is_reported(fmus, version, fault, says, capfd):
    with pytest.raises(RunError, match=says):
        strict(fmus, version, values=(f"fault = {fault}",)).advance(0, u=(0.0,), n=(0.0,))
    assert "Traceback" not in capfd.readouterr().err


CLOSING = """title: One that closes descriptors
system: strict
source: a test
duration: 1.0
nodes:
  strict: {package: softrig_control, executable: fmu_plant, parameters: {fmu: strict2.fmu, period: 0.25,
    outputs: [y/a/position = y, pid/a/position = pid], values: [fault = 7]}}
"""


@pytest.mark.parametrize(
    "mode",
    [
        "inprocess",
        *(pytest.param(m, marks=[pytest.mark.long, pytest.mark.processes]) for m in ("processes", "container")),
    ],
)
def test_a_run_whose_fmu_closes_descriptors_ends_with_a_line_and_its_status(page, mode, capfd):
    (page / "closing.yaml").write_text(CLOSING)
    before = command_lines()
    assert main(["run", "closing.yaml", "--mode", mode, "--no-plots", "--out", "out"]) == 3
    messages = [line for line in capfd.readouterr().err.splitlines() if line.startswith("softrig: the run broke")]
    text = "the FMU strict2.fmu at 0 s of its time: crashed: its process closed the pipe by which it is asked"
    assert len(messages) == 1
    assert messages[0].endswith(text)
    assert not [c for pid, c in command_lines().items() if pid not in before and b"fmu.child" in c]
    assert (page / "out" / "metrics.json").is_file()


@pytest.mark.long
def test_an_fmu_that_is_not_isolated_can_close_the_terminal_but_the_status_is_kept(page):
    """`isolated: false` gives it our own descriptors: output is lost, and the run still ends."""
    (page / "closing.yaml").write_text(CLOSING)
    words = ("run", "closing.yaml", "--mode", "inprocess", "--set", "strict.isolated=false", "--no-plots")
    done = subprocess.run([sys.executable, "-m", "softrig_bringup", *words], capture_output=True, timeout=PATIENCE)
    assert done.returncode == 3
    assert b"Traceback" not in done.stderr + done.stdout


@pytest.mark.parametrize("ending", few(["kill", "end"], 1))
def test_processes_started_by_an_fmu_end_with_it(fmus, ending, tmp_path):
    """Also where the node that runs it is killed."""
    context = multiprocessing.get_context("fork")
    near_end, far_end = context.Pipe()

    def runs():
        plant = strict(fmus, values=("fault = 8",))
        plant.advance(0, u=(0.0,), n=(0.0,))
        far_end.send(int(plant.outputs(0)["to_pid"][0]))
        far_end.recv()

    node = context.Process(target=runs)
    with warnings.catch_warnings():  # libraries with other threads handle forks themselves
        warnings.simplefilter("ignore", DeprecationWarning)
        node.start()
    assert near_end.poll(PATIENCE)
    pid = near_end.recv()
    assert Path(f"/proc/{pid}").exists()
    if ending == "kill":
        node.kill()
    else:
        near_end.send(None)
    node.join(PATIENCE)
    assert node.exitcode == (-signal.SIGKILL if ending == "kill" else 0)
    until(lambda: not Path(f"/proc/{pid}").exists(), "the end of what the FMU has started")


def test_archives_that_would_fill_a_disk_or_a_stack_are_refused(fmus, tmp_path, monkeypatch):
    monkeypatch.setattr("softrig_control.fmu.description.LARGEST", 4_000_000)

    def changed(name, add):
        path = tmp_path / f"{name}.fmu"
        path.write_bytes((fmus / "motor2.fmu").read_bytes())
        with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
            add(archive)
        return {"fmu": str(path)}

    def bomb(archive):
        with archive.open("resources/zeros", "w", force_zip64=True) as file:
            for _ in range(6):
                file.write(bytes(1_000_000))

    with pytest.raises(ParameterError, match=r"6 MB of content, expected at most 4 MB"):
        motor(fmus, **changed("bomb", bomb))
    with pytest.raises(ParameterError, match=r"is 3001 folders deep, expected at most 50"):
        motor(fmus, **changed("deep", lambda archive: archive.writestr("a/" * 3000 + "b", b"")))
    with pytest.raises(ParameterError, match=r"'\.\./b' is not a path inside it"):
        motor(fmus, **changed("out", lambda archive: archive.writestr("../b", b"")))


def test_an_fmu_without_a_usable_interface_is_refused_by_name(fmus, tmp_path):
    def described(text):
        path = tmp_path / "other.fmu"
        with zipfile.ZipFile(fmus / "motor3.fmu") as old, zipfile.ZipFile(path, "w") as new:
            for name in old.namelist():
                new.writestr(name, text if name == "modelDescription.xml" else old.read(name))
        return {"fmu": str(path)}

    one = '<fmiModelDescription fmiVersion="1.0" modelName="m" guid="g" numberOfContinuousStates="0"/>'
    with pytest.raises(ParameterError, match=r"other\.fmu is of FMI 1\.0, expected 2\.0 or 3\.0"):
        motor(fmus, **described(one))
    with zipfile.ZipFile(fmus / "motor3.fmu") as archive:
        text = archive.read("modelDescription.xml").decode()
    clocks = re.sub("<ModelExchange[^>]*/>", "", text).replace("<CoSimulation", "<ScheduledExecution")
    clocks = clocks.replace(' canHandleVariableCommunicationStepSize="true"', "")
    with pytest.raises(ParameterError, match="has no interface co_simulation; it has scheduled_execution"):
        motor(fmus, **described(clocks))


@pytest.mark.parametrize(
    ("version", "fault", "says"),
    few(
        [
            (2, 1, "crashed: its process was killed by SIGSEGV"),
            (3, 2, "fmi3DoStep: discarded it; it says: the step is too hard for me"),
            (2, 3, r"w = nan at 0\.6 s of its time, expected a finite number"),
            (3, 4, "gave no answer within 0.1 s"),
            (2, 5, "fmi2DoStep: error; it says: the step is too hard for me"),
        ],
        2,
    ),
)
def test_errors_inside_end_the_run_by_name_and_a_reset_starts_again(fmus, version, fault, says):
    outputs = ("motor/state/shaft/velocity = w",)
    plant = motor(fmus, version, period=0.1, timeout=0.1, values=(f"fault = {fault}",), outputs=outputs)

    def run():
        for _ in range(10):
            plant.advance(0, motor_command=(1.0,))

    for _ in range(2):
        with pytest.raises(RunError, match=f"motor: the FMU motor{version}.fmu.*{says}"):
            run()
        plant.reset(0)


def test_the_plant_of_the_page_is_controlled_as_ours(page):
    scenario = load_scenario(str(page / "plant.yaml"))
    run = simulate(scenario)
    nodes = scenario.model_dump(mode="json", exclude_unset=True)["nodes"]
    nodes["motor_plant"] |= {
        "package": "softrig_drives",
        "executable": "dc_motor_plant",
        "parameters": {"period": 0.001, "R": 0.5, "vmax": 100.0},
    }
    expected = simulate(make_scenario(nodes, duration=2.0)).signals["motor/state/shaft/velocity"]
    result = run.signals["motor/state/shaft/velocity"]
    assert result.t.tolist() == expected.t.tolist()
    assert result.x.tolist() == pytest.approx(expected.x.tolist(), abs=1e-9)
    assert 0.01 < run.figures["rise_time"] < 1.0
    with pytest.raises(ScenarioError, match=r"no variable 'speed'"):
        simulate(scenario, overrides={"motor_plant.outputs": ["motor/state/shaft/velocity = speed"]})


def test_the_law_of_the_page_holds_the_speed_of_our_motor(page, tmp_path):
    run = simulate(load_scenario(str(page / "law.yaml")))
    assert 0.01 < run.figures["rise_time"] < 2.0
    assert run.signals["motor/state/shaft/velocity"].x[-1] == pytest.approx(1.0, abs=0.05)


MIX = {
    "inputs": ("mix/in/a/effort = u[1]", "mix/in/c/effort = u[3]"),
    "outputs": ("mix/out/first/effort = y[1]", "mix/out/second/effort [mV] = y[2]"),
}


@pytest.mark.parametrize("isolated", few([False, True], 1))
def test_arrays_are_read_by_their_elements(fmus, isolated):
    def mix(**keywords):
        return ByHand(FmuLaw(name="mix", **{"fmu": str(fmus / "mix3.fmu"), "isolated": isolated, **MIX} | keywords))

    def commands(law, a, c):
        return law.update(0, mix_in=(a, c))["to_mix_out"]

    assert commands(mix(), 2.0, 3.0) == (1.0 * 2.0 + 3.0 * 3.0, 1e3 * (4.0 * 2.0 + 6.0 * 3.0))
    # No node publishes u[2], so it keeps its initial value.
    law = mix(values=("gain[2,3] = 60", "u[2] = 10", "bias = 1"))
    assert commands(law, 2.0, 3.0) == (1 + 2.0 + 20.0 + 9.0, 1e3 * (1 + 8.0 + 50.0 + 180.0))
    law.change(permit(FmuLaw, law.block.p, {"values": ("gain[2,3] = 60", "u[2] = 10", "bias = 5")}))
    assert commands(law, 2.0, 3.0)[0] == 5 + 2.0 + 20.0 + 9.0
    for values in (("gain[2,3] = 61", "u[2] = 10", "bias = 5"), ("bias = 5",)):
        with pytest.raises(ParameterError, match="values: this part cannot change during a run"):
            permit(FmuLaw, law.block.p, {"values": values})
    for name, says in (
        ("u", r"expected u\[1..3\]"),
        ("u[4]", r"u is an array of 3 values, expected u\[1..3\]"),
        ("gain[1]", r"expected gain\[1..2,1..3\]"),
        ("bias[1]", "bias"),
    ):
        with pytest.raises(ParameterError, match=says):
            mix(inputs=(f"mix/in/a/effort = {name}",), values=())


def test_an_fmu_beside_its_scenario_is_found_from_any_directory(page, tmp_path_factory, monkeypatch):
    other = tmp_path_factory.mktemp("other")
    monkeypatch.chdir(other)
    near_end = {m.name: m for m in rig_of(str(page / "plant.yaml")).members}
    assert near_end["motor_plant"].params.fmu == str(page / "motor2.fmu")
    (page / "child.yaml").write_text("extends: plant\ntitle: child\nduration: 0.02\n")
    assert not simulate(str(page / "child.yaml"), duration=0.01).error
    # A path in a scenario is first looked up in the current directory.
    (other / "motor2.fmu").symlink_to(page / "motor3.fmu")
    near_end = {m.name: m for m in rig_of(str(page / "plant.yaml")).members}
    assert near_end["motor_plant"].params.unit.version == "3.0"
    (other / "motor2.fmu").unlink()
    (page / "motor2.fmu").unlink()
    with pytest.raises(ScenarioError, match=r"no FMU 'motor2.fmu'; looked for motor2.fmu"):
        rig_of(str(page / "plant.yaml"))


def test_a_run_records_which_fmu_it_had(page, tmp_path):
    from softrig_bringup.cli import main

    assert main(["run", "plant.yaml", "--mode", "inprocess", "--duration", "0.1", "--no-plots", "--out", "out"]) == 0
    reported = json.loads(Path("out/metrics.json").read_text())["contents"]
    digest = hashlib.sha256(Path("motor2.fmu").read_bytes()).hexdigest()
    assert reported == {"motor_plant": {"motor2.fmu": f"sha256:{digest}"}}


@pytest.mark.parametrize("name", few(["law", "plant"], 1))
def test_real_time_gives_the_numbers_of_lockstep(page, name):
    wired = rig_of(load_scenario(str(page / f"{name}.yaml")), duration=0.2)
    rng = random.Random(1)
    run = SimulatedRig(wired, World(lambda *_: rng.randrange(1_000, 200_000)), "realtime")
    assert set(run.run().values()) == {"done"}
    assert not any(a.drive.missed or a.drive.incomplete for a in run.adapters.values())
    expected, signals = Signals(in_process(wired)), Signals(run.recording, run.epoch)
    for label in ("motor/state/shaft/velocity", "motor/command/armature/effort"):
        a, b = expected[label].x, signals[label].x
        n = min(len(a), len(b))  # the last tick may or may not be answered
        assert n >= len(a) - 1
        assert a[:n].tolist() == b[:n].tolist()


@pytest.mark.long
@pytest.mark.processes
def test_nodes_and_a_container_give_the_bytes_of_the_run_in_process(page, tmp_path):
    for name in ("plant", "law"):
        wired = rig_of(load_scenario(str(page / f"{name}.yaml")), duration=0.2)
        expected = in_process(wired)
        for groups in ([], [[m.name for m in wired.members]]):
            outcome = run_processes(wired, 0, tmp_path / f"{name}{len(groups)}", Placement(containers=groups))
            assert outcome.error == ""
            assert differences(expected, outcome.recording) == []


@pytest.mark.long
@pytest.mark.processes
def test_a_crash_ends_a_run_by_name_and_the_bag_stays(page, tmp_path):
    text = (page / "plant.yaml").read_text().replace("R = 0.5", "fault = 1")
    (page / "plant.yaml").write_text(text)
    wired = rig_of(load_scenario(str(page / "plant.yaml")))
    outcome = run_processes(wired, 0, tmp_path / "out", Placement(containers=[[m.name for m in wired.members]]))
    crash = "motor_plant: the FMU motor2.fmu at 0.5 s of its time: crashed: its process was killed by SIGSEGV"
    assert crash in outcome.error
    t = Signals(outcome.recording)["motor/state/shaft/velocity"].t
    assert t[-1] == pytest.approx(0.5)
    no_process_left(tmp_path / "out")


@pytest.mark.long
def test_an_fmu_that_cannot_save_its_state_is_repeated(fmus, monkeypatch):
    """All of it: its start, its steps, and changes in between."""
    monkeypatch.setattr(nodes, "describe", lambda file: dataclasses.replace(describe(file), serialises=False))
    plant = motor(fmus, isolated=False)
    trace(plant, 20)
    saved = plant.save()
    remaining = trace(plant, 20)
    for _ in range(2):
        plant.load(saved)
        assert trace(plant, 20) == remaining
    law = ByHand(FmuLaw(name="mix", **{"fmu": str(fmus / "mix3.fmu"), **MIX}, isolated=False, values=("bias = 1",)))
    one = law.update(0, mix_in=(2.0, 3.0))
    law.change(permit(FmuLaw, law.block.p, {"values": ("bias = 5",)}))
    saved = law.save()
    five = law.update(0, mix_in=(2.0, 3.0))
    law.change(permit(FmuLaw, law.block.p, {"values": ("bias = 1",)}))
    assert law.update(0, mix_in=(2.0, 3.0)) == one != five
    law.load(saved)
    assert law.update(0, mix_in=(2.0, 3.0)) == five
    plant.block.realtime = True
    plant.reset(0)
    with pytest.raises(RunError, match="cannot keep its state"):
        plant.save()


def test_the_log_of_an_fmu_need_not_be_text():
    log = SimpleNamespace(_log_lines=[])
    for text in (b"torn \xff", b"", None):
        Instance._log(log, 0, "instance", text)
    assert log._log_lines == ["torn \ufffd", "", ""]


def test_an_fmu_logs_only_if_the_scenario_sets_it(fmus, monkeypatch):
    from fmpy import simulation

    made, asked = simulation.instantiate_fmu, []

    def instantiated(*arguments, debug_logging, **more):
        asked.append(debug_logging)
        return made(*arguments, debug_logging=debug_logging, **more)

    monkeypatch.setattr(simulation, "instantiate_fmu", instantiated)
    for options in ({}, {"log": True}):
        trace(motor(fmus, isolated=False, **options), 1)
    assert asked == [False, True]
