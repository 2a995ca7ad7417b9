"""Criteria, searches, bounds and plants with delay, against independent code.

Sources: quadrature and roots by scipy, loops. The inequalities are held by what they are made from: along a
polynomial that meets the equation now, the derivative of the functional is worked out by integrals and differences,
with random matrices in the place of a certificate's.
"""

import math
from random import Random
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import near
from numpy.polynomial import legendre
from scipy.integrate import quad
from scipy.optimize import brentq
from softrig_core import ByHand, Level, ParameterError
from softrig_core.block.params import build
from softrig_core.kit.dde import trajectory
from softrig_systems.pwa_delay.certificate import Answer, CertificateNode, CriterionParams
from softrig_systems.pwa_delay.controllers import DelayLine, PendulumController, TankController
from softrig_systems.pwa_delay.figures import fall, largest_rise, level_covered
from softrig_systems.pwa_delay.lyapunov import LyapunovMonitor, functional
from softrig_systems.pwa_delay.margin_search import MarginSearch
from softrig_systems.pwa_delay.motion import FREE, PendulumConstants, pendulum_cell
from softrig_systems.pwa_delay.params import SystemParams
from softrig_systems.pwa_delay.plants import SwitchedDelayPlant, TankPlant
from softrig_systems.pwa_delay.profiles import delay_at, profile
from softrig_systems.pwa_delay.proof import certify as certifying
from softrig_systems.pwa_delay.proof.applicability import NotApplicable, require_equilibrium, require_no_sliding
from softrig_systems.pwa_delay.proof.bessel_legendre import bessel_legendre
from softrig_systems.pwa_delay.proof.certify import Certificate, Criterion, _bisect, _walk, certified_margin, certify
from softrig_systems.pwa_delay.proof.level import level_bound, level_margin
from softrig_systems.pwa_delay.proof.lmi import Eigenvalues, Problem, Term, quadratic
from softrig_systems.pwa_delay.proof.theorem1 import theorem1
from softrig_systems.pwa_delay.search import Margin, Run, find_margin, growth_rate
from softrig_systems.pwa_delay.system import BadSystem, PwaSystem, from_lines, linear

MS = 1_000_000


# the inequalities ------------------------------------------------------------------------------------------------


def two_cells(rng):
    """Two states, a switching line on each instant: four cells with different matrices."""
    A, Ad = ([rng.normal(size=(2, 2)) for _ in range(4)] for _ in range(2))
    return from_lines(A, Ad, [[1.0, 0.3]], [[-0.2, 1.0]])


def unknowns(problem, rng):
    """Random matrices in place of a certificate's."""
    results = {name: rng.normal(size=u.shape) for name, u in problem.unknowns.items()}
    return {name: m + m.T if problem.unknowns[name].symmetric else m for name, m in results.items()}


def satisfied(problem, name, matrices, y):
    """Return y' M y of an inequality."""
    inequality = next(i for i in problem.inequalities if i.name == name)
    return sum(2.0 * (y @ left) @ matrices[x] @ (right.T @ y) for x, left, right in inequality.terms)


def curve(rng, degree, A, Ad, d):
    """Coefficients of random polynomials, a column a state, whose slope at 0 is A x(0) + Ad x(-d)."""
    c = rng.normal(size=(degree + 1, 2))
    c[1] = 0.0
    c[1] = np.linalg.solve(np.eye(2) + d * Ad, A @ c[0] + Ad @ at(c, -d))
    return c


def at(c, t):
    return t ** np.arange(len(c)) @ c


def slope(c):
    return c[1:] * np.arange(1, len(c))[:, None] if len(c) > 1 else 0.0 * c


NODES, WEIGHTS = legendre.leggauss(10)


def over(function, a, b):
    """Integral of a function of time, exactly for polynomials."""
    return (
        0.5
        * (b - a)
        * sum(w * function(0.5 * (b - a) * s + 0.5 * (a + b)) for s, w in zip(NODES, WEIGHTS, strict=True))
    )


def shifted(k, s):
    """Legendre polynomial P_k of 2 s - 1."""
    return legendre.legval(2.0 * s - 1.0, [0.0] * k + [1.0])


def form(v, M):
    return v @ M @ v


def both(c, v, t):
    return np.concatenate([at(c, t), at(v, t)])


@pytest.mark.parametrize(
    ("order", "shortest", "d"), [(1, 1.0, 1.0), (3, 0.4, 0.4), (3, 0.4, 1.0), (2, 0.0, 0.0), (2, 0.0, 1.0)]
)
def test_the_criterion_of_constant_delays_is_the_derivative_of_its_functional(order, shortest, d):
    """In time scaled so that the delay is 1 (with a zero lower delay: in that of the system), V' by differences
    of V.
    """
    rng = np.random.default_rng(order)
    system = two_cells(rng)
    problem = bessel_legendre(system, order, shortest=shortest, cell_terms=True)
    matrices = unknowns(problem, rng)
    L, Q, R = (matrices[k] for k in "LQR")
    scaled = shortest > 0.0  # with scaled time the delay is 1, and slopes grow by d
    window, weight = (1.0, 1.0) if scaled else (d, d)

    def falls(i):
        share = d if scaled else 1.0
        c = curve(rng, order, share * system.A[i], share * system.Ad[i], window)
        v = slope(c)

        def omega(k, t):
            return over(lambda s: shifted(k, s) * at(c, t - window + window * s), 0.0, 1.0)

        def V(t):
            now = np.concatenate([at(c, t), at(c, t - window)])
            eta = np.concatenate([system.F[i] @ now, *(weight * omega(k, t) for k in range(order))])
            result = form(eta, L) + over(lambda s: form(both(c, v, s), Q), t - window, t)
            return result + over(lambda s: (s - t + window) * form(at(v, s), weight * R), t - window, t)

        now = np.concatenate([at(c, 0.0), at(c, -window)])
        y = np.concatenate([now, at(v, -window), *(omega(k, 0.0) for k in range(order))])
        return y, (V(1e-5) - V(-1e-5)) / 2e-5 + form(system.E[i] @ now, matrices[f"U{i}"])

    def least(i):
        """V of a curve for which Bessel's inequality is exact, without the terms of R; with a zero lower delay also
        without Q.
        """
        c = rng.normal(size=(order, 2))
        now = np.concatenate([at(c, 0.0), at(c, -1.0)])
        omega = [over(lambda s, k=k: shifted(k, s) * at(c, s - 1.0), 0.0, 1.0) for k in range(order)]
        result = form(np.concatenate([system.F[i] @ now, *omega]), L) - form(system.E[i] @ now, matrices[f"H{i}"])
        if scaled:
            result += over(lambda s: form(both(c, slope(c), s), Q), -1.0, 0.0)
        return np.concatenate([now, *omega]), result

    for i in range(4):
        y, rate = falls(i)
        name = f"V' < 0 cell {i}" + (f", d {d:.6g}" if shortest < 1.0 else "")
        assert satisfied(problem, name, matrices, y) == pytest.approx(-rate, rel=1e-6, abs=1e-5)
        y, value = least(i)
        assert satisfied(problem, f"V > 0 cell {i}", matrices, y) == near(value)
    y = rng.normal(size=4)
    assert (satisfied(problem, "Q", matrices, y), satisfied(problem, "R", matrices, y[:2])) == near(
        (form(y, Q), form(y[:2], R))
    )
    assert len(problem.inequalities) == 2 + 4 * (2 if shortest == 1.0 else 3)
    assert [i.name for i in problem.traced] == ["Q", "R", *(f"V > 0 cell {i}" for i in range(4))]


