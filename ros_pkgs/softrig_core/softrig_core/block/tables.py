"""All that changes while a rig runs, stored between two ticks so that the rig can return to it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ..errors import RunError, describe
from .held import Kept
from .step import Step

Moment = Mapping[str, Kept]  # values by name of the member


class Tables:
    """State of the nodes of a rig, or of some of them: one row a node, with the fields of `RunningBlock`.

    Parameters
    ----------
    steps : iterable of Step
        All between the same two ticks whenever they are kept.
    """

    def __init__(self, steps: Iterable[Step]) -> None:
        self._steps = tuple(steps)

    def keep(self) -> Moment:
        """Return a copy of the present contents.

        Raises
        ------
        RunError
            The state of a block cannot be stored; the message names the block and the reason.
        """
        result: dict[str, Kept] = {}
        for step in self._steps:
            try:
                result[step.name] = step.save()
            except Exception as error:
                raise RunError(
                    f"{step.name}: its state at t = {step.t / 1e9:.9g} s cannot be kept: {describe(error)}"
                ) from error
        return result

    def go_back(self, moment: Moment) -> None:
        """Restore a stored state, of this rig or of one built from the same scenario; any number of times.

        Raises
        ------
        RunError
            A block could not be restored; the message names the block and the reason.
        """
        for step in self._steps:
            stored = moment[step.name]
            try:
                step.load(stored)
            except Exception as error:
                t = stored.values["t"]
                raise RunError(f"{step.name}: cannot go back to t = {t / 1e9:.9g} s: {describe(error)}") from error
