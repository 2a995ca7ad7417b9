"""Each part of the fault locator against independent code: loops over the formulas, scipy, artificial records, tables
of limits.
"""

from __future__ import annotations

import itertools
import math
import types
import warnings

import numpy as np
import pytest
from helpers import interpreted
from scipy.optimize import minimize_scalar
from scipy.signal import butter, sosfilt
from softrig_bags.write import write_bag
from softrig_core import Level, ParameterError, Recording, RunError, ScenarioError, load_scenario, simulate
from softrig_core.block.params import build
from softrig_core.kit.file_format import text_of
from softrig_core.kit.jit import Jit
from softrig_power.fault_location import figures, locate_tool, pictures, study, study_tool
from softrig_power.fault_location.cases import Case
from softrig_power.fault_location.line import measurement, simulation
from softrig_power.fault_location.line.line_file import line_data
from softrig_power.fault_location.line.network import LEAST_RESISTANCE, network, steady
from softrig_power.fault_location.line.parameters import RATES, RigParams, grounded, phases
from softrig_power.fault_location.line.simulation import FaultedLine, advance
from softrig_power.fault_location.locator import FaultLocator
from softrig_power.fault_location.marker import LocationMarker
from softrig_power.fault_location.method import confidence as trust, ends, equations, location, transient
from softrig_power.fault_location.method.confidence import Confidence, ErrorBudget
from softrig_power.fault_location.method.inception import inception, windowed
from softrig_power.fault_location.method.location import Location, Locator
from softrig_power.fault_location.method.objective import LocatorParams, Objective, check_travel
from softrig_power.fault_location.method.search import brent, integer_grid
from softrig_power.fault_location.plant import LinePlant, LinePlantParams
from softrig_power.fault_location.ports import record_port
from softrig_power.fault_location.records import resample
from softrig_power.fault_location.records.comtrade_file import ComtradeFileError, read_comtrade, write_comtrade
from softrig_power.fault_location.records.record import CHANNELS, Record, RecordError, Status
from softrig_power.fault_location.records.rows import Rows
from softrig_power.lines import bergeron
from softrig_power.lines.modal import CLARKE
from softrig_power.lines.section import Section

CHANCE = np.random.default_rng(3).uniform(1.0, 2.0, (60, 12))


def table(t, samples=None):
    """The record form of times."""
    return np.column_stack([t, CHANCE[: len(t)] if samples is None else samples])


# Records ------------------------------------------------------------------------------------------------


def changed(at, value, t=None, channel=0):
    """A record with one sample a second in which one time or value is changed."""
    result = table(np.arange(20.0) if t is None else t)
    result[at, channel] = value
    return result


@pytest.mark.parametrize(
    ("rows", "status", "text"),
    [
        (np.ones(13), Status.TOO_SHORT, "a record of shape (13,): expected (samples, 13)"),
        (np.ones((5, 12)), Status.TOO_SHORT, "a record of shape (5, 12): expected (samples, 13)"),
        (table([1.0]), Status.TOO_SHORT, "a record of 1 samples"),
        (changed(3, np.nan), Status.NON_FINITE, "the time of sample 3 is not finite"),
        (table(np.zeros(9)), Status.UNSYNCHRONISED, "unsynchronised: the stamps do not rise, step 0 s"),
        (table(-np.arange(9.0)), Status.UNSYNCHRONISED, "unsynchronised: the stamps do not rise, step -1 s"),
        (changed(5, 5.1001), Status.GAP, "gap at 5 s: the next sample is at 5.1001 s"),
        (
            changed(5, 4.8999),
            Status.UNSYNCHRONISED,
            "unsynchronised: stamp 4.8999 s follows 4 s, expected 1 s between them",
        ),
        (changed(7, np.nan, channel=2), Status.NON_FINITE, "u_s/b is nan at 7 s"),
        (changed(19, -np.inf, channel=12), Status.NON_FINITE, "i_r/c is -inf at 19 s"),
        (changed(slice(None), 0.0, channel=4), Status.DEAD_CHANNEL, "dead channel: i_s/a is zero in the whole record"),
    ],
)
def test_an_unfit_record_is_refused_with_the_expected_message(rows, status, text):
    with pytest.raises(RecordError) as refused:
        Record.from_table(rows)
    assert (refused.value.status, str(refused.value)) == (status, text)


def test_fit_records_are_accepted():
    jitter = Record.from_table(changed(5, 5.1))
    assert (jitter.start, jitter.rate, jitter.note) == (0.0, 1.0, "")
    assert jitter.t.tolist() == list(range(20))
    once = changed(slice(1, None), 0.0, channel=4)  # a channel counts as alive if one of its values differs
    assert Record.from_table(once).group("i_s")[0, 0] == CHANCE[0, 3]
    result = Record.from_table(table(np.array([0.123456789123, 0.3734567891, 0.6234567891])))
    assert (result.start, result.rate) == (0.123456789, 4.0)  # rounded to a ns and to a mHz
    assert Record.from_table(table(np.arange(3) / 3.0)).rate == 3.0
    assert Record.from_table(table(np.arange(50) * 0.3)).rate == 3.333
    for k, name in enumerate(("u_s", "i_s", "u_r", "i_r")):
        assert (result.group(name) == CHANCE[:3, 3 * k : 3 * k + 3]).all()
    assert result.table()[:, 1:].tolist() == CHANCE[:3].tolist()
    assert CHANNELS[:4] + CHANNELS[-1:] == ("u_s/a", "u_s/b", "u_s/c", "i_s/a", "i_r/c")


def both(t_s, t_r):
    """Ends that see different slow sines."""
    s, r = (
        np.array([[math.sin(0.2 * x + k) + 3.0 for k in range(e, e + 6)] for x in t]) for e, t in ((0, t_s), (6, t_r))
    )
    return Record.from_ends(np.array(t_s), s, np.array(t_r), r)


def check_seen(record, within):
    """Check that the record contains what both ends see at its times."""
    wanted = np.sin(0.2 * record.t[:, None] + np.arange(12)) + 3.0
    np.testing.assert_allclose(record.samples, wanted, atol=within)


OFF = "R resampled, its samples lie {} of a sample off those of the other end"


@pytest.mark.parametrize(
    ("t_s", "t_r", "first", "samples", "note"),
    [
        (np.arange(60.0), np.arange(60.0), 0.0, 60, ""),
        (np.arange(60.0), np.arange(7.0, 90.0), 7.0, 53, ""),
        (np.arange(5.0, 60.0), np.arange(50.0), 5.0, 45, ""),
        (np.arange(60.0), np.arange(60.0) + 0.9e-3, 0.0, 60, ""),
        (np.arange(60.0), np.arange(60.0) - 0.9e-3, 0.0, 60, ""),
        (np.arange(60.0), np.arange(60.0) + 1.1e-3, 11.0, 39, OFF.format("+0.0011")),
        (np.arange(60.0), np.arange(60.0) - 0.4, 10.0, 39, OFF.format("-0.4")),
        (np.arange(60.0), np.arange(0.0, 60.5, 0.5), 10.0, 41, "R resampled from 2 to 1 Hz"),
        (np.arange(23.0), np.arange(23.0) + 0.3, 11.0, 2, OFF.format("+0.3")),
        (np.arange(0.0, 60.0, 0.5), np.arange(60.0), 10.0, 40, "S resampled from 2 to 1 Hz"),
        (np.arange(0.0, 60.0, 0.5), np.arange(20.0, 90.0), 20.0, 30, "S resampled from 2 to 1 Hz"),
    ],
)
def test_ends_are_joined_at_the_times_of_the_slower_one(t_s, t_r, first, samples, note):
    record = both(t_s, t_r)
    assert (record.start, len(record.samples), record.rate, record.note) == (first, samples, 1.0, note)
    check_seen(record, 2e-3)


@pytest.mark.parametrize(
    ("t_s", "t_r", "status", "text"),
    [
        (
            np.arange(9.0),
            np.arange(20.0, 25.0),
            Status.UNSYNCHRONISED,
            "unsynchronised: S lasts from 0 to 8 s and R from 20 to 24 s",
        ),
        (
            np.arange(9.0),
            np.arange(8.0, 25.0),
            Status.UNSYNCHRONISED,
            "unsynchronised: S lasts from 0 to 8 s and R from 8 to 24 s",
        ),
        (np.arange(1.0), np.arange(9.0), Status.TOO_SHORT, "end S: a record of 1 samples"),
        (np.arange(9.0), [0.0, 1.0, np.nan], Status.NON_FINITE, "end R: the time of sample 2 is not finite"),
        (np.arange(9.0), [0.0, 1.0, 3.0, 4.0, 5.0], Status.GAP, "end R: gap at 2 s: the next sample is at 3 s"),
        (
            np.arange(21.0),
            np.arange(21.0) + 0.3,
            Status.TOO_SHORT,
            "too short: 21 samples of R cannot be resampled to 1 Hz, 10 s are needed on both sides",
        ),
    ],
)
def test_ends_that_cannot_be_joined_are_refused(t_s, t_r, status, text):
    with pytest.raises(RecordError) as refused:
        both(t_s, t_r)
    assert (refused.value.status, str(refused.value)) == (status, text)


def test_two_samples_in_common_are_a_record():
    assert len(both(np.arange(9.0), np.arange(7.0, 25.0)).samples) == 2
    jittered = np.arange(20.0)
    jittered[7] += 0.09
    jittered[9] -= 0.09
    assert both(np.arange(20.0), jittered).note == ""


def streams(**lost):
    """The four topics of a recording, with some messages missing."""
    result = {}
    for k, (name, topic) in enumerate(
        (("u_s", "s/voltage"), ("i_s", "s/current"), ("u_r", "r/voltage"), ("i_r", "r/current"))
    ):
        keep = [n for n in range(30) if n not in lost.get(name, ())]
        for phase, axis in enumerate("xyz"):
            result[f"line/{topic}/{axis}"] = (np.array(keep) / 10.0, CHANCE[keep, 3 * k + phase])
    return result


def test_streams_of_a_recording_by_their_times():
    record = Record.from_signals(streams())
    assert (record.start, record.rate, record.samples.tolist()) == (0.0, 10.0, CHANCE[:30].tolist())
    late = Record.from_signals(streams(), (0.2, 0.5))  # the record of R starts three samples after that of S
    assert late.start == -0.2
    assert late.samples.tolist() == np.hstack([CHANCE[:27, :6], CHANCE[3:30, 6:]]).tolist()
    for lost, text in [
        ({"i_s": (4,)}, "gap: line/s/current has no message at 0.4 s, line/s/voltage has"),
        ({"u_s": (4, 9)}, "gap: line/s/voltage has no message at 0.4 s, line/s/current has (2 such times)"),
        ({"u_r": (7,)}, "gap: line/r/voltage has no message at 0.7 s, line/r/current has"),
        ({"i_r": (0,)}, "gap: line/r/current has no message at 0 s, line/r/voltage has"),
    ]:
        with pytest.raises(RecordError) as refused:
            Record.from_signals(streams(**lost))
        assert (refused.value.status, str(refused.value)) == (Status.GAP, text)


def test_rows_are_the_newest_ones_for_each_branch():
    """Against lists: values do not change, however they branch."""
    for most in (1, 2, 3):
        known = [(Rows(most, 1), [])]
        chance = np.random.default_rng(most)
        for n in range(60):
            rows, model = known[chance.integers(len(known)) if n % 3 == 0 else -1]
            known.append((rows.put((float(n),)), [*model, (float(n),)][-most:]))
        for rows, model in known:
            assert rows.newest() == model
            assert rows == next(r for r, m in known if m == model)
        assert known[0][0] != known[1][0]
        assert known[0][0].__eq__(3) is NotImplemented


def test_rows_store_little_more_than_they_keep():
    rows = Rows(4, 1)
    for n in range(100):
        rows = rows.put((float(n),))
        assert len(rows._list) <= 8


