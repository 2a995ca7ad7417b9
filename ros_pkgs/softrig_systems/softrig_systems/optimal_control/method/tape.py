"""Equations written as casadi expressions, carried out on power series: the tape of a function and its player.

A casadi SX function is a list of scalar instructions. `Tape.of` copies them with one slot for each result, and `expand`
runs them once for each power, so that the solution of dz/ds = T F(z) comes out coefficient by coefficient: z_(k+1) = T
F_k / (k + 1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from softrig_core import jit

from .series import exp_at, log_at, power_at, product_at, quotient_at, sin_cos_at

if TYPE_CHECKING:
    import casadi as ca
    from numpy.typing import NDArray
    from softrig_core import Array

    Index = NDArray[np.int64]

CONST, INPUT, ADD, SUB, NEG, MUL, DIV, SIN, COS, EXP, LOG, POWER, PARTNER, COPY = range(14)


class Tape(NamedTuple):
    """Instructions of a function of one vector, in the order in which they are carried out."""

    code: Index
    """(instructions,) what to do."""

    left: Index
    """(instructions,) place of the first operand; of an input its number."""

    right: Index
    """(instructions,) place of the second operand."""

    constant: Array
    """(instructions,) number of a constant, exponent of a power."""

    out: Index
    """(outputs,) place of each output."""

    @classmethod
    def of(cls, function: ca.Function) -> Tape:
        """Convert a casadi SX function of one vector with one output vector.

        Raises
        ------
        ValueError
            The function uses an operation that has no series here.
        """
        import casadi as ca

        binary = {ca.OP_ADD: ADD, ca.OP_SUB: SUB, ca.OP_MUL: MUL, ca.OP_DIV: DIV}
        unary = {ca.OP_NEG: NEG, ca.OP_SIN: SIN, ca.OP_COS: COS, ca.OP_EXP: EXP, ca.OP_LOG: LOG, ca.OP_ASSIGN: COPY}
        rows: list[tuple[int, int, int, float]] = []
        index_of: dict[int, int] = {}  # casadi's working place, which it uses again, to ours
        number: dict[int, float] = {}  # our place to the constant there
        written = function.sparsity_out(0).row()  # an entry that is structurally zero is written by no instruction
        outputs = [-1] * function.numel_out(0)

        def add(code: int, left: int = 0, right: int = 0, constant: float = 0.0) -> int:
            rows.append((code, left, right, constant))
            if code in (SIN, COS):
                rows.append((PARTNER, 0, 0, 0.0))  # its cosine or sine, directly after it
                return len(rows) - 2
            if code == CONST:
                number[len(rows) - 1] = constant
            return len(rows) - 1

        for k in range(function.n_instructions()):
            op = function.instruction_id(k)
            source, target = function.instruction_input(k), function.instruction_output(k)
            if op == ca.OP_OUTPUT:
                outputs[written[target[1]]] = index_of[source[0]]
                continue
            operands = [] if op in (ca.OP_INPUT, ca.OP_CONST) else [index_of[i] for i in source]
            if op == ca.OP_INPUT:
                index = add(INPUT, source[1])
            elif op == ca.OP_CONST:
                index = add(CONST, constant=function.instruction_constant(k))
            elif op in binary:
                index = add(binary[op], *operands)
            elif op in unary:
                index = add(unary[op], operands[0])
            elif op == ca.OP_SQ:
                index = add(MUL, operands[0], operands[0])
            elif op == ca.OP_TWICE:
                index = add(ADD, operands[0], operands[0])
            elif op == ca.OP_INV:
                index = add(DIV, add(CONST, constant=1.0), operands[0])
            elif op == ca.OP_SQRT:
                index = add(POWER, operands[0], constant=0.5)
            elif op in (ca.OP_POW, ca.OP_CONSTPOW) and operands[1] in number:
                index = _power(add, operands[0], number[operands[1]])
            else:
                raise ValueError(
                    f"{function.name()} uses casadi operation {op}, which has no power series here: "
                    "expected + - * /, sin, cos, exp, log, sqrt and constant powers"
                )
            index_of[target[0]] = index
        if -1 in outputs:
            zero = add(CONST)
            outputs = [zero if index < 0 else index for index in outputs]
        columns = list(zip(*rows, strict=True))
        code, left, right = (np.array(c, dtype=np.int64) for c in columns[:3])
        return cls(code, left, right, np.array(columns[3], dtype=float), np.array(outputs, dtype=np.int64))


def _power(add: object, base: int, exponent: float) -> int:
    """Compute integer powers as products, which have no singularity at 0; others by a recursion."""
    if exponent != int(exponent) or not 1 <= exponent <= 16:
        return add(POWER, base, constant=exponent)  # type: ignore[operator, no-any-return]
    index = base
    for _ in range(int(exponent) - 1):
        index = add(MUL, index, base)  # type: ignore[operator]
    return index


@jit
def play(tape: Tape, z: Array, work: Array, k: int) -> None:
    """Execute the tape for coefficient k; `work` has the coefficients below k, one row per place, z those up to k."""
    code, left, right = tape.code, tape.left, tape.right
    for i in range(code.shape[0]):
        op, a, b = code[i], left[i], right[i]
        if op == CONST:
            work[i, k] = tape.constant[i] if k == 0 else 0.0
        elif op == INPUT:
            work[i, k] = z[a, k]
        elif op == ADD:
            work[i, k] = work[a, k] + work[b, k]
        elif op == SUB:
            work[i, k] = work[a, k] - work[b, k]
        elif op == NEG:
            work[i, k] = -work[a, k]
        elif op == COPY:
            work[i, k] = work[a, k]
        elif op == MUL:
            work[i, k] = product_at(work[a], work[b], k)
        elif op == DIV:
            work[i, k] = quotient_at(work[a], work[b], work[i], k)
        elif op == SIN:
            work[i, k], work[i + 1, k] = sin_cos_at(work[a], work[i], work[i + 1], k)
        elif op == COS:
            work[i + 1, k], work[i, k] = sin_cos_at(work[a], work[i + 1], work[i], k)
        elif op == EXP:
            work[i, k] = exp_at(work[a], work[i], k)
        elif op == LOG:
            work[i, k] = log_at(work[a], work[i], k)
        elif op == POWER:
            work[i, k] = power_at(work[a], tape.constant[i], work[i], k)


@jit
def expand(tape: Tape, z: Array, more: Array, T: float) -> None:
    """Fill the series of dz/ds = T F(z), z(0) given in its column 0.

    The first outputs of the tape are F; the others, functions of z such as the control, go to `more`.

    Parameters
    ----------
    z : ndarray, (n_z, order + 1)
        Changed in place.
    more : ndarray, (outputs - n_z, order + 1)
        Changed in place.
    T : float
        Length of the time interval that s = 0 to 1 represents, s.
    """
    n, columns = z.shape
    work = np.zeros((tape.code.shape[0], columns))
    for k in range(columns):
        play(tape, z, work, k)
        if k + 1 < columns:
            for i in range(n):
                z[i, k + 1] = T * work[tape.out[i], k] / (k + 1)
        for i in range(more.shape[0]):
            more[i, k] = work[tape.out[n + i], k]


@jit
def evaluate(tape: Tape, points: Array, result: Array) -> None:
    """Evaluate a tape as an ordinary function: points (n, inputs) to result (n, outputs), changed in place."""
    work = np.zeros((tape.code.shape[0], 1))
    z = np.zeros((points.shape[1], 1))
    for row in range(points.shape[0]):
        for i in range(points.shape[1]):
            z[i, 0] = points[row, i]
        play(tape, z, work, 0)
        for i in range(result.shape[1]):
            result[row, i] = work[tape.out[i], 0]
