"""The entry of a scenario that describes where the board of a node is."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field, field_validator

from ..entry import Entry
from ..errors import ScenarioError
from . import SIMULATORS

CAN, ADS = "can:", "ads:"
LONGEST = 1 << 20  # bytes of a file that describes a node


class LinkEntry(Entry):
    """Link to the board of a node: its port, and the firmware that must run on it.

    Parameters
    ----------
    port : str
        File of a serial port, or ``simavr:FILE.elf``, ``qemu:FILE.elf``, ``program:FILE``; or
        ``can:INTERFACE/CHANNEL``, a CAN bus by an interface of python-can; or ``ads:NETID/PORT`` or
        ``ads:NETID@HOST/PORT``, a PLC.
    baud : int, optional
        Bits a second: of a serial port 115200, of a CAN bus as python-can or the system has it, when absent.
    firmware : str
        Folder or JSON file that ``softrig export`` wrote; the board must have this build. On a CAN bus the DBC, of a
        PLC the file of the program.
    timeout : float
        s until a frame is sent again; a board that is silent for 16 times as long ends a lockstep run.
    """

    port: str = Field(min_length=1, max_length=1024)
    baud: int | None = Field(None, ge=300, le=4_000_000)
    firmware: str = Field(min_length=1, max_length=1024)
    timeout: float = Field(0.5, gt=0.0, le=60.0, allow_inf_nan=False)

    @property
    def shared(self) -> bool:
        """Return whether other nodes may use the port, distinguished by their signals or programs."""
        return self.port.startswith((CAN, ADS))

    @field_validator("port")
    @classmethod
    def _whole(cls, port: str) -> str:
        if not port.isprintable():
            raise ValueError("expected a name without control characters")
        if port.startswith(CAN) and not re.fullmatch(r"can:\w+/.+", port):
            raise ValueError("expected can:INTERFACE/CHANNEL, as in can:socketcan/can0")
        if port.startswith(ADS):
            match = re.fullmatch(r"ads:(\d{1,3}(?:\.\d{1,3}){5})(?:@[\w.-]+)?/(\d{1,5})", port, re.ASCII)
            if match is None or max(map(int, match[1].split("."))) > 255 or int(match[2]) > 65535:
                raise ValueError("expected ads:NETID/PORT or ads:NETID@HOST/PORT, as in ads:192.168.0.5.1.1/851")
        return port


def contents_of(file: Path, longest: int = LONGEST) -> bytes:
    """Return the bytes of a file that a scenario names.

    Raises
    ------
    OSError
        It cannot be read, or is no regular file: one of a device may have no end.
    ValueError
        It is too long.
    """
    if file.exists() and not file.is_file():
        raise OSError(errno.EINVAL, "not a regular file")
    with file.open("rb") as stream:
        data = stream.read(longest + 1)
    if len(data) > longest:
        raise ValueError(f"more than {longest} bytes")
    return data


def absolute_port(port: str) -> str:
    """Return a port whose file, that of a simulator, does not depend on the working directory."""
    kind, colon, name = port.rpartition(":")
    return f"{kind}{colon}{Path(name).resolve()}" if kind in SIMULATORS else port


def require_own_ports(entries: Mapping[str, LinkEntry], context: str) -> None:
    """Ensure that no two nodes use the same port, or on a CAN bus the same identifier.

    Raises
    ------
    ScenarioError
    """
    seen: dict[str, str] = {}
    for node, entry in entries.items():
        for port, noun in _owned(node, entry):
            if port in seen:
                raise ScenarioError(f"{context}: nodes {seen[port]} and {node} have one {noun}; give each its own")
            seen[port] = node


def _owned(node: str, entry: LinkEntry) -> list[tuple[str, str]]:
    """Return the resource that only one node may use, and its name for errors."""
    if entry.port.startswith(ADS):
        return []  # each node has a program of its own name
    if not entry.shared:
        port = os.path.realpath(entry.port) if entry.port.startswith("/") else absolute_port(entry.port)
        return [(port, f"port, {entry.port}")]
    try:
        text = contents_of(Path(entry.firmware)).decode("cp1252", "replace")  # the encoding of DBC files
    except (OSError, ValueError):  # the function that reads the file reports the error
        return []
    ids = re.findall(rf"(?m)^BO_ (\d+) {re.escape(node)}_(?:to|from)_\d+ *:", text)
    return [(f"{entry.port} {i}", f"CAN identifier, {int(i) & 0x1FFFFFFF:#x} at {entry.port}") for i in ids]
