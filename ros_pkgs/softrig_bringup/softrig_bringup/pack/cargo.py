"""Code in a pack: packages, FMUs, C members and boards, listed by their true names before any of it runs."""

from __future__ import annotations

import configparser
import hashlib
import importlib.metadata
import keyword
import os
import re
import sys
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from softrig_core import Scenario, ScenarioError, load_scenario
from softrig_core.board import SIMULATORS
from softrig_core.extras import EXTRAS
from softrig_core.judge import registry
from softrig_core.kit.resource import prefixes
from softrig_core.rig.code import OURS, is_ours
from softrig_core.wire.types import TYPES

from .packed import About, digest_of
from .parts import PACKAGES, SCENARIO

GROUPS = ("console_scripts", "softrig_figures", "softrig_policies", "softrig_problems")
LETTERS = 16  # letters of a SHA-256 that are printed
# In bytes. A setup.cfg is read as a whole, and a stranger's may be of any size.
SETUP = 1 << 20
# Python imports these by itself when it starts, so a package of this name would run without a request.
_STARTS = {"sitecustomize", "usercustomize"}
_IMPORT = re.compile(r"^\s*(?:from|import)\s+([A-Za-z_]\w*)|find_spec\(\"(\w+)\"\)", re.MULTILINE)
_POINT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
_TARGET = re.compile(r"(\w+)((?:\.\w+)*):(\w+(?:\.\w+)*)", re.ASCII)
_LISTED = 20  # files of an FMU that are printed
_COMPILED = {".pyc", ".pyo", ".pth"}
_MACHINE = {".so", ".dll", ".dylib", ".pyd"}
_FLAG = re.compile(
    r"-(?:[DU]\w+(?:=.*)?|O\w*|g\d?|w|pedantic|pthread|std=[\w+]+|W[a-z0-9+-]*(?:=[\w+-]+)?|m[a-z0-9-]+(?:=[\w.+-]+)?"
    r"|f(?!dump|profile|plugin|save|callgraph|record|stack-usage|test-coverage|auto-profile)[a-z0-9-]+(?:=(?:on|off|fast|all))?"
    r"|l(?:m|pthread|gfortran|stdc\+\+))",
    re.ASCII,
)
_C = {("softrig_control", "c_controller"), ("softrig_control", "c_plant")}


@dataclass(frozen=True)
class Package:
    """A package that a pack contains.

    Parameters
    ----------
    folder : Path
        Of its sources; the Python package is the folder of its name below.
    files : mapping of str to Path
        By their places in `folder`.
    offers : mapping of str to mapping of str to str
        Entry points by group: name to ``module:function``.
    share : mapping of str to Path
        Files below the install prefix, by their places there.
    """

    name: str
    version: str
    folder: Path
    files: Mapping[str, Path]
    offers: Mapping[str, Mapping[str, str]]
    share: Mapping[str, Path]

    def __str__(self) -> str:
        lines = sum(file.read_bytes().count(b"\n") for file in self.files.values() if file.suffix == ".py")
        digest = hashlib.sha256("".join(f"{k}\0{digest_of(v)}\n" for k, v in self.files.items()).encode()).hexdigest()
        machine = [true_name(target) for target, file in self.files.items() if file.suffix in _MACHINE]
        code = f", machine code {', '.join(machine)}" if machine else ""
        return (
            f"package {self.name} {self.version}: {len(self.files)} files, {lines} lines of Python{code}, "
            f"sha256 {digest[:LETTERS]}"
        )


@dataclass(frozen=True)
class Unit:
    """An FMU in a pack: a file with machine code for some platforms."""

    path: Path
    name: str
    binaries: tuple[str, ...]

    def __str__(self) -> str:
        code = ", ".join(map(true_name, self.binaries)) or "no binary"
        return f"FMU {true_name(self.name)}: {code}, sha256 {digest_of(self.path)[:LETTERS]}"


@dataclass(frozen=True)
class Native:
    """A node that runs code without a package: C that is compiled or loaded, or a board or simulator at a port."""

    node: str
    runs: str

    def __str__(self) -> str:
        return f"node {self.node}: {self.runs}"


