"""The description of exported code, NODE.json; its content is checked before it is used."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ..wire.types import TYPES
from .entry import contents_of

LONGEST = 1 << 24  # bytes of a file: a node with thousands of constants has some hundred kB
_LONGEST_NAME = 300
_Text = Annotated[str, Field(max_length=_LONGEST_NAME)]
_Name = Annotated[str, Field(min_length=1, max_length=_LONGEST_NAME, pattern=r"^[^\s\x00-\x1f]+$")]


class _Checked(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False, extra="ignore")


class ValueDescription(_Checked):
    """A value of a port: label below the topic, unit, largest magnitude, and its default without a valid value."""

    label: _Name
    unit: _Text
    limit: float = Field(gt=0.0, allow_inf_nan=True)
    safe: float


class PortDescription(_Checked):
    """A port of the node, with the fields of `Port`."""

    direction: Literal["in", "out"]
    name: _Name
    topic: _Name
    type: _Name
    channels: tuple[_Name, ...] = ()
    fields: tuple[_Name, ...] = ()
    frame_id: _Text = ""
    dims: tuple[tuple[_Text, Annotated[int, Field(ge=1)]], ...] = ()
    held: bool = False
    sporadic: bool = False
    delayed: bool = False
    partial: bool = False
    values: tuple[ValueDescription, ...]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.type not in TYPES:
            raise ValueError(f"port {self.name} has messages of {self.type}, which no port can have")
        # The numbers must be as many as described: a port of more would be allocated before it is refused.
        if math.prod(size for _, size in self.dims) > max(1, len(self.values)):
            raise ValueError(f"port {self.name} has {len(self.values)} values, expected as many as its dims require")
        return self


class Description(_Checked):
    """The content that `softrig export` writes about a node, as far as other code relies on it."""

    node: str = Field(pattern=r"^[A-Za-z_]\w{0,99}$")
    block: _Name = Field(alias="class")
    digest: str = Field(pattern=r"^[0-9a-f]{8,64}$")
    real: Literal["float", "double"]
    period_s: tuple[Annotated[int, Field(gt=0, lt=1 << 63)], Annotated[int, Field(gt=0, lt=1 << 63)]]
    parameters: dict[_Name, Any]
    settable: tuple[_Name, ...]
    ports: tuple[PortDescription, ...]

    @model_validator(mode="after")
    def _settable_are_numbers(self) -> Self:
        for name in self.settable:
            value = self.parameters.get(name)
            if not isinstance(value, bool | int | float) or not abs(value) < math.inf:
                raise ValueError(f"parameter {name} is {str(value)[:50]!r}, expected a number, for it is settable")
        return self

    @property
    def period(self) -> float:
        """Period of the node, s."""
        return self.period_s[0] / self.period_s[1]


def read_description(file: Path) -> Description:
    """Read a description.

    Raises
    ------
    OSError
        It cannot be read.
    ValueError
        It is not a valid description; the error names the place.
    """
    data = contents_of(file, LONGEST)
    try:
        return Description.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        location = ".".join(map(str, first["loc"]))
        raise ValueError(f"{location or 'it'}: {first['msg']}"[:_LONGEST_NAME]) from None
