"""What drawings are made of: rotations against scipy, a camera by its axes, selected rows, and precomputed words and
arrows.
"""

import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from softrig_core.drawing.base import Drawing, Quantity, limited, readings, tail
from softrig_core.drawing.projection import Camera, plus, times, turned
from softrig_core.drawing.robot import _limits
from softrig_core.drawing.scope import _newest, plane, scope
from softrig_core.drawing.shapes import Circle, Line, Pen, Polygon, Text, as_dict, polar


@pytest.mark.parametrize("k", range(4))
def test_quaternions_turn_and_follow_each_other_as_those_of_scipy(k):
    rng = np.random.default_rng(k)
    a, b = (Rotation.from_quat(rng.normal(size=4)) for _ in range(2))
    p = rng.normal(size=3)
    first, second = (tuple(r.as_quat().tolist()) for r in (a, b))
    assert turned(first, tuple(p)) == pytest.approx(a.apply(p), abs=1e-12)
    assert turned(times(first, second), tuple(p)) == pytest.approx(a.apply(b.apply(p)), abs=1e-12)
    assert plus((1.0, 2.0, 3.0), (10.0, 20.0, 30.0)) == (11.0, 22.0, 33.0)


def axes(azimuth, elevation):
    """The axes towards the camera, to the right and up, as the camera sees them."""
    ce, se, ca, sa = math.cos(elevation), math.sin(elevation), math.cos(azimuth), math.sin(azimuth)
    towards, right = np.array([ce * ca, ce * sa, se]), np.array([-sa, ca, 0.0])
    return towards, right, np.cross(towards, right)


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (0.7, 0.3), (-2.0, -0.4), (3.0, 1.5)])
def test_a_camera_projects_along_its_axes(azimuth, elevation):
    towards, right, up = axes(azimuth, elevation)
    camera, rng = Camera(azimuth, elevation, 2.0, (10.0, 20.0)), np.random.default_rng(2)
    for p in rng.normal(size=(5, 3)):
        assert camera(tuple(p)) == pytest.approx((10.0 + 2.0 * p @ right, 20.0 - 2.0 * p @ up))
        assert camera.nearness(tuple(p)) == pytest.approx(p @ towards)
    places = [tuple(p) for p in rng.normal(size=(9, 3))]
    fitted = camera.fitted(places, 30.0, 50.0, 400.0, 300.0)
    x, y = np.array([fitted(p) for p in places]).T
    assert (x.min() + x.max(), y.min() + y.max()) == pytest.approx((2 * 230.0, 2 * 200.0))
    assert max(np.ptp(x) / 400.0, np.ptp(y) / 300.0) == pytest.approx(1.0)
    assert (fitted.azimuth, fitted.elevation) == (azimuth, elevation)
    # A single point has no size and is drawn in the middle.
    still = camera.fitted([(1.0, 2.0, 3.0)] * 2, 0.0, 0.0, 8.0, 4.0)
    assert still((1.0, 2.0, 3.0)) == pytest.approx((4.0, 2.0), abs=1e-3)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7, 40])
@pytest.mark.parametrize("points", [2, 3, 6])
def test_rows_of_the_past_are_selected_evenly_up_to_now(count, points):
    rows = [{"k": float(k)} for k in range(count)]
    results = [row["k"] for row in tail(rows[:-1], rows[-1], points)]
    assert len(results) == points
    assert (results[0], results[-1]) == (0.0, count - 1.0)
    assert all(a <= b for a, b in pairwise(results))
    assert all(abs(x - (count - 1) * k / (points - 1)) <= 0.5 for k, x in enumerate(results))
    picked = [row["k"] for row in _newest(rows[:-1], rows[-1], points)]
    if count <= points:  # the first row is repeated for the time before it
        assert picked == [0.0] * (points - count) + [float(k) for k in range(count)]
    else:
        assert all(abs(x - (count - 1) * k / (points - 1)) <= 0.5 for k, x in enumerate(picked))


