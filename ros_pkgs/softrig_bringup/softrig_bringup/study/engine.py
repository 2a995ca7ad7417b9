"""Running a study: on all cores or a cluster, interrupted and resumed without loss."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from softrig_core import Rig, RunError, Scenario, ScenarioError, figures_of, rig_of
from softrig_core.errors import closest
from softrig_core.extras import need
from softrig_core.guard import replace
from softrig_core.judge.expectation import Expectation
from softrig_core.kit.file_format import json_of
from softrig_core.rig.code import fingerprints
from softrig_core.run.purity import check_pure, is_suspect
from softrig_core.scenario.scenario import Draft
from softrig_core.wire.signals import full_name
from softrig_optim.sweep import cores

from ..folder import STUDY, ResultsFolder
from ..options.names import check_names
from .batch import Batch, Log
from .definition import Search, Study
from .draw import Case, _values, cases, count, drafts_of, seeds_of
from .work import Work, recorded, repeated, repeating, value_of, warm


def run_study(
    study: Study, out: Path, *, workers: int | None = None, scheduler: str = "", distinct: bool = False
) -> Log:
    """Run those runs of a study that are not done yet.

    Parameters
    ----------
    out : Path
        Folder for ``study.json`` and ``rows.jsonl``; results of an earlier call are kept and not run again.
    workers, scheduler
        See `softrig_optim.sweep.Workers`.
    distinct : bool
        Whether to refuse, before the first row, seeds that all produce the same run; see `check_seeds`.

    Returns
    -------
    Log
        The rows, closed.

    Raises
    ------
    ScenarioError
        The input is bad, the folder has another study or foreign files with our names, or another call is using the
        folder.
    """
    folder = ResultsFolder(out, STUDY)
    # The files are read once, so that an edit during the study does not change it.
    drafts = drafts_of(study)
    rigs = check_study(study, drafts)
    content = content_of(study, drafts, rigs)
    same(content, out / "study.json", "study")
    if distinct and not (out / "study.json").exists():
        check_seeds(study, drafts)
    # Workers stay from row to row, and a row must not depend on those that its worker has run before.
    for rig in rigs:
        check_pure(rig)
    if study.search:
        repeating(_work(study, next(_first(study, study.search, drafts)), drafts))
    with folder.alone():
        try:
            # The folder is checked again under the lock, because another call may have written to it since.
            replace(out / "study.json", same(content, out / "study.json", "study"))
            log = Log(out / "rows.jsonl", count(study), None if study.search else cases(study, drafts))
            if len(log) < log.total and not scheduler and (workers or cores()) > 1:
                for rig, case in zip(rigs, _firsts(study, drafts), strict=True):
                    warm(rig, _work(study, case, drafts))
            with Batch(study.name, log, workers, scheduler) as batch:
                if study.search:
                    _search(study, study.search, batch, drafts)
                else:
                    deque(batch.run(_work(study, case, drafts) for case in cases(study, drafts)), 0)
                    check_last(study, drafts, rigs, log)
            return log
        finally:
            folder.close()


def check_last(study: Study, drafts: Mapping[str, Draft], rigs: Iterable[Rig], log: Log) -> None:
    """Compute the last row again in this process and compare it with the worker's, see `repeated`."""
    if not any(map(is_suspect, rigs)):
        return
    row = max((row for row in log.rows() if not row["error"]), key=itemgetter("number"), default=None)
    if row is not None:
        case = next(case for case in cases(study, drafts) if case.number == row["number"])
        repeated(study.name, _work(study, case, drafts), row)


def content_of(study: Study, drafts: Mapping[str, Draft], rigs: Iterable[Rig]) -> dict[str, Any]:
    """Return the inputs on which the rows of a study depend."""
    free = {"title", "source", "require", "summaries", "expect", "claims", "name", "changed"}
    scenarios = {name: draft.filled() for name, draft in drafts.items()}
    return study.model_dump(mode="json", exclude=free) | {"figures": _kept_figures(study)} | made_of(scenarios, rigs)