@pytest.mark.parametrize(("d", "rate"), [(0.0, 0.3), (1.0, -0.3)])
def test_theorem_1_is_the_derivative_of_its_functional_and_its_integral_inequality(d, rate):
    """V' by differences of V, and the integrals over both windows of (xi, f xi, x') whose matrices are those of (8)."""
    rng = np.random.default_rng(7)
    system = two_cells(rng)
    problem = theorem1(system, 0.3, cell_terms=True)
    m = unknowns(problem, rng)

    def of_8(names):
        Z, ZZ, Y, N, NN = (m[k] for k in names)
        return np.block([[Z, Y, N], [Y.T, ZZ, NN], [N.T, NN.T, m["R"]]])

    windows = {1: of_8(("Z1", "Z2", "Y1", "N1", "N2")), 2: of_8(("Z3", "Z4", "Y2", "N3", "N4"))}

    def falls(i):
        c = curve(rng, 4, system.A[i], system.Ad[i], d)
        v = slope(c)

        def V(t):
            late = t - d - rate * t
            now = np.concatenate([at(c, t), at(c, late)])
            z2 = np.concatenate(
                [at(c, t - 1.0), over(lambda y: at(c, y), late, t), over(lambda y: at(c, y), t - 1.0, late)]
            )
            return (
                form(system.F[i] @ now, m["L1"])
                + form(z2, m["S"])
                + over(lambda y: form(np.concatenate([both(c, v, y), at(c, t) - at(c, y)]), m["Q"]), late, t)
                + over(lambda y: form(np.concatenate([both(c, v, y), at(c, late) - at(c, y)]), m["Z"]), t - 1.0, late)
                + over(lambda y: (y - t + 1.0) * form(at(v, y), m["R"]), t - 1.0, t)
            )

        def mean(a, b):
            return over(lambda y: at(c, y), a, b) / (b - a) if b > a else at(c, a)

        def window(k, a, b):
            """Integral of the form of (8), f falling from 1 to -1."""
            w = np.concatenate([at(c, b), at(c, a), mean(a, b)])
            f = (lambda y: 1.0 - 2.0 * (y - a) / (b - a)) if b > a else (lambda y: 0.0)
            return over(lambda y: form(np.concatenate([w, f(y) * w, at(v, y)]), windows[k]), a, b)

        now = np.concatenate([at(c, 0.0), at(c, -d)])
        y = np.concatenate([now, at(c, -1.0), at(v, -d), at(v, -1.0), mean(-d, 0.0), mean(-1.0, -d)])
        psi = (V(1e-5) - V(-1e-5)) / 2e-5 + window(1, -d, 0.0) + window(2, -1.0, -d)
        return y, psi + form(system.E[i] @ now, m[f"U{i} d {d:g} rate {rate:g}"])

    for i in (0, 2, 3):
        y, psi = falls(i)
        assert satisfied(problem, f"(10) cell {i}, d {d:g}, d' {rate:g}", m, y) == pytest.approx(
            -psi, rel=1e-6, abs=1e-5
        )
        now = y[:4]
        least = form(system.F[i] @ now, m["L1"]) - form(system.E[i] @ now, m[f"H{i}"])
        assert satisfied(problem, f"(9) cell {i}", m, now) == near(least)
    for name, M in (("(8) 1", windows[1]), ("(8) 2", windows[2]), *((k, m[k]) for k in "RSQZ")):
        y = rng.normal(size=len(M))
        assert satisfied(problem, name, m, y) == near(form(y, M))
    assert (len(problem.inequalities), len(problem.traced)) == (6 + 4 * 5, 6 + 4)
    assert len(theorem1(system, 0.0).inequalities) == 6 + 4 * 3  # a constant delay has two corners


def test_the_functional_on_samples_equals_its_integrals():
    """Of a smooth curve, by trapezoids of 1/200, for delays from zero to all of the record."""
    rng = np.random.default_rng(1)
    system = two_cells(rng)
    m = unknowns(theorem1(system, 0.0), rng)
    c = rng.normal(size=(4, 2))
    v, times = slope(c), np.linspace(-1.0, 0.0, 201)
    rows, slopes = (np.array([at(of, t) for t in times]) for of in (c, v))

    def V(d):
        now = np.concatenate([at(c, 0.0), at(c, -d)])
        z2 = np.concatenate([at(c, -1.0), over(lambda y: at(c, y), -d, 0.0), over(lambda y: at(c, y), -1.0, -d)])
        return (
            form(system.F[system.cell(now[:2], now[2:])] @ now, m["L1"])
            + form(z2, m["S"])
            + over(lambda y: form(np.concatenate([both(c, v, y), now[:2] - at(c, y)]), m["Q"]), -d, 0.0)
            + over(lambda y: form(np.concatenate([both(c, v, y), now[2:] - at(c, y)]), m["Z"]), -1.0, -d)
            + over(lambda y: (y + 1.0) * form(at(v, y), m["R"]), -1.0, 0.0)
        )

    for d in (0.0, 0.005, 0.25, 0.995, 1.0):
        assert functional(system, m, rows, slopes, d) == pytest.approx(V(d), rel=1e-3, abs=2e-3)


