"""The node adapter: `executable(BlockClass)` makes the main function of a node out of a block class."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

from .block import Block


class _Main:
    """Main function of a node's executable; carries the block class for the in-process runner."""

    def __init__(self, block: type[Block]) -> None:
        self.block = block

    def __call__(self, args: Sequence[str] | None = None) -> int:
        from .startup import run_node  # rclpy is imported only in a node process

        status = run_node(self.block, sys.argv if args is None else list(args))
        sys.stdout.flush()
        sys.stderr.flush()
        # Everything is written and acknowledged. A regular exit would run Fast DDS's static destructors, which
        # once in some thousand ends wait for ever (2.14).
        os._exit(status)


def executable(block: type[Block]) -> Any:
    """Make the entry point of a node.

    Examples
    --------
    In ``plant.py``: ``main = executable(DcMotorPlant)``; in setup.py:
    ``dc_motor_plant = softrig_drives.dc_motor.plant:main``.
    """
    return _Main(block)
