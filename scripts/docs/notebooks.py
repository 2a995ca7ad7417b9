"""Notebooks of the site are run when it is built: each in a kernel of its own, which opens no port."""

from __future__ import annotations

import asyncio
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nbformat
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError
from softrig_core import ScenarioError

PATIENCE = 600  # s for a cell, or for the start of a kernel, on a busy machine


class _Local(AsyncKernelManager):
    """Speaks to its kernel over sockets of the file system, in a folder that is the user's own."""

    def __init__(self, **given: Any) -> None:
        self.folder = TemporaryDirectory(prefix="softrig-")
        super().__init__(transport="ipc", ip=f"{self.folder.name}/kernel", **given)


def execute(site: Path) -> None:
    """Run all notebooks below a folder in parallel, and store their outputs in their files.

    Raises
    ------
    ScenarioError
        A cell failed, or took too long.
    """
    asyncio.run(_all([path for path in sorted(site.glob("*/*.ipynb")) if path.parent.name != "pictures"]))


async def _all(paths: list[Path]) -> None:
    await asyncio.gather(*map(_one, paths))


async def _one(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]
    client = NotebookClient(
        notebook,
        kernel_manager_class=_Local,
        timeout=PATIENCE,
        startup_timeout=PATIENCE,
        resources={"metadata": {"path": str(path.parent)}},
    )
    try:
        await client.async_execute()
    except (CellExecutionError, CellTimeoutError) as error:
        raise ScenarioError(f"{path.name}: {error}") from None
    nbformat.write(notebook, path)  # type: ignore[no-untyped-call]
