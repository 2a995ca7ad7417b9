"""Where the board of a node is, as scenarios say it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from ..entry import Entry
from ..errors import ScenarioError

SIMULATORS = ("simavr", "qemu", "program")


class LinkEntry(Entry):
    """Where the board of a node is, and what it must run.

    Parameters
    ----------
    port : str
        File of a serial port, or ``simavr:FILE.elf``, ``qemu:FILE.elf``, ``program:FILE``.
    baud : int
        Bits a second of a serial port.
    firmware : str
        Folder or JSON file that ``softrig export`` wrote; the board must have this build.
    timeout : float
        s until a frame is sent again; a board that is silent for 16 times as long ends a lockstep run.
    """

    port: str = Field(min_length=1)
    baud: int = Field(115200, ge=300, le=4_000_000)
    firmware: str = Field(min_length=1)
    timeout: float = Field(0.5, gt=0.0, le=60.0, allow_inf_nan=False)


def absolute_port(port: str) -> str:
    """Return a port whose file, that of a simulator, does not depend on the working directory."""
    kind, colon, name = port.rpartition(":")
    return f"{kind}{colon}{Path(name).resolve()}" if kind in SIMULATORS else port


def require_own_ports(entries: Mapping[str, LinkEntry], where: str) -> None:
    """Ensure that no two nodes have the same port.

    Raises
    ------
    ScenarioError
    """
    seen: dict[str, str] = {}
    for node, entry in entries.items():
        port = os.path.realpath(entry.port) if entry.port.startswith("/") else absolute_port(entry.port)
        if port in seen:
            raise ScenarioError(
                f"{where}: nodes {seen[port]} and {node} have one port, {entry.port}; give each its own"
            )
        seen[port] = node
