"""Fixed steps for equations written once: classical Runge-Kutta for casadi expressions and for native loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .jit import jit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# rate times step: the error of one step of order 4 is then 0.1^5/120 = 8e-8 of its change; the method diverges from 2.8
# on
RESOLVED = 0.1
STEPS = 50  # in one period at most, unless a person asks for more: a rate that needs more is as a rule a wrong unit


def resolving_step(period: float, substeps: int, *rates: tuple[float, str]) -> float:
    """Return the largest step that resolves rates and divides a period into at least some parts.

    Parameters
    ----------
    period : float
        s.
    substeps : int
        Least number of steps in one period.
    rates : tuple of (float, str)
        Rates of the equations, 1/s, each with the parameters that make it.

    Returns
    -------
    float
        s.

    Raises
    ------
    ValueError
        A rate needs more than `STEPS` steps and more than `substeps`; names it.
    """
    rate, name = max(rates)
    needed = rate * period / RESOLVED * (1.0 - 1e-12)  # a rounding error does not require a further step
    if needed > max(STEPS, substeps):
        raise ValueError(
            f"{name}: its fastest time constant is {1.0 / rate:.2g} s, a period is {period:g} s; check the units, or "
            f"use {math.ceil(min(needed, 1e9))} substeps"
        )
    return min(period / substeps, RESOLVED / rate) if rate > 0.0 else period / substeps


def rk4(ode: Callable[[Any], Any], x: Any, h: Any, substeps: int = 1) -> Any:
    r"""Return the expression of the state after steps of the classical Runge-Kutta method, order 4.

    .. math:: x_{k+1} = x_k + \frac{h}{6} (k_1 + 2 k_2 + 2 k_3 + k_4)

    Parameters
    ----------
    ode : callable
        State to its derivative (1/s), inputs held: built from casadi expressions, or from floats and arrays.
    x : casadi.SX, casadi.MX, ndarray or float
        State at the begin.
    h : casadi.SX, casadi.MX or float
        Length of one step, s.
    substeps : int
        Number of steps.

    Returns
    -------
    As x

    Examples
    --------
    >>> step = Compiled(casadi.Function("step", [x, u, h], [rk4(lambda x: ode(x, u), x, h, substeps=2)]))
    """
    for _ in range(substeps):
        k1 = ode(x)
        k2 = ode(x + 0.5 * h * k1)
        k3 = ode(x + 0.5 * h * k2)
        k4 = ode(x + h * k3)
        x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x


def rk4_loop(ode: Callable[..., None], limit: Callable[..., None] | None = None) -> Callable[..., None]:
    """Create the native loop of classical Runge-Kutta steps, order 4.

    Parameters
    ----------
    ode : callable
        `jit` function (t, x, p, dx): writes the derivative of x (1/s) into dx; p is passed by the caller (inputs,
        parameters: a tuple or array).
    limit : callable, optional
        `jit` function (x, p): brings a state back into its range (a current that a diode keeps positive), at each
        stage and at the end of a step. If it were applied only at the end, an error of first order would remain.

    Returns
    -------
    callable
        `jit` function (t, x, h, n, p): n steps of h seconds from t, x is changed in place.
    """
    clip: Callable[..., None] = _nothing if limit is None else limit

    @jit
    def advance(t: float, x: NDArray[np.float64], h: float, n: int, p: Any) -> None:
        start, stage, slope = x.copy(), x.copy(), x.copy()
        for step in range(n):
            now = t + step * h
            for j in range(x.size):
                start[j] = stage[j] = x[j]
            for i in range(4):
                # for each stage: its time, its weight, and how far its slope extends to the next one
                t_stage = now if i == 0 else (now + h if i == 3 else now + 0.5 * h)
                weight = h / 6.0 if i == 0 or i == 3 else h / 3.0
                ahead = h if i == 2 else (0.0 if i == 3 else 0.5 * h)
                ode(t_stage, stage, p, slope)
                for j in range(x.size):
                    stage[j] = start[j] + ahead * slope[j]
                    x[j] += weight * slope[j]
                clip(stage, p)
            clip(x, p)

    return advance


@jit
def _nothing(x: NDArray[np.float64], p: Any) -> None:
    pass