# Samples at other times -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "to_rate"), [(1.0, 1.0), (2.0, 1.0), (1.0, 3.0)])
def test_resampling_is_a_sinc_in_a_blackman_window(rate, to_rate):
    x = CHANCE[:, :2]
    t = np.array([8.3, 11.0, 15.77, 20.5])
    share = min(1.0, to_rate / rate)
    half = 10.0 / share
    result = np.empty((4, 2))
    resample._resample.py_func(x, (t - 0.5) * rate, share, result)
    for n, at in enumerate((t - 0.5) * rate):
        u = at - np.arange(60)
        inside = np.abs(u) <= half
        window = 0.42 + 0.5 * np.cos(np.pi * u / half) + 0.08 * np.cos(2 * np.pi * u / half)
        w = np.where(inside, window * np.sinc(share * u), 0.0)
        assert result[n].tolist() == pytest.approx(list(w @ x / w.sum()), rel=1e-11)
    np.testing.assert_allclose(resample.resampled(x, 0.5, rate, t, to_rate), result, rtol=1e-12)
    assert resample.reach(rate, to_rate) == 10.0 / min(rate, to_rate)


# Files -----------------------------------------------------------------------------------------------------


CFG = """\
Süd,softrig,2013
6,6A,0D
1,VA_R,A,R,V,1.0,0,0,-3.4e+38,3.4e+38,1,1,P
2,VB_R,B,R,V,1.0,0,0,-3.4e+38,3.4e+38,1,1,P
3,VC_R,C,R,V,1.0,0,0,-3.4e+38,3.4e+38,1,1,P
4,IA_R,A,R,A,1.0,0,0,-3.4e+38,3.4e+38,1,1,P
5,IB_R,B,R,A,1.0,0,0,-3.4e+38,3.4e+38,1,1,P
6,IC_R,C,R,A,1.0,0,0,-3.4e+38,3.4e+38,1,1,P
60
1
4000.0,9
01/01/2000,00:00:01.500250,
01/01/2000,00:00:01.500250,
FLOAT32
1.0
0,0
4,0
"""


def whole(n=9, start=1.5):
    """A record with numbers that each format represents exactly: multiples of the largest one's resolution."""
    samples = np.arange(n)[:, None] * np.arange(1.0, 13.0)
    samples[0] = -samples[-1]
    return Record(start, 4000.0, samples)


def test_a_written_file_line_by_line(tmp_path):
    cfg, data = write_comtrade(tmp_path / "one.cfg", whole(), "r", frequency=60.0, station="S", clock_late=250e-6)
    assert [cfg.name, data.name] == ["one.cfg", "one.dat"]
    wanted = CFG.replace("Süd", "S").replace("250,\n", "250\n").replace("\n", "\r\n")
    assert cfg.read_bytes().decode() == wanted
    rows = np.frombuffer(data.read_bytes(), dtype=[("n", "<u4"), ("us", "<u4"), ("x", "<f4", 6)])
    assert rows["n"].tolist() == list(range(1, 10))
    assert rows["us"].tolist() == [250 * k for k in range(9)]
    assert rows["x"].tolist() == whole().samples[:, 6:].tolist()
    both = write_comtrade(tmp_path / "two", whole())[0].read_text().splitlines()
    assert [line.split(",")[1] for line in both[2:14]] == [f"{q}{p}_{e}" for e in "SR" for q in "VI" for p in "ABC"]
    assert (both[1], both[14]) == ("12,12A,0D", "50")
    assert both[17] == "01/01/2000,00:00:01.500000"


@pytest.mark.parametrize(("kind", "largest"), [("ascii", 99998), ("binary", 32767)])
def test_whole_numbers_of_a_written_file(tmp_path, kind, largest):
    cfg, data = write_comtrade(tmp_path / "one", whole(), "s", file_format=kind)
    fields = cfg.read_text().splitlines()[3].split(",")
    assert float(fields[5]) == 16.0 / largest
    assert fields[8:10] == [f"{-largest:g}", f"{largest:g}"]
    if kind == "ascii":
        rows = [[int(x) for x in line.split(",")] for line in data.read_bytes().decode().split("\r\n")[:-1]]
    else:
        table = np.frombuffer(data.read_bytes(), dtype=[("n", "<u4"), ("us", "<u4"), ("x", "<i2", 6)])
        rows = [[int(n), int(us), *x.tolist()] for n, us, x in table]
    for k, row in enumerate(rows):
        share = -1.0 if k == 0 else k / 8.0
        assert row == [k + 1, 250 * k, *[round(share * largest)] * 6]


APART_BY = (
    "expected 2 voltage(s) and 2 current(s) of each phase, distinct by unit and phase; name the channels; it has "
)


def edited(tmp_path, record=None, name="one", end="both", **changes):
    """A written file with some lines (by number) replaced, read again."""
    cfg, _ = write_comtrade(tmp_path / name, record or whole(), end)
    lines = cfg.read_text().splitlines()
    for number, text in changes.items():
        lines[int(number[1:])] = text
    cfg.write_text("\n".join(lines) + "\n")
    return cfg


def test_a_file_without_dates_is_read_without_a_report(tmp_path):
    cfg = edited(tmp_path)
    dates = [k for k, line in enumerate(cfg.read_text().splitlines()) if line.count("/") == 2]
    assert len(dates) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = read_comtrade([edited(tmp_path, **{f"l{k}": "," for k in dates})])
    assert result.samples.tolist() == whole().samples.tolist()


def test_channels_by_unit_and_phase_and_their_scale(tmp_path):
    record = whole()
    for line, scale in [
        ("1,VA_S,A,S,V,1.0,0,0,-3.4e+38,3.4e+38,1,1,P", 1.0),
        ("1,VA_S, a ,S, kV ,1.0,0,0,-3.4e+38,3.4e+38,1,1,P", 1e3),
        ("1,VA_S,L1,S,KV,1.0,0,0,-3.4e+38,3.4e+38,1,1,P", 1e3),
        ("1,VA_S,AN,S,mV,1.0,0,0,-3.4e+38,3.4e+38,1,1,P", 1e-3),
        ("1,VA_S,A,S,MV,1.0,0,0,-3.4e+38,3.4e+38,1,1,P", 1e6),
        ("1,VA_S,A,S,v,1.0,0,0,-3.4e+38,3.4e+38,400,4,s", 100.0),
        ("1,VA_S,A,S,v,1.0,0,0,-3.4e+38,3.4e+38,400,4,P", 1.0),
    ]:
        result = read_comtrade([edited(tmp_path, l2=line)])
        assert result.samples[:, 0].tolist() == pytest.approx((scale * record.samples[:, 0]).tolist())
        assert result.samples[:, 1:].tolist() == record.samples[:, 1:].tolist()
    assert (result.start, result.rate) == (0.0, 4000.0)


NO_RATIO = "not readable as COMTRADE: line 3: channel VA_S has secondary values and no ratio"


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("1,VA_S,A,S,uV,1.0,0,0,-1,1,1,1,P", "channel VA_S has the unit 'uV', expected V, A, kV, kA"),
        ("1,VA_S,A,S,V,1.0,0,0,-1,1,400,0,S", "channel VA_S is secondary with a ratio of 400:0"),
        ("1,VA_S,A,S,V,1.0,0,0,-1,1,,,S", NO_RATIO),
        ("1,VA_S,A,S,V,1.0,0,0,-1,1,400,,s", NO_RATIO),
        ("1,VA_S,X,S,V,1.0,0,0,-1,1,1,1,P", APART_BY + "VA_S (V, phase X), VB_S (V, phase B)"),
        ("1,VA_S,B,S,V,1.0,0,0,-1,1,1,1,P", APART_BY + "VA_S (V, phase B), VB_S (V, phase B)"),
        ("1,VA_S,A,S,Hz,1.0,0,0,-1,1,1,1,P", APART_BY + "VA_S (Hz, phase A), VB_S (V, phase B)"),
    ],
)
def test_indistinguishable_channels_are_refused(tmp_path, line, text):
    cfg = edited(tmp_path, l2=line)
    with pytest.raises(ComtradeFileError) as refused:
        read_comtrade([cfg])
    assert str(refused.value).startswith(f"{cfg}: {text}")


def test_files_and_channels_can_be_named_as_expected(tmp_path):
    cfg = edited(tmp_path)
    names = [f"{q}{p}_{e}" for e in "SR" for q in "VI" for p in "ABC"]
    for paths, channels, text in [
        ([], (), "0 files: expected one with both ends, or one of each end"),
        ([cfg] * 3, (), "3 files: expected one with both ends, or one of each end"),
        ([cfg], names[:11], "11 channels: expected twelve, u_S, i_S, u_R, i_R of the phases a, b, c"),
        ([cfg], [*names[:11], "X"], f"{cfg}: no channel X; it has VA_S (V, phase A), "),
        ([tmp_path / "no.cfg"], (), f"{tmp_path / 'no.cfg'}: no such file"),
    ]:
        with pytest.raises(ComtradeFileError) as refused:
            read_comtrade(paths, channels)
        assert str(refused.value).startswith(text)
    assert read_comtrade([cfg], names[::-1]).samples.tolist() == whole().samples[:, ::-1].tolist()
    short = edited(tmp_path, whole(2), name="short")
    assert len(read_comtrade([short]).samples) == 2
    one = edited(tmp_path, whole(1), name="single")
    with pytest.raises(RecordError) as unfit:
        read_comtrade([one])
    assert (unfit.value.status, str(unfit.value)) == (Status.TOO_SHORT, f"{one}: 1 samples")


def test_two_recorders_are_aligned_by_their_clocks_and_reported(tmp_path):
    long = whole(40)
    s = write_comtrade(tmp_path / "s", long, "s")[0]
    r = write_comtrade(tmp_path / "r", long, "r", clock_late=0.001)[0]
    result = read_comtrade([s, r])  # R starts 1 ms, that is four samples, later
    assert (result.start, result.rate, len(result.samples)) == (0.001, 4000.0, 36)
    assert result.samples.tolist() == np.hstack([long.samples[4:, :6], long.samples[:36, 6:]]).tolist()
    again = read_comtrade([s, r], late=(0.0, 0.001))
    assert (again.start, again.samples.tolist()) == (0.0, long.samples.tolist())
    swapped = read_comtrade([r, s])
    assert swapped.samples.tolist() == result.samples[:, [*range(6, 12), *range(6)]].tolist()
    both = read_comtrade([edited(tmp_path, long)], late=(0.0005, 0.001))
    assert (both.start, both.samples.tolist()) == (
        -0.0005,
        np.hstack([long.samples[:38, :6], long.samples[2:, 6:]]).tolist(),
    )
    with pytest.raises(ComtradeFileError) as refused:
        read_comtrade([s, s])
    assert str(refused.value) == f"{s} and {s}: both are the same record, expected one of each end"


def test_texts_of_a_file_are_read_in_the_encodings_of_recorders():
    assert text_of("Süd".encode()) == "Süd"
    assert text_of(b"\xef\xbb\xbf" + "Süd".encode()) == "Süd"
    assert text_of("Süd".encode("cp1252")) == "Süd"
    assert text_of(b"S\x81d") == "S\N{REPLACEMENT CHARACTER}d"


# The equations --------------------------------------------------------------------------------------------


@pytest.fixture
def plain(monkeypatch):
    return interpreted(monkeypatch, equations, "lagrange", "trial_voltage", "mismatch")


LINE = Section(0.03, 1e-3, 1.2e-8, 100.0)
ENDS = np.random.default_rng(9).normal(size=(4, 80))
KINDS = ("corrected", "printed", "printed_sign", "printed_coefficient", "printed_resistance", "printed_speed")


def at_delay(x, k, delay):
    """x at k + delay: the quintic through the six samples around, the two nearest in the middle."""
    base = math.floor(delay) if delay >= 0.0 else math.ceil(delay)
    around = np.arange(-2, 4) if delay >= 0.0 else np.arange(2, -4, -1)
    s, points = abs(delay - base), np.arange(-2, 4)
    weights = [math.prod((s - m) / (j - m) for m in points if m != j) for j in points]
    return sum(w * x[k + base + n] for w, n in zip(weights, around, strict=True))


def u_x(u, i, k, r, delay, back_sign=1.0, squared=None, shunt=None):
    """Equation (9) of the page, with optional misprints."""
    z = math.sqrt(1e-3 / 1.2e-8)
    plus, minus = z + r / 4, z - r / 4
    ahead = at_delay(u, k, delay) - plus * at_delay(i, k, delay)
    behind = at_delay(u, k, -delay) + back_sign * minus * at_delay(i, k, -delay)
    second = minus**2 if squared is None else squared
    third = r**2 / 8 if shunt is None else shunt
    return (plus**2 * ahead + second * behind - third * u[k] - r / 2 * plus * minus * i[k]) / (2 * z**2)


