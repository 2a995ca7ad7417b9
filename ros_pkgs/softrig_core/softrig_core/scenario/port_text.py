"""Ports as the text of a parameter, for nodes whose topics are set by their scenario."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from ..block.port import Port
from ..kit.file_format import json_of

_TUPLES = ("channels", "fields", "units", "limits", "safe")


def reader(port: Port, name: str, held: bool = False) -> Port:
    """Return an input that accepts every message of an output."""
    return replace(port, name=name, held=held, sporadic=False, partial=False, also=(), unchecked=False, safe=())


def ports_text(ports: Sequence[Port]) -> str:
    """Write ports as JSON, each with what differs from a port's defaults."""
    return json.dumps([{f.name: v for f in fields(p) if (v := getattr(p, f.name)) != f.default} for p in ports])


def ports_of(text: str) -> tuple[Port, ...]:
    """Read ports from JSON.

    Raises
    ------
    ValueError
        The text is not JSON or does not describe ports; the message states what was expected.
    """
    try:
        entries: list[dict[str, Any]] = json_of(text)
        shaped: list[dict[str, Any]] = [
            {k: tuple(v) if k in _TUPLES else tuple(map(tuple, v)) if k == "dims" else v for k, v in p.items()}
            for p in entries
        ]
        return tuple(Port(**about) for about in shaped)
    except (TypeError, AttributeError, KeyError, ValueError) as error:
        raise ValueError(f"ports: {error}; expected a JSON list of ports") from None
