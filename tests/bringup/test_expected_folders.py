"""Folders of results and files of runs: what is replaced, kept or refused, packed and unpacked, what repeats a run."""

import argparse
import hashlib
import json
import os
import re
import stat
import struct
import zipfile
from dataclasses import replace as with_other
from pathlib import Path
from types import SimpleNamespace

import pytest
from expected_text import check_expected
from softrig_bringup import cli, folder as folders
from softrig_bringup.folder import FALSIFICATION, MANIFEST, RUN, STUDY, ResultsFolder
from softrig_bringup.options import like
from softrig_bringup.options.branch import began_as
from softrig_bringup.pack import packed
from softrig_bringup.run import run as runs
from softrig_bringup.verbs import pack
from softrig_core import Recording, Run, RunError, ScenarioError, rig_of, simulate
from softrig_core.kit.file_format import json_object
from softrig_core.wire.parameter_event import TOPIC, TYPE, encode

# the folder of results ------------------------------------------------------------------------------------------------


def tree(place, files):
    """Make files, each with its own name as content; a list becomes the manifest of an earlier call."""
    for name, content in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(content if isinstance(content, str) else json.dumps(content))


def files_in(place):
    return sorted(
        str(p.relative_to(place)) + "/" * p.is_dir() for p in place.rglob("*") if p.is_file() or not any(p.iterdir())
    )


NAMES = [
    "bag",
    "log",
    "left_1.yaml",
    "left_x.yaml",
    "metrics.json",
    "report.html",
    "overview.png",
    "overview.gif",
    "plot_01_a.svg",
    "plot_1_a.svg",
    "plot_01_A.pdf",
    "softrig_files.json",
    "notes.txt",
    "study.json",
    "rows.jsonl",
    "table.csv",
    "table.xlsx",
    "summaries.json",
    ".new",
    "falsification.json",
    "outcome.json",
    "nominal",
    "worst",
    "worst.png",
    "small",
    "a_worst.yaml",
    "a_small.yaml",
    "a_worse.yaml",
    "metrics.json.bak",
]
FORMER = {
    "metrics.json": {"scenario": "lag", "mode": "inprocess", "seed": 3},
    "bag/bag_0.mcap": "",
    "log/a/b/c.txt": "",
    "log/d.txt": "",
}
SITUATIONS = {
    "nothing": {},
    "files of others": {"notes.txt": "", "mine/bag": ""},
    "a former run": FORMER | {MANIFEST: [*FORMER, MANIFEST], "notes.txt": "", "mine/x": ""},
    "one with a file of somebody": FORMER | {MANIFEST: [*FORMER, MANIFEST], "log/mine.txt": ""},
    "one whose figures cannot be read": {"metrics.json": "{", MANIFEST: ["metrics.json", MANIFEST]},
    "one that is gone": {MANIFEST: ["metrics.json", "bag/x", MANIFEST]},
    "one that was broken off": {"log/a.shard": "", "notes.txt": "", MANIFEST: [MANIFEST, "*in real time"]},
    "no list": FORMER,
    "no list that can be read": {"report.html": "", MANIFEST: "{"},
    "another kind of list": {"notes.txt": "", MANIFEST: {"a": 1}},
    "a file put there afterwards": FORMER | {MANIFEST: [*FORMER, MANIFEST], "report.html": ""},
    "a study": {"study.json": "", MANIFEST: ["study.json", MANIFEST]},
    "a falsification": {"falsification.json": "", MANIFEST: ["falsification.json", MANIFEST]},
}


def test_files_in_the_folder_of_a_run_are_replaced_kept_or_refused_as_expected(tmp_path):
    messages = [
        f"{kind}: {' '.join(n for n in NAMES if of.fullmatch(n))}"
        for kind, of in (("a run writes", RUN), ("a study writes", STUDY), ("a falsification writes", FALSIFICATION))
    ]
    for k, (name, files) in enumerate(SITUATIONS.items()):
        tree(place := tmp_path / str(k), files)
        messages.append(name)
        try:
            folder = ResultsFolder(place)
        except ScenarioError as error:
            messages.append(f"  refused: {error}".replace(str(place), "HERE"))
            assert files_in(place) == sorted(files) if files else True
            continue
        messages.append(f"  replaces {folder.replaced or 'nothing'}")
        folder.clear("why")
        messages.append(f"  left: {' '.join(files_in(place))}, list {json.loads((place / MANIFEST).read_text())}")
        tree(place, {"log/new.txt": "", "metrics.json": ""})
        folder.close()
        folder.let_go()
        messages.append(f"  then listed: {' '.join(json.loads((place / MANIFEST).read_text()))}")
    check_expected("folders/found", messages)


