"""Each part of the rectifier against independent code: complex vectors, loops over legs, numpy's transforms, tables of
limits.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from softrig_core import ByHand, Level, ParameterError
from softrig_core.block.params import build
from softrig_power.rectifier import averaged, circuit, diodes, quality, switched
from softrig_power.rectifier.circuit import Circuit, Period
from softrig_power.rectifier.controller import RectifierGpc
from softrig_power.rectifier.models import d2, linearised
from softrig_power.rectifier.parameters import RectifierConstants
from softrig_power.rectifier.plant import RectifierPlant, RectifierPlantParams
from softrig_power.rectifier.quality import FIGURES, HARMONICS, ROWS

OMEGA, L, R, C = 2.0 * math.pi * 60.0, 2e-3, 0.3, 1e-3
PHI = math.atan2(OMEGA * L, R)
CIRCUIT = Circuit.of(OMEGA, L, R, C, PHI)
# The fields of Period: start, length, amplitude, fifth, load, reach, forward, decoupled, before, command.
SENSORLESS = Period(0.01, 1e-3, 170.0, 20.0, 16.0, 1.0, 1.0, False, 0.0, 30.0)
DECOUPLED = SENSORLESS._replace(decoupled=True, before=35.0, command=41.0)
TURN = np.exp(-2j * math.pi / 3.0 * np.arange(3))
TIMES = (0.01, 0.0103, 0.011)


@pytest.fixture
def plain(monkeypatch):
    """The compiled functions as plain ones, in every module that has them."""
    names = ("wanted", "limited", "phases", "turned", "grid", "sample", "turn_over", "modulation", "carrier", "compare")
    for module in (circuit, averaged, switched, diodes, quality):
        for name in (
            *names,
            "crossing",
            "piece",
            "slopes",
            "slopes_dq",
            "add_signals",
            "settle",
            "carried",
            "read",
            *MORE,
        ):
            if hasattr(result := getattr(module, name, None), "py_func"):
                monkeypatch.setattr(module, name, result.py_func)


MORE = ("phases_of", "grid_of", "amplitude", "squares_of", "measure")


def ode(t, x, p, dx):
    """The switched equations in the form of a solver."""
    dx[:] = switched.slopes(*x, circuit.grid(t, p[0], p[1]), p)


def figures(sums):
    """The figures of a window by name."""
    result = np.zeros(len(FIGURES))
    quality.measure(sums, result)
    return dict(zip(FIGURES, result.tolist(), strict=True))


def rk4(ode):
    """Classical Runge-Kutta steps."""

    def step(t, x, h, n, p):
        for k in range(n):
            at, slopes = t + k * h, []
            for share in (0.0, 0.5, 0.5, 1.0):
                d = np.empty_like(x)
                ode(at + share * h, x + share * h * slopes[-1] if slopes else x, p, d)
                slopes.append(d)
            x += h / 6.0 * (slopes[0] + 2.0 * slopes[1] + 2.0 * slopes[2] + slopes[3])

    return step


# The modulator ------------------------------------------------------------------------------------------


def asked(t, period):
    """The required converter voltage in the frame of the grid, d + jq: the grid's voltage minus the drop."""
    fifth = -period.forward * period.fifth * np.exp(-6j * OMEGA * t)
    if not period.decoupled:
        return period.amplitude - period.command * np.exp(1j * PHI) + fifth
    slope = (period.command - period.before) / period.length
    i = period.before + slope * (t - period.start)
    return period.amplitude - (R + 1j * OMEGA * L) * i - L * slope + fifth


def phases_of(vector, t):
    """Phases a, b, c of a vector d + jq: d lies on sin(omega t)."""
    return (vector * np.exp(1j * OMEGA * t) * TURN).imag


