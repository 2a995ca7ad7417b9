"""The settings of a COMTRADE file (IEEE C37.111): the table of its fields, and reading them."""

from __future__ import annotations

import datetime as dt
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from softrig_core.errors import closest
from softrig_core.kit.file_format import FileFormat, number_of

REVISIONS = ("1991", "1999", "2001", "2013")
FORMS = ("ASCII", "BINARY", "BINARY32", "FLOAT32")
SLOWEST, FASTEST = 1e-3, 1e9  # sampling rates, Hz
# In s. With clocks that may differ by more, a fault could be placed anywhere on the line.
UNTRUSTED = 1e-4
_QUALITY = "0123456789AB"  # tmq_code: locked, then within 1 ns, 10 ns, ... 10 s

COMTRADE = FileFormat(
    "COMTRADE",
    "IEEE C37.111-1991, -1999 and -2013 (IEC 60255-24), as .cfg with .dat and as .cff",
    {
        "station_name": ("ignored", "a name; no result depends on it"),
        "rec_dev_id": ("ignored", "a name; no result depends on it"),
        "rev_year": ("used", "1991 if absent; determines the form of dates, missing marks and fields"),
        "TT": ("used", "must be the sum of ##A and ##D"),
        "##A": ("used", "number of analog channels"),
        "##D": ("used", "number of status channels, whose bits are skipped"),
        "An": ("used", "must count from 1"),
        "ch_id": ("used", "option --channels; a name that occurs twice cannot be chosen"),
        "ph": ("used", "A, B, C; L1, L2, L3; 1, 2, 3; R, S, T; U, V, W; R, Y, B; each also as A-N or AN"),
        "ccbm": ("ignored", "a name; no result depends on it"),
        "uu": ("used", "V or A with k, m or M"),
        "a": ("used", "value = a x + b"),
        "b": ("used", "value = a x + b; 0 when empty"),
        "skew": ("used", "delay of the channel's samples, us; compensated"),
        "min": ("used", "samples below it are reported"),
        "max": ("used", "samples above it are reported"),
        "primary": ("used", "ratio of the transformer, for a channel in secondary values; since 1999"),
        "secondary": ("used", "ratio of the transformer, for a channel in secondary values; since 1999"),
        "PS": ("used", "P or S; P if absent (1991)"),
        "Dn, ch_id, ph, ccbm, y": ("ignored", "status channels do not locate a fault"),
        "lf": ("used", "frequency of the network, unless --set frequency=... overrides it"),
        "nrates": ("used", "0: the times come from the data"),
        "samp": ("used", "Hz; if there are several rates, one section is used and the others are reported"),
        "endsamp": ("used", "last sample of each rate; checked against the data"),
        "start date, time": ("used", "aligns two recorders, to 1 ns"),
        "trigger date, time": ("used", "chooses the section if there are several rates"),
        "ft": ("used", "ASCII, BINARY, BINARY32 or FLOAT32"),
        "timemult": ("used", "multiplies the times of the data"),
        "time_code": ("used", "offset of the stamps from UTC; aligns recorders in two time zones"),
        "local_code": ("ignored", "only time_code converts the stamps to UTC"),
        "tmq_code": ("used", "uncertainty of the clock; two recorders are refused if it is worse than 10 us"),
        "leapsec": ("ignored", "a leap second in the record does not change its sampling"),
        "n": ("used", "number of a sample, which determines its time; a missing number is a gap"),
        "timestamp": ("used", "time of a sample if nrates or samp is 0; otherwise compared with the sampling rate"),
        "missing value": ("used", "refused in a channel that is used; each revision and form of data has its own mark"),
        "CFF: CFG": ("used", "read as a .cfg"),
        "CFF: DAT": ("used", "read as a .dat; its form must be that of ft"),
        "CFF: INF": ("ignored", "for people only"),
        "CFF: HDR": ("ignored", "for people only"),
    },
)


class SettingsError(ValueError):
    """A line of the settings cannot be used; the text names the line."""


