"""Detection of the fault inception, for records without a given window."""

from __future__ import annotations

import numpy as np

from ..records.record import GROUPS, Record, RecordError, Status
from .objective import LocatorParams

# A share of the largest value of a channel group in the first cycle, which has no fault yet.
CHANGE = 0.2
AFTER = 1e-3  # s from the inception to the window, as in the study of the paper
LASTS = 18.5e-3  # s, length of the window there


def inception(record: Record, frequency: float) -> float:
    """Time in s at which a sample first differs by a fifth of the peak from the one a cycle earlier.

    Raises
    ------
    RecordError
        No cycle before the fault, or no fault.
    """
    cycle = round(record.rate / frequency)
    if len(record.samples) <= cycle + 1:
        raise RecordError(Status.TOO_SHORT, f"too short: {len(record.samples)} samples, a cycle has {cycle}")
    first = len(record.samples)
    for name in GROUPS:
        group = record.group(name)
        jump = np.abs(group[cycle:] - group[:-cycle]).max(axis=1)
        changes = np.flatnonzero(jump > CHANGE * np.abs(group[:cycle]).max())
        if changes.size:
            first = min(first, int(changes[0]) + cycle)
    if first == len(record.samples):
        raise RecordError(Status.NO_FAULT, "no_fault: no channel changes by a fifth from one cycle to the next")
    return record.start + first / record.rate


def windowed(record: Record, p: LocatorParams) -> LocatorParams:
    """Set the window after the inception: 1 ms to 19.5 ms after it, shorter if the record ends."""
    begin = inception(record, p.frequency)
    beyond = p.line.aerial.tau + 4.0 / record.rate
    end = min(begin + AFTER + LASTS, record.start + (len(record.samples) - 1) / record.rate - beyond)
    if end <= begin + AFTER:
        raise RecordError(Status.TOO_SHORT, f"too short: the record ends {end + beyond - begin:.4g} s after the fault")
    return p.model_copy(update={"window_start": begin + AFTER, "window_end": end})
