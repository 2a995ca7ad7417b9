"""Parameters with one value a joint."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator
from softrig_core import Params


def _as_sequence(value: Any) -> Any:
    return (value,) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


#: One number for every joint, or one number a joint.
PerJoint = Annotated[tuple[float, ...], BeforeValidator(_as_sequence)]


class JointUnits(NamedTuple):
    """Units of a port's joints, one a joint: of a linear one in m and N."""

    position: tuple[str, ...]
    velocity: tuple[str, ...]
    acceleration: tuple[str, ...]
    effort: tuple[str, ...]


def joint_units(joints: Sequence[str], linear: Collection[str]) -> JointUnits:
    """Return the units of joints, some of which move along a line."""
    lengths, efforts = zip(*(("m", "N") if j in linear else ("rad", "N m") for j in joints), strict=True)
    return JointUnits(
        lengths, tuple(f"{unit}/s" for unit in lengths), tuple(f"{unit}/s^2" for unit in lengths), efforts
    )


def spread(name: str, values: Sequence[float], joints: int) -> tuple[float, ...]:
    """Return one value a joint.

    Raises
    ------
    ValueError
        Neither one value nor as many as there are joints; names the parameter.
    """
    if len(values) == 1:
        return (float(values[0]),) * joints
    if len(values) != joints:
        raise ValueError(f"{name} = {list(values)} has {len(values)} values, expected 1 or {joints} (one a joint)")
    return tuple(map(float, values))


def require_positive(name: str, values: Sequence[float], *, or_zero: bool = False) -> None:
    """Refuse values that are not positive (or, with `or_zero`, negative).

    Raises
    ------
    ValueError
        Names the parameter and its values.
    """
    if any(value < 0.0 or (value == 0.0 and not or_zero) for value in values):
        raise ValueError(f"{name} = {list(values)}: expected {'no negative' if or_zero else 'only positive'} values")


class JointGains(Params):
    """Gains of a law that runs once a joint: no negative ones, one number for all joints or one a joint."""

    def _check(self) -> None:
        for name in type(self).model_fields:
            require_positive(name, getattr(self, name), or_zero=True)

    def of_joint(self, prefix: str, joint: int, joints: int) -> SimpleNamespace:
        """Return the gains of one joint, a number each, by their names.

        Raises
        ------
        ValueError
            A gain has neither one value nor one a joint; names it with the prefix.
        """
        names = type(self).model_fields
        return SimpleNamespace(**{k: spread(f"{prefix}.{k}", getattr(self, k), joints)[joint] for k in names})


def motor_names(joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return the channel names of the motors, motor1 on."""
    return tuple(f"motor{i + 1}" for i in range(len(joints)))
