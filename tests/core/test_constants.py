"""Everything that a block stores outside x is constant: a tick that writes it is refused at its line, one that changes
it in place later.
"""

import random
import re
from collections import deque
from inspect import getsourcelines
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from softrig_core import Block, BlockParams, ByHand, Plant, Rig, RunError, Session, param, scalars, simulate
from softrig_core.kit.history import History
from softrig_core.kit.newest import Newest
from softrig_core.rig.contents import contents, differing


class Params(BlockParams):
    period: float = param(0.1, "period", "s", gt=0.0)
    k: float = param(1.0, "gain", live=True)


class Law(Block[Params]):
    """Publishes k; each test adds a forbidden habit."""

    OUTPUTS = (scalars("u", "u", {"x": "1"}),)
    habit = staticmethod(lambda law, t: None)

    def setup(self):
        self.gain = self.p.k  # the message names this line
        self.kept, self.table = [], {"n": 0}
        self.helped()

    def helped(self):
        self.twice = 2.0 * self.p.k

    def update(self, x, t):
        type(self).habit(self, t)
        return x, {"u": (self.gain,)}


def law(habit, **keys):
    """A new class that has not been examined yet."""
    return type("Bad", (Law,), {"habit": staticmethod(habit), **keys})


def run(block_class, duration=1.0, **keys):
    return simulate(Rig.from_blocks({"law": block_class()}, duration), **keys)


class Rebinding(Law):
    def update(self, x, t):
        self.count = t  # the message names this line
        return x, {"u": (0.0,)}


class ByHelper(Law):
    def update(self, x, t):
        def inner():
            self.gain += 1.0  # the message names this line

        inner()
        return x, {"u": (0.0,)}


class Deleting(Law):
    def update(self, x, t):
        del self.gain  # the message names this line
        return x, {"u": (0.0,)}


class Again(Law):
    def update(self, x, t):
        self.setup()  # `setup` may do this, but a tick that calls it may not
        return x, {"u": (0.0,)}


class Swallowing(Law):
    def update(self, x, t):
        try:
            self.n += 1
        except AttributeError:
            self.n = 0  # the message names this line
        return x, {"u": (0.0,)}


class Moving(Plant[Params]):
    OUTPUTS = (scalars("u", "u", {"x": "1"}),)

    def outputs(self, x, t):
        return {"u": (0.0,)}

    def advance(self, x, t):
        self.helped(self)
        return x

    def helped(self, other):
        setattr(other, "n", 1)  # noqa: B010 # the message names this line


@pytest.mark.parametrize(
    ("block", "method", "name"),
    [(Rebinding, "update", "count"), (ByHelper, "update", "gain"), (Deleting, "update", "gain"),
     (Again, "update", "gain"), (Swallowing, "update", "n"), (Moving, "advance", "n")],
)  # fmt: skip
def test_a_tick_that_writes_an_attribute_is_refused_at_its_line(block, method, name):
    with pytest.raises(RunError) as message:
        run(block)
    lines, first = getsourcelines(Law if block is Again else block)
    line = next(k for k, text in enumerate(lines, first) if text.endswith("# the message names this line\n"))
    assert str(message.value) == (
        f"law: `{method}` writes self.{name} ({__file__}, line {line}); make it a field of x and return the new x"
    )
    assert message.value.node == "law"


def test_an_attribute_is_protected_in_a_session_and_in_a_rig_of_objects_too():
    with pytest.raises(RunError, match=r"Rebinding: `update` writes self\.count"):
        ByHand(Rebinding()).update(0)
    session = Session(Rig.from_blocks({"law": Rebinding()}, 1.0))
    with pytest.raises(RunError, match=r"law: `update` writes self\.count"):
        session.step()


def test_setup_change_reset_and_code_outside_may_write():
    block = Law(k=2.0)
    block.change(Params(k=3.0))
    assert (block.gain, block.twice) == (3.0, 6.0)
    block.reset(5)
    block.gain = 7.0  # a change from outside between two ticks is allowed
    assert ByHand(block).update(0) == {"u": (7.0,)}

    class Late(Law):
        def __init__(self, *arguments, **values):
            self.early = 1
            super().__init__(*arguments, **values)
            self.late = 2

    assert (Late().early, Late().late) == (1, 2)


class Helper:
    def __init__(self):
        self.n = 0

    def count(self):
        self.n += 1


def closure():
    n = [0]
    return lambda: n.append(1)


