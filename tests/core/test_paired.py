"""Which message a lockstep tick uses, and which it waits for: against lists of messages, delivered in any order.

Rows of the table of senders by themselves, fed with bytes by hand; and when and why a run that makes no progress is
ended.
"""

import math
import random
from types import SimpleNamespace

import pytest
from by_hand import Hand
from softrig_core import Recording, Sample, array, command, joint_state
from softrig_core.block.change import Change
from softrig_core.block.port import CLOCK
from softrig_core.block.schedule import Schedule
from softrig_core.rig.options import InputLink, Links
from softrig_core.wire.cdr import Layout
from softrig_nodes.adapter.files import Files
from softrig_nodes.lockstep import comeback as comebacks, paired
from softrig_nodes.lockstep.comeback import Comeback
from softrig_nodes.lockstep.first import repeat_first
from softrig_nodes.lockstep.paired import Newest, Paired, PairedSenders
from softrig_nodes.lockstep.stalls import Stalls
from softrig_nodes.seam.endpoint import Output
from softrig_nodes.seam.numbering import numbered
from softrig_nodes.seam.tick import TICK, TickWriter

MS = 1_000_000


class Reader:
    """The part of a node that its table of senders uses."""

    def __init__(self, period="0.01", plant=False, duration=0.2, **links):
        self.middleware, self.links = Hand("reader"), Links(base="0.01", **links)
        self.schedule = Schedule(period, "0.01", duration, plant)
        self.options = SimpleNamespace(
            paired=(), timeout=10.0, start_timeout=30.0, duration=duration, links="x", patience=0.8
        )
        self.is_plant, self.state, self.ticks, self.epoch, self.namespace = plant, "running", 0, 0, ""
        self.kept, self.values, self.paces, self.files = [], {}, [], None
        self.record = SimpleNamespace(foreign={}, sink=SimpleNamespace(add=lambda *entry: self.kept.append(entry)))
        self.account = SimpleNamespace(refuse=self._refuse, write_status=lambda: None)
        self.step = SimpleNamespace(
            stamps={},
            bad=False,
            note=lambda level, key, text, anew=False: self.notes.append((level and level.name, key, text)),
        )
        self.refusals, self.failures, self.notes, self.waits_for = [], [], [], []
        self.block = None
        self.turns, self.inputs = 0, []
        self.table = PairedSenders(self, SimpleNamespace(turn=self._turn))

    def _turn(self):
        self.turns += 1

    @property
    def t(self):
        return self.schedule.time(self.ticks)

    def peer(self, link):
        return Schedule(link.period, self.schedule.clock, self.options.duration, link.at_end)

    def _refuse(self, row, text):
        self.refusals.append((row.name, text))
        row.refused, row.last_refusal = row.refused + 1, text

    def fail(self, text):
        self.failures.append(text)
        self.state = "failed"

    def finish(self):
        self.state = "done"

    def row(self, port):
        self.values[port.name] = port.safe
        self.inputs.append(self.table.row(port))
        return self.inputs[-1]


def link(period="0.01", **more):
    return InputLink(period=period, node="sender", port="out", **more)


def state(name="x"):
    return joint_state(name, f"{name}", ["q"], position="m")


def message_of(port, stamp, value):
    return port.layout().encode(stamp, (value,))


# ---- any senders in any order ----

KINDS = {  # of a publisher: period, whether it publishes at the end, may be silent, and numbers its messages
    "alike": ("0.01", True, False, False),
    "slower": ("0.03", True, False, False),
    "twice": ("0.02", False, False, False),
    "counted": ("0.01", True, False, True),
    "slow counted": ("0.03", False, False, True),
    "silent": ("0.01", True, True, False),
    "slow silent": ("0.02", True, True, False),
    "silent counted": ("0.02", False, True, True),
}


class Sender:
    """A sender as a list of its messages, and how many of them have arrived."""

    def __init__(self, name, kind, draw, bad):
        self.period, self.at_end, self.silent, self.counted = KINDS[kind]
        self.name, self.kind = name, kind
        self.port = array(name, name, {"q": 1}, "m") if self.counted else state(name)
        self.schedule = Schedule(self.period, "0.01", 0.2, self.at_end)
        self.ticks = [self.schedule.time(k) for k in range(self.schedule.count())]
        self.stamps_sent = [t for t in self.ticks if not self.silent or draw.random() < 0.5]
        self.bad = {t for t in self.stamps_sent if draw.random() < bad}
        self.acknowledged_ticks = self.received = 0  # counts of acknowledgements and of messages

    def message(self, k):
        t = self.stamps_sent[k]
        value = math.nan if t in self.bad else t / 1e9 + 1.0
        return message_of(self.port, k if self.counted else t, value)

    def left(self):
        return ["message"] * (self.received < len(self.stamps_sent)) + ["tick"] * (
            self.silent and self.acknowledged_ticks < len(self.ticks)
        )

    def deliver(self, row, what):
        if what == "message":
            self.received += 1
            row.receive(self.message(self.received - 1))
        else:
            t = self.ticks[self.acknowledged_ticks]
            self.acknowledged_ticks += 1
            row.acknowledge(t, t in self.stamps_sent)

    def is_complete(self, t):
        """Return whether everything that a tick needs has arrived."""
        want = self.schedule.awaited(t)
        known = [s for s in self.ticks if s <= want]
        messages, arrived = set(self.ticks[: self.acknowledged_ticks]), set(self.stamps_sent[: self.received])
        if not self.silent:
            return want in arrived
        both = self.counted
        return all(
            (s in arrived and (s in messages or not both)) if s in self.stamps_sent else s in messages for s in known
        )

    def used(self, t):
        """The stamp of the message that a tick uses, and whether it is bad; None before the first."""
        want = self.schedule.awaited(t)
        return max((s for s in self.stamps_sent if s <= want), default=None)


