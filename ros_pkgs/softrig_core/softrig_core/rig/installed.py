"""Installed executables of Python packages, and the block classes behind them."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from functools import lru_cache
from typing import Any

from ..block.block import Block
from ..errors import FAILURES, ScenarioError, closest, describe
from ..renamed import executable_of, executables

_NO_MEMORY = re.compile("annot allocate memory|failed to map segment")  # messages of the C library and its loader


def load_main(package: str, executable: str) -> Any:
    """Import the main function of an installed Python executable; None if the package has none of this name.

    Raises
    ------
    ScenarioError
        Its module cannot be imported; the error contains the reason and the place.
    """
    try:
        point = executable_of(package, executable)
    except importlib.metadata.PackageNotFoundError:
        return None
    if point is None:
        return None
    try:
        return point.load()
    except MemoryError:
        raise
    except FAILURES as error:
        if isinstance(error, OSError | ImportError) and _NO_MEMORY.search(str(error)):
            raise MemoryError(str(error)) from error
        raise ScenarioError(f"{package}/{executable} cannot be loaded: {describe(error)}") from error


def block_of(main: Any) -> type[Block] | None:
    """Return the block class behind an executable's main function; None for a tool.

    The function is `Block.main` of that class, or what `executable` made of it in earlier versions.
    """
    owner = getattr(main, "__self__", None)
    return owner if isinstance(owner, type) and issubclass(owner, Block) else getattr(main, "block", None)


def load_block(package: str, executable: str) -> type[Block]:
    """Find the block class behind an installed executable; a class that was found is cached.

    Raises
    ------
    ScenarioError
        The package or executable is not installed, cannot be imported, or is not a softrig node.
    """
    return _block_class(package, executable, tuple(sys.path))


@lru_cache(maxsize=1024)
def _block_class(package: str, executable: str, _: tuple[str, ...]) -> type[Block]:
    try:
        point = executable_of(package, executable)
    except importlib.metadata.PackageNotFoundError:
        near = closest(package, (d.name for d in importlib.metadata.distributions()))
        raise ScenarioError(f"package {package!r} is not installed in this environment{near}") from None
    if point is None:
        names = executables(package)
        raise ScenarioError(
            f"package {package} has no executable {executable!r}{closest(executable, names)}; it has {', '.join(names)}"
        )
    block = block_of(load_main(package, executable))
    if block is None:
        raise ScenarioError(f"{package}/{executable} is a tool, not the node of a block")
    return block
