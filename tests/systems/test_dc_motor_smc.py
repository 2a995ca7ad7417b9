"""DC motor rig: the acceptance numbers through the scenario files, the model, the controllers, bad input."""

import functools
import math

import numpy as np
import pytest
from board_by_hand import UNO
from conftest import few, in_process
from softrig_control.sliding_mode import switching
from softrig_core import (
    ByHand,
    Level,
    Signals,
    evaluate,
    list_scenarios,
    load_scenario,
    rig_of,
)
from softrig_drives.dc_motor.kalman_surface import DcMotorSmcKalman
from softrig_drives.dc_motor.model import MotorConstants
from softrig_drives.dc_motor.pid import DcMotorPid
from softrig_drives.dc_motor.plant import DcMotorPlant
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc

K = 9.71170883  # K/r, 1/s^2, solved from Table II
C = 5.0320416  # slope of the surface, 1/s

# Covered by their golden bags and test_faults.py, by test_falsifications.py and test_other_machines.py.
ELSEWHERE = {f"dc_motor_smc_{n}" for n in ("faults", "faults_bus", "b1_insensitive", "re40", "re40_law")} | {*UNO}


@functools.cache
def run(name, **overrides):
    rig = rig_of(load_scenario(name, {k.replace("__", "."): v for k, v in overrides.items()}))
    return rig, Signals(in_process(rig))


@functools.cache
def figures(name):
    rig, signals = run(name)
    results = evaluate(rig, signals)
    assert [f"{r.name} = {r.value}" for r in results if not r.passed] == []
    assert any(r.judged for r in results)
    return {r.name: r.value for r in results}


def speed(name):
    """Time and true speed."""
    rig, signals = run(name)
    return signals[f"motor/{'true_' if 'motor/true_state' in rig.topics else ''}state/shaft/velocity"]


@pytest.mark.parametrize(
    "name", few(sorted({n for n in list_scenarios() if n.startswith("dc_motor_smc")} - ELSEWHERE), 6)
)
def test_every_scenario_meets_its_figures(name):
    assert figures(name)


def test_softening_removes_the_chattering():
    soft = [
        figures(f"dc_motor_smc_b2{d}")["total_variation"] for d in ("_delta1", "_delta2", "", "_delta10", "_delta20")
    ]
    assert soft == sorted(soft, reverse=True)
    assert figures("dc_motor_smc_b1")["total_variation"] / soft[2] >= 50


@pytest.mark.parametrize(("name", "period"), [("dc_motor_smc", 1e-4), ("dc_motor_smc_a1", 1e-3)])
def test_chattering_switches_at_every_sample(name, period):
    assert figures(name)["total_variation"] == pytest.approx(2 * K / (13.89 * period), rel=0.03)


def test_sliding_mode_follows_its_closed_form():
    t, w = speed("dc_motor_smc")
    reach = C / K
    reaching = K / C * (t - (1 - np.exp(-C * t)) / C)
    at_reach = K / C * (reach - (1 - np.exp(-C * reach)) / C)
    expected = np.where(t < reach, reaching, 1 - (1 - at_reach) * np.exp(-C * (t - reach)))
    assert np.abs(w - expected).max() < 3e-4  # the errors of the rounded model and of K Ts/c


def test_open_loop_is_the_two_pole_response():
    t, w = speed("dc_motor_smc_c1")
    p = MotorConstants()
    gain = p.Kt / (p.J * p.L)
    fast, slow = np.roots([1, p.b / p.J + p.R / p.L, (p.b * p.R + p.Kt * p.Ke) / (p.J * p.L)])
    final = 6.0 * gain / (fast * slow)
    expected = final * (1 + (slow * np.exp(fast * t) - fast * np.exp(slow * t)) / (fast - slow))
    assert np.abs(w - expected).max() < 1e-6 * final


def rk4(v, load_at, period, sub_steps, p):
    """Speed at every sample by an independent integrator; the load is looked up at each sub-step."""
    x, h, results = np.zeros(2), period / sub_steps, [0.0]

    def slope(x, u, load):
        w, i = x
        return np.array([(-p.b * w + p.Kt * i - load) / p.J, (u - p.R * i - p.Ke * w) / p.L])

    for k, u in enumerate(v):
        for j in range(sub_steps):
            load = load_at(k * period + (j + 0.5) * h)
            a = slope(x, u, load)
            b = slope(x + h / 2 * a, u, load)
            c = slope(x + h / 2 * b, u, load)
            d = slope(x + h * c, u, load)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        results.append(x[0])
    return np.array(results)


