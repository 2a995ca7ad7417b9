"""End a lockstep run that makes no progress, and report which nodes are missing.

This is the only use of wall-clock time in lockstep.
"""

from __future__ import annotations

import math

from softrig_core.block.block import Level
from softrig_core.timebase import SECOND

from ..adapter.handshake import Handshake
from ..seam.endpoint import COPY, Input
from .paired import PairedSenders

GONE_AFTER = 0.5  # s without the awaited message after its only publisher has vanished
GOODBYE = 2.0  # s: a publisher that vanishes sooner has left in order; a killed one stays for its lease (3 s)


STANDS, REPORT_AFTER = "stands", 1.5  # key of a report, and s without a tick after which it is made


class Stalls:
    """Checks periodically whether the run makes progress.

    Attributes
    ----------
    handshake : Handshake
        Handshake of the start.
    rivals : Input or None
        An input with more than one publisher.
    """

    handshake: Handshake

    def __init__(self, senders: PairedSenders) -> None:
        self._senders = senders
        self._node = senders.node
        self._middleware = senders.node.middleware
        self._progress = (-1, 0)
        self.rivals: Input | None = None
        self._reported = False  # whether the present stall has been reported
        self.restart()

    def restart(self) -> None:
        """Count the time from now."""
        self._since = self._middleware.steady()

    def check(self) -> None:
        """End the run if a peer has gone, stalls or never came."""
        node, senders = self._node, self._senders
        waited = self._middleware.steady() - self._since
        if self.rivals is not None:
            self._name(self.rivals, waited)
        elif node.state == "starting" or (node.state == "running" and not self._begun()):
            limit = node.options.start_timeout
            if limit and waited > limit:
                absent = self.handshake.absent()
                lacking = [row for row in senders.rows if not row.have]
                node.waits_for = self.handshake.missing if absent else [row.publisher for row in lacking]
                silent = [f"nothing on {row.port.topic} yet" for row in lacking]
                node.fail(f"not all peers after {limit:g} s: {'; '.join(absent or silent)}")
        elif node.state == "running":
            if self._progress != (node.t, senders.signs_of_life):
                self._progress = (node.t, senders.signs_of_life)
                self.restart()
                if self._reported:
                    node.step.note(None, STANDS, "")
                    self._reported = False
            else:
                self._judge(waited)

    def _begun(self) -> bool:
        """Return whether any node of the rig has published; before that, a node may still wait for an external one."""
        node = self._node
        if node.links.owns_clock or self._senders.signs_of_life:
            return True
        # A row of an earlier tick is complete before anything has arrived. Neither does an own tick prove that the rig
        # has begun: a source for an outside plant publishes t = 0 unasked.
        peers = [row for row in self._senders.rows if not row.earlier]
        # Without rows, everything that this node waits for is in its own process, which has begun.
        if not self._senders.rows:
            return True
        return any(row.have for row in peers) or (node.ticks > 0 and bool(peers))

    def _name(self, item: Input, waited: float) -> None:
        """End the run with the names of all nodes that publish a topic, if the graph knows them."""
        node, topic = self._node, item.port.topic
        rivals = self._middleware.publishers(self._middleware.resolve(topic))
        names = sorted({p.full_name for p in rivals})
        # The graph knows an endpoint before the name of its node, and the error should name both nodes.
        if not any("UNKNOWN" in n for n in names) or waited > node.options.timeout:
            node.fail(f"{len(rivals)} publishers on {topic} ({', '.join(names)}), expected exactly one")

    def _judge(self, waited: float) -> None:
        node = self._node
        lacking = [row for row in self._senders.rows if not row.have]
        # In the first ticks other nodes may still be starting, which is no stall.
        if lacking and waited > REPORT_AFTER and node.ticks > 1 and not self._reported:
            self._reported = True
            missing = ", ".join(f"{row.port.topic} from {row.publisher}" for row in lacking)
            node.step.note(Level.WARN, STANDS, f"waits for {missing} at t = {node.t / SECOND:.9g} s", anew=True)
        unpublished = [row for row in lacking if not row.publishers and not node.links.returns]
        limit = node.options.timeout
        # The runner that restarts nodes decides itself whether the rig still makes progress.
        if node.links.returns:
            limit = math.inf
        # Some node may not have begun yet, and its start may take as long as `start_timeout` allows.
        elif node.ticks <= 1:
            limit = max(limit, node.options.start_timeout)
        if lacking and (waited > limit or (unpublished and waited > GONE_AFTER)):
            # A node started by hand without a duration has no last tick of its own: it ends when its publisher leaves.
            if unpublished and waited < min(limit, GOODBYE) and not (node.options.links or node.options.duration):
                names = ", ".join(row.port.topic for row in unpublished)
                text = f"{names}: the sender has left at t = {node.t / SECOND:.9g} s, and this node with it"
                node.middleware.log(Level.OK, text)
                node.finish()
                return
            lacking = unpublished or lacking
            missing = ", ".join(
                f"{row.port.topic} from {row.publisher}{' (gone)' if row in unpublished else ''}"
                f"{'; last refused: ' + row.last_refusal if row.last_refusal else ''}"
                f"{f'; it is ahead, at {max(row.pending) / SECOND:.9g} s' if row.pending else ''}"
                f"{f'; its last message was stamped 0: {COPY}' if row.last_stamp_zero else ''}"
                for row in lacking
            )
            node.waits_for = [row.publisher for row in lacking]
            node.fail(f"nothing stamped t = {node.t / SECOND:.9g} s within {waited:.1f} s on {missing}")