@pytest.mark.parametrize(
    "period", [SENSORLESS, DECOUPLED, SENSORLESS._replace(forward=0.0), DECOUPLED._replace(fifth=0.0)]
)
def test_the_modulator_gets_the_expected_voltage(plain, period):
    for t in TIMES:
        v = asked(t, period)
        assert complex(*circuit.wanted(t, CIRCUIT, period)) == pytest.approx(v)
        for limit in (300.0, 2.0 * abs(v), 900.0):
            kept = v if abs(v) <= 0.5 * limit else v / abs(v) * 0.5 * limit
            assert complex(*circuit.limited(v.real, v.imag, limit, 1.0)) == pytest.approx(kept)
            assert complex(*circuit.limited(v.real, v.imag, limit / 1.1547, 1.1547)) == pytest.approx(kept)
        of = circuit.phases(v.real, v.imag, OMEGA * t)
        assert of == pytest.approx(phases_of(v, t))
        assert complex(*circuit.turned(*of, OMEGA * t)) == pytest.approx(v)
        wave = phases_of(period.amplitude, t) + period.fifth * np.sin(5.0 * (OMEGA * t + np.angle(TURN)))
        assert circuit.grid(t, CIRCUIT, period) == pytest.approx(wave)


@pytest.mark.parametrize("period", [SENSORLESS, DECOUPLED, SENSORLESS._replace(command=-90.0)])
def test_the_averaged_equations_with_complex_vectors(plain, period):
    """L i' = -(R + j omega L) i + v_g - v_r in the frame of the grid, the balance of the link; by phase the same."""
    for t in TIMES:
        for v_dc in (260.0, 420.0):
            i = 30.0 - 8.0j
            v_r = asked(t, period)
            v_r = v_r if abs(v_r) <= 0.5 * v_dc else v_r / abs(v_r) * 0.5 * v_dc
            v_g = period.amplitude - period.fifth * np.exp(-6j * OMEGA * t)
            slope = (-(R + 1j * OMEGA * L) * i + v_g - v_r) / L
            link = (1.5 * (v_r * i.conjugate()).real / v_dc - v_dc / period.load) / C
            result = averaged.slopes_dq(t, i.real, i.imag, v_dc, CIRCUIT, period)
            assert result == pytest.approx((slope.real, slope.imag, link))
            by_phase = np.empty(4)
            averaged.ode_abc.py_func(t, np.array([*phases_of(i, t), v_dc]), (CIRCUIT, period), by_phase)
            wanted = phases_of(slope + 1j * OMEGA * i, t)  # the frame rotates
            assert by_phase.tolist() == pytest.approx([*wanted, link])
            x = np.array([i.real, i.imag, v_dc])
            assert averaged.read(t, x, CIRCUIT) == pytest.approx((*phases_of(i, t), v_dc))
            assert averaged.read(t, by_phase, CIRCUIT) == tuple(by_phase)


def linear(t, stop, x, p):
    """A state that falls evenly, for which the composition of the walk does not matter."""
    x -= (stop - t) * np.array([1000.0, 500.0, 2000.0])


@pytest.mark.parametrize("traced", [False, True])
def test_a_walk_over_a_period_sums_by_trapezoids_and_closes_windows(plain, traced):
    x, sums, complete = np.array([10.0, 5.0, 400.0]), quality.empty(), np.full((ROWS, HARMONICS + 1), np.nan)
    sums[quality.PLAIN, quality.WINDOWS] = 2.0  # the third window ends at 0.0105 s
    trace = np.empty((4 if traced else 0, 5))
    walk = averaged.walk(linear).py_func
    assert walk(x, 4, 0.0035, (CIRCUIT, SENSORLESS), sums, complete, trace) == pytest.approx(398.0)
    edges = [0.01, 0.01025, 0.0105, 0.01075, 0.011]

    def at(t):
        return np.array([10.0, 5.0, 400.0]) - (t - 0.01) * np.array([1000.0, 500.0, 2000.0])

    def seen(t):
        d, q, v = at(t)
        return [*phases_of(d + 1j * q, t), v]

    for result, (a, b, c) in ((complete, edges[:3]), (sums, edges[2:])):
        h = b - a
        link = 0.5 * h * (seen(a)[3] + 2.0 * seen(b)[3] + seen(c)[3])
        assert result[quality.PLAIN, quality.TIME] == pytest.approx(c - a)
        assert result[quality.PLAIN, quality.LINK] == pytest.approx(link)
        assert result[quality.PLAIN, quality.HIGH] == pytest.approx(seen(a)[3])
        assert result[quality.PLAIN, quality.LOW] == pytest.approx(seen(c)[3])
        assert result[quality.PLAIN, quality.WINDOWS] == 3.0
    for row, t in zip(trace, edges[1:], strict=False):
        wave = circuit.grid(t, CIRCUIT, SENSORLESS)[0]
        i_a, i_b, i_c, v = seen(t)
        assert row.tolist() == pytest.approx([i_a, i_b, i_c, wave, v])


