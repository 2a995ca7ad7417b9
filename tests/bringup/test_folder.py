"""The folder of results: the output of an earlier run of softrig is replaced, nothing else is touched."""

import json
import os

import pytest
from softrig_bringup.cli import main
from softrig_bringup.folder import MANIFEST, ResultsFolder, alone_in
from softrig_core import ScenarioError
from softrig_core.timebase import SECOND
from softrig_core.wire.parameter_event import encode
from softrig_core.wire.recording import ShardWriter

TICK = SECOND // 100
RUN = ["run", "dc_motor_smc_b2", "--mode", "inprocess"]


def names(path):
    return sorted(str(p.relative_to(path)) for p in path.rglob("*") if p.is_file())


def test_a_run_replaces_the_previous_one_and_reports_it(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*RUN, "--duration", "0.1", "--out", str(out)]) == 0
    first = names(out)
    assert sorted(json.loads((out / MANIFEST).read_text())) == first
    assert "replacing" not in capsys.readouterr().err
    assert main([*RUN, "--out", str(out), "--seed", "1", "--no-plots"]) == 0
    assert "replacing dc_motor_smc_b2 (inprocess, seed 0)" in capsys.readouterr().err
    assert names(out) == ["bag/bag_0.mcap", "bag/metadata.yaml", "metrics.json", MANIFEST]


def test_other_files_stay_and_stop_a_run_if_they_are_in_its_way(tmp_path, capsys):
    out = tmp_path / "out"
    (out / "mine").mkdir(parents=True)
    (out / "mine/notes.txt").write_text("mine")
    (out / "photo.png").write_text("mine")
    assert main([*RUN, "--out", str(out), "--no-plots"]) == 0
    assert main([*RUN, "--out", str(out), "--no-plots"]) == 0
    assert (out / "mine/notes.txt").read_text() == (out / "photo.png").read_text() == "mine"
    for name in ("bag/theirs", "plot_01_x.png", "metrics.json"):
        other = tmp_path / name.replace("/", "_")
        (other / name).parent.mkdir(parents=True)
        (other / name).write_text("theirs")
        assert main([*RUN, "--out", str(other)]) == 2
        assert "was not written by a run of softrig" in capsys.readouterr().err
        assert (other / name).read_text() == "theirs"


def test_nothing_outside_the_folder_is_removed(tmp_path):
    """Neither by an edited manifest nor by links in place of our folders."""
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "file").write_text("keep")
    out = tmp_path / "out"
    out.mkdir()
    (out / "log").symlink_to(precious)
    listed = ["../precious/file", str(precious / "file"), "log/file", "log", "bag/../../precious/file", 3]
    (out / MANIFEST).write_text(json.dumps([*listed, MANIFEST]))
    ResultsFolder(out).clear()
    assert (precious / "file").read_text() == "keep"
    assert names(out) == [MANIFEST]


def test_the_remains_of_a_killed_run_do_not_stop_another(tmp_path):
    out = tmp_path / "out"
    (out / "mine").mkdir(parents=True)
    (out / "mine/notes.txt").write_text("mine")
    ResultsFolder(out).clear()
    (out / "log").mkdir()
    (out / "log/plant.shard").write_text("of a run that was killed here")
    assert main([*RUN, "--out", str(out), "--no-plots"]) == 0
    assert names(out) == ["bag/bag_0.mcap", "bag/metadata.yaml", "metrics.json", "mine/notes.txt", MANIFEST]
    (out / "report.html").write_text("theirs")  # a file that the user added after the run
    with pytest.raises(ScenarioError, match="was not written by a run of softrig"):
        ResultsFolder(out)


