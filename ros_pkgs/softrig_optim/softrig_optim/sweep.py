"""The same function over many cases: on the cores of this machine, or on a Dask cluster."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from softrig_core import ScenarioError
from softrig_core.extras import need

C = TypeVar("C")
R = TypeVar("R")

ATTEMPTS = 3  # of a case whose worker died under it
AHEAD = 3  # cases handed to each worker at a time: none idles, and memory stays bounded


def sweep(
    function: Callable[[C], R],
    cases: Sequence[C],
    *,
    title: str = "cases",
    workers: int | None = None,
    scheduler: str = "",
) -> list[R]:
    """Evaluate a function for every case, in parallel, with a progress bar when the error output is a terminal.

    Parameters
    ----------
    function : callable
        Importable by name, like everything in the cases and results; must depend on its case only.
    cases : sequence
    title : str
        Text beside the progress bar.
    workers : int, optional
        Processes on this machine; all cores when absent, 1 stays in this process.
    scheduler : str
        Address of a Dask scheduler (``tcp://host:8786``); its workers need this package installed.

    Returns
    -------
    list
        One result a case, in the order of the cases, whatever the number of workers.

    Raises
    ------
    ScenarioError
        A scheduler is given, but `distributed` is not installed and could not be added.
    """
    found: dict[int, R] = {}
    with progress(title, len(cases)) as advance:
        for k, result in stream(function, cases, workers=workers, scheduler=scheduler):
            found[k] = result
            advance()
    return [found[k] for k in range(len(cases))]


def stream(
    function: Callable[[C], R], cases: Iterable[C], *, workers: int | None = None, scheduler: str = ""
) -> Iterator[tuple[int, R]]:
    """Evaluate a function for every case and give each result with its case's number as soon as it is there.

    Only a few cases a worker are taken from `cases` ahead of time. A worker that is killed costs time, not results:
    the pool is made anew and what was under way is done again.

    Parameters
    ----------
    function, workers, scheduler
        See `sweep`.
    cases : iterable
        May be as long as one likes.

    Raises
    ------
    RuntimeError
        The worker of the same case died `ATTEMPTS` times.
    """
    numbered = enumerate(cases)
    if scheduler:
        yield from _on_cluster(function, numbered, scheduler)
    elif workers == 1:
        for k, case in numbered:
            yield k, function(case)
    else:
        with _own_imports():
            yield from _on_cores(function, numbered, workers or cores())


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def _on_cores(function: Callable[[C], R], cases: Iterator[tuple[int, C]], workers: int) -> Iterator[tuple[int, R]]:
    waiting: list[tuple[int, C, int]] = []  # number, case, how often its worker died
    open_: dict[Future[R], tuple[int, C, int]] = {}
    pool = _pool(workers)
    try:
        while True:
            room = workers * AHEAD - len(open_) - len(waiting)
            waiting += [(k, case, 0) for k, case in islice(cases, max(0, room))]
            try:
                while waiting:
                    open_[pool.submit(function, waiting[0][1])] = waiting[0]
                    waiting.pop(0)
                if not open_:
                    return
                for future in wait(open_, return_when=FIRST_COMPLETED).done:
                    result = future.result()
                    k = open_.pop(future)[0]
                    yield k, result
            except BrokenProcessPool:
                again = [(k, case, died + 1) for k, case, died in open_.values()]
                worst = max((died for *_, died in again), default=0)
                if worst >= ATTEMPTS:
                    k = next(k for k, _, died in again if died == worst)
                    raise RuntimeError(f"the worker of case {k} died {worst} times") from None
                waiting = again + waiting
                open_.clear()
                pool.shutdown(wait=False)
                pool = _pool(workers)
    except BaseException:
        for process in list((pool._processes or {}).values()):  # nobody wants what they work on
            process.kill()
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _pool(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _end_with_parent)


@contextmanager
def _own_imports() -> Iterator[None]:
    """Let no process that Python starts meanwhile import its own modules from the current directory."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ.pop("PYTHONSAFEPATH")
        if before is not None:
            os.environ["PYTHONSAFEPATH"] = before


def _end_with_parent() -> None:
    """End this worker when its parent has gone, whatever killed it: nobody would ever give it another case."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's; it ends us
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait_for_its_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_its_end, daemon=True).start()


def _on_cluster(function: Callable[[C], R], cases: Iterator[tuple[int, C]], scheduler: str) -> Iterator[tuple[int, R]]:
    need("distributed", f"scheduler {scheduler}")
    import distributed
    from distributed.comm import connect

    async def knock() -> None:
        comm = await connect(scheduler)
        await comm.close()

    # Not a Client at once: one that never came up is closed when it is collected as garbage, which, in the thread that
    # starts the next one's loop, waits for a lock that this start holds.
    try:
        with ThreadPoolExecutor(1) as thread:  # where a loop runs here already (a notebook), asyncio.run refuses
            thread.submit(lambda: asyncio.run(knock())).result()
    except (OSError, ValueError, TypeError) as error:  # TypeError: its own, of an address that is a word
        raise ScenarioError(f"--scheduler {scheduler}: no Dask scheduler there, expected an address as "
                            f"tcp://127.0.0.1:8786: {error}") from None  # fmt: skip
    with distributed.Client(scheduler) as client:
        numbers: dict[Any, int] = {}
        size = max(1, sum(client.nthreads().values())) * AHEAD
        done = distributed.as_completed()
        for k, case in islice(cases, size):
            future = client.submit(function, case, pure=False)
            numbers[future.key] = k
            done.add(future)
        for future in done:
            yield numbers.pop(future.key), future.result()
            for k, case in islice(cases, 1):
                new = client.submit(function, case, pure=False)
                numbers[new.key] = k
                done.add(new)


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on a terminal, a line every tenth elsewhere; gives a function to call for each case done."""
    if not sys.stderr.isatty():
        count = 0

        def advance() -> None:
            nonlocal count
            count += 1
            if total >= 20 and count * 10 // total != (count - 1) * 10 // total:
                print(f"softrig: {title}: {count} of {total}", file=sys.stderr)

        yield advance
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    name = TextColumn("{task.description}", markup=False)  # a title is text, whatever it holds
    with Progress(name, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)
