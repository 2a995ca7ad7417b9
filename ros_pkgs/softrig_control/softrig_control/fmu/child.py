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
START = 60.0  # s: on a busy machine a process may need longer to start than the timeout of a call


class Isolated:
    """An `Instance` in another process; its methods, with the same numbers.

    Parameters
    ----------
    seconds : float
        Wall-clock time after which a call is aborted and the process killed.
    confined : bool
        Whether it loses access to the network and all rights to write, if the system allows that.

    Raises
    ------
    Refusal
        By every method: the FMU refused, crashed, or did not answer in time.
    """

    def __init__(self, plan: Plan, seconds: float, confined: bool = False) -> None:
        self._plan, self._seconds, self._confined = plan, seconds, confined
        self._launch()

    def _launch(self) -> None:
        self._pipe, child_end = Pipe()
        code = "from softrig_control.fmu.child import main; main()"
        with child_end:
            # -P: nothing is imported from the current directory, which may belong to anybody.
            command = [sys.executable, "-P", "-c", code, str(child_end.fileno()), str(os.getpid())]
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=[child_end.fileno()])
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
                # It still runs, but it has closed its pipe.
                code = 0
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
            # After an error the state of the FMU is unknown.
            self._end()
            raise Refusal(result)
        return result


def _kill(process: subprocess.Popen[bytes], pipe: Connection) -> None:
    # This is the process of the keeper, which also ends everything that the FMU has started.
    process.terminate()
    try:
        process.wait(LEAVE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    pipe.close()


def main() -> None:
    """Run two processes: one answers calls until the pipe is closed, the other ends processes that the first leaves."""
    parent = int(sys.argv[2])
    # What an FMU prints must not mix with standard output, which another program may read.
    os.dup2(2, 1)
    # Ctrl-C is for the caller, which then ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # These are waited for and never handled. If the caller is killed, the end of the FMU arrives before SIGTERM.
    awaited = {signal.SIGTERM, signal.SIGCHLD}
    signal.pthread_sigmask(signal.SIG_BLOCK, awaited)
    prctl = ctypes.CDLL(None).prctl
    # Processes that the FMU has started become children of this one when the FMU has gone, so `_sweep` finds them.
    prctl(PR_SET_CHILD_SUBREAPER, 1)
    prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(0)
    keeper = os.getpid()
    fmu = os.fork()
    if not fmu:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, awaited)
        # SIGKILL also ends it while a call of the FMU hangs.
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
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
    # The caller sees only this process, so it ends by the same signal, without a second core dump.
    if os.WIFSIGNALED(status):
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
    # Linux clears this setting when the rights of a process change.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


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
            # Nothing waits for the code that an FMU runs at its end, so it is skipped.
            os._exit(0)
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
            # The caller has gone, or the FMU has closed the descriptors of this process.
            os._exit(0)
