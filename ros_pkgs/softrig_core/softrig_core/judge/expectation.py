"""What a figure is expected to be: a value with a tolerance, or bounds."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

from pydantic import BeforeValidator

from ..entry import Entry

_NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
_TWO_SIDED = re.compile(rf"{_NUMBER}\s*\+-\s*{_NUMBER}\s*(%?)")
_BOUND = re.compile(rf"at (most|least) {_NUMBER}")
_RANGE = re.compile(rf"between {_NUMBER} and {_NUMBER}")
WIDEST = 0.25  # a tolerance beyond this share of its value judges nothing
FORMS = "expected a number, 'X +- T', 'X +- P %', 'at most X', 'at least X' or 'between A and B'"


class Expectation(Entry):
    """Limits of a figure; those that are None judge nothing.

    Parameters
    ----------
    expected, tolerance : float, optional
        Two-sided: |value - expected| <= tolerance.
    at_most, at_least : float, optional
        Bounds.
    """

    expected: float | None = None
    tolerance: float | None = None
    at_most: float | None = None
    at_least: float | None = None

    def holds(self, value: float) -> bool:
        """Whether a measured value is within the limits; never for NaN or infinity."""
        return (
            math.isfinite(value)
            and (self.expected is None or abs(value - self.expected) <= (self.tolerance or 0.0))
            and (self.at_most is None or value <= self.at_most)
            and (self.at_least is None or value >= self.at_least)
        )

    def margin(self, value: float) -> float:
        """How far a value is within its bounds, negative beyond one; NaN without a bound.

        It is a margin as requirements have it: two-sided expectations, of a value known beforehand, have none.
        """
        rooms = [
            *(() if self.at_most is None else (self.at_most - value,)),
            *(() if self.at_least is None else (value - self.at_least,)),
        ]
        return min(rooms, default=math.nan)


def parse(given: Any) -> Any:
    """Read an expectation as scenario files write it.

    ``0.694 +- 0.0069``, ``0.694 +- 1 %``, ``44`` (exactly), ``at most 0.02``, ``at least 3``, ``between 80 and 81.1``.

    Raises
    ------
    ValueError
        Another form, a tolerance above a quarter of the value, an empty range.
    """
    if isinstance(given, Expectation | dict):
        return given
    if isinstance(given, int | float) and not isinstance(given, bool):
        return Expectation(expected=given, tolerance=0.0)
    text = given.strip() if isinstance(given, str) else ""
    if found := _TWO_SIDED.fullmatch(text):
        value, tolerance = float(found[1]), float(found[2])
        if found[3]:
            tolerance *= abs(value) / 100.0
        if tolerance < 0.0:
            raise ValueError("a tolerance is not negative")
        if value and tolerance > WIDEST * abs(value) * (1.0 + 1e-9):
            raise ValueError(
                f"the tolerance is {tolerance / abs(value):.0%} of the value and judges little; say what is meant: "
                f"'between {value - tolerance:.6g} and {value + tolerance:.6g}', 'at most ...' or 'at least ...'"
            )
        return Expectation(expected=value, tolerance=tolerance)
    if found := _BOUND.fullmatch(text):
        return Expectation(**{f"at_{found[1]}": float(found[2])})
    if found := _RANGE.fullmatch(text):
        low, high = float(found[1]), float(found[2])
        if low > high:
            raise ValueError(f"between {low:g} and {high:g}: nothing is")
        return Expectation(at_least=low, at_most=high)
    raise ValueError(FORMS)


Expected = Annotated[Expectation, BeforeValidator(parse)]
