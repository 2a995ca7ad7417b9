"""Compile exported C and compare it with its golden rows, on this machine or on a Cortex-M under qemu."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from ..errors import ScenarioError

# gcc from 12 on reads two numbers that were written one by one in one load, for which a processor waits
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fno-tree-slp-vectorize")
PATIENCE = 120.0  # s
# machine of qemu and flags of gcc; none has the bits of another machine's libm, see `Exported.libm`
BOARDS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "cortex-m3": ("mps2-an385", ("-mcpu=cortex-m3",)),
    "cortex-m4": ("mps2-an386", ("-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")),
    "cortex-m7": ("mps2-an500", ("-mcpu=cortex-m7", "-mfloat-abi=hard", "-mfpu=fpv5-d16")),
}
TOOLS = "apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"


@dataclass(frozen=True)
class Replayed:
    """Comparison of C code with golden rows.

    Attributes
    ----------
    rows : int
        Calls.
    differing : int
        Numbers whose bits differ.
    gave_up : int
        Calls that were answered by SR_GAVE_UP.
    wrong_status : int
        Calls in which Python raised an error and C did not, or the other way round.
    errors : list of (float, float)
        For each published value, over the calls of the run: largest difference, and largest magnitude.
    flash : int
        Code and constants of the node on a board, bytes; 0 on this machine.
    """

    rows: int
    differing: int
    gave_up: int
    wrong_status: int
    errors: list[tuple[float, float]]
    flash: int = 0

    @property
    def same(self) -> bool:
        """Return whether there were rows and all bits are equal."""
        return self.rows > 0 and not self.differing and not self.wrong_status


def replayed(folder: Path, name: str, board: str = "") -> Replayed:
    """Compile and run the replay program of an exported block.

    Parameters
    ----------
    folder : Path
        With its files.
    name : str
        Prefix of them.
    board : str
        One of `BOARDS`, simulated by qemu; empty: this machine.

    Raises
    ------
    ScenarioError
        A tool is missing, the compiler refuses the code, or the program does not end by itself.
    """
    program = folder.resolve() / f"{name}_replay.elf"  # it runs in the folder, so a relative path would be wrong
    about = json.loads((folder / f"{name}.json").read_text())
    files = [f"{name}_replay.c", f"{name}.c", *about["sources"]]
    flash = 0
    try:
        if board:
            machine, flags = BOARDS[board]
            compiler, emulator = tool("arm-none-eabi-gcc", TOOLS), tool("qemu-system-arm", TOOLS)
            arm = [compiler, *FLAGS, "-mthumb", *flags]
            with resources.as_file(resources.files(__package__)) as sources:
                linked = ["--specs=rdimon.specs", "-nostartfiles", "-T", str(sources / "cortex_m.ld")]
                _compiled([*arm, *linked, "-o", program.name, str(sources / "cortex_m.c"), *files, "-lm"], folder, name)
            flash = _size([*arm, "-c", "-o", f"{name}.o", f"{name}.c"], folder, name)
            hosted = ["-nographic", "-semihosting-config", "enable=on,target=native", "-kernel", program.name]
            command = [emulator, "-M", machine, *hosted]
        else:
            _compiled([c_compiler(), *FLAGS, "-o", program.name, *files, "-lm"], folder, name)
            command = [str(program)]
        content = json.loads(_ran(command, folder, name))
    finally:
        program.unlink(missing_ok=True)
    return Replayed(**content, flash=flash)


def c_compiler() -> str:
    """Return the C compiler of this machine; raise a ScenarioError if there is none."""
    return next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None) or tool("cc", "apt-get install gcc")


def tool(name: str, install: str) -> str:
    """Return the path of a program; raise a ScenarioError with how to install one that is missing."""
    if (result := shutil.which(name)) is None:
        raise ScenarioError(f"{name} is not installed (Debian: {install})")
    return result


def _compiled(command: Sequence[str], folder: Path, name: str) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE)
    if done.returncode:
        raise ScenarioError(f"{Path(command[0]).name} refuses {name}.c: {done.stderr.strip()[:2000]}")


def _size(command: Sequence[str], folder: Path, name: str) -> int:
    """Return the bytes of code and constants in the object file of a node."""
    _compiled(command, folder, name)
    done = subprocess.run(
        ["arm-none-eabi-size", f"{name}.o"], cwd=folder, capture_output=True, text=True, check=True, timeout=PATIENCE
    )
    (folder / f"{name}.o").unlink()
    text, data, *_ = done.stdout.splitlines()[1].split()
    return int(text) + int(data)


def _ran(command: Sequence[str], folder: Path, name: str) -> str:
    try:
        ran = subprocess.run(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE,
        )
    except subprocess.TimeoutExpired:
        raise ScenarioError(f"the replay of {name}.c did not end within {PATIENCE:g} s") from None
    if ran.returncode not in (0, 1) or not ran.stdout.startswith("{"):
        text = (ran.stderr or ran.stdout).strip()[:500]
        raise ScenarioError(f"the replay of {name}.c ended with status {ran.returncode}: {text}")
    return ran.stdout
