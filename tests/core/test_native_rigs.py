"""Small rigs as native code and in Python, which give the same: nodes that publish at each tick or not, late, with
checks, rarely due, with ticks in Python, with reports, in each order; and the same rigs as batches of instances.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from conftest import few
from softrig_core import Block, BlockParams, Level, Observer, Plant, Rig, RigEnv, command, param, scalars
from softrig_core.block.loop import Loop
from softrig_core.block.port import Sample
from softrig_core.kit.draws import Draws
from softrig_core.native import fitted
from softrig_core.native.batch_text import Form, batch_text, remembered
from softrig_core.native.compile import plain
from softrig_core.native.rig_text import rig_text
from softrig_core.native.value import NotNative
from softrig_core.run import inprocess
from test_native import the_same

gymnasium = pytest.importorskip("gymnasium")
RigVectorEnv = pytest.importorskip("softrig_core.analysis.environments").RigVectorEnv

SIGNAL = scalars("signal", "signal", {"x": "m", "y": ""})
PUSH = command("push", "push", ("u",), "N")
LATE = replace(SIGNAL, name="late", topic="late", delayed=True)
SPORADIC = replace(PUSH, sporadic=True)
WIDE = scalars("wide", "wide", dict.fromkeys("abc", ""))


class Params(BlockParams):
    """Parameters of all blocks."""

    period: float = param(0.001, "period", "s", gt=0.0)
    rate: float = param(0.25, "a rate", live=True)


class State(NamedTuple):
    """The state of the plant."""

    x: float = 1.0
    k: int = 0


class Body(Plant[Params]):
    """Moves by the commands."""

    INPUTS = (PUSH,)
    OUTPUTS = (SIGNAL,)

    def first(self) -> State:
        """Begin."""
        return State()

    def outputs(self, x: State, t: int) -> Mapping[str, tuple[float, ...]]:
        """Publish the position."""
        return {"signal": (x.x, 0.5)}

    def advance(self, x: State, t: int, *, push: tuple[float, ...]) -> State:
        """Move."""
        return State(x.x + self.p.rate * push[0], x.k + 1)


class Telling(Body):
    """A body that reports a text."""

    def advance(self, x: State, t: int, *, push: tuple[float, ...]) -> State:
        """Move."""
        if x.k == 7:
            self.report(Level.WARN, "seven", f"{x.x:g}")
        return State(x.x, x.k + 1)


class Law(Block[Params]):
    """A law whose force is opposite to the displacement."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (PUSH,)

    def first(self) -> float:
        """Remember the last command."""
        return 0.0

    def update(self, x: float, t: int, *, signal: tuple[float, ...]) -> tuple[float, Mapping[str, Any]]:
        """Answer."""
        return -signal[0], {"push": (x - signal[1],)}


class Deciding(Law):
    """A law that is not native at some ticks, so Python runs them."""

    def decides(self, x: float, t: int) -> bool:
        """Select the ticks at which it has moved far."""
        return x > 2.0


class Sensor(Block[Params]):
    """Publishes its measurement later."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (LATE,)

    def update(self, x: tuple[()], t: int, *, signal: tuple[float, ...]) -> tuple[tuple[()], Mapping[str, Any]]:
        """Answer."""
        return x, {"late": Sample(t - 1_000_000, signal)}


class Talker(Block[Params]):
    """Publishes at some ticks only."""

    INPUTS = (LATE,)
    OUTPUTS = (SPORADIC,)

    def update(self, x: tuple[()], t: int, *, late: Sample) -> tuple[tuple[()], Mapping[str, Any]]:
        """Answer at some ticks."""
        if late.stamp > 3_000_000:
            return x, {"push": (-late.data[0],)}
        return x, {}


class Both(Block[Params]):
    """Publishes one of two topics at a tick, and two others late."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (
        replace(PUSH, name="one", topic="one", sporadic=True),
        replace(SIGNAL, name="old", topic="old", delayed=True),
        replace(PUSH, name="two", topic="two", sporadic=True),
        replace(SIGNAL, name="older", topic="older", delayed=True),
    )

    def update(self, x: tuple[()], t: int, *, signal: tuple[float, ...]) -> tuple[tuple[()], Mapping[str, Any]]:
        """Answer."""
        old, older = Sample(t - 1, signal), Sample(t - 2, signal)
        if signal[0] > 0.0:
            return x, {"one": (1.0,), "old": old, "older": older}
        return x, {"two": (2.0,), "old": old, "older": older}


