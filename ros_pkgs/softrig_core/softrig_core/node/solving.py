"""Lockstep of a solver node: its executor goes on turning while the work is under way, and the peers are told."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.clock import Clock
from rclpy.node import Node

from ..model.solver import Solver
from .messages import message_class

BUSY = "/softrig/busy"  # std_msgs/Header, frame_id = the node: who waits for progress is to be patient
TOLD_EVERY = 0.5  # s
LOOK = 0.002  # s


class Solving:
    """One solver block between the begin of a tick and its answer.

    Parameters
    ----------
    node : rclpy.node.Node
    block : Solver
    clock : rclpy.clock.Clock
        Steady clock.
    resume : callable
        Called when the answer that was waited for is there.
    """

    def __init__(self, node: Node, block: Solver, clock: Clock, resume: Callable[[], object]) -> None:
        self.block = block
        self._header = message_class("std_msgs/msg/Header")(frame_id=node.get_fully_qualified_name())
        self._publisher = node.create_publisher(message_class("std_msgs/msg/Header"), BUSY, 10)
        self._resume = resume
        self._tick: int | None = None  # whose begin the block has seen and whose end not yet
        self._told = 0.0
        self._timer = node.create_timer(LOOK, self._look, clock=clock, autostart=False)

    def finished(self, t: int, inputs: Mapping[str, Any] | None) -> bool:
        """Begin a tick if that is not done; tell whether its answer can be given.

        Parameters
        ----------
        t : int
            ns.
        inputs : mapping or None
            None when one of them was refused.
        """
        if self._tick != t:
            self._tick = t
            if inputs is None:
                self.block.go_on(t)
            else:
                self.block.begin(t, **inputs)
        if self.block.ready(t):
            self._timer.cancel()
            return True
        if self._timer.is_canceled():
            self._told = time.monotonic()
            self._timer.reset()
        return False

    def _look(self) -> None:
        assert self._tick is not None
        if self.block.ready(self._tick):
            self._timer.cancel()
            self._resume()
        elif time.monotonic() - self._told > TOLD_EVERY:
            self._told = time.monotonic()
            self._publisher.publish(self._header)


def hear_busy(node: Node, heard: Callable[[], object]) -> None:
    """Call a function whenever a solver of the rig says that it is at work."""
    node.create_subscription(message_class("std_msgs/msg/Header"), BUSY, lambda data: heard(), 10, raw=True)
