"""The columns of a rig's map, for artificial maps: what counts as a state, each matrix, each step, what is reported."""

import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from softrig_core import RunError
from softrig_core.analysis import linear_view
from softrig_core.analysis.linear_view import Differences

LINK = "law/u"


class Map:
    """x+ = f(x, v, w), output = g(x, v, w): v are the values of the link's subscribers, w those of the sources.

    `direct` is the part of the output that depends on the link in the same tick; `g` has the rest.
    """

    t, period = 1.5, 0.25

    def __init__(self, f, g, start, sizes, moved, inputs=(), outputs=("plant/y",), link="", direct=0.0):
        self.direct = direct
        self.f, self.g, self.start, self.sizes = f, g, np.array(start, float), np.array(sizes, float)
        self.moved = np.array(moved, bool)
        self.resting = np.zeros(len(start), bool)
        self.names = [f"plant.x[{k}]" for k in range(len(start))]
        self.inputs, self.outputs, self.link = inputs, outputs, link
        self.places = dict.fromkeys((*outputs, *inputs, *([link] if link else [])))
        self.rig = SimpleNamespace(scenario=SimpleNamespace(name="made"))
        self.asked, self.odd = [], []

    def __call__(self, x, added, fixed=None):
        self.asked.append(np.array(x))
        w = np.array([0.5 + added.get(name, 0.0) for name in self.inputs])
        more, remaining = added.get(self.link, 0.0), self.g(x, 0.0, w)[-1] if self.link else 0.0
        # A fixed value replaces the message of the link; otherwise the feedthrough of the message is solved for.
        v = fixed[self.link] + more if fixed else (remaining + more) / (1.0 - self.direct)
        messages = {self.link: remaining + self.direct * v} if self.link else {}
        own = dict(zip(self.outputs, self.g(x, v, w), strict=False))
        return self.f(x, v, w), messages | own | dict(zip(self.inputs, [0.5] * len(self.inputs), strict=True))

    def go_on(self, x, periods, added=None, fixed=None):
        for _ in range(periods):
            x, text = self(x, added or {}, fixed)
            yield x, text

    def others(self):
        return self.odd

    def follows(self, *_):
        return True


@pytest.fixture(autouse=True)
def _units(monkeypatch):
    monkeypatch.setattr(linear_view, "signal_units", lambda rig: {"plant/y[0]": "m"})


def reached(A, some):
    some = set(some)
    while more := {i for j in some for i in range(len(A)) if A[i, j]} - some:
        some |= more
    return some


@pytest.mark.parametrize("opened", [True, False])
@pytest.mark.parametrize("seed", range(12))
def test_the_linear_view_of_a_linear_map_is_the_map_in_the_states_that_count(seed, opened):
    """In eighths, so that nothing is rounded. A state counts if it moves or is moved, and is observed; not if nothing
    moves it.
    """
    rng = np.random.default_rng(seed)

    def sparse(*shape, share=0.3):
        return rng.integers(-8, 9, shape) / 8.0 * (rng.random(shape) < share)

    n = 6
    while True:
        A0, B0, C0, D0, d0 = sparse(n, n), sparse(n, 2), sparse(3, n), sparse(3, 2), sparse(3)
        b0, c0, e0, direct = sparse(n, share=0.5), sparse(n, share=0.5), sparse(2), float(rng.choice([0.0, 0.5, -1.0]))
        if not opened:
            b0, c0, d0 = np.zeros(n), np.zeros(n), np.zeros(3)
        moved = rng.random(n) < 0.3
        hear, received = reached(A0, np.flatnonzero(b0)), reached(A0.T, np.flatnonzero(c0))
        if not opened or hear & received:
            break
    still = [i for i in range(n) if rng.random() < 0.2]
    for i in still:  # these states are constant, like parameters
        A0[i], B0[i], b0[i] = np.eye(n)[i], 0.0, 0.0
    if opened and not reached(A0, np.flatnonzero(b0)) & reached(A0.T, np.flatnonzero(c0)):
        return

    def f(x, v, w):
        return A0 @ x + b0 * v + B0 @ w

    def g(x, v, w):
        y = C0 @ x + d0 * v + D0 @ w
        return [*y, c0 @ x + e0 @ w] if opened else y

    inputs, outputs = ("one/w", "two/w"), ("plant/y[0]", "plant/y[1]", "plant/y[2]")
    m = Map(f, g, rng.integers(1, 9, n) / 4.0, [1.0] * n, moved, inputs, outputs, LINK if opened else "", direct)
    start = m.start.copy()
    view = Differences(m, outputs, inputs, LINK if opened else "").view()

    on = reached(A0, {*np.flatnonzero(moved), *np.flatnonzero(b0), *np.flatnonzero(B0.any(axis=1))})
    names = {j for j in range(n) if C0[:, j].any() or c0[j]}
    within = np.zeros((n, n))
    within[np.ix_(sorted(on), sorted(on))] = A0[np.ix_(sorted(on), sorted(on))]
    counts = on & reached(within.T, names & on)
    counts -= {i for i in on if (within[i] == np.eye(n)[i]).all() and not B0[i].any() and not b0[i]}
    k = sorted(counts)
    assert view.states == tuple(f"plant.x[{i}]" for i in k)
    a, b, c = A0[np.ix_(k, k)], b0[k], c0[k]
    if not opened:
        e0, direct = np.zeros(2), 0.0
    assert (view.a.tolist(), view.b.tolist(), view.c.tolist(), view.d) == (a.tolist(), b.tolist(), c.tolist(), direct)
    back = 1.0 / (1.0 - direct)  # gain of the loop closed by the direct feedthrough
    assert view.A.tolist() == (a + back * np.outer(b, c)).tolist()
    assert view.B.tolist() == (B0[k] + back * np.outer(b, e0)).tolist()
    assert view.C.tolist() == (C0[:, k] + back * np.outer(d0, c)).tolist()
    assert view.D.tolist() == (D0 + back * np.outer(d0, e0)).tolist()
    assert view.error == 0.0
    assert view.state_error < 1e-9
    assert (view.rig, view.at, view.period, view.link) == ("made", 1.5, 0.25, LINK if opened else "")
    assert (view.inputs, view.outputs) == (inputs, outputs)
    assert {view.values[f"plant.x[{i}]"] for i in k} == {start[i] for i in k}
    half = np.full(2, 0.5)
    assert view.values["plant/y[1]"] == pytest.approx(g(start, back * (c0 @ start + e0 @ half), half)[1])
    assert view.units["plant/y[0]"] == "m"
    assert set(view.units) == {*inputs, *outputs, *([LINK] if opened else [])}


