"""The walks of house.md match the code: each function exists, and calls or names the next one."""

import ast
import importlib
import re
from pathlib import Path

import pytest
from softrig_core import rig_of
from softrig_core.block.loop import Loop
from softrig_core.native.rig_text import rig_text
from softrig_core.run.inprocess import wired

# Each function of the walk calls the next one under this name.
NAMES = ("receive", "accept", "_arrived", "turn", "ticks", "_answer", "answer", "answer", "asked", "respond", "ask",
         "update")  # fmt: skip
PACKAGES = Path(__file__).parents[2] / "ros_pkgs"
PAGE = (PACKAGES / "softrig_core/doc/house.md").read_text()
MESSAGE, PRINTED = (
    re.findall(r"^\| `(\S+\.py)` \| `([\w.]+)` \|", part.split("<!-- end -->")[0], flags=re.M)
    for part in PAGE.split("<!-- walk -->")[1:]
)


def located(module, name):
    """The file of a function or method of the packages, and its syntax tree."""
    package, _, remaining = module.partition("/")
    file = PACKAGES / package / package / remaining
    node = ast.parse(file.read_text())
    for part in name.split("."):
        node = next(n for n in node.body if getattr(n, "name", "") == part)
    return file, node


def source(module, name):
    """The text of a function or method of a module of the packages."""
    file, node = located(module, name)
    return ast.get_source_segment(file.read_text(), node)


@pytest.mark.parametrize(("place", "name"), list(zip(MESSAGE[:-1], NAMES, strict=True)), ids=lambda v: str(v))
def test_a_message_follows_the_path_of_the_page(place, name):
    assert re.search(rf"\b{name}\b", source(*place).partition("\n")[2])


def dotted(module, name):
    return f"{module.removesuffix('.py').replace('/', '.')}.{name}"


def overridden(module, name):
    """The methods that a method overrides, by full name."""
    made, _, method = name.rpartition(".")
    imported = importlib.import_module(module.removesuffix(".py").replace("/", "."))
    return {f"{c.__module__}.{c.__qualname__}.{method}" for c in getattr(imported, made).__mro__} if made else set()


@pytest.mark.long
@pytest.mark.parametrize(("place", "name", "then"), list(zip(MESSAGE[:-1], NAMES, MESSAGE[1:], strict=True)))
def test_a_message_can_be_followed_by_go_to_definition(place, name, then):
    """It leads to the next function, to what that overrides, or to the assignment of an attribute that leads there."""
    jedi = pytest.importorskip("jedi")
    project = jedi.Project(PACKAGES, added_sys_path=[str(PACKAGES / p) for p in ("softrig_core", "softrig_nodes")])
    wanted = {dotted(*then)} | overridden(*then)

    def definitions(file, node, name):
        script = jedi.Script(path=file, project=project)
        for one in ast.walk(node):
            if name in (getattr(one, "attr", None), getattr(one, "id", None)):
                end = isinstance(one, ast.Attribute)
                where = (one.end_lineno, one.end_col_offset - 1) if end else (one.lineno, one.col_offset)
                yield from script.goto(*where, follow_imports=True)

    def assigned(definition):
        tree = ast.parse(Path(definition.module_path).read_text())
        lines = [n.value for n in ast.walk(tree) if isinstance(n, ast.Assign) and n.lineno == definition.line]
        for value in lines:
            yield from definitions(definition.module_path, value, then[1].rpartition(".")[2])

    first = list(definitions(*located(*place), name))
    second = [d for one in first if one.type == "statement" for d in assigned(one)]
    assert wanted & {d.full_name for d in (*first, *second)}


@pytest.mark.parametrize("place", PRINTED, ids=lambda v: v[1])
def test_the_writers_of_ticks_are_those_of_the_page(place):
    assert re.search(r'"""(Return|Create) ', source(*place))


def test_the_texts_of_the_page_are_those_of_the_rig():
    """The lines in Python are in the controller; those of native code are generated for the rig today."""
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
