"""Sums of native code against numpy's: the same bits for any number of terms."""

import numpy as np
import pytest
from softrig_core.judge import measures, sums
from softrig_core.kit.jit import Jit
from softrig_drives.induction_dtc import figures

SIZES = [1, 2, 3, 4, 5, 7, 8, 9, 63, 64, 65, 71, 72, 127, 128, 129, 135, 136, 137, 255, 257, 1000]


def numbers(size, seed):
    """Return numbers of several orders of magnitude, whose sum depends on the order of additions, and zeros."""
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=size)
        * 10.0 ** rng.integers(-3, 4, size)
        * rng.choice([1.0, 0.0, -0.0], size, p=[0.9, 0.05, 0.05])
    )


def bits(x):
    return np.array([x]).tobytes()


@pytest.fixture(params=["read", pytest.param("compiled", marks=pytest.mark.long)])
def native(request, monkeypatch):
    """Use the functions at the first call, as Python reads them or compiled."""
    for module, name in ((measures, "squares"), (figures, "products")):
        function = getattr(module, name)
        if request.param == "read":
            function = Jit(function.py_func).straight()
        monkeypatch.setattr(function, "pays", lambda *given: True, raising=False)
        monkeypatch.setattr(module, name, function)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.usefixtures("native")
def test_a_sum_of_squares_is_that_of_numpy(size):
    x = numbers(size, size)
    for middle in (0.0, float(x.mean())):
        assert bits(measures.squares(x, middle, sums.pairs(size))) == bits(((x - middle) ** 2).sum())
    even = np.full(size, 1e6)
    assert bits(measures.mean_square_over(x, even)) == bits(float(np.mean(x**2)))
    assert bits(measures.mean_square_over(x, even, 0.25)) == bits(float(np.mean((x - 0.25) ** 2)))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.usefixtures("native")
def test_a_sum_of_complex_products_is_that_of_numpy(size):
    x, y, weights = (numbers(size, seed) for seed in (1, 2, 3))
    psi = np.empty(size, np.complex128)
    psi.real, psi.imag = (x - 0.5) * weights, (y + 0.25) * weights
    result = figures.products(x, y, 0.5, -0.25, weights, sums.pairs(size, 2))
    assert bits(complex(*result)) == bits(complex(psi.sum()))
    t = np.arange(size) * 1e-3
    whole = x + 1j * y
    whole.real, whole.imag = x, y
    assert bits(figures._slope(t, x, y)) == bits(figures.slope(t, whole))


def test_a_sum_of_negative_zeros_has_the_sign_of_numpy():
    zeros, psi = np.full(3, -0.0), np.empty(3, np.complex128)
    psi.real = psi.imag = zeros
    result = Jit(sums.products.py_func).straight()(zeros, zeros, 0.0, 0.0, np.ones(3), sums.pairs(3, 2))
    assert bits(complex(*result)) == bits(complex(psi.sum()))


def test_uneven_gaps_are_weighed():
    x, gaps = np.array([1.0, 2.0, 4.0]), np.array([1.0, 2.0, 1.0])
    assert measures.mean_square_over(x, gaps) == (1.0 + 8.0 + 16.0) / 4.0
