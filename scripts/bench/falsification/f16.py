"""An aircraft that must not meet the ground: F16 of ARCH-COMP, whose start is searched.

Equations: Stevens and Lewis, "Aircraft Control and Simulation", 2nd edition, appendix A: engine, atmosphere, table of
damping, body. Aerodynamic polynomials: Morelli, "Global nonlinear parametric modeling with application to F-16
aerodynamics", ACC 1998. Inner loop (LQR with three integrators), autopilot (roll level, then pull) and start: Heidlauf,
Collins, Bolender and Bak, "Verification challenges in F-16 ground collision avoidance and other automated maneuvers",
ARCH 2018; gains and numbers as read in its public Python version, whose code is not used. As there, the table of
damping is added to the polynomials, which have one of their own. Requirement and ranges: Ernst et al., "ARCH-COMP
falsification category"; both, and the altitude of 2338 ft, as in the public MoonLightSuite/arch-comp-benchmarks
(models/F16, initF16.m). Scripts of other tools begin at 4040 ft, psy-taliro's example at 2330. Written anew; RK4 of
10 ms, modes once a step.
"""

from __future__ import annotations

from math import cos, pi, sin, tan

import numpy as np
from numba import njit
from softrig_core import Array

from .transmission import _place

DURATION, STEP, EVERY = 15.0, 0.01, 5  # s, s, steps for each sample
SPEED, ALPHA, ALTITUDE, POWER = 540.0, np.deg2rad(2.1215), 2338.0, 9.0  # at the start: ft/s, rad, ft, %
# Ft^2, ft, ft, ft/s^2, and ft in front of the centre of gravity.
AREA, SPAN, CHORD, G, PILOT = 300.0, 30.0, 11.32, 32.17, 15.0
PER_MASS, MOMENTUM, DENSITY = 1.57e-3, 160.0, 2.377e-3  # 1/slug, slug ft^2/s of the engine, slug/ft^3
C = np.array([0.0, -0.770, 0.02755, 1.055e-4, 1.642e-6, 0.9604, 1.759e-2, 1.792e-5, -0.7336, 1.587e-5])

ANGLES = np.arange(-10.0, 46.0, 5.0)  # angles of attack, deg
DAMPING = np.array(
    [
        [-0.267, -0.110, 0.308, 1.34, 2.08, 2.91, 2.76, 2.05, 1.50, 1.49, 1.83, 1.21],  # CXq
        [0.882, 0.852, 0.876, 0.958, 0.962, 0.974, 0.819, 0.483, 0.590, 1.21, -0.493, -1.04],  # CYr
        [-0.108, -0.108, -0.188, 0.110, 0.258, 0.226, 0.344, 0.362, 0.611, 0.529, 0.298, -2.27],  # CYp
        [-8.80, -25.8, -28.9, -31.4, -31.2, -30.7, -27.7, -28.2, -29.0, -29.8, -38.3, -35.3],  # CZq
        [-0.126, -0.026, 0.063, 0.113, 0.208, 0.230, 0.319, 0.437, 0.680, 0.100, 0.447, -0.330],  # Clr
        [-0.360, -0.359, -0.443, -0.420, -0.383, -0.375, -0.329, -0.294, -0.230, -0.210, -0.120, -0.100],  # Clp
        [-7.21, -0.540, -5.23, -5.26, -6.11, -6.64, -5.69, -6.00, -6.20, -6.40, -6.60, -6.00],  # Cmq
        [-0.380, -0.363, -0.378, -0.386, -0.370, -0.453, -0.550, -0.582, -0.595, -0.637, -1.02, -0.840],  # Cnr
        [0.061, 0.052, 0.052, -0.012, -0.013, -0.024, 0.050, 0.150, 0.130, 0.158, 0.240, 0.150],  # Cnp
    ]
)
HEIGHTS, MACHS = np.arange(0.0, 50001.0, 10000.0), np.arange(0.0, 1.01, 0.2)  # ft, Mach number
THRUST = np.array(
    [
        [
            [1060.0, 670, 880, 1140, 1500, 1860],
            [635, 425, 690, 1010, 1330, 1700],
            [60, 25, 345, 755, 1130, 1525],
            [-1020, -170, -300, 350, 910, 1360],
            [-2700, -1900, -1300, -247, 600, 1100],
            [-3600, -1400, -595, -342, -200, 700],
        ],
        [
            [12680, 9150, 6200, 3950, 2450, 1400],
            [12680, 9150, 6313, 4040, 2470, 1400],
            [12610, 9312, 6610, 4290, 2600, 1560],
            [12640, 9839, 7090, 4660, 2840, 1660],
            [12390, 10176, 7750, 5320, 3250, 1930],
            [11680, 9848, 8050, 6100, 3800, 2310],
        ],
        [
            [20000, 15000, 10800, 7000, 4000, 2500],
            [21420, 15700, 11225, 7323, 4435, 2600],
            [22700, 16860, 12250, 8154, 5000, 2835],
            [24240, 18910, 13760, 9285, 5700, 3215],
            [26070, 21075, 15975, 11115, 6860, 3950],
            [28886, 23319, 18300, 13484, 8642, 5057],
        ],
    ]
)  # fmt: skip; lb, idle, military and full, each over mach and altitude

