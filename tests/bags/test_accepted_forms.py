"""Messages in every form that a port accepts are recorded, read, shown, compared and exported by name.

A node outside may change the form of its messages while it runs: order of the channels, further fields, of any length,
the other names that a port knows, the byte order. Each is compared with what `Decoder` accepted, which the port uses.
"""

import json
import math
import random
import struct

import numpy as np
import pyarrow.csv
import pytest
from softrig_bags.cli import main_bag, main_compare
from softrig_bags.compare import compare
from softrig_bags.read import signals
from softrig_bags.write import write_bag
from softrig_bringup.plots import overlay
from softrig_bringup.plots.curves import Source
from softrig_bringup.report import several
from softrig_bringup.report.record import read_run
from softrig_bringup.run.run import summary
from softrig_bringup.view.sources import Growing
from softrig_core import Block, BlockParams, Port, Recording, Rig, Run
from softrig_core.block.codec import Decoder
from softrig_core.rig.members import other_names
from softrig_core.wire.cdr import Layout
from softrig_core.wire.signals import Signals

STATE, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
WRENCH, TRAJECTORY = "geometry_msgs/msg/WrenchStamped", "trajectory_msgs/msg/JointTrajectory"
COMMAND = Port("command", "law/command", STATE, ("a", "b", "c"), ("effort",), ("V",) * 3, also=("j1", "j2", "j3"))
GAINS = Port("gains", "law/gains", ARRAY, (), ("data",), ("1",) * 6, held=True, dims=(("row", 2), ("column", 3)))
PUSH = Port("push", "law/push", WRENCH, (), ("force",), ("N",) * 3)
PLAN = Port("plan", "law/plan", TRAJECTORY, ("a", "b"), ("velocity",), ("rad/s",) * 2)
PORTS = (COMMAND, GAINS, PUSH, PLAN)


class Plant(Block[BlockParams]):
    """A plant that subscribes to all four ports."""

    @classmethod
    def ports(cls, params):
        return PORTS, ()

    def update(self, x, t, **inputs):
        return x, {}


class Law(Block[BlockParams]):
    """Stands for a controller that is an external node."""

    @classmethod
    def ports(cls, params):
        plain = [Port(p.name, p.topic, p.msgtype, p.channels, p.fields, p.units, dims=p.dims) for p in PORTS]
        return (), tuple(plain)

    def update(self, x, t, **inputs):
        return x, {}


def big_endian(t, names, values):
    """A JointState with efforts only, most significant byte first."""
    data = struct.pack(">II", *divmod(t, 10**9)) + struct.pack(">I", 1) + b"\0"

    def padded(data, size):
        return data + bytes(-len(data) % size)

    data = padded(data, 4) + struct.pack(">I", len(names))
    for name in names:
        data = padded(data, 4) + struct.pack(">I", len(name) + 1) + name.encode() + b"\0"
    for field in ((), (), values):
        data = padded(data, 4) + struct.pack(">I", len(field))
        data = (padded(data, 8) if field else data) + b"".join(struct.pack(">d", v) for v in field)
    return b"\0\0\0\0" + data


def command(chance, t):
    """A command in one of the forms that the port accepts."""
    names = list(chance.choice([COMMAND.channels, COMMAND.also]))
    if chance.random() < 0.7:
        chance.shuffle(names)
    values = [chance.uniform(-9, 9) for _ in names]
    form = chance.randrange(5)
    if form == 0:
        return big_endian(t, names, values)
    further = {"position": chance.choice([0, 1, 3, 5]), "velocity": chance.choice([0, 3])} if form > 1 else {}
    counts = {"position": 0, "velocity": 0, **further, "effort": 3}
    layout = Layout(STATE, chance.choice(["", "world", "base"]), names, counts)
    extra = [
        chance.choice([chance.random(), math.nan, math.inf]) for _ in range(counts["position"] + counts["velocity"])
    ]
    return layout.encode(t, (*extra, *values))


def gains(chance, k):
    """An array with its shape, or flat, as people write it."""
    shaped = chance.random() < 0.5
    layout = Layout(ARRAY, counts={"data": 6}, dims=GAINS.dims if shaped else (), numbered=shaped)
    return layout.encode(k, tuple(chance.uniform(-9, 9) for _ in range(6)))


