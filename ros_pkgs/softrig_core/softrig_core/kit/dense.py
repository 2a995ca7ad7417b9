"""Small dense algebra with one order of additions: the same bits on every CPU, unlike BLAS and LAPACK.

For matrices of a model's size, up to some tens of rows. Complex numbers are worked out in real arithmetic: numpy fuses
the multiplication of complex arrays on some CPUs and not on others.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .jit import Jit, jit

Number = TypeVar("Number", float, complex)
# Plain Python does so many multiplications in some milliseconds, while loading numba takes longer.
FEW = 20_000


@jit
def _product(a: Any, b: Any, out: Any) -> None:
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
        # The loop over k is outside j: each sum keeps its order, yet many can be added at a time.
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]


@jit
def _eliminate(a: Any, b: Any) -> bool:
    """Turn b into the solution of a x = b, both changed; False where a is singular."""
    n, m = b.shape
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[pivot, k]):
                pivot = i
        # This also catches NaN, which compares false.
        if not 0.0 < abs(a[pivot, k]) < math.inf:
            return False
        if pivot != k:
            for j in range(n):
                a[k, j], a[pivot, j] = a[pivot, j], a[k, j]
            for j in range(m):
                b[k, j], b[pivot, j] = b[pivot, j], b[k, j]
        for i in range(k + 1, n):
            factor = a[i, k] / a[k, k]
            for j in range(k + 1, n):
                a[i, j] -= factor * a[k, j]
            for j in range(m):
                b[i, j] -= factor * b[k, j]
    for k in range(n - 1, -1, -1):
        for j in range(m):
            total = b[k, j]
            for i in range(k + 1, n):
                total -= a[k, i] * b[i, j]
            b[k, j] = total / a[k, k]
    return True


def _run(kernel: Any, terms: int, *arrays: NDArray[np.float64]) -> Any:
    """Run a kernel; with few terms natively only if numba is already loaded, because loading takes longer; same
    bits.
    """
    plain = terms < FEW and "numba" not in sys.modules and isinstance(kernel, Jit)
    return (kernel.py_func if plain else kernel)(*arrays)


def _matrix(x: Any) -> NDArray[np.float64]:
    """Return an own copy in C order: one signature for the compiler."""
    return np.array(x, dtype=np.float64, order="C")


def product(a: ArrayLike, b: ArrayLike) -> Any:
    """Multiply as ``a @ b``, sums from the first term to the last.

    Parameters
    ----------
    a : array_like, shape (n, k) or (k,)
        Real or complex.
    b : array_like, shape (k, m) or (k,)

    Returns
    -------
    ndarray or float or complex

    Raises
    ------
    ValueError
        Shapes that do not fit.
    """
    A, B = np.asarray(a), np.asarray(b)
    left, right = np.atleast_2d(A), B[:, None] if B.ndim == 1 else B
    if left.ndim != 2 or right.ndim != 2 or left.shape[1] != right.shape[0]:
        raise ValueError(f"product of shapes {A.shape} and {B.shape}: the inner sizes differ")
    n, m = left.shape[0], right.shape[1]
    if left.dtype.kind == "c" or right.dtype.kind == "c":
        # numpy fuses complex multiplications on some CPUs, so the real and imaginary parts are multiplied as real
        # matrices.
        parts = np.empty((2 * n, 2 * m))
        _run(
            _product,
            4 * left.size * m,
            _matrix(np.vstack([left.real, left.imag])),
            _matrix(np.hstack([right.real, right.imag])),
            parts,
        )
        out: NDArray[Any] = np.empty((n, m), dtype=np.complex128)
        out.real, out.imag = parts[:n, :m] - parts[n:, m:], parts[:n, m:] + parts[n:, :m]
    else:
        out = np.empty((n, m))
        _run(_product, left.size * m, _matrix(left), _matrix(right), out)
    out = out[0] if A.ndim == 1 else out
    return out[..., 0] if B.ndim == 1 else out


def solve(a: ArrayLike, b: ArrayLike) -> Any:
    """Solve a x = b by Gauss's elimination with row pivots.

    Parameters
    ----------
    a : array_like, shape (n, n)
        Real or complex.
    b : array_like, shape (n,) or (n, m)

    Returns
    -------
    ndarray, shape of b

    Raises
    ------
    ValueError
        Shapes that do not fit.
    numpy.linalg.LinAlgError
        The matrix is singular, or not finite.
    """
    A, B = np.asarray(a), np.asarray(b)
    n = A.shape[0]
    if A.shape != (n, n) or B.shape[:1] != (n,) or B.ndim > 2:
        raise ValueError(f"solve with shapes {A.shape} and {B.shape}: expected (n, n) and (n,) or (n, m)")
    right = B[:, None] if B.ndim == 1 else B
    is_complex = A.dtype.kind == "c" or B.dtype.kind == "c"
    # A complex system of n rows is a real one of 2 n rows.
    left, x = (
        (np.block([[A.real, -A.imag], [A.imag, A.real]]), np.vstack([right.real, right.imag]))
        if is_complex
        else (A, right)
    )
    x = _matrix(x)
    if not _run(_eliminate, left.size * (left.shape[0] + x.shape[1]), _matrix(left), x):
        raise np.linalg.LinAlgError(f"a matrix of shape {A.shape} is singular or not finite")
    if is_complex:
        out = np.empty(right.shape, dtype=np.complex128)
        out.real, out.imag = x[:n], x[n:]
        x = out  # type: ignore[assignment]
    return x[:, 0] if B.ndim == 1 else x


def total(values: Iterable[Number]) -> Number:
    """Add floats or complex numbers from first to last, as `sum` did before it compensated rounding.

    Python's `sum` does so for floats since 3.12 and for complex numbers since 3.14: its bits depend on the version.
    """
    result: Number = 0.0
    for value in values:
        result += value
    return result


def norm(x: ArrayLike) -> float:
    """Return the Euclidean length of a real vector, summed from the first term to the last."""
    return math.sqrt(total(value * value for value in np.asarray(x, dtype=np.float64).ravel().tolist()))


def times(a: ArrayLike, b: ArrayLike) -> NDArray[np.complex128]:
    """Multiply complex arrays, element by element; shapes are broadcast."""
    A, B = np.asarray(a), np.asarray(b)
    real = A.real * B.real - A.imag * B.imag
    out = np.empty(np.shape(real), dtype=np.complex128)
    out.real, out.imag = real, A.real * B.imag + A.imag * B.real
    return out


def turn(angle: ArrayLike) -> NDArray[np.complex128]:
    """Return e^(j angle) of angles in rad."""
    angles = np.asarray(angle, dtype=np.float64)
    out = np.empty(angles.shape, dtype=np.complex128)
    # numpy takes sine and cosine from the C library at every level of its kernels, unlike exp.
    out.real, out.imag = np.cos(angles), np.sin(angles)
    return out
