"""All nodes of a rig in one process: the same bytes as through processes and in process, the same messages on
faults.
"""

import json
import os
import signal
import subprocess
import time
from collections import deque
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from board_by_hand import UNO
from conftest import PATIENCE, PRESS, differences, few, fork, in_process, make_scenario, no_process_left, until
from outside import script
from softrig_core import Recording, Signals, list_scenarios, rig_of
from softrig_nodes import container as containers, run_processes
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment, find_executable
from softrig_nodes.processes.fork_server import start_node
from softrig_nodes.processes.placement import NOBODY, Listener, Placement
from softrig_nodes.processes.ports import chosen
from softrig_nodes.processes.shared_memory import numbers
from softrig_nodes.ros.profile import PROPERTY, VARIABLE, joining, own_profile
from softrig_nodes.seam.exchange import BURST, Exchange
from test_processes import BASIC, OUTSIDE, RIGS, params, rig

pytestmark = pytest.mark.processes

HEADLINES = [
    "dc_motor_smc",
    "dc_motor_fsfb",
    "economic_dispatch",
    "fault_location",
    "gupfc",
    "induction_dtc",
    "lsrm_fuzzy",
    "manipulator_adsmc",
    "pv_mppt",
    "rectifier_mpc",
    "rehab_impedance",
    "tcp_aqm_smc",
]
# Rigs whose systems do not run in processes daily; and one each with a link, a solver and arrays.
DAILY = ("dc_motor_fsfb", "economic_dispatch", "fault_location", "induction_dtc", "pv_mppt", "rectifier_mpc")


def run(wired, directory, seed=0, groups=None, domain=None, clock="lockstep", listener=NOBODY):
    """Run a rig in one container, or in the given ones."""
    groups = [[m.name for m in wired.members]] if groups is None else groups
    return run_processes(wired, seed, directory, Placement(domain=domain, containers=groups, clock=clock), listener)


def short(name, ticks):
    """A scenario shortened to some ticks, at least three of its slowest node."""
    whole = rig_of(name)
    slowest = max(m.schedule.period for m in whole.members)
    least = max(ticks * whole.clock.schedule.period, 3 * slowest)
    return rig_of(whole, duration=min(whole.scenario.duration, float(least)))


def equal_to_in_process(wired, outcome, seed=0):
    assert outcome.error == ""
    expected = in_process(wired, seed)
    assert sum(len(t.times) for t in expected.topics.values())
    assert differences(expected, outcome.recording) == []


@pytest.mark.parametrize(
    "name", few([pytest.param(n, marks=[pytest.mark.long] * (n not in DAILY)) for n in HEADLINES], 1)
)
def test_every_system_gives_the_bytes_of_the_run_in_process(name, tmp_path):
    wired = short(name, 300)
    seed = wired.scenario.seed
    outcome = run(wired, tmp_path, seed)
    equal_to_in_process(short(name, 300), outcome, seed)
    assert len(list(tmp_path.glob("*.log"))) == 1


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(list_scenarios()) - set(HEADLINES) - {*UNO}))
def test_every_scenario_gives_the_bytes_of_the_run_in_process(name, tmp_path):
    wired = short(name, 300)
    outcome = run(wired, tmp_path, wired.scenario.seed)
    equal_to_in_process(short(name, 300), outcome, wired.scenario.seed)


@pytest.mark.long
@pytest.mark.parametrize("name", HEADLINES)
def test_a_headline_scenario_through_processes_and_in_a_container(name, tmp_path):
    wired = short(name, 1000)
    processes = run(wired, tmp_path / "processes", wired.scenario.seed, groups=[])
    container = run(short(name, 1000), tmp_path / "container", wired.scenario.seed)
    assert processes.error == container.error == ""
    assert differences(processes.recording, container.recording) == []


@pytest.mark.parametrize("name", few(RIGS, 4))
def test_rigs_of_all_shapes_run_in_a_container(name, tmp_path):
    nodes, duration = RIGS[name]
    outcome = run(rig(nodes, duration), tmp_path, 7)
    equal_to_in_process(rig(nodes, duration), outcome, 7)
    assert all(s["state"] == "done" and not s["refused"] for s in outcome.status.values())


GROUPS = ([["plant", "source"]], [["plant"], ["source", "gain"]], [["gain", "plant"]])


@pytest.mark.parametrize("groups", few(GROUPS, 1))
def test_some_nodes_share_a_process(groups, tmp_path):
    outcome = run(rig(BASIC), tmp_path, groups=groups)
    equal_to_in_process(rig(BASIC), outcome)


