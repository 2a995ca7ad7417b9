"""Reader of a bag's metadata.yaml, of any version: its statements are later compared with the bag's files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from softrig_core import ScenarioError
from softrig_core.scenario.yaml_file import bounded

from ..content.topics import FOREVER
from .source import Damaged

LIMIT = 1 << 24
_DEFAULTS: dict[str, Any] = {
    "history": QosHistory.KEEP_LAST,
    "reliability": QosReliability.RELIABLE,
    "durability": QosDurability.VOLATILE,
    "liveliness": QosLiveliness.AUTOMATIC,
}


@dataclass(frozen=True)
class Stated:
    """A topic as listed in the metadata."""

    name: str
    msgtype: str
    encoding: str
    count: int
    offered: Any
    digest: str


@dataclass(frozen=True)
class Metadata:
    """The contents of the metadata.

    Parameters
    ----------
    version : int
        Of rosbag2's metadata format; 0 if it is not stated.
    files : list of str
        Names of the storage files.
    count : int
        Number of messages in the bag; None if it is not stated.
    """

    version: int = 0
    files: list[str] = field(default_factory=list)
    topics: list[Stated] = field(default_factory=list)
    count: int | None = None
    custom_data: dict[str, str] = field(default_factory=dict)
    distribution: str = ""


def loaded(text: str | bytes) -> Any:
    """Read YAML with all scalars as texts: a time or a truth value stays text.

    Raises
    ------
    yaml.YAMLError
    ScenarioError
        Its depth, or the size of its expanded aliases, is beyond that of any metadata of a bag.
    """
    # Without aliases no text has more values than characters.
    return bounded(text, getattr(yaml, "CBaseLoader", yaml.BaseLoader), len(text))


def read_metadata(path: Path) -> Metadata:
    """Read metadata.yaml.

    Raises
    ------
    Damaged
        It is not YAML, or its entries have types that no version of rosbag2 writes.
    """
    if path.stat().st_size > LIMIT:
        raise Damaged(f"metadata.yaml is longer than {LIMIT} bytes")
    try:
        content = loaded(path.read_bytes())
        return parsed(content["rosbag2_bagfile_information"])
    except (yaml.YAMLError, UnicodeError, ScenarioError) as error:
        raise Damaged(f"metadata.yaml is no YAML: {' '.join(str(error).split())[:200]}") from None
    except KeyError as error:
        raise Damaged(f"metadata.yaml is not that of a bag: it has no {error.args[0]}") from None
    except (TypeError, AttributeError):
        raise Damaged("metadata.yaml is not that of a bag: expected the fields that rosbag2 writes") from None


def embedded(text: str) -> Metadata:
    """Read the copy that rosbag2 keeps in a storage file; a copy that cannot be read yields empty metadata."""
    try:
        result = loaded(text)
        return parsed(result) if isinstance(result, dict) else Metadata()
    except (yaml.YAMLError, Damaged, KeyError, TypeError, AttributeError, ScenarioError):
        return Metadata()


def parsed(about: Mapping[str, Any]) -> Metadata:
    """Convert the fields of the metadata to `Metadata`."""
    custom = about.get("custom_data", "")
    if not isinstance(custom, dict) and custom not in ("", "null", "~"):
        raise Damaged(f"metadata.yaml: custom_data is {custom!r}"[:100] + ", expected a mapping")
    topics = []
    for entry in about.get("topics_with_message_count") or []:
        topic = entry["topic_metadata"]
        name, msgtype = topic["name"], topic["type"]
        if not isinstance(name, str) or not isinstance(msgtype, str):
            raise Damaged(f"metadata.yaml: topic {name!r} of type {msgtype!r}"[:100] + ", expected names")
        count = _number(f"messages on {name}", entry.get("message_count", 0))
        offered, digest = topic.get("offered_qos_profiles", ""), topic.get("type_description_hash", "")
        topics.append(Stated(name, msgtype, topic.get("serialization_format", "cdr"), count, offered, str(digest)))
    files = about.get("relative_file_paths") or [f["path"] for f in about.get("files") or []]
    return Metadata(
        _number("version", about.get("version", 0)),
        [str(name) for name in files],
        topics,
        _number("messages", about["message_count"]) if "message_count" in about else None,
        {str(k): str(v) for k, v in custom.items()} if isinstance(custom, dict) else {},
        str(about.get("ros_distro", "")),
    )


def _number(name: str, text: Any) -> int:
    try:
        number = int(text)
    except (TypeError, ValueError):
        number = -1
    if not 0 <= number < 1 << 63:
        raise Damaged(f"metadata.yaml: {name}: {text!r}"[:100] + ", expected a whole number of 64 bits")
    return number


def profiles(offered: Any) -> tuple[Qos, ...]:
    """Return the QoS profiles that publishers offered, from a YAML text or a list.

    Before version 9 policies are numbers. A missing or unknown policy gets the default that rclcpp offers. A text that
    is not a list of profiles yields no profiles.
    """
    return _profiles_in(offered) if isinstance(offered, str) else _profiles(offered)


# Most topics of a bag have the same text.
@lru_cache(maxsize=64)
def _profiles_in(text: str) -> tuple[Qos, ...]:
    try:
        return _profiles(loaded(text))
    except (yaml.YAMLError, ScenarioError):
        return ()


def _profiles(items: Any) -> tuple[Qos, ...]:
    return tuple(_profile(item) for item in items or [] if isinstance(item, dict))


def _profile(item: Mapping[str, Any]) -> Qos:
    depth = str(item.get("depth", ""))
    history, reliability, durability, liveliness = (_policy(item, name) for name in _DEFAULTS)
    times = [_time(item.get(name)) for name in ("deadline", "lifespan", "liveliness_lease_duration")]
    plain = str(item.get("avoid_ros_namespace_conventions", "")).lower() == "true"
    # A text of 19 digits may exceed 64 bits; such a depth is due to damage.
    number = int(depth) if depth.isdecimal() and len(depth) < 19 else 10
    return Qos(history, number, reliability, durability, times[0], times[1], liveliness, times[2], plain)


def _policy(item: Mapping[str, Any], name: str) -> Any:
    default = _DEFAULTS[name]
    if name not in item:
        return default
    kind, text = type(default), str(item[name])
    numbers = {str(policy.value): policy for policy in kind}
    return numbers.get(text) or kind.__members__.get(text.upper(), kind.UNKNOWN)


def _time(value: Any) -> QosTime:
    if not isinstance(value, dict):
        return FOREVER
    seconds, remaining = (str(value.get(name, "")) for name in ("sec", "nsec"))
    good = seconds.isdecimal() and remaining.isdecimal() and len(seconds) < 19 and len(remaining) < 19
    return QosTime(int(seconds), int(remaining)) if good else FOREVER


def custom_data(text: str) -> dict[str, str]:
    """Read the custom data in a bag's metadata, which may be damaged YAML."""
    try:
        result = loaded(str(text or ""))
    # The text may be damaged, and then the parser may raise anything.
    except Exception:
        return {}
    result = result.get("custom_data") if isinstance(result, dict) else None
    return {str(k): str(v) for k, v in result.items()} if isinstance(result, dict) else {}
