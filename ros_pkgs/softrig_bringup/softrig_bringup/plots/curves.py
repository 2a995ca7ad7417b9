"""The curves of a run: signals by name, as a picture shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from softrig_core import Array, Port, Rig, ScenarioError, Signals
from softrig_core.block.port import XYZ
from softrig_core.errors import closest
from softrig_core.rig.members import signal_units
from softrig_core.scenario.plot_entry import PlotEntry
from softrig_core.wire.long import gathered, stretches
from softrig_core.wire.signals import short_name, topic_of

from .named import Shown

_PIXELS = 1100  # columns that a long signal is reduced to
LONG = 1 << 18  # samples beyond which a curve over time is reduced already when it is made
_AXES = {"alpha_beta": ("α", "β", "0"), "dq": ("d", "q", "0"), "abc": ("a", "b", "c")}


@dataclass(frozen=True)
class Curve:
    """One line of a picture.

    Parameters
    ----------
    x, y : float arrays of shape (n,)
    held : bool
        The value stays until the next sample: drawn as steps.
    reference : bool
        Drawn as a thin dark dashed line on top.
    signal : str
        Name of the signal that it shows; empty for a difference.
    ink : float, optional
        Of a curve that `reduced` has made: how far the signal moves in all.
    logic : bool
        Of such a curve: whether the signal is 0 or 1 everywhere.
    """

    label: str
    unit: str
    x: Array
    y: Array
    held: bool = False
    reference: bool = False
    signal: str = ""
    ink: float | None = None
    logic: bool = False


def with_plots(rig: Rig, title: str, names: Sequence[str], window: Sequence[float] | None) -> Rig:
    """Return a rig with one plot of some signals, or with its scenario's plots if none are named, in a window of time.

    Raises
    ------
    ScenarioError
        No such signal, or the scenario has no plots of its own.
    """
    shared = rig.scenario.shared  # signals by the names that formulas use
    names = [str(shared.get(name, name)) for name in names]
    entries = (PlotEntry(title=title, signals=dict.fromkeys(names, "")),) if names else rig.scenario.plots
    if not entries:
        known = ", ".join(signal_units(rig))
        raise ScenarioError(f"{rig.scenario.name} has no plots of its own; which signals? It has {known}")
    rig = rig.with_plots(tuple(p.model_copy(update={"window": tuple(window)}) if window else p for p in entries))
    check_plots(rig)
    return rig


def check_plots(rig: Rig) -> None:
    """Check that the rig has the signals of its scenario's plots.

    Raises
    ------
    ScenarioError
        A plot names a signal that the rig does not have.
    """
    known = signal_units(rig)
    for entry in rig.scenario.plots:
        if entry.x:
            names = list(entry.signals)
            names += [f"{topic_of(name, rig.topics)}/{entry.x}" for name in names if name in known]
        else:
            names = [signal for name in entry.signals for signal in name.split(" - ", 1)]
        wrong = next((name for name in names if name not in known), None)
        if wrong is not None:
            raise ScenarioError(
                f"plot {entry.title!r}: no signal {wrong!r}{closest(wrong, known)}; own `plots` replace all inherited "
                f"ones, `plots: []` leaves the overview; the rig has {', '.join(known)}"
            )


def envelope(x: Array, y: Array, columns: int = _PIXELS) -> tuple[Array, Array]:
    """Reduce a long signal to what is visible: first, lowest, highest and last value of each pixel column.

    Parameters
    ----------
    x, y : float arrays of shape (n,)
        x ascending.
    columns : int
        Width of the axes in pixels.

    Returns
    -------
    x, y : float arrays of shape (at most 4 columns + 4,)
        The signal itself if it is not longer than 4 columns; the last sample may be in a column of its own.
    """
    if len(x) <= 4 * columns:
        return x, y
    scale, groups = columns / (x[-1] - x[0]), list[Array]()
    # A long signal is read a stretch at a time: a row of a group is a column of pixels.
    for xs, ys in zip(stretches(x), stretches(y), strict=True):
        column = np.floor((xs - x[0]) * scale)
        starts = np.flatnonzero(np.diff(column, prepend=np.nan))
        ends = np.append(starts[1:], len(xs)) - 1
        lowest, highest = np.fmin.reduceat(ys, starts), np.fmax.reduceat(ys, starts)
        group = np.stack([column[starts], xs[starts], ys[starts], lowest, highest, xs[ends], ys[ends]])
        if groups and groups[-1][0, -1] == group[0, 0]:
            last, first = groups[-1][:, -1], group[:, 0]
            last[3:] = np.fmin(last[3], first[3]), np.fmax(last[4], first[4]), *first[5:]
            group = group[:, 1:]
        groups.append(group)
    _, first_x, first_y, lowest, highest, last_x, last_y = np.concatenate(groups, axis=1)
    middle = (first_x + last_x) / 2
    corners_x = np.stack([first_x, middle, middle, last_x], axis=1)
    corners_y = np.stack([first_y, lowest, highest, last_y], axis=1)
    return corners_x.ravel(), corners_y.ravel()


def logical(y: Array) -> bool:
    """Return whether a signal is 0 or 1 everywhere, as a switch is."""
    return bool(len(y) and np.isin(y, (0.0, 1.0)).all())


def inked(y: Array) -> float:
    """Return the total movement of a signal: the sum of its absolute changes."""
    return float(np.abs(np.diff(y)).sum())


def reduced(curve: Curve) -> Curve:
    """Return the part of a very long curve that a picture over time needs, so that the rest can leave memory."""
    if len(curve.x) <= LONG:
        return replace(curve, x=np.asarray(curve.x), y=np.asarray(curve.y))
    x, y = envelope(curve.x, curve.y)
    return replace(curve, x=x, y=y, ink=inked(curve.y), logic=logical(curve.y))


def inside(curve: Curve, window: tuple[float, float] | None) -> Curve:
    """Cut a curve to a time window and interpolate at its edges; no value from outside remains.

    Parameters
    ----------
    window : (float, float), optional
        First and last time, s; none leaves the curve as it is.
    """
    if window is None or not len(curve.x):
        return curve
    x, y = curve.x, curve.y
    first, last = max(window[0], x[0]), min(window[1], x[-1])
    if first > last:
        return replace(curve, x=x[:0], y=y[:0])
    chosen = slice(int(np.searchsorted(x, first, "right")), int(np.searchsorted(x, last)))
    edges = np.array([first, last])
    if curve.held:  # a held signal counts up to its last edge
        end = np.searchsorted(x, last) - 1 if first < last < x[-1] else np.searchsorted(x, last, "right") - 1
        ends = y[np.array([np.searchsorted(x, first, "right") - 1, end])]
    else:
        ends = np.array([_between(x, y, t) for t in edges])
    return replace(
        curve, x=np.concatenate([edges[:1], x[chosen], edges[1:]]), y=np.concatenate([ends[:1], y[chosen], ends[1:]])
    )


def _between(x: Array, y: Array, t: float) -> float:
    """Return the value at an instant, linear between the samples around it."""
    k = int(np.searchsorted(x, t))
    around = slice(max(k - 1, 0), k + 1)
    return float(np.interp(t, np.asarray(x[around]), np.asarray(y[around])))


class Source:
    """The curves of a run by signal name.

    Parameters
    ----------
    signals : Signals
        Of the run's recording.
    rig : Rig
        Provides the units, which topics are held between samples, and which are references.
    """

    def __init__(self, signals: Signals, rig: Rig) -> None:
        self.signals = signals
        self.topics = rig.topics
        self.units = signal_units(rig)
        self.held = _held_topics(rig)
        recorded = [t for t in self.topics if t in signals.recording.topics]
        self.published = [t for t in recorded if signals.recording.topics[t].number]
        self.silent = [t for t in recorded if t not in self.published and self.topics[t].labels]
        self.end = max((signals.table(t).t[-1] for t in self.published), default=0.0)

    def curve(self, name: str, label: str = "") -> Curve:
        """Return a signal over time; it has no points if nothing was published."""
        topic = self.topic(name)
        table = self.signals.table(topic)
        x, y = table.t, table.columns.get(name[len(topic) + 1 :], table.t[:0])
        held = topic in self.held
        if len(y) == 0:
            x = y
        elif held and x[-1] < self.end:
            x, y = np.append(x, self.end), np.append(y, y[-1])
        return Curve(
            label or self.short(name), self.units[name], x, y, held, _reference(self.topics[topic], label), name
        )

    def difference(self, first: str, second: str, label: str = "") -> Curve:
        """Return a signal less the newest value of another, at the samples of the first."""
        a, b = self.curve(first), self.curve(second)
        n = len(self.signals.table(self.topic(first)).t)  # the point that is appended to a held signal does not count
        k = int(np.searchsorted(a.x[:n], b.x[0])) if len(b.x) else n
        x, y = a.x[k:n], a.y[k:n]
        newest = np.searchsorted(b.x, x, side="right") - 1
        return Curve(label or f"{self.short(first)} - {self.short(second)}", a.unit, x, y - gathered(b.y, newest))

    def short(self, name: str) -> str:
        """Return the shortest name of a signal."""
        return short_name(name, self.units)

    def topic(self, name: str) -> str:
        """Return the topic of a signal."""
        return topic_of(name, self.topics)

    def names(self, topic: str) -> list[str]:
        """Return the signals of a topic."""
        return [f"{topic}/{label}" for label in self.topics[topic].labels]

    def axis(self, name: str) -> str:
        """Return the name of a signal beside its topic: the axis letter of its frame, or its label."""
        topic = self.topic(name)
        label = name[len(topic) + 1 :]
        return dict(zip(XYZ, _AXES.get(self.topics[topic].frame_id, ()), strict=False)).get(label, label)

    def shown(self, entry: PlotEntry, name: str) -> Curve:
        """Return a signal of a plot entry inside the entry's window."""
        first, minus, second = name.partition(" - ")
        if minus:
            curve = self.difference(first, second, entry.signals[name])
        else:
            curve = self.curve(name, entry.signals[name])
        return reduced(inside(replace(curve, unit=entry.unit or curve.unit), entry.window))

    def against(self, entry: PlotEntry, name: str) -> tuple[str, Curve]:
        """Return the signal of the x axis and the curve over it."""
        over = f"{self.topic(name)}/{entry.x}"
        x, y = self.curve(over), self.curve(name, entry.signals[name])
        x, y = inside(x, entry.window), inside(y, entry.window)
        return over, replace(y, x=x.y, held=False)


