"""Lines on a terminal or in a pipe: text stays text, and a closed pipe ends the command with its own status."""

from __future__ import annotations

import os
import sys
from typing import Any

from rich.console import Console
from rich.text import Text
from softrig_core.guard import plain


def console(**options: Any) -> Console:
    """Create a console as wide as the terminal or COLUMNS; in a pipe, lines are not wrapped."""
    narrow = sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit()
    return _Console(**{"width": None if narrow else 1000, "highlight": False, "markup": False} | options)


def styled(*parts: str | tuple[str, str]) -> Text:
    """Create a line from texts and (text, style) pairs; control characters and markup in a text have no effect."""
    return Text.assemble(*(plain(p) if isinstance(p, str) else (plain(p[0]), p[1]) for p in parts))


class _Console(Console):
    """Rich's console, but text is text, and a closed pipe has its own exit status instead of 1."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Show control characters instead of obeying them."""
        return super().render_str(plain(text), **options)

    def on_broken_pipe(self) -> None:
        """Leave the error to `guarded`; called while it is handled."""
        raise
