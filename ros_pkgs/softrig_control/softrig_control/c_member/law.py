"""A user's functions, called with numbers alone: in this process, or in one that a run has for itself."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import struct
import subprocess
import weakref
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any, NamedTuple

from softrig_core import RunError
from softrig_core.kit.compiled import Compiled

from .build import Built

SIGNAL, RANGE, CONSTANT, MODE = 1e6, 2e6, 3e6, 4e6  # as in shim.c
LEAVE = 1.0  # s: after which a process that does not end is killed
PRINTED = 1 << 16  # bytes of output that a library may print before it ends; the rest is dropped
Row = tuple[float, ...]


class Counts(NamedTuple):
    """Numbers of arguments and results of a function; place, time and status precede them."""

    takes: int
    gives: int


def counts(built: Built, method: str) -> Counts:
    """Return the counts of a function."""
    states, ins, outs = (len(built.structs[role].leaves) for role in ("state", "in", "out"))
    return Counts(
        2 + states + ins * (method in ("step", "advance")),
        1 + states * (method in ("step", "advance")) + outs * (method in ("step", "outputs")),
    )


@lru_cache(maxsize=64)
def _loaded(shim: str, library: str) -> ctypes.CDLL:
    """Load a shim and the user's library, once a process.

    Raises
    ------
    ValueError
        The library cannot be loaded, with the reason of the loader.
    """
    result = ctypes.CDLL(shim)
    result.sr_load.restype = ctypes.c_char_p
    result.sr_init.restype = ctypes.c_double
    result.sr_size.restype = ctypes.c_long
    if (wrong := result.sr_load(library.encode(), 1)) is not None:
        raise ValueError(f"cannot be loaded: {wrong.decode(errors='replace')}")
    return result


class Called(Compiled):
    """One of a user's functions, in this process; native code calls it by its address."""

    # Each call writes the arguments before it reads the results, so nothing of a tick is left in them.
    SCRATCH = frozenset({"_arguments", "_results"})

    def __init__(self, built: Built, method: str) -> None:
        self._entry = getattr(_loaded(str(built.shim), str(built.library)), f"sr_{method}")
        self.native = True
        self.n_in, self.n_out = counts(built, method)
        self.symbol = f"{built.shim.stem.replace('-', '_')}_{method}"
        self._arguments, self._results = bytearray(8 * self.n_in), bytearray(8 * self.n_out)
        # addresses alone: the arrays live as long as the buffers, which they keep
        self._arrays = [(ctypes.c_char * len(b)).from_buffer(b) for b in (self._arguments, self._results)]
        self._tables = tuple((ctypes.c_void_p * 1)(ctypes.addressof(array)) for array in self._arrays)
        self._pack, self._unpack = struct.Struct(f"{self.n_in}d").pack_into, struct.Struct(f"{self.n_out}d").unpack

    def __call__(self, values: Sequence[float]) -> Row:
        """Call it: place of the constants, time in ns, state, inputs; status, state, outputs."""
        self._pack(self._arguments, 0, *values)
        self._entry(*self._tables, None, None, ctypes.c_longlong(0))
        return self._unpack(self._results)

    @property
    def address(self) -> int:
        """Return the address of the function."""
        return ctypes.cast(self._entry, ctypes.c_void_p).value or 0

    @property
    def places(self) -> tuple[int, int, int, int]:
        """See `Compiled.places`."""
        arguments = self.n_in + self.n_out
        return arguments, arguments + 1, arguments + 2, arguments + 2

    def scratch(self) -> Any:
        """See `Compiled.scratch`."""
        import numpy as np

        memory = np.zeros(self.places[3] + 1)
        words, base = memory.view(np.int64), memory.ctypes.data
        words[self.places[0]], words[self.places[1]] = base, base + 8 * self.n_in
        return memory


class Here:
    """A node's state as its NODE_init has left it, in this process.

    Attributes
    ----------
    place : int
        Its address.
    first : tuple of float
        The numbers of its state.
    status : float
        Return value of NODE_init.
    """

    def __init__(self, built: Built, params: Row) -> None:
        library = _loaded(str(built.shim), str(built.library))
        states = len(built.structs["state"].leaves)
        self._memory = ctypes.create_string_buffer(library.sr_size())
        numbers = (ctypes.c_double * max(1, states))()
        self.status = library.sr_init(self._memory, (ctypes.c_double * max(1, len(params)))(*params), numbers)
        self.place, self.first = ctypes.addressof(self._memory), tuple(numbers[:states])