def test_a_linear_matrix_inequality_is_solved_and_checked():
    """All of a trace of 1000 in a multiple of I; entries that may not be negative; an unknown that is not square."""
    p = Problem()
    p.symmetric("X", 4)
    p.positive("X", [quadratic("X", np.eye(4))], traced=True)
    solution = p.solve()
    assert (solution.status, solution.t) == ("Solved", pytest.approx(250.0, rel=1e-5))
    assert solution.matrices["X"] == pytest.approx(250.0 * np.eye(4), abs=1e-2)
    p = Problem()  # 10 X >= t with a trace of 1000, and X - Y >= t; Y >= 0 does not help
    p.symmetric("X", 2)
    p.symmetric("Y", 2, positive=True)
    p.positive("10 X", [quadratic("X", np.eye(2), 10.0)], traced=True)
    p.positive("X - Y", [quadratic("X", np.eye(2)), quadratic("Y", np.eye(2), -1.0)])
    solution = p.solve()
    assert solution.t == pytest.approx(50.0, rel=1e-4)
    assert np.diag(solution.matrices["Y"]) == pytest.approx(np.zeros(2), abs=1e-2)
    assert np.min(solution.matrices["Y"]) >= 0.0
    rng = np.random.default_rng(4)
    p = Problem()
    p.symmetric("S", 3)
    p.matrix("M", 2, 3)
    left, right, more = rng.normal(size=(4, 2)), rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    p.positive("sum", [Term("M", left, right), quadratic("S", more, -3.0), Term("S", right, more)])
    for _ in range(3):
        m = {"S": rng.normal(size=(3, 3)), "M": rng.normal(size=(2, 3))}
        m["S"] = m["S"] + m["S"].T
        total = left @ m["M"] @ right.T - 1.5 * more @ m["S"] @ more.T + right @ m["S"] @ more.T
        total = total + total.T
        (solution,) = p.eigenvalues(m)
        assert (solution.smallest, solution.largest) == near(tuple(np.linalg.eigvalsh(total)[[0, -1]]))
        # Columns of the solver: the upper triangle, with off-diagonal entries times the square root of 2.
        parts = p._coefficients(p.inequalities[0])
        entries = {"S": [m["S"][a, b] for b in range(3) for a in range(b + 1)], "M": m["M"].ravel()}
        triangle = sum(parts[k] @ np.array(entries[k]) for k in m)
        assert triangle == near(
            [total[a, b] * (1.0 if a == b else math.sqrt(2.0)) for b in range(4) for a in range(b + 1)]
        )
    assert p._split(np.concatenate([entries["S"], entries["M"]]))["S"] == near(m["S"])
    assert [Eigenvalues("x", least, 1.0).positive for least in (2e-9, 1e-9, 0.0, -1.0)] == [True, False, False, False]


# searches --------------------------------------------------------------------------------------------------------


def made(h, valid, shortest=0.0):
    return Certificate(h, valid, 0.0, {}, [], "Solved", 0.0, shortest)


def test_the_largest_delay_is_found_by_doubling_and_bisection():
    asked = []

    def ask(h, shortest=None):
        asked.append(h)
        return made(h, h <= 1.3)

    result = _bisect(ask, made(0.25, True), 0.25, 1e-3, 1e9)
    assert asked[:6] == [0.5, 1.0, 2.0, 1.5, 1.25, 1.375]
    assert 1.3 * (1.0 - 1e-3) <= result.h <= 1.3
    assert len(asked) == 3 + 10  # ten halvings reduce the gap of 1 to 1/1024
    endless = _bisect(lambda h, shortest=None: made(h, True), made(1.0, True), 1.0, 1e-3, 100.0)
    assert endless.h == 64.0  # the next value, 128, exceeds the limit of 100
    # One halving is enough.
    assert _bisect(lambda h, shortest=None: made(h, h < 1.5), made(1.0, True), 1.0, 0.5, 9.0).h == 1.0


def test_the_search_over_constant_delays_leaves_no_gap():
    """Each step is certified from the end of the previous one, up to half of the rest, as documented."""
    steps = []

    def ask(h, shortest):
        valid = h <= 2.0 and h - shortest <= 0.5 * (2.0 - shortest)
        steps.append((shortest, h, valid))
        return made(h, valid, shortest)

    result = _walk(ask, made(0.125, True, 0.1), 0.125, 1e-2, 1e9)
    assert [s[:2] for s in steps[:4]] == [(0.125, 0.25), (0.25, 0.5), (0.5, 1.0), (1.0, 2.0)]
    assert [s[1:] for s in steps[4:8]] == [(1.5, True), (2.0, False), (1.75, True), (2.0, False)]
    reached = 0.125
    for begin, end, valid in steps:
        assert begin == reached
        reached = end if valid else reached
    assert (result.h, result.shortest) == (reached, 0.1)
    assert 2.0 - reached <= 1e-3 * 2.0 * 2.0
    assert _walk(lambda h, s: made(h, True, s), made(1.0, True), 1.0, 1e-2, 50.0).h == 64.0


