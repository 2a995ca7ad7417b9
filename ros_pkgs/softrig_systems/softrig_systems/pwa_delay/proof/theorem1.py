r"""Theorem 1: delay margin of a piecewise linear system with a delay that varies, in its corrected form.

The system x' = A_i x + Ad_i x_d in the cell ``[E_i Ed_i] [x; x_d] >= 0``, x_d = x(t - d(t)), 0 <= d <= h, \|d'\| <= mu,
is asymptotically stable if L1, R, S, Q, Z, Z1 to Z4, Y1, Y2, N1 to N4 and H_i (entries >= 0) exist with, for every cell
and P_i = [F_i Fd_i]' L1 [F_i Fd_i]::

    (8)  [[Z1, Y1, N1], [*, Z2, N2], [*, *, R]] > 0,   [[Z3, Y2, N3], [*, Z4, N4], [*, *, R]] > 0,   R, S, Q, Z > 0
    (9)  P_i - [E_i Ed_i]' H_i [E_i Ed_i] > 0
    (10) B' psi_i B < 0 at the four corners d in {0, h}, d' in {-mu, mu}

B is the null space of [A_i, Ad_i, 0, -I, 0, 0, 0, 0] on::

    xi = [x, x_d, x(t-h), x', x_d', x'(t-h), (1/d) int_{t-d}^t x, (1/(h-d)) int_{t-h}^{t-d} x]

With b1 to b8 its block columns, g = 1 - d', Sym(M) = M + M'::

    psi_i = Sym(E1 P_i E2') + Sym(E3 S E4') + W1 + W2 + h b4 R b4' + Phi1 + Phi2
    E1 = [b1 b2]   E2 = [b4, g b5]   E3 = [b3, d b7, (h-d) b8]   E4 = [b6, b1 - g b2, g b2 - b3]
    W1 = E5 Q E5' - g E6 Q E6' + Sym(E7 Q E8')
        E5 = [b1 b4 0]   E6 = [b2, b5, b1 - b2]   E7 = [d b7, b1 - b2, d (b1 - b7)]   E8 = [0 0 b4]
    W2 = g E9 Z E9' - E10 Z E10' + Sym(E11 Z E12')
        E9 = [b2 b5 0]   E10 = [b3, b6, b2 - b3]   E11 = [(h-d) b8, b2 - b3, (h-d)(b2 - b8)]   E12 = [0, 0, g b5]
    Phi1 = d E13 (Z1 + Z2/3) E13' + Sym(E13 (N1 (b1-b2)' + N2 (2 b7 - b1 - b2)'))          E13 = [b1 b2 b7]
    Phi2 = (h-d) E14 (Z3 + Z4/3) E14' + Sym(E14 (N3 (b2-b3)' + N4 (2 b8 - b2 - b3)'))      E14 = [b2 b3 b8]

psi is affine in d and in d', so its corners suffice; mu = 0 covers every constant delay in [0, h]. Optionally
[E_i Ed_i]' U_i [E_i Ed_i] on (x, x_d) is added to psi_i, U_i with entries >= 0, one a corner.

The functional is V = [x; x_d]' P_i [x; x_d] + z2' S z2 + int_{t-d}^t z3' Q z3 + int_{t-h}^{t-d} z4' Z z4
+ int_{t-h}^t int_y^t x'' R x', z2 = (x(t-h), int_{t-d}^t x, int_{t-h}^{t-d} x), z3(y) = (x(y), x'(y), x(t) - x(y)),
z4(y) = (x(y), x'(y), x_d - x(y)).

For mu >= 1 there is no certificate: the block of x_d' alone in (10) is g (Z22 - Q22), and g takes both signs.

The paper prints instead: h_t = 1 - d for 1 - d'; Sym(E1 P E1') and, in the proof, Sym(E3 S E3'), which leave E2 and E4
unused; the integral of Z over [t-d, t]; "e4" for b4; P_i^{-1}(...) for the differences in (9); x_d for x_d' in the
fifth place of xi; the wrong sign of the length by which the inequality lemma divides; H_i of the size of the state. It
is not valid where the vector field slides along a face, nor for cells without the origin, whose conditions (11) to (13)
demand that a matrix with zero rows is positive definite.
"""

from __future__ import annotations

import numpy as np
from softrig_core import Array

from ..system import PwaSystem
from .lmi import Problem, Term, quadratic


