"""Figures of the queue loop that the general ones lack; called as ``f(signals, **arguments)``."""

from __future__ import annotations

import numpy as np
from softrig_core import SignalMap, figure

from .model import Bottleneck, equilibrium


@figure("{signal}^2")
def mean_square(signals: SignalMap, signal: str, *, reference: float = 0.0) -> float:
    """Mean of (signal - reference)^2 over all samples of the run, the J of the paper's tables.

    Mean squares are the only reading of the undefined J that fits the sizes printed.
    """
    _, x = signals[signal]
    return float(np.mean((x - reference) ** 2))


@figure("{signal}^2")
def mean_square_window(signals: SignalMap, signal: str, *, queue: float, N: int, C: float, tau_p: float) -> float:
    """Mean of (signal - w0)^2, w0 the window that holds the queue (packets) on this bottleneck: J_w of the paper."""
    return mean_square(signals, signal, reference=equilibrium(Bottleneck(N=N, C=C, tau_p=tau_p), queue).window)


@figure("{signal}")
def deviation(signals: SignalMap, signal: str, *, last: float = 5.0) -> float:
    """Standard deviation of the last `last` seconds."""
    t, x = signals[signal]
    return float(np.std(x[t >= t[-1] - last - 1e-6]))


@figure("", reads=["network/truth/served/position"])
def utilisation(signals: SignalMap, *, capacity: float) -> float:
    """Packets served over those that the link could have served at `capacity` (packet/s)."""
    t, served = signals["network/truth/served/position"]
    return float(served[-1] - served[0]) / (capacity * float(t[-1] - t[0]))
