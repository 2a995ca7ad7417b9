"""Series, roots, planners, player and evaluator over small cases, against independent code.

Sources: closed forms of the linear quadratic problems, casadi and scipy as other libraries, and loops.
"""

import itertools
import math
from random import Random
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from helpers import near
from scipy.integrate import solve_ivp
from softrig_core import ByHand, Level, Result, to_ns
from softrig_systems.optimal_control.collocation_planner import CollocationPlanner
from softrig_systems.optimal_control.evaluator import FIGURES, OcpEvaluator
from softrig_systems.optimal_control.method import collocation, exact, mvim, roots
from softrig_systems.optimal_control.method.mvim import Solution, costate, newton, polynomials
from softrig_systems.optimal_control.method.quadrature import gauss_legendre
from softrig_systems.optimal_control.method.roots import Root, best, distinct, starts
from softrig_systems.optimal_control.method.tape import Tape, expand
from softrig_systems.optimal_control.momentum_feedback import MomentumFeedback
from softrig_systems.optimal_control.mvim_planner import MvimPlanner
from softrig_systems.optimal_control.parameters import ProblemParams
from softrig_systems.optimal_control.planning import Planned
from softrig_systems.optimal_control.plants import OcpPlant, SpacecraftPlant
from softrig_systems.optimal_control.player import OcpPlayer
from softrig_systems.optimal_control.ports import SUMMARY, plan, state, summary
from softrig_systems.optimal_control.problem import Problem, ProblemError
from softrig_systems.optimal_control.problems import INERTIA, find, spacecraft

S = 1_000_000_000


MOVER = Problem(  # the mass moves by 1 in 2 s: u = 1.5 (1 - t), lambda = (-1.5, -1.5 (1 - t)), J = 0.75
    "mover",
    {"q": "m", "v": "m/s"},
    {"u": "m/s^2"},
    lambda x, u: [x[1], u[0]],
    lambda x, u: u[0] ** 2 / 2,
    x0=(0.0, 0.0),
    horizon=2.0,
    x_end=(1.0, 0.0),
)


# series and quadrature -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 5, 64])
def test_nodes_and_weights_are_those_of_numpy(n):
    nodes, weights = np.polynomial.legendre.leggauss(n)
    nodes_and_weights = gauss_legendre(n)
    assert nodes_and_weights[0] == pytest.approx(0.5 * (1.0 + nodes), abs=1e-14)
    assert nodes_and_weights[1] == pytest.approx(0.5 * weights, abs=1e-14)


def test_the_series_of_every_operation_is_the_solution_of_its_equation():
    """Cosine, logarithm, root, powers, quotients and negatives, order by order, against an integration."""
    z = ca.SX.sym("z", 2)
    F = ca.vertcat(
        ca.cos(z[1]) + ca.log(2.0 + z[0]) - z[0] ** 3 / 4.0,
        -ca.sqrt(2.0 + z[0]) + (2.0 + z[1]) ** 1.5 / 4.0 - 1.0 / (3.0 + z[0]) + ca.sin(z[0]) * ca.exp(-z[1]),
    )
    shown = ca.vertcat(z[0] * z[1], ca.cos(z[0]) ** 2)
    table, more = np.zeros((2, 28)), np.zeros((2, 28))
    table[:, 0] = 0.2, -0.1
    expand(Tape.of(ca.Function("f", [z], [ca.vertcat(F, shown)])), table, more, 0.4)
    f, g = ca.Function("f", [z], [F]), ca.Function("g", [z], [shown])
    exactly = solve_ivp(lambda t, x: f(x).full().ravel(), (0.0, 0.4), [0.2, -0.1], rtol=1e-12, atol=1e-13).y[:, -1]
    assert table.sum(axis=1) == pytest.approx(exactly, abs=1e-9)
    assert more.sum(axis=1) == pytest.approx(g(exactly).full().ravel(), abs=1e-9)


def test_whole_powers_are_products_and_others_are_not():
    """(x - 1)^n about 1, where the recursion of a general power would divide by zero."""
    x = ca.SX.sym("x")
    for exponent in (1, 2, 3, 16):
        table = np.zeros((1, 4))
        table[0, 0] = 1.0
        expand(Tape.of(ca.Function("f", [x], [(x - 1.0) ** exponent])), table, np.zeros((0, 4)), 1.0)
        assert table[0].tolist() == [1.0, 0.0, 0.0, 0.0]
    with pytest.raises(
        ValueError, match=r"^f uses casadi operation \d+, which has no power series here: expected \+ - "
    ):
        Tape.of(ca.Function("f", [x], [x**x]))


def test_a_plan_is_read_by_its_stages():
    coefficients = np.arange(18.0).reshape(3, 2, 3)
    for s in (-0.1, 0.0, 0.2, 1.0 / 3.0, 0.5, 0.99, 1.0, 1.1):
        stage = 0 if s < 1 / 3 else 1 if s < 2 / 3 else 2
        local = 3.0 * s - stage
        expected = [sum(c * local**k for k, c in enumerate(row)) for row in coefficients[stage]]
        assert polynomials(coefficients, s).tolist() == near(expected)
    whole = Solution(coefficients, 6.0, 2, np.zeros(1))
    assert whole(3.0).tolist() == polynomials(coefficients, 0.5).tolist()


# problems --------------------------------------------------------------------------------------------------------