def test_containers_of_a_scenario_are_checked():
    scenario = make_scenario(BASIC, containers=[["plant", "source"]])
    assert scenario.containers == (("plant", "source"),)
    with pytest.raises(ValueError, match="containers: no node 'plan'; the nodes are plant, source, gain"):
        make_scenario(BASIC, containers=[["plan"]])
    with pytest.raises(ValueError, match="containers: node plant is in more than one"):
        make_scenario(BASIC, containers=[["plant"], ["plant", "gain"]])


# A user with the usual tools: reads a topic, lists the nodes, requests a parameter.
PERSON = """
import json, sys
import rclpy
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState
from diagnostic_msgs.msg import DiagnosticArray

rclpy.init()
node = Node("person")
states, health = [], set()
node.create_subscription(JointState, "lag/state", lambda m: states.append(m.position[0]), 10)
node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: health.add(m.status[0].name), 10)
client = AsyncParameterClient(node, "gain")
client.wait_for_services()
asked = client.get_parameters(["noise"])
while not (asked.done() and len(states) > 50 and len(health) == 3):
    rclpy.spin_once(node)
print(json.dumps({"nodes": sorted(node.get_node_names()), "noise": asked.result().values[0].double_value,
                  "readers": sorted(i.node_name for i in node.get_subscriptions_info_by_topic("lag/state")),
                  "health": sorted(health)}))
"""


def test_each_node_is_on_the_graph_and_the_run_is_unchanged(tmp_path, monkeypatch):
    # Native code would finish the run before the other node has joined the graph.
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    wired, people = rig(BASIC, 1e4), []
    with free_domain() as domain, (tmp_path / "said").open("w") as text:

        def progress(t):
            if t and not people:
                people.append(script(PERSON, environment(domain, tmp_path), output=text.fileno()))
            if people and people[0].poll() is not None:
                raise KeyboardInterrupt

        stopped(lambda: run(wired, tmp_path, domain=domain, listener=Listener(progress)))
    seen = json.loads((tmp_path / "said").read_text())
    assert seen == {
        "nodes": ["gain", "person", "plant", "source"],
        "noise": 0.0,
        "readers": ["gain", "person"],
        "health": ["/gain", "/plant", "/source"],
    }
    recording = Recording((t, p.msgtype) for t, p in wired.topics.items())
    recording.read_shard(tmp_path / "plant.shard")
    states = recording.topics["lag/state"]
    expected = in_process(rig(BASIC, 0.01 * (len(states.times) + 1))).topics["lag/state"]
    assert states.data == expected.data[: len(states.data)]


def stopped(call):
    """A stopped run returns or raises, as the runner decides."""
    with suppress(KeyboardInterrupt):
        call()


@pytest.mark.long
def test_a_press_by_service_is_recorded_at_the_tick_that_saw_it(tmp_path):
    # The press ends the run, so its length does not matter.
    wired, people, text = rig(BASIC, 1e7), [], tmp_path / "said"
    until = time.monotonic() + PATIENCE
    with free_domain() as domain, text.open("w") as words:

        def progress(t):
            if t and not people:
                people.append(script(PRESS, environment(domain, tmp_path), output=words.fileno()))
            if (people and people[0].poll() is not None) or time.monotonic() > until:
                raise KeyboardInterrupt

        outcomes = []
        stopped(lambda: outcomes.append(run(wired, tmp_path, domain=domain, listener=Listener(progress))))
        ends = [person.poll() for person in people]
        for person in people:
            person.kill()
            person.wait()
    assert ends == [0], ([outcome.error for outcome in outcomes], text.read_text())
    recording = Recording((t, p.msgtype) for t, p in wired.topics.items())
    recording.read_shard(tmp_path / "plant.shard")
    pressed, released = recording.topics["lag/kick"].times
    assert released - pressed == 10_000_000
    assert Signals(recording)["lag/applied/u/effort"].x.sum() != 0.0


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ("kill", "node gain was killed by SIGKILL"),
        pytest.param("end", "code of node plant after t = ", marks=pytest.mark.long),
        ("nan", "gain: command u/effort became nan at t = 0.2 s"),
        ("raise", "gain: failed at t = 0.2 s: ArithmeticError: deliberate"),
    ],
)
def test_a_failing_node_ends_the_run_with_its_name_and_a_readable_recording(how, text, tmp_path):
    wired = rig(BASIC | {"gain": params("killed", how=how, at=0.2)}, 1.0, timeout=2.5)
    outcome = run(wired, tmp_path)
    assert text in outcome.error
    good = in_process(rig(BASIC, 0.2))
    states = outcome.recording.topics["lag/state"].data
    assert states == good.topics["lag/state"].data[: len(states)]
    assert len(states) == 21 or how in ("kill", "end")
    assert no_process_left(tmp_path)


