"""Branching and delay loops as native code: numba with a cache, the plain function without it, the same bits.

A `jit` function may use operations with the same result on both sides (measured over 20,000 random arguments each):
``+ - * / // %``, comparisons, ``min``, ``max``, ``abs``, ``round``, ``int`` and the functions of `math` except
``pow``, ``hypot``, ``gamma`` and ``lgamma``. Operations with different results are refused when the function is
declared: ``**`` and ``math.pow`` (native code turns constant powers into products: one result in four of ``x**3``
differs; write ``x * x`` or `power`), numpy's own elementary functions (``np.exp``: one in twenty), sums and products of
whole arrays (another order of additions).
"""

from __future__ import annotations

import builtins
import dis
import hashlib
import math
import os
import sys
import threading
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import EnumType
from functools import lru_cache, update_wrapper
from importlib.util import find_spec
from typing import Any, NamedTuple, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])
# The most parts of the arguments of a call that are handed over one by one.
MOST_PARTS = 100
# Calls of a function that has another form, too, after which it is loaded, and after which it is compiled.
SOME, MANY = 16, 200
# Part of the digest. Change it with the way of compiling, so that no older code is taken from the cache.
HOW = b"borrowed: parts, symbols by digest"
SVML = "NUMBA_DISABLE_INTEL_SVML"
NUMBAS = "NUMBA_DISABLE_JIT"

_NUMPY = """abs array ceil complex128 empty empty_like float64 floor full inf int64 isfinite isinf isnan maximum minimum
nan ndarray ones ones_like pi sign sqrt trunc zeros zeros_like"""
NUMPY = frozenset(_NUMPY.split())
REFUSED = {
    "**": "x * x, or power(x, y)",
    "@": "a loop",
    "pow": "power(x, y)",
    "hypot": "math.sqrt(x * x + y * y)",
    **dict.fromkeys(("gamma", "lgamma"), "another formula"),
    **dict.fromkeys(("sum", "prod", "dot", "mean", "std", "var"), "a loop"),
}


def jit(function: F) -> F:
    """Compile a function of floats and arrays at its first call; cached across processes.

    The function is compiled without fast-math and contraction, and with numpy's rules for division, so its results
    are bit-identical to those of the plain one. The plain one is used, a hundred times slower, if numba is absent or
    `switched_off`. (Errors differ: if plain Python raises, for ``1.0 / 0.0`` or ``math.sqrt(-1.0)``, native code
    returns infinity or NaN.) numba is imported at the first call, not before.

    Parameters
    ----------
    function : callable
        Loops and branches over floats, ints, tuples and numpy arrays. What it calls is `jit` itself, `power`, or in
        the list above; numbers and `jit` functions of the module and of an enclosing function are constants.

    Returns
    -------
    callable
        With the same arguments; its attribute ``py_func`` is the plain function.

    Raises
    ------
    ValueError
        The function uses what native code and plain Python compute differently.
    """
    for code in _codes(function.__code__):
        _check(code, function)
    return cast(F, Jit(function))


def power(x: float, y: float) -> float:
    """Return x to the power of y by the C library, the same bits in plain and in native code."""
    return math.pow(x, y)


