"""The page of a run as text: its widgets and pictures, its tables, and what its parameters and buttons do.

A small rig with a knob of every kind; the texts are in `tests/expected/view`.
"""

import math
from types import SimpleNamespace
from typing import Literal, NamedTuple

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.events import ButtonClick
from bokeh.models import ColumnDataSource, CrosshairTool, HoverTool, Range1d, Span
from expected_text import check_expected
from softrig_bringup.view import look, words
from softrig_bringup.view.control import Control, Entry, Knob, role
from softrig_bringup.view.page import PACES, Page, bare
from softrig_bringup.view.pictures import Picture, plots_of
from softrig_bringup.view.sources import Recorded
from softrig_bringup.view.tracks import Pane
from softrig_core import (
    Block,
    BlockParams,
    Observer,
    Plant,
    Recording,
    Scenario,
    ScenarioError,
    Signals,
    button,
    command,
    joint_state,
    number,
    param,
    reference,
    rig_of,
    run_inprocess,
    vector3,
)
from softrig_core.verdict.result import Result
from softrig_core.wire.signals import Table

# a rig ----------------------------------------------------------------------------------------------------------------


class Level(NamedTuple):
    h: float


class Tank(Plant):
    class Params(BlockParams):
        period: float = param(0.01, "sampling period", "s", gt=0)
        area: float = param(2.0, "cross section", "m^2", gt=0, le=1e6, live=True)
        leak: float | None = param(None, "share that leaks; none when absent", "1/s", ge=0, live=True)

    INPUTS = (command("q", "tank/command", ["inlet"], "m^3/s"), number("rain", "tank/rain", "m^3/s", held=True))
    OUTPUTS = (
        joint_state("state", "tank/state", ["level"], position="m", velocity="m/s"),
        vector3("wave", "tank/wave", "surface", "m"),
    )

    def first(self):
        return Level(1.0)

    def outputs(self, x, t):
        return {"state": (x.h, -0.5), "wave": (math.cos(t / 1e8), math.sin(t / 1e8), 0.0)}

    def advance(self, x, t, q, rain):
        return Level(x.h + self.p.period * q[0] / self.p.area)


class Law(Block):
    class Params(BlockParams):
        period: float = param(0.02, "sampling period", "s", gt=0)
        k: float = param(3.0, "gain", "m^2/s", ge=0, le=10, live=True)
        steps: int = param(40, "how many", ge=1, le=5000, live=True)
        offset: float = param(0.0, "added", "m^3/s", live=True)
        at_least: float = param(1e9, "no less", ge=-5, live=True)
        at_most: float = param(-2.5, "no more", le=7, live=True)
        clip: bool = param(True, "whether it is clipped", live=True)
        rule: Literal["soft", "hard"] = param("soft", "which rule", live=True)
        weights: tuple[float, ...] = param((1.0, 0.25), "of the levels", "m", live=True)
        wide: int = param(1200, "of a wide range", ge=-3000, le=1500, live=True)
        size: int = param(3, "of nothing that changes", ge=1)

    INPUTS = (
        joint_state("state", "tank/state", ["level"], position="m"),
        reference("wanted", "tank/wanted", ["level"], position="m"),
        button("flush", "flush", held=True),
    )
    OUTPUTS = (command("q", "tank/command", ["inlet"], "m^3/s"),)

    def update(self, x, t, state, wanted, flush):
        return x, {"q": (self.p.k * (wanted[0] - state[0]),)}


class Shaper(Block):
    class Params(BlockParams):
        period: float = param(0.02, "sampling period", "s", gt=0)
        slope: float = param(0.2, "of the ramp", "m/s", ge=0, le=1, live=True)

    INPUTS = (reference("asked", "tank/asked", ["level"], position="m"),)
    OUTPUTS = (reference("wanted", "tank/wanted", ["level"], position="m"),)

    def update(self, x, t, asked):
        return x, {"wanted": (asked[0],)}


class Steps(Block):
    class Params(BlockParams):
        period: float = param(0.02, "sampling period", "s", gt=0)
        high: float = param(2.0, "of the step", "m", ge=0, le=4, live=True)

    OUTPUTS = (reference("asked", "tank/asked", ["level"], position="m"),)

    def update(self, x, t):
        return x, {"asked": (self.p.high,)}


