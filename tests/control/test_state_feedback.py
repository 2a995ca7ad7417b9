"""Pole placement, the sampled law with anti-windup, and prediction by command replay."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from softrig_control.discretise import zero_order_hold
from softrig_control.predictor import CommandReplay
from softrig_control.state_feedback import StateFeedback, UnstableDesign, closed_loop_poles, place

MOTOR = ([[-5.26, 0.0], [1.0, 0.0]], [2.2862, 0.0], [0.0, 1.0])
MASSES = (  # two carts with a spring and a damper: four states
    [[0, 1, 0, 0], [-3, -0.2, 3, 0.2], [0, 0, 0, 1], [6, 0.4, -6, -0.4]],
    [0, 1, 0, 0],
    [0, 0, 1, 0],
)


@pytest.mark.parametrize(
    ("plant", "poles"),
    [
        (MOTOR, [-3, -6, -9]),
        (MOTOR, [-4, -4, -4]),
        (MOTOR, [-2 + 3j, -2 - 3j, -8]),
        (MASSES, [-1, -2, -3, -4, -5]),
        (MASSES, [-2 + 1j, -2 - 1j, -3, -1 - 4j, -1 + 4j]),
    ],
)
def test_the_loop_has_the_wanted_poles(plant, poles):
    gains = place(*plant, poles)
    result = np.poly(closed_loop_poles(*plant, gains.k, gains.ki))
    assert result == pytest.approx(np.poly(poles).real, rel=1e-9)


def test_the_gains_are_those_of_scipy():
    from scipy.signal import place_poles  # its import takes a second, so only this test pays it

    a, b, c = MOTOR
    augmented = np.block([[np.array(a), np.zeros((2, 1))], [-np.array([c]), np.zeros((1, 1))]])
    peer = place_poles(augmented, np.append(b, 0.0)[:, None], [-3, -6, -9]).gain_matrix[0]
    gains = place(*MOTOR, [-3, -6, -9])
    assert (*gains.k, -gains.ki) == pytest.approx(tuple(peer), rel=1e-9)


@pytest.mark.parametrize(
    ("plant", "poles", "error", "text"),
    [
        (MOTOR, [-3, 0.5, -9], UnstableDesign, r"pole 0\.5 among -3, 0\.5, -9 1/s"),
        (MOTOR, [-3, 0, -9], UnstableDesign, "pole 0 among"),
        (MOTOR, [1j, -1j, -9], UnstableDesign, r"pole 0\+1j, -?0-1j"),
        (MOTOR, [-3, -6], ValueError, "2 poles, expected 3"),
        (MOTOR, [-3, -6 + 1j, -6 + 1j], ValueError, "conjugate pairs"),
        (([[-1.0, 0.0], [0.0, -2.0]], [1.0, 0.0], [1.0, 1.0]), [-3, -4, -5], ValueError, "not controllable"),
    ],
)
def test_a_bad_design_is_refused(plant, poles, error, text):
    with pytest.raises(error, match=text):
        place(*plant, poles)


def test_the_controller_saturates_and_integrates_after_the_output():
    law = StateFeedback((2.0, 3.0), 10.0, 0.1, 5.0)
    xi, u = law(0.0, 1.0, (0.5, 0.0), 0.0)
    assert u == -1.0
    assert xi == pytest.approx(0.1)
    xi, u = law(xi, 1.0, (0.0, 0.0), -99.0)
    assert u == pytest.approx(1.0)
    assert law(xi, 0.0, (0.0, 0.0), 0.0)[1] == 5.0


@pytest.mark.parametrize(("error", "integrates"), [(1.0, False), (-1.0, True)])
def test_anti_windup_holds_the_integrator_only_towards_the_limit(error, integrates):
    law = StateFeedback((0.0,), 1.0, 0.1, 1.0, anti_windup=True)
    xi, u = law(3.0, error, (0.0,), 0.0)
    assert u == 1.0
    assert (xi != 3.0) == integrates


def test_settle_starts_without_a_bump():
    law = StateFeedback((2.0, 3.0), 10.0, 0.1, 5.0, kr=0.5)
    xi = law.settle((0.3, 4.0), 4.0)
    assert law(xi, 4.0, (0.3, 4.0), 4.0)[1] == pytest.approx(0.0, abs=1e-12)


def test_other_gains_continue_without_a_bump():
    before, law = (StateFeedback(k, ki, 0.1, 50.0) for k, ki in (((2.0, 3.0), 10.0), ((4.0, 1.0), 5.0)))
    state, r = (0.3, 4.0), 4.5
    command = before(1.7, r, state, 4.0)[1]
    assert law(1.7, r, state, 4.0)[1] != pytest.approx(command, rel=0.1)
    assert law(law.go_on(1.7, before, state, r), r, state, 4.0)[1] == pytest.approx(command, rel=1e-12)


@given(
    late=st.integers(0, 12),
    commands=st.lists(st.floats(-100, 100), min_size=12, max_size=30),
    start=st.tuples(*[st.floats(-10, 10)] * 4),
)
@settings(max_examples=60, deadline=None)
def test_replay_equals_the_plant_itself(late, commands, start):
    phi, gamma = zero_order_hold(MASSES[0], [[b] for b in MASSES[1]], 0.05)
    replay = CommandReplay(phi, gamma, 12)
    history, x, past = replay.nothing(), np.array(start), [np.array(start)]
    for u in commands:
        history = replay.record(history, u)
        x = np.array(phi) @ x + np.array(gamma)[:, 0] * u
        past.append(x)
    assert replay.present(history, past[-1 - late], late) == pytest.approx(tuple(x), rel=1e-9, abs=1e-9)


def test_replay_knows_its_longest_delay():
    phi, gamma = zero_order_hold(MOTOR[0], [[b] for b in MOTOR[1]], 0.01)
    replay = CommandReplay(phi, gamma, 5)
    history = replay.nothing()
    assert replay.present(history, (1.0, 2.0), 0) == (1.0, 2.0)
    for k in range(9):
        assert history.known == min(k, 5)
        history = replay.record(history, float(k))
    assert [history.line.back(k)[0] for k in range(5)] == [8.0, 7.0, 6.0, 5.0, 4.0]
    assert history.known == 5
