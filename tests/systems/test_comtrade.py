"""COMTRADE files of other recorders: each field of the table, against the comtrade package and closed forms."""

import re
import struct

import comtrade
import numpy as np
import pytest
from softrig_power.fault_location.locate_tool import _budget, _params, _parser
from softrig_power.fault_location.records.comtrade_cfg import COMTRADE, SettingsError, read_settings, sections
from softrig_power.fault_location.records.comtrade_file import ComtradeFileError, read_comtrade
from softrig_power.fault_location.records.record import RecordError, Status

RATE = 4000.0
PHASES = ("A", "B", "C")


def waves(n=400, f=50.0, rate=RATE, late=0.0, channels=12):
    """Twelve sines of a network with different sizes and angles: band limited, so any skew has a closed form."""
    t = np.arange(n) / rate + late
    k = np.arange(channels)
    return 100.0 * (1 + k) * np.sin(2 * np.pi * f * t[:, None] + 0.5 * k)


class File:
    """A record as text and bytes, with fields to change."""

    def __init__(self, folder, name="rec", ends="SR", form="FLOAT32", revision="2013", x=None):
        self.folder, self.name, self.form, self.revision = folder, name, form, revision
        self.x = waves(channels=6 * len(ends)) if x is None else x
        labels = [f"{q}{p}_{e}" for e in ends for q in "VI" for p in PHASES]
        remaining = ["1", "0", "0", "-3.4e38", "3.4e38", "1", "1", "P"]
        self.channels = [[str(k + 1), n, n[1], "", n[0].replace("I", "A"), *remaining] for k, n in enumerate(labels)]
        if revision == "1991":
            self.channels = [c[:10] for c in self.channels]
        self.rates = [f"{RATE:g},{len(self.x)}"]
        self.nrates = str(len(self.rates))
        self.dates = ["02/03/2024,10:00:00.000000"] * 2
        self.tail = ["1.0", "0,0", "4,0"] if revision == "2013" else ["1.0"] if revision == "1999" else []
        self.n = np.arange(1, len(self.x) + 1)
        self.us = np.round(np.arange(len(self.x)) * 1e6 / RATE).astype(np.int64)
        self.frequency = "50"

    def cfg(self):
        count = len(self.channels)
        head = "station,device" + (f",{self.revision}" if self.revision != "1991" else "")
        lines = [head, f"{count},{count}A,0D", *map(",".join, self.channels), self.frequency, self.nrates, *self.rates]
        return "\r\n".join([*lines, *self.dates, self.form, *self.tail]) + "\r\n"

    def dat(self):
        if self.form == "ASCII":
            rows = zip(self.n, self.us, self.x.tolist(), strict=True)
            return "".join(",".join([str(n), str(t), *(f"{v:.9g}" for v in x)]) + "\r\n" for n, t, x in rows).encode()
        kind = {"BINARY": "<i2", "BINARY32": "<i4", "FLOAT32": "<f4"}[self.form]
        table = np.zeros(len(self.x), dtype=[("n", "<u4"), ("t", "<u4"), ("x", kind, (self.x.shape[1],))])
        table["n"], table["t"] = self.n, self.us
        table["x"] = self.x if self.form == "FLOAT32" else np.round(self.x)
        return table.tobytes()

    def write(self, cfg=".cfg", dat=".dat"):
        path = self.folder / f"{self.name}{cfg}"
        path.write_bytes(self.cfg().encode())
        (self.folder / f"{self.name}{dat}").write_bytes(self.dat())
        return path


def read(file, *more, **how):
    return read_comtrade([file.write(), *(other.write() for other in more)], **how)


@pytest.mark.parametrize("revision", ["1991", "1999", "2013"])
@pytest.mark.parametrize("form", ["ASCII", "BINARY", "BINARY32", "FLOAT32"])
def test_each_form_is_read_as_by_the_comtrade_package(tmp_path, form, revision):
    file = File(tmp_path, form=form, revision=revision)
    for k, channel in enumerate(file.channels):
        channel[5:7] = str(0.5 + k), str(3.0 * k)
    data = read(file)
    other = comtrade.load(str(tmp_path / "rec.cfg"), str(tmp_path / "rec.dat"))
    np.testing.assert_allclose(data.samples, np.transpose(other.analog), rtol=1e-6, atol=1e-3)
    assert (data.rate, data.start, data.frequency) == (RATE, 0.0, 50.0)


