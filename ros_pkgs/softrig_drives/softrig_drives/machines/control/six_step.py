"""Six-step commutation of brushless DC machines by Hall sensors, with current and speed control."""

from __future__ import annotations

from typing import NamedTuple

from softrig_core import Block, Level, Values, param, scalars

from ..bldc import GATES, OFF
from ..ports import CURRENTS, DC_LINK, SHAFT_MEAS, SPEED_REF
from ..sensors import HALL
from .speed_control import Speed, SpeedControl, SpeedControlParams

SIX_STEP = scalars("six_step", "six_step", {"i": "A", "i_ref": "A", "u": "V", "torque_ref": "N m"})
# upper and lower phase in each sector
STEPS = ((0, 1), (0, 2), (1, 2), (1, 0), (2, 0), (2, 1))


class SixStepParams(SpeedControlParams):
    """The machine as the controller assumes it, bandwidths and limits."""

    period: float = param(5e-5, "sampling period T_s", "s", gt=0.0, le=0.1)
    R: float = param(0.515, "resistance of a phase", "ohm", gt=0.0, live=True)
    L: float = param(2.86e-4, "inductance of a phase", "H", gt=0.0, live=True)
    k_e: float = param(0.01675, "back-EMF of a phase over speed", "V s/rad", gt=0.0, live=True)
    pole_pairs: int = param(8, "pole pairs p", ge=1, le=1000)
    J: float = param(1.35e-5, "inertia that the speed control assumes", "kg m^2", gt=0.0, le=1e6, live=True)
    current_bandwidth: float = param(3000.0, "bandwidth of the current loop", "rad/s", gt=0.0, live=True)
    i_max: float = param(4.7, "largest current", "A", gt=0.0, live=True)


class State(NamedTuple):
    """Integral part of the voltage (V), state of the speed control, the sector held while Hall states are invalid."""

    u: float = 0.0
    speed: Speed = Speed()
    sector: int = 0


class SixStepController(Block[SixStepParams]):
    """Two phases in series carry the current, chosen by the Hall states; the third is off.

    ::

        T = 2 k_e i,  i = (i_up - i_low)/2
        u = k_p (i_ref - i) + I + 2 k_e w,  k_p = alpha_c 2 L,  I' = alpha_c 2 R (i_ref - i + (u_lim - u)/k_p)

    The upper phase has the share u/U_dc, the lower 0; a negative voltage exchanges them. Three equal Hall states are
    not a sector: they are reported, and the previous sector is kept.
    """

    INPUTS = (CURRENTS, HALL, SHAFT_MEAS, DC_LINK, SPEED_REF)
    OUTPUTS = (GATES, SIX_STEP)
    STATE = State
    AGREED = {"machines/pole_pairs": "pole_pairs"}

    def setup(self) -> None:
        """Design both loops."""
        p = self.p
        self._speed = SpeedControl(p)
        self._k_p = p.current_bandwidth * 2.0 * p.L
        self._share = p.period * p.R / p.L

    def update(
        self,
        x: State,
        t: int,
        *,
        currents: tuple[float, ...],
        hall: tuple[float, ...],
        joint_states: tuple[float, ...],
        dc_link: tuple[float, ...],
        speed_ref: tuple[float, ...] | None,
    ) -> tuple[State, Values]:
        """Commutate."""
        p, omega = self.p, joint_states[1]
        sector = _sector(hall[0] > 0.5, hall[1] > 0.5, hall[2] > 0.5)
        if sector < 0:
            self.report(Level.WARN, "hall", f"Hall states {hall} are no sector; sector {x.sector} is held")
            sector = x.sector
        upper, lower = STEPS[sector]
        i = 0.5 * (currents[upper] - currents[lower])
        speed, wanted, cut = self._speed.wanted(x.speed, 0.0 if speed_ref is None else speed_ref[0], omega)
        most = 2.0 * p.k_e * p.i_max
        torque = min(max(cut, -most), most)
        speed = self._speed.closed(speed, omega, wanted, torque)
        i_ref = torque / (2.0 * p.k_e)
        proportional = self._k_p * (i_ref - i)
        u = proportional + x.u + 2.0 * p.k_e * omega
        limit = max(dc_link[0], 0.0)
        v = min(max(u, -limit), limit)
        integral = x.u + self._share * (proportional + v - u)
        level = v / limit if limit > 0.0 else 0.0
        if level < 0.0:
            upper, lower, level = lower, upper, -level
        gates = (
            level if upper == 0 else 0.0 if lower == 0 else OFF,
            level if upper == 1 else 0.0 if lower == 1 else OFF,
            level if upper == 2 else 0.0 if lower == 2 else OFF,
        )
        return State(integral, speed, sector), {"gates": gates, "six_step": (i, i_ref, v, torque)}

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Turn all legs off for this period."""
        return x, {"gates": (OFF, OFF, OFF), "six_step": (0.0,) * SIX_STEP.size}


def _sector(a: bool, b: bool, c: bool) -> int:
    """Return the number of the sector 0 to 5, -1 for states that are all alike."""
    if a == b == c:
        return -1
    if a:
        return 0 if c else 2 if b else 1
    return (4 if c else 3) if b else 5
