"""The message types of softrig, each described once: fields in wire order, with names, stamps, shapes and labels.

Codec, ports, signals, links and the comparison of bags all use this table; a new type is one entry of `TYPES`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal, NamedTuple

Dims = tuple[tuple[str, int], ...]  # dimensions of an array: label and size of each, the last one changing fastest
Kind = Literal["stamp", "frame", "names", "dims", "one", "sequence", "numbers", "flag", "duration"]
AXES = "xyzw"


class Item(NamedTuple):
    """One part of a message in wire order.

    Its kind is "stamp" (builtin_interfaces/Time), "frame" (a string), "names" (strings), "dims" (a MultiArrayLayout),
    "one" (a sequence length that must be 1), "sequence" (float64[]), "numbers" (so many float64), "flag" (a bool),
    "duration" (a Duration that is no signal).
    """

    kind: Kind
    name: str = ""
    size: int = 0


@dataclass(frozen=True)
class MessageType:
    """The description of a message type in the suite.

    Parameters
    ----------
    name : str
        ``package/msg/Type``.
    schema : tuple of Item
        All that is on the wire, in order.
    """

    name: str
    schema: tuple[Item, ...]

    def _has(self, kind: Kind) -> bool:
        return any(item.kind == kind for item in self.schema)

    @cached_property
    def stamped(self) -> bool:
        """Return whether it begins with a header or a time."""
        return self._has("stamp")

    @cached_property
    def framed(self) -> bool:
        """Return whether its header contains the frame of its values."""
        return self._has("frame") and bool(self.sizes)

    @cached_property
    def named(self) -> bool:
        """Return whether its channels have names in the message."""
        return self._has("names")

    @cached_property
    def shaped(self) -> bool:
        """Return whether it is an array with labelled dimensions."""
        return self._has("dims")

    @cached_property
    def timed(self) -> bool:
        """Return whether it ends with a duration, which is not a signal."""
        return self._has("duration")

    @cached_property
    def sizes(self) -> dict[str, int | None]:
        """Return the number of values of each field; None if the message contains it."""
        return {i.name: i.size or None for i in self.schema if i.kind in ("sequence", "numbers", "flag")}

    def labels(self, fields: Mapping[str, int], names: Sequence[str] = (), dims: Dims | None = None) -> tuple[str, ...]:
        """Name each value below the topic: ``shaft/velocity``, ``force/x``; ``x`` or ``data`` where one word suffices.

        Parameters
        ----------
        fields : mapping of str to int
            Fields in the order of their values, with the number of values of each.
        names : sequence of str
            Names of the channels.
        dims : Dims, optional
            Shape of an array.
        """
        results: list[str] = []
        for name, count in fields.items():
            if names:
                results += [f"{c}/{name}" if c else f"{name}/{i}" for i, c in enumerate(names[:count])]
                results += [f"{name}/{i}" for i in range(len(names), count)]  # more values than names
            elif dims:
                results += element_labels(dims)
            elif self.sizes[name] is None:
                results += [f"{name}/{i}" for i in range(count)]
            elif count == 1:
                results.append(name)
            else:
                results += [axis if len(self.sizes) == 1 else f"{name}/{axis}" for axis in AXES[:count]]
        return tuple(results)


def element_labels(dims: Dims) -> tuple[str, ...]:
    """Name the elements of an array by their indices: ``0,0``, ``0,1``, ..."""
    return tuple(",".join(map(str, index)) for index in product(*(range(size) for _, size in dims)))


_HEADER = (Item("stamp"), Item("frame"))


def _sequences(*names: str) -> tuple[Item, ...]:
    return tuple(Item("sequence", name) for name in names)


JOINT_STATE = MessageType(
    "sensor_msgs/msg/JointState", (*_HEADER, Item("names"), *_sequences("position", "velocity", "effort"))
)
JOINT_TRAJECTORY = MessageType(
    "trajectory_msgs/msg/JointTrajectory",
    (
        *_HEADER,
        Item("names"),
        Item("one"),
        *_sequences("position", "velocity", "acceleration", "effort"),
        Item("duration"),
    ),
)
VECTOR = MessageType("geometry_msgs/msg/Vector3Stamped", (*_HEADER, Item("numbers", "vector", 3)))
WRENCH = MessageType(
    "geometry_msgs/msg/WrenchStamped", (*_HEADER, Item("numbers", "force", 3), Item("numbers", "torque", 3))
)
POSE = MessageType(
    "geometry_msgs/msg/PoseStamped", (*_HEADER, Item("numbers", "position", 3), Item("numbers", "orientation", 4))
)
CLOCK = MessageType("rosgraph_msgs/msg/Clock", (Item("stamp"),))
TIME = MessageType("builtin_interfaces/msg/Time", (Item("stamp"),))
HEADER = MessageType("std_msgs/msg/Header", _HEADER)
NUMBER = MessageType("std_msgs/msg/Float64", (Item("numbers", "data", 1),))
BUTTON = MessageType("std_msgs/msg/Bool", (Item("flag", "data", 1),))
ARRAY = MessageType("std_msgs/msg/Float64MultiArray", (Item("dims"), Item("sequence", "data")))

TYPES = {
    t.name: t for t in (JOINT_STATE, JOINT_TRAJECTORY, VECTOR, WRENCH, POSE, CLOCK, TIME, HEADER, NUMBER, BUTTON, ARRAY)
}
