"""The synchronous machine in rotor coordinates: constants or flux tables, and its equations."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from softrig_core import Array, Params, jit, param

TABLE = 7  # place of the first number of the tables among the constants


class SynchronousConstants(Params):
    """The 2.2 kW, 370 V, 75 Hz, 4.3 A, 14 N m interior magnet machine of the examples of motulator.

    Without a magnet (psi_f = 0) it is a synchronous reluctance machine. Flux tables, as a field computation gives them,
    replace L_d, L_q and psi_f; with `tables` for i_q >= 0 alone the other half is their mirror image.
    """

    R_s: float = param(3.6, "stator resistance R_s", "ohm", gt=0.0, le=1e4)
    L_d: float = param(0.036, "inductance L_d of the direct axis", "H", gt=0.0, le=100.0)
    L_q: float = param(0.051, "inductance L_q of the quadrature axis", "H", gt=0.0, le=100.0)
    psi_f: float = param(0.545, "flux linkage of the magnet psi_f", "Wb", ge=0.0, le=1e3)
    pole_pairs: int = param(3, "pole pairs p", ge=1, le=1000)
    table_i_d: tuple[float, ...] = param(
        (), "flux tables: currents i_d, at equal distances", "A", each=(-1e6, 1e6), max_length=101
    )
    table_i_q: tuple[float, ...] = param(
        (), "flux tables: currents i_q, at equal distances", "A", each=(-1e6, 1e6), max_length=101
    )
    table_psi_d: tuple[float, ...] = param(
        (), "flux tables: psi_d, for each i_d all i_q", "Wb", each=(-1e3, 1e3), max_length=10201
    )
    table_psi_q: tuple[float, ...] = param(
        (), "flux tables: psi_q, for each i_d all i_q", "Wb", each=(-1e3, 1e3), max_length=10201
    )

    def _check(self) -> None:
        sizes = len(self.table_i_d), len(self.table_i_q)
        shape = *sizes, len(self.table_psi_d), len(self.table_psi_q)
        if shape == (0, 0, 0, 0):
            return
        if min(sizes) < 2 or shape[2:] != (sizes[0] * sizes[1],) * 2:
            raise ValueError(
                f"flux tables of {shape[0]} i_d, {shape[1]} i_q, {shape[2]} psi_d, {shape[3]} psi_q: expected at least "
                "two currents of each axis, and i_d times i_q values of each flux linkage"
            )
        for name in ("table_i_d", "table_i_q"):
            axis = getattr(self, name)
            step = (axis[-1] - axis[0]) / (len(axis) - 1)
            if step <= 0.0 or any(abs(b - a - step) > 1e-6 * step for a, b in pairwise(axis)):
                raise ValueError(f"{name}: expected currents that increase by equal steps")
        psi, along_d, along_q = self._slopes()
        if min(along_d[0].min(), along_q[1].min()) <= 0.0:
            raise ValueError("flux tables: expected psi_d to increase with i_d and psi_q with i_q, without a fold")
        # the determinant of the slopes is linear in each current within a cell: its least value is at a corner
        for l_dd, l_qd in (along_d[:, :, :-1], along_d[:, :, 1:]):
            for l_dq, l_qq in (along_q[:, :-1], along_q[:, 1:]):
                if (l_dd * l_qq - l_dq * l_qd).min() <= 0.0:
                    raise ValueError("flux tables: two pairs of currents have the same flux linkages (cross coupling)")
        if self.table_i_q[0] > 0.0:
            raise ValueError(f"table_i_q begins at {self.table_i_q[0]:g} A: expected 0, or currents of both signs")
        if self.table_i_q[0] == 0.0 and np.abs(psi[1][:, 0]).max() > 1e-6 * np.abs(psi[1]).max():
            raise ValueError(
                "table_psi_q: expected 0 at i_q = 0, as the other half of the tables is their mirror image"
            )

    def _slopes(self) -> tuple[Array, Array, Array]:
        """Return the tables as arrays [2, i_d, i_q], and their slopes over i_d and over i_q, H."""
        psi = np.array([self.table_psi_d, self.table_psi_q]).reshape(2, len(self.table_i_d), len(self.table_i_q))
        return (
            psi,
            np.diff(psi, axis=1) / (self.table_i_d[1] - self.table_i_d[0]),
            np.diff(psi, axis=2) / (self.table_i_q[1] - self.table_i_q[0]),
        )

    def least(self) -> float:
        """Return the least inductance, H: of the tables, the least slope along its own axis."""
        if not self.table_i_d:
            return min(self.L_d, self.L_q)
        _, along_d, along_q = self._slopes()
        return float(min(along_d[0].min(), along_q[1].min()))

    def edges(self) -> tuple[float, float, float, float]:
        """Return the least and the largest i_d and i_q of the tables, A; infinite without tables."""
        if not self.table_i_d:
            return (-math.inf, math.inf, -math.inf, math.inf)
        i_d, i_q = self.table_i_d, self.table_i_q
        return (i_d[0], i_d[-1], -i_q[-1] if i_q[0] == 0.0 else i_q[0], i_q[-1])

    def numbers(self, r_on: float) -> Array:
        """Return the constants in the order of `linkage` and `rates`; the resistance includes that of the inverter."""
        i_d, i_q = self.table_i_d, self.table_i_q
        head = [self.R_s + r_on, self.L_d, self.L_q, self.psi_f, float(self.pole_pairs), len(i_d), len(i_q)]
        if not i_d:
            return np.array(head)
        axes = [i_d[0], (i_d[-1] - i_d[0]) / (len(i_d) - 1), i_q[0], (i_q[-1] - i_q[0]) / (len(i_q) - 1)]
        return np.array([*head, *axes, *self.table_psi_d, *self.table_psi_q])

    def at_rest(self) -> float:
        """Return psi_d without current, Wb."""
        return linkage(0.0, 0.0, self.numbers(0.0))[0]


@jit
def linkage(i_d: float, i_q: float, m: Any) -> tuple[float, float, float, float, float, float]:
    """Return psi_d, psi_q (Wb) and their slopes over i_d and i_q: l_dd, l_dq, l_qd, l_qq (H).

    ::

        psi_d = L_d i_d + psi_f,  psi_q = L_q i_q

    or, of tables, the bilinear interpolation of the cell in which the currents are; beyond the edge the last cell's.
    """
    n_d, n_q = int(m[5]), int(m[6])
    if n_d == 0:
        return m[1] * i_d + m[3], m[2] * i_q, m[1], 0.0, 0.0, m[2]
    mirrored = m[9] >= 0.0 and i_q < 0.0
    x, y = (i_d - m[7]) / m[8], ((-i_q if mirrored else i_q) - m[9]) / m[10]
    row, column = min(max(int(x), 0), n_d - 2), min(max(int(y), 0), n_q - 2)
    x, y = x - row, y - column
    index = TABLE + 4 + row * n_q + column
    a, b, c, d = m[index], m[index + 1], m[index + n_q], m[index + n_q + 1]
    index = index + n_d * n_q
    e, f, g, h = m[index], m[index + 1], m[index + n_q], m[index + n_q + 1]
    psi_d = (1.0 - x) * ((1.0 - y) * a + y * b) + x * ((1.0 - y) * c + y * d)
    psi_q = (1.0 - x) * ((1.0 - y) * e + y * f) + x * ((1.0 - y) * g + y * h)
    l_dd, l_dq = ((1.0 - y) * (c - a) + y * (d - b)) / m[8], ((1.0 - x) * (b - a) + x * (d - c)) / m[10]
    l_qd, l_qq = ((1.0 - y) * (g - e) + y * (h - f)) / m[8], ((1.0 - x) * (f - e) + x * (h - g)) / m[10]
    return (psi_d, -psi_q, l_dd, -l_dq, -l_qd, l_qq) if mirrored else (psi_d, psi_q, l_dd, l_dq, l_qd, l_qq)


@jit
def outputs_of(i_d: float, i_q: float, _2: float, _3: float, theta: float, m: Any) -> tuple[float, float, float]:
    """Return i_alpha, i_beta (A) and the torque T = 3/2 p (psi_d i_q - psi_q i_d), N m."""
    psi_d, psi_q = linkage(i_d, i_q, m)[:2]
    c, s = math.cos(m[4] * theta), math.sin(m[4] * theta)
    return c * i_d - s * i_q, s * i_d + c * i_q, 1.5 * m[4] * (psi_d * i_q - psi_q * i_d)


@jit
def rates(
    i_d: float, i_q: float, _2: float, _3: float, theta: float, omega: float, u_alpha: float, u_beta: float, m: Any
) -> tuple[float, float, float, float, float, float, float]:
    """Return the rates of i_d, i_q (A/s, two places are empty), T (N m), i_alpha and i_beta (A).

    ::

        psi_d' = u_d - R_s i_d + p omega psi_q
        psi_q' = u_q - R_s i_q - p omega psi_d
        T      = 3/2 p (psi_d i_q - psi_q i_d)

    The state is the currents: L i' = psi', L the matrix of slopes of `linkage`.
    """
    p = m[4]
    c, s, w = math.cos(p * theta), math.sin(p * theta), p * omega
    psi_d, psi_q, l_dd, l_dq, l_qd, l_qq = linkage(i_d, i_q, m)
    d = c * u_alpha + s * u_beta - m[0] * i_d + w * psi_q
    q = c * u_beta - s * u_alpha - m[0] * i_q - w * psi_d
    per = 1.0 / (l_dd * l_qq - l_dq * l_qd)
    torque = 1.5 * p * (psi_d * i_q - psi_q * i_d)
    return (
        (l_qq * d - l_dq * q) * per, (l_dd * q - l_qd * d) * per, 0.0, 0.0, torque, c * i_d - s * i_q, s * i_d + c * i_q
    )  # fmt: skip
