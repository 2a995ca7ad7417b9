"""The page about the Python prompt: its examples run and give the printed numbers."""

import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "ros_pkgs" / "softrig_core" / "doc" / "python.md"


@pytest.fixture(scope="module")
def blocks():
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_the_loop_of_the_page_runs_and_settles_where_it_states(blocks, capsys):
    known = {"__name__": "page"}
    exec(blocks[0], known)
    assert capsys.readouterr().out == "1.0000 m\n"
    # At rest the pump of 2 V and the outflow of 0.1 sqrt(1) balance.
    assert known["height"][-1] == pytest.approx(1.0, abs=1e-4)
    code = blocks[0][blocks[0].index("class Tank") : blocks[0].index("print")]
    assert sum(1 for line in code.splitlines() if line.strip()) <= 20


def test_a_run_returns_to_an_earlier_tick(blocks, capsys):
    known = {"__name__": "page"}
    for block in blocks[:3]:
        exec(block, known)
    *_, last = blocks[2].splitlines()
    assert capsys.readouterr().out.splitlines()[-1] == last.partition("  # ")[2]


@pytest.mark.long
def test_its_linear_model_is_the_analytic_one(blocks, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    known = {"__name__": "page"}
    exec(blocks[4], known)
    pole = -0.05 / np.sqrt(0.9)  # derivative of -0.1 sqrt(h)
    assert known["u"][0] == pytest.approx(2.0 * np.sqrt(0.9), rel=1e-8)
    assert known["plant"].poles() == pytest.approx([pole], rel=1e-8)
    assert known["loop"].poles() == pytest.approx([pole - 0.3], rel=1e-8)
    assert {p.name for p in tmp_path.iterdir()} == {"bode.png", "step.png", "locus.png"}


def test_a_run_is_shown_in_a_notebook(blocks, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    known = {"__name__": "page"}
    exec(blocks[0], known)
    exec(blocks[3], known)
    assert "<Run of dc_motor_smc_b2 (inprocess, seed 0)" in capsys.readouterr().out
    assert (tmp_path / "speed.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.long
def test_runs_come_back_from_processes(blocks):
    known = {}
    exec("from softrig_core import simulate\n" + blocks[5], known)
    for run in known["runs"]:
        assert run.recording.topics == known["simulate"](run.rig).recording.topics
