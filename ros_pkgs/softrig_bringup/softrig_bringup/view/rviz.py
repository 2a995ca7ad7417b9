"""RViz beside a launched rig, and its configuration, written for the rig."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softrig_core import Block, Rig
from softrig_core.block.port import WORLD
from softrig_core.block.scene import scene_of
from softrig_core.guard import replace

ROOTED = ("clock", "tf", "tf_static")  # topics with absolute names


@dataclass(frozen=True)
class Process:
    """The program to start.

    Parameters
    ----------
    name : str
        Of the node; empty for a container.
    arguments : list of str
        Of a container: its nodes.
    parameters : list of str
        Files.
    variables : mapping of str to str
        Of its environment, besides those of the launch.
    kind : {"rig", "viewer"}
        A node of the rig, or one whose end is the end of the launch.
    """

    package: str
    executable: str
    name: str = ""
    namespace: str = ""
    arguments: list[str] = field(default_factory=list)
    parameters: list[str] = field(default_factory=list)
    remappings: list[tuple[str, str]] = field(default_factory=list)
    variables: Mapping[str, str] = field(default_factory=dict)
    kind: str = "rig"


def viewer(rig: Rig, folder: Path, namespace: str, simulated: bool) -> Process:
    """Return RViz with its configuration: the first robot, and the drawings of blocks.

    Parameters
    ----------
    folder : Path
        For files.
    namespace : str
        Of the rig, without slashes; empty for the root.
    simulated : bool
        Whether the stamps are those of /clock.
    """
    prefix = f"/{namespace}" if namespace else ""
    moved = [(f"/{name}", f"{prefix}/{name}") for name in ROOTED] if namespace else []
    replace(folder / "rig.rviz", rviz_file(rig, prefix))
    return Process(
        "rviz2",
        "rviz2",
        arguments=["-d", str(folder / "rig.rviz")],
        parameters=[_parameters(folder / "rviz2.yaml", {"use_sim_time": simulated})],
        remappings=moved,
        kind="viewer",
    )


def rviz_file(rig: Rig, namespace: str = "") -> str:
    """Return the text of a configuration of RViz for a rig.

    Parameters
    ----------
    namespace : str
        That its nodes are in, with a leading slash.
    """
    robot, drawn = seen(rig)
    shown = _rviz(f"{namespace}/robot_description" if robot else "", [f"{namespace}/{n}/markers" for n in drawn])
    return json.dumps(shown, indent=1) + "\n"  # JSON is YAML


def seen(rig: Rig) -> tuple[bool, list[str]]:
    """Describe whether a rig has a robot, and name its nodes that draw markers."""
    robot = any(scene_of(m.block_class, m.params) is not None for m in rig.members)
    return robot, [m.name for m in rig.members if m.block_class.markers is not Block.markers]


def _parameters(file: Path, values: Mapping[str, Any]) -> str:
    replace(file, json.dumps({"/**": {"ros__parameters": dict(values)}}) + "\n")
    return str(file)


def _rviz(description: str, markers: Sequence[str]) -> dict[str, Any]:
    """Return a configuration of RViz 2."""

    def display(kind: str, name: str, **keys: Any) -> dict[str, Any]:
        return {"Class": f"rviz_default_plugins/{kind}", "Name": name, "Enabled": True, "Value": True} | keys

    def topic(name: str, durability: str) -> dict[str, Any]:
        return {
            "Value": name,
            "Depth": 5,
            "History Policy": "Keep Last",
            "Reliability Policy": "Reliable",
            "Durability Policy": durability,
        }

    displays = [display("Grid", "Grid"), display("TF", "TF")]
    if description:
        latched = {"Description Source": "Topic", "Description Topic": topic(description, "Transient Local")}
        displays.append(display("RobotModel", "RobotModel", **latched))
    displays += [display("MarkerArray", name, Topic=topic(name, "Volatile")) for name in markers]
    return {
        "Panels": [{"Class": "rviz_common/Displays", "Name": "Displays"}],
        "Visualization Manager": {
            "Class": "",
            "Displays": displays,
            "Enabled": True,
            "Global Options": {"Fixed Frame": WORLD, "Frame Rate": 30},
            "Name": "root",
            "Tools": [{"Class": f"rviz_default_plugins/{name}"} for name in ("Interact", "MoveCamera", "Select")],
            "Value": True,
            "Views": {"Current": {"Class": "rviz_default_plugins/Orbit", "Name": "Current View", "Distance": 3}},
        },
    }
