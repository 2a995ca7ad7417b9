"""Every certificate of the suite, on random problems, against an exact test: no false "valid".

Each case draws a problem from a generator and tells whether the suite certifies it and whether what is certified is so:
by the roots of the characteristic equation, by simulation to growth, by rational arithmetic, by enumeration. A few
draws a day; the long test takes 10,000 over all.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import pytest
from conftest import few
from helpers import Transformer
from scipy.linalg import solve_discrete_lyapunov
from softrig_control.predictive.carima import Carima
from softrig_control.predictive.certificate import assess, certify as dual_mode, companion
from softrig_optim.load_line import CertifiedSearch
from softrig_power.dispatch.certify import InfeasibleError, Optimiser
from softrig_power.dispatch.conditions import Conditions, Losses
from softrig_power.dispatch.enumeration import enumerate_kinks
from softrig_power.dispatch.units import Units
from softrig_robots.manipulator.surfaces import Coefficients
from softrig_systems.pwa_delay.certificate import CertificateNode
from softrig_systems.pwa_delay.profiles import profile
from softrig_systems.pwa_delay.proof.applicability import NotApplicable
from softrig_systems.pwa_delay.proof.certify import Criterion, certified_margin, certify
from softrig_systems.pwa_delay.proof.level import level_bound, level_margin
from softrig_systems.pwa_delay.search import pwa_margin, simulate_pwa
from softrig_systems.pwa_delay.system import from_lines, linear


class Drawn(NamedTuple):
    """Whether a problem is certified, whether that is true, and the problem."""

    certified: bool
    true: bool
    what: str


# delays: the rightmost root of det(s I - A - Ad exp(-s h)) ---------------------------------------------------------


def rightmost(A, Ad, h, points=24):
    """Largest real part of the characteristic roots (1/s): collocation of the generator at Chebyshev points."""
    n = len(A)
    k = np.arange(points + 1)
    theta = 0.5 * h * (np.cos(np.pi * k / points) - 1.0)  # Chebyshev points from 0 to -h
    c = np.where((k == 0) | (k == points), 2.0, 1.0) * (-1.0) ** k
    gap = theta[:, None] - theta[None, :]
    D = np.outer(c, 1.0 / c) / (gap + np.eye(points + 1))
    D -= np.diag(D.sum(axis=1))
    M = np.kron(D, np.eye(n))
    M[:n] = 0.0
    M[:n, :n], M[:n, -n:] = A, Ad
    return float(np.max(np.linalg.eigvals(M).real))


def a_linear_system(rng, most=3):
    """Matrices, and a delay that is near the end of a window in half of the cases."""
    n = int(rng.integers(1, most + 1))
    A = rng.normal(size=(n, n)) - rng.uniform(-0.5, 2.5) * np.eye(n)
    Ad = rng.uniform(0.2, 2.0) * rng.normal(size=(n, n))
    delays = np.geomspace(0.02, 6.0, 12) * rng.uniform(0.7, 1.4)
    # A coarse estimate to guide the draw; the exact check follows.
    signs = [rightmost(A, Ad, h, 10) < 0.0 for h in delays]
    ends = [k for k in range(11) if signs[k] != signs[k + 1]]
    if not ends or rng.random() < 0.4:
        return A, Ad, float(delays[rng.integers(12)])
    low, high = delays[(k := ends[int(rng.integers(len(ends)))])], delays[k + 1]
    for _ in range(9):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if (rightmost(A, Ad, middle, 16) < 0.0) == signs[k] else (low, middle)
    off = 10.0 ** rng.uniform(-3.0, -0.7)
    return A, Ad, float(low * (1.0 + off if rng.random() < 0.6 else 1.0 - off))


def stable(A, Ad, delays):
    """Return whether all are stable, except for what collocation and rounding leave open."""
    return all(rightmost(A, Ad, h) < 1e-7 * (np.linalg.norm(A) + np.linalg.norm(Ad)) for h in delays)


def constant_delay(rng):
    A, Ad, h = a_linear_system(rng)
    criterion = Criterion("constant", order=int(rng.integers(1, 5)))
    valid = certify(linear(A, Ad), h, criterion, sliding=False).valid
    return Drawn(valid, not valid or stable(A, Ad, [h]), f"{criterion} h = {h!r} A = {A.tolist()} Ad = {Ad.tolist()}")


def constant_delays_of_an_interval(rng):
    A, Ad, h = a_linear_system(rng, 2)
    shortest = 0.0 if rng.random() < 0.4 else h * (1.0 - 10.0 ** rng.uniform(-3.0, -0.1))
    criterion = Criterion("constant", order=int(rng.integers(1, 4)))
    valid = certify(linear(A, Ad), h, criterion, shortest=shortest, sliding=False).valid
    delays = np.linspace(max(shortest, 1e-3 * h), h, 20)
    what = f"{criterion} from {shortest!r} to {h!r} A = {A.tolist()} Ad = {Ad.tolist()}"
    return Drawn(valid, not valid or stable(A, Ad, delays), what)


def search_of_constant_delays(rng):
    A, Ad, h = a_linear_system(rng, 2)
    low, high = (0.0, 0.0) if rng.random() < 0.3 else (0.3 * h, 2.0 * h)
    certificate = certified_margin(linear(A, Ad), Criterion("constant"), low=low, high=high, width=0.02)
    what = f"low = {low!r} high = {high!r} A = {A.tolist()} Ad = {Ad.tolist()}"
    if certificate is None:
        return Drawn(False, True, what)
    top = min(certificate.h, 30.0)  # collocation is accurate up to this delay
    return Drawn(
        True, stable(A, Ad, np.linspace(max(certificate.shortest, 1e-3 * top), top, 60)), f"{certificate.h} {what}"
    )


def theorem_1(rng):
    A, Ad, h = a_linear_system(rng, 2)
    mu = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.05, 1.2))
    system = linear(A, Ad)
    valid = certify(system, h, Criterion("theorem1", mu), sliding=False).valid
    true = not valid or stable(A, Ad, np.linspace(1e-3 * h, h, 20))
    if valid and mu > 0.0:
        true = true and not grows(system, profile("sine", h, mu), rng)
    return Drawn(valid, true, f"mu = {mu} h = {h!r} A = {A.tolist()} Ad = {Ad.tolist()}")


def grows(system, delay, rng):
    """Return whether a trajectory from one of three starts ends larger than it was."""
    slowest = max(delay.h, *(1.0 / np.linalg.norm(A) for A in system.A))
    duration = 60.0 * slowest + (20.0 * math.pi * delay.h / delay.mu if delay.mu else 0.0)
    for _ in range(3):
        sizes = simulate_pwa(system, delay, rng.normal(size=system.n), min(duration, 3e4 * delay.h), steps=30).sizes
        third = sizes.size // 3
        before, after = float(np.max(sizes[third : 2 * third])), float(np.max(sizes[2 * third :]))
        if not after <= 1.02 * before and after > 1e-12:
            return True
    return False


def a_piecewise_system(rng):
    """Slopes that are continuous over the faces, except for a quarter of the draws, which may slide."""
    n = int(rng.integers(1, 3))
    A = rng.normal(size=(n, n)) - rng.uniform(-0.3, 2.0) * np.eye(n)
    Ad = rng.uniform(0.2, 1.5) * rng.normal(size=(n, n))
    c, c_d = rng.normal(size=n), rng.normal(size=n)
    g, g_d = (rng.uniform(0.0, 1.5) * rng.normal(size=n) for _ in range(2))
    jump = (0.3 * rng.normal(size=(n, n))) if rng.random() < 0.25 else np.zeros((n, n))
    kind = int(rng.integers(3))
    A = [A + s * np.outer(g, c) for s in (0.0, 1.0)]
    Ad = [Ad + s * np.outer(g_d, c_d) for s in (0.0, 1.0)]
    if kind == 0:
        return from_lines(A, [Ad[0], Ad[0] + jump], [c])
    if kind == 1:
        return from_lines([A[0]] * 2, Ad, [], [c_d])
    pairs = [(a, d) for a in (0, 1) for d in (0, 1)]
    return from_lines([A[a] for a, _ in pairs], [Ad[d] for _, d in pairs], [c], [c_d])


def piecewise(rng, method):
    system = a_piecewise_system(rng)
    h = float(10.0 ** rng.uniform(-1.5, 0.7))
    criterion = Criterion(method, 0.0, 2, bool(rng.random() < 0.5))
    what = (
        f"{criterion} h = {h!r} A = {[m.tolist() for m in system.A]} Ad = {[m.tolist() for m in system.Ad]} "
        f"lines = {system.lines.tolist()} {system.lines_delayed.tolist()}"
    )
    try:
        valid = certify(system, h, criterion).valid
    except NotApplicable:
        return Drawn(False, True, what)
    delays = [h] if method == "constant" else [h, 0.6 * h, 0.25 * h]
    return Drawn(valid, not valid or not any(grows(system, profile("constant", d), rng) for d in delays), what)


def constant_delay_of_cells(rng):
    return piecewise(rng, "constant")


def theorem_1_of_cells(rng):
    return piecewise(rng, "theorem1")


def margin_by_simulation(rng):
    """The result of `margin_search`: stable on its grid below the margin, and at the edge of stability there."""
    A, Ad, h = a_linear_system(rng, 2)
    low, high = 0.5 * h, 1.3 * h
    what = f"{low!r} to {high!r} A = {A.tolist()} Ad = {Ad.tolist()}"
    try:
        result = pwa_margin(linear(A, Ad), low, high, rng.normal(size=len(A)), 120.0 * h, steps=30, width=1e-3 * h)
    except ValueError:  # the range has no margin, or the motion no maxima
        return Drawn(False, True, what)
    below = [d for d in result.growth if d < result.low - 1e-3 * h]
    edge = rightmost(A, Ad, result.h)
    return Drawn(True, stable(A, Ad, below) and abs(edge) < 0.02 / h, f"{result.h!r} edge {edge:.3g} {what}")


# the tank: a delay that does its worst
# -------------------------------------------------------------------------------


def lowest_level(h, s, kL, kR, c, start, rng):
    """The lowest level if the delay, up to h with the hold, selects first the largest and then the least flow in the
    pipe.

    It differs from a trajectory of the tank only by the drain, which is late by a step: at most c sqrt(highest) of it.
    """
    steps = 250
    dt = h / steps
    x = np.full(13 * steps, start)
    u = np.where(x < s, kL * x, -kR * x)
    falling = bool(rng.random() < 0.3)
    top, patience = start, 0
    for k in range(steps, x.size - 1):
        window = u[k - steps + 1 : k + 1]
        flow = window.min() if falling else window.max()
        level = max(x[k] + dt * (flow - c * math.sqrt(x[k])), 0.0)
        x[k + 1], u[k + 1] = level, kL * level if level < s else -kR * level
        if level > top + 1e-9:
            top, patience = level, 0
        else:
            patience += 1
        if not falling and patience > 3:
            falling = True
        elif falling and level < s and window.min() >= 0.0:
            falling, top, patience = False, level, 0
    return float(x.min()), dt * c * math.sqrt(x.max())


def level(rng):
    s, c = float(rng.uniform(0.1, 2.0)), float(10.0 ** rng.uniform(-4.0, -1.0))
    kL, kR = (float(10.0 ** rng.uniform(-1.5, 0.3)) for _ in range(2))
    start = float(rng.uniform(0.05, 1.6) * s)
    tank = {"s": s, "kL": kL, "kR": kR, "c": c, "start": start}
    margin = level_margin(**tank)
    h = (margin or 1.0) * float(rng.choice([0.3, 0.9, 0.999, 1.001, 1.1]))
    bound = level_bound(h, **tank)
    if not bound.certified:
        return Drawn(False, True, "")
    lowest, slack = lowest_level(h, s, kL, kR, c, start, rng)
    return Drawn(True, lowest >= bound.lowest - slack, f"h = {h!r} {tank} {lowest} {bound}")


def tank_of_the_node(rng):
    """The node's own answer: its request, and its search range."""
    s, kL, kR = (float(v) for v in rng.uniform([0.2, 0.05, 0.02], [1.5, 0.5, 0.5]))
    x0, c = float(rng.uniform(0.05, 1.0)), float(10.0 ** rng.uniform(-4.0, -1.5))
    own = {"switch": s, "k_low": kL, "k_high": kR, "c": c, "x0": x0}
    h = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.5, 12.0))
    result = CertificateNode.solve(CertificateNode.Params(system="tank", method="level", h=h, **own), None).certificate
    if not result.valid:
        return Drawn(False, True, "")
    lowest, slack = lowest_level(result.h, s, kL, kR, c, x0, rng)
    return Drawn(True, lowest >= result.t - slack, f"h = {result.h!r} {own} {lowest}")


