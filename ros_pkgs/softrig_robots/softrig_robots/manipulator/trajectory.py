"""Reference of the arm: every joint swings up and back, q_d = A (1 - cos(2 pi t / T_cycle))."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

from softrig_core import Block, BlockParams, Port, Values, param, reference, to_ns, to_s
from softrig_core.motion import Goal, Path

from ..joints import PerJoint, joint_units, spread
from .plant import JOINTS


class TrajectoryParams(BlockParams):
    """Published trajectory, 1 - cos(pi t / 7) rad on every joint."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    joints: tuple[str, ...] = param(JOINTS, "joint names", min_length=1)
    linear: tuple[str, ...] = param((), "prismatic joints, which move in m instead of rad")
    amplitude: PerJoint = param((1.0,), "amplitude A: half the range of the motion", "rad", live=True)
    cycle: float = param(14.0, "duration T_cycle of one motion there and back", "s", gt=0.0, live=True)
    goal: Goal = Goal()

    def _check(self) -> None:
        self.goal.require(len(self.joints))
        spread("amplitude", self.amplitude, len(self.joints))
        if unknown := [name for name in self.linear if name not in self.joints]:
            raise ValueError(f"linear: {', '.join(unknown)}: no such joint; expected some of {', '.join(self.joints)}")


class TrajectorySource(Block[TrajectoryParams]):
    """Publishes positions, velocities and accelerations at every tick: the published motion, or that to a goal."""

    @classmethod
    def ports(cls, params: TrajectoryParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one output and no input."""
        units = joint_units(params.joints, params.linear)
        motion = {"position": units.position, "velocity": units.velocity, "acceleration": units.acceleration}
        return (), (reference("reference", "reference", params.joints, **motion),)

    def setup(self) -> None:
        """Spread the amplitudes, compute the motion to a goal."""
        self._amplitude = spread("amplitude", self.p.amplitude, len(self.p.joints))
        self._cycle = to_ns(self.p.cycle)
        self._omega = 2.0 * pi / self.p.cycle
        self._path = Path(self.p.goal, len(self.p.joints)) if self.p.goal.times else None

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Values]:
        """Return the reference at t."""
        if self._path is not None:
            return x, {"reference": self._path.at(t)}
        w = self._omega
        phase = w * to_s(t % self._cycle)  # whole cycles leave no rounding
        c, s = cos(phase), sin(phase)
        A = self._amplitude
        return x, {"reference": (*[a * (1.0 - c) for a in A], *[a * w * s for a in A], *[a * w * w * c for a in A])}
