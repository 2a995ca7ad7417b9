"""The tests' own workers: a lost worker loses one test, and pytest reports the same as without them."""

import os
import re
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent
LOST = """
import os, signal

def test_before(tmp_path):
    print("heard")

def test_is_killed():
    os.kill(os.getpid(), signal.SIGKILL)

def test_after(tmp_path):
    assert not list(tmp_path.iterdir())
"""
FOUND = """
import warnings
import pytest

PIECES = []

@pytest.fixture(scope="module")
def kept():
    yield PIECES
    print("torn down", PIECES)

@pytest.mark.parametrize("k", range(3))
def test_order(kept, k):
    kept.append(k)
    assert kept == list(range(k + 1))

def test_warns():
    warnings.warn("a word")

@pytest.mark.skip(reason="no reason")
def test_not_today():
    pass

def test_fails(kept):
    print("said before")
    assert kept == []
"""


def run(folder, *options):
    """Return what pytest writes about the tests of a folder, without times, and its status."""
    environment = os.environ | {"PYTHONPATH": f"{TESTS}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    environment.pop("PYTEST_ADDOPTS", None)  # pytest options of the outer run would change what this run writes
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "-p", "no:xdist", "-p", "forked", "-p", "no:cacheprovider",
               *options]  # fmt: skip
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    return re.sub(r"in [\d.]+s", "", ran.stdout + ran.stderr), ran.returncode


def test_workers_report_what_one_process_reports(tmp_path):
    (tmp_path / "test_found.py").write_text(FOUND)
    forked = run(tmp_path, "-n", "2")
    assert forked == run(tmp_path)
    assert forked[1] == 1
    for word in ("said before", "torn down [0, 1, 2]", "UserWarning: a word", "1 failed, 4 passed, 1 skipped"):
        assert word in forked[0]


def test_a_lost_worker_loses_one_test(tmp_path):
    (tmp_path / "test_lost.py").write_text(LOST)
    (tmp_path / "test_found.py").write_text(FOUND)
    reported, status = run(tmp_path, "-n", "1")
    assert status == 1
    assert "FAILED test_lost.py::test_is_killed" in reported
    assert "the process of the tests ended here with status -9" in reported
    assert "2 failed, 6 passed, 1 skipped, 1 warning" in reported
