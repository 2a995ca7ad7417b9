"""Units as text: products of powers, such as ``N m s/rad`` or ``deg^2``, compared and composed."""

from __future__ import annotations

import math
import re
from functools import cache

_TOKEN = re.compile(r"(\*|/)?\s*([^\s*/^]+)(?:\^(-?\d+))?")


def powers(unit: str) -> dict[str, int]:
    """Parse a unit: ``m/s^2`` gives ``{"m": 1, "s": -2}``; a slash concerns the next unit only."""
    results: dict[str, int] = {}
    for over, name, power in _TOKEN.findall(unit):
        if name != "1":
            results[name] = results.get(name, 0) + (-1 if over == "/" else 1) * int(power or 1)
    return {name: power for name, power in results.items() if power}


def compose(template: str, signal: str) -> str:
    """Replace ``{signal}`` by a signal's unit: ``{signal}/s`` of ``V`` is ``V/s``.

    Parameters
    ----------
    template : str
        Unit of a figure, such as ``{signal}^2 s``.
    signal : str
        Unit of the signal.
    """
    if "{signal}" not in template:
        return template
    remaining = powers(template.replace("{signal}", "1"))
    raised = re.search(r"\{signal\}\^(\d)", template)
    total = {name: power * (int(raised[1]) if raised else 1) for name, power in powers(signal).items()}
    for name, power in remaining.items():
        total[name] = total.get(name, 0) + power
    return text({name: power for name, power in total.items() if power})


def text(parts: dict[str, int]) -> str:
    """Write a unit from powers, with divisors last."""

    def powered(name: str, power: int) -> str:
        return name if power == 1 else f"{name}^{power}"

    above = " ".join(powered(n, p) for n, p in parts.items() if p > 0)
    below = "".join(f"/{powered(n, -p)}" for n, p in parts.items() if p < 0)
    return (above or "1") + below if below else above


_SI = {"s": "s", "m": "m", "g": "kg", "A": "A", "K": "K", "rad": "rad", "Hz": "1/s", "N": "kg m/s^2", "Pa": "kg/m/s^2",
       "J": "kg m^2/s^2", "W": "kg m^2/s^3", "VA": "kg m^2/s^3", "var": "kg m^2/s^3", "C": "A s", "V": "kg m^2/s^3/A",
       "ohm": "kg m^2/s^3/A^2", "Ohm": "kg m^2/s^3/A^2", "F": "A^2 s^4/kg/m^2", "H": "kg m^2/s^2/A^2",
       "Wb": "kg m^2/s^2/A", "T": "kg/s^2/A"}  # fmt: skip
_PREFIXES = {"p": -12, "n": -9, "u": -6, "m": -3, "c": -2, "k": 3, "M": 6, "G": 9}
_OTHERS = {
    "%": (0.01, ""),
    "percent": (0.01, ""),
    "deg": (math.pi / 180.0, "rad"),
    "rpm": (math.pi / 30.0, "rad/s"),
    "rev": (2.0 * math.pi, "rad"),
    "min": (60.0, "s"),
    "h": (3600.0, "s"),
}


@cache
def base(unit: str) -> tuple[float, dict[str, int]]:
    """Reduce a unit to SI base units: ``mV`` is 0.001 times ``kg m^2/s^3/A``; unknown units stay as they are."""
    factors, total = 1.0, dict[str, int]()
    for name, power in powers(unit).items():
        scale, below = _base(name)
        factors *= scale**power
        for part, p in powers(below).items():
            total[part] = total.get(part, 0) + p * power
    return factors, {name: power for name, power in total.items() if power}


def _base(name: str) -> tuple[float, str]:
    if name in _OTHERS:
        return _OTHERS[name]
    if name in _SI:
        # The SI base unit is kg, so g is a thousandth of it.
        return 1e-3 if name == "g" else 1.0, _SI[name]
    if name[:1] in _PREFIXES and name[1:] in _SI:
        power = _PREFIXES[name[0]] - 3 * (name[1:] == "g")
        return 10.0**power, _SI[name[1:]]
    return 1.0, name


@cache
def misfit(unit: str, wanted: str) -> str:
    """Describe why values in one unit cannot be read as values in another; empty when they can.

    Parameters
    ----------
    unit, wanted : str
        Units; one that is not stated (empty) fits any, ``1`` is a pure number.
    """
    if not unit or not wanted or powers(unit) == powers(wanted):
        return ""
    (a, si_unit), (b, si_wanted) = base(unit), base(wanted)
    if si_unit != si_wanted:
        return f"is in {unit!r}, expected {wanted!r}, which is another quantity"
    # Products of factors round, so equal units may differ in the last bits.
    if math.isclose(a, b, rel_tol=1e-12):
        return ""
    same = f"1 {unit}".removesuffix(" 1") + f" = {a / b:.9g} {wanted}".removesuffix(" 1")
    return (
        f"is in {unit!r}, expected {wanted!r}: the same quantity, {same}; declare {unit!r} at the reader and "
        f"scale there, or {wanted!r} at the sender and scale there"
    )


def factor(unit: str, wanted: str) -> float | None:
    """Number that turns values of one unit into another; None when they do not measure the same.

    Parameters
    ----------
    unit, wanted : str
        Units such as ``rad/s``.
    """
    a, b = powers(unit), powers(wanted)
    # The same unit needs no factor, not even a rounded one.
    if a == b:
        return 1.0
    turned = {"deg" if name == "rad" else name: power for name, power in a.items()}
    if "rad" in a and turned == b:
        return math.degrees(1.0) ** a["rad"]
    (scale, dims), (wanted_scale, wanted_dims) = base(unit), base(wanted)
    return scale / wanted_scale if dims == wanted_dims else None


def pretty_unit(unit: str) -> str:
    """Set a unit as it is printed: ``kg m^2`` as kg m², ``ohm`` as Ω.

    Examples
    --------
    >>> pretty_unit("m/s^2")
    'm/s²'
    """
    raised = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    unit = re.sub(r"\^(-?\d+)", lambda power: power[1].translate(raised), unit)
    return re.sub(r"\bohm\b", "Ω", unit)
