"""Kernels against mpmath at 60 digits, beside scipy: sampling, polynomials, Riccati equations of all scales and orders.

Source: mpmath. `TABLE` has what the page numerics shows, the worst error of each kind, ours and those of scipy.
"""

import math
import re
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from conftest import few
from softrig_control import transfer
from softrig_control.discretise import expm, zero_order_hold
from softrig_control.predictive.carima import Carima
from softrig_control.riccati import lqr, riccati
from softrig_control.state_feedback import place
from softrig_core.kit import exact
from softrig_core.kit.dense import solve

DIGITS = 60
PAGE = Path(__file__).parents[2] / "ros_pkgs/softrig_core/doc/numerics.md"


@pytest.fixture(autouse=True)
def digits():
    with mpmath.workdps(DIGITS):
        yield


def high(a):
    return mpmath.matrix(np.asarray(a, dtype=float).tolist())


def scaled(rng, n, decades=12):
    return 10.0 ** rng.uniform(-decades, decades, n)


def matrices(kind, rng):
    """Draw matrices of orders up to 20, fewer for larger orders."""
    for n in (1, 2, 3, 4, 6, 9, 20):
        a = rng.normal(size=(n, n)) / math.sqrt(n)
        if kind == "plain":
            yield 3.0 * a
        elif kind == "scaled":
            s = scaled(rng, n)
            yield a * s[:, None] / s
        elif kind == "stiff":
            yield np.diag(-(10.0 ** rng.uniform(-12, 2, n))) + np.tril(a, -1)
        elif kind == "near-defective":
            yield -np.eye(n) + np.triu(a, 1) + 1e-10 * rng.normal(size=(n, n))
        else:
            yield 1e-12 * a


def right_expm(a):
    """By the Taylor series of mpmath after many halvings: a method other than that of `exact`."""
    n, halvings = len(a), 60
    x, result, term = high(a) / mpmath.mpf(2) ** halvings, mpmath.eye(len(a)), mpmath.eye(len(a))
    for k in range(1, 9):
        term = term * x / k
        result += term
    for _ in range(halvings):
        result = result * result
    return np.array([[float(result[i, j]) for j in range(n)] for i in range(n)])


def off(result, right):
    return float(np.max(np.abs(np.asarray(result, dtype=float) - right)) / np.max(np.abs(right)))


def worst_of_exponentials(kind):
    rng = np.random.default_rng(60)
    own = reference = 0.0
    for a in matrices(kind, rng):
        if len(a) > 6:
            # mpmath checks this function for smaller matrices.
            right = np.array(exact.settled(exact.exponentials(exact.fractions(a.tolist()))))
        else:
            with mpmath.workdps(3 * DIGITS):
                right = right_expm(a)
            assert np.array(exact.settled(exact.exponentials(exact.fractions(a.tolist())))) == pytest.approx(
                right, rel=1e-15, abs=1e-300
            )
        own, reference = max(own, off(expm(a.tolist()), right)), max(reference, off(scipy.linalg.expm(a), right))
    return own, reference


def riccatis(kind, rng):
    for n in (1, 2, 4, 7):
        a, b = 0.9 * rng.normal(size=(n, n)) / math.sqrt(n), rng.normal(size=(n, 1))
        q = np.eye(n)
        if kind == "scaled":
            s = scaled(rng, n, 6)
            a, b, q = a * s[:, None] / s, b * s[:, None], np.diag(1.0 / s**2)
        elif kind == "slow":
            a, b = np.eye(n) + 1e-5 * a, 1e-5 * b
        elif kind == "unstable":
            a = 3.0 * a
        elif kind == "stiff":
            a = np.diag(10.0 ** rng.uniform(-12, 0, n))
        yield a, b, q


def right_riccati(a, b, q):
    A, G, H, one = high(a), high(b) * high(b).T, high(q), mpmath.eye(len(a))
    while mpmath.mnorm(A, 1) > mpmath.mpf(10) ** -45:
        W = (one + G * H) ** -1
        A, G, H = A * W * A, G + A * W * G * A.T, H + A.T * H * W * A
    return np.array([[float(H[i, j]) for j in range(len(a))] for i in range(len(a))])


