"""Requirements of a scenario: formulas of signal temporal logic over its shared names, measured like any figure.

A requirement is a figure whose value is its margin (robustness), which is expected to be at least zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..block.schedule import Schedule
from ..errors import ScenarioError
from ..judge.arithmetic import Tree
from ..judge.expression import references
from ..judge.formula import (
    Condition,
    Outline,
    margin_unit,
    named,
    outline,
    timing,
    variables,
    with_names,
)
from ..judge.measures import UNMEASURED, Places, SignalMap, newest, places, shared
from ..judge.one_pass import OnePass
from ..judge.requirement_entry import Requirement
from ..judge.robustness import Margin, Record, decided, truth
from ..rig.members import Members
from ..rig.noted import Noted
from ..scenario.port_text import ports_text, reader
from ..scenario.references import fill_parameters
from ..timebase import SECOND
from ..wire.long import LongArray, gathered, is_long
from ..wire.signals import full_name
from ..wire.times import common, once_for_times

Items = tuple[tuple[str, Any], ...]
Results = Mapping[str, tuple[Array, Array]]
# So many sets of times are kept of a formula: a study has one for all its runs, unless they end at different times.
READY = 4


class Measured(Protocol):
    """Protocol of a figure that a formula refers to."""

    @property
    def unit(self) -> str:
        """Unit of its value."""

    @property
    def reads(self) -> list[str]:
        """Names of the signals that it reads, or patterns of them."""

    def __call__(self, signals: SignalMap) -> float:
        """Measure."""


class _Ready(NamedTuple):
    """What a margin is computed of while only the values of signals differ from run to run, not their times."""

    objects: tuple[Any, ...]
    grid: Array
    at: Mapping[str, Places]
    window: tuple[int, int]


@dataclass(frozen=True)
class Judge:
    """A requirement bound to a rig: the parsed formula, its signals, and the unit of its margin.

    Called with signals it returns the margin, like a figure function. `ticker` is a signal that lasts to the end of a
    run. `figures` are those whose value the formula uses. `timed` are the figures from which its times are counted;
    `again` parses the formula with their values. `numbers` are those that the tree names; `native` has the formula's
    instructions. `follows` means that no bound of the formula is a fixed number.
    """

    tree: Tree
    signals: Mapping[str, str]
    conditions: Mapping[str, Condition]
    unit: str
    clock: Schedule
    ticker: str
    reads: tuple[str, ...] = ()
    figures: Mapping[str, Measured] = field(default_factory=dict)
    timed: Mapping[str, Measured] = field(default_factory=dict)
    follows: bool = False
    again: Callable[[Mapping[str, float]], Tree] | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    native: OnePass | None = None

    def __call__(self, signals: SignalMap) -> float:
        """Compute the margin; raise a ValueError with the reason if it cannot be judged."""
        return self.margin(signals).value

    def settled(self, signals: SignalMap) -> bool:
        """Return whether the verdict on a running run can no longer change."""
        # Figures change with each new message, so nothing is settled before the end.
        if self.figures or self.timed:
            return False
        try:
            self.margin(signals, ended=False)
        except ValueError:
            return False
        return True

    def margin(self, signals: SignalMap, *, ended: bool = True) -> Margin:
        """Measure the margin, and find where it is least and where the formula is violated.

        Parameters
        ----------
        signals : mapping of str to Signal
        ended : bool
            Whether nothing will come after the record.

        Raises
        ------
        ValueError
            Not judged: the record does not decide the formula, or its arithmetic is undefined.
        """
        results = {name: signals[signal] for name, signal in self.signals.items()}
        ticks, _ = signals[self.ticker]
        if not len(ticks):
            raise ValueError(f"not judged: nothing was recorded of {self.ticker}")
        plain = self.native if ended and not (self.figures or self.conditions or self.timed) else None
        if plain is not None and (result := self._quickly(plain, signals, results, ticks)) is not None:
            return result
        grid = _grid(self.clock, ticks)
        samples: dict[str, Any] = {**self.numbers}
        truths, late = {}, dict[str, NDArray[np.bool_]]()
        tree = self.tree
        if self.again is not None:
            tree = self.again({name: _measured(name, figure, signals) for name, figure in self.timed.items()})
        for name in variables(tree):
            if name in self.figures:
                samples[name] = np.broadcast_to(_measured(name, self.figures[name], signals), len(grid))
                continue
            condition = self.conditions.get(name)
            times, values = results[condition.signal if condition else name]
            now, none = _newest(_whole_ns(times), values, grid)
            if condition:
                truths[name] = truth(condition, now, np.concatenate((now[:1], now[:-1])))
            else:
                samples[name] = now
                if none is not None:
                    late[name] = none
        after = self.clock.next(int(grid[-1]))
        # With measured times the formula is another one, which has no instructions.
        native = self.native if tree is self.tree else None
        record = Record(grid, samples, truths=truths, late=late, after=after, ended=ended)
        if plain is not None and not (late or is_long(grid)) and (window := record.window(tree)) is not None:
            at = {name: _arrived(_whole_ns(results[name][0]), grid)[0] for name in plain.names}
            objects = self._times(plain, results, ticks)
            if len(plain.ready) >= READY:
                plain.ready.clear()
            # The objects are stored too: while they live, no others can have their identity.
            plain.ready[tuple(map(id, objects))] = _Ready(objects, grid, at, window)
        return record.margin(tree, native)

    def _times(self, native: OnePass, results: Results, ticks: Array) -> tuple[Any, ...]:
        """Return the objects that decide the window of the formula and which sample is valid when."""
        return self.clock, ticks, *(results[name][0] for name in native.names)

    def _quickly(self, native: OnePass, signals: SignalMap, results: Results, ticks: Array) -> Margin | None:
        """Return the margin in one pass if an earlier run had the same times; None where that is not enough."""
        known: _Ready | None = native.ready.get(tuple(map(id, self._times(native, results, ticks))))
        if known is None:
            return None
        values = {name: _held(signals, self.signals[name], results[name][1], at) for name, at in known.at.items()}
        extreme = native(values, self.constants, *known.window)
        return None if extreme is None else decided(extreme, known.grid)

    @cached_property
    def constants(self) -> Array:
        """The constants of the formula's instructions."""
        assert self.native is not None
        return self.native.constants(self.numbers)


