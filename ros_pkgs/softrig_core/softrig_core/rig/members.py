"""The members of a rig and how they are linked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..block.block import Block, Plant
from ..block.change import Change
from ..block.fill import Pick
from ..block.params import BlockParams, FromFiles, ParameterError
from ..block.port import CLOCK, Port
from ..block.schedule import Schedule
from ..errors import ScenarioError, closest
from ..kit.newest import Kept, of_these
from ..scenario.references import fill_parameters, parameter_of
from ..scenario.scenario import Scenario


@dataclass(frozen=True)
class Link:
    """The source of an input: the publishing member, its port, and the values that the input uses."""

    source: Member
    port: Port
    pick: Pick | None


@dataclass(eq=False)
class Member:
    """A node of the rig."""

    name: str
    package: str
    executable: str
    block_class: type[Block]
    params: BlockParams
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    external: bool
    remap: dict[str, str]
    links: dict[str, Link]
    schedule: Schedule
    changes: tuple[Change, ...] = ()

    @property
    def is_plant(self) -> bool:
        """Return whether it owns time."""
        return issubclass(self.block_class, Plant)

    def unlinked(self) -> Member:
        """Return the same node for another rig, in which it is not linked yet."""
        result = object.__new__(Member)
        result.__dict__.update(self.__dict__, remap=dict(self.remap), links={})
        return result

    @property
    def files(self) -> Mapping[str, str]:
        """Return name to hash of the files that affect the node in addition to its code."""
        return self.block_class.contents(self.params) if issubclass(self.block_class, FromFiles) else {}

    def block(self, seed: int) -> Block:
        """Create the block at its initial state; a ScenarioError names a node that cannot be set up."""
        try:
            block = self.block_class.seeded(self.params, self.name, seed)
        except ParameterError as error:
            raise ScenarioError(f"node {self.name}: {error}") from error
        return block


@dataclass(frozen=True)
class Members:
    """All members: plants first, then the others in the order in which they can answer a tick."""

    scenario: Scenario
    members: tuple[Member, ...]
    clock: Member

    @property
    def ticks(self) -> int:
        """Number of the clock's last tick."""
        assert self.clock.schedule.ticks is not None
        return self.clock.schedule.ticks

    @property
    def end(self) -> int:
        """Time of the clock's last tick, ns."""
        assert self.clock.schedule.end is not None
        return self.clock.schedule.end

    @property
    def classes(self) -> dict[str, type[Block]]:
        """The class of each node's block: with the scenario, all that a rig is built of."""
        return {m.name: m.block_class for m in self.members}

    @cached_property
    def topics(self) -> Mapping[str, Port]:
        """Every published topic in the order in which one tick's messages follow from each other."""
        result = {"/clock": CLOCK} | {port.topic: port for m in self.members for port in m.outputs}
        for m in self.members:
            result |= {p.topic: p for p in m.inputs if p.topic not in result}
        return result

    def readers(self, member: Member, port: Port) -> list[tuple[Member, Port]]:
        """Return the members that subscribe to an output."""
        return [
            (m, p)
            for m in self.members
            for p in m.inputs
            if (k := m.links.get(p.name)) and k.source is member and k.port.name == port.name
        ]

    def leaves(self) -> list[Member]:
        """Return the members for which no other waits at each tick; they acknowledge ticks so that no other runs ahead
        of them.
        """

        def awaited(m: Member) -> bool:
            # the inputs and conditions of an outside node are not known
            readers = [r for p in m.outputs for r, _ in self.readers(m, p) if not r.external]
            return any(r.schedule.every <= m.schedule.every for r in readers)

        return [m for m in self.members if not m.is_plant and not awaited(m)]

    def parameter(self, node: str, name: str) -> Any:
        """Return the value of ``$node.parameter``.

        Raises
        ------
        ScenarioError
            No such node or parameter.
        """
        params = {m.name: m.params for m in self.members}
        return parameter_of("", params, params.__getitem__, node, name)

    def reference(self, name: str) -> Any:
        """Return the value of a reference: of ``node.parameter``, or of a shared value by its name.

        Raises
        ------
        ScenarioError
            No such node, parameter or shared value.
        """
        node, _, parameter = name.partition(".")
        if parameter:
            return self.parameter(node, parameter)
        shared = self.scenario.shared
        if name not in shared:
            raise ScenarioError(f"${name}{closest(name, shared)}: the shared values are {', '.join(shared) or 'none'}")
        return fill_parameters(shared[name], self.parameter)


def signal_units(rig: Members) -> dict[str, str]:
    """Return the unit of every signal of a rig by its name ``topic/channel/field``; empty for a pure number.

    The variants of a rig share it, and what follows from it.
    """
    # Ports decide how members are linked.
    ports = [port for m in rig.members for port in (*m.inputs, None, *m.outputs, None)]
    return of_these(_units, ports, lambda: _units_of(rig))


_units: Kept[dict[str, str]] = {}


def _units_of(rig: Members) -> dict[str, str]:
    units = {
        f"{topic}/{label}": unit
        for topic, port in rig.topics.items()
        for label, unit in zip(port.labels, port.units, strict=True)
    }
    handed = {f"{p.topic}/{label}": unit_of(m, p, label) for m in rig.members for p in m.outputs for label in p.labels}
    return {name: "" if unit == "1" else unit for name, unit in (units | handed).items()}


def other_names(rig: Members) -> dict[str, dict[str, str]]:
    """Return, by topic, the names that outside nodes may use for the values of a port of the rig, to the port's own
    names.

    Channels by `Port.also`, and the elements of an array without a shape, which a held port accepts.
    """
    result: dict[str, dict[str, str]] = {}
    for port in (p for m in rig.members for p in m.inputs):
        flat = {f"data/{i}": label for i, label in enumerate(port.labels)} if port.held and port.dims else {}
        if names := dict(zip(port.also, port.channels, strict=False)) | flat:
            result.setdefault(port.topic, {}).update(names)
    return result


def unit_of(source: Member, port: Port, label: str, seen: tuple[str, ...] = ()) -> str:
    """Return the unit of an output's value; of a link, which forwards unknown units, that of its publisher."""
    unit = port.units[port.places[label]]
    for inward in source.inputs:
        link = source.links.get(inward.name)
        if not unit and link and inward.labels == port.labels and source.name not in seen:
            unit = unit_of(link.source, link.port, label, (*seen, source.name))
    return unit
