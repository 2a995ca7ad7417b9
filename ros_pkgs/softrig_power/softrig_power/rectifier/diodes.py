"""The switches off: their six diodes form a bridge, which charges the link to the peak between two phases."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from softrig_core import jit

from .averaged import walk
from .circuit import Circuit, Period, grid

if TYPE_CHECKING:
    from softrig_core import Array


# The longest step in s. Half of it changes the voltage of a loaded link by less than 0.01 %.
STEP = 1e-6


@jit
def conduct(t: float, h: float, x: Array, p: tuple[Circuit, Period]) -> None:
    """Integrate one step around t: a leg conducts by its upper diode into the link (s = 1), or back by the lower one.

    A leg without current starts to conduct when its terminal is above the positive or below the negative rail of the
    link. A current that would change its sign becomes zero.
    """
    circuit, period = p
    g = grid(t, circuit, period)
    v = x[3]
    s_a, on_a = (1.0 if x[0] > 0.0 else 0.0), (1.0 if x[0] != 0.0 else 0.0)
    s_b, on_b = (1.0 if x[1] > 0.0 else 0.0), (1.0 if x[1] != 0.0 else 0.0)
    s_c, on_c = (1.0 if x[2] > 0.0 else 0.0), (1.0 if x[2] != 0.0 else 0.0)
    if on_a + on_b + on_c == 0.0 and max(g) - min(g) > v:
        high, low = max(g), min(g)
        on_a, s_a = (1.0 if g[0] == high or g[0] == low else 0.0), (1.0 if g[0] == high else 0.0)
        on_b, s_b = (1.0 if g[1] == high or g[1] == low else 0.0), (1.0 if g[1] == high else 0.0)
        on_c, s_c = (1.0 if g[2] == high or g[2] == low else 0.0), (1.0 if g[2] == high else 0.0)
    drive_a, drive_b, drive_c = (
        g[0] - circuit.R * x[0] - s_a * v,
        g[1] - circuit.R * x[1] - s_b * v,
        g[2] - circuit.R * x[2] - s_c * v,
    )
    count = on_a + on_b + on_c
    if count > 1.0:
        # The currents of the conducting legs add to zero, which gives the voltage from the negative rail to the
        # neutral.
        rail = (on_a * drive_a + on_b * drive_b + on_c * drive_c) / count
        if count == 2.0:
            if on_a == 0.0 and (g[0] - rail > v or g[0] < rail):
                on_a, s_a = 1.0, (1.0 if g[0] - rail > v else 0.0)
                drive_a = g[0] - s_a * v
            elif on_b == 0.0 and (g[1] - rail > v or g[1] < rail):
                on_b, s_b = 1.0, (1.0 if g[1] - rail > v else 0.0)
                drive_b = g[1] - s_b * v
            elif on_c == 0.0 and (g[2] - rail > v or g[2] < rail):
                on_c, s_c = 1.0, (1.0 if g[2] - rail > v else 0.0)
                drive_c = g[2] - s_c * v
            count = on_a + on_b + on_c
            rail = (on_a * drive_a + on_b * drive_b + on_c * drive_c) / count
        x[0] = carried(x[0], on_a, s_a, h * (drive_a - rail) / circuit.L)
        x[1] = carried(x[1], on_b, s_b, h * (drive_b - rail) / circuit.L)
        x[2] = carried(x[2], on_c, s_c, h * (drive_c - rail) / circuit.L)
        left = (1.0 if x[0] != 0.0 else 0.0) + (1.0 if x[1] != 0.0 else 0.0) + (1.0 if x[2] != 0.0 else 0.0)
        # A current that ends within the step leaves a rest in the others, which must add to zero again.
        if left > 0.0:
            remaining = (x[0] + x[1] + x[2]) / left
            x[0] = carried(x[0], x[0], s_a, -remaining)
            x[1] = carried(x[1], x[1], s_b, -remaining)
            x[2] = carried(x[2], x[2], s_c, -remaining)
    else:
        x[0], x[1], x[2] = 0.0, 0.0, 0.0
    x[3] = v + h * (s_a * x[0] + s_b * x[1] + s_c * x[2] - v / period.load) / circuit.C


@jit
def carried(i: float, on: float, s: float, change: float) -> float:
    """Current of a leg after a change, or 0 where its diode would carry it backwards or it is not `on`."""
    after = i + change
    if on == 0.0 or (s == 1.0 and after < 0.0) or (s == 0.0 and after > 0.0):
        return 0.0
    return after


@jit
def bridge(t: float, stop: float, x: Array, p: tuple[Circuit, Period]) -> None:
    """Steps of at most `STEP` from t to stop, x = (i_a, i_b, i_c, v)."""
    count = math.ceil((stop - t) / STEP - 1e-9)
    for k in range(count):
        conduct(t + (k + 0.5) * (stop - t) / count, (stop - t) / count, x, p)


advance = walk(bridge)
