"""Motion of the examples as native loops on the suite's delay equations, with cell switches located inside a step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from softrig_core import jit
from softrig_core.kit.dde import Trajectory, delayed, integrator

from .profiles import Profile, delay_at

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from softrig_core import Array

    from .system import PwaSystem


FREE = -1  # the cell is looked up at every stage
BISECTIONS = 50
SWITCHES = 16  # most switches located in one step; beyond it is sliding, and cells are looked up at every stage


class PwaConstants(NamedTuple):
    """A piecewise affine system and its delay for native loops; `cell` holds the number of the present cell."""

    A: Array
    Ad: Array
    a: Array
    lines: Array
    lines_delayed: Array
    cell: NDArray[np.int64]
    profile: Profile


def constants(system: PwaSystem, profile: Profile) -> PwaConstants:
    """Pack a system whose cells are defined by lines."""
    import numpy as np

    return PwaConstants(
        np.array(system.A),
        np.array(system.Ad),
        np.array(system.a),
        system.lines.copy(),
        system.lines_delayed.copy(),
        np.array([FREE]),
        profile,
    )


@jit
def past_value(past: Trajectory, t: float, d: float, x: Array, channel: int) -> float:
    """Read a channel d before t; without a delay it is the state at hand."""
    return delayed(past, t - d, channel) if d > 0.0 else x[channel]


@jit
def pwa_cell(t: float, x: Array, past: Trajectory, p: PwaConstants) -> int:
    """Return the cell of (x, x_d), the first line's sign changing slowest."""
    d = delay_at(p.profile, t)
    index = 0
    for row in range(p.lines.shape[0]):
        value = 0.0
        for j in range(p.lines.shape[1]):
            value += p.lines[row, j] * x[j]
        index = 2 * index + (1 if value >= 0.0 else 0)
    for row in range(p.lines_delayed.shape[0]):
        value = 0.0
        for j in range(p.lines_delayed.shape[1]):
            if p.lines_delayed[row, j] != 0.0:
                value += p.lines_delayed[row, j] * past_value(past, t, d, x, j)
        index = 2 * index + (1 if value >= 0.0 else 0)
    return index


@jit
def pwa_slopes(t: float, x: Array, past: Trajectory, p: PwaConstants, dx: Array) -> None:
    """X' = A_i x + Ad_i x_d + a_i."""
    d = delay_at(p.profile, t)
    cell = p.cell[0]
    if cell == FREE:
        cell = pwa_cell(t, x, past, p)
    n = p.a.shape[1]
    for i in range(n):
        dx[i] = p.a[cell, i]
    for j in range(n):
        x_d = past_value(past, t, d, x, j)
        for i in range(n):
            dx[i] += p.A[cell, i, j] * x[j] + p.Ad[cell, i, j] * x_d


class TankConstants(NamedTuple):
    """The tank of `tank_slopes`; `closed`: 1 for the law inside, 0 for the inflow command; `pwa`: 1 for two slopes."""

    c: float
    s: float
    k_low: float
    k_high: float
    closed: float
    pwa: float
    cell: NDArray[np.int64]
    profile: Profile


@jit
def tank_cell(t: float, x: Array, past: Trajectory, p: TankConstants) -> int:
    """Return 0 below the switching level, 1 above, of the delayed level."""
    return 1 if past_value(past, t, delay_at(p.profile, t), x, 0) >= p.s else 0


@jit
def tank_slopes(t: float, x: Array, past: Trajectory, p: TankConstants, dx: Array) -> None:
    """X' = -c sqrt(x) + w(t - d), w = k_low x below s and -k_high x above, all at t - d; or w the command, x[1]."""
    d = delay_at(p.profile, t)
    if p.closed > 0.0:
        cell = p.cell[0]
        if cell == FREE:
            cell = tank_cell(t, x, past, p)
        inflow = past_value(past, t, d, x, 0) * (p.k_low if cell == 0 else -p.k_high)
    else:
        inflow = past_value(past, t, d, x, 1)
    level = x[0]
    if p.pwa > 0.0:
        drain = 8.6928e-4 * level + 2.1732e-4 if level < 0.5 else 5.0188e-4 * level + 3.7641e-4
    else:
        drain = p.c * math.sqrt(level) if level > 0.0 else 0.0
    dx[0] = inflow - drain
    if level <= 0.0 and dx[0] < 0.0:
        dx[0] = 0.0
    dx[1] = 0.0