def f_of(x, rate, kind, first, count, delays=None):
    """The mean of |u_XS - u_XR|."""
    z, v = math.sqrt(1e-3 / 1.2e-8), 3e5 if kind == "printed_speed" else 1.0 / math.sqrt(1e-3 * 1.2e-8)
    r_s, r_r = 0.03 * x, 0.03 * (100.0 - x)
    tau, remaining = delays or (x / v * rate, (100.0 - x) / v * rate)
    wrong = {part: kind in ("printed", f"printed_{part}") for part in ("sign", "coefficient", "resistance")}
    total = 0.0
    for k in range(first, first + count):
        s = u_x(
            ENDS[0],
            ENDS[1],
            k,
            r_s,
            tau,
            -1.0 if wrong["sign"] else 1.0,
            (z + r_s / 4) ** 2 if wrong["coefficient"] else None,
            r_s / 8 if wrong["resistance"] else None,
        )
        r = u_x(ENDS[2], ENDS[3], k, r_r, remaining, 1.0, (z + r_r / 4) ** 2 if wrong["coefficient"] else None,
                r_s / 8 if wrong["resistance"] else None)  # fmt: skip
        total += abs(s - r)
    return total / count


@pytest.mark.parametrize("kind", KINDS)
def test_the_objective_is_that_of_the_page_corrected_and_with_each_misprint(plain, kind):
    model = equations.model(LINE, kind)
    x, out = np.array([0.0, 13.7, 50.0, 88.8, 100.0]), np.empty(5)
    plain.objectives.py_func(model, ENDS, 20_000.0, 30, 7, x, out)
    assert out.tolist() == pytest.approx([f_of(p, 20_000.0, kind, 30, 7) for p in x], rel=1e-9)


def test_whole_delays_are_those_of_the_paper(plain):
    model, out = equations.model(LINE), np.empty(8)
    plain.objectives_integer.py_func(model, ENDS, 20_000.0, 30, 7, out)
    v = 1.0 / math.sqrt(1e-3 * 1.2e-8)
    whole = 100.0 / v * 20_000.0  # 6.93 samples
    for n in range(7):
        wanted = f_of(n * v / 20_000.0, 20_000.0, "corrected", 30, 7, (n, round(whole - n)))
        assert out[n] == pytest.approx(wanted, rel=1e-9)


# One record ready to be located ---------------------------------------------------------------------------


def long_record(n=1200, rate=20_000.0, start=0.0):
    """Twelve sines of 50 Hz."""
    t = start + np.arange(n) / rate
    return Record(start, rate, 1e5 * np.sin(100.0 * math.pi * t[:, None] + np.arange(12)))


def test_the_window_in_samples_and_its_margin_are_as_expected():
    work = Objective(long_record(), LocatorParams())
    assert (work.first, work.count) == (420, 371)  # from 21 to 39.5 ms
    assert Objective(long_record(start=0.001), LocatorParams()).first == 400
    section = LocatorParams().line.aerial
    # 8.66 samples: 8, and three more taps of the cubic.
    assert work.travel == pytest.approx(120.0 / section.velocity * 20_000.0)
    for n, first, last, good in [
        (802, 0.021, 0.0395, True),
        (801, 0.021, 0.0395, False),
        (1200, 11 / 20_000, 0.03, True),
        (1200, 10.9 / 20_000, 0.03, True),
        (1200, 9.9 / 20_000, 0.03, False),
        (1200, 0.03001, 0.03004, False),
        (1200, 0.03001, 0.03005, True),
    ]:
        p = LocatorParams(window_start=first, window_end=last)
        if good:
            assert Objective(long_record(n), p).count >= 1
            continue
        with pytest.raises(RecordError) as refused:
            Objective(long_record(n), p)
        text = (
            f"too short: the record from 0 to {(n - 1) / 20_000:.6g} s does not cover the window from {first:g} to "
            f"{last:g} s and 0.00055 s beyond it at both ends"
        )
        assert (refused.value.status, str(refused.value)) == (Status.TOO_SHORT, text)


def test_modes_grid_and_evaluations():
    record = long_record()
    work = Objective(record, LocatorParams(n_grid=5))
    a, b, c = (np.stack([record.group(g)[:, k] for g in ("u_s", "i_s", "u_r", "i_r")]) for k in range(3))
    for mode, pair in ((1, (a, b)), (2, (b, c)), (3, (c, a))):
        assert work.ends(mode) == pytest.approx((pair[0] - pair[1]) / 3.0)
    assert work.grid.tolist() == [0.0, 30.0, 60.0, 90.0, 120.0]
    assert work.curves.shape == (3, 5)
    assert work.evaluations == 15
    assert work.curve(2).tolist() == work.curves[1].tolist()
    assert work.f(np.array([30.0]), 2).tolist() == [work.curves[1, 1]]
    assert work.evaluations == 16
    assert work.f(np.array([30.0]), 2, (430, 10))[0] != work.curves[1, 1]
    wrong = Objective(record, LocatorParams(n_grid=5, equations="printed"))
    assert wrong.curve(1).tolist() != wrong.curves[0].tolist()
    assert wrong.curves.tolist() == work.curves.tolist()
    assert work.rng.uniform() == Objective(record, LocatorParams()).rng.uniform()
    assert work.rng.uniform() != Objective(record, LocatorParams(seed=1)).rng.uniform()


PASS = (
    "waves pass the line of 120 km in {} samples of 50 us, expected 4 or more: "
    "the errors of clocks and transformers weigh more"
)


@pytest.mark.parametrize(("travel", "text"), [(4.0, ""), (3.99, PASS.format(3.99)), (1.0, PASS.format(1))])  # fmt: skip
def test_the_samples_needed_for_a_travel_time_are_as_expected(travel, text):
    assert check_travel(travel, 20_000.0, LocatorParams()) == text


def test_too_few_samples_are_refused():
    with pytest.raises(RecordError) as refused:
        check_travel(0.999, 20_000.0, LocatorParams())
    text = "waves pass the line of 120 km in 0.999 samples of 50 us, expected 1 or more (least_travel)"
    assert (refused.value.status, str(refused.value)) == (Status.TOO_SHORT, text)
    with pytest.raises(ParameterError, match=r"window_end = 0\.02 s is not after window_start = 0\.021 s"):
        build(LocatorParams, {"window_end": 0.02})
    with pytest.raises(ParameterError, match="is not after"):
        build(LocatorParams, {"window_start": 0.03, "window_end": 0.03})


# Which mode, and whether there is a fault ------------------------------------------------------------------


def chooser(curves, monkeypatch, against="", **settings):
    """A locator with given curves; returns its reports, and the limit with which it has asked for contradictions."""
    work = Locator.__new__(Locator)
    work.p, work.evaluations = LocatorParams(**settings), 7
    work.__dict__["curves"] = np.array(curves)
    asked = []
    monkeypatch.setattr(location, "contradiction", lambda _, limit: asked.append(limit) or against)
    return work.choose(), asked


NONE = "no_fault: max F = {} V, min F = {} V in mode {}, expected 2000 V and a ratio of 5"
QUIET = "mode_not_excited: max F = {} V, min F = {} V in mode {}, but {} V in mode 3"
FLAT, SMALL, LARGE = (1900.0, 1000.0), (2000.0, 400.0), (9000.0, 900.0)


@pytest.mark.parametrize(
    ("curves", "settings", "status", "mode", "text", "limit"),
    [
        ((FLAT, SMALL, LARGE), {}, "OK", 3, "", 0.05),
        ((LARGE, SMALL, FLAT), {}, "OK", 1, "", 0.05),
        ((FLAT, SMALL, FLAT), {}, "OK", 2, "", 0.05),  # 2,000 V and a ratio of 5 are both just enough
        ((FLAT, (1999.0, 10.0), FLAT), {}, "NO_FAULT", 2, NONE.format(1999, 10, 2), None),
        ((FLAT, (2500.0, 501.0), FLAT), {}, "NO_FAULT", 2, NONE.format(2500, 501, 2), 0.02),
        ((FLAT, (2500.0, 501.0), FLAT), {"disagreement": 0.01}, "NO_FAULT", 2, NONE.format(2500, 501, 2), 0.01),
        ((FLAT, SMALL, LARGE), {"mode": "2"}, "OK", 2, "", 0.05),  # a mode needs a fifth of the largest signal
        (
            (FLAT, SMALL, (10001.0, 900.0)),
            {"mode": "2"},
            "MODE_NOT_EXCITED",
            2,
            QUIET.format(2000, 400, 2, "1e+04"),
            0.05,
        ),
        ((FLAT, SMALL, (10000.0, 900.0)), {"mode": "2"}, "OK", 2, "", 0.05),
        ((FLAT, SMALL, LARGE), {"mode": "1"}, "MODE_NOT_EXCITED", 1, QUIET.format(1900, 1000, 1, 9000), 0.05),
        ((FLAT, FLAT, FLAT), {"mode": "3"}, "NO_FAULT", 3, NONE.format(1900, 1000, 3), None),
        (((9000.0, 4000.0), SMALL, FLAT), {}, "NO_FAULT", 1, NONE.format(9000, 4000, 1), 0.05),
        ((FLAT, FLAT, FLAT), {"f_threshold": 1900.0, "f_ratio": 1.9}, "OK", 1, "", 0.05),
    ],
)
def test_the_mode_and_the_presence_of_a_fault_are_decided(monkeypatch, curves, settings, status, mode, text, limit):
    result, asked = chooser(curves, monkeypatch, **settings)
    assert (result.status.name, result.mode, result.text) == (status, mode, text)
    assert (result.x_km, result.f_max, result.f_min, result.evaluations) == (None, *curves[mode - 1], 7)
    assert asked == ([] if limit is None else [limit])


def test_a_contradiction_is_reported_first(monkeypatch):
    result, _ = chooser((FLAT, SMALL, LARGE), monkeypatch, "so it is")
    assert (result.status, result.text, result.mode, result.x_km) == (Status.CONTRADICTORY, "so it is", 3, None)
    # Contradictions are not checked if there is no fault.
    assert chooser((FLAT, FLAT, FLAT), monkeypatch, "so it is")[0].status == Status.NO_FAULT


@pytest.mark.parametrize(
    ("x", "status", "text"),
    [
        (50.0, "OK", "fault at 50.0000 km"),
        (0.0011, "OK", "fault at 0.0011 km"),
        (0.001, "AT_TERMINAL", "at_terminal: the minimum is at x = 0.0010 km"),
        (119.9985, "OK", "fault at 119.9985 km"),
        (119.9995, "AT_TERMINAL", "at_terminal: the minimum is at x = 119.9995 km"),
    ],
)
@pytest.mark.parametrize(
    ("algorithm", "module", "name"),
    [
        ("brent", "search", "brent"),
        ("woa", "search", "swarm"),
        ("gwo", "search", "swarm"),
        ("integer_grid", "search", "integer_grid"),
        ("phasor", "transient", "phasor"),
        ("travelling_wave", "transient", "travelling_wave"),
    ],
)
def test_each_algorithm_returns_the_place_and_a_place_at_an_end_is_reported(
    monkeypatch, algorithm, module, name, x, status, text
):
    work = Locator.__new__(Locator)
    work.p, work.section = LocatorParams(algorithm=algorithm), LINE.part(120.0)
    monkeypatch.setattr(Locator, "choose", lambda self: Location(Status.OK, None, 11.0, 99.0, 2, self.evaluations))
    whole = module == "search"
    monkeypatch.setattr(getattr(location, module), name, lambda of, mode: (x, 5.0 + mode) if whole else x)
    result = work.locate()
    assert (result.status.name, result.x_km, result.text, result.mode) == (status, x, text, 2)
    assert (result.f_min, result.f_max, result.evaluations) == (7.0 if whole else 11.0, 99.0, 0)


# The searches ----------------------------------------------------------------------------------------------


def work_of(f, n_grid=11, length=100.0, **settings):
    """An object whose objective is a given function."""
    work = types.SimpleNamespace(
        p=LocatorParams(n_grid=n_grid, **settings), grid=np.linspace(0.0, length, n_grid), evaluations=0
    )
    work.f = lambda x, mode: np.array([f(p) + mode for p in x])
    work.curve = lambda mode: work.f(work.grid, mode)
    return work


