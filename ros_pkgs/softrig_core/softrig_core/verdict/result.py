"""The measured and judged value of a figure, for pages that display it and need none of the code that measures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..data import KEPT, LEAST, NAME, Data

DECIDED = "by its conditions alone"  # value of a requirement without a distance


@dataclass(frozen=True, kw_only=True)
class Result(Data):
    """A figure of a run: the measured value, the expected value, and the verdict.

    Parameters
    ----------
    value : float, optional
        None if it could not be computed or is not finite; `error` then has the reason: ``never`` for an event that does
        not happen.
    published : float, optional
        Value in the paper, from the claim about this figure.
    expected, tolerance, at_most, at_least : float, optional
        The expectation; if none is set, the figure is for information.
    passed : bool
        Written as ``pass``. A figure for information passes unless its value is impossible; so does a figure that is
        not judged.
    at_s : float, optional
        Of a requirement: the instant that decides its margin, s.
    violated_s : tuple of (float, float)
        Of a requirement: intervals in which it does not hold, s.
    open_from_s : float, optional
        Of a requirement: the instant from which on a part of it is undecided at the run's end, s; the decided part is
        judged.
    published_for : str
        Of a changed run whose expectation is a number for the unchanged machine: the parameters of that machine. The
        figure is then not judged.
    follows : bool
        Whether the expectation depends on the machine: it is computed from the nodes' parameters, or the figure is
        relative to them.
    settled : bool
        Of a run under way: whether the verdict is final.
    number : float
        As measured: infinity too, which JSON cannot hold.
    """

    name: str
    value: float | None
    unit: str = ""
    published: float | None = None
    expected: float | None = None
    tolerance: float | None = field(default=None, metadata={LEAST: 0.0})
    at_most: float | None = None
    at_least: float | None = None
    passed: bool = field(metadata={NAME: "pass"})
    error: str = ""
    at_s: float | None = None
    violated_s: tuple[tuple[float, float], ...] = ()
    open_from_s: float | None = None
    published_for: str = ""
    follows: bool = field(default=False, metadata={KEPT: False})
    settled: bool = field(default=False, metadata={KEPT: False})
    number: float = field(default=math.nan, metadata={KEPT: False})

    @property
    def limited(self) -> bool:
        """Return whether the figure has anything to be compared with."""
        return any(x is not None for x in (self.expected, self.at_most, self.at_least))

    @property
    def judged(self) -> bool:
        """Return whether the figure has an expectation that applies to this run."""
        return self.limited and not self.published_for

    def not_judged(self, why: str) -> Result:
        """Return the result for a changed machine: not judged, unless the expectation applies to it, too.

        Parameters
        ----------
        why : str
            Parameters of the machine for which it is published.
        """
        if self.follows or not self.judged or not why:
            return self
        return self.having(published_for=why, passed=True)
