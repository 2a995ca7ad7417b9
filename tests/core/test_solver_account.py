"""Solvers and workers without a process.

Sources: the contract that `solver.py` begins with, and the page solver, as a list of events.
"""

import os
import random
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from softrig_core import Block, ByHand, Jobs, Level, Plant, RunError, Solver, SolverParams, jit, scalars
from softrig_core.solver import worker as module
from softrig_core.solver.solver import UNFINISHED
from softrig_core.solver.worker import MOST_IDLE, Work, Worker
from softrig_nodes import rehearsal
from softrig_nodes.rehearsal import rehearse


class Memory(NamedTuple):
    """The state of the solver of the test."""

    requests: int = 0
    jobs: Jobs = Jobs()


class Asking(Solver[SolverParams]):
    """Makes the requests that the test sets."""

    INPUTS = OUTPUTS = ()

    def first(self):
        return Memory()

    def request(self, x, t, *, ask):
        return x._replace(requests=x.requests + 1), ask

    @staticmethod
    def solve(request, work):
        raise NotImplementedError

    def answer(self, x, t, result, new):
        return x, (result and (result.stamp, result.answer, result.repeatable), new)


class Hands:
    """Replaces a worker; the test decides when it is done."""

    def __init__(self, function=None):
        self.state, self.job, self.struck, self.has_best, self.error, self.status = "idle", None, False, False, "", {}
        self.warmed = self.cancelled = 0
        self.best_there = False
        self.log, self.seconds, self.answer = [], 0.0, None

    def warm(self):
        self.warmed += 1

    def submit(self, request, job):
        assert self.state != "working"
        self.state, self.job, self.struck, self.has_best = "working", job, False, False
        self.log.append(request)

    def cancel(self):
        self.state, self.job = "idle", None
        self.cancelled += 1

    def strike(self):
        self.state, self.struck, self.answer = "done", True, "best" if self.has_best else None

    def elapsed(self):
        self.has_best = self.best_there
        return self.seconds

    def wait(self, seconds):
        self.log.append(seconds)
        self.finish()

    def finish(self, failed=False):
        if self.state == "working":
            self.state, self.error = ("failed" if failed else "done"), "bad"
            self.answer = f"answer to {self.job.request}"

    def release(self):
        self.log.append("rest")


def solver(monkeypatch, latency, cancels=False, realtime=False, limit=300.0):
    monkeypatch.setattr("softrig_core.solver.solver.Worker", Hands)
    monkeypatch.setattr(Asking, "CANCELS", cancels)
    block = Asking(SolverParams(latency=latency, limit=limit), "asking")
    block.realtime = realtime
    block.reset(0)
    return ByHand(block)


@pytest.mark.parametrize("cancels", [False, True])
@pytest.mark.parametrize("latency", [0.0, 0.1, 0.25])
def test_a_solver_ticks_as_its_independent_description_says(latency, cancels, monkeypatch):
    """Random requests; each result takes effect at the first tick that is not before its latency."""
    rng, held = random.Random(int(100 * latency) + cancels), solver(monkeypatch, latency, cancels)
    ns = round(latency * 1e9)
    waiting = active = result = None
    effect, worked = 0, []
    for k in range(80):
        t, ask = k * 100_000_000, f"r{k}" if rng.random() < 0.5 else None
        if ask:
            waiting = (t, ask)
            if cancels and active and t < effect:
                active = None
        new = False
        for _ in range(2):  # a result that takes effect makes room for the next request
            if not active and waiting:
                active, waiting, effect = waiting, None, t + ns
                worked.append(active[1])
            if active and t >= effect and not new:
                result, active, new = (active[0], f"answer to {active[1]}", True), None, True
        assert held.update(t, ask=ask) == (result, new)
        assert held.x.requests == k + 1
        assert held.block.working(held.x) == bool(active or waiting)
    log = held.block.worker.log
    assert [entry for entry in log if isinstance(entry, str)] == worked
    assert {entry for entry in log if not isinstance(entry, str)} == {0.251}  # s until the limit is checked again
    assert (held.block.worker.cancelled > 0) == (cancels and latency > 0.1)
    assert held.reports == {}
    held.block.release()
    assert log[-1] == "rest"