def test_the_reason_why_a_run_cannot_be_made_again_is_as_expected(tmp_path):
    cases = {
        "a plain run": {"metrics.json": {"once": []}},
        "one that says why": {"metrics.json": {"once": ["a", "b"], "code": {"json": "1", "pump_rig": "2"}}},
        "no map": {"metrics.json": "[]"},
        "ended": {"log/a.shard": ""},
        "broken off before anything": {MANIFEST: [MANIFEST, "*in real time"]},
        "broken off": {"log/b.shard": "", "log/a.shard1": "", MANIFEST: [MANIFEST, "*"]},
        "broken off and left": {"log/b.shard": "", "left_2.yaml": "", "left_1.yaml": "", MANIFEST: [MANIFEST, "*"]},
        "broken off in real time": {"log/b.shard": "", MANIFEST: [MANIFEST, "*in real time"]},
    }
    messages = []
    for k, (name, files) in enumerate(cases.items()):
        tree(place := tmp_path / str(k), {**files, MANIFEST: files.get(MANIFEST, [*files, MANIFEST])})
        result = ResultsFolder(place).once(lambda shards: [f"of {s.name}" for s in shards])
        messages.append(f"{name}: {result or 'it can'}".replace(str(place), "HERE"))
    tree(tmp_path / "0", {"log/a.shard": "", MANIFEST: [MANIFEST, "*"]})
    (tmp_path / "0/metrics.json").unlink()
    messages.append(
        f"nothing was done while it ran: {ResultsFolder(tmp_path / '0').once(lambda shards: []) or 'it can'}"
    )
    check_expected("folders/once", messages)


def test_new_files_replace_the_old_ones_when_all_are_written(tmp_path):
    def study():
        return ResultsFolder(tmp_path, STUDY)

    def broken(folder):
        with folder.anew() as new:
            tree(new, {"table.csv": "half"})
            raise RunError("gone")

    tree(
        tmp_path,
        {
            "table.csv": "old",
            "notes.txt": "mine",
            ".new/rows.jsonl": "of a call that was killed",
            MANIFEST: ["table.csv", ".new/rows.jsonl", MANIFEST],
        },
    )
    with study().anew() as new:
        assert list(new.iterdir()) == []
        tree(new, {"table.csv": "new", "rows.jsonl": "new"})
        assert (tmp_path / "table.csv").read_text() == "old"
    assert {p: (tmp_path / p).read_text() for p in ("table.csv", "rows.jsonl", "notes.txt")} == {
        "table.csv": "new",
        "rows.jsonl": "new",
        "notes.txt": "mine",
    }
    assert json.loads((tmp_path / MANIFEST).read_text()) == ["rows.jsonl", MANIFEST, "table.csv"]
    with pytest.raises(RunError, match="gone"):
        broken(study())
    assert (tmp_path / "table.csv").read_text() == "new"
    assert not (tmp_path / ".new").exists()
    with pytest.raises(ScenarioError, match=r"notes\.txt was not written by a run of softrig"), study().anew() as new:
        tree(new, {"table.csv": "newer", "notes.txt": "ours"})
    assert [(tmp_path / p).read_text() for p in ("table.csv", "notes.txt")] == ["new", "mine"]


def test_a_folder_is_locked_by_one_call_at_a_time(tmp_path):
    first, second = ResultsFolder(tmp_path / "x"), ResultsFolder(tmp_path / "x")
    current = f"process {os.getpid()}"
    assert (first.hold(), first.hold(), second.hold()) == (None, None, current)
    text = f"{tmp_path / 'x'}: {current} is writing there; wait for it, or choose another folder"
    for call in (second.begin, second.alone().__enter__, folders.alone_in(tmp_path / "x").__enter__):
        with pytest.raises(ScenarioError, match=f"^{re.escape(text)}$"):
            call()
    first.let_go()
    with second.alone():
        assert first.hold() == current
    with folders.alone_in(tmp_path / "x"):
        assert first.hold() == current
    assert first.hold() is None
    del first
    assert second.hold() is None


@pytest.mark.parametrize(
    ("error", "kept"),
    [
        (ZeroDivisionError("x"), True),
        (RunError("x"), False),
        (ScenarioError("x"), False),
        (OSError("x"), False),
        (MemoryError("x"), False),
    ],
)
def test_the_traceback_of_an_error_of_softrig_is_kept_and_listed(tmp_path, error, kept):
    tree(tmp_path, {"metrics.json": "", MANIFEST: ["metrics.json", MANIFEST]})
    folder = ResultsFolder(tmp_path)
    folder.hold()
    with pytest.raises(type(error)), folder.keeping():
        raise error
    logs = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.glob("log/*"))
    assert len(logs) == kept
    assert vars(error).get("log", "") == (str(tmp_path / logs[0]) if kept else "")
    assert json.loads((tmp_path / MANIFEST).read_text()) == (sorted([*logs, "metrics.json", MANIFEST]))
    assert ResultsFolder(tmp_path).hold() is None  # the lock was released


