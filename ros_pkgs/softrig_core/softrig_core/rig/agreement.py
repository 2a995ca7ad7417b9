"""Check that nodes of a rig agree on common quantities: a certificate with its loop, a figure with its network."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

from ..block.block import Block
from ..errors import ScenarioError, blaming
from ..kit.newest import once_for_objects


class Named(Protocol):
    """The attributes that are needed of a member."""

    name: str
    block_class: type[Block]
    params: Any


@once_for_objects
def agreed(block: type[Block], params: Any) -> Mapping[str, Any]:
    """Return the values that a block declares by `Block.agreed`."""
    with blaming(f"`agreed` of {block.__name__}"):
        return block.agreed(params)


def require_agreement(context: str, members: Iterable[Named]) -> None:
    """Compare the values that the blocks declare by `Block.agreed`.

    Parameters
    ----------
    context : str
        Name of the scenario, for the message.
    members : iterable
        The nodes of the rig.

    Raises
    ------
    ScenarioError
        Two nodes have different values of a quantity; the error names it, both nodes and both values.
    """
    members = list(members)
    quantities = agreed_values(members)
    for member in members:
        for quantity, value in agreed(member.block_class, member.params).items():
            node, known = quantities[quantity]
            if not _same(known, value):
                raise ScenarioError(
                    f"{context}: {node} and {member.name} must agree on {quantity}, but {node} has {shown(known)} and "
                    f"{member.name} has {shown(value)}; a shared value or ${node}.PARAMETER keeps them together"
                )


@runtime_checkable
class Assuming(Protocol):
    """A block that computes with quantities of another node, such as the lengths of the robot that it moves."""

    @classmethod
    def assumed(cls, params: Any) -> Mapping[str, Any]:
        """Return the values this block assumes for other nodes, keys as in `Block.agreed`.

        A mismatch is an experiment: it is allowed, and reported once.
        """


def assumptions(members: Iterable[Named]) -> list[str]:
    """Describe which nodes have wrong assumptions about others, by `Assuming.assumed`, in one line each."""
    members = list(members)
    stated = agreed_values(members)
    return [
        f"{member.name} takes {quantity} to be {shown(value)}, {stated[quantity][0]} has {shown(stated[quantity][1])}"
        for member in members
        if issubclass(member.block_class, Assuming)
        for quantity, value in member.block_class.assumed(member.params).items()
        if quantity in stated and not _same(stated[quantity][1], value)
    ]


def agreed_values(members: Iterable[Named]) -> dict[str, tuple[str, Any]]:
    """Return the values of `Block.agreed`: each quantity with the first node that declares it, and its value."""
    messages: dict[str, tuple[str, Any]] = {}
    for member in members:
        for quantity, value in agreed(member.block_class, member.params).items():
            messages.setdefault(quantity, (member.name, value))
    return messages


def agreeing(
    values: Mapping[str, tuple[str, Any]], arguments: Mapping[str, Any], agreed: Mapping[str, str]
) -> dict[str, Any]:
    """Fill in arguments of a figure with the values that the nodes of its rig declare.

    Parameters
    ----------
    values : mapping of quantity to (node, value)
        See `agreed_values`.
    arguments : mapping
        Arguments from the scenario.
    agreed : mapping of argument to quantity
        What the figure's function declares; a quantity that no node declares leaves its argument unchanged.

    Raises
    ------
    ScenarioError
        An argument has another value than the node's; the error names both.
    """
    filled = dict(arguments)
    for name, quantity in agreed.items():
        if quantity not in values:
            if name not in arguments:
                raise ScenarioError(f"argument {name} is missing, since no node of the rig defines its {quantity}")
            continue
        node, value = values[quantity]
        if not _same(filled.setdefault(name, value), value):
            raise ScenarioError(
                f"argument {name} = {shown(filled[name])}, but {node} has {shown(value)}; "
                f"leave it out and it is taken from there"
            )
    return filled


def _same(a: Any, b: Any) -> bool:
    """Compare with a tolerance for the last digits of a product."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float | int) and isinstance(b, float | int):
        return math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-300)
    return bool(a == b)


def shown(value: Any) -> str:
    """Return a value as messages have it, a long one cut."""
    text = f"{value:.12g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 100 else f"{text[:100]} ..."
