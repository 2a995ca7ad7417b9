"""Characteristic of the string on request."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from softrig_core import Block, BlockParams, Port, array, button, executable, param

from .array import ArrayParams, possible, split
from .ports import environment
from .string import characteristic


class PvCurvesParams(ArrayParams, BlockParams):
    """The string, and how many points of its characteristic are published."""

    period: float = param(0.5, "how often a request is looked for", "s", gt=0.0, le=100.0)
    n_points: int = param(201, "points from 0 V to open circuit", ge=2, le=1000)


class PvCurves(Block[PvCurvesParams]):
    """I-V and P-V curve of the string in the conditions at the last press of ``pv/curves/request``.

    ``pv/curves`` has three rows, voltage (V), current (A) and power (W), and a column a point. Before the first press
    it shows the conditions of the first tick.
    """

    @classmethod
    def ports(cls, params: PvCurvesParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """One column a point."""
        request = button("request", "pv/curves/request", held=True)
        units = [unit for unit in ("V", "A", "W") for _ in range(params.n_points)]
        curves = array("curves", "pv/curves", {"quantity": 3, "point": params.n_points}, units)
        return (environment(len(params.irradiance), held=True), request), (curves,)

    def start(self) -> None:
        """Nothing published yet, conditions of the parameters."""
        self._pressed = False
        self._answer: tuple[float, ...] = ()
        self._conditions = self.p.irradiance + self.p.temperature

    def update(
        self, t: int, environment: tuple[float, ...] | None, request: tuple[float] | None
    ) -> Mapping[str, tuple[float, ...]]:
        """Give the newest curve asked for."""
        if environment is not None and environment != self._conditions and possible(self, environment):
            self._conditions = environment
        pressed = request == (1.0,)
        if (pressed and not self._pressed) or not self._answer:
            p = self.p
            curve = characteristic(p.module, *split(self._conditions))
            v = np.linspace(0.0, curve.open_circuit, p.n_points)
            i = np.interp(v, curve.v, curve.i)
            self._answer = (*v.tolist(), *i.tolist(), *(v * i).tolist())
        self._pressed = pressed
        return {"curves": self._answer}


main = executable(PvCurves)
