"""Direct torque control with a switching table."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from math import sqrt
from typing import Self

from pydantic import model_validator
from softrig_core import Block, BlockParams, Level, Port, executable, param, to_ns, to_s

from .estimator import EstimatorParams, make_estimator
from .ports import CURRENTS_MEAS, DC_LINK, FLUX_ESTIMATE, SPEED, SWITCHES, TORQUE_ESTIMATE, TORQUE_REF
from .switching import SQRT3, TABLES, VECTORS, FluxComparator, TableName, TorqueComparator, sector, voltage

LOST_FLUX = 0.1


class DtcControllerParams(EstimatorParams, BlockParams):
    """References, bands, table and start sequence."""

    period: float = param(5e-5, "control period T_s", "s", gt=0.0, le=100.0)
    flux_ref: float = param(0.9, "flux reference", "Wb", gt=0.0, live=True)
    flux_band: float = param(0.01, "half-band of the flux comparator h_psi", "Wb", ge=0.0, live=True)
    torque_band: float = param(0.5, "half-band of the torque comparator h_T", "N m", ge=0.0, live=True)
    table: TableName = param(
        "printed", "printed: the paper's Table I; minimal_switching: V0 and V7 exchanged", live=True
    )
    magnetising_time: float = param(0.2, "V1 and V0 only until then, to build up the flux", "s", ge=0.0)
    flux_ramp: float = param(0.1, "duration of the ramp of the flux reference while magnetising", "s", gt=0.0)
    delay_steps: int = param(0, "periods between a measurement and the switching that it leads to", ge=0, le=100)
    current_correction: float = param(
        0.0, "added to both measured currents (extension: the ADC's +delta q)", "A", live=True
    )

    @model_validator(mode="after")
    def _ramp(self) -> Self:
        if self.magnetising_time and self.flux_ramp > self.magnetising_time:
            raise ValueError(
                f"flux_ramp = {self.flux_ramp:g} s does not end within magnetising_time = {self.magnetising_time:g} s"
            )
        return self


class DtcController(Block[DtcControllerParams]):
    """Flux and torque within hysteresis bands by choosing the inverter's voltage from a table.

    At every period the flux estimate gives the sector, the two comparators say what flux and torque need, the table
    names the vector. The applied voltage is reconstructed from the switches and the measured DC-link voltage.

    The table alone cannot start: with no torque asked for it names zero vectors only and the flux decays. So until
    `magnetising_time` V1 builds up the flux, in turn with V0.

    Other references, bands, tables and constants of the estimator act from the next period on: the estimated flux and
    the levels of the comparators stay. The start sequence is over when one would change it, `delay_steps` sizes a
    memory, and `estimator` the ports.
    """

    INPUTS = (CURRENTS_MEAS, DC_LINK, TORQUE_REF)
    OUTPUTS = (SWITCHES, FLUX_ESTIMATE, TORQUE_ESTIMATE)

    @classmethod
    def ports(cls, params: DtcControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The observer needs the speed too."""
        return (*cls.INPUTS, SPEED) if params.estimator == "observer" else cls.INPUTS, cls.OUTPUTS

    def setup(self) -> None:
        """Scale the vectors and pick the table."""
        p = self.p
        self._unit = [voltage(v) for v in VECTORS]
        self._table = TABLES[p.table]
        self._magnetised = to_ns(p.magnetising_time)
        self._lost = LOST_FLUX * p.flux_ref

    def change(self, params: DtcControllerParams) -> None:
        """Tune estimator and comparators, which go on from where they are."""
        super().change(params)
        self._estimator.tune(params, params.period)
        self._flux.band, self._torque.band = params.flux_band, params.torque_band

    def start(self) -> None:
        """No flux, no history."""
        p = self.p
        self._estimator = make_estimator(p, p.period)
        self._flux = FluxComparator(p.flux_band)
        self._torque = TorqueComparator(p.torque_band)
        self._pipe = deque([0] * p.delay_steps)
        self._u = self._i = 0j
        self._omega = self._dc_link = 0.0
        self._vector = 0

    def update(
        self, t: int, *, currents_meas: tuple[float, ...], dc_link: tuple[float, ...], torque_ref: tuple[float, ...],
        joint_states: tuple[float, ...] = (0.0,),
    ) -> Mapping[str, tuple[float, ...]]:  # fmt: skip
        """Estimate, compare, choose the switches."""
        correction = self.p.current_correction
        i_a, i_b = currents_meas[0] + correction, currents_meas[1] + correction
        self._i, self._omega = complex(i_a, (i_a + 2.0 * i_b) / SQRT3), joint_states[0]
        psi = self._estimator.update(self._u, self._i, self._omega)
        torque = self._estimator.torque()
        # abs() would call hypot, whose last digit depends on the C library; a digit is enough to change the switching
        size = sqrt(psi.real * psi.real + psi.imag * psi.imag)
        if t < self._magnetised:
            vector = self._flux(min(1.0, to_s(t) / self.p.flux_ramp) * self.p.flux_ref - size)
        else:
            flux = self._flux(self.p.flux_ref - size)
            vector = self._table[flux][self._torque(torque_ref[0] - torque)][sector(psi) - 1]
            if size < self._lost:
                self.report(Level.WARN, "flux_lost", f"estimated flux {size:.3g} Wb: zero vectors let it decay")
        self._pipe.append(vector)
        self._vector, self._dc_link = self._pipe.popleft(), dc_link[0]
        return self._answer(psi, torque)

    def refused(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Hold the switches; the flux is integrated with the last currents."""
        psi = self._estimator.update(self._u, self._i, self._omega)
        if self._pipe:
            self._pipe.append(self._pipe[-1])
            self._vector = self._pipe.popleft()
        return self._answer(psi, self._estimator.torque())

    def _answer(self, psi: complex, torque: float) -> Mapping[str, tuple[float, ...]]:
        vector = self._vector
        self._u = self._unit[vector] * self._dc_link
        return {
            "switches": VECTORS[vector],
            "flux_estimate": (psi.real, psi.imag, 0.0),
            "torque_estimate": (torque,),
        }


main = executable(DtcController)
