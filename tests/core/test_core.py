"""Parameters, scenarios, wiring, the in-process runner, shards."""

import math
import os

import numpy as np
import pytest
import yaml
from conftest import in_process, make_scenario
from faultrig import Gain, Lag
from hypothesis import given, strategies as st
from softrig_core import (
    Block,
    BlockParams,
    ByHand,
    ParameterError,
    Params,
    Recording,
    RunError,
    ScenarioError,
    Signals,
    figures_of,
    load_scenario,
    param,
    rig_of,
    run_inprocess,
)
from softrig_core.block.params import build, declarations, flatten
from softrig_core.rig.installed import load_block
from softrig_core.run import choice
from softrig_core.scenario.scenario import merge
from softrig_core.scenario.yaml_file import _limit_depth
from softrig_core.wire.cdr import Layout
from softrig_core.wire.recording import ShardWriter, shard_topics
from softrig_core.wire.types import TYPES

INSTALLED = os.environ["AMENT_PREFIX_PATH"]


class Inner(Params):
    bits: int = param(8, "resolution", ge=1, le=16)


class Outer(BlockParams):
    R: float = param(0.4, "resistance", "ohm", gt=0.0)
    names: tuple[str, ...] = param(("a",), "channels", min_length=1)
    rig: Inner = Inner()
    k: float | None = param(None, "gain")


def test_parameters_flatten_and_build_back():
    params = build(Outer, {"R": 1, "rig.bits": 10, "names": ["x", "y"]})
    assert flatten(params) == {"period": 0.01, "R": 1.0, "names": ["x", "y"], "rig.bits": 10, "k": None}
    assert build(Outer, flatten(params)) == params
    declared = {d.name: d for d in declarations(Outer)}
    assert (declared["R"].lower, declared["R"].unit, declared["rig.bits"].upper) == (0.0, "ohm", 16)
    with pytest.raises(Exception, match="frozen"):
        params.R = 2.0


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"R": 0.0}, "parameter R = 0.0: input should be greater than 0"),
        ({"R": math.nan}, "parameter R = nan: input should be a finite number"),
        ({"rig.bits": 17}, "parameter rig.bits = 17: input should be less than or equal to 16"),
        ({"rr": 1.0}, "parameter rr is unknown (did you mean 'R'?); this block has period, R, names, rig.bits, k"),
        ({"names": []}, "parameter names"),
        ({"period": -1.0}, "parameter period = -1.0"),
        ({"period": 1e-10}, "parameter period = 1e-10"),
        ({"rig": 5, "rig.bits": 8}, "parameter rig.bits: rig has the value 5 as well"),
        ({"rig.bits": 8, "rig": 5}, "parameter rig.bits: rig has the value 5 as well"),
    ],
)
def test_a_bad_parameter_is_named(values, text):
    with pytest.raises(ParameterError) as error:
        build(Outer, values)
    assert text in str(error.value)
    assert "\n" not in str(error.value)


def test_a_period_of_a_block_is_at_least_a_nanosecond_whatever_its_default():
    class Fast(BlockParams):
        period: float = param(1e-3, "sampling period", "s", gt=0.0)

    with pytest.raises(ParameterError, match="parameter period = 1e-10: expected at least 1e-9"):
        build(Fast, {"period": 1e-10})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    (tmp_path / "base.yaml").write_text(
        "title: T\nsystem: lag\nsource: S\nduration: 1.0\nnodes:\n"
        "  plant: {package: faultrig, executable: plant, parameters: {gain: 1e-1}}\n"
        "variants:\n  fast:\n    nodes: {plant: {parameters: {gain: 5.0}}}\n"
    )
    (tmp_path / "child.yaml").write_text("extends: base_fast\ntitle: C\nnodes: {plant: {parameters: {limit: 3.0}}}\n")
    return tmp_path


