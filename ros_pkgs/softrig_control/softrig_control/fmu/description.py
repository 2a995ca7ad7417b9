"""Reader of an FMU's modelDescription.xml by FMPy, with units converted to those of the suite."""

from __future__ import annotations

import contextlib
import hashlib
import math
import re
import tempfile
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from softrig_core import ParameterError, ScenarioError, resource
from softrig_core.errors import closest
from softrig_core.extras import need
from softrig_core.judge.units import base, powers, text
from softrig_core.kit.compiled import cache_folder
from softrig_core.kit.file_format import number_of

from .table import FMI, attributes, names as names_of

DESCRIPTION = "modelDescription.xml"
LARGEST = 1 << 29  # bytes of an FMU when unpacked
DEEPEST = 50  # folders in each other
LONGEST = 10_000  # values of an array
PRINTED = 1e-3  # relative tolerance, because tools print the factors of units with few digits
_VERSION = re.compile(r"""fmiVersion\s*=\s*["']([^"']*)["']""")
_INDEXED = re.compile(r"(?P<name>.+)\[(?P<at>\d+(,\d+)*)\]")
BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")  # base units of FMI
# how FMPy's methods call the types: of FMI 2.0, of FMI 3.0
KINDS = {"Real": "Real", "Integer": "Integer", "Boolean": "Boolean", "Enumeration": "Integer", "String": "String"}
KINDS3 = {name: name for name in ("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64",
                                  "UInt64", "Boolean", "String")} | {"Enumeration": "Int64"}  # fmt: skip


class Unfit(ValueError):
    """The FMU is not supported; the text gives the reason."""


@dataclass(frozen=True)
class Unit:
    """A unit: its name as we write it, and how its values become those of the base units: ``factor * x + offset``."""

    name: str
    factor: float
    offset: float
    base: tuple[tuple[str, int], ...]  # name and power, sorted
    odd: bool = False  # the FMU calls something else by this name than softrig: m may be minutes

    @staticmethod
    def of(name: str) -> Unit:
        """Return a unit that is known by its name alone."""
        factor, exponents = base(name)
        return Unit(name, factor, 0.0, tuple(sorted(exponents.items())))


@dataclass(frozen=True)
class Variable:
    """A scalar variable, or an array; `kind` is the type as FMPy's ``get...`` and ``set...`` call it.

    Attributes
    ----------
    start : str or None
        Of an array all values, separated by spaces.
    unit : Unit or None
        None where unstated.
    tunable : bool
        Whether a parameter may change while it runs.
    dims : tuple of int
        Size of an array.
    relative : bool
        Whether it is a difference: the offset of its unit is then not applied.
    constant : bool
        Whether it can never be set.
    items : tuple of (str, int)
        Names and values of an enumeration.
    element : int or None
        Which of its values, row after row, counted from 0; None of a scalar.
    """

    name: str
    reference: int
    kind: str
    causality: str
    start: str | None
    least: float | None
    largest: float | None
    unit: Unit | None
    tunable: bool = False
    dims: tuple[int, ...] = ()
    relative: bool = False
    constant: bool = False
    items: tuple[tuple[str, int], ...] = ()
    element: int | None = None

    @property
    def count(self) -> int:
        """Number of values."""
        return math.prod(self.dims)

    def at(self, indices: Sequence[int]) -> Variable:
        """Return one value of an array, by its indices, counted from 1 as in Modelica.

        Raises
        ------
        ValueError
            There is none.
        """
        if not self.dims:
            raise ValueError(f"{self.name} is one value, no array: expected {self.name}")
        exists = len(indices) == len(self.dims) and all(1 <= i <= n for i, n in zip(indices, self.dims, strict=True))
        if not exists:
            sizes = " x ".join(map(str, self.dims))
            raise ValueError(f"{self.name} is an array of {sizes} values, expected {self.name}[{_example(self.dims)}]")
        element = 0
        for i, n in zip(indices, self.dims, strict=True):
            element = element * n + i - 1
        return replace(self, name=f"{self.name}[{','.join(map(str, indices))}]", element=element)

    def starts(self) -> list[Any]:
        """Return the start values of all elements.

        Raises
        ------
        ValueError
            A value has the wrong type, or their number is neither one nor the number of elements.
        """
        values: list[Any] = [number_in("start", self.kind, text) for text in (self.start or "0").split()]
        if len(values) not in (1, self.count):
            raise ValueError(f"{len(values)} start values, expected one or {self.count}")
        return values if len(values) == self.count else values * self.count


