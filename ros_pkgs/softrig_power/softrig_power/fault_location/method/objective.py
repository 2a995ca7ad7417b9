"""A prepared record: its modes, the window of the objective F(x), F on a grid of the line."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Literal

import numpy as np
from softrig_core import Array, Params, param

from ...lines.modal import AERIAL
from ..line.parameters import LineParams
from ..records.record import Record, RecordError, Status
from .equations import TAPS, Equations, Model, model, objectives

Algorithm = Literal["brent", "woa", "gwo", "integer_grid", "phasor", "travelling_wave"]
USUAL_TRAVEL = 4.0  # samples of the whole line's travel time, fewer are warned of


class LocatorParams(Params):
    """Parameters of the location of a record."""

    line: LineParams = LineParams()
    algorithm: Algorithm = param("brent", "how the minimum of F(x) is found; phasor, travelling_wave: without F(x)")
    mode: Literal["auto", "1", "2", "3"] = param("auto", "aerial mode: 1 (a-b)/3, 2 (b-c)/3, 3 (c-a)/3, or the best")
    equations: Equations = param("corrected", "voltage equations: corrected, or with misprints of the paper")
    window_start: float = param(0.0210, "first time of the objective", "s", ge=0.0, le=1e6)
    window_end: float = param(0.0395, "last time of the objective, before the fault is cleared", "s", gt=0.0, le=1e6)
    n_grid: int = param(61, "points of the grid on the line", ge=5, le=10000)
    tolerance: float = param(1e-6, "brent: tolerance of x", "km", gt=0.0, le=1.0)
    n_pop: int = param(100, "woa, gwo: population", ge=3, le=10000)
    n_iter: int = param(500, "woa, gwo: iterations", ge=1, le=100000)
    seed: int = param(0, "woa, gwo: added to the seed of the run", ge=0, le=2**31 - 1)
    frequency: float = param(50.0, "phasor: frequency", "Hz", gt=0.0, le=1000.0)
    f_threshold: float = param(2000.0, "least max F of a fault", "V", ge=0.0, le=1e9)
    f_ratio: float = param(5.0, "least max F / min F of a fault", ge=1.0, le=1e9)
    least_travel: float = param(1.0, "least travel time of the whole line, in samples", ge=0.0, le=1e6)
    disagreement: float = param(0.05, "largest disagreement of the ends at the fault, of their voltage", ge=0.0, le=1e9)

    def _check(self) -> None:
        if self.window_end <= self.window_start:
            raise ValueError(f"window_end = {self.window_end:g} s is not after window_start = {self.window_start:g} s")


class Objective:
    """One record, prepared for any method.

    Parameters
    ----------
    rng : numpy.random.Generator, optional
        Random numbers of a swarm; those of `p.seed` alone when absent.

    Raises
    ------
    RecordError
        The record does not reach beyond the window by the travel time; the rate is too low for the line.
    """

    def __init__(self, record: Record, p: LocatorParams, rng: np.random.Generator | None = None) -> None:
        self.record, self.p, self.rng = record, p, rng or np.random.default_rng(p.seed)
        self.section = p.line.aerial
        self.model = model(self.section, p.equations)
        rate = record.rate
        self.travel = self.section.length / self.model.v * rate  # samples
        self.warning = check_travel(self.travel, rate, p)
        self.first = math.ceil((p.window_start - record.start) * rate - 1e-6)
        self.count = math.floor((p.window_end - record.start) * rate + 1e-6) - self.first + 1
        room = int(self.travel) + TAPS // 2
        if self.count < 1 or self.first < room or self.first + self.count + room > len(record.samples):
            end = record.start + (len(record.samples) - 1) / rate
            raise RecordError(
                Status.TOO_SHORT,
                f"too short: the record from {record.start:.6g} to {end:.6g} s does not cover the "
                f"window from {p.window_start:g} to {p.window_end:g} s and {room / rate:.3g} s beyond it at both ends",
            )
        groups = [record.group(name) for name in ("u_s", "i_s", "u_r", "i_r")]
        self._modal = [
            np.array([g[:, 0] * a + g[:, 1] * b + g[:, 2] * c for g in groups]) for a, b, c in AERIAL.tolist()
        ]
        self.evaluations = 0

    def ends(self, mode: int) -> Array:
        """Modal u_S, i_S, u_R, i_R of mode 1, 2 or 3, shape (4, n)."""
        return self._modal[mode - 1]

    def f(self, x: Array, mode: int, stretch: tuple[int, int] | None = None) -> Array:
        """F(x) in V at points in km, over the window or another stretch (first sample, number of samples)."""
        return self._f(self.model, x, mode, stretch or (self.first, self.count))

    def _f(self, equations: Model, x: Array, mode: int, stretch: tuple[int, int]) -> Array:
        points = np.ascontiguousarray(x, dtype=np.float64)
        out = np.empty(points.shape)
        objectives(equations, self.ends(mode), self.record.rate, *stretch, points, out)
        self.evaluations += points.size
        return out

    @cached_property
    def grid(self) -> Array:
        """Points of the grid on the line, km."""
        return np.linspace(0.0, self.section.length, self.p.n_grid)

    @cached_property
    def curves(self) -> Array:
        """F on the grid for the three modes by the correct equations, shape (3, n_grid), for fault location."""
        right = model(self.section)
        return np.array([self._f(right, self.grid, mode, (self.first, self.count)) for mode in (1, 2, 3)])

    def curve(self, mode: int) -> Array:
        """F on the grid by the equations of the parameters, shape (n_grid,)."""
        return self.curves[mode - 1] if self.p.equations == "corrected" else self.f(self.grid, mode)


def check_travel(travel: float, rate: float, p: LocatorParams) -> str:
    """Refuse a line with too few samples of travel time; return a warning if that is due to the profile."""
    if travel >= USUAL_TRAVEL:
        return ""
    if travel < p.least_travel:
        raise RecordError(Status.TOO_SHORT, f"{_passed(travel, rate, p)} {p.least_travel:g} or more (least_travel)")
    return f"{_passed(travel, rate, p)} {USUAL_TRAVEL:g} or more: the errors of clocks and transformers weigh more"


def _passed(travel: float, rate: float, p: LocatorParams) -> str:
    return f"waves pass the line of {p.line.length:g} km in {travel:.3g} samples of {1e6 / rate:.4g} us, expected"
