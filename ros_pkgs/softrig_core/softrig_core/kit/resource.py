"""Files that packages install: tables, robots."""

from __future__ import annotations

import importlib.util
from os.path import isfile
from pathlib import Path

from .. import needs


def prefixes() -> list[Path]:
    """Return the install prefixes, overlays first; see `softrig_core.needs.prefixes`."""
    return [Path(prefix) for prefix in needs.prefixes()]


def resource(source: str, kind: str = "file") -> Path:
    """Find a file.

    Parameters
    ----------
    source : str
        A file name, or ``package://NAME/path`` below the share folder or the Python package of an installed package.
    kind : str
        Kind of the file, for errors.

    Raises
    ------
    ValueError
        There is no such file or package; the error contains the searched places.
    """
    if source.startswith("package://"):
        package, _, remaining = source.removeprefix("package://").partition("/")
        candidates = [prefix / "share" / package / remaining for prefix in prefixes()]
        spec = importlib.util.find_spec(package) if package.isidentifier() else None
        candidates += [Path(folder, remaining) for folder in (spec and spec.submodule_search_locations) or ()]
    else:
        candidates = [Path(source)]
    for candidate in candidates:
        if isfile(candidate):
            return candidate
    raise ValueError(f"no {kind} {source!r}; looked for {', '.join(map(str, candidates))}")
