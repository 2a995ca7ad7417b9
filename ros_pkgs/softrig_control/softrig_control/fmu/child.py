"""An FMU in a separate process: a crash or hang there ends a run by name, and no process is left behind."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import select
import signal
import subprocess
import sys
import weakref
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from softrig_core.guard import print_for
from softrig_core.kit.confined import confine, forbidden

from .instance import Instance, Numbers, Plan, Refusal

LEAVE = 3.0  # s: after which a process that does not end is killed
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
START = 60.0  # s: a process needs its time to begin on a busy machine, whatever a call may take


class Isolated:
    """An `Instance` in another process; its methods, with the same numbers.

    Parameters
    ----------
    seconds : float
        Wall-clock time after which a call is aborted and the process killed.
    confined : bool
        Whether it loses the network and everything that it may write, where the system allows that.

    Raises
    ------
    Refusal
        By every method: the FMU refused, crashed, or did not answer in time.
    """

    def __init__(self, plan: Plan, seconds: float, confined: bool = False) -> None:
        self._plan, self._seconds, self._confined = plan, seconds, confined
        self._launch()

    def _launch(self) -> None:
        self._pipe, theirs = Pipe()
        code = "from softrig_control.fmu.child import main; main()"
        with theirs:
            # -P: nothing is imported from the current directory, which may belong to anybody.
            command = [sys.executable, "-P", "-c", code, str(theirs.fileno()), str(os.getpid())]
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])
        self._poll = select.poll()
        self._poll.register(self._pipe.fileno(), select.POLLIN)
        self._end = weakref.finalize(self, _kill, self._process, self._pipe)
        self._pipe.send((sys.path, self._plan.folder if self._confined else ""))
        self._call("__init__", self._plan, seconds=max(self._seconds, START))

    def begin(self) -> Numbers:
        """Start as `Instance` does; in a new process if the previous one has ended."""
        if not self._end.alive:
            self._launch()
        return self._call("begin", seconds=max(self._seconds, START))

    def advance(self, start: float, end: float, values: Numbers) -> Numbers:
        """Advance as `Instance` does."""
        return self._call("advance", start, end, values)

    def tune(self, values: Any) -> None:
        """Set values as `Instance` does."""
        self._call("tune", values)

    def keep(self) -> bytes:
        """Store the state as `Instance` does."""
        return self._call("keep")

    def restore(self, state: bytes) -> Numbers:
        """Restore a state as `Instance` does."""
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
            good, result = self._pipe.recv()
        except (EOFError, OSError):
            try:
                code = self._process.wait(LEAVE)
            except subprocess.TimeoutExpired:
                code = 0  # it lives on, and cannot be asked any more
            self._end()
            how = (
                f"was killed by {signal.Signals(-code).name}"
                if code < 0
                else f"ended with status {code}"
                if code
                else "closed the pipe by which it is asked"
            )
            raise Refusal(f"crashed: its process {how}") from None
        if not good:
            self._end()  # in which state it is nobody knows
            raise Refusal(result)
        return result


def _kill(process: subprocess.Popen[bytes], pipe: Connection) -> None:
    process.terminate()  # its keeper, which ends all that the FMU has started
    try:
        process.wait(LEAVE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    pipe.close()


def main() -> None:
    """Run two processes: one answers calls until the pipe is closed, the other ends processes that the first leaves."""
    parent = int(sys.argv[2])
    os.dup2(2, 1)  # an FMU that prints does so on the terminal, not in what a program may read
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the caller's; it ends us
    # Waited for and never handled: of a caller that is killed we see the FMU's end first, and then this signal
    awaited = {signal.SIGTERM, signal.SIGCHLD}
    signal.pthread_sigmask(signal.SIG_BLOCK, awaited)
    prctl = ctypes.CDLL(None).prctl
    prctl(PR_SET_CHILD_SUBREAPER, 1)  # what the FMU starts is ours when the FMU has gone
    prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(0)
    keeper = os.getpid()
    fmu = os.fork()
    if not fmu:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, awaited)
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # also while a call of the FMU hangs
        if os.getppid() == keeper:
            _answer(Connection(int(sys.argv[1])))
        os._exit(0)
    os.close(int(sys.argv[1]))
    status = None
    while status is None and signal.sigwait(awaited) != signal.SIGTERM:
        status = _reaped(fmu)
    _sweep()
    if status is None:
        os._exit(0)
    if os.WIFSIGNALED(status):  # end as it did
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.signal(os.WTERMSIG(status), signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, awaited)
        os.kill(keeper, os.WTERMSIG(status))
    os._exit(os.waitstatus_to_exitcode(status) if os.WIFEXITED(status) else 1)


def _confine(folder: str) -> None:
    """Block the FMU's access to network and files, or report why that is not possible."""
    if why := forbidden():
        print_for("fmu", f"{folder} runs with all rights of this user: the system allows no namespaces ({why})")
        return
    confine([folder])
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # other rights have cleared it


def _reaped(fmu: int) -> int | None:
    """Reap all children that have ended; return the status of the FMU's process if it is one of them."""
    status = None
    while True:
        try:
            child, ended = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return status
        if not child:
            return status
        if child == fmu:
            status = ended


def _sweep() -> None:
    """Kill our children, then their orphans, which become ours, until there is none."""
    me = os.getpid()
    while True:
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError, IndexError):
                if int(stat.read_text(errors="replace").rpartition(")")[2].split()[1]) == me:
                    os.kill(int(stat.parent.name), signal.SIGKILL)
        try:
            os.wait()
        except ChildProcessError:
            return


def _answer(pipe: Connection) -> None:
    """Answer calls until the pipe is closed."""
    sys.path[:], folder = pipe.recv()
    if folder:
        _confine(folder)
    instance: Any = None
    while True:
        try:
            name, arguments = pipe.recv()
        except (EOFError, OSError):
            os._exit(0)  # nobody waits for what the FMU has to say at its end
        try:
            if name == "__init__":
                instance, answer = Instance(*arguments), None
            else:
                answer = getattr(instance, name)(*arguments)
            result = True, answer
        except Exception as error:
            result = False, str(error) if isinstance(error, Refusal) else f"{type(error).__name__}: {error}"
        try:
            pipe.send(result)
        except OSError:
            os._exit(0)  # the caller has gone, or the FMU has closed our descriptors