@pytest.mark.parametrize("bad", [0.0, 0.2], ids=["", "some refused"])
@pytest.mark.parametrize("period", ["0.01", "0.02"])
@pytest.mark.parametrize("seed", range(6))
def test_a_tick_uses_the_newest_message_up_to_it_and_waits_for_it(seed, period, bad):
    draw = random.Random(seed)
    senders = [Sender(f"{kind}{k}", kind, draw, bad) for k, kind in enumerate(draw.sample(sorted(KINDS), 4))]
    inputs = {s.name: link(s.period, at_end=s.at_end, sporadic=s.silent) for s in senders}
    reader = Reader(period, inputs=inputs)
    rows = {s.name: reader.row(s.port) for s in senders}
    held = {s.name: rows[s.name].port.safe for s in senders}
    usual = {s.name: None for s in senders}
    for k in range(reader.schedule.count()):
        reader.ticks = k
        t, turns = reader.t, reader.turns
        reader.table.await_tick(t)
        assert reader.table.missing == sum(not s.is_complete(t) for s in senders)
        waited = reader.table.missing > 0
        while reader.table.missing or draw.random() < 0.4:
            open_ones = [
                (s, what)
                for s in senders
                for what in s.left()
                if s.received < 3 + s.schedule.tick(t) + 2 or what == "tick"
            ]
            if not open_ones:
                break
            sender, what = draw.choice(open_ones)
            sender.deliver(rows[sender.name], what)
            assert reader.table.missing == sum(not s.is_complete(t) for s in senders)
        assert reader.table.missing == 0
        assert reader.turns - turns == waited
        spoilt = False
        for sender in senders:
            stamp = sender.used(t)
            if stamp is not None and stamp != usual[sender.name]:
                usual[sender.name] = stamp
                if stamp in sender.bad:
                    spoilt = True
                else:
                    held[sender.name] = (stamp / 1e9 + 1.0,)
                    assert rows[sender.name].stamp == reader.step.stamps[sender.name]() == stamp
            assert reader.values[sender.name] == held[sender.name], (sender.kind, t)
        assert reader.step.bad == spoilt
        reader.step.bad = False
    assert len(reader.refusals) == sum(
        min(s.received, len(s.stamps_sent)) > j for s in senders for j, b in enumerate(s.stamps_sent) if b in s.bad
    )
    assert not reader.failures


def test_only_the_needed_message_of_a_faster_sender_is_used():
    reader = Reader("0.03", inputs={"x": link("0.01")})
    row = reader.row(state())
    for stamp in (0, 10, 20):
        row.receive(message_of(row.port, stamp * MS, stamp + 0.5))
    for k, (arrived, value) in enumerate([((30,), 0.5), ((40, 50, 60), 30.5), ((70, 80, 90), 60.5)]):
        reader.ticks = k
        reader.table.await_tick(reader.t)
        assert (reader.table.missing, reader.values["x"]) == (0, (value,))
        for stamp in arrived:
            row.receive(message_of(row.port, stamp * MS, stamp + 0.5))
    assert not reader.refusals


# ---- messages that belong to no tick ----


def test_a_message_of_no_tick_or_a_repeated_one_is_refused_with_what_was_expected():
    reader = Reader(inputs={"x": link("0.02")})
    row = reader.row(state())
    reader.table.await_tick(0)
    for stamp, text in (
        (10 * MS, "stamp 0.01 s from sender, expected 0 s"),  # the publisher has no tick at this time
        (20 * MS, None),  # a message for the next tick is kept
        (20 * MS, "stamp 0.02 s from sender, expected 0 s"),
        (0, None),
        (0, "stamp 0 s from sender, expected 0 s (already there)"),
        (220 * MS, "stamp 0.22 s from sender, expected 0 s (already there)"),  # the stamp is after the end of the run
        (200 * MS, None),
        (-20 * MS, "stamp -0.02 s from sender, expected 0 s (already there)"),
    ):
        before = len(reader.refusals)
        row.receive(message_of(row.port, stamp, 1.0))
        assert [reported for _, reported in reader.refusals[before:]] == ([text] if text else []), stamp
    for state_of_it in ("done", "failed"):
        reader.state = state_of_it
        row.receive(b"")
    assert len(reader.refusals) == 5


def test_repeated_messages_for_others_and_those_after_a_refused_one_are_skipped():
    reader = Reader(inputs={"x": link()}, guests=True)
    row = reader.row(state())
    reader.table.await_tick(0)
    row.receive(message_of(row.port, 0, 1.0))
    row.receive(message_of(row.port, 0, 2.0))
    assert (reader.values["x"], reader.refusals) == ((1.0,), [])
    reader.table.await_tick(10 * MS)
    row.receive(message_of(row.port, 10 * MS, math.nan))
    assert reader.step.bad
    row.receive(message_of(row.port, 10 * MS, 3.0))  # the valid message for this tick is too late
    assert (reader.values["x"], len(reader.refusals)) == ((1.0,), 1)
    row.receive(b"\0\1\0\0")  # without a stamp the message belongs to no known tick
    assert (len(reader.refusals), row.used) == (2, 10 * MS)


