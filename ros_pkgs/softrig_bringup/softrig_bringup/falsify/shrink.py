"""A violation made small: fewer faults, profiles with fewer steps, parameters back towards what they were."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from softrig_core import Scenario

from .space import Over, Space

Case = tuple[Scenario, dict[str, Any]]  # a scenario and what is changed in it
HALVINGS = 5  # of the way of a parameter back to its nominal value


def shrink(space: Space, overrides: dict[str, Any], violates: Callable[[Case], bool], budget: int) -> tuple[Case, int]:
    """Make a violation small while it stays one.

    Parameters
    ----------
    space : Space
    overrides : dict
        Of the violation.
    violates : callable
        Runs a case.
    budget : int
        Largest number of runs.

    Returns
    -------
    case : (Scenario, dict)
    runs : int
        How many were needed.
    """
    case: Case = (space.scenario, dict(overrides))
    runs = 0
    for candidates in (_without_faults, _nominal, _fewer_steps):
        again = True
        while again:
            again = False
            for candidate in candidates(space, case):
                if runs >= budget:
                    return case, runs
                runs += 1
                if violates(candidate):
                    case, again = candidate, True
                    break
    return case, runs


def _without_faults(space: Space, case: Case) -> Iterator[Case]:
    """Each fault dropped."""
    scenario, overrides = case
    for name in scenario.faults:
        faults = {n: f for n, f in scenario.faults.items() if n != name}
        left = {k: v for k, v in overrides.items() if not k.startswith(f"{name}.")}
        yield scenario.model_copy(update={"faults": faults}), left


def _nominal(space: Space, case: Case) -> Iterator[Case]:
    """Each parameter at its nominal value, or most of the way back to it."""
    scenario, overrides = case
    for over, target, nominal, whole in zip(space.overs, space.targets, space.nominal, space.whole, strict=True):
        if target not in overrides or over.on_signal:
            continue
        left = {k: v for k, v in overrides.items() if k != target}
        yield scenario, left
        now = overrides[target]
        if whole or over.count or not over.low <= nominal <= over.high:
            continue
        a, b = over.place(now), over.place(nominal)
        for k in range(1, HALVINGS + 1):  # from the longest step back to the shortest
            value = over.value(b + (a - b) * 0.5 ** (HALVINGS + 1 - k))
            if abs(over.place(value) - b) < 0.9 * abs(a - b):
                yield scenario, left | {target: value}


def _fewer_steps(space: Space, case: Case) -> Iterator[Case]:
    """Each step of a profile or list made equal to its neighbour, then to the middle of the range."""
    scenario, overrides = case
    for over, target in zip(space.overs, space.targets, strict=True):
        points = overrides.get(target)
        if not over.count or points is None:
            continue
        for i in range(1, len(points)):
            if points[i] != points[i - 1]:
                for value in (points[i - 1], points[i]):
                    merged = _levelled(points, i, value)
                    yield scenario, overrides | {target: merged}
        if over.on_signal and over.adds:
            yield from _zeroed(over, target, case)


def _levelled(points: list[float], i: int, value: float) -> list[float]:
    """Give both steps that meet at `i` one value, for as long as each lasts."""
    first = last = i
    while first > 0 and points[first - 1] == points[i - 1]:
        first -= 1
    while last < len(points) and points[last] == points[i]:
        last += 1
    return [*points[:first], *([value] * (last - first)), *points[last:]]


def _zeroed(over: Over, target: str, case: Case) -> Iterator[Case]:
    """What is added, nothing in one step."""
    scenario, overrides = case
    points = overrides[target]
    if over.low <= 0.0 <= over.high:
        for i, value in enumerate(points):
            if value != 0.0:
                yield scenario, overrides | {target: [*points[:i], 0.0, *points[i + 1 :]]}
