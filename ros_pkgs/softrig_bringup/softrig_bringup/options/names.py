"""Check of the names before ``=`` on a command line: a name without its node is refused, with the full name."""

from __future__ import annotations

from collections.abc import Iterable

from softrig_core import ScenarioError
from softrig_core.block.params import declarations
from softrig_core.rig.installed import load_block
from softrig_core.scenario.scenario import Draft


def check_names(draft: Draft, names: Iterable[str]) -> None:
    """Refuse names of parameters whose node is missing or unknown, where nodes of the scenario have such a parameter.

    Parameters
    ----------
    draft : Draft
        The scenario.
    names : iterable of str
        Names from options: ``node.parameter``, or a shared value.

    Raises
    ------
    ScenarioError
        Names what was meant: one of the nodes' parameters.
    """
    nodes, shared = draft.raw.get("nodes") or {}, draft.raw.get("shared") or {}
    known = {*nodes, *shared, *(draft.raw.get("faults") or {})}
    for name in names:
        node, _, parameter = name.replace("/", ".").partition(".")
        if (node in known and "/" not in name) or not isinstance(nodes, dict):
            continue
        spellings = {parameter.casefold(), name.casefold()}
        every = ((owner, field) for owner in nodes for field in _parameters(nodes[owner]))
        meant = sorted(f"{owner}.{field}" for owner, field in every if field.casefold() in spellings)
        meant = [candidate for candidate in meant if candidate.startswith(f"{node}.")] or meant
        if meant:
            raise ScenarioError(f"{name}: expected node.parameter; did you mean {' or '.join(meant)}?")


def _parameters(node: object) -> set[str]:
    """Return the names of a node's parameters; empty if the node cannot be found (reported elsewhere)."""
    about = node if isinstance(node, dict) else {}
    try:
        return {d.name for d in declarations(load_block(str(about["package"]), str(about["executable"])).Params)}
    except (KeyError, ScenarioError):
        return set()
