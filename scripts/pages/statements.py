"""Import statements of the packages, for the pages and tests that read them."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path


@cache
def imported(file: Path) -> list[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Return the import statements of a file, inside functions too, each with whether only type checkers see it."""
    results: list[tuple[ast.Import | ast.ImportFrom, bool]] = []
    waiting: list[tuple[ast.AST, bool]] = [(ast.parse(file.read_text()), False)]
    while waiting:
        node, types = waiting.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            results.append((node, types))
        # Only these lists contain statements. Most of a tree are expressions, which are not visited.
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            only = types or (field == "body" and getattr(getattr(node, "test", None), "id", "") == "TYPE_CHECKING")
            waiting += [(below, only) for below in getattr(node, field, ())]
    return results
