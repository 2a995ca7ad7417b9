"""Arrays that are too long for memory: they are read or computed one stretch at a time.

A run of minutes has millions of samples of each signal. Figures are written as functions of whole arrays; with these
they need the memory of one stretch. Numbers have the same bits as those of whole arrays, sums included.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, wraps
from typing import Any, TypeVar, cast

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

STRETCH = 1 << 15  # indices of the last axis that are in memory at a time

_F = TypeVar("_F", bound=Callable[..., Any])
Read = Callable[[int, int], NDArray[Any]]


class LongArray(NDArrayOperatorsMixin):
    """An array whose last axis is long; each use computes its numbers again.

    Operators and elementwise functions of numpy return another such array; sums, extremes and searches return what they
    return of an array. Anything else first computes the whole array.

    Parameters
    ----------
    size : int
        Length of the last axis.
    read : callable
        ``read(first, last)`` returns the part between two places of the last axis.
    """

    __array_priority__ = 1.0

    def __init__(self, size: int, read: Read) -> None:
        self.read, self._length = read, size
        first = read(0, min(1, size))
        self.shape, self.dtype = (*first.shape[:-1], size), first.dtype
        # Leading strides of 0 show readers that all rows are one, as those of `numpy.broadcast_to` do.
        self.strides = (*first.strides[:-1], self.dtype.itemsize)
        self.ndim, self.size = len(self.shape), math.prod(self.shape)
        self.nbytes = 0  # it holds no memory

    def __len__(self) -> int:
        return self.shape[0]

    def stretches(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield the first place of each stretch, and its part."""
        for first in range(0, self._length, STRETCH):
            yield first, self.read(first, min(first + STRETCH, self._length))

    @cached_property
    def begins(self) -> NDArray[Any]:
        """Return the first number of each stretch."""
        return np.array([self.read(first, first + 1)[0] for first in range(0, self._length, STRETCH)], self.dtype)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        result = np.empty(self.shape, self.dtype)
        for first, part in self.stretches():
            result[..., first : first + STRETCH] = part
        return result if dtype is None else result.astype(dtype)

    def __reduce__(self) -> Any:
        # The function that computes the numbers cannot be pickled, so another process gets the numbers.
        return np.asarray(self).__reduce__()

    def __iter__(self) -> Iterator[Any]:
        return iter(np.asarray(self))

    def __getattr__(self, name: str) -> Any:
        # numpy and pickle look for such names on any object, and an answer would read the whole array.
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)  # the other methods of an array

    def __pow__(self, other: Any) -> Any:
        # The operator of an array multiplies for a square; the ufunc `power`, which the mixin would call, need not.
        return _apply(lambda x, y: x**y, self, other)

    def __getitem__(self, key: Any) -> Any:
        lead: tuple[Any, ...] = key if isinstance(key, tuple) else (key,)
        last: Any = slice(None)
        if any(k is Ellipsis for k in lead) or len(lead) == self.ndim:
            *front, last = lead
            lead = tuple(k for k in front if k is not Ellipsis)
        lead_key = (*lead, Ellipsis)
        if isinstance(last, slice) and last.step in (None, 1):
            first, end, _ = last.indices(self._length)
            return LongArray(max(0, end - first), lambda a, b: self.read(first + a, first + b)[lead_key])
        if isinstance(last, int | np.integer):
            index = int(last) + (self._length if last < 0 else 0)
            if not 0 <= index < self._length:
                raise IndexError(f"index {last} is out of bounds for size {self._length}")
            return self.read(index, index + 1)[lead_key][..., 0]
        if isinstance(last, LongArray) and last.dtype.kind != "b":
            return LongArray(len(last), lambda a, b: self._gathered(last.read(a, b))[lead_key])
        if isinstance(last, LongArray | np.ndarray) and last.dtype.kind == "b":
            parts = [x[lead_key][..., np.asarray(last[k : k + STRETCH])] for k, x in self.stretches()]
            return np.concatenate(parts, axis=-1)
        if isinstance(last, np.ndarray):
            return self._gathered(last)[lead_key]
        return np.asarray(self)[key]

    def _gathered(self, indices: NDArray[np.intp]) -> NDArray[Any]:
        """Return the numbers at some places."""
        indices = np.where(indices < 0, indices + self._length, indices)
        low, end = int(np.min(indices, initial=0)), int(np.max(indices, initial=-1)) + 1
        if low < 0 or end > self._length:
            raise IndexError(f"indices from {low} to {end - 1} are out of bounds for size {self._length}")
        low = int(np.min(indices, initial=end))
        result = np.empty((*self.shape[:-1], indices.size), self.dtype)
        for first in range(low, end, STRETCH):
            last = min(first + STRETCH, end)
            chosen = (first <= indices) & (indices < last)
            if chosen.any():
                result[..., chosen] = self.read(first, last)[..., indices[chosen] - first]
        return result

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        if options.get("out") == (self,):
            # Nothing is written in place: `x += 1` binds the returned result to x.
            del options["out"]
        if method == "__call__" and "out" not in options:
            return _apply(lambda *parts: function(*parts, **options), *inputs)
        last = options.get("axis", 0) in (-1, self.ndim - 1)
        if method == "reduce" and last and not options.keys() - {"axis", "keepdims", "initial"}:
            return _reduced(function, inputs[0], **options)
        return getattr(function, method)(*map(_in_memory, inputs), **{k: _in_memory(v) for k, v in options.items()})

    def __array_function__(self, function: Any, types: Any, arguments: Any, options: Any) -> Any:
        known = _FUNCTIONS.get(function)
        result = NotImplemented if known is None else known(*arguments, **options)
        if result is not NotImplemented:
            return result
        return function(*map(_in_memory, arguments), **{k: _in_memory(v) for k, v in options.items()})

    @property
    def real(self) -> LongArray:
        """Return the real parts."""
        return _apply(np.real, self)

    @property
    def imag(self) -> LongArray:
        """Return the imaginary parts."""
        return _apply(np.imag, self)

    def astype(self, dtype: Any) -> LongArray:
        """Return the numbers in another type."""
        return _apply(lambda x: x.astype(dtype), self)

    def sum(self) -> Any:
        """Return the sum, in the order of numpy's own."""
        return _reduced(np.add, self)

    def mean(self) -> Any:
        """Return the mean."""
        return _reduced(np.add, self) / self._length

    def min(self) -> Any:
        """Return the least number."""
        return _reduced(np.minimum, self)

    def max(self) -> Any:
        """Return the greatest number."""
        return _reduced(np.maximum, self)

    def all(self) -> Any:
        """Return whether all are true."""
        return np.bool_(all(part.all() for _, part in self.stretches()))

    def any(self) -> Any:
        """Return whether any is true."""
        return np.bool_(any(part.any() for _, part in self.stretches()))

    def argmin(self) -> int:
        """Return the first place of the least number."""
        return _index_of(self, np.argmin)

    def argmax(self) -> int:
        """Return the first place of the greatest number."""
        return _index_of(self, np.argmax)


