"""The common part of scenarios from a data sheet: values are checked, and assumptions are written."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Asked = Mapping[str, tuple[str, str]]  # name of a value: (what it is, its unit)
Given = Mapping[str, float]


def check(
    rated: Given, asked: Asked, needed: Iterable[str | tuple[str, ...]], same: Iterable[tuple[str, str]] = ()
) -> None:
    """Ensure that values are known, positive and complete.

    Parameters
    ----------
    rated : mapping of str to float
        Values of a data sheet.
    asked : mapping of str to (str, str)
        All permitted values: description and unit.
    needed : iterable of str or tuple of str
        Required names; one name of a tuple is enough.
    same : iterable of (str, str)
        Pairs of names that exclude each other.

    Raises
    ------
    ValueError
        The message names the value and what is expected.
    """
    for name, value in rated.items():
        if name not in asked:
            raise ValueError(f"{name}: not asked for; known are {', '.join(asked)}")
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} = {value:g}: expected a number above zero")
    groups = ((names,) if isinstance(names, str) else names for names in needed)
    missing = [names for names in groups if not rated.keys() & set(names)]
    if missing:
        listed = ", ".join(names[0] + (f" (or {', '.join(names[1:])})" if names[1:] else "") for names in missing)
        raise ValueError(
            f"missing {listed}: give what the data sheet has, as {missing[0][0]}=...; known are {', '.join(asked)}"
        )
    for first, second in same:
        if first in rated and second in rated:
            raise ValueError(f"{first} and {second} mean the same: give one of them")


def whole(rated: Given, name: str) -> int:
    """Return a value that is a count.

    Raises
    ------
    ValueError
        It is not a whole number.
    """
    if rated[name] != round(rated[name]):
        raise ValueError(f"{name} = {rated[name]:g}: expected a whole number")
    return round(rated[name])


def plausible(name: str, value: float, unit: str, lower: float, upper: float, why: str) -> None:
    """Ensure that the results have the order of magnitude of real machines and converters.

    A value in another unit (mH, g cm^2, peak for rms) is off by a factor that no machine of these rated values has.

    Raises
    ------
    ValueError
        With the value, the bounds and the reason.
    """
    if not lower <= value <= upper:
        raise ValueError(f"{name} = {value:.4g} {unit}".rstrip() + f": expected {lower:.3g} to {upper:.3g}; {why}")


def head(rated: Given, asked: Asked, assumed: Sequence[str], title: str) -> str:
    """Return the comment at the beginning of a scenario: given and assumed values."""
    messages = [
        f"#   {name} = {value:g} {asked[name][1]}".rstrip() + f": {asked[name][0]}" for name, value in rated.items()
    ]
    noted = [f"#   {line}" for line in assumed]
    return "\n".join([f"# {title} from the values of a data sheet:", *messages,
                      "# Assumptions, to be replaced by known values:", *noted])  # fmt: skip


def text(value: float) -> str:
    """Return a number as YAML reads it: always as a float."""
    result = f"{value:.6g}"
    return result if "." in result and "e" not in result else repr(float(result))


def mapping(values: Mapping[str, Any]) -> str:
    """Return parameters as a mapping of YAML in one line."""
    shown = (f"{k}: {text(v) if isinstance(v, float) else v}" for k, v in values.items())
    return "{" + ", ".join(shown) + "}"