class Analog(NamedTuple):
    """An analog channel, with the fields of its line; skew in us."""

    name: str
    phase: str
    unit: str
    a: float
    b: float
    skew: float
    low: float
    high: float
    primary: float
    secondary: float
    side: str


@dataclass(frozen=True)
class Settings:
    """The contents of a ``.cfg``.

    Parameters
    ----------
    switches : int
        Status channels.
    frequency : float
        Of the network, Hz; 0 if not given.
    rates : tuple of (float, int)
        Sampling rate, Hz, and the last sample of it; a rate of 0 when the data have the times.
    start, trigger : int or None
        Stamps as written in the file, ns since 1970; None without a date.
    tick : float
        s; unit of the times of the data.
    form : str
        One of `FORMS`.
    zone : int or None
        ns by which the stamps are ahead of UTC; None if not given.
    clock : float or None
        Clock error bound stated in the file, s; infinite if the file marks the clock as unreliable.
    ignored : tuple of str
        Fields whose contents have no effect.
    """

    revision: str
    analog: tuple[Analog, ...]
    switches: int
    frequency: float
    rates: tuple[tuple[float, int], ...]
    start: int | None
    trigger: int | None
    tick: float
    form: str
    zone: int | None
    clock: float | None
    ignored: tuple[str, ...]


def read_settings(text: str) -> Settings:
    """Read the text of a ``.cfg``.

    Raises
    ------
    SettingsError
        A field that is no number, refused or out of place; names the line.
    """
    lines = _Lines(text.replace("\x1a", "").splitlines())
    revision = _revision(lines.fields("station, recorder and revision", (2, 3)))
    analog_count, switches = _counts(lines.fields("numbers of channels", (3,)), len(lines.rows))
    old = revision == "1991"
    analog = tuple(_analog(lines, k + 1, old) for k in range(analog_count))
    for _ in range(switches):
        lines.fields("a status channel", (3, 5))
    frequency = lines.number(lines.fields("line frequency", (1,))[0] or "0", "lf")
    rates = _rates(lines)
    (start, ns_start), (trigger, ns_trigger) = (_stamp(lines, instant, old) for instant in ("start", "trigger"))
    form = lines.fields("form of the data", (1,))[0].upper()
    if form not in FORMS:
        raise lines.wrong(f"ft is {form!r}{closest(form, FORMS)}, expected one of {', '.join(FORMS)}")
    multiplier = lines.number((lines.optional(1) or ["1"])[0] or "1", "timemult") if not old else 1.0
    zone = clock = None
    ignored = ["Dn, ch_id, ph, ccbm, y"] if switches else []
    if revision == "2013":
        code, local = (*(lines.optional(2) or ["", ""]), "")[:2]
        quality, leap = (*(lines.optional(2) or ["", "0"]), "0")[:2]
        zone = _zone(lines, code)
        clock = _clock(lines, quality)
        ignored += ["local_code"] if local not in ("", code, "x", "X") else []
        ignored += ["leapsec"] if leap not in ("", "0", "3") else []
    if left := [row for row in lines.rows[lines.at :] if row.strip()]:
        raise SettingsError(f"line {lines.at + 1}: {left[0]!r} follows the last field of revision {revision}")
    tick = multiplier * (1e-9 if ns_start or ns_trigger else 1e-6)
    return Settings(
        revision, analog, switches, frequency, rates, start, trigger, tick, form, zone, clock, tuple(ignored)
    )


