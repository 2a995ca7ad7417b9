"""One ask/tell interface for every search: swarms, evolution, hill climbing, deterministic ones."""

from __future__ import annotations

import math
import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import KW_ONLY, InitVar, dataclass
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
from softrig_core import Array

Point = tuple[float, ...]
Seed = int | np.random.Generator
Moves = Generator[Sequence[Point], list[float], None]


class Evaluation(NamedTuple):
    """A candidate and its value."""

    x: Point
    value: float


@dataclass(eq=False, repr=False)
class Search(ABC):
    """A search over a box: `ask` returns a candidate, `tell` stores its value.

    Parameters
    ----------
    lower, upper : sequence of float
        Bounds of each variable.
    seed : int or numpy.random.Generator
        The only source of random numbers.
    maximise : bool
        Whether a larger value is better.
    budget : int, optional
        Most evaluations; the algorithm's own number when absent.
    stop : callable, optional
        Stop rule: called with the search after each value, ends it when true.

    Attributes
    ----------
    lower, upper : ndarray, shape (n,)
    history : list of Evaluation
        All evaluations so far, in order.
    best : Evaluation or None
        The best so far, the earliest of equals.
    iteration : int
        Iteration (generation) the pending candidates belong to; 0 is the initial one.
    settle : bool
        Whether the pending candidate is to be measured in steady state; a sweep is measured in motion.
    watches : bool
        Whether it uses measurements on the way to the pending candidate, see `watch`.
    remembers : bool
        Whether old values still affect the search, so that all values must be of the same objective.

    Raises
    ------
    ValueError
        Empty or reversed bounds, budget below 1.

    Examples
    --------
    >>> search = ParticleSwarm([0.0], [1.0], seed=1)
    >>> while not search.done:
    ...     search.tell((search.ask()[0] - 0.3) ** 2)
    """

    lower: Any
    upper: Any
    seed: InitVar[Seed] = 0
    _: KW_ONLY
    maximise: bool = False
    budget: int | None = None
    stop: Callable[[Search], bool] | None = None

    remembers = True
    watches = False

    def __post_init__(self, seed: Seed) -> None:
        lower, upper = self.lower, self.upper
        self.lower, self.upper = np.array(lower, dtype=float), np.array(upper, dtype=float)
        if self.lower.ndim != 1 or self.lower.shape != self.upper.shape or self.lower.size == 0:
            raise ValueError(f"lower = {lower}, upper = {upper}: expected as many of each, one or more")
        if not (np.isfinite([*lower, *upper]).all() and (self.lower < self.upper).all()):
            raise ValueError(f"lower = {lower}, upper = {upper}: expected lower < upper, both finite")
        if self.budget is not None and self.budget < 1:
            raise ValueError(f"budget is {self.budget}, expected at least 1")
        self.rng = np.random.default_rng(seed)
        self.history: list[Evaluation] = []
        self.best: Evaluation | None = None
        self.iteration = 0
        self.settle = True
        self.sample: Point = ()
        self._done = False
        self._costs: list[float] = []
        self._moves = self.moves()
        self._generation = next(self._moves)

    @abstractmethod
    def moves(self) -> Moves:
        """Yield independent candidates; receive their costs, which are minimised.

        The algorithm itself. After the yield `self.sample` is the measurement of the last candidate.
        """

    @property
    def pending(self) -> Sequence[Point]:
        """Return all candidates that can be evaluated now, even in parallel; `tell` expects values in this order."""
        return () if self._done else self._generation[len(self._costs) :]

    @property
    def done(self) -> bool:
        """Return whether the search has ended."""
        return self._done

    @property
    def evaluations(self) -> int:
        """Number of values received."""
        return len(self.history)

    @property
    def result(self) -> Point:
        """Return the candidate to apply after the search: the best one.

        Raises
        ------
        ValueError
            No value was received yet.
        """
        if self.best is None:
            raise ValueError("no value was reported yet")
        return self.best.x

    @property
    def expected(self) -> float:
        """The value that `result` should have if nothing has changed since it was found; see `result`."""
        if self.best is None:
            raise ValueError("no value was reported yet")
        return self.best.value

    @property
    def bound(self) -> float | None:
        """Value that the objective cannot exceed anywhere in the box; None if nothing is proven."""
        return None

    @property
    def gap(self) -> float:
        """Share of the value by which a proven bound may exceed it; infinite if nothing is proven."""
        return math.inf

    def watch(self, sample: Sequence[float]) -> None:  # noqa: B027
        """Use a measurement on the way to the pending candidate; only searches that can use a transient do."""

    def ask(self) -> Point:
        """Return the next candidate; the same one until its value is passed to `tell`.

        Raises
        ------
        ValueError
            The search has ended.
        """
        if self._done:
            raise ValueError("the search has ended, there is no next candidate")
        return self._generation[len(self._costs)]

    def tell(self, value: float, sample: Sequence[float] = ()) -> None:
        """Store the value of the candidate that `ask` returned.

        Parameters
        ----------
        value : float
            Objective; infinity of the bad sign for an infeasible candidate.
        sample : sequence of float
            The measurement behind the value, for searches that learn from more than the value.

        Raises
        ------
        ValueError
            The value is NaN, or the search has ended.
        """
        if math.isnan(value):
            raise ValueError("the value of a candidate is NaN; measure it again")
        evaluation = Evaluation(self.ask(), value)
        self.history.append(evaluation)
        # The strict comparison keeps the earliest of equal values, so that the result does not depend on later
        # repetitions.
        if self.best is None or (value > self.best.value if self.maximise else value < self.best.value):
            self.best = evaluation
        self.sample = tuple(sample)
        # Algorithms minimise only, so the sign of a maximisation is turned here and nowhere else.
        self._costs.append(-value if self.maximise else value)
        if len(self._costs) == len(self._generation):
            costs, self._costs = self._costs, []
            try:
                self._generation = self._moves.send(costs)
            except StopIteration:
                self._done = True
        # The budget ends a search in the middle of a generation too, for each evaluation costs time at the plant.
        if self.evaluations == self.budget or (self.stop is not None and self.stop(self)):
            self._done = True


