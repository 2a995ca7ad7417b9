"""Which channel of which topic is which member of a user's structs: from NODE.json, or from a table in the scenario."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from softrig_core import Port
from softrig_core.board.description import PortDescription, read_description
from softrig_core.errors import closest
from softrig_core.wire.types import TYPES

from ..channels import FIELDS, port_of
from .layout import Leaf

HAS = "has_"  # prefix of a flag: whether the port has a value
ENTRY = re.compile(
    r"(?P<topic>\S+)/(?P<channel>[^\s/\[]+)/(?P<field>[a-z]+)\s*\[(?P<unit>[^\]]*)\]\s*=\s*(?P<name>\S+)"
)
VALUE = re.compile(
    r"(?P<name>[A-Za-z_][\w.\[\]]*)\s*(\[(?P<unit>[^\]]*)\])?\s*(\((?P<low>\S+)\s*\.\.\s*(?P<high>[^\s)]+)\))?"
    r"\s*=\s*(?P<value>\S+)"
)


class Side(NamedTuple):
    """The ports of one side; of each member of the struct, the port and the place in it, -1: whether it has a value."""

    ports: tuple[Port, ...]
    places: tuple[tuple[int, int], ...]


class Described(NamedTuple):
    """The contents of a NODE.json."""

    node: str
    period: float
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    parameters: Mapping[str, Any]


def described(file: Path) -> Described:
    """Read the description that `softrig export c` writes, or a file in the same form.

    Raises
    ------
    ValueError
        It is no JSON, or lacks something; names it.
    """
    try:
        description = read_description(file)
        sides: dict[str, list[Port]] = {"in": [], "out": []}
        for each in description.ports:
            sides[each.direction].append(_described_port(each))
    except ValueError as error:
        raise ValueError(f"{file.name} describes no node: {error}; expected what `softrig export c` writes") from None
    parameters = {name: description.parameters[name] for name in description.settable}
    return Described(description.node, description.period, tuple(sides["in"]), tuple(sides["out"]), parameters)


def _described_port(description: PortDescription) -> Port:
    kind = TYPES[description.type]
    values = description.values
    labels = [v.label.rpartition("/") for v in values]
    fields = tuple(dict.fromkeys(label for _, _, label in labels)) if kind.named else tuple(kind.sizes)[:1]
    channels = tuple(dict.fromkeys(channel for channel, _, _ in labels)) if kind.named else ()
    if description.fields:
        fields, channels = description.fields, description.channels
        if strange := [name for name in fields if name not in kind.sizes]:
            raise ValueError(
                f"port {description.name}: {description.type} has no {strange[0]}{closest(strange[0], kind.sizes)}"
            )
    return Port(
        description.name,
        description.topic,
        description.type,
        channels,
        fields,
        tuple(v.unit for v in values),
        description.frame_id,
        held=description.held,
        sporadic=description.sporadic,
        delayed=description.delayed,
        partial=description.partial,
        dims=description.dims,
        safe=tuple(v.safe for v in values),
        limits=tuple(v.limit for v in values),
    )


def fitted(ports: Sequence[Port], leaves: Sequence[Leaf], struct: str) -> Side:
    """Find the place of each member of a struct in ports that a description names.

    Raises
    ------
    ValueError
        A member belongs to no port, or a value of a port has no member.
    """
    known: dict[str, tuple[int, int]] = {}
    for k, port in enumerate(ports):
        if port.delayed:
            raise ValueError(f"{port.topic} is delayed; a C member cannot have such a port")
        name = re.sub(r"\W", "_", port.name)
        known |= {f"{name}[{i}]": (k, i) for i in range(port.size)}
        if port.held or port.sporadic:
            known[f"{HAS}{name}"] = (k, -1)
    optional = {name for name in known if name.startswith(HAS)}
    names = [leaf.access for leaf in leaves]
    if strange := [name for name in names if name not in known]:
        raise ValueError(f"{struct}.{strange[0]} belongs to no port of the description")
    if missing := [name for name in known if name not in names and name not in optional]:
        raise ValueError(f"{struct} has no member {missing[0]}, which the description names")
    return Side(tuple(ports), tuple(known[name] for name in names))


def table(
    entries: Sequence[str],
    leaves: Sequence[Leaf],
    struct: str,
    outward: bool,
    trajectories: Sequence[str],
    frames: Mapping[str, str],
    held: Sequence[str],
) -> Side:
    """Create the ports of one side from entries ``TOPIC/CHANNEL/FIELD [UNIT] = MEMBER``.

    Raises
    ------
    ValueError
        An entry cannot be read or names something that does not exist, or a member of the struct has no entry.
    """
    names = {leaf.access: k for k, leaf in enumerate(leaves)}
    topics: dict[str, dict[tuple[str, str], tuple[str, str]]] = {}
    used: set[str] = set()
    for entry in entries:
        match = ENTRY.fullmatch(entry.strip())
        if match is None or match["field"] not in FIELDS:
            raise ValueError(
                f"{entry!r}: expected TOPIC/CHANNEL/FIELD [UNIT] = MEMBER with field one of {', '.join(FIELDS)}, "
                "such as motor/state/shaft/velocity [rad/s] = speed"
            )
        name = match["name"]
        if name not in names:
            raise ValueError(f"{entry!r}: {struct} has no member {name!r}{closest(name, names)}; it has {_list(names)}")
        if name in used:
            raise ValueError(f"{entry!r}: {struct}.{name} has a channel already")
        used.add(name)
        cells = topics.setdefault(match["topic"], {})
        if (match["channel"], match["field"]) in cells:
            raise ValueError(f"{entry!r}: this place has a member already")
        cells[match["channel"], match["field"]] = (match["unit"] or "1", name)
    flags = {name for name in names if name.startswith(HAS)}
    if left := [name for name in names if name not in used | flags]:
        raise ValueError(
            f"{struct}.{left[0]} has no channel; add TOPIC/CHANNEL/FIELD [UNIT] = {left[0]} to "
            f"{'outputs' if outward else 'inputs'}"
        )
    for topic in (*trajectories, *frames, *held):
        if not outward and topic in held and topic not in topics:
            raise ValueError(f"held: {topic!r} is not a topic of inputs; they are {_list(topics)}")
    ports, position_of = [], dict[str, tuple[int, int]]()
    for k, (topic, cells) in enumerate(topics.items()):
        port = port_of(
            topic,
            cells,
            outward,
            topic in trajectories,
            frames.get(topic),
            entries=("vectors", "member"),
            held=topic in held and not outward,
        )
        for (channel, field), (_, name) in cells.items():
            position_of[name] = (k, port.fields.index(field) * len(port.channels) + port.channels.index(channel))
        if (flag := HAS + re.sub(r"\W", "_", topic)) in names:
            position_of[flag] = (k, -1)
        ports.append(port)
    if strange := flags - position_of.keys():
        raise ValueError(f"{struct}.{min(strange)} belongs to no topic; expected has_ and a topic with _ for /")
    return Side(tuple(ports), tuple(position_of[name] for name in names))


def values_of(
    entries: Sequence[str], leaves: Sequence[Leaf], struct: str, defaults: Mapping[str, Any]
) -> dict[str, float]:
    """Read ``MEMBER [UNIT] (LOW..HIGH) = VALUE``: the parameters, in the order of the struct.

    Raises
    ------
    ValueError
        An entry is missing, cannot be read, or names something that does not exist, or its value is outside its range
        or type.
    """
    names, result = {leaf.access: leaf for leaf in leaves}, dict[str, float]()
    for entry in entries:
        match = VALUE.fullmatch(entry.strip())
        if match is None:
            raise ValueError(
                f"{entry!r}: expected MEMBER [UNIT] (LOW..HIGH) = VALUE, such as kp [V s/rad] (0..10) = 2.5"
            )
        name = match["name"]
        if name not in names:
            raise ValueError(f"{entry!r}: {struct} has no member {name!r}{closest(name, names)}; it has {_list(names)}")
        if name in result:
            raise ValueError(f"{entry!r}: {name} is set twice")
        try:
            value = float(match["value"])
            low, high = float(match["low"] or "-inf"), float(match["high"] or "inf")
        except ValueError as error:
            raise ValueError(f"{entry!r}: {error}") from None
        unit = match["unit"] or "1"
        if not (abs(value) < float("inf") and low <= value <= high):
            raise ValueError(f"{entry!r}: {value:g} {unit} is beyond {low:g} to {high:g}, or no finite number")
        if names[name].whole and value != int(value):
            raise ValueError(f"{entry!r}: {name} is a whole number in C, expected one")
        result[name] = value
    for name in names:
        if name not in result and name in defaults:
            result[name] = float(defaults[name])
    if missing := [name for name in names if name not in result]:
        raise ValueError(f"values: {struct}.{missing[0]} has none; add {missing[0]} [UNIT] = VALUE")
    return {name: result[name] for name in names}


def _list(names: Any) -> str:
    return ", ".join(names) or "none"
