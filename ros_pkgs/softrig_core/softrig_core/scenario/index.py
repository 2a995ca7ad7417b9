"""An index of all scenarios, kept in the cache with the times of the files that it was read from."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from ..errors import ScenarioError
from .scenario_file import list_scenarios, scenario_folders

State = dict[str, list[int]]  # time of change (ns) and size by path


class Listed(NamedTuple):
    """Entry of a scenario in a list of scenarios."""

    name: str
    system: str
    duration: float
    title: str
    source: str


def listed(broken: list[ScenarioError]) -> list[Listed]:
    """Return all scenarios by name; they are loaded only if one of their files has changed.

    Parameters
    ----------
    broken : list
        Receives what is wrong with files and scenarios that cannot be loaded; nothing is kept then.
    """
    path = None
    with suppress(OSError):  # a cache that cannot be used is no reason to list nothing
        path = _index_path()
        if (result := _read_index(path)) is not None:
            return result
    before = _states(_candidates())
    rows = _loaded(broken)
    state = _states(_candidates())
    if path is not None and not broken and before == state:
        with suppress(OSError):
            _write_index(path, state, rows)
    return rows


def _loaded(broken: list[ScenarioError]) -> list[Listed]:
    from .scenario import load_scenario

    rows = []
    for name in sorted(list_scenarios(broken)):
        try:
            s = load_scenario(name)
        except ScenarioError as error:
            broken.append(error)
        else:
            rows.append(Listed(s.name, s.system, s.duration, s.title, s.source))
    return rows


def _candidates() -> list[Path]:
    """Return the files of scenarios, those that they extend, and the modules that check them."""
    package = Path(__file__).parent
    files = (file for folder in scenario_folders() for file in folder.glob("*.yaml"))
    return [*files, *package.glob("*.py"), *package.with_name("judge").glob("*.py")]


def _states(paths: Iterable[Path]) -> State:
    result = {}
    for path in paths:
        with suppress(OSError):
            state = path.stat()
            result[str(path)] = [state.st_mtime_ns, state.st_size]
    return result


def _index_path() -> Path:
    from ..kit.compiled import cache_folder

    return cache_folder() / "scenarios.json"


def _folders() -> list[str]:
    return [str(folder.absolute()) for folder in scenario_folders()]


def _read_index(path: Path) -> list[Listed] | None:
    """Return the content of the index, None if it does not belong to the present folders and files."""
    with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):  # the file is missing or damaged
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["folders"] == _folders() and content["state"] == _states(_candidates()):
            return [Listed(*row) for row in content["rows"]]
    return None


def _write_index(path: Path, state: State, rows: list[Listed]) -> None:
    from ..kit.compiled import store

    store(path, json.dumps({"folders": _folders(), "state": state, "rows": rows}).encode())
