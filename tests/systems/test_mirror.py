"""Controllers and plants under mirrored signs, with gains of the other sign, and started at another time than 0.

Source: the equations. Of a law or plant that is odd in its inputs, the mirror image of what goes in gives the mirror
image of what comes out, to the last bit: changing a sign rounds nothing.
"""

import importlib.metadata
import random

import pytest
from conftest import make_scenario
from softrig_control.pid import Pid, PidParams, PidState
from softrig_control.state_feedback import StateFeedback
from softrig_core import Plant, Sample, simulate
from softrig_core.renamed import executables
from softrig_core.rig.installed import block_of, load_main

ODD = {
    "softrig_control": "fieldbus_delay forward_command gpc_controller linear_plant unit_delay",
    "softrig_drives": "dc_motor_pid dc_motor_smc dc_axis_controller lsrm_fuzzy lsrm_pi speed_controller",
    "softrig_systems": "delay_line momentum_feedback scalar_plant",
}
LATER = {
    "softrig_drives": "bldc_plant current_sensor foc_controller induction_foc_controller induction_plant pmsm_plant "
    "shaft_sensor six_step_controller vhz_controller "
    "current_controller dc_axis_plant dc_motor_plant dc_motor_smc_kalman induction_dtc_plant lsrm_mrac "
    "lsrm_plant",
    "softrig_power": "dcdc_plant series_controller shunt_controller pv_plant",
    "softrig_robots": "arm_controller arm_plant impedance manipulator_plant rehab_plant manipulator_controller "
    "rehab_controller",
    "softrig_systems": "aqm_controller ocp_plant pendulum_controller pendulum_plant spacecraft_plant "
    "switched_delay_plant tank_controller tank_plant tcp_fluid tcp_packets two_state_plant",
}
TIME = {  # their outputs depend on time, by name or by the angle of the grid
    "softrig_control": "command_source reference_source scalar_source",
    "softrig_drives": "dtc_controller flux_observer lsrm_load profile_generator step_buttons",
    "softrig_power": "gupfc_plant line_plant pulse_generator rectifier_plant shading_source unit_fleet",
    "softrig_robots": "patient rehab_reference trajectory_source tuner",
}
NOT_OPEN = {  # they have no numeric input or output, or need a file or seconds of a solver
    "softrig_bags": "tape",
    "softrig_core": "clock figures",
    "softrig_control": "c_controller c_plant fault fmu_controller fmu_plant gpc_certificate pid_controller policy "
    "requirement_monitor",
    "softrig_drives": "dc_motor_uno",
    "softrig_optim": "optimiser",
    "softrig_power": "dispatch_solver fault_locator rectifier_gpc location_marker mppt_optimiser power_flow pv_curves",
    "softrig_robots": "robot_dynamics",
    "softrig_systems": "pwa_certificate collocation_planner lyapunov_monitor margin_search mvim_planner "
    "ocp_evaluator ocp_player",
}


def pairs(*tables):
    return [(package, name) for table in tables for package, names in table.items() for name in names.split()]


def driven(package, executable, sign=1.0, begin=0):
    """The output of a block in 25 periods under inputs that are drawn again every fifth, from a period on."""
    cls = block_of(load_main(package, executable))
    block = cls()
    block.reset(1)
    inputs, outputs = cls.ports(block.p)
    period, rng, held, rows = round(float(block.p.period) * 1e9), random.Random(3), {}, []
    x = block.first()
    for k in range(25):
        t = (k + begin) * period
        if k % 5 == 0:
            held = {p.name: tuple(sign * rng.uniform(-1.0, 1.0) for _ in range(p.size)) for p in inputs}
        inputs_now = {p.name: Sample(t, held[p.name]) if p.delayed else held[p.name] for p in inputs}
        if issubclass(cls, Plant):
            result = block.outputs(x, t)
            x = block.advance(x, t, **inputs_now)
        else:
            x, result = block.update(x, t, **inputs_now)
        messages = [result.get(p.name) for p in outputs if not p.sporadic]
        rows.append([tuple(r.data if isinstance(r, Sample) else r) for r in messages])
    return rows


