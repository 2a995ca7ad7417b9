"""Direct torque control with a switching table."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from softrig_core import Block, BlockParams, Level, Port, Values, param, to_ns, to_s

from .estimator import EstimatorParams, Flux, make_estimator
from .ports import CURRENTS_MEAS, DC_LINK, FLUX_ESTIMATE, SPEED, SWITCHES, TORQUE_ESTIMATE, TORQUE_REF
from .switching import SQRT3, TABLES, VECTORS, TableName, flux_level, sector, torque_level, voltage

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

    def _check(self) -> None:
        if self.magnetising_time and self.flux_ramp > self.magnetising_time:
            raise ValueError(
                f"flux_ramp = {self.flux_ramp:g} s does not end within magnetising_time = {self.magnetising_time:g} s"
            )


class State(NamedTuple):
    """Fluxes, levels of both comparators, pending vectors, the applied one; DC link (V), speed (rad/s) as read."""

    flux: Flux = Flux()
    increase: int = 1
    more: int = 0
    pipe: tuple[int, ...] = ()
    vector: int = 0
    dc_link: float = 0.0
    omega: float = 0.0


class DtcController(Block[DtcControllerParams]):
    """Flux and torque within hysteresis bands by choosing the inverter's voltage from a table.

    In every period the sector follows from the flux estimate, and the two comparators determine the changes of flux and
    torque. The table then selects the voltage vector. The applied voltage is reconstructed from the switches and the
    measured DC-link voltage.

    The table alone cannot start the drive: without a torque demand it selects zero vectors only, and the flux decays.
    So until `magnetising_time` V1, alternating with V0, builds up the flux.

    Changed references, bands, tables and estimator constants apply from the next period on; the estimated flux and the
    comparator levels stay. Other parameters cannot change: the start sequence is over by then, `delay_steps` sizes a
    memory, and `estimator` determines the ports.
    """

    INPUTS = (CURRENTS_MEAS, DC_LINK, TORQUE_REF)
    OUTPUTS = (SWITCHES, FLUX_ESTIMATE, TORQUE_ESTIMATE)

    @classmethod
    def ports(cls, params: DtcControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The observer needs the speed too."""
        return (*cls.INPUTS, SPEED) if params.estimator == "observer" else cls.INPUTS, cls.OUTPUTS

    def setup(self) -> None:
        """Create the estimator, scale the vectors and pick the table."""
        p = self.p
        self._estimator = make_estimator(p, p.period)
        self._unit = [voltage(v) for v in VECTORS]
        self._table = TABLES[p.table]
        self._magnetised = to_ns(p.magnetising_time)
        self._lost = LOST_FLUX * p.flux_ref

    def first(self) -> State:
        """No flux, no history."""
        return State(pipe=(0,) * self.p.delay_steps)

    def update(
        self,
        x: State,
        t: int,
        *,
        currents_meas: tuple[float, ...],
        dc_link: tuple[float, ...],
        torque_ref: tuple[float, ...],
        joint_states: tuple[float, ...] = (0.0,),
    ) -> tuple[State, Values]:
        """Estimate, compare, choose the switches."""
        p = self.p
        flux, increase, more, pipe, vector, link, _ = x
        i_a, i_b = currents_meas[0] + p.current_correction, currents_meas[1] + p.current_correction
        i, omega = complex(i_a, (i_a + 2.0 * i_b) / SQRT3), joint_states[0]
        flux = self._estimator(flux, self._unit[vector] * link, i, omega)
        psi, torque = flux.psi, self._estimator.torque(flux)
        # abs() would call hypot, whose last digit depends on the C library; a digit is enough to change the switching
        size = sqrt(psi.real * psi.real + psi.imag * psi.imag)
        if t < self._magnetised:
            increase = flux_level(increase, min(1.0, to_s(t) / p.flux_ramp) * p.flux_ref - size, p.flux_band)
            vector = increase  # V1 for an increase, V0 otherwise
        else:
            increase = flux_level(increase, p.flux_ref - size, p.flux_band)
            more = torque_level(more, torque_ref[0] - torque, p.torque_band)
            vector = self._table[increase][more][sector(psi) - 1]
            if size < self._lost:
                self.report(Level.WARN, "flux_lost", f"estimated flux {size:.3g} Wb: zero vectors let it decay")
        if pipe:
            vector, *later = *pipe, vector
            pipe = tuple(later)
        return State(flux, increase, more, pipe, vector, dc_link[0], omega), _answer(vector, psi, torque)

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Hold the switches; the flux is integrated with the last currents."""
        flux, increase, more, pipe, vector, link, omega = x
        flux = self._estimator(flux, self._unit[vector] * link, flux.i or 0j, omega)
        if pipe:
            vector, pipe = pipe[0], (*pipe[1:], pipe[-1])
        torque = self._estimator.torque(flux)
        return State(flux, increase, more, pipe, vector, link, omega), _answer(vector, flux.psi, torque)


def _answer(vector: int, psi: complex, torque: float) -> Values:
    return {
        "switches": VECTORS[vector],
        "flux_estimate": (psi.real, psi.imag, 0.0),
        "torque_estimate": (torque,),
    }
