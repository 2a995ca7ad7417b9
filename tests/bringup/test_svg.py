"""Pictures of pages as SVG: ticks as in matplotlib, curves with all of their extremes, descriptions."""

import math
import re
import xml.etree.ElementTree as ET
from itertools import pairwise

import numpy as np
import pytest
from expected_text import check_expected, on_paper
from hypothesis import assume, given, settings, strategies as st
from matplotlib import colormaps, get_data_path, rc_context
from matplotlib.colors import to_hex
from matplotlib.figure import Figure as Printed
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from PIL import ImageFont
from softrig_bringup.page.html import page, picture
from softrig_bringup.plots.axes import draw, draw_marks, legend
from softrig_bringup.plots.canvas import Axes, Axis, Figure
from softrig_bringup.plots.curves import Curve
from softrig_bringup.plots.marks import Mark
from softrig_bringup.plots.pictures import _overview, plot_entry, plot_run
from softrig_bringup.plots.printed import printed
from softrig_bringup.plots.shades import shades
from softrig_bringup.plots.style import style
from softrig_bringup.plots.svg import LONG, path, svg, width_of
from softrig_bringup.plots.ticks import power_of, round_ticks, texts, with_power
from softrig_core import rig_of, simulate
from test_pictures import marked

SVG = "{http://www.w3.org/2000/svg}"
whole_numbers = st.integers(-9999, 9999)


def figure(size=(10.0, 3.0)):
    return Figure(size, dpi=110)


def points(form):
    """Points of the data of a path, pieces one after the other."""
    result = []
    for letter, numbers in re.findall(r"([MlhHVvz])([^MlhHVvz]*)", form):
        numbers_read = [float(v) for v in re.findall(r"-?[\d.]+", numbers)]
        if letter == "M":
            result.append([tuple(numbers_read[:2])])
        elif letter == "l":
            for dx, dy in zip(numbers_read[::2], numbers_read[1::2], strict=True):
                result[-1].append((result[-1][-1][0] + dx, result[-1][-1][1] + dy))
    return result


# ticks: by matplotlib ---------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:The orderOfMagnitude attribute")  # matplotlib warns of its own deprecated attribute
@settings(max_examples=60)
@given(whole_numbers, whole_numbers, st.integers(-8, 6), st.integers(1, 9), st.booleans())
def test_ticks_and_their_texts_are_those_of_matplotlib(a, b, power, most, whole):
    assume(a != b)
    low, high = min(a, b) * 10.0**power, max(a, b) * 10.0**power
    assume(not whole or high - low >= 2)
    of_matplotlib = [t for t in MaxNLocator(most, steps=[1, 2, 2.5, 5, 10], integer=whole).tick_values(low, high)
              if low - 1e-9 * (high - low) <= t <= high + 1e-9 * (high - low)]  # fmt: skip
    drawn_here = round_ticks(low, high, most, whole)
    assert drawn_here == pytest.approx(of_matplotlib, abs=1e-9 * (high - low))
    if len(drawn_here) < 2 or whole:
        return
    with rc_context(style()):
        numbers = ScalarFormatter()
        numbers.create_dummy_axis()
        numbers.axis.set_view_interval(low, high)
        numbers.set_locs(drawn_here)
        messages = [re.sub("^\N{MINUS SIGN}(?=0\\.?0*$)", "", numbers(t)) for t in drawn_here]
    assert power_of(drawn_here) == numbers.orderOfMagnitude
    assert texts(drawn_here, power_of(drawn_here), (low, high)) == messages


def test_one_tick_has_the_digits_of_its_limits_and_none_has_none():
    assert texts([0.5], 0, (0.2, 0.9)) == ["0.5"]
    assert texts([], 0, (0.0, 1.0)) == []
    assert (power_of([0.0]), power_of([])) == (0, 0)


@pytest.mark.parametrize(
    ("title", "power", "unit", "result"),
    [("Cost, $/h", 7, False, "Cost, 10⁷ $/h"), ("Cost", -4, False, "Cost, 10⁻⁴"), ("V", 12, True, "10¹² V"),
     ("", 7, False, "10⁷"), ("a, b, V", 5, False, "a, b, 10⁵ V"), ("V", 0, True, "V")],
)  # fmt: skip
def test_a_factor_is_written_before_the_unit(title, power, unit, result):
    assert with_power(title, power, unit) == result


