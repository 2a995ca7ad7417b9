"""Figure functions: figures of merit of a recording; a scenario names them and sets their arguments.

Every function is called as ``f(signals, **arguments)`` and returns a float. `signals` maps a name
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
    Constant, or the name of a signal (its newest value at each sample of `signal`; means and integrals over time use
    each of its own values, too).

A sample holds until the next one, the last one to the end of the record. Means and integrals are over time: each value
counts for as long as it holds. So lost messages or uneven stamps do not change the figures of a signal that would
otherwise be sent at each tick. Times are counted from `start`, or from the first sample.

Raises
------
KeyError
    No such signal.
ValueError
    No (or not enough) samples in the window; a step of size zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from operator import itemgetter
from types import MappingProxyType
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..wire.long import counted, gathered, is_long
from ..wire.times import once_for_times
from .sums import fixed, pairs, squares

__all__ = [
    "error_overshoot", "error_settling_time", "final_value", "growth_rate", "integral_absolute", "maximum", "mean",
    "mean_absolute", "mean_error", "mean_square", "minimum", "overshoot", "peak", "peak_to_peak", "reach_time",
    "rise_time", "rms", "settling_time", "sum_absolute", "total_variation",
]  # fmt: skip

NS = 1e-9
# The errors that figure functions raise.
UNMEASURED = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
# A figure that exceeds its possible range by less than this is due to rounding and is no error.
ROUNDING = 1e-9
# Below so many instants a binary search is faster than the check whether each has its own newest time.
SIDE_BY_SIDE = 64
# Bytes: larger results are not shared, because a long run has to stay small in memory.
SHARED = 1 << 22
# Times in s are whole ns, so a sample nearer than this (s) to an end of a window is at it.
HALF_NS = 5e-10

SignalMap = Mapping[str, tuple[Array, Array]]
Function = Callable[..., float]
_F = TypeVar("_F", bound=Function)
_T = TypeVar("_T", bound=tuple[Any, ...])


class ImpossibleError(ValueError):
    """A figure with an impossible value, as an efficiency above 100 %: its arguments do not belong to the run."""


def figure(
    unit: str,
    reads: Sequence[str] = (),
    agreed: Mapping[str, str] = MappingProxyType({}),
    possible: tuple[float, float] = (-math.inf, math.inf),
    follows: bool = False,
) -> Callable[[_F], _F]:
    """Declare the result of a figure function, so that a scenario can be checked before its run.

    Parameters
    ----------
    unit : str
        Unit of the figure; ``{signal}`` is replaced by the unit of its argument `signal`.
    reads : sequence of str
        Signals that it reads in addition to those that its arguments name; ``*`` matches any characters.
    agreed : mapping of str to str
        Arguments whose value a node of the rig declares in `Block.agreed`: name to quantity (``tank/k_high``). A
        scenario leaves them out; a scenario with another value is refused.
    possible : (float, float)
        Range of possible values. A result outside (an efficiency above 100 %) is an error and never passes.
    follows : bool
        Whether the figure is relative to the machine itself (a share of the module's available power, whether a fault
        was found), so that its expectation also applies to a changed machine.
    """

    def declare(function: _F) -> _F:
        function.unit, function.reads = unit, tuple(reads)  # type: ignore[attr-defined]
        function.agreed, function.possible = agreed, possible  # type: ignore[attr-defined]
        function.follows = follows  # type: ignore[attr-defined]
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
    zero = begin(t, start)
    error = z - 1.0
    outside = np.flatnonzero(np.abs(error) > band)
    if outside.size == 0:
        return float(t[0] - zero)
    k = int(outside[-1])
    if k == t.size - 1:
        return float("inf")
    if at == "sample":
        return float(t[k + 1] - zero)
    # The signal leaves the band on the side of its last error, so it crosses that edge.
    edge = np.copysign(band, error[k])
    return float(t[k] + (t[k + 1] - t[k]) * (error[k] - edge) / (error[k] - error[k + 1]) - zero)


@figure("s")
def reach_time(
    signals: SignalMap, signal: str, *, level: float, start: float | None = None, end: float | None = None
) -> float:
    """Time in s until the first sample at `level` or beyond it, as seen from where the signal begins; inf without one.

    Parameters
    ----------
    level : float
        In the signal's unit.

    Returns
    -------
    float
        Counted from `start`, or from the first sample.
    """
    t, x = window(signals, signal, start, end)
    beyond = x >= level if x[0] < level else x <= level
    reached = np.flatnonzero(beyond)
    return float(t[reached[0]] - begin(t, start)) if reached.size else float("inf")


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
    """Return the largest value beyond `final` in % of the step size; 0 if there is none."""
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
    """Mean over time of reference - signal."""
    return -mean_over(*_held_error(signals, signal, reference, start, end))


def _over_time(unit: str) -> Callable[[Callable[[Array, Array], float]], Function]:
    """Create a figure from a function of signal - reference and of the time for which each value holds (ns)."""
    return _statistic(unit, lambda *arguments: _held_error(*arguments))  # the function is defined below


def _of_samples(unit: str) -> Callable[[Callable[[Array, Array], float]], Function]:
    """Create a figure from a function of the times and samples of signal - reference."""
    return _statistic(unit, lambda *arguments: _error(*arguments))


def _statistic(unit: str, values: Callable[..., tuple[Array, Array]]) -> Callable[[Callable[..., float]], Function]:
    def declare(number: Callable[[Array, Array], float]) -> Function:
        @figure(unit)
        def statistic(
            signals: SignalMap,
            signal: str,
            *,
            reference: float | str = 0.0,
            start: float | None = None,
            end: float | None = None,
        ) -> float:
            return float(number(*values(signals, signal, reference, start, end)))

        statistic.__name__ = statistic.__qualname__ = number.__name__
        statistic.__doc__ = number.__doc__
        return statistic

    return declare


@_over_time("{signal}")
def rms(e: Array, holds: Array) -> float:
    """Root of the mean square over time of signal - reference."""
    return math.sqrt(mean_square_over(e, holds))


@_of_samples("{signal}")
def peak(t: Array, e: Array) -> float:
    """Largest |signal - reference| of a sample."""
    return float(np.abs(e).max())


@_over_time("{signal}^2")
def mean_square(e: Array, holds: Array) -> float:
    """Mean over time of the squares of signal - reference (MSE of an error)."""
    return mean_square_over(e, holds)


@_over_time("{signal}")
def mean_absolute(e: Array, holds: Array) -> float:
    """Mean over time of |signal - reference| (MAE of an error, MAC of a current, MAV of a voltage)."""
    return mean_over(np.abs(e), holds)


@_of_samples("{signal}")
def sum_absolute(t: Array, e: Array) -> float:
    """Sum of the absolute values of all samples (SAE); grows with their number."""
    return float(np.abs(e).sum())


@_of_samples("{signal}")
def error_overshoot(t: Array, e: Array) -> float:
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
    """Integral over time of |signal - reference| (IAE of an error)."""
    t, _ = window(signals, signal, start, end)
    if t.size < 2:
        raise ValueError(f"{signal} has {t.size} samples, needed 2")
    _, e, gaps = _aligned(signals, signal, reference, start, end)
    return float((np.abs(e) * gaps).sum() * NS)


@figure("{signal}")
def mean(signals: SignalMap, signal: str, *, start: float | None = None, end: float | None = None) -> float:
    """Mean value over time."""
    return mean_over(*held(signals, signal, start, end)[1:])


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
    """Time in s until the first sample from which on |signal - reference| stays within `band`, in the signal's unit.

    Parameters
    ----------
    band : float
        Half width, in the signal's unit.

    Returns
    -------
    float
        Counted from `start`, or from the first sample. inf when the last sample is outside.
    """
    t, e = _error(signals, signal, reference, start, end)
    outside = np.flatnonzero(np.abs(e) > band)
    k = int(outside[-1]) + 1 if outside.size else 0
    return float(t[k] - begin(t, start)) if k < t.size else float("inf")


@figure("1/s")
def growth_rate(
    signals: SignalMap,
    signal: str,
    *,
    reference: float | str = 0.0,
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Slope of the straight line of least squares through the logarithm of the peaks of |signal - reference| over time.

    A peak is a maximum above zero or a minimum below it; its height and time are those of the parabola through it and
    the different values before and after. Of an oscillation of a linear system, exp(sigma t) cos(omega t), the slope is
    sigma, once other modes are gone: negative is damped, positive grows; at the margin of stability it is zero.

    Raises
    ------
    ValueError
        Fewer than three peaks.
    """
    t, x = _error(signals, signal, reference, start, end)
    # A value that only repeats the one before would hide a peak: neither of the two is above its neighbours.
    # The NaN in front counts the first sample as new, because a difference with it is not zero.
    new = np.flatnonzero(np.diff(x, prepend=np.nan))
    t, x = t[new], x[new]
    side = np.sign(x[1:-1])
    before, centre, after = side * x[:-2], side * x[1:-1], side * x[2:]
    k = np.flatnonzero((before < centre) & (after < centre) & (centre > 0.0))
    if k.size < 3:
        raise ValueError(f"{signal} has {k.size} peaks between {t[0]:g} and {t[-1]:g} s, needed 3 for a growth rate")
    u, v = (t[1:-1] - t[:-2])[k], (t[2:] - t[1:-1])[k]
    rising, falling = (centre - before)[k] / u, (after - centre)[k] / v
    # Slope and curvature of the parabola at the sample.
    slope, curve = (rising * v + falling * u) / (u + v), (falling - rising) / (u + v)
    return float(np.polyfit(t[1:-1][k] - slope / (2.0 * curve), np.log(centre[k] - slope**2 / (4.0 * curve)), 1)[0])


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
        recorded = f"recorded from {t[0]:g} to {t[-1]:g} s" if t.size else "nothing is recorded"
        raise ValueError(f"{signal} has {max(0, last - first)} samples from {asked}, needed {least}; {recorded}")
    return t[first:last], x[first:last]