def _held(signals: SignalMap, signal: str, values: Array, at: Places) -> Array:
    """Return the values at some places; several requirements often compare with one reference."""
    if isinstance(at, slice):
        return values[at]
    # The places are kept with the result: while they live, no others can have their identity.
    return shared(signals, ("held", signal, id(at)), lambda: (values[at], at))[0]


def _measured(name: str, figure: Measured, signals: SignalMap) -> float:
    try:
        value = figure(signals)
    except UNMEASURED as error:
        raise ValueError(f"not judged: the figure {name} of its formula: {error}") from None
    if not math.isfinite(value):
        never = "never happens" if value == math.inf else f"is {value}"
        raise ValueError(f"not judged: the figure {name} of its formula {never}")
    return value


def _grid(clock: Schedule, ticks: Array) -> Array:
    """Ticks of the clock up to the record's end, ns."""
    last = clock.tick(clock.held(round(float(ticks[-1]) * SECOND)))
    if is_long(ticks):
        return cast(Array, LongArray(last + 1, lambda a, b: clock.times(a, b).astype(np.float64)))
    return _ticks(clock, last)


@lru_cache(maxsize=8)
def _ticks(clock: Schedule, last: int) -> Array:
    return common(clock.times(0, last + 1).astype(np.float64))


@once_for_times
def _whole_ns(times: Array) -> Array:
    return np.rint(times * SECOND)


