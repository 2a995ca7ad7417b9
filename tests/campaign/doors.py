"""Files, libraries, programs of strangers: read with their meaning, or refused in one line; nothing remains of them."""

import importlib.util
import os
import random
import re
import signal
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from softrig_bringup.pack.cargo import _check_flag
from softrig_control.c_member.ports import described
from softrig_control.fmu.description import describe
from softrig_core import Rig, RunError, Scenario, ScenarioError, load_scenario, rig_of, simulate
from softrig_core.block.port import scalars
from softrig_core.board.dbc import build_of, messages_of, printed
from softrig_core.board.wires import Simulated
from softrig_core.export.command import export_c
from softrig_core.export.golden import member_of
from softrig_core.export.kinds import remark
from softrig_power.dispatch.table_file import read_rows
from softrig_power.fault_location.records.comtrade_file import read_comtrade
from softrig_robots.rigid_body import load_model
from softrig_robots.urdf import read_urdf

ROOT = Path(__file__).parents[2]
STRANGE = (
    "", "-1", "0", "1e999", "nan", "inf", "-0", "1_000", "２", "0x10", "1e-320", "9" * 400, "null", "true", "[]", "{}",
    "\0", "\u202e", "é", "*/", "]]>", "&x;", "<!--", '"', "'", "\\", "%s", "../../x", "/etc/passwd", ",", ";", "\t",
    "\r", "\n",
)  # fmt: skip
RAW = ("NoneType", "object has no", "object is not", "Traceback", "unsupported operand", "codec can't", "Error(")
LONGEST = 3000  # letters of a refusal, which names parameters with their values
URDF = ROOT / "ros_pkgs/softrig_robots/softrig_robots/urdf/two_link.urdf"
UNITS = "unit;p_min_MW;p_max_MW;a_usd_per_MW2h;b_usd_per_MWh;c_usd_per_h\na;1;200;0,002;10;5\nb;1;300;0,003;9;4\n"


def attack(seed: int, directory: Path) -> None:
    """Pass something damaged or hostile to one reader."""
    chance = random.Random(seed)
    door = DOORS[seed % len(DOORS)]
    (directory / "case").write_text(f"seed {seed}, {door.__name__}")
    before = {*Path("/tmp").iterdir()}
    try:
        door(chance, directory)
    except (ScenarioError, RunError, ValueError) as error:
        message = str(error)
        assert len(message) <= LONGEST, f"{len(message)} letters: {message[:200]}"
        assert not [word for word in RAW if word in message], message
    assert not [p for p in {*Path("/tmp").iterdir()} - before if p.name.startswith("softrig_fmu")], "left in /tmp"


def damaged(data: bytes, chance: random.Random) -> bytes:
    """Return a text with one to four parts changed."""
    for _ in range(chance.randint(1, 4)):
        words = re.split(rb"([\s,;:=\"<>{}\[\]]+)", data)
        k = chance.randrange(len(words))
        match chance.randrange(6):
            case 0 | 1:
                words[k] = chance.choice(STRANGE).encode()
            case 2:
                words[k] = words[chance.randrange(len(words))]
            case 3:
                del words[k : k + chance.randint(1, 6)]
            case 4:
                words.insert(k, b"".join(words[k : k + chance.randint(1, 40)]))
            case _:
                content = bytearray(data or b"x")
                content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
                words = [bytes(content)]
        data = b"".join(words)
    return data[: chance.randrange(len(data) + 1)] if chance.random() < 0.05 else data


def described_node(chance: random.Random, directory: Path) -> None:
    """A description of exported code."""
    file = directory / "law.json"
    file.write_bytes(damaged(exported().read_bytes(), chance))
    ports = described(file)
    assert all(abs(x) < float("inf") for port in (*ports.inputs, *ports.outputs) for x in port.safe)


@cache
def exported() -> Path:
    """Export a law once."""
    folder = Path(mkdtemp(prefix="softrig_campaign_"))
    export_c(rig_of("dc_motor_smc_b4", duration=0.05), "dc_motor_pid", folder, rows=2, drawn=2)
    return folder / "dc_motor_pid.json"


