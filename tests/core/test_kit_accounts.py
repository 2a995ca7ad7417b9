"""The model kit and the modules on which the core is built.

Sources: naive models of the documented contracts on lists, loops and a watch; exact fractions where numbers count.
"""

import math
import os
import random
import sys
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from softrig_core import History, ScenarioError, to_ns, to_s
from softrig_core.errors import RunError, closest, describe
from softrig_core.extras import EXTRAS, need
from softrig_core.kit import dde, draws, history
from softrig_core.kit.dense import norm, product, solve, times, total, turn
from softrig_core.kit.draws import HEAD, KEPT, SIZE, Draws, Stream, Window
from softrig_core.kit.floats import leaves, numbers, others, put, read, split
from softrig_core.kit.jit import our_numba
from softrig_core.kit.newest import Newest
from softrig_core.kit.resource import prefixes, resource
from softrig_core.timebase import Pace

# delay lines ----------------------------------------------------------------------------------------------------------


def at_age(rows, size, age):
    """Read a list of samples, of which the newest `size` are kept, at an age in samples, by linear interpolation."""
    age = min(age, size - 1)
    newer, older = rows[-1 - math.floor(age)], rows[-1 - math.ceil(age)]
    part = Fraction(age) - math.floor(age)
    return tuple(float(Fraction(a) + part * (Fraction(b) - Fraction(a))) for a, b in zip(newer, older, strict=True))


