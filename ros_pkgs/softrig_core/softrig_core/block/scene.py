"""What a viewer needs of a block that moves bodies: their description and where they are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from ..wire.types import VECTOR
from .port import WORLD, Port

if TYPE_CHECKING:
    from .marker import Marker

Point = tuple[float, float, float]


class Pose(NamedTuple):
    """Where a frame is in its parent's: position in m, rotation as unit quaternion (x, y, z, w)."""

    parent: str
    child: str
    position: Point
    rotation: tuple[float, float, float, float]


class Scene(Protocol):
    """Bodies that move with the positions of an output port; `Block.scene` gives it.

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


def standing(markers: Iterable[Marker], scene: Scene | None, outputs: Iterable[Port]) -> list[Pose]:
    """Return the frames that do not move and that a block knows: of its bodies, its drawings, and what it says.

    Those of drawings and of quantities without a place (abc, alpha_beta, dq) are the world's own. A force is told in
    the frame of a body, which whoever moves that body knows.

    Parameters
    ----------
    markers, outputs : iterable of Marker, of Port
        Its own; as is `scene`.
    """
    bodies = [] if scene is None else [at_origin(scene.base), *scene.fixed()]
    known = {WORLD, *(pose.child for pose in bodies)}
    own = {marker.frame_id for marker in markers} | {p.frame for p in outputs if p.msgtype == VECTOR.name}
    return [*bodies, *map(at_origin, sorted(own - known))]


def at_origin(frame: str) -> Pose:
    """Return a frame that is the world's under another name."""
    return Pose(WORLD, frame, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