# The switches -------------------------------------------------------------------------------------------


def test_the_switched_equations_by_leg(plain):
    x = np.array([20.0, -5.0, -15.0, 380.0])
    for legs in np.ndindex(2, 2, 2):
        dx = np.empty(4)
        ode(0.0104, x, (CIRCUIT, SENSORLESS, *map(float, legs)), dx)
        g = circuit.grid(0.0104, CIRCUIT, SENSORLESS)
        v = [(s - sum(legs) / 3.0) * 380.0 for s in legs]  # voltages to the neutral of a star-connected load
        slopes = [(g[k] - R * x[k] - v[k]) / L for k in range(3)]
        link = (sum(s * i for s, i in zip(legs, x, strict=False)) - 380.0 / 16.0) / C
        assert dx.tolist() == pytest.approx([*slopes, link])


@pytest.mark.parametrize("injection", [False, True])
def test_the_modulation_and_its_carrier(plain, injection):
    for t in TIMES:
        v = asked(t, SENSORLESS)
        of = phases_of(v if abs(v) <= 200.0 else v / abs(v) * 200.0, t)
        shift = 0.5 * (max(of) + min(of)) if injection else 0.0
        assert switched.modulation(t, 400.0, CIRCUIT, SENSORLESS, injection) == pytest.approx(
            [2.0 * (u - shift) / 400.0 for u in of]
        )
    for k in range(40):  # a triangle between -1 and 1 that rises first
        t = k * 0.0123e-3
        half = math.floor(2e4 * t)
        wanted = np.interp(2e4 * t, [half, half + 1], [-1.0, 1.0] if half % 2 == 0 else [1.0, -1.0])
        assert switched.carrier(t, 1e4, float(half)) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(("half", "command"), [(80.0, 30.0), (81.0, 30.0), (82.0, -60.0), (83.0, 80.0)])
def test_edges_are_where_a_fine_comparison_has_them(plain, half, command):
    """Within a half period of the carrier each leg switches where its modulation crosses the carrier, one by one."""
    period, f = SENSORLESS._replace(command=command), 4e3
    t, end = half / (2.0 * f), (half + 1.0) / (2.0 * f)
    x, legs = np.array([20.0, -5.0, -15.0, 400.0]), np.empty(3)
    sums, p = quality.empty(), None
    switched.compare(t, x[3], legs, CIRCUIT, period, f, half, False)
    assert legs.tolist() == [1.0, 1.0, 1.0] if half % 2 == 0 else [0.0, 0.0, 0.0]
    order = []
    while True:
        before = x.copy()
        at, leg = switched.crossing(t, end, x, legs, CIRCUIT, period, f, half, False, sums)
        p = (CIRCUIT, period, *legs)
        other, n = before.copy(), 40
        rk4(ode)(t, other, (at - t) / n, n, p)
        assert x.tolist() == pytest.approx(other.tolist(), abs=1e-4)
        if leg < 0:
            break
        m = switched.modulation(at, x[3], CIRCUIT, period, False)
        assert m[leg] == pytest.approx(switched.carrier(at, f, half), abs=1e-6)
        legs[leg] = 1.0 - legs[leg]
        order.append((at, leg))
        t = at
    assert at == end
    m = switched.modulation(end, x[3], CIRCUIT, period, False)
    assert [at for at, _ in order] == sorted(at for at, _ in order)
    assert len({leg for _, leg in order}) == len(order)
    ended = [1.0 if u > switched.carrier(end, f, half) else 0.0 for u in m]
    assert legs.tolist() == ended
    switched.settle(sums, end, x, (CIRCUIT, period))
    assert sums[quality.PLAIN, quality.TIME] == pytest.approx(end - half / (2.0 * f))