@pytest.mark.parametrize("native", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_delay_line_is_a_list_of_samples(seed, native, monkeypatch):
    """In Python and in native code: appending to an older one does not change the newer ones."""
    monkeypatch.setattr(history, "_write", history._write.py_func)
    rng = random.Random(seed)
    step, longest, width = 0.25, rng.choice([0.0, 0.2, 1.0, 1.1]), rng.randint(1, 3)
    size = math.ceil(longest / step) + 3
    past = tuple(rng.random() for _ in range(width))
    first = History(step, longest, past)
    kept = [(first.native() if native else first, [past] * size)]
    for _ in range(25):
        line, rows = kept[-1] if native else rng.choice(kept[-4:])  # native code keeps only the newest state
        if rng.random() < 0.2:
            line, rows = line.again(), [*rows, rows[-1]]
        else:
            new = tuple(rng.random() for _ in range(width))
            line, rows = line.put(new), [*rows, new]
        kept.append((line, rows))
        for line, rows in (kept[-1], rng.choice(kept))[: 2 - native]:
            for age in (0.0, 0.5, 1.0, 1.75, size - 2.0, size - 1.5, size - 1.0, size + 3.0):
                assert line.aged(age) == pytest.approx(at_age(rows, size, age), rel=1e-12)
            for delay in (0.0, longest, 0.37 * longest, longest * (1 + 0.95e-9)):
                assert line.at(delay) == pytest.approx(at_age(rows, size, delay / step), rel=1e-9)
            for delay in (-1e-9, longest * (1.0 + 1.05e-9) + 1e-12 * (not longest), math.nan):
                with pytest.raises(ValueError, match=f"delay = {delay} s: expected 0 to {longest} s"):
                    line.at(delay)
            assert [line.back(k) for k in range(size)] == rows[: -size - 1 : -1]
            python = line.python() if native else line
            assert python.numbers().tolist() == [v for row in rows[-size:] for v in row]
            assert python == History.of(step, longest, rows[-size:])
            assert (python == History.of(step, longest, [*rows[-size:-1], (9.0,) * width])) is False
            assert python.with_numbers(2.0 * python.numbers()).back(1) == tuple(2.0 * v for v in rows[-2])
    with pytest.raises(ValueError, match=f"{width + 1} values, expected {width}"):
        kept[-1][0].put((0.0,) * (width + 1))
    assert (first != History(step, longest + step, past), first == 1, first != History(2 * step, longest, past)) == (
        True,
        False,
        True,
    )


def test_the_ring_of_native_code_is_twice_as_long_as_needed():
    ring = History(0.5, 1.0, (3.0, 4.0)).native()
    assert (ring.step, ring.longest, ring.size, ring.written, ring.newest) == (0.5, 1.0, 5, 5, (3.0, 4.0))
    assert ring.ring.tolist() == [3.0, 4.0] * 5 + [0.0, 0.0] * 5


@pytest.mark.parametrize(
    ("step", "longest", "size"), [(0.1, 0.3, 6), (0.1, 0.31, 7), (1.0, 0.0, 3), (1.0, 1e-10, 3), (1.0, 1e-8, 4)]
)
def test_as_many_samples_are_kept_as_the_longest_delay_needs(step, longest, size):
    assert len(History(step, longest).numbers()) == size


@pytest.mark.parametrize("step", [0.0, -1.0, math.inf, math.nan])
def test_a_step_is_a_positive_time(step):
    with pytest.raises(ValueError, match=f"step = {step} s: expected a positive time"):
        History(step, 1.0)


@pytest.mark.parametrize("longest", [-1.0, math.inf, math.nan])
def test_a_longest_delay_is_a_finite_time(longest):
    with pytest.raises(ValueError, match=f"longest delay = {longest} s: expected a finite time of at least 0"):
        History(1.0, longest)


# delay equations ------------------------------------------------------------------------------------------------------


def hermite(begin, length, x0, x1, dx0, dx1):
    """The cubic of a step, by scipy."""
    return CubicHermiteSpline([begin, begin + length], [x0, x1], [dx0, dx1])


def read_at(rows, t, late):
    """Read a list of steps at a time: on a border the step after it, or the one before it if `late`."""
    edge = 1e-9 * rows[-1][1] * (1 if late else -1)
    row = [r for r in rows if t >= r[0] + edge][-1:] or [rows[0]]
    (begin, length, *ends), s = row[0], (t - row[0][0]) / row[0][1]
    return ends[0] if s <= 0.0 else ends[1] if s == 1.0 else float(hermite(begin, length, *ends)(t))


@pytest.mark.parametrize("seed", range(3))
def test_a_track_is_a_list_of_steps(seed, monkeypatch):
    """In a tree: continuing from an older one does not change the newer ones; read at any time, as in native code."""
    monkeypatch.setattr(dde, "between", dde.between.py_func)
    rng = random.Random(seed)
    past = dde.trajectory(0.5, 1.0, lambda t: 2.0 + t)
    size = len(past.begin)
    assert (size, past.begin.tolist(), past.meta.tolist()) == (5, [-2.5, -2.0, -1.5, -1.0, -0.5], [5, 0])
    assert len(dde.trajectory(0.5, 1.0, 1.0, spare=3).begin) == 8
    rows = [(b, 0.5, 2.0 + b, 2.5 + b, 1.0, 1.0) for b in past.begin.tolist()]
    assert np.allclose(
        [past.x0[:, 0], past.x1[:, 0], past.dx0[:, 0]],
        [[r[2] for r in rows], [r[3] for r in rows], [1.0] * 5],
        atol=1e-9,
    )
    kept = [(dde.Track(past), [(*r[:2], *(float(past[k][i, 0]) for k in (2, 3, 4, 5))) for i, r in enumerate(rows)])]
    for _ in range(14):
        track, rows = rng.choice(kept[-3:])
        new = []
        for _ in range(count := rng.choice([1, 2, 5, 13])):
            begin = sum(([*rows, *new][-1])[:2])
            new.append((begin, rng.choice([0.25, 0.5]), *(rng.random() for _ in range(4))))
        opened = track.open(count)
        first = int(opened.meta[0])
        for k, row in enumerate(new, first):
            opened.begin[k], opened.length[k] = row[:2]
            opened.x0[k, 0], opened.x1[k, 0], opened.dx0[k, 0], opened.dx1[k, 0] = row[2:]
            opened.meta[0] += 1
        kept.append((track.after(opened), [*rows, *new]))
        for track, rows in (kept[-1], rng.choice(kept)):
            held = rows[-size:]
            assert track.numbers().tolist() == [row[k] for k in (2, 3, 4, 5) for row in held]
            assert track.native().past.meta.tolist() == [size, 0]
            back = track.native().python()
            assert (back == track, back.numbers().tolist()) == (True, track.numbers().tolist())
            other = track.with_numbers(track.numbers() + 1.0)
            assert (other == track, other.numbers().tolist()) == (False, (track.numbers() + 1.0).tolist())
            past = track.open()
            assert past.meta[1] == 0
            borders = [r[0] for r in held] + [held[-1][0] + held[-1][1]]
            for late in (0, 1):
                past.meta[1] = late
                # Delays are read only within the steps that are kept.
                inside = [rng.uniform(borders[0] + 1e-6, borders[-1] + 0.2) for _ in range(4)]
                for t in (*borders[late:], *inside):
                    wanted = read_at(held, t, late)
                    assert dde.delayed.py_func(past, t, 0) == pytest.approx(wanted, abs=1e-9), (t, late)
            past.meta[1] = 0


def test_the_slope_of_a_past_is_exact_for_quartics():
    def past(t):
        return np.array([1.0 + t - 2.0 * t**2 + 0.5 * t**3 - 0.25 * t**4])

    assert dde._slope(past, 0.5, 0.125)[0] == pytest.approx(1.0 - 4.0 * 0.5 + 1.5 * 0.25 - 0.125, abs=1e-12)
    with pytest.raises(ValueError, match=r"step = 0\.0 s: expected a positive time"):
        dde.trajectory(0.0, 1.0, 0.0)
    assert [a.tolist() for a in dde.trajectory(1.0, 0.0, (3.0, 4.0))[2:6]] == [[[3.0, 4.0]] * 3] * 2 + [
        [[0.0, 0.0]] * 3
    ] * 2


# random numbers and answers that are kept -----------------------------------------------------------------------------


class Counted:
    """A generator that counts how often a row is drawn."""

    def __init__(self):
        self.generator, self.rows = np.random.Generator(np.random.PCG64(5)), 0
        self.bit_generator = self.generator.bit_generator

    def random(self, count):
        self.rows += 1
        return self.generator.random(count)


def test_random_draws_are_the_stream_and_the_newest_rows_are_cached(monkeypatch):
    monkeypatch.setattr(draws, "_begun", {})
    wanted = np.random.default_rng(5).random(7 * SIZE)
    counted = []
    monkeypatch.setattr(np.random, "default_rng", lambda seeds: counted.append(Counted()) or counted[-1])
    stream = Draws((5,), "random")
    for row, drawn in ((0, 1), (1, 2), (2, 3), (3, 4), (0, 4), (4, 5), (1, 5), (2, 5), (0, 5), (6, 7), (4, 7), (5, 8)):
        for k in (row * SIZE, row * SIZE + 17, (row + 1) * SIZE - 1):
            assert stream(k) == wanted[k]
        assert counted[0].rows == drawn, row
    assert stream.first(10).tolist() == wanted[:10].tolist()
    assert (SIZE, KEPT, len(counted)) == (4096, 4, 2)
    # The next run with this seed gets its first numbers without drawing them.
    again = Draws((5,), "random")
    assert [again(3), again.first(10).tolist()] == [wanted[3], wanted[:10].tolist()]
    assert again(SIZE) == wanted[SIZE]
    assert len(counted) == 2
    assert again(2 * SIZE) == wanted[2 * SIZE]
    assert counted[2].rows == 1
    monkeypatch.undo()
    assert Draws((6,), "random")(3) == np.random.default_rng(6).random(4)[3]


def test_a_window_of_random_numbers_moves_on_and_keeps_all_for_code_that_goes_far_back(monkeypatch):
    monkeypatch.setattr(draws, "MOST", 100)
    monkeypatch.setattr(draws, "BACK", 10)
    stream = Draws((5,), "standard_normal")
    wanted = np.random.default_rng(5).standard_normal(2000)
    stream.at_hand = window = Window(stream, 50)
    moves = ((50, 40, 150), (150, 140, 250), (999, 250, 1000), (1000, 990, 1100), (3, 0, 100), (400, 0, 401))
    for k, first, last in moves:
        window.follow(k + 1)
        assert (window.table[0], window.table[1]) == (first, 0.0)
        assert window.table[HEAD:].tolist() == wanted[first:last].tolist(), k
        assert [stream(k) for k in (first, last - 1, last)] == [*wanted[[first, last - 1, last]]]


def test_a_stream_continues_at_the_stated_position():
    wanted = np.random.default_rng(7).random(40)
    stream = Stream(np.random.default_rng(7))
    for begin, count in ((0, 3), (3, 2), (20, 5), (4, 6), (4, 1), (30, 0), (30, 2)):
        assert stream.at(begin).random(count).tolist() == wanted[begin : begin + count].tolist()
        assert stream.drawn(begin + count) == begin + count
    assert stream == Stream(np.random.default_rng(7)) != Stream(np.random.default_rng(8))
    assert (stream == 1) is False
    assert draws.SIZE == SIZE


def test_the_newest_answers_are_cached():
    asked: list[int] = []
    newest = Newest(lambda k: asked.append(k) or (k, len(asked)))
    assert (newest.key, newest.answer) == (None, None)
    for k in (1, 1, 2, 3, 4, 1, 5, 1, 3, 2):
        assert newest(k)[0] == k
        assert (newest.key, newest.answer) == (k, newest(k))
    assert asked == [1, 2, 3, 4, 5, 2]  # the cache holds four answers, and 2 was the least recently used
    assert Newest(lambda k: asked.append(k), 1)(9) is None


# numbers of a state ---------------------------------------------------------------------------------------------------


class Inner(NamedTuple):
    a: float = 0.5
    k: int = 3


class Aside(NamedTuple):
    shown: float = 1.0
    aside = True


class State(NamedTuple):
    x: float
    z: complex
    row: tuple[float, ...]
    inner: Inner
    pair: tuple[Any, ...]
    table: Any
    single: Any
    planes: Any
    whole: Any
    none: None
    word: str
    on: bool
    aside_of: Aside
    line: History


def a_state():
    return State(1.5, 2.0 - 1.0j, (3.0, 4.0), Inner(), (7, (Inner(8.0, 9), -1.0), ()),
                 np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([1.5, 2.5], np.float32), np.array([1.0 + 2.0j]),
                 np.array([1, 2]), None, "up", True, Aside(), History(1.0, 0.0, (5.0, 6.0)))  # fmt: skip


def test_the_numbers_of_a_state_have_their_names():
    results = {name: row.tolist() for name, row in read(a_state())}
    assert results == {
        "x": [1.5],
        "z": [2.0, -1.0],
        "row": [3.0, 4.0],
        "inner.a": [0.5],
        "pair[1][0].a": [8.0],
        "pair[1][1]": [-1.0],
        "table": [1.0, 2.0, 3.0, 4.0],
        "single": [1.5, 2.5],
        "planes": [1.0, 2.0],
        "line": [5.0, 6.0] * 3,
    }
    assert dict(others(a_state())) == {
        "inner.k": 3,
        "pair[0]": 7,
        "pair[1][0].k": 9,
        "whole": [1, 2],
        "none": None,
        "word": "up",
        "on": True,
    }
    assert numbers(a_state()).tolist() == [v for row in results.values() for v in row]
    assert [name for name, _ in leaves((1.0, 2))] == ["[0]", "[1]"]
    assert [name for name, _ in leaves(Inner(), "law")] == ["law.a", "law.k"]
    assert (numbers(3).tolist(), split(3, np.empty(0)), put(3, [])) == ([], [], 3)


def test_changed_numbers_are_written_back_to_their_places():
    state = a_state()
    row = numbers(state)
    plain = state._replace(z=None, table=None, single=None, planes=None)
    assert put(plain, split(plain, numbers(plain))) is plain
    new = put(state, split(state, row + 1.0))
    assert numbers(new).tolist() == (row + 1.0).tolist()
    assert dict(others(new)) == dict(others(state))
    assert [type(v) for v in new] == [type(v) for v in state]
    assert (new.table.shape, new.single.dtype, new.planes.dtype) == ((2, 2), np.float32, complex)
    assert new.aside_of is state.aside_of
    assert new.whole is state.whole
    for length in (len(row) - 1, len(row) + 1, 0):
        with pytest.raises(ValueError, match=f"{length} numbers, expected the {len(row)} of the state"):
            split(state, np.zeros(length))
    only = put(state, split(state, np.concatenate([[9.0], row[1:]])))
    assert (only.x, only.inner, only.line is state.line, only.row is state.row) == (9.0, state.inner, True, True)


# linear algebra -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_products_and_solutions_are_those_of_exact_fractions(seed):
    rng = random.Random(seed)
    n, m, k = (rng.randint(1, 5) for _ in range(3))
    a, b = ([[rng.randint(-9, 9) for _ in range(w)] for _ in range(h)] for h, w in ((n, m), (m, k)))
    exact = [[sum(x * row[j] for x, row in zip(left, b, strict=True)) for j in range(k)] for left in a]
    assert product(a, b).tolist() == exact
    assert product(a[0], b).tolist() == exact[0]
    assert product(a, [row[0] for row in b]).tolist() == [row[0] for row in exact]
    square = [[rng.randint(-9, 9) + (40 if i == j else 0) for j in range(n)] for i in range(n)]
    rng.shuffle(square)  # the solver has to exchange rows
    x = [[float(rng.randint(-9, 9)) for _ in range(k)] for _ in range(n)]
    right = product(square, x)
    assert np.allclose(solve(square, right), x, rtol=0, atol=1e-12)
    assert np.allclose(solve(square, right[:, 0]), [row[0] for row in x], rtol=0, atol=1e-12)
    assert norm([3.0, -4.0, 12.0]) == 13.0
    assert total([0.1] * 3) == 0.1 + 0.1 + 0.1
    z = [complex(rng.randint(-9, 9), rng.randint(-9, 9)) for _ in range(4)]
    assert times(z, z[::-1]).tolist() == [p * q for p, q in zip(z, z[::-1], strict=True)]
    assert np.allclose(turn([0.3, -2.0]), np.exp(1j * np.array([0.3, -2.0])), rtol=0, atol=1e-15)


# files, packages, errors ----------------------------------------------------------------------------------------------


def test_files_of_packages_are_found_with_overlays_first(tmp_path, monkeypatch):
    for prefix in ("one", "two"):
        (tmp_path / prefix / "share" / "some" / "data").mkdir(parents=True)
    (tmp_path / "two/share/some/data/table.csv").write_text("2")
    (tmp_path / "python" / "kitten" / "data").mkdir(parents=True)
    (tmp_path / "python/kitten/__init__.py").write_text("")
    (tmp_path / "python/kitten/data/here.csv").write_text("3")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/one{os.pathsep}{os.pathsep}{tmp_path}/two")
    monkeypatch.syspath_prepend(str(tmp_path / "python"))
    assert prefixes() == [tmp_path / "one", tmp_path / "two"]
    assert resource("package://some/data/table.csv") == tmp_path / "two/share/some/data/table.csv"
    assert resource("package://kitten/data/here.csv") == tmp_path / "python/kitten/data/here.csv"
    (tmp_path / "one/share/some/data/table.csv").write_text("1")
    assert resource("package://some/data/table.csv") == tmp_path / "one/share/some/data/table.csv"
    assert resource(str(tmp_path / "one/share/some/data/table.csv")).read_text() == "1"
    with pytest.raises(ValueError, match=r"no table 'none\.csv'; looked for none\.csv$"):
        resource("none.csv", "table")
    looked = ", ".join(f"{tmp_path}/{prefix}/share/some/none.csv" for prefix in ("one", "two"))
    with pytest.raises(ValueError, match=f"^no file 'package://some/none.csv'; looked for {looked}$"):
        resource("package://some/none.csv")
    with pytest.raises(ValueError, match=r"no file 'package://no-name/none\.csv'; looked for .*no-name/none\.csv$"):
        resource("package://no-name/none.csv")
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    assert prefixes() == []


def test_errors_name_the_line_in_the_users_code(tmp_path):
    (tmp_path / "own.py").write_text("def fails(x):\n    return 1 / x\n")
    scope: dict[str, Any] = {}
    exec(compile((tmp_path / "own.py").read_text(), str(tmp_path / "own.py"), "exec"), scope)

    def described(call):
        try:
            call()
        except Exception as error:
            return describe(error)

    assert described(lambda: scope["fails"](0)).endswith(f" ({tmp_path / 'own.py'}, line 2)")
    assert described(lambda: scope["fails"](0)).startswith("ZeroDivisionError: ")
    assert (
        described(lambda: exec(compile("x = = 1", "bad.py", "exec"))) == "SyntaxError: invalid syntax (bad.py, line 1)"
    )
    assert describe(ValueError("no trace")) == "ValueError: no trace"
    assert describe(KeyError()) == "KeyError"
    assert (closest("gian", ["gain", "loss"]), closest("x", ["gain"])) == (" (did you mean 'gain'?)", "")
    assert (RunError("x").node, issubclass(ScenarioError, ValueError)) == ("", True)


def test_the_package_that_an_extra_installs_is_named(monkeypatch):
    monkeypatch.setitem(EXTRAS, "no_such_package", "some")
    monkeypatch.setitem(EXTRAS, "json", "some")
    monkeypatch.delenv("SOFTRIG_COMMAND", raising=False)
    assert need("json", "a thing") is None
    with pytest.raises(ScenarioError) as error:
        need("no_such_package", "a thing")
    assert (
        str(error.value)
        == "a thing needs the package 'no_such_package': pip install 'softrig[some]', or no_such_package by itself"
    )
    asked: list[Any] = []
    monkeypatch.setenv("SOFTRIG_COMMAND", "softrig-here")
    monkeypatch.setattr("softrig_core.extras.subprocess.run", lambda *a, **k: asked.append((a, k)))
    with pytest.raises(ScenarioError) as error:
        need("no_such_package", "a thing")
    assert (
        str(error.value)
        == "a thing needs the package 'no_such_package': softrig-here setup some (see above why it failed)"
    )
    assert asked == [((["softrig-here", "setup", "some"],), {"stdin": -3, "check": False})]
    assert "no_such_package" not in sys.modules


# time -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_a_pace_lets_a_run_go_as_far_as_the_wall_clock_has_gone(seed):
    """Against a stopwatch: waited time counts, pauses do not, and a lag of more than 0.25 s is not caught up."""
    rng = random.Random(seed)
    rate, now, t = 1.0, 100.0, 0
    pace, advanced, seen, stopped = Pace(rate), None, None, False
    for _ in range(200):
        what = rng.choice(["look"] * 6 + ["change", "stop", "go on", "begin"])
        passed = rng.choice([0.0, 0.01, 0.05, 0.125, 0.5])
        now += passed
        if advanced is not None and not stopped:
            advanced += passed * rate  # s by which the run may have advanced
        if what == "change":
            pace.change(new := rng.choice([0.5, 1.0, 2.0]), now)
            rate = new
        elif what == "stop":
            pace.stop(now)
            stopped = True
        elif what == "go on":
            pace.go_on(now)
            stopped = False
        elif what == "begin":
            pace.begin()
            advanced = None
        elif not stopped:
            advanced = t / 1e9 if advanced is None else advanced
            result, ahead = pace.reach(now, t), advanced - t / 1e9
            if abs(ahead) < 1e-6 or abs(ahead - 0.25 * rate) < 1e-6:
                continue
            if ahead < 0:
                assert result is None
            elif ahead > 0.25 * rate:
                assert result == t
                advanced = t / 1e9
            else:
                assert result == pytest.approx(advanced * 1e9, abs=10)
                t = rng.randint(t, result)
                t = result if rng.random() < 0.5 else t
    assert seen is None


def test_a_pace_is_exact_at_its_limits():
    pace = Pace(1.0)
    assert pace.reach(5.0, 1000) is None
    assert pace.reach(5.0 + 1e-9, 1000) == 1001
    assert pace.reach(5.25, 1000) == 250_001_000  # a lag of exactly 0.25 s is caught up
    assert pace.reach(5.2500001, 1000) == 1000
    assert pace.reach(5.2500001, 1000) is None
    pace.change(0.0, 6.0)
    assert pace.pace == 0.0
    pace.change(2.0, 7.0)
    assert (pace.reach(8.0, 0), pace.reach(8.1, 0)) == (None, 200_000_000)
    assert (to_ns(1.5), to_ns(0.1 + 0.2), to_s(1_500_000_000), to_ns(-2.4e-9)) == (1_500_000_000, 300_000_000, 1.5, -2)


class Absent:
    """Finds no numba."""

    def find_spec(self, name, path=None, target=None):
        """Refuse it."""
        if name == "numba":
            self.seen = os.environ.get("NUMBA_DISABLE_INTEL_SVML")
            raise ImportError(name)


def test_numba_is_loaded_without_vectors_that_give_other_bits(monkeypatch):
    """A setting of the user stays; after numba is loaded the setting is too late; the user's environment is
    unchanged.
    """
    absent = Absent()
    monkeypatch.setattr(sys, "meta_path", [absent, *sys.meta_path])
    text = "NUMBA_DISABLE_INTEL_SVML"
    for loaded, before, seen in ((False, None, "1"), (False, "0", "0"), (True, None, None)):
        monkeypatch.delitem(sys.modules, "numba", raising=False)
        if loaded:
            monkeypatch.setitem(sys.modules, "numba", None)
        monkeypatch.setenv(text, before or "")
        if before is None:
            monkeypatch.delenv(text)
        absent.seen = None
        assert our_numba.__wrapped__() is None
        assert (absent.seen, os.environ.get(text)) == (seen, before)