# skew ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("skews", [[25] * 12, [0] * 3 + [40] * 3 + [10] * 3 + [-30] * 3, [5 * k for k in range(12)]])
def test_channels_are_shifted_to_one_time_by_their_skew(tmp_path, skews):
    """The channel k was sampled skew_k later: its samples are the sine at these times."""
    x = np.column_stack([waves(late=1e-6 * s)[:, k] for k, s in enumerate(skews)])
    file = File(tmp_path, x=x)
    for channel, skew in zip(file.channels, skews, strict=True):
        channel[7] = str(skew)
    data = read(file)
    right = 100.0 * (1 + np.arange(12)) * np.sin(2 * np.pi * 50.0 * data.t[:, None] + 0.5 * np.arange(12))
    assert len(data.t) > 300
    assert (np.abs(data.samples - right) / (100.0 * (1 + np.arange(12)))).max() < 2e-4


# times ---------------------------------------------------------------------------------------------------------------


def two(tmp_path, **changes):
    s, r = File(tmp_path, "s", "S"), File(tmp_path, "r", "R")
    r.x = 7.0 * r.x
    for key, value in changes.items():
        setattr(r, key, value)
    return s, r


def offset(tmp_path, **changes):
    """Seconds by which R starts after S, from the one sample that both have last."""
    s, r = two(tmp_path, **changes)
    data = read(s, r)
    return data, (len(s.x) - len(data.samples)) / RATE


@pytest.mark.parametrize(
    ("dates", "tail"),
    [
        (["02/03/2024,11:00:00.000000"] * 2, ["1", "+1,+1", "4,0"]),
        (["02/03/2024,04:30:00.000000"] * 2, ["1", "-5h30,-5h30", "4,0"]),
        (["02/03/2024,20:30:00.000000"] * 2, ["1", "+10h30,x", "0,3"]),
        (["02/03/2024,10:00:00.000000"] * 2, ["1", "0,-5", "0,3"]),
        (["02/03/24,10:00:00.000000"] * 2, ["1", "0,0", "0,0"]),
    ],
)
def test_recorders_of_two_zones_are_aligned_by_their_time_codes(tmp_path, dates, tail):
    result, apart = offset(tmp_path, dates=dates, tail=tail)
    assert (apart, len(result.samples)) == (0.0, 400)


def test_stamps_in_nanoseconds_are_kept(tmp_path):
    """R starts 10 ms and 125.25 us later: half a sample and a quarter of a microsecond, which resampling removes."""
    s, r = two(tmp_path, dates=["02/03/2024,10:00:00.010125250"] * 2)
    r.us = r.us * 1000
    x = waves(late=0.01012525, channels=6)
    r.x = x
    data = read(s, r)
    right = 100.0 * (1 + np.arange(6)) * np.sin(2 * np.pi * 50.0 * data.t[:, None] + 0.5 * np.arange(6))
    assert (np.abs(data.samples[:, 6:] - right) / (100.0 * (1 + np.arange(6)))).max() < 2e-4
    assert "R resampled" in data.note


def test_old_dates_have_the_month_first(tmp_path):
    assert read_settings(File(tmp_path, revision="1991").cfg()).start - read_settings(
        File(tmp_path, revision="1999").cfg()
    ).start == pytest.approx(-28 * 86400e9)  # read as 3 February 2024 instead of 2 March


@pytest.mark.parametrize(
    ("code", "clock"), [("F", "is not reliable"), ("6", r"within 0\.0001 s only"), ("B", "within 10 s")]
)
def test_clocks_that_are_not_good_enough_are_refused_for_two_recorders(tmp_path, code, clock):
    s, r = two(tmp_path, tail=["1", "0,0", f"{code},0"])
    with pytest.raises(RecordError, match=clock) as refused:
        read(s, r)
    assert refused.value.status == Status.UNSYNCHRONISED
    one = File(tmp_path)
    one.tail = r.tail
    assert read(one).rate == RATE  # two records of one recorder share its clock


def test_the_stated_clock_error_enters_the_budget_and_the_frequency_is_the_recorders(tmp_path):
    s, r = two(tmp_path, tail=["1", "0,0", "5,0"], frequency="60")
    s.frequency = "60"
    data = read(s, r)
    assert (data.sync, data.frequency) == (1e-5, 60.0)
    options = _parser().parse_args(["x", "--line", "paper"])
    assert _budget(options, data.sync).sync_us == pytest.approx(10.0)
    assert _params(options, data.frequency).frequency == 60.0
    options = _parser().parse_args(["x", "--line", "paper", "--set", "frequency=50.0", "--error", "sync_us=2.0"])
    assert (_budget(options, data.sync).sync_us, _params(options, 60.0).frequency) == (2.0, 50.0)
    s.frequency = "50"
    with pytest.raises(ComtradeFileError, match=r"line frequencies \[50.0, 60.0\] Hz"):
        read(s, r)


