"""Lockstep through real processes over DDS: exact, bit-equal to in-process, with a clear message for every fault."""

import os
import signal
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from conftest import PATIENCE, PRESS, differences, fork, in_process, make_scenario, no_process_left, until
from outside import busy, script
from softrig_core import ScenarioError, Signals, rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes import children
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment, find_executable
from softrig_nodes.processes.placement import Listener, Placement

pytestmark = pytest.mark.processes

BASIC = {"plant": "plant", "source": "source", "gain": "gain"}


def rig(nodes, duration=1.0, **keys):
    return rig_of(make_scenario(nodes, duration, **keys))


def params(executable, **parameters):
    return {"executable": executable, "parameters": parameters}


DAILY = ("delayed link",)
RIGS = {
    "basic": (BASIC, 3.0),
    "seeded noise": (BASIC | {"gain": params("gain", noise=0.3)}, 1.0),
    "two loops at two rates, a chain and a leaf": (
        {
            "plant": params("plant", period=0.0005),
            "source": params("source", period=0.1),
            "outer": params("outer", period=0.01),
            "gain": {"executable": "gain", "parameters": {"period": 0.001},
                     "remap": {"lag/reference": "lag/inner_reference"}},
            "watcher": params("watcher", period=0.0005),
        },
        1.0,
    ),
    "delayed link": ({"plant": "plant", "source": "source", "link": "link", "gain": "late_gain"}, 1.0),
    "three plants, one of which has a slow law": (
        {
            **BASIC,
            "second": {"executable": "plant", "parameters": {"period": 0.03},
                       "remap": {"lag/state": "second/state", "lag/applied": "second/applied"}},
            "third": {"executable": "plant", "parameters": {"period": 0.02},
                      "remap": {"lag/state": "third/state", "lag/applied": "third/applied",
                                "lag/command": "third/command"}},
            "law": {"executable": "dawdler", "parameters": {"period": 0.02},
                    "remap": {"lag/state": "third/state", "lag/command": "third/command"}},
        },
        0.3,
    ),
    "two plants": (
        {
            "plant": "plant", "source": "source", "gain": "gain",
            "second": {"executable": "plant", "parameters": {"period": 0.02, "gain": 3.0},
                       "remap": {"lag/state": "second/state", "lag/applied": "second/applied",
                                 "lag/command": "lag/command"}},
        },
        1.0,
    ),
}  # fmt: skip


# Rigs of other shapes run in a container daily (test_container.py).
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.long] * (n not in DAILY)) for n in RIGS])
def test_processes_equal_in_process_bit_for_bit(name, tmp_path):
    nodes, duration = RIGS[name]
    wired = rig(nodes, duration)
    outcome = run_processes(wired, 7, tmp_path)
    assert outcome.error == ""
    expected = in_process(wired, 7)
    assert differences(expected, outcome.recording) == []
    assert len(outcome.recording.topics["lag/state"].times) == wired.ticks + 1
    assert len(outcome.recording.topics["lag/command"].times) == wired.ticks // every(wired, "gain")
    assert all(s["state"] == "done" and not s["refused"] for s in outcome.status.values())


def every(wired, name):
    return next(m.schedule.every for m in wired.members if m.name == name)


@pytest.mark.long
def test_a_different_seed_gives_different_noise(tmp_path):
    wired = rig(BASIC | {"gain": params("gain", noise=0.3)}, 0.2)
    outcome = run_processes(wired, 8, tmp_path)
    assert "lag/command" in differences(in_process(wired, 7), outcome.recording)


def test_an_observer_sees_every_sample_up_to_the_end(tmp_path):
    nodes = BASIC | {"watcher": {"executable": "watcher"}}
    outcome = run_processes(rig(nodes), 0, tmp_path)
    assert outcome.status["watcher"]["figures"]["seen"] == [101.0, ""]


