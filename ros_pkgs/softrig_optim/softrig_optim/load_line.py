"""Searches for the largest power of a source through a matching converter, from its voltage and current alone.

The source has a fixed characteristic on which the current never rises with the voltage (a photovoltaic string, a fuel
cell, a thermoelectric generator). Every measured pair (v, i) lies on it, settled or not. These searches rely on nothing
else; they estimate the load behind the converter meanwhile.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Protocol

from .search import Moves, Point, Search, Seed

Corrections = Generator[Sequence[Point], list[float], None]


class Matching(Protocol):
    """Conversion of the load resistance by a converter's command into the resistance that the source sees."""

    def load(self, command: float, resistance: float) -> float:
        """Return the load (ohm) that makes the source see `resistance` ohm under this command."""

    def command(self, resistance: float, load: float) -> float:
        """Return the command under which this load makes the source see `resistance` ohm."""


@dataclass(eq=False, repr=False, kw_only=True)
class LoadLineSearch(Search):
    """Base of the searches along a source's characteristic: the load estimate and the final corrections.

    The sample passed with each value is (voltage in V, current in A, ...); the value is their product in W.

    Parameters
    ----------
    matching : Matching
        The converter's ideal law.
    corrections : int
        Periods at the end in which the command for the best point is corrected with the newest load estimate.
    **options
        Those of `Search`; always maximises.
    """

    matching: Matching
    corrections: int

    def __post_init__(self, seed: Seed) -> None:
        if len(self.lower) != 1:
            raise ValueError(f"a search along the load line has one command, got bounds of {len(self.lower)}")
        self._load = math.nan
        self._final: float | None = None
        self.peak = (0.0, 0.0)
        # The value is a power, so a caller cannot ask for its minimum.
        self.maximise = True
        super().__post_init__(seed)

    @property
    def result(self) -> Point:
        """The command for the best point, computed with the newest load estimate."""
        return super().result if self._final is None else (self._final,)

    @property
    def expected(self) -> float:
        """The power in W of the best point seen."""
        return self.peak[0] * self.peak[1]

    def learn(self, d: float) -> tuple[float, float]:
        """Store the measurement made under the command d; return (v, i)."""
        v, i = self.sample[:2]
        # Without power v / i is no load resistance, so the estimate keeps its last value.
        if v > 0.0 and i > 0.0:
            self._load = self.matching.load(d, v / i)
            self._remember(v, i)
        return v, i

    def _remember(self, v: float, i: float) -> None:
        if v * i > self.expected:
            self.peak = (v, i)

    def command(self, v: float, i: float) -> float:
        """Return the command that brings the source to the load line through (v, i)."""
        low, high = float(self.lower[0]), float(self.upper[0])
        # No steady measurement has had power yet, so there is no load line; the middle of the range is as good as any.
        if math.isnan(self._load):
            return 0.5 * (low + high)
        return min(max(self.matching.command(v / i, self._load), low), high)

    def correct(self) -> Corrections:
        """Approach the best point."""
        v, i = self.peak
        # In the dark there is no best point to approach.
        if v * i == 0.0:
            return
        # Each correction measures the load again nearer to the best point: the estimate so far is from other points.
        for _ in range(self.corrections):
            d = self.command(v, i)
            yield [(d,)]
            self.learn(d)
        self._final = self.command(v, i)


@dataclass(eq=False, repr=False, kw_only=True)
class CertifiedSearch(LoadLineSearch):
    r"""Search that ends with a proof: nothing between the outermost samples exceeds (1 + eps) times the best.

    Between two samples neighbouring in voltage, v_a < v_b, the current is at most i_a and the voltage at most
    v_b, so the power is at most v_b i_a. The pair with the largest such bound is split by the load line
    through the upper right corner of its box, R = v_b / i_a, until no bound is left above (1 + eps) times the best.
    The samples are ordered by voltage, never by command: those of a transient have another command. The first
    commands are the middle and both bounds; the proof covers the voltages between the outermost samples.

    Parameters
    ----------
    eps : float
        Relative gap to prove.
    n_iter : int
        Number of splits after which it abandons the proof: data with noise, or of a changing source, may be
        inconsistent.
    transients : bool
        Use every measurement on the way from one command to the next as well, not only the last: half the time.
    **options
        Those of `LoadLineSearch`.
    """

    eps: float = 0.01
    n_iter: int = 60
    transients: bool = False
    corrections: int = 3

    def __post_init__(self, seed: Seed) -> None:
        self.watches = self.transients
        self._points: list[tuple[float, float]] = []
        # Before both ends were measured, a bound between the outermost samples covers only a part of the range.
        self._spanned = False
        super().__post_init__(seed)

    @property
    def bound(self) -> float | None:
        """Power in W that no voltage between the outermost samples can exceed; None before both bounds were measured.

        Also None if the samples are not of one characteristic: a current that rises with the voltage by more than the
        gap, expressed as power, proves that the source changed, so that no bound holds.
        """
        if not self._spanned or self._contradicted():
            return None
        return max(self.expected, *self._bounds())

    @property
    def gap(self) -> float:
        """Return the gap as requested."""
        return self.eps

    def _contradicted(self) -> bool:
        lowest = math.inf
        for v, i in self._points:
            if v > 0.0 and (i - lowest) * v > self.eps * self.expected:
                return True
            lowest = min(lowest, i)
        return False

    def watch(self, sample: Sequence[float]) -> None:
        """Store a point of the characteristic on the way to a command."""
        # The load is not estimated here: in a transient the command does not belong to the measured voltage and
        # current.
        self._remember(sample[0], sample[1])
        insort(self._points, (sample[0], sample[1]))

    def _bounds(self) -> list[float]:
        pairs = zip(self._points, self._points[1:], strict=False)
        return [v_b * i_a if v_b > 0.0 and i_a > 0.0 else 0.0 for (_, i_a), (v_b, _) in pairs]

    def moves(self) -> Moves:  # noqa: D102
        low, high = float(self.lower[0]), float(self.upper[0])
        for d in (0.5 * (low + high), low, high):
            yield [(d,)]
            insort(self._points, self.learn(d))
        self._spanned = True
        while self.iteration < self.n_iter:
            bounds = self._bounds()
            k = max(range(len(bounds)), key=bounds.__getitem__)
            # No bound above the gap is left, so the proof is complete before the splits are used up.
            if bounds[k] <= (1.0 + self.eps) * self.expected:
                break
            self.iteration += 1
            d = self.command(self._points[k + 1][0], self._points[k][1])
            yield [(d,)]
            insort(self._points, self.learn(d))
        yield from self.correct()


@dataclass(eq=False, repr=False, kw_only=True)
class RampScan(LoadLineSearch):
    """Sweep of the command from bound to bound without waiting for steady state, then approach to the best point.

    Parameters
    ----------
    n_ramp : int
        Samples of the sweep, one a tick of the block.
    **options
        Those of `LoadLineSearch`.
    """

    n_ramp: int = 120
    corrections: int = 4

    def __post_init__(self, seed: Seed) -> None:
        if self.n_ramp < 2:
            raise ValueError(f"n_ramp is {self.n_ramp}, expected at least 2")
        super().__post_init__(seed)

    def moves(self) -> Moves:  # noqa: D102
        low, high = float(self.lower[0]), float(self.upper[0])
        self.settle = False
        for k in range(self.n_ramp):
            d = low + (high - low) * k / (self.n_ramp - 1)
            yield [(d,)]
            self.learn(d)
        self.settle = True
        yield from self.correct()
