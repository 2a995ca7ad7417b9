"""`softrig results`: claims held against runs, and the pages about it."""

import json

import pytest
from softrig_bringup.cli import main
from softrig_bringup.results import claiming, gather
from softrig_bringup.results_page import counts, html, markdown

LAG = """
title: First-order lag
system: lag
source: Nobody, 2020, Table I
duration: 1.0
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain}
figures:
  last: {function: final_value, arguments: {signal: lag/state/x/position}}
claims:
  last: {published: 0.4551, tolerance: 1 %, where: Table I, verdict: VERDICT, reason: because | so}
  order: {text: slower with less gain, figure: last, above: lag_slow.last, where: Figure 2, verdict: reproduced}
  other: {text: the weather, where: Figure 3, verdict: not_checkable, reason: no data}
variants:
  slow: {title: A slow one, nodes: {plant: {parameters: {gain: 0.5}}}}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lag.yaml").write_text(LAG.replace("VERDICT", "reproduced"))
    return tmp_path


def test_pages_show_each_claim_with_its_measurement(folder):
    rows, measured = gather(claiming(), workers=1)
    assert sorted(measured) == ["lag", "lag_slow"]
    assert [(r.key, r.holds) for r in rows] == [("last", True), ("order", True), ("other", True)]
    assert counts(rows) == "3 claims: 2 reproduced, 1 not checkable; every verdict holds"
    page, text = html(claiming(), rows), markdown(claiming(), rows)
    for part in ("Nobody, 2020, Table I", "slower with less gain", "0.4551", f"{rows[0].measured:.6g} m", "no data"):
        assert part in text
        assert part.removesuffix(" m") in page
    assert "because \\| so" in text
    assert "scripts/softrig run lag --mode inprocess" in page


def test_a_folder_that_takes_nothing_is_said_before_the_runs(folder, monkeypatch, capsys):
    monkeypatch.setattr("softrig_bringup.results.gather", lambda *_: pytest.fail("runs before it looks at the folder"))
    assert main(["results", "lag", "--out", "lag.yaml"]) == 2
    assert "lag.yaml" in capsys.readouterr().err


def test_a_false_verdict_fails_the_page_and_the_run(folder, capsys):
    assert main(["results", "lag", "--workers", "1"]) == 0
    assert (folder / "runs" / "results" / "results.html").is_file()
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "refuted"))
    capsys.readouterr()
    assert main(["results", "--workers", "1"]) == 1
    assert "softrig: lag: claim last: the verdict refuted does not hold: measured 0.45" in capsys.readouterr().err
    assert "NOT BORNE OUT" in (folder / "runs" / "results" / "results.md").read_text()
    assert main(["run", "lag", "--mode", "inprocess", "--no-record", "--no-plots"]) == 1
    assert "claim last: the verdict refuted does not hold" in capsys.readouterr().out
    claims = json.loads((folder / "runs" / "lag" / "metrics.json").read_text())["claims"]
    assert [c["holds"] for c in claims] == [False, None, True]


def test_a_claim_that_needs_a_run_that_broke_is_not_borne_out(folder, capsys):
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "reproduced").replace("{gain: 0.5}", "{gain: -0.5}"))
    assert main(["results", "--workers", "1"]) == 3
    error = capsys.readouterr().err
    assert "lag_slow: lag_slow: node plant: parameter gain = -0.5" in error
    assert "claim order: the verdict reproduced cannot be checked" in error


def test_an_unknown_system_is_refused(folder, capsys):
    assert main(["results", "leg"]) == 2
    assert "no system 'leg'; there are lag" in capsys.readouterr().err


@pytest.mark.long
def test_every_verdict_of_every_paper_holds():
    rows, measured = gather(claiming())
    assert [r.false for r in rows if not r.holds] == []
    assert [m.error or m.missed for m in measured.values() if m.error or m.missed] == []