def test_a_margin_is_searched_from_the_certified_delay(monkeypatch):
    """The criterion is replaced by one that holds up to 0.3 s; where it is evaluated first, and what is reported."""
    sliding, asked = [], []
    monkeypatch.setattr(certifying, "require_no_sliding", lambda system, h: sliding.append(h))

    def replaced(limit, least=0.0):
        def certified(system, h, criterion, *, shortest, sliding):
            asked.append(h)
            assert sliding is False
            alone = shortest is None
            return made(h, least <= h <= limit and (alone or shortest >= least), shortest or 0.0)

        monkeypatch.setattr(certifying, "certify", certified)

    system = linear(-1.0, -1.0)  # its shortest time constant is 1/2 s
    for options, first in (({}, 0.5), ({"high": 0.2}, 0.2), ({"low": 0.1, "high": 0.2}, 0.1)):
        replaced(0.3)
        asked.clear(), sliding.clear()
        messages = []
        certificate = certified_margin(system, width=1e-3, tell=messages.append, **options)
        assert asked[0] == first
        assert 0.3 * (1.0 - 1e-3) <= certificate.h <= 0.3
        assert [c.h for c in messages] == asked
        assert sliding == [options.get("high", 1e-9), certificate.h]
    # Stable for every delay: one search doubles up to a billion time constants, the other steps beyond that.
    replaced(math.inf)
    assert certified_margin(system).h == 2.0**28
    assert certified_margin(system, Criterion("constant")).h == 2.0**29
    replaced(-1.0)
    assert certified_margin(system) is None
    assert asked[-1] == pytest.approx(0.5 * 2.0**-19)  # half of it would be below a millionth of 1/2 s
    assert certified_margin(system, Criterion("constant"), low=0.2) is None
    assert certified_margin(system, low=1.05e-6 * 0.5 * 1024) is None
    assert asked[-1] == pytest.approx(1.05e-6 * 0.5)
    replaced(0.3, least=0.1)  # delays below 0.1 s are not certified, so no search from zero succeeds
    assert certified_margin(system, low=0.2) is None
    assert certified_margin(system, Criterion("constant")) is None


@pytest.mark.parametrize(
    ("h", "options", "text"),
    [
        (0.0, {}, "h = 0.0: expected a positive time"),
        (math.inf, {}, "h = inf: expected a positive time"),
        (1.0, {"criterion": Criterion(mu=-0.1)}, "mu = -0.1: expected at least 0"),
        (1.0, {"criterion": Criterion(mu=math.inf)}, "mu = inf: expected at least 0"),
        (1.0, {"criterion": Criterion("constant"), "shortest": 1.1}, "shortest = 1.1: expected from 0 to h = 1.0"),
        (1.0, {"criterion": Criterion("constant"), "shortest": -0.1}, "shortest = -0.1: expected from 0 to h = 1.0"),
    ],
)
def test_delays_that_cannot_be_certified_are_refused(h, options, text):
    with pytest.raises(ValueError, match=text):
        certify(linear(-1.0, 0.5), h, **options)


def test_the_coverage_of_a_certificate():
    system = linear(-1.0, 0.5)
    assert certify(system, 1.0, shortest=0.5)[7] == 0.0  # Theorem 1 covers all delays from zero on
    constant = Criterion("constant", order=1)
    assert [certify(system, 1.0, constant, shortest=s).shortest for s in (None, 0.0, 0.5, 1.0)] == [1.0, 0.0, 0.5, 1.0]
    assert certify(system, 1.0, constant).valid


def illinois(f, low, high):
    """Regula falsi with the correction of Dowell and Jarratt (1971): an end that stays twice counts half. Returns its
    points.
    """
    at_low, at_high, last = f(low), f(high), None
    while True:
        x = (low * at_high - high * at_low) / (at_high - at_low)
        yield x, low, high
        if f(x) < 0.0:
            low, at_low = x, f(x)
            at_high /= 2.0 if last == "low" else 1.0
            last = "low"
        else:
            high, at_high = x, f(x)
            at_low /= 2.0 if last == "high" else 1.0
            last = "high"


@pytest.mark.parametrize(
    ("growth", "first"),
    [
        (lambda h: math.sinh(9.0 * (h - 0.71)), 0.71),
        (lambda h: math.exp(30.0 * (h - 0.31)) - 1.0, 0.31),
        (lambda h: 1.0 - math.exp(-30.0 * (h - 0.77)), 0.77),
    ],
)
def test_a_margin_by_growth_is_at_the_first_change_of_sign(growth, first):
    result = find_margin(growth, 0.0, 1.0, width=1e-6)
    asked, n = list(result.growth), math.ceil(first * 8) + 1
    assert result.growth == {h: growth(h) for h in asked}
    assert asked[:n] == [k / 8 for k in range(n)]
    own = illinois(growth, *asked[n - 2 : n])
    before = asked[n - 2]
    for k, h in enumerate(asked[n:]):
        x, low, high = next(own)
        assert h == near(x)
        assert high - low > 1e-6
        assert (abs(x - before) < 0.2e-6) is (n + k == len(asked) - 1) or result.high - result.low <= 1e-6
        before = x
    assert (result.h, result.low <= result.h <= result.high) == (asked[-1], True)
    assert growth(result.low) < 0.0 <= growth(result.high)
    assert result.h == pytest.approx(first, abs=1e-6)


def test_the_first_of_two_margins_by_growth_is_found():
    twice = find_margin(lambda h: math.sin(9.0 * h - 3.0), 0.0, 1.0)
    assert twice.h == pytest.approx(1.0 / 3.0, abs=1e-5)
    with pytest.raises(ValueError, match=r"^growth 0 1/s at 0 s and 0 1/s at 0 s: no margin between$"):
        find_margin(lambda h: h, 0.0, 1.0)
    with pytest.raises(ValueError, match=r"^growth -1 1/s at 0 s and 0 1/s at 1 s: no margin between$"):
        find_margin(lambda h: h - 1.0, 0.0, 1.0)


def test_the_growth_of_a_run_is_the_slope_of_its_maxima():
    t = np.arange(1, 4001) * 0.01
    for rate in (-0.2, 0.3):
        # Only the second half of the run counts.
        sizes = np.exp(rate * t) * np.abs(np.cos(3.0 * t)) * np.where(t < 15.0, 9.0, 1.0)
        assert growth_rate(Run(t, sizes, np.zeros(1), 0)) == pytest.approx(rate, abs=1e-3)
    flat = np.array([0, 0, 0, 0, 1, 1, 0, 2, 2, 1, 0, 4, 0, 0.0])  # the last sample of a flat peak counts
    run = Run(np.arange(14.0), np.concatenate([np.zeros(14), flat])[14:], np.zeros(1), 0)
    with pytest.raises(ValueError, match=r"^2 maxima in 6 s: the run is too short for a growth rate$"):
        growth_rate(run)
    run = Run(np.arange(28.0), np.concatenate([np.zeros(14), flat]), np.zeros(1), 0)
    assert growth_rate(run) == near(np.polyfit([19.0, 22.0, 25.0], np.log([1.0, 2.0, 4.0]), 1)[0])


