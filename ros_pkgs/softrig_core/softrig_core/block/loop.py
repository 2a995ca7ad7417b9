"""Definition of a tick in all placements: `doc/tick.md` shows the source of these functions.

`answer` and `move` answer a node's first tick. For all later ticks `bound.py` generates the same code with the node's
names in it, which runs in half the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

from ..errors import FAILURES, ScenarioError
from .schedule import Plan

if TYPE_CHECKING:
    from .step import Step

# Who is due repeats after a round of ticks. In a longer round than this it is computed at each tick, so that the kept
# lists stay small.
KNOWN = 10_000
YOUNG = 200_000  # new objects between two searches for reference cycles: what a tick makes dies with it


def answer(step: Step, t: int) -> None:
    """Answer a tick: a plant publishes its outputs, any other block reads its inputs and answers.

    Raises
    ------
    RunError
        The block failed or returned an invalid value; `node` of the error is the name of the step.
    """
    step.t = t
    try:
        x, result = step.asked(t)  # apply parameter changes that are due; call update, outputs, finish or refused
        rows = step.checked(result)  # size, finite, within Port.limits
        step.x, step.last_answer = x, rows
    except FAILURES as error:
        step.fail(error)
    step.store_reports()  # the answer was accepted, so the block's reports of this tick count
    step.hand_on(t, rows)  # first to the inputs that they fill in this process, then to the link
    if not step.plant and step.link is not None:
        step.link.over(t)


def move(step: Step, t: int, values: Mapping[str, Any] | None = None) -> None:
    """Advance a plant from a tick over one period, with the held inputs or with other values.

    Raises
    ------
    RunError
        See `answer`.
    """
    step.t = t
    try:
        step.x = step.move(step.x, t, **(step.values if values is None else values))
    except FAILURES as error:
        step.fail(error)
    step.store_reports()
    if step.link is not None:
        step.link.over(t)


class Named(Protocol):
    """A node of a rig, in any form."""

    name: str


Node = TypeVar("Node", bound=Named)
Act = Literal["outputs", "update", "advance"]  # the method of a block that a node calls


def acts(nodes: Sequence[Any], is_plant: Callable[[Any], bool]) -> list[tuple[Any, Act]]:
    """Return the actions of a rig's nodes at a tick, in order: plants publish, then the others answer, then plants
    move.

    Parameters
    ----------
    nodes : sequence
        In the order of `in_order`.
    """
    plants, others = ([node for node in nodes if is_plant(node) is kind] for kind in (True, False))
    # Outputs of a plant never depend on inputs of the same tick, so plants can publish first and move last.
    order: list[tuple[Act, list[Any]]] = [("outputs", plants), ("update", others), ("advance", plants)]
    return [(node, act) for act, members in order for node in members]


def in_order(
    nodes: Sequence[Node], is_plant: Callable[[Node], bool], sources: Callable[[Node], Iterable[Node]]
) -> list[Node]:
    """Return nodes in the order in which they answer a tick: plants first, then each other one after its sources.

    Raises
    ------
    ScenarioError
        Nodes that are no plants read each other in a cycle; the error names them.
    """
    done = [node for node in nodes if is_plant(node)]
    path: list[Node] = []

    def visit(node: Node) -> None:
        if node in done:
            return
        if node in path:
            cycle = " -> ".join(member.name for member in [*path[path.index(node) :], node])
            raise ScenarioError(f"cycle without a plant in it: {cycle}; no tick could ever be answered")
        path.append(node)
        for source in sources(node):
            visit(source)
        path.pop()
        done.append(node)

    for node in nodes:
        visit(node)
    return done


class Loop:
    """The members of a rig that live in this process: all of them, some, or one.

    Parameters
    ----------
    steps : sequence of Step
        In the order of `in_order`. Their schedules have one clock and end together.
    """

    def __init__(self, steps: Sequence[Step]) -> None:
        self.steps, self.plan = tuple(steps), Plan(s.schedule for s in steps)
        # After so many ticks the same members are due again.
        self._again = math.lcm(*(self.plan.every(s.schedule) for s in self.steps))
        self._known: dict[int, tuple[list[Step], list[Step]]] = {}

    def run(self, first: int = 0) -> Iterator[int | None]:
        """Answer tick after tick.

        Parameters
        ----------
        first : int
            Tick to begin with, where the members are in the state of then.

        Yields
        ------
        int or None
            The time of a tick that is over, ns; None again and again while the next one to answer lacks something.

        Raises
        ------
        RunError
            A block failed or returned an invalid value.
        """
        plan = self.plan
        # From this tick on a member that is due may have had its last tick, or a plant may not move any more.
        ends = math.inf if plan.ticks is None else plan.ticks - self._again
        for k in count(first) if plan.ticks is None else range(first, plan.ticks + 1):
            t = plan.clock.time(k)
            plants, others = self._known.get(k % self._again) or self._due(k)
            for plant in plants:
                plant.answer(t)
            # At the end only plants, observers and blocks with a last word answer (`Schedule.at_end`). Before it that
            # is not asked: a question for each member and tick costs as much as a quick law.
            lacking = _answer(others if k < ends else [s for s in others if plan.answers(s.schedule, k)], t)
            # A message that a step lacks may depend on an answer from here, so control returns to the caller each time.
            while lacking:
                yield None
                lacking = _answer(lacking, t)
            for plant in plants:
                if k < ends or plan.moves(plant.schedule, k):
                    while plant.waits and plant.waits.lacks(t):
                        yield None
                    plant.advance(t)
            yield t

    def _due(self, k: int) -> tuple[list[Step], list[Step]]:
        """Return the plants that are due at a tick, and the others."""
        due = [s for s in self.steps if self.plan.due(s.schedule, k)]
        result = [s for s in due if s.plant], [s for s in due if not s.plant]
        if self._again <= KNOWN:
            self._known[k % self._again] = result
        return result


def _answer(steps: Sequence[Step], t: int) -> list[Step]:
    """Answer with all steps that have their inputs; return the others."""
    lacking: list[Step] = []
    for step in steps:
        # A step that reads from a step of this process that has not answered yet must wait for it, too.
        behind = lacking and any(fill.source in lacking for fill in step.fed.values())
        if behind or (step.waits and step.waits.lacks(t)):
            lacking.append(step)
        else:
            step.answer(t)
    return lacking
