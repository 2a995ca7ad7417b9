"""A block whose ticks are answered by a third-party node that uses /clock and does not copy stamps."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, ClassVar, Literal

from pydantic import Field

from ..block.block import Block, Plant
from ..block.port import Port
from ..entry import Entry
from ..errors import RunError, ScenarioError
from ..runners import find_runner
from .elsewhere import Elsewhere, LinkState

WAITS = "waits for its external node"  # part of each report, so that code that reads a process's log can find it


class ClockEntry(Entry):
    """The entry of a third-party node that answers by its own timer, or once for each message.

    Parameters
    ----------
    answers : {"clock"}
        The node publishes one message an output and period, without the stamp of the message that it answers.
    first : float, optional
        Time of its first message, s: one period for a timer (the default), 0 for a node that answers each message.
    reads : list of str, optional
        The topics that it subscribes to, in the order in which their messages are sent to it at each tick. The message
        that triggers the answer must be the last. All topics of the executable when absent.
    publishes : list of str, optional
        The topics that it publishes; all topics of the executable when absent.
    timeout : float
        Wall-clock time in s after which a missing message ends the run.
    start_timeout : float
        Wall-clock time in s after which a missing node ends the run at the start.
    """

    answers: Literal["clock"]
    first: float | None = Field(None, ge=0.0)
    reads: tuple[str, ...] | None = None
    publishes: tuple[str, ...] | None = None
    timeout: float = Field(10.0, gt=0.0, le=1e6)
    start_timeout: float = Field(300.0, gt=0.0, le=1e6)


class Clocked(Elsewhere):
    """Answers each tick by what a node publishes when its clock is advanced to it."""

    ENTRY: ClassVar[ClockEntry]
    SCRATCH = frozenset({"_guests"})  # the connection to the node, of which there is one at most

    @classmethod
    def ports(cls, params: Any) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return those of the executable that the node has."""
        inputs, outputs = super().ports(params)
        return _chosen(inputs, cls.ENTRY.reads), _chosen(outputs, cls.ENTRY.publishes)

    def setup(self) -> None:
        """Prepare; the node is waited for with the first tick."""
        super().setup()
        self._guests: list[Any] = []

    def save(self, x: LinkState) -> Any:
        """Refuse: the state is in the node.

        Raises
        ------
        RunError
        """
        raise RunError(f"{self.name}: its state is in the node in namespace /{self.name} and cannot be saved")

    def health(self, x: LinkState) -> Mapping[str, str]:
        """Return which node answers."""
        return {"answers": self._guests[0].full_name if self._guests else "not there yet"}

    def update(self, x: LinkState, t: int, **inputs: Any) -> tuple[LinkState, Mapping[str, Any]]:
        """Set the inputs, advance the node's clock to t, and return its answer.

        Raises
        ------
        RunError
            It publishes nothing, twice, or what cannot be read; names it and the topic.
        """
        if self.realtime:
            raise RunError("answers: clock is for lockstep; in real time use external: true")
        if not self._guests:
            reads, says = self.ports(self.p)
            self._guests.append(find_runner("guest")(self.name, reads, says, self.ENTRY))
        period = self.p.period
        begins = period if self.ENTRY.first is None else self.ENTRY.first
        answers = t / 1e9 >= begins - 0.5 * period
        result = self._guests[0].ask(t, inputs, answers)
        safe = {p.name: p.safe for p in self.ports(self.p)[1] if not p.sporadic}
        return LinkState(x.k + 1), result if answers else safe


def clocked(block: type[Block], entry: ClockEntry, params: Any, label: str) -> type[Block]:
    """Return the class of a node whose ticks are answered by a third-party node.

    Raises
    ------
    ScenarioError
        It is a plant, or has ports of kinds that such a node cannot have, or `reads` contains a name that is no input.
    """
    if issubclass(block, Clocked):  # the rig may be made again with other parameters
        return block
    inputs, outputs = block.ports(params)
    if issubclass(block, Plant):
        raise ScenarioError(
            f"{label}: external: clock is for controllers, because a plant owns the clock; use external: true"
        )
    used = (*_used(inputs, entry.reads), *_used(outputs, entry.publishes))
    if odd := [p.topic for p in used if p.delayed or p.sporadic or p.partial or p.dims]:
        raise ScenarioError(
            f"{label}: external: {odd[0]} is delayed, sporadic, partial or an array, which a node that answers by the "
            "clock cannot have"
        )
    for word, chosen, ports in (("reads", entry.reads, inputs), ("publishes", entry.publishes, outputs)):
        topics = [p.topic for p in ports]
        if wrong := [topic for topic in chosen or () if topic not in topics]:
            raise ScenarioError(f"{label}: external: {word} {wrong[0]!r}, but the executable has {', '.join(topics)}")
    return _class(block, entry)  # type: ignore[arg-type]  # mypy: a class has no hash


def _used(ports: tuple[Port, ...], topics: tuple[str, ...] | None) -> list[Port]:
    return [port for port in ports if topics is None or port.topic in topics]


def _chosen(ports: tuple[Port, ...], topics: tuple[str, ...] | None) -> tuple[Port, ...]:
    by_topic = {port.topic: port for port in ports}
    return ports if topics is None else tuple(by_topic[topic] for topic in topics)


@lru_cache(maxsize=64)
def _class(block: type[Block], entry: ClockEntry) -> type[Block]:
    body = {"ENTRY": entry, "__module__": block.__module__, "__doc__": block.__doc__}
    return type(block.__name__, (Clocked, block), body | {"__qualname__": block.__qualname__})
