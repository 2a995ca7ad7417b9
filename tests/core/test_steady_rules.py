"""Operating points by their rules: Newton's steps in plain loops; which states count; what is reported if there is
none.
"""

import math

import numpy as np
import pytest
from softrig_core import Block, NoOperatingPoint, Plant, Rig, RunError, ScenarioError, linear_view, number, steady
from softrig_core.analysis.steady import _core, _go, _least_squares


class Curve(Plant):
    """x+ = x + f(x) + u, and the values it has passed; its controller only reads it."""

    INPUTS = (number("u", "law/u", "m"),)
    OUTPUTS = (number("y", "plant/y", "m"), number("way", "plant/way", "m s"))

    def first(self):
        return 1.0, 0.0

    def outputs(self, x, t):
        return {"y": (x[0],), "way": (x[1],)}

    def advance(self, x, t, u):
        return x[0] + self.f(x[0]) + u[0], x[1] + x[0]

    @staticmethod
    def f(x):
        return 0.05 * (2.0 - x * x)


class Quiet(Block):
    """Publishes a tenth of zero."""

    INPUTS = (number("y", "plant/y", "m"),)
    OUTPUTS = (number("u", "law/u", "m"),)
    gain = 0.0

    def update(self, x, t, y):
        return x, {"u": (self.gain * y[0],)}


def rig_of_curve(f, gain=0.0):
    return Rig.from_blocks(
        {"plant": type("Curve", (Curve,), {"f": staticmethod(f)})(), "law": type("Quiet", (Quiet,), {"gain": gain})()},
        duration=0.1,
    )


def by_newton(f, slope, x, size):
    """Newton steps until the remaining error and the step are within a billionth of the size."""
    for steps in range(25):
        step = -f(x) / slope(x)
        if abs(step) <= 1e-9 * size and abs(f(x)) <= 1e-9 * size:
            return x, steps
        x += step
    return x, 25


@pytest.mark.parametrize("at", [0.0, 0.05, None])
def test_the_point_is_where_newtons_method_ends(at):
    point = steady(rig_of_curve(Curve.f), at=at)
    x = 1.0
    ticks = round((0.1 if at is None else at) / point.period)
    for _ in range(ticks):
        x += Curve.f(x)
    root, steps = by_newton(Curve.f, lambda x: -0.1 * x, x, max(1.0, x))
    assert root == pytest.approx(math.sqrt(2.0), rel=1e-9)
    assert (point.at, point.steps) == (pytest.approx(ticks * point.period), steps)
    assert point.states["plant[0]"] == pytest.approx(root, rel=1e-9)
    assert point.signals["plant/y/data"] == pytest.approx(root, rel=1e-9)
    assert point.units == {"plant/y/data": "m", "plant/way/data": "m s", "law/u/data": "m"}
    assert point.slowest == pytest.approx(1.0 - 0.1 * root, rel=1e-7)
    assert point.stable
    assert point.moved <= 1e-9
    # The integral grows without limit.
    assert point.drifting == {"plant[1]": pytest.approx(root / point.period, rel=1e-9)}


def test_an_unstable_point_is_reported_as_unstable():
    """x+ = 1.2 x - 0.22: at rest at 1.1, which is unstable."""
    point = steady(rig_of_curve(lambda x: 0.2 * (x - 1.1) if abs(x) < 50.0 else 0.0), at=0.0)
    assert (point.states["plant[0]"], point.slowest, point.stable) == (pytest.approx(1.1), pytest.approx(1.2), False)
    # The controller stabilises this point: x+ = 0.8 x - 0.22.
    held = steady(rig_of_curve(lambda x: 0.2 * (x - 1.1), -0.4), at=0.0)
    assert (held.states["plant[0]"], held.slowest) == (pytest.approx(-1.1), pytest.approx(0.8))
    assert held.signals["law/u/data"] == pytest.approx(0.44)