def test_scenarios_extend_and_vary(folder):
    assert load_scenario("base").nodes["plant"].parameters == {"gain": 0.1}
    assert load_scenario("base_fast").nodes["plant"].parameters == {"gain": 5.0}
    child = load_scenario("child", {"plant.period": 0.5})
    assert child.nodes["plant"].parameters == {"gain": 5.0, "limit": 3.0, "period": 0.5}
    assert (child.name, child.title) == ("child", "C")
    assert load_scenario(str(folder / "base.yaml")).name == "base"


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        ("title: T\ntitel: x\nsystem: s\nsource: s\nduration: 1\nnodes: {p: {package: a, executable: b}}", "bad",
         "bad.yaml, line 2: titel: unknown key (did you mean 'title'?), got 'x'"),
        ("extends: base\nnodes:\n  plant:\n    parametrs: {}\n", "bad",
         "bad.yaml, line 4: nodes.plant.parametrs: unknown key (did you mean 'parameters'?)"),
        ("extends: base\nvariants:\n  low: {title: x,\n    nodes: {plant: {packages: x}}}\n", "bad_low",
         "bad.yaml, line 4: nodes.plant.packages: unknown key (did you mean 'package'?), got 'x'"),
        ("extends: base\nfigures:\n  f: {signal: a, unit: s}\n", "bad",
         "line 3: figures.f.signal: unknown key; arguments of its function belong below arguments: {signal: ...}"),
        ("extends: base\nplots:\n- title: x\n  signals: {a: a}\n- {title: y,\n   signal: {a: a}}\n", "bad",
         "bad.yaml, line 5: plots.1.signals: Field required (and 1 more)"),
        ("title: [", "bad", "bad.yaml: not valid YAML"),
        ("title: x\n\nnodes: [\n", "bad", "bad.yaml: not valid YAML: line 4: while parsing a flow"),
        ("a: 1\na: 2", "bad", "duplicate key"),
        ("extends: nobody", "bad", "bad.yaml: extends 'nobody', which is unknown"),
        ("extends: bad", "bad", "extends itself: bad -> bad"),
        ("- 1", "bad", "expected a mapping"),
        ("", "bas", "scenario 'bas' is unknown (did you mean 'base'?)"),
        ("title: T\nsystem: s\nsource: s\nduration: -1\nnodes: {p: {package: a, executable: b}}", "bad",
         "bad.yaml, line 4: duration"),
        ("name: foo\nextends: base", "bad", "bad.yaml: key name: a scenario is named by its file"),
        ("1: foo\nextends: base", "bad", "bad.yaml, line 1: 1: "),
        ("extends: base\nvariants: [fast]", "bad", "bad.yaml: variants: expected a mapping of name to changes"),
    ],
)  # fmt: skip
def test_a_bad_scenario_is_explained(folder, text, name, expected):
    if text:
        (folder / "bad.yaml").write_text(text)
    with pytest.raises(ScenarioError) as error:
        load_scenario(name)
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ("nodes:\n  plant:\n    parameters:\n      gian: 2.0", "did you mean 'gain'?.* \\(bad.yaml, line 6\\)$"),
        ("nodes:\n  plant:\n    remap: {stat: a}", "remap of 'stat', but .* \\(bad.yaml, line 5\\)$"),
        (
            "nodes: {gain: {package: faultrig, executable: gain}, source: {package: faultrig, executable: source}}\n"
            "figures:\n  peak: {function: maximum, arguments: {signal: lag/state/x/positoin}}",
            "no signal 'lag/state/x/positoin' \\(did you mean 'lag/state/x/position'.* \\(bad.yaml, line 5\\)$",
        ),
    ],
)
def test_an_impossible_rig_names_the_line_of_its_file(folder, monkeypatch, entry, expected):
    monkeypatch.setenv("AMENT_PREFIX_PATH", INSTALLED)
    (folder / "bad.yaml").write_text(f"extends: base\nduration: 0.5\n{entry}\n")
    with pytest.raises(ScenarioError, match=expected):
        figures_of(rig_of("bad", duration=0.2))
    with pytest.raises(ScenarioError) as error:  # the value is not in the file, so the message has no line
        figures_of(rig_of("base", overrides={"plant.gian": 2.0}))
    assert "line" not in str(error.value)


def test_an_override_of_an_unknown_node_is_refused(folder):
    with pytest.raises(ScenarioError, match=r"override 'pump.gain': expected node.parameter with node one of plant"):
        load_scenario("base", {"pump.gain": 1.0})


