"""Switch states of the shunt converter and the spectrum of its voltage."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

from softrig_core import Block, BlockParams, Level, Values, array, param, scalars, vector3

from . import pulses
from .ports import converter_command

SIGMA = math.radians(172.5)
OMEGA = 2.0 * math.pi * 60.0
ORDERS = (1, -23, 25, -47, 49, -71, 73, -95, 97)


class State(NamedTuple):
    """Command that acts: conduction angle (rad), angle (rad) and its speed (rad/s)."""

    command: tuple[float, ...] = (SIGMA, 0.0, OMEGA)


class PulseGeneratorParams(BlockParams):
    """Parameters of the pulse generator: its period, and the on-time of a command."""

    period: float = param(1.0 / 2880.0, "sampling period", "s", ge=1e-6, le=0.1)
    command_period: float = param(1.0 / 2880.0, "period of the commands, a multiple of `period`", "s", ge=1e-6, le=1.0)


class PulseGenerator(Block[PulseGeneratorParams]):
    """Gates of the four three-level bridges under the newest command, see `pulses`.

    ``pulses/gates``: bridge by switch (Q1 to Q4 of phase a, b, c), 1 conducts. ``pulses/voltage``: the space vector of
    the 48-step voltage for a DC voltage of 1. ``pulses/spectrum``: order (negative: turns against the fundamental) and
    amplitude in % of the fundamental, up to the 97th. ``pulses/quality``: fundamental for a DC voltage of 1, distortion
    over all harmonics and up to the 50th in %. A command may have only some of the values (sigma alone). An invalid
    conduction angle is refused, and the last one stays in force.
    """

    INPUTS = (
        converter_command(
            "command", "shunt/command", "sigma", "rad", held=True, partial=True, safe=(SIGMA, 0.0, OMEGA)
        ),
    )
    OUTPUTS = (
        array("gates", "pulses/gates", {"bridge": 4, "switch": 12}, ""),
        vector3("voltage", "pulses/voltage", "alpha_beta", "pu"),
        array("spectrum", "pulses/spectrum", {"harmonic": len(ORDERS), "quantity": 2}, ["", "%"] * len(ORDERS)),
        scalars("quality", "pulses/quality", {"fundamental": "pu", "thd": "%", "thd_50": "%"}),
    )
    STATE = State
    # the cycle over which its figures are computed, which is also how long a command is rotated
    AGREED = {"gupfc/pulses.command_period": "command_period"}

    def setup(self) -> None:
        """Ticks of a command."""
        self._ticks = max(1, round(self.p.command_period / self.p.period))

    def update(self, x: State, t: int, *, command: tuple[float, ...] | None) -> tuple[State, Values]:
        """Answer one tick."""
        if command is not None and command != x.command:
            if 0.0 < command[0] <= math.pi * (1.0 + 1e-12):
                x = State(command)
            else:
                self.report(Level.ERROR, "command", f"command {tuple(command)} refused, the last one holds")
        sigma, angle, omega = x.command
        since = round(t * 1e-9 / self.p.period) % self._ticks * self.p.period
        theta = angle + omega * since
        v = pulses.vector(theta, sigma)
        spectrum, quality = judged(sigma)
        return x, {
            "gates": tuple(pulses.gates(theta, sigma).ravel().tolist()),
            "voltage": (v.real, v.imag, 0.0),
            "spectrum": spectrum,
            "quality": quality,
        }


@lru_cache(maxsize=16)
def judged(sigma: float) -> tuple[tuple[float, ...], tuple[float, float, float]]:
    """Spectrum, and fundamental with distortion (all, up to the 50th), of a conduction angle (rad)."""
    first, result = pulses.fundamental(sigma), pulses.harmonics(sigma, max(ORDERS))
    spectrum = tuple(value for n in ORDERS for value in (float(n), 100.0 * result[n] / first))
    return spectrum, (first, pulses.distortion(sigma), pulses.distortion(sigma, 50))