class Watch(Observer):
    class Params(BlockParams):
        period: float = param(0.02, "sampling period", "s", gt=0)
        limit: float = param(1.5, "of an alarm", "m", ge=0, le=2, live=True)

    INPUTS = (joint_state("state", "tank/state", ["level"], position="m"),)

    def update(self, x, t, state):
        return x, {}

    def status(self, *x):
        return {"seen": (1.0, "m")}


BLOCKS = {"tank": Tank, "law": Law, "shaper": Shaper, "steps": Steps, "watch": Watch}
PLOTS = [
    {
        "title": "Level and inflow",
        "signals": {
            "tank/state/level/position": "level",
            "tank/state/level/velocity": "speed",
            "tank/wave/z": "depth",
            "tank/wanted/level/position": "wanted",
            "tank/asked/level/position": "asked",
            "tank/wave/x": "wave",
            "tank/command/inlet/effort": "inflow",
        },
    },
    {
        "title": "Level, enlarged",
        "signals": {f"tank/{topic}/level/position": topic for topic in ("state", "wanted", "asked")},
        "window": [0.0, 0.1],
    },
    {"title": "Surface", "signals": {"tank/wave/y": "surface"}, "x": "x"},
]


@pytest.fixture
def rig(monkeypatch):
    return make(monkeypatch)


def make(patch, **keys):
    from softrig_core.rig.installed import load_block

    patch.setattr(
        "softrig_core.rig.rig.load_block",
        lambda package, name: BLOCKS[name] if package == "here" else load_block(package, name),
    )
    nodes = {name: {"package": "here", "executable": name} for name in BLOCKS}
    faults = {"drift": {"link": "tank/state -> law", "kind": "offset", "value": [0.05]}}
    about = {"name": "tank_demo", "title": "A <tank> & its level", "system": "tank", "source": "Nobody",
             "duration": 0.4}  # fmt: skip
    return rig_of(Scenario(**about | {"nodes": nodes, "plots": PLOTS, "faults": faults} | keys))


def recorded(rig):
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    run_inprocess(rig, 0, recording)
    return Signals(recording)


# its page in words ----------------------------------------------------------------------------------------------------

WIDGET = ("title", "label", "value", "active", "start", "end", "step", "options", "format", "show_value", "description",
          "width", "align", "visible", "disabled", "text")  # fmt: skip


def number_or_text(value):
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def widget_lines(model, depth=1):
    """A widget and those inside it, one line each, with all values that differ from Bokeh's defaults; a few lines for a
    picture.
    """
    indent, kind = "  " * depth, type(model).__name__
    if kind == "figure":
        yield from (f"{indent}{line}" for line in picture_lines(model))
        return
    known = model.properties_with_values(include_defaults=False)
    shown = {n: known[n] for n in WIDGET if n in known}
    if shown.get("text", "").startswith("<svg"):
        shown["text"] = "a drawing"
    name = [kind, model.name or "", model.sizing_mode or "", f"{n} sheets" if (n := len(model.stylesheets)) else ""]
    text = " ".join(f"{n} {number_or_text(v)}" for n, v in shown.items())
    yield f"{indent}{' '.join(filter(None, name))}{': ' if text else ''}{text}"
    # the widgets of a fault have an expected text of their own
    for child in () if model.name == "knobs drift" else getattr(model, "children", ()):
        yield from widget_lines(child, depth + 1)


def picture_lines(figure):
    y, tools = figure.y_range, figure.toolbar
    title = figure.title and figure.title.text
    yield f"picture {figure.name}: {title!r}, {figure.height} high {figure.sizing_mode}"
    yield f"  {figure.xaxis[0].axis_label!r} {figure.yaxis[0].axis_label!r}, y of the visible {y.only_visible}"
    drawn = "" if not figure.match_aspect else ", round"
    kinds = " ".join(type(t).__name__.removesuffix("Tool") for t in tools.tools)
    yield f"  tools {kinds}, drags {type(tools.active_drag).__name__}, hides {tools.autohide}{drawn}"
    for tool in tools.tools:
        if isinstance(tool, HoverTool):
            of = [r.name for r in tool.renderers]
            yield f"  says {tool.tooltips!r} {tool.mode} {tool.line_policy} {tool.formatters} of {of}"
        if isinstance(tool, CrosshairTool):
            yield f"  crosshair {tool.dimensions} {tool.line_color} {tool.line_alpha}"
    legend = figure.legend[0]
    words = [i.label.value for i in legend.items]
    yield f"  legend {words} {legend.orientation} {legend.click_policy} {legend.ncols} columns at {legend.location}"
    above, across = ([type(c).__name__ for c in part] for part in (figure.above, figure.center))
    yield f"  above {above}, across {across}"
    for renderer in figure.renderers:
        glyph, data = renderer.glyph, renderer.data_source.data
        look = f"{glyph.line_color} {glyph.line_width} {glyph.line_dash or ''}".rstrip()
        yield f"  {type(glyph).__name__} {renderer.name} of {renderer.data_source.name!r} {look}: {curve(data)}"


