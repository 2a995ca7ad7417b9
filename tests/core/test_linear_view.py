"""The linear view of loops, compared with analytic ones; delay margins, compared with runs."""

import json
import math
import re
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple

import control
import numpy as np
import pytest
from softrig_bringup.cli import main
from softrig_control.limit_cycle import Swinging
from softrig_core import (
    Block,
    NoOperatingPoint,
    Plant,
    Rig,
    RunError,
    Scenario,
    ScenarioError,
    linear_view,
    load_scenario,
    number,
    simulate,
    steady,
)
from softrig_core.analysis.state_map import StateMap
from softrig_core.analysis.steady import _move
from softrig_core.kit.floats import put, read
from softrig_drives.dc_motor.model import state_space
from softrig_drives.dc_motor.pid import DcMotorPid
from softrig_drives.dc_motor.plant import DcMotorPlant
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc

PAGE = Path(__file__).parents[2] / "ros_pkgs" / "softrig_core" / "doc" / "linear_view.md"
T = 0.01  # period of the motor loops in this file, s


def sampled_motor():
    """The motor from voltage to speed and current, by python-control's zero-order hold."""
    a, b = map(np.array, state_space(DcMotorPlant().p))
    return control.sample_system(control.ss(a[1:, 1:], b[1:, :1], np.eye(2), np.zeros((2, 1))), T, "zoh")


def off(view, L):
    """Largest relative difference of a measured loop to an analytic one below half the Nyquist frequency."""
    w = view.omega[view.omega < 0.5 * np.pi / T]
    exact = L(np.exp(1j * w * T)).ravel()
    return np.abs(view.at_frequencies(w) / exact - 1.0).max()


def motor_under_pid(**pid):
    nodes = load_scenario("dc_motor_smc_b4").model_dump()["nodes"]
    del nodes["dc_motor_metrics"]
    nodes["dc_motor_plant"]["parameters"] = {"vmax": 1e5}
    nodes["dc_motor_pid"]["parameters"] = {"u_max": 1e5, **pid}
    about = {"name": "pid", "title": "", "system": "", "source": "", "duration": 1.0, "nodes": nodes}
    return Scenario.model_validate(about)


def pid_loop(**pid):
    """The analytic loop, the integral of a PID law with positive gains."""
    c, z = DcMotorPid(**pid).p, control.tf([1, 0], [1], T)
    C = c.kp + c.ki * T / (z - 1) + c.kd * c.n_filter * (z - 1) / ((1 + c.n_filter * T) * z - 1)
    speed = sampled_motor()
    P = control.ss(speed.A, speed.B, [[1, 0]], [[0]], T)
    return control.ss(P * control.ss(C))


LARGE = {name: 60.0 * getattr(DcMotorPid().p, name) for name in ("kp", "ki", "kd")}  # the gain margin is 53.7


def slow(poles):
    return sorted(abs(p) for p in poles if abs(p) > 1e-3)


@pytest.mark.parametrize("kp", [None, LARGE["kp"]])
def test_the_loop_of_the_motor_under_pid_is_the_analytic_one(kp):
    gains = {} if kp is None else LARGE
    view, L = linear_view(motor_under_pid(**gains), at=0.5), pid_loop(**gains)
    assert off(view, L) < 1e-8
    assert slow(view.loop_poles) == pytest.approx(slow(control.feedback(L).poles()), rel=1e-8)
    assert view.stable == (kp is None)
    assert [m for m in view.modes if abs(m.pole) > 1.0 + 1e-9] == ([] if kp is None else view.modes[:1])
    gain, phase, _, _, crossing, _ = control.stability_margins(control.frd(L, view.omega, smooth=True))
    m = view.margins
    assert (m.phase, m.crossover) == pytest.approx((np.radians(phase) % (2.0 * np.pi), crossing), rel=1e-6)
    assert (m.gain if kp is None else m.gain_down) == pytest.approx(gain, rel=1e-6)
    if kp is None:
        assert m.delay == pytest.approx(np.radians(phase) / crossing, rel=1e-6)
        assert m.disk == pytest.approx(control.disk_margins(L, view.omega, 0.0)[0], rel=1e-6)
    else:  # at the lower gain margin the loop is still stable
        assert abs(control.feedback(pid_loop(**gains) * m.gain_down * 0.999).poles()).max() < 1.0
    w = np.array([1.0, 5.0, 20.0])
    assert np.abs(view.opened(np.exp(1j * w * T)).ravel() / view.at_frequencies(w) - 1.0).max() < 1e-9
    assert max(view.error, view.state_error) < 1e-10


