"""Figures of a rig: resolved and judged before the run, measured after it."""

from __future__ import annotations

import inspect
import json
import math
import pickle
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fnmatch import filter as filter_names
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError, create_model

from ..block.params import BlockParams, ParameterError, flatten, flattened
from ..block.port import CLOCK
from ..entry import Entry
from ..errors import ScenarioError, closest
from ..judge.claims import Claim
from ..judge.expectation import Expectation
from ..judge.expression import number, references
from ..judge.measures import (
    ROUNDING,
    UNMEASURED,
    Function,
    ImpossibleError,
    SignalMap,
    final_value,
    newest_step,
    step_levels,
)
from ..judge.registry import find
from ..judge.units import compose, factor, powers
from ..judge.words import NEVER
from ..kit.file_format import json_of
from ..kit.newest import Kept, of_these, once_for_objects
from ..rig.agreement import agreed_values, agreeing, shown
from ..rig.code import is_ours
from ..rig.members import Members, signal_units
from ..rig.noted import Noted
from ..scenario.port_text import ports_text, reader
from ..scenario.references import fill_parameters, pick
from ..scenario.scenario import FigureEntry
from ..wire.signals import Signal
from .requirements import Judge, judges
from .result import DECIDED, Result

MOST = 1e300
SIGNALS = ("signal", "reference", "final", "initial")  # arguments that name a signal, if they are a word
NONE = Expectation()
HOLDS = Expectation(at_least=0.0)  # a requirement holds if its margin is 0 or more
STEP = ("final", "initial")  # those among them that describe a step


@dataclass(frozen=True)
class Figure:
    """A figure with its function, its resolved arguments and its unit."""

    name: str
    function: Function
    arguments: Mapping[str, Any]
    unit: str
    scale: float
    since: str = ""

    @cached_property
    def reads(self) -> list[str]:
        """Names of the signals that it reads, or patterns of them."""
        texts, reads = [a for a in self.arguments.values() if isinstance(a, str)], getattr(self.function, "reads", ())
        # the machine is one of several drives in a rig, so its name is an argument, too
        return [*texts, *reads, *(f"{text}/{name}" for text in texts for name in reads), *self.since.split(", ")]

    def __call__(self, signals: SignalMap) -> float:
        """Measure the figure; raise an ImpossibleError if the result is outside the possible range."""
        # softrig's own functions use only operations that long arrays have; those of other packages may use any of
        # numpy.
        is_own = is_ours(self.function.__module__)
        value = float(self.function(signals if is_own else _InMemory(signals), **self._arguments_at(signals)))
        low, high = getattr(self.function, "possible", (-math.inf, math.inf))
        if value < low - ROUNDING * max(1.0, abs(low)) or value > high + ROUNDING * max(1.0, abs(high)):
            raise ImpossibleError(f"{value:.6g} is impossible, expected {low:g} to {high:g}")
        return self.scale * value

    def at(self, signals: SignalMap) -> Figure:
        """Return the figure for the newest step of `since`, with the values of that step among its arguments.

        Raises
        ------
        ValueError
            There was no step yet, or there is nothing to measure at it.
        """
        arguments = self._arguments_at(signals)
        return self if arguments is self.arguments else replace(self, arguments=arguments, since="")

    def _arguments_at(self, signals: SignalMap) -> Mapping[str, Any]:
        steps = any(isinstance(self.arguments.get(name), str) for name in STEP)
        if not (steps or self.since):
            return self.arguments
        args = dict(self.arguments)
        if steps:
            final, initial = step_levels(signals, args.get("final"), args.get("initial", 0.0), args.get("start"))
            args |= {"final": final, "initial": initial}
        if not self.since:
            return args
        t, value = newest_step(signals, self.since)
        values: dict[str, Any] = {"start": t + (args.get("start") or 0.0)}
        if args.get("end") is not None:
            values["end"] = t + args["end"]
        if args.get("reference") in self.since.split(", "):
            # Since that step the reference has had one value.
            values["reference"] = newest_step(signals, args["reference"])[1]
        if "final" in _model(self.function)[0].model_fields and args.get("final") is None:
            values |= {"final": value, "initial": final_value(signals, args["signal"], end=t)}
        return args | values


