"""The public names of the core: typed, and each imported when it is first used."""

import ast
import inspect
import subprocess
import sys

import pytest
import softrig_core


def typed():
    """Name to module, from the imports that type checkers read."""
    tree = ast.parse(inspect.getsource(softrig_core))
    nodes = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.level]
    return {alias.asname: f"softrig_core.{node.module}" for node in nodes for alias in node.names if alias.asname}


def test_every_public_name_is_typed_and_is_the_one_of_its_module():
    assert typed() == softrig_core._HOME
    # A class that another module defined before.
    for name, module in typed().items() - {("Held", "softrig_core.former")}:
        value = getattr(softrig_core, name)
        assert value is vars(sys.modules[module])[name], name
        written = getattr(value, "__module__", module)
        # The module that defines the class, not one that re-exports it.
        assert written == module or not written.startswith("softrig"), name


def test_an_unknown_name_is_reported():
    with pytest.raises(AttributeError, match="'softrig_core' has no attribute 'Blok'"):
        softrig_core.Blok  # noqa: B018


def test_importing_the_core_loads_nothing_heavy():
    code = "import sys, softrig_core; dir(softrig_core); print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "softrig_core" in out
    assert not {"numpy", "pydantic", "rclpy", "softrig_core.block", "softrig_core.rig", "softrig_core.run"} & {*out}