def test_states_are_named_and_the_whole_system_is_that_of_the_motor(capsys):
    view = linear_view(motor_under_pid(), at=0.5)
    assert {"dc_motor_plant.w", "dc_motor_plant.i", "dc_motor_pid.pid.integral"} <= set(view.states)
    at = [view.states.index(f"dc_motor_plant.{x}") for x in ("w", "i")]
    # The opened loop has only the plant.
    assert view.a[np.ix_(at, at)] == pytest.approx(sampled_motor().A, rel=1e-9)
    assert view.b[at] == pytest.approx(sampled_motor().B[:, 0], rel=1e-9)
    assert view.closed.state_labels == list(view.states)
    assert view.closed.output_labels == list(view.outputs)
    turning = next(m for m in view.modes if m.pole == 1.0)
    assert turning.shares["dc_motor_plant.theta"] == pytest.approx(1.0)
    oscillating = next(m for m in view.modes if m.pole.imag)
    assert next(iter(oscillating.shares)) == "dc_motor_plant.w"
    assert sum(oscillating.shares.values()) == pytest.approx(1.0, abs=0.05)


class Late(NamedTuple):
    line: tuple[float, ...]


class Shift(Block):
    """Publishes what it received three ticks ago."""

    INPUTS = (number("u", "plant/y", "1"),)
    OUTPUTS = (number("v", "late/v", "1"),)

    def first(self):
        return Late((0.0,) * 3)

    def update(self, x, t, u):
        return Late((*x.line[1:], u[0])), {"v": (x.line[0],)}


class Unstable(Plant):
    """x+ = 1.1 x + u."""

    INPUTS = (number("u", "law/u", "1"),)
    OUTPUTS = (number("y", "plant/y", "1"),)

    def first(self):
        return 0.25

    def outputs(self, x, t):
        return {"y": (x,)}

    def advance(self, x, t, u):
        return 1.1 * x + u[0]


class Gain(Block):
    INPUTS = (number("v", "late/v", "1"),)
    OUTPUTS = (number("u", "law/u", "1"),)
    gain = -0.11

    def update(self, x, t, v):
        return x, {"u": (self.gain * v[0],)}


def test_an_unstable_opened_loop_and_a_delay_are_exact_to_rounding():
    rig = Rig.from_blocks({"plant": Unstable(), "shift": Shift(), "law": Gain()}, duration=5.0)
    view = linear_view(rig, "law/u", at=3.0)
    z = control.tf([1, 0], [1], rig.clock.params.period)
    L = control.ss(0.11 / (z**3 * (z - 1.1)))
    assert off_at(view, L) < 1e-12
    assert max(abs(view.opened.poles())) == pytest.approx(1.1, rel=1e-14)
    assert slow(view.loop_poles) == pytest.approx(slow(control.feedback(L).poles()), rel=1e-9)
    line = [n for n in view.states if ".line[" in n]
    at = [view.states.index(n) for n in line]
    assert view.a[np.ix_(at, at)].tolist() == np.eye(3, k=1).tolist()  # The shift register only moves its values.


def off_at(view, L):
    w = view.omega[view.omega < 0.5 * np.pi / view.period]
    return np.abs(view.at_frequencies(w) / L(np.exp(1j * w * view.period)).ravel() - 1.0).max()


