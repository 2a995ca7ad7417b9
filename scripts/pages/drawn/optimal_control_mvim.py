"""Plans against the optimum, cost over order, end error over order and rate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from softrig_systems.optimal_control.method.exact import least_cost, tpbvp
from softrig_systems.optimal_control.method.mvim import Solution, solve
from softrig_systems.optimal_control.plants import step_function
from softrig_systems.optimal_control.problem import Problem
from softrig_systems.optimal_control.problems import find

# Tables I, III and VI: J_i for i = 1, 2, ...
PUBLISHED_J = {
    "scalar": (0.25000, 0.25000, 0.23493, 0.23493, 0.23533),
    "spacecraft": (0.00468052, 0.00467797, 0.00467903, 0.00467886),
    "two_state": (0.417241, 0.410274, 0.427145, 0.431156),
}
# The order of the paper, and one that is accurate.
EXAMPLES = {"scalar": (5, 12), "spacecraft": (4, 8), "two_state": (2, 10)}


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, Any]:
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def plans(path: Path) -> None:
    """Draw states and controls of the paper's order and of a good one against the exact optimum."""
    figure, axes = _figure(2, 3, (11.0, 5.4))
    for column, (name, orders) in enumerate(EXAMPLES.items()):
        problem = find(name)
        n, T = len(problem.states), problem.horizon
        exact = tpbvp(problem)
        t = np.linspace(0.0, T, 101)
        u = np.array(problem.extremal.function(exact.z)[1])
        for i in range(n):
            axes[0, column].plot(exact.t, exact.z[i], "k", lw=0.8, label="optimum" if i == 0 else None)
        for i in range(u.shape[0]):
            axes[1, column].plot(exact.t, u[i], "k", lw=0.8)
        for order, style in zip(orders, ("--", ":"), strict=True):
            values = np.array([solve(problem, order)(at) for at in t]).T
            for i in range(n):
                label = f"order {order}" if i == 0 else None
                axes[0, column].plot(t, values[i], style, color=f"C{i}", lw=1.6, label=label)
            for i in range(u.shape[0]):
                axes[1, column].plot(t, values[2 * n + i], style, color=f"C{i}", lw=1.6)
        axes[0, column].set_title(name.replace("_", " "), fontsize=9)
        axes[0, column].legend(fontsize=7)
        axes[1, column].set_xlabel("time, s")
    axes[0, 0].set_ylabel("states")
    axes[1, 0].set_ylabel("controls")
    figure.savefig(path, dpi=100)


def costs(path: Path) -> None:
    """Draw the cost of the polynomials over the order, the least cost, impossible costs, and the published ones."""
    figure, axes = _figure(1, 3, (11.0, 3.2))
    for axis, name in zip(axes[0], EXAMPLES, strict=True):
        problem = find(name)
        least = least_cost(problem)
        off = np.array(solve(problem, 14).J) / least - 1.0
        order = np.arange(1, off.size + 1)
        below = off < -1e-6
        axis.axhline(0.0, color="k", lw=0.8, label="least cost")
        axis.plot(order, off, ".-", color="C0", lw=0.8, label="by the polynomials")
        axis.plot(order[below], off[below], "x", color="C3", ms=8, label="infeasible")
        printed = np.array(PUBLISHED_J[name]) / least - 1.0
        axis.plot(order[: printed.size], printed, "o", color="C1", mfc="none", ms=8, label="published")
        axis.set_yscale("symlog", linthresh=1e-6)
        axis.set_title(name.replace("_", " "), fontsize=9)
        axis.set_xlabel("order")
    axes[0, 0].set_ylabel("J / least J - 1")
    axes[0, 2].legend(fontsize=7)
    figure.savefig(path, dpi=100)


def end_error(problem: Problem, solution: Solution, periods: int = 4000) -> float:
    """Return the rate that remains at the end under the planned control, relative to the start; in holds of T/4000.

    Parameters
    ----------
    periods : int
        Number of holds over the horizon, each taken in its middle.
    """
    step, n, T = step_function("ocp_picture", problem, 1), len(problem.states), problem.horizon
    x = problem.x0
    for k in range(periods):
        u = solution((k + 0.5) * T / periods)[2 * n :]
        *remaining, _ = step((*x, *u, T / periods))
        x = tuple(remaining)
    return float(np.linalg.norm(np.array(x)) / np.linalg.norm(problem.x0))


def errors(path: Path) -> None:
    """Draw the end error of the spacecraft over the order, and over its rates, with and without stages."""
    figure, axes = _figure(1, 2, (9.0, 3.4))
    plain = find("spacecraft")
    orders = range(1, 17)
    axes[0, 0].semilogy(orders, [end_error(plain, solve(plain, n)) for n in orders], ".-")
    axes[0, 0].set_xlabel("order")
    axes[0, 0].set_ylabel("end error / rate at the start")
    times = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0)
    for order, stages in ((8, 1), (16, 1), (24, 1), (16, 8)):
        left = []
        for factor in times:
            problem = plain.changed(x0=[factor * w for w in plain.x0])
            left.append(end_error(problem, solve(problem, order, stages=stages)))
        label = f"order {order}" + (f", {stages} stages" if stages > 1 else "")
        axes[0, 1].loglog(times, left, ".-", label=label)
    axes[0, 1].set_xlabel("rates, times the published")
    axes[0, 1].legend(fontsize=7)
    for axis in axes[0]:
        axis.grid(lw=0.3)
    figure.savefig(path, dpi=100)


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    plans(folder / "optimal_control_plans.png")
    costs(folder / "optimal_control_costs.png")
    errors(folder / "optimal_control_errors.png")
