"""A requirement watched during the run: its margin as far as it is known, and the end of a run that violates it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_core import Block, BlockParams, Level, Port, RunError, Sample, ScenarioError, Values, param, scalars
from softrig_core.judge.formula import margin_unit, read, variables
from softrig_core.judge.live import Live, Opened
from softrig_core.judge.robustness import truth
from softrig_core.scenario.port_text import ports_of

ENDLESS = 1e12  # published for a margin without a known bound, since a message must not contain infinity


class RequirementMonitorParams(BlockParams):
    """The formula, the meaning of its names, and the topics of its signals."""

    formula: str = param("always x <= 1", "in signal temporal logic, over the names below", min_length=1)
    ports: str = param(
        '[{"name": "state", "topic": "state", "msgtype": "sensor_msgs/msg/JointState", "channels": ["x"],'
        ' "fields": ["position"], "units": ["m"]}]',
        "the topics, each as a port, in JSON",
    )
    names: tuple[str, ...] = param(("x",), "names of signals in the formula")
    signals: tuple[str, ...] = param(("state/x/position",), "the signal of each: topic/channel/field")
    constants: tuple[str, ...] = param((), "names of numbers in the formula")
    values: tuple[float, ...] = param((), "their values")
    scale_units: tuple[str, ...] = param((), "units of a formula that compares several")
    scale_values: tuple[float, ...] = param((), "what counts as one in each")
    topic: str = param("requirement", "topic of the margin", min_length=1)
    ends: bool = param(False, "end the run when the requirement is violated")

    def _check(self) -> None:
        for first, second in (("names", "signals"), ("constants", "values"), ("scale_units", "scale_values")):
            if len(getattr(self, first)) != len(getattr(self, second)):
                raise ValueError(f"{len(getattr(self, first))} {first}, but {len(getattr(self, second))} {second}")
        known = {f"{p.topic}/{label}" for p in self.inputs() for label in p.labels}
        for signal in self.signals:
            if signal not in known:
                raise ValueError(f"signal {signal!r} is on none of the ports; they have {', '.join(sorted(known))}")
        try:
            self.read()
        except ScenarioError as error:
            raise ValueError(str(error)) from None

    def inputs(self) -> tuple[Port, ...]:
        """Return the ports that the text describes."""
        return ports_of(self.ports)

    def read(self) -> tuple[Any, Mapping[str, Any], str]:
        """Return the formula, its conditions and the unit of its margin.

        Raises
        ------
        ScenarioError
            It cannot be read, or its units do not fit.
        """
        known: dict[str, float | None] = dict(zip(self.constants, self.values, strict=True))
        tree, conditions = read(self.formula, known | dict.fromkeys(self.names))
        units = {f"{p.topic}/{label}": u for p in self.inputs() for label, u in zip(p.labels, p.units, strict=True)}
        signals = dict(zip(self.names, self.signals, strict=True))
        compared = {n: units[signals[n]] for n in variables(tree) if n not in conditions}
        tree, unit = margin_unit(tree, compared, dict(zip(self.scale_units, self.scale_values, strict=True)))
        return tree, conditions, unit


class State(NamedTuple):
    """Undecided part of the formula, values of its conditions at the previous tick, bounds of the decided margin."""

    opened: tuple[Opened, ...]
    before: tuple[float | None, ...]
    lower: float = -ENDLESS
    upper: float = ENDLESS
    decided: bool = False


class RequirementMonitor(Block[RequirementMonitorParams]):
    """Publishes bounds on the margin of a requirement at each tick, valid for any continuation of the run.

    The upper bound decreases during the run: once it is below zero the requirement is finally violated. `decided` is 1
    once no later message can change it. Signals are held; comparisons with a signal that has not arrived yet are false.
    """

    @classmethod
    def ports(cls, params: RequirementMonitorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return the topics of the formula's signals, and the margin."""
        unit = params.read()[2]
        bounds = {"lower": unit, "upper": unit, "decided": ""}
        return params.inputs(), (scalars("margin", params.topic, bounds, limits=(ENDLESS,) * 3),)

    def setup(self) -> None:
        """Read the formula and find its signals."""
        self._tree, self._conditions, self._unit = self.p.read()
        known = {f"{p.topic}/{label}": (p.name, k) for p in self.p.inputs() for k, label in enumerate(p.labels)}
        signals = dict(zip(self.p.names, self.p.signals, strict=True))
        self._places = {name: known[signal] for name, signal in signals.items()}
        self._used = variables(self._tree)

        self._live = Live(self._tree)

    def first(self) -> State:
        """Return the initial state without samples."""
        return State(self._live.first(), (None,) * len(self._used))

    def update(self, x: State, t: int, **inputs: Any) -> tuple[State, Values]:
        """Process the signals of this tick."""
        signals: dict[str, float] = {}
        truths: dict[str, float] = {}
        late: dict[str, bool] = {}
        now: list[float | None] = []
        for name, last in zip(self._used, x.before, strict=True):
            condition = self._conditions.get(name)
            port, k = self._places[condition.signal if condition else name]
            arrived = self.age(port) is not None
            message = inputs[port]
            value = (message.data if isinstance(message, Sample) else message)[k] if arrived else 0.0
            if condition is None:
                signals[name], late[name] = value, not arrived
                now.append(None)
                continue
            truths[name] = float(truth(condition, value, value if last is None else last))
            now.append(value)
        return self._pushed(x._replace(before=tuple(now)), t, signals, truths, late)

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Treat a tick with an invalid signal as one without information."""
        nothing = dict.fromkeys((n for n in self._used if n not in self._conditions), math.nan)
        return self._pushed(x, t, nothing, dict.fromkeys(self._conditions, math.nan), dict.fromkeys(nothing, False))

    def _pushed(
        self, x: State, t: int, signals: Mapping[str, float], truths: Mapping[str, float], late: Mapping[str, bool]
    ) -> tuple[State, Values]:
        opened, before, lower, upper, decided = x
        if not decided:
            violated = upper < 0.0
            opened = self._live.push(opened, float(t), signals, truths, late)
            lower, upper = self._live.bounds(opened)
            decided = self._live.decided(opened)
            if upper < 0.0 and not violated:
                self._report_violation(t, upper)
        outputs = (max(-ENDLESS, min(ENDLESS, lower)), max(-ENDLESS, min(ENDLESS, upper)), float(decided))
        return State(opened, before, lower, upper, decided), {"margin": outputs}

    def _report_violation(self, t: int, margin: float) -> None:
        """Report that the requirement is violated, or end the run with that."""
        least = f"{margin:.6g} {self._unit}".rstrip()
        text = f"{self.p.formula} is violated, its margin is at most {least}, known at t = {t / 1e9:.9g} s"
        if self.p.ends:
            raise RunError(f"{self.name}: {text}")
        self.report(Level.ERROR, "violated", text)