def check_seeds(study: Study, drafts: Mapping[str, Draft]) -> None:
    """Refuse several seeds of a study in whose first runs no node draws a random number: they are one run.

    Raises
    ------
    ScenarioError
        Two seeds of each case produce the same bytes.
    """
    if len(study.seeds or ()) < 2:
        return
    for case in _firsts(study, drafts):
        work = _work(study, case, drafts)
        try:
            first, second = (recorded(work, seed) for seed in (study.seeds or ())[:2])
        except RunError:
            return  # the row of the run reports the reason
        if any(topic.data != second[name].data for name, topic in first.items()):
            return
    raise ScenarioError(
        f"{study.name}: {len(study.seeds or ())} seeds give the same run, as no random number affects a message; "
        "expected draws (--draw), or one seed; --force runs all seeds"
    )


def _work(study: Study, case: Case, drafts: Mapping[str, Draft]) -> Work:
    return Work(
        case,
        study.duration,
        tuple(_kept_figures(study)),
        tuple(study.signals),
        study.samples,
        count(study) // max(1, len(study.cases)),
        drafts[case.scenario],
        study.strict,
    )


def _kept_figures(study: Study) -> list[str]:
    """Return the figures that a row keeps; all when empty."""
    sought = [study.search.figure, *study.search.subject_to] if study.search else []
    sought += [*study.require, *(summary.figure for summary in study.summaries.values())]
    return list(dict.fromkeys([*study.figures, *sought])) if study.figures else []


class OtherContentError(ScenarioError):
    """A folder holds rows that are not of this study or search."""


def made_of(scenarios: Mapping[str, Scenario], rigs: Iterable[Rig]) -> dict[str, Any]:
    """Return all that rows depend on besides the text of the study: scenarios, code, and files that blocks read."""
    # counters that do not occur in a run in process
    free = {"title", "source", "cites", "claims", "plots", "timeout", "start_timeout", "containers", "record"}
    rigs = list(rigs)
    members = [member for rig in rigs for member in rig.members if not member.external]
    return {
        "scenarios": {name: scenario.model_dump(mode="json", exclude=free) for name, scenario in scenarios.items()},
        "code": fingerprints(
            (member.block_class for member in members),
            (figure.function.__module__ for rig in rigs for figure in figures_of(rig)),
        ),
        "files": {m.name: dict(m.files) for m in members if m.files},
    }


def same(content: dict[str, Any], file: Path, noun: str) -> str:
    """Ensure that a folder has this content or none, because stored rows are reused by number.

    Raises
    ------
    OtherContentError
        It has other content; the text names the changed files if the definitions are equal.
    """
    if file.exists():
        try:
            stored = json_of(file.read_text())
        except ValueError:
            stored = None
        if stored != content:
            why = _changed(stored, content) if isinstance(stored, dict) else ""
            raise OtherContentError(f"{file.parent} holds another {noun}{why}; choose another --out, or remove it")
    return json.dumps(content, indent=1) + "\n"


def _changed(stored: dict[str, Any], current: dict[str, Any]) -> str:
    """Describe what has changed since a study with the same text; None if its text differs."""
    nouns = {"scenarios": "scenario", "code": "the code of", "files": "a file of"}
    if any(stored.get(key) != value for key, value in current.items() if key not in nouns):
        return ""
    for field, noun in nouns.items():
        old, new = stored.get(field), current[field]
        if not isinstance(old, dict):  # older results lack this field
            return ""
        if names := sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name)):
            return f" ({noun} {', '.join(names)} has changed)"
    return ""


def check_study(study: Study, drafts: Mapping[str, Draft]) -> list[Rig]:
    """Build and return the rig of the first run of each case, so that a misspelt name is reported before any run."""
    rigs = []
    for case in _firsts(study, drafts):
        check_names(drafts[case.scenario], case.overrides)
        rig = rig_of(drafts[case.scenario], duration=study.duration, overrides=case.overrides)
        rigs.append(rig)
        known = [f.name for f in figures_of(rig)]
        wanted = {*study.figures, *study.require, *(s.figure for s in study.summaries.values())}
        wanted |= {study.search.figure, *study.search.subject_to} if study.search else set()
        unknown = sorted(wanted - set(known))
        if unknown:
            near = closest(unknown[0], known)
            raise ScenarioError(
                f"{study.name}: {case.scenario} has no figure {unknown[0]!r}{near}; it has {', '.join(known)}"
            )
        topics = {f"{topic}/{label}" for topic, port in rig.topics.items() for label in port.labels}
        for name in study.signals:
            if full_name(name, topics) not in topics:
                raise ScenarioError(
                    f"{study.name}: no signal {name!r}{closest(name, topics)}; {case.scenario} has {', '.join(topics)}"
                )
    return rigs


