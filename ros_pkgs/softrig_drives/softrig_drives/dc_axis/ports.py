"""Signals that the nodes of the axis exchange."""

from softrig_core import button, command, joint_state, reference, scalars

AXIS = ("axis",)

STATE = joint_state("state", "axis/state", AXIS, position="mm", velocity="mm/s")
TRUE_STATE = joint_state("true_state", "axis/true_state", AXIS, position="mm", velocity="mm/s")
FEEDBACK = joint_state("feedback", "axis/feedback", AXIS, position="mm", velocity="mm/s", delayed=True)
REFERENCE = reference("reference", "axis/reference", AXIS, position="mm", held=True)
COMMAND = command("command", "axis/command", ("armature",), "V")
MODEL = scalars(
    "model",
    "axis/model",
    {"position_set": "mm", "velocity": "mm/s", "acceleration": "mm/s^2", "deceleration": "mm/s^2", "jerk": "mm/s^3"},
)
CONTROLLER_STATE = scalars(
    "controller_state",
    "axis/controller_state",
    {"set_point": "mm", "position": "mm", "velocity": "mm/s", "integral": "mm s", "age": "s"},
)
FORWARD = button("forward", "forward", held=True)
REVERSE = button("reverse", "reverse", held=True)
