"""Figure functions: figures of merit of a recording; a scenario names them and gives their arguments.

Every function is called as ``f(signals, **arguments)`` and gives a float. `signals` maps a name
``topic/channel/field`` to (t, x): `softrig_core.wire.signals.Signals`, or a plain dict of array pairs.

Arguments with the same meaning everywhere:

signal : str
    Name of the signal.
start, end : float, optional
    Time window in s, both ends included to the nearest ns (`window`, the one rule); the whole record when absent.
final : float or str, optional
    Value that counts as 100 % of a step, or the name of a signal: its newest value where the window begins. The last
    sample of the window when absent.
initial : float or str
    Value that counts as 0 % of a step, or the name of a signal: its value before the window begins.
reference : float or str
    Constant, or the name of a signal (its newest value at each sample of `signal`).

Raises
------
KeyError
    No such signal.
ValueError
    No (or not enough) samples in the window; a step of size zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from types import MappingProxyType
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "error_overshoot", "error_settling_time", "final_value", "growth_rate", "integral_absolute", "maximum", "mean",
    "mean_absolute", "mean_error", "mean_square", "minimum", "overshoot", "peak", "peak_to_peak", "reach_time",
    "rise_time", "rms", "settling_time", "sum_absolute", "total_variation",
]  # fmt: skip

ROUNDING = 1e-9  # what is so little beyond what is possible is rounding
HALF_NS = 5e-10  # s; times are whole ns: what is nearer to an end of a window than this is inside

Array = NDArray[np.float64]
SignalMap = Mapping[str, tuple[Array, Array]]
Function = Callable[..., float]
_F = TypeVar("_F", bound=Function)


class ImpossibleError(ValueError):
    """A figure that cannot be, as an efficiency above 100 %: it was measured against what the run is not about."""


def figure(
    unit: str,
    reads: Sequence[str] = (),
    agreed: Mapping[str, str] = MappingProxyType({}),
    possible: tuple[float, float] = (-math.inf, math.inf),
) -> Callable[[_F], _F]:
    """Say what a figure function gives, so that a scenario is judged before its run.

    Parameters
    ----------
    unit : str
        Unit of the figure; ``{signal}`` stands for that of its argument `signal`.
    reads : sequence of str
        Signals that it reads besides those that its arguments name; ``*`` stands for any characters.
    agreed : mapping of str to str
        Arguments that are what a node of the rig says by `Block.agreed`: name to quantity (``tank/k_high``). A scenario
        leaves them out; one that gives another value is refused.
    possible : (float, float)
        What lies outside cannot be (an efficiency above 100 %): such a result is an error and never passes.
    """

    def declare(function: _F) -> _F:
        function.unit, function.reads = unit, tuple(reads)  # type: ignore[attr-defined]
        function.agreed, function.possible = agreed, possible  # type: ignore[attr-defined]
        return function

    return declare


@figure("s")
def rise_time(
    signals: SignalMap,
    signal: str,
    *,
    final: float | str | None = None,
    initial: float | str = 0.0,
    low: float = 0.1,
    high: float = 0.9,
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Time in s from the first crossing of `low` to the first crossing of `high`, linear between samples.

    Parameters
    ----------
    low, high : float
        Levels as fractions of the step, 0 <= low < high.

    Returns
    -------
    float
        inf when the signal never reaches `high`.
    """
    if not 0.0 <= low < high:
        raise ValueError(f"levels low = {low}, high = {high}: expected 0 <= low < high")
    t, z = _step(signals, signal, final, initial, start, end)
    reached = _first_crossing(t, z, high)
    return reached - _first_crossing(t, z, low) if np.isfinite(reached) else np.inf


