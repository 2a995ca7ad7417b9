"""The command that repeats a run or a study, from any folder."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from softrig_core import ScenarioError
from softrig_core.kit.resource import prefixes
from softrig_core.scenario.scenario_file import locate, scenario_folders


@cache
def workspace(package: str) -> Path | None:
    """Return the workspace of a package: in which colcon has built it, or which --workspace named."""
    for prefix in prefixes():
        if (prefix / "share" / "ament_index" / "resource_index" / "packages" / package).exists():
            if (prefix / "workspace").is_file():
                return Path((prefix / "workspace").read_text().strip())
            install = prefix if prefix.name == "install" else prefix.parent  # merged, or a folder a package
            return install.parent if (install / "local_setup.sh").is_file() and not _is_suite(prefix) else None
    return None


def _is_suite(prefix: Path) -> bool:
    """Return whether a prefix is that of the suite itself, which scripts/softrig sources."""
    return (prefix / "share" / "ament_index" / "resource_index" / "packages" / "softrig_bringup").exists()


def words(packages: Iterable[str], *verb: str) -> list[str]:
    """Return the beginning of a command that works in any folder: the path of our command, and the workspace of the
    user's packages.

    Parameters
    ----------
    packages : iterable of str
        Those of the nodes.
    *verb : str
        What follows.
    """
    folders = [folder for folder in dict.fromkeys(map(workspace, packages)) if folder is not None]
    option = ["--workspace", str(folders[0].absolute())] if folders else []
    return [os.environ.get("SOFTRIG_COMMAND") or "softrig", *option, *verb]


def scenario_word(name: str) -> str:
    """Return a scenario as any folder finds it: by name, or by the whole path of a file that only this one does."""
    try:
        result, path = locate(name)
    except ScenarioError:
        return name
    if result != path.stem:  # a variant has no path of its own
        return name
    command = os.environ.get("SOFTRIG_COMMAND", "")
    home = Path(command).absolute().parent.parent / "config" / "scenarios" if command else None
    known = [f for f in scenario_folders() if f == home or f.parent.parent.name == "share"]
    return name if name == result and path.parent in known else str(path.absolute())


def for_reader(command: str) -> str:
    """Return a command that repeats a run on any machine, without paths of the machine that made the run.

    Parameters
    ----------
    command : str
        As stored in metrics.json.
    """
    try:
        parts = shlex.split(command)
    except ValueError:
        return command
    result = [os.path.basename(parts[0])] if parts else []
    left = iter(parts[1:])
    for word in left:
        if word in ("--workspace", "--out"):
            next(left, "")
            continue
        shipped = word.endswith(".yaml") and Path(word).parent.parts[-2:] == ("config", "scenarios")
        result.append(Path(word).stem if shipped else os.path.basename(word.rstrip("/")) if word[:1] == "/" else word)
    return shlex.join(result)
