"""The same motor in other people's simulators, run by whichever Python has them: ``python bench_peers.py NAME``.

Reads the switching sequence as JSON from the standard input and prints the CPU time in s as JSON, with the final
stator flux (Wb) and speed (rad/s) where the simulator was given the same machine. Imports nothing of softrig.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

T_S = 5e-5
LEGS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 1, 1)]


class Replay:
    """A control system for motulator with a prepared switching sequence."""

    t = 0.0

    def __init__(self, vectors: Sequence[int]) -> None:
        self._vectors = iter(vectors)

    def __call__(self, model: Any) -> tuple[float, Sequence[float]]:
        """Return the sampling period and the duty ratios; past the end, V0."""
        return T_S, [float(s) for s in LEGS[next(self._vectors, 0)]]

    def post_process(self) -> None:
        """No signals of its own."""


def motulator(vectors: Sequence[int], rtol: float = 1e-3) -> dict[str, float]:
    """Feed motulator's drive model (0.5) with the vectors, without PWM; its solver RK45 as it is, or a tighter one."""
    from functools import partial

    from motulator.common.model import _simulation
    from motulator.drive import model, utils

    machine = utils.InductionMachineInvGammaPars(n_p=2, R_s=3.7, R_R=2.1, L_sgm=0.021, L_M=0.224)
    motor = model.InductionMachine(utils.InductionMachinePars.from_inv_gamma_model_pars(machine))
    load_from = 0.6 - 1e-9
    mechanics = model.StiffMechanicalSystem(J=0.015, tau_L=lambda t: 10.0 * (t >= load_from))
    drive = model.Drive(model.VoltageSourceConverter(u_dc=540.0), motor, mechanics)
    drive.delay = lambda duty: duty
    _simulation.solve_ivp = partial(_simulation.solve_ivp, rtol=rtol, atol=1e-3 * rtol)
    simulation = model.Simulation(drive, Replay(vectors))
    start = time.process_time()
    simulation.simulate(t_stop=len(vectors) * T_S - 1.5 * T_S)
    result = time.process_time() - start
    psi = motor.state.psi_ss
    return {
        "cpu_s": result,
        "periods": round(drive.t0 / T_S),
        "psi_alpha": psi.real,
        "psi_beta": psi.imag,
        "speed": mechanics.state.w_M.real,
    }


def gym_electric_motor(vectors: Sequence[int]) -> dict[str, float]:
    """Step the motor in gym-electric-motor, finite switching set, 50 us, Euler's method, without load.

    The inverse-gamma machine is a T model without rotor leakage.
    """
    import gym_electric_motor as gem
    from gym_electric_motor.physical_systems.mechanical_loads import PolynomialStaticLoad
    from gym_electric_motor.physical_systems.solvers import EulerSolver

    # Rotor and load share the inertia; neither may be zero.
    machine = {"p": 2, "l_m": 0.224, "l_sigs": 0.021, "l_sigr": 0.0, "j_rotor": 0.005, "r_s": 3.7, "r_r": 2.1}
    environment = gem.make(
        "Finite-SC-SCIM-v0",
        tau=T_S,
        ode_solver=EulerSolver(),
        constraints=(),
        motor={"motor_parameter": machine},
        load=PolynomialStaticLoad(load_parameter={"a": 0.0, "b": 0.0, "c": 0.0, "j_load": 0.01}),
        supply={"u_nominal": 540.0},
    )
    environment.reset()
    # An action has one bit for each leg, phase a first. The motor starts at rest, as in softrig.
    actions = [4 * a + 2 * b + c for a, b, c in (LEGS[vector] for vector in vectors)]
    start = time.process_time()
    for action in actions[:-1]:
        environment.step(action)
    result = time.process_time() - start
    speed, i_alpha, i_beta, psi_alpha, psi_beta, _ = environment.unwrapped.physical_system._ode_solver.y
    return {
        "cpu_s": result,
        "periods": len(actions) - 1,
        "psi_alpha": machine["l_sigs"] * i_alpha + psi_alpha,
        "psi_beta": machine["l_sigs"] * i_beta + psi_beta,
        "speed": speed,
    }


def jax_environments(vectors: Sequence[int], many: int = 256) -> dict[str, float]:
    """Step many of the drive's plants in JAX in one compiled call: the same machine, step and converters."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    legs = jnp.array(LEGS, dtype=float)
    phases = legs - legs.mean(axis=1, keepdims=True)
    voltages = 540.0 * jnp.stack([phases[:, 0], (phases[:, 1] - phases[:, 2]) / 3.0**0.5], axis=1)
    R_s, R_R, L_sigma, L_M, p, J, lsb = 3.7, 2.1, 0.021, 0.224, 2, 0.015, 16.0 / 2**9

    def current(x: Any) -> Any:
        return (x[:2] - x[2:4]) / L_sigma

    def derivative(x: Any, u: Any, load: Any) -> Any:
        i, psi = current(x), x[2:4]
        torque = 1.5 * p * (x[0] * i[1] - x[1] * i[0])
        turned = jnp.array([-psi[1], psi[0]]) * p * x[4]
        remaining = jnp.array([(torque - load) / J, x[4]])
        return jnp.concatenate([u - R_s * i, R_R * i - R_R / L_M * psi + turned, remaining])

    def one(x: Any, vector: Any, key: Any, load: Any) -> Any:
        u = voltages[vector]
        k1 = derivative(x, u, load)
        k2 = derivative(x + 0.5 * T_S * k1, u, load)
        k3 = derivative(x + 0.5 * T_S * k2, u, load)
        k4 = derivative(x + T_S * k3, u, load)
        x = x + T_S / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        i = current(x)
        true = jnp.array([i[0], -0.5 * i[0] + 0.75**0.5 * i[1]])
        shown = (jnp.floor(true / lsb) + (jax.random.uniform(key, (2,)) < 0.5)) * lsb
        return x, jnp.concatenate([shown, x[4:6]]), -jnp.abs(x[4])

    def all_of_them(states: Any, vectors: Any, key: Any, load: Any) -> Any:
        key, use = jax.random.split(key)
        result = jax.vmap(one, (0, 0, 0, None))(states, vectors, jax.random.split(use, many), load)
        return (*result, key)

    moves = [jnp.full(many, vector) for vector in vectors]
    states, key = jnp.zeros((many, 6)), jax.random.key(1)
    step = jax.jit(all_of_them)
    step(states, moves[0], key, 0.0)
    start = time.process_time()
    for action in moves:
        states, _, reward, key = step(states, action, key, 0.0)
        reward.block_until_ready()
    return {"cpu_s": time.process_time() - start, "speed": float(states[0, 4])}


PEERS: dict[str, Callable[[Sequence[int]], dict[str, float]]] = {
    "motulator": motulator,
    "motulator-tight": lambda vectors: motulator(vectors, rtol=1e-8),
    "gym-electric-motor": gym_electric_motor,
    "jax": jax_environments,
}


if __name__ == "__main__":
    print(json.dumps(PEERS[sys.argv[1]](json.load(sys.stdin))))
