"""Characteristic of the string on request."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from softrig_core import Block, BlockParams, Port, Values, array, button, param

from .array import ArrayParams, possible, split
from .ports import environment
from .string import characteristic


class PvCurvesParams(ArrayParams, BlockParams):
    """The string, and how many points of its characteristic are published."""

    period: float = param(0.5, "how often a request is looked for", "s", gt=0.0, le=100.0)
    n_points: int = param(201, "points from 0 V to open circuit", ge=2, le=1000)


class State(NamedTuple):
    """State from tick to tick."""

    conditions: tuple[float, ...]
    """Irradiance (W/m^2) and temperature (deg C) of each module."""

    shown: tuple[float, ...] | None = None
    """Those of the curve that is published."""

    pressed: bool = False
    """Whether the button is."""


class PvCurves(Block[PvCurvesParams]):
    """I-V and P-V curve of the string in the conditions at the last press of ``pv/curves/request``.

    ``pv/curves`` has three rows, voltage (V), current (A) and power (W), and a column a point. Before the first press
    it shows the conditions of the first tick.
    """

    @classmethod
    def ports(cls, params: PvCurvesParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one column per point."""
        request = button("request", "pv/curves/request", held=True)
        units = [unit for unit in ("V", "A", "W") for _ in range(params.n_points)]
        curves = array("curves", "pv/curves", {"quantity": 3, "point": params.n_points}, units)
        return (environment(len(params.irradiance), held=True), request), (curves,)

    def setup(self) -> None:
        """Keep the newest curves at hand."""
        self._curves = lru_cache(maxsize=2)(self._computed)

    def first(self) -> State:
        """Return the initial state: nothing published yet, conditions of the parameters."""
        return State(self.p.irradiance + self.p.temperature)

    def update(
        self, x: State, t: int, *, environment: tuple[float, ...] | None, request: tuple[float] | None
    ) -> tuple[State, Values]:
        """Publish the newest requested curve."""
        conditions, shown, pressed = x.conditions, x.shown, request == (1.0,)
        if environment is not None and environment != conditions and possible(self, environment):
            conditions = environment
        if (pressed and not x.pressed) or shown is None:
            shown = conditions
        return State(conditions, shown, pressed), {"curves": self._curves(shown)}

    def _computed(self, conditions: tuple[float, ...]) -> tuple[float, ...]:
        curve = characteristic(self.p.module, *split(conditions))
        v = np.linspace(0.0, curve.open_circuit, self.p.n_points)
        i = np.interp(v, curve.v, curve.i)
        return (*v.tolist(), *i.tolist(), *(v * i).tolist())
