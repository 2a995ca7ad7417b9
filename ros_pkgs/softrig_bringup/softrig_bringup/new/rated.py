"""A scenario from the rated values of a data sheet; an entry point of a package turns them into a rig."""

from __future__ import annotations

import importlib.metadata
import math
import os
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from softrig_core import ScenarioError
from softrig_core.guard import replace
from softrig_core.kit.file_format import number_of
from softrig_core.scenario.scenario_file import find

GROUP = "softrig_data_sheets"  # entry points: (name, rated values) to the text of a scenario and what was assumed
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")  # 3,000: three, or three thousand


def from_data_sheet(name: str, parent: Path, kind: str, rated: Sequence[str], command: str) -> str:
    """Write ``NAME.yaml`` and return what to print.

    Parameters
    ----------
    name : str
        Of the scenario.
    parent : Path
        Folder in which the file is made.
    kind : str
        An entry point of `GROUP`.
    rated : sequence of str
        ``NAME=VALUE`` each.
    command : str
        Command with which a user starts softrig.

    Raises
    ------
    ScenarioError
        An unknown kind, a value that is no number, values that are missing or contradict, or a file that is there.
    """
    points = {p.name: p for p in importlib.metadata.entry_points(group=GROUP)}
    if kind not in points:
        raise ScenarioError(f"--plant {kind}: unknown; there are {', '.join(sorted(points))}")
    if not name.isidentifier():
        raise ScenarioError(f"name {name!r}: expected letters, digits and _, as in my_drive")
    if (existing := find(name)) is not None:
        raise ScenarioError(f"name {name!r}: `run {name}` is a scenario already ({existing.name}); choose another")
    numbers: dict[str, float] = {}
    for item in rated:
        key, result, value = item.partition("=")
        number = number_of(value.replace(",", "."))
        if _THOUSANDS.fullmatch(value.strip()):
            english, german = value.replace(",", ""), value.replace(",", ".")
            raise ScenarioError(f"--rated {item}: {value} may be {english} or {german}; write one of them")
        if not result or not math.isfinite(number):
            raise ScenarioError(f"--rated {item}: expected NAME=VALUE with a number, as speed=3000")
        numbers[key.strip()] = number
    try:
        text, assumed = points[kind].load()(name, numbers)
    except ValueError as error:
        raise ScenarioError(f"--rated: {error}") from None
    path = parent / f"{name}.yaml"
    if path.exists() or path.is_symlink():
        raise ScenarioError(f"{path} exists already; choose another name or --into DIR")
    path.parent.mkdir(parents=True, exist_ok=True)
    replace(path, text)
    shown = shlex.quote(os.path.relpath(path))
    lines = [f"wrote {shown}; assumed, because the rated values do not have it:", *(f"  {line}" for line in assumed)]
    return "\n".join([*lines, "now:", f"  {command} run {shown} --mode inprocess"])
