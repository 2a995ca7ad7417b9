"""Topics of the drive."""

from __future__ import annotations

from softrig_core import command, joint_state, reference, scalars

PHASES = ("a", "b", "c", "d")
TRANSLATOR = ("translator",)

JOINT_STATES = joint_state(
    "joint_states", "joint_states", TRANSLATOR, position="m", velocity="m/s", effort="N"
)  # effort: the force of all phases
MOTION = joint_state("joint_states", "joint_states", TRANSLATOR, position="m", velocity="m/s")
SPEED = joint_state("joint_states", "joint_states", TRANSLATOR, velocity="m/s")
PHASE_CURRENTS = joint_state("phase_currents", "phase_currents", PHASES, position="A")
PHASE_VOLTAGE = command("phase_voltage", "phase_voltage", PHASES, "V")
FORCE_PHASES = command("force_phases", "force_phases", PHASES, "N")  # for display; no controller reads it
FORCE_CMD = command("force_cmd", "force_cmd", TRANSLATOR, "N")
REFERENCE = reference("reference", "reference", TRANSLATOR, position="m", velocity="m/s", acceleration="m/s^2")
THETA = scalars("theta", "theta", {"mass": "kg", "damping": "N s/m", "friction": "N"})
LOAD = command("load", "load", ("mass", "friction"), ("kg", "N"), held=True)
