"""Each part of the GUPFC against independent code: complex phasors, a linear system for each step, differences,
tables.
"""

from __future__ import annotations

import cmath
import functools
import itertools
import math

import numpy as np
import pytest
from helpers import interpreted
from scipy.integrate import quad
from softrig_core import ByHand, Level, ParameterError
from softrig_core.block.params import build
from softrig_power.gupfc import circuit as steps, figures, measurement, pulses, steady
from softrig_power.gupfc.flow.dual import Dual
from softrig_power.gupfc.flow.injection import converter_power, series_power
from softrig_power.gupfc.flow.power_flow import Diverged, PowerFlow, References, Solution, _flow
from softrig_power.gupfc.flow.roots import _alone, _newton, operating_points
from softrig_power.gupfc.measurement import Weights
from softrig_power.gupfc.network import Network, NetworkParams, admittance
from softrig_power.gupfc.operating_point import DeviceParams, conduction, operating_point
from softrig_power.gupfc.plant import Command, GupfcPlant
from softrig_power.gupfc.power_flow_node import PowerFlowNode, State as Answered
from softrig_power.gupfc.pulse_generator import ORDERS, PulseGenerator, judged
from softrig_power.gupfc.series import SeriesController
from softrig_power.gupfc.shunt import ShuntController
from softrig_power.lines import bergeron

NETWORK = NetworkParams()
PERIOD = 1.0 / 2880.0
CHANCE = np.random.default_rng(12)


def some(*shape):
    """Complex numbers."""
    return CHANCE.normal(size=shape) + 1j * CHANCE.normal(size=shape)


# The network ---------------------------------------------------------------------------------------------


def test_the_admittance_matrix_by_currents_into_each_element():
    half, source, series, shunt = some(2, 2), *some(3)
    half[1, 0] = half[0, 1]
    Y = admittance(half, source, series, shunt)
    u = dict(zip("A1234B", some(6), strict=True))
    into = dict.fromkeys("A1234B", 0j)
    for k, m in (("A", "1"), ("A", "3"), ("2", "B"), ("4", "B")):
        into[k] += half[0, 0] * u[k] + half[0, 1] * u[m]
        into[m] += half[1, 0] * u[k] + half[1, 1] * u[m]
    for k, m in (("1", "2"), ("3", "4")):
        into[k] += series * (u[k] - u[m])
        into[m] += series * (u[m] - u[k])
    into["A"] += source * u["A"]
    into["B"] += source * u["B"]
    into["1"] += shunt * u["1"]
    assert Y @ list(u.values()) == pytest.approx(list(into.values()))
    assert admittance(half, source, series)[1, 1] == pytest.approx(half[1, 1] + series)


def test_the_constants_per_unit():
    p = NetworkParams(
        power_base=50e6, voltage_base=100e3, source_r=2.0, source_l=0.03, r1=0.03, l1=1e-3, c1=1e-8, half_length=90.0
    )
    assert p.impedance_base == 200.0
    assert p.omega == pytest.approx(376.99111843)
    assert (p.half.r, p.half.l, p.half.c, p.half.length) == pytest.approx((1.5e-4, 5e-6, 2e-6, 90.0))
    assert p.source_impedance == pytest.approx((0.01, 1.5e-4))
    assert (p.z_sh, p.z_se) == (complex(p.r_sh, p.x_sh), complex(p.r_se, p.x_se))
    behind_a, behind_b = cmath.rect(1.0, math.radians(9.2)), cmath.rect(1.0, math.radians(-20.8))
    assert p.sources == pytest.approx((behind_a, behind_b))
    y = 1.0 / complex(0.01, p.omega * 1.5e-4)
    network = Network(p)
    assert network.injection == pytest.approx([y * behind_a, 0, 0, 0, 0, y * behind_b])
    assert network.admittance == pytest.approx(admittance(p.half.exact_two_port(p.omega), y, 1.0 / p.z_se))
    text = "both sources are equal, so the line carries no power and no flow can be set"
    with pytest.raises(ParameterError) as refused:
        build(NetworkParams, {"source1_angle": 0.1, "source2_angle": 0.1})
    assert text in str(refused.value)
    assert (
        build(NetworkParams, {"source1_angle": 0.1, "source2_angle": 0.1, "source1_voltage": 0.9}).source1_angle == 0.1
    )


def test_injections_by_the_currents_of_the_converter():
    for v1, v2, v in some(9, 3):
        z = complex(0.02, 0.3)
        norton = v / z
        for bus, side in ((v1, -1), (v2, 1)):
            result = series_power(abs(bus), cmath.phase(bus), v.real, v.imag, z, side)
            s = side * bus * norton.conjugate()
            assert result == pytest.approx((s.real, s.imag))
        i = (v1 + v - v2) / z
        delivered = converter_power(abs(v1), cmath.phase(v1), abs(v2), cmath.phase(v2), v.real, v.imag, z)
        assert delivered == pytest.approx((v * i.conjugate()).real)
        reaches = v2 * ((v1 - v2) / z).conjugate()
        assert _flow(abs(v1), cmath.phase(v1), abs(v2), cmath.phase(v2), z) == pytest.approx(
            (reaches.real, reaches.imag)
        )


def test_numbers_with_their_derivatives_by_differences():
    x = CHANCE.uniform(0.5, 2.0, 6)

    def formulas(u):
        a, b, plain = u[0:3], u[3:6], np.array([2.0, -3.0, 0.5])
        yield from (a + b, a + plain, plain + a, a + 2.0, 2.0 + a, a - b, a - plain, a - 0.5)
        yield from (a * b, a * plain, plain * a, 3.0 * a, a * 3.0, a / b, a / plain, a / 4.0)
        yield from (
            np.cos(a * b),
            np.sin(a * b),
            (a * b).sum(0),
            (a[:, None] * b[None, :]).sum(1),
            a[[2, 0]],
            a[1] * b[2],
        )

    h = 1e-6
    for n, result in enumerate(formulas(Dual(x, np.eye(6)))):
        values = list(formulas(x))[n]
        assert result.value == pytest.approx(values)
        for k in range(6):
            step = h * np.eye(6)[k]
            slope = (list(formulas(x + step))[n] - list(formulas(x - step))[n]) / (2.0 * h)
            assert result.slope[..., k] == pytest.approx(slope, abs=1e-8)


