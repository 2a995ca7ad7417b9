"""Pictures of a run that is over, from its bag: sizes, letters, data."""

import csv
import json
import shutil
from pathlib import Path

import pytest
from matplotlib.image import imread
from softrig_bringup.cli import main
from softrig_bringup.plots.pictures import plot_entry
from softrig_bringup.report.redraw import rig_of_run

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


def test_a_run_is_drawn_again_as_it_ran(run, tmp_path, capsys):
    rig, _ = rig_of_run(run)
    assert rig.scenario.duration == 0.2
    assert next(m for m in rig.members if m.name == "dc_motor_smc").params.delta == 1.5
    capsys.readouterr()
    assert main(["draw", "plot", str(run), "--out", str(tmp_path), "--width", "88", "--font", "8", "--no-title"]) == 0
    written = capsys.readouterr().out.split()
    assert len(written) == len(rig.scenario.plots)
    assert all(Path(path).read_bytes().startswith(b"%PDF") for path in written)
    assert main(["draw", "plot", str(run / "bag"), SIGNAL, "--out", str(tmp_path / "bag")]) == 0  # a bag by itself


def test_width_letters_and_title_are_as_asked(run, tmp_path):
    rig, found = rig_of_run(run)
    entry = rig.scenario.plots[0]
    figure = plot_entry(found, rig, entry, title=False, font=8.0, inches=88.0 / 25.4)
    assert figure.get_size_inches()[0] == pytest.approx(88.0 / 25.4)
    assert not figure._suptitle
    sizes = {t.get_fontsize() for ax in figure.axes for t in (*ax.get_legend().get_texts(), ax.yaxis.label)}
    assert sizes == {8.0}
    assert main(["draw", "plot", str(run), SIGNAL, "--format", "png", "--width", "100", "--out", str(tmp_path)]) == 0
    (picture,) = tmp_path.glob("*.png")
    assert imread(picture).shape[1] == pytest.approx(300 * 100 / 25.4, abs=1)


def test_the_data_of_a_picture_has_units_in_its_head(run, tmp_path):
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
    assert page.count("<img") == len(rig_of_run(run)[0].scenario.plots) + 1
    assert "This run has no pictures" not in page


def test_what_cannot_be_drawn_is_one_line(run, tmp_path, capsys):
    assert main(["draw", "plot", str(tmp_path / "nowhere")]) == 2
    assert "no bag in it" in capsys.readouterr().err
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
