"""Metric functions against responses whose figures are known in closed form."""

import math

import numpy as np
import pytest
from softrig_core.judge import measures

T = np.linspace(0.0, 20.0, 20001)
FIRST_ORDER = {"y": (T, 3.0 * (1.0 - np.exp(-T)))}
ZETA, OMEGA = 0.5, 2.0
DAMPED = OMEGA * math.sqrt(1.0 - ZETA**2)


def second_order(t):
    decay = np.exp(-ZETA * OMEGA * t)
    return 1.0 - decay * (np.cos(DAMPED * t) + ZETA * OMEGA / DAMPED * np.sin(DAMPED * t))


SECOND_ORDER = {"y": (T, second_order(T))}


def test_an_error_settles_at_its_first_sample_its_last_or_never():
    error = {"y": (np.arange(4.0), np.array([0.0, 2.0, 2.0, 0.5]))}
    results = [measures.error_settling_time(error, "y", band=band) for band in (2.0, 0.5, 0.4)]
    assert results == [0.0, 3.0, math.inf]


def test_first_order_rise_and_settling_are_exact():
    assert measures.rise_time(FIRST_ORDER, "y", final=3.0) == pytest.approx(math.log(9.0), abs=1e-6)
    assert measures.settling_time(FIRST_ORDER, "y", final=3.0) == pytest.approx(math.log(50.0), abs=1e-6)
    assert measures.settling_time(FIRST_ORDER, "y", final=3.0, band=0.05) == pytest.approx(math.log(20.0), abs=1e-6)
    assert measures.overshoot(FIRST_ORDER, "y", final=3.0) == 0.0


def test_interpolation_makes_coarse_samples_accurate():
    coarse = {"y": (T[::100], FIRST_ORDER["y"][1][::100])}
    assert measures.rise_time(coarse, "y", final=3.0) == pytest.approx(math.log(9.0), abs=2e-3)
    assert measures.settling_time(coarse, "y", final=3.0) == pytest.approx(math.log(50.0), abs=2e-3)
    first_inside = math.ceil(math.log(50.0) * 10) / 10
    assert measures.settling_time(coarse, "y", final=3.0, at="sample") == pytest.approx(first_inside, abs=1e-12)


def test_second_order_overshoot_and_settling_are_exact():
    peak = 100.0 * math.exp(-math.pi * ZETA / math.sqrt(1.0 - ZETA**2))
    assert measures.overshoot(SECOND_ORDER, "y", final=1.0) == pytest.approx(peak, abs=1e-4)
    ts = measures.settling_time(SECOND_ORDER, "y", final=1.0)
    assert abs(second_order(ts) - 1.0) == pytest.approx(0.02, abs=1e-6)
    assert np.all(np.abs(second_order(np.linspace(ts + 1e-5, 20.0, 10000)) - 1.0) < 0.02)


def test_the_last_exit_counts_not_the_first_entry():
    t = np.arange(6.0)
    signals = {"y": (t, np.array([0.0, 1.0, 1.0, 1.1, 1.0, 1.0]))}
    assert measures.settling_time(signals, "y", final=1.0) == pytest.approx(3.8)
    assert measures.settling_time(signals, "y", final=1.0, at="sample") == 4.0


def test_a_downward_step_inside_a_record_is_measured():
    t = np.linspace(0.0, 10.0, 10001)
    signals = {"y": (t, np.where(t < 4.0, 40.0, 40.0 * np.exp(-2.0 * (t - 4.0))))}
    step = {"initial": 40.0, "final": 0.0, "start": 4.0}
    assert measures.rise_time(signals, "y", **step) == pytest.approx(math.log(9.0) / 2.0, abs=1e-6)
    assert measures.settling_time(signals, "y", **step) == pytest.approx(math.log(50.0) / 2.0, abs=1e-6)


def test_the_final_value_is_the_last_sample_by_default():
    y7 = 1.0 - math.exp(-1.5)
    signals = {"y": (T[T <= 1.5], 1.0 - np.exp(-T[T <= 1.5]))}
    expected = -math.log(1.0 - 0.9 * y7) + math.log(1.0 - 0.1 * y7)
    assert measures.rise_time(signals, "y") == pytest.approx(expected, abs=1e-6)


def test_a_level_that_is_never_reached_takes_infinite_time():
    short = {"y": (T[:1000], FIRST_ORDER["y"][1][:1000])}
    assert measures.rise_time(short, "y", final=3.0) == math.inf
    assert measures.rise_time(short, "y", final=1e6) == math.inf  # the signal does not even reach the lower level
    assert measures.settling_time(short, "y", final=3.0) == math.inf


def test_a_level_reached_at_the_start_takes_no_time():
    assert measures.settling_time({"y": (T, np.ones_like(T))}, "y", final=1.0, start=3.0) == pytest.approx(
        0.0, abs=1e-9
    )


