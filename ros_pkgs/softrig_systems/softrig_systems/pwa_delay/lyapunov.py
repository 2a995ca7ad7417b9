"""The functional of Theorem 1 on samples of a trajectory, and a node that watches it on the running plant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Array, Block, BlockParams, Level, Port, param, scalars
from softrig_core.kit.dense import product

from .certificate import VERDICT, CriterionParams
from .ports import VALUE, mode, state
from .system import PwaSystem
from .watch import Watch, fixed

SAMPLES = 64  # fewest samples in the delay bound


def functional(system: PwaSystem, matrices: Mapping[str, Array], x: Array, slopes: Array, share: float) -> float:
    """Evaluate V of Theorem 1 in the time t/h.

    Parameters
    ----------
    matrices : mapping
        Of a certificate.
    x : (m + 1, n) array
        Samples over the last h, the oldest first.
    slopes : (m + 1, n) array
        dx/d(t/h) at the same times.
    share : float
        d/h, constant over the last h; rounded to a whole number of samples.

    Returns
    -------
    float
    """
    m = x.shape[0] - 1
    k = m - round(share * m)  # sample of t - d
    now, delayed = x[-1], x[k]
    F = system.F[system.cell(now, delayed)]
    z = product(F, np.concatenate([now, delayed]))
    late, early = slice(k, m + 1), slice(0, k + 1)
    z2 = np.concatenate([x[0], _integral(x[late], m), _integral(x[early], m)])
    z3 = np.hstack([x[late], slopes[late], now - x[late]])
    z4 = np.hstack([x[early], slopes[early], delayed - x[early]])
    weight = np.arange(m + 1) / m
    energy = weight * _forms(slopes, matrices["R"])
    return float(
        _forms(z, matrices["L1"])
        + _forms(z2, matrices["S"])
        + _integral(_forms(z3, matrices["Q"]), m)
        + _integral(_forms(z4, matrices["Z"]), m)
        + _integral(energy, m)
    )


def _forms(z: Array, matrix: Array) -> Any:
    """Return z' M z of a vector, or of each row."""
    return (product(z, matrix) * z).sum(axis=-1)


def _integral(values: Array, m: int) -> Any:
    """Trapezoids of width 1/m."""
    if values.shape[0] < 2:
        return np.zeros(values.shape[1:])
    return (values.sum(axis=0) - 0.5 * (values[0] + values[-1])) / m


class LyapunovMonitorParams(CriterionParams, BlockParams):
    """System, criterion of the certificate, and the tolerance."""

    period: float = param(3e-4, "sampling period, at most h/64", "s", gt=0.0, le=10.0)
    rise: float = param(1e-3, "relative rise of V over one delay that is reported", gt=0.0, le=1.0)

    def _check(self) -> None:
        if self.method == "level" or self.system == "tank":
            raise ValueError(
                f"method = {self.method!r}, system = {self.system!r}: a certificate of levels has no matrices to watch"
            )
        if self.method == "constant":
            raise ValueError("method = 'constant': only the functional of theorem1 can be monitored; expected theorem1")


class State(NamedTuple):
    """Samples that the certificate needs; None without a certificate, or if the samples are too coarse for it."""

    watch: Watch | None = None


Answer = tuple[State, Mapping[str, tuple[float, ...]]]


class LyapunovMonitor(Block[LyapunovMonitorParams]):
    """V and its rate from the plant's state and a certificate; a rise over one delay is a warning.

    Its record covers four delays: the slope of the oldest sample needs the state one delay of the plant earlier. A
    switch of the cell leaves an error of the quadrature of 7e-4 at 64 samples a delay, 1.3e-4 at 192.
    """

    OUTPUTS = (VALUE,)
    STATE = State

    @classmethod
    def agreed(cls, params: LyapunovMonitorParams) -> Mapping[str, Any]:
        """Return system and criterion, because the matrices are valid only with them."""
        criterion = {f"certificate/{k}": getattr(params, k) for k in ("method", "mu", "order", "cell_terms")}
        return {**params.agreed(), **criterion}

    @classmethod
    def ports(cls, params: LyapunovMonitorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """State and mode of the plant, matrices and verdict of the certificate."""
        verdict = scalars("verdict", "certificate/verdict", VERDICT, held=True)
        return (state(params.states), mode("pwa/mode"), params.matrices_port(held=True), verdict), cls.OUTPUTS

    def setup(self) -> None:
        """Build the system."""
        self._system = self.p.build()

    def update(
        self,
        x: State,
        t: int,
        *,
        state: tuple[float, ...],
        mode: tuple[float, ...],
        matrices: tuple[float, ...] | None,
        verdict: tuple[float, ...] | None,
    ) -> Answer:
        """Return V once the record is long enough."""
        if mode[1] < 0.0:  # the delay counts samples back, and no sample is in the future
            self.report(
                Level.ERROR,
                "delay",
                f"pwa/mode delay became {mode[1]:g} s, expected 0 or more: the record of V begins again",
            )
            return self.refused(x, t)
        if matrices is None or verdict is None or verdict[1] != 1.0:
            return x, {}
        if self.age("matrices") == 0:
            x = self._begun(matrices, verdict[0])
            self.report(Level.OK, "certificate", f"the functional of the certificate for {verdict[0]:g} s is watched")
        if x.watch is None:
            return x, {}
        watch, (known, value, rate, rise) = x.watch.seen(state, mode[1])
        if known == 0.0:
            return State(watch), {}
        if rise > self.p.rise:
            self.report(Level.WARN, "rises", f"V rises by {rise:.3g} over one delay")
        return State(watch), {"value": (value, rate)}

    def refused(self, x: State, t: int) -> Answer:
        """Return no output; the record begins again."""
        return State(None if x.watch is None else x.watch.begun()), {}

    def _begun(self, matrices: tuple[float, ...], h: float) -> State:
        m = round(h / self.p.period)
        if m < SAMPLES:
            self.report(
                Level.ERROR, "coarse", f"period {self.p.period:g} s: expected at most h/{SAMPLES} = {h / SAMPLES:.3g} s"
            )
            return State()
        return State(Watch(fixed(self._system, self.p.unpad(matrices), m, self.p.period)))
