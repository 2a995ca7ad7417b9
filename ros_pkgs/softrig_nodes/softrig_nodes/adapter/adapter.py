"""What every node does with its step: endpoints, rejected messages, recording, its health, its end.

Its drive, `lockstep.Lockstep` or `realtime.Realtime`, decides when a tick is ready. Nothing here depends on ROS:
messages, timers and clocks come from a `Middleware`.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

from softrig_core.block.block import Block, Plant
from softrig_core.block.change import loads
from softrig_core.block.port import Port
from softrig_core.block.schedule import Schedule
from softrig_core.block.step import Step
from softrig_core.errors import RunError
from softrig_core.rig.options import InputLink, Links, RunOptions
from softrig_core.wire.recording import Sink

from ..seam.buttons import Buttons
from ..seam.endpoint import Input, Output
from ..seam.hold import Hold
from ..seam.middleware import Middleware
from .account import WATCH_PERIOD, Account
from .files import Files, read_files
from .outgoing import Outgoing
from .overheard import OverheardTopics
from .record import Record


class Drive(Protocol):
    """The part of a node that decides when its ticks are ready.

    Attributes
    ----------
    t : int
        Time of the tick under way, ns.
    status_every : int
        Number of watch periods from one status file of a running node to the next.
    """

    status_every: int

    @property
    def t(self) -> int:
        """Time of the current tick, ns."""

    def row(self, port: Port) -> Input:
        """Create the row of an input in the table of senders."""

    def on_matched(self, item: Input) -> None:
        """React to a change of the writers of an input."""

    def now(self) -> int:
        """Time of the rig, ns."""

    def record(self, number: int, data: bytes) -> None:
        """Record a message from outside, with the stamp of the tick that uses it."""

    def settle(self) -> None:
        """Bring the state of the step up to date; see `Link.settle`."""

    def progress(self) -> None:
        """Check for stalls and missing peers; called every `WATCH_PERIOD`."""

    def on_last_message(self) -> None:
        """End the node if, after its last tick, it waited only for this message."""

    def busy(self) -> bool:
        """Return whether peers that wait for this node must extend their timeouts."""

    def counts(self) -> dict[str, int]:
        """Return the counts of the run: cheap enough for every status file."""

    def statistics(self) -> dict[str, Any]:
        """Figures of the run for the last status file."""


def _by_hand(block: Block, options: RunOptions) -> Links:
    """Return the links of a node that was started without a rig; in lockstep it acknowledges its ticks if it may be
    silent.
    """
    if options.mode != "lockstep":
        return Links()
    plant = isinstance(block, Plant)
    silent = all(p.sporadic for p in block.ports(block.p)[1])
    return Links(owns_clock=plant, acknowledges=silent and not plant)


class Adapter:
    """A block as a node.

    Parameters
    ----------
    sink : Sink, optional
        Gets what the node publishes, instead of the file that the options name.
    """

    drive: Drive

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        self.middleware = middleware
        self.block = block
        self.options = options
        self.links = Links.model_validate_json(options.links) if options.links else _by_hand(block, options)
        self.schedule = Schedule(block.p.period, self.links.base or None, options.duration, block.ticks_at_end())
        inputs, outputs = block.ports(block.p)
        self.step = Step(middleware.name, block, self.schedule, inputs, outputs, loads(options.changes))
        self.values = self.step.values
        self.is_plant = isinstance(block, Plant)
        self.namespace = middleware.full_name.rsplit("/", 1)[0]
        self.state: Literal["starting", "running", "done", "failed"] = "starting"
        self.neighbours: Sequence[Adapter] = ()  # the nodes of its process, itself among them
        self.left_early = False  # whether a person has stopped it before its last tick
        self.ticks = 0
        self.epoch = 0  # ns added to a block's time for the stamp on the wire
        self.error: BaseException | None = None
        self.waits_for: list[str] = []  # the nodes whose absence or silence ended the run
        self.absent: list[str] = []  # nodes for which the start waits
        self.lacking: list[str] = []  # topics of external nodes that no node publishes yet
        self.files = self._files()  # files of a node that was restarted
        self.on_finished: Callable[[], None] = lambda: None
        self.account = Account(self)
        self.inputs: list[Input] = []  # inputs from other nodes, in the order of the drive's table
        self.paces: list[Input] = []  # /clock and the ticks of other nodes
        ends = [Output(p, middleware.resolve(p.topic), i) for i, p in enumerate(outputs)]
        # In real time nodes follow the wall clock, so no node publishes /clock.
        owns_clock = self.links.owns_clock and options.mode == "lockstep"
        self.record = Record(self, ends, owns_clock, sink)
        self.overheard = OverheardTopics(self, self.record.overheard)
        self.outgoing = Outgoing(self, ends, owns_clock)
        self.buttons = Buttons(self.values, self._record_press)
        self.pauses = owns_clock or self._may_stand()  # whether people pause the run here
        self.hold = Hold(options.paused, options.pace, owns_clock) if self.pauses else Hold()

    def begin(self, drive: Drive) -> None:
        """Create publishers and subscriptions; `drive` decides when ticks run."""
        self.drive = drive
        self.overheard.subscribe(drive.on_last_message)
        for port in self.step.inputs:
            self._subscribe(drive.row(port))
        self.outgoing.begin()
        self.middleware.timer(WATCH_PERIOD, self.account.watch)

    @property
    def t(self) -> int:
        """Time of the current tick, ns."""
        return self.drive.t

    def of_rig(self, name: str) -> str:
        """Return the full name of a topic of the rig, to which the node's own remapping does not apply."""
        return name if name.startswith("/") else f"{self.namespace}/{name}"

    def _may_stand(self) -> bool:
        """Return whether the node has the clock of a real-time rig that can be paused: all nodes are ours and follow
        it.
        """
        links = self.links
        exclusive = links.owns_clock and links.starter == self.middleware.name and not links.guests
        # With a given epoch there is no common start, and so no topic that announces that the clock is paused.
        return exclusive and self.options.mode == "realtime" and not self.options.epoch

    def _files(self) -> Callable[[], Files] | None:
        links = self.links
        clock = [] if links.clock is None else [links.clock.node]
        names = [*(link.node for link in links.inputs.values()), *clock, *links.acks, *links.tick_readers]
        names += [*(name for readers in links.readers.values() for name in readers), *links.clock_readers]
        again, peers = self.options.again, dict.fromkeys([*names, *links.solvers])
        return (lambda: read_files(Path(again), self.middleware.name, peers)) if again else None

    def _subscribe(self, item: Input) -> None:
        self.inputs.append(item)
        self.middleware.subscribe(item.port.topic, item.port.msgtype, self.overheard.recorded_reader(item))

    def _record_press(self, port: Port, down: bool) -> None:
        if self.record.sink is not None and port.name in self.record.foreign:
            self.drive.record(self.record.foreign[port.name], port.layout().encode(0, (down,)))

    def peer(self, link: InputLink) -> Schedule:
        """Return the schedule of a peer."""
        return Schedule(link.period, self.schedule.clock, self.options.duration, link.at_end)

    # its end ----------------------------------------------------------------------------------------------------

    def fail(self, text: str) -> None:
        """End the run with an error."""
        # Errors after the first one are its consequences.
        if self.error is None:
            self.error = RunError(text)
        self.finish("failed")

    def broke(self, error: RunError) -> None:
        """End the run because the block failed or returned an invalid output; log one line, and the stack of a bug."""
        cause = error.__cause__
        # Arithmetic errors come from values that diverge, where the stack of the block's code explains nothing.
        if cause is not None and not isinstance(cause, ArithmeticError):
            traceback.print_exception(cause)
        self.fail(str(error).removeprefix(f"{self.step.name}: "))

    def finish(self, state: Literal["done", "failed"] = "done") -> None:
        """Stop."""
        self.state = state
        self.on_finished()
