"""Completion of verbs, options, scenarios, nodes and parameters in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from softrig_core import Scenario

# The words so far go to `softrig completion --words`, which prints what the last one may become.
SCRIPT = """_softrig() {
    local IFS=$'\\n'
    COMPREPLY=($("${COMP_WORDS[0]}" completion --words "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
    [[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace
    return 0
}
complete -o default -F _softrig softrig
"""


def candidates(parser: argparse.ArgumentParser, words: Sequence[str]) -> list[str]:
    """Give what the last of some words may become.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        Of the command line.
    words : sequence of str
        What stands after the command's name; the last one is unfinished, perhaps empty.
    """
    *before, current = words or [""]
    return sorted({w for w in _all(parser, before, current) if w.startswith(current)})


def _all(parser: argparse.ArgumentParser, before: Sequence[str], current: str) -> Iterable[str]:
    verbs = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    if not before:
        return verbs.choices
    verb, previous = before[0], before[-1]
    if verb not in verbs.choices:
        return ()
    if verb == "node":
        return _executables(before[1:])
    if current.startswith("-"):
        return [o for a in verbs.choices[verb]._actions for o in a.option_strings if o.startswith("--")]
    option = next((a for a in verbs.choices[verb]._actions if previous in a.option_strings), None)
    if option is not None and option.choices:
        return map(str, option.choices)
    if previous in ("--set", "--grid", "--draw"):
        return [f"{name}=" for name in _shared(before)] + [
            f"{node}.{p}=" for node, names in _parameters(before).items() for p in names
        ]
    if previous == "--external":
        return _parameters(before)
    if verb in ("run", "golden", "study") and (option is None or option.nargs == 0):
        from softrig_core import list_scenarios

        return list_scenarios()
    return ()


def _executables(given: Sequence[str]) -> Iterable[str]:
    """Packages that depend on softrig_core, or the executables of one."""
    packages = {}
    from softrig_core.model.resource import prefixes

    for prefix in prefixes():
        for folder in prefix.glob("lib/*/"):
            manifest = prefix / "share" / folder.name / "package.xml"
            if manifest.is_file() and "softrig_core" in manifest.read_text(errors="replace"):
                packages[folder.name] = sorted(f.name for f in folder.iterdir() if f.is_file())
    if not given:
        return packages
    return packages.get(given[0], ()) if len(given) == 1 else ()


def _scenario(before: Sequence[str]) -> Scenario | None:
    """Give the first scenario that is named."""
    from softrig_core import ScenarioError, load_scenario

    for word in before[1:]:
        with suppress(ScenarioError):
            return load_scenario(word)
    return None


def _shared(before: Sequence[str]) -> Iterable[str]:
    """Shared values of the scenario that is named."""
    scenario = _scenario(before)
    return scenario.shared if scenario else ()


def _parameters(before: Sequence[str]) -> dict[str, list[str]]:
    """Nodes of the scenario that is named, with the names of their parameters."""
    from softrig_core import ScenarioError
    from softrig_core.model.params import declarations
    from softrig_core.rig.rig import load_block

    scenario = _scenario(before)
    with suppress(ScenarioError):
        return {name: [d.name for d in declarations(load_block(n.package, n.executable).Params)]
                for name, n in (scenario.nodes if scenario else {}).items()}  # fmt: skip
    return {}
