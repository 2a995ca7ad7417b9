"""A rig: the blocks of a scenario, wired by topic, checked before anything starts."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from ..errors import ScenarioError, closest, describe
from ..model.block import Block
from ..model.codec import selection
from ..model.params import ParameterError, build, flatten
from ..model.port import Port, Refused
from ..model.schedule import Schedule
from ..wire.signals import full_name
from .agreement import require_agreement
from .changes import script
from .faults import insert
from .figures import told
from .members import Link, Member, Members, signal_units, unit_of
from .node_parameters import NodeParameters
from .places import explain
from .requirements import watched
from .scenario import PlotEntry, Scenario
from .units import misfit

TICKS = 10**9  # of the clock in one run: more would take days


@dataclass(frozen=True)
class Rig(Members):
    """The members of a scenario, wired and checked."""

    @classmethod
    def from_scenario(cls, scenario: Scenario, classes: Mapping[str, type[Block]] | None = None) -> Rig:
        """Build, wire and check; `classes` gives nodes their block class where no executable does.

        Raises
        ------
        ScenarioError
            Names the node, port or cycle that cannot work.
        """
        known = dict(classes or {})
        for name, entry in scenario.nodes.items():
            if name not in known:
                known[name] = load_block(entry.package, entry.executable)
        if live := [n for n, e in scenario.nodes.items() if (e.package, e.executable) == FIGURES
                    and not {"figures", "scenario"} & e.parameters.keys()]:  # fmt: skip
            return cls._with_figures(scenario, live, known)
        params = NodeParameters(scenario, known)
        members = [_member(scenario, name, known[name], params) for name in scenario.nodes]
        if scenario.faults:
            return cls.from_scenario(_with_faults(scenario, members), known)
        if scenario.clock is not None or not any(m.is_plant for m in members):
            members.append(_clock(scenario, members))
        plants = [m for m in members if m.is_plant]
        clock = min(plants, key=lambda m: m.schedule.period)
        for m in members:
            try:
                m.schedule = Schedule(m.params.period, clock.params.period, scenario.duration,
                                      m.block_class.speaks_at_end())  # fmt: skip
            except ValueError as error:
                raise ScenarioError(f"{scenario.name}: node {m.name}: {error}, {clock.name}") from None
        if clock.schedule.ticks is not None and clock.schedule.ticks > TICKS:
            raise ScenarioError(f"{scenario.name}: {scenario.duration:g} s are {clock.schedule.ticks:.3g} periods of "
                                f"{clock.name}, expected at most {TICKS:.0e}")  # fmt: skip
        require_agreement(scenario.name, members)
        script(scenario.name, scenario.changes, members)
        _wire(scenario, members)
        rig = cls(_whole_names(scenario, members), (*plants, *_sorted([m for m in members if not m.is_plant])), clock)
        return cls.from_scenario(_with_watchers(rig), classes) if _live(scenario) else rig

    @classmethod
    def from_blocks(
        cls, blocks: Mapping[str, Block], duration: float, *, remap: Mapping[str, Mapping[str, str]] | None = None,
        name: str = "rig", **keys: Any,
    ) -> Rig:  # fmt: skip
        """Wire a rig from block objects, no file needed: by topic, as in a scenario.

        Parameters
        ----------
        blocks : mapping of node name to Block
            Their classes and parameters are taken; the objects themselves stay as they are.
        duration : float
            In s.
        remap : mapping, optional
            By node name: its topic to the topic that it is to have.
        name : str
        **keys
            Further keys of `Scenario`: ``figures``, ``expect``, ``plots``, ``seed``, ``title``.

        Examples
        --------
        >>> rig = Rig.from_blocks({"plant": Motor(R=0.4), "law": MyLaw(k=3.0)}, duration=2.0)
        >>> simulate(rig).signals["motor/state/shaft/velocity"]
        """
        nodes = {
            node: {"package": "none", "executable": type(block).__name__.strip("_"), "parameters": flatten(block.p),
                   "remap": dict((remap or {}).get(node, {}))}
            for node, block in blocks.items()
        }  # fmt: skip
        about = {"name": name, "title": name, "system": "", "source": "", "duration": duration, "nodes": nodes}
        try:
            scenario = Scenario.model_validate(about | keys)
        except ValidationError as error:
            raise ScenarioError(f"{name}: {explain(error, Scenario)}") from None
        return cls.from_scenario(scenario, {node: type(block) for node, block in blocks.items()})

    @classmethod
    def _with_figures(cls, scenario: Scenario, live: Sequence[str], known: Mapping[str, type[Block]]) -> Rig:
        """Build a rig some of whose nodes measure its figures while it runs: they are told which these are.

        They read what the figures name, also where a fault changes it for all others.
        """

        def rig(scenario: Scenario, told: Mapping[str, Any]) -> Rig:
            nodes = {n: e.model_copy(update={"parameters": {**told, **own[n]}}) if n in own else e
                     for n, e in scenario.nodes.items()}  # fmt: skip
            return cls.from_scenario(scenario.model_copy(update={"nodes": nodes}), known)

        own = {n: scenario.nodes[n].parameters for n in live}
        bare = rig(scenario, {"figures": "[]", "ports": "[]"})
        full = rig(bare.scenario, {"period": bare.clock.params.period, **told(bare)})
        nodes = {**full.scenario.nodes, **{n: scenario.nodes[n] for n in live}}  # what they are told may change
        return replace(full, scenario=full.scenario.model_copy(update={"nodes": nodes}))

    def changed(self, *, duration: float | None = None, overrides: Mapping[str, Any] | None = None) -> Rig:
        """Give the rig with another length or other parameters (``node.parameter`` to value)."""
        scenario = self.scenario.changed(duration=duration, overrides=overrides)
        return Rig.from_scenario(scenario, {m.name: m.block_class for m in self.members})

    def with_plots(self, plots: tuple[PlotEntry, ...]) -> Rig:
        """Give the rig with other plots."""
        changed = self.scenario.model_copy(update={"plots": plots})
        return replace(self, scenario=_whole_names(changed, list(self.members)))


_NO_MEMORY = re.compile("annot allocate memory|failed to map segment")  # of the C library and its loader
CLOCK_NODE = "clock"  # node and executable of a clock that is no plant
FIGURES = ("softrig_core", "figures")  # package and executable of what measures the figures of its rig


def load_main(package: str, executable: str) -> Any:
    """Import the main function of an installed Python executable; None when the package has none of this name.

    Raises
    ------
    ScenarioError
        Its module cannot be imported; says why and where.
    """
    try:
        points = importlib.metadata.distribution(package).entry_points.select(group="console_scripts")
    except importlib.metadata.PackageNotFoundError:
        return None
    if executable not in points.names:
        return None
    try:
        return points[executable].load()
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:
        if isinstance(error, OSError | ImportError) and _NO_MEMORY.search(str(error)):
            raise MemoryError(str(error)) from error
        raise ScenarioError(f"{package}/{executable} cannot be loaded: {describe(error)}") from error


def load_block(package: str, executable: str) -> type[Block]:
    """Find the block class behind an installed executable.

    Raises
    ------
    ScenarioError
        The package or executable is not installed, cannot be imported, or is not a softrig node.
    """
    try:
        points = importlib.metadata.distribution(package).entry_points.select(group="console_scripts")
    except importlib.metadata.PackageNotFoundError:
        near = closest(package, (d.name for d in importlib.metadata.distributions()))
        raise ScenarioError(f"package {package!r} is not installed in this environment{near}") from None
    names = sorted(points.names)
    if executable not in names:
        raise ScenarioError(f"package {package} has no executable {executable!r}{closest(executable, names)}; it has "
                            f"{', '.join(names)}")  # fmt: skip
    block: type[Block] | None = getattr(load_main(package, executable), "block", None)
    if block is None:
        raise ScenarioError(f"{package}/{executable} is a tool, not the node of a block")
    return block


def _member(scenario: Scenario, name: str, block: type[Block], parameters: NodeParameters) -> Member:
    entry = scenario.nodes[name]
    where = f"{scenario.name}: node {name}"
    try:
        params: Any = parameters(name)
        inputs, outputs = block.ports(params)
    except ParameterError as error:
        raise ScenarioError(f"{where}: {error}") from None
    topics = [p.topic for p in (*inputs, *outputs)]
    for topic in entry.remap:
        if topic not in topics:
            raise ScenarioError(f"{where}: remap of {topic!r}, but its topics are {', '.join(topics)}"
                                f"{scenario.written('nodes', name, 'remap', topic)}")  # fmt: skip
    inputs = tuple(p.renamed(entry.remap.get(p.topic, p.topic)) for p in inputs)
    outputs = tuple(p.renamed(entry.remap.get(p.topic, p.topic)) for p in outputs)
    return Member(name, entry.package, entry.executable, block, params, inputs, outputs, entry.external,
                  dict(entry.remap), {}, Schedule(params.period))  # fmt: skip


def _with_faults(scenario: Scenario, members: list[Member]) -> Scenario:
    """Give the scenario with its faults among its nodes."""
    nodes = insert(
        scenario.name, scenario.faults, {n: e.model_dump() for n, e in scenario.nodes.items()},
        {m.name: (m.inputs, m.outputs) for m in members}, {m.name: m.params for m in members},
    )  # fmt: skip
    return scenario.having(nodes=nodes, faults={})


def _live(scenario: Scenario) -> bool:
    return any(r.live or r.ends for r in scenario.requirements.values())


def _with_watchers(rig: Rig) -> Scenario:
    """Give the scenario with the nodes that watch its requirements among its nodes."""
    nodes = {n: e.model_dump() for n, e in rig.scenario.nodes.items()}
    for name, entry in watched(rig, signal_units(rig)).items():
        if name in nodes:
            raise ScenarioError(f"{rig.scenario.name}: node {name}: that is the name of what watches a requirement")
        nodes[name] = entry
    quiet = {n: r.model_copy(update={"live": False, "ends": False}) for n, r in rig.scenario.requirements.items()}
    return rig.scenario.having(nodes=nodes, requirements=quiet)


def _clock(scenario: Scenario, members: list[Member]) -> Member:
    """Make the clock of a rig without a plant, or with a period of its own."""
    if any(m.name == CLOCK_NODE for m in members):
        raise ScenarioError(f"{scenario.name}: node {CLOCK_NODE}: that is the name of the rig's own clock")
    block = load_block("softrig_core", CLOCK_NODE)
    period = scenario.clock if scenario.clock is not None else min(m.params.period for m in members)
    try:
        params: Any = build(block.Params, {"period": period})
    except ParameterError as error:
        raise ScenarioError(f"{scenario.name}: clock: {error}") from None
    schedule = Schedule(params.period)
    return Member(CLOCK_NODE, "softrig_core", CLOCK_NODE, block, params, (), (), False, {}, {}, schedule)


def _wire(scenario: Scenario, members: list[Member]) -> None:
    sources: dict[str, tuple[Member, Port]] = {}
    for member in members:
        for port in member.outputs:
            if port.topic in sources:
                other = sources[port.topic][0].name
                raise ScenarioError(f"{scenario.name}: {other} and {member.name} both publish {port.topic}")
            sources[port.topic] = (member, port)
    for member in members:
        for port in member.inputs:
            if port.topic not in sources:
                if port.held:
                    continue
                raise ScenarioError(
                    f"{scenario.name}: nobody publishes {port.topic}, which {member.name} needs; "
                    f"published are {', '.join(sources)}"
                )
            source, out = sources[port.topic]
            try:
                if out.delayed and not port.delayed:
                    raise Refused("its stamps are acquisition times, but the input pairs by stamp")
                member.links[port.name] = Link(source, out, selection(out, port))
            except Refused as error:
                raise ScenarioError(
                    f"{scenario.name}: {port.topic} from {source.name} does not fit {member.name}: {error}"
                ) from None
    _check_units(scenario, members)


def _whole_names(scenario: Scenario, members: list[Member]) -> Scenario:
    """Give the scenario with the signals of its figures and plots by their whole names."""
    known = {f"{p.topic}/{label}" for m in members for p in (*m.outputs, *m.inputs) for label in p.labels}

    def whole(value: Any) -> Any:
        if isinstance(value, str) and "/" in value and value not in known:
            return " - ".join(full_name(part, known) for part in value.split(" - "))
        return value

    figures = {
        name: f.model_copy(update={"arguments": {k: whole(v) for k, v in f.arguments.items()}, "since": whole(f.since)})
        for name, f in scenario.figures.items()
    }
    plots = tuple(p.model_copy(update={"signals": {whole(n): t for n, t in p.signals.items()}}) for p in scenario.plots)
    return scenario.model_copy(update={"figures": figures, "plots": plots})


def _check_units(scenario: Scenario, members: list[Member]) -> None:
    """Refuse links whose ends give one value different units."""
    for member in members:
        for port in member.inputs:
            link = member.links.get(port.name)
            for label, wanted in zip(port.labels, port.units, strict=True) if link else ():
                assert link is not None
                given = unit_of(link.source, link.port, label) if label in link.port.places else ""
                if wrong := misfit(given, wanted):
                    raise ScenarioError(f"{scenario.name}: {port.topic} from {link.source.name} does not fit "
                                        f"{member.name}: {label} {wrong}")  # fmt: skip


def _sorted(members: list[Member]) -> list[Member]:
    """Order members so that each follows its sources; a cycle without a plant has no order."""
    done: list[Member] = []
    path: list[Member] = []

    def visit(member: Member) -> None:
        if member in done:
            return
        if member in path:
            cycle = [m.name for m in path[path.index(member) :]] + [member.name]
            raise ScenarioError(f"cycle without a plant in it: {' -> '.join(cycle)}; no tick could ever be answered")
        path.append(member)
        for link in member.links.values():
            if not link.source.is_plant:
                visit(link.source)
        path.pop()
        done.append(member)

    for member in members:
        visit(member)
    return done
