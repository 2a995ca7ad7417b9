"""The separate process of an FMU, with a stand-in for the system: its requests, in order, and its reports."""

import errno
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest
from expected_text import check_expected
from softrig_control.fmu import child
from softrig_control.fmu.child import Isolated
from softrig_control.fmu.instance import Plan, Refusal

PURE = ("WIFSIGNALED", "WTERMSIG", "WIFEXITED", "waitstatus_to_exitcode", "WNOHANG")
ME, FMU, CALLER = 70, 71, 69  # process ids


class Exit(BaseException):
    """The end of a process."""


def word(x):
    if isinstance(x, set | frozenset):
        return "{" + ", ".join(sorted(map(word, x))) + "}"
    return x.name if isinstance(x, signal.Signals | signal.Handlers | signal.Sigmasks) else repr(x)


class System:
    """The operating system: each call is recorded and gets its prepared answer."""

    def __init__(self, **answers):
        self.calls, self.answers = [], {k: [*v] for k, v in answers.items()}

    def asked(self, name, default=None):
        def call(*arguments, **named):
            self.calls.append(
                f"{name}({', '.join([*map(word, arguments), *(f'{k}={v!r}' for k, v in named.items())])})"
            )
            assert self.answers.get(name, [True]), f"{name} once more than expected"
            result = self.answers[name].pop(0) if name in self.answers else default
            if isinstance(result, BaseException):
                raise result
            return result

        return call

    def ended(self, status):
        self.calls.append(f"_exit({status})")
        raise Exit


def played(monkeypatch, system, proc=()):
    names = ("dup2", "close", "kill", "waitpid", "wait")
    made = {name: system.asked(name) for name in names} | {name: getattr(os, name) for name in PURE}
    made |= {
        "getpid": lambda: ME,
        "fork": system.asked("fork", FMU),
        "getppid": system.asked("getppid", CALLER),
        "_exit": system.ended,
    }
    monkeypatch.setattr(child, "os", SimpleNamespace(**made))
    known = ("SIGINT", "SIG_IGN", "SIGTERM", "SIGCHLD", "SIG_BLOCK", "SIG_UNBLOCK", "SIGKILL", "SIG_DFL")
    signals = {n: getattr(signal, n) for n in known}
    asked = {n: system.asked(n) for n in ("signal", "pthread_sigmask", "sigwait")}
    monkeypatch.setattr(child, "signal", SimpleNamespace(**signals, **asked))
    library = SimpleNamespace(prctl=system.asked("prctl"))
    monkeypatch.setattr(child, "ctypes", SimpleNamespace(CDLL=lambda name: library))
    limits = SimpleNamespace(RLIMIT_CORE="core", setrlimit=system.asked("setrlimit"))
    monkeypatch.setattr(child, "resource", limits)
    monkeypatch.setattr(child, "sys", SimpleNamespace(argv=["-c", "5", str(CALLER)]))
    monkeypatch.setattr(child, "Connection", lambda number: f"pipe {number}")
    monkeypatch.setattr(child, "_answer", system.asked("answer"))

    def process(number, text):
        def read(errors="strict"):
            assert errors == "replace"
            if isinstance(text, Exception):
                raise text
            return text

        return SimpleNamespace(read_text=read, parent=SimpleNamespace(name=str(number)))

    def glob(pattern):
        assert pattern == "[0-9]*/stat"
        return [process(*p) for p in proc]

    monkeypatch.setattr(child, "Path", lambda folder: SimpleNamespace(glob=glob) if folder == "/proc" else None)


