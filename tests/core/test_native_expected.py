"""Small functions as native code: each returns what Python returns, also for another block that shares its text.

`tests/expected/native.txt` has the functions that have no native code or discard some ticks, and why.
"""

from __future__ import annotations

import cmath
import dataclasses
import itertools
import linecache
import math
import random
import re
import textwrap
from bisect import bisect_left, bisect_right
from contextlib import suppress
from functools import cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from expected_text import check_expected
from softrig_core import Block, BlockParams, ByHand, Level
from softrig_core.block.answer import only_floats, sum_of_products
from softrig_core.kit.dense import total
from softrig_core.kit.draws import Draws
from softrig_core.kit.jit import Jit, jit, power
from softrig_core.kit.newest import Newest
from softrig_core.native.compile import BASE, same
from softrig_core.native.fitted import NATIVE
from softrig_core.native.reports import Reports
from softrig_core.native.translate import Program, specialise, written
from softrig_core.native.twins import packed, unpacked
from softrig_core.native.value import UNKNOWN, Dynamic, NotNative, Record, Static, sample_of
from softrig_core.native.words import OWN, TEXTS
from softrig_core.native.writer import Writer

LEVEL = 0.875
TABLE = (0.5, 1.5, 4.0)


class Kept(NamedTuple):
    """A state."""

    a: float = 0.5
    k: int = 3
    pair: tuple[float, float] = (0.25, -0.5)
    last: float | None = None

    @property
    def twice(self) -> float:
        """Read as an attribute."""
        return 2.0 * self.a

    def more(self, by: float) -> Any:
        """Read as a method."""
        return self._replace(a=self.a + by)


@dataclasses.dataclass(frozen=True)
class Point:
    """A value with a twin."""

    a: float
    b: float = 0.5

    SCALE = 3.0

    def norm(self) -> float:
        """Its length."""
        return math.sqrt(self.a * self.a + self.b * self.b)


class Row(NamedTuple):
    """The native form of `Line`."""

    start: float

    def at(self, x: float, slope: float = 2.0) -> float:
        """The value on the line."""
        return self.start + slope * x

    def python(self) -> Line:
        """The line again."""
        return Line(self.start)


class Line:
    """An object with a native form."""

    def __init__(self, start: float) -> None:
        self.start = start

    def __repr__(self) -> str:
        return f"Line({self.start})"

    def native(self) -> Row:
        """Return the native form."""
        return Row(self.start)

    def at(self, x: float, slope: float = 2.0) -> float:
        """Its height."""
        return self.start + slope * x


class Gain:
    """An object that is called as a function."""

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def __call__(self, value: float, more: float = 0.0) -> float:
        return self.factor * value + more

    def own(self, value: float) -> float:
        """The same as a method."""
        return self(value)


class Base(Block[BlockParams]):
    """Has the method that `Owner` calls."""

    def half(self, value: float, n: int = 2) -> float:
        """Less."""
        return value / (abs(n) + 2)


class Owner(Base):
    """The block whose methods are compiled."""

    INPUTS = OUTPUTS = ()

    def setup(self) -> None:
        """Set all kinds of constants."""
        self.gain, self.count, self.large, self.word, self.on = 0.625, 4, 10**10, "down", True
        self.table, self.whole, self.nothing = [0.5, -0.25, 1.5, 2.0], (1, 2, 3), None
        self.named, self.by_number = {"low": -0.5, "high": 1.25}, {0: 0.5, 1: -1.0, 2: 2.0}
        self.by_pair = {(0, 1): 0.5, (1, 0): 2.0}
        self.rows = ({"u": 1.0, "v": 2.0}, {"v": 3.0, "u": 4.0})
        self.array, self.long = np.array([1.0, 2.0, 3.0]), [0.5 * k for k in range(17)]
        self.many, self.spin, self.gainful = tuple(map(float, range(65))), 0.5 - 1.5j, Gain(1.5)
        self.bound, self.lent, self.kept = partial(limited, most=1.0), self.gainful.own, Kept(a=1.25)
        self.draws = Draws((1,), "random")
        self.newest = Newest(lambda key: (2.0 * key, 3.0 * key))
        self.newest(0.5)
        self.view, self.ages = MappingProxyType({"one": 1.0}), {"near": 0, "far": 7_000_000_000}.get
        self.laws = (self.half, self.gainful.own)
        self.edge, self.beyond, self.low = 4096, 4097, "low"
        self.sixteen, self.seventeen = [0.5] * 16, [0.5] * 16 + [1]

    def third(self, k: int) -> float:
        """Reads an array."""
        return self.array[k]

    def half(self, value: float, n: int = 2) -> float:
        """Even less."""
        return 0.5 * super().half(value, n=n)

    def update(self, x: Any, t: int) -> Any:
        """Never asked."""
        return x, {}


def limited(x: float, least: float = -3.0, most: float = 3.0) -> float:
    """Return x, limited to both ends."""
    return min(max(x, least), most)


def sum_all(*values: float, **words: float) -> float:
    """Takes any number of arguments, with and without names."""
    return total(values) + total(list(words.values()))


def itself(x: float) -> float:
    """Calls itself."""
    return itself(x - 1.0) if x > 0.0 else x


def never(x: float) -> float:
    """Never returns a value."""
    raise ValueError


def signed(x: float) -> float | None:
    """Has three returns."""
    if x > 1.0:
        return x
    if x < -1.0:
        return -x
    return None


