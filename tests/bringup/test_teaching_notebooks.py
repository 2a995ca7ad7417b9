"""Notebooks for teaching: stored without results, their links are valid, and they show what the verbs print."""

import contextlib
import io
import json
import re

import matplotlib
import pytest
from docs.collect import without_solutions
from docs.outline import KINDS, pages
from softrig_bringup.cli import main
from softrig_core import Run, list_scenarios

NOTEBOOKS = KINDS["notebooks"][2]


def cells(name, kind):
    result = json.loads(pages()[name].read_text())["cells"]
    return ["".join(cell["source"]) for cell in result if cell["cell_type"] == kind]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_stored_without_results_and_names_things_that_exist(name):
    assert pages()[name].suffix == ".ipynb"
    for cell in json.loads(pages()[name].read_text())["cells"]:
        assert cell["cell_type"] == "markdown" or (cell["outputs"], cell["execution_count"]) == ([], None)
    code = "\n".join(cells(name, "code"))
    compile(code, name, "exec")
    systems = {scenario.split("_")[0] for scenario in list_scenarios()}
    named = [word for word in re.findall(r'"(\w+)"', code) if "_" in word and word.split("_")[0] in systems]
    assert named
    assert set(named) <= set(list_scenarios())
    text = "\n".join(cells(name, "markdown"))
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert (pages()[name].parent / target).exists(), target
    assert "## Exercises" in text


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_students_get_the_exercises_and_no_solution(name):
    text = pages()[name].read_text()
    whole, exercises = (json.loads(one)["cells"] for one in (text, without_solutions(text)))
    at = next(k for k, cell in enumerate(whole) if "".join(cell["source"]).startswith("## Solutions"))
    assert exercises[:at] == whole[:at]
    assert [cell["source"] for cell in exercises[at:]] == [
        "## Your answers",
        *(f"# {k}. " for k in range(1, len(whole) - at)),
    ]
    asked = re.findall(r"^\d+\.", "".join(whole[at - 1]["source"]), re.M)
    assert len(asked) == len(whole) - at - 1  # each exercise is followed by a cell for its answer


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_shows_the_numbers_of_the_verbs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    by_scenario = {}
    with contextlib.redirect_stdout(io.StringIO()):
        for cell in cells(name, "code"):
            exec(compile(cell, name, "exec"), by_scenario)
    runs = [run for run in by_scenario.values() if isinstance(run, Run) and run.rig.scenario.name in list_scenarios()]
    assert runs
    for run in runs:
        scenario = run.rig.scenario.name
        main(["run", scenario, "--mode", "inprocess", "--no-plots", "--no-record", "--out", scenario])
        of_notebook = json.loads((tmp_path / scenario / "metrics.json").read_text())["metrics"]
        measured = {figure["name"]: figure["value"] for figure in of_notebook}
        shown = {r.name: r.value for r in run.results if r.value is not None}
        assert shown
        assert {figure: measured[figure] for figure in shown} == shown
