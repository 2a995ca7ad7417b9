"""The controller of a scenario as a class for the user to change; at first it behaves as the original."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any, NamedTuple

from softrig_core import Port, Rig, ScenarioError, load_scenario, rig_of
from softrig_core.block.params import declarations, flatten
from softrig_core.errors import closest
from softrig_core.judge.expectation import Expectation
from softrig_core.rig.members import Member, signal_units
from softrig_core.run.live_figures import Figures
from softrig_core.scenario.yaml_file import write_yaml

from ..view.control import role

PREFERRED = ("law", "command", "observer")  # roles of nodes that a controller can replace, the likeliest first
MANY = 12  # values of a port up to which their names are listed


class Replaced(NamedTuple):
    """Data for a package that replaces a controller.

    Parameters
    ----------
    values : dict of str to str
        For the templates.
    package : str
        Has the class that is extended.
    change : str
        A parameter to change first, in the form of ``--set``.
    others : tuple of str
        Other nodes of the scenario that could be replaced.
    """

    values: dict[str, str]
    package: str
    change: str
    others: tuple[str, ...]


def replaced(wanted: str, name: str) -> Replaced:
    """Return the data with which a package `name` can replace the controller of a scenario.

    Parameters
    ----------
    wanted : str
        ``SCENARIO`` or ``SCENARIO/NODE``.

    Raises
    ------
    ScenarioError
        There is no such scenario or node, or the scenario has no controller.
    """
    scenario, _, node = wanted.partition("/")
    rig = rig_of(load_scenario(scenario))
    member, others = _member(rig, node)
    entry = rig.scenario.nodes[member.name]
    nodes = {member.name: {"package": name, "executable": f"{name}_controller"}}
    if entry.parameters:
        nodes[member.name] |= {"parameters": entry.model_dump(mode="json")["parameters"]}
    content: dict[str, Any] = {"title": f"{name} in {rig.scenario.name}", "extends": rig.scenario.name, "nodes": nodes}
    expected = {figure: _written(e) for figure, e in rig.scenario.expect.items()}
    content |= {"expect": expected} if expected else {}
    cls, units = member.block_class, signal_units(rig)
    outputs = [f"{p.topic}/{label}" for p in member.outputs for label in p.labels]
    values = {
        "scenario": write_yaml(content),
        "extended": rig.scenario.name,
        "node": member.name,
        "module": cls.__module__,
        "class": cls.__qualname__,
        "inputs": "\n".join(_described(member.inputs, "from", units)),
        "outputs": "\n".join(_described(member.outputs, "to", units)),
        "signals": repr(outputs[:MANY]),
        "input": member.inputs[0].name,
        "zeros": ", ".join(f'"{p.name}": {(0.0,) * len(p.labels)}' for p in member.outputs),
    }
    return Replaced(values, member.package, _change(member), others)


def _member(rig: Rig, node: str) -> tuple[Member, tuple[str, ...]]:
    """Return the node to replace (the nearest to the plant if none is named) and the names of the others."""
    name = rig.scenario.name
    plants = [m for m in rig.members if m.is_plant]
    direct = {link.source.name for plant in plants for link in plant.links.values()}
    ranks = {
        m.name: (PREFERRED.index(role(rig, m)), m.name not in direct)
        for m in rig.members
        if m.outputs and not issubclass(m.block_class, Figures) and role(rig, m) in PREFERRED
    }
    results = sorted(ranks, key=ranks.__getitem__)
    if not results:
        raise ScenarioError(f"--for {name}: it has no controller to replace; `softrig list` shows other scenarios")
    if node and node not in ranks:
        known = ", ".join(results)
        raise ScenarioError(f"--for {name}/{node}: no controller of it{closest(node, results)}; it has {known}")
    chosen = node or results[0]
    return next(m for m in rig.members if m.name == chosen), tuple(n for n in results if n != chosen)


def _written(expected: Expectation) -> Any:
    """Return an expectation in the form of a scenario file."""
    content = expected.model_dump(exclude_none=True)
    if "text" in content:
        return content["text"]
    if content.keys() == {"expected", "tolerance"}:
        return f"{content['expected']!r} +- {content['tolerance']!r}"
    return content


def _change(member: Member) -> str:
    """Return a parameter worth changing first, with a value near its present one, in the form of ``--set``."""
    values = flatten(member.params)
    numbers = [d for d in declarations(type(member.params)) if isinstance(values[d.name], float) and values[d.name]]
    chosen = min(numbers, key=lambda d: (not d.live, d.name.endswith("period")))
    return f"{member.name}.{chosen.name}={0.9 * values[chosen.name]:.4g}"


def _described(ports: tuple[Port, ...], direction: str, units: dict[str, str]) -> Iterator[str]:
    """Write a paragraph of a docstring for each port: name, topic, values with units."""
    for port in ports:
        shown = [f"{label} ({units.get(f'{port.topic}/{label}') or '1'})" for label in port.labels[:MANY]]
        more = f" and {len(port.labels) - MANY} more" if len(port.labels) > MANY else ""
        text = f"{port.name}, {direction} {port.topic}: {', '.join(shown) or port.msgtype}{more}"
        yield textwrap.fill(text, 110, initial_indent="    - ", subsequent_indent="      ", break_on_hyphens=False)