# Power flow ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", [False, True])
def test_the_equations_of_the_power_flow_by_currents_and_their_derivatives_by_differences(loss):
    flow = PowerFlow(NETWORK, converter_loss=loss)
    x = np.concatenate([CHANCE.uniform(0.9, 1.1, 6), CHANCE.uniform(-0.4, 0.4, 6), CHANCE.uniform(-0.2, 0.2, 6)])
    target = [1.0, -0.3, 0.9, -0.4, 1.02, 0.01]
    residual, jacobian = flow._equations(x, target)
    u = x[:6] * np.exp(1j * x[6:12])
    v12, v34, s_sh = complex(*x[12:14]), complex(*x[14:16]), complex(*x[16:18])
    network = Network(NETWORK)
    i12, i34 = (u[1] + v12 - u[2]) / NETWORK.z_se, (u[3] + v34 - u[4]) / NETWORK.z_se
    norton = np.zeros(6, dtype=complex)
    norton[[1, 2, 3, 4]] = -v12 / NETWORK.z_se, v12 / NETWORK.z_se, -v34 / NETWORK.z_se, v34 / NETWORK.z_se
    into = u * (network.admittance @ u - network.injection - norton).conj()  # minus the injection of the converters
    into[1] -= s_sh
    flows = u[2] * i12.conjugate(), u[4] * i34.conjugate()
    lost = NETWORK.r_sh * abs(s_sh / u[1]) ** 2 if loss else 0.0
    surplus = s_sh.real + lost + (v12 * i12.conjugate()).real + (v34 * i34.conjugate()).real
    held = [flows[0].real, flows[0].imag, flows[1].real, flows[1].imag, abs(u[1]), surplus]
    wanted = [*into.real, *into.imag, *(h - t for h, t in zip(held, target, strict=True))]
    assert residual == pytest.approx(np.array(wanted), abs=1e-9)
    h = 1e-6
    for k in range(18):
        step = h * np.eye(18)[k]
        slope = (flow._equations(x + step, target)[0] - flow._equations(x - step, target)[0]) / (2.0 * h)
        assert jacobian[:, k] == pytest.approx(slope, abs=1e-5)


@pytest.mark.parametrize(("loss", "surplus"), [(False, 0.0), (True, 0.0), (True, 0.03)])
def test_a_solution_is_one_in_all_its_numbers(loss, surplus):
    asked = References(p1=1.1, q1=-0.2, p2=0.8, q2=-0.3, v=1.01)
    solution = PowerFlow(NETWORK, converter_loss=loss).solve(asked, surplus=surplus)
    assert isinstance(solution, Solution)
    u = solution.bus
    assert abs(u["1"]) == pytest.approx(1.01)
    assert solution.flows == pytest.approx((1.1 - 0.2j, 0.8 - 0.3j))
    assert solution.i12 == pytest.approx((u["1"] + solution.v12 - u["2"]) / NETWORK.z_se)
    assert solution.i34 == pytest.approx((u["3"] + solution.v34 - u["4"]) / NETWORK.z_se)
    assert solution.s_sh == pytest.approx(u["1"] * solution.i_sh.conjugate())
    assert solution.v_sh == pytest.approx(u["1"] + NETWORK.z_sh * solution.i_sh)
    assert solution.p12 == pytest.approx((solution.v12 * solution.i12.conjugate()).real)
    assert solution.p34 == pytest.approx((solution.v34 * solution.i34.conjugate()).real)
    delivered = (solution.v_sh * solution.i_sh.conjugate()).real if loss else solution.s_sh.real
    assert delivered + solution.p12 + solution.p34 == pytest.approx(surplus, abs=1e-9)
    vector = np.array(list(u.values()))
    into = Network(NETWORK).admittance @ vector - Network(NETWORK).injection
    wanted = [0.0, solution.i_sh - solution.v12 / NETWORK.z_se, solution.v12 / NETWORK.z_se,
              -solution.v34 / NETWORK.z_se, solution.v34 / NETWORK.z_se, 0.0]  # fmt: skip
    assert into == pytest.approx(np.array(wanted), abs=1e-8)
    assert solution.mismatch <= 1e-10
    assert solution.sizes[0] == pytest.approx(max(abs(solution.v12), abs(solution.v34)))
    assert list(solution.sizes) == sorted(solution.sizes)


def test_points_in_closed_form_are_points_of_the_circuit():
    surplus, r_sh = 0.02, NETWORK.r_sh
    points = operating_points(NETWORK, 1.1 - 0.2j, 0.8 - 0.3j, 1.01, surplus, r_sh)
    assert len(points) > 1
    network = Network(NETWORK)
    for point in points:
        u = np.array(point.bus)
        i12, i34 = ((s / x).conjugate() for s, x in ((1.1 - 0.2j, u[2]), (0.8 - 0.3j, u[4])))
        assert point.v12 == pytest.approx(u[2] - u[1] + NETWORK.z_se * i12)
        assert point.v34 == pytest.approx(u[4] - u[3] + NETWORK.z_se * i34)
        i_sh = (point.s_sh / u[1]).conjugate()
        norton = np.array(
            [
                0.0,
                i_sh - point.v12 / NETWORK.z_se,
                point.v12 / NETWORK.z_se,
                -point.v34 / NETWORK.z_se,
                point.v34 / NETWORK.z_se,
                0.0,
            ]
        )
        assert network.admittance @ u - network.injection == pytest.approx(norton, abs=1e-8)
        assert abs(u[1]) == pytest.approx(1.01)
        delivered = (
            point.s_sh.real + r_sh * abs(i_sh) ** 2 + (point.v12 * i12.conjugate() + point.v34 * i34.conjugate()).real
        )
        assert delivered == pytest.approx(surplus, abs=1e-9)
        assert point.size == max(abs(point.v12), abs(point.v34))
        assert point.apart(tuple(u + [0, 0.3j, 0, 0, -0.1, 0])) == pytest.approx(0.3)
    assert [p.size for p in points] == sorted(p.size for p in points)
    assert all(p.apart(q.bus) > 1e-6 for p, q in itertools.combinations(points, 2))