def _newest(times: Array, values: Array, grid: Array) -> tuple[Array, NDArray[np.bool_] | None]:
    """Return for each tick the newest value that has arrived, 0 before the first, and its index."""
    indices, before = _arrived(times, grid)
    if before is None:
        return gathered(values, indices), None
    if not len(values):
        return np.broadcast_to(0.0, len(grid)), before
    # The 0 is not compared with anything, because comparisons with a late signal are false.
    return np.where(before, 0.0, gathered(values, np.maximum(indices, 0))), before


@once_for_times
def _arrived(times: Array, grid: Array) -> tuple[Places, NDArray[np.bool_] | None]:
    """Return the index of the newest of some times at each tick, and the ticks before the first one."""
    if len(times) >= len(grid) and np.array_equal(times[: len(grid)], grid):  # one a tick
        return slice(0, len(grid)), None
    indices = newest(times, grid)
    before = indices < 0
    return (indices, before) if before.any() else (places(indices), None)


def names_of(rig: Members, units: Mapping[str, str]) -> tuple[dict[str, float], dict[str, str]]:
    """Return the shared names of a rig's scenario that formulas may use: numbers, and signals.

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
    """Return the nodes that watch requirements of a rig's scenario while it runs, as entries of its nodes."""
    names = names_of(rig, units)
    nodes = {}
    for name, requirement in rig.scenario.requirements.items():
        if not (requirement.live or requirement.ends):
            continue
        # A figure is a number of the whole run, so a requirement that is watched while the rig runs must not name one.
        judge = _named(name, rig, requirement, names, units, {})
        constants = _of_nodes(rig, requirement) | names[0]
        topics = {t: p for t, p in rig.topics.items() if any(s.startswith(f"{t}/") for s in judge.signals.values())}
        ports = ports_text([reader(p, f"input_{k}") for k, p in enumerate(topics.values())])
        nodes[f"requirement_{name}"] = {
            "package": "softrig_control",
            "executable": "requirement_monitor",
            "parameters": {
                "period": rig.clock.params.period,
                "formula": with_names(requirement.formula),
                "ports": ports,
                "names": list(judge.signals),
                "signals": list(judge.signals.values()),
                "constants": list(constants),
                "values": list(constants.values()),
                "scale_units": list(requirement.scale),
                "scale_values": list(requirement.scale.values()),
                "topic": f"requirement/{name}",
                "ends": requirement.ends,
            },
        }
    return nodes


def judges(rig: Members, units: Mapping[str, str], figures: Mapping[str, Measured]) -> dict[str, Judge]:
    """Read the requirements of a rig's scenario.

    Parameters
    ----------
    units : mapping
        Of each signal of the rig.
    figures : mapping
        Of the scenario, by name: a formula may name them.

    Raises
    ------
    ScenarioError
        Names the requirement: a formula that does not parse, an unknown name, units that do not fit, an interval
        without a tick in it.
    """
    if not rig.scenario.requirements:
        return {}
    names = _known_names(rig, (rig.scenario.shared, units), (), lambda rig: names_of(rig, units))
    return {
        name: _named(name, rig, requirement, names, units, figures)
        for name, requirement in rig.scenario.requirements.items()
    }


# Runs of a study share the shared values and the requirements.
_known_names = Noted[tuple[dict[str, float], dict[str, str]]]()
_known = Noted[Judge]()


def _named(
    name: str,
    rig: Members,
    requirement: Requirement,
    names: tuple[dict[str, float], dict[str, str]],
    units: Mapping[str, str],
    figures: Mapping[str, Measured],
) -> Judge:
    """Read a requirement; errors name it."""
    objects = requirement, names, units, *figures.values(), *(m.schedule for m in rig.members)
    try:
        return _known(
            rig, objects, rig.clock.params.period, lambda rig: _judge(rig, requirement, *names, units, figures)
        )
    except ScenarioError as error:
        location = rig.scenario.written("requirements", name)
        raise ScenarioError(f"{rig.scenario.name}: requirement {name}: {error}{location}") from None


