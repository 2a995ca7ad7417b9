"""Workers, limits and the table of a campaign."""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import importlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

CASE_LIMIT = 240  # s; on a loaded machine too
SLICE = 25  # cases of one worker; the time limit is checked in between
LEAVE = 60.0  # s that cases still running at the end of a campaign get
MEMORY = 6 << 30  # bytes of address space for a worker; numba and pyarrow reserve much more than they use

PR_SET_PDEATHSIG = 1


class TooLong(BaseException):
    """A case did not end; not an Exception, so that nothing of the suite swallows it."""


class Stopped(BaseException):
    """The campaign has ended, at its limit or because it was killed: the case cleans up and counts as not tried."""


def _alarm(number: int, frame: object) -> None:
    raise TooLong(f"no end within {CASE_LIMIT} s")


def _stop(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)  # a second signal must not interrupt the clean-up
    raise Stopped


def work(area: str, seeds: list[int], results: multiprocessing.Queue, keep: Path | None) -> None:
    """Run the cases of some seeds; one line of findings each goes to the queue."""
    faulthandler.enable()
    # A killed campaign must not leave rigs behind: each case ends the processes it has started.
    signal.signal(signal.SIGTERM, _stop)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    signal.signal(signal.SIGALRM, _alarm)
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115 - for the life of the process
    attack = importlib.import_module(area).attack
    for seed in seeds:
        results.put((area, seed, "begun", "", 0.0))
        used = cpu()
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
            directory = Path(scratch)
            signal.alarm(CASE_LIMIT)
            try:
                attack(seed, directory)
                finding = ""
            except Stopped:
                return
            except (Exception, SystemExit, TooLong):
                finding = traceback.format_exc()
            finally:
                signal.alarm(0)
            if finding and keep is not None:
                (directory / "finding").write_text(finding)
                with contextlib.suppress(shutil.Error, OSError):  # the case may have made files unreadable
                    shutil.copytree(directory, keep / f"{area}-{seed}", dirs_exist_ok=True, symlinks=True)
        results.put((area, seed, "lost" if finding else "survived", finding, cpu() - used))


def cpu() -> float:
    """Return the CPU time of this process and of those that it has started, s."""
    spent = [resource.getrusage(process) for process in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(s.ru_utime + s.ru_stime for s in spent)


def campaign(counts: dict[str, int], first: int, limit: float, keep: Path | None, jobs: int) -> dict[str, list]:
    """Run all areas; return area to [tried, survived, findings, CPU s]. SIGTERM and SIGINT end it as the limit does."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    table = {area: [0, 0, [], 0.0] for area in counts}
    waiting = [
        (area, first + at, min(count - at, SLICE)) for area, count in counts.items() for at in range(0, count, SLICE)
    ]
    running: dict = {}
    deadline = time.monotonic() + limit

    def stop(number: int, frame: object) -> None:
        nonlocal deadline
        deadline = min(deadline, time.monotonic())

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)

    def collect(timeout: float) -> None:
        from queue import Empty

        while True:
            try:
                area, seed, state, finding, seconds = results.get(timeout=timeout)
            except Empty:
                return
            timeout = 0
            for entry in running.values():
                if entry[0] == area and seed in entry[1]:
                    entry[2] = seed if state == "begun" else None
                    if state != "begun":
                        entry[1].remove(seed)
            # A finding after the deadline only means that the worker was stopped.
            if state != "begun" and not (finding and time.monotonic() >= deadline):
                table[area][0] += 1
                table[area][1] += state == "survived"
                table[area][3] += seconds
                if finding:
                    table[area][2].append((seed, finding))

    while (waiting and time.monotonic() < deadline) or running:
        while waiting and len(running) < jobs and time.monotonic() < deadline:
            area, start, count = waiting.pop(0)
            seeds = list(range(start, start + count))
            process = context.Process(target=work, args=(area, seeds, results, keep))
            process.start()
            running[process] = [area, set(seeds), None]
        collect(0.2)
        stopped = time.monotonic() >= deadline
        for process in running if stopped else ():
            (process.terminate if time.monotonic() < deadline + LEAVE else process.kill)()
        for process in [p for p in running if not p.is_alive()]:
            collect(0.2)
            area, left, at = running.pop(process)
            # The worker died within a case or before its first; another one takes the remaining cases.
            if left and not stopped:
                at = min(left) if at is None else at
                table[area][0] += 1
                table[area][2].append((at, f"the process ended with status {process.exitcode}"))
                left.discard(at)
                waiting += [(area, seed, 1) for seed in sorted(left)]
        done = sum(row[0] for row in table.values())
        if sys.stderr.isatty():
            print(f"\r{done} of {sum(counts.values())} cases", end="", file=sys.stderr)
    return table
