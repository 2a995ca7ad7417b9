"""Drawings of plants and the films made of them."""

import io
import math
from random import Random
from xml.etree import ElementTree

import pytest
from conftest import few
from docs.gallery import sentences
from docs.outline import GALLERY
from expected_text import check_expected
from softrig_bringup.cli import main
from softrig_bringup.film.film import comfortable, film
from softrig_bringup.film.smil import animated
from softrig_core import Signals, load_scenario, rig_of, simulate
from softrig_core.drawing import PALETTE, as_dict, drawing_for
from softrig_core.rig.members import signal_units

# One scenario of each plant with a drawing, and of each of its wirings.
DRAWN = [
    "arm_computed_torque", "bldc_six_step", "buck_pi", "buck_pi_boost", "im_foc",
    "dc_motor_smc", "dc_motor_smc_b2", "dc_motor_fsfb", "economic_dispatch", "fault_location", "gupfc", "induction_dtc",
    "lsrm_fuzzy", "manipulator_adsmc", "manipulator_adsmc_two_link", "optimal_control_mvim", "optimal_control_mvim_s1",
    "optimal_control_mvim_s3", "pmsm_foc", "pmsm_foc_synrm", "pv_mppt", "pwa_delay", "pwa_delay_p2", "pwa_delay_p2c",
    "pwa_delay_p3", "rectifier_mpc",
    "rectifier_mpc_decoupled", "rehab_impedance", "rehab_impedance_r5", "tcp_aqm_smc", "tcp_aqm_smc_s4",
]  # fmt: skip


# By unit: a value that moves a drawing while it stays within its sheet.
SCALES = {"V": 60.0, "A": 6.0, "rad/s": 40.0, "rad": 1.0, "m": 0.08, "N m": 2.0, "Wb": 0.8, "": 0.7, "N": 20.0,
          "W": 40.0, "W/m^2": 900.0, "km": 80.0, "mm": 20.0, "MW": 80.0, "packet": 100.0, "deg": 30.0,
          "m/s": 0.3}  # fmt: skip


FAR = (-600.0, 800.0)  # px: how far a drawing may exceed its 640 by 380 px when all values are 10,000 or -10,000


def check_alike(frames):
    """Check the promise of a drawing: frames of the same shapes, in which only places, radii and texts differ."""
    kinds = None
    for k, frame in enumerate(frames):
        now = [_look(shape) for shape in frame]
        kinds = kinds or now
        if now != kinds:
            at = next((i for i, (a, b) in enumerate(zip(kinds, now)) if a != b), min(len(kinds), len(now)))
            was, result = (x[at] if at < len(x) else None for x in (kinds, now))
            raise ValueError(f"frame {k}: shape {at} of {len(now)} is {result}, in the first frame it is {was}")


def _look(shape):
    style = {name: getattr(shape, name) for name in shape.__dataclass_fields__}
    fixed = [value for name, value in style.items() if name not in ("points", "centre", "radius", "at", "text")]
    return (type(shape).__name__, len(getattr(shape, "points", ())), *fixed)


def test_every_system_is_drawn():
    systems = {load_scenario(scenario).system for scenario, _ in sentences().values()}
    assert len(systems) == len(GALLERY)
    assert {load_scenario(name).system for name in DRAWN} == systems


def usual(drawing, name, seed):
    """Readings of the size of their units, and the units."""
    known, draw = signal_units(rig_of(name)), Random(seed)
    assert set(drawing.signals) <= known.keys()
    return [{s: draw.uniform(-1, 1) * SCALES.get(known[s], 1.0) for s in sorted(drawing.signals)} for _ in range(13)]


@pytest.mark.parametrize("name", few(DRAWN, 12))
def test_frames_differ_only_in_places_radii_and_texts(name):
    drawing = drawing_for(name)
    assert drawing.signals
    draw = Random(1)
    rows = [{s: draw.uniform(-1, 1) * 10.0 ** draw.randint(-3, 6) for s in drawing.signals} for _ in range(20)]
    rows += [{}, dict.fromkeys(drawing.signals, math.nan), dict.fromkeys(drawing.signals, math.inf)]
    frames = [drawing.frame(row, rows[:k]) for k, row in enumerate(rows)]
    check_alike(frames)
    assert frames[0] != frames[-1]
    numbers = [x for f in frames for s in f for p in points(s) for x in p]
    assert all(map(math.isfinite, numbers))
    assert {as_dict(s)["role"] for f in frames for s in f} <= PALETTE.keys()
    # A frame does not depend on the frames drawn before it.
    assert [drawing.frame(row, rows[:k]) for k, row in enumerate(rows)] == frames


