"""Margins of a linear view: where the loop loses its stability, by eigenvalues only."""

import cmath
import math

import control
import numpy as np
import pytest
from softrig_core import RunError, ScenarioError
from softrig_core.analysis.linear_view import LinearView, _between, _power, _reach

T = 0.05


def view_of(a, b, c, d, link="plant/u", state_error=0.0, **about):
    """The view of an opened loop; everything else is as it would be found."""
    a, b, c = (np.array(x, dtype=float) for x in (a, b, c))
    n = len(b)
    states = tuple(f"plant.x[{k}]" for k in range(n))
    whole = a + np.outer(b, c) / (1.0 - d)
    entries = {
        "rig": "drawn",
        "at": 1.5,
        "period": T,
        "states": states,
        "inputs": ("plant/w",),
        "outputs": ("plant/y",),
        "units": {},
        "values": {},
        "A": whole,
        "B": np.eye(n)[:, :1],
        "C": np.eye(n)[:1],
        "D": np.zeros((1, 1)),
        "link": link,
        "a": a,
        "b": b,
        "c": c,
        "d": d,
        "error": 0.0,
        "worst": "",
        "state_error": state_error,
    }
    return LinearView(**entries | about)


def drawn(seed):
    """A loop that is stable when closed, with states that oscillate, lag and, for some, act immediately."""
    rng = np.random.default_rng(seed)
    while True:
        a = np.diag(rng.uniform(0.2, 0.97, 4))
        turn = rng.uniform(0.05, 1.0)
        a[:2, :2] = rng.uniform(0.7, 0.99) * np.array(
            [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        )
        b, c, d = rng.normal(size=4), 0.3 * rng.normal(size=4), float(rng.choice([0.0, 0.1]))
        if largest(a, b, c, d, 1.0) < 0.999:
            return a, b, c, d


def largest(a, b, c, d, factor):
    """Magnitude of the largest pole of the loop closed over a factor."""
    return float(np.abs(np.linalg.eigvals(a + factor * np.outer(b, c) / (1.0 - factor * d))).max())


def loop_at(a, b, c, d, w):
    z = np.exp(1j * w * T)[:, None, None]
    return -np.linalg.solve(z * np.eye(len(b)) - a, b[:, None])[..., 0] @ c - d


def test_a_pole_may_leave_without_a_crossing_frequency():
    """At z = -1, for a controller that is too fast for its period, or at z = 1: no phase crosses -180 degrees there."""
    fast = view_of([[0.5]], [1.0], [-1.0], 0.0)
    assert (fast.margins.gain, fast.margins.gain_down) == (pytest.approx(1.5), 0.0)
    still = view_of([[0.5]], [1.0], [0.25], 0.0)
    assert (still.margins.gain, still.margins.gain_down) == (pytest.approx(2.0), 0.0)
    held = view_of([[1.1]], [1.0], [-0.4], 0.0)
    assert (held.margins.gain, held.margins.gain_down) == (pytest.approx(2.1 / 0.4), pytest.approx(0.1 / 0.4))
    integrates = view_of([[1.0]], [1.0], [-0.5], 0.0)
    assert (integrates.margins.gain, integrates.margins.gain_down) == (pytest.approx(4.0), 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_margins_are_where_the_loop_loses_its_stability(seed):
    loop = drawn(seed)
    view = view_of(*loop)
    m = view.margins
    assert view.stable
    assert sorted(view.loop_poles, key=lambda p: (p.real, p.imag)) == pytest.approx(
        sorted(control.feedback(view.opened).poles(), key=lambda p: (p.real, p.imag)), abs=1e-7
    )
    for end, inside in ((m.gain, 1.0 - 1e-3), (m.gain_down, 1.0 + 1e-3)):
        for factor in np.geomspace(1.0, min(max(end * inside, 1e-2), 1e2), 12):
            assert largest(*loop, factor) < 1.0
        if 1e-2 < end < 1e2:
            assert largest(*loop, end) == pytest.approx(1.0, abs=1e-4)
    w = np.linspace(1e-4, math.pi / T - 1e-4, 1500)
    L = loop_at(*loop, w)
    gain = np.abs(L)
    k = np.flatnonzero((gain[1:] >= 1.0) != (gain[:-1] >= 1.0))
    if not len(k):
        assert (m.phase, m.delay) == (math.inf, math.inf)
        assert math.isnan(m.crossover)
    else:
        phases = (np.angle(L[k]) + math.pi) % (2.0 * math.pi)
        assert m.phase == pytest.approx(phases.min(), rel=0.01, abs=0.01)
        assert m.delay == pytest.approx((phases / w[k]).min(), rel=0.01)
        assert m.crossover == pytest.approx(w[k].max(), rel=0.01)
    assert m.disk == pytest.approx(1.0 / np.abs(1.0 / (1.0 + L) - 0.5).max(), rel=2e-3)
    assert view.at_frequencies(w[::150]) == pytest.approx(L[::150], rel=1e-9)
    assert view.loop.eval(w[100]) == pytest.approx(L[100], rel=1e-2)
    assert view.closed.dt == view.opened.dt == T
    assert (view.closed.input_labels, view.closed.output_labels) == (["plant/w"], ["plant/y"])


def resonant(seed):
    """A lag and light resonances that leave the unit circle one after the other, or none of them at small factors."""
    rng = np.random.default_rng(seed)
    while True:
        turns, radii = np.sort(rng.uniform(0.02, 2.5, 3)), 1.0 - 10.0 ** rng.uniform(-6.0, -3.0, 3)
        a = np.zeros((7, 7))
        for k, (turn, radius) in enumerate(zip(turns, radii, strict=True)):
            c, s = radius * math.cos(turn), radius * math.sin(turn)
            a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[c, -s], [s, c]]
        a[6, 6] = rng.uniform(0.5, 0.99)
        b, c = rng.normal(size=7), rng.normal(size=7) * 10.0 ** rng.uniform(-7.0, -5.0)
        if largest(a, b, c, 0.0, 1.0) < 1.0 - 1e-9:
            return a, b, c, 0.0


@pytest.mark.parametrize("seed", range(6))
def test_a_crossing_of_light_resonances_is_one_of_the_response_itself(seed):
    """The margin is the first factor at which an eigenvalue leaves the unit circle, by scanning and halving."""
    loop = resonant(seed)
    factors = np.geomspace(1.0, 1e6, 1500)
    out = next((k for k, factor in enumerate(factors) if largest(*loop, factor) >= 1.0), None)
    assert out
    low, high = factors[out - 1], factors[out]
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if largest(*loop, middle) >= 1.0 else (middle, high)
    assert view_of(*loop).margins.gain == pytest.approx(high, rel=1e-6)


def test_a_small_loop_has_a_large_margin():
    """At z = -1, at which 1 + L = 0 for the factor 1.5e6: no threshold hides such a small loop."""
    assert view_of([[0.5]], [1.0], [-1e-6], 0.0).margins.gain == pytest.approx(1.5e6)


def test_a_pole_at_one_within_rounding_is_not_a_margin():
    """An integrator with the error of an eigenvalue routine: its gain may fall to any value, not to 1e-15."""
    assert view_of([[1.0 - 2.0**-53, 0.1], [0.0, 0.5]], [0.0, 1.0], [0.1, 0.0], 0.0).margins.gain_down == 0.0


def test_a_margin_without_its_pole_is_not_reported(monkeypatch):
    view = view_of(*resonant(0))
    right = type(view).at_frequencies
    monkeypatch.setattr(type(view), "at_frequencies", lambda self, w: 1.5 * right(self, w))
    with pytest.raises(RunError, match="has no pole on the unit circle, so that is no margin"):
        _ = view.margins


def test_a_loop_without_phase_margin_is_reported():
    """Half of the link's value returns immediately: no frequency is nearer than any other."""
    view = view_of(np.zeros((0, 0)), [], [], -0.5)
    assert view.at_frequencies(np.array([1.0, 2.0])).tolist() == [0.5, 0.5]
    assert view.stable
    assert view.modes == []
    nothing = view_of(np.diag([0.5, 2.0]), [1.0, 0.0], [0.4, 0.0], 0.0)
    assert nothing.opened.state_labels == ["plant.x[0]"]
    assert nothing.stable  # the opened link does not reach the pole at 2, so it does not count
    assert not view_of(nothing.a, nothing.b, nothing.c, 0.0, link="").stable
    with pytest.raises(ScenarioError, match=r"^drawn: no link is opened$"):
        _ = view_of(nothing.a, nothing.b, nothing.c, 0.0, link="").opened


def test_modes_are_listed_slowest_first_with_their_states():
    """Two lags of which one drives the other, an oscillation (once for its pair), and one that decays within a tick."""
    A = np.zeros((5, 5))
    A[:2, :2] = [[0.9, 0.0], [0.2, 0.5]]
    A[2:4, 2:4] = 0.95 * np.array([[math.cos(0.4), -math.sin(0.4)], [math.sin(0.4), math.cos(0.4)]])
    A[4, 4] = 0.9e-4
    modes = view_of(A, np.zeros(5), np.zeros(5), 0.0, link="").modes
    assert [m.pole for m in modes] == pytest.approx([0.95 * cmath.exp(0.4j), 0.9, 0.5])
    assert [m.rate for m in modes] == pytest.approx([(math.log(0.95) + 0.4j) / T, math.log(0.9) / T, math.log(0.5) / T])
    assert [list(m.shares) for m in modes[1:]] == [["plant.x[0]"], ["plant.x[1]"]]
    assert modes[0].shares == pytest.approx({"plant.x[2]": 0.5, "plant.x[3]": 0.5})
    mixed = view_of(np.array([[0.9, 0.3], [-0.1, 0.4]]), np.zeros(2), np.zeros(2), 0.0, link="").modes
    values, right = np.linalg.eig(np.array([[0.9, 0.3], [-0.1, 0.4]]))
    for mode in mixed:
        k = int(np.argmin(np.abs(values - mode.pole)))
        share = np.abs(right[:, k] * np.linalg.inv(right)[k])
        order = sorted(mode.shares.values(), reverse=True)
        assert list(mode.shares.values()) == order
        assert mode.shares == pytest.approx({f"plant.x[{i}]": share[i] / share.sum() for i in range(2)})
    edge = view_of(np.diag([1.0, 1.1e-4]), np.zeros(2), np.zeros(2), 0.0, link="")
    assert ([m.pole for m in edge.modes], edge.stable) == ([1.0, 1.1e-4], False)


def test_frequencies_reach_from_the_slowest_pole_to_that_of_nyquist_and_are_dense_at_a_resonance():
    top = math.pi / T
    slow = view_of([[0.9]], [0.2], [-0.1], 0.0)
    closed = math.log(0.9 - 0.02) / T
    assert slow.omega[0] == pytest.approx(0.01 * min(-math.log(0.9) / T, -closed))
    assert slow.omega[-1] == pytest.approx(top, rel=1e-8)
    assert slow.omega[-1] < top
    assert len(slow.omega) == 1000
    drifts = view_of(np.diag([1.0, math.exp(-2e-9 * math.pi)]), [0.2, 0.1], [-1e-12, 1e-12], 0.0)
    # An integrator has no corner frequency, and that of the other pole is below the lower limit.
    assert drifts.omega[0] == pytest.approx(1e-7 * top)
    # Everything decays within a period.
    assert view_of([[1e-5]], [0.2], [1e-5], 0.0).omega[0] == pytest.approx(1e-2 * top)
    turn, damping = 0.3, 1e-4
    swings = math.exp(-damping) * np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    w = view_of(swings, [0.0, 1.0], [1e-6, 0.0], 0.0).omega
    assert (np.diff(w) > 0.0).all()
    near = w[np.abs(w - turn / T) <= 5.0001 * damping / T]
    assert len(near) >= 41
    assert (near.min(), near.max()) == pytest.approx(((turn - 5e-4) / T, (turn + 5e-4) / T))
    kept = view_of(swings, [0.0, 1.0], [1e-6, 0.0], 0.0, period=T / 2).omega
    assert kept[-1] == pytest.approx(2.0 * top)


def test_the_plot_shows_the_loop():
    view = view_of(*drawn(3))
    figure = view.plot()
    gain, nyquist, phase = (
        next(ax for ax in figure.axes if ax.get_ylabel().startswith(x)) for x in ("|L|", "Im", "ph")
    )
    L = view.at_frequencies(view.omega)
    assert pytest.approx(np.array([view.omega, np.abs(L)])) == gain.lines[0].get_xydata().T
    assert (gain.get_xscale(), gain.get_yscale(), phase.get_xscale()) == ("log", "log", "log")
    assert list(gain.lines[1].get_ydata()) == [1.0, 1.0]
    assert pytest.approx(np.array([view.omega, np.degrees(np.unwrap(np.angle(L)))])) == phase.lines[0].get_xydata().T
    for line, sign in zip(nyquist.lines, (1.0, -1.0), strict=False):
        assert pytest.approx(np.array([L.real, sign * L.imag])) == line.get_xydata().T
    assert nyquist.lines[2].get_xydata().tolist() == [[-1.0, 0.0]]
    assert (nyquist.get_xlim(), nyquist.get_ylim(), nyquist.get_aspect()) == ((-3.0, 1.0), (-2.0, 2.0), 1.0)
    assert figure.get_suptitle() == "drawn, opened at plant/u, t = 1.5 s"
    assert view_of([[1.2]], [1.0], [0.1], 0.0).plot().get_suptitle().endswith("t = 1.5 s, unstable when closed")


def test_the_nodes_reachable_in_a_net_are_found():
    rng = np.random.default_rng(0)
    for _ in range(30):
        A = rng.random((6, 6)) * (rng.random((6, 6)) < 0.2)
        b, c = (rng.random(6) * (rng.random(6) < 0.3) for _ in range(2))
        ways = np.linalg.matrix_power(np.eye(6) + A, 6) > 0.0  # nonzero where a path of at most six steps leads
        hear = (ways[:, b != 0.0]).any(axis=1)
        assert _reach(A, b != 0.0).tolist() == hear.tolist()
        assert _between(A, b, c).tolist() == (hear & (ways[c != 0.0]).any(axis=0)).tolist()
    assert [_power(x) for x in (1.0, 1.4, 1.5, 3.0, 0.3, 1e-3)] == [1.0, 1.0, 2.0, 4.0, 0.25, 2.0**-10]
