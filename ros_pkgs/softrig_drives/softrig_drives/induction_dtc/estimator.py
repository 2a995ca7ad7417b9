"""Flux and torque estimators of DTC."""

from __future__ import annotations

from typing import Literal

from softrig_core import Params, param


class EstimatorParams(Params):
    """What the controller believes of the machine."""

    R_s_hat: float = param(3.7, "stator resistance of the estimator", "ohm", gt=0.0, live=True)
    pole_pairs: int = param(2, "pole pairs p", ge=1, le=100)
    estimator: Literal["voltage_model", "observer"] = param(
        "voltage_model", "voltage_model: the paper's integrator; observer: corrected by the current model"
    )
    observer_gain: float = param(10.0, "observer: gain g of the correction", "rad/s", gt=0.0, live=True)
    R_R: float = param(2.1, "observer: rotor resistance R_R", "ohm", gt=0.0, live=True)
    L_sigma: float = param(0.021, "observer: leakage inductance L_sigma", "H", gt=0.0, live=True)
    L_M: float = param(0.224, "observer: magnetising inductance L_M", "H", gt=0.0, live=True)


class VoltageModel:
    """Stator flux by integration of u - R_s i, the current by the trapezoidal rule.

    ::

        psi(k+1) = psi(k) + T_s (u(k) - R_s (i(k) + i(k+1))/2)        psi(0) = 0

    With a forward rule for the current the estimate would be off by 7.5e-4 Wb, as much as quantisation makes.

    Parameters
    ----------
    p : EstimatorParams
    T_s : float
        Sampling period in s.

    Attributes
    ----------
    psi : complex
        Estimated stator flux in Wb, as are voltages (V) and currents (A) a space vector alpha + j beta.
    """

    def __init__(self, p: EstimatorParams, T_s: float) -> None:
        self.tune(p, T_s)
        self.psi = 0j
        self.i: complex | None = None

    def tune(self, p: EstimatorParams, T_s: float) -> None:
        """Take other constants of the machine for what comes; the flux found so far stays."""
        self._T_s = T_s
        self._half_R_s = 0.5 * p.R_s_hat
        self._factor = 1.5 * p.pole_pairs

    def update(self, u: complex, i: complex, omega: float) -> complex:
        """Give the flux now.

        Parameters
        ----------
        u : complex
            Voltage over the past period.
        i : complex
            Current now.
        omega : float
            Speed of the shaft now, rad/s; only the observer needs it.
        """
        if self.i is not None:
            self.psi += self._T_s * (u - self._half_R_s * (self.i + i))
        self.i = i
        return self.psi

    def torque(self) -> float:
        """T = 3/2 p (psi_alpha i_beta - psi_beta i_alpha) in N m; after the first update."""
        psi, i = self.psi, self.i or 0j
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
        self._psi_R = 0j

    def tune(self, p: EstimatorParams, T_s: float) -> None:
        """Take other constants of the machine; both fluxes stay."""
        super().tune(p, T_s)
        self._g = p.observer_gain * T_s
        self._half_R_R = 0.5 * p.R_R * T_s
        self._L_sigma = p.L_sigma
        self._decay = 0.5 * T_s * p.R_R / p.L_M
        self._turn = 0.5j * T_s * p.pole_pairs

    def update(self, u: complex, i: complex, omega: float) -> complex:
        """Give the flux now; see `VoltageModel.update`."""
        before = self.i
        super().update(u, i, omega)
        if before is not None:
            half_a = self._turn * omega - self._decay
            self._psi_R = ((1.0 + half_a) * self._psi_R + self._half_R_R * (before + i)) / (1.0 - half_a)
            self.psi += self._g * (self._L_sigma * i + self._psi_R - self.psi)
        return self.psi


def make_estimator(p: EstimatorParams, T_s: float) -> VoltageModel:
    """Make the estimator that the parameters ask for, with zero flux."""
    return (FluxObserver if p.estimator == "observer" else VoltageModel)(p, T_s)
