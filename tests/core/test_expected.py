"""Expectations and claims: what is read, refused, holds, agrees and is required, with each limit in a precomputed
table.
"""

import math

import pytest
from pydantic import ValidationError
from softrig_core import ScenarioError
from softrig_core.judge.claims import Claim
from softrig_core.judge.expectation import FORMS, Expectation, parse
from softrig_core.judge.formula import Condition
from softrig_core.judge.robustness import truth
from softrig_core.judge.words import readable

NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.694 +- 0.0069", {"expected": 0.694, "tolerance": 0.0069}),
        (" -0.5+-1 % ", {"expected": -0.5, "tolerance": 0.005}),
        ("2.e1 +- 5", {"expected": 20.0, "tolerance": 5.0}),
        ("0.4 +- 0.1", {"expected": 0.4, "tolerance": 0.1}),
        ("-8 +- 25%", {"expected": -8.0, "tolerance": 2.0}),
        ("1.2 +- 0.3", {"expected": 1.2, "tolerance": 0.3}),  # rounding makes 0.3 / 1.2 larger than a quarter
        ("0 +- 7", {"expected": 0.0, "tolerance": 7.0}),
        ("3 +- 0", {"expected": 3.0, "tolerance": 0.0}),
        (44, {"expected": 44.0, "tolerance": 0.0}),
        (0.5, {"expected": 0.5, "tolerance": 0.0}),
        ("at most -.5", {"at_most": -0.5}),
        ("at least 1e-3", {"at_least": 1e-3}),
        ("between 80 and 81.1", {"at_least": 80.0, "at_most": 81.1}),
        ("between 3 and 3", {"at_least": 3.0, "at_most": 3.0}),
        ("4 +- -1", "a tolerance is not negative"),
        ("-4 +- -1%", "a tolerance is not negative"),
        (
            "8 +- 26 %",
            "the tolerance is 26% of the value, which is a weak test; state the limits: 'between 5.92 and 10.08', "
            "'at most ...' or 'at least ...'",
        ),
        (
            "-4 +- 2",
            "the tolerance is 50% of the value, which is a weak test; state the limits: 'between -6 and -2', "
            "'at most ...' or 'at least ...'",
        ),
        (
            "1 +- 0.2500001",
            "the tolerance is 25% of the value, which is a weak test; state the limits: 'between 0.75 and 1.25', "
            "'at most ...' or 'at least ...'",
        ),
        ("between 2 and 1", "between 2 and 1: nothing is"),
        ("44", FORMS),
        ("at most", FORMS),
        ("between 1 and", FORMS),
        (True, FORMS),
        (None, FORMS),
        ("4 +- 1 m", FORMS),
        ("at most nan", FORMS),
    ],
)
def test_expectations_are_read_or_refused(text, expected):
    if isinstance(expected, str):
        with pytest.raises(ValueError) as refused:  # noqa: PT011
            parse(text)
        assert str(refused.value) == expected
        return
    parsed = parse(text)
    assert parsed.model_dump(exclude_none=True) == pytest.approx(expected, rel=1e-15)
    assert parse(parsed) is parsed
    assert parse({"at_most": 1.0}) == {"at_most": 1.0}


@pytest.mark.parametrize(
    ("limits", "holds", "not_holds", "margins"),
    [
        ({"expected": 2.0, "tolerance": 0.5}, (1.5, 2.0, 2.5), (1.4375, 2.5625, NAN, INF, -INF), {2.0: NAN}),
        ({"expected": 2.0}, (2.0,), (1.9375, 2.0625), {}),
        ({"at_most": 3.0}, (3.0, -9.0), (3.0625, INF, -INF, NAN), {1.0: 2.0, 4.0: -1.0}),
        ({"at_least": 3.0}, (3.0, 9.0), (2.9375, INF, NAN), {1.0: -2.0, 4.0: 1.0}),
        ({"at_least": 1.0, "at_most": 3.0}, (1.0, 3.0), (0.9375, 3.0625), {1.5: 0.5, 2.75: 0.25, 0.0: -1.0, 5.0: -2.0}),
        ({}, (0.0, 1e300), (NAN, INF), {0.0: NAN}),
    ],
)
def test_limits_hold_up_to_their_edges_and_margins_count_from_bounds(limits, holds, not_holds, margins):
    one = Expectation(**limits)
    assert [one.holds(x) for x in (*holds, *not_holds)] == [True] * len(holds) + [False] * len(not_holds)
    assert {x: one.margin(x) for x in margins} == pytest.approx(margins, nan_ok=True)