def robot(chance: random.Random, directory: Path) -> None:
    """A URDF; the parsed robot has the masses in it."""
    file = directory / "a.urdf"
    file.write_bytes(damaged(URDF.read_bytes(), chance))
    text = read_urdf(str(file))
    model = load_model(text)
    moved = sum(inertia.mass for inertia in list(model.inertias)[1:])
    links = re.findall(r"<link[^>]*?[^/]>.*?</link>", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL), re.DOTALL)
    messages = [float(m) for link in links for m in re.findall(r'<mass\s+value\s*=\s*"([^"]*)"', link)]
    assert not messages or moved <= sum(messages) * (1.0 + 1e-9), f"{moved} kg of {messages}"
    if len(messages) == 2:  # both links move, so no mass may be dropped
        assert abs(moved - sum(messages)) <= 1e-9 * sum(messages), f"{moved} kg of {messages}"


def record(chance: random.Random, directory: Path) -> None:
    """A COMTRADE record."""
    channels = [f"{k + 1},V{p},{p},,V,1.0,0,0,-1e6,1e6,1,1,P" for k, p in enumerate("ABC")]
    channels += [f"{k + 4},I{p},{p},,A,1.0,0,0,-1e6,1e6,1,1,P" for k, p in enumerate("ABC")]
    year = chance.choice(("1999", "2013"))
    lines = [f"s,d,{year}", "6,6A,0D", *channels, "50", "1", "4000,40", *["02/03/2024,10:00:00.000000"] * 2, "ASCII",
             "1"]  # fmt: skip
    cfg = "\r\n".join([*lines, *(["0,0", "4,0"] if year == "2013" else [])]) + "\r\n"
    dat = "".join(f"{n + 1},{250 * n},{','.join(str(k * n) for k in range(6))}\r\n" for n in range(40))
    both = [cfg.encode(), dat.encode()]
    k = chance.randrange(2)
    both[k] = damaged(both[k], chance)
    (directory / "a.cfg").write_bytes(both[0])
    (directory / "a.dat").write_bytes(both[1])
    read_comtrade([directory / "a.cfg"])


def table(chance: random.Random, directory: Path) -> None:
    """A table of units."""
    file = directory / "a.csv"
    file.write_bytes(damaged(UNITS.encode(), chance))
    columns, rows = read_rows(file)
    for row in rows:
        numbers = [row.number(column) for column in columns[1:]]
        assert all(abs(x) < float("inf") for x in numbers)


def signals(chance: random.Random, directory: Path) -> None:
    """A DBC."""
    if importlib.util.find_spec("cantools") is None:
        return
    member = member_of(rig_of("dc_motor_smc_b4", duration=0.05), "dc_motor_pid")
    build = build_of(member.block_class, member.params)
    units = {"v": chance.choice(("V", *STRANGE)), "w": "A"}
    inputs, outputs = (scalars("u", "u", units),), (scalars("y", "y", {"z": "V"}, limits=(12.0,)),)
    file = directory / "a.dbc"
    text = printed("law", inputs, outputs, 0x100, build).encode("cp1252", "replace")
    file.write_bytes(damaged(text, chance) if chance.random() < 0.9 else text)
    result = messages_of(file, "law", inputs, outputs, build)
    assert {k for frame in result.back for k, _ in frame.signals} == {0}


def unit(chance: random.Random, directory: Path) -> None:
    """An FMU's description."""
    text = (
        '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="m" guid="{1}"><CoSimulation '
        'modelIdentifier="m"/><UnitDefinitions><Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit>'
        '</UnitDefinitions><ModelVariables><ScalarVariable name="u" valueReference="1" causality="input"><Real '
        'unit="degC" start="1"/></ScalarVariable><ScalarVariable name="y" valueReference="2" causality="output">'
        '<Real/></ScalarVariable></ModelVariables><ModelStructure><Outputs><Unknown index="2"/></Outputs>'
        "</ModelStructure></fmiModelDescription>"
    )
    file = directory / "m.fmu"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("modelDescription.xml", damaged(text.encode(), chance))
        archive.writestr(chance.choice(("binaries/linux64/m.so", "../x", "/tmp/x", "binaries/../../x")), b"x")
    describe(str(file))


