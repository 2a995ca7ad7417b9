"""Solver nodes: only simulated time decides when a result takes effect, whatever the work takes."""

import gc
import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import PATIENCE, differences, in_process, make_scenario, until
from faultrig import Planner, Unreadable, unreadable
from simulated import SimulatedRig, World
from softrig_core import ByHand, RunError, Signals, Solver, rig_of
from softrig_core.solver.worker import Worker
from softrig_nodes import run_processes


def rig(duration=1.0, timeout=10.0, **planner):
    nodes = {
        "plant": "plant",
        "source": {"executable": "source", "parameters": {"period": 0.1}},
        "planner": {"executable": "planner", "parameters": planner},
        "gain": {"executable": "gain", "remap": {"lag/reference": "lag/inner_reference"}},
    }
    return rig_of(make_scenario(nodes, duration, timeout=timeout))


def asked_at(recording):
    """The request whose plan is in effect at each tick of the planner, s; -1: none."""
    return np.round(Signals(recording)["lag/plan/asked_at/position"].x, 9).tolist()


def test_the_loop_waits_without_latency():
    recording = in_process(rig())
    assert asked_at(recording) == pytest.approx([0.1 * k for k in range(10)])
    # The plan of a tick uses the state and the reference of that tick.
    signals = Signals(recording)
    x = signals["lag/state/x/position"].x[::10][:10]
    wanted = signals["lag/reference/x/position"].x
    np.testing.assert_array_equal(signals["lag/inner_reference/x/position"].x, wanted + 0.5 * (wanted - x))


def test_a_plan_takes_effect_its_latency_later_and_the_newest_request_is_next():
    recording = in_process(rig(latency=0.25))
    # The request of t = 0 takes effect at 0.3 s. By then the newest request is that of 0.3 s, which takes effect at
    # 0.6 s.
    assert asked_at(recording) == [-1.0] * 3 + [0.0] * 3 + [0.3] * 3 + [0.6]


def test_only_simulated_time_decides():
    """Work that takes no time and work that takes longer than the latency: the same bytes."""
    quick, slow = (in_process(rig(0.7, latency=0.2, work=work)) for work in (0.0, 0.25))
    assert differences(quick, slow) == []
    assert asked_at(quick) == [-1.0] * 2 + [0.0] * 2 + [0.2] * 2 + [0.4]


def drive(block, ticks, first=0):
    result = []
    for k in range(first, first + ticks):
        x = 0.01 * k
        result.append(block.update(round(k * 1e8), state=(x, 0.0), reference=(1.0,)))
    return result


def test_reset_kills_the_work_and_repeats_the_run():
    block = ByHand(Planner(latency=0.2, work=0.1))
    first = drive(block, 4)
    pid = block.block.worker._process.pid
    block.reset(0)
    assert not os.path.exists(f"/proc/{pid}")
    assert drive(block, 4) == first


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("raise", r"request of t = 0.1 s failed: ArithmeticError: deliberate \(faultrig.py:\d+\)"),
        ("kill", "request of t = 0.1 s failed: the process that works was killed by SIGKILL"),
    ],
)
def test_failed_work_ends_a_run_and_is_reported_in_real_time(fault, reason):
    block = ByHand(Planner(fault=fault))
    with pytest.raises(RunError, match=reason):
        drive(block, 2)
    block.reset(0)
    block.block.realtime = True
    results = []
    for k in range(5):  # in two halves, with all the time for the work in between
        block.x = block.block.begin(block.x, k * 100_000_000, state=(0.01 * k, 0.0), reference=(1.0,))
        assert block.block.worker.wait(PATIENCE)
        block.x, values = block.block.end(block.x, k * 100_000_000)
        block.store_reports()
        results.append(values)
    # The second computation failed, so a new process makes the third plan.
    assert [round(v["plan"][0], 9) for v in results] == [0.0, 0.0, 0.2, 0.3, 0.4]
    assert block.reports["work"][2] == 1


def test_a_refused_request_starts_no_work():
    block = ByHand(Planner())
    (first,) = drive(block, 1)
    assert block.refused(100_000_000) == first
    assert block.x.asked == 1


