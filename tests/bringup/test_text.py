"""Text from files is text: it contains no markup and no terminal commands, and it cannot end a run."""

import pytest
from softrig_bringup.cli import main
from softrig_core.guard import plain

LAG = """
title: TITLE
system: TITLE
source: TITLE
duration: 0.1
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain}
figures:
  last: {function: final_value, arguments: {signal: lag/state/x/position}}
claims:
  last: {published: 7.0, tolerance: 1 %, where: TITLE, verdict: reproduced}
"""
STUDY = (
    "{title: TITLE, scenario: lag, grid: {plant.gain: [1, 2]}, summaries: {s: {figure: last}}, expect: {s: at least 9}}"
)
TEXTS = {
    '"[bold red]loud[/bold red] x [/b] [rad/s]"': "[bold red]loud[/bold red] x [/b] [rad/s]",
    '"cost in $ and {braces} $x^$"': "cost in $ and {braces} $x^$",
}
ALL = f'"{" ".join(text[1:-1] for text in TEXTS)}"'  # both texts in one run, which halves the time


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "scenarios").mkdir()
    (tmp_path / "studies").mkdir()
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path / "scenarios"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    monkeypatch.setenv("COLUMNS", "300")  # wide enough that no line wraps
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("title", [ALL, *(pytest.param(text, marks=pytest.mark.long) for text in TEXTS)])
def test_a_title_is_shown_unchanged_whatever_it_contains(title, folder, capsys):
    (folder / "scenarios" / "lag.yaml").write_text(LAG.replace("TITLE", title))
    (folder / "studies" / "lags.yaml").write_text(STUDY.replace("TITLE", title))
    calls = [
        (["list"], 0),
        (["run", "lag", "--mode", "inprocess", "--no-record"], 1),
        (["study", "lags", "--workers", "1"], 1),
        (["check", "--claims", "--workers", "1"], 1),
        (["report", "runs/lag"], 0),
    ]
    for arguments, status in calls:
        assert main(arguments) == status, capsys.readouterr().err
        printed = " ".join("".join(capsys.readouterr()).split())  # the output without its line breaks
        assert (TEXTS | {ALL: " ".join(TEXTS.values())})[title] in printed or arguments[0] in ("check", "report")


def test_control_characters_of_a_file_are_refused_by_line(folder, capsys):
    (folder / "scenarios" / "lag.yaml").write_text(LAG.replace("TITLE", '"\\e[31mred\\e]0;title\\a \\x9b2J"'))
    for arguments in (["list"], ["run", "lag", "--mode", "inprocess", "--no-record"]):
        assert main(arguments) == 2
        printed = " ".join("".join(capsys.readouterr()).split())
        assert "lag.yaml: not valid YAML: line 2: control character in" in printed
        assert not {"\x1b", "\x9b", "\x07"} & set(printed)


def test_control_characters_are_made_visible_and_nothing_else_is_changed():
    assert plain("a\x1b[0m\x00\x7f\u202e\r") == r"a\x1b[0m\x00\x7f\u202e\r"
    assert plain("ü 中 \t\n é") == "ü 中 \t\n é"
