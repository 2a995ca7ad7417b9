"""Plots and the HTML report, from a synthetic drive run in memory."""

import json
import math
import platform
import struct
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from expected_text import check_expected, on_paper, page_lines
from hypothesis import given, strategies as st
from softrig_bringup.folder import ResultsFolder
from softrig_bringup.page.diagram import draw_diagram
from softrig_bringup.page.wiring import Node, Wiring, wiring_of
from softrig_bringup.page.wording import spans
from softrig_bringup.plots import pictures as plots
from softrig_bringup.plots.curves import envelope
from softrig_bringup.plots.named import OVERVIEW, plot_name
from softrig_bringup.plots.pictures import plot_run
from softrig_bringup.report.report import write_report
from softrig_bringup.report.run_page import _changes
from softrig_bringup.run.run import illustrate, save, summary
from softrig_core import (
    Block,
    BlockParams,
    Plant,
    Recording,
    Run,
    Scenario,
    ScenarioError,
    Signals,
    command,
    joint_state,
    number,
    param,
    reference,
    rig_of,
    run_inprocess,
    scalars,
    vector3,
)
from softrig_core.judge.units import pretty_unit
from softrig_core.rig.members import signal_units
from softrig_core.verdict.result import Result


class Shaft(NamedTuple):
    theta: float
    w: float


class Drive(Plant):
    """A machine whose flux turns while its speed follows the command; a bus with many channels."""

    class Params(BlockParams):
        period: float = param(1e-3, "sampling period", "s", gt=0)
        J: float = param(0.02, "inertia", "kg m^2", gt=0)

    INPUTS = (command("v", "drive/command", ["phase"], "V"), number("load", "drive/load", "N m", held=True))
    OUTPUTS = (
        joint_state("state", "drive/state", ["shaft"], position="rad", velocity="rad/s", effort="N m"),
        vector3("flux", "drive/flux", "alpha_beta", "Wb"),
        scalars("sensors", "drive/sensors", {"current": "A", "count": ""}),
        joint_state("bus", "drive/bus", [f"cell_{i}" for i in range(12)], position="V"),
    )

    def first(self):
        return Shaft(0.0, 0.0)

    def outputs(self, x, t):
        s, c = math.sin(x.theta), math.cos(x.theta)
        return {
            "state": (x.theta, x.w, 0.2 * s),
            "flux": (0.9 * c, 0.9 * s, 0.0),
            "sensors": (1.0 + 0.3 * s, math.floor(x.theta)),
            "bus": [3.7 + 0.01 * i * c for i in range(12)],
        }

    def advance(self, x, t, v, load):
        w = x.w + self.p.period * (v[0] - 0.05 * x.w) / self.p.J
        return Shaft(x.theta + self.p.period * w, w)


class Law(Block):
    class Params(BlockParams):
        period: float = param(10e-3, "sampling period", "s", gt=0)

    INPUTS = (
        joint_state("state", "drive/state", ["shaft"], velocity="rad/s"),
        reference("wanted", "drive/reference", ["shaft"], velocity="rad/s"),
    )
    OUTPUTS = (command("v", "drive/command", ["phase"], "V"), vector3("flux", "law/flux", "alpha_beta", "Wb"))

    def update(self, x, t, state, wanted):
        e = wanted[0] - state[0]
        flux = (0.8 * math.cos(t / 2e7), 0.8 * math.sin(t / 2e7), 0.0)
        return x, {"v": (max(-8.0, min(8.0, 2.0 * e)),), "flux": flux}


class Steps(Block):
    class Params(BlockParams):
        period: float = param(10e-3, "sampling period", "s", gt=0)

    OUTPUTS = (reference("wanted", "drive/reference", ["shaft"], velocity="rad/s"),)

    def update(self, x, t):
        return x, {"wanted": (50.0 if t < 1_000_000_000 else 80.0,)}


PLOTS = [
    {
        "title": "Speed follows its steps",
        "signals": {"drive/state/shaft/velocity": "measured", "drive/reference/shaft/velocity": "reference"},
    },
    {"title": "Command, held 10 ms", "signals": {"drive/command/phase/effort": "phase voltage"}, "window": [0.9, 1.2]},
    {
        "title": "Speed and command",
        "signals": {
            "drive/state/shaft/velocity": "speed",
            "drive/reference/shaft/velocity": "reference",
            "drive/command/phase/effort": "command",
        },
    },
    {"title": "Flux circle", "signals": {"drive/flux/y": "machine", "law/flux/y": "estimate"}, "x": "x"},
]
BLOCKS = {"drive": Drive, "law": Law, "steps": Steps}