def test_a_file_replaces_a_link_as_a_whole_and_leaves_nothing_else(tmp_path):
    tree(tmp_path, {"precious": "keep"})
    (tmp_path / "x").symlink_to(tmp_path / "precious")
    folders.replace(tmp_path / "x", "ü")
    folders.replace(tmp_path / "y", b"\xff")
    assert ((tmp_path / "x").read_bytes(), (tmp_path / "y").read_bytes()) == ("ü".encode(), b"\xff")
    assert (tmp_path / "precious").read_text() == "keep"
    with pytest.raises(OSError, match="none"):
        folders.replace(tmp_path / "none/x", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["precious", "x", "y"]


# the same run once more -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run():
    return simulate("dc_motor_smc_b2", duration=0.5)


def recalled(run, **more):
    about = {
        "path": Path("first"),
        "options": None,
        "bag": Path("first/bag"),
        "recording": run.recording,
        "epoch": 0,
        "late": {},
        "made_with": {"versions": {"numpy": "1"}},
    }
    return like.Recalled(**about | more)


def changed(run, topic, k=None, values=None, first=0, last=None):
    """The recording of a run with one message of a topic changed, or with only a part of its messages."""
    result = Recording((t.name, t.msgtype) for t in run.recording.topics.values())
    for name, old in run.recording.topics.items():
        times, data = list(old.times), [bytes(d) for d in old.data]
        if name == topic:
            if k is not None:
                data[k] = run.rig.topics[topic].layout().encode(times[k], values)
            times, data = times[first:last], data[first:last]
        result.topics[name].times.extend(times)
        result.topics[name].data.extend(data)
    return result


def test_a_repetition_is_compared_with_the_run_as_expected(run):
    ends = [t.name for t in run.recording.topics.values()]
    cases = {
        "the same": run.recording,
        "another number": changed(run, "motor/command", 10, (1.5,)),
        "a message less between": changed(run, "motor/command", first=1),
        "fewer at the end": changed(run, "motor/command", last=-3),
        "nothing of one": changed(run, "motor/command", last=0),
        "nothing": Recording((name, run.recording.topics[name].msgtype) for name in ends),
    }
    messages = []
    for name, recording in cases.items():
        messages.append(name)
        for late in ({}, {"law": {"missed_deadlines": 2}}):
            again = Run(run.rig, 0, recording)
            same, text = like.compared(recalled(run, late=late), again, {"versions": {"numpy": "2"}})
            messages += [f"  {same}: {line}" for line in text]
    same, text = like.compared(recalled(run, recording=Recording(())), run, {})
    messages += ["a bag without a topic", *(f"  {same}: {line}" for line in text)]
    digests = like.digests(run)
    for name, known in {
        "digests": digests,
        "one that differs": digests | {"motor/command": digests["motor/state"]},
    }.items():
        same, text = like.compared(
            recalled(run, recording=Recording(()), digests=known), run, {"versions": {"numpy": "1"}}
        )
        messages += [name, *(f"  {same}: {line}" for line in text)]
    other = Run(run.rig, 0, changed(run, "motor/command", 30, (1.5,)))
    for at in (0.0, 0.2, 0.4):
        same, text = began_as(recalled(run), other, at, {"versions": {"numpy": "1"}})
        messages += [f"up to {at:g} s", *(f"  {same}: {line}" for line in text)]
    check_expected("folders/compared", messages)


def test_a_stamp_in_only_one_of_the_runs_is_a_difference(run):
    layout, late = run.rig.topics["motor/command"].layout(), changed(run, "motor/command")
    topic = late.topics["motor/command"]
    topic.data[:] = [layout.encode(0, (float(v),)) for v in run.signals["motor/command/armature/effort"].x]
    for before, after in ((run.recording, late), (late, run.recording)):
        same, text = like.compared(recalled(run, recording=before), Run(run.rig, 0, after), {})
        assert (same, "motor/command from t = 0.01 s" in text[-1]) == (False, True)


def test_a_digest_covers_ticks_stamps_and_numbers_without_the_sign_of_zero(run):
    result = like.digests(run)
    assert result.keys() == {p.topic for m in run.rig.members for p in m.outputs}
    for topic, digest in result.items():
        table, hashed = run.signals.table(topic), hashlib.sha256()
        rows = zip(
            run.recording.topics[topic].times, table.stamp, zip(*table.columns.values(), strict=True), strict=True
        )
        for t, stamp, values in rows:
            hashed.update(
                struct.pack("<qq", t, round(stamp * 1e9)) + b"".join(struct.pack("<d", v + 0.0) for v in values)
            )
        assert (digest.messages, digest.sha256) == (len(table.t), hashed.hexdigest()[:32])
    zeros = [like.digests(Run(run.rig, 0, changed(run, "motor/command", 10, (zero,)))) for zero in (0.0, -0.0)]
    assert zeros[0] == zeros[1] != result


def test_counters_of_a_node_in_real_time_are_reported():
    status = {
        "a": {"missed_deadlines": 2, "late_messages": 0, "ticks": 9},
        "b": {"lost_arrays": 1.0, "dropped_ticks": 3},
        "c": {"ticks": 1},
    }
    assert like.lateness(status) == {"a": {"missed_deadlines": 2}, "b": {"dropped_ticks": 3, "lost_arrays": 1}}
    assert (
        like.words(like.lateness(status) | {"d": {"new": 1}})
        == "a 2 deadlines missed; b 3 ticks dropped, 1 arrays lost; d 1 new"
    )


def test_the_most_likely_different_version_is_named_as_expected():
    recorded = {
        "versions": {"commit": "abcdef0123456789", "run.lock": "a", "other": "1", "python": "3.12", "numpy": "1",
                     "math": "a"},
        "code": {"softrig_core": "x", "mine": "y"},
        "contents": {"n": {"file": "a"}},
    }  # fmt: skip
    current = {
        "versions": {"commit": "123456789abcdef0", "run.lock": "b", "other": "2", "python": "3.13", "numpy": "2",
                     "math": "b"},
        "code": {"softrig_core": "z", "mine": "z"},
        "contents": {"n": {"file": "b"}},
    }  # fmt: skip
    messages, now = [], dict(current)
    for key in (
        "all",
        "code.mine",
        "code.softrig_core",
        "contents",
        "versions.math",
        "versions.numpy",
        "versions.python",
        "versions.other",
    ):
        part, _, name = key.partition(".")
        if key != "all":
            now[part] = now[part] | {name: recorded[part][name]} if name else recorded[part]
        messages.append(f"{key} the same: {like.first_version(recorded, now)}")
    messages.append(f"no commit: {like.first_version(recorded, current | {'versions': {}})}")
    messages.append(f"not there: {like.first_version({'versions': {'numpy': '1'}}, {'versions': {}})}")
    check_expected("folders/versions", messages)


# what is recorded of a run --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kept", "text"),
    [
        ((0, 100), ""),
        ((1, 100), "motor/command: 99 messages of 100, first gap at t = 0 s"),
        ((0, 99), "motor/command: 99 messages of 100, first gap at t = 0.99 s"),
        ((0, 0), "motor/command: 0 messages of 100, first gap at t = 0 s"),
    ],
)
def test_a_topic_that_lacks_a_tick_is_named_with_the_first_missing_one(kept, text):
    rig = rig_of("dc_motor_smc_b2", duration=1.0)
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    schedules = {p.topic: m.schedule for m in rig.members for p in m.outputs} | {"/clock": rig.clock.schedule}
    for topic, schedule in schedules.items():
        times = [schedule.time(k) for k in range(schedule.count())]
        recording.topics[topic].times.extend(times[slice(*kept)] if topic == "motor/command" else times)
    assert runs.gaps(rig, recording) == text


