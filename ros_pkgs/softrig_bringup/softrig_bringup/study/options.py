"""A study from the command line."""

from __future__ import annotations

import hashlib
import math
import re
from argparse import Namespace
from os.path import isfile
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError, list_scenarios
from softrig_core.scenario.scenario_file import locate
from softrig_core.scenario.yaml_file import read_yaml

from .definition import Study, list_studies, load_study, make_study

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
MOST = 10_000  # values of a range
LONGEST = 120  # letters of a folder's name


def study_of(options: Namespace) -> Study:
    """Give the study of a name or file, with the command line's changes; or make one of a scenario.

    Raises
    ------
    ScenarioError
        Neither a study nor a scenario, or an option that cannot be read.
    """
    name: str = options.study
    changes = _changes(options)
    path = Path(name)
    file = path.suffix in (".yaml", ".yml") and isfile(path)
    if name in list_studies() or (file and "scenario" in (read_yaml(path.read_text(), path.name) or {})):
        return make_study(load_study(name).model_dump() | changes)
    if not file and name not in list_scenarios():
        raise ScenarioError(
            f"{name!r} is neither a study nor a scenario; `softrig study list`, `softrig list` show them"
        )
    slug = locate(name)[0]
    return make_study({"name": slug, "title": f"Study of {slug}", "scenario": name} | changes)


def folder_name(name: str, options: Namespace) -> str:
    """Name the folder of a study by what is varied, so that studies that differ do not meet in one."""
    draws = [f"{options.method}_{options.draws}"] if options.draw else []
    search = [f"{'max' if options.maximise else 'min'}_{options.search}", *options.subject_to] if options.search else []
    parts = [f"study_{name}", *options.grid, *options.draw, *draws, *search]
    parts += [f"{key}_{value}" for key in ("seeds", "duration") if (value := getattr(options, key)) is not None]
    found = re.sub(r"[^A-Za-z0-9_.,:=+-]+", "_", "-".join(parts))
    return found if len(found) <= LONGEST else f"{found[:LONGEST]}-{hashlib.sha256(found.encode()).hexdigest()[:8]}"


def _changes(options: Namespace) -> dict[str, Any]:
    changes: dict[str, Any] = {k: getattr(options, k) for k in ("figures", "signals") if getattr(options, k)}
    changes |= {k: getattr(options, k) for k in ("duration", "seeds") if getattr(options, k) is not None}
    grid = dict(pair(text, "--grid", "NODE.PARAM=A,B,C or LOW:HIGH:STEP") for text in options.grid)
    if grid:
        changes["grid"] = {name: _values(name, values) for name, values in grid.items()}
    drawn = {}
    for name, span in (pair(text, "--draw", "NODE.PARAM=LOW..HIGH") for text in options.draw):
        low, dots, high = span.partition("..")
        try:
            drawn[name] = {"uniform": (float(low), float(high))}
        except ValueError:
            raise ScenarioError(f"--draw {name}={span}: expected two numbers as LOW..HIGH") from None
        if not dots:
            raise ScenarioError(f"--draw {name}={span}: expected two numbers as LOW..HIGH")
    if options.search:
        aim = "maximise" if options.maximise else "minimise"
        changes["search"] = {"figure": options.search, "aim": aim, "count": options.draws, "parameters": drawn,
                             "subject_to": dict(map(_constraint, options.subject_to))}  # fmt: skip
    elif options.subject_to:
        raise ScenarioError("--subject-to: goes with --search FIGURE")
    elif drawn:
        changes["draws"] = {"count": options.draws, "method": options.method, "parameters": drawn}
    return changes


def _values(name: str, text: str) -> list[Any]:
    """Read the values of a grid, ranges LOW:HIGH:STEP among them with both ends."""
    given = read_yaml(f"[{text}]", f"--grid {name}")
    assert isinstance(given, list)
    return [value for one in given for value in (_range(name, one) if isinstance(one, str) else [one])]


def _range(name: str, text: str) -> list[Any]:
    found = re.fullmatch(rf"({NUMBER}):({NUMBER})(?::({NUMBER}))?", text.strip())
    if found is None:
        return [text]
    low, high, step = (float(part) for part in (found[1], found[2], found[3] or "1"))
    count = math.floor((high - low) / step * (1.0 + 1e-12) + 1e-9) + 1 if step else 0
    if not 1 <= count <= MOST:
        raise ScenarioError(f"--grid {name}={text}: expected LOW:HIGH:STEP with at least one and at most {MOST} values")
    values = [float(f"{low + k * step:.12g}") for k in range(count)]
    return [int(v) for v in values] if all(re.fullmatch(r"[-+]?\d+", p) for p in found.groups() if p) else values


def _constraint(text: str) -> tuple[str, str]:
    """Read ``overshoot <= 5`` as a figure and what is expected of it."""
    found = re.fullmatch(rf"\s*(\w+)\s*(<=|>=)\s*({NUMBER})\s*", text)
    if found is None:
        raise ScenarioError(f"--subject-to {text!r}: expected FIGURE <= NUMBER or FIGURE >= NUMBER")
    return found[1], f"at {'most' if found[2] == '<=' else 'least'} {found[3]}"


def pair(text: str, option: str, form: str) -> tuple[str, str]:
    """Split what an option gives into a name and a value; a ScenarioError says the form expected."""
    name, equals, value = text.partition("=")
    if not equals or not value:
        raise ScenarioError(f"{option} {text!r}: expected {form}")
    return name, value
