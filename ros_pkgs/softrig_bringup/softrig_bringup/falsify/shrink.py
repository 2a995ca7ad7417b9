"""Reduction of a violation: fewer faults, profiles with fewer steps, parameters closer to their original values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from softrig_core import Scenario

from .space import Over, Space

Case = tuple[Scenario, dict[str, Any]]  # a scenario and what is changed in it
# With so many halvings a parameter is found to 1/4096 of the way back to its nominal value.
HALVINGS = 12


def shrink(space: Space, overrides: dict[str, Any], violates: Callable[[Case], bool], budget: int) -> tuple[Case, int]:
    """Reduce a violation as long as it remains one.

    Parameters
    ----------
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
        Number of runs that were needed.
    """
    runs = 0

    def still(candidate: Case) -> bool:
        nonlocal runs
        if runs >= budget:
            return False
        runs += 1
        return violates(candidate)

    case: Case = (space.scenario, dict(overrides))
    # Faults are dropped first, because their parameters then need no shrinking.
    case = _greedily(_without_faults, space, case, still)
    case = _nominal(space, case, still)
    return _greedily(_fewer_steps, space, case, still), runs


def _greedily(
    candidates: Callable[[Space, Case], Iterator[Case]], space: Space, case: Case, still: Callable[[Case], bool]
) -> Case:
    """Replace the case by the first smaller one that violates, again and again."""
    while (result := next((c for c in candidates(space, case) if still(c)), None)) is not None:
        case = result
    return case


def _without_faults(space: Space, case: Case) -> Iterator[Case]:
    """Yield the case without each of its faults; pictures of the fault are dropped, too."""
    scenario, overrides = case
    for name, fault in scenario.faults.items():
        faults = {n: f for n, f in scenario.faults.items() if n != name}
        left = {k: v for k, v in overrides.items() if not k.startswith(f"{name}.")}
        prefix = f"{fault.link.partition('->')[0].strip()}/{name}/"  # prefix of the signals that the fault publishes
        drawn = [(p, {s: label for s, label in p.signals.items() if prefix not in s}) for p in scenario.plots]
        plots = tuple(p.model_copy(update={"signals": signals}) for p, signals in drawn if signals)
        yield scenario.model_copy(update={"faults": faults, "plots": plots}), left


def _nominal(space: Space, case: Case, still: Callable[[Case], bool]) -> Case:
    """Move each parameter to its nominal value, or by halving as near to it as the violation allows."""
    for over, target, nominal, integral in zip(space.overs, space.targets, space.nominal, space.integral, strict=True):
        scenario, overrides = case
        if target not in overrides or over.on_signal:
            continue
        left = {k: v for k, v in overrides.items() if k != target}
        if still((scenario, left)):
            case = scenario, left
        else:
            case = _nearer(over, target, nominal, integral, case, still)
    return case


def _nearer(over: Over, target: str, nominal: Any, integral: bool, case: Case, still: Callable[[Case], bool]) -> Case:
    """Move one parameter towards its nominal value as far as the violation allows; a list moves as a whole."""
    scenario, overrides = case
    worst, good = (x if isinstance(x, list) else [x] for x in (overrides[target], nominal))
    # Lists of different lengths have no values in between.
    if len(worst) != len(good):
        return case
    log = over.log and min(good) > 0.0

    def between(share: float) -> Any:
        values = [a * (b / a) ** share if log else a + (b - a) * share for a, b in zip(good, worst, strict=True)]
        values = [round(v) for v in values] if integral else values
        return values if over.count else values[0]

    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2.0
        # Whole numbers have no value left in between.
        if between(middle) in (between(low), between(high)):
            break
        if still((scenario, overrides | {target: between(middle)})):
            high = middle
        else:
            low = middle
    return scenario, overrides | {target: between(high)}


def _fewer_steps(space: Space, case: Case) -> Iterator[Case]:
    """Return variants in which a step of a profile or list equals its neighbour, then the middle of the range."""
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
    """Return the profile with one value for the two steps that meet at `i`, each for its own length."""
    first = last = i
    while first > 0 and points[first - 1] == points[i - 1]:
        first -= 1
    while last < len(points) and points[last] == points[i]:
        last += 1
    return [*points[:first], *([value] * (last - first)), *points[last:]]


def _zeroed(over: Over, target: str, case: Case) -> Iterator[Case]:
    """Return the added disturbance with one step set to zero."""
    scenario, overrides = case
    points = overrides[target]
    if over.low <= 0.0 <= over.high:
        for i, value in enumerate(points):
            if value != 0.0:
                yield scenario, overrides | {target: [*points[:i], 0.0, *points[i + 1 :]]}
