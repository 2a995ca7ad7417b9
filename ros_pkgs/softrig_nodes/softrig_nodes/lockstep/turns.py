"""The lockstep ticks of the nodes of one process: one loop answers them while no input is missing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

from softrig_core.block.loop import Loop
from softrig_core.block.step import Step
from softrig_core.errors import RunError
from softrig_core.run.choice import ticks_of

from ..adapter.adapter import Adapter

SLICE = 5_000_000  # ns: how long ticks may keep a timer waiting


class Turns:
    """The loop of one process.

    Attributes
    ----------
    ticks : iterator
        Ticks of the loop; a restarted node repeats those that it had answered.
    report_native : callable or None
        Updates `Step.native` of each step; None: no ticks run natively.
    """

    ticks: Iterator[int | None]

    def __init__(self, nodes: Sequence[Adapter]) -> None:
        self._nodes = nodes
        self._lacking = len(nodes)  # nodes of which a peer is missing
        self.report_native: Callable[[], object] | None = None

    def order(self, members: Sequence[Step], alone: Callable[[], bool]) -> None:
        """Set the order of the nodes in a tick.

        Parameters
        ----------
        members : sequence of Step
            See `Loop`.
        alone : callable
            See `Engine`.
        """
        self.ticks = Loop(members).run()
        # Native code publishes nothing, which is only right for a middleware that drops messages without subscribers.
        if len(members) > 1 and all(n.middleware.mute for n in self._nodes):
            self.ticks, self.report_native = ticks_of(members, alone=alone)

    def begin(self) -> None:
        """Count a node whose peers are present; with the last one the ticks begin."""
        self._lacking -= 1
        if not self._lacking:
            for node in self._nodes:
                node.state = "running"
            self.turn()

    def turn(self) -> None:
        """Run ticks while no input is missing."""
        for node in self._nodes:
            # A node that is done does not stop the loop, because its neighbours may have a later last tick.
            if node.state in ("starting", "failed"):
                return
        until = 0
        try:
            for t in self.ticks:
                if t is None:
                    return
                if not until:
                    until = time.monotonic_ns() + SLICE
                # Nodes started by hand may wait for no message and have no last tick, so timers would never fire.
                elif time.monotonic_ns() > until:
                    self._nodes[0].middleware.post(self.turn)
                    return
        except RunError as error:
            next(n for n in self._nodes if n.step.name == error.node).broke(error)