# the level of the tank -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [None, 0.05, 0.9])
def test_the_bound_of_the_level_is_its_integral(start):
    """The level falls by the drain and by the withdrawal, from a level that rises with the steepest slope to X."""
    s, kL, kR, c = 0.6, 0.3, 0.15, 0.01

    def lowest(h):
        X = max(s + (kL * s - c * math.sqrt(s)) * h, start or 0.0)
        r = kR * X + c * math.sqrt(X)
        used = quad(lambda t: kR * min(s + r * t, X), 0.0, h, points=[min(h, (X - s) / r)])[0]
        m = s - used - c * math.sqrt(s) * h
        return (m if start is None else min(m, start)), X

    enough = c / kL * math.sqrt(s)
    for h in (0.1, 1.0, 2.0, 4.0):
        result = level_bound(h, s=s, kL=kL, kR=kR, c=c, start=start)
        assert result[:2] == pytest.approx(lowest(h), rel=1e-9)
        assert result.certified is (lowest(h)[0] >= enough)
    margin = brentq(lambda h: lowest(h)[0] - enough, 1e-3, 20.0)
    assert level_margin(s=s, kL=kL, kR=kR, c=c, start=start) == pytest.approx(margin, rel=1e-7)


def test_no_level_is_bounded_if_the_drain_is_as_large_as_the_inflow():
    # The drain c * 0.5 is equal to the inflow 0.2 * 0.25, or smaller.
    for c, bounded in ((0.1, False), (0.0999, True)):
        result = level_bound(0.0, s=0.25, kL=0.2, c=c)
        assert result[:2] == ((0.25, 0.25) if bounded else (0.0, 0.25))
        assert result.certified is bounded
    assert level_bound(1.0, s=0.25, kL=0.2, c=0.1, start=0.7) == (0.0, 0.7, False)
    assert level_margin(s=0.25, kL=0.2, c=0.1) < 1e-8


# delays, systems, plants -----------------------------------------------------------------------------------------


def test_delays_over_time():
    sine, jumps = profile("sine", 0.4, 0.7), profile("telegraph", 0.25, seed=[3, 4], horizon=100.0)
    times = np.cumsum(np.random.default_rng([3, 4]).exponential(1.0, 150 + 20))
    assert jumps.changes == near(times)
    for t in np.linspace(0.0, 60.0, 97):
        assert delay_at(sine, t) == near(0.2 * (1.0 + math.sin(2.0 * 0.7 * t / 0.4)))
        assert delay_at(jumps, t) == (0.25 if sum(c <= t for c in times) % 2 == 0 else 0.0)
    assert delay_at(jumps, times[0]) == 0.0  # a jump at time t counts at t
    assert profile("telegraph", 0.0, horizon=5.0).changes.tolist() == [0.0]
    assert profile("sine", 0.0, 0.0)[:3] == (1.0, 0.0, 0.0)
    with pytest.raises(ValueError, match=r"^delay h = 1.0 s, mu = inf: expected finite values, not negative$"):
        profile("sine", 1.0, math.inf)


@pytest.mark.parametrize("kind", ["constant", "sine", "telegraph"])
def test_a_delay_line_reads_its_record_at_the_age_of_its_delay(kind):
    line = ByHand(DelayLine(delay=0.05, profile=kind, mu=0.4, period=0.01, channels=("a", "b"), fields=("velocity",)))
    line.reset(3)
    draw, record = Random(4), []
    for k in range(60):
        if draw.random() < 0.2:
            answer = line.refused(k * 10 * MS)
            if not record:
                assert answer is None
                continue
            record.append(record[-1])
        else:
            record.append((draw.random(), draw.random()))
            answer = line.update(k * 10 * MS, state=record[-1])
        back = delay_at(line.x.delay.profile, k * 0.01)
        ages = (len(record) - 1 - np.arange(len(record))) * 0.01
        expected = [np.interp(-back, -ages, [row[c] for row in record]) for c in (0, 1)]
        assert answer["delayed"] == near(tuple(expected))
    (port_in,), (gives,) = DelayLine.ports(line.block.p)
    assert port_in.units == gives.units == ("rad/s", "rad/s")


def test_gains_change_at_their_edges():
    tank, swing = ByHand(TankController(A=2.0, phi=10.0)), ByHand(PendulumController(k_negative=2.0, k_positive=3.0))
    assert [tank.update(0, level=(x,))["inflow"][0] for x in (0.499, 0.5)] == near([20 * 0.499 * 0.2, -20 * 0.5 * 0.1])
    assert [swing.update(0, state=(x, 0.5))["torque"][0] for x in (0.0, 1e-12)] == near([-1.0, -1.5])
    assert [TankPlant(x0=x).begin() for x in (0.499, 0.5)] == [near((0.499, 0.0998)), near((0.5, -0.05))]
    dry = ByHand(TankPlant(x0=0.0, delay=0.0, k_low=0.0))
    dry.advance(0, inflow=(0.0,))
    assert dry.reports["dry"][:2] == (Level.ERROR, "the tank is DRY: its level stays at 0")
    for delay, reported in ((0.05, []), (0.0501, ["delay"])):
        assert list(ByHand(SwitchedDelayPlant(delay=delay, max_delay=0.05)).reports) == reported


