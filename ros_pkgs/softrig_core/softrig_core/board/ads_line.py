"""Requests to one program on a PLC and its answers, over ADS."""

from __future__ import annotations

import math
import os
import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from ..errors import RunError, ScenarioError
from ..extras import need
from .entry import ADS, LinkEntry, contents_of
from .frames import Kind
from .line import PATIENCE, REOPEN, Build
from .remote import RemoteLine

WHAT = "a node on a PLC"
ROUTER = 48898  # TCP port of ADS
NUMBERS = 1 << 32
HEAD, TAIL = struct.Struct("<II"), struct.Struct("<I")  # number and session; the number again, against torn copies
POLL = 0.0005  # s between two polls of the answer
BUILD = 17  # bytes of a STRING(16)


class Plc(Protocol):
    """The variables of a program; the methods raise OSError if it cannot be reached now."""

    def build(self) -> str:
        """Return the build that the program reports."""

    def write(self, data: bytes) -> None:
        """Write the request."""

    def read(self, size: int) -> bytes:
        """Return the answer."""

    def wait(self, seconds: float) -> None:
        """Limit the time that the following calls may take."""

    def close(self) -> None:
        """Close the connection."""


class AdsLine(RemoteLine):
    """Requests to one program on a PLC and its answers.

    Parameters
    ----------
    port : str
        Name of the port, for errors.
    opened : callable
        Connects within a time in s; raises OSError if that fails now, ScenarioError if it can never succeed.
    build : Build
        Required build; a program with another one is refused.
    timeout : float
        s until a lockstep request is written again.
    clock, sleep : callable
        Return the time in s, and sleep for a time in s.
    """

    def __init__(
        self,
        port: str,
        opened: Callable[[float], Plc],
        build: Build,
        timeout: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        super().__init__(port, opened, clock, sleep)
        self.build, self.timeout = build, timeout
        self.begin(b"")

    def begin(self, params: bytes) -> None:
        """Begin a session with the next request; the program has its own parameters, so `params` is empty."""
        # Both are random, so that neither equals the last answer of the program.
        self._number, self._session = (int.from_bytes(os.urandom(4), "little") or 1 for _ in range(2))
        self._first, self.joined = True, False
        self._missing.clear()
        self._seen = b""  # the answer that was read last
        self._answered_at = self._clock()

    def ask(self, kind: Kind, values: bytes) -> bytes:
        """Write a request until it is answered, and return the answer.

        Raises
        ------
        RunError
            There is no answer, or the program is of another build.
        """
        self._opened.patient = True
        end = self._clock() + PATIENCE * self.timeout
        while not self.joined and self._clock() < end:
            if not self._join(self.timeout):
                self._sleep(REOPEN / 4)
        if not self.joined:
            raise RunError(self._why or f"no PLC answers at {self.port}")
        self._next()
        end, first = self._clock() + PATIENCE * self.timeout, True
        while first or self._clock() < end:
            self.counts.repeated += not first and self._connection is not None
            first = False
            if (answer := self._answer(values, self._clock() + self.timeout)) is not None:
                return answer
        lost = "; it may have restarted and lost its state, or another program writes to it"
        raise RunError(self._why or f"no answer of {self.port} within {PATIENCE * self.timeout:g} s{lost}")

    def try_ask(self, kind: Kind, values: bytes, wait: float) -> bytes | None:
        """Write a request once, and return the answer if it arrives within `wait` s."""
        end = self._clock() + wait
        self._opened.patient = False
        if not self.joined:
            if not self._join(wait):
                return None
            self._returned()
        self._next()
        answer = self._answer(values, end)
        if answer is None:
            self._lose(self._number, self._answered_at)
        return answer

    def _shut(self, connection: Plc) -> None:
        connection.close()

    # one request ----------------------------------------------------------------------------------------------------

    def _next(self) -> None:
        self._number = (self._number + 1) % NUMBERS

    def _answer(self, values: bytes, end: float) -> bytes | None:
        """Write the request and poll for its answer until a time."""
        if not self._there(end - self._clock()):
            self._sleep(max(0.0, min(REOPEN / 4, end - self._clock())))
            return None
        head = HEAD.pack(self._number, self._session) + bytes([self._first])
        self.counts.sent += 1
        if self._done(lambda plc: plc.write(head + values + TAIL.pack(self._number)), end) is None:
            return None
        while True:
            result = self._done(self._read, end)
            if result is None or (answer := self._awaited_values(result)) is not None:
                return answer if result is not None else None
            if self._clock() >= end:
                return None
            self._sleep(POLL)

    def _read(self, plc: Plc) -> bytes:
        return plc.read(HEAD.size + self.build.layout.answer.size + TAIL.size)

    def _awaited_values(self, data: bytes) -> bytes | None:
        """Return the values of an answer if it is the one that is awaited."""
        number, session = HEAD.unpack_from(data)
        fresh, self._seen = data != self._seen, data
        if TAIL.unpack_from(data, len(data) - TAIL.size)[0] != number:
            self.counts.damaged += fresh
            return None
        if session != self._session:
            self.counts.strays += fresh and session != 0
            return None
        if number != self._number:
            self._missing.late(number)
            return None
        answer = data[HEAD.size : -TAIL.size]
        if not all(map(math.isfinite, self.build.layout.answer.unpack(answer))):
            self.counts.damaged += fresh
            return None
        self._first, self._answered_at = False, self._clock()
        return answer

    # the connection -------------------------------------------------------------------------------------------------

    def _join(self, wait: float) -> bool:
        """Read the build of the program, which begins a session."""
        end = self._clock() + wait
        if not self._there(wait):
            return False
        build = self._done(lambda plc: plc.build(), end)
        if build is None:
            return False
        if build != self.build.digest:
            raise RunError(
                f"the program at {self.port} has build {build!r}, expected {self.build.digest!r}; "
                "load the program that the scenario names, or name that of the PLC"
            )
        self._answered_at, self.joined = self._clock(), True
        return True

    def _there(self, wait: float) -> bool:
        """Return whether the PLC is connected, after an attempt to connect."""
        timeout = max(wait, 0.001) if self._opened.patient else self.timeout
        return self._connected(f"the PLC {self.port} cannot be reached", timeout)

    def _done(self, call: Callable[[Plc], Any], end: float) -> Any:
        """Return the result of a call, True if it has none; None if the PLC cannot be reached."""
        if self._connection is None:
            return None
        try:
            self._connection.wait(end - self._clock())
            result = call(self._connection)
        except OSError as error:
            self._gone(f"the PLC {self.port} does not answer: {error.strerror or error}")
            return None
        return True if result is None else result


def ads_line(entry: LinkEntry, node: str, build: Build) -> Callable[[AdsLine | None], AdsLine]:
    """Return a function that opens the line of a node, or uses an open one; the file of the program is read now.

    Raises
    ------
    ScenarioError
        The file cannot be read, is no program, or is of another build.
    """
    need("pyads", WHAT)
    program, digest = program_of(Path(entry.firmware))
    if digest != build.digest:
        raise ScenarioError(
            f"link: {entry.firmware} is of another block or of other parameters of {node}; export it again"
        )

    def open_line(old: AdsLine | None) -> AdsLine:
        line = old or AdsLine(entry.port, lambda wait: _connected(entry.port, program, wait), build, entry.timeout)
        line.build, line.timeout = build, entry.timeout
        return line

    return open_line


def program_of(file: Path) -> tuple[str, str]:
    """Return the name of the program in a file of `softrig export ads`, and its build.

    Raises
    ------
    ScenarioError
        The file cannot be read or is none of these.
    """
    try:
        text = contents_of(file).decode("utf-8")
    except OSError as error:
        raise ScenarioError(f"link: {file}: {error.strerror}; `softrig export ads` writes it") from None
    except ValueError:
        text = ""
    name, build = re.search(r"\bPROGRAM (\w+)", text), re.search(r"\bbuild : STRING\(16\) := '(\w{1,16})';", text)
    if name is None or build is None:
        raise ScenarioError(f"link: {file} is no NODE_link.TcPOU with a build; `softrig export ads` writes it")
    return name[1], build[1]


_hosts: dict[tuple[int, str], int] = {}  # connections of this process: a PLC may drop the older of two of one address


def _connected(port: str, program: str, wait: float) -> Plc:
    """Connect to the program on a PLC.

    Raises
    ------
    OSError
        It is not there.
    """
    match = re.fullmatch(r"([\d.]+)(?:@([^/]+))?/(\d+)", port.removeprefix(ADS))
    assert match is not None  # ensured by `LinkEntry`
    net, number = match[1], int(match[3])
    host = socket.gethostbyname(match[2] or ".".join(net.split(".")[:4]))
    if not _hosts.get((os.getpid(), host)):  # pyads would wait for minutes if the address does not answer
        socket.create_connection((host, ROUTER), timeout=wait).close()
    return Connected(net, number, host, program, wait)


class Connected:
    """The variables of a program by pyads: see `Plc`."""

    def __init__(self, net: str, number: int, host: str, program: str, wait: float) -> None:
        import pyads

        self._pyads, self._key, self._program = pyads, (os.getpid(), host), program
        self._connection = pyads.Connection(net, number, host)
        self._timeout = 0
        with _unreachable(pyads.ADSError):
            self._connection.open()
        _hosts[self._key] = _hosts.get(self._key, 0) + 1
        try:
            self.wait(wait)
            with _unreachable(pyads.ADSError):
                self._request, self._reply, self._build = (
                    self._connection.get_handle(f"{program}.{name}") for name in ("request", "answer", "build")
                )
        except OSError:
            self.close()
            raise

    def build(self) -> str:
        """See `Plc.build`."""
        return self._bytes(self._build, BUILD).split(b"\0")[0].decode("ascii", "replace")

    def write(self, data: bytes) -> None:
        """See `Plc.write`."""
        with _unreachable(self._pyads.ADSError):
            self._connection.write_by_name("", tuple(data), self._pyads.PLCTYPE_BYTE * len(data), handle=self._request)

    def read(self, size: int) -> bytes:
        """See `Plc.read`."""
        return self._bytes(self._reply, size)

    def wait(self, seconds: float) -> None:
        """See `Plc.wait`."""
        timeout = max(1, math.ceil(seconds * 1000.0))
        if timeout != self._timeout:
            self._connection.set_timeout(timeout)
            self._timeout = timeout

    def close(self) -> None:
        """See `Plc.close`."""
        _hosts[self._key] -= 1
        self._connection.close()

    def _bytes(self, handle: Any, size: int) -> bytes:
        with _unreachable(self._pyads.ADSError):
            kind = self._pyads.PLCTYPE_BYTE * size
            result = bytes(self._connection.read_by_name("", kind, handle=handle, check_length=True))
        if len(result) != size:
            raise OSError(f"{len(result)} bytes of {self._program}, expected {size}")
        return result


@contextmanager
def _unreachable(kind: type[Exception]) -> Iterator[None]:
    """Turn an error of pyads into an OSError; one of an answer that is too short is a RuntimeError."""
    try:
        yield
    except (kind, RuntimeError) as error:
        raise OSError(str(error).strip()) from None
