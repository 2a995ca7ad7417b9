"""What a control engineer looks for in the pages: marks of expectations, block diagram, sources, several runs."""

import importlib
import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import tostring

import bibtexparser
import numpy as np
import pytest
from conftest import make_scenario
from expected_text import check_expected, figure_lines, on_paper
from matplotlib import rc_context
from matplotlib.figure import Figure
from softrig_bringup.cli import main
from softrig_bringup.folder import RUN
from softrig_bringup.options.repeat import for_reader
from softrig_bringup.page.citations import cited
from softrig_bringup.page.diagram import _lanes, draw_diagram
from softrig_bringup.page.wiring import Node, Wire, Wiring, columns, wiring_of
from softrig_bringup.plots import pictures as plots
from softrig_bringup.plots.axes import draw as draw_curves, draw_logic, fold_exponents
from softrig_bringup.plots.curves import Curve, check_plots, inside
from softrig_bringup.plots.marks import marks_of
from softrig_bringup.plots.named import Shown
from softrig_bringup.plots.overlay import BAND, Overlay, band, draw_overlay, overlay_figures
from softrig_bringup.plots.pictures import places, plot_entry, plot_run
from softrig_bringup.plots.style import ACCEPTED, PUBLISHED, Style, axis_title, style
from softrig_bringup.report.apart import differing, names
from softrig_bringup.report.record import RunRecord, read_run
from softrig_bringup.report.several import differences, groups, overlaid, side_by_side
from softrig_core import ScenarioError, Signals, list_scenarios, load_scenario, rig_of, simulate
from softrig_core.rig import code
from softrig_core.scenario.plot_entry import PlotEntry
from softrig_core.scenario.scenario_file import resolve
from softrig_core.verdict.result import Result

X = "lag/state/x/position"


def scenario(**keys):
    """A slow lag that approaches 0.455, with figures that have a place in its picture."""
    about = {
        "figures": {
            "settling_time": {"arguments": {"signal": X}},
            "last": {"function": "final_value", "arguments": {"signal": X}},
            "overshoot": {"arguments": {"signal": X, "final": 0.5}},
            "mean": {"arguments": {"signal": X, "start": 0.5, "end": 1.0}},
            "peak": {"arguments": {"signal": "lag/command/u/effort"}},
        },
        "expect": {
            "settling_time": "0.9 +- 0.1",
            "last": "0.45 +- 0.05",
            "overshoot": "at most 0",
            "mean": "0.3 +- 0.05",
        },
        "claims": {
            "last": {"published": 0.4, "where": "Table I", "verdict": "reproduced", "tolerance": "20 %"},
            "settling_time": {"published": 0.8, "where": "Table I", "verdict": "refuted", "reason": "it is not"},
        },
        "plots": [
            {"title": "Position", "signals": {X: "position"}},
            {"title": "Command", "signals": {"lag/command/u/effort": "command"}},
        ],
    }
    return make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, **{**about, **keys})


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Figures of a run's plots by title, as they were saved, without the overview."""

    def draw(scenario_of, also=""):
        result, save = {}, plots.save_figure

        def keep(figure, path, title, run, also):
            save(figure, path, title, run, also)
            result[title] = on_paper(figure)

        monkeypatch.setattr(plots, "save_figure", keep)
        run = simulate(rig_of(scenario_of))
        plot_run(run.signals, run.rig, tmp_path, also, len(scenario_of.plots))
        return result

    return draw


def marked(**keys):
    """One plot with each kind of mark: in windows, of peaks on both sides, far away, violated; a plane, a
    difference.
    """
    u, more = "lag/command/u/effort", {"arguments": {"signal": X}}
    figures = {
        "settling_time": more, "rise_time": more, "overshoot": {"arguments": {"signal": X, "final": 0.5}},
        "last": {"function": "final_value", **more}, "largest": {"function": "maximum", **more},
        "lowest": {"function": "minimum", "arguments": {"signal": X, "start": 0.3, "end": 0.7}},
        "peak": {"arguments": {"signal": X, "reference": 0.5}}, "mean": {"arguments": {"signal": u, "start": 0.5}},
    }  # fmt: skip
    about = {
        "figures": figures,
        "expect": {"settling_time": "0.9 +- 0.1", "rise_time": "at most 0.7", "overshoot": "at most 0",
                   "last": "0.45 +- 0.05", "largest": "0.44 +- 0.04", "lowest": "at least 0.25", "peak": "0.5 +- 0.02",
                   "mean": "at least 5"},
        "claims": {"last": {"published": 0.4, "where": "Table I", "verdict": "reproduced", "tolerance": "20 %"},
                   "mean": {"published": 500.0, "where": "Table I", "verdict": "refuted", "reason": "far away"},
                   "rise_time": {"published": 0.5, "where": "Table I", "verdict": "reproduced", "tolerance": "90 %"}},
        "shared": {"state": X},
        "requirements": {"low": "always[0.2, 0.8] state <= 0.3"},
        "plots": [
            {"title": "All", "signals": {X: "position", u: "command", f"{X} - {u}": "less"}},
            {"title": "Cut", "signals": {X: ""}, "window": [0.2, 0.6], "quantity": "Way"},
        ],
    }  # fmt: skip
    return scenario(**{**about, **keys})


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("marks", marked),
        ("short", lambda: load_scenario("induction_dtc").changed(duration=0.02)),
        ("angles", lambda: load_scenario("rehab_impedance").changed(duration=0.05)),
    ],
)
def test_pictures_of_runs_are_as_expected(name, make, drawn):
    """What is drawn where and how, in each picture of a run and in its overview."""
    check_expected(f"pictures/{name}", (line for figure in drawn(make()).values() for line in figure_lines(figure)))


