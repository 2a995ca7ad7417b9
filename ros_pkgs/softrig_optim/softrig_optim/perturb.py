"""Perturb and observe."""

from __future__ import annotations

from dataclasses import dataclass

from .search import Moves, Search, Seed


@dataclass(eq=False, repr=False, kw_only=True)
class PerturbObserve(Search):
    """Perturb and observe (P&O): step on while the value does not get worse, turn round when it does; never ends.

    Parameters
    ----------
    step : float
        Size of a step of the one variable.
    initial : float, optional
        Start, the lower bound when absent. The first step goes up.
    **options
        Those of `Search`.

    References
    ----------
    J. Farzaneh, A. Karsaz, 2020, section III.A.
    """

    step: float = 0.005
    initial: float | None = None

    remembers = False

    def __post_init__(self, seed: Seed) -> None:
        if len(self.lower) != 1:
            raise ValueError(f"perturb and observe has one variable, got bounds of {len(self.lower)}")
        self.start = self.lower[0] if self.initial is None else self.initial
        if not self.lower[0] <= self.start <= self.upper[0]:
            raise ValueError(f"initial is {self.start}, expected it within [{self.lower[0]}, {self.upper[0]}]")
        super().__post_init__(seed)

    def moves(self) -> Moves:  # noqa: D102
        low, high = float(self.lower[0]), float(self.upper[0])
        x, step = self.start, self.step
        (cost,) = yield [(x,)]
        while True:
            # A step beyond a bound turns before it is made: clipped to the bound, it could evaluate the same point
            # again.
            if not low <= x + step <= high:
                step = -step
            self.iteration += 1
            x = min(max(x + step, low), high)
            before = cost
            (cost,) = yield [(x,)]
            if cost > before:
                step = -step
