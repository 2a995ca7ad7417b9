"""Linear models of the rectifier for prediction: the paper's (19) and the corrected ones."""

from __future__ import annotations

import math

from softrig_control.discretise import Matrix, zero_order_hold
from softrig_control.predictive.carima import Carima

from .parameters import RectifierConstants

# Paper eq. (19), V' to v: 2.8286 (s + 175100)/((s + 51.17)(s + 125.7)), highest power first.
SEED19_NUM = (2.8286, 2.8286 * 175100.0)
SEED19_DEN = (1.0, 51.17 + 125.7, 51.17 * 125.7)


def seed19(period: float) -> Carima:
    """Return the paper's (19) sampled with zero-order hold.

    It is the transfer function from V' to v (not from m_i, as printed) with one phase current taken for a DC quantity:
    without the coupling omega L its DC gain, 77.003 V/V, is 10.9 times the true one.
    """
    return Carima.from_continuous(SEED19_NUM, SEED19_DEN, period)


def linearised(p: RectifierConstants) -> tuple[Matrix, Matrix]:
    """Linearise the dq equations of the sensorless structure at the exact operating point.

    States i_d, i_q (A), v (V); input V' (V); replaces (18) and (19)::

        A = [[-R/L, omega, 0], [-omega, -R/L, 0], [1.5 v_rd/(C v), 1.5 v_rq/(C v), -2/(C R_L)]]
        B = [cos(phi)/L, sin(phi)/L, -1.5 cos(phi) I/(C v)]
    """
    v_rd = p.V_g - p.drop * math.cos(p.phi)
    v_rq = -p.drop * math.sin(p.phi)
    k = 1.5 / (p.C * p.v_ref)
    a = ((-p.R / p.L, p.omega, 0.0), (-p.omega, -p.R / p.L, 0.0), (k * v_rd, k * v_rq, -2.0 / (p.C * p.R_L)))
    b = ((math.cos(p.phi) / p.L,), (math.sin(p.phi) / p.L,), (-k * math.cos(p.phi) * p.current,))
    return a, b


def n3(p: RectifierConstants, period: float) -> Carima:
    """Return the corrected third-order model from V' to v."""
    a, b = zero_order_hold(*linearised(p), period)
    return Carima.from_state_space(a, b, (0.0, 0.0, 1.0))


def d2(p: RectifierConstants, period: float) -> Carima:
    """Return the model of the decoupled structure from i* (A) to v.

    The power balance C v v' = 1.5 (V_g i - R i^2 - L i i') - v^2/R_L, linearised, with i going linearly from i*_(k-1)
    to i*_k inside the period::

        v(k+1) = e v(k) + gain (g0 di(k) + g1 di(k-1)),  e = exp(-2 T/(C R_L))
    """
    decay = 2.0 / (p.C * p.R_L)
    rate = 1.5 / (p.C * p.v_ref)
    direct, derivative = rate * (p.V_g - 2.0 * p.R * p.current), -rate * p.L * p.current
    e = math.exp(-decay * period)
    integral = -math.expm1(-decay * period) / decay  # integral of exp(-decay s) over the period
    rising = (1.0 - integral / period) / decay  # of s/T exp(-decay (T - s))
    slope = derivative * integral / period
    return Carima((1.0, -e), (direct * rising + slope, direct * (integral - rising) - slope))
