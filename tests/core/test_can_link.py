"""A node on a CAN bus: the DBC of its ports, limits before the cast, a disturbed bus, a rig with a controller."""

import ctypes
import random
import re
import shutil
import struct
import subprocess
import threading
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest
from softrig_core import ScenarioError, rig_of, simulate
from softrig_core.block.port import scalars
from softrig_core.board.can_line import CanLine
from softrig_core.board.dbc import build_of, encoded, messages_of, values_of
from softrig_core.board.entry import LONGEST, LinkEntry, require_own_ports
from softrig_core.board.frames import Kind
from softrig_core.board.layout import Layout
from softrig_core.board.line import Build
from softrig_core.errors import RunError
from softrig_core.export.check import FLAGS
from softrig_core.export.golden import member_of
from softrig_core.firmware.can_files import export_can
from softrig_core.firmware.command import dbc
from softrig_core.scenario.scenario import merge, read_draft

can = pytest.importorskip("can", reason="needs python-can (scripts/softrig setup hardware)")
cantools = pytest.importorskip("cantools", reason="needs cantools (scripts/softrig setup hardware)")
from can_by_hand import Bus, Node, file_of, framed  # noqa: E402 - only where both are there

SCENARIO, NODE = "dc_motor_smc_b2", "dc_motor_smc"
BUILD = "0badcafe"
FRAMES, MANY = 3_000, 300_000
channels = count()


@pytest.fixture
def own(tmp_path):
    """DBC of a port with a separate limit on each side."""
    ports = (scalars("u", "u", {"v": "V"}, limits=(12.0,)),), (scalars("y", "y", {"w": "rad/s", "i": "A"}),)
    return file_of(tmp_path, ports), ports


def layout_of(ports):
    return Layout(*ports, {}, plant=False, single=False)


def line_of(own, bus, build=BUILD, timeout=0.05):
    file, ports = own
    line = CanLine("can:test", bus.opened, bus.now, bus.sleep)
    return line.use(messages_of(file, "n", *ports, BUILD), Build(build, (1, 100), layout_of(ports)), timeout)


def total(state, tick, signals):
    """A node whose answer shows each request that it has received."""
    return state + signals["u_v_position"], {"y_w_position": state + signals["u_v_position"], "y_i_position": tick}


def node_of(own, step=total):
    return Node(own[0], "n", step, float)


def asked(line, ports, k, u):
    return line.ask(Kind.STEP, layout_of(ports).step.pack(k, u))


# on a bus that loses frames -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frames", "seed"), [(FRAMES, 1), pytest.param(MANY, 2, marks=pytest.mark.long)])
def test_no_disturbed_bus_gives_a_wrong_answer_in_lockstep(own, frames, seed):
    rng, ports = random.Random(seed), own[1]
    bus = Bus(rng, 0.2, node_of(own), pulled=0.01)
    line = line_of(own, bus)
    while line.counts.sent < frames:  # run after run, so that a late frame reaches the next run
        line.begin(b"")
        want = 0.0
        for k in range(40):
            u = float(rng.randrange(-4, 5))
            want += u
            _, w, i = layout_of(ports).answer.unpack(asked(line, ports, k, u))
            assert (w, i) == (pytest.approx(want, abs=1e-6), k)
    assert min(bus.happened.values()) > 0
    assert min(line.counts.repeated, line.counts.strays, line.counts.damaged, line.counts.reopened) > 0


@pytest.mark.parametrize(("frames", "seed"), [(FRAMES, 3), pytest.param(MANY, 4, marks=pytest.mark.long)])
def test_real_time_accepts_the_answer_to_its_tick_or_none(own, frames, seed):
    rng, ports = random.Random(seed), own[1]
    node = node_of(own, lambda x, tick, signals: (x, {"y_w_position": signals["u_v_position"], "y_i_position": tick}))
    bus = Bus(rng, 0.2, node, pulled=0.002)
    line = line_of(own, bus)
    used = 0
    while line.counts.sent < frames:
        begun, u = bus.time, float(rng.randrange(-4, 5))
        answer = line.try_ask(Kind.STEP, layout_of(ports).step.pack(0, u), 0.005)
        assert bus.time - begun < 0.0065  # at most the time limit and the duration of the frames themselves
        bus.time = max(bus.time, begun + 0.01)
        if rng.random() < 0.002:
            node.power()
        if answer is not None:
            used += 1
            assert layout_of(ports).answer.unpack(answer)[1] == pytest.approx(u, abs=1e-6)
    assert used > frames / 10
    counts = line.counts
    assert min(counts.lost, counts.late, counts.rejoined, counts.reopened, counts.damaged) > 0


