"""Constant delay: a tighter and faster criterion from the Bessel-Legendre integral inequality.

In the time in which the delay is 1, with the Legendre polynomials P_k::

    Omega_k  = int_0^1 P_k(2 s - 1) x(t - 1 + s) ds,   k = 0 ... N-1
    Omega_k' = x - (-1)^k x_d - sum_{j = k-1, k-3, ... >= 0} 2 (2 j + 1) Omega_j = zeta_k     (also int P_k x')
    eta      = (features of x and x_d, Omega_0 ... Omega_{N-1})
    V        = eta' L eta + int (x, x')' Q (x, x') + int int x'' R x'

    Q > 0, R > 0
    L over the cell + sum (2 k + 1) (Omega_k, zeta_k)' Q (Omega_k, zeta_k) - [E_i Ed_i]' H_i [E_i Ed_i] > 0
    Sym(eta' L eta') + (x, x')' Q (x, x') - (x_d, x_d')' Q (x_d, x_d') + x'' R x'
        - sum_{k=0}^N (2 k + 1) zeta_k' R zeta_k + [E_i Ed_i]' U_i [E_i Ed_i] < 0      on the null space of the dynamics

The second inequality contains all of Q: Omega_k and zeta_k are the Legendre coefficients of x and x', and Bessel's
inequality holds for both together. Q11 over Omega_k alone is not a lower bound if Q12 is not 0.

A certificate at one delay does not cover shorter delays. In the time t/h a shorter delay d multiplies the slope by d/h.
The third inequality is quadratic and convex in d/h (Q22 > 0, R > 0), so matrices that meet it at two delays meet it at
every delay between them. The second inequality does not depend on the delay. If the range begins at zero delay
(`shortest` 0), time cannot be scaled by the delay. Then V has d Omega_k in place of Omega_k and d R in place of R. The
third inequality is again convex in d, and the second one is required without Q.
"""

from __future__ import annotations

import numpy as np
from softrig_core import Array

from ..system import PwaSystem
from .lmi import Problem, Term, quadratic


def bessel_legendre(system: PwaSystem, order: int, *, shortest: float = 1.0, cell_terms: bool = False) -> Problem:
    """Write the inequalities for every constant delay from `shortest` to 1; scale the system by h first.

    Parameters
    ----------
    system : PwaSystem
        Equilibrium at the origin, offsets zero.
    order : int
        N, number of integrals; >= 1.
    shortest : float
        0 to 1.
    cell_terms : bool
        With the matrices U_i.
    """
    n, hinges = system.n, system.F[0].shape[0] - 2 * system.n
    size = (3 + order) * n  # of (x, x_d, x_d', Omega_0 ...): x' follows
    columns: list[Array] = list(np.hsplit(np.eye(size), 3 + order))
    x, x_d, slope_d, *omega = columns
    zeta = [_zeta(k, x, x_d, omega) for k in range(order + 1)]
    stays = np.r_[0 : 2 * n, 3 * n : size]
    p = Problem()
    p.symmetric("L", hinges + (2 + order) * n)
    p.symmetric("Q", 2 * n)
    p.symmetric("R", n)
    p.positive("Q", [quadratic("Q", np.eye(2 * n))], traced=True)
    p.positive("R", [quadratic("R", np.eye(n))], traced=True)
    for i in range(system.cells):
        E, F = system.E[i].T, system.F[i]
        now = np.hstack([x, x_d])
        terms = [quadratic("L", np.hstack([now @ F.T, *omega])[stays])]
        if shortest > 0.0:
            both = [np.hstack([omega[k], zeta[k]])[stays] for k in range(order)]
            terms += [quadratic("Q", both[k], 2.0 * k + 1.0) for k in range(order)]
        if E.size:
            p.symmetric(f"H{i}", E.shape[1], positive=True)
            terms.append(quadratic(f"H{i}", now[stays] @ E, -1.0))
        p.positive(f"V > 0 cell {i}", terms, traced=True)
        if cell_terms and E.size:
            p.symmetric(f"U{i}", E.shape[1], positive=True)
        for d in sorted({shortest, 1.0}, reverse=True):
            x_dot = x @ system.A[i].T + x_d @ system.Ad[i].T
            slope, weight = (d * x_dot, 1.0) if shortest > 0.0 else (x_dot, d)
            eta = np.hstack([now @ F.T, *(weight * o for o in omega)])
            falls = [
                Term("L", eta, np.hstack([np.hstack([slope, slope_d]) @ F.T, *zeta[:order]])),
                quadratic("Q", np.hstack([x, slope])),
                quadratic("Q", np.hstack([x_d, slope_d]), -1.0),
                quadratic("R", d * x_dot),
                *(quadratic("R", zeta[k], -(2.0 * k + 1.0)) for k in range(order + 1)),
            ]
            if f"U{i}" in p.unknowns:
                falls.append(quadratic(f"U{i}", now @ E))
            name = f"V' < 0 cell {i}" + (f", d {d:.6g}" if shortest < 1.0 else "")
            p.positive(name, [Term(t.name, -t.left, t.right) for t in falls])
    return p


def _zeta(k: int, x: Array, x_d: Array, omega: list[Array]) -> Array:
    total = x - (-1.0) ** k * x_d
    for j in range(k - 1, -1, -2):
        total = total - 2.0 * (2.0 * j + 1.0) * omega[j]
    return total