def test_a_plant_waits_for_a_good_command():
    reader = Reader(plant=True, inputs={"u": link(at_end=False)})
    row = reader.row(command("u", "u", ["a"], "N"))
    reader.table.await_tick(0)
    row.receive(message_of(row.port, 0, math.inf))
    assert (reader.table.missing, reader.step.bad, reader.turns) == (1, False, 0)
    row.receive(message_of(row.port, 0, 2.0))
    assert (reader.table.missing, reader.turns, reader.values["u"]) == (0, 1, (2.0,))


@pytest.mark.parametrize("returns", [False, True])
@pytest.mark.parametrize("guests", [False, True])
def test_arrays_are_counted_one_by_one(guests, returns):
    port = array("x", "x", {"q": 1}, "m")
    for number, outcome in ((0, "repeated 0"), (1, "repeated 1"), (2, "taken"), (4, "lost")):
        reader = Reader(inputs={"x": link()}, guests=guests, returns=returns)
        row = reader.row(port)
        for k in range(2):
            reader.table.await_tick(k * 10 * MS)
            row.receive(message_of(port, k, float(k)))
        reader.table.await_tick(20 * MS)
        row.receive(message_of(port, number, 7.0))
        if outcome == "taken":
            assert (reader.values["x"], row.received) == ((7.0,), 3)
        elif outcome == "lost":
            assert reader.failures == ["x: number 4 from sender, expected 2 (2 lost)"]
        else:
            assert (reader.values["x"], row.received, reader.table.missing) == ((1.0,), 2, 1)
            silent = returns or (guests and number == 0)
            text = f"number {number} from sender, expected 2 (already there)"
            assert reader.refusals == ([] if silent else [("x", text)])
            continue
        assert not reader.refusals


def test_delayed_messages_are_counted_and_keep_the_time_at_which_they_were_measured():
    port = joint_state("x", "x", ["q"], position="m", delayed=True)
    reader = Reader(inputs={"x": link(delayed=True)})
    row = reader.row(port)
    for k, stamp in enumerate((-5, 7, 6)):
        reader.ticks = k
        reader.table.await_tick(reader.t)
        assert reader.table.missing == 1
        row.receive(message_of(port, stamp, k + 0.5))
        assert reader.values["x"] == Sample(stamp, (k + 0.5,))
        assert reader.step.stamps["x"]() == reader.t  # the tick of the message is that of the reader
    reader = Reader(inputs={"x": link(delayed=True)}, returns=True)
    row = reader.row(port)
    for k, number in enumerate((0, 0, 1, 0)):  # a repeated message has the same number
        reader.table.await_tick(10 * MS * min(k, 1))
        row.receive(numbered(number, message_of(port, 100 + k, float(k))))
    assert (reader.values["x"], reader.refusals) == (Sample(102, (2.0,)), [])


def test_a_restarted_node_ignores_messages_that_it_has_missed():
    reader = Reader(inputs={"x": link()}, returns=True)
    reader.files = lambda: None
    row = reader.row(array("x", "x", {"q": 1}, "m"))
    reader.table.await_tick(0)
    row.receive(message_of(row.port, 3, 1.0))
    assert (row.received, reader.failures, reader.table.missing) == (0, [], 1)
    plain = reader.row(state("y"))  # a node started by hand accepts any publisher
    assert plain.publisher == "another node"


def test_an_input_without_a_known_sender_uses_the_newest():
    reader = Reader(free=["free"], inputs={"free": link(), "linked": link()})
    kinds = {}
    for port in (
        joint_state("held", "held", ["q"], position="m", held=True),
        joint_state("sporadic", "sporadic", ["q"], position="m", sporadic=True),
        state("needed"),
        state("free"),
        joint_state("linked", "linked", ["q"], position="m", held=True),
        joint_state("wanted", "wanted", ["q"], position="m", held=True),
    ):
        reader.options.paired = ("wanted",)
        kinds[port.name] = type(reader.row(port)).__name__
    newest = dict.fromkeys(("held", "sporadic", "free"), "Newest")
    assert kinds == newest | dict.fromkeys(("needed", "linked", "wanted"), "Paired")
    assert [row.name for row in reader.table.rows] == ["needed", "linked", "wanted"]
    assert {row.name: row.publisher for row in reader.table.rows} == {
        "needed": "another node",
        "linked": "sender",
        "wanted": "another node",
    }
    reader.table.without({"sender"})
    assert [row.name for row in reader.table.rows] == ["needed", "wanted"]
    reader.table.rows[0].local = True
    reader.table.without(set())
    assert [row.name for row in reader.table.rows] == ["wanted"]


def test_the_newest_value_is_valid_from_the_tick_at_which_it_arrived_and_is_recorded_there():
    reader = Reader()
    reader.record.foreign = {"x": 5}
    row = reader.row(joint_state("x", "x", ["q"], position="m", held=True))
    assert isinstance(row, Newest)
    for k, stamp in ((3, 17), (4, 2)):
        reader.ticks = k
        row.receive(message_of(row.port, stamp, float(k)))
        assert (reader.values["x"], row.stamp) == ((float(k),), reader.t)
        assert reader.kept[-1] == (5, reader.t, message_of(row.port, stamp, float(k)))
    row.receive(b"")
    assert (reader.step.bad, reader.values["x"]) == (True, (4.0,))
    counted = reader.row(array("y", "y", {"q": 1}, "m", held=True))
    for number, value in ((3, 1.0), (3, 2.0), (6, 3.0)):
        counted.receive(message_of(counted.port, number, value))
    assert reader.values["y"] == (3.0,)
    assert reader.refusals[1:] == [("y", "number 3 from another node, expected 4 (already there)")]
    assert reader.notes == [("WARN", "lost y", "2 messages of another node are lost")]


