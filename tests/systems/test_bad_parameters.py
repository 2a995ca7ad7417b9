"""Parameters within their bounds that contradict each other: each is refused by a message that says what and why.

And parameters that just fit, on the edge of what is refused: each is taken.
"""

import re
import sys
from pathlib import Path

import pytest
import yaml
from softrig_core import ParameterError
from softrig_core.block.params import build

sys.path.insert(0, str(Path(__file__).parents[1] / "campaign"))
from parameters import blocks

BLOCKS = {f"{package.removeprefix('softrig_')}.{name}": block for package, name, block in blocks()}
ROWS = (Path(__file__).parent / "bad_parameters.txt").read_text().splitlines()
FITTING = (Path(__file__).parent / "fitting_parameters.txt").read_text().splitlines()


@pytest.mark.parametrize("row", ROWS)
def test_a_contradiction_is_named(row):
    executable, values, text = re.fullmatch(r"([\w.]+) (\{.*\}) -> (.*)", row).groups()
    block = BLOCKS[executable]
    with pytest.raises((ParameterError, ValueError), match=re.escape(text)):
        block.ports(block(build(block.Params, yaml.safe_load(values))).p)


@pytest.mark.parametrize("row", FITTING)
def test_a_combination_that_just_fits_is_accepted(row):
    executable, values = re.fullmatch(r"([\w.]+) (\{.*\})", row).groups()
    block = BLOCKS[executable]
    block.ports(block(build(block.Params, yaml.safe_load(values))).p)
