"""Perturb and observe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from .search import Moves, Options, Search, Seed


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

    remembers = False

    def __init__(
        self,
        lower: Sequence[float],
        upper: Sequence[float],
        seed: Seed = 0,
        *,
        step: float = 0.005,
        initial: float | None = None,
        **options: Unpack[Options],
    ) -> None:
        if len(lower) != 1:
            raise ValueError(f"perturb and observe has one variable, got bounds of {len(lower)}")
        self.step = step
        self.initial = lower[0] if initial is None else initial
        if not lower[0] <= self.initial <= upper[0]:
            raise ValueError(f"initial is {self.initial}, expected it within [{lower[0]}, {upper[0]}]")
        super().__init__(lower, upper, seed, **options)

    def moves(self) -> Moves:  # noqa: D102
        low, high = float(self.lower[0]), float(self.upper[0])
        x, step = self.initial, self.step
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
