"""YAML as this suite reads it: YAML 1.2 scalars, no duplicate keys, bounded size, depth and aliases."""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from ..errors import ScenarioError

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the C parser where PyYAML was built with it

SIZE = 1 << 20  # bytes
DEPTH = 40
NODES = 100_000  # values after the aliases are expanded


class _Loader(_Base):  # type: ignore[misc]
    """Plain data only; numbers and words as in YAML 1.2 (``1e-5`` is a number, ``on`` a word)."""

    yaml_implicit_resolvers: dict[str, Any] = {}

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Refuse repeated keys."""
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise yaml.constructor.ConstructorError(None, None, "a key is no plain word", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"duplicate key {key!r}", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


for _tag, _pattern, _first in (
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("int", r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$", "-+0123456789"),
    (
        "float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)"
        r"|\.(?:nan|NaN|NAN))$",
        "-+0123456789.",
    ),
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("merge", r"^(?:<<)$", "<"),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), list(_first))


def _integer(loader: Any, node: Any) -> int:
    text = loader.construct_scalar(node)
    return int(text, 0 if text[:2] in ("0x", "0o") else 10)


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def read_yaml(text: str, where: str) -> Any:
    """Read one YAML document.

    Parameters
    ----------
    where : str
        What error messages call it, such as the file's name.

    Raises
    ------
    ScenarioError
        Not YAML, a key twice, larger than `SIZE`, deeper than `DEPTH` or more than `NODES` values.
    """
    if len(text) > SIZE:
        raise ScenarioError(f"{where}: {len(text)} characters, expected at most {SIZE}")
    loader = None
    try:
        _limit_depth(text)  # the C parser recurses on its own stack: too late once it composes
        loader = _Loader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _count(node)
        return loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        message = ", ".join(part for part in (error.context, error.problem) if part)
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark and "\n" in text else ""
        raise ScenarioError(f"{where}: not valid YAML: {line}{message}"[:200]) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ScenarioError(f"{where}: not valid YAML: {reason}") from None
    finally:
        if loader is not None:
            loader.dispose()


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a file whose keys are the fields of something.

    Raises
    ------
    ScenarioError
        No text in UTF-8, see `read_yaml`, or no mapping; names the file.
    """
    try:
        raw = read_yaml(path.read_text(encoding="utf-8"), path.name)
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path.name}: not valid YAML: {error}") from None
    if not isinstance(raw, dict):
        raise ScenarioError(f"{path.name}: expected a mapping of keys, got {type(raw).__name__}")
    return raw


def compose(text: str) -> Any:
    """Return the nodes of a document that `read_yaml` has read, with their line numbers."""
    return yaml.compose(text, _Loader)


def _limit_depth(text: str) -> None:
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEPTH:
                raise ScenarioError(f"nested deeper than {DEPTH} levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1


def _count(root: Any) -> None:
    """Count the values as they are after all aliases are expanded, each node once."""
    sizes: dict[int, int] = {}
    open_nodes: set[int] = set()

    def size(node: Any) -> int:
        if id(node) in open_nodes:
            raise ScenarioError("an alias is inside its own anchor")
        if id(node) not in sizes:
            open_nodes.add(id(node))
            children: list[Any] = []
            if isinstance(node, yaml.MappingNode):
                children = [part for pair in node.value for part in pair]
            elif isinstance(node, yaml.SequenceNode):
                children = node.value
            sizes[id(node)] = 1 + sum(size(child) for child in children)
            open_nodes.discard(id(node))
        if sizes[id(node)] > NODES:
            raise ScenarioError(f"more than {NODES} values once its aliases are expanded")
        return sizes[id(node)]

    size(root)
