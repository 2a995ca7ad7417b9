"""Nodes: `executable(BlockClass)` makes the main function of one out of a block class."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from ..block.block import Block
from ..interrupt import interrupt


class _Main:
    """Main function of a node's executable; carries the block class for the in-process runner."""

    def __init__(self, block: type[Block]) -> None:
        self.block = block

    def __call__(self, args: Sequence[str] | None = None) -> NoReturn:
        interrupt.install()
        from .main import run_node  # rclpy is imported only in a node process

        run_node(self.block, sys.argv if args is None else list(args))


def executable(block: type[Block]) -> Any:
    """Make the entry point of a node.

    Examples
    --------
    In ``plant.py``: ``main = executable(DcMotorPlant)``; in setup.py:
    ``dc_motor_plant = softrig_drives.dc_motor.plant:main``.
    """
    return _Main(block)