def test_the_voltage_at_the_end_of_a_line_by_its_quadratic():
    for a, k, s in some(20, 3):
        result = _alone(a, k, 0.1 * s)
        half = (a * 0.1 * s).real + 0.5 * abs(k) ** 2
        if half**2 > abs(a * 0.1 * s) ** 2:
            assert len(result) == 2
            assert abs(result[0]) > abs(result[1])
            for v in result:
                assert v * (a * v + k).conjugate() == pytest.approx(0.1 * s)
        else:
            assert len(result) == 1  # both solutions meet in this point
            assert result[0] == pytest.approx((((0.1 * s).conjugate() - a * half / abs(a) ** 2) / k).conjugate())


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_far_side_with_a_share_of_its_coupling(share):
    a, b, k = 0.4 - 2.0j, 0.1 + 0.3j, 0.2 + 1.9j
    v2, v4 = 1.0 + 0.1j, 0.9 - 0.2j
    own, other = a - b * (1.0 - share), -b * share
    s1 = v2 * (own * v2 + other * v4 + k).conjugate()
    s2 = v4 * (own * v4 + other * v2 + k).conjugate()
    result = _newton(a, b, share, k, s1, s2, v2 + 0.05, v4 - 0.04j)
    assert result[:2] == (pytest.approx(v2), pytest.approx(v4))
    assert result[2] <= 1e-11
    for far in ((-0.24 + 0.81j, 0.32 + 0.53j), (0.4 - 0.47j, 2.19 + 2.94j), (-1.9 + 2.3j, 2.0 + 1.2j)):
        again = _newton(a, b, share, k, s1, s2, v2 + far[0], v4 + far[1])  # full steps would diverge from here
        assert again[2] <= 1e-11
        assert again[0] * (own * again[0] + other * again[1] + k).conjugate() == pytest.approx(s1)
        assert again[1] * (own * again[1] + other * again[0] + k).conjugate() == pytest.approx(s2)
    stuck = _newton(a, b, share, k, 50.0 + 0j, 50.0 + 0j, v2, v4)  # no solution exists for this power
    assert stuck[2] > 1e-3


# Pulses ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.4, 2.0, 3.0, math.pi])
def test_the_integral_of_the_pulses_is_that_of_their_samples(monkeypatch, sigma):
    monkeypatch.setattr(pulses, "_area", pulses._area.py_func)
    beta = 0.5 * (math.pi - sigma)

    def level(x):
        x %= math.tau
        return float(beta <= x < beta + sigma) - float(math.pi + beta <= x < math.pi + beta + sigma)

    edges = [beta, beta + sigma, math.pi + beta, math.pi + beta + sigma]
    for x in (0.1, 1.0, 2.9, 4.0, 6.0, -1.0, 8.0):
        wanted = quad(level, 0.0, x % math.tau, points=[e for e in edges if e < x % math.tau] or None)[0]
        assert pulses._area(x, sigma) == pytest.approx(wanted, abs=1e-7)
    n = 200
    for a, b in ((0.3, 0.9), (-2.0, 1.5)):
        samples = [pulses.vector(a + (k + 0.5) * (b - a) / n, sigma) for k in range(n)]
        whole = pulses.integral.py_func(b, sigma) - pulses.integral.py_func(a, sigma)
        assert whole == pytest.approx(sum(samples) * (b - a) / n, abs=(b - a) / n)


def test_the_spectrum_of_the_pulses_and_its_distortion():
    for sigma in (1.0, 2.5, math.radians(172.5)):
        result = pulses.harmonics(sigma, 49)
        assert list(result) == [1, -23, 25, -47, 49]
        for n, amplitude in result.items():
            assert amplitude == pytest.approx(2.0 / math.pi * abs(math.sin(n * sigma / 2.0) / n))
        assert list(pulses.harmonics(sigma, 48)) == [1, -23, 25, -47]
        assert list(pulses.harmonics(sigma, 22)) == [1]
        first = 2.0 / math.pi * math.sin(sigma / 2.0)
        assert pulses.fundamental(sigma) == pytest.approx(first)
        part = math.sqrt(sum(result[n] ** 2 for n in (-23, 25, -47, 49)))
        assert pulses.distortion(sigma, 50) == pytest.approx(100.0 * part / first)
        many = pulses.harmonics(sigma, 60_000)
        whole = math.sqrt(sum(a * a for n, a in many.items() if n != 1))
        assert pulses.distortion(sigma) == pytest.approx(100.0 * whole / first, rel=1e-3)
        spectrum, quality = judged(sigma)
        assert spectrum[::2] == ORDERS
        wanted = [100.0 * abs(math.sin(n * sigma / 2.0) / n / math.sin(sigma / 2.0)) for n in ORDERS]
        assert spectrum[1::2] == pytest.approx(wanted)
        assert quality == (pulses.fundamental(sigma), pulses.distortion(sigma), pulses.distortion(sigma, 50))


def test_the_mean_of_a_converters_voltage_over_a_step(monkeypatch):
    monkeypatch.setattr(steps, "integral", pulses.integral.py_func)
    monkeypatch.setattr(steps, "_unit", steps._unit.py_func)
    monkeypatch.setattr(pulses, "_area", pulses._area.py_func)
    for theta, turn, sigma in ((0.3, 0.02, 2.0), (-2.0, 0.13, 3.0), (4.0, -0.05, 1.0)):
        first = 2.0 / math.pi * math.sin(sigma / 2.0)
        mean = first * (cmath.rect(1.0, theta + turn) - cmath.rect(1.0, theta)) / (1j * turn)
        assert steps.mean_voltage.py_func(theta, turn, sigma, 0) == pytest.approx(mean)
        whole = (steps.integral(theta + turn, sigma) - steps.integral(theta, sigma)) / turn
        assert steps.mean_voltage.py_func(theta, turn, sigma, 1) == pytest.approx(whole)


# Steps of the circuit ----------------------------------------------------------------------------------------


@pytest.fixture
def plain(monkeypatch):
    interpreted(monkeypatch, steps, "mean_voltage", "_unit", "integral", "histories", "store")
    interpreted(monkeypatch, pulses, "_area")


