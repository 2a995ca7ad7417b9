"""What has to be there before anything else: a pydantic that is new enough, the prefix of a wheel."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path


def check() -> None:
    """See to it that pydantic is there in its second version; Debian 12 and Ubuntu 24.04 bring the first.

    Raises
    ------
    ImportError
        It is not; says what to do.
    """
    spec = importlib.util.find_spec("pydantic")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else None
    if folder is None or not (folder / "_internal").is_dir():  # the first has none; importing it takes 0.1 s
        found = f"finds an older one in {folder}" if folder else "finds none"
        raise ImportError(
            f"softrig needs pydantic 2 and {found}: pip install 'pydantic>=2' in a virtual environment "
            "(softrig_bringup/doc/set_up.md)"
        )


def join_prefix() -> None:
    """Put the prefix of a wheel behind `AMENT_PREFIX_PATH`, where a workspace would have been sourced."""
    there = os.environ.get("AMENT_PREFIX_PATH", "")
    if sys.prefix not in there.split(os.pathsep) and os.path.isfile(
        f"{sys.prefix}/share/ament_index/resource_index/packages/softrig_core"
    ):
        os.environ["AMENT_PREFIX_PATH"] = os.pathsep.join(p for p in (there, sys.prefix) if p)
