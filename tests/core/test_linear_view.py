"""The linear view of loops: held against analytic ones, and margins of delay against what runs do."""

import json
import re
from pathlib import Path

import control
import numpy as np
import pytest
from softrig_bringup.cli import main
from softrig_core import RunError, Scenario, ScenarioError, linear_view, load_scenario, simulate, steady
from softrig_drives.dc_motor.model import state_space
from softrig_drives.dc_motor.pid import DcMotorPid
from softrig_drives.dc_motor.plant import DcMotorPlant
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc

PAGE = Path(__file__).parents[2] / "ros_pkgs" / "softrig_core" / "doc" / "linear_view.md"
T = 0.01  # s, of the motor's loops here


def sampled_motor():
    """The motor from voltage to speed and current, by python-control's own hold."""
    a, b = map(np.array, state_space(DcMotorPlant().p))
    return control.sample_system(control.ss(a[1:, 1:], b[1:, :1], np.eye(2), np.zeros((2, 1))), T, "zoh")


def off(view, L):
    """Largest relative difference of a measured loop to an analytic one below half the Nyquist frequency."""
    w = view.omega[view.omega < 0.5 * np.pi / T]
    exact = L(np.exp(1j * w * T)).ravel()
    return np.abs(view.at_frequencies(w) / exact - 1.0).max()


@pytest.fixture(scope="module")
def pid():
    nodes = load_scenario("dc_motor_smc_b4").model_dump()["nodes"]
    del nodes["dc_motor_metrics"]
    nodes["dc_motor_plant"]["parameters"] = {"vmax": 1e5}
    nodes["dc_motor_pid"]["parameters"] = {"u_max": 1e5}
    about = {"name": "pid", "title": "", "system": "", "source": "", "duration": 1.0, "nodes": nodes}
    return linear_view(Scenario.model_validate(about), window=40.0)


def test_the_loop_of_the_motor_under_pid_is_the_analytic_one(pid):
    c, z = DcMotorPid().p, control.tf([1, 0], [1], T)
    C = c.kp + c.ki * T / (z - 1) + c.kd * c.n_filter * (z - 1) / ((1 + c.n_filter * T) * z - 1)
    speed = sampled_motor()
    P = control.ss(speed.A, speed.B, [[1, 0]], [[0]], T)
    L = control.ss(control.tf(P) * C)
    assert off(pid, L) < 1e-6
    assert sorted(abs(pid.closed.poles())) == pytest.approx(sorted(abs(control.feedback(L).poles())), rel=1e-6)
    gain, phase, _, _, crossing, _ = control.stability_margins(control.frd(L, pid.omega, smooth=True))
    m = pid.margins
    assert (m.gain, m.phase, m.crossover) == pytest.approx((gain, np.radians(phase), crossing), rel=1e-6)
    assert m.delay == pytest.approx(np.radians(phase) / crossing, rel=1e-6)
    assert m.disk == pytest.approx(control.disk_margins(L, pid.omega, 0.0)[0], rel=1e-6)
    w = np.array([1.0, 5.0, 20.0])
    opened = pid.opened(np.exp(1j * w * T)).ravel()
    assert np.abs(opened / pid.at_frequencies(w) - 1.0).max() < 1e-6
    assert pid.error < 1e-9
    assert pid.misfit < 1e-8


def test_the_loop_of_the_motor_under_softened_sliding_mode_is_the_analytic_one():
    overrides = {"period": T, "dc_motor_smc.delta": 5.0}
    view = linear_view("dc_motor_smc", "voltage", overrides=overrides, at=14.0, window=12.0)
    rest = steady("dc_motor_smc", at=14.0, window=0.05, overrides=overrides)
    w, i = rest["motor/state/shaft/velocity"].mean, rest["motor/sensors/current_a/position"].mean
    c = DcMotorSmc(period=T).p
    s = c.c * (1.0 - w) - (c.wd_i * i - c.wd_w * w)
    slope = c.k_per_ref * 5.0 / (abs(s) + 5.0) ** 2  # of K s/(|s| + delta)
    of_w, of_wd = (c.model_a0 - slope * c.c) / c.model_gain, (c.model_a1 - c.c - slope) / c.model_gain
    motor = sampled_motor()
    gains = np.array([[of_w - of_wd * c.wd_w, of_wd * c.wd_i]])
    assert off(view, control.ss(motor.A, motor.B, -gains, 0.0, T)) < 1e-5
    assert view.closed.nstates == 2


def grows(scenario, signal, begin):
    t, x = scenario.signals[signal]
    early, late = (np.ptp(x[(t > a * begin) & (t < (a + 0.5) * begin)]) for a in (1.0, 2.0))
    return late > 0.5 * early