@dataclass(eq=False, repr=False, kw_only=True)
class Population(Search):
    """A search with a population that starts uniformly at random.

    Parameters
    ----------
    n_pop : int
        Population, at least the class's `SMALLEST`.
    n_iter : int
        Iterations after the initial population.
    **options
        Those of `Search`.
    """

    n_pop: int = 4
    n_iter: int = 10

    SMALLEST = 1

    def __post_init__(self, seed: Seed) -> None:
        if self.n_pop < self.SMALLEST:
            raise ValueError(f"n_pop is {self.n_pop}, {type(self).__name__} needs at least {self.SMALLEST}")
        if self.n_iter < 1:
            raise ValueError(f"n_iter is {self.n_iter}, expected at least 1")
        # This stands last because it starts `moves`, which reads the settings above.
        super().__post_init__(seed)

    def iterations(self) -> Iterator[int]:
        """Count from 1 to n_iter."""
        for k in range(1, self.n_iter + 1):
            self.iteration = k
            yield k

    def spread(self) -> Array:
        """Draw the initial population, shape (n_pop, n)."""
        return self.lower + (self.upper - self.lower) * self.rng.random((self.n_pop, self.lower.size))

    def clip(self, x: Array) -> Array:
        """Project positions onto the box."""
        return np.minimum(np.maximum(x, self.lower), self.upper)


def points(x: Array) -> list[Point]:
    """Return the rows of an array as candidates."""
    return [tuple(row) for row in x.tolist()]


