"""The data that a node needs about others: publishers of its inputs, nodes that wait for it, acknowledgements."""

from __future__ import annotations

from dataclasses import replace

from softrig_core.block.port import Port
from softrig_core.rig.members import Link, Member
from softrig_core.rig.options import InputLink, Links, OverheardLink
from softrig_core.rig.rig import Rig
from softrig_core.solver.solver import Solver


def links(rig: Rig, member: Member) -> Links:
    """Determine what a node must know about its peers."""
    paired = {
        port: InputLink(
            period=_seconds(link.source),
            node=link.source.name,
            at_end=link.source.schedule.at_end,
            port=link.port.name,
            sporadic=link.port.sporadic,
            delayed=link.port.delayed,
            reports_silence=_waits_for_silence(member, link),
        )
        for port, link in member.links.items()
        if not (link.source.external and link.port.sporadic)
    }
    tick_readers = _tick_readers(rig, member)
    pacers = _pacers(rig, member)
    acknowledging = [m for m in _acknowledging(rig) if m is not member] if member is _gatherer(rig) else []
    by_readers = rig.clock.external and bool(pacers or member.links)
    # An outside plant that reads no commands paces itself by the acknowledgements of a node that no node waits for, so
    # that node acknowledges its ticks although none of ours reads them.
    unheard = rig.clock.external and _gatherer(rig) is None and member in _acknowledging(rig)
    clocked = member in _clocked(rig)
    return Links(
        base=_seconds(rig.clock),
        inputs=paired,
        records=_recorded_inputs(rig, member),
        readers={p.name: [m.name for m, _ in rig.readers(member, p) if not m.external] for p in member.outputs},
        free=[name for name, k in member.links.items() if k.source.external and k.port.sporadic],
        overheard=_overheard(rig, member),
        guests=any(m.external for m in rig.members),
        outside=[p.topic for m in rig.members if m.external for p in m.outputs if has_own_reader(rig.readers(m, p))],
        # An outside clock may not publish /clock, so a source follows the acknowledgements of `_pacers` instead.
        clock=InputLink(period=_seconds(rig.clock), node=rig.clock.name) if clocked and not by_readers else None,
        follows_clock=clocked and by_readers,
        owns_clock=member is rig.clock,
        acknowledges=bool(tick_readers) or unheard,
        tick_readers=tick_readers,
        silence_readers=_silence_readers(rig, member),
        acks={m.name: _seconds(m) for m in [*acknowledging, *pacers]},
        followers=_followers(rig),
        clock_readers=[m.name for m in _clocked(rig) if not m.external] if member is rig.clock else [],
        solvers=[m.name for m in rig.members if issubclass(m.block_class, Solver) and not m.external],
        starter=starter(rig).name,
        starts=[m.name for m in rig.members if not m.external],
        grid=str(max(m.schedule.period for m in rig.members)),
    )


def starter(rig: Rig) -> Member:
    """Return the node that sets the start of a run in real time: the clock, or the first node that is ours."""
    return next((m for m in (rig.clock, *rig.members) if not m.external), rig.clock)


def _overheard(rig: Rig, member: Member) -> list[OverheardLink]:
    """Return the outputs of external nodes that a member records: those that it is the first to read.

    A sporadic output is recorded by its reader, at the tick that uses it. One without readers is recorded by a node
    that the external node reads, so that the recorder does not leave while that node still publishes; without such a
    node by the starter. A node whose remapping would subscribe it to another topic in its place is passed over.
    """
    result = []
    for m in rig.members:
        # Nodes that are themselves paced by others do not run far ahead of the external node.
        sources = sorted((k.source for k in m.links.values()), key=lambda source: not source.links)
        nodes = [node for node in (*sources, starter(rig), *rig.members) if not node.external]
        for p in m.outputs if m.external else ():
            readers = [(reader, port) for reader, port in rig.readers(m, p) if not reader.external]
            others = [(node, p) for node in nodes if p.topic not in node.remap]
            recorder, port = [*readers, *others, (starter(rig), p)][0]
            if recorder is member and not (readers and p.sporadic):
                link = {"period": _seconds(m), "node": m.name, "at_end": m.schedule.at_end}
                read = replace(port, topic=p.topic)
                result.append(OverheardLink.of(read, sporadic=p.sporadic, delayed=p.delayed, **link))
    return result


