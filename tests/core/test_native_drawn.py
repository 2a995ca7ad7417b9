"""Functions drawn at random from everything that native code supports, compared with themselves in Python, bit
for bit.
"""

import linecache
import math
import random
from typing import Any, NamedTuple

import pytest
from softrig_core import Block, Rig
from softrig_core.kit.dense import total
from softrig_core.native.compile import plain
from test_native import PUSH, SIGNAL, Oscillator, OscillatorParams, _no_text_in_the_way, limited, the_same  # noqa: F401

STATEMENTS = 7


class Inner(NamedTuple):
    """A part of the state."""

    c: float = 0.75
    row: tuple[float, float] = (0.25, -0.5)


class Kept(NamedTuple):
    """The state of a random block."""

    a: float = 1.0
    k: int = 0
    pair: tuple[float, ...] = (0.5, -1.5, 2.5)
    inner: Inner = Inner()
    last: float | None = None


class Pen:
    """Writes expressions and statements; each is a float, an integer or a truth value, by its method."""

    def __init__(self, seed: int) -> None:
        self.rng, self.names, self.lines, self.depth = random.Random(seed), ["p", "q"], [], 0

    def one(self, leaves: int, *forms: Any) -> str:
        self.depth += 1
        result: str = self.rng.choice(forms[:leaves] if self.depth > 3 else forms)()
        self.depth -= 1
        return result

    def number(self) -> str:
        e, i, b, rng = self.number, self.whole, self.truth, self.rng
        return self.one(
            4,
            lambda: rng.choice(self.names),
            lambda: rng.choice(["signal[0]", "signal[-1]", "x.a", "x.inner.c", "x.inner.row[1]", "x.pair[-2]"]),
            lambda: rng.choice(["self.gain", "self.table[2]", "self.named['low']", "self.p.growth", "LEVEL", "0.375"]),
            lambda: f"{rng.choice(self.names)} {rng.choice('+-*')} {rng.choice(self.names)}",
            lambda: f"({e()} {rng.choice('+-*')} {e()})",
            lambda: f"({e()} / (1.5 + abs({e()})))",
            lambda: f"-{e()}",
            lambda: f"+({e()})",
            lambda: f"min({e()}, {e()})",
            lambda: f"max({e()}, {e()}, {e()})",
            lambda: f"max(({e()}, {e()}))",
            lambda: f"math.{rng.choice(['sin', 'cos', 'atan', 'tanh', 'floor', 'fabs'])}({e()})",
            lambda: f"math.sqrt(abs({e()}))",
            lambda: f"math.{rng.choice(['copysign', 'atan2'])}({e()}, {e()})",
            lambda: f"math.exp(min({e()}, 1.5))",
            lambda: f"({e()} if {b()} else {e()})",
            lambda: f"({e()} or {e()})",
            lambda: f"({e()} and {e()})",
            lambda: f"limited({e()})",
            lambda: f"limited({e()}, most={e()})",
            lambda: f"limited({e()}, *({e()}, 2.0))",
            lambda: f"limited({e()}, **{{'least': -abs({e()})}})",
            lambda: f"self.half({e()})",
            lambda: f"self.half({e()}, {i()})",
            lambda: f"float({i()})",
            lambda: f"({e()}) ** 2",
            lambda: f"abs({e()}) ** 0.5",
            lambda: f"({e()}) % 2.0",
            lambda: f"({e()}) // 0.5",
            lambda: f"({e()}, {e()}, {e()})[{i()} % 3]",
            lambda: f"self.table[{i()} % 4]",
            lambda: f"x.pair[{i()} % 3]",
            lambda: f"x.pair[1:][{i()} % 2]",
            lambda: f"self.by_number[{i()} % 3]",
            lambda: f"total([v * {e()} for v in x.pair])",
            lambda: "total(v * w for v, w in zip(x.pair, self.table))",
            lambda: "total((k + 1) * v for k, v in enumerate(x.pair) if k != 1)",
            lambda: f"max([abs(v - {e()}) for v in reversed(x.pair)])",
            lambda: f"(w := {e()}) * w",
            lambda: f"(x.a if x.last is None else x.last - {e()})",
            lambda: f"{{'low': {e()}, **{{'high': {e()}}}}}['{rng.choice(['low', 'high'])}']",
            lambda: f"complex({e()}, {e()}).{rng.choice(['real', 'imag'])}",
            lambda: f"abs(complex({e()}, {e()}))",
        )

    def whole(self) -> str:
        e, i, b, rng = self.number, self.whole, self.truth, self.rng
        return self.one(
            2,
            lambda: rng.choice(["x.k", "t // 1_000_000 % 7", "3", "len(x.pair)", "self.count"]),
            lambda: f"(x.k % {rng.randint(2, 5)})",
            lambda: f"({i()} + {i()})",
            lambda: f"({i()} * {i()} % 11)",
            lambda: f"(-{i()} % 3)",
            lambda: f"({i()} // 2)",
            lambda: f"abs({i()} - 4)",
            lambda: f"min({i()}, 3)",
            lambda: f"int({e()})",
            lambda: f"int({b()})",
            lambda: f"(2 if {b()} else {i()})",
            lambda: f"sum(n * {i()} for n in (1, 2, 3))",
            lambda: f"sum([v > {e()} for v in x.pair])",
        )

    def truth(self) -> str:
        e, i, b, rng = self.number, self.whole, self.truth, self.rng
        return self.one(
            3,
            lambda: (
                f"{rng.choice(self.names)} {rng.choice(['<', '<=', '>', '>=', '!=', '=='])} {rng.choice(self.names)}"
            ),
            lambda: f"x.k % {rng.randint(2, 4)} == {rng.randint(0, 1)}",
            lambda: rng.choice(["self.flag", "x.last is None", "x.last is not None", "signal[0]", "x.k"]),
            lambda: f"{e()} < {e()}",
            lambda: f"{e()} <= {e()} < {e()}",
            lambda: f"not {b()}",
            lambda: f"({b()} and {b()})",
            lambda: f"({b()} or {b()})",
            lambda: f"({b()} and {b()} and not {b()})",
            lambda: f"{i()} in (0, 2, 5)",
            lambda: f"{i()} not in (1, 3)",
            lambda: f"any(v > {e()} for v in x.pair)",
            lambda: f"all([v < {e()} for v in x.pair])",
            lambda: f"bool({e()})",
        )

    def say(self, text: str, deep: int) -> None:
        self.lines.append("    " * (deep + 2) + text)

    def new(self) -> str:
        return f"v{sum(name[0] == 'v' for name in self.names)}"

    def block(self, count: int, deep: int) -> None:
        """Statements; a name that first appears in a branch or a loop is not read after it."""
        known = list(self.names)
        for _ in range(count):
            getattr(
                self, "_" + self.rng.choice(["set", "set", "more", "swap", "way", "turns", "counts", "list", "asserts"])
            )(deep)
        if deep:
            self.names = known

    def _set(self, deep: int) -> None:
        name = self.rng.choice([self.new(), *self.names[-3:]])
        self.say(f"{name} = limited({self.number()}, -9.0, 9.0)", deep)
        self.names += [] if name in self.names else [name]

    def _more(self, deep: int) -> None:
        self.say(
            f"{self.rng.choice(self.names)} {self.rng.choice(['+=', '-='])} 0.25 * math.sin({self.number()})", deep
        )

    def _swap(self, deep: int) -> None:
        first, second = self.rng.sample(self.names, 2)
        self.say(f"{first}, {second} = {second}, {first}", deep)

    def _way(self, deep: int) -> None:
        self.say(f"if {self.truth()}:", deep)
        self.block(self.rng.randint(1, 2), deep + 1)
        if self.rng.random() < 0.6:
            self.say(f"elif {self.truth()}:" if self.rng.random() < 0.4 else "else:", deep)
            self.block(1, deep + 1)

    def _turns(self, deep: int) -> None:
        head = self.rng.choice(
            [
                "for g in x.pair:",
                "for h, g in enumerate(x.pair):",
                "for g, h in zip(x.pair, self.table):",
                "for g in range(3):",
                "for h, g in reversed(((1, 0.5), (2, 0.25))):",
                "for g in range(x.k % 4):",
            ]
        )
        self.say(head, deep)
        name = self.rng.choice(self.names)
        self.say(f"{name} = limited({name} * 0.5 + g * {self.rng.choice(self.names)}, -9.0, 9.0)", deep + 1)

    def _counts(self, deep: int) -> None:
        name = self.rng.choice(self.names)
        self.say(f"left = {self.rng.randint(2, 4)}", deep)
        self.say("while left > 0:", deep)
        self.say("left -= 1", deep + 1)
        self.say(f"if {self.truth()}:", deep + 1)
        self.say(self.rng.choice(["continue", "break"]), deep + 2)
        self.say(f"{name} = limited({name} * 0.75 + 0.1 * left, -9.0, 9.0)", deep + 1)

    def _list(self, deep: int) -> None:
        name = self.rng.choice(self.names)
        self.say(f"rows = [{self.number()}]", deep)
        self.say(f"rows.append({self.number()})", deep)
        self.say(f"first, *rest = (*rows, {self.number()})", deep)
        self.say(f"{name} = limited(first - rest[-1], -9.0, 9.0)", deep)

    def _asserts(self, deep: int) -> None:
        self.say("assert len(signal) == 2", deep)


