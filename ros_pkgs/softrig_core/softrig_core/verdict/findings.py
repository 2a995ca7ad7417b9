"""Claims compared with measurements: of one run, or across scenarios."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from ..data import Data
from ..errors import ScenarioError
from ..judge.claims import Claim, Verdict
from ..judge.words import readable
from ..scenario.scenario import Scenario
from ..scenario.scenario_file import list_scenarios
from .result import Result

Figures = Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Finding(Data):
    """A claim and its check against the measurement.

    Parameters
    ----------
    scenario, key : str
        Scenario and key of the claim.
    text, where, reason : str
        Text of the claim, its place in the paper, and the reason of the verdict.
    asked : str
        Values that agree with the claim: the number with its tolerance, or what it is compared with.
    measured : float, optional
        None if the claim cannot be checked or the figure is not finite; `measured_text` is for people.
    holds : bool, optional
        Whether the verdict fits the measurement; None when nothing was measured for it here.
    """

    scenario: str
    key: str
    text: str
    where: str
    figure: str = ""
    unit: str = ""
    published: float | None = None
    measured: float | None = None
    measured_text: str = ""
    asked: str = ""
    verdict: Verdict
    reason: str = ""
    holds: bool | None = None

    @property
    def false(self) -> str:
        """Describe why the verdict of the claim is wrong; empty if it is right."""
        why = "cannot be checked" if self.holds is None else "does not hold"
        return f"the verdict {self.verdict} {why}: measured {self.measured_text}, {self.asked} {self.unit}".rstrip()

    @property
    def statement(self) -> tuple[str, ...]:
        """Describe the paper's statement and the outcome, over all scenarios, figures and bounds compared."""
        if self.text == _words(self.key):
            return self.scenario, self.key
        return self.text, self.where, str(self.published), self.verdict


def values(results: Iterable[Result]) -> dict[str, float]:
    """Return the measured value of each figure, infinity for an event that never happened, NaN for one that failed."""
    return {r.name: r.number for r in results}


def findings(scenario: Scenario, figures: Callable[[str], Figures | None], units: Mapping[str, str]) -> list[Finding]:
    """Compare the claims of a scenario with measurements.

    Parameters
    ----------
    figures : callable
        Figures of a scenario by its name; None when it has not been run.
    units : mapping
        Unit of the scenario's own figures.
    """
    return hold(scenario.name, scenario.claims, figures, units)


def hold(
    name: str, claims: Mapping[str, Claim], figures: Callable[[str], Figures | None], units: Mapping[str, str]
) -> list[Finding]:
    """Compare claims, of a scenario or of a study, with measurements; see `findings`.

    Parameters
    ----------
    name : str
        Of the scenario or study.
    claims : mapping of str to Claim
        By key.
    figures : callable
        Returns the figures of a scenario by its name; None if it was not run or failed.
    units : mapping of str to str
        Unit by figure.
    """
    return [_finding(name, key, claim, figures, units) for key, claim in claims.items()]


def _finding(
    name: str, key: str, claim: Claim, figures: Callable[[str], Figures | None], units: Mapping[str, str]
) -> Finding:
    figure = claim.figure or key
    value = _value(figure, name, figures)
    references = {kind: _value(r, name, figures) for kind, r in claim.compared().items()}
    holds: bool | None = True
    if claim.verdict != "not_checkable":
        known = value is not None and all(x is not None for x in references.values())
        sure = {kind: x for kind, x in references.items() if x is not None}
        holds = claim.holds(claim.agrees(value, sure)) if known and value is not None else None
    # The key of a claim that cannot be checked need not be the name of a figure; then there is nothing to show.
    speaks = claim.verdict != "not_checkable" or bool(claim.figure)
    return Finding(
        scenario=name,
        key=key,
        text=claim.text or _words(key),
        where=claim.where,
        figure=figure if speaks else "",
        unit=units.get(figure, ""),
        published=claim.published,
        measured=value if value is not None and math.isfinite(value) else None,
        measured_text=("?" if value is None else readable(value)) if speaks else "",
        asked=claim.asks(references),
        verdict=claim.verdict,
        reason=claim.reason,
        holds=holds,
    )


def _value(reference: float | str, default: str, figures: Callable[[str], Figures | None]) -> float | None:
    if not isinstance(reference, str):
        return reference
    scenario, _, figure = reference.rpartition(".")
    result = figures(scenario or default)
    return None if result is None else result.get(figure)


def _words(key: str) -> str:
    return key.replace("_", " ")


def needed(scenario: Scenario) -> set[str]:
    """Names of the scenarios whose figures its claims need, itself included.

    Raises
    ------
    ScenarioError
        A claim names a scenario that is not there.
    """
    names = {scenario.name}
    for key, claim in scenario.claims.items():
        for reference in (claim.figure, *claim.references()):
            name = reference.rpartition(".")[0]
            if name and name not in names and name not in list_scenarios():
                raise ScenarioError(f"{scenario.name}: claim {key}: scenario {name!r} is unknown")
            names |= {name} if name else set()
    return names
