"""Changes of parameters that a scenario makes during the run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Protocol

from pydantic import Field

from ..block.block import Block
from ..block.change import Change, permit
from ..block.params import ParameterError
from ..entry import Entry
from ..errors import ScenarioError, closest
from ..timebase import to_ns
from .faults import EXECUTABLE, PACKAGE, WORDS
from .references import fill_parameters, parameter_of


class ChangeEntry(Entry):
    """New values of parameters from a time on.

    Parameters
    ----------
    at : float
        In s. Each node applies its changes at its first tick that is not earlier.
    set : dict
        ``node.parameter`` to value; of a fault, ``fault.active``. ``$node.parameter`` is what a parameter is at first.
    """

    at: float = Field(ge=0, le=1e9)
    set: dict[str, Any] = Field(min_length=1)


class Changing(Protocol):
    """Protocol of a member whose parameters change."""

    name: str
    package: str
    executable: str
    block_class: type[Block]
    params: Any
    external: bool
    changes: tuple[Change, ...]


def script(source: str, entries: Sequence[ChangeEntry], members: Iterable[Changing]) -> None:
    """Return each node's changes in the order of their times, each checked after those before it.

    Parameters
    ----------
    source : str
        Name of the scenario, for errors.
    members : iterable
        The nodes of the rig.

    Raises
    ------
    ScenarioError
        There is no such node, the node is external, or `softrig_core.block.change.permit` refuses the values.
    """
    known = {m.name: m for m in members}
    first = {m.name: m.params for m in known.values()}
    now = dict(first)
    for entry in sorted(entries, key=lambda e: e.at):
        context = f"{source}: change at {entry.at:g} s"
        at_start = partial(parameter_of, f"{context}: ", first, first.__getitem__)
        by_node: dict[str, dict[str, Any]] = {}
        for key, value in entry.set.items():
            node, _, parameter = key.partition(".")
            if node not in known or not parameter:
                near = "" if node in known else closest(node, known)
                raise ScenarioError(
                    f"{context}: {key!r}{near}: expected node.parameter with node one of {', '.join(known)}"
                )
            if (known[node].package, known[node].executable) == (PACKAGE, EXECUTABLE):
                parameter = WORDS.get(parameter, parameter)
            by_node.setdefault(node, {})[parameter] = fill_parameters(value, at_start)
        for node, values in by_node.items():
            member = known[node]
            if member.external:
                raise ScenarioError(f"{context}: node {node} is external: softrig cannot change its parameters")
            try:
                now[node] = permit(member.block_class, now[node], values, node)
            except (ParameterError, ValueError) as error:
                raise ScenarioError(f"{context}: node {node}: {error}") from None
            member.changes = (*member.changes, Change(to_ns(entry.at), values))