def test_a_picture_for_print_is_as_expected():
    """Width, letters and no title as requested; a figure that was not published is reported."""
    marked_scenario = marked()
    run = simulate(rig_of(marked_scenario))
    figures = [plot_entry(run.signals, run.rig, marked_scenario.plots[0], Style(False, 7.0, 3.5))]
    run.recording.topics["lag/command"] = run.recording.topics["lag/command"].before(0)
    figures.append(plot_entry(Signals(run.recording), run.rig, marked_scenario.plots[0]))
    check_expected("pictures/print", (line for figure in figures for line in figure_lines(figure)))


def coloured(ax, colour):
    """Extent (x0, y0, x1, y1) of everything with a colour in an axes, in data coordinates."""
    from matplotlib.colors import same_color

    bands = [c.get_paths()[0].get_extents() for c in ax.collections if same_color(c.get_facecolor()[0][:3], colour)]
    spans = [
        p.get_extents().transformed(ax.transData.inverted())
        for p in ax.patches
        if same_color(p.get_facecolor()[:3], colour)
    ]
    lines = [line.get_path().get_extents() for line in ax.lines if same_color(line.get_color(), colour)]
    return [tuple(b.extents) for b in (*bands, *spans, *lines)]


def test_expected_and_published_values_are_drawn_where_the_signal_shows_them(drawn):
    (ax,) = drawn(scenario())["Position"].axes
    accepted, published = coloured(ax, ACCEPTED), coloured(ax, PUBLISHED)
    # The windows of the last value and of the mean.
    for x0, y0, x1, y1 in ((0.0, 0.4, 1.0, 0.5), (0.5, 0.25, 1.0, 0.35)):
        assert any(b == pytest.approx((x0, y0, x1, y1)) for b in accepted), accepted
    assert any((b[0], b[2]) == pytest.approx((0.8, 1.0)) for b in accepted)  # the accepted interval of the rise time
    assert any((b[1], b[3]) == pytest.approx((0.5, 0.5)) for b in accepted)  # the level of an overshoot of zero
    assert any(b == pytest.approx((0.0, 0.4, 1.0, 0.4)) for b in published)
    assert any((b[0], b[2]) == pytest.approx((0.8, 0.8)) for b in published)
    assert {t.get_text() for t in ax.get_legend().get_texts()} == {"position", "accepted", "limit", "published"}
    assert {t.get_text() for t in ax.texts} == {"settling time"}


def test_a_picture_without_expectations_has_no_marks(drawn):
    (ax,) = drawn(scenario())["Command"].axes
    assert coloured(ax, ACCEPTED) == coloured(ax, PUBLISHED) == []
    assert ax.get_legend() is None


def test_a_distant_mark_does_not_compress_the_curves(drawn):
    far = {"last": {"published": 50.0, "where": "Table I", "verdict": "refuted", "reason": "it is not"}}
    (ax,) = drawn(scenario(claims=far))["Position"].axes
    assert ax.get_ylim()[1] < 2.0
    assert coloured(ax, PUBLISHED) == []


def test_marks_follow_the_unit_of_the_figure_and_the_side_of_the_peak():
    rig = rig_of("rehab_impedance")  # the errors are in rad and their figures in deg
    t = np.linspace(0.0, 10.0, 11)
    marks = marks_of(rig, {"controller_state/e_hip/position": (t, -1e-4 * (t == 5.0))})
    (mark,) = (m for m in marks["controller_state/e_hip/position"] if m.name == "max_error_after_3_s_hip")
    assert (mark.low, mark.high) == pytest.approx((np.radians(-0.00819), np.radians(-0.00741)))
    # an extreme is marked beside its instant
    assert (mark.start, mark.end) == pytest.approx((5.0 - 0.06 * 7.0, 5.0 + 0.06 * 7.0))


