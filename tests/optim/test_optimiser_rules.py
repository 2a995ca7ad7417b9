"""The optimiser tick by tick: random measurements and buttons, changing plants.

Source: its page, as a naive model of the contract tick by tick.
"""

import copy
import math
import random

import pytest
from helpers import Transformer
from softrig_core import ByHand, param
from softrig_optim.falling import FallingCurve
from softrig_optim.load_line import CertifiedSearch
from softrig_optim.optimiser import CommandOptimiser, Optimiser, SearchParams
from softrig_optim.pso import ParticleSwarm
from softrig_optim.scan import Scan

STOPPED, SEARCH, HOLD = range(3)
PERIOD = 10_000_000  # ns; the re-implementations count time in ticks


class ProvenParams(SearchParams):
    """Parameters of a search that ends with a proof."""

    transients: bool = param(False, "whether it looks on the way")
    max_slew: float = param(0.0, "slew")

    def search(self, rng):
        return CertifiedSearch(
            [0.5], [2.0], rng, matching=Transformer(), eps=0.1, n_iter=4, corrections=1, transients=self.transients
        )


class OfPower:
    """The search maximises the product of both measurements."""

    def objective(self, sample):
        return sample[0] * sample[1]

    def slew(self):
        return self.p.max_slew

    def characteristic(self, n):
        return FallingCurve(n)


class Proven(OfPower, CommandOptimiser[ProvenParams]):
    """A source with a proven optimum."""

    ports = Optimiser.ports


class Scanned(OfPower, Optimiser):
    """A source that is scanned."""


