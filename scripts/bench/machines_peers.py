"""The machines of `bench machines` in motulator, fed the duty ratios that our drives applied; run by an own Python.

Reads ``{"machine": ..., "duties": [[a, b, c], ...], "period": s, "load": [N m, ...], "rtol": ...}`` on its standard
input, duty ratios and load torque of each period; prints the CPU time and what each period began with.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any


class Replay:
    """A control system for motulator that knows its duty ratios beforehand and notes what it would measure."""

    def __init__(self, duties: Sequence[Sequence[float]], load: Sequence[float], period: float) -> None:
        self._duties: Iterator[Sequence[float]] = iter(duties)
        self._load = iter(load)
        self._period, self.torque = period, 0.0
        self.rows: list[tuple[float, ...]] = []

    def __call__(self, model: Any) -> tuple[float, Sequence[float]]:
        """Return the sampling period and the duty ratios; past the end, zero voltage."""
        i_a, i_b, _ = model.machine.meas_currents()
        self.rows.append((float(i_a), float(i_b), float(model.mechanics.state.w_M.real)))
        self.torque = next(self._load, 0.0)
        return self._period, next(self._duties, (0.5, 0.5, 0.5))

    def post_process(self) -> None:
        """No signals of its own."""


def machine(name: str) -> Any:
    """Create the machine of motulator's examples that our scenario has."""
    from motulator.drive import model, utils

    if name == "pmsm_foc":
        par = utils.SynchronousMachinePars(n_p=3, R_s=3.6, L_d=0.036, L_q=0.051, psi_f=0.545)
        return model.SynchronousMachine(par)
    inverse_gamma = utils.InductionMachineInvGammaPars(n_p=2, R_s=3.7, R_R=2.1, L_sgm=0.021, L_M=0.224)
    return model.InductionMachine(utils.InductionMachinePars.from_inv_gamma_model_pars(inverse_gamma))


def simulated(given: dict[str, Any]) -> dict[str, Any]:
    """Simulate; time without the set-up."""
    from motulator.common.model import _simulation
    from motulator.drive import model

    control = Replay(given["duties"], given["load"], given["period"])
    # a load that steps with a period: as a function of time it would step within one by rounding
    mechanics = model.StiffMechanicalSystem(J=0.015, tau_L=lambda t: control.torque + 0.0 * t)
    drive = model.Drive(model.VoltageSourceConverter(u_dc=540.0), machine(given["machine"]), mechanics)
    drive.delay = lambda duty: duty
    rtol = given["rtol"]
    if rtol:
        _simulation.solve_ivp = partial(_simulation.solve_ivp, rtol=rtol, atol=0.1 * rtol)
    simulation = model.Simulation(drive, control)
    start = time.process_time()
    simulation.simulate(t_stop=(len(given["duties"]) - 1.5) * given["period"])
    return {"cpu_s": time.process_time() - start, "rows": control.rows}


if __name__ == "__main__":
    print(json.dumps(simulated(json.load(sys.stdin))))
