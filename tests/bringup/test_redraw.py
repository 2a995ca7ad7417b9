"""Pictures of a completed run, from its bag: sizes, letters, data."""

import csv
import json
import re
import shutil
from pathlib import Path

import pytest
from matplotlib.image import imread
from softrig_bringup.cli import main
from softrig_bringup.plots.pictures import plot_entry
from softrig_bringup.plots.style import Style
from softrig_bringup.report.apart import names
from softrig_bringup.report.record import read_run
from softrig_bringup.report.run_rig import rig_of_run

SIGNAL = "motor/applied/armature"
SCENARIO = """title: Two pictures
extends: dc_motor_smc_b2
plots:
  - {title: Speed, signals: {motor/true_state/shaft/velocity: speed, motor/reference/shaft/velocity: reference}}
  - {title: Voltage, signals: {motor/applied/armature: voltage}}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("redraw") / "run"
    scenario = folder.with_name("two.yaml")
    scenario.write_text(SCENARIO)
    options = ["--mode", "inprocess", "--duration", "0.2", "--set", "dc_motor_smc.delta=1.5", "--no-plots"]
    assert main(["run", str(scenario), *options, "--out", str(folder)]) == 0
    return folder


@pytest.mark.long
def test_a_run_is_drawn_again_as_it_ran(run, tmp_path, capsys):
    rig, _ = rig_of_run(run)
    assert rig.scenario.duration == 0.2
    assert next(m for m in rig.members if m.name == "dc_motor_smc").params.delta == 1.5
    capsys.readouterr()
    assert main(["draw", "plot", str(run), "--out", str(tmp_path), "--width", "88", "--font", "8", "--no-title"]) == 0
    written = capsys.readouterr().out.split()
    assert len(written) == len(rig.scenario.plots)
    assert all(Path(path).read_bytes().startswith(b"%PDF") for path in written)
    # The bag alone, without its results folder.
    assert main(["draw", "plot", str(run / "bag"), SIGNAL, "--out", str(tmp_path / "bag")]) == 0


def test_width_letters_and_title_are_as_requested(run, tmp_path):
    rig, result = rig_of_run(run)
    entry = rig.scenario.plots[0]
    figure = plot_entry(result, rig, entry, Style(title=False, font=8.0, inches=88.0 / 25.4))
    assert figure.get_size_inches()[0] == pytest.approx(88.0 / 25.4)
    assert not figure._suptitle
    sizes = {t.get_fontsize() for ax in figure.axes for t in (*ax.get_legend().get_texts(), ax.yaxis.label)}
    assert sizes == {8.0}
    assert main(["draw", "plot", str(run), SIGNAL, "--format", "png", "--width", "100", "--out", str(tmp_path)]) == 0
    (picture,) = tmp_path.glob("*.png")
    assert imread(picture).shape[1] == pytest.approx(300 * 100 / 25.4, abs=1)


def test_the_data_of_a_picture_has_units_in_its_header(run, tmp_path):
    options = [SIGNAL, "motor/true_state/shaft/velocity", "--csv", "--window", "0.05", "0.1", "--out", str(tmp_path)]
    assert main(["draw", "plot", str(run), *options]) == 0
    (table,) = tmp_path.glob("*.csv")
    head, *rows = csv.reader(table.open())
    assert head == ["t (s)", "motor/applied/armature (V)", "motor/true_state/shaft/velocity (rad/s)"]
    times = [float(row[0]) for row in rows]
    assert times == sorted(times)
    assert (times[0], times[-1]) == (0.05, 0.1)
    assert all(float(row[1]) == float(row[1]) for row in rows)


@pytest.mark.long
def test_a_report_draws_what_the_run_did_not(run, tmp_path):
    assert main(["report", str(run), "--out", str(tmp_path / "one.html")]) == 0
    page = (tmp_path / "one.html").read_text()
    assert page.count("<figure>") == len(rig_of_run(run)[0].scenario.plots) + 1
    assert "This run has no pictures" not in page


def test_a_picture_that_cannot_be_drawn_is_one_line(run, tmp_path, capsys):
    assert main(["draw", "plot", str(tmp_path / "nowhere")]) == 2
    assert "expected a run, a bag or a pack" in capsys.readouterr().err
    assert main(["draw", "plot", str(run), "motor/speed", "--out", str(tmp_path)]) == 2
    assert "no signal 'motor/speed'" in capsys.readouterr().err
    edited = Path(shutil.copytree(run, tmp_path / "edited"))
    content = json.loads((edited / "metrics.json").read_text())
    for command in ("make all", "softrig 'run"):
        (edited / "metrics.json").write_text(json.dumps(content | {"command": command}))
        assert main(["draw", "plot", str(edited)]) == 2
        assert f"command: expected that of a run, got {command!r}" in capsys.readouterr().err
        assert main(["report", str(edited), "--out", str(tmp_path / "edited.html")]) == 0
        assert "This run has no pictures" in (tmp_path / "edited.html").read_text()


@pytest.mark.parametrize(
    ("style", "columns", "width", "font"),
    [("ieee", 1, 88.9, "STIXGeneral"), ("ieee", 2, 182.0, "STIXGeneral"), ("elsevier", 1, 90.0, "DejaVuSans"),
     ("springer", 1, 84.0, "DejaVuSans"), ("serif", 1, 120.0, "STIXGeneral")],
)  # fmt: skip
def test_a_picture_has_the_column_width_and_letters_of_its_publisher(run, tmp_path, style, columns, width, font):
    words = ["--style", style, "--columns", str(columns), "--out", str(tmp_path)]
    assert main(["draw", "plot", str(run), SIGNAL, *words]) == 0
    (picture,) = tmp_path.glob("*.pdf")
    content = picture.read_bytes()
    (box,) = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+)", content)
    assert float(box) == pytest.approx(72.0 * width / 25.4, abs=0.1)
    assert b"/Type3" not in content
    assert {name.split(b"+")[-1].split(b"-")[0].decode() for name in re.findall(rb"/FontName /(\S+)", content)} == {
        font
    }


@pytest.mark.long
def test_no_pdf_of_softrig_has_type_3_fonts(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--duration", "0.1", "--no-record", "--format", "pdf"]
    assert main([*words, "--out", "a"]) == 0
    study = ["study", "dc_motor_smc_b2", "--draw", "dc_motor_plant.R=0.3..0.5", "--draws", "5", "--duration", "0.1"]
    assert main([*study, "--format", "pdf", "--workers", "1", "--out", "s"]) == 0
    assert main(["draw", "plot", str(run), "--out", "p"]) == 0
    results = [path for folder in "asp" for path in (tmp_path / folder).glob("*.pdf")]
    assert len(results) > 6
    assert [path.name for path in results if b"/Type3" in path.read_bytes()] == []


@pytest.mark.parametrize(
    ("window", "message"),
    [
        (("0", "0"), "expected FROM before TO"),
        (("0.1", "0.05"), "expected FROM before TO"),
        (("5", "6"), "only from 0"),
    ],
)
def test_a_window_without_a_sample_is_refused(run, window, message, capsys):
    assert main(["draw", "plot", str(run), SIGNAL, "--window", *window]) == 2
    assert f"--window {float(window[0]):g} {float(window[1]):g}: " in (text := capsys.readouterr().err)
    assert message in text


@pytest.mark.long
def test_several_runs_are_overlaid_and_replace_nothing(run, tmp_path, monkeypatch, capsys):
    """Their pictures have a folder of their own; those of one run are in its folder."""
    monkeypatch.chdir(tmp_path)
    other = Path(shutil.copytree(run, tmp_path / "other"))
    assert main(["draw", "plot", str(run), str(other), SIGNAL, "--csv", "--format", "svg"]) == 0
    picture, table = (Path(line) for line in capsys.readouterr().out.split())
    assert picture.parts[0] == "pictures"
    text = picture.read_text()
    assert "run" in text
    assert "other" in text
    head, *rows = csv.reader(table.open())
    assert head == ["t (s)", f"{SIGNAL} of run (V)", f"{SIGNAL} of other (V)"]
    assert all(row[1] == row[2] for row in rows)
    assert main(["draw", "plot", "other"]) == 0
    assert main(["draw", "plot", "other", SIGNAL, "--window", "0", "0.1"]) == 0
    lines = capsys.readouterr().out.split()
    assert len({*lines}) == 3
    assert all(line.startswith("other/pictures/") and Path(line).is_file() for line in lines)
    three = [f"very_long_name_of_a_run_that_fills_a_row_{k}" for k in range(2)]
    for k, name in enumerate(three):
        folder = Path(shutil.copytree(run, tmp_path / name))
        content = json.loads((folder / "metrics.json").read_text())
        content["parameters"]["dc_motor_smc"]["delta"] = 1.5 + k
        content["changed"] = [f"dc_motor_smc.delta={1.5 + k}"]
        (folder / "metrics.json").write_text(json.dumps(content))
    assert names([(tmp_path / n, read_run(tmp_path / n)) for n in three]) == ["delta 1.5", "delta 2.5"]