def applied(function: Any, x: float) -> Any:
    """Calls its argument."""
    return function(x)


def parted(x: float) -> dict[str, Any]:
    """Returns a mapping."""
    return {"sum": x + 1.0, "row": (x, -x), "in": {"a": x}}


@jit
def doubled(x: Any) -> Any:
    return 2.0 * x


# Arguments of the functions: a value that native code knows from the tick before, and a second value.
GIVEN: dict[str, tuple[Any, Any]] = {
    "p": (Dynamic("p", 0.5), 2.25),
    "q": (Dynamic("q", -1.5), 0.0),
    "r": (Dynamic("r", 2.0), -3.75),
    "i": (Dynamic("i", 3), 0),
    "j": (Dynamic("j", -2), 5),
    "z": (Dynamic("z", 0.5 - 1.0j), -2.0 + 0.25j),
    "yes": (Dynamic("yes", True), False),
    "e": (Dynamic("e", (0.5, -1.5, 2.5)), (-0.25, 4.0, 0.0)),
    "mixed": (Dynamic("mixed", (1.5, 2)), (-0.5, 7)),
    "long": (Dynamic("long", (0.0,) * 65), (1.0,) * 65),
    "x": (Dynamic("x", Kept()), Kept(-2.0, 4, (1.5, 0.5), 0.125)),
    "point": (Dynamic("point", packed(Point(3.0, 4.0))), Point(-1.0, 2.0)),
    "line": (Dynamic("line", Line(0.5)), Line(1.5)),
    "may": (Dynamic("may", 0.25, False), None),
    "none": (Dynamic("none", None, False), 1.5),
    "nil": (Dynamic("nil", None), None),
    "some": (Dynamic("some", (0.5, 1.0), False), (2.0,)),
    "u": (Dynamic("u"), 1.75),
    "v": (Dynamic("v", np.array([1.0, -2.0, 4.0])), np.array([0.5, 0.25, -8.0])),
    "flat": (Dynamic("flat", np.zeros((2, 2))), np.ones((2, 2))),
    "m": (Record({"low": Dynamic("low", -1.0), "high": Dynamic("high", 1.0)}), {"low": 0.5, "high": 0.25}),
    "d": (Dynamic("d", (2.0, -2.0), True, ("high", "low")), {"high": 0.5, "low": 0.25}),
}
GLOBALS = {**{k: v for k, v in globals().items() if k in ("LEVEL", "TABLE") or callable(v)}, "math": math,
           "cmath": cmath, "np": np, "bisect_left": bisect_left, "bisect_right": bisect_right, "Level": Level,
           "total": total, "power": power, "partial": partial, "__name__": "here"}  # fmt: skip


def written_out(case: str) -> Any:
    """Make the function of a case: its arguments are the names of `GIVEN` that it uses."""
    body = case if case in EACH[LINES:] else f"return {case}"
    words = set("".join(c if c.isalnum() or c == "_" else " " for c in body).split())
    names = [name for name in GIVEN if name in words]
    text = f"def case({', '.join(['self', *names])}):\n{textwrap.indent(textwrap.dedent(body).strip(), '    ')}\n"
    name = f"<case {text}>"
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    scope = dict(GLOBALS)
    exec(compile(text, name, "exec"), scope)
    return scope["case"], names


@cache
def native(case: str, typed: bool = True) -> tuple[Any, Any, Program, list[str]]:
    """Translate a case: its function, the result of a call or the reason why there is none, its program, its
    arguments.
    """
    function, names = written_out(case)
    owner = Owner()
    program = Program([owner], Writer, {(0, "near"): 0, (0, "far"): "when[0]"}, (), typed)
    program.reports = Reports()
    known = [GIVEN[name][0] for name in names]
    if typed:
        known = [dataclasses.replace(v, sample=packed(v.sample)) if isinstance(v, Dynamic) else v for v in known]
    try:
        value = specialise(program, function, [Static(owner, (0,)), *known], {}, set())
    except NotNative as reason:
        value = reason
    return function, value, program, names


def left_to_python(case: str) -> list[str]:
    """Return why a case has no native code, or discards some ticks; an empty text if it is native."""
    _, value, program, _ = native(case)
    reasons = [f"discards ticks: {reason.partition(', ')[2]}" for reason in program.seldom]
    if isinstance(value, NotNative):
        why = str(value).partition(", ")[2] or str(value)
        reasons.insert(0, f"not native: {re.sub('Error: .*', 'Error', why)}")
    return ["; ".join(line.strip() for line in case.splitlines()), *(f"    {r}" for r in reasons)] if reasons else []


