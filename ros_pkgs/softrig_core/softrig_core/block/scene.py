"""What a viewer needs of a block: its markers, and of one that moves bodies their description and where they are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

from ..wire.types import VECTOR
from .port import WORLD, Port

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Marker:
    """A set of points drawn as lines or balls: a block's `markers` returns them, a node publishes them as MarkerArray.

    Parameters
    ----------
    frame_id : str
        Frame of the points.
    name : str
        Namespace of the marker; one marker a name.
    kind : {"line_list", "line_strip", "sphere_list"}
        A line for each pair of points, one line through all, or a ball at each.
    points : tuple of (x, y, z)
        m.
    size : float
        Width of the lines or diameter of the balls, m.
    color : tuple of 4 floats
        Red, green, blue, opacity, each from 0 to 1.
    """

    frame_id: str
    name: str
    kind: Literal["line_list", "line_strip", "sphere_list"]
    points: tuple[Point, ...]
    size: float
    color: tuple[float, float, float, float] = (0.2, 0.4, 0.8, 1.0)


class Pose(NamedTuple):
    """Pose of a frame in its parent frame: position in m, rotation as unit quaternion (x, y, z, w)."""

    parent: str
    child: str
    position: Point
    rotation: tuple[float, float, float, float]


class Scene(Protocol):
    """Bodies that move with the positions of an output port; `Moving.scene` returns it.

    Attributes
    ----------
    port : str
        Name of the output, a joint state.
    description : str
        URDF.
    base : str
        Frame that does not move.
    """

    port: str
    description: str
    base: str

    def fixed(self) -> list[Pose]:
        """Return the frames that never move in their parents'."""

    def moving(self, q: Sequence[float]) -> list[Pose]:
        """Return the frames behind the joints at positions q (rad or m)."""

    def tip(self, q: Sequence[float]) -> Point:
        """Return the place in the base frame whose path is worth seeing, m."""


@runtime_checkable
class Moving(Protocol):
    """A block that moves bodies, such as a robot."""

    @classmethod
    def scene(cls, params: Any) -> Scene:
        """Return the scene for a viewer, with these parameters."""


def scene_of(block_class: type, params: Any) -> Scene | None:
    """Return the scene of the bodies that a block moves; None: it moves none."""
    return block_class.scene(params) if issubclass(block_class, Moving) else None


def standing(markers: Iterable[Marker], scene: Scene | None, outputs: Iterable[Port]) -> list[Pose]:
    """Return the fixed frames of a block: of its bodies, its drawings and its outputs.

    Frames of drawings and of quantities without a position (abc, alpha_beta, dq) coincide with the world frame. A force
    is published in the frame of a body, which the block that moves this body publishes.

    Parameters
    ----------
    markers, outputs : iterable of Marker, of Port
        Those of the block, like `scene`.
    """
    bodies = [] if scene is None else [at_origin(scene.base), *scene.fixed()]
    known = {WORLD, *(pose.child for pose in bodies)}
    frames = {marker.frame_id for marker in markers} | {p.frame for p in outputs if p.msgtype == VECTOR.name}
    return [*bodies, *map(at_origin, sorted(frames - known))]


def at_origin(frame: str) -> Pose:
    """Return a frame that is the world's under another name."""
    return Pose(WORLD, frame, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
