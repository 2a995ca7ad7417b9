"""Estimates from independent runs: means, shares, quantiles and differences, each with its interval."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array

# With fewer pairs a bootstrap covers less than 95 %: 0.75 of three normal pairs, 0.92 of five.
FEW = 10
LEVEL = 0.95  # confidence of every interval
# Resamples of a bootstrap. With this number the 2.5 % quantile is exactly the 125th of them.
RESAMPLES = 4999
# Numbers of resamples computed at a time, so that they fit into a processor's cache.
ROOM = 200_000

Statistic = Callable[..., Any]


class Estimate(NamedTuple):
    """A number computed from runs, and its 95 % confidence interval; an end is NaN where the runs are too few."""

    value: float
    low: float = math.nan
    high: float = math.nan


# Of `scipy.special`, because the import of `scipy.stats` takes a second of each study.
@lru_cache
def _student(n: int) -> float:
    """Return the quantile of Student's t distribution of n degrees of freedom that bounds an interval."""
    from scipy.special import stdtrit

    return float(stdtrit(n, 0.5 + LEVEL / 2.0))


@lru_cache
def _normal() -> float:
    """Return the same quantile of the normal distribution."""
    from scipy.special import ndtri

    return float(ndtri(0.5 + LEVEL / 2.0))


@lru_cache
def _ranks(n: int, q: float) -> tuple[int, int]:
    """Return which of n sorted values, from 0, enclose their quantile q; outside of them where they are too few.

    The number of values below the quantile is binomial; as in `scipy.stats.quantile_test`.
    """
    from scipy.special import bdtr, bdtrc

    tail = 0.5 - LEVEL / 2.0
    low = bisect_left(range(n), tail, key=lambda k: float(bdtr(k, n, q))) - 1
    return low, bisect_left(range(n), -tail, key=lambda k: -float(bdtrc(k, n, q)))


def mean(values: Array) -> Estimate:
    """Estimate a mean, with Student's t interval.

    Parameters
    ----------
    values : array, shape (n,)
        Finite numbers of independent runs.
    """
    middle, n = float(np.mean(values)), values.size
    if n < 2:
        return Estimate(middle)
    half = _student(n - 1) * float(np.std(values, ddof=1)) / math.sqrt(n)
    return Estimate(middle, middle - half, middle + half)


def deviation(values: Array) -> Estimate:
    """Estimate a standard deviation, with an interval that does not assume a normal distribution.

    References
    ----------
    D. G. Bonett, "Approximate confidence interval for standard deviation of nonnormal distributions", Computational
    Statistics & Data Analysis 50(3), 2006, eq. (4).
    """
    n = values.size
    if n < 2:
        return Estimate(math.nan)
    result, z = float(np.std(values, ddof=1)), _normal()
    # The trimmed mean below divides by the root of n - 4.
    if n < 5 or result == 0.0:
        return Estimate(result, *((0.0, 0.0) if result == 0.0 else ()))
    cut = int(0.5 / math.sqrt(n - 4.0) * n)
    about = values - np.partition(values, (cut, n - cut - 1))[cut : n - cut].mean()
    kurtosis = n * float(np.sum(about**4)) / float(np.sum((values - values.mean()) ** 2)) ** 2
    c = n / (n - z)
    half = z * c * math.sqrt((kurtosis - (n - 3.0) / n) / (n - 1.0))
    return Estimate(result, *(math.sqrt(c * result**2 * math.exp(sign * half)) for sign in (-1.0, 1.0)))


def quantile(values: Array, q: float) -> Estimate:
    """Estimate a quantile, with an interval between two of the sorted values that is valid for any distribution.

    Parameters
    ----------
    values : array, shape (n,)
        Infinity, of what never happens, is the largest.
    """
    low, high = _ranks(values.size, q)
    ordered = np.sort(values).tolist()
    ends = (ordered[k] if 0 <= k < values.size else math.nan for k in (low, high))
    return Estimate(float(at_quantile(values, q)), *ends)


def at_quantile(values: Array, q: float, axis: int = -1) -> Array:
    """Compute a quantile as `numpy.quantile` does; between infinity and infinity it is infinity."""
    with np.errstate(invalid="ignore"):
        result = np.quantile(values, q, axis=axis)
    return np.where(np.isnan(result), math.inf, result)


def share(portion: float, n: int) -> Estimate:
    """Estimate a probability, with Wilson's score interval.

    Parameters
    ----------
    portion : float
        Share of n independent runs in which the event occurs. scipy computes the interval for integer counts only, and
        the count is not an integer if each run is a mean over seeds.
    """
    z = _normal()
    centre, width = portion + z**2 / (2.0 * n), z * math.sqrt(portion * (1.0 - portion) / n + (z / (2.0 * n)) ** 2)
    ends = ((centre - width) / (1.0 + z**2 / n), (centre + width) / (1.0 + z**2 / n))
    return Estimate(portion, 0.0 if portion == 0.0 else ends[0], 1.0 if portion == 1.0 else ends[1])