def test_merge_removes_with_null():
    assert merge({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": None}, "d": 4}) == {"a": {"c": 2}, "d": 4}


def node(executable, remap=None, **parameters):
    return {"executable": executable, "parameters": parameters, "remap": remap or {}}


BASIC = {"plant": "plant", "source": "source", "gain": "gain"}


@pytest.mark.parametrize(
    ("nodes", "text"),
    [
        ({"plant": "plant", "source": "source"}, "no node publishes lag/command, which plant needs"),
        (BASIC | {"second": "gain"}, "gain and second both publish lag/command"),
        (BASIC | {"gain": node("gain", {"lag/sate": "x"})}, "node gain: remap of 'lag/sate', but its topics are"),
        (
            BASIC | {"gain": node("gain", period=0.015)},
            "node gain: period 0.015 s is not a multiple of the 0.01 s of the clock, plant",
        ),
        (BASIC | {"gain": "gian"}, "package faultrig has no executable 'gian'"),
        (
            BASIC | {"link": "link", "gain": node("gain", {"lag/state": "lag/late_state"})},
            "lag/late_state from link does not fit gain: its stamps are acquisition times",
        ),
        (
            BASIC
            | {
                "one": node("outer", {"lag/reference": "lag/b", "lag/inner_reference": "lag/a"}),
                "two": node("outer", {"lag/reference": "lag/a", "lag/inner_reference": "lag/b"}),
            },
            "cycle without a plant in it: one -> two -> one",
        ),
    ],
)
def test_a_rig_that_cannot_work_is_refused_before_the_start(nodes, text):
    with pytest.raises(ScenarioError) as error:
        rig_of(make_scenario(nodes))
    assert text in str(error.value)


def test_a_missing_package_and_a_tool_are_refused():
    with pytest.raises(ScenarioError, match="package 'nothing' is not installed"):
        load_block("nothing", "x")


def test_a_run_in_process_has_one_message_a_tick_and_repeats(lag_rig):
    first, second = in_process(lag_rig, 3), in_process(lag_rig, 3)
    assert {n: len(t.times) for n, t in first.topics.items() if t.times} == {
        "/clock": 101,
        "lag/state": 101,
        "lag/applied": 101,
        "lag/reference": 100,
        "lag/command": 100,
    }
    assert all(first.topics[n].data == second.topics[n].data for n in first.topics)


def test_a_run_reports_its_progress_about_a_hundred_times_and_at_its_end(monkeypatch):
    """2.05 s / 100 is about two of its ticks of 10 ms, so each third tick; the last tick is none of these."""
    # On a busy machine the measured ticks would be too expensive.
    monkeypatch.setattr(choice, "unwanted", lambda *arguments: choice.SHORT)
    monkeypatch.setattr(choice, "writes", lambda *arguments: False)
    rig = rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 2.05))
    messages = []
    run_inprocess(rig, 0, progress=messages.append)
    assert messages == [*range(0, 2_041_000_000, 30_000_000), 2_050_000_000]


def test_the_depth_of_a_file_does_not_count_closed_brackets():
    for text, refused in (
        ("[" + "[], " * 50 + "[" * 39 + "]" * 40, False),
        ("[" + "[], " * 50 + "[" * 40 + "]" * 41, True),
    ):
        if refused:
            with pytest.raises(ScenarioError, match="nested deeper than 40 levels"):
                _limit_depth(text, yaml.SafeLoader)
        else:
            _limit_depth(text, yaml.SafeLoader)


def test_in_process_follows_the_difference_equation():
    rig = rig_of(make_scenario({"plant": node("plant", gain=2.0), "source": "source", "gain": "gain"}))
    t, x = Signals(in_process(rig))["lag/state/x/position"]
    expected, state = [], 0.0
    for k in range(101):
        expected.append(state)
        u = 2.0 * (0.001 * (10 * k % 2000) - state)
        state += 0.01 * 2.0 * (u - state)
    assert x == pytest.approx(expected, abs=1e-15)
    assert t == pytest.approx([0.01 * k for k in range(101)], abs=1e-12)


