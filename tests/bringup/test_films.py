"""Films from artificial frames: which moment each shows, what moves in them, and where pixels are."""

import math
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from expected_text import check_expected
from PIL import Image
from softrig_bringup.film import raster
from softrig_bringup.film.film import LONGEST, Film, comfortable, film, speed_text
from softrig_bringup.film.smil import animated
from softrig_bringup.film.svg import element, number, sheet, still
from softrig_core import ScenarioError
from softrig_core.drawing.shapes import PALETTE, Circle, Line, Polygon, Text
from softrig_core.wire.signals import Signal

BOUNDS = (10.0, 20.0, 100.0, 60.0)


def shows(trail=0.0, signals=("a", "b")):
    """A drawing that shows the rows it receives."""
    return SimpleNamespace(
        bounds=BOUNDS, signals=signals, trail=trail, title="Made <by> hand", frame=lambda row, past: [(row, list(past))]
    )


# frames ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("speed", "end", "times", "digits", "words"),
    [
        (0.05, 1.009, [1.0, 1.00225, 1.0045, 1.00675, 1.009], "1.000 1.002 1.004 1.007 1.009", "slowed down 20 times"),
        (1.0, 1.18, [1.0, 1.045, 1.09, 1.135, 1.18], "1.0 1.0 1.1 1.1 1.2", "as fast as it is"),
        (5.0, 1.3, [1.0, 1.3], "1.0 1.3", "5 times as fast as it is"),
        (10.0, 3.0, [1.0, 1.5, 2.0, 2.5, 3.0], "1 2 2 2 3", "10 times as fast as it is"),
        (1e-7, 1.0 + 1e-8, [1.0, 1.0 + 5e-9, 1.0 + 1e-8], "1.000000 1.000000 1.000000", "slowed down 1e+07 times"),
    ],
)
def test_twenty_frames_a_second_state_their_time_and_speed(speed, end, times, digits, words):
    made = film(shows(), {"a": Signal(np.array([0.0]), np.array([7.0]))}, 1.0, end, speed)
    assert made.times == pytest.approx(times, abs=1e-12)
    assert (made.speed, made.duration, made.bounds) == (speed, len(times) / 20.0, (10.0, 20.0, 100.0, 90.0))
    for frame, t in zip(made.frames, digits.split(), strict=True):
        assert frame == [
            ({"a": 7.0}, []),
            Text((30.0, 94.0), f"t = {t} s", "muted"),
            Text((90.0, 94.0), words, "muted", 13.0, "end"),
        ]
    assert speed_text(speed) == words


def test_a_frame_has_the_newest_value_of_each_signal_and_none_before_its_first():
    a = Signal(np.array([0.0, 0.1, 0.15 + 5e-10, 0.2]), np.array([1.0, 2.0, 3.0, 4.0]))
    b = Signal(np.array([0.12]), np.array([-1.0]))
    made = film(shows(), {"a": a, "b": b, "other": a}, 0.0, 0.2, 1.0)
    rows = [frame[0][0] for frame in made.frames]
    assert [row["a"] for row in rows] == [1.0, 1.0, 2.0, 3.0, 4.0]  # up to rounding, both rows have the same instant
    assert [math.isnan(row["b"]) for row in rows] == [True, True, True, False, False]
    assert [set(row) for row in rows] == [{"a", "b"}] * 5


def test_a_trail_has_the_sixty_rows_before_each_frame():
    t = np.arange(401) / 100.0
    made = film(shows(trail=1.2), {"a": Signal(t, t)}, 2.0, 2.97, 2.0)  # a grid of 0.02 s from 0.8 s on
    for k, (row, past) in enumerate(frame[0] for frame in made.frames):
        at = 2.0 + 0.097 * k
        assert row == {"a": pytest.approx(math.floor(100.0 * at + 1e-6) / 100.0, abs=1e-9)}
        wanted = [g for g in (0.8 + 0.02 * j for j in range(110)) if at - 1.2 - 1e-9 <= g < at - 1e-9]
        assert [p["a"] for p in past] == pytest.approx(wanted, abs=1e-9)
        assert len(past) == 60
    early = film(shows(trail=1.2), {"a": Signal(t, t)}, 0.5, 0.6, 0.5)
    assert [frame[0][1][0]["a"] for frame in early.frames] == [0.0] * 5  # no frame lies before the start of the run
    assert [len(frame[0][1]) for frame in early.frames] == pytest.approx([25, 26, 27, 29, 30], abs=1)