@pytest.mark.parametrize("name", few(DRAWN, 12))
def test_each_signal_of_a_drawing_moves_it_and_none_moves_it_off_its_sheet(name):
    drawing = drawing_for(name)
    rows = usual(drawing, name, name)
    before, last = rows[:-1], rows[-1]
    for signal in drawing.signals:
        most = 2.0 * max(abs(row[signal]) for row in rows)
        # The largest value is that of a 345 kV line.
        turned = [last | {signal: value} for value in (most, 0.0, -most, 1e4 * most)]
        frames = [drawing.frame(row, [*before, row]) for row in turned]
        assert any(frame != frames[0] for frame in frames), signal
    for far in (1e4, -1e4):
        row = dict.fromkeys(drawing.signals, far)
        shapes = drawing.frame(row, [row])
        assert shapes != drawing.frame({}, [])
        places = [x for shape in shapes for point in points(shape) for x in point]
        assert FAR[0] < min(places) <= max(places) < FAR[1]


def test_texts_of_drawings_are_as_expected():
    """The text in one frame of each drawing: names, numbers with units, words."""
    messages = []
    for name in DRAWN:
        drawing = drawing_for(name)
        row = usual(drawing, name, name)[0]
        texts = [as_dict(shape).get("text") for shape in drawing.frame(row, [row])]
        messages.append(f"{name}: {' | '.join(text for text in texts if text)}")
    check_expected("drawings", messages)


def points(shape):
    result = as_dict(shape)
    yield from result.get("points") or [result.get("centre") or result.get("at")]
    if "radius" in result:
        assert result["radius"] >= 0.0


def test_a_frame_with_another_difference_is_named():
    drawing = drawing_for("induction_dtc")
    frame = drawing.frame({})
    last = len(frame) - 1
    with pytest.raises(
        ValueError, match=rf"frame 1: shape {last} of {last} is None, in the first frame it is \('Text'"
    ):
        check_alike([frame, frame[:-1]])


def test_the_motor_turns_as_its_shaft_and_the_flux_arrow_follows_the_flux():
    drawing = drawing_for("induction_dtc")
    still = {"flux_true/x": 1.05, "flux_true/y": 0.0}
    up = {"flux_true/x": 0.0, "flux_true/y": 1.05}
    tips = [
        next(s for s in drawing.frame(r) if s.role == "alarm" and type(s).__name__ == "Polygon").points[0]
        for r in (still, up)
    ]
    assert tips == [(298.0, 180.0), (190.0, 72.0)]
    # The picture has one pole pair and the machine two, so 90 degrees in the picture are 45 degrees of the shaft.
    marks = [
        next(
            s for s in drawing.frame({"joint_states/shaft/position": q}) if as_dict(s).get("fill") == s.role == "muted"
        ).points[0]
        for q in (0.0, math.pi / 4)
    ]
    assert marks == [(278.0, 180.0), (190.0, 92.0)]


def test_conductors_are_placed_so_that_their_currents_make_the_flux_along_the_axis():
    """A current in phase a alone, out of the page above and into it below: its field points right."""
    drawing = drawing_for("induction_dtc")
    frame = drawing.frame({"currents_true/x": 5.0})
    signs = {s.text: s.at[1] for s in frame if as_dict(s).get("text") in ("·", "×")}
    assert signs["·"] < 180.0 < signs["×"]


def test_the_translator_is_drawn_where_its_poles_are_aligned():
    """At a position of k times 13 mm pole k is below a tooth."""
    drawing = drawing_for("lsrm_fuzzy")
    for k, name in enumerate("abcd"):
        frame = drawing.frame({"joint_states/translator/position": 0.013 * k})
        letter = next(s for s in frame if as_dict(s).get("text") == name)
        teeth = [
            sum(x for x, _ in s.points) / 4 for s in frame if as_dict(s).get("fill") == "faint" and s.role == "muted"
        ]
        assert min(abs(x - letter.at[0]) for x in teeth) < 0.2


def test_a_robot_is_drawn_as_its_joints_are():
    """The leg hangs straight down at zero; if the hip bends, its foot moves forward, to the right."""
    drawing = drawing_for("rehab_impedance")
    feet = [drawing.camera(drawing.scene.tip(q)) for q in ((0.0, 0.0), (0.5, 0.0))]
    hip = drawing.camera((0.0, 0.0, 1.0))
    assert feet[0][0] == pytest.approx(hip[0])
    assert feet[0][1] > hip[1]
    assert feet[1][0] > feet[0][0] + 20.0
    foot = [s for s in drawing.frame({"joint_states/hip/position": 0.5}) if as_dict(s).get("fill") == "second"][-1]
    assert foot.centre == pytest.approx(feet[1], abs=0.06)


