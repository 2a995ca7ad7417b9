"""The same work in other people's libraries, run by whichever Python has them: ``python beside_peers.py NAME``.

Reads what the library is given as JSON from the standard input and prints the CPU time in s and the end state as JSON.
Imports nothing of softrig: every model is written here again, from its paper or its URDF.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np


def motor(given: dict[str, Any]) -> tuple[Any, Any]:
    """Return the matrices of the DC motor, equations (8) and (9) of its paper, for (angle, speed, current)."""
    R, L, J, b, Kt, Ke = (given[name] for name in ("R", "L", "J", "b", "Kt", "Ke"))
    return np.array([[0, 1, 0], [0, -b / J, Kt / J], [0, -Ke / L, -R / L]]), np.array([[0], [0], [1 / L]])


def python_control(given: dict[str, Any]) -> tuple[float, Any]:
    """Respond to held voltages by `control.forced_response` of the sampled motor."""
    import control

    a, b = motor(given)
    voltage = np.array(given["voltage"])
    start = time.process_time()
    sampled = control.sample_system(control.ss(a, b, np.eye(3), np.zeros((3, 1))), given["period"], "zoh")
    times = given["period"] * np.arange(len(voltage))
    result = control.forced_response(sampled, times, voltage)
    return time.process_time() - start, np.asarray(result.outputs)[:, -1]


def scipy_ivp(given: dict[str, Any]) -> tuple[float, Any]:
    """Integrate the motor over each period by `scipy.integrate.solve_ivp` (RK45, relative tolerance 1e-9)."""
    from scipy.integrate import solve_ivp

    a, b = motor(given)
    x, period = np.zeros(3), given["period"]
    start = time.process_time()
    for voltage in given["voltage"][:-1]:
        u = b[:, 0] * voltage
        x = solve_ivp(lambda _, y, u=u: a @ y + u, (0.0, period), x, rtol=1e-9, atol=1e-12).y[:, -1]
    return time.process_time() - start, x


def pvlib(given: dict[str, Any]) -> tuple[float, Any]:
    """Solve the single-diode equation of modules at given voltages by `pvlib.pvsystem.i_from_v` (Lambert's W)."""
    from pvlib import pvsystem

    columns = [np.array(given[name]) for name in ("V", "I_ph", "I_0", "R_s", "R_p", "aV_t")]
    V, I_ph, I_0, R_s, R_p, aV_t = columns
    start = time.process_time()
    result = pvsystem.i_from_v(V, I_ph, I_0, R_s, R_p, aV_t)
    return time.process_time() - start, result


def mujoco(given: dict[str, Any]) -> tuple[float, Any]:
    """Move the arm of a URDF by MuJoCo's Runge-Kutta steps under held torques."""
    import mujoco as mj

    model = mj.MjModel.from_xml_string(given["urdf"])
    model.opt.integrator, model.opt.timestep = mj.mjtIntegrator.mjINT_RK4, given["step"]
    model.opt.disableflags |= mj.mjtDisableBit.mjDSBL_LIMIT | mj.mjtDisableBit.mjDSBL_CONTACT
    data = mj.MjData(model)
    data.qpos[:], data.qvel[:] = given["q"], given["v"]
    start = time.process_time()
    for torque in given["torques"]:
        data.qfrc_applied[:] = torque
        for _ in range(given["substeps"]):
            mj.mj_step(model, data)
    return time.process_time() - start, np.concatenate([data.qpos, data.qvel])


def pinocchio(given: dict[str, Any]) -> tuple[float, Any]:
    """Move the arm of a URDF by Runge-Kutta steps around pinocchio's `aba` under held torques."""
    import pinocchio as pin

    model = pin.buildModelFromXML(given["urdf"])
    data, h, n = model.createData(), given["step"], model.nv

    def slope(x: Any, torque: Any) -> Any:
        return np.concatenate([x[n:], pin.aba(model, data, x[:n], x[n:], torque)])

    x = np.array([*given["q"], *given["v"]])
    start = time.process_time()
    for row in given["torques"]:
        torque = np.array(row)
        for _ in range(given["substeps"]):
            k1 = slope(x, torque)
            k2 = slope(x + 0.5 * h * k1, torque)
            k3 = slope(x + 0.5 * h * k2, torque)
            k4 = slope(x + h * k3, torque)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return time.process_time() - start, x


def motulator_grid(given: dict[str, Any]) -> tuple[float, Any]:
    """Simulate a rectifier by motulator's grid models (0.5): converter with DC link, filter and source.

    The modulator of the rig divides by the measured DC voltage, so its duty ratios are computed within the solver.
    Currents of motulator flow into the grid.
    """
    from motulator.common.model import _simulation
    from motulator.grid import model, utils

    phi, load = np.exp(1j * given["phi"]), [1.0]

    class Modulated(model.VoltageSourceConverter):  # type: ignore[misc,unused-ignore]
        command = 0.0

        def set_outputs(self, t: float) -> None:
            wanted = given["V_g"] - self.command * phi
            self.inp.q_cs = wanted * np.exp(1j * (given["omega"] * t - 0.5 * np.pi)) / self.u_dc
            super().set_outputs(t)

        def set_inputs(self, t: float) -> None:
            self.inp.i_dc = -self.u_dc / load[0]

    converter = Modulated(given["v_start"], C_dc=given["C"], i_dc=lambda t: 0.0)
    filter_ = model.ACFilter(utils.ACFilterPars(L_fc=given["L"], R_fc=given["R"], L_fg=0.0, C_f=0.0, L_g=0.0))
    filter_.state.i_cs = 1j * given["i_start"]
    source = model.ThreePhaseVoltageSource(given["omega"], given["V_g"], phi=-0.5 * np.pi)
    system = model.GridConverterSystem(converter, filter_, source)
    system.delay = lambda duty: duty
    commands = iter(zip(given["command"], given["load"], strict=True))

    class Replay:
        def __call__(self, mdl: Any) -> tuple[float, Any]:
            converter.command, load[0] = next(commands)
            return given["period"], (0.0, 0.0, 0.0)

        def post_process(self) -> None:
            pass

    if given["rtol"]:
        solve = _simulation.solve_ivp
        _simulation.solve_ivp = lambda *args, **more: solve(*args, **more, rtol=given["rtol"], atol=given["rtol"])
    start = time.process_time()
    model.Simulation(system, Replay()).simulate(t_stop=(len(given["command"]) - 0.5) * given["period"])
    spent = time.process_time() - start
    return spent, [*(-i for i in filter_.meas_currents()), converter.u_dc]


def pandapower(given: dict[str, Any]) -> tuple[float, Any]:
    """Solve a time series of power flows by pandapower's `run_timeseries`, each from the one before."""
    import pandapower as pp
    import pandas as pd
    from pandapower.control import ConstControl
    from pandapower.timeseries import DFData, OutputWriter, run_timeseries

    power, voltage, frequency = given["base"]
    z = voltage**2 / power
    net = pp.create_empty_network(f_hz=frequency, sn_mva=1e-6 * power)
    at = {name: pp.create_bus(net, 1e-3 * voltage) for name in given["buses"]}
    for a, b, r, x, g, charging in given["branches"]:
        farads = charging / z / (2.0 * np.pi * frequency)
        pp.create_line_from_parameters(
            net, at[a], at[b], 1.0, r * z, x * z, 1e9 * farads, max_i_ka=10.0, g_us_per_km=1e6 * g / z
        )
    for name, (size, angle) in given["sources"].items():
        pp.create_ext_grid(net, at[name], vm_pu=size, va_degree=angle)
    powers = 1e-6 * power * np.array(given["injected"])
    # The shunt converter holds the voltage of bus 1 like a generator.
    pp.create_gen(net, at["1"], powers[0, 0, 0], vm_pu=given["held"])
    for k, name in enumerate("234"):
        pp.create_sgen(net, at[name], *powers[0, k + 1])
    data = DFData(pd.DataFrame(powers.reshape(len(powers), -1)))
    for element, variable, columns in (
        ("gen", "p_mw", [0]),
        ("sgen", "p_mw", [2, 4, 6]),
        ("sgen", "q_mvar", [3, 5, 7]),
    ):
        ConstControl(net, element, variable, net[element].index, columns, data)
    sizes, angles = np.array(given["start"]).T
    pp.runpp(net, init_vm_pu=sizes, init_va_degree=angles, calculate_voltage_angles=True, tolerance_mva=1e-9)
    # Buses are named, because its reader of all buses fails if both magnitude and angle are logged (3.5.6).
    logged = [("res_bus", variable, list(at.values())) for variable in ("vm_pu", "va_degree")]
    writer = OutputWriter(net, log_variables=logged)
    start = time.process_time()
    run_timeseries(
        net,
        range(len(powers)),
        verbose=False,
        init="results",
        calculate_voltage_angles=True,
        tolerance_mva=1e-9,
    )
    spent = time.process_time() - start
    u = writer.np_results["res_bus.vm_pu"] * np.exp(1j * np.radians(writer.np_results["res_bus.va_degree"]))
    return spent, np.stack([u.real, u.imag], axis=-1)[:, :6]


def fmpy(given: dict[str, Any]) -> tuple[float, Any]:
    """Step the motor as an FMU of FMI 2.0 for co-simulation by FMPy, and read its state after each step."""
    import fmpy as fm
    from fmpy.fmi2 import FMU2Slave

    about = fm.read_model_description(given["fmu"])
    references = {variable.name: variable.valueReference for variable in about.modelVariables}
    inputs, outputs = [references["motor.command.armature.effort"]], [references[name] for name in given["state"]]
    unit = FMU2Slave(
        guid=about.guid,
        unzipDirectory=fm.extract(given["fmu"]),
        modelIdentifier=about.coSimulation.modelIdentifier,
        instanceName="peer",
    )
    unit.instantiate()
    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    rows, h = [], given["period"]
    start = time.process_time()
    for k, value in enumerate(given["voltage"][:-1]):
        unit.setReal(inputs, [value])
        unit.doStep(currentCommunicationPoint=k * h, communicationStepSize=h)
        rows.append(unit.getReal(outputs))
    return time.process_time() - start, rows[-1]


_FUNCTIONS = (python_control, scipy_ivp, pvlib, mujoco, pinocchio, motulator_grid, pandapower, fmpy)
PEERS: dict[str, Callable[[dict[str, Any]], tuple[float, Any]]] = {f.__name__: f for f in _FUNCTIONS}


if __name__ == "__main__":
    cpu_s, end = PEERS[sys.argv[1]](json.load(sys.stdin))
    print(json.dumps({"cpu_s": cpu_s, "end": np.asarray(end).tolist()}))
