"""Fault records in COMTRADE (IEEE C37.111): reading one or two recorders into a record, and writing a record."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os.path import isfile
from pathlib import Path
from typing import Literal

import numpy as np
from softrig_core import Array
from softrig_core.kit.file_format import text_of

from .comtrade_cfg import COMTRADE, UNTRUSTED, Analog, Settings, SettingsError, read_settings, sections
from .comtrade_data import DataError, read_samples, stretch, times
from .record import Record, RecordError, Status
from .resample import reach, resampled

Format = Literal["ascii", "binary", "float32"]
# Text that may stand in front of or behind the letter of a phase: L1, A-N, AN.
_PHASE = re.compile(r"^L(?=[123])|-?N$")
_SYSTEMS = ("ABC", "123", "RST", "UVW", "RYB")
PREFIXES = {"": 1.0, "k": 1e3, "K": 1e3, "m": 1e-3, "M": 1e6}
EPOCH = dt.datetime(2000, 1, 1)  # t = 0 of written files
FULL_SCALE = {"ascii": 99998, "binary": 32767}  # the largest raw numbers; ASCII keeps 99999 for missing data


class ComtradeFileError(ValueError):
    """A file cannot be converted to a record; the text states what was expected."""


@dataclass(frozen=True)
class Recorder:
    """One file: its settings, its samples in the file's units, and remarks on it."""

    path: Path
    settings: Settings
    t: Array
    raw: Array
    notes: tuple[str, ...]


def read_comtrade(
    paths: Sequence[Path | str], channels: Sequence[str] = (), late: tuple[float, float] = (0.0, 0.0)
) -> Record:
    """Read a record of both ends from one file with all channels or from two, end S first.

    Parameters
    ----------
    paths : sequence of Path or str
        One or two ``.cfg`` (or ``.cff``) files; the ``.dat`` beside it is found, in whatever case its name is.
    channels : sequence of str
        Names of the twelve analog channels u_S, i_S, u_R, i_R of the phases a, b, c (six of each of two files);
        when empty they are found by their units (V, A) and phases.
    late : (float, float)
        Delay of the data of end S and end R, s, from a clock or an anti-alias filter; it is removed.

    Returns
    -------
    Record
        Primary V and A; t = 0 is the first sample of the recorder that starts first.

    Raises
    ------
    ComtradeFileError
        A file is unreadable, the channels cannot be identified (the message lists them), or both ends are the same
        record.
    RecordError
        The ends have no time in common, or there is a gap, a missing value, a dead channel, or a clock with too large
        an error.
    """
    if len(paths) not in (1, 2):
        raise ComtradeFileError(f"{len(paths)} files: expected one with both ends, or one of each end")
    if channels and len(channels) != 12:
        raise ComtradeFileError(f"{len(channels)} channels: expected twelve, u_S, i_S, u_R, i_R of the phases a, b, c")
    files = [_load(Path(path)) for path in paths]
    notes: list[str] = []
    if len(files) == 1:
        order = _pick(files[0], channels, 2)
        ends = [_end(files[0], order[:6]), _end(files[0], order[6:])]
        starts, sync = [0.0, 0.0], 0.0
    else:
        ends = [_end(f, _pick(f, channels[6 * k : 6 * k + 6], 1)) for k, f in enumerate(files)]
        starts, notes, sync = _aligned(files)
    if ends[0][1].shape == ends[1][1].shape and np.allclose(ends[0][1], ends[1][1], rtol=1e-6, atol=0.0):
        both = f"{paths[0]} and {paths[1]}: both are" if len(paths) == 2 else f"{paths[0]}: both ends are"
        raise ComtradeFileError(f"{both} the same record, expected one of each end")
    times = [start - delay + t for start, delay, (t, _) in zip(starts, late, ends, strict=True)]
    record = Record.from_ends(times[0], ends[0][1], times[1], ends[1][1])
    notes += [note for file in files for note in file.notes]
    frequencies = {file.settings.frequency for file in files}
    if len(frequencies) > 1:
        raise ComtradeFileError(f"{paths[0]} and {paths[1]}: line frequencies {sorted(frequencies)} Hz, expected one")
    return replace(
        record, note="; ".join([*filter(None, [record.note]), *notes]), sync=sync, frequency=frequencies.pop()
    )


