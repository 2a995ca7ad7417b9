"""The verb `study`: run, table, numbers, pictures, page."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError
from softrig_core.extras import need
from softrig_core.guard import replace

from ..folder import STUDY, ResultsFolder
from ..page.html import write_page
from ..page.paper_table import write_paper_table
from ..study.definition import FILE, Study, list_studies, saved
from ..study.engine import run_study
from ..study.options import folder_name, study_of
from ..study.page import body_of, print_study, units_of
from ..study.pictures import draw_study
from ..study.statistics import not_judged, statistics
from ..study.table import claims, results, without_signals, write_table
from ..study.tabled import for_paper


def main(options: argparse.Namespace) -> int:
    """Run a study and write its results; 1 when an expectation or a claim does not hold, 3 when a run broke."""
    if options.study == "list":
        print("\n".join(sorted(list_studies())))
        return 0
    if options.like is not None:
        # Only a repeated study needs what reads packs, whose import takes a third of a second.
        from ..pack.trust import admitted

        if (status := admitted(options)) is not None:
            return status  # status of the sandbox
    study, before = (study_of(options), None) if options.like is None else _again(options)
    name = f"study_{study.name}-again" if before is not None else folder_name(study.name, options)
    out = options.out or Path("runs") / name
    widths = dict(map(_width, options.width))
    # A missing package is an error before hours of runs, not after them.
    need("pyarrow", "the table of a study")
    log = run_study(
        study,
        out,
        workers=options.workers,
        scheduler=options.scheduler,
        distinct=not (options.force or before is not None),
    )
    rows = without_signals(log.rows())
    units = units_of(rows)
    result = results(study, rows, units)
    judged = claims(study, result)
    over = statistics(study, rows, units, widths)
    content = {
        "study": study.name,
        "runs": len(rows),
        "broken": sum(bool(r["error"]) for r in rows),
        "not_judged": not_judged(rows),
        "summaries": [r.plain() for r in result],
        "claims": [c.plain() for c in judged],
    } | over.content()
    folder = ResultsFolder(out, STUDY)
    with folder.alone(), folder.anew() as new:
        write_table(rows, new, study.duration)
        replace(new / FILE, saved(study))
        pictures = draw_study(study, rows, log.rows() if study.signals else (), new, units, options.format)
        if over.lines:
            for ending in ("csv", "tex"):
                write_paper_table(new / f"statistics.{ending}", "case", *for_paper(over))
        replace(new / "summaries.json", json.dumps(content, indent=1) + "\n")
        write_page(new / "report.html", study.title, list(body_of(study, rows, result, judged, over, pictures, units)))
    print_study(study, rows, result, judged, over, out)
    if before is not None:
        from ..study.packed import differing

        apart = list(differing(before, rows))
        text = f"repeats {options.like} row for row" if not apart else f"{len(apart)} of {len(before)} rows are others"
        print("; ".join([text, *apart[:3]]))
        return 1 if apart else 0
    if any(row["error"] for row in rows):
        return 3
    return 0 if all(r.passed for r in result) and all(c.holds is not False for c in judged) else 1


def _again(options: argparse.Namespace) -> tuple[Study, list[dict[str, Any]]]:
    stated = ("grid", "draw", "against", "subject_to", "figures", "signals", "seeds", "duration", "search", "study")
    if wrong := [name for name in stated if getattr(options, name)]:
        raise ScenarioError(f"--like repeats a study as it was: expected no {wrong[0]} beside it")
    from ..study.packed import unpacked

    return unpacked(options.like)


def _width(text: str) -> tuple[str, float]:
    name, _, width = text.rpartition("=")
    try:
        result = float(width) if name else math.nan
    except ValueError:
        result = math.nan
    if not 0.0 < result < math.inf:
        raise ScenarioError(f"--width {text!r}: expected FIGURE=W, a width above 0")
    return name.strip(), result