def push(chance, t):
    """A wrench in any frame, with a torque that the port does not read."""
    torque = (chance.choice([0.0, math.nan, 1.0]) for _ in range(3))
    return Layout(WRENCH, chance.choice(["", "tool", "a frame of another length"])).encode(
        t, (*(chance.uniform(-9, 9) for _ in range(3)), *torque)
    )


def plan(chance, t):
    """A point of a trajectory: joints in any order, further fields of any length."""
    names = chance.sample(PLAN.channels, 2)
    counts = {"position": chance.choice([0, 2]), "velocity": 2, "effort": chance.choice([0, 1, 3])}
    return Layout(TRAJECTORY, "", names, counts).encode(t, tuple(chance.random() for _ in range(sum(counts.values()))))


@pytest.fixture(scope="module", params=range(3))
def taken(request):
    """A recording in which the form of the messages changes, and the values that the port read from each message."""
    chance = random.Random(request.param)
    recording = Recording([*((port.topic, port.msgtype) for port in PORTS), ("/clock", "rosgraph_msgs/msg/Clock")])
    values = {}
    for number, (port, make) in enumerate(zip(PORTS, (command, gains, push, plan), strict=True)):
        decode, results = Decoder(port), []
        for k in range(60):
            data = make(chance, k * 10**6)
            recording.add(number, k * 10**6, data)
            results.append(decode(data)[1])
        values[port.topic] = dict(zip(port.labels, np.array(results).T, strict=True))
    return recording, values


@pytest.fixture(scope="module")
def rig():
    return Rig.from_blocks({"plant": Plant(), "law": Law()}, duration=1.0)


def check(result, values):
    """Compare each value of the ports, for all messages."""
    for topic, columns in values.items():
        for label, x in columns.items():
            assert np.array_equal(result(topic).columns[label], x), (topic, label)


def test_a_run_has_the_values_that_its_port_read(taken, rig):
    recording, values = taken
    result = Signals(recording).known_as(other_names(rig))
    check(result.table, values)
    source = Source(result, rig)
    for label, x in values[COMMAND.topic].items():
        assert np.array_equal(source.curve(f"{COMMAND.topic}/{label}").y[:60], x)


def test_a_page_has_the_values_that_its_port_read(taken, rig):
    recording, values = taken
    page = Growing(rig)
    for first in range(0, 60, 7):
        part = Recording((t.name, t.msgtype) for t in recording.topics.values())
        for number, topic in enumerate(recording.topics.values()):
            for t, data in list(zip(topic.times, topic.data, strict=True))[first : first + 7]:
                part.add(number, t, data)
        page.append(part)
    check(page.pane(0.0, 1.0).table, values)


def test_a_bag_has_the_values_that_its_port_read(taken, rig, tmp_path, capsys):
    recording, values = taken
    write_bag(tmp_path / "bag", recording)
    raw, named = signals(tmp_path / "bag"), signals(tmp_path / "bag").known_as(other_names(rig))
    check(named.table, values)
    for topic in values:  # the decoder of bags and that of runs agree in all columns
        one, other = Signals(recording).table(topic).columns, raw.table(topic).columns
        assert set(one) == set(other)
        assert all(np.array_equal(one[k], other[k], equal_nan=True) for k in one)
    assert compare(raw, signals(tmp_path / "bag")).equal
    assert main_compare([str(tmp_path / "bag")] * 2) == 0
    assert main_bag(["export", str(tmp_path / "bag"), "--out", str(tmp_path / "csv")]) == 0
    printed = capsys.readouterr().err
    assert "/law/push: header/frame_id changes (" in printed
    table = pyarrow.csv.read_csv(tmp_path / "csv/law.command.csv")
    for own, also in zip(COMMAND.channels, COMMAND.also, strict=True):
        columns = [table[f"{name}/effort"].to_numpy() for name in (own, also)]
        assert np.array_equal(
            np.where(np.isnan(columns[0]), columns[1], columns[0]), values[COMMAND.topic][f"{own}/effort"]
        )


