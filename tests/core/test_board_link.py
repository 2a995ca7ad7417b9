"""The link to a board: frames, a wire that damages them, wrong boards, and a rig with a board in it."""

import copy
import ctypes
import json
import math
import os
import pty
import random
import shutil
import statistics
import struct
import subprocess
import threading
import time
import tty
from dataclasses import replace
from pathlib import Path

import pytest
from board_by_hand import Board, NoisyWire, QuietWire, library
from hypothesis import given, strategies as st
from softrig_core import ScenarioError, rig_of, simulate
from softrig_core.board import line as line_module, link as link_module
from softrig_core.board.description import read_description
from softrig_core.board.entry import LinkEntry
from softrig_core.board.frames import Kind, Splitter, decoded, encoded, read, written
from softrig_core.board.line import Line
from softrig_core.board.wires import Simulated, opened
from softrig_core.errors import RunError
from softrig_core.export.check import FLAGS
from softrig_core.export.golden import golden_calls, member_of
from softrig_core.firmware.files import export_firmware
from softrig_core.firmware.link_files import SUPPORT
from softrig_core.scenario.scenario import merge, read_draft

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt-get install gcc)")
FRAMES = 10_000  # frames over a wire that damages some of them
MANY = 300_000  # frames of the long test
SCENARIO, NODE = "dc_motor_smc_b2", "dc_motor_smc"


@pytest.fixture(scope="module")
def firmware(tmp_path_factory):
    """Folder, name, layout, requests of a run, and the answers of an undisturbed board."""
    folder = tmp_path_factory.mktemp("firmware")
    rig = rig_of(SCENARIO)
    name, layout = export_firmware(rig, NODE, folder, "host", rows=600, drawn=20)
    library(folder, name)
    main = ["cc", *FLAGS, "-D_POSIX_C_SOURCE=200809L", "-o", name, "main.c", f"{name}.c", f"{name}_link.c", "-lm"]
    subprocess.run(main, cwd=folder, check=True, capture_output=True)
    calls = golden_calls(rig, NODE, 1, 600)
    steps = [layout.step.pack(c.t, *layout.numbers(c.inputs)) for c in calls]
    answers = [b"\0" + b"".join(struct.pack("<d", v) for p in layout.outputs for v in c.outputs[p.name]) for c in calls]
    return folder, name, layout, steps, answers


@pytest.fixture
def drawn(monkeypatch):
    """Sessions and first numbers that are the same each time."""
    rng = random.Random(7)
    monkeypatch.setattr(line_module.os, "urandom", rng.randbytes)


def build_of(firmware):
    folder, name, *_ = firmware
    rig = rig_of(SCENARIO)
    entry = LinkEntry(port=f"program:{folder / name}", firmware=str(folder / f"{name}.json"))
    member = member_of(rig, NODE)
    cls = link_module.linked(member.block_class, entry, member.params, "test")
    block = cls(member.params, NODE)
    return block._build, block._params


@given(
    st.binary(max_size=700) | st.lists(st.sampled_from([b"\0", b"\1" * 253, b"\2" * 254, b"\3" * 255])).map(b"".join)
)
def test_cobs_has_no_zero_and_decodes_to_its_input(body):
    data = encoded(body)
    assert 0 not in data
    assert decoded(data) == body


