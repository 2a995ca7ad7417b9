"""Numbers with their derivatives, in real arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np


@dataclass(frozen=True, slots=True)
class Dual:
    """An array and its derivatives with respect to n unknowns.

    Parameters
    ----------
    value : ndarray or float
    slope : ndarray, of the value's shape and n
    """

    value: Any
    slope: Any
    # With this, numpy arrays leave their operators to this class.
    __array_priority__: ClassVar[float] = 1000.0

    def __getitem__(self, key: Any) -> Dual:
        return Dual(self.value[key], self.slope[key])

    def __add__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value + other.value, self.slope + other.slope)
        return Dual(self.value + other, self.slope)

    def __sub__(self, other: Any) -> Dual:
        return self + -1.0 * other

    def __mul__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            return Dual(self.value * other.value, self.slope * _wide(other.value) + _wide(self.value) * other.slope)
        return Dual(self.value * other, self.slope * _wide(other))

    def __truediv__(self, other: Any) -> Dual:
        if isinstance(other, Dual):
            ratio = self.value / other.value
            return Dual(ratio, (self.slope - _wide(ratio) * other.slope) / _wide(other.value))
        return Dual(self.value / other, self.slope / _wide(other))

    __radd__, __rmul__ = __add__, __mul__

    def cos(self) -> Dual:
        """Return the cosine, for `numpy.cos`."""
        return Dual(np.cos(self.value), -_wide(np.sin(self.value)) * self.slope)

    def sin(self) -> Dual:
        """Return the sine, for `numpy.sin`."""
        return Dual(np.sin(self.value), _wide(np.cos(self.value)) * self.slope)

    def sum(self, axis: int) -> Dual:
        """Add along an axis of the value, >= 0."""
        return Dual(self.value.sum(axis=axis), self.slope.sum(axis=axis))


def _wide(x: Any) -> Any:
    return x[..., None] if isinstance(x, np.ndarray) else x
