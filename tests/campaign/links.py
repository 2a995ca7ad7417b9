"""Links to boards, buses and PLCs: wrong files that describe a node, and wrong ADS servers and serial adapters."""

import os
import pty
import random
import socket
import struct
import tempfile
import threading
import time
import tty
from dataclasses import replace
from functools import cache
from pathlib import Path

from softrig_core import ScenarioError, rig_of, simulate
from softrig_core.board.ads_line import AdsLine, _connected
from softrig_core.board.can_line import CanLine, _bus
from softrig_core.board.dbc import build_of, messages_of, printed
from softrig_core.board.entry import LinkEntry
from softrig_core.board.frames import Kind
from softrig_core.board.layout import Layout
from softrig_core.board.line import Build
from softrig_core.errors import RunError
from softrig_core.export.golden import member_of
from softrig_core.export.st_files import written
from softrig_core.firmware.ads_files import link_units
from softrig_core.firmware.files import export_firmware
from softrig_core.scenario.scenario import merge, read_draft

SCENARIO, NODE = "dc_motor_smc_b2", "dc_motor_smc"
TICKS, WAIT = 20, 0.005  # ticks of a session; s a tick
SLOWEST = 3.0  # s for the slowest tick: python-can waits 2 s when it opens an adapter again
WORDS = (b"", b"9" * 400, b'"', b"-", b"1e400", b"null", b"[]", b"{", b"\0", b"\n", b"\xff", b"NaN", b"'")
ANSWERS = ("silent", "close", "garbage", "huge", "errors", "short", "long", "liar", "empty", "late", "length", "frame")


@cache
def known():
    """Return the node and its three files: bytes by suffix."""
    rig, folder = rig_of(SCENARIO), Path(tempfile.mkdtemp())
    member = member_of(rig, NODE)
    name, _ = export_firmware(rig, NODE, folder, "host", rows=3, drawn=1)
    program = written(link_units(member, None), NODE, "tcpou")[f"{NODE}_link.TcPOU"]
    dbc = printed(NODE, member.inputs, member.outputs, 0x100, build_of(member.block_class, member.params))
    json = (folder / f"{name}.json").read_bytes()
    return member, {".json": json, ".dbc": dbc.encode(), ".TcPOU": program.encode()}


def attack(seed: int, directory: Path) -> None:
    """Try one file, one server or one adapter."""
    chance = random.Random(seed)
    member, files = known()
    what = chance.choice(("file", "file", "file", "ads", "slcan"))
    if what == "file":
        damaged(chance, directory, files)
    elif what == "ads":
        plc(chance, member)
    else:
        adapter(chance, directory, member, files[".dbc"])


def damaged(chance: random.Random, directory: Path, files: dict[str, bytes]) -> None:
    """Run a rig whose link names a damaged file: one line reports it, or the missing port."""
    suffix = chance.choice(tuple(files))
    data = bytearray(files[suffix])
    for _ in range(chance.randrange(1, 5)):
        at = chance.randrange(len(data))
        data[at : at + chance.choice((0, 1, 9, 200))] = chance.choice((*WORDS, chance.randbytes(3)))
    file = directory / f"bad{suffix}"
    file.write_bytes(data)
    ports = {".json": "/dev/nowhere", ".dbc": "can:virtual/none", ".TcPOU": "ads:127.0.0.99.1.1/851"}
    link = {"port": ports[suffix], "firmware": str(file), "timeout": 0.001}
    draft = read_draft(SCENARIO)
    try:
        simulate(rig_of(replace(draft, raw=merge(draft.raw, {"nodes": {NODE: {"link": link}}})), duration=0.02))
    except (ScenarioError, RunError) as error:
        message = str(error)
    else:
        raise AssertionError(f"{file.name} ran without a port")
    assert "\n" not in message, message


