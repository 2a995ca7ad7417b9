"""All figures of merit against plain loops, written from their documentation.

Source of what is over time: Riemann sums over cells of 50 ms, of which all times of these records are multiples, so
that the sums are exact; of a peak: the parabola that numpy puts through three points.
"""

import math
import random
import statistics
from bisect import bisect
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from softrig_core.judge import measures
from softrig_core.wire import times
from softrig_core.wire.cdr import Layout
from softrig_core.wire.recording import Columns, Topic


def eighth(rng):
    return rng.randint(-16, 16) / 8.0  # binary fractions, so that a value on an edge is exactly on it


def records(rng):
    """A signal y and one that it may be compared with; times in tenths of a second from the same start."""
    result = {}
    for name in ("y", "r"):
        steps = [rng.randint(1, 3) for _ in range(rng.choice([1, 2, 3, 6, 12, 12]))]
        ticks = [sum(steps[:k]) for k in range(len(steps))]
        t = np.array(ticks) * 0.1  # times as in a run, where 3 * 0.1 differs from 0.3
        calm = rng.random() < 0.5  # a few values that repeat often
        result[name] = (t, np.array([rng.choice([0.0, 1.0, 2.0]) if calm else eighth(rng) for _ in ticks]))
    return result


def windows(rng):
    return [None if rng.random() < 0.6 else rng.randint(0, 30) / 20.0 for _ in range(2)]


def tick(t):
    return round(t * 1e9)


def cut(record, start, end):
    result = [
        (t, x)
        for t, x in zip(*(column.tolist() for column in record), strict=True)
        if (start is None or tick(t) >= tick(start)) and (end is None or tick(t) <= tick(end))
    ]
    if not result:
        raise ValueError
    return result


def value_at(record, t):
    """The newest value not after an instant."""
    return cut(record, None, t)[-1][1]


def errors(signals, reference, start, end):
    pairs = cut(signals["y"], start, end)
    if not isinstance(reference, str):
        return [(t, x - reference) for t, x in pairs]
    when = signals[reference][0].tolist()
    if len(pairs) > 1 and len(when) > 1 and tick(pairs[-1][0]) >= tick(2.0 * when[-1] - when[-2]):
        pairs.pop()
    return [(t, x - value_at(signals[reference], t)) for t, x in pairs]


def least_squares(points):
    return statistics.linear_regression(*zip(*points, strict=True)).slope


def growth(pairs):
    new = [pair for k, pair in enumerate(pairs) if k == 0 or pair[1] != pairs[k - 1][1]]
    peaks = []
    for three in zip(new, new[1:], new[2:], strict=False):
        side = math.copysign(1.0, three[1][1])
        a, b, c = (side * x for _, x in three)
        if a < b > c and b > 0.0:
            origin = three[1][0]
            parabola = np.polynomial.Polynomial.fit([t - origin for t, _ in three], [a, b, c], 2)
            top = float(parabola.deriv().roots()[0].real)
            peaks.append((origin + top, math.log(float(parabola(top)))))
    if len(peaks) < 3:
        raise ValueError
    return least_squares(peaks)


def settled(pairs, band, zero):
    for k in range(len(pairs), 0, -1):
        if abs(pairs[k - 1][1]) > band:
            return pairs[k][0] - zero if k < len(pairs) else math.inf
    return pairs[0][0] - zero


CELL = 50_000_000  # ns, the width of a cell


