"""True margins by simulation: the delay at which the growth rate of a trajectory changes its sign."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from softrig_core import Array
from softrig_core.kit.dde import trajectory

from .motion import constants, run_pwa
from .profiles import Profile, profile
from .system import PwaSystem


class Run(NamedTuple):
    """A simulated trajectory: times (s), largest size of a state at each, the last state, switches located."""

    t: Array
    sizes: Array
    x: Array
    switches: int


class Margin(NamedTuple):
    """A bracket of the delay margin (s), its best estimate, and the growth rates (1/s) that were found by delay."""

    h: float
    low: float
    high: float
    growth: dict[float, float]


def run_of(loop: Callable[..., int], p: object, start: Sequence[float], h: float, duration: float, steps: int) -> Run:
    """Simulate with the loop of a plant from a constant history, with a delay of at most h (s)."""
    step = h / steps
    count = round(duration / step)
    past, x, sizes = trajectory(step, h + 2.0 * step, tuple(start), spare=64), np.array(start, float), np.empty(count)
    switches = loop(past, 0.0, x, step, count, p, sizes)
    return Run(np.arange(1, count + 1, dtype=np.float64) * step, sizes, x, switches)


def simulate_pwa(system: PwaSystem, delay: Profile, x0: Sequence[float], duration: float, *, steps: int = 50) -> Run:
    """Simulate from a constant history.

    Parameters
    ----------
    delay : Profile
        With h > 0.
    duration : float
        s.
    steps : int
        Steps in the longest delay.
    """
    return run_of(run_pwa, constants(system, delay), [float(v) for v in x0], delay.h, duration, steps)


def growth_rate(run: Run) -> float:
    """Return the slope (1/s) of the logarithm of the maxima over time in the second half of a run.

    Raises
    ------
    ValueError
        Fewer than three maxima: the run is too short.
    """
    half = run.t.size // 2
    x, t = run.sizes[half:], run.t[half:]
    peak = np.flatnonzero((x[1:-1] >= x[:-2]) & (x[1:-1] > x[2:])) + 1
    if peak.size < 3:
        raise ValueError(
            f"{peak.size} maxima in {np.ptp(t) if t.size else 0.0:g} s: the run is too short for a growth rate"
        )
    return float(np.polyfit(t[peak], np.log(x[peak]), 1)[0])


def find_margin(
    growth: Callable[[float], float], low: float, high: float, *, width: float = 1e-5, grid: int = 8
) -> Margin:
    """Find the first delay at which a growth rate changes from negative to positive.

    A grid locates the first change of sign, because a stable delay does not imply that shorter delays are stable. Then
    regula falsi (Illinois) refines it.

    Parameters
    ----------
    growth : callable
        Delay (s) to growth rate (1/s).
    low, high : float
        Bracket, s.
    width : float
        Absolute width of the bracket, or change of the estimate, at which it ends, s.
    grid : int
        Number of parts of the bracket; an unstable window inside one part is missed.

    Raises
    ------
    ValueError
        The growth rate is not negative at `low`, or it is never positive.
    """
    results: dict[float, float] = {}
    at_low = at_high = -math.inf
    for h in (low + (high - low) * k / grid for k in range(grid + 1)):
        at_low, at_high = at_high, growth(h)
        results[h] = at_high
        if not at_high < 0.0:
            break
    if not at_low < 0.0 < at_high or at_low == -math.inf:
        first, last = next(iter(results.items())), next(reversed(results.items()))
        raise ValueError(
            f"growth {first[1]:.3g} 1/s at {first[0]:g} s and {last[1]:.3g} 1/s at {last[0]:g} s: no margin between"
        )
    low, high = list(results)[-2:]
    h = before = low
    side = 0
    while high - low > max(width, 2.0 * math.ulp(high)):  # as long as other floats lie in between
        h = (low * at_high - high * at_low) / (at_high - at_low)
        rate = growth(h)
        results[h] = rate
        if rate < 0.0:
            low, at_low = h, rate
            at_high *= 0.5 if side < 0 else 1.0
            side = -1
        else:
            high, at_high = h, rate
            at_low *= 0.5 if side > 0 else 1.0
            side = 1
        if abs(h - before) < 0.2 * width:
            break
        before = h
    return Margin(h, low, high, results)


def pwa_margin(
    system: PwaSystem,
    low: float,
    high: float,
    x0: Sequence[float],
    duration: float,
    *,
    steps: int = 50,
    width: float = 1e-5,
) -> Margin:
    """Find the margin of constant delays of a system from one start."""
    return find_margin(
        lambda h: growth_rate(simulate_pwa(system, profile("constant", h), x0, duration, steps=steps)),
        low,
        high,
        width=width,
    )
