"""Claims of a paper about figures, and their check against the measurement."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from ..entry import Entry
from .words import readable

Verdict = Literal["reproduced", "fitted", "corrected", "refuted", "not_checkable"]
VERDICTS: dict[Verdict, str] = {
    "reproduced": "what was measured agrees with it",
    "fitted": "agrees, but a parameter was identified from it, so it is no confirmation",
    "corrected": "agrees after a correction that the reason names",
    "refuted": "what was measured disagrees",
    "not_checkable": "cannot be decided, for the reason given",
}
# The share of the published value that agrees where a claim states no tolerance of its own.
TOLERANCE = 0.05
_PERCENT = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*%\s*")


class Claim(Entry):
    """One statement of a paper about a figure.

    Parameters
    ----------
    text : str
        The statement in words; needed where there is no published number.
    figure : str
        Name of the figure, with its scenario in front when it is another one's (``dc_motor_smc.rise_time``); the key
        of the claim when absent.
    published : float, optional
        The number that the paper prints.
    tolerance : float or str, optional
        How far from the published number agrees, absolute or ``"2 %"`` of it; `TOLERANCE` of it when absent.
    below, above, equals : float or str, optional
        Instead of `published`: a bound, a figure of this scenario, or ``scenario.figure`` of another.
    where : str
        Table, figure or equation of the paper.
    verdict : {"reproduced", "fitted", "corrected", "refuted", "not_checkable"}
    reason : str
        In a sentence; may be absent for ``reproduced`` alone.
    """

    text: str = ""
    figure: str = ""
    published: float | None = None
    tolerance: float | str | None = None
    below: float | str | None = None
    above: float | str | None = None
    equals: float | str | None = None
    where: str = Field(min_length=1)
    verdict: Verdict
    reason: str = ""

    @field_validator("tolerance")
    @classmethod
    def _width(cls, value: Any) -> Any:
        if isinstance(value, str) and not _PERCENT.fullmatch(value):
            raise ValueError("expected a number or a percentage such as '2 %'")
        if isinstance(value, int | float) and value < 0:
            raise ValueError("a tolerance is not negative")
        return value

    @model_validator(mode="after")
    def _complete(self) -> Claim:
        compared = [k for k in ("published", "below", "above", "equals") if getattr(self, k) is not None]
        if self.verdict != "not_checkable" and not compared:
            raise ValueError("expected a published number, or below, above or equals")
        if self.published is not None and len(compared) > 1:
            raise ValueError(f"published and {compared[1]}: expected one of them")
        if self.published is None and not self.text:
            raise ValueError("a claim without a published number needs its text")
        if self.verdict != "reproduced" and not self.reason:
            raise ValueError(f"the verdict {self.verdict} needs a reason")
        if self.published == 0.0 and self.tolerance is None and self.verdict != "not_checkable":
            raise ValueError("a published value of 0 needs a tolerance")
        return self

    def compared(self) -> dict[str, float | str]:
        """Return the comparison: ``below``, ``above``, ``equals`` with a number or a figure's name."""
        kinds = (("below", self.below), ("above", self.above), ("equals", self.equals))
        return {kind: x for kind, x in kinds if x is not None}

    def agrees(self, value: float, figures: Mapping[str, float] | None = None) -> bool:
        """Return whether the measurement agrees with the statement.

        Parameters
        ----------
        value : float
            Of the claim's figure; infinity for what never happens, NaN for what could not be measured.
        figures : mapping, optional
            The values behind `compared`.
        """
        if math.isnan(value):
            return False
        if self.published is not None:
            return self._near(value, self.published)
        limits = figures or {}
        return (
            ("below" not in limits or value < limits["below"])
            and ("above" not in limits or value > limits["above"])
            and ("equals" not in limits or self._near(value, limits["equals"]))
        )

    def _near(self, value: float, wanted: float) -> bool:
        # Infinity equals infinity ("never"), but their difference is NaN. The factor leaves room for rounding.
        return value == wanted or abs(value - wanted) <= self.width(wanted) * (1.0 + 1e-9)

    def width(self, wanted: float) -> float:
        """Return the distance from a number that still agrees."""
        if isinstance(self.tolerance, int | float):
            return float(self.tolerance)
        match = _PERCENT.fullmatch(self.tolerance) if self.tolerance else None
        return (float(match[1]) / 100.0 if match else TOLERANCE) * abs(wanted)

    def asks(self, figures: Mapping[str, float | None]) -> str:
        """Write the condition of agreement: ``0.607 ± 0.03 (5 %)``, ``below 0.02``, ``above a.rise_time = 0.69 here``.

        Parameters
        ----------
        figures : mapping
            The values behind `compared`; None for one that is not known.
        """

        def near(wanted: float) -> str:
            share = "" if isinstance(self.tolerance, int | float) else f" ({self.tolerance or f'{TOLERANCE:.0%}'})"
            return f"{wanted:.6g} ± {self.width(wanted):.3g}{share.replace('%', ' %').replace('  ', ' ')}"

        parts = [near(self.published)] if self.published is not None else []
        for kind, reference in self.compared().items():
            value = figures.get(kind)
            text = "?" if value is None else readable(value) if kind != "equals" else near(value)
            parts.append(f"{kind} {reference} = {text} here" if isinstance(reference, str) else f"{kind} {text}")
        return ", ".join(parts)

    def holds(self, agrees: bool) -> bool:
        """Return whether the verdict is right: all but refuted require agreement; not_checkable is always right."""
        return self.verdict == "not_checkable" or agrees == (self.verdict != "refuted")

    def references(self) -> list[str]:
        """Figures that it is compared with."""
        return [r for r in self.compared().values() if isinstance(r, str)]
