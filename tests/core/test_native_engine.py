"""When native code is tried, how many ticks it computes at a time, and when it is abandoned: by a clock and counts of
the test.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import pytest
from softrig_core import Block, Rig, RunError
from softrig_core.block.schedule import Schedule
from softrig_core.kit.compiled import Compiled
from softrig_core.kit.jit import jit
from softrig_core.native import compile as compile_, engine, fitted, twins
from softrig_core.native.compile import plain
from softrig_core.native.engine import Engine
from softrig_core.native.rig_text import RigText
from softrig_core.native.translate import Program
from softrig_core.native.value import NotNative
from softrig_core.native.writer import Writer
from softrig_core.run import choice, inprocess
from test_native_rigs import PUSH, SIGNAL, Body, Law, Params, Wide, watching


@pytest.fixture(autouse=True)
def _no_text_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, empty in (("_texts", []), ("_refused", {}), ("_counts", {})):
        monkeypatch.setattr(fitted, name, empty)


def going(blocks: dict[str, Any], seconds: float, **options: Any) -> Engine:
    """Return an engine for a rig of blocks."""
    made = Rig.from_blocks(blocks, seconds)
    return Engine(list(inprocess.wired(made, blocks).values()), **{"make": plain} | options)


def ended(run: Engine, first: int = 0) -> Engine:
    """Run it to its end."""
    for _ in run.run(first):
        pass
    return run


def test_the_number_of_ticks_in_a_batch_follows_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many times more as the limit allows, 16 at most; half after a batch above it; 1024 ticks at least."""
    elapsed = itertools.chain([8.0, 16.01, 32.0, 32.01, 40.0, 50.0, 50.0, 0.0], itertools.repeat(20.0))
    now = iter(())
    monkeypatch.setattr(engine, "time", SimpleNamespace(perf_counter=lambda: next(now)))
    run, gos, before = going({"body": Body(), "law": Law()}, 32.0), [], 1
    run._longest = 32.0
    now = itertools.chain.from_iterable((0.0, t) for t in elapsed)
    for t in run.run():
        if t is not None and t // 1_000_000 + 1 > before:
            gos.append(t // 1_000_000 + 1 - before)
        before = t // 1_000_000 + 1
    assert gos[:8] == [1024, 4096, 4096, 4096, 2048, 1024, 1024, 1024]
    assert fitted._texts[0].go == 16384


def test_with_external_nodes_a_batch_takes_a_tenth_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    for alone, go in ((None, 9216), (lambda: True, 1024)):
        now = itertools.accumulate(itertools.cycle([0.0, 0.0051]))
        monkeypatch.setattr(engine, "time", SimpleNamespace(perf_counter=lambda now=now: next(now)))
        fitted._texts.clear()
        fitted._counts.clear()
        ended(going({"body": Body(), "law": Law()}, 4.0, alone=alone))
        assert fitted._texts[0].go == go


def test_the_longest_batch_has_a_million_ticks() -> None:
    assert (fitted.SHORTEST, engine.LONGEST, engine.GO, engine.SHORT_GO) == (1024, 1 << 20, 0.05, 0.005)


@pytest.mark.parametrize(("given_up", "ticks", "often"), [(64, 0, False), (65, 1039, True), (65, 1040, False)])
def test_many_discarded_ticks_are_one_in_sixteen_of_more_than_a_thousand(
    given_up: int, ticks: int, often: bool
) -> None:
    run = going({"wide": Wide()}, 0.1)
    run.native.given_up, run.native.ticks = given_up, ticks
    assert run._often() is often


def test_a_varied_parameter_gets_another_text_once_in_twenty_runs() -> None:
    assert [k for k in range(70) if fitted._worth_another("a kind")] == [0, 20, 40, 60]
    assert fitted._worth_another("another")


def test_eight_texts_are_cached_the_newest_first() -> None:
    for k in range(10):
        ended(going({f"wide{k}": Wide()}, 0.01))
    assert [kept.kinds[2][0][0] for kept in fitted._texts] == [f"wide{k}" for k in range(9, 1, -1)]
    ended(going({"wide5": Wide()}, 0.01))
    assert len(fitted._texts) == 8


class Odd(Block[Params]):
    """Formats a text, which native code does not support."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (PUSH,)

    def update(self, x: tuple[()], t: int, *, signal: tuple[float, ...]) -> tuple[tuple[()], Mapping[str, Any]]:
        """Answer."""
        return x, {"push": (float(str(signal[1])),)}


@pytest.mark.parametrize(("period", "members"), [(0.007, ()), (0.008, ("body",))])
def test_a_node_due_at_each_eighth_tick_may_stay_in_python(period: float, members: tuple[str, ...]) -> None:
    run = ended(going({"body": Body(), "odd": Odd(period=period)}, 0.1))
    assert run.native.members == members
    assert [s.native for s in run.steps] == [(0, "")] * 2  # generated code that Python runs is not reported as native
    assert ("str()" in run.native.reason) == (members == ())
    # All ticks are native except the first and those of the other node.
    assert run.native.ticks == (0 if not members else 100 - 1 - 12)


class Turning(Block[Params]):
    """Changes the type of its state at some ticks."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (PUSH,)
    AT: tuple[int, ...] = ()

    def first(self) -> Any:
        """A number."""
        return 0.0

    def update(self, x: Any, t: int, *, signal: tuple[float, ...]) -> tuple[Any, Mapping[str, Any]]:
        """Answer."""
        return (int(x) if type(x) is float else float(x)) if t // 1_000_000 in self.AT else x, {"push": (0.5,)}


@pytest.mark.parametrize(
    ("turns", "tried"),
    [
        ((), [1]),
        ((3, 5), [1, 4, 6]),
        (range(1, 20), [1, 2, 3, 4]),  # the state changes its type at each tick, so there are four attempts
        ((200, 256), [1, 201, 257]),
        ((200, 257), [1, 201]),  # after tick 256 types are no longer checked
    ],
)
def test_a_rig_without_native_code_is_tried_again_when_its_states_change_type(turns, tried, monkeypatch) -> None:
    at: list[int] = []
    run = going({"body": Body(), "turning": Turning()}, 0.4)

    def none(steps: Any, *how: Any, reports: bool = True) -> Any:
        at.append(run.steps[0].t // 1_000_000 + 1)
        raise NotNative("a test")

    monkeypatch.setattr(Turning, "AT", turns)
    monkeypatch.setattr(fitted, "rig_text", none)
    monkeypatch.setattr(fitted, "_worth_another", lambda kinds: True)
    ended(run)
    assert at == [k for k in tried for _ in range(2)]  # each attempt generates the code with and without reports
    assert (run.native.reason, run.native.ticks, run.steps[0].t) == ("a test", 0, 400_000_000)


def test_with_external_subscribers_ticks_run_in_python_and_each_64th_asks_again() -> None:
    asked: list[int] = []
    run = going(
        {"body": Body(), "law": Law()}, 0.4, alone=lambda: asked.append(run.steps[0].t // 1_000_000) or len(asked) > 3
    )
    began = [run.native.reason for _ in zip(run.run(), range(3), strict=False)][-1]
    assert began == "another process, or a person, takes part in its ticks"
    run = going(
        {"body": Body(), "law": Law()}, 0.4, alone=lambda: asked.append(run.steps[0].t // 1_000_000) or len(asked) > 3
    )
    asked.clear()
    ended(run)
    assert asked[:4] == [0, 64, 128, 192]
    assert run.native.ticks == 400 - 193
    assert run.native.reason == ""


class Thread:
    """A thread of the test: its work is done when it has started, but it still counts as running."""

    def __init__(self, target: Any, daemon: bool) -> None:
        self.start, self.looks = target, 0

    def is_alive(self) -> bool:
        """Return false at the third call."""
        self.looks += 1
        return self.looks < 3


def test_a_text_is_compiled_in_a_thread_while_others_are_served(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine.threading, "Thread", Thread)
    called: list[tuple[int, int]] = []

    def make(text: Any) -> Any:
        function = plain(text)
        return lambda first, last, *more: called.append((first, last)) or function(first, last, *more)

    run = ended(going({"body": Body(), "law": Law()}, 0.4, make=make, alone=lambda: True))
    assert called == [(1, 1), (65, 400)]  # ticks run in Python until it is clear whether compiling pays off
    assert run.native.ticks == 335
    ended(going({"body": Body(), "law": Law()}, 0.4, make=make, alone=lambda: True))
    assert called[2:] == [(1, 400)]  # the code is cached by now
    called.clear()
    fitted._texts.clear()
    fitted._counts.clear()
    ended(going({"body": Body(), "law": Law()}, 0.4, make=make))
    assert called == [(1, 400)]  # a run without other nodes in its process waits for the compilation


def test_a_continued_run_begins_with_its_tick() -> None:
    whole = ended(going({"body": Body(), "law": Law()}, 0.1))
    run = going({"body": Body(), "law": Law()}, 0.1)
    for t in run.loop.run():
        if t == 39_000_000:
            break
    ended(run, 40)
    assert [s.x for s in run.steps] == [s.x for s in whole.steps]
    assert (run.native.ticks, whole.native.ticks) == (59, 99)  # the first tick of each part runs in Python


def test_a_text_that_numba_refuses_is_reported_and_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    class Refused(Exception):
        __module__ = "numba.core.errors"

    def make(text: Any) -> Any:
        def function(*handed: Any) -> Any:
            raise Refused("no\n  such   type " + "x" * 400)

        return function

    run = ended(going({"body": Body(), "law": Law()}, 0.05, make=make))
    assert run.native.reason == "numba: no such type " + "x" * (300 - 13)
    assert (run.native.ticks, fitted._texts) == (0, [])

    def broken(text: Any) -> Any:
        def function(*handed: Any) -> Any:
            raise OSError("else")

        return function

    with pytest.raises(OSError, match="else"):
        ended(going({"body": Body(), "law": Law()}, 0.05, make=broken))


def test_cached_texts_are_found_by_the_classes_of_blocks() -> None:
    """Blocks that only observe do not count; the order of the others does."""
    ended(going({"body": Body(), "law": Law(), "seeing": watching({"body": Body()}, True)()}, 0.05))
    ended(going({"wide": Wide()}, 0.05, make=engine.plain))

    def known(*blocks: Any, make: Any = plain) -> bool:
        return fitted.known([cast(Any, SimpleNamespace(block=block)) for block in blocks], make)

    body, law, wide = Body(), Law(), Wide()
    assert known(body, law)
    assert known(body, watching({"body": body}, True)(), law)
    assert known(wide)
    assert not any(known(*blocks) for blocks in ((law, body), (body,), (), (body, law, wide)))
    assert not known(body, law, make=engine.compiled)


@pytest.mark.parametrize(("ticks", "known"), [(64, False), (65, True)])
def test_the_cost_of_a_tick_is_known_after_65_of_them(ticks, known, monkeypatch) -> None:
    monkeypatch.setattr(choice, "_costs", {})
    monkeypatch.setattr(choice, "_spent", {})
    blocks = {"body": Body(), "law": Law()}
    made = Rig.from_blocks(blocks, ticks / 1000)
    steps = list(inprocess.wired(made, blocks).values())
    going, _ = choice.ticks_of(steps)
    assert {s.native for s in steps} == {(0, choice.SHORT)}
    assert list(going)[-1] == ticks * 1_000_000
    assert (choice.cost(steps) is not None) == known
    assert {s.native for s in steps} == {(0, choice.SHORT)}
    assert (choice._spent[Body, Law] > 0.0) == known
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    choice.ticks_of(steps)
    assert {s.native for s in steps} == {(0, "SOFTRIG_JIT=0")}


def test_a_run_that_saves_nothing_is_not_compiled() -> None:
    steps = going({"wide": Wide()}, 0.1).steps
    assert [choice.unwanted(steps, left, 2) for left in (3.0, 3.000001)] == [choice.SHORT, ""]
    assert [choice.writes(steps, left) for left in (0.15, 0.150001)] == [False, True]
    fitted._texts.clear()
    ended(going({"wide": Wide()}, 0.1))
    assert [choice.writes(steps, left) for left in (0.01, 0.010001)] == [False, True]


def test_a_run_without_an_end_stays_in_python() -> None:
    blocks = {"wide": Wide()}
    steps = list(inprocess.wired(Rig.from_blocks(blocks, 0.1), blocks).values())
    for step in steps:
        step.schedule = Schedule(0.1)
    choice.ticks_of(steps)
    assert steps[0].native == (0, "a run without an end")


TEXT = """
def f0_twice(c, n, x):
    return twice(x)

def rig(first, last, n, c, s):
    call0_there(0, 0, 0, 0, 0)
    return f0_twice(c, n, s)
"""


def test_compiled_texts_are_cached_by_everything_that_affects_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The text, the names in it, the functions that they mean and the options; none of it is compiled here."""

    def outside(x: float) -> float:
        return 3.0

    def made(text: str = TEXT, symbol: str = "one", twice: Any = None, name: str = "twice") -> Any:
        code = object.__new__(Compiled)
        code.symbol = symbol
        monkeypatch.setattr(compile_, "_external", lambda numba, thing: outside)
        names = {name: twice or jit(lambda x: 2.0 * x), "call0_there": code}
        return compile_.compiled(RigText(text, Program([], Writer, names=names), (), ()))

    def key(function: Any) -> str:
        return function.py_func.__qualname__

    double = jit(lambda x: x + x)
    keys = [
        key(made()),
        key(made(TEXT.replace("return twice", "return -twice"))),
        key(made(symbol="two")),
        key(made(twice=double)),
        key(made(name="thrice")),
    ]
    assert len(set(keys)) == len(keys)
    assert [key(made()), key(made(twice=double))] == [keys[0], keys[3]]
    function = made()
    assert keys[0].startswith("rig_")
    assert len(keys[0]) == 36
    inner = function.py_func.__globals__["f0_twice"]
    assert inner.py_func.__qualname__ == f"f0_twice_{keys[0][4:]}"
    assert function.py_func.__globals__["call0_there"] is outside
    options = {"error_model": "python", "boundscheck": True, "nogil": True}
    assert {k: v for k, v in function.targetoptions.items() if k in options} == options
    assert {k: v for k, v in inner.targetoptions.items() if k in options} == options
    alone = ("forceinline", "no_cpython_wrapper", "no_cfunc_wrapper")
    assert [bool(inner.targetoptions.get(name)) for name in alone] == [True] * 3
    assert [bool(function.targetoptions.get(name)) for name in alone] == [False] * 3


def test_a_state_keeps_its_type() -> None:
    assert compile_.same((1.0, 2), (3.0, 4)) == (3.0, 4)
    for other in ((1.0, 2.0), (1.0,), [1.0, 2], None):
        with pytest.raises(RuntimeError, match="a state that changes its type"):
            compile_.same((1.0, 2), other)


class Point(NamedTuple):
    a: float
    b: Any


@dataclass(frozen=True)
class Frozen:
    a: float
    b: Any = 2.0


@dataclass
class Loose:
    a: float


class Whole:
    """Defines its own native form."""

    def __init__(self, a: float) -> None:
        self.a = a

    def native(self) -> Kept:
        """Return the native form."""
        return Kept(self.a)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Whole) and other.a == self.a

    __hash__ = None  # type: ignore[assignment]


class Kept(NamedTuple):
    a: float

    def python(self) -> Whole:
        """Return the object."""
        return Whole(self.a)


@pytest.mark.parametrize(
    "state",
    [
        1.0,
        3,
        True,
        None,
        "word",
        (),
        (1.0, 2),
        Point(1.0, 2),
        Point(1.0, (2, Frozen(3.0))),
        Frozen(1.0, Frozen(2.0, (3,))),
        (Frozen(1.0), 5.0),
        Whole(2.0),
        (Whole(2.0), 1.0),
        Point(Whole(1.0), None),
        ((1.0, 2.0), (3, True)),
    ],
)
def test_a_state_returns_from_native_code_unchanged(state: Any) -> None:
    """Frozen dataclasses as named tuples of the same fields, objects by their own methods; other values are passed
    unchanged.
    """
    natively = twins.packed(state)
    assert twins.unpacked(natively) == state
    assert type(twins.unpacked(natively)) is type(state)
    assert "Frozen(" not in repr(natively).replace("__Frozen(", "")
    assert "Whole" not in repr(natively)
    if "Frozen" not in repr(state) and "Whole" not in repr(state):
        assert natively is state
        assert twins.unpacked(natively) is state
    python = twins.packed(state, False)
    assert ("Whole" in repr(python)) == ("Whole" in repr(state))
    assert twins.form(natively) == twins.form(twins.packed(state))


def test_native_forms_and_twins_are_checked() -> None:
    assert twins.form((1.0, (2, None), True)) == (tuple, (float, (tuple, (int, type(None))), bool))
    assert twins.form(Point(1.0, 2)) == (Point, (float, int)) != twins.form((1.0, 2))
    assert [twins.is_twinned(kind) for kind in (Frozen, Loose, Point, 5, Frozen(1.0), int)] == [True] + [False] * 5
    kind = twins.twin(Frozen)
    assert (kind._fields, kind._field_defaults, kind.__name__) == (("a", "b"), {"b": 2.0}, f"{__name__}__Frozen")
    assert twins.class_of(kind(1.0, 2.0)) is Frozen
    assert (twins.class_of(Point(1.0, 2)), twins.class_of((1.0,)), twins.class_of(5)) == (Point, None, None)
    assert getattr(twins, f"{__name__}__Frozen") is kind
    for name in ("none", "__none", "a__"):
        with pytest.raises((AttributeError, ImportError)):
            getattr(twins, name)


@pytest.mark.parametrize(
    ("line", "reported"),
    [
        ("q1 = (missing_,)", "NameError: name 'missing_' is not defined (`q1 = (missing_,)`)"),
        ("q1 = (1.0 + None,)", "TypeError: unsupported operand type"),
    ],
)
def test_an_error_in_a_text_is_reported_as_a_defect_of_softrig(line: str, reported: str) -> None:
    """An unknown name ends the run; if Python computes it without an error, Python's result is used, with a warning."""

    def make(text: Any) -> Any:
        at = next(k for k, one in enumerate(text.text.splitlines()) if one.strip().startswith("q1 = "))
        lines = text.text.splitlines()
        lines[at] = f"        {line}"
        return plain(replace(text, text="\n".join(lines) + "\n"))

    run = going({"body": Body(), "law": Law()}, 0.05, make=make)
    if reported.startswith("Name"):
        with pytest.raises(RunError, match=re.escape(f"{reported}: {fitted.DEFECT}")):
            ended(run)
        return
    with pytest.warns(RuntimeWarning, match=fitted.DEFECT):
        ended(run)
    assert run.native.reason.startswith(reported)
    whole = ended(going({"body": Body(), "law": Law()}, 0.05))
    assert [s.x for s in run.steps] == [s.x for s in whole.steps]
