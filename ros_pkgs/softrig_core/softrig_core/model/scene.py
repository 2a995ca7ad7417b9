"""What a viewer needs of a block that moves bodies: their description and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

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
        """Give the frames that never move in their parents'."""

    def moving(self, q: Sequence[float]) -> list[Pose]:
        """Give the frames behind the joints at positions q (rad or m)."""

    def tip(self, q: Sequence[float]) -> Point:
        """Give the place in the base frame whose path is worth seeing, m."""
