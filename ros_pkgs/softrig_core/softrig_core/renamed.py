"""Executables and figure functions that have been renamed: entry points of group ``softrig_former``, ``OLD = NEW``.

An old name keeps working for two versions and is reported once in a process. It stays among the `console_scripts` of
its package for `ros2 run`, and in no list of nodes.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping
from functools import lru_cache

GROUP = "softrig_former"
END = "0.4"  # the first version without the names that went in 0.2
_REPORTED: set[tuple[str, str]] = set()


def former(package: str) -> Mapping[str, str]:
    """Return the old names of a package's executables and figures, each with its new one; empty for no package."""
    return _former(package, tuple(sys.path))  # a pack may bring more


@lru_cache(maxsize=256)
def _former(package: str, _: tuple[str, ...]) -> Mapping[str, str]:
    import importlib.metadata  # a part of each start that few need

    try:
        points = importlib.metadata.distribution(package).entry_points.select(group=GROUP)
    except (importlib.metadata.PackageNotFoundError, ValueError):  # a ValueError for an empty name
        return {}
    return {point.name: point.value for point in points}


def executables(package: str) -> list[str]:
    """List the executables that a package has installed, without their old names.

    Raises
    ------
    importlib.metadata.PackageNotFoundError
        It is not installed.
    """
    import importlib.metadata

    points = importlib.metadata.distribution(package).entry_points.select(group="console_scripts")
    return sorted(points.names - former(package).keys())


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
    """Describe what an old name has become and how long it works."""
    return f"{package}/{name} is called {package}/{current(package, name)} now; the old name works until softrig {END}"
