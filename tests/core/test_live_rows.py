"""Nodes in real time, each alone with a clock that a test moves: which messages they accept, wait for and count."""

import math
import random
from collections import deque
from types import SimpleNamespace

import pytest
from by_hand import Hand, Kept
from faultrig import COMMAND, STATE, Gain, Lag, Source
from softrig_core import Block, BlockParams, Plant, RunError, Sample, array, command, joint_state, param
from softrig_core.block.block import Level
from softrig_core.block.schedule import Schedule
from softrig_core.rig.options import InputLink, Links, RunOptions
from softrig_nodes import group as group_module
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.group import Group
from softrig_nodes.realtime.beat import Beat
from softrig_nodes.realtime.live import Live
from softrig_nodes.realtime.realtime import Realtime, newest
from softrig_nodes.realtime.rivals import Rivals
from softrig_nodes.realtime.sporadic import Sporadic
from softrig_nodes.realtime.stand import LEAD, NEVER, Stand
from softrig_nodes.seam.hold import Hold
from softrig_nodes.seam.tick import TickWriter

MS, SECOND = 1_000_000, 1_000_000_000
START = 1_700_000_000 * SECOND  # The runs start at a time at which every period of this file has a tick.


class Node:
    """A block as a node in real time, over a middleware that the test steps."""

    def __init__(self, block, links=None, time=START - 5 * MS, epoch=0, **options):
        self.hand, self.kept = Hand("node", time), Kept()
        text = "" if links is None else Links(**links).model_dump_json()
        options = RunOptions(mode="realtime", links=text, epoch=epoch, **options)
        block.reset(0)
        self.adapter = Adapter(self.hand, block, options, self.kept)
        self.drive = Realtime(self.adapter)
        self.watch = self.hand.timers[0]

    def join(self, local=()):
        self.drive.join(set(local))
        return self

    @property
    def rows(self):
        return {row.name: row for row in self.adapter.inputs}

    def hear(self, name, stamp, *values, at=None, data=None):
        """Deliver a message to an input; at the time of the clock, or at the given one."""
        row = self.rows[name]
        self.hand.time = self.hand.time if at is None else at
        row.receive(row.port.layout().encode(stamp, values) if data is None else data)

    def published(self, topic):
        return self.hand.published[topic]

    def reports(self):
        return {key: f"{level.name} {text} ({n})" for key, (level, text, n) in self.adapter.step.reports.items()}


def linked(every="0.01", at_end=True, **more):
    return InputLink(period=every, node="other", port="out", at_end=at_end, **more)


class LawParams(BlockParams):
    period: float = param(0.01, "period", "s", gt=0.0)


SEEN = deque()


class Law(Block[LawParams]):
    """Publishes what it has received: `a` and `b` are required, `c` is optional."""

    INPUTS = (
        joint_state("a", "a", ["q"], position="m"),
        joint_state("b", "b", ["q"], position="m"),
        joint_state("c", "c", ["q"], position="m", held=True),
    )
    OUTPUTS = (command("u", "u", ["q"], "N"),)

    def update(self, x, t, a, b, c):
        SEEN.append((t, a[0], b[0], c[0] if c else None, self.unanswered))
        return x, {"u": (a[0],)}

    def refused(self, x, t):
        SEEN.append((t, "refused"))
        return x, None


@pytest.fixture(autouse=True)
def nothing_seen():
    SEEN.clear()


# ---- ticks that a controller answers, compared with a list of received messages ----


def play(node, messages, names):
    """Deliver messages (time, input, stamp, value), and let the controller's time limit expire between them."""
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_give_up")
    answers, limit, handled = [], math.inf, len(timer.asked)

    def note(at):
        nonlocal limit, handled
        for asked in timer.asked[handled:]:
            limit = math.inf if asked is None else at + asked[0]
        handled = len(timer.asked)
        while SEEN:
            answers.append(((at - START) / MS, *SEEN.popleft()))

    for at, name, stamp, value in [*messages, (math.inf, None, 0, 0)]:
        while limit < at:
            node.hand.time = limit
            timer.call()
            note(limit)
        if name is not None:
            node.hear(name, stamp, value, at=at)
            note(at)
    return answers


def expected(messages, links, period, patience):
    """The independent computation: a tick begins with the first message of a required input with its stamp or a later
    one.

    It is answered when every input that is due has come, or `patience` after it has become the oldest and lacks one;
    then with the newest of each that is not after it, if each required one has any. An optional one that a tick was
    answered without is awaited again when it has come.
    """
    law = Schedule(period)
    senders = {name: Schedule(k.period) for name, k in links.items()}
    arrived = {name: [] for name in links}  # stamp and value in the order of the stamps
    expect = dict.fromkeys(links, True)
    begun, newest_begun, limit, answers = [], -1, math.inf, []
    last = None

    def lacks(t):
        lacking = []
        for name, sender in senders.items():
            due = sender.held(t)
            arrived_in_time = bool(arrived[name]) and arrived[name][-1][0] >= due
            if name == "c" and not expect[name]:
                continue
            if not arrived_in_time or (name != "c" and arrived[name][0][0] > t):
                lacking.append(name)
        return lacking

    def answer(at, t):
        nonlocal last
        values = []
        for name in links:
            known = [value for stamp, value in arrived[name] if stamp <= t]
            values.append(known[-1] if known else None)
        missed = 0 if last is None else (t - last) // (law.time(1)) - 1
        answers.append(((at / MS), t, *values, max(missed, 0)))
        last = t

    def go_on(at, armed):
        nonlocal limit
        while begun and not lacks(begun[0]):
            answer(at, begun.pop(0))
            armed = False
        if not begun:
            limit = math.inf
        elif not armed:
            limit = at + patience

    def run_out(at):
        nonlocal newest_begun
        t = begun.pop(0)
        if all(arrived[n] and arrived[n][0][0] <= t for n in links if n != "c"):
            if "c" in lacks(t):
                expect["c"] = False
            answer(at, t)
        elif not begun:
            newest_begun = t - 1
        go_on(at, False)

    for at, name, stamp, value in [*messages, (math.inf, None, 0, 0)]:
        while limit < at:
            run_out(limit)
        if name is None:
            break
        if arrived[name] and stamp <= arrived[name][-1][0]:
            continue
        arrived[name].append((stamp, value))
        expect[name] = True
        armed = limit < math.inf
        if name != "c" and stamp > newest_begun and law.held(stamp) > newest_begun:
            t = law.held(stamp)
            if t >= 0:
                newest_begun = t
                begun.append(t)
        go_on(at, armed)
    return answers


