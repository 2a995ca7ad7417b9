"""The first picture of the README: a robot in motion beside its curves, and a terminal in which its run is repeated."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock
from xml.etree.ElementTree import Element, fromstring, tostring

import numpy as np
from softrig_bags.read import signals
from softrig_bringup.cli import main
from softrig_bringup.film.film import FRAMES, film
from softrig_bringup.film.smil import animated
from softrig_bringup.film.svg import number, points, root
from softrig_bringup.page.html import e
from softrig_core import rig_of
from softrig_core.drawing import drawing_for
from softrig_core.wire.signals import Signal

SCENARIO, START, END, SPEED = "rehab_impedance_r5", 5.0, 17.0, 2.0
SECONDS = (END - START) / SPEED  # duration of the film
FILE = "first_run.svg"
MONO = "font-family:ui-monospace,'DejaVu Sans Mono',Menlo,Consolas,monospace"
WIDTH, HEIGHT, FILM, LEFT, RIGHT = 960.0, 560.0, 470.0, 536.0, 940.0
DEGREES = 180.0 / np.pi
# For each curve: signal, factor, role and label; for each picture: signals, unit, place and axis.
HIP = [
    ("reference/hip/position", DEGREES, "reference", "reference"),
    ("joint_states/hip/position", DEGREES, "accent", "hip of the robot"),
]
FORCE = [("patient_force/force/x", 1.0, "second", "force of the patient")]
PLOTS = ((HIP, "deg", 34.0, 206.0, (-50.0, 150.0, 50.0)), (FORCE, "N", 246.0, 300.0, (0.0, 20.0, 10.0)))


def draw(folder: Path) -> None:
    """Run the scenario, pack it, repeat it, and draw the result."""
    with TemporaryDirectory() as work, chdir(work):
        ran = _typed("run", SCENARIO, "--mode", "container", "--no-plots")
        packed = _typed("pack", f"runs/{SCENARIO}")
        again = _typed("run", "--like", f"{SCENARIO}.softrig.zip", "--mode", "container", "--no-plots")
        result = signals(Path("runs") / SCENARIO / "bag")
    rows = [line for line in ran if line.endswith(("pass", "unit"))][:4]
    assert "number for number" in again[-1], again
    lines = [
        ("$", f"scripts/softrig run {SCENARIO} --mode container"),
        *(("", row) for row in rows),
        ("$", f"scripts/softrig pack runs/{SCENARIO}"),
        ("", packed[0]),
        ("$", f"scripts/softrig run --like {SCENARIO}.softrig.zip --mode container        # on another machine"),
        ("!", again[-1]),
    ]
    drawing = drawing_for(rig_of(SCENARIO))
    assert drawing is not None
    text = animated(film(drawing, result, START, END, SPEED)).replace(' xmlns="http://www.w3.org/2000/svg"', "")
    moving = fromstring(text)
    _, _, wide, high = (float(x) for x in moving.get("viewBox", "").split())
    moving.set("width", number(FILM))
    moving.set("height", number(FILM * high / wide))
    clip = e("clipPath", e("rect", _grow(), x=number(LEFT), y="0", width=number(RIGHT - LEFT), height="320"), id="past")
    parts = [part for plot in PLOTS for part in _plot(result, *plot)]
    title = "A leg in its rehabilitation robot gives way to the patient; the run repeats number for number elsewhere"
    picture = root((0.0, 0.0, WIDTH, HEIGHT), title, e("defs", clip), moving, *parts, *_terminal(lines, 336.0))
    (folder / FILE).write_text(tostring(picture, "unicode") + "\n")


def _typed(*words: str) -> list[str]:
    """Return the lines that a command prints, standard error last."""
    out, error = StringIO(), StringIO()
    with mock.patch.dict(os.environ, COLUMNS="100"), redirect_stdout(out), redirect_stderr(error):
        status = main(words)
    assert status == 0, error.getvalue()
    return [line.rstrip() for line in (*out.getvalue().splitlines(), *error.getvalue().splitlines())]


def _grow() -> Element:
    return e(
        "animate",
        attributeName="width",
        values=f"0;{number(RIGHT - LEFT)}",
        dur=f"{SECONDS:g}s",
        repeatCount="indefinite",
    )


def _plot(
    result: Mapping[str, Signal],
    curves: list[tuple[str, float, str, str]],
    label: str,
    top: float,
    bottom: float,
    axis: tuple[float, float, float],
) -> list[Element]:
    low, high, step = axis

    def place(t: float, value: float) -> tuple[float, float]:
        return LEFT + (RIGHT - LEFT) * (t - START) / (END - START), bottom - (bottom - top) * (value - low) / (
            high - low
        )

    made: list[Element] = [e("text", label, x=number(LEFT), y=number(top - 9), class_="f-muted", **{"font-size": "13"})]
    for value in np.arange(low, high + 0.5 * step, step):
        _, y = place(START, value)
        made.append(e("polyline", points=points(((LEFT, y), (RIGHT, y))), class_="s-faint"))
        made.append(
            e(
                "text",
                f"{value:g}".replace("-", "−"),
                x=number(LEFT - 8),
                y=number(y + 4),
                class_="f-muted",
                **{"font-size": "12", "text-anchor": "end"},
            )
        )
    for ahead in range(0, round(END - START) + 1, 2) if bottom == PLOTS[-1][3] else ():
        x, _ = place(START + ahead, low)
        made.append(
            e(
                "text",
                f"{START + ahead:g}{' s' * (START + ahead == END)}",
                x=number(x),
                y=number(bottom + 16),
                class_="f-muted",
                **{"font-size": "12", "text-anchor": "middle"},
            )
        )
    beside = RIGHT
    for name, factor, role, text in reversed(curves):
        times, values = result[name]
        wanted = np.linspace(START, END, 241)
        shown = factor * values[np.maximum(np.searchsorted(times, wanted + 1e-9, side="right") - 1, 0)]
        track = tuple(place(a, b) for a, b in zip(wanted.tolist(), shown.tolist(), strict=True))
        dashed = " d" if role == "reference" else ""
        faint = e("polyline", points=points(track), fill="none", class_=f"s-{role}{dashed}", opacity="0.25")
        line = e(
            "polyline",
            points=points(track),
            fill="none",
            class_=f"s-{role}{dashed}",
            **{"stroke-width": "2", "clip-path": "url(#past)"},
        )
        made += [faint, line]
        if not dashed:
            made.append(_dot(track, role))
        made.append(
            e(
                "text",
                text,
                x=number(beside),
                y=number(top - 9),
                class_=f"f-{role}",
                **{"font-size": "13", "text-anchor": "end"},
            )
        )
        beside -= 8.0 * len(text) + 14.0
    return made


def _dot(track: tuple[tuple[float, float], ...], role: str) -> Element:
    every = track[:: max(1, round((len(track) - 1) / (SECONDS * FRAMES)))]
    moves = [
        e(
            "animate",
            attributeName=name,
            values=";".join(number(at[k]) for at in every),
            dur=f"{SECONDS:g}s",
            repeatCount="indefinite",
        )
        for k, name in enumerate(("cx", "cy"))
    ]
    return e("circle", *moves, cx=number(track[-1][0]), cy=number(track[-1][1]), r="4.5", class_=f"f-{role}")


def _terminal(lines: list[tuple[str, str]], top: float) -> list[Element]:
    """Return the typed and the printed lines; a prompt before the first, the output in its own colour."""
    made = [
        e(
            "rect",
            x="20",
            y=number(top),
            width=number(WIDTH - 40),
            height=number(HEIGHT - top - 16),
            rx="6",
            class_="f-faint",
        )
    ]
    for k, (mark, text) in enumerate(lines):
        y = top + 26.0 + 19.5 * k
        role = {"$": "line", "!": "third"}.get(mark, "muted")
        bold = {"font-weight": "bold"} if mark else {}
        shown = f"$ {text}" if mark == "$" else text
        style = {"font-size": "13", "xml:space": "preserve", "style": MONO} | bold
        made.append(e("text", shown, x="36", y=number(y), class_=f"f-{role}", **style))
    return made
