"""What measurements prove about a falling characteristic, against all pairs of them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from softrig_optim.falling import FallingCurve


def brute(samples):
    """Largest change that two measurements prove: on one falling curve no point exceeds another in both."""
    rises = [min(a / x, b / y) for a, b in samples for x, y in samples]
    return max(1.0, *rises) ** 2 - 1.0


def changes(curve, samples):
    """What each sample contradicts of those before it."""
    result = []
    for sample in samples:
        change, curve = curve.with_sample(sample)
        result.append(change)
    return result


@given(st.lists(st.tuples(st.floats(0.01, 100.0), st.floats(0.01, 5.0)), min_size=1, max_size=40))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_any_two_measurements_are_compared(samples):
    assert max(changes(FallingCurve(1), samples)) == pytest.approx(brute(samples), rel=1e-12)


@given(st.lists(st.floats(0.0, 20.0), min_size=1, max_size=200), st.sampled_from([1, 3, 10]))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_measurements_of_one_characteristic_do_not_contradict(voltages, n):
    samples = [(v, max(3.8 - 0.01 * math.expm1(v / 3.2), 0.0), 25.0) for v in voltages]
    assert changes(FallingCurve(n), samples) == [0.0] * len(voltages)


@given(st.lists(st.tuples(st.floats(0.0, 60.0), st.floats(0.8, 1.2)), max_size=80), st.sampled_from([1, 3, 10]))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_native_code_keeps_the_same_corners(samples, n):
    """For many contradicting measurements, stored in both forms; and in turn."""
    curve = FallingCurve(n)
    rows = curve.native()
    for k, (v, share) in enumerate(samples):
        sample = (v, max(3.8 - 0.01 * math.expm1(v / 15.0), 0.0) * share, 25.0)
        wanted, curve = curve.with_sample(sample)
        result, rows = rows.with_sample(sample)
        assert (result, rows.python()) == (wanted, curve)
        rows = curve.native() if k % 7 == 6 else rows


def test_noise_is_within_a_corner_and_a_change_is_not():
    rng = np.random.default_rng(1)
    samples = []
    for k in range(5000):
        v = 10.0 + 8.0 * math.sin(0.002 * k)
        i = (3.0 if k < 4000 else 2.7) - 0.05 * v
        samples.append((v * (1.0 + 0.01 * rng.standard_normal()), i * (1.0 + 0.01 * rng.standard_normal())))
    change = changes(FallingCurve(10), samples)
    assert max(change[:4000]) < 0.01
    assert 0.1 < max(change[4010:]) < 0.4
