"""Check the executables and figures of a package, using only the package; `colcon test` runs this as its own tests."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import EntryPoint
from typing import Any
from unittest import SkipTest

from ..block.answer import admit
from ..block.block import Block, Plant
from ..block.held import ByHand
from ..block.params import ParameterError, build
from ..block.port import Port, require_distinct
from ..block.schedule import Schedule
from ..solver.solver import Solver
from .contents import contents, differing, digest, in_place
from .installed import block_of

TICKS = 3  # ticks of each block
GROUPS = ("console_scripts", "softrig_figures")
LINTERS = ("flake8", "pep257")  # linters of ament; the repository itself uses ruff and mypy
IGNORED = "D100 D104 D105 D107 D203 D205 D213 D400 D401 D406 D407 D413"  # as ruff does, see pyproject.toml


def package_tests(package: str) -> tuple[Callable[..., None], ...]:
    """Return pytest's hook with the cases of a package, and the tests of an entry point and of a linter."""

    def cases(metafunc: Any) -> None:
        if "point" in metafunc.fixturenames:
            metafunc.parametrize("point", entry_points(package), ids=lambda p: p.name)
        else:
            metafunc.parametrize("linter", LINTERS)

    def test_entry_point(point: EntryPoint) -> None:
        if left := check_entry_point(point):
            raise SkipTest(left)

    def test_linter(linter: str) -> None:
        status = lint(linter, package)
        if status is None:
            raise SkipTest("it is not installed")
        assert status == 0

    return cases, test_entry_point, test_linter


def entry_points(package: str) -> list[EntryPoint]:
    """Return the executables and figure functions of a package; entry points of other groups do not count."""
    result = importlib.metadata.distribution(package).entry_points
    return [p for p in result if p.group in GROUPS]


def lint(linter: str, package: str) -> int | None:
    """Run one of `LINTERS` in the folder of a package's sources; return its status, None if it is not installed."""
    if importlib.util.find_spec(f"ament_{linter}") is None:
        return None
    ignored = ["--convention", "numpy", "--add-ignore", *IGNORED.split(), "--", package]
    arguments = {"flake8": ["--config", "setup.cfg", package, "test"], "pep257": ignored}[linter]
    return int(importlib.import_module(f"ament_{linter}.main").main(arguments))


def check_entry_point(point: EntryPoint) -> str:
    """Load an executable or figure function and check that it can be used with its own defaults.

    A block's ports must have distinct names and topics, the block can be set up, and a plant's outputs at the start are
    finite and the same after a reset. Two ticks on first values change only the state x, and repeated from the same x
    they are the same.

    Returns
    -------
    str
        Why less was checked; empty if everything was checked.

    Raises
    ------
    Exception
        Whatever is wrong with it.
    """
    target: Any = point.load()
    if not callable(target):
        raise TypeError(f"{point.name} = {point.value} is {target!r}, expected a function")
    block_class = block_of(target)
    if block_class is None:
        return ""
    try:
        params = build(block_class.Params, {})
    except ParameterError as error:
        return f"{point.name} has no defaults to begin with: {error}"
    inputs, outputs = block_class.ports(params)
    try:
        require_distinct(inputs, outputs)
    except ValueError as error:
        raise ValueError(f"{point.name}: {error}") from None
    try:
        block = block_class(params, point.name)
    except ParameterError as error:
        if inputs or outputs:
            raise
        return f"{point.name} has no ports before its parameters name them: {error}"
    if isinstance(block, Plant):
        first, second = (_outputs(block, outputs, seed=3) for _ in range(2))
        if first != second:
            raise ValueError(f"{point.name} starts with {first}, after a reset with {second}")
    if not isinstance(block, Solver):  # ticks of a solver start a process
        _check_ticks(point.name, block, inputs)
    return ""


def _check_ticks(name: str, block: Block, inputs: Sequence[Port]) -> None:
    """Check that ticks on first values change only x, and that the same ticks have the same answers."""
    begun, values = contents(block), {port.name: port.initial for port in inputs}
    once, again = (_answers(block, values) for _ in range(2))
    for (t, first), (_, second) in zip(once, again, strict=True):
        if digest(first) != digest(second):
            raise ValueError(
                f"{name} answers the tick at t = {t} ns with {first}, and a second time, from the same state x, "
                f"with {second}; its state must be in x, random numbers must come from self.uniform(k)"
            )
    if changed := differing(begun, contents(block)):
        raise ValueError(f"{name}: {in_place(type(block), changed)}")


def _answers(block: Block, values: Mapping[str, Any]) -> list[tuple[int, Any]]:
    """Return the answers of the first ticks from the first state, each with its time in ns."""
    x, schedule, answers = block.first(), Schedule(block.p.period), []
    for t in map(schedule.time, range(TICKS)):
        if isinstance(block, Plant):
            outputs = block.outputs(x, t)
            x = block.advance(x, t, **values)
        else:
            x, outputs = block.update(x, t, **values)
        answers.append((t, outputs))
    return answers


def _outputs(block: Plant, ports: Any, seed: int) -> list[Any]:
    block.reset(seed)
    outputs = ByHand(block).outputs(0)
    return [admit(outputs, port, block.name, 0) for port in ports]
