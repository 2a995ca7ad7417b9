"""Reference and command sources."""

import pytest
from softrig_control.nodes.constant_source import CommandSource, ScalarSource
from softrig_control.nodes.reference_source import ReferenceSource
from softrig_control.profile import NEVER, StepProfile
from softrig_core import ByHand, ParameterError


def test_a_profile_changes_at_its_times():
    profile = StepProfile((0.5, 1.25), ("a", "b"))
    assert [profile.at(t) for t in (0, 500_000_000, 1_249_999_999, 1_250_000_000)] == ["a", "a", "a", "b"]
    assert [profile.next_change(t) for t in (0, 1_249_999_999, 1_250_000_000)] == [1_250_000_000] * 2 + [NEVER]


def test_reference_of_two_axes_in_three_fields():
    source = ReferenceSource(
        channels=("x", "y"), unit="mm", times=(0.0, 2.0), positions=(1.0, 2.0, 3.0, 4.0),
        velocities=(5.0, 6.0, 7.0, 8.0), accelerations=(9.0, 10.0, 11.0, 12.0))  # fmt: skip
    (_, (port,)) = source.ports(source.p)
    assert port.labels == ("x/position", "y/position", "x/velocity", "y/velocity", "x/acceleration", "y/acceleration")
    assert port.units == ("mm", "mm", "mm/s", "mm/s", "mm/s^2", "mm/s^2")
    assert ByHand(source).update(1_999_999_999)["reference"] == (1.0, 2.0, 5.0, 6.0, 9.0, 10.0)
    assert ByHand(source).update(2_000_000_000)["reference"] == (3.0, 4.0, 7.0, 8.0, 11.0, 12.0)


def test_only_the_fields_given_are_sent():
    source = ReferenceSource(channels=("axis",), unit="mm", positions=(10.0,))
    (_, (port,)) = source.ports(source.p)
    assert (port.labels, port.units) == (("axis/position",), ("mm",))
    assert ByHand(source).update(0)["reference"] == (10.0,)


def test_a_command_source_publishes_its_profile():
    source = CommandSource(channels=("a", "b"), units=("N m",), times=(0.0, 1.0), values=(1.0, 2.0, 3.0, 4.0))
    (_, (port,)) = source.ports(source.p)
    assert (port.labels, port.units) == (("a/effort", "b/effort"), ("N m", "N m"))
    assert [ByHand(source).update(t)["command"] for t in (0, 10**9)] == [(1.0, 2.0), (3.0, 4.0)]
    (_, (port,)) = ScalarSource.ports(ScalarSource.Params(channels=("v", "i"), units=("V", "A"), values=(1.0, 2.0)))
    assert (port.name, port.labels, port.units) == ("values", ("v/position", "i/position"), ("V", "A"))


@pytest.mark.parametrize(
    ("block", "values", "message"),
    [
        (ReferenceSource, {"velocities": ()}, "none of positions, velocities, accelerations"),
        (ReferenceSource, {"velocities": (1.0, 2.0)}, r"velocities has 2 values, expected 1 \(1 times, 1 channels\)"),
        (ReferenceSource, {"times": (1.0,)}, "times begins with 1 s"),
        (ReferenceSource, {"times": (0.0, 0.0), "velocities": (1.0, 2.0)}, "later than the one before"),
        (ReferenceSource, {"channels": ()}, "channels"),
        (CommandSource, {"values": (1.0, 2.0)}, "values has 2 values, expected 1"),
        (CommandSource, {"times": ()}, "times"),
        (
            ScalarSource,
            {"channels": ("a", "b", "c"), "units": ("V", "A"), "values": (1.0, 2.0, 3.0)},
            "2 units for 3 channels",
        ),
    ],
)
def test_bad_profiles_are_refused(block, values, message):
    with pytest.raises(ParameterError, match=message):
        block(**values)
