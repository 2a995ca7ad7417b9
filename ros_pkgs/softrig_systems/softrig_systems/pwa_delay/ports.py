"""Topics of the plants with delay, their controllers and their certificates."""

from __future__ import annotations

from softrig_core import Port, command, joint_state, scalars

BEYOND = 1e6  # size of a state with which no loop comes back

LEVEL = scalars("level", "tank/level", {"level": ""}, limits=(BEYOND,))
INFLOW = command("inflow", "tank/inflow", ("inflow",), "kg/s")
PENDULUM = joint_state("state", "pendulum/state", ("joint",), position="rad", velocity="rad/s", limits=(BEYOND,) * 2)
SEEN = joint_state("state", "pendulum/delayed_state", ("joint",), position="rad", velocity="rad/s")
TORQUE = command("torque", "pendulum/torque", ("joint",), "N m")
VALUE = scalars("value", "lyapunov", {"V": "", "dV": "1/s"}, sporadic=True)


def mode(topic: str) -> Port:
    """Cell in force and delay, of a plant."""
    return scalars("mode", topic, {"cell": "", "delay": "s"})


def state(n: int) -> Port:
    """State x1 ... xn of a piecewise affine plant."""
    return scalars("state", "pwa/state", {f"x{k + 1}": "" for k in range(n)}, limits=(BEYOND,) * n)