HEAD = '''
class Drawn(Block[OscillatorParams]):
    """Drawn at random."""

    INPUTS = (SIGNAL,)
    OUTPUTS = (PUSH,)

    def setup(self):
        self.gain, self.table, self.count, self.flag = 0.625, (0.5, -0.25, 1.5, 2.0), 4, True
        self.named, self.by_number = {"low": -0.5, "high": 1.25}, {0: 0.5, 1: -1.0, 2: 2.0}

    def half(self, v, n=2):
        if n > 3:
            return v
        return v / (abs(n) + 2)

    def first(self):
        return Kept()

    def update(self, x, t, *, signal):
        p, q = signal[0] - x.a, 0.5 * signal[1]
'''


def drawn(seed: int) -> type[Block[Any]]:
    pen = Pen(seed)
    pen.block(STATEMENTS, 0)
    pen.say("pair = (x.pair[1], limited(p, -3.0, 3.0), x.pair[0])", 0)
    pen.say("inner = x.inner._replace(c=limited(q, -2.0, 2.0))", 0)
    pen.say("x = Kept(limited(p + q, -4.0, 4.0), x.k + 1, pair, inner, q)", 0)
    pen.say(f"return x, {{'push': (limited({' + '.join(pen.names)}, -5.0, 5.0),)}}", 0)
    text = HEAD + "\n".join(pen.lines) + "\n"
    name = f"<drawn {seed}>"
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    scope = {"Block": Block, "OscillatorParams": OscillatorParams, "SIGNAL": SIGNAL, "PUSH": PUSH, "Kept": Kept,
             "math": math, "limited": limited, "total": total, "LEVEL": 0.875, "__name__": __name__}  # fmt: skip
    exec(compile(text, name, "exec"), scope)
    return scope["Drawn"]


@pytest.mark.parametrize("seed", range(12))
def test_random_functions_are_the_same_natively(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = drawn(seed)
    native = the_same(lambda: Rig.from_blocks({"plant": Oscillator(), "law": kind()}, 0.04), monkeypatch, plain)
    assert "law" in native.members
    assert native.given_up <= 1, native
