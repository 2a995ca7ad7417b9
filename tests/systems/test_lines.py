"""Line sections: constants, two-ports, the compiled steps against the sinusoidal steady state, modal transforms."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
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
    """Lumping R three times errs with the square of the losses: a quarter of the length, far less of the error."""
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


@pytest.mark.parametrize("kind", ["phase", "space_vector"])
def test_steps_hold_the_sinusoidal_steady_state(kind):
    """Both ends forced with sinusoids: the stepped currents are those of the two-port, from the first step on."""
    step, omega = 1.0 / 46080.0, 2.0 * math.pi * 60.0
    sections = [GUPFC_HALF, GUPFC_HALF.part(150.0)]
    prepared = lines(sections, step)
    voltages = np.array([[1.0, 0.9 * cmath.exp(-0.2j)], [0.8j, 1.1 * cmath.exp(0.5j)]])
    currents = np.array([discrete_two_port(s, omega, step) @ u for s, u in zip(sections, voltages, strict=True)])
    ring = steady_history(prepared, voltages, currents, omega, step)
    take = np.real if kind == "phase" else np.asarray
    ring = np.ascontiguousarray(take(ring))
    assert ring.shape == (2, 2, history_length(prepared))
    history, found = np.empty((2, 2), ring.dtype), np.empty((2, 2), ring.dtype)
    for k in range(1, 3 * ring.shape[2]):
        turn = cmath.exp(1j * omega * step * k)
        histories(prepared, ring, k, history)
        store(prepared, ring, k, np.ascontiguousarray(take(voltages * turn)), history, found)
        np.testing.assert_allclose(found, take(currents * turn), atol=1e-13)


def test_step_response_of_a_matched_lossless_line():
    """A wave sent into a line that ends in its surge impedance arrives after tau, whole, and does not come back."""
    section, step = Section(0.0, 1e-3, 1e-8, 100.0), 1e-6
    prepared = lines([section], step)
    ring = np.zeros((1, 2, history_length(prepared)))
    history, current, u = np.empty((1, 2)), np.empty((1, 2)), np.empty((1, 2))
    sent, arrived = [], []
    for k in range(1, 1000):
        histories(prepared, ring, k, history)
        u[0, 0] = 1.0
        u[0, 1] = -history[0, 1] / (2.0 * prepared.conductance[0])  # u = -Z i
        store(prepared, ring, k, u, history, current)
        sent.append(current[0, 0])
        arrived.append(u[0, 1])
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
    zero, positive = 10.0 + 2.0j, 3.0 + 1.0j  # of a transposed element: self (z0 + 2 z1)/3, mutual (z0 - z1)/3
    transposed = np.full((3, 3), (zero - positive) / 3.0) + positive * np.eye(3)
    for modal in (
        CLARKE @ transposed @ CLARKE.T,
        KARRENBAUER @ transposed @ KARRENBAUER_INVERSE,
    ):
        np.testing.assert_allclose(modal, np.diag([10.0 + 2.0j, 3.0 + 1.0j, 3.0 + 1.0j]), atol=1e-14)
    np.testing.assert_allclose(AERIAL @ np.ones(3), 0.0)
