"""JUnit XML, as continuous integration reads it: a suite a scenario, a case a figure, requirement or claim."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from softrig_core.guard import replace


@dataclass(frozen=True)
class Case:
    """One judged value.

    Parameters
    ----------
    failure : str
        Why it does not hold; empty when it does.
    text : str
        What was measured.
    unit : str
        Of that, where it is a number.
    """

    name: str
    failure: str = ""
    text: str = ""
    unit: str = ""


@dataclass(frozen=True)
class Suite:
    """The verdicts on a run, as a JUnit test suite.

    Parameters
    ----------
    seconds : float
        Wall-clock time of the run; each case reports an equal share, because servers add up the times of the cases.
    error : str
        Why the run failed; empty if it did not.
    """

    name: str
    seconds: float
    cases: Sequence[Case] = ()
    error: str = ""

    @property
    def failures(self) -> list[Case]:
        """The cases that do not hold."""
        return [case for case in self.cases if case.failure]


def write_reports(junit: Path | None, suites: Sequence[Suite], as_json: Path | None, content: Any) -> None:
    """Write the requested reports for machines: JUnit XML, and the content as JSON."""
    if junit is not None:
        write_junit(junit, suites)
    if as_json is not None:
        replace(as_json, json.dumps(content, indent=1) + "\n")


def write_junit(path: Path, suites: Sequence[Suite]) -> None:
    """Write a report that appears whole or not at all."""
    root = Element("testsuites", _counts(suites))
    for suite in suites:
        node = SubElement(root, "testsuite", {"name": _printable(suite.name)} | _counts([suite]))
        share = 0.0 if suite.error else suite.seconds / max(len(suite.cases), 1)
        for case in suite.cases:
            about = SubElement(
                node, "testcase", classname=_printable(suite.name), name=_printable(case.name), time=f"{share:.4f}"
            )
            if case.failure:
                SubElement(about, "failure", message=_printable(case.failure))
            if case.text:
                SubElement(about, "system-out").text = _printable(case.text)
        if suite.error:
            about = SubElement(
                node, "testcase", classname=_printable(suite.name), name="run", time=f"{suite.seconds:.3f}"
            )
            SubElement(about, "error", message=_printable(suite.error))
    indent(root)
    replace(path, tostring(root, encoding="unicode", xml_declaration=True) + "\n")


def _counts(suites: Sequence[Suite]) -> dict[str, str]:
    errors = sum(bool(s.error) for s in suites)
    return {
        "tests": str(sum(len(s.cases) for s in suites) + errors),
        "failures": str(sum(len(s.failures) for s in suites)),
        "errors": str(errors),
        "time": f"{sum(s.seconds for s in suites):.3f}",
    }


def _printable(text: str) -> str:
    """Replace what XML 1.0 does not allow: control characters, halves of surrogate pairs, U+FFFE and U+FFFF."""
    return re.sub(r"[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)
