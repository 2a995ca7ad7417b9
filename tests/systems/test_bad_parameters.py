"""Parameters that are within their bounds, and do not fit: each is refused by a message that says what and why."""

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


@pytest.mark.parametrize("row", ROWS)
def test_what_does_not_fit_is_named(row):
    executable, values, said = re.fullmatch(r"([\w.]+) (\{.*\}) -> (.*)", row).groups()
    block = BLOCKS[executable]
    with pytest.raises((ParameterError, ValueError), match=re.escape(said)):
        block.ports(block(build(block.Params, yaml.safe_load(values))).p)