@pytest.mark.parametrize("name", ["cividis", "viridis"])
def test_shades_are_those_of_matplotlib(name):
    shares = np.linspace(0.0, 1.0, 201)
    of_matplotlib = colormaps[name](shares)[:, :3] * 255
    drawn_here = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in shades(name, shares)])
    assert np.abs(drawn_here - of_matplotlib).max() < 8
    assert [shades(name, [k / 20])[0] for k in range(21)] == [to_hex(c) for c in colormaps[name](np.arange(21) / 20)]
    assert shades(name, [math.nan, -1.0, 2.0]) == ["", *(to_hex(colormaps[name](v)) for v in (0.0, 1.0))]


def test_no_letter_is_wider_than_assumed():
    font = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", 1000)
    for letter in map(chr, range(32, 127)):
        assert -10 < 1000 * width_of(letter, 1.0) - font.getlength(letter) < 130, letter
    assert width_of("ab\nabcd\n", 10.0) == width_of("abcd", 10.0)
    assert width_of("", 10.0) == 0.0


# curves -----------------------------------------------------------------------------------------------------------


@given(
    st.lists(st.integers(-999, 999), min_size=1, max_size=400), st.booleans(), st.sampled_from([8.0, 20.0, math.inf])
)
def test_a_path_has_the_ends_and_extremes_of_its_curve(values, steps, columns):
    x, y = 10.0 * np.arange(len(values)), np.array(values, float)
    (piece,) = points(path(x, y, steps, columns)) if len(values) > 1 else ([(x[0], y[0])],)
    assert piece[0] == (x[0], y[0])
    assert piece[-1] == (x[-1], y[-1])
    assert (min(v for _, v in piece), max(v for _, v in piece)) == (y.min(), y.max())
    assert all(b[0] >= a[0] for a, b in pairwise(piece))
    if columns == math.inf and not steps:  # omitted points lie on the drawn line
        at, level = zip(*piece, strict=True)
        assert np.interp(x, at, level) == pytest.approx(y)
    if steps and columns == math.inf:  # each value is held until the next
        assert all(a[0] == b[0] or a[1] == b[1] for a, b in pairwise(piece))
    assert len(piece) <= 2 * (4 * columns + 4 if columns < math.inf else len(values))


def test_a_path_has_a_gap_for_missing_values_and_leaves_out_points_on_a_level():
    x, y = np.arange(8.0), np.array([1.0, 1.0, 1.0, math.nan, 5.0, 7.0, math.inf, 2.0])
    assert path(x, y, False, 100.0) == "M0 1l2 0M4 5l1 2M7 2h0"
    assert path(x[:0], y[:0], False, 100.0) == ""
    # Coordinates are limited so that numbers stay short.
    assert path(np.array([0.0, 3.0]), np.array([0.0, 1e9]), False, 100.0) == "M0 0l3 1000000"


def test_a_trajectory_that_returns_is_drawn_once():
    turn = np.linspace(0.0, 2.0 * np.pi, 3001)[:-1]
    one = 5000 + np.round(4000 * np.array([np.cos(turn), np.sin(turn)]))
    many = np.tile(one, 10)
    assert many.shape[1] > LONG
    form = path(*many, False, math.inf)
    drawn = {(p, q) for piece in points(form) for p, q in pairwise(piece)}
    pairs = {(tuple(p), tuple(q)) for p, q in pairwise(many.T.tolist()) if p != q}
    assert drawn == pairs
    assert len(form) < 40_000


# the picture ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """SVGs of a run with each kind of mark, by name."""
    folder = tmp_path_factory.mktemp("svg")
    run = simulate(rig_of(marked()))
    return {p.stem: p.read_text() for p in plot_run(run.signals, run.rig, folder)}


def test_pictures_of_a_page_are_as_expected(drawn):
    """One line for each element."""
    lines = (line for text in drawn.values() for line in text.replace("><", ">\n<").splitlines())
    check_expected("pictures/svg", lines)


