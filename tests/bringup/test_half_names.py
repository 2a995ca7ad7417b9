"""Incomplete input: each line is completed, or answered by one line with the suggestion."""

import json
from argparse import Namespace

import pytest
from softrig_bringup.cli import main
from softrig_bringup.folder import RUN, ResultsFolder
from softrig_bringup.options.grammar import settings, span
from softrig_bringup.report.report import write_report
from softrig_bringup.study.options import _recounted
from softrig_core import ScenarioError
from softrig_core.command_line import pair

RUN_B4 = "run dc_motor_smc_b4 --mode inprocess --set"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (f"{RUN_B4} kp=2", "kp: expected node.parameter; did you mean dc_motor_pid.kp?"),
        (f"{RUN_B4} pid.kp=2", "pid.kp: expected node.parameter; did you mean dc_motor_pid.kp?"),
        ("run dc_motor_smc_b2 --set Kt=0.1", "did you mean dc_motor_plant.Kt or dc_motor_smc.Kt?"),
        (f"{RUN_B4} dc_motor_pid.kp = 2", "unexpected argument '='; NAME=VALUE is one word, without spaces"),
        (f"{RUN_B4} kp 2", "NAME=VALUE is one word, without spaces"),
        (f"{RUN_B4} kp:=2", "expected kp=2, without the colon of ros2"),
        (f"{RUN_B4} dc_motor_pid/kp=2", "did you mean dc_motor_pid.kp?"),
        (f"{RUN_B4} KP=2", "did you mean dc_motor_pid.kp?"),
        (f"{RUN_B4} dc_motor_pid.Kp=2", "parameter Kp is unknown (did you mean 'kp'?)"),
        (
            f"{RUN_B4} dc_motor_pid.kp=2..3",
            "expected one value; a study draws from a range, `softrig study dc_motor_smc_b4 ",
        ),
        ("run dc_motor_smc_b4 kp=2", "each NAME=... has its own option before it, --set"),
        ("run dc_motor_smc_b4 --kp 2", "unexpected option '--kp'; parameters are named by --set"),
        ("run dc_motor_smc_b4 --container", "did you mean '--mode container'?"),
        (
            "run dc_motor_smc_b4 dc_motor_smc_b2",
            "one scenario at a time; `softrig study ONE --against OTHER` compares two",
        ),
        ("run dc_motor_smc_b4.yaml", "a scenario of this name is there: dc_motor_smc_b4"),
        ("run mine", "mine: is a run, expected a scenario; `softrig run --like mine` repeats that run"),
        ("study b4", "'b4' is neither a study nor a scenario (did you mean 'dc_motor_smc_b4'?)"),
        ("dc_motor_pid_b3", "is no verb and no scenario; did you mean `softrig run dc_motor_smc_b3`?"),
        ("report many", "many: no such folder, expected that of a run (did you mean 'runs/many'?)"),
        ("report runs/many", "runs/many: is a study; its page is runs/many/report.html"),
        ("pack many", "(did you mean 'runs/many'?)"),
        ("draw mine", "draw: 'mine' is a run; `softrig draw plot mine` draws its signals"),
        ("claims dc_motor", "VERB 'claims' is unknown (did you mean `softrig check --claims`?)"),
        ("draw plot many", "expected a run, a bag or a pack (did you mean 'runs/many'?)"),
        ("bag info many", "many does not exist (did you mean 'runs/many'?)"),
        (
            "bag info recorded",
            "is not a bag: no metadata.yaml, no .mcap and no .db3 file in it; bags below it: recorded/a/bag",
        ),
        ("bag ls", "(did you mean `softrig bag info BAG`?)"),
        ("bag export mine --csv", "unexpected option '--csv' (did you mean '--format csv'?)"),
        ("study dc_motor_smc_b4 --draws 5", "--draws 5: nothing is drawn, expected --draw NAME=LOW..HIGH"),
        ("study dc_motor_smc_b4 --maximise", "--maximise: there is no search, expected --search FIGURE"),
        ("study dc_motor_smc_b4 --over kp=1..2", "parameters are named by --grid or --draw or --against"),
        ("study dc_motor_smc_b4 --draw dc_motor_pid.kp=1-3", "(did you mean dc_motor_pid.kp=1..3?)"),
        ("study dc_motor_smc_b4 --grid dc_motor_pid.kp=1;2", "expected A,B,C: dc_motor_pid.kp=1,2"),
        ("falsify dc_motor_smc_b4 --draw kp=1..3", "parameters are named by --over"),
        ("export matlab dc_motor_smc_b4", "kind 'matlab' is unknown; expected fmu, c, st, arduino, cortex-m"),
        ("test", "VERB 'test' is unknown (did you mean `softrig check SCENARIO`?)"),
        (f"{RUN_B4} dc_motor_pid.kp=2,5", "expected a decimal point, dc_motor_pid.kp=2.5, or a list, [2, 5]"),
        ("steady dc_motor_smc_b4 --set kp=2", "did you mean dc_motor_pid.kp?"),
        ("study dc_motor_smc_b4 --grid kp=1,2", "kp: expected node.parameter; did you mean dc_motor_pid.kp?"),
        ("study dc_motor_smc_b4 --draw kp=1..2", "did you mean dc_motor_pid.kp?"),
        ("study dc_motor_smc_b4 --grid dc_motor_pid.kp=1..2", "a range LOW..HIGH are drawn by --draw"),
        ("study dc_motor_smc_b4 --draw dc_motor_pid.kp=1:2", "(did you mean dc_motor_pid.kp=1..2?)"),
        ("study dc_motor_smc_b4 --draw dc_motor_pid.kp=1:2:0.5", "LOW:HIGH:STEP is a grid, --grid"),
        ("study dc_motor_smc_b4 --draw dc_motor_pid.kp=0,5..1,5", "expected LOW..HIGH with decimal points"),
        (
            "falsify dc_motor_smc_faults --over delta=1..2",
            "delta: expected node.parameter; did you mean dc_motor_smc.delta?",
        ),
        ("dc_motor_smc_b4 --mode inprocess", "is a scenario, expected a verb before it: `softrig run dc_motor_smc_b4`"),
        ("mine", "'mine' is a run, expected a verb before it: `softrig report mine`"),
        ("runs/many", "'runs/many' is a study; its page is runs/many/report.html"),
        ("mine.yaml", "'mine.yaml' is a scenario, expected a verb before it: `softrig run mine.yaml`"),
        ("report empty", "empty: no metrics.json there, expected directories of runs"),
    ],
)
def test_an_incomplete_name_is_answered_by_the_complete_one(words, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("mine", "runs/many", "empty"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "recorded" / "a" / "bag").mkdir(parents=True)
    (tmp_path / "recorded" / "a" / "bag" / "metadata.yaml").write_text("")
    (tmp_path / "mine" / "metrics.json").write_text("{}")
    (tmp_path / "runs" / "many" / "study.json").write_text("{}")
    (tmp_path / "mine.yaml").write_text("title: mine\n")
    assert main(words.split()) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


def test_spaces_around_the_equals_sign_do_not_matter():
    assert settings(["dc_motor_smc.delta = 2.5", " a.b=[1, 2] "]) == {"dc_motor_smc.delta": 2.5, "a.b": [1, 2]}
    assert (pair("a.b = 2"), pair(" s += 1..2 "), pair("a= x=1")) == ("a.b=2", "s+=1..2", "a=x=1")
    assert span("kp", "1 .. 3") == span("kp", "1..3")
    for text in ("a.b =", "= 2", "a.b"):
        with pytest.raises(ScenarioError, match="expected NAME=VALUE"):
            settings([text])


def test_a_folder_of_runs_is_read_as_its_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for k in (1, 2):
        words = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.1", "--no-plots"]
        assert main([*words, "--set", f"dc_motor_smc.delta={k}", "--out", f"runs/r{k}"]) == 0
    assert (main(["bag", "info", "runs/r1"]), main(["bag", "compare", "runs/r1", "runs/r1/bag"])) == (0, 0)
    write_report([tmp_path / "runs"], tmp_path / "all.html")
    write_report([tmp_path / "runs" / "r1", tmp_path / "runs" / "r2"], tmp_path / "both.html")
    assert (tmp_path / "all.html").read_text() == (tmp_path / "both.html").read_text()


@pytest.mark.parametrize("error", ["node plant: gone", ""])
def test_a_broken_run_is_kept_aside_and_its_folder_is_free(error, tmp_path, monkeypatch, capsys):
    """Messages of an outside node cannot be made again, so they are kept; only a completed run requires --force."""
    monkeypatch.chdir(tmp_path)
    folder = ResultsFolder(tmp_path / "mine", RUN)
    folder.begin()
    content = {"scenario": "lag", "mode": "processes", "seed": 0, "error": error, "once": ["gain from outside"]}
    (tmp_path / "mine" / "metrics.json").write_text(json.dumps(content))
    folder.close()
    folder.let_go()
    words = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.1", "--no-plots", "--out", "mine"]
    assert main(words) == (0 if error else 2)
    printed = capsys.readouterr().err
    kept = tmp_path / "mine-broke-1"
    if error:
        assert "the run that broke in mine is kept as mine-broke-1" in printed
        assert json.loads((kept / "metrics.json").read_text()) == content
        assert json.loads((tmp_path / "mine" / "metrics.json").read_text())["scenario"] == "dc_motor_smc_b2"
    else:
        assert "cannot be made again (gain from outside); expected another folder, or --force" in printed
        assert not kept.exists()


def test_help_and_version_are_verbs(capsys):
    for words, begins in (("help run", "usage: softrig run"), ("help", "usage: softrig"), ("version", "softrig ")):
        with pytest.raises(SystemExit) as end:
            main(words.split())
        assert end.value.code == 0
        assert capsys.readouterr().out.startswith(begins)


def test_parameters_are_listed_in_the_form_of_set(capsys):
    assert main(["list", "--parameters", "dc_motor_smc_b4"]) == 0
    rows = dict(line.split("\t", 1) for line in capsys.readouterr().out.splitlines())
    assert rows["dc_motor_plant.R"] == "0.4\tohm\t0..\t\tarmature resistance R"
    assert rows["dc_motor_pid.set_point"].split("\t")[:4] == ["10.0", "rad/s", "", "live"]


def test_a_shipped_study_accepts_other_counts(monkeypatch):
    options = Namespace(draws=7, draw=[], study="s")
    assert _recounted({"draws": {"count": 3, "seed": 1}, "search": None}, options)["draws"] == {"count": 7, "seed": 1}
    assert _recounted({"draws": None, "search": {"count": 3}}, options)["search"] == {"count": 7}
    with pytest.raises(ScenarioError, match="--draws 7: s draws nothing"):
        _recounted({"draws": None, "search": None}, options)