def test_the_sums_of_a_piece_follow_simpsons_rule(plain):
    x, sums = np.array([20.0, -5.0, -15.0, 400.0]), quality.empty()
    p = (CIRCUIT, SENSORLESS, 1.0, 0.0, 0.0)
    begin, g = x.copy(), circuit.grid(0.01, CIRCUIT, SENSORLESS)
    sine_and_cosine = math.sin(0.01 * OMEGA), math.cos(0.01 * OMEGA)
    switched.piece(0.01, 0.01005, x, switched.slopes(*x, g, p), p, sine_and_cosine, g, sums)
    switched.settle(sums, 0.01005, x, p[:2])

    def at(t, k):
        y = begin.copy()
        rk4(ode)(0.01, y, (t - 0.01) / 20, 20, p)
        return y[k] if k < 4 else y[k - 4] ** 2

    assert x.tolist() == pytest.approx([at(0.01005, k) for k in range(4)], rel=1e-7)
    assert sums[quality.PLAIN, quality.LINK] == pytest.approx(quad(at, 0.01, 0.01005, (3,))[0], rel=1e-8)
    for k in range(3):
        whole = quad(at, 0.01, 0.01005, (4 + k,))[0]
        assert sums[quality.PLAIN, quality.CURRENT_SQUARE + k] == pytest.approx(whole, rel=1e-4)
        cos, _ = quad(lambda t, k=k: at(t, k) * math.cos(3 * OMEGA * t), 0.01, 0.01005)
        if k < 2:  # the sum of the third phase follows from the other two
            assert sums[quality.CURRENT_COS + k, 3] == pytest.approx(cos, rel=1e-4)
    wave, _ = quad(lambda t: circuit.grid(t, CIRCUIT, SENSORLESS)[1] * math.sin(OMEGA * t), 0.01, 0.01005)
    assert sums[quality.GRID_SIN + 1, 1] == pytest.approx(wave, rel=1e-4)


@pytest.mark.parametrize("traced", [False, True])
def test_a_switched_period_is_the_equations_between_the_edges(plain, traced):
    """Against small steps with a comparator in each."""
    period, f = SENSORLESS._replace(length=2.5e-4), 1e4
    x, sums, complete = np.array([20.0, -5.0, -15.0, 400.0]), quality.empty(), np.empty((ROWS, HARMONICS + 1))
    trace = np.empty((5 if traced else 0, 5))
    y, n = x.copy(), 2500
    h = period.length / n
    sums[quality.PLAIN, quality.WINDOWS] = 4.0
    v = switched.advance.py_func(x, 5, 0.00202, (CIRCUIT, period), f, False, sums, complete, trace)
    for k in range(n):
        t = 0.01 + (k + 0.5) * h
        half = math.floor(2.0 * f * t)
        m = switched.modulation(t, y[3], CIRCUIT, period, False)
        legs = [1.0 if u > switched.carrier(t, f, float(half)) else 0.0 for u in m]
        d = np.empty(4)
        ode(t, y, (CIRCUIT, period, *legs), d)
        y += h * d
        if traced and (k + 1) % 500 == 0:
            i, wave = (k + 1) // 500 - 1, circuit.grid(0.01 + (k + 1) * h, CIRCUIT, period)[0]
            assert trace[i].tolist() == pytest.approx([*y[:3], wave, y[3]], abs=0.05)
    assert x.tolist() == pytest.approx(y.tolist(), abs=0.05)
    assert v == x[3]
    assert sums[quality.PLAIN, quality.WINDOWS] == 5.0
    assert complete[quality.PLAIN, quality.TIME] == pytest.approx(1e-4)  # up to the border at 0.0101 s
    assert sums[quality.PLAIN, quality.TIME] == pytest.approx(1.5e-4)


# The diodes ---------------------------------------------------------------------------------------------


def bridge(t, h, x, period):
    """A step of the bridge by its rules, leg by leg, for any numbers."""
    g, v, i = np.array(circuit.grid(t, CIRCUIT, period)), x[3], x[:3].copy()
    on, upper = i != 0.0, i > 0.0
    if not on.any() and np.ptp(g) > v:  # the phases with the highest and the lowest voltage start to conduct
        on, upper = (g == g.max()) | (g == g.min()), g == g.max()
    drive = g - R * i - upper * v
    if on.sum() > 1:
        rail = drive[on].mean()
        if on.sum() == 2:  # the third phase starts if it exceeds one rail
            k = int(np.flatnonzero(~on)[0])
            if g[k] - rail > v or g[k] < rail:
                on[k], upper[k] = True, g[k] - rail > v
                drive[k] = g[k] - upper[k] * v
                rail = drive.mean()
        i = np.where(on, i + h * (drive - rail) / L, 0.0)
        i[(upper & (i < 0.0)) | (~upper & (i > 0.0))] = 0.0
        left = i != 0.0
        if left.any():
            remaining = i.sum() / left.sum()
            i[left] -= remaining
            i[(upper & (i < 0.0)) | (~upper & (i > 0.0))] = 0.0
    else:
        i[:] = 0.0
    return np.array([*i, v + h * ((upper * i).sum() - v / period.load) / C])


