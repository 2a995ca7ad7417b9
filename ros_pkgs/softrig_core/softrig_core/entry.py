"""Base of all data that people write in files or as parameters."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidatorFunctionWrapHandler, field_validator

_MAYBE = frozenset({bool, str, list, tuple})


class Entry(BaseModel):
    """Base of all such models: frozen, no unknown names, no NaN or infinity, no switch or 1_000 as a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="wrap")
    @classmethod
    def _plain_numbers(cls, raw: Any, validated: ValidatorFunctionWrapHandler) -> Any:
        value = validated(raw)
        if type(raw) in _MAYBE:
            if _switches(raw) and not _switches(value):
                raise ValueError("expected a number, not true or false")
            _check_digits(raw, value)
        return value


def _switches(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_switches, value)))


def _check_digits(raw: Any, value: Any) -> None:
    """Refuse a number with underscores: pydantic reads 1_000 as Python does, other readers of YAML and ROS do not."""
    if isinstance(raw, str):
        if isinstance(value, int | float) and "_" in raw:
            raise ValueError(f"expected a number without underscores, {raw.replace('_', '')}")
    elif isinstance(raw, list | tuple) and isinstance(value, list | tuple) and len(raw) == len(value):
        for item, read in zip(raw, value, strict=True):
            _check_digits(item, read)
