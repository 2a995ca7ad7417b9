"""Buck and boost converters and the PID controller: against textbook ratios, scipy with events, and linear loops."""

import math
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import dlti, dstep
from softrig_control.nodes.pid_controller import PidController, PidControllerParams
from softrig_control.pid import Pid, PidParams, PidState
from softrig_core import ByHand, simulate
from softrig_power.dcdc.plant import DcdcPlant, DcdcPlantParams


def settled(periods=3000, **values):
    """Run a converter at a constant duty ratio; return its mean output over the last periods, and its state."""
    duty = values.pop("duty")
    block = ByHand(DcdcPlant(DcdcPlantParams(**{"delay": 0, "C": 50e-6, **values})))
    seen = []
    for k in range(periods):
        block.advance(k * 10_000, duty=(duty,), load_current=None)
        seen.append(block.outputs(k * 10_000)["converter"][0])
    return float(np.mean(seen[-50:])), block.x


@pytest.mark.parametrize("duty", [0.3, 0.6])
def test_continuous_conduction(duty):
    """V = D U and U/(1 - D), Erickson and Maksimovic, equations 2.17 and 2.40."""
    assert settled(duty=duty, R=2.0)[0] == pytest.approx(duty * 28.0, rel=2e-3)
    assert settled(duty=duty, R=5.0, C=5e-4, topology="boost", v_0=28.0)[0] == pytest.approx(
        28.0 / (1 - duty), rel=5e-3
    )


@pytest.mark.parametrize("topology", ["buck", "boost"])
def test_the_boundary_of_discontinuous_conduction(topology):
    """K = 2 L/(R T): above K_crit the valley of the current is above zero, below it the ratio M is another.

    Erickson and Maksimovic, table 5.2: K_crit = 1 - D and D (1 - D)^2; M = 2/(1 + sqrt(1 + 4 K/D^2)) and
    (1 + sqrt(1 + 4 D^2/K))/2.
    """
    D, L, T = 0.4, 50e-6, 1e-5
    critical = 1.0 - D if topology == "buck" else D * (1.0 - D) ** 2
    for share in (0.4, 0.95, 1.05):
        K = share * critical
        v, x = settled(duty=D, R=2.0 * L / (K * T), L=L, topology=topology, C=20e-6, periods=6000, v_0=20.0)
        assert (x.i > 1e-9) == (share > 1.0)
        if share < 1.0:
            buck = 2.0 / (1.0 + math.sqrt(1.0 + 4.0 * K / D**2))
            M = buck if topology == "buck" else 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * D**2 / K))
            assert v == pytest.approx(M * 28.0, rel=1e-2)


def test_losses_and_saturation_equal_those_of_scipy_with_events():
    """Twenty periods of a boost converter with all parasitics, discontinuous at first; within 1e-6."""
    p = DcdcPlantParams(topology="boost", delay=0, R_L=0.05, R_on=0.03, v_diode=0.6, R_C=0.02, i_sat=3.0, v_0=30.0,
                        R=15.0, C=40e-6, substeps=32)  # fmt: skip
    block = ByHand(DcdcPlant(p))
    y, T = [0.0, 30.0], p.period

    def slope(_, y, on):
        i, v = y
        fed = 0.0 if on else 1.0
        v_o = (v + p.R_C * fed * i) / (1.0 + p.R_C / p.R)
        L = p.L_sat + (p.L - p.L_sat) / (1.0 + (i / p.i_sat) ** 2)
        return [(p.U - (p.R_L + on * p.R_on) * i - fed * (p.v_diode + v_o)) / L, (fed * i - v_o / p.R) / p.C]

    def empty(_, y, on):
        return y[0]

    empty.terminal, empty.direction = True, -1
    more = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    for k in range(20):
        duty = 0.15 + 0.02 * k
        block.advance(k * 10_000, duty=(duty,), load_current=None)
        y = solve_ivp(slope, (0.0, duty * T), y, args=(1.0,), **more).y[:, -1]
        part = solve_ivp(slope, (duty * T, T), y, args=(0.0,), events=empty, **more)
        y = part.y[:, -1]
        if part.t[-1] < T:
            y = np.array([0.0, y[1] * math.exp(-(T - part.t[-1]) / (p.C * (p.R + p.R_C)))])
    assert (block.x.i, block.x.v) == pytest.approx(tuple(y), rel=1e-6)