class _InMemory(Mapping[str, Signal]):
    """The signals of a run as whole arrays in memory; figures of other packages may use any function of numpy."""

    def __init__(self, signals: SignalMap) -> None:
        self._signals = signals

    def __getattr__(self, name: str) -> Any:
        return getattr(self._signals, name)

    def __getitem__(self, name: str) -> Signal:
        t, x = self._signals[name]
        return Signal(np.asarray(t), np.asarray(x))

    def __iter__(self) -> Iterator[str]:
        return iter(self._signals)

    def __len__(self) -> int:
        return len(self._signals)


def figures_of(rig: Members) -> list[Figure]:
    """Resolve and judge the figures of a rig's scenario.

    Raises
    ------
    ScenarioError
        Names the figure: an unknown function, argument, signal or parameter, a wrong type, a unit that does not fit.
    """
    units, agreed = signal_units(rig), agreed_values(rig.members)
    result = []
    for name, entry in rig.scenario.figures.items():
        try:
            result.append(_figure(name, entry, units, agreed, rig))
        except ScenarioError as error:
            location = rig.scenario.written("figures", name)
            raise ScenarioError(f"{rig.scenario.name}: figure {name}: {error}{location}") from None
    required = judges(rig, units, {figure.name: figure for figure in result})
    result += [_margin_of(name, judge) for name, judge in required.items()]
    return result


@once_for_objects
def _margin_of(name: str, judge: Judge) -> Figure:
    return Figure(name, judge, {}, judge.unit, 1.0)


# Runs of a study share the entries of figures.
_known = Noted[Figure]()


@once_for_objects
def _function_of(name: str, entry: FigureEntry) -> Function:
    return find(entry.function or name)


def _figure(
    name: str, entry: FigureEntry, units: Mapping[str, str], agreed: Mapping[str, tuple[str, Any]], rig: Members
) -> Figure:
    function = _function_of(name, entry)
    wanted: Mapping[str, str] = getattr(function, "agreed", {})
    declared = {quantity: agreed[quantity] for quantity in wanted.values() if quantity in agreed}

    def make(rig: Members) -> Figure:
        filled = {k: _computed(v, rig) for k, v in fill_parameters(entry.arguments, rig.parameter).items()}
        arguments = _arguments(function, agreeing(agreed, filled, wanted))
        _check_since(function, arguments, units, entry.since)
        _check_signals(function, arguments, units)
        return Figure(name, function, arguments, *_unit(function, arguments, units, entry.unit), entry.since)

    return _known(rig, (entry, function, units, rig.scenario.shared), (name, pickle.dumps(declared)), make)


def _computed(argument: Any, rig: Members) -> Any:
    """Return an argument of a figure; arithmetic over references is computed."""
    arithmetic = isinstance(argument, str) and bool(references(argument)) and any(c in argument for c in " *+")
    return number(argument, rig.reference) if arithmetic else argument


def _unit(
    function: Function, arguments: Mapping[str, Any], units: Mapping[str, str], wanted: str | None
) -> tuple[str, float]:
    """Return the unit of a figure, and the factor from the function's result to this unit."""
    declared: str | None = getattr(function, "unit", None)
    if declared is None:
        return wanted or "", 1.0
    signal = units.get(str(arguments.get("signal")), "")
    unit = compose(declared, signal)
    if wanted is None or (declared == "{signal}" and not signal):  # a port that does not know its unit
        return wanted or unit, 1.0
    scale = factor(unit, wanted)
    if scale is None:
        raise ScenarioError(f"unit {wanted!r}, but {function.__name__} gives {unit or 'a pure number'!r}")
    return wanted, scale


def read_by(figures: Iterable[Figure], units: Mapping[str, str]) -> set[str]:
    """Return the signals that figures and requirements read; `units` has all of the rig (`signal_units`)."""
    figures = list(figures)
    return of_these(
        _read, (units, *figures), lambda: {s for f in figures for name in f.reads for s in _called(name, units)}
    )


_read: Kept[set[str]] = {}


def _called(name: str, units: Mapping[str, str]) -> Iterable[str]:
    """Return the signals that match a name, which may be a pattern."""
    return (name,) if name in units else _matching(name, tuple(units))


