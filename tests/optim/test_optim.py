"""Searches against known optima, published rules and other libraries; the optimiser node on a plant of its own."""

import gc
import math
import multiprocessing
import operator
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import faultrig
import numpy as np
import pytest
import softrig_optim.sweep as sweeping
from conftest import PATIENCE, make_scenario
from helpers import Transformer
from hypothesis import given, settings, strategies as st
from softrig_core import ByHand, Plant, RunError, ScenarioError, rig_of, run_inprocess
from softrig_core.solver.worker import Worker, _Process
from softrig_optim.algorithms import AlgorithmParams
from softrig_optim.de import DifferentialEvolution
from softrig_optim.falling import FallingCurve
from softrig_optim.genetic import Genetic
from softrig_optim.load_line import CertifiedSearch, RampScan
from softrig_optim.optimiser import Optimiser, Phase
from softrig_optim.perturb import PerturbObserve
from softrig_optim.pso import ParticleSwarm
from softrig_optim.scan import Scan
from softrig_optim.search import run
from softrig_optim.sweep import Workers, sweep
from softrig_power.baselines.algorithms import make
from softrig_power.baselines.firefly import Firefly
from softrig_power.baselines.salp import ImprovedSalpSwarm, SalpSwarm
from softrig_power.baselines.whale import Whale
from softrig_power.baselines.wolf import GreyWolf

POPULATIONS = [SalpSwarm, ImprovedSalpSwarm, ParticleSwarm, DifferentialEvolution, Firefly, GreyWolf, Whale, Genetic]
LOWER, UPPER = [0.5, 1.0], [5.0, 4.0]
OPTIMUM = np.array([2.0, 3.1])


def bowl(x):
    return float(((np.array(x) - OPTIMUM) ** 2).sum())


# the interface --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", POPULATIONS)
def test_the_same_seed_gives_the_same_search(algorithm):
    """The seed fixes every candidate; another seed gives others; a maximisation of -f is the minimisation of f."""
    histories = []
    for seed, sign in ((3, 1.0), (3, 1.0), (4, 1.0), (3, -1.0)):
        search = algorithm(LOWER, UPPER, seed, n_pop=5, n_iter=6, maximise=sign < 0.0)
        run(search, lambda x, sign=sign: sign * bowl(x))
        histories.append([e.x for e in search.history])
        assert np.all(np.array(histories[-1]) >= LOWER)
        assert np.all(np.array(histories[-1]) <= UPPER)
        assert search.best.value == (min if sign > 0.0 else max)(e.value for e in search.history)
        assert search.result == search.best.x
        assert search.expected == search.best.value
    assert histories[0] == histories[1] == histories[3] != histories[2]


def test_ask_repeats_until_reported_and_ends():
    search = ParticleSwarm([0.0], [1.0], 1, n_pop=2, n_iter=1)
    first = search.ask()
    assert search.ask() == first
    assert search.pending[0] == first
    assert len(search.pending) == 2
    with pytest.raises(ValueError, match="no value was reported yet"):
        _ = search.result
    for k in range(4):
        assert search.iteration == k // 2
        search.tell(float(k))
    assert search.done
    assert search.pending == ()
    with pytest.raises(ValueError, match="has ended"):
        search.ask()


def test_nan_is_never_accepted():
    search = ParticleSwarm([0.0], [1.0], 1)
    x = search.ask()
    with pytest.raises(ValueError, match="NaN"):
        search.tell(math.nan)
    assert search.best is None
    assert search.ask() == x


def test_infeasible_candidates_are_avoided():
    search = Genetic(LOWER, UPPER, 0, n_pop=30, n_iter=30)
    best = run(search, lambda x: math.inf if x[0] < 2.5 else bowl(x))
    assert best.x[0] == pytest.approx(2.5, abs=0.02)


