"""Delay lines and delay equations against closed forms; an independent integrator in the long set."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import PATIENCE
from softrig_core import History, jit
from softrig_core.kit.dde import delayed, integrator, trajectory


def test_state_dependent_and_time_varying_delay_against_closed_form():
    """A sampled ramp through a delay like that of a queue: y(t) = t - tau(t)."""
    line = History(0.01, 2.0, (-2.0,))
    for k in range(-200, 1000):
        t = 0.01 * k
        line = line.put((t,))
        tau = 0.2 + 0.7 * (1.0 + math.sin(t))
        if t > 0.0:
            assert line.at(tau)[0] == pytest.approx(t - tau, abs=1e-12)


@jit
def linear_rhs(t, x, past, p, dx):
    dx[0] = -p[0] * delayed(past, t - p[1], 0)


def test_method_of_steps_polynomials_are_exact():
    """x' = -x(t - 1), x = 1 before: x = sum (-1)^k (t - k + 1)^k / k!, of degree 4 up to t = 4."""
    past, x = trajectory(0.1, 1.0, 1.0), np.array([1.0])
    advance = integrator(linear_rhs)
    for k in range(30):
        advance(past, 0.1 * k, x, 0.1, 1, (1.0, 1.0))
        t = 0.1 * (k + 1)
        exact = sum((-1) ** i * max(t - i + 1, 0.0) ** i / math.factorial(i) for i in range(5) if t >= i - 1)
        assert x[0] == pytest.approx(exact, abs=1e-13), t


@jit
def neves(t, x, past, p, dx):
    dx[0] = x[0] * delayed(past, math.log(t + 1.0) - 1.0, 0) / (t + 1.0)


def test_delay_that_grows_with_time():
    """Neves: x'(s) = x(s) x(ln s) / s, x = 1 up to s = 1: x = s up to e, exp((1 + ln^2 s)/2) up to e^e."""

    def solve(n):
        h = (math.e - 1.0) / n  # e lies on a border of the steps, because the kink of s = 1 recurs there
        past, x = trajectory(h, 8.0, 1.0), np.array([1.0])
        integrator(neves)(past, 0.0, x, h, n, 0.0)
        assert x[0] == pytest.approx(math.e, abs=1e-9)
        remaining = (math.e**2 - math.e) / (4 * n)
        integrator(neves)(past, n * h, x, remaining, 4 * n, 0.0)
        return abs(x[0] - math.exp(2.5))

    coarse, fine = solve(20), solve(40)
    assert fine < 3e-7
    assert coarse / fine == pytest.approx(16.0, rel=0.25)


@jit
def manufactured(t, x, past, p, dx):
    tau = x[0] / 3.0
    exact = (math.sin(t) + 2.0) / 3.0
    dx[0] = math.cos(t) + delayed(past, t - tau, 0) - math.sin(t - exact) - 2.0


def test_delay_that_depends_on_the_state_is_of_order_four():
    """x = sin t + 2 solves x' = cos t + x(t - x/3) - sin(t - tau) - 2 with its own past."""
    errors = []
    for n in (100, 200):
        past, x = trajectory(10.0 / n, 1.1, lambda t: math.sin(t) + 2.0), np.array([2.0])
        integrator(manufactured)(past, 0.0, x, 10.0 / n, n, 0.0)
        errors.append(abs(x[0] - math.sin(10.0) - 2.0))
        assert past.begin.min() < 10.0 - 1.1
    assert errors[1] < 2e-6
    assert math.log2(errors[0] / errors[1]) > 3.7


@jit
def integral(t, x, past, p, dx):
    dx[0] = 0.0
    dx[1] = delayed(past, t - 0.5, 0)


@pytest.mark.parametrize("h", [0.1, 0.05])
def test_jumps_of_the_state_stay_sharp(h):
    """The integral of a delayed step is a ramp, exactly, whether or not rounding puts t - 0.5 before the jump."""
    past, x = trajectory(h, 0.5, (0.0, 0.0)), np.array([0.0, 0.0])
    advance = integrator(integral)
    for k in range(round(2.0 / h)):
        if k == round(0.7 / h):
            x[0] = 3.0
        advance(past, k * h, x, h, 1, 0.0)
        assert x[1] == pytest.approx(3.0 * max((k + 1) * h - 1.2, 0.0), abs=1e-12)


@jit
def falling(t, x, past, p, dx):
    dx[0] = -1.0 if x[0] > 0.0 else 0.0


@jit
def floor(x, p):
    x[0] = max(x[0], 0.0)


def test_limit_holds_in_the_history_too():
    past, x = trajectory(0.1, 1.0, 0.55), np.array([0.55])
    integrator(falling, floor)(past, 0.0, x, 0.1, 10, 0.0)
    assert x[0] == 0.0
    assert min(delayed(past, t, 0) for t in np.linspace(0.0, 1.0, 1001)) >= -0.02
    assert delayed(past, 0.3, 0) == pytest.approx(0.25)


@jit
def draining(t, x, past, p, dx):
    p[0] = min(p[0], x[0])
    dx[0] = -1.0


def test_limit_holds_at_each_stage():
    past, x, least = trajectory(0.1, 1.0, 0.01), np.array([0.01]), np.array([1.0])
    integrator(draining, floor)(past, 0.0, x, 0.1, 1, least)
    assert least[0] == 0.0


@pytest.mark.long
def test_without_numba_the_bits_are_the_same():
    code = (
        "import math, sys, numpy as np, test_history as t\n"
        "from softrig_core.kit.dde import integrator, trajectory\n"
        "past, x, out = trajectory(0.01, 1.1, lambda s: math.sin(s) + 2.0), np.array([2.0]), []\n"
        "step = integrator(t.manufactured)\n"
        "for k in range(300):\n"
        "    step(past, 0.01 * k, x, 0.01, 1, 0.0)\n"
        "    out.append(x[0])\n"
        "sys.stdout.buffer.write(np.array(out).tobytes())\n"
    )
    folder = os.path.dirname(__file__)
    path = os.pathsep.join((folder, os.path.dirname(folder), os.environ.get("PYTHONPATH", "")))
    plain, native = (
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONPATH": path, "SOFTRIG_JIT": jit},
            check=True,
            capture_output=True,
            timeout=PATIENCE,
        ).stdout
        for jit in "01"
    )
    assert len(plain) == 8 * 300
    assert native == plain


@jit
def mackey_glass(t, x, past, p, dx):
    late = delayed(past, t - 17.0, 0)
    dx[0] = 0.2 * late / (1.0 + late * late * late * late) - 0.1 * x[0]


@pytest.mark.long
def test_the_solution_agrees_with_an_independent_integrator(tmp_path, monkeypatch):
    import jitcdde

    monkeypatch.chdir(tmp_path)  # a build there would find this checkout

    past, x = trajectory(0.05, 17.0, 0.5), np.array([0.5])
    integrator(mackey_glass)(past, 0.0, x, 0.05, 4000, 0.0)
    late = jitcdde.y(0, jitcdde.t - 17.0)
    solver = jitcdde.jitcdde([0.2 * late / (1 + late**4) - 0.1 * jitcdde.y(0)], verbose=False)
    solver.constant_past([0.5])
    solver.set_integration_parameters(rtol=1e-10, atol=1e-10)
    solver.step_on_discontinuities(max_step=1.0)
    assert x[0] == pytest.approx(solver.integrate(200.0)[0], abs=2e-6)
