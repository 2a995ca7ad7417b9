"""Figures of the queue loop that the general ones lack; called as ``f(signals, **arguments)``."""

from __future__ import annotations

import math

import numpy as np
from softrig_core import SignalMap, figure, window
from softrig_core.judge.measures import held, mean_over, mean_square

from .model import Bottleneck, equilibrium


@figure("{signal}^2", (), {"N": "tcp/N", "C": "tcp/C", "tau_p": "tcp/tau_p"})
def mean_square_window(signals: SignalMap, signal: str, *, queue: float | str, N: int, C: float, tau_p: float) -> float:
    """Mean of (signal - w0)^2, w0 the window that holds the queue (packets) on this bottleneck: J_w of the paper.

    The mean is over time. The paper does not define its J; only mean squares agree with the printed values.

    Parameters
    ----------
    queue : float or str
        Packets, or the name of the signal that asks for them.
    """
    network = Bottleneck(N=N, C=C, tau_p=tau_p)
    if not isinstance(queue, str):
        return mean_square(signals, signal, reference=equilibrium(network, queue).window)
    when, asked = signals[queue]
    windows = np.array([equilibrium(network, q).window for q in asked.tolist()])
    return mean_square({signal: signals[signal], queue: (when, windows)}, signal, reference=queue)


@figure("{signal}")
def deviation(signals: SignalMap, signal: str, *, last: float = 5.0) -> float:
    """Standard deviation over time of the last `last` seconds."""
    t, _ = window(signals, signal, None, None)
    _, x, gaps = held(signals, signal, float(t[-1]) - last)
    return math.sqrt(mean_over((x - mean_over(x, gaps)) ** 2, gaps))


@figure("", ["network/truth/served/position"], {"capacity": "tcp/C"})
def utilisation(signals: SignalMap, *, capacity: float) -> float:
    """Packets served over those that the link could have served at `capacity` (packet/s)."""
    t, served = window(signals, "network/truth/served/position", None, None, least=2)
    return float(served[-1] - served[0]) / (capacity * float(t[-1] - t[0]))