CASES = {
    "numbers": """
        p + q * r - LEVEL
        p / q // r % 2.0
        i + j * i - 7
        i // j % 5
        i / j
        i & 6 | j ^ 1
        -p + +q
        ~i
        -self.gain
        -self.count
        -self.large
        +self.on
        -LEVEL
        -self.edge
        -self.beyond
        self.edge + i
        self.beyond + i
        limited(self.edge)
        limited(self.beyond)
        p ** 2
        p ** self.gain
        LEVEL ** 2 + 2 ** 3 + (1 << 4) - (32 >> 2)
        self.count * 2 + self.gain
        self.gain * self.gain
        self.large + 1
        self.count // 0
        i ** 2
        z ** 2
        i << 1
        z * 2.0 - 1.5
        z + self.spin
        u + 1.0
        p + u
        u * i
        u ** 2
        'down' + self.word
        self.word + str(p)
        yes + 1
        yes * i
        (i + 1) * 1000000
        p * i
        p @ q
        v + v
        v[0] + v[-1]
        1e999
        -(1e999)
        1e999 - 1e999 + p
        p + float('inf')
        p * -float('inf')
        p + float('nan')
        z + complex(1, 2)
        z * 1j
        """,
    "tests": """
        p < q
        p <= q
        p > q
        p >= q
        p == q
        p != q
        p < q < r
        p < q + 1.0
        p < 1.0 <= r
        1.0 < 2.0 < p
        2.0 < 1.0 < p
        p < q and q < r
        p < 2.0 > 1.0
        p < 1.0 > 2.0
        p < 1.0 < 2.0 < r
        p < p + 1.0 < r
        self.gain < 1.0
        self.count < 5
        self.large < 5
        self.table == self.table
        nil < p
        none is None
        none is not None
        nil is None
        nil is not None
        p is None
        p is not None
        self.nothing is None
        self.nothing is not None
        (p, q) is None
        m is not None
        m is None
        self.word is self.word
        self.word is not None
        p is q
        i in (1, 2, 3)
        i not in (1, 2, 3)
        p in (q, 0.5)
        self.count in (1, 4)
        self.count not in (1, 4)
        self.word in ('up', 'down')
        'low' in self.named
        i in self.whole
        not p
        not yes
        not self.on
        not self.nothing
        not (p < q)
        not self.count
        bool(p)
        bool(i)
        bool(z)
        bool(yes)
        bool(self.gain)
        bool(self.large)
        bool(self.spin)
        bool(self.edge)
        1.0 if self.edge else 2.0
        1.0 if self.beyond else 2.0
        1.0 if self.gain else 2.0
        1.0 if self.spin else 2.0
        bool(self.beyond)
        bool(-self.beyond)
        self.edge < 1
        self.beyond < 1
        1.0 if q > 0.0 or max(p, q, r) > 1.0 else 2.0
        1.0 if q < 0.0 or max(p, q, r) > 1.0 else 2.0
        1.0 if p > 0.0 and max(p, q, r) > 1.0 else 2.0
        1.0 if q > 0.0 or max(p, q, r) > 1.0 or yes else 2.0
        1.0 if not (q > 0.0 and max(p, q, r) > 1.0) else 2.0
        1.0 if q > 0.0 or max(p, q, r) > 1.0 and self.on else 2.0
        1.0 if u > 0.0 or max(p, q, r) > 1.0 else 2.0
        p > 0.0 and max(p, q, r)
        p or max(p, q, r)
        q < p < max(p, q, r) < 9.0
        bool(self.word)
        bool(e)
        bool(())
        bool(m)
        bool(some)
        bool(nil)
        bool(none)
        bool(u)
        bool(v)
        bool(line)
        1.0 if self.named else 2.0
        p if yes else q
        p if self.on else q
        p if self.nothing else q
        p if p < q else i
        (p, 1) if yes else (q, 2)
        (p, 1) if yes else (q, 2.0)
        'up' if yes else 'down'
        2 if yes else 2
        none if none is not None else p
        1.0 if none is None else none
        {'a': p} if yes else {'a': q}
        {'a': p} if yes else {'b': q}
        math.sqrt(p) if p > 0.0 else self.half(q)
        str(p) if q > 0.0 else p
        str(p) if q < 0.0 else p
        p if q < 0.0 else str(p)
        never(p) if q > 0.0 else p
        never(p) if q < 0.0 else p
        p or q
        p and q
        p or q or r
        yes and i
        yes or p < q
        self.on or p
        self.on and p
        self.nothing or p
        self.nothing and p
        p and self.half(q)
        p < q and (p or q)
        1.0 if p and q else 2.0
        1.0 if p or q else 2.0
        1.0 if p or self.half(q) < 0.1 else 2.0
        1.0 if p and limited(q) < r and on else 2.0
        1.0 if p and self.on else 2.0
        1.0 if p or self.on else 2.0
        1.0 if p and self.nothing else 2.0
        1.0 if p or self.nothing else 2.0
        1.0 if self.on and p else 2.0
        1.0 if not (p and limited(q)) else 2.0
        1.0 if u or p else 2.0
        1.0 if u and limited(u) > 1.0 else 2.0
        1.0 if yes and str(p) else 2.0
        1.0 if p < 0.0 and str(p) else 2.0
        """,
    "parts": """
        (p, i)[0]
        (p, i)[-1]
        (p, i)[2]
        (p, i)[-2]
        (p, i)[-3]
        (p, q, r, i, j)[self.count]
        e[self.whole[0]]
        m[self.low]
        e[0] + e[-1]
        e[3]
        e[-3]
        e[-4]
        e[2]
        e[i % 3]
        mixed[0]
        mixed[i % 2]
        mixed
        long[1]
        long[1:]
        tuple(long)
        e[1:]
        e[:-1]
        e[::2]
        e[::-1]
        e[i:]
        (p, q, r)[1:]
        (*e, p)
        [*mixed, *e[:1]]
        (1, 2.0)
        (self.gain, 1)
        (*self.whole, 4)
        e + (p,)
        e + mixed
        (p,) * 3
        (p,) * self.count
        e * p
        e - e
        x.a + x.k + x.pair[1]
        x.last
        x.twice
        x.more(p)
        x.nothing
        x[0]
        x._replace(a=p)
        x._replace(pair=(p, q), last=r)
        x._replace(pair={'a': p})
        x._replace(pair=(p, {'a': p}))
        x._replace(a=u)
        x._replace(a=may)
        Kept(d)
        Kept(p, 1)
        Kept(k=2, a=p)
        Kept(p, last=q)
        Row()
        Kept._make((p, 1, (q, r), None))
        self.kept.a
        self.kept
        x if yes else self.kept
        point.a * point.norm()
        point.SCALE * point.b
        point.nothing
        Point(p)
        Point(p, b=q)
        Point()
        line.start
        line.at(p)
        line.at(may)
        line.at(p, q)
        line.none(p)
        line.at(p, slope=q)
        line
        line.start * 2.0
        line.none
        z.real + z.imag
        p.real
        z.conjugate()
        i.real
        (p, q).real
        v.shape
        v.size
        v.sum()
        v.tolist()
        flat.tolist()
        self.gain
        self.count
        self.word
        self.absent
        self.table
        self.table[1]
        self.table[i % 4]
        self.table[9]
        self.table[1:3]
        self.whole[i % 3]
        self.array[0]
        self.array[i % 3]
        self.array
        self.long[i]
        self.long
        self.sixteen[i]
        self.seventeen[i]
        self.array[::2]
        self.many[0]
        self.many[i]
        self.many
        len(self.many)
        self.rows[0]['v']
        self.rows[i % 2]['v']
        self.named['low']
        self.named['none']
        self.named[self.word]
        self.by_number[i % 3]
        self.by_number[2]
        self.by_pair[i % 2, 1 - i % 2]
        self.by_number.get(i)
        self.by_number.get(2)
        self.by_number.get(7)
        self.by_number.get(7, 1.0)
        self.view['one']
        m['low'] - m['high']
        m['none']
        m.get('low')
        m.get('none')
        m[p]
        d['high'] - d['low']
        d
        {**d, 'low': p}
        {**m, 'more': 1.0}['more']
        {'low': p, 'high': q}
        {'b': (p, {'a': q}), 'a': 1}
        {1: p}
        {str(p): p}
        {**p}
        parted(p)['row'][1]
        parted(p)['in']['a']
        parted(p)
        {k: p * v for k, v in self.named.items()}
        {k: 1.0 for k in ('a', 'b')}
        {k: 1.0 for k in (1, 2)}
        p[0]
        none[0]
        u[0]
        x.pair[i % 2]
        x.pair[:1]
        """,
    "calls": """
        abs(p)
        abs(i)
        abs(z)
        abs(yes)
        float(i)
        float(yes)
        float(p)
        int(p)
        int(yes)
        round(p)
        round(p, 1)
        bool(0.0)
        min(p, q)
        max(p, q, r)
        min(e)
        max(p, i)
        min(p, 1)
        max(i, 2)
        min(1, 2)
        max(self.gain, 1.0)
        max(self.count, 1)
        max([p, q])
        math.sqrt(p)
        math.sqrt(4.0)
        math.sqrt(-1.0)
        math.sin(p) + math.cos(p) + math.tan(p)
        math.asin(p / 4.0) + math.acos(p / 4.0)
        math.exp(p) + math.log(p)
        math.log2(p) + math.log10(p) + math.log1p(p)
        math.expm1(p) + math.sinh(p) + math.cosh(p)
        math.tanh(p) + math.atan(p) + math.asinh(p)
        math.atan2(p, q) + math.copysign(p, q)
        math.floor(p) + math.ceil(p) + math.trunc(p)
        math.fmod(p, r) + math.remainder(p, r)
        math.fabs(q) + math.radians(p) + math.degrees(p)
        math.isfinite(p)
        math.isnan(p) or math.isinf(q)
        math.gamma(p)
        math.hypot(p, q)
        cmath.phase(z)
        cmath.rect(p, q)
        cmath.exp(z)
        complex(p, q)
        complex(p)
        bisect_right(TABLE, p)
        bisect_left(self.table, p)
        bisect_right(self.array, p)
        power(p, 2.0)
        total(e)
        sum(e)
        sum([1, 2, i])
        sum([v > p for v in e])
        sum(self.whole)
        any(v > p for v in e)
        all(v > p for v in e)
        any([])
        all(())
        any((p, self.on))
        all((p, self.on))
        any((self.nothing, 0))
        all((1, True))
        all((p, 0))
        any(v > 0.0 for v in v)
        len(e)
        len((p, q, r))
        len(v)
        len(some)
        len(self.table)
        len('four')
        isinstance(p, float)
        isinstance(none, float)
        isinstance(x, tuple)
        isinstance(self.word, str)
        getattr(self, 'gain')
        getattr(x, 'a')
        getattr(self, 'ga' + 'in') + p
        tuple(e)
        list(e)
        list(zip(e, self.table))
        list(zip(e, *((self.whole, (p, q, r)))))
        list(zip(e, v))
        list(enumerate(e, 1))
        list(enumerate(self.whole))
        list(reversed(e))
        list(map(abs, e))
        list(map(self.half, e[:2]))
        zip(e, e)
        enumerate(e[:1])
        reversed(self.whole)
        list(range(3))
        list(range(1, 8, 3))
        list(range(16))
        list(range(17))
        list(range(i))
        [v * p for v in e]
        [k * p for k in range(2) for l in range(k + 1)]
        [v for v in self.whole if v != 2]
        [v for v in e if v > 0.0]
        [p for _ in v]
        [w * v for v, w in zip(self.table[:2], e)]
        [a for a, *rest in ((p, 1), (q, 2))]
        np.array([p, 1.0, i])
        np.array([z])
        np.sin(p)
        np.add(p, q)
        limited(p)
        limited(p, most=q)
        limited(p, *(q, r))
        limited(p, **{'least': q})
        limited(p, **p)
        limited(p, *v)
        limited(p, none=1.0)
        limited()
        limited(*e)
        limited(self.gain)
        limited(1.0)
        limited(may)
        limited(limited(p), q)
        sum_all(p, 1.0, a=q)
        sum_all(*e)
        itself(p)
        never(p)
        signed(p)
        Gain(2.0)(p)
        applied(math.sin, p) + applied(math.cos, p)
        applied(self.gainful, p) + applied(self.lent, p)
        self.half(p)
        self.half(p, 4)
        self.gainful(p)
        self.gainful(p, more=q)
        self.gainful.own(p)
        self.lent(p)
        self.laws[0](p)
        self.laws[1](p)
        self.third(i % 3)
        self.bound(p)
        self.bound(p, least=q)
        partial(limited, 2.5)(p)
        self.draws(i)
        self.newest(p)[1]
        self.age('near')
        self.age('far')
        self.age('none')
        self.age(i)
        doubled(p)
        doubled(e)
        doubled(self.gain)
        self.view.get('one')
        list(self.named.items())
        list(self.named.values())
        list(self.named.keys())
        list(self.named)
        max(self.named.values())
        self.named.pop('low')
        p(q)
        absent(p)
        str(p)
        repr(self.count)
        pow(p, q)
        divmod(i, 2)
        print(p, sep='')
        x.absent()
        p.hex()
        (lambda v: v)(p)
        f'{p}' == 'up'
        len(f'{p}')
        {f'{p}': 1.0}
        1.0 if f'{p}' else 2.0
        self.named[f'{p}']
        f'{p}' + 'up'
        [p for p in [1.0]][0]
        (w := p * q) + w
        {1, 2}
        lambda: p
        """,
}
"""More than an expression: functions of several lines, parted by empty ones."""
LONGER = """
a, b = p, q
a, b = b, a
return a - b

a, *b, c = (p, 1, q, r)
return a * c + b[1], b

a, b = e
return a

(a, b), c = (p, q), r
return a + b * c

a: float = p
a += q
a *= r
a -= 1.0
return a

self.gain = p

e[0] = p

self.count += 1

a = b = p + q
return a * b

v[1] = p
return v[0]

v[i % 3] += p
return v[1]

flat[0] = p
return p

pass
"only words"
return None

return

p + q

limited(q)

if p > q:
    return p
return q

if p > q:
    return p
elif q > 1.0:
    return q

if yes:
    a = p
else:
    a = 1
return a

if yes:
    a = p
else:
    a = None
return a

if yes:
    a = None
else:
    a = p
return a

if yes:
    a = p
return a

a = 0.0
if yes:
    a = p
return a

a, b = p, (q, r)
if yes:
    a, b = q, (p, q)
return a, b

a = {"low": p}
if yes:
    a = {"low": q}
return a["low"]

a = {"low": p}
if yes:
    a = {"high": q}
return a

a = (p, q)
if yes:
    a = (p, q, r)
return a

a = "up"
if yes:
    a = "up"
return p if a == "up" else q

a = self
if yes:
    a = x
return a.a

if self.on:
    return p
return str(p)

if self.nothing:
    return str(p)
else:
    a = 2.0
return a * p

if q > 0.0:
    return str(p)
return p

if q < 0.0:
    return str(p)
return p

if q < 0.0:
    return p
return str(p)

if q < 0.0:
    return p
a = p + 1.0
if p > 3.0:
    return str(p)
return a

if u > 0.0:
    return str(p)
return p

if q > 0.0:
    a = x.a
    if a > 0.0:
        a = str(p)
else:
    a = p
return a

if p > 0.0:
    raise ValueError("bad")
return p

raise ValueError(f"{p}")

if q > 0.0:
    never(p)
return p

assert p > 0.0
return p

assert self.on
assert self.nothing
return p

assert self.on, "reports"
return q

assert p > 0.0 and never(p)
return q

while p > 0.5:
    p = p * 0.5
return p

a = 0
while a < i:
    a = a + 1
    if a == 2:
        continue
    if a * p > 5.0:
        break
return a

while True:
    p = p - 1.0
    if p < 0.0:
        return p

a = 0
while a < 3:
    a += 1
else:
    a = 9
return a

for a in e:
    p = p + a
return p

for a in e:
    p = a
else:
    p = 1.0
return p

for a in e:
    if a > p:
        break
return p

for a in e:
    if a > p:
        return a
return q

for a, b in zip(e, self.table):
    p = a * p + b
return p

for k in range(i):
    p = 0.5 * p + k
return p

for k in range(1, i, 2):
    p = p + k
return p, q

for k in range(3):
    if k == 1:
        continue
    p = p + k
return p

for k in range(20):
    p = 0.5 * p + k
return p

for k in v:
    p = p + k
return p

for a, b in range(i):
    p = p + a
return p

for k in range(i):
    a = p + k
return a

b = (p, q)
for k in range(i):
    b = (b[1], b[0] + k)
return b

b = (p, q)
for k in range(i):
    b = (b[0],)
return b

b = (p, q)
for k in range(i):
    b = (b[1], b[0])
    if k > 2:
        break
return b

b = None
for k in range(i):
    b = p
return b

b = "up"
for k in range(i):
    b = p
return b

for k in range(i):
    b = [p * j for j in (1.0, 2.0)]
    p = b[0] - b[1]
return p

for k in range(i):
    x = x._replace(a=x.a + k)
return x

for k in range(i):
    for l in range(k):
        p = p + l
    p = max(p, q, [a * p for a in e][0])
return [a * p for a in e]

while p > 1.0:
    p = p - 1.0
    if p < 3.0:
        break
        p = q
return p

while p > 1.0 and max(p, q, r) > 1.5:
    p = p - 1.0
return p

if yes:
    a = u
else:
    a = p
return a

if yes:
    a = p
else:
    a = u
return a

if u > 0.0:
    a = p
else:
    a = q
return a

if u > 0.0:
    a = u
else:
    a = e
return a

for a in e:
    if a > 2.0:
        return p
    elif a < -1.0:
        p = q
return p

while p > 1.0 and limited(p) > 1.0:
    p = p - 1.0
return p

a = [p]
a.append(q)
a.append(r * a[0])
return a

a = [p]
for b in e:
    a.append(b * a[0])
return a[3]

a = {"low": p}
a["high"] = q

del p

try:
    a = p
except ValueError:
    a = q
return a

with p:
    pass

import math

global LEVEL

def inner(a):
    return a
return inner(p)

yield p

if p > q:
    b = self.half(p)
    b = b + self.half(b)
else:
    b = self.half(q)
return b * self.half(p)

if yes:
    a = (p, {"in": q})
else:
    a = (q, {"in": p})
return a[1]["in"]

a, b, c = p, 0.0, 1
for k in self.whole:
    if k == 2:
        a = a + k
    if p > k:
        b = b + a
        c = k
return a, b, c
"""
REPORTS = """
self.report(Level.WARN, "key", "only words")
return p

if p > 1.0:
    self.report(Level.WARN, "key", f"{p} of {self.gain:.2f}, {i:>5}, {z!r}, {yes!s}, {self.word!a}")
return p

self.report(Level.ERROR, "key", f"{e} and {x} and {m['low']:g} of {self.count}")
return p

self.report(Level.ERROR, "key", f"{self.table}")
return p

self.report(Level.ERROR, "key", f"{self.whole}, {self.large}, {self.spin}, {self.nothing}")
return p

self.report(Level.ERROR, "key", f"{self.kept}")
return p

self.report(Level.WARN, "key", f"{Point(p, q)}, {Kept(p, last=q)}, {(p, i)}")
return p

self.report(Level.WARN, "key", f"{point}, {line}")
return p

self.report(Level.ERROR, "key", f"{m}")
return p

self.report(Level.ERROR, "key", f"{v[0]} {v}")
return p

self.report(Level.WARN, "key", f"{none}")
return p

self.report(Level.WARN, f"{p}", "words")
return p

self.report(Level.WARN, "key", self.word)
return p

self.report(Level.WARN, "key", "a" + "b")
return p

self.report(Level.WARN, "key", f"{p:{i}}")
return p

self.report(Level.WARN, "key", f"{str(p)}")
return p

self.report(Level.WARN, "key", text="words")
return p

self.report(Level.WARN if yes else Level.ERROR, "key", "words")
return p

if p > 5.0:
    a = str(p)
    self.report(Level.WARN, "key", a)
return p

if p > 0.0:
    a = str(p)
    self.report(Level.WARN, "key", a)
    return q
return p

for a in e:
    if a > p:
        self.report(Level.WARN, "key", f"{a}")
return p
"""
ALL = {
    **{name: [line.strip() for line in text.strip().splitlines()] for name, text in CASES.items()},
    "statements": LONGER.strip().split("\n\n"),
    "reports": REPORTS.strip().split("\n\n"),
}
EACH = [case for cases in ALL.values() for case in cases]
# Cases whose generated code depends on whether numba or Python runs it.
UNTYPED = [*ALL["numbers"], *ALL["parts"], *ALL["reports"]]
LINES = sum(len(ALL[name]) for name in CASES)