def test_a_quantity_is_its_value_or_at_rest_and_is_labelled_so():
    volts = Quantity("v", "V", 2.5)
    assert [volts(row) for row in ({"v": 7.0}, {}, {"v": math.nan}, {"v": -math.inf})] == [7.0, 2.5, 2.5, 2.5]
    assert [
        volts.text_of({"v": 1.25}),
        volts.text_of({"v": -3.0}, ".2f"),
        volts.text_of({"v": -0.04}),
        volts.text_of({"v": -0.05 - 1e-9}),
        volts.text_of({"v": -1234.5}, ",.0f", "kV"),
        volts.text_of({}),
        volts.text_of({"v": math.inf}, unit=""),
        Quantity("v").text_of({"v": 0.0}),
    ] == ["1.2 V", "−3.00 V", "0.0 V", "−0.1 V", "−1,234 kV", "– V", "–", "0.0"]
    assert [limited(x, 2.0) for x in (-3.0, -2.0, 0.5, 2.0, 9.0)] == [-2.0, -2.0, 0.5, 2.0, 2.0]


def test_a_quantity_is_found_at_the_plant_then_at_those_linked_to_it_then_elsewhere():
    """By the name of the port or the last part of its topic; another plant's are none."""

    def member(name, *outputs, links=(), plant=False):
        return SimpleNamespace(name=name, outputs=outputs, inputs=(), is_plant=plant, links=dict(enumerate(links)))

    def port(name, topic, *labels):
        return SimpleNamespace(name=name, topic=topic, labels=labels)

    def link(source):
        return SimpleNamespace(source=source)

    far = member("far", port("out", "far/speed", "x"), port("far", "far/only", "x"))
    writes = member("writes", port("out", "writes/speed", "x"))
    reads = member("reads", port("out", "reads/speed", "x"), port("out", "reads/load", "x"))
    other = member("other", port("out", "other/speed", "x"), port("out", "other/mass", "x"), plant=True)
    plant = member("plant", port("state", "plant/state", "x", "y"), links=[link(writes)], plant=True)
    reads.links = {0: link(plant)}
    drawing = object.__new__(Drawing)
    drawing.plant, drawing._names = plant, {}
    units = ["plant/state/x", "plant/state/y", "far/only/x", *(f"{n}/speed/x" for n in ("far", "writes", "reads"))]
    drawing._units = dict.fromkeys([*units, "reads/load/x"], "m/s^2")

    def named(members, name, label="x"):
        drawing.rig = SimpleNamespace(members=members)
        return drawing.quantity(name, label, 3.0)

    assert named([far, other, plant], "state", "y") == Quantity("plant/state/y", "m/s²", 3.0)
    assert named([far, other, reads, plant], "speed").name == "reads/speed/x"
    assert named([far, other, writes, plant], "speed").name == "writes/speed/x"
    assert named([far, writes, reads, plant], "speed").name == "writes/speed/x"
    assert named([other, far, plant], "speed").name == "far/speed/x"
    assert named([far, reads, plant], "out").name == "reads/speed/x"  # a port is known by its own name as well
    assert named([far, reads, plant], "load").name == "reads/load/x"
    assert named([far, other, plant], "mass") == Quantity("", "", 3.0)
    assert named([far, plant], "state", "z") == Quantity("", "", 3.0)
    results = ["plant/state/y", "reads/speed/x", "writes/speed/x", "far/speed/x", "reads/load/x"]
    assert list(drawing._names) == results


def shapes(draw):
    pen = Pen()
    draw(pen)
    return pen.shapes


