"""Laws with unusual Python: exported C has their bits, or the export is refused with class and line."""

import dataclasses
import enum
import math
import shutil
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pytest
from softrig_core import Block, ScenarioError, jit, rig_of
from softrig_core.export import c_files
from softrig_core.export.check import replayed
from softrig_core.export.command import c_of, export_c, export_rig
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc
from softrig_power.pv.mppt import MpptOptimiser, MpptParams

TABLE = (0.5, -1.5, 2.5, 3.25)


class Kept(NamedTuple):
    a: float = 0.0
    n: int = 0
    m: int = 1


class Law(DcMotorSmc):
    """Publishes `odd`, computed from its state, speed, reference and current."""

    def first(self):
        return Kept()

    def go_on(self, x, before):
        return x

    def update(self, x, t, *, state, sensors, reference):
        x, u = self.odd(x, state[0], 0.0 if reference is None else reference[0], sensors[1])
        return x, {"command": (max(-1e6, min(u, 1e6)),), "surface": (0.0,)}


class Names(Law):
    """Names that the C might use for its own variables."""

    def odd(self, x, w, r, i):
        u0, i0, b0, look0, t0_ = w + 1.0, r - w, w > 0.5, i * 3.0, TABLE[x.n % 4]
        v, v_l, v_j, va, l_v, k_k = w, r, i, 0.5, 0.25, 7.0
        for k in range(x.n % 5):
            v = v + 0.5 * v_l
            if v > 1.0:
                v_l = v_l - v_j
            k_k = k_k + k * v * va * l_v
        if b0 or (i0 > 0.1 and 1.0 / i0 > 3.0):
            u0 = u0 + i0 * 2.0 if t0_ > 0.0 else abs(look0)
        return x._replace(n=x.n + 1, a=u0), u0 + i0 + look0 + t0_ + v + v_l * 2 + v_j * 3 + k_k


def poke(a, v):
    a[0] = v
    return v


class Order(Law):
    """Chains that stop early, names bound in tests, zeros of both signs, an array that a call writes into."""

    def odd(self, x, w, r, i):
        k, h = 1, 9.0
        if w > 1.0 and (k := 3) > 2:
            h += 1.0
        q = (h := 4.0) if w > 0.7 else 2.0
        u = 1.0 if 0.0 < w < 1.0 / w else 2.0
        u += any(1.0 / v > 1.0 or v < 0.0 for v in (r + 1.0, w)) if r > -1.0 and w else 0.5
        z = -0.0 if w > 1.0 else 0.0
        a = np.array((w, r, i))
        u += a[0] + poke(a, 5.0) * a[0]
        j = 50
        for j in range(int(abs(w))):
            h += 0.5 * j
        y = w if w > 1.0 else None
        return x._replace(a=w), u + k + h + q + j + math.copysign(16.0, z) + (y or 3.0) + (0.5 if (y or x.a) else 0.25)


