"""Recorder and player as real processes over DDS."""

import gc
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
from conftest import PATIENCE, differences, ears, few, fork, until
from mcap.reader import make_reader
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from softrig_bags.cli import main_bag, main_compare, main_play, main_record
from softrig_bags.compare import compare
from softrig_bags.content.topics import BagTopic
from softrig_bags.files.bag import BagWriter
from softrig_bags.files.reader import BagReader
from softrig_bags.live.holds import Holds, patience
from softrig_bags.live.player import LockstepPlayer, Publishers, span
from softrig_bags.live.recorder import Recorder
from softrig_bags.live.ros import publisher_profile
from softrig_bags.live.selection import Selection
from softrig_bags.read import read_bag, signals
from softrig_bags.repair import repair
from softrig_bags.write import write_bag
from softrig_core import Recording, RunError
from softrig_core.wire.cdr import Layout, parse
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import PROFILE, environment, find_executable
from softrig_nodes.processes.shared_memory import judged
from softrig_nodes.ros.messages import message_class
from std_srvs.srv import Trigger

pytestmark = pytest.mark.processes
STATE, CLOCK = "sensor_msgs/msg/JointState", "rosgraph_msgs/msg/Clock"
NODES = Path(__file__).parents[1] / "bag_nodes.py"


class Rig:
    """Processes of one test, in a domain of their own."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.stack, self.folder = stack, folder
        self.domain = stack.enter_context(free_domain())
        self.environment = environment(self.domain, folder)

    def start(self, command: list[str], **options) -> subprocess.Popen:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env=self.environment, cwd=self.folder, process_group=0, **options)  # fmt: skip
        self.stack.callback(end, process)
        return process

    def recorder(self, *arguments):
        return self.fork("recorder", arguments)

    def player(self, *arguments):
        return self.fork("player", arguments)

    def fork(self, name: str, arguments):
        """Start a node of the suite by the fork server, which saves its imports."""
        command = [find_executable("softrig_bags", name), *arguments]
        process = fork(self.stack, "softrig_bags", name, command, self.environment, self.folder)
        self.stack.callback(end, process)
        return process

    def node(self, *arguments) -> subprocess.Popen:
        return self.start([sys.executable, str(NODES), *map(str, arguments)])


def end(process: subprocess.Popen) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # child processes would otherwise keep the pipe open
    process.communicate()


def finish(process: subprocess.Popen, number: int | None = None) -> tuple[int, str]:
    """Send a signal, if any; return exit status and output."""
    if number is not None:
        process.send_signal(number)
    output = process.communicate(timeout=PATIENCE)[0]
    return process.returncode, output


@pytest.fixture
def rig(tmp_path):
    with ExitStack() as stack:
        yield Rig(stack, tmp_path)


def small(ticks=200, every=4) -> Recording:
    """A clock and a plant's state each ms, and a command of twice the position every few ms."""
    result = Recording([("/clock", CLOCK), ("plant/state", STATE), ("command", STATE)])
    layouts = [Layout(CLOCK), Layout(STATE, "", ["a"], {"position": 1}), Layout(STATE, "", ["a"], {"effort": 1})]
    for k in range(ticks):
        t = k * 1_000_000
        result.add(0, t, layouts[0].encode(t, ()))
        result.add(1, t, layouts[1].encode(t, (0.5 * k,)))
        if k % every == 0:
            result.add(2, t, layouts[2].encode(t, (1.0 * k,)))
    return result


def large(count=500, channels=1200) -> Recording:
    """Messages of about 10 kB, 1 ms apart."""
    layout = Layout(STATE, "", [], {"position": channels})
    result = Recording([("big", STATE)])
    for k in range(count):
        result.add(0, k * 1_000_000, layout.encode(k * 1_000_000, (float(k),) * channels))
    return result