def curve(data):
    return ", ".join(
        f"{n} {len(v)} from {v[0]:.6g} to {v[-1]:.6g} in all {np.nansum(v):.6g}" if len(v) else f"{n} none"
        for n, v in data.items()
    )


def document_lines(document):
    for root in document.roots:
        yield f"{root.name}"
        yield from widget_lines(root)
    known = {k: v for k, v in document.template_variables.items() if k in ("look", "drawn", "curves", "groups")}
    yield from (f"{k}: {v}" for k, v in known.items())
    yield f"{document.title!r}, every {[c.period for c in document.session_callbacks]} ms"


METRICS = [
    Result(name="rise_time", unit="s", expected=0.6, tolerance=0.1, value=0.625, passed=True),
    Result(name="ripple", unit="m^3/s", at_most=0.5, value=0.75, passed=False),
    Result(name="settles", unit="s", at_most=1.0, value=None, error="never", passed=False),
    Result(name="late_one", unit="s", at_most=1.0, value=None, error="no sample after 2 s", passed=False),
    Result(name="cost", unit="", value=12345.678, passed=True),
    Result(name="stays", unit="m", at_least=0.0, value=-0.5, settled=True, passed=False),
    Result(name="starts", unit="m", at_least=0.0, value=0.5, settled=True, passed=True),
]
STATUS = {
    "tank": {"state": "running", "ticks": 41, "missed_deadlines": 3, "late_messages": 0, "dropped_ticks": 2},
    "law": {
        "state": "failed",
        "ticks": 20,
        "error": "no <answer>",
        "lacking": ["tank/state"],
        "refused": {"tank/command": [2, "inlet is nan"]},
        "reports": {"clip": [1, "clipped", 4], "ok": [0, "fine", 9]},
    },
    "steps": {},
}


def page_of(source, control, figures=((), True), look="light"):
    document = Document()
    page = Page(document, source, control, lambda: figures, "me", "in process", look)
    page.update()
    return document, page


def named(document, name):
    return document.select_one({"name": name})


def test_the_page_of_a_recording_is_as_expected(rig):
    content = {"nodes": STATUS, "changes": [{"at_s": 0.1, "node": "law", "set": {"k": 2.0}}]}
    source = Recorded(rig, recorded(rig), content)
    control = Control(rig, None, lambda: source.end, lambda: source.outcome)
    document, _ = page_of(source, control, (METRICS, False))
    check_expected("view/recording", document_lines(document))


def live(rig, asked=None, held=True, pace=1.0, **more):
    source = Recorded(rig, recorded(rig), {})
    source.live, source.outcome, source.length = True, "", 6.0
    for name, value in more.items():
        setattr(source, name, value)
    asked = [] if asked is None else asked
    control = Control(rig, lambda *what: asked.append(what), lambda: source.end, lambda: source.outcome, held, pace)
    return source, control


ONE = [{"title": "Level", "signals": {"tank/state/level/position": "level"}}]


def test_the_page_of_a_paused_run_is_as_expected(monkeypatch):
    source, control = live(make(monkeypatch, plots=ONE), status=STATUS)
    control.goes_back = True
    document, _ = page_of(source, control, (METRICS, True), "dark")
    check_expected("view/held", document_lines(document))


@pytest.mark.parametrize(
    ("held", "pace", "names"),
    [
        (None, None, ["window", "follow", "only forward"]),  # in real time with an external plant
        (True, None, ["window", "follow", "hold", "step", "only forward"]),
        (False, 0.0, ["window", "follow", "hold", "step", "pace", "only forward"]),
        (False, 3.0, ["window", "follow", "hold", "step", "pace", "only forward"]),
    ],
)
def test_a_run_that_cannot_be_paused_or_paced_has_no_button_for_it(monkeypatch, held, pace, names):
    # The parameter widgets are expensive and not part of this bar.
    monkeypatch.setattr(Page, "_knob", lambda self, knob: None)
    monkeypatch.setattr(Page, "_write", lambda self: False)
    source, control = live(make(monkeypatch, plots=ONE), held=held, pace=pace)
    control.roles.clear()
    document, _ = page_of(source, control)
    bar = document.roots[0].children[1]
    assert [w.name for w in bar.children] == names
    assert {w.align for w in bar.children} == {"end"}
    if "pace" in names:
        assert named(document, "pace").value == ("full" if not pace else "3")
        assert named(document, "pace").options == [*PACES, *(["3"] if pace else [])]