def elementwise(function: _F) -> _F:
    """Let a function that works on each place of the last axis separately accept long arrays, too."""

    @wraps(function)
    def call(*args: Any) -> Any:
        return _apply(function, *args) if any(isinstance(x, LongArray) for x in args) else function(*args)

    return cast(_F, call)


def is_long(x: Any) -> bool:
    """Return whether an array is computed a stretch at a time."""
    return isinstance(x, LongArray)


def gathered(values: Any, indices: Any) -> Any:
    """Return the values at some places; a long array of places gives a long array."""
    if isinstance(indices, LongArray) and not isinstance(values, LongArray):
        return LongArray(len(indices), lambda a, b: values[indices.read(a, b)])
    return values[indices]


def stretches(x: Any) -> Iterator[NDArray[Any]]:
    """Yield the parts of an array, of a long one a stretch at a time."""
    if isinstance(x, LongArray):
        yield from (part for _, part in x.stretches())
    else:
        yield x


def true_places(flags: Any) -> NDArray[np.intp] | slice:
    """Return the indices of the true values; a slice if they are all before the first false one."""
    end = len(flags) if flags.all() else int(flags.argmin())
    return np.flatnonzero(flags) if flags[end:].any() else slice(0, end)


def counted(first: int, last: int) -> NDArray[np.intp]:
    """Return the integers from `first` up to `last` as a long array."""
    return cast("NDArray[np.intp]", LongArray(last - first, lambda a, b: np.arange(first + a, first + b)))


def _in_memory(x: Any) -> Any:
    if isinstance(x, list | tuple):
        return type(x)(map(_in_memory, x))
    return np.asarray(x) if isinstance(x, LongArray) else x


def _apply(function: Callable[..., Any], *arrays: Any) -> LongArray:
    """Apply a function that works on each place separately."""
    size = next(x.shape[-1] for x in arrays if isinstance(x, LongArray))

    def part(x: Any, first: int, last: int) -> Any:
        if isinstance(x, LongArray):
            return x.read(first, last)
        return x[..., first:last] if np.ndim(x) and x.shape[-1] == size else x

    if any(np.ndim(x) and x.shape[-1] not in (1, size) for x in arrays):
        raise ValueError(f"arrays of {', '.join(str(np.shape(x)) for x in arrays)} do not fit together")

    def read(first: int, last: int) -> NDArray[Any]:
        # The numbers are computed when they are read, and by then the caller may have left its own `np.errstate`.
        with np.errstate(all="ignore"):
            return np.asarray(function(*(part(x, first, last) for x in arrays)))

    return LongArray(size, read)


def _reduced(function: Any, x: Any, axis: Any = 0, keepdims: bool = False, **start: Any) -> Any:
    length = x.shape[-1]
    if function is np.add:
        result = _sum(x, 0, length)
    else:
        parts = [function.reduce(part, axis=-1, **start) for _, part in x.stretches()]
        result = function.reduce(parts, axis=0, **start) if parts else function.reduce(x.read(0, 0), axis=-1, **start)
    return np.expand_dims(result, -1) if keepdims else result