@pytest.mark.long
def test_many_starts_are_identical_also_under_load(tmp_path):
    """Four starts, two at a time on two cores with a spinning process beside them; test_starts.py has a thousand."""
    wired = rig(BASIC, 0.3)
    expected = in_process(wired)
    load = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        with ThreadPoolExecutor(2) as pool:
            outcomes = list(pool.map(lambda i: run_processes(wired, 0, tmp_path / str(i)), range(4)))
    finally:
        load.kill()
        load.wait()
    assert [o.error for o in outcomes if o.error] == []
    assert [i for i, o in enumerate(outcomes) if differences(expected, o.recording)] == []


@pytest.fixture
def hasty(monkeypatch):
    """For nodes that react only to the last of the signals that end them."""
    monkeypatch.setattr(children, "STOP_STEPS", [(number, 0.3) for number, _ in children.STOP_STEPS])


def test_a_node_that_does_not_continue_ends_the_run_with_its_name(hasty, tmp_path):
    nodes = BASIC | {"watcher": params("watcher", lingers_after=31)}
    outcome = run_processes(rig(nodes, 0.3, timeout=2.5), 0, tmp_path)
    assert outcome.error == "node watcher did not reach the end of the run within 2.5 s after it"
    assert differences(in_process(rig(nodes, 0.3)), outcome.recording) == []
    assert no_process_left(tmp_path)


@pytest.mark.parametrize("mode", ["lockstep", pytest.param("realtime", marks=pytest.mark.long)])
def test_a_node_that_never_publishes_ends_the_run_with_its_name(mode, hasty, tmp_path):
    """As one that is blocked inside DDS; with an outside node its peers would wait forever, too."""
    nodes = BASIC | {"gain": params("gain") | {"external": True}, "watcher": params("watcher", comes_up=False)}
    outcome = run_processes(rig(nodes, 0.3, start_timeout=2.0), 0, tmp_path, Placement(clock=mode))
    assert outcome.error == "node watcher has reported nothing within 2 s of its start"
    assert no_process_left(tmp_path)


@pytest.mark.long
def test_a_slow_node_does_not_end_a_run_that_continues(tmp_path):
    """Its ticks, and its end, are further apart than the timeout."""
    nodes = {name: params(name, period=1e-4) for name in ("plant", "gain")} | {"source": params("source", period=1.0)}
    outcome = run_processes(rig(nodes, 1.0, timeout=2.5), 0, tmp_path)
    assert outcome.error == ""
    assert outcome.status["plant"]["ticks"] == 10_000


@pytest.mark.long
def test_a_node_read_only_by_slower_ones_is_waited_for(tmp_path):
    nodes = {
        "plant": params("plant", period=0.001),
        "source": params("source", period=0.1),
        "outer": params("outer", period=0.001),
        "gain": params("gain", period=0.02) | {"remap": {"lag/reference": "lag/inner_reference"}},
    }
    wired = rig(nodes, 0.2)
    outcome = run_processes(wired, 0, tmp_path)
    assert outcome.error == ""
    assert differences(in_process(wired), outcome.recording) == []


@pytest.mark.long  # runs in a container daily
def test_a_press_by_service_in_lockstep_is_recorded_at_the_tick_that_saw_it(tmp_path):
    wired = rig(BASIC, 1e4)
    people = []
    with free_domain() as domain:

        def progress(t):
            if t and not people:
                people.append(script(PRESS, environment(domain, tmp_path)))
            if people and people[0].poll() is not None:
                raise KeyboardInterrupt

        outcome = run_processes(wired, 0, tmp_path, Placement(domain=domain), Listener(progress=progress))
    assert people[0].returncode == 0
    assert (outcome.error, outcome.stopped) == ("", signal.SIGINT)
    recording = outcome.recording
    pressed, released = recording.topics["lag/kick"].times
    assert released - pressed == 10_000_000
    assert Signals(recording)["lag/applied/u/effort"].x.sum() != 0.0