def test_changes_by_a_person_are_reported_apart_from_those_of_the_scenario(run):
    rig = rig_of(run.rig.scenario.having(changes=[{"at": 0.01, "set": {"dc_motor_smc.delta": 3.0}}]))
    events = {
        "the scenario's": (10_000_000, {"delta": 3.0}),
        "another value": (10_000_000, {"delta": 2.0}),
        "another time": (20_000_000, {"delta": 3.0}),
        "another name": (10_000_000, {"k": 3.0}),
    }
    results = {}
    for name, (t, values) in events.items():
        recording = Recording([*((n, p.msgtype) for n, p in rig.topics.items()), (TOPIC, TYPE)])
        recording.topics[TOPIC].times.append(t)
        recording.topics[TOPIC].data.append(encode(t, "/dc_motor_smc", values))
        done = Run(rig, 0, recording)
        results[name] = runs.turned(done)
        assert runs._once(done) == ([runs.CHANGED] if results[name] else [])
    assert results == {
        "the scenario's": [],
        "another value": ["dc_motor_smc.delta=2.0 from 0.01 s"],
        "another time": ["dc_motor_smc.delta=3.0 from 0.02 s"],
        "another name": ["dc_motor_smc.k=3.0 from 0.01 s"],
    }


def test_a_bag_describes_its_run(run):
    content = {
        "scenario": "x",
        "mode": "m",
        "seed": 3,
        "versions": {"a": "1"},
        "code": {},
        "command": "c",
        "contents": {},
        "run": "0a",
    }
    plain = {"scenario": "x", "mode": "m", "seed": "3", "versions": '{"a": "1"}', "code": "{}", "command": "c"}
    plain |= {"run": "0a"}
    done = SimpleNamespace(epoch=0, status={"n": {"missed_deadlines": 2}}, branched=[])
    assert runs._provenance(done, content) == plain
    status = {"n": {"missed_deadlines": 2}, "w": {"figures": {"a": [1.0, "m"]}}}
    late = SimpleNamespace(epoch=7, status=status, branched=[{"at_s": 1.0}])
    more = content | {"from": {"run": "r"}, "contents": {"n": {"f": "h"}}}
    assert runs._provenance(late, more) == plain | {
        "epoch": "7",
        "late": '{"n": {"missed_deadlines": 2}}',
        "from": '{"run": "r"}',
        "contents": '{"n": {"f": "h"}}',
        "observed": '{"w": {"a": [1.0, "m"]}}',
        "branched": '[{"at_s": 1.0}]',
    }