# dual mode: rational arithmetic --------------------------------------------------------------------------------------


def rational(matrix):
    return [[Fraction(float(v)) for v in row] for row in np.atleast_2d(matrix)]


def times(a, b):
    return [
        [sum((x * y for x, y in zip(row, column, strict=True)), Fraction(0)) for column in zip(*b, strict=True)]
        for row in a
    ]


def schur(matrix):
    """Return whether all eigenvalues are inside the unit circle, exactly: Schur and Cohn on the characteristic
    polynomial.
    """
    n = len(matrix)
    p, power = [Fraction(1)], [[Fraction(int(i == j)) for j in range(n)] for i in range(n)]
    for k in range(1, n + 1):  # the method of Faddeev and LeVerrier
        power = times(matrix, power)
        p.append(-sum((power[i][i] for i in range(n)), Fraction(0)) / k)
        for i in range(n):
            power[i][i] += p[-1]
    while len(p) > 1:
        if abs(p[-1]) >= abs(p[0]):
            return False
        p = [p[0] * a - p[-1] * b for a, b in zip(p, p[::-1], strict=True)][:-1]
        p = [a / p[0] for a in p]
    return True


def positive(matrix):
    """Return whether a symmetric matrix is positive definite, exactly, by pivots."""
    m = [row[:] for row in matrix]
    for k in range(len(m)):
        if m[k][k] <= 0:
            return False
        for i in range(k + 1, len(m)):
            share = m[i][k] / m[k][k]
            m[i] = [x - share * y for x, y in zip(m[i], m[k], strict=True)]
    return True


