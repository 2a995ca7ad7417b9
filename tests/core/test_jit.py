"""Native loops: the bits of plain Python, a cache that knows its content, and no import before the first use."""

import enum
import math
import os
import subprocess
import sys
import textwrap
import types
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import pytest
from conftest import PATIENCE
from faultrig import Gain
from numpy import mean as average
from softrig_core import Block, BlockParams, jit, number
from softrig_core.kit import jit as module
from softrig_core.kit.jit import Jit, power
from softrig_nodes.rehearsal import rehearse

RELAY = '''
"""A relay over a delay line with every function of the C library that a model uses."""
import math, os, sys
import numpy as np
from softrig_core.kit import dde, ode
from softrig_core.kit.jit import jit, power
import helper

@jit
def wobble(x, y):
    if x > 0.3:
        return math.sin(x) * math.exp(-y * y) + math.tanh(x - y)
    if x < -0.3:
        return math.cos(3.0 * x) - math.sqrt(abs(y)) + math.log1p(abs(x)) + math.atan2(x, y)
    return power(abs(x) + 0.1, 1.7) - power(y, 3.0) + power(2.0, x) + x % 0.7 + x // 0.3

@jit
def run(line, gain, out):
    x, sign = 0.1, 1.0
    for k in range(out.size):
        late = line[k % line.size]
        for _ in range(3):
            x += 0.05 * (wobble(late, x) - x + helper.relay(late, sign) * gain)
        if abs(x - late) > 0.5:
            sign = -sign
        line[k % line.size] = x
        out[k] = x

out = np.empty(20000)
assert "numba" not in sys.modules  # before the first call
run(np.full(37, 0.2), helper.GAIN, out)
assert ("numba" in sys.modules) == (os.environ.get("SOFTRIG_JIT") != "0")
sys.stdout.buffer.write(out.tobytes())
'''
HELPER = """
from softrig_core.kit.jit import jit
GAIN = 0.8

@jit
def relay(x, sign):
    return sign * FACTOR if x > 0.0 else -sign * FACTOR

FACTOR = 1.25
"""


def relay(folder, **environment):
    env = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), **environment}
    done = subprocess.run([sys.executable, "relay.py"], cwd=folder, env=env, capture_output=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr.decode()
    return np.frombuffer(done.stdout)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "relay.py").write_text(RELAY)
    (tmp_path / "helper.py").write_text(HELPER)
    return tmp_path


def cached(folder):
    return sorted((folder / "cache/softrig/numba").iterdir())


@pytest.mark.long
def test_bits_of_a_branching_delay_loop_are_those_of_plain_python(folder):
    plain = relay(folder, SOFTRIG_JIT="0")
    assert not (folder / "cache").exists()
    with ThreadPoolExecutor(2) as pool:
        native = list(pool.map(lambda _: relay(folder).tobytes(), range(2)))
    assert np.ptp(plain) > 1.0
    assert native == [plain.tobytes()] * 2
    # The second process loads the code from the cache and adds nothing.
    files = {f: f.stat().st_mtime_ns for f in cached(folder)}
    assert [f.name.split("-")[0] for f in files] == ["relay", "run", "wobble"]
    assert relay(folder).tobytes() == plain.tobytes()
    assert {f: f.stat().st_mtime_ns for f in cached(folder)} == files
    # Change a constant in another file, which numba's own cache would miss; and damage a cached file.
    file = next(f for f in files if f.name.startswith("wobble-"))
    file.write_bytes(file.read_bytes()[:100])
    (folder / "helper.py").write_text(HELPER.replace("1.25", "1.26"))
    changed = relay(folder, SOFTRIG_JIT="0")
    assert changed.tobytes() != plain.tobytes()
    assert relay(folder).tobytes() == changed.tobytes()
    assert file.stat().st_size > 100