TERM, CHILD, NONE = signal.SIGTERM, signal.SIGCHLD, ChildProcessError()
# Each process with its line in /proc/PID/stat; the name may contain any character.
OURS = [
    (80, f"80 (an fmu) S {ME} 80 80"),
    (81, f"81 (a) {ME} b) R {ME} 81"),
    (82, f"82 (theirs) S {ME + 1} {ME}"),
    (83, ProcessLookupError()),
    (84, ""),
]
WAYS = {
    "the caller has gone before": {"getppid": [1]},
    "in the fork: it answers": {"fork": [0], "getppid": [CALLER, ME]},
    "in the fork: its keeper has gone before": {"fork": [0], "getppid": [CALLER, 1]},
    "the FMU ends well": {"sigwait": [CHILD], "waitpid": [(FMU, 0), (0, 0)], "wait": [(90, 0), NONE]},
    "the FMU ends with a status": {"sigwait": [CHILD], "waitpid": [(FMU, 3 << 8), NONE], "wait": [NONE]},
    "a child of the FMU ends, then the FMU crashes": {
        "sigwait": [CHILD, CHILD],
        "waitpid": [(88, 9), (0, 0), (89, 0), (FMU, signal.SIGSEGV), NONE],
        "wait": [NONE],
    },
    "the caller ends it": {"sigwait": [CHILD, TERM], "waitpid": [(0, 0)], "wait": [(FMU, 9), NONE]},
}


def conversation(monkeypatch):
    for what, answers in WAYS.items():
        system = System(**answers)
        with monkeypatch.context() as m:
            played(m, system, OURS)
            with pytest.raises(Exit):
                child.main()
        assert not any(system.answers.values()), what
        yield what
        yield from (f"  {call}" for call in system.calls)


def test_calls_of_the_system_are_as_expected(monkeypatch):
    check_expected("fmu/child", conversation(monkeypatch))


class Pipe:
    """Returns prepared objects in turn, and raises prepared errors."""

    def __init__(self, *comes, full=False):
        self.comes, self.sent, self.full, self.closed = [*comes], [], full, False

    def recv(self):
        result = self.comes.pop(0)
        if isinstance(result, Exception):
            raise result
        return result

    def send(self, what):
        if self.full:
            raise OSError(errno.EPIPE, "gone")
        self.sent.append(what)

    def close(self):
        self.closed = True


class Planned:
    def __init__(self, plan):
        if plan == "bad":
            raise ValueError("no plan")
        self.plan = plan

    def add(self, a, b):
        return f"{self.plan} {a - b}"

    def refuse(self):
        raise Refusal("too hard")


@pytest.mark.parametrize(("end", "folder"), [(EOFError(), ""), (OSError(), "/cache/fmu/0a")])
def test_calls_are_answered_until_the_other_end_is_closed(monkeypatch, end, folder):
    monkeypatch.setattr(child, "Instance", Planned)
    monkeypatch.setattr(child, "os", SimpleNamespace(_exit=System().ended))
    monkeypatch.setattr(child, "sys", SimpleNamespace(path=["old"]))
    asked = [("__init__", ("bad",)), ("__init__", ("p",)), ("add", (5, 3)), ("refuse", ()), ("nothing", ())]
    confined = []
    monkeypatch.setattr(child, "_confine", confined.append)
    pipe = Pipe((["a", "b"], folder), *asked, end)
    with pytest.raises(Exit):
        child._answer(pipe)
    assert child.sys.path == ["a", "b"]
    assert confined == [folder] * bool(folder)
    assert pipe.sent == [
        (False, "ValueError: no plan"),
        (True, None),
        (True, "p 2"),
        (False, "too hard"),
        (False, "AttributeError: 'Planned' object has no attribute 'nothing'"),
    ]
    with pytest.raises(Exit):
        child._answer(Pipe(([], ""), ("__init__", ("p",)), full=True))


class Ended:
    """The end of a process, raised once."""

    def __init__(self):
        self.alive, self.count = True, 0

    def __call__(self):
        self.alive, self.count = False, self.count + 1


def isolated(pipe, ready=True, code=0, seconds=2.5):
    one, waited = object.__new__(Isolated), []

    def wait(limit):
        waited.append(limit)
        if code is None:
            raise subprocess.TimeoutExpired("it", limit)
        return code

    asked = []
    one._seconds, one._pipe, one._end, one._plan = seconds, pipe, Ended(), "plan"
    one._poll = SimpleNamespace(poll=lambda ms: asked.append(ms) or ready)
    one._process = SimpleNamespace(wait=wait)
    return one, asked, waited


