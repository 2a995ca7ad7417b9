"""One run of a study or of a search for violations, in a worker, and its row."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from softrig_core import SECOND, Rig, Run, RunError, Scenario, ScenarioError, evaluate, simulate
from softrig_core.errors import Impure
from softrig_core.rig.outside import is_foreign
from softrig_core.run.stuck import watch_on
from softrig_core.scenario.scenario import Draft
from softrig_core.solver.solver import Solver

from .draw import Case

# JSON has no infinity, so this number stands for it in the margins of rows.
LARGE = 1e300
# The CPU time in s that the rest of a first run may take; if it takes more, it is better left to the workers.
LEFT = 0.1


class Work(NamedTuple):
    """A case and the data to keep of it; sent to the worker.

    Parameters
    ----------
    figures : tuple of str
        All when empty.
    signals, samples
        See `Study`.
    runs : int
        Number of tasks of this kind that all workers will get.
    scenario : Draft or Scenario, optional
        What the case names, read before; absent: read by that name.
    strict : bool
        Whether a changed run is also judged by numbers published for the unchanged machine, as by `run --strict`.
    margins : bool
        Whether to compute the margins of `figures`, which are requirements or figures with an expected bound.
    """

    case: Case
    duration: float | None = None
    figures: tuple[str, ...] = ()
    signals: tuple[str, ...] = ()
    samples: int = 0
    runs: int = 1
    scenario: Draft | Scenario | None = None
    strict: bool = False
    margins: bool = False


def trial(
    scenario: Scenario, overrides: dict[str, Any], requirements: Iterable[str], number: int = -1, runs: int = 1
) -> Work:
    """Return the task of a run that computes only the margins of requirements."""
    case, names = Case(number, scenario.name, "", overrides, scenario.seed), tuple(requirements)
    asked = {
        kind: {name: entry for name, entry in getattr(scenario, kind).items() if name in names}
        for kind in ("figures", "expect")
    }
    scenario = scenario.model_copy(update={**asked, "claims": {}})
    return Work(case, figures=names, runs=runs, scenario=scenario, margins=True)


def run(work: Work, thorough: bool = False) -> dict[str, Any]:
    """Run one case in this process and return its row; the row of a failed run has its error.

    Where margins are wanted, so does one whose parameters do not fit each other.

    Parameters
    ----------
    thorough : bool
        See `softrig_core.simulate`.

    Raises
    ------
    ScenarioError
        Bad input: no run of such a study can work.
    Impure
        What a block answers depends on runs before this one, so no row could be trusted.
    """
    from multiprocessing import parent_process

    # This process has run a study only if it is a worker, and no other code of it minds the thread that watches.
    if parent_process() is not None:
        watch_on()
    case = work.case
    row = case._asdict() | {
        "figures": dict.fromkeys(work.figures if work.margins else ()),
        "passed": False,
        "error": "",
    }
    started = time.perf_counter()
    try:
        done = simulate(
            work.scenario or case.scenario,
            seed=case.seed,
            duration=work.duration,
            overrides=case.overrides,
            runs=work.runs,
            # All signals are compared, so that the first that differs names the node at fault.
            signals=None if thorough else work.signals,
            thorough=thorough,
        )
        row |= _margins(done, work.figures) if work.margins else _figures(done, work)
    except (RunError, ScenarioError) as error:
        if isinstance(error, Impure) or (isinstance(error, ScenarioError) and not work.margins):
            raise
        row["error"] = str(error)
    return row | {"wall_s": time.perf_counter() - started}


def warm(rig: Rig, work: Work) -> None:
    """Run a case until little of it is left, so that copies of this process share what a run imports and loads.

    Rigs with blocks that are not softrig's own are left out, because these may end the process; so are rigs with a
    solver, which works in a process of its own.
    """
    if any(is_foreign(m.block_class) or issubclass(m.block_class, Solver) for m in rig.members):
        return
    calls: list[tuple[float, float]] = []

    def enough(t: int) -> None:
        calls.append((t / SECOND, time.process_time()))
        # Imports and loading are part of the first interval.
        if len(calls) > 2:
            (begin, earlier), (end, now) = calls[-2:]
            if (now - earlier) * (rig.scenario.duration - end) > LEFT * (end - begin):
                raise RunError("enough of it has run")

    # The run itself reports what is wrong with it.
    with suppress(RunError, ScenarioError):
        done = simulate(rig, seed=work.case.seed, progress=enough, runs=work.runs, signals=work.signals)
        _figures(done, work)


def repeated(name: str, work: Work, row: Mapping[str, Any]) -> None:
    """Run a case twice more in this process; compare both runs, and their results with the row of a worker.

    `check_pure` detects what the first ticks store outside of x, and each run detects what remains in the variables of
    a block's own modules. This check detects what takes effect later and is stored elsewhere, such as in a library.

    Raises
    ------
    Impure
        Something differs; names the signal, or the figure, and both values. The rows are kept.
    """
    try:
        again = run(work, thorough=True)
    except Impure as error:
        raise Impure(f"{name}: run {row['number']}, computed again after all others: {error}") from None
    for figure, value in row["figures"].items():
        if again["figures"].get(figure) != value:
            raise Impure(
                f"{name}: run {row['number']} ({row['overrides']}), computed again after all others, has {figure} = "
                f"{again['figures'].get(figure)}, not {value}: a block keeps something outside of x that matters after "
                "its first ticks, so rows depend on those before them; make it part of x"
            )


def repeating(work: Work) -> dict[str, Any]:
    """Run a case twice and return its row, which a search uses.

    Raises
    ------
    ScenarioError
        The second run differs; names the first difference.
    """
    row, again = run(work), run(work)
    if row["figures"] != again["figures"]:
        raise ScenarioError(
            f"{work.case.scenario}: two runs with the same parameters and seed differ{_parting(work)}; a search needs "
            "blocks that read no clock and draw numbers from their seed only"
        )
    return row


def _parting(work: Work) -> str:
    first, second = (recorded(work, work.case.seed) for _ in range(2))
    results = [
        (topic.times[k], name)
        for name, topic in first.items()
        for k, (first_row, second_row) in enumerate(zip(topic.data, second[name].data, strict=False))
        if first_row != second_row
    ]
    return f", first on {min(results)[1]} at t = {min(results)[0] / SECOND:.9g} s" if results else ""


def recorded(work: Work, seed: int) -> Mapping[str, Any]:
    """Run a case with a seed and return its recording by topic."""
    scenario, overrides = work.scenario or work.case.scenario, work.case.overrides
    return simulate(scenario, seed=seed, duration=work.duration, overrides=overrides, runs=work.runs).recording.topics


def _figures(done: Run, work: Work) -> dict[str, Any]:
    done.strict = work.strict
    judged, unjudged = any(r.judged for r in done.results), [r.name for r in done.results if r.published_for]
    wanted = [r for r in done.results if not work.figures or r.name in work.figures]
    missing = set(work.figures) - {r.name for r in wanted}
    if missing:
        raise ScenarioError(f"{work.case.scenario} has no figure {min(missing)!r}")
    sampled = {name: _sampled(done.signals[name], work.samples) for name in work.signals}
    missed = [r.name for r in done.missed]
    return {
        "figures": {r.name: r.number if math.isfinite(r.number) else None for r in wanted},
        "never": [r.name for r in wanted if r.number == np.inf],
        "missed": missed,
        # Where nothing was judged there is no verdict, which is neither passed nor failed.
        "passed": not missed if judged or missed else None,
        **({"not_judged": unjudged, "published_for": done.published_for} if unjudged else {}),
        **({"signals": sampled} if sampled else {}),
    }


def _margins(done: Run, names: Collection[str]) -> dict[str, Any]:
    # A search needs these alone, and measuring the others would take time in each run.
    wanted = [f for f in done.wanted or () if f.name in names]
    results, scenario = {r.name: r for r in evaluate(done.rig, done.signals, wanted)}, done.rig.scenario
    margins: dict[str, float | None] = {}
    error = ""
    for name in names:
        result, bounds = results[name], scenario.expect.get(name)
        formula = name in scenario.requirements
        margin = result.number if bounds is None or formula else bounds.margin(result.number)
        margins[name] = None if math.isnan(margin) else max(-LARGE, min(LARGE, margin))
        error = f"{name}: {result.error}" if math.isnan(margin) else error
    return {"figures": margins, "passed": all(m is not None and m >= 0.0 for m in margins.values()), "error": error}


def value_of(row: Mapping[str, Any], figure: str) -> float:
    """Return a figure of a row: infinity for an event that never happens, NaN for an unmeasured one."""
    value = row["figures"].get(figure)
    return float(value) if value is not None else np.inf if figure in row.get("never", ()) else np.nan


def absent(values: Iterable[float]) -> str:
    """Describe of how many runs there is no value: ``1 of 3 never``; empty when all have one."""
    result = np.array(list(values), float)
    never, lost = int(np.isposinf(result).sum()), int(np.isnan(result).sum())
    parts = [f"{never} of {result.size} never"] if never else []
    return ", ".join(parts + ([f"{lost} of {result.size} not measured"] if lost else []))


def _sampled(signal: Any, samples: int) -> dict[str, Any]:
    """Sample a signal at equal distances; it holds its value between its samples."""
    t, x = signal
    if t.size == 0:
        return {"end": 0.0, "x": []}
    times = np.linspace(t[0], t[-1], samples)
    indices = np.clip(np.searchsorted(t, times, side="right") - 1, 0, t.size - 1)
    return {"end": float(t[-1]), "x": x[indices].tolist()}
