"""The list of scenarios: a tree by system on a terminal, one line a scenario in a pipe."""

from __future__ import annotations

import argparse
import inspect
import json
import os
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text
from rich.tree import Tree
from softrig_core import Scenario, ScenarioError, list_scenarios, load_scenario, rig_of
from softrig_core.block.params import LARGEST, declarations, flatten
from softrig_core.errors import closest
from softrig_core.guard import plain, say
from softrig_core.judge.registry import find, registered
from softrig_core.rig.members import signal_units
from softrig_core.wire.signals import short_name

FOLDED = 1  # levels of variants that are shown of all systems


def console(**options: Any) -> Console:
    """Create a console as wide as the terminal or as COLUMNS says; in a pipe, lines are as long as they are."""
    narrow = sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit()
    return _Console(**{"width": None if narrow else 1000, "highlight": False, "markup": False} | options)


def styled(*parts: str | tuple[str, str]) -> Text:
    """Create a line of texts and of (text, style): no text has a style by itself, whoever wrote it."""
    return Text.assemble(*(plain(p) if isinstance(p, str) else (plain(p[0]), p[1]) for p in parts))


class _Console(Console):
    """Rich's console, but text is text, and a closed pipe has its own exit status instead of 1."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Show control characters instead of obeying them."""
        return super().render_str(plain(text), **options)

    def on_broken_pipe(self) -> None:
        """Leave the error to `guarded`; called while it is handled."""
        raise


def main(options: argparse.Namespace) -> int:
    """Print scenarios, or signals of one, or figure functions, as the options say; returns the exit status."""
    if options.signals is not None:
        return list_signals(options.signals)
    if options.parameters is not None:
        return list_parameters(options.parameters)
    return list_scenarios_of(options.filter) if options.figures is None else list_figures(options.figures)


def list_scenarios_of(part: str) -> int:
    """Print the scenarios with a text in their name or system; 1 when there are none, 2 when files are no scenarios.

    On a terminal variants of variants are folded unless a text is given.
    """
    broken: list[ScenarioError] = []
    scenarios = []
    for name in sorted(list_scenarios(broken)):
        try:
            scenarios.append(load_scenario(name))
        except ScenarioError as error:
            broken.append(error)
    for what in broken:
        say(what)
    chosen = [s for s in scenarios if part in s.name or part in s.system]
    if part and not chosen:
        near = closest(part, {word for s in scenarios for word in (s.name, s.system)})
        say(f"nothing matches {part!r}{near}; softrig list shows all {len(scenarios)} scenarios")
        return 2 if broken else 1
    if not sys.stdout.isatty() and "COLUMNS" not in os.environ:
        for s in chosen:
            print(plain(f"{s.name}\t{s.system}\t{s.duration:g} s\t{s.title}\t{s.source}"))
        return 2 if broken else 0
    show = console()
    for system in sorted({s.system for s in chosen}):
        show.print(_tree(system, [s for s in chosen if s.system == system], FOLDED if not part else len(chosen)))
    return 2 if broken else 0


def _tree(system: str, scenarios: list[Scenario], depth: int) -> Tree:
    """Return the scenarios of a system, variants below what they are variants of; those below `depth` as a number."""
    sources = {s.source for s in scenarios}
    tree = Tree(styled((system, "bold"), *(("  ", (sources.pop(), "dim")) if len(sources) == 1 else ())))
    branches: list[tuple[str, Tree]] = []
    for s in scenarios:  # sorted, so that a variant comes after what it is a variant of
        while branches and not s.name.startswith(f"{branches[-1][0]}_"):
            branches.pop()
        if len(branches) > depth:
            continue
        below = sum(other.name.startswith(f"{s.name}_") for other in scenarios) if len(branches) == depth else 0
        more = [f"{below} variant{'s' if below > 1 else ''}: list {s.name}"] if below else []
        facts = ", ".join([f"{s.duration:g} s", *_took(s.name), *more])
        label = styled(f"{s.name}  ", (facts, "dim"), f"  {s.title}")
        branches.append((s.name, (branches[-1][1] if branches else tree).add(label)))
    return tree


def _took(name: str) -> list[str]:
    """Return how long the last run took here, if there is one."""
    try:
        content = json.loads((Path("runs") / name / "metrics.json").read_text())
        return [f"took {float(content['wall_s']):.2g} s ({content['mode']})"]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def list_figures(name: str) -> int:
    """Print the figure functions that scenarios may name, or what one of them says of itself."""
    if name:
        function = find(name)
        print(f"{name}{inspect.signature(function)}\n\n{inspect.getdoc(function) or ''}\n")
        print(f"unit: {getattr(function, 'unit', None) or 'as in the scenario'}")
        return 0
    for one in registered():
        first = (inspect.getdoc(find(one)) or "").partition("\n")[0]
        print(f"{one}\t{getattr(find(one), 'unit', None) or ''}\t{first}")
    return 0


def list_signals(scenario: str) -> int:
    """Print the signals of a scenario: name, unit, who publishes it, who reads it; a field that is the only one is left
    out, as it may be wherever a signal is named.
    """
    rig = rig_of(scenario)
    units = signal_units(rig)
    source = {p.topic: (m, p) for m in rig.members for p in m.outputs}
    for topic, port in rig.topics.items():
        labels = [f"{topic}/{label}" for label in port.labels]
        for label in labels:
            member, own = source.get(topic, (None, port))
            readers = ", ".join(m.name for m, _ in rig.readers(member, own)) if member else ""
            said = f"{member.name if member else 'outside'} -> {readers or '-'}"
            print(f"{short_name(label, units)}\t{units[label] or '1'}\t{port.msgtype.replace('/msg/', '/')}\t{said}")
    return 0


def list_parameters(scenario: str) -> int:
    """Print the parameters of a scenario's nodes: name as --set takes it, value, unit, bounds, live, what it is."""
    for member in rig_of(scenario).members:
        values = flatten(member.params)
        for d in declarations(type(member.params)):
            low, high = (f"{x:g}" if x is not None and abs(x) < LARGEST else "" for x in (d.lower, d.upper))
            bounds = f"{low}..{high}" if low or high else ""
            cells = [f"{member.name}.{d.name}", values[d.name], d.unit or "1", bounds, "live" if d.live else "", d.doc]
            print(plain("\t".join(map(str, cells))))
    return 0
