"""How a node begins and ends, with a middleware that the test steps: missing nodes, the time of t = 0,
acknowledgements, status.
"""

import json
import re
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from by_hand import Hand, Kept
from faultrig import COMMAND, REFERENCE, STATE, Burst, Gain, Lag, Spread, Watcher
from softrig_core import RunError, joint_state
from softrig_core.block.block import Level
from softrig_core.rig.options import InputLink, Links, RunOptions
from softrig_core.wire.cdr import parse
from softrig_core.wire.recording import ShardWriter
from softrig_nodes import container as containers
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.adapter.departure import READY, START, Departure
from softrig_nodes.adapter.files import read_files
from softrig_nodes.adapter.handshake import Handshake
from softrig_nodes.adapter.record import CLOCK_LAYOUT
from softrig_nodes.adapter.spin import conclude, failure
from softrig_nodes.container import Container, split
from softrig_nodes.group import Group
from softrig_nodes.lockstep import comeback as comebacks, turns as turns_module
from softrig_nodes.lockstep.comeback import Comeback, LastPublished
from softrig_nodes.lockstep.turns import Turns
from softrig_nodes.ros.arguments import non_ros_arguments
from softrig_nodes.seam.endpoint import Input, Output
from softrig_nodes.seam.exchange import Exchange
from softrig_nodes.seam.tick import TICK, TickReader, TickWriter

MS, SECOND = 1_000_000, 1_000_000_000
NOW = 1_700_000_000 * SECOND
JOINT = "sensor_msgs/msg/JointState"


def state(name):
    return joint_state(name, name, ["q"], position="m")


# ---- what a node is started with ----


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-r", "__ns:=~/x"], "rule: '-r __ns:=~/x': expected __ns:=/NAMESPACE, which begins with a slash"),
        (["-r", "__node:=3law"], "rule: '-r __node:=3law': expected FROM:=TO or __node:=NAME, "),
        (["-r", "x:=a//b"], "rule: '-r x:=a//b': expected FROM:=TO"),
        (["-p", "x := 1.0"], "rule: '-p x := 1.0': expected NAME:=VALUE without spaces"),
        (["-p", "x:=[1, 2.5]"], "rule: '-p x:=[1, 2.5]'. Error: Sequence should be of same type."),
        (["-p", "x:=\udcff"], "argument 'x:=\\udcff': expected text in UTF-8"),
        (["--params-file", "/nowhere.yaml"], "'--params-file /nowhere.yaml'. Error: Error opening YAML file"),
        (["--frob"], "unknown ROS arguments ['--frob']: expected -p NAME:=VALUE, "),
    ],
)
def test_an_argument_that_rcl_refuses_is_one_line_with_the_expected_form(arguments, text, capfd):
    with pytest.raises(ValueError, match=re.escape(text)) as error:
        non_ros_arguments(["node", "--ros-args", *arguments])
    assert not re.search(r"\n|\.c:|lexeme|not set", str(error.value))
    assert capfd.readouterr() == ("", "")  # rcl itself would log some of these errors


def test_arguments_of_others_are_those_outside_of_rclpys():
    assert non_ros_arguments(["node", "a", "--ros-args", "-p", "x:=1", "--", "b"]) == ["a", "b"]


# ---- nodes that are not discovered yet ----


class Meeting:
    """A node that reads `x` of "sender" and publishes `y`, which `readers` subscribe to."""

    def __init__(self, readers=("law",), local=(), rig=True, plant=False, **links):
        self.hand = Hand("node")
        self.x, self.y = Input(state("x")), Output(state("y"), "/y", 0)
        node = SimpleNamespace(middleware=self.hand, links=Links(**links), namespace="/rig", is_plant=plant,
                               outgoing=SimpleNamespace(outputs=[self.y]),
                               options=SimpleNamespace(links="x" if rig else ""),
                               overheard=SimpleNamespace(absent=list),
                               of_rig=lambda name: name if name.startswith("/") else f"/rig/{name}")  # fmt: skip
        self.shake = Handshake(node, [(self.x, "sender")], [(self.y, list(readers))], set(local))

    def absent(self):
        return self.shake.absent()

    def whole(self, **readers):
        """Everything that is awaited is there."""
        self.x.matched(1)
        self.hand.readers["/y"] = readers or {"law": JOINT}
        self.y.matched(len(self.hand.readers["/y"]))
        return self


