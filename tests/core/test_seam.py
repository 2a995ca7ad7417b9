"""The middleware-independent logic of a node, each part alone: queues, buttons, ticks, reports."""

import itertools
import json
import os
import random
from functools import partial
from types import SimpleNamespace

import pytest
from by_hand import Hand
from softrig_core import Refused, array, button, joint_state
from softrig_core.block.schedule import Schedule
from softrig_core.wire.cdr import parse
from softrig_nodes.seam import exchange as module, health
from softrig_nodes.seam.awaited import RECORDER, Awaited, left_out
from softrig_nodes.seam.buttons import Buttons
from softrig_nodes.seam.endpoint import Input, Output
from softrig_nodes.seam.exchange import Exchange
from softrig_nodes.seam.hold import LOOK, Hold
from softrig_nodes.seam.middleware import Peer, other_types
from softrig_nodes.seam.numbering import Numbering, numbered, split
from softrig_nodes.seam.solving import BUSY, Busy, Solving
from softrig_nodes.seam.tick import TICK, TickReader, TickWriter, acknowledged, needed

MS = 1_000_000


# ---- the queue and the timers of a container ----


class Still(Exchange):
    """An exchange in a time that the test moves, and that passes while it waits."""

    def __init__(self, monkeypatch, step=0):
        super().__init__()
        self.t, self.step, self.log = 0, step, []
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic_ns=self._clock))

    def _clock(self):
        self.t += self.step
        return self.t

    def _wait(self, limit):
        self.t = max(self.t + 1, limit)

    def note(self, what):
        self.log.append((what, self.t))

    def work(self, name, takes):
        """A call that takes a number of ns."""

        def call():
            self.note(name)
            self.t += takes

        return call


def test_timers_of_a_container_fire_at_their_time_in_order_and_again_after_their_period(monkeypatch):
    exchange = Still(monkeypatch)
    for name, ns in (("slow", 5 * MS), ("quick", 2 * MS), ("odd", 3 * MS)):
        exchange.timer(ns, partial(exchange.note, name), name)
    assert exchange.next_due() == 2 * MS
    assert exchange.serve(9 * MS, 1 << 62) == 0
    expected = [
        (k * period * MS, name) for name, period in (("slow", 5), ("quick", 2), ("odd", 3)) for k in range(1, 5)
    ]
    assert sorted((t, name) for name, t in exchange.log) == sorted(e for e in expected if e[0] <= 9 * MS)
    assert [t for _, t in exchange.log] == sorted(t for _, t in exchange.log)


def test_a_timer_may_be_moved_or_cancelled_at_any_time_and_has_at_least_a_microsecond(monkeypatch):
    exchange = Still(monkeypatch)
    timer = exchange.timer(10, partial(exchange.note, "a"), "node")
    assert (timer.due, timer.period, exchange.next_due()) == (1000, 1000, 1000)
    timer.again(5000, 7000)
    timer.again(3000, 9000)
    assert (timer.due, timer.period, exchange.next_due()) == (3000, 9000, 3000)
    timer.again(4000)
    assert (timer.due, timer.period, exchange.next_due()) == (4000, 4000, 4000)
    timer.cancel()
    assert exchange.next_due() == 1 << 62
    timer.again(2000, 500)
    assert (timer.due, timer.period) == (2000, 1000)
    other = exchange.timer(3000, lambda: timer.again(50_000), "node")
    assert exchange.serve(3500, 1 << 62) == 0
    assert exchange.log == [("a", 2000)]  # at 3000 the other timer comes first, as it was set earlier
    assert (timer.due, other.due) == (53_000, 6000)
    other.cancel()
    assert exchange.serve(10_000_000) == 53_000 - exchange.t  # only the timer at 53,000 is left


def test_posted_calls_are_made_in_order_and_never_nested(monkeypatch):
    exchange = Still(monkeypatch)

    def outer():
        exchange.note("in")
        exchange.post(partial(exchange.note, "posted"))
        exchange.hand(exchange.note, "handed")
        exchange.note("out")

    exchange.post(outer)
    exchange.post(partial(exchange.note, "second"))
    assert exchange.serve(1000) == 1 << 62
    assert [what for what, _ in exchange.log] == ["in", "out", "second", "posted", "handed"]