def rigs(patch):
    """Return a function that makes a rig of the blocks above, with changes to the scenario's keys."""
    patch.setattr("softrig_core.rig.rig.load_block", lambda package, executable: BLOCKS[executable])

    def make(**keys):
        nodes = {name: {"package": "here", "executable": name} for name in BLOCKS}
        about = {"name": "flux_demo", "title": "Flux <b>& speed</b>", "system": "drive", "source": "Nobody 2020"}
        return rig_of(Scenario(**{**about, "duration": 2.0, "nodes": nodes, "plots": PLOTS, **keys}))

    return make


@pytest.fixture
def make_rig(monkeypatch):
    return rigs(monkeypatch)


def record(rig):
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    run_inprocess(rig, 0, recording)
    return recording


def nothing(rig):
    return Recording((topic, port.msgtype) for topic, port in rig.topics.items())


def drawing(patch, folder):
    """Return a function that draws the plots of a rig; it returns figures by title, laid out as they were saved."""

    def draw(rig, recording, overview=True):
        figures, save = {}, plots.save_figure

        def keep(figure, path, title, run, also):
            save(figure, path, title, run, also)
            figures[title] = on_paper(figure)

        patch.setattr(plots, "save_figure", keep)
        paths = plot_run(Signals(recording), rig, folder, most=None if overview else len(rig.scenario.plots))
        named = [plot_name(i, p.title) for i, p in enumerate(rig.scenario.plots, 1)]
        assert [p.name for p in paths] == named + [OVERVIEW] * overview
        assert all(p.read_text().startswith("<svg") for p in paths)
        return figures

    return draw


