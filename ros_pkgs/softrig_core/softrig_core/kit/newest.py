"""Cached answers: the newest ones of a value of a state, and those that many runs share."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Hashable, Sequence
from functools import lru_cache
from typing import Any, Generic, ParamSpec, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")
A = TypeVar("A")
S = ParamSpec("S")
# Answers of a function that are stored: enough for some runs of a study, each with values of its own.
KEPT = 256
Kept = dict[tuple[int, ...], tuple[Any, A]]


class Newest(Generic[K, V]):
    """A function of one value that stores its newest results.

    Native code treats the newest result as a constant, and leaves a tick that needs another one to Python.

    Parameters
    ----------
    function : callable
        Its result must depend only on its argument.
    size : int
        Number of stored results.

    Attributes
    ----------
    key, answer : object
        Last argument and its result; None before the first call.
    """

    SCRATCH = frozenset({"key", "answer"})  # a cache: the answer depends on the argument alone

    def __init__(self, function: Callable[[K], V], size: int = 4) -> None:
        self._function: Callable[..., V] = lru_cache(maxsize=size)(function)
        self.key: Any = None
        self.answer: Any = None

    def __call__(self, key: K) -> V:
        """Return the answer for a value."""
        if key != self.key:
            self.answer = self._function(key)
            self.key = key
        return self.answer  # type: ignore[no-any-return]


def once_for_objects(function: Callable[S, A]) -> Callable[S, A]:
    """Store the results of a function by the identity of its arguments: comparing contents takes longer than it saves.

    The result must depend only on the arguments; neither it nor the arguments may be changed. Errors are not stored.
    """
    kept: Kept[A] = {}

    def known(*arguments: S.args, **keywords: S.kwargs) -> A:
        # A run of a study asks here some dozens of times, so a known result takes as few steps as possible.
        stored = kept.get(tuple(map(id, arguments)))
        return of_these(kept, arguments, lambda: function(*arguments, **keywords)) if stored is None else stored[1]

    return known


def of_these(kept: Kept[A], objects: Sequence[Any], make: Callable[[], A]) -> A:
    """Return the result for these objects, made at the first call; see `once_for_objects`."""
    key = tuple(map(id, objects))
    if key not in kept:
        result = make()
        if len(kept) >= KEPT:
            kept.clear()
        # The objects are stored too: while they live, no other object can have their identity.
        kept[key] = objects, result
    return kept[key][1]


_made: dict[tuple[Any, bytes], Any] = {}


def shared(function: Callable[[Any, Any], A], owner: Any, values: Any) -> A:
    """Return the result of a function for a class and plain data; equal data give the same object.

    Types count: 1, 1.0 and True are three values.
    """
    try:
        key = owner, pickle.dumps(values)
    # These are no plain data; the function itself reports that.
    except Exception:
        return function(owner, values)
    if key not in _made:
        result = function(owner, values)
        if len(_made) >= KEPT:
            _made.clear()
        _made[key] = result
    return _made[key]  # type: ignore[no-any-return]