def test_a_time_limit_uses_the_best_so_far(monkeypatch):
    node = solver(monkeypatch, 0.0, limit=2.0)
    work = node.block.worker
    for k, (seconds, best, reported) in enumerate(
        [(2.0, True, ""), (2.1, True, "best answer so far after 2 s"), (2.1, False, "no answer after 2 s")]
    ):
        work.seconds, work.best_there = seconds, best
        stamp, answer, repeatable = node.update(k, ask="r")[0]
        assert (stamp, repeatable) == (k, not reported)
        assert answer == ("answer to r" if not reported else "best" if best else None)
        assert node.reports.get("limit", (0, ""))[1] == (f"{reported}: this result does not repeat" if reported else "")
    assert node.reports["limit"][0] is Level.WARN
    assert [s for s in work.log if s != "r"] == [pytest.approx(0.001)]


def test_work_that_fails_ends_a_run(monkeypatch):
    node = solver(monkeypatch, 0.0)
    monkeypatch.setattr(node.block.worker, "wait", lambda seconds: node.block.worker.finish(failed=True))
    with pytest.raises(RunError, match=r"^work on the request of t = 0\.25 s failed: bad$"):
        node.update(250_000_000, ask="r")


def test_a_tick_in_real_time_uses_the_messages_that_have_arrived(monkeypatch):
    node = solver(monkeypatch, 0.2, realtime=True)
    work, tenth = node.block.worker, 100_000_000
    assert node.update(0, ask="a") == (None, False)
    assert node.update(1 * tenth, ask=None) == (None, False)
    assert node.reports == {}  # the result is not due yet
    assert node.update(2 * tenth, ask="b") == (None, False)
    assert node.reports[UNFINISHED] == (
        Level.OK,
        "the work was not done when its result was due: answered without it",
        1,
    )
    work.finish()
    assert node.update(3 * tenth, ask=None) == ((0, "answer to a", True), True)
    assert work.job.request == "b"
    assert node.health() == {"work": "request of t = 0.2 s, 0.0 s"}
    work.status, work.seconds = {"gap": 0.1234567891, "node": 7}, 1.26
    assert node.health() == {"work": "request of t = 0.2 s, 1.3 s", "gap": "0.123456789", "node": "7"}
    work.finish(failed=True)
    assert node.update(4 * tenth, ask=None) == ((0, "answer to a", True), False)  # before its latency has passed
    assert node.update(5 * tenth, ask=None) == ((0, "answer to a", True), False)
    assert node.reports["work"] == (Level.ERROR, "work on the request of t = 0.2 s failed: bad", 1)
    assert node.health() == {"work": "idle"}
    node = solver(monkeypatch, 0.0, realtime=True)
    node.update(0, ask="a")  # the plan is due at once, so a missing result is no report
    assert node.reports == {}
    node = solver(monkeypatch, 0.0, cancels=True, realtime=True)
    node.update(0, ask="a")
    node.update(tenth, ask="b")  # the running computation is killed, even if it is late
    assert (node.block.worker.cancelled, node.block.worker.job.request) == (1, "b")
    node.block.worker.finish()
    node.update(2 * tenth, ask="c")
    assert node.block.worker.cancelled == 1


def test_going_back_repeats_the_work_again(monkeypatch):
    node = solver(monkeypatch, 0.2)
    node.update(0, ask="a")
    kept = node.save()
    node.update(100_000_000, ask=None)
    node.load(kept)
    # The same request is already being computed.
    assert (node.block.worker.log, node.block.worker.cancelled) == (["a"], 0)
    node.update(200_000_000, ask="b")
    node.load(kept)
    node.refused(100_000_000)
    assert [e for e in node.block.worker.log if isinstance(e, str)] == ["a", "b", "a"]
    assert node.block.worker.cancelled == 1
    node.load(kept._replace(x=Memory()))
    node.refused(100_000_000)
    assert (node.block.worker.cancelled, node.block.worker.state) == (2, "idle")


# a worker with a stand-in for its process
# -----------------------------------------------------------------------------


class Process:
    """The part of a process that a worker uses."""

    made: list[Any] = []

    @classmethod
    def of(cls, module, name):
        cls.made.append(result := cls())
        result.call = (module, name)
        return result

    def __init__(self):
        self.busy, self.dead, self.left, self.log, self.owner = False, False, 0, [], None

    def alive(self):
        return not self.dead

    def write(self, content):
        self.log.append(content)

    def kill(self):
        self.dead = True

    def leave(self):
        self.left += 1


@pytest.fixture
def hands(monkeypatch):
    monkeypatch.setattr(module, "_Process", Process)
    monkeypatch.setattr(Process, "made", [])
    return Process.made


