"""Fault records in COMTRADE (IEEE C37.111): reading one or two recorders into a record, and writing a record."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from os.path import isfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .record import Record, RecordError, Status

Array = NDArray[np.float64]
Format = Literal["ascii", "binary", "float32"]
PHASES = {"A": 0, "B": 1, "C": 2, "L1": 0, "L2": 1, "L3": 2, "AN": 0, "BN": 1, "CN": 2}
PREFIXES = {"": 1.0, "k": 1e3, "K": 1e3, "m": 1e-3, "M": 1e6}
EPOCH = dt.datetime(2000, 1, 1)  # of written files: t = 0
FULL_SCALE = {"ascii": 99998, "binary": 32767}  # the largest raw numbers; ASCII keeps 99999 for missing data


class ComtradeFileError(ValueError):
    """A file that cannot become a record; the text says what was expected."""


def read_comtrade(
    paths: Sequence[Path | str], channels: Sequence[str] = (), late: tuple[float, float] = (0.0, 0.0)
) -> Record:
    """Read a record of both ends from one file with all channels or from two, end S first.

    Parameters
    ----------
    paths : sequence of Path or str
        One or two ``.cfg`` (or ``.cff``) files; the ``.dat`` beside it is found.
    channels : sequence of str
        Names of the twelve analog channels u_S, i_S, u_R, i_R of the phases a, b, c (six of each of two files);
        when empty they are found by their units (V, A) and phases.
    late : (float, float)
        s by which what end S and end R tell is late, by a clock or an anti-alias filter; taken out.

    Returns
    -------
    Record
        Primary V and A; t = 0 is the first sample of the recorder that starts first.

    Raises
    ------
    ComtradeFileError
        Unreadable, or the channels are not told apart (lists those of the file), or both files are the same record.
    RecordError
        The ends have no time in common, a gap, a missing value, a dead channel.
    """
    if len(paths) not in (1, 2):
        raise ComtradeFileError(f"{len(paths)} files: expected one with both ends, or one of each end")
    if channels and len(channels) != 12:
        raise ComtradeFileError(f"{len(channels)} channels: expected twelve, u_S, i_S, u_R, i_R of the phases a, b, c")
    files = [_load(Path(path)) for path in paths]
    if len(files) == 1:
        columns = _pick(files[0], Path(paths[0]), channels, ends=2)
        t = np.asarray(files[0].time, dtype=np.float64)
        return Record.from_ends(t - late[0], columns[:, :6], t - late[1], columns[:, 6:])
    starts = [file.start_timestamp for file in files]
    zero = min(starts)
    times = [
        (start - zero).total_seconds() - delay + np.asarray(file.time, dtype=np.float64)
        for start, file, delay in zip(starts, files, late, strict=True)
    ]
    ends = [
        _pick(file, Path(path), channels[6 * k : 6 * k + 6], ends=1)
        for k, (file, path) in enumerate(zip(files, paths, strict=True))
    ]
    if ends[0].shape == ends[1].shape and np.allclose(ends[0], ends[1], rtol=1e-6, atol=0.0):
        raise ComtradeFileError(f"{paths[0]} and {paths[1]}: both are the same record, expected one of each end")
    return Record.from_ends(times[0], ends[0], times[1], ends[1])


def _load(path: Path) -> Any:
    import comtrade

    if not isfile(path):
        raise ComtradeFileError(f"{path}: no such file")
    try:
        _bounded(path)
        file = comtrade.Comtrade(ignore_warnings=True, use_numpy_arrays=True, use_double_precision=True)
        if path.suffix.lower() == ".cff":
            file.load(str(path))
        else:
            settings = _text(path.read_bytes())
            data = path.with_suffix(".DAT" if path.suffix.isupper() else ".dat").read_bytes()
            ascii_data = any(line.strip().upper() == "ASCII" for line in settings.splitlines())
            file.read(settings, _text(data) if ascii_data else data)
    except ComtradeFileError:
        raise
    except Exception as error:  # the reader raises whatever a broken line gives
        raise ComtradeFileError(f"{path}: not readable as COMTRADE: {type(error).__name__}: {error}") from error
    if file.total_samples < 2 or not len(file.time):
        raise RecordError(Status.TOO_SHORT, f"{path}: {file.total_samples} samples")
    return file


def _text(data: bytes) -> str:
    """Decode what recorders write: UTF-8, with a byte order mark or not, else the Western code page of Windows."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def _bounded(path: Path) -> None:
    """Refuse a file that tells of far more than it has: the reader makes room for all of it before it looks.

    Raises
    ------
    ComtradeFileError
        More channels than lines, or more than twice the samples that its data have bytes for.
    """
    import comtrade

    single = path.suffix.lower() == ".cff"
    text = _text(path.read_bytes())
    if single:
        text = text.partition("--- file type: CFG ---")[2].partition("--- file type:")[0]
    lines = text.strip().splitlines()
    counts = [int(field.strip(" AD\t")) for field in lines[1].upper().split(",")]
    if sum(counts) > 2 * len(lines):
        raise ComtradeFileError(f"{path}: tells of {max(counts)} channels in {len(lines)} lines")
    cfg = comtrade.Cfg(ignore_warnings=True)
    cfg.read("\n".join(lines))
    width = {"BINARY": 2, "BINARY32": 4, "FLOAT32": 4}.get(cfg.ft.upper())
    least = cfg.analog_count + cfg.status_count + 2  # ASCII: each field has a separator
    if width is not None:
        least = 8 + width * cfg.analog_count + 2 * -(-cfg.status_count // 16)
    own = [path] if single else [p for p in path.parent.iterdir() if p.stem == path.stem and p.suffix.lower() == ".dat"]
    size = max((p.stat().st_size for p in own), default=0)
    if cfg.sample_rates[-1][1] > 2 * (size // least + 1):
        raise ComtradeFileError(
            f"{path}: tells of {cfg.sample_rates[-1][1]} samples, but its data are {size} bytes, "
            f"room for {size // least} at most"
        )


def _pick(file: Any, path: Path, names: Sequence[str], ends: int) -> Array:
    """Give u a, b, c, i a, b, c of each end, in primary V and A, shape (samples, 6 ends)."""
    known = list(file.cfg.analog_channels)
    listing = ", ".join(f"{c.name} ({c.uu}, phase {c.ph})" for c in known)
    if names:
        by_name = {c.name: k for k, c in enumerate(known)}
        missing = [name for name in names if name not in by_name]
        if missing:
            raise ComtradeFileError(f"{path}: no channel {', '.join(missing)}; it has {listing}")
        order = [by_name[name] for name in names]
    else:
        found: dict[tuple[str, int], list[int]] = {}
        for k, c in enumerate(known):
            phase = PHASES.get(c.ph.strip().upper())
            unit = c.uu.strip()[-1:].upper()
            if phase is not None and unit in ("V", "A"):
                found.setdefault((unit, phase), []).append(k)
        wanted = [(unit, phase) for unit in "VA" for phase in range(3)]
        if any(len(found.get(key, ())) != ends for key in wanted):
            raise ComtradeFileError(
                f"{path}: expected {ends} voltage(s) and {ends} current(s) of each phase, told apart by unit and "
                f"phase; name the channels; it has {listing}"
            )
        order = [found[key][end] for end in range(ends) for key in wanted]
    columns = []
    for k in order:
        c = known[k]
        prefix = c.uu.strip()[:-1]
        if prefix not in PREFIXES:
            raise ComtradeFileError(f"{path}: channel {c.name} has the unit {c.uu!r}, expected V, A, kV, kA")
        scale = PREFIXES[prefix]
        if c.pors.strip().upper() == "S":
            if c.secondary == 0.0:
                raise ComtradeFileError(f"{path}: channel {c.name} is secondary with a ratio of {c.primary:g}:0")
            scale *= c.primary / c.secondary
        columns.append(scale * np.asarray(file.analog[k], dtype=np.float64))
    return np.column_stack(columns)


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
    record : Record
    end : {"both", "s", "r"}
        Which channels.
    file_format : {"ascii", "binary", "float32"}
        Resolution 1e-5 and 3e-5 of each channel's largest value, and single precision.
    frequency : float
        Hz.
    station : str
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
