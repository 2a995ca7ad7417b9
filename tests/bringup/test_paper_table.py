"""Figures and signals exported from softrig: LaTeX, CSV, MATLAB."""

import csv
import math
import re

import numpy as np
import pytest
from scipy.io import loadmat
from softrig_bags.export import _identifier
from softrig_bags.read import signals
from softrig_bringup.cli import main
from softrig_bringup.page.paper_table import Column, latex, table_csv, write_paper_table
from softrig_core import ScenarioError

RISE = Column("rise_time", "s", [0.79812, 0.4189, math.nan], [0.01034, 0.0041, math.nan])
PEAK = Column("peak", "%", [7.961234, math.inf, 1234.5])


def test_a_column_has_the_decimals_that_its_largest_uncertainty_allows():
    assert RISE.cells() == [("0.798", "0.010"), ("0.419", "0.004"), ("", "")]
    assert PEAK.cells() == [("8", ""), ("never", ""), ("1234", "")]
    assert Column("a", "", [123456.0], [4321.0]).cells() == [("123500", "4300")]
    assert Column("a", "", [0.5], [0.0999]).decimals == 2  # two digits: 0.10, not 0.100
    assert Column("a", "", [0.0, 0.0]).cells() == [("0", ""), ("0", "")]


def test_a_table_for_latex_uses_booktabs():
    assert (
        latex("case", ["smc_b2", "PI & more", "x"], [RISE, PEAK])
        == r"""\begin{tabular}{lrr}
\toprule
case & rise time (s) & peak (\%) \\
\midrule
smc\_b2 & $0.798 \pm 0.010$ & $8$ \\
PI \& more & $0.419 \pm 0.004$ & never \\
x & -- & $1234$ \\
\bottomrule
\end{tabular}
"""
    )
    assert list(csv.reader(table_csv("case", ["a", "b", "c"], [RISE, PEAK]).splitlines())) == [
        ["case", "rise time (s)", "± rise time (s)", "peak (%)"],
        ["a", "0.798", "0.010", "8"], ["b", "0.419", "0.004", "never"], ["c", "", "", "1234"],
    ]  # fmt: skip


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(ScenarioError, match=r"expected a table as .tex or .csv"):
        write_paper_table(tmp_path / "a.xls", "case", [], [])


def test_runs_and_studies_write_their_figures_for_a_paper(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for delta in (1, 2):
        words = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.2", "--no-plots"]
        assert main([*words, "--set", f"dc_motor_smc.delta={delta}", "--out", f"r/d{delta}"]) == 0
    assert main(["report", "r", "--table", "t.tex"]) == 0
    text = (tmp_path / "t.tex").read_text()
    assert re.findall(r"^(d\d) & ", text, re.M) == ["d1", "d2"]
    assert "peak current (A)" in text
    study = ["study", "dc_motor_smc_b2", "--draw", "dc_motor_plant.R=0.3..0.5", "--draws", "5", "--duration", "0.1"]
    assert main([*study, "--figures", "peak_current", "--workers", "1", "--out", "s"]) == 0
    assert re.search(r"all runs & \$[\d.]+ \\pm [\d.]+\$", (tmp_path / "s" / "statistics.tex").read_text())
    with (tmp_path / "s" / "statistics.csv").open() as file:
        assert next(csv.reader(file)) == ["case", "peak current (A)", "± peak current (A)"]


def test_a_bag_becomes_files_for_matlab(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.1", "--no-plots", "--out", "r"]) == 0
    capsys.readouterr()
    assert main(["bag", "export", "r", "--format", "mat"]) == 0
    files = {line.split("/")[-1]: line for line in capsys.readouterr().out.split()}
    result = loadmat(files["motor.state.mat"])
    t, speed = signals(tmp_path / "r" / "bag")["motor/state/shaft/velocity"]
    assert result["shaft_velocity"].shape == (len(t), 1)
    assert np.array_equal(result["shaft_velocity"][:, 0], speed)
    assert np.allclose(result["stamp"][:, 0], t)
    assert [name[0] for name in result["names"][:, 0]][:2] == ["time", "stamp"]
    assert not list((tmp_path / "r" / "bag_mat").glob("*.parquet"))
    assert [_identifier(h) for h in ("shaft/velocity", "1a", "_x__y", "é", "a" * 80)] == [
        "shaft_velocity", "x1a", "x_y", "x", "a" * 63,
    ]  # fmt: skip
