"""Inputs and answers of a node in a run, call by call: the reference for its C code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..block.block import Block, Plant
from ..block.loop import Loop
from ..block.params import flatten
from ..block.step import Step
from ..errors import ScenarioError, closest
from ..kit.newest import Newest
from ..rig.members import Member
from ..rig.rig import Rig
from ..run.inprocess import check_here, wired

LAW, PLANT = ("update",), ("outputs", "advance")


@dataclass(frozen=True)
class Call:
    """One call of a block's method.

    Parameters
    ----------
    t : int
        Time, ns.
    x : state
        Before it.
    inputs : mapping of str to values
    after : state
        After it; the same where the method does not move it.
    outputs : mapping of str to values
        What it published; empty for `advance`.
    kept : tuple
        What each kept answer of the block (`Newest`) was asked for last; None: not yet.
    late : frozenset of str
        Inputs without a new message at this time.
    """

    method: str
    t: int
    x: Any
    inputs: Mapping[str, Any]
    after: Any
    outputs: Mapping[str, Any]
    kept: tuple[Any, ...] = ()
    late: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Changed:
    """Live parameters that changed between two calls.

    Parameters
    ----------
    t : int
        Time, ns.
    values : mapping of str to object
        All parameters from then on, flattened.
    names : frozenset of str
        Those that changed.
    moved : bool
        Whether the state changed with them (`Block.go_on`).
    """

    t: int
    values: Mapping[str, Any]
    names: frozenset[str]
    moved: bool


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
    """Return the methods by which a block is called."""
    return PLANT if isinstance(block, Plant) else LAW


def kept_of(block: Block) -> list[Newest[Any, Any]]:
    """Return the cached answers of a block; C has only the one that is stored after the first calls."""
    return [value for value in vars(block).values() if isinstance(value, Newest)]


def keys_of(block: Block) -> tuple[Any, ...]:
    """Return the argument for which each kept answer of a block was last computed."""
    return tuple(newest.key for newest in kept_of(block))


def golden_calls(rig: Rig, node: str, seed: int, most: int) -> list[Call | Changed]:
    """Run a rig in this process, tick by tick in Python, and return the calls of one node and changes between them.

    Parameters
    ----------
    most : int
        The run ends after so many calls.
    """
    member_of(rig, node)
    blocks = {m.name: m.block(seed) for m in rig.members}
    calls: list[Call | Changed] = []
    steps = wired(rig, blocks)
    watched(steps[node], calls)
    for _ in Loop(list(steps.values())).run():
        if len(calls) >= most:
            break
    return calls[:most]


def watched(step: Step, calls: list[Call | Changed]) -> None:
    """Record the calls of a step's block and its parameter changes in a list; call this before its first tick."""
    for name in methods(step.block):
        _watch(step.block, name, calls)
    _watch_changes(step, calls)


def answer_of(method: str, x: Any, value: Any) -> tuple[Any, Mapping[str, Any]]:
    """Return the state after a call and the published values, from the result of the method."""
    after, outputs = value if method == "update" else (x, value) if method == "outputs" else (value, {})
    return after, outputs


def _watch_changes(step: Step, calls: list[Call | Changed]) -> None:
    change, block = step.change, step.block

    def watched(params: Any) -> None:
        before, x = flatten(block.p), step.x
        change(params)
        now = flatten(block.p)
        names = frozenset(name for name, value in now.items() if value != before[name])
        calls.append(Changed(step.t, now, names, type(block).go_on is not Block.go_on and step.x != x))

    setattr(step, "change", watched)  # noqa: B010 - of this step alone


def _watch(block: Block, name: str, calls: list[Call | Changed]) -> None:
    method = getattr(block, name)

    def watched(x: Any, t: int, **inputs: Any) -> Any:
        late = frozenset(port for port in inputs if block.age(port) != 0)
        result = method(x, t, **inputs)
        calls.append(Call(name, t, x, dict(inputs), *answer_of(name, x, result), keys_of(block), late))
        return result

    setattr(block, name, watched)
