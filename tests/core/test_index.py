"""The index of scenarios: its content equals what loading gives, and every change of a file is noticed."""

import os

import pytest
from softrig_core import ScenarioError, load_scenario
from softrig_core.scenario import index
from softrig_core.scenario.index import listed

FILE = """title: {title}
system: lag
source: none
duration: {duration}
nodes: {{source: {{package: faultrig, executable: source}}}}
variants: {{slow: {{duration: 9.0}}}}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    scenarios = tmp_path / "scenarios"
    scenarios.mkdir()
    (scenarios / "one.yaml").write_text(FILE.format(title="One", duration=1.5))
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(scenarios))
    monkeypatch.setattr(index, "_index_path", lambda: tmp_path / "index.json")
    monkeypatch.setattr("softrig_core.scenario.scenario_file.prefixes", list)
    return scenarios


def loads(monkeypatch):
    """The result of `listed`, and whether it has loaded a scenario for it."""
    names = []

    def noted(name):
        names.append(name)
        return load_scenario(name)

    monkeypatch.setattr("softrig_core.scenario.scenario.load_scenario", noted)
    broken = []
    return [tuple(row) for row in listed(broken)], bool(names), broken


def test_the_index_equals_what_loading_gives_until_a_file_changes(folder, tmp_path, monkeypatch):
    one, slow = ("one", "lag", 1.5, "One", "none"), ("one_slow", "lag", 9.0, "One", "none")
    assert loads(monkeypatch) == ([one, slow], True, [])
    assert loads(monkeypatch) == ([one, slow], False, [])
    (folder / "one.yaml").write_text(FILE.format(title="Two", duration=1.5))
    os.utime(folder / "one.yaml", ns=(1, 1))  # an older file replaces it
    rows, loaded, _ = loads(monkeypatch)
    assert (rows[0][3], loaded) == ("Two", True)
    (folder / "other.yaml").write_text("extends: one\n")
    assert [r[0] for r in loads(monkeypatch)[0]] == ["one", "one_slow", "other"]
    (folder / "other.yaml").unlink()
    assert [r[0] for r in loads(monkeypatch)[0]] == ["one", "one_slow"]
    assert loads(monkeypatch)[1] is False
    (tmp_path / "index.json").write_text('{"folders": [], "state"')
    assert loads(monkeypatch)[1] is True


def test_nothing_is_stored_while_a_file_is_broken_or_the_index_cannot_be_written(folder, tmp_path, monkeypatch):
    (folder / "bad.yaml").write_text("title: [")
    for _ in range(2):
        rows, loaded, broken = loads(monkeypatch)
        assert ([r[0] for r in rows], loaded, len(broken)) == (["bad", "one", "one_slow"][1:], True, 1)
        assert isinstance(broken[0], ScenarioError)
    assert not (tmp_path / "index.json").exists()
    (folder / "bad.yaml").unlink()
    monkeypatch.setattr(index, "_index_path", lambda: tmp_path / "missing/index.json")
    assert [r[0] for r in loads(monkeypatch)[0]] == ["one", "one_slow"]
