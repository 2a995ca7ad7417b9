"""Topics that let a viewer show a run from its bag alone: the robot's description, its frames, the path of its tip.

They are computed from the recording, so that equal runs still produce equal bags in every placement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from softrig_core import SECOND, Pose, Recording, Scene, Signals
from softrig_core.block.scene import Point, at_origin

from .content.topics import typestore

PERIOD = SECOND // 50  # ns between two sets of frames: a viewer's pictures
PATH = 500  # points of the path
STRING, TF, MARKERS = "std_msgs/msg/String", "tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray"
LATCHED = ("robot_description", "tf_static", "markers")


def with_scenery(recording: Recording, scenes: Mapping[str, Scene]) -> Recording:
    """Return a recording with additional topics for viewers.

    Parameters
    ----------
    recording : Recording
        Left as it is.
    scenes : mapping of str to Scene
        By the topic of the joint states. Of several robots the first is shown: their frames would have equal names.

    Returns
    -------
    Recording
        The same messages, and ``robot_description``, ``tf_static``, ``markers`` (the path of the tip, all three once,
        at the first joint state) and ``tf`` (`PERIOD`).
    """
    topic, scene = next(((t, s) for t, s in scenes.items() if recording.topics[t].number), ("", None))
    if scene is None:
        return recording
    result = recording.with_topics([("robot_description", STRING), ("tf_static", TF), ("tf", TF), ("markers", MARKERS)])
    ticks = recording.topics[topic].ticks()
    rows = [0]
    while (following := int(np.searchsorted(ticks, ticks[rows[-1]] + PERIOD))) < len(ticks):
        rows.append(following)
    columns = Signals(recording).table(topic).columns
    chosen = [x[rows].tolist() for label, x in columns.items() if label.endswith("/position")]
    times, q = ticks[rows].tolist(), list(zip(*chosen, strict=True))
    path = [scene.tip(joints) for joints in q[:: -(-len(q) // PATH)]]
    first = times[0]
    add(result, "robot_description", STRING, first, data=scene.description)
    still = [at_origin(scene.base), *scene.fixed()]
    add(result, "tf_static", TF, first, transforms=[_transform(first, pose) for pose in still])
    add(result, "markers", MARKERS, first, markers=[_line(first, scene.base, path)])
    for t, joints in zip(times, q, strict=True):
        add(result, "tf", TF, t, transforms=[_transform(t, pose) for pose in scene.moving(joints)])
    return result


def add(recording: Recording, name: str, msgtype: str, t: int, **fields: Any) -> None:
    """Add a message to a topic of a recording."""
    topic = recording.topics[name]
    topic.times.append(t)
    topic.data.append(bytes(typestore().serialize_cdr(make(msgtype, **fields), msgtype)))


def make(msgtype: str, **fields: Any) -> Any:
    """Create a message of rosbags' own."""
    return typestore().types[msgtype](**fields)


def header(t: int, frame: str) -> Any:
    """Create a header of a time in ns."""
    stamp = make("builtin_interfaces/msg/Time", sec=t // SECOND, nanosec=t % SECOND)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _vector(kind: str, values: Sequence[float]) -> Any:
    return make(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", values, strict=False)))


def _transform(t: int, pose: Pose) -> Any:
    translation, turn = _vector("Vector3", pose.position), _vector("Quaternion", pose.rotation)
    transform = make("geometry_msgs/msg/Transform", translation=translation, rotation=turn)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(t, pose.parent),
        child_frame_id=pose.child,
        transform=transform,
    )


def _line(t: int, frame: str, points: Sequence[Point]) -> Any:
    kind: Any = typestore().types["visualization_msgs/msg/Marker"]
    origin, upright = _vector("Point", (0.0, 0.0, 0.0)), _vector("Quaternion", (0.0, 0.0, 0.0, 1.0))
    nothing = np.array([], dtype=np.uint8)
    image = make("sensor_msgs/msg/CompressedImage", header=header(t, frame), format="", data=nothing)
    return kind(
        header=header(t, frame),
        ns="path",
        id=0,
        type=kind.LINE_STRIP,
        action=kind.ADD,
        pose=make("geometry_msgs/msg/Pose", position=origin, orientation=upright),
        scale=_vector("Vector3", (0.005, 0.0, 0.0)),
        color=make("std_msgs/msg/ColorRGBA", r=0.9, g=0.4, b=0.1, a=1.0),
        lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[_vector("Point", p) for p in points],
        colors=[],
        texture_resource="",
        texture=image,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=nothing),
        mesh_use_embedded_materials=False,
    )
