"""A rig: the blocks of a scenario, wired by topic, checked before anything starts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from pydantic import ValidationError

from ..block.block import Block
from ..block.codec import selection
from ..block.loop import in_order
from ..block.params import ParameterError, build, flatten
from ..block.port import Port, Refused, require_distinct
from ..block.schedule import schedule_of
from ..board.clocked import ClockEntry, clocked
from ..board.entry import require_own_ports
from ..errors import ScenarioError, blaming
from ..judge.expectation import Expectation
from ..judge.units import misfit
from ..kit.newest import KEPT, Kept, of_these, once_for_objects
from ..scenario.changes import script
from ..scenario.node_parameters import NodeParameters, stands_alone
from ..scenario.places import explain
from ..scenario.scenario import FigureEntry, PlotEntry, Scenario
from ..wire.signals import full_name
from .agreement import require_agreement
from .installed import load_block
from .members import Link, Member, Members, unit_of

TICKS = 10**9  # ticks of the clock in one run: more would take days


@dataclass(frozen=True)
class Rig(Members):
    """The members of a scenario, wired and checked."""

    @classmethod
    def from_scenario(cls, scenario: Scenario, classes: Mapping[str, type[Block]] | None = None) -> Rig:
        """Build, wire and check the nodes of a scenario; `classes` holds block classes that no executable provides.

        Nodes of other entries (faults, live requirements, live figures) are not added here; `rig_of` adds them.

        Raises
        ------
        ScenarioError
            A node, port or cycle cannot work; the error names it.
        """
        members = members_of(scenario, classes or {})
        if scenario.clock is not None or not any(m.is_plant for m in members):
            members.append(_clock(scenario, members))
        clock = min((m for m in members if m.is_plant), key=lambda m: m.schedule.period)
        return cls(scenario, (), clock).having(scenario, members, members)

    def listened(self, scenario: Scenario, names: Iterable[str]) -> Rig:
        """Return the rig with more nodes of a scenario, or with others of the same names, that only subscribe.

        Parameters
        ----------
        scenario : Scenario
            That of the rig, with them.

        Raises
        ------
        ScenarioError
            As `from_scenario`.
        """
        new = {m.name: m for m in members_of(scenario, self.classes, names)}
        members = [new.get(m.name, m) for m in self.members]
        members += [m for m in new.values() if m not in members]
        return self.having(scenario, members, list(new.values()))

    def having(self, scenario: Scenario, members: list[Member], new: list[Member]) -> Rig:
        """Return a rig of all these nodes, in which the new ones are not linked yet."""
        clock = self.clock
        for m in new:
            try:
                m.schedule = schedule_of(
                    m.params.period, clock.params.period, scenario.duration, m.block_class.ticks_at_end()
                )
            except ValueError as error:
                raise ScenarioError(f"{scenario.name}: node {m.name}: {error}, {clock.name}") from None
        if clock.schedule.ticks is not None and clock.schedule.ticks > TICKS:
            raise ScenarioError(
                f"{scenario.name}: {scenario.duration:g} s are {clock.schedule.ticks:.3g} periods of "
                f"{clock.name}, expected at most {TICKS:.0e}"
            )
        require_agreement(scenario.name, members)
        for m in members:
            m.changes = ()
        script(scenario.name, scenario.changes, members)
        _link(scenario, members, new)
        _check_units(scenario, new)
        ordered = in_order(members, lambda m: m.is_plant, lambda m: [link.source for link in m.links.values()])
        rig = replace(self, scenario=_whole_names(scenario, members), members=tuple(ordered))
        return replace(rig, scenario=rig.scenario.model_copy(update={"expect": _expected(rig)}))

    @classmethod
    def from_blocks(
        cls,
        blocks: Mapping[str, Block],
        duration: float,
        *,
        remap: Mapping[str, Mapping[str, str]] | None = None,
        name: str = "rig",
        **keys: Any,
    ) -> Rig:
        """Wire a rig from block objects, no file needed: by topic, as in a scenario.

        Parameters
        ----------
        blocks : mapping of node name to Block
            Only their classes and parameters are used; the objects themselves are not changed.
        duration : float
            Duration of a run, s.
        remap : mapping, optional
            By node name: its topic to the new topic.
        **keys
            Further keys of `Scenario`: ``figures``, ``expect``, ``plots``, ``seed``, ``title``.

        Examples
        --------
        >>> rig = Rig.from_blocks({"plant": Motor(R=0.4), "law": MyLaw(k=3.0)}, duration=2.0)
        >>> simulate(rig).signals["motor/state/shaft/velocity"]
        """
        nodes = {
            node: {
                "package": "none",
                "executable": type(block).__name__.strip("_"),
                "parameters": flatten(block.p),
                "remap": dict((remap or {}).get(node, {})),
            }
            for node, block in blocks.items()
        }
        about = {"name": name, "title": name, "system": "", "source": "", "duration": duration, "nodes": nodes}
        try:
            scenario = Scenario.model_validate(about | keys)
        except ValidationError as error:
            raise ScenarioError(f"{name}: {explain(error, Scenario)}") from None
        return cls.from_scenario(scenario, {node: type(block) for node, block in blocks.items()})

    def with_plots(self, plots: tuple[PlotEntry, ...]) -> Rig:
        """Return the rig with other plots."""
        changed = self.scenario.model_copy(update={"plots": plots})
        return replace(self, scenario=_whole_names(changed, list(self.members)))


CLOCK_NODE = "clock"  # node and executable of a clock that is no plant


def members_of(
    scenario: Scenario, classes: Mapping[str, type[Block]], names: Iterable[str] | None = None
) -> list[Member]:
    """Create members of a scenario, not yet linked.

    Parameters
    ----------
    classes : mapping of node name to type of Block
        Classes of nodes that no executable provides.
    names : iterable of str, optional
        Only these.

    Raises
    ------
    ScenarioError
        The executable, parameters or topics of a node are wrong; the error names the node.
    """
    entries = scenario.nodes.items()
    known = {n: classes[n] if n in classes else load_block(e.package, e.executable) for n, e in entries}
    parameters = NodeParameters(scenario, known)
    require_own_ports({n: e.link for n, e in entries if e.link is not None}, scenario.name)
    return [_member(scenario, n, known[n], parameters) for n in (known if names is None else names)]


@once_for_objects
def _ports(block: type[Block], params: Any) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """Return the inputs and outputs of a block with these parameters; raise a ValueError if they are invalid."""
    inputs, outputs = block.ports(params)
    require_distinct(inputs, outputs)
    return inputs, outputs


@once_for_objects
def _remapped(ports: tuple[Port, ...], remap: Mapping[str, str]) -> tuple[Port, ...]:
    return tuple([p.renamed(remap.get(p.topic, p.topic)) for p in ports])


def _member(scenario: Scenario, name: str, block: type[Block], parameters: NodeParameters) -> Member:
    entry = scenario.nodes[name]
    # Runs of a study share the entries of all nodes but the changed ones.
    if entry.external is False and entry.link is None and stands_alone(block, entry.parameters):
        known = of_these(_known, (entry, block, name), lambda: _new_member(scenario, name, block, parameters))
        return known.unlinked()
    return _new_member(scenario, name, block, parameters)


_known: Kept[Member] = {}


def _new_member(scenario: Scenario, name: str, block: type[Block], parameters: NodeParameters) -> Member:
    entry = scenario.nodes[name]
    context = f"{scenario.name}: node {name}"
    params: Any = parameters(name)  # its errors name the node already
    if isinstance(entry.external, ClockEntry):
        block = clocked(block, entry.external, params, context)
    with blaming(context):
        inputs, outputs = _ports(block, params)
    if entry.link is not None:
        if entry.external:
            raise ScenarioError(f"{context}: it is external and has a link; remove one of the two")
        from ..board.link import linked  # with all wires: few rigs have one, and its imports take 20 ms

        block = linked(block, entry.link, params, context)
    for topic in entry.remap:
        topics = [p.topic for p in (*inputs, *outputs)]
        if topic not in topics:
            raise ScenarioError(
                f"{context}: remap of {topic!r}, but its topics are {', '.join(topics)}"
                f"{scenario.written('nodes', name, 'remap', topic)}"
            )
    if entry.remap:
        inputs, outputs = _remapped(inputs, entry.remap), _remapped(outputs, entry.remap)
    return Member(
        name,
        entry.package,
        entry.executable,
        block,
        params,
        inputs,
        outputs,
        entry.external is True,
        dict(entry.remap),
        {},
        schedule_of(params.period),
    )


def _clock(scenario: Scenario, members: list[Member]) -> Member:
    """Create the clock of a rig without a plant, or with a period of its own."""
    if any(m.name == CLOCK_NODE for m in members):
        raise ScenarioError(f"{scenario.name}: node {CLOCK_NODE}: that is the name of the rig's own clock")
    block = load_block("softrig_core", CLOCK_NODE)
    period = scenario.clock if scenario.clock is not None else min(m.params.period for m in members)
    try:
        params: Any = build(block.Params, {"period": period})
    except ParameterError as error:
        raise ScenarioError(f"{scenario.name}: clock: {error}") from None
    schedule = schedule_of(params.period)
    return Member(CLOCK_NODE, "softrig_core", CLOCK_NODE, block, params, (), (), False, {}, {}, schedule)


def _link(scenario: Scenario, members: list[Member], new: list[Member]) -> None:
    """Find the sources of the new members' inputs."""
    sources: dict[str, tuple[Member, Port]] = {}
    for member in members:
        for port in member.outputs:
            if port.topic in sources:
                rival = sources[port.topic][0].name
                raise ScenarioError(f"{scenario.name}: {rival} and {member.name} both publish {port.topic}")
            sources[port.topic] = (member, port)
    for member in new:
        for port in member.inputs:
            if port.topic not in sources:
                if port.held:
                    continue
                raise ScenarioError(
                    f"{scenario.name}: no node publishes {port.topic}, which {member.name} needs; "
                    f"published are {', '.join(sources)}"
                )
            source, output = sources[port.topic]
            try:
                if output.delayed and not port.delayed:
                    raise Refused("its stamps are acquisition times, but the input pairs by stamp")
                member.links[port.name] = Link(source, output, selection(output, port))
            except Refused as error:
                raise ScenarioError(
                    f"{scenario.name}: {port.topic} from {source.name} does not fit {member.name}: {error}"
                ) from None