def worst_of_riccatis(kind):
    rng = np.random.default_rng(61)
    own = reference = 0.0
    for a, b, q in riccatis(kind, rng):
        right = right_riccati(a, b, q)
        own = max(own, off(riccati(a, b @ b.T, q), right))
        reference = max(reference, off(scipy.linalg.solve_discrete_are(a, b, q, [[1.0]]), right))
    return own, reference


def worst_of_solutions(kind):
    rng = np.random.default_rng(62)
    own = reference = 0.0
    for n in (1, 2, 5, 10, 20):
        a, x = rng.normal(size=(n, n)), rng.normal(size=n)
        if kind == "scaled":
            a = scaled(rng, n)[:, None] * a
        elif kind == "near-singular" and n > 1:
            a[-1] = a[0] + 1e-8 * a[-1]
        b = a @ x
        right = np.array([float(v) for v in mpmath.lu_solve(high(a), mpmath.matrix(b.tolist()))])
        own, reference = max(own, off(solve(a, b), right)), max(reference, off(np.linalg.solve(a, b), right))
    return own, reference


TABLE = {
    **{
        ("matrix exponential", kind): worst_of_exponentials
        for kind in ("plain", "scaled", "stiff", "near-defective", "tiny")
    },
    **{("Riccati equation", kind): worst_of_riccatis for kind in ("plain", "scaled", "slow", "unstable", "stiff")},
    **{("linear equations", kind): worst_of_solutions for kind in ("plain", "scaled", "near-singular")},
}


@pytest.mark.parametrize(("kernel", "kind"), few(TABLE, 3))
def test_no_kernel_is_ten_times_worse_than_scipys_and_the_page_has_the_errors(kernel, kind):
    own, reference = TABLE[kernel, kind](kind)
    assert own <= max(10.0 * reference, 4e-15)
    row = re.search(rf"^\| {kernel} \| {kind} \| (\S+) \| (\S+) \|$", PAGE.read_text(), re.M)
    assert row, f"| {kernel} | {kind} | {own:.0e} | {reference:.0e} |"
    for shown, result in zip(row.groups(), (own, reference), strict=True):
        assert max(result, 1e-17) == pytest.approx(max(float(shown), 1e-17), rel=9.0), f"{own:.0e} {reference:.0e}"


def test_an_exponential_has_its_closed_form():
    assert expm([[-1e12]]) == ((0.0,),)
    assert expm([[-200.0]])[0][0] == pytest.approx(math.exp(-200.0), rel=1e-15)
    assert expm([[0.0, 1e12], [0.0, 0.0]]) == ((1.0, 1e12), (0.0, 1.0))
    (a, b), (c, d) = expm(
        [[-1.0, 1e-12], [0.0, -1.0 - 1e-9]]
    )  # close to a Jordan block: b = 1e-12 (e^-d - e^-a)/(d - a)
    assert (a, c, d) == (math.exp(-1.0), 0.0, pytest.approx(math.exp(-1.0 - 1e-9), rel=1e-15))
    assert b == pytest.approx(1e-12 * math.exp(-1.0) * (1.0 - 0.5e-9), rel=1e-15)
    turn, rate = expm([[0.0, 1e6], [-1e-6, 0.0]]), 1.0  # an oscillator whose states have units of very different size
    assert turn[0] == (pytest.approx(math.cos(rate)), pytest.approx(1e6 * math.sin(rate)))


@pytest.mark.parametrize(
    ("a", "message"),
    [
        ([[800.0]], "beyond the range of float64"),
        ([[1e300]], "beyond the range of float64"),
        ([[math.inf]], "expected finite ones"),
        ([[math.nan]], "expected finite ones"),
    ],
)
def test_a_matrix_without_an_exponential_is_refused(a, message):
    with pytest.raises(ValueError, match=message):
        expm(a)


