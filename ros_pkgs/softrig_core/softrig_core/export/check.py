"""Compile exported C with the compiler of this machine and hold it against its golden rows."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from ..errors import ScenarioError

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off")
PATIENCE = 120.0  # s


@dataclass(frozen=True)
class Replayed:
    """How C compared with its rows.

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
        Of each value that is published, over the calls of the run: largest difference, and largest magnitude.
    """

    rows: int
    differing: int
    gave_up: int
    wrong_status: int
    errors: list[tuple[float, float]]

    @property
    def same(self) -> bool:
        """Whether there were rows and all bits are equal."""
        return self.rows > 0 and not self.differing and not self.wrong_status


def replayed(folder: Path, name: str) -> Replayed:
    """Compile and run the replay program of an exported block.

    Parameters
    ----------
    folder : Path
        With its files.
    name : str
        Prefix of them.

    Raises
    ------
    ScenarioError
        There is no C compiler, or it refuses the code.
    """
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        raise ScenarioError("no C compiler: expected cc, gcc or clang on the path (Debian: apt-get install gcc)")
    program = folder / f"{name}_replay"
    command = [
        compiler,
        *FLAGS,
        "-o",
        str(program),
        f"{name}_replay.c",
        f"{name}.c",
        "-lm",
    ]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE)
    if done.returncode:
        raise ScenarioError(f"{compiler} refuses {name}.c: {done.stderr.strip()[:2000]}")
    ran = subprocess.run([str(program)], cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE)
    program.unlink()
    if ran.returncode not in (0, 1):
        raise ScenarioError(f"the replay of {name}.c ended with status {ran.returncode}: {ran.stderr.strip()[:500]}")
    return Replayed(**json.loads(ran.stdout))
