"""What a node was asked and answered in a run, call by call: the reference of its C code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..block.block import Block, Plant
from ..block.loop import Loop
from ..errors import ScenarioError, closest
from ..rig.members import Member
from ..rig.rig import Rig
from ..run.inprocess import check_here, wired

LAW, PLANT = ("update",), ("outputs", "advance")


@dataclass(frozen=True)
class Call:
    """One call of a block's method.

    Parameters
    ----------
    method : str
    t : int
        Time, ns.
    x : state
        Before it.
    inputs : mapping of str to values
    after : state
        After it; the same where the method does not move it.
    outputs : mapping of str to values
        What it published; empty for `advance`.
    """

    method: str
    t: int
    x: Any
    inputs: Mapping[str, Any]
    after: Any
    outputs: Mapping[str, Any]


def member_of(rig: Rig, node: str) -> Member:
    """Return a node of a rig.

    Raises
    ------
    ScenarioError
        There is none of that name, or its code is elsewhere.
    """
    members = {m.name: m for m in rig.members}
    if node not in members:
        raise ScenarioError(
            f"{rig.scenario.name} has no node {node!r}{closest(node, members)}; it has {', '.join(members)}"
        )
    check_here(rig)
    return members[node]


def methods(block: Block) -> tuple[str, ...]:
    """Return the methods by which a block is asked."""
    return PLANT if isinstance(block, Plant) else LAW


def golden_calls(rig: Rig, node: str, seed: int, most: int) -> list[Call]:
    """Run a rig in this process, tick by tick in Python, and return the calls of one node.

    Parameters
    ----------
    most : int
        The run ends after so many calls; it also ends before the first change of the node's parameters.
    """
    member = member_of(rig, node)
    blocks = {m.name: m.block(seed) for m in rig.members}
    block, calls = blocks[node], list[Call]()
    for name in methods(block):
        _watch(block, name, calls)
    steps = wired(rig, blocks)
    until = member.changes[0].at if member.changes else None
    for t in Loop(list(steps.values())).run():
        if len(calls) >= most or (until is not None and t is not None and t >= until):
            break
    return [c for c in calls[:most] if until is None or c.t < until]


def answer_of(method: str, x: Any, found: Any) -> tuple[Any, Mapping[str, Any]]:
    """Return the state after a call and what it published, of what the method returned."""
    after, outputs = found if method == "update" else (x, found) if method == "outputs" else (found, {})
    return after, outputs


def _watch(block: Block, name: str, calls: list[Call]) -> None:
    method = getattr(block, name)

    def watched(x: Any, t: int, **inputs: Any) -> Any:
        found = method(x, t, **inputs)
        calls.append(Call(name, t, x, dict(inputs), *answer_of(name, x, found)))
        return found

    setattr(block, name, watched)
