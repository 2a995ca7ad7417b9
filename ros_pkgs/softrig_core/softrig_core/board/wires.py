"""Transports of bytes to a board: a serial port, or a simulator of the board in a process of its own."""

from __future__ import annotations

import ctypes
import json
import os
import re
import resource
import select
import shutil
import signal
import socket
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Protocol

from ..errors import ScenarioError
from ..extras import need
from . import SIMULATORS
from .simavr import simavr_program

CHUNK = 4096
PRINTED = 16 << 20  # bytes that a simulator may write to its standard error, which is a file
END = 2.0  # s: a simulator ends when its input does
QEMU = "apt-get install qemu-system-arm"


class Wire(Protocol):
    """Bytes to a board and back."""

    def write(self, data: bytes) -> None:
        """Send bytes; raise OSError if the board is gone."""

    def read(self, wait: float) -> bytes:
        """Return bytes as soon as any arrive, after `wait` s at the latest; raise OSError if the board is gone."""

    def close(self) -> None:
        """Close the port."""


class FileWire:
    """A wire that is a file descriptor.

    Parameters
    ----------
    port : object
        What `close` closes.
    fd : int
        To read and to write, without waiting.
    """

    def __init__(self, port: Any, fd: int) -> None:
        self._port, self._fd = port, fd
        os.set_blocking(fd, False)
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)

    def write(self, data: bytes) -> None:
        """Send bytes; see `Wire`."""
        while data:
            try:
                data = data[os.write(self._fd, data) :]
            except BlockingIOError:
                if not select.select([], [self._fd], [], 1.0)[1]:
                    raise OSError("the port accepts no bytes") from None

    def read(self, wait: float) -> bytes:
        """Return the bytes that have arrived; see `Wire`."""
        if not self._poll.poll(max(wait, 0.0) * 1e3):
            return b""
        try:
            data = os.read(self._fd, CHUNK)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError("the port has closed")
        return data

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class Simulated(FileWire):
    """A simulator that has the other end of a socket as its standard input and output."""

    def __init__(self, command: list[str]) -> None:
        local, remote = socket.socketpair()
        with remote:
            end = remote.fileno()
            self._output = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the port
            # Ctrl-C in a terminal is for the run: a board that ended before it would be taken for one that has failed.
            self._process = subprocess.Popen(
                command, stdin=end, stdout=end, stderr=self._output, preexec_fn=_end_with_parent, process_group=0
            )
        super().__init__(local, local.fileno())

    def end_and_count(self) -> dict[str, int]:
        """End the simulator and return its counts; empty if it counts nothing."""
        self._port.shutdown(socket.SHUT_WR)
        try:
            self._process.wait(END)
            self._output.seek(0)
            # The library libsimavr may print lines in front of it.
            counted = next(line for line in self._output if line.startswith(b"{"))
            return dict(json.loads(counted))
        except (ValueError, RecursionError, StopIteration, subprocess.TimeoutExpired):
            return {}

    def close(self) -> None:
        """End the simulator."""
        super().close()
        self._process.terminate()
        try:
            self._process.wait(END)
        except subprocess.TimeoutExpired:  # the program does not end by itself
            self._process.kill()
            self._process.wait()
        self._output.close()


_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


def _end_with_parent() -> None:
    """Let Linux end the simulator with this process, because qemu does not end when its input does. Limit its
    output.
    """
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    resource.setrlimit(resource.RLIMIT_FSIZE, (PRINTED, PRINTED))


def opened(port: str, baud: int) -> Wire:
    """Open the port of a board.

    Parameters
    ----------
    port : str
        A serial port's file, ``simavr:FILE.elf``, ``qemu:FILE.elf``, or ``program:FILE``, firmware for this machine.
    baud : int
        Bits a second of a serial port.

    Raises
    ------
    ScenarioError
        A package, tool or file is missing, so waiting is useless.
    OSError
        The port cannot be opened now.
    """
    kind, _, name = port.partition(":")
    if kind in SIMULATORS and name:
        file = Path(name)
        if not file.is_file():
            raise ScenarioError(f"link: {port}: there is no such file; `softrig export` writes it with --check")
        return Simulated(_command(kind, file))
    need("serial", "a board at a serial port")
    import serial

    try:
        device = serial.Serial(port, baud, timeout=0, exclusive=True)
    except serial.SerialException as error:
        if Path(port).exists() and not _is_terminal(port):
            raise ScenarioError(f"link: {port} is not a serial port; expected one such as /dev/ttyACM0") from None
        raise OSError(error.errno or 0, str(error)) from error
    except ValueError as error:
        raise ScenarioError(f"link: {port}: {error}") from None
    return FileWire(device, device.fileno())


def _is_terminal(port: str) -> bool:
    """Return whether a file may be a serial port; one that cannot be opened now may be."""
    if not Path(port).is_char_device():
        return False
    try:
        file = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return True
    try:
        return os.isatty(file)
    finally:
        os.close(file)


def _command(kind: str, file: Path) -> list[str]:
    if kind == "simavr":
        return [str(simavr_program("board")), str(file)]
    if kind == "program":
        return [str(file.resolve())]
    if (emulator := shutil.which("qemu-system-arm")) is None:
        raise ScenarioError(f"qemu-system-arm is not installed (Debian: {QEMU})")
    return [emulator, *qemu_options(machine_of(file)), "-serial", "stdio", "-kernel", str(file)]


def qemu_options(machine: str) -> list[str]:
    """Return how qemu simulates a machine without a display, an instruction a fixed time."""
    return ["-M", machine, "-display", "none", "-monitor", "none", "-icount", "shift=10,sleep=off"]


def machine_of(file: Path) -> str:
    """Return qemu's machine for a firmware, which `softrig export cortex-m` writes beside it.

    Raises
    ------
    ScenarioError
        It cannot be read.
    """
    counts_file = file.with_suffix(".json")
    try:
        machine = json.loads(counts_file.read_text())["machine"]
        # properties behind a comma would have qemu read and write other files
        if re.fullmatch(r"[\w.-]{1,60}", machine):
            return str(machine)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        pass
    raise ScenarioError(f"link: {counts_file} does not name qemu's machine; `softrig export cortex-m` writes it")