def test_a_step_of_the_diodes_in_every_situation(plain):
    """Currents of all signs and zero, links below and above the grid: by the rules leg by leg."""
    chance, met = np.random.default_rng(7), set()
    period = SENSORLESS._replace(amplitude=180.0)
    for k in range(400):
        i = chance.uniform(-3.0, 3.0, 3) * (chance.uniform(size=3) < 0.8)
        if k % 3 == 0:
            i[k % 9 // 3] = 0.0
        alive = i != 0.0
        if alive.sum() > 1:  # a single current has no return path and stays as it is
            i = np.where(alive, i - i.sum() / alive.sum(), 0.0)
        x = np.array([*i, chance.uniform(150.0, 330.0)])
        t, h = chance.uniform(0.0, 1.0 / 60.0), 10.0 ** chance.uniform(-6.0, -3.5)
        wanted = bridge(t, h, x, period)
        diodes.conduct.py_func(t, h, x, (CIRCUIT, period))
        assert x.tolist() == pytest.approx(wanted.tolist(), abs=1e-9)
        met.add((int((i != 0.0).sum()), int((x[:3] != 0.0).sum())))
    assert met >= {(0, 0), (0, 2), (1, 0), (2, 2), (2, 3), (3, 3), (3, 2)}


def test_a_diode_carries_nothing_backwards():
    carried = diodes.carried.py_func
    assert [carried(1.0, 1.0, 1.0, d) for d in (0.5, -1.0, -1.5)] == [1.5, 0.0, 0.0]
    assert [carried(-1.0, 1.0, 0.0, d) for d in (-0.5, 1.0, 1.5)] == [-1.5, 0.0, 0.0]
    assert carried(1.0, 0.0, 1.0, 1.0) == 0.0


def test_the_bridge_uses_even_steps_of_at_most_a_microsecond(monkeypatch):
    steps = []
    monkeypatch.setattr(diodes, "conduct", lambda t, h, x, p: steps.append((t, h)))
    for length, count in ((1e-6, 1), (1.0000001e-6, 2), (3.5e-6, 4), (0.4e-6, 1)):
        steps.clear()
        diodes.bridge.py_func(2.0, 2.0 + length, None, None)
        assert len(steps) == count
        assert [h for _, h in steps] == pytest.approx([length / count] * count, rel=1e-6)
        assert [t - 2.0 for t, _ in steps] == pytest.approx(
            [(k + 0.5) * length / count for k in range(count)], rel=1e-6
        )


# Power quality ------------------------------------------------------------------------------------------


def waves(t):
    """Currents, DC voltage and grid voltages with harmonics: amplitude and angle of each order, by phase."""
    x = OMEGA * t
    i = np.array([sum(a[k] * np.cos(n * x + n + k) for n, a in ORDERS.items()) for k in range(3)])
    v = 400.0 + 3.0 * np.cos(6 * x + 0.4) + 2.0 * np.cos(12 * x - 1.0) + 1.0 * np.cos(2 * x)
    g = np.array([180.0 * np.cos(x + 0.3 + k) + 5.0 * np.cos(5 * x) for k in range(3)])
    i[2] = -i[0] - i[1]  # the third current of a star
    return i, v, g


ORDERS = {1: (30.0, 28.0, 33.0), 5: (3.0, 4.0, 2.0), 7: (1.0, 2.0, 3.0), 49: (0.5, 0.4, 0.3), 60: (2.0, 1.0, 2.0)}


def test_all_figures_of_known_harmonics(plain):
    n = 160  # samples of a cycle, so each order below 80 is exact
    sums, other = quality.empty(), quality.empty()
    h = 1.0 / 60.0 / n
    for k in range(n):
        i, v, g = waves(k * h)
        quality.sample(sums, math.sin(OMEGA * k * h), math.cos(OMEGA * k * h), h, (*i, v), tuple(g))
    quality.turn_over(sums, other)
    assert (other[quality.PLAIN, quality.WINDOWS], sums[quality.PLAIN, quality.WINDOWS]) == (1.0, 1.0)
    assert np.delete(sums[quality.PLAIN], [quality.WINDOWS, quality.LOW, quality.HIGH]).any() == False  # noqa: E712
    assert not sums[: quality.PLAIN].any()
    assert (sums[quality.PLAIN, quality.LOW], sums[quality.PLAIN, quality.HIGH]) == (np.inf, -np.inf)
    i, v, g = waves(h * np.arange(n))
    lines = 2.0 / n * np.fft.rfft(i, axis=1)
    square = {order: float((np.abs(lines[:, order]) ** 2).sum()) for order in ORDERS}
    first = square[1]
    rms = [math.sqrt(np.mean(i[k] ** 2) * np.mean(g[k] ** 2)) for k in range(3)]
    voltage = 2.0 / n * np.fft.rfft(g, axis=1)[:, 1]
    shares = float((0.5 * lines[:, 1] * voltage.conj()).real.sum())
    wanted = {
        "windows": 1.0,
        "thd": 100.0 * math.sqrt(sum(s for order, s in square.items() if order != 1) / first),
        "thd50": 100.0 * math.sqrt((square[5] + square[7] + square[49]) / first),
        "pf": np.mean((i * g).sum(axis=0)) / sum(rms),
        "dpf": shares / float((0.5 * np.abs(lines[:, 1]) * 180.0).sum()),
        "current": math.sqrt(first / 3.0),
        "power": np.mean((i * g).sum(axis=0)),
        "voltage": 400.0,
        "ripple": np.ptp(v),
        "voltage_6": 3.0,
        "voltage_12": 2.0,
        "current_5": math.sqrt(square[5] / 3.0),
        "current_7": math.sqrt(square[7] / 3.0),
    }
    result = figures(other)
    assert list(result) == list(FIGURES)
    assert result == pytest.approx(wanted)
    assert sorted({*np.flatnonzero(other[quality.LINK_COS])}) == [6, 12]  # only orders that figures use are computed


def test_figures_without_a_window_or_a_current():
    still = quality.empty()
    for k in range(64):
        angle = OMEGA * k / 3840.0
        at = math.sin(angle), math.cos(angle), 1.0 / 3840.0
        quality.sample.py_func(still, *at, (0.0, 0.0, 0.0, 390.0), (1.0, 2.0, 3.0))
    still[quality.PLAIN, quality.WINDOWS] = 7.0
    result = figures(still)
    assert result == pytest.approx(dict.fromkeys(FIGURES, 0.0) | {"windows": 7.0, "voltage": 390.0}, abs=1e-9)
    kept = quality.opened(still.tobytes())
    assert kept.tolist() == still.tolist()
    kept[0, 0] = 5.0  # the copy must be writable, since sums are added to it


# Models and constants -------------------------------------------------------------------------------------


def test_the_constants_of_the_operating_point():
    p = RectifierConstants(V_g=150.0, R=0.4, L=2.5e-3, R_L=20.0, v_ref=350.0)
    i = p.current
    assert 1.5 * (150.0 * i - 0.4 * i * i) == pytest.approx(350.0**2 / 20.0)
    assert i < 150.0 / 0.8  # the smaller root is used
    z = complex(0.4, p.omega * 2.5e-3)
    assert (p.impedance, p.phi, p.drop) == pytest.approx((abs(z), np.angle(z), abs(z) * i))
    most = RectifierConstants(R=10.0, R_L=400.0**2 / (1.5 * 180.0**2 / 40.0))
    assert most.current == pytest.approx(9.0, rel=1e-6)  # beyond this current the loss in R exceeds the power
    with pytest.raises(ValueError, match=r"^R_L = 100 ohm takes 1600 W, more than V_g\^2/\(4 R\) allows$"):
        _ = RectifierConstants(R=10.0, R_L=100.0).current


def test_the_linear_model_by_differences_of_the_equations(plain):
    p = RectifierConstants(R=0.4)
    own = Circuit.of(p.omega, p.L, p.R, p.C, p.phi)

    def slope(x, command):
        period = Period(0.0, 1e-3, p.V_g, 0.0, p.R_L, 9.0, 0.0, False, 0.0, command)
        return np.array(averaged.slopes_dq(0.0, *x, own, period))

    at = np.array([p.current, 0.0, p.v_ref])
    assert np.abs(slope(at, p.drop)).max() < 1e-6
    a, b = linearised(p)
    h = 1e-4
    for k in range(3):
        step = h * np.eye(3)[k]
        column = (slope(at + step, p.drop) - slope(at - step, p.drop)) / (2.0 * h)
        assert [row[k] for row in a] == pytest.approx(column.tolist(), abs=1e-3)
    column = (slope(at, p.drop + h) - slope(at, p.drop - h)) / (2.0 * h)
    assert [row[0] for row in b] == pytest.approx(column.tolist(), abs=1e-3)


def test_the_decoupled_model_by_the_matrix_exponential():
    """v' = -2/(C R_L) v + 1.5/(C v) [(V_g - 2 R I) i - L I i'], i a ramp in each period: a linear system of three."""
    p, h = RectifierConstants(R=0.4), 1.3e-3
    k, i = 1.5 / (p.C * p.v_ref), p.current
    system = np.zeros((3, 3))  # voltage, current and its slope
    system[0] = [-2.0 / (p.C * p.R_L), k * (p.V_g - 2.0 * p.R * i), -k * p.L * i]
    system[1, 2] = 1.0
    whole = expm(system * h)
    after, slope, held = whole[0, 0], whole[0, 2] / h, whole[0, 1]
    model = d2(p, h)
    assert model.a == pytest.approx((1.0, -after))
    assert model.b == pytest.approx((slope, held - slope))


def test_the_first_command_of_the_controller():
    p = RectifierConstants()
    for model, values, wanted in [
        ("n3", {}, p.drop),
        ("n3", {"i_start": 10.0}, 10.0 * p.impedance),
        ("seed19", {}, p.drop),
        ("d2", {}, p.current),
        ("d2", {"i_start": 10.0}, 10.0),
    ]:
        assert RectifierGpc(model=model, **values).p.u_first == pytest.approx(wanted)


# The plant ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("period", "substep", "steps"),
    [(1e-3, 1e-4, 10), (1e-3, 0.99e-4, 11), (1e-3, 1.01e-4, 10), (1e-3, 1e-3, 1), (5e-4, 1e-3, 1), (3e-4, 1e-4, 3)],
)
def test_a_period_has_the_expected_number_of_steps(period, substep, steps):
    assert build(RectifierPlantParams, {"period": period, "substep": substep}).steps == steps


