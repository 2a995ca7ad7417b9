"""A steam condenser whose cooling water a recurrent network sets, and its requirements: SC of ARCH-COMP.

Model: the benchmark's Simulink model steamcondense_RNN_22 (S. Yaghoubi and G. Fainekos, "Gray-box adversarial testing
for control systems with machine learning components", HSCC 2019), its diagram read block by block: a dynamic energy
balance of the cooling water, the balance of steam, a table of saturation, an actuator of 1 s, a sensor of 0.5 s. The
weights of the network are those of the file. Requirement and input (steam, constant for 1.75 s each): Ernst et al.,
"ARCH-COMP falsification category". Written anew; the difference from the Simulink model is RK4 of 10 ms.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from softrig_core import Array

from .transmission import _line

DURATION, STEP, EVERY, SEGMENTS = 35.0, 0.01, 5, 20  # s, s, steps for each sample, pieces of the input
VOLUME, HOLDUP, COLD, HEAT = 3.0, 500.0, 60.0, 4.2  # m^3, kg of cooling water, its temperature in degC, kJ/(kg K)
GAS, FLOW, MOST_FLOW = 0.461526, 107.8880952381, 200.0  # kJ/(kg K) of steam, kg/s of cooling water
START, HOT, WANTED, CHANGED = 90.0, 80.0, 87.0, 2.0  # initial kPa and degC, new set point in kPa and its time in s
ACTUATOR, SENSOR, POLE = 1.0, 0.5, 10.0  # s, s, and the pole of the network's delays 1/(s + 10) in 1/s

PRESSURES = np.array([50.0, 60, 70, 80, 90, 100, 110])  # kPa
BOILING = np.array([81.3167, 85.9258, 89.9315, 93.4854, 96.6870, 99.6059, 102.2923])  # degC
EVAPORATION = np.array([2305.42, 2293.64, 2283.30, 2274.05, 2265.65, 2257.92, 2250.76])  # kJ/kg

# Both are scaled to -1 to 1.
IN, OUT = (-3.7742393716738434, 5.7997431225043385), (-30.855068745036114, 66.87926496595296)
W_IN = np.array([-0.36932254958803395, 0.37111199431650393, -0.52736280584118833])
W_BACK = np.array(
    [
        [0.44769854454577174, 1.1961840315574388, 1.1412233787458486, 0.72001623019786209, -0.37547125154051064,
         -0.61546760904874331],
        [-0.16668730359454359, -0.016432941671533533, -0.22132796342367161, -0.037206224095552992, 0.059874671921603305,
         0.080202592729115826],
        [0.24187644262601646, -0.66963285238228187, -1.0984401489322673, 0.029109804692608397, 1.3722216833345802,
         0.66166906669524039],
    ]
)  # fmt: skip
BIAS = np.array([0.40129050296348601, -0.12475735064274925, -1.3584541012442735])
W_OUT, BIAS_OUT = np.array([-0.22749313555095124, 2.0804967759906643, -0.56644809886208158]), -0.33227866684137108

REQUIREMENTS = {"SC": "always[30, 35] (pressure >= 87 and pressure <= 87.5)"}
INPUTS = (("steam", 3.99, 4.01, SEGMENTS),)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _slopes(t: float, x: Array, steam: float) -> Array:
    """Return the slopes of pressure, temperature, flow, measurement, and the network's delays, three for each lag."""
    dx = np.empty(10)
    boiling, flow = _line(x[0], PRESSURES, BOILING), x[2]
    mean = (x[1] - COLD) / np.log((boiling - COLD) / (boiling - x[1]))
    heat = mean / (0.0872924756541668 / flow**0.8 + 0.00073786772008033)  # kW
    dx[0] = GAS / VOLUME * (steam - heat / _line(x[0], PRESSURES, EVAPORATION)) * boiling
    dx[1] = (heat / HEAT + (COLD - x[1]) * flow) / HOLDUP
    error = x[3] - (WANTED if t >= CHANGED else START)
    into = 2.0 * (error - IN[0]) / (IN[1] - IN[0]) - 1.0
    out = BIAS_OUT
    for i in range(3):
        net = W_IN[i] * into + BIAS[i]
        for j in range(6):
            net += W_BACK[i, j] * x[4 + j]
        neuron = np.tanh(net)
        out += W_OUT[i] * neuron
        dx[4 + i] = neuron - POLE * x[4 + i]
        dx[7 + i] = x[4 + i] - POLE * x[7 + i]
    asked = FLOW + OUT[0] + (out + 1.0) / 2.0 * (OUT[1] - OUT[0])
    dx[2] = (min(max(asked, 0.0), MOST_FLOW) - flow) / ACTUATOR
    dx[3] = (x[0] - x[3]) / SENSOR
    return dx


@njit(cache=True)  # type: ignore[untyped-decorator]
def condense(steam: Array) -> Array:
    """Run for 35 s.

    Parameters
    ----------
    steam : array, shape (SEGMENTS,)
        kg/s.

    Returns
    -------
    array, shape (n,)
        Measured pressure (kPa) each 50 ms.
    """
    steps, h = round(DURATION / STEP), STEP
    result = np.empty(steps // EVERY + 1)
    x = np.zeros(10)
    x[:4] = START, HOT, FLOW, START
    for k in range(steps + 1):
        if k % EVERY == 0:
            result[k // EVERY] = x[3]
        t, u = k * h, steam[min(int(k * STEP / DURATION * SEGMENTS), SEGMENTS - 1)]
        a = _slopes(t, x, u)
        b = _slopes(t, x + h / 2 * a, u)  # the set point changes only between two steps
        c = _slopes(t, x + h / 2 * b, u)
        d = _slopes(t, x + h * c, u)
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return result


def signals(inputs: Array) -> dict[str, Array]:
    """Return the signals of the requirement for inputs of shape (SEGMENTS,)."""
    return {"pressure": condense(inputs)}


PERIOD = STEP * EVERY
