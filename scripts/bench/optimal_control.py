"""CPU time of one solve of the planners for the spacecraft."""

from __future__ import annotations

from collections.abc import Callable

from softrig_systems.optimal_control.method import collocation
from softrig_systems.optimal_control.method.exact import tpbvp
from softrig_systems.optimal_control.method.mvim import solve
from softrig_systems.optimal_control.problems import find

from .timing import least


def print_table() -> None:
    """One plan for the spacecraft by series, collocation and as a boundary value problem, CPU time."""
    problem = find("spacecraft")
    whole = collocation.solve(problem)
    later = problem.changed(x0=whole.rows[:3, 10].tolist(), horizon=90.0)
    guess = collocation.sampled(whole.rows, 100.0, 90.0, 3)
    rows: dict[str, Callable[[], object]] = {f"series, order {n}": lambda n=n: solve(problem, n) for n in (4, 8, 12)}  # type: ignore[misc]
    rows |= {
        "series, order 16 in 8 stages": lambda: solve(problem, 16, stages=8),
        "collocation, from a straight line": lambda: collocation.solve(problem),
        "collocation, from the last plan": lambda: collocation.solve(later, guess=guess),
        "boundary value problem, tolerance 1e-9": lambda: tpbvp(problem),
    }
    print("optimal control of the spacecraft, CPU time of a solve")
    for name, work in rows.items():
        print(f"  {name:40s} {1e3 * least(work, 7):8.2f} ms")
