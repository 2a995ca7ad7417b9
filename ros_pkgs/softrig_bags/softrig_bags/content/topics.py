"""Metadata of a topic in a bag: type, definition, type hash and the QoS that its publishers offered."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from softrig_core.kit.resource import prefixes

from ..errors import BagError
from .known import definition_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

# The value of RMW_DURATION_INFINITE, which rosbag2 writes for a policy without a limit.
FOREVER = QosTime(9223372036, 854775807)


def qos(durability: QosDurability = QosDurability.VOLATILE, depth: int = 10) -> Qos:
    """Return an offered QoS profile: keep last, reliable, no deadline, no lifespan, automatic liveliness."""
    reliable, alive = QosReliability.RELIABLE, QosLiveliness.AUTOMATIC
    return Qos(QosHistory.KEEP_LAST, depth, reliable, durability, FOREVER, FOREVER, alive, FOREVER, False)


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Parameters
    ----------
    name : str
        Absolute topic name.
    msgtype : str
        ``package/msg/Type``.
    definition : str
        Text of the type and all types in it; empty when unknown.
    digest : str
        Type hash (``RIHS01_...``); empty when unknown.
    offered : tuple of Qos
        One profile a publisher.
    encoding : str
        Language of the definition: ros2msg or ros2idl.
    wire : str
        Encoding of the messages: cdr.
    """

    name: str
    msgtype: str
    definition: str = ""
    digest: str = ""
    offered: tuple[Qos, ...] = ()
    encoding: str = "ros2msg"
    wire: str = "cdr"

    @classmethod
    def known(cls, name: str, msgtype: str, offered: Sequence[Qos] = (), digest: str = "") -> BagTopic:
        """Return a topic with the definition and hash of this ROS distribution, both empty for an unknown type."""
        definition, computed = _definition(msgtype)
        return cls(name, msgtype, definition, digest or computed, tuple(offered))


def absolute(name: str) -> str:
    """Return a topic's name as ROS and a bag write it."""
    return "/" + name.lstrip("/")


def checked_namespace(text: str) -> str:
    """Return a namespace with a leading slash and without a trailing one, empty for the root; BagError if it is
    invalid.
    """
    names = text.strip("/").split("/")
    if names == [""]:
        return ""
    if not all(re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII) for name in names):
        raise BagError(f"{text!r} is not the name of a namespace; expected one such as /a or a/b")
    return "/" + "/".join(names)


@cache
def typestore() -> Typestore:
    """Return the store of the Jazzy message types; `_definition` adds installed types that it lacks."""
    # Imported here, because the stores of seven distributions are loaded with it, which costs a tenth of a second.
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def is_known(msgtype: str) -> bool:
    """Return whether a type is defined here: in the library of the Jazzy types, or installed."""
    from rosbags.typesys import TypesysError

    try:
        return _register(msgtype)
    # An installed definition may be one that the library cannot read.
    except (TypesysError, OSError, ValueError):
        return False


@cache
def _definition(msgtype: str) -> tuple[str, str]:
    if (known := definition_of(msgtype)) is not None:
        return known
    if not is_known(msgtype):
        return "", ""
    return typestore().generate_msgdef(msgtype, ros_version=2)[0], typestore().hash_rihs01(msgtype)


def _register(msgtype: str) -> bool:
    """Ensure that a type and all types in it are in the store, from the .msg files of the ament prefixes."""
    if msgtype in typestore().fielddefs:
        return True
    package, _, name = msgtype.partition("/msg/")
    for prefix in prefixes():
        path = prefix / "share" / package / "msg" / f"{name}.msg"
        if path.is_file():
            from rosbags.typesys import get_types_from_msg

            types = get_types_from_msg(path.read_text(), msgtype)
            typestore().register(types)
            return all(_register(t) for t in _nested(types[msgtype][1]))
    return False


def _nested(fields: Any) -> set[str]:
    result = set()
    for _, (_, detail) in fields:
        while not isinstance(detail, str) and not isinstance(detail[0], str):  # down to the items of an array
            detail = detail[0][1]
        name = detail if isinstance(detail, str) else detail[0]
        if "/" in name:
            result.add(name)
    return result
