"""Plugin of pytest: one line of JSON for each test, in the file that SOFTRIG_TRACED_TESTS names."""

import json
import os
import time
from contextlib import suppress
from pathlib import Path

import pytest
import sitecustomize as lines

reports = []  # outcomes of the phases of the running test


def pytest_sessionstart(session):
    lines.begin()
    _tell_native()


def _tell_native():
    """Record the lines of functions that run as native code, for which no interpreter reports a line."""
    from softrig_core.kit.jit import Jit
    from softrig_core.native.fitted import Fitted

    def keep(function):
        todo, known = [function], set()
        while todo:
            function = todo.pop()
            code = function.__code__
            if code in known or not (file := lines.place(code.co_filename)):
                continue
            known.add(code)
            lines.executed.setdefault(file, set()).update(line for _, _, line in code.co_lines() if line)
            names = (function.__globals__.get(name) for name in code.co_names)
            todo += [one.py_func for one in names if isinstance(one, Jit)]

    call, direct, fitted = Jit.__call__, Jit.direct.fget, Fitted.__init__

    def called(self, *arguments):
        keep(self.py_func)
        return call(self, *arguments)

    def fit(self, kept, *remaining):
        for function, *_ in kept.text.program.known:
            keep(function)
        fitted(self, kept, *remaining)

    Jit.__call__, Fitted.__init__ = called, fit
    Jit.direct = property(lambda self: keep(self.py_func) or direct(self))


def pytest_runtest_logreport(report):
    reports.append(report.outcome)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Trace one test, in the process that runs it: with `-n` a fork, which writes its own lines."""
    lines.here()
    reports.clear()
    started = time.perf_counter()
    try:
        return (yield)
    finally:
        seconds = time.perf_counter() - started
        outcome = next((o for o in reports if o != "passed"), "passed")
        executed = {file: set(numbers) for file, numbers in lines.executed.items()}
        for place, line in _of_processes(item.nodeid):
            executed.setdefault(place, set()).add(line)
        test = {
            "test": item.nodeid,
            "seconds": round(seconds, 3),
            "outcome": outcome,
            "lines": {file: sorted(numbers) for file, numbers in executed.items()},
        }
        out = os.open(os.environ["SOFTRIG_TRACED_TESTS"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        os.write(out, (json.dumps(test) + "\n").encode())  # in one call, as several workers write to the file
        os.close(out)


def _of_processes(nodeid):
    """Lines that processes of this test have executed, read from their files, which are then removed."""
    for file in Path(lines.FOLDER).iterdir():
        with suppress(FileNotFoundError):  # another worker has read and removed its file
            head, *reported = file.read_text().splitlines() or [""]
            if head == f"# {nodeid}":
                file.unlink()
                places = (one.rpartition(":") for one in reported)
                yield from ((place, int(line)) for place, _, line in places if line.isdigit())