@pytest.mark.parametrize("final", [{"final": 0.75}, {}])
def test_a_rise_is_marked_from_where_it_began(final):
    experiment = scenario(
        figures={"rise_time": {"arguments": {"signal": X} | final}}, expect={"rise_time": "0.5 +- 0.1"}, claims={}
    )
    run = simulate(rig_of(experiment))
    (mark,) = marks_of(run.rig, run.signals)[X]
    t, x = run.signals[X]
    began = t[np.argmax(x >= 0.1 * final.get("final", x[-1]))]
    assert (mark.axis, mark.low, mark.high) == ("time", pytest.approx(began + 0.4), pytest.approx(began + 0.6))


@pytest.mark.long
@pytest.mark.parametrize(("kind", "begin"), [("png", b"\x89PNG"), ("pdf", b"%PDF")])
def test_a_print_format_is_written_beside_each_picture(tmp_path, kind, begin):
    run = simulate(rig_of(scenario(plots=[{"title": "Position", "signals": {X: "position"}}])))
    plot_run(run.signals, run.rig, tmp_path, kind)
    pictures = sorted(tmp_path.glob("*.svg"))
    assert len(pictures) == 2
    assert all(p.with_suffix(f".{kind}").read_bytes().startswith(begin) for p in pictures)
    assert all(RUN.fullmatch(p.with_suffix(f".{kind}").name) for p in pictures)


@pytest.mark.parametrize(
    ("name", "unit", "title"),
    [("speed", "rad/s^2", "Speed, rad/s²"), ("i_a", "A", "i_a, A"), ("V", "", "V"), ("", "ohm", "Ω")],
)
def test_axes_have_titles(name, unit, title):
    assert axis_title(name, unit) == title


@pytest.mark.parametrize(("largest", "power"), [(3e7, 7), (3e-4, -4)])
def test_scale_factors_are_in_the_axis_title_and_nowhere_else(largest, power):
    with rc_context(style()):
        figure = Figure(layout="constrained")
        ax = figure.subplots()
        ax.plot([0.0, 1.0], [0.0, largest])
        ax.set(ylabel="Cost, $/h", xlabel="Time, s")
        fold_exponents(figure)
        figure.draw_without_rendering()
    assert (ax.get_ylabel(), ax.get_xlabel()) == (rf"Cost, $\mathregular{{10^{{{power}}}}}$ $/h", "Time, s")
    shown = {t.get_text() for t in ax.get_yticklabels()}
    assert shown >= {"0.0", "1.0", "3.0"}
    assert not ax.yaxis.get_offset_text().get_visible()


@pytest.mark.parametrize("count", range(1, 8))
def test_no_panel_is_empty(count):
    figure = Figure()
    spots = [figure.add_subplot(p).get_position() for p in places(figure, count, 2 if count > 1 else 1)]
    assert len(spots) == count
    assert not any(a.overlaps(b) for i, a in enumerate(spots) for b in spots[:i])
    right, left = max(s.x1 for s in spots), min(s.x0 for s in spots)
    for y in {s.y0 for s in spots}:  # each row moves from one side to the other
        row = [s for s in spots if s.y0 == y]
        assert (min(s.x0 for s in row), max(s.x1 for s in row)) == pytest.approx((left, right))


def test_a_plot_of_a_replaced_node_explains_how_to_add_plots():
    experiment = scenario(
        plots=[{"title": "Gone", "signals": {"lag/status/x/position": ""}}], figures={}, expect={}, claims={}
    )
    with pytest.raises(ScenarioError, match=r"did you mean 'lag/state/x/position'.*`plots: \[\]` leaves the overview"):
        check_plots(rig_of(experiment))


# block diagram ----------------------------------------------------------------------------------------------------


def test_a_loop_is_drawn_from_left_to_right(lag_rig):
    wiring = wiring_of(lag_rig)
    assert columns(wiring) == [["source"], ["gain"], ["plant"]]
    assert {(w.source, w.readers) for w in wiring.wires if w.readers} == {
        ("source", ("gain",)),
        ("gain", ("plant",)),
        ("plant", ("gain",)),
    }


def test_followers_are_drawn_behind_the_plant():
    nodes = {n: Node(executable=f"p/{n}", period=0.1, plant=n == "plant") for n in ["plant", "law", "log", "note"]}
    wires = (
        Wire(topic="x", type="T", source="plant", readers=("law", "log")),
        Wire(topic="u", type="T", source="law", readers=("plant", "log")),
        Wire(topic="y", type="T", source="log", readers=("note",)),
    )
    assert columns(Wiring(nodes=nodes, wires=wires)) == [["law"], ["plant"], ["log"], ["note"]]
    del nodes["plant"], nodes["law"]  # a rig without a plant is drawn, too
    assert columns(Wiring(nodes=nodes, wires=wires[2:])) == [["log"], ["note"]]


