"""A homogeneous line of one mode: constants, travelling-wave quantities and sinusoidal two-ports."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np
from softrig_core import Complex


@dataclass(frozen=True)
class Section:
    """A stretch of line with evenly distributed constants, one mode of propagation.

    Parameters
    ----------
    r : float
        Resistance, ohm/km, >= 0.
    l : float
        Inductance, H/km, > 0.
    c : float
        Capacitance, F/km, > 0.
    length : float
        km, > 0.

    Raises
    ------
    ValueError
        A constant is impossible for a line; the message names it.
    """

    r: float
    l: float  # noqa: E741
    c: float
    length: float

    def __post_init__(self) -> None:
        for name in ("r", "l", "c", "length"):
            value = getattr(self, name)
            if not math.isfinite(value) or value < 0.0 or (value == 0.0 and name != "r"):
                raise ValueError(
                    f"{name} = {value!r}: expected a {'non-negative' if name == 'r' else 'positive'} number"
                )

    @property
    def velocity(self) -> float:
        """Speed of the waves 1/sqrt(l c), km/s."""
        return 1.0 / math.sqrt(self.l * self.c)

    @property
    def tau(self) -> float:
        """Travel time from end to end, s."""
        return self.length / self.velocity

    @property
    def z(self) -> float:
        """Surge impedance sqrt(l/c) of the lossless line Z, ohm."""
        return math.sqrt(self.l / self.c)

    @property
    def resistance(self) -> float:
        """Resistance of the whole section R, ohm."""
        return self.r * self.length

    @property
    def z_plus(self) -> float:
        """Z' = Z + R/4, ohm."""
        return self.z + 0.25 * self.resistance

    @property
    def z_minus(self) -> float:
        """Z'' = Z - R/4, ohm."""
        return self.z - 0.25 * self.resistance

    def part(self, length: float) -> Section:
        """Return a section of another length (km) of the same line."""
        return Section(self.r, self.l, self.c, length)

    def propagation(self, omega: float) -> complex:
        """Propagation constant gamma = sqrt((r + j omega l) j omega c), 1/km."""
        return cmath.sqrt(complex(self.r, omega * self.l) * complex(0.0, omega * self.c))

    def characteristic_impedance(self, omega: float) -> complex:
        """Characteristic impedance sqrt((r + j omega l)/(j omega c)), ohm."""
        return cmath.sqrt(complex(self.r, omega * self.l) / complex(0.0, omega * self.c))

    def exact_two_port(self, omega: float) -> Complex:
        r"""Nodal admittance of the section with distributed resistance (telegraph equations).

        .. math::
            \begin{pmatrix} I_k \\ I_m \end{pmatrix} = \frac{1}{Z_c \sinh \gamma \ell}
            \begin{pmatrix} \cosh \gamma \ell & -1 \\ -1 & \cosh \gamma \ell \end{pmatrix}
            \begin{pmatrix} U_k \\ U_m \end{pmatrix}

        Parameters
        ----------
        omega : float
            Angular frequency, rad/s.

        Returns
        -------
        ndarray, shape (2, 2)
            S; both currents flow into the section.
        """
        angle = self.propagation(omega) * self.length
        scale = 1.0 / (self.characteristic_impedance(omega) * cmath.sinh(angle))
        return _symmetric(scale * cmath.cosh(angle), -scale)

    def bergeron_two_port(self, omega: float, delay: complex | None = None) -> Complex:
        """Nodal admittance of the lossy Bergeron section (R/4, R/2, R/4 lumped), shape (2, 2), S.

        With M = [[R/4, Z], [Z, R/4]]/Z'^2 and the delay factor D the equations of `bergeron.Lines` read
        I = U/Z' - D M (U + Z'' I), so Y = (1 + D Z'' M)^-1 (1/Z' - D M); for the sum and the difference of the two
        ends M is the number (R/4 + Z)/Z'^2 and (R/4 - Z)/Z'^2.

        Parameters
        ----------
        omega : float
            Angular frequency, rad/s.
        delay : complex, optional
            D; exp(-j omega tau) when absent, the factor of an interpolated history for the discrete network.
        """
        d = cmath.exp(-1j * omega * self.tau) if delay is None else delay
        both, apart = (
            (1.0 / self.z_plus - d * m) / (1.0 + d * self.z_minus * m)
            for m in ((0.25 * self.resistance + z) / self.z_plus**2 for z in (self.z, -self.z))
        )
        return _symmetric(0.5 * (both + apart), 0.5 * (both - apart))


def _symmetric(diagonal: complex, mutual: complex) -> Complex:
    return np.array([[diagonal, mutual], [mutual, diagonal]])
