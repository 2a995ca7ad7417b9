"""The two-level inverter: parameters, and the states of its legs within a period."""

from __future__ import annotations

from typing import Literal

from softrig_core import BlockParams, jit, param

SQRT3 = 3.0**0.5
OFF, RISING, ON, FALLING, DONE = 0, 1, 2, 3, 4  # stages of a leg in a period of the carrier
NEVER = 1e300


class InverterParams(BlockParams):
    """Inverter, its DC link and the supply of that."""

    period: float = param(1e-4, "sampling period T_s of the control", "s", gt=0.0, le=0.1)
    inverter: Literal["averaged", "switched"] = param(
        "averaged", "mean voltages over each period, or the edges of each leg by comparison with the carrier"
    )
    updates: int = param(1, "periods in one period of the triangular carrier: 1, or 2 (both of its peaks)", ge=1, le=2)
    delay: int = param(1, "periods between a measurement and the duty ratios that follow from it: 0 or 1", ge=0, le=1)
    U_dc: float = param(540.0, "DC voltage of the source", "V", gt=0.0, le=1e5, live=True)
    R_dc: float = param(0.1, "resistance of the source; acts with C_dc > 0", "ohm", gt=0.0, le=1e6)
    C_dc: float = param(0.0, "capacitance of the DC link; 0: the voltage is that of the source", "F", ge=0.0, le=100.0)
    one_way: bool = param(False, "the source is a rectifier and accepts no reverse current; acts with C_dc > 0")
    dead_time: float = param(0.0, "dead time T_d of each leg", "s", ge=0.0, le=1e-3, live=True)
    v_switch: float = param(0.0, "voltage across a switch that conducts", "V", ge=0.0, le=100.0, live=True)
    v_diode: float = param(0.0, "voltage across a diode that conducts", "V", ge=0.0, le=100.0, live=True)
    r_on: float = param(0.0, "resistance of switch and diode", "ohm", ge=0.0, le=100.0, live=True)
    trip_current: float = param(
        100.0, "phase current at which the inverter trips: zero voltage from then on", "A", gt=0.0, le=1e6, live=True
    )
    trip_voltage: float = param(1000.0, "DC voltage at which it trips", "V", gt=0.0, le=1e6, live=True)

    def _check(self) -> None:
        if self.dead_time >= 0.5 * self.period:
            raise ValueError(f"dead_time = {self.dead_time:g} s: expected less than half the period {self.period:g} s")
        if self.trip_voltage <= self.U_dc:
            raise ValueError(f"trip_voltage = {self.trip_voltage:g} V: expected more than U_dc = {self.U_dc:g} V")


@jit
def begin(duty: float, updates: int, rising: bool, period: float) -> tuple[int, float]:
    """Return the stage of a leg at the begin of a period, and the time (s) of its next edge.

    The carrier begins at its upper peak: all legs are off there, a leg with 0 < duty < 1 is on in the middle of the
    carrier's period. With two updates in one period of the carrier it rises in one, falls in the next.
    """
    if duty <= 0.0:
        return DONE, NEVER
    if duty >= 1.0:
        return ON, NEVER
    if updates == 1:
        return OFF, 0.5 * (1.0 - duty) * period
    return (OFF, (1.0 - duty) * period) if rising else (ON, duty * period)


@jit
def edge(
    stage: int, time: float, current: float, duty: float, updates: int, period: float, dead_time: float
) -> tuple[int, float]:
    """Return the stage of a leg after its edge at `time`, and the time (s) of the next one.

    On a switching command a leg first turns off the conducting switch. The other switch turns on `dead_time` later;
    until then the current flows through a diode. With a positive current the leg stays low in this time, so the rising
    edge is late and the falling edge is not. With a negative current it is the other way round.
    """
    if stage == OFF and current > 0.0 and dead_time > 0.0:
        return RISING, time + dead_time
    if stage in (OFF, RISING):
        return ON, 0.5 * (1.0 + duty) * period if updates == 1 else NEVER
    if stage == ON and current < 0.0 and dead_time > 0.0:
        return FALLING, time + dead_time
    return DONE, NEVER


@jit
def drop(current: float, on: float, v_switch: float, v_diode: float) -> float:
    """Return the voltage (V) that a leg lacks, its upper switch on for the share `on` of the time."""
    if current > 0.0:
        return on * v_switch + (1.0 - on) * v_diode
    return -(on * v_diode + (1.0 - on) * v_switch) if current < 0.0 else 0.0


@jit
def lost(current: float, duty: float, share: float) -> float:
    """Return the share of the DC voltage that dead time takes from a leg on average, T_d f_c sign(i)."""
    if duty <= 0.0 or duty >= 1.0 or current == 0.0:
        return 0.0
    return share if current > 0.0 else -share
