"""Parameters of the nodes of a scenario, where one may refer to another's."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from ..block.block import Block
from ..block.params import FromFiles, ParameterError, build
from ..errors import ScenarioError
from ..kit.newest import once_for_objects, shared
from .references import fill_parameters, parameter_of
from .scenario import Scenario

CHAIN = 50  # nodes whose parameters are those of the next one


def parameters(block: type[Block], values: Mapping[str, Any]) -> Any:
    """Build the parameters of a block class; those of a class that is not `FromFiles` depend on the values alone.

    Raises
    ------
    ParameterError
        See `build`.
    """
    if issubclass(block, FromFiles):
        return build(block.Params, values)
    return shared(build, block.Params, values)


@once_for_objects
def stands_alone(block: type[Block], values: Mapping[str, Any]) -> bool:
    """Return whether parameters of a node depend on these values alone: on no other node, and no file."""
    return "$" not in str(values) and not issubclass(block, FromFiles)


@once_for_objects
def _own(block: type[Block], values: Mapping[str, Any]) -> Any:
    """Build parameters that refer to none of another node: runs of a study share those of all nodes but the changed."""
    return parameters(block, fill_parameters(values, lambda node, name: None))


class NodeParameters:
    """Validated parameters of a scenario's nodes, with ``$node.parameter`` filled in."""

    def __init__(self, scenario: Scenario, classes: Mapping[str, type[Block]]) -> None:
        self._scenario = scenario
        self._classes = classes
        self._known: dict[str, Any] = {}
        self._open: list[str] = []

    def __call__(self, name: str) -> Any:
        """Return the parameters of a node."""
        context = f"{self._scenario.name}: node {name}"
        if name in self._open:
            raise ScenarioError(f"{context}: its parameters refer to themselves: {' -> '.join((*self._open, name))}")
        if len(self._open) >= CHAIN:
            first, *_, last = self._open
            raise ScenarioError(
                f"{context}: parameters refer to each other through {CHAIN} nodes, from {first} to {last}"
            )
        if name not in self._known:
            entry, block = self._scenario.nodes[name], self._classes[name]
            self._open.append(name)
            try:
                if stands_alone(block, entry.parameters):
                    self._known[name] = _own(block, entry.parameters)
                else:
                    values = fill_parameters(entry.parameters, self._of)
                    self._known[name] = parameters(block, values)
            except ParameterError as error:
                wrong = [k for k in entry.parameters if re.search(rf"\bparameter {re.escape(k)}(?![\w.])", str(error))]
                location = self._scenario.written("nodes", name, "parameters", *wrong[:1])
                raise ScenarioError(f"{context}: {error}{location}") from None
            finally:
                self._open.pop()
        return self._known[name]

    def _of(self, node: str, parameter: str) -> Any:
        context = f"{self._scenario.name}: node {self._open[-1]}: "
        return parameter_of(context, self._scenario.nodes, self, node, parameter)
