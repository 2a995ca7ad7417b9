"""Studies: points, rows, interruption and resumption, searches, summaries, pictures."""

import csv
import itertools
import json
import math
import multiprocessing
import re
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from conftest import PATIENCE, few, until
from expected_text import check_expected, figure_lines, on_paper, page_lines
from softrig_bringup.cli import main, make_parser
from softrig_bringup.folder import STUDY, ResultsFolder
from softrig_bringup.options.grammar import values
from softrig_bringup.page.html import page as make_page
from softrig_bringup.plots.named import plot_name
from softrig_bringup.study import page, pictures
from softrig_bringup.study.batch import Log
from softrig_bringup.study.definition import list_studies, load_study, make_study
from softrig_bringup.study.draw import drafts_of, draw
from softrig_bringup.study.engine import check_study, run_study
from softrig_bringup.study.options import folder_name, study_of
from softrig_bringup.study.page import best
from softrig_bringup.study.statistics import statistics
from softrig_bringup.study.table import claims, results, without_signals
from softrig_bringup.study.work import absent
from softrig_core import ScenarioError

LAG = """
title: First-order lag
system: lag
source: none
duration: 0.5
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain}
figures:
  last: {function: final_value, arguments: {signal: lag/state/x/position}}
  never: {function: rise_time, arguments: {signal: lag/state/x/position, final: 1e9}}
variants:
  breaks: {nodes: {gain: {executable: killed, parameters: {how: raise, at: 0.2}}}}
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    (tmp_path / "scenarios").mkdir()
    (tmp_path / "studies").mkdir()
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path / "scenarios"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenarios" / "lag.yaml").write_text(LAG)
    return tmp_path


def study(**keys):
    return make_study({"name": "demo", "title": "Demo", "scenario": "lag"} | keys)


def rows_of(study, out, **keys):
    return without_signals(run_study(study, out, **({"workers": 1} | keys)).rows())


# points -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["random", "latin_hypercube", "sobol"])
def test_draws_follow_their_distributions(method):
    parameters = {
        "u": {"uniform": [2.0, 4.0]},
        "l": {"log_uniform": [0.01, 100.0]},
        "n": {"normal": [5.0, 0.5]},
        "i": {"integers": [1, 3]},
        "c": {"choice": ["x", "y"]},
        "v": {"uniform": [[0.0, 10.0], [1.0, 20.0]]},
    }
    draws = study(draws={"count": 2048, "seed": 3, "method": method, "parameters": parameters}).draws
    points = draw(draws)
    assert draw(draws) == points
    columns = {k: np.array([p[k] for p in points]) for k in ("u", "l", "n", "i", "v")}
    assert (columns["u"].min() >= 2.0, columns["u"].max() < 4.0) == (True, True)
    assert columns["u"].mean() == pytest.approx(3.0, abs=0.05)
    assert np.median(columns["l"]) == pytest.approx(1.0, rel=0.35)
    assert (columns["n"].mean(), columns["n"].std()) == pytest.approx((5.0, 0.5), abs=0.05)
    assert sorted(set(columns["i"])) == [1, 2, 3]
    assert columns["v"].mean(axis=0) == pytest.approx([0.5, 15.0], rel=0.05)
    assert 0.4 < np.mean([p["c"] == "x" for p in points]) < 0.6


def test_a_latin_hypercube_has_one_point_in_each_slice():
    draws = study(draws={"count": 50, "parameters": {"u": {"uniform": [0, 1]}, "w": {"uniform": [0, 1]}}}).draws
    for name in "uw":
        assert sorted(int(p[name] * 50) for p in draw(draws)) == list(range(50))


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("", "study_lag"),
        ("--grid gain.k=1,2 --grid plant.T=0.1:0.3:0.1 --seeds 5", "study_lag-gain.k=1,2-plant.T=0.1:0.3:0.1-seeds_5"),
        ("--draw gain.k=1..2 --draws 7", "study_lag-gain.k=1..2-latin_hypercube_7"),
        (
            "--draw gain.k=1..2 --search last --maximise --subject-to last<=5",
            "study_lag-gain.k=1..2-latin_hypercube_100-max_last-last_=5-9adb3f55",
        ),
    ],
)
def test_a_folder_is_named_by_the_varied_parameters(words, name):
    assert folder_name("lag", make_parser().parse_args(["study", "lag", *words.split()])) == name


def test_long_names_of_folders_stay_distinct():
    names = {
        folder_name("lag", make_parser().parse_args(["study", "lag", "--grid", f"gain.k={'1,' * 99}{k}"]))
        for k in range(3)
    }
    assert len(names) == 3
    assert max(map(len, names)) < 140


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"draws": {"count": 0, "parameters": {"a": {"uniform": [0, 1]}}}}, "draws.count"),
        ({"draws": {"count": 1, "parameters": {"a": {"uniform": [1, 0]}}}}, "expected a lower and an upper bound"),
        ({"draws": {"count": 1, "parameters": {"a": {}}}}, "expected one of uniform"),
        ({"draws": {"count": 1, "parameters": {"a": {"log_uniform": [0, 1]}}}}, "bounds above 0"),
        ({"grid": {"a": []}}, "grid.a"),
        ({"seeds": [-1]}, "seeds"),
        ({"seeds": 10_000_000_000}, "seeds: expected 1 to 1000000 seeds, or a list of them, got 10000000000"),
        ({"seeds": 0}, "expected 1 to 1000000 seeds"),
        ({"draws": {"count": 10**10, "parameters": {"a": {"uniform": [0, 1]}}}}, "draws.count"),
        ({"search": {"figure": "f", "count": 10**10, "parameters": {"a": {"uniform": [0, 1]}}}}, "search.count"),
        ({"summaries": {"s": {"figure": "last", "statistic": "share"}}}, "share, and allowed only there"),
        ({"expect": {"s": "at most 1"}}, "expect: no summary 's'"),
        (
            {"grid": {"a": [1]}, "search": {"figure": "f", "count": 1, "parameters": {"a": {"uniform": [0, 1]}}}},
            "not with cases, grid or draws",
        ),
    ],
)
def test_a_contradictory_study_is_refused(keys, message):
    with pytest.raises(ScenarioError, match=message):
        study(**keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"figures": ["lost"]}, "lag has no figure 'lost' \\(did you mean 'last'\\?\\); it has last, never"),
        ({"summaries": {"s": {"figure": "lost"}}}, "no figure 'lost'"),
        ({"signals": ["lag/state/y"]}, "no signal 'lag/state/y'"),
        ({"grid": {"pump.k": [1]}}, "pump.k: expected node.parameter; did you mean gain.k"),
        ({"cases": {"a": {}, "b": {"gain.k": "x"}}}, "node gain: parameter k = 'x'"),
        ({"scenario": "leg"}, "scenario 'leg' is unknown"),
    ],
)
def test_an_impossible_run_is_reported_before_the_first(folder, keys, message):
    with pytest.raises(ScenarioError, match=message):
        run_study(study(**keys), folder / "out", workers=1)
    assert (folder / "out" / "rows.jsonl").exists() is False


# rows -------------------------------------------------------------------------------------------------------------


def test_a_row_states_how_to_repeat_its_run(folder):
    assert main(["study", "lag", "--grid", "gain.k=1,2.5", "--seeds", "2", "--force", "--duration", "0.25",
                 "--workers", "1", "--out", "out"]) == 0  # fmt: skip
    table = pyarrow.parquet.read_table(folder / "out" / "table.parquet").to_pylist()
    with (folder / "out" / "table.csv").open() as file:
        assert [r["command"] for r in csv.DictReader(file)] == [r["command"] for r in table]
    assert [(r["gain.k"], r["seed"]) for r in table] == [(1.0, 0), (1.0, 1), (2.5, 0), (2.5, 1)]
    assert all(r["figure.never"] is None for r in table)
    words = shlex.split(table[3]["command"])
    assert (Path(words[0]).name, words[1]) == ("softrig", "run")
    assert main([*words[1:], "--no-plots", "--no-record", "--out", "again"]) == 0
    again = json.loads((folder / "again" / "metrics.json").read_text())
    assert again["metrics"][0]["value"] == table[3]["figure.last"]
    assert again["seed"] == 1
    page = (folder / "out" / "report.html").read_text()
    assert "Study of lag" in page
    assert "k 2.5" in page


def test_a_shared_value_is_a_parameter_of_a_study(folder):
    text = LAG.replace("nodes:", "shared: {k: 2.0}\nnodes:", 1)
    text = text.replace("executable: gain}", "executable: gain, parameters: {k: $k}}", 1)
    (folder / "scenarios" / "lag.yaml").write_text(text)
    rows = rows_of(study(grid={"k": [1.0, 2.0]}, duration=0.25), folder / "shared")
    singly = rows_of(study(grid={"gain.k": [1.0, 2.0]}, duration=0.25), folder / "singly")
    assert [r["figures"] for r in rows] == [r["figures"] for r in singly]
    assert rows[0]["figures"] != rows[1]["figures"]


def test_each_study_reads_its_scenario_again(folder):
    first, again = (rows_of(study(), folder / name) for name in ("first", "again"))
    (folder / "scenarios" / "lag.yaml").write_text(LAG.replace("  last:", "  end:") + "seed: 5\n")
    changed = rows_of(study(), folder / "changed")
    assert again[0]["figures"] == first[0]["figures"]
    assert (changed[0]["seed"], changed[0]["figures"]) == (5, {"end": first[0]["figures"]["last"], "never": None})


def test_a_broken_run_is_a_row_with_its_reason(folder, capsys):
    assert main(["study", "lag_breaks", "--grid", "plant.gain=1,2", "--workers", "1", "--out", "out"]) == 3
    rows = [json.loads(line) for line in (folder / "out" / "rows.jsonl").read_text().splitlines()]
    assert len(rows) == 2
    assert all("gain" in r["error"] for r in rows)


def test_an_interrupted_study_is_resumed(folder):
    demo = study(grid={"gain.k": [1.0, 2.0, 3.0]}, seeds=2)
    whole = rows_of(demo, folder / "whole")
    part = folder / "part"
    run_study(demo, part, workers=1)
    lines = (part / "rows.jsonl").read_bytes().splitlines(keepends=True)
    # As if the study had been killed while it wrote the fourth row.
    (part / "rows.jsonl").write_bytes(b"".join(lines[:3]) + lines[3][:20])
    kept = lines[:3]
    resumed = rows_of(demo, part)
    assert [(r["number"], r["figures"]) for r in resumed] == [(r["number"], r["figures"]) for r in whole]
    assert (part / "rows.jsonl").read_bytes().splitlines(keepends=True)[:3] == kept
    with pytest.raises(ScenarioError, match="holds another study"):
        run_study(study(grid={"gain.k": [1.0]}), part, workers=1)


def test_rows_of_another_scenario_or_code_are_not_reused(folder, monkeypatch):
    file, out = folder / "scenarios" / "lag.yaml", folder / "out"
    demo = study(grid={"gain.k": [1.0, 2.0]}, seeds=[0])
    first = rows_of(demo, out)
    file.write_text(LAG.replace("title: First-order lag", "title: Renamed") + "# a remark\n")
    assert rows_of(demo, out) == first
    file.write_text(LAG.replace("executable: plant}", "executable: plant, parameters: {gain: 3.0}}"))
    with pytest.raises(ScenarioError, match=r"another study \(scenario lag has changed\); choose another --out"):
        run_study(demo, out, workers=1)
    file.write_text(LAG)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("softrig_bringup.study.engine.fingerprints", lambda *_: {"faultrig": "edited"})
        with pytest.raises(ScenarioError, match=r"another study \(the code of faultrig, .* has changed\)"):
            run_study(demo, out, workers=1)
    assert rows_of(demo, out) == first
    assert [r["figures"] for r in rows_of(demo, folder / "anew")] == [r["figures"] for r in first]


def test_an_edit_while_a_study_runs_does_not_change_it(folder, monkeypatch):
    demo = study(cases={"a": {}, "b": {"plant.gain": 2.0}})
    whole = rows_of(demo, folder / "whole")
    add, file = Log.add, folder / "scenarios" / "lag.yaml"

    def edited(self, row):
        add(self, row)
        file.write_text(LAG.replace("duration: 0.5", "duration: 0.1\nseed: 5"))

    monkeypatch.setattr(Log, "add", edited)
    second_rows = rows_of(demo, folder / "there", workers=1)
    assert [(r["seed"], r["figures"]) for r in second_rows] == [(r["seed"], r["figures"]) for r in whole]


def test_a_log_without_rows_is_empty(folder):
    assert list(Log(folder / "log", 1).rows()) == []


def test_the_number_of_workers_does_not_matter_and_a_killed_one_loses_nothing(folder, monkeypatch):
    demo = study(grid={"gain.k": [0.5 + 0.05 * k for k in range(40)]}, duration=5.0)
    first_rows = rows_of(demo, folder / "here")
    killed, add = [], Log.add

    def kill(self, row):
        """Kill a worker at the first row."""
        if not killed:
            killed.append(multiprocessing.active_children()[0])
            killed[0].kill()
        add(self, row)

    monkeypatch.setattr(Log, "add", kill)
    second_rows = rows_of(demo, folder / "there", workers=2)
    killed[0].join(PATIENCE)
    assert killed[0].exitcode == -signal.SIGKILL
    assert [(r["number"], r["figures"]) for r in second_rows] == [(r["number"], r["figures"]) for r in first_rows]


def damaged(lines):
    """Each kind of damage in a file of rows, with the numbers of the undamaged rows."""
    other = json.dumps(json.loads(lines[1]) | {"overrides": {"gain.k": 7.0}}).encode() + b"\n"
    lacks = json.dumps({k: v for k, v in json.loads(lines[1]).items() if k != "figures"}).encode() + b"\n"
    return {
        "cut off": (lines[0] + lines[1][:30], 1),
        "without its last newline": (lines[0] + lines[1][:-1], 2),
        "damaged in the middle": (lines[0] + b'{"number": 1, "fig\xff\x00\n' + lines[2], 2),
        "lacks a key": (lines[0] + lacks + lines[2], 2),
        "of another run": (lines[0] + other + lines[2], 2),
        "doubled": (lines[0] + lines[1] + lines[1] + lines[2], 3),
        "of no run": (b"[]\n7\n" + lines[0].replace(b'"number":0', b'"number":99') + lines[0], 1),
    }


@pytest.mark.parametrize(
    "kind",
    [
        "cut off",
        "without its last newline",
        "damaged in the middle",
        "lacks a key",
        "of another run",
        "doubled",
        "of no run",
    ],
)
def test_undamaged_rows_are_read_and_none_of_them_is_lost(kind, folder, capsys):
    demo = study(grid={"gain.k": [1.0, 2.0, 3.0]})
    whole = rows_of(demo, folder / "out")
    file = folder / "out" / "rows.jsonl"
    content, right = damaged(file.read_bytes().splitlines(keepends=True))[kind]
    file.write_bytes(content)
    capsys.readouterr()
    result = rows_of(demo, folder / "out")
    assert [(r["number"], r["overrides"], r["figures"]) for r in result] == [
        (r["number"], r["overrides"], r["figures"]) for r in whole
    ]
    assert ("are no rows of this study" in capsys.readouterr().err) == (kind != "without its last newline")
    assert file.read_bytes().startswith(content)
    assert len(file.read_bytes()[len(content) :].splitlines()) >= 3 - right
    assert rows_of(demo, folder / "out") == result  # all runs are finished


def test_two_studies_do_not_write_into_one_folder(folder):
    demo, out = study(grid={"gain.k": [1.0, 2.0]}), folder / "out"
    with ResultsFolder(out, STUDY).alone(), pytest.raises(ScenarioError, match="is writing there"):
        run_study(demo, out, workers=1)
    assert len(rows_of(demo, out)) == 2


@pytest.mark.parametrize("name", ["rows.jsonl", "report.html", "table.csv", "study.json", "plot_01_figures_over_k.svg"])
def test_a_study_overwrites_only_its_own_files(name, folder, capsys):
    command = ["study", "lag", "--grid", "gain.k=1,2", "--workers", "1", "--out", "out"]
    (folder / "out").mkdir()
    (folder / "out" / name).write_text("theirs")
    if name.endswith(".svg"):
        name = "plot_01_figures_over_gain_k.svg"
        (folder / "out" / name).write_text("theirs")
    assert main(command) == 2
    printed = capsys.readouterr().err
    assert "not written by a run of softrig" in printed or "holds another study" in printed
    assert (folder / "out" / name).read_text() == "theirs"


def test_a_study_follows_no_link_in_its_folder(folder):
    command = ["study", "lag", "--grid", "gain.k=1,2", "--workers", "1", "--out", "out"]
    assert main(command) == 0
    first = {p.name for p in (folder / "out").iterdir()}
    for name in ("report.html", "table.parquet", "study.json", "softrig_files.json", "rows.jsonl"):
        precious, place = folder / f"precious_{name}", folder / "out" / name
        shutil.copy(place, precious)
        content = precious.read_bytes()
        place.unlink()
        place.symlink_to(precious)
        status = main(command)
        assert (precious.read_bytes(), status) == (content, 0 if name != "rows.jsonl" else 2)
        assert name == "rows.jsonl" or not place.is_symlink()
    assert {p.name for p in (folder / "out").iterdir()} == first


def session(pid):
    """Live processes of a session."""
    result = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, _, number = stat.read_text().rpartition(")")[2].split()[:4]
            result += [stat.parent.name] if int(number) == pid and state != "Z" else []
    return result


@pytest.mark.parametrize(
    ("number", "status"),
    few([(signal.SIGTERM, 143), pytest.param(signal.SIGHUP, 129, marks=pytest.mark.long), (signal.SIGKILL, -9)], 1),
)
def test_a_killed_study_leaves_no_process(folder, number, status):
    command = [sys.executable, "-m", "softrig_bringup", "study", "lag", "--duration", "2", "--seeds", "1000",
               "--force", "--workers", "2", "--out", "out"]  # fmt: skip
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    until(lambda: (folder / "out" / "rows.jsonl").exists() and (folder / "out" / "rows.jsonl").stat().st_size)
    assert len(session(process.pid)) >= 3
    process.send_signal(number)
    assert process.wait(PATIENCE) == status
    until(lambda: not session(process.pid))


# over the runs ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "keys", "made"),
    [
        ("summaries", {"grid": {"gain.k": [1, 2, 3]}, "source": "Nobody 2020", "duration": 0.3, "seeds": 2,
                       "summaries": {"mean_last": {"figure": "settling"}, "share_of_it": {
                           "figure": "settling", "statistic": "share", "of": "at most 0.6", "where": {"gain.k": 1.0}}},
                       "expect": {"mean_last": "0.5 +- 0.1", "share_of_it": "at least 0.5"},
                       "claims": {"mean_last": {"published": 0.6, "where": "Table I", "verdict": "reproduced"},
                                  "share_of_it": {"published": 0.1, "where": "Table I", "verdict": "refuted",
                                                  "reason": "it is more"}}}, {"over": (("gain.k", (1.0, 2.0, 3.0)),)}),
        ("few", {"cases": {"a": {}, "bb": {}}, "grid": {"gain.k": [1, 2]}, "figures": ["power", "settling"]},
         {"cases": ("a", "bb"), "over": (("gain.k", (1.0, 2.0)),)}),
        ("best", {"seeds": 2, "search": {"figure": "settling", "count": 4, "subject_to": {"power": "at most 39"},
                                         "parameters": {"gain.k": {"uniform": [1.0, 3.0]}}}},
         {"over": (("gain.k", (2.0, 1.0, 3.0)),)}),
        ("none", {"search": {"figure": "settling", "count": 4, "subject_to": {"power": "at most 1"}, "aim": "maximise",
                             "parameters": {"gain.k": {"uniform": [1.0, 3.0]}}}}, {"seeds": 1}),
    ],
)  # fmt: skip
def test_the_page_of_a_study_and_its_printed_text_are_as_expected(name, keys, made, folder, capsys, monkeypatch):
    """Rows by formula; one of them broke at a point with more than one seed."""
    demo, rows = study(**keys), [row | {"wall_s": 0.25, "ticks": 10} for row in many(**made)]
    if name != "best":
        rows[2] |= {"error": "node gain: RuntimeError: gone", "figures": {}}
    result = results(demo, rows, UNITS)
    held, over = claims(demo, result), statistics(demo, rows, UNITS)
    monkeypatch.setenv("SOFTRIG_COMMAND", "softrig")
    monkeypatch.delenv("COLUMNS", raising=False)
    page.print_study(demo, rows, result, held, over, Path("out"))
    printed = capsys.readouterr().out.replace(str(folder), "HERE").splitlines()
    text = make_page("Demo", page.body_of(demo, rows, result, held, over, [], UNITS)).replace(str(folder), "HERE")
    check_expected(f"studies/page_{name}", [*printed, *page_lines(text)])


def test_expectations_and_claims_of_a_study_are_checked(folder, capsys):
    text = """
