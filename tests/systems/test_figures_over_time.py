"""All registered figures of signals that are thinned, jittered, repeated, shifted, or mirrored.

Source: what a figure's definition says does not depend on how often, or since when, its signals are published. Each is
measured of continuous functions of time on an even grid; of the same functions on another grid it has to be the same
within the step of that grid, or the grid is refused.
"""

import math

import numpy as np
import pytest
from softrig_core import load_scenario, simulate
from softrig_core.judge.registry import find, registered
from softrig_power.fault_location.ports import LOCATION, VERDICT
from softrig_power.gupfc.figures import TRACE
from softrig_power.pv.module import ModuleParams

PERIOD, DURATION = 1e-3, 2.0
LATER = 50.0
TIMES = ("start", "end", "at")


def swing(t):
    """A step response that overshoots."""
    return 1.0 - np.exp(-3.0 * t) * np.cos(12.0 * t)


def decay(t):
    return np.exp(-1.5 * t) * np.cos(30.0 * t + 0.3)


def error(t):
    return 2.0 * np.exp(-2.0 * t) * np.cos(9.0 * t)


def slow(t):
    return 0.5 + 0.3 * np.sin(3.0 * t)


def ripple(t):
    return 10.0 + 4.0 * np.sin(2.0 * math.pi * 5.0 * t)


def constant(value):
    return lambda t: np.full_like(t, value)


class Case:
    """A figure's signals, arguments, and allowed differences.

    even: it needs an even grid and refuses others. own: its samples have meanings of their own (counts, waveforms), so
    repeating or dropping them is another signal. clock: it is a time of the run, not one counted from a begin. sign: of
    the mirror image, None where the signals have none.
    """

    def __init__(
        self, signals, *, even=False, own=False, clock=False, sign=1.0, mirrored=None, tolerance=0.02, **arguments
    ):
        self.signals, self.arguments, self.clock = signals, arguments, clock
        self.even, self.own, self.sign, self.tolerance = even, own, sign, tolerance
        self.mirrored = mirrored or {}


def one(function=swing, **about):
    return Case({"y": function}, signal="y", **about)


def module():
    return {"module": ModuleParams().model_dump(), "first": (1000.0, 300.0, 25.0, 25.0)}


PV = {
    "converter/state/p_in/position": lambda t: 60.0 * (1.0 - np.exp(-8.0 * t)),
    "converter/state/v_in/position": constant(15.0),
    **{
        f"pv/environment/{name}/position": constant(value)
        for name, value in (("g1", 1000.0), ("g2", 300.0), ("t1", 25.0), ("t2", 25.0))
    },
}
LSRM = {
    "joint_states/translator/position": lambda t: 0.2 * t,
    "joint_states/translator/velocity": swing,
    "joint_states/translator/effort": ripple,
    "reference/translator/velocity": constant(1.0),
}
FLUX = {
    "flux_estimate/x": lambda t: np.cos(20.0 * t) + 0.02 * t,
    "flux_estimate/y": lambda t: np.sin(20.0 * t) + 0.01 * t,
    "flux_true/x": lambda t: np.cos(20.0 * t),
    "flux_true/y": lambda t: np.sin(20.0 * t),
}
WAVE = {
    f"gupfc/trace/{step},{2 * TRACE.index('u1') + part}": lambda t, step=step, part=part: np.array(
        [np.cos, np.sin][part](20.0 * math.pi * (t + step * PERIOD / 2)) + 0.1 * np.cos(100.0 * math.pi * t)
    )
    for step in range(2)
    for part in range(2)
}
PULSES = {
    "pulses/voltage/x": lambda t: np.cos(20.0 * math.pi * t) + 0.2 * np.cos(100.0 * math.pi * t),
    "pulses/voltage/y": lambda t: np.sin(20.0 * math.pi * t) + 0.2 * np.sin(100.0 * math.pi * t),
}
POWERS = {f"gupfc/status/{name}/position": f for name, f in (("p_sh", slow), ("p12", decay), ("p34", error))}
MIRRORED_STEP = {"v_d": -1.0}

