"""What a system's own packages may have too old: asked for in words before anything fails on it."""

from __future__ import annotations

import importlib.util
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
