"""Time, ports, answers and parameters of blocks, against independent code and expected texts.

Sources: the pages tick and scenario_file, as naive models of the contracts on lists and exact fractions.
"""

import itertools
import math
import random
from fractions import Fraction

import numpy as np
import pytest
from expected_text import check_expected
from helpers import outcome
from softrig_core import (
    Block,
    Level,
    ParameterError,
    Plant,
    Port,
    Refused,
    array,
    button,
    command,
    joint_state,
    number,
    param,
    reference,
    scalars,
    vector3,
    wrench,
)
from softrig_core.block.answer import ReceivedMessages, usual
from softrig_core.block.codec import Decoder, encoder, readable_stamp, selection
from softrig_core.block.fill import picked
from softrig_core.block.held import ByHand
from softrig_core.block.params import BlockParams, Params, build, check_steps, declarations, differing, flatten
from softrig_core.block.port import Sample, pose
from softrig_core.block.schedule import Schedule, rational
from softrig_core.wire.cdr import Layout

# time -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_a_schedule_is_a_list_of_stamps(seed):
    """Ticks k = 0, 1, ... at k periods, rounded to the nearest ns, halves up; everything else is looked up in that
    list.
    """
    rng = random.Random(seed)
    for _ in range(10):
        clock = Fraction(rng.randint(1, 40), rng.choice([1, 7, 1000, 2880, 10**6, 3 * 10**8, 10**9]))
        every, at_end, ticks = rng.randint(1, 4), rng.random() < 0.5, rng.randint(1, 24)
        period = clock * every
        ns = period * 10**9
        stamps = [math.floor(k * ns + Fraction(1, 2)) for k in range(-2, 30)]
        first = stamps[2:]
        schedule = Schedule(period, clock, ticks * clock - Fraction(1, 2 * 10**9) * rng.randint(0, 1), at_end)
        assert [schedule.time(k) for k in range(-2, 30)] == stamps
        assert [schedule.tick(t) for t in first] == list(range(30))
        assert (schedule.every, schedule.ticks) == (every, ticks)
        assert schedule.end == math.floor(ticks * clock * 10**9 + Fraction(1, 2))
        own = [k for k in range(30) if k * every < ticks + at_end]
        assert (schedule.last, schedule.count()) == (first[own[-1]], len(own))
        near = {t + d for t in first[1:-1] for d in (-1, 0, 1)} | {rng.randrange(first[-1] + 1) for _ in range(9)}
        for t in near:
            if first[0] <= t < first[-1]:
                node = max(s for s in first if s <= t)
                assert schedule.held(t) == node
                assert schedule.next(t) == min(s for s in first if s > t)
                assert schedule.due(t) == (t in first)
                assert schedule.awaited(t) == min(node, schedule.last)
                assert schedule.before(t) == max(s for s in stamps if s < t)
                assert schedule.tick(t) == math.floor(Fraction(t) / ns + Fraction(1, 2))
        begin = rng.choice(
            [0, 5, (1 << 62) // ns.numerator - 3, (1 << 61) // ns.numerator - 3, (1 << 63) // ns.numerator - 9]
        )
        begin = max(0, min(begin, math.floor((1 << 63) / ns) - 7))
        wanted = [math.floor(k * ns + Fraction(1, 2)) for k in range(begin, begin + 6)]
        result = schedule.times(begin, begin + 6)
        assert (result.dtype, result.tolist()) == (np.int64, wanted)


def test_runs_that_are_too_short_or_infinite_are_refused():
    half = Fraction(1, 2 * 10**9)
    assert Schedule("0.01", None, Fraction(1, 100) - half).ticks == 1
    assert outcome(Schedule, "0.01", None, 0.009999999).startswith("ValueError: duration 0.01 s is shorter")
    assert outcome(Schedule, "0.01", "0.02") == "ValueError: period 0.01 s is not a multiple of the 0.02 s of the clock"
    assert outcome(Schedule("0.01").count) == "ValueError: the run has no end"
    assert (Schedule("0.01").last, Schedule("0.01", None, 0.0).ticks, Schedule("0.01").awaited(10**12)) == (
        None,
        None,
        10**12,
    )


def test_the_simplest_number_between_two_is_the_first_of_all_fractions_in_order():
    """By their denominators; floats next to a fraction mean it, negative ones as well."""
    for q in range(1, 20):
        for p in range(-25, 26):
            if math.gcd(p, q) == 1 and p:
                assert rational(p / q) == Fraction(p, q)
    assert rational(3.0) == 3
    assert [rational(math.nextafter(x, toward)) for x, toward in ((3.0, 0.0), (3.0, 9.0), (-3.0, 0.0))] == [3, 3, -3]
    assert rational(-(2.0**60)) == -(2**60)
    assert (rational("1/3"), rational(Fraction(2, 7))) == (Fraction(1, 3), Fraction(2, 7))


# ports ----------------------------------------------------------------------------------------------------------------


def all_ports():
    """One port of each kind."""
    return {
        "joint_state": joint_state("a", "t", ["x", "y"], position="m", velocity=["m/s", "1"], effort="N"),
        "some fields of it": joint_state("a", "t", ["x", "y"], velocity="rad/s", safe=(1, 2)),
        "command": command("a", "t", ["u", "v"], ["V", "A"], limits=(2.0, 3.0)),
        "scalars": scalars("a", "t", {"T": "K", "p": "Pa"}, held=True),
        "reference": reference("a", "t", ["x"], position="m", velocity="m/s", acceleration="m/s^2", partial=True),
        "vector3": vector3("a", "t", "abc", "A", delayed=True),
        "vector3 of units": vector3("a", "t", "dq", ("V", "A", "1"), sporadic=True),
        "wrench": wrench("a", "t", "foot"),
        "pose": pose("a", "t", "world"),
        "array": array("a", "t", {"row": 2, "column": 3}, "m", unchecked=True),
        "array of units": array("a", "t", {"k": 2}, ("m", "rad")),
        "number": number("a", "t", "V"),
        "button": button("a", "t"),
    }


def test_ports_are_as_expected():
    lines = []
    for name, port in all_ports().items():
        flags = [f for f in ("held", "delayed", "sporadic", "partial", "unchecked", "stamped") if getattr(port, f)]
        layout = port.layout()
        lines += [
            f"{name}: {port.msgtype} on {port.topic}, {' '.join(flags) or 'plain'}",
            f"  labels {port.labels}, {port.size} values in {port.units}, frame {port.frame!r}, dims {port.dims}",
            f"  initial {port.initial}, safe {port.safe}, limits {port.limits}, squares to {port.bound:g}",
            f"  layout {layout.size} numbers, {len(layout.encode(5, (1.0,) * layout.size))} bytes",
            f"  places {port.places}, renamed {port.renamed('b').topic}, same {port.renamed('t') is port}",
        ]
    kinds = {"channels": ("x", "y"), "fields": ("position",), "units": ("m", "m")}
    for keys in (
        {"units": ("m",)},
        {"safe": (1.0,)},
        {"limits": (1.0,)},
        {"also": ("p",)},
        {"channels": (), "units": ()},
        {"fields": ()},
        {"units": ("m", "m"), "also": ("p", "q")},
    ):
        reported = outcome(Port, "a", "t", "sensor_msgs/msg/JointState", **kinds | keys)
        lines.append(f"{keys}: {reported if 'Error' in reported else 'a port'}")
    lines.append(outcome(Port, "a", "t", "std_msgs/msg/Float64", fields=("data",), units=("m",), partial=True))
    lines.append(outcome(Port, "a", "t", "std_msgs/msg/Float64", fields=("data",), units=("m",), also=("x",)))
    lines.append(outcome(Port, "a", "t", "std_msgs/msg/Float64MultiArray", fields=("data",), units=()))
    check_expected("ports", lines)


def test_a_port_accepts_finite_values_within_its_limits():
    port = all_ports()["command"]
    for value in (2.0, -2.0, 2.0000001, -2.1, math.inf, -math.inf, math.nan):
        used = math.isfinite(value) and abs(value) <= 2.0
        assert (port.beyond((value, 0.0)) == "") == used
    assert port.beyond((0.0, 3.5)) == "v/effort is 3.5 A, expected at most 3 in magnitude"
    assert all_ports()["button"].beyond((2e12,)) == "data is 2e+12 1, expected at most 1e+12 in magnitude"
    assert port.beyond((math.nan, 0.0)) == "u/effort is nan, expected a finite number"


@pytest.mark.parametrize("seed", range(4))
def test_a_message_of_one_port_is_read_by_another_by_names(seed):
    """By label; missing channels of a partial one get their safe values, and bytes give the same numbers."""
    rng = random.Random(seed)
    kinds = ("position", "velocity", "effort")
    for _ in range(25):
        channels = rng.sample("abcde", rng.randint(1, 4))
        fields = [f for f in kinds if rng.random() < 0.7] or ["effort"]
        source = joint_state("s", "t", channels, **dict.fromkeys(fields, "1"))
        partial = rng.random() < 0.4
        others = rng.sample(channels, len(channels)) + (["z"] if partial else [])
        wanted = [f for f in fields if rng.random() < 0.7] or fields
        safe = tuple(float(k) for k in range(90, 90 + len(others) * len(wanted)))
        sink = joint_state("r", "t", others, **dict.fromkeys(wanted, "1"), partial=partial, safe=safe)
        values = tuple(rng.random() for _ in source.labels)
        by_label = dict(zip(source.labels, values, strict=True))
        expected = tuple(by_label.get(label, s) for label, s in zip(sink.labels, sink.safe, strict=True))
        accept = selection(source, sink)
        assert picked(accept, values) == expected
        assert (accept is None) == (source.labels == sink.labels)
        message = source.layout().encode(1_500_000_000, values)
        decoder = Decoder(sink)
        assert [decoder(message) for _ in range(2)] == [(1_500_000_000, expected)] * 2
        assert readable_stamp(message) == 1_500_000_000


def test_arrays_are_numbered_in_the_order_of_calls():
    port = all_ports()["array of units"]
    decode = Decoder(port)
    for begin in (0, 5):
        encode = encoder(port.layout(), {"a": begin}, "a")
        assert [decode(encode(7, (float(k), 0.0))) for k in range(3)] == [
            (begin + k, (float(k), 0.0)) for k in range(3)
        ]
    plain = all_ports()["command"].layout()
    assert encoder(plain, {}, "")(7, (1.0, 2.0)) == plain.encode(7, (1.0, 2.0))
    assert decode.number(encoder(port.layout(), {"a": 9}, "a")(0, (1.0, math.nan))) == 9
    assert decode.number(b"none") == -1
    assert [readable_stamp(data) for data in (b"", b"\0\1\0\0" + b"\1" * 7, b"\0\0\0\0" + b"\1" * 8)] == [None] * 3
    assert readable_stamp(b"\0\1\0\0" + b"\xff" * 4 + b"\5\0\0\0") == -(10**9) + 5


def joints(names):
    """A message of positions; other publishers may send two channels of one name."""
    return Layout("sensor_msgs/msg/JointState", "", names, {"position": len(names)}).encode(3, (1.0, 2.0)[: len(names)])


def test_a_mismatch_is_reported_as_expected():
    two = joint_state("a", "t", ["x", "y"], position="m")
    pairs = {
        "another type": (two, number("a", "t", "m")),
        "another frame": (vector3("a", "t", "abc", "A"), vector3("a", "t", "dq", "A")),
        "a frame where none is named": (wrench("a", "t"), wrench("a", "t", "foot")),
        "another shape": (all_ports()["array"], all_ports()["array of units"]),
        "other channels": (two, joint_state("a", "t", ["x", "z"], position="m")),
        "more channels than a partial one has": (two, joint_state("a", "t", ["x"], position="m", partial=True)),
        "fields that are not filled": (two, joint_state("a", "t", ["x", "y"], effort="N")),
    }
    lines = [f"{name}: {outcome(selection, *pair)}" for name, pair in pairs.items()]
    lines += [
        f"bytes, {name}: {outcome(Decoder(sink), s.layout().encode(3, (1.0,) * s.layout().size))}"
        for name, (s, sink) in pairs.items()
        if name != "another type"
    ]
    named = joint_state("a", "t", ["x", "y"], position="m", also=("p", "q"))
    for names in (("p", "q"), ("q", "p"), ("x", "p"), ("x", "x"), ()):
        message = joints(names or ["n"])
        lines.append(f"names {names}: {outcome(Decoder(named), message)}")
    partial = joint_state("a", "t", ["x", "y"], position="m", partial=True)
    for names in (("x",), ("y", "x"), ("x", "x"), ("z",)):
        message = joints(names)
        lines.append(f"partial {names}: {outcome(Decoder(partial), message)}")
    lines.append(f"cut: {outcome(Decoder(two), two.layout().encode(3, (1.0, 2.0))[:-3])}")
    lines.append(f"too large: {outcome(Decoder(two), two.layout().encode(3, (1.0, 2e9)))}")
    check_expected("refused", lines)


# answers --------------------------------------------------------------------------------------------------------------


def test_messages_received_together_are_one_row():
    stamps, values = np.array([3, 5, 9]), np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    received, row = ReceivedMessages(stamps, values), ((3, (1.0, 2.0)), (5, (3.0, 4.0)), (9, (5.0, 6.0)))
    assert (tuple(received), len(received)) == (row, 3)
    for k in range(-3, 3):
        assert received[k] == row[k]
    for part in (slice(1, None), slice(None, None, -2), slice(0, 0)):
        assert tuple(received[part]) == row[part]
    assert type(received[0][0]) is int
    assert all(type(v) is float for _, numbers in received for v in numbers)


@pytest.mark.parametrize(
    ("values", "yes"),
    [
        ((3.0, 4.0), True),
        ((3.0, 4.1), False),
        ((), True),
        ((1, 2), False),
        ((1, 2.0), False),
        ((True, 2.0), False),
        ((math.nan,), False),
        (("x",), False),
        ((10**400,), False),
    ],
)
def test_usual_values_are_floats_with_a_sum_of_squares_below_a_bound(values, yes):
    assert usual(values, 25.0) is yes


# parameters -----------------------------------------------------------------------------------------------------------


class Inner(Params):
    bits: int = param(12, "word length", ge=2, le=16)
    word: str = param("up", "a text")


class Every(BlockParams):
    R: float = param(0.4, "resistance", "ohm", gt=0.0, lt=5.0, live=True)
    free: float = param(1.0, "no bounds", "m")
    count: int = param(3, "whole")
    on: bool = param(True, "a switch", live=True)
    names: tuple[str, ...] = param(("a",), "channels", min_length=1, max_length=3)
    row: tuple[float, ...] = param((1.0, 2.0), "numbers", "s", each=(0.0, 9.0))
    wide: tuple[float, ...] = param((), "numbers without bounds")
    maybe: float | None = param(None, "or nothing", "s", ge=-1.0)
    rig: Inner = Inner()


GIVEN = [
    {},
    {"R": 1, "rig.bits": 10, "names": ["x", "y"]},
    {"rig": {"bits": 3}, "rig.word": "down"},
    {"rig.word": "down", "rig": {"bits": 3}},
    {"R": 0.0},
    {"R": 5.0},
    {"R": math.nan},
    {"R": "x"},
    {"rig.bits": 17},
    {"rig.bits": 1},
    {"rr": 1.0},
    {"coumt": 1},
    {"rig.bitz": 3},
    {"names": []},
    {"names": list("abcd")},
    {"row": [0.0, 9.0]},
    {"row": [1.0, 9.1]},
    {"row": [-0.1]},
    {"free": 1e12},
    {"free": -1e12},
    {"free": 1.1e12},
    {"free": -1.1e12},
    {"count": 10**12 + 1},
    {"count": 10**5000},
    {"wide": [1e13]},
    {"wide": [1.0] * 10_000},
    {"wide": [1.0] * 10_001},
    {"rig.word": "x" * 98},
    {"rig.word": "x" * 99},
    {"rig.word": "x" * 10_000},
    {"rig.word": "x" * 10_001},
    {"maybe": -1.0},
    {"maybe": -1.1},
    {"on": 1},
    {"period": "1/2880"},
    {"period": "1/0"},
    {"period": 1e-9},
    {"period": 0.9e-9},
    {"period": 100.0},
    {"period": 100.1},
    {"rig": 5, "rig.bits": 8},
    {"R": 7.0, "count": 1.5},
]


def test_parameters_are_as_expected():
    lines = [
        f"{d.name} = {d.default!r}, {d.type.__name__}, {d.doc}, {d.unit!r}, {d.lower} to {d.upper}{', live' * d.live}"
        for d in declarations(Every)
    ]
    for values in GIVEN:
        short = ", ".join(f"{k} = {v if len(outcome(lambda v=v: v)) < 40 else 'much'}" for k, v in values.items())
        try:
            result = build(Every, values)
        except ParameterError as error:
            lines.append(f"{short}: {error}")
            continue
        assert build(Every, flatten(result)) == result
        new = {k: v for k, v in flatten(result).items() if v != flatten(Every())[k] and len(repr(v)) < 100}
        lines.append(f"{short}: changes {new}")
        if len(differing(result)) < 300:
            lines.append(f"  {differing(result)!r}")
    lines += [
        f"{steps} steps: {outcome(check_steps, steps / 1024, 1 / 1024, 'substep')}" for steps in (100_000, 100_001)
    ]
    check_expected("parameters", lines)


# a block and what it remembers ----------------------------------------------------------------------------------------


class Counting(Block[Every]):
    """Counts its ticks, and reports each third."""

    INPUTS, OUTPUTS = (), (scalars("out", "out", {"a": ""}),)

    def first(self):
        return (0, self.p.R)

    def go_on(self, x, before):
        return (x[0], self.p.R - before.R)

    def update(self, x, t):
        if x[0] % 3 == 2:
            self.report(Level.WARN, f"key {x[0] % 2}", f"tick {x[0]}", anew=x[0] > 5)
        if x[0] == 9:
            self.withdraw("key 1")
        return (x[0] + 1, x[1]), {"out": (float(x[0]),)}


@pytest.mark.parametrize("seed", range(5))
def test_a_rewound_block_has_its_earlier_state(seed):
    """Ticks, changes, dropped ticks, going back: against an independent list of states."""
    rng, node, kept = random.Random(seed), ByHand(Counting()), []
    count, gain, own, reports = 0, 0.4, 0.4, {}
    for _ in range(60):
        what = rng.choice(["tick", "tick", "tick", "drop", "change", "keep", "back"])
        if what == "tick":
            assert node.update(0) == {"out": (float(count),)}
            if count % 3 == 2:
                key = f"key {count % 2}"
                reports[key] = (Level.WARN, f"tick {count}", reports.get(key, (0, 0, 0))[2] + 1)
            if count == 9:
                reports.pop("key 1", None)
            count += 1
        elif what == "drop":
            node.block.report(Level.ERROR, "lost", "never told")
            node.drop()
        elif what == "change":
            own, gain = round(rng.uniform(0.1, 4.0), 3), own
            node.change(Every(R=own))
            gain = own - gain
        elif what == "keep":
            kept.append((node.save(), count, gain, own, dict(reports)))
        elif kept:
            state, count, gain, own, reports = rng.choice(kept)
            reports = dict(reports)
            node.load(state)
        assert node.x == (count, gain)
        assert (node.params.R, node.block.p.R, node.reports) == (own, own, reports)
        assert node.block.events == []
    node.reset(3)
    assert (node.x, node.reports, node.anew) == ((0, own), {}, set())


def test_reports_are_collected_by_the_caller_of_the_block():
    block = Counting()
    block.report(Level.WARN, "a", "before it is held")
    node = ByHand(block)
    assert (node.reports, block.events) == ({}, [])
    block.report(Level.WARN, "a", "first")
    block.report(Level.ERROR, "a", "second", anew=True)
    assert block.events == [(Level.WARN, "a", "first", False), (Level.ERROR, "a", "second", True)]
    node.store_reports()
    assert (node.reports, node.anew, block.events) == ({"a": (Level.ERROR, "second", 2)}, {"a"}, [])
    block.withdraw("a")
    block.withdraw("none")
    assert block.events == [(None, "a", "", False), (None, "none", "", False)]
    node.store_reports()
    assert (node.reports, block.age("any"), block.health(), block.latched(), block.markers()) == ({}, 0, {}, {}, ())


def test_a_sample_before_the_first_message_has_time_zero():
    assert all_ports()["vector3"].initial == Sample(0, (0.0, 0.0, 0.0))
    assert list(itertools.islice(all_ports()["scalars"].units, 2)) == ["K", "Pa"]
    assert issubclass(Refused, ValueError)


class Loud(Plant[BlockParams]):
    """Reports whatever it receives."""

    OUTPUTS = (scalars("out", "out", {"a": ""}),)

    def outputs(self, x, t):
        self.report(Level.WARN, "outputs", f"at {t}")
        return {"out": (1.0,)}

    def advance(self, x, t):
        self.report(Level.WARN, "advance", f"at {t}")
        return (*x, t)


def test_reports_of_a_plant_without_a_rig_are_returned_immediately():
    plant = ByHand(Loud())
    assert plant.outputs(5) == {"out": (1.0,)}
    assert plant.reports == {"outputs": (Level.WARN, "at 5", 1)}
    plant.advance(7)
    assert (plant.reports["advance"], plant.x) == ((Level.WARN, "at 7", 1), (7,))
