"""A study as one file: it repeats row for row elsewhere, reports it, and contains nothing about its machine."""

import hashlib
import json
import zipfile

import pytest
from softrig_bags.compare import compare
from softrig_bags.files.reader import BagReader
from softrig_bags.write import retell
from softrig_bringup.cli import main
from softrig_bringup.pack.packed import opened, placeless
from softrig_bringup.study import packed

WORDS = ["study", "mine.yaml", "--against", "dc_motor_smc_b4", "--draw", "dc_motor_plant.R=0.3..0.5", "--draws", "2",
         "--figures", "rise_time", "peak_current", "--duration", "1", "--workers", "1"]  # fmt: skip


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("title: mine\nextends: dc_motor_smc_b2\n")
    assert main([*WORDS, "--out", "s"]) == 0
    return tmp_path


def test_a_study_packs_and_repeats_row_for_row(folder, capsys):
    assert main(["pack", "s", "--out", "a.softrig.zip"]) == 0
    assert "4 rows; elsewhere:\n  scripts/softrig study --like a.softrig.zip" in capsys.readouterr().out
    (folder / "mine.yaml").unlink()  # on another machine the file does not exist
    assert main(["study", "--like", "a.softrig.zip", "--workers", "1", "--out", "again"]) == 0
    assert "repeats a.softrig.zip row for row" in capsys.readouterr().out
    rows = [json.loads(line) for line in (folder / "again" / "rows.jsonl").read_text().splitlines()]
    first = [json.loads(line) for line in (folder / "s" / "rows.jsonl").read_text().splitlines()]
    assert [r["figures"] for r in rows] == [r["figures"] for r in first]
    with zipfile.ZipFile("a.softrig.zip") as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    assert {"scenario/mine.yaml", "scenario/dc_motor_smc_b4.yaml", "study/study.yaml", "study/rows.jsonl"} <= {*content}
    assert [name for name, text in content.items() if str(folder).encode() in text] == []
    assert main(["pack", "again", "--out", "b.softrig.zip"]) == 0
    rows[1]["figures"]["rise_time"] = 9.0
    content["study/rows.jsonl"] = "".join(json.dumps(row) + "\n" for row in rows).encode()
    about = json.loads(content["pack.json"])
    about["files"]["study/rows.jsonl"] = hashlib.sha256(content["study/rows.jsonl"]).hexdigest()
    with zipfile.ZipFile("other.softrig.zip", "w") as archive:
        for name, text in (content | {"pack.json": json.dumps(about).encode()}).items():
            archive.writestr(name, text)
    capsys.readouterr()
    assert main(["study", "--like", "other.softrig.zip", "--workers", "1", "--out", "third"]) == 1
    assert "1 of 4 rows are others; row 1: figures {'rise_time': 9.0" in capsys.readouterr().out


