"""Topics of the drive."""

from __future__ import annotations

from softrig_core import command, joint_state, reference, scalars, vector3

SHAFT = ("shaft",)

JOINT_STATES = joint_state("joint_states", "joint_states", SHAFT, position="rad", velocity="rad/s", effort="N m")
SPEED = joint_state("joint_states", "joint_states", SHAFT, velocity="rad/s")
CURRENTS_MEAS = vector3("currents_meas", "currents_meas", "abc", "A")
DC_LINK = scalars("dc_link", "dc_link", {"voltage": "V"})
SWITCHES = command("switches", "switches", ("Sa", "Sb", "Sc"), "1")
LOAD_TORQUE = command("load_torque", "load_torque", SHAFT, "N m", held=True)
TORQUE_REF = command("torque_ref", "torque_ref", SHAFT, "N m")
SPEED_REF = reference("speed_ref", "speed_ref", SHAFT, velocity="rad/s", held=True)
FLUX_ESTIMATE = vector3("flux_estimate", "flux_estimate", "alpha_beta", "Wb")
TORQUE_ESTIMATE = command("torque_estimate", "torque_estimate", SHAFT, "N m")

# The truth, for evaluation only: no controller may subscribe these.
CURRENTS_TRUE = vector3("currents_true", "currents_true", "abc", "A")
FLUX_TRUE = vector3("flux_true", "flux_true", "alpha_beta", "Wb")