@pytest.mark.parametrize("name", few(["dc_motor_smc_a1", "dc_motor_smc_b1", "dc_motor_smc_b4", "dc_motor_smc_b5"], 2))
def test_plant_agrees_with_a_second_integrator(name):
    rig, signals = run(name)
    params = rig.clock.params
    if params.rig:
        v = signals["motor/applied/armature/effort"].x[1:]
    else:
        v = signals["motor/command/armature/effort"].x
    step = params.load_torques[-1]
    expected = rk4(v, lambda t: step if t > 3.0 else 0.0, params.period, 4, params)
    assert np.abs(speed(name).x - expected).max() <= 1e-6


def test_load_step_inside_a_sample_is_exact():
    loads = {"load_times": [0.0, 0.0137, 0.0161, 0.03], "load_torques": [0.001, 0.005, -0.002, 0.004]}
    coarse, fine = ByHand(DcMotorPlant(**loads)), ByHand(DcMotorPlant(period=1e-4, **loads))
    for k in range(500):
        fine.advance(k * 100_000, command=(3.0,))
        if k % 100 == 0:
            coarse.advance(k * 100_000, command=(3.0,))
        if k % 100 == 99:
            assert coarse.x[:3] == pytest.approx(fine.x[:3], rel=1e-11)


# The digital rig


def test_encoder_counts_and_speed():
    plant = ByHand(DcMotorPlant(rig=True))
    rad = math.tau / 1496
    assert plant.outputs(0)["state"][:2] == (0.0, 0.0)
    before = 0
    for k in range(300):
        plant.advance(k * 10**7, command=(-12.0 if k > 30 else 12.0,))
        (position, w, _), (count, _) = plant.outputs(0)["state"], plant.outputs(0)["sensors"]
        assert count == math.floor(plant.x.theta / rad)
        assert (position, w) == pytest.approx((count * rad, (count - before) * rad / 0.01), rel=1e-12)
        before = count
    assert before < 0  # passes zero, where truncation differs from floor


@pytest.mark.parametrize(("command", "level"), [(12.0, 255), (-12.0, -255), (6.0, 128), (2.5 * 12 / 255, 2), (0.02, 0)])
def test_pwm_and_bridge(command, level):
    plant = ByHand(DcMotorPlant(rig=True))
    plant.advance(0, command=(command,))
    assert plant.outputs(0)["applied"] == pytest.approx((level / 255 * 10.0,), rel=1e-12)
    assert not plant.reports


def test_current_sensor_has_steps_and_a_range():
    plant = ByHand(DcMotorPlant(rig=True))
    for k in range(30):
        plant.advance(k * 10**7, command=(12.0,))
    steps = plant.outputs(0)["sensors"][1] / 0.0008
    assert steps == pytest.approx(round(steps), abs=1e-9)
    assert abs(plant.outputs(0)["sensors"][1] - plant.x.i) <= 0.0004 + 1e-12
    for k in range(200):
        plant.advance(k * 10**7, command=(12.0,))
    assert plant.x.i > 3.3
    assert plant.outputs(0)["sensors"][1] == 3.2
    assert plant.reports["current_range"][0] is Level.WARN


def test_current_noise_is_seeded():
    plant = ByHand(DcMotorPlant(rig=True, current_noise=0.01))

    def noise(seed):
        plant.reset(seed)
        result = []
        for k in range(2000):
            plant.advance(k * 10**7, command=(0.0,))
            result.append(plant.outputs(0)["sensors"][1])
        return result

    first = noise(1)
    assert first == noise(1)
    assert first != noise(2)
    assert np.std(first) == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize("rig", [False, True])
def test_command_beyond_the_supply_is_clipped_and_flagged(rig):
    plant, limit = ByHand(DcMotorPlant(rig=rig)), ByHand(DcMotorPlant(rig=rig))
    plant.advance(0, command=(-13.0,))
    limit.advance(0, command=(-12.0,))
    assert plant.x.w == limit.x.w < 0.0
    assert plant.reports["clipped"][0] is Level.WARN
    assert "-13 V" in plant.reports["clipped"][1]
    assert not limit.reports