def dual_mode_holds(a, b, gain, terminal, q, r):
    """Return whether A + B K is inside the circle, Qbar > 0, and V falls by the stage cost within 1e-8 of its largest
    entry; all exact.
    """
    a, b, k, p, q = (rational(m) for m in (a, b, gain, terminal, q))
    n = len(a)
    p = [[(p[i][j] + p[j][i]) / 2 for j in range(n)] for i in range(n)]
    bk = times(b, k)
    closed = [[x + y for x, y in zip(*rows, strict=True)] for rows in zip(a, bk, strict=True)]
    fallen = times([list(c) for c in zip(*closed, strict=True)], times(p, closed))
    kk = times([list(c) for c in zip(*k, strict=True)], k)
    slack = Fraction(1, 10**8) * max(1, *(abs(v) for row in p for v in row))
    left = [
        [
            p[i][j] - fallen[i][j] - (q[i][j] + q[j][i]) / 2 - Fraction(r) * kk[i][j] + (slack if i == j else 0)
            for j in range(n)
        ]
        for i in range(n)
    ]
    return schur(closed) and positive(p) and positive(left)


def dual_mode_of_matrices(rng):
    n = int(rng.integers(1, 4))
    b, gain = rng.normal(size=(n, 1)), rng.normal(size=(1, n)) * rng.choice([0.0, 1.0])
    closed = rng.normal(size=(n, n))
    size = float(np.max(np.abs(np.linalg.eigvals(closed))))
    edge = float(rng.choice([0.5, 0.9, 1.0 - 1e-6, 1.0 - 1e-13, 1.0, 1.0 + 1e-13, 1.0 + 1e-6, 1.2]))
    closed *= edge / size
    cost = rng.normal(size=(1, n))
    if rng.random() < 0.4:  # a root on the circle that affects neither cost nor feedback
        left = np.linalg.qr(rng.normal(size=(n, n)))[0] + 0.3 * rng.normal(size=(n, n))
        roots = np.diag([edge, *rng.uniform(-0.8, 0.8, n - 1)])
        closed = left @ roots @ np.linalg.inv(left)
        gain, cost = np.zeros((1, n)), (np.linalg.inv(left)[-1:] if n > 1 else np.zeros((1, 1)))
    a = closed - b @ gain
    q, r = cost.T @ cost, float(rng.uniform(0.1, 2.0))
    if edge < 0.99:
        seen = float(rng.choice([0.0, 1e-3]))  # with zero, Qbar may be flat in one direction
        terminal = solve_discrete_lyapunov((a + b @ gain).T, q + r * gain.T @ gain + seen * np.eye(n))
    else:
        terminal = np.eye(n)
        for _ in range(40):
            terminal = q + r * gain.T @ gain + (a + b @ gain).T @ terminal @ (a + b @ gain)
        terminal = terminal + 0.1 * np.eye(n)
    kind = int(rng.integers(4))
    if kind == 1:
        terminal = terminal * (1.0 + 10.0 ** rng.uniform(-10.0, -1.0) * rng.choice([-1.0, 1.0]))
    elif kind == 2:
        terminal = terminal + 10.0 ** rng.uniform(-8.0, -1.0) * rng.normal(size=(n, n))
    elif kind == 3:
        gain = gain + 10.0 ** rng.uniform(-6.0, 0.0) * rng.normal(size=(1, n))
    valid = assess(a, b, gain, terminal, q, r).valid
    what = f"a = {a.tolist()} b = {b.tolist()} K = {gain.tolist()} P = {terminal.tolist()} q = {q.tolist()} r = {r}"
    return Drawn(valid, not valid or dual_mode_holds(a, b, gain, terminal, q, r), what)


