"""Report a block whose code does not return, and let Ctrl-C end the process in that case.

Python handles a signal between two of its own instructions, so a loop in native code of this process cannot be
interrupted. A thread checks the stacks once a second, at no cost for the ticks. It receives the signal through a pipe,
which Python's handler in C writes to.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from pathlib import Path
from types import CodeType, FrameType

from ..block.block import Block
from ..guard import print_for
from ..timebase import SECOND

LOOK = 1.0  # s between two looks
LONG = 5.0  # s in one call of a block after which it is reported
LAST = 5.0  # s from a signal to the end of the process, if the same call is still under way then
ENDS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT}
CALLS = {"setup", "first", "outputs", "advance", "update", "finish", "refused", "change", "go_on"}
NATIVE = "softrig_core.native.fitted"  # module whose `Fitted.call` answers ticks by native code
# What may take long and ends by itself: compilers, and waits for other processes, which have limits of their own.
PATIENT = (
    "numba",
    "llvmlite",
    "subprocess",
    "softrig_core.solver",
    "softrig_core.kit.jit",
    "softrig_core.kit.compiled",
    "softrig_nodes.ros.guest",
)
STUCK = "has not returned"  # part of each report, so that code that reads a process's log can find it
_STOP = b"\0"

_running: Watch | None = None


class Watch(threading.Thread):
    """Checks the running calls of blocks, until `stop`."""

    def __init__(self) -> None:
        super().__init__(name="softrig watch", daemon=True)
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._main = threading.main_thread().ident or 0
        # By thread: the call under way at the last look, and the time of the first look that saw it.
        self._seen: dict[int, tuple[FrameType, float]] = {}
        self._listens = False
        if threading.current_thread() is threading.main_thread():
            before = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
            self._listens = before == -1
            # An event loop has a file descriptor of its own there already, and keeps it.
            if not self._listens:
                signal.set_wakeup_fd(before)

    def run(self) -> None:
        """Check the calls until `stop` is called."""
        now, wait = 0.0, LOOK
        ends: tuple[int, float, FrameType | None] = 0, 0.0, None  # signal, time, the call that is to return before it
        while True:
            if select.select([self._read], [], [], wait)[0]:
                arrived = os.read(self._read, 64)
                if _STOP in arrived:
                    return
                number = next((n for n in arrived if n in ENDS), 0)
                if number and not ends[0]:
                    ends = number, now + LAST, calls().get(self._main)
                continue
            now += wait
            self._check(now, wait)
            if ends[0] and self._seen.get(self._main, (None,))[0] is not ends[2]:
                ends = 0, 0.0, None
            elif ends[2] is not None and now >= ends[1]:
                source, text = report(ends[2], f"{LAST:g} s after {signal.Signals(ends[0]).name}")
                print_for(source, f"{text}: the process is ended, and unwritten data are lost")
                # An exception in this thread would not end the process, whose main thread does not return.
                os._exit(128 + ends[0])

    def _check(self, now: float, wait: float) -> None:
        """Report the calls that have become too long since the last look."""
        seen = self._seen
        self._seen = {
            thread: seen[thread] if thread in seen and seen[thread][0] is call else (call, now)
            for thread, call in calls().items()
        }
        # A list, because another thread may release its call in the meantime.
        for call, since in list(self._seen.values()):
            # The second comparison holds at one look only, so a call is reported once.
            if now - since >= LONG > now - since - wait:
                print_for(*report(call, f"for {LONG:g} s; Ctrl-C ends the run"))

    def forget(self) -> None:
        """Release the call of this thread, which has ended: its frame would hold a run's memory until the next look."""
        self._seen.pop(threading.get_ident(), None)

    def stop(self) -> None:
        """End the checks."""
        if self._listens:
            signal.set_wakeup_fd(-1)
        os.write(self._write, _STOP)
        self.join()
        os.close(self._read)
        os.close(self._write)


@contextmanager
def watched() -> Iterator[None]:
    """Watch the blocks of this process within the ``with`` block; nested ones do nothing."""
    global _running
    if _running is not None:
        watch = _running
        try:
            yield
        finally:
            watch.forget()
        return
    _running = watch = Watch()
    watch.start()
    try:
        yield
    finally:
        _running = None
        watch.stop()


@cache
def watch_on() -> AbstractContextManager[None]:
    """Watch the blocks of this process until it ends: a thread for each run takes a fiftieth of a short one."""
    watch = watched()
    watch.__enter__()
    return watch


def _forget() -> None:
    """Forget the parent's watch after a fork, which has no watching thread and other signals."""
    global _running
    if _running is not None:
        _running = None
        # This raises an error if another thread than the main one has forked.
        with suppress(ValueError):
            signal.set_wakeup_fd(-1)


os.register_at_fork(after_in_child=_forget)


def calls() -> dict[int, FrameType]:
    """Return the outermost call of a block, or of native ticks, on the stack of each thread that is in one."""
    result: dict[int, FrameType] = {}
    for thread, top in _stacks().items():
        frame: FrameType | None = top
        while frame is not None:
            # The walk goes outwards, so what the block has called (a compiler, a wait) is met first and excuses the
            # thread.
            if str(frame.f_globals.get("__name__")).startswith(PATIENT):
                result.pop(thread, None)
                break
            if _is_call(frame.f_code, frame):
                result[thread] = frame
            frame = frame.f_back
    return result


def _stacks() -> dict[int, FrameType]:
    return sys._current_frames()  # noqa: SLF001 - documented, and the only way to another thread's stack


def _is_call(code: CodeType, frame: FrameType) -> bool:
    if code.co_name == "call":
        return frame.f_globals.get("__name__") == NATIVE
    return code.co_name in CALLS and isinstance(frame.f_locals.get("self"), Block)


def report(call: FrameType, how: str) -> tuple[str, str]:
    """Return the call that does not return, and one line with the place where it is."""
    known, deepest = call.f_locals, call
    for top in _stacks().values():  # the innermost frame of that stack
        frame: FrameType | None = top
        while frame is not None and frame is not call:
            frame = frame.f_back
        deepest = top if frame is call else deepest
    block = known["self"]
    if isinstance(block, Block):
        t = known.get("t")
        when = f" at t = {t / SECOND:.9g} s" if isinstance(t, int) else ""
        location = f"{Path(deepest.f_code.co_filename).name}, line {deepest.f_lineno}"
        return block.name or type(block).__name__, f"`{call.f_code.co_name}`{when} {STUCK} {how} ({location})"
    return "softrig", f"{block.under_way()} {STUCK} {how}"
