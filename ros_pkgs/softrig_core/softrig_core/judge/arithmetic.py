"""Expressions of formulas: their values, and where they are undefined."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np

from ..arrays import Array
from ..wire.long import elementwise

# What sentil writes as JSON: {"Always": [{"lower", "upper"}, tree]}, {"Predicate": {"lhs", "op", "rhs"}}.
# A literal is a number, or the name of one among the samples, so that variants of a rig share the tree of a formula.
Tree = Any
Samples = Mapping[str, Array]
SEVERAL = ("min", "max")  # functions of two numbers or more; the others take one


def _each(function: Callable[..., float]) -> Callable[..., Array]:
    """Turn a function of numbers into one of arrays, NaN where undefined; numpy's own depend on the CPU."""

    def defined(*arguments: float) -> float:
        try:
            return function(*arguments)
        except (ValueError, OverflowError, ZeroDivisionError):
            return math.nan

    @elementwise
    def all_(*arguments: Array) -> Array:
        # Constants of a formula are numbers, for which an array would take most of the time.
        if all(isinstance(each, float) for each in arguments):
            return np.float64(defined(*map(float, arguments)))  # type: ignore[return-value]
        arrays = np.broadcast_arrays(*arguments)
        flat = [defined(*each) for each in zip(*(a.ravel().tolist() for a in arrays), strict=True)]
        return np.array(flat, dtype=np.float64).reshape(arrays[0].shape)

    return all_


ARITHMETIC: Mapping[str, Callable[..., Array]] = {
    "Add": np.add, "Sub": np.subtract, "Mul": np.multiply, "Div": np.divide, "Mod": np.fmod, "Pow": _each(math.pow),
    "abs": np.abs, "sqrt": np.sqrt, "floor": np.floor, "ceil": np.ceil, "exp": _each(math.exp),
    "log": _each(math.log10), "ln": _each(math.log), "sin": _each(math.sin), "cos": _each(math.cos),
    "tan": _each(math.tan), "min": lambda *x: reduce(np.minimum, x), "max": lambda *x: reduce(np.maximum, x),
}  # fmt: skip


# Operations whose result is a number only if all operands are: NaN stays visible in the result. Division is not among
# them, because a number divided by infinity is 0.
_CARRY = frozenset({"Add", "Sub", "Mul", "abs", "sqrt", "floor", "ceil"})


def arithmetic(tree: Tree, samples: Samples) -> Any:
    """Return an expression's values; NaN where it, or a part of it, is undefined or beyond all numbers."""
    with np.errstate(all="ignore"):
        # Where nothing undefined can vanish on the way, one check of the result replaces one after each operation.
        if carries(tree) and is_sure(result := _calculated(tree, samples, lambda values: values)):
            return result
        return _calculated(tree, samples, sure)


def _calculated(tree: Tree, samples: Samples, check: Callable[[Any], Any]) -> Any:
    ((kind, body),) = tree.items()
    if kind == "Literal":
        return literal(body, samples)
    if kind == "Variable":
        return samples[body]
    name, operands = called(kind, body)
    return check(ARITHMETIC[name](*(_calculated(part, samples, check) for part in operands)))


def literal(body: float | str, samples: Samples) -> Any:
    """Return the number of a literal."""
    return np.float64(samples[body] if isinstance(body, str) else body)


def called(kind: str, body: Any) -> tuple[str, Any]:
    """Return the name and the operands of an operation."""
    return (body[0], body[1]) if kind == "Call" else (body[0], body[1:])


def carries(tree: Tree) -> bool:
    """Return whether NaN in an expression stays visible in its result."""
    ((kind, body),) = tree.items()
    if kind in ("Literal", "Variable"):
        return True
    name, operands = called(kind, body)
    return name in _CARRY and all(map(carries, operands))


def is_sure(values: Any) -> bool:
    """Return whether all values are finite."""
    # Constants are numbers, for which numpy takes twenty times as long.
    return math.isfinite(values) if isinstance(values, float) else bool(np.isfinite(values).all())


def sure(values: Any) -> Any:
    """Return the values, with NaN for those that are not finite."""
    # An infinity is no distance: it would let a comparison pass or fail by a division by zero.
    return values if is_sure(values) else np.where(np.isfinite(values), values, np.nan)