def test_budget_and_stop_rule():
    search = ParticleSwarm(LOWER, UPPER, 0, budget=7)
    run(search, bowl)
    assert search.evaluations == 7
    search = ParticleSwarm(LOWER, UPPER, 0, n_pop=10, n_iter=100, stop=lambda s: s.best.value < 1e-3)
    run(search, bowl)
    assert search.best.value < 1e-3
    assert all(e.value >= 1e-3 for e in search.history[:-1])


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: ParticleSwarm([1.0], [0.0]), "lower < upper"),
        (lambda: ParticleSwarm([0.0], [math.inf]), "finite"),
        (lambda: ParticleSwarm([0.0, 0.0], [1.0]), "as many"),
        (lambda: ParticleSwarm([0.0], [1.0], budget=0), "budget"),
        (lambda: ParticleSwarm([0.0], [1.0], n_pop=0), "n_pop is 0"),
        (lambda: ParticleSwarm([0.0], [1.0], n_iter=0), "n_iter is 0"),
        (lambda: DifferentialEvolution([0.0], [1.0], n_pop=3), "needs at least 4"),
        (lambda: GreyWolf([0.0], [1.0], n_pop=2), "needs at least 3"),
        (lambda: Genetic([0.0], [1.0], n_pop=4, elite=4), "elite is 4"),
        (lambda: ImprovedSalpSwarm([0.0], [1.0]), "positive"),
        (lambda: PerturbObserve([0.0, 0.0], [1.0, 1.0]), "one variable"),
        (lambda: PerturbObserve([0.0], [1.0], initial=2.0), "initial is 2"),
        (lambda: Scan([0.0, 0.0], [1.0, 1.0]), "one variable"),
        (lambda: Scan([0.0], [1.0], n_grid=2), "n_grid is 2"),
        (lambda: RampScan([0.1], [0.9], matching=Transformer(), n_ramp=1), "n_ramp is 1"),
        (lambda: CertifiedSearch([0.1, 0.1], [0.9, 0.9], matching=Transformer()), "one command"),
    ],
)
def test_bad_settings_are_named(call, text):
    with pytest.raises(ValueError, match=text):
        call()


@pytest.mark.parametrize(
    "call",
    [
        lambda: ParticleSwarm([0.0], [1.0], budget=1),
        lambda: ParticleSwarm([0.0], [1.0], n_pop=1, n_iter=1),
        lambda: DifferentialEvolution([0.0], [1.0], n_pop=4),
        lambda: GreyWolf([0.0], [1.0], n_pop=3),
        lambda: Genetic([0.0], [1.0], n_pop=4, elite=3),
        lambda: ImprovedSalpSwarm([1e-9], [1.0]),
        lambda: PerturbObserve([0.0], [1.0], initial=0.0),
        lambda: PerturbObserve([0.0], [1.0], initial=1.0),
        lambda: Scan([0.0], [1.0], n_grid=3),
        lambda: RampScan([0.1], [0.9], matching=Transformer(), n_ramp=2),
    ],
)
def test_settings_at_their_limits_are_accepted(call):
    assert len(call().ask()) == 1


# the algorithms -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("algorithm", "close"),
    [
        (SalpSwarm, 0.05),
        (ImprovedSalpSwarm, 0.05),
        (ParticleSwarm, 1e-6),
        (DifferentialEvolution, 1e-6),
        (Firefly, 0.05),
        (GreyWolf, 0.02),
        (Whale, 0.03),
        (Genetic, 1e-3),
    ],
)
def test_every_search_finds_a_known_optimum(algorithm, close):
    """With enough evaluations each reaches the bottom of a bowl, as close as its last steps are small."""
    worst = 0.0
    for seed in range(2):
        best = run(algorithm(LOWER, UPPER, seed, n_pop=20, n_iter=60), bowl)
        worst = max(worst, float(np.abs(np.array(best.x) - OPTIMUM).max()))
    assert worst < close


@pytest.mark.parametrize("name", ["issa", "ssa", "pso", "de_rand1", "de_best1", "woa"])
def test_the_number_of_evaluations_is_as_published(name):
    search = make(name, [0.1], [0.9], 0, AlgorithmParams(), maximise=True)
    run(search, lambda x: -(x[0] ** 2))
    assert search.evaluations == 44