def shared(signals: SignalMap, key: Hashable, make: Callable[[], _T]) -> _T:
    """Return an intermediate result that several figures of one run share; it is cached if the signals allow it.

    Parameters
    ----------
    signals : mapping
        Signals of a run cache results in their attribute `shared`; for other signals the result is computed at each
        call.
    key : hashable
        Identifies the result, with all arguments that it depends on.
    make : callable
        Computes a tuple of arrays, which callers must not modify, and numbers.
    """
    store: dict[Hashable, Any] | None = getattr(signals, "shared", None)
    if store is None:
        return make()
    if key not in store:
        result: Any = make()
        if sum(getattr(part, "nbytes", 0) for part in result) > SHARED:
            return result  # type: ignore[no-any-return]
        store[key] = result
    return store[key]  # type: ignore[no-any-return]


def begin(t: Array, start: float | None) -> float:
    """Return the start of a time window: `start`, or the first sample of the times.

    Parameters
    ----------
    t : array, shape (n,)
        As `window` returns it.
    start : float or None
        s.
    """
    return float(t[0]) if start is None else start


def held(
    signals: SignalMap, signal: str, start: float | None = None, end: float | None = None
) -> tuple[Array, Array, Array]:
    """Cut a held signal to a time window; the window begins with the value that was valid before it.

    Parameters
    ----------
    start, end : float or None
        As in `window`.

    Returns
    -------
    t, x : arrays of shape (n,)
    gaps : array, shape (n,)
        How long each value holds, ns; the last one up to `end`, at most to the newest message of the record.

    Raises
    ------
    KeyError
        No such signal.
    ValueError
        No samples in the window.
    """
    t, x = window(signals, signal, start, end)
    times, values = signals[signal]
    first = int(np.searchsorted(times, t[0]))
    # The value from before the window holds until its first sample, so it belongs to a mean over time.
    if start is not None and first and t[0] - start > HALF_NS:
        t, x = _from(float(start), t), np.append(values[first - 1], x)
    stop = max(float(t[-1]), min(_record_end(signals), math.inf if end is None else end))
    return t, x, _gaps(t, stop)


