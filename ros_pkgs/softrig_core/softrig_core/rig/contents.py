"""The contents of a block besides its state x: constants, which no tick may change."""

from __future__ import annotations

import hashlib
import itertools
import math
import types
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..block.block import Block
from ..block.step import Step
from ..errors import Impure
from .outside import CHANGEABLE, all_outside, is_filled, is_foreign, outside

# attributes that the code running a block writes
_RUNNERS = frozenset(
    {"p", "name", "ages", "unanswered", "events", "realtime", "_seed", "_Block__first", "_open", "SCRATCH"}
)
_PLAIN = (type(None), bool, int, float, complex, str, bytes)


def contents(block: Block) -> dict[str, str]:
    """Return a digest of each attribute of a block, with all that it leads to.

    It also detects changes in place: in lists, dicts, arrays, helper objects, random generators, variables that a
    function holds, attributes of the block's classes, and variables of a module or function that its methods name. Of
    classes that are not softrig's own, functions and modules that the methods use are followed, too. Left out are what
    a class names in ``SCRATCH``, cached properties, and what libraries keep outside of Python.
    """
    skipped = _RUNNERS | _scratch(type(block))
    attributes = {f"self.{name}": digest(value) for name, value in vars(block).items() if name not in skipped}
    return attributes | reached(type(block))


def reached(block_class: type[Block]) -> dict[str, str]:
    """Return a digest of the objects outside a block that its code can change, because they outlive a run."""
    skipped, result = _RUNNERS | _scratch(block_class), dict[str, str]()
    for cls in block_class.__mro__:
        if issubclass(cls, Block) and cls.__module__.partition(".")[0] != "softrig_core":
            result |= {
                f"{cls.__name__}.{name}": digest(value)
                for name, value in vars(cls).items()
                if isinstance(value, CHANGEABLE) and not name.startswith("__") and name not in skipped
            }
            results: dict[str, list[Any]] = {}
            for name, value in _outside(cls):
                if name not in skipped:
                    results.setdefault(name, []).append(value)
            result |= {name: digest(values) for name, values in results.items()}
    return result


def _outside(cls: type) -> Iterator[tuple[str, Any]]:
    if is_foreign(cls):
        yield from all_outside(cls)
        return
    for value in vars(cls).values():
        if isinstance(value, types.FunctionType):
            yield from outside(value)


class StartContents:
    """The contents of blocks at the start, for comparison with their contents later.

    Parameters
    ----------
    steps : mapping of str to Step
        The members by name.
    thorough : bool
        Compare all blocks, and once more after the run; else those of classes that have not passed in this process.
    many : bool
        Other runs will follow in this process: for classes that are not softrig's own, compare after the run everything
        that outlives it.

    Attributes
    ----------
    due : float
        When a block's second tick is over and `check` is to be called, ns.
    """

    def __init__(self, steps: Mapping[str, Step], thorough: bool = False, many: bool = False) -> None:
        self._thorough = thorough
        self._begun = {
            name: (step.block, step.block.p, contents(step.block))
            for name, step in steps.items()
            if thorough or type(step.block) not in _passed
        }
        foreign = {name: type(step.block) for name, step in steps.items() if many and is_foreign(type(step.block))}
        self._reached = {name: (cls, reached(cls)) for name, cls in foreign.items()}
        self._left = {name: float(steps[name].schedule.time(1)) for name in self._begun}
        self.due = min(self._left.values(), default=math.inf)

    def check(self, t: float = math.inf) -> None:
        """Compare the blocks that have answered two ticks at t (ns); by default, after a run, all remaining ones.

        A block whose parameters were changed in the meantime has other constants and is left out.

        Raises
        ------
        Impure
            A tick has changed what a block holds besides x; the error names node and attribute.
        """
        for name, (block, params, begun) in self._begun.items():
            if (self._thorough and t == math.inf) or self._left.get(name, math.inf) <= t:
                self._left.pop(name, None)
                if block.p is params and (changed := differing(begun, contents(block))):
                    raise _impure(name, type(block), changed)
                _passed.add(type(block))
        for name, (cls, known) in self._reached.items() if t == math.inf else ():
            if changed := differing(known, reached(cls)):
                raise _impure(name, cls, changed)
        self.due = min(self._left.values(), default=math.inf)