def best_step(f, x, size):
    """Differences at steps of a sixteenth of the size and so on, up to the first two that agree, or the two nearest."""
    rows = [((f(x + h) - f(x - h)) / (2.0 * h), h) for h in (size * 2.0**-n for n in range(4, 33, 4))]
    best = None
    for (slope, _), (finer, step) in pairwise(rows):
        # Relative to a slope of 1, which is that of the disturbed signal.
        error = abs(finer - slope) / max(abs(finer), 1.0)
        if best is None or error < best[0]:
            best = error, slope if error <= 1e-11 else finer, step
        if error <= 1e-11:
            break
    return best


@pytest.mark.parametrize(
    ("f", "x", "size"),
    [
        (lambda x: x**3, 1.0, 1.0),
        (math.sin, 0.25, 4.0),
        (lambda x: math.exp(-x), 2.0, 3.0),
        (lambda x: 3.0 * x, 5.0, 0.75),
        (lambda x: 2.0**-10 * x**5, 2.0, 0.3),
    ],
)
def test_a_column_is_computed_where_two_neighbouring_steps_agree_best(f, x, size):
    m = Map(lambda s, v, w: np.array([f(s[0])]), lambda s, v, w: [s[0]], [x], [size], [True])
    differences = Differences(m, ["plant/y"], [], "")
    view = differences.view()
    error, slope, step = best_step(f, x, 2.0 ** round(math.log2(size)))
    assert (view.A[0, 0], view.error, differences.steps) == (
        pytest.approx(slope, rel=1e-14),
        pytest.approx(error),
        {0: step},
    )
    assert view.worst == "plant.x[0]"
    # Compare ten periods, started a 256th of the step away on both sides, with the linear model.
    ups, downs, off, worst, largest = x + step / 256.0, x - step / 256.0, step / 256.0, 0.0, 0.0
    for _ in range(10):
        ups, downs, off = f(ups), f(downs), slope * off
        worst, largest = max(worst, abs((ups - downs) / 2.0 - off)), max(largest, abs(ups - downs) / 2.0)
    assert view.state_error == pytest.approx(worst / largest, rel=1e-6, abs=1e-14)


def test_a_state_that_rests_at_zero_counts_as_one_of_size_one():
    m = Map(lambda s, v, w: np.array([math.sin(s[0]), 0.5 * s[1]]), lambda s, v, w: [s.sum()], [1.0, 0.0], [1.0, 0.0],
            [True] * 2)  # fmt: skip
    differences = Differences(m, ["plant/y"], [], "")
    view = differences.view()
    off = differences.steps[0] / 256.0
    # `largest` is that of the second disturbance after one period.
    up, down, worst, largest = 1.0 + off, 1.0 - off, 0.0, differences.steps[1] / 512.0
    for _ in range(10):
        up, down, off = math.sin(up), math.sin(down), view.A[0, 0] * off
        worst, largest = max(worst, abs((up - down) / 2.0 - off)), max(largest, abs(up - down) / 2.0)
    assert view.state_error == pytest.approx(worst / largest, rel=1e-6)
    assert view.state_error > 1e-5