def test_a_time_zone_of_only_one_recorder_is_reported(tmp_path):
    s, r = two(tmp_path, tail=["1", "+1,+1", "4,0"])
    s.tail = ["1", ",", "4,0"]
    assert "only one recorder has a time_code" in read(s, r).note
    s.dates = [","] * 2
    with pytest.raises(ComtradeFileError, match="no date of the first sample"):
        read(s, r)


@pytest.mark.parametrize("slow_first", [True, False])
def test_the_part_with_the_fastest_rate_is_used_or_the_one_with_the_trigger(tmp_path, slow_first):
    slow, fast = waves(100, rate=1000.0), waves(400)
    file = File(tmp_path, x=np.vstack([slow, fast] if slow_first else [fast, slow]))
    parts = [("1000", 100), ("4000", 500)] if slow_first else [("4000", 400), ("1000", 500)]
    file.nrates, file.rates = "2", [f"{rate},{last}" for rate, last in parts]
    # Each sample follows the last one by the period of its own rate.
    begin = 99 / 1000.0 + 1 / 4000.0 if slow_first else 0.0
    file.us = np.zeros(500, dtype=int)
    data = read(file)
    assert (data.rate, len(data.samples), data.start) == (RATE, 400, pytest.approx(begin))
    np.testing.assert_allclose(data.samples, fast, rtol=1e-6, atol=1e-3)
    assert "only 4000 Hz is used" in data.note
    assert "not the samples at 1000 Hz" in data.note
    at = 0.05 if slow_first else 0.15
    file.dates[1] = f"02/03/2024,10:00:00.{at * 1e6:06.0f}"
    assert read(file).rate == 1000.0


def test_parts_of_one_rate_are_joined(tmp_path):
    file = File(tmp_path)
    file.nrates, file.rates = "3", ["4000,100", "4000,250", "4000,400"]
    data = read(file)
    assert (len(data.samples), data.note) == (400, "")


def test_without_a_rate_the_times_of_the_data_are_used(tmp_path):
    file = File(tmp_path)
    file.nrates, file.rates, file.us, file.tail[0] = "0", ["0,400"], file.us // 2, "2"
    data = read(file)
    assert (data.rate, len(data.t)) == (RATE, 400)
    file.us[7] = 0xFFFFFFFF
    with pytest.raises(ComtradeFileError, match="no sampling rate, and sample 8 has no time"):
        read(file)


def test_stamps_that_contradict_the_rate_and_missing_numbers_are_reported(tmp_path):
    file = File(tmp_path)
    file.us = file.us * 2
    data = read(file)
    assert data.rate == RATE
    assert "stamps of the data are up to 0.0997 s off the sampling rate" in data.note
    file.n[100:] += 3
    file.rates = ["4000,403"]
    with pytest.raises(RecordError, match=r"gap at 0\.025 s"):
        read(file)


# missing marks -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("form", "revision", "mark"),
    [
        ("ASCII", "1999", "99999"), ("ASCII", "2013", " 99999 "), ("ASCII", "2013", "99999.0"), ("ASCII", "2013", ""),
        ("ASCII", "1991", ""), ("BINARY", "1999", b"\x00\x80"), ("BINARY", "2013", b"\x00\x80"),
        ("BINARY", "1991", b"\xff\xff"), ("BINARY32", "2013", b"\x00\x00\x00\x80"),
        ("FLOAT32", "2013", struct.pack("<I", 0xFF7FFFFF)), ("FLOAT32", "2013", struct.pack("<f", np.nan)),
        ("FLOAT32", "2013", struct.pack("<f", -np.inf)),
    ],
)  # fmt: skip
def test_missing_values_are_never_numbers(tmp_path, form, revision, mark):
    file = File(tmp_path, form=form, revision=revision)
    path, data = file.write(), tmp_path / "rec.dat"
    if form == "ASCII":
        rows = data.read_text().splitlines()
        fields = rows[200].split(",")
        fields[4] = mark
        rows[200] = ",".join(fields)
        data.write_text("\n".join(rows))
    else:
        width = len(mark)
        at = 200 * (8 + 12 * width) + 8 + 2 * width
        content = data.read_bytes()
        data.write_bytes(content[:at] + mark + content[at + width :])
    with pytest.raises(RecordError, match=r"u_s/c is nan at 0\.05 s") as refused:
        read_comtrade([path])
    assert refused.value.status == Status.NON_FINITE


