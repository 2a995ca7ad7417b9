"""Real starts of all kinds of rig, outside nodes and containers included, three at a time: none is lost.

Nor beside processes that join the domains of the runs, before, after and in between, and are killed at any moment.
"""

import os
import random
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
from conftest import differences
from outside import busy
from softrig_core import rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes.domain import DOMAINS
from softrig_nodes.processes.executables import environment
from softrig_nodes.processes.placement import Placement
from test_discovery import KINDS, guests, rig_and_record
from test_outside import replaced

pytestmark = [pytest.mark.long, pytest.mark.processes]


def trial(seed):
    """One start; returns its kind and what is wrong with it."""
    rng = random.Random(seed)
    kind = rng.choice([k for k in KINDS if k != "solver"])  # a solver is slow, but starts as any other node
    rig, expected = rig_and_record(kind)
    what = rng.random()
    outside = guests(kind, rng)[:1] if what < 0.3 else ()
    with tempfile.TemporaryDirectory() as folder:
        if outside:
            return f"{kind} with {outside} outside", replaced(rig, outside[0], Path(folder), seed)
        together = [[m.name for m in rig.members]] if what > 0.85 else []
        patience = {name: getattr(rig.scenario, name) * busy() for name in ("timeout", "start_timeout")}
        rig = rig_of(rig.scenario.model_copy(update=patience))
        outcome = run_processes(rig, 0, Path(folder), Placement(containers=together))
        wrong = [outcome.error] if outcome.error else differences(expected, outcome.recording)
        wrong += [f"{n} refused {s['refused']}" for n, s in outcome.status.items() if s.get("refused")]
        return f"{kind}{' in a container' if together else ''}", wrong


JOINS = "import rclpy; print(flush=True); rclpy.init(); rclpy.create_node('victim'); input()"


@contextmanager
def killings():
    """During the test, processes join one of the domains of this process' runs, and are killed."""
    over, killed = threading.Event(), []

    def kill():
        rng = random.Random(0)
        with tempfile.TemporaryDirectory() as folder:
            while not over.is_set():
                domain = DOMAINS[(os.getpid() + rng.randrange(4)) % len(DOMAINS)]
                variables = environment(domain, Path(folder))
                pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
                victim = subprocess.Popen([sys.executable, "-c", JOINS], env=variables, **pipes)
                victim.stdout.readline()
                # Kill half of them while they create files and discover others, and half after that.
                over.wait(rng.uniform(0.0, 0.1) * busy() if rng.random() < 0.5 else rng.uniform(0.1, 1.5))
                victim.kill()
                victim.communicate()
                killed.append(domain)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("beside", [nullcontext, killings])
def test_no_start_is_lost(beside):
    """It takes some minutes on two cores; `SOFTRIG_REAL_STARTS` sets another number of starts, `trial(seed)` repeats
    one.
    """
    number = int(os.environ.get("SOFTRIG_REAL_STARTS", "250"))
    with beside() as killed, ThreadPoolExecutor(3) as pool:
        results = [(seed, *result) for seed, result in enumerate(pool.map(trial, range(number)))]
    assert [f"seed {seed}, {what}: {wrong}" for seed, what, wrong in results if wrong] == []
    assert killed is None or len(killed) > number / 10
