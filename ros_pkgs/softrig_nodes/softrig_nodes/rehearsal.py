"""A discarded tick before the first one: it loads or compiles everything that a block uses first during a run."""

from __future__ import annotations

import sys
import warnings
from contextlib import suppress
from typing import Any

from softrig_core.block.block import Block, Plant
from softrig_core.block.held import ByHand
from softrig_core.errors import FAILURES
from softrig_core.kit.jit import Jit
from softrig_core.solver.solver import Solver


def rehearse(block_class: type[Block], params: Any, name: str, always: bool = False) -> bool:
    """Run one tick of a temporary block if its class uses native code that is compiled at the first call.

    Otherwise the first tick would take seconds in lockstep. In real time all deadlines in that time would be missed.

    Parameters
    ----------
    always : bool
        Run the tick for any class: in real time, an import in the first tick also makes it late.

    Returns
    -------
    bool
        Whether a tick was run. An error here is not reported; it occurs again in the run.
    """
    if issubclass(block_class, Solver) or not (always or _native(block_class)):
        return False
    with suppress(*FAILURES), warnings.catch_warnings():
        # Warnings about these invented values would mislead.
        warnings.simplefilter("ignore")
        block = block_class(params, name)
        spare = ByHand(block)
        inputs, _ = block.ports(params)
        values = {port.name: port.initial for port in inputs}
        if isinstance(block, Plant):
            spare.outputs(0)
            spare.advance(0, **values)
        else:
            spare.update(0, **values)
        block.warm_up()
    return True


def _native(block_class: type[Block]) -> bool:
    """Return whether a module of the class, or one that it has a function or class from, has such functions."""
    seen: set[str] = set()
    for cls in block_class.__mro__:
        for value in vars(sys.modules[cls.__module__]).values():
            seen.add(getattr(value, "__module__", None) or "")
        seen.add(cls.__module__)
    package = block_class.__module__.split(".")[0]
    modules = [sys.modules[m] for m in sorted(seen) if m.split(".")[0] == package and m in sys.modules]
    return any(isinstance(value, Jit) for module in modules for value in vars(module).values())