title: Gains
scenario: lag
grid: {gain.k: [1.0, 2.0]}
summaries: {largest: {figure: last, statistic: max}}
expect: {largest: at least LIMIT}
claims: {largest: {published: 0.1, where: Table I, verdict: refuted, reason: larger}}
"""
    file = folder / "studies" / "gains.yaml"
    file.write_text(text.replace("LIMIT", "0.001"))
    assert list(list_studies()) == ["gains"]
    assert main(["study", "gains", "--workers", "1"]) == 0
    file.write_text(text.replace("LIMIT", "1000"))
    assert main(["study", "gains", "--workers", "1"]) == 1
    file.write_text(text.replace("LIMIT", "0.001").replace("published: 0.1,", "published: 0.1, tolerance: 10.0,"))
    capsys.readouterr()
    assert main(["study", "gains", "--workers", "1"]) == 1
    assert "the verdict refuted does not hold" in capsys.readouterr().out
    content = json.loads((folder / "runs" / "study_gains" / "summaries.json").read_text())
    assert (content["runs"], content["claims"][0]["holds"]) == (2, False)
    # A study is not judged if options change what its file defines.
    file.write_text(text.replace("LIMIT", "1000"))
    assert main(["study", "gains", "--workers", "1", "--duration", "0.2", "--out", "other"]) == 0
    assert "summaries and claims are not judged: published for the study without other duration" in (
        capsys.readouterr().out
    )
    content = json.loads((folder / "other" / "summaries.json").read_text())
    assert content["claims"][0]["holds"] is None
    assert content["summaries"][0]["published_for"] == "the study without other duration"
    assert ">not judged</span>" in (folder / "other" / "report.html").read_text()
    # These options leave the runs unchanged.
    assert main(["study", "gains", "--workers", "1", "--figures", "last", "--out", "same"]) == 1


def a_row(number, k, value, seed=0, never=()):
    return {
        "number": number,
        "scenario": "lag",
        "case": "",
        "seed": seed,
        "overrides": {"gain.k": k},
        "error": "",
        "figures": {"settling": value},
        "never": list(never),
    }


def test_runs_without_a_value_are_marked_and_counted_and_do_not_improve_the_median():
    rows = [a_row(0, 1.0, 0.5), a_row(1, 1.0, 0.6), a_row(2, 1.0, 0.7)]
    rows += [a_row(3, 2.0, 0.4), a_row(4, 2.0, None, never=["settling"]), a_row(5, 2.0, None, never=["settling"])]
    figure = on_paper(pictures._over(rows, "gain.k", ["settling"], {}, banded=True))
    (ax,) = figure.axes
    # two of three runs never reach the level
    assert list(ax.lines[0].get_ydata()) == pytest.approx([0.6, math.nan], nan_ok=True)
    assert [t.get_text() for t in ax.texts] == ["2 of 3 never"]
    assert ax.get_title(loc="right") == "2 of 6 never"
    assert list(ax.get_xticks()) == [1.0, 2.0]
    assert "band: least to greatest of up to 3 runs" in figure._supxlabel.get_text()
    assert absent([1.0, math.inf, math.nan]) == "1 of 3 never, 1 of 3 not measured"


@pytest.mark.parametrize("number", [pictures.TICKS, pictures.TICKS + 1])
def test_up_to_a_limit_each_value_gets_a_tick(number):
    few, values = number == pictures.TICKS, [0.1 + k for k in range(number)]
    (ax,) = on_paper(pictures._over([a_row(0, k, 0.5) for k in values], "gain.k", ["settling"], {}, banded=True)).axes
    assert (list(ax.get_xticks()) == values) == few
    rows = [a_row(0, k, k * g) for k in values for g in (1.0, 2.0)]
    for row, g in zip(rows, [1.0, 2.0] * number, strict=True):
        row["overrides"]["plant.gain"] = g
    ax = on_paper(pictures._map(rows, ["gain.k", "plant.gain"], "settling", {})).axes[0]
    assert (list(ax.get_xticks()) == values) == few


def test_a_study_reports_never_for_a_figure_without_a_value(folder, capsys):
    assert (
        main(["study", "lag", "--grid", "gain.k=1:3", "--grid", "plant.gain=1,2", "--out", "out", "--workers", "1"])
        == 0
    )
    out = capsys.readouterr().out
    assert out.count("never") == 1 + 6  # once in the head, and once in the row of each run
    assert "None" not in out
    page = (folder / "out" / "report.html").read_text()
    assert page.count(">never</td>") == 6
    table = pyarrow.parquet.read_table(folder / "out" / "table.parquet").to_pylist()
    assert [(r["gain.k"], r["plant.gain"]) for r in table] == [(k, g) for k in (1, 2, 3) for g in (1, 2)]
    assert {r["never"] for r in table} == {"never"}  # the row of the figure "never" says the same


@pytest.mark.parametrize(
    ("text", "result"),
    [
        ("1:5:1", [1, 2, 3, 4, 5]),
        ("0:0.3:0.1", [0.0, 0.1, 0.2, 0.3]),
        ("0.5,1:2", [0.5, 1, 2]),
        ("3:1:-1", [3, 2, 1]),
        ("a,b", ["a", "b"]),
        ("[1, 2],[3, 4]", [[1, 2], [3, 4]]),
    ],
)
def test_ranges_have_both_ends(text, result):
    assert values("gain.k", text) == result


@pytest.mark.parametrize("text", ["1:5:0", "1:0:1", "0:1:1e-9"])
def test_empty_and_infinite_ranges_are_refused(text):
    with pytest.raises(ScenarioError, match="at least one and at most"):
        values("gain.k", text)


def test_a_search_keeps_to_its_limits_and_its_best_is_not_a_lucky_seed(folder, capsys):
    options = ["study", "lag", "--search", "last", "--draws", "8", "--maximise", "--draw", "gain.k=0.5..5", "--workers",
               "1"]  # fmt: skip
    assert main([*options, "--subject-to", "last <= 0.2", "--out", "some"]) == 0
    best_of = float(re.search(r"best: last ([\d.]+)", capsys.readouterr().out)[1])
    rows = [json.loads(line) for line in (folder / "some" / "rows.jsonl").read_text().splitlines()]
    assert best_of == pytest.approx(max(v for r in rows if (v := r["figures"]["last"]) <= 0.2), rel=1e-5)
    assert max(r["figures"]["last"] for r in rows) > 0.2
    page = (folder / "some" / "report.html").read_text()
    assert "<td>last</td>" in re.sub(' data-label="[^"]*"', "", page)
    assert main([*options, "--subject-to", "last >= 99", "--out", "none"]) == 0
    assert "best: none of 8 runs has a last within the limits" in capsys.readouterr().out
    assert main([*options, "--subject-to", "last < 0.4", "--out", "x"]) == 2
    assert main([*options, "--subject-to", "lost <= 0.4", "--out", "x"]) == 2
    demo = study(seeds=2, search={"figure": "settling", "count": 2, "parameters": {"gain.k": {"uniform": [1, 2]}}})
    pairs = [a_row(0, 1.0, 0.1), a_row(1, 1.0, 9.0, 1), a_row(2, 2.0, 1.0), a_row(3, 2.0, 1.0, 1)]
    assert [r["number"] for r in best(demo, pairs)] == [2, 3]


def test_a_search_finds_the_best_gain_with_any_workers_and_resumes(folder):
    parameters = {"gain.k": {"uniform": [0.5, 4.0]}}
    search = {"figure": "last", "aim": "maximise", "count": 24, "batch": 4, "seed": 2, "parameters": parameters}
    whole = rows_of(study(search=search), folder / "whole")
    assert len(whole) == 24
    best = max(whole, key=lambda r: r["figures"]["last"])
    assert best["overrides"]["gain.k"] > 3.0  # a larger gain increases the figure
    file = folder / "whole" / "rows.jsonl"
    file.write_bytes(b"".join(file.read_bytes().splitlines(keepends=True)[:18]))
    again = rows_of(study(search=search), folder / "whole", workers=2)
    assert [(r["number"], r["overrides"], r["figures"]) for r in again] == [
        (r["number"], r["overrides"], r["figures"]) for r in whole
    ]


@pytest.mark.parametrize(
    ("keys", "pictures"),
    [
        (
            {"grid": {"gain.k": [1, 2, 3]}, "seeds": 3, "signals": ["lag/state/x/position"]},
            ["figures_over_gain_k", "distribution", "signal_lag_state_x"],
        ),
        (
            {"grid": {"gain.k": [1, 2], "plant.gain": [1, 2]}},
            ["figures_over_gain_k", "figures_over_plant", "map_of_last"],
        ),
        ({"seeds": 6, "signals": ["lag/command/u"]}, ["distribution", "signal_lag_command_u"]),
        (
            {"draws": {"count": 6, "parameters": {"gain.k": {"uniform": [1, 2]}}}},
            ["figures_over_gain_k", "distribution_over", "figures_over_gain_k"],
        ),
        (
            {"search": {"figure": "last", "count": 4, "parameters": {"gain.k": {"uniform": [1, 2]}}}},
            ["search_last", "search_parallel"],
        ),
    ],
)
def test_pictures_follow_from_the_form_of_the_study(folder, keys, pictures):
    (folder / "studies" / "demo.yaml").write_text(json.dumps({"title": "Demo", "scenario": "lag"} | keys))
    assert main(["study", "demo", "--workers", "1", "--force", "--out", "out"]) == 0
    drawn = [p.name for p in sorted((folder / "out").glob("*.svg"))]
    for name in pictures:
        assert any(name in d for d in drawn), drawn
    page = (folder / "out" / "report.html").read_text()
    titles = re.findall(r'<title id="[^"]*">([^<]*)</title>', page)
    assert [plot_name(k, title) for k, title in enumerate(titles, 1)] == drawn


UNITS = {"settling": "s", "power": "W", "gain.k": "N/m", "plant.gain": "1/s", "lag/state/x/position": "m"}


def many(cases=("",), over=(("gain.k", (1.0, 2.0, 3.0)),), seeds=2):
    """Rows by formula; in some runs a figure never gets a value, in one it was not measured, one broke."""
    for number, (case, at, seed) in enumerate(
        itertools.product(cases, itertools.product(*(v for _, v in over)), range(seeds))
    ):
        settling = 0.3 * sum(at) + 0.07 * seed + 0.2 * len(case)
        lost = number % 7 == 3
        yield a_row(number, 0.0, None if lost else settling, seed, ["settling"] if number % 2 else []) | {
            "case": case,
            "overrides": {name: v for (name, _), v in zip(over, at, strict=True)},
            "figures": {"settling": None if lost else settling, "power": 40.0 - number, "none": None},
        }


def keeping(rows):
    """With one signal each: a line of six samples."""
    for row in rows:
        x = [k * row["figures"]["power"] for k in range(6)]
        yield row | {"signals": {"lag/state/x/position": {"end": 0.5, "x": [] if row["number"] == 1 else x}}}


K, G = ("gain.k", (1.0, 2.0, 3.0)), ("plant.gain", (0.5, 1.5))
FINE = ("gain.k", tuple(0.1 * k for k in range(1, 14)))
SEARCH = {"figure": "settling", "count": 9, "parameters": {"gain.k": {"uniform": [1.0, 3.0]}}}
SCATTERED = {"count": 9, "parameters": {"gain.k": {"uniform": [1, 3]}, "plant.gain": {"uniform": [1, 3]}}}


@pytest.mark.parametrize(
    ("name", "keys", "rows"),
    [
        ("grid", {"cases": {"a": {}, "bb": {}}, "grid": {"gain.k": [1, 2, 3]}, "signals": ["lag/state/x/position"],
                  "samples": 6}, [*many(("a", "bb"), (K,))]),
        ("map", {"grid": {"gain.k": [1, 2, 3], "plant.gain": [1, 2]}}, [*many(("",), (K, G))]),
        ("scattered", {"draws": SCATTERED}, [row | {"overrides": {"gain.k": 1.0 + 0.1 * k, "plant.gain": 2.0 - 0.2 * k}}
                                             for k, row in enumerate(many(seeds=3))]),
        ("seeds", {"seeds": 9, "figures": ["power"]}, [*many(over=(), seeds=9)]),
        ("search", {"search": SEARCH | {"subject_to": {"power": "at least 33"}}}, [*many(over=(FINE,), seeds=1)]),
        ("largest", {"search": SEARCH | {"aim": "maximise"}}, [*many(over=(FINE,), seeds=1)]),
    ],
)  # fmt: skip
def test_pictures_of_studies_are_as_expected(name, keys, rows):
    demo = study(**keys)
    drawn = [(title, on_paper(f)) for title, f in pictures._figures(demo, rows, keeping(rows), UNITS)]
    check_expected(f"studies/{name}", (line for title, f in drawn for line in (title, *figure_lines(f))))


def test_the_history_of_a_search_shows_the_best_so_far():
    search = {"figure": "settling", "count": 3, "parameters": {"gain.k": {"uniform": [1.0, 3.0]}}}
    rows = [a_row(0, 1.0, 0.5), a_row(1, 2.0, 0.7), a_row(2, 3.0, 0.3)]
    for aim, result in (("minimise", [0.5, 0.5, 0.3]), ("maximise", [0.5, 0.7, 0.7])):
        (ax,) = on_paper(pictures._history(study(search=search | {"aim": aim}).search, rows, {})).axes
        assert [line.get_xydata().tolist() for line in ax.lines] == [
            [[0.0, 0.5], [1.0, 0.7], [2.0, 0.3]],
            [[float(number), value] for number, value in enumerate(result)],
        ]


def test_an_unknown_name_or_option_is_one_line(capsys):
    for arguments, reason in {
        "leg": "neither a study nor a scenario",
        "lag --grid k": "--grid 'k': expected NAME=A,B,C or LOW:HIGH:STEP",
        "lag --grid gain.k=": "--grid 'gain.k=': expected NAME=",
        "lag --draw gain.k=1": "gain.k=1: expected LOW..HIGH",
        "lag --draw gain.k=3..1": "gain.k=3..1: 3 is above 1",
        "lag --draw gain.k=0..1~3": "gain.k=0..1~3: a parameter has no time profile",
        "lag --grid gain.k=[1": "gain.k=[1: not valid YAML",
        "lag --grid gain.k=1 plant.gain=2": "unexpected argument 'plant.gain=2'; each NAME=... has its own option",
    }.items():
        assert main(["study", *arguments.split(), "--workers", "1"]) == 2
        error = capsys.readouterr().err
        assert reason in error
        assert len(error.splitlines()) == 1


def test_drawn_formats_are_those_of_the_page_and_no_option_swallows_the_name():
    ranges = {"gain.k": "log 0.1..10", "plant.gain": "1..2*2", "plant.limit": "1,2:4"}
    words = [part for name, text in ranges.items() for part in ("--draw", f"{name}={text}")]
    options = make_parser().parse_args(["study", *words, "--grid", "source.value=1,2", "lag"])
    result = study_of(options)
    assert result.scenario == "lag"
    assert result.grid == {"source.value": [1, 2]}
    assert {k: d.model_dump(exclude_none=True) for k, d in result.draws.parameters.items()} == {
        "gain.k": {"log_uniform": (0.1, 10.0)},
        "plant.gain": {"uniform": ([1.0, 1.0], [2.0, 2.0])},
        "plant.limit": {"choice": [1, 2, 3, 4]},
    }


def test_every_shipped_study_can_run(monkeypatch):
    monkeypatch.undo()
    names = list_studies()
    assert {"dc_motor_gains", "pv_mppt_hits"} <= set(names)
    for name in names:
        check_study(shipped := load_study(name), drafts_of(shipped))


@pytest.mark.long
@pytest.mark.parametrize("name", ["dc_motor_pid_tuning", "pv_mppt_draws", "pv_mppt_hits", "pv_mppt_settling"])
def test_a_shipped_study_at_full_length_meets_its_expectations(name, monkeypatch, tmp_path):
    monkeypatch.undo()
    assert main(["study", name, "--out", str(tmp_path / name)]) == 0