def test_a_node_begins_when_its_inputs_have_publishers_and_its_outputs_their_subscribers():
    meeting = Meeting()
    assert meeting.absent() == ["no publisher on x (expected from sender)", "law does not subscribe /y"]
    assert meeting.shake.missing == ["sender", "law"]
    meeting.hand.types = {"/x": ["std_msgs/msg/Float64"]}
    assert (
        meeting.absent()[0]
        == "no publisher on x (expected from sender; the topic exists with type std_msgs/msg/Float64)"
    )
    meeting.x.matched(1)
    meeting.hand.readers["/y"] = {"law": "other/msg/Type"}
    assert meeting.absent() == ["law does not subscribe /y"]
    assert meeting.shake.missing == ["law"]
    meeting.hand.readers["/y"] = {"law": JOINT, "tool": JOINT}
    # The graph shows a subscriber before the publisher is matched with it.
    assert meeting.absent() == ["/y has 0 of 2 subscribers"]
    meeting.y.matched(1)
    assert meeting.absent() == ["/y has 1 of 2 subscribers"]
    meeting.y.matched(2)
    assert (meeting.absent(), meeting.shake.missing, meeting.shake.lacking) == ([], [], [])
    departed = Meeting().whole()
    departed.x.matched(0)
    departed.x.received_any = True  # the publisher has sent everything and has left
    assert departed.absent() == []
    nobody = Meeting([])
    nobody.x.matched(1)
    nobody.hand.readers["/y"] = {"tool": JOINT}
    assert nobody.absent() == []  # no subscriber is expected
    local = Meeting(["law", "here"], local=["here"]).whole(law=JOINT, here=JOINT)
    local.y.matched(1)
    assert local.absent() == []


def test_incompatible_subscribers_are_named_if_they_are_awaited():
    meeting = Meeting().whole(law=JOINT, tool=JOINT)
    meeting.y.matched(1)
    meeting.hand.unfit = lambda topic, kind: [("tool", "reliability")] if (topic, kind) == ("/y", JOINT) else []
    assert meeting.absent() == []  # the tool is not expected
    meeting.y.matched(0)
    assert meeting.absent() == ["/y has 0 of 1 subscribers"]
    meeting.hand.unfit = lambda topic, kind: [("law", "reliability"), ("tool", "durability")]
    assert meeting.absent() == ["law can never read /y: reliability"]
    assert meeting.shake.missing == ["law"]


def test_any_external_node_counts_as_a_subscriber_of_its_topics():
    meeting = Meeting([], outside=["cmd", "/abs"])
    messages = ["no publisher on x (expected from sender)"]
    messages += [f"no publisher on {name} (expected from an external node)" for name in ("cmd", "/abs")]
    assert meeting.absent()[:3] == messages
    assert meeting.shake.lacking == ["cmd", "/abs"]
    meeting.whole(law=JOINT)
    meeting.hand.writers = {"/rig/cmd": ["guest", "second"], "/abs": ["other"]}
    meeting.hand.reads = {"guest": ["/y", "/z"], "other": ["/z"]}
    meeting.hand.readers["/y"] = {}
    meeting.y.matched(0)
    assert meeting.absent() == ["guest does not subscribe /y"]
    assert meeting.shake.lacking == []
    meeting.hand.readers["/y"] = {"guest": JOINT}
    assert meeting.absent() == ["/y has 0 of 1 subscribers"]
    meeting.y.matched(1)
    styles = 0
    while meeting.absent() == ["outside nodes are still announcing themselves"]:
        styles += 1
    assert (styles, meeting.absent()) == (
        25,
        [],
    )  # checked every 20 ms; complete if nothing has changed for 0.5 s
    unmatched = Meeting([], outside=["/x"])
    unmatched.hand.writers = {"/x": ["guest"]}
    assert unmatched.absent() == ["no publisher on x (expected from sender)"]
    assert unmatched.shake.lacking == ["/x"]  # the publisher is discovered but not matched yet


def test_for_a_node_started_alone_the_visible_endpoints_count_when_they_have_not_changed_for_a_while():
    meeting = Meeting([], rig=False).whole()
    meeting.hand.writers["/_softrig/recorder"] = ["bag"]
    assert meeting.absent() == ["bag does not subscribe /y"]
    meeting.whole(bag=JOINT)
    assert {*(tuple(meeting.absent()) for _ in range(20))} == {("outside nodes are still announcing themselves",)}
    meeting.y.matched(2)  # another subscriber joins
    assert {*(tuple(meeting.absent()) for _ in range(25))} == {("outside nodes are still announcing themselves",)}
    assert meeting.absent() == []
    for plant in (True, False):
        lonely = Meeting([], rig=False, plant=plant)
        lonely.x.matched(1)
        for _ in range(25):
            assert lonely.absent() == ["no node subscribes to /y"]
        # Only a plant can run without a subscriber.
        assert lonely.absent() == ([] if plant else ["no node subscribes to /y"])
    public = Meeting([], public=True, recorders=["bag"])
    public.x.matched(1)
    assert public.absent() == ["bag does not subscribe /y"]
    public.whole(bag=JOINT)
    assert public.absent() == ["outside nodes are still announcing themselves"]


