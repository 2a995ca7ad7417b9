"""Immutable, validated block parameters: one declaration gives the Python model and the ROS parameters."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self, get_args, runtime_checkable

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from ..entry import Entry
from ..errors import closest
from ..kit.newest import once_for_objects
from .schedule import rational

# Of any number in SI units. A larger one is a slip, and its powers soon leave the range of floats.
LARGEST = 1e12
LONGEST = 10_000  # values of one list, characters of one text
STEPS = 100_000  # steps of integration in one period
_UPPER = ("le", "lt", "max_length")


class ParameterError(ValueError):
    """A parameter is unknown, of the wrong type or out of bounds; the message names it."""


def param(
    default: Any,
    doc: str,
    unit: str = "",
    *,
    each: tuple[float, float] | None = None,
    live: bool = False,
    **bounds: Any,
) -> Any:
    """Declare one field of a `Params` class.

    Parameters
    ----------
    default : Any
        Published value.
    doc : str
        What it is, with its symbol and source where there is one.
    unit : str
        SI unit, empty for a pure number.
    each : (float, float), optional
        Least and largest value of every element of a list.
    live : bool
        Whether it may change while the block runs (`softrig_core.block.block.Block.change`): gains, limits, set
        points, switches; not what sets a size, a port or the period.
    **bounds
        ``gt``, ``ge``, ``lt``, ``le``, ``min_length``, ``max_length`` as in pydantic. A number without them is bounded
        by `LARGEST` alone; a count that sets an effort or a size needs its own.
    """
    extra: dict[str, Any] = {"unit": unit} | ({} if each is None else {"each": each}) | ({"live": True} if live else {})
    return Field(default, description=doc, json_schema_extra=extra, **bounds)


class derived(property):  # noqa: N801, a decorator
    """A number that follows from the parameters of a class; scenarios reach it as ``$node.name``.

    Examples
    --------
    >>> @derived
    ... def search_time(self) -> float:
    ...     "What a search takes, s."
    ...     return self.budget * self.hold_time
    """


class Params(Entry):
    """Base of every parameter model.

    Nested models are written with dots outside (``rig.pwm_bits``). A class whose values have to fit together has a
    method ``_check(self)``, which raises a ValueError where they do not. It is called after those of its bases.
    """

    @field_validator("*")
    @classmethod
    def _no_slips(cls, value: Any, info: ValidationInfo) -> Any:
        keys = {key for rule in cls.model_fields[str(info.field_name)].metadata for key in _UPPER if hasattr(rule, key)}
        if isinstance(value, str | tuple) and "max_length" not in keys and len(value) > LONGEST:
            raise ValueError(f"expected at most {LONGEST} {'characters' if isinstance(value, str) else 'values'}")
        # A declared upper bound replaces the general one.
        if keys & {"le", "lt"}:
            return value
        low, high = _each(cls.model_fields[str(info.field_name)])
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not low <= number <= high:
                if high == LARGEST == -low:
                    raise ValueError(f"expected at most {LARGEST:g} in magnitude")
                raise ValueError(f"expected {low:g} to {high:g}, got {_shown(number)}")
        return value

    _checks: ClassVar[tuple[Callable[[Any], None], ...]] = ()

    @classmethod
    def __pydantic_init_subclass__(cls, **keywords: Any) -> None:
        super().__pydantic_init_subclass__(**keywords)
        # Parameters are created for each run of a study, so their classes are not searched each time.
        cls._checks = tuple(vars(each)["_check"] for each in reversed(cls.__mro__) if "_check" in vars(each))

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for check in self._checks:
            check(self)
        return self


def _each(field: Any) -> tuple[float, float]:
    """Return the bounds of a field's elements."""
    extra = field.json_schema_extra
    low, high = (isinstance(extra, dict) and extra.get("each")) or (-LARGEST, LARGEST)
    return low, high


@runtime_checkable
class FromFiles(Protocol):
    """A block that also depends on files: an FMU, a library, the firmware of a board."""

    @classmethod
    def contents(cls, params: Any) -> Mapping[str, str]:
        """Return name to hash of these files, for the record of a run."""


class BlockParams(Params):
    """Parameters that every block has."""

    period: float = param(0.01, "sampling period; also a fraction as text: 1/2880", "s", gt=0.0, le=100.0)

    @field_validator("period", mode="before")
    @classmethod
    def _period_as_fraction(cls, period: Any) -> Any:
        # The float stands for the fraction: `rational` finds it again as the simplest one within the last place.
        return float(rational(period)) if isinstance(period, str) and "/" in period else period

    @field_validator("period")  # a block that has a default of its own inherits this
    @classmethod
    def _period_in_ns(cls, period: float) -> float:
        if period < 1e-9:
            raise ValueError("expected at least 1e-9, the unit of time is the nanosecond")
        return period


def check_steps(period: float, step: float, name: str) -> None:
    """Limit the integration steps in a period, for the validator of a model whose step is a parameter.

    Raises
    ------
    ValueError
        There are more than `STEPS` steps: one tick would take forever.
    """
    if period > STEPS * step:
        raise ValueError(
            f"period = {period:g} s takes {period / step:.3g} steps of {name} = {step:g} s, expected at most {STEPS}"
        )


