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
    """Give the space vector of a two-level inverter's voltage as a fraction of U_dc.

    ::

        u_alpha = (2 S_a - S_b - S_c)/3        u_beta = (S_b - S_c)/sqrt(3)
    """
    S_a, S_b, S_c = switches
    return complex((2.0 * S_a - S_b - S_c) / 3.0, (S_b - S_c) / SQRT3)


def sector(psi: complex) -> int:
    """Give the sector 1 to 6 of a flux: sector n is the 60 degrees around 60 (n - 1), lower bound inside."""
    alpha, beta = psi.real, SQRT3 * psi.imag
    if alpha > 0.0:
        return 6 if beta < -alpha else 1 if beta < alpha else 2
    if beta > -alpha:
        return 3
    if beta > alpha:
        return 4
    return 5 if alpha < 0.0 else 6


class FluxComparator:
    """Two-level hysteresis: 1 above +band, 0 below -band, else as before; starts at 1."""

    def __init__(self, band: float) -> None:
        self.band = band
        self.level = 1

    def __call__(self, error: float) -> int:
        """Give 1 to increase the flux, 0 to decrease it."""
        if error > self.band:
            self.level = 1
        elif error < -self.band:
            self.level = 0
        return self.level


class TorqueComparator:
    """Three-level hysteresis: +-1 beyond +-band, back to 0 when the error has changed its sign; starts at 0."""

    def __init__(self, band: float) -> None:
        self.band = band
        self.level = 0

    def __call__(self, error: float) -> int:
        """Give 1 for more torque, -1 for less, 0 for no change."""
        if error > self.band:
            self.level = 1
        elif error < -self.band:
            self.level = -1
        elif self.level * error <= 0.0:
            self.level = 0
        return self.level
