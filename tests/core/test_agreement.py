"""Nodes of a rig that must mean the same."""

import pytest
from softrig_core import Block, BlockParams, Rig, ScenarioError, param


class MassParams(BlockParams):
    """A mass, and what it carries."""

    mass: float = param(2.0, "mass", "kg")
    loads: tuple[float, ...] = param((1.0, 2.0), "loads", "kg")


class Judge(Block[MassParams]):
    """Speaks of the mass."""

    @classmethod
    def agreed(cls, params):
        """The mass, and what it carries."""
        return {"cart/mass": params.mass, "cart/loads": params.loads}

    def update(self, t):
        """Say nothing."""
        return {}


class Law(Judge):
    """Has an idea of its own of it."""

    agreed = Block.agreed


@pytest.mark.parametrize(("change", "text"), [
    ({"mass": 3.0}, "rig: one and other must agree on cart/mass, but one has 2 and other has 3"),
    ({"loads": (1.0, 2.5)}, "must agree on cart/loads, but one has .1.0, 2.0. and other has .1.0, 2.5."),
    ({"loads": (1.0,)}, "must agree on cart/loads"),
])  # fmt: skip
def test_those_who_speak_of_one_quantity_must_agree(change, text):
    Rig.from_blocks({"one": Judge(), "other": Judge(), "law": Law(**change)}, 1.0)
    with pytest.raises(ScenarioError, match=text):
        Rig.from_blocks({"one": Judge(), "other": Judge(**change)}, 1.0)


def test_the_last_digit_of_a_product_is_no_disagreement():
    Rig.from_blocks({"one": Judge(mass=0.3), "other": Judge(mass=0.1 * 3.0)}, 1.0)
