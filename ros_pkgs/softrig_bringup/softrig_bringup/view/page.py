"""One page: a document of Bokeh for one browser, made of pictures, tables, parameters and buttons."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    ColumnDataSource,
    CustomJS,
    Div,
    InlineStyleSheet,
    Range1d,
    Select,
    Slider,
    Span,
    TextInput,
    Toggle,
)
from bokeh.themes import Theme
from softrig_core import ScenarioError
from softrig_core.drawing import drawing_for
from softrig_core.verdict.result import Result

from ..film.film import PAST, rows
from ..film.svg import still
from . import words
from .control import Control, Knob
from .look import BESIDE, CHANGED, RECONNECT, TEMPLATE, WIDGETS, theme
from .pictures import Picture, plots_of
from .sources import Source

EVERY = 250  # ms: nodes pass on their recorded data four times a second
FRAME = 100  # ms between two states of a page; between them the drawing follows the data that have arrived
PACES = ("0.1", "0.5", "1", "2", "10", "full")  # simulated time divided by wall-clock time
WINDOWS = ("0.1", "0.5", "2", "10", "60", "all")  # s
WIDE = 20  # largest range of a slider, in multiples of the value (or of 1); beyond it the slider shows a part
HUGE = 1e9  # from here on numbers have an exponent, because fields are ten digits wide
SLOW = 10  # frames between two states of the tables
WHAT = {"law": "", "fault": "fault"}  # text beside the name of a node, by its role; for other roles the role itself


class Page:
    """The page shown in one browser.

    Parameters
    ----------
    figures : callable
        Returns the newest figures, and whether they are provisional.
    author : str
        Name of this browser on all pages.
    how : str
        Mode and placement of the run.
    look : {"light", "dark"}
    """

    def __init__(
        self,
        document: Document,
        source: Source,
        control: Control,
        figures: Callable[[], tuple[Sequence[Result], bool]],
        author: str,
        how: str,
        look: str,
    ) -> None:
        self._source, self._control, self._figures = source, control, figures
        self._author, self._how = author, how
        self._sheet, self._narrow_sheet = InlineStyleSheet(css=WIDGETS), InlineStyleSheet(css=BESIDE)
        self._calm = False  # whether changes of widgets come from this class
        self._shown: tuple[Any, ...] = ()
        self._texts: tuple[Any, ...] = ()
        self._shown_state: tuple[Any, ...] = ()
        self._count = 0
        # Of the drawing: time (s), s per frame, newest time of the data (s).
        self._at = self._speed = self._ahead = 0.0
        self._drawn_at = -1.0
        self.time = Range1d(0.0, source.length)
        self._cursor = Span(dimension="height", location=math.nan, line_color=CHANGED[look], line_width=1.5)
        self._changes = ColumnDataSource({"t": []}, name="changes")
        rig = source.rig
        self._pictures = [Picture(e, rig, self.time, self._cursor, self._changes, look) for e in plots_of(rig)]
        self._head = self._div("state")
        self._theme = look
        self._drawing, self._drawn = drawing_for(rig), self._div("drawing")
        self._tables = {name: self._div(name) for name in ("figures", "health", "log")}
        self._sliders: dict[str, Slider] = {}
        self._knobs = {key: self._knob(knob) for key, knob in control.knobs.items()}
        # A browser that has not shown the last state gets no further one: it skips pictures, and no queue grows.
        self._beat, self._echo = self._div("beat", visible=False), self._div("echo", visible=False)
        shown = CustomJS(args={"beat": self._beat, "echo": self._echo}, code="echo.text = beat.text")
        self._beat.js_on_change("text", shown)
        document.js_on_event("document_ready", shown)  # the page itself contains the first state
        self.time.on_change("start", self._moved)
        self.time.on_change("end", self._moved)
        top = [self._head, row(*self._bar(), sizing_mode="stretch_width", styles={"flex-wrap": "wrap"})]
        if not source.live:
            top.append(self._recorded())
        if control.goes_back:
            top.append(self._backwards())
        results = [f for p in self._pictures for f in p.figures]
        groups = self._groups()
        roots = {"head": column(*top, self._beat, self._echo, sizing_mode="stretch_width")}
        roots |= {"drawing": self._drawn} if self._drawing else {}
        roots |= {f"curve {k}": f for k, f in enumerate(results)} | {name: root for name, root, *_ in groups}
        roots["tables"] = column(*self._below(), sizing_mode="stretch_width")
        for name, root in roots.items():
            root.name = name
            document.add_root(root)
        document.template_variables.update(
            {
                "look": look,
                "drawn": self._drawing is not None,
                "curves": [name for name in roots if name[:5] == "curve"],
                "groups": [(name, title, heading, opened) for name, _, title, heading, opened in groups],
            }
        )
        # Bokeh alone would resume the session, which a restarted server does not know.
        document.config.update(reconnect_session=False, notify_connection_status=False)
        document.js_on_event("connection_lost", CustomJS(code=RECONNECT))
        document.theme = Theme(json=theme(look))
        document.template = TEMPLATE
        document.title = f"{rig.scenario.name} - softrig"
        document.add_periodic_callback(self.update, FRAME)

    # the parts of a page --------------------------------------------------------------------------------------------

    def _div(self, name: str, visible: bool = True) -> Div:
        return Div(name=name, visible=visible, sizing_mode="stretch_width", stylesheets=[self._sheet])

    def _slide(self, name: str, low: float, high: float, value: float, **how: Any) -> Slider:
        ends: dict[str, Any] = {"start": low, "end": high, "step": (high - low) / 1000, "value": value}
        return Slider(name=name, stylesheets=[self._sheet], sizing_mode="stretch_width", **ends | how)

    def _button(self, label: str, call: Callable[[], object], name: str = "", width: int | None = 90) -> Button:
        result = Button(label=label, name=name or label, stylesheets=[self._sheet], width=width)
        result.on_click(call)
        return result

    def _press(self, node: str, name: str) -> Button:
        def press() -> None:
            self._control.press(self._author, node, name)

        return self._button(f"{node}: {name}", press, f"{node}/{name}", width=None)  # as wide as its text

    def _bar(self) -> list[Any]:
        """Create the bar: window of time, follow; pause and step if the run can be paused."""
        sheet = [self._sheet]
        self._window = Select(
            title="window, s", value="all", options=list(WINDOWS), width=90, stylesheets=sheet, name="window"
        )
        self._follow = Toggle(label="follow", active=True, width=90, stylesheets=sheet, name="follow", align="end")
        self._window.on_change("value", self._again)
        self._follow.on_change("active", self._again)
        result: list[Any] = [self._window, self._follow]
        if self._control.held is not None and self._source.live:
            self._hold = self._button("pause", self._pause, "hold")
            result += [self._hold, self._button("step", lambda: self._control.hold(self._author, "step"))]
        if not self._source.live or (self._control.held is not None and self._control.pace is not None):
            now = _pace((self._control.pace or 0.0) if self._source.live else 1.0)
            paces = [*PACES, *([] if now in PACES else [now])]
            self._pace = Select(title="pace", value=now, options=paces, width=90, stylesheets=sheet, name="pace")
            if self._source.live:
                self._pace.on_change("value", self._go)
            result.append(self._pace)
        if self._source.live and not self._control.goes_back:
            nodes = self._div("only forward")
            nodes.text = "<p class=soft>nodes only go on; with <code>--mode inprocess</code> a run goes back, too</p>"
            result.append(nodes)
        for widget in result:
            widget.align = "end"
        return result

    def _recorded(self) -> Any:
        """Create a time cursor, and the widget that moves it."""
        end = max(self._source.end, 1e-9)
        self._slider = self._slide("cursor", 0.0, end, 0.0, title="t, s", format="0.000000")
        self._slider.on_change("value", lambda attr, old, new: self._point())
        self._play = Toggle(label="play", width=90, stylesheets=[self._sheet], name="play", align="end")
        return row(self._slider, self._play, sizing_mode="stretch_width")

    def _backwards(self) -> Any:
        """Create the widgets to go back to a time, typed or moved to, with its line in the pictures."""
        sheet = [self._sheet]
        self._to = TextInput(title="t, s", value="0", width=90, name="back to", stylesheets=sheet, align="end")
        self._along = self._slide("back to slider", 0.0, self._source.length, 0.0, show_value=False, align="end")
        self._along.on_change("value", lambda attr, old, new: self._calm or self._to.update(value=f"{new:.6g}"))
        self._to.on_change("value", lambda attr, old, new: self._aim())
        button = self._button("go back", self._go_back)
        button.align = "end"
        return row(self._to, button, self._along, sizing_mode="stretch_width")

    def _below(self) -> list[Any]:
        if not self._source.live:
            self._values = self._div("values")
        return [*([] if self._source.live else [self._values]), *self._tables.values()]

    def _groups(self) -> list[tuple[str, Any, str, str, bool]]:
        """Return the buttons, and the parameters by node: name of the root, root, title, other widgets, whether
        it is open.
        """
        control, result = self._control, []
        if control.buttons:
            buttons = row(*(self._press(*b) for b in control.buttons), styles={"flex-wrap": "wrap"})
            result.append(("buttons", buttons, "Buttons", "", True))
        first = next(iter(control.roles.values()), "")
        for node, role in control.roles.items():
            knobs = [knob for knob in control.knobs.values() if knob.node == node]
            used, idle = [k for k in knobs if not k.idle], [k for k in knobs if k.idle]
            heading = f"{WHAT.get(role, role)} {len(used)}".strip()
            result.append((f"knobs {node}", self._group(used), node, heading, role in (first, "law", "fault")))
            if idle:
                result.append((f"idle {node}", self._group(idle), node, f"not used by this choice {len(idle)}", False))
        return result

    def _group(self, knobs: Sequence[Knob]) -> Any:
        widgets = [w for k in knobs for w in (self._knobs[k.key], self._sliders.get(k.key)) if w is not None]
        return column(*widgets, sizing_mode="stretch_width")

    def _knob(self, knob: Knob) -> Any:
        """Return the widget of a parameter; a value that is not a number, switch or text is written as YAML."""
        title = f"{knob.name}{f', {knob.unit}' if knob.unit else ''}"
        about: dict[str, Any] = {"name": knob.key, "stylesheets": [self._sheet], "sizing_mode": "stretch_width"}
        if knob.kind is bool:
            result: Any = Toggle(label=title, active=bool(knob.value), **about)
            result.on_change("active", lambda attr, old, new: self._turned(knob, new))
            return result
        if knob.number and (ends := reach(knob)) is not None:
            self._sliders[knob.key] = self._slider_of(knob, *ends)
        title += _range(knob)
        about["stylesheets"] = [self._sheet, self._narrow_sheet]
        result = TextInput(title=title, value=_text(knob.value), description=knob.doc or None, **about)
        result.on_change("value", lambda attr, old, new: self._turned(knob, new))
        return result

    def _slider_of(self, knob: Knob, low: float, high: float) -> Slider:
        """Return the slider of a number; its value counts when it is released."""
        step = max(1, round((high - low) / 1000)) if knob.kind is int else (high - low) / 1000
        result = self._slide(f"{knob.key} slider", low, high, knob.value, step=step, show_value=False)
        result.on_change("value_throttled", lambda attr, old, new: self._turned(knob, knob.kind(new)))
        return result

    # what people do ------------------------------------------------------------------------------------------------

    def _turned(self, knob: Knob, value: Any) -> None:
        if self._calm:
            return
        try:
            value = knob.read(value) if isinstance(value, str) else value
            if value != knob.value:
                self._control.turn(self._author, knob.key, value)
        except ScenarioError as error:
            self._control.add_entry(self._author, str(error), True)
        self._texts = ()

    def _aim(self) -> float:
        """Return the time to go back to, s; NaN if the typed text is not a time."""
        try:
            t = float(self._to.value)
        except ValueError:
            t = math.nan
        self._cursor.location, self._calm = t, True
        if self._along.start <= t <= self._along.end:
            self._along.value = t
        self._calm = False
        return t

    def _go_back(self) -> None:
        self._control.go_back(self._author, self._aim())
        self._shown = self._texts = ()

    def _pause(self) -> None:
        self._control.hold(self._author, "resume" if self._control.held else "pause")

    def _go(self, attr: str, old: Any, new: Any) -> None:
        if not self._calm and new in self._pace.options:
            self._control.go_at(self._author, 0.0 if new == "full" else float(new))
            self._texts = ()

    def _moved(self, attr: str, old: Any, new: Any) -> None:
        """Show the window that a browser has chosen by zooming or moving, until it follows again."""
        if not self._calm:
            self._set_follow(False)

    def _again(self, attr: str, old: Any, new: Any) -> None:
        if not self._calm:
            self._set_follow(True)
            self.update()

    def _set_follow(self, active: bool) -> None:
        self._calm = True
        self._follow.active = active
        self._calm = False
        self._shown = ()

    def _point(self) -> None:
        """Show the values at the cursor."""
        t = float(self._slider.value)
        self._cursor.location = t
        pane = self._source.pane(t, t)
        named: dict[str, tuple[float | None, str]] = {}
        for picture in self._pictures:
            named |= picture.values(pane)
        self._values.text = words.values(named, t)
        self._draw_plant(t)

    def _draw_plant(self, t: float) -> None:
        """Draw the plant as it is at a time, s."""
        drawing = self._drawing
        if drawing is None:
            return
        pane = self._source.pane(t - drawing.trail, t)
        known = {name: pane[name] for name in drawing.signals if name in pane}
        past = rows(known, np.linspace(max(0.0, t - drawing.trail), t, PAST)) if drawing.trail and known else ()
        try:
            now = rows(known, np.array([t]))[0] if known else {}  # the drawing is at rest before the first data
            self._drawn.text = still(drawing, drawing.frame(now, past), self._theme == "dark")
        except Exception as error:  # a drawing of a user's plant may fail; the page continues without it
            self._drawing = None
            self._drawn.text = f"<p class=wrong>{drawing.title}: no drawing: {html.escape(repr(error))}</p>"

    def _moving(self) -> float:
        """Return the time of the drawing, s: data that arrived together is shown as slowly as it was simulated."""
        end = self._source.end
        if end != self._ahead:
            self._speed, self._ahead = max(0.0, end - self._at) * FRAME / EVERY, end
        self._at = end if self._source.outcome else min(end, self._at + self._speed)
        return self._at

    # what is shown -------------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Show new data, if the browser has shown the last state."""
        source = self._source
        if not source.live and self._play.active:
            pace = self._pace.value
            step = self._slider.end / 100 if pace == "full" else float(pace) * FRAME / 1000
            following = self._slider.value + step
            self._slider.value = 0.0 if following > self._slider.end else following
        if self._beat.text != self._echo.text:
            return
        self._calm = True
        try:
            try:
                changed = self._draw()
            except (ValueError, TypeError, ArithmeticError):  # a request for a window that this page does not offer
                self._window.value, self._follow.active = "all", True
                changed = self._draw()
            self._count += 1
            state = (self._control.lines, self._control.held, self._control.pace)
            if self._count % SLOW == 1 or source.outcome or state != self._shown_state:
                self._shown_state = state
                changed = self._write() or changed
        finally:
            self._calm = False
        if changed:
            self._beat.text = str(self._count)

    def _draw(self) -> bool:
        source = self._source
        if self._follow.active:
            first, last = 0.0, max(source.length, source.end)
            if self._window.value != "all":
                last = max(source.end, float(self._window.value))
                first = last - float(self._window.value)
            self.time.update(start=first, end=last)
        first, last = float(self.time.start), float(self.time.end)
        now = (source.version, first, last)
        moment = min(last, self._moving()) if source.live else float(self._slider.value)
        if moved := moment != self._drawn_at:
            self._drawn_at = moment
            self._draw_plant(moment)
        if now == self._shown:
            return moved
        self._shown = now
        pane, end = source.pane(first, min(last, source.end)), min(last, source.end)
        for picture in self._pictures:
            picture.show(pane, end)
        if (changes := [t for t, _, _ in source.changes]) != list(self._changes.data["t"]):
            self._changes.data = {"t": changes}
        self._head.text = words.head(source, self._how, self._control)
        return True

    def _write(self) -> bool:
        source, control = self._source, self._control
        results, so_far = self._figures()
        texts = (
            words.figures(results, so_far),
            words.health(source.status),
            words.log(control.entries),
            words.head(source, self._how, control),
            tuple(repr(k.value) for k in control.knobs.values()),
            control.held,
            control.pace,
            source.outcome,
        )
        if texts == self._texts:
            return False
        self._texts = texts
        for div, text in zip(self._tables.values(), texts, strict=False):
            if div.text != text:
                div.text = text  # type: ignore[assignment]
        for key, knob in control.knobs.items():
            widget = self._knobs[key]
            if knob.kind is bool:
                widget.active = bool(knob.value)
            else:
                widget.value = _text(knob.value)
            widget.disabled = bool(source.outcome)
            if (slider := self._sliders.get(key)) is not None and slider.value != knob.value:
                if not slider.start <= knob.value <= slider.end and (ends := reach(knob)) is not None:
                    slider.update(start=ends[0], end=ends[1])
                slider.value = knob.value
        if control.held is not None and source.live:
            self._hold.label = "resume" if control.held else "pause"
            if control.pace is not None:
                self._pace.value = _pace(control.pace)
        self._head.text = texts[3]
        return True


