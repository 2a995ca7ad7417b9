"""From a voltage to the duty ratios of three legs."""

from __future__ import annotations

from typing import Literal

SQRT3 = 3.0**0.5
Modulation = Literal["sinusoidal", "third_harmonic", "space_vector", "discontinuous", "discontinuous_min"]


def linear_range(modulation: Modulation) -> float:
    """Return the largest amplitude of a sinusoidal phase voltage of the modulation, over the DC voltage."""
    return 0.5 if modulation == "sinusoidal" else 1.0 / SQRT3


def duties(u_alpha: float, u_beta: float, U_dc: float, modulation: Modulation) -> tuple[float, float, float]:
    """Return the duty ratios of the legs a, b, c for a voltage (V), clipped to 0 and 1.

    ::

        d_k = 1/2 + (u_k + u_0)/U_dc

    The zero sequence u_0 does not reach the machine. It is 0 (`sinusoidal`), a sixth of the amplitude at three times
    the angle (`third_harmonic`), minus the mean of the largest and the smallest phase voltage (`space_vector`), or what
    keeps the phase of the largest absolute value (`discontinuous`) or the smallest (`discontinuous_min`) at a rail.

    References
    ----------
    D. G. Holmes, T. A. Lipo, Pulse Width Modulation for Power Converters, IEEE Press 2003, chapters 5 and 6.
    """
    a = u_alpha / U_dc
    b = (-0.5 * u_alpha + 0.5 * SQRT3 * u_beta) / U_dc
    c = -a - b
    high, low = max(a, b, c), min(a, b, c)
    zero = 0.0
    if modulation == "third_harmonic":
        # cos(3 t) = 4 a b c/m^3 for a, b, c = m cos(t - k 2 pi/3)
        square = 2.0 / 3.0 * (a * a + b * b + c * c)
        zero = -2.0 / 3.0 * a * b * c / square if square > 0.0 else 0.0
    elif modulation == "space_vector":
        zero = -0.5 * (high + low)
    elif modulation == "discontinuous":
        zero = 0.5 - high if high >= -low else -0.5 - low
    elif modulation == "discontinuous_min":
        zero = -0.5 - low
    shift = 0.5 + zero
    return _unit(a + shift), _unit(b + shift), _unit(c + shift)


def _unit(d: float) -> float:
    return min(max(d, 0.0), 1.0)
