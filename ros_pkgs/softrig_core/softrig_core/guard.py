"""Wrapper of every command: safe standard streams, and one line and an exit status for every failure."""

from __future__ import annotations

import errno
import importlib.util
import io
import os
import re
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from pathlib import Path
from typing import Any

from .errors import RunError, ScenarioError

# control characters of terminals, except tab and new line, and those that change the direction of writing
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
LINE = 1000  # characters of a failure that are shown
_quiet = False
_incomplete = False
# on machines without rclpy's wheels (they are for Linux on x86-64), everything else works as usual
WITHOUT_ROS = (
    "nodes, topics, recording and playing need ROS 2 (rclpy), which is not here: source a Jazzy installation; runs "
    "with --mode inprocess, studies, falsification, reports and bags need none"
)
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
# the caller has named a file that cannot be read or written: bad input, not a broken run
_NAMED = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError, FileExistsError)


def guarded(work: Callable[[], int]) -> int:
    """Run a command and turn every failure into one line and its exit status.

    Parameters
    ----------
    work : callable
        Returns 0 if done, 1 if done with another result than requested.

    Returns
    -------
    int
        The status of `work`, but 1 in place of 0 after `incomplete`; 2: bad input; 3: the run failed; 4: an error of
        softrig itself (its traceback is in a file); 128 plus the number of the signal that stopped it; 141: the reader
        of the output has closed it.
    """
    usual = {number: signal.getsignal(number) for number in ENDING}
    try:
        return _guarded(work)
    finally:
        for number, handler in usual.items():
            if handler is not None and signal.getsignal(number) is not handler:
                signal.signal(number, handler)


def _guarded(work: Callable[[], int]) -> int:
    global _incomplete
    secure_streams()
    _incomplete = False
    try:
        try:
            _need_directory()
            with warnings.catch_warnings():
                warnings.showwarning = partial(_warn, warnings.showwarning)
                status = work()
            return 1 if _incomplete and not status else status
        finally:
            _flush()  # while the report that the disk is full can still be printed
    except ScenarioError as error:
        # the error has a cause: it is from a user's package, whose traceback explains more than a line (a bag's does
        # not)
        own_error = type(error) is not ScenarioError or error.__cause__ is None
        print_line(error if own_error else f"{error}; the traceback is in {keep_traceback()}")
        return 2
    except BrokenPipeError:  # the reader of the output has ended, as `head` does
        return 141
    except OSError as error:
        print_line(f"{error.filename}: {error.strerror}" if error.filename is not None else error)
        return 2 if isinstance(error, _NAMED) or error.errno == errno.ENAMETOOLONG else 3
    except RunError as error:
        print_line(error)
        return 3
    except KeyboardInterrupt as error:
        if threading.current_thread() is threading.main_thread():
            # A second one would strike in the line, or in what is freed after it. One that has arrived already needs a
            # handler, because Python prints a traceback if it finds SIG_IGN instead.
            for handler in (lambda *_: None, signal.SIG_IGN):
                for number in ENDING:
                    signal.signal(number, handler)
        print_line(stopped_by(error))
        return 128 + int(getattr(error, "number", signal.SIGINT))
    except MemoryError:
        return _full()
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != "rclpy":
            return _wrong(error)
        print_line(WITHOUT_ROS)
        return 2
    except Exception as error:
        if isinstance(error, ImportError) and "failed to map segment" in str(error):  # a library under `ulimit -v`
            return _full()
        return _wrong(error)


def stopped_by(error: KeyboardInterrupt) -> str:
    """Return one line with the signal received and its notes: what is missing because of it, and how to create it."""
    notes = getattr(error, "__notes__", ())
    number = int(getattr(error, "number", signal.SIGINT))
    stopped = f"stopped by {signal.Signals(number).name}"
    return f"{stopped}: {'; '.join(notes)}" if notes else stopped


def end_within(seconds: float, status: int) -> None:
    """End the process after some time, even if threads or processes of a user's code are still running."""
    known: Any = sys.modules.get("multiprocessing")  # without this module the process has started no others
    running = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    running += known.active_children() if known else []
    names = ", ".join(thread.name for thread in running if not thread.daemon)
    if not names:
        return

    def end() -> None:
        print_line(f"{names}, started by a user's code, still runs; softrig ends without waiting for it")
        os._exit(status)

    last = threading.Timer(seconds, end)
    last.daemon = True
    last.start()