def claim(verdict="reproduced", reason="so it is", where="Table 1", **keywords):
    return Claim(verdict=verdict, reason=reason, where=where, **keywords)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"published": 2.0}, ""),
        ({"published": 2.0, "reason": ""}, ""),
        ({"published": 2.0, "reason": "", "verdict": "refuted"}, "the verdict refuted needs a reason"),
        ({"published": 2.0, "where": ""}, "at least 1 character"),
        ({}, "expected a published number, or below, above or equals"),
        ({"text": "it is fast"}, "expected a published number, or below, above or equals"),
        ({"text": "it is fast", "verdict": "not_checkable"}, ""),
        ({"verdict": "not_checkable"}, "a claim without a published number needs its text"),
        ({"below": 1.0}, "a claim without a published number needs its text"),
        ({"below": 1.0, "text": "it is fast"}, ""),
        ({"below": 1.0, "published": 2.0}, "published and below: expected one of them"),
        ({"above": 1.0, "equals": 3.0, "published": 2.0}, "published and above: expected one of them"),
        ({"published": 0.0}, "a published value of 0 needs a tolerance"),
        ({"published": 0.0, "tolerance": 0.0}, ""),
        ({"published": 0.0, "verdict": "not_checkable"}, ""),
        ({"published": 1.0, "tolerance": -0.1}, "a tolerance is not negative"),
        ({"published": 1.0, "tolerance": "2"}, "expected a number or a percentage such as '2 %'"),
        ({"published": 1.0, "tolerance": " 2e0% "}, ""),
        ({"published": 1.0, "verdict": "seen"}, "Input should be 'reproduced', 'fitted'"),
    ],
)
def test_a_claim_is_complete_or_refused(arguments, text):
    if not text:
        assert claim(**arguments)
        return
    with pytest.raises(ValidationError) as refused:
        claim(**arguments)
    assert text in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "others", "agrees", "not_agrees", "asked"),
    [
        ({"published": 2.0}, {}, (1.9, 2.1), (1.899, 2.101, NAN, INF), "2 ± 0.1 (5 %)"),
        ({"published": -0.607, "tolerance": "10 %"}, {}, (-0.6677, -0.5463), (-0.668, 0.607), "-0.607 ± 0.0607 (10 %)"),
        ({"published": 0.607, "tolerance": "2.5%"}, {}, (0.607, 0.5919), (0.5918,), "0.607 ± 0.0152 (2.5 %)"),
        ({"published": 2.0, "tolerance": 0.5}, {}, (1.5, 2.5), (1.4999, 2.5001), "2 ± 0.5"),
        ({"published": 2.0, "tolerance": 1}, {}, (1.0, 3.0), (0.999,), "2 ± 1"),
        ({"published": 0.0, "tolerance": 0.0}, {}, (0.0,), (1e-12,), "0 ± 0"),
        ({"below": 3.0}, {"below": 3.0}, (2.9999,), (3.0, 3.1, NAN), "below 3"),
        ({"above": "a.b"}, {"above": 0.69}, (0.7, INF), (0.69, 0.6), "above a.b = 0.69 here"),
        ({"above": "a.b"}, {"above": INF}, (), (1e300,), "above a.b = never here"),
        ({"above": "a.b"}, {"above": None}, (), (), "above a.b = ? here"),
        ({"equals": "b", "tolerance": 0.5}, {"equals": 4.0}, (3.5, 4.5), (3.4,), "equals b = 4 ± 0.5 here"),
        ({"equals": 4.0}, {"equals": 4.0}, (3.8, 4.2), (3.79,), "equals 4 ± 0.2 (5 %)"),
        ({"below": 3.0, "above": 1.0}, {"below": 3.0, "above": 1.0}, (2.0,), (1.0, 3.0), "below 3, above 1"),
    ],
)
def test_agreement_with_a_claim_is_as_expected(arguments, others, agrees, not_agrees, asked):
    one = claim(text="it is", **arguments)
    assert one.asks(others) == asked
    assert [one.agrees(x, others) for x in (*agrees, *not_agrees)] == [True] * len(agrees) + [False] * len(not_agrees)
    assert one.compared() == {k: v for k, v in arguments.items() if k in ("below", "above", "equals")}
    assert one.references() == [v for k, v in arguments.items() if isinstance(v, str) and k != "tolerance"]