def test_firefly_evaluates_every_ordered_pair():
    search = make("fa_all_pairs", [0.1], [0.9], 0, AlgorithmParams(), maximise=True)
    run(search, lambda x: x[0])
    assert search.evaluations == 76


def test_perturb_observe_climbs_and_turns():
    search = PerturbObserve([0.0], [1.0], step=0.1, initial=0.25, maximise=True)
    for _ in range(12):
        search.tell(-abs(search.ask()[0] - 0.48))
    visited = [round(e.x[0], 6) for e in search.history]
    assert visited == [0.25, 0.35, 0.45, 0.55, 0.45, 0.35, 0.45, 0.55, 0.45, 0.35, 0.45, 0.55]
    assert not search.done
    edge = PerturbObserve([0.0], [0.2], step=0.1, maximise=True)
    for _ in range(6):
        edge.tell(edge.ask()[0])
    assert [round(e.x[0], 6) for e in edge.history] == [0.0, 0.1, 0.2, 0.1, 0.2, 0.1]


def test_genetic_generations_in_parallel():
    """A generation evaluated by an executor gives the search of a loop; the elite is not evaluated again."""
    serial = Genetic(LOWER, UPPER, 5, n_pop=20, n_iter=10, elite=2)
    run(serial, bowl)
    with ThreadPoolExecutor(4) as pool:
        parallel = Genetic(LOWER, UPPER, 5, n_pop=20, n_iter=10, elite=2)
        run(parallel, bowl, pool.map)
    assert parallel.history == serial.history
    assert serial.evaluations == 20 + 10 * 18


# along the load line --------------------------------------------------------------------------------------------


def operate(v, i, load, d):
    """The intersection of the load line with the polyline (v, i)."""
    R = load / d**2
    k = int(np.flatnonzero(v - R * i >= 0.0)[0])
    share = (R * i[k - 1] - v[k - 1]) / ((v[k] - v[k - 1]) - R * (i[k] - i[k - 1]))
    return v[k - 1] + share * (v[k] - v[k - 1]), i[k - 1] + share * (i[k] - i[k - 1])


@pytest.mark.parametrize("maximise", [False, True])
def test_the_first_of_equal_candidates_is_best(maximise):
    search = DifferentialEvolution(LOWER, UPPER, 1, n_pop=5, n_iter=2, maximise=maximise)
    first = search.ask()
    for _ in range(3):
        search.tell(7.0)
    assert (search.best.x, search.best.value) == (first, 7.0)
    assert search.ask() != first


@given(
    st.lists(st.floats(0.05, 1.0), min_size=3, max_size=8),
    st.lists(st.floats(0.0, 1.0), min_size=8, max_size=8),
    st.floats(2.0, 50.0),
    st.sampled_from([0.003, 0.01, 0.05]),
)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_certificate_holds_on_any_falling_curve(widths, drops, load, eps):
    """The proven bound is never below the true maximum, and the search ends within eps of it."""
    v = np.concatenate([[0.0], np.cumsum(widths)]) * 20.0
    i = np.concatenate([np.cumsum((np.array(drops[: len(widths)]) + 0.01)[::-1])[::-1], [0.0]])
    dense = np.linspace(0.0, v[-1], 4001)
    search = CertifiedSearch([0.05], [20.0], matching=Transformer(), eps=eps, n_iter=500)
    lowest, highest = (operate(v, i, load, d)[0] for d in (20.0, 0.05))
    inside = dense[(dense >= lowest) & (dense <= highest)]
    best = float((inside * np.interp(inside, v, i)).max())
    while not search.done:
        sample = operate(v, i, load, search.ask()[0])
        search.tell(sample[0] * sample[1], sample)
        assert search.bound is None or search.bound >= best * (1.0 - 1e-12)
    assert search.bound <= (1.0 + eps) * search.expected
    assert search.expected >= best / (1.0 + eps) * (1.0 - 1e-9)
    final = operate(v, i, load, search.result[0])
    assert final[0] * final[1] == pytest.approx(search.expected, rel=1e-9)


