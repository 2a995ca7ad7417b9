"""The walks of house.md are those of the code: each function is there, and calls or names the next one."""

import ast
import re
from pathlib import Path

import pytest
from softrig_core import rig_of
from softrig_core.block.loop import Loop
from softrig_core.native.rig_text import rig_text
from softrig_core.run.inprocess import wired

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"
PAGE = (PACKAGES / "softrig_core/doc/house.md").read_text()
MESSAGE, PRINTED = (
    re.findall(r"^\| `(\S+\.py)` \| `([\w.]+)` \|", part.split("<!-- end -->")[0], flags=re.M)
    for part in PAGE.split("<!-- walk -->")[1:]
)
# how a function names the one below it in the table
CALLS = ("receive", "receive", "came", "", "_arrived", "turn", "_ticks", "say", "asked", "ask", "")


def source(module, name):
    """The text of a function or method of a module of the packages."""
    package, _, rest = module.partition("/")
    node = ast.parse(text := (PACKAGES / package / package / rest).read_text())
    for part in name.split("."):
        node = next(n for n in node.body if getattr(n, "name", "") == part)
    return ast.get_source_segment(text, node)


@pytest.mark.parametrize(("place", "then"), list(zip(MESSAGE, CALLS, strict=True)), ids=lambda v: str(v))
def test_a_message_goes_the_way_that_the_page_tells(place, then):
    assert re.search(rf"\b{then}\b", source(*place).partition("\n")[2])


@pytest.mark.parametrize("place", PRINTED, ids=lambda v: v[1])
def test_the_writers_of_ticks_are_where_the_page_says(place):
    assert re.search(r'"""(Return|Create) ', source(*place))


def test_the_texts_of_the_page_are_those_of_the_rig():
    """Python's lines stand in the law; those of native code are what is written for the rig today."""
    python, method, turn = (
        re.sub(r"^ +", "", text, flags=re.M) for text in re.findall(r"```(?:python|text)\n(.*?)```", PAGE, re.S)
    )
    rig = rig_of("dc_motor_smc_b2")
    steps = wired(rig, {m.name: m.block(0) for m in rig.members})
    next(Loop(list(steps.values())).run())
    made = rig_text([s for s in steps.values() if s.outputs], list(steps.values())).text
    law = source("softrig_drives/dc_motor/sliding_mode.py", "DcMotorSmc.update")
    for text, whole in ((python, law), (method, made), (turn, made)):
        assert text in re.sub(r"^ +|  # softrig_.*$", "", whole, flags=re.M)
