"""Evaluation of a running drive; sees the truth, steers nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, chain
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from softrig_core import BlockParams, Observer, executable, param
from softrig_core.block.answer import Heard

from .figures import circle, device_frequency, last_revolution, slope
from .ports import CURRENTS_MEAS, CURRENTS_TRUE, FLUX_ESTIMATE, FLUX_TRUE, SWITCHES

BLOCK = 64  # samples; a tick copies some of the last block only
Row = tuple[int, tuple[float, ...]]  # time, ns; all inputs in their order
INPUTS = (FLUX_TRUE, FLUX_ESTIMATE, CURRENTS_TRUE, CURRENTS_MEAS, SWITCHES)
ENDS = tuple(accumulate(port.size for port in INPUTS))
LEGS = slice(-SWITCHES.size, None)


class FluxMonitorParams(BlockParams):
    """Window of the figures."""

    period: float = param(5e-5, "sampling period", "s", gt=0.0, le=100.0)
    window: float = param(0.5, "time over which the figures are taken", "s", gt=0.0)
    pole_pairs: int = param(2, "pole pairs p, for the torque", ge=1, le=100)


class State(NamedTuple):
    """Samples of the window, in full blocks and of the one under way; the newest; leg transitions since the start."""

    blocks: tuple[Sequence[Row], ...] = ()
    samples: tuple[Row, ...] = ()
    newest: Row | None = None
    transitions: int = 0


class FluxMonitor(Observer[FluxMonitorParams]):
    """Flux error and its slope, circles of true and estimated flux, converter errors, switching, torque.

    All over the last `window`, but the number of leg transitions, which counts from the start. The circles are those
    of the last revolution; before there was one they are not reported.
    """

    INPUTS = INPUTS

    @classmethod
    def agreed(cls, params: FluxMonitorParams) -> Mapping[str, Any]:
        """The machine that it judges."""
        return {"induction_dtc/pole_pairs": params.pole_pairs}

    def setup(self) -> None:
        """Size the window."""
        self._size = max(2, round(self.p.window / self.p.period))
        self._blocks = ceil(self._size / BLOCK)

    def first(self) -> State:
        """Nothing seen."""
        return State()

    def update(
        self, x: State, t: int, *, flux_true: tuple[float, ...], flux_estimate: tuple[float, ...],
        currents_true: tuple[float, ...], currents_meas: tuple[float, ...], switches: tuple[float, ...],
    ) -> tuple[State, Mapping[str, tuple[float, ...]]]:  # fmt: skip
        """Note one sample."""
        blocks, samples, newest, transitions = x
        # An observer also gets the outputs at the end of the run, beside a flux estimate that is one period old:
        # a sample counts only once the next one is here.
        sample = t, (*flux_true, *flux_estimate, *currents_true, *currents_meas, *switches)
        if newest is not None:
            samples = (*samples, newest)
            if len(samples) == BLOCK:
                blocks, samples = (*blocks, samples)[-self._blocks :], ()
            if switches != newest[1][LEGS]:
                transitions += sum(a != b for a, b in zip(switches, newest[1][LEGS], strict=True))
        return State(blocks, samples, sample, transitions), {}

    def at_once(self, x: State, t: int, messages: Mapping[str, Heard]) -> State | None:
        """See `Observer.at_once`."""
        heard = [messages[port.name] for port in self.INPUTS if port.name in messages]
        if x.newest is None or len({h.stamps.tobytes() for h in heard}) != 1 or len(heard) < len(self.INPUTS):
            return None
        rows = Heard(heard[0].stamps, np.hstack([h.values for h in heard]))
        *full, last = rows.blocks((*x.samples, x.newest), BLOCK)
        legs = np.vstack([x.newest[1], rows.values])[:, LEGS]
        transitions = x.transitions + int((legs[1:] != legs[:-1]).sum())
        return State((*x.blocks, *full)[-self._blocks :], tuple(last[:-1]), last[-1], transitions)

    def status(self, x: State) -> Mapping[str, tuple[float, str]]:
        """Give the figures; none before the third sample."""
        samples = [*chain.from_iterable(x.blocks), *x.samples][-self._size :]
        if len(samples) < 2:
            return {}
        stamps, rows = zip(*samples, strict=True)
        t = np.array(stamps) * 1e-9
        true, estimate, i_true, i_meas, switches = np.split(np.array(rows), ENDS[:-1], axis=1)
        psi, psi_hat = true[:, 0] + 1j * true[:, 1], estimate[:, 0] + 1j * estimate[:, 1]
        i = i_true[:, 0] + 1j * (i_true[:, 0] + 2.0 * i_true[:, 1]) / np.sqrt(3.0)
        torque = 1.5 * self.p.pole_pairs * (psi.conj() * i).imag
        error = psi_hat - psi
        rate = slope(t, error)
        figures = {
            "flux_error": (float(abs(error[-1])), "Wb"),
            "flux_error_slope_alpha": (rate.real, "Wb/s"),
            "flux_error_slope_beta": (rate.imag, "Wb/s"),
            "torque_mean": (float(torque.mean()), "N m"),
            "torque_std": (float(torque.std()), "N m"),
            "leg_transitions": (float(x.transitions), ""),
            "device_frequency": (device_frequency(switches, float(t[-1] - t[0])), "Hz"),
        }
        for phase, deviation in zip("ab", (i_meas - i_true).T, strict=False):
            figures[f"adc_{phase}_mean"] = (float(deviation.mean()), "A")
            figures[f"adc_{phase}_std"] = (float(deviation.std()), "A")
        for name, flux in (("true", psi), ("estimated", psi_hat)):
            turn = last_revolution(flux)
            if turn is not None:
                centre, radius = circle(turn)
                figures[f"{name}_circle_alpha"] = (centre.real, "Wb")
                figures[f"{name}_circle_beta"] = (centre.imag, "Wb")
                figures[f"{name}_circle_radius"] = (radius, "Wb")
        return figures


main = executable(FluxMonitor)
