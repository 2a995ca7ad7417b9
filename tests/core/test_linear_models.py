"""Linear models and equilibria of artificial models: polynomials, linear systems, and the path of Newton's method."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from softrig_core import Plant, RunError, Sampled, command, equilibrium, joint_state, linearise, number


def quartic(x, u):
    """A quartic: differences of order four are exact except for rounding."""
    a, b = x
    return np.array([a**4 - 2.0 * a * b**3 + u[0] * b, a * u[0] ** 2]), np.array([a * b - u[0] ** 4])


def test_differences_are_exact_for_polynomials_of_degree_four():
    a, b, u = 1.5, -0.5, 2.0
    result = linearise(quartic, [a, b], [u])
    assert (
        pytest.approx(np.array([[4 * a**3 - 2 * b**3, -6 * a * b**2 + u], [u**2, 0.0]]), rel=1e-9, abs=1e-9) == result.A
    )
    assert pytest.approx(np.array([[b], [2 * a * u]]), rel=1e-9, abs=1e-9) == result.B
    assert pytest.approx(np.array([[b, a]]), rel=1e-9) == result.C
    assert pytest.approx(np.array([[-4 * u**3]]), rel=1e-9) == result.D
    assert (result.x.tolist(), result.u.tolist(), result.y.tolist(), result.period) == (
        [a, b],
        [u],
        [a * b - u**4],
        0.0,
    )


def test_each_number_is_perturbed_by_a_thousandth_of_its_size_or_of_one():
    asked = []

    def model(x, u):
        asked.append([*x, *u])
        return x, u

    linearise(model, [0.25, -8.0], [3.0])
    moved = [(k, row[k] - begin) for row in asked for k, begin in enumerate([0.25, -8.0, 3.0]) if row[k] != begin]
    steps = (1e-3, 8e-3, 3e-3)
    expected = [(k, n * h) for k, h in enumerate(steps) for n in (-2, -1, 1, 2)]
    assert [k for k, _ in moved] == [k for k, _ in expected]
    assert [d for _, d in moved] == pytest.approx([d for _, d in expected], rel=1e-9)


A = np.array([[-1.0, 2.0, 0.0], [0.5, -3.0, 1.0], [0.0, 1.0, 0.0]])
B = np.array([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])


def linear(x, u):
    return A @ x + B @ u, x[:1]


@pytest.mark.parametrize(
    ("conditions", "x", "u"),
    [
        ({}, [1.0 + 2.0 * 0.0, 0.0, -0.5 - 4.0], [1.0, 2.0]),  # solved by hand: x1 = 0, x0 = u0, x2 = -x0/2 - 2 u1
        ({"held": [0], "free": [0]}, [3.0, 0.0, -1.5 - 4.0], [3.0, 2.0]),
        ({"held": [2], "free": [1]}, [1.0, 0.0, 5.0], [1.0, -2.75]),
        ({"moving": [2]}, [(2.0 * 4.0 + 8.0 + 1.0 * 3.0) / 2.0, (0.5 + 4.0 + 5.0) / 2.0, 5.0], [1.0, 2.0]),
    ],
)
def test_an_equilibrium_of_a_linear_model_is_found_in_a_step(conditions, x, u):
    result = equilibrium(linear, [3.0, 4.0, 5.0], [1.0, 2.0], **conditions)
    held = [i for i in range(3) if i in (*conditions.get("held", ()), *conditions.get("moving", ()))]
    remaining = [i for i in range(3) if i not in conditions.get("moving", ())]
    assert result[0][held].tolist() == np.array([3.0, 4.0, 5.0])[held].tolist()
    assert (A @ result[0] + B @ result[1])[remaining] == pytest.approx(np.zeros(len(remaining)), abs=1e-8)
    if "moving" not in conditions:
        assert result[0] == pytest.approx(x, abs=1e-8)
        assert result[1] == pytest.approx(u, abs=1e-8)
    else:
        assert result[0] == pytest.approx(
            np.linalg.solve(A[:2, :2], -A[:2, 2] * 5.0 - (B @ [1.0, 2.0])[:2]).tolist() + [5.0]
        )


@pytest.mark.parametrize(
    ("conditions", "text"),
    [
        ({"held": [0]}, "2 states and 0 inputs are free, expected 3 in all: one for each derivative that is to vanish"),
        ({"free": [1]}, "3 states and 1 inputs are free, expected 3 in all"),
        ({"moving": [0], "held": [0]}, ""),
        ({"moving": [0, 1], "free": [0, 1]}, "1 states and 2 inputs are free, expected 1 in all"),
    ],
)
def test_there_must_be_as_many_unknowns_as_conditions(conditions, text):
    if not text:
        equilibrium(linear, [3.0, 4.0, 5.0], [1.0, 2.0], **conditions)
        return
    with pytest.raises(ValueError, match=f"^{text}"):
        equilibrium(linear, [3.0, 4.0, 5.0], [1.0, 2.0], **conditions)


def one(f):
    """A model of one state, and the states at which it was evaluated (except for the differences)."""
    asked = []

    def model(x, u):
        asked.append(float(x[0]))
        return np.array([f(x[0])]), x

    return model, asked


def test_a_step_is_halved_until_it_comes_nearer():
    """Newton's method for atan diverges from 3; half a step, and half of that, converge."""
    model, asked = one(math.atan)
    (x,), _ = equilibrium(model, [3.0], [])
    assert x == pytest.approx(0.0, abs=3e-9)
    move = math.atan(3.0) * 10.0  # Newton's step: the value divided by the slope 1/(1 + x^2)
    assert asked[6:9] == pytest.approx([3.0 - move, 3.0 - move / 2.0, 3.0 - move / 4.0], rel=1e-6)
    hole, asked = one(lambda x: x - 1.0 if x < 1.5 or x > 3.9 else math.nan if x < 3.0 else 2.0 * x)
    assert equilibrium(hole, [4.0], [])[0] == pytest.approx([1.0])


