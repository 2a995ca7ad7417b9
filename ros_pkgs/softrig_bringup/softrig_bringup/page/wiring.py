"""The links of a rig, and the position of each node in its block diagram."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from softrig_core.data import Data

if TYPE_CHECKING:
    from softrig_core import Rig

SWEEPS = 8  # passes over the columns that bring neighbours closer together


@dataclass(frozen=True)
class Node(Data):
    """A node as a box of the diagram.

    Parameters
    ----------
    executable : str
        With its package: ``softrig_drives/dc_motor_plant``.
    period : float
        s.
    plant, outside : bool
        Whether the node owns time; whether it is an external node.
    """

    executable: str
    period: float
    plant: bool = False
    outside: bool = False


@dataclass(frozen=True)
class Wire(Data):
    """A topic from the node that publishes it to those that read it."""

    topic: str
    type: str
    source: str
    readers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Wiring(Data):
    """The nodes of a rig by name, and its wires."""

    nodes: dict[str, Node] = field(default_factory=dict)
    wires: tuple[Wire, ...] = ()

    def __post_init__(self) -> None:
        for wire in self.wires:
            for name in (wire.source, *wire.readers):
                if name not in self.nodes:
                    raise ValueError(f"{wire.topic} names {name!r}, which is none of the nodes")


def wiring_of(rig: Rig) -> Wiring:
    """Return the wiring of a rig; a clock that is no plant has no wires and is left out."""
    members = [m for m in rig.members if m.inputs or m.outputs]
    nodes = {
        m.name: Node(
            executable=f"{m.package}/{m.executable}", period=m.params.period, plant=m.is_plant, outside=m.external
        )
        for m in members
    }
    wires = tuple(
        Wire(
            topic=p.topic,
            type=p.msgtype,
            source=m.name,
            readers=tuple(dict.fromkeys(r.name for r, _ in rig.readers(m, p))),
        )
        for m in members
        for p in m.outputs
    )
    return Wiring(nodes=nodes, wires=wires)


def columns(wiring: Wiring) -> list[list[str]]:
    """Arrange the nodes in columns from left to right, as control engineers draw a loop.

    Nodes that act on a plant are left of it, as near as their readers allow. The plants follow, then the nodes that
    only observe. Wires out of a plant do not affect the order, because they are the feedback. Inside a column nodes are
    near the nodes they are connected to.
    """
    after = {n: [r for w in wiring.wires if w.source == n for r in w.readers] for n in wiring.nodes}
    plants = {n for n, node in wiring.nodes.items() if node.plant}
    forward = {n: [] if n in plants else after[n] for n in wiring.nodes}
    before = {n: [m for m in wiring.nodes if n in forward[m]] for n in wiring.nodes}
    acting = _longest(forward, plants)
    last = max(acting.values(), default=-1)
    looking = [n for n in wiring.nodes if n not in acting]
    watched = {n: [m for m in before[n] if m in looking] for n in looking}
    watching = _longest(watched, {n for n in looking if not watched[n]})
    column_of = {n: last - acting[n] if n in acting else last + 1 + watching[n] for n in wiring.nodes}
    results = [[n for n in wiring.nodes if column_of[n] == k] for k in range(max(column_of.values(), default=-1) + 1)]
    read = {n: [m for m in wiring.nodes if n in after[m]] for n in wiring.nodes}
    return _ordered(results, {n: [*after[n], *read[n]] for n in wiring.nodes})


def _longest(forward: Mapping[str, list[str]], goals: set[str]) -> dict[str, int]:
    """Return the length of the longest path to a goal for each node that has one; each cycle has a plant, where
    paths end.
    """
    result = dict.fromkeys(goals, 0)
    for _ in forward:
        longer = {n: 1 + max(ways) for n, to in forward.items() if (ways := [result[m] for m in to if m in result])}
        if all(result.get(n) == d for n, d in longer.items()):
            break
        result |= longer
    return result


def _ordered(texts: list[list[str]], neighbours: Mapping[str, list[str]]) -> list[list[str]]:
    """Sort each column by the mean place of the neighbours in other columns."""
    for sweep in range(SWEEPS):
        for column in texts if sweep else texts[::-1]:
            position = {n: (k + 0.5) / len(c) for c in texts for k, n in enumerate(c)}
            apart = {n: [position[m] for m in neighbours[n] if m not in column] for n in column}
            column.sort(key=lambda n: sum(apart[n]) / len(apart[n]) if apart[n] else position[n])
    return texts