def test_old_binary_data_of_an_unsigned_range(tmp_path):
    """C37.111-1991: 0 to 65534 with an offset."""
    file = File(tmp_path, form="BINARY", revision="1991", x=waves() + 33000.0)
    for channel in file.channels:
        channel[6], channel[8:10] = "-33000", ["0", "65534"]
    data = np.round(file.x).astype("<u2")
    path = file.write()
    table = np.zeros(400, dtype=[("n", "<u4"), ("t", "<u4"), ("x", "<u2", (12,))])
    table["n"], table["x"] = file.n, data
    (tmp_path / "rec.dat").write_bytes(table.tobytes())
    np.testing.assert_allclose(read_comtrade([path]).samples, waves(), atol=0.5)


# names ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "system", ["A B C", "L1 L2 L3", "1 2 3", "R S T", "U V W", "R Y B", "A-N B-N C-N", "AN BN CN", "r s t"]
)
def test_the_phase_names_of_each_country_are_read(tmp_path, system):
    file = File(tmp_path)
    for k, channel in enumerate(file.channels):
        channel[2] = system.split()[k % 3]
    np.testing.assert_allclose(read(file).samples, waves(), rtol=1e-6, atol=1e-3)


def test_letters_of_two_systems_are_not_guessed(tmp_path):
    file = File(tmp_path)
    for k, channel in enumerate(file.channels):
        channel[2] = ("R Y B" if k < 6 else "A B C").split()[k % 3]
    with pytest.raises(ComtradeFileError, match="name the channels"):
        read(file)


def test_repeated_channels_equal_names_and_equal_ends_are_refused(tmp_path):
    file = File(tmp_path)
    names = [c[1] for c in file.channels]
    with pytest.raises(ComtradeFileError, match="channel VA_S occurs twice"):
        read(file, channels=names[:6] * 2)
    file.channels[6][1] = "VA_S"
    with pytest.raises(ComtradeFileError, match="channel VA_S occurs twice"):
        read(file, channels=["VA_S", *names[1:6], *names[7:], "VA_S"])
    file = File(tmp_path, x=np.hstack([waves()[:, :6]] * 2))
    with pytest.raises(ComtradeFileError, match="both ends are the same record"):
        read(file)


@pytest.mark.parametrize(("cfg", "dat"), [(".cfg", ".DAT"), (".CFG", ".dat"), (".Cfg", ".Dat"), (".CFG", ".DAT")])
def test_the_data_file_is_found_in_any_letter_case(tmp_path, cfg, dat):
    assert len(read_comtrade([File(tmp_path).write(cfg, dat)]).samples) == 400


def test_missing_or_ambiguous_data_are_refused(tmp_path):
    path = File(tmp_path).write(".cfg", ".DaT")
    (tmp_path / "rec.Dat").write_bytes(b"")
    with pytest.raises(ComtradeFileError, match=r"several data files beside it: rec\.D"):
        read_comtrade([path])
    for p in tmp_path.glob("*.[dD]*"):
        p.unlink()
    with pytest.raises(ComtradeFileError, match=r"no \.dat file beside it"):
        read_comtrade([path])


@pytest.mark.parametrize(
    "head",
    [
        "--- file type: {} ---\r\n", "--- FILE TYPE: {} ---\r\n", "--- File Type : {} ---\n", "---file type:{}---\r\n",
    ],
)  # fmt: skip
@pytest.mark.parametrize("form", ["ASCII", "FLOAT32"])
@pytest.mark.parametrize("ended", [True, False])
def test_sections_of_a_cff_are_read_in_any_letter_case_and_without_a_last_line_end(tmp_path, head, form, ended):
    file = File(tmp_path, form=form)
    data = file.dat() if ended or form != "ASCII" else file.dat().rstrip(b"\r\n")
    size = f": {len(data)}" if form != "ASCII" else ""
    parts = [head.format("CFG").encode(), file.cfg().encode(), head.format("INF").encode(), b"x=1\r\n",
             head.format("hdr").encode(), head.format(f"DAT {form}{size}").encode(), data]  # fmt: skip
    path = tmp_path / "rec.CFF"
    path.write_bytes(b"".join(parts))
    np.testing.assert_allclose(read_comtrade([path]).samples, waves(), rtol=1e-6, atol=1e-3)
    wrong = b"".join(parts).replace(f"DAT {form}".encode(), b"DAT BINARY")
    path.write_bytes(wrong)
    with pytest.raises(ComtradeFileError, match=f"the section DAT is BINARY, but ft is {form}"):
        read_comtrade([path])


