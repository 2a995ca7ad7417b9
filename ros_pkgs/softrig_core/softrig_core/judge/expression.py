"""Numbers of expectations and formulas that a scenario writes as arithmetic over ``$name`` and ``$node.parameter``."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable
from typing import Any

from ..errors import ScenarioError

REFERENCE = re.compile(r"\$([A-Za-z_]\w*(?:\.\w+)*)")
# In characters. A longer expression could be nested so deeply that Python's own limit of recursion is near.
LONGEST = 500
# A power by `**` would return a complex number for a negative base and a fraction; `math.pow` refuses it.
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: math.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip
_CALLS: dict[str, Callable[..., Any]] = {"abs": abs, "min": min, "max": max, "sqrt": math.sqrt}
_FORM = "expected numbers, $node.parameter, $name, + - * / ** ( ), abs, min, max and sqrt"


def number(text: str, value: Callable[[str], Any]) -> float:
    """Compute the value of an arithmetic expression.

    Parameters
    ----------
    text : str
        Such as ``0.96 * $dtc_controller.flux_ref``; ``^`` is a power, as in formulas.
    value : callable
        Returns the value of a reference, given without its dollar sign: ``dtc_controller.flux_ref``.

    Returns
    -------
    float
        Finite.

    Raises
    ------
    ScenarioError
        The text is not arithmetic, a reference is not a number, or the result is not finite; the message has the text.
    """
    known: dict[str, float] = {}

    def named(match: re.Match[str]) -> str:
        result = value(match[1])
        if isinstance(result, bool) or not isinstance(result, int | float):
            raise ScenarioError(f"${match[1]} is {result!r}, expected a number")
        known[name := f"_{len(known)}"] = float(result)
        return name

    if len(text) > LONGEST:
        raise ScenarioError(f"{text[:40]!r} ... has {len(text)} characters, expected at most {LONGEST}")
    try:
        tree = ast.parse(REFERENCE.sub(named, text).replace("^", "**").strip(), mode="eval")
        match = float(_value(tree.body, known))
    except ScenarioError:
        raise
    except (SyntaxError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError, MemoryError):
        raise ScenarioError(f"{text!r} is not a number; {_FORM}") from None
    if not math.isfinite(match):
        raise ScenarioError(f"{text!r} is {match}, expected a finite number")
    return match


def references(text: str) -> list[str]:
    """Return the references of a text, without their dollar signs."""
    return REFERENCE.findall(text)


def _value(tree: ast.AST, known: dict[str, float]) -> float:
    if isinstance(tree, ast.Constant) and isinstance(tree.value, int | float) and not isinstance(tree.value, bool):
        return float(tree.value)
    if isinstance(tree, ast.Name) and tree.id in known:
        return known[tree.id]
    if isinstance(tree, ast.BinOp):
        return _OPERATORS[type(tree.op)](_value(tree.left, known), _value(tree.right, known))  # type: ignore[no-any-return]
    if isinstance(tree, ast.UnaryOp):
        return _OPERATORS[type(tree.op)](_value(tree.operand, known))  # type: ignore[no-any-return]
    if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) and not tree.keywords:
        return float(_CALLS[tree.func.id](*(_value(part, known) for part in tree.args)))
    raise ValueError(tree)