def test_constructs_left_to_python_are_expected_with_their_reason() -> None:
    check_expected("native", (line for case in EACH for line in left_to_python(case)))


def in_native(value: Any) -> Any:
    """Return a Python value in its native form: mappings as tuples in the order of keys, objects as fields."""
    if isinstance(value, dict):
        return tuple(in_native(value[k]) for k in sorted(value))
    if isinstance(value, (np.ndarray, np.generic)):
        return in_native(value.tolist())
    if dataclasses.is_dataclass(value) or isinstance(value, Line):
        value = packed(value)
    if isinstance(value, (list, tuple, zip, enumerate, reversed, map, type({}.items()), type({}.values()))):
        return tuple(map(in_native, value))
    return value


def values_of(name: str, k: int) -> tuple[Any, dict[str, Any]]:
    """Return the k-th value of an argument in Python, and its native parts by their names there."""
    known, other = GIVEN[name]
    if isinstance(known, Record):
        value = other if k else {key: sample_of(v) for key, v in known.items.items()}
        return value, value
    value = other if k or known.sample is UNKNOWN else unpacked(known.sample)
    if known.keys and not k:
        value = dict(zip(known.keys, value, strict=True))
    return value, {name: in_native(value) if known.keys else value}


def calling(case: str, typed: bool, owner: Owner | None = None) -> Any:
    """Return functions that call the native text of a case and its Python, and what both report; None without a text.

    The text is called for another owner where one is given.
    """
    function, value, program, names = native(case, typed)
    if isinstance(value, NotNative):
        return None
    code = Writer(program, None, {}).code(value) if not isinstance(value, Static) else None
    running = ByHand(owner := owner or Owner())
    words = TEXTS if typed else {w: text for w, text in TEXTS.items() if w not in OWN}
    scope = {
        "same_": same,
        "only_floats": only_floats,
        "sum_of_products": sum_of_products,
        **BASE,
        **({} if typed else OWN),
        **program.names,
    }
    scope |= {name: thing.py_func for name, thing in program.names.items() if isinstance(thing, Jit)}
    for text in [*(words[w] for w in sorted(program.words) if w in words), *program.functions]:
        exec(text, scope)
    tables = dict(zip(program.arrays.values(), program.tables([owner]), strict=True))
    tables |= {name: np.append([0.0, 0.0], np.random.default_rng(1).random(10)) for name in program.draws.values()}
    scope |= tables | {"c": program.constants([owner]), "n": [0, 0, 0], "when": [7_000_000_000, 0]}
    scope["reports"] = [0.0] * program.reports.size

    def call(values: dict[str, Any]) -> Any:
        scope.update({k: packed(v, typed) for k, v in values.items()})
        return value.value if code is None else eval(code, scope)

    def python(*arguments: Any) -> Any:
        return function(owner, *arguments)

    def reported() -> Any:
        """Return the native reports, and those in Python."""
        other = ByHand(Owner())
        program.reports.record(scope["reports"], [other])
        running.store_reports()
        return other.reports, running.reports

    return names, call, python, reported


