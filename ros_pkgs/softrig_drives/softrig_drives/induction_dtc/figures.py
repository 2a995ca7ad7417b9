"""Figure functions of the drive: flux error, flux circles, converter errors, switching.

A flux is a complex array alpha + j beta in Wb, or its two parts; `start` and `end` (s) limit the samples as in
`softrig_core.judge.measures`.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array, SignalMap, figure, window
from softrig_core.judge.measures import HALF_NS, Places, held, mean_over, mean_square_over, newest, places, shared
from softrig_core.judge.sums import fixed, pairs, products
from softrig_core.wire.long import elementwise, gathered, is_long, true_places
from softrig_core.wire.times import once_for_times

Vectors = NDArray[np.complex128]
Component = Literal["alpha", "beta", "magnitude"]
SMALL = 1e-250  # squares beyond this or its inverse may have lost digits
FLUX_ERROR = ("flux_estimate/x", "flux_estimate/y", "flux_true/x", "flux_true/y")


def slope(t: Array, psi: Vectors) -> complex:
    """Return the slope (per s) of the least-squares line through each component, as alpha + j beta."""
    centred, squares = _centred(t)
    if not centred.any():
        return complex(np.nan, np.nan)
    if is_long(psi):
        return complex((centred * (psi - psi.mean())).sum() / squares)
    # Part by part in place, which is the product of a real and a complex number without new arrays.
    mean, product = psi.mean(), psi.copy()
    for component, middle in ((product.real, mean.real), (product.imag, mean.imag)):
        component -= middle
        component *= centred
    return complex(product.sum() / squares)


def _slope(t: Array, alpha: Array, beta: Array) -> complex:
    """Return the slope as `slope` does, by native code where that saves time."""
    if is_long(alpha):
        return slope(t, _complex(alpha, beta))
    arguments = fixed(alpha), fixed(beta), 0.0, 0.0, _ones(t), pairs(len(alpha), 2)
    if not products.pays(*arguments):  # type: ignore[attr-defined]
        return slope(t, _complex(alpha, beta))
    centred, squares = _centred(t)
    if not centred.any():
        return complex(np.nan, np.nan)
    mean = np.complex128(complex(*products(*arguments))) / len(alpha)
    total = products(*arguments[:2], float(mean.real), float(mean.imag), fixed(centred), arguments[-1])
    return complex(np.complex128(complex(*total)) / squares)


@once_for_times
def _ones(t: Array) -> Array:
    return fixed(np.ones(len(t)))


@once_for_times
def _centred(t: Array) -> tuple[Array, np.float64]:
    """Return times less their mean, and the sum of their squares."""
    centred = t - t.mean()
    return centred, (centred**2).sum()


def last_revolution(psi: Vectors) -> Vectors | None:
    """Cut a vector that turns around the origin to its last 360 degrees; None when it has turned less."""
    angle = np.unwrap(np.angle(psi))
    before = np.flatnonzero(np.abs(angle - angle[-1]) >= 2.0 * np.pi)
    return psi[before[-1] + 1 :] if before.size else None


def circle(psi: Vectors) -> tuple[complex, float]:
    """Fit a circle.

    ::

        |psi|^2 = 2 Re(conj(centre) psi) + radius^2 - |centre|^2          least squares (Kasa)

    Returns
    -------
    centre : complex
    radius : float
    """
    columns = np.column_stack((2.0 * psi.real, 2.0 * psi.imag, np.ones(psi.size)))
    (alpha, beta, remaining), *_ = np.linalg.lstsq(columns, np.abs(psi) ** 2, rcond=None)
    return complex(alpha, beta), float(np.sqrt(remaining + alpha**2 + beta**2))


def largest(alpha: Array, beta: Array) -> float:
    """Return the largest magnitude; that of each vector would take most of the time of a short run's figures."""
    squares: Array = alpha * alpha
    squares += beta * beta
    most = float(np.max(squares))
    # Rounding changes a square by less than 1e-15 of it, so that of the largest magnitude is among these.
    if SMALL < most < 1.0 / SMALL:
        near = np.flatnonzero(squares >= most * (1.0 - 1e-12))
        alpha, beta = alpha[near], beta[near]
    return float(np.max(np.abs(_complex(alpha, beta))))


@elementwise
def _complex(alpha: Array, beta: Array) -> Vectors:
    psi = np.empty(alpha.size, np.complex128)
    psi.real, psi.imag = alpha, beta
    return psi


def leg_transitions(switches: Array) -> int:
    """Count the changes of one leg, shape (n,), or of all legs, shape (n, 3)."""
    return int(np.count_nonzero(switches[1:] != switches[:-1]))


@figure("Wb", FLUX_ERROR)
def flux_error_peak(signals: SignalMap, *, start: float | None = None, end: float | None = None) -> float:
    """Largest |psi_hat - psi| in Wb."""
    return largest(*_flux_error(signals, start, end)[1:])


@figure("Wb", FLUX_ERROR)
def flux_error_end(signals: SignalMap, *, end: float | None = None) -> float:
    """|psi_hat - psi| in Wb at the last control instant."""
    _, alpha, beta = _flux_error(signals, None, end)
    return float(np.abs(_complex(alpha[-1:], beta[-1:]))[0])


@figure("Wb/s", FLUX_ERROR)
def flux_error_slope(
    signals: SignalMap, *, component: Component = "magnitude", start: float = 0.3, end: float | None = None
) -> float:
    """Slope of psi_hat - psi by least squares, in Wb/s."""
    t, alpha, beta = _flux_error(signals, start, end)
    return _component(_slope(t, alpha, beta), component)


