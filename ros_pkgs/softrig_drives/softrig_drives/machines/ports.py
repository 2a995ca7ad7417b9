"""Topics of the drives with three-phase machines."""

from __future__ import annotations

from softrig_core import command, joint_state, reference, scalars, vector3

SHAFT = ("shaft",)
LEGS = ("a", "b", "c")

JOINT_STATES = joint_state("joint_states", "joint_states", SHAFT, position="rad", velocity="rad/s", effort="N m")
LOAD_SHAFT = joint_state("load_shaft", "load_shaft", ("load",), position="rad", velocity="rad/s", effort="N m")
SHAFT_MEAS = joint_state("joint_states", "joint_states", SHAFT, position="rad", velocity="rad/s")
CURRENTS = vector3("currents", "currents", "abc", "A")
DC_LINK = scalars("dc_link", "dc_link", {"voltage": "V"})
DUTY = command("duty", "duty", LEGS, "1")
APPLIED = command("applied", "applied_duty", LEGS, "1")
LOAD_TORQUE = command("load_torque", "load_torque", SHAFT, "N m", held=True)
SPEED_REF = reference("speed_ref", "speed_ref", SHAFT, velocity="rad/s", held=True)
TORQUE_REF = command("torque_ref", "torque_ref", SHAFT, "N m", held=True)
