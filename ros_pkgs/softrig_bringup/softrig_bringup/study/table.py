"""The table of a study: a row a run, as parquet and CSV, and the numbers over the runs."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from softrig_core import load_scenario
from softrig_core.arrow import arrow
from softrig_core.judge.expectation import Expectation
from softrig_core.verdict.findings import Finding, hold
from softrig_core.verdict.result import Result

from ..options.repeat import scenario_word, words
from .definition import Study, Summary

Row = Mapping[str, Any]
ALL = "all runs"  # label of all runs of a study without cases and grid


def without_signals(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows by number, without the data that are only drawn."""
    return sorted(({k: v for k, v in row.items() if k != "signals"} for row in rows), key=lambda r: int(r["number"]))


def write_table(rows: Sequence[Row], folder: Path, duration: float | None = None) -> None:
    """Write ``table.parquet`` and ``table.csv``: one row for each run, with its changes, measurements and verdicts."""
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    parameters = list(dict.fromkeys(name for row in rows for name in row["overrides"]))
    figures = list(dict.fromkeys(name for row in rows for name in row["figures"]))
    columns: dict[str, list[Any]] = {k: [row[k] for row in rows] for k in ("number", "scenario", "case", "seed")}
    columns |= {name: _column([row["overrides"].get(name) for row in rows]) for name in parameters}
    columns |= {f"figure.{name}": [row["figures"].get(name) for row in rows] for name in figures}
    for key in ("never", "missed", "not_judged"):
        columns[key] = [" ".join(row.get(key, ())) for row in rows]
    columns |= {k: [row[k] for row in rows] for k in ("passed", "error", "wall_s")}
    columns["command"] = [*_commands(rows, duration)]
    table = pyarrow.table({name: arrow(column) for name, column in columns.items()})
    pyarrow.parquet.write_table(table, folder / "table.parquet", compression="zstd")
    pyarrow.csv.write_csv(table, folder / "table.csv")


def _column(values: list[Any]) -> list[Any]:
    """Return a column; numbers stay numbers, and vectors or mixed values become text."""
    types = {type(v) for v in values if v is not None}
    if types <= {int, float} and bool not in types:
        return [None if v is None else float(v) for v in values]
    return values if types in ({str}, {bool}) else [None if v is None else json.dumps(v) for v in values]


def command(row: Row, duration: float | None = None) -> str:
    """Return the command that repeats a run."""
    return next(_commands([row], duration))


def _commands(rows: Iterable[Row], duration: float | None) -> Iterator[str]:
    """Yield the command of each run; a scenario of many runs is read once."""
    begins: dict[str, list[str]] = {}
    for row in rows:
        if (name := row["scenario"]) not in begins:
            nodes = load_scenario(name).nodes.values()
            begins[name] = [*words((node.package for node in nodes), "run"), scenario_word(name)]
        gathered = [*begins[name], "--mode", "inprocess", "--seed", str(row["seed"])]
        gathered += ["--duration", repr(duration)] if duration is not None else []
        for parameter, value in row["overrides"].items():
            gathered += ["--set", f"{parameter}={value if isinstance(value, str) else json.dumps(value)}"]
        yield shlex.join(gathered)


def label(study: Study, row: Row) -> str:
    """Describe the changes of a run, except its seed and random draws."""
    drawn = study.draws.parameters if study.draws else {}
    changes = [
        f"{k.rpartition('.')[2]} {in_short(v, 10)}"
        for k, v in row["overrides"].items()
        if k in study.grid and k not in drawn
    ]
    return ", ".join(([row["case"]] if row["case"] else []) + changes) or ALL


def in_short(value: Any, digits: int = 4) -> str:
    """Write a value of a parameter."""
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def summarise(rows: Sequence[Row], summary: Summary) -> float:
    """Compute a number over the runs; NaN without runs, or when one it needs could not be measured."""
    chosen = [row for row in rows if all(_value(row, k) == v for k, v in summary.where.items())]
    values = np.array([_number(row["figures"].get(summary.figure)) for row in chosen])
    if summary.statistic == "count":
        return float(len(chosen))
    if not len(chosen):
        return math.nan
    if summary.of is not None:
        return float(np.mean([summary.of.holds(v) for v in values]))
    if summary.statistic == "quantile":
        return float(np.quantile(values, summary.q))
    functions: dict[str, Callable[..., Any]] = {
        "mean": np.mean,
        "median": np.median,
        "std": np.std,
        "min": np.min,
        "max": np.max,
        "sum": np.sum,
    }
    return float(functions[summary.statistic](values))


def _value(row: Row, key: str) -> Any:
    return row[key] if key in ("case", "scenario", "seed") else row["overrides"].get(key)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def each_case(study: Study) -> Iterator[tuple[str, str, Summary]]:
    """Yield name, entry and content of each summary; one that chooses from no case is one of each."""
    for name, summary in study.summaries.items():
        if not study.each_case(summary):
            yield name, name, summary
            continue
        for case in study.cases:
            yield f"{name} ({case})", name, summary.model_copy(update={"where": summary.where | {"case": case}})


def results(study: Study, rows: Sequence[Row], units: Mapping[str, str]) -> list[Result]:
    """Judge the summaries of a study; those of a changed machine are only computed. `units` are of figures."""
    result = []
    for name, entry, summary in each_case(study):
        value = summarise(rows, summary)
        limits = study.expect.get(entry)
        published = next((c.published for k, c in study.claims.items() if (c.figure or k) == name), None)
        sure = math.isfinite(value)
        pure = summary.statistic in ("share", "count")
        result.append(
            Result(
                name=name,
                value=value if sure else None,
                number=value,
                unit="" if pure else units.get(summary.figure, ""),
                published=published,
                passed=limits is None or limits.holds(value),
                error="" if sure else f"the result is {value}",
                **(limits or Expectation()).model_dump(exclude={"text"}),
            ).not_judged(study.written)
        )
    return result


def claims(study: Study, gathered: Sequence[Result]) -> list[Finding]:
    """Compare the claims of a study with its summaries; those of a changed machine stay open."""
    values = {r.name: r.number for r in gathered}
    findings = hold(study.name, study.claims, lambda name: values if name == study.name else None, {})
    return [claim.having(holds=None) for claim in findings] if study.written else findings