@pytest.mark.parametrize("name", ["buck_pi", "buck_pi_cascade", "buck_pi_light"])
def test_converters_meet_their_expectations(name):
    assert not simulate(name).missed


def test_impossible_converters_are_refused():
    for values, text in (
        ({"L_sat": 1.0, "i_sat": 1.0}, "at most L"),
        ({"load_times": (0.0, 0.0)}, "later than the one before"),
        ({"C": 1e-10}, "C = 1e-10 F: its fastest time constant is"),
    ):
        with pytest.raises(ValueError, match=text):
            DcdcPlantParams(**values)


# PID --------------------------------------------------------------------------------------------------------------


def controller(**values):
    return ByHand(PidController(PidControllerParams(**values)))


def command(block, t, y, r=None):
    return block.update(t, measurement=(y,), **({} if r is None else {"reference": (r,)}))["command"][0]


def test_it_equals_the_pid_of_the_suite_with_the_same_options():
    """The same bits except for the first derivative, for which the suite's PID assumes an error of zero before."""
    gains = {"kp": 2.0, "ki": 3.0, "kd": 0.1, "n_filter": 50.0}
    law, x = Pid(PidParams(**gains, u_max=5.0), 0.01), PidState()
    block = controller(**gains, u_min=-5.0, u_max=5.0, period=0.01, set_point=0.0)
    draw = np.random.default_rng(2)
    for k, y in enumerate([0.0, *draw.uniform(-3.0, 3.0, 300).tolist()]):
        x, u = law(x, 0.0 - y)
        assert command(block, k, y) == pytest.approx(min(max(u, -5.0), 5.0), abs=1e-12), k


@pytest.mark.parametrize(("form", "t_i", "t_d"), [("ideal", 0.4, 0.05), ("series", 0.4, 0.05), ("ideal", 0.0, 0.05)])
def test_forms(form, t_i, t_d):
    """Each form against its transfer function with backward differences, as polynomials in z, in scipy."""
    T, K, N = 0.01, 1.7, 80.0
    block = controller(form=form, kp=K, t_i=t_i, t_d=t_d, n_filter=N, period=T, set_point=1.0, anti_windup="none")
    y = [0.0, *np.sin(0.05 * np.arange(200)).tolist()]
    results = [command(block, k, v) for k, v in enumerate(y)]
    Ki, Kd, Kp = (K / t_i if t_i else 0.0), K * t_d, K * (1.0 + (t_d / t_i if form == "series" and t_i else 0.0))
    # The law: u = Kp e + Ki T/(z - 1) e + Kd N (z - 1)/((1 + N T) z - 1) e.
    e = 1.0 - np.array(y)
    integral = Ki * T * np.concatenate([[0.0], np.cumsum(e)[:-1]])
    num, den = [Kd * N, -Kd * N], [1.0 + N * T, -1.0]
    derivative = dlti(num, den, dt=T).output(e - e[0], np.arange(len(e)) * T)[1][:, 0]
    assert results == pytest.approx(Kp * e + integral + derivative, abs=1e-9)


def test_derivative_on_the_measurement_and_set_point_weight_do_not_kick():
    block = controller(kp=2.0, kd=1.0, derivative_on="measurement", weight=0.0, ki=1.0, reference="r/r/position")
    assert command(block, 0, 0.0, 0.0) == 0.0
    # The step itself only acts through the integral, from the next tick on.
    assert command(block, 1, 0.0, 10.0) == 0.0
    assert command(block, 2, 0.0, 10.0) == pytest.approx(1.0 * 10.0 * 0.001)
    kicked = controller(kp=2.0, kd=1.0, reference="r/r/position")
    command(kicked, 0, 0.0, 0.0)
    assert command(kicked, 1, 0.0, 10.0) > 900.0