def test_a_worker_knows_the_state_of_its_work(hands, monkeypatch):
    worker = Worker(rehearse)
    fresh = {
        "state": "idle",
        "answer": None,
        "best": None,
        "has_best": False,
        "status": {},
        "error": "",
        "struck": False,
        "job": None,
    }

    def now(worker=worker, **other):
        assert {k: getattr(worker, k) for k in fresh} == fresh | other

    now()
    assert (worker.elapsed(), hands) == (0.0, [])
    worker.release()
    worker.warm()
    worker.warm()
    (process,) = hands
    assert process.call == ("softrig_nodes.rehearsal", "rehearse")
    assert process.owner() is worker
    worker.submit("r", job := object())
    now(state="working", job=job)
    assert (process.log, process.busy) == (["r"], True)
    with pytest.raises(RuntimeError, match="a worker does one thing at a time; cancel it first"):
        worker.submit("s")
    assert worker.wait(0.0) is False
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: 5.0))
    worker.process_message(process, "begun", None)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: 7.5))
    assert worker.elapsed() == 2.5
    worker.process_message(process, "status", {"gap": 1.0})
    worker.process_message(process, "best", "b")
    worker.process_message(object(), "done", "of another process")
    now(state="working", job=job, status={"gap": 1.0}, best="b", has_best=True)
    worker.process_message(process, "done", "a")
    now(state="done", job=job, status={"gap": 1.0}, best="b", has_best=True, answer="a")
    assert worker.wait(0.0) is True
    worker.process_message(process, "failed", "its end")  # messages after the answer are ignored
    now(state="done", job=job, status={"gap": 1.0}, best="b", has_best=True, answer="a")
    worker.submit("s")
    now(state="working")
    assert worker.elapsed() == 0.0
    worker.process_message(process, "failed", "why")
    now(state="failed", error="why")
    worker.release()
    assert (process.left, worker.state) == (1, "failed")
    worker.submit("u", 7)
    assert len(hands) == 2  # started another process
    worker.release()
    assert hands[1].left == 0  # a busy process is not returned
    worker.process_message(hands[1], "best", "b")
    worker.strike()
    now(state="done", answer="b", has_best=True, struck=True, job=7)
    assert hands[1].dead
    worker.submit("v")
    worker.strike()
    now(state="done", struck=True)
    worker.submit("w")
    worker.cancel()
    now()
    worker.cancel()
    assert [p.dead for p in hands] == [False, True, True, True]
    assert [p.left for p in hands] == [1, 0, 0, 0]
    worker.warm()
    hands[-1].dead = True
    worker.warm()  # a dead process is replaced
    assert len(hands) == 6
    now.__defaults__ = ()
    del worker
    assert hands[-1].left == 1


def test_a_function_that_cannot_be_found_by_its_name_is_refused():
    for function in (lambda request, work: None, hands):
        if "<" not in function.__qualname__:
            continue
        with pytest.raises(
            ValueError, match="of test_solver_account cannot be imported by another process; expected a"
        ):
            Worker(function)


class Pipe:
    """Records what is written."""

    def __init__(self):
        self.data, self.closed = b"", False

    def write(self, data):
        self.data += data

    def flush(self):
        pass

    def close(self):
        self.closed = True


class Started:
    """A process object without a process."""

    def __init__(self, command, **options):
        self.command, self.options, self.pid, self.ended, self.killed = command, options, 77, None, 0
        self.stdin, self.stdout = Pipe(), Pipe()

    def poll(self):
        return self.ended

    def kill(self):
        self.killed += 1
        self.ended = -9

    def wait(self):
        return self.ended


