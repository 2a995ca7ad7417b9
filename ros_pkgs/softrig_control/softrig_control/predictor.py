"""Prediction of the present state from a late one by replaying the commands issued since."""

from __future__ import annotations

from collections.abc import Sequence

from .discretise import Matrix, matmul


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
        n = len(phi)
        power: Matrix = tuple(tuple(float(i == j) for j in range(n)) for i in range(n))
        self._powers = [power]  # Phi^D
        impulse = []  # Phi^j Gamma
        for _ in range(capacity):
            impulse.append([row[0] for row in matmul(power, gamma)])
            power = matmul(phi, power)
            self._powers.append(power)
        self._impulse = list(zip(*impulse, strict=True))  # one sequence over j a state
        self._capacity = capacity

    def record(self, history: tuple[float, ...], u: float) -> tuple[float, ...]:
        """Give the commands known with that of this period, as issued (after saturation), newest first."""
        return (u, *history[: self._capacity - 1]) if self._capacity else ()

    def present(self, history: tuple[float, ...], x: Sequence[float], late: int) -> tuple[float, ...] | None:
        """Predict the state now.

        Parameters
        ----------
        history : tuple of float
            Commands known, newest first; () at the start.
        x : (n,) sequence
            State `late` periods ago.
        late : int
            D >= 0.

        Returns
        -------
        tuple of float or None
            None when the commands of the last D periods are not all known.
        """
        if late > len(history):
            return None
        recent = history[:late]
        state = []
        for row, impulse in zip(self._powers[late], self._impulse, strict=True):
            total = 0.0
            for a, b in zip(row, x, strict=True):
                total += a * b
            for g, u in zip(impulse, recent, strict=False):
                total += g * u
            state.append(total)
        return tuple(state)
