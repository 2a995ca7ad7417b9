"""A controller and a plant in C as nodes: the struct is the state, and errors of a library end the run by name."""

from __future__ import annotations

import copy
import functools
import pickle
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from conftest import command_lines
from softrig_bringup.new.native import new_native
from softrig_control.c_member.nodes import CController, CParams
from softrig_control.c_member.ports import described
from softrig_core import (
    ByHand,
    ParameterError,
    Rig,
    RunError,
    Scenario,
    Session,
    linear_view,
    load_scenario,
    rig_of,
    simulate,
)
from softrig_core.export.command import export_c
from softrig_core.native import engine, fitted
from softrig_core.native.compile import plain
from test_linear_view import T, sampled_motor
from test_native import the_same

if shutil.which("cc") is None:
    pytest.skip("needs a C compiler: apt-get install gcc", allow_module_level=True)

HERE = Path(__file__).parent / "c_laws"
PI: dict[str, Any] = {
    "period": 0.01,
    "sources": [str(HERE / "pi.c")],
    "header": str(HERE / "pi.h"),
    "trajectories": ["motor/reference"],
    "inputs": ["motor/reference/shaft/velocity [rad/s] = reference", "motor/state/shaft/velocity [rad/s] = speed"],
    "outputs": ["motor/command/armature/effort [V] = voltage"],
    "values": ["kp [V s/rad] (0..10) = 0.5", "ki [V/rad] = 2.0", "limit [V] = 12", "period [s] = 0.01"],
}
SPEED = "motor/state/shaft/velocity"


EXPORTED = {"dc_motor_pid": ("dc_motor_smc_b4", 0.5), "dc_motor_plant": ("dc_motor_smc", 0.05)}


@functools.cache
def contents_of(scenario: str) -> dict[str, Any]:
    return load_scenario(scenario).model_dump(exclude={"name"})


def rig_with(
    parameters: dict[str, Any],
    node: str = "dc_motor_pid",
    executable: str = "c_controller",
    scenario: str = "dc_motor_smc_b4",
    duration: float = 0.5,
    plant: dict[str, Any] | None = None,
) -> Rig:
    """Make the rig of a scenario with one node in C, unchanged without parameters."""
    result = copy.deepcopy(contents_of(scenario))
    if parameters:
        result["nodes"][node] = {"package": "softrig_control", "executable": executable, "parameters": parameters}
    if plant:
        result["nodes"]["dc_motor_plant"]["parameters"] = plant
    del result["nodes"]["dc_motor_metrics"]
    result |= {"figures": {}, "expect": {}, "plots": [], "claims": {}, "requirements": {}, "duration": duration}
    return rig_of(Scenario(name="c_test", **result))


def faulty(fault: str, **more: Any) -> dict[str, Any]:
    return PI | {"flags": [f"-DFAULT={fault}"]} | more


def f32(x: float) -> float:
    return float(np.float32(x))


def test_the_law_computes_its_source_in_single_precision() -> None:
    """Against numpy's float32, operation by operation."""
    law = ByHand(CController(CParams(**PI), "pi"))
    one = np.float32
    integral, kp, step, limit = one(0.0), one(0.5), one(2.0) * one(0.01), one(12.0)
    for k, (reference, speed) in enumerate([(10.0, 0.0), (10.0, 3.3), (40.0, 3.4), (10.0, 9.9), (-50.0, 2.0)]):
        outputs = law.update(k * 10**7, motor_reference=(reference,), motor_state=(speed,))
        e = one(reference) - one(speed)
        u = kp * e + integral
        if abs(u) <= limit:
            integral += step * e
        assert outputs == {"to_motor_command": (float(np.clip(u, -limit, limit)),)}
        assert law.x == (float(integral), k + 1, int(abs(u) > limit))
        assert type(law.x.ticks) is int
    assert law.x._fields == ("integral", "ticks", "saturated")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    for node, (scenario, duration) in EXPORTED.items():
        export_c(rig_of(scenario, duration=duration), node, folder, drawn=20)
    return folder


@pytest.mark.parametrize(
    ("node", "executable"),
    [("dc_motor_pid", "c_controller"), pytest.param("dc_motor_plant", "c_plant", marks=pytest.mark.long)],
)
def test_exported_c_runs_as_a_node_with_the_same_bits(exported: Path, node: str, executable: str) -> None:
    scenario, duration = EXPORTED[node]
    parameters = {
        "period": float(next(m.schedule.period for m in rig_of(scenario).members if m.name == node)),
        "sources": [str(exported / f"{node}.c")],
        "header": str(exported / f"{node}.h"),
        "description": str(exported / f"{node}.json"),
    }
    wanted = simulate(rig_with({}, scenario=scenario, duration=duration)).recording
    result = simulate(rig_with(parameters, node, executable, scenario, duration))
    assert result.recording.topics == wanted.topics
    assert len(result.blocks[node].block._names) > 2