def test_each_picture_has_a_name_and_a_description_for_screen_readers(drawn):
    ids = []
    for text in drawn.values():
        root = ET.fromstring(text)
        title, about = root[:2]
        assert (title.tag, about.tag, root.get("role")) == (f"{SVG}title", f"{SVG}desc", "img")
        assert root.get("aria-labelledby").split() == [title.get("id"), about.get("id")]
        ids += [title.get("id"), about.get("id")]
    assert len(set(ids)) == len(ids)
    assert "Position, m, over Time, s 0 to 1: position 0 to 0.455, last 0.455; " in drawn["plot_01_all"]
    assert "accepted; limit; published; violated." in drawn["plot_01_all"]


def test_pictures_are_embedded_in_a_page_and_turn_dark_on_screen_but_not_on_paper(drawn):
    text = page("t", [picture(svg_text, "") for svg_text in drawn.values()])
    assert text.count("<svg") >= len(drawn)
    assert "xmlns" not in text
    assert "ns0:" not in text
    assert text.count("<style>") == 1
    dark, light = text.index("prefers-color-scheme: dark"), text.index("@media print")
    assert dark < text.index("img, .plot { filter: invert(0.9)") < light < text.index("img, .plot { filter: none;")
    assert all("@media screen and (prefers-color-scheme:dark){svg.plot{filter:invert" in t for t in drawn.values())


def test_equal_pictures_are_equal_bytes_and_others_have_other_names(drawn, tmp_path):
    run = simulate(rig_of(marked()))
    again = {p.stem: p.read_text() for p in plot_run(run.signals, run.rig, tmp_path)}
    assert again == drawn


def test_no_element_is_outside_the_picture_or_over_another_text(drawn):
    for text in drawn.values():
        root = ET.fromstring(text)
        wide, high = float(root.get("width")), float(root.get("height"))
        boxes = []
        for element in root.findall(f"{SVG}text"):
            size, x, y = (float(element.get(k)) for k in ("font-size", "x", "y"))
            long = width_of(element.text, size)
            before = {None: 0.0, "middle": long / 2, "end": long}[element.get("text-anchor")]
            flat = (x - before, y - 0.8 * size, x - before + long, y + 0.2 * size)
            turned = (x - 0.8 * size, y + before - long, x + 0.2 * size, y + before)
            boxes.append((turned if element.get("transform") else flat, element.text))
        for k, ((a, b, c, d), message) in enumerate(boxes):
            assert -1.0 <= a <= c <= wide + 1.0, message
            assert -1.0 <= b <= d <= high + 1.0, message
            for (e, f, g, h), other in boxes[:k]:
                assert min(c, g) - max(a, e) < 2.0 or min(d, h) - max(b, f) < 2.0, (message, other)


def inner(text):
    """The nested SVG of each axes: its box in the picture, and what is drawn in it."""
    result = []
    for element in ET.fromstring(text).findall(f"{SVG}svg"):
        result.append(([float(element.get(k)) for k in ("x", "y", "width", "height")], list(element)))
    return result