def _of_nodes(rig: Members, requirement: Requirement) -> dict[str, float]:
    """Return the values of a formula's references, by their names in the formula."""
    result = {}
    for reference in references(requirement.formula):
        node, _, parameter = reference.partition(".")
        if parameter:
            value = rig.parameter(node, parameter)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ScenarioError(f"${reference} is {value!r}, expected a number")
            result[named(reference)] = float(value)
    return result


def _judge(
    rig: Members,
    requirement: Requirement,
    numbers: Mapping[str, float],
    signals: Mapping[str, str],
    units: Mapping[str, str],
    figures: Mapping[str, Measured],
) -> Judge:
    formula = with_names(requirement.formula)
    usable = {name: figure for name, figure in figures.items() if name not in signals and name not in numbers}
    known: dict[str, float | None] = {**dict.fromkeys(usable), **_of_nodes(rig, requirement), **numbers}
    known |= dict.fromkeys(signals)
    timed = {name: usable[name] for name in timing(formula) if name in usable}
    if strange := [name for name, figure in timed.items() if figure.unit != "s"]:
        raise ScenarioError(f"{strange[0]} in an interval is in {usable[strange[0]].unit!r}, expected s")
    # Times that figures give are known only after the run; 0 stands for them until then (`Judge.again`).
    known |= dict.fromkeys(timed, 0.0)
    result = outline(formula, known)
    used, conditions = result.variables, result.conditions
    period = rig.clock.params.period * SECOND
    for low, high in result.intervals:
        # The two small numbers keep rounding from hiding a tick exactly at an end of the window.
        if high is not None and math.floor(high / period + 1e-9) * period < low * (1.0 - 1e-12):
            raise ScenarioError(
                f"no tick of {rig.clock.name} (each {period / SECOND:g} s) is within "
                f"[{low / SECOND:g}, {high / SECOND:g}] s"
            )
    measured = {name: usable[name] for name in used if name in usable and name not in timed}
    if lost := [name for name, condition in conditions.items() if condition.signal in usable and name in used]:
        raise ScenarioError(f"{conditions[lost[0]].signal} is a figure, a number of the whole run: compare it")
    compared = {
        name: usable[name].unit if name in usable else units[signals[name]] for name in used if name not in conditions
    }
    scaled = tuple(compared.items()), tuple(requirement.scale.items())
    tree, unit, native = _scaled(result, *scaled)
    read_ = {n: signals[n] for n in {conditions[v].signal if v in conditions else v for v in used} if n not in usable}
    ticker = _ticker(rig)
    read_too = [signal for figure in (*measured.values(), *timed.values()) for signal in figure.reads]
    return Judge(
        tree,
        read_,
        conditions,
        unit,
        rig.clock.schedule,
        ticker,
        (*read_.values(), *read_too, ticker),
        measured,
        timed,
        not _has_bounds(result, scaled[0]),
        partial(_at, formula, known, scaled) if timed else None,
        {name: value for name in result.numbers if (value := known[name]) is not None},
        native,
    )


def _at(
    formula: str, known: Mapping[str, float | None], scaled: tuple[Items, Items], values: Mapping[str, float]
) -> Tree:
    return _scaled(outline(formula, {**known, **values}), *scaled)[0]


# An outline is the same object for the variants of a rig, so that what follows from it is found once for all of them.


@lru_cache(maxsize=256)
def _has_bounds(shape: Outline, units: Items) -> bool:
    return shape.has_bounds(dict(units))


@lru_cache(maxsize=256)
def _scaled(shape: Outline, units: Items, scale: Items) -> tuple[Tree, str, OnePass | None]:
    tree, unit = margin_unit(shape.tree, dict(units), dict(scale))
    try:
        return tree, unit, OnePass(tree)
    except LookupError:
        return tree, unit, None


def _ticker(rig: Members) -> str:
    """Return a signal with a sample at each tick of its node, up to the end of the run."""
    ports = [(m, p) for m in rig.members for p in m.outputs if p.labels and not p.sporadic]
    _, port = max(ports, key=lambda each: (each[0].schedule.last or 0, -each[0].schedule.every))
    return f"{port.topic}/{port.labels[0]}"