@pytest.mark.parametrize("make", [plain, pytest.param(engine.compiled, marks=pytest.mark.long)])
def test_native_code_calls_it_by_its_address(monkeypatch: pytest.MonkeyPatch, make: Any) -> None:
    """In Python's text, and by numba; if the library returns a status, Python runs the tick."""
    native = the_same(lambda: rig_with(PI), monkeypatch, make)
    assert native.ticks >= 48
    fitted._counts.clear()  # forget the code generated for the former library
    broken = the_same(lambda: rig_with(faulty("CRASH")), monkeypatch, make)
    assert broken.given_up == 1


def test_a_c_member_is_rewound_branched_and_changed_live() -> None:
    for parameters in (PI, faulty("STATIC")):
        plain, back = Session(rig_with(parameters)), Session(rig_with(parameters))
        plain.go(0.5)
        back.go(0.4)
        back.rewind(0.2)
        other = back.branch()
        other.set({"dc_motor_pid.values": [*PI["values"][:1], "ki [V/rad] = 9.0", *PI["values"][2:]]})
        other.go(0.5)
        back.go(0.5)
        assert back.recording.topics == plain.recording.topics
        assert other.recording.topics != plain.recording.topics


def test_hidden_state_gives_the_same_run_as_declared_state_and_is_reported() -> None:
    pure, hiding = simulate(rig_with(PI)), [simulate(rig_with(faulty("STATIC"))) for _ in range(2)]
    for run in hiding:  # the state of one run does not affect the next
        assert run.recording.topics == pure.recording.topics
        level, text, _ = run.blocks["dc_motor_pid"].reports["hidden_state"]
        assert (level, "pi.c keeps state outside of pi: integral; " in text) == (1, True)
    assert "hidden_state" not in pure.blocks["dc_motor_pid"].reports


def test_state_that_no_file_shows_is_found_by_repeated_ticks() -> None:
    runs = [simulate(rig_with(faulty("RANDOM"))) for _ in range(2)]
    assert runs[0].recording.topics == runs[1].recording.topics
    assert "has different answers when it is repeated" in runs[0].blocks["dc_motor_pid"].reports["hidden_state"][1]


def test_its_state_is_kept_by_an_fmu_and_by_a_restarted_node() -> None:
    for parameters in (PI, faulty("STATIC")):
        one, other = (ByHand(CController(CParams(**parameters), "pi")) for _ in range(2))
        for k in range(5):
            one.update(k * 10**7, motor_reference=(10.0,), motor_state=(float(k),))
        other.load(pickle.loads(pickle.dumps(one.save())))
        ask = {"motor_reference": (3.0,), "motor_state": (1.0,)}
        assert other.update(5 * 10**7, **ask) == one.update(5 * 10**7, **ask)
        assert other.block.save(other.x) is not None


def test_in_a_separate_process_the_numbers_are_the_same() -> None:
    law, apart = (ByHand(CController(CParams(**PI, isolated=isolated), "pi")) for isolated in (False, True))
    for k in range(5):
        ask = {"motor_reference": (10.0 * k,), "motor_state": (float(k),)}
        assert apart.update(k * 10**7, **ask) == law.update(k * 10**7, **ask)
        assert apart.x == law.x


def test_the_linear_view_includes_it() -> None:
    """Its integral is a state, and the poles of the loop are those of python-control."""
    values = [*PI["values"][:2], "limit [V] = 1e5", *PI["values"][3:]]
    rig = rig_with(PI | {"flags": ["-DREAL=double"], "values": values}, plant={"vmax": 1e5})
    view = linear_view(rig, at=0.4, link="motor/command/armature/effort")
    assert "dc_motor_pid.integral" in view.states
    law = 0.5 + 2.0 * T / control.tf([1, -1], [1], T)
    motor = sampled_motor()
    loop = control.ss(control.ss(motor.A, motor.B, [[1, 0]], [[0]], T) * control.ss(law))
    exact = np.linalg.eigvals(loop.A - loop.B @ loop.C)
    results = sorted(abs(p) for p in view.loop_poles if abs(p) > 1e-3)
    assert results == pytest.approx(sorted(map(abs, exact)), rel=1e-6)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("CRASH", "pi.c at t = 0.2 s: crashed (SIGSEGV) in pi_step"),
        pytest.param("ABORT", "pi.c at t = 0.2 s: crashed (SIGABRT) in pi_step", marks=pytest.mark.long),
        pytest.param("RECURSE", "pi.c at t = 0.2 s: crashed (SIGSEGV) in pi_step", marks=pytest.mark.long),
        ("CONSTANT", "pi.c at t = 0.2 s: pi_step changes a member that holds constants"),
        ("NOT_A_NUMBER", "armature/effort became nan at t = 0.2 s"),
    ],
)
@pytest.mark.parametrize("isolated", [False, True])
def test_a_failing_library_ends_the_run_by_name(fault: str, message: str, isolated: bool) -> None:
    if isolated and fault != "CRASH":
        return
    message = message.replace(" in pi_step", "") if isolated else message
    with pytest.raises(RunError, match="dc_motor_pid: ") as result:
        simulate(rig_with(faulty(fault, isolated=isolated)))
    assert message in str(result.value)