class Jit:
    """A function that is native code from its first call on; made by `jit`."""

    SCRATCH = frozenset({"_run", "_dispatcher", "_straight", "_asked", "_stored"})  # made at the first call

    def __init__(self, function: Callable[..., Any]) -> None:
        self.py_func = function
        self._run: Callable[..., Any] = self._first
        self._dispatcher: Any = None
        self._straight: types.FunctionType | None = None
        self._asked, self._stored = 0, False
        update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        """Call with positional arguments."""
        return self._run(*arguments)

    @property
    def direct(self) -> Callable[..., Any]:
        """Return the function that a call runs; before the first call this is the object itself."""
        return self if self._run == self._first else self._run

    def pays(self, *arguments: Any) -> bool:
        """Return whether the native function is faster for these arguments than the same computation in numpy.

        Loading native code takes some ms and compiling it seconds. So it is loaded after some calls, and compiled
        after many.
        """
        if self._asked >= MANY:
            return True
        if "numba" not in sys.modules or switched_off():
            return False
        self._asked += 1
        if self._asked == SOME:
            dispatcher = self.dispatcher(our_numba())
            self._stored = dispatcher._cache.has(tuple(map(dispatcher.typeof_pyval, arguments)), dispatcher.targetctx)
        return self._asked >= (SOME if self._stored else MANY)

    def _first(self, *arguments: Any) -> Any:
        if switched_off() or (numba := our_numba()) is None:
            if getattr(getattr(sys.modules.get(self.py_func.__module__), "__spec__", None), "_initializing", False):
                # During the import of its module the functions that it calls may not be defined yet, so nothing is
                # fixed now.
                return self.py_func(*arguments)
            self._run = self.straight()
        else:
            self._run = self._by_parts(numba, arguments) or self.dispatcher(numba)
        return self._run(*arguments)

    def straight(self) -> types.FunctionType:
        """Return the plain function, in which the compiled functions that it calls are plain, too.

        A call through such an object costs as much as a line of arithmetic. As in native code, functions of the module
        and of an enclosing function are constants.
        """
        if self._straight is None:
            function = cast(types.FunctionType, self.py_func)
            scope = dict(function.__globals__)
            cells = [types.CellType(cell.cell_contents) for cell in function.__closure__ or ()]
            self._straight = _copy(function, scope, tuple(cells))
            for name in {name for code in _codes(function.__code__) for name in code.co_names}:
                if isinstance(scope.get(name), Jit):
                    scope[name] = scope[name].straight()
            for cell in cells:
                if isinstance(cell.cell_contents, Jit):
                    cell.cell_contents = cell.cell_contents.straight()
        return self._straight

    def _by_parts(self, numba: Any, arguments: tuple[Any, ...]) -> Callable[..., Any] | None:
        """Create a callable that passes tuples in parts: numba inspects one in 1 us, a number or an array in 0.05 us.

        Return None if no argument is a tuple. Later arguments of another kind than these are passed unchanged.
        """
        from ._borrowed import Borrowing
        from ._jit_cache import Cache

        kinds: dict[str, type] = {}
        parts = [_parts(value, f"a{k}", kinds) for k, value in enumerate(arguments)]
        tests = [test for part in parts for test in part.tests]
        names = ", ".join(name for part in parts for name in part.names)
        # The generated call passes exactly these arguments, so a function with defaults is called as it is.
        if not tests or names.count(",") >= MOST_PARTS or self.py_func.__defaults__:
            return None
        text = f"def parted({names}):\n    return function({', '.join(part.rebuilt for part in parts)})\n"
        tokens = (self.digest(), text, *(f"{name} {t.__module__}.{t.__qualname__}" for name, t in kinds.items()))
        digest = hashlib.sha256("\0".join(tokens).encode()).hexdigest()
        # numba looks for the module of a function that it loads from the cache.
        scope: dict[str, Any] = {"function": self, "__name__": __name__, **kinds}
        exec(text, scope)
        # numba makes the symbol of the native code from this name, and no two functions may share one.
        scope["parted"].__qualname__ = f"parted_{digest[:32]}"
        parted = numba.njit(fastmath=False, error_model="numpy", pipeline_class=Borrowing)(scope["parted"])
        # A class that cannot be imported would be another class in the next process, so such code is not stored.
        parted._cache = Cache(self.py_func.__qualname__, digest, (b"__main__", b"<locals>"))
        scope |= {"parted": parted, "whole": self.dispatcher(numba)}
        params, handed = ", ".join(f"a{k}" for k, _ in enumerate(arguments)), ", ".join(part.passed for part in parts)
        test = f"if {' and '.join(tests)}:\n        return parted({handed})"
        text = f"def call({params}):\n    {test}\n    return whole({params})\n"
        exec(compile(text, f"<parts of {self.py_func.__qualname__}>", "exec"), scope)
        return cast(Callable[..., Any], scope["call"])

    def dispatcher(self, numba: Any) -> Any:
        """Return numba's own object with our cache, because numba's cache ignores changes in called functions."""
        if self._dispatcher is None:
            from ._borrowed import Borrowing
            from ._jit_cache import Cache

            digest = self.digest()
            # numba makes the symbols of the native code from this name and a count of the process that compiled it. If
            # two functions of one factory were compiled by two processes, both can have the same symbols in the cache,
            # and a process that loads both would run the first in the place of the second.
            function = cast(types.FunctionType, self.py_func)
            named = _copy(function, function.__globals__, function.__closure__)
            named.__qualname__ = f"{self.py_func.__qualname__}_{digest[:32]}"
            dispatcher = numba.njit(fastmath=False, error_model="numpy", pipeline_class=Borrowing)(named)
            dispatcher._cache = Cache(self.py_func.__qualname__, digest)
            self._dispatcher = dispatcher
        return self._dispatcher

    def digest(self) -> str:
        """Return a digest of everything that affects the native code: its own code, constants, and all its callees."""
        content = hashlib.sha256(HOW)
        for token in _tokens(self.py_func, set()):
            content.update(token.encode() + b"\0")
        return content.hexdigest()


def switched_off() -> str:
    """Return the setting of the environment that forbids native code, ours or numba's own; empty if none does."""
    if os.environ.get("SOFTRIG_JIT", "1") == "0":
        return "SOFTRIG_JIT=0"
    return f"{NUMBAS}={value}" if (value := os.environ.get(NUMBAS, "0")) not in ("", "0") else ""