def test_without_numba_the_plain_function_runs():
    code = """
        import sys
        sys.modules["numba"] = None
        from softrig_core.kit.jit import jit

        @jit
        def twice(x):
            return 2.0 * x

        print(twice(3.0), twice._run is twice.straight())
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.stdout, done.stderr) == ("6.0 True\n", "")


def cube(x):
    return x**3


def grow(x):
    x **= 2
    return x


def total(a):
    return a.sum()


def builtin_total(a):
    return sum(a)


def product(a, b):
    return a @ b


def length(x, y):
    return math.hypot(x, y)


def numpy_exponential(x):
    return np.exp(x)


def hidden(x):
    return [math.pow(v, 2.0) for v in x]


@pytest.mark.parametrize(
    ("function", "word"),
    [
        (cube, r"\*\*"),
        (grow, r"\*\*"),
        (total, "sum"),
        (builtin_total, "sum"),
        (product, "@"),
        (length, "hypot"),
        (numpy_exponential, "numpy.exp"),
        (hidden, "pow"),
    ],
)
def test_functions_that_native_code_computes_differently_are_refused(function, word):
    with pytest.raises(ValueError, match=rf"{function.__name__} uses {word}, which native code"):
        jit(function)


@jit
def mean(a):
    total = 0.0
    for x in a:
        total += x
    return total / len(a)


def own_mean(a):
    return mean(a)


def renamed(a):
    return average(a)


def test_a_users_function_may_have_the_name_of_a_refused_one():
    """And a refused one is refused under another name, too: objects are compared."""
    assert jit(own_mean)(np.array([1.0, 2.0, 6.0])) == 3.0

    def enclosing(sum):
        return jit(lambda a: sum(a))

    assert enclosing(mean)(np.array([1.0, 2.0, 6.0])) == 3.0
    with pytest.raises(ValueError, match="uses sum, which native code"):
        enclosing(sum)
    with pytest.raises(ValueError, match="renamed uses mean, which native code"):
        jit(renamed)
    with pytest.raises(ValueError, match="uses mean, which native code"):
        jit(lambda a: a.mean())
    assert jit(lambda x: np.abs(x))(-2.0) == 2.0


SCALE = "@jit\ndef f(x):\n    return x * {}\n"
LARGE = "D = np.zeros(5000)\nD[2000] = {}\n"


# `slope` is too large to be inlined, so its symbol is looked up when the code is loaded.
FACTORY = """
import sys
import numpy as np
from softrig_core.kit.jit import jit

def factory(rates):
    @jit
    def slope(x, step):
        y = x
LINES
        return y

    @jit
    def advance(x, steps):
        for k in range(steps):
            x[0] = slope(x[0], 0.25) if k % 2 else slope(x[0], 0.5)
        return x[0]

    return advance

@jit
def up(x):
    return 1.0

@jit
def down(x):
    return -2.0

for name in sys.argv[1:]:
    print(name, factory(globals()[name])(np.zeros(1), 3))