def test_a_hanging_library_is_abandoned_if_it_is_isolated() -> None:
    with pytest.raises(RunError, match=r"pi.c at t = 0.2 s: gave no answer within 0.2 s"):
        simulate(rig_with(faulty("HANG", isolated=True, timeout=0.2)))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("EXIT", "ended its process with status 0"),
        pytest.param("CLOSES", "closed the pipes on which it answers", marks=pytest.mark.long),
        pytest.param("FORKS", "gave no answer within 0.5 s", marks=pytest.mark.long),
    ],
)
def test_a_library_that_exits_ends_alone_and_leaves_nothing_behind(fault: str, message: str) -> None:
    """`exit` in a law would end softrig itself, with the status 0 of a passed run."""
    before = command_lines()
    with pytest.raises(RunError, match=rf"pi.c at t = 0.2 s: {message}"):
        simulate(rig_with(faulty(fault, isolated=fault == "CLOSES", timeout=0.5)))
    assert not [c for pid, c in command_lines().items() if pid not in before and b"shim_pi" in c]


def test_a_library_that_affects_the_whole_process_reports_why_it_runs_separately() -> None:
    run = simulate(rig_with(faulty("EXIT"), duration=0.1))
    assert (
        run.blocks["dc_motor_pid"].reports["apart"][1].startswith("pi.c calls exit, which would affect all of softrig")
    )
    assert run.recording.topics == simulate(rig_with(PI, duration=0.1)).recording.topics


@pytest.mark.long
@pytest.mark.parametrize("isolated", [False, True])
def test_the_floating_point_mode_of_the_processor_is_restored(isolated: bool) -> None:
    """If it rounded upward, one plus half of its last bit would be more than one; if it flushed, a subnormal number
    would be 0.
    """
    # Volatile inputs, which the compiler cannot fold.
    least, bit = struct.unpack("2d", struct.pack("2d", 5e-324, 2.0**-53))
    with pytest.raises(RunError, match="leaves the processor with another rounding mode"):
        simulate(rig_with(faulty("ROUNDING", isolated=isolated)))
    simulate(rig_with(PI | {"flags": ["-ffast-math"]}, duration=0.05))
    # Compare bytes: a CPU that flushes subnormal numbers also compares them as 0.
    assert struct.pack("2d", 1.0 + bit, least * 2.0) == struct.pack("dq", 1.0, 2)


@pytest.mark.long
def test_a_library_that_prints_more_than_a_pipe_holds_does_not_block() -> None:
    run, quiet = (simulate(rig_with(p, duration=0.25)) for p in (faulty("PRINTS", isolated=True), PI))
    assert run.recording.topics == quiet.recording.topics


