"""Find what a block's code uses from outside of it: variables of modules, closures, defaults, random generators."""

from __future__ import annotations

import builtins
import itertools
import random
import sys
import sysconfig
import types
from collections import deque
from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import numpy as np

from .code import is_ours

CHANGEABLE = (int, float, list, dict, set, deque, bytearray)
_OTHERS = (np.ndarray, np.random.Generator, np.random.RandomState, random.Random, itertools.count, types.GeneratorType)
_LIBRARIES = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
_FUNCTIONS = (types.FunctionType, staticmethod, classmethod, property, partial)


def is_foreign(cls: type) -> bool:
    """Return whether a block class is not of softrig's own packages."""
    return not is_ours(cls.__module__)


def outside(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the mutable objects that a method names: variables of its module and of enclosing functions."""
    for name in function.__code__.co_names:
        if isinstance(value := function.__globals__.get(name), CHANGEABLE) and not name.isupper():
            yield name, value
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        if is_filled(cell) and isinstance(cell.cell_contents, CHANGEABLE):
            yield name, cell.cell_contents


def all_outside(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield the variables, values of closures, mutable defaults, attributes of functions and random generators
    that the methods of a user's class reach, through functions, classes and modules that are not libraries.
    """
    seen: set[int] = set()
    # An author's package may be installed like a library.
    package = cls.__module__.partition(".")[0]

    def is_library(module: str) -> bool:
        return module.partition(".")[0] != package and _is_library(module)

    todo: list[Any] = list(vars(cls).values())
    while todo:
        function = _function(todo.pop())
        if function is None or id(function) in seen or is_library(function.__module__):
            continue
        seen.add(id(function))
        for name, value in _named(function):
            if isinstance(value, _FUNCTIONS) or hasattr(value, "__wrapped__"):
                todo.append(value)
            elif isinstance(value, type):
                if id(value) not in seen and not is_library(value.__module__):
                    seen.add(id(value))
                    todo += vars(value).values()
                    yield from (
                        (f"{value.__name__}.{key}", item)
                        for key, item in vars(value).items()
                        # Ports are constants, and a digest of them takes as long as a short run.
                        if key[0] != "_" and _is_kept(item) and not (key.isupper() and isinstance(item, tuple))
                    )
            elif _is_kept(value) and not (name.isupper() and isinstance(value, tuple)):
                yield name, value


def is_filled(cell: types.CellType) -> bool:
    """Return whether a variable of an enclosing function has a value yet."""
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _function(value: Any) -> types.FunctionType | None:
    """Return the Python function behind a method, a property, a cached or a partial one; None if there is none."""
    while not isinstance(value, types.FunctionType):
        inner = next(
            (target for key in ("__wrapped__", "__func__", "fget", "func") if (target := getattr(value, key, None))),
            None,
        )
        if inner is None or isinstance(value, type):
            return None
        value = inner
    return value


def _named(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the objects that the code of a function can reach by a name."""
    names = list(_names(function.__code__))
    for name in names:
        value = function.__globals__.get(name, None if hasattr(builtins, name) else sys.modules.get(name))
        if isinstance(value, types.ModuleType):
            yield from _of_module(name, value, names)
        elif isinstance(value, types.BuiltinMethodType) and not isinstance(value.__self__, types.ModuleType):
            yield name, value.__self__  # `from random import random`
        else:
            yield name, value
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        if is_filled(cell):
            yield name, cell.cell_contents
    defaults = (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values())
    yield from ((f"a default of {function.__name__}", value) for value in defaults)
    yield from ((f"{function.__name__}.{key}", value) for key, value in vars(function).items() if key != "__wrapped__")


def _names(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from _names(part)


def _of_module(name: str, module: types.ModuleType, names: list[str]) -> Iterator[tuple[str, Any]]:
    """Yield the objects that a function may use of a module: only the random numbers of a library."""
    if module is random:
        yield name, random.random.__self__  # type: ignore[attr-defined]
    elif module is np.random or (module is np and "random" in names):
        yield f"{name}.random" if module is np else name, np.random.mtrand._rand  # noqa: SLF001 - it has no other name
    elif not _is_library(module.__name__):
        yield from ((f"{name}.{key}", vars(module)[key]) for key in names if key in vars(module))


def _is_kept(value: Any) -> bool:
    """Return whether a value may store state: a number or text can be replaced, and a container changed."""
    return isinstance(value, (*CHANGEABLE, *_OTHERS, str, bytes, tuple)) or not _is_library(type(value).__module__)


@cache
def _is_library(module: str) -> bool:
    """Return whether a module belongs to Python, an installed library or softrig, not to a user."""
    top = module.partition(".")[0]
    if top == "__main__":
        return False
    file = str(getattr(sys.modules.get(module), "__file__", None) or "")
    return top in sys.stdlib_module_names or is_ours(top) or file.startswith(_LIBRARIES)
