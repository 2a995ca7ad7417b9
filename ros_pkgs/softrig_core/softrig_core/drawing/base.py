"""The parts that all drawings share: the signals that a drawing needs, by the ports of its plant, and its frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..block.port import Port
from ..judge.units import pretty_unit
from ..rig.members import Member, signal_units
from ..rig.rig import Rig
from .shapes import Pen, Point, Shape

Row = Mapping[str, float]

NOTHING = "–"  # text in place of a value that has not arrived


@dataclass(frozen=True)
class Quantity:
    """A signal as a drawing reads it.

    Parameters
    ----------
    name : str
        Of the signal; empty for one that the rig does not have.
    unit : str
        As it is printed.
    rest : float
        Value that is drawn if there is none.
    """

    name: str
    unit: str = ""
    rest: float = 0.0

    def __call__(self, row: Row) -> float:
        """Return the value, or its value at rest if there is none."""
        value = row.get(self.name, math.nan)
        return value if math.isfinite(value) else self.rest

    def text_of(self, row: Row, form: str = ".1f", unit: str | None = None) -> str:
        """Write the value with its unit.

        Parameters
        ----------
        row : mapping of str to float
        form : str
            Format of the number.
        unit : str, optional
            In place of its own.
        """
        value = row.get(self.name, math.nan)
        number = f"{value:{form}}" if math.isfinite(value) else NOTHING
        if float(number.replace(",", "") if number != NOTHING else 1) == 0.0:
            number = number.lstrip("-")  # no "-0.0"
        return f"{number.replace('-', '−')} {self.unit if unit is None else unit}".rstrip()


class Drawing:
    """A plant as its rig shows it; a subclass draws one kind of plant.

    Attributes
    ----------
    signals : tuple of str
        Names of the signals that `frame` reads.
    bounds : tuple of 4 floats
        Left, top, width, height of what is drawn on.
    trail : float
        Length of the past that `frame` reads, s.
    title : str
        What is drawn.
    """

    title = ""
    bounds: tuple[float, float, float, float] = (0.0, 0.0, 640.0, 360.0)
    trail: float = 0.0

    def __init__(self, rig: Rig, plant: Member) -> None:
        self.rig, self.plant = rig, plant
        self.p: Any = plant.params
        self._units = signal_units(rig)
        self._names: dict[str, None] = {}
        self.setup()
        self.signals = tuple(self._names)

    def setup(self) -> None:
        """Name the quantities and read the needed parameters."""
        raise NotImplementedError

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Draw one instant; shapes and their order are always the same, only positions, radii and texts differ."""
        raise NotImplementedError

    def frame(self, row: Row, past: Sequence[Row] = ()) -> list[Shape]:
        """Return the shapes of one instant.

        Parameters
        ----------
        row : mapping of str to float
            The newest value of each signal; one that is missing or not finite is drawn at rest and labelled so.
        past : sequence of mappings
            Earlier rows of the last `trail` s, oldest first.

        Returns
        -------
        list of Shape
            As many as in every other frame, of the same kinds and roles, with as many points.
        """
        pen = Pen()
        self.draw(pen, row, past)
        return pen.shapes

    def quantity(self, port: str, label: str, at_rest: float = 0.0) -> Quantity:
        """Return a signal of the plant's port, or of a port of this name elsewhere in the rig.

        Parameters
        ----------
        port : str
            Name of an output or input of the plant, else of an output of another node, first of those linked to it; or
            the last part of its topic.
        label : str
            Below the topic: ``shaft/velocity``.

        Returns
        -------
        Quantity
            Without a name where the rig has no such signal.
        """
        result = self._port(port, label)
        return self.signal(result.topic if result else "", label, at_rest)

    def signal(self, topic: str, label: str, at_rest: float = 0.0) -> Quantity:
        """Return a signal by its topic, as `quantity` does."""
        name = f"{topic}/{label}"
        if name not in self._units:
            return Quantity("", rest=at_rest)
        self._names[name] = None
        return Quantity(name, pretty_unit(self._units[name]), at_rest)

    def _port(self, name: str, label: str) -> Port | None:
        ports = [*self.plant.outputs, *self.plant.inputs]
        near = sorted(self.rig.members, key=lambda m: not self._linked(m))
        ports += [p for m in near if m is not self.plant and not m.is_plant for p in m.outputs]
        fitting = [p for p in ports if label in p.labels and name in (p.name, p.topic.rpartition("/")[2])]
        return next(iter(fitting), None)

    def _linked(self, member: Member) -> bool:
        """Return whether a node publishes to the plant or subscribes to it."""
        links = [*member.links.values()], [*self.plant.links.values()]
        return any(k.source is self.plant for k in links[0]) or any(k.source is member for k in links[1])


def readings(
    pen: Pen, corner: Point, rows: Sequence[tuple[str, str, str]], width: float = 190.0, step: float = 22.0
) -> None:
    """Write values below each other: name on the left, value on the right.

    Parameters
    ----------
    corner : (float, float)
        Left end of the first baseline.
    rows : sequence of (name, value, role)
    """
    for k, (name, value, role) in enumerate(rows):
        y = corner[1] + step * k
        pen.text((corner[0], y), name, "muted")
        pen.text((corner[0] + width, y), value, role, anchor="end")


def tail(past: Sequence[Row], row: Row, points: int) -> list[Row]:
    """Select `points` rows of the past, evenly up to now; while there are fewer, the first one is repeated."""
    rows = [*past, row]
    last = len(rows) - 1
    return [rows[max(0, last - round((points - 1 - k) * max(last, 1) / (points - 1)))] for k in range(points)]


def limited(value: float, limit: float) -> float:
    """Limit a value to plus or minus `limit`, where the drawing ends."""
    return min(max(value, -limit), limit)
