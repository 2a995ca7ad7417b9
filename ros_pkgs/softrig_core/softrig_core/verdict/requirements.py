"""Requirements of a scenario: formulas of signal temporal logic over its shared names, measured like any figure.

A requirement is a figure whose value is its margin (robustness) and whose expectation is: at least zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..block.schedule import Schedule
from ..errors import ScenarioError
from ..judge.arithmetic import Array, Tree
from ..judge.formula import Condition, intervals, margin_unit, read, variables
from ..judge.measures import SignalMap, newest
from ..judge.requirement_entry import Requirement
from ..judge.robustness import Margin, Record, truth
from ..rig.members import Members
from ..scenario.port_text import ports_text, reader
from ..scenario.references import fill_parameters
from ..timebase import SECOND
from ..wire.signals import full_name

Items = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Judge:
    """A requirement of a rig: its formula read, its names found, its margin's unit known.

    Called with signals it gives the margin, as a figure function does; `ticker` is a signal that goes to a run's end.
    """

    tree: Tree
    signals: Mapping[str, str]
    conditions: Mapping[str, Condition]
    unit: str
    clock: Schedule
    ticker: str
    reads: tuple[str, ...] = ()

    def __call__(self, signals: SignalMap) -> float:
        """Measure the margin; a ValueError says why it cannot be judged."""
        return self.margin(signals).value

    def margin(self, signals: SignalMap) -> Margin:
        """Measure the margin, and find where it is least and where the formula is violated.

        Raises
        ------
        ValueError
            Not judged: the record does not decide the formula, or its arithmetic is undefined.
        """
        found = {name: signals[signal] for name, signal in self.signals.items()}
        ticks, _ = signals[self.ticker]
        if not len(ticks):
            raise ValueError(f"not judged: nothing was recorded of {self.ticker}")
        grid = _grid(self.clock, ticks[-1])
        held, truths, late = {}, {}, {}
        for name in variables(self.tree):
            condition = self.conditions.get(name)
            times, values = found[condition.signal if condition else name]
            now, none = _newest(np.rint(times * SECOND), values, grid)
            if condition:
                truths[name] = truth(condition, now, np.concatenate((now[:1], now[:-1])))
            else:
                held[name], late[name] = now, none
        after = self.clock.next(int(grid[-1]))
        return Record(grid, held, truths=truths, late=late, after=after).margin(self.tree)


def _grid(clock: Schedule, end: float) -> Array:
    """Ticks of the clock up to the record's end, ns."""
    last = clock.tick(clock.held(round(end * SECOND)))
    return clock.times(0, last + 1).astype(np.float64)


