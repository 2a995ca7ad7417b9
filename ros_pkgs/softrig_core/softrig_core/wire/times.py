"""Arrays of times that many runs share, and results that depend only on them, computed once in a process.

The runs of a study publish at the same ticks, so that the places of samples, their distances and windows are the same
in each of them; only the values differ. Arrays that are kept here are read-only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from .long import is_long

_T = TypeVar("_T", bound=NDArray[Any])
_F = TypeVar("_F", bound=Callable[..., Any])
# Bytes: a long run has to stay small in memory, so a larger array is not kept.
LARGEST = 1 << 20
# Bytes that are kept before all are dropped.
MOST = 1 << 24


class _Kept:
    """Arrays by their identity and content, and results of functions of them."""

    def __init__(self) -> None:
        self.arrays: dict[int, NDArray[Any]] = {}
        self.equal: dict[Any, NDArray[Any]] = {}
        self.results: dict[Any, Any] = {}
        self.size = 0

    def keep(self, parts: Iterable[Any]) -> None:
        """Store the arrays of times among the parts of a result, so that results that depend on them can be stored,
        too.
        """
        for array in parts:
            if isinstance(array, np.ndarray) and array.base is None and id(array) not in self.arrays:
                array.flags.writeable = False
                self.arrays[id(array)] = array
                self.size += array.nbytes


# Replaced as a whole when it is full: another thread may still be using the old one.
_kept = _Kept()


def _room() -> _Kept:
    global _kept
    if _kept.size > MOST:
        _kept = _Kept()
    return _kept


def common(times: _T) -> _T:
    """Return the equal array of times of an earlier run if there is one, else this one.

    Parameters
    ----------
    times : array, shape (n,)
        Ascending; the caller must not use it afterwards.
    """
    if not times.size or times.nbytes > LARGEST or is_long(times):
        return times
    kept = _room()
    key = times.dtype.str, times.size, times[0].item(), times[-1].item()
    known = kept.equal.get(key)
    if known is not None and np.array_equal(known, times):
        return cast(_T, known)
    result = times if times.base is None else times.copy()
    kept.keep((result,))
    kept.equal[key] = result
    return result


def once_for_times(function: _F) -> _F:
    """Cache the results of a function of arrays of times and hashable values.

    Results for arrays that are not kept here (`common`, or results of such functions, and parts of them) are computed
    at each call.
    """

    @wraps(function)
    def call(*arguments: Any) -> Any:
        kept, key = _room(), list[Any]([function])
        if any(map(is_long, arguments)):
            return function(*arguments)
        for value in arguments:
            if isinstance(value, np.ndarray):
                owner = value if value.base is None else value.base
                if kept.arrays.get(id(owner)) is not owner or not value.flags.c_contiguous:
                    return function(*arguments)
                # The place of a part takes longer to find than all else here.
                key += (id(owner), owner is value or value.__array_interface__["data"][0], value.size)
            else:
                key.append(value)
        entry = tuple(key)
        if entry not in kept.results:
            result = function(*arguments)
            kept.keep(result if isinstance(result, tuple) else (result,))
            kept.results[entry] = result
        return kept.results[entry]

    return cast(_F, call)
