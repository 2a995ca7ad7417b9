"""Queue control laws: each computes the drop probability, before clipping, from the controller's measurements.

Notation of all: e = q - q_d; q' = N w/R - C, not clipped at an empty or full queue; Phi and Psi as in `model`, so that
q'' = Phi + Psi u.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Protocol

from softrig_control.sliding_mode import switching
from softrig_core import Params, param


class Gains(Params):
    """Gains of every law; each uses its own."""

    k1: float = param(15.0, "sspd: reaching gain k1", "1/s", ge=0.0, le=1e4, live=True)
    k2: float = param(10.0, "sspd: switching gain k2", "packet/s^2", ge=0.0, le=1e7, live=True)
    lam: float = param(20.0, "sspd: slope lambda of the surface", "1/s", ge=0.0, le=1e4, live=True)
    l1: float = param(16.0, "sspid: gain of e in the surface", "1/s", ge=0.0, le=1e4, live=True)
    l2: float = param(64.0, "sspid: gain of the integral in the surface", "1/s^2", ge=0.0, le=1e6, live=True)
    k: float = param(5.0, "sspid: switching gain k", "packet/s^2", ge=0.0, le=1e7, live=True)
    kp: float = param(
        4.2196e-5, "pi: proportional gain, the paper's 4.2196 times 1e-5", "1/packet", ge=0.0, le=100.0, live=True
    )
    ki: float = param(
        3.7056e-5, "pi: integral gain, the paper's 3.7056 times 1e-5", "1/(packet s)", ge=0.0, le=100.0, live=True
    )
    bias: float = param(0.0, "pi: drop probability around which it works", ge=0.0, le=1.0, live=True)
    pid_gain: float = param(2.9067e-5, "pid: gain, eq. (34)", "1/packet", ge=0.0, le=100.0, live=True)
    pid_ti: float = param(5.45, "pid: integral time", "s", gt=0.0, le=1e6, live=True)
    pid_td: float = param(0.4157, "pid: derivative time", "s", ge=0.0, le=1e3, live=True)
    a: float = param(2.5, "robust: triple pole of the closed loop", "1/s", gt=0.0, le=100.0, live=True)
    boundary: float = param(
        0.0,
        "sspd, sspid: half width of the boundary layer, in which sign(s) is s/boundary",
        "packet/s",
        ge=0.0,
        le=1e7,
        live=True,
    )


class Measured(NamedTuple):
    """Inputs of a law at one tick; `derivative` is the backward difference of e in packet/s."""

    e: float
    rate: float
    phi: float
    psi: float
    derivative: float
    integral: float


class Decision(NamedTuple):
    """Drop probability before clipping, and the surface s (0 for a law without one; packet/s)."""

    u: float
    s: float


class Law(Protocol):
    """Signature of a law."""

    def __call__(self, m: Measured, g: Gains) -> Decision:
        """Decide for one tick."""


LawName = Literal["sspd", "sspid", "pi", "pid", "robust"]


def sign(s: float, width: float) -> float:
    """Return sign(s); with a boundary layer s/width, clipped to [-1, 1]."""
    return min(max(s / width, -1.0), 1.0) if width > 0.0 else switching(s)


def sspd(m: Measured, g: Gains) -> Decision:
    """Sliding mode on a PD surface, eq. (21)-(25).

    ::

        s = q' + lambda e
        u = (-k1 s - k2 sign(s) - lambda q' - Phi)/Psi

    With the exact model and without clipping e'' + (k1 + lambda) e' + k1 lambda e = -k2 sign(s): s reaches 0 in finite
    time for k2 > 0 (eq. (29) states asymptotically), but not with the delay of a network. The chatter of u is k2/|Psi|.
    """
    s = m.rate + g.lam * m.e
    return Decision((-g.k1 * s - g.k2 * sign(s, g.boundary) - g.lam * m.rate - m.phi) / m.psi, s)


def sspid(m: Measured, g: Gains) -> Decision:
    """Sliding mode on a PID surface, eq. (7), (20) with the one minus sign that belongs there.

    ::

        s = q' + l1 e + l2 int e dt
        u = (-Phi - l1 q' - l2 e - k sign(s))/Psi

    k must exceed the error of the model: 10 % of N are thousands of packet/s^2. The integral winds up while the queue
    fills, so s never comes to 0.
    """
    s = m.rate + g.l1 * m.e + g.l2 * m.integral
    return Decision((-m.phi - g.l1 * m.rate - g.l2 * m.e - g.k * sign(s, g.boundary)) / m.psi, s)


def pi(m: Measured, g: Gains) -> Decision:
    """Proportional and integral, u = bias + kp e + ki int e dt, eq. (33).

    The paper's 4.2196 and 3.7056 lack a factor 1e-5. The formula itself, at R0 = 0.232 s with tau_c = 1.5 R0, gives
    kp = 5.6492e-5, ki = 3.1419e-5.
    """
    return Decision(g.bias + g.kp * m.e + g.ki * m.integral, 0.0)


def pid(m: Measured, g: Gains) -> Decision:
    """PID of Wang, Rong and Liu (2008), u = K (e + int e dt/Ti + Td e'), eq. (34)."""
    return Decision(g.pid_gain * (m.e + m.integral / g.pid_ti + g.pid_td * m.derivative), 0.0)


def robust(m: Measured, g: Gains) -> Decision:
    """Linearising law with an integral and a triple pole slow enough for the delay of the network.

    ::

        u = (-Phi - 3 a q' - 3 a^2 e - a^3 int e dt)/Psi

    The integral compensates errors of the model; the controller freezes it while u is clipped.
    """
    a = g.a
    return Decision((-m.phi - 3.0 * a * m.rate - 3.0 * a * a * m.e - a * a * a * m.integral) / m.psi, 0.0)


def integral_gain(law: str, g: Gains) -> float:
    """Return the factor of the integral of e in a controller; sspd has none."""
    if law == "sspid":
        return g.l2
    if law == "pi":
        return g.ki
    if law == "pid":
        return g.pid_gain / g.pid_ti
    return g.a * g.a * g.a if law == "robust" else 0.0


LAWS: dict[str, Law] = {"sspd": sspd, "sspid": sspid, "pi": pi, "pid": pid, "robust": robust}