@jit
def keep_level(x: Array, p: TankConstants) -> None:
    """An empty tank stays empty."""
    if x[0] < 0.0:
        x[0] = 0.0


class PendulumConstants(NamedTuple):
    """The pendulum of `pendulum_slopes`; `sine`: 1 for sin(theta); `closed`: 1 for the law inside."""

    sine: float
    closed: float
    cell: NDArray[np.int64]
    profile: Profile


@jit
def pendulum_cell(t: float, x: Array, past: Trajectory, p: PendulumConstants) -> int:
    """Cells by the signs of theta and of the delayed theta."""
    theta_d = past_value(past, t, delay_at(p.profile, t), x, 0)
    return (2 if x[0] > 0.0 else 0) + (1 if theta_d > 0.0 else 0)


@jit
def pendulum_slopes(t: float, x: Array, past: Trajectory, p: PendulumConstants, dx: Array) -> None:
    """Theta' = omega, omega' = a theta + u; u = -k (theta_d + omega_d), or the command, x[2]; with sin, -sin(theta)."""
    cell = p.cell[0]
    if cell == FREE:
        cell = pendulum_cell(t, x, past, p)
    if p.closed > 0.0:
        d = delay_at(p.profile, t)
        k = 5.0 if cell % 2 == 1 else 1.0
        u = -k * (past_value(past, t, d, x, 0) + past_value(past, t, d, x, 1))
    else:
        u = x[2]
    dx[0] = x[1]
    dx[1] = u - math.sin(x[0]) if p.sine > 0.0 else u + (-0.4875 if cell >= 2 else -0.825) * x[0]
    dx[2] = 0.0


def located(
    rhs: Callable[..., None], cell_of: Callable[..., int], limit: Callable[..., None] | None = None
) -> Callable[..., int]:
    """Create the native loop of steps whose switches are located.

    Parameters
    ----------
    rhs, limit : callable
        As for `softrig_core.kit.dde.integrator`; rhs takes its cell from ``p.cell[0]``.
    cell_of : callable
        `jit` function (t, x, past, p): the cell that the state is in.

    Returns
    -------
    callable
        `jit` function (past, t, x, h, n, p, norms) -> number of switches. n steps of h; a step in which the cell
        changes is taken up to the change, found by bisection on its cubic, and from there on. ``norms`` gets the
        largest size of a state after each step; of length 0 it gets nothing.
    """
    advance = integrator(rhs, limit)

    @jit
    def cell_at(t: float, x: Array, past: Trajectory, p: Any) -> int:
        """Cell of the state that the past had at t, which is written into x."""
        for j in range(x.shape[0]):
            x[j] = delayed(past, t, j)
        return cell_of(t, x, past, p)

    @jit
    def run(past: Trajectory, t: float, x: Array, h: float, n: int, p: Any, norms: Array) -> int:
        switches = 0
        start, probe = x.copy(), x.copy()
        width = x.shape[0]
        if p.cell[0] == FREE:
            p.cell[0] = cell_of(t, x, past, p)
        for step in range(n):
            now, end = t + step * h, t + (step + 1) * h
            start[:] = x
            result = 0
            while True:
                advance(past, now, x, end - now, 1, p)
                after = cell_of(end, x, past, p)
                if after == p.cell[0]:
                    break
                if result == SWITCHES:
                    p.cell[0] = after
                    break
                result += 1
                low, high = now, end
                for _ in range(BISECTIONS):
                    middle = 0.5 * (low + high)
                    if cell_at(middle, probe, past, p) == p.cell[0]:
                        low = middle
                    else:
                        high = middle
                after = cell_at(high, probe, past, p)
                past.meta[0] -= 1  # back to the begin of the step, and up to the switch
                x[:] = start
                if high - now > 1e-6 * h:
                    advance(past, now, x, high - now, 1, p)
                    now = high
                    start[:] = x
                p.cell[0] = after
                if end - now <= 1e-6 * h:
                    break
            switches += result
            if norms.size > 0:
                largest = 0.0
                for j in range(width):
                    largest = max(largest, abs(x[j]))
                norms[step] = largest
        return switches

    return run


run_pwa = located(pwa_slopes, pwa_cell)
run_tank = located(tank_slopes, tank_cell, keep_level)
run_pendulum = located(pendulum_slopes, pendulum_cell)
