"""The start of a node of a rig: it publishes a message only when its writer is matched with all its readers."""

from __future__ import annotations

from collections.abc import Sequence, Set

from ..seam.awaited import Awaited
from ..seam.endpoint import Input, Output
from ..seam.middleware import Peer, other_types
from .adapter import Adapter

CHECK = 1_000_000_000 // 50  # ns between two checks
# Checks in a row, half a second, in which the graph has not changed. A foreign node announces its endpoints one by one;
# those that appear within this time of each other lose no message.
SETTLED = 25


class Handshake:
    """Determines which nodes are still missing at the start.

    Parameters
    ----------
    awaited : sequence of (Input, str)
        Inputs that must have a writer, and the node that it belongs to.
    wanted : sequence of (Output, list of str)
        Outputs that must be matched with their readers, and the readers that the rig names.
    local : set of str
        Nodes of the same process, which are present.

    Attributes
    ----------
    lacking : list of str
        Topics of external nodes that no node publishes yet.
    missing : list of str
        Nodes that do not yet publish or subscribe to the expected topics.
    """

    def __init__(
        self,
        node: Adapter,
        awaited: Sequence[tuple[Input, str]],
        wanted: Sequence[tuple[Output, list[str]]],
        local: Set[str],
    ) -> None:
        self._node = node
        self._awaited = awaited
        self._wanted = [(output, [name for name in names if name not in local]) for output, names in wanted]
        self._local = local
        self._settled = 0
        self._seen: list[tuple[str, str | int]] = []
        self.lacking: list[str] = []
        self.missing: list[str] = []
        # A node without a rig, and a public rig, share their domain with recorders that may ask to be awaited.
        alone = not node.options.links
        self._recorders = Awaited(node.middleware, node.links.recorders) if alone or node.links.public else None

    def absent(self) -> list[str]:
        """Describe the missing peers; empty when the node may begin."""
        node = self._node
        self.missing = [sender for i, sender in self._awaited if not i.publishers and not i.received_any]
        absent = [
            f"no publisher on {i.port.topic} (expected from {sender}{self._other_type(i)})"
            for i, sender in self._awaited
            # A publisher that was matched and has gone has published everything.
            if not i.publishers and not i.received_any
        ]
        results: list[tuple[str, str]] = []
        for peer in self._outside(absent):
            topics = node.middleware.subscriptions_of(peer)
            results += [(o.topic, peer.name) for o, _ in self._wanted if o.topic in topics]
        for output, known in self._wanted:
            names = known + [name for topic, name in results if topic == output.topic and name not in known]
            names += self._recorders.of(output.topic) if self._recorders else []
            # A subscriber of another type is never matched, so nothing waits for it.
            matching = [i.name for i in node.middleware.subscribers(output.topic) if i.msgtype == output.port.msgtype]
            matching = [name for name in matching if name not in self._local]
            unmatched = [name for name in names if name not in matching]
            self.missing += unmatched
            absent += [f"{name} does not subscribe {output.topic}" for name in unmatched]
            # The graph knows a subscriber before the writer is matched with it, so the count of the writer decides.
            if names and output.readers < len(matching):
                unfit = node.middleware.unfit(output.topic, output.port.msgtype)
                never = [(name, why) for name, why in unfit if name in names]
                self.missing += [name for name, _ in never]
                absent += [f"{name} can never read {output.topic}: {why}" for name, why in never]
                if not never and output.readers < len(matching) - len(unfit):
                    absent.append(f"{output.topic} has {output.readers} of {len(matching) - len(unfit)} subscribers")
        unread = [] if node.options.links or self._local else [o.topic for o in node.outgoing.outputs if not o.readers]
        # A node announces its endpoints one by one, and without a rig nothing names the subscribers. So what the graph
        # shows counts once all publishers are there and it has not changed for a while. A program that is no ROS node
        # has no name in the graph and is seen only as a matched subscriber.
        state: list[tuple[str, str | int]] = [*results, *((output.topic, output.readers) for output, _ in self._wanted)]
        self._settled = self._settled + 1 if state == self._seen and not absent else 0
        self._seen = state
        if absent or self._settled >= SETTLED or self._knows_all():
            # Only a plant may run without any subscriber.
            if len(unread) == len(node.outgoing.outputs) and not node.is_plant:
                absent += [f"no node subscribes to {topic}" for topic in unread]
            return absent or node.overheard.absent()
        return [f"no node subscribes to {topic}" for topic in unread] or [
            "outside nodes are still announcing themselves"
        ]

    def _knows_all(self) -> bool:
        """Return whether the rig names all nodes that may be present."""
        links = self._node.links
        return bool(self._node.options.links) and not links.outside and not links.public

    def _outside(self, absent: list[str]) -> list[Peer]:
        """Return the external nodes behind the topics that they publish."""
        peers = []
        self.lacking = []
        resolve = self._node.middleware.resolve
        unmatched = {resolve(i.port.topic) for i, _ in self._awaited if not i.publishers and not i.received_any}
        for name in self._node.links.outside:
            topic = self._node.of_rig(name)
            result = self._node.middleware.publishers(topic)
            if not result or topic in unmatched:
                self.lacking.append(name)
            if not result:
                absent.append(f"no publisher on {name} (expected from an external node)")
            peers += result[:1]
        return list(dict.fromkeys(peers))

    def _other_type(self, item: Input) -> str:
        types = other_types(self._node.middleware, item.port)
        return f"; the topic exists with type {types}" if types else ""