def test_a_delayed_link_carries_the_time_of_acquisition():
    nodes = {"plant": "plant", "source": "source", "link": node("link", samples=3), "gain": "late_gain"}
    recording = in_process(rig_of(make_scenario(nodes)))
    table = Signals(recording).table("lag/late_state")
    assert list(table.stamp[:6]) == pytest.approx([0, 0, 0, 0, 0.01, 0.02])
    assert list(table.t[:3]) == pytest.approx([0, 0.01, 0.02])


def test_a_slow_block_runs_at_its_own_ticks_only():
    rig = rig_of(make_scenario(BASIC | {"gain": node("gain", period=0.05)}))
    recording = in_process(rig)
    assert recording.topics["lag/command"].times == [k * 50_000_000 for k in range(20)]


def test_a_block_that_fails_is_named_with_the_time():
    for how, text in [
        ("nan", "gain: command u/effort became nan at t = 0.2 s"),
        ("raise", "gain: failed at t = 0.2 s: ArithmeticError: deliberate"),
    ]:
        rig = rig_of(make_scenario(BASIC | {"gain": node("killed", how=how, at=0.2)}))
        with pytest.raises(RunError) as error:
            run_inprocess(rig, 0)
        assert text in str(error.value)


def test_an_external_node_needs_processes():
    rig = rig_of(make_scenario(BASIC | {"gain": {"executable": "gain", "external": True}}))
    with pytest.raises(ScenarioError, match="node gain is external"):
        run_inprocess(rig, 0)


def test_a_block_can_be_used_at_a_prompt():
    plant, gain = ByHand(Lag(gain=2.0)), ByHand(Gain(k=3.0))
    command = gain.update(0, state=plant.outputs(0)["state"], reference=(1.0,))["command"]
    plant.advance(0, command=command, offset=None, kick=None)
    assert plant.outputs(10_000_000)["state"][0] == pytest.approx(0.06)
    plant.reset(0)
    assert plant.outputs(0)["state"][0] == 0.0


def test_random_numbers_depend_on_seed_and_name_only():
    def draw(name, seed):
        block = Block(name=name)
        block.reset(seed)
        return block.standard_normal(0)

    assert draw("a", 1) == draw("a", 1)
    assert len({draw("a", 1), draw("a", 2), draw("b", 1)}) == 3


MESSAGES = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 2**40), st.binary(max_size=50)), max_size=30)


@given(MESSAGES, st.integers(0, 60))
def test_a_shard_truncated_anywhere_gives_back_all_whole_messages(tmp_path_factory, messages, cut):
    path = tmp_path_factory.mktemp("shard") / "x.shard"
    topics = [("a", "std_msgs/msg/Float64"), ("b", "std_msgs/msg/Bool")]
    writer = ShardWriter(path, topics)
    for message in messages:
        writer.add(*message)
    writer.close()
    whole = path.read_bytes()
    head = len(whole) - sum(14 + len(d) for _, _, d in messages)
    path.write_bytes(whole[: max(head, len(whole) - cut)])
    recording = Recording(topics)
    lost = recording.read_shard(path)
    result = sum(len(t.times) for t in recording.topics.values())
    size = sum(14 + len(d) for _, _, d in messages[:result])
    assert size + lost == max(0, len(whole) - head - cut)
    for index, (name, _) in enumerate(topics):
        expected = [(t, d) for i, t, d in messages[:result] if i == index]
        assert list(zip(recording.topics[name].times, recording.topics[name].data, strict=True)) == expected


ROW = {0: Layout("std_msgs/msg/Bool"), 2: Layout("sensor_msgs/msg/JointState", "", "ab", {"position": 2, "effort": 1})}
NUMBERS = st.tuples(st.floats(allow_nan=False), st.floats(allow_nan=False), st.floats(allow_nan=False))
ROWS = st.lists(
    st.one_of(st.tuples(st.integers(0, 2**60), st.booleans(), NUMBERS), st.binary(max_size=30)), max_size=20
)


