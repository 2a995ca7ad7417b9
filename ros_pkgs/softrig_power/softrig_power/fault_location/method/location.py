"""From a record to the place of the fault: checks, choice of the mode, one of six algorithms, the verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..records.record import Record, RecordError, Status
from . import search, transient
from .ends import contradiction
from .objective import LocatorParams, Objective

# A share of the voltage. Ends that disagree by more everywhere are not those of a healthy line.
NOWHERE = 0.02
# In km. A minimum this near to an end of the line may belong to a fault beyond it.
NEAR_END = 1e-3


@dataclass(frozen=True)
class Location:
    """The answer.

    Parameters
    ----------
    x_km : float or None
        Distance from S; None if there is no position.
    f_min, f_max : float
        Smallest and largest objective on the line, V.
    mode : int
        Aerial mode used, 1 to 3.
    evaluations : int
        Of the objective.
    text : str
        Meaning of the status in this case.
    """

    status: Status
    x_km: float | None = None
    f_min: float = math.nan
    f_max: float = math.nan
    mode: int = 0
    evaluations: int = 0
    text: str = ""


class Locator(Objective):
    """One record, located by any method; see `Objective`."""

    def choose(self) -> Location:
        """Choose the mode with the largest F and return whether there is a fault, without a position yet."""
        p, highest, lowest = self.p, np.max(self.curves, axis=1), np.min(self.curves, axis=1)
        excited = (highest >= p.f_threshold) & (highest >= p.f_ratio * lowest)
        mode = int(np.argmax(highest)) + 1 if p.mode == "auto" else int(p.mode)
        choice = Location(Status.OK, None, float(lowest[mode - 1]), float(highest[mode - 1]), mode, self.evaluations)
        limit = p.disagreement if excited.any() else min(p.disagreement, NOWHERE)
        against = contradiction(self, limit) if float(np.max(highest)) >= p.f_threshold else ""
        if against:
            return replace(choice, status=Status.CONTRADICTORY, text=against)
        if excited[mode - 1] and (p.mode == "auto" or highest[mode - 1] >= float(np.max(highest)) / p.f_ratio):
            return choice
        measured = f"max F = {choice.f_max:.4g} V, min F = {choice.f_min:.4g} V in mode {mode}"
        if p.mode != "auto" and excited.any():
            best = int(np.argmax(highest)) + 1
            text = f"mode_not_excited: {measured}, but {highest[best - 1]:.4g} V in mode {best}"
            return replace(choice, status=Status.MODE_NOT_EXCITED, text=text)
        text = f"no_fault: {measured}, expected {p.f_threshold:g} V and a ratio of {p.f_ratio:g}"
        return replace(choice, status=Status.NO_FAULT, text=text)

    def locate(self) -> Location:
        """Find the fault with the algorithm of the parameters."""
        self.evaluations = 0
        result = self.choose()
        if result.status != Status.OK:
            return result
        match self.p.algorithm:
            case "brent":
                x, f = search.brent(self, result.mode)
            case "woa" | "gwo":
                x, f = search.swarm(self, result.mode)
            case "integer_grid":
                x, f = search.integer_grid(self, result.mode)
            case "phasor":
                x, f = transient.phasor(self, result.mode), result.f_min
            case "travelling_wave":
                x, f = transient.travelling_wave(self, result.mode), result.f_min
        status, text = Status.OK, f"fault at {x:.4f} km"
        if not NEAR_END < x < self.section.length - NEAR_END:
            status, text = Status.AT_TERMINAL, f"at_terminal: the minimum is at x = {x:.4f} km"
        return Location(status, x, f, result.f_max, result.mode, self.evaluations, text)


def locate(record: Record, p: LocatorParams | None = None) -> Location:
    """Locate the fault of a record; an unfit record results in its status and no position."""
    try:
        return Locator(record, p or LocatorParams()).locate()
    except RecordError as error:
        return Location(error.status, text=str(error))