def test_cells_are_the_signs_of_their_lines():
    """Each combination once, the first line slowest, negative first; hinges if they are active."""
    A = [[[float(k), 0.0], [0.0, 0.0]] for k in range(4)]
    system = from_lines(A, A, [[1.0, 0.5]], [[1.0, 1.0]], a=[[k, -k] for k in range(4)])
    rng = np.random.default_rng(2)
    for _ in range(40):
        x, x_d = rng.normal(size=2), rng.normal(size=2)
        signs = (x[0] + 0.5 * x[1], x_d[0] + x_d[1])
        cell = 2 * (signs[0] > 0.0) + (signs[1] > 0.0)
        assert system.cell(x, x_d) == cell
        assert system.A[cell][0, 0] == cell
        assert system.a[cell].tolist() == [cell, -cell]
        z = np.concatenate([x, x_d])
        assert system.F[cell] @ z == near([*(max(s, 0.0) for s in signs), *z])
    faces = system.faces()
    assert faces == [(i, row, i ^ (2 - row)) for i in range(4) for row in range(2)]
    twice = system.scaled(2.0)
    assert (twice.A[3][0, 0], twice.Ad[3][0, 0], twice.a[3].tolist()) == (6.0, 6.0, [6.0, -6.0])
    assert system.A[3][0, 0] == 3.0


def test_a_plant_moves_by_the_cell_of_its_state_and_of_its_past():
    """A line on x, one on x_d, four cells with different matrices and offsets; the past is the start."""
    rng = np.random.default_rng(6)
    A, Ad, a = rng.normal(size=(4, 2, 2)), rng.normal(size=(4, 2, 2)), rng.normal(size=(4, 2))
    lines, late = [[1.0, 0.4]], [[0.7, -1.0]]
    system = from_lines(A, Ad, lines, late, a)
    numbers = {"A": A, "Ad": Ad, "lines": lines, "lines_delayed": late, "offsets": a}
    made = {"system": "user", "n": 2, "period": 1e-6, "step": 1e-6, "delay": 0.1}
    made |= {name: tuple(np.ravel(m).tolist()) for name, m in numbers.items()}
    cells = set()
    for start in rng.normal(size=(6, 2)):
        plant = SwitchedDelayPlant(x0=tuple(start), **made)
        first = plant.first()
        for now in rng.normal(size=(6, 2)):
            x = first._replace(x1=now[0], x2=now[1])
            cell = system.cell(now, start)
            assert plant.outputs(x, 0)["mode"] == (float(cell), 0.1)
            after = plant.advance(x, 0)
            expected = A[cell] @ now + Ad[cell] @ start + a[cell]
            assert (np.array(after[:2]) - now) / 1e-6 == pytest.approx(expected, abs=1e-4)
            cells.add(cell)
    assert len(cells) == 4


def test_invalid_systems_are_refused():
    one, none = (np.array([[-1.0]]),), np.zeros((0, 1))
    system = {
        "A": one,
        "Ad": one,
        "a": (np.zeros(1),),
        "E": (np.zeros((0, 2)),),
        "e": (np.zeros(0),),
        "F": (np.eye(2),),
        "lines": none,
        "lines_delayed": none,
    }
    both = {k: v * 2 for k, v in system.items() if isinstance(v, tuple)} | {"lines": none, "lines_delayed": none}
    half = (np.array([[1.0, 0.0]]), np.array([[-1.0, 0.0]]))
    offset = (np.zeros(1),) * 2
    for values, text in (
        (system | {"a": ()}, "^0 matrices a for 1 cells$"),
        (system | {"Ad": (np.eye(2),)}, r"^Ad of cell 0 has the shape \(2, 2\), expected \(1, 1\)$"),
        (system | {"A": (np.array([[math.nan]]),)}, "^A of cell 0 is not finite$"),
        (both, r"^cells 0 and 1 overlap at x = \[.*\], x_d = \[.*\]$"),
        (
            {k: v if k in ("lines", "lines_delayed") else v * 3 for k, v in system.items()},
            r"^cells 0 and 1 overlap at x",
        ),
        (both | {"E": half, "e": (np.full(1, -0.3), np.zeros(1))}, r"^no cell holds x = .*: the cells leave a gap$"),
        (both | {"E": half, "e": offset, "F": (np.eye(2), 2.0 * np.eye(2))}, "^features of cells 0 and 1 differ by"),
    ):
        with pytest.raises(BadSystem, match=text):
            PwaSystem(**values)
    split = PwaSystem(**(both | {"E": half, "e": offset}))
    assert split.faces() == [(0, 0, 1), (1, 0, 0)]
    # On a face between two cells the first cell counts.
    assert (split.cell(np.zeros(1), np.ones(1)), split.cell(-np.ones(1), np.ones(1))) == (0, 1)
    away = PwaSystem(**(both | {"E": half, "e": (np.full(1, -0.3), np.full(1, 0.3))}))
    with pytest.raises(NotApplicable, match=r"^a cell does not hold the origin; conditions"):
        require_equilibrium(away)


def test_the_reason_why_a_system_has_no_criterion_is_named():
    across = [[1.0, 0.0]]
    for sign, kind in ((-1.0, "repelling"), (1.0, "sliding")):
        system = from_lines(
            [np.zeros((2, 2))] * 2, [[[0.0, 0.0], [0.0, 0.0]]] * 2, across, a=[[sign, 0.0], [-sign, 0.0]]
        )
        with pytest.raises(
            NotApplicable, match=rf"^{kind} on the face \[.*\] x = 0 of cells 0 and 1: at x = .*across it are"
        ):
            require_no_sliding(system, 0.1)
    require_no_sliding(
        from_lines([np.zeros((2, 2))] * 2, [np.zeros((2, 2))] * 2, (), across, a=[[1.0, 0.0], [-1.0, 0.0]]), 0.1
    )
    for scale in (1.0, 3e-10, 1e-14):  # An offset that no shift can remove is reported, whatever its unit.
        with pytest.raises(NotApplicable, match=r"^no equilibrium: the offset"):
            require_equilibrium(
                from_lines([-np.eye(2)] * 2, [np.zeros((2, 2))] * 2, across, a=[[scale, 0.0], [3.0 * scale, 0.0]])
            )
        for sign in (-1.0, 1.0):
            system = from_lines(
                [np.zeros((2, 2))] * 2, [np.zeros((2, 2))] * 2, across, a=[[sign * scale, 0.0], [-sign * scale, 0.0]]
            )
            with pytest.raises(NotApplicable, match=r"^(sliding|repelling) on the face"):
                require_no_sliding(system, 0.1)
    # The equilibrium (1, 0) of all cells is moved to the origin.
    A, Ad = [[0.0, 1.0], [-2.0, -1.0]], [[0.0, 0.0], [-1.0, 0.0]]
    shifted = require_equilibrium(from_lines([A], [Ad], a=[[0.0, 3.0]]))
    assert [a.tolist() for a in shifted.a] == [[0.0, 0.0]]
    assert shifted.A[0].tolist() == A
    with pytest.raises(NotApplicable, match=r"^no equilibrium: the offset \[0.0, 4.0\] of cell 1 stays, wherever"):
        require_equilibrium(from_lines([A] * 2, [Ad] * 2, across, a=[[0.0, 3.0], [0.0, 4.0]]))