@pytest.mark.parametrize("typed", [True, False])
def test_the_text_gives_what_python_gives(typed: bool) -> None:
    """With the values it was written for, and with others; or it discards the tick."""
    equal = 0
    for case in EACH if typed else UNTYPED:
        # These cases load numba, which other tests cover.
        if "doubled" in case or (result := calling(case, typed)) is None:
            continue
        names, call, python, reported = result
        for pick in itertools.product(*([0, 1] for _ in names)):
            values = [values_of(name, k) for name, k in zip(names, pick, strict=True)]
            try:
                result = call({k: v for _, native in values for k, v in native.items()})
            except NATIVE:
                continue
            try:
                wanted = python(*(value for value, _ in values))
            except Exception as error:
                wanted = repr(error)
            assert repr(in_native(result)) == repr(in_native(wanted)), (case, names, pick)
            equal += 1
        natively, wanted = reported()
        assert natively == wanted, case
    assert equal > (1000 if typed else 250)


# By attribute: another value, and the attribute itself if its values cannot share code.
CHANGES: dict[str, tuple[Any, str]] = {
    "gain": (7.5, ""),
    "array": (np.zeros(9), ""),
    "table": ([0.5, 0.5], "table"),
    "count": (5, "count"),
    "word": ("up", "word"),
    "nothing": (0.0, "nothing"),
    "whole": ((1, 2, 3.0), "whole"),
    "named": ({"low": -0.5, "high": 1.0}, "named"),
    "rows": (({"u": 1.0, "v": 2.0}, {"v": 3.0, "u": 4.5}), "rows"),
    "gainful": (Gain(9.0), ""),
    "lent": (Gain(2.0).own, ""),
    "bound": (partial(limited, most=2.0), "bound"),
    "laws": ((Gain(1.0).own, Gain(1.5).own), "laws"),
    "kept": (Kept(a=1.0), "kept"),
    "edge": (3, ""),
}