def test_the_whole_system_is_the_same_wherever_its_loop_is_opened():
    """Also if an input acts immediately on the link or through it, and if it is not in the loop at all (the
    reference).
    """
    speed, command = "motor/state/shaft/velocity", "motor/command/armature/effort"
    received, z = [speed, "motor/reference/shaft/velocity", command], np.exp(1j * T * np.array([1.0, 5.0, 20.0]))
    whole, *opened = (
        linear_view(motor_under_pid(), link, at=0.5, inputs=[speed], outputs=received).closed(z)
        for link in ("", command, speed)
    )
    for result in opened:
        assert result == pytest.approx(whole, rel=1e-9, abs=1e-12)


def test_the_loop_of_the_motor_under_softened_sliding_mode_is_the_analytic_one():
    overrides = {"period": T, "dc_motor_smc.delta": 5.0}
    view = linear_view("dc_motor_smc", "voltage", overrides=overrides, at=14.0)
    w, i = view.values["dc_motor_plant.w"], view.values["dc_motor_plant.i"]
    c = DcMotorSmc(period=T).p
    s = c.c * (1.0 - w) - (c.wd_i * i - c.wd_w * w)
    slope = c.k_per_ref * 5.0 / (abs(s) + 5.0) ** 2  # the slope of K s/(|s| + delta)
    of_w, of_wd = (c.model_a0 - slope * c.c) / c.model_gain, (c.model_a1 - c.c - slope) / c.model_gain
    motor = sampled_motor()
    gains = np.array([[of_w - of_wd * c.wd_w, of_wd * c.wd_i]])
    assert off(view, control.ss(motor.A, motor.B, -gains, 0.0, T)) < 1e-8
    assert len(slow(view.loop_poles)) == 2


def grows(scenario, signal, begin):
    t, x = scenario.signals[signal]
    early, late = (np.ptp(x[(t > a * begin) & (t < (a + 0.5) * begin)]) for a in (1.0, 2.0))
    return late > 0.5 * early


def test_counts_of_a_fine_encoder_are_states():
    """They were once integers, which the view leaves out: 0.2 s, unstable."""
    fine = {"dc_axis_plant.counts_per_rev": 4e10, "fieldbus_delay.delay": 0.02}
    view = linear_view("dc_motor_fsfb_s1_none", overrides=fine, at=2.0)
    assert view.stable
    assert view.margins.delay == pytest.approx(0.064052, abs=1e-6)
    assert view.state_error < 1e-3


class Counted(NamedTuple):
    """An encoder count, and how often it changed."""

    counts: int = 0
    changes: int = 0


class Encoder(Block):
    """Publishes its count one tick later: as an integer, too fine for any step of a column."""

    INPUTS = (number("u", "plant/y", "1"),)
    OUTPUTS = (number("v", "late/v", "1"),)
    used = True

    def first(self):
        return Counted()

    def update(self, x, t, u):
        n = round(u[0] * 2.0**60)
        return Counted(n, x.changes + (n != x.counts)), {"v": (x.counts / 2.0**60 if self.used else u[0],)}


@pytest.mark.parametrize("used", [True, False])
def test_changing_integers_are_refused_if_outputs_depend_on_them(used):
    """The loop contained them, and the view without them was wrong: no loop, or a stable one."""

    class Fine(Encoder):
        pass

    Fine.used = used
    rig = Rig.from_blocks({"plant": Unstable(), "shift": Fine(), "law": Gain()}, duration=5.0)
    if not used:  # then only counters change
        assert linear_view(rig, "law/u", at=0.5).states == ("plant",)
        return
    for view in (partial(linear_view, rig, "law/u"), partial(linear_view, rig, ""), partial(steady, rig)):
        with pytest.raises(
            RunError, match=r"shift\.counts changes with plant at 0\.5 s, .* is not a float: whole numbers"
        ):
            view(at=0.5)


class Kept(NamedTuple):
    """A count, and a float computed from it one tick later."""

    counts: int = 0
    made: float = 0.0


class Keeper(Encoder):
    """Counts, converts to a float, and publishes nothing."""

    used = True

    def first(self):
        return Kept()

    def update(self, x, t, u):
        made = x.counts / 2.0**60 if self.used else 0.0
        return Kept(round(u[0] * 2.0**60), made), {"v": (u[0],)}


