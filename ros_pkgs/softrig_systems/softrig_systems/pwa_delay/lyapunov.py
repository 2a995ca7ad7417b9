"""The functional of Theorem 1 on samples of a trajectory, and a node that watches it on the running plant."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from softrig_core import Block, BlockParams, Level, Port, executable, param, scalars
from softrig_core.kit.dense import product

from .certificate import VERDICT, CriterionParams
from .lmi import Array
from .ports import VALUE, mode, state
from .system import PwaSystem

SAMPLES = 64  # fewest samples in the delay bound


def functional(system: PwaSystem, matrices: Mapping[str, Array], x: Array, slopes: Array, share: float) -> float:
    """Evaluate V of Theorem 1 in the time t/h.

    Parameters
    ----------
    system : PwaSystem
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
    """Give z' M z of a vector, or of each row."""
    return (product(z, matrix) * z).sum(axis=-1)


def _integral(values: Array, m: int) -> Any:
    """Trapezoids of width 1/m."""
    if values.shape[0] < 2:
        return np.zeros(values.shape[1:])
    return (values.sum(axis=0) - 0.5 * (values[0] + values[-1])) / m


class LyapunovMonitorParams(CriterionParams, BlockParams):
    """System, criterion of the certificate, and the tolerance."""

    period: float = param(3e-4, "sampling period, at most h/64", "s", gt=0.0, le=10.0)
    rise: float = param(1e-3, "relative rise of V over one delay that is told", gt=0.0, le=1.0)


class LyapunovMonitor(Block[LyapunovMonitorParams]):
    """V and its rate from the plant's state and a certificate; a rise over one delay is a warning.

    Its record covers four delays: the slope of the oldest sample needs the state one delay of the plant earlier. A
    switch of the cell leaves an error of the quadrature of 7e-4 at 64 samples a delay, 1.3e-4 at 192.
    """

    OUTPUTS = (VALUE,)

    @classmethod
    def agreed(cls, params: LyapunovMonitorParams) -> Mapping[str, Any]:
        """System and criterion: the matrices mean nothing under another."""
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

    def start(self) -> None:
        """Know no certificate."""
        self._x: deque[Array] = deque(maxlen=1)
        self._slopes: deque[Array] = deque(maxlen=1)
        self._values: deque[float] = deque(maxlen=1)
        self._given: tuple[float, ...] | None = None
        self._matrices: dict[str, Array] = {}
        self._m = 0
        self.worst = -np.inf

    def update(
        self, t: int, *, state: tuple[float, ...], mode: tuple[float, ...], matrices: tuple[float, ...] | None,
        verdict: tuple[float, ...] | None,
    ) -> Mapping[str, tuple[float, ...]]:  # fmt: skip
        """Give V once the record is long enough."""
        if matrices is None or verdict is None or verdict[1] != 1.0:
            return {}
        if matrices is not self._given:
            self._take(matrices, verdict[0])
        if not self._m:
            return {}
        h = self._m * self.p.period
        share = min(mode[1] / h, 1.0)
        x = np.array(state)
        self._x.append(x)
        back = round(mode[1] / self.p.period)
        x_d = self._x[-1 - back] if len(self._x) > back else self._x[0]
        cell = self._system.cell(x, x_d)
        self._slopes.append(h * (product(self._system.A[cell], x) + product(self._system.Ad[cell], x_d)))
        if len(self._slopes) <= self._m + min(back, 3 * self._m):
            return {}
        m = self._m
        xs, slopes = np.array(self._x)[-m - 1 :], np.array(self._slopes)[-m - 1 :]
        value = functional(self._system, self._matrices, xs, slopes, share)
        before = self._values[0] if len(self._values) > m else None
        rate = (value - self._values[-1]) / self.p.period if self._values else 0.0
        self._values.append(value)
        if before is not None:
            rise = value / before - 1.0
            self.worst = max(self.worst, rise)
            if rise > self.p.rise:
                self.report(Level.WARN, "rises", f"V rises by {rise:.3g} over one delay")
        return {"value": (value, rate)}

    def refused(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Say nothing; the record begins again."""
        if self._m:
            self._clear()
        return {}

    def _take(self, matrices: tuple[float, ...], h: float) -> None:
        self._given = matrices
        self._m = round(h / self.p.period)
        if self._m < SAMPLES:
            self.report(Level.ERROR, "coarse", f"period {self.p.period:g} s: expected at most h/{SAMPLES} = "
                        f"{h / SAMPLES:.3g} s")  # fmt: skip
            self._m = 0
            return
        self._matrices = self.p.unpad(matrices)
        self._clear()

    def _clear(self) -> None:
        self._x = deque(maxlen=4 * self._m + 1)
        self._slopes = deque(maxlen=4 * self._m + 1)
        self._values = deque(maxlen=self._m + 1)


main = executable(LyapunovMonitor)
