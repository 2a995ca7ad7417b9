"""Search space: parameters, numbers of faults, and profiles added to signals, as one unit cube."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from softrig_core import Rig, Scenario, ScenarioError, rig_of
from softrig_core.block.params import flatten
from softrig_core.errors import closest
from softrig_core.rig.members import signal_units
from softrig_core.scenario.references import pick
from softrig_core.wire.signals import topic_of

from ..options.grammar import FORMS, Span, span


@dataclass(frozen=True)
class Over(Span):
    """One parameter, fault or profile that the search may change, and its range.

    Parameters
    ----------
    key : str
        ``node.parameter``, ``fault.parameter``, or the name of a signal.
    adds : bool
        Of a profile on a signal: added to what is sent instead of replacing it.
    """

    key: str = ""
    adds: bool = False

    @property
    def on_signal(self) -> bool:
        """Return whether it is a profile on a signal."""
        return "/" in self.key

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return max(1, self.count)

    def value(self, u: float) -> float:
        """Turn a number from 0 to 1 into one of the range; both ends are met exactly."""
        # The ends are returned as they are, because the formulas below would round them.
        if u <= 0.0 or u >= 1.0:
            return self.low if u <= 0.0 else self.high
        if self.log:
            return self.low * (self.high / self.low) ** u
        return self.low + (self.high - self.low) * u

    def place(self, value: float) -> float:
        """Return the number from 0 to 1 that maps to a value of the range."""
        if self.low == self.high:
            return 0.0
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


def parse(key: str, text: str) -> Over:
    """Read one range; a key that ends with ``+`` adds to its signal.

    Raises
    ------
    ScenarioError
        Another form, a range upside down, a logarithm of what is not above 0.
    """
    key = key.strip()
    adds, key = key.endswith("+"), key.removesuffix("+").strip()
    over = Over(**asdict(span(key, text)), key=key, adds=adds)
    if over.on_signal and not over.count:
        raise ScenarioError(f"{key}={text}: a signal needs a profile, such as {over.low:g}..{over.high:g}*6")
    if adds and not over.on_signal:
        raise ScenarioError(f"{key}+={text}: only signals can be added to")
    return over


@dataclass(frozen=True)
class Space:
    """A scenario and the values in it that may be changed.

    Parameters
    ----------
    scenario : Scenario
        With a fault for each profile.
    targets : tuple of str
        Of each: the parameter that is set, ``node.parameter``.
    nominal : tuple
        Of each: its value in the scenario as it is; None for profiles.
    integral : tuple of bool
        For each: whether it accepts integers only.
    """

    scenario: Scenario
    overs: tuple[Over, ...]
    targets: tuple[str, ...]
    nominal: tuple[Any, ...]
    integral: tuple[bool, ...]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(over.size for over in self.overs)

    def names(self) -> list[str]:
        """Name of each coordinate."""
        return [f"{o.key}.{i}" if o.count else o.key for o in self.overs for i in range(o.size)]

    def overrides(self, point: Sequence[float]) -> dict[str, Any]:
        """Return the changes of a point of the unit cube."""
        result: dict[str, Any] = {}
        first = 0
        for over, target, integral in zip(self.overs, self.targets, self.integral, strict=True):
            values = [over.value(u) for u in point[first : first + over.size]]
            values = [round(v) for v in values] if integral else values
            first += over.size
            result[target] = values if over.count else values[0]
        return result


def space_of(scenario: Scenario, overs: Sequence[Over]) -> Space:
    """Hold ranges against a rig, and put a fault on each link whose signal gets a profile.

    Raises
    ------
    ScenarioError
        No such parameter or signal, with the nearest name; a parameter that is no number, or a list of another length.
    """
    rig = rig_of(scenario)
    params = {m.name: flatten(m.params) for m in rig.members}
    faults = {n: e.model_dump() for n, e in scenario.faults.items()}
    targets: list[str] = []
    nominal: list[Any] = []
    integral: list[bool] = []
    for k, over in enumerate(overs):
        if any(over.key == earlier.key for earlier in overs[:k]):
            raise ScenarioError(f"{over.key} is given twice")
        if over.on_signal:
            name = f"profile_{k}"
            faults[name] = _profile(rig, over)
            targets.append(f"{name}.points")
            nominal.append(None)
            integral.append(False)
            continue
        value = _parameter(params, over.key)
        targets.append(over.key)
        nominal.append(value)
        first = value[0] if isinstance(value, list) and value else value
        integral.append(isinstance(first, int))
        number = isinstance(first, int | float) and not isinstance(first, bool)
        if isinstance(value, list) != bool(over.count) or not (number or value == []):
            kind = f"a list of {len(value)}" if isinstance(value, list) else f"{value!r}"
            raise ScenarioError(f"{over.key} is {kind}: {'a number is searched' if not over.count else FORMS}")
    changed = scenario.having(faults=faults)
    space = Space(changed, tuple(overs), tuple(targets), tuple(nominal), tuple(integral))
    # A block that refuses an end of a range does so now, with the bounds of the parameter, not in the middle of a
    # search.
    for corner in (0.0, 0.5, 1.0):
        rig_of(changed.changed(overrides=space.overrides([corner] * space.size)))
    return space


def _parameter(params: Mapping[str, Mapping[str, Any]], key: str) -> Any:
    node, _, name = key.partition(".")
    if node not in params or not name:
        if meant := [f"{member}.{name or key}" for member, has in params.items() if (name or key) in has]:
            raise ScenarioError(f"{key}: expected node.parameter; did you mean {' or '.join(meant)}?")
        raise ScenarioError(
            f"{key!r}{closest(node, params)}: expected node.parameter, with node one of "
            f"{', '.join(params)}, or a signal topic/channel/field"
        )
    try:
        return pick(params[node], name)
    except KeyError:
        raise ScenarioError(
            f"{key!r}: {node} has no parameter {name!r}{closest(name, params[node])}; it has {', '.join(params[node])}"
        ) from None


def _profile(rig: Rig, over: Over) -> dict[str, Any]:
    """Create the fault that lays a profile on a signal."""
    known = signal_units(rig)
    if over.key not in known:
        raise ScenarioError(f"no signal {over.key!r}{closest(over.key, known)}; the rig has {', '.join(known)}")
    topic = topic_of(over.key, rig.topics)
    middle = (over.low + over.high) / 2.0
    return {
        "link": topic,
        "kind": "add" if over.adds else "replace",
        "affects": [over.key[len(topic) + 1 :]],
        "points": [middle] * over.count,
        "span": rig.scenario.duration,
        "linear": over.linear,
    }