def test_the_integral_does_not_wind_up():
    """A plant 1/(s + 1) that cannot follow for 5 s, then can: how long the command stays at its limit."""
    stays = {}
    for way in ("none", "conditional", "back_calculation"):
        block, y, held = controller(kp=2.0, ki=2.0, u_min=0.0, u_max=1.0, anti_windup=way, period=0.01, t_t=0.2,
                                    reference="r/r/position"), 0.0, 0  # fmt: skip
        for k in range(1500):
            u = command(block, k, y, 2.0 if k < 500 else 0.5)
            y += 0.01 * (u - y)
            held += k >= 500 and u == 1.0
        stays[way] = held
        assert y == pytest.approx(0.5, abs=0.02) or way == "none"
    assert stays["none"] > 100
    assert stays["conditional"] == stays["back_calculation"] == 0


def test_manual_mode_and_gains_change_without_a_bump():
    block = controller(kp=2.0, ki=2.0, set_point=1.0, period=0.01)
    for k in range(50):
        u = command(block, k, 0.4)
    for change in ({"kp": 3.0}, {"ki": 9.0}, {"bias": 0.7}, {"form": "ideal", "ki": 0.0, "t_i": 0.5}):
        block.change(block.params.model_copy(update=change))
        nxt = command(block, 51, 0.4)
        assert nxt == pytest.approx(u, abs=0.1), change
        u = nxt
    block.change(block.params.model_copy(update={"manual": True, "manual_command": 5.0}))
    assert command(block, 60, 0.4) == 5.0
    block.change(block.params.model_copy(update={"manual": False}))
    assert command(block, 61, 0.4) == pytest.approx(5.0, abs=1e-9)


def test_a_loop_equals_the_linear_loop():
    """PI on 1/(s + 1), sampled: the closed loop's step by scipy, within 1e-9."""
    T, Kp, Ki = 0.05, 1.5, 2.0
    a = math.exp(-T)
    block, y, rows = controller(kp=Kp, ki=Ki, period=T, set_point=1.0), 0.0, []
    for k in range(100):
        rows.append(y)
        y = a * y + (1.0 - a) * command(block, k, y)
    # The loop of C = Kp + Ki T/(z - 1) and P = (1 - a)/(z - a).
    num = np.polymul([1.0 - a], [Kp, Ki * T - Kp])
    den = np.polyadd(np.polymul([1.0, -a], [1.0, -1.0]), num)
    wanted = dstep(dlti(num, den, dt=T), n=100)[1][0][:, 0]
    assert rows == pytest.approx(wanted, abs=1e-9)


@pytest.mark.long
@pytest.mark.skipif(find_spec("control") is None, reason="python-control is not installed: pip install control")
def test_a_loop_equals_that_of_python_control():
    """The ideal form with a filtered derivative on a double pole, both sampled by python-control; within 1e-8."""
    import control

    T, K, t_i, t_d, N = 0.02, 1.2, 0.8, 0.15, 30.0
    plant = control.ss(control.c2d(control.tf([1.0], [0.3, 1.1, 1.0]), T, "zoh"))
    A, B, C = (np.asarray(m) for m in (plant.A, plant.B, plant.C))
    block = controller(form="ideal", kp=K, t_i=t_i, t_d=t_d, n_filter=N, period=T, set_point=1.0)
    x, rows = np.zeros(2), []
    command(block, -1, 1.0)  # the error is zero before the step, so the first sample has a derivative
    for k in range(300):
        y = (C @ x).item()
        rows.append(y)
        x = A @ x + B[:, 0] * command(block, k, y)
    law = control.tf([K], [1.0], T) + control.tf([K * T / t_i], [1.0, -1.0], T)
    law += control.tf([K * t_d * N, -K * t_d * N], [1.0 + N * T, -1.0], T)
    closed = control.feedback(law * control.tf(plant), 1)
    wanted = control.step_response(closed, np.arange(300) * T).outputs
    assert rows == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"u_min": 1.0, "u_max": 0.0}, "less than u_max"),
        ({"t_i": 1.0}, "parallel form has ki and kd"),
        ({"form": "series", "ki": 1.0}, "series form has t_i and t_d"),
        ({"measurement": "y"}, "expected topic/channel/field"),
    ],
)
def test_impossible_controllers_are_refused(values, text):
    with pytest.raises(ValueError, match=text):
        PidControllerParams(**values)
