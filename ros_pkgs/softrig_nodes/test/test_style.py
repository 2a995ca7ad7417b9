"""The linters of ament with the package's own configuration; `scripts/test` of the repository has ruff and mypy."""

import pytest

IGNORED = "D100 D104 D105 D107 D203 D205 D213 D400 D401 D406 D407 D413"  # as ruff does, see pyproject.toml


def test_flake8():
    flake8 = pytest.importorskip("ament_flake8.main")
    assert flake8.main(["--config", "setup.cfg", "softrig_nodes", "test"]) == 0


def test_pep257():
    pep257 = pytest.importorskip("ament_pep257.main")
    assert pep257.main(["--convention", "numpy", "--add-ignore", *IGNORED.split(), "--", "softrig_nodes"]) == 0
