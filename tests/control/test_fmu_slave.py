"""A node inside an FMU, without a tool around it: its description as text, its steps against precomputed numbers."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import pytest
from expected_text import check_expected
from softrig_core import Block, BlockParams, Plant, joint_state, param

pytest.importorskip("pythonfmu")
from pythonfmu import Fmi2Slave
from softrig_control.fmu import slave
from softrig_control.fmu.slave import Node, content, variable

PERIOD = 0.125
WANTED, PUSH = (
    joint_state("wanted", "wanted", ["x"], position=["m"], safe=(2.0,), held=True),
    joint_state("push", "cart/push", ["x", "y"], effort=["N", ""], safe=(1.0, 3.0), limits=(10.0, 20.0)),
)
ANSWER = replace(PUSH, sporadic=True, limits=(1e6, 1e6))
STATE = joint_state("state", "cart/state", ["x"], position=["mm"], velocity=["1"], safe=(0.25, 0.5))


class CartParams(BlockParams):
    gain: float = param(2.0, "gain of the push", "1/s", ge=0.0, le=8.0)
    count: int = param(3, "a whole number", ge=1)
    on: bool = param(True, "whether it moves")
    word: str = param("a", "a text")
    rows: tuple[float, ...] = param((1.0, 2.0), "numbers")

    def model_post_init(self, _):
        if self.gain == 5.0:
            raise ValueError("gain = 5: no")


class Cart(Plant[CartParams]):
    """A cart that moves as it is pushed.

    and nothing else."""

    INPUTS, OUTPUTS = (PUSH,), (STATE,)

    def first(self):
        return 0.5

    def outputs(self, x, t):
        return {"state": (x, t / 1e9)}

    def advance(self, x, t, push):
        return x + PERIOD * self.p.gain * push[0] * push[1]


class Sum(NamedTuple):
    total: float = 0.0


class Law(Block[CartParams]):
    """Adds up its inputs; publishes nothing if there are none."""

    INPUTS, OUTPUTS = (STATE, WANTED), (ANSWER,)

    def first(self):
        return Sum()

    def update(self, x, t, state, wanted):
        if state[0] > 9.0:
            raise RuntimeError("it is far")
        total = x.total + state[0] + (100.0 if wanted is None else wanted[0]) * self.p.gain
        return Sum(total), {} if state[0] == 7.0 else {"push": (total, t / 1e9)}


class Made(Node, Fmi2Slave):
    pass


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Make the content of the FMU of a block."""

    def make(block, start=None, **parameters):
        monkeypatch.setattr(slave, "load_block", lambda *arguments: {("here", "made"): block}[arguments])
        what = {
            "node": "it",
            "package": "here",
            "executable": "made",
            "seed": 3,
            "parameters": CartParams(period=PERIOD).model_dump() | {"rows": [1.0, 2.0]} | parameters,
            "topics": {"cart/push": "other/push"},
            "start": start or {},
        }
        (tmp_path / "node.json").write_text(json.dumps(what))
        return Made(instance_name="made", resources=str(tmp_path))

    return make


def at(fmu, name):
    return next(v for v in fmu.vars.values() if v.name == name)


def put(fmu, **values):
    for name, x in values.items():
        at(
            fmu,
            {
                "force": "other.push.x.effort",
                "y": "other.push.y.effort",
                "x": "cart.state.x.position",
                "wanted": "wanted.x.position",
            }.get(name, name),
        ).setter(x)


def get(fmu, *names):
    return [at(fmu, name).getter() for name in names]


X, SPEED = "cart.state.x.position", "cart.state.x.velocity"


def lines(element, depth=0):
    entries = {k: v for k, v in element.attrib.items() if not k.startswith("generation") and k != "guid"}
    yield "  " * depth + " ".join([element.tag, *(f"{k}={v!r}" for k, v in entries.items())])
    for part in element:
        if element.tag != "LogCategories" and part.tag != "LogCategories":
            yield from lines(part, depth + 1)


def test_the_description_is_as_expected(made):
    check_expected("fmu/slave", [*lines(made(Cart).to_xml()), *lines(made(Law, {"state": [4.0, 6.0]}).to_xml({}))])


def test_a_plant_outputs_the_state_at_the_end_of_a_step(made):
    fmu = made(Cart, {"push": [0.5, 4.0]})
    assert get(fmu, X, SPEED, "other.push.x.effort", "other.push.y.effort") == [0.5, 0.0, 0.5, 4.0]
    assert fmu.do_step(0.0, PERIOD)
    assert get(fmu, X, SPEED) == [0.5 + PERIOD * 2.0 * 0.5 * 4.0, PERIOD]
    put(fmu, force=-1.0, y=2.0)
    assert fmu.do_step(PERIOD, 3 * PERIOD)  # one call over three periods, in which the inputs hold
    assert get(fmu, X, SPEED) == [1.0 - 3 * PERIOD * 2.0 * 2.0, 4 * PERIOD]
    assert not fmu.log_queue
    fmu = made(Cart)
    # Safe values, because no message has arrived.
    assert get(fmu, "other.push.x.effort", "other.push.y.effort") == [1.0, 3.0]


def test_a_controller_outputs_its_answer_and_holds_it_while_it_is_silent(made):
    fmu = made(Law, {"wanted": [0.5]})
    # Safe values before the first message.
    assert get(fmu, "other.push.x.effort", "other.push.y.effort") == [1.0, 3.0]
    put(fmu, x=4.0)
    assert fmu.do_step(0.0, 2 * PERIOD)
    assert get(fmu, "other.push.x.effort", "other.push.y.effort") == [10.0, PERIOD]
    put(fmu, x=7.0)
    assert fmu.do_step(2 * PERIOD, PERIOD)
    assert get(fmu, "other.push.x.effort") == [10.0]
    put(fmu, x=0.0)
    assert fmu.do_step(3 * PERIOD, PERIOD)
    assert get(fmu, "other.push.x.effort", "other.push.y.effort") == [19.0, 3 * PERIOD]