def test_the_problems_equal_their_equations():
    draw = Random(3)
    for name, equations in (
        ("scalar", lambda x, u: [x[0] ** 2 * math.sin(x[0]) / 2 + u[0], u[0] ** 2]),
        (
            "two_state",
            lambda x, u: [x[1] + x[0] * x[1], -x[0] + x[1] + x[1] ** 2 + u[0], (x[0] ** 2 + x[1] ** 2 + u[0] ** 2) / 2],
        ),
        (
            "reactor",
            lambda x, u: [
                -2 * (x[0] + 0.25) + (x[1] + 0.5) * math.exp(25 * x[0] / (x[0] + 2)) - (x[0] + 0.25) * u[0],
                0.5 - x[1] - (x[1] + 0.5) * math.exp(25 * x[0] / (x[0] + 2)),
                x[0] ** 2 + x[1] ** 2 + 0.1 * u[0] ** 2,
            ],
        ),
        (
            "spacecraft",
            lambda x, u: [
                ((85.07 - 113.59) * x[1] * x[2] + u[0]) / 86.24,
                ((113.59 - 86.24) * x[2] * x[0] + u[1]) / 85.07,
                ((86.24 - 85.07) * x[0] * x[1] + u[2]) / 113.59,
                (u[0] ** 2 + u[1] ** 2 + u[2] ** 2) / 2,
            ],
        ),
    ):
        x, u, dx, L = find(name).expressions()
        f = ca.Function("f", [x, u], [ca.vertcat(dx, L)])
        at = [draw.uniform(-0.5, 0.5) for _ in range(x.numel())], [draw.uniform(-1.0, 1.0) for _ in range(u.numel())]
        assert f(*at).full().ravel().tolist() == near(equations(*at))
    stated = {p.name: (p.x0, p.horizon, p.x_end, p.carrier) for p in map(find, ("scalar", "two_state", "reactor"))}
    assert stated == {
        "scalar": ((0.0,), 1.0, (0.5,), "position"),
        "two_state": ((-0.8, 0.0), 1.0, None, "position"),
        "reactor": ((0.05, 0.0), 0.78, None, "position"),
    }
    assert (find("spacecraft").x0, find("spacecraft").horizon) == ((0.01, 0.005, 0.001), 100.0)


@pytest.mark.parametrize("R", [(), (3.0,)])
def test_pontryagins_conditions_are_those_of_the_hamiltonian(R):
    """u makes H least; x' and -lambda' are its slopes; the variational equations are differences of the canonical."""
    problem = find("reactor").changed(R=R)
    x, u, dx, L = problem.expressions()
    lam = ca.SX.sym("lam", 2)
    H = ca.Function("H", [x, lam, u], [L + ca.dot(lam, dx)])
    z = np.array([0.1, -0.2, 0.3, -0.4])

    def hamiltonian(z, u):
        return float(H(z[:2], z[2:], u))

    F, best_u = (np.array(v).ravel() for v in problem.extremal.function(z))
    at = hamiltonian(z, best_u)
    assert min(hamiltonian(z, best_u + d) - at for d in (1e-3, -1e-3)) == pytest.approx((R[0] / 2 if R else 0.1) * 1e-6)
    steps = 1e-5 * np.eye(4)
    slopes = [(hamiltonian(z + d, best_u) - hamiltonian(z - d, best_u)) / 2e-5 for d in steps]
    assert F.tolist() == pytest.approx([slopes[2], slopes[3], -slopes[0], -slopes[1]], abs=1e-7)
    jacobian = [
        (np.array(problem.extremal.function(z + d)[0]) - problem.extremal.function(z - d)[0]) / 2e-5 for d in steps
    ]
    columns = np.zeros((12, 2))
    columns[:, 0] = [*z, *np.arange(8.0)]  # S has a column for each costate
    expand(problem.extremal.variational, columns, np.zeros((0, 2)), 1.0)
    moved = np.hstack(jacobian) @ np.arange(8.0).reshape(2, 4).T
    assert columns[4:, 1].tolist() == pytest.approx(moved.T.ravel().tolist(), rel=1e-7, abs=1e-7)
    assert columns[:4, 1].tolist() == near(F.tolist())


def test_a_problem_changed_is_checked():
    changed = MOVER.changed(x0=(1, 2), horizon=3, x_end=(4, 5), R=(2,))
    assert (changed.x0, changed.horizon, changed.x_end, changed.R) == ((1.0, 2.0), 3.0, (4.0, 5.0), (2.0,))
    assert MOVER.changed() == MOVER
    assert changed.end_error(np.array([5.0, 7.0, 1.0, 1.0])).tolist() == [1.0, 2.0]
    for values, text in (
        ({"x0": (1.0,)}, r"^x0 = \(1.0,\): expected 2 finite numbers$"),
        ({"x_end": (1.0, math.nan)}, r"^x_end = \(1.0, nan\): expected 2 finite numbers$"),
        ({"horizon": 0.0}, "^horizon = 0 s: expected a positive time$"),
        ({"horizon": math.inf}, "^horizon = inf s: expected a positive time$"),
        ({"R": (1.0, 2.0)}, "^R: expected 1 numbers, row by row, not 2$"),
        ({"R": (0.0,)}, r"^R = \[\[0.0\]\]: expected a symmetric positive definite matrix$"),
    ):
        with pytest.raises(ProblemError, match=text):
            MOVER.changed(**values)
    free = Problem(**{**MOVER.__dict__, "name": "free", "x_end": None})
    assert free.end_error(np.array([5.0, 7.0, 1.0, 2.0])).tolist() == [1.0, 2.0]
    idle = Problem(**{**MOVER.__dict__, "name": "idle", "cost": lambda x, u: x[0] ** 2 + 0 * u[0] ** 2})
    with pytest.raises(ProblemError, match=r"^R: the cost of idle has no positive definite weight of the control$"):
        _ = idle.extremal
    for inertia, fits in (((1.0, 2.0, 3.0), True), ((1.0, 2.0, 3.01), False), ((1.0, math.inf, 2.0), False)):
        if fits:
            assert spacecraft(inertia).states.keys() == {"axis_1", "axis_2", "axis_3"}
        else:
            with pytest.raises(ProblemError, match=r"^inertia = "):
                spacecraft(inertia)


def test_quantities_that_nodes_of_a_problem_agree_on():
    p = ProblemParams(problem="spacecraft", x0=(0.1, 0.2, 0.3), horizon=5.0, inertia=(2.0, 2.0, 2.0))
    assert p.plant_agreed() == {"ocp/problem": "spacecraft", "ocp/x0": (0.1, 0.2, 0.3), "ocp/inertia": (2.0, 2.0, 2.0)}
    assert p.task_agreed() == {"ocp/problem": "spacecraft", "ocp/horizon": 5.0, "ocp/x_end": (0.0,) * 3, "ocp/R": ()}
    other = ProblemParams(problem="two_state", R=(2.0,))
    assert other.plant_agreed() == {"ocp/problem": "two_state", "ocp/x0": (-0.8, 0.0)}
    assert other.task_agreed() == {"ocp/problem": "two_state", "ocp/horizon": 1.0, "ocp/x_end": None, "ocp/R": (2.0,)}


