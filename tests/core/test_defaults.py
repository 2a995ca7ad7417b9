"""What holds where nobody says anything is part of the interface: each default of the general packages is written down.

A scenario, a call and a bag that leave something out mean another thing when a default changes, without a word. Who
changes one on purpose writes the list anew: ``scripts/softrig python tests/core/test_defaults.py``.
"""

import inspect
import pkgutil
from importlib import import_module
from pathlib import Path

import pytest

LIST = Path(__file__).with_name("defaults.txt")
PACKAGES = ("softrig_core", "softrig_bags", "softrig_control", "softrig_optim")
LAZY = ("softrig_control.fmu.child", "softrig_control.fmu.slave")  # of an extra


def public(package):
    """Functions and classes of a package's modules, with their names, each once; methods after their class."""
    for module in pkgutil.walk_packages(import_module(package).__path__, f"{package}."):
        if module.name in LAZY:
            continue
        for name, found in sorted(vars(import_module(module.name)).items()):
            if getattr(found, "__module__", "") != module.name or name.startswith("_"):
                continue
            if inspect.isfunction(found):
                yield f"{module.name}.{name}", found
            if inspect.isclass(found):
                yield f"{module.name}.{name}", found
                for method, function in sorted(vars(found).items()):
                    function = getattr(function, "__func__", function)
                    if inspect.isfunction(function) and (method == "__init__" or not method.startswith("_")):
                        yield f"{module.name}.{name}.{method}", function


NUMBER = bool | int | float


def defaults(package):
    """A line for each."""
    for name, found in public(package):
        if fields := getattr(found, "model_fields", None):
            own = inspect.get_annotations(found)
            yield from (
                f"{name}.{k} = {f.default!r}" for k, f in fields.items() if k in own and isinstance(f.default, NUMBER)
            )
        elif inspect.isfunction(found) and not getattr(found, "__wrapped__", None):
            given = inspect.signature(found).parameters.values()
            yield from (f"{name}({p.name} = {p.default!r})" for p in given if isinstance(p.default, NUMBER))


@pytest.mark.parametrize("package", PACKAGES)
def test_no_default_changes_without_a_word(package):
    lines = [line for line in LIST.read_text().splitlines() if line.startswith(f"{package}.")]
    written, now = (dict(line.rsplit(" = ", 1) for line in found) for found in (lines, defaults(package)))
    known = written.keys() & now.keys()
    assert {name: now[name] for name in known} == {name: written[name] for name in known}
    assert len(known) > 0.9 * len(now)  # what is new is to be written down, too


if __name__ == "__main__":
    LIST.write_text("\n".join(line for package in PACKAGES for line in defaults(package)) + "\n")