def test_impossible_plants_are_refused():
    assert build(RectifierPlantParams, {"carrier_hz": 600.0}).carrier_hz == 600.0
    with pytest.raises(ParameterError, match=r"carrier_hz = 599 Hz: expected at least ten times f = 60 Hz"):
        build(RectifierPlantParams, {"carrier_hz": 599.0})
    with pytest.raises(ParameterError, match="more than V_g"):
        build(RectifierPlantParams, {"R": 10.0})
    assert build(RectifierPlantParams, {"R": 10.0, "i_start": 3.0}).i_first == 3.0


@pytest.mark.parametrize("structure", ["sensorless", "decoupled"])
@pytest.mark.parametrize("model", ["averaged_dq", "averaged_abc", "switched"])
def test_the_plant_begins_as_expected(model, structure):
    plant = RectifierPlant(model=model, structure=structure, waveform=True, i_start=12.0, v_start=390.0, R_L=30.0,
                           period=1e-3, substep=5e-4)  # fmt: skip
    x = plant.first()
    of = phases_of(12.0, 0.0)
    assert x.v == 390.0
    assert x[:3] == pytest.approx((12.0, 0.0, 390.0) if model == "averaged_dq" else of)
    assert x.applied == ((12.0,) if structure == "decoupled" else ())
    assert (x.events.load, x.events.amplitude, x.events.fifth, x.end, x.collapsed) == (30.0, 180.0, 0.0, 0, False)
    outputs = plant.outputs(x, 0)
    assert outputs["dc_link"] == (390.0, 13.0)
    assert outputs["grid_current"] == pytest.approx(of)
    assert outputs["grid_voltage"] == pytest.approx(phases_of(180.0, 0.0))
    assert outputs["power_quality"] == (0.0,) * 13
    assert outputs["waveform"] == pytest.approx((*of, 0.0, 390.0) * 2)
    assert "waveform" not in RectifierPlant().outputs(RectifierPlant().first(), 0)


