"""Objects that the runs of a study share are made once, and equal those that each run would have made."""

from __future__ import annotations

import pickle
from typing import Any, NamedTuple

import pytest
from softrig_core import Block, BlockParams, Level, Port, ScenarioError, param
from softrig_core.block.held import RunningBlock
from softrig_core.block.params import ParameterError, build
from softrig_core.kit.newest import KEPT, once_for_objects, shared
from softrig_core.run.expand import rig_of
from softrig_core.scenario.scenario import Scenario, read_draft

OVERRIDES = {
    "one node": {"dc_motor_smc.delta": 0.5},
    "two nodes": {"dc_motor_smc.delta": 0.5, "dc_motor_plant.R": 0.41},
    "a shared value": {"late": 1.5},
    "a fault": {"dc_motor_smc.delta": 0.5, "drift.value": [0.1]},
}


@pytest.mark.parametrize("values", OVERRIDES.values(), ids=OVERRIDES)
def test_a_draft_with_changed_values_equals_the_scenario_checked_as_a_whole(values):
    draft = read_draft("dc_motor_smc_faults" if "drift.value" in values else "dc_motor_smc_b2")
    quick, whole = draft.filled(values), Scenario.model_validate(draft.filled(values).model_dump())
    assert quick.model_dump() == whole.model_dump()
    for key, value in values.items():
        node, _, parameter = key.partition(".")
        if node in quick.nodes:
            assert quick.nodes[node].parameters[parameter] == value
        else:
            result = quick.faults[node].value if parameter else quick.shared[key]
            assert result == value
    assert draft.filled() is draft.filled()  # a change does not affect the draft that it was made from
    assert draft.filled().model_dump() == read_draft(draft.name).filled().model_dump()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"dc_motor_smc.delta": "$nothing"}, "nothing"),
        ({"dc_motor_smc.delta": float("inf")}, "delta"),
        ({"dc_motor_smc.detla": 1.0}, "did you mean 'delta'"),
    ],
)
def test_a_wrong_changed_value_is_refused_as_in_a_file(values, message):
    with pytest.raises(ScenarioError, match=message):
        rig_of(read_draft("dc_motor_smc_b2"), overrides=values)


def test_equal_drafts_that_a_process_receives_are_one_object():
    draft = read_draft("dc_motor_smc_b2")
    first, again = (pickle.loads(pickle.dumps(draft)) for _ in range(2))
    assert first is again
    assert (first.name, first.path, first.raw) == (draft.name, draft.path, draft.raw)
    assert first.filled({"dc_motor_smc.delta": 0.5}) == draft.filled({"dc_motor_smc.delta": 0.5})
    assert pickle.loads(pickle.dumps(read_draft("dc_motor_smc"))).name == "dc_motor_smc"


def test_rigs_of_one_scenario_share_what_depends_on_it_alone():
    draft = read_draft("dc_motor_smc_b2")
    one, two = rig_of(draft), rig_of(draft, overrides={"dc_motor_smc.delta": 0.25})
    for a, b in zip(one.members, two.members, strict=True):
        assert a is not b
        assert a.links is not b.links
        assert (a.params is b.params) == (a.name != "dc_motor_smc")
        assert [p is q for p, q in zip(a.inputs, b.inputs, strict=True)] == [True] * len(a.inputs)


class Params(BlockParams):
    gain: float | bool = param(1.0, "gain", live=True)


def test_equal_numbers_of_different_types_are_different_values():
    one, whole, switch = (shared(build, Params, {"gain": v}) for v in (1.0, 1, True))
    assert [type(p.gain) for p in (one, switch)] == [float, bool]
    assert whole is not one
    assert shared(build, Params, {"gain": 1.0}) is one
    for _ in range(2):  # an error is raised again and not cached
        with pytest.raises(ParameterError, match="gain"):
            shared(build, Params, {"gain": "much"})
    assert shared(lambda of, values: values, Params, unpicklable := lambda: 0) is unpicklable


def test_an_answer_is_cached_by_the_identity_of_the_arguments():
    calls: list[Any] = []

    @once_for_objects
    def answer(*arguments: Any) -> int:
        calls.append(arguments)
        return len(calls)

    a, b = [1], [1]
    assert [answer(a), answer(b), answer(a), answer(a, b)] == [1, 2, 1, 3]
    for k in range(2 * KEPT):  # Python reuses the identity of a deleted list
        assert answer([k]) == len(calls)
        assert calls[-1] == ([k],)


class State(NamedTuple):
    drawn: float


class Odd(Block[Params]):
    OUTPUTS = (Port("y", "y", "std_msgs/msg/Float64", (), ("data",), ("1",)),)

    def setup(self) -> None:
        Odd.firsts = 0

    def first(self) -> State:
        Odd.firsts += 1
        self.report(Level.WARN, "odd", f"gain {self.p.gain:g}")
        return State(self.uniform(0))


def test_the_first_state_is_made_once_with_the_seed_and_reported_once():
    block = Odd.seeded(Params(), "odd", 3)
    assert (Odd.firsts, block.reports) == (1, {})
    running = RunningBlock(block)
    by_hand = Odd(Params(), "odd")
    by_hand.reset(3)
    assert (running.x, running.reports["odd"]) == (by_hand.first(), (Level.WARN, "gain 1", 1))
    assert RunningBlock(Odd.seeded(Params(), "odd", 4)).x != running.x
    again = RunningBlock(block)  # a block that has run is created again
    assert (again.x, again.reports["odd"][2]) == (running.x, 1)
    changed = Odd.seeded(Params(), "odd", 3)
    changed.change(Params(gain=2.0))
    assert RunningBlock(changed).reports["odd"][1] == "gain 2"
