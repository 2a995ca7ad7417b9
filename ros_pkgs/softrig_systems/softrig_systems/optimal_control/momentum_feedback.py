"""The exact optimal feedback of the spacecraft."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_core import Block, Port, Values, to_s

from .parameters import ProblemParams
from .ports import control, state
from .problem import ProblemError


class State(NamedTuple):
    """Time of the first tick, ns."""

    begin: int | None = None


class MomentumFeedback(Block[ProblemParams]):
    r"""Drives the momentum h = I w of a spacecraft to zero along a straight line.

    :math:`u = -I \omega / (T - t)`. The gyroscopic torque cannot change \|h\|, so no control does with less than
    \|h_0\|^2/(2T). In the last period T - t is held at the period; after the horizon the command is zero. If the state
    is refused, the command is held.
    """

    STATE = State

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

    def update(self, x: State, t: int, *, state: tuple[float, ...]) -> tuple[State, Values]:
        """Return the torques."""
        if x.begin is None:
            x = State(t)
        assert x.begin is not None
        left = self._T - to_s(t - x.begin)
        if left <= 1e-9:
            return x, {"command": (0.0, 0.0, 0.0)}
        gain = -1.0 / max(left, self.p.period)
        return x, {"command": tuple(gain * moment * w for moment, w in zip(self.p.inertia, state[:3], strict=True))}
