"""The numbers of a state: its float fields, by the names of the paper."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..arrays import Array


def leaves(x: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of each leaf of a state, such as ``pid.integral``; rows of floats are leaves.

    Named tuples whose class has a property ``aside`` are left out: only the reports of a block depend on them, its
    outputs do not.
    """
    # What such a class holds goes into reports only, so that a linear view need not disturb it.
    if hasattr(type(x), "aside"):
        return
    if isinstance(x, tuple) and not _is_row(x):
        for name, item in zip(getattr(x, "_fields", range(len(x))), x, strict=True):
            yield from leaves(item, f"{path}[{name}]" if isinstance(name, int) else f"{path}.{name}" if path else name)
    else:
        yield path, x


def _is_row(x: tuple[Any, ...]) -> bool:
    return bool(x) and not hasattr(x, "_fields") and all(type(item) is float for item in x)


def read(x: Any, path: str = "") -> Iterator[tuple[str, Array]]:
    """Yield the path and the numbers of each float in a state.

    Floats, complex numbers (two each), arrays of them, and tuples of these, also named ones within: ``pid.integral``.
    Integers, strings and booleans are no part of a linear view (`others`). Objects are opaque, unless they provide
    their numbers by ``numbers()`` and ``with_numbers(row)``, as a history does.
    """
    for name, leaf in leaves(x, path):
        if isinstance(leaf, float):
            yield name, np.array([leaf])
        elif type(leaf) is complex:
            yield name, np.array([leaf.real, leaf.imag])
        elif isinstance(leaf, np.ndarray):
            if leaf.size and leaf.dtype.kind in "fc":
                flat = np.ascontiguousarray(leaf).ravel()
                yield name, (flat.view(np.float64) if leaf.dtype.kind == "c" else flat).astype(np.float64)
        elif isinstance(leaf, tuple):
            yield name, np.array(leaf)
        elif hasattr(leaf, "with_numbers"):
            yield name, leaf.numbers()


def others(x: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of comparable parts that `read` leaves out: integers, words, switches, None."""
    for name, leaf in leaves(x, path):
        if leaf is None or isinstance(leaf, int | str | np.integer | np.bool_):
            yield name, leaf
        elif isinstance(leaf, np.ndarray) and leaf.dtype.kind in "iub":
            yield name, leaf.tolist()


def numbers(x: Any) -> Array:
    """Return all floats of a state in one row."""
    return np.concatenate([np.empty(0), *(row for _, row in read(x))])


def split(x: Any, row: Array) -> list[Array]:
    """Cut a row from `numbers` into the arguments of `put`.

    Raises
    ------
    ValueError
        It has another length than the numbers of the state.
    """
    ends = np.cumsum([len(part) for _, part in read(x)])
    if len(row) != (ends[-1] if len(ends) else 0):
        raise ValueError(f"{len(row)} numbers, expected the {sum(len(part) for _, part in read(x))} of the state")
    return np.split(row, ends[:-1]) if len(ends) else []


def put(x: Any, rows: Sequence[Array]) -> Any:
    """Return the state with other numbers, in the order of `read`; it is x itself where they are the same."""
    return _put(x, iter(rows))


def _put(x: Any, rows: Iterator[Array]) -> Any:
    kind = type(x)
    if hasattr(kind, "aside"):
        return x
    if isinstance(x, float):
        new = float(next(rows)[0])
        # The same object is returned where nothing changed, so that a caller can test by identity.
        return x if new == x else new
    if kind is complex:
        re, im = next(rows).tolist()
        return complex(re, im)
    if isinstance(x, np.ndarray):
        if not (x.size and x.dtype.kind in "fc"):
            return x
        row = np.ascontiguousarray(next(rows), dtype=np.float64)
        return (row.view(np.complex128) if x.dtype.kind == "c" else row).reshape(x.shape).astype(x.dtype)
    if isinstance(x, tuple):
        items = next(rows).tolist() if _is_row(x) else [_put(item, rows) for item in x]
        same = all(a is b or (type(a) is float and a == b) for a, b in zip(items, x, strict=True))
        return x if same else x._make(items) if hasattr(x, "_make") else tuple(items)
    if hasattr(x, "with_numbers"):
        row = next(rows)
        return x if np.array_equal(row, x.numbers()) else x.with_numbers(np.asarray(row))
    return x
