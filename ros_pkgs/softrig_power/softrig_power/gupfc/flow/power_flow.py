"""Power flow of the line with the GUPFC: Newton's method with the corrected power injections, from every root."""

from __future__ import annotations

import cmath
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from softrig_core import Array, Params, param
from softrig_core.kit import dense

from ..network import BUSES, Network, NetworkParams
from .dual import Dual
from .injection import converter_power, series_power
from .roots import Point, operating_points

UNKNOWNS = 18  # |V| of six buses, their angles, real and imaginary part of V12 and of V34, P_sh, Q_sh
TOLERANCE = 1e-10  # pu
ITERATIONS = 20
SAME = 1e-4  # pu: bus voltages of one operating point


class References(Params):
    """References of the GUPFC: flows out of buses 2 and 4 towards source 1, voltage at bus 1."""

    p1: float = param(1.0, "active power of circuit 1", "pu", ge=-10.0, le=10.0)
    q1: float = param(-0.3, "reactive power of circuit 1", "pu", ge=-10.0, le=10.0)
    p2: float = param(1.0, "active power of circuit 2", "pu", ge=-10.0, le=10.0)
    q2: float = param(-0.4, "reactive power of circuit 2", "pu", ge=-10.0, le=10.0)
    v: float = param(1.0, "voltage of bus 1", "pu", gt=0.0, le=2.0)


@dataclass(frozen=True)
class Solution:
    """A solved operating point; phasors in pu, angles absolute.

    Parameters
    ----------
    iterations : int
        Newton steps taken from the start that led to it.
    mismatch : float
        Largest residual, pu.
    bus : dict of str to complex
        Voltage of A, 1, 2, 3, 4, B.
    v12, v34, v_sh : complex
        Converter voltages, the shunt's behind its transformer.
    i12, i34, i_sh : complex
        Currents from bus 1 to 2, 3 to 4, and out of the shunt converter into bus 1.
    p12, p34 : float
        Active power that the series converters deliver.
    s_sh : complex
        Power of the shunt converter into bus 1.
    sizes : tuple of float
        Larger series voltage of each operating point that these references have, smallest first: this one and those
        that were not taken.
    """

    iterations: int
    mismatch: float
    bus: dict[str, complex]
    v12: complex
    v34: complex
    v_sh: complex
    i12: complex
    i34: complex
    i_sh: complex
    p12: float
    p34: float
    s_sh: complex
    sizes: tuple[float, ...] = ()

    @property
    def flows(self) -> tuple[complex, complex]:
        """Powers out of bus 2 and bus 4 into their lines, P + jQ."""
        return self.bus["2"] * self.i12.conjugate(), self.bus["4"] * self.i34.conjugate()


@dataclass(frozen=True)
class Diverged:
    """No operating point was found, so there are no voltages.

    Parameters
    ----------
    iterations : int
        Newton steps taken.
    mismatch : float
        Largest residual at the last finite step, pu.
    """

    iterations: int
    mismatch: float