# ---- when t = 0 is ----


class Leaves:
    """A node of a rig of three that waits for its common start."""

    def __init__(self, starter="node", local=(), limit=30.0, grid="0.01"):
        self.hand, self.begun, self.words, self.failures = Hand("node", NOW), [], [], []
        links = Links(starter=starter, starts=["node", "law", "source"], grid=grid)
        self.node = SimpleNamespace(
            middleware=self.hand,
            links=links,
            paces=[],
            options=SimpleNamespace(start_timeout=limit),
            fail=self.failures.append,
            account=SimpleNamespace(refuse=lambda item, text: self.failures.append(text)),
        )
        self.shake = SimpleNamespace(absent=lambda: [*self.absent_nodes], absent_nodes=[])
        self.absent_nodes = self.shake.absent_nodes
        self.departure = Departure(
            self.node,
            self.shake,
            set(local),
            lambda *message: self.begun.append(message),
            lambda message: self.words.append(message),
        )
        (self.timer,) = self.hand.timers

    def look(self, times=1, each=20 * MS):
        for _ in range(times):
            self.hand.time += each
            self.timer.call()
        return self.departure.absent


def test_the_starter_waits_until_all_are_ready_and_matched_and_announces_the_time():
    one = Leaves()
    ready, text = one.hand.callbacks[READY], one.hand.published[START]
    assert one.timer.asked == [(20 * MS, 0)]
    one.hand.readers[f"/{START}"] = {"law": TICK}
    one.absent_nodes.append("nobody on x")
    assert one.look() == [
        "nobody on x",
        "law is not ready",
        "source is not ready",
        f"source has not subscribed to {START} yet",
    ]
    one.absent_nodes.clear()
    ready(TickWriter()(0, ["law"]))
    one.hand.matched[START](1)
    assert one.look() == ["source is not ready", f"source has not subscribed to {START} yet"]
    ready(TickWriter()(0, ["source"]))
    one.hand.readers[f"/{START}"] = {"law": TICK, "source": TICK}
    assert one.look() == [f"one of 3 nodes has not subscribed to {START} yet"]
    assert not text
    one.hand.matched[START](2)
    assert one.look() == []
    now = one.hand.time
    ((epoch, ahead),) = one.begun
    assert (epoch % (10 * MS), ahead) == (0, 0)
    assert now + 500 * MS < epoch <= now + 510 * MS  # half a second from now, rounded up to the grid
    assert TickReader()(text[0]) == (epoch, frozenset([str(now)]))
    assert one.timer.now is None
    one.hand.time += SECOND
    ready(TickWriter()(0, ["law"]))  # a node that asks again gets the answer with the present time
    assert TickReader()(text[1]) == (epoch, frozenset([str(now + SECOND)]))
    one.departure.announce(["ahead=0", "from=5"])
    assert TickReader()(text[2]) == (epoch, frozenset([str(now + SECOND), "ahead=0", "from=5"]))
    ready(b"\0\1\0\0")
    assert one.failures == ["std_msgs/msg/Header: 4 bytes end inside a field at byte 4"]
    assert not one.words


def test_neighbours_in_its_process_are_informed_in_memory():
    one, two = Leaves(local=["law"]), Leaves("other")
    one.departure.neighbours = two.departure.neighbours = [one.departure, two.departure]
    for name in ("law", "source"):
        one.hand.callbacks[READY](TickWriter()(0, [name]))
    assert one.look() == [f"law, source has not subscribed to {START} yet"]
    one.hand.matched[START](1)  # counts nodes of other processes only
    one.look()
    (call,) = one.hand.posted  # the other node of this process, which does not start the run, is informed by a call
    call()
    assert [epoch for epoch, _ in two.begun] == [one.begun[0][0]]


