"""Events, partial messages, records at the end, ends by a block, unit delays, clocks: alike in every placement."""

import pytest
from conftest import differences, in_process, make_scenario
from hypothesis import given, strategies as st
from softrig_bringup.run.run import gaps
from softrig_core import (
    Block,
    BlockParams,
    Refused,
    Rig,
    RunError,
    ScenarioError,
    Signals,
    command,
    feed,
    joint_state,
    param,
    reference,
    rig_of,
    scalars,
    wrench,
)
from softrig_core.block.answer import admit
from softrig_core.block.codec import Decoder, selection
from softrig_core.block.port import require_distinct
from softrig_core.block.schedule import Schedule
from softrig_core.wire.cdr import Layout
from softrig_nodes import run_processes
from typing_extensions import TypeVar

DELAY = {
    "package": "softrig_control",
    "executable": "unit_delay",
    "parameters": {
        "topic_in": "loop/sum",
        "topic_out": "loop/back",
        "channels": ["y"],
        "fields": ["position"],
        "initial": [4.0],
    },
}
BASIC = {"plant": "plant", "source": "source", "gain": "gain"}
RIGS = {
    "events": ({"plant": "plant", "burst": "burst", "gain": "burst_gain"}, 0.3, {}),
    "arrays": ({"plant": "plant", "spread": "spread", "peaks": "peaks", "weigh": "weigh"}, 0.3, {}),
    "record": (BASIC | {"record": "record", "analyst": "analyst"}, 0.1, {}),
    "end": (
        {
            **BASIC,
            "watcher": "watcher",
            "record": {"executable": "record", "parameters": {"period": 0.03}},
            "second": {
                "executable": "plant",
                "parameters": {"period": 0.05},
                "remap": {"lag/state": "second/state", "lag/applied": "second/applied"},
            },
        },
        0.2,
        {},
    ),
    "algebraic loop": ({"accumulator": "accumulator", "delay": DELAY}, 0.2, {}),
    "no plant": ({"source": "source"}, 0.2, {"clock": "1/300"}),
}
RIGS["no plant"][0]["source"] = {"executable": "source", "parameters": {"period": "1/100"}}


def rig(name):
    nodes, duration, options = RIGS[name]
    return rig_of(make_scenario(nodes, duration, **options))


DAILY = ("end",)  # this case runs in processes; the others use the simulated middleware


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.long] * (n not in DAILY)) for n in RIGS])
@pytest.mark.processes
def test_processes_and_open_loop_give_the_same_as_in_process(name, tmp_path):
    wired = rig(name)
    expected = in_process(wired)
    outcome = run_processes(wired, 0, tmp_path)
    assert outcome.error == ""
    assert differences(expected, outcome.recording) == []
    assert not any(s["refused"] for s in outcome.status.values())
    assert gaps(wired, expected) == ""


@pytest.mark.parametrize("name", RIGS)
def test_open_loop_gives_the_same_as_in_process(name):
    wired = rig(name)
    expected = in_process(wired)
    for member in wired.members:
        answers = feed(member, 0, expected)
        assert all(answers.topics[t].data == expected.topics[t].data for t in answers.topics), member.name


def test_an_event_reaches_its_readers_at_its_tick_and_is_held():
    recording = in_process(rig("events"))
    assert recording.topics["lag/burst"].times == [50_000_000, 120_000_000]
    signals = Signals(recording)
    u, x = signals["lag/command/u/effort"], signals["lag/state/x/position"]
    # Channel a never gets a message and keeps its safe value of 0.25. Channel b starts with -0.5 and changes its sign
    # 30 ms after the event.
    b = [-0.5] * 5 + [1.0] * 3 + [-1.0] * 4 + [2.0] * 3 + [-2.0] * 15
    assert u.x + x.x[:-1] == pytest.approx([0.25 + value for value in b])


def test_a_record_is_read_once_at_the_end():
    recording = in_process(rig("record"))
    signals = Signals(recording)
    assert recording.topics["lag/record"].times == recording.topics["lag/result"].times == [100_000_000]
    x = signals["lag/state/x/position"].x
    assert list(signals["lag/result/x/position"].x) == [x[-1] - x[1]]
    assert signals["lag/record/2"].x == [11.0]


def test_a_unit_delay_opens_an_algebraic_loop():
    y = Signals(in_process(rig("algebraic loop")))["loop/sum/y/position"].x
    assert list(y) == [2.0 + 2.0 * 0.5 ** (k + 1) if k else 3.0 for k in range(len(y))]
    nodes = {"accumulator": {"executable": "accumulator", "remap": {"loop/back": "loop/sum"}}}
    with pytest.raises(ScenarioError, match="cycle without a plant in it: accumulator -> accumulator"):
        rig_of(make_scenario(nodes))


def test_a_rig_without_a_plant_has_a_clock():
    recording = in_process(rig("no plant"))
    assert recording.topics["/clock"].times == [Schedule("1/300").time(k) for k in range(61)]
    assert len(recording.topics["lag/reference"].times) == 20
    alone = rig_of(make_scenario({"source": "source"}, 0.2))
    assert (alone.clock.name, alone.ticks) == ("clock", 20)
    with pytest.raises(ScenarioError, match="neither a number nor a fraction"):
        rig_of(make_scenario({"source": "source"}, 0.2, clock="1/x"))


