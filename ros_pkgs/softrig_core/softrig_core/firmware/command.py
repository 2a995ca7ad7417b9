"""The verbs ``softrig export arduino`` and ``softrig export cortex-m``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..command_line import Parser
from ..run.expand import rig_of
from .check import DEBIAN, checked
from .files import BAUD, export_firmware

CORES = ("cortex-m3", "cortex-m4", "cortex-m7")


def arduino(arguments: Sequence[str]) -> int:
    """Be the verb ``export arduino``."""
    parser = _parser(
        "arduino", "A node of a scenario as an Arduino sketch that answers its ticks over the serial port."
    )
    parser.add_argument(
        "--check", action="store_true", help=f"build NODE.elf, run it in simavr and compare (Debian: {DEBIAN})"
    )
    options = parser.parse_args(arguments)
    return _exported(options, "arduino")


def cortex_m(arguments: Sequence[str]) -> int:
    """Be the verb ``export cortex-m``."""
    parser = _parser("cortex-m", "A node of a scenario as firmware of a Cortex-M, without CMSIS, with a linker script.")
    parser.add_argument("--core", choices=CORES, default=CORES[1], help="of the board (cortex-m4)")
    parser.add_argument("--check", action="store_true", help="build NODE.elf, run it in qemu and compare")
    options = parser.parse_args(arguments)
    return _exported(options, options.core)


def _parser(verb: str, description: str) -> Parser:
    parser = Parser(prog=f"softrig export {verb}", description=description)
    parser.add_argument("scenario", help="name or YAML file")
    parser.add_argument("node", metavar="NODE", help="of the scenario, with its parameters there")
    parser.add_argument("--out", type=Path, metavar="DIR", help="the files go to DIR (./NODE)")
    parser.add_argument("--baud", type=int, default=BAUD, help="bits a second of the serial port (115200)")
    return parser


def _exported(options: Any, board: Any) -> int:
    folder = options.out or Path(options.node)
    name, layout = export_firmware(rig_of(options.scenario), options.node, folder, board, baud=options.baud)
    print(f"{folder}: {', '.join(sorted(p.name for p in folder.iterdir() if p.is_file()))}")
    if not options.check:
        return 0
    found = checked(folder, name, layout, board)
    print(f"{options.node} on {board}: {found}")
    return int(found.differing > 0)