@pytest.mark.parametrize(("off", "ahead"), [(0, 0), (SECOND // 2, 0), (SECOND // 2 + 1, 1), (-SECOND, 1)])
def test_the_others_report_that_they_are_ready_and_follow_a_clock_that_is_half_a_second_off(off, ahead):
    one = Leaves("law")
    hear, text = one.hand.callbacks[START], one.hand.published[READY]
    one.absent_nodes.append("nobody on x")
    one.look(10)
    assert not text
    one.absent_nodes.clear()
    one.look(13)
    # The request is repeated at each fifth check: 15 and 20.
    assert [TickReader()(data) for data in text] == [(0, frozenset(["node"]))] * 2
    hear(TickWriter()(0, []))
    hear(b"")
    assert not one.begun
    epoch = NOW + 3 * SECOND
    hear(TickWriter()(epoch, [str(one.hand.time + off), "ahead=0"]))
    assert one.begun == [(epoch, ahead * off)]
    assert one.timer.now is None
    assert one.words == [frozenset([str(one.hand.time + off), "ahead=0"])]
    hear(TickWriter()(epoch, ["until=5"]))
    assert (len(one.begun), one.words[1]) == (1, frozenset(["until=5"]))
    other = Leaves("law")
    other.hand.callbacks[START](TickWriter()(epoch, ["x"]))  # this start message has no clock time
    assert other.begun == [(epoch, 0)]


def test_a_start_that_does_not_arrive_ends_the_run_with_a_reason():
    for limit, seconds in ((30.0, 30.0), (0.0, 1e6)):
        one = Leaves("law", limit=limit)
        one.look(1, round(seconds * 1e9))
        assert not one.failures
        one.look(1, MS)
        assert one.failures == (["not all peers after 30 s: law has not published the start time"] if limit else [])
    one.failures.clear()
    one = Leaves(limit=30.0)
    one.absent_nodes.append("nobody on x")
    one.look(1, 31 * SECOND)
    assert one.failures[0].startswith("not all peers after 30 s: nobody on x; law is not ready; source is not ready; ")
    assert one.timer.now is None


# ---- reports of a node about its ticks ----


def law_links(**more):
    inputs = {
        "state": InputLink(period="0.01", node="plant", port="state"),
        "reference": InputLink(period="0.01", node="source", port="reference", at_end=False),
    }
    return {"base": "0.01", "inputs": inputs, "readers": {"command": ["plant"]}} | more


def node(block, links, sink=True, name="node", **options):
    """A lockstep node over a middleware that the test steps, with all awaited nodes."""
    hand, kept = Hand(name), Kept()
    block.reset(0)
    text = "" if links is None else Links(**links).model_dump_json()
    adapter = Adapter(hand, block, RunOptions(mode="lockstep", links=text, **options), kept if sink else None)
    return hand, kept, adapter


def begun(adapter, hand, readers):
    """Make all nodes present; the node begins at its next check."""
    group = Group([adapter])
    for item in [*adapter.inputs, *adapter.paces]:
        hand.matched[item.port.topic](1)
    for topic, names in readers.items():
        ends = *adapter.outgoing.outputs, adapter.outgoing.clock_output, adapter.outgoing.tick_output
        output = next(o for o in ends if o.topic == hand.resolve(topic))
        hand.readers[hand.resolve(topic)] = dict.fromkeys(names, output.port.msgtype)
        output.matched(len(names))
    next(t for t in hand.timers if t.call.__name__ == "_start").call()
    return group


def test_a_lockstep_controller_answers_each_tick_when_its_inputs_are_there_and_leaves_after_the_last():
    hand, kept, adapter = node(Gain(), law_links(), duration=0.03)
    left = []
    adapter.on_finished = lambda: left.append(adapter.t)
    begun(adapter, hand, {"lag/command": ["plant"]})
    assert (adapter.state, adapter.drive.busy(), adapter.drive.counts()) == ("running", False, {})
    x, r = (STATE.layout(), REFERENCE.layout())
    for k in range(3):
        assert (adapter.ticks, adapter.t) == (k, 10 * k * MS)
        hand.callbacks["lag/state"](x.encode(10 * k * MS, (1.0, 0.0)))
        hand.callbacks["lag/reference"](r.encode(10 * k * MS, (4.0 + k,)))
    u = COMMAND.layout()
    assert hand.published["lag/command"] == [u.encode(10 * k * MS, (6.0 + 2 * k,)) for k in range(3)]
    assert kept.published == [(0, 10 * k * MS, u.encode(10 * k * MS, (6.0 + 2 * k,))) for k in range(3)]
    assert (adapter.state, left) == ("done", [30 * MS])
    assert "tick_p50_ms" not in adapter.drive.statistics()  # only a plant has this statistic


def test_a_node_that_cannot_begin_reports_after_five_seconds_what_is_missing():
    hand, _, adapter = node(Gain(), law_links())
    Group([adapter])
    start = next(t for t in hand.timers if t.call.__name__ == "_start")
    assert start.asked == [(20 * MS, 0)]
    for k in range(300):
        start.call()
        assert len(hand.logs) == (k >= 249)
    assert hand.logs[0].startswith("WARN cannot begin yet: no publisher on lag/state (expected from plant); no ")
    assert adapter.absent[0] == "no publisher on lag/state (expected from plant)"
    assert adapter.state == "starting"


def test_a_plant_publishes_its_ticks_on_the_clock_and_knows_its_followers():
    links = {
        "base": "0.01",
        "owns_clock": True,
        "clock_readers": ["source"],
        "acks": {"watcher": "0.01"},
        "inputs": {"command": InputLink(period="0.01", node="law", port="command", at_end=False)},
        "readers": {"state": ["law"], "applied": []},
        "starts": ["node", "law", "source", "watcher"],
    }
    hand, kept, adapter = node(Lag(), links, duration=0.02)
    begun(adapter, hand, {"lag/state": ["law"], "/clock": ["source"]})
    command = hand.callbacks["lag/command"]
    for k in range(2):
        assert adapter.ticks == k
        command(COMMAND.layout().encode(10 * k * MS, (1.0,)))
        assert adapter.ticks == k
        hand.callbacks["/watcher/tick"](TickWriter()(10 * k * MS, []))
    hand.callbacks["/watcher/tick"](TickWriter()(20 * MS, []))
    assert [parse("rosgraph_msgs/msg/Clock", data).stamp for data in hand.published["/clock"]] == [0, 10 * MS, 20 * MS]
    assert [parse(JOINT, data).fields["position"] for data in hand.published["lag/state"]] == [
        (0.0,),
        (0.01,),
        (0.0199,),
    ]
    assert [number for number, _, _ in kept.published] == [0, 1, 4] * 3
    assert adapter.record.topics == [
        ("lag/state", JOINT),
        ("lag/applied", JOINT),
        ("lag/offset", "std_msgs/msg/Float64"),
        ("lag/kick", "std_msgs/msg/Bool"),
        ("/clock", "rosgraph_msgs/msg/Clock"),
    ]
    assert (adapter.record.foreign, adapter.record.clock) == ({"offset": 2, "kick": 3}, 4)
    assert adapter.state == "done"
    figures = adapter.drive.statistics()
    assert figures["running_s"] >= 0.0
    assert figures["tick_max_ms"] >= figures["tick_p50_ms"] >= 0.0
    status = adapter.account.status()
    assert (status["state"], status["t"], status["ticks"]) == ("done", 20 * MS, 2)


def test_two_publishers_of_a_paired_input_end_the_run():
    hand, _, adapter = node(Gain(), law_links())
    begun(adapter, hand, {"lag/command": ["plant"]})
    hand.writers["/lag/state"] = ["a", "b"]
    hand.matched["lag/state"](2)
    assert adapter.state == "failed"
    next(t for t in hand.timers if t.call.__name__ == "watch").call()
    assert str(adapter.error) == "2 publishers on lag/state (/a, /b), expected exactly one"
    hand, _, adapter = node(Gain(), law_links(returns=True))
    begun(adapter, hand, {"lag/command": ["plant"]})
    hand.matched["lag/state"](2)  # one of the two publishers has died
    assert adapter.state == "running"


def test_a_sporadic_node_announces_its_messages_with_its_acknowledgement():
    links = {
        "base": "0.01",
        "clock": InputLink(period="0.01", node="plant"),
        "acknowledges": True,
        "tick_readers": ["law"],
        "readers": {"burst": ["law"]},
    }
    hand, kept, adapter = node(Burst(at=(0.01,)), links, duration=0.03)
    begun(adapter, hand, {"lag/burst": ["law"], "~/tick": ["law"]})
    clock = hand.callbacks["/clock"]
    for k in range(3):
        clock(CLOCK_LAYOUT.encode(10 * k * MS, ()))
    messages = [TickReader()(data) for data in hand.published["~/tick"]]
    assert messages == [(0, frozenset()), (10 * MS, frozenset(["burst"])), (20 * MS, frozenset())]
    assert [t for _, t, _ in kept.published] == [10 * MS]


def test_arrays_are_numbered_and_a_shard_holds_them_as_rows(tmp_path):
    links = {"base": "0.01", "inputs": {"state": InputLink(period="0.01", node="plant", port="state")}}
    hand, _, adapter = node(
        Spread(), links, sink=False, duration=0.03, shard=str(tmp_path / "a.shard"), status=str(tmp_path / "a.status")
    )
    (output,) = adapter.outgoing.outputs
    begun(adapter, hand, {})
    for k in range(3):
        hand.callbacks["lag/state"](STATE.layout().encode(10 * k * MS, (1.0, 2.0)))
    numbers = [parse(output.port.msgtype, data).number for data in hand.published[output.port.topic]]
    assert (numbers, adapter.step.counts[output.name]) == ([0, 1, 2], 3)
    assert conclude(adapter, stopped=False) == 0
    assert json.loads((tmp_path / "a.status").read_text())["state"] == "done"
    adapter.outgoing.keep(np.arange(2), np.zeros((2, 0)))
    assert adapter.step.counts[output.name] == 5


def test_a_topic_of_another_type_is_reported_once_and_a_watch_writes_the_status(tmp_path):
    hand, _, adapter = node(Gain(), law_links(), status=str(tmp_path / "a.status"))
    Group([adapter])
    watch = next(t for t in hand.timers if t.call.__name__ == "watch")
    assert watch.asked == [(250 * MS, 0)]
    watch.call()
    assert json.loads((tmp_path / "a.status").read_text())["state"] == "starting"
    hand.types = {"/lag/state": ["std_msgs/msg/Float64"], "/lag/reference": [REFERENCE.msgtype]}
    for k in range(1, 9):
        watch.call()
        assert len(hand.logs) == (k >= 4)  # the node checks at every fourth call
    text = f"lag/state exists with type std_msgs/msg/Float64, expected {JOINT}"
    assert hand.logs == [f"ERROR {text}"]
    assert adapter.account.status()["reports"] == {"type of lag/state": [2, text, 1]}
    hand.deaf = lambda: "hears nobody"
    for _ in range(4):
        watch.call()
    assert str(adapter.error) == "hears nobody"
    adapter.step.note(Level.WARN, "late", "it is late")
    watch.call()
    watch.call()
    assert hand.logs[1:] == ["WARN it is late"]


def test_a_missing_external_node_is_named_once_with_what_its_vendor_needs(tmp_path):
    """In a launch no other process reports it; in `softrig run` the class `Guests` does."""
    hand, _, adapter = node(Gain(), law_links())
    Group([adapter])
    watch = next(t for t in hand.timers if t.call.__name__ == "watch").call
    adapter.lacking = ["lag/command"]
    for seconds in (0.0, 9.0, 2.0, 20.0):
        hand.time += int(seconds * 1e9)
        for _ in range(4):
            watch()
        assert len(hand.logs) == (hand.time > 10**10)
    (text,) = hand.logs
    assert text.startswith("WARN waits for the external node of lag/command: not seen for 10 s; where it runs on Cy")
    assert "export CYCLONEDDS_URI='<CycloneDDS>" in text


@pytest.mark.parametrize(("every", "written"), [(1, [1, 2, 3, 4, 5, 6, 7, 8]), (4, [4, 8])])
def test_a_status_is_written_at_each_check_and_in_real_time_at_each_fourth(every, written, tmp_path):
    hand, _, adapter = node(Gain(), law_links(), status=str(tmp_path / "a.status"))
    Group([adapter])
    watch = next(t for t in hand.timers if t.call.__name__ == "watch")
    adapter.state, adapter.drive.status_every = "running", every
    adapter.drive.progress = lambda: None
    times = []
    adapter.account.write_status = lambda: times.append(adapter.account.watches)
    for _ in range(8):
        watch.call()
    assert times == written
    adapter.state = "done"
    watch.call()
    assert times[-1] == 9


def test_a_restarted_node_announces_every_quarter_of_a_second_that_it_lives(monkeypatch):
    clock, written = SimpleNamespace(now=5.0), []
    monkeypatch.setattr(comebacks, "time", SimpleNamespace(monotonic=lambda: clock.now))
    back = object.__new__(Comeback)
    back._reported_at, back._paired, back._free = 5.0, {}, []
    account = SimpleNamespace(write_status=lambda: written.append(clock.now))
    back._node = SimpleNamespace(account=account, block=None)
    back._drive = SimpleNamespace(senders=SimpleNamespace(rows=[]), solving=None)
    for k in range(1, 11):
        clock.now = 5.0 + 0.1 * k
        assert not back.lacks(0)
    assert written == pytest.approx([5.3, 5.6, 5.9])


def test_an_observer_that_is_done_publishes_its_figures():
    hand, _, adapter = node(Watcher(), law_links(), duration=0.03)
    begun(adapter, hand, {})
    assert "figures" not in adapter.account.status()
    adapter.step.x = 7
    adapter.finish()
    assert adapter.account.status()["figures"] == {"seen": (7.0, "")}
    adapter.step.x = 8
    assert adapter.account.status()["figures"] == {"seen": (7.0, "")}  # the figures were computed once and are cached


def test_a_restarted_node_repeats_its_last_messages():
    sent = []
    outputs = [SimpleNamespace(send=lambda *text, k=k: sent.append((k, *text))) for k in range(2)]
    fake = SimpleNamespace(
        outputs=outputs[:1], clock_output=outputs[1], acknowledge=lambda *text: sent.append(("ack", *text))
    )
    published = LastPublished(SimpleNamespace(outgoing=fake, links=SimpleNamespace(owns_clock=True)))
    for t in range(3):
        outputs[0].send(t, (1.0,))
    outputs[1].send(2, ())
    fake.acknowledge(2, ())
    before = len(sent)
    published.again()
    assert sent[before:] == [(0, 1, (1.0,)), (0, 2, (1.0,)), (1, 2, ()), ("ack", 2, ())]
    published.silent = True
    before = len(sent)
    outputs[0].send(3, (1.0,))
    assert len(sent) == before
    published.again()
    assert sent[before : before + 2] == [(0, 2, (1.0,)), (0, 3, (1.0,))]


def test_the_files_of_a_run_show_the_progress_of_its_nodes(tmp_path):
    for name, status in (("a", {"t": 5, "state": "running"}), ("b", {"t": 9, "state": "done"}), ("c", None)):
        if status:
            (tmp_path / f"{name}.status").write_text(json.dumps(status))
    for name, topic in (("a.shard", "x"), ("me.shard.died", "mine"), ("b.shard", "y")):
        writer = ShardWriter(tmp_path / name, [(topic, "std_msgs/msg/Float64")])
        writer.add(0, 3, topic.encode())
        writer.close()
    files = read_files(tmp_path, "me", ["a", "b", "c"])
    assert files.answered == {"a": 5.0, "b": float("inf"), "c": 0.0}
    assert files.ended == frozenset("b")
    assert {n: t.data for n, t in files.recording.topics.items()} == {"x": [b"x"], "y": [b"y"]}
    assert {n: t.data for n, t in files.local.topics.items()} == {"mine": [b"mine"]}


def test_ticks_of_a_process_delay_a_timer_by_at_most_five_ms_and_stop_at_a_missing_one(monkeypatch):
    clock = SimpleNamespace(now=0)

    def monotonic_ns():
        clock.now += MS
        return clock.now

    monkeypatch.setattr(turns_module, "time", SimpleNamespace(monotonic_ns=monotonic_ns))
    hand, used = Hand(), []

    def ticks():
        for k in range(20):
            used.append(k)
            yield None if k == 15 else k

    node = SimpleNamespace(state="running", middleware=hand)
    turns = Turns([node])
    turns.ticks = ticks()
    turns.turn()
    assert (len(used), hand.posted) == (7, [turns.turn])  # the first of these ticks sets the time limit
    hand.posted.pop()()
    assert (len(used), hand.posted) == (14, [turns.turn])
    hand.posted.pop()()
    assert (used[-1], hand.posted) == (15, [])
    for state, more in (("starting", 0), ("failed", 0), ("done", 4)):
        before, node.state = len(used), state
        turns.turn()
        assert len(used) == before + more


def test_a_block_that_fails_ends_the_run_in_the_name_of_its_node():
    broken = []

    def ticks():
        yield 0
        error = RunError("law: failed")
        error.node = "law"
        raise error

    nodes = [
        SimpleNamespace(state="running", step=SimpleNamespace(name=n), broke=broken.append) for n in ("plant", "law")
    ]
    nodes[0].broke = None
    turns = Turns(nodes)
    turns.ticks = ticks()
    turns.turn()
    assert [str(e) for e in broken] == ["law: failed"]


# ---- the end of a process ----


def ended(state, error=None, absent=(), shard=None, broken=False):
    def write():
        written.append(fake.state)
        if broken:
            raise OSError("disk full")

    written = []
    fake = SimpleNamespace(state=state, error=error, absent=[*absent])
    fake.record, fake.account = SimpleNamespace(shard=shard), SimpleNamespace(write_status=write)
    fake.middleware, fake.t = SimpleNamespace(name="node"), 1_500_000_000
    return fake, written


@pytest.mark.parametrize(
    ("state", "stopped", "status", "after"),
    [
        ("done", False, 0, "done"),
        ("done", True, 0, "done"),
        ("running", True, 0, "done"),
        ("starting", True, 0, "done"),
        ("failed", True, 3, "failed"),
        ("failed", False, 3, "failed"),
    ],
)
def test_a_process_ends_with_status_3_if_its_node_has_failed(state, stopped, status, after, capsys):
    fake, written = ended(state, RunError("broken") if state == "failed" else None, ["x is late", "y too"])
    assert (conclude(fake, stopped), fake.state, written) == (status, after, [after])
    printed = capsys.readouterr().err
    waits = state == "starting" and stopped
    assert ("stopped before it could begin: x is late; y too" in printed) is waits
    assert ("broken" in printed) is (state == "failed")


def test_a_full_disk_is_a_failure(capsys):
    fake, _ = ended("done", broken=True)
    assert (conclude(fake, False), fake.state, str(fake.error)) == (3, "failed", "disk full")

    def close():
        raise OSError("shard")

    fake, written = ended("done", shard=SimpleNamespace(close=close))
    assert (conclude(fake, False), written, str(fake.error)) == (3, ["failed"], "shard")
    fake, _ = ended("failed", RunError("first"), broken=True)
    assert (conclude(fake, False), str(fake.error)) == (3, "first")
    fake, _ = ended("running")
    own = RunError("own")
    assert failure(fake, own) is own
    assert re.fullmatch(r"failed at t = 1\.5 s: KeyError: 'x'.*", str(failure(fake, KeyError("x"))))
    assert "node" in capsys.readouterr().err


def test_a_container_command_is_split_at_each_two_dashes():
    for arguments, groups in (
        ([], []),
        (["a", "b"], [["a", "b"]]),
        (["a", "--", "b", "c", "--"], [["a"], ["b", "c"]]),
        (["--", "--", "a"], [["a"]]),
    ):
        assert split(arguments) == groups


def test_an_error_of_a_node_in_a_container_ends_the_run_in_its_name(capsys):
    container = Container()
    fake, _ = ended("running")
    other, _ = ended("running")
    other.middleware = SimpleNamespace(name="other")
    container.adapters = [other, fake]
    for adapter in container.adapters:
        adapter.drive = SimpleNamespace(settle=lambda: None)
    container.exchange = SimpleNamespace(culprit=lambda: "node")
    container._broke(ValueError("no"))
    assert (fake.state, other.state) == ("failed", "running")
    assert str(fake.error).startswith("failed at t = 1.5 s: ValueError: no")
    assert "ValueError: no" in capsys.readouterr().err
    container.exchange = Exchange()
    with pytest.raises(ValueError, match="no"):
        container._broke(ValueError("no"))
    assert container._conclude(stopped=False) == 3
    assert (other.state, str(other.error), other.waits_for) == ("failed", "stopped: node has failed", ["node"])


class Ended(Exception):
    """A process has ended with this status."""


def test_a_container_starts_the_nodes_of_its_command_line_and_reports_errors_in_it(monkeypatch, capsys):
    def leave(nodes, status):
        raise Ended(status)

    added, broken = [], []

    class Started(Container):
        def add(self, group):
            added.append(group)
            if broken:
                raise broken[0]

        def connect(self):
            added.append("connected")

        def run(self):
            return 7

    monkeypatch.setattr(containers, "leave", leave)
    monkeypatch.setattr(containers, "Container", Started)
    monkeypatch.setattr(containers, "interrupt", SimpleNamespace(install=lambda: None, early=True))
    monkeypatch.setattr(containers, "secure_streams", lambda: None)
    joined = []
    monkeypatch.setattr(containers, "joining", lambda **how: joined.append(how) or nullcontext())
    rmw = ["rmw_fastrtps_cpp"]
    ros = SimpleNamespace(init=lambda args: None, ok=lambda: True, get_rmw_implementation_identifier=lambda: rmw[0])
    monkeypatch.setattr(containers, "rclpy", ros)

    def status(*arguments):
        added.clear()
        with pytest.raises(Ended) as left:
            containers.main(arguments)
        return left.value.args[0], capsys.readouterr()

    assert status("a", "b", "--", "c", "d", "--ros-args")[0] == 7
    assert added == [["a", "b"], ["c", "d", "--ros-args"], "connected"]
    assert joined == [{"exclusive": True, "silence": 10.0}]
    code, text = status("a")
    assert (code, "a: expected PACKAGE EXECUTABLE [--ros-args ...]" in text.err.replace("\n", " ")) == (2, True)
    for arguments, expected in (((), 2), (("--ros-args",), 2), (("-h",), 0), (("a", "b", "--help"), 0)):
        code, text = status(*arguments)
        assert (code, "PACKAGE EXECUTABLE" in text.out, added) == (expected, True, [])
    broken.append(KeyboardInterrupt())
    assert status("a", "b")[0] == 0
    broken[:] = [RunError("no such thing")]
    code, text = status("a", "b")
    assert (code, "a b: no such thing" in text.err) == (2, True)
    ros.ok = lambda: False  # a signal has shut the context down meanwhile
    assert status("a", "b")[0] == 0
    ros.ok, rmw[0] = (lambda: True), "rmw_cyclonedds_cpp"
    code, text = status("a", "b")
    assert (code, "needs Fast DDS (RMW_IMPLEMENTATION=rmw_fastrtps_cpp), got rmw_cyclonedds_cpp" in text.err) == (
        2,
        True,
    )