def test_actions_on_a_page_become_requests_to_the_nodes_and_lines_as_expected(monkeypatch):
    asked, messages = [], []
    source, control = live(make(monkeypatch, plots=ONE), asked)
    control.goes_back = True
    control._now = lambda: 0.5
    document, page = page_of(source, control)

    lines = 0

    def after(what, answer=None):
        """The requests to the nodes and the lines on the pages, and what the page shows after the answers."""
        nonlocal lines
        messages.extend([what, *(f"  asks {request}" for request, _ in asked)])
        for _, answered in asked:
            answered(answer is None, answer or "")
        asked.clear()
        new, lines = control.lines - lines, control.lines
        messages.extend(
            f"  {s.t:g} s, {s.author}: {s.text}{' (wrong)' if s.wrong else ''}"
            for s in [*control.entries][-new:]
            if new
        )
        named(document, "echo").text = named(document, "beat").text
        page.update()

    def shows(*names):
        messages.extend(f"  {n} shows {number_or_text(getattr(named(document, n), 'value', None))}" for n in names)

    def press(name):
        named(document, name)._trigger_event(ButtonClick(named(document, name)))

    def types(name, text, answer=None):
        named(document, name).value = text
        after(f"{name}: types {text!r}", answer)
        shows(name)

    def switches(name, answer=None):
        named(document, name).active = not named(document, name).active
        after(f"{name}: switches", answer)
        messages.append(f"  {name} shows {named(document, name).active}")

    def slides(name, value):
        slider = named(document, f"{name} slider")
        slider.value = value
        slider.trigger("value_throttled", None, value)
        after(f"{name}: slides to {value}")
        shows(name, f"{name} slider")

    for text in ("2.5", "2.5", "5 m", "11"):
        types("law.k", text, "at most 10" if text == "11" else None)
    for text in ("41", "4.5"):
        types("law.steps", text)
    types("law.rule", "hard")
    types("law.weights", "[2, 0.5]")
    types("law.weights", "[2,")
    types("law.weights", "")
    types("tank.leak", "0.25")
    types("law.offset", "12345678901.0")
    switches("law.clip")
    switches("law.clip", "not now")
    slides("law.k", 7.5)
    slides("law.steps", 51.6)
    control.log_change(0.25, "law", {"steps": 4000, "rule": "soft"})
    after("somebody else turns")
    shows("law.steps", "law.rule")
    slider = named(document, "law.steps slider")
    messages.append(f"  its slider shows {slider.value} of {slider.start} to {slider.end}")
    for name in ("step", "hold", "hold", "law/flush"):
        press(name)
        after(f"presses {name}", None if name != "step" else "it runs")
        messages.append(
            f"  hold says {named(document, 'hold').label}; {named(document, 'state').text.partition('process')[2]}"
        )
    for pace in ("0.5", "full"):
        named(document, "pace").value = pace
        after(f"pace {pace}")
        messages.append(f"  {control.pace:g} {named(document, 'pace').value}")
    types("back to", "0.3")
    shows("back to slider")
    press("go back")
    after("goes back", None)
    for text in ("0", "6", "7", "x"):
        types("back to", text)
        shows("back to slider")
    press("go back")
    after("goes back", "expected a time")
    named(document, "back to slider").value = 1.25
    after("moves the line")
    shows("back to")
    messages.append(f"  the line is at {page._cursor.location:g}")
    check_expected("view/people", messages)


class Plain:
    """A drawing that prints what it receives."""

    title, trail, signals = "Tank", 0.1, ("tank/state/level/position", "tank/nowhere")

    def frame(self, now, past):
        times = f"{len(past)} before it from {past[0][self.signals[0]]:.4g}" if len(past) else "none before it"
        return f"{now.get(self.signals[0], math.nan):.4g}, {times}"