""".replace("LINES", "        y += rates(y) * step if y < 1e9 else 0.0\n" * 60)


def test_functions_of_one_factory_from_two_processes_keep_their_own_code(tmp_path):
    """The second process would otherwise have the symbols of the first; a third one loads both from the cache."""
    (tmp_path / "factory.py").write_text(FACTORY)
    env = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    results = [
        subprocess.run([sys.executable, "factory.py", *names], cwd=tmp_path, env=env, capture_output=True, text=True)
        for names in (["up"], ["down"], ["up", "down"], ["down", "up"])
    ]
    assert [r.stdout for r in results[2:]] == [
        results[0].stdout + results[1].stdout,
        results[1].stdout + results[0].stdout,
    ]
    steps = 60 * (0.5 + 0.25 + 0.5)
    assert results[2].stdout == f"up {1.0 * steps}\ndown {-2.0 * steps}\n"


@pytest.mark.parametrize(
    ("inner", "outer"),
    [
        (SCALE, "@jit\ndef g(x):\n    return p.h.f(x)\n"),
        ("C = {}", "@jit\ndef g(x):\n    return x + p.h.C\n"),
        (f"{LARGE}C = (D, 1.0)", "C = p.h.C\n@jit\ndef g(x):\n    return x + C[0][2000]\n"),
        (LARGE, "@jit\ndef g(x, y=p.h.D):\n    return x + y[2000]\n"),
        ("C = {}", "@jit\ndef g(x, *, y=p.h.C):\n    return x + y\n"),
        ("class M(enum.Enum):\n    A = {}\n", "M = p.h.M\n@jit\ndef g(x):\n    return x + M.A.value\n"),
        ("@numba.njit\ndef f(x):\n    return x * {}\n", "f = p.h.f\n@jit\ndef g(x):\n    return f(x)\n"),
    ],
    ids=["function", "constant", "array in a tuple", "default", "by name", "enum", "of numba"],
)
def test_everything_that_a_function_reaches_is_part_of_its_digest(inner, outer):
    """Otherwise the cache would return the machine code of an earlier version."""

    def digest(value):
        p, h, whole = types.ModuleType("p"), types.ModuleType("h"), types.ModuleType("whole")
        p.h, h.p = h, p
        vars(h).update(jit=jit, np=np, enum=enum, numba=pytest.importorskip("numba"))
        vars(whole).update(jit=jit, p=p)
        exec(inner.format(value), vars(h))
        exec(outer, vars(whole))
        return whole.g.digest()

    assert digest(2.0) == digest(2.0) != digest(4.0)


def test_functions_in_closures_and_as_arguments_are_compiled():
    def scaled(factor):
        @jit
        def scale(x):
            return factor * x

        @jit
        def apply(x):
            return scale(x) + 1.0

        return apply

    assert scaled(2.0)(3.0) == 7.0
    assert scaled(4.0)(3.0) == 13.0
    assert scaled(2.0).digest() == scaled(2.0).digest() != scaled(4.0).digest()

    @jit
    def twice(f, x):
        return f(f(x))

    assert twice(scaled(2.0), 3.0) == 15.0


class Line(NamedTuple):
    slope: float
    table: np.ndarray


class Other(NamedTuple):
    table: np.ndarray
    slope: float


@jit
def along(line, at, weights):
    line.table[0] += weights[1][0]
    return line.slope * at + line.table[1] * weights[0]


def test_tuples_are_passed_by_their_parts_and_further_ones_unchanged():
    table = np.array([0.0, 3.0])
    calls = [
        (Line(2.0, table), 5.0, (10.0, (1.0, 2.0))),  # types for which the function is compiled in advance
        (Other(table, 2.0), 5.0, (10.0, (1.0, 2.0))),  # another tuple with the same fields in another order
        (Line(2.0, table), 5.0, (10.0, (1.0,))),
    ]
    for k, call in enumerate(calls, 1):
        assert along(*call) == 40.0, call
        assert table[0] == k  # the function got the array itself, not a copy
    assert along.py_func(*calls[0]) == 40.0


def test_recursion_is_compiled():
    assert factorial(10.0) == factorial.py_func(10.0) == 3628800.0


@jit
def factorial(x):
    if x <= 1.0:
        return 1.0
    return x * factorial(x - 1.0)


def test_power_has_the_bits_of_the_library_for_constant_exponents():
    @jit
    def powers(a, out):
        for i in range(a.size):
            out[i, 0], out[i, 1], out[i, 2] = power(a[i], 2.0), power(a[i], 0.5), power(2.0, a[i])
            out[i, 3] = power(a[i], 3)

    a = np.random.default_rng(4).uniform(0.0, 10.0, 20000)
    out = np.empty((a.size, 4))
    powers(a, out)
    expected = [[math.pow(x, 2.0), math.pow(x, 0.5), math.pow(2.0, x), math.pow(x, 3.0)] for x in a.tolist()]
    assert np.array_equal(out, expected)
    assert not np.array_equal(out[:, 3], a * a * a), "the check could not fail"


def test_module_without_a_writable_cache_still_compiles(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nowhere")
    assert jit(lambda x: x + 1.0)(2.0) == 3.0
    assert module.our_numba() is not None


@jit
def _twice(x):
    return 2.0 * x


class _Native(Block):
    """Begins with its native code, counts its copies."""

    INPUTS = (number("u", "u", "V"),)
    OUTPUTS = (number("y", "y", "V"),)
    ticks: list = []

    def update(self, x, t, u):
        self.ticks.append(t)
        return x, {"y": (_twice(u[0]),)}


@jit
def _later(x):
    return 3.0 * x


class _Later(_Native):
    def warm_up(self):
        _later(1.0)


class _Broken(_Native):
    def update(self, x, t, u):
        raise ArithmeticError("only in the run")


def test_a_rehearsal_compiles_native_code_and_changes_nothing_else():
    assert _twice._run == _twice._first
    assert rehearse(_Native, BlockParams(), "a")
    assert _twice._run != _twice._first
    assert _Native.ticks == [0]
    assert rehearse(_Broken, BlockParams(), "a")  # the error is reported in the run itself
    assert not rehearse(Gain, Gain.Params(), "a")
    assert rehearse(_Later, BlockParams(), "a")  # the first tick does not reach this branch
    assert _later._run != _later._first


@jit
def borrowed(line, at, out):
    values, scale = line
    for k in range(out.size):
        out[k] = values[(k + at) % values.size] * scale
    return out[0]


@jit
def copied(line, out):
    out[0, 1:] = line[:2]
    out[0, :2] = out[0, 1:]  # both sides overlap, so numba writes through a temporary copy
    return out[0, 0]


@jit
def handed_back(line):
    return line, line[1:]


def test_a_function_that_only_reads_its_arrays_counts_no_references():
    line, out, counts = np.arange(5.0), np.empty((1, 3)), []
    for _ in range(9):  # the first call compiles, and the compiler keeps its arguments for a while
        assert borrowed((line, 2.0), 1, out[0]) == 2.0
        assert copied(line, out) == 0.0
        whole, part = handed_back(line)
        counts.append([sys.getrefcount(x) for x in (line, out)])
    assert counts[1:] == counts[1:2] * 8
    assert out.tolist() == [[0.0, 1.0, 1.0]]
    assert (whole.tolist(), part.tolist()) == (line.tolist(), line[1:].tolist())
    from softrig_core.kit._borrowed import Borrowing

    # Compiled again, because the cache does not contain LLVM code.
    made = module.our_numba().njit(pipeline_class=Borrowing)(borrowed.py_func)
    made((line, 2.0), 1, out[0])
    assert not any("NRT_incref" in text for text in made.inspect_llvm().values())


def _times(n):
    @jit
    def inner(x):
        return n * x

    @jit
    def outer(x, again):
        return inner(x) + (outer(x, again - 1) if again else 0.0)

    return outer


@pytest.mark.parametrize(("name", "value"), [("SOFTRIG_JIT", "0"), ("NUMBA_DISABLE_JIT", "1")])
def test_without_numba_functions_call_plain_functions(name, value, monkeypatch):
    """Functions of an enclosing function and a function itself included; the others still call the objects."""
    monkeypatch.setenv(name, value)
    calls = []
    monkeypatch.setattr(Jit, "__call__", lambda self, *arguments: calls.append(self.__name__) or self._run(*arguments))
    two, three = _times(2.0), _times(3.0)
    assert (two(1.0, 2), three(1.0, 2), two(5.0, 0)) == (6.0, 9.0, 10.0)
    assert calls == ["outer"] * 3


@pytest.mark.parametrize(("stored", "asked"), [(True, 3), (False, 6)])
def test_code_beside_another_form_is_loaded_after_some_calls_and_compiled_after_many(monkeypatch, stored, asked):
    monkeypatch.setattr(module, "SOME", 3)
    monkeypatch.setattr(module, "MANY", 6)
    monkeypatch.setattr(module, "our_numba", lambda: None)
    monkeypatch.setitem(sys.modules, "numba", module)
    cache = types.SimpleNamespace(has=lambda signature, target: stored and signature == (float, int))
    made = types.SimpleNamespace(_cache=cache, typeof_pyval=type, targetctx=None)
    monkeypatch.setattr(Jit, "dispatcher", lambda self, numba: made)
    function = Jit(lambda x, n: x)
    assert [function.pays(1.0, 2) for _ in range(8)] == [k >= asked for k in range(1, 9)]
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    function = Jit(lambda x, n: x)
    assert not any(function.pays(1.0, 2) for _ in range(8))