@pytest.mark.parametrize("gain", [0.2, -0.3])
def test_a_plant_that_starts_at_rest_keeps_its_states(gain):
    """x+ = (1 + gain) x - gain from x = 1: only a sum moves, and a ball on a hilltop is not stable."""
    rig = rig_of_curve(lambda x: (gain - 0.0625) * (x - 1.0) - 0.0625, 0.0625)  # the controller contributes 0.0625 x
    point = steady(rig, at=0.0)
    assert (point.states["plant[0]"], point.stable, point.steps) == (1.0, gain < 0.0, 0)
    assert point.slowest == pytest.approx(1.0 + gain)
    seen = linear_view(rig, at=0.0, outputs=["plant/y/data"])
    assert np.linalg.eigvals(seen.A) == pytest.approx([1.0 + gain])


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_rest_is_relative_to_the_size_of_a_state(scale):
    """The same in another unit: the same number of steps, the same place."""

    class Scaled(Curve):
        def first(self):
            return scale, 0.0

        @staticmethod
        def f(x):
            return scale * Curve.f(x / scale)

    point = steady(Rig.from_blocks({"plant": Scaled(), "law": Quiet()}, duration=0.1), at=0.0)
    same = steady(rig_of_curve(Curve.f), at=0.0)
    assert (point.steps, point.states["plant[0]"]) == (same.steps, pytest.approx(scale * same.states["plant[0]"]))


class Drawn(Curve):
    """Rests at twice a number that its seed decides."""

    def advance(self, x, t, u):
        return 0.5 * x[0] + self.uniform(0), x[1]


def test_the_seed_is_that_of_the_rig_or_another():
    rig = Rig.from_blocks({"plant": Drawn(), "law": Quiet()}, duration=0.1)
    for seed in (None, 0, 3):
        block = Drawn(name="plant")
        block.reset(rig.scenario.seed if seed is None else seed)
        assert steady(rig, at=0.0, seed=seed).states["plant[0]"] == pytest.approx(2.0 * block.uniform(0), rel=1e-12)
        view = linear_view(rig, "", at=10.0, seed=seed)
        assert view.values["plant[0]"] == pytest.approx(2.0 * block.uniform(0), rel=1e-12)


class Wanders:
    """A map with equilibria at 1 and 8, from which a run departs slightly in each of its periods."""

    t, period, names, places = 3.0, 0.01, ("plant.a", "plant.b"), ()
    little = np.array([0.0, 1e-8])

    def __init__(self, rig, at, seed, received, inputs, periods):
        self.rig, self.signals, self.periods = rig, received, periods
        self.start, self.sizes, self.moved = np.array([2.0, 8.0]), np.array([1.0, 4.0]), np.ones(2, bool)
        self.resting = np.zeros(2, bool)

    def __call__(self, x, added, fixed=None):
        return 0.5 * x + [0.5, 4.0], dict.fromkeys(self.signals, x.sum())

    def go_on(self, x, periods):
        assert periods == self.periods == 200
        for k in range(periods):
            yield x + (k + 1) * self.little, dict.fromkeys(self.signals, x.sum() + k)

    def others(self):
        return []


def test_the_drift_of_a_run_is_measured_in_the_sizes_of_the_states(monkeypatch):
    monkeypatch.setattr("softrig_core.analysis.steady.StateMap", Wanders)
    point = steady(rig_of_curve(Curve.f))
    assert point.states == pytest.approx({"plant.a": 1.0, "plant.b": 8.0}, rel=1e-12)
    assert point.moved == pytest.approx(200 * 1e-8 / 4.0, rel=1e-6)
    assert point.signals == pytest.approx(dict.fromkeys(["law/u/data", "plant/y/data", "plant/way/data"], 9.0))
    assert (point.at, point.period, point.slowest) == (3.0, 0.01, pytest.approx(0.5))
    # After 200 periods the states have moved by 1e-6 and 1.5e-6 of their sizes.
    monkeypatch.setattr(Wanders, "little", np.array([0.5e-8, 3e-8]))
    with pytest.raises(
        NoOperatingPoint, match=r"near t = 3 s: the point found is not steady; plant\.b = 8 moves by 6e-06 within 2 s$"
    ):
        steady(rig_of_curve(Curve.f))