def test_a_bound_waits_for_both_ends():
    """Samples on the way to the second command bound the voltages between them, and no others."""
    v, i = np.array([0.0, 10.0, 12.0, 30.0, 40.0]), np.array([2.0, 1.9, 1.2, 1.1, 0.0])
    search = CertifiedSearch([0.05], [20.0], matching=Transformer(), transients=True)
    bounds = []
    for _ in range(3):
        d = search.ask()[0]
        for way in (0.9 * d, 1.1 * d):
            search.watch(operate(v, i, 20.0, way))
        sample = operate(v, i, 20.0, d)
        bounds.append(search.bound)
        search.tell(sample[0] * sample[1], sample)
    assert bounds == [None, None, None]
    assert search.bound >= 33.0


def test_a_certified_search_abandons_an_impossible_proof():
    """A source that changes contradicts its own samples; the search still ends, with the corrections."""
    search = CertifiedSearch([0.1], [0.9], matching=Transformer(), n_iter=30)
    while not search.done:
        # The samples bound the power by 4 W, which the source never reaches.
        sample = ((1.0, 2.0), (2.0, 1.0))[search.evaluations % 2]
        search.tell(2.0, sample)
    assert search.evaluations == 3 + 30 + 3


def test_load_line_searches_in_the_dark():
    for algorithm in (CertifiedSearch, RampScan):
        search = algorithm([0.1], [0.9], matching=Transformer())
        while not search.done:
            search.tell(0.0, (0.0, 0.0))
        assert search.expected == 0.0
        assert search.lower <= search.result[0] <= search.upper


# the node -------------------------------------------------------------------------------------------------------


class Dish(Plant):
    """A dish antenna: two drives follow their commands with a lag, the received power has a main and a side lobe."""

    def setup(self):
        self.target = (0.4, -0.2)

    def first(self):
        return (0.0, 0.0)

    def power(self, x):
        miss = math.dist(x, self.target)
        side = math.dist(x, (self.target[0] - 0.9, self.target[1] + 0.5))
        return 10.0 * math.exp(-8.0 * miss**2) + 5.0 * math.exp(-20.0 * side**2)

    def outputs(self, x, t):
        return {"objective": (self.power(x),)}

    def advance(self, x, t, command):
        return tuple(q + 0.2 * (u - q) for q, u in zip(x, command, strict=True))


DISH = {"channels": ("azimuth", "elevation"), "lower": (-1.0, -1.0), "upper": (1.0, 1.0), "unit": "rad",
        "period": 0.01, "hold_time": 0.3, "measure_window": 0.02, "settle_time": 0.5, "n_pop": 12, "n_iter": 15,
        "algorithm": "pso", "rescan_period": 0.0}  # fmt: skip
TICK = 10_000_000


class Loop:
    """The dish and the optimiser, tick by tick."""

    def __init__(self, seed=0, **changes):
        self.optimiser, self.dish = ByHand(Optimiser(**(DISH | changes))), ByHand(Dish())
        self.optimiser.reset(seed)
        self.t = 0
        self.commands = []

    def run(self, seconds, objective=None, refuse=False, **buttons):
        for _ in range(round(seconds * 100)):
            measured = self.dish.outputs(self.t)["objective"] if objective is None else (objective,)
            pressed = {name: buttons.get(name) for name in ("start", "stop", "restart")}
            if refuse:
                answer = self.optimiser.refused(self.t)
            else:
                answer = self.optimiser.update(self.t, measurement=measured, **pressed)
            self.commands.append(answer["command"])
            names = ("phase", "iteration", "evaluations", "restarts", "best_value", "bound", "azimuth", "elevation")
            self.state = dict(zip(names, answer["state"], strict=True))
            self.dish.advance(self.t, command=answer["command"])
            self.t += TICK
        return self.state


def test_the_optimiser_points_a_dish():
    """Two commands, a plant without a model: the main lobe is found, then held."""
    loop = Loop()
    state = loop.run(0.01 + 12 * 16 * 0.3)
    assert state["phase"] == Phase.HOLD
    assert state["evaluations"] == 192
    state = loop.run(1.0)
    assert loop.dish.block.power(loop.dish.x) > 9.9
    assert state["restarts"] == 0
    assert loop.commands[-1] == (state["azimuth"], state["elevation"])
    commands = np.array(loop.commands)
    assert np.all(np.abs(commands) <= 1.0)
    changes = np.flatnonzero(np.any(np.diff(commands, axis=0) != 0.0, axis=1))
    assert np.all(np.diff(changes) % 30 == 0)  # each candidate is held for 30 ticks