def dual_mode_of_a_model(rng):
    roots = rng.uniform(-1.4, 1.4, int(rng.integers(1, 4)))
    a = tuple(np.poly(roots).tolist())
    # A zero may cancel a root.
    zeros = rng.choice(roots, 1) if rng.random() < 0.3 else rng.uniform(-1.5, 1.5, len(roots) - 1)
    model, r, q = (
        Carima(a, tuple(np.atleast_1d(np.poly(zeros)).tolist())),
        *(float(v) for v in 10.0 ** rng.uniform(-3.0, 3.0, 2)),
    )
    what = f"{model} r = {r} q = {q}"
    try:
        result = dual_mode(model, r, q)
    except np.linalg.LinAlgError:
        return Drawn(False, True, what)
    A, B, C = companion(model)
    true = not result.valid or dual_mode_holds(A, B, result.gain, result.terminal, q * C.T @ C, r)
    return Drawn(result.valid, true, what)


# the arm's surfaces: roots of the loop on the plant of the proof ------------------------------------------------------


def gains_of_the_arm(rng):
    """The proof: q'' = v - g, g constant; with mu_1 = a_1 + b_1 every positive gain makes the error vanish."""
    a1, a2, b1, b2, gamma, k = (float(v) for v in 10.0 ** rng.uniform(-1.0, 3.0, 6))
    printed = bool(rng.random() < 0.5)
    mu = Coefficients.of(a1, a2, b1, b2, printed)
    surfaces = np.polymul([1.0, a1, a2], [1.0, b1, b2])
    loop = np.polyadd([1.0, *mu, 0.0, 0.0], np.polymul([k, gamma], surfaces))
    # Then sigma' = f - f-hat - k sigma, without other terms.
    sigma_alone = np.allclose([1.0, *mu], surfaces, rtol=1e-12)
    roots = np.roots(loop)
    size = float(np.max(np.abs(roots)))
    return Drawn(
        sigma_alone, not sigma_alone or bool(np.max(roots.real) < 1e-9 * size), f"{(a1, a2, b1, b2, gamma, k)}"
    )