CASES = {
    "rise_time": one(final=1.0, mirrored={"final": -1.0}),
    "settling_time": one(final=1.0, mirrored={"final": -1.0}),
    "overshoot": one(final=1.0, mirrored={"final": -1.0}),
    "reach_time": one(level=0.8, mirrored={"level": -0.8}),
    "error_settling_time": one(error, band=0.1),
    "total_variation": one(slow),
    "peak_to_peak": one(slow),
    "mean_error": one(reference=0.4, sign=-1.0, mirrored={"reference": -0.4}, start=0.3, end=1.5),
    "rms": one(error, start=0.25),
    "peak": one(error, end=1.2),
    "mean_square": one(error),
    "mean_absolute": one(error),
    "integral_absolute": one(error, start=0.1, end=1.9),
    "mean": one(slow, sign=-1.0, start=0.2),
    "sum_absolute": one(error, own=True),
    "error_overshoot": one(error),
    "growth_rate": one(decay),
    "maximum": one(slow, sign=None),
    "minimum": one(slow, sign=None),
    "final_value": one(slow, sign=-1.0, end=1.0),
    "aqm_deviation": one(slow, last=1.0),
    "aqm_mean_square_window": one(lambda t: 8.0 + slow(t), queue=50.0, N=20, C=500.0, tau_p=0.1, sign=None),
    "aqm_utilisation": Case({"network/truth/served/position": lambda t: 40.0 * t}, capacity=50.0, sign=None),
    "dispatch_set_point": Case({"dispatch/setpoints/u1/effort": slow}, units=("u1",), sign=-1.0),
    "dtc_circle_centre": Case({k: v for k, v in FLUX.items() if "true" in k}, tolerance=0.05),
    "dtc_converter_error": Case(
        {"currents_meas/x": lambda t: slow(t) + 0.1 * np.sin(7.0 * t), "currents_true/x": slow},
        lsb=0.1,
        statistic="std",
        start=0.3,
    ),
    "dtc_current_peak": Case({f"currents_true/{x}": slow for x in "xyz"}),
    "dtc_flux_error_direction": Case(FLUX, start=0.3, sign=None),
    "dtc_flux_error_end": Case(FLUX),
    "dtc_flux_error_peak": Case(FLUX),
    "dtc_flux_error_slope": Case(FLUX, start=0.3),
    "dtc_flux_magnitude": Case(FLUX, topic="flux_true", extreme="max"),
    "dtc_switching_frequency": Case(
        {f"switches/{leg}/effort": lambda t: np.sign(np.sin(20.0 * t + 0.1)) for leg in ("Sa", "Sb", "Sc")}
    ),
    "lsrm_arrival": Case(LSRM, v_d=1.0, clock=True, mirrored=MIRRORED_STEP),
    "lsrm_dip": Case(LSRM, v_d=1.0, start=0.5, mirrored=MIRRORED_STEP),
    "lsrm_force_ripple": Case(LSRM, pitch=0.05),
    "lsrm_iae": Case(LSRM, start=0.1),
    "lsrm_itae": Case(LSRM, start=0.1),
    "lsrm_mean_force": Case(LSRM, pitch=0.05, sign=-1.0),
    "lsrm_overshoot": Case(LSRM, v_d=1.0, mirrored=MIRRORED_STEP),
    "lsrm_peak_force": Case(LSRM, width=0.05, sign=-1.0),
    "gupfc_best_sigma": Case(
        {
            "pulses/quality/thd/position": lambda t: 1.0 + (t - 1.0) ** 2,
            "shunt/command/sigma/effort": lambda t: 1.0 + t,
        },
        sign=None,
    ),
    "gupfc_voltage_harmonic": Case(PULSES, order=5, cycle=0.1, even=True),
    "gupfc_voltage_levels": Case({"pulses/voltage/x": lambda t: np.sign(np.cos(63.0 * t))}, cycle=0.1, even=True),
    "gupfc_distortion": Case(WAVE, part="u1", frequency=10.0, even=True, own=True),
    "gupfc_drift": one(lambda t: slow(t) + np.sin(20.0 * math.pi * t), frequency=10.0, even=True),
    "gupfc_power_balance": Case(POWERS, sign=-1.0),
    "gupfc_shunt_angle": Case(
        {"shunt/command/angle/effort": slow, "u1/x": lambda t: np.cos(0.3 * t), "u1/y": lambda t: np.sin(0.3 * t)},
        sign=None,
    ),
    "fault_location_error": Case({"location/0": constant(80.1)}, truth=80.0, sign=None),
    "fault_location_error_percent": Case({"location/0": constant(80.1)}, truth=80.0, length=200.0, sign=None),
    "fault_location_status": Case({f"verdict/{VERDICT.index('status')}": constant(0.0)}, status="ok", sign=None),
    "fault_locations": Case({"location/0": constant(80.1)}, own=True, sign=None),
    "fault_peak": Case({"line/fault_current/x": error}, phase="a"),
    "pv_efficiency": Case(PV, **module(), sign=None),
    "pv_gmpp": Case(PV, **module(), at=0.5, sign=None),
    "pv_in_global_basin": Case(PV, **module(), sign=None),
    "pv_local_maximum": Case(PV, **module(), at=0.5, sign=None),
    "pv_tracking_time": Case(PV, **module(), level=0.5, sign=None),
    "pwa_fall": Case({"lyapunov/V/position": lambda t: np.exp(-t)}, delay=0.2, sign=None),
    "pwa_largest_rise": Case({"lyapunov/V/position": lambda t: 2.0 + np.sin(3.0 * t)}, delay=0.2, sign=None),
    "pwa_level_covered": Case(
        {"certificate/verdict/h/position": constant(1.0), "certificate/verdict/valid/position": constant(1.0)},
        delay=0.5,
        hold=0.1,
        sign=None,
    ),
}


