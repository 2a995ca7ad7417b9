"""The list of scenarios: a tree by system on a terminal, one line a scenario in a pipe."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from softrig_core.errors import ScenarioError, closest
from softrig_core.guard import plain, print_line
from softrig_core.kit.file_format import json_of
from softrig_core.scenario.index import Listed, listed

if TYPE_CHECKING:
    from rich.tree import Tree

FOLDED = 1  # levels of variants that are printed in the list of all systems


def main(options: argparse.Namespace) -> int:
    """Print scenarios, signals of one scenario, or figure functions, as the options select; return the exit status."""
    if (options.signals, options.parameters, options.figures) == (None, None, None):
        return list_scenarios_of(options.filter)
    from ..terminal import parts

    if options.signals is not None:
        return parts.list_signals(options.signals)
    if options.parameters is not None:
        return parts.list_parameters(options.parameters)
    return parts.list_figures(options.figures)


def list_scenarios_of(text: str) -> int:
    """Print the scenarios with a text in their name or system; 1 if there are none, 2 if files are not scenarios.

    On a terminal variants of variants are folded unless a text is given.
    """
    broken: list[ScenarioError] = []
    scenarios = listed(broken)
    for error in broken:
        print_line(error)
    chosen = [s for s in scenarios if text in s.name or text in s.system]
    if text and not chosen:
        near = closest(text, {name for s in scenarios for name in (s.name, s.system)})
        print_line(f"nothing matches {text!r}{near}; softrig list shows all {len(scenarios)} scenarios")
        return 2 if broken else 1
    if not sys.stdout.isatty() and "COLUMNS" not in os.environ:
        for s in chosen:
            print(plain(f"{s.name}\t{s.system}\t{s.duration:g} s\t{s.title}\t{s.source}"))
        return 2 if broken else 0
    from ..terminal.console import console

    show = console()
    for system in sorted({s.system for s in chosen}):
        show.print(_tree(system, [s for s in chosen if s.system == system], FOLDED if not text else len(chosen)))
    return 2 if broken else 0


def _tree(system: str, scenarios: list[Listed], depth: int) -> Tree:
    """Return the scenarios of a system, with variants below their base; those below `depth` as a number."""
    from rich.tree import Tree

    from ..terminal.console import styled

    sources = {s.source for s in scenarios}
    tree = Tree(styled((system, "bold"), *(("  ", (sources.pop(), "dim")) if len(sources) == 1 else ())))
    branches: list[tuple[str, Tree]] = []
    for s in scenarios:  # sorted, so that a variant follows its base
        while branches and not s.name.startswith(f"{branches[-1][0]}_"):
            branches.pop()
        if len(branches) > depth:
            continue
        below = sum(variant.name.startswith(f"{s.name}_") for variant in scenarios) if len(branches) == depth else 0
        more = [f"{below} variant{'s' if below > 1 else ''}: list {s.name}"] if below else []
        facts = ", ".join([f"{s.duration:g} s", *_last_duration(s.name), *more])
        label = styled(f"{s.name}  ", (facts, "dim"), f"  {s.title}")
        branches.append((s.name, (branches[-1][1] if branches else tree).add(label)))
    return tree


def _last_duration(name: str) -> list[str]:
    """Return how long the last run took here, if there is one."""
    try:
        content = json_of((Path("runs") / name / "metrics.json").read_text())
        return [f"took {float(content['wall_s']):.2g} s ({content['mode']})"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
