"""Statistics of a study: of each case, comparisons between cases, and sensitivities."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Array, load_scenario
from softrig_core.errors import ScenarioError, closest
from softrig_core.judge.expectation import Expectation

from . import estimate
from .definition import Study
from .draw import points_of, size
from .estimate import Estimate
from .table import Row, label
from .work import absent, value_of


class Line(NamedTuple):
    """A figure over the runs of a case and grid point: `n` independent runs have a value; `lost` covers the rest."""

    group: str
    figure: str
    unit: str
    n: int
    lost: str
    mean: Estimate
    deviation: Estimate
    low: Estimate
    median: Estimate
    high: Estimate


class Share(NamedTuple):
    """Share of judged runs in which a requirement holds; failed or undecided runs count as not holding."""

    group: str
    requirement: str
    held: int
    n: int
    share: Estimate


class Difference(NamedTuple):
    """A figure of two cases at the same draws and seeds.

    Parameters
    ----------
    group, base : str
        What is compared with what: group minus base.
    n : int
        Number of pairs in which both runs have a number.
    smaller : Estimate
        Share of the pairs in which the figure of `group` is smaller; equal ones count half.
    effect : float
        Mean difference by its standard deviation, Cohen's d_z.
    p : float
        Of the paired t test, adjusted by Holm's rule over all differences of the study.
    """

    group: str
    base: str
    figure: str
    unit: str
    n: int
    difference: Estimate
    smaller: Estimate
    effect: float
    p: float


class Index(NamedTuple):
    """Sobol' indices of a figure: the share of its variance that a parameter explains alone, and with all others."""

    group: str
    figure: str
    parameter: str
    n: int
    first: Estimate
    total: Estimate


class Statistics(NamedTuple):
    """All of a study, and sentences about it."""

    lines: Sequence[Line] = ()
    shares: Sequence[Share] = ()
    differences: Sequence[Difference] = ()
    indices: Sequence[Index] = ()
    notes: Sequence[str] = ()

    def content(self) -> dict[str, Any]:
        """Return it as JSON: values that are not finite are None."""
        return {
            key: [_plain(entry) if isinstance(entry, tuple) else entry for entry in entries]
            for key, entries in self._asdict().items()
        }


def _plain(entry: Any) -> Any:
    if isinstance(entry, tuple):
        return {key: _plain(value) for key, value in entry._asdict().items()}  # type: ignore[attr-defined]
    return entry if not isinstance(entry, float) or math.isfinite(entry) else None


class Sample:
    """The runs of one case and grid point, which differ by random draws.

    Parameters
    ----------
    rows : sequence
        By number: the seeds of the first draw, of the second, ...
    seeds : int
        Of each draw.

    Attributes
    ----------
    one_run : bool
        Whether the seeds of each draw are one run, with the same figures.
    """

    def __init__(self, rows: Sequence[Row], seeds: int) -> None:
        self.rows, self.seeds = rows, seeds if len(rows) % seeds == 0 else 1
        messages = [(row["figures"], row.get("never"), bool(row["error"])) for row in rows]
        self.one_run = self.seeds > 1 and all(messages[k] == messages[k - k % self.seeds] for k in range(len(messages)))

    def table(self, value: Callable[[Row], float], one_run: bool | None = None) -> Array:
        """Return a number of each run, shape (independent runs, runs that belong to one of them)."""
        values = np.array([value(row) for row in self.rows], float).reshape(-1, self.seeds)
        values = values[:, :1] if (self.one_run if one_run is None else one_run) else values
        # With a single draw the seeds are the independent runs.
        return values.T if len(values) == 1 else values


def statistics(
    study: Study, rows: Sequence[Row], units: Mapping[str, str], widths: Mapping[str, float] | None = None
) -> Statistics:
    """Compute the statistics of a study; empty for a search, whose runs are not a random sample.

    Parameters
    ----------
    rows : sequence
        By number.
    units : mapping
        Of figures.
    widths : mapping, optional
        Desired interval width of a figure, requirement or share; the notes give the number of runs that it needs.

    Raises
    ------
    ScenarioError
        A width names a quantity that the study does not estimate.
    """
    if study.search or not rows:
        return Statistics()
    samples = samples_of(study, rows)
    figures = list(dict.fromkeys(name for row in rows for name, value in row["figures"].items() if value is not None))
    lines = [_line(group, name, units.get(name, ""), s) for group, s in samples.items() for name in figures]
    result = Statistics(
        [line for line in lines if line is not None],
        [share for group, sample in samples.items() for share in _shares(study, group, sample)],
        _adjusted([d for name in figures for d in _differences(study, samples, name, units.get(name, ""))]),
        [*_indices(study, rows, figures)],
    )
    return result._replace(notes=[*_notes(study, samples, result), *_needed(result, widths or {})])


