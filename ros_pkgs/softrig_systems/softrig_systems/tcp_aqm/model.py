"""Constants of the bottleneck, its equilibrium, and the linearising terms Phi and Psi of the sliding mode laws."""

from __future__ import annotations

from typing import Any, NamedTuple

from softrig_core import Params, param


class Bottleneck(Params):
    """The link and its sources, as a plant has or a controller assumes them."""

    N: int = param(60, "TCP flows N", ge=1, le=2000)
    C: float = param(3750.0, "capacity C of the link", "packet/s", gt=0.0, le=1e7)
    tau_p: float = param(0.2, "propagation delay tau_p of a round trip (printed tau_d)", "s", gt=0.0, le=10.0)
    q_max: float = param(300.0, "size of the queue; packets beyond it are lost", "packet", gt=0.0, le=1e6)

    def agreed(self) -> dict[str, Any]:
        """Return the quantities on which a network and the nodes that judge it must agree."""
        return {f"tcp/{name}": getattr(self, name) for name in Bottleneck.model_fields}


class Equilibrium(NamedTuple):
    """Round trip R0 (s), window w0 (packets) and drop probability p0 that hold the queue at its set point."""

    rtt: float
    window: float
    probability: float


def equilibrium(network: Bottleneck, queue: float) -> Equilibrium:
    """Return the steady state with `queue` packets: R0 = q/C + tau_p, w0 = R0 C/N, p0 = 2/w0^2.

    Examples
    --------
    >>> equilibrium(Bottleneck(), 120.0).window
    14.5
    """
    rtt = queue / network.C + network.tau_p
    window = rtt * network.C / network.N
    return Equilibrium(rtt, window, 2.0 / window**2)


def phi(w: float, R: float, N: float, C: float, *, printed: bool = False) -> float:
    """Return q'' without drops, so that q'' = Phi + Psi p (packet/s^2).

    ::

        Phi = N (1 + w)/R^2 - N^2 w^2/(C R^3)        from q' = N w/R - C, w' = 1/R - ..., R' = q'/C
        Phi = 2 N/R^2       - N^2 w^2/(C R^3)        as printed, eq. (15), (17): the factor w was lost

    Parameters
    ----------
    w : float
        Mean window, packets.
    R : float
        Round trip time, s.
    N, C : float
        Flows and capacity (packet/s).
    printed : bool
        The form of the paper.
    """
    grows = 2.0 if printed else 1.0 + w
    return N * grows / (R * R) - N * N * w * w / (C * R * R * R)


def psi(w: float, R: float, w_R: float, R_R: float, N: float) -> float:
    """Return the gain of the drop probability on q'', Psi = -N w w_R/(2 R R_R) < 0 (packet/s^2).

    In place of this product the paper prints a difference, "-N - w/(2R) ...", eq. (17).

    Parameters
    ----------
    w, R : float
        Window (packets) and round trip (s) now.
    w_R, R_R : float
        Both one round trip ago.
    N : float
        Flows.
    """
    return -N * w * w_R / (2.0 * R * R_R)