@pytest.mark.parametrize(
    ("to", "result"),
    [
        ({"a": ("d",), "b": ("c", "plant"), "c": ("plant",), "d": ("plant",), "plant": ()}, [["a", "b"], ["d", "c"]]),
        # Both c and d lie at the mean of their neighbours: one and three of them.
        ({"a": ("d", "plant"), "b": ("d",), "c": ("plant",), "d": ("plant",), "plant": ()}, [["a", "b"], ["c", "d"]]),
    ],
)
def test_parallel_nodes_are_side_by_side_and_the_first_named_is_on_top(to, result):
    nodes = {n: Node(executable=f"p/{n}", period=0.1, plant=n == "plant") for n in to}
    wires = tuple(Wire(topic=n, type="T", source=n, readers=readers) for n, readers in to.items())
    assert columns(Wiring(nodes=nodes, wires=wires)) == [*result, ["plant"]]


def test_many_nodes_are_arranged_quickly():
    names = [f"n{k}" for k in range(60)]  # node k reads all nodes before it: 2^58 paths lead to the last
    nodes = {n: Node(executable=f"p/{n}", period=0.1, plant=n == "n59") for n in names}
    wires = tuple(Wire(topic=n, type="T", source=n, readers=tuple(names[k + 1 :])) for k, n in enumerate(names[:-1]))
    assert columns(Wiring(nodes=nodes, wires=wires)) == [[n] for n in names]


def segments(group):
    """Straight pieces of a wire: ((x0, y0), (x1, y1))."""
    for path in group.iter("path"):
        if path.get("class") != "head":
            (x0, y0), (x1, y1) = ([float(v) for v in p.split()] for p in path.get("d")[1:].split("L"))
            yield (min(x0, x1), min(y0, y1)), (max(x0, x1), max(y0, y1))


def headlines():
    """Return the shortest scenario name of each system, without reading the rest of 390 scenarios."""
    results = sorted(list_scenarios().items(), key=lambda item: len(item[0]), reverse=True)
    return sorted({resolve(name, path)["system"]: name for name, path in results}.values())


@pytest.mark.parametrize("name", headlines())
def test_the_diagram_has_every_node_and_wire_of_a_system(name):
    wiring = wiring_of(rig_of(name))
    drawing = draw_diagram(wiring)
    assert {g.get("data-node") for g in drawing.iter("g")} - {None} == set(wiring.nodes)
    wires = {g.get("data-topic"): g for g in drawing.iter("g") if g.get("data-topic")}
    assert set(wires) == {w.topic for w in wiring.wires}
    for wire in wiring.wires:  # each subscriber has an arrow
        heads = [p for p in wires[wire.topic].iter("path") if p.get("class") == "head"]
        assert len(heads) == len(wire.readers), wire
    pieces = [(topic, piece) for topic, group in wires.items() for piece in segments(group)]
    for k, (topic, (a, b)) in enumerate(pieces):  # wires may cross, but none covers another
        for other, (c, d) in pieces[:k]:
            for i, j in ((0, 1), (1, 0)):
                level = a[i] == b[i] == c[i] == d[i]
                assert topic == other or not (level and min(b[j], d[j]) > max(a[j], c[j])), (topic, other)
    width, height = (float(v) for v in drawing.get("viewBox").split()[2:])
    boxes = [[float(r.get(k)) for k in ("x", "y", "width", "height")] for r in drawing.iter("rect")]
    assert all(x >= 0 and y >= 0 and x + w <= width and y + h <= height for x, y, w, h in boxes)
    for k, (x, y, w, h) in enumerate(boxes):
        assert all(x + w <= u or u + p <= x or y + h <= v or v + q <= y for u, v, p, q in boxes[:k])


def test_nodes_outside_are_marked():
    experiment = make_scenario({"plant": "plant", "source": "source", "gain": {"executable": "gain", "external": True}})
    drawing = draw_diagram(wiring_of(rig_of(experiment)))
    styles = {g.get("data-node"): g.get("class") for g in drawing.iter("g") if g.get("data-node")}
    assert styles == {"plant": "node plant", "source": "node", "gain": "node outside"}
    assert b"outside" in tostring(drawing)


# sources ----------------------------------------------------------------------------------------------------------


def test_every_system_cites_papers_that_can_be_copied():
    keys = {key for name in list_scenarios() for key in load_scenario(name).cites}
    assert len(keys) >= 14
    for citation in cited(sorted(keys)):
        (entry,) = bibtexparser.parse_string(citation.bibtex).entries
        assert entry.key == citation.key
        assert entry.fields_dict["year"].value == citation.year
        assert all(citation.authors)
        assert citation.doi == (entry.fields_dict["doi"].value if "doi" in entry.fields_dict else "")
    assert cited(["maarif2021"])[0].authors == ("A. Ma'arif", "A. Çakan")