def theorem1(system: PwaSystem, mu: float, *, cell_terms: bool = False) -> Problem:
    """Write the inequalities for the delay bound 1; scale the system by h first.

    Parameters
    ----------
    system : PwaSystem
        Equilibrium at the origin, offsets zero.
    mu : float
        Bound of the rate of the delay, >= 0; beyond 1 is allowed.
    cell_terms : bool
        With the matrices U_i.
    """
    n = system.n
    p = Problem()
    p.symmetric("L1", system.F[0].shape[0])
    p.symmetric("R", n)
    for name in ("S", "Q", "Z", "Z1", "Z2", "Z3", "Z4"):
        p.symmetric(name, 3 * n)
    for name in ("Y1", "Y2"):
        p.matrix(name, 3 * n, 3 * n)
    for name in ("N1", "N2", "N3", "N4"):
        p.matrix(name, 3 * n, n)
    first, second, third = np.eye(7 * n)[:, : 3 * n], np.eye(7 * n)[:, 3 * n : 6 * n], np.eye(7 * n)[:, 6 * n :]
    for k, (z, zz, y, m, mm) in enumerate((("Z1", "Z2", "Y1", "N1", "N2"), ("Z3", "Z4", "Y2", "N3", "N4"))):
        terms = [
            quadratic(z, first),
            quadratic(zz, second),
            quadratic("R", third),
            Term(y, first, second),
            Term(m, first, third),
            Term(mm, second, third),
        ]
        p.positive(f"(8) {k + 1}", terms, traced=True)
    for name, size in (("R", n), ("S", 3 * n), ("Q", 3 * n), ("Z", 3 * n)):
        p.positive(name, [quadratic(name, np.eye(size))], traced=True)
    for i in range(system.cells):
        E, F = system.E[i].T, system.F[i].T
        terms = [quadratic("L1", F)]
        if E.size:
            p.symmetric(f"H{i}", E.shape[1], positive=True)
            terms.append(quadratic(f"H{i}", E, -1.0))
        p.positive(f"(9) cell {i}", terms, traced=True)
        basis = _null_space(system.A[i], system.Ad[i])
        for d in (0.0, 1.0):
            for rate in (-mu, mu) if mu else (0.0,):
                blocks = _psi(n, F, d, rate)
                if cell_terms and E.size:
                    name = f"U{i} d {d:g} rate {rate:g}"
                    p.symmetric(name, E.shape[1], positive=True)
                    blocks.append(quadratic(name, _columns(n, 0, 1) @ E))
                negated = [Term(t.name, -basis.T @ t.left, basis.T @ t.right) for t in blocks]
                p.positive(f"(10) cell {i}, d {d:g}, d' {rate:g}", negated)
    return p


def _columns(n: int, *blocks: int) -> Array:
    return np.hstack([np.kron(np.eye(8)[:, [k]], np.eye(n)) for k in blocks])


def _null_space(A: Array, Ad: Array) -> Array:
    """Return columns that span xi under the dynamics: all but x', which follows from the others."""
    n = A.shape[0]
    basis = _columns(n, 0, 1, 2, 4, 5, 6, 7)
    basis[3 * n : 4 * n, :n], basis[3 * n : 4 * n, n : 2 * n] = A, Ad
    return basis


def _psi(n: int, F: Array, d: float, rate: float) -> list[Term]:
    """Return the terms of psi_i for h = 1."""
    b1, b2, b3, b4, b5, b6, b7, b8 = (_columns(n, k) for k in range(8))
    none, g, remaining = np.zeros_like(b1), 1.0 - rate, 1.0 - d

    def side(*blocks: Array) -> Array:
        return np.hstack(blocks)

    E13, E14 = side(b1, b2, b7), side(b2, b3, b8)
    return [
        Term("L1", side(b1, b2) @ F, side(b4, g * b5) @ F),
        Term("S", side(b3, d * b7, remaining * b8), side(b6, b1 - g * b2, g * b2 - b3)),
        quadratic("Q", side(b1, b4, none)),
        quadratic("Q", side(b2, b5, b1 - b2), -g),
        Term("Q", side(d * b7, b1 - b2, d * (b1 - b7)), side(none, none, b4)),
        quadratic("Z", side(b2, b5, none), g),
        quadratic("Z", side(b3, b6, b2 - b3), -1.0),
        Term("Z", side(remaining * b8, b2 - b3, remaining * (b2 - b8)), side(none, none, g * b5)),
        quadratic("R", b4),
        quadratic("Z1", E13, d),
        quadratic("Z2", E13, d / 3.0),
        Term("N1", E13, b1 - b2),
        Term("N2", E13, 2.0 * b7 - b1 - b2),
        quadratic("Z3", E14, remaining),
        quadratic("Z4", E14, remaining / 3.0),
        Term("N3", E14, b2 - b3),
        Term("N4", E14, 2.0 * b8 - b2 - b3),
    ]