@once_for_times
def _from(start: float, t: Array) -> Array:
    return np.append(start, t)


@once_for_times
def _gaps(t: Array, stop: float) -> Array:
    """Return the time from each sample to the next, and from the last one to `stop`, ns."""
    return np.rint(np.diff(t, append=stop) / NS)


def _record_end(signals: SignalMap) -> float:
    # A record may be longer than its newest message of a signal; plain dicts of arrays do not know its end.
    reported: float | None = getattr(signals, "end", None)
    return max(float(t[-1]) for t, _ in signals.values() if t.size) if reported is None else reported


def mean_square_over(x: Array, gaps: Array, middle: float = 0.0) -> float:
    """Average ``(x - middle) ** 2`` as `mean_over` does."""
    if _weights(gaps) is None and not is_long(x):
        arguments = fixed(x), middle, pairs(len(x))
        if squares.pays(*arguments):  # type: ignore[attr-defined]
            return squares(*arguments) / len(x)
    return mean_over((x - middle) ** 2, gaps)


def mean_over(x: Array, gaps: Array) -> float:
    """Average values over the time for which they are valid; a last one without a duration counts as long as the
    shortest.

    Parameters
    ----------
    x, gaps : array, shape (n,)
        Values; ns, as `held` returns them.
    """
    weights = _weights(gaps)
    return float(np.mean(x)) if weights is None else float((x * weights).sum() / weights.sum())