def test_every_executable_is_tested():
    results = {
        (d.metadata["Name"], name)
        for d in importlib.metadata.distributions()
        if (d.metadata["Name"] or "").startswith("softrig")
        for name in executables(d.metadata["Name"])
        if block_of(load_main(d.metadata["Name"], name)) is not None
    }
    assert sorted(results) == sorted(pairs(ODD, LATER, TIME, NOT_OPEN))


@pytest.mark.parametrize(("package", "executable"), pairs(ODD))
def test_mirrored_inputs_give_mirrored_outputs(package, executable):
    right = [[tuple(-v for v in row) for row in rows] for rows in driven(package, executable)]
    assert any(v for rows in right for row in rows for v in row)
    assert driven(package, executable, -1.0) == right


@pytest.mark.parametrize(("package", "executable"), pairs(ODD, LATER))
def test_a_block_that_begins_later_gives_the_same(package, executable):
    assert driven(package, executable, begin=4000) == driven(package, executable)


@pytest.mark.parametrize("kd", [0.0, 0.3])
def test_a_reverse_acting_pid_is_the_mirror_image_of_a_direct_one(kd):
    """Into saturation and back: the integral is stopped for gains of either sign."""
    rng = random.Random(8)
    direct, reverse = (
        Pid(PidParams(kp=s * 4.0, ki=s * 4.0, kd=s * kd, n_filter=20.0, u_max=12.0), 0.01) for s in (1.0, -1.0)
    )
    x = y = PidState()
    stopped = 0
    for k in range(400):
        error = (6.0 if k < 200 else -2.0) + rng.uniform(-0.5, 0.5)
        before = x.integral
        x, u = direct(x, error)
        y, v = reverse(y, error)
        stopped += x.integral == before
        assert (v, y.integral, y.derivative) == (-u, -x.integral, -x.derivative)
    assert stopped > 50


def test_a_feedback_whose_plant_has_a_negative_gain_stops_its_integral_too():
    direct, reverse = (StateFeedback((k,), ki, 0.1, 1.0, anti_windup=True) for k, ki in ((0.5, 2.0), (-0.5, -2.0)))
    x = y = 0.0
    for error in (1.0, 1.0, 1.0, 1.0, -0.5, -0.5, -0.5):
        x, u = direct(x, error, (0.1,), 0.0)
        y, v = reverse(y, error, (0.1,), 0.0)
        assert (y, v) == (x, -u)
    assert x < 0.6  # without the limit the integral would be 4 s times the input


def acting(gain):
    """Set point 20 that is out of reach for 20 s, then 3, for a first-order plant with a saturated amplifier."""
    nodes = {
        "plant": {
            "package": "softrig_control",
            "executable": "linear_plant",
            "parameters": {
                "period": 0.01,
                "num": [0.5 * gain],
                "den": [1.0, 1.0],
                "command": "motor/command/armature/effort",
                "command_unit": "V",
                "output": "motor/state/shaft/velocity",
                "output_unit": "rad/s",
            },
        },
        "pid": {
            "package": "softrig_drives",
            "executable": "dc_motor_pid",
            "parameters": {"period": 0.01, "kp": 4.0 * gain, "ki": 4.0 * gain, "kd": 0.0, "u_max": 12.0},
        },
        "reference": {
            "package": "softrig_control",
            "executable": "reference_source",
            "parameters": {"period": 0.01, "times": [0.0, 20.0], "velocities": [20.0, 3.0]},
            "remap": {"reference": "motor/reference"},
        },
    }
    faults = {"amplifier": {"link": "motor/command", "kind": "saturate", "value": [12.0]}}
    return simulate(make_scenario(nodes, 40.0, faults=faults)).signals


def test_a_reverse_acting_loop_settles_as_the_direct_one():
    """Behind a saturated amplifier the run of a reverse-acting plant is the mirror image, to the last bit."""
    ends, commands = [], []
    for gain in (1.0, -1.0):
        signals = acting(gain)
        ends.append(signals["motor/state/shaft/velocity"].x)
        commands.append(gain * signals["motor/command/armature/effort"].x)
    assert ends[0].tolist() == ends[1].tolist()
    assert commands[0].tolist() == commands[1].tolist()
    assert abs(ends[0][-1] - 3.0) < 1e-6
    assert max(commands[0]) == 80.0  # the first command, with Kp = 20
