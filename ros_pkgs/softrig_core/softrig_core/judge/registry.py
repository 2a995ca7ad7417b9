"""Figure functions: those of `softrig_core.judge.measures` and the entry points of group ``softrig_figures``."""

from __future__ import annotations

import importlib.metadata
import sys
from functools import lru_cache
from typing import Any

from ..errors import ScenarioError, closest
from ..renamed import former, report
from . import measures
from .measures import Function

GROUP = "softrig_figures"


def _points() -> dict[str, importlib.metadata.EntryPoint]:
    # The path is part of the key, because a pack extends it and may bring more functions.
    return _installed(tuple(sys.path))


@lru_cache(maxsize=8)
def _installed(_: tuple[str, ...]) -> dict[str, importlib.metadata.EntryPoint]:
    return {p.name: p for p in importlib.metadata.entry_points(group=GROUP)}


def registered() -> list[str]:
    """Names of all figure functions that are installed."""
    new = (name for name, point in _points().items() if name not in former(_package(point)))
    return sorted({*measures.__all__, *new})


@lru_cache(maxsize=1024)
def _package(point: importlib.metadata.EntryPoint) -> str:
    # A distribution parses its metadata each time it is asked for its name.
    return point.dist.name if point.dist is not None else ""


def find(name: str) -> Function:
    """Return a figure function by its registered name; nothing else is ever called.

    Raises
    ------
    ScenarioError
        Not registered, or its module cannot be imported.
    """
    if name in measures.__all__:
        return getattr(measures, name)
    point = _points().get(name)
    if point is None:
        raise ScenarioError(
            f"no figure function {name!r} is registered{closest(name, registered())}; "
            f"a package registers its own in the group {GROUP}"
        )
    report(_package(point), name)
    try:
        function: Any = point.load()
    except (ImportError, AttributeError) as error:
        raise ScenarioError(f"figure function {name} ({point.value}) cannot be loaded: {error}") from None
    return function