def _reference(port: Port, label: str) -> bool:
    """Return whether a signal is a reference, judged by its message type or its label."""
    is_reference = label.startswith(("reference", "set point")) or label.endswith((" reference", " set point"))
    return is_reference or port.msgtype.startswith("trajectory_msgs")


def _held_topics(rig: Rig) -> set[str]:
    """Topics whose values stay until the next message."""
    sampled = {p.topic for m in rig.members for p in (m.inputs if m.is_plant else m.outputs)}
    # Commands applied by a plant come from it, but they are held just as those that it received.
    return sampled | {t for t, port in rig.topics.items() if port.fields == ("effort",)}


def shown(rig: Rig) -> dict[str, Shown]:
    """Describe the signals of the plots over time of a rig's scenario."""
    known, held = signal_units(rig), _held_topics(rig)
    result = {}
    for entry in rig.scenario.plots:
        for name, label in entry.signals.items():
            if name in known and not entry.x:
                topic = topic_of(name, rig.topics)
                reference = _reference(rig.topics[topic], label)
                result[name] = Shown(unit=entry.unit or known[name], held=topic in held, reference=reference)
    return result


def by_unit(curves: Sequence[Curve]) -> dict[str, list[Curve]]:
    """Return the curves of each unit."""
    rows: dict[str, list[Curve]] = {}
    for curve in curves:
        rows.setdefault(curve.unit, []).append(curve)
    return rows
