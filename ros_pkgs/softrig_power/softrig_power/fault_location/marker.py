"""Node: the line, its towers and the located fault as markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from softrig_core import BlockParams, Marker, Observer, param

from .ports import LOCATION, location_port

HEIGHT = 0.2  # height of the towers, in units of the picture
GREY, RED = (0.5, 0.5, 0.5, 1.0), (0.9, 0.1, 0.1, 1.0)


class LocationMarkerParams(BlockParams):
    """Parameters of the marker: the line, and its appearance."""

    period: float = param(5e-5, "sampling period", "s", gt=0.0, le=1.0)
    length: float = param(120.0, "length of the line", "km", gt=0.0, le=3000.0)
    towers: int = param(61, "towers drawn", ge=2, le=10000)
    scale: float = param(0.1, "units of the picture a kilometre", "m/km", gt=0.0, le=1000.0)


class LocationMarker(Observer[LocationMarkerParams]):
    """Line along x from bus S in the frame ``line``, towers, a ball at the newest location; it and F as figures."""

    INPUTS = (location_port(),)

    def first(self) -> tuple[float, ...] | None:
        """Return the initial state, without a location; the state is the newest location."""
        return None

    def update(
        self, x: tuple[float, ...] | None, t: int, *, location: tuple[float, ...]
    ) -> tuple[tuple[float, ...] | None, Mapping[str, tuple[float, ...]]]:
        """Keep the newest location; before the first the input has an age of None."""
        return (location if self.age("location") == 0 else x), {}

    def status(self, x: tuple[float, ...] | None) -> Mapping[str, tuple[float, str]]:
        """Return the location, when there is one."""
        if x is None:
            return {}
        named = dict(zip(LOCATION, x, strict=True))
        return {"x": (named["x_km"], "km"), "f_min": (named["f_min"], "V"), "scatter": (named["scatter_km"], "km")}

    def markers(self, x: tuple[float, ...] | None) -> Sequence[Marker]:
        """Draw conductor and towers, and the fault."""
        p = self.p
        positions = (p.scale * np.linspace(0.0, p.length, p.towers)).tolist()
        wire = tuple((position, 0.0, HEIGHT) for position in positions)
        poles = tuple(point for position in positions for point in ((position, 0.0, 0.0), (position, 0.0, HEIGHT)))
        result = [
            Marker("line", "conductor", "line_strip", wire, 0.02, GREY),
            Marker("line", "towers", "line_list", poles, 0.02, GREY),
        ]
        if x is not None:
            position = p.scale * x[LOCATION.index("x_km")]
            result.append(Marker("line", "fault", "sphere_list", ((position, 0.0, HEIGHT),), 0.2, RED))
        return result
