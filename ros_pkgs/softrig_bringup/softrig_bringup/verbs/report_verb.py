"""The verb `report`."""

from __future__ import annotations

import argparse
import math

from softrig_core.verdict.result import Result

from ..folder import list_too
from ..page.paper_table import Column, write_paper_table
from ..page.wording import NEVER
from ..report.report import write_report


def main(options: argparse.Namespace) -> int:
    """Write the requested page."""
    runs, named = write_report(options.runs, options.out, options.label, check=True)
    list_too(options.out)
    print(f"wrote {options.out}")
    if options.table is not None:
        measures = dict.fromkeys((m.name, m.unit) for run in runs for m in run.metrics)
        have = [{(m.name, m.unit): _number(m) for m in run.metrics} for run in runs]
        columns = [Column(*key, [figures.get(key, math.nan) for figures in have]) for key in measures]
        write_paper_table(options.table, "run", named, columns)
        print(f"wrote {options.table}")
    return 0


def _number(metric: Result) -> float:
    return metric.value if metric.value is not None else math.inf if metric.error == NEVER else math.nan