class Apart:
    """A user's library in a process of its own, at its begin.

    Parameters
    ----------
    seconds : float
        Wall-clock time after which a call is aborted and the process killed.

    Raises
    ------
    RunError
        By every method: the library crashed or did not answer in time.
    """

    def __init__(self, built: Built, methods: Sequence[str], params: Row, seconds: float) -> None:
        self._seconds, self._methods = seconds, tuple(methods)
        self._counts = [counts(built, m) for m in methods]
        (reading, write_end), (read_end, writing), (printed, saying) = os.pipe(), os.pipe(), os.pipe()
        # A library that reads nothing, or prints more than the pipe holds, must not block the run.
        for descriptor in (writing, printed, saying):
            os.set_blocking(descriptor, False)
        command = [str(built.program), str(built.library), str(read_end), str(write_end)]
        # The library has its own process group: Ctrl-C is for the run, and processes that the library starts end with
        # it.
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=2, stderr=saying, pass_fds=[read_end, write_end], process_group=0
        )
        for descriptor in (read_end, write_end, saying):
            os.close(descriptor)
        self._reading, self._writing, self._printed = reading, writing, printed
        self.end = weakref.finalize(self, _ended, self._process, reading, writing, printed)
        result = self._ask(-1, params, 1 + len(built.structs["state"].leaves))
        self.status, self.first = result[0], result[1:]

    def call(self, method: str, values: Row) -> Row:
        """Call it as `Called`, with the address of the constants filled in."""
        number = self._methods.index(method)
        return self._ask(number, (0.0, *values), self._counts[number].gives)

    def _ask(self, number: int, values: Row, count: int) -> Row:
        request, data = struct.pack(f"=i{len(values)}d", number, *values), b""
        try:
            while request:
                self._wait(select.POLLOUT)
                request = request[os.write(self._writing, request) :]
            while len(data) < 8 * count:
                self._wait(select.POLLIN)
                more = os.read(self._reading, 8 * count - len(data))
                if not more:
                    raise BrokenPipeError
                data += more
        except OSError:
            raise RunError(self._ending()) from None
        return struct.unpack(f"{count}d", data)

    def _wait(self, event: int) -> None:
        """Wait until the process is ready to receive bytes or has sent some."""
        # `select` cannot wait for descriptors beyond 1,024.
        poll = select.poll()
        poll.register(self._writing if event == select.POLLOUT else self._reading, event)
        if not poll.poll(self._seconds * 1e3):
            self.end()
            raise RunError(f"gave no answer within {self._seconds:g} s")

    def _ending(self) -> str:
        """End a process that answers no more, and return how it ended."""
        try:
            code = self._process.wait(LEAVE)
        except subprocess.TimeoutExpired:
            code = None
        data = b""
        # The pipe is empty but still open if a process that the library started lives on.
        with suppress(BlockingIOError):
            data = os.read(self._printed, PRINTED)
        self.end()
        return _how(code, data.decode(errors="replace").strip())


def _how(code: int | None, text: str) -> str:
    if code is not None and code < 0:
        return f"crashed ({signal.Signals(-code).name})"
    if code == 2 and text:
        return f"cannot be loaded: {text.splitlines()[-1]}"
    if code is None:
        return "closed the pipes on which it answers"
    return f"ended its process with status {code}"


def _ended(process: subprocess.Popen[bytes], *descriptors: int) -> None:
    for descriptor in descriptors:
        os.close(descriptor)
    # No process of its group may be left.
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def wrong(status: float, method: str, names: Sequence[str]) -> str:
    """Describe the status of a call; empty if the user's function has answered by itself."""
    if SIGNAL <= status < RANGE:
        return f"crashed ({signal.Signals(int(status - SIGNAL)).name}) in {method}"
    if RANGE <= status < CONSTANT:
        return f"{method}: {names[int(status - RANGE)]} is beyond what its type, or a double, holds exactly"
    if status == CONSTANT:
        return (
            f"{method} changes a member that holds constants; only NODE_init may write k, constants and the parameters"
        )
    if status == MODE:
        return (
            f"{method} leaves the processor with another rounding mode, or flushing subnormal numbers (fesetround, "
            "-ffast-math); restore the mode before it returns"
        )
    return ""
