"""The inputs of the controllers: means of space vectors over the control period, rotated to its end.

The mean removes what 48 samples a cycle would fold onto the fundamental, the 47th and 49th, down to 2 % of them; it
lags by half a period, by which it is turned forward, and is divided by its gain for a vector at nominal speed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from softrig_core import jit
from softrig_core.kit import dense


@jit
def weigh(weights: NDArray[np.float64], samples: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Sum samples, shape (k, n), by complex weights, shape (2, k), in real arithmetic, in their order."""
    result = np.empty_like(samples[0])
    for j in range(result.size):
        rr = ri = ir = ii = 0.0
        for k in range(samples.shape[0]):
            x, y = samples[k, j].real, samples[k, j].imag
            rr += weights[0, k] * x
            ri += weights[0, k] * y
            ir += weights[1, k] * x
            ii += weights[1, k] * y
        result[j] = complex(rr - ii, ri + ir)
    return result


class Weights:
    """Weights of the samples of one period.

    Parameters
    ----------
    omega : float
        Nominal angular frequency, rad/s.
    step : float
        Time between samples, s.
    steps : int
        Steps in a period.
    """

    def __init__(self, omega: float, step: float, steps: int) -> None:
        trapezoid = np.full(steps + 1, 1.0 / steps)
        trapezoid[[0, -1]] *= 0.5
        nominal = dense.turn(-omega * step * np.arange(steps, -1, -1))
        weights = trapezoid / dense.product(trapezoid, nominal)
        self._w = np.array([weights.real, weights.imag])
        self._turn = omega * step * steps
        self._steps = steps

    def __call__(self, samples: NDArray[np.complex128]) -> Any:
        """Return the measurement at the last sample of a period, shape (n,); samples of shape (steps + 1, n)."""
        return weigh(self._w, samples)

    def record(self, samples: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the measurement at the end of each of n periods, shape (n,); samples of shape (n steps + 1,)."""
        ends = range(self._steps, samples.size, self._steps)
        return np.asarray(self(np.column_stack([samples[e - self._steps : e + 1] for e in ends])))

    def phasor(self, samples: NDArray[np.complex128]) -> complex:
        """Mean of `record`, each turned on to the last sample at nominal speed."""
        result = self.record(samples)
        return complex(np.mean(dense.times(result, dense.turn(self._turn * np.arange(result.size - 1, -1, -1)))))