def test_a_killed_run_that_cannot_be_made_again_stays(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "runs" / "dc_motor_smc_b2"
    for shard in (False, True):
        folder = ResultsFolder(out)
        folder.clear("in real time")
        folder.let_go()
        if shard:
            (out / "log").mkdir()
            (out / "log" / "plant.shard").write_text("an hour of a run that was killed here")
        assert main([*RUN, "--no-plots", "--no-record"]) == 0  # the run is stored where no result exists yet
        assert (out / "metrics.json").is_file() != shard
    text = f"its run cannot be made again (in real time, and broken off: softrig bag repair {out / 'log'})"
    assert text in capsys.readouterr().err
    assert (out.with_name("dc_motor_smc_b2-2") / "metrics.json").is_file()
    assert main([*RUN, "--no-plots", "--no-record", "--force"]) == 0
    assert not (out / "log").exists()


@pytest.mark.parametrize(
    ("note", "why"),
    [
        (encode(TICK, "/dc_motor_smc", {"delta": 3.0}), ""),  # the scenario's value again, so nothing has changed
        (encode(TICK, "/dc_motor_smc", {"delta": 2.0}), "parameters were changed while it ran"),
        (b"damaged", "parameters may have been changed while it ran"),
    ],
    ids=["the scenario's own", "tuned", "damaged"],
)
def test_a_killed_lockstep_run_with_changed_parameters_stays(tmp_path, monkeypatch, capsys, note, why):
    """The changes are in the shards while the run lasts."""
    monkeypatch.chdir(tmp_path)
    changes = "changes:\n- {at: 0.01, set: {dc_motor_smc.delta: 3.0}}\n"
    (tmp_path / "mine.yaml").write_text(f"title: Mine\nextends: dc_motor_smc_b2\nduration: 0.05\n{changes}")
    folder = ResultsFolder(tmp_path / "runs" / "mine")
    folder.clear()
    folder.let_go()
    (log := folder.path / "log").mkdir()
    shard = ShardWriter(log / "dc_motor_smc.shard", [("motor/command", "std_msgs/msg/Float64")])
    shard.note(TICK, encode(TICK, "/dc_motor_smc", {"delta": 3.0}))  # the first message is always written to the file
    shard.note(TICK, note)
    assert main(["run", "mine.yaml", "--mode", "inprocess", "--no-plots", "--no-record"]) == 0
    assert (folder.path / "metrics.json").is_file() != bool(why)
    assert bool(why) == (f"({why}, and broken off: softrig bag repair {log})" in capsys.readouterr().err)
    del shard


def test_a_killed_run_with_a_changed_branch_stays(tmp_path, monkeypatch, capsys):
    """After a rewind without a change, the shards hold the last branch and a separate file holds the first."""
    monkeypatch.chdir(tmp_path)
    folder = ResultsFolder(tmp_path / "runs" / "dc_motor_smc_b2")
    folder.clear()
    folder.let_go()
    (folder.path / "left_1.yaml").write_text("what was tuned")
    assert main([*RUN, "--no-plots", "--no-record"]) == 0
    assert (folder.path / "left_1.yaml").read_text() == "what was tuned"
    text = f"(left_1.yaml, and broken off: softrig bag repair {folder.path / 'log'})"
    assert text in capsys.readouterr().err


def test_a_file_at_the_path_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(ScenarioError, match="out is a file, expected a folder"):
        ResultsFolder(tmp_path / "out")


def test_runs_that_differ_have_folders_of_their_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*RUN, "--no-plots", "--no-record"]) == 0
    assert main([*RUN, "--no-plots", "--no-record", "--set", "dc_motor_smc.delta=1.0"]) == 0
    assert main([*RUN, "--no-plots", "--no-record", "--seed", "3", "--duration", "5"]) == 0
    assert sorted(p.name for p in (tmp_path / "runs").iterdir()) == [
        "dc_motor_smc_b2",
        "dc_motor_smc_b2-dc_motor_smc.delta=1.0",
        "dc_motor_smc_b2-duration_5.0-seed_3",
    ]


