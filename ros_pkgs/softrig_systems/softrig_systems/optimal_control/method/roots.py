r"""Selection among several roots: polynomials of low order have more than one alpha that meets the end conditions.

All of them are extremals of the truncated series. Neither the nearest root nor the root of least series cost need be an
extremal of the problem, because a series of low order is a poor approximation. So each root's control is applied to the
true equations, and the root of least cost there is chosen. The cost of a missed end follows from its costate,
:math:`|\lambda(T)|^T |x(T) - x_T|`.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from softrig_core import jit

from .series import value
from .tape import Tape, play

if TYPE_CHECKING:
    from collections.abc import Callable

    from softrig_core import Array

    from ..problem import Problem


SIZES = (0.5, 1.5, 5.0)  # sizes of the starts, relative to alpha
SAME = 1e-6  # relative distance of roots that are one
ESCAPED = 1e12  # cost of a plant that escapes
STEPS = 64  # Runge-Kutta steps a stage of the plant


class Root(NamedTuple):
    """One alpha that meets the end conditions."""

    alpha: Array
    paid: float
    """Cost in the plant, with what the missed end costs."""

    series: float
    """Cost along the polynomials."""


def starts(alpha: Array) -> list[Array]:
    """Return starts of Newton's method: at 0 and in all directions of 0, +, - in each costate, at several distances."""
    size = max(float(np.sqrt(np.sum(alpha * alpha))), 1e-3)
    scale = np.maximum(np.abs(alpha), 0.1 * size)
    around = [np.array(d) * scale for d in product((0.0, 1.0, -1.0), repeat=alpha.size) if any(d)]
    return [np.zeros_like(alpha), *(radius * d for radius in SIZES for d in around)]


def distinct(
    alpha: Array, values: Array, error: float, accurate: float, newton: Callable[[Array], tuple[Array, float]]
) -> list[Array]:
    """Return all real roots found, with `values` first if it is a root.

    Parameters
    ----------
    alpha : ndarray
        Root of the previous order, which gives the magnitude of the costates.
    values, error : ndarray, float
        Result of Newton's method from this root, and its error.
    accurate : float
        Largest error of a root.
    newton : callable
        A start to (alpha, error).
    """
    roots = [values] if error <= accurate else []
    for start in starts(values if roots else alpha):
        root, missing = newton(start)
        size = float(np.sqrt(np.sum(root * root)))
        if missing <= accurate and all(np.max(np.abs(root - other)) > SAME * (size + accurate) for other in roots):
            roots.append(root)
    return roots


def best(
    problem: Problem,
    roots: list[Array],
    z_of: Callable[[Array], tuple[Array, Array]],
    cost: Callable[[Array, Array], float],
) -> list[Root]:
    """Order roots by the cost of the plant, the best first.

    Parameters
    ----------
    z_of : callable
        An alpha to the series of states and costates, and of the controls.
    cost : callable
        Both series to the cost along them; it also orders roots under which the plant escapes.
    """
    judged = []
    for alpha in roots:
        z, u = z_of(alpha)
        n = len(problem.states)
        x = np.zeros(n + 1)
        x[:n] = problem.x0
        pay(problem.extremal.plant, u, problem.horizon, STEPS, x)
        paid = float(x[n])
        if problem.x_end is not None:
            costate = np.abs(z[-1].sum(axis=1)[n:])
            paid += float(np.sum(costate * np.abs(x[:n] - np.array(problem.x_end))))
        judged.append(Root(alpha, paid if paid < ESCAPED else np.inf, cost(z, u)))
    return sorted(judged, key=lambda root: (root.paid, root.series))


@jit
def pay(plant: Tape, u: Array, T: float, steps: int, x: Array) -> None:
    """Play controls (stages, m, powers) to a plant, its states and then the cost in x, changed in place."""
    n, m = x.shape[0] - 1, u.shape[1]
    work = np.zeros((plant.code.shape[0], 1))
    point = np.zeros((n + m, 1))
    k = np.zeros((4, n + 1))
    h = T / (u.shape[0] * steps)
    for stage in range(u.shape[0]):
        for step in range(steps):
            for rk_stage in range(4):
                share = 0.0 if rk_stage == 0 else (1.0 if rk_stage == 3 else 0.5)
                for i in range(n):
                    point[i, 0] = x[i] + (h * share * k[rk_stage - 1, i] if rk_stage else 0.0)
                for i in range(m):
                    point[n + i, 0] = value(u[stage, i], (step + share) / steps)
                play(plant, point, work, 0)
                for i in range(n + 1):
                    k[rk_stage, i] = work[plant.out[i], 0]
            for i in range(n + 1):
                x[i] += h / 6.0 * (k[0, i] + 2.0 * k[1, i] + 2.0 * k[2, i] + k[3, i])
