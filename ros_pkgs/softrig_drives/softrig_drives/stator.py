"""Three-phase stators: slots for drawings, and the circuit of induction machines in another form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from softrig_core.drawing.shapes import Pen

CENTRE = (190.0, 180.0)
OUTER, INNER = 150.0, 116.0
SLOTS = 12  # two a side of each phase
PHASES = (("a", "accent"), ("b", "second"), ("c", "third"))
THIRD = 2.0 * math.pi / 3.0


def belt(slot: int) -> tuple[int, int]:
    """Return phase and sense of a slot: a current out of the page a quarter turn after its axis makes flux along it."""
    angle = 2.0 * math.pi * (slot + 0.5) / SLOTS
    turns = [math.sin(angle - k * THIRD) for k in range(3)]  # 1 a quarter turn after the axis of phase k
    phase = max(range(3), key=lambda k: abs(turns[k]))
    return phase, 1 if turns[phase] > 0 else -1


def draw_stator(pen: Pen, currents: Sequence[float], radius: float) -> None:
    """Draw iron and slots; the phase currents are relative, 1 fills a circle of this radius."""
    from softrig_core.drawing.shapes import polar  # a run that is not drawn does not need it

    pen.circle(CENTRE, OUTER, "line", "faint")
    pen.circle(CENTRE, INNER, "line", "paper")
    for slot in range(SLOTS):
        # the axis of phase a points right: its conductors lie a quarter turn before and after
        phase, side = belt(slot)
        role, current = PHASES[phase][1], side * currents[phase]
        point = polar(CENTRE, (OUTER + INNER) / 2, 2.0 * math.pi * (slot + 0.5) / SLOTS)
        pen.circle(point, 11.0, "muted", "paper", 1.0)
        pen.circle(point, radius * math.sqrt(abs(current)), role, role, 0)
        mark = "·" if current > 0 else "×" if current < 0 else ""
        pen.text((point[0], point[1] + 4.5), mark, "paper", 13.0, "middle")


def inverse_gamma(R_r: float, L_ls: float, L_lr: float, L_m: float) -> tuple[float, float, float]:
    """Turn the T equivalent circuit, in which machines are published, into the constants R_R, L_sigma, L_M.

    ::

        gamma = L_m/(L_m + L_lr),  R_R = gamma^2 R_r,  L_M = gamma L_m,  L_sigma = L_m + L_ls - L_M

    The stator resistance is the same in both.

    Parameters
    ----------
    R_r : float
        Rotor resistance referred to the stator, ohm.
    L_ls, L_lr, L_m : float
        Leakage of stator and rotor (referred to the stator) and magnetising inductance, H.

    References
    ----------
    G. R. Slemon, "Modelling of induction machines for electric drives", IEEE Transactions on Industry Applications
    25(6), 1989.
    """
    gamma = L_m / (L_m + L_lr)
    return gamma * gamma * R_r, L_m + L_ls - gamma * L_m, gamma * L_m
