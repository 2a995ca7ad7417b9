"""Set point of an axis from a reference topic and two push buttons."""

from __future__ import annotations

import math
from collections.abc import Callable

from softrig_core import Level


class SetPoint:
    """The newest of both wins: another reference value sets the set point, a press moves it from where it is.

    Parameters
    ----------
    step : float
        What one press adds or takes, mm.
    report : callable
        `Block.report` of the owner.
    largest : float
        A larger step at once is reported, mm.
    """

    def __init__(self, step: float, report: Callable[[Level, str, str], None], largest: float = math.inf) -> None:
        self._report = report
        self.adjust(step, largest)
        self.start(0.0)

    def adjust(self, step: float, largest: float) -> None:
        """Take another size of a press and another limit; the set point stays."""
        self._step, self._largest = step, largest

    def start(self, value: float) -> None:
        """Begin at a value, with the buttons up and no reference yet."""
        self.value = value
        self._reference: float | None = None
        self._forward = self._reverse = False

    def update(self, reference: float | None, forward: bool, reverse: bool) -> None:
        """Take this period's inputs."""
        before = self.value
        if reference is not None and reference != self._reference:
            self.value = self._reference = reference
        self.value += self._pressed(forward, reverse)
        if abs(self.value - before) > self._largest:
            self._report(
                Level.WARN, "step", f"step of {abs(self.value - before):g} mm without anti-windup: it will overshoot"
            )

    def _pressed(self, forward: bool, reverse: bool) -> float:
        """Motion asked for by a button going down."""
        forward_edge, reverse_edge = forward and not self._forward, reverse and not self._reverse
        self._forward, self._reverse = forward, reverse
        if forward and reverse:
            if forward_edge or reverse_edge:
                self._report(Level.WARN, "buttons", "both buttons pressed: no motion")
            return 0.0
        return self._step * (forward_edge - reverse_edge)