@pytest.mark.parametrize("lost", [0.0, 0.15], ids=["", "some lost"])
@pytest.mark.parametrize("seed", range(10))
def test_a_controller_answers_a_tick_when_all_due_inputs_have_arrived_or_its_time_limit_has_expired(seed, lost):
    draw = random.Random(seed)
    periods = {"a": "0.01", "b": draw.choice(["0.01", "0.02", "0.03"]), "c": draw.choice(["0.01", "0.02"])}
    links = {name: linked(every) for name, every in periods.items()}
    node = Node(Law(), {"base": "0.01", "inputs": links}, epoch=START).join()
    messages = []
    for name, every in periods.items():
        sender, at = Schedule(every), 0
        for k in range(24):
            stamp = sender.time(k)
            at = max(at, stamp + draw.choice([1, 1, 2, 3, 7, 12, 26]) * MS + draw.randrange(1000))
            if draw.random() >= lost and stamp < 240 * MS:
                messages.append((at, name, stamp, k + {"a": 0.0, "b": 0.25, "c": 0.5}[name]))
    messages.sort()
    wanted = expected(messages, links, "0.01", 8 * MS)
    result = play(node, [(START + at, name, START + stamp, value) for at, name, stamp, value in messages], periods)
    assert result == wanted
    assert node.drive.missed == sum(missed for *_, missed in wanted)
    assert node.adapter.ticks == len(wanted) > 10
    stamps = [START + t for _, t, *_ in result]
    assert list(node.published("u")) == [
        node.adapter.outgoing.outputs[0].layout.encode(s, (a,)) for s, (_, _, a, *_) in zip(stamps, result, strict=True)
    ]


def three(patience=0.8, **options):
    links = {"base": "0.01", "inputs": {"a": linked(), "b": linked()}}
    return Node(Law(), links, epoch=START, patience=patience, **options).join()


def test_an_answer_without_an_input_is_counted_and_reported():
    node = three()
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_give_up")
    for t in (0, 10):
        node.hear("a", START + t * MS, 1.0, at=START + (t + 1) * MS)
        node.hear("b", START + t * MS, 1.0)
    node.hear("a", START + 20 * MS, 2.0, at=START + 21 * MS)
    assert timer.now == (8 * MS, 0)
    timer.call()
    assert [seen[0] for seen in SEEN] == [0, 10 * MS, 20 * MS]
    assert node.drive.counts() == {"missed_deadlines": 0, "incomplete_ticks": 1}
    assert node.reports() == {"incomplete": "WARN answered without what was due on b (1)"}
    node.hear("b", START + 20 * MS, 2.0, at=START + 29 * MS)
    assert node.rows["b"].overdue == 1
    assert node.drive.counts()["overdue_messages"] == 1
    node.hear("b", START + 10 * MS, 2.0)
    assert (node.rows["b"].late, node.drive.counts()["late_messages"]) == (1, 1)
    node.hear("a", START + 60 * MS, 6.0, at=START + 61 * MS)
    node.hear("b", START + 60 * MS, 6.0)
    assert SEEN[-1] == (60 * MS, 6.0, 6.0, None, 3)
    assert (node.drive.missed, node.drive.incomplete) == (3, 1)


def test_ticks_older_than_the_window_are_dropped():
    node = three()
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_give_up")
    for k in range(40):
        node.hear("a", START + k * 10 * MS, 1.0, at=START + k * 10 * MS)
    assert not SEEN
    node.hand.time = START + 1_200 * MS  # stamps may be one second old, so the ticks before 200 ms are dropped
    node.rows["a"].receive(node.rows["a"].port.layout().encode(START + 400 * MS, (1.0,)))
    assert node.drive.counts()["dropped_ticks"] == 20
    assert node.reports() == {"dropped": "ERROR 20 ticks dropped: the controller is too slow, or was stopped (1)"}
    node.hear("b", START + 400 * MS, 1.0)
    for _ in range(20):  # b has a message for the last tick only
        assert not SEEN
        assert timer.now == (8 * MS, 0)
        timer.call()
    assert [*SEEN] == [(400 * MS, 1.0, 1.0, None, 0)]
    assert (timer.now, node.drive.incomplete) == (None, 0)
    last = three()
    for k in range(3):
        last.hear("a", START + k * 10 * MS, 1.0, at=START + k * 10 * MS)
    last.hear("c", START + 9 * SECOND, 1.0, at=START + 9 * SECOND)
    assert last.drive.counts()["dropped_ticks"] == 2  # the newest tick is kept, whatever its age
    other = three(stamp_window=100.0)
    for k in range(70):
        other.hear("a", START + k * 10 * MS, 1.0, at=START + k * 10 * MS)
    assert other.drive.counts()["dropped_ticks"] == 6  # a row keeps at most 64 messages


def test_a_rejected_message_counts_for_its_tick_and_the_block_decides_the_answer():
    node = three()
    node.hear("a", START, 1.0, at=START + MS)
    node.hear("b", START, 1.0)
    node.hear("a", START + 10 * MS, math.nan, at=START + 11 * MS)
    node.hear("b", START + 10 * MS, 2.0)
    node.hear("a", START + 20 * MS, 3.0, at=START + 21 * MS)
    node.hear("b", START + 20 * MS, 3.0)
    assert [*SEEN] == [(0, 1.0, 1.0, None, 0), (10 * MS, "refused"), (20 * MS, 3.0, 3.0, None, 0)]
    node.hear("b", START + 900 * SECOND, 3.0)
    node.hear("b", START - 900 * SECOND, 3.0)
    assert [node.rows[n].refused for n in "abc"] == [1, 2, 0]
    assert node.rows["b"].last_refusal == "stamp is -900 s from now, expected at most 1 s"
    assert len(SEEN) == 3  # these messages belong to no tick, so they start none
    node.hear("b", 0, 0.0, data=b"\0\1\0\0")
    node.hear("a", START + 30 * MS, 3.0, at=START + 31 * MS)
    node.hear("b", START + 30 * MS, 3.0)
    assert SEEN[-1] == (30 * MS, "refused")


