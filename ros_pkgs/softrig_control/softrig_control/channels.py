"""Ports from entries ``TOPIC/CHANNEL/FIELD``: how scenarios name variables of an FMU and members of a C law."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from softrig_core import Port, joint_state, reference, vector3
from softrig_core.block.port import XYZ

FIELDS = ("position", "velocity", "acceleration", "effort", "vector")
Cell = TypeVar("Cell", bound=tuple[Any, ...])


def frames_of(vectors: Sequence[str]) -> dict[str, str]:
    """Read entries ``TOPIC = FRAME``.

    Raises
    ------
    ValueError
        An entry names no frame.
    """
    frames = {}
    for entry in vectors:
        topic, equals, frame = (text.strip() for text in entry.partition("="))
        if not equals:
            raise ValueError(f"vectors: {entry!r}: expected TOPIC = FRAME")
        frames[topic] = frame
    return frames


def port_of(
    topic: str,
    cells: Mapping[tuple[str, str], Cell],
    outward: bool,
    trajectory: bool,
    frame: str | None,
    entries: tuple[str, str],
    *,
    held: bool = False,
    safe: Callable[[Cell], float] | None = None,
) -> Port:
    """Create the port of a topic.

    Parameters
    ----------
    cells : mapping of (str, str) to tuple
        By channel and field; each begins with its unit.
    outward : bool
        Whether the node publishes it.
    trajectory : bool
        Whether its messages are JointTrajectory.
    frame : str or None
        Of Vector3Stamped messages.
    entries : (str, str)
        For errors: where topics of Vector3Stamped are named, and what a channel belongs to.
    safe : callable, optional
        Returns the safe value of a cell.

    Raises
    ------
    ValueError
        A field or channel that the message does not have, or one of a published message that no cell fills.
    """
    name = "to_" * outward + re.sub(r"\W", "_", topic)
    fields = [f for f in FIELDS if any(f == field for _, field in cells)]
    channels = list(dict.fromkeys(channel for channel, _ in cells))
    allowed = ("vector",) if frame is not None else FIELDS[:3] if trajectory else ("position", "velocity", "effort")
    if wrong := [f for f in fields if f not in allowed]:
        raise ValueError(
            f"{topic}: no field {wrong[0]} in its messages, expected {', '.join(allowed)}; topics of "
            f"JointTrajectory are named in trajectories, those of Vector3Stamped in {entries[0]}"
        )
    if frame is not None:
        if set(channels) - set(XYZ):
            raise ValueError(f"{topic}: channels {', '.join(channels)}, expected x, y and z")
        channels = list(XYZ)
    missing = [f"{topic}/{c}/{f}" for f in fields for c in channels if (c, f) not in cells]
    if missing and outward and frame is None:
        raise ValueError(f"{topic}: the message carries {', '.join(missing)} as well; name a {entries[1]} for each")
    units = {f: [cells[c, f][0] if (c, f) in cells else "" for c in channels] for f in fields}
    more: dict[str, Any] = {"held": held}
    if safe is not None:
        more["safe"] = tuple(safe(cells[c, f]) if (c, f) in cells else 0.0 for f in fields for c in channels)
    if frame is not None:
        return vector3(name, topic, frame, units["vector"], **more)
    if trajectory:
        return reference(name, topic, channels, **units, **more)
    return joint_state(name, topic, channels, **units, **more)