def changed(program: Program, name: str, value: Any) -> Owner:
    """Return an owner like the one of a program, with one attribute changed."""
    other = Owner()
    other.half, other.gainful, other.laws = program.roots[0].half, program.roots[0].gainful, program.roots[0].laws
    setattr(other, name, value)
    return other


def test_native_code_shared_with_another_block_returns_the_values_of_its_python() -> None:
    """Whatever differs in that block is passed in, or the text is refused for it."""
    shared = refused = 0
    for case in EACH:
        for name, (value, _) in CHANGES.items():
            value_of_call, program = native(case)[1:3]
            # A constant answer is not an argument of the code, because the caller inserts it.
            if f"self.{name}" not in case or "doubled" in case or isinstance(value_of_call, Static):
                continue
            other = changed(program, name, value)
            if program.differs([other]):
                refused += 1
                continue
            if (result := calling(case, True, other)) is None:
                continue
            names, call, python, _ = result
            values = [values_of(argument, 0) for argument in names]
            with suppress(*NATIVE):
                natively = call({k: v for _, native in values for k, v in native.items()})
                assert repr(in_native(natively)) == repr(in_native(python(*(v for v, _ in values)))), (case, name)
                shared += 1
    assert min(shared, refused) > 10, (shared, refused)


def native_or_why(body: str, **keywords: Any) -> str:
    """Return why a function of some arguments is not native; empty if it is."""
    text = f"def case({', '.join(keywords)}):\n    return {body}\n"
    name = f"<{text}>"
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    scope = dict(GLOBALS)
    exec(compile(text, name, "exec"), scope)
    try:
        specialise(Program([Owner()], Writer), scope["case"], list(keywords.values()), {}, set())
    except NotNative as why:
        return str(why).partition(", ")[2]
    return ""