@pytest.mark.long
def test_an_unwritable_status_file_is_one_line(tmp_path):
    executable = str(find_executable("faultrig", "plant"))
    done = subprocess.run([executable, "--ros-args", "-p", f"run.status:={tmp_path}/nowhere/s"], capture_output=True,
                          text=True, env=environment(1, tmp_path), timeout=PATIENCE)  # fmt: skip
    assert done.returncode == 3
    assert "No such file or directory" in done.stderr.splitlines()[-1]


def fault(how, **keys):
    return rig(BASIC | {"gain": params("killed", how=how, at=0.2)}, 1.0, timeout=2.5, **keys)


@pytest.mark.parametrize(
    ("how", "texts"),
    [
        ("kill", ["node gain was killed by SIGKILL"]),
        pytest.param("stop", ["node gain: its process is stopped (SIGSTOP)"], marks=pytest.mark.long),
        pytest.param(
            "hang", ["plant: nothing stamped t = 0.2 s within", "lag/command from gain"], marks=pytest.mark.long
        ),
        pytest.param("end", ["code of node gain after t = ", "has ended its process"], marks=pytest.mark.long),
        ("nan", ["gain: command u/effort became nan at t = 0.2 s"]),
        pytest.param("raise", ["gain: failed at t = 0.2 s: ArithmeticError: deliberate"], marks=pytest.mark.long),
    ],
)
def test_a_failing_controller_ends_the_run_with_its_name_and_a_readable_recording(how, texts, tmp_path):
    wired = fault(how)
    outcome = run_processes(wired, 0, tmp_path)
    for text in texts:
        assert text in outcome.error
    good = in_process(rig(BASIC, 0.2))
    assert outcome.recording.topics["lag/state"].data == good.topics["lag/state"].data
    commands = outcome.recording.topics["lag/command"].data  # a node killed by force may lose its last 0.25 s
    assert commands == good.topics["lag/command"].data[: len(commands)]
    assert len(commands) == 20 or how in ("kill", "stop", "hang", "end")
    assert no_process_left(tmp_path)


@pytest.mark.long
def test_ctrl_c_stops_all_nodes(tmp_path):
    code = textwrap.dedent(f"""
        import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r})
        from conftest import make_scenario
        from softrig_core import (rig_of)
        from softrig_nodes import run_processes
        from softrig_nodes.processes.placement import Listener
        from pathlib import Path
        wired = rig_of(make_scenario({BASIC!r}, 1e5))
        run_processes(wired, 0, Path({str(tmp_path)!r}), listener=Listener(lambda t: print(t, flush=True)))
    """)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True)
    while int(process.stdout.readline()) == 0:
        pass
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=PATIENCE)  # each node may take up to 9 s, on a busy machine more
    assert no_process_left(tmp_path)


def test_nodes_die_with_a_killed_runner(tmp_path):
    code = textwrap.dedent(f"""
        import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r})
        from conftest import make_scenario
        from softrig_core import (rig_of)
        from softrig_nodes import run_processes
        from softrig_nodes.processes.placement import Listener
        from pathlib import Path
        wired = rig_of(make_scenario({BASIC!r}, 1e5))
        run_processes(wired, 0, Path({str(tmp_path)!r}), listener=Listener(lambda t: print(t, flush=True)))
    """)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    while int(process.stdout.readline()) == 0:
        pass
    process.kill()
    process.wait()
    until(lambda: no_process_left(tmp_path), "nodes outlive their runner")


def test_bad_parameters_stop_a_node_with_one_line(tmp_path):
    variables = os.environ | {"ROS_LOG_DIR": str(tmp_path)}
    executable = find_executable("faultrig", "plant")
    for argument, text in [
        ("gain:=-1.0", "parameter gain = -1.0: input should be greater than 0"),
        ("gian:=1.0", "parameter gian is unknown (did you mean 'gain'?); this block has period, gain, limit"),
        ("gain:=high", "parameter gain = 'high': input should be a valid number"),
        ("run.mode:=fast", "run.mode"),
    ]:
        with ExitStack() as stack:
            done = fork(stack, "faultrig", "plant", [executable, "--ros-args", "-p", argument], variables)
            message = done.communicate(PATIENCE)[0]
        assert done.returncode == 2
        assert text.removeprefix("run.") in message
        assert len(message.strip().splitlines()) == 1