def samples_of(study: Study, rows: Sequence[Row]) -> dict[str, Sample]:
    """Return the runs of each case and grid point, those that are independent draws."""
    seeds = len(study.seeds or [0])
    # A sensitivity study has two independent sets of points; the others are mixed of these and would count twice.
    sets = 2 * study.draws.count * seeds if study.draws and study.draws.method == "sensitivity" else None
    return {group: Sample(group_rows[:sets], seeds) for group, group_rows in _groups(study, rows).items()}


def _groups(study: Study, rows: Sequence[Row]) -> dict[str, list[Row]]:
    result: dict[str, list[Row]] = {}
    for row in rows:
        result.setdefault(label(study, row), []).append(row)
    return result


def _line(group: str, figure: str, unit: str, sample: Sample) -> Line | None:
    """Estimate over a sample; None for a single run."""
    table = sample.table(lambda row: value_of(row, figure))
    # A figure that was not measured is not known to be small or large, so its run belongs to no tail.
    known = table[~np.isnan(table).any(axis=1)]
    finite = known[np.isfinite(known).all(axis=1)]
    if table.size < 2 or not known.size:
        return None
    nothing = Estimate(math.nan)
    single = finite.mean(axis=1)
    tails = (partial(_at, known, q) for q in (0.05, 0.5, 0.95))
    return Line(
        group,
        figure,
        unit,
        len(finite),
        absent(table.ravel()),
        estimate.mean(single) if single.size else nothing,
        _over(finite, estimate.deviation, partial(np.std, ddof=1)) if finite.size else nothing,
        *(tail() for tail in tails),
    )


def _at(values: Array, q: float) -> Estimate:
    return _over(values, lambda x: estimate.quantile(x, q), lambda x, axis: estimate.at_quantile(x, q, axis))


def _over(table: Array, independent: Callable[[Array], Estimate], statistic: estimate.Statistic) -> Estimate:
    """Estimate over independent single runs by the usual rule, over dependent runs by a bootstrap."""
    return independent(table.ravel()) if table.shape[1] == 1 else estimate.clustered(table, statistic)


def _shares(study: Study, group: str, sample: Sample) -> Iterator[Share]:
    """Compute how often the scenario's requirements and the study's conditions on figures hold."""
    if len(sample.rows) < 2:
        return
    asked: dict[str, Callable[[Row], float]] = {}
    # Rows of an older version do not have this entry.
    if all("missed" in row for row in sample.rows):
        for name in load_scenario(sample.rows[0]["scenario"]).requirements:
            if not all(name in row.get("not_judged", ()) for row in sample.rows):
                asked[name] = partial(_holds, name)
    for figure, limits in study.require.items():
        asked[bound_text(figure, limits)] = lambda row, f=figure, bound=limits: bound.holds(value_of(row, f))  # type: ignore[misc]
    for name, holds in asked.items():
        table = sample.table(holds)
        sure = table[~np.isnan(table).any(axis=1)]
        # The requirement was judged at no draw by all of its seeds.
        if not sure.size:
            continue
        yield Share(group, name, round(sure.sum()), sure.size, estimate.share(float(sure.mean()), len(sure)))


def _holds(name: str, row: Row) -> float:
    """Return whether a requirement holds in a run; NaN if it does not apply to that run."""
    return math.nan if name in row.get("not_judged", ()) else not row["error"] and name not in row["missed"]


def not_judged(rows: Sequence[Row]) -> str:
    """Describe which requirements do not apply to the runs of a study, and for which machine they are published."""
    unjudged = [row for row in rows if row.get("not_judged")]
    names = dict.fromkeys(name for row in unjudged for name in row["not_judged"])
    # The longest description is of the machine of which most was changed.
    machine = max((row["published_for"] for row in unjudged), key=len, default="")
    text = f"not judged in {len(unjudged)} of {len(rows)} runs: {', '.join(names)}, published for {machine}"
    return f"{text} (--strict judges them)" if unjudged else ""


def bound_text(figure: str, limits: Expectation) -> str:
    """Write the limit of a figure: ``overshoot <= 5``."""
    if limits.text:
        return f"{figure} {limits.text}"
    parts = [f"= {limits.expected:g} +- {limits.tolerance or 0.0:g}"] if limits.expected is not None else []
    parts += [f">= {limits.at_least:g}"] if limits.at_least is not None else []
    return " ".join([figure, *parts, *([f"<= {limits.at_most:g}"] if limits.at_most is not None else [])])


