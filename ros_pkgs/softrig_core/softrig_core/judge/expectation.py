"""Expectation of a figure: a value with a tolerance, or bounds."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BeforeValidator

from ..entry import Entry
from ..errors import ScenarioError
from .expression import number, references

_NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
_TWO_SIDED = re.compile(rf"{_NUMBER}\s*\+-\s*{_NUMBER}\s*(%?)")
_BOUND = re.compile(rf"at (most|least) {_NUMBER}")
_RANGE = re.compile(rf"between {_NUMBER} and {_NUMBER}")
_FOLLOWING = re.compile(r"(?:at (most|least)|between) (.+)")  # forms of expectations with $ references
# A tolerance beyond this share of its value is no test, so it has to be written as bounds.
WIDEST = 0.25
FORMS = "expected a number, 'X +- T', 'X +- P %', 'at most X', 'at least X' or 'between A and B'"


class Expectation(Entry):
    """Limits of a figure; a limit of None is not checked.

    Parameters
    ----------
    expected, tolerance : float, optional
        Two-sided: |value - expected| <= tolerance.
    at_most, at_least : float, optional
        Bounds.
    text : str
        The written text if it follows the machine, that is, contains ``$node.parameter``. Its numbers are known once
        the nodes are known (`resolved`).
    """

    expected: float | None = None
    tolerance: float | None = None
    at_most: float | None = None
    at_least: float | None = None
    text: str | None = None

    @property
    def follows(self) -> bool:
        """Return whether all numbers except zero are references to parameters, so that they apply to a changed machine,
        too.
        """
        return bool(self.text) or not any((self.expected, self.tolerance, self.at_most, self.at_least))

    def resolved(self, value: Callable[[str], Any]) -> Expectation:
        """Return the expectation with its references replaced by numbers; unchanged if it has none.

        Parameters
        ----------
        value : callable
            Returns the value of a reference, given without its dollar sign.

        Raises
        ------
        ScenarioError
            A reference is unknown, a value is not a number, or the range is empty.
        """
        return _following(self.text, lambda part: number(part, value)) if self.text else self

    def holds(self, value: float) -> bool:
        """Return whether a measured value is within the limits; never for NaN or infinity.

        Raises
        ------
        ScenarioError
            The expectation depends on parameters of the machine that are not known yet.
        """
        if self.text and (self.expected, self.at_most, self.at_least) == (None, None, None):
            raise ScenarioError(f"{self.text!r} refers to parameters of nodes: expected the expectation of a rig")
        return (
            # NaN compares false with bounds and infinity would satisfy "at least", so neither may pass.
            math.isfinite(value)
            and (self.expected is None or abs(value - self.expected) <= (self.tolerance or 0.0))
            and (self.at_most is None or value <= self.at_most)
            and (self.at_least is None or value >= self.at_least)
        )

    def margin(self, value: float) -> float:
        """Return how far a value is within its bounds, negative beyond one; NaN without a bound.

        It is a margin like that of a requirement. Two-sided expectations are for values that are known beforehand and
        have none.
        """
        rooms = [
            *(() if self.at_most is None else (self.at_most - value,)),
            *(() if self.at_least is None else (value - self.at_least,)),
        ]
        return min(rooms, default=math.nan)


def parse(raw: Any) -> Any:
    """Read an expectation as scenario files write it.

    ``0.694 +- 0.0069``, ``0.694 +- 1 %``, ``44`` (exactly), ``at most 0.02``, ``at least 3``, ``between 80 and 81.1``.
    Any of these numbers may be arithmetic over parameters of nodes: ``at most 1.03 * $motor.current``.

    Raises
    ------
    ValueError
        The text has another form, the tolerance is above a quarter of the value, or the range is empty.
    """
    if isinstance(raw, Expectation | dict):
        return raw
    if isinstance(raw, int | float) and not isinstance(raw, bool):
        return Expectation(expected=raw, tolerance=0.0)
    text = raw.strip() if isinstance(raw, str) else ""
    if references(text):
        return Expectation(text=text)
    if match := _TWO_SIDED.fullmatch(text):
        value, tolerance = float(match[1]), float(match[2])
        if match[3]:
            tolerance *= abs(value) / 100.0
        if tolerance < 0.0:
            raise ValueError("a tolerance is not negative")
        # The factor leaves room for the rounding of a tolerance that is written as exactly the limit.
        if value and tolerance > WIDEST * abs(value) * (1.0 + 1e-9):
            raise ValueError(
                f"the tolerance is {tolerance / abs(value):.0%} of the value, which is a weak test; state the limits: "
                f"'between {value - tolerance:.6g} and {value + tolerance:.6g}', 'at most ...' or 'at least ...'"
            )
        return Expectation(expected=value, tolerance=tolerance)
    if match := _BOUND.fullmatch(text):
        return Expectation(**{f"at_{match[1]}": float(match[2])})
    if match := _RANGE.fullmatch(text):
        low, high = float(match[1]), float(match[2])
        if low > high:
            raise ValueError(f"between {low:g} and {high:g}: nothing is")
        return Expectation(at_least=low, at_most=high)
    raise ValueError(FORMS)


def _following(text: str, value: Callable[[str], float]) -> Expectation:
    """Parse an expectation with references; `value` computes the numbers of its parts."""
    if match := _FOLLOWING.fullmatch(text):
        if match[1]:
            return Expectation(**{f"at_{match[1]}": value(match[2])}, text=text)
        low, between, high = match[2].partition(" and ")
        if not between:
            raise ScenarioError(f"{text!r}: {FORMS}")
        limits = Expectation(at_least=value(low), at_most=value(high), text=text)
        if value(low) > value(high):
            raise ScenarioError(f"{text!r}: between {value(low):g} and {value(high):g}: nothing is")
        return limits
    middle, plus, width = text.partition("+-")
    share = width.rstrip().endswith("%")
    wanted = value(middle)
    tolerance = value(width.rstrip().rstrip("%")) if plus else 0.0
    if tolerance < 0.0:
        raise ScenarioError(f"{text!r}: a tolerance is not negative")
    return Expectation(expected=wanted, tolerance=tolerance * (abs(wanted) / 100.0 if share else 1.0), text=text)


Expected = Annotated[Expectation, BeforeValidator(parse)]
