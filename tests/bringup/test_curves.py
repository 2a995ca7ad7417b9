"""What a picture shows of a signal, computed independently: its envelope, its window, marks of expectations, axes and
legends.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from expected_text import check_expected, figure_lines, on_paper
from matplotlib import rc_context
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from softrig_bringup.plots import marks as marks_module, pictures, style as look
from softrig_bringup.plots.axes import draw, draw_marks, fold_exponents, is_logic, legend, styles
from softrig_bringup.plots.curves import Curve, Source, by_unit, envelope, inside
from softrig_bringup.plots.marks import Mark, marks_of
from softrig_bringup.plots.named import Shown, plot_name
from softrig_bringup.plots.overlay import Overlay, _linear, _shared, band
from softrig_bringup.plots.pictures import time_scale
from softrig_core import rig_of
from softrig_core.judge import measures
from softrig_core.judge.expectation import Expectation
from softrig_core.scenario.plot_entry import PlotEntry
from softrig_core.verdict.figures import Figure as Measured
from softrig_core.verdict.requirements import Judge

X = "lag/state/x/position"
COLUMNS = 7


def curve(y, *, label="", unit="V", x=None, **more):
    return Curve(label, unit, np.arange(len(y)) / 10.0 if x is None else np.array(x, float), np.array(y, float), **more)


# curves ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 27, 28, 29, 200])
def test_a_long_signal_is_reduced_to_its_extremes_column_by_column(count):
    """Each pixel column shows first, last, lowest and highest value; gaps do not count."""
    rng = np.random.default_rng(count)
    x, y = np.cumsum(rng.random(count)), rng.standard_normal(count)
    y[rng.random(count) < 0.1] = np.nan
    found_x, found_y = envelope(x, y, COLUMNS)
    if count <= 4 * COLUMNS:
        assert (found_x is x, found_y is y) == (True, True)
        return
    columns = {}
    for a, b in zip(x, y, strict=True):
        columns.setdefault(math.floor((a - x[0]) * COLUMNS / (x[-1] - x[0])), []).append((a, b))
    wanted = []
    for those in columns.values():
        middle, values = (those[0][0] + those[-1][0]) / 2.0, [b for _, b in those if not math.isnan(b)] or [math.nan]
        wanted += [those[0], (middle, min(values)), (middle, max(values)), those[-1]]
    np.testing.assert_allclose(np.array([found_x, found_y]).T, wanted, rtol=1e-12)
    assert len(found_x) <= 4 * COLUMNS + 4


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize(
    "window", [(0.0, 0.4), (0.05, 0.25), (0.1, 0.3), (-1.0, 0.15), (0.3, 9.0), (0.2, 0.2), (0.25, 0.25), (0.4, 0.5)]
)
def test_a_window_has_both_edges_and_no_value_from_outside(held, window):
    whole = curve([5.0, 1.0, 4.0, 2.0, 3.0], held=held)
    result = inside(whole, window)
    first, last = max(window[0], 0.0), min(window[1], 0.4)

    def at(t, before=False):
        """The newest value, or the linear interpolation between two samples; just before a step at `t`."""
        if held:
            return [y for x, y in zip(whole.x, whole.y, strict=True) if x < t or (x <= t and not before)][-1]
        k = min(int(t * 10 + 1e-9), 3)
        return whole.y[k] + (whole.y[k + 1] - whole.y[k]) * (t - whole.x[k]) * 10.0

    between = [(x, y) for x, y in zip(whole.x, whole.y, strict=True) if first < x < last]
    wanted = [(first, at(first)), *between, (last, at(last, before=held and first < last < 0.4))]
    assert list(zip(result.x, result.y, strict=True)) == [pytest.approx(w) for w in wanted]
    assert (result.held, result.unit) == (held, "V")


def test_a_window_outside_the_curve_shows_nothing_of_it():
    whole = curve([5.0, 1.0, 4.0])
    assert [len(inside(whole, w).x) for w in ((0.21, 0.5), (-1.0, -0.1))] == [0, 0]
    assert inside(whole, None) is whole
    empty = curve([])
    assert inside(empty, (0.0, 1.0)) is empty


@pytest.fixture(scope="module")
def lag():
    from conftest import make_scenario

    return rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}))


def recorded(**topics):
    """Signals of a few messages, by topic: times and values of the only column."""
    tables = {}
    for topic, (label, t, values) in topics.items():
        name = topic.replace("_", "/")
        tables[name] = SimpleNamespace(t=np.array(t, float), columns={label: np.array(values, float)} if len(t) else {})
    return SimpleNamespace(
        table=tables.__getitem__,
        recording=SimpleNamespace(topics={n: SimpleNamespace(number=len(t.t)) for n, t in tables.items()}),
    )


def test_a_held_signal_continues_to_the_end_of_the_run_and_a_measured_one_does_not(lag):
    source = Source(
        recorded(lag_state=("x/position", [0.0, 0.1, 0.2], [1.0, 2.0, 4.0]),
                 lag_command=("u/effort", [0.0, 0.1], [7, 8]), lag_reference=("x/position", [], [])), lag
    )  # fmt: skip
    assert (source.end, source.published, source.silent) == (0.2, ["lag/state", "lag/command"], ["lag/reference"])
    state, command, nothing = (source.curve(n) for n in (X, "lag/command/u/effort", "lag/reference/x/position"))
    assert (state.x.tolist(), state.y.tolist(), state.held) == ([0.0, 0.1, 0.2], [1.0, 2.0, 4.0], False)
    assert (command.x.tolist(), command.y.tolist(), command.held) == ([0.0, 0.1, 0.2], [7.0, 8.0, 8.0], True)
    assert (len(nothing.x), len(nothing.y)) == (0, 0)
    assert (state.label, state.unit, state.signal) == (X, source.units[X], X)
    less = source.difference("lag/command/u/effort", X, "")
    # Without the last point, up to which the line is extended.
    assert (less.x.tolist(), less.y.tolist()) == ([0.0, 0.1], [6.0, 6.0])
    assert (less.label, less.unit) == (f"lag/command/u - {X}", source.units["lag/command/u/effort"])
    late = Source(
        recorded(lag_state=("x/position", [0.15, 0.2], [3.0, 4.0]), lag_command=("u/effort", [0.1, 0.2], [7, 8])), lag
    )
    # no difference before the first sample of the other signal
    assert late.difference("lag/command/u/effort", X).y.tolist() == [4.0]
    entry = PlotEntry(
        title="", signals={X: "reference of x", f"{X} - lag/command/u/effort": "less"}, window=(0.1, 0.15)
    )
    shown = [source.shown(entry, name) for name in entry.signals]
    assert [(c.label, c.reference, c.x.tolist()) for c in shown] == [
        ("reference of x", True, [0.1, 0.15]), ("less", False, [0.1, 0.15]),
    ]  # fmt: skip
    assert source.shown(entry.model_copy(update={"unit": "km"}), X).unit == "km"


@pytest.mark.parametrize(
    ("label", "reference"),
    [("reference", True), ("set point of it", True), ("its reference", True), ("its set point", True),
     ("a reference frame", False), ("preference", False), ("", False)],
)  # fmt: skip
def test_a_label_marks_a_signal_as_a_reference(lag, label, reference):
    result = Source(recorded(lag_state=("x/position", [0.0], [1.0])), lag).curve(X, label)
    assert result.reference == reference


def test_curves_of_a_unit_share_a_row_in_their_order():
    a, b, c = curve([1.0], unit="V"), curve([2.0], unit="A"), curve([3.0], unit="V")
    assert by_unit([a, b, c]) == {"V": [a, c], "A": [b]}


@pytest.mark.parametrize(
    ("last", "result"), [([], (1.0, "s")), ([0.0], (1.0, "s")), ([0.099], (1e3, "ms")), ([0.1], (1.0, "s")),
                        ([0.01, 5.0], (1.0, "s"))]
)  # fmt: skip
def test_a_very_short_run_is_drawn_in_milliseconds(last, result):
    assert time_scale([[curve([1.0], x=[t]), curve([])] for t in last]) == result


@pytest.mark.parametrize("held", [True, False])
def test_a_band_shows_quantiles_at_times_common_to_all_runs(held):
    curves = [Curve("", "", np.array([0.0, 0.5, 1.0 + 0.1 * k]), k * np.array([1.0, 2.0, 3.0]), held) for k in range(5)]
    t, low, middle, high = band(curves)
    assert (t[0], t[-1], len(t)) == (0.0, 1.0, 1000)
    for k in (0, 250, 499, 600, 999):
        values = [
            j * ((1.0 if t[k] < 0.5 else 3.0 if t[k] >= c.x[2] else 2.0) if held else np.interp(t[k], c.x, [1, 2, 3]))
            for j, c in enumerate(curves)
        ]
        assert (low[k], middle[k], high[k]) == pytest.approx(np.quantile(values, [0.1, 0.5, 0.9]))


def test_a_band_reads_only_the_samples_around_its_times():
    draw = np.random.default_rng(1)
    x, times = np.unique(draw.normal(size=50)), draw.normal(size=200)
    curve = Curve("", "", x, draw.normal(size=len(x)))
    for t in (times, times[:3], x, x[:1] - 1.0, x[-1:] + 1.0):
        assert _linear(t, curve).tolist() == np.interp(t, curve.x, curve.y).tolist()


def test_only_signals_that_two_runs_show_in_one_plot_are_overlaid():
    """One run plots x, the other x with r, so they have no plot in common; a third run that plots x has one."""
    t = np.arange(5) / 10.0
    about = Shown(unit="m", held=False, reference=False)

    def run(label, *names):
        entry = PlotEntry(title="It", signals=dict.fromkeys(names, ""))
        return Overlay(label, label, [entry], dict.fromkeys(names, about), dict.fromkeys(names, (t, t)))

    assert _shared([run("a", "x"), run("b", "x", "r")]) == []
    assert [list(e.signals) for e in _shared([run("a", "x"), run("b", "x", "r"), run("c", "x")])] == [["x"]]


@pytest.mark.parametrize(
    ("number", "title", "name"),
    [(1, "Speed, and more: x_1 (V)", "plot_01_speed_and_more_x_1_v.svg"), (12, "__a__", "plot_12_a.svg"),
     (3, "x" * 70, f"plot_03_{'x' * 60}.svg"), (123, "Ωä", "plot_123_.svg")],
)  # fmt: skip
def test_a_picture_is_named_by_its_number_and_title(number, title, name):
    assert plot_name(number, title) == name


# marks -----------------------------------------------------------------------------------------------------------

T = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
CLIMB = np.array([0.0, 1.0, 3.0, 5.0, 4.0])
INF = math.inf


def marked(monkeypatch, function, expected=None, published=None, scale=1.0, values=CLIMB, **arguments):
    """Marks of one figure in a picture of its signal, as (axis, low, high, published, start, end)."""
    figure = Measured("f", function, {"signal": "s"} | arguments, "", scale)
    claims = {} if published is None else {"a claim": SimpleNamespace(figure="f", published=published)}
    expect = {} if expected is None else {"f": Expectation.model_validate(expected)}
    rig = SimpleNamespace(scenario=SimpleNamespace(claims=claims, expect=expect))
    monkeypatch.setattr(marks_module, "figures_of", lambda rig: [figure])
    return [
        (m.axis, m.low, m.high, m.published, m.start, m.end) for m in marks_of(rig, {"s": (T, values)}).get("s", [])
    ]


BETWEEN, MOST, LEAST = {"expected": 2.0, "tolerance": 0.5}, {"at_most": 2.0}, {"at_least": 2.0}


@pytest.mark.parametrize(
    ("function", "expected", "published", "arguments", "result"),
    [
        (measures.mean, BETWEEN, None, {}, [("value", 1.5, 2.5, math.nan, -INF, INF)]),
        (measures.mean, MOST, None, {}, [("value", -INF, 2.0, math.nan, -INF, INF)]),
        (measures.mean, LEAST, 7.0, {"start": 1.0, "end": 3.0}, [("value", 2.0, INF, 7.0, 1.0, 3.0)]),
        (measures.mean, {"expected": 2.0, "tolerance": 0.0}, None, {}, [("value", 2.0, 2.0, math.nan, -INF, INF)]),
        (measures.mean, None, 7.0, {}, [("value", math.nan, math.nan, 7.0, -INF, INF)]),
        (measures.mean, None, None, {}, []),
        (measures.final_value, BETWEEN, None, {"scale": 2.0}, [("value", 0.75, 1.25, math.nan, -INF, INF)]),
        (measures.mean_square, BETWEEN, None, {}, []),  # a mean square has no unit of its signal, so it is not drawn
        # Extremes: a bound is drawn over the whole window, a value beside its instant, 0.06 of the window to either
        # side.
        (measures.maximum, {"expected": 5.0, "tolerance": 0.5}, None, {}, [("value", 4.5, 5.5, math.nan, 2.76, 3.24)]),
        (measures.maximum, None, 2.9, {}, [("value", math.nan, math.nan, 2.9, 1.76, 2.24)]),
        (measures.maximum, MOST, None, {"start": 1.0}, [("value", -INF, 2.0, math.nan, 1.0, INF)]),
        (measures.minimum, {"expected": 1.0, "tolerance": 0.1}, None, {"start": 1.0, "end": 3.0},
         [("value", 0.9, 1.1, math.nan, 1.0, 1.12)]),
        (measures.minimum, {"expected": 4.0, "tolerance": 0.1}, None, {"start": 2.0},
         [("value", 3.9, 4.1, math.nan, 3.88, 4.12)]),
        (measures.peak, {"expected": 5.0, "tolerance": 0.5}, 4.8, {}, [("value", 4.5, 5.5, 4.8, 2.76, 3.24)]),
        (measures.peak, {"expected": 6.0, "tolerance": 0.5}, None, {"reference": 6.0},
         [("value", -0.5, 0.5, math.nan, -0.24, 0.24)]),  # the largest deviation below the reference
        (measures.peak, MOST, None, {"reference": 1.0}, [("value", -INF, 3.0, math.nan, -INF, INF)]),
        (measures.peak, BETWEEN, None, {"reference": "s"}, []),
        # Instants are measured from the beginning of the window or of the rise.
        (measures.reach_time, BETWEEN, 2.2, {"level": 3.0}, [("time", 1.5, 2.5, 2.2, -INF, INF)]),
        (measures.error_settling_time, MOST, None, {"band": 0.1}, [("time", -INF, 2.0, math.nan, -INF, INF)]),
        (measures.settling_time, BETWEEN, 1.0, {}, [("time", 1.5, 2.5, 1.0, -INF, INF)]),
        (measures.settling_time, BETWEEN, 1.0, {"start": 1.0}, [("time", 2.5, 3.5, 2.0, 1.0, INF)]),
        # The first sample above 10 % is 1 V, at 1 s.
        (measures.rise_time, BETWEEN, None, {"final": 5.0}, [("time", 2.5, 3.5, math.nan, -INF, INF)]),
        # 10 % of 10 V is 1 V, which the signal reaches exactly at 1 s.
        (measures.rise_time, BETWEEN, None, {"final": 10.0}, [("time", 2.5, 3.5, math.nan, -INF, INF)]),
        (measures.rise_time, BETWEEN, None, {"low": 0.5}, [("time", 3.5, 4.5, math.nan, -INF, INF)]),
        (measures.rise_time, BETWEEN, None, {"final": 99.0, "low": 0.2}, []),  # the rise never begins
        (measures.overshoot, {"expected": 25.0, "tolerance": 5.0}, 10.0, {}, [("value", 4.8, 5.2, 4.4, -INF, INF)]),
        (measures.overshoot, MOST, None, {"final": 4.0, "initial": 2.0}, [("value", -INF, 4.04, math.nan, -INF, INF)]),
        (measures.mean, BETWEEN, None, {"start": 9.0}, [("value", 1.5, 2.5, math.nan, 9.0, INF)]),
        (measures.maximum, BETWEEN, None, {"start": 9.0}, []),  # the run ended before its window
    ],
)  # fmt: skip
def test_a_figure_is_marked_where_its_signal_shows_it(monkeypatch, function, expected, published, arguments, result):
    scale = arguments.pop("scale", 1.0) if arguments.get("scale") else 1.0
    marks = marked(monkeypatch, function, expected, published, scale, **arguments)
    assert len(marks) == len(result)
    for mark, wanted in zip(marks, result, strict=True):
        assert mark[0] == wanted[0]
        assert mark[1:] == pytest.approx(wanted[1:], nan_ok=True)


def test_a_fall_is_marked_as_a_rise_is(monkeypatch):
    fall = marked(monkeypatch, measures.rise_time, BETWEEN, values=-CLIMB)
    assert fall == [("time", 2.5, 3.5, pytest.approx(math.nan, nan_ok=True), -INF, INF)]
    (down,) = marked(monkeypatch, measures.overshoot, MOST, values=-CLIMB)
    assert down[1:3] == (pytest.approx(-4.08), INF)  # the overshoot of a fall lies below its final value


class Fixed(Judge):
    """A requirement with known intervals in which it does not hold."""

    def margin(self, signals):
        if self.tree == "not judged":
            raise ValueError
        return SimpleNamespace(violated=self.tree)


@pytest.mark.parametrize(
    ("spans", "drawn"),
    [
        ([], []),
        ([(1.0, 2.0)], [(1.0, 2.0)]),
        # A gap below a hundredth of the ten seconds closes.
        ([(0.0, 1.0), (1.099, 2.0), (2.2, 10.0)], [(0.0, 2.0), (2.2, 10.0)]),
        ([(0.0, 1.0), (1.0, 1.5), (1.5, 1.6)], [(0.0, 1.6)]),
        ([(0.0, 0.5), (1.5, 100.0)], [(0.0, 100.0)]),  # the largest gap that is closed: 1 s of 100 s
        ("not judged", []),
    ],
)
def test_violations_are_shaded_in_each_signal_of_the_formula(monkeypatch, spans, drawn):
    judge = object.__new__(Fixed)
    for name, value in {"tree": spans, "signals": {"a": "s", "b": "r"}}.items():
        object.__setattr__(judge, name, value)
    monkeypatch.setattr(marks_module, "figures_of", lambda rig: [SimpleNamespace(name="q", function=judge)])
    result = marks_of(SimpleNamespace(scenario=SimpleNamespace(claims={}, expect={})), {})
    entries = {name: [(m.axis, m.name, m.start, m.end) for m in marks] for name, marks in result.items()}
    assert entries == ({name: [("violated", "q", *span) for span in drawn] for name in "sr"} if drawn else {})


MARKS = {
    "a band in its window": [Mark("value", "a", 0.4, 0.6, start=2.0, end=5.0)],
    "a band cut at the edges": [Mark("value", "a", 0.4, 0.6, start=-2.0, end=50.0)],
    "a band of one instant": [Mark("value", "a", 0.4, 0.6, start=5.0, end=5.0)],
    "a window behind the picture": [Mark("value", "a", 0.4, 0.6, start=11.0, end=12.0)],
    "a level and what is printed": [Mark("value", "a", -INF, 0.7, published=0.2)],
    "one level": [Mark("value", "a", 0.5, 0.5)],
    "half a height away": [Mark("value", "a", -0.5, 1.5, published=1.5)],
    "farther": [Mark("value", "a", -0.51, 1.51, published=1.51)],
    "one end far away": [Mark("value", "a", 0.9, 7.0)],
    "a stretch of time": [Mark("time", "rise_time", 2.0, 4.0, published=3.0)],
    "a bound of time": [Mark("time", "rise_time", -INF, 4.0)],
    "a bound of time outside": [Mark("time", "rise_time", -INF, 10.5, published=-0.1)],
    "times at the edges": [Mark("time", "a", 0.0, 10.0, published=10.0)],
    "an instant": [Mark("time", "a", 4.0, 4.0)],
    "names together": [Mark("time", "a", -INF, 4.0), Mark("time", "b_c", 4.1, INF), Mark("time", "d", 4.25, INF)],
    "four names": [Mark("time", n, -INF, 2.0 * k + 1.0) for k, n in enumerate("abcd")],
    "five times without names": [Mark("time", n, -INF, 2.0 * k + 1.0) for k, n in enumerate("abcde")],
    "violated": [Mark("violated", "a", start=2.0, end=3.0), Mark("violated", "a", start=9.0, end=12.0)],
    "a name at the edge": [Mark("time", "a", -INF, 0.0), Mark("time", "b", -INF, -0.1)],
    "violated up to the edges": [
        Mark("violated", "a", start=-2.0, end=0.0),
        Mark("violated", "a", start=10.0, end=12.0),
    ],
    "violated outside": [Mark("violated", "a", start=-2.0, end=-0.5), Mark("violated", "a", start=10.5, end=12.0)],
}


@pytest.mark.parametrize(("scale", "name"), [(1.0, "marks_each"), (1e3, "marks_in_ms")])
def test_each_kind_of_mark_is_drawn_as_expected(scale, name):
    """In axes of ten by one that begin at 2 and 1."""
    chosen = MARKS if scale == 1.0 else {k: MARKS[k] for k in ("a band in its window", "a stretch of time", "violated")}
    figure = Figure()
    for k, (about, shown) in enumerate(chosen.items()):
        ax = figure.add_axes((0.0, k / len(chosen), 1.0, 0.9 / len(chosen)))
        ax.set_axis_off()
        ax.set(xlim=(2.0, 12.0), ylim=(1.0, 2.0))
        marks = []
        for m in shown:
            plus, by = (2.0, scale) if m.axis == "time" else (1.0, 1.0)
            low, high, published = ((v + plus) / by for v in (m.low, m.high, m.published))
            marks.append(Mark(m.axis, m.name, low, high, published, (m.start + 2.0) / scale, (m.end + 2.0) / scale))
        entries = draw_marks(ax, marks, scale)
        ax.set_title(f"{about}: {', '.join(name for _, name in entries) or 'nothing'}", loc="left")
    check_expected(f"pictures/{name}", (line for line in figure_lines(figure) if not line.strip().startswith("linear")))
    assert not any(t.get_in_layout() for ax in figure.axes for t in ax.texts)  # a long name does not shrink the axes


# axes ------------------------------------------------------------------------------------------------------------


def test_the_curve_with_most_ink_is_below_and_references_are_on_top():
    figure = Figure()
    ax = figure.subplots()
    draw(ax, [curve([0, 1, 0, 1]), curve([0, 1, 1, 1]), curve([0, 9, 0, 9]), curve([1, 1, 1, 1], reference=True)], 1.0)
    orders = [line.get_zorder() for line in ax.lines]
    assert orders == pytest.approx([2.25, 2.5, 2.0, 3.0])
    assert [line.get_linestyle() for line in ax.lines] == ["-", "-", "-", "--"]


def test_a_single_sample_is_a_dot_and_a_constant_is_no_noise():
    figure = Figure()
    one, two, none = figure.subplots(3)
    draw(one, [curve([4.0], label="a")], 1e3)
    assert [(line.get_marker(), line.get_label()) for line in one.lines] == [("o", "a")]
    draw(two, [curve([2.0, 2.0 + 1e-9])], 1e3)
    assert two.lines[0].get_xdata().tolist() == [0.0, 100.0]
    assert two.get_ylim() == pytest.approx((2.0 - 2e-3, 2.0 + 2e-3), abs=1e-6)
    draw(none, [curve([0.0, 1e-13])], 1.0)
    assert none.get_ylim() == pytest.approx((-1e-9, 1e-9), rel=1e-3)


@pytest.mark.parametrize(
    ("rows", "logic"),
    [([[0, 1], [1, 1]], True), ([[0, 1]], False), ([[0, 1], [0, 2]], False), ([[0, 1], []], False),
     ([[0, 1]] * 8, True), ([[0, 1]] * 9, False)],
)  # fmt: skip
def test_several_curves_with_values_0_and_1_are_switches(rows, logic):
    assert is_logic([curve(row) for row in rows]) == logic


def test_curves_are_distinguished_by_colour_then_by_dashes_and_many_by_shade():
    plain, reference = curve([1.0]), curve([1.0], reference=True)
    eight = styles([plain] * 7 + [plain])
    assert [s["color"] for s in eight] == [*look.COLOURS, look.COLOURS[0]]
    assert [s["linestyle"] for s in eight] == ["-"] * 7 + [(0, (5, 3))]
    mixed = styles([reference, plain, reference, plain])
    assert [(s["color"], s["linestyle"], s.get("linewidth"), s.get("zorder")) for s in mixed] == [
        ("#222222", (0, (5, 3)), 1.0, 3.0), ("#0072b2", "-", None, None),
        ("#222222", (0, (1.5, 1.5)), 1.0, 3.0), ("#d55e00", "-", None, None),
    ]  # fmt: skip
    alone = styles([reference, reference])
    assert [(s["color"], s["linestyle"]) for s in alone] == [("#0072b2", (0, (5, 3))), ("#d55e00", (0, (1.5, 1.5)))]
    many = styles([plain] * 9)
    assert {s["linewidth"] for s in many} == {0.8}
    lightness = [sum(to_rgb(s["color"])) for s in many]
    assert lightness == sorted(lightness)  # the colours go from dark to light
    assert [many[k]["color"] for k in (0, 8)] == ["#00224e", "#f3db42"]


def boxed(names, width, title="", marks=()):
    ax = Figure().subplots()
    curves = [curve([1.0, 2.0] if name else [math.nan, math.nan], label=name or "gone") for name in names]
    draw(ax, curves, 1.0)
    legend(ax, curves, title, width, [(ax.lines[0], mark) for mark in marks])
    box = ax.get_legend()
    if box is None:
        return ax.get_title("left") or None
    corner = ax.transAxes.inverted().transform(box.get_bbox_to_anchor().p0)
    assert corner == pytest.approx((0.0, 1.0), abs=1e-9)  # the legend is above the axes and begins at their left edge
    assert (box._loc, {t.get_fontsize() for t in box.get_texts()}, box._alignment) == (3, {9.0}, "left")
    return [t.get_text() for t in box.get_texts()], box._ncols, box.get_title().get_text()


@pytest.mark.parametrize(
    ("names", "width", "more", "result"),
    [
        (["a", "b"], 55, {}, (["a", "b"], 2, "")),
        (["aaaa", "b", "c"], 20, {}, (["aaaa", "b", "c"], 2, "")),  # each name needs six more letters of width
        (["aaaa", "b", "c"], 9, {}, (["aaaa", "b", "c"], 1, "")),
        (["a b c d"], 4, {"title": "it"}, (["a b\nc d"], 1, "it")),
        # Names without a value in this picture are left out.
        (["a", "", "c"], 55, {"marks": ["limit"]}, (["a", "c", "limit"], 3, "")),
        ([""], 55, {}, None),
        (["a"] * 8, 200, {}, (["a"] * 8, 8, "")),
        (["a"] * 9, 200, {}, "9 signals, dark to light from first to last"),
        (["a"] * 9, 200, {"title": "it"}, "it: 9 signals, dark to light from first to last"),
    ],
)
def test_a_legend_lists_visible_curves_in_as_many_columns_as_fit(names, width, more, result):
    assert boxed(names, width, **more) == result


@pytest.mark.parametrize(
    ("largest", "title", "unit", "result"),
    [
        (3e7, "Cost, $/h", False, r"Cost, $\mathregular{10^{7}}$ $/h"), (3e4, "Cost, $/h", False, "Cost, $/h"),
        (3e7, "Cost", False, r"Cost, $\mathregular{10^{7}}$"), (3e7, "V", True, r"$\mathregular{10^{7}}$ V"),
        (3e7, "", False, r"$\mathregular{10^{7}}$"), (3e-5, "a, b, V", False, r"a, b, $\mathregular{10^{-5}}$ V"),
    ],
)  # fmt: skip
def test_a_scale_factor_is_written_before_the_unit(largest, title, unit, result):
    with rc_context(look.style()):
        ax = Figure().subplots()
        ax.plot([0.0, 1.0], [0.0, largest])
        ax.set_ylabel(title, gid="unit" if unit else None)
        fold_exponents(ax.figure)
    assert ax.get_ylabel() == result
    assert not ax.yaxis.get_offset_text().get_visible()


# pictures of a run -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "columns", "rows"), [(0, 1, 1), (1, 1, 1), (3, 1, 3), (4, 2, 2), (5, 2, 3)])
def test_an_overview_has_one_column_up_to_three_panels(monkeypatch, count, columns, rows):
    panels = [(f"t{k}", "V", [curve([0.0, 1.0, 3.0], label="x")]) for k in range(count)]
    monkeypatch.setattr(pictures, "_panels", lambda source: panels)
    figure = on_paper(pictures._overview(SimpleNamespace(silent=["q", "r"] if count else [])))
    assert figure.get_size_inches().tolist() == pytest.approx([10.0, 0.9 + 1.55 * rows])
    assert {ax.get_subplotspec().get_gridspec().get_geometry() for ax in figure.axes} <= {(rows, columns)}
    assert [ax.get_title("left") for ax in figure.axes] == [f"t{k}/x" for k in range(count)]
    bottom = [ax for ax in figure.axes if ax.get_subplotspec().rowspan.stop == rows]
    assert [ax.get_xlabel() for ax in figure.axes] == ["Time, s" if ax in bottom else "" for ax in figure.axes]
    shown = [ax.xaxis.get_tick_params()["labelbottom"] for ax in figure.axes]
    assert shown == [ax in bottom for ax in figure.axes]
    text = "" if figure._supxlabel is None else figure._supxlabel.get_text()
    assert text == ("nothing published on q, r" if count else "")


@pytest.mark.parametrize(
    ("silent", "most", "drawn"),
    [
        ([], None, ["Own", "Outside", "Less", "Both", "overview"]),
        (["o"], None, ["Own", "Both", "overview"]),  # only topics without any internal publisher are left out
        # A silent topic of an internal node is named in its picture.
        (["o", "t"], None, ["Own", "Both", "overview"]),
        (["t"], None, ["Own", "Outside", "Less", "Both", "overview"]),
        (["o"], 1, ["Own"]),
        ([], 3, ["Own", "Outside", "Less"]),
        (["o"], 3, ["Own", "overview"]),  # there are fewer pictures than requested
    ],
)
def test_each_plot_of_a_run_is_drawn_except_signals_that_never_arrived(monkeypatch, tmp_path, silent, most, drawn):
    plots = [PlotEntry(title=title, signals=dict.fromkeys(names, "")) for title, names in (
        ("Own", ["t/x"]), ("Outside", ["o/x"]), ("Less", ["o/x - o/y"]), ("Both", ["o/x - t/x"]))]  # fmt: skip
    members = [SimpleNamespace(external=outside, outputs=[SimpleNamespace(topic=t)]) for t, outside in
               (("t", False), ("o", True))]  # fmt: skip
    rig = SimpleNamespace(scenario=SimpleNamespace(name="run", plots=plots), members=members)
    source = SimpleNamespace(silent=silent, topic=lambda name: name[0])
    saved = []
    for name, what in {
        "check_plots": lambda rig: None, "marks_of": lambda *_: {}, "Source": lambda signals, rig: source,
        "_time_figure": lambda source, entry, marks: entry.title, "_overview": lambda source: "overview",
        "save_figure": lambda figure, path, title, run, also: saved.append((figure, path.name, title, run, also)),
    }.items():  # fmt: skip
        monkeypatch.setattr(pictures, name, what)
    paths = pictures.plot_run(None, rig, tmp_path, "pdf", most)
    assert [figure for figure, *_ in saved] == drawn
    assert [path.name for path in paths] == [name for _, name, *_ in saved]
    numbers = {"Own": 1, "Outside": 2, "Less": 3, "Both": 4}
    assert saved == [
        (t, plot_name(numbers[t], t), t, "run", "pdf") if t in numbers
        else ("overview", "overview.svg", "Every recorded signal", "run", "pdf")
        for t in drawn
    ]  # fmt: skip


def test_panels_state_their_content_once(monkeypatch):
    rows = [
        [curve([0, 1], label="a/position"), curve([1, 0], label="b/position")],
        [curve([0, 2], label="a/position"), curve([1, 3], label="b/position")],
        [curve([0, 2], label="a/position"), curve([1, 3], label="b/velocity")],
        [curve([0, 2], label="x"), curve([1, 3], label="y")],
    ]
    monkeypatch.setattr(pictures, "_panels", lambda source: [("t", "V", row) for row in rows])
    switches, same, other, bare = on_paper(pictures._overview(SimpleNamespace(silent=[]))).axes
    assert switches.get_title("left") == "t/*/position"
    assert [t.get_text() for t in switches.get_yticklabels()] == ["a", "b"]
    messages = [(ax.get_legend().get_title().get_text(), [t.get_text() for t in ax.get_legend().get_texts()])
            for ax in (same, other, bare)]  # fmt: skip
    assert messages == [("t/*/position", ["a", "b"]), ("t", ["a/position", "b/velocity"]), ("t", ["x", "y"])]
    assert [ax.get_ylabel() for ax in (same, other)] == ["V", "V"]


def test_a_legend_of_a_run_has_room_for_110_letters(monkeypatch):
    widths = []
    monkeypatch.setattr(pictures, "legend", lambda ax, curves, title, width, marks: widths.append(width))
    source = SimpleNamespace(shown=lambda entry, name: curve([0.0, 0.5, 3.0], label=name))
    pictures._time_figure(source, PlotEntry(title="It", signals={"a": "", "b": ""}), {})
    pictures._time_figure(source, PlotEntry(title="It", signals={"a": ""}), {})  # a single curve needs no legend
    assert widths == [110]


def test_a_scale_factor_holds_for_all_ticks():
    """The numbers at the axis are those that the title multiplies, also when the layout gives other ticks."""
    with rc_context(look.style()):
        ax = Figure().subplots()
        ax.plot([0.0, 1.0], [0.0, 3e7])
        fold_exponents(ax.figure)
        numbers = ax.yaxis.get_major_formatter()
        for largest in (3e7, 9e3):
            numbers.set_locs([0.0, largest])
            assert numbers.orderOfMagnitude == 7


@pytest.mark.parametrize(
    ("name", "title"),
    [("speed", "Speed"), ("ab", "Ab"), ("abCd", "AbCd"), ("aBcd", "aBcd"), ("q", "q"), ("a_b", "a_b"), ("a.b", "a.b"),
     ("ab/c", "ab/c"), ("", "")],
)  # fmt: skip
def test_a_word_is_capitalised_in_a_title_and_a_name_is_not(name, title):
    assert look.axis_title(name, "") == title


@pytest.mark.parametrize(
    ("labels", "unit", "wanted", "title"),
    [(["a", "b"], "V", "", "Voltage, V"), (["a", "b"], "V", "Own", "Own, V"), (["speed"], "x", "", "Speed, x"),
     (["a", "b"], "x", "", "Value, x"), (["a", "b"], "", "", ""), (["a"], "", "", "a")],
)  # fmt: skip
def test_a_value_axis_is_labelled(labels, unit, wanted, title):
    assert pictures._value_title([curve([1.0], label=name) for name in labels], unit, wanted) == title


def test_the_style_of_pictures_is_as_expected():
    """Settings of matplotlib, and the label of each unit."""
    settings = {k: v if k != "axes.prop_cycle" else v.by_key()["color"] for k, v in look.style().items()}
    units = {unit: look.quantity(unit) for unit in sorted(look._QUANTITIES)}
    check_expected("pictures/style", [f"{k}: {v}" for k, v in (settings | units).items()])
    assert look.quantity("furlong") == ""