@pytest.mark.parametrize("place", [3.3, 47.1, 50.0, 96.0, 0.0, 100.0])
def test_brent_finds_the_lowest_of_several_minima(place):
    x, f = brent(work_of(lambda p: (p - place) ** 2 + 30.0 * math.sin(p / 9.0) ** 2 * (p != place)), 2)

    def smooth(p):
        return (p - place) ** 2 + 30.0 * math.sin(p / 9.0) ** 2

    cells = (minimize_scalar(smooth, bounds=(a, a + 2.0), method="bounded") for a in range(0, 100, 2))
    wanted = min(cells, key=lambda r: r.fun)
    assert x == pytest.approx(wanted.x, abs=2e-2) or place in (0.0, 50.0, 100.0)
    assert f <= wanted.fun + 2.0 + 1e-6


def test_brent_stays_in_the_cells_beside_the_lowest_grid_point():
    assert brent(work_of(lambda p: abs(p - 37.0)), 1) == (pytest.approx(37.0, abs=1e-5), pytest.approx(1.0, abs=1e-5))
    assert brent(work_of(lambda p: p), 1) == (0.0, 1.0)
    assert brent(work_of(lambda p: -p), 3) == (100.0, -97.0)
    spike = work_of(lambda p: -5.0 if p == 40.0 else abs(p - 43.0))  # Brent's method does not evaluate this spike
    assert brent(spike, 1) == (40.0, -4.0)
    rough = work_of(lambda p: abs(p - 37.0), tolerance=1.0)
    assert brent(rough, 1)[0] == pytest.approx(37.0, abs=1.0)
    assert abs(brent(rough, 1)[0] - 37.0) > 1e-4


def test_integer_samples_are_multiples_of_the_distance_of_one_sample(monkeypatch):
    from softrig_power.fault_location.method import search

    def written(model, both, rate, first, count, out):
        assert (model, both, rate, first, count) == (work.model, "ends 2", 20_000.0, 3, 4)
        out[:] = np.abs(np.arange(len(out)) - 5.0) + 0.5

    v, rate = types.SimpleNamespace(v=3e5), types.SimpleNamespace(rate=20_000.0)
    work = types.SimpleNamespace(
        travel=8.9, model=v, record=rate, first=3, count=4, evaluations=1, ends=lambda mode: f"ends {mode}"
    )
    monkeypatch.setattr(search, "objectives_integer", written)
    assert integer_grid(work, 2) == (5 * 3e5 / 20_000.0, 0.5)
    assert work.evaluations == 1 + 9


# Classic baselines -----------------------------------------------------------------------------------------


def fronts(at_s, at_r, quiet=1.0, front=100.0, n=400):
    """Ends at rest except for ripples, with a front at one sample each."""
    both = np.zeros((4, n))
    both[0, 10], both[2, 20] = quiet, quiet
    both[0, at_s:] += front
    both[2, at_r:] += front
    return types.SimpleNamespace(
        ends=lambda mode: both, first=200, count=150, section=LINE, record=types.SimpleNamespace(rate=1e6)
    )


@pytest.mark.parametrize(("at_s", "at_r"), [(250, 250), (230, 300), (300, 230), (201, 349), (349, 201)])
def test_the_end_with_the_earlier_front_is_nearer(at_s, at_r):
    x = 0.5 * (100.0 + (at_s - at_r) * 1e-6 / math.sqrt(1e-3 * 1.2e-8))
    assert transient.travelling_wave(fronts(at_s, at_r), 1) == pytest.approx(min(max(x, 0.0), 100.0))


def test_fronts_are_detected_as_expected():
    assert transient._arrival(fronts(250, 300), 1, 0) == 250
    assert transient._arrival(fronts(250, 300), 1, 2) == 300
    # The ripple has second differences of 2, and a front must exceed them twenty times.
    quietly = fronts(250, 300, front=40.1)
    assert transient._arrival(quietly, 1, 0) == 250
    for front in (40.0, 39.0):
        with pytest.raises(RecordError, match=r"^no_fault: no wave front arrives in the window$") as refused:
            transient._arrival(fronts(250, 300, front=front), 1, 0)
        assert refused.value.status == Status.NO_FAULT
    with pytest.raises(RecordError):
        transient._arrival(fronts(351, 300), 1, 0)  # the front lies after the window
    assert transient._arrival(fronts(349, 300), 1, 0) == 349
    early = fronts(250, 300)
    early.ends(1)[0, 103:] += 60.0  # a front in the second half before the window is detected
    assert transient._arrival(early, 1, 0) == 103
    early.ends(1)[0, 90:] += 60.0  # the first half before the window only measures the ripple
    with pytest.raises(RecordError):
        transient._arrival(early, 1, 0)


@pytest.mark.parametrize("x", [0.0, 20.0, 63.0, 100.0, -30.0, 130.0])
def test_phasors_of_both_ends_agree_at_the_fault(x):
    """By the telegraph equations from the fault to both ends; a place beyond an end is reported as the end."""
    omega, rate = 100.0 * math.pi, 4000.0
    gamma, zc = LINE.propagation(omega), LINE.characteristic_impedance(omega)
    # Voltage at the fault, and currents from it towards S and R.
    u, i_s, i_r = 3.0 + 1.0j, 0.02 - 0.01j, -0.01 + 0.03j
    ends_of = []
    for length, i in ((x, i_s), (100.0 - x, i_r)):
        ch, sh = np.cosh(gamma * length), np.sinh(gamma * length)
        ends_of += [u * ch - zc * i * sh, -(i * ch - u * sh / zc)]  # currents count as positive into the line
    t = np.arange(400) / rate
    both = np.array([(p * np.exp(1j * omega * t)).real for p in ends_of])
    work = types.SimpleNamespace(
        record=types.SimpleNamespace(rate=rate), p=LocatorParams(), first=100, count=201, section=LINE,
        ends=lambda mode: both)  # fmt: skip
    assert transient.phasor(work, 1) == pytest.approx(min(max(x, 0.0), 100.0), abs=1e-6)


def test_a_cycle_must_end_at_the_end_of_the_window():
    work = types.SimpleNamespace(
        record=types.SimpleNamespace(rate=4000.0), p=LocatorParams(), section=LINE, ends=lambda mode: ENDS
    )
    work.first, work.count = 70, 10  # a cycle has 80 samples
    assert 0.0 <= transient.phasor(work, 1) <= 100.0
    work.count = 9
    with pytest.raises(RecordError) as refused:
        transient.phasor(work, 1)
    text = "too short: a cycle of 80 samples does not end at the window's end"
    assert (refused.value.status, str(refused.value)) == (Status.TOO_SHORT, text)


# When a fault begins ----------------------------------------------------------------------------------------


def stepped(channel, at, jump, n=400, rate=4000.0, start=0.5):
    """Sines of peak 1, one of which jumps."""
    t = np.arange(n)
    samples = np.cos(2.0 * math.pi * t / 80.0)[:, None] * np.ones(12)
    samples[at:, channel] += jump
    return Record(start, rate, samples)


@pytest.mark.parametrize("channel", [0, 4, 8, 11])
def test_a_fault_begins_with_the_first_sample_that_differs_by_a_fifth_from_the_cycle_before(channel):
    assert inception(stepped(channel, 150, 0.201), 50.0) == pytest.approx(0.5 + 150 / 4000.0)
    assert inception(stepped(channel, 150, -0.201), 50.0) == pytest.approx(0.5 + 150 / 4000.0)
    assert inception(stepped(channel, 80, 0.5), 50.0) == pytest.approx(0.5 + 80 / 4000.0)
    with pytest.raises(RecordError, match=r"^no_fault: no channel changes by a fifth from one cycle to the next$"):
        inception(stepped(channel, 150, 0.199), 50.0)
    two = stepped(channel, 150, 0.5)
    two.samples[120:, (channel + 3) % 12] += 0.5
    assert inception(two, 50.0) == pytest.approx(0.5 + 120 / 4000.0)
    with pytest.raises(RecordError, match=r"^too short: 81 samples, a cycle has 80$"):
        inception(stepped(channel, 80, 0.5, n=81), 50.0)
    assert inception(stepped(channel, 80, 0.5, n=82), 50.0) == pytest.approx(0.5 + 80 / 4000.0)


def test_the_window_is_that_of_the_study_or_what_the_record_has():
    p = LocatorParams(frequency=50.0)
    result = windowed(stepped(0, 150, 1.0), p)
    assert (result.window_start, result.window_end) == (pytest.approx(0.5385), pytest.approx(0.557))
    # The travel time, and the samples that the interpolation needs.
    beyond = 120.0 / p.line.aerial.velocity + 4.0 / 4000.0
    result = windowed(stepped(0, 150, 1.0, n=200), p)
    assert (result.window_start, result.window_end) == (
        pytest.approx(0.5385),
        pytest.approx(0.5 + 199 / 4000.0 - beyond),
    )
    with pytest.raises(RecordError) as refused:
        windowed(stepped(0, 150, 1.0, n=160), p)
    text = "too short: the record ends 0.00225 s after the fault"
    assert (refused.value.status, str(refused.value)) == (Status.TOO_SHORT, text)


# How far it can be trusted ----------------------------------------------------------------------------------


def quintic(t):
    """A polynomial that six points determine."""
    return 3.0 + t * (1.0 + t * (-0.5 + t * (0.03 + t * (1e-3 - 1e-5 * t))))


def test_a_late_clock_reads_older_samples(monkeypatch):
    monkeypatch.setattr(trust, "lagrange", trust.lagrange.py_func)
    t = np.arange(20.0)
    record = Record(0.0, 1000.0, np.tile(quintic(t)[:, None], 12))
    for late in (0.0, 2e-4, 9e-4):
        result = trust.shifted(record, late)
        assert result.shape == (20, 6)
        np.testing.assert_allclose(result[3:-3, 4], quintic(t[3:-3] - 1000.0 * late), rtol=1e-9)


def test_each_item_of_the_budget_shifts_the_place(monkeypatch):
    """For a locator that weighs its samples: each shift is the effect of that item alone on the weights."""
    record, p = long_record(200), LocatorParams(algorithm="woa", mode="auto")
    seen = []

    def locate(changed_record, settings):
        seen.append((changed_record, settings))
        sums = np.abs(changed_record.samples).sum(axis=0).reshape(4, 3).sum(axis=1) / np.abs(record.samples).sum() * 4.0
        place = 50.0 + sums @ [1.0, -2.0, 4.0, 8.0] + 1e3 * settings.line.l1 + 10.0 * settings.line.r1
        return Location(Status.OK, float(place))

    monkeypatch.setattr(trust, "locate", locate)
    monkeypatch.setattr(trust, "shifted", lambda arguments, late: arguments.samples[:, 6:] * (1.0 + 1e4 * late))
    monkeypatch.setattr(trust, "_scatter", lambda work, result: 0.25)
    monkeypatch.setattr(trust, "Locator", lambda *arguments: None)
    budget = ErrorBudget(sync_us=2.0, ratio=0.01, reactance=0.02, resistance=0.5)
    result = trust.confidence(record, p, Location(Status.OK, 61.0, 4.0, 100.0, 2), budget)
    share = np.abs(record.samples).sum(axis=0).reshape(4, 3).sum(axis=1) / np.abs(record.samples).sum() * 4.0
    assert result.effects_km == pytest.approx(
        {
            "clocks 2 us": 0.02 * (share[2:] @ [4.0, 8.0]),
            "u_s 1 %": 0.01 * share[0],
            "i_s 1 %": 0.02 * share[1],
            "u_r 1 %": 0.04 * share[2],
            "i_r 1 %": 0.08 * share[3],
            "L1 2 %": 1e3 * 0.02 * p.line.l1,
            "R1 50 %": 10.0 * 0.5 * p.line.r1,
        }
    )
    assert (result.scatter_km, result.contrast) == (0.25, 25.0)
    assert {(s.algorithm, s.mode) for _, s in seen} == {("brent", "2")}
    assert seen[0][0] is record
    none = ErrorBudget(sync_us=0.0, ratio=0.0, reactance=0.0, resistance=0.0)
    assert trust.confidence(record, p, Location(Status.OK, 61.0, 0.0, 100.0, 2), none) == Confidence(0.25, {}, math.inf)
    with pytest.raises(ValueError, match=r"^there is no position: nothing$"):
        trust.confidence(record, p, Location(Status.NO_FAULT, text="nothing"))
    monkeypatch.setattr(trust, "locate", lambda *arguments: Location(Status.NO_FAULT))
    assert trust.confidence(record, p, Location(Status.OK, 61.0, 4.0, 100.0, 2)).effects_km == {}


