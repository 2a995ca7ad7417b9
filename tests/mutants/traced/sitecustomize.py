"""Which lines of the suite a test executes, also in processes that it starts: their files have the name of the test.

Python imports it at its start where this folder is on PYTHONPATH. A line is recorded once in each process, so that
loops keep their speed. Needs Python 3.12.
"""

import fcntl
import os
import sys
from contextlib import suppress
from functools import cache

FOLDER = os.environ.get("SOFTRIG_TRACED")  # folder for the results; without it nothing is traced
ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__)))))
events = sys.monitoring
executed = {}  # executed lines by file, of the test that runs in this process
_out = [-1]  # descriptor of the results in a process that a test has started


@cache
def place(name):
    """The path of one of our files in the checkout, or ''."""
    if name.startswith("<"):
        return ""
    path = os.path.realpath(name)
    inside = path.startswith(f"{ROOT}/") and not path.startswith((f"{ROOT}/.", __file__))
    return path[len(ROOT) + 1 :] if inside else ""


def record_line(code, line):
    """Record a line, once."""
    file = place(code.co_filename)
    if file:
        if _out[0] < 0:
            executed.setdefault(file, set()).add(line)
        else:
            with suppress(OSError):  # the traced program may have closed it
                os.write(_out[0], f"{file}:{line}\n".encode())
    return events.DISABLE


def begin():
    """Record lines from here on."""
    events.use_tool_id(events.COVERAGE_ID, "mutants")
    events.register_callback(events.COVERAGE_ID, events.events.LINE, record_line)
    events.set_events(events.COVERAGE_ID, events.events.LINE)
    os.register_at_fork(after_in_child=child)


def here():
    """Record the lines of this process from here on, also in a fork that runs tests."""
    _out[0] = -1
    executed.clear()
    events.restart_events()


def child():
    """Write to a file of this process from here on: it may end at any time."""
    name = os.environ.get("PYTEST_CURRENT_TEST", "")
    opened = os.open(f"{FOLDER}/{os.getpid()}", os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
    # A high number, which a test does not reuse after it has closed a stream.
    _out[0] = fcntl.fcntl(opened, fcntl.F_DUPFD_CLOEXEC, 500)
    os.close(opened)
    os.write(_out[0], f"# {name.rpartition(' ')[0]}\n".encode())
    events.restart_events()


if FOLDER and "PYTEST_CURRENT_TEST" in os.environ:
    begin()
    child()
