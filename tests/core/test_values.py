"""State as a value: what the contract promises, and the rule that enforces it."""

import ast
import inspect
import sys
import textwrap
from pathlib import Path

import pytest
from softrig_core import Block, BlockParams, ByHand, Level, Plant, load_scenario, rig_of
from softrig_core.block.block import Observer
from softrig_core.block.loop import Loop
from softrig_core.block.tables import Tables
from softrig_core.kit.draws import SIZE
from softrig_core.kit.floats import numbers, put, read, split
from softrig_core.rig.installed import load_block
from softrig_core.run.inprocess import wired

sys.path.insert(0, str(Path(__file__).parents[1] / "campaign"))
from parameters import executables

# The state of a library or a simulated board is not an attribute of the block. These blocks write the library or the
# board when they load a state.
HOLDERS = {"softrig_control/c_controller", "softrig_control/c_plant", "softrig_drives/dc_motor_uno"}
BLOCKS = {f"{package}/{name}": cls for package, name, cls in executables() if f"{package}/{name}" not in HOLDERS}
MUTATING = {"append", "extend", "insert", "pop", "popleft", "appendleft", "clear", "remove", "add", "discard", "update",
            "setdefault", "sort", "reverse", "rotate", "popitem"}  # fmt: skip


def own_classes(cls):
    """Return a block's classes below the contract."""
    return [c for c in cls.__mro__ if issubclass(c, Block) and c not in (Block, Plant, Observer)]


def of_self(node):
    """Return whether an expression reaches through self."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        node = node.value
    return isinstance(node, ast.Name) and node.id == "self"


def written(cls):
    """Return (method, line) of what a class writes into itself outside `setup`."""
    result = []
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    for method in body.body:
        if not isinstance(method, ast.FunctionDef) or method.name in ("setup", "__init__", "reset"):
            continue
        for node in ast.walk(method):
            targets = getattr(node, "targets", None) or [getattr(node, "target", None)]
            flat = [t for target in targets if target is not None for t in ast.walk(target)]
            stored = isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign | ast.Delete | ast.For) and any(
                isinstance(t, ast.Attribute | ast.Subscript) and isinstance(t.ctx, ast.Store | ast.Del) and of_self(t)
                for t in flat
            )
            called = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
            mutated = (
                called and node.func.attr in MUTATING and isinstance(node.func.value, ast.Attribute | ast.Subscript)
            )
            if stored or (mutated and of_self(node.func.value)):
                result.append((method.name, ast.unparse(node)[:60]))
    return result


@pytest.mark.parametrize("name", BLOCKS)
def test_a_block_writes_nothing_outside_setup(name):
    cls = BLOCKS[name]
    assert {c.__name__: w for c in own_classes(cls) if (w := written(c))} == {}
    assert not [c.__name__ for c in own_classes(cls) if "change" in vars(c)]
    method = cls.outputs if issubclass(cls, Plant) else cls.update
    assert method.__code__.co_varnames[1] == "x"


def test_the_rule_finds_what_is_written():
    class Bad(Block):
        def update(self, x, t):
            self.a, b = 1, 2
            self.rows[0] = b
            self.line.append(b)
            return x, {}

    assert [name for name, _ in written(Bad)] == ["update"] * 3


class Noise(Block[BlockParams]):
    def first(self):
        return 0

    def update(self, x, t):
        self.report(Level.WARN, "drawn", "once more")
        return x + 1, {"n": (self.standard_normal(x), self.uniform(x))}


def test_random_numbers_by_index_are_those_of_the_stream():
    block = Noise(name="n")
    block.reset(3)
    normal = block.generator().standard_normal(3 * SIZE)
    for k in (0, 1, SIZE - 1, SIZE, 3 * SIZE - 1, 7, 2 * SIZE, 0):
        assert block.standard_normal(k) == normal[k]
    one_by_one = block.generator()
    assert [block.uniform(k) for k in range(50)] == [one_by_one.random() for _ in range(50)]
    first = block.standard_normal(5)
    block.reset(4)
    assert block.standard_normal(5) != first


def test_a_discarded_tick_has_reported_nothing_and_draws_again():
    node = ByHand(Noise(name="n"))
    node.update(0)
    saved = node.save()
    after = node.update(1)
    node.block.update(node.x, 2)  # a trial tick, whose result is dropped
    node.drop()
    assert node.reports["drawn"][2] == 2
    node.load(saved)
    assert node.reports["drawn"][2] == 1
    assert node.update(1) == after


@pytest.mark.parametrize(
    ("name", "duration"),
    [("dc_motor_smc_b2", 0.1), ("dc_motor_smc_b5_pid", 0.1), ("induction_dtc", 0.005), ("dc_motor_smc_faults", 0.1),
     ("dc_motor_fsfb_stretch_jitter", 0.2), ("rectifier_mpc_seed19", 0.02), ("rehab_impedance_r5", 0.05),
     ("rehab_impedance_r4_arsc", 0.05), ("tcp_aqm_smc", 0.05), ("tcp_aqm_smc_s4", 0.5), ("pwa_delay_p3", 0.05),
     *(pytest.param(*case, marks=pytest.mark.long) for case in (("pwa_delay", 0.05), ("pwa_delay_p2_d2", 0.5)))],
)  # fmt: skip
def test_going_back_to_any_tick_repeats_it(name, duration):
    rig = rig_of(load_scenario(name).changed(duration=duration))
    steps = wired(rig, {m.name: m.block(1) for m in rig.members})
    ticks, states = Loop(list(steps.values())).run(), []
    for _ in range(5):
        next(ticks)
    tables = Tables(steps.values())
    kept = tables.keep()
    for _ in range(4):
        next(ticks)
        states.append({n: s.x for n, s in steps.items()})
    tables.go_back(kept)
    again = Loop(list(steps.values())).run(5)
    for before in states:
        next(again)
        assert {n: s.x for n, s in steps.items()} == before


def test_the_floats_of_a_state():
    block = load_block("softrig_drives", "dc_motor_smc")()
    x = block.first()
    assert [name for name, _ in read(x)] == ["r", "size", "wd"]
    assert put(x, split(x, numbers(x))) is x
    other = put(x, split(x, numbers(x) + 1.0))
    assert (other.r, other.w, other.wd) == (11.0, None, 1.0)


def test_a_block_without_a_state_argument_is_refused_at_its_definition():
    with pytest.raises(TypeError, match=r"Old\.update\(self, t, \.\.\.\): expected update\(self, x, t, \.\.\.\)"):

        class Old(Block):
            def update(self, t, **inputs):
                return {}