@pytest.mark.parametrize(("x", "length"), [(50.0, 100.0), (1.0, 100.0), (99.5, 100.0)])
def test_the_scatter_is_that_of_eight_parts_within_two_km(x, length):
    places, seen = {}, []

    def f(at, mode, stretch):
        seen.append((float(at[0]), mode, stretch))
        places.setdefault(stretch, x + 0.1 * len(places))
        return (at - places[stretch]) ** 2

    work = types.SimpleNamespace(f=f, section=types.SimpleNamespace(length=length), first=100, count=80)
    result = trust._scatter(work, Location(Status.OK, x, mode=3))
    assert list(places) == [(100 + 10 * k, 10) for k in range(8)]
    wanted = np.clip([x + 0.1 * k for k in range(8)], max(x - 2.0, 0.0), min(x + 2.0, length))
    assert result == pytest.approx(np.std(wanted, ddof=1) / math.sqrt(8.0), rel=1e-3)
    assert {mode for _, mode, _ in seen} == {3}
    assert min(at for at, *_ in seen) >= max(x - 2.0, 0.0)
    assert max(at for at, *_ in seen) <= min(x + 2.0, length)
    few = types.SimpleNamespace(f=f, section=work.section, first=0, count=5)  # fewer samples than parts of the window
    assert trust._scatter(few, Location(Status.OK, x, mode=3)) >= 0.0
    assert all(b > 0 for _, b in places)


def test_a_location_is_described_as_expected():
    result = Location(Status.OK, 50.1234, 123.456, 2345.6, 2, 80, "fault at 50.1234 km")
    confidence = Confidence(0.0123, {"clocks 1 us": 0.5, "L1 1 %": 1.25}, 19.0)
    lines = [
        "fault at 50.123 km from S (69.877 km from R), standard uncertainty 1.35 km",
        "  aerial mode 2, F from 123.5 to 2346 V (contrast 19)",
        "  scatter inside the record 12.3 m",
        "  clocks 1 us would move it by 500.0 m",
        "  L1 1 % would move it by 1.25 km",
    ]
    assert trust.describe(result, confidence, 120.0).splitlines() == lines
    near = Location(Status.AT_TERMINAL, 0.0, 1.0, 9.0, 1, 8, "at_terminal: the minimum is at x = 0.0000 km")
    one = Confidence(0.9999, {}, 9.0)
    assert trust.describe(near, one, 120.0).splitlines() == [
        "fault at 0.000 km from S (120.000 km from R), standard uncertainty 999.9 m",
        "  aerial mode 1, F from 1 to 9 V (contrast 9)",
        "  scatter inside the record 999.9 m",
        "  at_terminal: the minimum is at x = 0.0000 km: the fault may be beyond the line",
    ]
    assert trust.describe(Location(Status.GAP, text="gap at 2 s"), None, 120.0) == "gap at 2 s"
    assert trust.describe(result, None, 120.0) == result.text
    assert trust._metres(1.0) == "1.00 km"
    record = Record(0.5, 1000.0, CHANCE[:41], "R resampled from 2000 to 1000 Hz")
    rests = [
        "  line 120 km, 0.0275 ohm/km, 0.00100268 H/km, 1.3e-08 F/km",
        "  record 0.5 to 0.54 s, 41 samples at 1000 Hz",
        "  window 0.021 to 0.0395 s, as set by --window",
        "  R resampled from 2000 to 1000 Hz",
    ]
    assert trust.conditions(record, LocatorParams(), "as set by --window").splitlines() == rests
    assert (
        trust.conditions(Record(0.5, 1000.0, CHANCE[:41]), LocatorParams(), "as set by --window").splitlines()
        == rests[:3]
    )


# How the ends are wired --------------------------------------------------------------------------------------


def test_all_wrong_wirings_of_the_ends_are_tried():
    """Each is applied to the samples independently."""
    record = Record(0.0, 1.0, CHANCE[:4])
    at = {"u_s": 0, "i_s": 3, "u_r": 6, "i_r": 9}
    orders = {
        "b and c": (0, 2, 1),
        "a and b": (1, 0, 2),
        "a and c": (2, 1, 0),
        "a, b, c in a circle": (1, 2, 0),
        "a, c, b in a circle": (2, 0, 1),
    }
    wanted = {}
    for groups in (["i_s"], ["i_r"], ["i_s", "i_r"], ["u_s"], ["u_r"]):
        wanted[f"{' and '.join(groups)} reversed"] = again = CHANCE[:4].copy()
        for g in groups:
            again[:, at[g] : at[g] + 3] *= -1.0
    for g, phase in itertools.product(("i_s", "i_r"), "abc"):
        wanted[f"phase {phase} of {g} reversed"] = again = CHANCE[:4].copy()
        again[:, at[g] + "abc".index(phase)] *= -1.0
    for groups, (name, order) in itertools.product(
        (["u_r", "i_r"], ["i_s"], ["i_r"], ["u_s"], ["u_r"]), orders.items()
    ):
        turned = CHANCE[:4].copy()
        for g in groups:
            turned[:, at[g] : at[g] + 3] = CHANCE[:4][:, [at[g] + k for k in order]]
        text = f"phases {name} of {' and '.join(groups)} exchanged"
        wanted[text] = turned
        if groups[-1] != "u_s" and groups[-1] != "u_r":
            wanted[f"{text} and {groups[-1]} reversed"] = again = turned.copy()
            again[:, at[groups[-1]] : at[groups[-1]] + 3] *= -1.0
    results = {name: other.samples for name, other in ends._otherwise(record)}
    assert list(results) == list(wanted) or set(results) == set(wanted)
    for name, samples in wanted.items():
        assert results[name].tolist() == samples.tolist(), name
    assert record.samples.tolist() == CHANCE[:4].tolist()


def contradicted(monkeypatch, own, others, least_at=2, limit=0.05, voltage=1000.0, part=None):
    """The report about ends that disagree by `own` (V) as wired, and by `others` with other wirings."""
    record = types.SimpleNamespace(
        group=lambda name: np.full((4, 3), voltage if name == "u_s" else 0.5 * voltage), by=own, part=own
    )
    work = types.SimpleNamespace(
        grid=np.linspace(0.0, 4.0, 5), record=record, first=10, count=40, p=LocatorParams(f_threshold=100.0),
        curves=np.full((3, 5), 2.0 * own) - own * (np.arange(5) == least_at))  # fmt: skip
    seen = []

    def apart(of, changed_record, stretch):
        seen.append(stretch)
        by = changed_record.part if stretch == (10, 10) else changed_record.by
        return lambda x: np.full(len(x), float(by))

    monkeypatch.setattr(ends, "_apart", apart)
    wired = [(name, types.SimpleNamespace(by=by, part=by if part is None else part)) for name, by in others.items()]
    monkeypatch.setattr(ends, "_otherwise", lambda record: iter(wired))
    reported = ends.contradiction(work, limit)
    assert set(seen) <= {(10, 40), (10, 10)}
    return reported


APART = "contradictory: the ends disagree by {} V or more wherever the fault may be, "
WIRED = APART + "by {} V with {}: wired so?"
NOBODY = (
    APART + "{} % of their voltage (at most 5 % expected), and no exchange of signs or phases explains it: "
    "the data of another line, clocks, ratios?"
)


@pytest.mark.parametrize(
    ("own", "others", "more", "reported"),
    [
        (1.0, {"x": 0.0}, {}, ""),  # differences below a thousandth of the voltage are not checked
        (1.01, {"x": 0.101}, {}, WIRED.format(1.01, 0.101, "x")),
        (40.0, {"x": 4.1}, {}, ""),  # another wiring must fit ten times better
        (40.0, {"x": 4.0}, {}, WIRED.format(40, 4, "x")),
        (40.0, {"x": 4.0, "y": 3.0}, {}, WIRED.format(40, 3, "y")),
        (50.0, {"x": 9.0}, {}, ""),  # the ends may differ by a twentieth of the voltage
        (51.0, {"x": 9.0}, {}, NOBODY.format(51, 5.1)),
        (51.0, {}, {}, NOBODY.format(51, 5.1)),
        (40.0, {"x": 1.0}, {"part": 13.4}, ""),  # within a part of the window it must fit three times better
        (39.0, {"x": 1.0}, {"part": 13.0}, WIRED.format(39, 1, "x")),
        (200.0, {"x": 99.0}, {"least_at": 0}, "contradictory: with x the ends are those of a healthy line: wired so?"),
        (200.0, {"x": 99.0}, {"least_at": 4}, "contradictory: with x the ends are those of a healthy line: wired so?"),
        (200.0, {"x": 100.0}, {"least_at": 4}, NOBODY.format(200, 20)),
        (200.0, {"x": 99.0}, {"least_at": 1}, NOBODY.format(200, 20)),
    ],
)
def test_the_report_about_disagreeing_ends_is_as_expected(monkeypatch, own, others, more, reported):
    assert contradicted(monkeypatch, own, others, **more) == reported


def test_the_minimum_along_the_line_is_searched_between_the_points_of_the_grid():
    work = types.SimpleNamespace(grid=np.linspace(0.0, 10.0, 6))
    for place in (0.0, 0.7, 5.1, 9.0, 10.0):
        least = ends._least(work, lambda x, place=place: (x - place) ** 2)
        assert least == pytest.approx(0.0, abs=1e-3)
    assert ends._least(work, lambda x: np.abs(x - 5.0), np.array([9.0, 9.0, 9.0, 9.0, 9.0, 0.25])) == 0.25
    assert ends._least(
        work, lambda x: np.abs(x - 5.0) - 3.0, np.array([9.0, 9.0, 8.0, 9.0, 9.0, 9.0])
    ) == pytest.approx(-3.0, abs=0.02)


def test_the_disagreement_of_the_ends_is_the_mean_over_the_modes():
    record = long_record(300, start=0.02)
    p = LocatorParams(n_grid=5, window_start=0.024, window_end=0.026)
    work = Objective(record, p)
    result = ends._apart(work, record, (work.first, work.count))(work.grid)
    assert result.tolist() == pytest.approx(work.curves.mean(axis=0).tolist(), rel=1e-12)


# The simulated line ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["AG", "BG", "CG", "AB", "BC", "CA", "ABG", "BCG", "CAG", "ABC", "ABCG"])
def test_the_fault_branch_by_nodal_equations(kind):
    """Conductances to a star point, and from it to ground; each set of phases that may be closed."""
    p = build(RigParams, {"fault.type": kind, "fault.rf_ohm": 4.0, "fault.x_km": 30.0})
    net = network(p)
    letters = ["ABC".index(c) for c in kind if c != "G"]
    assert list(phases(kind)) == letters
    assert grounded(kind) == ("G" in kind)
    behind = CLARKE.T @ np.diag(1.0 / (net.lines.conductance[:3] + net.lines.conductance[3:])) @ CLARKE
    for bits in range(8):
        closed = [ph for ph in range(3) if bits >> ph & 1]
        wanted = np.zeros((3, 3))
        if set(closed) <= set(letters) and (len(closed) > 1 or (closed and "G" in kind)):
            n = len(closed)
            y = np.zeros((n + 1, n + 1))  # terminals of the phases, and the star point
            y[:n, :n] = np.linalg.inv(behind[np.ix_(closed, closed)]) + 0.25 * np.eye(n)
            y[:n, n] = y[n, :n] = -0.25
            y[n, n] = 0.25 * n + (1e3 if "G" in kind else 0.0)
            for k, ph in enumerate(closed):
                source = np.zeros(n + 1)
                source[:n] = np.linalg.inv(behind[np.ix_(closed, closed)])[:, k]
                u = np.linalg.solve(y, source)
                for m, to in enumerate(closed):
                    wanted[to, ph] = 0.25 * (u[m] - u[n])
        np.testing.assert_allclose(net.closed[bits], wanted, rtol=1e-9, atol=1e-12)


