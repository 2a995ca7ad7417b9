"""A fault record: time-aligned samples of both line ends, and what makes it unfit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
GROUPS = ("u_s", "i_s", "u_r", "i_r")
CHANNELS = tuple(f"{group}/{phase}" for group in GROUPS for phase in "abc")
COLUMNS = ("t", *CHANNELS)
TOPICS = {"u_s": "line/s/voltage", "i_s": "line/s/current", "u_r": "line/r/voltage", "i_r": "line/r/current"}
SYNC = 0.1 + 1e-6  # samples, most that two ends may differ, or a sample from its place


class Status(IntEnum):
    """What became of a location."""

    OK = 0
    AT_TERMINAL = 1
    NO_FAULT = 2
    MODE_NOT_EXCITED = 3
    UNSYNCHRONISED = 4
    GAP = 5
    NON_FINITE = 6
    DEAD_CHANNEL = 7
    TOO_SHORT = 8


class RecordError(ValueError):
    """A record that must not be located; `status` says which kind, the text what and where."""

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
    """

    start: float
    rate: float
    samples: Array

    @property
    def t(self) -> Array:
        """Sample times, s."""
        return self.start + np.arange(len(self.samples)) / self.rate

    def group(self, name: str) -> Array:
        """Give the three phases of u_s, i_s, u_r or i_r, shape (n, 3)."""
        k = 3 * GROUPS.index(name)
        return self.samples[:, k : k + 3]

    def table(self) -> Array:
        """Give the record form, shape (n, 13): t and the 12 channels."""
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
        """Join what the recorders of both ends saw.

        Parameters
        ----------
        t_s, t_r : ndarray, shape (n,)
            Sample times of the ends, s.
        s, r : ndarray, shape (n, 6)
            Voltages and currents of the three phases.

        Raises
        ------
        RecordError
            Also when the ends have no common sample times.
        """
        for t in (t_s, t_r):
            _rate(t)
        begin, end = max(t_s[0], t_r[0]), min(t_s[-1], t_r[-1])
        room = SYNC * (t_s[1] - t_s[0])
        keep_s = (t_s >= begin - room) & (t_s <= end + room)
        keep_r = (t_r >= begin - room) & (t_r <= end + room)
        t_s, s, t_r, r = t_s[keep_s], s[keep_s], t_r[keep_r], r[keep_r]
        if len(t_s) < 2 or len(t_s) != len(t_r):
            raise RecordError(
                Status.UNSYNCHRONISED, f"unsynchronised: {len(t_s)} samples of S and {len(t_r)} of R at common times"
            )
        apart = np.abs(t_s - t_r)
        if apart.max() > room:
            offset = float(t_r[0] - t_s[0]) / float(t_s[1] - t_s[0])
            raise RecordError(
                Status.UNSYNCHRONISED, f"unsynchronised: R lies {offset - round(offset):+.3g} samples off S, "
                f"near {t_s[int(np.argmax(apart > room))]:.9g} s"
            )  # fmt: skip
        return _checked(t_s, np.hstack([s, r]))

    @classmethod
    def from_signals(cls, signals: Mapping[str, tuple[Array, Array]]) -> Record:
        """Read the four streams of a recording; `signals` gives (t, x) of ``line/s/voltage/x`` and so on."""
        found = {group: [signals[f"{topic}/{axis}"] for axis in "xyz"] for group, topic in TOPICS.items()}
        for a, b in (("u_s", "i_s"), ("u_r", "i_r")):
            if len(found[a][0][0]) != len(found[b][0][0]) or np.any(found[a][0][0] != found[b][0][0]):
                raise RecordError(
                    Status.UNSYNCHRONISED, f"unsynchronised: {TOPICS[a]} and {TOPICS[b]} differ in stamps"
                )
        ends = [np.column_stack([x for g in pair for _, x in found[g]]) for pair in (("u_s", "i_s"), ("u_r", "i_r"))]
        return cls.from_ends(found["u_s"][0][0], ends[0], found["u_r"][0][0], ends[1])


def _rate(t: Array) -> float:
    """Sampling rate of equidistant times, to 1 mHz, so that equal records give equal numbers however they came."""
    if len(t) < 2:
        raise RecordError(Status.TOO_SHORT, f"a record of {len(t)} samples")
    if not np.isfinite(t).all():
        raise RecordError(Status.NON_FINITE, f"the time of sample {int(np.argmin(np.isfinite(t)))} is not finite")
    steps = np.diff(t)
    usual = float(np.median(steps))
    if not usual > 0.0:
        raise RecordError(Status.UNSYNCHRONISED, f"unsynchronised: the stamps do not rise, step {usual:g} s")
    for k in np.flatnonzero(np.abs(steps - usual) > SYNC * usual)[:1].tolist():
        if steps[k] < usual:
            raise RecordError(Status.UNSYNCHRONISED, f"unsynchronised: stamp {t[k + 1]:.9g} s follows {t[k]:.9g} s, "
                              f"expected {usual:.6g} s between them")  # fmt: skip
        raise RecordError(Status.GAP, f"gap at {t[k] + usual:.9g} s: the next sample is at {t[k + 1]:.9g} s")
    return round((len(t) - 1) / float(t[-1] - t[0]), 3)


def _checked(t: Array, samples: Array) -> Record:
    rate = _rate(t)
    bad = np.argwhere(~np.isfinite(samples))
    if bad.size:
        k, channel = bad[0].tolist()
        raise RecordError(Status.NON_FINITE, f"{CHANNELS[channel]} is {samples[k, channel]} at {t[k]:.9g} s")
    for channel in np.flatnonzero(~samples.any(axis=0)).tolist():
        raise RecordError(Status.DEAD_CHANNEL, f"dead channel: {CHANNELS[channel]} is zero in the whole record")
    return Record(round(float(t[0]), 9), rate, np.ascontiguousarray(samples, dtype=np.float64))