def test_a_claim_agrees_at_the_edge_of_its_tolerance_within_rounding():
    one = claim(published=0.3, tolerance=0.1)  # 0.3 - 0.1 is not exactly 0.2
    assert one.agrees(0.2)
    assert one.agrees(0.4)
    assert not one.agrees(0.3 - 0.1 * (1.0 + 2e-9))
    assert one.agrees(0.3 - 0.1 * (1.0 + 0.9e-9))


def test_verdicts_and_their_words_are_as_expected():
    held = {
        v: [claim(v, published=1.0).holds(agrees) for agrees in (True, False)]
        for v in ("reproduced", "fitted", "corrected", "refuted", "not_checkable")
    }
    assert held == {
        "reproduced": [True, False],
        "fitted": [True, False],
        "corrected": [True, False],
        "refuted": [False, True],
        "not_checkable": [True, True],
    }
    assert [readable(x) for x in (INF, -INF, 0.1234567, 3.0)] == ["never", "-inf", "0.123457", "3"]


@pytest.mark.parametrize(
    ("edge", "pairs"),
    [
        ("", {(0.5, 0.0): -INF, (0.51, 0.0): INF, (1.0, NAN): INF, (0.0, NAN): -INF, (NAN, 1.0): NAN}),
        ("rising", {(1.0, 0.9): INF, (1.0, 1.0): -INF, (0.9, 1.0): -INF, (1.0, NAN): NAN, (NAN, 1.0): NAN}),
        ("falling", {(1.0, 0.9): -INF, (1.0, 1.0): -INF, (0.9, 1.0): INF, (0.0, NAN): NAN, (NAN, 1.0): NAN}),
        ("changed", {(1.0, 0.9): INF, (1.0, 1.0): -INF, (0.9, 1.0): INF, (0.0, NAN): NAN, (NAN, 1.0): NAN}),
    ],
)
def test_conditions_decide_and_are_undefined_for_figures_without_a_number(edge, pairs):
    results = {pair: float(truth(Condition("x", edge), *pair)) for pair in pairs}
    assert results == pytest.approx(pairs, nan_ok=True)
    assert Condition("x", edge).variable == f"_{edge or 'true'}__x"


SAID = {"motor.i_max": 10.0, "law.set_point": -4.0, "load.times.1": 0.5, "name": "word", "on": True}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("at most $motor.i_max", {"at_most": 10.0}),
        ("at least 0.95 * $motor.i_max - 1", {"at_least": 8.5}),
        ("between -$motor.i_max and max($motor.i_max, 3)", {"at_least": -10.0, "at_most": 10.0}),
        ("$law.set_point +- 5 %", {"expected": -4.0, "tolerance": 0.2}),
        ("2 * $law.set_point +- $load.times.1 / 4", {"expected": -8.0, "tolerance": 0.125}),
        ("$law.set_point", {"expected": -4.0, "tolerance": 0.0}),
        ("sqrt($motor.i_max ^ 2) +- 0", {"expected": 10.0, "tolerance": 0.0}),
        ("at most $motor.i", "no motor.i"),
        ("at most $name", r"\$name is 'word', expected a number"),
        ("at most $on", r"\$on is True, expected a number"),
        ("at most $motor.i_max / 0", "is not a number"),
        ("at most $motor.i_max ** 9999", "is not a number"),
        ("at most open($motor.i_max)", "is not a number"),
        ("at most ($motor.i_max).real", "is not a number"),
        ("at most [$motor.i_max]", "is not a number"),
        ("about $motor.i_max", "is not a number"),
        ("between $motor.i_max and 3", "nothing is"),
        ("between $motor.i_max", "expected a number"),
        ("3 +- -$motor.i_max", "a tolerance is not negative"),
    ],
)
def test_an_expectation_refers_to_numbers_of_nodes(text, expected):
    def reported(name):
        if name not in SAID:
            raise ScenarioError(f"no {name}")
        return SAID[name]

    parsed = parse(text)
    assert parsed.follows
    with pytest.raises(ScenarioError, match="refers to parameters of nodes"):
        parsed.holds(0.0)
    if isinstance(expected, str):
        with pytest.raises(ScenarioError, match=expected):
            parsed.resolved(reported)
        return
    assert parsed.resolved(reported).model_dump(exclude_none=True, exclude={"text"}) == pytest.approx(
        expected, rel=1e-15
    )
    assert parsed.resolved(reported).resolved(reported) == parsed.resolved(reported)


def test_a_number_in_an_expectation_belongs_to_the_machine_unless_it_is_zero():
    assert parse("0 +- 0").follows
    assert parse("at least 0").follows
    assert not parse("0 +- 0.01").follows
    assert not parse("at most 3").follows
    assert not parse(1).follows
