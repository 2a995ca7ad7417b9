"""Check of a block's outputs, made in every placement before a value is published."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from operator import mul
from typing import TYPE_CHECKING, Any

from ..errors import RunError, closest
from .port import Port, Sample

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Row = tuple[float, ...] | Sample  # answer of an output at a tick
Rows = tuple[Row | None, ...]  # answer of each output; None for the silence of a sporadic output
TEXT = (str, bytes, bytearray)
# A check against `Mapping` is slow, so `dict`, which nearly all blocks return, is tried first.
MAPPINGS = (dict, Mapping)


def answers(value: Any, ports: Sequence[Port], node: str, t: int) -> Rows:
    """Ensure that a block's answer may leave it: each output by `admit`, and no other entries.

    Raises
    ------
    RunError
        Also names an output that the block does not have.
    """
    rows = tuple([admit(value, port, node, t) for port in ports])
    # A mapping with as many entries as ports, of which each was found, has no other names.
    if isinstance(value, MAPPINGS) and (len(value) != len(ports) or None in rows):
        names = [port.name for port in ports]
        for name in value:
            if name not in names:
                raise RunError(
                    f"{node} returned {name!r} at t = {t / 1e9:.9g} s, which is not an output of it"
                    f"{closest(str(name), names)}; its outputs: {', '.join(names) or 'none'}"
                )
    return rows


def admit(result: Any, port: Port, node: str, t: int) -> Row | None:
    """Ensure that a block's answer may leave it: right length, plain floats, all finite and within `Port.limits`.

    Parameters
    ----------
    result : mapping
        Result of the block, port name to values; anything else is refused.
    node : str
        For the error.
    t : int
        Time in ns, for the error.

    Returns
    -------
    tuple of float, Sample or None
        None for the silence of a sporadic port.

    Raises
    ------
    RunError
        Names node, port, value and time.
    """
    try:
        message: Any = result[port.name]
    except (KeyError, TypeError):
        if port.sporadic and isinstance(result, MAPPINGS):
            return None
        names = ", ".join(map(str, result)) or "none" if isinstance(result, MAPPINGS) else f"a {type(result).__name__}"
        raise RunError(
            f"{node} returned no {port.name} at t = {t / 1e9:.9g} s; the outputs it returned: {names}"
        ) from None
    if type(message) is tuple and len(message) == port.size and usual(message, port.bound):  # the usual case
        return message
    if message is None and port.sporadic:
        return None
    data: Sequence[float] = message.data if isinstance(message, Sample) else message
    try:
        if isinstance(data, TEXT) or any(isinstance(value, TEXT) for value in data):
            raise TypeError(f"{data!r:.200} is text")  # `float` would accept a text
        values = tuple(map(float, data))
    except (TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{node}: {port.name} is not a sequence of numbers at t = {t / 1e9:.9g} s: {error}") from None
    if len(values) != port.size:
        raise RunError(f"{node}: {port.name} has {len(values)} values, expected {port.size}, at t = {t / 1e9:.9g} s")
    result = Sample(message.stamp, values) if isinstance(message, Sample) else values
    # A fault may publish bad values on purpose; then each input checks what it receives.
    if port.unchecked:
        return result
    for label, value, limit, unit in zip(port.labels, values, port.limits, port.units, strict=True):
        # The negated comparison is also true for NaN, which no comparison holds for.
        if not abs(value) <= limit:
            location = f"{node}: {port.name} {label} became {value:g}"
            most = f" {unit or '1'}, expected at most {limit:g} in magnitude" if math.isfinite(value) else ""
            raise RunError(f"{location}{most} at t = {t / 1e9:.9g} s")
    return result


def _squares(p: tuple[Any, ...], q: tuple[Any, ...]) -> Any:
    return sum(map(mul, p, q))


only_floats = frozenset({float}).issuperset
sum_of_products = getattr(math, "sumprod", _squares)  # Python 3.12 and later have it


def flat(rows: Any) -> tuple[float, ...]:
    """Concatenate the numbers of several tuples."""
    return rows[0] if len(rows) == 1 else sum(rows, ())


def usual(values: tuple[Any, ...], bound: float) -> bool:
    """Return whether all values are floats and their sum of squares is at most a bound; a fast check."""
    # Integers, bools and numpy's scalars are converted by `admit`: -0 would be another number than -0.0.
    return only_floats(map(type, values)) and bool(sum_of_products(values, values) <= bound)


Slots = tuple[int, int, int | None, int | None]  # numbers of an output: from, to; its stamp and flag, where it has them


def slots_of(outputs: Sequence[Port]) -> list[Slots]:
    """Return the position of each output in the numbers that a step publishes at a tick (see `part`)."""
    offsets = [*accumulate((p.width for p in outputs), initial=0)]
    # From 0 on: the sum of the first two switches alone would be a bool, which numpy takes for a mask.
    stamp = [*accumulate((p.delayed for p in outputs), initial=0)]
    flag = [*accumulate((p.sporadic for p in outputs), initial=offsets[-1])]
    return [
        (offsets[j], offsets[j + 1], stamp[j] if p.delayed else None, flag[j] if p.sporadic else None)
        for j, p in enumerate(outputs)
    ]


def part(numbers: Sequence[float], stamps: Sequence[int], slots: Slots) -> Row | None:
    """Return the message of one output from the outputs of a step at a tick; None if it published nothing."""
    low, high, stamp, flag = slots
    if flag is not None and not numbers[flag]:
        return None
    row = tuple(numbers[low:high])
    return row if stamp is None else Sample(stamps[stamp], row)


def parted(outputs: Sequence[Port], numbers: Sequence[float], stamps: Sequence[int]) -> Rows:
    """Return the message of each output, from all numbers, flags and stamps of a tick."""
    return tuple([part(numbers, stamps, slots) for slots in slots_of(outputs)])


Messages = Sequence[tuple[int, tuple[float, ...]]]  # (stamp in ns, values) of each, the oldest first


class ReceivedMessages(Messages):
    """Messages that arrived together, each (stamp in ns, values); converted when they are accessed.

    Parameters
    ----------
    stamps : array of int, shape (n,)
    values : array of float, shape (n, size)
    """

    def __init__(self, stamps: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        self.stamps, self.values = stamps, values

    def __len__(self) -> int:
        return len(self.stamps)

    def __getitem__(self, k: Any) -> Any:
        if isinstance(k, slice):
            return ReceivedMessages(self.stamps[k], self.values[k])
        return int(self.stamps[k]), tuple(self.values[k].tolist())

    def __iter__(self) -> Iterator[tuple[int, tuple[float, ...]]]:
        return zip(self.stamps.tolist(), map(tuple, self.values.tolist()), strict=True)