# Laws


def test_switching_term():
    assert [switching(s) for s in (-3.0, -0.0, 0.0, 0.1)] == [-1.0, 0.0, 0.0, 1.0]
    assert switching(-3.0, 1.0) == -0.75
    assert switching(0.0, 1.0) == 0.0


def test_a_rejected_reference_still_gives_the_surface():
    law = ByHand(DcMotorSmc(publish_surface=True))
    answer = law.refused(0)
    assert answer == {"command": (0.0,), "surface": (0.0,)}


def test_motor_brakes_when_the_reference_becomes_zero():
    _rig, signals = run("dc_motor_smc_b2", motor_reference__times=(0.0, 3.0), motor_reference__velocities=(10.0, 0.0))
    w = signals["motor/true_state/shaft/velocity"]
    assert w.x[299] == pytest.approx(10.0, abs=0.05)
    assert w.x[-1] == pytest.approx(0.0, abs=0.05)


# Bad input


# For each law: how to create it, its inputs beside the reference, and which of their numbers it uses.
MEASURED = [
    (DcMotorSmc, {"state": (5.0,), "sensors": (100.0, 0.9)}, [("state", 0), ("sensors", 1)]),
    (lambda: DcMotorSmc(wd_source="diff", wd_lp=0.02), {"state": (5.0,), "sensors": (100.0, 0.9)}, [("state", 0)]),
    (DcMotorPid, {"state": (5.0,)}, [("state", 0)]),
    (
        DcMotorSmcKalman,
        {"sensors": (100.0, 0.9), "applied": (1.0,)},
        [("sensors", 0), ("sensors", 1), ("applied", 0)],
    ),
]


@pytest.mark.parametrize(("make", "inputs", "used"), MEASURED)
def test_a_tick_with_a_rejected_input_gives_zero_volt_and_leaves_the_state_unchanged(make, inputs, used):
    block, clean = ByHand(make()), ByHand(make())
    inputs = inputs | {"reference": (10.0,)}
    for b in (block, clean):
        b.update(0, **inputs)
    assert block.refused(1)["command"] == (0.0,)
    assert block.reports["refused"][0] is Level.ERROR
    after = inputs | {"reference": (9.0,)}
    assert block.update(2, **after) == clean.update(2, **after)


@pytest.mark.parametrize(("make", "inputs", "used"), MEASURED)
def test_reference_beyond_the_sensor_range_keeps_the_previous(make, inputs, used):
    block, clean = ByHand(make()), ByHand(make())
    assert block.update(0, **inputs, reference=(5.0,)) == clean.update(0, **inputs, reference=(5.0,))
    assert not block.reports
    for k, r in enumerate((21.9, -40.0), 1):
        assert block.update(k, **inputs, reference=(r,)) == clean.update(k, **inputs, reference=(5.0,))
        level, text, count = block.reports["reference_range"]
        assert (level, count) == (Level.WARN, k)
        assert f"{r:g} rad/s" in text
    assert block.update(3, **inputs, reference=(-21.8,)) == clean.update(3, **inputs, reference=(-21.8,))


@pytest.mark.parametrize(("make", "inputs", "used"), MEASURED)
def test_without_a_reference_the_set_point_holds(make, inputs, used):
    block, reported = ByHand(make()), ByHand(make())
    assert block.update(0, **inputs, reference=None) == reported.update(0, **inputs, reference=(10.0,))


@pytest.mark.parametrize(("make", "inputs", "used"), MEASURED)
def test_reset_forgets_everything(make, inputs, used):
    block, fresh = ByHand(make()), ByHand(make())
    for k in range(5):
        block.update(k, **inputs, reference=(-3.0,))
    block.reset(0)
    for k in range(5):
        assert block.update(k, **inputs, reference=None) == fresh.update(k, **inputs, reference=None)


@pytest.mark.parametrize("rig", [False, True])
def test_reset_brings_the_motor_to_rest(rig):
    plant = ByHand(DcMotorPlant(rig=rig, load_times=[0.0, 0.02], load_torques=[0.0, 0.01]))

    def states():
        result = [plant.outputs(0)]
        for k in range(5):
            plant.advance(k * 10**7, command=(5.0,))
            result.append(plant.outputs(k * 10**7))
        return result

    first = states()
    plant.reset(0)
    assert states() == first
