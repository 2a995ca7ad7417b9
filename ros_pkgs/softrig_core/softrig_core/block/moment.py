"""The state of a rig between two ticks as a value: kept when wanted, put back into that rig or into another one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from ..errors import RunError, describe
from .change import Change
from .held import Saved
from .step import Step


class Kept(NamedTuple):
    """All that decides how a member goes on; the fields of `Step` by their names."""

    held: Saved
    values: Mapping[str, Any]
    t: int
    bad: bool
    spoken: tuple[int | None, ...]
    said: Any
    numbers: tuple[float, ...]
    changes: tuple[Change, ...]


Moment = Mapping[str, Kept]  # by name of the member


def keep(steps: Iterable[Step]) -> Moment:
    """Keep the state of a rig's members, all between the same two ticks.

    Raises
    ------
    RunError
        What a block is made of cannot be kept; names it and says why.
    """
    return {step.name: _kept(step) for step in steps}


def put_back(steps: Iterable[Step], moment: Moment) -> None:
    """Have members go on from a kept state: those that it was kept of, or those of the same rig wired anew.

    Raises
    ------
    RunError
        A block could not go back; names it and says why.
    """
    for step in steps:
        kept = moment[step.name]
        try:
            step.load(kept.held)
        except Exception as error:
            raise RunError(f"{step.name}: cannot go back to t = {kept.t / 1e9:.9g} s: {describe(error)}") from error
        step.values.update(kept.values)
        step.t, step.bad, step.spoken, step.said = kept.t, kept.bad, list(kept.spoken), kept.said
        step.numbers = kept.numbers
        step.plan(kept.changes)


def _kept(step: Step) -> Kept:
    try:
        held = step.save()
    except Exception as error:
        raise RunError(
            f"{step.name}: its state at t = {step.t / 1e9:.9g} s cannot be kept: {describe(error)}"
        ) from error
    return Kept(
        held, dict(step.values), step.t, step.bad, tuple(step.spoken), step.said, step.numbers, tuple(step.changes)
    )