@pytest.fixture
def drawn(monkeypatch):
    """A page of one picture with a drawing, and the times at which it was drawn."""
    monkeypatch.setattr("softrig_bringup.view.page.drawing_for", lambda rig: Plain())
    monkeypatch.setattr("softrig_bringup.view.page.still", lambda drawing, frame, dark: f"{frame}{', dark' * dark}")
    return make(monkeypatch, plots=ONE, faults={})


def test_the_chosen_window_of_time_stays_until_somebody_moves_it(drawn):
    source, control = live(drawn)
    document, page = page_of(source, control)
    messages = []

    def now(what):
        named(document, "echo").text = named(document, "beat").text
        page.update()
        points = len(named(document, "Level: tank/state/level/position").data["x"])
        messages.append(
            f"{what}: {page.time.start:.6g} to {page.time.end:.6g} s, {points} points, "
            f"follows {named(document, 'follow').active}, window {named(document, 'window').value}"
        )

    now("at first")
    for end in (0.2, 8.0):
        source.end, source.version = end, source.version + 1
        now(f"up to {end:g} s")
    for window in ("2", "0.1", "10", "all"):
        named(document, "window").value = window
        messages.append(f"at once from {page.time.start:.6g} s")
        now(f"chosen {window}")
    page.time.start = 0.25
    now("moved")
    page.time.end = 0.3
    now("moved again")
    named(document, "follow").active = True
    now("follows again")
    named(document, "window").value = "wide"
    now("what no page of ours says")
    source.changes.append((0.15, "law", {"k": 1.0}))
    source.version += 1
    now("something changed")
    messages.append(f"changes at {named(document, 'changes').data['t']}")
    check_expected("view/window", messages)


def test_the_drawing_moves_in_equal_steps_between_updates(drawn):
    """Nodes send data four times a second and a page draws ten times: 0.04 s a frame for a step of 0.1 s."""
    source, control = live(drawn, end=2.5)
    document, page = page_of(source, control, look="dark")
    text = named(document, "drawing")
    # The frame shows the newest value received.
    assert (page._at, text.text) == (1.0, "1.456, 60 before it from 1.456, dark")
    source.end, page._at, page._ahead = 0.0, 0.0, 0.0
    at = []
    for end in (0.1, 0.1, 0.1, 0.1, 0.3, 0.3, 0.2):
        source.end = end
        named(document, "echo").text = named(document, "beat").text
        page.update()
        at.append(page._at)
    assert at == pytest.approx([0.04, 0.08, 0.1, 0.1, 0.18, 0.26, 0.2])
    assert text.text == "1.263, 60 before it from 1.141, dark"  # the level 2 - 0.97^n m after n controller periods
    source.end, source.outcome = 0.4, "ended"
    named(document, "echo").text = named(document, "beat").text
    page.update()
    assert page._at == 0.4
    assert named(document, "law.k").disabled


def test_a_browser_that_has_not_shown_the_last_state_gets_no_other(drawn):
    source, control = live(drawn)
    document, page = page_of(source, control)
    beat = named(document, "beat").text
    source.version += 1
    control.held = False
    for _ in range(3):
        page.update()
    assert (named(document, "beat").text, named(document, "hold").label) == (beat, "resume")
    named(document, "echo").text = beat
    page.update()
    assert (named(document, "beat").text, named(document, "hold").label) == ("2", "pause")
    named(document, "echo").text = "2"
    page.update()  # the first update draws
    named(document, "echo").text = "3"
    page.update()  # the second has nothing to draw
    assert named(document, "beat").text == "3"
    source.version += 1  # a new frame only, as the table is not due yet
    page.update()
    assert named(document, "beat").text == "5"


def test_tables_are_written_at_every_tenth_frame_and_after_a_new_line(drawn):
    source, control = live(drawn)
    document, page = page_of(source, control)
    written = []
    page._write = lambda: written.append(page._count) or False
    for k in range(2, 34):
        named(document, "echo").text = named(document, "beat").text
        if k == 5:
            control.add_entry("me", "hm")
        if k == 16:
            control.held = False
        if k == 25:
            control.pace = 2.0
        page.update()
    assert written == [5, 11, 16, 21, 25, 31]


