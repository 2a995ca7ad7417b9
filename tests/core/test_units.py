"""Units: held against each other where a rig is wired, converted where a figure asks for another."""

import math

import pytest
from softrig_control.unit_delay import UnitDelay
from softrig_core import Block, BlockParams, Plant, Rig, ScenarioError, command, param, scalars
from softrig_core.judge.units import factor, misfit
from softrig_core.rig.members import signal_units


class Params(BlockParams):
    period: float = param(1e-3, "sampling period", "s", gt=0)


def buck(duty="1"):
    """A converter in V and A whose duty is a pure number."""

    class Buck(Plant[Params]):
        INPUTS = (command("duty", "buck/duty", ["d"], duty),)
        OUTPUTS = (scalars("state", "buck/state", {"voltage": "V", "current": "A"}),)

        def outputs(self, x, t):
            return {"state": (12.0, 1.0)}

        def advance(self, x, t, duty):
            return x

    return Buck()


def law(voltage="V", current="A", duty="1", topic="buck/state"):
    class Law(Block[Params]):
        INPUTS = (scalars("state", topic, {"voltage": voltage, "current": current}),)
        OUTPUTS = (command("duty", "buck/duty", ["d"], duty),)

        def update(self, x, t, state):
            return x, {"duty": (0.5,)}

    return Law()


@pytest.mark.parametrize(
    ("units", "message"),
    [
        ({"voltage": "mV"}, r"voltage/position is in 'V', expected 'mV': the same quantity, 1 V = 1000 mV; declare"),
        (
            {"current": "rad"},
            r"buck/state from plant does not fit law: current/position is in 'A', expected 'rad', "
            r"which is another quantity",
        ),
        ({"duty": "percent"}, r"buck/duty from law .* plant: d/effort is in 'percent', expected '1': .* = 0.01;"),
        ({"duty": "V"}, r"d/effort is in 'V', expected '1', which is another quantity"),
    ],
)
def test_units_that_do_not_fit_are_refused_where_the_rig_is_wired(units, message):
    with pytest.raises(ScenarioError, match=message):
        Rig.from_blocks({"plant": buck(), "law": law(**units)}, 0.01)


@pytest.mark.parametrize("units", [{}, {"voltage": ""}, {"voltage": "W/A"}, {"voltage": "kg m^2/s^3/A"}])
def test_units_that_say_the_same_and_those_not_stated_fit(units):
    rig = Rig.from_blocks({"plant": buck(), "law": law(**units)}, 0.01)
    assert signal_units(rig)["buck/state/voltage/position"] == "V"


def test_a_link_hands_on_the_units_of_what_it_carries():
    link = {
        "topic_in": "buck/state",
        "topic_out": "late/state",
        "channels": ["voltage", "current"],
        "fields": ["position"],
    }
    blocks = {"plant": buck(), "link": UnitDelay(**link), "law": law(topic="late/state")}
    assert signal_units(Rig.from_blocks(blocks, 0.01))["late/state/current/position"] == "A"
    with pytest.raises(ScenarioError, match="late/state from link does not fit law: voltage/position is in 'V'"):
        Rig.from_blocks(blocks | {"law": law(voltage="kV", topic="late/state")}, 0.01)


@pytest.mark.parametrize(
    ("given", "wanted", "number"),
    [
        ("s", "ms", 1e3),
        ("rad", "deg", math.degrees(1.0)),
        ("rpm", "rad/s", math.pi / 30.0),
        ("m/s^2", "mm/s^2", 1e3),
        ("N m", "J", 1.0),
        ("km", "m", 1e3),
        ("kg", "g", 1e3),
        ("V", "A", None),
        ("packet", "1", None),
        ("1", "%", 1e2),
    ],
)
def test_units_are_converted_where_they_measure_the_same(given, wanted, number):
    found = factor(given, wanted)
    assert found == (None if number is None else pytest.approx(number))
    assert bool(misfit(given, wanted)) == (number != 1.0)
