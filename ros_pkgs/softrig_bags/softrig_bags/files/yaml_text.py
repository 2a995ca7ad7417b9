"""The YAML of bags being written: metadata and QoS, byte for byte as ruamel.yaml writes them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import StringIO
from typing import Any

import yaml
from rosbags.interfaces import Qos
from ruamel.yaml import YAML
from ruamel.yaml.resolver import implicit_resolvers


def qos_dicts(offered: Sequence[Qos]) -> list[dict[str, Any]]:
    """Return profiles as rosbag2's metadata version 9 writes them: policies by name."""
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


def to_yaml(content: Any) -> str:
    """Write plain data as YAML 1.2 in block style, keys in their order."""
    text: str = yaml.dump(content, Dumper=_Dumper, default_flow_style=False, sort_keys=False, width=_WIDTH)
    return _by_ruamel(content) if _OTHERWISE.search(text) else text


_WIDTH = 1 << 16
# ruamel.yaml decides the bytes of bags; it quotes or escapes these otherwise: quotes in quotes, all beyond ASCII.
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