class _Lines:
    """Lines, one after the other, and the error in the last one."""

    def __init__(self, rows: Sequence[str]) -> None:
        self.rows = rows
        self.at = 0

    def wrong(self, text: str) -> SettingsError:
        """Return an error about the last line."""
        return SettingsError(f"line {self.at}: {text}")

    def fields(self, content: str, sizes: Sequence[int]) -> list[str]:
        """Return the fields of the next line."""
        self.at += 1
        if self.at > len(self.rows):
            raise self.wrong(f"the file ends before {content}")
        result = [field.strip() for field in self.rows[self.at - 1].split(",")]
        while len(result) > max(sizes) and not result[-1]:
            result.pop()  # some recorders end each line with a comma
        if len(result) not in sizes:
            expected = " or ".join(map(str, sizes))
            raise self.wrong(f"{len(result)} fields, expected {expected} ({content})")
        return result

    def optional(self, size: int) -> list[str]:
        """Return the fields of a line that may be missing at the end."""
        return self.fields("the end", range(1, size + 1)) if self.at < len(self.rows) else []

    def number(self, text: str, name: str) -> float:
        """Return a finite number."""
        value = number_of(text)
        if not math.isfinite(value):
            raise self.wrong(f"{name} is {text!r}, expected a number")
        return value

    def count(self, text: str, name: str) -> int:
        """Return a number that is not negative and has no decimals."""
        if not text.isdecimal():
            raise self.wrong(f"{name} is {text!r}, expected a whole number")
        return int(text)


def _revision(fields: list[str]) -> str:
    revision = fields[2] if len(fields) == 3 else ""
    if revision and revision not in REVISIONS:
        raise SettingsError(f"line 1: rev_year is {revision!r}, expected one of {', '.join(REVISIONS)}")
    return revision or "1991"


def _counts(fields: list[str], lines: int) -> tuple[int, int]:
    results = [re.fullmatch(pattern, field) for pattern, field in zip((r"(\d+)", r"(\d+)[aA]", r"(\d+)[dD]"), fields)]
    if None in results:
        raise SettingsError(f"line 2: {','.join(fields)!r}, expected TT,##A,##D")
    total, analog, switches = (int(match[1]) for match in results if match)
    if total != analog + switches:
        raise SettingsError(f"line 2: {total} channels, but {analog} analog and {switches} status channels")
    if total > lines:
        raise SettingsError(f"states {total} channels in {lines} lines")
    return analog, switches


def _analog(lines: _Lines, k: int, old: bool) -> Analog:
    fields = lines.fields("an analog channel", (10, 13) if old else (13,))
    if lines.count(fields[0], "An") != k:
        raise lines.wrong(f"An is {fields[0]}, expected {k}")
    name, phase, _, unit = fields[1:5]
    a, low, high = (lines.number(fields[i], key) for i, key in ((5, "a"), (8, "min"), (9, "max")))
    b, skew = (lines.number(fields[i] or "0", key) for i, key in ((6, "b"), (7, "skew")))
    primary, secondary, side = [*fields[10:], "1", "1", "P"][:3]
    if side.upper() not in ("P", "S"):
        raise lines.wrong(f"PS of channel {name} is {side!r}, expected P or S")
    if side.upper() == "S" and not (primary and secondary):
        raise lines.wrong(f"channel {name} has secondary values and no ratio, expected its primary and secondary")
    up, down = (lines.number(text or "1", key) for text, key in ((primary, "primary"), (secondary, "secondary")))
    return Analog(name, phase, unit, a, b, skew, low, high, up, down, side.upper())


def _rates(lines: _Lines) -> tuple[tuple[float, int], ...]:
    count = lines.count(lines.fields("number of sampling rates", (1,))[0], "nrates")
    results: list[tuple[float, int]] = []
    for _ in range(max(count, 1)):
        samp, end = lines.fields("a sampling rate and its last sample", (2,))
        rate, last = lines.number(samp, "samp"), lines.count(end, "endsamp")
        if not (rate == 0.0 or SLOWEST <= rate <= FASTEST) or (results and last <= results[-1][1]):
            raise lines.wrong(
                f"samp {samp} and endsamp {end}: expected 0 or a rate of {SLOWEST:g} to {FASTEST:g} Hz, "
                "and a rising last sample"
            )
        results.append((rate if count else 0.0, last))
    if len(results) > 1 and any(rate == 0.0 for rate, _ in results):
        raise lines.wrong("one of several sampling rates is 0")
    # parts of one rate are joined
    return tuple(pair for pair, after in zip(results, [*results[1:], (-1.0, 0)], strict=True) if pair[0] != after[0])


