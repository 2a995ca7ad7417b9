"""Names used until 0.2: they work until 0.4, and a warning names their replacement."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

from .block.block import Block
from .block.held import RunningBlock
from .runners import find_runner


class _Main:
    """Main function of an executable; carries its block class."""

    def __init__(self, block: type[Block]) -> None:
        self.block = block

    def __call__(self, args: Sequence[str] | None = None) -> NoReturn:
        self.block.main(args)


def executable(block: type[Block]) -> Any:
    """Return the main function of a block's node; deprecated, an entry point names ``module:Class.main``."""
    module, name = block.__module__, block.__qualname__
    _warn(f"executable({name})", f"the entry point `NAME = {module}:{name}.main`")
    return _Main(block)


def run_processes(*arguments: Any, **keywords: Any) -> Any:
    """Run a rig as processes; deprecated, `softrig_nodes` has it."""
    _warn("softrig_core.run_processes", "softrig_nodes.run_processes")
    return find_runner("processes")(*arguments, **keywords)


def container() -> NoReturn:
    """Run several nodes in one process; deprecated, ``softrig_nodes container``."""
    _warn("ros2 run softrig_core container", "ros2 run softrig_nodes container")
    find_runner("container")()
    raise AssertionError("a container ends its process")


def __getattr__(name: str) -> Any:
    """Return a class by its former name; deprecated."""
    if name != "Held":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    _warn("softrig_core.Held", "softrig_core.RunningBlock")
    return RunningBlock


def _warn(old: str, new: str) -> None:
    # visible by default, unlike DeprecationWarning, which Python hides outside of the main module
    warnings.warn(f"{old} will go in softrig 0.4; use {new}", FutureWarning, stacklevel=3)