def test_numbers_show_lost_and_repeated_messages_and_start_again_with_a_replayed_bag():
    reader = Reader()
    row = reader.row(array("x", "x", {"q": 1}, "m", held=True))
    for k, (reported, new, lost) in enumerate(
        [
            (5, True, 0),
            (6, True, 0),
            (6, False, 0),
            (9, True, 2),
            (3, False, 2),
            (0, True, 2),
            (0, False, 2),
            (5, True, 6),
            (-1, True, 6),
            (2, True, 6),
            (3, True, 6),
            (0, True, 6),
            (1, True, 6),
            (0, True, 6),
        ]
    ):
        assert row.in_order(reported) is new, k
        assert row.lost == lost
    assert [text.split(",")[0] for _, text in reader.refusals] == [f"number {n} from another node" for n in (6, 3, 0)]


def test_an_external_message_is_recorded_at_the_tick_that_uses_it():
    reader = Reader(inputs={"x": link()})
    reader.record.foreign = {"x": 2}
    row = reader.row(state())
    for stamps in ((0,), (10, 20), (), (30,)):  # one of two messages arrives ahead of its time
        reader.table.await_tick(reader.t)
        for stamp in stamps:
            row.receive(message_of(row.port, stamp * MS, 1.0))
        assert reader.kept[-1] == (2, reader.t, message_of(row.port, reader.t, 1.0))
        reader.ticks += 1
    assert len(reader.kept) == 4
    reader.record.sink = None
    reader.table.await_tick(reader.t)
    row.receive(message_of(row.port, reader.t, 1.0))
    assert row.used == reader.t


# ---- the clock, and acknowledgements ----


def test_a_node_that_follows_the_clock_waits_for_each_of_its_ticks_once():
    reader = Reader()
    reader.table.follow_clock(link())
    (row,) = reader.table.rows
    assert (row.port, row.publisher, reader.paces) == (CLOCK, "sender", [row])
    hear = reader.middleware.callbacks["/clock"]
    clock = Layout("rosgraph_msgs/msg/Clock").encode
    for k in range(4):
        reader.table.await_tick(k * 10 * MS)
        assert reader.table.missing == 1
        hear(clock(k * 10 * MS + 1, ()))
        assert reader.table.missing == 1
        hear(clock(k * 10 * MS, ()))
        assert (reader.table.missing, row.used, row.reached) == (0, k * 10 * MS, k * 10 * MS)
        hear(clock(k * 10 * MS, ()))  # repeated, which changes nothing
        assert reader.turns == k + 1
    hear(clock(40 * MS, ()))  # a clock message ahead of its time
    assert row.reached == 40 * MS
    hear(clock(60 * MS, ()))
    assert row.reached == 40 * MS
    reader.table.await_tick(40 * MS)
    assert (reader.table.missing, reader.table.signs_of_life) == (0, 14)
    hear(b"")
    assert not reader.step.bad
    reader.middleware.matched["/clock"](1)
    assert row.publishers == 1


def acknowledged(reader, name):
    return lambda t, sent=(): reader.middleware.callbacks[f"/{name}/tick"](TickWriter()(t, sent))


def test_acknowledgements_announce_silence_and_are_awaited_as_the_rig_says():
    """A sporadic controller that no node awaits; a plant that is awaited; a follower some ticks behind."""
    then = []
    reader = Reader(plant=True, inputs={"x": link(sporadic=True)}, acks={"second": "0.01", "follower": "0.01"},
                    followers=["follower"], owns_clock=False)  # fmt: skip
    row = reader.row(state())
    reader.table.follow_ticks({"here"}, lambda: then.append(1))
    table = reader.table
    assert [r.publisher for r in table.rows] == ["sender", "second", "follower"]
    assert [r.publisher for r in table.unpaced] == ["sender"]
    assert [type(p).__name__ for p in reader.paces] == ["Ticks", "Behind", "Ticks"]
    second, follower, sender = (acknowledged(reader, node_name) for node_name in ("second", "follower", "sender"))
    table.await_tick(0)
    assert [r.publisher for r in table.rows if not r.have] == ["sender", "second"]
    sender(0)
    assert (row.have, table.missing, len(then)) == (True, 1, 1)
    second(0)
    assert (table.missing, len(then)) == (0, 2)
    sender(10 * MS, ["other"])
    table.await_tick(10 * MS)
    assert row.have
    sender(20 * MS, ["out"])
    second(10 * MS)
    for k in range(2, 9):
        second(k * 10 * MS)
    table.await_tick(20 * MS)
    assert [r.publisher for r in table.rows if not r.have] == ["sender"]
    row.receive(message_of(row.port, 20 * MS, 4.0))
    assert reader.values["x"] == (4.0,)
    for k in range(3, 9):
        sender(k * 10 * MS)
    table.await_tick(80 * MS)  # the follower must have acknowledged all ticks up to 30 ms
    assert [r.publisher for r in table.rows if not r.have] == ["follower"]
    follower(20 * MS)
    assert table.missing == 1
    follower(30 * MS)
    assert table.missing == 0
    reader.middleware.callbacks["/second/tick"](b"")
    assert "second" not in [name for name, _ in reader.refusals]
    assert len(reader.refusals) == 1


