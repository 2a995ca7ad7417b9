"""Certificates for constant delays in rational arithmetic: the criterion, implemented again, holds by exact pivots."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
from softrig_systems.pwa_delay.proof.certify import Criterion, certify
from softrig_systems.pwa_delay.system import from_lines, switched

BITS = 44  # The solver's matrices are rounded to multiples of 2**-44, far below their margin t of 7e-9.
TALL, WIDE = [[0, 5], [-1, 0]], [[0, 1], [-5, 0]]
LINES = [[1, -1], [1, 1]]


def rational(matrix):
    return np.array([[Fraction(round(v * 2**BITS), 2**BITS) for v in row] for row in matrix.tolist()], dtype=object)


def exact(rows):
    return np.array([[Fraction(v) for v in row] for row in rows], dtype=object)


def positive(matrix):
    """Return whether a symmetric matrix is positive definite, exactly: all pivots of the elimination are positive."""
    m = matrix.copy()
    for k in range(len(m)):
        if m[k, k] <= 0:
            return False
        for i in range(k + 1, len(m)):
            if m[i, k]:
                m[i] = m[i] - m[i, k] / m[k, k] * m[k]
    return True


def cells(both):
    """Return the rows of each cell's conditions, its hinges, and its matrix of the delayed state, of P1."""
    zero = [[0, 0]] * 2
    rows = [[*now, *late] for now, late in zip(LINES, zero, strict=True)]
    if both:  # the signs of the delayed state select cells as well
        rows += [[*now, *late] for now, late in zip(zero, LINES, strict=True)]
    for signs in itertools.product((-1, 1), repeat=len(rows)):
        conditions = exact([[s * v for v in row] for s, row in zip(signs, rows, strict=True)])
        hinges = exact([row if s > 0 else [0] * 4 for s, row in zip(signs, rows, strict=True)])
        yield conditions, hinges, exact(TALL if signs[0] == signs[1] else WIDE)


def failures(result, h, order, both):
    """Return the inequalities of the criterion that do not hold exactly at the delay h, a Fraction.

    V = eta' L eta + int (x, x')' Q (x, x') + int int x'' R x', eta = (features, Omega_0 ... ), after Seuret and
    Gouaisbaut 2015, theorem 5, with cells: over a cell, V less [x; x_d]' E' H E [x; x_d] is positive, and its
    derivative plus [x; x_d]' E' U E [x; x_d] is negative, H and U entrywise >= 0.
    """
    m = {name: rational(matrix) for name, matrix in result.items()}
    assert all((matrix == matrix.T).all() for matrix in m.values())
    unit = exact(np.eye((3 + order) * 2, dtype=int).tolist())
    x, late, late_slope, *omega = (unit[:, 2 * k : 2 * k + 2] for k in range(3 + order))
    zeta = [  # integral of P_k(s) x'(s) by parts, with P_k' = sum of 2 (2 j + 1) P_j over j = k - 1, k - 3, ...
        x - (-1) ** k * late - sum((2 * (2 * j + 1) * omega[j] for j in range(k - 1, -1, -2)), 0 * x)
        for k in range(order + 1)
    ]
    now = np.hstack([x, late])
    without_slope = np.r_[0:4, 6 : len(unit)]  # V does not depend on x_d'

    def form(name, left, right=None):
        return left @ m[name] @ (left if right is None else right).T

    wrong = [name for name in "QR" if not positive(m[name])]
    for i, (rows, hinges, delayed) in enumerate(cells(both)):
        wrong += [f"{name}{i}" for name in "HU" if f"{name}{i}" in m and np.any(m[f"{name}{i}"] < 0)]
        features = np.vstack([hinges, exact(np.eye(4, dtype=int).tolist())])
        slope = h * (x * Fraction(-1, 10) + late @ delayed.T)
        eta = np.hstack([now @ features.T, *omega])
        rate = np.hstack([np.hstack([slope, late_slope]) @ features.T, *zeta[:order]])
        v = form("L", eta) - form(f"H{i}", now @ rows.T)
        v = v + sum((2 * k + 1) * form("Q", np.hstack([omega[k], zeta[k]])) for k in range(order))
        fall = form("L", eta, rate) + form("L", rate, eta) + form("R", slope)
        fall = fall + form("Q", np.hstack([x, slope])) - form("Q", np.hstack([late, late_slope]))
        fall = fall - sum((2 * k + 1) * form("R", zeta[k]) for k in range(order + 1))
        if f"U{i}" in m:
            fall = fall + form(f"U{i}", now @ rows.T)
        wrong += [f"V {i}"] if not positive(v[np.ix_(without_slope, without_slope)]) else []
        wrong += [f"V' {i}"] if not positive(-fall) else []
    return wrong


def test_a_certificate_holds_in_rational_arithmetic():
    certificate = certify(switched(), 0.019, Criterion("constant", order=1), sliding=False)
    assert certificate.valid
    assert failures(certificate.matrices, Fraction(19, 1000), 1, both=False) == []
    assert failures(certificate.matrices, Fraction(20, 1000), 1, both=False) == [f"V' {i}" for i in range(4)]
    assert (
        failures(certificate.matrices | {"R": -certificate.matrices["R"]}, Fraction(19, 1000), 1, both=False)[0] == "R"
    )


@pytest.mark.long
@pytest.mark.parametrize("order", [4, 5])
def test_the_published_0_0195_is_certified_in_rational_arithmetic(order):
    """The stretch: 16 cells by x and x_d; the margins of the solver are 2e-8 (refused in floats) and 7e-9."""
    system = from_lines([-0.1 * np.eye(2)] * 16, [m for m in (TALL, WIDE, WIDE, TALL) for _ in range(4)], LINES, LINES)
    certificate = certify(system, 0.0195, Criterion("constant", order=order, cell_terms=True))
    assert certificate.valid is (order == 5)
    assert failures(certificate.matrices, Fraction(195, 10000), order, both=True) == []
    assert failures(certificate.matrices, Fraction(196, 10000), order, both=True) != []