def sampled(case, at=lambda t: t, factor=1.0, shift=0.0):
    t = np.rint(np.arange(round(DURATION / PERIOD) + 1) * PERIOD * 1e9) * 1e-9
    t = at(t)
    return {name: (t + shift, factor * f(t)) for name, f in case.signals.items()}


def measure(name, signals, shift=0.0, **changed):
    case = CASES[name]
    arguments = {k: v + shift if k in TIMES else v for k, v in case.arguments.items()} | changed
    return float(find(name)(signals, **arguments))


def jittered(t):
    moves = np.random.default_rng(4).uniform(-0.3, 0.3, t.size) * PERIOD
    moves[[0, -1]] = 0.0
    return t + moves


def held_twice(signals):
    result = {}
    for name, (t, x) in signals.items():
        middle = t[:-1] + 0.5 * PERIOD
        order = np.argsort(np.concatenate([t, middle]))
        result[name] = np.concatenate([t, middle])[order], np.concatenate([x, x[:-1]])[order]
    return result


def thinned(signals):
    """Each signal loses a third of its messages, different ones for each signal; not the first and last."""
    result = {}
    for name, (t, x) in signals.items():
        topic = name.rsplit("/", 1)[0] if name.count("/") == 1 else name.rsplit("/", 2)[0]
        kept = np.random.default_rng(len(topic)).random(t.size) > 1.0 / 3.0
        kept[[0, -1]] = True
        result[name] = t[kept], x[kept]
    return result


def near(name, result, right):
    tolerance = CASES[name].tolerance
    assert result == pytest.approx(right, rel=tolerance, abs=tolerance * max(0.1, abs(right))), (result, right)


def test_every_registered_figure_is_tested():
    assert sorted(CASES) == registered()
    assert LOCATION.index("x_km") == 0


