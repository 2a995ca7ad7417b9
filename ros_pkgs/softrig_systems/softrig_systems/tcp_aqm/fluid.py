"""The fluid equations of the queue: a delay differential equation with a delay that depends on the state."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from softrig_core import jit
from softrig_core.kit.dde import Trajectory, delayed, integrator

if TYPE_CHECKING:
    from softrig_core import Array


# channels of the state; the command is one, held between its jumps, so that the history keeps it too
WINDOW, QUEUE, DROP, SERVED = 0, 1, 2, 3


class Constants(NamedTuple):
    """Constants of the equations, see `model.Bottleneck`; d is uncontrolled traffic (packet/s)."""

    N: float
    C: float
    tau_p: float
    q_max: float
    w_min: float
    w_max: float
    d: float
    input_delay: float


@jit
def slopes(t: float, x: Array, past: Trajectory, c: Constants, dx: Array) -> None:
    """Compute w' and q', eq. (1)-(5) of the paper.

    With R(t) = q/C + tau_p, and w_R, R_R the values of w and R at t - R(t)::

        w' = 1/R - w w_R/(2 R_R) p_eff        w in [w_min, w_max]
        q' = N w/R - C + d                    q in [0, q_max], no outward slope at a bound

    p_eff is p(t - R) with `input_delay` (what a network does), otherwise p(t) (what the paper simulated).

    Parameters
    ----------
    t : float
        s.
    x, dx : (4,) float64 array
        Window and queue (packets), drop probability, packets served; their slopes are written.
    past : Trajectory
        The history of x.
    """
    w, q = x[WINDOW], x[QUEUE]
    R = q / c.C + c.tau_p
    w_R = delayed(past, t - R, WINDOW)
    R_R = delayed(past, t - R, QUEUE) / c.C + c.tau_p
    p = delayed(past, t - R, DROP) if c.input_delay > 0.0 else x[DROP]
    inflow = c.N * w / R + c.d
    dx[WINDOW] = 1.0 / R - w * w_R / (2.0 * R_R) * p
    dx[DROP] = 0.0
    if q <= 0.0 and inflow < c.C:
        dx[QUEUE], dx[SERVED] = 0.0, inflow
    elif q >= c.q_max and inflow > c.C:
        dx[QUEUE], dx[SERVED] = 0.0, c.C
    else:
        dx[QUEUE], dx[SERVED] = inflow - c.C, c.C


@jit
def limit(x: Array, c: Constants) -> None:
    """Clip window and queue to their ranges."""
    x[WINDOW] = min(max(x[WINDOW], c.w_min), c.w_max)
    x[QUEUE] = min(max(x[QUEUE], 0.0), c.q_max)


advance = integrator(slopes, limit)
Four = tuple[float, float, float, float]


@jit
def stepped(
    past: Trajectory, t: float, x: Four, h: float, steps: int, net: Four, limits: Four
) -> tuple[float, float, float]:
    """Return window, queue and packets served some steps after t (s).

    Parameters
    ----------
    x : (float, float, float, float)
        The state at t, see `slopes`.
    net, limits : (float, float, float, float)
        N, C, tau_p and d; q_max, w_min, w_max and input_delay, see `Constants`.
    """
    N, C, tau_p, d = net
    q_max, w_min, w_max, input_delay = limits
    now = np.array(x)
    advance(past, t, now, h, steps, Constants(N, C, tau_p, q_max, w_min, w_max, d, input_delay))
    return float(now[WINDOW]), float(now[QUEUE]), float(now[SERVED])


@jit
def past_values(past: Trajectory, when: float) -> tuple[float, float]:
    """Return window and queue at a time, s."""
    return delayed(past, when, WINDOW), delayed(past, when, QUEUE)
