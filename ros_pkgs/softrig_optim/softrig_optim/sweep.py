"""The same function over many cases: on the cores of this machine, or on a Dask cluster."""

from __future__ import annotations

import gc
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

from softrig_core import RunError, ScenarioError
from softrig_core.extras import need
from softrig_core.guard import is_quiet, print_line

# Pools and their modules are imported where processes begin: most uses have one case, or one process.
if TYPE_CHECKING:
    from concurrent.futures import Future, ProcessPoolExecutor

    from .template import Template

C = TypeVar("C")
R = TypeVar("R")
Chunk = list[tuple[int, C]]  # cases and their numbers

# The number of times that a worker may die at one case: a case that kills its worker must not run for ever.
ATTEMPTS = 3
# Wall-clock time in s between two progress lines, so that a few long cases show that they still run.
NEWS = 10.0
# Chunks submitted for each worker: no worker idles between two of them, and memory stays bounded.
AHEAD = 3
# The time in s that the cases of a chunk take together: with much less, passing them on costs as much as they do.
CHUNK = 0.25
# The same for a cluster, in s, where each task costs milliseconds of its scheduler.
FAR = 5.0
LARGEST = 1000  # cases of a chunk
YOUNG = 5_000  # new objects between two searches for reference cycles in a worker


class Workers:
    """Processes of this machine, or a Dask cluster, that evaluate functions and are reused from batch to batch.

    A process keeps what it has imported or compiled for all later cases. All have ended when the ``with`` block has
    ended; those that still work are terminated. If this process has a single thread, they are forked from it when the
    block begins and share all its imports; so are those that take the place of killed ones (`Template`). Otherwise they
    are started fresh with the first case.

    Parameters
    ----------
    count : int, optional
        Number of processes on this machine; default: all cores. With 1, functions are evaluated in this process.
    scheduler : str
        Address of a Dask scheduler (``tcp://host:8786``); its workers need this package installed.
    """

    def __init__(self, count: int | None = None, scheduler: str = "") -> None:
        self._count, self._scheduler = count or cores(), scheduler
        self._pool: ProcessPoolExecutor | None = None
        self._template: Template | None = None
        self._client: Any = None
        # The time of a case in s, over the newest chunks.
        self._mean = math.inf
        self._frozen = False

    def __enter__(self) -> Workers:
        if self._count > 1 and not self._scheduler and _has_one_thread():
            # A garbage collection in a forked worker would touch, and so copy, all memory that it shares with this
            # process.
            gc.freeze()
            from concurrent.futures import ProcessPoolExecutor
            from multiprocessing import get_context

            from .template import Template

            self._template = Template()
            self._pool = ProcessPoolExecutor(self._count, get_context("fork"), _end_with_parent)
            # This starts the workers now, before a progress bar has its thread, because a fork copies one thread only.
            self._pool.submit(_freeze)
            gc.unfreeze()
        return self

    def __exit__(self, *_: object) -> None:
        if self._client is not None:
            self._client.close()
        if self._frozen:
            gc.unfreeze()
        if self._pool is not None:
            for process in list((self._pool._processes or {}).values()) if self._pool._pending_work_items else ():
                # No result is read any more, so waiting for a long case would only delay an error, or what follows.
                process.kill()
            # The executor's thread must end here. If the interpreter ends beside it, either may find closed what it
            # wakes the other by; the interpreter then does not wait for the thread, stops it while it holds a lock, and
            # waits for this lock forever (CPython 3.13.0, `weakref_cb` of concurrent/futures/process.py).
            self._pool.shutdown(cancel_futures=True)
        if self._template is not None:
            self._template.close()

    def stream(self, function: Callable[[C], R], cases: Iterable[C]) -> Iterator[tuple[int, R]]:
        """Evaluate a function for every case; yield each result with its case's number as soon as it is available.

        Only a few chunks per worker are taken from `cases` in advance. A chunk has as many cases as take a quarter of a
        second (on a cluster 5 s). If a worker is killed, no result is lost: the processes are created again, and the
        unfinished cases are repeated one by one.

        Parameters
        ----------
        function : callable
            Importable by name, like everything in the cases and results; must depend on its case only.
        cases : iterable
            May be of any length.

        Raises
        ------
        ScenarioError
            There is no such scheduler, or `distributed` is not installed and could not be added.
        RuntimeError
            The worker of the same case died `ATTEMPTS` times.
        """
        numbered = enumerate(cases)
        if self._scheduler:
            yield from self._on_cluster(function, numbered)
        elif self._count == 1:
            for k, case in numbered:
                result = function(case)
                if not self._frozen:
                    self._frozen = _freeze()
                yield k, result
        else:
            yield from self._on_cores(function, numbered)

    def map(self, function: Callable[[C], R], cases: Sequence[C], done: Callable[[], object] = bool) -> list[R]:
        """Evaluate a function for every case; returns the results in the order of the cases. See `stream`.

        Parameters
        ----------
        function, cases
        done : callable
            Called after each.
        """
        results: dict[int, R] = {}
        for k, result in self.stream(function, cases):
            results[k] = result
            done()
        return [results[k] for k in range(len(cases))]

    def _chunks(self, cases: Iterator[tuple[int, C]], room: int, seconds: float, workers: int) -> Iterator[Chunk[C]]:
        """Split cases into a number of chunks; a small number of cases is spread over all workers."""
        # Before the first result the mean is infinite, so that the first chunks have one case each.
        size = max(1, min(LARGEST, int(seconds / max(self._mean, 1e-6))))
        used = list(islice(cases, room * size))
        size = min(size, -(-len(used) // workers)) if len(used) < room * size else size
        # Without cases the size is 0, which `range` refuses as a step.
        for first in range(0, len(used), size or 1):
            yield used[first : first + size]

    def _numbered(self, chunk: Chunk[C], answer: tuple[list[R], float]) -> Iterator[tuple[int, R]]:
        """Return the results of a chunk, with the numbers of its cases."""
        result, seconds = answer
        mean = seconds / len(chunk)
        # The newest chunk counts half, so that the size follows a sweep whose cases become slower or faster.
        self._mean = mean if self._mean == math.inf else (self._mean + mean) / 2
        return zip((k for k, _ in chunk), result, strict=True)

    def _on_cores(self, function: Callable[[C], R], cases: Iterator[tuple[int, C]]) -> Iterator[tuple[int, R]]:
        from concurrent.futures import FIRST_COMPLETED, wait
        from concurrent.futures.process import BrokenProcessPool

        # The number beside a chunk counts how often its worker died.
        waiting: list[tuple[Chunk[C], int]] = []
        open_: dict[Future[tuple[list[R], float]], tuple[Chunk[C], int]] = {}
        while True:
            room = max(0, self._count * AHEAD - len(open_) - len(waiting))
            waiting += [(chunk, 0) for chunk in self._chunks(cases, room, CHUNK, self._count)]
            try:
                while waiting:
                    open_[self._submit(function, waiting[0][0])] = waiting[0]
                    waiting.pop(0)
                if not open_:
                    return
                for future in wait(open_, return_when=FIRST_COMPLETED).done:
                    answer = future.result()
                    yield from self._numbered(open_.pop(future)[0], answer)
            except BrokenProcessPool:
                # The pool does not name the case that killed its worker, so all open ones are repeated one by one.
                again = [([case], died + 1) for chunk, died in open_.values() for case in chunk]
                worst = max((died for _, died in again), default=0)
                if worst >= ATTEMPTS:
                    k = next(chunk[0][0] for chunk, died in again if died == worst)
                    raise RuntimeError(f"the worker of case {k} died {worst} times") from None
                waiting = again + waiting
                open_.clear()
                if self._pool is not None:
                    self._pool.shutdown()
                self._pool = None

    def _submit(self, function: Callable[[C], R], chunk: Chunk[C]) -> Future[tuple[list[R], float]]:
        with _own_imports():
            if self._pool is None:
                from concurrent.futures import ProcessPoolExecutor
                from multiprocessing import get_context

                context = get_context("spawn" if self._template is None else "forkserver")
                self._pool = ProcessPoolExecutor(self._count, context, _end_with_parent)
            return self._pool.submit(_each_here, function, [case for _, case in chunk])

    def _on_cluster(self, function: Callable[[C], R], cases: Iterator[tuple[int, C]]) -> Iterator[tuple[int, R]]:
        need("distributed", f"scheduler {self._scheduler}")
        from concurrent.futures import CancelledError

        import distributed

        if self._client is None:
            self._client = _connected(self._scheduler)
            _check_peers(self._client, self._scheduler)
        client = self._client
        open_: dict[Any, Chunk[C]] = {}
        workers = max(1, sum(client.nthreads().values()))
        done = distributed.as_completed()

        def submit(room: int) -> None:
            for chunk in self._chunks(cases, room, FAR, workers):
                # Dask would give equal chunks of a pure function one key, by which only one of them could be found
                # here.
                future = client.submit(_each, function, [case for _, case in chunk], pure=False)
                open_[future.key] = chunk
                done.add(future)

        try:
            submit(workers * AHEAD)
            for future in done:
                yield from self._numbered(open_.pop(future.key), future.result())
                submit(1)
        except (CancelledError, OSError, distributed.comm.CommClosedError) as error:
            # With a running client the error comes from the case itself, not from the connection.
            if isinstance(error, OSError) and client.status == "running":
                raise
            raise RunError(
                f"--scheduler {self._scheduler}: the scheduler has gone; finished work is kept, and the same command "
                "resumes it"
            ) from None


def _each(function: Callable[[C], R], cases: Sequence[C]) -> tuple[list[R], float]:
    """Evaluate a function for the cases of a chunk, in a worker; return the results and the time used, s."""
    started = time.perf_counter()
    return [function(case) for case in cases], time.perf_counter() - started


# Objects are frozen after the first chunk only, because its imports are what the garbage collection shall skip.
_own: list[bool] = []


def _each_here(function: Callable[[C], R], cases: Sequence[C]) -> tuple[list[R], float]:
    """Run the case in a dedicated worker."""
    result = _each(function, cases)
    if not _own:
        _own.append(_freeze())
        # New objects of some short runs, among which a search takes as long as among those of one run.
        gc.set_threshold(YOUNG, *gc.get_threshold()[1:])
    return result


def _freeze() -> bool:
    """Exclude imported objects from garbage collection, which would take a tenth of a short case."""
    # Only the young generations: a collection of everything that is imported takes longer than many a study.
    gc.collect(1)
    gc.freeze()
    return True


def sweep(
    function: Callable[[C], R], cases: Sequence[C], *, title: str = "cases", workers: int | None = None
) -> list[R]:
    """Evaluate a function for every case, in parallel, with a progress bar when the error output is a terminal.

    Parameters
    ----------
    function, cases
        See `Workers.stream`.
    title : str
        Text beside the progress bar.
    workers : int, optional
        See `Workers`; no more than there are cases.

    Returns
    -------
    list
        One result a case, in the order of the cases, whatever the number of workers.
    """
    with Workers(min(workers or cores(), max(1, len(cases)))) as pool, progress(title, len(cases)) as advance:
        return pool.map(function, cases, advance)


def _has_one_thread() -> bool:
    """Return whether a copy of this process would have all of it: of threads it has the one that copied."""
    try:
        return len(os.listdir("/proc/self/task")) == 1
    # This system has no /proc, so a fork is not known to be safe.
    except OSError:
        return False


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


@contextmanager
def _own_imports() -> Iterator[None]:
    """Keep Python processes that are started in the block from importing modules from the current directory."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ.pop("PYTHONSAFEPATH")
        if before is not None:
            os.environ["PYTHONSAFEPATH"] = before


def _end_with_parent() -> None:
    """End this worker when its parent process has ended for any reason, because it would never receive another case."""
    # Ctrl-C reaches the whole process group; the parent handles it and ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A fork inherits the handler of its parent, which would not end this process.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    from multiprocessing import parent_process

    parent = parent_process()
    assert parent is not None

    def wait_for_its_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_its_end, daemon=True).start()


def _connected(scheduler: str) -> Any:
    """Return a client of a Dask scheduler."""
    import asyncio
    from concurrent.futures import ThreadPoolExecutor

    import distributed
    from distributed.comm import connect

    async def knock() -> None:
        comm = await connect(scheduler)
        await comm.close()

    # No Client is created before the scheduler has answered. A Client that never came up is closed when it is collected
    # as garbage; in the thread that starts the loop of the next one, this waits for a lock which that start holds.
    try:
        # A thread of its own, because in a notebook a loop runs already and asyncio.run refuses to start another one.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(lambda: asyncio.run(knock())).result()
    # distributed itself raises a TypeError for an address that is a plain word.
    except (OSError, ValueError, TypeError) as error:
        raise ScenarioError(
            f"--scheduler {scheduler}: no Dask scheduler there, expected an address as tcp://127.0.0.1:8786: {error}"
        ) from None
    return distributed.Client(scheduler)


def _versions() -> dict[str, str]:
    """Describe everything that affects numbers on this host; also runs on workers."""
    from importlib.metadata import version

    return {"Python": ".".join(map(str, sys.version_info[:2]))} | {n: version(n) for n in ("softrig_core", "numpy")}


def _check_peers(client: Any, scheduler: str) -> None:
    """Ensure that scheduler and workers can import softrig, in the versions of this host.

    Raises
    ------
    ScenarioError
        One cannot import it, or has other versions; the message explains how to start them.
    """
    how = "start it by `scripts/softrig python -m distributed.cli.dask_{kind}` of the same checkout and packages"
    try:
        client.run_on_scheduler(_versions)
    # Unpickling on the scheduler may raise anything, as it runs other versions of other packages.
    except Exception as error:
        why = str(error).splitlines()[0][:200]
        raise ScenarioError(
            f"--scheduler {scheduler}: it cannot import softrig ({why}); {how.format(kind='scheduler')}"
        ) from None
    if not client.nthreads():
        print_line(f"no worker has joined {scheduler} yet: waiting; {how.format(kind='worker')}")
        client.wait_for_workers(1)
    local = _versions()
    for address, result in client.run(_versions, on_error="return").items():
        if isinstance(result, Exception):
            why = str(result).splitlines()[0][:200]
            raise ScenarioError(f"worker {address} cannot import softrig ({why}); {how.format(kind='worker')}")
        if wrong := [
            f"{name} {result.get(name)}, here {want}" for name, want in local.items() if result.get(name) != want
        ]:
            raise ScenarioError(f"worker {address} has {', '.join(wrong)}; expected the versions of this host")


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar, a line now and then where there is no terminal; returns a function to call for each case."""
    if is_quiet():
        yield lambda: None
        return
    if not sys.stderr.isatty():
        count, last = 0, time.monotonic()

        def advance() -> None:
            nonlocal count, last
            count += 1
            tenth = total >= 20 and count * 10 // total != (count - 1) * 10 // total
            if tenth or time.monotonic() - last > NEWS:
                last = time.monotonic()
                print(f"softrig: {title}: {count} of {total}", file=sys.stderr, flush=True)

        yield advance
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    # A title may hold square brackets, which rich would read as its markup.
    name = TextColumn("{task.description}", markup=False)
    with Progress(name, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)