class SearchHistory:
    """A search as an immutable value, for the state of a block: how it was created, and the values it received since.

    The live search belongs to the newest value of its line. If an older value is used, as after a rig has gone back in
    time, a new search is created and receives the older value's calls again.

    Parameters
    ----------
    make : callable
        Creates the search from its random generator.
    rng : numpy.random.Generator
        The generator in its initial state; no numbers are drawn from it.
    calls : sequence of (str, tuple)
        The calls of `Search.tell` and `Search.watch` so far.
    """

    __slots__ = ("__weakref__", "_line", "_n")

    def __init__(
        self,
        make: Callable[[np.random.Generator], Search],
        rng: np.random.Generator,
        calls: Sequence[tuple[str, tuple[Any, ...]]] = (),
    ) -> None:
        self._line = _Line(make, rng, calls)
        self._n = len(calls)

    @property
    def now(self) -> Search:
        """The search in its present state, which the caller must not modify."""
        line = self._line
        # The shared live search has received more than this value knows, so this value builds its own.
        if len(line.calls) != self._n:
            line = self._line = _Line(line.make, line.rng, line.calls[: self._n])
        return line.live

    @property
    def low(self) -> Point:
        """The lower bounds, as a candidate."""
        return tuple(self.now.lower.tolist())

    @property
    def high(self) -> Point:
        """The upper bounds, as a candidate."""
        return tuple(self.now.upper.tolist())

    @property
    def settle(self) -> bool:
        """See `Search`."""
        return self.now.settle

    @property
    def watches(self) -> bool:
        """See `Search`."""
        return self.now.watches

    @property
    def gap(self) -> float:
        """See `Search`."""
        return self.now.gap

    @property
    def expected(self) -> float:
        """See `Search`; NaN before the first value."""
        return math.nan if self.now.best is None else float(self.now.expected)

    def tell(self, value: float, sample: Sequence[float] = ()) -> SearchHistory:
        """Return the value after a call of `Search.tell`."""
        return self._after("tell", (value, sample))

    def watch(self, sample: Sequence[float]) -> SearchHistory:
        """Return the value after a call of `Search.watch`."""
        return self._after("watch", (sample,))

    def _after(self, method: str, values: tuple[Any, ...]) -> SearchHistory:
        getattr(self.now, method)(*values)
        self._line.calls.append((method, values))
        history = object.__new__(SearchHistory)
        history._line, history._n = self._line, self._n + 1
        return history

    def native(self) -> SearchHistoryView:
        """Convert it to its read-only form for native code."""
        _handed[id(self)] = self
        return SearchHistoryView(id(self), self.low, self.high, self.settle, self.watches, self.gap, self.expected)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SearchHistory):
            return NotImplemented
        return self._line.calls[: self._n] == other._line.calls[: other._n]

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> Any:
        return SearchHistory, (self._line.make, self._line.rng, self._line.calls[: self._n])


class SearchHistoryView(NamedTuple):
    """The view of a `SearchHistory` that native code may read; only Python passes new values to the search."""

    number: int
    low: Point
    high: Point
    settle: bool
    watches: bool
    gap: float
    expected: float

    def python(self) -> SearchHistory:
        """Return the `SearchHistory` of this view."""
        return _handed[self.number]


# Native code holds numbers only, so it names a search by the id under which Python finds it here.
_handed: WeakValueDictionary[int, SearchHistory] = WeakValueDictionary()


class _Line:
    """State shared by the values of one search: all calls so far, and the live search that has received them."""

    def __init__(self, make: Any, rng: np.random.Generator, calls: Sequence[tuple[str, tuple[Any, ...]]]) -> None:
        # A search draws from its generator, and a later line must begin from the same numbers. Few lines are begun, and
        # the bytes of a generator take a third of the time of another generator.
        self.make, self._begun, self.calls = make, pickle.dumps(rng), list(calls)
        self.live: Search = make(self.rng)
        for method, values in calls:
            getattr(self.live, method)(*values)

    @property
    def rng(self) -> np.random.Generator:
        """Return the generator with which the search began, another one each time."""
        return pickle.loads(self._begun)  # type: ignore[no-any-return]


def run(
    search: Search,
    objective: Callable[[Point], float],
    mapper: Callable[[Callable[[Point], float], Sequence[Point]], Iterable[float]] = map,
) -> Evaluation:
    """Drive a search to its end with a function.

    Parameters
    ----------
    objective : callable
        Value of a candidate.
    mapper : callable
        `map`, or the `map` of an executor to evaluate each generation in parallel.

    Returns
    -------
    Evaluation
        The best.
    """
    while not search.done:
        # Candidates after the stop rule are evaluated by a parallel mapper, but their values no longer count.
        for value in mapper(objective, search.pending):
            search.tell(value)
            if search.done:
                break
    assert search.best is not None
    return search.best