@pytest.mark.parametrize(
    ("call", "sent"),
    [
        (lambda one: one.advance(1.0, 2.0, (3.0,)), ("advance", (1.0, 2.0, (3.0,)))),
        (lambda one: one.keep(), ("keep", ())),
        (lambda one: one.restore(b"x"), ("restore", (b"x",))),
        (lambda one: one.begin(), ("begin", ())),
    ],
)
def test_a_call_is_sent_and_its_answer_returned(call, sent):
    one, asked, _ = isolated(Pipe((True, "found")))
    assert call(one) == "found"
    assert one._pipe.sent == [sent]
    assert asked == [60000.0 if sent[0] == "begin" else 2500.0]  # the time limit of a start is a minute
    assert one._end.alive


def test_a_start_may_take_as_long_as_a_call_if_that_is_longer():
    one, asked, _ = isolated(Pipe((True, ()), (True, None)), seconds=90.0)
    one.begin()
    one.tune([1])
    assert (asked, one._pipe.sent[1]) == ([90000.0, 90000.0], ("tune", ([1],)))


@pytest.mark.parametrize(
    ("pipe", "ready", "code", "text"),
    [
        (Pipe((False, "too hard")), True, 0, "too hard"),
        (Pipe(), False, 0, "gave no answer within 2.5 s"),
        (Pipe(EOFError()), True, -signal.SIGSEGV, "crashed: its process was killed by SIGSEGV"),
        (Pipe(OSError()), True, 3, "crashed: its process ended with status 3"),
        (Pipe(EOFError()), True, 1, "crashed: its process ended with status 1"),
        (Pipe(full=True), True, 0, "crashed: its process closed the pipe by which it is asked"),
        (Pipe(EOFError()), True, None, "crashed: its process closed the pipe by which it is asked"),
    ],
)
def test_a_missing_answer_is_reported_and_ends_it(pipe, ready, code, text):
    one, _, waited = isolated(pipe, ready, code)
    with pytest.raises(Refusal) as refused:
        one.keep()
    assert str(refused.value) == text
    assert one._end.count == 1
    assert waited == ([3.0] if "crashed" in text else [])
    with pytest.raises(Refusal, match=r"^has ended before$"):
        one.keep()
    assert one._end.count == 1


def test_a_new_process_begins_where_the_previous_one_ended(monkeypatch):
    one, _, _ = isolated(Pipe((True, ())))
    launched = []
    monkeypatch.setattr(one, "_launch", lambda: launched.append(setattr(one, "_end", Ended())), raising=False)
    one.begin()
    assert not launched
    one._end()
    one._pipe = Pipe((True, "anew"))
    assert one.begin() == "anew"
    assert len(launched) == 1


@pytest.mark.parametrize("late", [False, True])
def test_a_process_is_asked_to_end_and_killed_if_it_does_not(late):
    asked, pipe = [], Pipe()

    def wait(limit=None):
        asked.append(f"wait {limit}")
        if late and limit:
            raise subprocess.TimeoutExpired("it", limit)

    process = SimpleNamespace(terminate=lambda: asked.append("terminate"), kill=lambda: asked.append("kill"), wait=wait)
    child._kill(process, pipe)
    assert asked == ["terminate", "wait 3.0", *["kill", "wait None"] * late]
    assert pipe.closed


def test_it_is_launched_with_its_end_of_the_pipe_and_its_import_path(monkeypatch):
    pipe, started, registered = Pipe((True, None)), [], []

    class Theirs:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            started.append("closed")

        def fileno(self):
            return 9

    pipe.fileno = lambda: 8
    asked = {
        "register": lambda *arguments: registered.append(arguments),
        "poll": lambda ms: registered.append(ms) or True,
    }
    poll = SimpleNamespace(**asked)
    monkeypatch.setattr(child, "Pipe", lambda: (pipe, Theirs()))
    monkeypatch.setattr(child.subprocess, "Popen", lambda *arguments, **named: started.append((arguments, named)))
    monkeypatch.setattr(child.select, "poll", lambda: poll)
    plan = Plan("here", False, (), (), (), 1, False)
    one = Isolated(plan, 5.0)
    one._end.detach()
    code = "from softrig_control.fmu.child import main; main()"
    command = [sys.executable, "-P", "-c", code, "9", str(os.getpid())]
    assert started == [((command,), {"stdin": subprocess.DEVNULL, "pass_fds": [9]}), "closed"]
    assert registered == [(8, child.select.POLLIN), 60000.0]
    assert pipe.sent == [(sys.path, ""), ("__init__", (plan,))]