def container(directory, *arguments):
    """Exit status and output of a container that fails to start."""
    command = [find_executable("softrig_nodes", "container"), *arguments]
    with ExitStack() as stack:
        process = fork(stack, "softrig_nodes", "container", command, environment(1, directory))
        printed = process.communicate(PATIENCE)[0]
    return process.returncode, printed


def test_a_bad_parameter_is_one_line_that_names_the_node(tmp_path):
    arguments = ["faultrig", "plant", "--", "faultrig", "gain", "--ros-args", "-r", "__node:=mine", "-p", "noise:=high"]
    status, printed = container(tmp_path, *arguments)
    assert status == 2
    assert printed.splitlines()[-1].startswith("mine: parameter noise = 'high'")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [(["faultrig"], "expected PACKAGE EXECUTABLE"), (["faultrig", "nothing"], "no executable 'nothing'")],
)
def test_a_bad_command_line_is_one_line(arguments, text, tmp_path):
    status, message = container(tmp_path, *arguments)
    assert status == 2
    assert text in message.splitlines()[-1]


def with_outside_controller(extra, directory):
    wired = rig(BASIC | {"gain": {"executable": "gain", "external": True}}, 1.0, timeout=2.5)
    with free_domain() as domain:
        outside = script(OUTSIDE.replace("EXTRA", extra), environment(domain, directory))
        try:
            return run(wired, directory, domain=domain)
        finally:
            outside.kill()
            outside.wait()


def test_an_outside_controller_closes_the_loop_around_a_container(tmp_path):
    outcome = with_outside_controller("", tmp_path)
    assert outcome.error == ""
    reference = in_process(rig(BASIC))
    assert outcome.recording.topics["lag/state"].data == reference.topics["lag/state"].data
    assert len(outcome.recording.topics["lag/command"].data) == 100


@pytest.mark.long  # as the same test in processes
def test_a_bad_outside_command_never_reaches_the_plant(tmp_path):
    outcome = with_outside_controller("command.effort = [float('nan')]", tmp_path)
    reason = "u/effort is nan, expected a finite number"
    assert "plant: nothing stamped t = 0 s within" in outcome.error
    assert reason in outcome.error
    assert outcome.status["plant"]["refused"]["lag/command"] == [1, reason]
    assert len(outcome.recording.topics["lag/state"].times) == 1


def test_a_second_publisher_ends_the_run_naming_both(tmp_path, monkeypatch):
    monkeypatch.setenv("SOFTRIG_JIT", "0")  # native code would finish the run before the other publisher exists
    wired, intruders = rig(BASIC, 1e5), []
    with free_domain() as domain:

        def progress(t):
            if t and not intruders:
                code = OUTSIDE.replace('Node("gain")', 'Node("intruder")').replace("EXTRA", "")
                intruders.append(script(code, environment(domain, tmp_path)))

        outcome = run(wired, tmp_path, domain=domain, listener=Listener(progress))
        intruders[0].kill()
        intruders[0].wait()
    assert "2 publishers on lag/command (/gain, /intruder), expected exactly one" in outcome.error


READER = """
import sys
import rclpy
from rclpy.node import Node

from sensor_msgs.msg import JointState

rclpy.init()
node = Node("reader")
file = open(sys.argv[1], "wb", buffering=0)
node.create_subscription(JointState, "lag/state", file.write, 1000, raw=True)
file.write(b"up")
rclpy.spin(node)
"""


def test_a_rig_runs_in_real_time_in_a_container(tmp_path):
    with free_domain() as domain:
        reader = script(READER, environment(domain, tmp_path), str(tmp_path / "read"))
        until(lambda: (tmp_path / "read").exists() and (tmp_path / "read").stat().st_size)
        outcome = run(rig(BASIC), tmp_path, domain=domain, clock="realtime")
        assert outcome.error == ""
        # The native thread must have published everything that was recorded, up to the last message.
        recorded = b"".join(outcome.recording.topics["lag/state"].data)
        until(lambda: (tmp_path / "read").read_bytes().endswith(recorded[-100:]))
        reader.kill()
        reader.wait()
    received = (tmp_path / "read").read_bytes().removeprefix(b"up")
    assert recorded.endswith(received)
    assert len(received) > len(recorded) / 10
    status = outcome.status["plant"]
    times = outcome.recording.topics["lag/state"].times  # a busy machine may start late
    assert len(times) + status["missed_deadlines"] == (times[-1] - times[0]) // 10_000_000 + 1
    assert times[-1] - outcome.epoch >= 1_000_000_000
    assert status["lateness_p50_ms"] >= 0.0  # tests of the simulated clock check how late ticks are
    assert status["round_trip_p50_ms"] > 0.0