def number_in(name: str, kind: str, text: str) -> float | int | bool:
    """Read a number of a variable's kind, as the XML of an FMU writes it.

    Raises
    ------
    ValueError
        The text is not of this kind; the message begins with the name.
    """
    if kind == "Boolean":
        if text not in ("true", "false", "1", "0"):
            raise ValueError(f"{name} = {text!r}, expected true or false")
        return text in ("true", "1")
    return _real(name, text) if kind in ("Real", "Float64", "Float32") else _integer(name, text)


def _example(dims: Sequence[int]) -> str:
    return ",".join(f"1..{n}" for n in dims)


@dataclass(frozen=True)
class Description:
    """The parts of an FMU that a rig uses.

    Attributes
    ----------
    version : str
        Of the FMI: ``2.0``, ``3.0``.
    interfaces : tuple of str
        Those of ``co_simulation``, ``model_exchange`` and ``scheduled_execution`` that it has.
    serialises : bool
        Whether its state can be kept as bytes.
    digest : str
        SHA-256 of its file.
    notes : tuple of str
        Parts of its description that have no effect.
    """

    path: Path
    version: str
    interfaces: tuple[str, ...]
    serialises: bool
    variables: dict[str, Variable]
    digest: str
    notes: tuple[str, ...] = ()

    def variable(self, name: str, indices: Sequence[int] | None = None) -> Variable:
        """Find a variable; an element of an array by its indices, counted from 1: ``x[2]``, ``A[1,3]``.

        Raises
        ------
        ValueError
            There is none, or it is of a type that no channel carries.
        """
        indexed = _INDEXED.fullmatch(name)
        if name not in self.variables and indexed and indexed["name"] in self.variables:
            return self.variable(indexed["name"], [int(i) for i in indexed["at"].split(",")])
        if name not in self.variables:
            raise ValueError(
                f"{self.path.name} has no variable {name!r}{closest(name, self.variables)}; it has "
                f"{_listed(list(self.variables))}"
            )
        result = self.variables[name]
        if not result.kind:
            raise ValueError(f"{name} of {self.path.name} is a clock or binary, expected a number or text")
        return result if indices is None and not result.dims else result.at(indices or ())


def describe(source: str) -> Description:
    """Read the description of an FMU.

    Parameters
    ----------
    source : str
        A file, or ``package://PACKAGE/path``.

    Raises
    ------
    ValueError
        There is no such file, it is no FMU of FMI 2.0 or 3.0, or has no binary for this machine.
    """
    if Path(source, DESCRIPTION).is_file():
        raise ValueError(f"{source} is an unpacked FMU, expected the file: `cd {source} && zip -r ../m.fmu .` makes it")
    path = resource(source, "FMU").resolve()
    stat = path.stat()
    return _describe(path, stat.st_mtime_ns, stat.st_size)


