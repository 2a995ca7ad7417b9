r"""Arithmetic of truncated power series, coefficient by coefficient.

A series :math:`a(s) = \sum_k a_k s^k` is an array of its coefficients. Each ``*_at`` function gives coefficient k of a
result from the coefficients up to k of its operands and those below k of the result itself: the recursions that follow
from differentiating the definition (A. Griewank and A. Walther, Evaluating Derivatives, 2008, chapter 13). A product
costs k + 1 multiplications, so a series of degree n costs n^2/2 for each operation.

The functions without ``_at`` do the same for whole series of one length.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from softrig_core import jit
from softrig_core.kit.jit import power

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Series = NDArray[np.float64]


@jit
def product_at(a: Series, b: Series, k: int) -> float:
    r""":math:`c = a b`: :math:`c_k = \sum_{j=0}^k a_j b_{k-j}`."""
    total = 0.0
    for j in range(k + 1):
        total += a[j] * b[k - j]
    return total


@jit
def quotient_at(a: Series, b: Series, q: Series, k: int) -> float:
    r""":math:`q = a / b`: :math:`q_k = (a_k - \sum_{j=1}^k b_j q_{k-j}) / b_0`."""
    total = a[k]
    for j in range(1, k + 1):
        total -= b[j] * q[k - j]
    return total / b[0]


@jit
def sin_cos_at(a: Series, s: Series, c: Series, k: int) -> tuple[float, float]:
    r"""Sine and cosine of a: :math:`k s_k = \sum_{j=1}^k j a_j c_{k-j}`, :math:`k c_k = -\sum j a_j s_{k-j}`."""
    if k == 0:
        return math.sin(a[0]), math.cos(a[0])
    sine, cosine = 0.0, 0.0
    for j in range(1, k + 1):
        sine += j * a[j] * c[k - j]
        cosine -= j * a[j] * s[k - j]
    return sine / k, cosine / k


@jit
def exp_at(a: Series, e: Series, k: int) -> float:
    r""":math:`e = \exp a`: :math:`k e_k = \sum_{j=1}^k j a_j e_{k-j}`."""
    if k == 0:
        return math.exp(a[0])
    total = 0.0
    for j in range(1, k + 1):
        total += j * a[j] * e[k - j]
    return total / k


@jit
def power_at(a: Series, p: float, y: Series, k: int) -> float:
    r""":math:`y = a^p`: :math:`k a_0 y_k = \sum_{j=1}^k (p j - k + j) a_j y_{k-j}`; needs :math:`a_0 \ne 0`."""
    if k == 0:
        return power(a[0], p)
    total = 0.0
    for j in range(1, k + 1):
        total += (p * j - k + j) * a[j] * y[k - j]
    return total / (k * a[0])


@jit
def log_at(a: Series, y: Series, k: int) -> float:
    r""":math:`y = \log a`: :math:`k a_0 y_k = k a_k - \sum_{j=1}^{k-1} j y_j a_{k-j}`."""
    if k == 0:
        return math.log(a[0])
    total = k * a[k]
    for j in range(1, k):
        total -= j * y[j] * a[k - j]
    return total / (k * a[0])


@jit
def value(a: Series, s: float) -> float:
    """Value of a series at s, by Horner's rule."""
    total = 0.0
    for k in range(a.shape[0] - 1, -1, -1):
        total = total * s + a[k]
    return total


@jit
def slope(a: Series, s: float) -> float:
    """Derivative of a series at s."""
    total = 0.0
    for k in range(a.shape[0] - 1, 0, -1):
        total = total * s + k * a[k]
    return total


def product(a: Series, b: Series) -> Series:
    """Product of two series, both (n + 1,), truncated at degree n."""
    return np.array([product_at(a, b, k) for k in range(len(a))])


def quotient(a: Series, b: Series) -> Series:
    """Quotient of two series, both (n + 1,); b must not vanish at 0.

    Raises
    ------
    ZeroDivisionError
        The constant term of b is 0.
    """
    if b[0] == 0.0:
        raise ZeroDivisionError("division by a series whose constant term is 0")
    q = np.zeros(len(a))
    for k in range(len(a)):
        q[k] = quotient_at(a, b, q, k)
    return q


def exp(a: Series) -> Series:
    """Exponential of a series."""
    e = np.zeros(len(a))
    for k in range(len(a)):
        e[k] = exp_at(a, e, k)
    return e


def log(a: Series) -> Series:
    """Logarithm of a series with a positive constant term."""
    y = np.zeros(len(a))
    for k in range(len(a)):
        y[k] = log_at(a, y, k)
    return y
