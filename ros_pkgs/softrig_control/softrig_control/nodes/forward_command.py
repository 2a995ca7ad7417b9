"""The role of forward_command_controller (ros2_controllers) for its hardware: an array is forwarded to the
actuators.
"""

from __future__ import annotations

from typing import Any

from softrig_core import Block, BlockParams, Port, Values, array, command, param


class ForwardCommandParams(BlockParams):
    """Parameters of the command forwarder: the actuators, and the source of their commands."""

    joints: tuple[str, ...] = param(("armature",), "names of the actuators, in the order of the array", min_length=1)
    units: tuple[str, ...] = param(("V",), "unit of each, or one of all", min_length=1)
    commands: str = param("forward_command_controller/commands", "topic of the array", min_length=1)
    initial: tuple[float, ...] = param((0.0,), "command before the first array; one of all or one each", min_length=1)

    def _check(self) -> None:
        for name in ("units", "initial"):
            n = len(getattr(self, name))
            if n not in (1, len(self.joints)):
                raise ValueError(f"{n} {name} for {len(self.joints)} joints, expected 1 or {len(self.joints)}")


class ForwardCommand(Block[ForwardCommandParams]):
    """Forwards a std_msgs/Float64MultiArray to the actuators at every tick, unchanged.

    The array needs no layout. An array of another length, with NaN or beyond the limits is rejected, and the previous
    one is held.
    """

    @classmethod
    def ports(cls, params: ForwardCommandParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one value per actuator."""
        n = len(params.joints)
        units = params.units * n if len(params.units) == 1 else params.units
        commands = array("commands", params.commands, {"joint": n}, units, held=True)
        return (commands,), (command("command", "command", params.joints, units),)

    def setup(self) -> None:
        """Compute the output before the first array."""
        n = len(self.p.joints)
        self._initial = self.p.initial * n if len(self.p.initial) == 1 else self.p.initial

    def update(self, x: Any, t: int, commands: tuple[float, ...] | None = None) -> tuple[Any, Values]:
        """Return the newest array."""
        return x, {"command": self._initial if commands is None else commands}