def test_a_run_with_some_of_the_drawn_signals_is_drawn():
    nothing, some = Signal(np.array([]), np.array([])), Signal(np.array([0.0]), np.array([1.0]))
    assert film(shows(), {"a": nothing, "b": some}, 0.0, 1.0).frames[0][0][0] == {"b": 1.0}
    with pytest.raises(ScenarioError, match=r"^no drawn signal was recorded: a, b$"):
        film(shows(), {"a": nothing}, 0.0, 1.0)


def test_a_film_has_two_frames_at_least_and_six_hundred_at_most():
    signals = {"a": Signal(np.array([0.0]), np.array([1.0]))}
    assert len(film(shows(), signals, 0.0, 29.95, 1.0).frames) == LONGEST == 600
    with pytest.raises(ScenarioError) as refused:
        film(shows(), signals, 0.0, 30.0, 1.0)
    assert str(refused.value) == (
        "601 frames at 20 a second: expected at most 600; use a speed of 5 or a shorter window"
    )
    assert len(film(shows(), signals, 0.0, 0.03, 1.0).frames) == 2
    with pytest.raises(ScenarioError, match=r"^0.02 s at a speed of 1 are less than two frames of 1/20 s$"):
        film(shows(), signals, 0.0, 0.02, 1.0)


@pytest.mark.parametrize("exponent", range(-5, 4))
def test_a_comfortable_film_takes_from_three_to_eight_seconds_at_the_least_round_speed(exponent):
    speeds = [float(f"{m}e{e}") for e in range(-8, 6) for m in (1, 2, 5)]
    for span in (1.0, 1.6, 1.7, 3.9, 4.0, 4.1, 7.9, 8.0, 8.1, 9.9):
        span *= 10.0**exponent
        assert comfortable(span) == next(s for s in speeds if s * 8.0 >= span * (1 - 1e-9))


# SVG -------------------------------------------------------------------------------------------------------------


def svg_lines(root, depth=0):
    """Elements of an SVG, one line each, without its style."""
    for tag in root:
        if (name := tag.tag.rpartition("}")[2]) != "style":
            words = [name, *(f"{k}={v}" for k, v in tag.attrib.items()), *([repr(tag.text)] if tag.text else [])]
            yield "  " * depth + " ".join(words)
            yield from svg_lines(tag, depth + 1)


def moving(frames, title="Made <by> hand"):
    drawing = SimpleNamespace(bounds=BOUNDS, title=title)
    return ElementTree.fromstring(animated(Film(drawing, np.arange(len(frames)) / 20.0, frames, 1.0)))


def series(make, values):
    return [make(v) for v in values]


def square(x, y, size=10.0):
    return Polygon(((x, y), (x + size, y), (x + size, y + size), (x, y + size)), "accent", "faint", 2.0)


def test_a_film_as_svg_is_as_expected():
    """Parts that stay, that are shifted, that bend, that jump, a text that changes and one that moves along."""
    steps = [0.0, 1.0, 4.0, 9.0, 9.0]
    every = [
        [Line(((0.0, 0.0), (5.0, 5.0)), "muted", 1.0, True)] * 5,
        series(lambda x: square(5.0 + x, 7.0 + 2 * x), steps),
        series(lambda x: Line(((0.0, 0.0), (10.0, x)), "second"), steps),
        series(lambda x: square(5.0 + 10 * x, 7.0), steps),  # it moves by 50 px within one frame
        series(lambda x: Line(((0.0, 0.0), (10.0, 10 * x))), steps),
        series(lambda x: Circle((50.0, 20.0 + x), 3.0 + x, "third", "third", 0.0), steps),
        series(lambda x: Circle((10 * x, 20.0), 3.0), steps),
        [Circle((1.0, 2.0), 3.0)] * 5,
        [Text((20.0, 30.0), "stays", anchor="middle")] * 5,
        series(lambda x: Text((20.0 + x, 30.0), "goes", "alarm", 10.0, "end"), steps),
        series(lambda k: Text((20.0, 40.0), "abacc"[k], "line", 10.0), range(5)),
        series(lambda k: Text((20.0 + steps[k], 50.0), "xyzuv"[k]), range(5)),
    ]
    root = moving([list(frame) for frame in zip(*every, strict=True)])
    head = [f"svg {' '.join(f'{k}={v}' for k, v in root.attrib.items())}"]
    check_expected("film", [*head, *svg_lines(root)])


def test_without_a_text_that_changes_there_is_no_window():
    assert [tag.tag.rpartition("}")[2] for tag in moving([[square(0, 0)]] * 2)] == ["title", "style", "rect", "polygon"]