def test_a_refused_parameter_is_a_scenario_error():
    with pytest.raises(ScenarioError, match=r"test: node plant: parameter gain = -1"):
        rig(BASIC | {"plant": params("plant", gain=-1.0)})


OUTSIDE = """
import sys
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

rclpy.init()
node = Node("gain")
publisher = node.create_publisher(JointState, "lag/command", 10)
latest = {}

def reference(message):
    latest[message.header.stamp.sec * 10**9 + message.header.stamp.nanosec] = message.points[0].positions[0]
    answer()

def state(message):
    latest["state"] = message
    answer()

def answer():
    message = latest.get("state")
    if message is None:
        return
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    if stamp not in latest:
        return
    command = JointState()
    command.header.stamp = message.header.stamp
    command.name = ["u"]
    command.effort = [2.0 * (latest[stamp] - message.position[0])]
    EXTRA
    publisher.publish(command)
    latest.pop("state")

node.create_subscription(JointState, "lag/state", state, 10)
node.create_subscription(JointTrajectory, "lag/reference", reference, 10)
rclpy.spin(node)
"""


def by_itself(code, variables):
    return subprocess.Popen([sys.executable, "-c", code], env=variables)


def with_outside_controller(extra, directory, duration=1.0, mode="lockstep", start=None, **keys):
    """Run the basic rig with a plain rclpy controller: nothing of softrig is imported in it, unless it is forked."""
    wired = rig(BASIC | {"gain": {"executable": "gain", "external": True}}, duration, **keys)
    with free_domain() as domain:
        code, outside, messages = OUTSIDE.replace("EXTRA", extra), [], []

        def announce(text):
            messages.append(text)
            if outside:
                return
            assert f"ROS_DOMAIN_ID={domain}" in text
            assert "lag/command" in text
            outside.append((start or by_itself)(code, environment(domain, directory)))

        try:
            outcome = run_processes(
                wired, 0, directory, Placement(domain=domain, clock=mode), Listener(announce=announce)
            )
            arrived = messages.index("gain is there")
            assert all("CYCLONEDDS_URI" in text for text in messages[1:arrived])
            assert all("refused a message on lag/command" in text for text in messages[arrived + 1 :])
            return wired, outcome
        finally:
            for process in outside:
                process.kill()
                process.wait()


@pytest.mark.long
def test_an_outside_controller_replaces_a_softrig_controller(tmp_path):
    """It joins late by construction: it is started only when the rig already waits for it."""
    _, outcome = with_outside_controller("", tmp_path)
    assert outcome.error == ""
    reference = in_process(rig(BASIC))
    assert outcome.recording.topics["lag/state"].data == reference.topics["lag/state"].data
    assert len(outcome.recording.topics["lag/command"].data) == 100


@pytest.mark.long
def test_real_time_begins_when_the_outside_controller_has_joined(tmp_path):
    """And not a fixed time after the start: it is started only when the rig already waits for it."""
    _, outcome = with_outside_controller("", tmp_path, 1.0, "realtime", script)
    assert outcome.error == ""
    command = Signals(outcome.recording, outcome.epoch)["lag/command/u/effort"]
    assert 0.0 <= command.t[0] < 0.5
    assert len(command.t) > 20  # of 101 ticks; on a loaded machine some are late
    assert len({s["epoch"] for s in outcome.status.values()}) == 1


@pytest.mark.long
@pytest.mark.parametrize(
    ("extra", "reason"),
    [  # tests of the codec cover each of these refusals as well
        ("command.effort = [float('nan')]", "u/effort is nan, expected a finite number"),
        *(
            pytest.param(*row, marks=pytest.mark.long)
            for row in (
                ("command.header.stamp.sec += 1", "stamp 1 s from gain, expected 0 s"),
                ("command.name = ['w']", "names ['w'], expected ['u']"),
                ("command.effort = [1.0, 2.0]", "effort has 2 values, expected 1 (u)"),
            )
        ),
    ],
)
def test_a_bad_outside_command_never_reaches_the_plant(extra, reason, tmp_path):
    _, outcome = with_outside_controller(extra, tmp_path, start=script, timeout=2.5 * busy())
    assert "plant: nothing stamped t = 0 s within" in outcome.error
    assert reason in outcome.error
    assert outcome.status["plant"]["refused"]["lag/command"] == [1, reason]
    assert len(outcome.recording.topics["lag/state"].times) == 1


