"""YAML as this suite reads it: YAML 1.2 scalars, no duplicate keys, bounded size, depth and aliases."""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from ..errors import ScenarioError

# The C parser and emitter where PyYAML was built with them.
_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_BaseDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

SIZE = 1 << 20  # bytes
DEPTH = 40
NODES = 100_000  # values after the aliases are expanded


# A quoted text may have these as escapes ("\\e"); a terminal obeys them, and XML has none.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


class _Loader(_Base):  # type: ignore[misc]
    """Plain data only; numbers and words as in YAML 1.2 (``1e-5`` is a number, ``on`` a word)."""

    yaml_implicit_resolvers: dict[str, Any] = {}

    def construct_scalar(self, node: Any) -> Any:
        """Refuse control characters."""
        text = super().construct_scalar(node)
        if not text.isprintable() and _CONTROL.search(text):
            raise yaml.constructor.ConstructorError(
                None, None, f"control character in {text[:60]!r}; remove it", node.start_mark
            )
        return text

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Refuse repeated keys."""
        seen = set()
        for key_node, value_node in node.value:
            merges = key_node.tag == "tag:yaml.org,2002:merge"
            key = "<<" if merges else self.construct_object(key_node, deep=True)
            self.check_value(node, key, value_node)
            if not isinstance(key, Hashable):
                raise yaml.constructor.ConstructorError(None, None, "a key is not a plain word", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"duplicate key {key!r}", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)

    def check_value(self, mapping: Any, key: Any, node: Any) -> None:
        """Refuse a key without a value in braces: {x: 1,5} is an x of 1 and a key 5, which would remove nothing."""
        if mapping.flow_style and getattr(node, "value", 0) == "" and not node.style:
            message = f"key {key!r} has no value; a decimal comma? write a point, or null"
            raise yaml.constructor.ConstructorError(None, None, message, mapping.start_mark)


class _Texts(_Loader):
    """All scalars are texts; the caller checks which are missing."""

    yaml_implicit_resolvers: dict[str, Any] = {}

    def check_value(self, mapping: Any, key: Any, node: Any) -> None:
        """Accept a key without a value."""


class _Dumper(_BaseDumper):  # type: ignore[misc]
    """Quotes what YAML 1.1 or `_Loader` would not read as the text that it is: ``1e5`` is a text of YAML 1.1."""


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
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), list(_first))


def _integer(loader: Any, node: Any) -> int:
    text = loader.construct_scalar(node)
    digits = text.lstrip("+-")
    if digits[0] == "0" and len(digits) > 1 and digits.isdecimal():
        # YAML 1.1, ROS and C take it for an octal number, YAML 1.2 for a decimal one.
        message = f"{text} may be octal; write {int(text)}, or 0o and the digits of an octal number"
        raise yaml.constructor.ConstructorError(None, None, message, node.start_mark)
    return int(text, 0 if text[:2] in ("0x", "0o") else 10)


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def read_yaml(text: str, source: str, texts: bool = False) -> Any:
    """Read one YAML document.

    Parameters
    ----------
    source : str
        Its name in error messages, such as the file's name.
    texts : bool
        Whether all scalars are texts, for readers that have their own numbers.

    Raises
    ------
    ScenarioError
        Not YAML, a key twice, larger than `SIZE`, deeper than `DEPTH` or more than `NODES` values.
    """
    if len(text) > SIZE:
        raise ScenarioError(f"{source}: {len(text)} characters, expected at most {SIZE}")
    try:
        return bounded(text, _Texts if texts else _Loader, NODES)
    except yaml.MarkedYAMLError as error:
        message = ", ".join(part for part in (error.context, error.problem) if part)
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark and "\n" in text else ""
        raise ScenarioError(f"{source}: not valid YAML: {line}{message}"[:200]) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ScenarioError(f"{source}: not valid YAML: {reason}") from None


def bounded(text: str | bytes, kind: Any, most: int) -> Any:
    """Read one YAML document of bounded depth and number of values.

    Parameters
    ----------
    kind : type
        Loader of PyYAML.
    most : int
        Values after all aliases are expanded.

    Raises
    ------
    ScenarioError
        Deeper than `DEPTH`, or more values.
    yaml.YAMLError
        Not YAML.
    """
    _limit_depth(text, kind)  # the C parser recurses on its own stack: too late once it composes
    loader = kind(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _count(node, most)
        return loader.construct_document(node)
    finally:
        loader.dispose()


def write_yaml(content: Any) -> str:
    """Write plain data so that `read_yaml` returns it, keys in their order."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=110, allow_unicode=True))


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


def _limit_depth(text: str | bytes, kind: Any) -> None:
    depth = 0
    for event in yaml.parse(text, kind):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEPTH:
                raise ScenarioError(f"nested deeper than {DEPTH} levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1


def _count(root: Any, most: int) -> None:
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
        if sizes[id(node)] > most:
            raise ScenarioError(f"more than {most} values once its aliases are expanded")
        return sizes[id(node)]

    size(root)