def test_scenarios_of_a_user_cite_from_their_own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    bib = tmp_path / "references.bib"
    bib.write_text("@book{me, author = {Doe, Jane and van Dyk, Jan}, title = {{PID} loops}, year = {1999}}")
    (result,) = cited(["me"])
    assert (result.authors, result.title, result.doi) == (("J. Doe", "J. van Dyk"), "PID loops", "")
    with pytest.raises(ScenarioError, match=r"cites: no entry 'mee' .* \(did you mean 'me'\?\)"):
        cited(["mee"])
    bib.write_text("@book{me, title = {PID loops}, year = {1999}}")
    with pytest.raises(ScenarioError, match=r"references.bib: me: no author"):
        cited(["me"])
    bib.write_text("@book{me, title = {PID loops\n}\n@book{b, year = {1}}")
    with pytest.raises(ScenarioError, match=r"references.bib: line 1"):
        cited(["me"])


@pytest.mark.parametrize(
    ("fields", "place"),
    [
        ("journal = {Automatica}, volume = {2}, number = {6}, pages = {582--587}", "Automatica 2(6), 582–587"),
        ("journal = {Automatica}, volume = {2}, booktitle = {Talks}, publisher = {Press \\& Co}", "Automatica 2"),
        ("booktitle = {{ACM} SIGCOMM}, pages = {1--9}, publisher = {Press \\& Co}", "ACM SIGCOMM, 1–9"),
        ("publisher = {Press \\& Co}", "Press & Co"),
        ("pages = {7}", "7"),
        ("note = {Unpublished}", ""),
    ],
)
def test_a_paper_is_listed_with_its_journal_else_its_book_else_its_publisher(tmp_path, monkeypatch, fields, place):
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    entry = "@misc{me, author = {Doe, Jane}, title = {PID loops}, year = {1999}, "
    (tmp_path / "references.bib").write_text(f"{entry}{fields}}}")
    assert cited(["me"])[0].place == place


# several runs -----------------------------------------------------------------------------------------------------


def run_of(**keys):
    about = {"scenario": "lag", "title": "Lag", "system": "lag", "source": "", "mode": "inprocess", "seed": 0,
             "duration_s": 1.0, "ticks": 1, "wall_s": 0.1, "command": "", "metrics": (), "versions": {"machine": "x86"},
             "code": {"my_laws": "aaa"}, "parameters": {"gain": {"k": 1.0}},
             "wiring": {"nodes": {"gain": {"executable": "my_laws/gain", "period": 0.1}}}}  # fmt: skip
    return RunRecord.read(about | keys)


@pytest.mark.parametrize(
    ("folders", "labels", "labels_of_user", "result"),
    [
        (["runs/a", "runs/b"], ["", ""], [], ["a", "b"]),
        (["x/run", "y/run"], ["", ""], [], ["x/run", "y/run"]),
        (["a", "b"], ["my PI", ""], [], ["my PI", "b"]),
        (["a", "b"], ["my PI", "my PI"], [], ["my PI (a)", "my PI (b)"]),
        (["a", "b"], ["my PI", "other"], ["first"], ["first", "other"]),
        (["a", "a"], ["", ""], [], ["a [1]", "a [2]"]),
    ],
)
def test_runs_are_named_by_folder_or_label(folders, labels, labels_of_user, result):
    runs = [(Path(f), run_of(label=text)) for f, text in zip(folders, labels, strict=True)]
    assert names(runs, labels_of_user) == result


@pytest.mark.parametrize(
    ("changes", "banded"),
    [
        ([{"seed": 0}, {"seed": 1}, {"seed": 2}], True),
        ([{"seed": 0}] * 3, False),  # identical runs are not draws
        ([{"seed": s, "code": {"my_laws": f"{s}"}} for s in range(3)], False),
        ([{"seed": s, "parameters": {"gain": {"k": s}}} for s in range(3)], False),
        ([{"seed": s, "versions": {"machine": "arm" if s else "x86"}} for s in range(3)], False),
        ([{"seed": 0}, {"seed": 1}, {"seed": 2, "error": "gone"}], False),
        ([{"seed": 0}, {"seed": 1}, {"seed": 2, "stopped": "stopped by SIGINT"}], False),
        ([{"seed": s, "duration_s": 1.0 + s} for s in range(3)], False),
        ([{"seed": s, "code": {}} for s in range(3)], False),  # runs of a version that did not record its code
        (
            [
                {"seed": s, "wiring": {"nodes": {"gain": {"executable": "a/b", "period": 1.0, "outside": True}}}}
                for s in range(3)
            ],
            False,
        ),
    ],
)
def test_a_band_is_of_seeds_of_the_same_code_and_parameters_that_ended(changes, banded):
    named = ["lag-seed_0", "lag-seed_1", "lag-seed_2", "other"]
    runs = [run_of(**change) for change in changes] + [run_of(scenario="other")]
    assert groups(runs, named) == (["lag"] * 3 + ["other"] if banded else named)