class Whole(Law):
    """Integers beside floats, near the limits of 64 bits and of 53."""

    def odd(self, x, w, r, i):
        n = (6364136223 * (x.n % 1000003) + 1442695) % 4294967296
        big = 9007199254740993 + x.m
        u = (1.0 if big - x.m == 9007199254740992.0 else 0.0) + (2.0 if w * 0.0 + 9007199254740992.0 < big else 0.0)
        far = 4611686018427387904 + x.m
        return x._replace(n=n, m=x.m + 1), u + n / 4294967296 + (-n // 7) % 5 + (far - x.n) % 11 + round(w * 2) / 2


@jit
def looped(a, n, u0, u0_l):
    v_l, v, i0 = 0.5, a, 2.0
    for k in range(n):
        v = v * 0.5 + v_l
        if v > 1.0:
            v_l = v_l - 0.1
            break
        i0 = i0 + u0 + k
    while v < 5.0:
        v = v + 1.0
        u0_l = u0_l + abs(v)
        if u0_l > 100.0:
            return -1.0
    m = np.zeros((2, 2))
    m[0, 0], m[1, 1] = a, u0
    row = m[0]
    row[1] = 7.0
    return v + v_l + i0 + u0 + u0_l + m[0, 1] + m[0, 0]


class Loops(Law):
    """A compiled function with loops that are left early, and rows of an array."""

    def odd(self, x, w, r, i):
        return x._replace(n=(x.n + 1) % 7), looped(w, x.n, r, i)


class Mode(enum.IntEnum):
    IDLE = 0
    RUN = 2


@dataclass(frozen=True)
class Größe:
    v: float = 0.0
    mode: int = Mode.IDLE


@dataclass(frozen=True)
class Outer:
    inner: Größe = Größe()
    pair: tuple[float, float] = (0.0, 1.0)
    n: int = 0


class Kinds(Law):
    """Dataclasses in dataclasses, enumerations, operations on bits, names beyond ASCII, `//` and `%` of negatives."""

    FACTORS = {Mode.IDLE: 0.5, Mode.RUN: 2.5}

    def first(self):
        return Outer()

    def odd(self, x, w, r, i):
        mode = Mode.RUN if w > 0.5 or (x.inner.mode == Mode.RUN and i > 0.0) else Mode.IDLE
        größe = dataclasses.replace(x.inner, v=0.5 * x.inner.v + w, mode=mode)
        k = (x.n << 3 >> x.n % 3 ^ 0x55) & ~(x.n % 7)
        u = self.FACTORS[mode] * größe.v + k + (x.n - 5) // -3 + (x.n - 5) % -3 + w % -0.7 + math.fmod(-w, 0.3)
        return Outer(größe, (x.pair[1], w), x.n + 1), u + x.pair[0] + (1.0 if x.inner == größe else 2.0)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt-get install gcc)")
@pytest.mark.parametrize(
    "law",
    [Kinds, *(pytest.param(law, marks=pytest.mark.long) for law in (Names, Order, Whole, Loops))],
    ids=lambda c: c.__name__,
)
def test_odd_laws_have_the_bits_of_python(law, tmp_path):
    done = export_c(
        rig_of("dc_motor_smc_b2", classes={"dc_motor_smc": law}), "dc_motor_smc", tmp_path, rows=80, drawn=90
    )
    assert not done.discards
    assert replayed(tmp_path, done.name).same


def push(a, v):
    a.append(v)


def stored(v, kept=[]):  # noqa: B006 - a mutable default, as users write it
    kept.append(v)
    return float(len(kept))


class Alias(Law):
    def odd(self, x, w, r, i):
        a = [w]
        b = a
        a.append(r)
        return x, b[-1]


class Added(Law):
    def odd(self, x, w, r, i):
        a = [w]
        b = a
        a += [r]
        return x, b[-1]


class Pushed(Law):
    def odd(self, x, w, r, i):
        a = [w]
        push(a, r)
        return x, a[-1]


class Default(Law):
    def odd(self, x, w, r, i):
        return x, stored(w)


class Now(Law):
    def odd(self, x, w, r, i):
        return x, w + 0.0 * time.time()


class Listed(Law):
    def odd(self, x, w, r, i):
        y = 0.0
        a = [y := y + v for v in (w, r, i)]
        return x, a[-1] + y


class Unbound(Law):
    def odd(self, x, w, r, i):
        if r > 1e9:
            z = w
        return x, (z if r > 1e9 else 0.0) + w


class Growing(Law):
    def odd(self, x, w, r, i):
        return x._replace(n=x.m, m=3 * x.m + x.n + (1 << 60)), w + x.n % 7


UNKNOWN = {"unknown": 1.0}


class Field(Law):
    def odd(self, x, w, r, i):
        return (x if r < 1e9 else x._replace(**UNKNOWN)) if w < 1e9 else x._replace(unknown=w), w


class Leaving(Law):
    def odd(self, x, w, r, i):
        for v in (w, r):
            if v > 1.0:
                break
        else:
            v = 3.0
        return x, v


class Compared(NamedTuple):
    a: float = 0.0

    def __eq__(self, other):
        return True

    def __add__(self, other):
        return Compared(self.a - other.a)


class Equal(Law):
    def odd(self, x, w, r, i):
        return x, 1.0 if Compared(w) == Compared(r) else 2.0


class Sum(Law):
    def odd(self, x, w, r, i):
        return x, (Compared(w) + Compared(r))[0]


class Doubled(Kept):
    def __new__(cls, a):
        return super().__new__(cls, 2.0 * a)


class Created(Law):
    def odd(self, x, w, r, i):
        return x, Doubled(w).a