@pytest.mark.parametrize(("far", "discrete"), [(39.9, False), (40.0, False), (40.1, True)])
@pytest.mark.parametrize("way", [(1, 0), (0, 1), (-1, 0), (0, -1)])
def test_a_shape_that_moves_more_than_forty_units_in_a_frame_starts_there_again(far, discrete, way):
    x, y = far * way[0], far * way[1]
    circle, shifted, bent = moving(
        [
            [Circle((0.0, 0.0), 1.0), square(0.0, 0.0), Line(((0.0, 0.0), (1.0, 1.0)))],
            [Circle((x, y), 1.0), square(x, y), Line(((0.0, 0.0), (1.0 + x, 1.0 + y)))],
        ]
    )[3:]
    assert [e[0].get("calcMode") == "discrete" for e in (circle, shifted, bent)] == [discrete] * 3


@pytest.mark.parametrize(("off", "shift"), [(0.0, True), (0.1, True), (-0.1, True), (0.2, False), (-0.2, False)])
@pytest.mark.parametrize("where", [0, 1])
def test_a_shape_is_shifted_as_a_whole_within_rounding(off, shift, where):
    by = [3.0, 4.0]
    by[where] += off
    (line,) = moving([[Line(((1.0, 2.0), (5.0, 5.0)))], [Line(((4.0, 6.0), (5.0 + by[0], 5.0 + by[1])))]])[3:]
    assert line[0].tag.rpartition("}")[2] == ("animateTransform" if shift else "animate")


def test_a_text_stays_for_four_frames_and_is_reused():
    # A text stays for four frames, so "c" within the four frames of "b" is not shown.
    texts = ["a"] * 4 + ["b"] * 3 + ["c"] + ["a"] * 2
    (_, _, _, _, group) = moving([[Text((20.0, 30.0), text, size=10.0)] for text in texts])
    (text,) = group
    spans = [(e.text, e.get("y")) for e in text if e.tag.endswith("tspan")]
    assert spans == [("a", "30"), ("b", "50")]
    assert text[-1].get("values").split(";") == ["0"] * 4 + ["0 -20"] * 4 + ["0"] * 2


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (-0.0, "0"), (-0.04, "0"), (0.05, "0.1"), (1.0, "1"), (-1.0, "-1"), (1.26, "1.3"), (-12.34, "-12.3")],
)
def test_a_coordinate_has_a_resolution_of_a_tenth(value, text):
    assert number(value) == text


def test_colours_suit_a_light_or_dark_background_or_the_readers_choice():
    light, dark, either = sheet(False), sheet(True), sheet()
    rules = [".s-alarm{stroke:#cc3311}.f-alarm{fill:#cc3311}", ".s-alarm{stroke:#ff7a66}.f-alarm{fill:#ff7a66}"]
    assert [rule in text for text in (light, dark) for rule in rules] == [True, False, False, True]
    before, media, after = either.partition("@media (prefers-color-scheme:dark){")
    assert (before == light, media != "", after.endswith(f"{rules[1]}}}")) == (True, True, True)
    assert light.startswith("text{font-family:system-ui")
    assert ".d{stroke-dasharray:5 4}" in light
    drawing = SimpleNamespace(bounds=BOUNDS, title="One")
    assert [rules[1] in still(drawing, [], ground) for ground in (False, True, None)] == [False, True, True]


def test_each_shape_has_its_look():
    results = [
        element(s)
        for s in (
            Line(((0.0, 1.0), (2.5, 3.0)), "alarm", 2.0),
            Line(((0.0, 1.0), (2.5, 3.0)), dashed=True),
            Polygon(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), "line", "faint", 0.0),
            Polygon(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), "line"),
            Circle((1.0, 2.0), 3.25, "accent", "paper"),
            Text((1.0, 2.0), "a", "muted", 9.5),
            Text((1.0, 2.0), "a", anchor="middle"),
        )
    ]
    assert [(e.tag, e.attrib) for e in results] == [
        ("polyline", {"points": "0,1 2.5,3", "fill": "none", "class": "s-alarm", "stroke-width": "2"}),
        ("polyline", {"points": "0,1 2.5,3", "fill": "none", "class": "s-line d", "stroke-width": "1.5"}),
        ("polygon", {"points": "0,0 1,0 0,1", "class": "f-faint"}),
        ("polygon", {"points": "0,0 1,0 0,1", "class": "s-line", "fill": "none", "stroke-width": "1.5"}),
        ("circle", {"cx": "1", "cy": "2", "r": "3.2", "class": "s-accent f-paper", "stroke-width": "1.5"}),
        ("text", {"x": "1", "y": "2", "class": "f-muted", "font-size": "9.5"}),
        ("text", {"x": "1", "y": "2", "class": "f-line", "font-size": "13", "text-anchor": "middle"}),
    ]