@given(ROWS, st.integers(0, 60))
def test_rows_of_numbers_in_a_shard_are_read_as_their_messages(tmp_path_factory, rows, cut):
    path = tmp_path_factory.mktemp("shard") / "x.shard"
    topics = [("flag", "std_msgs/msg/Bool"), ("other", "std_msgs/msg/Float64"), ("state", "sensor_msgs/msg/JointState")]
    writer = ShardWriter(path, topics, ROW)
    head, expected = path.stat().st_size, {name: [] for name, _ in topics}
    size = head

    def warnings_of_run():
        return path.stat().st_size + len(writer._buffer)

    for row in rows:  # A message from outside may arrive between two rows.
        before = warnings_of_run()
        if isinstance(row, bytes):
            writer.add(1, 5, row)
        else:
            writer.add_row(row[0], (row[1], *row[2]))
        expected["end"] = [*expected.get("end", []), (warnings_of_run() - before, row)]
    writer.close()
    whole = path.read_bytes()
    path.write_bytes(whole[: max(head, len(whole) - cut)])
    recording = Recording(topics)
    lost = recording.read_shard(path)
    for length, row in expected.pop("end", []):
        size += length
        if size > len(whole) - cut:
            break
        if isinstance(row, bytes):
            expected["other"].append((5, row))
        else:
            expected["flag"].append((row[0], ROW[0].encode(row[0], (row[1],))))
            expected["state"].append((row[0], ROW[2].encode(row[0], row[2])))
    assert {n: list(zip(t.times, t.data, strict=True)) for n, t in recording.topics.items()} == expected
    assert lost < 60
    assert shard_topics(path) == dict(topics)


@pytest.mark.parametrize("numbered", [False, True])
@pytest.mark.parametrize("name", sorted(TYPES))
def test_a_block_of_messages_has_the_bytes_of_each(name, numbered):
    kind = TYPES[name]
    fields = {i.name: 2 for i in kind.schema if i.kind == "sequence"}
    dims = [("rows", 2)] if kind.shaped else ()
    layout = Layout(name, "abc", "xy" if kind.named else (), fields, dims, numbered and kind.shaped)
    stamps = [0, 1, 17, 10**12 - 1] if layout.numbered else [0, 1, 1_700_000_000_123_456_789, 2**31 * 10**9 - 1]
    values = np.random.default_rng(1).normal(size=(4, layout.size))
    values[0] = 0.0
    values[1, :1] = -0.0
    block = layout.encode_block(np.array(stamps), values)
    assert [row.tobytes() for row in block] == [
        layout.encode(s, v) for s, v in zip(stamps, values.tolist(), strict=True)
    ]


def test_the_first_message_of_a_shard_is_written_immediately_and_the_next_together(tmp_path):
    path = tmp_path / "x.shard"
    writer = ShardWriter(path, [("a", "std_msgs/msg/Float64")])

    def is_ready():
        recording = Recording([("a", "std_msgs/msg/Float64")])
        recording.read_shard(path)
        return recording.topics["a"].times

    assert is_ready() == []
    writer.add(0, 1, b"first")
    assert is_ready() == [1]
    writer.add(0, 2, b"second")
    assert is_ready() == [1]
    writer.flush()
    assert is_ready() == [1, 2]


def test_a_shard_cut_in_its_head_has_no_messages(tmp_path):
    path = tmp_path / "x.shard"
    ShardWriter(path, [("a", "std_msgs/msg/Float64")]).close()
    whole = path.read_bytes()
    recording = Recording([("a", "std_msgs/msg/Float64")])
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert recording.read_shard(path) == size
    assert recording.topics["a"].times == []


def test_messages_are_ordered_by_time_and_equal_times_by_topic():
    recording = Recording([("a", "x"), ("b", "x")])
    for topic, t in [(1, 0), (0, 0), (1, 5), (0, 3)]:
        recording.add(topic, t, bytes([topic]))
    assert [(t, topic.name) for t, topic, _ in recording.messages()] == [(0, "a"), (0, "b"), (3, "a"), (5, "b")]


def test_an_unknown_signal_is_explained(lag_rig):
    signals = Signals(in_process(lag_rig))
    with pytest.raises(KeyError, match="no signal 'x/force' on lag/state; it has x/position, x/velocity"):
        signals["lag/state/x/force"]
    with pytest.raises(KeyError, match="no topic for signal"):
        signals["nothing/x"]


def test_a_topic_is_valid_after_its_recording_is_deleted(lag_rig):
    topic = in_process(lag_rig).topics["lag/state"]
    assert len(topic.data) == len(topic.times) == 101