@dataclass(frozen=True)
class Cargo:
    """All code of a pack; `kept_out` are packages of its names that are installed here and run in their place."""

    packages: tuple[Package, ...] = ()
    units: tuple[Unit, ...] = ()
    natives: tuple[Native, ...] = ()
    kept_out: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.packages or self.units or self.natives)

    def __iter__(self) -> Iterator[str]:
        yield from map(str, (*self.packages, *self.units, *self.natives))


def true_name(text: str) -> str:
    """Return a name in which every character that could be mistaken for another is shown by its number."""
    return text if text.isascii() and text.isprintable() else ascii(text)[1:-1]


def cargo_of(folder: Path, about: About) -> Cargo:
    """Find all code in an unpacked pack, without importing or building any of it.

    Raises
    ------
    ScenarioError
        A package has the name of a library, offers what is not in it, or would put files elsewhere; the scenario names
        a file outside of the pack, or a package that the pack does not name.
    """
    check_scenario(folder, load_scenario(str(folder / SCENARIO / f"{about.scenario}.yaml")), about)
    packages, kept_out = [], []
    for name in sorted(p.name for p in (folder / PACKAGES).glob("*")):
        if _is_rig_package(name):
            kept_out.append(name)
            continue
        check_name(name)
        packages.append(_read(folder / PACKAGES / name, about))
    files = [f for part in (SCENARIO, PACKAGES) for f in sorted((folder / part).rglob("*")) if f.is_file()]
    brought = {p.folder for p in packages}
    units = [
        Unit(f, str(f.relative_to(folder)), result)
        for f in files
        if (f.is_relative_to(folder / SCENARIO) or brought & {*f.parents}) and (result := _binaries(f)) is not None
    ]
    return Cargo(tuple(packages), tuple(units), tuple(_natives(folder)), tuple(kept_out))


def brings(folder: Path, about: About) -> list[str]:
    """List the code that only the pack has: packages that its nodes need, and nodes that run C or a board."""
    packages = [n for n in about.packages if (folder / PACKAGES / n).is_dir() and not _is_rig_package(n)]
    return [*packages, *dict.fromkeys(native.node for native in _natives(folder))]


def runs_code(scenario: Scenario) -> bool:
    """Return whether nodes of a scenario run C, a board or a simulator, which a pack of it lists as code."""
    return bool(nodes_in_c(scenario)) or any(e.link is not None for e in scenario.nodes.values())


def nodes_in_c(scenario: Scenario) -> list[str]:
    """List the nodes of a scenario that run C."""
    return [name for name, e in scenario.nodes.items() if (e.package, e.executable) in _C]


def _natives(folder: Path) -> Iterator[Native]:
    """Yield the native code of the nodes of a pack's scenarios; compiler flags count, because a flag can start
    a program.
    """
    for file in sorted((folder / SCENARIO).glob("*.yaml")):
        scenario = load_scenario(str(file))
        for node, entry in scenario.nodes.items():
            if entry.link is not None:
                yield Native(node, f"a board at {true_name(entry.link.port)}")
            elif (entry.package, entry.executable) in _C:
                result = filter(None, (_within(text, folder) for text in _texts(entry.parameters)))
                files = [f"{true_name(str(p.relative_to(folder)))} (sha256 {digest_of(p)[:LETTERS]})" for p in result]
                flags = [f"flag {true_name(text)}" for text in _texts(entry.parameters.get("flags", ()))]
                yield Native(node, ", ".join(["C", *files, *flags]))


def _within(text: str, folder: Path) -> Path | None:
    """Return the file of a pack that a parameter names; None if it names none."""
    if not text or len(text) >= 4096 or "\0" in text:
        return None
    result = (folder / SCENARIO / text).resolve()
    return result if result.is_file() and result.is_relative_to(folder) else None


def _binaries(path: Path) -> tuple[str, ...] | None:
    """List the machine code in an FMU; None if the file is not an FMU."""
    if not zipfile.is_zipfile(path):
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError):
        return ()
    code = [n for n in names if n.startswith(("binaries/", "sources/")) and not n.endswith("/")]
    return (*code[:_LISTED], *([f"{len(code) - _LISTED} more"] if len(code) > _LISTED else []))


# names ----------------------------------------------------------------------------------------------------------------