def test_numbers_wrap_around_and_a_node_that_restarts_ends_a_lockstep_run(own):
    node = node_of(own)
    bus = Bus(random.Random(0), 0.0, node)
    line = line_of(own, bus)
    asked(line, own[1], 0, 1.0)
    line._tick = node.last = 65535
    assert layout_of(own[1]).answer.unpack(asked(line, own[1], 0, 1.0))[1:] == (pytest.approx(2.0), 0.0)
    node.power()
    with pytest.raises(RunError, match=r"no answer to a tick at can:test .* it may have restarted"):
        asked(line, own[1], 0, 1.0)


def test_another_build_and_a_second_node_are_refused(own, tmp_path):
    (tmp_path / "other").mkdir()
    other = Node(file_of(tmp_path / "other", own[1], "00000001"), "n", total, float)
    with pytest.raises(RunError, match="has build 00000001, expected 0badcafe"):
        asked(line_of(own, Bus(random.Random(0), 0.0, other)), own[1], 0, 1.0)
    twin = node_of(own, lambda x, tick, signals: (x, {"y_w_position": -7.0, "y_i_position": 0.0}))
    line = line_of(own, Bus(random.Random(0), 0.0, node_of(own), twin))
    asked(line, own[1], 0, 1.0)
    with pytest.raises(RunError, match="two answers to tick 0 at can:test differ"):
        asked(line, own[1], 1, 1.0)


def test_a_bus_that_cannot_be_opened_ends_a_lockstep_run_with_its_reason(own):
    bus = Bus(random.Random(0), 0.0, node_of(own))
    bus.back = 1e9
    with pytest.raises(RunError, match="the bus can:test cannot be opened: no such device"):
        asked(line_of(own, bus), own[1], 0, 1.0)


def test_lines_that_an_adapter_cannot_read_are_damaged(own):
    bus, bad = Bus(random.Random(0), 0.0, node_of(own)), iter(range(150))
    receive = bus.recv

    def recv(wait):
        if next(bad, None) is not None:
            raise IndexError("string index out of range")  # the error of python-can's slcan
        return receive(wait)

    bus.recv = recv
    line = line_of(own, bus, timeout=1.0)
    assert layout_of(own[1]).answer.unpack(asked(line, own[1], 0, 1.0))[1] == pytest.approx(1.0)
    assert (line.counts.damaged, line.counts.reopened) == (150, 0)


def test_without_an_echo_the_newest_values_count_until_they_are_old(own):
    file, ports = own
    kept, message = [], ""
    for line in file.read_text().splitlines(keepends=True):
        message = line.split()[2] if line.startswith("BO_ ") else message
        if message != "n_from_0:" and not ("n_from" in message and line.startswith((" SG_ tick", " SG_ run"))):
            kept.append(line)
    file.write_text("".join(kept))
    bus = Bus(random.Random(0), 0.0)
    line, db = line_of(own, bus), cantools.database.load_file(file)
    assert line.try_ask(Kind.STEP, layout_of(ports).step.pack(0, 1.0), 0.0) is None
    for name, row in {"n_from_1": {"y_w_position": 1.5}, "n_from_2": {"y_i_position": 2.5}}.items():
        bus.coming.append((bus.time, name, framed(db.get_message_by_name(name), row)))
    answer = line.try_ask(Kind.STEP, layout_of(ports).step.pack(0, 1.0), 0.0)
    assert layout_of(ports).answer.unpack(answer) == (0, 1.5, 2.5)
    bus.time += 1.0
    assert line.try_ask(Kind.STEP, layout_of(ports).step.pack(0, 1.0), 0.0) is None
    with pytest.raises(RunError, match="which lockstep needs"):
        asked(line, ports, 0, 1.0)