@once_for_times
def _weights(gaps: Array) -> Array | None:
    # The last sample of a record holds for no time, yet it must count: a final error would be lost.
    if gaps[-1] == 0.0:
        gaps = np.append(gaps[:-1], np.min(gaps[:-1], initial=np.inf))
    # Equal gaps weigh nothing, and without weights the bits do not depend on the period.
    return None if (gaps == gaps[0]).all() else gaps


def interval(t: Array, signal: str) -> float:
    """Return the time between two samples, s, for computations on an even grid.

    Parameters
    ----------
    t : array, shape (n,)
        s, at least two.
    signal : str
        Whose times these are.

    Raises
    ------
    ValueError
        The samples are not even: some are lost, or were taken at other times.
    """
    shortest, longest = float(np.min(np.diff(t))), float(np.max(np.diff(t)))
    # Each end of a gap is rounded to 1 ns; what is beyond that and a millionth of the gap is an uneven grid.
    if longest - shortest > 4.0 * HALF_NS + 1e-6 * shortest:
        raise ValueError(
            f"{signal} has samples {shortest:g} to {longest:g} s apart, expected an even grid: use the signal before "
            "a link that loses or delays messages"
        )
    return float((t[-1] - t[0]) / (t.size - 1))


Places = NDArray[np.intp] | slice


@once_for_times
def newest(times: Array, t: Array) -> NDArray[np.intp]:
    """Return for each of many instants which of some times is the newest not after it; -1 before the first.

    Parameters
    ----------
    times : array, shape (n,)
        Ascending.
    t : array, shape (m,)
        Ascending.
    """
    # With few times and many instants counting is faster than a search for each instant.
    if len(times) > len(t) / 4 or is_long(t):
        return _one_each(times, t) if len(t) > SIDE_BY_SIDE else np.searchsorted(times, t, side="right") - 1
    # Times after the last instant are counted in one more place, which is cut off.
    arrived = np.bincount(np.searchsorted(t, times), minlength=len(t))[: len(t)]
    return np.cumsum(arrived) - 1


def places(indices: NDArray[np.intp]) -> Places:
    """Return indices as a slice if they are consecutive, so that indexing copies nothing."""
    if len(indices) and indices[0] >= 0 and (np.diff(indices) == 1).all():
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices


def _one_each(times: Array, t: Array) -> NDArray[np.intp]:
    """Return the result of `newest` for two nodes of the same period, without a search."""
    first = int(np.searchsorted(times, t[0], side="right")) - 1
    last = first + len(t)
    # Two nodes of one period have one time for each instant. The guess is checked as a whole, else it is searched for.
    if first >= 0 and last <= len(times):
        guess = times[first:last]
        if (guess <= t).all() and (t[:-1] < guess[1:]).all() and not (times[last : last + 1] <= t[-1]).any():
            return counted(first, last) if is_long(t) else np.arange(first, last, dtype=np.intp)
    return np.searchsorted(times, t, side="right") - 1


