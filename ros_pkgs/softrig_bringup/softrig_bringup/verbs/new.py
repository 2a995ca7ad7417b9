"""A package to begin with: a plant, a law, their scenario and tests, which builds and runs as it is."""

from __future__ import annotations

import argparse
import importlib.metadata
import keyword
import os
import re
import shlex
import sys
from importlib.resources import files
from pathlib import Path
from string import Template

from softrig_core import ScenarioError

# template, and where it goes; $name below stands for the package's name
FILES = {
    "package.xml": "package.xml",
    "setup.py": "setup.py",
    "setup.cfg": "setup.cfg",
    "README.md": "README.md",
    "plant.py": "$name/plant.py",
    "controller.py": "$name/controller.py",
    "scenario.yaml": "scenarios/$name.yaml",
    "test.py": "test/test_$name.py",
}
EMPTY = ("$name/__init__.py", "resource/$name")


def command() -> str:
    """Give what a person types to get the command line, for instructions."""
    return shlex.quote(os.environ.get("SOFTRIG_COMMAND") or "softrig")


def first(place: str) -> str:
    """Give how a command begins that uses the package in a relative folder: a wheel's knows what is installed."""
    checkout = "SOFTRIG_COMMAND" in os.environ
    return f"{command()} --workspace {place}" if checkout else f"pip install ./{place} && softrig"


def new_package(name: str, parent: Path) -> Path:
    """Write a package.

    Parameters
    ----------
    name : str
        Of the package: lower-case letters, digits and _.
    parent : Path
        The folder in which its own folder is made.

    Returns
    -------
    Path
        Its folder.

    Raises
    ------
    ScenarioError
        Not a name for a package, one that is taken, or a folder that is there already.
    """
    if not re.fullmatch(r"[a-z]([a-z0-9_]*[a-z0-9])?", name) or "__" in name:
        raise ScenarioError(f"package name {name!r}: expected lower-case letters, digits and single _, as in my_rig")
    taken = name in sys.stdlib_module_names or keyword.iskeyword(name) or name == "test"
    if taken or any(d.name.replace("-", "_").lower() == name for d in importlib.metadata.distributions()):
        raise ScenarioError(f"package name {name!r}: taken by a Python package that is installed here")
    folder = parent / name
    if folder.exists() or folder.is_symlink():
        raise ScenarioError(f"{folder} is there already; choose another name or --into DIR")
    values = {"name": name, "softrig": command(), "first": first(".")}
    source = files("softrig_bringup") / "template"
    texts = {Template(to).substitute(values): Template((source / f"{file}.template").read_text(encoding="utf-8"))
             for file, to in FILES.items()}  # fmt: skip
    for to, text in texts.items():
        _write(folder / to, text.substitute(values))
    for to in EMPTY:
        _write(folder / Template(to).substitute(values), "")
    return folder


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def main(options: argparse.Namespace) -> int:
    """Write a package and say what to do with it."""
    folder = new_package(options.name, options.into)
    shown = shlex.quote(os.path.relpath(folder))
    print(f"wrote {shown}: a plant, a law, their scenario, tests, README.md; now:")
    print(f"  {first(shown)} run {options.name}")
    return 0
