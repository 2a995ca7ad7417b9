"""Through processes every system gives the bytes of the run in process; in a container: processes/test_container.py."""

import pytest
from conftest import differences, few, in_process
from softrig_core import rig_of
from softrig_nodes import run_processes

pytestmark = pytest.mark.processes

# Scenario, duration in s (None: all of it), seed; main scenarios run in a container daily, others have golden bags.
DAILY = [
    ("dc_motor_smc_b4", 1.0, 3),
    ("dc_motor_fsfb_stretch_jitter", None, 3),
    ("manipulator_adsmc_two_link", 0.3, 0),
    ("optimal_control_mvim_s4_1s", 20.0, 1),
    ("pwa_delay_p2_d2", 20.0, 1),
    ("rehab_impedance_r5", 0.5, 0),
    ("tcp_aqm_smc_s4", 3.0, 1),
    ("economic_dispatch_e2", 4.0, 0),
]
LONG = [
    ("dc_motor_smc_stretch_b", 1.0, 3), ("dc_motor_fsfb", None, 3), ("dc_motor_fsfb_s1_none", None, 3),
    ("dc_motor_fsfb_s1_velocity", None, 3), ("dc_motor_fsfb_s2", None, 3), ("dc_motor_fsfb_s3", None, 3),
    ("gupfc", None, 0), ("manipulator_adsmc_s2", 1.0, 0), ("optimal_control_mvim", 20.0, 1), ("pv_mppt", 0.3, 3),
    ("pv_mppt_certified_transients", 0.3, 3), ("pwa_delay_p2c", 20.0, 1), ("rectifier_mpc", 0.25, 0),
    ("rectifier_mpc_n1_qp2", 0.25, 0), ("tcp_aqm_smc", 0.5, 1), ("tcp_aqm_smc_10ms", 0.5, 1),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "duration", "seed"), few([*DAILY, *(pytest.param(*r, marks=pytest.mark.long) for r in LONG)], 1)
)
def test_processes_give_the_bytes_of_the_run_in_process(name, duration, seed, tmp_path):
    rig = rig_of(name, duration=duration)
    outcome = run_processes(rig, seed, tmp_path)
    assert outcome.error == ""
    assert not any(status["refused"] for status in outcome.status.values())
    expected = in_process(rig, seed)
    assert all(expected.topics[p.topic].times for m in rig.members for p in m.outputs if not p.sporadic)
    assert differences(expected, outcome.recording) == []
