"""A fault record: time-aligned samples of both line ends, and the reasons why one is unfit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array

from .resample import reach, resampled

GROUPS = ("u_s", "i_s", "u_r", "i_r")
CHANNELS = tuple(f"{group}/{phase}" for group in GROUPS for phase in "abc")
COLUMNS = ("t", *CHANNELS)
TOPICS = {"u_s": "line/s/voltage", "i_s": "line/s/current", "u_r": "line/r/voltage", "i_r": "line/r/current"}
# In samples: how far a sample may be from its place. The last term is for the rounding of times.
SYNC = 0.1 + 1e-6
# In samples. Ends that are nearer to each other are not resampled; at 20 kHz this is an error of 7 m.
EXACT = 1e-3


class Status(IntEnum):
    """Outcome of a fault location."""

    OK = 0
    AT_TERMINAL = 1
    NO_FAULT = 2
    MODE_NOT_EXCITED = 3
    UNSYNCHRONISED = 4
    GAP = 5
    NON_FINITE = 6
    DEAD_CHANNEL = 7
    TOO_SHORT = 8
    CONTRADICTORY = 9


class RecordError(ValueError):
    """A record is unfit for fault location; `status` is the kind of defect, the text describes it and its place."""

    def __init__(self, status: Status, text: str) -> None:
        super().__init__(text)
        self.status = status


@dataclass(frozen=True)
class Record:
    """Samples of both ends at the same times.

    Parameters
    ----------
    start : float
        Time of the first sample, s.
    rate : float
        Samples a second.
    samples : ndarray, shape (n, 12)
        Columns `CHANNELS`: u_S, i_S, u_R, i_R of the phases a, b, c in V and A, currents into the line.
    note : str
        Description of how the data of the ends were combined.
    sync : float
        Largest difference of the ends' clocks as stated by the recorders, s; 0 if not stated.
    frequency : float
        Of the network as stated by the recorders, Hz; 0 if not stated.
    """

    start: float
    rate: float
    samples: Array
    note: str = ""
    sync: float = 0.0
    frequency: float = 0.0

    @property
    def t(self) -> Array:
        """Sample times, s."""
        return self.start + np.arange(len(self.samples)) / self.rate

    def group(self, name: str) -> Array:
        """Return the three phases of u_s, i_s, u_r or i_r, shape (n, 3)."""
        k = 3 * GROUPS.index(name)
        return self.samples[:, k : k + 3]

    def table(self) -> Array:
        """Return the record form, shape (n, 13): t and the 12 channels."""
        return np.column_stack([self.t, self.samples])

    @classmethod
    def from_table(cls, table: Array) -> Record:
        """Read the record form and check it.

        Raises
        ------
        RecordError
            Too few samples, a gap, a value that is not finite, a dead channel.
        """
        table = np.asarray(table, dtype=np.float64)
        if table.ndim != 2 or table.shape[1] != len(COLUMNS):
            raise RecordError(Status.TOO_SHORT, f"a record of shape {table.shape}: expected (samples, {len(COLUMNS)})")
        return _checked(table[:, 0], table[:, 1:])

    @classmethod
    def from_ends(cls, t_s: Array, s: Array, t_r: Array, r: Array) -> Record:
        """Join the recordings of both ends.

        Parameters
        ----------
        t_s, t_r : ndarray, shape (n,)
            Sample times of the ends, s.
        s, r : ndarray, shape (n, 6)
            Voltages and currents of the three phases.

        Returns
        -------
        Record
            At the sample times of the end with the lower rate, or of S if both rates are equal. If the other end has no
            samples at these times it is resampled, which the note states.

        Raises
        ------
        RecordError
            The ends have no time in common, or another defect was found.
        """
        rate_s, rate_r = (_rate(t, f"end {name}: ") for name, t in (("S", t_s), ("R", t_r)))
        begin, end = max(t_s[0], t_r[0]), min(t_s[-1], t_r[-1])
        room = SYNC / min(rate_s, rate_r)
        keep_s = (t_s >= begin - room) & (t_s <= end + room)
        keep_r = (t_r >= begin - room) & (t_r <= end + room)
        if min(np.count_nonzero(keep_s), np.count_nonzero(keep_r)) < 2:
            raise RecordError(
                Status.UNSYNCHRONISED,
                f"unsynchronised: S lasts from {t_s[0]:.9g} to {t_s[-1]:.9g} s and R from "
                f"{t_r[0]:.9g} to {t_r[-1]:.9g} s",
            )
        if np.count_nonzero(keep_s) == np.count_nonzero(keep_r):
            apart = (t_r[keep_r] - t_s[keep_s]) * rate_s
            if abs(apart.mean()) <= EXACT and np.abs(apart).max() <= SYNC:
                return _checked(t_s[keep_s], np.hstack([s[keep_s], r[keep_r]]))
        if rate_s <= rate_r:
            t, keep, moved = _aligned("R", t_r, r, rate_r, t_s, rate_s)
            return _checked(t, np.hstack([s[keep], moved]), _off("R", t_r, rate_r, t, rate_s))
        t, keep, moved = _aligned("S", t_s, s, rate_s, t_r, rate_r)
        return _checked(t, np.hstack([moved, r[keep]]), _off("S", t_s, rate_s, t, rate_r))

    @classmethod
    def from_signals(cls, signals: Mapping[str, tuple[Array, Array]], late: tuple[float, float] = (0.0, 0.0)) -> Record:
        """Read the four streams of a recording.

        Parameters
        ----------
        signals : mapping
            Returns (t, x) of ``line/s/voltage/x`` and so on.
        late : (float, float)
            Delay of the data of end S and end R, s; it is removed.

        Raises
        ------
        RecordError
            One topic of an end lacks a message (the text names the topic), or another defect was found.
        """
        results = {group: [signals[f"{topic}/{axis}"] for axis in "xyz"] for group, topic in TOPICS.items()}
        times = {group: axes[0][0] for group, axes in results.items()}
        for u, i in (("u_s", "i_s"), ("u_r", "i_r")):
            for complete, short in ((u, i), (i, u)):
                lost = np.setdiff1d(times[complete], times[short])
                if lost.size:
                    raise RecordError(
                        Status.GAP,
                        f"gap: {TOPICS[short]} has no message at {lost[0]:.9g} s, {TOPICS[complete]} has"
                        + (f" ({lost.size} such times)" if lost.size > 1 else ""),
                    )
        ends = [np.column_stack([x for g in pair for _, x in results[g]]) for pair in (("u_s", "i_s"), ("u_r", "i_r"))]
        return cls.from_ends(times["u_s"] - late[0], ends[0], times["u_r"] - late[1], ends[1])


def _aligned(
    end: str, t_x: Array, x: Array, rate: float, t: Array, to_rate: float
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Return one end at the times of the other, those times, and which they are."""
    margin = reach(rate, to_rate)
    keep = (t >= t_x[0] + margin) & (t <= t_x[-1] - margin)
    if np.count_nonzero(keep) < 2:
        raise RecordError(
            Status.TOO_SHORT,
            f"too short: {len(t_x)} samples of {end} cannot be resampled to "
            f"{to_rate:g} Hz, {margin:.3g} s are needed on both sides",
        )
    start = float(t_x.mean()) - 0.5 * (len(t_x) - 1) / rate
    return t[keep], keep, resampled(x, start, rate, t[keep], to_rate)