def test_states_are_perturbed_with_alternating_signs_to_test_linearity():
    m = Map(lambda s, v, w: s, lambda s, v, w: [s.sum()], [1.0] * 4, [1.0, 2.0, 4.0, 8.0], [True] * 4)
    m.f = lambda s, v, w: np.roll(s, 1)
    differences = Differences(m, ["plant/y"], [], "")
    differences.states()
    m.asked.clear()
    assert differences.view().state_error == 0.0
    offs = [(x - 1.0).tolist() for x in m.asked]
    step = np.array([differences.steps[k] for k in range(4)]) / 256.0
    assert step.tolist() == [2.0**-16 * s for s in (1.0, 2.0, 4.0, 8.0)]
    assert (step * [1.0, -1.0, 1.0, 1.0]).tolist() in offs
    assert (-step * [1.0, -1.0, 1.0, 1.0]).tolist() in offs


def test_a_state_at_zero_gets_the_size_by_which_others_move_it():
    """The second is moved by 16 times the first, of size 8; the third as the second: a 64th of that is just enough."""
    A = np.array([[0.5, 0.0, 0.0], [16.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    m = Map(lambda s, v, w: A @ s, lambda s, v, w: [s.sum()], [8.0, 0.0, 0.0], [8.0, 0.0, 2.0], [True, False, False])
    differences = Differences(m, ["plant/y"], [], "")
    assert differences.view().A.tolist() == A.tolist()
    assert m.sizes.tolist() == [8.0, 128.0, 2.0]
    assert differences.steps == {0: 8.0 / 256.0, 1: 128.0 / 256.0, 2: 2.0 / 256.0}


def fenced(limit):
    def f(s, v, w):
        if abs(s[0] - 1.0) > limit:
            raise RunError("beyond")
        return 1.0 + 0.5 * (s - 1.0)

    return Map(f, lambda s, v, w: [s[0]], [1.0], [1.0], [True])


def test_a_step_that_breaks_the_rig_is_shortened_and_its_failure_reported():
    differences = Differences(fenced(2.0**-10), ["plant/y"], [], "")
    assert differences.view().A.tolist() == [[0.5]]
    # 2^-12 is the first step inside the fence, and 2^-16 confirms its slope.
    assert differences.steps == {0: 2.0**-16}
    with pytest.raises(RunError, match=r"^made: plant\.x\[0\] cannot be disturbed at 1\.5 s, however little$"):
        Differences(fenced(0.0), ["plant/y"], [], "").view()


def test_a_changing_value_that_is_not_a_float_is_reported():
    m = Map(lambda s, v, w: s * 0.5, lambda s, v, w: [s[0]], [1.0], [1.0], [True])
    m.others = lambda: [("plant.n", len(m.asked))]
    text = r"^made: plant\.n changes with plant\.x\[0\] at 1\.5 s, however little that is disturbed, and is not a float"
    with pytest.raises(RunError, match=text):
        Differences(m, ["plant/y"], [], "").view()
    m.asked.clear()
    m.others = lambda: [("plant.n", 1)] * (len(m.asked) > 1)  # a search that did not exist before the disturbance
    with pytest.raises(RunError, match=text):
        Differences(m, ["plant/y"], [], "").view()
    m.follows = lambda *_: False  # the search exists, but no signal depends on it
    assert Differences(m, ["plant/y"], [], "").view().A.tolist() == [[0.5]]


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (5, ""),
        (6, "6 numbers move, 6 of them in plant.x,"),
        (9, "9 numbers move"),
        (10, "10 numbers move, 10 of them in "),
    ],
)
def test_too_many_states_are_reported(monkeypatch, count, text):
    monkeypatch.setattr(linear_view, "MOST", 5)
    monkeypatch.setattr(linear_view, "TRIED", 9)
    m = Map(lambda s, v, w: 0.5 * s, lambda s, v, w: [s.sum()], [1.0] * count, [1.0] * count, [True] * count)
    differences = Differences(m, ["plant/y"], [], "")
    m.asked.clear()
    if not text:
        assert len(differences.states()[0]) == count
        return
    with pytest.raises(RunError, match=f"^made: {text}.* expected at most 5 states: a long delay has one or more"):
        differences.states()
    assert (not m.asked) == (count > 9)  # refused before any disturbance


def test_infinite_numbers_and_numbers_too_large_to_move_have_no_columns():
    m = Map(lambda s, v, w: s * [0.5, 1.0], lambda s, v, w: [s[0]], [1.0, math.inf], [1.0, 0.0], [True, True])
    assert Differences(m, ["plant/y"], [], "").view().states == ("plant.x[0]",)
    m = Map(lambda s, v, w: s * 0.5, lambda s, v, w: [s[0]], [1e20], [1.0], [True])
    with pytest.raises(RunError, match="cannot be disturbed"):
        Differences(m, ["plant/y"], [], "").view()
