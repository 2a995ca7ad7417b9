"""Columns of tables for pyarrow, made without pandas: `pyarrow.array` imports it where it is installed, half a second.

A value that is missing is null. Floats need no null: where a table has NaN for what is missing, NaN stays a number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow

NUMBERS: dict[type, type] = {bool: bool, int: np.int64}


def arrow(values: Sequence[Any] | NDArray[Any], missing: NDArray[np.bool_] | None = None) -> pyarrow.Array:
    """Return a column as an array of pyarrow.

    Parameters
    ----------
    values : sequence or array, shape (n,)
        Texts, truths or numbers, each of which may be None, which is missing; or an array of numbers or truths, of
        which the result may use the memory.
    missing : array of bool, shape (n,), optional
        Which values of an array are missing; by default none of them is.
    """
    import pyarrow

    def bits(flags: NDArray[np.bool_]) -> Any:
        return pyarrow.py_buffer(np.packbits(flags, bitorder="little"))

    if not isinstance(values, np.ndarray):
        missing = np.array([v is None for v in values], bool)
        kinds = {type(v) for v in values if v is not None}
        if kinds == {str}:
            texts = [(v or "").encode() for v in values]
            ends = np.cumsum([0, *map(len, texts)])
            # The usual kind of text counts its bytes by 32 bits.
            kind, count = (pyarrow.string(), np.int32) if ends[-1] < 1 << 31 else (pyarrow.large_string(), np.int64)
            parts = [bits(~missing), pyarrow.py_buffer(ends.astype(count)), pyarrow.py_buffer(b"".join(texts))]
            return pyarrow.Array.from_buffers(kind, len(values), parts)
        number = NUMBERS.get(next(iter(kinds)), float) if len(kinds) == 1 else float
        values = np.array([v or 0 for v in values], number)
    data = bits(values) if values.dtype == bool else pyarrow.py_buffer(np.ascontiguousarray(values))
    buffers = [None if missing is None else bits(~missing), data]
    return pyarrow.Array.from_buffers(pyarrow.from_numpy_dtype(values.dtype), len(values), buffers)