def test_reports_of_the_plant_are_as_expected():
    plant = ByHand(RectifierPlant(period=1e-3))
    plant.advance(0, command=(30.0,), events=(16.0, 0.0, 5.0))
    text = "load 16 ohm, grid 0 V: expected both positive; the last good ones hold"
    assert plant.reports["bad_event"] == (Level.ERROR, text, 1)
    assert plant.x.events == RectifierPlant().first().events
    plant.advance(1_000_000, command=(30.0,), events=(0.0, 170.0, 5.0))
    assert plant.reports["bad_event"][1] == "load 0 ohm, grid 170 V: expected both positive; the last good ones hold"
    assert plant.x.end == 2_000_000
    assert "off" not in plant.reports
    plant.advance(2_000_000, command=(0.0,), events=(8.0, 170.0, 5.0))
    assert plant.reports["off"][:2] == (Level.WARN, "switches off: the diodes carry the current")
    assert (plant.x.events.load, plant.x.events.amplitude, plant.x.events.fifth) == (8.0, 170.0, 5.0)


@pytest.mark.parametrize(("age", "late"), [(None, False), (5_000_000, False), (5_000_001, True)])
def test_a_command_older_than_five_periods_is_reported(age, late):
    plant = RectifierPlant(period=1e-3)
    plant.age = lambda name: age
    plant.advance(plant.first(), 0, command=(30.0,), events=None)
    assert plant.reports.get("late", (None,))[0] == (Level.WARN if late else None)
    if late:
        assert plant.reports["late"][1] == "command older than 5 periods is held"


