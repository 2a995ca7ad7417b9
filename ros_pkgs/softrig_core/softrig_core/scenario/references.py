"""References in scenario files: ``$name`` is a shared value, ``$node.parameter`` a parameter of a node."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from ..block.params import flattened, known
from ..errors import ScenarioError
from .scenario_file import SHARED, Over, merge
from .yaml_file import NODES

DEEPEST = 200  # values in each other, and references that lead to references
_PLAIN = frozenset({float, int, bool, type(None)})  # values that contain no reference
_PARAMETER = re.compile(r"\$([A-Za-z_]\w*)\.([\w.]+)")


def fill(value: Any, shared: Mapping[str, Any]) -> Any:
    """Copy plain data with every string ``$name`` (keys of mappings too) replaced by its shared value.

    Strings ``$node.parameter`` are left for `fill_parameters`; ``$$`` is a literal dollar sign.

    Parameters
    ----------
    value : any
        Mappings, lists and scalars as parsed from YAML; also changes that override parts of a reference (`Over`).
    shared : mapping
        Shared values by name.

    Raises
    ------
    ScenarioError
        There is no such shared value, one refers to itself, or there are more than `NODES` values or more than
        `DEEPEST` levels.
    """
    count, depth = 1, 0

    def known(name: str, path: tuple[str, ...]) -> Any:
        if name in path:
            raise ScenarioError(f"shared value {name} refers to itself: {' -> '.join((*path, name))}")
        if name not in shared:
            have = f"the shared values are {', '.join(shared)}" if shared else "there are no shared values"
            raise ScenarioError(f"${name}: {have}")
        return copy(shared[name], (*path, name))

    def copy(value: Any, path: tuple[str, ...]) -> Any:
        nonlocal count, depth
        if type(value) in _PLAIN or (type(value) is str and value[:1] != "$"):  # most of a file
            return value
        count += len(value) if isinstance(value, list | tuple) else 2 * len(value) if isinstance(value, Mapping) else 0
        depth += 1
        if count > NODES or depth > DEEPEST:
            limit = f"{NODES} values" if count > NODES else f"{DEEPEST} values in each other"
            through = f" (by {' -> '.join(path[:5])}{' -> ...' if len(path) > 5 else ''})" if path else ""
            raise ScenarioError(f"its $ references make more than {limit}{through}; expected fewer references")
        result = copied(value, path)
        depth -= 1
        return result

    def copied(value: Any, path: tuple[str, ...]) -> Any:
        if isinstance(value, str):
            match = SHARED.fullmatch(value) if value[:1] == "$" else None
            return known(match[1], path) if match else value
        if isinstance(value, Over):
            below = copy(value.below, path)
            for change in value.changes:
                below = merge(below if isinstance(below, Mapping) else {}, copy(change, path))
            return below
        if isinstance(value, Mapping):
            return {copy(k, path) if isinstance(k, str) else k: copy(v, path) for k, v in value.items()}
        return [copy(v, path) for v in value] if isinstance(value, list | tuple) else value

    return copy(value, ())


def fill_parameters(value: Any, parameter: Callable[[str, str], Any]) -> Any:
    """Copy plain data with each ``$node.parameter`` replaced by the result of `parameter`.

    Parameters
    ----------
    value : any
        Plain data.
    parameter : callable
        Returns a value for the name of a node and the dotted name of its parameter.

    Raises
    ------
    ScenarioError
        The values inserted for references are more than `NODES`.
    """
    count = 0

    def copy(value: Any) -> Any:
        nonlocal count
        if isinstance(value, str):
            if value[:1] != "$":
                return value
            match = _PARAMETER.fullmatch(value)
            if match:
                result = parameter(match[1], match[2])
                count += len(result) if isinstance(result, list | tuple | dict) else 1
                if count > NODES:
                    raise ScenarioError(f"{value}: its $ references make more than {NODES} values; expected fewer")
                return result
            return value[1:] if value.startswith("$$") else value
        if type(value) in _PLAIN:
            return value
        if isinstance(value, Mapping):
            return {k: copy(v) for k, v in value.items()}
        return [copy(v) for v in value] if isinstance(value, list | tuple) else value

    return copy(value)


def pick(values: Mapping[str, Any], name: str) -> Any:
    """Return a parameter by its dotted name, a group of them, or one element of a list by its number: ``times.0``.

    Parameters
    ----------
    values : mapping
        Parameters by dotted name.
    name : str
        Which, ``times.0`` for the first element of the list ``times``, ``motors`` for all ``motors.NAME`` by name.

    Raises
    ------
    KeyError
        No such parameter or element.
    """
    if name in values:
        return values[name]
    group = {key.removeprefix(f"{name}."): value for key, value in values.items() if key.startswith(f"{name}.")}
    if group:
        return group
    head, _, last = name.rpartition(".")
    if head in values and last.isdigit() and int(last) < len(values[head]):
        return values[head][int(last)]
    raise KeyError(name)


def parameter_of(context: str, nodes: Mapping[str, Any], params: Callable[[str], Any], node: str, name: str) -> Any:
    """Return the value of ``$node.parameter``; `params` returns the parameters of a node.

    The name may also be a value that is `derived` from the parameters.

    Raises
    ------
    ScenarioError
        There is no such node or parameter; the message begins with `context`.
    """
    if node not in nodes:
        raise ScenarioError(f"{context}${node}.{name}: the nodes are {', '.join(nodes)}")
    parameters = params(node)
    try:
        return pick(flattened(parameters), name)  # derived parameters take longer to find
    except KeyError:
        pass
    values = known(parameters)
    try:
        return pick(values, name)
    except KeyError:
        raise ScenarioError(f"{context}${node}.{name}: {node} has {', '.join(values)}") from None
