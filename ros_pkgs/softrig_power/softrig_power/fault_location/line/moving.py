"""The state of the line as a value, and its native form, which updates the arrays in place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from softrig_core import Array
from softrig_core.kit import floats

from .measurement import Chain
from .network import Network
from .simulation import State, advance

Row = tuple[float, ...]


class Parts(NamedTuple):
    """Constant parts of the equations that advance a state."""

    net: Network
    chain: Chain
    transform: Array  # Clarke's


class Moving:
    """The line at a sample, a value: a later sample is another one.

    Parameters
    ----------
    state : State
        Nothing writes into its arrays from now on.
    """

    __slots__ = ("parts", "state")

    def __init__(self, parts: Parts, state: State) -> None:
        self.parts, self.state = parts, state

    def measured(self) -> Row:
        """Return the present samples, without noise, 12 values in V and A."""
        return tuple(self.state.measured.tolist())

    def fault_current(self) -> Row:
        """Return the current of the fault in each phase, A."""
        return tuple(self.state.fault_current.tolist())

    def moved(self, k: int, steps: int) -> Moving:
        """Return the line some steps after step k; see `simulation.advance`."""
        state = _copied(self.state)
        advance(*self.parts, state, k, steps)
        return Moving(self.parts, state)

    def native(self) -> MovingRows:
        """Return its native form."""
        return MovingRows(self.parts, _copied(self.state))

    def numbers(self) -> Array:
        """Return all its numbers in one row, which a linear view uses as states."""
        return floats.numbers(self.state)

    def with_numbers(self, row: Array) -> Moving:
        """Return it with other numbers, in the order of `numbers`."""
        return Moving(self.parts, floats.put(self.state, floats.split(self.state, row)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Moving):
            return NotImplemented
        return all(np.array_equal(a, b) for a, b in zip(self.state, other.state, strict=True))


class MovingRows(NamedTuple):
    """A `Moving` in native code, which moves its arrays in place."""

    parts: Parts
    state: State

    def measured(self) -> Row:
        """See `Moving.measured`."""
        return tuple(self.state.measured.tolist())

    def fault_current(self) -> Row:
        """See `Moving.fault_current`."""
        return tuple(self.state.fault_current.tolist())

    def moved(self, k: int, steps: int) -> MovingRows:
        """See `Moving.moved`."""
        advance(self.parts.net, self.parts.chain, self.parts.transform, self.state, k, steps)
        return self

    def python(self) -> Moving:
        """Return its Python form."""
        return Moving(self.parts, _copied(self.state))


def _copied(state: State) -> State:
    return State._make([array.copy() for array in state])