def test_a_recording_is_played_at_its_pace_and_shows_its_values_at_the_cursor(drawn):
    source = Recorded(drawn, recorded(drawn), {})
    control = Control(drawn, None, lambda: source.end, lambda: source.outcome)
    document, page = page_of(source, control)
    line, play = named(document, "cursor"), named(document, "play")
    page.update()
    assert line.value == 0.0
    play.active = True
    results = []
    for pace, frames in (("1", 5), ("0.5", 2), ("full", 2), ("2", 2)):
        named(document, "pace").value = pace
        for _ in range(frames):
            page.update()
            results.append(line.value)
    # After the end, which stays visible for a while, the recording starts again.
    assert results == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.0, 0.05, 0.1, 0.104, 0.108, 0.308, 0.0])
    line.value = 0.2
    assert page._cursor.location == line.value
    assert named(document, "values").text == (
        '<h2>At 0.2 s</h2><table><tr><td>Level: level</td><td class="n">1.26258</td><td>m</td></tr></table>'
    )
    assert named(document, "drawing").text.startswith("1.263, ")


def test_a_drawing_that_fails_is_not_drawn_again(drawn, monkeypatch):
    def fails(self, now, past):
        raise ValueError("no <level>")

    monkeypatch.setattr(Plain, "frame", fails)
    empty = Recorded(drawn, Signals(Recording([])), {})
    document, page = page_of(empty, Control(drawn, None, lambda: 0.0, lambda: ""))
    assert named(document, "cursor").end == 1e-9
    text = "<p class=wrong>Tank: no drawing: ValueError(&#x27;no &lt;level&gt;&#x27;)</p>"
    assert named(document, "drawing").text == text
    monkeypatch.setattr(Plain, "frame", lambda *_: pytest.fail("it is asked again"))
    page._draw_plant(0.1)


def test_the_run_continues_without_a_page_that_cannot_be_made(rig):
    for held, names in ((True, ["resume", "pause"]), (None, [])):
        document, (_, control) = Document(), live(rig, asked := [], held=held)
        bare(document, control, "me", ValueError("a <b>"))
        text, *buttons = document.roots
        assert "<p>ValueError: a &lt;b&gt;</p>" in text.text
        assert [(b.name, b.label) for b in buttons] == [(n, n) for n in names]
        for b in buttons:
            b._trigger_event(ButtonClick(b))
        assert [r for r, _ in asked] == [{"node": "tank", "call": n} for n in names]


# its parts -----------------------------------------------------------------------------------------------------------


def test_the_role_of_a_node_follows_from_its_links(rig):
    expected = {"tank": "plant", "law": "law", "drift": "fault", "shaper": "command", "steps": "source",
                "watch": "observer"}  # fmt: skip
    assert {m.name: role(rig, m) for m in rig.members} == expected
    control = Control(rig, lambda *_: None, lambda: 0.0, lambda: "")
    assert list(control.roles) == ["law", "drift", "shaper", "watch", "steps", "tank"]
    assert sorted(control.buttons) == [("drift", "toggle"), ("law", "flush")]
    assert (control.held, control.pace) == (None, 0.0)
    bounds = {k.name: k.bounds for k in control.knobs.values() if k.node == "law"}
    assert bounds == {
        "k": (0, 10),
        "steps": (1, 5000),
        "offset": (-math.inf, math.inf),
        "at_least": (-5, math.inf),
        "at_most": (-math.inf, 7),
        "clip": (-math.inf, math.inf),
        "rule": (-math.inf, math.inf),
        "weights": (-math.inf, math.inf),
        "wide": (-3000, 1500),
    }
    nothing = Control(rig, None, lambda: 0.0, lambda: "")
    assert (nothing.knobs, nothing.roles, nothing.buttons) == ({}, {}, [])


KIND = {
    "held": None,
    "pace": None,
    "goes_back": False,
    "entries": (),
    "live": True,
    "outcome": "",
    "thinned": False,
    "end": 1.5,
    "awaited": [],
    "waited": 0.0,
    "speed": 1.0,
}