# dispatch: enumeration, grids ----------------------------------------------------------------------------------------


def some_units(rng, n):
    low = rng.uniform(0.0, 120.0, n)
    ranges = np.array([[20.0, 400.0], [0.0, 5e-3], [5.0, 12.0], [50.0, 500.0], [0.0, 300.0], [0.01, 0.1]])
    table = np.column_stack([low, rng.uniform(*ranges.T, (n, 6))])
    table[:, 1] += low
    if n > 2 and rng.random() < 0.3:
        table[1] = table[0]
    return Units(tuple(f"u{k}" for k in range(n)), table)


def dispatch(rng):
    units = some_units(rng, int(rng.integers(2, 6)))
    demand = float(units.p_min.sum() + rng.uniform(0.02, 0.98) * (units.p_max - units.p_min).sum())
    result = Optimiser(units).certified(demand)
    try:
        least = units.total(enumerate_kinks(units, demand))
    except InfeasibleError:
        least = math.inf
    for _ in range(200):  # further dispatches, balanced by one unit
        P = units.p_min + rng.random(len(units)) * (units.p_max - units.p_min)
        j = int(rng.integers(len(units)))
        P[j] += demand - P.sum()
        if units.p_min[j] <= P[j] <= units.p_max[j]:
            least = min(least, units.total(P))
    meets = abs(result.P.sum() - demand) < 1e-6 and np.all((units.p_min <= result.P) & (units.p_max >= result.P))
    true = meets and result.bound <= least + 1e-7 and result.cost <= least + 1e-3 + 1e-7
    what = f"{units.table.tolist()} demand {demand!r} cost {result.cost} bound {result.bound} least {least}"
    return Drawn(result.reason == "proven", bool(true), what)