def test_total_variation_is_per_second():
    t = np.arange(0.0, 10.0, 0.01)
    square = {"u": (t, np.where(np.arange(t.size) % 2, -0.5, 0.5))}
    assert measures.total_variation(square, "u") == pytest.approx(100.0)
    assert measures.total_variation(square, "u", start=3.0, end=5.0) == pytest.approx(100.0)
    assert measures.total_variation({"u": (t, 3.0 * t)}, "u", start=2.0) == pytest.approx(3.0)


def test_statistics_of_a_sine_are_exact():
    t = np.linspace(0.0, 2.0 * math.pi, 100001)[:-1]
    signals = {"y": (t, 2.0 * np.sin(t) + 0.5), "r": (t[::2], np.sin(t[::2]))}
    assert measures.peak_to_peak(signals, "y") == pytest.approx(4.0, abs=1e-6)
    assert measures.mean_error(signals, "y", reference=1.5) == pytest.approx(1.0, abs=1e-9)
    assert measures.rms(signals, "y", reference=0.5) == pytest.approx(math.sqrt(2.0), abs=1e-6)
    assert measures.rms(signals, "y") == pytest.approx(1.5, abs=1e-6)
    assert measures.peak(signals, "y") == pytest.approx(2.5, abs=1e-6)
    assert measures.peak(signals, "y", reference="r") == pytest.approx(1.5, abs=1e-4)
    assert (measures.minimum(signals, "y"), measures.maximum(signals, "y")) == pytest.approx((-1.5, 2.5), abs=1e-6)
    assert measures.final_value(signals, "y", end=math.pi / 2) == pytest.approx(2.5, abs=1e-6)


def test_a_reference_signal_is_held_between_its_samples():
    signals = {"y": (np.arange(4.0), np.zeros(4)), "r": (np.array([0.0, 2.0]), np.array([1.0, 5.0]))}
    assert measures.mean_error(signals, "y", reference="r") == 3.0
    late = signals | {"r": (np.array([2.0]), np.array([5.0]))}
    with pytest.raises(ValueError, match="r has no value yet at 0 s"):
        measures.mean_error(late, "y", reference="r")
    last = {"y": (np.arange(4.0), np.array([0.0, 0.0, 0.0, 9.0])), "r": (np.arange(3.0), np.ones(3))}
    # The plant's last message has no reference to pair with.
    assert measures.mean_error(last, "y", reference="r") == 1.0


def test_both_ends_of_a_window_are_included():
    t = np.arange(11) * 0.1  # 3 * 0.1 is larger than 0.3
    signals = {"y": (t, np.arange(11.0))}
    assert measures.minimum(signals, "y", start=0.3) == 3.0
    assert measures.maximum(signals, "y", end=0.3) == 3.0


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (
            measures.peak,
            {"start": 30.0},
            r"y has 0 samples from 30 s to its end, needed 1; recorded from 0 to 20 s",
        ),
        (measures.total_variation, {"start": 20.0}, "needed 2"),
        (measures.overshoot, {"final": 0.0}, "size zero"),
        (measures.rise_time, {"low": 0.9, "high": 0.1}, "0 <= low < high"),
        (measures.settling_time, {"band": 0.0}, "band"),
        (measures.settling_time, {"at": "never"}, "crossing"),
    ],
)
def test_bad_arguments_are_refused(function, arguments, message):
    with pytest.raises(ValueError, match=message):
        function(FIRST_ORDER, "y", **arguments)


def test_an_empty_record_is_refused():
    with pytest.raises(ValueError, match="nothing is recorded"):
        measures.peak({"y": (np.empty(0), np.empty(0))}, "y")


@pytest.mark.parametrize("sigma", [-0.3, 0.0, 0.2])
def test_the_growth_rate_of_an_oscillation_is_its_exponent(sigma):
    t = np.arange(0.0, 20.0, 0.01)
    x = 2.0 + np.exp(sigma * t) * np.cos(5.0 * t)
    offset = np.where(t < 10.0, 1e3, x)  # values before the window do not count
    for values in (x, offset):
        result = measures.growth_rate({"x": (t, values)}, "x", reference=2.0, start=10.0)
        assert result == pytest.approx(sigma, abs=2e-6)
    assert measures.growth_rate({"x": (t, x), "r": (t, 0.0 * t + 2.0)}, "x", reference="r") == pytest.approx(
        sigma, abs=2e-6
    )
    # Both maxima and minima count as peaks.
    with pytest.raises(ValueError, match=r"x has 2 peaks between 18.7 and 19.99 s, needed 3"):
        measures.growth_rate({"x": (t, x)}, "x", reference=2.0, start=18.7)