def test_the_owner_of_the_clock_waits_for_the_messages_of_the_previous_tick():
    """So the others' ticks run beside its own; an owner alone needs no message for the first."""
    reader = Reader(acks={"law": "0.01", "slow": "0.02"}, owns_clock=True)
    reader.table.follow_ticks(set(), lambda: None)
    law, slow = (acknowledged(reader, name) for name in ("law", "slow"))
    reader.table.await_tick(0)
    wants = {row.publisher: row.want for row in reader.table.rows}
    assert wants == {"law": 0, "slow": 0}
    assert [row.earlier for row in reader.table.rows] == [False, False]
    law(0)
    slow(0)
    assert reader.table.missing == 0
    reader.table.await_tick(10 * MS)
    # The last message of the slow publisher is held.
    assert [row.publisher for row in reader.table.rows if not row.have] == ["law"]
    other = Reader(acks={"law": "0.01"})
    other.table.follow_ticks(set(), lambda: None)
    (row,) = other.table.rows
    assert (row.earlier, row.have, row.want) == (True, True, -10 * MS)
    other.table.await_tick(0)
    assert other.table.missing == 0
    other.table.await_tick(10 * MS)
    assert (row.want, other.table.missing) == (0, 1)
    acknowledged(other, "law")(0)
    assert other.table.missing == 0
    plant = Reader(plant=True, acks={"law": "0.01"})
    plant.table.follow_ticks(set(), lambda: None)
    plant.table.await_tick(0)
    assert plant.table.rows[0].want == 0  # the acknowledgement of t = 0 is needed before the next tick


def test_after_a_restart_a_row_continues_after_the_used_message_and_reads_what_was_published():
    reader = Reader(inputs={"x": link()})
    row = reader.row(state())
    row.resume(20 * MS, 20 * MS)
    reader.table.await_tick(20 * MS)
    assert reader.table.missing == 0
    row.recall(3, message_of(row.port, 40 * MS, 5.0))
    reader.table.await_tick(30 * MS)
    assert reader.table.missing == 1
    row.recall(2, message_of(row.port, 30 * MS, 4.0))
    assert (reader.table.missing, reader.values["x"], reader.turns) == (0, (4.0,), 1)
    row.resume(10 * MS, 10 * MS)  # resuming at an earlier time does not undo used messages
    assert (row.used, row.have) == (30 * MS, False)
    quiet = Reader(inputs={"x": link(sporadic=True)})
    row = quiet.row(state())
    quiet.table.await_tick(0)
    row.learn(-10 * MS)
    assert quiet.table.missing == 1
    row.learn(10 * MS)
    assert (quiet.table.missing, quiet.turns, row.reached) == (0, 1, 10 * MS)
    counted = Reader(inputs={"x": link(sporadic=True)})
    row = counted.row(array("x", "x", {"q": 1}, "m"))
    row.resume(-1, 10 * MS)
    row.count(4, [10 * MS])
    row.acknowledge(10 * MS, True)  # this acknowledgement is already known
    row.receive(message_of(row.port, 4, 6.0))
    counted.table.await_tick(10 * MS)
    assert (row.received, counted.values["x"], counted.table.missing) == (5, (6.0,), 0)


def test_a_row_stores_at_most_a_hundred_thousand_early_messages(monkeypatch):
    monkeypatch.setattr(paired, "AHEAD", 3)
    reader = Reader(inputs={"x": link()})
    row = reader.row(state())
    reader.table.await_tick(0)
    for k in range(1, 6):
        row.receive(message_of(row.port, k * 10 * MS, 1.0))
    assert sorted(row.pending) == [10 * MS, 20 * MS, 30 * MS]
    assert [text for _, text in reader.refusals] == [f"stamp 0.0{k} s from sender, expected 0 s" for k in (4, 5)]


# ---- the first message, repeated ----


def test_the_first_message_is_repeated_for_late_subscribers_while_the_node_is_at_its_first_tick():
    outputs = [Output(state(name), f"/{name}", k) for k, name in enumerate("ab")]
    sent, first = [], [True]
    for output in outputs:
        output.send = lambda mark, values, name=output.name: sent.append((name, mark, values))
    repeat_first(outputs, lambda: first[0])
    outputs[0].matched(1)
    assert not sent
    outputs[0].send(5, (1.0,))
    outputs[0].send(6, (2.0,))
    outputs[0].matched(2)
    outputs[1].matched(2)
    assert sent == [("a", 5, (1.0,)), ("a", 6, (2.0,)), ("a", 5, (1.0,))]
    first[0] = False
    outputs[0].matched(3)
    assert len(sent) == 3


# ---- a run that stalls ----


class Shake:
    def __init__(self, *absent):
        self.absent_nodes, self.missing = list(absent), ["late"]

    def absent(self):
        return self.absent_nodes


def stands(rig=None, **options):
    """A reader at tick 5 that waits for `x`, whose sender is there; at the first check nothing is wrong."""
    reader = Reader(inputs={"x": link()}, **(rig or {}))
    vars(reader.options).update(options)
    row = reader.row(state())
    row.outside = 1
    stalls = Stalls(reader.table)
    stalls.handshake = Shake()
    reader.ticks, reader.table.signs_of_life = 5, 1
    reader.table.await_tick(reader.t)
    stalls.check()
    return reader, row, stalls


def after(reader, stalls, seconds):
    reader.middleware.time += round(seconds * 1e9)
    stalls.check()
    return reader.failures[-1] if reader.failures else reader.state