@pytest.mark.parametrize(
    ("more", "state", "look"),
    [
        ({}, "1.5 of 6 s, running", "soft"),
        ({"held": False}, "1.5 of 6 s, running", "soft"),
        ({"pace": 1.0}, "1.5 of 6 s, running", "soft"),
        ({"held": True}, "1.5 of 6 s, paused", "soft"),
        ({"held": True, "awaited": ["a", "b"], "waited": 2.6}, "1.5 of 6 s, starting for 3 s, waits for a, b", "soft"),
        ({"held": False, "pace": 0.0}, "1.5 of 6 s, running as fast as possible", "soft"),
        ({"held": False, "pace": 1.0}, "1.5 of 6 s, running at the wall's pace", "soft"),
        ({"held": False, "pace": 0.5, "speed": 0.0}, "1.5 of 6 s, running at 0.5 of the wall's pace", "soft"),
        ({"held": False, "pace": 2.0, "speed": 1.61}, "1.5 of 6 s, running at 2 of the wall's pace", "soft"),
        ({"held": False, "pace": 2.0, "speed": 1.6}, "1.5 of 6 s, running at 2 of the wall's pace", "soft"),
        (
            {"held": False, "pace": 2.0, "speed": 1.2345},
            "1.5 of 6 s, running at 2 of the wall's pace, of which this machine reaches 1.2",
            "soft",
        ),
        ({"thinned": True}, "1.5 of 6 s, running; older samples are reduced to their extremes", "soft"),
        ({"outcome": "ended"}, "the run is over: 1.5 s, ended; its knobs act no more", "over"),
        ({"outcome": "ended", "goes_back": True}, "the run is over: 1.5 s, ended; go back and turn a knob", "over"),
        ({"outcome": "recorded", "live": False}, "1.5 s, recorded", "soft"),
    ],
)
def test_the_head_shows_progress_and_state(more, state, look):
    about = SimpleNamespace(**KIND | more)
    about.rig = SimpleNamespace(scenario=SimpleNamespace(name="x_1", title="Mine", duration=6.0))
    result = words.head(about, "container", about).replace("&#x27;", "'")
    assert result == f'<h1>x_1</h1><p>Mine</p><p class="{look}">container: {state}</p>'


def test_the_head_shows_the_last_line_and_the_log_all_lines_newest_first():
    messages = [Entry(0.5, "me", "k = 1 <V>", False), Entry(12.3456789, "law", "no", True)]
    about = SimpleNamespace(**KIND | {"entries": messages})
    about.rig = SimpleNamespace(scenario=SimpleNamespace(name="x", title="Mine", duration=6.0))
    assert words.head(about, "here", about).endswith('</p><p class="wrong">law: no</p>')
    assert words.log(messages) == (
        '<h2>What was done</h2><table><tr><td class="n">12.3457 s</td><td>law</td><td class="wrong">no</td></tr>'
        '<tr><td class="n">0.5 s</td><td>me</td><td class="">k = 1 &lt;V&gt;</td></tr></table>'
    )


def test_missing_values_are_dashes():
    result = words.values({"a <b>": (1234567.0, "m^2"), "c": (None, ""), "d": (math.nan, "s")}, 0.1234567)
    assert result == (
        '<h2>At 0.123457 s</h2><table><tr><td>a &lt;b&gt;</td><td class="n">1.23457e+06</td><td>m²</td></tr>'
        '<tr><td>c</td><td class="n">-</td><td></td></tr><tr><td>d</td><td class="n">-</td><td>s</td></tr></table>'
    )


@pytest.mark.parametrize(
    ("kind", "value", "text", "result"),
    [
        (str, "soft", "hard: 1", "hard: 1"),
        (float, 1.0, "2", 2.0),
        (float, None, "1e-3", 0.001),
        (int, 3, "4", 4),
        (int, 3, "4.0", "expected a whole number"),
        (float, 3.0, "4 m", "expected a number, such as 2.5 or 1e-3"),
        (float, [1.0], "[1, 2]", [1, 2]),
        (tuple, (1.0,), "", "expected a value"),
    ],
)
def test_typed_values_are_read_by_the_type_of_the_parameter(kind, value, text, result):
    knob = Knob("n", "p", "", "", value, kind, (-math.inf, math.inf))
    assert knob.key == "n.p"
    if isinstance(result, str) and kind is not str:
        with pytest.raises(ScenarioError, match=rf"^n\.p.*{result}$"):
            knob.read(text)
    else:
        assert (knob.read(text), type(knob.read(text))) == (result, type(result))


def test_a_hundred_lines_are_kept_and_all_are_counted(rig):
    control = Control(rig, None, lambda: 0.25, lambda: "")
    for k in range(103):
        control.add_entry("me", str(k))
    assert [s.text for s in control.entries] == [str(k) for k in range(3, 103)]
    assert (control.lines, control.entries[0]) == (103, Entry(0.25, "me", "3", False))
    control.log_change(0.5, "law", {"k": 2.0, "unknown": 1})
    assert control.lines == 105
    assert control.entries[-2] == Entry(0.5, "law", "k = 2 from this tick on", False)


