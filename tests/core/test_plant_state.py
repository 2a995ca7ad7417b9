"""Every plant names its state, and can be linearised."""

import control
import numpy as np
import pytest
from helpers import blocks
from softrig_control.discretise import zero_order_hold
from softrig_control.nodes.linear_plant import LinearPlant
from softrig_core import ByHand, Plant, Sampled, equilibrium, state_type, to_ns
from softrig_core.kit.floats import numbers
from softrig_drives.dc_motor.model import state_space
from softrig_drives.dc_motor.plant import DcMotorPlant
from softrig_drives.induction_dtc.plant import ImPlant
from softrig_power.pv.converter import steady_state
from softrig_power.pv.plant import PvPlant
from softrig_power.rectifier.plant import RectifierPlant

# The states of two plants are in files.
PLANTS = {
    name: block
    for _, name, block in blocks(defaults=False)
    if issubclass(block, Plant) and name not in ("fmu_plant", "c_plant")
}


def stepped(node, first, count):
    plant = node.block
    period = to_ns(plant.p.period)
    inputs, _ = plant.ports(plant.p)
    safe = {port.name: None if port.held else port.safe for port in inputs}
    for k in range(first, first + count):
        node.outputs(k * period)
        node.advance(k * period, **safe)
    return node.x


def test_all_plants_are_tested():
    assert len(PLANTS) >= 20


@pytest.mark.parametrize("name", PLANTS)
def test_every_plant_names_its_state(name):
    plant = PLANTS[name]()
    node = ByHand(plant)
    begin = node.x
    if name != "clock":
        assert len(set(begin._fields)) == len(begin) > 0
    later = stepped(node, 0, 3)
    assert type(later) is type(begin)
    assert np.isfinite([*numbers(begin), *numbers(later)]).all()
    assert plant.first() == begin


def test_a_state_of_another_length_is_refused():
    """The state of a plant with a past has the past in it: three numbers are not all."""
    with pytest.raises(ValueError, match=r"^3 numbers, expected the \d+ of the state"):
        Sampled(PLANTS["tcp_fluid"]()).linearise((1.0, 0.0, 0.0), (0.0, *(0.0,) * 4))


def test_names_are_made_valid():
    kind = state_type(("P", ("1", "2")), ("", ("axis/position", "3", "lambda")))
    assert kind._fields == ("P_1", "P_2", "axis_position", "x_3", "x_lambda")


def test_linearised_motor_is_the_sampled_equations():
    plant = DcMotorPlant()
    ad, bd = (np.array(m) for m in zero_order_hold(*state_space(plant.p), plant.p.period))
    result = Sampled(plant).linearise((0.0, 3.0, 0.2), (1.5,))
    np.testing.assert_allclose(result.A, ad, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(result.B[:, 0], bd[:, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(result.C[:2], np.eye(3)[:2], atol=1e-12)  # the outputs motor/state are angle and speed
    assert result.system().dt == plant.p.period


def test_the_voltage_that_holds_a_speed_is_found():
    plant = DcMotorPlant()
    x, u = equilibrium(Sampled(plant), (0.0, 5.0, 0.0), (0.0,), held=[1], free=[0], moving=[0])
    p = plant.p
    assert x[2] == pytest.approx(p.b * 5.0 / p.Kt, rel=1e-9)
    assert u[0] == pytest.approx(p.R * x[2] + p.Ke * 5.0, rel=1e-9)


def test_linear_plant_has_its_poles():
    plant = LinearPlant()
    result = Sampled(plant).linearise((0.0, 0.0), (0.0,)).system()
    expected = control.sample_system(control.tf(plant.p.num, plant.p.den), plant.p.period)
    assert np.sort(result.poles().real) == pytest.approx(np.sort(expected.poles().real), rel=1e-9)
    assert result.dcgain() == pytest.approx(expected.dcgain(), rel=1e-9)


@pytest.mark.long
def test_the_resting_converter_is_the_steady_state():
    plant = PvPlant()
    conditions = plant.first().conditions
    source = plant.p.sources()(conditions)
    start = (*steady_state(plant.p.converter, source, 0.38), *conditions)
    x, _ = equilibrium(Sampled(plant), start, (0.4, *conditions))
    assert x == pytest.approx((*steady_state(plant.p.converter, source, 0.4), *conditions), rel=1e-7)


def test_the_resting_rectifier_and_its_poles():
    """At its published start the averaged rectifier is at rest; its dominant pole is that of the DC link, -126 1/s."""
    plant = RectifierPlant()
    p = plant.p
    x, u = equilibrium(Sampled(plant), numbers(plant.first()), (p.drop, p.R_L, p.V_g, 0.0))
    assert x == pytest.approx((37.83218957482916, 0.0, 400.0), abs=1e-6)
    poles = np.log(np.linalg.eigvals(Sampled(plant).linearise(x, u).A).astype(complex)) / p.period
    assert max(poles.real) == pytest.approx(-p.R / p.L, rel=1e-6)
    assert min(poles.real) == pytest.approx(-126.26, rel=1e-3)


def test_currents_of_a_state_are_those_of_the_step():
    plant = ImPlant(adc_mode="none")
    state = (0.3, -0.8, 0.35, -0.7, 20.0, 1.0)
    outputs = plant.outputs(type(plant.first())(*state), 0)
    again = plant._step((*state, 0.0, 0.0, 0.0, *plant._constants[:-1], 0.0))  # a step of zero length
    assert outputs["currents_true"] == pytest.approx(again[6:9], rel=1e-12)
    assert outputs["joint_states"][2] == pytest.approx(again[9], rel=1e-12)
