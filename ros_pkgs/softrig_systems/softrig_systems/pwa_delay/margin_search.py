"""The search for the true margin as a node: simulations in its own process, the bracket on a topic."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softrig_core import Level, Result, SolverParams, Work, button, param, scalars

from .params import AskedSolver, AskedState, SystemParams
from .profiles import profile
from .search import Margin, find_margin, growth_rate, simulate_pwa


class MarginSearchParams(SystemParams, SolverParams):
    """System, bracket and length of the runs."""

    low: float = param(0.0195, "delay at which it is stable", "s", gt=0.0, le=1e3)
    high: float = param(0.021, "delay at which it is not", "s", gt=0.0, le=1e3)
    width: float = param(1e-5, "width of the answer", "s", ge=1e-12, le=1.0)
    duration: float = param(60.0, "length of a run; growth is taken from its second half", "s", gt=0.0, le=1e6)
    steps: int = param(50, "integration steps in a delay", ge=10, le=100000)
    x0: tuple[float, ...] = param((-2.0, 0.0), "state at and before the start")
    at_start: bool = param(True, "search once at the start; later at each press of the button")

    def _check(self) -> None:
        if len(self.x0) != self.states:
            raise ValueError(f"x0 has {len(self.x0)} values, expected {self.states}")
        if not self.low < self.high:
            raise ValueError(f"low = {self.low:g} s: expected less than high = {self.high:g} s")


class MarginSearch(AskedSolver[MarginSearchParams]):
    """Bisects the growth rate of simulated trajectories over constant delays.

    ``margin``: the margin, its bracket (s) and the growth rate there (1/s). It is the first margin in the bracket that
    the grid resolves: an unstable window shorter than an eighth of the bracket may be missed. A bracket without a
    change of sign causes a warning, and the margin is 0.
    """

    INPUTS = (button("search", "search", held=True),)
    OUTPUTS = (scalars("margin", "margin", {"margin": "s", "low": "s", "high": "s", "growth": "1/s"}, sporadic=True),)

    @classmethod
    def agreed(cls, params: MarginSearchParams) -> Mapping[str, Any]:
        """The system."""
        return params.agreed()

    @staticmethod
    def solve(request: MarginSearchParams, work: Work) -> Margin | str:
        """Simulate in another process."""
        p = request
        system = p.build()

        def growth(h: float) -> float:
            run = simulate_pwa(system, profile("constant", h), p.x0, p.duration, steps=p.steps)
            rate = growth_rate(run)
            work.status(h=h, growth=rate)
            return rate

        try:
            return find_margin(growth, p.low, p.high, width=p.width)
        except ValueError as reason:
            return str(reason)

    def answer(self, x: AskedState, t: int, result: Result | None, new: bool) -> tuple[AskedState, Mapping[str, Any]]:
        """Publish a new result."""
        if result is None or not new:
            return x, {}
        answer = result.answer
        if not isinstance(answer, Margin):
            self.report(Level.WARN, "no_margin", str(answer))
            return x, {"margin": (0.0, self.p.low, self.p.high, 0.0)}
        return x, {"margin": (answer.h, answer.low, answer.high, answer.growth.get(answer.h, 0.0))}
