"""Topics of the motor rig."""

from __future__ import annotations

from softrig_core import command, joint_state, reference, scalars

SHAFT = ("shaft",)

STATE = joint_state("state", "motor/state", SHAFT, position="rad", velocity="rad/s", effort="N m")
SPEED = joint_state("state", "motor/state", SHAFT, velocity="rad/s")
SENSORS = scalars("sensors", "motor/sensors", {"encoder_count": "", "current_a": "A"})
TRUE_STATE = joint_state("true_state", "motor/true_state", SHAFT, position="rad", velocity="rad/s", effort="N m")
APPLIED = command("applied", "motor/applied", ("armature",), "V")
COMMAND = command("command", "motor/command", ("armature",), "V")
REFERENCE = reference("reference", "motor/reference", SHAFT, velocity="rad/s", held=True)
SURFACE = scalars("surface", "motor/surface", {"s": "rad/s^2"})
