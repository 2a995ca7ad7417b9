"""The machines of `bench machines` in motulator, fed the duty ratios that our drives applied; run by an own Python.

Reads ``{"machine": node, "duties": [[a, b, c], ...], "load": [N m, ...], "rtol": ...}`` and the parameters of our plant
by their names on its standard input, duty ratios and load torque of each period; prints the CPU time and what each
period began with.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any


class Replay:
    """A control system for motulator with prepared duty ratios that records its measurements."""

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


def machine(p: dict[str, Any]) -> Any:
    """Create the machine that our plant has."""
    from motulator.drive import model, utils

    if p["machine"] == "pmsm_plant":
        same = {name: p[name] for name in ("R_s", "L_d", "L_q", "psi_f")}
        return model.SynchronousMachine(utils.SynchronousMachinePars(n_p=p["pole_pairs"], **same))
    inverse_gamma = utils.InductionMachineInvGammaPars(
        n_p=p["pole_pairs"], R_s=p["R_s"], R_R=p["R_R"], L_sgm=p["L_sigma"], L_M=p["L_M"]
    )
    return model.InductionMachine(utils.InductionMachinePars.from_inv_gamma_model_pars(inverse_gamma))


def simulated(given: dict[str, Any]) -> dict[str, Any]:
    """Simulate; time without the set-up."""
    from motulator.common.model import _simulation
    from motulator.drive import model

    control = Replay(given["duties"], given["load"], given["period"])
    # The load is set at each period; as a function of time, rounding would move a step into a period.
    mechanics = model.StiffMechanicalSystem(J=given["J"], B_L=given["B"], tau_L=lambda t: control.torque + 0.0 * t)
    drive = model.Drive(model.VoltageSourceConverter(u_dc=given["U_dc"]), machine(given), mechanics)
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
