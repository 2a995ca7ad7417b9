"""What people write, in files or as parameters, as validated data."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidatorFunctionWrapHandler, field_validator

_MAYBE = frozenset({bool, list, tuple})


class Entry(BaseModel):
    """Base of all such models: frozen, no unknown names, no NaN or infinity, no switch in the place of a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="wrap")
    @classmethod
    def _no_switch_as_number(cls, given: Any, validated: ValidatorFunctionWrapHandler) -> Any:
        value = validated(given)
        if type(given) in _MAYBE and _switches(given) and not _switches(value):
            raise ValueError("expected a number, not true or false")
        return value


def _switches(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_switches, value)))