def test_systems_are_given_by_name_and_by_their_numbers():
    for name, n, cells in (
        ("switched", 2, 4),
        ("tank", 1, 2),
        ("continuous_tank", 1, 4),
        ("pendulum", 2, 4),
        ("benchmark", 2, 1),
        ("scalar", 1, 1),
    ):
        p = SystemParams(system=name)
        system = p.build()
        assert (system.n, system.cells, p.states) == (n, cells, n)
    tank, smooth = SystemParams(system="tank").build(), SystemParams(system="continuous_tank").build()
    drains = [(8.6928e-4, 2.1732e-4), (5.0188e-4, 3.7641e-4)]  # drains of both slopes, linearised at the level 0.5
    assert [m.item() for m in tank.A] == [-slope_ for slope_, _ in drains]
    assert [m.item() for m in tank.Ad] == [0.2, -0.1]
    assert [a.item() for a in tank.a] == near(
        [0.5 * k - (0.5 * r + c) for k, (r, c) in zip((0.2, -0.1), drains, strict=True)]
    )
    assert [(A.item(), Ad.item()) for A, Ad in zip(smooth.A, smooth.Ad, strict=True)] == [
        (-r, -k) for r, _ in drains for k in (0.2, 0.1)
    ]
    own = SystemParams(
        system="user", n=2, A=tuple(range(8)), Ad=tuple(range(8, 16)), lines=(1.0, 2.0), offsets=(1.0, 2.0, 3.0, 4.0)
    )
    with pytest.raises(ParameterError, match="2 matrices A and 1 Ad for 1 cells of 0 lines"):
        build(SystemParams, {"system": "user", "A": (1.0, 2.0), "Ad": (1.0,)})
    assert [m.tolist() for m in own.build().A] == [[[0, 1], [2, 3]], [[4, 5], [6, 7]]]
    assert [m.tolist() for m in own.build().Ad] == [[[8, 9], [10, 11]], [[12, 13], [14, 15]]]
    assert [a.tolist() for a in own.build().a] == [[1.0, 2.0], [3.0, 4.0]]
    assert own.agreed() == {
        "pwa/system": "user",
        "pwa/n": 2,
        "pwa/A": own.A,
        "pwa/Ad": own.Ad,
        "pwa/lines": (1.0, 2.0),
        "pwa/lines_delayed": (),
        "pwa/offsets": own.offsets,
    }
    assert SystemParams(system="scalar").agreed() == {"pwa/system": "scalar"}
    swing = SystemParams(system="pendulum", k_negative=2.0, k_positive=3.0)
    assert swing.agreed() == {
        "pwa/system": "pendulum",
        "pendulum/k_negative": 2.0,
        "pendulum/k_positive": 3.0,
        "pendulum/model": "pwa",
    }
    assert [m.tolist() for m in swing.build().Ad] == [[[0, 0], [-k, -k]] for k in (2.0, 3.0, 2.0, 3.0)]
    assert [m[1, 0] for m in swing.build().A] == [-0.825, -0.825, -0.4875, -0.4875]


# nodes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("block", "button"), [(CertificateNode, "certify"), (MarginSearch, "search")])
@pytest.mark.parametrize("at_start", [True, False])
def test_work_is_requested_at_the_start_and_when_the_button_is_pressed(block, button, at_start):
    node = block(at_start=at_start)
    x, asked = node.first(), []
    for pressed in (None, (0.0,), (1.0,), (1.0,), (0.0,), (1.0,)):
        x, request = node.request(x, 0, **{button: pressed})
        asked.append(request is not None)
    assert asked == [at_start, False, True, False, False, True]


def test_reports_of_a_certificate_node_are_as_expected():
    node = CertificateNode(system="scalar", method="constant", order=1)
    p, eigenvalues = node.p, [Eigenvalues("a", 2.0, 4.0), Eigenvalues("b", -0.3, 0.0), Eigenvalues("c", 3.0, -0.5)]
    shapes = p.shapes()
    matrices = {name: np.full(shape, k + 1.0) for k, (name, shape) in enumerate(shapes.items())}
    count, rows, columns = p.padded()
    assert (count, rows, columns) == (3, 3, 3)
    for valid in (True, False):
        certificate = Certificate(0.7, valid, 0.25, matrices, eigenvalues[::2], "Solved", 0.1, 0.7)
        _x, outputs = node.answer(node.first(), 0, SimpleNamespace(answer=Answer(certificate, "")), True)
        assert outputs["verdict"] == (0.7, float(valid), 0.25, 0.5, 2.0)
        padded = np.zeros((3, 3, 3))
        for k, m in enumerate(matrices.values() if valid else ()):
            padded[k, : m.shape[0], : m.shape[1]] = m
        assert outputs["matrices"] == tuple(padded.ravel().tolist())
        assert node.reports == {}
    assert node.answer(node.first(), 0, SimpleNamespace(answer=Answer(certificate, "")), False)[1] == {}
    assert node.answer(node.first(), 0, None, True)[1] == {}
    for answer, outputs in (
        (Answer(None, "not applicable: why"), "not applicable: why"),
        (None, "no answer before the limit"),
    ):
        node.events.clear()
        assert node.answer(node.first(), 0, SimpleNamespace(answer=answer), True)[1] == {"verdict": (0.0,) * 5}
        assert node.reports["no_certificate"][:2] == (Level.WARN, outputs)
    smallest = Certificate(0.7, False, 0.25, matrices, eigenvalues[1:2], "Solved", 0.1)
    assert node.answer(node.first(), 0, SimpleNamespace(answer=Answer(smallest, "")), True)[1]["verdict"][3] < -1e299
    level = CertificateNode(method="level", system="tank")
    assert level.p.shapes() == {}
    answer = CertificateNode.solve(level.p, None)
    assert answer.certificate.h == near(level_margin(start=0.2, c=level.p.c))
    assert level.answer(level.first(), 0, SimpleNamespace(answer=answer), True)[1] == {
        "verdict": (answer.certificate.h, 1.0, near(answer.certificate.t), 0.0, 0.0)
    }
    far = CertificateNode.solve(CertificateNode(method="level", system="tank", h=50.0).p, None)
    assert far.reason == "no certificate: the tank may run empty"
    assert CriterionParams(system="tank").shapes() == {}


