r"""All operating points of line and device for given references, as starts of Newton's method.

The device cuts the line in two. Beyond it, buses 2, 4 and B see two prescribed powers; before it, buses A, 1 and 3 see
the currents that follow, and the shunt current. With y_s, y_m of a half line and y_g of a source,
:math:`\beta = y_m/(y_g + 2 y_s)`, :math:`a = y_s - y_m \beta`, :math:`b = y_m \beta` and
:math:`k = y_m y_g E/(y_g + 2 y_s)`:

.. math::
    I_{12} &= a V_2 - b V_4 + k_B, & I_{34} &= a V_4 - b V_2 + k_B, & S_1 &= V_2 I_{12}^*, & S_2 &= V_4 I_{34}^* \\
    I_{sh} &= y V_1 + j, & V_3 &= (b V_1 - k_A - I_{34})/a, & y &= a - b^2/a, &
    j &= k_A (1 + b/a) + I_{12} + I_{34} b/a

The balance of powers is then :math:`K + V \Re(e^{i\varphi} w) = P_0` for :math:`V_1 = V e^{i\varphi}`: two angles, or
none. The four equations of the far side decouple for :math:`V_2 = V_4`; from the two times two roots of these
quadratic equations the true coupling is put in step by step.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from softrig_core.kit import dense

from ..network import NetworkParams

# The coupling is added in steps, so that Newton's method stays near the root that it follows.
STEPS = 8
ITERATIONS = 30
HALVINGS = 12
SOLVED = 1e-11  # pu
TINY = 1e-9  # pu: a voltage like this carries no power
APART = 1e-6  # pu: roots nearer to each other are one


class Point(NamedTuple):
    """An operating point: bus voltages A, 1, 2, 3, 4, B, voltages of the series converters, power of the shunt, pu."""

    bus: tuple[complex, ...]
    v12: complex
    v34: complex
    s_sh: complex

    def apart(self, bus: tuple[complex, ...]) -> float:
        """Largest distance of the bus voltages from others, pu."""
        return max(abs(m - n) for m, n in zip(self.bus, bus, strict=True))

    @property
    def size(self) -> float:
        """The larger one of the two series voltages, pu."""
        return max(abs(self.v12), abs(self.v34))


def operating_points(
    p: NetworkParams, s1: complex, s2: complex, v: float, surplus: float = 0.0, r_sh: float = 0.0
) -> list[Point]:
    """Find the operating points, smallest series voltage first.

    Parameters
    ----------
    s1, s2 : complex
        Powers out of buses 2 and 4 into their lines, pu.
    v : float
        Magnitude at bus 1, pu.
    surplus : float
        P_sh + P12 + P34 and the loss, pu.
    r_sh : float
        Resistance whose loss the balance covers, pu.

    Returns
    -------
    list of Point
        Empty when none was found.
    """
    half = p.half.exact_two_port(p.omega)
    y_s, y_m = complex(half[0, 0]), complex(half[0, 1])
    r, l = p.source_impedance  # noqa: E741
    y_g = 1.0 / complex(r, p.omega * l)
    ground = y_g + 2.0 * y_s
    beta = y_m / ground
    a, b = y_s - y_m * beta, y_m * beta
    e_a, e_b = (y_g * e / ground for e in p.sources)  # values of A and B with both lines at zero
    k_a, k_b = y_m * e_a, y_m * e_b
    y = a - b * b / a
    results: list[Point] = []
    for v2, v4 in _far_side(a, b, k_b, s1, s2):
        i12, i34 = (s1 / v2).conjugate(), (s2 / v4).conjugate()
        j = k_a * (1.0 + b / a) + i12 + i34 * b / a
        w = (j - i12).conjugate() - i34.conjugate() * b / a + 2.0 * r_sh * y * j.conjugate()
        series = (v2 + p.z_se * i12) * i12.conjugate() + (v4 + p.z_se * i34 + (k_a + i34) / a) * i34.conjugate()
        constant = (y.real + r_sh * abs(y) ** 2) * v * v + series.real + r_sh * abs(j) ** 2
        # The balance does not depend on the angle here, so it determines none.
        if abs(w) < TINY:
            continue
        cosine = (surplus - constant) / (v * abs(w))
        # No angle balances the powers; the form also excludes NaN.
        if not abs(cosine) <= 1.0:
            continue
        for side in (1.0, -1.0):
            v1 = cmath.rect(v, side * math.acos(cosine) - cmath.phase(w))
            v3 = (b * v1 - k_a - i34) / a
            point = Point(
                (e_a - beta * (v1 + v3), v1, v2, v3, v4, e_b - beta * (v2 + v4)),
                v2 - v1 + p.z_se * i12,
                v4 - v3 + p.z_se * i34,
                v1 * (y * v1 + j).conjugate(),
            )
            if all(point.apart(q.bus) > APART for q in results):
                results.append(point)
    return sorted(results, key=lambda q: q.size)


def _far_side(a: complex, b: complex, k: complex, s1: complex, s2: complex) -> Iterator[tuple[complex, complex]]:
    """Yield V2, V4 of the roots of S1 = V2 (a V2 - b V4 + k)*, S2 = V4 (a V4 - b V2 + k)*."""
    for v2, v4 in product(_alone(a - b, k, s1), _alone(a - b, k, s2)):
        for step in range(1, STEPS + 1):
            v2, v4, remaining = _newton(a, b, step / STEPS, k, s1, s2, v2, v4)
        if remaining <= SOLVED and min(abs(v2), abs(v4)) > TINY:
            yield v2, v4


def _alone(a: complex, k: complex, s: complex) -> list[complex]:
    """Return the roots of S = V (a V + k)*; if there are none, the point between them."""
    # k V* = S* - a m with m = |V|^2, so |S* - a m|^2 = |k|^2 m
    half = (a * s).real + 0.5 * abs(k) ** 2
    remaining = half * half - abs(a * s) ** 2
    span = math.sqrt(max(remaining, 0.0))
    squares = {(half + span) / abs(a) ** 2, (half - span) / abs(a) ** 2}
    return [((s.conjugate() - a * m) / k).conjugate() for m in sorted(squares, reverse=True)]


def _newton(
    a: complex, b: complex, share: float, k: complex, s1: complex, s2: complex, v2: complex, v4: complex
) -> tuple[complex, complex, float]:
    """Solve with a share of the coupling, and the rest as if both voltages were equal; return the mismatch too."""
    diag, off = a - b * (1.0 - share), -b * share

    def mismatch(v2: complex, v4: complex) -> tuple[complex, complex]:
        return (
            v2 * (diag * v2 + off * v4 + k).conjugate() - s1,
            v4 * (diag * v4 + off * v2 + k).conjugate() - s2,
        )

    f1, f2 = mismatch(v2, v4)
    size = max(abs(f1), abs(f2))
    for _ in range(ITERATIONS):
        if size <= SOLVED:
            break
        i12, i34 = diag * v2 + off * v4 + k, diag * v4 + off * v2 + k
        straight = ((i12.conjugate(), 0j), (0j, i34.conjugate()))  # of dV, beside those of dV*
        turned = (
            (v2 * diag.conjugate(), v2 * off.conjugate()),
            (v4 * off.conjugate(), v4 * diag.conjugate()),
        )
        matrix = np.zeros((4, 4))
        for i, n in product(range(2), range(2)):
            both, apart = straight[i][n] + turned[i][n], straight[i][n] - turned[i][n]
            matrix[2 * i : 2 * i + 2, 2 * n : 2 * n + 2] = [[both.real, -apart.imag], [both.imag, apart.real]]
        try:
            d = dense.solve(matrix, [f1.real, f1.imag, f2.real, f2.imag])
        except np.linalg.LinAlgError:
            break
        step = 1.0
        for _ in range(HALVINGS):
            new = v2 - step * complex(d[0], d[1]), v4 - step * complex(d[2], d[3])
            g1, g2 = mismatch(*new)
            if max(abs(g1), abs(g2)) < size:
                break
            step *= 0.5
        else:
            break
        (v2, v4), f1, f2 = new, g1, g2
        size = max(abs(f1), abs(f2))
    return v2, v4, size
