"""Programs on libsimavr, compiled when they are first needed and kept in the cache."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path

from ..errors import ScenarioError
from ..kit.compiled import cache_folder

DEBIAN = "apt-get install gcc simavr libsimavr-dev libelf-dev"
FLAGS = ("-std=gnu11", "-O2", "-ffp-contract=off")
HEADER = Path("/usr/include/simavr/sim_avr.h")


@cache
def simavr_program(name: str) -> Path:
    """Return the program of ``simavr_NAME.c``, compiled for this machine.

    Raises
    ------
    ScenarioError
        There is no compiler or no libsimavr.
    """
    text = (resources.files(__package__) / f"simavr_{name}.c").read_text()
    return compiled({"main.c": text}, ["-lsimavr", "-lelf"], f"simavr_{name}", DEBIAN)


def compiled(files: Mapping[str, str], libraries: Sequence[str], name: str, debian: str) -> Path:
    """Compile files of C into a program; one that the cache has is not compiled again.

    Parameters
    ----------
    files : mapping of str to str
        Text by file name.
    name : str
        Of the program, in the cache and in errors.
    debian : str
        The command that installs what is missing.

    Raises
    ------
    ScenarioError
        There is no compiler, or it refuses the files; says what to install.
    """
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        raise ScenarioError(f"{name} needs a C compiler (Debian: {debian})")
    content = "\0".join((*FLAGS, *libraries, *(f"{file}\0{text}" for file, text in sorted(files.items()))))
    program = cache_folder() / f"{name}-{hashlib.sha256(content.encode()).hexdigest()[:32]}"
    if program.exists():
        return program
    with tempfile.TemporaryDirectory(dir=program.parent) as scratch:
        for file, text in files.items():
            Path(scratch, file).write_text(text)
        sources = [file for file in files if file.endswith(".c")]
        command = [compiler, *FLAGS, "-o", "product", *sources, *libraries, "-lm"]
        done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, check=False)
        if done.returncode:
            reason = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[-300:])
            raise ScenarioError(f"{name} cannot be compiled ({reason.strip()}; Debian: {debian})")
        Path(scratch, "product").replace(program)
    return program
