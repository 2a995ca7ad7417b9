"""Which code a rig is made of: a fingerprint of each package, so that runs of different code can be distinguished."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Iterable
from functools import cache
from os.path import isfile
from pathlib import Path

from ..block.block import Block
from ..kit.resource import prefixes

OURS = "softrig_"  # the names of softrig's own packages begin so
LETTERS = 12  # length of a fingerprint
_IMPORT = re.compile(r"^\s*(?:from|import)\s+([A-Za-z_]\w*)", re.MULTILINE)
_BUILT = {"__pycache__", ".pyc", ".so", ".nbi", ".nbc"}  # made from the sources


def fingerprints(classes: Iterable[type[Block]], modules: Iterable[str] = ()) -> dict[str, str]:
    """Return the fingerprint of each package whose code affects some blocks.

    Parameters
    ----------
    classes : iterable of type
        The block classes of a rig; their bases count, and what their packages import of others that colcon built.
    modules : iterable of str
        Further modules, such as those of figure functions.

    Returns
    -------
    dict of str to str
        By package, or by class where its module belongs to none, as in a notebook: the first `LETTERS` of a SHA-256
        of its files.
    """
    results: dict[str, str] = {}
    seen: set[str] = set()
    todo = [name for m in (__name__, *modules) if _folder(name := m.partition(".")[0]) is not None]
    for block_class in dict.fromkeys(base for cls in classes for base in cls.__mro__ if issubclass(base, Block)):
        package = block_class.__module__.partition(".")[0]
        if _folder(package) is not None:
            todo.append(package)
        else:
            results[f"{block_class.__module__}.{block_class.__qualname__}"] = _source(block_class)
    while todo:
        package = todo.pop()
        if package not in seen:
            seen.add(package)
            results[package], imported = _package(package)
            todo += imported
    return dict(sorted(results.items()))


@cache
def _folder(package: str) -> Path | None:
    """Return the folder of a package's or module's files; None for code that was typed, not imported."""
    if package == "__main__" or package in sys.stdlib_module_names:
        return None
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    folders = list(spec.submodule_search_locations or ())
    return Path(folders[0]) if folders else Path(spec.origin) if spec.origin and isfile(spec.origin) else None


@cache
def _package(package: str) -> tuple[str, tuple[str, ...]]:
    """Fingerprint of a package's files, and the packages of its kind that it imports."""
    folder = _folder(package)
    assert folder is not None
    files = [f for f in sorted(folder.rglob("*")) if f.is_file()] if folder.is_dir() else [folder]
    digest, imported = hashlib.sha256(), set()
    for file in files:
        if _BUILT & {*file.parts, file.suffix}:
            continue
        content = file.read_bytes()
        digest.update(f"{file.relative_to(folder.parent)}\0{len(content)}\0".encode() + content)
        if file.suffix == ".py":
            imported |= set(_IMPORT.findall(content.decode(errors="replace")))
    own_imports = sorted(name for name in imported - {package} if _is_own(name) and _folder(name) is not None)
    return digest.hexdigest()[:LETTERS], tuple(own_imports)


def is_ours(module: str) -> bool:
    """Return whether a package or module belongs to softrig, whose tests show that blocks store nothing outside x."""
    return module.startswith(OURS)


@cache
def _is_own(package: str) -> bool:
    """Return whether a package is ours or was built by colcon; a library is identified by its version instead."""
    marks = (prefix / "share" / "colcon-core" / "packages" / package for prefix in prefixes())
    return is_ours(package) or any(map(isfile, marks))


def _source(block_class: type[Block]) -> str:
    try:
        text = inspect.getsource(block_class)
    except (OSError, TypeError):  # typed at a prompt
        return "unknown"
    return hashlib.sha256(text.encode()).hexdigest()[:LETTERS]
