"""A delay of one period that breaks an algebraic loop: it answers with what it took in at the tick before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

from pydantic import model_validator
from softrig_core import BlockParams, Plant, Port, executable, param, state_type
from softrig_core.block.port import XYZ
from softrig_core.wire import types

MessageType = Literal[
    "sensor_msgs/msg/JointState",
    "trajectory_msgs/msg/JointTrajectory",
    "geometry_msgs/msg/Vector3Stamped",
    "geometry_msgs/msg/WrenchStamped",
]


class LinkParams(BlockParams):
    """Which messages a link carries."""

    topic_in: str = param("axis/state", "topic at the sender's end", min_length=1)
    topic_out: str = param("axis/feedback", "topic at the receiver's end", min_length=1)
    message: MessageType = param("sensor_msgs/msg/JointState", "type of the messages")
    channels: tuple[str, ...] = param(("axis",), "names in a JointState or JointTrajectory")
    fields: tuple[str, ...] = param(("position", "velocity"), "fields used of a JointState or JointTrajectory")
    units: tuple[str, ...] = param((), "unit of each value, field after field; empty: pure numbers")
    frame_id: str = param("", "frame of the messages")
    initial: tuple[float, ...] = param((), "values given before the first arrival; empty: what the link says of itself")

    @model_validator(mode="after")
    def _names_fit(self) -> Self:
        if self.topic_in == self.topic_out:
            raise ValueError(f"topic_in and topic_out are both {self.topic_in!r}")
        known = {"position", "velocity", "effort" if self.message == types.JOINT_STATE.name else "acceleration"}
        if not self.fields or not known.issuperset(self.fields):
            raise ValueError(f"fields {list(self.fields)}, expected some of {sorted(known)} for {self.message}")
        self.check_size("initial")
        self.check_size("units")
        return self

    def check_size(self, name: str) -> None:
        """Make sure that a list of values, if there is one, has one for each value of the port."""
        given, size = getattr(self, name), self.port("link", self.topic_in).size
        if given and len(given) != size:
            raise ValueError(f"{name} has {len(given)} values, expected {size}")

    def port(self, name: str, topic: str, **options: Any) -> Port:
        """Give one end of the link."""
        used = tuple(f for f in ("position", "velocity", "acceleration", "effort") if f in self.fields)
        fields = {types.VECTOR.name: ("vector",), types.WRENCH.name: ("force", "torque")}.get(self.message, used)
        names = self.channels if self.message in (types.JOINT_STATE.name, types.JOINT_TRAJECTORY.name) else XYZ
        units = self.units or ("",) * (len(fields) * len(names))
        return Port(name, topic, self.message, names, fields, units, self.frame_id, **options)


class UnitDelay(Plant[LinkParams]):
    """y(t_k) = u(t_{k-1}), at first `initial` (zeros when empty).

    To the rig it is a plant: its output never depends on the same tick's input, so a cycle through it can be run.
    """

    @classmethod
    def ports(cls, params: LinkParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Give both ends, of the same message type."""
        return (params.port("sent", params.topic_in),), (params.port("arrived", params.topic_out),)

    def start(self) -> None:
        """Hold the initial values."""
        self._held = self.p.initial or (0.0,) * self.p.port("sent", self.p.topic_in).size

    @property
    def state(self) -> Any:
        """Give what is held, named as in the message."""
        return state_type(("", self.p.port("sent", self.p.topic_in).labels))(*self._held)

    def put(self, state: Sequence[float]) -> None:
        """Hold other values."""
        self._held = tuple(state)

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give what came in a tick ago."""
        return {"arrived": self._held}

    def advance(self, t: int, *, sent: tuple[float, ...]) -> None:
        """Take in what was sent."""
        self._held = sent


main = executable(UnitDelay)
