"""Voltage vectors of a two-level inverter, sectors of the flux, hysteresis comparators and switching tables."""

from __future__ import annotations

from math import sqrt
from typing import Literal

SQRT3 = sqrt(3.0)

# V0 to V7 as (S_a, S_b, S_c); V1 to V6 point at 0, 60, ... 300 degrees.
VECTORS = (
    (0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (1.0, 1.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 1.0, 1.0),
    (0.0, 0.0, 1.0),
    (1.0, 0.0, 1.0),
    (1.0, 1.0, 1.0),
)

TableName = Literal["printed", "minimal_switching"]

_INCREASE_UP, _INCREASE_DOWN = (2, 3, 4, 5, 6, 1), (6, 1, 2, 3, 4, 5)
_DECREASE_UP, _DECREASE_DOWN = (3, 4, 5, 6, 1, 2), (5, 6, 1, 2, 3, 4)
_V0_FIRST, _V7_FIRST = (0, 7, 0, 7, 0, 7), (7, 0, 7, 0, 7, 0)

# TABLES[name][flux][torque][sector - 1] is the number of the vector; flux 1 = increase, 0 = decrease, torque 1 = up,
# 0 = no change, -1 = down (the last place). As printed in the paper's Table I, every change to a zero vector toggles
# two legs; Takahashi and Noguchi (1986) have V0 and V7 the other way round, which toggles one.
TABLES: dict[TableName, tuple[tuple[tuple[int, ...], ...], ...]] = {
    "printed": ((_V7_FIRST, _DECREASE_UP, _DECREASE_DOWN), (_V0_FIRST, _INCREASE_UP, _INCREASE_DOWN)),
    "minimal_switching": ((_V0_FIRST, _DECREASE_UP, _DECREASE_DOWN), (_V7_FIRST, _INCREASE_UP, _INCREASE_DOWN)),
}


def voltage(switches: tuple[float, float, float]) -> complex:
    """Return the space vector of a two-level inverter's voltage as a fraction of U_dc.

    ::

        u_alpha = (2 S_a - S_b - S_c)/3        u_beta = (S_b - S_c)/sqrt(3)
    """
    S_a, S_b, S_c = switches
    return complex((2.0 * S_a - S_b - S_c) / 3.0, (S_b - S_c) / SQRT3)


def sector(psi: complex) -> int:
    """Return the sector 1 to 6 of a flux: sector n is the 60 degrees around 60 (n - 1), lower bound inside."""
    alpha, beta = psi.real, SQRT3 * psi.imag
    if alpha > 0.0:
        return 6 if beta < -alpha else 1 if beta < alpha else 2
    if beta > -alpha:
        return 3
    if beta > alpha:
        return 4
    return 5 if alpha < 0.0 else 6


def flux_level(level: int, error: float, band: float) -> int:
    """Two-level hysteresis: 1 to increase the flux above +band, 0 to decrease it below -band, otherwise unchanged."""
    return 1 if error > band else 0 if error < -band else level


def torque_level(level: int, error: float, band: float) -> int:
    """Three-level hysteresis: 1 and -1 beyond +-band, for more and less torque; 0 once the error has changed its sign.

    Otherwise the previous level.
    """
    return 1 if error > band else -1 if error < -band else 0 if level * error <= 0.0 else level
