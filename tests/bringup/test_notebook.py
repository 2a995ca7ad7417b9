"""A run at a prompt and in a notebook; signals by their short names."""

import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from softrig_bringup.cli import main
from softrig_bringup.terminal.progress import progress
from softrig_core import ScenarioError, load_scenario, rig_of, simulate
from softrig_core.wire.signals import full_name

SHORT, WHOLE = "motor/applied/armature", "motor/applied/armature/effort"


@pytest.fixture(scope="module")
def run():
    return simulate("dc_motor_smc_b2", duration=0.5)


def test_a_run_is_one_line_at_a_prompt(run):
    assert repr(run).startswith("<Run of dc_motor_smc_b2 (inprocess, seed 0): 0.5 s in ")
    assert "\n" not in repr(run)
    assert len(repr(run)) < 120


def test_a_run_shows_its_figures_and_pictures_in_a_cell(run):
    cell = run._repr_html_()
    assert "<td" in cell
    assert "rise time" in cell
    assert cell.count('class="plot"') == 4


class Cell:
    """What IPython's `display` does as far as a bar needs it."""

    def __init__(self):
        self.states = []

    def display(self, data, *, raw, display_id):
        assert raw
        assert display_id
        self.update(data, raw=raw)
        return self

    def update(self, data, *, raw):
        self.states.append(data["text/html"])


def test_a_notebook_shows_the_progress_of_a_run(monkeypatch):
    cell = Cell()
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=cell.display))
    monkeypatch.setattr("softrig_bringup.terminal.progress.REDRAWN", -1.0)
    simulate("dc_motor_smc_b2", duration=0.5, progress=True)
    first, *between, last = cell.states
    assert first == 'dc_motor_smc_b2 <progress value="0" max="0.5"></progress> 0 of 0.5 s'
    assert last == ""
    values = [float(re.search(r'value="([^"]+)"', state)[1]) for state in between]
    assert values == sorted(values)
    assert values[-1] == 0.5
    assert len(values) > 40
    with pytest.raises(ZeroDivisionError), progress("broken", 1.0):
        raise ZeroDivisionError
    assert cell.states[-1] == ""


def test_without_a_terminal_a_line_now_and_then_reports_progress(monkeypatch, capsys):
    monkeypatch.setattr("softrig_bringup.terminal.progress.NEWS", -1.0)
    simulate("dc_motor_smc_b2", duration=0.5, progress=True)
    assert capsys.readouterr().err.splitlines()[-1] == "softrig: dc_motor_smc_b2: 0.5 of 0.5 s"


def test_signals_are_plotted_by_name_in_their_units(run):
    figure = run.plot(SHORT, "motor/true_state/shaft/velocity", window=(0.1, 0.2))
    volts, speed = figure.axes
    assert (volts.get_ylabel(), speed.get_ylabel()) == ("Voltage, V", "Speed, rad/s")
    assert volts.get_xlim() == (0.1, 0.2)
    assert figure._repr_png_().startswith(b"\x89PNG")  # a notebook shows the figure with and without pyplot
    assert len(run.plot().axes) >= 1
    with pytest.raises(ScenarioError, match="no signal 'motor/speed'"):
        run.plot("motor/speed")


def test_signals_become_a_data_frame_with_units(run):
    pandas = pytest.importorskip("pandas")
    frame = run.to_pandas("motor/applied")
    assert isinstance(frame, pandas.DataFrame)
    assert np.array_equal(frame[WHOLE].to_numpy(), run.signals[WHOLE].x)
    assert frame.attrs["units"][WHOLE] == "V"
    assert len(run.to_pandas().columns) > 5
    with pytest.raises(KeyError, match="no topic 'nowhere'"):
        run.to_pandas("nowhere")


def test_the_only_field_of_a_channel_may_be_left_out(run):
    assert np.array_equal(run.signals[SHORT].x, run.signals[WHOLE].x)
    with pytest.raises(KeyError, match="no signal 'shaft' on motor/state; it has shaft/position, shaft/velocity"):
        run.signals["motor/state/shaft"]  # several parts of the topic have this name
    assert full_name("a/b", ["a/b/x", "a/b/y"]) == "a/b"
    scenario = load_scenario("dc_motor_smc_b2")
    plots = (scenario.plots[0].model_copy(update={"signals": {SHORT: "volts"}}),)
    figures = {
        "mean": scenario.figures["rise_time"].model_copy(
            update={"function": "mean", "unit": None, "arguments": {"signal": SHORT}}
        )
    }
    short = scenario.model_copy(update={"plots": plots, "figures": figures, "expect": {}, "claims": {}})
    rig = rig_of(short.changed(duration=0.5))
    assert list(rig.scenario.plots[0].signals) == [WHOLE]
    assert simulate(rig).figures["mean"] == pytest.approx(run.signals[WHOLE].x.mean())


def test_signals_and_figures_are_listed(capsys):
    assert main(["list", "--signals", "dc_motor_smc_b2"]) == 0
    rows = {line.split("\t")[0]: line.split("\t")[1:] for line in capsys.readouterr().out.splitlines()}
    assert rows[SHORT] == ["V", "sensor_msgs/JointState", "dc_motor_plant -> dc_motor_metrics"]
    assert rows["motor/state/shaft/velocity"][0] == "rad/s"
    assert main(["list", "--figures"]) == 0
    assert "rise_time\ts\tTime in s from the first crossing" in capsys.readouterr().out
    assert main(["list", "--figures", "rise_time"]) == 0
    assert "low, high : float" in capsys.readouterr().out
    assert main(["list", "--figures", "rise_tim"]) == 2
    assert "did you mean 'rise_time'?" in capsys.readouterr().err
