"""Defaults are part of the interface: each default and constant is written down.

If a default changes, every scenario, call and bag that omits the value changes its meaning without a message; the same
holds for the constants of modules and classes. Beside the default of a parameter the list has its bounds and whether it
may change during a run. After an intended change write the list again:
``scripts/softrig python tests/core/test_defaults.py``.
"""

import inspect
import pkgutil
import re
from enum import Enum
from importlib import import_module
from pathlib import Path

import pytest

LIST = Path(__file__).with_name("defaults.txt")
PACKAGES = ("softrig_core", "softrig_bags", "softrig_control", "softrig_nodes", "softrig_optim", "softrig_drives",
            "softrig_power", "softrig_robots", "softrig_systems", "softrig_bringup")  # fmt: skip
LAZY = (  # modules of an optional package, of numba, or that run when imported
    "softrig_control.fmu.child",
    "softrig_control.fmu.slave",
    "softrig_core.kit._borrowed",
    "softrig_bringup.__main__",
)
BOUNDS = ("gt", "ge", "lt", "le", "min_length", "max_length")
SET = re.compile(r"^_?[A-Z]\w*(?:, _?[A-Z]\w*)*(?=: .* = | = )", re.M)  # names of a module start a line
LONG = 300  # characters; longer tables have tests of their own


def public(package):
    """Functions and classes of a package's modules, with their names, each once; methods after their class."""
    for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
        if module.name in LAZY:
            continue
        for name, result in sorted(vars(import_module(module.name)).items()):
            if getattr(result, "__module__", "") != module.name or name.startswith("_"):
                continue
            if inspect.isfunction(result):
                yield f"{module.name}.{name}", result
            if inspect.isclass(result):
                yield f"{module.name}.{name}", result
                for method, function in sorted(vars(result).items()):
                    function = getattr(function, "__func__", function)
                    if inspect.isfunction(function) and (method == "__init__" or not method.startswith("_")):
                        yield f"{module.name}.{name}.{method}", function


NUMBER = bool | int | float


def text_of(value):
    """A number, or an object of numbers, as text; a TypeError for anything else."""
    if hasattr(value, "tolist"):
        return text_of(value.tolist())
    if isinstance(value, float | complex):
        return f"{value:.12g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{int(value)}"  # members of an enumeration included
    if isinstance(value, bool | str | None):
        return repr(value)
    if isinstance(value, tuple | list):
        return f"({', '.join(text_of(v) for v in value)})"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{text_of(k)}: {text_of(v)}' for k, v in value.items())}}}"
    raise TypeError


def constants(name, home, names):
    """A line for each constant with a number in it, except paths of this machine."""
    for constant in names:
        value = getattr(home, constant, None)
        value = value.value if isinstance(value, Enum) else value
        try:
            words = text_of(value)
        except TypeError:
            continue
        if not isinstance(value, str) and any(c.isdigit() for c in words) and len(words) < LONG and "'/" not in words:
            yield f"{name}.{constant} = {words}"


def parameter(field):
    """Default and bounds of a parameter, and whether it may change during a run."""
    bounds = [f"{name} {getattr(m, name):.12g}" for m in field.metadata for name in BOUNDS if hasattr(m, name)]
    more = [f"{name} {text_of(value)}" for name, value in (field.json_schema_extra or {}).items() if name != "unit"]
    return ", ".join([text_of(field.default), *bounds, *more])


def defaults(package):
    """One line for each default."""
    for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
        if module.name not in LAZY:
            home = import_module(module.name)
            set_here = SET.findall(Path(home.__file__).read_text(encoding="utf-8"))
            yield from constants(module.name, home, [name for names in set_here for name in names.split(", ")])
    for name, result in public(package):
        if inspect.isclass(result) and not hasattr(result, "model_fields"):
            yield from constants(name, result, [k for k in vars(result) if not k.startswith("_")])
            named = getattr(result, "_field_defaults", {})  # defaults of a named tuple
            yield from (f"{name}.{k} = {text_of(v)}" for k, v in named.items() if isinstance(v, NUMBER))
    for name, result in public(package):
        if fields := getattr(result, "model_fields", None):
            own = inspect.get_annotations(result)
            for k in (k for k in fields if k in own):
                try:
                    yield f"{name}.{k} = {parameter(fields[k])}"
                except TypeError:
                    continue
        elif inspect.isfunction(result) and not getattr(result, "__wrapped__", None):
            signature = inspect.signature(result).parameters.values()
            yield from (f"{name}({p.name} = {p.default!r})" for p in signature if isinstance(p.default, NUMBER))


@pytest.mark.parametrize("package", PACKAGES)
def test_no_default_changes_unnoticed(package):
    lines = [line for line in LIST.read_text().splitlines() if line.startswith(f"{package}.")]
    written, now = (dict(line.split(" = ", 1) for line in result) for result in (lines, defaults(package)))
    known = written.keys() & now.keys()
    assert {name: now[name] for name in known} == {name: written[name] for name in known}
    assert len(known) > 0.9 * len(now)  # so most new defaults must be listed


if __name__ == "__main__":
    LIST.write_text("\n".join(line for package in PACKAGES for line in defaults(package)) + "\n")