def test_a_rig_that_waits_reports_for_what_once_until_it_moves():
    reader, row, stalls = stands()
    assert after(reader, stalls, 1.5) == "running"
    assert reader.notes == []
    for _ in range(3):
        after(reader, stalls, 0.1)
    waits = ("WARN", "stands", "waits for x from sender at t = 0.05 s")
    assert reader.notes == [waits]
    reader.table.signs_of_life += 1
    after(reader, stalls, 0.1)
    assert reader.notes == [waits, (None, "stands", "")]
    after(reader, stalls, 1.6)
    assert reader.notes == [waits, (None, "stands", ""), waits]
    reader, row, stalls = stands()
    row.have = True
    after(reader, stalls, 5.0)
    assert reader.notes == []
    reader, row, stalls = stands()
    reader.ticks = 1  # another node may still be starting
    after(reader, stalls, 5.0)
    assert reader.notes == []


def test_a_run_without_progress_ends_after_its_timeout_and_names_what_it_waits_for():
    reader, row, stalls = stands()
    assert after(reader, stalls, 10.0) == "running"
    assert after(reader, stalls, 0.25) == "nothing stamped t = 0.05 s within 10.2 s on x from sender"
    assert reader.waits_for == ["sender"]
    for moves in ("tick", "signs_of_life"):
        reader, row, stalls = stands()
        assert after(reader, stalls, 9.0) == "running"
        if moves == "tick":
            reader.ticks += 1
        else:
            reader.table.signs_of_life += 1
        assert after(reader, stalls, 9.0) == "running"  # the tick has advanced
        assert after(reader, stalls, 10.0) == "running"
        assert after(reader, stalls, 0.1).startswith("nothing stamped")
    reader, row, stalls = stands()
    row.have = True  # no message is missing; a user holds the rig
    assert after(reader, stalls, 100.0) == "running"
    reader, row, stalls = stands()
    row.receive(message_of(row.port, 130 * MS, 1.0))
    row.receive(message_of(row.port, 120 * MS, 1.0))
    row.receive(b"")
    reader.table.signs_of_life = 1
    assert after(reader, stalls, 11.0) == (
        "nothing stamped t = 0.05 s within 11.0 s on x from sender; last refused: sensor_msgs/msg/JointState: 0 bytes"
        " end inside a field at byte 4; it is ahead, at 0.13 s"
    )
    for guests, said_of_it in (
        (True, "; its last message was stamped 0: copy the stamp of what you answer"),
        (False, ""),
    ):
        reader, row, stalls = stands()
        reader.links.guests = guests
        row.used = 40 * MS
        row.receive(message_of(row.port, 0, 1.0))
        reader.table.signs_of_life = 1
        result = after(reader, stalls, 11.0)
        assert result.startswith("nothing stamped t = 0.05 s within 11.0 s on x from sender")
        assert result.endswith(said_of_it or ", expected 0.05 s")


def test_at_the_first_ticks_the_timeout_is_that_of_a_start():
    for ticks, limit in ((0, 30.0), (1, 30.0), (2, 10.0)):
        reader, row, stalls = stands()
        reader.ticks = ticks
        row.have = False
        stalls.check()
        assert after(reader, stalls, limit) == "running"
        assert after(reader, stalls, 0.1).startswith("nothing stamped")


@pytest.mark.parametrize(
    ("seconds", "options", "end"),
    [
        (0.5, {}, "running"),
        (0.51, {"links": "", "duration": 0.0}, "done"),
        (1.99, {"links": "", "duration": 0.0}, "done"),
        (2.0, {"links": "", "duration": 0.0}, "nothing stamped t = 0.05 s within 2.0 s on x from sender (gone)"),
        (
            1.0,
            {"links": "", "duration": 0.0, "timeout": 0.9},
            "nothing stamped t = 0.05 s within 1.0 s on x from sender (gone)",
        ),
        (0.6, {"links": "x", "duration": 0.0}, "nothing stamped t = 0.05 s within 0.6 s on x from sender (gone)"),
        (0.6, {"links": "", "duration": 1.0}, "nothing stamped t = 0.05 s within 0.6 s on x from sender (gone)"),
    ],
)
def test_a_sender_that_has_left_ends_a_node_started_alone_without_an_error(seconds, options, end):
    reader, row, stalls = stands(**options)
    row.outside = 0
    assert after(reader, stalls, seconds) == end
    if end == "done":
        assert reader.middleware.logs == ["OK x: the sender has left at t = 0.05 s, and this node with it"]


def test_only_the_missing_one_of_several_senders_is_named():
    reader, row, stalls = stands()
    other = reader.row(state("y"))
    other.outside = 0
    reader.table.await_tick(reader.t)
    assert after(reader, stalls, 0.6) == "nothing stamped t = 0.05 s within 0.6 s on y from another node (gone)"
    reader, row, stalls = stands({"returns": True})
    row.outside = 0
    assert after(reader, stalls, 1e6) == "running"  # the command that restarts nodes checks the progress of the rig


@pytest.mark.parametrize("starting", [True, False])
def test_a_start_that_takes_too_long_names_the_missing_nodes(starting):
    def begun():
        reader, row, stalls = stands()
        reader.ticks = reader.table.signs_of_life = 0
        reader.state = "starting" if starting else "running"
        return reader, row, stalls

    reader, _row, stalls = begun()
    assert after(reader, stalls, 30.0) == reader.state
    assert after(reader, stalls, 0.1) == "not all peers after 30 s: nothing on x yet"
    assert reader.waits_for == ["sender"]
    reader, _row, stalls = begun()
    stalls.handshake = Shake("no publisher on a", "b is late")
    assert after(reader, stalls, 30.1) == "not all peers after 30 s: no publisher on a; b is late"
    assert reader.waits_for == ["late"]
    reader, _row, stalls = begun()
    reader.options.start_timeout = 0.0
    assert after(reader, stalls, 1e6) == reader.state
    stalls.restart()
    reader.options.start_timeout = 30.0
    assert after(reader, stalls, 29.0) == reader.state


