"""Fixed steps against analytic solutions, in expressions and in native loops."""

import math

import casadi as ca
import numpy as np
import pytest
from softrig_core.model.compiled import Compiled
from softrig_core.model.jit import jit
from softrig_core.model.ode import rk4, rk4_loop

TURN = ((-0.1, 2.0), (-2.0, -0.1))  # a damped turn: x = e^(-0.1 t) (cos 2t, -sin 2t)


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
def test_order_four_towards_the_analytic_solution(solve):
    errors = [math.dist(solve(n), turned(3.0)) for n in (60, 120)]
    assert errors[1] < 1e-6
    assert math.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)


@jit
def forced(t, x, p, dx):
    dx[0] = 4.0 * t * t * t - p


def test_time_in_the_stages():
    x = np.array([1.0])
    rk4_loop(forced)(0.5, x, 0.25, 6, 1.0)  # exact for t^4
    assert x[0] == pytest.approx(1.0 + 2.0**4 - 0.5**4 - 1.5, abs=1e-14)


@jit
def falling(t, x, p, dx):
    dx[0] = -p
    dx[1] = x[0]


@jit
def floor(x, p):
    x[0] = max(x[0], 0.0)


def test_limit_holds_in_the_stages_too():
    """A ramp to zero and its integral: without the limit in the stages the integral would still fall."""
    x = np.array([0.0, 0.0])
    rk4_loop(falling, floor)(0.0, x, 0.1, 5, 1.0)
    assert x.tolist() == [0.0, 0.0]
