"""Conditions of every start: a pydantic that is new enough, the prefix of a wheel."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Mapping, MutableMapping
from pathlib import Path


def check() -> None:
    """Check that version 2 of pydantic is installed; Debian 12 and Ubuntu 24.04 have version 1.

    Raises
    ------
    ImportError
        It is not installed; the message explains what to do.
    """
    spec = importlib.util.find_spec("pydantic")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else None
    if folder is None or not (folder / "_internal").is_dir():  # the first has none; importing it takes 0.1 s
        text = f"finds an older one in {folder}" if folder else "finds none"
        raise ImportError(
            f"softrig needs pydantic 2 and {text}: pip install 'pydantic>=2' in a virtual environment "
            "(softrig_bringup/doc/set_up.md)"
        )


def is_executable() -> bool:
    """Return whether this program is an executable of an installed package, ``PREFIX/lib/PACKAGE/NAME``."""
    library, _, name = (sys.argv[0] if sys.argv else "").rpartition("/")
    prefix, _, package = library.rpartition("/lib/")
    return bool(name) and "/" not in package and _has(prefix, package)


def prefixes(environ: Mapping[str, str] = os.environ) -> list[str]:
    """Return the install prefixes, overlays first: ``AMENT_PREFIX_PATH``, and that of a wheel where it is not in it."""
    results = [prefix for prefix in environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    return results if sys.prefix in results or not _has(sys.prefix, "softrig_core") else [*results, sys.prefix]


def join_prefix(environ: MutableMapping[str, str] = os.environ) -> None:
    """Append the prefix of a wheel to `AMENT_PREFIX_PATH`, as sourcing a workspace would."""
    if (text := os.pathsep.join(prefixes(environ))) != environ.get("AMENT_PREFIX_PATH", ""):
        environ["AMENT_PREFIX_PATH"] = text


def _has(prefix: str, package: str) -> bool:
    return os.path.isfile(f"{prefix}/share/ament_index/resource_index/packages/{package}")