def _firsts(study: Study, drafts: Mapping[str, Draft]) -> Iterator[Case]:
    """Yield the first run of each case."""
    seen = set()
    for case in _first(study, study.search, drafts) if study.search else cases(study, drafts):
        if case.case not in seen:
            seen.add(case.case)
            yield case
        if len(seen) == max(1, len(study.cases)):
            return


def _first(study: Study, search: Search, drafts: Mapping[str, Draft]) -> Iterator[Case]:
    middle = {name: _suggest_middle(d) for name, d in search.parameters.items()}
    yield Case(0, study.scenario, "", middle, drafts[study.scenario].filled().seed)


def _suggest_middle(d: Any) -> Any:
    return _values(d, np.array([0.5]))[0]


def _search(study: Study, search: Search, batch: Batch, drafts: Mapping[str, Draft]) -> None:
    """Run the ask/tell loop of a search in batches; existing rows are passed to it again in the same order."""
    need("optuna", f"{study.name}: its search")
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    samplers: dict[str, Any] = {
        "tpe": lambda: optuna.samplers.TPESampler(seed=search.seed, constant_liar=True),
        "random": lambda: optuna.samplers.RandomSampler(seed=search.seed),
    }
    direction: Literal["minimize", "maximize"] = "minimize" if search.aim == "minimise" else "maximize"
    asked = optuna.create_study(direction=direction, sampler=samplers[search.sampler]())
    space = {name: _optuna(name, d) for name, d in search.parameters.items()}
    seeds = seeds_of(study, drafts[study.scenario])
    worst = math.inf if search.aim == "minimise" else -math.inf
    for start in range(0, search.count, search.batch):
        trials = [asked.ask(space) for _ in range(min(search.batch, search.count - start))]
        works = [
            _work(study, Case((start + i) * len(seeds) + k, study.scenario, "", dict(trial.params), seed), drafts)
            for i, trial in enumerate(trials)
            for k, seed in enumerate(seeds)
        ]
        # Values are reported in the order of the trials, not as they end, so that the search repeats on any number of
        # cores.
        rows = batch.rows(works)
        for i, trial in enumerate(trials):
            group = rows[i * len(seeds) : (i + 1) * len(seeds)]
            values = [row["figures"].get(search.figure) for row in group]
            value = worst if None in values else float(np.mean(values))
            for name, limits in search.subject_to.items():
                trial.set_constraint(name, max(beyond(row, name, limits) for row in group))
            asked.tell(trial, value if math.isfinite(value) else math.copysign(1e300, value))


def beyond(row: Mapping[str, Any], figure: str, limits: Expectation) -> float:
    """Return the distance by which a figure violates its expectation; at most 0 if it does not."""
    value = value_of(row, figure)
    if limits.holds(value):
        return 0.0
    ends = (limits.at_most, limits.at_least, limits.expected)
    excess = max((abs(value - end) for end in ends if end is not None), default=math.inf)
    return min(excess, 1e300) if excess == excess else 1e300


def _optuna(name: str, d: Any) -> Any:
    from optuna import distributions

    if d.choice is not None:
        return distributions.CategoricalDistribution(d.choice)
    if d.integers is not None:
        return distributions.IntDistribution(*d.integers)
    pair = d.uniform or d.log_uniform
    if pair is None or any(isinstance(x, list) for x in pair):
        raise ScenarioError(f"search: parameter {name}: expected uniform, log_uniform, integers or choice of numbers")
    return distributions.FloatDistribution(pair[0], pair[1], log=d.log_uniform is not None)
