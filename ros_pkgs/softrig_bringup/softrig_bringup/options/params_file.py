"""Parameters of nodes from a parameter file of ROS, read as rcl reads it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from softrig_core import ScenarioError
from softrig_core.errors import closest
from softrig_core.guard import print_line
from softrig_core.kit.file_format import FileFormat
from softrig_core.scenario.yaml_file import read_yaml

PARAMS_FILE = FileFormat(
    "the parameter file of ROS",
    "rcl_yaml_param_parser of ROS 2 Jazzy",
    {
        "NODE": (
            "used",
            "full name of a node, with or without the first slash; sections of other nodes are skipped and reported",
        ),
        "NAMESPACE: {NODE: ...}": ("used", "the same as NAMESPACE/NODE; also in several levels"),
        "/*": ("used", "one part of a name"),
        "/**": ("used", "any number of parts; a node skips the parameters that it does not have"),
        "several sections for one node": ("used", "in the order of the file; the last value counts"),
        "ros__parameters": ("used", "names dotted or nested"),
        "true, yes, on, y; false, no, off, n": ("used", "bool; capital letters are allowed, as in rcl"),
        "whole and real numbers": ("used", "as C reads them: 0x10 is 16, 010 is 8, .nan and .inf are floats"),
        "other words": ("used", "text"),
        "lists": ("used", "all elements have one type"),
        "use_sim_time": ("ignored", "the rig sets the time"),
        "start_type_description_service": ("ignored", "belongs to the ROS node, not to the block"),
        "qos_overrides": ("ignored", "belongs to the ROS node, not to the block"),
        "run": ("ignored", "the rig sets it"),
        "null": ("refused", "for a node of the rig: rcl reads it as the text 'null', which no number may be"),
        "anchors and aliases": ("refused", "rcl refuses them"),
        "tags (!!str)": ("refused", "quotes make a text"),
        "a name of several parts inside another, with more after it": ("refused", "rcl misreads what follows"),
        "several documents": ("refused", "write one"),
        "lists of several kinds": ("refused", "rcl refuses them"),
        "a key twice": ("refused", "only one of the values would count"),
    },
)
OF_ROS = tuple(name for name, (use, _) in PARAMS_FILE.table.items() if use == "ignored")
_TOKEN = re.compile(r"[A-Za-z_]\w*|\*\*?", re.ASCII)
_INT = re.compile(r"[+-]?(?:0[xX][0-9a-fA-F]+|[0-9]+)")
_REAL = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?inf(?:inity)?|[+-]?nan", re.IGNORECASE)
_SPECIAL = re.compile(r"\.(?:nan|NaN|NAN)|[+-]?\.(?:inf|Inf|INF)")
_NULL = ("~", "null", "Null", "NULL")
_BOOL = {
    variant: value
    for value, words in ((True, ("true", "yes", "on")), (False, ("false", "no", "off")))
    for word in words
    for variant in (word, word.capitalize(), word.upper())
} | {"y": True, "Y": True, "n": False, "N": False}


class Unfit(NamedTuple):
    """A value that rcl reads but no node accepts: refused if it is for a node of the rig."""

    reason: str


def params_of(
    file: Path, nodes: Iterable[str], namespace: str = "", has: Callable[[str, str], bool] = lambda node, name: True
) -> dict[str, Any]:
    """Return the parameters of a file in the form of `load_scenario`'s changes: by ``node.parameter``.

    Those that every ROS node has are left out, and so are ``run.*``, which the rig sets.

    Parameters
    ----------
    file : Path
        See `PARAMS_FILE`.
    nodes : iterable of str
        Of the scenario.
    namespace : str
        In which the nodes run.
    has : callable
        Returns whether a node has a parameter; called for values that a wildcard assigns to several nodes.

    Raises
    ------
    ScenarioError
        The file cannot be read, has another form, or has no section for a node of the scenario.
    """
    nodes = list(nodes)
    full = {node: f"/{namespace.strip('/')}/{node}".replace("//", "/") for node in nodes}
    sections = read_sections(file)
    result: dict[str, Any] = {}
    unmatched = []
    for pattern, values in sections.items():
        meant = [node for node in nodes if matches(pattern, full[node])]
        params = {name: value for name, value in values.items() if name.partition(".")[0] not in OF_ROS}
        if not meant:
            unmatched.append(pattern)
        for name, value in params.items():
            takers = [node for node in meant if "*" not in pattern or has(node, name)]
            if takers and type(value) is Unfit:
                raise ScenarioError(value.reason)
            if meant and not takers:
                raise ScenarioError(f"params file {file}: {pattern}: none of its nodes has a parameter {name!r}")
            result |= {f"{node}.{name}": value for node in takers}
    if unmatched and len(unmatched) == len(sections):
        near = next((text for name in unmatched if (text := closest(name, full.values()))), "")
        if any(name.rpartition("/")[2] in nodes for name in unmatched):
            near = " (of another namespace: --namespace NS)"
        raise ScenarioError(
            f"params file {file}: {', '.join(unmatched)}: no such node{near}; the nodes are {', '.join(full.values())}"
        )
    if unmatched:
        print_line(f"params file {file}: ignored entries of nodes that this rig does not have: {', '.join(unmatched)}")
    return result


def matches(pattern: str, name: str) -> bool:
    """Return whether the name of a section matches a node by the rules of rcl; both are full names."""
    wild = {"**": r"(/\w+)*", "*": r"/\w+"}
    parts = (wild.get(part, f"/{re.escape(part)}") for part in pattern[1:].split("/"))
    return re.fullmatch("".join(parts), name, re.ASCII) is not None


def read_sections(file: Path) -> dict[str, dict[str, Any]]:
    """Read a parameter file: full names of nodes, or patterns, to names of parameters to values, in its order.

    Raises
    ------
    ScenarioError
        Not YAML, or something that rcl refuses.
    """
    source = f"params file {file}"
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{source}: {getattr(error, 'strerror', None) or error}") from None
    read_yaml(text, str(file), texts=True)  # refuses values out of bounds, repeated keys and text that is not YAML
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ScenarioError(f"{source}: it has an alias (*name), which rcl refuses; write the values out")
        if (tag := getattr(event, "tag", None)) is not None:
            line = event.start_mark.line + 1
            raise ScenarioError(f"{source}, line {line}: it has the tag {tag}; write text in quotes, all else without")
    root = yaml.compose(text, yaml.SafeLoader)
    if not isinstance(root, yaml.MappingNode):
        raise ScenarioError(f"{source}: expected NODE: {{ros__parameters: {{NAME: VALUE}}}}")
    result: dict[str, dict[str, Any]] = {}
    for name, values in _nodes(root, "", source):
        result.setdefault(name, {}).update(values)
    return result


def _nodes(branch: yaml.MappingNode, above: str, source: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    over, lost = False, ""
    for key, value in branch.value:
        name, line = str(key.value), key.start_mark.line + 1
        if over:
            raise ScenarioError(
                f"{source}, line {line}: rcl refuses {name!r} after ros__parameters; write it before that"
            )
        if lost:  # rcl 9.2 removes only one part of its path at the end of a section, even if the key has several
            raise ScenarioError(
                f"{source}, line {line}: rcl misreads {name!r} after {lost!r}, a name of several parts inside another; "
                "write both in full at the left margin"
            )
        if name == "ros__parameters":
            if not above or not isinstance(value, yaml.MappingNode):
                raise ScenarioError(f"{source}, line {line}: expected NODE: {{ros__parameters: {{NAME: VALUE}}}}")
            if above.endswith("/"):
                raise ScenarioError(
                    f"{source}, line {line}: {above!r} is not a name of a node, expected no slash at its end"
                )
            yield above, dict(_values(value, "", source))
            over = True
            continue
        path = name if name.startswith("/") and not above else f"{above.removesuffix('/')}/{name}"
        if above and "/" in name.strip("/") + name[-1:]:
            lost = name
        if isinstance(value, yaml.MappingNode) and not value.value:
            continue  # rcl checks only names of sections that are not empty
        if not all(map(_TOKEN.fullmatch, path.removesuffix("/").split("/")[1:])):
            raise ScenarioError(f"{source}, line {line}: {path!r} is not a name of a node or namespace")
        if not isinstance(value, yaml.MappingNode):
            raise ScenarioError(f"{source}, line {line}: {name}: expected ros__parameters: {{NAME: VALUE}}")
        yield from _nodes(value, path, source)


def _values(branch: yaml.MappingNode, above: str, source: str) -> Iterator[tuple[str, Any]]:
    for key, value in branch.value:
        name = f"{above}{key.value}"
        if isinstance(value, yaml.MappingNode):
            if not value.value:
                raise ScenarioError(f"{source}: {name} is an empty map; give a value, or leave the line out")
            yield from _values(value, f"{name}.", source)
        elif isinstance(value, yaml.SequenceNode):
            items = [_scalar(item, f"{source}: {name}") for item in value.value]
            if len({str if type(item) is Unfit else type(item) for item in items}) > 1:
                raise ScenarioError(f"{source}: {name} is a list of several kinds, which rcl refuses")
            yield name, next((item for item in items if type(item) is Unfit), items)
        else:
            yield name, _scalar(value, f"{source}: {name}")


def _scalar(node: yaml.Node, source: str) -> bool | int | float | str | Unfit:
    """Read a value as rcl does: quoted values are text, and C reads the numbers."""
    if not isinstance(node, yaml.ScalarNode):
        raise ScenarioError(f"{source}: a list of lists or maps, which a parameter cannot hold")
    text = str(node.value)
    if node.style is not None and node.style != "":
        return text
    if not text:
        raise ScenarioError(f"{source} has no value, which rcl refuses; give one, or leave the line out")
    if text in _NULL:
        return Unfit(f"{source} is null: a node refuses it; give a value, or leave the line out")
    if text in _BOOL:
        return _BOOL[text]
    number = _number(text)
    return text if number is None else number


def _number(text: str) -> int | float | None:
    if _INT.fullmatch(text):
        digits = text.lstrip("+-")
        octal = digits[0] == "0" and len(digits) > 1 and digits[1] not in "xX"
        if not octal or set(digits) <= set("01234567"):
            value = int(text, 8 if octal else 0)
            if -(2**63) <= value < 2**63:
                return value
    if _SPECIAL.fullmatch(text):
        return float(text.replace(".", ""))
    if _REAL.fullmatch(text):
        real = float(text)
        overflown = real in (float("inf"), float("-inf")) and "inf" not in text.lower()
        return None if overflown else real
    return None
