"""The page of `check`: which scenarios hold, and the judged values of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

from .html import NONE, e, mark, table
from .junit import Suite


def checked(suites: Sequence[Suite], outcomes: Sequence[Mapping[str, Any]], against: str) -> list[Element]:
    """Create the body of the page.

    Parameters
    ----------
    suites, outcomes : sequences of equal length
        What was judged of each scenario, and what else is known of it (``differs``, ``kind``).
    against : str
        File of the expectations; empty: each scenario's own.
    """
    good = sum(not suite.error and not suite.failures for suite in suites)
    asked = f"judged by {against}" if against else "judged by what each scenario expects"
    rows = []
    for k, (suite, outcome) in enumerate(zip(suites, outcomes, strict=True)):
        holding = f"{len(suite.cases) - len(suite.failures)} of {len(suite.cases)} hold"
        verdict = mark(not suite.error and not suite.failures, outcome["kind"] or holding)
        missed = suite.error or ", ".join(case.name for case in suite.failures) or NONE
        name = e("a", suite.name, href=f"#scenario-{k}") if suite.cases else suite.name
        rows.append((name, verdict, missed, *([", ".join(outcome["differs"]) or NONE] if against else [])))
    heads = ("Scenario", "Result", "Missed", *(["Differs in"] if against else []))
    head = e("header", e("h1", f"{good} of {len(suites)} scenarios hold"), e("p", asked, class_="what"))
    each = [_cases(k, suite) for k, suite in enumerate(suites) if suite.cases]
    return [head, table(heads, rows), *([e("h2", "Each scenario")] if each else []), *each]


def _cases(number: int, suite: Suite) -> Element:
    """Create the table of the judged values of one scenario; unfolded if something does not hold."""
    rows = [
        (case.name, case.failure or case.text, mark(not case.failure, "miss" if case.failure else "holds"))
        for case in suite.cases
    ]
    folded = e("details", e("summary", suite.name), table(("Name", "Measured", "Result"), rows))
    folded.set("id", f"scenario-{number}")
    if suite.failures:
        folded.set("open", "open")
    return folded
