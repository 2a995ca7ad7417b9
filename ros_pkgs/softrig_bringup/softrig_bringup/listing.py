"""The list of scenarios: a tree by system on a terminal, one line a scenario in a pipe."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.tree import Tree
from softrig_core import Scenario, list_scenarios, load_scenario


def console(**options: Any) -> Console:
    """Make a console as wide as the terminal or as COLUMNS says; in a pipe, lines are as long as they are."""
    narrow = sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit()
    return _Console(**{"width": None if narrow else 1000, "highlight": False} | options)


class _Console(Console):
    """As rich has it, but a reader that has gone is told by its own exit status, not by 1."""

    def on_broken_pipe(self) -> None:
        """Leave it to `guarded`; called while the error is handled."""
        raise


def main(part: str) -> int:
    """Print the scenarios with `part` in their name or system."""
    scenarios = [load_scenario(name) for name in sorted(list_scenarios())]
    chosen = [s for s in scenarios if part in s.name or part in s.system]
    if not sys.stdout.isatty() and "COLUMNS" not in os.environ:
        for s in chosen:
            print(f"{s.name}\t{s.system}\t{s.duration:g} s\t{s.title}\t{s.source}")
        return 0
    show = console()
    for system in sorted({s.system for s in chosen}):
        show.print(_tree(system, [s for s in chosen if s.system == system]))
    return 0


def _tree(system: str, scenarios: list[Scenario]) -> Tree:
    tree = Tree(f"[bold]{escape(system)}[/]")
    sources = {s.source for s in scenarios}
    if len(sources) == 1:
        tree.label = f"[bold]{escape(system)}[/]  [dim]{escape(sources.pop())}[/]"
    branches: list[tuple[str, Tree]] = []
    for s in scenarios:  # sorted, so that a variant comes after what it is a variant of
        while branches and not s.name.startswith(f"{branches[-1][0]}_"):
            branches.pop()
        facts = ", ".join([f"{s.duration:g} s", *_took(s.name)])
        label = f"{s.name}  [dim]{facts}[/]  {escape(s.title)}"
        branches.append((s.name, (branches[-1][1] if branches else tree).add(label)))
    return tree


def _took(name: str) -> list[str]:
    """How long the last run took here, if there is one."""
    try:
        content = json.loads((Path("runs") / name / "metrics.json").read_text())
        return [f"took {float(content['wall_s']):.2g} s ({content['mode']})"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
