"""The nodes of one process: they pass numbers to each other, and in lockstep one runner runs their ticks.

While no other process and no person takes part, native code runs those ticks where it can. The recording is then
written in batches of many ticks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from softrig_core.block.codec import selection
from softrig_core.block.fill import Pick
from softrig_core.block.loop import in_order
from softrig_core.block.port import Refused
from softrig_core.block.step import Step
from softrig_core.errors import RunError

from .adapter.adapter import Adapter
from .lockstep.lockstep import Lockstep
from .lockstep.turns import Turns
from .realtime.beat import Beat
from .realtime.live import Live
from .realtime.native import Native
from .realtime.realtime import Realtime
from .seam.endpoint import Output


class Group:
    """Nodes of one process, driven together.

    Parameters
    ----------
    nodes : sequence of Adapter
        All in lockstep, or all in real time.
    """

    def __init__(self, nodes: Sequence[Adapter]) -> None:
        self.nodes = nodes
        for node in nodes:
            node.neighbours = nodes
        names = {n.middleware.name for n in nodes}
        if {n.options.mode for n in nodes} == {"realtime"}:
            drives = {n: Realtime(n) for n in nodes}
            links = _links(nodes)
            if _is_closed(drives.values(), links):
                _feed(links)
                commands = [(k.writer.step, k.item, drives[k.reader]) for k in links if k.reader.is_plant]
                driven = {d.step: d for d in drives.values()}
                ordered = [driven[step] for step in _ordered(nodes)]
                native = Native(ordered)
                native.prepare()
                Beat(ordered, commands, native)
            else:
                for writer, output, reader, item, pick in links:
                    drives[writer].connect(output, drives[reader], item, pick)
            for node, drive in drives.items():
                drive.join(names - {node.middleware.name})
            waiting = [d.departure for d in drives.values() if d.departure is not None]
            for departure in waiting:
                departure.neighbours = [d for d in waiting if d is not departure]
            return
        turns = Turns(nodes)
        steps = [Lockstep(n, turns) for n in nodes]
        links = _links(nodes)
        _feed(links)
        turns.order(_ordered(nodes), lambda: all(step.alone for step in steps))
        for step in steps:
            step.join(names - {step.node.middleware.name})


class _Link(NamedTuple):
    """An input that is written by a node of the same process."""

    writer: Adapter
    output: Output
    reader: Adapter
    item: Any  # the reader's row of the kind of its drive
    pick: Pick | None


def _links(nodes: Sequence[Adapter]) -> list[_Link]:
    """Find which nodes of the process read which; RunError if two ports do not match, or two nodes publish a topic."""
    written: dict[tuple[str, str], tuple[Adapter, Output]] = {}
    for node in nodes:
        for output in node.outgoing.outputs:
            key = output.topic, output.port.msgtype
            if key in written:
                names = f"{written[key][0].middleware.full_name}, {node.middleware.full_name}"
                raise RunError(f"2 publishers on {output.topic} ({names}), expected exactly one")
            written[key] = node, output
    result = []
    for node in nodes:
        for item in node.inputs:
            source = written.get((node.middleware.resolve(item.port.topic), item.port.msgtype))
            if source is None:
                continue
            try:
                result.append(_Link(*source, node, item, selection(source[1].port, item.port)))
                item.local = True
            except Refused as error:
                raise RunError(f"{source[1].topic} does not fit {node.middleware.name}: {error}") from None
    return result


def _feed(links: Sequence[_Link]) -> None:
    """Fill the inputs with the messages that have been published so far."""
    for writer, output, reader, item, pick in links:
        writer.step.hands_to(output.name, reader.step, item.name, pick)


def _ordered(nodes: Sequence[Adapter]) -> list[Step]:
    """Return the steps of nodes that are fed, in the order in which they answer a tick."""
    return in_order([n.step for n in nodes], lambda s: s.plant, lambda s: [fill.source for fill in s.fed.values()])


def _is_closed(drives: Iterable[Realtime], links: Sequence[_Link]) -> bool:
    """Return whether nodes read only each other, with checked links and at their ticks; free inputs may be external."""
    rows = [row for drive in drives for row in drive.senders.rows]
    fed = [row for row in rows if row.local]
    # One timer for all nodes needs a common t = 0. The outputs of faults are excluded, because each reader has to check
    # them (`Live.receiver`).
    return (
        bool(fed)
        and all(row.paired and type(row) is Live for row in fed)
        and not any(row.awaited or row.schedule is not None for row in rows if not row.local)
        and not any(k.output.port.unchecked for k in links)
        and all(d.node.links.starter or d.node.options.epoch for d in drives)
    )
