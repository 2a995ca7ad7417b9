"""Requests to one node on a CAN bus and its answers, as the signals of a DBC."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from ..errors import RunError, ScenarioError
from ..extras import need
from .dbc import NUMBERS, RUN, TICK, WHAT, Frame, Messages, decoded, encoded, messages_of
from .entry import CAN, LinkEntry
from .frames import Kind
from .line import PATIENCE, REOPEN, Build
from .remote import RemoteLine

RUNS = 1 << 8
PAUSE = 0.0005  # s to wait after an unreadable line, because the next one may be unreadable, too
MOST = 500  # frames between two ticks: some 10 ms of work
Key = tuple[int, bool]
Parts = dict[Key, dict[int, float]]


class CanLine(RemoteLine):
    """Requests to one node on a bus and its answers.

    Parameters
    ----------
    port : str
        Name of the port, for errors.
    opened : callable
        Opens the bus; raises OSError if that fails now, ScenarioError if it can never succeed.
    clock, sleep : callable
        Return the time in s, and sleep for a time in s.
    """

    def __init__(
        self,
        port: str,
        opened: Callable[[], Any],
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        super().__init__(port, opened, clock, sleep)
        self._run = int.from_bytes(os.urandom(1), "little")
        self._limited: dict[str, None] = {}

    def use(self, messages: Messages, build: Build, timeout: float) -> Self:
        """Begin with messages, a build and a timeout, and return the line.

        Parameters
        ----------
        build : Build
            Another one is refused.
        timeout : float
            s until a lockstep request is sent again; age in s of values without number that are still used.
        """
        self.build, self.timeout, self._messages = build, timeout, messages
        self._back: dict[Key, Frame] = {frame.key: frame for frame in messages.back}
        self._filter()
        self.begin(b"")
        return self

    def begin(self, params: bytes) -> None:
        """Begin a run with the next request; the node has its own parameters, so `params` is empty."""
        self._run = (self._run + 1) % RUNS
        self._tick = -1
        self._parts: Parts = {}  # parts of the awaited or newest answer
        self._received_at: dict[Key, float] = {}
        self._missing.clear()
        self._ready: int | None = None  # the build that the node has reported
        self._asked = -math.inf  # when the node was asked for its build
        self.joined = self._messages.ready is None

    def remarks(self) -> str:
        """Describe unusual events; empty if there were none."""
        limited = f"limited to the range in the DBC: {', '.join(self._limited)}" if self._limited else ""
        return "; ".join(filter(None, (self.counts.remarks(), limited)))

    def ask(self, kind: Kind, values: bytes) -> bytes:
        """Send the inputs of the next tick until they are answered, and return the answer.

        Raises
        ------
        RunError
            There is no answer, the node has another build, or the bus cannot be opened.
        """
        if self._messages.ready is None:
            raise RunError(f"{self.port}: the node's messages have no {TICK} and {RUN}, which lockstep needs")
        self._opened.patient = True
        end = self._clock() + PATIENCE * self.timeout
        while not self.joined and self._clock() < end:
            self._join(self._clock() + self.timeout)
        if not self.joined:
            raise RunError(self._why or f"no node answers at {self.port} within {PATIENCE * self.timeout:g} s")
        self._next()
        row = self._row(values)
        for attempt in range(PATIENCE):
            self.counts.repeated += attempt > 0
            self._send(row)
            if self._await(self._complete, self._clock() + self.timeout):
                return self._answer()
        lost = "; it may have restarted and lost its state"
        raise RunError(self._why or f"no answer to a tick at {self.port} within {PATIENCE * self.timeout:g} s{lost}")

    def try_ask(self, kind: Kind, values: bytes, wait: float) -> bytes | None:
        """Send the inputs of the next tick once, and return the answer if it arrives within `wait` s.

        If the node echoes no number, the newest answer is returned.
        """
        end = self._clock() + wait
        self._opened.patient = False
        if not self.joined:
            if not self._join(end):
                return None
            self._returned()
        self._next()
        self._send(self._row(values))
        if self._messages.ready is None:
            self._pump()
            oldest = min(self._received_at.get(key, -math.inf) for key in self._back)
            if self._clock() - oldest <= self.timeout:
                return self._answer()
        elif self._await(self._complete, end):
            return self._answer()
        else:
            self._lose(self._tick, max(self._received_at.values(), default=-math.inf))
            return None
        self.counts.lost += 1
        return None

    def _shut(self, connection: Any) -> None:
        connection.shutdown()

    def _next(self) -> None:
        self._pump()
        self._tick = (self._tick + 1) % NUMBERS
        if self._messages.ready is not None:
            self._parts = {}

    def _row(self, values: bytes) -> tuple[float, ...]:
        """Return the inputs of a tick; its times are not transmitted."""
        row = self.build.layout.step.unpack(values)
        return row[3:] if self.build.layout.plant else row[1:]

    def _complete(self) -> bool:
        return len(self._parts) == len(self._back)

    def _answer(self) -> bytes:
        results = {index: value for part in self._parts.values() for index, value in part.items()}
        row = [bool(results[k]) if k in self._messages.flags else results[k] for k in range(len(results))]
        return self.build.layout.answer.pack(0, *row)

    # joining ------------------------------------------------------------------------------------------------------

    def _join(self, end: float) -> bool:
        """Ask the node for its build until a time; the run begins when it has answered."""
        if self._clock() - self._asked >= self.timeout:
            self._asked = self._clock()
            if self._messages.hello is not None:
                self._post(self._messages.hello, (int(self.build.digest, 16),))
        if not self._await(lambda: self._ready is not None, end):
            return False
        if self._ready != int(self.build.digest, 16):
            raise RunError(f"the node at {self.port} has build {self._ready:08x}, expected {self.build.digest}")
        self.joined = True
        self._received_at = {(0, False): self._clock()}
        return True

    # frames -------------------------------------------------------------------------------------------------------

    def _send(self, row: tuple[float, ...]) -> None:
        for frame in self._messages.to:
            self._post(frame, row)

    def _post(self, frame: Frame, row: tuple[float, ...]) -> None:
        """Send a message; if the bus is not open it is lost, as on a disturbed bus."""
        import can

        data, limited = encoded(frame, {TICK: max(self._tick, 0), RUN: self._run}, row)
        self._limited |= dict.fromkeys(limited)
        if not self._there():
            return
        self.counts.sent += 1
        number, extended = frame.key
        try:
            self._connection.send(can.Message(arbitration_id=number, is_extended_id=extended, data=data), self.timeout)
        except (can.CanError, OSError, ValueError):
            # The queue may also be full; if the bus has failed, reading fails as well.
            self.counts.damaged += 1

    def _await(self, done: Callable[[], bool], end: float) -> bool:
        """Receive frames until a condition holds; return whether it held before a time."""
        while not done():
            left = end - self._clock()
            if left <= 0.0:
                return False
            if not self._there():
                self._sleep(min(left, REOPEN / 4))
            elif (message := self._received(left)) is not None:
                self._process(message)
        return True

    def _pump(self) -> None:
        """Process the frames that have arrived."""
        while self._there() and (message := self._received(0.0)) is not None:
            self._process(message)

    def _received(self, wait: float) -> Any:
        """Return the next frame if one arrives; an adapter's line that python-can cannot read counts as damaged."""
        import can

        try:
            return self._connection.recv(wait)
        except (can.CanError, OSError) as error:
            self._gone(f"the bus {self.port} is gone: {error}")
        except Exception:  # adapters let errors of their parsers escape, such as an IndexError
            self.counts.damaged += 1
            self._sleep(PAUSE)
        return None

    def _process(self, message: Any) -> None:
        if message.is_error_frame or message.is_remote_frame:
            return
        key, data = (message.arbitration_id, message.is_extended_id), bytes(message.data)
        ready = self._messages.ready
        frame = ready if ready is not None and key == ready.key else self._back.get(key)
        if frame is None:
            return
        read = decoded(frame, data)
        if read is None:
            self.counts.damaged += 1
            return
        tick, run, values = read
        if frame.numbered and run != self._run:
            self.counts.strays += 1
        elif frame is ready:
            self._greeted(int(values[0]))
        elif tick is None or tick == self._tick:
            self._same(key, values if tick is not None else None)
            self._parts[key] = values
            self._received_at[key] = self._clock()
        elif not self._missing.late(tick):
            self.counts.strays += 1

    def _greeted(self, build: int) -> None:
        if self._ready is not None and self._ready != build:
            raise RunError(f"two nodes answer at {self.port}; connect one of them to another bus")
        self._ready = build

    def _same(self, key: Key, values: dict[int, float] | None) -> None:
        """Check that a second answer to a tick equals the first."""
        if values is not None and self._parts.get(key, values) != values:
            raise RunError(f"two answers to tick {self._tick} at {self.port} differ; are two nodes on the bus?")

    # the bus ------------------------------------------------------------------------------------------------------

    def _there(self) -> bool:
        """Return whether the bus is open, after an attempt to open it."""
        if self._connection is not None:
            return True
        if not self._connected(f"the bus {self.port} cannot be opened"):
            return False
        self._filter()
        return True

    def _filter(self) -> None:
        """Let only the node's messages pass the bus filter, since other traffic may be heavy."""
        if self._connection is not None:
            ready = self._messages.ready
            keys = [*self._back, *([ready.key] if ready is not None else [])]
            masks = {False: 0x7FF, True: 0x1FFFFFFF}
            self._connection.set_filters([{"can_id": i, "can_mask": masks[x], "extended": x} for i, x in keys])


