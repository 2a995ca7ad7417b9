"""Memory: all that a block remembers from one tick to the next, found in what its attributes hold.

A block keeps its state as its equations read best: numbers, tuples, arrays, lines of messages, objects of its own. Here
it is seen from outside, so that a rig can be put back to where it was and its state moved, whatever the block is.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import CellType, FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..kit.compiled import Compiled
from ..kit.dde import Trajectory
from ..kit.floats import put, read
from .block import Block, Plant
from .params import Params

Array = NDArray[np.float64]
Numbers = Callable[[str, Array], Array]  # gets (path, numbers) and gives what is to stand in their place
LARGEST = 2**62
NOT_STATE = frozenset({"p", "name", "ages", "reports", "anew", "_seed", "realtime"})


class Memory:
    """What some blocks, and the inputs that they hold, remember.

    Parameters
    ----------
    owners : mapping of str to sequence
        By member: its block, and plain containers that belong to it (a mapping of inputs to held values).

    Notes
    -----
    The numbers are float64 in one row: those of float, complex (two), int and tuples, lists, deques, mappings and
    arrays of them, in objects of the block's own package or of softrig. Words, switches and random generators are kept
    and put back, but are no numbers. What lives elsewhere (another process, a library's object) is not seen.
    """

    def __init__(self, owners: Mapping[str, Sequence[Any]]) -> None:
        self._owners = {name: list(things) for name, things in owners.items()}
        self._own = {
            type(thing).__module__.partition(".")[0]
            for things in self._owners.values() for thing in things if isinstance(thing, Block)
        }  # fmt: skip
        self._named: dict[str, tuple[str, ...]] = {}
        for name, things in self._owners.items():
            for thing in things:
                if isinstance(thing, Plant):
                    self._name(name, thing)

    def save(self) -> Any:
        """Give a copy of all of it, for `restore`."""
        seen: dict[int, Any] = {}
        return [
            [(thing, thing.save()) if hasattr(thing, "law") else self._save(thing, seen) for thing in things]
            for things in self._owners.values()
        ]

    def restore(self, saved: Any) -> None:
        """Go back to what `save` gave, as often as wanted."""
        done: set[int] = set()
        for nodes in saved:
            for node in nodes:
                if hasattr(node[0], "law"):
                    node[0].load(node[1])
                else:
                    _restore(node, done)

    def read(self) -> Array:
        """Give all numbers, in the order of `names`."""
        found: list[Array] = []

        def keep(path: str, x: Array) -> Array:
            found.append(x)
            return x

        self._visit(keep)
        return np.concatenate(found).astype(np.float64) if found else np.empty(0)

    def whole(self) -> NDArray[np.bool_]:
        """Give which of them are whole numbers (an encoder's count, a stamp in ns): others are rounded when written."""
        found: list[NDArray[np.bool_]] = []

        def keep(path: str, x: Array) -> Array:
            found.append(np.full(len(x), x.dtype.kind == "i"))
            return x

        self._visit(keep)
        return np.concatenate(found) if found else np.empty(0, dtype=bool)

    def write(self, numbers: Array) -> None:
        """Put other numbers in, in the order of `names`."""
        at = 0

        def next_ones(path: str, x: Array) -> Array:
            nonlocal at
            at += len(x)
            return numbers[at - len(x) : at]

        self._visit(next_ones)

    def names(self) -> list[str]:
        """Give the name of each number: ``member.attribute``, the paper's where the plant's `state` has it."""
        found: list[str] = []

        def label(path: str, x: Array) -> Array:
            own = self._named.get(path)
            found.extend(
                [f"{path.partition('.')[0]}.{n}" for n in own] if own
                else [path] if len(x) == 1 else [f"{path}[{k}]" for k in range(len(x))]
            )  # fmt: skip
            return x

        self._visit(label)
        counts: dict[str, int] = {}
        for k, name in enumerate(found):  # an attribute x beside one _x
            counts[name] = counts.get(name, 0) + 1
            if counts[name] > 1:
                found[k] = f"{name}#{counts[name]}"
        return found

    def _name(self, member: str, plant: Plant) -> None:
        """Find which numbers a plant's `state` tells: those with which it changes."""
        try:
            state: Any = plant.state
            fields = tuple(state._fields)
        except (NotImplementedError, AttributeError):
            return
        saved = self.save()
        paths: list[tuple[str, int]] = []

        def note(path: str, x: Array) -> Array:
            paths.append((path, len(x)))
            return x

        self._visit(note)
        wanted = np.arange(1.0, len(fields) + 1.0) * 2.0**-10
        for path, size in paths:
            if size != len(fields) or not path.startswith(f"{member}."):
                continue
            self._visit(lambda p, x, path=path: wanted.copy() if p == path else x)  # type: ignore[misc]
            if tuple(plant.state) == tuple(wanted.tolist()):
                self._named[path] = fields
            self.restore(saved)

    # one way through everything ------------------------------------------------------------------------------------

    def _visit(self, numbers: Numbers) -> None:
        seen: set[int] = set()
        for name, things in self._owners.items():
            for thing in things:
                if hasattr(thing, "law"):
                    thing.x = put(thing.x, [numbers(f"{name}.{path}", x) for path, x in read(thing.x)])
                else:
                    self._through(thing, name, numbers, seen)

    def _through(self, value: Any, path: str, numbers: Numbers, seen: set[int]) -> Any:
        """Let `numbers` have all of what a value holds; give the value, made anew where it cannot be changed."""
        kind = type(value)
        if kind is float or isinstance(value, float):
            new = float(numbers(path, np.array([value]))[0])
            return value if new == value else new
        if kind is int and abs(value) < LARGEST:
            new = float(numbers(path, np.array([value]))[0])  # type: ignore[arg-type]
            return value if new == float(value) else round(new)
        if kind is complex:
            re, im = numbers(path, np.array([value.real, value.imag])).tolist()
            return complex(re, im)
        if value is None or kind in (int, str, bool, bytes) or not self._mine(value) or id(value) in seen:
            return value
        if isinstance(value, Trajectory):
            size = len(value.begin)
            order = (int(value.meta[0]) + np.arange(size)) % size  # the oldest first
            for field in ("x0", "x1", "dx0", "dx1"):
                rows = getattr(value, field)
                rows[order] = numbers(f"{path}.{field}", rows[order].ravel()).reshape(rows.shape)
            return value
        if isinstance(value, tuple):
            if value and all(type(x) is float for x in value):
                plain = numbers(path, np.array(value)).tolist()
                return value if tuple(plain) == value else _tuple(value, plain)
            names = getattr(value, "_fields", range(len(value)))
            items = [self._through(x, _joined(path, n), numbers, seen) for n, x in zip(names, value, strict=True)]
            return value if all(a is b for a, b in zip(items, value, strict=True)) else _tuple(value, items)
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            if value.size and value.dtype.kind in "fc" and value.flags.writeable:
                flat = value.ravel().view(np.float64) if value.dtype.kind == "c" else value.ravel()
                row = numbers(path, flat.astype(np.float64))
                value[...] = (row.view(np.complex128) if value.dtype.kind == "c" else row).reshape(value.shape)
        elif isinstance(value, list | deque):
            for k, x in enumerate(list(value)):
                value[k] = self._through(x, _joined(path, k), numbers, seen)
        elif isinstance(value, dict):
            keys = sorted(value) if all(type(k) is int for k in value) else list(value)
            for k, key in enumerate(keys):  # by order: a key may be a time
                name = key if isinstance(key, str) else k
                value[key] = self._through(value[key], _joined(path, name), numbers, seen)
        elif isinstance(value, FunctionType):
            for name, cell in zip(value.__code__.co_freevars, value.__closure__ or (), strict=True):
                _fill(cell, lambda x, name=name: self._through(x, _joined(path, name), numbers, seen))  # type: ignore[misc]
        else:
            for key, x in list(vars(value).items()):
                if not (isinstance(value, Block) and key in NOT_STATE):
                    vars(value)[key] = self._through(x, _joined(path, key), numbers, seen)
        return value

    def _mine(self, value: Any) -> bool:
        """Whether a value may hold something of a state."""
        if isinstance(value, tuple | list | deque | dict | np.ndarray):
            return True
        if isinstance(value, type | Compiled | Params):
            return False
        root = (value.__module__ if isinstance(value, FunctionType) else type(value).__module__ or "").partition(".")[0]
        ours = root.startswith("softrig_") or root in self._own
        return ours and (isinstance(value, FunctionType) or hasattr(value, "__dict__"))

    def _save(self, value: Any, seen: dict[int, Any]) -> Any:
        if id(value) in seen:
            return seen[id(value)]
        node: list[Any] = [value, None]
        if isinstance(value, np.random.Generator):
            node[1] = value.bit_generator.state
        elif isinstance(value, set):
            node[1] = set(value)
        elif value is not None and type(value) not in (float, int, str, bool, bytes, complex) and self._mine(value):
            seen[id(value)] = node
            if isinstance(value, np.ndarray):
                node[1] = value.copy()
            elif isinstance(value, tuple) and all(type(x) is float for x in value):
                pass
            elif isinstance(value, tuple | list | deque):
                node[1] = [self._save(x, seen) for x in value]
            elif isinstance(value, dict):
                node[1] = {key: self._save(x, seen) for key, x in value.items()}
            elif isinstance(value, FunctionType):
                node[1] = [self._save(c.cell_contents, seen) for c in value.__closure__ or () if _full(c)]
            else:
                node[1] = {
                    key: self._save(x, seen) for key, x in vars(value).items() if key not in ("p", "ages")
                }  # fmt: skip
        return node


def _restore(node: Any, done: set[int]) -> Any:
    value, kept = node
    if kept is None or id(node) in done:
        return value
    done.add(id(node))
    if isinstance(value, np.random.Generator):
        value.bit_generator.state = kept
    elif isinstance(value, set):
        value.clear()
        value.update(kept)
    elif isinstance(value, np.ndarray):
        if value.flags.writeable:
            value[...] = kept
    elif isinstance(value, tuple):
        for child in kept:
            _restore(child, done)
    elif isinstance(value, list):
        value[:] = [_restore(child, done) for child in kept]
    elif isinstance(value, deque):
        rows = [_restore(child, done) for child in kept]
        value.clear()
        value.extend(rows)
    elif isinstance(value, FunctionType):
        for cell, child in zip([c for c in value.__closure__ or () if _full(c)], kept, strict=True):
            cell.cell_contents = _restore(child, done)
    else:
        held = value if isinstance(value, dict) else vars(value)
        new = {key: _restore(child, done) for key, child in kept.items()}
        if not isinstance(value, dict):
            new |= {key: held[key] for key in ("p", "ages") if key in held}
        held.clear()
        held.update(new)
    return value


def _full(cell: CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True


def _fill(cell: CellType, change: Callable[[Any], Any]) -> None:
    if _full(cell):
        cell.cell_contents = change(cell.cell_contents)


def _joined(path: str, name: str | int) -> str:
    return f"{path}[{name}]" if isinstance(name, int) else f"{path}.{name.lstrip('_')}"


def _tuple(old: Any, values: Sequence[Any]) -> Any:
    return old._make(values) if hasattr(old, "_make") else tuple(values)
