"""Option `-n`: the tests run in forks of the process that has collected them.

Importing and collecting takes as long as the longest files. pytest-xdist repeats it in each worker; here it happens
once. A worker runs one file after the other, so that the process rigs of a file do not crowd each other.
"""

import atexit
import gc
import importlib.util
import os
import pickle
import signal
import sys
import traceback
import warnings
from contextlib import suppress
from itertools import count, groupby
from multiprocessing.connection import Pipe, wait

import pytest

gc.disable()  # off until all tests are collected: it would take a quarter of that time and find nothing
# Objects before Python looks for cycles, ten times the default, which takes a third of the time of parsing sources.
YOUNG = 20_000
AHEAD = pytest.StashKey[int]()
LATE = 20.0  # s for an interrupted worker to tear down its fixtures


def pytest_addoption(parser):
    # pytest's public `addoption` refuses short options
    parser.getgroup("forked")._addoption(
        "-n", type=int, default=0, metavar="N", help="run the tests in N forks, by file"
    )


def pytest_configure(config):
    if config.option.n and config.args_source is config.ArgsSource.TESTPATHS:
        folders = [config.rootpath / folder for folder in config.getini("testpaths")]
        config.stash[AHEAD] = _ahead([file for folder in folders for file in sorted(folder.rglob("test_*.py"))])


def _ahead(files):
    """Import test files in a fork, the last one first, and return its process; 0 in a checkout that has their bytecode.

    To rewrite and compile a fresh checkout and all that it imports takes half of the collection, on one core. The fork
    writes the bytecode of the second half in this time.
    """
    if os.path.isdir(os.path.dirname(importlib.util.cache_from_source(files[-1]))):
        return 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the reason is that of the fork of a worker
        if child := os.fork():
            return child
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    for file in reversed(files):
        sys.path.insert(0, str(file.parent))
        with suppress(BaseException):  # pytest's collection reports the error again
            importlib.import_module(file.stem)
    os._exit(0)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_finish(session):
    if child := session.config.stash.get(AHEAD, 0):
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session):
    gc.enable()
    gc.set_threshold(YOUNG)
    option = session.config.option
    if not option.n or option.collectonly or option.usepdb or session.testsfailed:
        return None
    gc.collect()
    gc.freeze()  # freezes what is loaded, so that the workers' garbage collectors leave its pages shared
    Workers(session).run(option.n)
    return True


class Worker:
    """A fork and the tests that it still has to run."""

    def __init__(self, session, folder, others):
        self.connection, child_end = Pipe()
        self.todo = []  # indices of tests, of which the first one is running
        sys.stdout.flush()
        with warnings.catch_warnings():  # OpenBLAS and jemalloc have threads, and both handle forks
            warnings.simplefilter("ignore", DeprecationWarning)
            self.pid = os.fork()
        if not self.pid:
            for connection in [self.connection, *others]:
                # A worker notices the end of its parent only if no other process holds the connection.
                connection.close()
            _work(session, child_end, folder)
        child_end.close()
        # Processes of a test may hold the worker's end of the connection open after it has died.
        self.ended = os.pidfd_open(self.pid)

    def give(self, todo):
        """Send the indices of the next tests; without any the worker ends."""
        self.todo = todo
        self.connection.send(todo)

    def close(self):
        """Wait for the end of the process and return its exit status; a late one is killed."""
        if not wait([self.ended], LATE):
            os.kill(self.pid, signal.SIGKILL)
        os.close(self.ended)
        self.connection.close()
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


