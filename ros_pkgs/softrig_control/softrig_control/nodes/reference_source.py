"""Reference of one or more axes: constants that step at given times."""

from __future__ import annotations

from typing import Any

from pydantic import model_validator
from softrig_core import Block, Port, Values, param, reference

from ..profile import ProfileParams, StepProfile

# parameter: (argument of `reference`, what follows the unit of a position)
FIELDS = {"positions": ("position", ""), "velocities": ("velocity", "/s"), "accelerations": ("acceleration", "/s^2")}


class ReferenceSourceParams(ProfileParams):
    """Parameters of a reference source: axes, and their positions, velocities and accelerations from each time on.

    A field is sent if it has values: all axes at the first time, then all axes at the next, and so on.
    """

    unit: str = param("rad", "unit of a position; velocities and accelerations are in this unit per s and s^2")
    positions: tuple[float, ...] = param((), "position of every axis from each time on", live=True)
    velocities: tuple[float, ...] = param(
        (10.0,), "velocity of every axis from each time on; empty if only other fields are used", live=True
    )
    accelerations: tuple[float, ...] = param((), "acceleration of every axis from each time on", live=True)

    @property
    def fields(self) -> list[str]:
        """The fields that are sent."""
        return [f for f in FIELDS if getattr(self, f)]

    @model_validator(mode="before")
    @classmethod
    def _only_what_is_given(cls, values: Any) -> Any:
        # The default velocity is for a source without any values; it must not be sent beside fields that a scenario
        # gives.
        stated = isinstance(values, dict) and (values.get("positions") or values.get("accelerations"))
        return {"velocities": ()} | values if stated else values

    def _check(self) -> None:
        if not self.fields:
            raise ValueError("none of positions, velocities, accelerations is given")
        for field in self.fields:
            self.rows(field)


class ReferenceSource(Block[ReferenceSourceParams]):
    """Publishes the reference of the axes at every tick."""

    @classmethod
    def ports(cls, params: ReferenceSourceParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one output with the fields that have values."""
        units = {FIELDS[field][0]: params.unit + FIELDS[field][1] for field in params.fields}
        return (), (reference("reference", "reference", params.channels, **units),)

    def setup(self) -> None:
        """Prepare the answer for each time."""
        fields = [self.p.rows(field) for field in self.p.fields]
        answers = [{"reference": tuple(x for row in rows for x in row)} for rows in zip(*fields, strict=True)]
        self._answers = StepProfile(self.p.times, answers)

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Values]:
        """Return the reference at t."""
        return x, self._answers.at(t)