@lru_cache(maxsize=1024)
def _matching(name: str, signals: tuple[str, ...]) -> list[str]:
    return filter_names(signals, name)


def figure_parameters(rig: Members) -> dict[str, str]:
    """Write the figures of a rig's scenario, and the topics that they are on, as parameters of the node `figures`.

    Requirements have nodes of their own.
    """
    names, units = rig.scenario.figures, signal_units(rig)
    figures = [f for f in figures_of(rig) if f.name in names]
    read = read_by(figures, units)
    messages = {p.topic for m in rig.members for p in m.outputs}
    ports = [
        reader(p, f"input_{k}", held=topic not in messages)
        for k, (topic, p) in enumerate(rig.topics.items())
        if topic != CLOCK.topic and any(f"{topic}/{label}" in read for label in p.labels)
    ]
    written = [asdict(f) | {"function": names[f.name].function or f.name} for f in figures]
    return {"figures": json.dumps(written), "ports": ports_text(ports)}


def figures_in(text: str) -> list[Figure]:
    """Read the figures that `figure_parameters` has encoded.

    Raises
    ------
    ValueError
        The text is not JSON or does not describe figures; the message states what was expected.
    """
    try:
        return [Figure(**about | {"function": find(about["function"])}) for about in json_of(text)]
    except (TypeError, KeyError, ValueError, ScenarioError) as error:
        raise ValueError(f"figures: {error}; expected a JSON list of name, function, arguments, unit, scale") from None


def evaluate(
    rig: Members, signals: SignalMap, figures: Sequence[Figure] | None = None, *, under_way: bool = False
) -> list[Result]:
    """Measure the figures of a rig's scenario and judge them.

    A figure that cannot be computed has the value None and the reason; it passes only if it has no expectation.

    Parameters
    ----------
    rig : Rig
        Its scenario defines the figures and the expectations.
    signals : Signals
        Of a run of this rig.
    figures : sequence of Figure, optional
        Result of `figures_of` for the rig, if it is known already.
    under_way : bool
        Whether the run continues: `Result.settled` is then set.
    """
    scenario, results = rig.scenario, []
    for figure in figures_of(rig) if figures is None else figures:
        required = figure.name in scenario.requirements
        limits = scenario.expect.get(figure.name, HOLDS if required else None)
        judge = figure.function if isinstance(figure.function, Judge) else None
        about: dict[str, Any] = {"settled": under_way and judge is not None and judge.settled(signals)}
        impossible = False
        try:
            if judge is not None:
                value, t, violated, bounds, open_from = judge.margin(signals)
                about |= {"at_s": t, "violated_s": violated}
                about |= {"open_from_s": open_from} if math.isfinite(open_from) else {}
            else:
                value = figure(signals)
                bounds = value, value
            error = ""
            if not math.isfinite(value):
                decided = f"{'holds' if value > 0 else 'violated'} {DECIDED}"
                error = decided if required else NEVER if value == math.inf else f"the result is {value}"
        except UNMEASURED as broken:
            value, error, bounds = math.nan, str(broken) or type(broken).__name__, (math.nan, math.nan)
            impossible = isinstance(broken, ImpossibleError)
        # A requirement that conditions alone decide has an infinite margin, but `Expectation.holds` refuses infinity.
        sure = (math.copysign(MOST, x) if required and math.isinf(x) else x for x in bounds)
        passed = limits is None or all(limits.holds(x) for x in sure)
        passed = passed and not impossible
        # Numbers and truths of numpy have no JSON.
        value = float(value)
        about |= {"value": None if error else value, "number": value, "passed": bool(passed), "error": error}
        results.append(_unmeasured(figure, limits, scenario.claims).having(**about))
    return results


@once_for_objects
def _unmeasured(figure: Figure, limits: Expectation | None, claims: Mapping[str, Claim]) -> Result:
    """Return a result with what is known before the run."""
    published = {c.figure or key: c.published for key, c in claims.items() if c.published is not None}
    return Result(
        name=figure.name,
        value=None,
        unit=figure.unit,
        published=published.get(figure.name),
        passed=True,
        follows=follows(figure, limits),
        **{key: getattr(limits or NONE, key) for key in ("expected", "tolerance", "at_most", "at_least")},
    )