def check_name(name: str) -> None:
    """Refuse a package with the name of an installed module, or of one that softrig imports.

    Raises
    ------
    ScenarioError
    """
    # A package with the name of a module that is imported elsewhere would run in its place.
    if name in sys.stdlib_module_names or name in _STARTS or keyword.iskeyword(name):
        whose = "Python's own"
    elif name.lower().startswith("softrig"):
        whose = "softrig's own"
    elif name in _wanted():
        whose = "a library's that softrig uses"
    elif find_spec(name) is not None or any(importlib.metadata.distributions(name=name)):
        whose = "a library's that is installed here"
    else:
        return
    raise ScenarioError(f"{PACKAGES}/{name}: that name is {whose}; a pack may not replace it: rename the package")


@cache
def _wanted() -> frozenset[str]:
    """List the modules that softrig imports anywhere, also those that are not installed here."""
    results = {*EXTRAS, *(name.partition("/")[0] for name in TYPES), "builtin_interfaces", "rosidl_runtime_py"}
    for entry in sys.path:
        for folder in Path(entry).glob(f"{OURS}*") if entry else ():
            for file in folder.rglob("*.py"):
                results.update(*_IMPORT.findall(file.read_text(encoding="utf-8")))
    return frozenset(results)


def _is_rig_package(name: str) -> bool:
    """Return whether a package of nodes of this name is installed here; it is then used instead of the pack's."""
    marks = (prefix / "share" / "ament_index" / "resource_index" / "packages" / name for prefix in prefixes())
    return not name.startswith("softrig") and find_spec(name) is not None and any(map(os.path.isfile, marks))


# scenario -------------------------------------------------------------------------------------------------------------


def check_scenario(folder: Path, scenario: Scenario, about: About) -> None:
    """Refuse a scenario that uses files outside its pack, or packages that it does not name.

    Raises
    ------
    ScenarioError
    """
    for node, entry in scenario.nodes.items():
        if entry.package not in about.packages and not is_ours(entry.package):
            raise ScenarioError(
                f"node {node} is of package {entry.package!r}, which pack.json does not name; expected one of "
                f"{', '.join([f'{OURS}*', *about.packages])}"
            )
        if (entry.package, entry.executable) in _C:
            for flag in _texts(entry.parameters.get("flags", ())):
                _check_flag(folder, node, flag)
        if entry.link is not None:
            kind, _, file = entry.link.port.partition(":")
            for name in (entry.link.firmware, *([file] if kind in SIMULATORS else ())):
                if not (folder / SCENARIO / name).resolve().is_relative_to(folder.resolve()):
                    raise ScenarioError(
                        f"node {node} links {name[:200]!r}, a file outside of the pack; expected one in it"
                    )
        for value in _texts(entry.parameters):
            path = Path(value) if len(value) < 4096 and "\0" not in value else None
            exists = path is not None and (os.path.isfile(path) or (path.is_absolute() and os.path.exists(path)))
            if exists and path is not None and not path.resolve().is_relative_to(folder.resolve()):
                raise ScenarioError(
                    f"node {node} names {value[:200]!r}, a file outside of the pack; expected one in it"
                )


def _check_flag(folder: Path, node: str, flag: str) -> None:
    """Refuse a compiler flag that could read or start a file outside the pack.

    Only flags known to be harmless are accepted, because compilers have many dangerous ones: ``@FILE``, ``-include
    FILE``, ``-fplugin=``, ``-B``, ``-specs=``, ``-wrapper``, ``-Wl,``, ``-L``, ``-o``.
    """
    within = flag[:2] == "-I" and flag[2:] and (folder / SCENARIO / flag[2:]).resolve().is_relative_to(folder.resolve())
    if not within and not _FLAG.fullmatch(flag):
        raise ScenarioError(
            f"node {node}: flag {flag[:200]!r} may read or start what is not in the pack; expected -D, -U, -O, -std=, "
            "-I of a folder in it, and -f, -W, -m and -l without a file"
        )