# pixels ----------------------------------------------------------------------------------------------------------


def colour(role):
    return tuple(int(PALETTE[role][0][k : k + 2], 16) for k in (1, 3, 5))


def shade(image, x, y):
    """The role whose colour is nearest to that of the pixel with its middle at a point of the drawing."""
    result = image.getpixel((int(x - BOUNDS[0]), int(y - BOUNDS[1])))
    return min(("paper", "faint", "alarm", "second"), key=lambda role: math.dist(result, colour(role)))


def drawn(*shapes):
    image = raster.picture(list(shapes), BOUNDS)
    assert image.size == (100, 60)
    return image


def inked(image, role):
    """The bounding box of a colour: left, top, right, bottom in units of the drawing."""
    far = np.abs(np.asarray(image, int) - colour("paper")).sum(axis=2)
    ys, xs = np.nonzero(far > 0.5 * np.abs(np.subtract(colour(role), colour("paper"))).sum())
    return xs.min() + BOUNDS[0], ys.min() + BOUNDS[1], xs.max() + 1 + BOUNDS[0], ys.max() + 1 + BOUNDS[1]


def test_a_line_has_its_points_and_its_width():
    image = drawn(Line(((30.0, 40.0), (90.0, 40.0)), "alarm", 4.0))
    assert inked(image, "alarm") == pytest.approx((28, 38, 92, 42), abs=1)  # the line has round ends
    assert shade(image, 60.5, 40.5) == "alarm"
    assert {shade(image, 60.5, y) for y in (36.5, 43.5)} == {"paper"}
    assert shade(image, 28.5, 38.5) != "alarm"
    thin = drawn(Line(((30.0, 40.0), (90.0, 40.0)), "alarm", 0.2))
    assert inked(drawn(Line(((30.0, 40.0), (30.0, 70.0)), "line", 1.0)), "line")[1::2] == pytest.approx((40, 70), abs=1)
    # A line of 0.2 px stays visible.
    assert min(thin.getpixel((50, y))[1] for y in range(15, 25)) < 220
    assert drawn(Line(((30.0, 40.0), (90.0, 40.0)), "alarm", 0.0)).getcolors() == [(6000, colour("paper"))]


def test_a_polygon_is_filled_and_its_edge_closed():
    corners = ((30.0, 30.0), (70.0, 30.0), (70.0, 60.0), (30.0, 60.0))
    both = drawn(Polygon(corners, "alarm", "faint", 4.0))
    assert shade(both, 50.5, 45.5) == "faint"
    assert {shade(both, *at) for at in ((50.5, 30.5), (69.5, 45.5), (50.5, 60.5), (29.5, 45.5))} == {"alarm"}
    edge = drawn(Polygon(corners, "alarm", "", 4.0))
    assert shade(edge, 50.5, 45.5) == "paper"
    assert shade(edge, 29.5, 45.5) == "alarm"
    fill = drawn(Polygon(corners, "alarm", "second", 0.0))
    assert inked(fill, "second") == pytest.approx((30, 30, 70, 60), abs=1)
    assert "alarm" not in {shade(fill, x, 30.5) for x in range(11, 110)}


def test_a_circle_is_round_its_centre():
    both = drawn(Circle((60.0, 50.0), 12.0, "alarm", "faint", 3.0))
    assert inked(both, "alarm") == pytest.approx((46.5, 36.5, 73.5, 63.5), abs=1)  # half of the edge lies outside
    assert shade(both, 60.5, 50.5) == "faint"
    ring = {shade(both, 60 + 12.0 * math.cos(a), 50 + 12.0 * math.sin(a)) for a in np.arange(0.0, 6.2, 0.4)}
    assert ring == {"alarm"}
    bare = drawn(Circle((60.0, 50.0), 12.0, "alarm", "", 3.0))
    assert (shade(bare, 60.5, 50.5), shade(bare, 60.5, 38.5)) == ("paper", "alarm")
    full = drawn(Circle((60.0, 50.0), 12.0, "alarm", "second", 0.0))
    assert (shade(full, 60.5, 50.5), shade(full, 60.5, 39.5)) == ("second",) * 2
    assert len(drawn(Circle((60.0, 50.0), 0.5, "alarm", "alarm")).getcolors()) > 1
    assert drawn(Circle((60.0, 50.0), 0.0, "alarm", "second")).getcolors() == [(6000, colour("paper"))]


