"""Figures of the motion while it runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import repeat
from typing import Any, NamedTuple

from pydantic import field_validator
from softrig_core import Figure, Watch, WatchParams, executable, param
from softrig_core.block.answer import Heard
from softrig_core.judge import measures
from softrig_core.verdict.watch import Kept

from .figures import POSITION, REFERENCE, SPEED, dip, iae, itae, overshoot, peak_force
from .ports import FORCE_CMD, JOINT_STATES, LOAD, PHASE_CURRENTS, PHASE_VOLTAGE, REFERENCE as REFERENCE_PORT

PHASES = "abcd"


class MotionMonitorParams(WatchParams):
    """What counts as arrived, and the window of the force."""

    period: float = param(1e-3, "sampling period", "s", gt=0.0, le=0.1)
    window: float = param(10.0, "the figures are those of this last time", "s", gt=0.0, le=3600.0)
    v_d: float = param(0.5, "cruise speed that the figures refer to; in the direction of the reference", "m/s",
                       ge=-10.0, le=10.0)  # fmt: skip
    band: float = param(0.02, "half width of the band around v_d as a part of it", gt=0.0, lt=0.9)
    force_window: float = param(5e-3, "the peak force is that of a mean over this time", "s", gt=0.0, le=1.0)

    @field_validator("v_d")
    @classmethod
    def _moves(cls, v_d: float) -> float:
        if v_d == 0.0:
            raise ValueError("expected a speed, forwards or backwards")
        return v_d


class State(NamedTuple):
    """What was seen; the load and when it came (s); direction of the reference, 0 before it has moved.

    And when (s) that has turned.
    """

    seen: tuple[Kept, ...]
    load: tuple[float, ...] = (0.0, 0.0)
    loaded: float | None = None
    way: float = 0.0
    begin: float | None = None


class MotionMonitor(Watch[MotionMonitorParams]):
    """Overshoot, rise and settling time, IAE, ITAE, peak error, peak force; after a load its dip and recovery.

    At the monitor's own period; the figures of a scenario see every sample. Speeds are in the direction of the
    reference; where it turns, the figures begin anew: those of a scenario can begin at a step, but a profile has none.
    """

    INPUTS = (JOINT_STATES, PHASE_CURRENTS, PHASE_VOLTAGE, FORCE_CMD, REFERENCE_PORT, LOAD)

    def first(self) -> State:
        """No load yet."""
        return State(self.nothing)

    def update(
        self, x: State, t: int, *, load: tuple[float, ...] | None, reference: tuple[float, ...], **inputs: Any
    ) -> tuple[State, Mapping[str, Any]]:  # fmt: skip
        """Take one sample in."""
        seen = self.keep(x.seen, t, {"reference": reference, **inputs})
        return self._noted(x, t, reference, load)._replace(seen=seen), {}

    def _noted(self, x: State, t: int, reference: tuple[float, ...], load: tuple[float, ...] | None) -> State:
        seen, before, loaded, way, begin = x
        now = math.copysign(1.0, reference[1]) if reference[1] else 0.0
        if now * way < 0.0:
            begin, loaded = t / 1e9, None
        if load is not None and load != before:
            before, loaded = load, t / 1e9
        return State(seen, before, loaded, now or way, begin)

    def at_once(self, x: State, t: int, messages: Mapping[str, Heard]) -> State | None:
        """See `Observer.at_once`."""
        reference, load = messages["reference"], messages.get("load")
        seen = self.keep_at_once(x.seen, t, {name: heard for name, heard in messages.items() if name != "load"})
        if seen is None or (load is not None and load.stamps.tobytes() != reference.stamps.tobytes()):
            return None
        for (at, row), (_, loaded) in zip(reference, load or repeat((0, None)), strict=False):
            x = self._noted(x, at, row, loaded)
        return x._replace(seen=seen)

    def figures(self, x: State) -> Iterator[Figure]:
        """Figures of the window; those of the start until a load comes, then those of the load."""
        v_d = math.copysign(self.p.v_d, x.way or self.p.v_d)
        band, leg = {"final": v_d, "band": self.p.band, "at": "sample"}, {"start": x.begin}
        yield self.figure("overshoot", overshoot, {"v_d": v_d, **leg})
        yield self.figure("rise_time", measures.rise_time, {"signal": SPEED, "final": v_d, **leg})
        if x.loaded is None:
            yield self.figure(
                "settling_time", measures.settling_time, {"signal": SPEED, "start": x.begin or 0.0, **band}
            )
        else:
            yield self.figure("dip", dip, {"v_d": v_d, "start": x.loaded})
            yield self.figure("recovery", measures.settling_time, {"signal": SPEED, "start": x.loaded, **band})
        yield self.figure("iae", iae)
        yield self.figure("itae", itae)
        yield self.figure("peak_error", measures.peak, {"signal": SPEED, "reference": REFERENCE})
        yield self.figure("peak_force", peak_force, {"width": self.p.force_window, **leg})
        yield self.figure("peak_command", measures.peak, {"signal": "force_cmd/translator/effort"})
        for phase in PHASES:
            yield self.figure(f"peak_current_{phase}", measures.peak, {"signal": f"phase_currents/{phase}/position"})
            yield self.figure(f"peak_voltage_{phase}", measures.peak, {"signal": f"phase_voltage/{phase}/effort"})
        yield self.figure("position", measures.final_value, {"signal": POSITION})


main = executable(MotionMonitor)
