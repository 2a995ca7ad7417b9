"""The exact optimal feedback of the spacecraft."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softrig_core import Block, Port, executable, to_s

from .parameters import ProblemParams
from .ports import control, state
from .problem import ProblemError


class MomentumFeedback(Block[ProblemParams]):
    r""":math:`u = -I \omega / (T - t)`: the momentum h = I w goes straight to zero.

    The gyroscopic torque cannot change \|h\|, so no control does with less than \|h_0\|^2/(2T). In the last period
    T - t is held at the period; after the horizon the command is zero. A state that is refused holds the command.
    """

    @classmethod
    def agreed(cls, params: ProblemParams) -> Mapping[str, Any]:
        """The task; its idea of the plant is its own."""
        return params.task_agreed()

    @classmethod
    def ports(cls, params: ProblemParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Channels of the spacecraft."""
        problem = params.statement()
        if problem.name != "spacecraft":
            raise ProblemError(f"problem = {problem.name!r}: the feedback is the spacecraft's")
        return (state(problem),), (control(problem),)

    def setup(self) -> None:
        """Horizon."""
        self._T = self.p.statement().horizon

    def start(self) -> None:
        """Not begun."""
        self._begin: int | None = None

    def update(self, t: int, *, state: tuple[float, ...]) -> Mapping[str, tuple[float, ...]]:
        """Give the torques."""
        if self._begin is None:
            self._begin = t
        left = self._T - to_s(t - self._begin)
        if left <= 1e-9:
            return {"command": (0.0, 0.0, 0.0)}
        gain = -1.0 / max(left, self.p.period)
        return {"command": tuple(gain * moment * w for moment, w in zip(self.p.inertia, state[:3], strict=True))}


main = executable(MomentumFeedback)
