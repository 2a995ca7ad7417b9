"""Search of command channels over topics: send a candidate, wait, read the measured objective, tell the algorithm."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from enum import IntEnum
from typing import Self

import numpy as np
from pydantic import model_validator
from softrig_core import Block, BlockParams, Level, Port, button, command, executable, param, scalars, to_ns
from typing_extensions import TypeVar

from .algorithms import Algorithm, AlgorithmParams, make
from .falling import FallingCurve
from .search import Point, Search

CONSECUTIVE = 2  # deviations of the held objective in a row that start a new search
STEADY = 0.1  # share of a change that counts by which a value may move in a hold_time and be the one held
LOOK_BACK = 2  # how long that takes, in hold_times
BROKEN = 3  # searches in a row that a change of the plant may break off


class Phase(IntEnum):
    """What the block is doing."""

    STOPPED = 0
    SEARCH = 1
    HOLD = 2


class SearchParams(AlgorithmParams, BlockParams):
    """How a search is run against a plant."""

    period: float = param(0.001, "sampling period of the measurement", "s", gt=0.0, le=100.0)
    hold_time: float = param(0.04, "how long a candidate is applied before its value counts", "s", gt=0.0, live=True)
    measure_window: float = param(0.002, "the value is the mean of the last samples in this time", "s", gt=0.0)
    settle_time: float = param(
        0.12, "the value held is the reference for changes only after this time", "s", gt=0.0, live=True
    )
    restart_threshold: float = param(
        0.05, "relative change of the value held that starts a search; 0 = none", ge=0.0, live=True
    )
    rescan_period: float = param(
        60.0, "a new search starts this long after the last one did; 0 = never", "s", ge=0.0, live=True
    )
    floor: float | None = param(
        None, "a value not above this is no signal: wait for it instead of searching", live=True
    )
    autostart: bool = param(True, "search from the first tick instead of waiting for the start button")

    @model_validator(mode="after")
    def _times(self) -> Self:
        if self.hold_time < self.period:
            raise ValueError(f"hold_time = {self.hold_time:g} s is shorter than period = {self.period:g} s")
        if self.measure_window > self.hold_time:
            raise ValueError(
                f"measure_window = {self.measure_window:g} s is longer than hold_time = {self.hold_time:g} s"
            )
        return self


def buttons(prefix: str) -> tuple[Port, ...]:
    """Give the held buttons of a search; each acts when it goes down."""
    return tuple(button(name, f"{prefix}/{name}", held=True) for name in ("start", "stop", "restart"))


def state_port(topic: str, channels: Mapping[str, str]) -> Port:
    """Give the state output of a search over the channels (name to unit)."""
    units = {"phase": "", "iteration": "", "evaluations": "", "restarts": "", "best_value": "", "bound": ""}
    return scalars("state", topic, units | {f"best_{name}": unit for name, unit in channels.items()})


P = TypeVar("P", bound=SearchParams, default=SearchParams)


class CommandSearch(Block[P], ABC):
    """What the optimiser nodes share; a subclass says what is searched and what the objective is.

    A candidate is applied, the command moving at most `slew` a second; `hold_time` after it has arrived its value is
    told and the next one applied. When the search has ended its result is held, and a new search starts

    - when the value at the end of `settle_time` differs by more than `restart_threshold` from what the search found:
      the plant changed meanwhile (later where it still moves by a tenth of that in a `hold_time`);
    - at once, until then, when the measurements prove a change of the plant by more than that (`characteristic`), or by
      more than the gap of a proof; so that they do, a search whose plant has a characteristic looks back at its end:
      the command passes once through its range;
    - when two samples in a row, `hold_time` apart, differ so much from the value at the end of `settle_time`;
    - `rescan_period` after the start of the last search: what changes elsewhere does not show in the value held.

    What was found and lost so for the second time in a row, or broken off so for the fourth, is held nevertheless,
    twice as long as it took; twice that the next time, and so on: where nothing is ever confirmed searches become rare.

    A search that meets no signal (`no_signal`) for `hold_time` stops, goes to the lower bounds, and starts anew when
    the signal is back; a shorter gap has the candidate measured again. That needs no `restart_threshold`.

    Until the first start without `autostart` the command is the lower bounds. A candidate with a bad measurement
    among its samples is measured again. Bounds and algorithm are those of the search under way: fixed at the start.

    The state output has the phase (0 stopped, 1 search, 2 hold), the iteration and evaluations of the newest search,
    the number of new searches after the first, the best value and command so far, and the proven bound. That is of the
    plant as it was while the search measured. It is 0 without a proof, and from when measurements prove that the plant
    changed during the search, or the value held differs from what was found, by more than the gap that was proven.
    """

    _since: int | None  # when the command arrived at the target
    _reference: float | None  # value held that changes are measured against
    _looking: int | None  # since when the search is done and looks back
    _dark: int | None  # since when candidates end without a signal
    _streak: int  # samples in a row without one

    @abstractmethod
    def new_search(self, rng: np.random.Generator) -> Search:
        """Make a search."""

    @abstractmethod
    def objective(self, sample: Point) -> float:
        """Give the objective of a measurement."""

    @abstractmethod
    def slew(self) -> float:
        """Give the most change of a command in a second; 0: no limit."""

    def no_signal(self, sample: Point, value: float) -> bool:
        """Tell whether a measurement during a search shows that there is nothing to search on: not above `floor`."""
        return self.p.floor is not None and value <= self.p.floor

    def characteristic(self, n: int) -> FallingCurve | None:
        """Make what sees in measurements that the plant is another one, n of them a corner; None: nothing can."""
        return None

    def setup(self) -> None:
        """Times in ns."""
        p = self.p
        self._period, self._hold, self._settle, self._rescan = (
            to_ns(t) for t in (p.period, p.hold_time, p.settle_time, p.rescan_period)
        )
        self._window_size = max(1, round(p.measure_window / p.period))
        self._step = self.slew() * p.period or math.inf

    def start(self) -> None:
        """No candidate yet."""
        self._pressed: tuple[bool, ...] = (False, False, False)
        self._window: deque[float] = deque(maxlen=self._window_size)
        self._command: Point | None = None
        self._restarts = -1
        self._unconfirmed = 0  # searches in a row whose result the plant did not bear out
        self._begin(0)
        if not self.p.autostart:  # the search begun only answers for the state; the first start makes another
            self._phase = Phase.STOPPED
            self._restarts = -1
            self._aim(tuple(self._search.lower.tolist()))
        self._note()

    def update(
        self, t: int, measurement: Point, start: Point | None, stop: Point | None, restart: Point | None
    ) -> Mapping[str, Point]:
        """Answer one tick."""
        self._press(t, start == (1.0,), stop == (1.0,), restart == (1.0,))
        value = self.objective(measurement)
        if not math.isfinite(value):
            self.report(Level.ERROR, "objective", f"the objective is {value}: the candidate is measured again")
            self._discard(t)
        else:
            self._window.append(value)
            if self._phase is Phase.SEARCH:
                if self._waiting:
                    self._wait_tick(t)
                else:
                    self._search_tick(t, measurement, self.no_signal(measurement, value))
            elif self._phase is Phase.HOLD:
                self._hold_tick(t, measurement)
        return {"command": self._move(t), "state": self._state}

    def refused(self, t: int) -> Mapping[str, Point]:
        """Stay with the candidate; the safe command would be measured in its name."""
        self._discard(t)
        return {"command": self._move(t), "state": self._state}

    def _discard(self, t: int) -> None:
        """Forget the samples next to a bad one; a candidate is then applied for a whole dwell again."""
        self._window.clear()
        # what is held is not judged anew: bad samples now and then must not keep off the looks at it and the timer
        if self._phase is Phase.SEARCH and self._since is not None:
            self._since = t

    # the command -----------------------------------------------------------------------------------------------

    def _aim(self, target: Point) -> None:
        self._target = target
        self._since = None

    def _move(self, t: int) -> Point:
        """Go towards the target; note when it is there."""
        limit = self._step
        if self._command is None:
            self._command = self._target
        pairs = zip(self._command, self._target, strict=True)
        self._command = tuple(
            to if abs(to - x) <= limit else x + math.copysign(limit, to - x) for x, to in pairs
        )  # fmt: skip
        if self._since is None and self._command == self._target:
            self._since = t
            self._window.clear()
        return self._command

    # the search ------------------------------------------------------------------------------------------------

    def _begin(self, t: int) -> None:
        """Start a new search."""
        self._phase = Phase.SEARCH
        self._began = t
        self._restarts += 1
        self._search = self.new_search(self.rng)
        self._dark = None
        self._streak = 0
        self._waiting = self._broken = False
        self._void = math.isinf(self._search.gap)
        self._reference = None
        self._again = math.inf
        self._looking = None
        watched = self._search.remembers and (self.p.restart_threshold > 0.0 or not self._void)
        self._curve = self.characteristic(max(1, self._hold // (4 * self._period))) if watched else None
        self._aim(self._search.ask())

    def _gone(self, t: int) -> None:
        """Measure the candidate again; after a while give up the search."""
        self._discard(t)
        self._dark = t if self._dark is None else self._dark
        if t - self._dark >= self._hold:
            self.report(Level.WARN, "no signal", "the signal is gone: the search stops; another one when it is back")
            self._waiting = True
            self._aim(tuple(self._search.lower.tolist()))

    def _wait_tick(self, t: int) -> None:
        if self._since is not None and t - self._since >= self._hold:
            if self.p.floor is None or self._mean() > self.p.floor:
                self._begin(t)
                self._note()
            else:
                self._since = t

    def _search_tick(self, t: int, sample: Point, dark: bool) -> None:
        search = self._search
        wait = self._hold if search.settle else self._period
        self._streak = self._streak + 1 if dark else self._streak
        if not dark:
            if 2 * self._streak * self._period >= self._hold:  # not one of a transient: the candidate has not settled
                self._discard(t)
            self._streak = 0
            if self._breaks_off(t, sample):
                return
        if self._looking is not None:
            self._look_back(t, t - self._looking)
            return
        if self._since is None or t - self._since < wait:
            if not dark:
                search.watch(sample)
            return
        if dark and self.no_signal(sample, self._mean()):
            self._gone(t)
            return
        self._dark = None
        search.tell(self._mean(), sample)
        if not search.done:
            self._aim(search.ask())
        elif self.p.floor is not None and search.expected <= self.p.floor:
            self.report(Level.WARN, "no signal", "no candidate gave a value above the floor: searching on")
            self._begin(t)
        elif self._curve is not None and self.p.restart_threshold > 0.0:
            self._looking = t
        else:
            self._keep()
        self._note()

    def _look_back(self, t: int, elapsed: int) -> None:
        """Pass through the range of the command once: the search may have measured what is no more."""
        share = elapsed / (LOOK_BACK * self._hold)
        lower, upper = self._search.lower, self._search.upper
        if share < 1.0:
            self._aim(tuple((lower + share * (upper - lower)).tolist()))
        elif self._command == self._target:
            self._keep()
            self._note()

    def _keep(self) -> None:
        """Hold what was found."""
        self._phase = Phase.HOLD
        self._aim(self._search.result)
        self._next_sample = self._hold
        self._seen = math.inf
        self._deviations = 0
        self._lost = False

    def _breaks_off(self, t: int, sample: Point) -> bool:
        """See in a measurement that the plant changed since the search began; tell whether another one has begun."""
        if self._curve is None:
            return False
        change, gap, threshold = self._curve.take(sample), self._search.gap, self.p.restart_threshold
        if change > gap and not self._void:
            self._withdraw()
        if self._broken or self._reference is not None or not change > min(threshold, gap) > 0.0:
            return False
        self._broken = True
        self._unconfirmed += 1
        if self._unconfirmed > BROKEN:
            return False
        self.report(Level.WARN, "changed", "the plant changed during the search: searching anew")
        self._begin(t)
        self._note()
        return True

    def _withdraw(self) -> None:
        if self._search.bound is not None:
            self.report(Level.WARN, "proof", "the plant is not the one of the proof any more: the bound is withdrawn")
        self._void = True
        self._note()

    def _refuted(self, t: int, value: float) -> bool:
        """Whether the value held calls for a new search, now; plan one for later when that has been tried."""
        free = BROKEN if self._broken else 1
        if not self._broken:
            if not self._differs(value, self._search.expected):
                self._unconfirmed = 0
                return False
            self._unconfirmed += 1
        self._again = t + (t - self._began) * 2 ** max(self._unconfirmed - free, 0)
        return self._unconfirmed <= free

    def _hold_tick(self, t: int, sample: Point) -> None:
        watched = self._reference is None or not self._void
        if watched and not self.no_signal(sample, self._window[-1]) and self._breaks_off(t, sample):
            return
        if self._since is None or t - self._since < self._next_sample:
            return
        held, value = t - self._since, self._mean()
        self._next_sample = held + self._hold  # also after bad samples a whole hold_time apart
        expected, changed = self._search.expected, self._changed(t, value, held)
        judged = self._lost or self._reference is not None
        if judged and not self._void and abs(value - expected) > self._search.gap * abs(expected):
            self._withdraw()
        timer = t >= self._again or (self._rescan and t - self._began >= self._rescan)
        if changed or (timer and not self._lost):
            self._begin(t)
            self._note()

    def _changed(self, t: int, value: float, held: int) -> bool:
        """Whether the value held calls for a new search."""
        if self.p.floor is not None and value <= self.p.floor:
            self._lost = True
            self.report(Level.WARN, "no signal", "the value held fell to the floor: waiting for it")
            return False
        if self._lost:
            return True
        if self._reference is None:
            before, self._seen = self._seen, value
            if held < self._settle or self._differs(value, before, STEADY):
                return False
            self._reference = value
            return self._refuted(t, value)
        self._deviations = self._deviations + 1 if self._differs(value, self._reference) else 0
        return self._deviations == CONSECUTIVE

    def _differs(self, value: float, reference: float, part: float = 1.0) -> bool:
        threshold = part * self.p.restart_threshold
        return threshold > 0.0 and abs(value - reference) > threshold * abs(reference)

    def _mean(self) -> float:
        return math.fsum(self._window) / len(self._window)

    # people ----------------------------------------------------------------------------------------------------

    def _press(self, t: int, *pressed: bool) -> None:
        """Act on the buttons that went down: stop before restart before start."""
        if pressed == self._pressed:
            return
        start, stop, restart = (now and not before for now, before in zip(pressed, self._pressed, strict=True))
        self._pressed = pressed
        if stop:
            self._phase = Phase.STOPPED
            if self._search.best is not None:
                self._aim(self._search.result)
        elif restart or (start and self._phase is Phase.STOPPED):
            self._unconfirmed = 0
            self._begin(t)
        self._note()

    def _note(self) -> None:
        """Prepare the state output; it changes only with a value told, a phase or a button."""
        search = self._search
        best, x = (0.0, self._target) if search.best is None else (search.expected, search.result)
        self._state = (
            float(self._phase), float(search.iteration), float(search.evaluations), float(max(self._restarts, 0)), best,
            (not self._void and search.bound) or 0.0, *x,
        )  # fmt: skip


class OptimiserParams(SearchParams):
    """What to search and what to optimise."""

    algorithm: Algorithm = param("pso", "name of the algorithm")
    channels: tuple[str, ...] = param(("command",), "names of the command channels", min_length=1)
    lower: tuple[float, ...] = param((0.0,), "lower bound of each channel, in its unit")
    upper: tuple[float, ...] = param((1.0,), "upper bound of each channel, in its unit")
    unit: str = param("1", "unit of the command")
    max_slew: float = param(0.0, "most change of each channel in a second; 0: no limit", "1/s", ge=0.0, live=True)
    objective: str = param("objective", "name of the measured objective")
    maximise: bool = param(True, "whether a larger objective is better")

    @model_validator(mode="after")
    def _search(self) -> Self:
        if len(self.lower) != len(self.channels):
            raise ValueError(f"{len(self.lower)} values of lower for {len(self.channels)} channels")
        make(self.algorithm, self.lower, self.upper, 0, self, maximise=self.maximise)
        return self


class Optimiser(CommandSearch[OptimiserParams]):
    """Optimiser of any plant with bounded commands and one measured objective.

    The objective comes as a named scalar on ``objective``, the commands go out on ``command``; remap both.
    """

    @classmethod
    def ports(cls, params: OptimiserParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels as the parameters name them."""
        measurement = scalars("measurement", "objective", {params.objective: ""})
        to = command("command", "command", params.channels, params.unit, safe=params.lower)
        state = state_port("optimiser/state", dict.fromkeys(params.channels, params.unit))
        return (measurement, *buttons("optimiser")), (to, state)

    def new_search(self, rng: np.random.Generator) -> Search:
        """Make a search over the channels."""
        p = self.p
        return make(p.algorithm, p.lower, p.upper, rng, p, maximise=p.maximise)

    def objective(self, sample: Point) -> float:
        """The one measured scalar."""
        return sample[0]

    def slew(self) -> float:
        """As the parameter says."""
        return self.p.max_slew


main = executable(Optimiser)
