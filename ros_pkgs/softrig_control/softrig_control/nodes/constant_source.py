"""Constants that step at given times: named scalars (set points, events), or the open-loop command of actuators."""

from __future__ import annotations

from typing import Any, ClassVar

from softrig_core import Block, Port, Values, joint_state, param
from typing_extensions import TypeVar

from ..profile import ProfileParams, StepProfile


class ScalarSourceParams(ProfileParams):
    """Parameters of a source of scalars: channels, units, and values, ordered by time and then by channel."""

    channels: tuple[str, ...] = param(("v_dc",), "names of the channels", min_length=1)
    units: tuple[str, ...] = param(("V",), "unit of each, or one of all", min_length=1)
    values: tuple[float, ...] = param((400.0,), "value of every channel from each time on", live=True)

    def _check(self) -> None:
        self.rows("values")
        if len(self.units) not in (1, len(self.channels)):
            raise ValueError(f"{len(self.units)} units for {len(self.channels)} channels")


class CommandSourceParams(ScalarSourceParams):
    """As `ScalarSourceParams`, of actuators."""

    channels: tuple[str, ...] = param(("armature",), "names of the actuators", min_length=1)
    values: tuple[float, ...] = param((6.0,), "command of every actuator from each time on", live=True)


P = TypeVar("P", bound=ScalarSourceParams, default=ScalarSourceParams)


class ScalarSource(Block[P]):
    """Publishes the scalars at every tick."""

    NAME: ClassVar[str] = "values"
    FIELD: ClassVar[str] = "position"

    @classmethod
    def ports(cls, params: ScalarSourceParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one output with the channels of the parameters."""
        units = params.units * len(params.channels) if len(params.units) == 1 else params.units
        return (), (joint_state(cls.NAME, cls.NAME, params.channels, **{cls.FIELD: units}),)

    def setup(self) -> None:
        """Prepare the answer for each time."""
        self._answers = StepProfile(self.p.times, [{self.NAME: row} for row in self.p.rows("values")])

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Values]:
        """Return the values at t."""
        return x, self._answers.at(t)


class CommandSource(ScalarSource[CommandSourceParams]):
    """Publishes the command of the actuators at every tick."""

    NAME = "command"
    FIELD = "effort"
