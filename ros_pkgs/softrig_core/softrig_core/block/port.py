"""Ports: what a block reads and writes, as tuples of float64."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

from ..wire import types
from ..wire.cdr import Layout
from ..wire.types import TYPES, Dims, MessageType, element_labels

XYZ = ("x", "y", "z")
WORLD = "world"  # the frame at rest, for messages that name no other

# Largest plausible magnitude by unit: a value beyond it is not a measurement, and its square or exponential would
# overflow in a controller. The last is that of any other unit.
PLAUSIBLE = {"V": 1e7, "A": 1e7, "N": 1e8, "N m": 1e8, "rad": 1e9, "rad/s": 1e7, "m": 1e9, "m/s": 1e7, "s": 1e10}
PLAUSIBLE_OTHER = 1e12
LARGEST = 1e150  # its square is still a float
# Native code writes out each value of a message; a longer array that is rarely published leaves its tick to Python.
LONGEST = 64


class Refused(ValueError):
    """A message was rejected before it reached a block; the text states the fault and what was expected."""


class Sample(NamedTuple):
    """A message of a `delayed` port: the acquisition time in ns and the values."""

    stamp: int
    data: tuple[float, ...]


def twice(names: Iterable[str]) -> str | None:
    """Return the first name that occurs twice; None if there is none."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            return name
        seen.add(name)
    return None


