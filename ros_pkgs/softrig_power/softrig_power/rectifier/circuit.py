"""What the three plant models share: constants and commands of one control period, modulator, limit."""

from __future__ import annotations

import math
from typing import NamedTuple

from softrig_core import jit

SPWM = 1.0  # largest |v_r| as a multiple of v/2
INJECTION = 2.0 / math.sqrt(3.0)  # with min-max zero-sequence injection


class Circuit(NamedTuple):
    """Constants: omega (rad/s), L (H), R (ohm), C (F), cosine and sine of phi, the angle of R + j omega L."""

    omega: float
    L: float
    R: float
    C: float
    cos_phi: float
    sin_phi: float

    @staticmethod
    def of(omega: float, L: float, R: float, C: float, phi: float) -> Circuit:
        """Create it for the angle phi (rad)."""
        return Circuit(omega, L, R, C, math.cos(phi), math.sin(phi))


class Period(NamedTuple):
    """Constant inputs over one control period from `start` (s) for `length` (s).

    Attributes
    ----------
    amplitude, fifth : float
        Grid phase amplitude and its fifth harmonic a5, V peak.
    load : float
        R_L in ohm.
    reach : float
        Largest |v_r| as a multiple of v/2.
    forward : float
        Share of the fifth harmonic that the modulator adds: 1 instantaneous feed-forward, 0 fundamental only.
    decoupled : bool
        Structure.
    before, command : float
        Sensorless: `command` is V' in V. Decoupled: current reference in A at the end of the last period and of this.
    """

    start: float
    length: float
    amplitude: float
    fifth: float
    load: float
    reach: float
    forward: float
    decoupled: bool
    before: float
    command: float


@jit
def wanted(t: float, circuit: Circuit, period: Period) -> tuple[float, float]:
    """Return the converter voltage (v_rd, v_rq) that the modulator is to form at t, before its limit.

    Sensorless (paper eq. (13) multiplied out; d on the grid voltage, q leads by 90 degrees)::

        v_rd = V_g - V' cos(phi),  v_rq = -V' sin(phi)

    Decoupled, with i* ramped linearly inside the period, so that i_d = i* exactly for nominal parameters::

        v_rd = V_g - R i* - L di*/dt,  v_rq = -omega L i*

    V_g is the measured grid amplitude. A measured fifth harmonic, a negative sequence, adds
    -a5 cos(6 omega t), a5 sin(6 omega t).
    """
    if period.decoupled:
        slope = (period.command - period.before) / period.length
        i = period.before + slope * (t - period.start)
        v_rd = period.amplitude - circuit.R * i - circuit.L * slope
        v_rq = -circuit.omega * circuit.L * i
    else:
        v_rd = period.amplitude - period.command * circuit.cos_phi
        v_rq = -period.command * circuit.sin_phi
    if period.fifth != 0.0 and period.forward != 0.0:
        sixth = 6.0 * circuit.omega * t
        v_rd -= period.forward * period.fifth * math.cos(sixth)
        v_rq += period.forward * period.fifth * math.sin(sixth)
    return v_rd, v_rq


@jit
def limited(v_rd: float, v_rq: float, v: float, reach: float) -> tuple[float, float]:
    """Scale a voltage vector to |v_r| <= reach v/2, keeping its angle."""
    size = math.sqrt(v_rd * v_rd + v_rq * v_rq)
    largest = reach * 0.5 * v
    if size > largest:
        scale = largest / size
        return v_rd * scale, v_rq * scale
    return v_rd, v_rq


@jit
def phases(d: float, q: float, angle: float) -> tuple[float, float, float]:
    """Return x_a, x_b, x_c of a dq vector at an angle: x_a = d sin(angle) + q cos(angle), b and c 120 deg later."""
    return phases_of(d, q, math.sin(angle), math.cos(angle))


@jit
def phases_of(d: float, q: float, s: float, c: float) -> tuple[float, float, float]:
    """See `phases`, of sine and cosine of the angle."""
    x_a = d * s + q * c
    quarter = 0.5 * math.sqrt(3.0) * (q * s - d * c)
    return x_a, -0.5 * x_a + quarter, -0.5 * x_a - quarter


@jit
def turned(a: float, b: float, c: float, angle: float) -> tuple[float, float]:
    """Return the dq vector of three phases, the inverse of `phases`."""
    s, k = math.sin(angle), math.cos(angle)
    beta = (b - c) / math.sqrt(3.0)
    alpha = (2.0 * a - b - c) / 3.0
    return alpha * s - beta * k, alpha * k + beta * s


@jit
def grid(t: float, circuit: Circuit, period: Period) -> tuple[float, float, float]:
    """Return the grid voltages of the three phases at t: V_g sin(x) + a5 sin(5 x), x = omega t - k 2 pi/3."""
    angle = circuit.omega * t
    return grid_of(angle, math.sin(angle), math.cos(angle), period)


@jit
def grid_of(angle: float, s: float, c: float, period: Period) -> tuple[float, float, float]:
    """See `grid`, of omega t, its sine and its cosine."""
    v_a, v_b, v_c = phases_of(period.amplitude, 0.0, s, c)
    if period.fifth != 0.0:
        # The fifth harmonic has negative sequence, so b and c change places.
        h_a, h_c, h_b = phases(period.fifth, 0.0, 5.0 * angle)
        return v_a + h_a, v_b + h_b, v_c + h_c
    return v_a, v_b, v_c
