"""The verbs ``softrig export arduino``, ``softrig export cortex-m`` and ``softrig export dbc``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..board.dbc import build_of, printed
from ..command_line import Number, Parser, export_parser
from ..errors import ScenarioError
from ..export.golden import member_of
from ..run.expand import rig_of
from .can_files import export_can
from .check import DEBIAN, checked
from .files import BAUD, export_firmware

CORES = ("cortex-m3", "cortex-m4", "cortex-m7")


def arduino(arguments: Sequence[str]) -> int:
    """Run the verb ``export arduino``."""
    parser = _parser(
        "arduino", "A node of a scenario as an Arduino sketch that answers its ticks over the serial port."
    )
    parser.add_argument(
        "--check", action="store_true", help=f"build NODE.elf, run it in simavr and compare (Debian: {DEBIAN})"
    )
    options = parser.parse_args(arguments)
    return _exported(options, "arduino")


def cortex_m(arguments: Sequence[str]) -> int:
    """Run the verb ``export cortex-m``."""
    parser = _parser("cortex-m", "A node of a scenario as firmware of a Cortex-M, without CMSIS, with a linker script.")
    parser.add_argument("--core", choices=CORES, default=CORES[1], help="of the board (cortex-m4)")
    parser.add_argument("--check", action="store_true", help="build NODE.elf, run it in qemu and compare")
    options = parser.parse_args(arguments)
    return _exported(options, options.core)


def dbc(arguments: Sequence[str]) -> int:
    """Run the verb ``export dbc``."""
    parser = export_parser("dbc", "The ports of a node as the signals of a CAN bus.")
    parser.add_argument("node", metavar="NODE", help="of the scenario")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the DBC (./NODE.dbc)")
    parser.add_argument("--id", default="0x100", help="identifier of the first message (0x100); the next ones follow")
    parser.add_argument(
        "--code", type=Path, metavar="DIR", help="folder for the node as C, and for C that answers these messages"
    )
    options = parser.parse_args(arguments)
    try:
        first_id = int(options.id, 0)
    except ValueError:
        first_id = -1
    if first_id < 0:
        raise ScenarioError(f"--id {options.id}: expected a whole number from 0 to 0x7ff")
    rig = rig_of(options.scenario)
    member = member_of(rig, options.node)
    build = build_of(member.block_class, member.params)
    text = printed(member.name, *member.block_class.ports(member.params), first_id, build)
    file = options.out or Path(f"{options.node}.dbc")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(text.encode("cp1252", "replace"))
    print(f"{file}: {text.count(chr(10) + 'BO_ ')} messages, {text.count(chr(10) + ' SG_ ')} signals")
    if options.code is not None:
        export_can(rig, options.node, file, build, options.code)
        print(f"{options.code}: {', '.join(sorted(p.name for p in options.code.iterdir() if p.is_file()))}")
    return 0


def _parser(verb: str, description: str) -> Parser:
    parser = export_parser(verb, description)
    parser.add_argument("node", metavar="NODE", help="of the scenario, with its parameters there")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the files (./NODE)")
    parser.add_argument(
        "--baud", type=Number(int, 300, 4_000_000), default=BAUD, help="bits a second of the serial port (115200)"
    )
    return parser


def _exported(options: Any, board: Any) -> int:
    folder = options.out or Path(options.node)
    name, layout = export_firmware(rig_of(options.scenario), options.node, folder, board, baud=options.baud)
    print(f"{folder}: {', '.join(sorted(p.name for p in folder.iterdir() if p.is_file()))}")
    if not options.check:
        return 0
    result = checked(folder, name, layout, board)
    print(f"{options.node} on {board}: {result}")
    return int(result.differing > 0)