def test_optimiser_is_reproducible_by_seed():
    first, again, other = (Loop(seed) for seed in (1, 1, 2))
    for loop in (first, again, other):
        loop.run(5.0)
    assert first.commands == again.commands != other.commands


class Source(Optimiser):
    """A source with a voltage and a current, on a falling characteristic."""

    def objective(self, sample):
        return sample[0] * sample[1]

    def characteristic(self, n):
        return FallingCurve(n)


@pytest.mark.parametrize(("met", "again"), [(3.0, False), (3.0000001, True)])
def test_a_new_search_starts_only_beyond_the_threshold(met, again):
    """Exactly half as much again as the 2 W of the search is not beyond it."""
    about = {"channels": ("d",), "lower": (0.0,), "upper": (1.0,), "algorithm": "scan", "n_grid": 3, "tolerance": 0.0}
    block = ByHand(Source(**(DISH | about | {"restart_threshold": 0.5})))
    block.reset(0)
    messages = []
    for k in range(175):
        power = (2.0 if k <= 3 * 30 else met, 1.0)
        answer = block.update(k * TICK, measurement=power, start=None, stop=None, restart=None)
        messages.append((answer["state"][0], answer["state"][3], answer["command"][0]))
    passed = [d for _, restarts, d in messages[91:] if not restarts]
    assert max(restarts for _, restarts, _ in messages) == again
    assert ("more" in block.reports) == again
    if not again:
        # The command passes the range in two hold times.
        assert passed[:59] == pytest.approx([n / 60.0 for n in range(1, 60)])
        assert messages[-1] == (2.0, 0.0, 0.0)


# sweeps ---------------------------------------------------------------------------------------------------------


def double(x):
    return 2 * x, os.getpid()  # a spawned worker imports this file, which takes 2 s, so its tests are in the long set


def fail(x):
    raise ZeroDivisionError("case 3") if x == 3 else ValueError(x)


def test_a_sweep_keeps_the_order_with_any_number_of_workers():
    cases = [f"(2 * {k}, __import__('os').getpid())" for k in range(7)]
    by_one = sweep(eval, cases, workers=1)
    by_two = sweep(eval, cases, workers=2)
    assert [value for value, _ in by_one] == [value for value, _ in by_two] == list(range(0, 14, 2))
    assert {pid for _, pid in by_one} == {os.getpid()}
    assert os.getpid() not in {pid for _, pid in by_two}


@pytest.mark.long
def test_workers_are_reused_between_batches_and_end_with_the_block():
    with Workers(2) as workers:
        pids = [{pid for _, pid in workers.map(double, range(12))} for _ in range(3)]
        started = set(workers._pool._processes)
    assert set.union(*pids) <= started
    assert len(started) <= 2
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)


@pytest.mark.parametrize("forked", [True, False])
@pytest.mark.parametrize("cases", [[0.0, 0.0, 0.0], [0.0, 900.0, 900.0]], ids=["all answered", "some still work"])
def test_nothing_of_the_workers_is_left_when_their_block_has_ended(monkeypatch, forked, cases):
    """A thread of theirs that ends beside the interpreter can make it wait for a lock forever."""
    monkeypatch.setattr("softrig_optim.sweep._has_one_thread", lambda: forked)
    threads = set(threading.enumerate())
    with Workers(2) as workers:
        results = workers.stream(time.sleep, cases)
        assert len(list(islice(results, cases.count(0.0)))) == cases.count(0.0)
    assert set(threading.enumerate()) == threads
    assert not multiprocessing.active_children()


def test_a_sweep_passes_on_the_failure():
    with pytest.raises(ZeroDivisionError, match="case 3"):
        sweep(fail, [3], workers=1)


