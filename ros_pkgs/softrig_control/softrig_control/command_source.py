"""Open-loop command of one or more actuators: constants that step at given times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pydantic import model_validator
from softrig_core import Block, Port, command, executable, param

from .profile import ProfileParams, StepProfile


class CommandSourceParams(ProfileParams):
    """Which actuators, and their commands: all at the first time, then all at the next, and so on."""

    channels: tuple[str, ...] = param(("armature",), "names of the actuators", min_length=1)
    unit: str = param("V", "unit of the commands")
    values: tuple[float, ...] = param((6.0,), "command of every actuator from each time on")

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        self.rows("values")
        return self


class CommandSource(Block[CommandSourceParams]):
    """Publishes the command of the actuators at every tick."""

    @classmethod
    def ports(cls, params: CommandSourceParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """One output with the channels of the parameters."""
        return (), (command("command", "command", params.channels, params.unit),)

    def setup(self) -> None:
        """Prepare the answer for each time."""
        self._answers = StepProfile(self.p.times, [{"command": row} for row in self.p.rows("values")])

    def update(self, t: int, **inputs: Any) -> Mapping[str, tuple[float, ...]]:
        """Give the command at t."""
        return self._answers.at(t)


main = executable(CommandSource)
