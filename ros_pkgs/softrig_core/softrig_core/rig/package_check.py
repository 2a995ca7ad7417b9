"""What a package offers, checked with nothing but the package: `colcon test` runs it as the package's own tests."""

from __future__ import annotations

import importlib.metadata
from importlib.metadata import EntryPoint
from itertools import pairwise
from typing import Any

from ..block.answer import admit
from ..block.block import Plant
from ..block.held import ByHand
from ..block.params import ParameterError, build
from .installed import block_of

GROUPS = ("console_scripts", "softrig_figures")


def entry_points(package: str) -> list[EntryPoint]:
    """Give the executables and figure functions that a package offers; none of another group counts."""
    found = importlib.metadata.distribution(package).entry_points
    return [p for p in found if p.group in GROUPS]


def check_entry_point(point: EntryPoint) -> str:
    """Load what a package offers and see that it can be used with its own defaults.

    A block's ports have distinct names and topics of their own, it can be set up, and a plant's outputs at the start
    are finite and the same after a reset.

    Parameters
    ----------
    point : importlib.metadata.EntryPoint

    Returns
    -------
    str
        Why less was checked; empty when all was.

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
    for what, names in (("ports", [p.name for p in (*inputs, *outputs)]), ("topics", [p.topic for p in outputs])):
        twice = [a for a, b in pairwise(sorted(names)) if a == b]
        if twice:
            raise ValueError(f"{point.name} has two {what} named {twice[0]!r}")
    try:
        block = block_class(params, point.name)
    except ParameterError as error:
        if inputs or outputs:
            raise
        return f"{point.name} has no ports before it is told of them: {error}"
    if isinstance(block, Plant):
        first, second = (_outputs(block, outputs, seed=3) for _ in range(2))
        if first != second:
            raise ValueError(f"{point.name} starts with {first}, after a reset with {second}")
    return ""


def _outputs(block: Plant, ports: Any, seed: int) -> list[Any]:
    block.reset(seed)
    found = ByHand(block).outputs(0)
    return [admit(found, port, block.name, 0) for port in ports]