@figure("deg", FLUX_ERROR)
def flux_error_direction(signals: SignalMap, *, start: float = 0.3, end: float | None = None) -> float:
    """Direction in degrees into which psi_hat - psi grows, by least squares."""
    t, alpha, beta = _flux_error(signals, start, end)
    return float(np.degrees(np.angle(_slope(t, alpha, beta))))


@figure(
    "LSB",
    tuple(f"currents_{kind}/{channel}" for kind in ("meas", "true") for channel in "xy"),
    {"lsb": "induction_dtc/lsb"},
)
def converter_error(
    signals: SignalMap,
    *,
    lsb: float,
    channel: Literal["x", "y"] = "x",
    statistic: Literal["mean", "std"] = "mean",
    start: float = 0.3,
    end: float | None = None,
) -> float:
    """Mean or standard deviation of measured less true phase current in LSB (A); channel x is i_a, y is i_b.

    Over time, each pair of samples of the same instant until the next measurement.
    """
    key = "converter_error", channel, lsb, start, end
    error, holds = shared(signals, key, lambda: _converter_error(signals, channel, lsb, start, end))
    mean = mean_over(error, holds)
    return mean if statistic == "mean" else math.sqrt(mean_square_over(error, holds, mean))


def _converter_error(
    signals: SignalMap, channel: str, lsb: float, start: float, end: float | None
) -> tuple[Array, Array]:
    """Return measured minus true current in LSB, and how long each value is valid, ns."""
    t, x, holds = held(signals, f"currents_meas/{channel}", start, end)
    true = f"currents_true/{channel}"
    indices, both, _ = _same(signals, true, t)
    return (gathered(x, both) - gathered(signals[true][1], indices)) / lsb, gathered(holds, both)


@figure("Wb")
def circle_centre(
    signals: SignalMap, *, topic: str = "flux_true", component: Component = "magnitude", end: float | None = None
) -> float:
    """Centre of the flux circle over the last revolution in Wb; NaN before a revolution."""
    turn = last_revolution(_complex(*_vector(signals, topic, None, end)[1:]))
    return float("nan") if turn is None else _component(circle(turn)[0], component)


@figure("Wb")
def flux_magnitude(
    signals: SignalMap,
    *,
    topic: str,
    extreme: Literal["min", "max"],
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Smallest or largest |psi| in Wb."""
    _, alpha, beta = _vector(signals, topic, start, end)
    return largest(alpha, beta) if extreme == "max" else float(np.abs(_complex(alpha, beta)).min())


@figure("A", tuple(f"currents_true/{phase}" for phase in "xyz"))
def current_peak(signals: SignalMap, *, start: float | None = None, end: float | None = None) -> float:
    """Largest true phase current in A."""
    phases = (window(signals, f"currents_true/{phase}", start, end)[1] for phase in "xyz")
    return max(float(np.abs(i).max()) for i in phases)


@figure("Hz", tuple(f"switches/{leg}/effort" for leg in ("Sa", "Sb", "Sc")))
def switching_frequency(signals: SignalMap) -> float:
    """Mean switching frequency of the six devices in Hz over the whole run: leg transitions / 6 / duration."""
    legs = [window(signals, f"switches/{leg}/effort", None, None, least=2) for leg in ("Sa", "Sb", "Sc")]
    t = legs[0][0]
    return sum(leg_transitions(x) for _, x in legs) / 6.0 / float(t[-1] - t[0])


def _vector(signals: SignalMap, topic: str, start: float | None, end: float | None) -> tuple[Array, Array, Array]:
    (t, alpha), (_, beta) = (window(signals, f"{topic}/{axis}", start, end) for axis in "xy")
    return t, alpha, beta


def _flux_error(signals: SignalMap, start: float | None, end: float | None) -> tuple[Array, Array, Array]:
    """Pair estimate and truth of the same instants; the truth has one sample more, the end of the run."""
    times, alpha, beta = shared(signals, "flux_error", lambda: _new_flux_error(signals, None, None))
    first = 0 if start is None else int(np.searchsorted(times, start - HALF_NS))
    last = len(times) if end is None else int(np.searchsorted(times, end + HALF_NS, side="right"))
    # Without a sample it raises an error that names what is missing.
    return (
        (times[first:last], alpha[first:last], beta[first:last])
        if first < last
        else _new_flux_error(signals, start, end)
    )


def _new_flux_error(signals: SignalMap, start: float | None, end: float | None) -> tuple[Array, Array, Array]:
    t, *estimate = _vector(signals, "flux_estimate", start, end)
    indices, both, times = _same(signals, "flux_true/x", t)
    alpha, beta = (
        gathered(component, both) - gathered(signals[f"flux_true/{axis}"][1], indices)
        for component, axis in zip(estimate, "xy", strict=True)
    )
    return times, alpha, beta


def _same(signals: SignalMap, name: str, t: Array) -> tuple[Places, Places, Array]:
    """Return the places of a signal's samples of the same instants, which of the instants those are, and the instants.

    Raises
    ------
    ValueError
        There is no common sample.
    """
    indices, both, times = _together(signals[name][0], t)
    if not times.size:
        raise ValueError(f"{name} has no sample at any of the {t.size} instants from {t[0]:g} s to {t[-1]:g} s")
    return indices, both, times


@once_for_times
def _together(when: Array, t: Array) -> tuple[Places, Places, Array]:
    indices = newest(when, t + HALF_NS)
    both = true_places((indices >= 0) & (t - gathered(np.append(when, np.inf), indices) < HALF_NS))
    return places(gathered(indices, both)), both if isinstance(both, slice) else places(both), gathered(t, both)


def _component(z: complex, component: Component) -> float:
    return {"alpha": z.real, "beta": z.imag, "magnitude": abs(z)}[component]