def unpacked(path: Path) -> Path:
    """Return the folder with the content of an FMU, in the cache: a killed node leaves no files behind.

    Raises
    ------
    ParameterError
        It cannot be unpacked, or is larger or deeper than `LARGEST` and `DEEPEST` allow.
    """
    folder = cache_folder() / "fmu" / _digest(path)[:32]
    if folder.is_dir():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Unpacked beside the target and then renamed, so that no other node finds half of the content.
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix="unpacking_") as scratch:
        content = Path(scratch, "fmu")
        try:
            with zipfile.ZipFile(path) as archive:
                _check_content(archive)
                archive.extractall(content)
        except (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ParameterError(f"parameter fmu = {str(path)!r} cannot be unpacked: {error}") from None
        # Another node may have unpacked the same FMU in the meantime; its folder has the same content.
        with contextlib.suppress(OSError):
            content.rename(folder)
    return folder


def _check_content(archive: zipfile.ZipFile) -> None:
    """Refuse contents that would fill a disk or a stack; zipfile truncates an entry longer than its stated size."""
    size = sum(entry.file_size for entry in archive.infolist())
    if size > LARGEST:
        raise ValueError(f"{size / 1e6:.0f} MB of content, expected at most {LARGEST / 1e6:.0f} MB")
    for entry in archive.infolist():
        names = entry.filename.split("/")
        if len(names) > DEEPEST:
            raise ValueError(f"{entry.filename[:60]}... is {len(names)} folders deep, expected at most {DEEPEST}")
        if "\\" in entry.filename or ":" in entry.filename or names[0] == "" or ".." in names:
            raise ValueError(f"{entry.filename!r} is not a path inside it")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@cache
def _describe(path: Path, _changed: int, _size: int) -> Description:
    need("fmpy", f"the FMU {path.name}")
    from fmpy import platform, platform_tuple, read_model_description

    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            _check_content(archive)
            if DESCRIPTION not in names and (below := [n for n in names if n.endswith(f"/{DESCRIPTION}")]):
                raise Unfit(
                    f"{path.name} has its {DESCRIPTION} as {below[0]}; zip the content of that folder, not the folder"
                )
            content = archive.read(DESCRIPTION)
            version = _VERSION.search(content[:10_000].decode(errors="replace"))
        if version and version[1] != "2.0" and not version[1].startswith("3.0"):
            raise Unfit(f"{path.name} is of FMI {version[1]}, expected 2.0 or 3.0")
        notes = FMI.check(names_of(content), path.name)
        texts = attributes(content)
        model = read_model_description(str(path), validate=False)
    except (Unfit, ScenarioError):
        raise
    # zipfile and lxml raise errors of many kinds, and FMPy raises bare Exceptions.
    except Exception as error:
        raise ValueError(f"{path} cannot be read as an FMU: {type(error).__name__}: {error}") from None
    machine = platform if model.fmiVersion == "2.0" else platform_tuple
    built = sorted({name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") > 1})
    if machine not in built:
        raise ValueError(f"{path.name} has no binary for this machine, {machine}; it has {', '.join(built) or 'none'}")
    units: dict[str, Unit] = {}
    for u in model.unitDefinitions:
        if u.name in units:
            raise ValueError(f"{path.name}: two units are called {u.name!r}")
        units[u.name] = _unit(u, path.name)
    types = KINDS if model.fmiVersion == "2.0" else KINDS3
    variables: dict[str, Variable] = {}
    for v in model.modelVariables:
        if v.name in variables:
            raise ValueError(f"{path.name}: two variables are called {v.name!r}, so which one is meant is unknown")
        try:
            variables[v.name] = _variable(v, types.get(v.type, ""), units, texts)
        except (ValueError, TypeError, AttributeError) as error:
            raise ValueError(f"{path.name}: variable {v.name!r}: {error}") from None
    results = {
        "co_simulation": model.coSimulation,
        "model_exchange": model.modelExchange,
        "scheduled_execution": model.scheduledExecution,
    }
    either = model.coSimulation or model.modelExchange
    return Description(
        path,
        model.fmiVersion,
        tuple(name for name, present in results.items() if present is not None),
        bool(either and either.canGetAndSetFMUstate and either.canSerializeFMUstate),
        variables,
        _digest(path),
        tuple(notes),
    )


def _variable(v: Any, kind: str, units: Mapping[str, Unit], attributes_of: Mapping[str, Mapping[str, str]]) -> Variable:
    """Create a variable from FMPy's.

    Raises
    ------
    ValueError
        A number cannot be read, or the numbers of start values and elements differ.
    """
    unit = _declared(v, "unit", attributes_of)
    known = None if not unit else units.get(unit) or Unit.of(_plain_unit(unit))
    sizes = [d.start if d.start is not None else d.variable.start for d in v.dimensions or ()]
    dims = tuple(_integer("Dimension", size) for size in sizes)
    if dims and not 1 <= math.prod(dims) <= LONGEST:
        raise ValueError(f"an array of {' x '.join(map(str, dims))} values, expected 1 to {LONGEST}")
    start = " ".join(map(str, v.start)) if isinstance(v.start, list | tuple) else v.start
    least, largest = (
        None if text is None or kind in ("String", "") else _real(name, text)
        for name in ("min", "max")
        for text in (_declared(v, name, attributes_of),)
    )
    if least is not None and largest is not None and least > largest:
        raise ValueError(f"min = {least:g} is above max = {largest:g}")
    variable = Variable(
        v.name,
        v.valueReference,
        kind,
        v.causality,
        start,
        least,
        largest,
        known,
        v.variability == "tunable",
        dims,
        _declared(v, "relativeQuantity", attributes_of) in (True, "true", "1"),
        v.variability == "constant",
        tuple((item.name, _integer("value of its type", item.value)) for item in getattr(v.declaredType, "items", ())),
    )
    if start is not None and kind not in ("String", ""):
        variable.starts()
    return variable


def _real(name: str, text: object) -> float:
    number = number_of(str(text))
    if math.isnan(number):
        raise ValueError(f"{name} = {str(text)!r}, expected a number")
    return number


def _integer(name: str, text: object) -> int:
    if not re.fullmatch(r"\s*[-+]?[0-9]{1,20}\s*", str(text)):
        raise ValueError(f"{name} = {str(text)!r}, expected a whole number")
    return int(str(text))


def _declared(variable: Any, name: str, texts: Mapping[str, Mapping[str, str]]) -> Any:
    """Return an attribute of a variable unchanged, or that of its declared type if the variable has none."""
    result = texts.get(variable.name, {}).get(name) or getattr(variable, name, None)
    return getattr(variable.declaredType, name, None) if result in (None, "") else result


def _plain_unit(name: str) -> str:
    """Write a unit as ours are: ``N.m/rad2`` of Modelica is ``N m/rad^2``."""
    plain = name.replace(".", " ").replace("Ohm", "ohm")
    return re.sub(r"(?<=[A-Za-z])(-?\d)", r"^\1", plain)


def _unit(value: Any, file: str) -> Unit:
    """Return a unit of FMPy's; `odd` if its name has another meaning here.

    Raises
    ------
    ValueError
        A number cannot be read, or the factor is not above zero.
    """
    name, defined = _plain_unit(value.name), value.baseUnit
    if defined is None:
        return Unit.of(name)
    try:
        powers = {b: _integer(b, getattr(defined, b) or 0) for b in BASES}
        factor, offset = _real("factor", defined.factor), _real("offset", defined.offset)
    except ValueError as error:
        raise ValueError(f"{file}: unit {value.name!r}: {error}") from None
    if not (0.0 < factor < math.inf and abs(offset) < math.inf):
        raise ValueError(
            f"{file}: unit {value.name!r}: factor {factor:g} and offset {offset:g}, expected a factor above 0"
        )
    exps = tuple(sorted((b, power) for b, power in powers.items() if power))
    named = Unit.of(name)
    # The unit equals one of SI under a name that is unknown here, so the name of SI replaces it.
    if (factor, offset) == (1.0, 0.0):
        return named if named.base == exps and named.factor == 1.0 else Unit(text(dict(exps)), 1.0, 0.0, exps)
    same = named.base == exps and math.isclose(named.factor, factor, rel_tol=PRINTED) and not offset
    known = all(unit in BASES for unit, _ in named.base)
    return Unit(name, factor, offset, exps, odd=known and not same)


def conversion(variable: Variable, wanted: str) -> tuple[float, float]:
    """Return how values of a variable become those of a port: ``scale * x + offset``.

    Parameters
    ----------
    wanted : str
        Unit at the port; empty: that of the variable.

    Raises
    ------
    ValueError
        They measure different quantities, or the FMU defines its unit otherwise than softrig and `wanted` is empty.
    """
    if variable.unit is None:
        return 1.0, 0.0
    if variable.unit.odd and not wanted:
        name, in_base = variable.unit.name, text(dict(variable.unit.base)) or "1"
        raise ValueError(
            f"{variable.name} is in {name!r}, which the FMU defines as {variable.unit.factor:g} {in_base} and softrig "
            f"does not; write the unit of the channel before the =, such as [{in_base}]"
        )
    if not wanted or (not variable.unit.odd and powers(wanted) == powers(variable.unit.name)):
        return 1.0, 0.0
    port = Unit.of(wanted)
    if port.base != variable.unit.base:
        raise ValueError(
            f"{variable.name} is in {variable.unit.name!r}, expected {wanted!r}, which is another quantity"
        )
    offset = 0.0 if variable.relative else variable.unit.offset
    return variable.unit.factor / port.factor, offset / port.factor


def _listed(names: list[str]) -> str:
    return ", ".join(names[:30]) + (f" and {len(names) - 30} more" if len(names) > 30 else "")