def test_reports_of_a_margin_search_are_as_expected():
    node = MarginSearch(low=0.01, high=0.03)
    margin = Margin(0.02, 0.019, 0.021, {0.02: -0.5, 0.01: -3.0})
    x = node.first()
    assert node.answer(x, 0, SimpleNamespace(answer=margin), True)[1] == {"margin": (0.02, 0.019, 0.021, -0.5)}
    assert node.answer(x, 0, SimpleNamespace(answer=margin), False)[1] == {}
    assert node.reports == {}
    assert node.answer(x, 0, SimpleNamespace(answer="none"), True)[1] == {"margin": (0.0, 0.01, 0.03, 0.0)}
    assert node.reports["no_margin"][:2] == (Level.WARN, "none")


def test_a_monitor_publishes_once_its_record_is_complete():
    """64 samples for the largest delay, a plant whose delay is half of it: slopes by its own record of states."""
    monitor = ByHand(LyapunovMonitor(system="scalar", period=0.01, rise=0.5))
    p = monitor.block.p
    rng = np.random.default_rng(3)
    m = {
        name: (lambda a: a @ a.T if a.shape[0] == a.shape[1] else a)(rng.normal(size=shape))
        for name, shape in p.shapes().items()
    }
    matrices, verdict, system = p.pad(m), (0.64, 1.0, 0.1, 0.1, 9.0), p.build()
    states = (2.0 + np.cos(0.3 * np.arange(200))) * 1.012 ** np.arange(200)
    record, slopes, values, reported, age = [], [], [], False, 0
    monitor.block.ages = lambda name: age
    assert monitor.update(0, state=(1.0,), mode=(0.0, 0.32), matrices=matrices, verdict=(0.64, 0.0, 0, 0, 0)) == {}
    for k, state in enumerate(states):
        monitor.reports.clear()
        age = k
        outputs = monitor.update(k, state=(state,), mode=(0.0, 0.32), matrices=matrices, verdict=verdict)
        record.append(state)
        slopes.append(-0.64 * record[max(k - 32, 0)])
        if k < 64 + 32:
            assert outputs == {}
            continue
        value = functional(system, m, np.array(record[-65:])[:, None], np.array(slopes[-65:])[:, None], 0.5)
        rate = (value - values[-1]) / 0.01 if values else 0.0
        assert outputs == {"value": near((value, rate))}
        rises = len(values) > 64 and value / values[-65] - 1.0 > 0.5
        reported |= rises
        assert ("rises" in monitor.reports) is rises
        values.append(value)
    assert reported
    _, outputs = monitor.block.update(monitor.x, 0, state=(9.0,), mode=(0.0, 0.66), matrices=matrices, verdict=verdict)
    rows, rates = np.array([*record[-64:], 9.0]), np.array([*slopes[-64:], -0.64 * record[-66]])
    assert outputs["value"][0] == near(functional(system, m, rows[:, None], rates[:, None], 1.0))
    assert monitor.refused(0) == {}
    # After the refused tick its record starts again.
    assert monitor.update(0, state=(1.0,), mode=(0.0, 0.32), matrices=matrices, verdict=verdict) == {}
    for h, coarse in ((0.64, False), (0.63, True)):
        other = ByHand(LyapunovMonitor(system="scalar", period=0.01))
        other.update(0, state=(1.0,), mode=(0.0, 0.3), matrices=matrices, verdict=(h, *verdict[1:]))
        assert ("coarse" in other.reports) is coarse
    assert other.reports["coarse"][1] == "period 0.01 s: expected at most h/64 = 0.00984 s"


def test_figures_of_the_functional_and_of_a_levels_coverage():
    t, v = np.arange(8) * 0.5, np.array([8.0, 6.0, 4.0, 3.3, 2.0, 1.5, 1.0, 0.9])
    signals = {"lyapunov/V/position": (t, v)}
    over_two = [b / a - 1.0 for a, b in zip(v, v[2:], strict=False)]
    assert largest_rise(signals, delay=1.0) == 0.0
    assert fall(signals, delay=1.0) == near(-np.median(over_two))
    assert largest_rise({"lyapunov/V/position": (t, v[::-1])}, delay=1.0) == near(
        max(a / b - 1.0 for a, b in zip(v, v[2:], strict=False))
    )
    assert fall(signals, delay=3.5) == near(1.0 - 0.9 / 8.0)
    with pytest.raises(ValueError, match=r"^V is recorded for 3.5 s, needed more than the delay 4 s$"):
        fall(signals, delay=4.0)

    def covered(h, valid, delay):
        named = {"h": [0.0, h], "valid": [0.0, valid]}
        entries = {f"certificate/verdict/{k}/position": (np.arange(2.0), np.array(x)) for k, x in named.items()}
        return level_covered(entries, delay=delay, hold=0.5)

    assert [covered(*values) for values in ((2.0, 1.0, 1.5), (2.0, 1.0, 1.51), (2.0, 0.0, 1.0))] == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(("angle", "before", "cell"), [(0.0, 0.0, 0), (0.0, 1e-12, 1), (1e-12, 0.0, 2), (1.0, 1.0, 3)])
def test_a_pendulum_that_hangs_straight_down_is_in_the_cell_of_negative_angles(angle, before, cell):
    past = trajectory(0.01, 0.1, (before, 0.0))
    constants = PendulumConstants(0.0, 1.0, np.array([FREE]), profile("constant", 0.05))
    assert pendulum_cell(0.0, np.array([angle, 0.0]), past, constants) == cell