TRIM_ALPHA, TRIM_THROTTLE, TRIM_ELEVATOR = 0.0389, 0.1395, -0.7496  # rad, share of full throttle, deg
# Gains of alpha, q and the integral of Nz, to deg.
K_LONG = np.array([-156.8801506723475, -31.037008068526642, -38.72983346216317])
K_LAT = np.array(
    [[37.84483, -25.40956, -6.82876, -332.88343, -17.15997], [-23.91233, 5.69968, -21.63431, 64.4949, -88.36203]]
)  # beta, p, r, integrals of ps and of Ny + r; deg of aileron and rudder
ROLL_P, ROLL_D, PULL, DECK, PULLED = 4.0, 2.0, 5.0, 1000.0, 2.0  # 1/s, 1, g, ft, s that a pull lasts at least
LEVEL, STILL = np.deg2rad(5.0), np.deg2rad(10.0)  # rad, rad/s
STANDBY, ROLLING, PULLING = 0, 1, 2

REQUIREMENTS = {"F16": "always[0, 15] altitude > 0"}
INPUTS = (
    ("roll", pi / 4 - pi / 20, pi / 4 + pi / 30, 1),
    ("pitch", -2 * pi / 5, -2 * pi / 5 + pi / 20, 1),
    ("yaw", -pi / 4 - pi / 8, -pi / 4 + pi / 8, 1),
)


@njit(cache=True)  # type: ignore[untyped-decorator]
def polynomials(
    a: float, b: float, e: float, w: float, d: float, p: float, q: float, r: float
) -> tuple[float, float, float, float, float, float]:
    """Cx, Cy, Cz, Cl, Cm, Cn at angles (rad) of attack, sideslip, elevator, aileron, rudder and at reduced rates."""
    a2, a3, a4 = a**2, a**3, a**4
    cx = (
        -1.943367e-2
        + 2.136104e-1 * a
        - 2.903457e-1 * e**2
        - 3.348641e-3 * e
        - 2.060504e-1 * a * e
        + 6.988016e-1 * a2
        - 9.035381e-1 * a3
        + (4.833383e-1 + 8.644627 * a + 11.31098 * a2 - 74.22961 * a3 + 60.75776 * a4) * q
    )
    cy = (
        -1.145916 * b
        + 6.016057e-2 * w
        + 1.642479e-1 * d
        + (-1.006733e-1 + 8.679799e-1 * a + 4.260586 * a2 - 6.923267 * a3) * p
        + (8.071648e-1 + 1.189633e-1 * a + 4.177702 * a2 - 9.162236 * a3) * r
    )
    cz = (
        (-1.378278e-1 - 4.211369 * a + 4.775187 * a2 - 10.26225 * a3 + 8.399763 * a4) * (1.0 - b**2)
        - 4.354e-1 * e
        + (-30.54956 - 41.32305 * a + 329.2788 * a2 - 684.8038 * a3 + 408.0244 * a4) * q
    )
    cl = (-1.05853e-1 * b - 5.776677e-1 * a * b - 1.672435e-2 * a2 * b + 1.357256e-1 * b**2 + 2.172952e-1 * a * b**2
          + 3.464156 * a3 * b - 2.835451 * a4 * b - 1.098104 * a2 * b**2
          + (-4.126806e-1 - 1.189974e-1 * a + 1.247721 * a2 - 7.391132e-1 * a3) * p
          + (6.250437e-2 + 6.067723e-1 * a - 1.101964 * a2 + 9.100087 * a3 - 11.92672 * a4) * r
          + (-1.463144e-1 - 4.07391e-2 * a + 3.253159e-2 * b + 4.851209e-1 * a2 + 2.97885e-1 * a * b
             - 3.746393e-1 * a2 * b - 3.213068e-1 * a3) * w
          + (2.635729e-2 - 2.19291e-2 * a - 3.152901e-3 * b - 5.817803e-2 * a * b + 4.516159e-1 * a2 * b
             - 4.928702e-1 * a3 * b - 1.579864e-2 * b**2) * d)  # fmt: skip
    cm = (
        -2.02937e-2
        + 4.660702e-2 * a
        - 6.012308e-1 * e
        - 8.062977e-2 * a * e
        + 8.320429e-2 * e**2
        + 5.018538e-1 * a2 * e
        + 6.378864e-1 * e**3
        + 4.226356e-1 * a * e**2
        + (-5.19153 - 3.554716 * a - 35.98636 * a2 + 224.7355 * a3 - 412.0991 * a4 + 241.175 * a**5) * q
    )
    cn = (2.993363e-1 * b + 6.594004e-2 * a * b - 2.003125e-1 * b**2 - 6.233977e-2 * a * b**2 - 2.107885 * a2 * b
          + 2.14142 * a2 * b**2 + 8.476901e-1 * a3 * b
          + (2.677652e-2 - 3.298246e-1 * a + 1.926178e-1 * a2 + 4.013325 * a3 - 4.404302 * a4) * p
          + (-3.698756e-1 - 1.167551e-1 * a - 7.641297e-1 * a2) * r
          + (-3.348717e-2 + 4.276655e-2 * a + 6.573646e-3 * b + 3.535831e-1 * a * b - 1.373308 * a2 * b
             + 1.237582 * a3 * b + 2.302543e-1 * a2 - 2.512876e-1 * a3 + 1.588105e-1 * b**3
             - 5.199526e-1 * a * b**3) * w
          + (-8.115894e-2 - 1.15658e-2 * a + 2.514167e-2 * b + 2.038748e-1 * a * b - 3.337476e-1 * a2 * b
             + 1.004297e-1 * a2) * d)  # fmt: skip
    return cx, cy, cz, cl, cm, cn