@pytest.mark.parametrize(("jump", "kept"), [(0, True), (500_000, True), (500_001, False), (-500_001, False)])
def test_the_sums_of_a_window_start_again_after_a_jump_of_time(jump, kept):
    plant = RectifierPlant(period=1e-3)
    x = plant.advance(plant.first(), 0, command=(30.0,), events=None)
    again = plant.advance(x, 1_000_000 + jump, command=(30.0,), events=None)
    sums = quality.opened(again.record.sums.kept)
    assert sums[quality.PLAIN, quality.TIME] == pytest.approx(2e-3 if kept else 1e-3)
    # After ten windows of six cycles a new one has just begun.
    later = plant.advance(x, 10**9, command=(30.0,), events=None)
    assert quality.opened(later.record.sums.kept)[quality.PLAIN, quality.WINDOWS] == 10.0
    assert later.record.figures == (0.0,) * 13


def test_figures_belong_to_complete_windows_only():
    plant = RectifierPlant(period=1e-2, substep=1e-3)
    x = plant.first()
    for k in range(11):  # the first six cycles end at 0.1 s
        assert x.record.figures == (0.0,) * 13
        x = plant.advance(x, k * 10_000_000, command=(plant.p.drop,), events=None)
    assert x.record.figures[0] == 1.0
    result = x.record.figures
    x = plant.advance(x, 50_000_000, command=(plant.p.drop - 1.0,), events=None)  # returns to the middle of a window
    for k in range(6, 12):
        x = plant.advance(x, k * 10_000_000, command=(plant.p.drop - 1.0,), events=None)
    assert x.record.figures == result  # half a window has no figures
    for k in range(12, 21):
        x = plant.advance(x, k * 10_000_000, command=(plant.p.drop - 1.0,), events=None)
    assert x.record.figures[0] == 2.0


def test_with_the_switches_off_both_frames_see_the_same_currents():
    states = {}
    for model in ("averaged_dq", "averaged_abc"):
        plant = ByHand(RectifierPlant(model=model, v_start=250.0, i_start=5.0))
        for k in range(3):
            plant.advance(k * 830_000, command=(0.0,), events=None)
        states[model] = plant.outputs(3 * 830_000)["grid_current"] + plant.outputs(3 * 830_000)["dc_link"]
    assert states["averaged_dq"] == pytest.approx(states["averaged_abc"], abs=1e-9)
