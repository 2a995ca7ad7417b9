"""The page of `softrig check --claims`: for each paper every claim with its measurement, as HTML and as Markdown."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from xml.etree.ElementTree import Element

from softrig_core import Scenario, load_scenario
from softrig_core.judge.claims import VERDICTS
from softrig_core.judge.units import pretty_unit
from softrig_core.verdict.findings import Finding

from ..options.repeat import scenario_word, words
from ..page.citations import Citation, cited, listed, sources
from ..page.html import e, mark, page, table
from ..page.wording import short
from ..plots.named import OVERVIEW
from ..study.definition import list_studies

HEADER = ("Claim", "Where", "Published", "Agrees when", "Measured", "Verdict", "Run")
AGREES = (
    "Agrees when: the published number with its tolerance (5 % where a claim states none), or the bound or the "
    "figure of ours that the claim compares with. One statement that is held against several figures or "
    "scenarios counts once."
)


def counts(rows: Sequence[Finding]) -> str:
    """Describe how many claims have which verdict, and how many verdicts are false; a repeated claim counts once."""
    counter = Counter(verdict for verdict in _verdicts(rows).values())
    text = ", ".join(f"{counter[v]} {v.replace('_', ' ')}" for v in VERDICTS if counter[v])
    false = sum(not row.holds for row in rows)
    total = f"{counter.total()} claims" + (f" in {len(rows)} rows" if len(rows) > counter.total() else "")
    return f"{total}: {text}; " + (f"{false} verdicts are not borne out" if false else "every verdict holds")


def _verdicts(rows: Sequence[Finding]) -> dict[tuple[str, ...], str]:
    return {row.statement: row.verdict for row in rows}


def by_system(
    scenarios: Sequence[Scenario], rows: Sequence[Finding]
) -> Iterator[tuple[str, list[Scenario], list[Finding]]]:
    """Yield system, scenarios and findings, the systems by name."""
    system = {s.name: s.system for s in scenarios}
    for name, group in groupby(sorted(rows, key=lambda r: system[r.scenario]), lambda r: system[r.scenario]):
        yield name, [s for s in scenarios if s.system == name], list(group)


def html(scenarios: Sequence[Scenario], rows: Sequence[Finding], without: str = "", out: Path | None = None) -> str:
    """Create the HTML page.

    Parameters
    ----------
    without : str
        Text that names what is not on the page.
    out : Path, optional
        Folder of the page and of the runs that it links.
    """
    groups = list(by_system(scenarios, rows))
    totals: list[tuple[Element | str, ...]] = [
        (e("a", system, href=f"#{system}"), *(_count(group, v) for v in VERDICTS), _borne_out(group))
        for system, _, group in groups
    ]
    header = ("System", *(v.replace("_", " ").capitalize() for v in VERDICTS), "")
    body = [
        e(
            "header",
            e("h1", "Claims of the papers, and which hold"),
            e("p", counts(rows), class_="what"),
            *([e("p", without, class_="what")] if without else []),
        ),
        table(header, totals, " nnnnn "),
        e(
            "p",
            *(element for v, text in VERDICTS.items() for element in (e("b", v.replace("_", " ")), f": {text}. ")),
            class_="note",
        ),
        e("p", AGREES, class_="note"),
    ]
    for system, members, group in groups:
        cells: list[tuple[Element | str, ...]] = [
            (
                _claim(r),
                r.where,
                short(r.published),
                r.asked,
                f"{r.measured_text} {pretty_unit(r.unit)}".strip(),
                _verdict(r),
                _run(r, out),
            )
            for r in group
        ]
        names = list(dict.fromkeys(r.scenario for r in group))
        papers = list(sources(_cited(members))) or [e("p", text, class_="what") for text in _stated(members)]
        body.append(
            e(
                "section",
                e("h2", system),
                *papers,
                table(HEADER, cells, "  n n  "),
                e("details", e("summary", "Repeat"), e("pre", "\n".join(map(command, names)))),
                id=system,
            )
        )
    return page("Results", body)


def markdown(scenarios: Sequence[Scenario], rows: Sequence[Finding], without: str = "") -> str:
    """Create the Markdown page; see `html`."""
    lines = [
        "# Claims of the papers, and which hold",
        "",
        f"{counts(rows)}. Made by `scripts/softrig check --claims`.",
        "",
    ]
    lines += [f"{without}.", ""] if without else []
    lines += ["| system | " + " | ".join(v.replace("_", " ") for v in VERDICTS) + " |", "|---" * 6 + "|"]
    groups = list(by_system(scenarios, rows))
    lines += [f"| {s} | " + " | ".join(_count(group, v) for v in VERDICTS) + " |" for s, _, group in groups]
    lines += ["", *(f"- **{v.replace('_', ' ')}**: {text}" for v, text in VERDICTS.items()), "", AGREES]
    for system, members, group in groups:
        lines += ["", f"## {system}", "", *(listed(_cited(members)) or _stated(members)), ""]
        lines += ["| claim | where | published | agrees when | measured | verdict | scenario |", "|---" * 7 + "|"]
        for r in group:
            verdict = r.verdict.replace("_", " ") + ("" if r.holds else " (NOT BORNE OUT)")
            reason = f": {r.reason}" if r.reason else ""
            numbers = [_with_unit(short(r.published), r), r.asked, _with_unit(r.measured_text, r)]
            cells = [r.text, r.where, *numbers, f"**{verdict}**{reason}", f"`{r.scenario}`"]
            lines.append("| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |")
    lines += [
        "",
        "Repeat with `scripts/softrig run SCENARIO --mode inprocess`; a study with `scripts/softrig study NAME`.",
    ]
    lines.append("")
    return "\n".join(lines)


def _stated(scenarios: Sequence[Scenario]) -> list[str]:
    """Return the sources that scenarios state, for scenarios without a paper."""
    return list(dict.fromkeys(s.source for s in scenarios))


def _cited(scenarios: Sequence[Scenario]) -> tuple[Citation, ...]:
    return cited(list(dict.fromkeys(key for s in scenarios for key in s.cites)))


def command(scenario: str) -> str:
    """Return the command that repeats the measurement of a scenario or study."""
    if scenario in list_studies():
        return shlex.join(words((), "study", scenario))
    nodes = load_scenario(scenario).nodes.values()
    return shlex.join([*words((n.package for n in nodes), "run"), scenario_word(scenario), "--mode", "inprocess"])


def _run(row: Finding, out: Path | None) -> Element:
    """Return the scenario with its report and its first picture, if they exist."""
    name = row.figure.rpartition(".")[0] or row.scenario
    folder = Path("runs", name)
    if out is None or not (out / folder / "report.html").is_file():
        return e("code", name)
    first = next(iter(sorted((out / folder).glob("plot_01_*.svg"))), out / folder / OVERVIEW)
    return e(
        "div",
        e("a", e("code", name), href=f"{folder}/report.html"),
        " ",
        e("a", "picture", href=f"{folder}/{first.name}"),
    )


def _claim(row: Finding) -> Element:
    figure = row.figure.replace("_", " ")
    return e("div", row.text, *([e("div", figure, class_="note")] if figure and figure != row.text else []))


def _verdict(row: Finding) -> Element:
    word = row.verdict.replace("_", " ")
    shown = e("b", word) if row.holds else mark(False, f"{word}: not borne out")
    return e("div", shown, *([e("div", row.reason, class_="note")] if row.reason else []))


def _borne_out(group: Sequence[Finding]) -> Element:
    false = sum(not r.holds for r in group)
    return mark(not false, f"{false} not borne out" if false else "all hold")


def _count(group: Sequence[Finding], verdict: str) -> str:
    return str(sum(v == verdict for v in _verdicts(group).values()) or "")


def _with_unit(text: str, row: Finding) -> str:
    return f"{text} {row.unit}" if text and row.unit else text
