"""Figure functions: those of `softrig_core.rig.measures` and the entry points of group ``softrig_figures``."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, TypeVar

from ..errors import ScenarioError, closest

GROUP = "softrig_figures"
Function = Callable[..., float]
_F = TypeVar("_F", bound=Function)


def figure(unit: str, reads: Sequence[str] = ()) -> Callable[[_F], _F]:
    """Say what a figure function gives, so that a scenario is judged before its run.

    Parameters
    ----------
    unit : str
        Unit of the figure; ``{signal}`` stands for that of its argument `signal`.
    reads : sequence of str
        Signals that it reads besides those that its arguments name.
    """

    def declare(function: _F) -> _F:
        function.unit, function.reads = unit, tuple(reads)  # type: ignore[attr-defined]
        return function

    return declare


@cache
def _points() -> dict[str, importlib.metadata.EntryPoint]:
    return {p.name: p for p in importlib.metadata.entry_points(group=GROUP)}


def registered() -> list[str]:
    """Names of all figure functions that are installed."""
    from . import measures

    return sorted({*measures.__all__, *_points()})


def find(name: str) -> Function:
    """Give a figure function by its registered name; nothing else is ever called.

    Raises
    ------
    ScenarioError
        Not registered, or its module cannot be imported.
    """
    from . import measures

    if name in measures.__all__:
        return getattr(measures, name)
    point = _points().get(name)
    if point is None:
        raise ScenarioError(f"no figure function {name!r} is registered{closest(name, registered())}; "
                            f"a package registers its own in the group {GROUP}")  # fmt: skip
    try:
        function: Any = point.load()
    except (ImportError, AttributeError) as error:
        raise ScenarioError(f"figure function {name} ({point.value}) cannot be loaded: {error}") from None
    return function
