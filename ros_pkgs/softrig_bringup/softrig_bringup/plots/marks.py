"""Expectations of a signal as marks in its picture: bands and levels, instants on the time axis."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from softrig_core import Rig, SignalMap, figures_of
from softrig_core.judge import measures
from softrig_core.judge.expectation import Expectation
from softrig_core.verdict.figures import Figure
from softrig_core.verdict.requirements import Judge
from softrig_core.verdict.result import Result

Spans = tuple[tuple[float, float], ...]

BESIDE = 0.06  # share of the window by which the mark of an extreme extends to either side
TOGETHER = 0.01  # share of the window: violations that are closer are drawn as one
NAMED = 4  # more instants than this in one picture would cover it with their names


@dataclass(frozen=True)
class Mark:
    """A figure of merit where its signal shows it.

    Parameters
    ----------
    axis : {"value", "time", "violated"}
        A level of the signal, an instant, or an interval in which a requirement on the signal does not hold.
    name : str
        Of the figure.
    low, high : float
        The accepted range; infinite where there is no bound, both NaN if nothing is expected.
    published : float
        The number printed in the paper; NaN if there is none.
    start, end : float
        Where a level counts, s.
    """

    axis: Literal["value", "time", "violated"]
    name: str
    low: float = math.nan
    high: float = math.nan
    published: float = math.nan
    start: float = -math.inf
    end: float = math.inf

    @property
    def judged(self) -> bool:
        """Return whether anything is expected."""
        return not math.isnan(self.low)

    def at(self, convert: Callable[[float], float], axis: Literal["value", "time"]) -> Mark:
        """Return the mark with its figures converted to positions in the picture."""
        low, high = sorted((convert(self.low), convert(self.high)))
        return replace(self, axis=axis, low=low, high=high, published=convert(self.published))


def marks_of(rig: Rig, signals: SignalMap, results: Iterable[Result] = ()) -> dict[str, list[Mark]]:
    """Return the marks of each signal that a figure of the scenario measures.

    Only figures of `softrig_core.judge.measures` that have a place in a picture over time: levels (final value, mean,
    extremes, overshoot, peak against a constant) and instants (rise, settling, reaching).

    Parameters
    ----------
    signals : Signals
        Of the run: a rise is counted from where it began.
    results : iterable of Result
        Results of the run, as far as they are known; requirements that are not among them are judged again.
    """
    judged = {result.name: result.violated_s for result in results}
    scenario = rig.scenario
    published = {c.figure or k: c.published for k, c in scenario.claims.items() if c.published is not None}
    result: dict[str, list[Mark]] = {}
    for figure in figures_of(rig):
        if isinstance(figure.function, Judge):
            spans = judged[figure.name] if figure.name in judged else _spans(figure.function, signals)
            for mark in _violated(figure.name, spans):
                for name in figure.function.signals.values():
                    result.setdefault(name, []).append(mark)
            continue
        limits = scenario.expect.get(figure.name)
        if limits is None and figure.name not in published:
            continue
        low, high = _bounds(limits)
        printed = published.get(figure.name, math.nan)
        about = Mark("value", figure.name, low / figure.scale, high / figure.scale, printed / figure.scale)
        signal = figure.arguments.get("signal")
        if isinstance(signal, str):
            with suppress(KeyError, ValueError):  # the run may have ended before the window of the figure
                result.setdefault(signal, []).extend(_placed(figure.at(signals), about, signals))
    return result


def _spans(judge: Judge, signals: SignalMap) -> Spans:
    """Return the intervals in which a requirement does not hold."""
    try:
        return judge.margin(signals).violated
    except (KeyError, ValueError):  # the table reports why the requirement is not judged
        return ()


def _violated(name: str, spans: Spans) -> Iterator[Mark]:
    """Yield the intervals in which a requirement does not hold, those next to each other as one."""
    near = TOGETHER * (spans[-1][1] - spans[0][0]) if spans else 0.0
    merged: list[tuple[float, float]] = []
    for start, end in spans:
        if merged and start - merged[-1][1] <= near:
            merged[-1] = merged[-1][0], end
        else:
            merged.append((start, end))
    for start, end in merged:
        yield Mark("violated", name, start=start, end=end)


def _bounds(limits: Expectation | None) -> tuple[float, float]:
    if limits is None:
        return math.nan, math.nan
    if limits.expected is not None:
        return limits.expected - (limits.tolerance or 0.0), limits.expected + (limits.tolerance or 0.0)
    return (
        -math.inf if limits.at_least is None else limits.at_least,
        math.inf if limits.at_most is None else limits.at_most,
    )


def _placed(figure: Figure, mark: Mark, signals: SignalMap) -> Iterator[Mark]:
    """Place a figure in the picture of its signal; None if it has no place there."""
    a = figure.arguments
    mark = replace(mark, start=_number_of(a, "start", -math.inf), end=_number_of(a, "end", math.inf))
    if figure.function in (measures.mean, measures.final_value):
        yield mark
    elif figure.function in (measures.maximum, measures.minimum):
        yield _extreme(mark, signals, a, math.nan)
    elif figure.function is measures.peak and not isinstance(a.get("reference", 0.0), str):
        yield _extreme(mark, signals, a, _number_of(a, "reference", 0.0))
    elif figure.function in (measures.reach_time, measures.error_settling_time):
        zero = measures.begin(signals[a["signal"]][0], a.get("start"))
        yield mark.at(lambda v: zero + v, "time")
    elif figure.function in (measures.overshoot, measures.settling_time, measures.rise_time):
        yield from _step(figure, mark, signals)


def _extreme(mark: Mark, signals: SignalMap, arguments: Mapping[str, Any], zero: float) -> Mark:
    """Place an extreme, or a peak on either side of `zero`: a bound over all times, a value where it is reached."""
    t, x = measures.window(signals, arguments["signal"], arguments.get("start"), arguments.get("end"))
    if not math.isnan(zero):
        index = int(np.argmax(np.abs(x - zero)))
        side = 1.0 if x[index] >= zero else -1.0
        mark = mark.at(lambda v: zero + side * v, "value")
    else:
        middle = (mark.low + mark.high) / 2 if mark.judged else mark.published
        index = int(np.argmin(np.abs(x - middle))) if math.isfinite(middle) else 0
    if math.isinf(mark.low) or math.isinf(mark.high):
        return mark
    reach = BESIDE * float(t[-1] - t[0])
    return replace(mark, start=max(mark.start, t[index] - reach), end=min(mark.end, t[index] + reach))


def _step(figure: Figure, mark: Mark, signals: SignalMap) -> Iterator[Mark]:
    """Place a figure of a step."""
    a = figure.arguments
    t, x = measures.window(signals, a["signal"], a.get("start"), a.get("end"))
    initial = _number_of(a, "initial", 0.0)
    step = (float(x[-1]) if a.get("final") is None else float(a["final"])) - initial
    if figure.function is measures.overshoot:
        yield mark.at(lambda v: initial + step * (1.0 + v / 100.0), "value")
        return
    began = t[0] if a.get("start") is None else float(a["start"])
    if figure.function is measures.rise_time:
        reached = np.flatnonzero((x - initial) * np.sign(step) >= a.get("low", 0.1) * abs(step))
        if not reached.size:
            return
        began = t[reached[0]]
        mark = replace(mark, name=f"{mark.name} from {began:.3g} s")
    yield mark.at(lambda v: float(began) + v, "time")


def _number_of(arguments: Mapping[str, Any], name: str, default: float) -> float:
    value = arguments.get(name)
    return default if value is None else float(value)