def _sum(x: LongArray, first: int, last: int) -> Any:
    """Add in pairs as numpy does."""
    if last - first <= STRETCH:
        return x.read(first, last).sum(axis=-1)
    middle = halved(first, last, 2 if x.dtype.kind == "c" else 1)
    return _sum(x, first, middle) + _sum(x, middle, last)


def halved(first: int, last: int, each: int) -> int:
    """Return where numpy halves a sum of terms of one or, if they are complex, two numbers: at a multiple of eight."""
    half = (last - first) * each // 2
    return first + (half - half % 8) // each


def _index_of(x: LongArray, extreme: Callable[..., Any]) -> int:
    best: tuple[int, Any] | None = None
    for first, part in x.stretches():
        index = int(extreme(part))
        # Equal numbers: the first counts, as in numpy; so does the first that is not a number.
        if best is None or extreme(np.array([best[1], part[index]])) == 1:
            best = first + index, part[index]
    if best is None:
        raise ValueError("attempt to get an extreme of an empty array")
    return best[0]


def _joined(arrays: Sequence[Any], axis: int = 0) -> Any:
    ends = np.cumsum([len(x) for x in arrays]).tolist()

    def read(first: int, last: int) -> NDArray[Any]:
        cuts = [
            (x, max(first - end + len(x), 0), min(last - end + len(x), len(x)))
            for x, end in zip(arrays, ends, strict=True)
        ]
        parts = [x.read(a, b) if isinstance(x, LongArray) else np.asarray(x[a:b]) for x, a, b in cuts if b > a]
        return np.concatenate(parts or [np.asarray(arrays[0][:0])])

    return LongArray(ends[-1], read)


def _append(x: Any, values: Any) -> Any:
    return _joined([a if np.ndim(a) else np.array([a]) for a in (x, values)])


def _diff(x: Any, prepend: Any = None, append: Any = None) -> Any:
    ends = [np.array([a]) for a in (prepend,) if a is not None], [np.array([a]) for a in (append,) if a is not None]
    joined = _joined([*ends[0], x, *ends[1]]) if any(ends) else x
    return LongArray(max(0, len(joined) - 1), lambda a, b: np.diff(joined.read(a, b + 1 if b > a else b)))


def _search(times: Any, instants: Any, side: Any = "left") -> Any:
    if isinstance(instants, LongArray):
        return LongArray(len(instants), lambda a, b: _search(times, instants.read(a, b), side))
    if not isinstance(times, LongArray):
        return np.searchsorted(times, instants, side)
    if np.ndim(instants) and not np.size(instants):
        return np.empty(0, np.intp)
    # Only the stretches are read in which the answers are.
    first = max(int(np.searchsorted(times.begins, np.min(instants), "left")) - 1, 0) * STRETCH
    last = min(int(np.searchsorted(times.begins, np.max(instants), "right")) * STRETCH, len(times))
    # Instants far apart would read everything between them, so each half of them is searched by itself.
    if last - first > 2 * STRETCH and np.size(instants) > 1:
        half = np.size(instants) // 2
        return np.concatenate([_search(times, instants[:half], side), _search(times, instants[half:], side)])
    return first + np.searchsorted(times.read(first, last), instants, side)


def _flatnonzero(x: LongArray) -> NDArray[np.intp]:
    return np.concatenate([first + np.flatnonzero(part) for first, part in x.stretches()] or [np.empty(0, np.intp)])


_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.sum: lambda x: x.sum(),
    np.mean: lambda x: x.mean(),
    np.min: lambda x, **start: _reduced(np.minimum, x, **start),
    np.max: lambda x, **start: _reduced(np.maximum, x, **start),
    np.ptp: lambda x: x.max() - x.min(),
    np.all: lambda x: x.all(),
    np.any: lambda x: x.any(),
    np.argmin: lambda x: x.argmin(),
    np.argmax: lambda x: x.argmax(),
    np.count_nonzero: lambda x: sum(int(np.count_nonzero(part)) for _, part in x.stretches()),
    np.flatnonzero: _flatnonzero,
    np.where: lambda condition, *values: _apply(np.where, condition, *values) if values else NotImplemented,
    np.broadcast_to: lambda x, shape: _apply(lambda part: np.broadcast_to(part, (*shape[:-1], part.shape[-1])), x),
    np.isin: lambda x, values: _apply(lambda part: np.isin(part, values), x),
    np.diff: _diff,
    np.append: _append,
    np.concatenate: _joined,
    np.searchsorted: _search,
    np.array_equal: lambda a, b: bool(len(a) == len(b) and np.all(a == b)),
    np.real: lambda x: x.real,
    np.imag: lambda x: x.imag,
    np.shape: lambda x: x.shape,
    np.ndim: lambda x: x.ndim,
}