def _newest(times: Array, values: Array, grid: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Give for each tick the newest of the values that came at these times, 0 before the first, and where that is."""
    if len(times) >= len(grid) and np.array_equal(times[: len(grid)], grid):  # one a tick
        return values[: len(grid)], np.zeros(len(grid), dtype=bool)
    at = newest(times, grid)
    return np.where(at < 0, 0.0, values[at]) if len(values) else np.zeros(len(grid)), at < 0


def names_of(rig: Members, units: Mapping[str, str]) -> tuple[dict[str, float], dict[str, str]]:
    """Give the shared names of a rig's scenario that formulas may use: numbers, and signals.

    Parameters
    ----------
    units : mapping
        Of each signal of the rig.
    """
    shared = rig.scenario.shared.items()
    named = {k: fill_parameters(v, rig.parameter) if isinstance(v, str) else v for k, v in shared}
    numbers = {k: float(v) for k, v in named.items() if isinstance(v, int | float) and not isinstance(v, bool)}
    signals = {k: full_name(v, units) for k, v in named.items() if isinstance(v, str)}
    return numbers, {k: v for k, v in signals.items() if v in units}


def watched(rig: Members, units: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Give the nodes that watch requirements of a rig's scenario while it runs, as entries of its nodes."""
    numbers, signals = names_of(rig, units)
    nodes = {}
    for name, requirement in rig.scenario.requirements.items():
        if not (requirement.live or requirement.ends):
            continue
        judge = _judge(rig, requirement, {**numbers, **dict.fromkeys(signals)}, signals, units)
        topics = {t: p for t, p in rig.topics.items() if any(s.startswith(f"{t}/") for s in judge.signals.values())}
        ports = ports_text([reader(p, f"input_{k}") for k, p in enumerate(topics.values())])
        nodes[f"requirement_{name}"] = {
            "package": "softrig_control",
            "executable": "requirement_monitor",
            "parameters": {
                "period": rig.clock.params.period,
                "formula": requirement.formula,
                "ports": ports,
                "names": list(judge.signals),
                "signals": list(judge.signals.values()),
                "constants": list(numbers),
                "values": list(numbers.values()),
                "scale_units": list(requirement.scale),
                "scale_values": list(requirement.scale.values()),
                "topic": f"requirement/{name}",
                "ends": requirement.ends,
            },
        }
    return nodes


def judges(rig: Members, units: Mapping[str, str]) -> dict[str, Judge]:
    """Read the requirements of a rig's scenario.

    Parameters
    ----------
    units : mapping
        Of each signal of the rig.

    Raises
    ------
    ScenarioError
        Names the requirement: a formula that does not parse, an unknown name, units that do not fit, an interval
        without a tick in it.
    """
    if not rig.scenario.requirements:
        return {}
    numbers, signals = names_of(rig, units)
    known: dict[str, float | None] = {**numbers, **dict.fromkeys(signals)}
    found = {}
    for name, requirement in rig.scenario.requirements.items():
        try:
            found[name] = _judge(rig, requirement, known, signals, units)
        except ScenarioError as error:
            raise ScenarioError(f"{rig.scenario.name}: requirement {name}: {error}") from None
    return found


def _judge(
    rig: Members,
    requirement: Requirement,
    known: Mapping[str, float | None],
    signals: Mapping[str, str],
    units: Mapping[str, str],
) -> Judge:
    tree, conditions = read(requirement.formula, known)
    used, asked = _used(requirement.formula, tuple(known.items()))
    period = rig.clock.params.period * SECOND
    for low, high in asked:
        if high is not None and math.floor(high / period + 1e-9) * period < low * (1.0 - 1e-12):
            raise ScenarioError(
                f"no tick of {rig.clock.name} (each {period / SECOND:g} s) is within "
                f"[{low / SECOND:g}, {high / SECOND:g}] s"
            )
    compared = {name: units[signals[name]] for name in used if name not in conditions}
    scaled = tuple(known.items()), tuple(compared.items()), tuple(requirement.scale.items())
    tree, unit = _scaled(requirement.formula, *scaled)
    read_ = {n: signals[n] for n in {conditions[v].signal if v in conditions else v for v in used}}
    ticker = _ticker(rig)
    return Judge(tree, read_, conditions, unit, rig.clock.schedule, ticker, (*read_.values(), ticker))


# what a formula says is found once for the variants of a rig


@lru_cache(maxsize=256)
def _used(formula: str, known: Items) -> tuple[list[str], list[tuple[float, float | None]]]:
    tree, _ = read(formula, dict(known))
    return variables(tree), list(intervals(tree))


@lru_cache(maxsize=256)
def _scaled(formula: str, known: Items, units: Items, scale: Items) -> tuple[Tree, str]:
    return margin_unit(read(formula, dict(known))[0], dict(units), dict(scale))


def _ticker(rig: Members) -> str:
    """Give a signal that is sent at each tick of its node, to the end of the run."""
    ports = [(m, p) for m in rig.members for p in m.outputs if p.labels and not p.sporadic]
    _, port = max(ports, key=lambda each: (each[0].schedule.last or 0, -each[0].schedule.every))
    return f"{port.topic}/{port.labels[0]}"
