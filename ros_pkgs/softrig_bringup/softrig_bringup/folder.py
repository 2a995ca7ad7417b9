"""The folder of a run's results: what a former run of ours wrote there is replaced, nothing else is touched."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

from softrig_core import ScenarioError

MANIFEST = "softrig_files.json"
UNDER_WAY = "*"  # in place of a list: a run has begun here and not ended; all that a run may write is its own
OURS = re.compile(
    r"bag|log|metrics\.json|report\.html|(overview|plot_\d\d_[a-z0-9_]*)\.(png|svg|pdf)|softrig_files\.json"
)


class ResultsFolder:
    """A folder that a run may write into.

    Parameters
    ----------
    path : Path
        New, empty, or with the results of a former run; other files may lie beside those.

    Attributes
    ----------
    replaced : str
        What a former run left there, in words; empty for nothing.

    Raises
    ------
    ScenarioError
        Something there stands in the way that no run of softrig has listed as its own.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.exists() and not path.is_dir():
            raise ScenarioError(f"{path} is a file, expected a folder for the results")
        self._old = _listed(path)
        if UNDER_WAY in self._old:
            self._old |= {f for f in _files(path) if OURS.fullmatch(Path(f).parts[0])}
            self._old.discard(UNDER_WAY)
        self._foreign = {f for f in _files(path) if f not in self._old}
        for file in sorted(self._foreign):
            if OURS.fullmatch(Path(file).parts[0]):
                raise ScenarioError(f"{path / file} was not written by a run of softrig (or by one before 0.2); move "
                                    "it away or choose another --out")  # fmt: skip
        self.replaced = _what(path) if self._old & set(_files(path)) else ""

    def clear(self) -> None:
        """Remove what the former run listed, and the folders that this leaves empty; never what a link points to."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for file in self._old:
                place = self.path / file
                if _inside(self.path, place):
                    place.unlink(missing_ok=True)
            # what a run leaves that is killed, or refused by one of its nodes, must not stop the next one
            (self.path / MANIFEST).write_text(json.dumps([MANIFEST, UNDER_WAY]) + "\n")
        except OSError as error:
            raise ScenarioError(f"{error.filename}: {error.strerror}; choose another --out") from None
        if not os.access(self.path, os.W_OK | os.X_OK):
            raise ScenarioError(f"{self.path}: cannot be written into; choose another --out")
        for folder in sorted({p for f in self._old for p in Path(f).parents}, key=lambda p: -len(p.parts)):
            place = self.path / folder
            if folder.parts and place.is_dir() and not place.is_symlink() and not any(place.iterdir()):
                place.rmdir()

    def close(self) -> None:
        """List everything that this run has written, so that a later one may replace it."""
        files = sorted(f for f in _files(self.path) if f not in self._foreign)
        (self.path / MANIFEST).write_text(json.dumps(sorted({*files, MANIFEST}), indent=1) + "\n")


def _files(path: Path) -> Iterator[str]:
    """Give every file below a folder by its relative path; links are files, and not followed."""
    for folder, folders, files in os.walk(path):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in [*files, *links]:
            yield str((Path(folder) / name).relative_to(path))


def _listed(path: Path) -> set[str]:
    try:
        content = json.loads((path / MANIFEST).read_text())
    except (OSError, ValueError):
        return set()
    names = content if isinstance(content, list) else []
    return {n for n in names if isinstance(n, str) and not Path(n).is_absolute() and ".." not in Path(n).parts}


def _inside(path: Path, place: Path) -> bool:
    """Whether the folder of a file is really below `path`, no link in between."""
    return place.parent.resolve().is_relative_to(path.resolve())


def _what(path: Path) -> str:
    try:
        content = json.loads((path / "metrics.json").read_text())
        return f"{content['scenario']} ({content['mode']}, seed {content['seed']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "an earlier run"