def _texts(value: Any) -> Iterable[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for each in value.values():
            yield from _texts(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _texts(each)


# packages -------------------------------------------------------------------------------------------------------------


def _read(folder: Path, about: About) -> Package:
    """Read a package as data."""
    name = folder.name
    files = {str(f.relative_to(folder)): f for f in sorted(folder.rglob("*")) if f.is_file()}
    if not any(target.startswith(f"{name}/") and target.endswith(".py") for target in files):
        raise ScenarioError(f"{PACKAGES}/{name}: no Python in {name}/{name}, expected the package's modules there")
    # Compiled files may hold other code than the sources that a person has read.
    compiled = next((k for k, f in files.items() if f.suffix in _COMPILED or "__pycache__" in f.parts), None)
    if compiled is not None:
        raise ScenarioError(
            f"{PACKAGES}/{name}/{true_name(compiled)}: expected sources alone, as `softrig pack` writes"
        )
    config = _setup(folder)
    if (stated := config.get("metadata", "name", fallback=name)) != name:
        raise ScenarioError(f"{PACKAGES}/{name}/setup.cfg: name = {stated!r}, expected {name}, as its folder is called")
    offers = about.offers.get(name)
    if offers is None:
        offers = {group: dict(_points(config.get("options.entry_points", group, fallback=""))) for group in GROUPS}
        known = config.options("options.entry_points") if config.has_section("options.entry_points") else []
        offers |= {group: {} for group in known if group not in GROUPS}
    _check_offers(name, offers)
    version = about.packages[name]
    version = version if re.fullmatch(r"[A-Za-z0-9.+!_-]{1,50}", version) else "unknown"
    return Package(name, version, folder, files, offers, dict(_share(name, files, config)))


def _setup(folder: Path) -> configparser.ConfigParser:
    """Read setup.cfg, where there is one, as the pairs of words that it is."""
    config = configparser.ConfigParser(delimiters=("=",), interpolation=None)
    config.optionxform = str  # type: ignore[assignment,method-assign] # names keep their case
    file = folder / "setup.cfg"
    try:
        if file.is_file():
            if file.stat().st_size > SETUP:
                raise ScenarioError(f"{PACKAGES}/{folder.name}/setup.cfg: expected at most {SETUP} bytes")
            config.read_string(file.read_text(encoding="utf-8"))
    except (configparser.Error, UnicodeDecodeError) as error:
        raise ScenarioError(f"{PACKAGES}/{folder.name}/setup.cfg: {' '.join(str(error).split())}") from None
    return config


def _points(text: str) -> Iterator[tuple[str, str]]:
    for line in filter(None, map(str.strip, text.split("\n"))):
        point, _, target = (part.strip() for part in line.partition("="))
        yield point, target


def _check_offers(name: str, offers: Mapping[str, Mapping[str, str]]) -> None:
    """Refuse entry points of other kinds than rigs use, of other packages' functions, or with the names of ours."""
    for group, points in offers.items():
        if group not in GROUPS:
            raise ScenarioError(f"{PACKAGES}/{name}: entry points of {group!r}; expected {', '.join(GROUPS)}")
        for point, target in points.items():
            match = _TARGET.fullmatch(target)
            if not _POINT.fullmatch(point) or not match or match[1] != name:
                raise ScenarioError(
                    f"{PACKAGES}/{name}: {group}: {f'{point} = {target}'[:200]!r}; "
                    f"expected NAME = {name}.MODULE:FUNCTION"
                )
            if group == registry.GROUP and point in registry.registered():
                raise ScenarioError(f"{PACKAGES}/{name}: the figure function {point} exists already; rename it")


def _share(name: str, files: Mapping[str, Path], config: configparser.ConfigParser) -> Iterator[tuple[str, Path]]:
    """Yield the data files by their places below the prefix: only those of the package itself."""
    for target, patterns in config.items("options.data_files") if config.has_section("options.data_files") else ():
        parts = target.strip().split("/")
        if target == "share/ament_index/resource_index/packages":
            continue
        if parts[:2] != ["share", name] or ".." in parts or "." in parts or "" in parts:
            raise ScenarioError(
                f"{PACKAGES}/{name}/setup.cfg: data files for {target[:200]!r}; expected them in share/{name}"
            )
        for pattern in filter(None, map(str.strip, patterns.replace("\n", ",").split(","))):
            for relative, file in files.items():
                same = os.path.dirname(relative) == os.path.dirname(pattern)
                if same and fnmatchcase(os.path.basename(relative), os.path.basename(pattern)):
                    yield f"{target}/{file.name}", file
