"""Prediction of the present state from a late one by replaying the commands issued since."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from softrig_core import History

from .discretise import Matrix, matmul


class Commands(NamedTuple):
    """Commands of the last periods, as many as are kept; so many of them are known, the others 0."""

    line: History
    known: int


@lru_cache(maxsize=64)  # runs of a study often share their plant
def _powers(phi: Matrix, gamma: Matrix, capacity: int) -> tuple[list[float], list[list[float]]]:
    """Return Phi^D, one after the other, and Phi^j Gamma, of each state a sequence over j."""
    n = len(phi)
    power: Matrix = tuple(tuple(float(i == j) for j in range(n)) for i in range(n))
    powers, impulse = [x for row in power for x in row], []
    for _ in range(capacity):
        impulse.append([row[0] for row in matmul(power, gamma)])
        power = matmul(phi, power)
        powers += [x for row in power for x in row]
    return powers, [list(row) for row in zip(*impulse, strict=True)]


class CommandReplay:
    """State at t_k from the state at t_(k-D) through the exact sampled plant.

    x(k) = Phi^D x(k-D) + sum_(m=0)^(D-1) Phi^(D-1-m) Gamma u(k-D+m)

    For a plant without delay inside this equals a Smith predictor whose state is restarted at every measurement. It
    also serves an integrating plant, where the plain Smith form keeps a model that drifts away.

    Parameters
    ----------
    phi : (n, n) nested sequence
        State matrix over one period.
    gamma : (n, 1) nested sequence
        Input matrix over one period.
    capacity : int
        Number of commands kept, the largest D.
    """

    def __init__(self, phi: Sequence[Sequence[float]], gamma: Sequence[Sequence[float]], capacity: int) -> None:
        self._size = len(phi)
        self._powers, self._impulse = _powers(tuple(map(tuple, phi)), tuple(map(tuple, gamma)), capacity)
        self._capacity = capacity

    def nothing(self) -> Commands:
        """Return the commands known before the first."""
        return Commands(History(step=1.0, longest=self._capacity), 0)

    def record(self, history: Commands, u: float) -> Commands:
        """Return the known commands with that of this period, as issued (after saturation)."""
        return Commands(history.line.put((u,)), min(history.known + 1, self._capacity))

    def present(self, history: Commands, x: Sequence[float], late: int) -> tuple[float, ...]:
        """Predict the state now.

        Parameters
        ----------
        x : (n,) sequence
            State `late` periods ago.
        late : int
            D, from 0 to the number of commands known.
        """
        state, n = [], self._size
        for i in range(n):
            total, impulse = 0.0, self._impulse[i]
            for j in range(n):
                total += self._powers[(late * n + i) * n + j] * x[j]
            for k in range(late):
                total += impulse[k] * history.line.back(k)[0]
            state.append(total)
        return tuple(state)