TRAPS = ("queue", "pickle", "socket", "runpy", "struct", "random", "tempfile", "numpy", "softrig_core", "softrig_optim")


@pytest.mark.parametrize(
    "code",
    [
        "import os; from softrig_optim.sweep import sweep; assert sweep(abs, [-1, -2], workers=2) == [1, 2]; "
        "assert 'PYTHONSAFEPATH' not in os.environ",
        "import faultrig; from softrig_core.solver.worker import Worker; worker = Worker(faultrig.Planner.solve); "
        "worker.submit((1, 0.0, 1.0, 0.0, '')); assert worker.wait(60.0) and worker.state == 'done', worker.error",
    ],
)
def test_nothing_is_imported_from_the_current_directory(code, tmp_path):
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'a').write({name!r})\n")
    script = tmp_path / "elsewhere" / "script.py"
    script.parent.mkdir()
    script.write_text(f"if __name__ == '__main__':\n    {code}\n")
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "sprung").exists()


def test_an_idle_process_serves_the_next_worker_of_its_function(monkeypatch):
    """With the same thread, directory and variables; a busy one ends with its worker."""

    def works(seconds=0.0):
        worker = Worker(faultrig.Planner.solve)
        worker.submit((1, 0.0, 1.0, seconds, ""))
        pid = worker._process.pid
        if not seconds:
            assert worker.wait(PATIENCE)
            assert (worker.state, worker.answer) == ("done", 1.5)
        return pid

    first = works()
    assert works() == first
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    other = works()
    assert other != first
    monkeypatch.undo()
    assert works(3600.0) == first
    assert not Path(f"/proc/{first}").exists()
    assert works() not in (first, other)


def test_a_completed_run_leaves_its_process_to_the_next():
    while _Process.idle:  # other tests may have left idle processes
        _Process.idle.pop().kill()
    nodes = {
        "plant": "plant",
        "source": {"executable": "source", "parameters": {"period": 0.1}},
        "planner": "planner",
        "gain": {"executable": "gain", "remap": {"lag/reference": "lag/inner_reference"}},
    }
    rig = rig_of(make_scenario(nodes, 0.3))
    first = run_inprocess(rig, 0)["planner"]
    (left,) = _Process.idle
    second = run_inprocess(rig, 0)["planner"]
    assert _Process.idle == [left]
    first.block.reset(0)
    first.block.worker.warm()  # the next request gets the idle process
    assert first.block.worker._process is left
    assert second.block.worker._process is None


def test_a_sweep_names_the_missing_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delenv("SOFTRIG_COMMAND", raising=False)  # as with an installed wheel
    with pytest.raises(
        ScenarioError, match=r"tcp://nowhere:1 needs the package 'distributed': pip install 'softrig\[dask\]'"
    ):
        Workers(scheduler="tcp://nowhere:1").map(double, [1])


@pytest.mark.long
def test_an_address_without_a_scheduler_is_named(monkeypatch):
    import dask
    import distributed  # imported first, since it sets dask's defaults

    # Collect garbage of earlier tests here; otherwise it may be collected in the starting thread of the next loop.
    factory = distributed.utils.get_loop_factory
    monkeypatch.setattr(distributed.utils, "get_loop_factory", lambda: (gc.collect(), factory())[1])
    with dask.config.set({"distributed.comm.timeouts.connect": "100ms"}):
        for address in ("nonsense", "tcp://127.0.0.1:1", "what://is", ":", "tcp://127.0.0.1:1"):
            with pytest.raises(ScenarioError, match=rf"--scheduler {address}: no Dask scheduler there"):
                Workers(scheduler=address).map(abs, [1])


class Cluster:
    """A scheduler whose workers report their versions, and that disappears when it gets work."""

    status = "closed"

    def __init__(self, scheduler=None, workers=None):
        self._scheduler, self._workers = scheduler, workers or {}

    def run_on_scheduler(self, function):
        if self._scheduler is not None:
            raise self._scheduler
        return function()

    def nthreads(self):
        return dict.fromkeys(self._workers or ["w"], 1)

    def run(self, function, on_error):
        assert on_error == "return"
        return {
            address: function() | result if isinstance(result, dict) else result
            for address, result in self._workers.items()
        }

    def submit(self, *_, **__):
        import distributed

        raise distributed.comm.CommClosedError("gone")

    def close(self):
        pass