@pytest.mark.parametrize(("pulse", "tripped"), [(0, False), (1, False), (0, True)])
def test_a_step_is_one_system_of_linear_equations(plain, pulse, tripped):
    """Trapezoidal branches, lines by the waves that arrive at their ends, currents that add up to zero at each bus."""
    h = PERIOD / 16.0
    c, lines = steps.circuit(NETWORK, h)
    ring = 0.1 * some(4, 2, bergeron.history_length(lines))
    state = steps.State(ring.copy(), some(6), some(5), np.array([0.98]))
    u, i, v_dc = state.u.copy(), state.i.copy(), 0.98
    turning = steps.Turning(np.array([3.0, 1.2, 0.0]), np.array([0.1, -1.5, 2.0]), np.array([377.0, 380.0, 370.0]))
    n = 3
    rows = steps.Rows(*(np.zeros((n + 1, k), dtype=complex) for k in (6, 5, 3)))
    begin = u.copy(), i.copy()
    power = steps.advance.py_func(c, lines, state, 7, turning, pulse, tripped, rows)
    branches = [  # from node, to node (-1 is a source), R, L
        (-1, 0, *NETWORK.source_impedance),
        (-1, 5, *NETWORK.source_impedance),
        (1, 2, NETWORK.r_se, NETWORK.x_se / NETWORK.omega),
        (3, 4, NETWORK.r_se, NETWORK.x_se / NETWORK.omega),
        (-1, 1, NETWORK.r_sh, NETWORK.x_sh / NETWORK.omega),
    ]
    scale = np.array([1.0 / pulses.fundamental(NETWORK.shunt_sigma), 0.25 * math.pi / 2.0, 0.25 * math.pi / 2.0])
    total = np.zeros(3)
    arriving = np.empty((4, 2, 1), dtype=complex)
    out = arriving[:, :, 0]
    for k in range(n):
        step = 7 + k + 1
        v = np.array(
            [
                s * v_dc * steps.mean_voltage(a + k * w * h, w * h, sigma, pulse)
                if sigma > 0.0 and not tripped
                else 0.0
                for s, a, w, sigma in zip(scale, turning.angle, turning.omega, turning.sigma, strict=True)
            ]
        )
        bergeron.histories.py_func(lines, ring, step, arriving)
        now, before = (cmath.exp(1j * NETWORK.omega * h * m) for m in (step, step - 1))
        e = NETWORK.sources
        forced = [0.5 * e[0] * (now + before), 0.5 * e[1] * (now + before), v[1], v[2], v[0]]
        # Unknowns: six voltages and five currents.
        A, b = np.zeros((11, 11), dtype=complex), np.zeros(11, dtype=complex)
        for m, ((start, end, r, l), drive) in enumerate(zip(branches, forced, strict=True)):  # noqa: E741
            row = 6 + m
            if m == 4 and tripped:
                A[row, row] = 1.0  # this branch is disconnected
                continue
            A[row, row] = l / h + 0.5 * r  # L (i - i0)/h + R (i + i0)/2 = drive + (u_from - u_to + before)/2
            b[row] = (l / h - 0.5 * r) * i[m] + drive
            for bus, sign in ((start, 1.0), (end, -1.0)):
                if bus >= 0:
                    A[row, bus] -= 0.5 * sign
                    b[row] += 0.5 * sign * u[bus]
        for bus in range(6):
            A[bus, bus] += sum(bus in ends for ends in ENDS) / NETWORK.half.z_plus
            b[bus] -= sum(out[line, ends.index(bus)] for line, ends in enumerate(ENDS) if bus in ends)
            for m, (start, end, *_) in enumerate(branches):
                A[bus, 6 + m] += 1.0 if start == bus else (-1.0 if end == bus else 0.0)
        x = np.linalg.solve(A, b)
        mean = 0.5 * (i + x[6:])
        u, i = x[:6], x[6:]
        delivered = np.array([(w * m.conjugate()).real for w, m in zip(v, (mean[4], mean[2], mean[3]), strict=True)])
        total += delivered
        if not tripped:
            v_dc = math.sqrt(v_dc**2 - h / NETWORK.dc_time * delivered.sum())
        ends = np.array([[u[m] for m in pair] for pair in ENDS])
        bergeron.store.py_func(lines, ring, step, ends[:, :, None], arriving, np.empty_like(arriving))
        assert rows.bus[k + 1] == pytest.approx(u)
        assert rows.current[k + 1] == pytest.approx(i)
        assert rows.converter[k + 1] == pytest.approx(v)
    assert (rows.bus[0] == begin[0]).all()
    assert (rows.current[0] == begin[1]).all()
    assert power == pytest.approx(total / n)
    assert state.v_dc[0] == pytest.approx(v_dc)
    assert state.u == pytest.approx(u)
    assert state.i == pytest.approx(i)
    assert state.ring == pytest.approx(ring)


ENDS = ((0, 1), (0, 3), (2, 5), (4, 5))  # buses at the ends of the half lines


def test_samples_are_weighed_by_the_trapezoidal_rule_and_rotated_to_the_end(monkeypatch):
    monkeypatch.setattr(measurement, "weigh", measurement.weigh.py_func)
    omega, h, n = 377.0, 1e-4, 8
    weights = Weights(omega, h, n)
    samples = some(n + 1, 3)
    trapezia = np.array([0.5, *[1.0] * (n - 1), 0.5]) / n
    gain = trapezia @ np.exp(-1j * omega * h * np.arange(n, -1, -1))
    assert weights(samples) == pytest.approx(trapezia @ samples / gain)
    nominal = np.exp(1j * omega * h * np.arange(3 * n + 1))
    assert weights(np.column_stack([nominal[: n + 1]]))[0] == pytest.approx(nominal[n])
    assert weights.record(nominal) == pytest.approx(nominal[[n, 2 * n, 3 * n]])
    assert weights.phasor(nominal) == pytest.approx(nominal[-1])
    other = some(2 * n + 1)
    ends = [weights(other[k : k + n + 1][:, None])[0] for k in (0, n)]
    assert weights.phasor(other) == pytest.approx(0.5 * (ends[0] * cmath.exp(1j * omega * h * n) + ends[1]))


