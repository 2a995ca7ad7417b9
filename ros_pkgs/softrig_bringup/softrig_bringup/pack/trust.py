"""Admission of foreign code: it is listed, confirmed, and only then imported, in a sandbox if there is one."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from softrig_core import ScenarioError
from softrig_core.extras import need
from softrig_core.guard import plain, print_line
from softrig_core.kit.confined import STRANGE, forbidden

from . import sandbox
from .brought import add_packages
from .cargo import LETTERS, Cargo, cargo_of
from .packed import about, digest_of, opened
from .parts import is_pack
from .signature import signed_by


def admitted(options: argparse.Namespace) -> int | None:
    """Allow imports of a repeated run's pack once its code is confirmed; a pack without code needs no confirmation.

    Parameters
    ----------
    options : argparse.Namespace
        Of the verb `run` or `study`; with `trust`, the code counts as confirmed.

    Returns
    -------
    int or None
        The exit status if the run was made in a sandbox; None if it is to be made in this process.

    Raises
    ------
    ScenarioError
        The code is not confirmed, or the pack contains something that may never run.
    """
    path = sandbox.source_of(options)
    if path is None or not is_pack(path):
        return None
    folder = opened(path)
    try:
        cargo = cargo_of(folder, about(folder))
        signer = signed_by(path)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    for name in cargo.kept_out:
        print_line(f"{path}: package {name} is installed here; that one runs, not the one in the pack")
    if not cargo:
        if signer != "unsigned":
            print_line(f"{path}: no code in it, {signer}")
        return None
    if cargo.units:
        # The package is fetched now, because a sandbox has no network.
        need("fmpy", f"the FMU {cargo.units[0].name}")
    if not sandbox.inside():
        _confirm(path, cargo, signer, options.trust)
        if (command := sandbox.command(options)) is not None:
            return sandbox.run(command)
    if cargo.units or cargo.natives:
        os.environ[STRANGE] = "1"
    add_packages(folder.name, cargo.packages)
    return None


def _confirm(path: Path, cargo: Cargo, signer: str, trusted: bool) -> None:
    """List the code that would run, and ask the user to confirm it."""
    print_line(f"{path} (sha256 {digest_of(path)[:LETTERS]}, {signer}) has code that would run here:")
    for line in cargo:
        print_line(f"  {line}")
    if cargo.units and (why := forbidden()):
        print_line(f"  the system allows no namespaces ({why}): an FMU runs with all your rights")
    if trusted:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ScenarioError(f"{path}: its code runs only when somebody confirms it; read it first, then add --trust")
    print(plain(f"softrig: run this code of {path}? [y/N] "), end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ScenarioError(f"{path}: not confirmed; nothing of it has run")