class Workers:
    """Distribute files to workers and pass on what these report."""

    def __init__(self, session):
        self.session, self.config = session, session.config
        of_file = groupby(range(len(session.items)), lambda k: session.items[k].nodeid.partition("::")[0])
        self.files = [list(indices) for _, indices in of_file][::-1]  # reversed, because `pop` takes the last
        self.folder, self.numbers = self.config._tmp_path_factory.getbasetemp(), count()
        self.workers = {}  # workers by their connection

    def run(self, number):
        """Run all tests; end as pytest's own loop does."""
        try:
            for _ in range(min(number, len(self.files))):
                self.start(self.files.pop())
            while self.workers:
                ready = wait([w.ended for w in self.workers.values()] + list(self.workers))
                for worker in [w for c, w in self.workers.items() if c in ready or w.ended in ready]:
                    self.attend(worker)
                if self.session.shouldfail:
                    raise self.session.Failed(self.session.shouldfail)
                if self.session.shouldstop:
                    raise self.session.Interrupted(self.session.shouldstop)
        finally:
            for worker in self.workers.values():
                os.kill(worker.pid, signal.SIGINT)
            for worker in self.workers.values():
                worker.close()

    def start(self, todo):
        """Fork a worker for some tests."""
        folder = self.folder / f"worker-{next(self.numbers)}"
        worker = Worker(self.session, folder, list(self.workers))
        self.workers[worker.connection] = worker
        worker.give(todo)

    def attend(self, worker):
        """Process the next report of a worker, or its end."""
        try:
            if not worker.connection.poll():
                raise EOFError
            what, content = worker.connection.recv()
        except (EOFError, ConnectionError):
            del self.workers[worker.connection]
            self.lost(worker, worker.close())
            return
        if what == "report":
            self.report(self.config.hook.pytest_report_from_serializable(config=self.config, data=content))
        elif what == "warning":
            self.config.hook.pytest_warning_recorded.call_historic(kwargs=content)
        else:
            self.finished(worker)

    def report(self, report):
        self.config.hook.pytest_runtest_logreport(report=report)

    def finished(self, worker):
        """Continue after a test: the worker gets the next test of its file, or another file, or ends."""
        item = self.session.items[worker.todo.pop(0)]
        self.config.hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        if not worker.todo:
            worker.give(self.files.pop() if self.files else [])

    def lost(self, worker, status):
        """Fail the test in which a worker ended, and run the others of its file in a new worker."""
        if not worker.todo:
            return
        item = self.session.items[worker.todo[0]]
        why = f"the process of the tests ended here with status {status}"
        report = pytest.TestReport(item.nodeid, item.location, {}, "failed", why, "call")
        self.report(report)
        if worker.todo[1:]:
            self.start(worker.todo[1:])


class Sender:
    """Takes the place of pytest's terminal in a worker: reports and warnings are sent to the parent."""

    def __init__(self, config, connection):
        self.config, self.connection = config, connection
        self._tw = config.get_terminal_writer()  # pytest-timeout prints its stacks through this writer
        self.begun = False
        self.brief = config.option.durations is None and not config.option.xmlpath

    def pytest_runtest_logreport(self, report):
        if self.brief and report.passed and report.when != "call" and not report.sections:
            return  # the terminal shows nothing of the 20,000 reports of setup and teardown
        data = self.config.hook.pytest_report_to_serializable(config=self.config, report=report)
        self.connection.send(("report", data))

    def pytest_warning_recorded(self, warning_message, when, nodeid, location):
        if not self.begun:  # pytest also reports warnings from before this plugin was registered
            return
        warning_message.source = None
        try:
            pickle.dumps(warning_message)
        except Exception:  # some classes of warnings cannot be pickled
            warning_message.message, warning_message.category = Warning(str(warning_message.message)), Warning
        entries = {"warning_message": warning_message, "when": when, "nodeid": nodeid, "location": location}
        self.connection.send(("warning", entries))


def _work(session, connection, folder):
    """Run what the parent sends, in a fork, and end the process."""
    config, items = session.config, session.items
    status = 1
    try:
        folder.mkdir(mode=0o700)
        capture = config.pluginmanager.get_plugin("capturemanager")
        capture.stop_global_capturing()  # its files would share their position between all forks
        capture.start_global_capturing()
        capture.suspend_global_capture()
        sender = Sender(config, connection)
        config.pluginmanager.unregister(name="terminalreporter")
        config.pluginmanager.register(sender, "terminalreporter")
        sender.begun = True
        numbers = count()
        while todo := connection.recv():
            # pytest reads the whole base folder for each new `tmp_path`, so each file gets a base folder of its own.
            config._tmp_path_factory._basetemp = folder / str(next(numbers))
            config._tmp_path_factory._basetemp.mkdir(mode=0o700)
            for index, following in zip(todo, [*todo[1:], None], strict=True):
                after = None if following is None else items[following]
                config.hook.pytest_runtest_protocol(item=items[index], nextitem=after)
                connection.send(("finished", None))
        status = 0
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # both the terminal and the parent may send it
        session._setupstate.teardown_exact(None)
    except (EOFError, ConnectionError):  # the parent has ended
        session._setupstate.teardown_exact(None)
    except BaseException:
        traceback.print_exc()
    finally:
        atexit._run_exitfuncs()
        os._exit(status)
