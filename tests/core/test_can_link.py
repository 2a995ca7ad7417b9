"""A node on a CAN bus: the DBC of its ports, limits before the cast, and a rig with a controller on a virtual bus."""

import threading
from dataclasses import replace
from itertools import count

import pytest
from softrig_core import ScenarioError, rig_of, simulate
from softrig_core.block.port import scalars
from softrig_core.board.can_link import CanLine
from softrig_core.board.dbc import encoded, frames_of, printed
from softrig_core.board.entry import LinkEntry, require_own_ports
from softrig_core.errors import RunError
from softrig_core.export.golden import member_of
from softrig_core.scenario.scenario import merge, read_draft

can = pytest.importorskip("can", reason="needs python-can (scripts/softrig setup hardware)")
cantools = pytest.importorskip("cantools", reason="needs cantools (scripts/softrig setup hardware)")
SCENARIO, NODE = "dc_motor_smc_b2", "dc_motor_smc"
channels = count()


@pytest.fixture
def own(tmp_path):
    """DBC of a port with a limit of its own on each side."""
    ports = (scalars("u", "u", {"v": "V"}, limits=(12.0,)),), (scalars("y", "y", {"w": "rad/s", "i": "A"}),)
    (tmp_path / "n.dbc").write_text(printed("n", *ports, 0x100))
    return tmp_path / "n.dbc", ports


class Peer(threading.Thread):
    """The law itself at the other end of the bus; reads and writes by cantools' own scaling."""

    def __init__(self, channel, file, lose=0):
        super().__init__(daemon=True)
        self.bus, self.lose, self.going = can.Bus(interface="virtual", channel=channel), lose, True
        self.db = cantools.database.load_file(file)
        member = member_of(rig_of(SCENARIO), NODE)
        self.block, self.period = member.block_class(member.params, NODE), round(member.params.period * 1e9)
        self.inputs, self.outputs = member.block_class.ports(member.params)
        self.want = sum("_to_" in m.name for m in self.db.messages)

    def run(self):
        parts, done, answer, k, seen, x = {}, None, [], 0, 0, None
        while self.going:
            if (message := self.bus.recv(0.05)) is None:
                continue
            read = self.db.decode_message(message.arbitration_id, message.data)
            tick = read.pop("tick")
            parts = (parts if parts.get("tick") == tick else {"tick": tick, "n": 0}) | read
            parts["n"] += 1
            if parts["n"] < self.want:
                continue
            if tick != done:
                k = 0 if tick == 0 else k + 1
                x = self.block.first() if tick == 0 else x
                x, said = self.block.update(x, k * self.period, **self.given(parts))
                done, answer = tick, self.frames(tick, said)
            parts, seen = {}, seen + 1
            if self.lose and seen % self.lose == 0:
                continue
            for frame in answer:
                self.bus.send(frame)
        self.bus.shutdown()

    def given(self, read):
        found = {}
        for p in self.inputs:
            row = tuple(read[f"{p.name}_{label}".replace("/", "_")] for label in p.labels)
            found[p.name] = None if p.held and not read[f"{p.name}_given"] else row
        return found

    def frames(self, tick, said):
        values = {"tick": tick}
        for p in self.outputs:
            row = said.get(p.name)
            values |= {f"{p.name}_given": row is not None} if p.sporadic else {}
            row = p.safe if row is None else row
            values |= {f"{p.name}_{label}".replace("/", "_"): v for label, v in zip(p.labels, row, strict=True)}
        return [
            can.Message(arbitration_id=m.frame_id, is_extended_id=False, data=m.encode(values, strict=False))
            for m in self.db.messages
            if "_from_" in m.name
        ]


def linked_rig(tmp_path, channel, **more):
    member = member_of(rig_of(SCENARIO), NODE)
    file = tmp_path / "law.dbc"
    file.write_text(printed(NODE, *member.block_class.ports(member.params), 0x100))
    link = {"port": f"can:virtual/{channel}", "firmware": str(file)} | more
    draft = read_draft(SCENARIO)
    return file, rig_of(replace(draft, raw=merge(draft.raw, {"nodes": {NODE: {"link": link}}})), duration=0.5)


@pytest.mark.parametrize("lose", [0, 7])
def test_a_law_on_the_bus_is_the_law_without_to_the_digits_of_a_float(tmp_path, lose):
    channel = f"rig{next(channels)}"
    file, rig = linked_rig(tmp_path, channel, timeout=0.02)
    peer = Peer(channel, file, lose)
    peer.start()
    try:
        found = simulate(rig)
    finally:
        peer.going = False
        peer.join()
    plain = simulate(rig_of(SCENARIO, duration=0.5))
    for name in ("motor/state/shaft/velocity", "motor/command/armature/effort"):
        assert found.signals[name].x == pytest.approx(plain.signals[name].x, rel=1e-3, abs=1e-3)


