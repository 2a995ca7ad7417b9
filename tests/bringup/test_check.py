"""`softrig check` and `run --junit`, as a company's continuous integration reads them."""

import csv
import json
import re
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


def test_results_of_a_check_are_reported_in_words_xml_and_json(files, tmp_path, capsys):
    holds, fails, _ = files
    junit, report = tmp_path / "report.xml", tmp_path / "report.json"
    command = ["check", str(holds), str(fails), "--junit", str(junit), "--json", str(report), "--workers", "1"]
    assert main(command) == 1
    printed = capsys.readouterr().out
    assert f"{holds}: 1 hold, 0 do not" in printed
    assert f"{fails}: 0 hold, 1 do not" in printed
    root, result = cases(junit)
    assert (root.get("tests"), root.get("failures"), root.get("errors")) == ("2", "1", "0")
    assert result[str(holds), "supply"].find("failure") is None
    message = result[str(fails), "supply"].find("failure").get("message")
    assert "expected ≥ 0 V; violated from" in message
    content = json.loads(report.read_text())
    assert [c["scenario"] for c in content] == [str(holds), str(fails)]
    assert next(m for m in content[1]["metrics"] if m["name"] == "supply")["pass"] is False
    assert main(["check", str(holds), "--workers", "1"]) == 0


def test_servers_that_add_up_the_times_of_cases_get_the_time_of_the_run(tmp_path):
    write_junit(tmp_path / "a.xml", [Suite("a", 3.0, [Case("b"), Case("c")]), Suite("d", 1.0, error="no")])
    root, result = cases(tmp_path / "a.xml")
    assert sum(float(case.get("time")) for case in result.values()) == float(root.get("time")) == 4.0


def test_a_run_that_breaks_is_an_error_of_its_suite(files, tmp_path, capsys):
    junit = tmp_path / "report.xml"
    status = main(["check", str(files[2]), "--junit", str(junit), "--workers", "1"])
    root, result = cases(junit)
    assert (status, root.get("errors")) == (3, "1")
    assert result[str(files[2]), "run"].find("error").get("message") in capsys.readouterr().out


def test_one_run_has_a_report_too(files, tmp_path):
    junit = tmp_path / "report.xml"
    assert main(["run", str(files[1]), "--mode", "inprocess", "--no-plots", "--no-record", "--junit", str(junit),
                 "--out", str(tmp_path / "out")]) == 1  # fmt: skip
    assert cases(junit)[1]["fails", "supply"].find("failure") is not None


def test_bad_input_is_reported_and_the_rest_is_judged(files, tmp_path, capsys):
    assert main(["check", str(files[0]), "dc_motor_smc_b22", "--workers", "1"]) == 2
    text, error = capsys.readouterr()
    assert f"{files[0]}: 1 hold, 0 do not" in text
    assert "dc_motor_smc_b22: refused: scenario 'dc_motor_smc_b22' is unknown (did you mean" in text
    assert error.splitlines()[-1] == "softrig: of 2 scenarios not judged: dc_motor_smc_b22"
    assert main(["check", str(files[0]), str(files[2]), "dc_motor_smc_b22", "--workers", "1"]) == 3
    capsys.readouterr()
    assert main(["check", str(files[0]), "--junit", str(tmp_path / "none" / "report.xml")]) == 2
    assert "there is no folder" in capsys.readouterr().err


def test_control_characters_in_a_name_leave_the_xml_readable(tmp_path):
    write_junit(tmp_path / "x.xml", [Suite("a\x1b[31m", 0.1, [Case("b\x00", "c\x07 <&>\udc80\uffff😀é")])])
    root, result = cases(tmp_path / "x.xml")
    assert result["a?[31m", "b?"].find("failure").get("message") == "c? <&>??😀é"
    assert root.get("failures") == "1"


def test_a_class_is_judged_by_the_lecturers_file_and_by_path(files, tmp_path, monkeypatch, capsys):
    """Each student hands in task1.yaml; their own expectations do not count, and what else they changed is named."""
    monkeypatch.chdir(tmp_path)
    task = tmp_path / "task1.yaml"
    peak = "{function: final_value, arguments: {signal: motor/true_state/shaft/velocity}}"
    task.write_text(HOLDS + f"figures: {{peak: {peak}}}\n"
                    "expect: {peak: at least -1000}\n")  # fmt: skip
    own = {"ann": "nodes: {dc_motor_smc: {parameters: {delta: 2.5}}}\n", "bob": "duration: 0.5\n", "eve": "nodes: 3\n"}
    for name, text in own.items():
        (tmp_path / "sub" / name).mkdir(parents=True)
        lenient = HOLDS.replace("abs(voltage) <= 24", "abs(voltage) <= 1")
        lenient = lenient.replace("duration: 1.0\n", "") if name == "bob" else lenient
        (tmp_path / "sub" / name / "task1.yaml").write_text(lenient + text)
    files_of = [f"sub/{name}/task1.yaml" for name in own]
    words = ["check", "--against", "task1.yaml", *files_of, "--marks", "marks.csv", "--junit", "x.xml", "--html",
             "x.html", "--workers", "1"]  # fmt: skip
    assert main(words) == 2  # one file is not readable
    printed = capsys.readouterr().out
    for name, differs in (("ann", "nodes.dc_motor_smc.parameters.delta"), ("bob", "duration")):
        assert f"sub/{name}/task1.yaml: 2 hold, 0 do not\n  differs from task1.yaml: {differs}\n" in printed
    assert "sub/eve/task1.yaml: refused: " in printed
    with (tmp_path / "marks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["scenario"], r["held"], r["judged"]) for r in rows] == [
        (files_of[0], "2", "2"), (files_of[1], "2", "2"), (files_of[2], "0", "0"),
    ]  # fmt: skip
    assert (rows[0]["supply holds"], rows[2]["supply holds"]) == ("1", "")
    assert float(rows[0]["supply (V)"]) > 0.0
    assert [r["differs"] for r in rows] == ["nodes.dc_motor_smc.parameters.delta", "duration", ""]
    page = (tmp_path / "x.html").read_text()
    assert re.findall(r"<h1>(.*?)</h1>", page) == ["2 of 3 scenarios hold"]
    assert page.count("2 of 2 hold") == 2
    assert '<td data-label="Differs in">duration</td>' in page
    assert rows[2]["error"] in page
    assert rows[2]["error"]
    assert {name for name, _ in cases(tmp_path / "x.xml")[1]} == {*files_of}