def test_workers_without_softrig_or_with_other_versions_are_named():
    sweeping._check_peers(Cluster(workers={"tcp://a:1": {}}), "tcp://s:8786")
    lacks = ModuleNotFoundError("No module named 'softrig_optim'")
    for cluster, text in (
        (
            Cluster(scheduler=lacks),
            "--scheduler tcp://s:8786: it cannot import softrig (No module named 'softrig_optim')",
        ),
        (Cluster(workers={"tcp://a:1": {}, "tcp://b:2": lacks}), "worker tcp://b:2 cannot import softrig"),
        (Cluster(workers={"tcp://a:1": {"numpy": "1.0"}}), "worker tcp://a:1 has numpy 1.0, here "),
    ):
        with pytest.raises(ScenarioError) as refused:
            sweeping._check_peers(cluster, "tcp://s:8786")
        assert str(refused.value).startswith(text)
        assert "has numpy" in text or "start it by `scripts/softrig python -m distributed.cli.dask_" in str(
            refused.value
        )


def test_a_disappeared_scheduler_is_reported_with_how_to_continue(monkeypatch):
    import distributed

    monkeypatch.setattr(distributed, "as_completed", lambda: iter(()))
    workers = Workers(scheduler="tcp://s:8786")
    workers._client = Cluster()
    with pytest.raises(
        RunError, match=r"the scheduler has gone; finished work is kept, and the same command resumes it"
    ):
        workers.map(abs, [1])


def test_a_sweep_runs_on_a_local_cluster():
    import distributed

    local = distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None)
    with local, Workers(scheduler=local.scheduler_address) as workers:
        assert workers.map(operator.neg, range(5)) == [0, -1, -2, -3, -4]
        first = workers._client
        assert workers.map(abs, [-1]) == [1]
        assert workers._client is first


FORKED = """
import json, os, sys
from softrig_optim import sweep
from softrig_optim.sweep import Workers
made = []  # by this process alone, which a process of its own start would lack

def told(case):
    private = [line.split()[1] for line in open("/proc/self/smaps_rollup") if line.startswith("Private_Dirty")]
    return made, os.getppid(), sum(map(int, private)) / 1024, case, os.getpid()

if __name__ == "__main__":
    made.append(os.getpid())
    with Workers(2) as workers:
        found = workers.map(told, range(6))
        if len(sys.argv) < 2:  # those in the place of a killed one are copies, too
            # A worker that is left could answer all cases before the end of the other one is noticed.
            for pid in {pid for *_, pid in found}:
                os.kill(pid, 9)
            after = workers.map(told, range(6))
            assert {tuple(own) for own, *_ in after} == {tuple(made)}, after
            assert not {pid for *_, pid in after} & {pid for *_, pid in found}
            assert max(private for _, _, private, _, _ in after) < 35.0, after
    assert {tuple(own) for own, *_ in found} == ({tuple(made)} if len(sys.argv) < 2 else {()}), found
    assert {parent for _, parent, *_ in found} == {os.getpid()}
    assert [case for *_, case, _ in found] == list(range(6))
    assert len(sys.argv) > 1 or max(private for _, _, private, _, _ in found) < 35.0, found
"""


@pytest.mark.parametrize("threads", [[], ["a thread"]])
def test_workers_are_forked_if_nothing_would_be_lost(tmp_path, threads):
    """They share what their parent has imported: 35 MB of their own at most; beside a thread they are started fresh."""
    script = FORKED
    if threads:
        script = FORKED.replace(
            "    made.append",
            "    import threading as th; th.Thread(target=th.Event().wait, daemon=True).start()\n    made.append",
        )
    (tmp_path / "study.py").write_text(script)
    done = subprocess.run([sys.executable, "study.py", *threads], capture_output=True, text=True, cwd=tmp_path,
                          timeout=PATIENCE, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