# one file -------------------------------------------------------------------------------------------------------------


def entry(name, kind=0, compress=zipfile.ZIP_STORED, flags=0):
    result = zipfile.ZipInfo(name)
    result.external_attr, result.compress_type, result.flag_bits = (kind | 0o644) << 16, compress, flags
    return result


GOOD = ["pack.json", "metrics.json", "scenario/a.yaml", "packages/rig/rig/law.py", "bag/bag_0.mcap",
        "scenario/" + "x" * 150, "bag/metadata.yaml", "scenario" + "/d" * 20, "scenario/a b"]  # fmt: skip
BAD = ["pack.jsonx", "other.json", "scenario", "bag/", "bag" + "/d" * 21, "scenario/" + "x" * 151, "scenario/./a",
       "scenario/../a", "/pack.json", "scenario//a", "scenario/a\\b", "scenario/a\x07b", "scenario/a\x7f",
       "pack.json/a"]  # fmt: skip


def test_only_plain_files_at_their_places_are_unpacked():
    seen = set()
    for name in GOOD:
        packed._check(entry(name, stat.S_IFREG if "bag" in name else 0, zipfile.ZIP_DEFLATED), seen)
        seen.add(name)
    wrong = [*map(entry, BAD), entry("pack.json"), entry("bag/x", stat.S_IFLNK), entry("bag/y", stat.S_IFDIR)]
    for bad in wrong:
        with pytest.raises(
            ScenarioError, match=r"expected plain files below scenario, packages, bag, study, each once"
        ):
            packed._check(bad, {"pack.json"})
    for stray in ("bag/z", "bag/a/b.mcap", "bag/x.zip"):
        with pytest.raises(ScenarioError, match=r"expected metadata.yaml and files of messages in bag$"):
            packed._check(entry(stray), set())
    for name, most in packed.LARGEST.items():
        large = entry(name)
        large.file_size = most
        packed._check(large, set())
        large.file_size += 1
        with pytest.raises(ScenarioError, match=f"{name}: {most + 1} bytes, expected at most {most}$"):
            packed._check(large, set())
    for bad in (entry("bag/z", compress=zipfile.ZIP_LZMA), entry("bag/z", flags=1)):
        with pytest.raises(ScenarioError, match="expected it stored or deflated, and not encrypted"):
            packed._check(bad, set())
    long = entry("x" * 200)
    with pytest.raises(ScenarioError, match=f"^'{'x' * 100}': "):
        packed._check(long, set())


