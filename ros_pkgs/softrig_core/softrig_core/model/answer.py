"""What a block may send: the check of every runner before a value leaves it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..errors import RunError
from .port import Port, Sample


def check(found: Any, port: Port, node: str, t: int) -> tuple[float, ...] | Sample | None:
    """Make sure that a block's answer may leave it: right length, all finite, plain floats.

    Parameters
    ----------
    found : mapping
        What the block gave, port name to values; anything else is refused.
    port : Port
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
        given: Any = found[port.name]
    except (KeyError, TypeError):
        if port.sporadic and isinstance(found, Mapping):
            return None
        raise RunError(f"{node} gave no {port.name} at t = {t / 1e9:.9g} s") from None
    if type(given) is tuple and len(given) == port.size:  # what nearly every block gives, told in a fifth of the time
        try:
            total = sum(given)
        except (TypeError, OverflowError):  # told below
            total = None
        if type(total) is float and total - total == 0.0:
            return given
    if given is None and port.sporadic:
        return None
    data: Sequence[float] = given.data if isinstance(given, Sample) else given
    try:
        values = tuple(map(float, data))
    except (TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{node}: {port.name} is no row of numbers at t = {t / 1e9:.9g} s: {error}") from None
    if len(values) != port.size:
        raise RunError(f"{node}: {port.name} has {len(values)} values, expected {port.size}, at t = {t / 1e9:.9g} s")
    if not math.isfinite(sum(values)):
        for label, value in zip(port.labels, values, strict=True):
            if not math.isfinite(value):
                raise RunError(f"{node}: {port.name} {label} became {value} at t = {t / 1e9:.9g} s")
    return Sample(given.stamp, values) if isinstance(given, Sample) else values
