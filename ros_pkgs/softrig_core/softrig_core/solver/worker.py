"""Run slow work in a process of its own: one call at a time, with reports of its progress; it can be killed.

`Worker` is the side of the caller; ``python -m softrig_core.solver.worker`` is the process. They exchange pickles
over its standard input and output; output that the work prints goes to the caller's standard error. If a worker is
released while it is idle, its process is reused by the next worker of the same function, since its imports take a
second.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import importlib
import os
import pickle
import queue
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Mapping
from typing import IO, Any, ClassVar, Literal

from ..bits import pin

State = Literal["idle", "working", "done", "failed"]
Figures = Mapping[str, "float | str"]
LENGTH = struct.Struct("<Q")
# The most processes without an owner, as each holds the memory of its imports.
MOST_IDLE = 4


class Work:
    """The interface by which a function in a `Worker` reports while it runs."""

    def __init__(self, send: Callable[[str, Any], None]) -> None:
        self._send = send

    def status(self, **figures: float | str) -> None:
        """Report how far it is; seen in the diagnostics of the node (bound, gap, iteration)."""
        self._send("status", figures)

    def best(self, answer: Any) -> None:
        """Store the best answer so far: it is the result if the time limit is reached."""
        self._send("best", answer)


class Worker:
    """Calls one function in a process of its own.

    Parameters
    ----------
    function : callable
        ``function(request, work)`` of an importable module: request and answer can be pickled, `work` is a `Work`.

    Raises
    ------
    ValueError
        The function cannot be imported by name (defined at a prompt or within another function).
    """

    def __init__(self, function: Callable[[Any, Work], Any]) -> None:
        # Functions defined within others have ``<locals>`` in their name, and lambdas ``<lambda>``.
        if function.__module__ == "__main__" or "<" in function.__qualname__:
            raise ValueError(
                f"{function.__qualname__} of {function.__module__} cannot be imported by another process; "
                "expected a function of a module"
            )
        self._call = (function.__module__, function.__qualname__)
        self._process: _Process | None = None
        self._changed = threading.Condition()
        self._forget()

    def _forget(self) -> None:
        self.state: State = "idle"
        self.answer: Any = None
        self.best: Any = None
        self.has_best = False
        self.status: Figures = {}
        self.error = ""
        self.since: float | None = None
        self.struck = False
        self.job: object = None

    def elapsed(self) -> float:
        """Wall-clock time of the work so far, s, without the start of its process."""
        return 0.0 if self.since is None else time.monotonic() - self.since

    def warm(self) -> None:
        """Start the process, so that its imports are done when the first request arrives."""
        if self._process is not None and self._process.alive():
            return
        process = self._process = _Process.of(*self._call)
        process.owner = weakref.ref(self)
        self._end = weakref.finalize(self, process.leave)

    def submit(self, request: Any, job: object = None) -> None:
        """Begin to work on a request.

        Parameters
        ----------
        job : object
            By which the caller knows it: `job` until the next one or `cancel`.

        Raises
        ------
        RuntimeError
            It works on another one.
        """
        if self.state == "working":
            raise RuntimeError("a worker does one thing at a time; cancel it first")
        self.warm()
        self._forget()
        self.state, self.job = "working", job
        assert self._process is not None
        self._process.busy = True
        self._process.write(request)

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until the work has ended, at most for a time in s (None: forever); return whether it has."""
        with self._changed:
            return self._changed.wait_for(lambda: self.state != "working", seconds)

    def cancel(self) -> None:
        """Kill the process, wherever it is; the next request gets a new one."""
        if self._process is not None:
            self._end.detach()
            self._process.kill()
        self._process = None
        self._forget()

    def strike(self) -> None:
        """Kill the process; the answer is then the best one so far, or None, and `struck` is set."""
        best, result, job = self.best, self.has_best, self.job
        self.cancel()
        self.answer, self.has_best, self.job = best if result else None, result, job
        self.state, self.struck = "done", True

    def release(self) -> None:
        """Release an idle process until there is work again."""
        if self._process is not None and self.state != "working":
            self._end()
            self._process = None

    def process_message(self, process: _Process, kind: str, content: Any) -> None:
        """Process a message of the worker process."""
        with self._changed:
            # A process that was killed may have sent this before.
            if process is not self._process:
                return
            if kind == "begun":
                self.since = time.monotonic()
            elif kind == "status":
                self.status = content
            elif kind == "best":
                self.best, self.has_best = content, True
            elif kind == "done":
                self.answer, self.state = content, "done"
            elif self.state == "working":
                self.error, self.state = content, "failed"
            self._changed.notify_all()


