r"""Voltage at a trial point from each end, and the objective F(x): corrected and as printed.

Eliminating the current at x from the two equations of the lossy Bergeron section between S and x gives, with
R = r x, Z' = Z + R/4, Z'' = Z - R/4, tau = x/v (equations 9 and 10, corrected):

.. math::
    u_{XS}(t) = \frac{1}{2 Z^2} \Big\{ Z'^2 [u_S(t + \tau) - Z' i_S(t + \tau)]
        + Z''^2 [u_S(t - \tau) + Z'' i_S(t - \tau)] - \frac{R^2}{8} u_S(t) - \frac{R}{2} Z' Z'' i_S(t) \Big\}

u_XR is the same with the quantities of R, R = r (L - x) and the delay T - tau. The objective (12, 13) is the mean of
:math:`|u_{XS} - u_{XR}|` over the samples of the window; printed with the factor 1/(dt (k1 - k0)) in place of
1/(k1 - k0 + 1), which does not move its minimum.

The printed forms, each selectable to see what it does:

- sign: (9) has u_S - Z'' i_S in the second bracket, (10) the right plus;
- coefficient: both have Z'^2 before the second bracket in place of Z''^2;
- resistance: R/8 in place of R^2/8, and R_XS in (10) as well;
- speed: (16) takes C = 3e8 m/s in place of the mode's 1/sqrt(l c).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from softrig_core import Array, jit

from ...lines.section import Section

Equations = Literal[
    "corrected", "printed", "printed_sign", "printed_coefficient", "printed_resistance", "printed_speed"
]
LIGHT = 3e5  # km/s, equation (16)
TAPS = 6  # points of the Lagrange interpolation of fractional delays


class Model(NamedTuple):
    """Line and equations for the compiled objective."""

    length: float  # km
    r: float  # ohm/km
    z: float  # ohm
    v: float  # km/s
    sign: bool  # whether a misprint acts
    coefficient: bool
    resistance: bool


def model(line: Section, equations: Equations = "corrected") -> Model:
    """Prepare the line constants; ``printed`` has the three misprints of (9) and (10), not (16)."""
    wrong = {name: equations in ("printed", f"printed_{name}") for name in ("sign", "coefficient", "resistance")}
    v = LIGHT if equations == "printed_speed" else line.velocity
    return Model(line.length, line.r, line.z, v, **wrong)


@jit
def lagrange(s: float, w: Array) -> None:
    """Weights of the quintic through the points -2 ... 3 at s in [0, 1)."""
    for j in range(6):
        product = 1.0
        for m in range(6):
            if m != j:
                product *= (s - (m - 2)) / (j - m)
        w[j] = product


@jit
def trial_voltage(
    line: Model, end: Array, r: float, delay: float, first: int, misprint_sign: bool, shunt: float, out: Array
) -> None:
    """Write the voltage at the trial point, seen from one end, for the samples from `first` on.

    Parameters
    ----------
    end : ndarray, shape (2, n)
        Modal voltage and current of the end.
    r : float
        Resistance up to the point, ohm.
    delay : float
        Travel time to the point, samples.
    shunt : float
        Factor of u(t): R^2/8 where it is right.
    """
    u, i, z, samples = end[0], end[1], line.z, int(delay)
    w = np.empty(6)
    lagrange(delay - samples, w)
    plus, minus = z + 0.25 * r, z - 0.25 * r
    a = plus * plus
    b = a if line.coefficient else minus * minus
    back = -minus if misprint_sign else minus
    d = 0.5 * r * plus * minus
    scale = 0.5 / (z * z)
    for n in range(out.shape[0]):
        k = first + n
        ahead = k + samples - 2
        behind = k - samples + 2
        u_ahead, i_ahead, u_behind, i_behind = 0.0, 0.0, 0.0, 0.0
        for j in range(6):
            u_ahead += w[j] * u[ahead + j]
            i_ahead += w[j] * i[ahead + j]
            u_behind += w[j] * u[behind - j]
            i_behind += w[j] * i[behind - j]
        out[n] = scale * (a * (u_ahead - plus * i_ahead) + b * (u_behind + back * i_behind) - shunt * u[k] - d * i[k])


@jit
def mismatch(line: Model, ends: Array, first: int, count: int, x: float, tau: float, remaining: float) -> float:
    """Mean of |u_XS - u_XR| over the window, V.

    Parameters
    ----------
    ends : ndarray, shape (4, n)
        Modal u_S, i_S, u_R, i_R.
    first, count : int
        Samples of the window.
    x : float
        Trial point, km from S, 0 <= x <= length.
    tau, remaining : float
        Travel times from S to the point and from the point to R, samples.
    """
    near, far = np.empty(count), np.empty(count)
    r_s, r_r = line.r * x, line.r * (line.length - x)
    shunt_s, shunt_r = r_s * r_s / 8.0, r_r * r_r / 8.0
    if line.resistance:
        shunt_s, shunt_r = r_s / 8.0, r_s / 8.0
    trial_voltage(line, ends[:2], r_s, tau, first, line.sign, shunt_s, near)
    trial_voltage(line, ends[2:], r_r, remaining, first, False, shunt_r, far)
    total = 0.0
    for n in range(count):
        total += abs(near[n] - far[n])
    return total / count


@jit
def objectives(line: Model, ends: Array, rate: float, first: int, count: int, x: Array, out: Array) -> None:
    """Write F at the points x, shape (m,), in km; the delays are fractions of samples."""
    travel = line.length / line.v * rate
    for n in range(x.shape[0]):
        tau = x[n] / line.v * rate
        out[n] = mismatch(line, ends, first, count, x[n], tau, max(travel - tau, 0.0))


@jit
def objectives_integer(line: Model, ends: Array, rate: float, first: int, count: int, out: Array) -> None:
    """Write F at x_n = n v/rate with whole-sample delays, n = 0, 1, ...: the paper's discretisation (15)."""
    travel = line.length / line.v * rate
    for n in range(out.shape[0]):
        out[n] = mismatch(line, ends, first, count, n * line.v / rate, float(n), float(round(travel - n)))
