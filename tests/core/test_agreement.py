"""Nodes of a rig that must agree on a quantity."""

import math

import numpy as np
import pytest
from softrig_core import Block, BlockParams, Figure, Rig, ScenarioError, evaluate, figure, param
from softrig_core.rig.agreement import agreed_values, agreeing, assumptions


class MassParams(BlockParams):
    """A mass, and what it carries."""

    mass: float = param(2.0, "mass", "kg")
    loads: tuple[float, ...] = param((1.0, 2.0), "loads", "kg")


class Judge(Block[MassParams]):
    """States the mass."""

    @classmethod
    def agreed(cls, params):
        """The mass, and what it carries."""
        return {"cart/mass": params.mass, "cart/loads": params.loads}

    def update(self, x, t):
        """Publish nothing."""
        return x, {}


class Law(Judge):
    """Assumes a value of its own."""

    agreed = Block.agreed

    @classmethod
    def assumed(cls, params):
        """The assumed mass of the cart."""
        return {"cart/mass": params.mass, "cart/colour": "red"}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"mass": 3.0}, "rig: one and other must agree on cart/mass, but one has 2 and other has 3"),
        ({"loads": (1.0, 2.5)}, "must agree on cart/loads, but one has .1.0, 2.0. and other has .1.0, 2.5."),
        ({"loads": (1.0,)}, "must agree on cart/loads"),
    ],
)
def test_nodes_that_state_one_quantity_must_agree(change, text):
    Rig.from_blocks({"one": Judge(), "other": Judge(), "law": Law(**change)}, 1.0)
    with pytest.raises(ScenarioError, match=text):
        Rig.from_blocks({"one": Judge(), "other": Judge(**change)}, 1.0)


def test_the_last_digit_of_a_product_is_not_a_disagreement():
    rig = Rig.from_blocks({"one": Judge(mass=0.3), "other": Judge(mass=0.1 * 3.0)}, 1.0)
    masses = [m.params.mass for m in rig.members if m.name != rig.clock.name]
    assert masses == [0.3, 0.1 * 3.0]


def test_an_assumption_of_a_controller_may_differ_and_is_reported():
    rig = Rig.from_blocks({"one": Judge(), "law": Law(mass=3.0)}, 1.0)
    assert assumptions(rig.members) == ["law takes cart/mass to be 3, one has 2"]
    assert assumptions(Rig.from_blocks({"one": Judge(), "law": Law()}, 1.0).members) == []


def test_an_argument_of_a_figure_can_refer_to_a_node():
    text = agreed_values(Rig.from_blocks({"one": Judge(mass=3.0)}, 1.0).members)
    agreed = {"mass": "cart/mass"}
    assert agreeing(text, {"band": 0.1}, agreed) == {"band": 0.1, "mass": 3.0}
    assert agreeing(text, {"mass": 3}, agreed) == {"mass": 3}
    with pytest.raises(ScenarioError, match="argument mass = 2, but one has 3; leave it out"):
        agreeing(text, {"mass": 2.0}, agreed)
    assert agreeing({}, {"mass": 2.0}, agreed) == {"mass": 2.0}  # the recording has no such node
    with pytest.raises(ScenarioError, match="argument mass is missing, since no node of the rig defines its cart/mass"):
        agreeing({}, {}, agreed)


@pytest.mark.parametrize(
    ("value", "fits"),
    [
        (0.0, True),
        (100.0, True),
        (100.0 + 1e-8, True),
        (100.1, False),
        (-0.1, False),
        (209.9, False),
        (math.nan, True),
    ],
)
def test_an_impossible_figure_is_not_a_result(value, fits):
    @figure("%", possible=(0.0, 100.0))
    def share(signals):
        return value

    if fits:
        assert Figure("share", share, {}, "%", 1.0)({}) == pytest.approx(value, nan_ok=True)
    else:
        with pytest.raises(ValueError, match="is impossible, expected 0 to 100"):
            Figure("share", share, {}, "%", 1.0)({})


def test_an_impossible_figure_fails_even_without_an_expectation(monkeypatch):
    @figure("%", possible=(0.0, 100.0))
    def share(signals):
        return 340.0

    monkeypatch.setattr("softrig_core.verdict.figures.find", lambda name: share)
    rig = Rig.from_blocks({"one": Judge()}, 1.0, figures={"share": {}})
    (result,) = evaluate(rig, {})
    assert (result.value, result.passed) == (None, False)
    assert "340 is impossible" in result.error


def test_levels_of_a_step_come_from_signals():
    t = np.linspace(0.0, 2.0, 201)
    asked = np.where(t < 1.0 - 1e-9, 2.0, 6.0)
    x = np.where(t < 1.0, 2.0, 6.0 - 4.0 * np.exp(-np.maximum(t - 1.0, 0.0) / 0.1))
    signals = {"x": (t, x), "asked": (t, asked)}
    from softrig_core.judge.measures import rise_time

    by_hand = rise_time(signals, "x", final=6.0, initial=2.0, start=1.0)
    assert rise_time(signals, "x", final="asked", initial="asked", start=1.0) == by_hand
    assert by_hand == pytest.approx(0.1 * math.log(9.0), rel=0.01)
    reported = Figure("rise", rise_time, {"signal": "x", "final": "asked", "initial": "asked", "start": 1.0}, "s", 1.0)
    assert reported.at(signals).arguments == {"signal": "x", "final": 6.0, "initial": 2.0, "start": 1.0}
    with pytest.raises(ValueError, match="asked has no value before the begin of the window"):
        rise_time(signals, "x", final=6.0, initial="asked")