@pytest.mark.parametrize(
    "options",
    [
        ("--compression", "zstd", "--max-duration", "0.05"),
        pytest.param(("--storage", "sqlite3", "--regex", "clock|plant|comm"), marks=pytest.mark.long),
    ],
)
def test_record_and_replay_round_trip(rig, tmp_path, capsys, options):
    write_bag(tmp_path / "source", small())
    recorder = rig.recorder("--output", "copy", "--use-sim-time", *options)
    player = rig.player("source", "--wait", "--rate", "2")
    assert finish(player) == (0, "450 messages played\n")
    status, output = finish(recorder, signal.SIGTERM)
    assert status == 0, output
    assert re.search(r"450 messages of . topics in .*/copy, none lost", output)
    copy = read_bag(tmp_path / "copy")
    assert differences(small(), copy) == []
    files = len(list((tmp_path / "copy").iterdir())) - 1
    assert files == (4 if "--max-duration" in options else 1)
    with BagReader(tmp_path / "copy") as bag:
        assert all(t.offered for t in bag.topics)
    assert main_compare([str(tmp_path / "source"), str(tmp_path / "copy")]) == 0
    assert main_bag(["info", str(tmp_path / "copy")]) == 0
    assert "450 messages in 0.199 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("storage", "source"),
    few([("mcap", large()), ("mcap", small(8)), ("sqlite3", large())], 1),
)
def test_kill_9_costs_at_most_a_megabyte(rig, tmp_path, storage, source):
    write_bag(tmp_path / "source", source)
    size = sum(len(d) for t in source.topics.values() for d in t.data)
    short = len(source.topics) == 3  # the bag is smaller than a chunk, but older than the flush period
    last = [t.data[-1] for t in source.topics.values()] if short else []
    recorder = rig.recorder("--output", "cut", "--storage", storage, "--use-sim-time")
    assert finish(rig.player("source", "--wait"))[0] == 0
    file = next((tmp_path / "cut").glob("cut_0.*"))
    least = max(size - 1_000_000, 4 * size // 5)
    until(lambda: file.stat().st_size > least and all(d in file.read_bytes() for d in last), "the flush")
    recorder.kill()
    recorder.wait()
    with pytest.raises(ValueError, match="softrig bag repair"):
        read_bag(tmp_path / "cut")
    done = repair(tmp_path / "cut")
    assert "no index" in str(done) or "lost" in str(done)
    recording = read_bag(tmp_path / "cut")
    for name, topic in source.topics.items():
        kept = len(recording.topics[name].data)
        assert kept >= len(topic.data) - 1_000_000 // len(topic.data[0])
        assert recording.topics[name].data == topic.data[:kept]
    if short:
        assert sum(f.kept for f in done.files) == 18


def small_disk(command: list[str]) -> tuple[list[str], dict]:
    """Run a command with a disk of 3 MB at ``disk``, kept as ``saved``; without the right to mount, files are limited
    to 3 MB.
    """
    script = 'mkdir disk && mount -t tmpfs -o size=3m none disk && "$@"; status=$?; cp -r disk saved; exit $status'
    if subprocess.run(["unshare", "-rm", "true"], check=False, capture_output=True).returncode == 0:
        return ["unshare", "-rm", "sh", "-c", script, "sh", *command], {}
    script = 'mkdir disk && "$@"; status=$?; cp -r disk saved; exit $status'
    limit = (3_000_000, resource.RLIM_INFINITY)
    return ["sh", "-c", script, "sh", *command], {
        "preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    }


@pytest.mark.parametrize("storage", ["mcap", pytest.param("sqlite3", marks=pytest.mark.long)])
def test_a_full_disk_ends_the_recording_with_a_readable_bag(rig, tmp_path, storage):
    source = large()
    write_bag(tmp_path / "source", source)
    executable = str(find_executable("softrig_bags", "recorder"))
    command, options = small_disk([executable, "-o", "disk/bag", "-s", storage, "--use-sim-time"])
    recorder = rig.start(command, **options)
    rig.player("source", "--wait")
    status, output = finish(recorder)
    assert status == 3, output
    assert re.search(r"recording stopped: .*(full|No space|too large|disk I/O)", output)
    result = read_bag(tmp_path / "saved/bag").topics["big"]
    assert 100 < len(result.data) < 320
    assert result.data == source.topics["big"].data[: len(result.data)]
    assert sorted(p.suffix for p in (tmp_path / "saved/bag").iterdir()) == sorted(
        [".yaml", ".mcap" if storage == "mcap" else ".db3"]
    )


def test_losses_are_counted_and_reported(rig, tmp_path):
    # A node that is stopped for longer than the lease of 3 s counts as dead, and messages that it misses then do not
    # count as lost. On a loaded machine the burst alone takes that long.
    patient = tmp_path / "patient.xml"
    patient.write_text(PROFILE.read_text().replace("<sec>3</sec>", "<sec>600</sec>"))
    rig.environment["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(patient)
    publisher = rig.node("publish", 8_000)
    recorder = rig.recorder("burst", "--output", "bag", "--use-sim-time")
    assert publisher.stdout.readline() == "matched\n"
    recorder.send_signal(signal.SIGSTOP)  # of the burst the recorder receives only what fits into its queue
    publisher.stdin.write("go\n")
    publisher.stdin.flush()
    assert publisher.stdout.readline() == "sent\n"
    recorder.send_signal(signal.SIGCONT)
    assert publisher.stdout.readline() == "acknowledged\n"
    status, output = finish(recorder, signal.SIGINT)
    assert status == 1
    assert "messages lost so far: /burst" in output
    count, lost = map(int, re.search(r"(\d+) messages of 1 topics in .*, LOST (\d+): /burst", output).groups())
    assert lost > 0
    assert count + lost == 8_000
    with BagReader(tmp_path / "bag") as bag:
        assert bag.count == count
        assert bag.custom_data["lost"] == f"/burst: {lost}"


def test_qos_is_adapted_to_publishers_as_they_appear(rig, tmp_path):
    node = rig.node("mixed")
    assert node.stdout.readline() == "latched\n"
    recorder = rig.recorder("--output", "bag", "--regex", "text|sensor|both")
    # The recorder has subscribed to "both" again, with a weaker QoS profile.
    assert node.stdout.readline() == "sent\n"
    file = tmp_path / "bag/bag_0.mcap"
    awaited = (b"sensor\0", b"unreliable\0", b"reliable again\0")
    until(lambda: all(name in file.read_bytes() for name in awaited), "the flush")
    status, output = finish(recorder, signal.SIGINT)
    assert status == 0, output
    result = read_bag(tmp_path / "bag").topics
    assert [b"once" in d for d in result["text"].data] == [True]
    assert len(result["sensor"].data) == 1
    assert sorted(parse(STATE, d).names[0] for d in result["both"].data) == ["reliable", "reliable again", "unreliable"]
    with BagReader(tmp_path / "bag") as bag:
        profiles = {t.name: publisher_profile(t) for t in bag.topics}
    assert profiles["/text"].durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert profiles["/sensor"].reliability == ReliabilityPolicy.BEST_EFFORT
    assert profiles["/both"].reliability == ReliabilityPolicy.RELIABLE


@pytest.fixture
def recorder(listener, tmp_path):
    """A recorder inside this process, which processes messages only on request."""
    writer = BagWriter(tmp_path / "bag")
    made = Recorder(SimpleNamespace(node=listener), writer, Selection(("/late",)), stamped=True)
    yield made
    writer.close()


def test_messages_that_wait_while_qos_is_adapted_are_kept(recorder, listener, tmp_path):
    other = Node("other", context=listener.context)
    kind = message_class(STATE)
    reliable = other.create_publisher(kind, "/late", 1000)
    until(lambda: recorder._discover() or reliable.get_subscription_count(), "match")
    for _ in range(50):
        reliable.publish(kind())
    assert reliable.wait_for_all_acked(Duration(seconds=10))
    other.create_publisher(kind, "/late", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    until(lambda: listener.count_publishers("/late") == 2, "second publisher")
    before = recorder._subscriptions["/late"]
    until(lambda: recorder._events.poll() or recorder._subscriptions.get("/late") is not before, "adaption")
    assert recorder._subscriptions["/late"].qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    recorder._flush()
    assert recorder._writer.count == 50
    assert "lost" not in recorder._writer.custom_data


def test_a_topic_that_returns_with_another_type_is_recorded_with_both(recorder, rig, tmp_path):
    context = rclpy.Context()  # a participant has one type per topic, so the other type needs a second participant
    context.init(domain_id=rig.domain)
    other = Node("other", context=context)
    for msgtype, count in ((STATE, 5), ("std_msgs/msg/Header", 4), (STATE, 3)):
        kind = message_class(msgtype)
        publisher = other.create_publisher(kind, "/late", 10)
        until(lambda p=publisher: recorder._discover() or p.get_subscription_count(), f"match of {msgtype}")
        for _ in range(count):
            publisher.publish(kind())
        assert publisher.wait_for_all_acked(Duration(seconds=10))
        other.destroy_publisher(publisher)
    context.shutdown()
    recorder._drain()
    assert recorder.losses() == "none lost"
    recorder._writer.close()
    with (tmp_path / "bag/bag_0.mcap").open("rb") as file:
        counts = Counter((schema.name, channel.topic) for schema, channel, _ in make_reader(file).iter_messages())
    assert counts == {(STATE, "/late"): 8, ("std_msgs/msg/Header", "/late"): 4}


def test_topics_without_header_get_the_newest_stamp(recorder, tmp_path):
    stamped, bare = BagTopic.known("/stamped", STATE), BagTopic.known("/bare", "std_msgs/msg/Float64")
    for topic in (stamped, bare):
        recorder._numbers[topic.name, topic.msgtype] = recorder._writer.add_topic(topic)
    for t in (5, 3):
        recorder._receiver(stamped)(Layout(STATE).encode(t, ()))
    recorder._receiver(bare)(Layout("std_msgs/msg/Float64").encode(0, (1.0,)))
    recorder._writer.close()
    topics = read_bag(tmp_path / "bag").topics
    assert sorted(topics["stamped"].times) == [3, 5]
    assert topics["bare"].times == [5]


def test_a_recorder_that_was_stopped_does_not_claim_that_nothing_was_lost(listener, tmp_path):
    now = [100.0]
    writer = BagWriter(tmp_path / "bag")
    made = Recorder(SimpleNamespace(node=listener), writer, Selection(("/late",)), holds=Holds(2.5, lambda: now[0]))
    topic = BagTopic.known("/late", STATE)
    made._numbers["/late", STATE] = writer.add_topic(topic)
    for pause in (0.1, 2.4, 0.1):  # a slow machine, on which no limit is exceeded
        now[0] += pause
        made._discover()
        made._receiver(topic)(Layout(STATE).encode(1, ()))
    assert made.losses() == "none lost"
    assert "held" not in writer.custom_data
    now[0] += 7.3
    made._discover()
    now[0] += 0.1
    made._discover()
    assert made.losses() == (
        "none counted as lost, but HELD for 7.3 s after message 3: what was sent then may be missing"
    )
    writer.close()
    with BagReader(tmp_path / "bag") as bag:
        assert bag.custom_data["held"] == "7.3 s after message 3"


def test_the_timeout_of_publishers_is_that_of_the_profile(tmp_path, monkeypatch):
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    assert patience() == 2.5
    own = tmp_path / "own.xml"
    own.write_text(PROFILE.read_text().replace("<sec>3</sec>", "<sec>DURATION_INFINITY</sec>"))
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(own))
    assert patience() == float("inf")
    own.write_text("<profiles/>")  # the profile sets no durations, so Fast DDS's defaults hold
    assert patience() == 17.0
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE")
    assert patience() == 2.5


def received(directory: Path, source: Recording) -> None:
    """A bag as `ros2 bag record` makes it: times of arrival on the wall clock, out of step with the stamps."""
    writer = BagWriter(directory)
    numbers = [writer.add_topic(BagTopic.known("/" + t.name.lstrip("/"), t.msgtype)) for t in source.topics.values()]
    for i, (number, topic) in enumerate(zip(numbers, source.topics.values(), strict=True)):
        for t, data in zip(topic.times, topic.data, strict=True):
            writer.write(number, 1_700_000_000 * 10**9 + t + (2 - i) * 1_500_000, data)
    writer.close()


@pytest.mark.long
def test_lockstep_replay_is_complete_and_identical_at_any_speed(rig, tmp_path):
    source = small(every=1)
    write_bag(tmp_path / "golden", source)
    write_bag(tmp_path / "sparse", small(every=4))
    del source.topics["command"]
    received(tmp_path / "received", source)

    def play(bag, *options):
        return finish(rig.player(bag, "--lockstep", "/command", "--exclude", "clock", *options))

    echo = rig.node("echo", 2.0, 0.0, 10_000)
    assert play("golden", "--answers", "fast") == (0, "200 messages played, answered by 200 on command\n")
    status, output = play("sparse")
    assert status == 3
    assert "/command: answer stamped 0.001 s, expected 0.004 s" in output
    assert play("received", "--answers", "free")[0] == 0
    finish(echo, signal.SIGINT)
    echo = rig.node("echo", 2.0, 0.002, 210)
    assert play("golden", "--answers", "slow")[0] == 0
    status, output = play("golden", "--timeout", "1")
    assert status == 3
    assert "no answer to t = 0.01 s on /command within 1 s" in output
    finish(echo, signal.SIGINT)

    answers = [read_bag(tmp_path / name).topics for name in ("fast", "slow", "free")]
    assert answers[0] == answers[1] == answers[2]
    golden = signals(tmp_path / "golden")
    assert compare(golden, signals(tmp_path / "fast"), topics=["command"]).equal
    changed = rig.node("echo", 2.02, 0.0, 10_000)
    assert play("golden", "--answers", "changed")[0] == 0
    finish(changed, signal.SIGINT)
    result = compare(golden, signals(tmp_path / "changed"), topics=["command"])
    assert (result.topics[0].differing, result.first.stamp, result.first.a) == (199, 1_000_000, 1.0)


@pytest.fixture
def listener(rig, monkeypatch):
    """A node in this process, in the domain of the rig, with what it received."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    context = rclpy.Context()
    context.init(domain_id=rig.domain)
    node = Node("listener", context=context)
    node.received = []
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    for name, msgtype in (("/clock", CLOCK), ("/state", STATE)):
        node.create_subscription(
            message_class(msgtype), name, lambda m, name=name: node.received.append((name, m)), 1000
        )

    def turn():  # one turn handles all messages that have arrived before `until` is checked again
        executor.spin_once(timeout_sec=0.05)
        for _ in range(20):
            executor.spin_once(timeout_sec=0)

    node.turn = turn
    yield node
    context.shutdown()


def in_lockstep(listener, bag: BagReader) -> LockstepPlayer:
    """A player in this process of a plant's state, answered on /command; it runs in the listener's executor."""
    session = SimpleNamespace(node=listener, stopped=False, spin=lambda seconds: listener.turn())
    session.stop = partial(setattr, session, "stopped", True)
    played = [t for t in bag.topics if t.name == "/plant/state"]
    return LockstepPlayer(session, bag, Publishers(session, bag, played, {}), ["/command"], {}, span(bag, 0.0, None))


@pytest.fixture
def law(listener):
    """A node in this process that answers as in the bag."""
    node, kind = Node("law", context=listener.context), message_class(STATE)
    publisher = node.create_publisher(kind, "/command", 10)

    def answer(message):
        doubled = kind(header=message.header, name=["a"], effort=[2.0 * message.position[0]])
        publisher.publish(doubled)

    node.create_subscription(kind, "/plant/state", answer, 10)
    listener.executor.add_node(node)
    yield node
    gc.unfreeze()


def test_a_node_in_this_process_answers_a_replay_tick_by_tick(listener, law, tmp_path):
    write_bag(tmp_path / "bag", small(20, every=1))
    with BagReader(tmp_path / "bag") as bag:
        player = in_lockstep(listener, bag)
        result = player.run()
    assert player.sent == 20
    assert result.topics["command"].times == small(20, every=1).topics["command"].times
    golden = small(20, every=1).topics["command"].data
    assert [parse(STATE, d) for d in result.topics["command"].data] == [parse(STATE, d) for d in golden]


def test_a_replay_does_not_start_with_two_publishers_of_the_answer(listener, law, tmp_path):
    other = Node("other", context=listener.context)
    other.create_publisher(message_class(STATE), "/command", 10)
    until(lambda: listener.count_publishers("/command") == 2, "second publisher")
    write_bag(tmp_path / "bag", small())
    with BagReader(tmp_path / "bag") as bag:
        player = in_lockstep(listener, bag)
        with pytest.raises(RunError, match=r"^2 publishers on /command, expected exactly one$"):
            player.run()
    assert player.sent == 0


def ask(node, service: str, kind, **fields):
    client = node.create_client(kind, service)
    until(lambda: node.turn() or client.service_is_ready(), service)
    future = client.call_async(kind.Request(**fields))
    until(lambda: node.turn() or future.done(), f"answer of {service}")
    return future.result()


def call(node, service: str) -> None:
    assert ask(node, service, Trigger).success


def test_pause_step_resume_span_remap_and_clock(rig, listener, tmp_path):
    write_bag(tmp_path / "bag", small())
    player = rig.player("bag", "--paused", "--clock", "--wait", "--start-offset", "0.05", "--duration", "0.099",
                        "--topics", "/plant/state", "--remap", "/plant/state:=/state")  # fmt: skip

    def states():
        return [m.header.stamp.nanosec // 1_000_000 for name, m in listener.received if name == "/state"]

    def clock():
        return [m.clock.nanosec for name, m in listener.received if name == "/clock"]

    call(listener, "/player/step")
    call(listener, "/player/step")
    until(lambda: listener.turn() or len(states()) == 2, "two steps")
    call(listener, "/player/pause")
    assert states() == [50, 51]
    call(listener, "/player/resume")
    status, output = finish(player)
    assert (status, output) == (0, "100 messages played\n")
    until(lambda: listener.turn() or (len(states()) == 100 and clock()[-1] == 149_000_000), "the rest")
    assert states() == list(range(50, 150))
    assert clock() == sorted(clock())
    assert {k * 1_000_000 for k in range(50, 150)} <= set(clock())

    listener.received.clear()
    player = rig.player("bag", "--loop", "--wait", "--rate", "2", "--duration", "0.004", "--regex", "plant",
                        "--remap", "/plant/state:=/state")  # fmt: skip
    until(lambda: listener.turn() or len(states()) >= 17, "three loops and more")
    assert finish(player, signal.SIGINT)[0] == 0
    first = states().index(0)  # the player is matched with the listener before the listener is with the player
    assert first < 5
    assert states()[first : first + 12] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["none"], "does not exist"),
        (["bag", "--topics", "/absent"], "no topic /absent in"),
        (["bag", "--rate", "0"], "expected a number from"),
        (["bag", "--start-offset", "5"], "only 0.199 s long"),
        (["bag", "--lockstep", "/command", "--loop"], "the node sets the pace"),
        (["bag", "--remap", "a=b"], "expected OLD:=NEW"),
        (["bag", "--regex", "("], "regular expression"),
        (["bag", "--exclude", "."], "none of the topics"),
    ],
)
def test_bad_arguments_of_play(tmp_path, monkeypatch, capsys, arguments, text):
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / "bag", small())
    assert main_play(arguments) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", ["/a b", "//x", "/x/", "/1x", "/~/y", ""])
def test_names_that_ros_does_not_have_are_not_played(tmp_path, capsys, name):
    writer = BagWriter(tmp_path / "odd")
    writer.write(writer.add_topic(BagTopic(name, "std_msgs/msg/Header")), 5, bytes(16))
    writer.close()
    assert main_play([str(tmp_path / "odd")]) == 2
    assert "not played, invalid names in ROS; rename them by --remap" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("main", "arguments", "text"),
    [
        (main_record, ["--output", "bag"], "exists already"),
        (main_record, ["--output", "new", "--regex", "["], "regular expression"),
        (main_record, ["--output", "new", "--ros-args", "--unknown"], "unknown ROS arguments ['--unknown']"),
        (main_record, ["--output", "new", "--ros-args", "-r", "__ns:=a"], "expected __ns:=/NAMESPACE"),
        (main_record, ["--output", "new", "--ros-args", "-r", "__ns:=/a/"], "no slash at the end"),
        (main_record, ["--output", "new", "__ns:=/a"], "'__ns:=/a' is not the name of a topic"),
        (main_record, ["--output", "new", "--max-size", "-1"], "--max-size: expected a number from 0 to 1e+09"),
        (main_record, ["--outptu", "new"], "unexpected option '--outptu' (did you mean '--output'?)"),
        (main_record, ["--output", "new", "--storage", "sqlite3", "--compression", "zstd"], "mcap only"),
        (main_compare, ["bag", "none"], "does not exist"),
        (main_compare, ["bag", "bag", "--field", "x"], "expected PATTERN=ABS"),
        *((main_compare, ["bag", "bag", "--field", f"*={x}"], "finite") for x in ("inf", "nan", "-1", "1_0", "1,inf")),
        (main_compare, ["bag", "bag", "--topics", "x"], "no topic x to compare"),
        (main_bag, ["repair", "bag/metadata.yaml"], "no .mcap"),
        (main_bag, ["info", "."], "not a bag"),
    ],
)
def test_bad_arguments_of_the_others(tmp_path, monkeypatch, capsys, main, arguments, text):
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / "bag", small())
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]


def test_compare_and_bag_on_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_bag(tmp_path / "a", small())
    other = small()
    layout = Layout(STATE, "", ["a"], {"effort": 1})
    other.topics["command"].data[3] = layout.encode(12_000_000, (12.1,))
    write_bag(tmp_path / "b", other)
    assert main_compare(["a", "b"]) == 1
    assert "first difference: t = 0.012 s, command a/effort: 12.0 against 12.1" in capsys.readouterr().out
    assert main_compare(["a", "b", "--field", "*/effort=0.2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["equal"] is True
    assert main_compare(["a", "b", "--topics", "/plant/state", "--bitwise"]) == 0
    assert main_bag(["export", "a", "--out", "tables"]) == 0
    assert "tables/plant.state.csv" in capsys.readouterr().out
    assert main_bag(["export", "a"]) == 0
    assert "a_csv/plant.state.csv" in capsys.readouterr().out
    (tmp_path / "a/metadata.yaml").unlink()
    assert main_bag(["repair", "a", "--out", "whole"]) == 0
    assert "450 messages in" in capsys.readouterr().out
    assert main_compare(["whole", "b", "--abs", "0.2"]) == 0


@pytest.mark.long
def test_their_options_are_parameters_that_can_be_read_but_not_set(rig, listener, tmp_path):
    write_bag(tmp_path / "bag", small())
    # A parameter file (`ros2 param dump`) has the same values as the options.
    player = rig.player("bag", "--paused", "--rate", "2.5", "--ros-args", "-p", "rate:=2.5", "-p", "paused:=true")
    recorder = rig.recorder("--output", "copy", "--max-size", "8", "/none")
    names = ask(listener, "/player/list_parameters", ListParameters).result.names
    assert {"bag", "rate", "paused", "use_sim_time"} <= set(names)
    (rate,) = ask(listener, "/player/get_parameters", GetParameters, names=["rate"]).values
    assert rate.double_value == 2.5
    (reported,) = ask(listener, "/player/describe_parameters", DescribeParameters, names=["rate"]).descriptors
    assert reported.description == "bag seconds a second"
    assert reported.read_only
    assert (reported.floating_point_range[0].from_value, reported.floating_point_range[0].to_value) == (1e-6, 1e6)
    (size,) = ask(listener, "/recorder/get_parameters", GetParameters, names=["max_size"]).values
    assert size.double_value == 8.0
    wanted = Parameter(name="rate", value=ParameterValue(type=3, double_value=1.0))
    (answer,) = ask(listener, "/player/set_parameters", SetParameters, parameters=[wanted]).results
    assert not answer.successful
    for process in (player, recorder):
        finish(process, signal.SIGINT)
    status, output = finish(rig.player("bag", "--ros-args", "-p", "rate:=2.0"))
    assert status == 2
    assert "parameter rate cannot be set to 2.0 by ROS arguments" in output


@pytest.mark.parametrize("tool", few(["recorder", "player"], 1))
def test_two_interrupts_in_a_row_end_without_a_traceback(rig, tmp_path, tool):
    write_bag(tmp_path / "bag", small())
    arguments = {"recorder": ["--output", "copy"], "player": ["bag", "--paused"]}[tool]
    process = rig.start([str(find_executable("softrig_bags", tool)), *arguments])
    if tool == "recorder":
        until(lambda: (tmp_path / "copy").is_dir(), "its bag")
    process.send_signal(signal.SIGINT)
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    status, output = finish(process)
    assert "Traceback" not in output
    # A negative status: the signal arrived before Python had installed its handler.
    assert status in (0, 130, -signal.SIGINT)


@pytest.mark.long
def test_a_late_recording_ends_with_a_status(rig, tmp_path):
    late = Recording([("/clock", CLOCK)])
    for k in range(22, 60):
        late.add(0, k * 10_000_000, Layout(CLOCK).encode(k * 10_000_000, ()))
    write_bag(tmp_path / "source", late)
    recorder = rig.recorder("--output", "copy")
    until((tmp_path / "copy").exists)
    assert finish(rig.player("source", "--wait"))[0] == 0
    status, reported = finish(recorder, signal.SIGINT)
    assert status == 1
    assert "JOINED LATE, MISSED 22: /clock: 22" in reported
    with BagReader(tmp_path / "copy") as bag:
        assert bag.custom_data["missed"] == "/clock: 22"


@pytest.mark.long
def test_a_tool_marks_its_ports_as_alive(rig):
    """Otherwise Fast DDS would look at the port's reader after 20 s, and a process that opens the port waits
    for that.
    """
    recorder = rig.recorder("--output", "copy")
    for port in until(lambda: len(result := ears(recorder)) == 2 and result):
        began, before = time.monotonic(), port.read_bytes()
        place = judged(before, port)
        assert place > 0
        until(lambda port=port, place=place, before=before: port.read_bytes()[place:][:8] != before[place:][:8])
        assert time.monotonic() - began < 15.0
