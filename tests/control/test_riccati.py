"""Linear-quadratic controllers against python-control, and by their definition."""

import numpy as np
import pytest
from softrig_control.riccati import lqr
from softrig_core import Sampled
from softrig_drives.dc_motor.plant import DcMotorPlant


@pytest.mark.parametrize("inputs", [1, 2])
def test_lqr_equals_that_of_the_control_library(inputs):
    import control  # its import takes a second, so only this test pays it

    rng = np.random.default_rng(3)
    for n in (1, 2, 4):
        a, b = 1.2 * rng.normal(size=(n, n)), rng.normal(size=(n, inputs))
        half = rng.normal(size=(n, n))
        q, r = half @ half.T + np.eye(n), np.diag(rng.uniform(0.5, 2.0, inputs))
        assert np.array(lqr(a, b, q, r)) == pytest.approx(control.dlqr(a, b, q, r)[0], rel=1e-8, abs=1e-10)
        diagonal = control.dlqr(a, b, np.eye(n), np.diag([2.0] * inputs))[0]
        assert np.array(lqr(a, b, [1.0] * n, [2.0] * inputs)) == pytest.approx(diagonal, rel=1e-8, abs=1e-10)


def test_the_controller_of_a_plant_makes_its_loop_stable():
    model = Sampled(DcMotorPlant()).linearise((0.0, 0.0, 0.0), (0.0,))
    # The angle integrates, so the plant has a pole at 1.
    assert max(abs(np.linalg.eigvals(model.A))) == pytest.approx(1.0)
    loop = model.A - model.B @ np.array(lqr(model.A, model.B, (100.0, 1.0, 0.0), (0.1,)))
    assert max(abs(np.linalg.eigvals(loop))) < 0.999


@pytest.mark.parametrize(
    ("a", "b", "q", "r", "text"),
    [
        ([[2.0]], [[0.0]], [1.0], [1.0], "no such controller"),  # an unstable state that the input cannot reach
        ([[1.5]], [[1.0]], [1.0], [0.0], "no such controller"),
        ([[1.0]], [1.0], [1.0], [1.0], r"B \(1,\)"),
        ([[1.0]], [[1.0]], [1.0, 2.0], [1.0], r"Q \(2, 2\)"),
    ],
)
def test_a_plant_without_a_stabilising_controller_is_reported(a, b, q, r, text):
    with pytest.raises(ValueError, match=text):
        lqr(a, b, q, r)
