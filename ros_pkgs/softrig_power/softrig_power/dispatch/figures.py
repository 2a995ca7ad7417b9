"""Figure functions of a dispatch."""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core import SignalMap, figure
from softrig_core.judge.measures import final_value


@figure("MW", ("dispatch/setpoints/*",), {"units": "dispatch/units"})
def set_point(signals: SignalMap, *, units: Sequence[str], place: int = 1, end: float | None = None) -> float:
    """Newest set point (MW) of a unit by its place in the table, whatever its name.

    Parameters
    ----------
    units : sequence of str
        Names of the units in their order.
    place : int
        1 for the first.
    end : float, optional
        s.

    Raises
    ------
    ValueError
        The table is shorter.
    """
    if not 1 <= place <= len(units):
        raise ValueError(f"place = {place}: the table has {len(units)} units")
    return final_value(signals, f"dispatch/setpoints/{units[place - 1]}/effort", end=end)
