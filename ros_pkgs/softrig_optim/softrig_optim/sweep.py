"""The same function over many cases: on the cores of this machine, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import Any, TypeVar

C = TypeVar("C")
R = TypeVar("R")


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
    ImportError
        A scheduler is given, but `distributed` is not installed.
    """
    with _progress(title, len(cases)) as advance:
        if scheduler:
            return _on_cluster(function, cases, scheduler, advance)
        if workers == 1:
            return [_counted(function(case), advance) for case in cases]
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=spawn) as pool:
            futures = [pool.submit(function, case) for case in cases]
            try:
                for future in as_completed(futures):
                    _counted(future.result(), advance)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
            return [future.result() for future in futures]


def _on_cluster(function: Callable[[C], R], cases: Sequence[C], scheduler: str, advance: Callable[[], None]) -> list[R]:
    try:
        import distributed
    except ImportError:
        raise ImportError(f"scheduler {scheduler}: needs the package 'distributed' (pip install distributed)") from None
    with distributed.Client(scheduler) as client:
        futures: list[Future[R]] = client.map(function, cases, pure=False)
        for _ in distributed.as_completed(futures):
            advance()
        return client.gather(futures)


def _counted(result: R, advance: Callable[[], None]) -> R:
    advance()
    return result


@contextmanager
def _progress(title: str, total: int) -> Iterator[Callable[[], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns: list[Any] = [TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)
