"""What a bag must know of a topic: type, definition, type hash and the QoS its publishers offered."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from io import StringIO
from typing import Any

import yaml
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from ruamel.yaml import YAML
from ruamel.yaml.resolver import implicit_resolvers
from softrig_core.kit.resource import prefixes

FOREVER = QosTime(9223372036, 854775807)  # RMW_DURATION_INFINITE


def qos(durability: QosDurability = QosDurability.VOLATILE, depth: int = 10) -> Qos:
    """Give an offered QoS profile: keep last, reliable, no deadline, no lifespan, automatic liveliness."""
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
        """Give a topic with the definition and hash of this ROS distribution, both empty for an unknown type."""
        definition, computed = _definition(msgtype)
        return cls(name, msgtype, definition, digest or computed, tuple(offered))


def absolute(name: str) -> str:
    """Give a topic's name as ROS and a bag write it."""
    return "/" + name.lstrip("/")


def qos_dicts(offered: Sequence[Qos]) -> list[dict[str, Any]]:
    """Give profiles as rosbag2's metadata version 9 writes them: policies by name."""
    return [
        {
            "history": q.history.name.lower(),
            "depth": q.depth,
            "reliability": q.reliability.name.lower(),
            "durability": q.durability.name.lower(),
            "deadline": q.deadline._asdict() | {},
            "lifespan": q.lifespan._asdict() | {},
            "liveliness": q.liveliness.name.lower(),
            "liveliness_lease_duration": q.liveliness_lease_duration._asdict() | {},
            "avoid_ros_namespace_conventions": q.avoid_ros_namespace_conventions,
        }
        for q in offered
    ]


def custom_data(text: str) -> dict[str, str]:
    """Read what the writer of a bag left in its metadata, YAML that may be damaged."""
    try:
        found = YAML(typ="safe").load(str(text or ""))
    except Exception:  # damaged text makes the parser raise whatever it leads to
        return {}
    found = found.get("custom_data") if isinstance(found, dict) else None
    return {str(k): str(v) for k, v in found.items()} if isinstance(found, dict) else {}


def to_yaml(content: Any) -> str:
    """Write plain data as YAML 1.2 in block style, keys in their order."""
    text: str = yaml.dump(content, Dumper=_Dumper, default_flow_style=False, sort_keys=False, width=_WIDTH)
    return _by_ruamel(content) if _OTHERWISE.search(text) else text


_WIDTH = 1 << 16
# what ruamel.yaml, which decides the bytes of bags, quotes or escapes otherwise: quotes in quotes, all beyond ASCII
_OTHERWISE = re.compile(r"[^ ]''|''[^\n]|\\[^n\"\\]|[^\x00-\x7f]")


def _by_ruamel(content: Any) -> str:
    writer = YAML()
    writer.default_flow_style = False
    writer.width = _WIDTH
    text = StringIO()
    writer.dump(content, text)
    return text.getvalue()


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """A twentieth of ruamel.yaml's time, which was most of a short run's for its bag."""

    yaml_implicit_resolvers: dict[str, Any] = {}

    def ignore_aliases(self, data: Any) -> bool:
        """Write everything out."""
        return True


for _versions, _tag, _pattern, _first in implicit_resolvers:
    if (1, 2) in _versions:
        _Dumper.add_implicit_resolver(_tag, _pattern, _first)


def _text(dumper: Any, text: str) -> Any:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"' if "\n" in text else None)


_Dumper.add_representer(str, _text)


@cache
def typestore() -> Typestore:
    """Give the store of the Jazzy message types; `_definition` adds installed types that it lacks."""
    return get_typestore(Stores.ROS2_JAZZY)


def is_known(msgtype: str) -> bool:
    """Return whether a type is defined here: in the library of the Jazzy types, or installed."""
    try:
        return _register(msgtype)
    except (TypesysError, OSError, ValueError):  # an installed text that the library does not read
        return False


@cache
def _definition(msgtype: str) -> tuple[str, str]:
    if not is_known(msgtype):
        return "", ""
    return typestore().generate_msgdef(msgtype, ros_version=2)[0], typestore().hash_rihs01(msgtype)


def _register(msgtype: str) -> bool:
    """Make sure that a type and all types in it are in the store, from the .msg files of the ament prefixes."""
    if msgtype in typestore().fielddefs:
        return True
    package, _, name = msgtype.partition("/msg/")
    for prefix in prefixes():
        path = prefix / "share" / package / "msg" / f"{name}.msg"
        if path.is_file():
            types = get_types_from_msg(path.read_text(), msgtype)
            typestore().register(types)
            return all(_register(t) for t in _nested(types[msgtype][1]))
    return False


def _nested(fields: Any) -> set[str]:
    found = set()
    for _, (_, detail) in fields:
        while not isinstance(detail, str) and not isinstance(detail[0], str):  # an array of something
            detail = detail[0][1]
        name = detail if isinstance(detail, str) else detail[0]
        if "/" in name:
            found.add(name)
    return found