# The start -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("omega", [377.0, -377.0, 25 * 377.0])
def test_the_answer_to_one_frequency_by_its_residuals(omega):
    h = PERIOD / 16.0
    network = steady.Phasors(NETWORK, h, omega)
    e_a, e_b, *v = some(5)
    bus, branch, line = network(e_a, e_b, np.array(v))
    z = cmath.exp(1j * omega * h)
    driven = [
        (0.5 * (z + 1.0) * (e_a - bus[0]), branch[0], *NETWORK.source_impedance),
        (0.5 * (z + 1.0) * (e_b - bus[5]), branch[1], *NETWORK.source_impedance),
        (v[1] + 0.5 * (z + 1.0) * (bus[1] - bus[2]), branch[2], NETWORK.r_se, NETWORK.x_se / NETWORK.omega),
        (v[2] + 0.5 * (z + 1.0) * (bus[3] - bus[4]), branch[3], NETWORK.r_se, NETWORK.x_se / NETWORK.omega),
        (v[0] - 0.5 * (z + 1.0) * bus[1], branch[4], NETWORK.r_sh, NETWORK.x_sh / NETWORK.omega),
    ]
    for across, i, r, l in driven:  # noqa: E741  # L (i_n+1 - i_n)/h + R (i_n+1 + i_n)/2 = mean of the voltage
        assert across == pytest.approx(i * (l * (z - 1.0) / h + 0.5 * r * (z + 1.0)))
    two_port = bergeron.discrete_two_port(NETWORK.half, omega, h)
    for k, ends in enumerate(ENDS):
        assert line[k] == pytest.approx(two_port @ bus[list(ends)])
    out = np.zeros(6, dtype=complex)
    for k, ends in enumerate(ENDS):
        out[list(ends)] += line[k]
    out += [-branch[0], branch[2] - branch[4], -branch[2], branch[3], -branch[3], -branch[1]]
    assert np.abs(out).max() < 1e-9


@pytest.mark.parametrize("waveform", ["average", "pulse"])
def test_the_start_continues_periodically(waveform):
    """The ring of the lines is that of the past, and the next steps are those of a cycle ago, rotated."""
    p = DeviceParams(waveform=waveform)
    point = operating_point(p)
    c, lines = steps.circuit(p.network, p.step)
    start = point.start
    state = steps.State(*(x.copy() for x in start.state))
    assert state.u.tolist() == start.bus[-1].tolist()
    assert state.i.tolist() == start.current[-1].tolist()
    omega = np.full(3, p.network.omega)
    sigma = np.array(
        [
            p.network.shunt_sigma,
            *(conduction(abs(v), point.v_dc, p.network.series_limit) for v in (point.v12, point.v34)),
        ]
    )
    angle = np.array([cmath.phase(v) for v in (point.v_sh, point.v12, point.v34)])
    n = 24
    rows = steps.Rows(*(np.zeros((n + 1, k), dtype=complex) for k in (6, 5, 3)))
    steps.advance(c, lines, state, 0, steps.Turning(sigma, angle, omega), p.pulse, False, rows)
    for k in range(1, n + 1):
        if waveform == "average":
            wanted = start.bus[-1] * cmath.exp(1j * p.network.omega * p.step * k)
        else:
            wanted = start.bus[k]  # the stored past is one cycle
        assert rows.bus[k] == pytest.approx(wanted, abs=2e-6)
    assert np.abs(start.power.sum()) < 2e-6
    assert abs(state.v_dc[0] - point.v_dc) < 5e-3


def test_conduction_is_computed_and_impossible_devices_are_refused():
    for v, v_dc in ((0.1, 1.0), (0.24, 0.97), (0.0, 1.0)):
        assert 0.25 * v_dc * math.sin(0.5 * conduction(v, v_dc, 0.25)) == pytest.approx(v)
    assert conduction(0.3, 1.0, 0.25) == conduction(0.25, 1.0, 0.25) == math.pi
    assert DeviceParams().step == pytest.approx(PERIOD / 16.0)
    assert (DeviceParams().pulse, DeviceParams(waveform="pulse").pulse) == (0, 1)
    for parameters, text in [
        ({"waveform": "pulse", "period": 1e-4}, "waveform = pulse: a cycle has 166.667 control periods, expected 48"),
        ({"initial.p1": 8.0}, "initial: the power flow has no solution for these references, mismatch "),
        ({"initial.p1": 0.0}, "initial: these references need V12 = 0.4976 pu, the limit is 0.2425 pu"),
        ({"initial.p2": 0.0}, "initial: these references need V34 = 0.4838 pu, the limit is 0.246 pu"),
        ({"substeps": 1}, "expected at least 4, which is "),
    ]:
        with pytest.raises(ParameterError) as refused:
            build(DeviceParams, parameters)
        assert text in str(refused.value)


# The laws --------------------------------------------------------------------------------------------------


def measured(law, k, u, i):
    """The input of a controller at tick k for given steady vectors."""
    turn = cmath.exp(1j * NETWORK.omega * PERIOD * k)
    names = (
        ("u1", "i_sh")
        if isinstance(law.block, ShuntController)
        else ("u2", "i12")
        if law.block.p.circuit == 1
        else ("u4", "i34")
    )
    return {n: ((x * turn).real, (x * turn).imag, 0.0) for n, x in zip(names, (u, i), strict=True)}


@pytest.mark.parametrize("circuit", [1, 2])
@pytest.mark.parametrize("kind", ["integral", "printed"])
def test_the_series_controller_in_complex_numbers(kind, circuit):
    """v = j K_i times the integral, or K_p and K_i axis by axis, in the frame of the loop; within its limit."""
    law = ByHand(SeriesController(law=kind, circuit=circuit, kp=0.4, ki=20.0))
    point = law.block._point
    u0, i0, v0 = (point.u2, point.i12, point.v12) if circuit == 1 else (point.u4, point.i34, point.v34)
    start = complex(1.0, -0.3) if circuit == 1 else complex(1.0, -0.4)
    still = law.update(0, reference=None, **measured(law, 0, u0, i0))[f"series_{circuit}"]
    assert still == pytest.approx((abs(v0), cmath.phase(v0), NETWORK.omega), abs=2e-6)
    turn = 1j if kind == "integral" else 1.0
    theta = cmath.phase(u0)
    integral = v0 * cmath.exp(-1j * theta)
    asked = start + 0.2 - 0.1j
    current = i0  # in the rotating frame the current is constant, so a filter does not matter
    error = turn * ((asked / abs(u0)).conjugate() - current * cmath.exp(-1j * theta))
    for k in range(1, 6):
        integral += 20.0 * PERIOD * error
        v = integral + (0.4 * error if kind == "printed" else 0.0)
        if abs(v) > 0.25:
            integral += v * 0.25 / abs(v) - v
            v *= 0.25 / abs(v)
        angle = theta + NETWORK.omega * PERIOD * k + cmath.phase(v)
        result = law.update(0, reference=(asked.real, asked.imag), **measured(law, k, u0, i0))[f"series_{circuit}"]
        assert result[0] == pytest.approx(abs(v), abs=5e-6)
        assert math.remainder(result[1] - angle, math.tau) == pytest.approx(0.0, abs=5e-6)


