"""What a viewer needs of a robot: its URDF and the frame of every link."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from softrig_core import Pose
from softrig_core.block.scene import Point

from .rigid_body import frame_id, load_model
from .urdf import root_link


class RobotScene:
    """The links of a URDF robot; see `softrig_core.block.scene.Scene`.

    Parameters
    ----------
    urdf : str
        URDF text.
    tip : str
        Frame whose path is drawn.
    port : str
        Output with the joint positions, in the URDF's order.
    """

    def __init__(self, urdf: str, tip: str, port: str = "joint_states") -> None:
        import pinocchio as pin

        self.description, self.port = urdf, port
        self._pin = pin
        self._model = load_model(urdf)
        self._data = self._model.createData()
        self._tip = frame_id(self._model, tip)
        frames = list(self._model.frames)
        bodies = [i for i, f in enumerate(frames) if f.type == pin.FrameType.BODY]
        # the parent frame of a link is its joint, whose parent frame is the link before
        joints = {i: frames[frames[i].parentFrame] for i in bodies}
        moving = {pin.FrameType.FIXED_JOINT: False, pin.FrameType.JOINT: True}
        linked = [(joints[i].parentFrame, i, moving[joints[i].type]) for i in bodies if joints[i].type in moving]
        self._fixed = [(parent, child) for parent, child, moves in linked if not moves and parent in joints]
        self._moving = [(parent, child) for parent, child, moves in linked if moves]
        self.base = root_link(urdf)

    def _place(self, q: Sequence[float]) -> None:
        import numpy as np

        self._pin.framesForwardKinematics(self._model, self._data, np.array(q, dtype=float))

    def _poses(self, pairs: Sequence[tuple[int, int]]) -> list[Pose]:
        return [self._pose(parent, child) for parent, child in pairs]

    def _pose(self, parent: int, child: int) -> Pose:
        frames, poses = self._model.frames, self._data.oMf
        between: Any = poses[parent].actInv(poses[child])
        x, y, z = between.translation.tolist()
        qx, qy, qz, qw = self._pin.Quaternion(between.rotation).normalized().coeffs().tolist()
        return Pose(frames[parent].name, frames[child].name, (x, y, z), (qx, qy, qz, qw))

    def fixed(self) -> list[Pose]:
        """Return the frames that never move in their parents'."""
        self._place([0.0] * self._model.nq)
        return self._poses(self._fixed)

    def moving(self, q: Sequence[float]) -> list[Pose]:
        """Return the frames behind the joints at positions q (rad or m)."""
        self._place(q)
        return self._poses(self._moving)

    def tip(self, q: Sequence[float]) -> Point:
        """Return the place of the tip in the base frame, m."""
        self._place(q)
        x, y, z = self._data.oMf[self._tip].translation.tolist()
        return x, y, z