def test_a_silent_bus_ends_a_lockstep_run_in_one_line(tmp_path):
    _, rig = linked_rig(tmp_path, f"silent{next(channels)}", timeout=0.001)
    with pytest.raises(RunError, match="no node answers tick 0 at can:virtual"):
        simulate(rig)


@pytest.mark.parametrize(
    ("value", "raw", "limited"),
    [
        (12.0, 2**31 - 1, []),
        (12.1, 2**31 - 1, ["u_v_position"]),
        (-1e300, -(2**31) + 1, ["u_v_position"]),
        (-12.0, -(2**31) + 1, []),
    ],
)
def test_a_value_is_limited_before_it_becomes_a_whole_number(own, value, raw, limited):
    file, ports = own
    frame = frames_of(file, "n", *ports)[0][0]
    data, cut = encoded(frame, 5, [value])
    assert int.from_bytes(data[2:6], "little", signed=True) == raw
    assert (data[:2], cut) == (b"\5\0", limited)


def test_bits_that_a_signal_does_not_have_are_not_cut(own):
    file, ports = own
    text = file.read_text().replace(" : 16|32@1-", " : 16|8@1-").replace("[-12|12]", "[0|0]")
    file.write_text(text)
    frame = frames_of(file, "n", *ports)[0][0]
    assert encoded(frame, 1, [11.0])[0][2] == 127


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused(own, value):
    file, ports = own
    with pytest.raises(RunError, match="u_v_position would be"):
        encoded(frames_of(file, "n", *ports)[0][0], 1, [value])


def answer(db, tick, w, i):
    rows = {"n_from_1": {"tick": tick, "y_w_position": w}, "n_from_2": {"tick": tick, "y_i_position": i}}
    for name, row in rows.items():
        message = db.get_message_by_name(name)
        row = {s.name: row.get(s.name, 0) for s in message.signals}
        yield can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=message.encode(row, strict=False))


def test_real_time_counts_lost_and_late_answers_and_never_takes_another_ticks(own):
    file, ports = own
    channel, db = f"live{next(channels)}", cantools.database.load_file(file)
    with can.Bus(interface="virtual", channel=channel) as here, can.Bus(interface="virtual", channel=channel) as there:
        line = CanLine("can:virtual/x", here, frames_of(file, "n", *ports), 0.05)
        assert line.live(0, (1.0,), 0.001) is None
        for frame in [*answer(db, 0, 1.0, 2.0), *answer(db, 1, 3.0, float("nan"))]:
            there.send(frame)
        assert line.live(1, (1.0,), 0.001) is None
        assert (line.counts.lost, line.counts.late, line.counts.damaged) == (1, 1, 1)


def test_without_an_echo_the_newest_values_count_until_they_are_old(own):
    file, ports = own
    lines = file.read_text().splitlines(keepends=True)
    at = next(k for k, line in enumerate(lines) if "n_from_1" in line)
    file.write_text("".join(line for k, line in enumerate(lines) if not (k > at and " SG_ tick " in line)))
    channel, db = f"old{next(channels)}", cantools.database.load_file(file)
    with can.Bus(interface="virtual", channel=channel) as here, can.Bus(interface="virtual", channel=channel) as there:
        line = CanLine("can:virtual/x", here, frames_of(file, "n", *ports), 0.02)
        for frame in answer(db, 0, 1.5, 2.5):
            there.send(frame)
        assert line.live(0, (1.0,), 0.0) == (1.5, 2.5)
        threading.Event().wait(0.03)  # the values grow old
        assert line.live(1, (1.0,), 0.0) is None
        with pytest.raises(RunError, match="no signal tick"):
            line.paired(0, (1.0,))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("u_v", "u_w", "is none of u_v"),
        ("n_to_1", "m_to_1", "has the signal u_v"),
        ("0|16@1+", "0|12@1+", "of 16 bits"),
    ],
)
def test_a_dbc_that_does_not_fit_is_refused(own, old, new, said):
    file, ports = own
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ScenarioError, match=said):
        frames_of(file, "n", *ports)


def test_two_nodes_may_share_a_bus_but_no_identifier(tmp_path):
    (tmp_path / "a.dbc").write_text("BO_ 256 a_to_1: 8 softrig\n")
    (tmp_path / "b.dbc").write_text("BO_ 257 b_to_1: 8 softrig\n")
    entry = {n: LinkEntry(port="can:virtual/0", firmware=str(tmp_path / f"{n}.dbc")) for n in "ab"}
    require_own_ports(entry, "s")
    (tmp_path / "b.dbc").write_text("BO_ 256 b_to_1: 8 softrig\n")
    with pytest.raises(ScenarioError, match="one CAN identifier, 0x100"):
        require_own_ports(entry, "s")
