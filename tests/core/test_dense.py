"""The dense algebra against numpy's, its order of additions, and that plain Python gives the bits of native code."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, strategies as st
from softrig_core.kit import dense

RNG = np.random.default_rng(5)
SHAPES = [((3, 4), (4, 2)), ((4,), (4, 2)), ((3, 4), (4,)), ((4,), (4,)), ((1, 1), (1, 1)), ((2, 0), (0, 3))]


def draw(shape, kind):
    x = RNG.normal(size=shape)
    return x + 1j * RNG.normal(size=shape) if kind == "complex" else x


@pytest.mark.parametrize("kinds", [("real", "real"), ("complex", "real"), ("real", "complex"), ("complex", "complex")])
@pytest.mark.parametrize(("left", "right"), SHAPES)
def test_product_is_the_matrix_product(left, right, kinds):
    a, b = draw(left, kinds[0]), draw(right, kinds[1])
    result = dense.product(a, b)
    assert np.shape(result) == np.shape(a @ b)
    np.testing.assert_allclose(result, a @ b, rtol=1e-14, atol=1e-14)
    strided = dense.product(np.repeat(a, 2, axis=-1)[..., ::2], b)  # neither the order of memory nor strides matter
    np.testing.assert_array_equal(strided, result)


@given(st.lists(st.tuples(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9)), min_size=1, max_size=30))
def test_sums_are_added_from_the_first_term_to_the_last(pairs):
    total = 0.0
    for x, y in pairs:
        total += x * y
    a, b = np.array(pairs).T
    assert dense.product(a, b) == total


@pytest.mark.parametrize("kinds", [("real", "real"), ("complex", "real"), ("real", "complex"), ("complex", "complex")])
@pytest.mark.parametrize("columns", [(), (1,), (4,)])
@pytest.mark.parametrize("n", [1, 2, 7, 18])
def test_solve_solves(n, columns, kinds):
    a, b = draw((n, n), kinds[0]), draw((n, *columns), kinds[1])
    a[0, 0] = 0.0 if n > 1 else 2.0  # the zero forces an exchange of rows
    kept = a.copy(), b.copy()
    x = dense.solve(a, b)
    assert x.shape == b.shape
    np.testing.assert_allclose(a @ x, b, rtol=0, atol=1e-11)
    np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-8)
    np.testing.assert_array_equal(a, kept[0])  # arguments stay as they are
    np.testing.assert_array_equal(b, kept[1])


@pytest.mark.parametrize(
    "a",
    [
        [[1.0, 2.0], [2.0, 4.0]],
        [[0.0, 0.0], [0.0, 1.0]],
        [[math.nan, 1.0], [1.0, 1.0]],
        [[math.inf, 1.0], [1.0, 1.0]],
        [[1j, 1.0], [-1.0, 1j]],
    ],
)
def test_a_singular_matrix_is_refused(a):
    with pytest.raises(np.linalg.LinAlgError, match=r"of shape \(2, 2\) is singular or not finite"):
        dense.solve(a, [1.0, 2.0])


@pytest.mark.parametrize(
    ("function", "a", "b", "message"),
    [
        (dense.product, (2, 3), (2, 3), r"product of shapes \(2, 3\) and \(2, 3\)"),
        (dense.product, (2, 3), (2,), r"\(2, 3\) and \(2,\)"),
        (dense.product, (2, 2, 2), (2, 2), r"\(2, 2, 2\)"),
        (dense.solve, (2, 3), (2,), r"solve with shapes \(2, 3\)"),
        (dense.solve, (2, 2), (3,), r"\(2, 2\) and \(3,\)"),
        (dense.solve, (4,), (4,), r"solve with shapes \(4,\)"),
    ],
)
def test_mismatched_shapes_are_named(function, a, b, message):
    with pytest.raises(ValueError, match=message):
        function(np.ones(a), np.ones(b))


def test_norm_times_and_turn():
    x, a, b = RNG.normal(size=9), draw((3, 2), "complex"), draw((3, 1), "complex")
    assert dense.norm(x) == pytest.approx(np.linalg.norm(x), rel=1e-15)
    np.testing.assert_allclose(dense.times(a, b), a * b, rtol=1e-15)
    assert dense.times(2j, 3.0) == 6j
    angles = np.linspace(-9.0, 9.0, 50)
    np.testing.assert_allclose(dense.turn(angles), np.exp(1j * angles), atol=1e-15)


CODE = """
import hashlib, numpy as np, sys
from softrig_core.kit import dense
rng = np.random.default_rng(1)
digest = hashlib.sha256()
for n in (1, 3, 8, 18):
    a, b = rng.normal(size=(2, n, n)), rng.normal(size=(2, n, 3))
    for x, y in ((a[0], b[0]), (a[0] + 1j * a[1], b[0] + 1j * b[1])):
        digest.update(dense.product(x, y).tobytes() + dense.solve(x, y).tobytes() + dense.times(x, x).tobytes())
digest.update(dense.turn(rng.normal(size=500)).tobytes())
print(digest.hexdigest(), "numba" in sys.modules)
"""


@pytest.mark.long
def test_native_plain_and_every_kernel_give_the_same_bits():
    def choice(before="", **variables):
        done = subprocess.run([sys.executable, "-c", before + CODE], capture_output=True, text=True, check=True,
                              env=os.environ | variables)  # fmt: skip
        return done.stdout.split()

    native, compiled = choice("import numba\n")
    plain, loaded = choice(SOFTRIG_JIT="0")
    assert (compiled, loaded) == ("True", "False")
    assert native == plain
    assert (
        choice(OPENBLAS_CORETYPE="Prescott", NPY_ENABLE_CPU_FEATURES="X86_V2", NPY_DISABLE_CPU_FEATURES="")[0] == plain
    )