def test_a_tripped_law_publishes_its_outputs_keeps_its_state_and_is_counted() -> None:
    run = simulate(rig_with(faulty("GIVES_UP")))
    step = run.blocks["dc_motor_pid"]
    assert step.reports["gave_up"][1:] == (
        "pi_step answers 1 (gave up): its outputs are published, its state stays",
        30,
    )
    assert step.x.ticks == 20
    assert run.signals["motor/command/armature/effort"][1][-1] == 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": "nowhere.h"}, "no header 'nowhere.h'"),
        ({"sources": [], "library": "/bin/true"}, "pi_init"),
        ({"sources": [], "library": str(HERE / "pi.c")}, "is not a shared library"),
        ({"sources": []}, "expected either library, which is built, or sources"),
        ({"prefix": "pid"}, "has no function pid_init; it offers pi_init, pi_step"),
        ({"inputs": PI["inputs"][:1]}, "pi_in.speed has no channel; add TOPIC/CHANNEL/FIELD [UNIT] = speed to inputs"),
        ({"inputs": [*PI["inputs"], "a/b/position [1] = sped"]}, "pi_in has no member 'sped' (did you mean 'speed'?)"),
        ({"inputs": ["speed"]}, "expected TOPIC/CHANNEL/FIELD [UNIT] = MEMBER"),
        ({"values": PI["values"][1:]}, "pi_params.kp has none; add kp [UNIT] = VALUE"),
        ({"values": ["kp [V s/rad] (0..10) = 11", *PI["values"][1:]]}, "11 V s/rad is beyond 0 to 10"),
        ({"values": ["kp = nan", *PI["values"][1:]]}, "no finite number"),
        ({"flags": ["-DFAULT=("]}, "pi.c does not compile: "),
    ],
)
def test_a_mismatch_is_refused_before_a_run(changes: dict[str, Any], message: str) -> None:
    with pytest.raises((ParameterError, ValueError)) as result:
        CController(CParams(**(PI | changes)), "pi")
    assert message in str(result.value)


def test_a_library_of_another_machine_is_refused(tmp_path: Path) -> None:
    library = tmp_path / "libpi.so"
    subprocess.run(["cc", "-shared", "-fPIC", str(HERE / "pi.c"), "-o", str(library)], check=True)
    changed = bytearray(library.read_bytes())
    struct.pack_into("<H", changed, 18, 40)  # e_machine: ARM
    library.write_bytes(changed)
    with pytest.raises(ValueError, match="is built for ARM, this machine is "):
        CParams(**(PI | {"sources": [], "library": str(library)}))


def test_a_rebuilt_library_is_loaded_with_the_next_run(tmp_path: Path) -> None:
    library = tmp_path / "libpi.so"

    def build(*flags: str) -> None:
        subprocess.run(["cc", "-shared", "-fPIC", *flags, str(HERE / "pi.c"), "-o", str(library)], check=True)

    build()
    parameters = PI | {"sources": [], "library": str(library)}
    plain, session = Session(rig_with(parameters)), Session(rig_with(parameters))
    plain.go(0.5)
    session.go(0.2)
    build("-DFAULT=GIVES_UP")
    session.set({"dc_motor_pid.values": PI["values"]})
    session.go(0.5)
    assert all(session.recording.topics[name] == topic for name, topic in plain.recording.topics.items())
    assert "this run continues with the build of its start" in session.steps["dc_motor_pid"].reports["rebuilt"][1]
    assert simulate(rig_with(parameters)).recording.topics != plain.recording.topics


PAIRS = (("c++", "g++"), ("fortran", "gfortran"), ("rust", "cargo"))


@pytest.mark.parametrize(
    ("language", "tool"),
    [("c", "cc"), *(pytest.param(*pair, marks=pytest.mark.long) for pair in PAIRS)],
)
def test_the_result_of_new_runs_as_its_scenario_expects(language: str, tool: str, tmp_path: Path) -> None:
    if shutil.which(tool) is None:
        pytest.skip(f"needs {tool}: apt-get install {'g++' if tool == 'g++' else tool}")
    scenario = new_native("my_pi", tmp_path / "my_pi", language, "softrig")
    if language == "rust":
        command = ["cargo", "build", "--release", "--offline", "--quiet"]
        subprocess.run(command, cwd=scenario.parent, check=True)
    run = simulate(str(scenario))
    assert not run.missed, run.figures
    assert not run.blocks["my_pi"].reports  # statics of Rust's own library are not reported as hidden state


@pytest.mark.long
@pytest.mark.parametrize("language", ["c", "c++", "fortran", "rust"])
def test_its_own_build_and_test_pass(language: str, tmp_path: Path) -> None:
    folder = new_native("my_pi", tmp_path / "my_pi", language, "softrig").parent
    cmake = (["cmake", "-B", "build"], ["cmake", "--build", "build"], ["ctest", "--test-dir", "build"])
    for command in [["cargo", "test", "--offline"]] if language == "rust" else cmake:
        if shutil.which(command[0]) is None:
            pytest.skip(f"needs {command[0]}: apt-get install {command[0]}")
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"period_s": [1e999, 1], "ports": 3}', '{"period_s": [1, 0], "ports": []}']
)
def test_an_invalid_description_is_refused_in_one_line(text, tmp_path):
    (tmp_path / "law.json").write_text(text)
    with pytest.raises(ValueError, match=r"^law\.json describes no node: .*; expected what `softrig export c` writes$"):
        described(tmp_path / "law.json")
