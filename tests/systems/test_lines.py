"""Line sections: constants, two-ports, the compiled steps against the sinusoidal steady state, modal transforms."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from scipy.linalg import expm
from softrig_power.lines.bergeron import (
    branch,
    branch_impedance,
    delay_factor,
    discrete_two_port,
    histories,
    history_length,
    interpolation,
    lines,
    steady_history,
    store,
    together,
)
from softrig_power.lines.modal import (
    AERIAL,
    CLARKE,
    KARRENBAUER,
    KARRENBAUER_INVERSE,
)
from softrig_power.lines.section import Section

POSITIVE = Section(0.0275, 1.00268e-3, 0.013e-6, 120.0)  # Faramarzi and Ghaffarzadeh, table I
ZERO = Section(0.275, 3.26798e-3, 0.0085e-6, 120.0)
GUPFC_HALF = Section(0.02546, 0.9337e-3, 12.74e-9, 200.0)
OMEGA = 2.0 * math.pi * 50.0


def test_wave_constants():
    assert POSITIVE.velocity == pytest.approx(276_979.2, rel=1e-6)
    assert POSITIVE.z == pytest.approx(277.7215, rel=1e-6)
    assert POSITIVE.tau == pytest.approx(433.246e-6, abs=0.5e-9)
    assert ZERO.velocity == pytest.approx(189_736.5, rel=1e-6)
    assert ZERO.z == pytest.approx(620.055, rel=1e-6)
    assert GUPFC_HALF.tau == pytest.approx(689.79e-6, rel=1e-5)
    assert GUPFC_HALF.z == pytest.approx(270.72, rel=1e-5)
    assert GUPFC_HALF.resistance == pytest.approx(5.092)


@pytest.mark.parametrize(("name", "value"), [("l", 0.0), ("c", -1e-9), ("r", -0.01), ("length", math.nan)])
def test_impossible_constants_are_named(name, value):
    with pytest.raises(ValueError, match=f"^{name} = "):
        Section(**{"r": 0.03, "l": 1e-3, "c": 1e-8, "length": 100.0} | {name: value})


def test_bergeron_two_port_tends_to_the_telegraph_equations():
    """Lumping R three times has an error of the square of the losses: far less at a quarter of the length."""
    errors = []
    for length in (400.0, 200.0, 100.0):
        section = POSITIVE.part(length)
        exact = section.exact_two_port(OMEGA)
        errors.append(np.abs(section.bergeron_two_port(OMEGA) - exact).max() / np.abs(exact).max())
    assert errors[0] < 0.01
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 0.3 * errors[1]


def test_lossless_two_port_is_exact():
    section = Section(0.0, 1e-3, 1e-8, 150.0)
    np.testing.assert_allclose(section.bergeron_two_port(OMEGA), section.exact_two_port(OMEGA), rtol=1e-11, atol=1e-15)


def test_interpolation_is_exact_for_cubics():
    newest, weights = interpolation(17.37)
    ages = newest + np.arange(4)
    for power in range(4):
        assert weights @ ages**power == pytest.approx(17.37**power, rel=1e-12)
    newest, weights = interpolation(17.0)
    assert (newest, weights.tolist()) == (16, [0.0, 1.0, 0.0, 0.0])


def test_delay_factor_of_a_fine_step():
    assert delay_factor(POSITIVE, OMEGA, 1e-6) == pytest.approx(cmath.exp(-1j * OMEGA * POSITIVE.tau), abs=1e-12)
    coarse = delay_factor(GUPFC_HALF, 2.0 * math.pi * 60.0, 1.0 / 46080.0)
    assert coarse == pytest.approx(cmath.exp(-2j * math.pi * 60.0 * GUPFC_HALF.tau), abs=1e-7)


def test_section_too_short_for_the_step():
    with pytest.raises(ValueError, match=r"1 km is passed in 3\.61 steps.*at least 4, which is 1\.108 km"):
        lines([POSITIVE.part(1.0)], 1e-6)


@pytest.mark.parametrize("most", [1, 1000])
@pytest.mark.parametrize("kind", ["phase", "space_vector"])
def test_steps_reproduce_the_sinusoidal_steady_state(kind, most):
    """Both ends forced with sinusoids: the stepped currents are those of the two-port, from the first step on."""
    step, omega = 1.0 / 46080.0, 2.0 * math.pi * 60.0
    sections = [GUPFC_HALF, GUPFC_HALF.part(150.0)]
    prepared = lines(sections, step)
    voltages = np.array([[1.0, 0.9 * cmath.exp(-0.2j)], [0.8j, 1.1 * cmath.exp(0.5j)]])
    currents = np.array([discrete_two_port(s, omega, step) @ u for s, u in zip(sections, voltages, strict=True)])
    ring = steady_history(prepared, voltages, currents, omega, step)
    accept = np.real if kind == "phase" else np.asarray
    ring = np.ascontiguousarray(accept(ring))
    assert ring.shape == (2, 2, history_length(prepared))
    k, end, counts = 1, 3 * ring.shape[2], set()
    while k < end:
        count = min(together(prepared, ring, k), end - k, most)
        turn = np.exp(1j * omega * step * np.arange(k, k + count))
        history, result = np.empty((2, 2, count), ring.dtype), np.empty((2, 2, count), ring.dtype)
        histories(prepared, ring, k, history)
        store(prepared, ring, k, np.ascontiguousarray(accept(voltages[:, :, None] * turn)), history, result)
        np.testing.assert_allclose(result, accept(currents[:, :, None] * turn), atol=1e-13)
        counts.add(count)
        k += count
    # A block ends where the first wave of a section arrives, and where the ring buffer wraps.
    assert counts == {1} if most == 1 else len(counts) > 1 and max(counts) == int(prepared.newest.min())


def test_step_response_of_a_matched_lossless_line():
    """A wave sent into a line that ends in its surge impedance arrives after tau, unchanged, and is not reflected."""
    section, step = Section(0.0, 1e-3, 1e-8, 100.0), 1e-6
    prepared = lines([section], step)
    ring = np.zeros((1, 2, history_length(prepared)))
    history, current, u = (np.empty((1, 2, 1)) for _ in range(3))
    sent, arrived = [], []
    for k in range(1, 1000):
        histories(prepared, ring, k, history)
        u[0, 0] = 1.0
        u[0, 1] = -history[0, 1] / (2.0 * prepared.conductance[0])  # u = -Z i
        store(prepared, ring, k, u, history, current)
        sent.append(current[0, 0, 0])
        arrived.append(u[0, 1, 0])
    np.testing.assert_allclose(sent, 1.0 / section.z, rtol=1e-12)
    arrival = math.floor(section.tau / step)
    assert np.abs(arrived[: arrival - 3]).max() == 0.0
    np.testing.assert_allclose(arrived[arrival + 3 :], 1.0, rtol=1e-12)


def test_branch_in_the_steady_state():
    step, resistance, inductance = 1e-5, 1.31, 15.0 / OMEGA
    b = branch(resistance, inductance, step)
    z = branch_impedance(resistance, inductance, OMEGA, step)
    assert z == pytest.approx(complex(resistance, 15.0), rel=1e-5)
    i = 1.0 / z
    previous_u, previous_i = 1.0, i.real
    for k in range(1, 100):
        turn = cmath.exp(1j * OMEGA * step * k)
        now = b.conductance * (turn.real + previous_u + b.keep * previous_i)
        assert now == pytest.approx((i * turn).real, abs=1e-14)
        previous_u, previous_i = turn.real, now


def test_modal_transforms():
    np.testing.assert_allclose(CLARKE @ CLARKE.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(KARRENBAUER @ KARRENBAUER_INVERSE, np.eye(3), atol=1e-15)
    # Of a transposed element: self impedance (z0 + 2 z1)/3, mutual impedance (z0 - z1)/3.
    zero, positive = 10.0 + 2.0j, 3.0 + 1.0j
    transposed = np.full((3, 3), (zero - positive) / 3.0) + positive * np.eye(3)
    for modal in (
        CLARKE @ transposed @ CLARKE.T,
        KARRENBAUER @ transposed @ KARRENBAUER_INVERSE,
    ):
        np.testing.assert_allclose(modal, np.diag([10.0 + 2.0j, 3.0 + 1.0j, 3.0 + 1.0j]), atol=1e-14)
    np.testing.assert_allclose(AERIAL @ np.ones(3), 0.0)


# independent re-implementations
# --------------------------------------------------------------------------------------


PLAIN = Section(0.04, 1.1e-3, 1.2e-8, 90.0)


def test_the_constants_of_a_section_by_their_formulas():
    assert PLAIN.velocity == pytest.approx(1.0 / math.sqrt(1.1e-3 * 1.2e-8))
    assert PLAIN.tau == pytest.approx(90.0 * math.sqrt(1.1e-3 * 1.2e-8))
    assert PLAIN.z == pytest.approx(math.sqrt(1.1e-3 / 1.2e-8))
    assert PLAIN.resistance == pytest.approx(3.6)
    assert (PLAIN.z_plus, PLAIN.z_minus) == pytest.approx((PLAIN.z + 0.9, PLAIN.z - 0.9))
    assert PLAIN.part(30.0) == Section(0.04, 1.1e-3, 1.2e-8, 30.0)
    series, shunt = complex(0.04, OMEGA * 1.1e-3), complex(0.0, OMEGA * 1.2e-8)
    assert PLAIN.propagation(OMEGA) ** 2 == pytest.approx(series * shunt)
    assert PLAIN.propagation(OMEGA).real > 0.0
    assert PLAIN.characteristic_impedance(OMEGA) ** 2 == pytest.approx(series / shunt)
    assert PLAIN.characteristic_impedance(OMEGA).real > 0.0
    for name, value, text in [
        ("r", -1.0, "r = -1.0: expected a non-negative number"),
        ("l", 0.0, "l = 0.0: expected a positive number"),
        ("c", math.inf, "c = inf: expected a positive number"),
        ("length", -2.0, "length = -2.0: expected a positive number"),
    ]:
        with pytest.raises(ValueError) as refused:  # noqa: PT011
            Section(**{"r": 0.0, "l": 1.0, "c": 1.0, "length": 1.0} | {name: value})
        assert str(refused.value) == text


@pytest.mark.parametrize("omega", [OMEGA, 7.0 * OMEGA])
def test_the_two_port_by_the_matrix_exponential(omega):
    """u' = -z i, i' = -y u along the line."""
    series, shunt = complex(0.04, omega * 1.1e-3), complex(0.0, omega * 1.2e-8)
    chain = expm(-90.0 * np.array([[0.0, series], [shunt, 0.0]]))
    y = PLAIN.exact_two_port(omega)
    for u in ([1.0, 0.0], [0.3j, 1.0 - 0.2j]):
        i = y @ u
        assert chain @ [u[0], i[0]] == pytest.approx(np.array([u[1], -i[1]]))


@pytest.mark.parametrize("delay", [None, 0.8 * cmath.exp(-0.3j)])
def test_the_lossy_section_by_the_equations_of_its_page(delay):
    d = cmath.exp(-1j * OMEGA * PLAIN.tau) if delay is None else delay
    y = PLAIN.bergeron_two_port(OMEGA, delay)
    z, r, plus, minus = PLAIN.z, 3.6, PLAIN.z + 0.9, PLAIN.z - 0.9
    for u in ([1.0, 0.0], [0.3j, 1.0 - 0.2j]):
        i = y @ u
        leaving = u + minus * i
        for own, other in ((0, 1), (1, 0)):
            history = -z / plus**2 * leaving[other] - r / 4.0 / plus**2 * leaving[own]
            assert i[own] == pytest.approx(u[own] / plus + d * history)


def test_the_numbers_of_prepared_sections():
    step = 2e-6
    result = lines([PLAIN, PLAIN.part(40.0)], step)
    for k, section in enumerate((PLAIN, PLAIN.part(40.0))):
        r, plus = section.resistance, section.z + section.resistance / 4.0
        assert result.conductance[k] == pytest.approx(1.0 / plus)
        assert result.z_minus[k] == pytest.approx(section.z - r / 4.0)
        assert result.far[k] == pytest.approx(-section.z / plus**2)
        assert result.near[k] == pytest.approx(-r / 4.0 / plus**2)
        delay = section.tau / step
        assert result.newest[k] == math.floor(delay) - 1
        ages = result.newest[k] + np.arange(4)
        for n, age in enumerate(ages):
            product = math.prod((delay - m) / (age - m) for m in ages if m != age)
            assert result.weights[k, n] == pytest.approx(product, abs=1e-12)
    size = 1
    while size <= result.newest.max() + 4:
        size *= 2
    assert history_length(result) == size
    assert [history_length(result._replace(newest=np.array([n]))) for n in (3, 4, 11, 12, 27, 28)] == [
        8,
        16,
        16,
        32,
        32,
        64,
    ]
    edge = PLAIN.part(4.0 * step * PLAIN.velocity)
    assert lines([edge.part(edge.length * (1.0 - 1e-10))], step).newest[0] in (2, 3)
    with pytest.raises(ValueError, match="expected at least 4, which is"):
        lines([PLAIN, edge.part(edge.length * (1.0 - 1e-8))], step)


def test_arriving_and_stored_waves_agree_with_loops():
    """Random values: the value stored at a step arrives after the travel time, by the cubic."""
    step = 5e-6
    prepared, chance = lines([PLAIN, PLAIN.part(40.0)], step), np.random.default_rng(1)
    size, messages = history_length(prepared), []
    ring = np.zeros((2, 2, size), complex)
    arrived, currents = np.empty((2, 2, 1), complex), np.empty((2, 2, 1), complex)
    out, current = arrived[:, :, 0], currents[:, :, 0]
    for k in range(1, 3 * size):
        histories.py_func(prepared, ring, k, arrived)
        u = chance.normal(size=(2, 2)) + 1j * chance.normal(size=(2, 2))
        for n in range(2):
            for end in range(2):
                ages = [prepared.newest[n] + m for m in range(4)]
                seen = [messages[k - 1 - age][n][end] if age < k else 0.0 for age in ages]
                assert out[n, end] == pytest.approx(sum(w * x for w, x in zip(prepared.weights[n], seen, strict=True)))
        store.py_func(prepared, ring, k, u[:, :, None], arrived, currents)
        arriving = np.empty((2, 2), complex)
        for n in range(2):
            i = u[n] * prepared.conductance[n] + out[n]
            assert current[n] == pytest.approx(i)
            leaving = u[n] + prepared.z_minus[n] * i
            arriving[n] = prepared.far[n] * leaving[::-1] + prepared.near[n] * leaving
        messages.append(arriving)


def test_the_sinusoidal_past_slot_by_slot():
    step = 5e-6
    prepared = lines([PLAIN], step)
    u, i = np.array([[1.0, 0.5j]]), np.array([[0.01j, -0.02]])
    ring = steady_history(prepared, u, i, OMEGA, step)
    size = history_length(prepared)
    leaving = u[0] + prepared.z_minus[0] * i[0]
    for age in range(size):
        turned = cmath.exp(-1j * OMEGA * step * age)
        for end in range(2):
            wanted = (prepared.far[0] * leaving[1 - end] + prepared.near[0] * leaving[end]) * turned
            assert ring[0, end, -age % size] == pytest.approx(wanted)


def test_a_branch_by_the_trapezoidal_rule():
    r, l, h = 2.0, 0.03, 1e-4  # noqa: E741
    b = branch(r, l, h)
    u0, u1, i0 = 5.0, -3.0, 0.7
    i1 = b.conductance * (u1 + u0 + b.keep * i0)
    assert l * (i1 - i0) / h + r * 0.5 * (i1 + i0) == pytest.approx(0.5 * (u1 + u0))
    z = cmath.exp(1j * OMEGA * h)  # u = Z i for sampled sinusoids
    wanted = (l * (z - 1.0) / h + 0.5 * r * (z + 1.0)) / (0.5 * (z + 1.0))
    assert branch_impedance(r, l, OMEGA, h) == pytest.approx(wanted)


def test_the_transforms_entry_by_entry():
    third, root = 1.0 / 3.0, math.sqrt
    np.testing.assert_allclose(
        CLARKE,
        [[root(third)] * 3, [root(2 * third), -root(1 / 6), -root(1 / 6)], [0.0, root(0.5), -root(0.5)]],
        rtol=1e-15,
    )
    np.testing.assert_allclose(KARRENBAUER, [[third] * 3, [third, -third, 0.0], [third, 0.0, -third]])
    np.testing.assert_allclose(KARRENBAUER_INVERSE, [[1, 1, 1], [1, -2, 1], [1, 1, -2]])
    np.testing.assert_allclose(AERIAL, [[third, -third, 0.0], [0.0, third, -third], [-third, 0.0, third]])
    for matrix in (CLARKE, KARRENBAUER, KARRENBAUER_INVERSE, AERIAL):
        assert not matrix.flags.writeable