def _load(path: Path) -> Recorder:
    if not isfile(path):
        raise ComtradeFileError(f"{path}: no such file")
    try:
        settings, data = _cff(path.read_bytes()) if path.suffix.lower() == ".cff" else _pair(path)
        samples = read_samples(settings, data)
        if len(samples.n) < 2:
            raise RecordError(Status.TOO_SHORT, f"{path}: {len(samples.n)} samples")
        t, apart = times(settings, samples)
        rows, unused = stretch(settings, samples.n, t)
    except (SettingsError, DataError) as error:
        raise ComtradeFileError(f"{path}: not readable as COMTRADE: {error}") from None
    notes = [f"{path.name}: {note}" for note in (*samples.notes, *apart, *unused)]
    notes += [f"{path.name}: {note}" for note in _outside(settings.analog, samples.raw)]
    notes += COMTRADE.check(settings.ignored, path.name)
    return Recorder(path, settings, t[rows], samples.raw[rows], tuple(notes))


def _outside(channels: Sequence[Analog], raw: Array) -> list[str]:
    """Describe the channels with samples outside of the range in their line of the settings, if it has a range."""
    notes = []
    for k, c in enumerate(channels):
        count = int(np.count_nonzero((raw[:, k] < c.low) | (raw[:, k] > c.high)))
        if count and c.low < c.high:
            notes.append(f"channel {c.name} has {count} samples outside of its min {c.low:g} and max {c.high:g}")
    return notes


def _pair(path: Path) -> tuple[Settings, bytes]:
    """Read a ``.cfg`` and the ``.dat`` beside it."""
    beside = [p for p in path.parent.iterdir() if p.suffix.lower() == ".dat" and p.stem.lower() == path.stem.lower()]
    alike = [p for p in beside if p.stem == path.stem]
    exact = [p for p in alike if p.suffix == (".DAT" if path.suffix.isupper() else ".dat")]
    result = exact or alike or beside
    if len(result) != 1:
        names = ", ".join(p.name for p in result)
        raise SettingsError(f"several data files beside it: {names}" if result else "no .dat file beside it")
    return read_settings(text_of(path.read_bytes())), result[0].read_bytes()


def _cff(data: bytes) -> tuple[Settings, bytes]:
    """Read the sections of a ``.cff``."""
    results = {name: (form, content) for name, form, content in sections(data)}
    for name in ("CFG", "DAT"):
        if name not in results:
            raise SettingsError(f"no section {name}")
    settings = read_settings(text_of(results["CFG"][1]).strip("\r\n"))
    form, samples = results["DAT"]
    if form and form != settings.form:
        raise SettingsError(f"the section DAT is {form}, but ft is {settings.form}")
    return settings, samples


def _aligned(files: Sequence[Recorder]) -> tuple[list[float], list[str], float]:
    """Return when each of two recorders starts, s after the first, notes, and how far their clocks may be apart, s."""
    stamps: list[int] = []
    zones = [file.settings.zone for file in files]
    for file, zone in zip(files, zones, strict=True):
        if file.settings.start is None:
            raise ComtradeFileError(f"{file.path}: no date of the first sample, so two recorders cannot be aligned")
        stamps.append(file.settings.start - (zone or 0 if None not in zones else 0))
    notes = []
    if None in zones and any(zones):
        notes.append("only one recorder has a time_code; their stamps are taken to be of one zone")
    clocks = [file.settings.clock or 0.0 for file in files]
    for file, clock in zip(files, clocks, strict=True):
        if clock >= UNTRUSTED:
            how = "is not reliable" if clock == float("inf") else f"is within {clock:g} s only"
            raise RecordError(
                Status.UNSYNCHRONISED, f"unsynchronised: the clock of {file.path} {how} (tmq_code), expected 10 us"
            )
    first = min(stamps)
    return [(stamp - first) * 1e-9 for stamp in stamps], notes, max(clocks)