def bare(document: Document, control: Control, author: str, error: Exception) -> None:
    """Show a page without the rig's widgets, with the reason and how the run continues."""
    why = html.escape(f"{type(error).__name__}: {error}")
    document.add_root(Div(text=f"<h1>This page cannot be shown</h1><p>{why}</p><p>The run does not depend on it.</p>"))
    for action in ("resume", "pause") if control.held is not None else ():
        button = Button(label=action, name=action)
        button.on_click(lambda action=action: control.hold(author, action))
        document.add_root(button)


def reach(knob: Knob) -> tuple[float, float] | None:
    """Return the ends of a slider: the declared bounds, or values near the present one if they are far away; None for
    no slider.
    """
    low, high, value = *knob.bounds, knob.value
    if value is None or math.isinf(high - low):
        return None
    if not value:
        return (low, high) if high - low <= WIDE else None
    far = high - low > WIDE * max(1.0, abs(value))
    return (max(low, value - 3 * abs(value)), min(high, value + 3 * abs(value))) if far else (low, high)


def _range(knob: Knob) -> str:
    low, high = knob.bounds
    if math.isinf(low) and math.isinf(high):
        return ""
    if math.isinf(high):
        return f" (at least {low:g})"
    return f" (to {high:g})" if math.isinf(low) else f" ({low:g} to {high:g})"


def _pace(pace: float) -> str:
    return f"{pace:g}" if pace else "full"


def _text(value: Any) -> str:
    if isinstance(value, float) and abs(value) >= HUGE and float(f"{value:g}") == value:
        return f"{value:g}"
    return "" if value is None else str(value)
