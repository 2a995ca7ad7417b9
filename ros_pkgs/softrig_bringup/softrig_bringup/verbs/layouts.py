"""The verb `layouts`: files with which PlotJuggler, Foxglove and RViz show a scenario, made from its plots.

Only Foxglove has a Python library for its layouts, foxglove-sdk: 19 MB in place of 35 lines.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import indent, tostring

from softrig_core import Port, Rig, ScenarioError, rig_of
from softrig_core.block.scene import scene_of
from softrig_core.guard import replace
from softrig_core.judge.units import pretty_unit
from softrig_core.rig.members import signal_units
from softrig_core.wire.signals import topic_of

from ..page.html import e
from ..plots.curves import check_plots
from ..plots.style import COLOURS, axis_title
from ..view.rviz import rviz_file, seen

_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
_POINT = {"position": "positions", "velocity": "velocities", "acceleration": "accelerations", "effort": "effort"}
_STREAM = "ROS2 Topic Subscriber"


def layouts(options: argparse.Namespace) -> int:
    """Write the files; returns the exit status."""
    texts = {name: text for scenario in options.scenarios for name, text in files(rig_of(scenario)).items()}
    options.out.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        replace(options.out / name, text)
        print(options.out / name)
    return 0


def files(rig: Rig) -> dict[str, str]:
    """Return the layouts of a rig by file name.

    Parameters
    ----------
    rig : Rig
        Each plot of its scenario becomes a plot a unit, with the same signals; of a difference both are shown.

    Returns
    -------
    dict of str to str
        ``NAME.plotjuggler.xml`` and ``NAME.foxglove.json``; ``NAME.rviz`` where a robot or markers are to be seen.

    Raises
    ------
    ScenarioError
        The scenario has no plots, or one with a signal that the rig does not have.
    """
    if not rig.scenario.plots:
        raise ScenarioError(f"{rig.scenario.name} has no plots, from which layouts are made: expected `plots` in it")
    name, shown = rig.scenario.name, list(_plots(rig))
    results = {f"{name}.plotjuggler.xml": _plotjuggler(shown), f"{name}.foxglove.json": _foxglove(shown, rig)}
    return results | ({f"{name}.rviz": rviz_file(rig)} if any(seen(rig)) else {})


@dataclass(frozen=True)
class Plotted:
    """A plot of one unit.

    Parameters
    ----------
    title : str
        With the unit.
    unit : str
        Of all curves, as people read it; empty for a number without one.
    over : str
        Label of the value on the x axis, of the same topic; empty for time.
    """

    title: str
    unit: str
    curves: tuple[tuple[str, Port, str, str], ...]
    over: str = ""


def _plots(rig: Rig) -> Iterator[Plotted]:
    check_plots(rig)
    units = signal_units(rig)
    for entry in rig.scenario.plots:
        rows: dict[str, dict[str, str]] = {}
        for name, label in entry.signals.items():
            for signal in name.split(" - ", 1):
                rows.setdefault(units[signal], {}).setdefault(signal, label if signal == name else "")
        for unit, row in rows.items():
            topics = {name: topic_of(name, rig.topics) for name in row}
            curves = tuple((t, rig.topics[t], name[len(t) + 1 :], row[name]) for name, t in topics.items())
            yield Plotted(axis_title(entry.title, unit), pretty_unit(unit), curves, entry.x)


def _plotjuggler(plots: Sequence[Plotted]) -> str:
    """Write one tab for each plot; PlotJuggler names the signals of a JointState by their channels."""
    tabs = []
    for plot in plots:
        curves = []
        for k, (topic, port, label, _) in enumerate(plot.curves):
            name, colour = _series(topic, port, label), COLOURS[k % len(COLOURS)]
            xy = {"curve_x": _series(topic, port, plot.over), "curve_y": name} if plot.over else {}
            curves.append(e("curve", name=name, color=colour, **xy))
        mode = "XYPlot" if plot.over else "TimeSeries"
        drawn = e("plot", e("limitY"), *curves, mode=mode, style="Lines", flip_x="false", flip_y="false")
        split = e("DockSplitter", e("DockArea", drawn, name=plot.title), orientation="-", sizes="1", count="1")
        tabs.append(e("Tab", e("Container", split), tab_name=plot.title, containers="1"))
    topics = dict.fromkeys(f"/{topic}" for plot in plots for topic, *_ in plot.curves)
    stream = e("plugin", e("use_header_stamp", value="true"), e("selected_topics", value=";".join(topics)), ID=_STREAM)
    window = e("tabbed_widget", *tabs, e("currentTabIndex", index="0"), name="Main Window", parent="main_window")
    root = e(
        "root",
        window,
        e("use_relative_time_offset", enabled="1"),
        e("Plugins", stream),
        e("previouslyLoaded_Streamer", name=_STREAM),
    )
    indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + tostring(root, "unicode") + "\n"


def _foxglove(plots: Sequence[Plotted], rig: Rig) -> str:
    """Write one panel for each plot, one below the other; two columns from five plots on. Panels in 3D are first."""
    panels: dict[str, dict[str, Any]] = {}
    scene = next((s for m in rig.members if (s := scene_of(m.block_class, m.params)) is not None), None)
    if scene is not None:
        panels["3D!robot"] = {"followTf": scene.base, "topics": {"/robot_description": {"visible": True}}}
    for number, plot in enumerate(plots, 1):
        paths = [_path(topic, port, label, text, plot.unit) for topic, port, label, text in plot.curves]
        axis: dict[str, Any] = {"xAxisVal": "timestamp"}
        if plot.over:
            topic, port, *_ = plot.curves[0]
            over = _path(topic, port, plot.over, "", "")
            axis = {"xAxisVal": "custom", "xAxisPath": {"value": over["value"], "enabled": True}}
        panels[f"Plot!plot{number:02d}"] = {
            "title": plot.title,
            "foxglovePanelTitle": plot.title,
            "paths": paths,
            "showXAxisLabels": True,
            "showYAxisLabels": True,
            "showLegend": True,
            "legendDisplay": "floating",
            "isSynced": True,
            **axis,
        }
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _arranged(list(panels)),
    }
    return json.dumps(layout, indent=1, ensure_ascii=False) + "\n"


def _arranged(names: Sequence[str]) -> Any:
    if len(names) > 4:
        half = (len(names) + 1) // 2
        return {"direction": "row", "first": _column(names[:half]), "second": _column(names[half:])}
    return _column(names)


def _column(names: Sequence[str]) -> Any:
    if len(names) == 1:
        return names[0]
    return {
        "direction": "column",
        "first": names[0],
        "second": _column(names[1:]),
        "splitPercentage": round(100.0 / len(names), 1),
    }


def _path(topic: str, port: Port, label: str, text: str, unit: str) -> Mapping[str, Any]:
    """Return a message path, with the time of the header where there is one, and the unit in its legend."""
    stamp = "headerStamp" if port.stamped else "receiveTime"
    return {
        "value": f"/{topic}.{_message_path(port, label)}",
        "enabled": True,
        "timestampMethod": stamp,
        "label": f"{text or label} ({unit})" if unit else text or label,
    }


def _message_path(port: Port, label: str) -> str:
    """Return where a value is in its message: ``position[0]``, ``points[0].velocities[0]``, ``vector.x``."""
    head, _, last = label.rpartition("/")
    if port.type.named:
        index = port.channels.index(head)
        return f"points[0].{_POINT[last]}[{index}]" if port.msgtype == _TRAJECTORY else f"{last}[{index}]"
    if port.type.shaped:
        return f"data[{port.labels.index(label)}]"
    if not head and label in ("x", "y", "z"):
        return f"vector.{label}"
    kind = port.msgtype.rpartition("/")[2]
    within = {"WrenchStamped": "wrench.", "PoseStamped": "pose."}.get(kind, "")
    return within + label.replace("/", ".")


def _series(topic: str, port: Port, label: str) -> str:
    """Return the name of PlotJuggler's series: channel before field of a JointState, else the place in the message."""
    if port.type.named and port.msgtype != _TRAJECTORY:
        return f"/{topic}/{label}"
    return f"/{topic}/{_message_path(port, label).replace('.', '/')}"
