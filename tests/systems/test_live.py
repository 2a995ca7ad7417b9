"""Every live parameter, changed during a run: at its tick, alike in every placement, without a bump."""

from __future__ import annotations

import functools
import json
import math
from typing import Literal, get_args, get_origin

import numpy as np
import pytest
from conftest import differences, few, in_process
from simulated import SimulatedRig, World
from softrig_core import ParameterError, Signals, feed, load_scenario, rig_of
from softrig_core.block.change import Change, changeable, permit
from softrig_core.block.params import flatten
from softrig_core.wire.parameter_event import recorded

CASES = {  # by scenario: duration, and time of the change, at which the changed nodes must be active
    "dc_motor_smc_b5_pid": (0.3, 0.1),
    "dc_motor_smc_stretch_b_delta2": (0.3, 0.1),
    "dc_motor_smc_faults": (0.3, 0.1),
    "dc_motor_fsfb_s1": (1.2, 1.0),
    "induction_dtc_e1": (0.012, 0.01),
    "lsrm_fuzzy_n2_mrac": (0.03, 0.02),
    "lsrm_fuzzy_n2": (0.03, 0.02),
    "lsrm_fuzzy_n3_pi": (0.03, 0.02),
    "rectifier_mpc_n1_qp1": (0.03, 0.02),
    "rectifier_mpc_l2": (0.03, 0.02),
    "pv_mppt_de": (0.3, 0.2),
    "fault_location": (0.03, 0.015),
    "gupfc_s2_short": (0.012, 0.008),
    "rehab_impedance_r6": (0.1, 0.05),
    "manipulator_adsmc_s2": (0.1, 0.05),
    "tcp_aqm_smc_pi": (0.1, 0.05),
    "optimal_control_mvim_a4": (5.0, 3.0),
}
MORE = {  # the same blocks as above, or seconds of work each
    "dc_motor_smc_c1": (0.3, 0.1),
    "dc_motor_smc_b2": (0.3, 0.1),
    "rectifier_mpc_decoupled": (0.03, 0.02),
    "rehab_impedance_r2": (0.1, 0.05),
    "tcp_aqm_smc_s3": (0.1, 0.05),
    "economic_dispatch_case1": (3.0, 2.0),
    "optimal_control_mvim_n4": (5.0, 3.0),
}
TIMES = CASES | MORE
EVERY = [*CASES, *(pytest.param(name, marks=pytest.mark.long) for name in MORE)]


@functools.cache
def run_of(name, overrides="{}"):
    """The rig of a case, and its run without a change."""
    rig = rig_of(load_scenario(name, json.loads(overrides)).changed(duration=TIMES[name][0]))
    return rig, in_process(rig, rig.scenario.seed)


def annotation(model, name):
    """Type of a parameter with a dotted name."""
    first, _, remaining = name.partition(".")
    result = model.model_fields[first].annotation
    return annotation(result, remaining) if remaining else result


def others(kind, value):
    """Values to try in place of one."""
    if get_origin(kind) is Literal:
        return [v for v in get_args(kind) if v != value]
    if isinstance(value, bool):
        return [not value]
    if value is None:
        return [0.5, 0.2, 1.0]
    if isinstance(value, list) and not value:
        return [[1e-3] * n for n in (1, 2, 3)]
    if isinstance(value, int | float):
        return [value * 1.25, value * 0.8, value + 0.125, value - 0.125, value + 1]
    if isinstance(value, str):
        return []
    if all(isinstance(v, int) for v in value):
        return [[-v for v in value]]
    tries = [[v * 1.25 for v in value], [v * 0.8 for v in value], [v + 0.125 for v in value]]
    return [t for t in tries if t != list(value)]


@functools.cache
def variations(member):
    """Another value for each live parameter that the rig allows to change."""
    result, known = {}, flatten(member.params)
    for name in changeable(member.block_class.Params):
        for value in others(annotation(type(member.params), name), known[name]):
            try:
                permit(member.block_class, member.params, {name: value}, member.name)
            except (ParameterError, ValueError):
                continue
            result[name] = value
            break
    return result


def answers(rig, recording, member, at, values):
    """The answers of a node in open loop under a change; its signals."""
    member.changes = (Change(round(at * 1e9), values),) if values else ()
    try:
        return feed(member, rig.scenario.seed, recording)
    finally:
        member.changes = ()


def cut(recording, t):
    """All messages before t (s), by topic."""
    topics = {n: topic for n, topic in recording.topics.items() if n != "parameter_events"}
    return {n: [d for at, d in zip(x.times, x.data, strict=True) if at < t * 1e9] for n, x in topics.items()}


@pytest.mark.parametrize("name", few(EVERY, 6))
def test_a_change_takes_effect_at_its_tick_and_not_before(name):
    """The change is recorded with its tick, name and value."""
    rig, recording = run_of(name)
    at = TIMES[name][1]
    for member in rig.members:
        values = variations(member)
        base = answers(rig, recording, member, at, {})
        assert recorded(base) == [], member.name
        tick = member.schedule.next(round(at * 1e9) - 1)
        for one in values:
            result = answers(rig, recording, member, at, {one: values[one]})
            where = f"{member.name}.{one}"
            assert cut(result, at) == cut(base, at), where
            last = member.schedule.last
            used = [(tick, member.name, {one: values[one]})] if last is None or tick <= last else []
            assert recorded(result) == used, where
            assert all(np.isfinite(signal.x).all() for signal in Signals(result).values()), where


