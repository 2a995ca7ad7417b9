"""Tables of the names that a file format defines, and what softrig does with each: used, ignored, or refused."""

from __future__ import annotations

import json
import math
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ..errors import ScenarioError, closest

UTF_16 = (BOM_UTF16_LE, BOM_UTF16_BE)
Use = Literal["used", "ignored", "refused"]
BELOW = "/**"  # ends a name that stands for an element and everything in it


def json_of(text: str | bytes) -> Any:
    """Read JSON of a file that somebody else may have written.

    Raises
    ------
    ValueError
        It is not JSON, or is nested more deeply than any such file.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def json_object(file: Path) -> dict[str, Any]:
    """Return the object in a JSON file; empty if the file does not exist or has anything else in it."""
    try:
        content = json_of(file.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


class FileFormat(NamedTuple):  # no dataclass, whose import would take 5 ms of each command's start
    """Every name of a file format's standard: tags, attributes, fields, columns.

    Reading a file, generating its reference page, and the tests all use this one table.

    Parameters
    ----------
    title : str
        Name of the format, for messages and pages.
    standard : str
        Where the names are defined.
    table : mapping
        Name to (use, explanation). The explanation of an ignored name completes "NAME is ignored: ", that of a refused
        one "NAME is refused: ". A name that ends in ``/**`` covers an element with everything in it.
    """

    title: str
    standard: str
    table: Mapping[str, tuple[Use, str]]

    def check(self, names: Iterable[str], source: str) -> list[str]:
        """Check the names that a file has.

        Parameters
        ----------
        source : str
            The file, for messages.

        Returns
        -------
        list of str
            A note on each ignored name, once.

        Raises
        ------
        ScenarioError
            A refused or an unknown name; suggests the nearest one.
        """
        notes: dict[str, str] = {}
        for name in names:
            key = self.entry(name)
            if key is None:
                raise ScenarioError(
                    f"{source}: {name} is not part of {self.title}{closest(name, self.known())}; "
                    "remove it or correct its name"
                )
            use, text = self.table[key]
            if use == "refused":
                raise ScenarioError(f"{source}: {name} is refused: {text}")
            if use == "ignored":
                shown = key.removesuffix(BELOW)
                notes.setdefault(shown, f"{source}: {shown} is ignored: {text}")
        return list(notes.values())

    def entry(self, name: str) -> str | None:
        """Return the key of the table that covers a name, or None."""
        if name in self.table:
            return name
        parts = name.partition("@")[0].split("/")
        covering = ("/".join(parts[:k]) + BELOW for k in range(len(parts), 0, -1))
        return next((key for key in covering if key in self.table), None)

    def known(self) -> list[str]:
        """Return the names that a file may contain."""
        return [key.removesuffix(BELOW) for key, (use, _) in self.table.items() if use != "refused"]


def number_of(text: str) -> float:
    """Return a number as C reads it, NaN if it is invalid: only Python accepts 1_000 and digits of other scripts."""
    try:
        return float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        return math.nan


def text_of(data: bytes) -> str:
    """Decode text of other programs: UTF-16 or UTF-8 with a byte order mark, UTF-8, else cp1252."""
    if data.startswith(UTF_16):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")