class Account:
    """The page of `CommandOptimiser`, implemented independently."""

    def __init__(self, make, rng, falls, *, hold, window, settle, threshold, rescan, floor, autostart, slew):
        self.make, self.rng, self.falls, self.hold, self.n, self.settle = make, rng, falls, hold, window, settle
        self.threshold, self.rescan, self.floor, self.slew = threshold, rescan, floor, slew
        self.restarts, self.down, self.reported, self.failures, self.command = -1, (False,) * 3, set(), 0, None
        self.since_arrival = []
        self.begin(0)
        self.command = self.target
        if not autostart:
            self.phase, self.restarts, self.target, self.command = STOPPED, -1, self.low(), self.low()
        self.note()

    def low(self):
        return tuple(self.search.lower.tolist())

    def high(self):
        return tuple(self.search.upper.tolist())

    def begin(self, k, style=None):
        """Begin a new search, with the random numbers of the one before."""
        self.search = self.make(copy.deepcopy(self.rng if self.command is None else self.search.rng))
        self.phase, self.began, self.restarts, self.target = SEARCH, k, self.restarts + 1, self.search.ask()
        self.proven = math.isfinite(self.search.gap)
        sees = self.falls and self.search.remembers and (self.threshold > 0.0 or self.proven)
        self.curve = FallingCurve(max(1, self.hold // 4)) if sees else None
        self.arrived = self.dark = self.looking = self.reference = self.again = None
        self.gaps, self.waits, self.broken, self.look, self.lost = 0, False, False, style, False
        self.off, self.last = 0, math.inf

    def mean(self):
        return sum(self.since_arrival[-self.n :]) / len(self.since_arrival[-self.n :])

    def note(self):
        s = self.search
        best, at = (s.expected, s.result) if s.best is not None else (0.0, self.target)
        bound = s.bound if self.proven and s.bound else 0.0
        counts = map(float, (self.phase, s.iteration, s.evaluations, max(self.restarts, 0)))
        self.state = (*counts, best, bound, *at)

    def differs(self, value, reference, part=1.0):
        return self.threshold > 0.0 and abs(value - reference) > part * self.threshold * abs(reference)

    def forget(self, k):
        """After a bad sample a candidate is measured for a whole dwell again."""
        self.since_arrival = []
        if self.phase == SEARCH and self.arrived is not None:
            self.arrived = k

    def move(self, k):
        if self.arrived is None or self.command != self.target:
            self.command = tuple(
                to if abs(to - at) <= self.slew else at + math.copysign(self.slew, to - at)
                for at, to in zip(self.command, self.target, strict=True)
            )
            if self.arrived is None and self.command == self.target:
                self.arrived, self.since_arrival = k, []
        return self.command, self.state

    def refused(self, k):
        self.forget(k)
        return self.move(k)

    def tick(self, k, sample, value, pressed):
        if pressed != self.down:
            start, stop, again = (now and not before for now, before in zip(pressed, self.down, strict=True))
            self.down = pressed
            if stop:
                self.phase = STOPPED
                if self.search.best is not None:
                    self.target, self.arrived = self.search.result, None
            elif again or (start and self.phase == STOPPED):
                self.failures = 0
                self.begin(k)
            self.note()
        if not math.isfinite(value):
            self.reported.add("objective")
            self.forget(k)
        else:
            self.since_arrival.append(value)
            if self.phase == SEARCH:
                self.waiting(k) if self.waits else self.searching(k, sample, value)
            elif self.phase == HOLD:
                self.holding(k, sample, value)
        return self.move(k)

    def waiting(self, k):
        """Wait for the signal to return, with a check each dwell."""
        if self.arrived is not None and k - self.arrived >= self.hold:
            if self.floor is None or self.mean() > self.floor:
                self.begin(k)
                self.note()
            else:
                self.arrived = k

    def no_signal(self, value):
        return self.floor is not None and value <= self.floor

    def searching(self, k, sample, value):
        nothing = self.no_signal(value)
        if nothing:
            self.gaps += 1
        else:
            if 2 * self.gaps >= self.hold:
                self.forget(k)
            self.gaps = 0
            if self.breaks_off(k, sample):
                return
        if self.looking is not None:  # the command passes the range in two hold times
            share = (k - self.looking) / (2 * self.hold)
            if share < 1.0:
                self.arrived = None
                self.target = tuple(a + share * (b - a) for a, b in zip(self.low(), self.high(), strict=True))
            elif self.command == self.target:
                self.keep(k)
            return
        dwell = self.hold if self.search.settle else 1
        if self.arrived is None or k - self.arrived < dwell:
            if self.search.watches and not nothing:
                self.search.watch(sample)
            return
        if nothing and self.no_signal(self.mean()):
            self.loses_signal(k)
            return
        self.dark = None
        self.search.tell(self.mean(), sample)
        if not self.search.done:
            self.target, self.arrived = self.search.ask(), None
        elif self.no_signal(self.search.expected):
            self.reported.add("no signal")
            self.begin(k)
        elif self.curve is not None and self.threshold > 0.0:
            self.looking = k
        else:
            self.keep(k)
        self.note()

    def loses_signal(self, k):
        self.forget(k)
        self.dark = k if self.dark is None else self.dark
        if k - self.dark >= self.hold:
            self.reported.add("no signal")
            self.waits, self.target, self.arrived = True, self.low(), None

    def keep(self, k):
        if self.looking is not None and self.look is not None:
            self.look = k + max(k - self.began, 25 * self.hold)
        else:
            self.look = None
        self.phase, self.looking, self.target, self.arrived = HOLD, None, self.search.result, None
        self.next, self.last, self.off, self.lost = self.hold, math.inf, 0, False
        self.note()

    def breaks_off(self, k, sample):
        if self.curve is None:
            return False
        change, self.curve = self.curve.with_sample(sample)
        gap = self.search.gap
        more = (
            self.looking is not None
            and len(self.since_arrival) > 0
            and self.mean() > (1.0 + self.threshold) * self.search.expected
        )
        if self.proven and (change > gap or more):
            self.withdraw()
        changed = change > min(self.threshold, gap) > 0.0
        if self.broken or self.reference is not None or not (changed or more):
            return False
        self.broken, self.failures = True, self.failures + 1
        if self.failures > 3:
            return False
        self.reported.add("changed" if changed else "more")
        self.begin(k, k if changed else self.look)
        self.note()
        return True

    def withdraw(self):
        if self.search.bound is not None:
            self.reported.add("proof")
        self.proven = False
        self.note()

    def holding(self, k, sample, value):
        styles = self.reference is None or self.proven
        if styles and not self.no_signal(value) and self.breaks_off(k, sample):
            return
        if self.arrived is None or k - self.arrived < self.next:
            return
        held = k - self.arrived
        self.next = held + self.hold
        mean = self.mean()
        calls = self.calls(k, mean, held)
        off = abs(mean - self.search.expected) > self.search.gap * abs(self.search.expected)
        if off and self.proven and (self.lost or self.reference is not None):
            self.withdraw()
        if calls or (self.again is not None and k >= self.again and not self.lost):
            self.begin(k, k)
        elif self.rescan and k - self.began >= self.rescan and not self.lost:
            self.begin(k)
        elif self.look is not None and k >= self.look and self.reference is not None and not self.lost:
            self.phase, self.looking, self.reference = SEARCH, k, None
        else:
            return
        self.note()

    def calls(self, k, mean, held):
        """Return whether the held value requires a new search now."""
        if self.no_signal(mean):
            self.reported.add("no signal")
            self.lost = True
            return False
        if self.lost:
            return True
        if self.reference is None:
            moves, self.last = math.isfinite(self.last) and self.differs(mean, self.last, 0.1), mean
            if held < self.settle or moves:
                return False
            self.reference = mean
            return self.refuted(k, mean)
        self.off = self.off + 1 if self.differs(mean, self.reference) else 0
        return self.off == 2

    def refuted(self, k, mean):
        """Return whether a proof is refuted: once, and after three interruptions; then later and later."""
        free = 3 if self.broken else 1
        if not self.broken:
            if not self.differs(mean, self.search.expected):
                self.failures = 0
                return False
            self.failures += 1
        self.again = k + int((k - self.began) * 2.0 ** max(self.failures - free, 0) * PERIOD) / PERIOD
        return self.failures <= free


class Episode:
    """A source whose load the command changes, another one now and then; some measurements are bad or rejected."""

    def __init__(self, seed, calm, floor, threshold):
        self.rng, self.calm, self.level, self.drift, self.down = random.Random(seed), calm, 1.0, 0.0, [False] * 3
        just = [share * (1.0 + part * edge) for edge in (threshold, 0.1) for part in (1.03, -0.99) for share in (1.0,)]
        self.levels = [1.0, 1.0, 0.6, 1.5, *just, *([0.0] * 2 if floor is not None else [])]

    def next(self, command):
        draw = self.rng
        if draw.random() < self.calm:
            self.level, self.drift = draw.choice(self.levels), draw.choice([0.0, 0.0, 0.003, -0.002])
        self.level *= 1.0 + self.drift * (0.5 < self.level < 2.0)
        for k in range(3):
            # The source rarely stops, and not for long.
            if draw.random() < self.calm / (60.0 if k == 1 and not self.down[1] else 12.0):
                self.down[k] = not self.down[k]
        load = 2.0 / command[0] ** 2 + (0.3 * command[1] if len(command) > 1 else 0.0)
        a, b, c = 0.1 * load, 1.0 + 0.5 * load, -4.0 * load  # from v = load i and i = 4 - 0.5 v - 0.1 v^2, at level 1
        v = (math.sqrt(b * b - 4.0 * a * c) - b) / (2.0 * a)
        kind = draw.random()
        return (v, self.level * v / load if kind > 0.004 else math.nan), tuple(self.down), kind > 0.996


KINDS = {
    "scan": (Optimiser, lambda p, rng: Scan(p.lower, p.upper, rng, n_grid=4, tolerance=0.1, maximise=True),
             {"algorithm": "scan", "n_grid": 4, "tolerance": 0.1, "channels": ("d",), "lower": (0.5,),
              "upper": (2.0,)}),
    "swarm": (Optimiser, lambda p, rng: ParticleSwarm(p.lower, p.upper, rng, n_pop=3, n_iter=2, maximise=True),
              {"n_pop": 3, "n_iter": 2, "channels": ("d", "e"), "lower": (0.5, 0.0), "upper": (2.0, 1.0)}),
    "source": (Scanned, lambda p, rng: Scan(p.lower, p.upper, rng, n_grid=3, tolerance=0.0, maximise=True),
               {"algorithm": "scan", "n_grid": 3, "tolerance": 0.0, "channels": ("d",), "lower": (0.5,),
                "upper": (2.0,)}),
    "proven": (Proven, lambda p, rng: p.search(rng), {}),
    "watched": (Proven, lambda p, rng: p.search(rng), {"transients": True}),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(6))
def test_each_tick_is_answered_as_the_page_says(kind, seed):
    block_class, make, given = KINDS[kind]
    draw = random.Random(f"{kind} {seed}")
    hold, window = draw.choice([(4, 1), (8, 3), (5, 5)])
    settle, floor = draw.choice([1, 12, 20]), draw.choice([None, 0.5])
    threshold, rescan = (0.05, 0.05, 0.2, 0.05, 0.2, 0.0)[seed], draw.choice([0, 150])
    slew, autostart = draw.choice([0.0, 20.0]), seed != 3
    block = ByHand(
        block_class(
            **given, period=0.01, hold_time=0.01 * hold, measure_window=0.01 * window, settle_time=0.01 * settle,
            restart_threshold=threshold, rescan_period=0.01 * rescan, floor=floor, autostart=autostart, max_slew=slew,
        )
    )  # fmt: skip
    block.reset(seed)
    two = block_class is not Optimiser
    account = Account(
        lambda rng: make(block.block.p, rng), block.block.generator(), two, hold=hold, window=window, settle=settle,
        threshold=threshold, rescan=rescan, floor=floor, autostart=autostart, slew=slew * 0.01 or math.inf,
    )  # fmt: skip
    block.reset(seed)
    episode = Episode(f"{kind} {seed}", draw.choice([0.004, 0.02]), floor, threshold)
    command = account.command
    for k in range(400):
        (v, i), down, bad = episode.next(command)
        if bad:
            answer, wanted = block.refused(k * PERIOD), account.refused(k)
        else:
            sample = (v, i) if two else (v * i,)
            buttons = {n: (float(d),) for n, d in zip(("start", "stop", "restart"), down, strict=True)}
            answer = block.update(k * PERIOD, measurement=sample, **buttons)
            wanted = account.tick(k, sample, v * i, down)
        command = answer["command"]
        assert (answer["command"], answer["state"]) == tuple(pytest.approx(w, rel=1e-12) for w in wanted), (
            f"at tick {k}"
        )
    assert set(block.reports) == account.reported


def built(**changes):
    return Optimiser(
        **({"algorithm": "scan", "n_grid": 3, "tolerance": 0.0, "period": 0.01, "hold_time": 0.02} | changes)
    )


@pytest.mark.parametrize(
    ("changes", "refused"),
    [
        ({"hold_time": 0.01}, ""),
        ({"hold_time": 0.009, "measure_window": 0.009}, "hold_time = 0.009 s is shorter than period = 0.01 s"),
        ({"measure_window": 0.02}, ""),
        ({"measure_window": 0.021}, "measure_window = 0.021 s is longer than hold_time = 0.02 s"),
        ({"lower": (0.0, 1.0)}, "2 values of lower for 1 channels"),
        # The initial value is checked by creating the search.
        ({"algorithm": "perturb_observe", "initial": 2.0}, "initial is 2.0, expected it within"),
        ({"upper": (0.0,)}, "lower < upper"),
    ],
)
def test_impossible_times_and_bounds_are_refused(changes, refused):
    if not refused:
        assert built(**changes)
    else:
        with pytest.raises(ValueError, match=refused):
            built(**changes)


@pytest.mark.parametrize(("value", "phase"), [(0.5, SEARCH), (0.5000001, HOLD)])
def test_a_signal_exactly_at_the_floor_is_no_signal(value, phase):
    block = ByHand(built(floor=0.5, measure_window=0.01))
    block.reset(0)
    for k in range(60):
        answer = block.update(k * PERIOD, measurement=(value,), start=None, stop=None, restart=None)
    assert answer["state"][0] == phase


@pytest.mark.parametrize(("value", "restarts"), [(0.5, 0), (0.5000001, 1)])
def test_a_signal_exactly_at_the_floor_is_not_back(value, restarts):
    block = ByHand(built(floor=0.5, measure_window=0.01))
    block.reset(0)
    for k in range(40):
        answer = block.update(k * PERIOD, measurement=(0.0 if k < 20 else value,), start=None, stop=None, restart=None)
    assert answer["state"][3] == restarts
    assert block.x.waiting == (not restarts)


def test_buttons_are_held_and_the_state_names_its_channels():
    (measured, *buttons), (command, state) = Optimiser.ports(built(channels=("a", "b"), lower=(0.1, 0.2),
                                                                    upper=(1.0, 1.0), algorithm="pso").p)  # fmt: skip
    assert [(b.name, b.topic, b.held) for b in buttons] == [
        (name, f"optimiser/{name}", True) for name in ("start", "stop", "restart")
    ]
    assert (measured.topic, command.topic, command.safe, state.topic) == (
        "objective", "command", (0.1, 0.2), "optimiser/state"
    )  # fmt: skip
    about = ("phase", "iteration", "evaluations", "restarts", "best_value", "bound", "best_a", "best_b")
    assert tuple(label.partition("/")[0] for label in state.labels) == about
