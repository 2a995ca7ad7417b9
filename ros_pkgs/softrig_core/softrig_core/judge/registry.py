"""Figure functions: those of `softrig_core.judge.measures` and the entry points of group ``softrig_figures``."""

from __future__ import annotations

import importlib.metadata
import sys
from functools import lru_cache
from typing import Any

from ..errors import ScenarioError, closest
from ..renamed import GROUP as FORMER, report
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
    new = (name for name, point in _points().items() if name not in _former(point))
    return sorted({*measures.__all__, *new})


@lru_cache(maxsize=1024)
def _former(point: importlib.metadata.EntryPoint) -> frozenset[str]:
    """Return the former names in the distribution of a figure function, without the name of the distribution.

    Reading that name parses the metadata by the module `email`, whose import takes as long as a short run.
    """
    return frozenset(point.dist.entry_points.select(group=FORMER).names if point.dist is not None else ())


def find(name: str) -> Function:
    """Return a figure function by its registered name; no other function is ever called.

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
    if name in _former(point):
        report(point.dist.name, name)  # type: ignore[union-attr]
    try:
        function: Any = point.load()
    except (ImportError, AttributeError) as error:
        raise ScenarioError(f"figure function {name} ({point.value}) cannot be loaded: {error}") from None
    return function
