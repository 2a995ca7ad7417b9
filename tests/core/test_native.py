"""Native code gives the same as Python: messages, reports, errors, states; and it names what it does not support."""

from __future__ import annotations

import cmath
import inspect
import itertools
import json
import linecache
import math
import os
import random
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from conftest import PATIENCE
from softrig_core import (
    Block,
    BlockParams,
    Level,
    Observer,
    Plant,
    Recording,
    Rig,
    RunError,
    Watch,
    command,
    load_scenario,
    param,
    rig_of,
    scalars,
    simulate,
)
from softrig_core.block.loop import Loop
from softrig_core.kit.jit import our_numba
from softrig_core.native import engine, fitted, translate
from softrig_core.native.compile import plain
from softrig_core.native.engine import Engine, Native
from softrig_core.native.rig_text import rig_text
from softrig_core.native.value import NotNative
from softrig_core.native.words import TEXTS
from softrig_core.run import choice, inprocess
from softrig_power.pv.plant import PvPlant
from softrig_power.pv.ports import array_port
from softrig_power.pv.shading import ShadingSource

# One rig for each kind of block that native code knows, as short as possible.
KNOWN = {"dc_motor_smc": 0.02, "dc_motor_smc_b2": 2.0, "dc_motor_smc_b6_pid": 1.0, "dc_motor_smc_stretch_b": 0.5,
         "induction_dtc": 0.03, "lsrm_fuzzy": 0.01, "lsrm_fuzzy_mrac": 0.01, "lsrm_fuzzy_b5": 0.01,
         "manipulator_adsmc": 0.2, "manipulator_adsmc_s3": 0.1, "pv_mppt_certified": 0.2}  # fmt: skip


@pytest.fixture(autouse=True)
def _no_text_in_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a text that other tests have evicted from the cache again."""
    monkeypatch.setattr(fitted, "_counts", {})
    monkeypatch.setattr(choice, "_spent", {})


def ran(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, make: Any = None, timed: bool = False
) -> tuple[Recording, Any, str, Native]:
    """Run a rig in Python, or with the text that `make` returns; return messages, steps, error and which ticks were
    native.
    """
    engines: list[Engine] = []

    def build(steps: Any, *options: Any) -> Engine:
        engines.append(Engine(steps, make))
        return engines[-1]

    monkeypatch.setattr(choice, "cost", lambda steps: None if timed else 0.0)
    monkeypatch.setattr(choice, "writes", lambda steps, left: False)
    monkeypatch.setattr(choice, "unwanted", lambda steps, left, runs: "" if make else "a test")
    monkeypatch.setattr(choice, "Engine", build)
    monkeypatch.setattr(choice, "gather", lambda step, ticks: None)  # the compared Python run executes tick by tick
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    steps, error = {}, ""
    try:
        steps = inprocess.run_inprocess(rig, rig.scenario.seed, recording)
    except RunError as broken:
        error = str(broken)
    return recording, steps, error, engines[0].native if engines else Native()


def the_same(rig: Any, monkeypatch: pytest.MonkeyPatch, make: Any = plain) -> Native:
    """Compare two runs."""
    wanted, steps, error, _ = ran(rig(), monkeypatch)
    result, others, other_error, native = ran(rig(), monkeypatch, make)
    assert other_error == error
    assert result.topics == wanted.topics
    for name, step in steps.items():
        other = others[name]
        assert repr(other.x) == repr(step.x) or other.x == step.x
        assert (other.reports, other.t, repr(other.values), repr(other.last_answer), other.published_at) == (
            step.reports,
            step.t,
            repr(step.values),
            repr(step.last_answer),
            step.published_at,
        )
    return native


@pytest.mark.parametrize("name", KNOWN)
def test_scenarios_are_the_same_as_in_python(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    native = the_same(lambda: rig_of(name, duration=KNOWN[name]), monkeypatch)
    assert native.members
    assert native.ticks > native.given_up


def test_numba_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    native = the_same(lambda: rig_of("dc_motor_smc_c1", duration=1.0), monkeypatch, engine.compiled)
    assert native.ticks == 99


@pytest.mark.parametrize(
    ("name", "node", "positions"),
    [
        ("manipulator_adsmc", "trajectory_source", [0.001, 0.002, 0.003]),
        ("rehab_impedance", "prom_reference", [-0.519, -1.57]),
    ],
)
def test_a_reference_with_a_trajectory_is_native_to_its_end(
    name: str, node: str, positions: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Whether a change is worth a new compilation would depend on the earlier rigs of this process.
    monkeypatch.setattr(fitted, "_worth_another", lambda kinds: True)
    goal = {"start": 0.01, "times": [0.0, 0.02, 0.03], "positions": positions * 3}
    changes = [{"at": 0.01, "set": {f"{node}.goal.{key}": value for key, value in goal.items()}}]
    file = tmp_path / "points.yaml"
    file.write_text(json.dumps({"extends": name, "duration": 0.06, "changes": changes, "expect": {}}))
    native = the_same(lambda: rig_of(str(file)), monkeypatch)
    assert native.given_up < 10 < native.ticks


def test_figures_of_many_runs_equal_those_of_single_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit, and no run affects the next."""
    monkeypatch.setattr(fitted, "_texts", [])
    monkeypatch.setattr(choice, "cost", lambda steps: 1e-5)
    variants = [{"dc_motor_plant.J": inertia} for inertia in (3e-4, 4e-4, 5e-4, 3e-4)]
    single, many = (
        [simulate("dc_motor_smc_c1", duration=20.0, overrides=v, runs=n) for v in variants] for n in (1, 10**6)
    )
    for one, other in zip(single, many, strict=True):
        ticks = [run.blocks["dc_motor_plant"].native[0] for run in (one, other)]  # type: ignore[attr-defined]
        assert ticks == [0, 1999]
        assert repr([r.number for r in other.results]) == repr([r.number for r in one.results])
        assert other.recording.topics == one.recording.topics