@figure("s")
def settling_time(
    signals: SignalMap,
    signal: str,
    *,
    final: float | str | None = None,
    initial: float | str = 0.0,
    band: float = 0.02,
    at: Literal["crossing", "sample"] = "crossing",
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Time in s from the start of the window until the signal stays within `band` of the step around `final`.

    Parameters
    ----------
    band : float
        Half width as a fraction of the step size, > 0.
    at : {"crossing", "sample"}
        "crossing": where the last exit of the band ends, linear between samples. "sample": the first sample
        inside for good.

    Returns
    -------
    float
        Counted from `start`, or from the first sample. inf when the last sample is outside.
    """
    if not band > 0.0:
        raise ValueError(f"band = {band}: expected a positive fraction of the step")
    if at not in ("crossing", "sample"):
        raise ValueError(f"at = {at!r}: expected 'crossing' or 'sample'")
    t, z = _step(signals, signal, final, initial, start, end)
    zero = t[0] if start is None else start
    error = z - 1.0
    outside = np.flatnonzero(np.abs(error) > band)
    if outside.size == 0:
        return float(t[0] - zero)
    k = int(outside[-1])
    if k == t.size - 1:
        return float("inf")
    if at == "sample":
        return float(t[k + 1] - zero)
    edge = np.copysign(band, error[k])
    return float(t[k] + (t[k + 1] - t[k]) * (error[k] - edge) / (error[k] - error[k + 1]) - zero)


@figure("s")
def reach_time(
    signals: SignalMap, signal: str, *, level: float, start: float | None = None, end: float | None = None
) -> float:
    """Time in s of the first sample at `level` or above; inf when there is none.

    Parameters
    ----------
    level : float
        In the signal's unit.
    """
    t, x = window(signals, signal, start, end)
    reached = np.flatnonzero(x >= level)
    return float(t[reached[0]]) if reached.size else float("inf")


@figure("%")
def overshoot(
    signals: SignalMap,
    signal: str,
    *,
    final: float | str | None = None,
    initial: float | str = 0.0,
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Largest value beyond `final` in % of the step size; 0 when there is none."""
    _, z = _step(signals, signal, final, initial, start, end)
    return max(0.0, 100.0 * (float(np.max(z)) - 1.0))


@figure("{signal}/s")
def total_variation(signals: SignalMap, signal: str, *, start: float | None = None, end: float | None = None) -> float:
    """Chattering index: sum of |x_k - x_(k-1)| over the time from the first to the last sample; unit of x per s."""
    t, x = window(signals, signal, start, end, least=2)
    return float(np.abs(np.diff(x)).sum() / (t[-1] - t[0]))


@figure("{signal}")
def peak_to_peak(signals: SignalMap, signal: str, *, start: float | None = None, end: float | None = None) -> float:
    """Largest less smallest value."""
    return float(np.ptp(window(signals, signal, start, end)[1]))


@figure("{signal}")
def mean_error(
    signals: SignalMap, signal: str, *, reference: float | str, start: float | None = None, end: float | None = None
) -> float:
    """Mean of reference - signal."""
    return -float(_error(signals, signal, reference, start, end)[1].mean())


def _statistic(unit: str) -> Callable[[Callable[[Array], float]], Function]:
    """Make a figure of what is a number of all samples of signal - reference."""

    def declare(number: Callable[[Array], float]) -> Function:
        @figure(unit)
        def statistic(
            signals: SignalMap,
            signal: str,
            *,
            reference: float | str = 0.0,
            start: float | None = None,
            end: float | None = None,
        ) -> float:
            return float(number(_error(signals, signal, reference, start, end)[1]))

        statistic.__name__ = statistic.__qualname__ = number.__name__
        statistic.__doc__ = number.__doc__
        return statistic

    return declare


@_statistic("{signal}")
def rms(e: Array) -> float:
    """Root of the mean square of signal - reference."""
    return float(np.sqrt(np.mean(e**2)))


@_statistic("{signal}")
def peak(e: Array) -> float:
    """Largest |signal - reference|."""
    return np.abs(e).max()


@_statistic("{signal}^2")
def mean_square(e: Array) -> float:
    """Mean of the squares of signal - reference (MSE of an error)."""
    return float(np.mean(e**2))


@_statistic("{signal}")
def mean_absolute(e: Array) -> float:
    """Mean of the absolute values of signal - reference (MAE of an error, MAC of a current, MAV of a voltage)."""
    return np.abs(e).mean()


@_statistic("{signal}")
def sum_absolute(e: Array) -> float:
    """Sum of the absolute values of all samples (SAE); grows with their number."""
    return float(np.abs(e).sum())


@_statistic("{signal}")
def error_overshoot(e: Array) -> float:
    """Largest error of the sign opposite to that of the first error; 0 without one."""
    return max(0.0, float(-(e * np.sign(e[0])).min()))


@figure("{signal} s")
def integral_absolute(
    signals: SignalMap,
    signal: str,
    *,
    reference: float | str = 0.0,
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Integral of the absolute value (IAE of an error), each sample held until the next."""
    t, e = _error(signals, signal, reference, start, end)
    if t.size < 2:
        raise ValueError(f"{signal} has {t.size} samples, needed 2")
    return float(np.abs(e).sum() * (t[1] - t[0]))


@figure("{signal}")
def mean(signals: SignalMap, signal: str, *, start: float | None = None, end: float | None = None) -> float:
    """Mean value."""
    return float(np.mean(window(signals, signal, start, end)[1]))


@figure("s")
def error_settling_time(
    signals: SignalMap,
    signal: str,
    *,
    reference: float | str = 0.0,
    band: float,
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Time in s of the first sample from which on |signal - reference| stays within `band`, in the signal's unit.

    Parameters
    ----------
    band : float
        Half width, in the signal's unit.

    Returns
    -------
    float
        inf when the last sample is outside.
    """
    t, e = _error(signals, signal, reference, start, end)
    outside = np.flatnonzero(np.abs(e) > band)
    if outside.size == 0:
        return float(t[0])
    k = int(outside[-1]) + 1
    return float(t[k]) if k < t.size else float("inf")


@figure("1/s")
def growth_rate(
    signals: SignalMap,
    signal: str,
    *,
    reference: float | str = 0.0,
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Slope of the straight line of least squares through the logarithm of the peaks of signal - reference over time.

    A peak is a positive sample not below the one before and above the one after; its height and time are those of the
    parabola through the three. Of an oscillation of a linear system, exp(sigma t) cos(omega t), it is sigma, once other
    modes are gone: negative is damped, positive grows; at the margin of stability it is zero, whatever the amplitude.

    Raises
    ------
    ValueError
        Fewer than three peaks.
    """
    t, x = _error(signals, signal, reference, start, end)
    k = np.flatnonzero((x[1:-1] >= x[:-2]) & (x[1:-1] > x[2:]) & (x[1:-1] > 0.0)) + 1
    if k.size < 3:
        raise ValueError(f"{signal} has {k.size} peaks between {t[0]:g} and {t[-1]:g} s, needed 3 for a growth rate")
    before, here, after = x[k - 1], x[k], x[k + 1]
    shift = 0.5 * (before - after) / (before - 2.0 * here + after)  # of the top, in samples
    heights, times = here - 0.25 * (before - after) * shift, t[k] + shift * (t[k + 1] - t[k])
    return float(np.polyfit(times, np.log(heights), 1)[0])


@figure("{signal}")
def maximum(signals: SignalMap, signal: str, *, start: float | None = None, end: float | None = None) -> float:
    """Largest value."""
    return float(np.max(window(signals, signal, start, end)[1]))


@figure("{signal}")
def minimum(signals: SignalMap, signal: str, *, start: float | None = None, end: float | None = None) -> float:
    """Smallest value."""
    return float(np.min(window(signals, signal, start, end)[1]))


@figure("{signal}")
def final_value(signals: SignalMap, signal: str, *, start: float | None = None, end: float | None = None) -> float:
    """Last value in the window; with `end`, the newest value at that time."""
    return float(window(signals, signal, start, end)[1][-1])


def window(
    signals: SignalMap, signal: str, start: float | None, end: float | None, least: int = 1
) -> tuple[Array, Array]:
    """Cut a signal to a time window: the one rule of all figures.

    Parameters
    ----------
    start, end : float or None
        In s, both included, to the nearest ns; None: the first, the last sample.
    least : int
        Samples needed.

    Returns
    -------
    t, x : arrays of shape (n,)

    Raises
    ------
    KeyError
        No such signal.
    ValueError
        Fewer than `least` samples in the window.
    """
    t, x = signals[signal]
    first = 0 if start is None else int(np.searchsorted(t, start - HALF_NS))
    last = t.size if end is None else int(np.searchsorted(t, end + HALF_NS, side="right"))
    if last - first < least:
        asked = f"{'its begin' if start is None else f'{start:g} s'} to {'its end' if end is None else f'{end:g} s'}"
        held = f"recorded from {t[0]:g} to {t[-1]:g} s" if t.size else "nothing is recorded"
        raise ValueError(f"{signal} has {max(0, last - first)} samples from {asked}, needed {least}; {held}")
    return t[first:last], x[first:last]


def newest(times: Array, at: Array) -> NDArray[np.intp]:
    """Give for each of many instants which of some times is the newest not after it; -1 before the first.

    Parameters
    ----------
    times : array, shape (n,)
        Ascending.
    at : array, shape (m,)
        Ascending.
    """
    if len(times) > len(at) / 4:
        return np.searchsorted(times, at, side="right") - 1
    come = np.bincount(np.searchsorted(at, times), minlength=len(at))[: len(at)]
    return np.cumsum(come) - 1


def newest_step(signals: SignalMap, references: str) -> tuple[float, float]:
    """Give when (s) any of some signals was last another than before, and to what value; a first sample is a step, too.

    Parameters
    ----------
    signals : mapping
    references : str
        Their names; several with a comma and a blank between.

    Raises
    ------
    KeyError
        No such signal.
    ValueError
        No samples.
    """
    steps = []
    for name in references.split(", "):
        t, x = window(signals, name, None, None)
        k = int(np.flatnonzero(np.diff(x, prepend=np.nan))[-1])
        steps.append((float(t[k]), float(x[k])))
    return max(steps, key=itemgetter(0))


def step_levels(
    signals: SignalMap, final: float | str | None, initial: float | str, start: float | None
) -> tuple[float | None, float]:
    """Give `final` and `initial` of a step at `start` as numbers, where they name signals.

    Raises
    ------
    KeyError
        No such signal.
    ValueError
        A signal has no value there yet.
    """

    def value(name: str, shift: float) -> float:
        when, x = signals[name]
        count = int(np.searchsorted(when, (when[0] if start is None else start) + shift)) if when.size else 0
        if not count:
            raise ValueError(f"{name} has no value {'at' if shift > 0.0 else 'before'} the begin of the window")
        return float(x[count - 1])

    return (
        value(final, HALF_NS) if isinstance(final, str) else final,
        value(initial, -HALF_NS) if isinstance(initial, str) else initial,
    )


def _step(
    signals: SignalMap,
    signal: str,
    final: float | str | None,
    initial: float | str,
    start: float | None,
    end: float | None,
) -> tuple[Array, Array]:
    """Give (t, x) with x normalised so that `initial` is 0 and `final` is 1."""
    t, x = window(signals, signal, start, end)
    final, initial = step_levels(signals, final, initial, start)
    size = (float(x[-1]) if final is None else final) - initial
    if size == 0.0:
        raise ValueError(f"{signal}: the step from {initial:g} to the final value has size zero")
    return t, (x - initial) / size


def _first_crossing(t: Array, z: Array, level: float) -> float:
    reached = z >= level
    k = int(np.argmax(reached))
    if not reached[k]:
        return float("inf")
    if k == 0:
        return float(t[0])
    return float(t[k - 1] + (t[k] - t[k - 1]) * (level - z[k - 1]) / (z[k] - z[k - 1]))


def _error(
    signals: SignalMap, signal: str, reference: float | str, start: float | None, end: float | None
) -> tuple[Array, Array]:
    """Give (t, signal - reference)."""
    t, x = window(signals, signal, start, end)
    if not isinstance(reference, str):
        return t, x - reference
    when, values = signals[reference]
    if t.size > 1 and when.size > 1 and t[-1] > 2.0 * when[-1] - when[-2] - HALF_NS:
        t, x = t[:-1], x[:-1]  # at the end of a run a plant speaks once more, its reference does not: no pair
    held = newest(when, t)
    if held.size and held[0] < 0:
        raise ValueError(f"{reference} has no value yet at {t[0]:g} s, where {signal} begins")
    return t, x - values[held]
