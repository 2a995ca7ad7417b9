"""A car with an automatic transmission, and its requirements: AT1, AT2, AT6a to c of ARCH-COMP.

Equations: MathWorks' demonstration "Modeling an Automatic Transmission Controller" (documentation of Simulink),
equations 1 to 5. Numbers of its tables and constants: the public benchmark, as read in an open-source translation,
zlscheck (I. Bennani); its code is not used. Requirements and inputs (throttle and brake constant for 5 s each): Ernst
et al., "ARCH-COMP falsification category", from Hoxha, Abbas and Fainekos, "Benchmarks for temporal logic requirements
for automotive systems", ARCH 2014. Written anew; differences from the Simulink model: RK4 of 10 ms, shifts decided
once a step.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from softrig_core import Array

DURATION, STEP, EVERY, SEGMENTS = 50.0, 0.01, 5, 10  # s, s, steps for each sample, pieces of each input
# Inertias of engine and impeller, and of the vehicle.
INERTIA, VEHICLE_INERTIA = 0.0219914882835559, 12.09414785731247
FINAL_DRIVE, FRICTION, DRAG, RADIUS = 3.23, 40.0, 0.02, 1.0  # ratio, ft lb, ft lb/mph^2, ft
MPH = 2.0 * np.pi * RADIUS * 60.0 / 5280.0  # speed of a wheel at 1 rpm
# rpm, rpm, rpm, s for which the condition of a shift must hold.
SLOWEST, FASTEST, IDLE, WAIT = 600.0, 6000.0, 1000.0, 0.08

THROTTLES = np.array([0.0, 20, 30, 40, 50, 60, 70, 80, 90, 100])  # percent
SPEEDS = np.array([800.0, 1200, 1600, 2000, 2400, 2800, 3200, 3600, 4000, 4400, 4800])  # rpm
TORQUES = np.array(
    [
        [-40.0, -44, -49, -53, -57, -61, -65, -70, -74, -78, -82],
        [215, 117, 85, 66, 44, 29, 10, -2, -13, -22, -32],
        [245, 208, 178, 148, 122, 104, 85, 66, 48, 33, 18],
        [264, 260, 241, 219, 193, 167, 152, 133, 119, 96, 85],
        [264, 279, 282, 275, 260, 238, 223, 208, 189, 171, 152],
        [267, 290, 293, 297, 290, 275, 260, 256, 234, 212, 193],
        [267, 297, 305, 305, 305, 301, 293, 282, 267, 249, 226],
        [267, 301, 308, 312, 319, 323, 319, 316, 297, 279, 253],
        [267, 301, 312, 319, 327, 327, 327, 327, 312, 293, 267],
        [267, 301, 312, 319, 327, 334, 334, 334, 319, 305, 275],
    ]
)  # ft lb
RATIOS = np.array(
    [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.81, 0.82, 0.83, 0.84, 0.85, 0.86, 0.87, 0.88, 0.89, 0.9, 0.92, 0.94]
)
CAPACITY = np.array([137.465, 137.065, 135.864, 135.664, 137.565, 140.367, 145.269, 152.873, 162.977, 164.278, 166.179,
                     167.980, 170.081, 172.782, 175.383, 179.585, 183.587, 189.890, 197.694, 215.902,
                     244.516])  # fmt: skip
AMPLIFIED = np.array([2.232, 2.075, 1.975, 1.846, 1.720, 1.564, 1.409, 1.254, 1.096, 1.080, 1.061, 1.043, 1.028, 1.012,
                      1.002, 1.002, 1.001, 0.998, 0.999, 1.001, 1.002])  # fmt: skip
GEARS = np.array([2.393, 1.450, 1.000, 0.677])
UP_AT = np.array([0.0, 25, 35, 50, 90, 100])
UP = np.array(
    [
        [10.0, 30, 50, 1e6],
        [10, 30, 50, 1e6],
        [15, 30, 50, 1e6],
        [23, 41, 60, 1e6],
        [40, 70, 100, 1e6],
        [40, 70, 100, 1e6],
    ]
)
DOWN_AT = np.array([0.0, 5, 40, 50, 90, 100])
DOWN = np.array([[0.0, 5, 20, 35], [0, 5, 20, 35], [0, 5, 25, 40], [0, 5, 30, 50], [0, 30, 50, 80], [0, 30, 50, 80]])

REQUIREMENTS = {
    "AT1": "always[0, 20] speed < 120",
    "AT2": "always[0, 10] rpm < 4750",
    "AT6a": "(always[0, 30] rpm < 3000) -> (always[0, 4] speed < 35)",
    "AT6b": "(always[0, 30] rpm < 3000) -> (always[0, 8] speed < 50)",
    "AT6c": "(always[0, 30] rpm < 3000) -> (always[0, 20] speed < 65)",
}
INPUTS = (("throttle", 0.0, 100.0, SEGMENTS), ("brake", 0.0, 325.0, SEGMENTS))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _place(x: float, grid: Array) -> tuple[int, float]:
    """Return the place of a number in a grid; beyond its ends on the last piece."""
    k = min(max(int(np.searchsorted(grid, x, side="right")) - 1, 0), len(grid) - 2)
    return k, (x - grid[k]) / (grid[k + 1] - grid[k])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _line(x: float, grid: Array, values: Array) -> float:
    k, share = _place(x, grid)
    return values[k] + share * (values[k + 1] - values[k])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _slopes(engine: float, wheel: float, throttle: float, brake: float, gear: int) -> tuple[float, float]:
    """Accelerations of engine and wheel, rpm/s."""
    i, a = _place(throttle, THROTTLES)
    torque = (1.0 - a) * _line(engine, SPEEDS, TORQUES[i]) + a * _line(engine, SPEEDS, TORQUES[i + 1])
    ratio = FINAL_DRIVE * wheel * GEARS[gear] / engine
    impeller = (engine / _line(ratio, RATIOS, CAPACITY)) ** 2
    out = impeller * _line(ratio, RATIOS, AMPLIFIED) * GEARS[gear]
    mph = MPH * wheel
    load = (FRICTION + DRAG * mph * mph + brake) * (1.0 if mph >= 0.0 else -1.0)
    return (torque - impeller) / INERTIA, (FINAL_DRIVE * out - load) / VEHICLE_INERTIA


@njit(cache=True)  # type: ignore[untyped-decorator]
def drive(throttles: Array, brakes: Array) -> Array:
    """Drive for 50 s.

    Parameters
    ----------
    throttles, brakes : array, shape (SEGMENTS,)
        In percent and in ft lb.

    Returns
    -------
    array, shape (n, 2)
        Speed (mph) and engine speed (rpm) each 50 ms.
    """
    steps = round(DURATION / STEP)
    result = np.empty((steps // EVERY + 1, 2))
    engine, wheel, gear, wanted, since = IDLE, 0.0, 0, 0, 0.0
    h = STEP
    for k in range(steps + 1):
        mph = MPH * wheel
        if k % EVERY == 0:
            result[k // EVERY] = mph, engine
        piece = min(int(k * STEP / DURATION * SEGMENTS), SEGMENTS - 1)
        throttle, brake = throttles[piece], brakes[piece]
        up, down = _line(throttle, UP_AT, UP[:, gear]), _line(throttle, DOWN_AT, DOWN[:, gear])
        want = 1 if mph > up and gear < 3 else -1 if mph < down and gear > 0 else 0
        since = since + h if want and want == wanted else 0.0
        wanted = want
        if want and since > WAIT:
            gear, wanted, since = gear + want, 0, 0.0
        a1, b1 = _slopes(engine, wheel, throttle, brake, gear)
        a2, b2 = _slopes(engine + h / 2 * a1, wheel + h / 2 * b1, throttle, brake, gear)
        a3, b3 = _slopes(engine + h / 2 * a2, wheel + h / 2 * b2, throttle, brake, gear)
        a4, b4 = _slopes(engine + h * a3, wheel + h * b3, throttle, brake, gear)
        engine = min(max(engine + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4), SLOWEST), FASTEST)
        wheel += h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
    return result


def signals(inputs: Array) -> dict[str, Array]:
    """Return the signals of the requirements for inputs of shape (2 * SEGMENTS,)."""
    result = drive(inputs[:SEGMENTS], inputs[SEGMENTS:])
    return {"speed": result[:, 0], "rpm": result[:, 1]}


PERIOD = STEP * EVERY