class PowerFlow:
    """Newton's method on the 18 equations of network and device.

    Unknowns are magnitude and angle of the six bus voltages, real and imaginary part of V12 and V34, P_sh and Q_sh;
    equations the power balance of each bus (12), the two flows (4), V1 = V_ref and P_sh + P12 + P34 = 0. The injections
    are functions of the voltages in each step: if they are treated as constants, a flat start leads to another root (V1
    = 1.0199).

    A flat start fails for one reachable point in twelve. It diverges, or it ends at another root, or where V3 is 0 and
    the balance of that bus carries no information. So its result is used only if it is the operating point with the
    smallest series voltages. Otherwise Newton's method starts from that point, known in closed form from `roots`.

    Parameters
    ----------
    converter_loss : bool
        Whether the balance holds at the converter's terminal, so that P_sh + P12 + P34 also covers the loss of the
        shunt transformer, as in the plant; the power-injection model of the paper balances at bus 1.
    """

    def __init__(self, params: NetworkParams, converter_loss: bool = False) -> None:
        self.params = params
        self._loss = params.r_sh if converter_loss else 0.0
        network = Network(params)
        self._Y = network.admittance
        # The injections contain the Norton sources of the series transformers, as their impedances are in Y.
        self._source = network.injection

    def solve(self, references: References, tolerance: float = TOLERANCE, surplus: float = 0.0) -> Solution | Diverged:
        """Find the operating point with the smallest series voltages.

        Parameters
        ----------
        tolerance : float
            Largest residual that counts as solved, pu.
        surplus : float
            P_sh + P12 + P34, pu; not zero where the DC link has a source, or harmonics have losses of their own.

        Returns
        -------
        Solution or Diverged
            Diverged when there is no operating point; its numbers are those of the flat start.
        """
        flat = np.zeros(UNKNOWNS)
        flat[:6] = 1.0
        # A flat start may diverge, which is found by its mismatch and is no reason for warnings.
        with np.errstate(over="ignore", invalid="ignore"):
            first = self._newton(flat, references, tolerance, surplus)
        r = references
        points = operating_points(self.params, complex(r.p1, r.q1), complex(r.p2, r.q2), r.v, surplus, self._loss)
        sizes = tuple(point.size for point in points)
        for point in points:
            if isinstance(first, Solution) and point.apart(tuple(first.bus.values())) < SAME:
                return replace(first, sizes=sizes)
            result = self._newton(self._start(point), references, tolerance, surplus)
            if isinstance(result, Solution):
                return replace(result, sizes=sizes)
        return first if isinstance(first, Diverged) else Diverged(first.iterations, first.mismatch)

    @staticmethod
    def _start(point: Point) -> Array:
        sizes, angles = zip(*(cmath.polar(u) for u in point.bus), strict=True)
        device = point.v12.real, point.v12.imag, point.v34.real, point.v34.imag, point.s_sh.real, point.s_sh.imag
        return np.array([*sizes, *angles, *device])

    def _newton(self, x: Array, references: References, tolerance: float, surplus: float) -> Solution | Diverged:
        """Iterate from a start; at most 20 steps."""
        target = [getattr(references, name) for name in ("p1", "q1", "p2", "q2", "v")] + [surplus]
        residual, jacobian = self._equations(x, target)
        mismatch = float(np.abs(residual).max())
        for iteration in range(ITERATIONS):
            if mismatch <= tolerance:
                return self._solution(x, iteration, mismatch)
            try:
                x = x - dense.solve(jacobian, residual)
            except np.linalg.LinAlgError:
                return Diverged(iteration, mismatch)
            residual, jacobian = self._equations(x, target)
            result = float(np.abs(residual).max())
            if not np.isfinite(result):
                return Diverged(iteration + 1, mismatch)
            mismatch = result
        return self._solution(x, ITERATIONS, mismatch) if mismatch <= tolerance else Diverged(ITERATIONS, mismatch)

    def _equations(self, x: Array, target: list[float]) -> tuple[Array, Array]:
        """Return all 18 residuals, shape (18,), and their derivatives, shape (18, 18)."""
        u = Dual(x, np.eye(UNKNOWNS))
        v, a = u[0:6], u[6:12]
        e, f, p_sh, q_sh = u[[12, 14]], u[[13, 15]], u[16], u[17]
        z = self.params.z_se
        apart = a[:, None] - a[None, :]
        G, B = self._Y.real, self._Y.imag
        cos, sin = apart.cos(), apart.sin()
        # power into the network at each bus less what the sources and the device inject
        p = v * ((cos * G + sin * B) * v[None, :]).sum(1) - v * (
            a.cos() * self._source.real + a.sin() * self._source.imag
        )
        q = v * ((sin * G - cos * B) * v[None, :]).sum(1) - v * (
            a.sin() * self._source.real - a.cos() * self._source.imag
        )
        # In front of and behind the two series converters.
        v1, a1, v2, a2 = v[[1, 3]], a[[1, 3]], v[[2, 4]], a[[2, 4]]
        p1, q1 = series_power(v1, a1, e, f, z, -1)
        p2, q2 = series_power(v2, a2, e, f, z, 1)
        flow_p, flow_q = _flow(v1, a1, v2, a2, z)
        flow_p, flow_q = flow_p + p2, flow_q + q2
        loss = self._loss * (p_sh * p_sh + q_sh * q_sh) / (v[1] * v[1])
        surplus = p_sh + loss + converter_power(v1, a1, v2, a2, e, f, z).sum(0)
        balance_p = [p[0], p[1] - p1[0] - p_sh, p[2] - p2[0], p[3] - p1[1], p[4] - p2[1], p[5]]
        balance_q = [q[0], q[1] - q1[0] - q_sh, q[2] - q2[0], q[3] - q1[1], q[4] - q2[1], q[5]]
        controlled = [flow_p[0], flow_q[0], flow_p[1], flow_q[1], v[1], surplus]
        rows = [*balance_p, *balance_q, *(h - wanted for h, wanted in zip(controlled, target, strict=True))]
        return np.array([row.value for row in rows]), np.array([row.slope for row in rows])

    def _solution(self, x: Array, iterations: int, mismatch: float) -> Solution:
        p = self.params
        bus = {name: cmath.rect(x[k], x[6 + k]) for k, name in enumerate(BUSES)}
        v12, v34 = complex(x[12], x[13]), complex(x[14], x[15])
        s_sh = complex(x[16], x[17])
        i_sh = (s_sh / bus["1"]).conjugate()
        p12, p34 = (
            float(converter_power(x[k], x[6 + k], x[k + 1], x[7 + k], v.real, v.imag, p.z_se))
            for k, v in ((1, v12), (3, v34))
        )
        return Solution(
            iterations,
            mismatch,
            bus,
            v12,
            v34,
            bus["1"] + p.z_sh * i_sh,
            (bus["1"] + v12 - bus["2"]) / p.z_se,
            (bus["3"] + v34 - bus["4"]) / p.z_se,
            i_sh,
            p12,
            p34,
            s_sh,
        )


def _flow(v1: Any, a1: Any, v2: Any, a2: Any, z: complex) -> tuple[Any, Any]:
    """P and Q that reach the second bus through the transformer alone, without the injection: V2 ((V1 - V2)/Z)*."""
    g, b = z.real / abs(z) ** 2, z.imag / abs(z) ** 2
    cos, sin = np.cos(a2 - a1), np.sin(a2 - a1)
    return v2 * (v1 * (g * cos - b * sin) - v2 * g), v2 * (v1 * (g * sin + b * cos) - v2 * b)
