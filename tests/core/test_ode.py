"""Fixed steps against analytic solutions, in expressions and in native loops."""

import math

import casadi as ca
import control
import numpy as np
import pytest
from softrig_core import ByHand, Compiled, RunError, equilibrium, jit, linearise, rk4, rk4_loop
from softrig_drives.dc_motor.model import MotorConstants, state_space
from softrig_drives.dc_motor.plant import DcMotorPlant

TURN = ((-0.1, 2.0), (-2.0, -0.1))  # a damped rotation: x = e^(-0.1 t) (cos 2t, -sin 2t)


def turned(t):
    return math.exp(-0.1 * t) * math.cos(2.0 * t), -math.exp(-0.1 * t) * math.sin(2.0 * t)


def by_expression(n):
    x, h = ca.SX.sym("x", 2), ca.SX.sym("h")
    step = Compiled(ca.Function("turn", [x, h], [rk4(lambda s: ca.mtimes(ca.DM(TURN), s), x, h, substeps=2)]))
    state = (1.0, 0.0)
    for _ in range(n // 2):
        state = step((*state, 3.0 / n))
    return state


@jit
def turn(t, x, p, dx):
    dx[0] = p[0] * x[0] + p[1] * x[1]
    dx[1] = -p[1] * x[0] + p[0] * x[1]


def by_loop(n):
    x = np.array([1.0, 0.0])
    rk4_loop(turn)(0.0, x, 3.0 / n, n, (-0.1, 2.0))
    return x


@pytest.mark.parametrize("solve", [by_expression, by_loop])
def test_the_method_has_order_four_towards_the_analytic_solution(solve):
    errors = [math.dist(solve(n), turned(3.0)) for n in (60, 120)]
    assert errors[1] < 1e-6
    assert math.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)


@jit
def forced(t, x, p, dx):
    dx[0] = 4.0 * t * t * t - p


def test_stages_use_their_own_time():
    x = np.array([1.0])
    rk4_loop(forced)(0.5, x, 0.25, 6, 1.0)  # the method is exact for t^4
    assert x[0] == pytest.approx(1.0 + 2.0**4 - 0.5**4 - 1.5, abs=1e-14)


@jit
def falling(t, x, p, dx):
    dx[0] = -p
    dx[1] = x[0]


@jit
def floor(x, p):
    x[0] = max(x[0], 0.0)


def test_the_limit_holds_in_the_stages_too():
    """A ramp to zero and its integral: without the limit in the stages the integral would still fall."""
    x = np.array([0.0, 0.0])
    rk4_loop(falling, floor)(0.0, x, 0.1, 5, 1.0)
    assert x.tolist() == [0.0, 0.0]


# linearisation and equilibrium -----------------------------------------------------------------------------------


def pendulum(x, u):
    """A driven pendulum with friction: angle, speed; torque; the output is its height."""
    return (x[1], -9.81 * math.sin(x[0]) - 0.3 * x[1] + u[0]), (1.0 - math.cos(x[0]),)


def symbolic_pendulum():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    return ca.Function(
        "pendulum", [x, u], [ca.vertcat(x[1], -9.81 * ca.sin(x[0]) - 0.3 * x[1] + u), 1.0 - ca.cos(x[0])]
    )


@pytest.mark.parametrize("model", [pendulum, symbolic_pendulum()])
def test_linearisation_has_the_analytic_jacobians(model):
    result = linearise(model, (0.4, 1.0), (0.2,))
    np.testing.assert_allclose(result.A, [[0.0, 1.0], [-9.81 * math.cos(0.4), -0.3]], atol=1e-10)
    np.testing.assert_allclose(result.B, [[0.0], [1.0]], atol=1e-10)
    np.testing.assert_allclose(result.C, [[math.sin(0.4), 0.0]], atol=1e-10)
    np.testing.assert_allclose(result.D, [[0.0]], atol=1e-10)
    assert result.y == pytest.approx([1.0 - math.cos(0.4)])


@pytest.mark.parametrize("model", [pendulum, symbolic_pendulum()])
def test_an_equilibrium_is_found_with_the_input_that_holds_a_state(model):
    x, u = equilibrium(model, (0.1, 0.5), (4.0,))
    assert x == pytest.approx((math.asin(4.0 / 9.81), 0.0), abs=1e-9)
    x, u = equilibrium(model, (1.0, 0.5), (0.0,), held=[0], free=[0])
    assert (*x, *u) == pytest.approx((1.0, 0.0, 9.81 * math.sin(1.0)), abs=1e-9)
    x, u = equilibrium(model, (3.0, 0.0), (0.0,))
    assert x[0] == pytest.approx(math.pi)


def test_a_rotating_state_may_move_at_an_operating_point():
    x, u = equilibrium(lambda x, u: ((x[1], u[0] - 0.5 * x[1]), ()), (7.0, 0.0), (1.0,), moving=[0])
    assert (*x, *u) == pytest.approx((7.0, 2.0, 1.0))


def test_a_model_without_rest_is_reported():
    with pytest.raises(RunError, match="the largest derivative left is"):
        equilibrium(pendulum, (0.1, 0.0), (20.0,))
    with pytest.raises(ValueError, match="1 states and 0 inputs are free, expected 2 in all"):
        equilibrium(pendulum, (0.1, 0.0), (20.0,), held=[0])


def test_the_dc_motor_in_python_control():
    """The plant's equations as a python-control system: poles, gain and step response are those of the motor."""
    constants = MotorConstants()
    A, B = (np.array(m) for m in state_space(constants))

    def motor(x, u):
        return A @ x + B @ u, x[1:2]

    x, u = equilibrium(motor, (0.0, 0.0, 0.0), (0.0, 0.0), held=[1], free=[0], moving=[0])
    assert x.tolist() == [0.0, 0.0, 0.0]
    result = linearise(motor, x, u)
    motor_system = result.system(states=["theta", "w", "i"], inputs=["u", "TL"], outputs=["w"])
    assert sorted(control.poles(motor_system).real) == pytest.approx(sorted(np.linalg.eigvals(A).real), abs=1e-6)
    response = control.step_response(motor_system["w", "u"], np.linspace(0.0, 2.0, 2001))
    plant = ByHand(DcMotorPlant(period=0.001))
    speeds = [plant.outputs(0)["state"][1]]
    for k in range(2000):
        plant.advance(k * 1_000_000, command=(1.0,))
        speeds.append(plant.outputs(0)["state"][1])
    np.testing.assert_allclose(response.outputs, speeds, atol=1e-6 * max(speeds))