def test_differences_between_runs_are_reported():
    runs = [run_of(), run_of(code={"my_laws": "bbb"}, parameters={"gain": {"k": 2.0}}, seed=7)]
    results = {"seed": ["0", "7"], "code of my_laws": ["aaa", "bbb"], "gain.k": ["1.0", "2.0"]}
    assert differing(runs) == (results, {})
    text = "".join(t for element in differences(runs, ["a", "b"]) for t in element.itertext())
    assert "code of my_lawsaaa in abbb in b" in text
    (_, nothing) = differences([run_of(), run_of()], ["a", "b"])
    assert "equal code" in nothing.text


def test_changes_by_a_person_come_first_and_the_rest_is_folded_without_escapes():
    limits = [{"gain": {"k": k, "figures": json.dumps({"a": [{"end": k}], "b": 1})}} for k in (1.0, 2.0)]
    runs = [run_of(parameters=limits[0]), run_of(parameters=limits[1], changed=("load=2", "seed 7"), seed=7)]
    changed, follows = differing(runs)
    assert changed == {"seed": ["0", "7"], "load": ["as in the scenario", "2"]}
    assert follows == {"gain.k": ["1.0", "2.0"], "gain.figures.a[0].end": ["1.0", "2.0"]}
    _, table, folded = differences(runs, ["a", "b"])
    assert "gain" not in "".join(table.itertext())
    assert folded.tag == "details"
    assert "2 parameters that differ because of it" in "".join(folded.itertext())
    by_name = [run_of(parameters=limits[0]), run_of(parameters=limits[1], changed=("gain.k=2",))]
    assert differing(by_name)[0] == {"gain.k": ["1.0", "2.0"]}


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (
            "/home/me/softrig/scripts/softrig --workspace /home/me/ws run pump --mode inprocess --out /home/me/x",
            "softrig run pump --mode inprocess",
        ),
        (
            "softrig run /home/me/softrig/config/scenarios/dc_motor_smc_b2.yaml --set a.b=/x",
            "softrig run dc_motor_smc_b2 --set a.b=/x",
        ),
        (
            "softrig run '/home/me/my rigs/pump.yaml' --params-file /home/me/p.yaml",
            "softrig run pump.yaml --params-file p.yaml",
        ),
        ("softrig run 'unbalanced", "softrig run 'unbalanced"),
    ],
)
def test_a_printed_command_names_no_folder_of_its_author(command, text):
    assert for_reader(command) == text