def test_the_numbers_of_the_stepped_network():
    p = build(RigParams, {"fault.x_km": 30.0, "fault.t_on": 0.0200004, "fault.t_off": 0.0300006})
    net = network(p)
    assert (net.on, net.off, net.omega, net.step) == (20001, 30001, 100.0 * math.pi, 1e-6)
    assert network(build(RigParams, {"fault.t_on": 0.02, "fault.t_off": 0.03})).on == 20000
    assert network(build(RigParams, {"fault.type": "none"})).on == 2**62
    for k, (r, x) in enumerate(((2.33, 26.6), (1.31, 15.0), (1.31, 15.0))):
        reactance = 2.0 * x / (100.0 * math.pi) / 1e-6  # 2 L/h
        assert net.source_conductance[k] == pytest.approx(1.0 / (r + reactance))
        assert net.source_keep[k] == pytest.approx(reactance - r)
    assert net.emf.tolist() == [[400e3, 0.0], [400e3, math.radians(-10.0)]]
    line = p.line
    for k, (r, l, c) in enumerate(((line.r0, line.l0, line.c0), *2 * ((line.r1, line.l1, line.c1),))):  # noqa: E741
        for first, length in ((0, 30.0), (3, 90.0)):
            assert net.lines.conductance[first + k] == pytest.approx(1.0 / (math.sqrt(l / c) + r * length / 4.0))
    least = build(RigParams, {"fault.rf_ohm": 0.0, "fault.x_km": 30.0})
    tiny = build(RigParams, {"fault.rf_ohm": LEAST_RESISTANCE, "fault.x_km": 30.0})
    assert network(least).closed.tolist() == network(tiny).closed.tolist()


def plain_steps(monkeypatch):
    """The compiled step as a plain function; its allocated memory is filled with NaN."""
    room = types.SimpleNamespace(**vars(np) | {"empty": lambda shape: np.full(shape, np.nan)})
    monkeypatch.setattr(simulation, "np", room)
    step = simulation.advance.py_func
    compiled = [name for name, value in vars(simulation).items() if isinstance(value, Jit)]
    assert {"histories", "store", "together", "filter_steps", "_fault"} < set(compiled)
    interpreted(monkeypatch, simulation, *compiled)
    return step


@pytest.mark.parametrize("phase", [(0, 0, 0), (1, 2, 2), (1, 1, 2), (1, 1, 1)])
def test_a_step_of_the_network_is_one_system_of_linear_equations(monkeypatch, phase):
    """In phases: sources behind R and L by the trapezoidal rule, waves that arrive at the ends, currents that add up to
    zero.
    """
    p = build(
        RigParams, {"fault.type": "ABCG", "fault.rf_ohm": 7.0, "fault.x_km": 30.0, "measurement.profile": "raw1m"}
    )
    line = FaultedLine(p)
    net, chance, n = line.net, np.random.default_rng(11), 25_000  # tick between closing and opening
    net = net._replace(on=n if any(phase) else n + 1)
    state = line.state._replace(phase=np.array(phase))
    state.ring[:] = chance.normal(0.0, 300.0, state.ring.shape)
    state.source_current[:], state.source_voltage[:] = chance.normal(0.0, 9.0, (2, 2, 3))
    state.fault_current[:], state.peak[:] = float(any(phase)), [0.0, 1e9, 0.0]
    ring, i0, u0 = state.ring.copy(), state.source_current.copy(), state.source_voltage.copy()
    history = np.empty((6, 2, 1))
    bergeron.histories.py_func(net.lines, ring, n, history)
    h = history[:, :, 0]
    plain_steps(monkeypatch)(net, line.chain, CLARKE, state, n - 1, 1)
    g, C = net.lines.conductance, CLARKE
    closed = [k for k in range(3) if phase[k] == 1]
    m = len(closed)
    # Unknowns: modes at S, F and R; sources; star point; fault currents.
    A, b = np.zeros((16 + m, 16 + m)), np.zeros(16 + m)
    angles = 100.0 * math.pi * n * 1e-6 + np.array([0.0, math.radians(-10.0)])
    for end, node in ((0, 0), (1, 6)):
        emf = 400e3 * np.array([0.0, math.cos(angles[end]), math.sin(angles[end])])
        for mode in range(3):
            r, x = (2.33, 26.6) if mode == 0 else (1.31, 15.0)
            lh = x / (100.0 * math.pi) / 1e-6  # L/h
            row = 9 + 3 * end + mode
            A[row, row], A[row, node + mode] = lh + 0.5 * r, 0.5  # L (i - i0)/h + R (i + i0)/2 = (e - u + before)/2
            b[row] = (lh - 0.5 * r) * i0[end, mode] + 0.5 * (emf[mode] + u0[end, mode])
            A[node + mode, row] = -1.0
            A[node + mode, node + mode] = g[3 * end + mode]
            b[node + mode] = -h[3 * end + mode, end]
    for mode in range(3):
        A[3 + mode, 3 + mode] = g[mode] + g[3 + mode]
        b[3 + mode] = -h[mode, 1] - h[3 + mode, 0]
        for k, ph in enumerate(closed):
            A[3 + mode, 16 + k] = C[mode, ph]
    A[15, 15] = 1e3  # the star point to ground
    for k, ph in enumerate(closed):
        A[15, 16 + k] = -1.0
        A[16 + k, 3:6], A[16 + k, 15], A[16 + k, 16 + k] = C[:, ph], -1.0, -7.0
    x = np.linalg.solve(A, b)
    current = np.zeros(3)
    current[closed] = x[16:]
    np.testing.assert_allclose(state.fault_current, current, atol=1e-6)
    np.testing.assert_allclose(state.source_current.ravel(), x[9:15], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        state.peak, np.maximum([0.0, 1e9, 0.0], np.abs(current)) if any(phase) else [0.0, 1e9, 0.0]
    )
    for end, node in ((0, 0), (1, 6)):
        u = x[node : node + 3]
        i = g[3 * end : 3 * end + 3] * u + h[3 * end : 3 * end + 3, end]
        np.testing.assert_allclose(
            state.measured[6 * end : 6 * end + 6], [*(C.T @ u), *(C.T @ i)], rtol=1e-8, atol=1e-6
        )
    voltage = np.array(
        [[x[k % 3 + 6 * 0] if k < 3 else x[3 + k % 3], x[3 + k % 3] if k < 3 else x[6 + k % 3]] for k in range(6)]
    )
    bergeron.store.py_func(net.lines, ring, n, voltage[:, :, None], history, np.empty((6, 2, 1)))
    np.testing.assert_allclose(state.ring, ring, rtol=1e-8, atol=1e-8)


def test_phases_close_and_open_at_the_expected_steps(monkeypatch):
    """All phases close together; after the end each one opens when its current first changes sign."""
    p = build(RigParams, {"fault.type": "ABG", "fault.rf_ohm": 2.0, "fault.x_km": 30.0})
    line = FaultedLine(p)
    net = line.net._replace(on=100, off=200)
    state = line.state

    def step(n, volts):
        block = np.array(volts).reshape(3, 1)
        simulation._fault.py_func(net, state, n, block)
        assert block[:, 0].tolist() == state.fault_current.tolist()
        return state.phase.tolist(), state.fault_current.tolist()

    before = step(99, [1e4, 2e4, 3e4])
    assert before == ([0, 0, 2], [0.0, 0.0, 0.0])
    phase, current = step(100, [1e4, 2e4, 3e4])
    assert phase == [1, 1, 2]
    np.testing.assert_allclose(current, net.closed[0b011] @ [1e4, 2e4, 3e4])
    assert current[2] == 0.0
    largest = [abs(c) for c in current]
    phase, current = step(199, [-1e3, 2e3, 0.0])  # a change of sign before this time is ignored
    assert phase == [1, 1, 2]
    np.testing.assert_allclose(current, net.closed[0b011] @ [-1e3, 2e3, 0.0])
    phase, current = step(200, [-1e3, 2e3, 0.0])
    assert phase == [1, 1, 2]
    # The current of the first phase changes its sign, so that phase opens; the second one continues.
    phase, current = step(201, [3e3, 2e3, 0.0])
    assert phase == [2, 1, 2]
    np.testing.assert_allclose(current, net.closed[0b010] @ [3e3, 2e3, 0.0])
    assert state.opened.tolist() == pytest.approx([201e-6, 0.0, 0.0])
    phase, current = step(202, [3e3, 0.0, 0.0])  # a current of zero counts as a change of sign
    assert (phase, current) == ([2, 2, 2], [0.0, 0.0, 0.0])
    assert state.opened.tolist() == pytest.approx([201e-6, 202e-6, 0.0])
    assert state.peak.tolist() == pytest.approx(largest)
    assert step(203, [9e9, 9e9, 9e9])[1] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("profile", ["m20k", "raw1m"])
def test_steps_computed_in_blocks_equal_single_ones(profile):
    """Blocks of any length: a fault that closes and opens within one, a ring that wraps around, a late clock."""
    parameters = {"fault.type": "ABG", "fault.x_km": 12.0, "fault.t_on": 2.13e-4, "fault.t_off": 4.01e-4,
             "measurement.profile": profile, "measurement.shift_us_r": 90.0}  # fmt: skip
    one, several, whole = (FaultedLine(build(RigParams, parameters)) for _ in range(3))
    for k in range(12_000):
        advance(one.net, one.chain, CLARKE, one.state, k, 1)
    whole.advance(12_000)
    for steps in itertools.cycle((1, 7, 64, 65, 300)):
        several.advance(min(steps, 12_000 - several.k))
        if several.k == 12_000:
            break
    assert one.state.phase.tolist() == [2, 2, 2]
    for a, b, c in zip(one.state, several.state, whole.state, strict=True):
        assert a.tobytes() == b.tobytes() == c.tobytes()


def test_a_record_has_a_row_every_so_many_steps(monkeypatch):
    moved = []

    def advance(net, chain, transform, state, k, steps):
        moved.append((k, steps))
        state.measured[:] += 1.0
        state.fault_current[:] += 10.0

    monkeypatch.setattr(simulation, "advance", advance)
    state = types.SimpleNamespace(measured=np.zeros(12), fault_current=np.zeros(3))
    out = np.empty((4, 15))
    simulation.record.py_func(None, None, None, state, 50, out)
    assert moved == [(0, 50), (50, 50), (100, 50)]
    assert out[:, 0].tolist() == out[:, 11].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert out[:, 12].tolist() == out[:, 14].tolist() == [0.0, 10.0, 20.0, 30.0]


@pytest.mark.parametrize("shift", [0.0, 30.0, -45.0])
def test_the_first_sample_is_that_of_the_steady_state_at_each_clock(shift):
    p = build(
        RigParams, {"measurement.profile": "raw20k", "measurement.shift_us_r": shift, "measurement.ratio_err.i_s": 0.01}
    )
    line, result = FaultedLine(p), steady(p)
    late = {"s": max(0.0, -shift), "r": max(0.0, shift)}
    wanted = []
    for phasor, end, ratio in (
        (result.u[0], "s", 1.0),
        (result.i[0], "s", 1.01),
        (result.u[2], "r", 1.0),
        (result.i[1], "r", 1.0),
    ):
        for phase in range(3):
            angle = -2.0 * math.pi / 3.0 * phase - 100.0 * math.pi * 1e-6 * late[end]
            wanted.append(ratio * abs(phasor) * math.cos(np.angle(phasor) + angle))
    assert line.state.measured.tolist() == pytest.approx(wanted, rel=1e-9)
    line.advance(20)  # after 20 steps the delayed measurements are still from before t = 0
    for k, (phasor, end, ratio) in enumerate(
        ((result.u[0], "s", 1.0), (result.i[0], "s", 1.01), (result.u[2], "r", 1.0), (result.i[1], "r", 1.0))
    ):
        angle = 100.0 * math.pi * 1e-6 * (20 - late[end])
        assert line.state.measured[3 * k] == pytest.approx(
            ratio * abs(phasor) * math.cos(np.angle(phasor) + angle), rel=1e-6
        )
    assert line.prefault_rms[3:6].tolist() == pytest.approx([1.01 * abs(result.i[0]) / math.sqrt(2.0)] * 3)
    assert line.k == 20