def test_joints_in_a_different_order_are_compared_by_name(tmp_path, capsys):
    names = ("a", "b", "c")
    for bag, change in (("one", 0.0), ("other", 0.0), ("wrong", 1e-9)):
        recording, chance = Recording([("u", STATE)]), random.Random(bag)
        for k in range(20):
            order = list(names) if bag == "one" else chance.sample(names, 3)
            values = [math.sin(k + names.index(name)) + change * (name == "b") for name in order]
            layout = Layout(STATE, "", order, {"effort": 3})
            recording.add(0, k, big_endian(k, order, values) if k % 3 == 1 else layout.encode(k, tuple(values)))
        write_bag(tmp_path / bag, recording)
    one, other, wrong = (str(tmp_path / bag) for bag in ("one", "other", "wrong"))
    assert main_compare([one, other]) == 0
    assert main_compare([one, other, "--bitwise"]) == 1
    capsys.readouterr()
    assert main_compare([one, wrong]) == 1
    assert "u b/effort: " in capsys.readouterr().out


def test_a_report_of_several_runs_has_the_values_that_their_ports_read(taken, rig, tmp_path, monkeypatch):
    recording, values = taken
    labels, drawn = values[COMMAND.topic], []
    plots = [{"title": "u", "signals": {f"{COMMAND.topic}/{label}": label for label in labels}}]
    law = rig.scenario.nodes["law"].model_copy(update={"external": True})
    scenario = rig.scenario.having(plots=plots, nodes={**rig.scenario.nodes, "law": law})
    outside = Rig.from_scenario(scenario, {"plant": Plant, "law": Law})
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        content = summary(Run(outside, 0, recording, mode="processes"), [], f"softrig run {name}")
        (tmp_path / name / "metrics.json").write_text(json.dumps(content))
        write_bag(tmp_path / name / "bag", recording)
    monkeypatch.setattr(overlay, "draw_overlay", lambda runs, note: drawn.extend(runs) or ())
    list(several.overlaid([(tmp_path / n, read_run(tmp_path / n)) for n in ("one", "other")], ("one", "other")))
    assert len(drawn) == 2
    for run in drawn:
        for label, x in labels.items():
            assert np.array_equal(run.signals[f"{COMMAND.topic}/{label}"].x, x)


def test_texts_that_a_table_does_not_show_are_named(tmp_path, capsys):
    """A bag with texts, one constant frame and one that changes: each exported file names what it leaves out."""
    text = "std_msgs/msg/String"
    recording = Recording([("said", text), ("silent", text), ("still", WRENCH), ("moved", WRENCH)])
    for k in range(4):
        for number, word in enumerate((b"hi", b"")):
            recording.add(number, k, b"\0\1\0\0" + struct.pack("<I", len(word) + 1) + word + b"\0")
        for number, frame in ((2, "tool"), (3, "tool" if k < 2 else "base")):
            recording.add(number, k, Layout(WRENCH, frame).encode(k, (0.0,) * 6))
    write_bag(tmp_path / "bag", recording)
    assert main_bag(["export", str(tmp_path / "bag"), "--out", str(tmp_path / "csv")]) == 0
    assert [line.split("/bag: ")[1] for line in capsys.readouterr().err.splitlines()] == [
        "/said: texts are not in its table: data",
        "/moved: header/frame_id changes ('base' and 'tool'), which its table does not show",
    ]


def test_a_message_with_a_repeated_name_is_read_by_position_and_the_others_by_name(tmp_path):
    recording, forms = Recording([("joints", STATE)]), [("a", "a"), ("a", "b"), ("", "b"), ("a", "b")]
    for k, names in enumerate(forms):
        recording.add(0, k, Layout(STATE, "", names, {"effort": 2}).encode(k, (k + 1.0, -k - 1.0)))
    write_bag(tmp_path / "bag", recording)
    for signals_read in (Signals(recording), signals(tmp_path / "bag")):
        columns = {name: x.tolist() for name, x in signals_read.table("joints").columns.items()}
        nan = np.nan
        assert columns.keys() == {"a/effort", "b/effort", "effort/0", "effort/1"}
        assert np.array_equal(columns["a/effort"], [nan, 2, nan, 4], equal_nan=True)
        assert np.array_equal(columns["b/effort"], [nan, -2, -3, -4], equal_nan=True)
        assert np.array_equal(columns["effort/0"], [1, nan, 3, nan], equal_nan=True)
        assert np.array_equal(columns["effort/1"], [-1, nan, nan, nan], equal_nan=True)
