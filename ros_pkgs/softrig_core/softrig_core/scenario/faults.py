"""Faults of a scenario: each becomes a node between a publisher and its subscribers, inserted by remapping."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from ..block.params import BlockParams
from ..block.port import Port
from ..errors import ScenarioError, closest

PACKAGE, EXECUTABLE = "softrig_control", "fault"
TAKEN = ("bag", "log")
WORDS = {"from": "start", "to": "stop", "channels": "affects"}  # words of scenarios for the node's parameters
Ports = tuple[tuple[Port, ...], tuple[Port, ...]]


class FaultEntry(BaseModel):
    """A fault on a link.

    Parameters
    ----------
    link : str
        The topic, for all its readers, or ``topic -> reader`` for one node.
    **parameters
        Of the node `softrig_control` ``fault``: kind, value, ...; ``from``, ``to`` and ``channels`` are its `start`,
        `stop` and `affects`.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    link: str = Field(pattern=r"^\s*[\w/]+\s*(->\s*\w+\s*)?$")

    @field_validator("link")
    @classmethod
    def _spaced(cls, link: str) -> str:
        return " -> ".join(part.strip() for part in link.split("->"))

    @property
    def parameters(self) -> dict[str, Any]:
        """Return the entries of the fault other than the link."""
        return {WORDS.get(name, name): value for name, value in (self.model_extra or {}).items()}


def insert(
    source: str,
    faults: Mapping[str, FaultEntry],
    nodes: Mapping[str, Any],
    ports: Mapping[str, Ports],
    params: Mapping[str, BlockParams],
) -> dict[str, Any]:
    """Insert the faults of a scenario between its nodes, in the order of the file.

    Parameters
    ----------
    source : str
        Name of the scenario, for errors.
    faults : mapping of str to FaultEntry
        By the name of the node that implements the fault.
    nodes : mapping of str to mapping
        Package, executable, parameters, remap and external of each node.
    ports, params : mapping
        Of each node; the topics of ports are remapped as in `nodes`.

    Returns
    -------
    dict
        The nodes with those of the faults, remapped.

    Raises
    ------
    ScenarioError
        There is no such link or reader, a name is taken, or a parameter is set by the link; the message names the
        fault.
    """
    result = {name: {**entry, "remap": dict(entry["remap"])} for name, entry in nodes.items()}
    sources = {port.topic: (name, port) for name, (_, outputs) in ports.items() for port in outputs}
    # the present link of each subscriber: (node, its own topic) to its present topic and the original one
    readers = {(name, port.topic): port.topic for name, (inputs, _) in ports.items() for port in inputs}
    for name, fault in faults.items():
        topic, _, reader = fault.link.partition(" -> ")
        context = f"{source}: fault {name}"
        if name in TAKEN:
            raise ScenarioError(f"{context}: a run's folder has a {name} of its own, expected another name")
        if name in result:
            raise ScenarioError(f"{context}: that is the name of a node, too")
        if topic not in sources:
            raise ScenarioError(
                f"{context}: no node publishes {topic!r}{closest(topic, sources)}; published are {', '.join(sources)}"
            )
        concerned = [key for key in readers if key[1] == topic and reader in ("", key[0])]
        if not concerned:
            raise ScenarioError(f"{context}: {_unheard(topic, reader, [n for n, t in readers if t == topic])}")
        before = {readers[key] for key in concerned}
        if len(before) > 1:
            raise ScenarioError(
                f"{context}: the readers of {topic} have other faults already "
                f"({', '.join(sorted(before))}); put the fault that all share first"
            )
        sender, port = sources[topic]
        begins, ends = before.pop(), f"{topic}/{name}"
        about = {
            "topic_in": begins,
            "topic_out": ends,
            "message": port.msgtype,
            "channels": list(port.channels),
            "fields": list(port.fields),
            "dims": [label for label, _ in port.dims],
            "sizes": [size for _, size in port.dims],
            "units": list(port.units),
            "limits": list(port.limits),
            "frame_id": port.frame_id,
            "delayed": port.delayed,
            "period": params[sender].period,
        }
        if any(nodes[reader]["external"] for reader, _ in concerned):
            about["holds"] = True  # an outside node is not told of silence, and would be waited for
        for key in sorted(about.keys() & fault.parameters.keys() - {"period", "holds"}):
            raise ScenarioError(f"{context}: {key} is set by the link; remove it from the fault")
        result[name] = {
            "package": PACKAGE,
            "executable": EXECUTABLE,
            "parameters": about | fault.parameters,
            "remap": {},
            "external": False,
        }
        for input_key in concerned:
            readers[input_key] = ends
            result[input_key[0]]["remap"] |= _remap(nodes[input_key[0]]["remap"], topic, ends)
    return result


def _unheard(topic: str, reader: str, subscribers: list[str]) -> str:
    """Report that a fault has no effect, since none of the nodes concerned subscribes to its link."""
    if reader and subscribers:
        return f"{reader} does not subscribe to {topic}; its subscribers are {', '.join(subscribers)}"
    return (
        f"no node acts on {topic}, so a fault there would change nothing (figures are measured on what is sent); "
        "expected a link with a subscriber"
    )


def _remap(remap: Mapping[str, str], topic: str, ends: str) -> dict[str, str]:
    """Return the new name of a topic that a subscriber knows under its own name."""
    names = [name for name, target in remap.items() if target == topic]
    return dict.fromkeys(names or [topic], ends)
