"""Time: rational periods, stamps, ends; the same in process, through processes and open loop."""

from fractions import Fraction

import pytest
from conftest import differences, in_process, make_scenario
from hypothesis import given, strategies as st
from softrig_bringup.run.run import gaps
from softrig_core import BlockParams, ParameterError, ScenarioError, feed, rig_of
from softrig_core.block.params import build
from softrig_core.block.schedule import rational
from softrig_nodes import run_processes


@given(st.integers(1, 10**6), st.integers(1, 10**6))
def test_a_float_means_the_simplest_fraction_that_rounds_to_it(p, q):
    meant = rational(p / q)
    assert abs(meant - Fraction(p, q)) * 2**51 <= Fraction(p, q)
    assert meant.denominator <= Fraction(p, q).denominator


def test_a_period_may_be_written_as_a_fraction():
    assert build(BlockParams, {"period": "1/2880"}) == BlockParams(period=1 / 2880)
    with pytest.raises(ParameterError, match="period = '1/0'"):
        build(BlockParams, {"period": "1/0"})
    with pytest.raises(ParameterError, match="neither a number nor a fraction"):
        build(BlockParams, {"period": "a/b"})


def two_plants(period, second, duration, **options):
    slow = {
        "executable": "plant",
        "parameters": {"period": second},
        "remap": {"lag/state": "second/state", "lag/applied": "second/applied"},
    }
    fast = {"executable": "plant", "parameters": {"period": period}}
    others = {n: {"executable": n, "parameters": {"period": period}} for n in ("source", "gain", "watcher")}
    return rig_of(make_scenario({"plant": fast, **others, "second": slow}, duration, **options))


ENDS = {
    "second plant's period does not divide the duration": (0.01, 0.03, 0.2, 20, 7),
    "no whole number of ns": ("1/2880", "1/288", 0.1, 288, 29),
    "a duration between two ticks": (0.00083, 0.00249, 0.1, 120, 41),
}


DAILY = "a duration between two ticks"


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.long] * (n != DAILY)) for n in ENDS])
@pytest.mark.processes
def test_ends_are_the_same_in_process_through_processes_and_open_loop(name, tmp_path):
    period, second, duration, ticks, messages = ENDS[name]
    rig = two_plants(period, second, duration)
    assert rig.ticks == ticks
    expected = in_process(rig)
    assert gaps(rig, expected) == ""
    assert len(expected.topics["/clock"].times) == ticks + 1
    assert len(expected.topics["second/state"].times) == messages
    outcome = run_processes(rig, 0, tmp_path)
    assert outcome.error == ""
    assert differences(expected, outcome.recording) == []
    for member in rig.members:
        answers = feed(member, 0, expected)
        assert all(answers.topics[t].data == expected.topics[t].data for t in answers.topics)


def test_a_duration_shorter_than_a_tick_is_refused():
    with pytest.raises(ScenarioError, match=r"duration 0\.005 s is shorter than the period 0\.01 s"):
        two_plants(0.01, 0.03, 0.005)