_passed: set[type[Block]] = set()


def _impure(name: str, cls: type[Block], changed: Sequence[str]) -> Impure:
    error = Impure(f"{name}: {in_place(cls, changed)}")
    error.node = name
    return error


def differing(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Return the names whose digests differ, or that only one has."""
    return sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))


def in_place(cls: type[Block], changed: Sequence[str]) -> str:
    """Describe which attributes the ticks of a block change, and what the author can do about it."""
    return (
        f"its ticks change {', '.join(changed)} in place ({cls.__name__}); make its state a field of x, or name the "
        "attribute in SCRATCH if no answer depends on it"
    )


_known_scratch: dict[type, frozenset[str]] = {}


def _scratch(cls: type) -> frozenset[str]:
    if cls not in _known_scratch:
        names: set[str] = set()
        for base in cls.__mro__:
            names |= vars(base).get("SCRATCH", frozenset())
            names |= {name for name, value in vars(base).items() if isinstance(value, cached_property)}
        _known_scratch[cls] = frozenset(names)
    return _known_scratch[cls]


def digest(value: Any) -> str:
    """Return a digest of a value with all that it leads to; see `contents`."""
    result = hashlib.blake2b(digest_size=16)
    seen: dict[int, Any] = {}  # objects by identity; they are kept, so that no identity is used again
    stack = [value]
    while stack:
        item = stack.pop()
        if isinstance(item, _PLAIN):
            result.update(f"{type(item).__name__} {item!r};".encode())
        elif id(item) in seen:
            result.update(b"again;")
        else:
            seen[id(item)] = item
            label, parts = _parts(item)
            result.update(f"{type(item).__qualname__} {label};".encode())
            stack.extend(parts)
    return result.hexdigest()


def _parts(value: Any) -> tuple[str, Iterable[Any]]:
    """Describe a value, and the further objects that it refers to."""
    if isinstance(value, (list, tuple, deque)):
        return str(len(value)), value
    if isinstance(value, (dict, types.MappingProxyType)):
        return str(len(value)), [*value.keys(), *value.values()]
    if isinstance(value, (set, frozenset)):
        return str(sorted(map(repr, value))), ()
    if isinstance(value, (bytearray, memoryview)):
        return bytes(value).hex(), ()
    if type(value).__module__ == "numpy" and hasattr(value, "tobytes"):
        return f"{value.dtype} {value.shape} {value.tobytes().hex() if value.dtype != object else ''}", (
            value.ravel().tolist() if value.dtype == object else ()
        )
    if hasattr(value, "bit_generator"):
        return "", (value.bit_generator.state,)
    if isinstance(value, np.random.RandomState):
        return "", (value.get_state(),)
    if hasattr(value, "getstate"):  # random.Random
        return "", (value.getstate(),)
    if isinstance(value, itertools.count):
        return repr(value), ()
    if isinstance(value, types.GeneratorType):
        return str(value.gi_frame and value.gi_frame.f_lasti), ()
    if isinstance(value, types.FunctionType):
        cells = value.__closure__ or ()
        return value.__qualname__, [cell.cell_contents for cell in cells if is_filled(cell)]
    if isinstance(value, partial):
        return "", (value.func, value.args, value.keywords)
    if isinstance(value, types.MethodType):
        return value.__name__, (value.__self__,)
    if isinstance(value, Block):  # a method of one that is held; the blocks themselves are looked at one by one
        return value.name, ()
    if isinstance(value, (type, types.ModuleType, types.BuiltinFunctionType)):
        return str(value), ()
    return "", _attributes(value)


def _attributes(value: Any) -> list[Any]:
    scratch = _scratch(type(value))
    slots = [name for base in type(value).__mro__ for name in getattr(base, "__slots__", ()) if name[:2] != "__"]
    known = dict(getattr(value, "__dict__", {}))
    known |= {name: getattr(value, name) for name in slots if hasattr(value, name)}
    return [part for name, item in known.items() if name not in scratch for part in (name, item)]