@pytest.mark.parametrize("used", [True, False])
def test_values_that_no_output_depends_on_are_left_out(used):
    keeper = type("Keeper", (Keeper,), {"used": used})
    rig = Rig.from_blocks({"plant": Unstable(), "shift": keeper(), "law": Gain()}, duration=5.0)
    if not used:
        assert linear_view(rig, "law/u", at=0.5).states == ("plant",)
        return
    with pytest.raises(RunError, match=r"^rig: shift\.counts changes with "):
        linear_view(rig, "law/u", at=0.5)


@pytest.mark.long
def test_the_delay_margin_of_the_axis_over_its_fieldbus_is_the_true_one():
    """The rest of one margin at two delays of the fieldbus, and the delay at which runs begin to oscillate."""
    name, y = "dc_motor_fsfb_s1_none", "axis/true_state/axis/position"
    fine = {"dc_axis_plant.counts_per_rev": 4e10}
    left = []
    for delay in (0.02, 0.06):
        view = linear_view(name, overrides=fine | {"fieldbus_delay.delay": delay}, at=8.0)
        left.append(view.margins.delay + delay)
    assert left[0] == pytest.approx(left[1], rel=1e-6)
    assert sum("fieldbus_delay.line" in name for name in view.states) == 12  # two values in each of six messages
    # Beyond the delay margin the loop oscillates.
    late = linear_view(name, overrides=fine | {"fieldbus_delay.delay": 0.09}, at=1.0)
    assert not late.stable
    assert max(abs(late.loop_poles)) > 1.001
    periods = int(left[0] / 0.01)
    for n, swings in ((periods, False), (periods + 1, True)):
        run = simulate(name, duration=60.0, overrides=fine | {"fieldbus_delay.delay": n * 0.01})
        assert grows(run, y, 20.0) == swings, n


@pytest.mark.long
def test_the_delay_margin_of_the_rectifier_is_the_true_one():
    scenario = load_scenario("rectifier_mpc", {"event_source.times": [0.0, 5.0]})
    view = linear_view(scenario, at=0.1)
    assert max(abs(view.loop_poles)) == pytest.approx(0.9559, abs=1e-4)
    assert view.state_error < 1e-7
    for n, swings in (
        (int(view.margins.delay / view.period), False),
        (int(view.margins.delay / view.period) + 1, True),
    ):
        late = {"link": "v_drop/command", "kind": "delay", "delay": n * view.period}
        changes = {
            "duration": 1.5,
            "faults": {"late": late},
            "figures": {},
            "expect": {},
            "claims": {},
            "requirements": {},
        }
        run = simulate(Scenario.model_validate(scenario.model_dump() | changes))
        assert grows(run, "dc_link/voltage/position", 0.5) == swings, n


@pytest.mark.long
def test_the_speed_loop_of_the_lsrm_is_near_that_of_a_rigid_mass():
    """Only near: the force ripples along the track, so the loop changes with the position."""
    view = linear_view("lsrm_fuzzy_pi_fast", "force_cmd/translator", at=1.0, overrides={"current_period": 1e-4})
    # The period is that of the speed controller; plant and current controller run faster.
    assert view.period == pytest.approx(1e-3)
    P = control.sample_system(control.tf([1], [5.0, 10.0 + 14.0]), 1e-3, "zoh")  # inertia M, damping C + k_p
    C = 80.0 * (1.3 + 3.2 * 1e-3 / (control.tf([1, 0], [1], 1e-3) - 1))
    rigid = control.frd((P * C)(np.exp(1j * view.omega * 1e-3)), view.omega, smooth=True)
    _, phase, _, crossing = control.margin(rigid)
    assert view.margins.crossover == pytest.approx(crossing, rel=0.02)
    assert np.degrees(view.margins.phase) == pytest.approx(phase, abs=1.0)
    # psi_b is a state of the rig but not of the loop: phase b carries no current, so its flux can only rise.
    assert "lsrm_plant.psi_b" in view.states
    assert "lsrm_plant.psi_b" not in view.opened.state_labels
    assert 1e-3 < view.state_error < 0.1


