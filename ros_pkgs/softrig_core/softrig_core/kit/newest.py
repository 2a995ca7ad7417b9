"""Answers that are kept: the newest ones of a value of a state, and those that many runs share."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any, Generic, ParamSpec, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")
A = TypeVar("A")
S = ParamSpec("S")
# Answers of a function that are stored: enough for some runs of a study, each with values of its own.
KEPT = 256


class Newest(Generic[K, V]):
    """A function of one value, whose newest answers are at hand.

    Native code takes the newest answer for a constant, and leaves the tick to Python at which another one is asked for.

    Parameters
    ----------
    function : callable
        Its answer depends on its argument alone.
    size : int
        So many answers are kept.

    Attributes
    ----------
    key, answer : object
        What was asked last, and what it was; None before.
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


def once(function: Callable[S, A]) -> Callable[S, A]:
    """Keep the answers of a function by the identity of its arguments: comparing contents takes longer than it saves.

    The answer must depend on nothing else; neither it nor the arguments may be changed. Errors are not kept.
    """
    kept: dict[tuple[int, ...], tuple[Any, A]] = {}

    def known(*arguments: S.args, **keywords: S.kwargs) -> A:
        key = tuple(map(id, arguments))
        if key not in kept:
            found = function(*arguments, **keywords)
            if len(kept) >= KEPT:
                kept.clear()
            # The arguments are stored too: while they live, no other object can have their identity.
            kept[key] = arguments, found
        return kept[key][1]

    return known


_made: dict[tuple[Any, bytes], Any] = {}


def shared(function: Callable[[Any, Any], A], of: Any, values: Any) -> A:
    """Return what a function makes of a class and plain data: the same object as for equal data before.

    Types count: 1, 1.0 and True are three values.
    """
    try:
        key = of, pickle.dumps(values)
    # These are no plain data; the function itself reports that.
    except Exception:
        return function(of, values)
    if key not in _made:
        found = function(of, values)
        if len(_made) >= KEPT:
            _made.clear()
        _made[key] = found
    return _made[key]  # type: ignore[no-any-return]