@pytest.mark.parametrize(("span", "speed"), [(0.1, 0.02), (2.0, 0.5), (8.0, 1.0), (9.0, 2.0), (100.0, 20.0)])
def test_a_film_is_short_and_its_speed_a_round_number(span, speed):
    assert comfortable(span) == speed
    assert 3.0 < span / speed <= 8.0


@pytest.fixture(scope="module")
def shorted():
    return simulate("induction_dtc_short")


def test_a_film_shows_the_newest_value_of_each_time(shorted):
    drawing = drawing_for(shorted.rig)
    made = film(drawing, shorted.signals, 0.08, 0.1)
    t, _ = shorted.signals["flux_true/x"]
    row = {name: shorted.signals[name].x[-1] for name in drawing.signals}
    assert made.times[-1] == t[-1] == 0.1
    assert made.frames[-1][60:-2][-1] == drawing.frame(row)[-1]
    assert made.speed == 0.005
    check_alike(made.frames)


def test_an_svg_moves_without_a_script_and_contains_everything_once(shorted):
    made = film(drawing_for(shorted.rig), shorted.signals, 0.05, 0.1)
    root = ElementTree.fromstring(animated(made))
    space = "{http://www.w3.org/2000/svg}"
    moving = [*root.iter(f"{space}animate"), *root.iter(f"{space}animateTransform")]
    assert {m.get("dur") for m in moving} == {"5.05s"}
    assert {len(m.get("values").split(";")) for m in moving} == {101}
    assert len(list(root.iter(f"{space}polyline"))) == sum(type(s).__name__ == "Line" for s in made.frames[0])
    # The file loads nothing from the network.
    assert "http" not in animated(made).replace("http://www.w3.org/2000/svg", "")


@pytest.mark.parametrize("form", few(["svg", "gif", "webp", "png"], 2))
def test_the_verb_writes_every_form(form, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (
        main(["draw", "animate", "induction_dtc_short", "--from", "0.09", "--speed", "0.05", "-o", f"film.{form}"]) == 0
    )
    assert capsys.readouterr().out.startswith(f"film.{form}: 0.25 s, 5 frames, 0.")
    assert [p.name for p in tmp_path.iterdir()] == [f"film.{form}"]
    if form != "svg":
        from PIL import Image

        with Image.open(tmp_path / f"film.{form}") as image:
            assert (image.n_frames, image.size) == (5, (640, 390))


@pytest.mark.long
def test_a_gif_is_made_small_enough_or_refused(shorted, monkeypatch):
    from PIL import Image
    from softrig_bringup.film import raster
    from softrig_core import ScenarioError

    made = film(drawing_for(shorted.rig), shorted.signals, 0.09, 0.1, 0.02)
    whole, text = raster.pixels(made, "gif")
    assert text == ""
    monkeypatch.setattr(raster, "LARGEST", len(whole) - 1)
    less, text = raster.pixels(made, "gif")
    assert text == "reduced to 32 colours and 11 frames"
    assert len(less) < len(whole)
    monkeypatch.setattr(raster, "LARGEST", 2 * len(less) // 3)
    fewer, text = raster.pixels(made, "gif")
    assert text == "reduced to 32 colours and 6 frames"
    with Image.open(io.BytesIO(fewer)) as image:
        assert (image.n_frames, image.info["duration"]) == (6, 100)  # half the frames, each twice as long
    monkeypatch.setattr(raster, "LARGEST", 1000)
    with pytest.raises(ScenarioError, match=r"16 colours and 4 frames, expected at most 0\.001 MB: choose a shorter"):
        raster.pixels(made, "gif")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["induction_dtc_short", "-o", "film.mp4"], "expected a file that ends with .svg, .gif, .webp, .png"),
        (["induction_dtc_short", "--to", "5e-324"], "expected a part of the run, which is 0.1 s long"),
        (["induction_dtc_short", "--from", "0.2"], "expected a part of the run, which is 0.1 s long"),
        (["induction_dtc_short", "--speed", "1e-4"], "use a speed of 0.02 or a shorter window"),
        (["induction_dtc_short", "--speed", "10"], "less than two frames of 1/20 s"),
        (["rectifier_mpc_certificate"], "no drawing of"),
        (["induction_dtc_shor"], "did you mean"),
    ],
)
def test_a_system_that_cannot_be_animated_is_named(words, text, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["draw", "animate", *words]) == 2
    assert text in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_run_without_the_drawn_signals_is_named(shorted):
    from softrig_core import Recording, ScenarioError

    with pytest.raises(ScenarioError, match="no drawn signal was recorded: joint_states/shaft/position"):
        film(drawing_for(shorted.rig), Signals(Recording([])), 0.0, 0.1)