@pytest.mark.parametrize(("body", "of"), [("a.pop() * 2.0", [0.5, 1.5]), ("next(a)", iter([0.5]))])
def test_a_call_that_changes_its_object_is_not_evaluated_during_translation(body: str, of: Any) -> None:
    """Otherwise it would be called once for all ticks, in addition to the calls of Python."""
    assert "which changes an object outside of the state" in native_or_why(body, a=Static(of))
    assert list(of) == ([0.5] if body == "next(a)" else [0.5, 1.5])


@pytest.mark.parametrize(
    ("body", "made_of", "why"),
    [
        ("tuple(a)", lambda n: {"a": Dynamic("a", (1.0,) * n)}, "a tuple of 65, expected at most 64"),
        ("a.tolist()", lambda n: {"a": Dynamic("a", np.ones(n))}, "an array of 65 as a list, expected at most 64"),
        ("a[0]", lambda n: {"a": Dynamic("a", (1.0,) * n)}, ""),
        ("TABLE[k]", lambda n: {"TABLE": Static((1.0,) * n), "k": Dynamic("k", 1)}, "a table of 65, expected"),
        (
            "a[k]",
            lambda n: {"a": Static(dict.fromkeys(range(n), 0.5)), "k": Dynamic("k", 1)},
            "a mapping of 65, expected",
        ),
        ("[p for _ in range(k)]", lambda n: {"k": Static(n - 48), "p": Dynamic("p", 1.0)}, "a list of no fixed length"),
    ],
)
def test_the_length_of_unrolled_code_is_limited(body: str, made_of: Any, why: str) -> None:
    """To 64 parts, and loops of 16 turns."""
    assert native_or_why(body, **made_of(64)) == ""
    result = native_or_why(body, **made_of(65))
    assert why in result if why else not result


