"""Units: compared where a rig is wired, converted where a figure uses another."""

import math
import random
import re

import numpy as np
import pytest
from softrig_control.nodes.unit_delay import UnitDelay
from softrig_core import Block, BlockParams, Plant, Rig, ScenarioError, command, param, scalars
from softrig_core.judge.units import base, compose, factor, misfit, powers, pretty_unit, text
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
def test_units_that_do_not_fit_are_refused_when_the_rig_is_wired(units, message):
    with pytest.raises(ScenarioError, match=message):
        Rig.from_blocks({"plant": buck(), "law": law(**units)}, 0.01)


@pytest.mark.parametrize("units", [{}, {"voltage": ""}, {"voltage": "W/A"}, {"voltage": "kg m^2/s^3/A"}])
def test_equal_units_and_undeclared_ones_fit(units):
    rig = Rig.from_blocks({"plant": buck(), "law": law(**units)}, 0.01)
    assert signal_units(rig)["buck/state/voltage/position"] == "V"


def test_a_link_passes_on_the_units_of_its_messages():
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
    ("unit", "wanted", "number"),
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
def test_units_of_the_same_quantity_are_converted(unit, wanted, number):
    result = factor(unit, wanted)
    assert result == (None if number is None else pytest.approx(number))
    assert bool(misfit(unit, wanted)) == (number != 1.0)


# Derived by hand from the SI brochure: exponents of kg, m, s, A, K and rad, and the factor.
DIMENSIONS = {
    "s": ("001000", 1),
    "m": ("010000", 1),
    "g": ("100000", 1e-3),
    "A": ("000100", 1),
    "K": ("000010", 1),
    "rad": ("000001", 1),
    "Hz": ("00-1000", 1),
    "N": ("11-2000", 1),
    "Pa": ("1-1-2000", 1),
    "J": ("12-2000", 1),
    "W": ("12-3000", 1),
    "VA": ("12-3000", 1),
    "var": ("12-3000", 1),
    "C": ("001100", 1),
    "V": ("12-3-100", 1),
    "ohm": ("12-3-200", 1),
    "Ohm": ("12-3-200", 1),
    "F": ("-1-24200", 1),
    "H": ("12-2-200", 1),
    "Wb": ("12-2-100", 1),
    "T": ("10-2-100", 1),
    "%": ("000000", 0.01),
    "percent": ("000000", 0.01),
    "deg": ("000001", math.pi / 180),
    "rpm": ("00-1001", 2 * math.pi / 60),
    "rev": ("000001", 2 * math.pi),
    "min": ("001000", 60),
    "h": ("001000", 3600),
}
PREFIXES = {"": 0, "p": -12, "n": -9, "u": -6, "m": -3, "c": -2, "k": 3, "M": 6, "G": 9}
PLAIN = ("%", "percent", "deg", "rpm", "rev", "min", "h")


def parsed(name):
    """Dimensions and size of a unit with its prefix."""
    prefix, unit = name
    results = [int(x) for x in re.findall(r"-?\d", DIMENSIONS[unit][0])]
    return np.array(results), 10.0 ** PREFIXES[prefix] * DIMENSIONS[unit][1]


NAMES = [*((p, u) for p in PREFIXES for u in DIMENSIONS if u not in PLAIN), *(("", u) for u in PLAIN)]


def drawn(rng):
    """A product of powers of few units, so that some measure the same quantity."""
    return [(rng.choice(NAMES), rng.choice([1, 1, 2, 3, -1, -2])) for _ in range(rng.choice([1, 1, 2, 3]))]


def written(unit):
    text = ""
    for k, (name, power) in enumerate(unit):
        over = power < 0 and k > 0
        size = -power if over else power
        text += ("/" if over else " " if k else "") + "".join(name) + (f"^{size}" if size != 1 else "")
    return text


def total(unit):
    dims = sum(parsed(name)[0] * power for name, power in unit)
    return dims.tolist(), math.prod(parsed(name)[1] ** power for name, power in unit)


MADE = [
    ([(("", "N"), 1), (("", "m"), 1)], [(("", "J"), 1)]),
    ([(("k", "g"), 1)], [(("", "g"), 1)]),
    ([(("", "rad"), 2)], [(("", "deg"), 2)]),
    ([(("", "V"), 1)], [(("m", "V"), 1)]),
    ([(("", "rev"), 1), (("", "min"), -1)], [(("", "rpm"), 1)]),
]


def test_any_two_units_measure_the_same_quantity_or_not():
    rng = random.Random(1)
    for name in NAMES:  # each unit beside one of its own dimension and one of any
        alike = [n for n in NAMES if DIMENSIONS[n[1]][0] == DIMENSIONS[name[1]][0]]
        hold_units([(name, 1)], [(rng.choice(alike), 1)])
        hold_units([(name, rng.choice([2, -1]))], drawn(rng))
    for one, other in MADE:
        hold_units(one, other)
    for _ in range(60):
        one = drawn(rng)
        hold_units(one, drawn(rng))
        hold_units(one, one[::-1])


def hold_units(one, other):
    (dims, size), (wanted, of) = total(one), total(other)
    a, b = written(one), written(other)
    assert base(a)[0] == pytest.approx(size, rel=1e-12)
    assert powers(text(powers(a))) == powers(a)
    result = factor(a, b)
    if dims == wanted:
        assert result == pytest.approx(size / of, rel=1e-12)
        same = math.isclose(size, of, rel_tol=1e-12)
        assert misfit(a, b).startswith("" if same else f"is in {a!r}, expected {b!r}: the same quantity, 1 ")
        assert bool(misfit(a, b)) != same
    else:
        assert result is None
        assert misfit(a, b) == f"is in {a!r}, expected {b!r}, which is another quantity"
    assert misfit(a, "") == misfit("", b) == ""


def test_units_are_written_as_expected():
    assert powers("m/s^2") == {"m": 1, "s": -2}
    assert powers("1/s") == {"s": -1}
    assert powers("N*m/rad/m") == {"N": 1, "rad": -1}
    assert text({"m": 1, "s": -2}) == "m/s^2"
    assert text({"s": -1}) == "1/s"
    assert text({"a": 2, "b": 1, "c": -1, "d": -3}) == "a^2 b/c/d^3"
    assert text({}) == ""
    assert [compose(t, "V") for t in ("A", "{signal}", "{signal}/s", "{signal} s", "{signal}^2")] == [
        "A",
        "V",
        "V/s",
        "V s",
        "V^2",
    ]
    assert compose("{signal} s", "m/s") == "m"
    assert compose("{signal}^2 s", "m/s") == "m^2/s"
    assert misfit("V", "mV") == (
        "is in 'V', expected 'mV': the same quantity, 1 V = 1000 mV; declare 'V' at the reader and scale there, "
        "or 'mV' at the sender and scale there"
    )
    assert ": the same quantity, 1 % = 0.01; declare" in misfit("%", "1")
    assert [pretty_unit(u) for u in ("kg m^2", "ohm", "m^-12", "kohm")] == ["kg m²", "Ω", "m⁻¹²", "kohm"]
    assert (base("packet"), factor("packet/min", "packet/s")) == ((1.0, {"packet": 1}), pytest.approx(1.0 / 60.0))
