"""A run as one file: it repeats elsewhere, names the difference if it does not, and a malicious file does no harm."""

import json
import os
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from softrig_bags.files.reader import BagReader
from softrig_bags.read import signals
from softrig_bringup.cli import main
from softrig_bringup.options.like import first_version
from softrig_bringup.pack import packed
from softrig_bringup.report.run_rig import rig_of_run
from softrig_bringup.verbs.pack import raw_alone, standing_alone
from softrig_core import ScenarioError, load_scenario

TABLE = Path(__file__).parents[2] / "ros_pkgs/softrig_power/softrig_power/dispatch/tables/wood_wollenberg_3.csv"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with a changed gain, and a change while it ran."""
    folder = tmp_path_factory.mktemp("pack")
    (folder / "mine.yaml").write_text(
        "title: Mine\nextends: dc_motor_smc_b2\nduration: 1.0\nchanges:\n- {at: 0.5, set: {dc_motor_smc.delta: 3.0}}\n"
    )
    assert main(["run", str(folder / "mine.yaml"), "--mode", "inprocess", "--no-plots", "--set",
                 "dc_motor_smc.delta=2", "--out", str(folder / "run")]) == 0  # fmt: skip
    (folder / "mine.yaml").rename(folder / "away.yaml")
    return folder / "run"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """Put unpacked files into the test's folder, and remove what `opened` adds to the environment after the test."""
    monkeypatch.setattr(packed, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setenv("SOFTRIG_SCENARIOS", os.environ.get("SOFTRIG_SCENARIOS", ""))


def pack(run, out, *options):
    own_file = run.parent / "mine.yaml"
    shutil.copy(run.parent / "away.yaml", own_file)
    try:
        assert main(["pack", str(run), "--out", str(out), *options]) == 0
    finally:
        own_file.unlink()
    return out


def repeat(file, tmp_path, capsys):
    """Exit status and the last line of a repetition."""
    status = main(["run", "--like", str(file), "--mode", "inprocess", "--no-plots", "--out", str(tmp_path / "again")])
    return status, capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("options", [(), ("--no-bag",)])
def test_a_file_repeats_elsewhere_number_for_number(options, run, tmp_path, capsys):
    file = pack(run, tmp_path / "sent.zip", *options)
    status, last = repeat(file, tmp_path, capsys)
    assert (status, last) == (0, f"softrig: repeats {file} number for number: 704 messages on 7 topics")
    assert pack(run, tmp_path / "once_more.zip", *options).read_bytes() == file.read_bytes()
    names = zipfile.ZipFile(file).namelist()
    assert any(name.startswith("bag/") for name in names) is not bool(options)
    assert str(run.parent) not in zipfile.ZipFile(file).read("metrics.json").decode()


def test_the_last_line_says_which_version_differs_first(run, tmp_path, capsys):
    file = pack(run, tmp_path / "sent.zip", "--no-bag")
    other = tmp_path / "other.zip"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(other, "w") as new:
        for name in old.namelist():
            text = old.read(name).decode()
            if name == "pack.json":
                content = json.loads(text)
                content["code"]["softrig_drives"] = "0123456789ab"
                content["files"] = {}
                text = json.dumps(content)
            new.writestr(name, text.replace("delta: 3.0", "delta: 3.5"))
    status, last = repeat(other, tmp_path, capsys)
    assert status == 1
    assert f"softrig: differs from {other}: " in last
    assert "the first version that differs is the code of softrig_drives: 0123456789ab there, " in last


def test_versions_are_reported_by_their_likely_effect():
    second = {"versions": {"numpy": "1", "math": "a", "python": "3"}, "code": {"softrig_core": "x", "mine": "y"}}
    first = {"versions": {"numpy": "2", "math": "b", "python": "3"}, "code": {"softrig_core": "z", "mine": "z"}}
    assert "the code of mine: y there, z here" in first_version(second, first)
    assert "math: a there, b here" in first_version(second, first | {"code": second["code"]})
    assert first_version(second, second) == "no version differs"
    assert first_version({}, first) == "its versions are not known"


def test_a_single_mcap_file_is_a_run(run, tmp_path, capsys):
    (file,) = (run / "bag").glob("*.mcap")
    lone = Path(shutil.copy(file, tmp_path / "lone.mcap"))
    with BagReader(lone) as one, BagReader(run / "bag") as whole:
        assert one.custom_data == whole.custom_data != {}
    shutil.copy(run.parent / "away.yaml", run.parent / "mine.yaml")
    try:
        status, last = repeat(lone, tmp_path, capsys)
    finally:
        (run.parent / "mine.yaml").unlink()
    assert (status, "lone.mcap number for number: " in last) == (0, True)


def test_a_pack_is_viewed_as_its_run_is(run, tmp_path):
    rig, result = rig_of_run(pack(run, tmp_path / "sent.zip"))
    assert rig.scenario.nodes["dc_motor_smc"].parameters["delta"] == 2.0
    assert result.keys() == signals(run / "bag").keys()
    with pytest.raises(ScenarioError, match=r"small\.zip: no bag in it; `softrig run --like"):
        rig_of_run(pack(run, tmp_path / "small.zip", "--no-bag"))


def test_a_run_whose_scenario_has_changed_since_is_not_packed(run, tmp_path, capsys):
    own_file = run.parent / "mine.yaml"
    own_file.write_text((run.parent / "away.yaml").read_text() + "nodes: {dc_motor_smc: {parameters: {c: 4.5}}}\n")
    try:
        assert main(["pack", str(run), "--out", str(tmp_path / "sent.zip")]) == 2
    finally:
        own_file.unlink()
    assert "dc_motor_smc.c" in (printed := capsys.readouterr().err)
    assert "which is 4.5 by now: run it again" in printed
    assert not (tmp_path / "sent.zip").exists()


def test_a_package_that_is_not_installed_is_named(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "gone")
    data = copy / "bag" / "metadata.yaml"
    data.write_text(data.read_text().replace('"softrig_drives":', '"pump_rig":'))
    for word in ("run", "pack"):
        arguments = ["run", "--like", str(copy)] if word == "run" else ["pack", str(copy)]
        assert main(arguments) == 2
        assert "it needs package pump_rig, not installed here; `softrig pack RUN`" in capsys.readouterr().err


def test_files_that_a_scenario_names_are_packed_with_it(tmp_path):
    """A table of units beside the scenario; other files with its name are not packed, except COMTRADE's."""
    first, second = tmp_path / "here", tmp_path / "there"
    first.mkdir()
    shutil.copy(TABLE, first / "units.csv")
    for name in ("units.dat", "units.key", "fault.CFG", "fault.DAT", "fault.pdf", "law.c", "law.h", "law.o"):
        (first / name).write_text("x")
    for one, result in (("fault.CFG", ["fault.CFG", "fault.DAT"]), ("law.c", ["law.c", "law.h"])):
        _, files = raw_alone({"shared": {"file": str(first / one)}})
        assert sorted(Path(place).name for place in files) == result
    (first / "mine.yaml").write_text("extends: economic_dispatch_wood\nshared: {table: units.csv}\n")
    scenario = load_scenario(str(first / "mine.yaml"))
    text, files = standing_alone(scenario)
    assert str(first).encode() not in text
    assert sorted(Path(place).name for place in files) == ["units.csv"]
    for place, content in {"mine.yaml": text, **{k: v.read_bytes() for k, v in files.items()}}.items():
        (second / place).parent.mkdir(exist_ok=True, parents=True)
        (second / place).write_bytes(content)
    shutil.rmtree(first)
    again = load_scenario(str(second / "mine.yaml"))
    table = again.nodes["unit_fleet"].parameters["unit_table"]
    assert Path(table).read_bytes() == TABLE.read_bytes()
    assert str(scenario.nodes).replace(str(first / "units.csv"), table) == str(again.nodes)
    assert again.expect == scenario.expect


def test_firmware_and_the_board_description_are_packed_with_a_scenario(tmp_path):
    """A Cortex-M under qemu has the machine in a file beside the program."""
    first, second = tmp_path / "here", tmp_path / "there"
    (first / "fw").mkdir(parents=True)
    for name in ("law.json", "law.elf", "law.c", "board.elf", "board.json"):
        (first / "fw" / name).write_text(name)
    nodes = "nodes: {dc_motor_smc: {link: {port: 'qemu:fw/%s', firmware: %s}}}\n"
    for program, firmware, wanted in (("law.elf", "fw/law.json", 2), ("board.elf", "fw/law.json", 3)):
        (first / "mine.yaml").write_text("extends: dc_motor_smc_b2\n" + nodes % (program, firmware))
        text, files = standing_alone(load_scenario(str(first / "mine.yaml")))
        assert len(files) in (wanted, wanted + (program == "law.elf"))
        shutil.rmtree(second, ignore_errors=True)
        for place, content in {"mine.yaml": text, **{k: v.read_bytes() for k, v in files.items()}}.items():
            (second / place).parent.mkdir(exist_ok=True, parents=True)
            (second / place).write_bytes(content)
        link = load_scenario(str(second / "mine.yaml")).nodes["dc_motor_smc"].link
        kind, _, elf = link.port.partition(":")
        assert (kind, Path(elf).read_text(), Path(link.firmware).read_text()) == ("qemu", program, "law.json")
        assert Path(elf).with_suffix(".json").read_text() == program.replace("elf", "json")
        assert Path(elf).is_relative_to(second)


@pytest.mark.parametrize("name", ["dc_motor_smc_faults", "induction_dtc", "pwa_delay_margin", "tcp_aqm_smc"])
def test_a_pack_of_a_scenario_alone_is_the_scenario(name, tmp_path):
    text, files = standing_alone(scenario := load_scenario(name))
    (tmp_path / f"{name}.yaml").write_bytes(text)
    assert load_scenario(str(tmp_path / f"{name}.yaml")).model_dump() == scenario.model_dump()
    assert not files


def zipped(path, *entries, **more):
    with zipfile.ZipFile(path, "w", **more) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return path


ABOUT = ("pack.json", '{"format": 1, "scenario": "x"}')


def link():
    entry = zipfile.ZipInfo("scenario/link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    return entry, "/etc/passwd"


@pytest.mark.parametrize(
    ("entries", "text"),
    [
        ([ABOUT, ("../evil", "")], "expected plain files below"),
        ([ABOUT, ("scenario/../../evil", "")], "expected plain files below"),
        ([ABOUT, ("/tmp/evil", "")], "expected plain files below"),
        ([ABOUT, ("scenario/..\\..\\evil", "")], "expected plain files below"),
        ([ABOUT, ("evil", "")], "expected plain files below"),
        ([ABOUT, ("scenario/", "")], "expected plain files below"),
        ([ABOUT, link()], "expected plain files below"),
        ([ABOUT, ("scenario/a", ""), ("scenario/a/b", "")], "cannot be unpacked"),
        ([ABOUT, *((f"scenario/{k}", "") for k in range(packed.FILES))], "expected at most 10000"),
        ([("scenario/x.yaml", "")], "expected a file that `softrig pack` has written"),
        ([("pack.json", '{"format": 2, "scenario": "x"}')], "pack.json: format"),
        ([("pack.json", '{"scenario": "../x"}')], "pack.json: scenario"),
    ],
)
def test_a_malicious_file_writes_nothing_outside_its_folder(entries, text, tmp_path):
    before = set(tmp_path.rglob("*"))
    file = zipped(tmp_path / "evil.zip", *entries)
    with pytest.raises(ScenarioError, match=text):
        packed.opened(file)
    left = {p for p in set(tmp_path.rglob("*")) - before if "cache" not in p.parts}
    assert left == {file}
    assert not [p for p in (tmp_path / "cache").rglob("*") if p.is_file()]


def test_a_file_that_unpacks_to_more_than_fits_is_refused(tmp_path, monkeypatch):
    bomb = zipped(tmp_path / "bomb.zip", ABOUT, ("bag/x.mcap", bytes(1 << 20)), compression=zipfile.ZIP_DEFLATED)
    monkeypatch.setattr(packed, "MOST", 1 << 19)
    with pytest.raises(ScenarioError, match=r"2 files of \d+ bytes in all, expected at most 10000 of 524288"):
        packed.unpack(bomb, tmp_path / "new")
    # If the declared size of an entry is wrong, only that many bytes are read.
    monkeypatch.undo()
    data = bytearray(bomb.read_bytes())
    for head in (b"PK\x03\x04", b"PK\x01\x02"):
        at = data.index(b"bag/x.mcap", data.index(head) if head == b"PK\x03\x04" else data.rindex(head))
        size = at - (30 - 22 if head == b"PK\x03\x04" else 46 - 24)
        assert int.from_bytes(data[size : size + 4], "little") == 1 << 20
        data[size : size + 4] = (100).to_bytes(4, "little")
    bomb.write_bytes(data)
    with pytest.raises(ScenarioError, match="cannot be unpacked"):
        packed.unpack(bomb, tmp_path / "other")
    assert (tmp_path / "other" / "bag" / "x.mcap").stat().st_size <= 100


def test_a_damaged_file_is_one_line(run, tmp_path, capsys):
    sent = pack(run, tmp_path / "sent.zip")
    data = bytearray(sent.read_bytes())
    data[300] ^= 0xFF
    sent.write_bytes(data)
    assert main(["run", "--like", str(sent)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    sent.write_bytes(data[:1000])  # too short for a zip file
    assert main(["run", "--like", str(sent)]) == 2
    assert "or a file of `softrig pack`" in capsys.readouterr().err
