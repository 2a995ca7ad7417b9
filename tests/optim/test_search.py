"""The one interface of all searches, and a search as a value of a block's state."""

import copy
import math
import os
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from types import SimpleNamespace

import numpy as np
import pytest
from softrig_optim.pso import ParticleSwarm
from softrig_optim.scan import Scan
from softrig_optim.search import Search, SearchHistory, run
from softrig_optim.sweep import Workers, _own_imports, progress, sweep


class Walk(Search):
    """Continues from its results and from samples on the way; ends after five values."""

    def moves(self):
        seen = 0.0
        for k in range(5):
            self.iteration = k
            self.settle = k % 2 == 0
            (cost,) = yield [(0.1 * k + 0.01 * self.passed + 0.001 * self.rng.random(),)]
            seen += cost

    watches = True
    passed = 0.0

    def watch(self, sample):
        self.passed += sample[0]


def test_a_search_as_a_value_continues_from_any_of_its_past():
    """It continues also after another branch has begun at the same state; searches with equal calls are equal."""
    made = []

    def make(rng):
        made.append(Walk([0.0], [1.0], rng))
        return made[-1]

    rng = np.random.default_rng(4)
    begin = SearchHistory(make, rng)
    assert (begin.low, begin.high, begin.watches, begin.settle, begin.gap) == ((0.0,), (1.0,), True, True, math.inf)
    assert math.isnan(begin.expected)
    line = [begin]
    for k in range(3):
        watched = line[-1].watch((float(k),))
        assert watched != line[-1]
        line.append(watched.tell(5.0 - k))
    assert len(made) == 1  # all states share one search object
    assert [reported.now.evaluations for reported in line] == [0, 1, 2, 3]
    assert len(made) > 1
    candidates = [reported.now.ask() for reported in line]
    assert len(set(candidates)) == 4
    assert [reported.expected for reported in line[1:]] == [5.0, 4.0, 3.0]
    assert [reported.settle for reported in line] == [True, False, True, False]
    other = line[1].watch((9.0,))
    assert other.now.ask() != line[2].now.ask()
    assert [reported.now.ask() for reported in line] == candidates
    again = SearchHistory(make, rng, [("watch", ((0.0,),)), ("tell", (5.0, ()))])
    assert again == line[1] != line[2]
    assert again != "else"
    copied = copy.copy(line[2])
    assert (copied, copied.now.ask()) == (line[2], candidates[2])
    assert rng.random() == np.random.default_rng(4).random()  # no number was drawn from the generator
    native = line[2].native()
    assert native[1:] == (line[2].low, line[2].high, True, True, math.inf, 4.0)
    assert native.python() is line[2]


def test_a_search_reports_what_it_knows():
    search = ParticleSwarm([0.0], [1.0], 0, n_pop=2, n_iter=1, maximise=True)
    assert (search.bound, search.gap, search.settle, search.watches, search.remembers) == (
        None,
        math.inf,
        True,
        False,
        True,
    )
    for read in (lambda: search.result, lambda: search.expected):
        with pytest.raises(ValueError, match="no value was reported yet"):
            read()
    search.watch((1.0,))
    search.tell(-1.0, [3, 4])
    assert search.sample == (3, 4)
    search.tell(-2.0)
    assert (search.sample, search.expected, search.iteration) == ((), -1.0, 1)
    one = ParticleSwarm([0.0], [1.0], budget=1, stop=lambda s: False)
    one.tell(1.0)
    assert one.done
    whole = run(ParticleSwarm([0.0], [1.0], n_pop=3, n_iter=2, budget=4), lambda x: x[0])
    assert whole.value == whole.x[0]
    edge = ParticleSwarm([0.0], [1.0], n_pop=1, n_iter=1)
    assert run(edge, lambda x: x[0]).value <= edge.history[0].value
    assert edge.evaluations == 2
    for lower, upper in (([1.0], [1.0]), ([], []), ([[0.0]], [[1.0]]), ([0.0], [math.nan])):
        with pytest.raises(ValueError, match=r"^lower = .*, upper = .*: expected "):
            ParticleSwarm(lower, upper)
    assert Scan([0.0], [1.0], n_grid=3, tolerance=0.0).pending == [(0.0,), (0.5,), (1.0,)]