def test_a_rig_has_begun_when_a_node_has_published():
    """Before that it waits for its start; a message at t = 0 of a clock or an outside plant is a beginning."""

    def limit(change, **links):
        reader, row, stalls = stands(links)
        reader.ticks = reader.table.signs_of_life = 0
        row.have = False
        change(reader, row)
        stalls.check()
        reader.options.timeout, reader.options.start_timeout = 40.0, 30.0
        text = after(reader, stalls, 35.0)
        return "start" if text.startswith("not all peers") else text

    assert limit(lambda reader, row: None) == "start"
    assert limit(lambda reader, row: None, owns_clock=True) == "running"
    assert limit(lambda reader, row: setattr(reader.table, "signs_of_life", 1)) == "running"
    assert limit(lambda reader, row: setattr(row, "have", True)) == "running"
    assert limit(lambda reader, row: setattr(reader, "ticks", 1)) == "running"
    assert limit(lambda reader, row: setattr(row, "earlier", True)) == "start"
    assert limit(lambda reader, row: (setattr(row, "earlier", True), setattr(row, "have", True))) == "start"
    assert limit(lambda reader, row: (setattr(row, "earlier", True), setattr(reader, "ticks", 1))) == "start"
    assert limit(lambda reader, row: reader.table.rows.clear()) == "running"


def test_two_publishers_of_one_topic_are_named_when_the_graph_shows_them():
    reader, row, stalls = stands()
    stalls.rivals, reader.state = row, "failed"
    reader.middleware.writers["/x"] = ["one", "_NODE_NAME_UNKNOWN_"]
    stalls.check()
    assert not reader.failures
    assert after(reader, stalls, 10.0) == "failed"
    assert after(reader, stalls, 0.1) == "2 publishers on x (/_NODE_NAME_UNKNOWN_, /one), expected exactly one"
    reader.failures.clear()
    stalls.restart()
    reader.middleware.writers["/x"] = ["two", "one"]
    assert after(reader, stalls, 0.0) == "2 publishers on x (/one, /two), expected exactly one"
    assert isinstance(row, Paired)
    assert TICK == "std_msgs/msg/Header"


# ---- a node that rejoins ----


class Drive:
    """The environment of a reader that restarts."""

    def __init__(self, reader):
        self.node, self.senders, self.solving = reader, reader.table, None
        self.last_published = SimpleNamespace(silent=False)

    def await_tick(self, t):
        self.senders.await_tick(t)


def comes_back(record, own=(), answered=(), departed=(), inputs=None, ports=None, clock=False, **links):
    """A reader that has died, and the recordings of the others: times (ms) and values by topic, by sender how far."""
    kinds = {"x": link(), "s": InputLink(period="0.01", node="quiet", port="out", sporadic=True), "c": link()}
    reader = Reader(inputs=kinds if inputs is None else inputs, returns=True, **links)
    reader.files = True
    ports = (state("x"), state("s"), array("c", "c", {"q": 1}, "m")) if ports is None else ports
    rows = {port.name: reader.row(port) for port in ports}
    if clock:
        reader.table.follow_clock(link())
    reader.table.follow_ticks(set(), lambda: None)
    planned, marked = [], []
    reader.step.changes, reader.step.plan = [Change(MS, {"k": 1.0})], planned.extend
    reader.step.link, reader.block = "its links", None

    def recording(of):
        known = {port.name: port for port in ports} | {"/clock": CLOCK}
        made = Recording((name, known[name].msgtype) for name in of)
        for name, said_then in of.items():
            port = known[name]
            for k, (t, value) in enumerate(said_then):
                made.topics[name].times.append(t * MS)
                made.topics[name].data.append(
                    port.layout().encode(k if name == "c" else t * MS, value if name == "/clock" else (value,))
                )
        return made

    files = Files(recording(record), recording(dict(own)), dict(answered), frozenset(departed))
    back = Comeback(Drive(reader), lambda: files)
    seen = []

    def ticks():
        for k in range(reader.schedule.count()):
            reader.ticks = k
            assert back._drive.last_published.silent
            if reader.step.link.lacks(reader.t):
                yield None
                return
            marked.append({name: row.stamp for name, row in rows.items()})
            seen.append((k, *(reader.values[name][0] for name in rows), reader.step.bad))
            reader.step.bad = False
            yield reader.t

    back.go(ticks())
    return reader, rows, back, seen, marked, planned, recording


RECORD = {
    "x": [(10 * k, k + 0.5) for k in range(5)],  # a message every 10 ms, up to 40 ms
    "s": [(10, 7.0), (30, math.nan)],  # two messages, of which the second was rejected
    "c": [(10 * k, k + 0.25) for k in range(6)],
}


