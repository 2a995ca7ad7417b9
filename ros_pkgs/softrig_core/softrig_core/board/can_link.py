"""A node on a CAN bus: its inputs are sent at each tick as the signals of a DBC, and its answer is published."""

from __future__ import annotations

import atexit
import hashlib
import math
import os
import time
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..block.block import Block, Level, Plant
from ..block.params import flatten
from ..errors import RunError, ScenarioError
from ..extras import need
from .dbc import NUMBERS, WHAT, Frame, decoded, encoded, frames_of
from .elsewhere import LinkState
from .entry import CAN, LinkEntry
from .layout import Layout
from .line import PATIENCE, REMEMBERED, Counts
from .link import PART, Linked, LinkedLaw, LinkedPlant, linked

Row = tuple[float, ...]


class CanLine:
    """Requests to one node on a bus and its answers.

    Parameters
    ----------
    port : str
        For errors.
    bus : can.BusABC
    frames : (list of Frame, list of Frame)
        To the node and from it.
    timeout : float
        s until a lockstep request is sent again; age in s of an answer without number that is still used.
    """

    def __init__(self, port: str, bus: Any, frames: tuple[list[Frame], list[Frame]], timeout: float) -> None:
        self.port, self.timeout, self.counts = port, timeout, Counts()
        self.limited: list[str] = []
        self.served: tuple[int, Row, Row] | None = None
        self._bus = bus
        self._to, back = frames
        self._echoes = back[0].numbered
        self._from = {(f.message.frame_id, f.message.is_extended_frame): f for f in back}
        self._parts: dict[tuple[int, bool], Mapping[int, float]] = {}  # of the answer that is awaited
        self._heard: dict[tuple[int, bool], float] = {}
        self._missing: dict[int, None] = {}
        bus.set_filters([{"can_id": i, "can_mask": 0x1FFFFFFF if x else 0x7FF, "extended": x} for i, x in self._from])

    def paired(self, k: int, row: Row) -> Row:
        """Return the answer to tick k of a lockstep run; the request is repeated until it comes.

        Raises
        ------
        RunError
            There is no answer, or the tick is an earlier one.
        """
        if not self._echoes:
            raise RunError(f"{self.port}: the node's messages have no signal tick, which lockstep needs")
        if self.served is not None and self.served[:2] == (k, row):
            return self.served[2]
        if k and (self.served is None or k != self.served[0] + 1):
            raise RunError(f"the node at {self.port} cannot go back to an earlier tick: its state is not known here")
        if k == 0:
            self._pump(None, 0.0)  # answers to a run before this one
        number = _number(k)
        for attempt in range(PATIENCE):
            self.counts.repeated += attempt > 0
            self._parts.clear()
            self._send(number, row)
            if self._await(number, time.monotonic() + self.timeout):
                answer = self._answer()
                self.served = k, row, answer
                return answer
        raise RunError(f"no node answers tick {k} at {self.port} within {PATIENCE * self.timeout:g} s")

    def live(self, k: int, row: Row, wait: float) -> Row | None:
        """Return the answer to tick k if it comes within `wait` s; of a node that echoes no number, the newest."""
        number = _number(k)
        if self._echoes:
            self._pump(None, 0.0)
            self._parts.clear()
            self._send(number, row)
            if self._await(number, time.monotonic() + wait):
                return self._answer()
            self._missing[number] = None
            while len(self._missing) > REMEMBERED:
                del self._missing[next(iter(self._missing))]
        else:
            self._send(number, row)
            self._pump(None, 0.0)
            oldest = min((self._heard.get(key, -math.inf) for key in self._from), default=-math.inf)
            if time.monotonic() - oldest <= self.timeout:
                return self._answer()
        self.counts.lost += 1
        return None

    def _send(self, number: int, row: Row) -> None:
        import can

        self.limited = []
        for frame in self._to:
            data, limited = encoded(frame, number, row)
            self.limited += limited
            self.counts.sent += 1
            extended = frame.message.is_extended_frame
            try:
                self._bus.send(
                    can.Message(arbitration_id=frame.message.frame_id, is_extended_id=extended, data=data), self.timeout
                )
            except can.CanError:  # the bus is off or its queue is full: the frame is lost, as if it had been disturbed
                self.counts.damaged += 1

    def _await(self, number: int, end: float) -> bool:
        """Return whether all messages of an answer have come until a time."""
        while len(self._parts) < len(self._from):
            if not self._pump(number, max(end - time.monotonic(), 0.0)) and time.monotonic() >= end:
                return False
        return True

    def _pump(self, number: int | None, wait: float) -> bool:
        """Take the frames that have come; wait for the first one when a number is awaited."""
        import can

        taken = False
        while not taken or number is None:
            try:
                message = self._bus.recv(wait)
            except can.CanError:
                self.counts.damaged += 1
                return taken
            if message is None:
                return taken
            taken = True
            self._take((message.arbitration_id, message.is_extended_id), message, number)
        return taken

    def _take(self, key: tuple[int, bool], message: Any, number: int | None) -> None:
        frame = self._from.get(key)
        if frame is None or message.is_error_frame or message.is_remote_frame:
            return
        read = decoded(frame, bytes(message.data))
        if read is None or not all(map(math.isfinite, read[1].values())):
            self.counts.damaged += 1
            return
        theirs, values = read
        if theirs is None or theirs == number:
            self._parts[key] = values
            self._heard[key] = time.monotonic()
        elif theirs in self._missing:
            del self._missing[theirs]
            self.counts.late += 1
            self.counts.lost -= 1
        else:
            self.counts.strays += 1

    def _answer(self) -> Row:
        found = {place: value for part in self._parts.values() for place, value in part.items()}
        return tuple(found[place] for place in range(len(found)))