def cells(signals, reference, start, end):
    """The error in each cell in which both signals are held, and the length of the last sample in cells, for means."""
    pairs = cut(signals["y"], start, end)
    times = [tick(t) for t in signals["y"][0]]
    last, newest = tick(pairs[-1][0]), max(tick(t[-1]) for t, _ in signals.values())
    since = tick(start) if start is not None and times[0] <= tick(start) else tick(pairs[0][0])
    until = max(last, newest if end is None else min(tick(end), newest))

    def error(at):
        return value_at(signals["y"], at * 1e-9) - (
            value_at(signals["r"], at * 1e-9) if isinstance(reference, str) else reference
        )

    results = [error(at + CELL // 2) for at in range(since, until, CELL)]
    if until > last:
        return results, []
    when = [tick(t) for t in signals["r"][0]] if isinstance(reference, str) else []
    if len(pairs) > 1 and len(when) > 1 and last >= 2 * when[-1] - when[-2]:
        return results, []
    edges = sorted({t for t in [*times, *when] if since < t < until} | {since, until})
    shortest = min([b - a for a, b in pairwise(edges)], default=CELL)
    return results, [error(last)] * (shortest // CELL)


def over_time(number):
    return lambda *arguments: number([x for part in cells(*arguments) for x in part])


def held_integral(signals, reference, start, end):
    if len(cut(signals["y"], start, end)) < 2:
        raise ValueError
    return sum(abs(e) for e in cells(signals, reference, start, end)[0]) * CELL * 1e-9


def opposite(pairs):
    first = pairs[0][1]
    return max([0.0, *(abs(e) for _, e in pairs if e * first < 0.0)])


OVER_TIME = {
    "mean_error": over_time(lambda e: -statistics.fmean(e)),
    "rms": over_time(lambda e: math.sqrt(statistics.fmean(x * x for x in e))),
    "mean_square": over_time(lambda e: statistics.fmean(x * x for x in e)),
    "mean_absolute": over_time(lambda e: statistics.fmean(map(abs, e))),
    "integral_absolute": held_integral,
    "mean": over_time(statistics.fmean),
}
OF_ERRORS = {
    "peak": lambda pairs: max(abs(e) for _, e in pairs),
    "sum_absolute": lambda pairs: sum(abs(e) for _, e in pairs),
    "error_overshoot": opposite,
    "growth_rate": growth,
    "error_settling_time": settled,
}


def variation(pairs):
    if len(pairs) < 2:
        raise ValueError
    return sum(abs(b - a) for (_, a), (_, b) in pairwise(pairs)) / (pairs[-1][0] - pairs[0][0])


OF_VALUES = {
    "total_variation": variation,
    "peak_to_peak": lambda pairs: max(x for _, x in pairs) - min(x for _, x in pairs),
    "maximum": lambda pairs: max(x for _, x in pairs),
    "minimum": lambda pairs: min(x for _, x in pairs),
    "final_value": lambda pairs: pairs[-1][1],
    "reach_time": lambda pairs, level, zero: next(
        (t - zero for t, x in pairs if x == level or (x > level) != (pairs[0][1] > level)), math.inf
    ),
}


def crossing(pairs, level):
    for k, (t, z) in enumerate(pairs):
        if z >= level:
            before, low = pairs[max(k - 1, 0)]
            return t if k == 0 else before + (t - before) * (level - low) / (z - low)
    return math.inf


def rise(pairs, zero, low=0.1, high=0.9):
    if not 0.0 <= low < high:
        raise ValueError
    reached = crossing(pairs, high)
    return reached - crossing(pairs, low) if reached < math.inf else math.inf


def settling(pairs, zero, band=0.02, at="crossing"):
    if band <= 0.0:
        raise ValueError
    outside = [k for k, (_, z) in enumerate(pairs) if abs(z - 1.0) > band]
    if not outside:
        return pairs[0][0] - zero
    if outside[-1] == len(pairs) - 1:
        return math.inf
    (t, z), (after, inside) = pairs[outside[-1] : outside[-1] + 2]
    edge = 1.0 + band if z > 1.0 else 1.0 - band
    return (after if at == "sample" else t + (after - t) * (z - edge) / (z - inside)) - zero


def beyond(pairs, zero):
    return max(0.0, 100.0 * (max(z for _, z in pairs) - 1.0))


OF_STEPS = {"rise_time": rise, "settling_time": settling, "overshoot": beyond}


def compared(expected, result):
    """Check that both give the same number within rounding, or both refuse."""
    try:
        wanted = expected()
    except ValueError:
        with pytest.raises(ValueError):  # noqa: PT011
            result()
        return
    assert result() == pytest.approx(wanted, rel=1e-9, abs=1e-12)


MADE = [
    ({"y": (np.arange(9) * 0.1, np.array([0, 1, 0, 2, 1, 4, 0, 1, 0]) + 0.5)}, (None, None), 0.5, 1.0),
    ({"y": (np.arange(5) * 0.1, np.array([0.0, 9.0, 1.0, 9.0, -1.0]))}, (None, None), 0.0, 1.0),
    ({"y": (np.arange(4.0), np.arange(4.0) ** 2), "r": (np.arange(3.0), np.ones(3))}, (None, None), "r", 0.0),
    ({"y": (np.arange(2.0), np.arange(2.0)), "r": (np.array([0.0, 0.5]), np.ones(2))}, (None, None), "r", 0.0),
]


def test_figures_of_values_and_errors_are_those_of_the_loops():
    for made in MADE:
        hold_values(*made)
    for seed in range(100):
        rng = random.Random(seed)
        hold_values(records(rng), windows(rng), rng.choice(["r", 0.0, 0.5, None]), abs(eighth(rng)))


def hold_values(signals, cuts, reference, number):
    start, end = cuts
    limits = {"start": start, "end": end}
    entries = {} if reference is None else {"reference": reference}
    for name, of in OVER_TIME.items():
        messages = {} if name == "mean" else entries or ({"reference": 0.0} if name == "mean_error" else {})
        compared(
            lambda of=of, messages=messages: of(signals, messages.get("reference", 0.0), start, end),
            lambda name=name, messages=messages: getattr(measures, name)(signals, "y", **messages, **limits),
        )

    def since(pairs):
        return {"zero": pairs[0][0] if start is None else start}

    for name, of in OF_ERRORS.items():
        more = {"band": number} if name == "error_settling_time" else {}
        messages = entries

        def wanted(of=of, more=more):
            pairs = errors(signals, reference or 0.0, start, end)
            return of(pairs, **more, **(since(pairs) if more else {}))

        compared(
            wanted,
            lambda name=name, more=more, messages=messages: getattr(measures, name)(
                signals, "y", **messages, **more, **limits
            ),
        )
    for name, of in OF_VALUES.items():
        more = {"level": number} if name == "reach_time" else {}

        def of_values(of=of, more=more):
            pairs = cut(signals["y"], start, end)
            return of(pairs, **more, **(since(pairs) if more else {}))

        compared(of_values, lambda name=name, more=more: getattr(measures, name)(signals, "y", **more, **limits))


def test_figures_of_steps_are_those_of_the_loops():
    for seed in range(150):
        rng = random.Random(seed)
        hold_steps(
            records(rng),
            windows(rng),
            rng.choice([-4.0, -1.0, 0.0, 0.5, 1.0, 2.0]),
            rng.choice(["level", "signal", None]),
            rng.choice([{}, {}, {"low": 0.0, "high": 0.5}, {"low": 0.25, "high": 0.25}, {"low": -0.25, "high": 0.5}]),
            rng.choice([{}, {"band": 0.25}, {"band": 0.5, "at": "sample"}, {"band": 0.0}]),
        )


def hold_steps(signals, cuts, initial, final, levels, bands):
    start, end = cuts
    limits = {"start": start, "end": end}
    text = {"level": {"final": initial + 2.0}, "signal": {"final": "r", "initial": "r"}, None: {}}[final]
    arguments = {"initial": initial} | text if initial or final == "signal" else text

    def pairs():
        result = cut(signals["y"], start, end)
        goal, begin = result[-1][1], initial
        if final == "level":
            goal = initial + 2.0
        elif final == "signal":
            at = tick(signals["r"][0][0] if start is None else start)
            goal = value_at(signals["r"], at * 1e-9)
            begin = value_at(signals["r"], (at - 1) * 1e-9)
        if goal == begin:
            raise ValueError
        return [(t, (x - begin) / (goal - begin)) for t, x in result]

    for name, of in OF_STEPS.items():
        more = {"rise_time": levels, "settling_time": bands}.get(name, {})

        def expected(of=of, more=more):
            z = pairs()
            return of(z, z[0][0] if start is None else start, **more)

        compared(
            expected, lambda name=name, more=more: getattr(measures, name)(signals, "y", **arguments, **more, **limits)
        )


def test_a_step_over_uneven_samples_is_interpolated():
    """Crossings are on the lines between two samples, wherever these are."""
    t, y = np.array([0.0, 0.1, 0.4, 0.5, 1.0, 1.8, 2.0]), np.array([0.0, 0.05, 0.6, 0.8, 1.2, 0.9, 1.0])
    signals = {"y": (t + 3.0, 2.0 * y - 7.0)}  # the same signal, shifted and as a step of 2 from -7
    about = {"final": -5.0, "initial": -7.0}
    low, high = 0.1 + 0.3 * 0.05 / 0.55, 0.5 + 0.5 * 0.1 / 0.4
    assert measures.rise_time(signals, "y", **about) == pytest.approx(high - low)
    assert measures.rise_time(signals, "y", **about, low=0.0) == pytest.approx(high)
    assert measures.settling_time(signals, "y", **about, band=0.15) == pytest.approx(1.0 + 0.8 * 0.05 / 0.3)
    assert measures.settling_time(signals, "y", **about, band=0.15, at="sample") == pytest.approx(1.8)
    assert measures.settling_time(signals, "y", **about, band=0.05) == pytest.approx(1.8 + 0.2 * 0.05 / 0.1)
    assert measures.settling_time(signals, "y", **about, band=0.25) == pytest.approx(0.4 + 0.1 * 0.15 / 0.2)


@given(st.lists(st.integers(0, 60), min_size=1, max_size=60), st.lists(st.integers(0, 60), max_size=60))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_the_newest_of_many_instants_is_found(times, at):
    times, at = sorted(set(times)), sorted(at)
    assert measures.newest(np.array(times), np.array(at)).tolist() == [bisect(times, t) - 1 for t in at]
    assert measures.newest(np.array(times[:1]), np.array(at)).tolist() == [bisect(times[:1], t) - 1 for t in at]


@pytest.mark.parametrize("seed", range(15))
def test_the_newest_step_of_some_signals_is_found(seed):
    signals = records(random.Random(seed))
    steps = []
    for t, x in signals.values():
        k = max(k for k in range(len(t)) if k == 0 or x[k] != x[k - 1])
        steps.append((float(t[k]), float(x[k])))
    results = [measures.newest_step(signals, names) for names in ("y", "r", "y, r")]
    assert results == [*steps, steps[0] if steps[0][0] >= steps[1][0] else steps[1]]


def test_missing_arguments_are_named():
    t = np.arange(1.0, 4.0)
    signals = {"y": (t, t), "late": (t + 1.0, t), "none": (t[:0], t[:0])}
    messages = []
    for figure, name, arguments in (
        (measures.mean, "y", {"start": 5.0}),
        (measures.mean, "y", {"end": 0.5}),
        (measures.mean, "y", {"start": 2.5, "end": 1.5}),
        (measures.total_variation, "y", {"start": 3.0, "end": 3.0}),
        (measures.integral_absolute, "y", {"end": 1.0}),
        (measures.mean, "none", {}),
        (measures.peak, "y", {"reference": "late"}),
        (measures.overshoot, "y", {"initial": 3.0}),
        (measures.overshoot, "y", {"initial": "y"}),
        (measures.overshoot, "y", {"initial": "late", "start": 2.0}),
        (measures.overshoot, "y", {"final": "late", "start": 1.0}),
        (measures.overshoot, "y", {"final": "none"}),
        (measures.growth_rate, "y", {}),
        (measures.settling_time, "y", {"at": "end"}),
        (measures.settling_time, "y", {"band": -0.1}),
        (measures.rise_time, "y", {"low": 0.5, "high": 0.5}),
    ):
        with pytest.raises(ValueError) as refused:  # noqa: PT011
            figure(signals, name, **arguments)
        messages.append(str(refused.value))
    assert messages == [
        "y has 0 samples from 5 s to its end, needed 1; recorded from 1 to 3 s",
        "y has 0 samples from its begin to 0.5 s, needed 1; recorded from 1 to 3 s",
        "y has 0 samples from 2.5 s to 1.5 s, needed 1; recorded from 1 to 3 s",
        "y has 1 samples from 3 s to 3 s, needed 2; recorded from 1 to 3 s",
        "y has 1 samples, needed 2",
        "none has 0 samples from its begin to its end, needed 1; nothing is recorded",
        "late has no value yet at 1 s, where y begins",
        "y: the step from 3 to the final value has size zero",
        "y has no value before the begin of the window",
        "late has no value before the begin of the window",
        "late has no value at the begin of the window",
        "none has no value at the begin of the window",
        "y has 0 peaks between 1 and 3 s, needed 3 for a growth rate",
        "at = 'end': expected 'crossing' or 'sample'",
        "band = -0.1: expected a positive fraction of the step",
        "levels low = 0.5, high = 0.5: expected 0 <= low < high",
    ]


def test_every_figure_is_tested_and_has_no_bound_of_its_own():
    assert sorted(measures.__all__) == sorted(OVER_TIME | OF_ERRORS | OF_VALUES | OF_STEPS)
    assert {getattr(measures, name).possible for name in measures.__all__} == {(-math.inf, math.inf)}


@pytest.mark.parametrize("side", [0, 10**9])
@pytest.mark.parametrize("seed", range(8))
def test_the_newest_time_of_each_instant_is_that_of_a_plain_search(monkeypatch, side, seed):
    """Times of one period that begin earlier or later, end earlier or later, or repeat; compared by a count of each."""
    monkeypatch.setattr(measures, "SIDE_BY_SIDE", side)
    draw = np.random.default_rng(seed)
    at = np.arange(90.0)
    for first, last, shift in [(0, 90, 0.0), (0, 91, 0.999), (-3, 89, 0.5), (4, 95, 0.0), (0, 90, -0.5), (-1, 60, 0.0)]:
        times = np.arange(float(first), float(last))
        if seed:
            times[draw.integers(1, len(times) - 1, seed)] -= draw.choice([0.0, 1.0, 0.25], seed)
        times.sort()
        newest = measures.newest(times, at + shift)
        assert newest.tolist() == [int((times <= instant).sum()) - 1 for instant in at + shift]


def test_the_end_of_a_record_is_its_newest_message_in_any_order_of_its_parts():
    layout = Layout("sensor_msgs/msg/JointState", "", ["x"], {"position": 1})
    topic = Topic("a", "sensor_msgs/msg/JointState")
    assert topic.newest() is None
    topic.add_columns(Columns(np.array([1, 5]), np.zeros((2, 1)), layout))
    topic.add_columns(Columns(np.array([7]), np.zeros((1, 1)), layout))
    topic.add_columns(Columns(np.array([], np.int64), np.zeros((0, 1)), layout))
    assert topic.newest() == 7
    topic.times.append(9)
    topic.data.append(b"")
    assert topic.newest() == 9


def test_results_of_equal_times_are_computed_once(monkeypatch):
    monkeypatch.setattr(times, "_kept", times._Kept())
    calls = []

    @times.once_for_times
    def gaps(t, stop):
        calls.append(stop)
        return np.diff(t, append=stop)

    first, again, other = (times.common(np.arange(50.0) * step) for step in (1.0, 1.0, 2.0))
    assert again is first
    assert other is not first
    assert gaps(first, 50.0) is gaps(again, 50.0)
    assert gaps(first[10:], 50.0) is gaps(again[10:], 50.0)
    assert gaps(first[10:20], 50.0)[-1] == 31.0  # another slice of the same array
    assert gaps(first, 60.0)[-1] == 11.0
    assert len(calls) == 4
    assert gaps(gaps(first, 50.0), 9.0) is gaps(gaps(first, 50.0), 9.0)  # results are cached as arguments, too
    lone = np.arange(50.0)
    assert gaps(lone, 50.0) is not gaps(lone, 50.0)  # a writable array may change, so its result is not cached
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 1.0
    monkeypatch.setattr(times, "MOST", 1)
    assert times.common(np.arange(50.0)) is not first
    monkeypatch.setattr(times, "LARGEST", 1)
    big = np.arange(7.0)
    assert times.common(big) is big
    assert big.flags.writeable
