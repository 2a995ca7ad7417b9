"""The rectifier and the line with the GUPFC beside libraries of grid converters and of power flow."""

from __future__ import annotations

from typing import Any

import numpy as np
from softrig_core import rig_of
from softrig_power.gupfc.flow.power_flow import Diverged, PowerFlow, References, Solution
from softrig_power.gupfc.network import BUSES, HALVES, NetworkParams

from .peers import Row, farthest, peer, run
from .timing import least

POINTS = 200  # number of points in the series of power flows
# References of the first and the last point, as in the scenario `gupfc`.
FIRST, LAST = References(), References(p1=1.2, p2=1.2)


def rectifier(library: str, allowed: float) -> Row | None:
    """The averaged rectifier under the commands of its predictive controller and the steps of its load."""
    rig = rig_of("rectifier_mpc")
    signals, ours = run(rig)
    plant: Any = next(m.params for m in rig.members if m.is_plant)  # parameters of rectifier_plant
    commands = signals["v_drop/command/v_drop/effort"].x[:-1]
    when, loads = signals["events/load_resistance/position"]
    begins = plant.period * np.arange(len(commands))
    held = loads[np.searchsorted(when, begins + 1e-9, side="right") - 1]
    given = {name: getattr(plant, name) for name in ("period", "V_g", "omega", "phi", "L", "R", "C", "v_start")} | {
        "command": commands.tolist(),
        "load": held.tolist(),
        "i_start": plant.i_first,
    }
    loose, tight = (peer(library, given | {"rtol": rtol}) for rtol in (0.0, 1e-11))
    if loose is None or tight is None:
        return None
    k = len(commands)
    state = [signals[f"grid/current/{phase}"].x[k] for phase in "xyz"] + [signals["dc_link/voltage/position"].x[k]]
    work = f"{k} periods of held command (difference: at a tolerance of 1e-11)"
    apart = farthest(tight["end"], state)
    return Row("rectifier_mpc", work, ours, loose["cpu_s"], apart, allowed, "A, V")


def gupfc(library: str, allowed: float) -> Row | None:
    """A time series of power flows from references, beside flows under the powers that the device injects."""
    p = NetworkParams()
    solver, last = PowerFlow(p), {name: getattr(LAST, name) for name in References.model_fields}
    first = {name: getattr(FIRST, name) for name in last}
    shares = np.linspace(0.0, 1.0, POINTS)
    points = [References(**{n: first[n] + share * (last[n] - first[n]) for n in first}) for share in shares.tolist()]
    results: list[Solution | Diverged] = []

    def solve() -> None:
        results[:] = [solver.solve(point) for point in points]

    ours = least(solve, 3)
    flows = [flow for flow in results if isinstance(flow, Solution)]
    z, y = p.impedance_base, p.half.exact_two_port(p.omega)
    source, line, charging = complex(p.source_r, p.omega * p.source_l) / z, -1.0 / y[0, 1], 2.0 * (y[0, 0] + y[0, 1])
    pairs = [("S2", "A", source, 0j), ("S1", "B", source, 0j), ("1", "2", p.z_se, 0j), ("3", "4", p.z_se, 0j)]
    pairs += [(a, b, complex(line), complex(charging)) for a, b in HALVES]
    given = {
        "base": [p.power_base, p.voltage_base, p.frequency],
        "buses": [*BUSES, "S2", "S1"],
        "branches": [(a, b, x.real, x.imag, w.real, w.imag) for a, b, x, w in pairs],
        "sources": {name: (abs(e), np.angle(e, deg=True)) for name, e in zip(("S2", "S1"), p.sources, strict=True)},
        # Powers of the device at its four buses, one row for each point; voltages at the first point as the start.
        "injected": [[(s.real, s.imag) for s in _injected(flow, p.z_se)] for flow in flows],
        "held": FIRST.v,
        "start": [(abs(u), np.angle(u, deg=True)) for u in (*flows[0].bus.values(), *p.sources)],
    }
    if (result := peer(library, given)) is None:
        return None
    apart = farthest(result["end"], [[(u.real, u.imag) for u in flow.bus.values()] for flow in flows])
    work = f"a time series of {POINTS} power flows"
    return Row("gupfc", work, ours, result["cpu_s"], apart, allowed, "pu")


def _injected(flow: Solution, z: complex) -> list[complex]:
    """Return the complex powers (pu) that the device injects at buses 1 to 4."""
    i12, i34 = (flow.v12 / z).conjugate(), (flow.v34 / z).conjugate()
    bus = flow.bus
    return [flow.s_sh - bus["1"] * i12, bus["2"] * i12, -bus["3"] * i34, bus["4"] * i34]
