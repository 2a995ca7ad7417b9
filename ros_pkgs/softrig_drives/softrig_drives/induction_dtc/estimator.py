"""Flux and torque estimators of DTC."""

from __future__ import annotations

from typing import Literal, NamedTuple

from softrig_core import Params, param


class EstimatorParams(Params):
    """The controller's assumptions about the machine."""

    R_s_hat: float = param(3.7, "stator resistance of the estimator", "ohm", gt=0.0, live=True)
    pole_pairs: int = param(2, "pole pairs p", ge=1, le=100)
    estimator: Literal["voltage_model", "observer"] = param(
        "voltage_model", "voltage_model: the paper's integrator; observer: corrected by the current model"
    )
    observer_gain: float = param(10.0, "observer: gain g of the correction", "rad/s", gt=0.0, live=True)
    R_R: float = param(2.1, "observer: rotor resistance R_R", "ohm", gt=0.0, live=True)
    L_sigma: float = param(0.021, "observer: leakage inductance L_sigma", "H", gt=0.0, live=True)
    L_M: float = param(0.224, "observer: magnetising inductance L_M", "H", gt=0.0, live=True)


class Flux(NamedTuple):
    """Estimated stator flux (Wb), newest current (A; None before the first) and, of the observer, rotor flux (Wb).

    Space vectors alpha + j beta.
    """

    psi: complex = 0j
    i: complex | None = None
    psi_R: complex = 0j  # noqa: N815


class VoltageModel:
    """Stator flux by integration of u - R_s i, the current by the trapezoidal rule.

    ::

        psi(k+1) = psi(k) + T_s (u(k) - R_s (i(k) + i(k+1))/2)        psi(0) = 0

    With a forward rule for the current the estimate would have an error of 7.5e-4 Wb, as large as that of quantisation.

    Parameters
    ----------
    T_s : float
        Sampling period in s.
    """

    def __init__(self, p: EstimatorParams, T_s: float) -> None:
        self._T_s = T_s
        self._half_R_s = 0.5 * p.R_s_hat
        self._factor = 1.5 * p.pole_pairs

    def __call__(self, x: Flux, u: complex, i: complex, omega: float) -> Flux:
        """Return the fluxes now.

        Parameters
        ----------
        x : Flux
            A period ago.
        u : complex
            Voltage over the past period, V.
        i : complex
            Current now, A.
        omega : float
            Speed of the shaft now, rad/s; only the observer needs it.
        """
        psi = x.psi if x.i is None else x.psi + self._T_s * (u - self._half_R_s * (x.i + i))
        return Flux(psi, i, x.psi_R)

    def torque(self, x: Flux) -> float:
        """T = 3/2 p (psi_alpha i_beta - psi_beta i_alpha) in N m."""
        psi, i = x.psi, x.i or 0j
        return self._factor * (psi.real * i.imag - psi.imag * i.real)


class FluxObserver(VoltageModel):
    """Voltage model with a correction towards the current model; an extension, not in the paper.

    ::

        psi_R'  = R_R i - (R_R/L_M - j p omega) psi_R          by the trapezoidal rule
        psi_cm  = L_sigma i + psi_R
        psi'    = u - R_s i + g (psi_cm - psi)

    A mean error di of the currents then shifts the estimate by R_s |di|/g at most, instead of without bound.
    """

    def __init__(self, p: EstimatorParams, T_s: float) -> None:
        super().__init__(p, T_s)
        self._g = p.observer_gain * T_s
        self._half_R_R = 0.5 * p.R_R * T_s
        self._L_sigma = p.L_sigma
        self._decay = 0.5 * T_s * p.R_R / p.L_M
        self._turn = 0.5j * T_s * p.pole_pairs

    def __call__(self, x: Flux, u: complex, i: complex, omega: float) -> Flux:
        """Return the fluxes now; see `VoltageModel`."""
        psi, _, psi_R = super().__call__(x, u, i, omega)
        if x.i is not None:
            half_a = self._turn * omega - self._decay
            psi_R = ((1.0 + half_a) * psi_R + self._half_R_R * (x.i + i)) / (1.0 - half_a)
            psi += self._g * (self._L_sigma * i + psi_R - psi)
        return Flux(psi, i, psi_R)


def make_estimator(p: EstimatorParams, T_s: float) -> VoltageModel:
    """Create the estimator that the parameters ask for."""
    return (FluxObserver if p.estimator == "observer" else VoltageModel)(p, T_s)
