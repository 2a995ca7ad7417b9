"""The YAML of bags being written: metadata and QoS, byte for byte as ruamel.yaml writes them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from io import StringIO
from typing import Any

import yaml
from rosbags.interfaces import Qos


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
    text: str = yaml.dump(content, Dumper=_dumper(), default_flow_style=False, sort_keys=False, width=_WIDTH)
    return _by_ruamel(content) if _OTHERWISE.search(text) else text


_WIDTH = 1 << 16
# ruamel.yaml decides the bytes of bags; it quotes or escapes these otherwise: quotes in quotes, all beyond ASCII.
_OTHERWISE = re.compile(r"[^ ]''|''[^\n]|\\[^n\"\\]|[^\x00-\x7f]")


def _by_ruamel(content: Any) -> str:
    from ruamel.yaml import YAML

    writer = YAML()
    writer.default_flow_style = False
    writer.width = _WIDTH
    text = StringIO()
    writer.dump(content, text)
    return text.getvalue()


@cache
def _dumper() -> Any:
    """Return a dumper with the rules of ruamel.yaml.

    It needs a twentieth of the time of ruamel.yaml, which was most of what a short run spent on its bag.
    """
    # Imported here, because most processes write no bag.
    from ruamel.yaml.resolver import implicit_resolvers

    class Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
        yaml_implicit_resolvers: dict[str, Any] = {}

        def ignore_aliases(self, data: Any) -> bool:
            return True

    for versions, tag, pattern, first in implicit_resolvers:
        if (1, 2) in versions:
            Dumper.add_implicit_resolver(tag, pattern, first)
    Dumper.add_representer(str, _text)
    return Dumper


def _text(dumper: Any, text: str) -> Any:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"' if "\n" in text else None)
