"""`softrig check` and `run --junit`: what a company's continuous integration reads."""

import json
from xml.etree import ElementTree

import pytest
from softrig_bringup.cli import main
from softrig_bringup.page.junit import Case, Suite, write_junit

HOLDS = """
extends: dc_motor_smc_b2
title: holds
duration: 1.0
requirements: {supply: always abs(voltage) <= 24}
"""


@pytest.fixture
def files(tmp_path):
    holds, fails, breaks = (tmp_path / f"{name}.yaml" for name in ("holds", "fails", "breaks"))
    holds.write_text(HOLDS)
    fails.write_text(HOLDS.replace("<= 24", "<= 1").replace("holds", "fails"))
    breaks.write_text(
        HOLDS.replace("holds", "breaks") + "nodes: {dc_motor_smc: {parameters: {k: 1.0e+11, delta: 0.0}}}\n"
    )
    return holds, fails, breaks


def cases(file):
    root = ElementTree.parse(file).getroot()
    return root, {(c.get("classname"), c.get("name")): c for c in root.iter("testcase")}


def test_what_holds_and_what_does_not_is_told_in_words_xml_and_json(files, tmp_path, capsys):
    holds, fails, _ = files
    junit, report = tmp_path / "report.xml", tmp_path / "report.json"
    given = ["check", str(holds), str(fails), "--junit", str(junit), "--json", str(report), "--workers", "1"]
    assert main(given) == 1
    said = capsys.readouterr().out
    assert "holds: 1 hold, 0 do not" in said
    assert "fails: 0 hold, 1 do not" in said
    root, found = cases(junit)
    assert (root.get("tests"), root.get("failures"), root.get("errors")) == ("2", "1", "0")
    assert found["holds", "supply"].find("failure") is None
    message = found["fails", "supply"].find("failure").get("message")
    assert "expected ≥ 0 V; violated from" in message
    content = json.loads(report.read_text())
    assert [c["scenario"] for c in content] == ["holds", "fails"]
    assert next(m for m in content[1]["metrics"] if m["name"] == "supply")["pass"] is False
    assert main(["check", str(holds), "--workers", "1"]) == 0


def test_servers_that_add_up_the_times_of_cases_get_that_of_the_run(tmp_path):
    write_junit(tmp_path / "a.xml", [Suite("a", 3.0, [Case("b"), Case("c")]), Suite("d", 1.0, error="no")])
    root, found = cases(tmp_path / "a.xml")
    assert sum(float(case.get("time")) for case in found.values()) == float(root.get("time")) == 4.0


def test_a_run_that_breaks_is_an_error_of_its_suite(files, tmp_path, capsys):
    junit = tmp_path / "report.xml"
    status = main(["check", str(files[2]), "--junit", str(junit), "--workers", "1"])
    root, found = cases(junit)
    assert (status, root.get("errors")) == (3, "1")
    assert found["breaks", "run"].find("error").get("message") in capsys.readouterr().out


def test_one_run_has_a_report_too(files, tmp_path):
    junit = tmp_path / "report.xml"
    assert main(["run", str(files[1]), "--mode", "inprocess", "--no-plots", "--no-record", "--junit", str(junit),
                 "--out", str(tmp_path / "out")]) == 1  # fmt: skip
    assert cases(junit)[1]["fails", "supply"].find("failure") is not None


def test_bad_input_is_one_line_before_the_first_run(files, tmp_path, capsys):
    assert main(["check", str(files[0]), "dc_motor_smc_b22"]) == 2
    assert "did you mean" in capsys.readouterr().err
    assert main(["check", str(files[0]), "--junit", str(tmp_path / "none" / "report.xml")]) == 2
    assert "there is no folder" in capsys.readouterr().err


def test_control_characters_in_a_name_leave_the_xml_readable(tmp_path):
    write_junit(tmp_path / "x.xml", [Suite("a\x1b[31m", 0.1, [Case("b\x00", "c\x07 <&>")])])
    root, found = cases(tmp_path / "x.xml")
    assert found["a?[31m", "b?"].find("failure").get("message") == "c? <&>"
    assert root.get("failures") == "1"