def test_the_limit_of_a_series_voltage_in_words():
    law = ByHand(SeriesController(law="printed", kp=2.0, ki=0.0))
    point = law.block._point
    law.update(0, reference=(1.5, 0.25), **measured(law, 0, point.u2, point.i12))
    flows = point.u2 * point.i12.conjugate()
    text = f"series voltage at its limit of 0.25 pu while 1.5+0.25j pu is asked for and {flows:.4g} pu flows"
    level, message, _ = law.reports["series_voltage_limited"]
    assert level is Level.WARN
    assert message.split(" and ")[0] == text.split(" and ")[0]
    low = ByHand(SeriesController(law="printed", kp=0.01, ki=0.0))
    before = low.x
    low.update(0, reference=(0.02, 0.0), **measured(low, 0, 0.05 * cmath.rect(1.0, cmath.phase(point.u2)), 0j))
    # The error is divided by the voltage, but at least by 0.1 pu.
    assert low.x.error == pytest.approx((0.02 / 0.1) + 0j)
    assert before.error == 0j


@pytest.mark.parametrize(("kind", "jump"), [("integral", 0.0), ("printed", -0.1)])
def test_changed_gains_cause_no_jump(kind, jump):
    old = SeriesController(law=kind, kp=0.5)
    new = SeriesController(law=kind, kp=0.6)
    x = old.first()._replace(error=1.0 - 2.0j)
    after = new.go_on(x, old.p)
    assert after.integral == pytest.approx(x.integral + jump * (1.0 - 2.0j))
    assert after._replace(integral=x.integral) == x
    none = SeriesController(law=kind, kp=0.6, ki=0.0)
    assert none.go_on(x, old.p) == x  # without an integrator, the state is unchanged


def test_the_shunt_controller_is_a_cascade_of_two_regulators():
    law = ByHand(ShuntController(voltage_kp=3.0, voltage_ki=40.0, current_kp=4.0, current_ki=2.0))
    point = law.block._point
    alpha = math.degrees(cmath.phase(point.v_sh / point.u1))
    i_q = -(point.i_sh * cmath.exp(-1j * cmath.phase(point.u1))).imag
    result = law.update(0, reference=None, **measured(law, 0, point.u1, point.i_sh))["shunt"]
    assert result == pytest.approx((NETWORK.shunt_sigma, cmath.phase(point.v_sh), NETWORK.omega), abs=2e-6)
    outer, inner, e_v = i_q, -alpha, 0.02  # states of both integrators, and the error of the voltage
    for k in range(1, 5):
        asked = 3.0 * e_v + outer
        outer += 40.0 * PERIOD * e_v
        e_i = asked - i_q
        angle = 4.0 * e_i + inner
        inner += 2.0 * PERIOD * e_i
        wanted = cmath.phase(point.u1) + NETWORK.omega * PERIOD * k - math.radians(angle)
        result = law.update(0, reference=(abs(point.u1) + e_v,), **measured(law, k, point.u1, point.i_sh))["shunt"]
        assert math.remainder(result[1] - wanted, math.tau) == pytest.approx(0.0, abs=3e-4)
        assert (result[0], result[2]) == (NETWORK.shunt_sigma, pytest.approx(NETWORK.omega, rel=1e-6))
    assert law.reports == {}


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_limits_of_the_shunt_law_in_words(sign):
    law = ByHand(ShuntController(voltage_kp=100.0, voltage_ki=0.0, current_limit=1.5, angle_limit=5.0))
    point = law.block._point
    v = abs(point.u1)
    law.update(0, reference=(v + sign * 0.2,), **measured(law, 0, point.u1, point.i_sh))
    texts = {key: text for key, (level, text, _) in law.reports.items() if level is Level.WARN}
    i_q = -(point.i_sh * point.u1.conjugate()).imag / v
    assert texts == {
        "reactive_current_limited": f"reactive current at its limit of 1.5 pu while {v + sign * 0.2:g} pu is asked "
        f"of a voltage of {v:.4g} pu",
        "angle_limited": f"angle at its limit of 5 deg while {sign * 1.5:.4g} pu is asked of a reactive current "
        f"of {i_q:.4g} pu",
    }
    angle = law.x.command[1] - cmath.phase(point.u1)
    assert math.remainder(angle, math.tau) == pytest.approx(-sign * math.radians(5.0), abs=1e-6)


# The plant -------------------------------------------------------------------------------------------------


@functools.cache
def steady_plant():
    """One plant for many tests."""
    return GupfcPlant()


def taken(command, age=0, k=1, bad=0):
    """The effect of a command on a plant, and its reports."""
    plant = steady_plant()
    plant.events.clear()
    x = plant.first()
    last = Command(1.0, 0.5, 400.0, bad)
    x = x._replace(commands=tuple(last if n == k else c for n, c in enumerate(x.commands)))
    return plant._accepted(x, k, command, age), dict(plant.reports), float(x.network.v_dc[0])


W = NETWORK.omega


@pytest.mark.parametrize(
    ("k", "command", "good"),
    [
        (0, (math.pi, 0.3, W), True),
        (0, (3.1416, 0.3, W), False),
        (0, (0.0, 0.3, W), True),
        (0, (-1e-9, 0.3, W), False),
        (1, (1.2, 0.3, W), True),
        (1, (1.201, 0.3, W), False),
        (2, (-0.01, 0.3, W), False),
        (2, (0.0, 0.3, W), True),
        (1, (0.1, 0.3, 0.5 * W), True),
        (1, (0.1, 0.3, 0.499 * W), False),
        (1, (0.1, 0.3, 1.5 * W), True),
        (1, (0.1, 0.3, 1.501 * W), False),
    ],
)
def test_possible_commands_are_accepted(k, command, good):
    result, reports, v_dc = taken(command, 0, k)
    name = ("shunt", "series_1", "series_2")[k]
    if good:
        sigma = command[0] if k == 0 else conduction(command[0], v_dc, 0.25)
        assert result == Command(sigma, 0.3, command[2])
        assert reports == {}
        return
    assert result == Command(1.0, pytest.approx(0.5 + 400.0 * PERIOD), 400.0, 1)
    text = f"{name}: command {command} is implausible: the last one holds for a period"
    assert reports == {f"{name}_held": (Level.WARN, text, 1)}
    result, reports, _ = taken(command, 0, k, bad=1)
    text = f"{name}: command {command} is implausible, twice in a row: converter blocked"
    assert reports == {f"{name}_blocked": (Level.ERROR, text, 1)}
    if k == 0:
        plant = steady_plant()
        u1 = complex(*plant.outputs(plant.first(), 0)["u1"][:2])
        assert result == Command(1.0, pytest.approx(cmath.phase(u1)), W, 2)
    else:
        assert result == Command(0.0, pytest.approx(0.5 + 400.0 * PERIOD), 400.0, 2)