def modal(modes, damping):
    """1 over the product of (s/w)^2 + 2 d s/w + 1, and its step response by residues at 60 digits."""
    den = [1.0]
    for w in modes:
        den = np.polymul(den, [1.0 / w**2, 2.0 * damping / w, 1.0])
    exactly = [mpmath.mpf(x) for x in den.tolist()]
    poles = mpmath.polyroots(exactly, maxsteps=400, extraprec=500)
    n = len(exactly) - 1
    slopes = [mpmath.polyval([c * (n - i) for i, c in enumerate(exactly[:-1])], p) for p in poles]

    def step(t):
        return float((1 / exactly[-1] + sum(mpmath.exp(p * t) / (p * s) for p, s in zip(poles, slopes))).real)

    return den.tolist(), step


@pytest.mark.parametrize(
    ("modes", "damping", "period"),
    [
        (2.0 * math.pi * np.geomspace(0.8, 16.0, 7), 0.01, 0.01),
        (np.geomspace(1.0, 30.0, 4), 0.01, 1e-3),
        (2.0 * math.pi * 1e3 * np.array([0.9, 1.0, 1.1]), 0.5, 1e-4),
        (np.geomspace(1e-3, 1e3, 5), 0.7, 0.1),
        pytest.param(np.geomspace(1.0, 100.0, 10), 0.002, 0.02, marks=pytest.mark.long),
    ],
)
def test_a_transfer_function_of_high_order_has_the_response_of_its_residues(modes, damping, period):
    den, step = modal(modes, damping)
    samples = 2000
    result = transfer.sample_transfer_function((1.0,), den, period).step_response(samples)
    at = range(1, samples + 1, 37)
    right = [step(mpmath.mpf(period) * k) for k in at]
    assert [result[k - 1] for k in at] == pytest.approx(right, abs=1e-9 * max(map(abs, right)))


def test_sampling_does_not_depend_on_units():
    """A filter at 1 Hz in seconds is one at 1 GHz in nanoseconds: the same numbers except for rounding."""
    num, den = scipy.signal.butter(6, 2.0 * math.pi, analog=True)
    slow = transfer.sample_transfer_function(num.tolist(), den.tolist(), 0.05).step_response(100)
    fast = transfer.sample_transfer_function(
        (num * 1e54).tolist(), (den * 1e9 ** np.arange(7)).tolist(), 0.05e-9
    ).step_response(100)
    assert fast == pytest.approx(slow, abs=1e-12)


@pytest.mark.parametrize(
    ("num", "den", "message"),
    [
        ((1.0,), (1.0, math.inf), r"num = \[1.0\], den = \[1.0, inf\]: expected finite numbers"),
        ((1.0,), (1e-200, 1.0, 1e200), "expected finite|cannot be sampled"),
        ((1.0,), (1.0, -1e5), "the transfer function of order 1 cannot be sampled with a period of 0.1 s: .*float64"),
    ],
)
def test_a_transfer_function_beyond_float64_is_refused(num, den, message):
    with pytest.raises(ValueError, match=message):
        transfer.sample_transfer_function(num, den, 0.1)


def test_a_sampled_system_that_fails_its_check_is_refused(monkeypatch):
    with monkeypatch.context() as m:
        m.setattr(transfer, "zero_order_hold", lambda a, b, T: (((0.9 + 2e-9,),), ((0.1,),)))
        m.setattr(transfer, "sampled_exactly", transfer.sampled_exactly.__wrapped__)
        with pytest.raises(ValueError, match=r"would be off by .* of its largest value, expected at most 1e-09"):
            transfer.sample_transfer_function((1.0,), (1.0, 1.0), 0.1)