def test_archives_can_read_the_content_of_a_pack(folder, capsys):
    """RO-Crate 1.1: a descriptor of the root, which has a name, a description, a date, a licence and its parts."""
    assert main(["pack", "s", "--out", "a.softrig.zip"]) == 0
    assert main(["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.1", "--no-plots", "--out", "r"]) == 0
    authors = ["--author", "Ann Example 0000-0002-1825-0097", *["--author", "Bo Example"] * 2]
    whose = [*authors, "--publisher", "Zenodo https://zenodo.org", "--license", "cc-by-4.0"]
    assert main(["pack", "r", "--out", "r.softrig.zip", "--published", "2026-11-28", *whose]) == 0
    assert main(["run", "--like", "a.softrig.zip"]) == 2
    assert "holds a study, expected a run; `softrig study --like a.softrig.zip`" in capsys.readouterr().err
    for words, text in (
        (["--published", "28.11.2026"], "expected a date as 2026-11-28"),
        (["--author", "0000-0002-1825-0097"], "expected a name, as"),
        (["--author", "Ann Example 0000-0002-1825-0098"], "its last digit does not belong to the others"),
        (["--author", "Ann Example 0000-0002-1825"], "0000-0002-1825: expected an ORCID as"),
        (["--publisher", "https://zenodo.org"], "expected a name, as"),
        (["--license", "CC BY"], "'CC BY': expected one identifier of spdx.org/licenses"),
        (["--license", "MIT OR Apache-2.0"], "expected one identifier"),
        (["--license", "CC-BY-4"], "'CC-BY-4': expected one identifier"),
    ):
        assert main(["pack", "r", *words]) == 2
        assert text in capsys.readouterr().err
    for name in ("a", "r"):
        with zipfile.ZipFile(f"{name}.softrig.zip") as archive:
            crate = json.loads(archive.read("ro-crate-metadata.json"))
            files = {f: archive.read(f) for f in archive.namelist() if f not in ("pack.json", "ro-crate-metadata.json")}
        assert crate["@context"] == "https://w3id.org/ro/crate/1.1/context"
        entities = {entity["@id"]: entity for entity in crate["@graph"]}
        assert len(entities) == len(crate["@graph"])
        descriptor, root = entities["ro-crate-metadata.json"], entities["./"]
        assert (descriptor["@type"], descriptor["about"]) == ("CreativeWork", {"@id": "./"})
        assert descriptor["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
        assert all(root[key] for key in ("name", "description", "datePublished", "license"))
        assert [part["@id"] for part in root["hasPart"]] == [*files]
        for place, content in files.items():
            assert entities[place]["sha256"] == hashlib.sha256(content).hexdigest()
            assert entities[place]["contentSize"] == str(len(content))
            assert str(folder).encode() not in content
        assert root["license"]["@id"] in entities
        assert not any(isinstance(v, list) and len(v) == 1 for e in crate["@graph"] for k, v in e.items())
        assert root["datePublished"] == ("2026-11-28" if name == "r" else "1980-01-01")
    made_by = [entities[author["@id"]] for author in root["author"]]
    assert [(one["@type"], one["name"]) for one in made_by] == [("Person", "Ann Example"), ("Person", "Bo Example")]
    assert made_by[0]["@id"] == "https://orcid.org/0000-0002-1825-0097"
    assert entities[root["publisher"]["@id"]]["name"] == "Zenodo"
    assert root["license"]["@id"] == "https://spdx.org/licenses/CC-BY-4.0"


def test_an_incomplete_study_or_something_else_is_refused(folder, capsys):
    lines = (folder / "s" / "rows.jsonl").read_text().splitlines(keepends=True)
    (folder / "s" / "rows.jsonl").write_text("".join(lines[:3]))
    for words, text in (
        (["pack", "s"], "s: 3 of 4 rows are there; run the study to its end first"),
        (["study", "--like", "s"], "--like s: expected a file that `softrig pack` has written of a study"),
        (["study", "--like", "x.zip", "--seeds", "2"], "--like repeats a study as it was: expected no seeds beside it"),
        (["study"], "expected a study or a scenario, or --like FILE"),
    ):
        assert main(words) == 2
        assert text in capsys.readouterr().err
    (folder / "mine.yaml").write_text("title: mine\nextends: dc_motor_smc_b2\nseed: 4\n")
    assert main(["pack", "s"]) == 2
    assert "holds another study (scenario" in capsys.readouterr().err


def test_a_bag_in_a_pack_equals_that_of_the_run_except_folders(folder, monkeypatch):
    """Equal inputs give equal bytes; a pack's bag has the run's messages, and no file names a folder of its machine."""
    (folder / "p.yaml").write_text("/**:\n  ros__parameters:\n    delta: 3.0\n")
    words = ["run", "mine.yaml", "--mode", "inprocess", "--duration", "0.2", "--no-plots", "--params-file", "p.yaml"]
    assert main([*words, "--out", "r"]) == 0
    assert main(["run", "--from", "r@0.1", "--mode", "inprocess", "--no-plots", "--out", "branch"]) == 0
    with BagReader(folder / "r/bag") as reader:
        retell(folder / "r/bag", folder / "bag", reader.custom_data)
    for name in ("bag_0.mcap", "metadata.yaml"):
        assert (folder / "bag" / name).read_bytes() == (folder / "r/bag" / name).read_bytes()
    for name in ("r", "branch"):
        assert main(["pack", name, "--out", f"{name}.zip"]) == 0
        with zipfile.ZipFile(f"{name}.zip") as archive:
            archive.extractall(f"x{name}")
        assert [f for f in (folder / f"x{name}").rglob("*") if f.is_file() and b"/tmp/" in f.read_bytes()] == []
        assert compare(folder / name / "bag", folder / f"x{name}/bag", bitwise=True).equal
        monkeypatch.setattr(opened, "cache_clear", lambda: None)
        assert main(["run", "--like", f"{name}.zip", "--mode", "inprocess", "--no-plots", "--out", f"a{name}"]) == 0


def test_folders_are_removed_and_texts_like_a_folder_stay():
    entries = {"a": ["/tmp/ann/my rig/x.py", "see /motor/state/shaft and https://doi.org/10.1/2"], "/tmp/b/c": 1.5}
    assert placeless(entries) == {"a": ["my rig/x.py", "see /motor/state/shaft and https://doi.org/10.1/2"], "c": 1.5}


def test_a_broken_row_keeps_no_folder_of_its_machine():
    row = {"number": 0, "scenario": "dc_motor_smc_b2", "case": "", "seed": 0, "overrides": {}, "figures": {},
           "error": "node gain: ValueError: x (/home/ann/my rig/src/gain.py, line 3)", "wall_s": 0.1}  # fmt: skip
    assert b"/home" not in packed.rows_alone([row])
    assert list(packed.differing([row], [row])) == []
    assert list(packed.differing([row], [])) == ["row 0 is missing"]
    assert list(packed.differing([row], [row | {"error": ""}])) == ["row 0: broke there, not here"]
