"""An FMU in a process of its own: what crashes or hangs there ends a run by name, and takes nobody with it."""

from __future__ import annotations

import ctypes
import os
import select
import signal
import subprocess
import sys
import weakref
from multiprocessing.connection import Connection, Pipe
from typing import Any

from .instance import Instance, Numbers, Plan, Refusal

START = 60.0  # s: a process needs its time to begin on a busy machine, whatever a call may take


class Isolated:
    """An `Instance` in another process; its methods, with the same numbers.

    Parameters
    ----------
    plan : Plan
    seconds : float
        Wall-clock time after which a call is given up and the process killed.

    Raises
    ------
    Refusal
        By every method: the FMU refused, crashed, or did not answer in time.
    """

    def __init__(self, plan: Plan, seconds: float) -> None:
        self._plan, self._seconds = plan, seconds
        self._launch()

    def _launch(self) -> None:
        self._pipe, theirs = Pipe()
        code = "from softrig_control.fmu.child import main; main()"
        with theirs:
            # -P: nothing is imported from the current directory, which is anybody's
            command = [sys.executable, "-P", "-c", code, str(theirs.fileno()), str(os.getpid())]
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])
        self._poll = select.poll()
        self._poll.register(self._pipe.fileno(), select.POLLIN)
        self._end = weakref.finalize(self, _kill, self._process, self._pipe)
        self._pipe.send(sys.path)
        self._call("__init__", self._plan, seconds=max(self._seconds, START))

    def begin(self) -> Numbers:
        """As of `Instance`; in a new process where the one before has ended."""
        if not self._end.alive:
            self._launch()
        return self._call("begin", seconds=max(self._seconds, START))

    def advance(self, start: float, end: float, values: Numbers) -> Numbers:
        """As of `Instance`."""
        return self._call("advance", start, end, values)

    def tune(self, values: Any) -> None:
        """As of `Instance`."""
        self._call("tune", values)

    def keep(self) -> bytes:
        """As of `Instance`."""
        return self._call("keep")

    def restore(self, state: bytes) -> Numbers:
        """As of `Instance`."""
        return self._call("restore", state)

    def _call(self, name: str, *arguments: Any, seconds: float | None = None) -> Any:
        seconds = self._seconds if seconds is None else seconds
        if not self._end.alive:
            raise Refusal("has ended before")
        try:
            self._pipe.send((name, arguments))
            if not self._poll.poll(seconds * 1000.0):
                self._end()
                raise Refusal(f"gave no answer within {seconds:g} s")
            good, found = self._pipe.recv()
        except (EOFError, OSError):
            code = self._process.wait()
            self._end()
            how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
            raise Refusal(f"crashed: its process {how}") from None
        if not good:
            self._end()  # in which state it is nobody knows
            raise Refusal(found)
        return found


def _kill(process: subprocess.Popen[bytes], pipe: Connection) -> None:
    process.kill()
    process.wait()
    pipe.close()


def main() -> None:
    """Be the process: answer calls until the other end of the pipe is closed."""
    pipe, parent = Connection(int(sys.argv[1])), int(sys.argv[2])
    os.dup2(2, 1)  # an FMU that prints does so on the terminal, not in what a program may read
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the caller's; it ends us
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)  # also while a call of the FMU hangs
    if os.getppid() != parent:
        os._exit(0)
    sys.path[:] = pipe.recv()
    instance: Any = None
    while True:
        try:
            name, arguments = pipe.recv()
        except (EOFError, OSError):
            os._exit(0)  # nobody waits for what the FMU has to say at its end
        try:
            if name == "__init__":
                instance = Instance(*arguments)
                answer = None
            else:
                answer = getattr(instance, name)(*arguments)
            pipe.send((True, answer))
        except BrokenPipeError:
            os._exit(0)
        except Exception as error:
            pipe.send((False, str(error) if isinstance(error, Refusal) else f"{type(error).__name__}: {error}"))
