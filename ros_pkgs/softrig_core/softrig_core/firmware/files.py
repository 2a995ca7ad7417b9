"""Folders with firmware of one node: for this machine, as an Arduino sketch, for a Cortex-M."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Literal

from ..block.block import Plant, finishes
from ..board.layout import Layout
from ..errors import ScenarioError
from ..export.check import BOARDS
from ..export.command import DRAWN, ROWS, export_c
from ..export.golden import member_of
from ..guard import write_files
from ..rig.rig import Rig
from .link_files import link_files

Board = Literal["host", "arduino", "cortex-m3", "cortex-m4", "cortex-m7"]
BAUD = 115200
MAINS = {"host": "board_host.c", "arduino": "board.ino"}


def export_firmware(
    rig: Rig, node: str, folder: Path, board: Board, *, baud: int = BAUD, rows: int = ROWS, drawn: int = DRAWN
) -> tuple[str, Layout]:
    """Write a node of a rig as firmware that answers its ticks over a serial port.

    Parameters
    ----------
    folder : Path
        The files go here; the Arduino IDE opens a folder whose name is that of the sketch.
    board : str
        ``host`` is a program of this machine.
    baud : int
        Bits a second.
    rows, drawn : int
        Golden rows, see `export_c`.

    Returns
    -------
    str
        Prefix of the files.
    Layout
        Of the frames.

    Raises
    ------
    ScenarioError
        There is no such node, or it has no C.
    """
    member = member_of(rig, node)
    if finishes(member.block_class):
        raise ScenarioError(f"{node} cannot run on a board: it publishes at the end of a run")
    single = board == "arduino"
    done = export_c(rig, node, folder, rows=rows, drawn=drawn, single=single)
    described = folder / f"{done.name}.json"
    known = json.loads(described.read_text())
    settable = {name: type(known["parameters"][name]) for name in done.settable}
    plant = issubclass(member.block_class, Plant)
    layout = Layout(member.inputs, member.outputs, settable, plant, single)
    files = link_files(done.name, layout)
    if board in MAINS:
        main = f"{folder.resolve().name}.ino" if board == "arduino" else "main.c"
        files[main] = filled(MAINS[board], done.name, baud)
    else:
        files["main.c"] = filled("board_cortex_m.c", done.name, baud)
        files["board.ld"] = filled("board.ld", done.name, baud)
        known |= {"core": board, "machine": BOARDS[board][0]}
    files[described.name] = json.dumps(known | {"baud": baud}, indent=1) + "\n"
    write_files(folder, files)
    return done.name, layout


def filled(file: str, name: str, baud: int) -> str:
    """Return a file of this package for a node."""
    text = (resources.files(__package__) / file).read_text()
    return text.replace("@NODE@", name).replace("@BAUD@", str(baud))
