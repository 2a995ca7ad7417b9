"""One board at its line: sessions, repetitions, and counts."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

from ..errors import RunError, ScenarioError
from .apart import Apart
from .frames import Frame, Kind, Splitter, read, written
from .layout import HELLO, Layout
from .wires import Wire

PATIENCE = 16  # timeouts without an answer, after which the board is given up
SETTLE = 0.05  # s after an answer to a hello: a second board on the wire would have answered by then
TRIES = 3  # attempts of a reset or of parameters, each after a new hello
REOPEN = 0.1  # s between two tries to open a port
NUMBERS = 1 << 16
REMEMBERED = 64  # numbers of requests without an answer, to tell late ones from strays


@dataclass(frozen=True)
class Build:
    """The build that a board must report: digest, period in s as a fraction, and the frames of its node."""

    digest: str
    period: tuple[int, int]
    layout: Layout


@dataclass
class Counts:
    """Counters of the events on a wire.

    Attributes
    ----------
    sent : int
        Frames sent.
    repeated : int
        Frames sent again because no answer arrived.
    damaged : int
        Frames that did not pass their checksum, or belong to another session.
    strays : int
        Unexpected answers: duplicates, and answers to an older request.
    echoed : int
        Requests that came back, as from a half-duplex adapter.
    late, lost : int
        Real time: answers after their deadline, and those that never arrived.
    reopened : int
        Number of times the port was gone and was opened again.
    rejoined : int
        Real time: number of times the board restarted with a fresh state.
    """

    sent: int = 0
    repeated: int = 0
    damaged: int = 0
    strays: int = 0
    echoed: int = 0
    late: int = 0
    lost: int = 0
    reopened: int = 0
    rejoined: int = 0

    def remarks(self) -> str:
        """Describe unusual events; empty if there were none."""
        return ", ".join(f"{n} {name}" for name, n in asdict(self).items() if n and name != "sent")


class Missing:
    """Requests in real time whose answers did not arrive in time; they distinguish a late answer from a stray one.

    Parameters
    ----------
    counts : Counts
        Counters of the line: `lost` and `late` are kept up to date.
    """

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._numbers: dict[int, None] = {}

    def add(self, number: int) -> None:
        """Count a request as lost; only the newest `REMEMBERED` are known."""
        self._counts.lost += 1
        self._numbers[number] = None
        while len(self._numbers) > REMEMBERED:
            del self._numbers[next(iter(self._numbers))]

    def late(self, number: int) -> bool:
        """Return whether an answer belongs to a request that was counted as lost, which is late then."""
        if number not in self._numbers:
            return False
        del self._numbers[number]
        self._counts.late += 1
        self._counts.lost -= 1
        return True

    def clear(self) -> None:
        """Forget all requests: their answers are strays."""
        self._numbers.clear()


class Line:
    """Requests to one board and its answers.

    Parameters
    ----------
    port : str
        Name of the port, for errors.
    opened : callable
        Opens the wire; raises OSError if that fails now, ScenarioError if it can never succeed.
    build : Build
        Required build; a board with another one is refused.
    timeout : float
        s until a request is sent again.
    clock, sleep : callable
        Return the time in s, and sleep for a time in s.

    Attributes
    ----------
    counts : Counts
    wire : Wire or None
        None while the port is not open.
    joined : bool
        Whether the board has accepted the reset of this session: steps may be sent.
    served : (int, bytes, bytes)
        Number of the last answered tick, its request and its answer.
    accepted : bytes
        The parameters that the board has.
    longest : int
        Duration of the board's longest step in ticks of its clock, as reported in its last hello.
    """

    def __init__(
        self,
        port: str,
        opened: Callable[[], Wire],
        build: Build,
        timeout: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.port, self.build, self.timeout = port, build, timeout
        self._opened, self._clock, self._sleep = Apart(opened), clock, sleep
        self.wire: Wire | None = None
        self._splitter = Splitter()
        self._inbox: list[Frame] = []
        self._number = int.from_bytes(os.urandom(2), "little")
        self._session = 0
        self._tried = clock() - REOPEN
        self._newest: Frame | None = None  # the answer that was taken last
        self._received_at = 0.0
        self.counts = Counts()
        self._missing = Missing(self.counts)
        self.joined = False
        self.longest = 0
        self.served: tuple[int, bytes, bytes] = (-1, b"", b"")
        self.accepted = b""
        self.begin(b"")

    def begin(self, params: bytes) -> None:
        """Begin a session with the next request, with these parameters."""
        self._stage = Kind.HELLO
        self._asked: tuple[int, float] | None = None  # number, and when it is sent again
        self._greeted: Frame | None = None
        self._settled = 0.0
        self._params = params
        self.joined = False

    def remarks(self) -> str:
        """Describe unusual events; empty if there were none."""
        return self.counts.remarks()

    def close(self) -> None:
        """Close the port."""
        if self.wire is not None:
            self.wire.close()
            self.wire = None
        self.joined = False

    # lockstep -----------------------------------------------------------------------------------------------------

    def ask(self, kind: Kind, values: bytes) -> bytes:
        """Send a request until it is answered, and return the answer's values.

        Raises
        ------
        RunError
            The board does not answer, is another one, or has lost its state.
        ScenarioError
            The wire can never be opened.
        """
        patience = PATIENCE * self.timeout
        self._opened.patient = True
        self._join_within(patience)
        number = self._next()
        end = self._clock() + patience
        first = True
        while first or self._clock() < end:
            if not self._there():
                if not self._open():
                    self._pause()
                    continue
                self.counts.reopened += 1
            if not first:
                self.counts.repeated += 1
            first = False
            self._send(number, kind, values)
            if (frame := self._await(number, self._clock() + self.timeout)) is not None:
                return frame.values
        raise RunError(f"the board at {self.port} does not answer{self._restarted()}")

    def _join_within(self, patience: float) -> None:
        end = self._clock() + patience
        before = self.counts.strays
        while not self.joined:
            if self._clock() >= end:
                raise RunError(self._absent(before))
            if not self._there() and not self._open():
                self._pause()
                continue
            self._join(self._clock() + self.timeout)

    def _absent(self, before: int) -> str:
        if self.wire is None:
            return f"the port {self.port} cannot be opened: {self._why}"
        if self._doubled:
            return f"two boards answer at {self.port}; connect one board to a port"
        strays = self.counts.strays - before
        note = f" ({strays} frames are answers to others)" if strays else ""
        return f"no board answers at {self.port}{note}" + (
            "; the port returns what it is sent" * bool(self.counts.echoed)
        )

    def _restarted(self) -> str:
        """Report that the board has restarted, if it answers again."""
        self.begin(self._params)
        while self._there():
            self._join(self._clock() + self.timeout)
            if self.joined or self._stage is not Kind.HELLO:
                return ": it has restarted and lost its state"
            if self._asked is None or self._clock() >= self._asked[1]:
                break
        return f" within {PATIENCE * self.timeout:g} s"

    # real time ----------------------------------------------------------------------------------------------------

    def try_ask(self, kind: Kind, values: bytes, wait: float) -> bytes | None:
        """Send a request once, and return the answer's values if it arrives within `wait` s; never wait for longer."""
        end = self._clock() + wait
        self._opened.patient = False
        if not self._there() and not self._open():
            return None
        if not self.joined:
            self._join(end)
            if not self.joined:
                return None
            self.counts.rejoined += self._known
            self._known = True
            self._received_at = self._clock()
        number = self._next()
        self._send(number, kind, values)
        frame = self._await(number, end)
        if frame is not None:
            self._received_at = self._clock()
            return frame.values
        self._missing.add(number)
        if self._clock() - self._received_at > self.timeout:  # it may have restarted
            self.begin(self._params)
        return None

    # joining ------------------------------------------------------------------------------------------------------

    def _join(self, end: float) -> None:
        """Send hello, reset and parameters, each repeatedly until the board answers or a time has passed."""
        while not self.joined and self._there():
            now = self._clock()
            if self._greeted is not None:
                frame = self._greeted
                if now < self._settled:
                    self._pump(min(end, self._settled))
                    if self._clock() < self._settled and self._clock() >= end:
                        return
                    continue
                self._greeted, self._asked = None, None
                if self._doubled:
                    if now >= end:
                        return
                    continue
                self._check(frame)
                self._stage = Kind.RESET
            if self._asked is None or now >= self._asked[1]:
                self._post()
            assert self._asked is not None
            frame_ = self._await(self._asked[0], min(end, self._asked[1]))
            if frame_ is None:
                if self._clock() >= end:
                    return
                continue
            self._stage_over(frame_)

    def _post(self) -> None:
        self._tries += 1
        if self._stage is not Kind.HELLO and self._tries > TRIES:
            self._stage = Kind.HELLO
        if self._stage is Kind.HELLO:
            self._tries = 0
            self._session = self._new_session()
            self._doubled = False
        values = {Kind.HELLO: self._session.to_bytes(2, "little"), Kind.PARAMS: self._params}.get(self._stage, b"")
        number = self._next()
        self._asked = number, self._clock() + self.timeout
        self._send(number, self._stage, values)

    def _stage_over(self, frame: Frame) -> None:
        if self._stage is Kind.HELLO:
            self._greeted, self._settled = frame, self._clock() + SETTLE
            return
        self._asked, self._tries = None, 0
        if frame.values[:1] != b"\0":
            status = str(frame.values[0]) if frame.values else "missing"
            raise RunError(f"the board at {self.port} refuses its {self._stage.name.lower()} (status {status})")
        if self._stage is Kind.RESET and self._params:
            self._stage = Kind.PARAMS
        else:
            self.joined = True

    def _check(self, frame: Frame) -> None:
        """Ensure that the board has the build."""
        if len(frame.values) != HELLO.size:
            raise RunError(f"the board at {self.port} has firmware of another version of softrig; build it again")
        _, digest, over, under, size, step, answer, params, self.longest = HELLO.unpack(frame.values)
        layout = self.build.layout
        wanted = (8 - 4 * layout.single, layout.step.size, layout.answer.size, layout.params.size)
        build = digest.decode("ascii", "replace")
        if build != self.build.digest or (size, step, answer, params) != wanted:
            raise RunError(
                f"the board at {self.port} has build {build}, expected {self.build.digest}; "
                "load the firmware that the scenario names, or name that of the board"
            )
        if over * self.build.period[1] != under * self.build.period[0]:
            raise RunError(f"the board at {self.port} has a period of {over}/{under} s, expected {self.build.period}")

    # frames -------------------------------------------------------------------------------------------------------

    _doubled = False
    _why = ""
    _tries = 0
    _known = False  # whether the board has joined before, in real time

    def _new_session(self) -> int:
        """Return a session number that is neither the previous one nor zero."""
        result = self._session
        while result in (0, self._session):
            result = int.from_bytes(os.urandom(2), "little")
        return result

    def _next(self) -> int:
        self._number = (self._number + 1) % NUMBERS
        return self._number

    def _there(self) -> bool:
        return self.wire is not None

    def _open(self) -> bool:
        """Try to open the port, rarely enough that it costs no time."""
        if self._clock() - self._tried < REOPEN and not self._opened.busy:
            return False
        self._tried = self._clock()
        try:
            self.wire = self._opened()
        except OSError as error:
            self._why = error.strerror or str(error) or "the program has ended"
            return False
        except ScenarioError as error:  # waiting would not remove the error
            raise RunError(str(error)) from None
        self._splitter = Splitter()
        self._inbox.clear()
        return True

    def _pause(self) -> None:
        self._sleep(REOPEN / 4)

    def _send(self, number: int, kind: Kind, values: bytes) -> None:
        if self.wire is None:
            return
        self.counts.sent += 1
        try:
            self.wire.write(written(number, kind, values, 0 if kind is Kind.HELLO else self._session))
        except OSError:
            self._gone()

    def _gone(self) -> None:
        """Close a wire whose board cannot be reached; the session continues later if the board kept its power."""
        if self.wire is not None:
            self.wire.close()
            self.wire = None
            self._tried = self._clock()

    def _await(self, number: int, end: float) -> Frame | None:
        """Return the answer to a request if it arrives before a time."""
        while True:
            for k, frame in enumerate(self._inbox):
                if frame.number == number:
                    remaining = self._inbox[k + 1 :]
                    self._inbox = []
                    self._newest = frame
                    for stray in remaining:
                        self._stray(stray)
                    return frame
                self._stray(frame)
            self._inbox.clear()
            if not self._there() or self._clock() >= end:
                return None
            self._pump(end)

    def _pump(self, end: float) -> None:
        """Receive bytes until a time, or until the first ones."""
        if self.wire is None:
            return
        try:
            data = self.wire.read(end - self._clock())
        except OSError:
            self._gone()
            return
        for piece in self._splitter.split_frames(data):
            frame = read(piece, self._session)
            if frame is None:
                self.counts.damaged += 1
            elif frame.kind not in (Kind.HELLO, Kind.ANSWER) or self._is_ours(frame):
                self.counts.echoed += 1
            elif self._greeted is not None:
                self._stray(frame)
            else:
                self._inbox.append(frame)

    def _is_ours(self, frame: Frame) -> bool:
        """Return whether a hello is the request: the board's has its build in it."""
        return frame.kind == Kind.HELLO and frame.values == self._session.to_bytes(2, "little")

    def _stray(self, frame: Frame) -> None:
        """Count an unexpected answer; a second answer to one request shows that there are two boards."""
        if self._missing.late(frame.number):
            return
        self.counts.strays += 1
        newest = self._newest
        if newest is None or frame.number != newest.number:
            return
        if frame.kind == Kind.HELLO:
            self._doubled = True
        elif frame != newest:
            self.begin(self._params)
            raise RunError(
                f"frame {frame.number} has two different answers at {self.port}; are two boards connected to one port?"
            )
