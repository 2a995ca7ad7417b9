"""The data of a line for `ros2 run softrig_power locate`, from a file; nothing is assumed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError
from softrig_core.block.params import build
from softrig_core.scenario.yaml_file import read_yaml

from .parameters import LineParams

PAPER = "paper"


def line_data(source: str | None, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the line's data from a file; values in `overrides` (``line.length`` and so on) take precedence.

    Parameters
    ----------
    source : str, optional
        A YAML file with length (km), r1 (ohm/km), l1 (H/km) and c1 (F/km), or ``paper`` for Table I.
    overrides : mapping
        Locator parameters by dotted name.

    Returns
    -------
    dict
        By dotted name.

    Raises
    ------
    ScenarioError
        A value is missing, the file cannot be read, or it has unknown names.
    """
    names = list(LineParams.model_fields)
    entries: dict[str, Any] = {}
    if source == PAPER:
        entries = LineParams().model_dump()
    elif source is not None:
        try:
            entries = read_yaml(Path(source).read_text(encoding="utf-8-sig"), source)
        except (OSError, UnicodeDecodeError) as error:
            raise ScenarioError(f"--line {source}: {error}") from None
        if not isinstance(entries, dict) or not set(entries) <= set(names):
            raise ScenarioError(f"--line {source}: expected {', '.join(names)}, got {entries!r}")
        build(LineParams, entries)  # its errors use the words of the file
    result = {f"line.{name}": value for name, value in entries.items()}
    result |= {name: value for name, value in overrides.items() if name.startswith("line.")}
    missing = [name for name in names if f"line.{name}" not in result]
    if missing:
        raise ScenarioError(
            f"the line's {', '.join(missing)} are missing: expected --line FILE (YAML: length in km, "
            f"r1 in ohm/km, l1 in H/km, c1 in F/km), --line {PAPER} for that of the paper, or "
            f"--set {' '.join(f'line.{name}=...' for name in missing)}"
        )
    return result