@njit(cache=True)  # type: ignore[untyped-decorator]
def _thrust(power: float, height: float, mach: float) -> float:
    """Thrust, lb."""
    i, a = _place(max(height, 0.01), HEIGHTS)
    j, b = _place(mach, MACHS)
    low, share = (0, power / 50.0) if power < 50.0 else (1, power / 50.0 - 1.0)
    both = THRUST[low : low + 2]
    ends = (1 - b) * ((1 - a) * both[:, j, i] + a * both[:, j, i + 1]) + b * (
        (1 - a) * both[:, j + 1, i] + a * both[:, j + 1, i + 1]
    )
    return ends[0] + share * (ends[1] - ends[0])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _power_slope(power: float, asked: float) -> float:
    """Return how fast the engine follows, percent/s."""
    if power >= 50.0:
        return 5.0 * ((asked if asked >= 50.0 else 40.0) - power)
    far = (60.0 if asked >= 50.0 else asked) - power
    return far * (1.0 if far <= 25.0 else 0.1 if far >= 50.0 else 1.9 - 0.036 * far)


@njit(cache=True)  # type: ignore[untyped-decorator]
def slopes(x: Array, nz_wanted: float, ps_wanted: float) -> Array:
    """Slopes of the state.

    Parameters
    ----------
    x : array, shape (14,)
        Speed (ft/s), angles of attack and sideslip, roll, pitch, yaw (rad), their rates p, q, r (rad/s), altitude (ft),
        power (percent), integrals of Nz, ps and Ny + r.
    nz_wanted, ps_wanted : float
        In g above 1, and rad/s.
    """
    vt, a, b, roll, pitch, _, p, q, r, height, power, nz_sum, ps_sum, ny_sum = x
    da = a - TRIM_ALPHA
    elevator = TRIM_ELEVATOR - (K_LONG[0] * da + K_LONG[1] * q + K_LONG[2] * nz_sum)
    aileron, rudder = -(
        K_LAT[:, 0] * b + K_LAT[:, 1] * p + K_LAT[:, 2] * r + K_LAT[:, 3] * ps_sum + K_LAT[:, 4] * ny_sum
    )
    elevator = min(max(elevator, -25.0), 25.0)
    aileron, rudder = min(max(aileron, -21.5), 21.5), min(max(rudder, -30.0), 30.0)

    cold = 1.0 - 0.703e-5 * height
    pressure = 0.5 * DENSITY * cold**4.14 * vt * vt
    mach = vt / np.sqrt(1.4 * 1716.3 * (390.0 if height >= 35000.0 else 519.0 * cold))
    thrust = _thrust(power, height, mach)
    half = 0.5 / vt
    pr, qr, rr = SPAN * half * p, CHORD * half * q, SPAN * half * r
    rad = pi / 180.0
    cx, cy, cz, cl, cm, cn = polynomials(a, b, elevator * rad, aileron * rad, rudder * rad, pr, qr, rr)
    k, share = _place(a / rad, ANGLES)
    d = DAMPING[:, k] + share * (DAMPING[:, k + 1] - DAMPING[:, k])
    cx, cy, cz = cx + qr * d[0], cy + d[1] * rr + d[2] * pr, cz + qr * d[3]
    cl, cm, cn = cl + d[4] * rr + d[5] * pr, cm + qr * d[6], cn + d[7] * rr + d[8] * pr

    u, v, w = vt * cos(a) * cos(b), vt * sin(b), vt * sin(a) * cos(b)
    force, moment = pressure * AREA, pressure * AREA * SPAN
    ay, az = PER_MASS * force * cy, PER_MASS * force * cz
    du = r * v - q * w - G * sin(pitch) + PER_MASS * (force * cx + thrust)
    dv = p * w - r * u + G * cos(pitch) * sin(roll) + ay
    dw = q * u - p * v + G * cos(pitch) * cos(roll) + az
    dx = np.empty(14)
    dx[0] = (u * du + v * dv + w * dw) / vt
    dx[1] = (u * dw - w * du) / (u * u + w * w)
    dx[2] = (vt * dv - v * dx[0]) * cos(b) / (u * u + w * w)
    turn = q * sin(roll) + r * cos(roll)
    dx[3], dx[4], dx[5] = p + tan(pitch) * turn, q * cos(roll) - r * sin(roll), turn / cos(pitch)
    dx[6] = (C[2] * p + C[1] * r + C[4] * MOMENTUM) * q + moment * (C[3] * cl + C[4] * cn)
    dx[7] = (C[5] * p - C[7] * MOMENTUM) * r + C[6] * (r * r - p * p) + force * CHORD * C[7] * cm
    dx[8] = (C[8] * p - C[2] * r + C[9] * MOMENTUM) * q + moment * (C[4] * cl + C[9] * cn)
    dx[9] = u * sin(pitch) - v * sin(roll) * cos(pitch) - w * cos(roll) * cos(pitch)
    dx[10] = _power_slope(power, 64.94 * TRIM_THROTTLE)  # the autopilot keeps the throttle constant
    dx[11] = -(az - PILOT * dx[7]) / G - 1.0 - nz_wanted
    dx[12] = p * cos(da) + r * sin(da) - ps_wanted
    dx[13] = (ay + PILOT * dx[8]) / G + r
    return dx


