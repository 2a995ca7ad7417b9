"""RViz beside a launched rig: its file, written for the rig, and those who give it frames."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softrig_core import Block, Rig, Scene
from softrig_core.rig.members import Member

WORLD = "world"  # the frame that is fixed where no robot brings one


@dataclass(frozen=True)
class Process:
    """What is to be started.

    Parameters
    ----------
    package, executable : str
    name : str
        Of the node; empty for a container.
    namespace : str
    arguments : list of str
        Of a container: its nodes.
    parameters : list of str
        Files.
    remappings : list of (str, str)
    kind : {"rig", "frames", "viewer"}
        A node of the rig, one that goes on beside it, or one whose end is the end of the launch.
    """

    package: str
    executable: str
    name: str = ""
    namespace: str = ""
    arguments: list[str] = field(default_factory=list)
    parameters: list[str] = field(default_factory=list)
    remappings: list[tuple[str, str]] = field(default_factory=list)
    kind: str = "rig"


def viewers(rig: Rig, folder: Path, namespace: str, simulated: bool) -> list[Process]:
    """Give RViz with its file, and what publishes the frames of the first robot and of what is drawn.

    Parameters
    ----------
    rig : Rig
    folder : Path
        For files.
    namespace : str
        Of the rig, without slashes; empty for the root.
    simulated : bool
        Whether the stamps are those of /clock.
    """
    own = f"/{namespace}" if namespace else ""
    moved = [(f"/{name}", f"{own}/{name}") for name in ("clock", "tf", "tf_static")] if namespace else []
    robot, scene = next(((m, s) for m in rig.members if (s := m.block_class.scene(m.params))), (None, None))
    drawn = {m.name: _frames(m, rig.scenario.seed) for m in rig.members if m.block_class.markers is not Block.markers}
    fixed = scene.base if scene is not None else WORLD
    given = {"use_sim_time": simulated}
    found = []
    known = {fixed}
    if robot is not None and scene is not None:
        known |= {pose.child for pose in (*scene.fixed(), *scene.moving([0.0] * len(_joints(robot, scene))))}
        file = _parameters(folder / "robot_state_publisher.yaml", given | {"robot_description": scene.description})
        joints = next(p.topic for p in robot.outputs if p.name == scene.port)
        # the robot's node publishes the description already
        remaps = [*moved, ("joint_states", joints), ("robot_description", "~/robot_description")]
        found.append(Process("robot_state_publisher", "robot_state_publisher", namespace=namespace, parameters=[file],
                             remappings=remaps, kind="frames"))  # fmt: skip
    for frame in sorted({f for frames in drawn.values() for f in frames} - known):
        found.append(Process("tf2_ros", "static_transform_publisher", f"frame_{frame}", namespace,
                             ["--frame-id", fixed, "--child-frame-id", frame], remappings=moved,
                             kind="frames"))  # fmt: skip
    shown = _rviz(fixed, f"{own}/robot_description" if scene is not None else "", [f"{own}/{n}/markers" for n in drawn])
    (folder / "rig.rviz").write_text(json.dumps(shown, indent=1) + "\n")  # JSON is YAML
    found.append(Process("rviz2", "rviz2", arguments=["-d", str(folder / "rig.rviz")],
                         parameters=[_parameters(folder / "rviz2.yaml", given)], remappings=moved,
                         kind="viewer"))  # fmt: skip
    return found


def _joints(robot: Member, scene: Scene) -> Sequence[str]:
    port = next(p for p in robot.outputs if p.name == scene.port)
    return list(dict.fromkeys(label.rpartition("/")[0] for label in port.labels if label.endswith("/position")))


def _frames(member: Member, seed: int) -> set[str]:
    """Name the frames in which a block draws at its start."""
    return {marker.frame_id for marker in member.block(seed).markers()}


def _parameters(file: Path, values: Mapping[str, Any]) -> str:
    file.write_text(json.dumps({"/**": {"ros__parameters": dict(values)}}) + "\n")
    return str(file)


def _rviz(fixed: str, description: str, markers: Sequence[str]) -> dict[str, Any]:
    """Give a configuration of RViz 2."""

    def display(kind: str, name: str, **keys: Any) -> dict[str, Any]:
        return {"Class": f"rviz_default_plugins/{kind}", "Name": name, "Enabled": True, "Value": True} | keys

    def topic(name: str, durability: str) -> dict[str, Any]:
        return {"Value": name, "Depth": 5, "History Policy": "Keep Last", "Reliability Policy": "Reliable",
                "Durability Policy": durability}  # fmt: skip

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
            "Global Options": {"Fixed Frame": fixed, "Frame Rate": 30},
            "Name": "root",
            "Tools": [{"Class": f"rviz_default_plugins/{name}"} for name in ("Interact", "MoveCamera", "Select")],
            "Value": True,
            "Views": {"Current": {"Class": "rviz_default_plugins/Orbit", "Name": "Current View", "Distance": 3}},
        },
    }