@pytest.fixture
def draw(monkeypatch, tmp_path):
    return drawing(monkeypatch, tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The rig with all of its plots, and their figures, drawn once."""
    with pytest.MonkeyPatch.context() as patch:
        rig = rigs(patch)()
        return rig, drawing(patch, tmp_path_factory.mktemp("whole"))(rig, record(rig))


def lines(axes):
    return {line.get_label(): line for line in axes.lines}


def test_every_recorded_signal_has_a_unit(make_rig):
    rig = make_rig()
    known = signal_units(rig)
    assert set(Signals(record(rig))) <= set(known)
    assert known["drive/state/shaft/velocity"] == "rad/s"
    assert known["drive/sensors/count/position"] == ""


@pytest.mark.parametrize(
    ("unit", "printed"),
    [("kg m^2", "kg m²"), ("rad/s^2", "rad/s²"), ("m^-1", "m⁻¹"), ("ohm", "Ω"), ("kohms", "kohms"), ("%", "%")],
)
def test_units_are_typeset(unit, printed):
    assert pretty_unit(unit) == printed


def test_commands_are_steps_and_states_are_lines(whole):
    speed, volts = whole[1]["Speed and command"].axes
    result = lines(speed)
    assert result["speed"].get_drawstyle() == "default"
    assert result["reference"].get_drawstyle() == "steps-post"
    assert result["reference"].get_linestyle() == "--"
    assert result["reference"].get_zorder() > result["speed"].get_zorder()
    assert (speed.get_ylabel(), volts.get_ylabel()) == ("Speed, rad/s", "Voltage, V")
    (command,) = volts.lines
    assert command.get_drawstyle() == "steps-post"
    # The command holds to the end of the run; its last sample is at 1.99 s.
    assert command.get_xdata()[-1] == pytest.approx(2.0)


def test_a_quantised_measurement_of_a_plant_is_drawn_as_steps(make_rig, draw):
    title = "Count"
    rig = make_rig(plots=[{"title": title, "signals": {"drive/sensors/count/position": "count"}}])
    (count,) = draw(rig, record(rig), overview=False)[title].axes[0].lines
    assert count.get_drawstyle() == "steps-post"


@pytest.mark.long
def test_legends_cover_no_data(whole):
    for figure in whole[1].values():
        figure.draw_without_rendering()
        for ax in figure.axes:
            if (legend := ax.get_legend()) is not None:
                assert legend.get_window_extent().y0 >= ax.get_window_extent().y1 - 1


def test_flux_circle_is_round_and_names_its_axes(whole):
    (ax,) = whole[1]["Flux circle"].axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("α, Wb", "β, Wb")
    assert ax.get_aspect() == 1.0
    machine = lines(ax)["machine"]
    assert np.hypot(machine.get_xdata(), machine.get_ydata()) == pytest.approx(0.9)


def test_window_shows_only_its_time(whole):
    (ax,) = whole[1]["Command, held 10 ms"].axes
    assert ax.get_xlim() == (0.9, 1.2)
    t = ax.lines[0].get_xdata()
    assert t[0] <= 0.9
    assert t[-1] >= 1.2
    assert len(t) < 35  # the curve is drawn with fewer points than the 200 samples


def test_short_run_is_drawn_in_milliseconds(make_rig, draw):
    rig = make_rig(duration=0.05, plots=PLOTS[:1])
    (ax,) = draw(rig, record(rig), overview=False)[PLOTS[0]["title"]].axes
    assert ax.get_xlabel() == "Time, ms"
    assert lines(ax)["measured"].get_xdata()[-1] == pytest.approx(50.0)


def test_constant_signal_with_rounding_noise_stays_a_line(make_rig, draw):
    rig = make_rig(duration=0.1, plots=[PLOTS[0]])
    recording = nothing(rig)
    topic = recording.topics["drive/state"]
    layout = rig.topics["drive/state"].layout()
    for k in range(100):
        topic.times.append(k * 1_000_000)
        topic.data.append(layout.encode(k * 1_000_000, (0.0, 100.0 + 1e-13 * (k % 2), 0.0)))
    (ax,) = draw(rig, recording, overview=False)[PLOTS[0]["title"]].axes
    low, high = ax.get_ylim()
    assert high - low > 0.01


def test_overview_shows_every_signal_with_its_unit(whole):
    rig, figures = whole
    figure = figures["Every recorded signal"]
    panels = [ax for ax in figure.axes if ax.get_visible()]
    assert sum(len(ax.lines) for ax in panels) == len(signal_units(rig)) - 1  # no node publishes drive/load
    assert {ax.get_ylabel() for ax in panels} == {"rad", "rad/s", "N m", "Wb", "A", "", "V"}
    assert figure._supxlabel.get_text() == "nothing published on drive/load"
    assert all(ax.lines for ax in panels)
    titles = [ax.get_title(loc="left") for ax in panels]
    assert "drive/state/shaft/velocity" in titles
    assert any(t.startswith("drive/bus/*/position: 12 signals") for t in titles)


def test_switches_are_stacked(make_rig, draw):
    title = "Legs"
    rig = make_rig(plots=[{"title": title, "signals": {"drive/flux/x": "a", "drive/flux/y": "b"}}], duration=0.05)
    recording = nothing(rig)
    layout, topic = rig.topics["drive/flux"].layout(), recording.topics["drive/flux"]
    for k in range(50):
        topic.times.append(k * 1_000_000)
        topic.data.append(layout.encode(k * 1_000_000, (k % 2, k // 5 % 2, 0.0)))
    (ax,) = draw(rig, recording, overview=False)[title].axes
    a, b = (line.get_ydata() for line in ax.lines)
    assert a.min() > b.max()
    assert [t.get_text() for t in ax.get_yticklabels()] == ["a", "b"]


@pytest.mark.parametrize("recorder", [nothing, record], ids=["nothing", "everything"])
def test_a_run_that_broke_early_still_has_pictures(make_rig, draw, recorder):
    rig = make_rig(duration=0.001, plots=PLOTS[::3])  # one plot over time and one against another signal
    assert len(draw(rig, recorder(rig))) == 3


@pytest.mark.parametrize(
    "entry",
    [
        {"signals": {"drive/state/shaft/speed": ""}},
        {"signals": {"drive/flux/y": ""}, "x": "alpha"},
        {"signals": {"nowhere/y": ""}},
    ],
)
def test_plot_of_an_unknown_signal_is_refused(make_rig, tmp_path, entry):
    rig = make_rig(plots=[{"title": "Wrong", **entry}], duration=0.01)
    with pytest.raises(ScenarioError, match=r"plot 'Wrong': no signal '(drive|nowhere)/.*drive/state/shaft/velocity"):
        plot_run(Signals(record(rig)), rig, tmp_path)


@given(st.lists(st.floats(-1e9, 1e9), min_size=9, max_size=300), st.integers(1, 12))
def test_an_envelope_keeps_extremes_and_ends(values, columns):
    x, y = np.arange(float(len(values))), np.array(values)
    short_x, short_y = envelope(x, y, columns)
    assert len(short_x) <= max(4 * columns + 4, 0) or len(short_x) == len(x)
    assert (short_y.min(), short_y.max()) == (y.min(), y.max())
    assert (short_y[0], short_y[-1]) == (y[0], y[-1])
    assert np.all(np.diff(short_x) >= 0)


def test_a_signal_with_fewer_samples_than_pixels_is_drawn_unreduced():
    x = np.arange(8.0)
    assert envelope(x, x, 2)[0] is x


def test_a_table_of_changes_is_shown_if_something_was_changed():
    change = SimpleNamespace(at_s=0.25, node="gain", set={"k": 2.0})
    (table,) = _changes(SimpleNamespace(changes=[change], units={"gain": {"k": "1/s"}}))
    assert "".join(table.itertext()).endswith("0.25gain.k2.0 1/s")
    assert list(_changes(SimpleNamespace(changes=[], units={}))) == []


def test_the_first_of_many_intervals_are_written():
    pairs = [(0.0, 1.0), (2.0, 2.0), (3.0, 4.0), (5.0, 6.0)]
    assert spans(pairs[:3]) == "from 0 to 1 s, at 2 s, from 3 to 4 s"
    assert spans(pairs) == "from 0 to 1 s, at 2 s, from 3 to 4 s and 1 times more, to 6 s"


def test_envelope_keeps_a_single_spike_where_it_is():
    x, y = np.linspace(0.0, 2.0, 200_001), np.zeros(200_001)
    y[123_456] = 1.0
    short_x, short_y = envelope(x, y)
    assert len(short_x) < 5000
    assert short_x[short_y.argmax()] == pytest.approx(x[123_456], abs=2.0 / 1100)


class Page(HTMLParser):
    """The references of a page, its tags, and the cells of its tables."""

    def __init__(self, path):
        super().__init__()
        self.references, self.tags, self.rows, self.text = [], [], [], ""
        self._cell = False
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.references += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "action")]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._cell = True
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        self._cell = self._cell and tag not in ("td", "th")

    def handle_data(self, data):
        self.text += data
        if self._cell:
            self.rows[-1][-1] += data

    def row(self, name):
        (result,) = [r for r in self.rows if r[0] == name]
        return result


METRICS = [
    {"name": "rise_time", "unit": "s", "published": 0.607, "expected": 0.607, "tolerance": 0.001, "value": 0.60695,
     "pass": True},
    {"name": "final_error", "unit": "rad/s^2", "at_most": 0.5, "value": -1.25, "pass": True},
    {"name": "cost", "published": 15459.0012, "expected": 15459.0, "tolerance": 0.01, "value": 15459.5, "pass": False},
    {"name": "ripple", "value": 0.25, "pass": True},
    {"name": "settling", "at_most": 1.0, "value": None, "pass": False, "error": "never <settles>"},
]  # fmt: skip


@pytest.fixture
def make_run(make_rig, tmp_path):
    """A run directory as the command line writes it."""

    def make(name="flux_demo", metrics=METRICS, picture=False, **keys):
        rig = make_rig(name=name, duration=0.2, plots=PLOTS[::3])
        run = Run(rig, 3, record(rig), 0.05, **keys)
        directory = tmp_path / name
        content = summary(run, [Result.read(m) for m in metrics], "scripts/softrig run flux_demo --set 'a.b=<c>'")
        save(run, content, ResultsFolder(directory), record=False)
        if picture:
            illustrate(run, ResultsFolder(directory))
        write_report([directory], directory / "report.html")
        return directory

    return make


def test_report_is_self_contained_and_escaped(make_run):
    page = Page(make_run(picture=True) / "report.html")
    assert all(r.startswith("#") for r in page.references)
    assert not {"script", "link", "iframe", "b"} & set(page.tags)
    assert page.tags.count("desc") == 3
    for text in ("Flux <b>& speed</b>", "Nobody 2020", "--set 'a.b=<c>'", "never <settles>", "law/flux/y"):
        assert text in page.text
    assert "url(" not in page.text
    assert "@import" not in page.text


def test_report_shows_measured_against_published(make_run):
    page = Page(make_run() / "report.html")
    tolerance = "-5 % of the tolerance".replace("-", "−")
    assert page.row("rise time") == [
        "rise time",
        "0.607",
        "0.60695",
        "s",
        "−0.01 %",
        "0.607 ± 0.001",
        tolerance,
        "✓ pass",
    ]
    assert page.row("final error") == ["final error", "–", "−1.25", "rad/s²", "–", "≤ 0.5", "", "✓ pass"]
    cost = page.row("cost")
    assert cost[1:3] == ["15459.0012", "15459.5000"]
    assert cost[-1] == "✗ miss"
    assert page.row("ripple")[-1] == "–"
    assert page.row("settling")[-1] == "✗ missnever <settles>"
    assert "✗ 2 of 4 pass" in page.text


def test_empty_columns_are_left_out(make_run):
    page = Page(make_run(metrics=[{"name": "ripple", "unit": "A", "value": 0.25, "pass": True}]) / "report.html")
    assert [r for r in page.rows if r[0] == "Figure"] == [["Figure", "Measured", "Unit"]]
    assert "Published" not in page.text


def test_report_shows_parameters_with_units_versions_and_command(make_run):
    file = make_run() / "report.html"
    page = Page(file)
    assert page.tags.count("details") == len(BLOCKS)
    assert all(f"<summary><code>{node}</code>" in file.read_text() for node in BLOCKS)
    assert " · softrig</title>" in file.read_text()
    # The title has the name of the scenario, not the path of its file.
    assert "Repeat this runsoftrig run flux_demo --set" in page.text
    for text in ("J0.02 kg m²", "period0.001 s", platform.python_version(), "seed3", "ticks200"):
        assert text in page.text


STATUS = {
    "drive": {"state": "done", "t": 7, "ticks": 200, "error": "", "waits_for": [], "cpu_s": 0.5,
              "round_trip_p99_ms": 0.1234, "refused": {"drive/command": [2, "phase/effort is nan"]}, "reports": {},
              "native": [150, "50 of its ticks were given up"]},
    "law": {"state": "failed", "t": 7, "ticks": 199, "error": "no answer", "waits_for": [], "refused": {},
            "reports": {"clip": [1, "command clipped to 8 V", 12]}},
}  # fmt: skip


def test_a_report_shows_what_nodes_rejected_and_how_slow_they_were(make_run):
    page = Page(make_run(status=STATUS, error="node law died") / "report.html")
    assert page.row("Node") == ["Node", "refused", "ticks", "cpu (s)", "round trip p99 (ms)"]
    assert page.row("drive") == ["drive", "2", "200", "0.5", "0.123"]
    assert page.row("law") == ["law", "0", "199", "–", "–"]
    for text in (
        "2 messages refused on drive/command: phase/effort is nan",
        "command clipped to 8 V (12 ×)",
        "no answer",
        "The run broke: node law died",
        "✗ broke",
        "Answered by native code: drive 150 ticks (50 of its ticks were given up)",
    ):
        assert text in page.text


def test_several_runs_get_an_index_and_are_side_by_side(make_run, tmp_path):
    good = [m for m in METRICS if m["pass"]]
    runs = [make_run("first"), make_run("second", good), make_run("broken", [], error="gone")]
    write_report(runs[:1], tmp_path / "one.html", ["as many labels as runs"])
    write_report(runs, tmp_path / "all.html")
    page = Page(tmp_path / "all.html")
    index, compared = ([r for r in page.rows if r[0] == name] for name in ("first", "second"))
    assert [r[-2:] for r in (index[0], compared[0])] == [["✗ 2 of 4 pass", "cost, settling"], ["✓ 2 of 2 pass", ""]]
    assert [r for r in page.rows if r[0] == "broken"] == [
        ["broken", "broken", "inprocess", "3", "0.2 s", "0.05 s", "✗ broke", "gone"]
    ]
    assert index[1] == ["first", "0.60695", "−1.25", "0.25"]
    assert compared[1] == ["second", "0.60695", "−1.25", "0.25"]
    assert page.references[:3] == ["#run-1", "#run-2", "#run-3"]
    assert page.tags.count("section") == 3
    assert page.tags.count("details") == 3 * (1 + len(BLOCKS))  # the report folds the sections of single runs
    assert "This run has no pictures" in page.text
    assert not list(tmp_path.glob("*.part"))


GAUGED = [
    *METRICS,
    {"name": "exact", "unit": "m", "expected": 2.0, "tolerance": 0.1, "value": 2.05, "pass": True},
    {"name": "far_off", "expected": 2.0, "tolerance": 0.1, "value": -9.0, "pass": False},
    {"name": "lower", "at_least": 1.0, "published": 1.5, "value": 1.0, "pass": True},
    {"name": "never_there", "at_least": 1.0, "value": None, "pass": False, "error": "never"},
]
TURNED = [{"at_s": 0.0125, "node": "drive", "set": {"J": 0.03, "period": 0.001}}]


@pytest.mark.parametrize(
    ("name", "keys", "more"),
    [
        ("run", {"status": STATUS}, {"changes": TURNED, "label": "mine"}),
        ("broke", {"status": STATUS, "error": "node law died", "metrics": ()}, {"mode": "processes"}),
        ("stopped", {"stopped": 2, "metrics": GAUGED[:2]}, {"changed": ["drive.J=0.03", "seed 3"], "wall_s": 0.0}),
        ("compared", {"metrics": GAUGED[1:3]}, {"changed": ["drive.J=0.03"]}),
    ],
)
def test_the_page_of_a_run_is_as_expected(make_run, name, keys, more):
    folder = make_run(**{"metrics": GAUGED} | keys)
    content = json.loads((folder / "metrics.json").read_text()) | more
    (folder / "metrics.json").write_text(json.dumps(content))
    if name == "run":
        for k, picture in enumerate((plot_name(1, PLOTS[0]["title"]), OVERVIEW)):
            (folder / picture).write_bytes(b"\x89PNG" + bytes(12) + struct.pack(">II", 640 + k, 390))
    write_report([folder], folder / "report.html")
    check_expected(f"pages/{name}", page_lines((folder / "report.html").read_text(), ["Versions", "Block diagram"]))


def test_the_page_of_several_runs_is_as_expected(make_run, tmp_path):
    folders = [make_run("first", GAUGED), make_run("second", METRICS[:2]), make_run("broken", [], error="gone")]
    for folder, more in zip(folders, ({"label": "mine"}, {"seed": 4, "changed": ["seed 4"]}, {}), strict=True):
        content = json.loads((folder / "metrics.json").read_text()) | more
        (folder / "metrics.json").write_text(json.dumps(content))
    write_report(folders, tmp_path / "all.html")
    page = (tmp_path / "all.html").read_text().replace(str(tmp_path), "HERE")
    check_expected("pages/several", page_lines(page, ["Versions", "Block diagram", "Parameters"]))


def test_the_block_diagram_is_as_expected(make_rig):
    """One with every kind of wire: back to the controller, to several subscribers, to none; a node outside."""
    wiring = wiring_of(make_rig(duration=0.2))
    nodes = wiring.nodes | {"log": Node(executable="p/log", period=0.5, outside=True)}
    wires = [replace(w, readers=(*w.readers, "log")) if "flux" in w.topic else w for w in wiring.wires]
    text = ElementTree.tostring(draw_diagram(Wiring(nodes=nodes, wires=tuple(wires))), "unicode", "html")
    check_expected("pages/diagram", page_lines(text))


def test_bad_run_directories_are_refused(make_run, tmp_path):
    with pytest.raises(ScenarioError, match=r"nowhere: no such folder, expected that of a run"):
        write_report([tmp_path / "nowhere"], tmp_path / "r.html")
    (tmp_path / "part" / "log").mkdir(parents=True)
    with pytest.raises(ScenarioError, match=r"expected directories of runs$"):
        write_report([tmp_path / "part"], tmp_path / "r.html")
    (tmp_path / "part" / "log" / "plant.shard").touch()
    with pytest.raises(ScenarioError, match=r"part: no metrics.json there, .* softrig bag repair makes one bag"):
        write_report([tmp_path / "part"], tmp_path / "r.html")
    file = make_run() / "metrics.json"
    content = file.read_text()
    for changed, message in (
        (content[:50], r"metrics\.json: not valid JSON"),
        (content.replace('"seed"', '"sead"'), r"metrics\.json: seed: field required"),
        (content.replace('"value": 0.25', '"value": "much"'), r"metrics\.json: metrics\.3\.value: input should be"),
    ):
        file.write_text(changed)
        with pytest.raises(ScenarioError, match=message):
            write_report([file.parent], tmp_path / "r.html")
    for keys, value, message in (
        (("nodes", "plant"), {"reports": "none"}, r"nodes\.reports: "),
        (("nodes", "plant"), {"refused": {"motor/command": 3}}, r"nodes\.refused\.motor/command: "),
        (("wiring",), {"nodes": {}, "wires": [{"topic": "t", "type": "T", "source": "s"}]}, "wiring: .*t names 's'"),
        (("metrics", 0, "tolerance"), -1.0, r"metrics\.0\.tolerance: input should be greater than or equal to 0"),
    ):
        edited = json.loads(content)
        place = edited
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        file.write_text(json.dumps(edited))
        with pytest.raises(ScenarioError, match=rf"(?s)metrics\.json: {message}"):
            write_report([file.parent], tmp_path / "r.html")
    assert not (tmp_path / "r.html").exists()