IN_PLACE = {
    "list": (lambda law, t: law.kept.append(t), "self.kept"),
    "dict": (lambda law, t: law.table.update(n=t), "self.table"),
    "array": (lambda law, t: law.held.__setitem__(0, t), "self.held", lambda: np.zeros(2)),
    "deque": (lambda law, t: law.held.append(t), "self.held", lambda: deque(maxlen=3)),
    "set": (lambda law, t: law.held.add(t), "self.held", set),
    "bytes": (lambda law, t: law.held.append(t % 7), "self.held", bytearray),
    "helper": (lambda law, t: law.held.count(), "self.held", Helper),
    "deep": (lambda law, t: law.held[0]["a"].count(), "self.held", lambda: [{"a": Helper()}]),
    "generator": (lambda law, t: law.held.normal(), "self.held", lambda: np.random.default_rng(0)),
    "random": (lambda law, t: law.held.random(), "self.held", lambda: random.Random(0)),
    "count": (lambda law, t: next(law.held), "self.held", count),
    "iterator": (lambda law, t: next(law.held), "self.held", lambda: (k for k in range(100))),
    "closure": (lambda law, t: law.held(), "self.held", closure),
    "around": (lambda law, t: vars(law).update(n=t), "self.n"),
    "class": (lambda law, t: type(law).seen.append(t), "Bad.seen"),
    "number of the class": (lambda law, t: setattr(type(law), "number", t), "Bad.number"),
}


@pytest.mark.parametrize("habit", IN_PLACE)
@pytest.mark.parametrize("session", [False, True])
def test_a_tick_that_changes_an_attribute_in_place_is_named_after_the_second(habit, session):
    does, name, *held = IN_PLACE[habit]

    def setup(self):
        Law.setup(self)
        self.held = held[0]() if held else None

    noted = frozenset({"done"})
    bad, done = law(lambda one, t: done.append(t) or does(one, t), setup=setup, seen=[], number=0, SCRATCH=noted), []
    rig = Rig.from_blocks({"law": bad()}, 1.0)
    with pytest.raises(RunError) as text:
        Session(rig).go() if session else simulate(rig)
    assert str(text.value) == (
        f"law: its ticks change {name} in place (Bad); make its state a field of x, or name the attribute in "
        "SCRATCH if no answer depends on it"
    )
    assert not session or done == [0, 100_000_000]  # the check is made at the first tick only, not at the end


def test_a_late_change_is_found_by_a_thorough_run():
    late = law(lambda one, t: one.kept.append(t) if t > 500_000_000 else None)
    Session(Rig.from_blocks({"law": late()}, 1.0)).go()  # its first two ticks keep the rule
    with pytest.raises(RunError, match=r"self\.kept in place"):
        run(late, thorough=True)


def test_scratch_caches_and_changed_parameters_are_not_state():
    def setup(self):
        Law.setup(self)
        self.cache, self.newest = {}, Newest(lambda k: k + 1)
        self.line = History(0.1, 1.0)

    def habit(one, t):
        one.cache[t] = t
        assert one.newest(t) == t + 1
        one.line.put((1.0,))
        one.uniform(3)  # computes a cached property

    fine = law(habit, setup=setup, SCRATCH=frozenset({"cache"}))
    rig = Rig.from_blocks({"law": fine()}, 1.0, changes=[{"at": 0.5, "set": {"law.k": 2.0}}])
    assert simulate(rig, thorough=True).signals["u/x"].x[-1] == 2.0


def test_a_digest_covers_everything_that_an_attribute_leads_to():
    one, other = Law(), Law()
    assert contents(one) == contents(other)
    assert not {"self.p", "self.reports", "self.events"} & contents(one).keys()
    one.kept = [one.kept, one]  # a list that contains itself
    one.kept.append(one.kept)
    assert differing(contents(one), contents(other)) == ["self.kept"]
    other.loop = [1.0]
    assert differing(contents(one), contents(other)) == ["self.kept", "self.loop"]


def test_the_examples_of_the_page_keep_their_state_in_x(capsys):
    page = (Path(__file__).parents[2] / "ros_pkgs/softrig_core/doc/model_kit.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    known = {"__name__": "page"}
    exec(next(b for b in blocks if "class Speed" in b), known)
    assert capsys.readouterr().out == "{'command': (8.0,)} State(integral=0.1)\n"
    exec(next(b for b in blocks if "def go_on" in b), known)
    known["Speed"].go_on = known["go_on"]
    block = known["law"].block
    known["law"].change(block.p.model_copy(update={"ki": 0.4}))
    # The integral part of the voltage does not jump.
    assert known["law"].x.integral * block.p.ki == pytest.approx(0.1 * 0.2)
