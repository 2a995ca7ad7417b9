"""The run in a pack, read without running code of its sender; its figures are computed from its bag."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from softrig_bags.files.reader import BagReader
from softrig_bags.read import BagSignals, signals
from softrig_bags.tape import written
from softrig_core import Port, Rig, Run, Scenario, ScenarioError, load_scenario, rig_of
from softrig_core.block.port import CLOCK, XYZ
from softrig_core.kit.file_format import json_object, json_of
from softrig_core.rig.code import is_ours
from softrig_core.rig.members import other_names
from softrig_core.rig.rig import members_of
from softrig_core.scenario.scenario import NodeEntry
from softrig_core.verdict.result import Result
from softrig_core.wire.signals import full_name
from softrig_core.wire.types import TYPES

from ..options.identity import HALF, asked_half, bagged_half, strangers
from ..pack.cargo import brings, check_scenario
from ..pack.packed import about
from ..pack.parts import BAG, METRICS, SCENARIO
from .record import RunRecord, record_of

SAME = 1e-9  # relative difference up to which figures of other libraries from the same bag agree


def rig_of_pack(folder: Path) -> tuple[Rig, BagSignals]:
    """Return rig and signals of an unpacked pack's run; if the pack contains packages, only its bag is used.

    Raises
    ------
    ScenarioError
        No bag in it, or its scenario reaches out of it.
    """
    stated = about(folder)
    scenario = load_scenario(str(folder / SCENARIO / f"{stated.scenario}.yaml"))
    check_scenario(folder, scenario, stated)
    if not (folder / BAG).is_dir():
        raise ScenarioError("no bag in it; `softrig run --like` makes it again")
    result = signals(folder / BAG, on_disk=True)
    names = brings(folder, stated)
    rig = recorded_rig(scenario, folder / BAG, result, names) if names else rig_of(scenario)
    return rig, result.known_as(other_names(rig))


def record_of_pack(folder: Path) -> RunRecord:
    """Read the record of an unpacked pack's run, with figures computed from its bag and its scenario.

    Returns
    -------
    RunRecord
        Its `contradictions` list what its metrics.json states differently, what does not belong together, and what
        could not be computed.
    """
    stated, content = about(folder), _content(folder)
    rig, result = rig_of_pack(folder)
    with BagReader(folder / BAG) as reader:
        custom = reader.custom_data
    strange = strangers(content, custom, bagged_half(folder / BAG))
    run = str(content.get("run", "")) or stated.run
    if stated.run and run != stated.run:
        strange.append(f"pack.json is of run {stated.run[:HALF]}, metrics.json of run {run[:HALF]}")
    if names := brings(folder, stated):
        strange.append(f"the figures are those of metrics.json, as computing them needs code: {', '.join(names)}")
    else:
        if run and asked_half(rig, _seed(content, rig)) != run[HALF:]:
            strange.append("its scenario is not that of its run: duration, seed or parameters differ")
        results = Run(rig, rig.scenario.seed, result.recording, epoch=int(custom.get("epoch", "0"))).results
        strange += differing(content.get("metrics", []), results)
        content = {**content, "metrics": [m.plain() for m in results]}
    return record_of(content | {"contradictions": strange}, METRICS)


def _seed(content: Mapping[str, Any], rig: Rig) -> int:
    seed = content.get("seed")
    return seed if isinstance(seed, int) else rig.scenario.seed


def differing(text: Any, measured: Sequence[Result]) -> list[str]:
    """Describe figures that differ between a metrics.json and the computation from its bag."""
    stored = {m.get("name"): m for m in text if isinstance(m, Mapping)} if isinstance(text, list) else {}
    results = []
    for result in measured:
        value = stored.get(result.name, {}).get("value")
        if result.name not in stored:
            results.append(f"{result.name}: not in metrics.json, the bag gives {_number(result.value)}")
        elif not _same(value, result.value):
            results.append(f"{result.name}: {_number(value)} in metrics.json, the bag gives {_number(result.value)}")
    return [
        *results,
        *(f"{name}: no figure of its scenario" for name in stored if name not in {m.name for m in measured}),
    ]


def _same(a: Any, b: float | None) -> bool:
    if a is None or b is None:
        return a is b
    return isinstance(a, int | float) and math.isclose(a, b, rel_tol=SAME, abs_tol=1e-300)


def _number(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, int | float) else "none" if value is None else repr(value)[:60]


def _content(folder: Path) -> dict[str, Any]:
    try:
        content = json_of((folder / METRICS).read_text())
    except OSError:
        raise ScenarioError(f"no {METRICS} in it, expected a pack of a run's folder") from None
    except ValueError as error:
        raise ScenarioError(f"{METRICS}: not valid JSON: {error}") from None
    if not isinstance(content, dict):
        raise ScenarioError(f"{METRICS}: expected an object")
    return content


# a rig made only of recorded topics --------------------------------------------------------------------------------


def recorded_rig(scenario: Scenario, bag: Path, result: BagSignals, apart: Collection[str]) -> Rig:
    """Create a rig of one node that publishes a bag's topics; it keeps those plots that the topics can show.

    Parameters
    ----------
    bag : Path
        Beside it is the metrics.json of its run, which has units of signals.
    apart : collection of str
        Nodes, and packages, whose code may not run for it.
    """
    nodes = {n: e for n, e in scenario.nodes.items() if is_ours(e.package) and n not in apart}
    units = {name: str(entry.get("unit", "")) for name, entry in _units(bag.parent).items()}
    ports = [written(port) for port in _ports(scenario, result, units, nodes)]
    if not ports:
        raise ScenarioError(f"{scenario.name}: no topic in its bag that can be shown without its code")
    tape = {"package": "softrig_bags", "executable": "tape", "parameters": {"period": 0.001, "bag": str(bag),
            "inputs": ports}}  # fmt: skip
    none: dict[str, Any] = {key: {} for key in ("faults", "figures", "expect", "claims", "requirements", "shared")}
    none |= dict.fromkeys(("changes", "containers", "trips", "plots"), ()) | {"clock": None}
    rig = rig_of(scenario.having(nodes={"recorded": tape}, **none))
    known = [f"{p.topic}/{label}" for p in rig.topics.values() for label in p.labels]

    def available(name: str) -> bool:
        return all(full_name(signal, known) in known for signal in name.split(" - "))

    plots = tuple(p for p in scenario.plots if not p.x and all(map(available, p.signals)))
    return rig.with_plots(plots)


def _units(folder: Path) -> Mapping[str, Mapping[str, Any]]:
    result = json_object(folder / METRICS).get("signals")
    return {k: v for k, v in result.items() if isinstance(v, Mapping)} if isinstance(result, Mapping) else {}


def _ports(
    scenario: Scenario, result: BagSignals, units: Mapping[str, str], nodes: Mapping[str, NodeEntry]
) -> Iterator[Port]:
    """Yield a port for each recorded topic: that of its node, or one made from its messages."""
    known: dict[str, Port] = {}
    if nodes:
        alone = scenario.having(nodes=nodes, changes=(), containers=(), trips=(), faults={})
        known = {p.topic: p for m in members_of(alone, {}) for p in (*m.inputs, *m.outputs)}
    for name, topic in result.recording.topics.items():
        if name == CLOCK.topic or topic.msgtype not in TYPES or not topic.number:
            continue
        port = known.get(name) or _port(name, topic.msgtype, list(result.table(name).columns), units)
        if port is not None and port.size:
            yield replace(port, name=f"topic_{len(name)}_{name}".replace("/", "_"), topic=name, held=False)


def _port(name: str, msgtype: str, labels: Sequence[str], units: Mapping[str, str]) -> Port | None:
    """Return a port that fits the messages of a topic; None if there is none."""
    kind = TYPES[msgtype]
    parts = [label.rpartition("/") for label in labels]
    channels = tuple(dict.fromkeys(p[0] for p in parts)) if kind.named else XYZ
    fields = tuple(dict.fromkeys(p[2] for p in parts)) if kind.named else tuple(kind.sizes)
    try:
        port = Port("x", name, msgtype, channels, fields, tuple(units.get(f"{name}/{label}", "") for label in labels))
    except (ValueError, KeyError):
        return None
    return port if list(port.labels) == list(labels) else None
