"""Syntax of the text after ``NODE.PARAMETER=``, the same for every option: one value, several, or a range."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from softrig_core import ScenarioError
from softrig_core.command_line import named
from softrig_core.scenario.scenario import read_draft
from softrig_core.scenario.yaml_file import read_yaml

from .names import check_names

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_SPAN = re.compile(rf"(log )?\s*({NUMBER})\s*\.\.\s*({NUMBER})(?:([*~])(\d+))?")
FORMS = "expected LOW..HIGH, 'log LOW..HIGH', of lists and signals LOW..HIGH*N (steps), of signals LOW..HIGH~N (lines)"
MOST = 10_000  # longest list of values
# The most numbers of a profile or list: a search over more finds nothing in its budget.
MANY = 50


@dataclass(frozen=True)
class Span:
    """Numbers from a least to a largest one.

    Parameters
    ----------
    log : bool
        Whether their logarithm counts.
    count : int
        Numbers of a list or profile; 0: a single number.
    linear : bool
        Of a profile: joined by lines.
    """

    low: float
    high: float
    log: bool = False
    count: int = 0
    linear: bool = False


_TWO = re.compile(rf"({NUMBER})\s*(?:-|,|:|to|\.\.\.)\s*({NUMBER})")  # a range as others write it
_COMMA = re.compile(r"[-+]?\d+,\d+")


def settings(texts: Iterable[str], scenario: str = "") -> dict[str, Any]:
    """Read ``NAME=VALUE`` of several ``--set``, VALUE as in a scenario file.

    Parameters
    ----------
    scenario : str
        Nodes that the names may refer to; not checked if empty.

    Raises
    ------
    ScenarioError
        Another form, a decimal comma, a parameter without its node.
    """
    result: dict[str, Any] = {}
    for text in texts:
        name, value = named(text, "--set", "VALUE")
        if _COMMA.fullmatch(value):
            point, items = value.replace(",", "."), value.replace(",", ", ")
            raise ScenarioError(f"--set {name}={value}: expected a decimal point, {name}={point}, or a list, [{items}]")
        if _SPAN.fullmatch(value):
            raise ScenarioError(
                f"--set {name}={value}: expected one value; a study draws from a range, "
                f"`softrig study {scenario or 'SCENARIO'} --draw {name}={value}`"
            )
        result[name] = read_yaml(value, f"--set '{name}={value}'")
    if scenario and result:
        check_names(read_draft(scenario), result)
    return result


def values(name: str, text: str) -> list[Any]:
    """Read ``A,B,C``, ranges ``LOW:HIGH:STEP`` among them with both ends."""
    items = read_yaml(f"[{text}]", f"{name}={text}")
    assert isinstance(items, list)
    if re.fullmatch(rf"{NUMBER}(?:[\s;]+{NUMBER})+", text.strip()):
        raise ScenarioError(f"{name}={text}: expected A,B,C: {name}={','.join(re.split(r'[ ;]+', text.strip()))}")
    return [value for item in items for value in (_steps(name, item) if isinstance(item, str) else [item])]


def _steps(name: str, text: str) -> list[Any]:
    match = re.fullmatch(rf"({NUMBER}):({NUMBER})(?::({NUMBER}))?", text.strip())
    if match is None:
        if _SPAN.fullmatch(text.strip()):
            raise ScenarioError(
                f"{name}={text}: expected A,B,C or LOW:HIGH:STEP; numbers of a range LOW..HIGH are drawn by --draw"
            )
        return [text]
    low, high, step = (float(part) for part in (match[1], match[2], match[3] or "1"))
    ratio = (high - low) / step * (1.0 + 1e-12) + 1e-9 if step and all(map(math.isfinite, (low, high, step))) else -1.0
    count = math.floor(ratio) + 1 if math.isfinite(ratio) else 0
    if not 1 <= count <= MOST:
        raise ScenarioError(f"{name}={text}: expected LOW:HIGH:STEP with at least one and at most {MOST} values")
    values = [float(f"{low + k * step:.12g}") for k in range(count)]
    return [int(v) for v in values] if all(re.fullmatch(r"[-+]?\d+", p) for p in match.groups() if p) else values


def span(name: str, text: object) -> Span:
    """Read a range.

    Raises
    ------
    ScenarioError
        Another form, a range upside down, a logarithm of what is not above 0.
    """
    match = _SPAN.fullmatch(str(text).strip())
    if not match:
        steps = re.fullmatch(rf"{NUMBER}:{NUMBER}:{NUMBER}", str(text).strip())
        two = _TWO.fullmatch(str(text).strip())
        near = f" (did you mean {name}={two[1]}..{two[2]}?)" if two else ""
        raise ScenarioError(f"{name}={text}: {FORMS}{near}" + ("; LOW:HIGH:STEP is a grid, --grid" if steps else ""))
    low, high, count = float(match[2]), float(match[3]), int(match[5] or 0)
    if not math.isfinite(high - low):
        raise ScenarioError(f"{name}={text}: expected numbers below 1.8e308 in size and difference")
    if low > high:
        raise ScenarioError(f"{name}={text}: {low:g} is above {high:g}")
    if match[1] and low <= 0.0:
        raise ScenarioError(f"{name}={text}: a logarithm needs a range above 0")
    if match[4] and not 1 <= count <= MANY:
        raise ScenarioError(f"{name}={text}: expected 1 to {MANY} numbers, got {count}")
    return Span(low, high, bool(match[1]), count, match[4] == "~")
