"""Executables and figure functions that have been renamed: entry points of group ``softrig_former``, ``OLD = NEW``.

An old name keeps working for two versions and is reported once in a process. It stays among the `console_scripts` of
its package for `ros2 run`, and in no list of nodes.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint, EntryPoints

GROUP = "softrig_former"
END = "0.4"  # the first version without the names that went in 0.2
_REPORTED: set[tuple[str, str]] = set()


@lru_cache(maxsize=256)
def _points(package: str, _: tuple[str, ...]) -> EntryPoints:
    import importlib.metadata  # a part of each start that few need

    return importlib.metadata.distribution(package).entry_points


def _scripts(package: str) -> EntryPoints:
    return _points(package, tuple(sys.path)).select(group="console_scripts")  # a pack may bring more


def former(package: str) -> Mapping[str, str]:
    """Return the old names of a package's executables and figures, each with its new one; empty for no package."""
    try:
        return _former(package, tuple(sys.path))
    except (ModuleNotFoundError, ValueError):  # not installed; a ValueError for an empty name
        return {}


@lru_cache(maxsize=256)
def _former(package: str, path: tuple[str, ...]) -> Mapping[str, str]:
    # A scenario asks for each of its nodes, and looking through all entry points takes a tenth of the time to its rig.
    return {point.name: point.value for point in _points(package, path).select(group=GROUP)}


def executables(package: str) -> list[str]:
    """List the executables that a package has installed, without their old names.

    Raises
    ------
    importlib.metadata.PackageNotFoundError
        It is not installed.
    """
    return sorted(_scripts(package).names - former(package).keys())


def executable_of(package: str, name: str) -> EntryPoint | None:
    """Return the entry point of an executable, also under a former name; None if the package has none of this name.

    Raises
    ------
    importlib.metadata.PackageNotFoundError
        The package is not installed.
    """
    points = _scripts(package)
    if name in points.names:
        return points[name]
    # The next attempt finds it if the package is installed again in the meantime.
    _points.cache_clear()
    _former.cache_clear()
    return None


def current(package: str, name: str) -> str:
    """Return the new name of an executable or a figure function; its own where it has not been renamed."""
    return former(package).get(name, name)


def report(package: str, name: str) -> str:
    """Return the new name, as `current`, and warn once in a process about an old one."""
    new = current(package, name)
    if new != name and (package, name) not in _REPORTED:
        _REPORTED.add((package, name))
        warnings.warn(notice(package, name), FutureWarning, stacklevel=3)
    return new


def notice(package: str, name: str) -> str:
    """Describe the replacement of an old name and how long the old one works."""
    return f"{package}/{name} is called {package}/{current(package, name)} now; the old name works until softrig {END}"