def test_a_changed_gain_does_not_fail(tmp_path, capsys):
    """The paper's numbers are shown for comparison; metrics.json says what was changed."""
    assert main([*RUN, "--no-plots", "--set", "dc_motor_smc.delta=20.0", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "not judged" in printed
    assert "MISS" not in printed
    assert json.loads((tmp_path / "metrics.json").read_text())["changed"] == ["dc_motor_smc.delta=20.0"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  dc_motor_plant:", "  ../../evil:", "nodes.../../evil"),
        ("executable: dc_motor_plant", "executable: ../../../bin/sh", "executable"),
        ("{reference: motor/reference}", "{reference: ../x}", "remap"),
    ],
)
def test_invalid_ros_names_are_refused(tmp_path, capsys, monkeypatch, old, new, message):
    from softrig_core import list_scenarios

    text = list_scenarios()["dc_motor_smc"].read_text()
    assert old in text
    (tmp_path / "x.yaml").write_text(text.replace(old, new))
    monkeypatch.chdir(tmp_path)
    assert main(["run", "x.yaml", "--mode", "inprocess"]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert names(tmp_path) == ["x.yaml"]


def test_a_folder_that_is_being_written_belongs_to_one_call(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first = ResultsFolder(tmp_path / "runs" / "dc_motor_smc_b2")
    first.clear()
    assert main([*RUN, "--duration", "0.1", "--no-plots", "--out", "runs/dc_motor_smc_b2"]) == 2
    assert f"process {os.getpid()} is writing there; expected another folder\n" in capsys.readouterr().err
    assert main([*RUN, "--no-plots"]) == 0  # the folder's name is in use, so the run is stored beside it
    assert "this run goes to runs/dc_motor_smc_b2-2" in capsys.readouterr().err
    assert names(first.path) == [MANIFEST]
    first.close()
    first.let_go()
    assert main([*RUN, "--no-plots"]) == 0
    assert "bag/metadata.yaml" in names(first.path)


@pytest.mark.parametrize("what", [{"once": ["parameters were changed while it ran"]}, {"code": {"pump_rig": "1"}}])
def test_a_run_that_cannot_be_made_again_is_replaced_only_by_force(tmp_path, monkeypatch, capsys, what):
    monkeypatch.chdir(tmp_path)
    words = [*RUN, "--no-plots", "--no-record"]
    assert main(words) == 0
    file = tmp_path / "runs" / "dc_motor_smc_b2" / "metrics.json"
    kept = json.dumps(json.loads(file.read_text()) | what)
    file.write_text(kept)
    assert main([*words, "--out", "runs/dc_motor_smc_b2"]) == 2
    assert "cannot be made again (" in capsys.readouterr().err
    assert main(words) == 0
    assert file.read_text() == kept
    assert (tmp_path / "runs" / "dc_motor_smc_b2-2" / "metrics.json").is_file()
    assert main([*words, "--force"]) == 0
    assert file.read_text() != kept


@pytest.mark.parametrize(
    ("mark", "words"),
    [
        ("study.json", [*RUN, "--no-plots"]),
        ("falsification.json", [*RUN, "--no-plots"]),
        ("metrics.json", ["study", "dc_motor_smc", "--seeds", "2"]),
        ("falsification.json", ["study", "dc_motor_smc", "--seeds", "2"]),
        ("study.json", ["falsify", "dc_motor_fsfb_late"]),
    ],
)
def test_results_of_another_kind_are_not_replaced(tmp_path, capsys, mark, words):
    (tmp_path / mark).write_text("{}")
    (tmp_path / MANIFEST).write_text(json.dumps([mark, MANIFEST]))
    assert main([*words, "--out", str(tmp_path)]) == 2
    assert f"{tmp_path} holds a {mark.removesuffix('.json').replace('metrics', 'run')}" in capsys.readouterr().err
    assert names(tmp_path) == sorted([mark, MANIFEST])


def test_a_folder_of_pages_and_one_of_a_golden_bag_have_one_writer(tmp_path, capsys):
    (tmp_path / "dc_motor_smc_b2").mkdir()
    for words, place in (
        (["check", "--claims", "dc_motor_fsfb", "--out", str(tmp_path)], tmp_path),
        (["golden", "dc_motor_smc_b2", "--bags", str(tmp_path), "--duration", "0.01"], tmp_path / "dc_motor_smc_b2"),
    ):
        with alone_in(place):
            assert main(words) == 2
        assert f"{place}: process {os.getpid()} is writing there" in capsys.readouterr().err


def test_a_fork_does_not_hold_the_folder_of_its_parent(tmp_path):
    """A worker of a study may end a little later: the next writer need not wait for it."""
    folder, other = ResultsFolder(tmp_path / "a"), ResultsFolder(tmp_path / "a")
    (tmp_path / "a").mkdir()
    assert folder.hold() is None
    ready, tell = os.pipe()
    wait, end = os.pipe()
    child = os.fork()
    if not child:
        os.close(end)
        os.write(tell, b"1")
        os.read(wait, 1)
        os._exit(0)
    try:
        assert os.read(ready, 1) == b"1"
        assert other.hold() is not None  # a child that inherited the lock must not release it when it ends
        folder.let_go()
        assert other.hold() is None
        other.let_go()
    finally:
        os.close(end)
        os.waitpid(child, 0)
        for pipe in (ready, tell, wait):
            os.close(pipe)
