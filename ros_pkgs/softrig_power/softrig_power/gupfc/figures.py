"""Figure functions of the GUPFC: angle of the shunt converter, steadiness, power balance, distortion."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array, SignalMap, figure, window
from softrig_core.judge.measures import HALF_NS, held, interval, mean_over, newest

from .ports import TRACE

STATUS = "gupfc/status"
POWERS = tuple(f"{STATUS}/{name}/position" for name in ("p_sh", "p12", "p34"))
FREQUENCY = {"frequency": "gupfc/network.frequency"}
CYCLE = {"cycle": "gupfc/pulses.command_period"}
ANGLE, U1_ALPHA, U1_BETA = "shunt/command/angle/effort", "u1/x", "u1/y"


@figure("rad", (ANGLE, U1_ALPHA, U1_BETA))
def shunt_angle(signals: SignalMap, *, start: float | None = None, end: float | None = None) -> float:
    """Mean angle over time alpha of the shunt converter's voltage ahead of bus 1, rad."""
    t, angle, gaps = held(signals, ANGLE, start, end)
    alpha, beta = (signals[name] for name in (U1_ALPHA, U1_BETA))
    indices = newest(alpha[0], t + HALF_NS)
    if indices[0] < 0:
        raise ValueError(f"{U1_ALPHA} has no value yet at {t[0]:g} s, where {ANGLE} begins")
    turned = np.exp(1j * angle) * (alpha[1][indices] - 1j * beta[1][indices])
    return math.atan2(mean_over(turned.imag, gaps), mean_over(turned.real, gaps))


@figure("{signal}", agreed=FREQUENCY)
def drift(
    signals: SignalMap,
    signal: str,
    *,
    frequency: float,
    measure: Literal["mean", "repeat"] = "mean",
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Return how far a signal is from a periodic steady state, in its unit.

    Parameters
    ----------
    frequency : float
        Of the periodic state, Hz.
    measure : {"mean", "repeat"}
        ``mean``: largest difference of the mean over any cycle from that over the first. ``repeat``: largest
        difference of any sample from the one a cycle before.
    """
    t, x = window(signals, signal, start, end, least=2)
    samples = round(1.0 / (frequency * interval(t, signal)))
    if x.size < 2 * samples:
        raise ValueError(f"{signal}: {x.size} samples in the window, two cycles are {2 * samples}")
    if measure == "repeat":
        return float(np.abs(x[samples:] - x[:-samples]).max())
    total = np.concatenate([[0.0], np.cumsum(x)])
    means = (total[samples:] - total[:-samples]) / samples
    return float(np.abs(means - means[0]).max())


@figure("pu", POWERS)
def power_balance(
    signals: SignalMap,
    *,
    statistic: Literal["mean", "peak"] = "mean",
    start: float | None = None,
    end: float | None = None,
) -> float:
    """Return the sum of the converters' active powers, pu: positive if the DC link delivers energy.

    Parameters
    ----------
    statistic : {"mean", "peak"}
        Mean over time, or largest magnitude.
    """
    gaps = held(signals, POWERS[0], start, end)[2]
    total = np.asarray(sum(held(signals, name, start, end)[1] for name in POWERS))
    return mean_over(total, gaps) if statistic == "mean" else float(np.abs(total).max())


def cycles(
    signals: SignalMap, part: str, cycle: float, count: int, topic: str = "gupfc/trace"
) -> NDArray[np.complex128]:
    """Waveform of whole cycles at the end of a run, from the trace.

    Parameters
    ----------
    part : {"v_sh", "v12", "u1", "i_sh"}
    cycle : float
        s.
    count : int
        Cycles.

    Returns
    -------
    ndarray, shape (count x steps of a cycle,)
        Space vector, pu.
    """
    column = 2 * TRACE.index(part)
    labels = [name for name in signals if name.startswith(topic + "/")]
    steps = 1 + max(int(name.rsplit("/", 1)[1].split(",")[0]) for name in labels)
    t = window(signals, f"{topic}/0,{column}", None, None, least=2)[0]
    periods = round(cycle / interval(t[-2:], topic)) * count
    if t.size < periods:
        raise ValueError(f"{topic} has {t.size} messages, {count} cycles are {periods}")
    interval(t[-periods:], topic)
    result = np.empty((periods, steps), dtype=complex)
    for step in range(steps):
        result[:, step] = (
            signals[f"{topic}/{step},{column}"][1][-periods:]
            + 1j * signals[f"{topic}/{step},{column + 1}"][1][-periods:]
        )
    return result.ravel()


@figure("%", ("gupfc/trace/*",), FREQUENCY)
def distortion(
    signals: SignalMap, *, part: Literal["v_sh", "v12", "u1", "i_sh"], frequency: float, count: int = 3
) -> float:
    """Total harmonic distortion of a space vector over the last cycles, in % of its fundamental.

    Parameters
    ----------
    part : {"v_sh", "v12", "u1", "i_sh"}
        Waveform of the trace.
    frequency : float
        Of the fundamental, Hz.
    count : int
        Cycles.
    """
    spectrum = np.abs(np.fft.fft(cycles(signals, part, 1.0 / frequency, count)))
    first = spectrum[count]
    return float(100.0 * math.sqrt(max(0.0, float(np.square(spectrum).sum() - first**2))) / first)


def _first_cycle(signals: SignalMap, axis: str, cycle: float) -> Array:
    """Return one component of the generator's voltage over the first cycle."""
    t, x = window(signals, f"pulses/voltage/{axis}", None, None, least=2)
    t = t - t[0]
    # Stamps are whole ns, so the first sample of the next cycle may be a little early; half a sample of room leaves it
    # out.
    half = 0.5 * float(t[1])
    if t[-1] < cycle - 3.0 * half:
        raise ValueError(f"pulses/voltage is recorded to {t[-1]:g} s, a cycle lasts {cycle:g} s")
    count = int(np.searchsorted(t, cycle - half))
    interval(t[:count], "pulses/voltage")
    return x[:count]


@figure("%", ("pulses/voltage/x", "pulses/voltage/y"), CYCLE)
def voltage_harmonic(signals: SignalMap, *, order: int, cycle: float) -> float:
    """Amplitude of one order of the sampled 48-step voltage in % of its fundamental, by FFT.

    Parameters
    ----------
    order : int
        Negative for what turns against the fundamental; 1 gives the fundamental itself in % of the DC voltage.
    cycle : float
        s; what one command of the pulse generator lasts.
    """
    alpha, beta = (_first_cycle(signals, axis, cycle) for axis in "xy")
    spectrum = np.abs(np.fft.fft(alpha + 1j * beta)) / alpha.size
    return float(100.0 * spectrum[order] / (1.0 if order == 1 else spectrum[1]))


@figure("", ("pulses/voltage/x",), CYCLE)
def voltage_levels(signals: SignalMap, *, cycle: float) -> float:
    """Number of different values of phase a over the first cycle (s)."""
    return float(np.unique(np.round(_first_cycle(signals, "x", cycle), 9)).size)


@figure("rad", ("pulses/quality/thd/position", "shunt/command/sigma/effort"))
def best_sigma(signals: SignalMap) -> float:
    """Conduction angle of the sweep with the least distortion, rad."""
    t, thd = signals["pulses/quality/thd/position"]
    when, sigma = signals["shunt/command/sigma/effort"]
    best = float(t[int(np.argmin(thd))])
    index = int(newest(when, np.array([best + HALF_NS]))[0])
    if index < 0:
        raise ValueError(f"shunt/command/sigma/effort has no value yet at {best:g} s, where the distortion is least")
    return float(sigma[index])