def test_every_live_parameter_may_change_in_some_rig():
    """A parameter whose every change the block or the rig would refuse must not be declared live."""
    messages, allowed = set(), set()
    for name in CASES:
        for member in run_of(name)[0].members:
            key = f"{member.package}/{member.executable}"
            known = flatten(member.params)  # an empty list means that the field does not exist
            messages |= {f"{key}.{p}" for p in changeable(member.block_class.Params) if known[p] != []}
            allowed |= {f"{key}.{p}" for p in variations(member)}
    # This block needs a solver; softrig_power's block of the same class has one in a scenario.
    assert messages - allowed == {"softrig_control/gpc_controller.du_max"}


@pytest.mark.parametrize("name", few(EVERY, 6))
def test_a_change_to_the_same_values_changes_no_byte(name):
    """The state of a block is kept: its `change` recreates nothing that has state."""
    rig, recording = run_of(name)
    same = {
        f"{m.name}.{k}": v
        for m in rig.members
        for k, v in flatten(m.params).items()
        if k in changeable(m.block_class.Params)
    }
    scenario = rig.scenario
    entries = [{"at": part * scenario.duration, "set": same} for part in (0.31, 0.7)]
    again = rig_of(type(scenario).model_validate({**dict(scenario), "changes": entries}))
    assert not differences(recording, in_process(again, scenario.seed))


@pytest.mark.parametrize("name", few(EVERY, 2))
def test_many_simultaneous_changes_give_the_same_bytes_in_every_placement(name):
    rig, recording = run_of(name)
    entries = {}
    for member in rig.members:
        now = member.params
        for one, value in variations(member).items():
            try:
                now = permit(member.block_class, now, {one: value}, member.name)
            except (ParameterError, ValueError):
                continue
            entries[f"{member.name}.{one}"] = value
    assert entries
    scenario = rig.scenario
    changed = type(scenario).model_validate({**dict(scenario), "changes": [{"at": TIMES[name][1], "set": entries}]})
    changed = rig_of(changed)
    changed_run = in_process(changed, scenario.seed)
    assert differences(recording, changed_run), "nothing of what was changed has an effect"
    names = [m.name for m in rig.members]
    for groups in ((), [names]):
        run = SimulatedRig(changed, World(), "lockstep", seed=scenario.seed, groups=groups)
        assert set(run.run().values()) == {"done"}
        assert not differences(changed_run, run.recording), groups


BUMPLESS = [  # scenario, node, change, overrides
    ("dc_motor_smc_b5_pid", "dc_motor_pid", {"ki": 40.0}, {"dc_motor_pid.anti_windup": False}),
    ("dc_motor_fsfb_s1", "fsfb_controller", {"ki": 60.0}, {}),
    (
        "induction_dtc_e1",
        "speed_controller",
        {"ki": 90.0},
        {"speed_source.times": [0.0], "speed_source.velocities": [20.0]},
    ),
    ("lsrm_fuzzy_n3_pi", "speed_controller", {"K_i": 30.0}, {}),
    ("lsrm_fuzzy_n3_pi", "current_controller", {"K_ic": 900.0}, {}),
    ("gupfc_s2_short", "series_controller_1", {"ki": 16.0, "pll.ki": 300.0}, {}),
    ("gupfc_s2_short", "shunt_controller", {"voltage_ki": 9.0, "current_ki": 9.0}, {}),
    ("tcp_aqm_smc_pi", "aqm_controller", {"ki": 9e-5}, {"aqm_controller.bias": 0.05}),
    ("manipulator_adsmc_s2", "vcs_controller", {"adsmc.gamma": [3300.0], "adsmc.b1": [20.5]}, {}),
    ("manipulator_adsmc_s2", "vcs_controller", {"dsmc.b2": [601.0]}, {"vcs_controller.law": "dsmc"}),
    (
        "rehab_impedance_r2",
        "voltage_controller",
        {"tsarc.gamma_a": [90.0], "tsarc.gamma_b": [9.0]},
        {"voltage_controller.law": "tsarc"},
    ),
    ("rehab_impedance_r2", "voltage_controller", {"arsc.gamma1": [4.0]}, {"voltage_controller.law": "arsc"}),
]


@pytest.mark.parametrize(("name", "node", "values", "overrides"), BUMPLESS)
def test_the_command_is_continuous_when_integral_action_changes(name, node, values, overrides):
    rig, recording = run_of(name, json.dumps(overrides))
    member = next(m for m in rig.members if m.name == node)
    tick = member.schedule.next(round(TIMES[name][1] * 1e9) - 1)
    base, result = (Signals(answers(rig, recording, member, TIMES[name][1], v)) for v in ({}, values))
    labels = [label for label in base if label.startswith(f"{member.outputs[0].topic}/")]
    moved = 0
    for label in labels:
        k = list(base[label].t).index(tick / 1e9)
        before, a, b = base[label].x[k - 1], base[label].x[k], result[label].x[k]
        assert b == pytest.approx(a, rel=1e-3, abs=0.2 * abs(a - before) + 1e-9), label
        moved += sum(base[label].x[k + 1 :] != result[label].x[k + 1 :])
    assert labels
    assert moved, "the change has no effect at all"


@pytest.mark.parametrize("name", CASES)
def test_a_set_with_one_wrong_value_is_refused_completely(name):
    """One good value beside one that is refused."""
    for member in run_of(name)[0].members:
        good = variations(member)
        for bad in good:
            for wrong in (math.nan, "much", [1.0, "x"]):
                with pytest.raises(ParameterError):
                    permit(member.block_class, member.params, {**good, bad: wrong}, member.name)
