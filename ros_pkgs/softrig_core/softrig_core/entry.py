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
    def _plain_numbers(cls, given: Any, validated: ValidatorFunctionWrapHandler) -> Any:
        value = validated(given)
        if type(given) in _MAYBE:
            if _switches(given) and not _switches(value):
                raise ValueError("expected a number, not true or false")
            _check_digits(given, value)
        return value


def _switches(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_switches, value)))


def _check_digits(given: Any, value: Any) -> None:
    """Refuse a number with underscores: pydantic reads 1_000 as Python does, other readers of YAML and ROS do not."""
    if isinstance(given, str):
        if isinstance(value, int | float) and "_" in given:
            raise ValueError(f"expected a number without underscores, {given.replace('_', '')}")
    elif isinstance(given, list | tuple) and isinstance(value, list | tuple) and len(given) == len(value):
        for one, read in zip(given, value, strict=True):
            _check_digits(one, read)
