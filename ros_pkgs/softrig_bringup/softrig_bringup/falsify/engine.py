"""A falsification from its definition to its outcome: searched on all cores, resumed, reduced."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softrig_core import Scenario, ScenarioError, figures_of, load_scenario, rig_of
from softrig_core.errors import closest
from softrig_core.extras import need
from softrig_core.guard import replace
from softrig_core.run.purity import check_pure, is_suspect
from softrig_core.verdict.figures import follows

from ..run.run import checked
from ..study.batch import Batch, Log
from ..study.engine import made_of, same
from ..study.work import LARGE, repeated, repeating, run, trial
from .definition import Falsification
from .search import Point, SearchResult, needs, search
from .shrink import Case, shrink
from .space import Over, Space, parse, space_of
from .words import shown

SHRINKING = 100  # runs that may be used to make a violation small


@dataclass(frozen=True)
class Prepared:
    """A falsification with checked input.

    Parameters
    ----------
    names : tuple of str
        The requirements.
    nominal : dict of str to float or None
        Their margins without changes.
    content : dict
        Everything that distinguishes it from other falsifications.
    published : tuple of str
        Those of `names` whose bounds apply to the unchanged machine.
    not_judged : tuple of str
        Requirements of the scenario that were left out, because they have such bounds and were not requested.
    machine : str
        Parameters of the unchanged machine.
    """

    space: Space
    names: tuple[str, ...]
    nominal: dict[str, float | None]
    content: dict[str, Any]
    published: tuple[str, ...] = ()
    not_judged: tuple[str, ...] = ()
    machine: str = ""


@dataclass(frozen=True, kw_only=True)
class Outcome(Prepared):
    """The result of a falsification.

    Parameters
    ----------
    worst : dict of str to float or None
        Margins of the worst run.
    search : SearchResult
        The search result; with several requirements, each margin is divided by its magnitude in the nominal run.
    case : Case, optional
        The worst run; None when no run could be measured.
    small : Case, optional
        The violation after it was reduced to smaller changes; None if there is no violation.
    shrinking : int
        Number of runs that the reduction needed.
    broken : list of (dict, str)
        Changes of each run that failed, and the reason of the failure.
    """

    worst: dict[str, float | None]
    search: SearchResult
    case: Case | None
    small: Case | None
    small_margins: dict[str, float | None]
    shrinking: int
    broken: list[tuple[dict[str, Any], str]]

    @property
    def violated(self) -> list[str]:
        """Requirements that the worst run violates."""
        return [name for name, margin in self.worst.items() if margin is not None and margin < 0.0]

    @property
    def bounds(self) -> list[str]:
        """Describe which bounds are published for the unchanged machine: those that were requested, and the others."""
        messages = {"asked by name": self.published, "not judged": self.not_judged}
        return [f"{how}: {', '.join(names)}, published for {self.machine}" for how, names in messages.items() if names]


def prepare(task: Falsification) -> Prepared:
    """Check the input of a falsification, and run its unchanged scenario; nothing is written.

    Raises
    ------
    ScenarioError
        Bad input, a package that is missing, or a run that cannot be judged.
    """
    scenario = load_scenario(task.scenario).changed(duration=task.duration)
    names = _requirements(scenario, task.requirements)
    space = space_of(scenario, [parse(key, interval) for key, interval in task.over.items()])
    machine = ", ".join(map(_before, space.overs, space.nominal))
    free = {"name", "title", "expect", "budget", "first"}
    rig = checked(scenario)
    unjudged = {f.name for f in figures_of(rig) if not follows(f, rig.scenario.expect.get(f.name))}
    left = () if task.requirements or task.strict else tuple(name for name in names if name in unjudged)
    if len(left) == len(names):
        raise ScenarioError(
            f"{task.scenario}: all requirements ({', '.join(left)}) are published for {machine}; expected "
            "--strict, which judges another machine by them, or --requirement NAME"
        )
    names = tuple(name for name in names if name not in left)
    content = task.model_dump(mode="json", exclude=free) | made_of({task.scenario: scenario}, [rig])
    check_pure(rig)
    if package := needs(task.sampler, space.size):
        need(package, "falsify")
    nominal = repeating(trial(scenario, {}, names, runs=task.budget))
    if nominal["error"]:
        raise ScenarioError(f"{task.scenario}: the run without changes cannot be judged: {nominal['error']}")
    return Prepared(space, names, nominal["figures"], content, tuple(n for n in names if n in unjudged), left, machine)


def _before(over: Over, nominal: Any) -> str:
    """Return the unchanged values of all that a search changes."""
    return f"{over.key} as it is" if nominal is None else f"{over.key} = {shown(nominal)}"


def falsify(
    task: Falsification, prepared: Prepared, out: Path, *, workers: int | None = None, scheduler: str = ""
) -> Outcome:
    """Search, and reduce the violation that is found.

    Parameters
    ----------
    prepared : Prepared
        Result of `prepare` for it.
    out : Path
        Folder for ``falsification.json`` and ``rows.jsonl``; runs that an earlier call stored there are not repeated.
    workers, scheduler
        See `softrig_optim.sweep.Workers`.

    Raises
    ------
    ScenarioError
        The folder holds another falsification.
    """
    space, names = prepared.space, prepared.names
    replace(out / "falsification.json", same(prepared.content, out / "falsification.json", "falsification"))
    sizes = _sizes(prepared.nominal)
    asked: list[Point] = []
    rows: list[dict[str, Any]] = []
    with Batch(task.name, Log(out / "rows.jsonl", task.budget), workers, scheduler) as batch:

        def measure(points: Sequence[Point]) -> list[float]:
            works = [
                trial(space.scenario, space.overrides(point), names, number, task.budget)
                for number, point in enumerate(points, len(asked))
            ]
            new = batch.rows(works)
            asked.extend(points)
            rows.extend(new)
            return [margin(row["figures"], sizes) for row in new]

        match = search(
            [over.size for over in space.overs],
            measure,
            task.budget,
            seed=task.seed,
            sampler=task.sampler,
            enough=0.0 if task.first else -math.inf,
        )
    complete = [(point, row) for point, row in zip(asked, rows, strict=True) if not row["error"]]
    if complete and is_suspect(rig_of(space.scenario)):
        point, last = complete[-1]
        repeated(task.name, trial(space.scenario, space.overrides(point), names, last["number"], task.budget), last)
    broken = [(row["overrides"], row["error"]) for row in rows if row["error"]]
    worst = next((row for row, point in zip(rows, asked, strict=True) if point == match.point), None)
    case = None if worst is None else (space.scenario, dict(worst["overrides"]))
    small, small_margins, runs = None, {}, 0
    if worst is not None and case is not None and match.least < 0.0:
        violated = tuple(n for n, m in worst["figures"].items() if m is not None and m < 0.0)
        small, runs = shrink(space, case[1], lambda c: _violates(c, violated), SHRINKING)
        small_margins = run(trial(*small, names, runs=SHRINKING))["figures"]
    return Outcome(
        **vars(prepared),
        worst=worst["figures"] if worst is not None else {},
        search=match,
        case=case,
        small=small,
        small_margins=small_margins,
        shrinking=runs,
        broken=broken,
    )


def _requirements(scenario: Scenario, wanted: Sequence[str]) -> tuple[str, ...]:
    bounded = [
        n
        for n, e in scenario.expect.items()
        if e.at_most is not None or e.at_least is not None or (e.text or "").startswith(("at ", "between "))
    ]
    known = list(dict.fromkeys([*scenario.requirements, *bounded]))
    if not scenario.requirements and not wanted:
        raise ScenarioError(
            f"{scenario.name} has no requirements; it needs an entry requirements: NAME: FORMULA, or "
            "--requirement FIGURE with an expected bound"
        )
    for name in wanted:
        if name not in known and name in scenario.figures:
            text = "has an expectation on both sides" if name in scenario.expect else "has no expectation"
            raise ScenarioError(
                f"{scenario.name}: figure {name} {text}, no bound that a run could violate; it needs an entry expect: "
                f"{name}: at most NUMBER (or at least NUMBER)"
            )
        if name not in known:
            raise ScenarioError(
                f"{scenario.name} has no requirement {name!r}{closest(name, known)}; it has "
                f"{', '.join(known) or 'none'}"
            )
    return tuple(wanted) or tuple(scenario.requirements)


def _sizes(nominal: Mapping[str, float | None]) -> dict[str, float]:
    """Return the scales of margins: each margin is divided by its scale before margins are compared."""
    # One margin keeps its unit; several are divided by their nominal size to be compared.
    if len(nominal) == 1:
        return dict.fromkeys(nominal, 1.0)
    return {n: abs(m) if m is not None and 0.0 < abs(m) < LARGE else 1.0 for n, m in nominal.items()}


def margin(margins: Mapping[str, float | None], sizes: Mapping[str, float]) -> float:
    """Return the least of several margins, each divided by its scale; NaN if one could not be measured."""
    results = [m / sizes[n] for n, m in margins.items() if m is not None]
    return min(results) if len(results) == len(margins) else math.nan


def _violates(case: Case, names: tuple[str, ...]) -> bool:
    margins = run(trial(*case, names, runs=SHRINKING))["figures"]
    return any(m is not None and m < 0.0 for m in margins.values())
