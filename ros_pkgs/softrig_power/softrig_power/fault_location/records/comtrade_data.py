"""The samples of a COMTRADE file (IEEE C37.111): each form of data, missing marks, times."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from softrig_core import Array
from softrig_core.kit.file_format import number_of

from .comtrade_cfg import Settings

_KINDS = {"BINARY": "<i2", "BINARY32": "<i4", "FLOAT32": "<f4"}
_NO_STAMP = 0xFFFFFFFF


class DataError(ValueError):
    """Samples cannot be used; the text names them."""


@dataclass(frozen=True)
class Samples:
    """The contents of a ``.dat``.

    Parameters
    ----------
    n : ndarray, shape (rows,)
        Sample numbers.
    stamps : ndarray, shape (rows,)
        Times in units of the file, NaN where missing.
    raw : ndarray, shape (rows, channels)
        Analog values as stored, NaN where missing.
    notes : tuple of str
        Differences from the settings.
    """

    n: Array
    stamps: Array
    raw: Array
    notes: tuple[str, ...]


def read_samples(settings: Settings, data: bytes) -> Samples:
    """Read samples and check them against the settings.

    Raises
    ------
    DataError
        The settings declare far more samples than there are bytes for, or a row has the wrong number of fields.
    """
    last = settings.rates[-1][1]
    words = -(-settings.switches // 16)
    count = len(settings.analog)
    if settings.form == "ASCII":
        least = count + settings.switches + 2  # each field has a separator
    else:
        least = 8 + np.dtype(_KINDS[settings.form]).itemsize * count + 2 * words
    if last > 2 * (len(data) // least + 1):
        raise DataError(
            f"states {last} samples, but its data are {len(data)} bytes, room for {len(data) // least} at most"
        )
    n, stamps, raw = _ascii(settings, data) if settings.form == "ASCII" else _binary(settings, data, words)
    notes = []
    if settings.form != "ASCII" and len(data) % least:
        notes.append(f"{len(data) % least} bytes after the last whole sample are not used")
    if len(n) < last:
        notes.append(f"the data end after {len(n)} of {last} samples")
    if len(n) > last:
        notes.append(f"only the {last} samples that the settings state are used, of {len(n)}")
    return Samples(n[:last], stamps[:last], raw[:last], tuple(notes))


def _ascii(settings: Settings, data: bytes) -> tuple[Array, Array, Array]:
    analog, size = len(settings.analog), 2 + len(settings.analog) + settings.switches
    rows: list[list[float]] = []
    for k, line in enumerate(data.decode("latin-1").lstrip("\xef\xbb\xbf").replace("\x1a", "").splitlines(), 1):
        if not line.strip():
            continue
        fields = line.split(",")
        while len(fields) > size and not fields[-1].strip():
            # Some recorders end each line with a comma.
            fields.pop()
        if len(fields) != size:
            raise DataError(f"line {k} of the data has {len(fields)} fields, expected {size}")
        results = [number_of(field) for field in fields[: 2 + analog]]
        for field, value in zip(fields, results, strict=False):
            if value != value and field.strip().lower() not in ("", "nan"):
                raise DataError(f"line {k} of the data: {field.strip()!r} is not a number")
        rows.append(results)
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 2 + analog)
    raw = table[:, 2:]
    # In the revision of 1991 only an empty field stands for missing data, and 99999 is a value.
    if settings.revision != "1991":
        raw[raw == 99999.0] = np.nan
    return table[:, 0], table[:, 1], raw


def _binary(settings: Settings, data: bytes, words: int) -> tuple[Array, Array, Array]:
    layout = [("n", "<u4"), ("t", "<u4"), ("x", _KINDS[settings.form], (len(settings.analog),)), ("s", "<u2", (words,))]
    table = np.frombuffer(data, dtype=layout, count=len(data) // np.dtype(layout).itemsize)
    # Bytes in another order may form a signalling NaN, which is found later and needs no warning here.
    with np.errstate(invalid="ignore"):
        raw = table["x"].astype(np.float64)
    if settings.form == "FLOAT32":
        raw[(table["x"] == np.finfo(np.float32).min) | ~np.isfinite(raw)] = np.nan
    elif settings.form == "BINARY32":
        raw[table["x"] == -(2**31)] = np.nan
    elif settings.revision == "1991":
        # Values are unsigned where the range requires it. All bits set mean missing data in both cases.
        unsigned = np.array([channel.low >= 0.0 and channel.high > 32767.0 for channel in settings.analog])
        raw = np.where(unsigned & (raw < 0.0), raw + 65536.0, raw)
        raw[table["x"] == -1] = np.nan
    else:
        raw[table["x"] == -(2**15)] = np.nan
    stamps = table["t"].astype(np.float64)
    stamps[table["t"] == _NO_STAMP] = np.nan
    return table["n"].astype(np.float64), stamps, raw


def times(settings: Settings, samples: Samples) -> tuple[Array, list[str]]:
    """Return the time of each sample, s after the first one, and contradictions.

    A sample is identified by its number, so a missing sample is a gap. If there is a sampling rate, times follow from
    it, as the standard requires, and the stamps of the data are compared with these times.

    Raises
    ------
    DataError
        There is neither a rate nor a stamp, or a sample number is not an integer.
    """
    n, stamps = samples.n, (samples.stamps - samples.stamps[:1]) * settings.tick
    if not np.isfinite(n).all() or (n != np.round(n)).any():
        raise DataError("a sample without a whole number")
    if settings.rates[0][0] == 0.0:
        if not np.isfinite(stamps).all():
            raise DataError(f"no sampling rate, and sample {int(n[np.argmin(np.isfinite(stamps))])} has no time")
        return stamps, []
    t = np.zeros(len(n))
    begin, elapsed = n[0] if len(n) else 1.0, 0.0
    for rate, last in settings.rates:
        covered = (n > begin) & (n <= last) if elapsed else n <= last
        t[covered] = elapsed + (n[covered] - begin) / rate
        elapsed, begin = elapsed + (last - begin) / rate, float(last)
    beyond = n > settings.rates[-1][1]
    t[beyond] = elapsed + (n[beyond] - begin) / settings.rates[-1][0]
    apart = np.abs(stamps - t)
    known = np.isfinite(apart)
    if known.any() and (stamps[known] != 0.0).any():
        worst = float(apart[known].max())
        if worst > 0.5 / settings.rates[-1][0] + 2.0 * settings.tick:
            return t, [
                f"stamps of the data are up to {worst:.3g} s off the sampling rate, which decides (of {len(n)} samples)"
            ]
    return t, []


def stretch(settings: Settings, n: Array, t: Array) -> tuple[slice, list[str]]:
    """Choose the samples of one rate: those with the trigger, or the fastest ones.

    Returns
    -------
    (slice, list of str)
        Rows, and a note on those that are not used.
    """
    if len(settings.rates) == 1:
        return slice(0, len(n)), []
    edges = [0, *(int(np.searchsorted(n, last, side="right")) for _, last in settings.rates)]
    runs = [slice(a, b) for a, b in pairwise(edges)]
    chosen = max(range(len(runs)), key=lambda k: (settings.rates[k][0], runs[k].stop - runs[k].start))
    if settings.start is not None and settings.trigger is not None and settings.trigger > settings.start:
        trigger = (settings.trigger - settings.start) * 1e-9
        chosen = next((k for k, run in enumerate(runs) if run.stop > run.start and t[run.stop - 1] >= trigger), chosen)
    run = runs[chosen]
    if run.stop - run.start < 2:
        raise DataError(f"fewer than two samples at {settings.rates[chosen][0]:g} Hz")
    others = ", ".join(f"{rate:g} Hz" for k, (rate, _) in enumerate(settings.rates) if k != chosen)
    note = (
        f"of the rates only {settings.rates[chosen][0]:g} Hz is used, from {t[run.start]:.6g} to "
        f"{t[run.stop - 1]:.6g} s, not the samples at {others}"
    )
    return run, [note]
