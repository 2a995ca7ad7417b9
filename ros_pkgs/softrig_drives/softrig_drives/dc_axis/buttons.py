"""Push buttons pressed by a script."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_core import Block, BlockParams, param, to_ns

from .ports import FORWARD, REVERSE


class StepButtonsParams(BlockParams):
    """Parameters of the buttons: the times at which each is pressed, counted from the first tick."""

    forward: tuple[float, ...] = param(
        (0.0,), "times at which the forward button is pressed", "s", each=(0.0, 1e9), live=True
    )
    reverse: tuple[float, ...] = param(
        (), "times at which the reverse button is pressed", "s", each=(0.0, 1e9), live=True
    )
    hold: float = param(0.1, "how long a press lasts", "s", gt=0.0, live=True)


class State(NamedTuple):
    """Time of the first tick, ns; None before it."""

    zero: int | None = None


class StepButtons(Block[StepButtonsParams]):
    """Publishes the state of both buttons at every tick: 1 while pressed."""

    OUTPUTS = (FORWARD, REVERSE)
    STATE = State

    def setup(self) -> None:
        """Turn the presses into intervals of ns."""
        hold = to_ns(self.p.hold)
        self._presses = {
            name: [(to_ns(at), to_ns(at) + hold) for at in getattr(self.p, name)] for name in ("forward", "reverse")
        }

    def update(self, x: State, t: int, **inputs: Any) -> tuple[State, Mapping[str, tuple[float]]]:
        """Return both buttons."""
        zero = t if x.zero is None else x.zero
        since = t - zero
        return State(zero), {
            name: (float(any(down <= since < up for down, up in presses)),) for name, presses in self._presses.items()
        }