def test_a_restarted_node_answers_the_ticks_with_complete_inputs_and_waits_for_the_rest():
    reader, rows, back, seen, marked, planned, _ = comes_back(RECORD, answered={"quiet": 60 * MS, "sender": 50 * MS})
    assert seen == [
        (0, 0.5, 0.0, 0.25, False),
        (1, 1.5, 7.0, 1.25, False),
        (2, 2.5, 7.0, 2.25, False),
        (3, 3.5, 7.0, 3.25, True),
        (4, 4.5, 7.0, 4.25, False),
    ]
    assert marked[4] == {"x": 40 * MS, "s": 10 * MS, "c": 40 * MS}
    assert planned == [Change(MS, {"k": 1.0})]
    assert (reader.step.link, back._drive.last_published.silent) == ("its links", False)
    assert reader.refusals == [("s", "q/position is nan, expected a finite number")]
    assert {name: (row.used, row.reached) for name, row in rows.items()} == {
        "x": (40 * MS, 40 * MS),
        "s": (50 * MS, 50 * MS),
        "c": (50 * MS, 50 * MS),
    }
    assert [row.publisher for row in reader.table.rows if not row.have] == ["sender"]
    assert rows["c"].received == 6
    assert rows["x"].want == 50 * MS
    rows["x"].receive(message_of(rows["x"].port, 50 * MS, 9.5))
    assert (reader.table.missing, reader.values["x"], reader.values["c"], reader.turns) == (0, (9.5,), (5.25,), 1)


def test_a_restarted_node_reads_from_the_files_what_was_published_and_which_nodes_have_left():
    reader, rows, back, *_, recording = comes_back(RECORD, answered={"quiet": 60 * MS, "sender": 50 * MS})
    more = RECORD | {"x": [(10 * k, k + 0.5) for k in range(6)], "s": [*RECORD["s"], (50, 8.0)]}
    files = Files(recording(more), recording({}), {"quiet": 70 * MS, "sender": math.inf}, frozenset({"sender"}))
    back._open_files = lambda: files
    assert back.read_earlier()
    assert back.ended == {"sender"}
    assert [row.received_any for row in rows.values()] == [True, False, True]
    assert (reader.table.missing, reader.values["x"]) == (0, (5.5,))
    assert not back.read_earlier()  # no further node has left
    assert len(reader.refusals) == 1


def test_a_sender_that_has_answered_a_tick_and_recorded_nothing_was_silent_at_it():
    record = {"x": [(0, 0.5)], "s": []}
    kinds = {"x": link(), "s": InputLink(period="0.01", node="quiet", port="out", sporadic=True)}
    for answered, last in (({"quiet": 10 * MS}, 0), ({"quiet": 1}, 0), ({}, None)):
        ports = state("x"), state("s")
        reader, rows, _, seen, *_ = comes_back(record, answered=answered, inputs=kinds, ports=ports)
        assert [k for k, *_ in seen] == ([] if last is None else [*range(last + 1)])
        assert rows["s"].reached == (-10 * MS if last is None else 0)
    fresh, rows, *_ = comes_back({}, inputs=kinds, ports=ports)  # nothing has been recorded yet
    rows["x"].receive(message_of(rows["x"].port, 0, 3.0))
    rows["s"].receive(message_of(rows["s"].port, 0, 4.0))
    assert (fresh.table.missing, fresh.values["x"], fresh.values["s"]) == (0, (3.0,), (4.0,))
    ended = comes_back(
        record, answered={"quiet": math.inf, "sender": math.inf}, inputs=kinds, ports=ports, departed={"quiet"}
    )
    reader, rows, back, seen, *_ = ended
    assert len(seen) == reader.schedule.count()  # all messages had been published
    assert rows["s"].reached == 200 * MS
    assert back.ended == {"quiet"}
    assert [row.received_any for row in rows.values()] == [False, True]


def test_external_messages_are_in_the_nodes_own_recording_and_each_one_counts():
    free = joint_state("f", "f", ["q"], position="m", held=True)
    ports = state("x"), free
    record, own = (
        {"x": [(10 * k, k + 0.5) for k in range(3)]},
        {"f": [(0, 1.0), (10, 2.0), (10, 3.0), (20, math.inf), (90, 5.0)]},
    )
    reader, rows, _, seen, _, _, recording = comes_back(record, own, inputs={"x": link()}, ports=ports)
    assert seen == [(0, 0.5, 1.0, False), (1, 1.5, 3.0, False), (2, 2.5, 3.0, True)]
    assert rows["f"].stamp == 10 * MS
    reader = Reader(inputs={"x": link()}, returns=True)
    reader.record.foreign, row = {"f": 4}, None
    reader.row(state("x"))
    row = reader.row(free)
    received = comebacks._Recorded(row, Files(recording({}), recording(own)), outside=True)
    reader.ticks = 1
    received.set_value(10 * MS)
    assert [(number, t) for number, t, _ in reader.kept] == [(4, 10 * MS)] * 3  # the messages are recorded again
    assert [number for number, _ in received.unused()] == [3, 4]
    paired_ = comebacks._Recorded(reader.table.rows[0], Files(recording(record), recording(own)), outside=False)
    paired_.set_value(15 * MS)
    assert (reader.values["x"], reader.table.rows[0].stamp, len(reader.kept)) == ((1.5,), 10 * MS, 3)
    assert [number for number, _ in paired_.unused()] == [2]


def test_a_node_that_follows_the_clock_restarts_at_its_newest_tick():
    times = [(10 * k, ()) for k in range(4)]
    for record, ticks, used in ((times, 4, 30 * MS), ([], 0, -1)):
        reader, _, _, seen, *_ = comes_back({"/clock": record}, inputs={}, ports=(), clock=True)
        (row,) = reader.table.rows
        assert (len(seen), row.used, row.reached, reader.table.missing) == (ticks, used, used, 1)
        row.receive(CLOCK.layout().encode(10 * ticks * MS, ()))
        assert (reader.table.missing, reader.turns) == (0, 1)