# ---- accepted stamps and their ages ----


@pytest.mark.parametrize(("off", "text"), [(1001, "+1"), (-1001, "-1"), (1000, ""), (-1000, "")])
def test_a_stamp_is_accepted_within_a_second_of_now(off, text):
    node = three(time=START)
    node.hear("a", START + off * MS, 1.0, at=START)
    message = f"stamp is {text} s from now, expected at most 1 s" if text else ""
    assert node.rows["a"].last_refusal == message
    wide = three(time=START, stamp_window=2.5)
    wide.hear("a", START + off * MS, 1.0, at=START)
    assert not wide.rows["a"].refused


def test_a_controller_started_alone_begins_with_the_first_message_and_learns_the_periods_of_others():
    node = Node(Law(), time=START + 7 * MS).join()
    assert node.adapter.epoch == 0
    node.hear("a", START, 1.0)
    assert node.adapter.epoch == START
    node.hear("b", START - MS, 1.0)
    assert [*SEEN] == [(0, 1.0, 1.0, None, 0)]
    node.hear("a", START + 10 * MS, 2.0, at=START + 14 * MS)  # the period of b is not known yet
    assert SEEN[-1] == (10 * MS, 2.0, 1.0, None, 0)
    node.hear("b", START + 9 * MS, 2.0)
    node.hear("a", START + 20 * MS, 3.0, at=START + 24 * MS)
    assert len(SEEN) == 2  # its period is now known to be 10 ms, so the row waits for it
    node.hear("b", START + 19 * MS, 3.0)
    assert SEEN[-1] == (20 * MS, 3.0, 3.0, None, 0)
    node.hear("c", 0, 9.0)
    node.hear("a", START + 30 * MS, 4.0, at=START + 34 * MS)
    node.hear("b", START + 29 * MS, 4.0)
    assert SEEN[-1] == (30 * MS, 4.0, 4.0, 9.0, 0)
    node.hear("a", 0, 5.0, at=START + 44 * MS)  # a message without a stamp is stamped on arrival
    node.hear("b", 0, 5.0)
    assert SEEN[-1] == (40 * MS, 5.0, 5.0, 9.0, 0)
    assert node.adapter.record.topics[:4] == [
        ("u", "sensor_msgs/msg/JointState"),
        ("a", "sensor_msgs/msg/JointState"),
        ("b", "sensor_msgs/msg/JointState"),
        ("c", "sensor_msgs/msg/JointState"),
    ]
    kept = [(number, (t - START) // MS) for number, t, _ in node.kept.published]
    inputs = [k for k in kept if k[0]]
    assert inputs == [(1, 0), (2, 0), (1, 10), (2, 20), (1, 20), (2, 20), (3, 30), (1, 30), (2, 30), (1, 40), (2, 40)]
    assert [k for k in kept if not k[0]] == [(0, 10 * k) for k in range(5)]


def test_a_message_is_stale_after_five_periods_or_as_many_of_its_sender_which_is_reported_once():
    for every, limit in (("0.01", 0.05), ("0.04", 0.2)):
        links = {"base": "0.01", "inputs": {"a": linked(), "b": linked(every)}}
        node = Node(Law(), links, epoch=START, patience=0.0).join()
        node.hear("a", START, 1.0, at=START + MS)
        node.hear("b", START, 1.0)
        timer = next(t for t in node.hand.timers if t.call.__name__ == "_give_up")
        for k in range(1, 40):
            node.hear("a", START + k * 10 * MS, 1.0, at=START + (k * 10 + 1) * MS)
            timer.call()
            silent = k * 0.01 > limit + 1e-9
            assert node.drive.senders.stale == ({"b"} if silent else set()), k
        text = f"no message on b for {limit:g} s: the last one is held"
        assert node.reports()["stale b"] == f"ERROR {text} (1)"
        node.hear("b", START + 400 * MS, 1.0, at=START + 401 * MS)
        assert node.reports()["recovered b"] == "WARN messages are back (1)"
        assert node.drive.senders.stale == set()


def plant(links=None, **options):
    node = Node(Lag(period=0.01), links, **options)
    return node.join()


def test_a_plant_holds_a_command_until_it_is_stale_and_then_uses_the_safe_one():
    """For its time limit, or five of its periods; the command is held in the meantime, whatever its stamp."""
    for watchdog, periods in ((0.0, 5), (0.03, 3)):
        node = plant(epoch=START, watchdog=watchdog)
        timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
        node.hand.time = START
        timer.call()
        node.hear("command", START, 5.0, at=START + 10 * MS)
        applied = []
        for k in range(1, 9):
            node.hand.time = START + k * 10 * MS
            timer.call()
            applied.append(node.adapter.step.x.u)
        assert applied == [5.0] * (1 + periods) + [0.0] * (7 - periods)
        text = f"no command on lag/command for {watchdog or 0.05:g} s: safe input"
        assert node.reports() == {"stale lag/command": f"ERROR {text} (1)"}
        node.hear("command", START, 4.0, at=START + 95 * MS)  # a second message with the same stamp
        assert node.rows["command"].late == 1
        node.hear("command", START + 90 * MS, 4.0)
        assert node.reports()["recovered lag/command"] == "WARN commands are back (1)"


def test_optional_values_of_a_plant_hold_forever_and_rejected_ones_change_nothing():
    node = plant(epoch=START, time=START)
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    timer.call()
    node.hear("command", START, 1.0)
    node.hear("offset", 0, 0.5)
    node.hear("offset", 0, math.nan)
    for k in range(1, 4):
        timer_at(node, timer, k)
    assert node.adapter.step.x.u == 1.5
    assert node.rows["offset"].refused == 1
    assert not node.adapter.step.bad


def timer_at(node, timer, k, late=0):
    node.hand.time = START + k * 10 * MS + late
    timer.call()


# ---- ticks by a timer ----


def test_timer_ticks_follow_the_grid_and_missed_ones_are_counted_and_skipped_after_a_pause():
    node = plant(epoch=START, time=START)
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    assert timer.asked == [(MS, 0), None, (MS, 0)]
    states = lambda: len(node.published("lag/state"))  # noqa: E731
    timer_at(node, timer, 0, 3 * MS)
    assert (timer.now, states(), node.adapter.ticks) == ((7 * MS, 10 * MS), 1, 1)
    timer_at(node, timer, 0, 4 * MS)  # a second call at the same tick
    assert (timer.now, states()) == ((6 * MS, 10 * MS), 1)
    timer_at(node, timer, 1)
    assert (timer.now, states()) == ((10 * MS, 10 * MS), 2)
    timer_at(node, timer, 4, 2 * MS)  # the plant moves over all missed ticks and publishes only the newest
    assert (states(), node.drive.missed, node.drive.t) == (3, 2, 40 * MS)
    assert node.drive.counts() == {"missed_deadlines": 2}
    node.adapter.step.x = node.adapter.step.x._replace(x=1.0)
    timer_at(node, timer, 104)  # after a pause of one second all missed ticks are computed
    assert node.adapter.step.x.x == pytest.approx(0.99**100)
    assert (node.drive.missed, node.drive.skipped) == (101, 0)
    node.adapter.step.x = node.adapter.step.x._replace(x=1.0)
    timer_at(node, timer, 205, 11 * MS)  # after a longer pause they are skipped
    assert node.adapter.step.x.x == pytest.approx(0.99)
    assert (node.drive.missed, node.drive.skipped) == (202, 101)
    assert node.drive.counts() == {"missed_deadlines": 202, "skipped_periods": 101}
    node.adapter.state = "done"
    timer.call()
    assert timer.now is None
    figures = node.drive.statistics()
    assert "late_ticks" not in figures
    assert figures["lateness_max_ms"] == 3.0
    assert figures["jitter_ms"] == figures["lateness_p99_ms"] - figures["lateness_p50_ms"]
    assert "round_trip_max_ms" not in figures


def test_a_tick_that_begins_when_the_next_is_due_is_late_and_a_round_trip_lasts_from_output_to_command():
    node = plant(epoch=START, time=START)
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    for k, late in ((0, 0), (1, 0)):
        timer_at(node, timer, k, late)
    node.drive.tick(2, 20 * MS, START + 30 * MS - 1)
    node.drive.tick(3, 30 * MS, START + 40 * MS)
    assert node.drive.statistics()["late_ticks"] == 1
    node.hand.time = START + 41 * MS
    node.drive.tick(4, 40 * MS, START + 41 * MS)
    # The test's clock still showed 10 ms when this tick was published.
    node.hear("command", START + 30 * MS, 1.0, at=START + 43 * MS)
    node.hear("command", START + 35 * MS, 1.0)  # this stamp belongs to no tick of the node
    node.hear("command", START + 40 * MS, 1.0, at=START + 44 * MS)
    figures = node.drive.statistics()
    assert {k: v for k, v in figures.items() if k.startswith("round")} == {
        "round_trip_p50_ms": 33.0,
        "round_trip_p99_ms": 33.0,
        "round_trip_max_ms": 33.0,
    }


def test_a_run_ends_with_its_last_tick_or_a_second_after_it():
    node = plant(epoch=START, time=START, duration=0.03)
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    for k in range(4):
        assert node.adapter.state == "running"
        timer_at(node, timer, k)
    assert (node.adapter.state, node.adapter.ticks) == ("done", 4)
    held = plant(epoch=START, time=START, duration=0.03)
    timer = next(t for t in held.hand.timers if t.call.__name__ == "_tick")
    timer_at(held, timer, 9)  # the first call after the end of the run
    assert (held.adapter.state, held.drive.t, held.adapter.ticks) == ("done", 30 * MS, 1)
    law = Node(Law(), {"base": "0.01", "inputs": {"a": linked(), "b": linked()}}, epoch=START, duration=0.03).join()
    law.hand.time = START + 1030 * MS
    law.drive.progress()
    assert law.adapter.state == "running"
    law.hand.time += 1
    law.drive.progress()
    assert law.adapter.state == "done"


def test_a_process_that_stood_over_the_end_answers_its_last_tick_before_it_ends():
    node = plant(epoch=START, time=START, duration=0.03)
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    timer_at(node, timer, 0)
    node.hand.time = START + 3 * SECOND
    node.drive.progress()
    assert (node.adapter.state, node.drive.t, node.adapter.ticks, node.drive.missed) == ("done", 30 * MS, 2, 2)
    law = three(time=START, duration=0.05)
    for name in ("a", "b"):
        law.hear(name, START, 1.0)
    assert (law.drive.t, law.drive.missed) == (0, 0)
    law.hand.time = START + 3 * SECOND
    law.drive.progress()
    assert (law.adapter.state, law.drive.missed) == ("done", 5)


def test_a_source_publishes_its_ticks_from_the_next_point_of_the_grid_on():
    node = Node(Source(period=0.01), time=START + 4 * MS).join()
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    timer.call()
    assert (node.adapter.epoch, node.adapter.ticks) == (START + 10 * MS, 0)
    timer_at(node, timer, 1)
    assert (node.adapter.ticks, len(node.published("lag/reference"))) == (1, 1)
    timer_at(node, timer, 4)
    assert (node.adapter.block.unanswered, node.drive.missed) == (2, 2)


class Fails(Block[LawParams]):
    """Raises the given error."""

    OUTPUTS = (command("u", "u", ["q"], "N"),)
    error = ArithmeticError("no")

    def update(self, x, t):
        if t >= 10 * MS:
            raise self.error
        return x, {"u": (3.0,)}


@pytest.mark.parametrize(
    ("error", "ends"), [(ArithmeticError("no"), False), (ValueError("no"), False), (KeyError("no"), True)]
)
def test_a_controller_that_overflows_publishes_the_last_value_and_an_error_in_it_ends_the_run(error, ends, capsys):
    block = Fails()
    block.error = error
    node = Node(block, epoch=START, time=START).join()
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    for k in range(3):
        timer_at(node, timer, k)
    assert node.adapter.state == ("failed" if ends else "running")
    port = node.adapter.outgoing.outputs[0].layout
    zero = [] if ends else [port.encode(START + k * 10 * MS, (0.0,)) for k in (1, 2)]
    assert node.published("u") == [port.encode(START, (3.0,)), *zero]
    if not ends:
        assert node.reports()["failed"].startswith("ERROR failed at t = 0.02 s: ")
        assert node.reports()["failed"].endswith("; safe output (2)")
    assert node.adapter.ticks == (1 if ends else 3)


class Waits(Lag):
    AWAITS_COMMAND = True


def test_a_plant_started_alone_that_waits_for_a_command_stays_at_t_0_and_reports_it():
    node = Node(Waits(period=0.01), time=START + 3 * MS).join()
    assert node.hand.logs == ["OK stays at t = 0 until it is commanded on lag/command"]
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    for k in range(1, 4):
        timer_at(node, timer, k)
        assert (node.adapter.epoch, node.drive.t) == (START + k * 10 * MS, 0)
    node.hear("command", START + 30 * MS, 2.0, at=START + 35 * MS)
    timer_at(node, timer, 4)
    assert (node.adapter.epoch, node.drive.t, node.adapter.step.x.u) == (START + 30 * MS, 10 * MS, 2.0)


def test_the_aim_of_the_next_tick_is_as_expected():
    timer = Hand().timer(1, lambda: None)
    for schedule, t, due, asked in (
        (Schedule("0.01"), 25 * MS, 20 * MS, (5 * MS, 10 * MS)),
        (Schedule("0.01"), 30 * MS, 30 * MS, (10 * MS, 10 * MS)),
        (Schedule("1/300"), 3_333_332, 0, (1, 3_333_333)),
        (Schedule("1/300"), 3_333_333, 3_333_333, (3_333_334, 3_333_333)),
    ):
        assert newest(timer, schedule, t) == due
        assert timer.now == asked


# ---- lasting conditions are reported repeatedly ----


def test_a_lasting_silence_is_reported_every_ten_seconds():
    node = plant(epoch=START, time=START)
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    timer_at(node, timer, 0)
    node.hear("command", START, 1.0)
    for k in range(10):
        timer_at(node, timer, k)
    text = "ERROR no command on lag/command for 0.05 s: safe input"
    messages = []
    for tenth in range(250):
        node.hand.time = START + tenth * SECOND // 10
        node.drive.progress()
        messages += [tenth] * (len(node.hand.logs) - len(messages))
    assert messages == [101, 202]
    assert node.hand.logs == [text, text]


def test_a_controller_that_receives_nothing_from_a_present_node_reports_it_every_ten_seconds():
    node = three(time=START)
    node.rows["a"].matched(1)
    messages = []
    for tenth in range(250):
        node.hand.time = START + tenth * SECOND // 10
        node.drive.progress()
        messages += [tenth] * (len(node.hand.logs) - len(messages))
    assert messages == [101, 202]
    text = "ERROR has received nothing on a for 10 s, though it is published"
    assert node.hand.logs == [text, text]
    node.rows["b"].matched(1)
    node.rows["a"].matched(0)
    node.hand.time += 10 * SECOND
    node.drive.progress()
    assert node.hand.logs[2:] == [text.replace(" a ", " b ")]


# ---- several publishers of one topic ----


def test_a_second_writer_is_accepted_after_it_alone_has_published_without_a_gap():
    """Each message: number, time, whether a writer is accepted after it; a gap counts from 10 on."""
    for text in (
        [(5, 0, False), (6, 10, False), (7, 11, True), (8, 12, True)],
        # Number 6 was lost, so another publisher may exist.
        [(5, 0, False), (7, 9, False), (8, 19, False), (9, 20, True)],
        # Number 6 arrived twice, so there are two publishers.
        [(5, 0, False), (6, 11, True), (6, 12, False), (7, 99, False)],
        [(5, 0, False), (3, 1, False), (4, 99, False)],
        [(None, 0, False), (1, 50, False), (2, 99, False)],
        [(1, 0, False), (None, 1, False), (2, 99, False)],
    ):
        rivals = Rivals()
        for number, now, alone in text:
            rivals.receive(number, now, 10)
            assert rivals.alone is alone, (text, number)
        rivals.change()
        assert not rivals.alone
        for number, now in ((1, 100), (2, 111)):
            rivals.receive(number, now, 10)
        assert rivals.alone


def test_neither_of_two_controllers_is_accepted_until_one_has_been_silent_for_a_second():
    node = plant(epoch=START, time=START)
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    row = node.rows["command"]
    node.hand.matched["lag/command"](1)
    node.hear("command", START, 3.0)
    timer_at(node, timer, 0)
    timer_at(node, timer, 1)
    assert node.adapter.step.x.u == 3.0
    node.hand.writers["/lag/command"] = ["two", "one"]
    node.hand.matched["lag/command"](2)
    assert (row.disputed, node.adapter.values["command"], row.arrived) == (True, (0.0,), None)
    assert row.last_refusal == "2 publishers at the same time (one, two), expected one"
    node.hear("command", START + 20 * MS, 4.0, at=START + 20 * MS)
    timer_at(node, timer, 2)
    assert node.adapter.step.x.u == 0.0
    assert row.refused == 2
    for k in range(102):
        row.numbered(k + 1)
        assert row.disputed is (k < 101)
        node.hand.time += 10 * MS
    text = "of 2 publishers only one has published for 1 s: accepted"
    assert node.reports()["rivals lag/command"] == f"WARN {text} (1)"
    node.hear("command", node.hand.time, 4.0)
    assert node.adapter.values["command"] == (4.0,)
    node.hand.matched["lag/command"](1)
    assert not row.disputed
    row.numbered(5)
    assert not row.disputed


# ---- sporadic publishers ----


def test_a_controller_waits_for_the_acknowledgement_of_a_sporadic_sender():
    links = {"base": "0.01", "inputs": {"a": linked(), "b": linked(sporadic=True, reports_silence=True)}}
    node = Node(Law(), links, epoch=START).join()
    row, tick = node.rows["b"], node.hand.callbacks["/other/tick"]
    assert type(row).__name__ == "Sporadic"
    write = TickWriter()

    def acknowledge(t, *ports):
        tick(write(START + t * MS, ports))

    def answered():
        return [seen[0] // MS for seen in SEEN]

    node.hand.time = START + MS
    node.hear("a", START, 1.0)
    assert not SEEN
    acknowledge(0, "other")  # the sender acknowledges its tick without a message on `out`
    assert [*SEEN] == [(0, 1.0, 0.0, None, 0)]
    assert row.held_stamp() is None
    acknowledge(10, "out")  # the message itself arrives later
    node.hear("a", START + 10 * MS, 2.0)
    assert answered() == [0]
    node.hear("b", START + 10 * MS, 7.0)
    assert SEEN[-1] == (10 * MS, 2.0, 7.0, None, 0)
    assert row.held_stamp() == 10 * MS
    arrived, node.hand.time = row.arrived, node.hand.time + 1
    acknowledge(10, "out")  # the message is repeated
    acknowledge(10)
    assert row.arrived == arrived
    acknowledge(20)
    node.hear("b", START + 30 * MS, 8.0)
    node.hear("a", START + 20 * MS, 3.0)
    assert SEEN[-1] == (20 * MS, 3.0, 7.0, None, 0)
    node.hear("a", START + 30 * MS, 4.0)
    assert SEEN[-1] == (30 * MS, 4.0, 8.0, None, 0)
    acknowledge(30, "out")
    node.hear("a", START + 40 * MS, 5.0)
    acknowledge(40, "out")
    acknowledge(50)
    assert answered()[-1] == 30
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_give_up")
    timer.call()
    assert SEEN[-1] == (40 * MS, 5.0, 8.0, None, 0)
    node.hear("a", START + 50 * MS, 6.0)
    assert SEEN[-1] == (50 * MS, 6.0, 8.0, None, 0)  # after one timeout the node no longer waits for b
    acknowledge(5000_000)
    assert node.adapter.paces[0].refused == 1
    node.adapter.state = "done"
    acknowledge(60)
    node.hear("a", START + 60 * MS, 6.0)
    assert answered()[-1] == 50


def test_a_message_of_a_sporadic_sender_is_valid_before_its_tick_is_acknowledged_and_until_the_next():
    links = {"base": "0.01", "inputs": {"a": linked(), "b": linked("0.02", sporadic=True, reports_silence=True)}}
    node = Node(Law(), links, epoch=START).join()
    node.hear("b", START, 7.0, at=START + MS)
    for k in range(3):
        node.hear("a", START + k * 10 * MS, 1.0)
    assert [(t // MS, b) for t, _, b, *_ in SEEN] == [(0, 7.0), (10, 7.0)]
    node.hand.callbacks["/other/tick"](TickWriter()(START + 20 * MS, []))
    assert SEEN[-1] == (20 * MS, 1.0, 7.0, None, 0)


def test_a_rig_begins_when_the_acknowledging_node_has_joined_too():
    links = {
        "base": "0.01",
        "inputs": {"a": linked(), "b": linked(sporadic=True, reports_silence=True)},
        "starter": "node",
        "starts": ["node", "other"],
        "grid": "0.01",
    }
    node = Node(Law(), links).join()
    assert node.drive.departure.handshake.absent() == [
        f"no publisher on {topic} (expected from other)" for topic in ("a", "b", "/other/tick")
    ]
    assert Node(Law(), links).join(["other"]).drive.departure.handshake.absent()[2:] == []


# ---- messages without a stamp, and messages of nodes in the same process ----


class Counts(Block[LawParams]):
    """Publishes what it has received of an array and of a state."""

    INPUTS = (array("a", "a", {"q": 1}, "m"), joint_state("b", "b", ["q"], position="m"))
    OUTPUTS = (command("u", "u", ["q"], "N"),)

    def update(self, x, t, a, b):
        SEEN.append((t // MS, a[0], b[0]))
        return x, {"u": (a[0],)}


@pytest.mark.parametrize(("every", "waits"), [("0.01", True), ("0.02", False)])
def test_an_array_belongs_to_the_tick_at_which_it_arrives_and_the_newest_of_a_slower_sender_is_used(every, waits):
    node = Node(Counts(), {"base": "0.01", "inputs": {"a": linked(every), "b": linked()}}, epoch=START).join()
    node.hear("a", 0, 1.0, at=START + MS)
    node.hear("b", START, 0.5)
    assert [*SEEN] == [(0, 1.0, 0.5)]
    node.hear("b", START + 10 * MS, 1.5, at=START + 11 * MS)
    assert len(SEEN) == (1 if waits else 2)
    node.hear("a", 1, 2.0, at=START + 12 * MS)
    assert SEEN[-1] == (10, 2.0 if waits else 1.0, 1.5)
    node.hear("a", 4, 3.0, at=START + 21 * MS)
    node.hear("a", 4, 4.0)
    node.hear("b", START + 20 * MS, 2.5)
    assert SEEN[-1] == (20, 3.0, 2.5)
    assert (node.rows["a"].lost, node.rows["a"].refused, node.drive.counts()["lost_arrays"]) == (2, 1, 2)
    assert node.rows["a"].last_refusal == "number 4 from other, expected 5 (already there)"


def test_a_message_of_a_node_in_the_same_process_is_stored_as_one_over_dds():
    node = three()
    row, used = node.rows["a"], []
    node.drive.senders.on_value = lambda *text: used.append(text[1:])
    tell = row.receiver(None, False)
    tell(START + 10 * MS, (1.0,), START + 11 * MS)
    assert used == [(START + 10 * MS, START + 10 * MS, (1.0,), START + 11 * MS)]
    assert (row.stamp, row.arrived, row.recent[-1]) == (START + 10 * MS, START + 11 * MS, (START + 10 * MS, (1.0,)))
    tell(START + 20 * MS, None, START + 21 * MS)  # an acknowledged tick without a message is not forwarded
    assert len(used) == 1
    row.receiver((1, 0), False)(START + 30 * MS, (1.0, 2.0), START + 31 * MS)
    assert used[-1][2] == (2.0, 1.0)
    tell(START + 40 * MS, Sample(35 * MS, (3.0,)), START + 41 * MS)
    assert used[-1][:3] == (START + 40 * MS, START + 40 * MS, (3.0,))
    row.receiver(None, True)(START + 50 * MS, (math.nan,), START + 51 * MS)
    assert (row.refused, row.last_refusal, row.bad) == (
        1,
        "q/position is nan, expected a finite number",
        START + 50 * MS,
    )
    assert len(used) == 3
    row.receiver(None, True)(START + 60 * MS, (4.0,), START + 61 * MS)
    assert used[-1][2] == (4.0,)
    row.local, row.outside = True, 1  # another process has a publisher as well
    tell(START + 70 * MS, (5.0,), START + 71 * MS)
    assert (len(used), row.refused) == (4, 2)
    late = Node(Lag(period=0.01), epoch=START).join()
    command_row = late.rows["command"]
    command_row.receiver(None, True)(START, (math.inf,), START + MS)
    # a plant ignores an invalid command and waits for a valid one
    assert (command_row.refused, command_row.bad) == (1, None)
    begun = Node(Law(), {"base": "0.01", "inputs": {"a": linked(), "b": linked()}}).join()
    begun.rows["a"].receiver(None, False)(START + 13 * MS, (1.0,), START + 14 * MS)
    assert begun.adapter.epoch == START + 10 * MS
    delayed = Node(Delays(), epoch=START).join()
    delayed.rows["d"].receiver(None, False)(START + 20 * MS, (1.0,), START + 31 * MS)
    assert delayed.rows["d"].recent[-1] == (START + 30 * MS, Sample(20 * MS, (1.0,)))
    delayed.rows["d"].receiver(None, False)(START + 20 * MS, Sample(7 * MS, (2.0,)), START + 41 * MS)
    assert delayed.rows["d"].recent[-1] == (START + 40 * MS, Sample(7 * MS, (2.0,)))


class Delays(Block[LawParams]):
    INPUTS = (joint_state("d", "d", ["q"], position="m", delayed=True),)
    OUTPUTS = (command("u", "u", ["q"], "N"),)

    def update(self, x, t, d):
        return x, {"u": d.data}


def test_nodes_of_one_process_with_external_subscribers_receive_each_others_messages_after_the_current_call():
    links = {"base": "0.01", "inputs": {"state": linked(), "reference": linked()}}
    source = Adapter(Hand("source", START), Source(period=0.01), RunOptions(mode="realtime", epoch=START))
    law = Adapter(
        Hand("law", START),
        Gain(period=0.01),
        RunOptions(mode="realtime", epoch=START, links=Links(**links).model_dump_json()),
    )
    Group([source, law])
    hand, other = source.middleware, law.middleware
    tick = next(t for t in hand.timers if t.call.__name__ == "_tick")
    for k in range(2):
        hand.time = other.time = START + k * 10 * MS
        tick.call()
        (received,) = hand.posted
        hand.posted.clear()
        assert law.ticks == k
        other.callbacks["lag/state"](STATE.layout().encode(hand.time, (1.0, 0.0)))
        assert law.ticks == k
        received()
        assert law.ticks == k + 1
    assert other.published["lag/command"][1] == COMMAND.layout().encode(START + 10 * MS, (2.0 * (0.01 - 1.0),))
    assert len(hand.published["lag/reference"]) == 2  # also published to other nodes


# ---- a rig whose clock a user holds ----


def test_the_clock_stops_at_the_next_tick_and_continues_from_there():
    """Texts: how far it is ahead of the wall clock, and between which times it stops; a twentieth of a second ahead."""
    hand, clocks, messages = Hand(time=START), [], []
    hold = Hold(paced=False)
    node = SimpleNamespace(middleware=hand, hold=hold, epoch=START - 20 * MS, schedule=Schedule("0.01"))
    stand = Stand(node, clocks.append)
    stand.serve(messages.append)
    assert not messages
    assert hold.ask("pause") == (True, "paused")
    hand.posted.pop()()
    until = START + LEAD + 10 * MS
    assert messages == [[f"ahead={0}", f"from={START}", f"until={until}"]]
    clock = clocks[-1]
    for wall, rig in ((0, 0), (30 * MS, 30 * MS), (60 * MS, 60 * MS), (61 * MS, 60 * MS), (SECOND, 60 * MS)):
        hand.time = START + wall
        assert clock() - START == rig
    hold.ask("step", 3)
    hand.posted.pop()()
    now = until
    assert messages[-1] == [f"ahead={now - hand.time - LEAD}", f"from={now}", f"until={now + 30 * MS}"]
    clock, wall = clocks[-1], hand.time
    for past, rig in ((0, 0), (LEAD, 0), (LEAD + 10 * MS, 10 * MS), (LEAD + 40 * MS, 30 * MS)):
        hand.time = wall + past
        assert clock() - now == rig
    hold.ask("resume")
    hand.posted.pop()()
    now += 30 * MS
    assert messages[-1] == [f"ahead={now - hand.time - LEAD}", f"from={now}", f"until={NEVER}"]
    hand.time += LEAD + 5 * MS
    assert clocks[-1]() == now + 5 * MS
    before = len(clocks)
    for words in ((), ("ahead=1", "from=2"), ("until=",), ("12345",)):
        stand.receive(words)
    assert len(clocks) == before
    assert (NEVER, LEAD) == (2**63 - 1, 50 * MS)


def test_a_rig_that_is_paused_at_the_start_stays_at_t_0_and_follows_the_clock_of_the_starter():
    hand, clocks, messages = Hand(time=START), [], []
    node = SimpleNamespace(
        middleware=hand, hold=Hold(held=True, paced=False), epoch=START + 500 * MS, schedule=Schedule("0.01")
    )
    stand = Stand(node, clocks.append)
    stand.follow(7 * SECOND)
    assert clocks[-1]() == START + 7 * SECOND
    stand.follow(-7 * SECOND)
    stand.serve(messages.append)
    assert messages == [["ahead=0", f"from={START}", f"until={START + 500 * MS}"]]
    assert not hand.timers  # no node waits, so no timer is needed


# ---- several nodes of a process on one timer, and the status of an adapter ----


def test_a_node_reports_its_status():
    node = plant(epoch=START, time=START, status="x")
    timer = next(t for t in node.hand.timers if t.call.__name__ == "_tick")
    timer_at(node, timer, 0)
    node.hear("command", START, math.nan)
    node.hear("command", START, math.nan)
    status = node.adapter.account.status()
    assert status["refused"] == {"lag/command": [2, "u/effort is nan, expected a finite number"]}
    assert {
        k: status[k] for k in ("state", "t", "ticks", "error", "waits_for", "lacking", "epoch", "busy", "held")
    } == {
        "state": "running",
        "t": 0,
        "ticks": 1,
        "error": "",
        "waits_for": [],
        "lacking": [],
        "epoch": START,
        "busy": False,
        "held": False,
    }
    assert "peak_memory_mb" not in status
    assert (status["missed_deadlines"], status["prompt"], status["processor"], status["pace"]) == (0, False, None, 0.0)
    assert len(node.hand.logs) == 1  # the second rejection is not logged again
    node.adapter.fail("broken")
    node.adapter.fail("broken more")
    status = node.adapter.account.status()
    assert (status["state"], status["error"]) == ("failed", "broken")
    assert status["peak_memory_mb"] > 1.0
    assert "figures" not in status


def test_an_error_of_a_block_ends_the_run_without_the_name_of_the_node(capsys):
    node = plant(epoch=START, time=START)
    error = RunError("node: failed at t = 0 s: no")
    error.__cause__ = ArithmeticError("no")
    node.adapter.broke(error)
    assert (str(node.adapter.error), node.adapter.state) == ("failed at t = 0 s: no", "failed")
    assert capsys.readouterr().err == ""
    other = plant(epoch=START, time=START)
    error.__cause__ = KeyError("mistake")
    other.adapter.broke(error)
    assert "KeyError: 'mistake'" in capsys.readouterr().err
    assert isinstance(Gain(), Block)
    assert issubclass(Lag, Plant)
    assert Level.OK < Level.ERROR


# ---- nodes of one process that read only each other ----


class Beats:
    """Nodes whose ticks are triggered together; the first one has the time."""

    def __init__(self, periods, clock="0.01"):
        self.hand, self.calls = Hand(time=START), []
        self.nodes = []
        for k, period in enumerate(periods):
            node = SimpleNamespace(
                schedule=Schedule(period, clock), middleware=self.hand, epoch=START, state="starting"
            )
            tick = lambda number, t, now, k=k: self.calls.append((k, number, t // MS, (now - START) // MS))  # noqa: E731
            drive = SimpleNamespace(node=node, clock=self.hand.now, tick=tick, follow=self.follows)
            drive.commanded = lambda stamp, now, k=k: self.calls.append(("commanded", (stamp - START) // MS))
            self.nodes.append(drive)
        self.begins = []
        self.law, self.row = SimpleNamespace(t=0), SimpleNamespace(fed=lambda now: self.calls.append("fed"))
        Beat(self.nodes, [(self.law, self.row, self.nodes[0])], SimpleNamespace(active=False, begins=lambda k: False))
        (self.timer,) = self.hand.timers

    def follows(self, begun, newest):
        self.begins.append(begun)

    def begin(self):
        for drive, begun in zip(self.nodes, self.begins, strict=True):
            drive.node.state = "running"
            begun()

    def at(self, ms):
        """The messages published when the timer fires at a time."""
        self.hand.time = START + round(ms * MS)
        self.calls.clear()
        self.timer.call()
        return [*self.calls]


def test_nodes_of_one_process_answer_in_order_by_one_timer_and_late_ones_first():
    beats = Beats(["0.01", "0.02", "0.03"])
    assert beats.timer.asked == [(MS, 0), None]
    beats.law.t = -1
    assert beats.at(5) == []
    assert beats.timer.now is None
    beats.begin()
    assert beats.timer.asked[-1:] == [(MS, 0)]
    assert len(beats.timer.asked) == 4  # the last of the three nodes sets the timer when it has started
    assert beats.at(2) == [(0, 0, 0, 2), (1, 0, 0, 2), (2, 0, 0, 2)]
    assert beats.timer.now == (8 * MS, 10 * MS)
    assert beats.at(9.9) == []
    assert beats.at(10) == [(0, 1, 10, 10)]
    assert beats.at(41) == [
        (0, 2, 20, 41),
        (1, 1, 20, 41),
        (0, 3, 30, 41),
        (2, 1, 30, 41),
        (0, 4, 40, 41),
        (1, 2, 40, 41),
    ]
    # Up to 50 ms late all ticks are made up; after that, only the newest tick of each node.
    assert [s[1] for s in beats.at(100) if s[0] == 0] == [5, 6, 7, 8, 9, 10]
    assert beats.at(170) == [(1, 8, 160, 170), (2, 5, 150, 170), (0, 17, 170, 170)]
    beats.law.t = 180 * MS
    assert beats.at(180)[-2:] == ["fed", ("commanded", 180)]
    assert "fed" not in beats.at(190)
    for drive in beats.nodes[:2]:
        drive.node.state = "done"
    assert beats.at(200) != []
    beats.nodes[2].node.state = "done"
    assert beats.at(210) == []
    assert beats.timer.now is None


def test_nodes_slower_than_the_clock_tick_at_their_common_period():
    beats = Beats(["0.04", "0.06"], clock="0.01")
    beats.law.t = -1
    beats.begin()
    assert beats.at(0) == [(0, 0, 0, 0), (1, 0, 0, 0)]
    assert beats.timer.now == (20 * MS, 20 * MS)
    assert beats.at(20) == []
    assert beats.at(40) == [(0, 1, 40, 40)]
    assert beats.at(60) == [(1, 1, 60, 60)]


def test_nodes_tick_together_only_if_all_their_inputs_are_their_own_and_checked():
    """A node waits if it reads external nodes, by order of arrival, sporadic or unchecked messages, or has no common
    start.
    """

    def row(kind=Live, **about):
        made = object.__new__(kind)
        made.local, made.paired, made.awaited, made.schedule = True, True, True, Schedule("0.01")
        vars(made).update(about)
        return made

    def whole(*rows, unchecked=False, starter="node", epoch=0):
        node = SimpleNamespace(links=SimpleNamespace(starter=starter), options=SimpleNamespace(epoch=epoch))
        drive = SimpleNamespace(senders=SimpleNamespace(rows=[*rows]), node=node)
        link = SimpleNamespace(output=SimpleNamespace(port=SimpleNamespace(unchecked=unchecked)))
        return group_module._is_closed([drive], [link])

    free = row(local=False, paired=False, awaited=False, schedule=None)
    assert whole(row(), row(), free)
    assert whole(row(), starter="", epoch=5)
    assert not whole(row(), starter="")
    assert not whole(row(), unchecked=True)
    assert not whole(row(), row(paired=False))
    assert not whole(row(), row(Sporadic))
    assert not whole(row(), row(local=False, schedule=None))
    assert not whole(row(), row(local=False, awaited=False))
    assert not whole(free)
