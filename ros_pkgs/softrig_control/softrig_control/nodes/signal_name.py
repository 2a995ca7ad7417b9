"""Ports named by a parameter, as scenarios name signals: ``topic/channel/field``."""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core import Port, joint_state

FIELDS = ("position", "velocity", "effort")


def split(signal: str) -> tuple[str, str, str]:
    """Return (topic, channel, field) of ``topic/channel/field``.

    Raises
    ------
    ValueError
        It has no such form.
    """
    topic, channel, field = ("", "", *signal.rsplit("/", 2))[-3:]
    if not topic or not channel or field not in FIELDS:
        raise ValueError(f"{signal!r}: expected topic/channel/field with field one of {', '.join(FIELDS)}")
    return topic, channel, field


def signal_port(
    name: str,
    signal: str,
    unit: str,
    *,
    also: Sequence[str] = (),
    held: bool = False,
    safe: tuple[float, ...] = (),
) -> Port:
    """Create a port of one channel of a JointState, the first channel.

    Parameters
    ----------
    name : str
        Keyword of the block.
    signal : str
        ``topic/channel/field``.
    unit : str
        Empty for a pure number.
    also : sequence of str
        Channels that are in the same message, their units not known.
    """
    topic, channel, field = split(signal)
    units: dict[str, tuple[str, ...]] = {field: (unit or "1", *("" for _ in also))}
    return joint_state(name, topic, (channel, *also), held=held, safe=safe, **units)