def test_late_and_missing_commands_are_handled():
    result, _, v_dc = taken((0.1, 3.0, 380.0), age=2_000_000)
    sigma = conduction(0.1, v_dc, 0.25)
    assert result == Command(sigma, pytest.approx(math.remainder(3.0 + 380.0 * 0.002, math.tau)), 380.0)
    assert taken((9.0, 3.0, 380.0), age=None)[0] == Command(1.0, pytest.approx(0.5 + 400.0 * PERIOD), 400.0)


@pytest.mark.parametrize(("v_dc", "trips"), [(0.5005, False), (0.4, True), (1.2995, False), (1.35, True)])
def test_the_link_trips_permanently_beyond_its_limits(v_dc, trips):
    plant = GupfcPlant()
    x = plant.first()
    network = x.network._replace(v_dc=np.array([v_dc]))
    still = {
        name: (0.0 if k else NETWORK.shunt_sigma, 0.0, W) for k, name in enumerate(("shunt", "series_1", "series_2"))
    }
    off = {**still, "shunt": (0.0, 0.0, W)}  # no power is drawn from the DC link
    after = plant.advance(x._replace(network=network), 0, **off)
    assert after.tripped == trips
    assert after.steps == 16
    if trips:
        now = float(after.network.v_dc[0])
        text = f"DC voltage {now:.4g} pu, outside 0.5 to 1.3 pu: tripped"
        assert plant.reports["trip"] == (Level.ERROR, text, 1)
        assert after.network.i[4] == 0.0
        again = plant.advance(after, 0, **still)
        assert plant.reports["trip"][2] == 1
        assert float(again.network.v_dc[0]) == now
        assert plant.outputs(again, 0)["status"][9:] == (0.0, 0.0)


def test_the_plant_reports_its_steady_start():
    plant = GupfcPlant(trace=True)
    x = plant.first()
    outputs, point = plant.outputs(x, 0), plant._point
    for name in ("u1", "u2", "u4", "i_sh", "i12", "i34"):
        assert complex(*outputs[name][:2]) == pytest.approx(getattr(point, name), abs=1e-9)
        assert outputs[name][2] == 0.0
    assert outputs["dc_link"] == (pytest.approx(point.v_dc * 16070.0),)
    powers = point.start.power
    wanted = (1.0, -0.3, 1.0, -0.4, 1.0, point.v_dc, *powers, abs(point.v12), abs(point.v34))
    assert outputs["status"] == pytest.approx(wanted, abs=2e-6)
    trace = np.reshape(outputs["trace"], (16, 8))
    rows = x.seen.rows
    for column, values in enumerate((rows.converter[:, 0], rows.converter[:, 1], rows.bus[:, 1], rows.current[:, 4])):
        assert trace[:, 2 * column] + 1j * trace[:, 2 * column + 1] == pytest.approx(values[1:])
    assert [c.omega for c in x.commands] == [W] * 3
    assert x.commands[0].angle == pytest.approx(cmath.phase(point.v_sh) - PERIOD * W)


# Power flow and pulses on request -----------------------------------------------------------------------------


def test_the_node_answers_new_requests():
    node = PowerFlowNode()
    asked = []
    one = PowerFlow(NETWORK).solve(References())

    class Solver:
        def solve(self, references):
            asked.append((references.p1, references.q1, references.p2, references.q2, references.v))
            return one if references.p1 < 5.0 else Diverged(7, 0.1234)

    node._solver = Solver()
    x, inputs = node.first(), {"request": None, "series_1": None, "series_2": None, "shunt": None}
    for change, answers in [
        ({}, 3),
        ({}, 0),
        ({"request": (1.0,)}, 3),
        ({"request": (1.0,)}, 0),
        ({"request": (0.0,)}, 0),
        ({"request": (1.0,)}, 3),
        ({"series_1": (1.1, -0.2)}, 3),
        ({"series_2": (0.9, -0.1)}, 3),
        ({"shunt": (1.02,)}, 3),
        ({"shunt": (-1.0,)}, 0),
        ({"shunt": (1.02,), "series_1": (9.0, 0.0)}, 1),
        ({"request": (0.0,)}, 0),
    ]:
        inputs |= change
        x, outputs = node.update(x, 0, **inputs)
        assert len(outputs) == answers
    assert asked == [(1.0, -0.3, 1.0, -0.4, 1.0)] * 3 + [
        (1.1, -0.2, 1.0, -0.4, 1.0),
        (1.1, -0.2, 0.9, -0.1, 1.0),
        (1.1, -0.2, 0.9, -0.1, 1.02),
        (9.0, 0.0, 0.9, -0.1, 1.02),
    ]
    assert node.reports["diverged"][:2] == (Level.ERROR, "diverged: mismatch 0.123 pu after 7 iterations")
    changes = {"p1": 1.1, "q1": -0.2, "p2": 0.9, "q2": -0.1, "v": -1.0}
    assert node.reports["references"][1] == f"references {changes} are impossible: nothing is solved"
    assert x.sizes == ()


def test_the_tables_of_an_answer():
    solution = PowerFlow(NETWORK).solve(References())
    tables = PowerFlowNode()._tables(solution)
    rows = dict(zip("A1234B", np.reshape(tables["bus"], (6, 4)), strict=True))
    n12, n34 = solution.v12 / NETWORK.z_se, solution.v34 / NETWORK.z_se
    injected = {
        "A": 0j,
        "B": 0j,
        "2": solution.bus["2"] * n12.conjugate(),
        "4": solution.bus["4"] * n34.conjugate(),
        "3": -solution.bus["3"] * n34.conjugate(),
        "1": solution.s_sh - solution.bus["1"] * n12.conjugate(),
    }
    for bus, row in rows.items():
        u, s = solution.bus[bus], injected[bus]
        assert row.tolist() == pytest.approx([abs(u), cmath.phase(u), s.real, s.imag])
    v = [x for u in (solution.v12, solution.v34, solution.v_sh) for x in (abs(u), cmath.phase(u))]
    assert tables["device"] == pytest.approx((*v, solution.p12, solution.p34, solution.s_sh.real, solution.s_sh.imag))