@dataclass(frozen=True)
class Limited:
    a: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "a", min(self.a, 0.5))


class Post(Law):
    def first(self):
        return Limited()

    def odd(self, x, w, r, i):
        return Limited(x.a + w), x.a


REFUSED = {
    Equal: r"Equal.odd, line \d+: Compared, which has __eq__ of its own",
    Sum: r"Sum.odd, line \d+: Compared, which has __add__ of its own",
    Created: r"Created.odd, line \d+: Doubled, which has a __new__ of its own",
    Post: r"Post, line \d+: its state is of the type Limited, .*; instead, keep numbers",
    Alias: r"Alias.odd, line \d+: a may be a list with another name",
    Added: r"Added.odd, line \d+: a may be a list with another name",
    Pushed: r"push, line \d+: a may be a list with another name",
    Default: r"stored, line \d+: kept may be a list with another name",
    Now: r"Now.odd, line \d+: time, which does not depend on its arguments alone",
    Listed: r"Listed.odd, line \d+: `:=` in a list",
    Unbound: "Unbound.odd: z has no value on some paths",
    Growing: "Growing, line .* at 0.0[12] s: a whole number that has no place in 64 bits in .*Growing.odd",
    Leaving: r"Leaving.odd, line \d+: else of a loop",
}


@pytest.mark.parametrize("law", REFUSED, ids=lambda c: c.__name__)
def test_constructs_that_c_computes_differently_are_refused(law):
    with pytest.raises(ScenarioError, match=REFUSED[law]):
        c_of(rig_of("dc_motor_smc_b2", classes={"dc_motor_smc": law}), "dc_motor_smc", rows=4, drawn=2)


class Huge(Law):
    def odd(self, x, w, r, i):
        return x, float(int(w * 1e19) % 7)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt-get install gcc)")
def test_a_random_call_with_an_integer_beyond_64_bits_may_be_discarded(tmp_path):
    done = export_c(
        rig_of("dc_motor_smc_b2", classes={"dc_motor_smc": Huge}), "dc_motor_smc", tmp_path, rows=4, drawn=60
    )
    assert [reason.rpartition(" in ")[0] for reason in done.discards] == ["a whole number that has no place in 64 bits"]
    result = replayed(tmp_path, done.name)
    assert result.same
    assert result.gave_up >= 1


def test_a_field_that_does_not_exist_is_refused_in_c():
    done = c_of(rig_of("dc_motor_smc_b2", classes={"dc_motor_smc": Field}), "dc_motor_smc", rows=4, drawn=2)
    assert [reason.partition(": ")[2] for reason in done.discards] == [
        "** of something that is not written out",
        "_replace of Kept by what is none of its fields",
    ]


def test_a_text_with_another_answer_than_the_run_is_refused(monkeypatch):
    own = c_files.law_of

    def wrong(*arguments):
        law = own(*arguments)
        return replace(law, texts={name: text.replace(" - ", " + ") for name, text in law.texts.items()})

    monkeypatch.setattr(c_files, "law_of", wrong)
    with pytest.raises(ScenarioError, match=r"another result than Python at .* s: a defect of softrig"):
        c_of(rig_of("dc_motor_smc_b2"), "dc_motor_smc", rows=20, drawn=2)


class Steady(Block[MpptParams]):
    """A constant duty."""

    ports = classmethod(lambda cls, params: MpptOptimiser.ports(params))

    def first(self):
        return 0

    def update(self, x, t, **inputs):
        return x + 1, {"command": (0.45,), "state": (0.45,) * 7}


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt-get install gcc)")
def test_rows_of_a_rig_end_with_those_of_a_node(tmp_path):
    patterns = {"times": [0.0, 0.01], "irradiance": [1000.0, 800.0, 600.0, 400.0, *[1000.0] * 4]}
    over = {f"shading_source.{name}": value for name, value in patterns.items()}
    rig = rig_of("pv_mppt", overrides=over, classes={"mppt_optimizer": Steady})
    done, _ = export_rig(rig, tmp_path, rows=50)
    assert done.ends == "pv_plant: the rows end at 0.01 s: _source is asked for another value"
    result = replayed(tmp_path, done.name)
    assert result.rows == 10
    assert result.same