def test_if_newtons_method_does_not_converge_the_state_that_moves_most_is_reported():
    with pytest.raises(NoOperatingPoint) as refused:
        steady(rig_of_curve(lambda x: 0.05 * (2.0 + x * x) if abs(x) < 1e3 else 0.0), at=0.0)
    message = str(refused.value)
    assert "no operating point near t = 0 s: Newton's method does not converge; plant[0] = " in message
    assert message.endswith(" within 2 s")


def test_impossible_requests_are_refused():
    rig = rig_of_curve(Curve.f)
    for at in (-0.1, math.inf, math.nan):
        with pytest.raises(ScenarioError, match=r"^at = .* s: expected 0 or more$"):
            steady(rig, at=at)
    with pytest.raises(ScenarioError, match="no plant publishes at each of its ticks; name outputs"):
        steady(rig, at=0.0, outputs=[])
    assert steady(rig, at=0.0, outputs=["plant/y/data"]).states.keys() == {"plant[0]"}


def who_moves(A, received):
    """Remove one state after the other that no output reads, that forgets or adds up, and that moves no other."""
    n, left = len(A), set(range(len(A)))
    while True:
        removable = [
            j for j in left if not received[j] and A[j, j] in (0.0, 1.0) and not any(A[i, j] for i in left if i != j)
        ]
        if not removable:
            return [j in left for j in range(n)]
        left -= set(removable)


def test_states_that_only_observe_others_do_not_count():
    rng = np.random.default_rng(4)
    reported = 0
    for _ in range(60):
        n = int(rng.integers(1, 7))
        A = rng.uniform(-1.0, 1.0, (n, n)) * (rng.random((n, n)) < 0.25)
        np.fill_diagonal(A, rng.choice([0.0, 1.0, 0.5], n))
        received = rng.random(n) < 0.2
        expected = who_moves(A, received)
        assert _core(A, received).tolist() == expected
        reported += 0 < sum(expected) < n
    assert reported > 20
    near = np.array([[1.0 + 0.9e-9, 0.0], [0.0, 1.0 + 2e-9]])
    assert _core(near, np.array([False, False])).tolist() == [False, True]


def test_the_step_is_the_shortest_that_comes_nearest_in_the_sizes_of_the_states():
    rng = np.random.default_rng(5)
    for rank in (3, 2, 1):
        sizes = rng.uniform(0.1, 10.0, 3)
        half = rng.normal(size=(3, rank))
        A, move = np.eye(3) - half @ rng.normal(size=(rank, 3)), rng.normal(size=3)
        scale = np.diag(sizes)
        expected = scale @ np.linalg.pinv(np.linalg.inv(scale) @ (np.eye(3) - A) @ scale, rcond=1e-11) @ (move / sizes)
        assert _least_squares(A, move, sizes) == pytest.approx(expected, rel=1e-7)


class Fenced:
    """A map that raises an error if its first number is beyond a limit."""

    t, names = 2.5, ["a", "b"]

    class rig:  # noqa: N801
        class scenario:  # noqa: N801
            name = "fenced"

    def __init__(self, fence):
        self.fence, self.start, self.asked = fence, np.array([1.0, 7.0]), []

    def __call__(self, x, inputs):
        self.asked.append(x[0])
        if x[0] > self.fence:
            raise RunError("beyond")
        return x, {}


@pytest.mark.parametrize(("fence", "halved"), [(2.0, 0), (1.9, 1), (1.25, 2), (1.0 + 2.0**-7, 7)])
def test_a_step_is_halved_until_the_rig_accepts_it(fence, halved):
    fenced = Fenced(fence)
    _go(fenced, [0], np.array([1.0]))
    assert fenced.asked == [1.0 + 0.5**k for k in range(halved + 1)]
    assert fenced.start.tolist() == [1.0 + 0.5**halved, 7.0]


def test_a_step_without_progress_is_reported():
    fenced = Fenced(1.0)
    with pytest.raises(
        NoOperatingPoint, match=r"^fenced: no operating point near t = 2\.5 s: the iteration leaves the l"
    ):
        _go(fenced, [0], np.array([1.0]))
    assert fenced.asked == [1.0 + 0.5**k for k in range(8)]
    assert fenced.start.tolist() == [1.0, 7.0]