def has_own_reader(readers: list[tuple[Member, Port]]) -> bool:
    """Return whether a node of ours is among the readers of a port."""
    return any(not m.external for m, _ in readers)


def _seconds(member: Member) -> str:
    return str(member.schedule.period)


def _recorded_inputs(rig: Rig, member: Member) -> list[str]:
    """Return the inputs from outside the rig whose first subscriber is this node."""
    first: dict[str, Member] = {}
    for m in rig.members:
        for port in m.inputs:
            link = m.links.get(port.name)
            if link is None or link.source.external:
                first.setdefault(port.topic, m)
    return [p.name for p in member.inputs if first.get(p.topic) is member]


def _tick_readers(rig: Rig, member: Member) -> list[str]:
    """Name the nodes that read a member's acknowledgements of its ticks."""
    gatherer = _gatherer(rig)
    results = [gatherer] if gatherer not in (None, member) and member in _acknowledging(rig) else []
    results += [m for m in rig.members if member in _pacers(rig, m)]
    results += [m for p in member.outputs if p.sporadic for m, _ in rig.readers(member, p)]
    return list(dict.fromkeys(m.name for m in results if not m.external))


def _waits_for_silence(reader: Member, link: Link) -> bool:
    """Return whether a controller in real time waits for the acknowledgements of a sender that may be silent.

    A plant does not wait for messages. A message that is paired by its order belongs to the tick at which it arrives.
    """
    port = link.port
    return port.sporadic and port.stamped and not port.delayed and not reader.is_plant and not reader.external


def _silence_readers(rig: Rig, member: Member) -> list[str]:
    """Name the nodes that receive the silent ticks of a node in real time."""
    results = [m.name for m in rig.members for k in m.links.values() if k.source is member and _waits_for_silence(m, k)]
    return [] if member.external else list(dict.fromkeys(results))


def _clocked(rig: Rig) -> list[Member]:
    """Return the members that /clock paces: sources, and plants that do not own it."""
    return [m for m in rig.members if m is not rig.clock and (m.is_plant or not m.links)]


def _gatherer(rig: Rig) -> Member | None:
    """Return the member that waits for acknowledgements: the clock, or the node that commands an external clock."""
    if not rig.clock.external:
        return rig.clock
    senders = [k.source for k in rig.clock.links.values()]
    return next((m for m in senders if not m.external and not m.is_plant), None)


def _pacers(rig: Rig, member: Member) -> list[Member]:
    """Return the nodes whose ticks pace a source when an outside clock may not publish /clock.

    These are its readers, or the node that commands the clock.
    """
    if not rig.clock.external or member.external or member.is_plant or member.links:
        return []
    readers = [m for p in member.outputs for m, _ in rig.readers(member, p) if not m.external]
    gatherer = _gatherer(rig)
    return list(dict.fromkeys(readers)) or ([gatherer] if gatherer is not None else [])


def _followers(rig: Rig) -> list[str]:
    """Name the nodes that subscribe but have no subscribers; none if a node is outside or works for long."""
    if any(m.external or issubclass(m.block_class, Solver) for m in rig.members):
        return []
    return [
        m.name
        for m in rig.members
        if m.links and not m.is_plant and not any(rig.readers(m, port) for port in m.outputs)
    ]


def _acknowledging(rig: Rig) -> list[Member]:
    """Return the members that others could run ahead of: those that no node waits for, and further plants."""
    leaves = rig.leaves()
    return [m for m in rig.members if m is not rig.clock and not m.external and (m.is_plant or m in leaves)]