def test_a_worker_ends_with_its_owner_and_with_the_process_that_started_it():
    worker = Worker(Planner.solve)
    worker.submit((1, 0.0, 1.0, 3600.0, ""))
    pid = worker._process.pid
    del worker
    assert not os.path.exists(f"/proc/{pid}")
    code = (
        "import os, signal; from faultrig import Planner; from softrig_core.solver.worker import Worker\n"
        "worker = Worker(Planner.solve); worker.submit((1, 0.0, 1.0, 3600.0, ''))\n"
        "while not worker.has_best: worker.wait(0.01)\n"
        "print(worker._process.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, timeout=PATIENCE)
    assert done.returncode == -signal.SIGKILL
    orphan = int(done.stdout)
    status = Path(f"/proc/{orphan}/status")
    until(lambda: not status.exists() or "State:\tZ" in status.read_text())


def test_work_in_an_endless_call_ends_with_the_process_that_started_it():
    """It holds Python's lock, so no thread of its process sees that the pipe is closed; the kernel ends it."""
    code = (
        "import os, signal; from faultrig import deaf; from softrig_core.solver.worker import Worker\n"
        "worker = Worker(deaf); worker.submit(3600)\n"
        "while not worker.has_best: worker.wait(0.01)\n"
        "print(worker._process.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, timeout=PATIENCE)
    status = Path(f"/proc/{int(done.stdout)}/status")
    until(lambda: not status.exists() or "State:\tZ" in status.read_text())


def test_a_request_that_cannot_be_read_fails_and_the_next_is_worked_on():
    worker = Worker(Planner.solve)
    worker.submit(Unreadable())
    assert worker.wait(PATIENCE)
    assert worker.state == "failed"
    assert worker.error.startswith("ValueError: invalid literal for int()")
    worker.submit((1, 0.0, 1.0, 0.0, ""))
    assert worker.wait(PATIENCE)
    assert (worker.state, worker.answer) == ("done", 1.5)
    worker.cancel()


def test_an_answer_that_cannot_be_read_is_a_failure():
    worker = Worker(unreadable)
    worker.submit(None)
    assert worker.wait(PATIENCE)
    assert worker.state == "failed"
    assert worker.error.startswith("its answer cannot be read: ValueError: invalid literal for int()")
    worker.cancel()


def test_the_result_of_a_solver_is_checked():
    with pytest.raises(NotImplementedError):
        ByHand(Solver()).update(0)


@pytest.mark.processes
def test_nodes_give_the_bits_of_the_blocks_while_the_work_exceeds_their_timeout(tmp_path):
    """A plan of 3.7 s against a timeout of 3 s: the others are informed that the planner is busy.

    The second case: a node that has not begun yet may take as long as a start.
    """
    wired = rig(0.2, timeout=3.0, work=3.7, fault="late")
    outcome = run_processes(wired, 0, tmp_path)
    assert outcome.error == ""
    assert differences(in_process(rig(0.2)), outcome.recording) == []


@pytest.mark.long
@pytest.mark.processes
def test_with_latency_the_nodes_continue_in_the_meantime(tmp_path):
    wired = rig(0.8, latency=0.25, work=0.3)
    outcome = run_processes(wired, 0, tmp_path)
    assert outcome.error == ""
    assert differences(in_process(rig(0.8, latency=0.25)), outcome.recording) == []


@pytest.mark.long
@pytest.mark.processes
def test_work_that_dies_ends_the_run_and_is_named(tmp_path):
    outcome = run_processes(rig(0.5, fault="kill"), 0, tmp_path)
    assert "planner" in outcome.error
    assert "request of t = 0.1 s failed: the process that works was killed by SIGKILL" in outcome.error


def test_a_realtime_node_answers_every_tick_while_a_plan_is_made():
    """A plan takes three ticks of the loop."""
    world = World()
    run = SimulatedRig(rig(60.0, period=0.01), world, "realtime")
    world.match()
    planner = run.adapters["planner"]
    until = run.epoch
    while (result := planner.step.x.jobs.result) is None or result.stamp == 0:
        until += 10_000_000
        world.run(until + 1_000_000)
        assert until < run.epoch + 60_000_000_000
    ticks = (until - run.epoch) // 10_000_000
    assert planner.ticks == ticks + 1
    assert planner.drive.missed == planner.drive.incomplete == 0
    signal = Signals(run.recording, run.epoch)["lag/plan/asked_at/position"]
    first, second, *_ = [a for a, _ in itertools.groupby(signal.x) if a >= 0.0]
    # The second request is the newest one at the tick at which the first plan takes effect.
    used = signal.t[np.argmax(signal.x == first)]
    assert (first, second) == (0.0, pytest.approx(used, abs=1e-9))


def works(queue=None):
    """The process that worked for a planner."""
    worker = Worker(Planner.solve)
    worker.submit((1, 0.0, 1.0, 0.0, ""))
    pid = worker._process.pid
    assert worker.wait(PATIENCE)
    assert (worker.state, worker.answer) == ("done", 1.5)
    worker.release()
    if queue is not None:
        queue.put(pid)
    return pid


@pytest.fixture
def no_garbage():
    """No worker of another test is collected during the test: its process would be idle, too, and replace an
    older one.
    """
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.long
def test_a_fork_leaves_the_idle_processes_of_its_parent_alone(monkeypatch, no_garbage):
    """Python forks by default for `multiprocessing`; closing the parent's pipes would block forever."""
    monkeypatch.setattr("softrig_core.solver.worker.MOST_IDLE", 1)
    first = works()
    owned = Worker(Planner.solve)
    owned.warm()  # uses the idle process
    assert owned._process.pid == first
    second = works()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()

    def child():
        owned.cancel()
        works(queue)

    forked = context.Process(target=child)
    forked.start()
    third = queue.get(timeout=PATIENCE)
    forked.join(PATIENCE)
    assert forked.exitcode == 0
    assert third not in (first, second)
    assert works() == second
    owned.submit((1, 0.0, 1.0, 0.0, ""))
    assert owned.wait(PATIENCE)
    assert (owned._process.pid, owned.state) == (first, "done")