# limits ---------------------------------------------------------------------------------------------------------------


def sent(own, value):
    frame = messages_of(own[0], "n", *own[1], BUILD).to[0]
    return encoded(frame, {"tick": 5, "run": 9}, [value])


@pytest.mark.parametrize(
    ("value", "raw", "limited"),
    [
        (12.0, 2**31 - 1, []),
        (12.1, 2**31 - 1, ["u_v_position"]),
        (-1e300, -(2**31) + 1, ["u_v_position"]),
        (-12.0, -(2**31) + 1, []),
    ],
)
def test_a_value_is_limited_before_it_becomes_an_integer(own, value, raw, limited):
    data, cut = sent(own, value)
    assert int.from_bytes(data[3:7], "little", signed=True) == raw
    assert (data[:3], cut) == (b"\5\0\x09", limited)


def test_values_beyond_the_bits_of_a_signal_are_not_truncated(own):
    own[0].write_text(
        own[0].read_text().replace("u_v_position : 24|32@1-", "u_v_position : 24|8@1-").replace("[-12.0|12.0]", "[0|0]")
    )
    assert sent(own, 11.0)[0][3] == 127


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_refused(own, value):
    with pytest.raises(RunError, match="u_v_position would be"):
        sent(own, value)


# files ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("u_v", "u_w", "is none of u_v"),
        ("n_to_1", "m_to_1", "has the signal u_v"),
        ("n_from_0", "m_from_0", "n_from_0 and the signals tick and run"),
        (" SG_ run : 16|8@1+ (1,0) [0|255]", " SG_ ran : 16|8@1+ (1,0) [0|255]", "run and build alone"),
        (" SG_ tick : 0|16@1+", " SG_ tick : 0|12@1+", "of 16 bits without sign"),
        (" SG_ tick : 0|16@1+", " SG_ tick : 0|16@1-", "of 16 bits without sign"),
        ("BO_ 257 ", "BO_ 256 ", "have one identifier, 0x100"),
        ("24|32@1-", "8|32@1-", "overlapping"),
        ("24|32@1-", "24|99@1-", "is no DBC"),
        ("[-12.0|12.0]", "[12|-12]", "expected the smaller number first"),
        ("[-12.0|12.0]", "[0|0.0]", r"range 0 to 0.0, .* or \[0\|0\] for none"),
        (f"[{int(BUILD, 16)}|{int(BUILD, 16)}]", "[1|1]", "of another block or of other parameters"),
        ("VERSION", "\0\0", "is no DBC"),
        ("n_to_1: 8", "n_to_1: 64", "longer than 8 bytes"),
        ("SG_ tick : 0", "SG_ tick M : 0", "multiplexed"),
        ('"V"', '"mV"', "is in 'mV', expected 'V': the same quantity, 1 mV = 0.001 V; write the channel's unit"),
        ('"V"', '"A"', "is in 'A', expected 'V', which is another quantity; write the channel's unit"),
    ],
)
def test_a_mismatching_dbc_is_refused(own, old, new, text):
    file, ports = own
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ScenarioError, match=text) as refused:
        messages_of(file, "n", *ports, BUILD)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("scale", ["0", "1e999", "nan"])
def test_an_invalid_scale_is_refused(own, scale):
    file, ports = own
    (line,) = (line for line in file.read_text().splitlines() if "SG_ u_v" in line)
    file.write_text(file.read_text().replace(line[line.index("(") : line.index(")")], f"({scale},0"))
    with pytest.raises(ScenarioError, match=r"scale|is no DBC"):
        messages_of(file, "n", *ports, BUILD)


