"""Base of data that softrig itself writes to files and reads again: frozen dataclasses, checked by their annotations.

Data that people write are models of pydantic (`softrig_core.entry`). Its import takes a sixth of the start of a command
that only shows what a run has written, and a model takes several times as long to create as a dataclass.
msgspec would do the same in less code, but rosdistro has no key for it, and a package that a ROS distribution may
include can only depend on packages with one.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from functools import cache
from types import UnionType
from typing import Any, Literal, Self, Union, cast, get_args, get_origin

Check = Callable[[Any], Any]  # function from a raw value to the value of a field
# What the metadata of a field may have: its name in files, if it is another one; whether files have it; and the least
# finite number that is accepted.
NAME, KEPT, LEAST = "name", "kept", "least"


class MisfitError(ValueError):
    """Data of a file that are not of their declared form.

    Attributes
    ----------
    place : tuple of str or int
        Keys that lead to the value.
    reason : str
        What was expected.
    """

    def __init__(self, reason: str, place: tuple[str | int, ...] = ()) -> None:
        self.reason, self.place = reason, place
        super().__init__(f"{'.'.join(map(str, place))}: {reason}" if place else reason)

    def below(self, key: str | int) -> MisfitError:
        """Return the error of the value that holds this one under a key."""
        return MisfitError(self.reason, (key, *self.place))


class Data:
    """Base of such dataclasses."""

    @classmethod
    def read(cls, raw: Any) -> Self:
        """Create one from the content of a file; names that it does not declare are left out.

        Raises
        ------
        MisfitError
            Names the first value that is missing or has another form, and what was expected.
        """
        if isinstance(raw, cls):
            return raw
        if not isinstance(raw, Mapping):
            raise MisfitError("input should be an object")
        values, kind = {}, cast(Any, cls)
        for name, in_file, required, check in _fields(kind):
            if in_file in raw:
                values[name] = _checked(check, raw[in_file], in_file)
            elif required:
                raise MisfitError("field required", (in_file,))
        try:
            return cls(**values)
        except ValueError as error:  # raised by `__post_init__` of the class itself
            raise MisfitError(f"value error, {error}") from None

    def having(self, **values: Any) -> Self:
        """Return it with other values of some fields, which are not checked."""
        # `dataclasses.replace` creates the object anew, which takes ten times as long.
        result = object.__new__(type(self))
        result.__dict__.update(self.__dict__, **values)
        return result

    def plain(self) -> dict[str, Any]:
        """Return what a file has of it."""
        kind: Any = type(self)
        return {in_file: _plain(getattr(self, name)) for name, in_file in _written(kind)}


def _plain(value: Any) -> Any:
    if isinstance(value, Data):
        return value.plain()
    if type(value) is tuple:
        return tuple([_plain(item) for item in value])
    return {key: _plain(item) for key, item in value.items()} if type(value) is dict else value


@cache
def _written(kind: Any) -> list[tuple[str, str]]:
    return [(f.name, f.metadata.get(NAME) or f.name) for f in fields(kind) if f.metadata.get(KEPT, True)]


@cache
def _fields(kind: Any) -> list[tuple[str, str, bool, Check]]:
    """Return the name of each field, its name in files, whether it is required, and its check."""
    hints = typing.get_type_hints(kind)
    required = {f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING}
    return [
        (f.name, f.metadata.get(NAME) or f.name, f.name in required, _check_of(hints[f.name], f.metadata.get(LEAST)))
        for f in fields(kind)
    ]


def _checked(check: Check, raw: Any, key: str | int) -> Any:
    try:
        return check(raw)
    except MisfitError as error:
        raise error.below(key) from None


def _check_of(kind: Any, least: float | None = None) -> Check:
    """Return the check of values of a type."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        (inner,) = [_check_of(part, least) for part in parts if part is not type(None)]
        return lambda raw: None if raw is None else inner(raw)
    if origin is tuple:
        return _sequence(parts)
    if origin is dict:
        inner = _check_of(parts[1])
        return lambda raw: {key: _checked(inner, item, key) for key, item in _of(dict, "dictionary", raw).items()}
    if origin is Literal:
        return lambda raw: _one_of(parts, raw)
    if kind is float:
        return lambda raw: _number(raw, least)
    if kind in _SIMPLE:
        return lambda raw: _of(kind, _SIMPLE[kind], raw)
    if isinstance(kind, type) and issubclass(kind, Data):
        return kind.read
    assert kind is Any, kind
    return lambda raw: raw


_SIMPLE: dict[Any, str] = {str: "string", int: "integer", bool: "boolean"}


def _of(kind: Any, noun: str, raw: Any) -> Any:
    # True is an integer in Python, but not a number of a file.
    if isinstance(raw, kind) and (kind is bool or not isinstance(raw, bool)):
        return raw
    raise MisfitError(f"input should be a valid {noun}")


def _number(raw: Any, least: float | None) -> float:
    if not isinstance(raw, int | float) or isinstance(raw, bool):
        raise MisfitError("input should be a valid number")
    try:
        number = float(raw)
    except OverflowError:  # whole numbers of a file may have any length
        number = math.inf
    if least is not None and not math.isfinite(number):
        raise MisfitError("input should be a finite number")
    if least is not None and number < least:
        raise MisfitError(f"input should be greater than or equal to {least:g}")
    return number


def _one_of(known: tuple[Any, ...], raw: Any) -> Any:
    if raw in known:
        return raw
    raise MisfitError(f"input should be {', '.join(map(repr, known[:-1]))} or {known[-1]!r}")


def _sequence(parts: tuple[Any, ...]) -> Check:
    """Return the check of a tuple: of any length if its last part is `...`."""
    checks, free = [_check_of(part) for part in parts if part is not ...], ... in parts

    def check(raw: Any) -> tuple[Any, ...]:
        items = _of(list | tuple, "tuple", raw)
        if not free and len(items) != len(checks):
            raise MisfitError(f"input should be a tuple of {len(checks)} values, not {len(items)}")
        return tuple([_checked(checks[0 if free else k], item, k) for k, item in enumerate(items)])

    return check