def difference(pairs: Array) -> Estimate:
    """Estimate the mean of paired differences, with an expanded percentile bootstrap; of few pairs by Student's t.

    The quantiles are taken a little farther out than 2.5 %, by as much as Student's t of n - 1 is wider than the normal
    distribution: the plain percentile interval is too narrow for few pairs.

    Parameters
    ----------
    pairs : array, shape (n,)

    References
    ----------
    T. C. Hesterberg, "What teachers should know about the bootstrap", The American Statistician 69(4), 2015, sec. 4.2.
    """
    return mean(pairs) if pairs.size < FEW else _resampled(pairs, np.mean)


def clustered(values: Array, statistic: Statistic) -> Estimate:
    """Estimate a statistic over dependent runs, by a bootstrap over the independent groups.

    Parameters
    ----------
    values : array, shape (n, seeds)
        The seeds of one draw share its parameters.
    statistic : callable
        Of an array and an axis.
    """
    n, seeds = values.shape

    def drawn(rows: NDArray[np.int_], axis: int) -> Array:
        return statistic(values[rows].reshape(*rows.shape[:-1], n * seeds), axis=axis)

    return _resampled(np.arange(n), drawn)


def _resampled(values: Array | NDArray[np.int_], statistic: Statistic) -> Estimate:
    from scipy import stats

    n = values.size
    value = float(statistic(values, axis=-1))
    if n < 2:
        return Estimate(value)
    wider = stats.norm.cdf(math.sqrt(n / (n - 1.0)) * stats.t.ppf(0.5 - LEVEL / 2.0, n - 1))
    result = stats.bootstrap(
        (values,),
        statistic,
        n_resamples=RESAMPLES,
        batch=max(1, ROOM // n),
        vectorized=True,
        method="percentile",
        confidence_level=1.0 - 2.0 * wider,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(value, float(result.low), float(result.high))


def holm(p: Sequence[float]) -> list[float]:
    """Adjust p values of several comparisons by Holm's step-down rule; NaN stays and does not count."""
    order = sorted((k for k in range(len(p)) if not math.isnan(p[k])), key=lambda k: p[k])
    result, least = [math.nan] * len(p), 0.0
    for rank, k in enumerate(order):
        least = max(least, min(1.0, (len(order) - rank) * p[k]))
        result[k] = least
    return result


def runs_for_mean(spread: float, width: float) -> int:
    """Compute how many runs a t interval of this width needs, given the standard deviation."""
    return _least(lambda n: 2.0 * _student(n - 1) * spread / math.sqrt(n), width)


def runs_for_share(portion: float, width: float) -> int:
    """Compute how many runs a Wilson interval of this width needs for a share."""

    def width_of(n: int) -> float:
        _, low, high = share(portion, n)
        return high - low

    return _least(width_of, width)


def _least(width_of: Callable[[int], float], width: float) -> int:
    """Find the least number of runs, at least two, whose interval is no wider; the width falls with the number."""
    # The width falls with n, so doubling and then halving finds the least n.
    high = 2
    while width_of(high) > width:
        high *= 2
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if width_of(middle) > width else (low, middle)
    return high


def sobol(a: Array, b: Array, mixed: Array) -> list[tuple[Estimate, Estimate]]:
    """Estimate first-order and total Sobol' indices of each input, with a bootstrap over the points.

    Parameters
    ----------
    a, b : array, shape (n,)
        Values at two sets of points; n is a power of two.
    mixed : array, shape (inputs, n)
        At the first set with one input of the second.

    References
    ----------
    A. Saltelli et al., "Variance based sensitivity analysis of model output", Computer Physics Communications 181,
    2010; the estimators of `scipy.stats.sobol_indices`.
    """
    from scipy import stats

    def indices(rows: NDArray[np.int_]) -> Array:
        values = {"f_A": a[None, rows], "f_B": b[None, rows], "f_AB": mixed[:, None, rows]}
        result = stats.sobol_indices(func=values, n=a.size)
        return np.array([np.atleast_1d(result.first_order), np.atleast_1d(result.total_order)])

    value = indices(np.arange(a.size))
    drawn = np.random.default_rng(0).integers(a.size, size=(499, a.size))
    low, high = np.quantile([indices(rows) for rows in drawn], (0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0), axis=0)
    first, total = (
        [Estimate(*map(float, ends)) for ends in zip(value[k], low[k], high[k], strict=True)] for k in (0, 1)
    )
    return list(zip(first, total, strict=True))