class Saying(Block[Params]):
    """Publishes a message at some ticks, and its state at others."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (SPORADIC.renamed("said"), replace(WIDE, name="often", topic="often"))

    def first(self) -> int:
        """Counts."""
        return 0

    def update(self, x: int, t: int, *, signal: tuple[float, ...]) -> tuple[int, Mapping[str, Any]]:
        """Answer."""
        often = (signal[0], float(x), 1.0)
        if x % 3 == 1:
            return x + 1, {"push": (float(x),), "often": often}
        return x + 1, {"often": often}


class Aging(Block[Params]):
    """Publishes the age of its input."""

    INPUTS = (SIGNAL, WIDE)
    OUTPUTS = (replace(PUSH, name="pull", topic="pull"),)

    def update(self, x: tuple[()], t: int, *, signal: Any, wide: Any) -> tuple[tuple[()], Mapping[str, Any]]:
        """Answer."""
        return x, {"pull": (signal[0] + self.age("signal"),)}


class Hearing(Block[Params]):
    """Reads all messages, and stamps those that have none."""

    INPUTS = (*Both.OUTPUTS, replace(SIGNAL, name="signal", delayed=True))

    def update(self, x: tuple[()], t: int, **inputs: Any) -> tuple[tuple[()], Mapping[str, Any]]:
        """Nothing."""
        if inputs["signal"].stamp + inputs["old"].stamp > inputs["older"].stamp + inputs["one"][0] + inputs["two"][0]:
            return x, {}
        return (), {}


class Asking(Body):
    """Asks for the age of its input."""

    INPUTS = (SPORADIC,)

    def advance(self, x: State, t: int, *, push: tuple[float, ...]) -> State:
        """Move once a message has arrived."""
        if self.age("push") is None:
            return x
        return State(x.x + 1e-9 * self.age("push") * push[0], x.k)


class Spoiling(Law):
    """May publish a value that every subscriber rejects."""

    OUTPUTS = (replace(PUSH, unchecked=True),)


class Wide(Plant[Params]):
    """Publishes more numbers than are squared one by one."""

    OUTPUTS = (WIDE,)

    def first(self) -> tuple[float, ...]:
        """Begin."""
        return (1.0, 2.0, 3.0)

    def outputs(self, x: tuple[float, ...], t: int) -> Mapping[str, tuple[float, ...]]:
        """Publish everything."""
        return {"wide": x}

    def advance(self, x: tuple[float, ...], t: int) -> tuple[float, ...]:
        """Turn."""
        return (x[1], x[2], x[0] + 1e-9 * t)


class Short(Law):
    """Publishes fewer numbers than its port has."""

    def update(self, x: float, t: int, *, signal: tuple[float, ...]) -> tuple[float, Mapping[str, Any]]:
        """Answer."""
        return x, {"push": () if x > 9.0 else (1.0,)}


class More(Block[Params]):
    """Reads two messages."""

    INPUTS = (SIGNAL, WIDE)
    OUTPUTS = (replace(PUSH, name="pull", topic="pull"),)

    def first(self) -> tuple[()]:
        """Remembers nothing."""
        return ()

    def update(self, x: tuple[()], t: int, *, signal: Any, wide: Any) -> tuple[tuple[()], Mapping[str, Any]]:
        """Answer."""
        return x, {"pull": (signal[0] + wide[2],)}


def hard(**periods: float) -> dict[str, Any]:
    kinds = {"body": Asking, "sensor": Sensor, "talker": Talker}
    return {name: kind(period=periods.get(name, 0.001)) for name, kind in kinds.items()}


class Several(NamedTuple):
    """Everything that a state may consist of."""

    a: float = 0.5
    k: int = 3
    on: bool = True
    z: complex = 1.0 - 2.0j
    pair: tuple[float, int] = (2.0, 4)
    none: None = None


class Shaken(Body):
    """Moved by random numbers."""

    def setup(self) -> None:
        """Draw."""
        self.draws = Draws((1,), "random")

    def first(self) -> Several:
        """Begin."""
        return Several()

    def outputs(self, x: Several, t: int) -> Mapping[str, tuple[float, ...]]:
        """Publish the position."""
        return {"signal": (x.a, x.pair[0])}

    def advance(self, x: Several, t: int, *, push: tuple[float, ...]) -> Several:
        """Move."""
        return x._replace(a=x.a + push[0] + self.draws(x.k), k=x.k + 1)


BATCHES: dict[str, tuple[Any, str, str]] = {  # blocks, the agent, and why the batch is not native
    "an agent in the place of the law": (lambda: {"body": Body(), "law": Law()}, "law", ""),
    "an agent at each third tick": (lambda: {"body": Shaken(), "law": Law(period=0.003)}, "law", ""),
    "a watcher is the quickest": (
        lambda: {"body": Body(period=0.002), "law": Law(period=0.004), "wide": Wide()},
        "law",
        "",
    ),
    "an agent beside a law": (
        lambda: {"body": Body(), "law": Law(period=0.002), "wide": Wide(period=0.002), "more": More(period=0.004)},
        "more",
        "",
    ),
    "one asks for an age": (
        lambda: {"body": Body(), "law": Law(), "wide": Wide(), "aging": Aging(period=0.002)},
        "law",
        "",
    ),
    "one asks for an age that changes": (
        lambda: {"body": Body(period=0.002), "law": Law(period=0.002), "wide": Wide(), "aging": Aging()},
        "law",
        "age",
    ),
    "silent": (hard, "sensor", "it does not publish at each tick"),
}


@pytest.mark.parametrize("name", BATCHES)
def test_instances_of_a_batch_equal_single_ones(name: str) -> None:
    blocks, agent, why = BATCHES[name]
    keys = {"what": Rig.from_blocks(blocks(), 0.05), "replace": agent, "reward": lambda now: 0.0}
    one = gymnasium.vector.SyncVectorEnv([lambda: RigEnv(**keys)] * 2)
    many = RigVectorEnv(**keys, num_envs=2)
    draws = np.random.default_rng(1)
    pairs = [(many.reset(seed=5), one.reset(seed=5))]
    for _ in range(30):
        actions = draws.uniform(-2.0, 2.0, many.action_space.shape)
        pairs.append((many.step(actions), one.step(actions)))
    for result, wanted in pairs:
        assert [x.tobytes() for x in result[:-1]] == [y.tobytes() for y in wanted[:-1]]
    assert (many.native > 0) == (not why), (many.native, many.reason)
    assert why in many.reason


def test_a_value_that_is_not_a_number_is_refused_in_a_row() -> None:
    with pytest.raises(NotNative, match="str in a state: an instance is a row of numbers"):
        Form((1.0, ("up",)))


def stepped(blocks: dict[str, Any], native: str = "", ticks: int = 2, duration: float = 0.1) -> list[Any]:
    """Return the native steps of a rig after some ticks."""
    made = Rig.from_blocks(blocks, duration)
    steps = inprocess.wired(made, blocks)
    going = iter(Loop(list(steps.values())).run())
    for _ in range(ticks):
        next(going)
    return [s for name, s in steps.items() if name in (native.split() or steps)]


def why_not(make: Any, *how: Any) -> str:
    """Return why there is no text of a rig; empty if there is one."""
    try:
        make(*how)
    except NotNative as reason:
        return re.sub(r"line \d+: ", "", str(reason))
    return ""


@pytest.mark.parametrize(("ticks", "refused"), [(2305, False), (2306, True)])
def test_times_are_64_bit_integers(ticks: int, refused: bool) -> None:
    """Ticks of 1000003/10007 s are 1000003 * 10**9 / 10007 ns apart: twice the first number by 2306 is beyond 2**62."""
    blocks = {"body": Body(period="1000003/10007"), "law": Law(period="1000003/10007")}
    steps = stepped(blocks, duration=ticks * 1000003 / 10007 + 1.0)
    form = Form(remembered(steps[1], steps, [(s.x, s.numbers) for s in steps]))
    text = "times beyond whole numbers of 64 bits"
    for result in (why_not(rig_text, steps, []), why_not(batch_text, steps, steps[1], ["a[0]"], form)):
        assert result == (text if refused else "")
    # The code of one run serves runs of other lengths as long as their times fit into its types.
    short = stepped(blocks, duration=300.0)
    one, other = (fitted.kinds_of(fitted.Core(each), [], plain) for each in (steps, short))
    assert (one == other) is not refused


@pytest.mark.parametrize(("size", "refused"), [(64, False), (65, True)])
def test_an_input_of_many_numbers_is_an_array(size: int, refused: bool) -> None:
    port = scalars("many", "many", {f"c{k}": "" for k in range(size)})

    class Many(Block[Params]):
        OUTPUTS = (port,)

        def update(self, x: Any, t: int) -> Any:
            return x, {"many": (0.5,) * size}

    class Reads(Block[Params]):
        INPUTS = (port,)

        def update(self, x: Any, t: int, *, many: Any) -> Any:
            return x, {}

    result = why_not(rig_text, stepped({"many": Many(), "reads": Reads()}), [])
    assert ("expected at most 64" in result) == refused


def watching(blocks: dict[str, Any], at_once: bool) -> type[Observer[Params]]:
    """Return a class that reads all messages of blocks: of each input the sum of messages, stamps and numbers."""
    ports = [port for block in blocks.values() for port in block.ports(block.p)[1]]
    text = [replace(port, name=f"{port.name}_{k}", unchecked=False) for k, port in enumerate(ports)]

    class Seeing(Observer[Params]):
        INPUTS = tuple(text)

        def first(self) -> tuple[tuple[int, int, float], ...]:
            return ((0, 0, 0.0),) * len(text)

        def update(self, x: Any, t: int, **inputs: Any) -> Any:
            ages = [self.age(port.name) for port in text]
            new = [(age == 0, inputs[port.name], port.delayed) for age, port in zip(ages, text, strict=True)]
            return tuple(taken(old, t, *one) for old, one in zip(x, new, strict=True)), {}

        def status(self, x: Any) -> Any:
            return {}

    def taken(old: Any, t: int, new: bool, value: Any, late: bool) -> Any:
        if late:
            return old[0] + 1, old[1] + value.stamp, old[2] + value.data[0]
        return (old[0] + 1, old[1] + t, old[2] + value[0]) if new else old

    def all_at_once(self: Any, x: Any, t: int, messages: Mapping[str, Any]) -> Any:
        x = list(x)
        for k, port in enumerate(text):
            for stamp, values in messages.get(port.name, ()):
                x[k] = taken(x[k], stamp, True, values, False)
        return tuple(x)

    if at_once:
        Seeing.at_once, Seeing.in_batches = all_at_once, True  # type: ignore[attr-defined]
    return Seeing


class Failing(Law):
    """Fails after a long way."""

    def update(self, x: float, t: int, *, signal: tuple[float, ...]) -> tuple[float, Mapping[str, Any]]:
        """Answer at some ticks."""
        if t == 31_000_000:
            raise ValueError("far")
        return x, {"push": (0.125 if t % 7_000_000 else float(f"{signal[0]:.1f}"),)}


class PythonsLaw(Law):
    """Has a statement that native code does not support."""

    def update(self, x: float, t: int, *, signal: tuple[float, ...]) -> tuple[float, Mapping[str, Any]]:
        """Answer."""
        try:
            return super().update(x, t, signal=signal)
        finally:
            pass


RUN: dict[str, Any] = {
    "both at each tick": lambda: {"body": Body(), "law": Law()},
    "of which one is Python's": lambda: {"body": Body(), "law": PythonsLaw(period=0.02)},
    "one at each other tick": lambda: {"body": Body(), "law": Law(period=0.002)},
    "ticks that are no whole number of ns": lambda: {"body": Body(period=1 / 3000), "law": Law(period=1 / 1500)},
    "one whose ticks are Python's at times": lambda: {"body": Body(), "law": Deciding(period=0.002)},
    "one that reports": lambda: {"body": Telling(), "law": Law()},
    "late and silent": hard,
    "late and seldom": lambda: hard(sensor=0.002, talker=0.004),
    "several late and silent": lambda: {
        "body": Body(period=0.003),
        "both": Both(period=0.003),
        "hearing": Hearing(period=0.006),
        "law": Law(period=0.003),
        "wide": Wide(),
    },
    "one that asks for an age": lambda: {"body": Body(), "law": Law(), "wide": Wide(), "aging": Aging()},
    "doubted": lambda: {"body": Body(), "law": Spoiling()},
    "of many numbers": lambda: {"wide": Wide()},
    "an answer that is too short": lambda: {"body": Body(), "law": Short()},
    "silent at times": lambda: {"body": Body(), "law": Law(), "saying": Saying()},
    "silent at times and seldom": lambda: {"body": Body(), "law": Law(period=0.002), "saying": Saying(period=0.004)},
    "one that fails": lambda: {"body": Body(), "law": Failing()},
    "one that is moved by chance": lambda: {"body": Shaken(), "law": Law(period=0.003)},
}


@pytest.mark.parametrize("name", few(RUN, 20))
def test_a_rig_runs_natively_as_in_python(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With observers of each tick or of columns, as often as it ticks or half as often; with both kinds of text."""
    monkeypatch.setattr(fitted, "_counts", {})
    for k, (at_once, every) in enumerate(((True, 1), (True, 2), (False, 1), (False, 2))):
        quickest = min(block.p.period for block in RUN[name]().values())

        def made(at_once: bool = at_once, every: int = every, quickest: float = quickest) -> Rig:
            blocks = RUN[name]()
            seeing = watching(blocks, at_once)(period=every * quickest)
            return Rig.from_blocks(blocks | {"seeing": seeing}, 40 * quickest)

        native = the_same(made, monkeypatch, plain if k % 3 else lambda text: plain(text))
        assert native.members or "short" in name, native.reason