def test_c_and_python_write_the_same_frames(tmp_path):
    source = """
#include <stdint.h>
#include <stddef.h>
#include "softrig_c.h"
#define SR_LINK_ROOM 2000u
#define SR_LINK_SOURCE
#include "softrig_link.h"
static sr_link link; static uint8_t *to; static int used;
static void put(uint8_t byte) { to[used++] = byte; }
int echo(const uint8_t *in, int n, uint8_t *out)
{
    uint8_t kind = 0;
    link.put = put; link.code = 0xFFu; to = out; used = 0;
    for (int i = 0; i < n; i++) { uint8_t k = sr_request(&link, in[i]); kind = (k != 0u) ? k : kind; }
    if (kind == 0u) { return (used > 0) ? used : -1; }
    const uint16_t size = link.length;
    memcpy(sr_values(&link, kind), link.in + 3, size);
    sr_answer(&link, kind, 0, size);
    return used;
}
"""
    (tmp_path / "echo.c").write_text(source)
    folder = line_module.__file__.rsplit("/board/", 1)[0]
    (tmp_path / SUPPORT).write_text(Path(folder, "firmware", SUPPORT).read_text())
    command = ["cc", "-std=c99", "-O1", "-shared", "-fPIC", f"-I{folder}/export", "-o", "echo.so", "echo.c"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    echo, out = ctypes.CDLL(str(tmp_path / "echo.so")), (ctypes.c_uint8 * 4096)()
    rng = random.Random(3)

    def asked(number, kind, values, session):
        data = written(number, kind, values, session)
        n = echo.echo(data, len(data), out)
        return None if n < 0 else bytes(out[:n])

    assert asked(1, Kind.HELLO, b"\x11\x22", 0)
    for k in range(300):
        values = b"".join(rng.choice([b"\0", b"\7" * 253, b"\7" * 254, rng.randbytes(9)]) for _ in range(k % 7))
        answer = asked(2 + k, Kind.STEP, values, 0x2211)
        assert answer == written(2 + k, Kind.ANSWER, b"\0" + values, 0x2211)[1:]
        assert read(answer[:-1], 0x2211).values == b"\0" + values
    assert asked(301, Kind.STEP, b"", 0x2211) is not None  # the repeated frame gets the stored answer
    assert asked(200, Kind.STEP, b"", 0x2211) is None  # a frame older than the last one gets no answer
    assert asked(400, Kind.STEP, b"", 0x2212) is None  # a frame of another session gets no answer


def lockstep(firmware, wire, steps):
    build, params = build_of(firmware)
    line = Line("wire", wire.opened, build, 0.5, wire.now, wire.sleep)
    line.begin(params)
    return line, [line.ask(Kind.STEP, step) for step in steps]


def test_an_undisturbed_wire_has_the_answers_of_python(firmware, tmp_path, drawn):
    folder, _, _, steps, answers = firmware
    line, result = lockstep(firmware, QuietWire(Board(folder / "board.so", tmp_path)), steps)
    assert result == answers
    assert line.counts.remarks() == ""


@pytest.mark.parametrize(("frames", "seed"), [(FRAMES, 1), pytest.param(MANY, 2, marks=pytest.mark.long)])
def test_no_damaged_frame_gives_a_wrong_answer_in_lockstep(frames, seed, firmware, tmp_path, drawn):
    folder, _, _, steps, answers = firmware
    rng = random.Random(seed)
    used, happened, counted = 0, {}, 0
    while used < frames:
        wire = NoisyWire(rng, 0.3, Board(folder / "board.so", tmp_path), pulled=0.01)
        line, result = lockstep(firmware, wire, steps)
        assert result == answers
        used += line.counts.sent
        counted += line.counts.damaged + line.counts.repeated + line.counts.strays
        happened = {k: happened.get(k, 0) + v for k, v in wire.happened.items()}
        assert line.counts.reopened >= min(1, wire.happened["pulled"])
    assert min(happened.values()) > 0, happened
    assert counted > frames / 10


@pytest.mark.parametrize(("frames", "seed"), [(FRAMES, 4), pytest.param(MANY, 5, marks=pytest.mark.long)])
def test_real_time_accepts_an_answer_to_the_request_or_none(frames, seed, firmware, tmp_path, drawn):
    folder, _, _, steps, _ = firmware
    rng = random.Random(seed)
    board = Board(folder / "board.so", tmp_path)
    messages = {}  # the board's answers by session and number

    def feed(data, of=board.feed):
        answer = of(data)
        for piece in Splitter().split_frames(answer):
            frame = read(piece, line._session)
            if frame is not None and frame.kind == Kind.ANSWER:
                messages.setdefault((line._session, frame.number), frame.values)
        return answer

    board.feed = feed
    wire = NoisyWire(rng, 0.3, board, pulled=0.002)
    build, params = build_of(firmware)
    line = Line("wire", wire.opened, build, 0.5, wire.now, wire.sleep)
    line.begin(params)
    used = 0
    for k in range(frames):
        begun = wire.time
        answer = line.try_ask(Kind.STEP, steps[k % len(steps)], 0.005)
        assert wire.time - begun < 0.0062  # at most the time limit and one time step of the wire
        if rng.random() < 0.002:
            board.power()  # the board restarts
        wire.time = max(wire.time, begun + 0.01)
        if answer is not None:
            used += 1
            assert answer == messages[line._session, line._number]
    assert used > frames / 10
    assert line.counts.lost > 0
    assert line.counts.late > 0
    assert line.counts.rejoined > 0


def test_two_boards_at_one_port_are_refused(firmware, tmp_path, drawn):
    boards = [Board(firmware[0] / "board.so", tmp_path) for _ in range(2)]
    with pytest.raises(RunError, match="two boards answer at wire"):
        lockstep(firmware, QuietWire(*boards), firmware[3][:1])


def test_a_second_board_that_appears_later_is_ignored(firmware, tmp_path, drawn):
    wire = QuietWire(Board(firmware[0] / "board.so", tmp_path))
    line, result = lockstep(firmware, wire, firmware[3][:10])
    wire.boards = (*wire.boards, Board(firmware[0] / "board.so", tmp_path))
    assert [*result, *(line.ask(Kind.STEP, s) for s in firmware[3][10:20])] == firmware[4][:20]


def test_another_build_is_refused_by_name(firmware, tmp_path, drawn):
    folder = tmp_path / "other"
    name, _ = export_firmware(rig_of("dc_motor_smc_b2_delta1"), NODE, folder, "host", rows=50, drawn=5)
    wire = QuietWire(Board(library(folder, name), tmp_path))
    with pytest.raises(RunError, match=r"at wire has build [0-9a-f]{16}, expected [0-9a-f]{16}; load the firmware"):
        lockstep(firmware, wire, firmware[3][:1])


def test_a_board_that_restarts_ends_a_lockstep_run(firmware, tmp_path, drawn):
    board = Board(firmware[0] / "board.so", tmp_path)
    line, _ = lockstep(firmware, QuietWire(board), firmware[3][:10])
    board.power()
    with pytest.raises(RunError, match="it has restarted and lost its state"):
        line.ask(Kind.STEP, firmware[3][10])


def test_a_board_that_is_silent_ends_a_lockstep_run(firmware, drawn):
    with pytest.raises(RunError, match="no board answers at wire"):
        lockstep(firmware, QuietWire(), firmware[3][:1])


class EchoWire(QuietWire):
    """A half-duplex adapter, which receives what it sends."""

    def write(self, data):
        self.waiting += data
        super().write(data)


def test_requests_that_come_back_are_no_answers(firmware, tmp_path, drawn):
    """The echo of a hello was taken for that of a board with another firmware."""
    line, result = lockstep(firmware, EchoWire(Board(firmware[0] / "board.so", tmp_path)), firmware[3][:10])
    assert result == firmware[4][:10]
    assert "echoed" in line.remarks()
    assert (line.counts.damaged, line.counts.strays) == (0, 0)
    with pytest.raises(RunError, match="no board answers at wire; the port returns what it is sent"):
        lockstep(firmware, EchoWire(), firmware[3][:1])


def linked_rig(firmware, port, **more):
    folder, name, *_ = firmware
    link = {"port": port, "firmware": str(folder / f"{name}.json")} | more
    draft = read_draft(SCENARIO)
    return rig_of(replace(draft, raw=merge(draft.raw, {"nodes": {NODE: {"link": link}}})))


def test_a_rig_with_a_board_over_a_pty_equals_the_rig_without(firmware):
    pytest.importorskip("serial", reason="needs pyserial (scripts/softrig setup hardware)")
    folder, name, *_ = firmware
    near_end, far_end = pty.openpty()
    tty.setraw(far_end)
    board = subprocess.Popen([folder / name], stdin=near_end, stdout=near_end)
    try:
        result = recorded(linked_rig(firmware, os.ttyname(far_end)), duration=1.0)
    finally:
        board.kill()
        board.wait()
        os.close(near_end)
        os.close(far_end)
    assert result == recorded(SCENARIO, duration=1.0)


def recorded(rig, **more):
    return {name: topic.data for name, topic in simulate(rig, **more).recording.topics.items()}


def test_gains_change_on_the_board_between_two_ticks(firmware):
    folder, name, *_ = firmware
    script = {"changes": [{"at": 0.3, "set": {f"{NODE}.k_per_ref": 4.0}}]}
    draft = read_draft(SCENARIO)
    link = {"nodes": {NODE: {"link": {"port": f"program:{folder / name}", "firmware": str(folder)}}}}
    plain = rig_of(replace(draft, raw=merge(draft.raw, script)), duration=0.6)
    board = rig_of(replace(draft, raw=merge(merge(draft.raw, script), link)), duration=0.6)
    assert recorded(board) == recorded(plain)
    assert recorded(board) != recorded(linked_rig(firmware, f"program:{folder / name}"), duration=0.6)


@pytest.mark.parametrize("realtime", [False, True])
def test_gains_that_view_changes_take_effect_at_the_next_tick(realtime, firmware, tmp_path, monkeypatch):
    folder = firmware[0]
    rig = rig_of(SCENARIO)
    entry = LinkEntry(port="program:x", firmware=str(folder / f"{NODE}.json"))
    member = member_of(rig, NODE)
    wire = QuietWire(Board(folder / "board.so", tmp_path))
    cls = link_module.linked(member.block_class, entry, member.params, "test")
    board, python = cls(member.params, NODE), member.block(1)
    line = Line("wire", wire.opened, board._build, 0.5, wire.now, wire.sleep)
    monkeypatch.setattr(link_module, "_line", lambda *_: line)
    board.realtime = realtime
    x, y, voltages = board.first(), python.first(), []
    for k in range(12):
        if k in (4, 8):  # changed between two ticks, as in a session
            gains = member.params.model_copy(update={"k_per_ref": 4.0 if k == 4 else 7.0, "delta": 0.8})
            for block in (board, python):
                block.change(gains)
            x, y = board.go_on(x, member.params), python.go_on(y, member.params)
        inputs = {"state": (0.5 * k,), "sensors": (0.0, 0.1 * k), "reference": (10.0,)}
        y, wanted = python.update(y, k * 10**7, **inputs)
        x, result = board.update(x, k * 10**7, **inputs)
        while not line.joined:  # In real time the first answers are missing until the board has joined.
            assert realtime
            assert result["command"] == (0.0,)
            wire.sleep(0.01)
            x, result = board.update(x, k * 10**7, **inputs)
        assert result == wanted
        voltages.append(wanted["command"])
    assert len(set(voltages)) == len(voltages)
    assert line.remarks() == ""
    assert board.void(x) == ""


@pytest.mark.parametrize("ticks", [0, 5])
def test_a_run_in_real_time_whose_board_is_silent_at_its_end_is_not_judged(ticks, firmware, tmp_path, monkeypatch):
    folder = firmware[0]
    member = member_of(rig_of(SCENARIO), NODE)
    entry = LinkEntry(port="program:x", firmware=str(folder / f"{NODE}.json"), timeout=0.1)
    wire = QuietWire(Board(folder / "board.so", tmp_path))
    block = link_module.linked(member.block_class, entry, member.params, "test")(member.params, NODE)
    line = Line("wire", wire.opened, block._build, 0.1, wire.now, wire.sleep)
    monkeypatch.setattr(link_module, "_line", lambda *_: line)
    block.realtime, x, messages = True, block.first(), []
    for k in range(60):
        if k == 30 + ticks:
            wire.write = lambda data: None  # as if the board were unplugged: what is written to the port is lost
            messages.append(block.void(x))
        if k >= 30 + ticks or ticks:
            x, result = block.update(x, k * 10**7, state=(1.0,), sensors=(0.0, 0.0), reference=(10.0,))
            wire.sleep(0.01)
    assert result["command"] == (0.0,)
    assert messages == [""]
    since = "at any time" if not ticks else f"after {(29 + ticks) * 0.01:g} s"
    assert block.void(x) == f"no answer came from wire {since}, so the run is no evidence about this node"


def test_a_port_that_opens_slowly_delays_no_tick_in_real_time(firmware, tmp_path):
    folder, _, _, steps, _ = firmware
    wire, gate = QuietWire(Board(folder / "board.so", tmp_path)), threading.Event()

    def slowly():
        assert gate.wait(60.0)
        return wire.opened()

    build, params = build_of(firmware)
    line = Line("wire", slowly, build, 0.5, wire.now, wire.sleep)
    line.begin(params)
    for _ in range(40):
        assert line.try_ask(Kind.STEP, steps[0], 0.005) is None
        wire.sleep(0.005)
    assert line.wire is None
    gate.set()
    end = time.monotonic() + 60.0
    while line.try_ask(Kind.STEP, steps[0], 0.005) is None:
        wire.sleep(0.005)
        assert time.monotonic() < end
    assert line.joined


def test_a_parameter_that_is_compiled_in_is_refused(firmware):
    folder, name, *_ = firmware
    with pytest.raises(ScenarioError, match=r"has c = 5\.\d+ compiled in, expected 6\.0; export it again"):
        rig_of(linked_rig(firmware, f"program:{folder / name}"), overrides={f"{NODE}.c": 6.0})


@pytest.mark.parametrize(
    ("change", "reported"),
    {
        "of another node": ({"nodes": {NODE: {"executable": "dc_motor_smc_kalman"}}}, "is firmware of softrig_drives"),
        "external": ({"nodes": {NODE: {"external": True}}}, "it is external and has a link; remove one of the two"),
        "no file": ({"nodes": {NODE: {"link": {"firmware": "/nowhere"}}}}, "/nowhere: No such file or directory"),
        "no number": ({"nodes": {NODE: {"link": {"timeout": 0.0}}}}, "greater than 0"),
        "unknown key": ({"nodes": {NODE: {"link": {"speed": 9600}}}}, "speed"),
    }.values(),
)
def test_a_link_that_cannot_work_is_refused_before_the_run(change, reported, firmware):
    folder = firmware[0]
    link = {"nodes": {NODE: {"link": {"port": "program:x", "firmware": str(folder)}}}}
    draft = read_draft(SCENARIO)
    with pytest.raises(ScenarioError, match=reported):
        rig_of(replace(draft, raw=merge(merge(draft.raw, link), change)))


def test_a_port_that_cannot_be_opened_ends_the_run_with_one_line(firmware):
    pytest.importorskip("serial", reason="needs pyserial (scripts/softrig setup hardware)")
    with pytest.raises(RunError, match=r"the port /dev/nowhere cannot be opened: .*No such file"):
        simulate(linked_rig(firmware, "/dev/nowhere", timeout=0.01))


@pytest.mark.long
def test_a_link_costs_little_beside_the_bare_port(firmware):
    serial = pytest.importorskip("serial", reason="needs pyserial (scripts/softrig setup hardware)")
    folder, name, layout, steps, answers = firmware
    near_end, far_end = pty.openpty()
    tty.setraw(far_end)
    board = subprocess.Popen([folder / name], stdin=near_end, stdout=near_end)
    build, params = build_of(firmware)
    rounds = []
    try:
        line = Line("pty", lambda: opened(os.ttyname(far_end), 115200), build, 0.5)
        line.begin(params)
        line.ask(Kind.STEP, steps[0])
        bare = serial.Serial(os.ttyname(far_end), 115200, timeout=1.0)
        for _ in range(7):
            begun = time.perf_counter()
            for step in steps:
                line.ask(Kind.STEP, step)
            elapsed = time.perf_counter() - begun
            # Send the newest frame again, so that the board only repeats its stored answer.
            frame = written(line._number, Kind.STEP, steps[-1], line._session)
            size = len(written(line._number, Kind.ANSWER, answers[-1], line._session)) - 1
            begun = time.perf_counter()
            for _ in steps:
                bare.write(frame)
                assert len(bare.read(size)) == size
            rounds.append(elapsed / (time.perf_counter() - begun))
    finally:
        board.kill()
        board.wait()
        os.close(near_end)
        os.close(far_end)
    print(f"{statistics.median(rounds):.2f} times the bare port; {layout.step.size} bytes of values to the board")
    assert statistics.median(rounds) <= 1.5


@pytest.mark.parametrize("port", ["file", "folder", "/dev/null", "/dev/zero"])
def test_a_device_that_is_not_a_serial_port_is_refused_immediately(port, tmp_path):
    pytest.importorskip("serial")
    (tmp_path / "file").write_text("no port")
    (tmp_path / "folder").mkdir()
    name = port if port.startswith("/") else str(tmp_path / port)
    with pytest.raises(ScenarioError, match=r"^link: .* is not a serial port; expected one such as /dev/ttyACM0$"):
        opened(name, 115200)


DESCRIBED = {
    "node": "law", "class": "a.b:C", "digest": "0123456789abcdef", "real": "double", "period_s": [1, 100],
    "parameters": {"k": 1.5, "name": "x"}, "settable": ["k"],
    "ports": [{"direction": "in", "name": "state", "topic": "motor/state", "type": "sensor_msgs/msg/JointState",
               "channels": ["shaft"], "fields": ["velocity"], "dims": [],
               "values": [{"label": "shaft/velocity", "unit": "rad/s", "limit": 1e7, "safe": 0.0}]}],
}  # fmt: skip


def places(of, path=()):
    """Yield the place of each part of a description."""
    yield path
    for key, value in of.items() if isinstance(of, dict) else enumerate(of) if isinstance(of, list) else ():
        yield from places(value, (*path, key))


@pytest.mark.parametrize("place", [*places(DESCRIBED)])
def test_a_description_is_complete_or_refused_with_the_place(place, tmp_path):
    """Each part is left out and replaced by values of every other type."""
    file = tmp_path / "law.json"
    strange = (None, True, -1, 10**400, math.inf, math.nan, "", "\0", "a b", [], [1], [[]], {}, {"a": 1}, "x" * 400)
    for value in strange:
        result = copy.deepcopy(DESCRIBED)
        part = result
        for key in place[:-1]:
            part = part[key]
        if place:
            part[place[-1]] = value
        file.write_text(json.dumps(result if place else value))
        try:
            used = read_description(file)
        except ValueError as error:
            refused = str(error)
        else:  # text where text is expected, and a number where a number is
            refused = ""
            assert {type(v.safe) for p in used.ports for v in p.values} <= {float}
            assert all(isinstance(used.parameters[name], bool | int | float) for name in used.settable)
        assert "Error" not in refused
        assert len(refused) <= 300


def test_arrays_that_are_larger_than_described_are_not_created(tmp_path):
    port = DESCRIBED["ports"][0] | {"type": "std_msgs/msg/Float64MultiArray", "dims": [["x", 10**9]]}
    (tmp_path / "law.json").write_text(json.dumps(DESCRIBED | {"ports": [port]}))
    with pytest.raises(ValueError, match=r"ports\.0: .*port state has 1 values, expected as many as its dims require"):
        read_description(tmp_path / "law.json")


def test_ctrl_c_in_a_terminal_does_not_reach_a_simulated_board():
    """It is sent to the process group of the run, which ends the board itself."""
    wire = Simulated(["cat"])
    try:
        assert os.getpgid(wire._process.pid) == wire._process.pid
    finally:
        wire.close()