@lru_cache(maxsize=1)
def our_numba() -> Any:
    """Import numba and teach it `Jit` and `power`; None where it is not installed."""
    # With Intel's short vector library, loops give other bits than single calls do. numba reads the variable when it is
    # imported; it does not stay, because this process and what it starts may be somebody else's.
    sets = "numba" not in sys.modules and SVML not in os.environ
    if sets:
        os.environ[SVML] = "1"
    try:
        with _without_libraries():
            import numba
            from numba.core.registry import cpu_target

            # What numba would load with its first function.
            cpu_target.typing_context.refresh()
            cpu_target.target_context.refresh()
    except ImportError:
        return None
    finally:
        if sets:
            del os.environ[SVML]
    # numba has looked for scipy once. Native code of the user may need it, and then it is imported.
    vars(sys.modules["numba.np.arraymath"])["_HAVE_BLAS"] = find_spec("scipy") is not None
    from ._jit_cache import teach

    teach(numba, Jit, power)
    return numba


class _Without:
    """A finder that lets this thread import neither scipy nor coverage.

    numba loads both if they are installed, which takes longer than to load the code of a rig. Ours needs no functions
    of scipy, and coverage only where it is loaded already.
    """

    def __init__(self) -> None:
        self._thread = threading.get_ident()

    def find_spec(self, name: str, *_: object) -> None:
        """Refuse them; other modules are left to the other finders."""
        if name.partition(".")[0] in ("scipy", "coverage") and threading.get_ident() == self._thread:
            raise ImportError(name)


@contextmanager
def _without_libraries() -> Iterator[None]:
    finder: Any = _Without()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _Parts(NamedTuple):
    """The parts of an argument: their names, the code that passes them and rebuilds it, and the tests of its type."""

    names: list[str]
    passed: str
    rebuilt: str
    tests: list[str]


def _parts(value: Any, path: str, kinds: dict[str, type]) -> _Parts:
    """Return the parts of the argument at a path, and the classes of tuples by their names in `rebuilt`."""
    word = path.replace("[", "_").replace("]", "")
    if not isinstance(value, tuple) or not value:
        return _Parts([word], path, word, [])
    kind = type(value)
    items = [_parts(part, f"{path}[{k}]", kinds) for k, part in enumerate(value)]
    tests = [f"type({path}) is {'tuple' if kind is tuple else f't{word}'}"]
    if kind is tuple:
        tests.append(f"len({path}) == {len(value)}")
    else:
        kinds[f"t{word}"] = kind
    return _Parts(
        [name for part in items for name in part.names],
        ", ".join(part.passed for part in items) if any(part.tests for part in items) else f"*{path}",
        f"{'' if kind is tuple else f't{word}'}({''.join(f'{part.rebuilt}, ' for part in items)})",
        tests + [test for part in items for test in part.tests],
    )


def _copy(
    function: types.FunctionType, scope: dict[str, Any], cells: tuple[types.CellType, ...] | None
) -> types.FunctionType:
    result = types.FunctionType(function.__code__, scope, function.__name__, function.__defaults__, cells)
    result.__kwdefaults__ = function.__kwdefaults__
    return result


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _codes(constant)


def _operators(code: types.CodeType) -> set[int]:
    # A code consists of pairs of bytes, operation and argument; unused places between them are 0.
    binary = dis.opmap["BINARY_OP"]
    return {operator for word, operator in zip(code.co_code[::2], code.co_code[1::2], strict=True) if word == binary}


REFUSED_OPERATORS = _operators(compile("a ** b; a @ b; a **= b; a @= b", "", "exec"))


def _is_clean(code: types.CodeType, function: Callable[..., Any]) -> bool:
    """Return whether no operator and no name of a code can be refused, wherever in the code they are.

    This takes 0.04 ms a function. Decoding the instructions, which `_check` does if this finds something, takes 7 ms.
    """
    names = {*code.co_names, *code.co_freevars, *code.co_cellvars}
    if names & REFUSED.keys() or _operators(code) & REFUSED_OPERATORS:
        return False
    results = [_named(function, word) for word in names]
    for owner in [item for item in results if isinstance(item, types.ModuleType)]:
        attributes = {word: getattr(owner, word) for word in names if hasattr(owner, word)}
        if owner.__name__ == "numpy" and not NUMPY.issuperset(attributes):
            return False
        if any(isinstance(item, types.ModuleType) for item in attributes.values()):
            return False
        results += attributes.values()
    try:
        for item in results:
            _check_call(function, item)
    except ValueError:
        return False
    return True


