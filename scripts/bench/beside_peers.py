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


PEERS: dict[str, Callable[[dict[str, Any]], tuple[float, Any]]] = {
    function.__name__: function for function in (python_control, scipy_ivp, pvlib, mujoco, pinocchio)
}


if __name__ == "__main__":
    cpu_s, end = PEERS[sys.argv[1]](json.load(sys.stdin))
    print(json.dumps({"cpu_s": cpu_s, "end": np.asarray(end).tolist()}))