def test_a_text_is_anchored_at_its_start_middle_or_end_above_its_baseline():
    boxes = [
        inked(drawn(Text((60.0, 50.0), "HHH", "line", 13.0, anchor)), "line") for anchor in ("start", "middle", "end")
    ]
    lefts, rights = [box[0] for box in boxes], [box[2] for box in boxes]
    assert [lefts[0], (lefts[1] + rights[1]) / 2, rights[2]] == pytest.approx([60, 60, 60], abs=1.6)
    assert {box[3] for box in boxes} == {50}
    # Height of capital letters in DejaVu.
    assert [box[3] - box[1] for box in boxes] == pytest.approx([0.73 * 13.0] * 3, abs=1)
    large = inked(drawn(Text((30.0, 60.0), "HHH", "line", 26.0)), "line")
    assert large[3] - large[1] == pytest.approx(0.73 * 26.0, abs=1)


def test_a_dashed_line_is_drawn_in_dashes_without_round_ends():
    image = drawn(Line(((20.0, 40.0), (100.0, 40.0)), "alarm", 4.0, True))
    row = "".join("x" if shade(image, 20.5 + k, 40.5) == "alarm" else "." for k in range(78))
    assert [(row[9 * k + 1 : 9 * k + 4], row[9 * k + 6 : 9 * k + 8]) for k in range(8)] == [("xxx", "..")] * 8
    assert shade(image, 18.5, 40.5) == "paper"


def frames(count):
    return [[square(10.0 + 4 * k, 30.0)] for k in range(count)]


@pytest.mark.parametrize(("form", "duration"), [("gif", 50), ("webp", 50), ("png", 50)])
def test_a_moving_picture_repeats_frames_of_a_twentieth_of_a_second(form, duration, tmp_path):
    data, words = raster.pixels(Film(SimpleNamespace(bounds=BOUNDS), np.arange(3), frames(3), 1.0), form)
    (tmp_path / "film").write_bytes(data)
    with Image.open(tmp_path / "film") as image:
        assert (image.format.lower(), image.n_frames, image.size, words) == (form, 3, (100, 90), "")
        image.seek(2)
        image.load()
        assert (image.info["duration"], image.info["loop"]) == (duration, 0)
        shown = image.convert("RGB")
    # The trail fades: 8 px to the side it has the third of its colours.
    assert shown.getpixel((13, 15)) == pytest.approx(colour("faint"), abs=4)
    assert shown.getpixel((3, 15)) == pytest.approx(colour("paper"), abs=4)


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ([100], ""),
        ([101, 100], "reduced to 32 colours and 5 frames"),
        ([101, 101, 100], "reduced to 32 colours and 3 frames"),
        ([101, 101, 101, 100], "reduced to 16 colours and 2 frames"),
        ([101, 101, 101, 2_345_678], None),
    ],
)
def test_a_gif_loses_colours_then_frames_until_it_is_small_enough(sizes, words, monkeypatch):
    asked, left = [], iter(sizes)

    def written(images, form, every):
        asked.append((form, every, len(images), max(len(i.getcolors()) for i in images)))
        return bytes(next(left))

    monkeypatch.setattr(raster, "_written", written)
    monkeypatch.setattr(raster, "LARGEST", 100)
    noisy = [Image.effect_noise((40, 40), 90.0).convert("RGB") for _ in range(5)]
    monkeypatch.setattr(raster, "picture", lambda frame, bounds: noisy[frame])
    made = Film(SimpleNamespace(bounds=BOUNDS), np.arange(5), [0, 1, 2, 3, 4], 1.0)
    if words is None:
        with pytest.raises(
            ScenarioError, match=r"^a GIF of 2.35 MB with 16 colours and 2 frames, expected at most 0.00"
        ):
            raster.pixels(made, "gif")
    else:
        assert raster.pixels(made, "gif") == (bytes(100), words)
    wanted = [("gif", 1, 5, 64), ("gif", 1, 5, 32), ("gif", 2, 3, 32), ("gif", 3, 2, 16)]
    assert [(form, every, count) for form, every, count, _ in asked] == [w[:3] for w in wanted[: len(sizes)]]
    assert all(result <= most for (*_, result), (*_, most) in zip(asked, wanted, strict=False))
