"""The algebraic Riccati equation of sampled systems, and the feedback that minimises a quadratic cost."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np
from softrig_core.kit.dense import product, solve

from .discretise import Matrix

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from softrig_core import Array


# Largest residual of the equation, relative to the size of an entry: doubling may end at a matrix that is no solution.
RESIDUAL = 1e-7


def riccati(a: ArrayLike, g: ArrayLike, h: ArrayLike) -> Array | None:
    r"""Solution of the discrete Riccati equation :math:`X = A^T X (1 + G X)^{-1} A + H`, None if none is found.

    It uses doubling: each step equals as many steps of the recursion as all before it, with the same bits on every CPU.
    The result is inserted into the equation, and a matrix that does not solve it is not returned.

    .. math::
        A \leftarrow A W A, \quad G \leftarrow G + A W G A^T, \quad H \leftarrow H + A^T H W A, \quad W = (1 + G H)^{-1}

    Parameters
    ----------
    a, g, h : (n, n) array_like
        G and H symmetric, not negative.

    References
    ----------
    E. K.-W. Chu et al., Int. J. Systems Science 35, 2004.
    """
    A, G, H = (np.array(x, dtype=float) for x in (a, g, h))
    # A problem without a solution grows beyond all numbers, or iterates forever.
    with np.errstate(over="ignore", invalid="ignore"), suppress(np.linalg.LinAlgError):
        # Each step doubles the number of iterations of the recursion, so this limit stands for 2^60 of them.
        for _ in range(60):
            W = solve(np.eye(len(A)) + product(G, H), np.eye(len(A)))
            AW, more = product(A, W), product(product(A.T, H), product(W, A))
            G = G + product(product(AW, G), A.T)
            A, H = product(AW, A), H + more
            # A is the influence of the start on the result; below this it cannot change H any more.
            if np.max(np.abs(A)) < 1e-20:
                return H if _solves(H, *(np.array(x, dtype=float) for x in (a, g, h))) else None
    return None


def _solves(X: Array, A: Array, G: Array, H: Array) -> bool:
    r"""Return whether X is a solution, by :math:`A^T (1 + X G)^{-1} X A + H`: another form than the doubling's."""
    XA = product(X, A)
    right = product(A.T, solve(np.eye(len(A)) + product(X, G), XA)) + H
    # In a matrix without negative eigenvalues no entry is larger than the product of two of these, so they scale it.
    sizes = np.sqrt(np.abs(np.diag(X)))
    return bool(np.isfinite(X).all() and (np.abs(X - right) <= RESIDUAL * np.outer(sizes, sizes)).all())


def lqr(a: ArrayLike, b: ArrayLike, q: ArrayLike, r: ArrayLike) -> Matrix:
    r"""Gain K of the law :math:`u = -K x` that minimises :math:`\sum x^T Q x + u^T R u`.

    Of :math:`x_{k+1} = A x_k + B u_k`; a plant around a point has A and B in ``Sampled(plant).linearise(x, u)``.

    Parameters
    ----------
    a : (n, n) array_like
    b : (n, m) array_like
    q : (n,) or (n, n) array_like
        Weights of the states, or their matrix.
    r : (m,) or (m, m) array_like
        Weights of the inputs, all positive, or their matrix.

    Returns
    -------
    tuple of m tuples of n float

    Raises
    ------
    ValueError
        Sizes that do not fit, or there is no such controller, because a growing state is not controllable or has no
        weight.
    """
    A, B = np.array(a, dtype=float), np.array(b, dtype=float)
    Q, R = (np.diag(x) if x.ndim == 1 else x for x in (np.array(q, dtype=float), np.array(r, dtype=float)))
    n, m = B.shape if B.ndim == 2 else (0, 0)
    if A.shape != (n, n) or Q.shape != (n, n) or R.shape != (m, m):
        raise ValueError(
            f"A is {A.shape}, B {B.shape}, Q {Q.shape}, R {R.shape}: expected (n, n), (n, m), (n, n), (m, m)"
        )
    try:
        X = riccati(A, product(B, solve(R, B.T)), Q)
    except np.linalg.LinAlgError:
        X = None
    if X is None:
        raise ValueError("no such controller: R is singular, or an unstable state is not controllable or has no weight")
    XB = product(X, B)
    K = solve(R + product(B.T, XB), product(XB.T, A))
    return tuple(tuple(map(float, row)) for row in K)