def _phases(known: Sequence[Analog]) -> list[int | None]:
    """Return the phase of each channel, 0 to 2; None if it has none, or if letters of two systems are mixed."""
    marks = [_PHASE.sub("", c.phase.upper().replace(" ", "")) for c in known]
    complete = [system for system in _SYSTEMS if set(system) <= set(marks)]
    result: list[int | None] = []
    for mark in marks:
        fits = [system for system in complete if mark in system] or [system for system in _SYSTEMS if mark in system]
        phases = {system.index(mark) for system in fits} if mark else set()
        result.append(phases.pop() if len(phases) == 1 else None)
    return result


def _pick(file: Recorder, names: Sequence[str], ends: int) -> list[int]:
    """Return the indices of the channels u a, b, c, i a, b, c of each end."""
    known = file.settings.analog
    listing = ", ".join(f"{c.name} ({c.unit}, phase {c.phase})" for c in known)
    if names:
        by_name: dict[str, list[int]] = {}
        for k, c in enumerate(known):
            by_name.setdefault(c.name, []).append(k)
        missing = [name for name in names if name not in by_name]
        if missing:
            raise ComtradeFileError(f"{file.path}: no channel {', '.join(missing)}; it has {listing}")
        for name in names:
            if list(names).count(name) > 1 or len(by_name[name]) > 1:
                raise ComtradeFileError(f"{file.path}: channel {name} occurs twice; expected different ones")
        return [by_name[name][0] for name in names]
    results: dict[tuple[str, int], list[int]] = {}
    for k, (c, phase) in enumerate(zip(known, _phases(known), strict=True)):
        unit = c.unit[-1:].upper()
        if phase is not None and unit in ("V", "A"):
            results.setdefault((unit, phase), []).append(k)
    wanted = [(unit, phase) for unit in "VA" for phase in range(3)]
    if any(len(results.get(key, ())) != ends for key in wanted):
        raise ComtradeFileError(
            f"{file.path}: expected {ends} voltage(s) and {ends} current(s) of each phase, distinct by unit and "
            f"phase; name the channels; it has {listing}"
        )
    return [results[key][end] for end in range(ends) for key in wanted]


def _end(file: Recorder, order: Sequence[int]) -> tuple[Array, Array]:
    """Return times (s) and primary V and A of six channels, all shifted to the times of the first of them."""
    columns = np.column_stack([_scaled(file, k) for k in order])
    skews = [1e-6 * file.settings.analog[k].skew for k in order]
    t = file.t + skews[0]
    if len(set(skews)) == 1:
        return t, columns
    rate = (len(t) - 1) / float(t[-1] - t[0])
    margin = reach(rate, rate) + max(skews) - min(skews)
    keep = (t >= t[0] + margin) & (t <= t[-1] - margin)
    if np.count_nonzero(keep) < 2:
        raise RecordError(Status.TOO_SHORT, f"{file.path}: too short to remove the skew, {margin:.3g} s on each side")
    moved = []
    alone = np.ascontiguousarray(columns.T)[:, :, None]  # contiguous, because code is compiled for one layout only
    for k, skew in enumerate(skews):
        begin = float(file.t[0]) + skew
        aligned = skew == skews[0]
        moved.append(columns[keep, k] if aligned else resampled(alone[k], begin, rate, t[keep], rate)[:, 0])
    return t[keep], np.column_stack(moved)


