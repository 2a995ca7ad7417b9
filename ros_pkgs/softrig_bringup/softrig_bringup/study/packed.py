"""A study as one file: its inputs and its rows, which `study --like FILE` repeats."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError, load_scenario
from softrig_core.scenario.scenario_file import locate
from softrig_core.scenario.yaml_file import read_mapping

from ..pack.cargo import check_scenario
from ..pack.packed import about, need_packages, opened, placeless
from ..pack.parts import SCENARIO, STUDY, is_pack
from .batch import row_of
from .definition import FILE, Study, make_study
from .draw import drafts_of
from .engine import check_study, content_of, same
from .table import Row

ROWS = "rows.jsonl"


def of_folder(folder: Path) -> Study:
    """Read the definition of the study whose results are in a folder.

    Raises
    ------
    ScenarioError
        It has none, or a scenario, code or file of it has changed since.
    """
    if not (folder / FILE).is_file():
        raise ScenarioError(f"{folder}: no {FILE} in it, expected results of a study; run it again to write that file")
    study = make_study(read_mapping(folder / FILE))
    drafts = drafts_of(study)
    same(content_of(study, drafts, check_study(study, drafts)), folder / "study.json", "study")
    return study


def standing_alone(study: Study) -> tuple[Study, dict[str, dict[str, Any]]]:
    """Return a study that names its scenarios as the file has them, and the content of these by name."""
    drafts = drafts_of(study)
    names = {name: locate(name)[0] for name in drafts}
    if len({*names.values()}) < len(names):
        raise ScenarioError(f"{study.name}: two of its scenarios are called {min(names.values())}; rename one")
    cases = {
        case: changes | ({"scenario": names[changes["scenario"]]} if "scenario" in changes else {})
        for case, changes in study.cases.items()
    }
    alone = study.model_copy(update={"scenario": names[study.scenario], "cases": cases})
    return alone, {names[name]: draft.raw for name, draft in drafts.items()}


def rows_alone(rows: Sequence[Row]) -> bytes:
    """Return rows without paths of this machine: scenarios by name, errors of failed runs without paths."""
    lines = []
    for row in rows:
        entries = {**row, "scenario": locate(row["scenario"])[0], "error": placeless(row["error"])}
        lines.append(json.dumps(entries, separators=(",", ":")) + "\n")
    return "".join(lines).encode()


def unpacked(path: Path) -> tuple[Study, list[dict[str, Any]]]:
    """Read a study and its rows from a file that `softrig pack` has written.

    Raises
    ------
    ScenarioError
        Another file; the code in it has been admitted before, see `softrig_bringup.pack.trust`.
    """
    if not is_pack(path):
        raise ScenarioError(f"--like {path}: expected a file that `softrig pack` has written of a study")
    folder = opened(path)
    stated = about(folder)
    if not (folder / STUDY / FILE).is_file():
        raise ScenarioError(f"--like {path}: it holds a run, expected a study; `softrig run --like` repeats it")
    need_packages(f"--like {path}", [*stated.packages, *stated.code])
    study = make_study(read_mapping(folder / STUDY / FILE))

    def packed_path(name: str) -> str:
        file = folder / SCENARIO / f"{name}.yaml"
        if os.path.basename(name) != name or not file.is_file():
            raise ScenarioError(f"--like {path}: no scenario {name!r} in it")
        check_scenario(folder, load_scenario(str(file)), stated)
        return str(file)

    cases = {
        case: changes | ({"scenario": packed_path(str(changes["scenario"]))} if "scenario" in changes else {})
        for case, changes in study.cases.items()
    }
    result = study.model_copy(update={"scenario": packed_path(study.scenario), "cases": cases})
    try:
        with (folder / STUDY / ROWS).open("rb") as file:
            rows = [row_of(line) for line in file]
    except OSError:
        raise ScenarioError(f"--like {path}: no {STUDY}/{ROWS} in it") from None
    if None in rows:
        raise ScenarioError(f"--like {path}: {STUDY}/{ROWS}, line {rows.index(None) + 1}: expected a row of a study")
    return result, [row for row in rows if row is not None]


def differing(before: Sequence[Row], after: Sequence[Row]) -> Iterator[str]:
    """Name the rows that are not repeated, and the first difference in each."""
    rows: Mapping[int, Row] = {row["number"]: row for row in after}
    for row in before:
        repeated = rows.get(row["number"])
        if repeated is None:
            yield f"row {row['number']} is missing"
            continue
        for key in ("case", "seed", "overrides", "figures", "never"):
            if row.get(key) != repeated.get(key):
                yield f"row {row['number']}: {key} {row.get(key)} there, {repeated.get(key)} here"
                break
        else:
            if bool(row["error"]) != bool(repeated["error"]):
                yield f"row {row['number']}: {'broke' if row['error'] else 'ended'} there, not here"