def _full() -> int:
    print_line("out of memory; a shorter run or a smaller size may fit")
    return 3


def _wrong(error: Exception) -> int:
    print_line(
        f"error of softrig itself: {type(error).__name__}: {error}; the traceback is in "
        f"{vars(error).get('log') or keep_traceback()}"
    )
    return 4


def need_ros() -> None:
    """Check that ROS 2 is installed, which everything over topics needs.

    Raises
    ------
    ScenarioError
        It is not installed; the message lists what works without it.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise ScenarioError(WITHOUT_ROS)


@contextmanager
def quietly() -> Iterator[None]:
    """Suppress the standard output and the progress within the block; errors are still reported."""
    global _quiet
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        _quiet = True
        try:
            yield
        finally:
            _quiet = False


def is_quiet() -> bool:
    """Return whether progress is suppressed (`quietly`)."""
    return _quiet


def print_line(event: object) -> None:
    """Print one short line about an event."""
    print_for("softrig", event)


def _warn(show: Callable[..., None], message: Warning | str, category: type[Warning], *remaining: Any) -> None:
    """Print a warning about an old name as one line; Python shows all others."""
    if issubclass(category, FutureWarning):
        print_line(message)
    else:
        show(message, category, *remaining)


def incomplete(event: object) -> None:
    """Print one line about input that was not read completely; the exit status is then not 0."""
    global _incomplete
    _incomplete = True
    print_line(event)


def print_for(source: str, event: object) -> None:
    """Print one line prefixed with a name; a closed output is ignored."""
    text = plain(" ".join(str(event).split()))
    with suppress(OSError, ValueError):
        # A message quotes the input first and ends with what was expected, so a long quotation loses its middle.
        shown = text if len(text) <= LINE else f"{text[: LINE // 2]} ... {text[-LINE // 2 :]}"
        print(f"{source}: {shown}", file=sys.stderr, flush=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the name of a file or folder to an OSError that lacks it; only an error of `open` has it."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def replace(path: Path, text: str | bytes) -> None:
    """Write a file completely or not at all; a link at its path is replaced, not followed."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with naming(path):
            temporary.write_bytes(text.encode() if isinstance(text, str) else text)
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """Write files, text by name, into a folder, which is created if necessary."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        replace(folder / name, text)


def plain(text: str) -> str:
    """Escape the control characters of a foreign text, because a terminal would execute them."""
    return _CONTROL.sub(lambda match: repr(match[0])[1:-1], text)


def secure_streams() -> None:
    """Open closed standard streams, and prevent a character missing in the encoding from ending the program.

    A file that is opened while a standard stream is closed gets the stream's number, so printed text would be written
    into the file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is that of the closed stream
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream: Any = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115 - for the life of the process
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def _need_directory() -> None:
    try:
        os.getcwd()
    except FileNotFoundError:
        raise ScenarioError("the current directory has been removed; change to one that exists") from None


def _flush() -> None:
    try:
        if sys.stdout is None or sys.stdout.closed:
            raise OSError(errno.EBADF, "closed by a user's code; the output is lost", "standard output")
        sys.stdout.flush()
    except OSError as error:
        error.filename = error.filename or "standard output"
        # the rest of the buffer would be written, and fail, again when Python ends
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def keep_traceback(folder: Path | None = None) -> str:
    """Write the current traceback into a separate file; return its name.

    Parameters
    ----------
    folder : Path, optional
        Made if need be; the system's temporary one when absent, or when nothing can be written there.
    """
    import tempfile
    import traceback

    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        number, name = tempfile.mkstemp(prefix="softrig-error-", suffix=".log", dir=folder)
        with os.fdopen(number, "w", encoding="utf-8", errors="replace") as file:
            file.write(f"{shlex.join(sys.argv)}\n{traceback.format_exc()}")
    except OSError as error:
        return f"no file: {error}" if folder is None else keep_traceback()
    return name