PLANT = """
import rclpy
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

rclpy.init()
node = Node("plant")
state = node.create_publisher(JointState, "lag/state", 10)
clock = node.create_publisher(Clock, "/clock", 10)
tick = 0

def send():
    message = JointState(name=["x"], position=[0.01 * tick], velocity=[float("nan") if tick == BAD else 1.0])
    message.header.stamp.nanosec = 10_000_000 * tick
    state.publish(message)
    clock.publish(Clock(clock=message.header.stamp))

def command(message):
    global tick
    tick += 1
    send()

def start():
    if state.get_subscription_count() and clock.get_subscription_count() and subscription.get_publisher_count():
        timer.cancel()
        send()

subscription = node.create_subscription(JointState, "lag/command", command, 10)
timer = node.create_timer(0.5, start)
rclpy.spin(node)
"""


def test_a_link_loses_a_rejected_measurement_and_the_run_continues(tmp_path):
    """For messages that are paired by counting: one that cannot be read counts too."""
    parameters = {"topic_in": "lag/state", "topic_out": "lag/late_state", "channels": ["x"], "delay": 0.03}
    link = {"package": "softrig_control", "executable": "fieldbus_delay", "parameters": parameters}
    nodes = {"plant": {"executable": "plant", "external": True}, "source": "source", "link": link, "gain": "late_gain"}
    wired = rig(nodes, 0.3)
    with free_domain() as domain:
        outside = []

        def announce(text):
            if outside:
                return
            outside.append(script(PLANT.replace("BAD", "10"), environment(domain, tmp_path)))

        try:
            outcome = run_processes(wired, 0, tmp_path, Placement(domain=domain), Listener(announce=announce))
        finally:
            for process in outside:
                process.kill()
                process.wait()
    assert outcome.error == ""
    assert outcome.status["link"]["refused"]["lag/state"] == [1, "x/velocity is nan, expected a finite number"]
    late = Signals(outcome.recording)["lag/late_state/x/position"]
    lost = np.array([*range(10), 9, *range(11, 27)]) * 0.01
    assert late.x == pytest.approx([0.0] * 3 + list(lost), abs=1e-12)


@pytest.mark.long  # runs in a container daily
def test_a_second_publisher_ends_the_run_naming_both(tmp_path):
    wired = rig(BASIC, 1e4)
    with free_domain() as domain:
        variables = environment(domain, tmp_path)
        intruders = []

        def progress(t):
            if t and not intruders:
                code = OUTSIDE.replace('Node("gain")', 'Node("intruder")').replace("EXTRA", "")
                intruders.append(script(code, variables))

        outcome = run_processes(wired, 0, tmp_path, Placement(domain=domain), Listener(progress=progress))
        intruders[0].kill()
        intruders[0].wait()
    assert "2 publishers on lag/command (/gain, /intruder), expected exactly one" in outcome.error


def test_a_peer_that_never_starts_is_named(tmp_path):
    wired = rig(BASIC | {"gain": {"executable": "gain", "external": True}})
    outcome = run_processes(wired, 0, tmp_path, Placement(wait=1.0))
    assert "not all peers after 1 s" in outcome.error
    assert "gain" in outcome.error


@pytest.mark.long
def test_two_simultaneous_runs_do_not_mix(tmp_path):
    wired = rig(BASIC, 1.0)
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(lambda i: run_processes(wired, i, tmp_path / str(i)), range(2)))
    assert len({o.domain for o in outcomes}) == 2
    assert [o.error for o in outcomes] == ["", ""]