def _off(end: str, t_x: Array, rate: float, t: Array, to_rate: float) -> str:
    if abs(rate - to_rate) * (t[-1] - t[0]) > EXACT:
        return f"{end} resampled from {rate:g} to {to_rate:g} Hz"
    offset = float(t_x[0] - t[0]) * rate
    return f"{end} resampled, its samples lie {offset - round(offset):+.3g} of a sample off those of the other end"


def _rate(t: Array, context: str = "") -> float:
    """Sampling rate of equidistant times, to 1 mHz, so that equal records produce equal numbers from any source."""
    if len(t) < 2:
        raise RecordError(Status.TOO_SHORT, f"{context}a record of {len(t)} samples")
    if not np.isfinite(t).all():
        raise RecordError(
            Status.NON_FINITE, f"{context}the time of sample {int(np.argmin(np.isfinite(t)))} is not finite"
        )
    steps = np.diff(t)
    usual = float(np.median(steps))
    if not usual > 0.0:
        raise RecordError(Status.UNSYNCHRONISED, f"{context}unsynchronised: the stamps do not rise, step {usual:g} s")
    for k in np.flatnonzero(np.abs(steps - usual) > SYNC * usual)[:1].tolist():
        if steps[k] < usual:
            raise RecordError(
                Status.UNSYNCHRONISED,
                f"{context}unsynchronised: stamp {t[k + 1]:.9g} s follows {t[k]:.9g} s, "
                f"expected {usual:.6g} s between them",
            )
        raise RecordError(Status.GAP, f"{context}gap at {t[k] + usual:.9g} s: the next sample is at {t[k + 1]:.9g} s")
    return round((len(t) - 1) / float(t[-1] - t[0]), 3)


def _checked(t: Array, samples: Array, note: str = "") -> Record:
    rate = _rate(t)
    bad = np.argwhere(~np.isfinite(samples))
    if bad.size:
        k, channel = bad[0].tolist()
        raise RecordError(Status.NON_FINITE, f"{CHANNELS[channel]} is {samples[k, channel]} at {t[k]:.9g} s")
    for channel in np.flatnonzero(~samples.any(axis=0)).tolist():
        raise RecordError(Status.DEAD_CHANNEL, f"dead channel: {CHANNELS[channel]} is zero in the whole record")
    return Record(round(float(t[0]), 9), rate, np.ascontiguousarray(samples, dtype=np.float64), note)
