"""The start of a lockstep node: nobody sends before all readers of a message are matched, as the writer sees them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .endpoint import Output
from .middleware import Peer

if TYPE_CHECKING:
    from .lockstep import Lockstep

SETTLED = 10  # checks of 20 ms in a row in which what the graph says has not changed


class Handshake:
    """Says who is not there yet."""

    def __init__(self, node: Lockstep) -> None:
        self._node = node
        self._settled = 0
        self._seen: list[tuple[str, str]] = []

    def absent(self) -> list[str]:
        """Describe the peers that are not there yet; nothing when the node may begin."""
        node, links = self._node, self._node.links
        absent = [
            f"no publisher on {p.topic} (expected from {p.sender}{self._other_type(p.topic, p.item.port.msgtype)})"
            for p in [*node.pairings, *node.unpaced] if not p.item.publishers
        ]  # fmt: skip
        wanted: list[tuple[Output, list[str]]] = [(o, list(links.readers.get(o.name, []))) for o in node.outputs]
        if links.owns_clock:
            wanted.append((node.clock_output, links.clock_readers))
        if links.acknowledges:
            wanted.append((node.tick_output, links.tick_readers))
        found: list[tuple[str, str]] = []
        for peer in self._outside(absent):
            topics = node.middleware.subscriptions_of(peer)
            found += [(o.topic, peer.name) for o, _ in wanted if o.topic in topics]
        for output, names in wanted:
            names += [name for topic, name in found if topic == output.topic and name not in names]
            there = [i.name for i in node.middleware.subscribers(output.topic) if i.msgtype == output.port.msgtype]
            absent += [f"{name} does not subscribe {output.topic}" for name in names if name not in there]
            # The graph knows a reader before the writer is matched with it; only what the writer says counts.
            if names and output.readers < len(there):
                absent.append(f"{output.topic} has {output.readers} readers of {len(there)}")
        unread = [] if node.options.links else [o.topic for o in node.outputs if not o.readers]
        seen = [*found, *((topic, "") for topic in unread)]
        # A node announces its endpoints one by one, and by hand nobody says who reads what: what is seen counts when
        # all senders have come and it has not changed for a while.
        self._settled = self._settled + 1 if seen == self._seen and not absent else 0
        self._seen = seen
        if absent or self._settled >= SETTLED or (node.options.links and not links.outside):
            if len(unread) == len(node.outputs) and not node.is_plant:  # only a plant may do without any reader
                absent += [f"nobody subscribes {topic}" for topic in unread]
            return absent
        return [f"nobody subscribes {topic}" for topic in unread] or ["outside nodes are still announcing themselves"]

    def _outside(self, absent: list[str]) -> list[Peer]:
        """Give the external nodes behind the topics that they publish."""
        peers = []
        for topic in self._node.links.outside:
            found = self._node.middleware.publishers(topic)
            if not found:
                absent.append(f"no publisher on {topic} (expected from an external node)")
            peers += found[:1]
        return peers

    def _other_type(self, topic: str, msgtype: str) -> str:
        other = [t for t in self._node.middleware.types(topic) if t != msgtype]
        return f"; the topic exists with type {', '.join(other)}" if other else ""
