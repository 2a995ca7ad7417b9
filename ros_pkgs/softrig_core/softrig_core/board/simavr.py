"""Programs on libsimavr, compiled when they are first needed and kept in the cache."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path

from ..errors import ScenarioError
from ..kit.compiled import kept

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
    """Compile C files into a program, unless it is in the cache.

    Parameters
    ----------
    files : mapping of str to str
        Text by file name.
    name : str
        Name of the program, in the cache and in errors.
    debian : str
        The command that installs what is missing.

    Raises
    ------
    ScenarioError
        There is no compiler, or it fails on the files; the error contains what to install.
    """
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        raise ScenarioError(f"{name} needs a C compiler (Debian: {debian})")
    try:
        return made_of(files, compiler, FLAGS, libraries, name)
    except subprocess.CalledProcessError as error:
        reason = next((line for line in error.stderr.splitlines() if "error" in line), error.stderr[-300:])
        raise ScenarioError(f"{name} cannot be compiled ({reason.strip()}; Debian: {debian})") from None


def made_of(files: Mapping[str, str], compiler: str, flags: Sequence[str], libraries: Sequence[str], name: str) -> Path:
    """Return the file that a compiler makes of some source files, from the cache if it made it before.

    Parameters
    ----------
    name : str
        Name of the product; the digest is inserted before its suffix.

    Raises
    ------
    subprocess.CalledProcessError
        The compiler fails on the files; its output is in `stderr`.
    """
    stem, suffix = Path(name).stem, Path(name).suffix
    content = "\0".join((*flags, *libraries, *(f"{file}\0{text}" for file, text in sorted(files.items()))))

    def make(product: Path) -> None:
        for file, text in files.items():
            product.with_name(file).write_text(text)
        sources = [file for file in files if file.endswith(".c")]
        command = [compiler, *flags, "-o", product.name, *sources, *libraries, "-lm"]
        subprocess.run(command, cwd=product.parent, capture_output=True, text=True, check=True)

    return kept(f"{stem}-{hashlib.sha256(content.encode()).hexdigest()[:32]}{suffix}", make)
