"""The content of the wheel beside the Python packages: share/, lib/PACKAGE/EXECUTABLE and each package's entry points.

`pip wheel --no-deps .` builds it. Below the prefix that it is installed into it is what colcon would make of the
packages, from the same lists as the checkout's own workspace.
"""

import importlib.util
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# Starts the Python of the prefix, wherever the prefix is.
START = """#!/bin/sh
'''exec' "$(dirname "$0")/../../bin/python" "$0" "$@"
' '''
"""


class Files(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the files to those of hatchling."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Report which file is stored where; missing ones are written first."""
        root = Path(self.root)
        spec = importlib.util.spec_from_file_location("layout", root / "scripts" / "layout.py")
        assert spec is not None
        assert spec.loader is not None
        layout = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(layout)
        self._made = tempfile.TemporaryDirectory()  # lasts until the wheel is built
        for name, folder, config in layout.packages(root):
            build_data["force_include"][str(folder / name)] = name
            for place, file in layout.share(folder, config).items():
                build_data["shared_data"][str(file)] = place
            for place, text in layout.executables(name, config):
                build_data["shared_data"][self._made_file(place, START + text, 0o755)] = place
            for place, text in layout.metadata(name, config).items():
                build_data["force_include"][self._made_file(place, text, 0o644)] = place

    def _made_file(self, place: str, text: str, mode: int) -> str:
        path = Path(self._made.name, place)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        path.chmod(mode)
        return str(path)