SIGNAL = scalars("signal", "signal", {"x": "", "y": ""})
PUSH = scalars("push", "push", {"u": ""})


class Turning(NamedTuple):
    """Two numbers, and a count."""

    a: float = 1.0
    b: float = 0.5
    k: int = 0


class OscillatorParams(BlockParams):
    """Parameters of the oscillator."""

    period: float = param(0.001, "period", "s", gt=0.0)
    rate: float = param(0.25, "turn a tick", live=True)
    growth: float = param(1.0, "factor a tick", live=True)


class Oscillator(Plant[OscillatorParams]):
    """A growing rotation, written with constructs that are easily misread."""

    INPUTS = (PUSH,)
    OUTPUTS = (SIGNAL,)

    def setup(self) -> None:
        """Set constants."""
        self._turn = (self.p.rate, -self.p.rate)

    def first(self) -> Turning:
        """Begin."""
        return Turning()

    def outputs(self, x: Turning, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give both."""
        a, b = x.a, x.b
        a, b = b, a  # reads both names before it writes them
        x = x._replace(a=a)
        return {"signal": (b, x.a)}

    def advance(self, x: Turning, t: int, *, push: tuple[float, ...]) -> Turning:
        """Turn."""
        a, b, k = x
        both = (a, b)
        both = tuple(a + rate * part for a, rate, part in zip(both, self._turn, (b, a), strict=True))
        for part in both:
            both = (both[0], both[1] + 0.0 * part)  # uses the value of the pass before
        left = 3
        while left > 0:
            left -= 1
            if left == 1 and k % 7 == 3:
                continue
            a = a * 0.5
        if k % 50 == 49:
            self.report(Level.WARN, "fifty", "ticks" + " without their number")
        if k % 7 == 6:
            self.report(Level.WARN, "seven", f"{k} ticks, {both} and {x!r}, {a:.3g} of {self.p.growth:g}, {k > 300}")
            if k % 3 == 0:
                self.report(Level.ERROR, "seven", "by three, too")
        elif k % 5 == 2:
            self.report(Level.WARN, "five", f"{t}")
        return Turning(both[0] * self.p.growth + 1e-3 * push[0] + 0.0 * a, both[1] * self.p.growth, k + 1)


class Pushing(NamedTuple):
    """Newest value; None before the first."""

    last: float | None = None


def limited(x: float, least: float = -3.0, most: float = 3.0) -> float:
    """Return a value limited to 1."""
    return min(max(x, least), most)


class Pusher(Block[OscillatorParams]):
    """Publishes a force against the motion at every other tick."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (PUSH,)

    def first(self) -> Pushing:
        """Nothing yet."""
        return Pushing()

    def update(self, x: Pushing, t: int, *, signal: tuple[float, ...]) -> tuple[Pushing, Mapping[str, Any]]:
        """Answer."""
        last = signal[0] if x.last is None else x.last
        u = 1.0 / (signal[0] - last) if t % 40_000_000 == 0 and signal[0] != last else (signal[1] or 1.0) ** 3
        most = {"most": 0.05}
        return Pushing(signal[0]), {"push": (limited(u, least=-1.0, **most),)}


class Watcher(Observer[OscillatorParams]):
    """Counts, and fails at a given tick."""

    INPUTS = (SIGNAL,)
    FAILS = 10**18

    def first(self) -> tuple[int, ...]:
        """Nothing seen."""
        return (0,)

    def update(self, x: Any, t: int, *, signal: tuple[float, ...]) -> tuple[Any, Mapping[str, Any]]:
        """Count."""
        if t >= self.FAILS:
            raise ValueError(f"seen {x[0]}")
        return (x[0] + (signal[0] > 0.0),), {}

    def status(self, x: Any) -> Mapping[str, tuple[float, str]]:
        """Report the count."""
        return {"seen": (float(x[0]), "")}


def rig(
    duration: float = 0.5, watcher: type[Watcher] = Watcher, changes: Any = (), other: Any = None, **values: float
) -> Rig:
    blocks = {"plant": Oscillator(**values), "law": Pusher(period=0.002), "watcher": watcher()}
    blocks |= {"other": other} if other else {}
    return Rig.from_blocks(blocks, duration, changes=list(changes))


class Large(Block[OscillatorParams]):
    """Reports integers that no float represents."""

    INPUTS = (SIGNAL,)

    def first(self) -> Pushing:
        """Nothing."""
        return Pushing()

    def update(self, x: Pushing, t: int, *, signal: tuple[float, ...]) -> tuple[Pushing, Mapping[str, Any]]:
        """Report every third."""
        if t % 3_000_000 == 0:
            self.report(Level.WARN, "large", f"{t + 2**53 + 1}")
        return x, {}


def test_integers_that_no_float_represents_are_reported_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    native = the_same(lambda: rig(0.1, other=Large()), monkeypatch)
    assert "other" in native.members
    assert native.given_up > 30


def test_a_report_with_a_computed_text_leaves_the_tick_to_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """10 of 500 ticks."""
    assert the_same(rig, monkeypatch).given_up == 10


def test_steps_record_which_ticks_were_native_and_why_others_were_not(monkeypatch: pytest.MonkeyPatch) -> None:
    # `lambda` instead of `plain` selects numpy tables, as compiled code has.
    steps = ran(rig(), monkeypatch, lambda text: plain(text))[1]
    assert {name: step.native for name, step in steps.items()} == {
        "plant": (489, "10 of its ticks were given up"),
        "law": (249, "10 of its ticks were given up"),
        "watcher": (0, "it watches what is recorded"),
    }
    assert {step.native for step in ran(rig(), monkeypatch, plain)[1].values()} == {(0, "")}


@pytest.mark.parametrize("numba", [False, pytest.param(True, marks=pytest.mark.long)])
def test_functions_that_native_code_rewrites_have_the_bits_of_pythons(numba: bool) -> None:
    scope: dict[str, Any] = {"math": math, "array_floor": np.floor}
    for name in ("abs_", "phase", "rect", "remainder", "fmod", "whole_"):
        exec(TEXTS[name], scope)
        scope[name] = our_numba().njit(error_model="python")(scope[name]) if numba else scope[name]

    def reported(function: Any, *values: Any) -> Any:
        try:
            return repr(function(*values))
        except (ArithmeticError, ValueError):
            return "raises"

    numbers = [0.0, -0.0, math.pi, -math.pi, math.tau, 0.5 * math.tau, 1.5 * math.tau, 1e300, -3e-310]
    rng = random.Random(1)
    numbers += [rng.gauss(0.0, 1.0) * 10.0 ** rng.randint(-9, 9) for _ in range(30)]
    for x in numbers:
        assert abs(x) > 4e18 or repr(float(scope["whole_"](x))) == repr(float(math.floor(x)))
    for x, y in itertools.product(numbers, numbers):
        assert reported(scope["abs_"], complex(x, y)) == reported(abs, complex(x, y))
        assert reported(scope["phase"], complex(x, y)) == reported(cmath.phase, complex(x, y))
        for name, own in {"rect": cmath.rect, "remainder": math.remainder, "fmod": math.fmod}.items():
            assert reported(scope[name], x, y) == reported(own, x, y), (name, x, y)


def test_the_reason_why_native_code_does_not_pay_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = core(rig())
    monkeypatch.setattr(fitted, "_texts", [])
    assert choice.unwanted(steps, 5.9) == choice.SHORT
    assert choice.unwanted(steps, 6.1) == choice.unwanted(steps, 0.061, 100) == ""
    assert choice.unwanted(steps, 0.0009, 1000) == choice.SHORT
    assert choice.unwanted(steps, 0.0009, 10**4) == ""
    with monkeypatch.context() as patch:
        patch.setattr(choice, "known", lambda kinds, make: make is engine.compiled)
        assert choice.unwanted(steps, 0.009) == choice.SHORT
        assert choice.unwanted(steps, 0.011) == choice.unwanted(steps, 0.0009, 12) == ""
    assert choice.writes(steps, 0.2)
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    assert not choice.writes(steps, 0.2)
    assert choice.unwanted(steps, 6.1) == "SOFTRIG_JIT=0"


class Ticking:
    """A clock on which each call takes a fixed time, and the first tick some seconds."""

    def __init__(self, tick: float) -> None:
        self.tick, self.now, self.looks = tick, 0.0, 0

    def __call__(self) -> float:
        self.looks += 1
        self.now += 5.0 if self.looks == 2 else self.tick
        return self.now


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize(
    ("left", "runs", "way"),
    [(0.1, 1, None), (0.1, 50, None), (0.2, 1, plain), (5.9, 1, plain), (6.1, 1, engine.compiled)]
    + [(0.1, 70, engine.compiled), (0.009, 600, None), (0.009, 700, engine.compiled)],
)
def test_the_remaining_time_decides_how_a_run_continues(left, runs, way, timed, monkeypatch):
    """The cost of a tick is measured in the first ones, by a clock of the test, or known; the messages are the same."""
    with monkeypatch.context() as usual:
        wanted = ran(rig(), usual)[0]
    made: list[Any] = []
    monkeypatch.setattr(fitted, "_texts", [])
    monkeypatch.setattr(choice, "Engine", lambda steps, make, alone: made.append(make) or Engine(steps, plain))
    clock = Ticking(left / ((500 - 64) if timed else 501))
    monkeypatch.setattr(choice.time, "thread_time", clock)
    classes = (Oscillator, Pusher, Watcher) if runs == 1 else (Oscillator, Pusher)
    monkeypatch.setattr(choice, "_costs", {} if timed else {classes: clock.tick})
    recording = Recording((topic, port.msgtype) for topic, port in rig().topics.items())
    inprocess.run_inprocess(rig(), rig().scenario.seed, recording, runs=runs)
    assert made == ([way] if way else [])
    assert choice._costs == {classes: pytest.approx(clock.tick)}
    assert clock.looks == (130 if timed else 0)
    assert recording.topics == wanted.topics


def test_repeated_short_runs_use_a_text_that_python_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once as much time has been spent on them as the text takes to write, unless there is no such text."""
    monkeypatch.setattr(choice, "_costs", {(Oscillator, Pusher, Watcher): 0.1 / 501})
    monkeypatch.setattr(fitted, "_texts", [])
    made: list[Any] = []
    monkeypatch.setattr(choice, "Engine", lambda steps, make, alone: made.append(make) or Engine(steps, make))
    for count in (0, 1, 2):
        inprocess.run_inprocess(rig(), 0)
        assert made == [plain] * count
    monkeypatch.setattr(fitted, "_texts", [])

    def none(*value: Any) -> Any:
        raise NotNative("a test")

    monkeypatch.setattr(fitted, "rig_text", none)
    for _ in range(2):
        inprocess.run_inprocess(rig(), 0)
        assert made == [plain] * 3


def test_changes_during_a_run_are_the_same_as_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    changes = [{"at": 0.1005, "set": {"plant.rate": 0.1}}, {"at": 0.2, "set": {"law.rate": 1.0}}]
    native = the_same(lambda: rig(changes=changes), monkeypatch)
    assert native.ticks > 450


class Failing(Watcher):
    FAILS = 123_000_000


class AtOnce(Watcher):
    """Receives columns of many ticks."""

    in_batches = True

    def at_once(self, x: Any, t: int, messages: Mapping[str, Any]) -> Any:
        """Count."""
        return (x[0] + sum(values[0] > 0.0 for _, values in messages["signal"]),)


@pytest.mark.parametrize(
    "faults",
    [
        {
            "noisy": ("motor/state", {"kind": "noise", "value": [0.01]}),
            "lost": ("motor/command", {"kind": "loss", "probability": 0.3}),
            "late": ("motor/reference", {"kind": "delay", "delay": 0.03, "jitter": 0.02}),
        },
        {"spoilt": ("motor/state", {"kind": "invalid", "probability": 0.02})},
    ],
)
def test_silent_late_and_faulty_links_are_the_same_as_in_python(faults, monkeypatch):
    results = {name: {"link": link, "from": 0.2, "to": 1.5, **how} for name, (link, how) in faults.items()}
    case = load_scenario("dc_motor_smc_b2").having(duration=2.0, faults=results)
    for make in (plain, lambda text: plain(text)):  # the code as Python runs it, and as numba gets it
        native = the_same(lambda: rig_of(case), monkeypatch, make)
        assert native.ticks > 190
        assert set(faults) < set(native.members)


def test_rarely_due_nodes_stay_in_python(monkeypatch):
    native = the_same(lambda: rig_of("manipulator_adsmc_two_link", duration=0.1), monkeypatch)
    # Of 100 ticks, five belong to a node that is due at each twentieth one, so they run in Python.
    assert (native.ticks, native.given_up) == (95, 0)
    assert "robot_dynamics" not in native.members


class SeldomParams(BlockParams):
    """Of a test."""

    period: float = param(0.02, "period", "s", gt=0.0)


class Seldom(Block[SeldomParams]):
    """A rarely due block without native code; its output may be bad, and is bad at the end."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (replace(PUSH, unchecked=True),)

    def update(self, x: tuple[()], t: int, *, signal: tuple[float, ...]) -> tuple[tuple[()], Mapping[str, Any]]:
        """Push."""
        return x, {"push": (float(f"{signal[0]:.2f}") if t < 100_000_000 else math.nan,)}


class Noting(Seldom):
    """The same, and remembers it."""

    OUTPUTS = ()

    def first(self) -> float:
        """Nothing yet."""
        return 0.0

    def update(self, x: float, t: int, *, signal: tuple[float, ...]) -> tuple[float, Mapping[str, Any]]:
        """Keep it."""
        return float(f"{signal[0]:.2f}"), {}


def test_a_native_node_checks_the_output_of_one_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = {"plant": Oscillator, "law": Seldom}
    native = the_same(lambda: Rig.from_blocks({n: b() for n, b in blocks.items()}, 0.5), monkeypatch)
    assert (native.members, native.ticks > 90) == (("plant",), True)


class Chooser(Block[OscillatorParams]):
    """Chooses again at each twentieth tick, by code that cannot be compiled, and fails at a given one."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (PUSH,)
    FAILS = 10**18

    def first(self) -> float:
        """Nothing chosen."""
        return 0.0

    def decides(self, x: float, t: int) -> bool:
        """Select each twentieth tick."""
        return t % 20_000_000 == 0

    def update(self, x: float, t: int, *, signal: tuple[float, ...]) -> tuple[float, Mapping[str, Any]]:
        """Push as chosen."""
        if t % 20_000_000 == 0:
            x = float(f"{signal[0]:.2f}")
        if t >= self.FAILS:
            raise ValueError("a choice")
        return x, {"push": (0.5 * x,)}


@pytest.mark.parametrize(
    ("fails", "decided", "given_up"), [(10**18, 24, 10), (400_000_000, 20, 8), (405_000_000, 20, 9)]
)
@pytest.mark.parametrize("watcher", [AtOnce, Watcher, Noting])
def test_ticks_that_a_block_decides_run_in_python(watcher, fails, decided, given_up, monkeypatch):
    """Whether observers get the results immediately after them or at each tick, and if another block has ticks in
    Python anyway.

    A run that breaks there says the same.
    """
    monkeypatch.setattr(Chooser, "FAILS", fails)
    blocks = {"plant": Oscillator, "law": Chooser, "watcher": watcher}

    def made() -> Rig:
        return Rig.from_blocks({name: block() for name, block in blocks.items()}, 0.5)

    native = the_same(made, monkeypatch, lambda text: plain(text))
    assert (native.decided, native.given_up) == (decided, given_up)
    assert native.ticks > 360


def test_messages_of_a_decided_tick_are_delivered_after_earlier_ones(monkeypatch):
    fault = {"link": "converter/duty", "from": 0.05, "kind": "offset", "value": [0.1]}
    case = load_scenario("pv_mppt_certified").having(duration=0.15, faults={"fault": fault})
    assert the_same(lambda: rig_of(case), monkeypatch, lambda text: plain(text)).decided == 3


class ClimbParams(BlockParams):
    """Parameters of the climb."""

    period: float = param(0.001, "period", "s", gt=0.0)


class Climb(Block[ClimbParams]):
    """A duty that turns back when the power falls."""

    INPUTS = (array_port("port"),)
    OUTPUTS = (command("duty", "converter/duty", ("duty",), "1"),)

    def first(self) -> tuple[float, float, float]:
        """Duty, its change, power."""
        return 0.4, 0.001, 0.0

    def update(self, x: Any, t: int, *, port: tuple[float, ...]) -> Any:
        """Go on, or back."""
        duty, change, before = x
        power = port[0] * port[1]
        change = change if power >= before else -change
        duty = min(max(duty + change, 0.2), 0.8)
        return (duty, change, power), {"duty": (duty,)}


def test_a_block_recreated_at_some_ticks_is_a_constant_between_them(monkeypatch):
    """A photovoltaic string in changing weather: its characteristic is a constant until it changes."""
    weather = ShadingSource(times=(0.0, 0.1), irradiance=(1000.0,) * 4 + (500.0,) * 4)
    blocks = {"plant": PvPlant(), "weather": weather, "law": Climb()}
    native = the_same(lambda: Rig.from_blocks(blocks, 0.2), monkeypatch)
    assert (native.ticks, native.given_up) == (198, 1)


@pytest.mark.parametrize("how", [{"growth": 1.05}, {"watcher": Failing}, {"watcher": Failing, "other": AtOnce()}])
def test_a_run_that_breaks_reports_the_same_as_in_python(how: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    native = the_same(lambda: rig(**how), monkeypatch)
    assert native.ticks > 100
    assert ran(rig(**how), monkeypatch, plain)[2]


def core(made: Rig) -> list[Any]:
    """Return the steps of plants and controllers after a tick."""
    blocks = {m.name: m.block(1) for m in made.members}
    steps = inprocess.wired(made, {name: b for name, b in blocks.items() if not isinstance(b, Observer)})
    result = list(steps.values())
    next(iter(Loop(result).run()))
    return result


def test_variants_share_a_text_and_other_rigs_do_not() -> None:
    first, second = core(rig()), core(rig(rate=0.125, growth=0.5))
    program = rig_text(first, []).program
    assert program.differs([s.block for s in second]) == ""
    assert program.constants([s.block for s in first]) != program.constants([s.block for s in second])
    other = [Watcher(), *(s.block for s in second[1:])]
    assert program.differs(other)


@pytest.mark.parametrize(("name", "called"), [("induction_dtc", 0), ("manipulator_adsmc", 1)])
def test_the_text_contains_what_a_short_casadi_function_of_arithmetic_computes(
    name: str, called: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = rig_text(core(rig_of(name)), [])
    assert [len(text.program.scratches) > 0, "ctypes" in text.text] == [called, called]
    monkeypatch.setattr(translate, "FORMULA", 100)
    assert "ctypes" in rig_text(core(rig_of(name)), []).text
    assert "ctypes" in rig_text(core(rig_of(name)), [], typed=False).text  # Python calls both


def test_other_equations_make_another_text() -> None:
    """Their constants are in the text, or in the C code that it calls."""
    program = rig_text(core(rig_of("optimal_control_mvim_a4")), []).program
    assert program.differs([s.block for s in core(rig_of("optimal_control_mvim_a4"))]) == ""
    assert program.differs([s.block for s in core(rig_of("optimal_control_mvim_a4_inertia"))])


class Texts(Pusher):
    """Formats a text at each tick, in two branches."""

    def update(self, x: Pushing, t: int, *, signal: tuple[float, ...]) -> tuple[Pushing, Mapping[str, Any]]:
        """Answer."""
        sign = -1.0
        if signal[0] > 0.0:
            sign = 1.0
        return x, {"push": (sign * len(str(signal[0])),)}


def test_unsupported_constructs_are_named() -> None:
    blocks = {"plant": Oscillator(), "law": Texts()}
    with pytest.raises(NotNative, match=r"test_native\.Texts\.update, line \d+: str"):
        rig_text(core(Rig.from_blocks(blocks, 0.1)), [])


def test_a_debugger_shows_the_text_of_a_rig() -> None:
    function = plain(rig_text(core(rig()), []))
    code, shown = function.__code__, inspect.getsource(function)
    assert shown.startswith("def rig(first, last, n, c, s")
    assert linecache.getline(code.co_filename, code.co_firstlineno) == shown.splitlines(keepends=True)[0]


def test_a_rig_that_often_discards_ticks_stays_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "PATIENCE", 3)
    monkeypatch.setattr(engine, "SELDOM", 100)
    native = the_same(rig, monkeypatch)
    assert native.given_up == 4
    assert native.reason == "many ticks are discarded"


@pytest.mark.long
@pytest.mark.parametrize("name", KNOWN)
def test_scenarios_are_the_same_by_numba(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    the_same(lambda: rig_of(name, duration=KNOWN[name]), monkeypatch, engine.compiled)


TWICE = """
from softrig_core import simulate
from softrig_core.native import fitted
for name in ("dc_motor_smc", "dc_motor_smc_b6_pid"):  # two texts whose functions have the same names
    done = simulate(name, duration=0.2, runs=10000)
    found = fitted._texts[0].function.stats
    print(name, sum(found.cache_hits.values()), [r.number for r in done.results])
"""


@pytest.mark.long
def test_another_process_takes_native_code_from_the_cache(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}

    def run() -> list[str]:
        command = [sys.executable, "-c", TWICE]
        return subprocess.check_output(command, env=environment, text=True, timeout=PATIENCE).splitlines()

    first, second = run(), run()
    assert [line.split()[1] for line in first + second] == ["0", "0", "1", "1"]
    assert [line.split(" ", 2)[2] for line in first] == [line.split(" ", 2)[2] for line in second]


@pytest.mark.parametrize(
    ("window", "period", "asked"),
    [
        (0.15, 1e-4, 2),  # the window drops messages one by one
        (0.15, 5e-4, 2),  # the period is longer than that of the messages, so some are missed
        (0.02, 1e-4, 2),  # the window is shorter than the gap between two messages of the reference
        (60.0, 1e-4, 2),
    ],
)
def test_an_observer_that_gets_columns_gets_what_it_would_have_seen(window, period, asked, monkeypatch):
    calls: list[int] = []

    def counted(self, x, t, *, update=Watch.update, **inputs):
        calls.append(t)
        return update(self, x, t, **inputs)

    monkeypatch.setattr(Watch, "update", counted)
    about = {"dc_motor_metrics.window": window, "dc_motor_metrics.period": period}
    native = the_same(lambda: rig_of("dc_motor_smc", duration=0.3, overrides=about), monkeypatch)
    assert native.ticks == 2999
    assert len(calls) == round(0.3 / period) + 1 + asked


def test_a_run_that_has_begun_in_python_continues_natively(monkeypatch):
    """Also one whose blocks decide some ticks, whose messages are then delivered later."""
    monkeypatch.setattr(choice, "_costs", {})
    wanted, result = (
        ran(rig_of("pv_mppt_certified", duration=0.2), monkeypatch, make, timed=True)
        for make in (None, lambda text: plain(text))
    )
    assert result[0].topics == wanted[0].topics
    assert result[3].ticks > 100
    assert result[3].decided