def _scaled(file: Recorder, k: int) -> Array:
    """Return a channel in primary V or A, NaN where it is missing."""
    c = file.settings.analog[k]
    prefix = c.unit[:-1]
    if prefix not in PREFIXES or c.unit[-1:].upper() not in ("V", "A"):
        raise ComtradeFileError(f"{file.path}: channel {c.name} has the unit {c.unit!r}, expected V, A, kV, kA")
    scale = PREFIXES[prefix]
    if c.side == "S":
        if c.secondary == 0.0:
            raise ComtradeFileError(f"{file.path}: channel {c.name} is secondary with a ratio of {c.primary:g}:0")
        scale *= c.primary / c.secondary
    return np.asarray(scale * (c.a * file.raw[:, k] + c.b), dtype=np.float64)


def write_comtrade(
    path: Path | str,
    record: Record,
    end: Literal["both", "s", "r"] = "both",
    *,
    file_format: Format = "float32",
    frequency: float = 50.0,
    station: str = "softrig",
    clock_late: float = 0.0,
) -> list[Path]:
    """Write a record as COMTRADE 2013, ``.cfg`` and ``.dat``.

    Parameters
    ----------
    path : Path or str
        Without suffix, or with ``.cfg``.
    end : {"both", "s", "r"}
        Which channels.
    file_format : {"ascii", "binary", "float32"}
        Resolution 1e-5 and 3e-5 of each channel's largest value, and single precision.
    frequency : float
        Hz.
    clock_late : float
        s added to the written start time.

    Returns
    -------
    list of Path
        The two files.
    """
    base = Path(path).with_suffix("")
    chosen = {"both": "sr", "s": "s", "r": "r"}[end]
    groups = [(f"{q}_{e}", q, e) for e in chosen for q in "ui"]
    data = np.hstack([record.group(name) for name, _, _ in groups])
    labels = [
        (f"{'V' if q == 'u' else 'I'}{p}_{e.upper()}", p, e.upper(), "V" if q == "u" else "A")
        for _, q, e in groups
        for p in "ABC"
    ]
    peak = np.maximum(np.abs(data).max(axis=0), 1e-30)
    steps = np.ones(data.shape[1]) if file_format == "float32" else peak / FULL_SCALE[file_format]
    n = len(data)
    cfg = [f"{station},softrig,2013", f"{data.shape[1]},{data.shape[1]}A,0D"]
    largest = 3.4e38 if file_format == "float32" else FULL_SCALE[file_format]
    for k, (name, phase, component, unit) in enumerate(labels):
        cfg.append(f"{k + 1},{name},{phase},{component},{unit},{float(steps[k])!r},0,0,{-largest:g},{largest:g},1,1,P")
    start = EPOCH + dt.timedelta(seconds=record.start + clock_late)
    stamp = start.strftime("%d/%m/%Y,%H:%M:%S.%f")
    cfg += [f"{frequency:g}", "1", f"{record.rate!r},{n}", stamp, stamp, file_format.upper(), "1.0", "0,0", "4,0"]
    files = [base.with_suffix(".cfg"), base.with_suffix(".dat")]
    files[0].write_bytes(("\r\n".join(cfg) + "\r\n").encode("ascii"))
    us = np.round(np.arange(n) / record.rate * 1e6).astype(np.int64)
    raw = data / steps if file_format == "float32" else np.round(data / steps)
    if file_format == "ascii":
        rows = [",".join(map(str, [k + 1, us[k], *raw[k].astype(int)])) for k in range(n)]
        files[1].write_bytes(("\r\n".join(rows) + "\r\n").encode("ascii"))
    else:
        kind = "<f4" if file_format == "float32" else "<i2"
        table = np.empty(n, dtype=[("n", "<u4"), ("t", "<u4"), ("x", kind, (data.shape[1],))])
        table["n"], table["t"], table["x"] = np.arange(1, n + 1), us, raw
        files[1].write_bytes(table.tobytes())
    return files