@pytest.mark.parametrize("name", CASES)
def test_a_figure_does_not_depend_on_how_often_its_signals_are_published(name):
    case = CASES[name]
    right = measure(name, sampled(case))
    assert math.isfinite(right)
    if not case.own:
        near(name, measure(name, held_twice(sampled(case))), right)
    for signals in (sampled(case, jittered), thinned(sampled(case))):
        if case.even:
            with pytest.raises(ValueError, match="expected an even grid"):
                measure(name, signals)
        elif not case.own:
            near(name, measure(name, signals), right)


@pytest.mark.parametrize("name", CASES)
def test_a_figure_does_not_depend_on_when_the_record_begins(name):
    right = measure(name, sampled(CASES[name])) + LATER * CASES[name].clock
    assert measure(name, sampled(CASES[name], shift=LATER), LATER) == pytest.approx(right, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.sign])
def test_a_figure_of_the_mirror_image_is_the_mirror_image(name):
    case = CASES[name]
    result = measure(name, sampled(case, factor=-1.0), **case.mirrored)
    assert result == pytest.approx(case.sign * measure(name, sampled(case)), rel=1e-12, abs=1e-12)


def test_some_figures_over_time_equal_closed_forms():
    """The mean of a ramp held over uneven gaps, the integral of its size, a force over a width."""
    t = np.array([0.0, 1.0, 1.5, 4.0])
    signals = {"y": (t, np.array([1.0, -3.0, 2.0, 5.0])), "end": (np.array([0.0, 5.0]), np.zeros(2))}
    whole = 1.0 * 1.0 + 3.0 * 0.5 + 2.0 * 2.5 + 5.0 * 1.0
    assert find("integral_absolute")(signals, "y") == pytest.approx(whole)
    assert find("mean_absolute")(signals, "y") == pytest.approx(whole / 5.0)
    assert find("mean")(signals, "y", start=0.5, end=2.5) == pytest.approx((0.5 - 1.5 + 2.0) / 2.0)
    signals["r"] = (np.array([0.0, 2.0]), np.array([0.0, 2.0]))  # the reference changes while y is constant
    assert find("integral_absolute")(signals, "y", reference="r") == pytest.approx(1.0 + 1.5 + 1.0 + 0.0 + 3.0)
    pulse = {
        "joint_states/translator/effort": (np.array([0.0, 1.0, 1.1, 3.0]), np.array([0.0, 10.0, 0.0, 0.0])),
        "joint_states/translator/position": (np.array([0.0, 1.0, 1.1, 3.0]), np.array([0.0, 1.0, 1.1, 3.0])),
    }
    assert find("lsrm_peak_force")(pulse, width=1.0) == pytest.approx(1.0)


CASE = """
extends: dc_motor_smc_b2
title: IAE of a signal, whole and behind a link that loses messages
duration: 2.0
faults:
  half: {link: motor/sensors -> dc_motor_smc, kind: loss, probability: 0.5}
figures:
  iae_sent: {function: integral_absolute, arguments: {signal: motor/sensors/current_a/position}}
  iae_arrived: {function: integral_absolute, arguments: {signal: motor/sensors/half/current_a/position}}
"""


@pytest.mark.parametrize("seed", [0, 3])
def test_the_iae_of_received_samples_equals_that_of_sent_ones_except_for_lost_ones(seed, tmp_path):
    """By the trapezoidal rule over the received samples, 10 ms apart: the difference is half a sample."""
    (tmp_path / "iae.yaml").write_text(CASE)
    run = simulate(load_scenario(tmp_path / "iae.yaml"), seed=seed)
    t, x = run.signals["motor/sensors/half/current_a/position"]
    assert len(t) < 120  # fewer than the 200 samples
    results = {m.name: m.value for m in run.results}
    until = float(np.trapezoid(np.abs(x), t)) + abs(float(x[-1])) * (2.0 - float(t[-1]))
    assert results["iae_arrived"] == pytest.approx(until, rel=0.015)
    assert results["iae_arrived"] == pytest.approx(results["iae_sent"], rel=0.02)
