"""Modal transforms of a transposed three-phase line: orthonormal Clarke and Karrenbauer."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

_S = math.sqrt

CLARKE: Matrix = _S(2.0 / 3.0) * np.array([[_S(0.5), _S(0.5), _S(0.5)], [1.0, -0.5, -0.5], [0.0, _S(0.75), -_S(0.75)]])
"""Phases (a, b, c) to modes (0, alpha, beta), orthonormal: the inverse is the transpose."""

KARRENBAUER: Matrix = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.0], [1.0, 0.0, -1.0]]) / 3.0
"""Phases to modes (0, 1, 2) with mode 1 = (a - b)/3 and mode 2 = (a - c)/3 (Faramarzi and Ghaffarzadeh, eq. 20)."""

KARRENBAUER_INVERSE: Matrix = np.array([[1.0, 1.0, 1.0], [1.0, -2.0, 1.0], [1.0, 1.0, -2.0]])
"""Modes to phases (eq. 23)."""

AERIAL: Matrix = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0], [-1.0, 0.0, 1.0]]) / 3.0
"""Phases to the three aerial modes (a - b)/3, (b - c)/3, (c - a)/3, of which every fault excites at least two."""
for _matrix in (CLARKE, KARRENBAUER, KARRENBAUER_INVERSE, AERIAL):
    _matrix.setflags(write=False)