def test_ports_of_a_problem():
    problem = find("spacecraft")
    assert (plan(problem, 5).size, plan(problem, 5, stages=2).size) == (9 * 5, 2 * 9 * 5)
    assert (plan(problem, 5).sporadic, plan(problem, 5, output=True).sporadic) == (False, True)
    assert (summary().sporadic, summary(output=True).sporadic, summary().size) == (False, True, 8)
    assert tuple(state(problem).limits[:3]) == (1e3,) * 3
    assert (state(problem).size, state(MOVER).size, tuple(state(MOVER).limits)) == (6, 2, (1e3,) * 2)


@pytest.mark.parametrize(("x0", "x_end", "T"), [(0.0, 0.5, 1.0), (0.9, 0.2, 2.0), (-0.3, 0.6, 0.5)])
def test_the_scalar_problem_by_quadrature_ends_at_its_state_and_cost(x0, x_end, T):
    """Its costate at the start, integrated with the state and the cost."""
    result = exact.scalar(x_end, T, x0)

    def slopes(t, z):
        x, lam, _ = z
        u = -lam / 2
        return [x * x * math.sin(x) / 2 + u, -lam * (x * math.sin(x) + x * x * math.cos(x) / 2), u * u]

    end = solve_ivp(slopes, (0.0, T), [x0, result.alpha, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
    assert (end[0], end[2]) == pytest.approx((x_end, result.cost), rel=1e-8)
    problem = find("scalar").changed(x0=(x0,), x_end=(x_end,), horizon=T)
    assert exact.least_cost(problem) == result.cost


def test_the_boundary_value_solver_with_a_given_start():
    problem = find("scalar").changed(x0=(0.1,), x_end=(0.3,), horizon=2.0)
    result = exact.tpbvp(problem, 1e-5, np.array([0.2, -0.2]))
    assert result.cost == pytest.approx(exact.scalar(0.3, 2.0, 0.1).cost, rel=1e-5)
    assert (result.t[0], result.t[-1], result.z[:, 0][0], result.z[0, -1]) == pytest.approx(
        (0.0, 2.0, 0.1, 0.3), abs=1e-6
    )


# roots -----------------------------------------------------------------------------------------------------------


def ends_of(f, slope, asked=None):
    """A function of one alpha and its slope, in place of the end conditions."""

    def ends(problem, alpha, order, stages, T):
        if asked is not None:
            asked.append(float(alpha[0]))
        return np.array([f(alpha[0])]), np.array([[slope(alpha[0])]])

    return ends


def test_newton_halves_its_steps_if_allowed_and_keeps_the_best(monkeypatch):
    asked = []
    monkeypatch.setattr(mvim, "_ends", ends_of(math.atan, lambda a: 1.0 / (1.0 + a * a), asked))
    alpha, error = newton(None, np.array([3.0]), 1, 1, 1.0, 1e-12, 12)
    assert (abs(alpha[0]) < 1e-9, error < 1e-9) == (True, True)
    a, expected = 3.0, [3.0]  # the damped steps, computed here
    while len(expected) < len(asked):
        step = -math.atan(a) * (1.0 + a * a)
        for _ in range(13):
            expected.append(a + step)
            if abs(math.atan(a + step)) < abs(math.atan(a)):
                break
            step /= 2.0
        a = expected[-1]
    assert asked == near(expected[: len(asked)])
    asked.clear()
    # Full steps diverge, so the first alpha was the best.
    alpha, error = newton(None, np.array([3.0]), 1, 1, 1.0, 1e-12, 0, 5)
    assert (alpha[0], error, len(asked)) == (3.0, near(math.atan(3.0)), 6)
    asked.clear()
    monkeypatch.setattr(mvim, "_ends", ends_of(lambda a: 1e-9, lambda a: 1.0, asked))
    assert newton(None, np.array([0.0]), 1, 1, 1.0, 1e-8) == (0.0, 1e-9)  # the first of several equal errors wins
    assert len(asked) == 3  # an accurate start needs two more steps to see that they change nothing
    asked.clear()
    newton(None, np.array([0.0]), 1, 1, 1.0, 1e-9)
    assert len(asked) == 3  # an error equal to the tolerance counts as accurate
    asked.clear()
    assert newton(None, np.array([0.0]), 1, 1, 1.0, 1e-10)[1] == 1e-9
    assert len(asked) == 41  # an inaccurate start uses all 40 steps
    asked.clear()
    monkeypatch.setattr(mvim, "_ends", ends_of(lambda a: a * a, lambda a: 2.0 * a, asked))
    assert newton(None, np.array([1.0]), 1, 1, 1.0, 1e-30, steps=7)[0][0] == 2.0**-7
    for f, slope in (
        (lambda a: math.nan, lambda a: 1.0),
        (lambda a: 1.0, lambda a: math.inf),
        (lambda a: 0.0, lambda a: 1.0),
        (lambda a: 1.0, lambda a: 0.0),
    ):
        asked.clear()
        monkeypatch.setattr(mvim, "_ends", ends_of(f, slope, asked))
        assert newton(None, np.array([2.0]), 1, 1, 1.0, 1e-9)[0][0] == 2.0
        assert asked == [2.0]


def test_the_end_conditions_and_their_jacobian_are_differences():
    for problem in (MOVER.changed(x0=(0.3, -0.2)), find("two_state")):
        alpha = np.array([0.4, -0.3])
        error, jacobian = mvim._ends(problem, alpha, 12, 2, 0.9)
        step = [
            mvim._ends(problem, alpha + d, 12, 2, 0.9)[0] - mvim._ends(problem, alpha - d, 12, 2, 0.9)[0]
            for d in 1e-5 * np.eye(2)
        ]
        assert jacobian == pytest.approx(np.array(step).T / 2e-5, abs=1e-8)
    # The mover with lambda = (0.4, -0.3 - 0.4 t), hence u = 0.3 + 0.4 t.
    T = 0.9
    error, _ = mvim._ends(MOVER.changed(x0=(0.3, -0.2)), np.array([0.4, -0.3]), 6, 1, T)
    q, v = 0.3 - 0.2 * T + 0.3 * T**2 / 2 + 0.4 * T**3 / 6, -0.2 + 0.3 * T + 0.4 * T**2 / 2
    assert error.tolist() == near([q - 1.0, v])


@pytest.mark.parametrize(
    ("order", "reached", "answer"),
    [
        (1, {1.0: 9.0}, 2.0),  # the root found from 1 is 9, which is too far; the damped search finds 2
        (5, {1.0: 1.5}, 1.5),  # a root at most half of alpha away is accepted
        (5, {1.0: 1.51}, 1.51),  # too far, but the damped search finds 2.0, which is further
        (5, {1.0: 4.0}, 2.0),
        (5, {}, 2.0),
        (2, {1.0: 1.0999}, 1.0999),  # at a low order, a tenth of alpha is near enough
        (4, {1.0: 1.11}, 1.11),
    ],
)
def test_a_costate_follows_its_branch(monkeypatch, order, reached, answer):
    """Newton's method is replaced by one that reaches the given root, and 2 from a start at 2, and fails elsewhere."""

    def replaced(problem, alpha, order, stages, T, accurate, halvings=0, steps=40):
        start = round(float(alpha[0]), 9)
        if start in reached and halvings == 0:
            return np.array([reached[start]]), 1e-8  # exactly the tolerance
        return (np.array([2.0]), 1e-8) if start == 2.0 and halvings == 12 else (alpha, 1.0)

    monkeypatch.setattr(mvim, "newton", replaced)
    monkeypatch.setattr(mvim, "distinct", lambda *args: pytest.fail("no low order"))
    result, several = costate(SimpleNamespace(horizon=1.0), np.array([1.0]), order, 1, 1e-8)
    assert (result[0], several) == (answer, [])


def test_a_costate_of_a_low_order_is_the_best_of_all(monkeypatch):
    """Beyond a tenth all roots are computed; a single alpha is not judged; without any the branch is followed."""
    problem = SimpleNamespace(horizon=1.0)
    monkeypatch.setattr(mvim, "newton", lambda *args: (np.array([1.2]), 1e-9))
    monkeypatch.setattr(mvim, "best", lambda problem, roots, z_of, cost: [Root(r, 0.0, 0.0) for r in roots[::-1]])
    for order, roots_found, answer in ((2, [1.2, 7.0], 7.0), (3, [1.2, 7.0, 5.0], 5.0), (2, [3.0], 3.0), (2, [], 1.2)):
        monkeypatch.setattr(mvim, "distinct", lambda *args, roots=roots_found: [np.array([g]) for g in roots])
        result, several = costate(problem, np.array([1.0]), order, 1, 1e-8)
        assert (result[0], len(several)) == (answer, len(roots_found) if len(roots_found) > 1 else 0)
    monkeypatch.setattr(mvim, "distinct", lambda *args: pytest.fail("no low order"))
    assert costate(problem, np.array([1.0]), 4, 1, 1e-8)[0][0] == 1.2


@pytest.mark.parametrize(("limit", "answer"), [(99.0, 0.1), (2.0, -4.7)])
def test_an_unreachable_costate_is_continued_with_the_horizon(monkeypatch, limit, answer):
    """From 0 on over tenths of the horizon; if one of them has no root, the last result of Newton's method is kept."""
    asked = []

    def replaced(problem, alpha, order, stages, T, accurate, halvings=0, steps=40):
        if halvings == 12 and 0.0 <= alpha[0] < 1.0 and limit > T:
            asked.append((T, float(alpha[0])))
            return alpha + 0.01, accurate
        return alpha - 5.0, 1.0

    monkeypatch.setattr(mvim, "newton", replaced)
    result, several = costate(SimpleNamespace(horizon=4.0), np.array([0.3]), 9, 1, 1e-8)
    assert (result[0], several) == (near(answer), [])
    assert asked == [(near(0.4 * k), near(0.01 * (k - 1))) for k in range(1, 11) if 0.4 * k < limit - 1e-9]


def test_the_distance_of_a_moved_costate():
    assert mvim._moved(np.array([3.0, 4.0]), np.array([0.0, 4.0])) == 0.75
    assert mvim._moved(np.array([3.0, 4.0]), np.zeros(2)) == 0.0


def test_newton_begins_in_all_directions_from_zero():
    for alpha, scale in ((np.array([3.0, -0.1]), (3.0, 0.1 * math.hypot(3.0, 0.1))), (np.zeros(2), (1e-4, 1e-4))):
        expected = [(0.0, 0.0)]
        for size in (0.5, 1.5, 5.0):
            ways = [d for d in itertools.product((0.0, 1.0, -1.0), repeat=2) if d != (0.0, 0.0)]
            expected += [tuple(size * a * b for a, b in zip(d, scale, strict=True)) for d in ways]
        assert [tuple(s) for s in starts(alpha)] == near(expected) or np.allclose(starts(alpha), expected)
        np.testing.assert_allclose(starts(alpha), expected, rtol=1e-12)


def test_equal_roots_are_counted_once():
    """Newton's method ends at the nearest of -2, 1 and 1 + 1e-7, or beside all of them."""
    ends = np.array([-2.0, 1.0, 1.0 + 5e-7, 40.0])

    def newton(start):
        end = ends[np.argmin(np.abs(ends - start[0]))]
        return np.array([end]), 0.01 if end == 40.0 else 1e-9

    result = distinct(np.array([1.0]), np.array([1.0]), 1e-9, 1e-9, newton)
    assert [f[0] for f in result] == [1.0, -2.0]
    missed = distinct(np.array([1.0]), np.array([1.0]), 1e-8, 1e-9, newton)
    assert sorted(round(f[0], 3) for f in missed) == [-2.0, 1.0]
    apart = distinct(np.array([1.0]), np.array([1.0]), 1e-9, 1e-9, lambda s: (np.array([1.0 + 3e-6]), 1e-9))
    assert len(apart) == 2


def test_roots_are_ordered_by_the_cost_in_the_plant():
    """The mover under u = a constant: it costs T u^2/2 and, for the missed end, the costates at the end."""

    def z_of(alpha):
        z = np.zeros((1, 4, 2))
        z[0, 2:, 0] = -3.0, 0.5
        return z, np.array([[[float(alpha[0]), 0.0]]])

    def paid(u):
        return 2.0 * u * u / 2 + 3.0 * abs(2.0 * u - 1.0) + 0.5 * abs(2.0 * u)

    candidates = [np.array([u]) for u in (2.0, 0.4, -1.0, 1e7)]
    result = best(MOVER, candidates, z_of, lambda z, u: 7.0 * float(u[0, 0, 0]))
    assert [r.alpha[0] for r in result] == [0.4, -1.0, 2.0, 1e7]
    assert [r.paid for r in result] == pytest.approx([paid(0.4), paid(-1.0), paid(2.0), math.inf])
    assert [r.series for r in result] == near([2.8, -7.0, 14.0, 7e7])
    free = Problem(**{**MOVER.__dict__, "name": "free mover", "x_end": None})
    escaped = best(free, [np.array([u]) for u in (3e6, 2e6, 0.5)], z_of, lambda z, u: float(u[0, 0, 0]))
    assert [(r.alpha[0], r.paid) for r in escaped] == [(0.5, near(0.25)), (2e6, math.inf), (3e6, math.inf)]
    # Controls of 1 for 1 s and then 2 for 1 s: v = 1 + 1, J = 1/2 + 2/3.
    staged = np.array([[[1.0, 0.0]], [[0.0, 2.0]]])
    x = np.array([0.0, 0.0, 0.0])
    roots.pay(MOVER.extremal.plant, staged, 2.0, 64, x)
    assert x.tolist() == pytest.approx([0.5 + 1.0 + 1.0 / 3.0, 2.0, 0.5 + 2.0 / 3.0])


def test_reasons_and_roots_are_described_as_expected():
    base = {"coefficients": np.zeros((1, 1, 1)), "horizon": 1.0, "order": 4, "alpha": np.zeros(1)}

    def reason(**more):
        return mvim._reason(Solution(**base, **{"ratio": [0.5, 0.01, 0.002], "accurate": True, **more}), 1e-3, 1e-4)

    assert reason(accurate=False, end_error=0.25) == "end conditions missed by 0.25"
    assert reason(residual=[1.0, 1e-4]) == "residual 0.0001 is not below 0.0001"
    assert reason(residual=[0.9e-4]) == "cost has not settled: ratios 0.01, 0.002 against 0.001"
    assert reason(residual=[0.9e-4], converged=True) == "converged at order 4"
    solution = Solution(
        **base, roots={2: [Root(None, 0.5, 0.0), Root(None, math.inf, 0.0)], 3: [Root(None, 1.23456789, 0.0)]}
    )
    assert mvim.several(solution) == (
        "2 roots at order 2, under which the plant pays 0.5, without end: the first is taken; "
        "1 roots at order 3, under which the plant pays 1.2346: the first is taken"
    )


def test_stages_are_doubled_until_the_order_suffices(monkeypatch):
    asked = []

    def replaced(problem, order, *, eps_res, stages):
        asked.append(stages)
        return SimpleNamespace(accurate=stages >= 4, residual=[9.0, 0.1 / stages])

    monkeypatch.setattr(mvim, "solve", replaced)
    assert (mvim.enough_stages(None, 8, 1.0), asked) == (4, [2, 4])
    asked.clear()
    assert (mvim.enough_stages(None, 8, 0.1 / 16), asked) == (0, [2, 4, 8, 16])
    asked.clear()
    assert (mvim.enough_stages(None, 8, 0.1 / 15, most=8), asked) == (0, [2, 4, 8])
    assert mvim.enough_stages(None, 8, 0.1 / 15) == 16


def test_the_evaluation_of_a_series_is_its_integral_and_its_slopes():
    """For polynomials that are not a solution: cost by Gauss, residual by differences, relative to states and
    costates.
    """
    rng = np.random.default_rng(2)
    problem = find("two_state").changed(horizon=1.6)
    z, u = 0.3 * rng.normal(size=(2, 4, 4)), 0.3 * rng.normal(size=(2, 1, 4))
    J, relative, states = mvim._judge(problem, z, u)
    x, w, _dx, L = problem.expressions()
    running = ca.Function("L", [x, w], [L])
    cost, off, sizes = 0.0, np.zeros(4), np.zeros(4)
    for stage in range(2):
        of = [np.polynomial.Polynomial(c) for c in (*z[stage], *u[stage])]
        nodes, weights = np.polynomial.legendre.leggauss(20)
        for s, weight in zip(0.5 * (nodes + 1.0), weights, strict=True):
            cost += 0.4 * weight * float(running([p(s) for p in of[:2]], of[4](s)))
        for s in np.linspace(0.0, 1.0, 65):
            now = np.array([p(s) for p in of[:4]])
            rate = np.array([p.deriv()(s) / 0.8 for p in of[:4]])
            F = problem.extremal.function(now)[0].full().ravel()
            off, sizes = np.maximum(off, np.abs(rate - F)), np.maximum(sizes, np.abs(now))
    assert near(cost) == J
    assert states == near(max(off[:2]))
    assert relative == near(1.6 * max(max(off[:2]) / max(sizes[:2]), max(off[2:]) / max(sizes[2:])))


# collocation -----------------------------------------------------------------------------------------------------


def test_collocation_of_a_mass_equals_its_closed_form_at_any_sampling():
    """The exact answer is a cubic, which three points an interval represent."""
    solution = collocation.solve(MOVER, intervals=2, samples=9)
    t = np.linspace(0.0, 2.0, 9)
    rows = [0.75 * t**2 - 0.25 * t**3, 1.5 * t - 0.75 * t**2, -1.5 + 0 * t, -1.5 * (1.0 - t), 1.5 * (1.0 - t)]
    assert solution.rows == pytest.approx(np.array(rows), abs=1e-7)
    assert (solution.J, solution.success, solution.iterations > 0) == (pytest.approx(0.75), True, True)
    assert solution.alpha == pytest.approx([-1.5, -1.5])
    assert (solution.residual < 1e-9, solution.end_error < 1e-8) == (True, True)


def test_the_residual_of_a_coarse_collocation_is_that_of_its_polynomial():
    """One interval of two points: x a parabola, u a line, read from their samples; between the Legendre points."""
    problem = find("scalar").changed(horizon=2.0, x_end=(1.2,))
    solution = collocation.solve(problem, intervals=1, degree=2, samples=41)
    t = np.linspace(0.0, 2.0, 41)
    x, u = np.polynomial.Polynomial.fit(t, solution.rows[0], 2), np.polynomial.Polynomial.fit(t, solution.rows[2], 1)
    points = [0.0, *(1.0 + np.polynomial.legendre.leggauss(2)[0])]  # over the first of two intervals of 2 s
    between = [(a + b) / 2 for a, b in itertools.pairwise(points)]
    off = max(abs(x.deriv()(s) - x(s) ** 2 * math.sin(x(s)) / 2 - u(s)) for s in between)
    assert off > 1e-3
    assert solution.residual == pytest.approx(2.0 * off / max(abs(x(s)) for s in points), rel=1e-6)


def test_the_remaining_plan_has_the_end_of_the_plan():
    # Rows of a state, two costates and a control.
    rows = np.array([np.linspace(0.0, 1.0, 11) ** k for k in (3, 2, 5, 1)])
    guess = collocation.sampled(rows[[0, 1, 2]], 10.0, 4.0, 1)
    s = np.array([0.0, 0.5, 1.0])
    assert guess(s) == pytest.approx(np.array([[0.6**3, 0.8**3, 1.0], [0.6**5, 0.8**5, 1.0]]), abs=1e-3)
    assert guess(s)[0] == near([0.6**3, 0.8**3, 1.0])


# nodes -----------------------------------------------------------------------------------------------------------


def test_a_planner_requests_at_the_expected_ticks():
    """Every third period from the first state on; also with two periods left, with fewer the old plan stays."""
    planner = MvimPlanner(problem="two_state", period=0.1, k_replan=3)
    x, asked = planner.first(), {}
    x = x._replace(last=Planned((), 0, 0.0, 0.0, 0.0, True, True, "", {}, "remembered"))
    for k in range(12):
        x, request = planner.request(x, to_ns(5.0 + 0.1 * k), state=(0.1 * k, 1.0), replan=(float(k == 8),))
        if request is not None:
            asked[k] = request
    assert list(asked) == [0, 3, 6, 8]
    for k, request in asked.items():
        assert (request.x, request.horizon, request.before) == ((0.1 * k, 1.0), near(1.0 - 0.1 * k), "remembered")
    assert MvimPlanner(problem="two_state").request(MvimPlanner().first(), 0, state=(1.0, 2.0))[1].before is None


def test_reports_of_a_planner_about_an_answer_are_as_expected():
    planner = MvimPlanner(problem="two_state", order=1, eps_res=0.1)
    request = SimpleNamespace(horizon=0.7)

    def updated(new=True, **more):
        planner.events.clear()
        planned = Planned(
            **{
                "values": (1.0,) * 10,
                "order": 4,
                "J": 0.5,
                "residual": 0.099,
                "end_error": 0.25,
                "accurate": True,
                "converged": True,
                "reason": "because",
                "details": {"a": "b"},
                **more,
            }
        )
        x, values = planner.answer(planner.first(), 9, Result(3 * S, request, planned, True), new)
        return values.get("summary"), sorted(planner.reports), x.last is planned

    assert updated() == ((3.0, 0.7, 4.0, 0.5, 0.099, 0.25, 1.0, 1.0), [], True)
    assert updated(residual=0.1, converged=False) == (
        (3.0, 0.7, 4.0, 0.5, 0.1, 0.25, 0.0, 0.0),
        ["not_converged"],
        True,
    )
    assert updated(accurate=False) == (None, ["no_plan"], False)
    assert updated(values=(1.0, math.nan)) == (None, ["no_plan"], False)
    assert planner.reports["no_plan"][:2] == (Level.ERROR, "no plan: because")
    assert updated(new=False) == (None, [], False)
    assert planner.answer(planner.first(), 0, None, True)[1] == {}
    assert "a" not in planner.health(planner.first())


def test_planners_solve_their_requests():
    """The unregistered mass; the two-state problem by both methods, and a frozen alpha that misses its end."""
    series = MvimPlanner(problem="two_state", order=4, order_max=6, eps=1e-9)
    request = series.request(series.first(), 0, state=(-0.4, 0.1))[1]
    solution, own = (
        MvimPlanner.solve(request, None),
        mvim.solve(find("two_state").changed(x0=(-0.4, 0.1)), 4, 6, eps=1e-9),
    )
    table = np.reshape(solution.values, (1, 5, 7))
    assert table.tolist() == own.coefficients.tolist()
    assert solution[1:5] == (6, own.J[-1], own.residual[-1], own.end_error)
    assert (solution.accurate, solution.converged) == (True, False)
    assert solution.details["J per order"] == " ".join(f"{J:.10g}" for J in own.J)
    assert solution.details["alpha"] == " ".join(f"{a:.10g}" for a in own.alpha)
    assert (solution.details["end error"], solution.details["order"]) == (f"{own.end_error:.3g}", "6")
    assert MvimPlanner.shape(series.p) == (1, 7)
    # The planner reports how many stages suffice.
    assert (solution.accurate, own.residual[-1] >= 1e-4) == (True, True)
    stages = mvim.enough_stages(find("two_state").changed(x0=(-0.4, 0.1)), 6, 1e-4)
    assert solution.reason == f"{own.reason}; stages: {stages} do; {mvim.several(own)}"
    edge = MvimPlanner(problem="two_state", order=4, order_max=6, eps=1e-9, eps_res=own.residual[-1])
    assert "; stages: " in MvimPlanner.solve(edge.request(edge.first(), 0, state=(-0.4, 0.1))[1], None).reason
    met = series.request(series.first(), 0, state=(0.0, 0.0))[1]
    assert "stages" not in MvimPlanner.solve(met, None).reason
    coarse = CollocationPlanner(problem="two_state", intervals=4, samples=5)
    request = coarse.request(coarse.first(), 0, state=(-0.8, 0.0))[1]
    solution = CollocationPlanner.solve(request, None)
    again = collocation.solve(find("two_state"), intervals=4, samples=5)
    assert (np.reshape(solution.values, (5, 5)).tolist(), solution.order) == (again.rows.tolist(), 3)
    assert again.end_error == 0.0  # a free end state has no end error
    assert solution[2:8] == (again.J, again.residual, again.end_error, True, again.residual < 1e-4, again.reason)
    assert solution.details["alpha"] == f"{again.alpha[0]} {again.alpha[1]}"
    assert (solution.details["J"], solution.details["iterations"]) == (f"{again.J:.12g}", str(again.iterations))
    assert (solution.memory[0].tolist(), solution.memory[1]) == (again.rows.tolist(), 1.0)
    assert CollocationPlanner.shape(coarse.p) == (1, 5)
    x = coarse.first()._replace(last=solution)  # the last plan is already optimal, a straight line is not
    warm = CollocationPlanner.solve(coarse.request(x, 0, state=(-0.8, 0.0))[1], None)
    cold = CollocationPlanner(problem="two_state", intervals=4, samples=5, warm_start=False)
    cold = CollocationPlanner.solve(cold.request(x, 0, state=(-0.8, 0.0))[1], None)
    assert int(warm.details["iterations"]) < int(cold.details["iterations"]) == again.iterations


def power_plan(rng, stages=1, order=2):
    return rng.normal(size=(stages, 9, order + 1))


def about(**more):
    named = {"start": 0.0, "horizon": 3.0, "order": 2.0, "J_series": 0.1, "residual": 1e-9, "end_error": 0.0,
             "converged": 1.0, "trusted": 1.0}  # fmt: skip
    return tuple({**named, **more}[name] for name in SUMMARY)


@pytest.mark.parametrize("form", ["power", "time"])
@pytest.mark.parametrize("sampling", ["middle", "start"])
def test_the_player_reads_the_newest_plan(form, sampling):
    rng = np.random.default_rng(4)
    block = OcpPlayer(form=form, order=2, stages=2 if form == "power" else 1, samples=7, sampling=sampling, period=0.5)
    shift = 0.25 if sampling == "middle" else 0.0
    assert block.p.columns == (3 if form == "power" else 7)
    player = ByHand(block)
    table = power_plan(rng, 2) if form == "power" else rng.normal(size=(9, 7)).cumsum(axis=1)
    first = table[0, :3, 0] if form == "power" else table[:3, 0]
    began = None
    for k in range(9):
        t = 1.0 + 0.5 * k
        new = k == 1
        player.block.ages = lambda name, new=new: 0 if new else None
        inputs = {"plan": tuple(table.ravel()), "summary": about(start=1.5)}
        outputs = player.update(to_ns(t), state=(*first, 0.0, 0.0, 0.0), **inputs)
        began = 1.5 if new or began else None
        left = max(4.5 - t, 0.0) if began else 0.0
        assert outputs["progress"] == near((t - 1.5 if began else 0.0, left))
        s = min((t - 1.5 + shift) / 3.0, 1.0)
        if left == 0.0:
            expected = [0.0] * 3
        elif form == "power":
            expected = polynomials(table[:, 6:], s)
        else:
            from scipy.interpolate import CubicSpline

            expected = CubicSpline(np.linspace(0.0, 1.0, 7), table[6:], axis=1)(s)
        assert outputs["command"] == near(tuple(expected))
    assert player.reports == {}


@pytest.mark.parametrize(
    ("t", "summary", "off", "options", "message"),
    [
        (0.0, {}, 0.0, {}, ""),
        (0.0, {"horizon": 0.0}, 0.0, {}, "the plan is over: it began at 0 s and lasts 0 s"),
        (1.0, {"horizon": math.inf}, 0.0, {}, "the plan is over: it began at 0 s and lasts inf s"),
        (3.0, {}, 0.0, {}, "the plan is over: it began at 0 s and lasts 3 s"),
        (2.999, {}, 0.0, {}, ""),
        (0.0, {}, 1.9e-6, {}, ""),  # within a millionth of a state of 2
        (0.0, {}, 2.1e-6, {}, "the plan is another problem's: it begins at"),
        (0.5, {}, 0.3, {}, ""),  # later than its start, a plan does not restrict the state
        (0.0, {"trusted": 0.0, "residual": 0.25}, 0.0, {}, "the plan has not converged: residual 0.25"),
        (0.0, {"trusted": 0.5}, 0.0, {}, ""),
        (0.0, {"trusted": 0.0}, 0.0, {"allow_unconverged": True}, ""),
    ],
)
def test_the_player_reports_why_it_refuses_a_plan(t, summary, off, options, message):
    player = ByHand(OcpPlayer(order=2, **options))
    player.block.ages = lambda name: 0
    table = power_plan(np.random.default_rng(4))
    table[0, :3, 0] = 2.0, -1.0, 0.5
    x = (2.0, -1.0 + off, 0.5)
    outputs = player.update(to_ns(t), state=(*x, 0.0, 0.0, 0.0), plan=tuple(table.ravel()), summary=about(**summary))
    assert (outputs["command"] == (0.0, 0.0, 0.0)) is bool(message)
    assert [text[: len(message)] for _, text, *_ in player.reports.values()] == ([message] if message else [])


def test_the_player_of_a_small_state_has_a_resolution_of_a_billionth():
    for off, refused in ((0.9e-9, False), (1.1e-9, True)):
        player = ByHand(OcpPlayer(order=2))
        player.block.ages = lambda name: 0
        table = power_plan(np.random.default_rng(4))
        table[0, :3, 0] = 0.0
        player.update(0, state=(off, 0.0, 0.0, 0.0, 0.0, 0.0), plan=tuple(table.ravel()), summary=about())
        assert bool(player.reports) is refused


def test_the_feedback_of_the_momentum_equals_its_formula():
    law = ByHand(MomentumFeedback(horizon=10.0, period=1.0, inertia=(2.0, 3.0, 4.0)))
    for t, left in ((5.0, 10.0), (9.0, 6.0), (14.0, 1.0), (14.5, 1.0), (15.0 - 2e-9, 1.0)):
        outputs = law.update(to_ns(t), state=(0.1, -0.2, 0.3, 9.0, 9.0, 9.0))["command"]
        assert outputs == near((-0.2 / left, 0.6 / left, -1.2 / left))
    assert law.update(to_ns(15.0), state=(0.1, -0.2, 0.3, 9.0, 9.0, 9.0))["command"] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("form", ["power", "time"])
def test_the_evaluator_is_a_loop_over_its_inputs(form):
    """A spacecraft with given states: cost by the commands alone, distance from the newest plan, end errors."""
    rng = np.random.default_rng(5)
    made = {"horizon": 3.0, "x_end": (0.1, 0.0, -0.2), "period": 0.5, "form": form, "order": 2, "samples": 7}
    evaluator = ByHand(OcpEvaluator(**made))
    tables = [power_plan(rng) if form == "power" else rng.normal(size=(9, 7)) for _ in range(2)]
    paid, far, newest, start, residual, begin = 0.0, 0.0, None, 0.0, 0.0, None
    for k in range(9):
        t, w, u = 2.0 + 0.5 * k, 0.01 * rng.normal(size=3), rng.normal(size=3)
        comes = {1: 0, 4: 1}.get(k)
        inputs = {"plan": None, "summary": None}
        if comes is not None:
            newest, start, residual = tables[comes], t - 0.25, (1e-5, 1e-6)[comes]
            inputs = {"plan": tuple(newest.ravel()), "summary": about(start=start, horizon=2.0, residual=residual)}
        outputs = evaluator.update(to_ns(t), state=(*w, 0.0, 0.0, 0.0), command=tuple(u), **inputs)["evaluation"]
        results = dict(zip(FIGURES, outputs, strict=True))
        begin = w if k == 0 else begin
        left = 3.0 - 0.5 * k
        if newest is not None and t <= start + 2.0 + 1e-9:
            s = min(max((t - start) / 2.0, 0.0), 1.0)
            if form == "power":
                planned = polynomials(newest[:, :3], s)
            else:
                from scipy.interpolate import CubicSpline

                planned = CubicSpline(np.linspace(0.0, 1.0, 7), newest[:3], axis=1)(s)
            far = max(far, float(np.abs(w - planned).max()))
        if left >= 0.0:
            missed = w - (0.1, 0.0, -0.2)
        paid += 0.5 * float(u @ u) * min(max(left, 0.0), 0.5)
        assert results["J_plant"] == near(paid)
        assert results["distance"] == near(far)
        assert (results["end_error"], results["end_error_max"]) == near((np.linalg.norm(missed), np.abs(missed).max()))
        assert results["J_exact"] == near(float(np.sum((np.array(INERTIA) * begin) ** 2)) / 6.0)
        assert (results["residual"], results["J_series"]) == (residual, 0.1 if k else 0.0)


@pytest.mark.parametrize(
    ("summary", "flag"),
    [
        ({}, 0.0),
        ({"residual": 1e-4}, 1.0),
        ({"residual": 0.99e-4}, 0.0),
        ({"J_series": 1.0 - 0.9e-6}, 0.0),
        ({"J_series": 1.0 - 1.1e-6}, 1.0),
        # If the start was late, the cost of the remaining horizon is not judged.
        ({"J_series": 0.5, "horizon": 2.9}, 0.0),
    ],
)
def test_the_evaluator_flags_impossible_optima(summary, flag):
    """The least cost is 1: |I w|^2 = 6 over 3 s."""
    w = math.sqrt(6.0) / INERTIA[0]
    evaluator = ByHand(OcpEvaluator(horizon=3.0, x0=(w, 0.0, 0.0), order=2))
    reported = about(**{"J_series": 1.0, **summary})
    table = tuple(power_plan(np.random.default_rng(1)).ravel())
    inputs = {"state": (w, 0.0, 0.0, 0.0, 0.0, 0.0), "command": (0.0,) * 3, "plan": table}
    assert evaluator.update(0, summary=reported, **inputs)["evaluation"][-1] == flag
    assert ("infeasible" in evaluator.reports) is bool(flag)
    evaluator.update(1, summary=about(residual=0.5), **inputs)  # the second plan is shown, not judged
    assert (evaluator.status()["infeasible"][0], evaluator.status()["residual"][0]) == (flag, 0.5)
    evaluator.block.ages = {"plan": 0, "summary": 1}.get  # plan and summary have different times
    evaluator.update(2, summary=about(residual=0.7), **inputs)
    assert evaluator.status()["residual"][0] == 0.5


def test_plants_limit_and_bias_their_commands():
    plant = ByHand(SpacecraftPlant(torque_limit=0.5, bias=(0.1, 0.0, 0.0), x0=(0.0, 0.0, 0.0), period=2.0))
    plant.advance(0, command=(0.5, -0.5, 0.0))
    assert plant.reports == {}
    w = [2.0 * 0.6 / INERTIA[0], -2.0 * 0.5 / INERTIA[1], 0.0]
    assert plant.outputs(0)["state"] == pytest.approx((*w, 0.5, -0.5, 0.0), abs=1e-5)
    plant.advance(1, command=(0.0, 0.0, -0.51))
    assert plant.outputs(0)["state"][3:] == (0.0, 0.0, -0.5)
    assert plant.reports["limited"][:2] == (Level.WARN, "command beyond 0.5: limited")
    free = ByHand(OcpPlant(problem="two_state"))
    free.advance(0, command=(1e6,))
    assert free.reports == {}
    assert len(free.outputs(0)["state"]) == 2
