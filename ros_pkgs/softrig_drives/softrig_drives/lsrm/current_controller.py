"""Commutation and the four current loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from softrig_core import Array, Block, BlockParams, Values, jit, param

from .machine import N_PHASES, Geometry, distance, profile
from .ports import FORCE_CMD, MOTION, PHASE_CURRENTS, PHASE_VOLTAGE

Vector = tuple[float, ...]


class CurrentControllerParams(Geometry, BlockParams):
    """Gains, limits and the position sensor."""

    period: float = param(5e-5, "sampling period", "s", gt=0.0, le=0.01)
    K_pc: float = param(
        0.05, "proportional gain; the error in A gives a duty cycle", "1/A", ge=0.0, le=100.0, live=True
    )
    K_ic: float = param(2.2, "integral gain", "1/(A s)", ge=0.0, le=1e5, live=True)
    U_dc: float = param(150.0, "supply voltage, at duty cycle 1", "V", gt=0.0, le=1e4, live=True)
    I_max: float = param(10.0, "rated current, the largest reference", "A", gt=0.0, le=1e3, live=True)
    threshold: float = param(0.02, "a phase is on where its slope is beyond this part of G", ge=0.0, lt=1.0, live=True)
    zero_current: float = param(
        0.02, "current below which a phase that is off gets 0 V", "A", gt=0.0, le=10.0, live=True
    )
    resolution: float = param(1e-5, "step of the position sensor (magnetic strip)", "m", gt=0.0, le=1e-3)
    feed_forward: bool = param(False, "add R i* + g v i* to the voltage, which removes the force ripple", live=True)
    R: float = param(2.5, "phase resistance that the feed-forward assumes", "ohm", gt=0.0, le=1e3, live=True)


class State(NamedTuple):
    """Integrals z of the current errors of the phases, A s."""

    integral: Vector = (0.0,) * N_PHASES


class CurrentController(Block[CurrentControllerParams]):
    """Share the force among the phases whose slope has its sign, and control their currents.

    ::

        on_k   = sgn(F*) g_k(x) > threshold G
        i*_k   = min(sqrt(2 |F*|/G), I_max) if on_k else 0        force g_k i*^2/2, the shares g_k/G add up to 1
        duty_k = K_pc (i*_k - i_k) + K_ic z_k, within -1 and 1,  u_k = U_dc duty_k
        z_k   += (i*_k - i_k) Ts                                  unless the duty is clipped and the error drives it on
        off:     z_k = 0, u_k = -U_dc while i_k > zero_current, else 0

    x is the position rounded to the sensor's step. After a rejected measurement or command the voltage is 0 V for one
    period: the phases freewheel.

    When K_ic changes, the integrals are rescaled so that K_ic z stays the same and no voltage jumps. With K_ic = 0
    there is no such z, so the integrals are reset. Other parameters act from the next period on.
    """

    INPUTS = (MOTION, PHASE_CURRENTS, FORCE_CMD)
    OUTPUTS = (PHASE_VOLTAGE,)
    STATE = State

    def setup(self) -> None:
        """Arrange the constants for the compiled law."""
        p = self.p
        self._geometry = p.numbers()
        self._law = np.array([p.K_pc, p.K_ic, p.U_dc, p.I_max, p.threshold, p.zero_current, p.resolution, p.period,
                              float(p.feed_forward), p.R])  # fmt: skip

    def go_on(self, x: State, before: CurrentControllerParams) -> State:
        """Continue with other gains; the output of the integrals stays."""
        if self.p.K_ic == before.K_ic:
            return x
        share = before.K_ic / self.p.K_ic if self.p.K_ic else 0.0
        return State(tuple(z * share for z in x.integral))

    def update(
        self,
        x: State,
        t: int,
        *,
        joint_states: tuple[float, ...],
        phase_currents: tuple[float, ...],
        force_cmd: tuple[float, ...],
    ) -> tuple[State, Values]:
        """Return the voltages."""
        result = regulate(x.integral, joint_states, phase_currents, force_cmd[0], self._geometry, self._law)
        return State(result[:N_PHASES]), {"phase_voltage": result[N_PHASES:]}


@jit
def regulate(
    integral: Vector, motion: Vector, currents: Vector, force: float, geometry: Array, law: Array
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return the four integrals and the four voltages (V).

    Parameters
    ----------
    integral : tuple (4,)
        A s.
    motion : tuple (2,)
        Position (m) and speed (m/s).
    currents : tuple (4,)
        A.
    force : float
        N.
    geometry, law : array
        As `CurrentController.setup` lays them out.
    """
    x, v = motion
    i_ref = min(math.sqrt(2.0 * abs(force) / geometry[2]), law[3])
    quantised = math.floor(x / law[6] + 0.5) * law[6]
    z_a, u_a = phase_law(integral[0], currents[0], i_ref, force, v, distance(quantised, 0, geometry), geometry, law)
    z_b, u_b = phase_law(integral[1], currents[1], i_ref, force, v, distance(quantised, 1, geometry), geometry, law)
    z_c, u_c = phase_law(integral[2], currents[2], i_ref, force, v, distance(quantised, 2, geometry), geometry, law)
    z_d, u_d = phase_law(integral[3], currents[3], i_ref, force, v, distance(quantised, 3, geometry), geometry, law)
    return z_a, z_b, z_c, z_d, u_a, u_b, u_c, u_d


@jit
def phase_law(
    z: float, i: float, i_ref: float, force: float, v: float, xi: float, geometry: Array, law: Array
) -> tuple[float, float]:
    """Return the integral (A s) and the voltage (V) of a phase at `xi` (m) from its aligned position."""
    K_pc, K_ic, U_dc, _, threshold, zero_current, _, period, feed_forward, R = law
    towards = xi <= 0.0 if force > 0.0 else xi > 0.0  # for the other phases the slope has the opposite sign
    G, g = geometry[2], profile(xi, geometry)[1] if towards else 0.0
    if not ((force > 0.0 and g > threshold * G) or (force < 0.0 and -g > threshold * G)):
        return 0.0, -U_dc if i > zero_current else 0.0
    error = i_ref - i
    ahead = feed_forward * (R * i_ref + g * v * i_ref) / U_dc
    wanted = K_pc * error + K_ic * z + ahead
    duty = min(max(wanted, -1.0), 1.0)
    if wanted == duty or wanted * error <= 0.0:
        z += error * period
    return z, U_dc * duty