def test_a_missing_or_too_long_file_is_refused(own, tmp_path):
    file, ports = own
    file.write_bytes(file.read_bytes() + b"\n" * LONGEST)
    with pytest.raises(ScenarioError, match="has more than"):
        messages_of(file, "n", *ports, BUILD)
    with pytest.raises(ScenarioError, match="No such file"):
        messages_of(tmp_path / "none.dbc", "n", *ports, BUILD)
    with pytest.raises(ScenarioError, match="not a regular file"):
        messages_of(Path("/dev/zero"), "n", *ports, BUILD)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.long) for k in range(1, 30))])
def test_a_damaged_file_is_read_or_refused_in_one_line(own, seed):
    file, ports = own
    good, rng = file.read_bytes(), random.Random(seed)
    for _ in range(40):
        data = bytearray(good)
        for _ in range(rng.randrange(1, 4)):
            at = rng.randrange(len(data))
            data[at : at + rng.choice([0, 1, 9])] = rng.choice(
                [b"", b"9" * 400, b'"', b"-", b"1e400", rng.randbytes(2)]
            )
        file.write_bytes(data)
        text = ""
        try:
            messages = messages_of(file, "n", *ports, BUILD)
            encoded(messages.to[0], {"tick": 65535, "run": 255}, [12.0])
        except (ScenarioError, RunError) as refused:
            text = str(refused)
        assert "\n" not in text


def test_long_names_and_characters_that_a_dbc_cannot_hold_are_restored(tmp_path):
    labels = {"x" * 40: "V", "x" * 40 + "y": "V", "größe": "A", 'a" SG_ b': "A"}
    ports = (scalars("u", "u", labels),), (scalars("y", "y", {"w": "rad/s"}),)
    result = messages_of(file_of(tmp_path, ports), "n", *ports, BUILD)
    assert sorted(place for frame in result.to for place, _ in frame.signals) == [0, 1, 2, 3]


def test_two_nodes_may_share_a_bus_but_no_identifier(tmp_path):
    (tmp_path / "a.dbc").write_text("BO_ 256 a_to_1: 8 softrig\n")
    (tmp_path / "b.dbc").write_text("BO_ 257 b_to_1: 8 softrig\n")
    entry = {n: LinkEntry(port="can:virtual/0", firmware=str(tmp_path / f"{n}.dbc")) for n in "ab"}
    require_own_ports(entry, "s")
    (tmp_path / "b.dbc").write_text("BO_ 256 b_to_1: 8 softrig\n")
    with pytest.raises(ScenarioError, match="one CAN identifier, 0x100"):
        require_own_ports(entry, "s")


# in a rig -------------------------------------------------------------------------------------------------------------


class Peer(threading.Thread):
    """The controller itself at the other end of a virtual bus."""

    def __init__(self, channel, file):
        super().__init__(daemon=True)
        member = member_of(rig_of(SCENARIO), NODE)
        self.block, self.period = member.block_class(member.params, NODE), round(member.params.period * 1e9)
        self.inputs, self.outputs = member.block_class.ports(member.params)
        self.node, self.going = Node(file, NODE, self.step, self.block.first), True
        self.bus = can.Bus(interface="virtual", channel=channel)

    def run(self):
        while self.going:
            if (message := self.bus.recv(0.05)) is not None:
                for frame in self.node.feed(message):
                    self.bus.send(frame)
        self.bus.shutdown()

    def step(self, x, tick, read):
        signals, values = {}, {}
        for p in self.inputs:
            row = tuple(read[f"{p.name}_{label}".replace("/", "_")] for label in p.labels)
            signals[p.name] = None if p.held and not read[f"{p.name}_given"] else row
        x, outputs = self.block.update(x, tick * self.period, **signals)
        for p in self.outputs:
            row = outputs.get(p.name)
            values |= {f"{p.name}_given": row is not None} if p.sporadic else {}
            row = p.safe if row is None else row
            values |= {f"{p.name}_{label}".replace("/", "_"): v for label, v in zip(p.labels, row, strict=True)}
        return x, values


def linked_rig(file, channel, **more):
    link = {"port": f"can:virtual/{channel}", "firmware": str(file)} | more
    draft = read_draft(SCENARIO)
    return rig_of(replace(draft, raw=merge(draft.raw, {"nodes": {NODE: {"link": link}}})), duration=0.5)