def _differences(study: Study, samples: Mapping[str, Sample], figure: str, unit: str) -> Iterator[Difference]:
    """Compare each case with the first one, at the same grid point and run by run."""
    first = next(iter(study.cases), "")
    for group, sample in samples.items():
        # Cases are compared at equal draws and seeds, which removes their contribution to the spread.
        case = sample.rows[0]["case"]
        basis = samples.get(first + group[len(case) :])
        if case == first or basis is None or len(sample.rows) != len(basis.rows) or len(sample.rows) < 2:
            continue
        both = [s.table(lambda row: value_of(row, figure), sample.one_run and basis.one_run) for s in (sample, basis)]
        new, base = both
        known = ~(np.isnan(new) | np.isnan(base)).any(axis=1)
        finite = known & np.isfinite(new).all(axis=1) & np.isfinite(base).all(axis=1)
        pairs = (new[finite] - base[finite]).mean(axis=1)
        less = ((new[known] < base[known]) + 0.5 * (new[known] == base[known])).mean(axis=1)
        if not less.size:
            continue
        from scipy import stats  # late import: it takes 0.3 s, and a study without cases does not need it

        middle = float(pairs.mean()) if pairs.size else math.nan
        spread = float(np.std(pairs, ddof=1)) if pairs.size > 1 else math.nan
        yield Difference(
            group,
            first + group[len(case) :],
            figure,
            unit,
            len(pairs),
            estimate.difference(pairs) if pairs.size else Estimate(math.nan),
            estimate.share(float(less.mean()), len(less)),
            middle / spread if spread > 0.0 else math.nan,
            float(stats.ttest_1samp(pairs, 0.0).pvalue) if spread > 0.0 else 1.0 if middle == 0.0 else math.nan,
        )


def _adjusted(differences: Sequence[Difference]) -> list[Difference]:
    return [d._replace(p=p) for d, p in zip(differences, estimate.holm([d.p for d in differences]), strict=True)]


def _indices(study: Study, rows: Sequence[Row], figures: Sequence[str]) -> Iterator[Index]:
    """Sobol' indices of each figure that every run has; the seeds of a point count by their mean."""
    if study.draws is None or study.draws.method != "sensitivity":
        return
    n, seeds = study.draws.count, len(study.seeds or [0])
    drawn = [
        name if size(d) == 1 else f"{name}[{k}]" for name, d in study.draws.parameters.items() for k in range(size(d))
    ]
    for group, members in _groups(study, rows).items():
        for figure in figures:
            values = np.array([value_of(row, figure) for row in members], float)
            if values.size != n * seeds * (len(drawn) + 2) or not np.isfinite(values).all() or not np.ptp(values):
                continue
            a, b, *mixed = values.reshape(-1, n, seeds).mean(axis=2)
            for name, (first, total) in zip(drawn, estimate.sobol(a, b, np.array(mixed)), strict=True):
                yield Index(group, figure, name, n, first, total)


def _notes(study: Study, samples: Mapping[str, Sample], result: Statistics) -> Iterator[str]:
    """Describe what n counts, and the assumptions of the intervals."""
    seeds = len(study.seeds or [0])
    if same := [group for group, sample in samples.items() if sample.one_run]:
        which_groups = "" if len(same) == len(samples) else f" of {', '.join(same)}"
        yield f"the {seeds} seeds{which_groups} give the same run: no random number affects a figure"
    if any(sample.seeds > 1 and not sample.one_run and len(sample.rows) > sample.seeds for sample in samples.values()):
        yield f"n counts draws: the {seeds} seeds of a draw are not independent, and the intervals are those of draws"
    if study.draws and study.draws.method != "random" and result.lines:
        yield "the draws fill the space evenly; the intervals are those of independent draws, which are no narrower"
    if study.draws and study.draws.method == "sensitivity":
        left = {line.figure for line in result.lines} - {index.figure for index in result.indices}
        yield f"statistics are over the {2 * study.draws.count} independent of {points_of(study)} points"
        if left:
            yield f"no sensitivity of {', '.join(sorted(left))}: not every run has a number, or all have the same one"


def _needed(result: Statistics, widths: Mapping[str, float]) -> Iterator[str]:
    """Describe how many runs intervals of given widths need."""
    known = {line.figure for line in result.lines} | {share.requirement for share in result.shares}
    for name, width in widths.items():
        if name not in known:
            raise ScenarioError(f"--width {name}: nothing of that name is estimated{closest(name, known)}")
        for line in (line for line in result.lines if line.figure == name):
            if math.isnan(line.deviation.value):
                yield (
                    f"mean {name} of {line.group}: {line.n} runs have no spread, so no number of runs can be "
                    "computed from a width"
                )
                continue
            n = estimate.runs_for_mean(line.deviation.value, width)
            yield _more(f"mean {name} of {line.group}", line.mean, line.n, n, width)
        for share in (share for share in result.shares if share.requirement == name):
            n = estimate.runs_for_share(share.share.value, width)
            yield _more(f"share of {name} of {share.group}", share.share, share.n, n, width)
        for d in (d for d in result.differences if d.figure == name and d.effect):
            n = estimate.runs_for_mean(abs(d.difference.value / d.effect), width)
            yield _more(f"{name} of {d.group} less that of {d.base}", d.difference, d.n, n, width)


def _more(text: str, now: Estimate, n: int, needed: int, width: float) -> str:
    more = f"some {needed}, {needed - n} more" if needed > n else "no more"
    return f"{text}: the interval is {now.high - now.low:.3g} wide after {n}; a width of {width:g} needs {more}"
