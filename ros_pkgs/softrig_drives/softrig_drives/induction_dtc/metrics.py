"""Metrics of the scenarios: flux error, flux circles, converter errors, switching.

Every function is called as ``f(signals, **arguments)``; `start` and `end` (s) limit the samples, both included.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from softrig_core.rig.metrics import SignalMap

from .figures import Array, Vectors, circle, device_frequency, last_revolution, slope

Component = Literal["alpha", "beta", "magnitude", "angle"]


def flux_error_peak(signals: SignalMap, *, start: float = 0.0, end: float = np.inf) -> float:
    """Largest |psi_hat - psi| in Wb."""
    return float(np.abs(_flux_error(signals, start, end)[1]).max())


def flux_error_end(signals: SignalMap, *, end: float = np.inf) -> float:
    """|psi_hat - psi| in Wb at the last control instant."""
    return float(np.abs(_flux_error(signals, 0.0, end)[1][-1]))


def flux_error_slope(
    signals: SignalMap, *, component: Component = "magnitude", start: float = 0.3, end: float = np.inf
) -> float:
    """Slope of psi_hat - psi by least squares, in Wb/s; of the component ``angle`` its direction in degrees."""
    return _component(slope(*_flux_error(signals, start, end)), component)


def converter_error(
    signals: SignalMap, *, channel: Literal["x", "y"] = "x", statistic: Literal["mean", "std"] = "mean", lsb: float,
    start: float = 0.3, end: float = np.inf,
) -> float:  # fmt: skip
    """Mean or standard deviation of measured less true phase current in LSB; channel x is i_a, y is i_b."""
    t, measured = signals[f"currents_meas/{channel}"]
    inside = (t >= start) & (t <= end)
    error = (measured - signals[f"currents_true/{channel}"][1])[inside] / lsb
    return float(error.mean() if statistic == "mean" else error.std())


def circle_centre(
    signals: SignalMap, *, topic: str = "flux_true", component: Component = "magnitude", end: float = np.inf
) -> float:
    """Centre of the flux circle over the last revolution in Wb (its direction in degrees); NaN before a revolution."""
    t, psi = _vector(signals, topic)
    turn = last_revolution(psi[t <= end])
    return float("nan") if turn is None else _component(circle(turn)[0], component)


def flux_magnitude(
    signals: SignalMap, *, topic: str, extreme: Literal["min", "max"], start: float = 0.0, end: float = np.inf
) -> float:
    """Smallest or largest |psi| in Wb."""
    t, psi = _vector(signals, topic)
    size = np.abs(psi[(t >= start) & (t <= end)])
    return float(size.min() if extreme == "min" else size.max())


def current_peak(signals: SignalMap, *, start: float = 0.0, end: float = np.inf) -> float:
    """Largest true phase current in A."""
    t = signals["currents_true/x"][0]
    inside = (t >= start) & (t <= end)
    return max(float(np.abs(signals[f"currents_true/{phase}"][1][inside]).max()) for phase in "xyz")


def switching_frequency(signals: SignalMap) -> float:
    """Mean switching frequency of a device in Hz over the whole run."""
    legs = [signals[f"switches/{leg}/effort"] for leg in ("Sa", "Sb", "Sc")]
    return device_frequency(np.column_stack([x for _, x in legs]), float(legs[0][0][-1]))


def _vector(signals: SignalMap, topic: str) -> tuple[Array, Vectors]:
    t, alpha = signals[f"{topic}/x"]
    return t, alpha + 1j * signals[f"{topic}/y"][1]


def _flux_error(signals: SignalMap, start: float, end: float) -> tuple[Array, Vectors]:
    """Pair estimate and truth of the same instant; the truth has one sample more, the end of the run."""
    t, estimate = _vector(signals, "flux_estimate")
    inside: NDArray[np.bool_] = (t >= start) & (t <= end)
    return t[inside], (estimate - _vector(signals, "flux_true")[1][: t.size])[inside]


def _component(z: complex, component: Component) -> float:
    parts = {"alpha": z.real, "beta": z.imag, "magnitude": abs(z), "angle": float(np.degrees(np.angle(z)))}
    return parts[component]