def newest_step(signals: SignalMap, references: str) -> tuple[float, float]:
    """Return when (s) any of some signals last changed, and to what value; a first sample counts as a step.

    Parameters
    ----------
    references : str
        Their names; several with a comma and a blank between.

    Raises
    ------
    KeyError
        No such signal.
    ValueError
        No samples.
    """

    def newest() -> tuple[float, float]:
        steps = []
        for name in references.split(", "):
            t, x = window(signals, name, None, None)
            k = int(np.flatnonzero(np.diff(x, prepend=np.nan))[-1])
            steps.append((float(t[k]), float(x[k])))
        return max(steps, key=itemgetter(0))

    return shared(signals, ("newest_step", references), newest)


def step_levels(
    signals: SignalMap, final: float | str | None, initial: float | str, start: float | None
) -> tuple[float | None, float]:
    """Return `final` and `initial` of a step at `start` as numbers, where they name signals.

    Raises
    ------
    KeyError
        No such signal.
    ValueError
        A signal has no value there yet.
    """

    def value(name: str, shift: float) -> float:
        when, x = signals[name]
        # "At" the begin includes a sample there, "before" excludes it; hence half a ns to either side.
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
    """Return (t, x) with x normalised so that `initial` is 0 and `final` is 1."""
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
    """Return (t, signal - reference)."""
    t, x = window(signals, signal, start, end)
    if not isinstance(reference, str):
        return t, x - reference
    when, values = signals[reference]
    # A plant publishes once more than its controller at the end of a run, so the last sample has no reference.
    if t.size > 1 and _unpaired(t, when):
        t, x = t[:-1], x[:-1]
    return t, x - gathered(values, _known(signal, reference, t, when))


def _unpaired(t: Array, when: Array) -> bool:
    """Return whether the last sample has no reference: at the end of a run a plant publishes once more than others."""
    # At that sample a whole period of the reference has passed since its newest value.
    return bool(when.size > 1 and t[-1] > 2.0 * when[-1] - when[-2] - HALF_NS)


def _known(signal: str, reference: str, t: Array, when: Array) -> Places:
    indices = newest(when, t)
    if indices.size and indices[0] < 0:
        raise ValueError(f"{reference} has no value yet at {t[0]:g} s, where {signal} begins")
    return _places(indices)


_places = once_for_times(places)


def _held_error(
    signals: SignalMap, signal: str, reference: float | str, start: float | None, end: float | None
) -> tuple[Array, Array]:
    """Return signal - reference, and for how long each value is valid (ns), for means over time."""
    key = "held_error", signal, reference, start, end
    return shared(signals, key, lambda: _new_held_error(signals, signal, reference, start, end))


def _new_held_error(
    signals: SignalMap, signal: str, reference: float | str, start: float | None, end: float | None
) -> tuple[Array, Array]:
    t, e, gaps = _aligned(signals, signal, reference, start, end)
    if isinstance(reference, str) and t.size > 1 and not gaps[-1] and _unpaired(t, signals[reference][0]):
        return e[:-1], gaps[:-1]
    return e, gaps


def _aligned(
    signals: SignalMap, signal: str, reference: float | str, start: float | None, end: float | None
) -> tuple[Array, Array, Array]:
    """Return (t, signal - reference, gaps), with a value wherever either of them has a new one."""
    t, x, gaps = held(signals, signal, start, end)
    if not isinstance(reference, str):
        return t, x - reference, gaps
    when, values = signals[reference]
    both, indices, gaps = _union(t, when, float(t[-1]) + float(gaps[-1]) * NS)
    return both, gathered(x, indices) - gathered(values, _known(signal, reference, both, when)), gaps


@once_for_times
def _union(t: Array, when: Array, stop: float) -> tuple[Array, Places, Array]:
    """Return all times of two signals up to `stop`, the places among `t` that they belong to, and their gaps, ns."""
    added = when[(when > t[0]) & (when < stop - HALF_NS)]
    # A reference sample at a time of the signal is covered already; a second one would count for no time.
    added = added[added - gathered(t, newest(t, added + HALF_NS)) > HALF_NS]
    # Nothing to sort: the array of the times may be long, or shared by others.
    both = np.sort(np.concatenate([t, added])) if len(added) else t
    return both, places(newest(t, both)), np.rint(np.diff(both, append=stop) / NS)