@njit(cache=True)  # type: ignore[untyped-decorator]
def _rolled(x: Array, mode: int) -> float:
    """Return the wanted roll rate, rad/s."""
    return -(x[3] - 2 * pi * round(x[3] / (2 * pi))) * ROLL_P - x[6] * ROLL_D if mode == ROLLING else 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def fly(roll: float, pitch: float, yaw: float) -> Array:
    """Fly for 15 s, with the recovery active from the start.

    Returns
    -------
    array, shape (n,)
        Altitude (ft) each 50 ms.
    """
    steps, h = round(DURATION / STEP), STEP
    result = np.empty(steps // EVERY + 1)
    x = np.zeros(14)
    x[0], x[1], x[3], x[4], x[5], x[9], x[10] = SPEED, ALPHA, roll, pitch, yaw, ALTITUDE, POWER
    mode, since = ROLLING, 0.0
    for k in range(steps + 1):
        if k % EVERY == 0:
            result[k // EVERY] = x[9]
        tilt = x[3] - 2 * pi * round(x[3] / (2 * pi))
        path = x[4] - x[1]
        high = path - 2 * pi * round(path / (2 * pi)) > 0.0
        if mode == STANDBY and not high and x[9] < DECK:
            mode = ROLLING
        elif mode == ROLLING and abs(x[6]) < STILL and abs(tilt) < LEVEL:
            mode, since = PULLING, k * h
        elif mode == PULLING and high and k * h >= since + PULLED:
            mode = STANDBY
        nz = PULL if mode == PULLING else 0.0
        a = slopes(x, nz, _rolled(x, mode))
        y = x + h / 2 * a
        b = slopes(y, nz, _rolled(y, mode))
        y = x + h / 2 * b
        c = slopes(y, nz, _rolled(y, mode))
        y = x + h * c
        d = slopes(y, nz, _rolled(y, mode))
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return result


def signals(inputs: Array) -> dict[str, Array]:
    """Return the signal of the requirement for a start of shape (3,)."""
    return {"altitude": fly(*inputs)}


PERIOD = STEP * EVERY