@pytest.fixture
def law(tmp_path, capsys):
    file = tmp_path / "law.dbc"
    assert dbc([SCENARIO, NODE, "--out", str(file)]) == 0
    assert "messages" in capsys.readouterr().out
    return file


def test_a_controller_on_the_bus_equals_the_one_without_to_the_digits_of_a_float(law):
    channel = f"rig{next(channels)}"
    peer = Peer(channel, law)
    peer.start()
    try:
        # The second run begins a new session of the peer.
        results = [simulate(linked_rig(law, channel)).signals for _ in range(2)]
    finally:
        peer.going = False
        peer.join()
    plain = simulate(rig_of(SCENARIO, duration=0.5)).signals
    for name in ("motor/state/shaft/velocity", "motor/command/armature/effort"):
        assert list(results[0][name].x) == list(results[1][name].x)
        assert results[0][name].x == pytest.approx(plain[name].x, rel=1e-3, abs=1e-3)


def test_a_silent_bus_ends_a_lockstep_run_in_one_line(law):
    with pytest.raises(RunError, match="no node answers at can:virtual"):
        simulate(linked_rig(law, f"silent{next(channels)}", timeout=0.001))


@pytest.mark.parametrize(("port", "text"), [("can:nonsense/0", "cannot be opened"), ("can:slcan//dev/none", "No such")])
def test_an_unknown_interface_ends_a_run_in_one_line(law, port, text):
    with pytest.raises(RunError, match=text):
        simulate(linked_rig(law, 0, port=port, timeout=0.01))


def test_parameters_other_than_those_of_the_dbc_are_refused(law):
    draft = read_draft(SCENARIO)
    nodes = {NODE: {"link": {"port": "can:virtual/0", "firmware": str(law)}, "parameters": {"period": 0.02}}}
    with pytest.raises(ScenarioError, match="of other parameters of dc_motor_smc; export the DBC again"):
        simulate(rig_of(replace(draft, raw=merge(draft.raw, {"nodes": nodes})), duration=0.5))


# the node's side in C -------------------------------------------------------------------------------------------------

SHOWN = """
#include "{n}_can.h"
static {n}_can node;
void power(void);
unsigned receive(uint32_t id, const uint8_t *data, uint8_t length, uint32_t *ids, uint8_t *answers);
void power(void) {{ {n}_can_init(&node); }}
unsigned receive(uint32_t id, const uint8_t *data, uint8_t length, uint32_t *ids, uint8_t *answers)
{{
    const unsigned count = {n}_can_receive(&node, id, data, length);
    for (unsigned k = 0u; k < count; k++) {{
        ids[k] = node.frames[k].id;
        memcpy(answers + 8 * k, node.frames[k].data, 8);
    }}
    return count;
}}
"""


