"""Margins of requirements by native code, in one pass over the samples.

Most requirements demand one condition always or at some time: ``always[a, b] (x <= c and abs(y) < d)``. What they
compare is translated into a few instructions, which native code follows for a block of samples at a time, small enough
for the cache of the CPU. `robustness.Record` is the reference; it also evaluates every formula that is refused here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..kit.jit import jit
from .arithmetic import Tree, arithmetic, called, carries
from .formula import FUTURE, variables
from .sums import fixed

COLUMNS = 6  # signals that a formula may read
DEPTH = 8  # values that are at hand at a time
BLOCK = 512  # samples of a block: with DEPTH rows of 8 bytes each, 32 kB, which a first-level cache holds
SPANS = 256  # violations that are told apart

LOAD, CONSTANT, ADD, SUBTRACT, MULTIPLY, DIVIDE, LEAST, GREATEST, NEGATE, MAGNITUDE, ROOT, FINITE, NUMBER = range(13)
_BINARY = {"Add": ADD, "Sub": SUBTRACT, "Mul": MULTIPLY, "Div": DIVIDE}
_CALLS = {"abs": MAGNITUDE, "sqrt": ROOT, "min": LEAST, "max": GREATEST}
_REVERSED = ("Less", "LessEqual")
_COMPARED = ("Greater", "GreaterEqual", *_REVERSED, "Equal", "NotEqual")


class Extreme(NamedTuple):
    """The extreme of a comparison in a window: its value, the index of its sample, and the spans of violation.

    `spans` has the first and the last index of each.
    """

    value: float
    at: int
    spans: list[tuple[int, int]]


class OnePass:
    """A formula as instructions for native code.

    Parameters
    ----------
    tree : plain data
        As `formula.outline` has it.

    Attributes
    ----------
    ready : dict
        What a caller keeps of the formula by the identity of objects, such as its window on some times.

    Raises
    ------
    LookupError
        This form of a formula has none.
    """

    def __init__(self, tree: Tree) -> None:
        ((self.kind, body),) = tree.items()
        if self.kind not in FUTURE:
            raise LookupError(self.kind)
        self.names = variables(tree)
        self._code: list[tuple[int, int]] = []
        self._constants: list[Tree] = []
        self._depth = self._deepest = 0
        self._joined(body[1])
        if len(self.names) > COLUMNS or self._deepest > DEPTH:
            raise LookupError("too many")
        self.code = np.array(self._code, np.int64)
        self.ready: dict[tuple[int, ...], Any] = {}

    def constants(self, numbers: Mapping[str, Any]) -> Array:
        """Return the constants of its instructions for the numbers that the formula names."""
        return np.array([_number(tree, numbers) for tree in self._constants], np.float64)

    def __call__(self, samples: Mapping[str, Array], constants: Array, first: int, last: int) -> Extreme | None:
        """Return the extreme that decides the formula; None where the reference implementation has to decide it.

        Parameters
        ----------
        samples : mapping of str to array, shape (n,)
            Of its signals and conditions.
        constants : array
            See `constants`.
        first, last : int
            Index of the first and the last sample of its window.
        """
        columns = [fixed(samples[name]) for name in self.names] or [fixed(np.zeros(1))]
        if first > last or not all(column.flags.c_contiguous and column.dtype == float for column in columns):
            return None
        # The native function has a fixed number of columns; its instructions never load those that only fill up.
        columns += columns[:1] * (COLUMNS - len(columns))
        edges = np.empty(2 * SPANS, np.int64)
        arguments = self.code, constants, *columns, first, last, self.kind == "Always", edges
        # Loading native code takes milliseconds and compiling it seconds, so the first calls leave the formula to the
        # reference.
        if not extreme.pays(*arguments):  # type: ignore[attr-defined]
            return None
        value, index, count = extreme(*arguments)
        # Which zero is the least of several depends on the order of comparisons, and so does the sign of the margin.
        if count < 0 or value == 0.0:
            return None
        ends = edges[:count].tolist()
        return Extreme(float(value), int(index), list(zip(ends[::2], ends[1::2], strict=True)))

    def _add(self, operation: int, change: int, operand: int = 0) -> None:
        self._code.append((operation, operand))
        self._depth += change
        self._deepest = max(self._deepest, self._depth)

    def _joined(self, tree: Tree) -> None:
        """Add the instructions of comparisons that are joined."""
        ((kind, body),) = tree.items()
        if kind == "Not":
            self._joined(body)
            self._add(NEGATE, 0)
        elif kind in ("And", "Or", "Implies"):
            self._joined(body[0])
            if kind == "Implies":
                self._add(NEGATE, 0)
            self._joined(body[1])
            self._add(LEAST if kind == "And" else GREATEST, -1)
        elif kind == "Predicate" and body["op"] in _COMPARED:
            self._compared(body)
        else:
            raise LookupError(kind)

    def _compared(self, body: Any) -> None:
        name = body["lhs"].get("Variable", "")
        # The truth of a condition is a column already, so nothing is compared.
        if name.startswith("_"):
            self._add(LOAD, 1, self.names.index(name))
            self._add(NUMBER, 0)
            return
        sides = [body["lhs"], body["rhs"]]
        for side in reversed(sides) if body["op"] in _REVERSED else sides:
            self._value(side, carries(side))
        self._add(SUBTRACT, -1)
        if body["op"] in ("Equal", "NotEqual"):
            self._add(MAGNITUDE, 0)
        if body["op"] == "Equal":
            self._add(NEGATE, 0)
        self._add(FINITE, 0)

    def _value(self, tree: Tree, visible: bool) -> None:
        """Add the instructions of an expression; `visible`: a NaN in a part of it stays NaN in its result."""
        ((kind, body),) = tree.items()
        if not variables(tree):
            self._add(CONSTANT, 1, len(self._constants))
            self._constants.append(tree)
            return
        if kind == "Variable":
            self._add(LOAD, 1, self.names.index(body))
            if not visible:
                self._add(NUMBER, 0)
            return
        name, operands = called(kind, body)
        operation = (_BINARY if kind == "Binary" else _CALLS)[name]
        self._value(operands[0], visible)
        if kind == "Call" and len(operands) == 1:
            self._add(operation, 0)
        for part in operands[1:]:
            self._value(part, visible)
            self._add(operation, -1)
        if not visible:
            self._add(FINITE, 0)


def _number(tree: Tree, numbers: Mapping[str, Any]) -> Any:
    literal = tree.get("Literal")
    return arithmetic(tree, numbers) if literal is None else numbers[literal] if isinstance(literal, str) else literal


@jit
def _load(row: Array, column: Array) -> None:
    # With an index that might be negative in the place of a part, the loop would not be vectorised.
    for i in range(column.shape[0]):
        row[i] = column[i]


@jit
def extreme(
    code: NDArray[np.int64],
    constants: Array,
    a: Array,
    b: Array,
    c: Array,
    d: Array,
    e: Array,
    f: Array,
    first: int,
    last: int,
    least: bool,
    edges: NDArray[np.int64],
) -> tuple[float, int, int]:
    """Return the extreme, its index, and the number of ends of spans below zero; -1 where something is no number."""
    stack = np.empty((DEPTH, BLOCK))
    value, index, count, below = (math.inf if least else -math.inf), first, 0, False
    start = first
    while start <= last:
        n = min(BLOCK, last + 1 - start)
        top = -1
        for k in range(code.shape[0]):
            operation, operand = code[k, 0], code[k, 1]
            if operation == LOAD:
                top += 1
                if operand == 0:
                    _load(stack[top], a[start : start + n])
                elif operand == 1:
                    _load(stack[top], b[start : start + n])
                elif operand == 2:
                    _load(stack[top], c[start : start + n])
                elif operand == 3:
                    _load(stack[top], d[start : start + n])
                elif operand == 4:
                    _load(stack[top], e[start : start + n])
                else:
                    _load(stack[top], f[start : start + n])
            elif operation == CONSTANT:
                top += 1
                number = constants[operand]
                for i in range(n):
                    stack[top, i] = number
            elif operation == ADD:
                top -= 1
                for i in range(n):
                    stack[top, i] = stack[top, i] + stack[top + 1, i]
            elif operation == SUBTRACT:
                top -= 1
                for i in range(n):
                    stack[top, i] = stack[top, i] - stack[top + 1, i]
            elif operation == MULTIPLY:
                top -= 1
                for i in range(n):
                    stack[top, i] = stack[top, i] * stack[top + 1, i]
            elif operation == DIVIDE:
                top -= 1
                for i in range(n):
                    stack[top, i] = stack[top, i] / stack[top + 1, i]
            elif operation == LEAST:
                top -= 1
                for i in range(n):
                    stack[top, i] = np.minimum(stack[top, i], stack[top + 1, i])
            elif operation == GREATEST:
                top -= 1
                for i in range(n):
                    stack[top, i] = np.maximum(stack[top, i], stack[top + 1, i])
            elif operation == NEGATE:
                for i in range(n):
                    stack[top, i] = -stack[top, i]
            elif operation == MAGNITUDE:
                for i in range(n):
                    stack[top, i] = abs(stack[top, i])
            elif operation == ROOT:
                for i in range(n):
                    stack[top, i] = math.sqrt(stack[top, i]) if stack[top, i] >= 0.0 else math.nan
            else:
                lost = 0
                for i in range(n):
                    # The difference of a number and itself is NaN for infinity and NaN only.
                    x = stack[top, i] - stack[top, i] if operation == FINITE else stack[top, i]
                    lost += 1 if x != x else 0
                if lost:
                    return value, index, -1
        row = stack[0]
        better = negative = 0
        # Counting is vectorised; only a block that has something new is looked at sample by sample.
        for i in range(n):
            better += 1 if (row[i] < value if least else row[i] > value) else 0
        for i in range(n):
            negative += 1 if row[i] < 0.0 else 0
        if better:
            for i in range(n):
                if row[i] < value if least else row[i] > value:
                    value, index = row[i], start + i
        if least and negative != (n if below else 0):
            for i in range(n):
                if (row[i] < 0.0) != below:
                    if count == edges.shape[0]:
                        return value, index, -1
                    edges[count] = start + i - (1 if below else 0)
                    count += 1
                    below = not below
        start += n
    if below:
        edges[count] = last
        count += 1
    return value, index, count