def test_the_level_of_the_noise_is_so_many_decibels_below_each_channel():
    quiet, noisy = (FaultedLine(build(RigParams, {"measurement.noise_snr_db": db})) for db in (None, 40.0))
    assert quiet.noise_level().tolist() == [0.0] * 12
    assert noisy.noise_level().tolist() == pytest.approx((0.01 * noisy.prefault_rms).tolist())
    assert quiet.noise(None, 3).tolist() == [[0.0] * 12] * 3
    drawn = noisy.noise(np.random.default_rng(1), 2)
    wanted = np.random.default_rng(1).standard_normal((2, 12)) * noisy.noise_level()
    assert drawn.tolist() == wanted.tolist()


def test_the_filter_is_that_of_scipy_from_its_steady_state_on():
    sos, step, omega = measurement.butterworth(0.06), 1e-4, 100.0 * math.pi
    other = butter(4, 0.12, output="sos")
    phasors = np.array([3.0 - 1.0j, 0.5j])
    state, filtered = measurement.steady_filter(sos, phasors, omega, step)
    t = step * np.arange(-4000, 40)
    waves = (phasors[:, None] * np.exp(1j * omega * t)).real
    wanted = sosfilt(other, waves, axis=1)[:, 4000:]  # after the filter has settled
    assert filtered.real.tolist() == pytest.approx(wanted[:, 0].tolist(), rel=1e-9)
    x = waves[:, 4001:].T.copy()
    for block in (x[:1], x[1:20], x[20:]):
        measurement.filter_steps.py_func(sos, state, block)
    np.testing.assert_allclose(x.T, wanted[:, 1:], rtol=0.0, atol=1e-9)
    none, x = np.empty((0, 5)), np.array([[1.0, 2.0]])
    measurement.filter_steps.py_func(none, np.empty((2, 0, 2)), x)
    assert x.tolist() == [[1.0, 2.0]]


@pytest.mark.parametrize("profile", list(RATES))
def test_the_chain_of_each_profile(profile):
    p = build(
        RigParams, {"measurement.profile": profile, "measurement.shift_us_r": -30.0, "measurement.ratio_err.u_r": 0.02}
    )
    result = measurement.chain(p)
    assert result.sos.shape == ((2, 5) if profile.startswith("m") else (0, 5))
    if profile.startswith("m"):
        rows = butter(4, RATES[profile] / 5.0, fs=1e6, output="sos")  # scipy has the whole gain in the first section
        assert np.prod(result.sos[:, :3].sum(axis=1)) == pytest.approx(np.prod(rows[:, :3].sum(axis=1)), rel=1e-6)
        poles = np.sort_complex(np.concatenate([np.roots([1.0, *row[3:]]) for row in result.sos]))
        assert np.abs(poles - np.sort_complex(np.concatenate([np.roots(r[3:]) for r in rows]))).max() < 1e-9
    assert result.ratio.tolist() == [1.0, 1.0, 1.02, 1.0]
    assert result.delay.tolist() == [30, 0]
    assert (p.decimation, p.samples, p.shift) == (1_000_000 // RATES[profile], round(0.06 * RATES[profile]), -30)


NEAR = (
    "fault.x_km = {} km: expected 1.108 to 118.9 km of a line of 120 km, so that waves need 4 steps or more "
    "for each section"
)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"step": 3e-6}, "step = 3e-06 s does not divide the sampling period 5e-05 s of m20k"),
        ({"step": 1e-4}, "step = 0.0001 s does not divide the sampling period 5e-05 s of m20k"),
        ({"step": 2e-6, "measurement.shift_us_r": 3.0}, "shift_us_r = 3 us is not whole steps of 2e-06 s"),
        ({"fault.t_off": 0.02}, "t_off = 0.02 s is not after t_on = 0.02 s"),
        ({"fault.x_km": 1.1}, NEAR.format(1.1)),
        ({"fault.x_km": 118.95}, NEAR.format(118.95)),
    ],
)
def test_impossible_lines_are_refused(parameters, text):
    with pytest.raises(ParameterError) as refused:
        build(RigParams, parameters)
    assert text in str(refused.value)


def test_a_row_of_the_study(monkeypatch):
    seen = []
    answers = iter([Location(Status.OK, 49.0, 2.0, 30.0, 3, 7), Location(Status.NO_FAULT, None, 4.0, 5.0, 1, 9)])
    monkeypatch.setattr(study, "_simulated", lambda settings: seen.append(dict(settings)) or "record")
    monkeypatch.setattr(study, "locate", lambda record, p: seen.append((record, p)) or next(answers))
    case = Case("AB", 50.0, 5.0)
    row = study.run_case(case, {"measurement.profile": "m4k"}, {"algorithm": "phasor", "line.length": 200.0})
    fault = {"fault.type": "AB", "fault.x_km": 50.0, "fault.rf_ohm": 5.0}
    assert seen[0] == fault | {"measurement.profile": "m4k"}
    assert seen[1] == ("record", build(LocatorParams, {"algorithm": "phasor", "line.length": 200.0}))
    reported = ("AB", 50.0, 5.0, "phasor", "m4k", "ok", 49.0, -0.5, 2.0, 30.0, 3, 7)
    assert tuple(vars(row).values())[:-1] == reported
    assert row.error_m == pytest.approx(-1000.0)
    lost = study.run_case(case, {}, {})
    assert (lost.profile, lost.status, lost.located_km, lost.error_percent) == ("m20k", "no_fault", None, None)
    assert math.isnan(lost.error_m)
    assert 0.0 <= lost.cpu_s < 1.0
    lines = study.as_csv([row, lost]).split("\n")
    assert (
        lines[0] == "type,x_km,rf_ohm,method,profile,status,located_km,error_percent,f_min,f_max,mode,evaluations,cpu_s"
    )
    assert lines[2].startswith("AB,50.0,5.0,brent,m20k,no_fault,,,4.0,5.0,1,9,")
    assert lines[3:] == [""]


@pytest.mark.parametrize("words", [["--profile", "raw1m"], ["--methods", "guess"], ["--processes", "two"]])
def test_the_study_takes_known_profiles_and_methods_only(capsys, words):
    with pytest.raises(SystemExit) as ended:
        study_tool.main(words)
    assert ended.value.code == 2
    assert words[-1] in capsys.readouterr().err


# What is shown ------------------------------------------------------------------------------------------------


def test_the_marker_keeps_the_newest_location():
    block = LocationMarker(length=100.0, towers=3, scale=0.5)
    seen, x = (
        [(None, (1.0,) * 6), (0, (25.0, 7.0, 9.0, 1.0, 8.0, 0.5)), (1, (1.0,) * 6), (9, (2.0,) * 6)],
        block.first(),
    )
    for age, reported in seen:
        block.age = lambda name, age=age: age
        x, outputs = block.update(x, 0, location=reported)
        assert outputs == {}
        assert x == (None if age is None else seen[1][1])
    assert block.status(None) == {}
    assert block.status(x) == {"x": (25.0, "km"), "f_min": (7.0, "V"), "scatter": (0.5, "km")}
    conductor, towers = block.markers(None)
    assert conductor.points == ((0.0, 0.0, 0.2), (25.0, 0.0, 0.2), (50.0, 0.0, 0.2))
    assert towers.points == tuple((x, 0.0, z) for x in (0.0, 25.0, 50.0) for z in (0.0, 0.2))
    *same, fault = block.markers(x)
    assert same == [conductor, towers]
    assert (fault.name, fault.kind, fault.points, fault.size, fault.color) == (
        "fault",
        "sphere_list",
        ((12.5, 0.0, 0.2),),
        0.2,
        (0.9, 0.1, 0.1, 1.0),
    )
    assert [(m.frame_id, m.name, m.kind, m.size, m.color) for m in same] == [
        ("line", "conductor", "line_strip", 0.02, (0.5, 0.5, 0.5, 1.0)),
        ("line", "towers", "line_list", 0.02, (0.5, 0.5, 0.5, 1.0)),
    ]


def test_figures_of_a_run_are_those_of_its_last_answer():
    signals = {
        "location/0": (np.arange(2.0), np.array([10.0, 49.5])),
        "verdict/0": (np.arange(2.0), np.array([2.0, 1.0])),
        "line/fault_current/x": (np.arange(3.0), np.array([1.0, -7.0, 3.0])),
        "line/fault_current/z": (np.arange(3.0), np.array([1.0, 2.0, 3.0])),
    }
    assert figures.location_error(signals, truth=50.0) == pytest.approx(-500.0)
    assert figures.location_error_percent(signals, truth=50.0, length=200.0) == pytest.approx(0.25)
    messages = [figures.location_status(signals, status=s) for s in ("ok", "at_terminal", "no_fault")]
    assert messages == [0.0, 1.0, 0.0]
    assert figures.locations(signals) == 2.0
    assert [figures.fault_peak(signals, phase=p) for p in "ac"] == [7.0, 3.0]
    with pytest.raises(ValueError, match=r"^no message was recorded on location$"):
        figures.location_error({"location/0": (np.empty(0), np.empty(0))}, truth=1.0)


# The nodes -----------------------------------------------------------------------------------------------------


def test_reports_of_the_locator_are_as_expected():
    node = FaultLocator(truth_km=50.0)
    node._report_location(Location(Status.OK, 50.012, text="fault at 50.0120 km"), None)
    text = "fault at 50.0120 km; error 0.0100 % of the line (12.0 m)"
    assert node.reports == {"ok": (Level.OK, text, 1)}
    node = FaultLocator()
    node._report_location(Location(Status.NO_FAULT, text="none"), types.SimpleNamespace(warning="slow"))
    assert node.reports == {"no_fault": (Level.OK, "none", 1), "rate": (Level.WARN, "slow", 1)}
    node = FaultLocator(truth_km=50.0)
    node._report_location(Location(Status.AT_TERMINAL, 0.0, text="at the end"), types.SimpleNamespace(warning=""))
    text = "at the end; error -41.6667 % of the line (-50000.0 m)"
    assert node.reports == {"at_terminal": (Level.WARN, text, 1)}
    with pytest.raises(
        ParameterError, match=r"waves pass the line of 13 km in 0\.939 samples of 50 us, expected 1 or more"
    ):
        FaultLocator(line={"length": 13.0})


def test_the_locator_answers_a_press_with_the_samples_so_far():
    node = FaultLocator(samples=3)
    x, inputs = node.first(), dict.fromkeys(("u_s", "i_s", "u_r", "i_r"), (1.0, 2.0, 3.0))
    asked = []
    node._answer = lambda x: (asked.append(len(x.rows.newest())) or x, {"verdict": (len(asked),)})
    for t, locate in enumerate([None, (1.0,), (1.0,), (0.0,), (2.0,), None]):
        x, outputs = node.update(x, t * 10**9, locate=locate, **inputs)
        assert bool(outputs) == (t in (1, 4))
    assert asked == [2, 3]
    assert x.rows.newest()[0] == (3.0, *(1.0, 2.0, 3.0) * 4)
    assert node.finish(x, 6 * 10**9, locate=None, **inputs)[1] == {"verdict": (3,)}
    whole = FaultLocator(form="record", samples=3)
    x, ages = whole.first(), iter((None, 0, 1))
    whole.age = lambda name: next(ages)
    for wanted in ((), (1.0,), (1.0,)):
        x, _ = whole.update(x, 0, locate=None, record=(float(len(wanted)),))
        assert x.record == wanted


def test_a_verdict_states_its_basis():
    node = FaultLocator(n_grid=5)
    empty, outputs = node._answer(node.first())
    assert outputs == {"verdict": (float(Status.TOO_SHORT), 0.0, 0.0)}
    assert (empty.answers, empty.result.text) == (1, "a record of 0 samples")
    record = study.simulate(build(RigParams, {"fault.x_km": 30.0}))
    x = node.first()._replace(record=tuple(record.table().ravel()))
    whole = FaultLocator(form="record", samples=1200, n_grid=5)
    _, outputs = whole._answer(x)
    work = Locator(record, whole.p)
    result = work.locate()
    assert outputs["verdict"] == (0.0, float(result.mode), result.f_max)
    scatter = trust._scatter(Locator(record, whole.p.model_copy(update={"mode": str(result.mode)})), result)
    assert outputs["location"] == (
        result.x_km,
        result.f_min,
        result.f_max,
        result.mode,
        result.evaluations,
        pytest.approx(scatter),
    )
    assert outputs["objective"] == (0.0, 30.0, 60.0, 90.0, 120.0, *work.curves.ravel())