@pytest.mark.long
def test_the_delay_margin_of_the_axis_over_its_fieldbus_is_the_true_one():
    """What is left of one and the same margin at two delays of the fieldbus, and where runs begin to swing."""
    name, y = "dc_motor_fsfb_s1_none", "axis/true_state/axis/position"
    fine = {"dc_axis_plant.counts_per_rev": 4e10}
    left = []
    for delay in (0.02, 0.06):
        overrides = fine | {"fieldbus_delay.delay": delay}
        left.append(linear_view(name, overrides=overrides, at=8.0, window=12.0).margins.delay + delay)
    assert left[0] == pytest.approx(left[1], rel=1e-4)
    periods = int(left[0] / 0.01)
    for n, swings in ((periods, False), (periods + 1, True)):
        run = simulate(name, duration=60.0, overrides=fine | {"fieldbus_delay.delay": n * 0.01})
        assert grows(run, y, 20.0) == swings, n


def test_the_delay_margin_of_the_rectifier_is_the_true_one():
    scenario = load_scenario("rectifier_mpc", {"event_source.times": [0.0, 5.0]})
    view = linear_view(scenario, at=0.1, window=0.4)
    assert view.closed.nstates == 6
    assert view.misfit < 1e-6
    for n, swings in (
        (int(view.margins.delay / view.period), False),
        (int(view.margins.delay / view.period) + 1, True),
    ):
        late = {"link": "v_drop/command", "kind": "delay", "delay": n * view.period}
        changes = {"duration": 1.5, "faults": {"late": late}, "figures": {}, "expect": {}, "claims": {},
                   "requirements": {}}  # fmt: skip
        run = simulate(Scenario.model_validate(scenario.model_dump() | changes))
        assert grows(run, "dc_link/voltage/position", 0.5) == swings, n


@pytest.mark.long
def test_the_speed_loop_of_the_lsrm_is_near_that_of_a_rigid_mass():
    """Near only: a force that ripples along the track makes a loop that changes with the position."""
    view = linear_view(
        "lsrm_fuzzy_pi_fast", "force_cmd/translator", at=1.0, window=4.0, overrides={"current_period": 1e-4}
    )
    P = control.sample_system(control.tf([1], [5.0, 10.0 + 14.0]), 1e-3, "zoh")  # M, C + k_p
    C = 80.0 * (1.3 + 3.2 * 1e-3 / (control.tf([1, 0], [1], 1e-3) - 1))
    rigid = control.frd((P * C)(np.exp(1j * view.omega * 1e-3)), view.omega, smooth=True)
    _, phase, _, crossing = control.margin(rigid)
    assert view.margins.crossover == pytest.approx(crossing, rel=0.02)
    assert np.degrees(view.margins.phase) == pytest.approx(phase, abs=1.0)
    assert 1e-3 < view.variation < 0.1


def test_a_loop_that_cannot_be_seen_is_told(pid):
    with pytest.raises(RunError, match=r"left, expected 0.0001: the loop is unstable, or a longer window"):
        linear_view("dc_motor_smc", "voltage", overrides={"period": T, "dc_motor_smc.delta": 5.0}, window=0.3)
    with pytest.raises(RunError, match="does not come back there: no loop"):
        linear_view("dc_motor_smc", "motor/reference/shaft", overrides={"period": T}, window=3.0)
    with pytest.raises(ScenarioError, match="no signal 'volt'"):
        linear_view("dc_motor_smc", "volt")
    with pytest.raises(ScenarioError, match=r"open which link.*phase_voltage/a/effort"):
        linear_view("lsrm_fuzzy")
    with pytest.raises(ScenarioError, match="has 5 ticks in the window"):
        linear_view("dc_motor_smc", "voltage", overrides={"period": T}, window=0.05)


def test_what_rests_and_what_moves():
    rest = steady("dc_motor_smc", at=14.0, overrides={"period": T, "dc_motor_smc.delta": 5.0})
    assert rest["motor/command/armature/effort"].rests(1e-3)
    assert rest["motor/state/shaft/velocity"].mean == pytest.approx(1.0, abs=1e-3)
    assert rest["motor/state/shaft/position"].swing == pytest.approx(1.4, abs=0.02)  # it turns
    assert not rest["motor/state/shaft/position"].rests(1e-3)
    with pytest.raises(ScenarioError, match="window = 9 s: expected more than 0, at most the run's 1 s"):
        steady("dc_motor_smc", at=1.0, window=9.0, overrides={"period": T})


def test_the_verbs(tmp_path, capsys):
    common = ["dc_motor_smc", "--set", "period=0.01", "--set", "dc_motor_smc.delta=5"]
    assert main(["linearise", *common, "--at", "8", "--window", "12", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "delay margin" in out
    found = json.loads((tmp_path / "linear.json").read_text())
    assert found["link"] == "motor/command/armature/effort"
    assert len(found["closed"]["poles"]) == len(found["closed"]["A"])
    assert (tmp_path / "linear.png").read_bytes().startswith(b"\x89PNG")
    assert main(["steady", *common, "--at", "14"]) == 1
    assert re.search(r"shaft/position\t.*rad\tmoves: swing", capsys.readouterr().out)


def test_the_page_says_what_is(capsys):
    text = PAGE.read_text()
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], {})
    assert capsys.readouterr().out == re.search(r"```text\n(.*?)```", text, re.DOTALL)[1]
