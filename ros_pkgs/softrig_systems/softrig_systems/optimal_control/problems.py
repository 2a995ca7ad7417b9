r"""The three problems of the paper and a fourth one.

Source of the first three: the paper's examples 1 to 3, with the corrections of the suite's page. The fourth is the
stirred tank of D. E. Kirk, Optimal Control Theory, 1970, section 6.2: exponential, quotient, and a control that
multiplies a state.
"""

from __future__ import annotations

import importlib.metadata
from functools import lru_cache
from typing import Any

from .method.exact import scalar_cost, spacecraft_cost
from .problem import Problem, ProblemError

INERTIA = (86.24, 85.07, 113.59)


def _scalar() -> Problem:
    r""":math:`\dot x = x^2 \sin(x)/2 + u`, J = int u^2 dt (no 1/2); hence u = -lambda/2."""
    import casadi as ca

    return Problem(
        "scalar",
        {"x": "1"},
        {"u": "1"},
        lambda x, u: [x[0] ** 2 * ca.sin(x[0]) / 2 + u[0]],
        lambda x, u: u[0] ** 2,
        x0=(0.0,),
        horizon=1.0,
        x_end=(0.5,),
        exact=scalar_cost,
    )


@lru_cache(maxsize=8)
def spacecraft(inertia: tuple[float, ...] = INERTIA) -> Problem:
    r"""Bring a spacecraft to rest: :math:`I_1 \dot w_1 = (I_2 - I_3) w_2 w_3 + u_1`, cyclic; J = 1/2 int |u|^2.

    Parameters
    ----------
    inertia : tuple of 3 floats
        Principal moments, kg m^2.

    Raises
    ------
    ProblemError
        A moment is not positive, or it is larger than the sum of the other two, which no body has.
    """
    if len(inertia) != 3 or not all(0.0 < moment < float("inf") for moment in inertia):
        raise ProblemError(f"inertia = {inertia}: expected 3 positive moments, kg m^2")
    if 2.0 * max(inertia) > sum(inertia):
        raise ProblemError(
            f"inertia = {inertia}: {max(inertia):g} is more than the other two together, as of no body; expected "
            f"at most {sum(inertia) - max(inertia):g} kg m^2"
        )
    I1, I2, I3 = inertia

    def ode(w: Any, u: Any) -> list[Any]:
        return [
            ((I2 - I3) * w[1] * w[2] + u[0]) / I1,
            ((I3 - I1) * w[2] * w[0] + u[1]) / I2,
            ((I1 - I2) * w[0] * w[1] + u[2]) / I3,
        ]

    axes = [f"axis_{k}" for k in (1, 2, 3)]
    return Problem(
        "spacecraft",
        dict.fromkeys(axes, "rad/s"),
        dict.fromkeys(axes, "N m"),
        ode,
        lambda w, u: (u[0] ** 2 + u[1] ** 2 + u[2] ** 2) / 2,
        x0=(0.01, 0.005, 0.001),
        horizon=100.0,
        x_end=(0.0, 0.0, 0.0),
        carrier="velocity",
        exact=lambda problem: spacecraft_cost(problem, inertia),
    )


TWO_STATE = Problem(
    "two_state",
    {"x1": "1", "x2": "1"},
    {"u": "1"},
    lambda x, u: [x[1] + x[0] * x[1], -x[0] + x[1] + x[1] ** 2 + u[0]],
    lambda x, u: (x[0] ** 2 + x[1] ** 2 + u[0] ** 2) / 2,
    x0=(-0.8, 0.0),
    horizon=1.0,
)


def _reactor() -> Problem:
    """Stirred tank: deviations of temperature x1 and concentration x2; the coolant flow u multiplies x1 + 0.25."""
    import casadi as ca

    def ode(x: Any, u: Any) -> list[Any]:
        reaction = (x[1] + 0.5) * ca.exp(25.0 * x[0] / (x[0] + 2.0))
        return [-2.0 * (x[0] + 0.25) + reaction - (x[0] + 0.25) * u[0], 0.5 - x[1] - reaction]

    return Problem(
        "reactor",
        {"x1": "1", "x2": "1"},
        {"u": "1"},
        ode,
        lambda x, u: x[0] ** 2 + x[1] ** 2 + 0.1 * u[0] ** 2,
        x0=(0.05, 0.0),
        horizon=0.78,
    )


PROBLEMS = {p.name: p for p in (_scalar(), spacecraft(), TWO_STATE, _reactor())}
GROUP = "softrig_problems"  # group of entry points


def find(name: str) -> Problem:
    """Find a problem by its name: one of ours, or the entry point of an installed package in the group `GROUP`.

    Raises
    ------
    ProblemError
        There is none; the message lists those that exist. Only registered code is imported, because a scenario may be
        untrusted.
    """
    if name in PROBLEMS:
        return PROBLEMS[name]
    points = importlib.metadata.entry_points(group=GROUP)
    if name not in points.names:
        known = ", ".join([*PROBLEMS, *sorted(points.names)])
        raise ProblemError(
            f"problem = {name!r}: expected one of {known}; a package registers its own in the group {GROUP}"
        )
    try:
        result = points[name].load()
    except (ImportError, AttributeError) as error:
        raise ProblemError(f"problem = {name!r} ({points[name].value}) cannot be loaded: {error}") from None
    if not isinstance(result, Problem):
        raise ProblemError(f"problem = {name!r}: {points[name].value} is a {type(result).__name__}, expected a Problem")
    return result
