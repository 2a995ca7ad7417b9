"""What is made anew when a value of a state has changed, and kept until then."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any, Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


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
        """Give the answer for a value."""
        if key != self.key:
            self.answer = self._function(key)
            self.key = key
        return self.answer  # type: ignore[no-any-return]
