"""`softrig check --claims`: claims are compared with runs, and the pages about them."""

import json
import re
from xml.etree import ElementTree

import pytest
from expected_text import check_expected, page_lines
from softrig_bringup.cli import main
from softrig_bringup.results.page import counts, html, markdown
from softrig_bringup.results.results import claiming, gather

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
    assert f"softrig run {folder / 'lag.yaml'} --mode inprocess" in page


def test_an_unwritable_folder_is_reported_before_the_runs(folder, monkeypatch, capsys):
    monkeypatch.setattr(
        "softrig_bringup.results.results.gather", lambda *_: pytest.fail("runs before it looks at the folder")
    )
    assert main(["check", "--claims", "lag", "--out", "lag.yaml"]) == 2
    assert "lag.yaml" in capsys.readouterr().err


def test_pages_report_the_agreement_and_published_is_the_papers_number_alone(folder):
    rows, _ = gather(claiming(), workers=1)
    last, order, _ = rows
    assert last.asked == "0.4551 ± 0.00455 (1 %)"
    assert re.fullmatch(r"above lag_slow.last = 0\.3\d+ here", order.asked)
    cells = [[c.strip() for c in line.split("|")] for line in markdown(claiming(), rows).splitlines()]
    assert next(c for c in cells if c[1:2] == [order.text])[3:5] == ["", order.asked]
    assert next(c for c in cells if c[1:2] == ["last"])[3:5] == ["0.4551 m", last.asked]


def test_a_repeated_claim_counts_once(folder):
    again = "  again: {text: slower with less gain, figure: last, above: 0.1, where: Figure 2, verdict: reproduced}\n"
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "reproduced").replace("  other:", f"{again}  other:"))
    rows, _ = gather(claiming(), workers=1)
    assert counts(rows) == "3 claims in 4 rows: 2 reproduced, 1 not checkable; every verdict holds"
    assert "| lag | 2 |  |  |  | 1 |" in markdown(claiming(), rows)


def test_runs_are_cached_until_their_code_or_scenario_changes(folder, capsys, monkeypatch):
    assert main(["check", "--claims", "--workers", "1"]) == 0
    page = (folder / "runs" / "results" / "results.html").read_text()
    for link in re.findall(r'href="(runs/[^"]*)"', page):
        assert (folder / "runs" / "results" / link).is_file()
    assert 'href="runs/lag/report.html"' in page
    assert 'href="runs/lag/overview.svg"' in page
    assert "are kept" not in capsys.readouterr().out
    assert main(["check", "--claims", "--workers", "1"]) == 0
    assert "2 of 2 runs are kept" in capsys.readouterr().out
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "reproduced").replace("{gain: 0.5}", "{gain: 0.6}"))
    assert main(["check", "--claims", "--workers", "1"]) == 0
    assert "1 of 2 runs are kept" in capsys.readouterr().out
    monkeypatch.setattr("softrig_bringup.study.engine.fingerprints", lambda *_: {"faultrig": "changed"})
    assert main(["check", "--claims", "--workers", "1"]) == 0
    assert "are kept" not in capsys.readouterr().out


def test_claims_of_studies_that_are_not_checked_are_named(folder, capsys, monkeypatch):
    study = (
        "title: Many\nscenario: lag\nseeds: 1\nsummaries: {mean: {figure: last}}\n"
        "claims: {mean: {published: 0.4551, where: Table II, verdict: reproduced}}\n"
    )
    (folder / "many").mkdir()
    (folder / "many" / "some.yaml").write_text(study)
    monkeypatch.setenv("SOFTRIG_STUDIES", str(folder / "many"))
    assert main(["check", "--claims", "--workers", "1"]) == 0
    text = "1 more claims are of studies (some): hundreds of runs, with --studies"
    assert text in capsys.readouterr().out
    assert text in (folder / "runs" / "results" / "results.html").read_text()
    assert main(["check", "--claims", "--workers", "1", "--studies"]) == 0
    assert "4 claims: 3 reproduced" in capsys.readouterr().out
    lag = (folder / "lag.yaml").read_text()
    # Cached rows of another scenario are not used.
    (folder / "lag.yaml").write_text(lag.replace("duration: 1.0", "duration: 0.5"))
    assert main(["check", "--claims", "--workers", "1", "--studies"]) == 1
    assert "some: claim mean: the verdict reproduced does not hold: measured 0.15957" in capsys.readouterr().err