def test_reports_are_collected_as_if_they_were_reported_one_by_one() -> None:
    """Places of two blocks, some with the same key, reached in any order; the counts continue."""
    scope: dict[str, Any] = {}
    exec(TEXTS["reported_"], scope)
    for seed in range(20):
        rng = random.Random(seed)
        reports, natively, wanted = Reports(), [ByHand(Owner()), ByHand(Owner())], [ByHand(Owner()), ByHand(Owner())]
        keys = [(rng.randrange(2), rng.choice("abc"), rng.choice([Level.WARN, Level.ERROR])) for _ in range(6)]
        at = [
            reports.add(b, level, key, lambda row, k=k: f"{k}: {row[0]} {row[1]}", 2)
            for k, (b, key, level) in enumerate(keys)
        ]
        for _ in range(2):
            table = [0.0] * reports.size
            for _ in range(rng.randrange(12)):
                k, row = rng.randrange(6), (rng.random(), rng.random())
                scope["reported_"](table, at[k], row)
                block, key, level = keys[k]
                wanted[block].block.report(level, key, f"{k}: {row[0]} {row[1]}")
                wanted[block].store_reports()
            reports.record(table, natively)
            assert [list(b.reports.items()) for b in natively] == [list(b.reports.items()) for b in wanted]


def test_the_values_in_which_another_block_may_differ_are_those_passed_in() -> None:
    """Not those that affect the text, nor objects within a table, nor its length."""
    program = Program([Owner()], Writer)
    writer = Writer(program, None, {})
    own = Static(program.roots[0], (0,))
    node = written_out("p")[0]  # any node will do

    def attribute(*names: str) -> Any:
        value: Any = own
        for name in names:
            value = writer.attribute(value, name, node)
        return value

    program.slot(attribute("gain"))
    program.slot(attribute("table"))
    program.slot(attribute("array"))
    for name in ("count", "word", "nothing", "whole", "named", "rows", "gainful", "lent", "bound", "laws", "kept"):
        program.guard(attribute(name))
    assert program.differs([program.roots[0]]) == ""
    for name, (value, differs) in CHANGES.items():
        assert program.differs([changed(program, name, value)]) == differs, name
    other = Owner()
    del other.word
    assert program.differs([other]) == "word"
    assert program.constants([Owner()]) == (0.625, (0.5, -0.25, 1.5, 2.0))
    assert [table.tolist() for table in program.tables([Owner()])] == [[1.0, 2.0, 3.0]]
    assert [written(path) for path in ((0, ("attr", "a"), ("item", 1)), (0, ("item", "k"), ("attr", "b")))] == [
        "a[1]",
        "['k'].b",
    ]


def test_a_text_that_adds_up_a_mapping_suits_only_blocks_with_its_order_of_keys() -> None:
    class Added:
        def __init__(self, **gains: float) -> None:
            self.gains = gains

        def total(self, x: float) -> float:
            result = 0.0
            for gain in self.gains.values():
                result = result + gain * x
            return result

    first, turned, other = Added(a=0.1, b=0.2, c=0.3), Added(c=0.3, b=0.2, a=0.1), Added(a=1.0, b=2.0, c=3.0)
    program = Program([first], Writer)
    specialise(program, Added.total, [Static(first, (0,)), Dynamic("x", 1.0)], {}, set())
    assert first.total(1.0) != turned.total(1.0)
    assert program.differs([turned])
    assert not program.differs([other])
