"""Margins and changes of a falsification in words."""

from __future__ import annotations

from typing import Any

from ..study.work import LARGE


def number(value: float | None) -> str:
    """Write a margin."""
    if value is None:
        return "not judged"
    return ("holds" if value > 0.0 else "violated") if abs(value) >= LARGE else f"{value:.6g}"


def shown(value: Any) -> str:
    """Write a value of a change."""
    return "[" + ", ".join(f"{x:.6g}" for x in value) + "]" if isinstance(value, list) else f"{value:.10g}"