@pytest.mark.long
def test_a_loop_that_cannot_be_linearised_is_reported():
    motor = {"overrides": {"period": T}, "at": 1.0}
    with pytest.raises(RunError, match=r"motor_reference does not depend on motor/reference/.*: no loop"):
        linear_view("dc_motor_smc", "motor/reference/shaft", **motor)
    with pytest.raises(
        RunError,
        match=r"effort by 0\.0312 comes back there at 0\.1 s, within 10 periods, a smaller "
        "one does not: .* in steps",
    ):
        linear_view("dc_motor_smc_b2", at=0.1)
    with pytest.raises(
        RunError, match=r"effort by 8 comes back there at 0\.3 s, .* in steps"
    ):  # without this check all margins would be infinite
        linear_view("dc_motor_fsfb", at=0.3)
    with pytest.raises(ScenarioError, match="no signal 'volt'"):
        linear_view("dc_motor_smc", "volt", **motor)
    with pytest.raises(
        ScenarioError,
        match=r"published every 0.0001 s, but the rig repeats only every 0.001 s; open the "
        r"loop where it is slow: .*force_cmd",
    ):
        linear_view("lsrm_fuzzy_pi_fast", "phase_voltage/a", at=0.1, overrides={"current_period": 1e-4})
    periods = "dc_motor_smc 0.0123457 s, dc_motor_plant 1e-07 s"  # the message lists the slowest node first
    with pytest.raises(ScenarioError, match=rf"due together only every .* divide each other with --set \({periods}\)$"):
        linear_view("dc_motor_smc", overrides={"dc_motor_smc.period": 0.0123457, "dc_motor_plant.period": 1e-7}, at=0.0)
    with pytest.raises(ScenarioError, match="at = -1 s: expected 0 or more"):
        linear_view("dc_motor_smc", at=-1.0)


class OneSided(Unstable):
    """x+ = (x + 1)/2, and less by the part below -1."""

    def advance(self, x, t, u):
        return 0.5 * x + 0.5 + min(u[0] + 1.0, 0.0)


def test_a_one_sided_derivative_is_found_on_its_side():
    rig = Rig.from_blocks({"plant": OneSided(), "shift": Shift(), "law": Gain()}, duration=5.0)
    with pytest.raises(
        RunError, match=r"^rig: a change of law/u/data by 1 comes back there at 0\.5 s, within 10 periods"
    ):
        linear_view(rig, "law/u", at=0.5)


class Slow(Block):
    """Publishes a request that no node follows immediately."""

    OUTPUTS = (number("w", "slow/w", "1"),)

    def update(self, x, t):
        return x, {"w": (t / 1e9,)}


class Listening(Gain):
    INPUTS = (*Gain.INPUTS, number("w", "slow/w", "1", held=True))

    def update(self, x, t, v, w):
        return x, {"u": (self.gain * v[0] + (w or (0.0,))[0],)}


@pytest.mark.parametrize(("inputs", "periods"), [((), 2), (("slow/w",), 6), (None, 2)])
def test_the_period_of_the_whole_system_is_the_common_one(inputs, periods):
    """Of all nodes except sources, and of sources to which something is added."""
    blocks = {
        "plant": Unstable(period=0.01),
        "shift": Shift(period=0.02),
        "law": Listening(period=0.02),
        "slow": Slow(period=0.03),
    }
    view = linear_view(Rig.from_blocks(blocks, duration=1.0), "", at=0.5, inputs=inputs)
    assert view.period == pytest.approx(0.01 * periods)
    assert view.inputs == tuple(f"{name}/data" for name in inputs or ())
    assert view.at == pytest.approx(math.ceil(0.5 / view.period - 1e-9) * view.period)


class Peaks(Unstable):
    """At 7 after its 51st tick, at -9 after the next; else at 1."""

    def first(self):
        return 0.0

    def outputs(self, x, t):
        return {"y": (x,)}

    def advance(self, x, t, u):
        k = round(t / 1e7) + 1
        return {51: 7.0, 52: -9.0}.get(k, 1.0)


