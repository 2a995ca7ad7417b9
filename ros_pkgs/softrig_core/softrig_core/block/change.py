"""Changes of parameters while a block runs: checked as at the start, applied all or none, between two ticks."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from .params import BlockParams, ParameterError, build, declarations, flatten

if TYPE_CHECKING:
    from .block import Block
    from .port import Port


@runtime_checkable
class Fixing(Protocol):
    """A block with ``live`` parameters that may not change while it runs, such as some variables of an FMU."""

    @classmethod
    def fixed(cls, params: Any) -> Any:
        """Return the part of the ports that must not change, for comparison."""


class Change(NamedTuple):
    """New values of parameters.

    Parameters
    ----------
    at : int
        ns; it takes effect at the first tick of its node that is not earlier.
    values : mapping
        Value by dotted name.
    """

    at: int
    values: Mapping[str, Any]


def dumps(changes: Iterable[Change]) -> str:
    """Write changes as JSON, ``[[ns, {name: value}], ...]``; empty without changes."""
    results = [[change.at, dict(change.values)] for change in changes]
    return json.dumps(results) if results else ""


def loads(text: str) -> list[Change]:
    """Read the text of `dumps`.

    Raises
    ------
    ParameterError
        Something else.
    """
    try:
        return [Change(int(t), dict(values)) for t, values in json.loads(text or "[]")]
    except (ValueError, TypeError) as error:
        raise ParameterError(f"changes: expected [[ns, {{name: value}}], ...]: {error}") from None


def changeable(model: type[BlockParams]) -> list[str]:
    """Name the parameters that are declared ``live=True``."""
    return [d.name for d in declarations(model) if d.live]


def revise(params: BlockParams, values: Mapping[str, Any]) -> BlockParams:
    """Return a copy of the parameters with other values.

    Raises
    ------
    ParameterError
        One of them is unknown, may not change while running, or does not fit; names it.
    """
    known, free = flatten(params), changeable(type(params))
    for name in values:
        if name in known and name not in free:
            hint = f"these may: {', '.join(free)}" if free else "none of this block's may"
            raise ParameterError(f"parameter {name} may not change while running; {hint}")
    revised: Any = build(type(params), known | dict(values))
    return revised  # type: ignore[no-any-return]


def _known_to_others(ports: tuple[tuple[Port, ...], tuple[Port, ...]]) -> list[list[Port]]:
    """Return the properties of ports that other nodes rely on; the safe value of a held port is not one of them."""
    return [[replace(p, safe=()) if p.held and not p.partial else p for p in side] for side in ports]


def permit(block_class: type[Block], params: BlockParams, values: Mapping[str, Any], name: str = "") -> BlockParams:
    """Ensure that a block could start with the changed parameters, and that its ports would still fit the rig.

    Parameters
    ----------
    params : BlockParams
        As they are.
    values : mapping
        Value by dotted name.
    name : str
        Of the node.

    Returns
    -------
    BlockParams
        The changed parameters.

    Raises
    ------
    ParameterError
        See `revise`; or the block cannot be set up with them, its ports would change, or a quantity on which the nodes
        of its rig must agree would change.
    """
    revised = revise(params, values)
    # Some errors appear only in `setup`, so a second block is set up: the running one must stay as it is if it fails.
    block_class(revised, name)
    names = ", ".join(values)
    if _known_to_others(block_class.ports(revised)) != _known_to_others(block_class.ports(params)):
        raise ParameterError(f"{names}: this would change the ports, which is impossible during a run")
    if issubclass(block_class, Fixing) and block_class.fixed(revised) != block_class.fixed(params):
        raise ParameterError(f"{names}: this part cannot change during a run")
    # The rig was checked with the agreed values of all its nodes; a change of one would contradict the others.
    before, after = block_class.agreed(params), block_class.agreed(revised)
    if changed := [key for key in after if before.get(key) != after[key]]:
        raise ParameterError(f"{names}: {changed[0]} would change, but all nodes of a rig must agree on it")
    return revised