def test_the_period_of_a_plant_follows_from_its_profile():
    assert build(LinePlantParams, {"measurement.profile": "m4k"}).period == 1.0 / 4000.0
    assert build(LinePlantParams, {"measurement.profile": "m4k", "period": 2.5e-4}).period == 2.5e-4
    with pytest.raises(ParameterError) as refused:
        build(LinePlantParams, {"measurement.profile": "m4k", "period": 1e-3})
    assert "period = 0.001 s, but m4k samples every 0.00025 s" in str(refused.value)


def test_a_record_of_the_plant_with_its_noise_and_a_new_one_at_a_press():
    plant = LinePlant(
        measurement={"profile": "m4k", "noise_snr_db": 40.0},
        duration=0.001,
        step=1e-6,
        fault={"t_on": 0.0003, "t_off": 0.0008},
    )
    x, rows = plant.first(), []
    line = FaultedLine(plant.p)
    clean = line.run(4)
    for k in range(4):
        noise = np.random.default_rng([0, x.seed]).standard_normal(48)[12 * k : 12 * k + 12] * line.noise_level()
        outputs = plant.outputs(x, 0)
        row = [v for name in ("u_s", "i_s", "u_r", "i_r") for v in outputs[name]]
        assert row == pytest.approx((clean[k, :12] + noise).tolist())
        assert outputs["fault_current"] == pytest.approx(tuple(clean[k, 12:]))
        rows += [k / 4000.0, *row]
        assert ("record" in outputs) == (k == 3)
        x = plant.advance(x, 0, run=(0.0,))
    assert outputs["record"] == pytest.approx(tuple(rows))
    assert (x.k, x.number, x.pressed) == (4, 0, False)
    assert len(x.rows.newest()) == 3
    again = plant.advance(x, 0, run=(1.0,))
    assert (again.k, again.number, again.pressed, again.rows.newest()) == (0, 1, True, [])
    assert plant.reports["run"][:2] == (Level.OK, "a new record begins")
    assert again.seed != x.seed
    held = plant.advance(again, 0, run=(1.0,))
    assert (held.k, held.number, held.pressed) == (1, 1, True)
    assert plant.advance(held, 0, run=None).pressed is False


# `locate` -----------------------------------------------------------------------------------------------


LINE_GIVEN = ["--line", "paper"]


def asked(monkeypatch, *arguments, result=None, error=None):
    """The effect of a command line: the status of the tool, and its calls."""
    called, record = {}, long_record(1200)
    result = result or Location(Status.OK, 30.0, 1.0, 9.0, 1, 5, "fault at 30.0000 km")

    def read(sources, channels, late):
        called["read"] = ([str(s) for s in sources], channels, late)
        if error:
            raise error
        return record

    monkeypatch.setattr(locate_tool, "read", read)
    monkeypatch.setattr(locate_tool, "to_bag", lambda record, path: called.update(bag=str(path)))
    monkeypatch.setattr(locate_tool, "inception", lambda record, frequency: called.update(frequency=frequency) or 0.02)
    window = {"window_start": 0.021, "window_end": 0.03}
    monkeypatch.setattr(locate_tool, "windowed", lambda record, p: p.model_copy(update=window))
    monkeypatch.setattr(locate_tool, "locate", lambda record, p: called.update(p=p) or result)
    confidence = Confidence(0.001, {}, 9.0)
    monkeypatch.setattr(
        locate_tool, "confidence", lambda record, p, of, budget: called.update(budget=budget) or confidence
    )
    return locate_tool._locate(list(arguments)), called


def test_a_command_line_makes_the_expected_calls(monkeypatch, capsys):
    status, called = asked(monkeypatch, "a.cfg", *LINE_GIVEN)
    assert (status, called["read"], called["frequency"]) == (0, (["a.cfg"], [], (0.0, 0.0)), 50.0)
    assert called["p"] == LocatorParams(window_start=0.021, window_end=0.03)
    assert called["budget"] == ErrorBudget()
    assert "bag" not in called
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "fault at 30.000 km from S (90.000 km from R), standard uncertainty 1.0 m"
    assert printed[-1] == "  window 0.021 to 0.03 s, from the change at 0.02 s"
    more = ["s.cfg", "r.cfg", *LINE_GIVEN, "--window", "0.022", "0.035", "--late", "3", "-5", "--channels", "a,b,,c",
            "--bag", "there", "--set", "algorithm=phasor", "--set", "frequency=60", "--set", "line.length=100",
            "--error", "ratio=0.02", "--error", "sync_us=7"]  # fmt: skip
    status, called = asked(monkeypatch, *more)
    assert called["read"] == (["s.cfg", "r.cfg"], ["a", "b", "c"], (pytest.approx(3e-6), pytest.approx(-5e-6)))
    assert called["bag"] == "there"
    parameters = {
        "algorithm": "phasor",
        "frequency": 60.0,
        "line.length": 100.0,
        "window_start": 0.022,
        "window_end": 0.035,
    }
    assert called["p"] == build(LocatorParams, parameters)
    assert called["budget"] == ErrorBudget(ratio=0.02, sync_us=7.0)
    assert "frequency" not in called
    assert capsys.readouterr().out.splitlines()[-1] == "  window 0.022 to 0.035 s, as set by --window"


def test_the_tool_ends_with_the_expected_status(monkeypatch, capsys):
    lost = Location(Status.NO_FAULT, text="no_fault: nothing")
    status, called = asked(monkeypatch, "a.cfg", *LINE_GIVEN, result=lost)
    assert (status, "budget" in called) == (1, False)
    assert capsys.readouterr().out.splitlines()[0] == "no_fault: nothing"
    status, _ = asked(monkeypatch, "a.cfg", *LINE_GIVEN, error=RecordError(Status.GAP, "gap at 2 s"))
    assert (status, capsys.readouterr().err) == (1, "gap at 2 s\n")
    for error, kind in ((ComtradeFileError("a.cfg: no"), ScenarioError), (KeyError("no topic"), RunError)):
        with pytest.raises(kind, match=f"^{error.args[0]}$"):
            asked(monkeypatch, "a.cfg", *LINE_GIVEN, error=error)
    with pytest.raises(ScenarioError, match="n_grid"):
        asked(monkeypatch, "a.cfg", *LINE_GIVEN, "--set", "n_grid=2")
    with pytest.raises(ScenarioError, match="ratio"):
        asked(monkeypatch, "a.cfg", *LINE_GIVEN, "--error", "ratio=2")
    with pytest.raises(ScenarioError, match=r"^'mode=2': mode is 1 already$"):
        asked(monkeypatch, "a.cfg", *LINE_GIVEN, "--set", "mode=1", "--set", "mode=2")
    for wrong in (["--window", "1"], ["--late", "x", "1"], []):
        with pytest.raises(SystemExit):
            asked(monkeypatch, *(["a.cfg"] if wrong else []), *LINE_GIVEN, *wrong)


def test_pictures_are_drawn_in_the_requested_folder(monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(pictures, "waveforms", lambda record, p, path: drawn.append(path.name))
    monkeypatch.setattr(
        pictures, "objective", lambda record, p, result, path, truth: drawn.append((path.name, result.x_km, truth))
    )
    asked(monkeypatch, "a.cfg", *LINE_GIVEN, "--pictures", str(tmp_path / "new" / "there"), "--truth", "31.5")
    assert drawn == ["waveforms.png", ("objective.png", 30.0, 31.5)]
    assert (tmp_path / "new" / "there").is_dir()
    asked(monkeypatch, "a.cfg", *LINE_GIVEN)
    assert len(drawn) == 2


def test_a_record_in_a_bag_as_streams_or_whole(tmp_path):
    record = long_record(40)
    locate_tool.to_bag(record, tmp_path / "bag")
    again = locate_tool.read([tmp_path / "bag"])
    assert (again.start, again.rate, again.samples.tolist()) == (0.0, 20_000.0, record.samples.tolist())
    late = locate_tool.read([tmp_path / "bag"], (), (0.0, 50e-6))
    assert late.samples.tolist() == np.hstack([record.samples[:39, :6], record.samples[1:, 6:]]).tolist()
    port = record_port(40)
    recording = Recording([(port.topic, port.msgtype)])
    recording.add(0, 10**9, port.layout().encode(10**9, tuple(record.table().ravel())))
    write_bag(tmp_path / "whole", recording)
    for late_by in ((0.0, 0.0), (50e-6, 50e-6)):
        assert locate_tool.read([tmp_path / "whole"], (), late_by).samples.tolist() == record.samples.tolist()
    assert locate_tool.read([tmp_path / "whole"], (), (0.0, 50e-6)).samples.tolist() == late.samples.tolist()


@pytest.mark.parametrize(
    ("text", "options", "wanted"),
    [
        (
            "length: 90\nr1: 0.03\nl1: 1e-3\nc1: 1e-8\n",
            {},
            {"line.length": 90, "line.r1": 0.03, "line.l1": 1e-3, "line.c1": 1e-8},
        ),
        (
            "r1: 0.03\nl1: 1e-3\nc1: 1e-8\n",
            {"line.length": 7.0, "mode": "1"},
            {"line.length": 7.0, "line.r1": 0.03, "line.l1": 1e-3, "line.c1": 1e-8},
        ),
        (
            "length: 90\nr1: 0.03\nl1: 1e-3\nc1: 1e-8\n",
            {"line.r1": 0.5},
            {"line.length": 90, "line.r1": 0.5, "line.l1": 1e-3, "line.c1": 1e-8},
        ),
    ],
)
def test_the_data_of_a_line_of_a_file_and_of_options(tmp_path, text, options, wanted):
    (tmp_path / "line.yaml").write_text(text)
    assert line_data(str(tmp_path / "line.yaml"), options) == wanted
    paper = {"line.length": 120.0, "line.r1": 0.0275, "line.l1": 1.00268e-3, "line.c1": 1.3e-8}
    assert line_data("paper", {}) == paper
    assert line_data(None, wanted) == wanted


def test_missing_data_of_a_line_are_reported(tmp_path):
    with pytest.raises(ScenarioError) as refused:
        line_data(None, {"line.r1": 1.0, "line.c1": 1.0})
    text = (
        "the line's length, l1 are missing: expected --line FILE (YAML: length in km, r1 in ohm/km, l1 in H/km, "
        "c1 in F/km), --line paper for that of the paper, or --set line.length=... line.l1=..."
    )
    assert str(refused.value) == text
    (tmp_path / "l.yaml").write_text("- 1\n")
    for name, words in (
        (str(tmp_path / "l.yaml"), "expected length, r1, l1, c1, got [1]"),
        (str(tmp_path / "no.yaml"), "No such file"),
    ):
        with pytest.raises(ScenarioError) as refused:
            line_data(name, {})
        assert str(refused.value).startswith(f"--line {name}: ")
        assert words in str(refused.value)
    (tmp_path / "l.yaml").write_text("length: -1\n")
    with pytest.raises(ParameterError, match="length"):
        line_data(str(tmp_path / "l.yaml"), {})


def test_a_fault_may_change_while_the_line_runs():
    """Before it begins that is the same as from the start; while it lasts the current falls from then on."""
    bare = {"figures": {}, "expect": {}, "claims": {}, "requirements": {}, "plots": ()}
    scenario = load_scenario("fault_location").changed(duration=0.035).having(**bare)

    def current(**fault):
        at = fault.pop("at", None)
        values = {f"line_plant.fault.{name}": value for name, value in fault.items()}
        changes = ({"at": at, "set": values},) if at else ()
        run = simulate(scenario.having(changes=changes) if at else scenario, overrides={} if at else values)
        return run.signals["line/fault_current/x"]

    t, plain = current()
    assert np.array_equal(current(at=0.01, rf_ohm=20.0).x, current(rf_ohm=20.0).x)
    assert np.array_equal(current(at=0.01, t_on=0.03, t_off=0.04).x, current(t_on=0.03).x)
    later = current(at=0.03, rf_ohm=20.0).x
    assert np.array_equal(later[t < 0.03], plain[t < 0.03])
    assert np.abs(later[t > 0.031]).max() < 0.8 * np.abs(plain[t > 0.031]).max()
    assert not current(at=0.025, t_off=0.026).x[t > 0.0345].any()