def test_axes_of_a_row_and_of_a_column_have_aligned_edges():
    one = figure((10.0, 6.0))
    grid = one.add_gridspec(2, 2)
    for k, values in enumerate(([0.0, 1e-3], [0.0, 12345.0], [5.0, 6.0], [0.0, 1.0])):
        ax = one.add_subplot(grid[k // 2, k % 2])
        ax.plot([0.0, 1.0], values)
        ax.set_ylabel("Value, V")
    boxes = [box for box, _ in inner(svg(one))]
    assert [b[0] for b in boxes[:2]] == [b[0] for b in boxes[2:]]
    assert len({b[1] for b in boxes[:2]}) == len({b[1] for b in boxes[2:]}) == 1
    assert len({(b[2], b[3]) for b in boxes}) == 1
    assert boxes[0][0] + boxes[0][2] < boxes[1][0]
    assert boxes[0][1] + boxes[0][3] < boxes[2][1]


def test_a_wide_axes_ends_where_those_below_it_end():
    one = figure((10.0, 6.0))
    grid = one.add_gridspec(2, 2)
    for place in (grid[0, :], grid[1, 0], grid[1, 1]):
        one.add_subplot(place).plot([0.0, 1.0], [0.0, 1.0])
    (x, _, wide, _), left, right = (box for box, _ in inner(svg(one)))
    assert (x, x + wide) == pytest.approx((left[0], right[0] + right[2]), abs=0.2)


@pytest.mark.parametrize("values", [(0.0, 1.0), (-3.0, 40.0), (2.0, 2.0), (0.0, 0.0), (math.nan, math.nan)])
def test_limits_are_those_of_matplotlib(values):
    drawn_here, of_matplotlib = figure().subplots(), None
    drawn_here.plot([0.0, 2.0], values)
    with rc_context(style()):
        of_matplotlib = Printed().subplots()
        of_matplotlib.plot([0.0, 2.0], values)
        of_matplotlib.margins(x=0.05)
    drawn_here.margins(x=0.05)
    assert drawn_here.get_xlim() == pytest.approx(of_matplotlib.get_xlim())
    assert drawn_here.get_ylim() == pytest.approx(of_matplotlib.get_ylim())
    assert figure().subplots().get_ylim() == (0.0, 1.0)
    fixed = Axis(0.1)
    fixed.see([0.0, 10.0], (0.0,))
    assert fixed.limits() == (0.0, 11.0)  # sticky edges have no margin


def test_a_curve_is_drawn_at_its_values():
    one = figure()
    ax = one.subplots()
    ax.plot([0.0, 1.0, 2.0], [0.0, 10.0, 5.0], color="#123456")
    ((box, (curve,)),) = inner(svg(one))
    (piece,) = points(curve.get("d"))
    wide, high = 10.0 * box[2], 10.0 * box[3]
    low, top = -0.5, 10.5
    assert piece == [pytest.approx((wide * t / 2.0, high * (top - v) / (top - low)), abs=1.0)
                     for t, v in ((0.0, 0.0), (1.0, 10.0), (2.0, 5.0))]  # fmt: skip
    assert (curve.get("stroke"), curve.get("fill")) == ("#123456", "none")
    assert float(curve.get("stroke-width")) == pytest.approx(1.4 * 110 / 72 * 10, abs=0.1)


def test_both_axes_of_a_plane_with_one_unit_have_the_same_scale():
    one = figure((7.0, 6.4))
    ax = one.subplots()
    ax.plot(np.cos(np.arange(7.0)), 0.1 * np.sin(np.arange(7.0)))
    ax.set_aspect("equal", adjustable="datalim")
    ((box, _),) = inner(svg(one))
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    assert (x1 - x0) / box[2] == pytest.approx((y1 - y0) / box[3], rel=0.01)
    assert x0 <= -0.9899
    assert x1 >= 0.9999


def test_bars_boxes_maps_and_dots_are_those_of_matplotlib():
    """Counts of a histogram, quartiles and whiskers of a box plot, cells of a map: by matplotlib's own numbers."""
    values = [1.0, 2.0, 2.5, 3.0, 3.5, 4.0, 9.0]
    one = figure()
    grid = one.add_gridspec(1, 2)
    left, right = (one.add_subplot(grid[0, k]) for k in (0, 1))
    left.hist(values, bins=[0.0, 2.0, 4.0, 10.0], color="#0072b2")
    right.boxplot([values, []], orientation="horizontal", tick_labels=["a", "b"], flierprops={"markersize": 3})
    of_matplotlib = on_paper(one)
    bars = left.items[0].boxes
    assert bars[:, 3].tolist() == [p.get_height() for p in of_matplotlib.axes[0].patches] == [1.0, 4.0, 2.0]
    assert left.get_ylim()[0] == 0.0  # bars begin at the axis
    box, low, high, *_, middle, beyond = right.lines
    lines = of_matplotlib.axes[1].lines
    assert sorted({*box.x}) == [2.25, 3.75]
    whiskers = [sorted(line.get_xdata()) for line in lines[1:3]]
    assert [low.x.tolist(), high.x.tolist()] == whiskers == [[1.0, 2.25], [3.75, 4.0]]
    assert middle.x.tolist() == [3.0, 3.0]
    assert beyond.x.tolist() == [9.0]
    two = figure()
    ax = two.subplots()
    scale = {"cmap": "viridis", "vmin": 0.0, "vmax": 3.0}
    cells = ax.pcolormesh(np.array([0.0, 1.0, 3.0]), np.array([5.0]), np.array([[0.0, math.nan, 3.0]]),
                          shading="nearest", **scale)  # fmt: skip
    assert cells.boxes.tolist() == [[-0.5, 4.5, 0.5, 5.5], [0.5, 4.5, 2.0, 5.5], [2.0, 4.5, 4.0, 5.5]]
    assert cells.colours == ["#440154", "", "#fde725"]
    two.colorbar(cells, ax=[ax], label="It, s")
    ((_, drawn),) = inner(svg(two))
    assert [r.get("fill") for r in drawn if r.tag == f"{SVG}rect"] == ["#440154", "#fde725"]
    assert "It, s" in svg(two)
    assert len(on_paper(two).axes) == 2
    three = figure()
    dots = three.subplots().scatter(np.array([0.0, 1.0]), np.array([0.0, 1.0]), c=np.array([0.0, 3.0]), s=8, **scale)
    assert svg(three).count("<circle") == len(dots.colours) == 2


def test_marks_at_the_edge_are_not_cut_and_have_their_height_as_a_share():
    one = figure()
    ax = one.subplots()
    ax.plot([0.0, 1.0], [0.0, 1.0])
    ax.plot([1.0], [0.75], "x", color="#b3261e", transform=ax.get_xaxis_transform(), clip_on=False)
    text = svg(one)
    ((box, parts),) = inner(text)
    assert len(parts) == 1
    (cross,) = [p for p in ET.fromstring(text).findall(f"{SVG}path") if p.get("stroke") == "#b3261e"]
    x, y = (float(v) for v in re.match(r"M([\d.]+) ([\d.]+)", cross.get("d")).groups())
    half = 3.0 * 110 / 72
    assert (x + half, y + half) == pytest.approx((box[0] + box[2], box[1] + 0.25 * box[3]), abs=0.2)
    assert ax.get_ylim() == (-0.05, 1.05)  # a share of the height is not a value of the axis


def test_a_legend_is_above_the_axes_with_a_sample_of_each_entry():
    one = figure()
    ax = one.subplots()
    t = np.linspace(0.0, 1.0, 20)
    curves = [Curve(name, "V", t, k * t) for k, name in enumerate(("one", "two & more", "three"))]
    draw(ax, curves, 1.0)
    legend(ax, curves, "", 20, draw_marks(ax, [Mark("value", "a", 0.2, 0.4)], 1.0))
    text = svg(one)
    ((box, _),) = inner(text)
    named = [
        e for e in ET.fromstring(text).findall(f"{SVG}text") if e.text in ("one", "two & more", "three", "accepted")
    ]
    assert [e.text for e in named] == ["one", "two & more", "three", "accepted"]
    assert all(float(e.get("y")) < box[1] for e in named)
    assert text.count('fill="#44aa99"') == 2  # once for the band and once for its sample in the legend
    assert "two &amp; more" in text


def test_an_empty_picture_states_what_is_missing():
    one = figure()
    one.column(1)[0].set_axis_off()
    one.supxlabel("nothing published: a < b")
    text = svg(one)
    assert "nothing published: a &lt; b" in text
    assert ET.fromstring(text).findall(f"{SVG}svg") == []


def test_a_picture_is_drawn_again_for_print_with_all_of_its_calls():
    run = simulate(rig_of(marked()))
    entry = run.rig.scenario.plots[0]
    from softrig_bringup.plots.curves import Source

    assert len(plot_entry(run.signals, run.rig, entry).axes) == 2
    own = _overview(Source(run.signals, run.rig))
    of_matplotlib = printed(own)
    assert [len(a.lines) for a in own.axes] == [len(a.lines) for a in of_matplotlib.axes]
    assert {line.get_linewidth() for a in of_matplotlib.axes for line in a.lines} == {1.0}
    assert isinstance(own.axes[0], Axes)