def test_the_number_of_points_is_described_as_expected():
    node = PowerFlowNode()
    assert node.health(node.first()) == {}
    text = "; taken: the one with the smallest series voltage, 0.1235 pu"
    assert node.health(Answered(sizes=(0.12345,))) == {"operating points": f"1{text}"}
    more = {"operating points": f"3{text}, the next needs 0.5 pu"}
    assert node.health(Answered(sizes=(0.12345, 0.5, 0.7))) == more


def test_the_gates_of_the_newest_command_are_rotated_on():
    node = ByHand(PulseGenerator(period=1e-4, command_period=3e-4))
    for k, (command, sigma, angle) in enumerate(
        [
            (None, math.radians(172.5), 0.0),
            ((2.0, 0.5, 400.0), 2.0, 0.5),
            (None, 2.0, 0.5),
            ((0.0, 1.0, 400.0), 2.0, 0.5),
            ((math.pi, 0.1, 100.0), math.pi, 0.1),
            ((3.15, 0.1, 100.0), math.pi, 0.1),
        ]
    ):
        omega = (2.0 * math.pi * 60.0, 400.0, 400.0, 400.0, 100.0, 100.0)[k]
        theta = angle + omega * (k % 3) * 1e-4
        outputs = node.update(k * 100_000, command=command)
        wanted = pulses.vector(theta, sigma)
        assert outputs["voltage"] == pytest.approx((wanted.real, wanted.imag, 0.0))
        assert np.reshape(outputs["gates"], (4, 12)).tolist() == pulses.gates(theta, sigma).tolist()
        assert (outputs["spectrum"], outputs["quality"]) == judged(sigma)
    assert node.reports["command"] == (Level.ERROR, "command (3.15, 0.1, 100.0) refused, the last one holds", 2)


# Figures ----------------------------------------------------------------------------------------------------


def signal(*values, period=1.0):
    return np.arange(len(values)) * period, np.array(values, float)


def test_figures_of_artificial_runs():
    run = {
        name: signal(*x)
        for name, x in zip(figures.POWERS, ((1.0, 2.0, -9.0), (0.5, 0.5, 0.5), (0.0, 1.0, 2.0)), strict=True)
    }
    assert figures.power_balance(run) == pytest.approx((1.5 + 3.5 - 6.5) / 3.0)
    assert figures.power_balance(run, statistic="peak") == 6.5
    assert figures.power_balance(run, start=0.0, end=1.0) == 2.5
    waves = {"x": signal(1.0, 2.0, 3.0, 2.0, 2.0, 5.0, 1.0, 3.0)}
    assert figures.drift(waves, "x", frequency=0.5, measure="repeat") == 3.0
    assert figures.drift(waves, "x", frequency=0.5) == 2.0  # means of two samples: 1.5 2.5 2.5 2 3.5 3 2
    with pytest.raises(ValueError, match=r"^x: 8 samples in the window, two cycles are 10$"):
        figures.drift(waves, "x", frequency=0.2)
    assert figures.drift(waves, "x", frequency=0.25) == pytest.approx(1.0)
    ahead = {
        figures.ANGLE: (np.array([0.0, 1.0, 2.0]), np.array([0.5, 0.9, 1.3])),
        figures.U1_ALPHA: (np.arange(3.0), np.cos([0.3, 0.6, 0.9])),
        figures.U1_BETA: (np.arange(3.0), np.sin([0.3, 0.6, 0.9])),
    }
    turned = np.exp(1j * np.array([0.2, 0.3, 0.4]))
    assert figures.shunt_angle(ahead) == pytest.approx(np.angle(turned.mean()))
    assert figures.shunt_angle(ahead, start=1.0) == pytest.approx(np.angle(turned[1:].mean()))
    best = {
        "pulses/quality/thd/position": signal(9.0, 7.0, 3.0, 5.0),
        "shunt/command/sigma/effort": (np.array([0.0, 0.5, 2.0, 3.0]), np.array([1.0, 2.0, 3.0, 4.0])),
    }
    assert figures.best_sigma(best) == 3.0


def test_the_distortion_of_a_trace_and_the_harmonics_of_the_pulses():
    steps_of, periods, cycle = 4, 30, 10.0  # samples in a message, messages, and s
    x = 2.0 * math.pi / cycle * (np.arange(periods * steps_of) + 1.0) / steps_of
    wave = (2.0 * np.exp(1j * x) + 0.3 * np.exp(-5j * x) + 0.4 * np.exp(7j * x)).reshape(periods, steps_of)
    trace = {}
    for k in range(steps_of):
        for part, values in enumerate((wave[:, k].real, wave[:, k].imag)):
            trace[f"gupfc/trace/{k},{4 + part}"] = signal(*values)
            for other in (0, 2, 6):
                trace[f"gupfc/trace/{k},{other + part}"] = signal(*np.zeros(periods))
    assert figures.distortion(trace, part="u1", frequency=0.1) == pytest.approx(25.0)
    assert figures.cycles(trace, "u1", cycle, 2) == pytest.approx(wave[10:].ravel())
    with pytest.raises(ValueError, match=r"^gupfc/trace has 30 messages, 4 cycles are 40$"):
        figures.distortion(trace, part="u1", frequency=0.1, count=4)
    n = 32
    y = 2.0 * math.pi * np.arange(n + 5) / n
    vector = 0.6 * np.exp(1j * y) + 0.06 * np.exp(-5j * y)
    voltage = {"pulses/voltage/x": signal(*vector.real), "pulses/voltage/y": signal(*vector.imag)}
    results = [figures.voltage_harmonic(voltage, order=k, cycle=float(n)) for k in (1, -5, 7)]
    assert results == pytest.approx([60.0, 10.0, 0.0], abs=1e-9)
    levels = {"pulses/voltage/x": signal(*[0.0, 1.0, 1.0 + 1e-12, 2.0, 9.0])}
    assert figures.voltage_levels(levels, cycle=4.0) == 3.0
    with pytest.raises(ValueError, match=r"^pulses/voltage is recorded to 4 s, a cycle lasts 5\.6 s$"):
        figures.voltage_levels(levels, cycle=5.6)
    assert figures.voltage_levels(levels, cycle=5.0) == 4.0