@pytest.mark.parametrize("order", [1, 2, 3, 5, 8])
def test_a_difference_equation_has_the_polynomials_of_its_poles(order):
    """A(z) is the product of the z - e^(p T), at 60 digits; B(z) gives the response of the sampled system."""
    poles = [-1.0 * k for k in range(1, order + 1)]
    den = np.poly(poles).tolist()
    model = Carima.from_continuous((3.0,), den, 0.5)
    right = [mpmath.mpf(1)]
    for p in poles:
        z = mpmath.exp(mpmath.mpf(p) / 2)
        right = [up - z * down for up, down in zip([*right, mpmath.mpf(0)], [mpmath.mpf(0), *right], strict=True)]
    assert model.a == pytest.approx([float(x) for x in right], rel=1e-13)
    wanted = transfer.sample_transfer_function((3.0,), den, 0.5).step_response(60)
    assert model.step_response(60) == pytest.approx(wanted, rel=1e-11)


def test_a_difference_equation_that_floats_cannot_represent_is_refused():
    den, _ = modal(np.geomspace(1.0, 30.0, 6), 0.05)
    with pytest.raises(ValueError, match="the step response of the difference equation of order 12 would be off by"):
        Carima.from_continuous((1.0,), den, 0.01)
    slow = zero_order_hold([[-1.0, 1.0], [0.0, -2.0]], [[0.0], [1.0]], 0.5)
    assert Carima.from_state_space(*slow, (1.0, 0.0)).a == pytest.approx(
        (1.0, -math.exp(-0.5) - math.exp(-1.0), math.exp(-1.5))
    )


def test_a_matrix_that_does_not_solve_its_riccati_equation_is_not_returned(monkeypatch):
    assert riccati([[0.5]], [[1.0]], [[1.0]]) == pytest.approx((math.sqrt(0.25**2 + 4.0) + 0.25) / 2.0)
    monkeypatch.setattr("softrig_control.riccati.RESIDUAL", -1.0)
    with pytest.raises(ValueError, match="no such controller"):
        lqr([[0.5]], [[1.0]], [1.0], [1.0])


def test_balancing_preserves_a_matrix_and_equalises_its_rows_and_columns():
    rng = np.random.default_rng(3)
    s = scaled(rng, 6)
    a = rng.normal(size=(6, 6)) * s[:, None] / s
    rows = exact.fractions(a.tolist())
    balanced, exponents = exact.balance(rows)
    for i in range(6):
        for j in range(6):
            assert balanced[i][j] * Fraction(2) ** (exponents[i] - exponents[j]) == rows[i][j]
    sizes = np.abs(np.array(balanced, dtype=float))
    np.fill_diagonal(sizes, 0.0)
    assert np.max(np.abs(np.log2(sizes.sum(axis=0) / sizes.sum(axis=1)))) < 4.0


def test_a_number_that_never_settles_has_no_settling_time():
    with pytest.raises(exact.UnsettledError, match="not settled with 6400 bits"):
        exact.settled(lambda bits: bits)


@pytest.mark.parametrize("order", [1, 2, 4, 6])
def test_gains_of_a_plant_in_other_units_are_the_same_gains_in_other_units(order):
    """Units by powers of two, whose scaling rounds nothing: k_i x_i stays, however different the units are."""
    rng = np.random.default_rng(order)
    a, b, c = rng.normal(size=(order, order)), rng.normal(size=order), rng.normal(size=order)
    poles = [-1.0 - k for k in range(order + 1)]
    right = place(a.tolist(), b.tolist(), c.tolist(), poles)
    units = 2.0 ** rng.integers(-40, 40, order)
    result = place((a * units[:, None] / units).tolist(), (b * units).tolist(), (c / units).tolist(), poles)
    assert np.array(result.k) * units == pytest.approx(np.array(right.k), rel=1e-9)
    assert result.ki == pytest.approx(right.ki, rel=1e-9)


def test_gains_that_do_not_give_the_wanted_poles_are_not_returned(monkeypatch):
    a, b, c = [[-1.0, 0.0], [0.0, -2.0]], [1.0, 1.0], [1.0, 2.0]
    assert place(a, b, c, [-3.0, -4.0, -5.0]).ki
    monkeypatch.setattr("softrig_core.kit.dense.solve", lambda reach, right: 1.001 * np.linalg.solve(reach, right))
    with pytest.raises(ValueError, match="not controllable"):
        place(a, b, c, [-3.0, -4.0, -5.0])