def _expected(rig: Rig) -> dict[str, Expectation]:
    """Return a scenario's expectations, with their numbers from the nodes filled in."""
    result = {}
    for name, limits in rig.scenario.expect.items():
        try:
            result[name] = limits.resolved(rig.reference)
        except ScenarioError as error:
            location = rig.scenario.written("expect", name)
            raise ScenarioError(f"{rig.scenario.name}: expect {name}: {error}{location}") from None
    return result


def _whole_names(scenario: Scenario, members: list[Member]) -> Scenario:
    """Return the scenario with the signals of its figures and plots by their whole names."""
    known = _signals(*(p for m in members for p in (*m.outputs, *m.inputs)))
    figures, plots = _named(scenario.figures, scenario.plots, known)
    return scenario.model_copy(update={"figures": figures, "plots": plots})


@lru_cache(maxsize=KEPT)
def _signals(*ports: Port) -> frozenset[str]:
    """Return the signal names of ports; equal ports share one object, because a block may create its ports again."""
    return frozenset(f"{p.topic}/{label}" for p in ports for label in p.labels)


@once_for_objects
def _named(
    figures: Mapping[str, FigureEntry], plots: tuple[PlotEntry, ...], known: frozenset[str]
) -> tuple[dict[str, FigureEntry], tuple[PlotEntry, ...]]:
    def full(value: Any) -> Any:
        if isinstance(value, str) and "/" in value and "$" not in value and value not in known:
            return " - ".join(full_name(part, known) for part in value.split(" - "))
        return value

    def entry(f: FigureEntry) -> FigureEntry:
        since = ", ".join(map(full, f.since.split(", ")))
        return f.model_copy(update={"arguments": {k: full(v) for k, v in f.arguments.items()}, "since": since})

    return (
        {name: entry(f) for name, f in figures.items()},
        tuple(p.model_copy(update={"signals": {full(n): t for n, t in p.signals.items()}}) for p in plots),
    )


def _check_units(scenario: Scenario, members: list[Member]) -> None:
    """Refuse links whose ends have different units for one value."""
    for member in members:
        for port in member.inputs:
            link = member.links.get(port.name)
            for label, wanted in zip(port.labels, port.units, strict=True) if link else ():
                assert link is not None
                unit = unit_of(link.source, link.port, label) if label in link.port.places else ""
                if wrong := misfit(unit, wanted):
                    raise ScenarioError(
                        f"{scenario.name}: {port.topic} from {link.source.name} does not fit "
                        f"{member.name}: {label} {wrong}"
                    )