def test_processes_without_an_owner_serve_the_next_of_the_same_call(monkeypatch):
    monkeypatch.setattr(module.subprocess, "Popen", Started)
    monkeypatch.setattr(
        module.threading, "Thread", lambda target, daemon: type("T", (), {"start": lambda self: None})()
    )
    monkeypatch.setattr(module._Process, "idle", [])
    monkeypatch.setattr(module, "_of_parents", [])
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    of, idle = module._Process.of, module._Process.idle
    first = of("m", "f")
    assert {k: first._process.options["env"][k] for k in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")} == {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "3",
    }
    assert (first.pid, first.busy, first.owner(), first.alive()) == (77, False, None, True)
    assert module.pickle.loads(first._process.stdin.data[8:]) == (os.getpid(), module.sys.path, "m", "f")
    first.leave()
    assert idle == [first]
    assert of("m", "g") is not first
    assert of("m", "f") is first
    assert idle == []
    first.leave()
    monkeypatch.setenv("OTHER", "1")
    assert of("m", "f") is not first  # a process with other environment variables cannot be used
    monkeypatch.delenv("OTHER")
    first._process.ended = 0
    assert of("m", "f") is not first
    assert (idle, first._process.killed) == ([], 1)
    busy = of("m", "f")
    busy.busy = True
    busy.leave()
    assert (idle, busy._process.killed, busy._process.stdin.closed, busy._process.stdout.closed) == ([], 1, True, True)
    many = [of("m", f"f{k}") for k in range(MOST_IDLE + 2)]
    for process in many:
        process.leave()
    assert idle == many[2:]
    assert [p._process.killed for p in many] == [1, 1] + [0] * MOST_IDLE
    module._after_fork()
    assert idle == []
    assert set(many[2:]) <= set(module._of_parents)
    of_parent = of("m", "h")
    of_parent._started_by = os.getpid() + 1
    of_parent.kill()
    assert (of_parent._process.killed, of_parent in module._of_parents) == (0, True)
    again = [of("m", f"f{k}") for k in range(3)]
    for process in again:
        process.leave()
    module._end_idle()
    assert (idle, [p._process.killed for p in again]) == ([], [1, 1, 1])


def test_a_listener_passes_on_messages_until_the_end(monkeypatch):
    read, write = os.pipe()
    for content in (("begun", None), ("status", {"gap": 1}), ("done", 5)):
        with os.fdopen(os.dup(write), "wb") as pipe:
            module._send(pipe, content)
    with os.fdopen(write, "wb") as pipe:
        pipe.write(module.LENGTH.pack(3) + b"bad")
    for status, how in ((3, "ended with status 3"), (0, "ended with status 0"), (-9, "was killed by SIGKILL")):
        process = object.__new__(module._Process)
        process._process, process.busy, received = Started([]), True, []
        process._process.stdout, process._process.ended = (
            os.fdopen(os.dup(read), "rb") if status == 3 else os.fdopen(os.open(os.devnull, os.O_RDONLY), "rb"),
            status,
        )
        taker = type(
            "Taker",
            (),
            {"process_message": lambda self, p, kind, content, h=received: h.append((kind, content, p.busy))},
        )()
        process.owner = lambda taker=taker: taker
        process._listen()
        if status == 3:
            assert received[:3] == [("begun", None, True), ("status", {"gap": 1}, True), ("done", 5, False)]
            kind, text, _ = received[3]
            assert kind == "failed"
            assert text.startswith("its answer cannot be read: UnpicklingError: ")
        assert received[-1][:2] == ("failed", f"the process that works {how}")
        process.owner = lambda: None
        process._process.stdout.close()
    os.close(read)
    messages: list[Any] = []
    work = Work(lambda *reported: messages.append(reported))
    work.status(gap=0.5, node=3)
    work.best("b")
    assert messages == [("status", {"gap": 0.5, "node": 3}), ("best", "b")]


# warm-up: a tick before the first one
# ---------------------------------------------------------------------------------


@jit
def compiled(x):
    return x


class Law(Block):
    INPUTS = (scalars("a", "a", {"x": ""}, safe=(2.0,)),)
    OUTPUTS = ()
    done: list[Any] = []

    def update(self, x, t, *, a):
        self.done.append((self.name, t, a))
        return x, {}

    def warm_up(self):
        self.done.append("warm")


class Body(Plant):
    OUTPUTS = (scalars("a", "a", {"x": ""}),)
    done: list[Any] = []

    def outputs(self, x, t):
        self.done.append("outputs")
        return {"a": (1.0,)}

    def advance(self, x, t):
        self.done.append("advance")
        raise ValueError("not said here")

    def warm_up(self):
        self.done.append("warm")


def test_a_rehearsal_is_a_tick_that_is_discarded(monkeypatch):
    monkeypatch.setattr(Law, "done", [])
    monkeypatch.setattr(Body, "done", [])
    assert rehearse(Law, Law().p, "law")  # the module of this block has a compiled function
    assert Law.done == [("law", 0, (2.0,)), "warm"]
    assert rehearse(Body, Body().p, "body", always=True)
    assert Body.done == ["outputs", "advance"]
    assert not rehearse(Asking, SolverParams(), "asking", always=True)
    monkeypatch.setattr(rehearsal, "_native", lambda block_class: False)
    assert not rehearse(Law, Law().p, "law")
    assert rehearse(Law, Law().p, "law", True)
    assert len(Law.done) == 4