class _Process:
    """The process behind a worker; successive workers may use the same one.

    Parameters
    ----------
    module, name : str
        Of the function that it calls.
    key : hashable
        What a caller must have in common with the one that it was started for.
    """

    # The one that has been idle longest is first, so it is the first to be killed.
    idle: ClassVar[list[_Process]] = []

    @classmethod
    def of(cls, module: str, name: str) -> _Process:
        """Return an idle process, or a new one."""
        # The thread belongs to the key, because the kernel kills the process when the thread that started it ends.
        key = (module, name, os.getpid(), threading.get_ident(), tuple(sys.path), _directory(), _variables())
        for process in reversed(cls.idle):
            if process.key == key:
                # Another thread may have removed it from the list in the meantime.
                with contextlib.suppress(ValueError):
                    cls.idle.remove(process)
                    if process.alive():
                        return process
                    process.kill()
        return cls(module, name, key)

    def __init__(self, module: str, name: str, key: object) -> None:
        self.key = key
        self._started_by = os.getpid()
        self.busy = False
        self.owner: Callable[[], Worker | None] = lambda: None
        variables = dict(os.environ)
        pin(variables)
        # One thread each: a BLAS that splits sums by the number of cores would change the last bits.
        for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
            variables.setdefault(variable, "1")
        # -P: no module is imported from the current directory, into which others may write.
        command = [sys.executable, "-P", "-c", "from softrig_core.solver.worker import main; main()"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=variables)
        self.pid = self._process.pid
        self.write((os.getpid(), sys.path, module, name))
        threading.Thread(target=self._listen, daemon=True).start()

    def alive(self) -> bool:
        """Return whether the process is running."""
        return self._process.poll() is None

    def write(self, content: Any) -> None:
        """Send an object to the process."""
        assert self._process.stdin is not None
        # The process has ended; the listener reports why.
        with contextlib.suppress(BrokenPipeError):
            _send(self._process.stdin, content)

    def leave(self) -> None:
        """Release the process: an idle one is kept for another worker, a busy one is killed."""
        if self.busy or not self.alive():
            self.kill()
            return
        self.idle.append(self)
        while len(self.idle) > MOST_IDLE:
            self.idle.pop(0).kill()

    def kill(self) -> None:
        """Kill the process at any point; a worker copied by a fork leaves the process to the parent."""
        if self._started_by != os.getpid():
            _of_parents.append(self)
            return
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                # Closing flushes a request that the process had not read, and the pipe is broken by now.
                with contextlib.suppress(OSError):
                    pipe.close()

    def _listen(self) -> None:
        """Forward the process's messages until its end; hold no reference to the worker, so that its end is noticed."""

        def send(kind: str, content: Any) -> None:
            if (worker := self.owner()) is not None:
                worker.process_message(self, kind, content)

        assert self._process.stdout is not None
        while True:
            try:
                data = _read(self._process.stdout)
            # A ValueError comes when the pipe is closed under the reader.
            except (EOFError, OSError, ValueError):
                code = self._process.wait()
                how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
                send("failed", f"the process that works {how}")
                return
            try:
                kind, content = pickle.loads(data)
            # Unpickling runs the code of the object's class, which may raise anything.
            except Exception as error:
                kind, content = "failed", f"its answer cannot be read: {type(error).__name__}: {error}"
            if kind in ("done", "failed"):
                self.busy = False
            send(kind, content)


def _directory() -> str:
    try:
        return os.getcwd()
    # The current directory may have been removed.
    except FileNotFoundError:
        return ""


def _variables() -> frozenset[tuple[str, str]]:
    # pytest sets this one for each test, so no process would serve the next test.
    return frozenset((k, v) for k, v in os.environ.items() if k != "PYTEST_CURRENT_TEST")


# Processes that a fork has copied. They are stored, because closing a pipe that a thread of the parent was reading
# would never return.
_of_parents: list[_Process] = []


def _after_fork() -> None:
    _of_parents.extend(_Process.idle)
    _Process.idle.clear()


os.register_at_fork(after_in_child=_after_fork)


@atexit.register
def _end_idle() -> None:
    while _Process.idle:
        _Process.idle.pop().kill()


def _send(pipe: IO[bytes], content: Any) -> None:
    data = pickle.dumps(content, pickle.HIGHEST_PROTOCOL)
    pipe.write(LENGTH.pack(len(data)) + data)
    pipe.flush()


def _read(pipe: IO[bytes]) -> bytes:
    head = pipe.read(LENGTH.size)
    if len(head) < LENGTH.size:
        raise EOFError
    return pipe.read(LENGTH.unpack(head)[0])


def main() -> None:
    """Run the worker process: read requests until the caller closes the pipe."""
    incoming = os.fdopen(os.dup(0), "rb")
    outgoing = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    # Whatever the solver prints goes to standard error, because a print would break the pickles on standard output.
    os.dup2(2, 1)
    # Ctrl-C reaches this process too, but the caller handles it and ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent, path, module, name = pickle.loads(_read(incoming))
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    # The caller may have ended before the line above took effect.
    if os.getppid() != parent:
        os._exit(0)
    # A loop on the wall clock must not wait for this work.
    os.nice(5)
    sys.path[:] = path
    # The bytes are queued as they are: unpickling may import modules and fail, which must not end the listener.
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        try:
            while True:
                requests.put(_read(incoming))
        except (EOFError, OSError):
            os._exit(0)

    lock = threading.Lock()

    def send(kind: str, content: Any) -> None:
        with lock:
            _send(outgoing, (kind, content))

    function: Any = None
    threading.Thread(target=listen, daemon=True).start()
    while True:
        try:
            if function is None:
                function = importlib.import_module(module)
                for part in name.split("."):
                    function = getattr(function, part)
            request = pickle.loads(requests.get())
            send("begun", None)
            send("done", function(request, Work(send)))
        except Exception as error:
            traceback.print_exc()
            # Without the function no request can be answered, so each one is read and fails.
            if function is None:
                requests.get()
            frame = traceback.extract_tb(error.__traceback__)[-1]
            send("failed", f"{type(error).__name__}: {error} ({os.path.basename(frame.filename)}:{frame.lineno})")