def dispatch_with_conditions(rng):
    units = some_units(rng, 3)
    nans, span = np.full((3, 4), np.nan), units.p_max - units.p_min
    if rng.random() < 0.5:
        nans[:, 0] = units.p_min + rng.random(3) * span
        nans[:, 1:3] = rng.uniform(20.0, 200.0, (3, 2))
    if rng.random() < 0.5:
        nans[:, 3] = rng.uniform(5.0, 100.0, 3)
    units = Units(units.ids, units.table, nans)
    half = rng.uniform(0.0, 3e-5, (3, 3))
    losses = Losses(0.5 * (half + half.T), rng.uniform(-1e-3, 1e-3, 3), float(rng.uniform(0.0, 0.5)))
    conditions = Conditions.of(
        units, losses if rng.random() < 0.6 else None, float(rng.choice([0.0, 0.1, 0.3]) * span.sum())
    )
    demand = float(conditions.low.sum() + rng.uniform(0.05, 0.95) * (conditions.high - conditions.low).sum())
    axes = []
    for j in (0, 1):
        inside = [v for v in units.valve_points(j) if conditions.low[j] <= v <= conditions.high[j]]
        axes.append(np.unique([*np.linspace(conditions.low[j], conditions.high[j], 140), *inside]))
    p0, p1 = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    p2 = np.maximum(demand - p0 - p1, 0.0)
    lost = conditions.losses
    for _ in range(12):
        P = np.column_stack([p0, p1, p2])
        p2 = demand + np.sum(P * (P @ lost.B), axis=1) + P @ lost.B0 + lost.B00 - p0 - p1
    P = np.column_stack([p0, p1, p2])
    good = (p2 >= conditions.low[2]) & (p2 <= conditions.high[2])
    good &= np.sum(np.minimum(conditions.ready, units.p_max - P), axis=1) >= conditions.reserve
    least = float(units.cost(P[good]).sum(axis=1).min()) if good.any() else math.inf
    what = f"{units.table.tolist()} {nans.tolist()} {conditions} demand {demand!r} least {least}"
    try:
        result = Optimiser(units, tol=1e-2, max_nodes=200_000).conditioned(demand, conditions)
    except InfeasibleError as error:  # the optimiser must have proven that no dispatch exists
        return Drawn("no dispatch found" not in str(error), least == math.inf, f"{error} {what}")
    meets = abs(result.P.sum() - lost.of(result.P) - demand) < 1e-5
    meets = meets and np.all((conditions.low - 1e-9 <= result.P) & (conditions.high + 1e-9 >= result.P))
    meets = meets and conditions.spinning(units, result.P) >= conditions.reserve - 1e-6
    return Drawn(result.reason == "proven", bool(meets and result.bound <= least + 1e-7), f"{what} {result}")


# search along a falling characteristic: all of it --------------------------------------------------------------------


