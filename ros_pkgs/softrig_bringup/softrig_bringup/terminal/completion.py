"""Completion of names of scenarios, nodes, parameters and executables on a command line, for argcomplete."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Callable, Container, Iterable
from contextlib import suppress
from typing import Any


def complete(parser: argparse.ArgumentParser) -> None:
    """Complete the arguments of a parser and of its verbs by their meaning."""
    for action in parser._actions:
        if action.dest in _COMPLETERS:
            action.completer = _COMPLETERS[action.dest]  # type: ignore[attr-defined]
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                complete(verb)


def asked(foreign: Container[str]) -> list[str]:
    """Return the words of the verb that a shell completes, if the verb has its own parser."""
    try:
        words = shlex.split(os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))] + "|")
    except ValueError:  # the word is within quotes
        return []
    for count in (2, 1):
        verb = words[1 : count + 1]
        if len(words) > count + 1 and " ".join(verb) in foreign:
            os.environ["_ARGCOMPLETE"] = str(count + 1)  # the words of the command begin with the last of these
            return verb
    return []


def _scenarios(**_: Any) -> Iterable[str]:
    from softrig_core import list_scenarios

    return list_scenarios()


def _parameters(parsed_args: argparse.Namespace) -> tuple[Iterable[str], dict[str, list[str]]]:
    """Shared values of the scenario that is named, and its nodes with the names of their parameters."""
    from softrig_core import ScenarioError, load_scenario
    from softrig_core.block.params import declarations
    from softrig_core.rig.installed import load_block

    options = vars(parsed_args)
    with suppress(ScenarioError):
        scenario = load_scenario(options.get("scenario") or options.get("study") or options.get("what") or "")
        return scenario.shared, {
            name: [d.name for d in declarations(load_block(n.package, n.executable).Params)]
            for name, n in scenario.nodes.items()
        }
    return (), {}


def _settings(parsed_args: argparse.Namespace, **_: Any) -> Iterable[str]:
    shared, nodes = _parameters(parsed_args)
    return [f"{name}=" for name in shared] + [f"{node}.{p}=" for node, names in nodes.items() for p in names]


def _nodes(parsed_args: argparse.Namespace, **_: Any) -> Iterable[str]:
    return _parameters(parsed_args)[1]


def _packages() -> dict[str, list[str]]:
    """Packages that depend on softrig_core, with their executables."""
    from softrig_core.kit.resource import prefixes

    packages = {}
    for prefix in prefixes():
        for folder in prefix.glob("lib/*/"):
            manifest = prefix / "share" / folder.name / "package.xml"
            if manifest.is_file() and "softrig_core" in manifest.read_text(errors="replace"):
                packages[folder.name] = sorted(f.name for f in folder.iterdir() if f.is_file())
    return packages


def _executables(parsed_args: argparse.Namespace, **_: Any) -> Iterable[str]:
    return _packages().get(parsed_args.package, ())


_COMPLETERS: dict[str, Callable[..., Iterable[str]]] = {
    "scenario": _scenarios,
    "scenarios": _scenarios,
    "names": _scenarios,
    "study": _scenarios,
    "what": _scenarios,
    "set": _settings,
    "grid": _settings,
    "draw": _settings,
    "over": _settings,
    "external": _nodes,
    "only": _nodes,
    "package": lambda **_: _packages(),
    "executable": _executables,
}
