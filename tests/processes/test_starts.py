"""Real starts of all kinds of rig, outside nodes and containers included, three at a time: none is lost."""

import os
import random
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from conftest import differences
from softrig_core import run_processes
from softrig_core.processes.placement import Placement
from test_discovery import KINDS, guests, rig_and_record
from test_outside import replaced

pytestmark = [pytest.mark.long, pytest.mark.processes]


def trial(seed):
    """One start; gives what it was and what is wrong with it."""
    rng = random.Random(seed)
    kind = rng.choice([k for k in KINDS if k != "solver"])  # its work is slow, its start that of any other
    rig, expected = rig_and_record(kind)
    what = rng.random()
    outside = guests(kind, rng)[:1] if what < 0.3 else ()
    with tempfile.TemporaryDirectory() as folder:
        if outside:
            return f"{kind} with {outside} outside", replaced(rig, outside[0], Path(folder), seed)
        together = [[m.name for m in rig.members]] if what > 0.85 else []
        outcome = run_processes(rig, 0, Path(folder), Placement(containers=together))
        wrong = [outcome.error] if outcome.error else differences(expected, outcome.recording)
        wrong += [f"{n} refused {s['refused']}" for n, s in outcome.status.items() if s.get("refused")]
        return f"{kind}{' in a container' if together else ''}", wrong


@pytest.mark.timeout(3600)
def test_no_start_is_lost():
    """Some minutes on two cores; `SOFTRIG_REAL_STARTS` sets another number, `trial(seed)` repeats one."""
    number = int(os.environ.get("SOFTRIG_REAL_STARTS", "400"))
    with ThreadPoolExecutor(3) as pool:
        found = [(seed, *result) for seed, result in enumerate(pool.map(trial, range(number)))]
    assert [f"seed {seed}, {what}: {wrong}" for seed, what, wrong in found if wrong] == []
