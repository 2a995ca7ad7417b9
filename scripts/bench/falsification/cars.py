"""Five cars that follow each other, and their requirements: CC1 to CC5 of ARCH-COMP.

Model: Hu, Lygeros and Sastry, "Towards a theory of stochastic hybrid systems", HSCC 2000: who is far behind
accelerates, who is near keeps its speed, who is too near brakes. Requirements and inputs (throttle and brake of the
first car, constant for 5 s each): Ernst et al., "ARCH-COMP falsification category". Modes and distances of the
Simulink model: as read in an open-source translation, zlscheck (I. Bennani); its code is not used. There, as here, who
keeps its speed falls back with it: did it follow, random inputs would violate CC1 to CC5 far more often (32, 48, 100,
59 and 91 % of 1000 drawn; as it is 1, 1, 4, 0 and 1 %).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from softrig_core import Array

DURATION, STEP, EVERY, SEGMENTS, CARS = 100.0, 0.01, 10, 20, 5
CHASE_FROM, KEEP_TO, KEEP_FROM, BRAKE_FROM = 20.0, 15.0, 10.0, 5.0  # m, distances to the car ahead
REQUIREMENTS = {
    "CC1": "always y5 - y4 <= 40",
    "CC2": "always[0, 70] (eventually[0, 30] y5 - y4 >= 15)",
    "CC3": "always[0, 80] ((always[0, 20] y2 - y1 <= 20) or (eventually[0, 20] y5 - y4 >= 40))",
    "CC4": "always[0, 65] (eventually[0, 30] (always[0, 5] y5 - y4 >= 8))",
    "CC5": "always[0, 72] (eventually[0, 8] ((always[0, 5] y2 - y1 >= 9) -> (always[5, 20] y5 - y4 >= 9)))",
}
INPUTS = (("throttle", 0.0, 1.0, SEGMENTS), ("brake", 0.0, 1.0, SEGMENTS))
CHASING, KEEPING, BRAKING = 0, 1, 2


@njit(cache=True)  # type: ignore[untyped-decorator]
def drive(throttles: Array, brakes: Array) -> Array:
    """Drive for 100 s.

    Parameters
    ----------
    throttles, brakes : array, shape (SEGMENTS,)

    Returns
    -------
    array, shape (n, CARS)
        Places (m) each 0.1 s; all drive towards smaller ones.
    """
    steps = round(DURATION / STEP)
    result = np.empty((steps // EVERY + 1, CARS))
    y, v, mode = np.arange(CARS) * 10.0, np.zeros(CARS), np.zeros(CARS, dtype=np.int64)
    for k in range(steps + 1):
        if k % EVERY == 0:
            result[k // EVERY] = y
        piece = min(int(k * STEP / DURATION * SEGMENTS), SEGMENTS - 1)
        for i in range(1, CARS):
            gap = y[i] - y[i - 1]
            if mode[i] == CHASING and gap <= KEEP_FROM:
                mode[i] = KEEPING
            elif mode[i] == KEEPING and gap >= KEEP_TO:
                mode[i] = CHASING
            elif mode[i] == KEEPING and gap <= BRAKE_FROM:
                mode[i] = BRAKING
            elif mode[i] == BRAKING and gap >= CHASE_FROM:
                mode[i] = CHASING
        before = v.copy()
        v[0] += STEP * (throttles[piece] - brakes[piece] * v[0])
        for i in range(1, CARS):
            v[i] += STEP * (1.0 if mode[i] == CHASING else -v[i] if mode[i] == BRAKING else 0.0)
        for i in range(CARS):
            y[i] += STEP * (before[i] + v[i]) / 2.0 * (1.0 if mode[i] == KEEPING and i else -1.0)
    return result


def signals(inputs: Array) -> dict[str, Array]:
    """Return the signals of the requirements for inputs of shape (2 * SEGMENTS,)."""
    result = drive(inputs[:SEGMENTS], inputs[SEGMENTS:])
    return {f"y{i + 1}": result[:, i] for i in range(CARS)}


PERIOD = STEP * EVERY