def test_sections_are_found_only_by_their_heads():
    assert [name for name, _, _ in sections(b"--- file type: CFG ---\nx\n--- file type: DAT ASCII ---")] == [
        "CFG",
        "DAT",
    ]
    inside = b"--- file type: DAT BINARY: 28 ---\n\n--- file type: INF ---\nabc--- file type: HDR ---\n"
    assert next((name, len(data)) for name, _, data in sections(inside)) == ("DAT", 28)
    with pytest.raises(SettingsError, match="no line '--- file type: CFG ---'"):
        list(sections(b"hello"))
    with pytest.raises(SettingsError, match="states 9 bytes, but there are 1"):
        list(sections(b"--- file type: DAT BINARY: 9 ---\nx"))


# counts and fields ---------------------------------------------------------------------------------------------------


def test_contradicting_counts_are_reported(tmp_path):
    file = File(tmp_path)
    file.rates = ["4000,410"]
    assert "the data end after 400 of 410 samples" in read(file).note
    file.rates = ["4000,390"]
    result = read(file)
    assert "only the 390 samples that the settings state are used, of 400" in result.note
    assert len(result.samples) == 390
    path = file.write()
    data = tmp_path / "rec.dat"
    data.write_bytes(data.read_bytes() + b"abc")
    assert "3 bytes after the last whole sample" in read_comtrade([path]).note
    file.rates, file.channels[0][8:10] = ["4000,400"], ["-50", "50"]
    assert re.search(r"channel VA_S has 2\d\d samples outside of its min -50 and max 50", read(file).note)
    assert read(File(tmp_path)).note == ""
    file = File(tmp_path, form="ASCII")
    path = file.write()
    data.write_text(data.read_text().replace("\n", ",7\n", 1))
    with pytest.raises(ComtradeFileError, match="line 1 of the data has 15 fields, expected 14"):
        read_comtrade([path])


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (",2013", ",2020", "line 1: rev_year is '2020', expected one of 1991, 1999, 2001, 2013"),
        ("12,12A,0D", "13,12A,0D", "13 channels, but 12 analog and 0 status channels"),
        ("12,12A,0D", "twelve", "expected TT,##A,##D|1 fields, expected 3"),
        ("1,VA_S", "7,VA_S", "line 3: An is 7, expected 1"),
        (",1,0,0,-3.4e38", ",x,0,0,-3.4e38", "line 3: a is 'x', expected a number"),
        (",1,1,P", ",1,1,Q", "PS of channel VA_S is 'Q', expected P or S"),
        ("3.4e38,1,1,P", "3.4e38,1,1", "line 3: 12 fields, expected 13"),
        ("FLOAT32", "FLOAT", "ft is 'FLOAT' .did you mean 'FLOAT32'"),
        ("02/03/2024", "2024-03-02", "start is 2024-03-02,10:00:00.000000, expected dd/mm/yyyy"),
        ("02/03/2024", "31/02/2024", "day is out of range|day"),
        ("0,0\r\n4,0", "east,0\r\n4,0", "time_code is 'east', expected a difference from UTC"),
        ("4,0\r\n", "Q,0\r\n", "tmq_code is 'Q'"),
        ("4,0\r\n", "4,0\r\nmore\r\n", "'more' follows the last field of revision 2013"),
        ("4000,400", "4000", "1 fields, expected 2"),
        ("4000,400", "1e-300,400", "expected 0 or a rate of 0.001 to 1e"),
        ("4000,400", "inf,400", "samp is 'inf', expected a number"),
        ("4000,400", "４000,400", "samp is '４000', expected a number"),
        ("\r\n1\r\n4000,400", "\r\n2\r\n4000,400\r\n1000,300", "rising last sample"),
    ],
)
def test_impossible_fields_are_refused_by_their_line(tmp_path, old, new, why):
    text = File(tmp_path).cfg()
    assert old in text
    with pytest.raises(SettingsError, match=why):
        read_settings(text.replace(old, new, 1))


