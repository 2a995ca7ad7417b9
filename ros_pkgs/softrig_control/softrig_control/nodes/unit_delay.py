"""A delay of one period that breaks an algebraic loop: it publishes the input of the previous tick."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from softrig_core import BlockParams, Plant, Port, Values, param
from softrig_core.block.port import XYZ
from softrig_core.wire import types

MessageType = Literal[
    "sensor_msgs/msg/JointState",
    "trajectory_msgs/msg/JointTrajectory",
    "geometry_msgs/msg/Vector3Stamped",
    "geometry_msgs/msg/WrenchStamped",
    "geometry_msgs/msg/PoseStamped",
    "std_msgs/msg/Float64",
    "std_msgs/msg/Bool",
    "std_msgs/msg/Float64MultiArray",
]


class LinkParams(BlockParams):
    """Parameters of a link: the messages it carries."""

    topic_in: str = param("axis/state", "topic at the sender's end", min_length=1)
    topic_out: str = param("axis/feedback", "topic at the receiver's end", min_length=1)
    message: MessageType = param("sensor_msgs/msg/JointState", "type of the messages")
    channels: tuple[str, ...] = param(("axis",), "names in a JointState or JointTrajectory")
    fields: tuple[str, ...] = param(("position", "velocity"), "fields used of a JointState or JointTrajectory")
    dims: tuple[str, ...] = param((), "labels of the dimensions of a Float64MultiArray, the outermost first")
    sizes: tuple[int, ...] = param((), "their sizes", each=(1, 10_000))
    units: tuple[str, ...] = param((), "unit of each value, field after field; empty: pure numbers")
    limits: tuple[float, ...] = param(
        (), "magnitude beyond which each value is refused; empty: by unit", each=(0.0, 1e300)
    )
    frame_id: str = param("", "frame of the messages")
    initial: tuple[float, ...] = param(
        (), "values published before the first arrival; empty: the safe values of the link"
    )

    def _check(self) -> None:
        if self.topic_in == self.topic_out:
            raise ValueError(f"topic_in and topic_out are both {self.topic_in!r}")
        known = self.type.sizes
        if self.type.named and not (self.fields and known.keys() >= set(self.fields)):
            raise ValueError(f"fields {list(self.fields)}, expected some of {sorted(known)} for {self.message}")
        if len(self.dims) != len(self.sizes) or self.type.shaped != bool(self.dims):
            expected = "one size for each label" if self.type.shaped else f"none for {self.message}"
            raise ValueError(f"dims {list(self.dims)} with sizes {list(self.sizes)}, expected {expected}")
        for name in ("initial", "units", "limits"):
            self.check_size(name)

    @property
    def type(self) -> types.MessageType:
        """Return the description of the message type."""
        return types.TYPES[self.message]

    def check_size(self, name: str) -> None:
        """Ensure that a list of values, if there is one, has one for each value of the port."""
        values, size = getattr(self, name), len(self._labels)
        if values and len(values) != size:
            raise ValueError(f"{name} has {len(values)} values, expected {size}")

    @property
    def _fields(self) -> tuple[str, ...]:
        sizes = self.type.sizes
        return tuple(f for f in sizes if f in self.fields) if self.type.named else tuple(sizes)

    @property
    def _labels(self) -> tuple[str, ...]:
        names = self.channels if self.type.named else ()
        counts = {f: self.type.sizes[f] or len(names) for f in self._fields}
        return self.type.labels(counts, names, tuple(zip(self.dims, self.sizes, strict=True)))

    def port(self, name: str, topic: str, **options: Any) -> Port:
        """Return one end of the link."""
        vector = self.message in (types.VECTOR.name, types.WRENCH.name)
        names = self.channels if self.type.named else XYZ if vector else ()
        return Port(
            name,
            topic,
            self.message,
            names,
            self._fields,
            self.units or ("",) * len(self._labels),
            self.frame_id,
            dims=tuple(zip(self.dims, self.sizes, strict=True)),
            limits=self.limits,
            **options,
        )


class State(NamedTuple):
    """The message of the previous tick."""

    held: tuple[float, ...]


class UnitDelay(Plant[LinkParams]):
    """y(t_k) = u(t_{k-1}), at first `initial` (zeros when empty).

    To the rig it is a plant: its output never depends on the same tick's input, so a cycle through it can be run.
    """

    @classmethod
    def ports(cls, params: LinkParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return both ends, of the same message type."""
        return (params.port("sent", params.topic_in),), (params.port("arrived", params.topic_out),)

    def first(self) -> State:
        """Hold the initial values."""
        return State(self.p.initial or (0.0,) * self.p.port("sent", self.p.topic_in).size)

    def outputs(self, x: State, t: int) -> Values:
        """Return the input of one tick ago."""
        return {"arrived": x.held}

    def advance(self, x: State, t: int, *, sent: tuple[float, ...]) -> State:
        """Store the published value."""
        return State(sent)
