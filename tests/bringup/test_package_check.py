"""The tests that `colcon test` runs for each package, and that they notice errors."""

from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import pytest
from softrig_core import Block, BlockParams, Plant, param, scalars
from softrig_core.rig.package_check import check_entry_point, entry_points

PACKAGES = sorted(p.parent for p in (Path(__file__).parents[2] / "ros_pkgs").glob("*/package.xml"))


class Steady(Plant):
    OUTPUTS = (scalars("state", "state", {"x": "m"}),)

    def first(self):
        return 1.0

    def outputs(self, x, t):
        return {"state": (x,)}

    def advance(self, x, t):
        return x


class Twice(Block):
    OUTPUTS = (scalars("a", "same", {"x": "m"}), scalars("b", "same", {"x": "m"}))


class Drifting(Steady):
    made = 0

    def first(self):
        Drifting.made += 1
        return float(Drifting.made)


class Infinite(Steady):
    def first(self):
        return float("inf")


class Counting(Steady):
    seen = 0

    def outputs(self, x, t):
        Counting.seen += 1
        return {"state": (float(Counting.seen),)}


class Keeping(Steady):
    def setup(self):
        self.kept = []

    def advance(self, x, t):
        self.kept.append(x)
        return x


class Gain(BlockParams):
    k: float = param(..., "gain")


class Needs(Steady):
    Params = Gain


def point(target, monkeypatch):
    monkeypatch.setattr(EntryPoint, "load", lambda self: target)
    return EntryPoint("it", "somewhere:main", "console_scripts")


def test_a_sound_block_passes_and_one_without_defaults_is_reported(monkeypatch):
    # An executable that is a plain function counts as a tool.
    assert check_entry_point(point(Block.update, monkeypatch)) == ""
    for block, left in ((Steady, ""), (Needs, "it has no defaults to begin with: parameter k")):
        main = lambda: None  # noqa: E731
        main.block = block
        assert check_entry_point(point(main, monkeypatch)).startswith(left)


@pytest.mark.parametrize(
    ("block", "what"),
    [
        (Counting, "after a reset"),
        (Keeping, r"its ticks change self\.kept in place \(Keeping\)"),
        (Twice, "outputs a and b both publish 'same'"),
        (Drifting, "after a reset"),
        (Infinite, "state x/position became inf"),
    ],
)
def test_an_unsound_block_fails(monkeypatch, block, what):
    main = lambda: None  # noqa: E731
    main.block = block
    with pytest.raises(Exception, match=what):
        check_entry_point(point(main, monkeypatch))


def test_an_object_that_cannot_be_called_is_not_an_executable(monkeypatch):
    with pytest.raises(TypeError, match="expected a function"):
        check_entry_point(point(SimpleNamespace(block=Steady), monkeypatch))


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.name)
def test_every_package_has_such_tests(package):
    assert f'package_tests("{package.name}")' in (package / "test" / f"test_{package.name}.py").read_text()
    assert entry_points(package.name)