def test_an_optional_input_has_no_value_until_it_is_set(made):
    fmu = made(Law)
    put(fmu, x=1.0)
    assert fmu.do_step(0.0, PERIOD)
    assert get(fmu, "other.push.x.effort", "wanted.x.position") == [201.0, 2.0]
    put(fmu, wanted=0.0)
    assert fmu.do_step(PERIOD, PERIOD)
    assert get(fmu, "other.push.x.effort") == [202.0]


@pytest.mark.parametrize(
    ("block", "values", "step", "text"),
    [
        (Cart, {}, 0.5 * PERIOD, "it: a step of 0.0625 s, expected a whole number of periods of 0.125 s"),
        (Cart, {}, 0.0, "it: a step of 0.0 s, expected"),
        (Cart, {}, (1.0 + 1.1e-6) * PERIOD, "s, expected a whole number of periods"),
        (Cart, {}, (1.0 + 0.9e-6) * PERIOD, ""),
        (Cart, {}, (2.0 - 0.9e-6) * PERIOD, ""),
        (Cart, {"force": 10.0, "y": -20.0}, PERIOD, ""),
        (Cart, {"force": 10.5}, PERIOD, "it: cart/push: "),
        (Cart, {"gain": 5.0}, PERIOD, "gain = 5: no"),
        (Cart, {"gain": 9.0}, PERIOD, "parameter gain = 9.0: "),
        (Cart, {"gain": 8.0}, PERIOD, ""),
        (Law, {"x": 9.5}, PERIOD, "it is far"),
    ],
)
def test_an_impossible_step_is_refused(made, block, values, step, text):
    """By an exception: PythonFMU makes fmi2Fatal of it, which every tool reports."""
    fmu = made(block)
    put(fmu, **values)
    before = get(fmu, X)

    def run():
        fmu.exit_initialization_mode()
        fmu.do_step(0.0, step)

    if text:
        with pytest.raises(ValueError, match=re.escape(text)):
            run()
    else:
        run()
    assert (get(fmu, X) == before) == (bool(text) or block is Law)


def test_the_clock_is_that_of_the_tool_from_its_start_time_on(made):
    """SPEED is the time of the cart, in s."""
    fmu = made(Cart)
    fmu.setup_experiment(5 * PERIOD, None, None)
    fmu.exit_initialization_mode()
    assert get(fmu, X, SPEED) == [0.5, 5 * PERIOD]
    fmu.do_step(5 * PERIOD, PERIOD)
    assert get(fmu, SPEED) == [6 * PERIOD]
    with pytest.raises(ValueError, match=r"a step from 0\.0 s, expected one from 0\.75 s"):
        fmu.do_step(0.0, PERIOD)
    fmu = made(Cart)
    fmu.setup_experiment(0.3 * PERIOD)
    with pytest.raises(ValueError, match=r"a start at .* s, expected a whole number of periods of 0\.125 s"):
        fmu.exit_initialization_mode()


def test_parameters_count_from_the_end_of_the_initialisation(made):
    fmu = made(Cart)
    begun = fmu._step
    fmu.exit_initialization_mode()
    assert fmu._step is begun  # no parameter has changed
    put(fmu, gain=4.0, word="b", on=False, count=5)
    assert get(fmu, "gain", "word", "on", "count") == [4.0, "b", False, 5]
    fmu.exit_initialization_mode()
    block = fmu._step.block
    assert (block.p.gain, block.p.word, block.p.on, block.p.count, block.p.rows) == (4.0, "b", False, 5, (1.0, 2.0))
    fmu.do_step(0.0, PERIOD)
    assert get(fmu, X, SPEED) == [0.5 + PERIOD * 4.0 * 3.0, PERIOD]
    drawn = [made(Cart)._step.block.uniform(0), made(Cart)._step.block.uniform(0)]
    assert drawn[0] == drawn[1]  # random numbers depend on the seed and the node's name


@pytest.mark.parametrize("block", [Cart, Law])
def test_a_state_is_restored_and_moved_into_another_instance(made, block):
    fmu = made(block)

    def go(one, begin, count):
        result = []
        for k in range(count):
            put(one, **({"force": 1.0 + k} if block is Cart else {"x": 1.0 + k}))
            assert one.do_step((begin + k) * PERIOD, PERIOD)
            result.append([v.getter() for v in one.vars.values()])
        return result

    go(fmu, 0, 3)
    kept = fmu._fmu_state_from_bytes(fmu._fmu_state_to_bytes(fmu._get_fmu_state()))
    messages = [v.getter() for v in fmu.vars.values()]
    remaining = go(fmu, 3, 3)
    fmu._set_fmu_state(kept)
    assert [v.getter() for v in fmu.vars.values()] == messages
    assert go(fmu, 3, 3) == remaining
    other = made(block)
    other._set_fmu_state(kept)
    assert go(other, 3, 3) == remaining


def test_names_and_contents():
    assert variable("motor/state", "shaft/velocity") == "motor.state.shaft.velocity"
    assert variable("/level/", "") == "level"
    member = SimpleNamespace(
        name="it", package="p", executable="e", params=CartParams(period=PERIOD), remap={"a": "b"}.items()
    )
    result = content(member, 7, {"push": [1.0]})
    assert result.pop("parameters")["gain"] == 2.0
    assert result == {
        "node": "it",
        "package": "p",
        "executable": "e",
        "seed": 7,
        "topics": {"a": "b"},
        "start": {"push": [1.0]},
    }