def test_versions_of_code_are_distinguished_by_files_and_their_imports(tmp_path, monkeypatch):
    law = "import softrig_a_helper\nfrom softrig_core.block.block import Block\nclass Law(Block):\n    pass\n"
    for name, text in (("softrig_a_law", law), ("softrig_a_helper", "K = 1\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    for function in ("_folder", "_package", "_is_own"):
        # The cache would hide the change; a new process has none.
        monkeypatch.setattr(code, function, getattr(code, function).__wrapped__)
    law = importlib.import_module("softrig_a_law").Law
    before = code.fingerprints([law])
    assert list(before) == ["softrig_a_helper", "softrig_a_law", "softrig_core"]
    (tmp_path / "softrig_a_helper" / "__init__.py").write_text("K = 2\n")
    after = code.fingerprints([law])
    assert {name for name in before if before[name] != after[name]} == {"softrig_a_helper"}


def test_a_band_is_the_quantiles_of_its_draws():
    t = np.linspace(0.0, 1.0, 11)
    middle = band([Curve(str(k), "", t, t * k) for k in range(11)])
    assert [y[-1] for y in middle[1:]] == pytest.approx([1.0, 5.0, 9.0])
    held = band([Curve("", "", np.array([0.0, 0.5, 1.0]), np.array([k, 2.0 * k, 2.0 * k]), True) for k in range(3)])
    assert held[2][:490] == pytest.approx(1.0)
    assert held[2][510:] == pytest.approx(2.0)


def overlay(label, group, offset=0.0, end=1.0, window=None, peak=0.0):
    t = np.linspace(0.0, end, 101)
    entry = PlotEntry(title="Position", signals={"x/position": "position", "r/position": "reference"}, window=window)
    shown = {
        "x/position": Shown(unit="m", held=False, reference=False),
        "r/position": Shown(unit="m", held=True, reference=True),
    }
    return Overlay(
        label,
        group,
        [entry],
        shown,
        {"x/position": (t, t + offset + peak * (t > 0.9 * end)), "r/position": (t, 0.0 * t + 0.5)},
    )


def test_runs_overlay_with_bands_over_seeds():
    runs = [overlay(f"seed {k}", "draws", 0.1 * k) for k in range(5)] + [overlay("own", "own", 1.0)]
    ((title, text),) = draw_overlay(runs)
    assert (title, text[:4]) == ("Position", "<svg")
    ((_, figure),) = overlay_figures(runs)
    (ax,) = figure.axes
    own, median, reference = (
        next(line for line in ax.lines if line.get_label().startswith(n))
        for n in ("own", "draws: median of 5 seeds", "reference")
    )
    assert len(ax.lines) == 3
    assert median.get_ydata()[0] == pytest.approx(0.2)
    assert own.get_ydata()[0] == pytest.approx(1.0)
    assert reference.get_linestyle() == "--"
    (area,) = ax.collections
    assert area.get_paths()[0].get_extents().y0 == pytest.approx(0.4 * BAND[0])
    assert ax.get_ylabel() == "Position, m"


def test_overlaid_pictures_are_as_expected():
    """A band of five with a single run; two groups too small for one; more runs than can be named; a window."""
    cases = [
        [overlay(f"seed {k}", "draws", 0.1 * k) for k in range(5)] + [overlay("own", "own", 1.0, end=2.0)],
        [overlay(f"seed {k}", "ab"[k % 2], 0.1 * k, window=(0.02, 0.09), end=0.09) for k in range(4)],
        [overlay(f"run {k}", f"run {k}", 0.1 * k, peak=1.0) for k in range(12)],
    ]
    titles = [title for runs in cases for title, _ in draw_overlay(runs, ", again")]
    figures = [figure for runs in cases for _, figure in overlay_figures(runs)]
    reported = (line for title, f in zip(titles, figures, strict=True) for line in (title, *figure_lines(f)))
    check_expected("pictures/overlay", reported)


def test_signals_that_only_one_run_has_are_not_overlaid():
    assert list(draw_overlay([overlay("a", "a")])) == []
    assert (
        list(draw_overlay([overlay("a", "a", window=(0.5, 0.6)), overlay("b", "b", end=0.1, window=(0.5, 0.6))])) == []
    )


def test_a_windowed_picture_has_the_range_of_its_window():
    runs = [overlay(name, name, 0.01 * k, window=(0.4, 0.5), peak=50.0) for k, name in enumerate("ab")]
    ((_, figure),) = overlay_figures(runs)
    (ax,) = figure.axes
    assert ax.get_xlim() == (0.4, 0.5)
    low, high = ax.get_ylim()
    assert 0.3 < low < 0.41
    assert 0.5 < high < 0.6


@pytest.mark.parametrize(("held", "values"), [(True, [1.0, 2.0, 2.0]), (False, [1.5, 2.0, 3.0])])
def test_a_curve_is_cut_at_the_edges_of_its_window(held, values):
    t = np.array([0.0, 1.0, 2.0, 3.0])
    result = inside(Curve("", "V", t, t + 1.0, held), (0.5, 2.0))
    assert (list(result.x), list(result.y)) == ([0.5, 1.0, 2.0], values)


def test_runs_of_very_different_length_do_not_share_an_axis(tmp_path):
    one = tmp_path / "one.yaml"
    keys = {"title", "system", "source", "duration", "nodes", "plots"}
    one.write_text(scenario().model_dump_json(include=keys))
    for name, seconds in (("a", "1"), ("b", "1"), ("c", "0.02"), ("d", "0.02"), ("e", "0.1")):
        assert main(["run", str(one), "--mode", "inprocess", "--duration", seconds, "--no-plots",
                     "--out", str(tmp_path / name)]) == 0  # fmt: skip
    page = b"".join(tostring(e) for e in overlaid([(tmp_path / n, read_run(tmp_path / n)) for n in "abcde"], "abcde"))
    assert re.findall(r">Position(, [^<]*)</title>", page.decode()) == [", runs of up to 1 s", ", runs of up to 0.02 s"]
    assert b"no other run of about their length has their plots: e" in page


def test_pictures_of_several_systems_are_grouped_by_system(tmp_path, monkeypatch):
    def drawn(overlays, title):
        yield " and ".join(o.label for o in overlays) + title, b"\x89PNG"

    monkeypatch.setattr("softrig_bringup.plots.overlay.draw_overlay", drawn)
    monkeypatch.setattr("softrig_bringup.report.several.picture", lambda data, title: title)
    monkeypatch.setattr("softrig_bringup.report.several._signals", lambda d, run: None if d.name == "e" else {})
    systems = {"a": "lag", "b": "motor", "c": "lag", "d": "motor", "e": "motor"}
    runs = [(tmp_path / name, run_of(system=system)) for name, system in systems.items()]
    messages = ["".join(element.itertext()) for element in overlaid(runs, [*systems])]
    assert messages == [
        *("lag: signals", "a and c"),
        *("motor: signals", "b and d", "Not drawn here, for want of a bag: e"),
    ]


def test_many_figures_of_few_runs_are_written_one_a_row():
    metrics = [Result(name=f"f{k}", value=k, passed=True) for k in range(12)]
    cells = {}
    for count in (2, 9):
        element = list(side_by_side([run_of(metrics=metrics)] * count, [f"run {k}" for k in range(count)]))[1:]
        cells[count] = [len(t.find(".//thead/tr")) for t in element]
    assert cells == {2: [3], 9: [9, 5]}


@pytest.mark.long
def test_the_report_of_several_runs_overlays_their_bags(tmp_path):
    runs = [str(tmp_path / "a"), str(tmp_path / "b")]
    (plot,) = (p for p in load_scenario("dc_motor_smc_c1").plots if p.title == "Armature voltage and current")
    (tmp_path / "one.yaml").write_text(
        f"title: One picture\nextends: dc_motor_smc_c1\nplots: [{plot.model_dump_json(exclude_defaults=True)}]\n"
    )
    for r, out, more in (("0.5", runs[0], ["--format", "pdf"]), ("0.6", runs[1], ["--no-plots"])):
        assert main(["run", str(tmp_path / "one.yaml"), "--mode", "inprocess", "--duration", "0.5", "--set",
                     f"dc_motor_plant.R={r}", "--out", out, *more]) == 0  # fmt: skip
    assert len(list((tmp_path / "a").glob("*.pdf"))) == len(list((tmp_path / "a").glob("*.svg"))) == 2
    assert main(["report", *runs, "--out", str(tmp_path / "both.html")]) == 0
    page = (tmp_path / "both.html").read_text()
    assert "dc_motor: signals" in page
    assert page.index("dc_motor: signals") < page.index(">Armature voltage and current</title>")
    assert '<a href="#run-2">b</a>' in page
    assert "<td>one, dc_motor_plant.R=0.6, duration 0.5</td>" in re.sub(" data-label=.*?>", ">", page)
    assert 'href="https://doi.org/10.18196/jrc.26140"' in page
    assert "differs" in page
    assert "✗" not in page  # a changed run is compared, not judged
    assert "@article{maarif2021," in page
    assert page.count('class="diagram"') == 2
    assert page.count('class="plot"') == 5  # one picture overlays both runs, and each run has two of its own
    assert "<style>@media" not in page  # the style occurs once, in the head of the page


def test_intervals_in_which_a_requirement_does_not_hold_are_shaded():
    rig = rig_of(
        make_scenario(
            {"plant": "plant", "source": "source", "gain": "gain"},
            1.0,
            shared={"state": "lag/state/x/position"},
            requirements={"low": "always[0.2, 0.8] state <= 0.3"},
        )
    )
    run = simulate(rig)
    (mark,) = marks_of(rig, run.signals)["lag/state/x/position"]
    (low,) = [r for r in run.results if r.name == "low"]
    assert (mark.axis, mark.start, mark.end) == ("violated", *low.violated_s[0])
    assert low.violated_s[0][0] <= low.at_s <= low.violated_s[0][1]
    # Requirements that are already judged are not judged again.
    known = replace(low, violated_s=((0.25, 0.5),))
    (mark,) = marks_of(rig, run.signals, [known])["lag/state/x/position"]
    assert (mark.start, mark.end) == (0.25, 0.5)


def test_the_lower_of_two_wires_of_a_node_turns_first():
    """So that the stub of the upper one is above its lane and does not cross it."""
    wires = [Wire(topic=topic, type="T", source="plant", readers=("law",)) for topic in ("upper", "lower")]
    assert _lanes(wires, {"plant": 0, "law": 1}, 0) == ["lower out", "upper out"]


@pytest.mark.parametrize(("number", "steps"), [(1000, "steps-post"), (100_000, "default")])
def test_a_long_curve_of_steps_is_drawn_by_its_extremes(number, steps):
    """Steps between the extremes of a pixel column would be drawn where no sample is."""
    x = np.linspace(0.0, 1.0, number)
    figure = Figure()
    draw_curves(figure.subplots(), [Curve("u", "", x, np.sin(50.0 * x), held=True)], 1.0)
    assert figure.axes[0].lines[0].get_drawstyle() == steps


@pytest.mark.parametrize(("each", "steps"), [(8, "default"), (9, "steps-post")])
def test_a_signal_of_few_values_is_drawn_as_steps(each, steps):
    y = np.repeat(np.arange(8.0), each)
    figure = Figure()
    draw_curves(figure.subplots(), [Curve("n", "", np.arange(len(y)) + 0.0, y)], 1.0)
    assert figure.axes[0].lines[0].get_drawstyle() == steps


def test_switches_are_stacked_with_the_first_on_top():
    figure = Figure()
    draw_logic(figure.subplots(), [Curve(n, "", np.arange(3.0), np.array([0.0, 1.0, 1.0])) for n in "ab"], 1.0)
    (axes,) = figure.axes
    assert [(t.get_text(), place) for t, place in zip(axes.get_yticklabels(), axes.get_yticks(), strict=True)] == [
        ("a", 1.9),
        ("b", 0.5),
    ]
    assert [line.get_ydata().tolist() for line in axes.lines] == [[1.4, 2.4, 2.4], [0.0, 1.0, 1.0]]
    assert {line.get_drawstyle() for line in axes.lines} == {"steps-post"}
