"""Genetic tuning of alpha_hat on the active assistive exercise: remarks 1 and 2 of the paper."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache, lru_cache, partial
from typing import NamedTuple

import numpy as np
from softrig_core import (
    ByHand,
    Jobs,
    Result,
    Sample,
    Solver,
    SolverParams,
    Values,
    Work,
    array,
    button,
    param,
    to_ns,
)
from softrig_optim.genetic import Genetic
from softrig_optim.search import Evaluation, Point, SearchHistory, run

from .controller import VoltageController
from .impedance import Impedance
from .patient import PATIENT_FORCE, Patient
from .plant import RehabPlant
from .prom import PromReference
from .stability import alpha_hat_limit

PERIOD = 0.001  # s
LAMBDA = 4.0  # 1/s
MARGIN = 0.9  # share of the stability limit that the guarded search may use
WEIGHT = 1e-7  # deg^2/(V/s)^2, of the squared total variation in the guarded cost
Mapper = Callable[[Callable[[Point], float], Sequence[Point]], Iterable[float]]


class Exercise(NamedTuple):
    """Figures of one exercise, means of both joints."""

    mse: float
    """Of the error from the regenerated reference, deg^2; infinite when the robot had to be stopped."""

    variation: float
    """Total variation of the voltage, V/s."""


def exercise(alpha_hat: float, duration: float = 15.0) -> Exercise:
    """Run scenario R6 with one value of alpha_hat, without topics.

    Parameters
    ----------
    alpha_hat : float
        V s/rad.
    duration : float
        s.
    """
    references, forces = _inputs(duration)
    q0 = references[0][:2]
    plant = ByHand(RehabPlant(position=q0, disturbance={"torque": 0.0}))
    impedance = ByHand(Impedance())
    controller = ByHand(VoltageController(emvc={"alpha_hat": alpha_hat, "lam": LAMBDA}))
    period = to_ns(PERIOD)
    squares = variation = 0.0
    last: tuple[float, ...] | None = None
    for k, (reference, force) in enumerate(zip(references, forces, strict=True)):
        t = k * period
        outputs = plant.outputs(t)
        state = outputs["joint_states"]
        bent = impedance.update(t, reference=reference, patient_force=Sample(t, force), joint_states=state[:2])
        answer = controller.update(
            t,
            joint_states=state[:4],
            motor_states=outputs["motor_states"],
            reference=bent["regenerated"],
            applied_voltage=outputs["applied_voltage"],
        )
        e1, e2, *_ = answer["controller_state"]
        squares += e1 * e1 + e2 * e2
        v = answer["motor_command"]
        if last is not None:
            variation += abs(v[0] - last[0]) + abs(v[1] - last[1])
        last = v
        plant.advance(t, motor_command=v, patient_force=force)
        if plant.x.safe:
            return Exercise(math.inf, math.inf)
    n = len(references)
    return Exercise(math.degrees(1.0) ** 2 * squares / (2 * n), variation / (2 * (n - 1) * PERIOD))


@lru_cache(maxsize=4)
def _inputs(duration: float) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]]]:
    """Reference and force at every tick."""
    source, patient, period = ByHand(PromReference()), ByHand(Patient()), to_ns(PERIOD)
    ticks = [k * period for k in range(to_ns(duration) // period)]
    return [source.update(t)["reference"] for t in ticks], [patient.update(t)[PATIENT_FORCE] for t in ticks]


def cost(candidate: Point, duration: float = 15.0, guarded: bool = True) -> float:
    """Value of a candidate (alpha_hat,): its MSE, in the guarded search plus a price on chattering."""
    mse, variation = exercise(candidate[0], duration)
    return mse + WEIGHT * variation**2 if guarded else mse


@cache
def guarded_limit() -> float:
    """Largest alpha_hat of the guarded search, V s/rad."""
    return MARGIN * alpha_hat_limit(PERIOD, LAMBDA, False)


def search(
    seed: int | np.random.Generator = 0,
    *,
    guarded: bool = True,
    lower: float = 0.05,
    upper: float = 12.0,
    n_pop: int = 20,
    n_iter: int = 10,
) -> Genetic:
    """Create the search for alpha_hat.

    Parameters
    ----------
    seed : int or numpy.random.Generator
    guarded : bool
        Keep alpha_hat below 0.9 of the stability limit. The published cost is the MSE alone; its minimum lies where
        other exercises already oscillate.
    lower, upper : float
        Bounds, V s/rad.
    n_pop, n_iter : int
        Population and generations after the first.
    """
    if guarded:
        upper = min(upper, guarded_limit())
    return Genetic([lower], [upper], seed, n_pop=n_pop, n_iter=n_iter)


def tune(
    seed: int = 0,
    *,
    guarded: bool = True,
    duration: float = 15.0,
    n_pop: int = 20,
    n_iter: int = 10,
    mapper: Mapper = map,
) -> Evaluation:
    """Tune alpha_hat.

    Parameters
    ----------
    guarded : bool
        See `search`.
    duration : float
        Of each exercise, s.
    n_pop, n_iter : int
        Population and generations after the first.
    mapper : callable
        `map`, or that of an executor: the candidates of a generation are independent.

    Returns
    -------
    Evaluation
        ``x = (alpha_hat,)`` and its cost.
    """
    objective = partial(cost, duration=duration, guarded=guarded)
    return run(search(seed, guarded=guarded, n_pop=n_pop, n_iter=n_iter), objective, mapper)


class TunerParams(SolverParams):
    """Published search: population 20, 10 generations."""

    period: float = param(0.5, "one candidate is tried a period", "s", gt=0.0, le=100.0)
    guarded: bool = param(True, "price on chattering and margin to the stability limit; false: as published")
    duration: float = param(15.0, "duration of an exercise", "s", gt=0.0)
    lower: float = param(0.05, "least alpha_hat", "V s/rad", gt=0.0)
    upper: float = param(12.0, "largest alpha_hat", "V s/rad", gt=0.0)
    n_pop: int = param(20, "population", ge=2, le=1000)
    n_iter: int = param(10, "generations after the first", ge=1, le=100000)
    autostart: bool = param(False, "start immediately instead of waiting for the trigger")

    def _check(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"lower = {self.lower:g} and upper = {self.upper:g} V s/rad: expected lower < upper")
        if self.guarded and self.lower >= guarded_limit():
            raise ValueError(
                f"lower = {self.lower:g} V s/rad: expected less than {guarded_limit():.3g}, "
                f"{MARGIN:g} of the stability limit, for a guarded search"
            )


class State(NamedTuple):
    """State from tick to tick."""

    pressed: bool = False
    """Whether the trigger is."""

    search: SearchHistory | None = None
    candidate: Point | None = None
    """The one that is tried."""

    jobs: Jobs = Jobs()


class Tuner(Solver[TunerParams]):
    """Tunes alpha_hat in the background; evaluates one candidate after another and publishes the best result so far.

    The result is generation, best alpha_hat (V s/rad) and its cost (deg^2); zeros before the first candidate with which
    the robot need not be stopped.
    """

    INPUTS = (button("start", "tuner/start", held=True),)
    OUTPUTS = (array("result", "tuner/result", {"generation, alpha_hat, cost": 3}, ("", "V s/rad", "deg^2")),)

    def first(self) -> State:
        """Wait for the trigger."""
        return State(search=self._begin(None) if self.p.autostart else None)

    def _begin(self, before: SearchHistory | None) -> SearchHistory:
        p = self.p
        make = partial(search, guarded=p.guarded, lower=p.lower, upper=p.upper, n_pop=p.n_pop, n_iter=p.n_iter)
        return SearchHistory(make, self.generator() if before is None else before.now.rng)

    def request(
        self, x: State, t: int, *, start: tuple[float, ...] | None
    ) -> tuple[State, tuple[Point, float, bool] | None]:
        """Return the next candidate, when there is one and the last one has its cost."""
        pressed = start == (1.0,)
        if pressed and not x.pressed:
            x = x._replace(search=self._begin(x.search), candidate=None)
        x = x._replace(pressed=pressed)
        if x.search is None or x.search.now.done or x.candidate is not None:
            return x, None
        candidate = x.search.now.ask()
        return x._replace(candidate=candidate), (candidate, self.p.duration, self.p.guarded)

    @staticmethod
    def solve(request: tuple[Point, float, bool], work: Work) -> float:
        """Return the cost of a candidate."""
        return cost(*request)

    def answer(self, x: State, t: int, result: Result | None, new: bool) -> tuple[State, Values]:
        """Return the best candidate so far."""
        actual = x.search
        if actual is None:
            return x, {"result": (0.0, 0.0, 0.0)}
        # a candidate whose exercise took longer than the limit has no value; one of a search that the button ended is
        # dropped
        if new and result is not None and result.request[0] == x.candidate:
            actual = actual.tell(math.inf if result.answer is None else result.answer)
            x = x._replace(search=actual, candidate=None)
        now = actual.now
        if now.best is None or math.isinf(now.best.value):
            return x, {"result": (float(now.iteration), 0.0, 0.0)}
        return x, {"result": (float(now.iteration), now.best.x[0], now.best.value)}
