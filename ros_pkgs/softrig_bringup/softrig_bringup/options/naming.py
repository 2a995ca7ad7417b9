"""Names of folders of results: short, readable, and different for different runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

LONGEST = 80  # letters of a name before its digest


def folder_of(parts: Sequence[str], apart: Sequence[str] = ()) -> str:
    """Name a folder after the arguments of a run or study.

    Characters that do not belong in a file name are replaced. A name longer than `LONGEST` loses whole parts, because a
    truncated number would be another number. If the name does not contain everything, a digest of everything is
    appended.

    Parameters
    ----------
    parts : sequence of str
        Parts of the name; the first one is always kept.
    apart : sequence of str
        Further inputs that the folder depends on: paths of other runs or files.
    """
    text = parts[0]
    for part in parts[1:]:
        if len(text) + 1 + len(part) > LONGEST:
            break
        text += f"-{part}"
    name = re.sub(r"[^A-Za-z0-9_.,:=+-]+", "_", text[:LONGEST])
    if name == "-".join(parts) and not apart:
        return name
    import hashlib

    digest = hashlib.sha256("\0".join([*parts, "", *apart]).encode()).hexdigest()
    return f"{name}-{digest[:8]}"


def elsewhere(path: Path | None) -> list[str]:
    """Return the whole path of a file outside the current folder, because its name alone may be ambiguous."""
    if path is None or path.absolute().parent == Path.cwd():
        return []
    return [from_here(path)]


def from_here(path: Path) -> str:
    """Return a path as it is from this folder; the whole path where it is not below."""
    absolute = path.absolute()
    return str(absolute.relative_to(Path.cwd()) if absolute.is_relative_to(Path.cwd()) else absolute)


def scenario_file(called: str) -> Path | None:
    """Return the file by which a scenario was called, None where it was called by name or has one that is listed."""
    path = Path(called)
    if path.suffix not in (".yaml", ".yml"):
        return None
    from softrig_core.scenario.scenario_file import find

    listed = find(path.stem)
    return None if listed is not None and path.exists() and listed.samefile(path) else path