def test_arrows_boxes_arcs_and_circles_are_as_expected():
    line, head = shapes(lambda pen: pen.arrow((10.0, 10.0), (10.0, 40.0), "alarm", 3.0, 10.0))
    assert line == Line(((10.0, 10.0), (10.0, 30.0)), "alarm", 3.0)
    assert head == Polygon(((10.0, 40.0), (6.0, 30.0), (14.0, 30.0)), "alarm", "alarm", 0)
    # Too short for a shaft, so only a smaller head is drawn.
    line, head = shapes(lambda pen: pen.arrow((0.0, 0.0), (3.0, 4.0)))
    assert (line.points, head.points) == (((0.0, 0.0), (0.0, 0.0)), ((3.0, 4.0), (-1.6, 1.2), (1.6, -1.2)))
    line, head = shapes(lambda pen: pen.arrow((5.0, 5.0), (5.0, 5.0)))
    assert {*line.points, *head.points} == {(5.0, 5.0)}
    (box,) = shapes(lambda pen: pen.box(1.0, 2.0, 10.0, -5.0, "muted", "faint", 0.5))
    assert box == Polygon(((1.0, 2.0), (11.0, 2.0), (11.0, -3.0), (1.0, -3.0)), "muted", "faint", 0.5)
    (arc,) = shapes(lambda pen: pen.arc((0.0, 0.0), 10.0, 0.0, math.pi, "line", 2.0))
    assert (len(arc.points), arc.points[0], arc.points[-1]) == (24, (10.0, 0.0), (-10.0, 0.0))
    assert min(y for _, y in arc.points) == -10.0  # upward, since y points down on a sheet
    assert polar((1.0, 2.0), 2.0, math.pi / 2.0) == pytest.approx((1.0, 0.0))
    circle, text = shapes(lambda pen: (pen.circle((1.04, 2.06), 3.25), pen.text((1.0, 2.0), "a", "muted", 9.0, "end")))
    assert circle == Circle((1.0, 2.1), 3.2)
    assert as_dict(text) == {
        "kind": "text",
        "at": (1.0, 2.0),
        "text": "a",
        "role": "muted",
        "size": 9.0,
        "anchor": "end",
    }


def test_readings_are_listed_below_each_other():
    text = shapes(
        lambda pen: readings(pen, (10.0, 20.0), [("Speed", "3", "accent"), ("Load", "4", "line")], 50.0, 15.0)
    )
    assert text == [
        Text((10.0, 20.0), "Speed", "muted"),
        Text((60.0, 20.0), "3", "accent", anchor="end"),
        Text((10.0, 35.0), "Load", "muted"),
        Text((60.0, 35.0), "4", "line", anchor="end"),
    ]


def test_an_oscillogram_ends_at_its_edges():
    past, now = [{"x": 0.0}, {"x": 1.0}], {"x": -9.0}
    box, zero, curve = shapes(
        lambda pen: scope(pen, (10.0, 20.0, 30.0, 40.0), past, now, [(lambda r: r["x"], "accent")], 2.0, 4)
    )
    assert box == Polygon(((10.0, 20.0), (40.0, 20.0), (40.0, 60.0), (10.0, 60.0)), "muted", "", 1.0)
    assert zero == Line(((10.0, 40.0), (40.0, 40.0)), "faint", 1.0)
    assert curve == Line(((10.0, 40.0), (20.0, 40.0), (30.0, 30.0), (40.0, 60.0)), "accent", 1.5)


@pytest.mark.parametrize(
    ("full", "lines", "place"),
    [
        ((-1.0, 3.0, -2.0, 2.0), [((20.0, 20.0), (20.0, 60.0)), ((10.0, 40.0), (50.0, 40.0))], (40.0, 30.0)),
        ((0.0, 4.0, 0.0, 2.0), [], (30.0, 40.0)),
        ((-4.0, 0.0, -2.0, 0.0), [], (50.0, 20.0)),
        ((4.0, 8.0, 5.0, 6.0), [], (10.0, 60.0)),
    ],
)
def test_a_plane_has_its_axes_at_zero_if_that_is_inside(full, lines, place):
    row = {"x": 2.0, "y": 1.0}
    result = shapes(
        lambda pen: plane(
            pen, (10.0, 20.0, 40.0, 40.0), [{"x": 99.0, "y": -99.0}], row, lambda r: r["x"], lambda r: r["y"], full, 3
        )
    )
    assert [s.points for s in result[1:-2]] == lines
    assert result[-1] == Circle(place, 5.0, "accent", "accent")
    assert result[-2].points == ((50.0, 60.0), (50.0, 60.0), place)
    assert {s.role for s in result[1:-2]} <= {"faint"}


def test_ranges_of_joints_are_drawn():
    text = """<robot name="r">
      <joint name="a" type="revolute"><limit lower="-1" upper="2"/></joint>
      <joint name="b" type="revolute"><limit lower="-9" upper="9"/></joint>
      <joint name="c" type="continuous"><limit lower="-1" upper="2"/></joint>
      <joint name="d" type="prismatic"><limit upper="0.5"/></joint>
      <joint name="e" type="fixed"/>
    </robot>"""
    assert _limits(text) == {"a": (-1.0, 2.0), "b": (-math.pi, math.pi), "d": (0.0, 0.5)}