@pytest.mark.parametrize(("at", "size"), [(1.0, 7.0), (0.52, 9.0), (0.51, 7.0), (0.5, 1.0), (0.1, 1.0), (0.0, 0.0)])
def test_sizes_of_states_are_the_largest_of_twenty_samples_of_the_run(at, size):
    """Of a hundred ticks the first is sampled, each fifth from there, and the last; of some fifty each second."""
    rig = Rig.from_blocks({"plant": Peaks(period=0.01), "shift": Shift(period=0.01), "law": Gain(period=0.01)}, 2.0)
    result = StateMap(rig, at, 0, ["plant/y/data"], [], 5)
    k = result.names.index("plant")
    assert (result.t, result.period) == (pytest.approx(at), pytest.approx(0.01))
    assert (result.sizes[k], result.moved[k]) == (size, True)


SYSTEMS = {"dc_motor_fsfb": "in steps .a quantised sensor", "dc_motor_smc": "",
           "dc_motor_smc_b2": "in steps .a quantised sensor", "economic_dispatch": "",
           "fault_location": "numbers move, .* of them in ", "gupfc": "", "induction_dtc": "", "lsrm_fuzzy": "",
           "manipulator_adsmc": "", "optimal_control_mvim": "",
           "pv_mppt": "duty/effort comes back there .* is at a limit, or waits",
           "pwa_delay": "numbers move, .* of them in switched_delay_plant.past", "rectifier_mpc": "",
           "rehab_impedance": "", "tcp_aqm_smc": "numbers move, .* of them in tcp_fluid.past"}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("name", "reason"), SYSTEMS.items())
def test_each_system_has_a_linear_view_or_a_reason_why_not(name, reason):
    if reason:
        with pytest.raises(RunError, match=reason):
            linear_view(name, at=0.3)
    else:
        view = linear_view(name, at=0.3)
        assert view.states
        assert view.error < 1e-6
        assert np.isfinite(view.A).all()


@pytest.mark.long
def test_a_loop_with_a_short_delay_has_a_view():
    steps = dict.fromkeys(("tcp_fluid.period", "tcp_fluid.h", "aqm_controller.period", "aqm_metrics.period"), 0.02)
    view = linear_view("tcp_aqm_smc", at=15.0, overrides=steps | {"tcp_fluid.history": 0.3})
    assert view.stable
    assert 0.0 < view.margins.delay < math.inf
    assert view.state_error < 1e-2


@pytest.mark.long
def test_a_state_may_have_the_name_of_an_input_and_one_that_only_a_warning_reads_does_not_count():
    # Both the state and an input of the speed controller are named `reference`.
    view = linear_view("induction_dtc", at=0.05)
    assert "im_plant.omega" in view.states
    swinging = Swinging(400.0, 401.0, 399.0, swings=(2.0, 2.0))
    assert [name for name, _ in read((1.0, swinging, (2.0,)))] == ["[0]", "[2]"]
    assert put((1.0, swinging, (2.0,)), [np.array([3.0]), np.array([2.0])]) == (3.0, swinging, (2.0,))


class Outside(Shift):
    """Keeps part of its state outside of x."""

    elsewhere: ClassVar[list] = [0.0]

    def update(self, x, t, u):
        self.elsewhere[0] += 1.0
        return x, {"v": (u[0] + self.elsewhere[0],)}


def test_a_state_that_cannot_be_restored_is_reported_by_name():
    rig = Rig.from_blocks({"plant": Unstable(), "shift": Outside(), "law": Gain()}, duration=1.0)
    with pytest.raises(
        RunError, match=r"^rig: law, plant cannot be put back to where it was at 0\.5 s: "
    ):  # the message names the nodes that use the state
        linear_view(rig, "law/u", at=0.5)


# operating points