def test_only_a_port_declared_sporadic_may_be_silent():
    port = command("u", "u", ["a"], "N")
    with pytest.raises(RunError, match="returned no u"):
        admit({}, port, "node", 0)
    assert admit({"u": None}, command("u", "u", ["a"], "N", sporadic=True), "node", 0) is None


def test_units_are_declared_by_channel():
    port = command("u", "u", ["a", "b"], ["N", "1"])
    assert port.units == ("N", "1")
    assert joint_state("x", "x", ["a", "b"], position=["rad", "m"], velocity="1").units == ("rad", "m", "1", "1")
    with pytest.raises(ValueError, match="3 units for 2 values"):
        command("u", "u", ["a", "b"], ["N", "V", "A"])
    # The key of native code must contain the limits.
    assert command("u", "u", ["a", "b"], "N", limits=[1.0, 2.0]).limits == (1.0, 2.0)


@given(
    st.lists(st.sampled_from("abc"), min_size=1, unique=True), st.lists(st.sampled_from("abc"), min_size=1, unique=True)
)
def test_absent_channels_of_a_partial_port_keep_their_value(first, second):
    port = joint_state("e", "e", "abc", position="m", effort="N", partial=True, safe=range(6))
    decode, kept = Decoder(port), dict(zip(port.labels, port.safe, strict=True))
    for names, base in ((first, 10.0), (second, 20.0)):
        n = len(names)
        values = [base + i for i in range(2 * n)]
        data = Layout(port.msgtype, "", names, {"position": n, "effort": n}).encode(7, values)
        kept |= dict(zip([f"{c}/{f}" for f in ("position", "effort") for c in names], values, strict=True))
        stamp, decode.kept = decode(data)
        assert stamp == 7
        assert decode.kept == tuple(kept[label] for label in port.labels)


def test_a_partial_port_refuses_unknown_channels():
    port = command("e", "e", ["a", "b"], "N", partial=True)
    for names in (["a", "c"], [], ["a", "a"]):
        with pytest.raises(Refused, match="expected some of"):
            Decoder(port)(Layout(port.msgtype, "", names, {"effort": len(names)}).encode(0, [1.0] * len(names)))
    with pytest.raises(Refused, match="expected some of"):
        selection(command("e", "e", ["a", "c"], "N"), port)
    with pytest.raises(ValueError, match="cannot be partial"):
        wrench("e", "e", partial=True)


def test_a_block_of_parameters_has_them_as_its_params():
    class Own(BlockParams):
        k: float = param(3.0, "gain")

    class Law(Block[Own]):
        """An empty controller."""

    class Derived(Law):
        """A class derived from it."""

    assert Law(k=2.0).p.k == 2.0
    assert Derived().p.k == 3.0
    assert Block.Params is BlockParams


class Ranged(BlockParams):
    top: float = param(1.0, "range")


class Turned(Ranged):
    gain: float = param(2.0, "gain")


R = TypeVar("R", bound=Ranged, default=Turned)
S = TypeVar("S", bound=Ranged)


def test_a_base_class_leaves_its_parameters_open():
    class Base(Block[R]):
        """A base class of several controllers."""

    class Law(Base[Ranged]):
        """One of the controllers."""

    class Bound(Block[S]):
        """A parameter without a default."""

    assert (Base.Params, Law.Params, Bound.Params) == (Turned, Ranged, Ranged)
    assert Base(gain=3.0).p.gain == 3.0


@pytest.mark.parametrize(
    "make",
    [
        lambda: command("duty", "duty", ["switch"], ""),
        lambda: joint_state("state", "state", ["x"]),
        lambda: joint_state("state", "state", [], position="m"),
        lambda: reference("r", "r", ["x"]),
        lambda: scalars("s", "s", {}),
    ],
)
def test_a_port_without_values_is_refused_when_it_is_made(make):
    with pytest.raises(ValueError, match=r"port \w+: \w+ has no values; expected .* '1' for a pure number"):
        make()


class Doubled(Block):
    """Two inputs with one name: the second link replaced the first."""

    INPUTS = (scalars("in", "a", {"x": "1"}), scalars("in", "b", {"x": "1"}))


class DoubledOutputs(Block):
    OUTPUTS = (scalars("out", "a", {"x": "1"}), scalars("out", "b", {"x": "1"}))


class DoubledTopics(Block):
    OUTPUTS = (scalars("one", "a", {"x": "1"}), scalars("other", "a", {"x": "1"}))


@pytest.mark.parametrize(
    ("block", "what"),
    [
        (Doubled, r"rig: node n: two inputs are named 'in' \(topics a and b\); give each its own name"),
        (DoubledOutputs, r"rig: node n: two outputs are named 'out' \(topics a and b\); give each its own name"),
        (DoubledTopics, r"rig: node n: outputs one and other both publish 'a'; give each its own topic"),
    ],
)
def test_names_that_must_be_unique_are_checked(block, what):
    with pytest.raises(ScenarioError, match=what):
        Rig.from_blocks({"n": block()}, 1.0)


def test_an_input_and_an_output_may_share_a_name():
    require_distinct((scalars("x", "a", {"x": "1"}),), (scalars("x", "b", {"x": "1"}),))


def test_two_values_of_a_port_have_two_names():
    with pytest.raises(ValueError, match=r"port a: two values are named 'm/position'; give each channel a name"):
        joint_state("a", "a", ["m", "m"], position="rad")
