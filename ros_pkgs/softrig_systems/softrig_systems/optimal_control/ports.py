"""Topics of the problems; a user's own planner or player only needs these."""

from __future__ import annotations

from softrig_core import Port, array, command, joint_state, scalars

from .problem import Problem

ESCAPED = 1e3  # size of a state with which no loop comes back
SUMMARY = {
    "start": "s",
    "horizon": "s",
    "order": "",
    "J_series": "",
    "residual": "",
    "end_error": "",
    "converged": "",
    "trusted": "",
}
"""What comes with a plan: when it begins, how long it is, its cost by its own account, whether it is to be trusted."""


def state(problem: Problem) -> Port:
    """Return the port of the measured state; with velocities it includes the previously applied effort."""
    units = tuple(problem.states.values())
    limits = [ESCAPED] * len(units)
    if problem.carrier == "velocity":
        efforts = tuple(problem.controls.values())
        limits += command("command", "", tuple(problem.controls), efforts).limits
        return joint_state("state", "ocp/state", tuple(problem.states), velocity=units, effort=efforts, limits=limits)
    return joint_state("state", "ocp/state", tuple(problem.states), position=units, limits=limits)


def control(problem: Problem) -> Port:
    """Return the port of the command."""
    return command("command", "ocp/command", tuple(problem.controls), tuple(problem.controls.values()))


def plan(problem: Problem, columns: int, *, stages: int = 1, label: str = "power", output: bool = False) -> Port:
    """Return the port of a plan: rows are states, costates and controls; a leading dimension where there are stages."""
    rows = 2 * len(problem.states) + len(problem.controls)
    dims = {"stage": stages} if stages > 1 else {}
    return array("plan", "ocp/plan", {**dims, "variable": rows, label: columns}, "", sporadic=output)


def summary(*, output: bool = False) -> Port:
    """Return the port of a plan's summary."""
    return scalars("summary", "ocp/summary", SUMMARY, sporadic=output)