def test_a_false_verdict_fails_the_page_and_the_run(folder, capsys):
    assert main(["check", "--claims", "lag", "--workers", "1"]) == 0
    assert (folder / "runs" / "results" / "results_lag.html").is_file()
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "refuted"))
    capsys.readouterr()
    assert main(["check", "--claims", "--workers", "1"]) == 1
    assert "softrig: lag: claim last: the verdict refuted does not hold: measured 0.45" in capsys.readouterr().err
    assert "NOT BORNE OUT" in (folder / "runs" / "results" / "results.md").read_text()
    assert main(["run", "lag", "--mode", "inprocess", "--no-record", "--no-plots"]) == 1
    assert "claim last: the verdict refuted does not hold" in capsys.readouterr().out
    claims = json.loads((folder / "runs" / "lag" / "metrics.json").read_text())["claims"]
    assert [c["holds"] for c in claims] == [False, None, True]


def test_a_claim_that_needs_a_broken_run_does_not_hold(folder, capsys):
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "reproduced").replace("{gain: 0.5}", "{gain: -0.5}"))
    assert main(["check", "--claims", "--workers", "1"]) == 3
    error = capsys.readouterr().err
    assert "lag_slow: lag_slow: node plant: parameter gain = -0.5" in error
    assert "claim order: the verdict reproduced cannot be checked" in error


def test_pages_of_results_are_as_expected(folder, monkeypatch):
    """A verdict that does not hold, one that cannot be checked, one of a figure of another run; omitted claims."""
    monkeypatch.setenv("SOFTRIG_COMMAND", "softrig")
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "refuted"))
    rows, _ = gather(claiming(), workers=1)
    out = folder / "out"
    for name in ("lag", "lag_slow"):
        (out / "runs" / name).mkdir(parents=True)
        (out / "runs" / name / "report.html").touch()
    (out / "runs" / "lag" / "plot_01_position.svg").touch()
    marked, whole = (
        make(claiming(), rows, "3 more are of studies", *to) for make, to in ((markdown, ()), (html, (out,)))
    )
    messages = [*marked.splitlines(), *page_lines(whole), *page_lines(html(claiming(), rows[:1]))]
    check_expected("pages/results", [line.replace(str(folder), "HERE") for line in messages])


def test_results_are_written_for_machines(folder):
    (folder / "lag.yaml").write_text(LAG.replace("VERDICT", "refuted"))
    assert main(["check", "--claims", "--workers", "1", "--junit", "unit.xml", "--json", "rows.json"]) == 1
    root = ElementTree.parse(folder / "unit.xml").getroot()
    assert (root.get("tests"), root.get("failures")) == ("3", "1")
    assert "does not hold" in root.find(".//failure").get("message")
    assert [row["holds"] for row in json.loads((folder / "rows.json").read_text())] == [False, True, True]


def test_an_unknown_system_is_refused(folder, capsys):
    assert main(["results", "leg"]) == 2
    assert "`results` is `check --claims` now; the old form works until softrig 0.4" in capsys.readouterr().err
    for words, text in (
        (["check"], "check: expected scenarios (names or files), --claims or --golden"),
        (["check", "--claims", "mine.yaml"], "expected a system; `check mine.yaml` judges a file's claims"),
        (["check", "lag", "--studies"], "--studies belongs to `check` of --claims"),
        (["check", "--claims", "--with", "lag"], "--with belongs to `check` of --golden"),
        (["check", "--golden", "--marks", "m.csv"], "--marks belongs to `check` of scenarios"),
        (["check", "--golden", "--claims"], "not allowed with"),
        (["golden", "--check", "--bags", "none"], "none has no golden bags yet; name the scenarios"),
        (["locate", "x.cfg"], "`softrig locate` is `softrig node softrig_power locate` now"),
    ):
        assert main(words) == 2
        assert text in capsys.readouterr().err
    assert main(["check", "--claims", "leg"]) == 2
    assert "no system 'leg'; there are lag" in capsys.readouterr().err


@pytest.mark.long
def test_every_verdict_of_every_paper_holds():
    rows, measured = gather(claiming())
    assert [r.false for r in rows if not r.holds] == []
    assert [m.error or m.missed for m in measured.values() if m.error or m.missed] == []
