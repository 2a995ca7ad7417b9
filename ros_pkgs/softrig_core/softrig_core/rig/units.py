"""Units as text: products of powers, such as ``N m s/rad`` or ``deg^2``, compared and composed."""

from __future__ import annotations

import math
import re

_TOKEN = re.compile(r"(\*|/)?\s*([^\s*/^]+)(?:\^(-?\d+))?")


def powers(unit: str) -> dict[str, int]:
    """Take a unit apart: ``m/s^2`` gives ``{"m": 1, "s": -2}``; a slash concerns the next unit only."""
    found: dict[str, int] = {}
    for over, name, power in _TOKEN.findall(unit):
        if name != "1":
            found[name] = found.get(name, 0) + (-1 if over == "/" else 1) * int(power or 1)
    return {name: power for name, power in found.items() if power}


def compose(template: str, signal: str) -> str:
    """Put a signal's unit in the place of ``{signal}``: ``{signal}/s`` of ``V`` is ``V/s``.

    Parameters
    ----------
    template : str
        Unit of a figure, such as ``{signal}^2 s``.
    signal : str
        Unit of the signal.
    """
    if "{signal}" not in template:
        return template
    rest = powers(template.replace("{signal}", "1"))
    raised = re.search(r"\{signal\}\^(\d)", template)
    total = {name: power * (int(raised[1]) if raised else 1) for name, power in powers(signal).items()}
    if raised:
        rest.pop("1", None)
    for name, power in rest.items():
        total[name] = total.get(name, 0) + power
    return text({name: power for name, power in total.items() if power})


def text(parts: dict[str, int]) -> str:
    """Write powers as a unit, what is divided by last."""

    def one(name: str, power: int) -> str:
        return name if power == 1 else f"{name}^{power}"

    above = " ".join(one(n, p) for n, p in parts.items() if p > 0)
    below = "".join(f"/{one(n, -p)}" for n, p in parts.items() if p < 0)
    return (above or "1") + below if below else above


def factor(given: str, wanted: str) -> float | None:
    """Number that turns values of one unit into another; None when they do not measure the same.

    The suite is in SI; the one conversion is from rad to deg, in any power.

    Parameters
    ----------
    given, wanted : str
        Units such as ``rad/s``.
    """
    a, b = powers(given), powers(wanted)
    if a == b:
        return 1.0
    turned = {"deg" if name == "rad" else name: power for name, power in a.items()}
    return math.degrees(1.0) ** a["rad"] if "rad" in a and turned == b else None