@pytest.mark.parametrize(("until", "done"), [(15_999, 16), (16_000, 32), (31_999, 32), (32_000, 40)])
def test_after_sixteen_calls_the_time_is_checked(until, done, monkeypatch):
    exchange = Still(monkeypatch)
    for k in range(40):
        exchange.post(exchange.work(k, 1000))
    left = exchange.serve(until)
    assert [what for what, _ in exchange.log] == list(range(done))
    assert left == (0 if done < 40 else (1 << 62) - 40_000 if until >= 40_000 else 0)


def test_a_queue_that_never_empties_delays_a_timer_by_at_most_five_ms(monkeypatch):
    exchange = Still(monkeypatch)

    def endless():
        exchange.work("turn", MS)()
        exchange.post(endless)

    exchange.post(endless)
    timer = exchange.timer(2 * MS, partial(exchange.note, "timer"), "node")
    assert exchange.serve(12 * MS) == 0
    turns = [("turn", t) for t in range(13)]
    assert [(what, t // MS) for what, t in exchange.log] == [
        *turns[:6],
        ("timer", 6),
        *turns[6:12],
        ("timer", 12),
        turns[12],
    ]
    assert timer.due == 14 * MS


def test_the_time_until_the_next_due_call_is_reported_and_waited_for(monkeypatch):
    exchange = Still(monkeypatch)
    exchange.timer(5000, partial(exchange.note, "t"), "node")
    assert exchange.serve(4999, 4999) == 5000
    assert exchange.serve(4999, 5000) == 0  # returns 0 if the whole time was spent waiting
    assert (exchange.t, exchange.log) == (5000, [])
    assert exchange.serve(5000, 0) == 5000
    assert exchange.log == [("t", 5000)]


@pytest.mark.parametrize(
    ("due", "awake", "turns"),
    [
        (100_000, 300_000, 7),  # no time is left: the timer has priority, for seven turns
        (150_000, 300_000, 7),
        (150_001, 300_000, 0),  # messages have time before the timer
        (100_000, 0, 0),
        (1000, 999, 0),
        (1000, 1000, 7),
    ],
)
def test_messages_for_others_are_sent_when_there_is_time_or_after_eight_turns(due, awake, turns, monkeypatch):
    exchange = Still(monkeypatch)
    exchange.timer(due, partial(exchange.note, "timer"), "node")
    for k in range(3):
        exchange.carry(exchange.note, k)
    exchange.serve(9 * due, awake)
    whats = [what for what, _ in exchange.log]
    assert whats[: turns + 3] == ["timer"] * turns + [0, 1, 2]
    assert whats.count(0) == 1


def test_eight_messages_for_others_are_sent_together_and_the_rest_at_the_end(monkeypatch):
    exchange = Still(monkeypatch)
    for k in range(11):
        exchange.carry(exchange.note, k)
        assert len(exchange.log) == (8 if k >= 7 else 0)
    exchange.flush()
    assert [what for what, _ in exchange.log] == list(range(11))
    exchange.carry(exchange.note, "late")
    exchange.post(exchange.work("long", 2000))
    assert exchange.serve(1000) == 0
    assert [what for what, _ in exchange.log[11:]] == ["long", "late"]
    exchange.flush()
    assert len(exchange.log) == 13


def test_an_error_names_the_node_whose_call_raised_it(monkeypatch):
    def fail(data=None):
        raise ValueError("no")

    def broken(data):
        raise ValueError("no")

    exchange = Still(monkeypatch)
    assert exchange.culprit() == ""
    exchange.owners[broken] = "reader"
    exchange.hand(broken, b"")
    with pytest.raises(ValueError, match="no"):
        exchange.serve(1000)
    assert exchange.culprit() == "reader"
    exchange.timer(1000, fail, "timed")
    with pytest.raises(ValueError, match="no"):
        exchange.serve(5000, 5000)
    assert exchange.culprit() == "timed"
    exchange.post(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        exchange.serve(5000)
    assert exchange.culprit() == ""


def test_a_container_receives_while_another_thread_writes():
    exchange = Exchange()
    assert not exchange.listens
    exchange.writers.update(a=0, b=2)
    assert exchange.listens
    exchange.writers["b"] = 0
    assert not exchange.listens


def test_a_container_stays_awake_until_a_time(monkeypatch):
    exchange = Still(monkeypatch, step=10)
    Exchange._wait(exchange, 95)
    assert exchange.t == 100
    Exchange._wait(exchange, 110)
    assert exchange.t == 110


# ---- buttons ----


def test_each_press_is_one_tick_down_and_at_least_one_up_however_fast_they_come():
    """Against the list of what a block must see: as many edges as presses, none lost, none longer than a tick."""
    draw = random.Random(3)
    port, values, messages = button("kick", "kick"), {"kick": (0.0,)}, []
    buttons = Buttons(values, lambda p, down: messages.append((p, down)))
    waiting, seen, down = 0, [], False
    for _ in range(200):
        for _ in range(draw.choice([0, 0, 0, 1, 2])):
            assert buttons.press(port) == (True, "kick pressed")
            waiting += 1
        assert bool(buttons.pressed) == (waiting > 0 or down)
        now = values["kick"] == (1.0,)
        seen.append(now)
        expected = not down and waiting > 0
        assert now == expected
        waiting, down = waiting - now, now
        buttons.release()
    for _ in range(2 * waiting + 2):
        seen.append(values["kick"] == (1.0,))
        buttons.release()
    presses = sum(seen)
    assert not any(a and b for a, b in itertools.pairwise(seen))
    assert not buttons.pressed
    assert [down for _, down in messages] == [True, False] * presses
    assert {p for p, _ in messages} == {port}
    values["kick"] = (1.0,)
    assert buttons.press(port) == (False, "kick is held down by its topic")
    assert not buttons.pressed


# ---- endpoints ----


def test_an_endpoint_counts_its_matches_and_an_input_forgets_its_number_when_that_changes():
    end, joined = Input(joint_state("a", "t", ["x"], position="m")), []
    assert (end.publishers, end.outside, end.received_any, end.following) == (0, 0, False, None)
    assert (end.lost, end.late, end.overdue, end.refused, end.last_refusal) == (0, 0, 0, 0, "")
    end.receive(b"")  # an empty message is dropped
    assert not end.received_any
    end.following = 7
    for count, following in ((0, 7), (2, None), (2, 8), (1, None)):
        end.matched(count)
        assert (end.outside, end.publishers, end.following) == (count, count, following)
        end.following = 8 if following is None else following
    end.local = True
    assert end.publishers == 2
    out = Output(array("a", "t", {"row": 2}, "V"), "/rig/t", 3)
    assert (out.name, out.topic, out.number, out.numbered, out.readers) == ("a", "/rig/t", 3, True, 0)
    assert not Output(joint_state("a", "t", ["x"], position="m"), "/t", 0).numbered
    out.joined()
    out.joined = lambda: joined.append(out.readers)
    for count in (0, 1, 1, 3, 2, 3):
        out.matched(count)
        assert out.readers == count
    assert joined == [1, 3, 3]
    with pytest.raises(RuntimeError, match="not advertised"):
        out.send(0, ())


# ---- acknowledgements ----


@pytest.mark.parametrize(("clock", "every"), [("1/1000", 1), ("1/300", 1), ("1/1000", 2), ("1/300", 3), ("1/1000", 5)])
def test_the_clock_waits_for_an_acknowledgement_of_a_follower_and_is_less_than_nine_ticks_ahead(clock, every):
    """A follower acknowledges some of its ticks; each tick of the clock needs one of these."""
    owner = Schedule(clock, clock, 41 * float(eval(clock)), at_end=True)
    follower = Schedule(every * owner.period, clock, 41 * float(owner.period))
    ticks = [follower.time(k) for k in range(follower.count())]
    acknowledged_ticks = [t for t in ticks if acknowledged(follower, t)]
    together = max(1, 4 // every)
    assert acknowledged_ticks == [t for k, t in enumerate(ticks) if (k + 1) % together == 0 or t == ticks[-1]]
    for k in range(owner.ticks + 1):
        want = needed(follower, owner, owner.time(k))
        if owner.next(owner.time(k)) >= owner.end:
            assert want == follower.awaited(owner.time(k))
            continue
        ready = [t for t in acknowledged_ticks if t <= owner.time(k) and follower.tick(t) * every <= k - 4]
        newest = max((t for j, t in enumerate(ticks) if (j + 1) % together == 0 and t in ready), default=-1)
        assert want == newest or (want < 0 and newest < 0)
        assert k - owner.tick(max(want, 0)) < 9 + every


def test_an_acknowledgement_contains_its_tick_and_topics_and_is_read_from_any_node(monkeypatch):
    write, read = TickWriter(), TickReader()
    for t, sent in (
        (0, ()),
        (1_700_000_000_123_456_789, ("a", "b")),
        (5, ("a", "b")),
        (7, ["a"]),
        (-3 * 10**9 + 1, ()),
    ):
        data = write(t, sent)
        assert parse(TICK, data).frame_id == " ".join(sent)
        for _ in range(2):  # the second time the message is in the cache
            assert read(data) == (t, frozenset(sent))
    big = b"\0\0\0\0" + (5).to_bytes(4, "big") + (6).to_bytes(4, "big") + (2).to_bytes(4, "big") + b"a\0"
    assert read(big) == read(big) == (5_000_000_006, frozenset("a"))
    for bad in (b"", b"\0\1\0\0", write(5, ["abc"])[:-2]):
        with pytest.raises(Refused, match="std_msgs/msg/Header"):
            read(bad)
    for k in range(100):  # the cache holds 64 messages, and further ones are parsed
        assert read(write(k, [f"p{k}"])) == (k, frozenset([f"p{k}"]))
    assert len(read._known) == 64
    monkeypatch.setattr("softrig_nodes.seam.tick.parse", None)  # cached messages are not parsed
    assert read(write(3, ["a"])) == (3, frozenset("a"))


def test_a_number_takes_eight_bytes_after_a_message():
    messages, counts = [], {"u": 0}
    port = joint_state("a", "t", ["x"], position="m")
    publish = Numbering(messages.append, port.layout(), counts, "u")
    for k in range(3):
        publish(10 + k, (float(k),))
    assert messages == [port.layout().encode(10 + k, (float(k),)) + bytes([k, 0, 0, 0, 0, 0, 0, 0]) for k in range(3)]
    counts["u"] = 1  # counting two messages back publishes them again unchanged
    publish(11, (1.0,))
    publish(12, (2.0,))
    assert messages[3:] == messages[1:3]
    assert split(messages[2]) == (2, port.layout().encode(12, (2.0,)))
    assert split(numbered(2**40 + 258, b"abc")) == (2**40 + 258, b"abc")


def test_requesting_recorders_are_awaited_except_on_topics_that_they_leave_out():
    hand = Hand()
    awaited = Awaited(hand, ["bag"])
    assert awaited.of("/a") == ["bag"]
    hand.writers[RECORDER] = ["one", "two"]
    assert awaited.of("/a") == ["bag", "one", "two"]
    hand.callbacks[RECORDER](left_out("/one", ["/a", "/b"]))
    hand.callbacks[RECORDER](left_out("/two", ["/b"]))
    assert [awaited.of(topic) for topic in ("/a", "/b", "/c")] == [["bag", "two"], ["bag"], ["bag", "one", "two"]]
    hand.callbacks[RECORDER](b"\0\1\0\0")
    assert hand.logs == [
        "ERROR refused on /_softrig/recorder: std_msgs/msg/Header: 4 bytes end inside a field at byte 4"
    ]
    hand.types = {"/t": ["b", "sensor_msgs/msg/JointState", "a"]}
    assert other_types(hand, joint_state("a", "t", ["x"], position="m")) == "b, a"
    assert other_types(hand, joint_state("a", "u", ["x"], position="m")) == ""
    assert [Peer("a", space, "").full_name for space in ("/", "/rig", "/rig/")] == ["/a", "/rig/a", "/rig/a"]


# ---- reports of long computations and held nodes ----


def solving(monkeypatch):
    """A solver between two ticks, with a record of its requests."""
    hand, asked, resumed = Hand(time=10**9), [], []
    block = SimpleNamespace(
        begin=lambda x, t, **inputs: asked.append(("begin", x, t, inputs)) or "begun",
        carry_on=lambda x, t: asked.append(("carry on", x, t)) or "carried",
        end=lambda x, t: asked.append(("end", x, t)) or "answer",
        ready=lambda x, t: block.is_ready,
        working=lambda x: asked.append(("working", x)) or True,
        is_ready=False,
    )
    monkeypatch.setattr("softrig_nodes.seam.solving.Solver", SimpleNamespace)
    step = SimpleNamespace(block=block, x="first", bad=False, begun=None, values={"u": 1.0}, link=None)
    return hand, block, step, asked, resumed, Solving(hand, step, lambda: resumed.append(hand.time))


def test_a_solver_begins_a_tick_once_and_is_polled_until_its_answer_is_there(monkeypatch):
    hand, block, step, asked, resumed, part = solving(monkeypatch)
    (timer,) = hand.timers
    assert timer.asked == [(2 * MS, 0), None]
    for _ in range(3):
        assert not part.finished(5)
    assert asked == [("begin", "first", 5, {"u": 1.0})]
    assert step.x == "begun"
    assert timer.asked[2:] == [(2 * MS, 0)]  # the timer is set once
    timer.call()
    assert (resumed, timer.now) == ([], (2 * MS, 0))
    block.is_ready = True
    timer.call()
    assert (resumed, timer.now) == ([hand.time], None)
    assert part.finished(5)
    assert (step.link.respond("begun", 5, u=2.0), asked[-1]) == ("answer", ("end", "begun", 5))
    assert part.working
    step.bad = True
    block.is_ready = False
    assert not part.finished(6)
    assert (asked[-1], step.x) == (("carry on", "begun", 6), "carried")
    assert timer.now == (2 * MS, 0)  # the node waits again


def test_a_solver_informs_its_peers_every_half_second_that_it_works(monkeypatch):
    hand, _, _, _, _, part = solving(monkeypatch)
    assert not part.finished(5)
    times = []
    for _ in range(900):
        hand.time += 2 * MS
        before = len(hand.published[BUSY])
        hand.timers[0].call()
        times += [hand.time - 10**9] * (len(hand.published[BUSY]) - before)
    assert times == [502 * MS, 1004 * MS, 1506 * MS]
    assert TickReader()(hand.published[BUSY][0]) == (0, frozenset(["/node"]))
    received = []
    item = Busy(hand, 2, lambda: received.append(1))
    hand.callbacks[BUSY](hand.published[BUSY][0])
    assert received == [1]
    for count, publishers in ((0, 0), (1, 0), (2, 1), (3, 1), (4, 2)):
        hand.matched[BUSY](count)
        assert item.publishers == publishers


def test_a_paused_node_reports_it_and_runs_the_steps_it_gets():
    hand, turned = Hand(), []
    hold = Hold(held=True)
    assert hold.ask("pause") == (False, "this node has not begun")
    assert not hold.go_at(2.0)
    hold.begin(hand, lambda: turned.append(1))
    (tells,) = hand.timers
    assert tells.asked == [(500 * MS, 0)]
    tells.call()
    assert [TickReader()(data) for data in hand.published[BUSY]] == [(0, frozenset(["/node"]))]
    assert [hold.holds(0) for _ in range(3)] == [True] * 3
    assert hold.ask("step", 2) == (True, "one step")
    assert [hold.holds(0) for _ in range(4)] == [False, False, True, True]
    assert hold.ask("pause") == (True, "paused")
    assert hold.ask("resume") == (True, "goes on")
    assert (hold.held, hold.steps) == (False, 0)
    assert hold.ask("step") == (False, "the run is not paused; pause it first")
    assert not hold.holds(0)
    tells.call()
    assert len(hand.published[BUSY]) == 1
    assert len(hand.posted) == 3
    hand.posted[-1]()
    assert turned == [1]
    hold.ask("pause")
    assert len(hand.timers) == 1  # this is reported already
    hold.ask("step", 3)
    hold.ask("resume")
    hold.ask("pause")
    assert hold.holds(0)  # steps that were requested but not executed are dropped


def test_a_pace_is_checked_a_hundred_times_a_second_until_there_is_none():
    hand, turned = Hand(time=10**9), []
    hold = Hold(pace=0.5)
    hold.begin(hand, lambda: turned.append(1))
    tells, styles = hand.timers
    assert styles.asked == [(LOOK, 0), (LOOK, 0)]
    assert LOOK == 10 * MS
    assert hold.holds(0)
    assert hold.waits
    tells.call()
    assert len(hand.published[BUSY]) == 1
    hand.time += 20 * MS  # 20 ms of wall time are 10 ms of the run
    styles.call()
    assert (turned, hold.waits) == ([1], False)
    styles.call()
    assert turned == [1]  # no request is left
    assert [hold.holds(t * MS) for t in (0, 5, 9, 10, 11)] == [False, False, False, True, True]
    assert hold.go_at(2.0)
    assert hold.pace == 2.0
    hand.time += 10 * MS
    assert [hold.holds(t * MS) for t in (10, 29, 30)] == [False, False, True]
    assert hold.go_at(0.0)
    assert styles.now is None
    hand.posted.pop()()
    assert turned == [1, 1]
    assert not hold.holds(10**15)
    assert not Hold(pace=1.0, paced=False).go_at(1.0)


# ---- how a node is ----


def test_a_status_file_is_complete_whenever_it_is_read(tmp_path):
    path = tmp_path / "node.status"
    file = health.StatusFile(str(path))
    file.write({"t": 1})
    assert json.loads(path.read_text()) == {"t": 1}
    with path.open() as before:
        file.write({"t": 2, "error": "ü"})
        assert json.loads(before.read()) == {"t": 1}  # a reader that has opened the file keeps the old content
    assert json.loads(path.read_text()) == {"t": 2, "error": "ü"}
    assert os.listdir(tmp_path) == ["node.status"]


def test_a_status_file_is_replaced_if_names_cannot_be_exchanged(tmp_path, monkeypatch):
    for exchange in (None, lambda *names: -1):
        monkeypatch.setattr(health, "_renameat2", exchange)
        for t in (1, 2):
            health.StatusFile(str(tmp_path / "a.status")).write({"t": t})
            assert json.loads((tmp_path / "a.status").read_text()) == {"t": t}
    asked = []
    monkeypatch.setattr(health, "_renameat2", lambda *names: asked.append(names) or 0)
    health.StatusFile(str(tmp_path / "a.status")).write({"t": 3})
    new, old = (os.fsencode(tmp_path / f"a.{end}") for end in ("new", "status"))
    assert asked == [(-100, new, -100, old, 2)]  # Linux's AT_FDCWD and RENAME_EXCHANGE
    assert os.listdir(tmp_path) == ["a.status"]


def test_the_median_the_hundredth_longest_and_the_longest_duration_are_reported():
    assert health.percentiles("x", [], 5) == {}
    for n in (1, 2, 3, 99, 100, 101, 250):
        samples = list(range(1, n + 1))
        random.Random(n).shuffle(samples)
        text = health.percentiles("x", (s * MS for s in samples), 400 * MS)
        middle = n // 2 + 1  # for an even number, the upper of the two
        assert text == {"x_p50_ms": middle, "x_p99_ms": n * 99 // 100 + 1, "x_max_ms": 400.0}


def test_the_largest_memory_is_that_of_the_system():
    text = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))  # noqa: SIM115
    assert health.peak_memory() == pytest.approx(int(text.split()[1]) / 1024, abs=1.0)
    assert round(health.peak_memory(), 1) == health.peak_memory()