def test_pictures_of_a_scenario_without_plots_are_those_of_its_topics(monkeypatch):
    made = plots_of(make(monkeypatch, plots=[], faults={}))
    assert {p.title: list(p.signals) for p in made} == {
        "tank/command": ["tank/command/inlet/effort"],
        "tank/state": ["tank/state/level/position", "tank/state/level/velocity"],
        "tank/wave": ["tank/wave/x", "tank/wave/y", "tank/wave/z"],
        "tank/rain": ["tank/rain/data"],
        "flush": ["flush/data"],
        "tank/wanted": ["tank/wanted/level/position"],
        "tank/asked": ["tank/asked/level/position"],
    }


def test_texts_are_readable_in_light_and_dark():
    """By the rule of WCAG: contrast of at least 4.5 with the background for letters, 3 for colours of curves."""

    def light(colour):
        parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
        parts = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
        return 0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2]

    def contrast(a, b):
        low, high = sorted((light(a), light(b)))
        return (high + 0.05) / (low + 0.05)

    for name, paper in look.PAPER.items():
        assert min(contrast(c, paper) for c in (look.INK[name], look.SOFT[name], look.CHANGED[name])) >= 4.5
        assert [c for c in look.COLOURS[name] if contrast(c, paper) < 2.2] == []


@pytest.mark.parametrize(
    ("ask", "over", "why"), [(None, "", "this is a recording"), (print, "broke", "the run is over (broke)")]
)
def test_an_impossible_request_is_refused_by_name(rig, ask, over, why):
    control = Control(rig, ask, lambda: 0.25, lambda: over, True, 1.0)
    control.knobs["law.k"] = Knob("law", "k", "m", "", 3.0, float, (0.0, 10.0))
    acts = {
        "law.k = 4": lambda: control.turn("me", "law.k", 4),
        "law/flush": lambda: control.press("me", "law", "flush"),
        "step": lambda: control.hold("me", "step"),
        "pace 2": lambda: control.go_at("me", 2.0),
        "as fast as it goes": lambda: control.go_at("me", 0.0),
    }
    for text, act in acts.items():
        act()
        assert control.entries[-1] == Entry(0.25, "me", f"{text} refused: {why}", True)
    assert (control.held, control.pace, control.knobs["law.k"].value) == (True, 1.0, 3.0)


def test_a_page_resumes_its_session_by_reloading_itself(drawn):
    document, _ = page_of(*live(drawn))
    assert document.template is look.TEMPLATE
    calls = {name: [c.code for c in result] for name, result in document.callbacks._js_event_callbacks.items()}
    assert calls == {"document_ready": ["echo.text = beat.text"], "connection_lost": [look.RECONNECT]}
    sheets = {name: [s.css for s in named(document, name).stylesheets] for name in ("state", "law.k")}
    assert sheets == {"state": [look.WIDGETS], "law.k": [look.WIDGETS, look.BESIDE]}
    assert document.theme._json == look.theme("light")
    assert (document.config.reconnect_session, document.config.notify_connection_status) == (False, False)


def test_a_curve_has_at_most_four_points_a_column_of_pixels(monkeypatch):
    rig = make(monkeypatch, plots=PLOTS[2:], faults={})
    (picture,) = [Picture(entry, rig, Range1d(), Span(), ColumnDataSource(), "light") for entry in plots_of(rig)]
    angle = np.linspace(0.0, 6.0, 6001)
    columns = {"x": np.cos(angle), "y": np.sin(angle), "z": 0.0 * angle}
    picture.show(Pane({"tank/wave": Table(angle, angle, columns)}), 6.0)
    (source,) = picture.sources.values()
    assert len(source.data["x"]) == 2001  # every third sample
    assert np.array_equal(source.data["y"], np.sin(angle)[::3])
    picture.show(Pane({"tank/wave": Table(angle[:1999], angle[:1999], {k: x[:1999] for k, x in columns.items()})}), 6.0)
    assert len(source.data["x"]) == 1999
    assert picture.values(Pane({})) == {}


def test_light_and_dark_style_are_as_expected():
    attrs = {name: look.theme(name)["attrs"] for name in ("light", "dark")}
    messages = [f"{name} {kind}: {shown}" for name, kinds in attrs.items() for kind, shown in kinds.items()]
    messages += [f"{name} curves: {' '.join(colours)}" for name, colours in look.COLOURS.items()]
    check_expected("view/look", messages)