def session(line, layout: Layout) -> None:
    """Compute ticks in real time: no answer is accepted, and none takes long."""
    values = layout.step.pack(0, 1.0, 0.0, 0.0, True, 0.0)
    for k in range(TICKS):
        begun = time.monotonic()
        try:
            answer = line.try_ask(Kind.STEP, values, WAIT)
        except RunError:
            return
        elapsed = time.monotonic() - begun
        assert answer is None, f"an answer was taken: {answer!r}"
        assert k == 0 or elapsed < SLOWEST, f"tick {k} took {elapsed:.2f} s"  # the first tick opens the link


def plc(chance: random.Random, member) -> None:
    """Connect to a server that answers wrongly."""
    host = f"127.{chance.randrange(1, 255)}.{chance.randrange(255)}.{chance.randrange(1, 255)}"
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind((host, 48898))
        server.listen()
        threading.Thread(target=serve, args=(server, chance.choice(ANSWERS), chance), daemon=True).start()
        layout = Layout(member.inputs, member.outputs, {}, plant=False, single=False)
        build = Build("0badcafe", (1, 100), layout)
        line = AdsLine(f"ads:{host}", lambda wait: _connected(f"ads:{host}.1.1/851", "p", wait), build, 0.02)
        session(line, layout)
        line.close()


def serve(server: socket.socket, kind: str, chance: random.Random) -> None:
    """Answer all clients, one after the other."""
    while True:
        try:
            client, _ = server.accept()
        except OSError:
            return
        threading.Thread(target=answer, args=(client, kind, chance), daemon=True).start()


def answer(client: socket.socket, kind: str, chance: random.Random) -> None:
    """Answer one client: with meaningless bytes, or a right header before wrong data."""
    try:
        while (asked := client.recv(4096)) and kind != "close":
            head, data, length, tcp = asked[6:38], struct.pack("<II", 0, 4) + b"abcd", None, None
            if kind == "garbage":
                client.send(chance.randbytes(chance.randrange(1, 300)))
            elif kind == "huge":
                client.send(struct.pack("<HI", 0, 0xFFFFFFF0) + bytes(500))
            elif kind != "silent":
                data = {
                    "errors": struct.pack("<I", 0x701),
                    "short": struct.pack("<II", 0, 1) + b"x",
                    "long": struct.pack("<II", 0, 900) + bytes(900),
                    "liar": struct.pack("<II", 0, 100_000) + bytes(4),
                    "empty": b"",
                }.get(kind, data)
                length = 0xFFFFFF if kind == "length" else len(data)
                number = chance.randbytes(4) if kind == "late" else head[28:32]
                ams = head[8:16] + head[:8] + head[16:18] + struct.pack("<HII", 5, length, 0) + number + data
                tcp = 3 if kind == "frame" else len(ams)
                client.send(struct.pack("<HI", 0, tcp) + ams)
        client.close()
    except OSError:
        pass


def adapter(chance: random.Random, directory: Path, member, dbc: bytes) -> None:
    """Open a CAN adapter at a serial port that answers as no adapter does."""
    near_end, far_end = pty.openpty()
    tty.setraw(near_end)
    os.set_blocking(near_end, False)
    over = threading.Event()
    known = (b"t1038", b"t103z00\r", b"T1\r", b"t103800\r", b"r1038\r", b"t1028" + b"A" * 16 + b"\r", b"\r" * 20)

    def talk() -> None:
        while not over.wait(0.001):
            try:
                os.write(near_end, chance.choice((*known, chance.randbytes(30))))
                os.read(near_end, 4096)
            except BlockingIOError:
                pass
            except OSError:
                return

    talking = threading.Thread(target=talk)
    talking.start()
    try:
        file = directory / "good.dbc"
        file.write_bytes(dbc)
        build = build_of(member.block_class, member.params)
        entry = LinkEntry(port=f"can:slcan/{os.ttyname(far_end)}", firmware=str(file))
        layout = Layout(member.inputs, member.outputs, {}, plant=False, single=False)
        messages = messages_of(file, NODE, member.inputs, member.outputs, build)
        line = CanLine(entry.port, lambda: _bus(entry)).use(messages, Build(build, (1, 100), layout), 0.02)
        session(line, layout)
        line.close()
    finally:
        over.set()
        talking.join()
        os.close(near_end)
        os.close(far_end)
