"""A package to begin with: a plant, a law or both, a scenario and tests, which builds and runs as it is."""

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
from shutil import rmtree
from string import Template
from typing import NamedTuple

from softrig_core import ScenarioError
from softrig_core.guard import naming
from softrig_core.scenario.scenario_file import find

from ..new.controller import Replaced, replaced
from ..new.native import new_native, next_steps
from ..new.rated import from_data_sheet

# template, and its destination; $name below stands for the package's name
FILES = {"package.xml": "package.xml", "setup.py": "setup.py", "setup.cfg": "setup.cfg", "README.md": "README.md"}
EMPTY = ("$name/__init__.py", "resource/$name")
REMEMBERED = " (a folder given as `--workspace` is remembered; `--workspace none` forgets it)"


class Kind(NamedTuple):
    """Kind of package that `new` creates: description, extra files, dependencies, and a suggested first change."""

    what: str
    files: dict[str, str]
    depends: tuple[str, ...]
    change: str


PLANT, LAW = "$name/plant.py", "$name/controller.py"
CLASSES = {"plant": "Pendulum", "controller": "Controller"}  # classes in the templates, by module
KINDS = {
    "both": Kind(
        "a plant and its control law",
        {"plant.py": PLANT, "controller.py": LAW},
        ("softrig_control",),
        "${name}_controller.r=0.1",
    ),
    "law": Kind("a control law for a plant that is there", {"law.py": LAW}, ("softrig_drives",), "dc_motor_smc.kp=1.5"),
    "for": Kind("a controller that replaces the one of a scenario", {"for_law.py": LAW}, (), ""),
    "plant": Kind("a plant", {"plant.py": PLANT}, ("softrig_control",), "${name}_plant.m=0.3"),
}


def command() -> str:
    """Return the command with which a person calls the command line, for instructions."""
    return shlex.quote(os.environ.get("SOFTRIG_COMMAND") or "softrig")


def first(package: str) -> str:
    """Return the beginning of a command that uses the package in a relative folder; a wheel finds installed
    packages.
    """
    folder = package if package.startswith((".", "/")) else f"./{package}"
    return f"{command()} --workspace {package}" if _checkout() else f"pip install {folder} && softrig"


def _checkout() -> bool:
    return "SOFTRIG_COMMAND" in os.environ


def new_package(name: str, parent: Path, kind: str = "both", swap: Replaced | None = None) -> Path:
    """Write a package.

    Parameters
    ----------
    name : str
        Of the package: lower-case letters, digits and _.
    parent : Path
        The folder in which its own folder is made.
    kind : str
        ``both``, ``law``, ``for`` or ``plant``; see `KINDS`.
    swap : Replaced, optional
        Of kind ``for``: what it replaces.

    Returns
    -------
    Path
        Its folder.

    Raises
    ------
    ScenarioError
        Not a name for a package, one that is taken by a package or a scenario, or a folder that is there already.
    """
    folder = folder_of(name, parent)
    form = KINDS[kind]
    files_of = (
        FILES | form.files | {f"{kind}_scenario.yaml": "scenarios/$name.yaml", f"{kind}_test.py": "test/test_$name.py"}
    )
    modules = [Path(target).stem for target in form.files.values()]
    values = {
        "name": name,
        "softrig": command(),
        "first": first("."),
        "remembered": REMEMBERED if _checkout() else "",
        "colcon": f"{command()} env colcon" if _checkout() else "colcon",
        "What": form.what.capitalize(),
        "modules": ", ".join(f"`{name}/{module}.py`" for module in modules),
        "executables": "\n".join(
            f"    {name}_{module} = {name}.{module}:{CLASSES[module]}.main" for module in sorted(modules)
        ),
        "executable": f"{name}_{modules[0]}",
        "change": Template(form.change).substitute(name=name),
    }
    depends = form.depends
    if swap is not None:
        depends = (swap.package,)
        values |= {"change": swap.change, **swap.values}
    values["depends"] = "\n".join(f"  <exec_depend>{package}</exec_depend>" for package in depends)
    source = files("softrig_bringup") / "template"
    texts = {
        Template(path).substitute(values): Template((source / f"{file}.template").read_text(encoding="utf-8"))
        for file, path in files_of.items()
    }
    try:
        for path, text in texts.items():
            _write(folder / path, text.substitute(values))
        for path in EMPTY:
            _write(folder / Template(path).substitute(values), "")
    except OSError:
        rmtree(folder, ignore_errors=True)  # the folder did not exist before
        raise
    return folder


def folder_of(name: str, parent: Path) -> Path:
    """Check that a name is free and that its folder is not there yet; return that folder.

    Raises
    ------
    ScenarioError
        Not a name for a package, one that is taken by a package or a scenario, or a folder that is there already.
    """
    if not re.fullmatch(r"[a-z]([a-z0-9_]*[a-z0-9])?", name) or "__" in name:
        raise ScenarioError(f"package name {name!r}: expected lower-case letters, digits and single _, as in my_rig")
    used = name in sys.stdlib_module_names or keyword.iskeyword(name) or name == "test"
    if used or any(importlib.metadata.distributions(name=name)):
        raise ScenarioError(f"package name {name!r}: taken by a Python package that is installed here")
    if (clash := find(name)) is not None:
        raise ScenarioError(f"package name {name!r}: `run {name}` is a scenario already ({clash.name}); choose another")
    folder = parent / name
    if folder.exists() or folder.is_symlink():
        raise ScenarioError(f"{folder} exists already; choose another name or --into DIR")
    return folder


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with naming(path):
        path.write_text(text, encoding="utf-8")


def main(options: argparse.Namespace) -> int:
    """Write a package, a controller in another language, or a drive from a data sheet; print the next steps."""
    if options.rated and not options.plant:
        raise ScenarioError("--rated: needs `--plant pmsm`")
    if options.plant:
        if options.only or options.language or options.scenario:
            raise ScenarioError("--plant: writes a scenario; leave --only, --for and --language out")
        print(from_data_sheet(options.name, options.into, options.plant, options.rated, command()))
        return 0
    if options.language:
        if options.scenario:
            raise ScenarioError("--for: writes Python; leave --language out")
        if options.only == "plant":
            raise ScenarioError("--only plant: `--language` writes a law; c_plant runs a plant in C")
        scenario = new_native(options.name, folder_of(options.name, options.into), options.language, command())
        print(next_steps(scenario, options.language, command()))
        return 0
    if options.scenario:
        if options.only != "law":
            raise ScenarioError("--for: writes a controller; give `--only law`, too")
        return _in_place_of(options)
    folder = new_package(options.name, options.into, options.only or "both")
    shown = shlex.quote(os.path.relpath(folder))
    hint = "; `--only law` or `--only plant` writes that alone" if not options.only else ""
    print(f"wrote {shown}: {KINDS[options.only or 'both'].what}, a scenario, tests, README.md{hint}; now:")
    print(f"  {first(shown)} run {options.name}")
    return 0


def _in_place_of(options: argparse.Namespace) -> int:
    """Write a controller that replaces the one of a scenario."""
    swap = replaced(options.scenario, options.name)
    shown = shlex.quote(os.path.relpath(new_package(options.name, options.into, "for", swap)))
    scenario, node = swap.values["extended"], swap.values["node"]
    more = f"; others: {', '.join(f'`--for {scenario}/{name}`' for name in swap.others)}" if swap.others else ""
    print(f"wrote {shown}: a controller in place of {node} of {scenario}, a scenario, tests, README.md{more}; now:")
    print(f"  {first(shown)} run {options.name} --mode inprocess")
    return 0