@pytest.mark.parametrize(("files", "size", "fits"), [(2, 100, True), (3, 100, False), (2, 101, False)])
def test_a_pack_has_a_limit_of_size_and_number_of_files(files, size, fits, tmp_path, monkeypatch):
    """For writing and unpacking alike; at most half of the free disk is used."""
    about = packed.About(scenario="x")
    content = {f"scenario/{k}": bytes(size // (files - 1)) for k in range(files - 1)}
    content[f"scenario/{files - 2}"] = b"extends: x" + bytes(size // (files - 1) - 10)
    listed = {place: hashlib.sha256(text).hexdigest() for place, text in content.items()}
    head = len(about.model_copy(update={"files": listed}).model_dump_json(indent=1)) + 1
    for module in (packed, pack):
        monkeypatch.setattr(module, "FILES", 2)
        monkeypatch.setattr(module, "MOST", 100 + head)
    made = pack._Pack(content, about, ())
    if not fits:
        with pytest.raises(
            ScenarioError,
            match=rf"{files} files of \d+ bytes in all, expected at most 2 of {100 + head}; --no-bag",
        ):
            pack.write(made, tmp_path / "x.zip")
        assert list(tmp_path.iterdir()) == []
        return
    pack.write(made, tmp_path / "x.zip")
    packed.unpack(tmp_path / "x.zip", tmp_path / "new")
    assert packed.about(tmp_path / "new") == about.model_copy(update={"files": listed})
    usage = SimpleNamespace(free=2 * (100 + head) - 1)
    monkeypatch.setattr(packed.shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(
        ScenarioError, match=rf"2 files of {100 + head} bytes in all, expected at most 2 of {99 + head}$"
    ):
        packed.unpack(tmp_path / "x.zip", tmp_path / "other")
    usage.free += 1
    packed.unpack(tmp_path / "x.zip", tmp_path / "third")


def test_a_file_has_the_same_bytes_whoever_writes_it(tmp_path):
    (tmp_path / "f").write_bytes(b"abc" * 500_000)  # longer than a block of the compressor
    made = pack._Pack({"bag/f": tmp_path / "f", "scenario/x.yaml": b"a: 1"}, packed.About(scenario="x"), ())
    for name in ("one", "two"):
        pack.write(made, tmp_path / f"{name}.zip")
        os.utime(tmp_path / "f", (0, 0))
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()
    with zipfile.ZipFile(tmp_path / "one.zip") as archive:
        about = [(e.filename, e.date_time[0], e.compress_type, oct(e.external_attr >> 16)) for e in archive.infolist()]
        assert archive.read("bag/f") == (tmp_path / "f").read_bytes()
    assert about == [(n, 1980, zipfile.ZIP_DEFLATED, "0o644") for n in ("pack.json", "bag/f", "scenario/x.yaml")]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f", "one.zip", "two.zip"]


def test_only_sources_of_a_package_are_packed(tmp_path):
    tree(
        rig := tmp_path / "ws/src/rig",
        {
            "package.xml": "<package><name> rig </name></package>",
            "setup.cfg": "",
            "rig/law.py": "",
            "rig/__pycache__/law.pyc": "",
            "rig/old.pyc": "",
            "build/x": "",
            "runs/x": "",
            ".git/x": "",
            "rig.egg-info": "",
            "log/x": "",
        },
    )
    tree(tmp_path, {"secret": ""})
    (rig / "link").symlink_to(tmp_path / "secret")
    (rig / "also").symlink_to(rig / "rig/law.py")
    (rig / "folder").symlink_to(tmp_path)
    assert [str(p.relative_to(rig)) for p in pack._files(rig)] == ["also", "package.xml", "rig/law.py", "setup.cfg"]
    assert (pack._named(rig / "package.xml"), pack._named(rig / "setup.cfg"), pack._named(rig / "none")) == (
        "rig",
        "",
        "",
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pack.repeat, "workspace", lambda package: tmp_path / "ws" if package == "rig" else None)
        assert (pack._sources("rig"), pack._sources("no_such_rig")) == (rig, None)
        (rig / "package.xml").unlink()
        assert pack._sources("rig") is None
    assert pack._version("no_such_rig") == "unknown"


@pytest.mark.parametrize(
    ("epoch", "outside", "content", "why"),
    [
        (0, False, {}, ""),
        (5, False, {}, "in real time"),
        (0, True, {"stopped": "x"}, "there were messages from outside, it ended early"),
        (0, False, {"error": "x"}, "it ended early"),
    ],
)
def test_a_bag_is_left_out_if_the_scenario_reproduces_it(run, monkeypatch, epoch, outside, content, why):
    monkeypatch.setattr(pack, "from_outside", lambda rig, recording: ["x"] * outside)
    before = recalled(run, epoch=epoch)
    if why:
        with pytest.raises(ScenarioError, match=rf"^--no-bag: the run cannot be repeated without its bag \({why}\)$"):
            pack._digests(before, run.rig.scenario, content)
    else:
        assert pack._digests(before, run.rig.scenario, content) == like.digests(run)
    known = with_other(before, digests={"a": 1})
    assert pack._digests(known, run.rig.scenario, content) == {"a": 1}


def test_packages_that_are_missing_are_named():
    packed.need_packages("x", ["json", "os"])
    for names, text in (
        (["json", "pump_rig"], "x: it needs package pump_rig, not installed here"),
        (["pump_rig", "json", "tank_rig"], "x: it needs packages pump_rig, tank_rig, not installed here"),
        (["<stdin>", "pump_rig"], "x: <stdin> was defined interactively: only blocks of a package can be repeated"),
    ):
        with pytest.raises(ScenarioError, match=f"^{text}"):
            packed.need_packages("x", names)


# what goes into a file ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A run in its folder, of a user's scenario with a change while it ran."""
    place = tmp_path_factory.mktemp("kept")
    (place / "mine.yaml").write_text(
        "title: Mine\nextends: dc_motor_smc_b2\nduration: 0.1\nchanges:\n- {at: 0.05, set: {dc_motor_smc.delta: 3.0}}\n"
    )
    command = ["run", str(place / "mine.yaml"), "--mode", "inprocess", "--no-plots", "--out", str(place / "run")]
    assert cli.main(command) == 0
    return place


def test_the_content_of_a_packed_run_is_as_expected(kept, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    messages = []
    for name, bag in (("with its bag", True), ("without", False)):
        made = pack.collect(kept / "run", kept / f"aside_{bag}", bag=bag)
        messages.append(f"{name}: lacks {list(made.lacks)}")
        messages += [f"  {place}" for place in made.files]
        about = made.about
        messages.append(f"  {about.scenario}, packages {about.packages}, code of {' '.join(about.code)}")
        messages.append(f"  digests of {len(about.digests)} topics")
        assert about.versions == json.loads((kept / "run/metrics.json").read_text())["versions"]
        content = json.loads(made.files["metrics.json"])
        messages.append(f"  {content['command']}")
        messages += [
            f"    {line}"
            for line in made.files[f"scenario/{about.scenario}.yaml"].decode().splitlines()
            if "delta" in line or line.startswith("  at")
        ]
    lone = pack.collect(next((kept / "run/bag").glob("*.mcap")), kept / "aside_one")
    messages += ["a single file", *(f"  {place}" for place in lone.files)]
    for words in (["--out", "x.zip"], ["--no-bag"]):
        assert cli.main(["pack", str(kept / "run"), *words]) == 0
        printed = capsys.readouterr()
        messages += [
            f"pack {' '.join(words)}",
            *(f"  {re.sub(r'[0-9]+ kB', 'N kB', line)}" for line in (printed.out + printed.err).splitlines()),
        ]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.softrig.zip", "x.zip"]
    assert cli.main(["pack", str(kept / "run"), "--out", str(tmp_path)]) == 2
    assert "is a folder, expected a file" in capsys.readouterr().err
    check_expected("folders/packed", messages)


def test_a_code_file_that_has_changed_since_the_run_is_named(kept, capsys, monkeypatch):
    real = pack.recall

    def other(run, parse):
        result = real(run, parse)
        return with_other(
            result, made_with=result.made_with | {"code": result.made_with["code"] | {"softrig_core": "0123"}}
        )

    monkeypatch.setattr(pack, "recall", other)
    now = pack.fingerprints([])["softrig_core"] if pack.fingerprints([]) else None
    made = pack.collect(kept / "run", kept / "aside")
    printed = capsys.readouterr().err
    assert printed.startswith("softrig: the code of softrig_core is no longer that of the run (0123 then, ")
    assert printed.count("\n") == 1
    assert made.about.code["softrig_core"] == "0123"
    assert now is None or now in printed
    rig = rig_of("dc_motor_smc_b2")
    pack._unchanged(Path("r"), rig, {})
    pack._unchanged(Path("r"), rig, {"parameters": {"dc_motor_smc": {"gone": 1}, "nobody": {"k": 1}}})
    with pytest.raises(
        ScenarioError, match=r"^r: it ran with dc_motor_smc\.delta = 7\.5, which is 5\.0 by now: run it again$"
    ):
        pack._unchanged(Path("r"), rig, {"parameters": {"dc_motor_smc": {"delta": 7.5}}})


# sporadic topics, and what comes from outside -------------------------------------------------------------------------

NODES = "nodes:\n  plant: {package: faultrig, executable: plant}\n  source: {package: faultrig, executable: source}\n"
LAG = f"title: Lag\nsystem: lag\nsource: none\nduration: 0.05\n{NODES}  gain: {{package: faultrig, executable: gain}}\n"


@pytest.fixture
def lag(tmp_path, monkeypatch):
    (tmp_path / "lag.yaml").write_text(LAG)
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    rig = rig_of("lag")
    return rig, simulate(rig)


def spoken(run, topic, times, values=None):
    """The recording of a run in which a person published on a topic at some times, ns."""
    port = run.rig.topics[topic]
    recording = Recording((t.name, t.msgtype) for t in run.recording.topics.values())
    for name, old in run.recording.topics.items():
        if name == topic:
            messages = [port.layout().encode(t, values or (1.0,) * port.size) for t in times]
            recording.topics[name].times.extend(times)
            recording.topics[name].data.extend(messages)
        else:
            recording.topics[name].times.extend(old.times)
            recording.topics[name].data.extend(map(bytes, old.data))
    return recording


def test_external_messages_are_published_again_by_a_node(lag):
    rig, run = lag
    plain = [m.name for m in rig.members]
    assert like.from_outside(rig, run.recording) == []
    assert like.tape(rig, recalled(run)) == {}
    recording = spoken(run, "lag/offset", [10_000_000])
    (port,) = like.from_outside(rig, recording)
    assert (port.topic, port.name) == ("lag/offset", "input_1")
    made = like.tape(rig, recalled(run, recording=recording, bag=Path("b")))
    assert made[like.TAPE]["parameters"] == {
        "period": "1/100",
        "bag": "b",
        "until": 0.0,
        "inputs": [like.written(port)],
    }
    assert like.tape(rig, recalled(run, recording=recording), 0.5)[like.TAPE]["parameters"]["until"] == 0.5
    again = like.repeated(rig.scenario, recalled(run, recording=recording))
    assert [*again.nodes] == [*plain, like.TAPE]
    assert runs._once(Run(rig, 0, recording)) == [runs.OUTSIDE]
    assert runs._once(Run(rig, 0, run.recording)) == []
    assert runs._once(Run(rig, 0, run.recording, epoch=3)) == ["in real time"]
    branch = {"at_s": 0.1, "from_s": 0.2}
    for left, result in (("", []), ("x", [runs.CHANGED])):
        done = Run(rig, 0, run.recording)
        done.branched = [branch | {"left": left}]
        assert runs._once(done) == result


def test_a_bag_or_a_folder_identifies_its_run(kept, tmp_path):
    options = SimpleNamespace(parsed=[])

    def parse(words):
        options.parsed.append(words)
        return "options"

    result = like.recall(kept / "run", parse)
    assert (result.path, result.options, result.bag, result.epoch, result.late) == (
        kept / "run",
        "options",
        kept / "run/bag",
        0,
        {},
    )
    assert options.parsed[0][:3] == [str(kept / "mine.yaml"), "--mode", "inprocess"]
    content = json.loads((kept / "run/metrics.json").read_text())
    assert {k: dict(v) for k, v in result.made_with.items()} == {k: content[k] for k in ("versions", "code")} | (
        {"contents": content["contents"]} if content["contents"] else {"contents": {}}
    )
    assert like._reached(result.recording, 0) == 100_000_000
    assert like._reached(Recording(()), 7) == 0
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare/metrics.json").write_text("{}")
    for place, message in (
        (
            tmp_path / "bare",
            "that run has no bag, so changes made during the run are unknown; rerun it without --no-record",
        ),
        (tmp_path, "expected the directory of a run, the bag of a run"),
        (tmp_path / "none", "expected the directory of a run"),
    ):
        with pytest.raises(ScenarioError, match=message):
            like.recall(place, parse)

    def unknown(words):
        raise argparse.ArgumentError(None, "unrecognized arguments: --new")

    with pytest.raises(ScenarioError, match="the bag of a run"):
        like.recall(kept / "run", unknown)
    for text, content in (("[1]", {}), ("{", {}), ('{"a": 1}', {"a": 1})):
        (tmp_path / "m.json").write_text(text)
        assert json_object(tmp_path / "m.json") == content


def test_a_topic_with_rare_external_messages_has_no_message_twice(lag):
    rig, run = lag
    sporadic = next((p.topic for m in rig.members for p in m.outputs if p.sporadic), None)
    assert runs.gaps(rig, run.recording) == ""
    if sporadic is None:
        member = rig.members[2]
        port = with_other(member.outputs[0], sporadic=True)
        member = with_other(member, outputs=(port, *member.outputs[1:]))
        rig = with_other(rig, members=(*rig.members[:2], member))
        sporadic = port.topic
    for times, wrong in (
        ([], ""),
        ([0, 20_000_000], ""),
        ([0, 0], "0"),
        ([0, 5_000_000], "0.005"),
        ([20_000_000, 10_000_000], "0.01"),
    ):
        text = runs.gaps(rig, spoken(run, sporadic, times))
        assert text == (
            f"{sporadic}: a message at t = {wrong} s, which is not a tick, or not after the last message"
            if wrong
            else ""
        )