def test_the_operating_point_of_the_motor_is_the_analytic_one():
    scenario = motor_under_pid()
    point = steady(scenario, at=0.5)  # at 0.5 s the run has not reached the operating point
    p = DcMotorPlant().p
    assert point.states["dc_motor_plant.w"] == pytest.approx(10.0, rel=1e-12)
    assert point.states["dc_motor_plant.i"] == pytest.approx(p.b * 10.0 / p.Kt, rel=1e-9)
    assert point.signals["motor/state/shaft/velocity"] == pytest.approx(10.0, rel=1e-12)
    assert point.drifting["dc_motor_plant.theta"] == pytest.approx(10.0, rel=1e-9)
    assert point.stable
    end = simulate(scenario, duration=40.0).signals["motor/state/shaft/velocity"][1][-1]
    assert end == pytest.approx(point.signals["motor/state/shaft/velocity"], rel=1e-6)


class Integrator(Unstable):
    """x+ = x + 1 + u: at rest where the controller publishes -1."""

    def advance(self, x, t, u):
        return x + 1.0 + max(u[0], self.least)

    least = -2.0


@pytest.mark.parametrize("least", [-2.0, -0.5])
def test_a_missing_operating_point_is_reported(least):
    class Plain(Integrator):
        pass

    Plain.least = least
    rig = Rig.from_blocks({"plant": Plain(), "shift": Shift(), "law": Gain()}, duration=5.0)
    if least < -1.0:
        assert steady(rig, at=1.0).states["plant"] == pytest.approx(1.0 / 0.11, rel=1e-9)
        return
    with pytest.raises(
        NoOperatingPoint, match=r"no operating point near t = 1 s: .* is not steady; .* moves by \d+ within 2 s"
    ):
        steady(rig, at=1.0)


def test_a_view_of_a_wrong_link_is_refused(monkeypatch, capsys):
    view = linear_view("dc_motor_smc", overrides={"period": 0.01, "dc_motor_smc.delta": 5.0}, at=2.0)
    monkeypatch.setattr("softrig_bringup.verbs.linear.linear_view", lambda *_, **__: replace(view, state_error=0.6))
    assert main(["linearise", "dc_motor_smc"]) == 0
    assert "this is not the rig" in capsys.readouterr().out


def test_the_verbs_print_the_view(tmp_path, capsys, undrawn):
    common = ["dc_motor_smc", "--set", "period=0.01", "--set", "dc_motor_smc.delta=5"]
    assert main(["linearise", *common, "--at", "8", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert re.search(r"delay margin +1\.1\d+ s", out)
    assert "dc_motor_plant.i 88%" in out
    assert "this is not the rig" not in out
    content = json.loads((tmp_path / "linear.json").read_text())
    assert content["link"] == "motor/command/armature/effort"
    assert len(content["closed"]["A"]) == len(content["closed"]["states"])
    assert (tmp_path / "linear.png").read_bytes().startswith(b"\x89PNG")
    assert main(["steady", *common, "--at", "14"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"shaft/velocity\t0.99996\d* rad/s", out)
    assert re.search(r"dc_motor_plant.theta\t.*drifts by 0.99996\d* a second", out)
    # The motor chatters, so there is no operating point.
    assert main(["steady", "dc_motor_smc", "--set", "period=0.01", "--at", "2"]) == 1
    assert "no operating point near t = 2 s" in capsys.readouterr().err


@pytest.mark.long
def test_the_page_is_true(capsys):
    text = PAGE.read_text()
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], {})
    assert capsys.readouterr().out == re.search(r"```text\n(.*?)```", text, re.DOTALL)[1]


def test_infinite_states_give_no_warning():
    """`steady` printed numpy's warnings of them before its answer."""

    class Map:
        start = np.array([1.0, math.inf])

        def __call__(self, x, inputs):
            return np.array([3.0, math.inf]), {}

    with np.errstate(all="raise"):
        assert _move(Map(), [0]).tolist() == [2.0]


@pytest.mark.long
def test_a_missing_operating_point_is_reported_without_a_warning_before_it():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(NoOperatingPoint, match="Newton's method does not converge"):
            steady("lsrm_fuzzy")
