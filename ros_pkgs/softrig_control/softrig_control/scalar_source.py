"""Named scalars of different units (set points, events): constants that step at given times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pydantic import model_validator
from softrig_core import Block, Port, executable, param, scalars

from .profile import ProfileParams, StepProfile


class ScalarSourceParams(ProfileParams):
    """Which scalars, their units, and their values: all at the first time, then all at the next, and so on."""

    channels: tuple[str, ...] = param(("v_dc",), "names of the scalars", min_length=1)
    units: tuple[str, ...] = param(("V",), "unit of each", min_length=1)
    values: tuple[float, ...] = param((400.0,), "value of every scalar from each time on")

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        self.rows("values")
        if len(self.units) != len(self.channels):
            raise ValueError(f"{len(self.units)} units for {len(self.channels)} channels")
        return self


class ScalarSource(Block[ScalarSourceParams]):
    """Publishes the scalars at every tick."""

    @classmethod
    def ports(cls, params: ScalarSourceParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """One output with the channels of the parameters."""
        return (), (scalars("values", "values", dict(zip(params.channels, params.units, strict=True))),)

    def setup(self) -> None:
        """Prepare the answer for each time."""
        self._answers = StepProfile(self.p.times, [{"values": row} for row in self.p.rows("values")])

    def update(self, t: int, **inputs: Any) -> Mapping[str, tuple[float, ...]]:
        """Give the scalars at t."""
        return self._answers.at(t)


main = executable(ScalarSource)