def follows(figure: Figure, limits: Expectation | None) -> bool:
    """Return whether the expectation of a figure applies to a changed machine, too."""
    if isinstance(figure.function, Judge):
        return figure.function.follows
    return bool(limits and limits.follows) or bool(getattr(figure.function, "follows", False))


def changed_from(rig: Members) -> str:
    """Describe the original values of a machine that overrides have changed: ``motor.J = 0.01``; empty if none."""
    params = {m.name: m.params for m in rig.members}
    parts = []
    for key, before in rig.scenario.changed_from.items():
        node, _, name = key.partition(".")
        # The parameter may have no default, or belong to a node that is not in this rig; then only its name is written.
        with suppress(ParameterError, ValueError, KeyError):
            before = pick(_defaults(type(params[node])), name) if before is None else before
            if before == pick(flattened(params[node]), name):
                continue
        parts.append(key if before is None else f"{key} = {shown(before)}")
    return ", ".join(parts)


@cache
def _defaults(kind: type[BlockParams]) -> Mapping[str, Any]:
    return flatten(kind())


@cache
def _model(function: Function) -> tuple[type[BaseModel], bool]:
    """Validate the keyword arguments of a function by its annotations."""
    try:
        hints = typing.get_type_hints(function)
    # Annotations may name what only type checkers import; such arguments are not checked.
    except (NameError, TypeError):
        hints = {}
    fields: dict[str, Any] = {}
    _, *parameters = inspect.signature(function).parameters.values()
    for p in parameters:
        if p.kind is not p.VAR_KEYWORD:
            fields[p.name] = (hints.get(p.name, Any), ... if p.default is p.empty else p.default)
    return create_model(function.__name__, __base__=Entry, **fields), len(fields) == len(parameters)


def _arguments(function: Function, values: Mapping[str, Any]) -> dict[str, Any]:
    model, closed = _model(function)
    # A function with ``**keywords`` takes arguments of any name, so there is nothing to check them against.
    if not closed:
        return dict(values)
    try:
        checked = model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            raise ScenarioError(f"unknown argument {name}; it takes {', '.join(model.model_fields)}") from None
        if first["type"] == "missing":
            raise ScenarioError(f"argument {name} is missing") from None
        raise ScenarioError(f"argument {name} = {first['input']!r}: {first['msg']}") from None
    return {name: getattr(checked, name) for name in model.model_fields if name in checked.model_fields_set}


def _check_signals(function: Function, arguments: Mapping[str, Any], units: Mapping[str, str]) -> None:
    named = {k: v for k, v in arguments.items() if isinstance(v, str) and (k in SIGNALS or "/" in v)}
    for name in (*named.values(), *getattr(function, "reads", ())):
        if not _called(name, units):
            raise ScenarioError(f"no signal {name!r}{closest(name, units)}; the rig has {', '.join(units)}")
    first, *further = [(k, units[arguments[k]]) for k in SIGNALS if isinstance(arguments.get(k), str)] or [("", "")]
    for name, unit in further:
        if powers(first[1]) != powers(unit):
            raise ScenarioError(f"signal in {first[1]!r}, but its {name} in {unit!r}")


def _check_since(function: Function, arguments: Mapping[str, Any], units: Mapping[str, str], since: str) -> None:
    if not since:
        return
    names = since.split(", ")
    for name in names:
        if name not in units:
            raise ScenarioError(f"since: no signal {name!r}{closest(name, units)}; the rig has {', '.join(units)}")
    takes = _model(function)[0].model_fields
    if "start" not in takes:
        raise ScenarioError(f"since: {function.__name__} has no start, since it covers a whole run")
    if "final" in takes and arguments.get("final") is None:
        unit, signal_unit = units[names[0]], units.get(arguments["signal"], units[names[0]])
        if names[1:] or "initial" in arguments or powers(unit) != powers(signal_unit):
            why = "initial" if "initial" in arguments else f"a signal in {signal_unit!r} and a reference in {unit!r}"
            why = "several signals" if names[1:] else why
            raise ScenarioError(f"since: with {why} the final value must be given, too")
