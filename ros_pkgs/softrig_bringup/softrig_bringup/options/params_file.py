"""Parameters of nodes from a file in the form of ``ros2 param dump``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError
from softrig_core.errors import closest
from softrig_core.scenario.yaml_file import read_yaml

OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides", "run")  # not of a block


def params_of(file: Path, nodes: Iterable[str]) -> dict[str, Any]:
    """Give the parameters of a file as `load_scenario` takes changes: by ``node.parameter``.

    Those that every ROS node has are left out, and so are ``run.*``, which the rig sets.

    Parameters
    ----------
    file : Path
        ``NODE: {ros__parameters: {NAME: VALUE}}``, NODE with or without its namespace, names dotted or nested.
    nodes : iterable of str
        Of the scenario.

    Raises
    ------
    ScenarioError
        The file cannot be read, has another form, or names a node that is not of the scenario.
    """
    nodes = list(nodes)
    try:
        content = read_yaml(file.read_text(), str(file))
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"params file {file}: {error}") from None
    if not isinstance(content, Mapping):
        raise ScenarioError(f"params file {file}: expected NODE: {{ros__parameters: {{NAME: VALUE}}}}")
    found: dict[str, Any] = {}
    for key, entry in content.items():
        node = str(key).rpartition("/")[2]
        if node not in nodes:
            raise ScenarioError(
                f"params file {file}: {key}: no such node{closest(node, nodes)}; the nodes are {', '.join(nodes)}"
            )
        values = entry.get("ros__parameters") if isinstance(entry, Mapping) else None
        if not isinstance(values, Mapping):
            raise ScenarioError(f"params file {file}: {key}: expected ros__parameters: {{NAME: VALUE}}")
        own = ((name, value) for name, value in _flat(values) if name.partition(".")[0] not in OF_ROS)
        found |= {f"{node}.{name}": value for name, value in own}
    return found


def _flat(values: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
