"""Progress of a run: a bar on a terminal and in a notebook, occasional lines elsewhere."""

from __future__ import annotations

import html
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from softrig_core.guard import is_quiet, print_line

SILENT = 1.0  # s of wall-clock time before the progress is shown
NEWS = 10.0  # s of wall-clock time between two lines
REDRAWN = 0.1  # s of wall-clock time between two states of a notebook's bar

OnTick = Callable[[int], None]


@contextmanager
def progress(title: str, duration: float) -> Iterator[OnTick]:
    """Show the progress of a run until it ends.

    Parameters
    ----------
    duration : float
        Of the run, s.

    Yields
    ------
    callable
        To be called with the time in ns.
    """
    if is_quiet():
        yield lambda t: None
        return
    if (show := _notebook()) is not None:
        yield from _cell(show, title, duration)
        return
    if not sys.stderr.isatty():
        yield _lines(title, duration)
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from .console import console

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.3g} of {task.total:.3g} s"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console(stderr=True, width=None), transient=True) as bar:
        task = bar.add_task(title, total=duration)
        yield lambda t: bar.update(task, completed=t / 1e9)


@contextmanager
def busy(text: str) -> Iterator[None]:
    """Print a line about the work within the block if it takes longer than `SILENT`."""
    if is_quiet():
        yield
        return
    timer = threading.Timer(SILENT, print_line, [text])
    timer.daemon = True  # an error of the work ends the process without waiting for it
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _notebook() -> Any:
    """Return the function of IPython that shows something, when there is a notebook to show it."""
    ipython: Any = sys.modules.get("IPython")  # only a notebook server imports it
    shell = ipython.get_ipython() if ipython is not None else None
    if shell is None or not hasattr(shell, "kernel"):
        return None
    return sys.modules["IPython.display"].display


def _cell(show: Any, title: str, duration: float) -> Iterator[OnTick]:
    """Draw a bar of HTML, which needs no widgets; it leaves an empty line."""

    def bar(seconds: float) -> dict[str, str]:
        text = f"{seconds:.3g} of {duration:g} s"
        drawn = f'<progress value="{seconds:g}" max="{duration:g}"></progress>'
        return {"text/html": f"{html.escape(title)} {drawn} {text}", "text/plain": f"{title}: {text}"}

    shown, last = show(bar(0.0), raw=True, display_id=True), time.monotonic()

    def on_tick(t: int) -> None:
        nonlocal last
        if time.monotonic() - last > REDRAWN:
            last = time.monotonic()
            shown.update(bar(t / 1e9), raw=True)

    try:
        yield on_tick
    finally:
        shown.update({"text/html": "", "text/plain": ""}, raw=True)


def _lines(title: str, duration: float) -> OnTick:
    last = time.monotonic()

    def on_tick(t: int) -> None:
        nonlocal last
        if time.monotonic() - last > NEWS:
            last = time.monotonic()
            print_line(f"{title}: {t / 1e9:.3g} of {duration:g} s")

    return on_tick
