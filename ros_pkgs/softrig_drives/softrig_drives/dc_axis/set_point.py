"""Set point of an axis from a reference topic and two push buttons."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from softrig_core import Level


class Asked(NamedTuple):
    """Set point (mm), newest reference (mm; None before the first), and which buttons were down."""

    value: float = 0.0
    reference: float | None = None
    forward: bool = False
    reverse: bool = False


class SetPoint:
    """The newest of both wins: another reference value sets the set point, a press moves it from where it is.

    Parameters
    ----------
    step : float
        Change by one press, mm.
    report : callable
        `Block.report` of the owner.
    largest : float
        A larger step at once is reported, mm.
    """

    def __init__(self, step: float, report: Callable[[Level, str, str], None], largest: float = math.inf) -> None:
        self._step, self._report, self._largest = step, report, largest

    def __call__(self, x: Asked, reference: float | None, forward: bool, reverse: bool) -> Asked:
        """Process this period's inputs."""
        value, newest, was_forward, was_reverse = x
        if reference is not None and reference != newest:
            value = newest = reference
        forward_edge, reverse_edge = forward and not was_forward, reverse and not was_reverse
        if not (forward and reverse):
            value += self._step * (forward_edge - reverse_edge)
        elif forward_edge or reverse_edge:
            self._report(Level.WARN, "buttons", "both buttons pressed: no motion")
        if abs(value - x.value) > self._largest:
            self._report(
                Level.WARN, "step", f"step of {abs(value - x.value):g} mm without anti-windup: it will overshoot"
            )
        return Asked(value, newest, forward, reverse)