def test_a_field_without_effect_is_reported_once_if_it_is_not_empty(tmp_path):
    file = File(tmp_path, form="BINARY")
    file.tail = ["1", "0,+2", "0,1"]
    text = file.cfg().replace("12,12A,0D", "13,12A,1D").replace("50\r\n1", "1,trip,,,0\r\n50\r\n1")
    path = file.write()
    path.write_bytes(text.encode())
    table = np.zeros(400, dtype=[("n", "<u4"), ("t", "<u4"), ("x", "<i2", (12,)), ("s", "<u2")])
    table["n"], table["x"] = file.n, np.round(file.x)
    (tmp_path / "rec.dat").write_bytes(table.tobytes())
    note = read_comtrade([path]).note
    for field in ("local_code", "leapsec", "Dn, ch_id, ph, ccbm, y"):
        assert note.count(f"{field} is ignored: ") == 1
    assert set(read_settings(text).ignored) < set(COMTRADE.table)


# the table -----------------------------------------------------------------------------------------------------------

# : For each used field of the table: a part of the settings, and a replacement with another meaning.
CHANGES = {
    "rev_year": (",2013", ",2014"),
    "TT": ("12,12A", "13,12A"),
    "##A": ("12A", "11A"),
    "##D": ("0D", "1D"),
    "An": ("2,VB_S", "3,VB_S"),
    "ch_id": ("VA_S", "VB_S"),
    "ph": ("VA_S,A,", "VA_S,N,"),
    "uu": ("VA_S,A,,V", "VA_S,A,,kV"),
    "a": ("VA_S,A,,V,1,", "VA_S,A,,V,2,"),
    "b": ("VA_S,A,,V,1,0,", "VA_S,A,,V,1,5,"),
    "skew": ("VA_S,A,,V,1,0,0,", "VA_S,A,,V,1,0,25,"),
    "min": ("VA_S,A,,V,1,0,0,-3.4e38", "VA_S,A,,V,1,0,0,-3"),
    "max": ("VA_S,A,,V,1,0,0,-3.4e38,3.4e38", "VA_S,A,,V,1,0,0,-3.4e38,3"),
    "primary": ("VB_S,B,,V,1,0,0,-3.4e38,3.4e38,1,1,S", "VB_S,B,,V,1,0,0,-3.4e38,3.4e38,9,1,S"),
    "secondary": ("VB_S,B,,V,1,0,0,-3.4e38,3.4e38,1,1,S", "VB_S,B,,V,1,0,0,-3.4e38,3.4e38,1,9,S"),
    "PS": ("VB_S,B,,V,1,0,0,-3.4e38,3.4e38,1,1,S", "VB_S,B,,V,1,0,0,-3.4e38,3.4e38,1,1,X"),
    "lf": ("\r\n50\r\n", "\r\n60\r\n"),
    "nrates": ("\r\n1\r\n4000", "\r\n2\r\n4000"),
    "samp": ("4000,400", "2000,400"),
    "endsamp": ("4000,400", "4000,300"),
    "start date, time": ("400\r\n02/03/2024", "400\r\n2/3-2024"),
    "trigger date, time": ("10:00:00.000000\r\nFLOAT32", "10-00\r\nFLOAT32"),
    "ft": ("FLOAT32", "BINARY32"),
    "timemult": ("\r\n1.0\r\n", "\r\n2.0\r\n"),
    "time_code": ("0,0\r\n4,0", "z,0\r\n4,0"),
    "tmq_code": ("4,0\r\n", "z,0\r\n"),
}
OF_DATA = {"n", "timestamp", "missing value", "CFF: CFG", "CFF: DAT"}  # tested above with values


def reading(tmp_path, old="", new=""):
    """Everything read from a file, or the reason of a refusal; the second channel is in secondary values with a ratio
    of one.
    """
    file = File(tmp_path)
    file.channels[1][12] = "S"
    path = file.write()
    text = file.cfg()
    assert old in text
    path.write_bytes(text.replace(old, new, 1).encode() if old else text.encode())
    try:
        result = read_comtrade([path], [c[1] for c in file.channels] if old == "VA_S" else ())
    except ValueError as error:
        return str(error)
    return result.samples.tolist(), result.start, result.rate, result.note, result.frequency


@pytest.mark.parametrize("field", CHANGES)
def test_a_used_field_has_an_effect(tmp_path, field):
    old, new = CHANGES[field]
    assert reading(tmp_path, old, new) != reading(tmp_path)


def test_the_table_is_complete():
    used = {name for name, (use, _) in COMTRADE.table.items() if use == "used"}
    assert used == set(CHANGES) | OF_DATA