def _check(code: types.CodeType, function: Callable[..., Any]) -> None:
    if _is_clean(code, function):
        return
    owner: Any = None  # the module whose attribute is taken next
    for step in dis.get_instructions(code):
        word, result = step.argval, None
        if step.opname == "BINARY_OP" and (word := step.argrepr.rstrip("=")) in REFUSED:
            raise _refusal(function, word)
        if step.opname in ("LOAD_GLOBAL", "LOAD_DEREF"):
            result = _named(function, word)
        elif step.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            # The attribute is that of an array, such as x.sum().
            if owner is None and word in REFUSED:
                raise _refusal(function, word)
            result = getattr(owner, word, None)
            if getattr(owner, "__name__", "") == "numpy" and word not in NUMPY | REFUSED.keys():
                raise _foreign(function, word)
        _check_call(function, result)
        owner = result if isinstance(result, types.ModuleType) else None


def _check_call(function: Callable[..., Any], value: Any) -> None:
    """Refuse a function that native code computes differently, whatever its name here; a user's own one may
    have that name.
    """
    home = getattr(value, "__module__", None) or type(value).__module__
    if isinstance(value, types.ModuleType) or home.partition(".")[0] not in ("builtins", "math", "numpy", "_operator"):
        return
    name = getattr(value, "__name__", "")
    if name in REFUSED:
        raise _refusal(function, name)
    if home.startswith("numpy") and callable(value):
        import numpy as np

        if all(value is not getattr(np, known) for known in NUMPY):
            raise _foreign(function, name)


def _refusal(function: Callable[..., Any], word: str) -> ValueError:
    return ValueError(
        f"{function.__qualname__} uses {word}, which native code computes differently; expected {REFUSED[word]}"
    )


def _foreign(function: Callable[..., Any], word: str) -> ValueError:
    return ValueError(
        f"{function.__qualname__} uses numpy.{word}, which native code may compute differently; "
        "expected functions of math, or a loop"
    )


def _named(function: Callable[..., Any], word: str) -> Any:
    """Return the object that a function finds under a name of its module, of an enclosing function, or of Python."""
    cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
    if word in cells:
        try:
            return cells[word].cell_contents
        # The variable of the enclosing function is not assigned yet.
        except ValueError:
            return None
    return function.__globals__.get(word, getattr(builtins, word, None))


def _tokens(function: Callable[..., Any], seen: set[int]) -> Iterator[str]:
    if id(function) in seen:
        return
    seen.add(id(function))
    yield from tokens_of((function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items()))), seen)
    names: set[str] = set()
    for code in _codes(function.__code__):
        yield code.co_code.hex()
        yield repr([c for c in code.co_consts if not isinstance(c, types.CodeType)])
        yield repr((code.co_names, code.co_varnames, code.co_freevars))
        names.update(code.co_names)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    known = [function.__globals__[name] for name in sorted(names) if name in function.__globals__]
    for value in [*cells, *known]:
        yield from _reached(value, sorted(names), seen)


def _reached(value: Any, names: list[str], seen: set[int]) -> Iterator[str]:
    """Yield the tokens of a constant, or of all that a function may reach by these attributes of a module."""
    if not isinstance(value, types.ModuleType):
        yield from tokens_of(value, seen)
    elif id(value) not in seen:
        seen.add(id(value))
        yield value.__name__
        # Names of a module within it are followed too, for `package.module.function(x)`.
        for name in names:
            if hasattr(value, name):
                yield from _reached(getattr(value, name), names, seen)


def tokens_of(value: Any, seen: set[int]) -> Iterator[str]:
    """Yield everything about a constant, or a function and its callees, that affects their native code."""
    if isinstance(value, Jit) or hasattr(value, "py_func"):  # a function of ours, or one that numba has compiled
        yield from _tokens(value.py_func, seen)
    elif hasattr(value, "tobytes") and not isinstance(value, type):  # an array or a number, not np.int64 itself
        yield f"{value.dtype}{value.shape}{value.tobytes().hex()}"
    # Part by part, because `repr` shows only the corners of a large array and two tuples could look equal.
    elif isinstance(value, tuple):
        yield f"{type(value).__qualname__}{getattr(value, '_fields', '')}{len(value)}"
        for part in value:
            yield from tokens_of(part, seen)
    elif hasattr(value, "__qualname__"):
        yield f"{value.__module__}.{value.__qualname__}{getattr(value, '_fields', '')}"
        # Code contains the values of an enumeration's members, and the name of the class stays when they change.
        if isinstance(value, EnumType):
            members = cast(dict[str, Any], value.__members__)
            yield repr([(name, member.value) for name, member in members.items()])
    elif isinstance(value, (bool, int, float, complex, str, type(None))):
        yield repr(value)
