"""Search of command channels over topics: publish a candidate, wait, measure the objective, update the algorithm."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from softrig_core import Block, BlockParams, Level, Port, button, command, param, scalars, to_ns
from softrig_core.kit.dense import total
from typing_extensions import TypeVar

from .algorithms import Algorithm, AlgorithmParams, make
from .falling import FallingCurve
from .search import Point, Search, SearchHistory

# One sample may be a dip of the measurement, so a single deviation of the held objective does not start a search.
CONSECUTIVE = 2
# A value that still moves is no reference for changes: in a hold_time it may move by this share of the threshold.
STEADY = 0.1
# Duration of a scan of the range in hold_times. No point of it need settle: a transient is on the characteristic, too.
SCAN_HOLDS = 2
# A pass spends SCAN_HOLDS hold_times off the best point; this pause, in hold_times, keeps that share below a tenth.
SCAN_PAUSE = 25
# The number of searches in a row that a change may break off: a plant that never rests would never get a result.
BROKEN = 3
# These stand for "has not been" and "will not be", so that times stay integers, as native code needs them.
NEVER, LATER = -1, 1 << 62
# The delay doubles with each refuted search; this bound in ns keeps the sum with a time within 64 bits.
LONGEST = 2e18


class Phase:
    """The phase of the block."""

    STOPPED, SEARCH, HOLD = range(3)


class SearchParams(AlgorithmParams, BlockParams):
    """Parameters of a search on a plant."""

    period: float = param(0.001, "sampling period of the measurement", "s", gt=0.0, le=100.0)
    hold_time: float = param(
        0.04, "time for which a candidate is applied before its value is measured", "s", gt=0.0, live=True
    )
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

    def _check(self) -> None:
        if self.hold_time < self.period:
            raise ValueError(f"hold_time = {self.hold_time:g} s is shorter than period = {self.period:g} s")
        if self.measure_window > self.hold_time:
            raise ValueError(
                f"measure_window = {self.measure_window:g} s is longer than hold_time = {self.hold_time:g} s"
            )

    def search(self, rng: np.random.Generator) -> Search:
        """Create a search."""
        raise NotImplementedError


class State(NamedTuple):
    """State of a search over topics; times in ns, `NEVER` if there is none."""

    search: SearchHistory
    phase: int
    began: int
    """When the newest search did."""

    restarts: int
    """New searches after the first; -1 before that."""

    void: bool
    """Whether the search proves nothing, or no more."""

    curve: FallingCurve | None
    """What sees that the plant is another one."""

    target: Point
    """Where the command goes."""

    state: Point
    """The state output; it changes only with a value told, a phase or a button."""

    command: Point
    """Where it is now."""

    window: tuple[float, ...]
    """The newest values of the objective since the command arrived, the newest last; 0 where there are fewer."""

    filled: int = 0
    """How many they are."""

    pressed: tuple[bool, ...] = (False, False, False)
    """Buttons that are down."""

    since: int = NEVER
    """When the command arrived at the target."""

    unconfirmed: int = 0
    """Searches in a row whose result the plant did not bear out."""

    dark: int = NEVER
    """Since when candidates end without a signal."""

    streak: int = 0
    """Samples in a row without one."""

    waiting: bool = False
    """Whether it waits for a signal."""

    scanning_since: int = NEVER
    """Time at which the scan of the range after a search began; `NEVER` outside of one."""

    broken: bool = False
    """Whether a change of the plant has broken the search off, or should have."""

    reference: float = math.inf
    """Value held that changes are measured against; infinite before there is one."""

    again: int = LATER
    """When the next search starts whatever is held."""

    next_scan: int = LATER
    """Time of the next scan."""

    next_sample: int = 0
    """Time after `since` at which what is held is looked at next."""

    seen: float = math.inf
    """The value at the last check of the held command."""

    deviations: int = 0
    """Looks in a row that differ from the reference."""

    lost: bool = False
    """Whether the value held has fallen to the floor."""


def buttons(prefix: str) -> tuple[Port, ...]:
    """Return the held buttons of a search; each acts when it is pressed."""
    return tuple(button(name, f"{prefix}/{name}", held=True) for name in ("start", "stop", "restart"))


def state_port(topic: str, channels: Mapping[str, str]) -> Port:
    """Return the state output of a search over the channels (name to unit)."""
    units = {"phase": "", "iteration": "", "evaluations": "", "restarts": "", "best_value": "", "bound": ""}
    return scalars("state", topic, units | {f"best_{name}": unit for name, unit in channels.items()})


P = TypeVar("P", bound=SearchParams, default=SearchParams)


class CommandOptimiser(Block[P], ABC):
    """Base of the optimiser nodes; a subclass defines the search variables and the objective.

    The command moves to each candidate by at most `slew` per second. `hold_time` after it has arrived, the measured
    value is passed to the algorithm and the next candidate is applied. After a search its result is held. A new search
    starts

    - if the value at the end of `settle_time` differs by more than `restart_threshold` from the result of the search:
      the plant has changed in the meantime (checked later if the value still moves by a tenth of that per `hold_time`);
    - immediately, before that time, if the measurements prove a change of the plant by more than
      `restart_threshold` (`characteristic`) or by more than the gap of a proof. To make such measurements possible, a
      search whose plant has a characteristic ends with a scan: the command sweeps once through its range;
    - if two successive samples, `hold_time` apart, differ by that much from the value at the end of `settle_time`;
    - immediately if a scan of the range measures a value that exceeds the search's by more than `restart_threshold`;
      the plant has changed, or the search missed that value. After a search that a change has started, scans are
      repeated. The time to the next scan is that from the start of the search to the last scan, at least `SCAN_PAUSE`
      times `hold_time`. A plant that changed once may change again, at commands where the held value does not show it;
    - `rescan_period` after the start of the last search.

    A result that is lost in this way for the second time in a row is held nevertheless, for twice the duration of its
    search. The same applies to a search that is broken off for the fourth time in a row. The time doubles with each
    repetition, so searches become rare if no result is ever confirmed.

    A search that has no signal (`no_signal`) for `hold_time` stops, applies the lower bounds, and starts again when the
    signal returns. After a shorter gap the candidate is measured again. This does not require `restart_threshold`.

    Without `autostart`, the command is the lower bounds until the first start. A candidate with a bad measurement among
    its samples is measured again. Bounds and algorithm are fixed when a search starts.

    The state output has the phase (0 stopped, 1 search, 2 hold), the iteration and evaluations of the newest search,
    the number of new searches after the first, the best value and command so far, and the proven bound. The bound
    applies to the plant as it was during the search. It is 0 without a proof. It also becomes 0 when measurements prove
    that the plant changed during the search by more than the proven gap, or when the held value differs from the result
    by more than this gap.
    """

    @abstractmethod
    def objective(self, sample: Point) -> float:
        """Return the objective of a measurement."""

    @abstractmethod
    def slew(self) -> float:
        """Return the most change of a command in a second; 0: no limit."""

    def no_signal(self, sample: Point, value: float) -> bool:
        """Return whether a measurement during a search is at or below `floor`, so that there is no signal."""
        return self.p.floor is not None and value <= self.p.floor

    def characteristic(self, n: int) -> FallingCurve | None:
        """Create a detector of changes of the plant, with n measurements for a corner; None: it cannot be detected."""
        return None

    def setup(self) -> None:
        """Times in ns."""
        p = self.p
        self._period, self._hold, self._settle, self._rescan = (
            to_ns(t) for t in (p.period, p.hold_time, p.settle_time, p.rescan_period)
        )
        # The window is filled with zeros because the state keeps its shape from tick to tick; `filled` counts the
        # samples.
        self._nothing = (0.0,) * max(1, round(p.measure_window / p.period))
        # A slew of 0 means no limit.
        self._step = self.slew() * p.period or math.inf

    def first(self) -> State:
        """Begin the first search, or wait for the start."""
        x = self._begin(None, 0)
        # The search is needed for the bounds in the state output only; the first start makes another one.
        if not self.p.autostart:
            lower = x.search.low
            x = x._replace(phase=Phase.STOPPED, restarts=-1, target=lower, command=lower)
        return self._note(x)

    def decides(self, x: State, t: int) -> bool:
        """Return whether the search receives values: it is a generator."""
        if x.phase != Phase.SEARCH or x.waiting or x.scanning_since != NEVER or x.since == NEVER:
            return False
        # A search that watches uses the samples on the way to a candidate, so it receives a value at every tick.
        return x.search.watches or t - x.since >= self._wait(x)

    def _wait(self, x: State) -> int:
        """Return how long a candidate is applied."""
        # A sweep is measured on the fly, one sample a tick; a hold_time at each point would make it a slow scan.
        return self._hold if x.search.settle else self._period

    def update(
        self, x: State, t: int, *, measurement: Point, start: Point | None, stop: Point | None, restart: Point | None
    ) -> tuple[State, Mapping[str, Point]]:
        """Answer one tick."""
        pressed = (start == (1.0,), stop == (1.0,), restart == (1.0,))
        if pressed != x.pressed:
            x = self._press(x, t, pressed)
        value = self.objective(measurement)
        if not math.isfinite(value):
            self.report(Level.ERROR, "objective", f"the objective is {value}: the candidate is measured again")
            x = self._discard(x, t)
        else:
            x = x._replace(window=(*x.window[1:], value), filled=min(x.filled + 1, len(x.window)))
            if x.phase == Phase.SEARCH:
                if x.waiting:
                    x = self._wait_tick(x, t)
                else:
                    x = self._search_tick(x, t, measurement, self.no_signal(measurement, value))
            elif x.phase == Phase.HOLD:
                x = self._hold_tick(x, t, measurement)
        return self._moved(x, t)

    def refused(self, x: State, t: int) -> tuple[State, Mapping[str, Point]]:
        """Stay with the candidate; the safe command would be measured in its name."""
        return self._moved(self._discard(x, t), t)

    def _discard(self, x: State, t: int) -> State:
        """Forget the samples next to a bad one; a candidate is then applied for a whole dwell again."""
        # While a result is held the dwell is not restarted: occasional bad samples must not postpone its checks.
        again = x.phase == Phase.SEARCH and x.since != NEVER
        return x._replace(window=self._nothing, filled=0, since=t if again else x.since)

    # the command -----------------------------------------------------------------------------------------------

    def _moved(self, x: State, t: int) -> tuple[State, Mapping[str, Point]]:
        """Move towards the target; record when it is reached."""
        if x.since == NEVER or x.command != x.target:
            limit, target = self._step, x.target
            command = tuple(
                [
                    goal if abs(goal - value) <= limit else value + math.copysign(limit, goal - value)
                    for value, goal in zip(x.command, target, strict=True)
                ]
            )
            x = x._replace(command=command)
            if x.since == NEVER and command == target:
                # Samples from the way to the target belong to no candidate, so they must not enter its mean.
                x = x._replace(since=t, window=self._nothing, filled=0)
        return x, {"command": x.command, "state": x.state}

    # the search ------------------------------------------------------------------------------------------------

    def _begin(self, x: State | None, t: int, next_scan: int = LATER) -> State:
        """Start a new search; from the time `next_scan` (ns) on, the node checks for another change after it."""
        history = SearchHistory(self.p.search, self.generator() if x is None else x.search.now.rng)
        search = history.now
        # An infinite gap means that this search proves nothing, so there is no bound to withdraw.
        void = math.isinf(search.gap)
        # A search that does not rely on old values follows a changed plant by itself and need not be broken off.
        watched = search.remembers and (self.p.restart_threshold > 0.0 or not void)
        # A corner spans a quarter of a hold_time: noise and fast transients within it prove no change.
        curve = self.characteristic(max(1, self._hold // (4 * self._period))) if watched else None
        target, phase = search.ask(), Phase.SEARCH
        if x is None:
            return State(history, phase, t, 0, void, curve, target, (), target, self._nothing)
        return State(
            history, phase, t, x.restarts + 1, void, curve, target, x.state, x.command, x.window, x.filled, x.pressed
        )._replace(unconfirmed=x.unconfirmed, next_scan=next_scan)

    def _gone(self, x: State, t: int) -> State:
        """Measure the candidate again; after a while abort the search."""
        x = self._discard(x, t)
        # The time counts from the first candidate without a signal; a shorter gap only repeats the measurement.
        dark = t if x.dark == NEVER else x.dark
        if t - dark < self._hold:
            return x._replace(dark=dark)
        self.report(
            Level.WARN, "no signal", "the signal is lost: the search stops, and a new one starts when it returns"
        )
        return x._replace(dark=dark, waiting=True, target=x.search.low, since=NEVER)

    def _wait_tick(self, x: State, t: int) -> State:
        if x.since == NEVER or t - x.since < self._hold:
            return x
        # A subclass may define `no_signal` without a floor; then only a new search shows whether the signal is back.
        if self.p.floor is None or _mean(x) > self.p.floor:
            return self._note(self._begin(x, t))
        return x._replace(since=t)

    def _search_tick(self, x: State, t: int, sample: Point, dark: bool) -> State:
        if dark:
            x = x._replace(streak=x.streak + 1)
        else:
            # A gap of half a hold_time is no part of a transient, so the candidate has not settled and is applied
            # again.
            if 2 * x.streak * self._period >= self._hold:
                x = self._discard(x, t)
            if x.streak:
                x = x._replace(streak=0)
            x, begun = self._breaks_off(x, t, sample)
            if begun:
                return x
        if x.scanning_since != NEVER:
            return self._scan(x, t, t - x.scanning_since)
        if x.since == NEVER or t - x.since < self._wait(x):
            return x if dark or not x.search.watches else x._replace(search=x.search.watch(sample))
        # One dark sample at the end may be noise; the mean of the window must be without a signal too.
        if dark and self.no_signal(sample, _mean(x)):
            return self._gone(x, t)
        x = x._replace(dark=NEVER, search=x.search.tell(_mean(x), sample))
        search = x.search.now
        if not search.done:
            x = x._replace(target=search.ask(), since=NEVER)
        # A best value at the floor or below is no optimum, so it is not held.
        elif self.p.floor is not None and search.expected <= self.p.floor:
            self.report(Level.WARN, "no signal", "no candidate had a value above the floor: the search continues")
            x = self._begin(x, t)
        elif x.curve is not None and self.p.restart_threshold > 0.0:
            x = x._replace(scanning_since=t)
        else:
            x = self._keep(x, t)
        return self._note(x)

    def _scan(self, x: State, t: int, elapsed: int) -> State:
        """Move the command once through its range: the plant may have changed since the search measured there."""
        share = elapsed / (SCAN_HOLDS * self._hold)
        if share < 1.0:
            ends = zip(x.search.low, x.search.high, strict=True)
            return x._replace(target=tuple([low + share * (high - low) for low, high in ends]), since=NEVER)
        # The slew limit may keep the command behind its target, so the scan ends only when it has arrived.
        return self._note(self._keep(x, t)) if x.command == x.target else x

    def _keep(self, x: State, t: int) -> State:
        """Hold the result until as much time as the search took has passed, if something had changed during it."""
        return x._replace(
            phase=Phase.HOLD,
            scanning_since=NEVER,
            # A search that the timer began is followed by no passes: nothing has shown that this plant changes.
            next_scan=LATER
            if x.scanning_since == NEVER or x.next_scan == LATER
            else t + max(t - x.began, SCAN_PAUSE * self._hold),
            target=x.search.now.result,
            since=NEVER,
            next_sample=self._hold,
            seen=math.inf,
            deviations=0,
            lost=False,
        )

    def _breaks_off(self, x: State, t: int, sample: Point) -> tuple[State, bool]:
        """Detect from a measurement that the plant changed since the search began; return also whether one started."""
        if x.curve is None:
            return x, False
        change, curve = x.curve.with_sample(sample)
        x = x._replace(curve=curve)
        gap = x.search.gap
        # A change beyond the gap refutes the proof, so it breaks the search off even where it is below the threshold.
        changed = change > min(self.p.restart_threshold, gap) > 0.0
        # A pass is too fast to leave corners near the line from 0, so the value itself is compared too.
        more = (
            x.scanning_since != NEVER and x.filled and _mean(x) > (1.0 + self.p.restart_threshold) * x.search.expected
        )
        if (change > gap or more) and not x.void:
            x = self._withdraw(x)
        if x.broken or x.reference < math.inf or not (changed or more):
            return x, False
        x = x._replace(broken=True, unconfirmed=x.unconfirmed + 1)
        # After that many broken searches in a row this one is finished, so that some result is applied at all.
        if x.unconfirmed > BROKEN:
            return x, False
        if changed:
            self.report(Level.WARN, "changed", "the plant changed during the search: searching again")
        else:
            self.report(
                Level.WARN, "more", "a scan of the range measured a larger value than the search: searching again"
            )
        return self._note(self._begin(x, t, t if changed else x.next_scan)), True

    def _withdraw(self, x: State) -> State:
        if x.search.now.bound is not None:
            self.report(Level.WARN, "proof", "the plant has changed since the proof: the bound is withdrawn")
        return self._note(x._replace(void=True))

    def _refuted(self, x: State, t: int, value: float) -> tuple[State, bool]:
        """Return whether the held value requires a new search now; plan a later one if that has been tried."""
        # A search that was broken off may be repeated BROKEN times, any other refuted result once.
        free = BROKEN if x.broken else 1
        unconfirmed = x.unconfirmed
        if not x.broken:
            if not self._differs(value, x.search.expected):
                return x._replace(unconfirmed=0), False
            unconfirmed += 1
        # Where no result is ever confirmed, the pause doubles so that searches become rare.
        later = min((t - x.began) * 2.0 ** max(unconfirmed - free, 0), LONGEST)
        return x._replace(unconfirmed=unconfirmed, again=t + int(later)), unconfirmed <= free

    def _hold_tick(self, x: State, t: int, sample: Point) -> State:
        # Once a reference is taken, samples matter only for a proof that may still have to be withdrawn.
        watched = x.reference == math.inf or not x.void
        if watched and not self.no_signal(sample, x.window[-1]):
            x, begun = self._breaks_off(x, t, sample)
            if begun:
                return x
        if x.since == NEVER or t - x.since < x.next_sample:
            return x
        elapsed, value = t - x.since, _mean(x)
        # The next check is a whole hold_time after this one, also after bad samples.
        x, changed = self._changed(x._replace(next_sample=elapsed + self._hold), t, value, elapsed)
        # Before the value has settled, a deviation from the expected one proves nothing.
        judged, expected = x.lost or x.reference < math.inf, x.search.expected
        if judged and not x.void and abs(value - expected) > x.search.gap * abs(expected):
            x = self._withdraw(x)
        if changed or (t >= x.again and not x.lost):
            return self._note(self._begin(x, t, t))
        # Without a signal a new search would find nothing; it begins when the signal is back.
        if 0 < self._rescan <= t - x.began and not x.lost:
            return self._note(self._begin(x, t))
        if t >= x.next_scan and x.reference < math.inf and not x.lost:
            return self._note(x._replace(phase=Phase.SEARCH, scanning_since=t, reference=math.inf))
        return x

    def _changed(self, x: State, t: int, value: float, elapsed: int) -> tuple[State, bool]:
        """Return whether the held value requires a new search."""
        if self.p.floor is not None and value <= self.p.floor:
            self.report(Level.WARN, "no signal", "the held value fell to the floor: waiting until it rises")
            return x._replace(lost=True), False
        if x.lost:
            return x, True
        if x.reference == math.inf:
            before, x = x.seen, x._replace(seen=value)
            # The reference must be a value at rest, for every later change is measured against it.
            if elapsed < self._settle or self._differs(value, before, STEADY):
                return x, False
            return self._refuted(x._replace(reference=value), t, value)
        deviations = x.deviations + 1 if self._differs(value, x.reference) else 0
        return x._replace(deviations=deviations), deviations == CONSECUTIVE

    def _differs(self, value: float, reference: float, factor: float = 1.0) -> bool:
        threshold = factor * self.p.restart_threshold
        return threshold > 0.0 and abs(value - reference) > threshold * abs(reference)

    # people ----------------------------------------------------------------------------------------------------

    def _press(self, x: State, t: int, pressed: tuple[bool, ...]) -> State:
        """Act on the buttons that went down: stop before restart before start."""
        # Buttons act on their edge: they are held, so a level would act again at each tick.
        start, stop, restart = (now and not before for now, before in zip(pressed, x.pressed, strict=True))
        x = x._replace(pressed=pressed)
        if stop:
            x = x._replace(phase=Phase.STOPPED)
            if x.search.now.best is not None:
                x = x._replace(target=x.search.now.result, since=NEVER)
        # A person requested this search, so its result is judged without those that were refuted before.
        elif restart or (start and x.phase == Phase.STOPPED):
            x = self._begin(x._replace(unconfirmed=0), t)
        return self._note(x)

    def _note(self, x: State) -> State:
        """Prepare the state output."""
        search = x.search.now
        best, best_command = (0.0, x.target) if search.best is None else (search.expected, search.result)
        return x._replace(
            state=(
                float(x.phase),
                float(search.iteration),
                float(search.evaluations),
                float(max(x.restarts, 0)),
                best,
                (not x.void and search.bound) or 0.0,
                *best_command,
            )
        )


def _mean(x: State) -> float:
    return total(x.window) / x.filled


class OptimiserParams(SearchParams):
    """The search variables and the objective."""

    algorithm: Algorithm = param("pso", "name of the algorithm")
    channels: tuple[str, ...] = param(("command",), "names of the command channels", min_length=1)
    lower: tuple[float, ...] = param((0.0,), "lower bound of each channel, in its unit")
    upper: tuple[float, ...] = param((1.0,), "upper bound of each channel, in its unit")
    unit: str = param("1", "unit of the command")
    max_slew: float = param(0.0, "most change of each channel in a second; 0: no limit", "1/s", ge=0.0, live=True)
    objective: str = param("objective", "name of the measured objective")
    maximise: bool = param(True, "whether a larger objective is better")

    def _check(self) -> None:
        if len(self.lower) != len(self.channels):
            raise ValueError(f"{len(self.lower)} values of lower for {len(self.channels)} channels")
        # This builds a search to check its settings now, because an error inside a run would come too late.
        self.search(np.random.default_rng(0))

    def search(self, rng: np.random.Generator) -> Search:
        """Create a search over the channels."""
        return make(self.algorithm, self.lower, self.upper, rng, self, maximise=self.maximise)


class Optimiser(CommandOptimiser[OptimiserParams]):
    """Optimiser of any plant with bounded commands and one measured objective.

    The objective comes as a named scalar on ``objective``, the commands go out on ``command``; remap both.
    """

    @classmethod
    def ports(cls, params: OptimiserParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels as the parameters name them."""
        measurement = scalars("measurement", "objective", {params.objective: ""})
        command_port = command("command", "command", params.channels, params.unit, safe=params.lower)
        state = state_port("optimiser/state", dict.fromkeys(params.channels, params.unit))
        return (measurement, *buttons("optimiser")), (command_port, state)

    def objective(self, sample: Point) -> float:
        """The one measured scalar."""
        return sample[0]

    def slew(self) -> float:
        """Return the rate of the parameter."""
        return self.p.max_slew
