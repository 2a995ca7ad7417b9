"""Which channel of which topic is which variable of an FMU."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from softrig_core import Port

from ..channels import FIELDS, port_of
from .description import Description, Variable, conversion, number_in

_ENTRY = re.compile(
    r"(?P<topic>\S+)/(?P<channel>[^\s/\[]+)/(?P<field>[a-z]+)\s*(\[(?P<unit>[^\]]*)\])?\s*=\s*(?P<name>\S.*)"
)


# An array's size is read before the FMU runs, so the parameter that sets it must not change.
UNSET = ("independent", "calculatedParameter", "structuralParameter")


class Place(NamedTuple):
    """A variable and the position of its value in a port; scale and offset convert the FMU's value to the port's."""

    variable: Variable
    port: int
    at: int
    scale: float
    offset: float

    def out(self, x: float) -> float:
        """Return the port's value of the FMU's; the same bits where the units are the same."""
        return x if self.scale == 1.0 and not self.offset else self.scale * x + self.offset

    def into(self, x: float) -> float:
        """Return the FMU's value of the port's."""
        return x if self.scale == 1.0 and not self.offset else (x - self.offset) / self.scale


class Mapped(NamedTuple):
    """The ports of one side, and the place of each variable."""

    ports: tuple[Port, ...]
    places: tuple[Place, ...]


def mapped(
    unit: Description,
    entries: Sequence[str],
    outward: bool,
    trajectories: Sequence[str] = (),
    frames: Mapping[str, str] | None = None,
) -> Mapped:
    """Create the ports of one side of an FMU.

    Parameters
    ----------
    entries : sequence of str
        ``TOPIC/CHANNEL/FIELD [UNIT] = VARIABLE``; without a unit, the unit of the variable applies.
    outward : bool
        Whether these are outputs.
    trajectories : sequence of str
        Topics that carry JointTrajectory messages.
    frames : mapping of str to str
        Topics that carry Vector3Stamped messages, and their frames.

    Raises
    ------
    ValueError
        An entry cannot be read, names an unknown variable or one of another quantity, or fills a value that another
        entry fills.
    """
    frames = frames or {}
    topics: dict[str, dict[tuple[str, str], tuple[str, Variable, tuple[float, float]]]] = {}
    for entry in entries:
        match = _ENTRY.fullmatch(entry.strip())
        if match is None or match["field"] not in FIELDS:
            raise ValueError(
                f"{entry!r}: expected TOPIC/CHANNEL/FIELD [UNIT] = VARIABLE with field one of {', '.join(FIELDS)}"
            )
        variable = unit.variable(match["name"])
        if not outward and variable.causality != "input":
            raise ValueError(
                f"{entry!r}: {variable.name} is {variable.causality} of {unit.path.name}, expected an "
                f"input; it has {_names(unit, 'input')}"
            )
        if outward and variable.causality == "input":
            raise ValueError(
                f"{entry!r}: {variable.name} is an input of {unit.path.name}; its outputs are {_names(unit, 'output')}"
            )
        if variable.kind == "String":
            raise ValueError(f"{entry!r}: {variable.name} is a text, which no channel carries")
        try:
            turn = conversion(variable, match["unit"] or "")
        except ValueError as error:
            raise ValueError(f"{entry!r}: {error}") from None
        default = variable.unit.name or "1" if variable.unit else "1" if variable.kind == "Boolean" else ""
        cells = topics.setdefault(match["topic"], {})
        if (match["channel"], match["field"]) in cells:
            raise ValueError(f"{entry!r}: this place has a variable already")
        cells[match["channel"], match["field"]] = (match["unit"] or default, variable, turn)
    if not outward and len({v.name for cells in topics.values() for _, v, _ in cells.values()}) < len(entries):
        raise ValueError("inputs: a variable is named twice")
    ports, places = [], []
    for k, (topic, cells) in enumerate(topics.items()):
        port = port_of(
            topic, cells, outward, topic in trajectories, frames.get(topic), entries=("frames", "variable"), safe=_safe
        )
        names = port.channels
        for (channel, field), (_, variable, turn) in cells.items():
            places.append(Place(variable, k, port.fields.index(field) * len(names) + names.index(channel), *turn))
        ports.append(port)
    for name in (*trajectories, *frames):
        if not re.fullmatch(r"\S+", name):
            raise ValueError(f"{name!r} is not a topic")
    return Mapped(tuple(ports), tuple(places))


def _safe(cell: tuple[str, Variable, tuple[float, float]]) -> float:
    """Return the start value in the form of the port: the value of an input before its first message."""
    _, variable, (scale, offset) = cell
    if variable.start is None:
        return 0.0
    value = scale * float(variable.starts()[variable.element or 0]) + offset
    if not math.isfinite(value):
        raise ValueError(f"{variable.name} starts at {value:g}, which no message carries")
    return value


def _names(unit: Description, causality: str) -> str:
    return ", ".join(v.name for v in unit.variables.values() if v.causality == causality) or "none"


def start_values(unit: Description, entries: Sequence[str]) -> tuple[tuple[Variable, float | int | bool | str], ...]:
    """Read ``VARIABLE = VALUE``: parameters and start values, in the FMU's own units.

    Raises
    ------
    ValueError
        There is no such variable, it cannot be set, or the value is outside its type or bounds.
    """
    results: dict[str, tuple[Variable, float | int | bool | str]] = {}
    for entry in entries:
        name, equals, value = (text.strip() for text in entry.partition("="))
        if not equals:
            raise ValueError(f"{entry!r}: expected VARIABLE = VALUE")
        variable = unit.variable(name)
        if variable.causality in UNSET or variable.constant:
            role = "constant" if variable.constant else variable.causality
            raise ValueError(f"{entry!r}: {name} is {role} of {unit.path.name}, it cannot be set")
        if name in results:
            raise ValueError(f"{entry!r}: {name} is set twice")
        results[name] = (variable, _value(variable, value))
    return tuple(results.values())


def _value(variable: Variable, value: str) -> float | int | bool | str:
    if variable.kind == "String":
        return value
    if variable.items:
        values = dict(variable.items)
        if value not in values and value not in map(str, values.values()):
            known = ", ".join(f"{name} ({number})" for name, number in variable.items)
            raise ValueError(f"{variable.name} = {value}: expected one of {known}")
        return values[value] if value in values else int(value)
    number = number_in(variable.name, variable.kind, value.lower())
    if isinstance(number, bool):
        return number
    low = -float("inf") if variable.least is None else variable.least
    high = float("inf") if variable.largest is None else variable.largest
    if not (abs(number) < float("inf") and low <= number <= high):
        raise ValueError(f"{variable.name} = {value}: expected {low:g} to {high:g}, a finite number")
    return number