@dataclass(frozen=True)
class Declaration:
    """Data of one field for its ROS parameter declaration."""

    name: str
    default: Any
    type: type
    doc: str
    unit: str
    lower: float | None
    upper: float | None
    live: bool = False


def declarations(model: type[Params], prefix: str = "") -> list[Declaration]:
    """List the fields of a model with dotted names, nested models flattened."""
    result = []
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Params):
            result += declarations(kind, f"{prefix}{name}.")
            continue
        bounds: dict[str, float] = {}
        for rule in field.metadata:
            bounds |= {key: getattr(rule, key) for key in ("gt", "ge", "lt", "le") if hasattr(rule, key)}
        kinds = [k for k in get_args(kind) if k is not type(None)]
        extra = field.json_schema_extra
        plain = kind in (int, float) or any(k in (int, float) for k in kinds)
        lower = bounds.get("ge", bounds.get("gt", -LARGEST if plain else None))
        upper = bounds.get("le", bounds.get("lt", LARGEST if plain else None))
        result.append(
            Declaration(
                prefix + name,
                field.get_default(call_default_factory=True),
                kind if isinstance(kind, type) else (kinds[0] if kinds and isinstance(kinds[0], type) else str),
                field.description or "",
                str(extra.get("unit", "")) if isinstance(extra, dict) else "",
                lower,
                upper,
                isinstance(extra, dict) and bool(extra.get("live")),
            )
        )
    return result


def flatten(params: Params, prefix: str = "") -> dict[str, Any]:
    """Return the values of a model under dotted names."""
    flat: dict[str, Any] = {}
    for name in type(params).model_fields:
        value = getattr(params, name)
        if isinstance(value, Params):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = list(value) if isinstance(value, tuple) else value
    return flat


@once_for_objects
def flattened(params: Params) -> Mapping[str, Any]:
    """Return the result of `flatten`, to be read only; the runs of a study have most parameters in common."""
    return flatten(params)


def known(params: Params, prefix: str = "") -> dict[str, Any]:
    """Return the values of a model under dotted names, and the numbers that are `derived` from them."""
    # The outermost call has flattened the nested models already.
    flat = flatten(params) if not prefix else {}
    for name, value in inspect.getmembers_static(type(params)):
        if isinstance(value, derived):
            flat[prefix + name] = getattr(params, name)
    for name in type(params).model_fields:
        if isinstance(value := getattr(params, name), Params):
            flat |= known(value, f"{prefix}{name}.")
    return flat


def differing(params: Params) -> str:
    """Describe which parameters differ from the published ones, as the middle of a message; empty if none does."""
    try:
        published = flatten(type(params)())
    except ValidationError:  # no defaults: all were given
        published = {}
    results = [f"{k} = {_shown(v)}" for k, v in flatten(params).items() if k not in published or v != published[k]]
    return f" with {', '.join(results)}"[:400] if results else ""


def build(model: type[Params], values: Mapping[str, Any]) -> Params:
    """Create a parameter model from dotted (or nested) names.

    Raises
    ------
    ParameterError
        One line with the parameter, the given value and the allowed values.
    """
    nested: dict[str, Any] = {}
    for name, value in values.items():
        level = nested
        *path, last = name.split(".")
        for part in path:
            level = level.setdefault(part, {})
            if not isinstance(level, dict):
                raise ParameterError(f"parameter {name}: {part} has the value {_shown(level)} as well")
        if isinstance(level.get(last), dict):
            if not isinstance(value, Mapping):
                below = next(iter(level[last]), "")
                raise ParameterError(f"parameter {name}.{below}: {last} has the value {_shown(value)} as well")
            level[last] |= value
        else:
            level[last] = dict(value) if isinstance(value, Mapping) else value
    try:
        return model(**nested)
    except ValidationError as error:
        text = "; ".join(_explain(model, e) for e in error.errors())
    # A validator may compute with the values.
    except (ArithmeticError, MemoryError) as error:
        text = f"parameters: {error or 'out of memory'}"
    # The error is about what follows from several values, so it names none that was given.
    if values and not any(_named(name, text) for name in values):
        stated = ", ".join(f"{name} = {_shown(value)}" for name, value in values.items())
        text += f" (with {stated if len(stated) < 400 else stated[:400] + ' ...'})"
    raise ParameterError(text)


def _named(parameter: str, text: str) -> bool:
    return re.search(rf"(?<![\w.]){re.escape(parameter)}(?![\w.])", text) is not None


def _explain(model: type[Params], error: Any) -> str:
    name = ".".join(str(part) for part in error["loc"]) or model.__qualname__
    if error["type"] == "extra_forbidden":
        known = [d.name for d in declarations(model)]
        return f"parameter {name} is unknown{closest(name, known)}; this block has {', '.join(known)}"
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "value_error" and not error["loc"]:
        return f"parameters: {message}"
    return f"parameter {name} = {_shown(error['input'])}: {message[:1].lower()}{message[1:]}"


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    # Python refuses to print an integer of more than 4300 digits.
    except ValueError:
        return "a number of thousands of digits"
    return text if len(text) <= 100 else f"{text[:100]} ..."
