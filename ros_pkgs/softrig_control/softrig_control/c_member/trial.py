"""A library before it runs: its first ticks in a process of its own, twice from the same state and in another order."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from softrig_core import RunError

from .build import Built
from .law import Apart, Row, wrong

# values of all inputs at the ticks that are tried, the first one once more at the end
TRIED = (0.5, -1.25, 0.0, 3.0)
PERIOD = 1_000_000  # ns between them


class Trial(NamedTuple):
    """Results of a trial of a library."""

    wrong: str
    """Why it cannot run; empty."""

    hidden: str
    """What it keeps outside of its struct; empty."""


def tried(built: Built, methods: Sequence[str], params: Row, seconds: float) -> Trial:
    """Find out whether a library crashes or hangs at its begin, and whether it keeps state outside of its struct.

    Variables that a tick may write are found in the library file. State that the file does not show (allocated memory,
    random numbers of the C library) is detected by repeating the same ticks from the same struct, also in another
    order.
    """
    return _tried(_Key(built), tuple(methods), params, seconds)


class _Key:
    """A build, compared by its inputs."""

    def __init__(self, built: Built) -> None:
        self.built = built

    def __hash__(self) -> int:
        return hash(self.built.shim)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.built.shim == self.built.shim


@lru_cache(maxsize=64)
def _tried(key: _Key, methods: tuple[str, ...], params: Row, seconds: float) -> Trial:
    built = key.built
    known = "" if built.hidden is None else str(built.hidden)
    names = [leaf.access for leaf in built.structs["state"].leaves]
    try:
        apart = Apart(built, methods, params, seconds)
        if apart.status and (reason := wrong(apart.status, "init", names)):
            return Trial(reason, known)
        _answers(apart, built, methods, (0.0,))
    except RunError as error:
        return Trial(f"its first tick, with all inputs 0: {error}", known)
    try:
        straight, back, again = (_answers(apart, built, methods, order) for order in (TRIED, TRIED[::-1], TRIED))
        apart.end()
    # Inputs of a run may be quite different from these, so a library that fails on them is not refused.
    except RunError:
        return Trial("", known)
    if not known and not straight == back == again:
        value = next(v for v in TRIED if not _same(straight[v], back[v], again[v]))
        known = (
            f"the same tick from the same struct, all inputs {value:g}, has different answers when it is repeated "
            "or in another order (a static variable, allocated memory, random numbers or a clock)"
        )
    return Trial("", known)


def _same(*rows: Row) -> bool:
    return all(row == rows[0] for row in rows)


def _answers(apart: Apart, built: Built, methods: Sequence[str], order: Sequence[float]) -> dict[float, Row]:
    """Return the answers to one tick each, all from the first state; equal bits compare as equal, NaN included."""
    result = {}
    for value in order:
        row = (float(PERIOD), *apart.first)
        inputs = (value,) * len(built.structs["in"].leaves)
        answers: list[float] = []
        for method in methods:
            answers += apart.call(method, row if method == "outputs" else (*row, *inputs))
        result[value] = tuple(map(str, answers))
    return result  # type: ignore[return-value]