def flag(chance: random.Random, directory: Path) -> None:
    """A flag of a compiler in a pack."""
    parts = ("-", "I", "D", "W", "f", "l", "include", "plugin", "=", "/etc", "..", "@", ",", "x", "O2", "std", " ", "B")
    text = "-" * chance.randrange(2) + "".join(chance.choices(parts, k=chance.randint(1, 5)))
    (directory / "scenario").mkdir()
    _check_flag(directory, "law", text)
    if text[:2] == "-I":
        assert (directory / "scenario" / text[2:]).resolve().is_relative_to(directory.resolve())
    elif not text.startswith("-D"):
        assert not re.search(r"[/@, ]|\.\.|plugin=|^-[BoL]|^-include", text), text


def comment(chance: random.Random, directory: Path) -> None:
    """A text of a user in exported code."""
    text = "".join(chance.choices(("*", "/", "(", ")", "?", "\\", "\n", " ", "a", *STRANGE), k=chance.randint(0, 40)))
    result = remark(text)
    assert not [end for end in ("*/", "/*", "*)", "(*", "??", "\n") if end in result]
    assert not result.endswith("\\")


def with_law(parameters: dict[str, Any]) -> Rig:
    """Wire a rig whose controller is the law of the tests of C members."""
    result = load_scenario("dc_motor_smc_b4").model_dump(exclude={"name"})
    speed, place = "motor/state/shaft/velocity [rad/s] = speed", ROOT / "tests/control/c_laws"
    law = {
        "period": 0.01, "sources": [str(place / "pi.c")], "header": str(place / "pi.h"),
        "trajectories": ["motor/reference"], "outputs": ["motor/command/armature/effort [V] = voltage"],
        "inputs": ["motor/reference/shaft/velocity [rad/s] = reference", speed],
        "values": ["kp [V s/rad] = 0.5", "ki [V/rad] = 2.0", "limit [V] = 12", "period [s] = 0.01"],
    }  # fmt: skip
    result["nodes"]["dc_motor_pid"] = {
        "package": "softrig_control", "executable": "c_controller", "parameters": law | parameters,
    }  # fmt: skip
    del result["nodes"]["dc_motor_metrics"]
    result |= {"figures": {}, "expect": {}, "plots": [], "claims": {}, "requirements": {}, "duration": 0.25}
    return rig_of(Scenario(name="doors", **result))


def program_of(pid: str) -> str:
    """Return the command line of a process, empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text(errors="replace")
    except OSError:
        return ""


def library(chance: random.Random, directory: Path) -> None:
    """A law in C that breaks in one way, in this process or in its own."""
    faults = ("STATIC", "RANDOM", "CRASH", "GIVES_UP", "NOT_A_NUMBER", "CONSTANT", "ABORT", "RECURSE", "EXIT")
    faults += ("ROUNDING", "PRINTS", "CLOSES", "FORKS")
    name = chance.choice(faults)
    apart = name == "CLOSES" or chance.random() < 0.5
    try:
        simulate(with_law({"flags": [f"-DFAULT={name}"], "isolated": apart, "timeout": 0.5}))
    finally:
        children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
        shims = [c for c in children if "shim_" in program_of(c)]
        # The other shims end only when the run is garbage collected.
        ended = ("CRASH", "ABORT", "RECURSE", "EXIT", "CLOSES", "FORKS")
        assert not shims or name not in ended, f"{name}: left {shims}"


def program(chance: random.Random, directory: Path) -> None:
    """A board's program that does not end, prints without end, or closes its streams."""
    script = directory / "board"
    acts = ("trap '' TERM; sleep 100", "yes >&2", "exec <&- >&-; sleep 100", "exit 3", "cat /dev/zero", "kill -STOP $$")
    script.write_text(f"#!/bin/sh\n{chance.choice(acts)}\n")
    script.chmod(0o755)
    wire = Simulated([str(script)])
    try:
        wire.write(b"\0" * 100)
        wire.read(0.05)
    except OSError:
        pass
    finally:
        process = wire._process
        wire.close()
    assert process.returncode is not None
    assert process.returncode in (0, 3, 141, -signal.SIGTERM, -signal.SIGKILL, -signal.SIGXFSZ, -signal.SIGPIPE, 1, 143)


DOORS: list[Callable[[random.Random, Path], None]] = [
    described_node, robot, record, table, signals, unit, flag, comment, robot, record, described_node, library, program,
]  # fmt: skip
