"""What an oscilloscope shows at the simulated Uno: voltage at the motor, current and speed, for both laws."""

from __future__ import annotations

import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from softrig_drives.dc_motor.uno import DcMotorUnoParams, firmware_of, simulator_of

SHOWN = 2.0, 2.05  # s
LAWS = {"sgn": "dc_motor_smc_b1", "softened, delta 5": "dc_motor_smc_b2"}


def trace(scenario: str) -> np.ndarray:
    """Return time, voltage at the motor, current and speed each 10 us, shape (n, 4)."""
    p = DcMotorUnoParams(scenario=scenario)
    with tempfile.NamedTemporaryFile(suffix=".txt") as file:
        command = [str(simulator_of(p)), str(firmware_of(p)), file.name]
        subprocess.run(command, input=struct.pack("<q", int(SHOWN[1] * 1e9)), capture_output=True, check=True)
        return np.loadtxt(file.name)


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True, sharey="row")
    for column, (law, scenario) in zip(axes.T, LAWS.items(), strict=True):
        rows = trace(scenario)
        rows = rows[rows[:, 0] >= SHOWN[0]]
        for axis, k, word, color in zip(column, (1, 2, 3), ("V", "A", "rad/s"), ("C1", "C2", "C0"), strict=True):
            axis.plot(1e3 * (rows[:, 0] - SHOWN[0]), rows[:, k], color, lw=0.7)
            axis.grid(True, lw=0.3)
            axis.set_ylabel(word if law == "sgn" else "")
        column[0].set_title(f"{law}: voltage at the motor, current, speed", fontsize=9)
        column[-1].set_xlabel(f"time after {SHOWN[0]:g} s, ms")
    figure.savefig(folder / "dc_motor_smc_uno_scope.png", dpi=100)