def bound_of_a_search(rng):
    """Strings with shaded modules: steps in the current, passed between two commands, too."""
    parts = int(rng.integers(2, 9))
    v = np.concatenate([[0.0], np.cumsum(np.repeat(rng.uniform(1.0, 20.0, parts), 2) * np.tile([0.9, 0.1], parts))])
    steps = np.concatenate([[0.0], np.cumsum(rng.exponential(1.0, parts))])[::-1]
    i = np.concatenate([np.repeat(steps, 2)[:-1] * 1.0, [0.0]])[: v.size]
    i = np.minimum.accumulate(i + np.linspace(0.02, 0.0, v.size))
    load, eps = float(rng.uniform(2.0, 50.0)), float(rng.choice([0.003, 0.01, 0.05]))

    def operate(d):
        R = load / d**2
        k = max(int(np.flatnonzero(v - R * i >= 0.0)[0]), 1)
        share = (R * i[k - 1] - v[k - 1]) / ((v[k] - v[k - 1]) - R * (i[k] - i[k - 1]))
        return v[k - 1] + share * (v[k] - v[k - 1]), i[k - 1] + share * (i[k] - i[k - 1])

    search = CertifiedSearch(
        [0.05], [20.0], matching=Transformer(), eps=eps, n_iter=400, transients=bool(rng.random() < 0.5)
    )
    lowest, highest = (operate(d)[0] for d in (20.0, 0.05))
    at = np.unique(np.concatenate([np.linspace(lowest, highest, 3000), v[(v >= lowest) & (v <= highest)]]))
    best = float((at * np.interp(at, v, i)).max())
    true, before = True, 1.0
    while not search.done:
        d = search.ask()[0]
        for way in np.linspace(before, d, 6)[1:-1]:  # a search may also use samples between two candidates
            search.watch(operate(way))
        sample, before = operate(d), d
        search.tell(sample[0] * sample[1], sample)
        true = true and (search.bound is None or search.bound >= best * (1.0 - 1e-12))
    proven = search.bound is not None and search.bound <= (1.0 + eps) * search.expected
    return Drawn(
        proven, true and (not proven or search.expected >= best / (1.0 + eps) * (1.0 - 1e-9)), f"{v} {i} {load}"
    )


# For each case: draws daily, draws of the long test (at most 35 CPU s each), least shares of certified and of refused
# draws.
CASES = {
    dual_mode_of_matrices: (60, 3500, 0.1, 0.3),
    dual_mode_of_a_model: (10, 400, 0.5, 0.0),
    gains_of_the_arm: (50, 500, 0.3, 0.3),
    level: (10, 700, 0.2, 0.1),
    tank_of_the_node: (5, 400, 0.2, 0.1),
    bound_of_a_search: (20, 1200, 0.8, 0.0),
    dispatch: (4, 400, 0.5, 0.0),
    dispatch_with_conditions: (4, 200, 0.3, 0.0),
    constant_delay: (20, 1500, 0.2, 0.3),
    constant_delays_of_an_interval: (10, 700, 0.1, 0.3),
    search_of_constant_delays: (1, 60, 0.2, 0.05),
    constant_delay_of_cells: (2, 120, 0.1, 0.2),
    theorem_1: (4, 400, 0.1, 0.3),
    theorem_1_of_cells: (1, 50, 0.1, 0.2),
    margin_by_simulation: (4, 150, 0.05, 0.1),
}


def judge(case, draws, seed):
    """Return how many are certified; each false one is an error."""
    certified = 0
    for k in range(draws):
        drawn = case(np.random.default_rng([seed, k]))
        assert drawn.true or not drawn.certified, f"{case.__name__}, seed {seed}, draw {k}: {drawn.what}"
        certified += drawn.certified
    return certified


@pytest.mark.parametrize("case", few(CASES, 6), ids=lambda case: case.__name__)
def test_no_certificate_is_false(case):
    assert judge(case, CASES[case][0], 1) > 0 or CASES[case][0] < 5


@pytest.mark.long
@pytest.mark.timeout(1800)  # s of wall time, on a shared machine
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_no_certificate_of_ten_thousand_is_false(case):
    _, draws, valid, refused = CASES[case]
    certified = judge(case, draws, 2)
    print(f"\n| {case.__name__} | {draws} | {certified} | 0 |")
    assert valid * draws <= certified <= (1.0 - refused) * draws  # the draw includes both certified and refused cases


def test_the_long_test_takes_ten_thousand():
    assert sum(draws for _, draws, *_ in CASES.values()) >= 10_000