class InC:
    """The exported node behind the interface of `Node`."""

    def __init__(self, folder, name):
        (folder / "shown.c").write_text(SHOWN.format(n=name))
        sources = ["shown.c", f"{name}_can.c", f"{name}.c"]
        command = ["cc", *FLAGS, "-Wconversion", "-pedantic", "-shared", "-fPIC", "-o", "node.so", *sources, "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        self.library = ctypes.CDLL(str(folder / "node.so"))
        self.power()

    def power(self):
        self.library.power()

    def feed(self, frame):
        if frame.is_remote_frame or frame.is_error_frame:
            return []
        ids, data = (ctypes.c_uint32 * 8)(), ctypes.create_string_buffer(64)
        count = self.library.receive(frame.arbitration_id, bytes(frame.data), len(frame.data), ids, data)
        rows = [(ids[k], data.raw[8 * k : 8 * k + 8]) for k in range(count)]
        return [can.Message(arbitration_id=number, is_extended_id=False, data=row) for number, row in rows]


@pytest.fixture(scope="module")
def coded(tmp_path_factory):
    """Folder, DBC, build and the node of a controller that runs as C."""
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler (Debian: apt-get install gcc)")
    folder, rig = tmp_path_factory.mktemp("can_c"), rig_of(SCENARIO)
    member = member_of(rig, NODE)
    build, file = build_of(member.block_class, member.params), folder / "smc.dbc"
    file = file_of(folder, member.block_class.ports(member.params), build, NODE)
    assert export_can(rig, NODE, file, build, folder, rows=50, drawn=20) == NODE
    return folder, file, build, member


def single(row):
    return [struct.unpack("<f", struct.pack("<f", v))[0] for v in row]


def test_the_node_in_c_answers_a_disturbed_bus_as_the_block_does(coded):
    folder, file, build, member = coded
    ports = member.block_class.ports(member.params)
    layout, rng = Layout(*ports, {}, plant=False, single=False), random.Random(5)
    bus = Bus(rng, 0.2, InC(folder, NODE), pulled=0.01)
    line = CanLine("can:test", bus.opened, bus.now, bus.sleep)
    line.use(messages_of(file, NODE, *ports, build), Build(build, (1, 100), layout), 0.05)
    answered = 0
    while line.counts.sent < 1500:
        line.begin(b"")
        block = member.block(1)
        x = block.first()
        for k in range(20):
            w, i, r = single([rng.uniform(-20.0, 20.0), rng.uniform(-3.0, 3.0), rng.choice([5.0, 10.0])])
            inputs = {"state": (w,), "sensors": (0.0, i), "reference": (r,) if k % 3 else None}
            x, wanted = block.update(x, k * 10**7, **inputs)
            answer = layout.answer.unpack(line.ask(Kind.STEP, layout.step.pack(k * 10**7, *layout.numbers(inputs))))
            assert list(answer[1:]) == single([*wanted["command"], *wanted["surface"]])
            answered += 1
    assert answered > 100
    assert min(bus.happened.values()) > 0


def test_a_signal_with_a_range_is_packed_in_c_as_softrig_packs_it(coded, tmp_path):
    folder, file, build, member = coded
    ports = member.block_class.ports(member.params)
    shutil.copytree(folder, tmp_path / "c")
    other = tmp_path / "c" / "edited.dbc"
    text = file.read_text()
    lines = [line for line in text.splitlines() if line.startswith(" SG_ command_armature_effort ")]
    assert len(lines) == 1
    scaled = re.sub(r": (\d+)\|32@1- \(1,0\) \[[^]]*\]", r": \1|16@1- (0.001,0) [-9|9]", lines[0])
    assert scaled != lines[0]
    text = re.sub(
        r"^SIG_VALTYPE_ \d+ command_armature_effort .*\n", "", text.replace(lines[0], scaled), flags=re.MULTILINE
    )
    other.write_text(text)
    export_can(rig_of(SCENARIO), NODE, other, build, tmp_path / "c", rows=50, drawn=20)
    node = InC(tmp_path / "c", NODE)
    messages = messages_of(other, NODE, *ports, build)
    block = member.block(1)
    for w in (0.0, 3.0, 9.7, -20.0, 21.0):
        node.power()
        hello, _ = encoded(messages.hello, {"run": 7}, [int(build, 16)])
        assert len(node.feed(can.Message(arbitration_id=0x100, is_extended_id=False, data=hello))) == 1
        inputs = {"state": (w,), "sensors": (0.0, 0.5), "reference": (10.0,)}
        wanted = block.update(block.first(), 0, **inputs)[1]
        row = Layout(*ports, {}, plant=False, single=False).numbers(inputs)
        answers = []
        for frame in messages.to:
            data, _ = encoded(frame, {"tick": 0, "run": 7}, row)
            answers += node.feed(can.Message(arbitration_id=frame.key[0], is_extended_id=False, data=data))
        expected = [*wanted["command"], *wanted["surface"]]
        assert [bytes(a.data) for a in answers] == [
            encoded(f, {"tick": 0, "run": 7}, expected)[0] for f in messages.back
        ]
        assert len(values_of(ports[1], "sporadic")) == len(expected)