@dataclass(frozen=True)
class Port:
    """A named input or output of a block.

    The values of a port are a flat tuple of floats, field after field: a JointState with channels (a, b) and
    fields (position, velocity) is (pos_a, pos_b, vel_a, vel_b).

    Parameters
    ----------
    name : str
        Keyword under which the block receives or returns the values.
    topic : str
        Relative topic name.
    msgtype : str
        ROS message type, one of `softrig_core.wire.types.TYPES`.
    channels : tuple of str
        Names inside the message (JointState.name, joint_names; x, y, z of a vector).
    fields : tuple of str
        Which number fields of the message are used.
    units : tuple of str
        One unit per value, compared with that of the other end when a rig is wired. "1" is a pure number. An empty unit
        is unknown and matches any unit (used by a block that forwards any message).
    frame_id : str
        header.frame_id, by default ``world``; an input with a frame rejects any other frame.
    held : bool
        Input only: optional, newest value, None until the first message; for people and external nodes.
    delayed : bool
        Messages are `Sample` with an acquisition time of their own, and are paired by order instead of by stamp.
    sporadic : bool
        Output: the block may be silent at a tick (the port is missing in its answer, or None); readers are informed and
        do not wait. An input keeps its newest value, whose `Block.age` is 0 at a tick at which a message arrived.
    partial : bool
        Input only: a message may carry a subset of the channels; the others keep their value, at first `safe`.
    dims : Dims
        Labels and sizes of the dimensions of a Float64MultiArray; the last one changes fastest. A held input also
        accepts a message without dimensions that has the same number of values.
    also : tuple of str
        Input only: alternative names of all channels, in their order, that an external node may use.
    unchecked : bool
        Output of a fault: it may publish invalid values (NaN or beyond limits), which each reader rejects itself.
    safe : tuple of float
        Value used if there is no valid one: a plant's input under its watchdog, a controller's output when its
        measurement is bad. Default: zeros.
    limits : tuple of float
        Plausible magnitude of each value in its unit, beyond which an input rejects a message. Default by unit.
    """

    name: str
    topic: str
    msgtype: str
    channels: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    frame_id: str = ""
    held: bool = False
    delayed: bool = False
    sporadic: bool = False
    partial: bool = False
    also: tuple[str, ...] = ()
    unchecked: bool = False
    dims: Dims = ()
    safe: tuple[float, ...] = field(default=())
    limits: tuple[float, ...] = field(default=())

    def __post_init__(self) -> None:
        if self.type.shaped and not self.dims:
            raise ValueError(f"port {self.name}: an array needs at least one dimension")
        if not self.size and self.type.sizes:
            raise ValueError(
                f"port {self.name}: {self.topic} has no values; expected channels, and the unit of a "
                "field, '1' for a pure number"
            )
        if (label := twice(self.labels)) is not None:
            raise ValueError(f"port {self.name}: two values are named {label!r}; give each channel a name of its own")
        if len(self.units) != self.size:
            raise ValueError(f"port {self.name}: {len(self.units)} units for {self.size} values")
        object.__setattr__(self, "safe", tuple(map(float, self.safe)))
        if not self.safe:
            object.__setattr__(self, "safe", (0.0,) * self.size)
        if len(self.safe) != self.size:
            raise ValueError(f"port {self.name}: {len(self.safe)} safe values for {self.size} values")
        # A list is accepted, too, but keys of native texts contain the limits.
        limits = self.limits or (PLAUSIBLE.get(unit, PLAUSIBLE_OTHER) for unit in self.units)
        object.__setattr__(self, "limits", tuple(limits))
        if len(self.limits) != self.size:
            raise ValueError(f"port {self.name}: {len(self.limits)} limits for {self.size} values")
        if self.also and (not self.type.named or len(self.also) != len(self.channels)):
            raise ValueError(f"port {self.name}: {len(self.also)} other names for {len(self.channels)} channels")
        if self.partial and not self.type.named:
            raise ValueError(f"port {self.name}: {self.msgtype} has no channel names, it cannot be partial")

    @cached_property
    def size(self) -> int:
        """Number of float64 values."""
        return len(self.labels)

    @cached_property
    def width(self) -> int:
        """Number of values in a table of many ticks: none of a long array that is rarely published."""
        return 0 if self.sporadic and self.size > LONGEST else self.size

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Name of each value below the topic, e.g. ``shaft/velocity``; ``x`` or ``data`` where one word is enough."""
        sizes = self.type.sizes
        counts = {name: sizes[name] or len(self.channels) for name in self.fields}
        return self.type.labels(counts, self.channels if self.type.named else (), self.dims)

    @cached_property
    def places(self) -> dict[str, int]:
        """Return the indices of the labels in one pass; searching label by label would take quadratic time."""
        return {label: i for i, label in enumerate(self.labels)}

    @cached_property
    def bound(self) -> float:
        """Values the sum of whose squares is not above it are all within their limits."""
        least = min(self.limits, default=0.0)
        # A square beyond all floats would be infinite and let any value pass; a bound of 0 leaves the check to each
        # value.
        return least * least if least < LARGEST else 0.0

    def beyond(self, values: Sequence[float]) -> str:
        """Describe which value is not finite or beyond its limit, and what was expected; empty if all are valid."""
        for label, value, limit, unit in zip(self.labels, values, self.limits, self.units, strict=True):
            # Infinity minus itself is NaN, so one subtraction finds both; NaN would pass the comparison below.
            if value - value != 0.0:
                return f"{label} is {value}, expected a finite number"
            if abs(value) > limit:
                return f"{label} is {value:g} {unit or '1'}, expected at most {limit:g} in magnitude"
        return ""

    @property
    def type(self) -> MessageType:
        """Return the description of its message type."""
        return TYPES[self.msgtype]

    @property
    def initial(self) -> tuple[float, ...] | Sample | None:
        """Return the value of an input before its first message: None if held, else the safe value."""
        if self.held:
            return None
        return Sample(0, self.safe) if self.delayed else self.safe

    @property
    def stamped(self) -> bool:
        """Return whether its messages have a header with a stamp."""
        return self.type.stamped

    @property
    def frame(self) -> str:
        """Return the header.frame_id of its messages; empty for a type without one."""
        return (self.frame_id or WORLD) if self.type.framed else ""

    def layout(self) -> Layout:
        """Return the wire layout of the messages of this port."""
        return self._layout

    @cached_property
    def _layout(self) -> Layout:
        names = self.channels if self.type.named else ()
        count = self.size if self.dims else len(self.channels)
        counts = dict.fromkeys(self.fields, count)
        return Layout(self.msgtype, self.frame, names, counts, self.dims, numbered=self.type.shaped)

    def renamed(self, topic: str) -> Port:
        """Return the same port on another topic."""
        return self if topic == self.topic else replace(self, topic=topic)

    def __hash__(self) -> int:
        # A hash of all fields takes microseconds, and hardly any two ports share name and topic.
        return hash((self.name, self.topic))


Units = str | Sequence[str]  # one of all channels, or one a channel; "1" for a pure number


def joint_state(
    name: str,
    topic: str,
    channels: Sequence[str],
    *,
    position: Units = "",
    velocity: Units = "",
    effort: Units = "",
    **options: object,
) -> Port:
    """State of mechanical axes or named scalars; the fields are those whose unit or units are given.

    Parameters
    ----------
    name : str
        Argument of the block's methods, or key of its answer.
    topic : str
        Relative name.
    channels : sequence of str
        Names in the message, such as joints.
    position, velocity, effort : str or sequence of str
        Unit of all channels or one a channel, "1" for a pure number; a field without unit is not used.
    **options
        Further fields of `Port`: held, delayed, sporadic, partial, safe, limits.
    """
    units = {"position": position, "velocity": velocity, "effort": effort}
    return _named(types.JOINT_STATE.name, name, topic, channels, units, options)


def command(name: str, topic: str, channels: Sequence[str], unit: Units, **options: object) -> Port:
    """Actuator command: a JointState whose effort holds the commanded values (V, N m, N, duty); one unit or many.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    channels : sequence of str
        Names of the commanded quantities.
    unit : str or sequence of str
        Of all channels, or one a channel.
    """
    return joint_state(name, topic, channels, effort=unit, **options)  # type: ignore[arg-type]


def scalars(name: str, topic: str, units: Mapping[str, str], **options: object) -> Port:
    """Named scalars of different units (channel to unit), in JointState.position.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    units : mapping of str to str
        Unit by channel.
    """
    return Port(name, topic, types.JOINT_STATE.name, tuple(units), ("position",), tuple(units.values()), **options)  # type: ignore[arg-type]


def reference(
    name: str,
    topic: str,
    channels: Sequence[str],
    *,
    position: Units = "",
    velocity: Units = "",
    acceleration: Units = "",
    **options: object,
) -> Port:
    """Axis reference: a JointTrajectory of one point; the fields are those whose unit or units are given.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    channels : sequence of str
        Names of the axes.
    position, velocity, acceleration : str or sequence of str
        Unit of all axes or one an axis; a field without unit is not used.
    """
    units = {"position": position, "velocity": velocity, "acceleration": acceleration}
    return _named(types.JOINT_TRAJECTORY.name, name, topic, channels, units, options)


def vector3(name: str, topic: str, frame_id: str, units: str | Sequence[str], **options: object) -> Port:
    """Three-phase (abc) or rotating-frame (alpha_beta, dq) quantity.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    frame_id : str
        ``abc``, ``alpha_beta`` or ``dq``; a message of another frame is refused.
    units : str or sequence of str
        Of all three components, or one each.
    """
    units = (units,) * 3 if isinstance(units, str) else tuple(units)
    return Port(name, topic, types.VECTOR.name, XYZ, ("vector",), units, frame_id, **options)  # type: ignore[arg-type]


def wrench(name: str, topic: str, frame_id: str = "", **options: object) -> Port:
    """Force (N) and torque (N m) of a person or a load.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    frame_id : str
        Where force and torque are expressed; an input without one takes any.
    """
    units = ("N",) * 3 + ("N m",) * 3
    return Port(name, topic, types.WRENCH.name, XYZ, ("force", "torque"), units, frame_id, **options)  # type: ignore[arg-type]


def pose(name: str, topic: str, frame_id: str, **options: object) -> Port:
    """Position (m) and orientation (unit quaternion x, y, z, w) in a frame.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    frame_id : str
        Where the pose is expressed; an input without one takes any.
    """
    units = ("m",) * 3 + ("",) * 4
    fields = ("position", "orientation")
    return Port(name, topic, types.POSE.name, (), fields, units, frame_id, **options)  # type: ignore[arg-type]


def array(name: str, topic: str, dims: Mapping[str, int], units: str | Sequence[str], **options: object) -> Port:
    """A vector or matrix (Float64MultiArray): label and size of each dimension, unit of all or of each value.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    dims : mapping of str to int
        Size by label, the outermost dimension first.
    units : str or sequence of str
        Of all values, or one a value in the order of the message.
    """
    shape = tuple(dims.items())
    units = (units,) * len(element_labels(shape)) if isinstance(units, str) else tuple(units)
    return Port(name, topic, types.ARRAY.name, (), ("data",), units, dims=shape, **options)  # type: ignore[arg-type]


def number(name: str, topic: str, unit: str, **options: object) -> Port:
    """Create a port for a set point or other single number from a person or an external node (std_msgs/Float64).

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    unit : str
        Of the number; the message has no unit.
    """
    return Port(name, topic, types.NUMBER.name, (), ("data",), (unit,), **options)  # type: ignore[arg-type]


def button(name: str, topic: str, **options: object) -> Port:
    """A push button (std_msgs/Bool): 0.0 or 1.0.

    Parameters
    ----------
    name, topic, **options
        As in `joint_state`.
    """
    return Port(name, topic, types.BUTTON.name, (), ("data",), ("",), **options)  # type: ignore[arg-type]


def _named(
    msgtype: str,
    name: str,
    topic: str,
    channels: Sequence[str],
    units: Mapping[str, Units],
    options: Mapping[str, object],
) -> Port:
    fields = tuple(f for f, unit in units.items() if unit)
    each = {f: [unit] * len(channels) if isinstance(unit, str) else unit for f, unit in units.items()}
    flat = tuple(unit for f in fields for unit in each[f])
    return Port(name, topic, msgtype, tuple(channels), fields, flat, **options)  # type: ignore[arg-type]


CLOCK = Port("clock", "/clock", "rosgraph_msgs/msg/Clock")


def require_distinct(inputs: Sequence[Port], outputs: Sequence[Port]) -> None:
    """Ensure that no two inputs and no two outputs of a block share a name, and no two outputs a topic.

    Values and links are found by these names, so the second one would silently take the place of the first.

    Raises
    ------
    ValueError
        Names the two topics, or the two outputs, that share a name.
    """
    for kind, ports in (("inputs", inputs), ("outputs", outputs)):
        if (name := twice(p.name for p in ports)) is not None:
            first, second = [p.topic for p in ports if p.name == name][:2]
            raise ValueError(f"two {kind} are named {name!r} (topics {first} and {second}); give each its own name")
    if (topic := twice(p.topic for p in outputs)) is not None:
        first, second = [p.name for p in outputs if p.topic == topic][:2]
        raise ValueError(f"outputs {first} and {second} both publish {topic!r}; give each its own topic")