def _stamp(lines: _Lines, instant: str, american: bool) -> tuple[int | None, bool]:
    """Return ns since 1970, and whether the fraction is in ns; years of two digits are those since 1970."""
    date, time = lines.fields(f"date and time of the {instant}", (2,))
    clock = re.fullmatch(r"(\d{1,2}):(\d{2}):(\d{1,2})(?:\.(\d{1,12}))?", time or "00:00:00")
    day = re.fullmatch(r"(\d{1,2})/(\d{1,2})/(\d{2}|\d{4})", date or "1/1/1970")
    if day is None or clock is None:
        raise lines.wrong(f"{instant} is {date},{time}, expected dd/mm/yyyy,hh:mm:ss.ssssss")
    first, second, year = (int(number) for number in day.groups())
    fraction = clock[4] or ""
    nanoseconds = len(fraction) > 6
    if first == second == 0:
        return None, nanoseconds
    year += 0 if len(day[3]) == 4 else 1900 if year >= 70 else 2000
    month, day_of_month = (first, second) if american else (second, first)
    try:
        midnight = dt.datetime(year, month, day_of_month)
        moment = midnight + dt.timedelta(hours=int(clock[1]), minutes=int(clock[2]), seconds=int(clock[3]))
    except ValueError as error:
        raise lines.wrong(f"{instant} is {date},{time}: {error}") from None
    past = moment - dt.datetime(1970, 1, 1)
    stamp = (past.days * 86400 + past.seconds) * 10**9 + int(fraction.ljust(9, "0")[:9])
    return (stamp if date else None), nanoseconds


def _zone(lines: _Lines, code: str) -> int | None:
    """Return a difference from UTC such as -5h30 in ns."""
    if code in ("", "x", "X"):
        return None
    match = re.fullmatch(r"([+-]?)(\d{1,2})(?:[hH:](\d{1,2})?[mM]?)?", code)
    if match is None:
        raise lines.wrong(f"time_code is {code!r}, expected a difference from UTC such as 0, +1 or -5h30")
    minutes = 60 * int(match[2]) + int(match[3] or 0)
    return (-minutes if match[1] == "-" else minutes) * 60 * 10**9


def _clock(lines: _Lines, quality: str) -> float | None:
    if not quality:
        return None
    if quality.upper() == "F":
        return math.inf
    if quality.upper() not in _QUALITY:
        raise lines.wrong(f"tmq_code is {quality!r}, expected 0 to 9, A, B or F")
    rank = _QUALITY.index(quality.upper())
    return 10.0 ** (rank - 10) if rank else 0.0


def sections(data: bytes) -> Iterator[tuple[str, str, bytes]]:
    """Yield the sections of a ``.cff``: name and form in capital letters, and their bytes.

    Raises
    ------
    SettingsError
        There is no section, or binary data are shorter than stated in their head.
    """
    head = re.compile(
        rb"^[ \t]*---\s*file\s+type\s*:\s*([a-z]+)(?:[ \t]+([a-z0-9]+))?(?:\s*:\s*(\d+))?\s*---[ \t]*(?:\r\n|\n|\r|\Z)",
        re.I | re.M,
    )
    match = head.search(data)
    if match is None:
        raise SettingsError("no line '--- file type: CFG ---'")
    while match is not None:
        name, form = match[1].decode().upper(), (match[2] or b"").decode().upper()
        begin = match.end()
        if name == "DAT" and form != "ASCII":  # bytes of the data may look like anything, so these are not searched
            size = int(match[3] or len(data) - begin)
            if begin + size > len(data):
                raise SettingsError(f"the head of the data states {size} bytes, but there are {len(data) - begin}")
            following = head.search(data, begin + size)
            yield name, form, data[begin : begin + size]
        else:
            following = head.search(data, begin)
            yield name, form, data[begin : following.start() if following else len(data)]
        match = following