def test_a_stopped_container_keeps_its_recordings(tmp_path):
    command = [str(find_executable("softrig_nodes", "container"))]
    for name in BASIC:
        command += [
            "faultrig",
            name,
            "--ros-args",
            "-p",
            f"run.shard:={tmp_path / name}.shard",
            "-p",
            f"run.status:={tmp_path / name}.status",
            "--",
        ]
    with free_domain() as domain:
        process = start_node("softrig_nodes", "container", command, environment(domain, tmp_path), 2)
        until(lambda: all(status(tmp_path, name)["ticks"] for name in ("plant", "gain")))
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
    assert {status(tmp_path, name)["state"] for name in BASIC} == {"done"}


def status(directory, name):
    try:
        return json.loads((directory / f"{name}.status").read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return {}


# the exchange alone ----------------------------------------------------------------------------------------------


def test_messages_are_delivered_one_after_the_other_and_never_nested():
    exchange, order, depth = Exchange(), deque(maxlen=4), [0]
    limit = 100_000

    def receive(number):
        depth[0] += 1
        assert depth[0] == 1
        order.append(number)
        if number < limit:
            exchange.post(partial(receive, number + 1))
        depth[0] -= 1

    exchange.post(partial(receive, 0))
    exchange.serve(1 << 62)
    assert list(order) == [limit - 3, limit - 2, limit - 1, limit]


def test_messages_for_others_are_sent_in_bursts_and_when_there_is_time():
    exchange, sent = Exchange(), []
    for k in range(BURST + 1):
        exchange.carry(sent.append, k)
        assert sent == ([] if k < BURST - 1 else list(range(BURST)))  # a full burst is published in one go
    assert exchange.serve(1 << 62) > 0  # with nothing else due, the rest is published before the loop sleeps
    assert sent == list(range(BURST + 1))

    def again(left):
        if left:
            exchange.post(partial(again, left - 1))

    exchange.carry(sent.append, "late")
    exchange.post(partial(again, 1000))
    exchange.serve(0)  # with no time left
    assert sent[-1] == "late"


def test_a_full_queue_yields_in_time_and_an_error_names_its_node():
    exchange = Exchange()

    def again():
        exchange.post(again)

    def broken(data):
        raise ArithmeticError("deliberate")

    exchange.owners[broken] = "culprit"
    exchange.post(again)
    start = time.monotonic()
    assert exchange.serve(time.monotonic_ns() + 20_000_000) == 0
    assert time.monotonic() - start >= 0.02
    assert exchange.culprit() == ""
    exchange.hand(broken, b"")
    with pytest.raises(ArithmeticError):
        exchange.serve(1 << 62)
    assert exchange.culprit() == "culprit"


def test_timers_repeat_and_can_be_moved():
    exchange, fired = Exchange(), []
    timer = exchange.timer(1_000_000, lambda: fired.append(1), "me")
    while len(fired) < 3:
        assert 0 < exchange.serve(1 << 62) <= 1_000_000
    timer.cancel()
    assert exchange.next_due() == 1 << 62
    so_far = len(fired)
    timer.again(100_000_000_000)
    assert 0 < exchange.serve(1 << 62, awake=1_000_000) <= 100_000_000_000
    # The loop stays awake, but ends in time.
    assert exchange.serve(time.monotonic_ns() + 5_000_000, awake=200_000_000_000) == 0
    assert len(fired) == so_far


def test_a_timer_can_move_or_end_itself():
    exchange, fired = Exchange(), []

    def once():
        fired.append(1)
        timer.cancel()

    timer = exchange.timer(1_000, once, "me")
    while not fired:
        exchange.serve(1 << 62)
    assert exchange.next_due() == 1 << 62


# the profile -------------------------------------------------------------------------------------------------------


def test_a_profile_keeps_its_settings_and_gets_ports_and_the_property(tmp_path, monkeypatch):
    profile_file = tmp_path / "mine.xml"
    profile_file.write_text(
        '<?xml version="1.0"?><profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">'
        '<participant profile_name="a" is_default_profile="true"><rtps><name>mine</name></rtps>'
        "</participant></profiles>"
    )
    monkeypatch.setenv(VARIABLE, str(profile_file))
    for exclusive in (True, False):
        with joining(exclusive=exclusive):
            text = Path(os.environ[VARIABLE]).read_text()
            assert "<name>mine</name>" in text
            assert (f"<name>{PROPERTY}</name><value>true</value>" in text) == exclusive
            assert "ns0:" not in text
            assert text.count("<port><portBase>") == 1
        assert os.environ[VARIABLE] == str(profile_file)
    content = profile_file.read_bytes().replace(b"<rtps>", b"<rtps><port><portBase>7000</portBase></port>")
    assert own_profile(content).count(b"<portBase>") == 1


def test_the_well_known_ports_stay_and_the_others_change(monkeypatch):
    """With the standard ones at 7400 + 250 * domain, no port belongs to another participant or to a dead one."""
    seen = set()
    for k in range(40):
        monkeypatch.setattr(os, "getpid", lambda k=k: 32_700 + k)
        ports = chosen(7, now=1e6 + 0.45 * k)
        base = ports["portBase"]
        assert {name: base + ports[name] for name in ("offsetd0", "offsetd1", "offsetd2")} == {
            "offsetd0": 7400,
            "offsetd1": 7410,
            "offsetd2": 7401,
        }
        user, unique = base + ports["offsetd3"] - 7400, base - 400
        assert 11 + 2 * 32 < user < 250 - 2 * 31
        assert 6200 <= unique < 6600
        seen.add((user, unique))
    last = chosen(232)
    # Above 65,535 no port exists, so the standard's numbers hold.
    assert last["portBase"] + last["offsetd3"] == 7400 + 11
    assert len({user for user, _ in seen}) == len({unique for _, unique in seen}) == 40
    together = set()
    for k in range(50):
        monkeypatch.setattr(os, "getpid", lambda k=k: 32_700 + k)
        together.add(chosen(7, now=1e6)["portBase"])
    assert len(together) == 50


def test_a_port_number_with_an_existing_file_is_chosen_last(tmp_path, monkeypatch):
    """A process that wrote to the dead owner of the file continues to use it, so its messages to a new owner of the
    same name are lost.
    """
    for name in ("fastrtps_port9236", "fastrtps_port9237_el", "sem.fastrtps_port1_mutex", "fastrtps_0123456789abcdef"):
        (tmp_path / name).touch()
    assert numbers(tmp_path) == {9236, 9237}
    assert numbers(tmp_path / "none") == set()
    whole = range(6200, 10_000)
    monkeypatch.setattr("softrig_nodes.ros.profile.numbers", lambda: {*whole} - {6333, 7400 + 250 * 7 + 100})
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    with joining():
        text = Path(os.environ[VARIABLE]).read_text()
    assert "<portBase>6733</portBase>" in text
    assert f"<offsetd3>{7400 - 6733 + 100}</offsetd3>" in text
    assert chosen(7, whole, 1e6) == chosen(7, now=1e6)


@pytest.mark.parametrize(("text", "why"), [(b"<a", "not XML"), (b"<profiles/>", "no participant")])
def test_a_profile_without_a_participant_is_refused(text, why):
    with pytest.raises(ValueError, match=why):
        own_profile(text)


def test_a_container_without_nodes_prints_its_usage(tmp_path):
    done = subprocess.run([find_executable("softrig_nodes", "container")], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (2, "")
    assert "PACKAGE EXECUTABLE" in done.stdout
    for arguments in (["--ros-args"], ["--ros-args", "-r", "__node:=container"]):
        assert container(tmp_path, *arguments) == (2, done.stdout)


def test_failed_nodes_are_named_among_those_that_had_not_ended(monkeypatch):
    def node(name, state, settle=lambda: None):
        drive = SimpleNamespace(settle=settle)
        return SimpleNamespace(
            middleware=SimpleNamespace(name=name), state=state, error=None, waits_for=[], drive=drive
        )

    def full():
        raise OSError("disk full")

    monkeypatch.setattr(containers, "conclude", lambda node, stopped: 3 if node.state == "failed" else 0)
    ended, _, going = nodes = [node("a", "done"), node("b", "failed"), node("c", "running")]
    assert containers.Container._conclude(SimpleNamespace(adapters=nodes), stopped=False) == 3
    assert [(n.state, str(n.error), n.waits_for) for n in nodes] == [
        ("done", "None", []),
        ("failed", "None", []),
        ("failed", "stopped: b has failed", ["b"]),
    ]
    going = node("c", "running")
    assert containers.Container._conclude(SimpleNamespace(adapters=[ended, going]), stopped=True) == 0
    assert going.state == "running"
    going = node("c", "running", full)  # its native ticks cannot be recorded
    assert containers.Container._conclude(SimpleNamespace(adapters=[going]), stopped=True) == 3
    assert str(going.error) == "disk full"