def can_line(entry: LinkEntry, node: str, build: Build) -> Callable[[CanLine | None], CanLine]:
    """Return a function that opens the line of a node, or uses an open one; the DBC is read now.

    Raises
    ------
    ScenarioError
        The DBC cannot be read or does not fit.
    """
    layout = build.layout
    messages = messages_of(Path(entry.firmware), node, layout.inputs, layout.outputs, build.digest)

    def open_line(old: CanLine | None) -> CanLine:
        line = CanLine(entry.port, lambda: _bus(entry)) if old is None else old
        return line.use(messages, build, entry.timeout)

    return open_line


def _bus(entry: LinkEntry) -> Any:
    """Open a bus.

    Raises
    ------
    OSError
        It cannot be opened now.
    ScenarioError
        There is no such interface.
    """
    need("can", WHAT)
    import can

    interface, _, channel = entry.port.removeprefix(CAN).partition("/")
    rate: dict[str, Any] = {} if entry.baud is None else {"bitrate": entry.baud}
    try:
        return can.Bus(interface=interface, channel=channel, **rate)
    except OSError:
        raise
    except (can.CanOperationError, can.CanInitializationError) as error:
        raise OSError(str(error)) from None
    except Exception as error:  # each interface has errors of its own, of a missing library or a wrong channel
        raise ScenarioError(f"the bus {entry.port} cannot be opened: {error}") from None