def _number(k: int) -> int:
    """Return the number of tick k on the bus: only the first tick of a run has 0."""
    return (k - 1) % NUMBERS + 1 if k else 0


class OverCan(Linked):
    """Answers each tick by what a node on a CAN bus sends; the DBC takes the place of the firmware's description."""

    def setup(self) -> None:
        """Read the DBC; the bus is opened with the first tick."""
        Block.setup(self)
        self._lines: list[Any] = []
        inputs, outputs = self.ports(self.p)
        self._layout = Layout(inputs, outputs, {}, isinstance(self, Plant), False)
        self._frames = frames_of(Path(self.ENTRY.firmware), self.name, inputs, outputs)
        self._safe = {p.name: p.safe for p in outputs if not p.sporadic}
        self._delayed = frozenset()

    @classmethod
    def fixed(cls, params: Any) -> Any:
        """Return all parameters: the node on the bus has its own."""
        return flatten(params)

    @classmethod
    def contents(cls, params: Any) -> Mapping[str, str]:
        """Return the digest of the DBC."""
        return {"dbc": hashlib.sha256(Path(cls.ENTRY.firmware).read_bytes()).hexdigest()}

    def _connected(self, x: LinkState) -> CanLine:
        """Return the line, made anew where the block is at its first state."""
        if not self._lines or (x.k == 0 and self._lines[0].served is not None):
            bus = _bus(self.ENTRY, self.name)
            self._lines[:] = [CanLine(self.ENTRY.port, bus, self._frames, self.ENTRY.timeout)]
        return self._lines[0]

    def _heard(self, line: Any, x: LinkState, row: list[Any]) -> tuple[Any, ...] | None:
        """Return status and outputs; the times of a tick are not transmitted, the node counts its own."""
        numbers = tuple(map(float, row[3 if self._layout.plant else 1 :]))
        wait = min(self.ENTRY.timeout, PART * self.p.period)
        answer = line.live(x.k, numbers, wait) if self.realtime else line.paired(x.k, numbers)
        if line.limited:
            self.report(Level.WARN, "limited", f"{', '.join(line.limited)} limited to the range in the DBC")
        return None if answer is None else (0, *answer)


class CanLaw(OverCan, LinkedLaw):
    """A controller on a bus."""


class CanPlant(OverCan, LinkedPlant):
    """A plant on a bus: a request has the inputs of the tick before, and its answer the outputs of this one."""


def attached(block: type[Block], entry: LinkEntry, params: Any, where: str) -> type[Block]:
    """Return the class of a node that runs on a board or on a CAN bus; see `linked`.

    Raises
    ------
    ScenarioError
        The firmware or the DBC cannot be read or does not fit, or the block has a last answer at the end of a run.
    """
    if not entry.port.startswith(CAN):
        return linked(block, entry, params, where)
    if issubclass(block, Linked):  # of a rig that is made again, with other parameters
        block = block.__bases__[1]
    if not Path(entry.firmware).is_file():
        raise ScenarioError(f"{where}: link: {entry.firmware}: there is no such file; `softrig export dbc` writes it")
    if block.finishes():
        raise ScenarioError(f"{where}: a block with a last answer at the end of a run cannot run on a CAN bus")
    absolute = entry.model_copy(update={"firmware": str(Path(entry.firmware).resolve())})
    return _class(block, absolute)  # type: ignore[arg-type]  # mypy: a class has no hash


@lru_cache(maxsize=64)
def _class(block: type[Block], entry: LinkEntry) -> type[Block]:
    base = CanPlant if issubclass(block, Plant) else CanLaw
    body = {"ENTRY": entry, "__module__": block.__module__, "__doc__": block.__doc__}
    return type(block.__name__, (base, block), body | {"__qualname__": block.__qualname__})


_buses: dict[tuple[int, str, int | None, str], Any] = {}  # of this process: a node opens its bus once


def _bus(entry: LinkEntry, node: str) -> Any:
    """Return the open bus of a node.

    Raises
    ------
    RunError
        It cannot be opened.
    """
    need("can", WHAT)
    import can

    key = os.getpid(), entry.port, entry.baud, node
    if key not in _buses:
        interface, _, channel = entry.port.removeprefix(CAN).partition("/")
        rate: dict[str, Any] = {} if entry.baud is None else {"bitrate": entry.baud}
        try:
            _buses[key] = can.Bus(interface=interface, channel=channel, **rate)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise RunError(f"the bus {entry.port} cannot be opened: {error}") from None
        atexit.register(_buses[key].shutdown)
    return _buses[key]