def test_progress_is_reported_by_tenths_or_after_ten_seconds(monkeypatch, capsys):
    """Without a terminal; nothing in quiet mode."""
    clock = [0.0]
    monkeypatch.setattr("softrig_optim.sweep.time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr("sys.stderr.isatty", lambda: False)

    def progress_lines(total, seconds=0.0):
        with progress("cases", total) as advance:
            for _ in range(total):
                clock[0] += seconds
                advance()
        return [int(line.split()[2]) for line in capsys.readouterr().err.splitlines()]

    assert progress_lines(20) == [*range(2, 21, 2)]
    assert progress_lines(19) == []
    assert progress_lines(30) == [*range(3, 31, 3)]
    assert progress_lines(5, 6.0) == [2, 4]
    assert progress_lines(3, 10.0) == [2]
    monkeypatch.setattr("softrig_optim.sweep.is_quiet", lambda: True)
    assert progress_lines(20) == []


@pytest.mark.parametrize(
    ("mean", "room", "workers", "cases", "sizes"),
    [
        (math.inf, 6, 2, 10, [1] * 6),  # as long as the duration of a run is unknown, chunks have one case
        (1.0, 6, 2, 10, [1] * 6),
        (0.125, 3, 2, 10, [2, 2, 2]),  # two cases of 0.125 s fill a quarter of a second
        (0.0625, 3, 2, 10, [4, 4, 2]),
        (0.0625, 3, 4, 10, [3, 3, 3, 1]),  # the last cases are spread over all workers
        (0.0625, 3, 2, 3, [2, 1]),
        (0.0, 2, 2, 2500, [1000, 1000]),
        (1e-9, 2, 2, 1500, [750, 750]),
        (0.125, 0, 2, 10, []),
        (0.125, 3, 2, 0, []),
    ],
)
def test_cases_are_sent_in_chunks_of_a_quarter_of_a_second(mean, room, workers, cases, sizes):
    pool = Workers(workers)
    pool._mean = mean
    left = iter(enumerate(range(cases)))
    chunks = list(pool._chunks(left, room, 0.25, workers))
    assert [len(chunk) for chunk in chunks] == sizes
    assert [case for chunk in chunks for case in chunk] == [(k, k) for k in range(sum(sizes))]
    assert next(left, (sum(sizes),))[0] == sum(sizes)  # no case was taken from the iterator in advance


def test_the_duration_of_a_case_is_estimated_from_the_newest_chunks():
    pool, means = Workers(2), []
    for seconds in (4.0, 1.0, 6.0):
        assert list(pool._numbered([(7, "a"), (9, "b")], (["x", "y"], seconds))) == [(7, "x"), (9, "y")]
        means.append(pool._mean)
    assert means == [2.0, 1.25, 2.125]


@pytest.mark.parametrize("deaths", [0, 1, 2, 3])
def test_a_case_whose_worker_dies_three_times_is_abandoned_and_no_other_is_lost(monkeypatch, deaths):
    asked = []

    def submit(self, function, chunk):
        numbers, future = [k for k, _ in chunk], Future()
        asked.append(numbers)
        if 5 in numbers and sum(5 in n for n in asked) <= deaths:
            future.set_exception(BrokenProcessPool())
        else:
            future.set_result(([function(case) for _, case in chunk], 0.01))
        return future

    monkeypatch.setattr(Workers, "_submit", submit)
    with Workers(2) as pool:
        if deaths < 3:
            assert dict(pool.stream(lambda case: 10 * case, range(9))) == {k: 10 * k for k in range(9)}
        else:
            # A case of the same chunk may be blamed.
            with pytest.raises(RuntimeError, match=r"^the worker of case \d died 3 times$"):
                list(pool.stream(lambda case: 10 * case, range(9)))
    assert sum(5 in numbers for numbers in asked) == min(deaths + 1, 3)
    assert all(len(numbers) == 1 for numbers in asked[-1:])


def test_a_sweep_has_no_more_workers_than_cases(monkeypatch):
    made = []
    monkeypatch.setattr(Workers, "map", lambda self, function, cases, done: made.append(self._count) or list(cases))
    monkeypatch.setattr("softrig_optim.sweep.cores", lambda: 5)
    for cases, workers in ((3, None), (9, None), (9, 2), (2, 7), (0, 4)):
        assert sweep(abs, list(range(cases)), workers=workers) == list(range(cases))
    assert made == [3, 5, 2, 2, 1]
    assert Workers()._count == 5


def test_no_process_imports_from_the_current_directory_while_it_starts(monkeypatch):
    for before in (None, "", "0"):
        monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
        if before is not None:
            monkeypatch.setenv("PYTHONSAFEPATH", before)
        with _own_imports():
            assert os.environ["PYTHONSAFEPATH"] == "1"
        assert os.environ.get("PYTHONSAFEPATH") == before