def test_a_model_without_equilibrium_is_reported_with_the_remaining_distance():
    with pytest.raises(
        RunError, match=r"^no equilibrium found near x = \[3\.0\], u = \[\]: the largest derivative left is 1$"
    ):
        equilibrium(one(lambda x: 1.0 + x * x)[0], [3.0], [])
    with pytest.raises(RunError, match=r"the largest derivative left is 2$"):  # the slope is zero everywhere
        equilibrium(one(lambda x: 2.0)[0], [3.0], [])


@pytest.mark.parametrize(("start", "tolerance", "asked"), [(1.0, 0.5, 2), (1.0, 0.49, 9), (3.0, 0.75, 2)])
def test_rest_is_relative_to_one_and_the_largest_initial_derivative(start, tolerance, asked):
    model, places = one(lambda x: x)
    equilibrium(model, [start], [], tolerance=tolerance)
    assert len(places) <= asked
    assert (len(places) == 2) == (asked == 2)


class Mixed(NamedTuple):
    a: float
    n: int
    b: float


class Box(Plant):
    """a+ = a + T (b + u_1 + 2 u_2), b+ = b + T (-a + 3 v); an integer counts the ticks."""

    INPUTS = (command("u", "box/u", ["l", "r"], "N"), number("v", "box/v", "V"))
    OUTPUTS = (
        number("rare", "box/rare", "m", sporadic=True),
        joint_state("state", "box/state", ["x"], position=["m"], velocity=["m/s"]),
        number("sum", "box/sum", "m"),
    )

    def first(self):
        return Mixed(1.0, 7, 2.0)

    def outputs(self, x, t):
        return {"rare": None, "state": (x.a, 5.0 * x.b), "sum": (x.a - x.b + x.n + t,)}

    def advance(self, x, t, u, v):
        T = self.p.period
        return Mixed(x.a + T * (x.b + u[0] + 2.0 * u[1]), x.n + 1, x.b + T * (-x.a + 3.0 * v[0]))


def test_a_sampled_plant_is_its_difference_equation():
    box = Box(period=0.25)
    dx, y = Sampled(box, 100)(np.array([1.0, 2.0]), np.array([3.0, 4.0, 5.0]))
    assert (dx.tolist(), y.tolist()) == ([2.0 + 3.0 + 8.0, -1.0 + 15.0], [1.0, 10.0, 1.0 - 2.0 + 7.0 + 100.0])
    assert Sampled(box)(np.array([1.0, 2.0]), np.zeros(3))[1][2] == 6.0
    result = Sampled(box).linearise((1.0, 2.0), (3.0, 4.0, 5.0))
    assert pytest.approx(np.array([[1.0, 0.25], [-0.25, 1.0]]), abs=1e-9) == result.A
    assert pytest.approx(0.25 * np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 3.0]]), abs=1e-9) == result.B
    assert pytest.approx(np.array([[1.0, 0.0], [0.0, 5.0], [1.0, -1.0]]), abs=1e-9) == result.C
    assert pytest.approx(np.zeros((3, 3)), abs=1e-9) == result.D
    assert result.period == 0.25
