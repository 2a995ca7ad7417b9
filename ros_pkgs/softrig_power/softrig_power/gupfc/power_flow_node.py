"""Power flow on request."""

from __future__ import annotations

import cmath
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from softrig_core import Block, BlockParams, Level, Values, array, button, param

from .flow.power_flow import Diverged, PowerFlow, References, Solution
from .network import BUSES, NetworkParams
from .ports import SERIES_REFERENCE, SHUNT_REFERENCE

DEVICE = {
    "v12": "pu",
    "v12_angle": "rad",
    "v34": "pu",
    "v34_angle": "rad",
    "v_sh": "pu",
    "v_sh_angle": "rad",
    "p12": "pu",
    "p34": "pu",
    "p_sh": "pu",
    "q_sh": "pu",
}
RESULT = {"converged": "", "iterations": "", "mismatch": "pu"}


class State(NamedTuple):
    """References answered last, whether the button was down; largest series voltage (pu) of each operating point."""

    asked: References | None = None
    pressed: bool = False
    sizes: tuple[float, ...] = ()


class PowerFlowParams(BlockParams):
    """Network, and the references that apply until the first message."""

    period: float = param(0.1, "how often requests are looked for", "s", ge=1e-3, le=10.0)
    network: NetworkParams = NetworkParams()
    initial: References = References()


class PowerFlowNode(Block[PowerFlowParams]):
    """Operating point for the newest references, at the start, on each request and whenever a reference changes.

    ``power_flow/bus``: a row a bus (A, 1, 2, 3, 4, B) with magnitude (pu), angle (rad) and the P and Q (pu) that the
    device injects there. ``power_flow/device``: one value each of `DEVICE`. ``power_flow/result``: converged (1 or 0),
    iterations, largest mismatch (pu). If there are several operating points, the one with the smallest series voltages
    is published, and /diagnostics has their number. All topics are silent between solutions. Without a solution only
    ``power_flow/result`` is published, because a diverged iteration has no voltages.
    """

    INPUTS = (
        button("request", "power_flow/request", held=True),
        *(replace(port, name=f"series_{k}") for k, port in SERIES_REFERENCE.items()),
        replace(SHUNT_REFERENCE, name="shunt"),
    )
    OUTPUTS = (
        array("bus", "power_flow/bus", {"bus": 6, "quantity": 4}, ["pu", "rad", "pu", "pu"] * 6, sporadic=True),
        array("device", "power_flow/device", {"quantity": len(DEVICE)}, list(DEVICE.values()), sporadic=True),
        array("result", "power_flow/result", {"quantity": len(RESULT)}, list(RESULT.values()), sporadic=True),
    )
    STATE = State

    def setup(self) -> None:
        """Prepare the network."""
        self._solver = PowerFlow(self.p.network)

    def update(
        self,
        x: State,
        t: int,
        *,
        request: tuple[float] | None,
        series_1: tuple[float, ...] | None,
        series_2: tuple[float, ...] | None,
        shunt: tuple[float, ...] | None,
    ) -> tuple[State, Values]:
        """Answer if there is anything to answer."""
        pressed = request == (1.0,)
        asked = self._references(series_1, series_2, shunt)
        due = asked is not None and (asked != x.asked or (pressed and not x.pressed))
        if asked is None or not due:
            return State(x.asked, pressed, x.sizes), {}
        solution = self._solver.solve(asked)
        if isinstance(solution, Diverged):
            text = f"diverged: mismatch {solution.mismatch:.3g} pu after {solution.iterations} iterations"
            self.report(Level.ERROR, "diverged", text)
            return State(asked, pressed), {"result": (0.0, float(solution.iterations), solution.mismatch)}
        answer = {"result": (1.0, float(solution.iterations), solution.mismatch), **self._tables(solution)}
        return State(asked, pressed, solution.sizes), answer

    def health(self, x: State) -> Mapping[str, str]:
        """Describe how many operating points there are, and which one was selected."""
        if not x.sizes:
            return {}
        used, *others = x.sizes
        text = f"{len(x.sizes)}; taken: the one with the smallest series voltage, {used:.4g} pu"
        return {"operating points": text + (f", the next needs {others[0]:.4g} pu" if others else "")}

    def _references(self, *messages: tuple[float, ...] | None) -> References | None:
        """Return the newest references; None, and a report, if they are impossible."""
        changes: dict[str, float] = {}
        for names, values in zip((("p1", "q1"), ("p2", "q2"), ("v",)), messages, strict=True):
            changes |= dict(zip(names, values or (), strict=False))
        try:
            return References(**{**self.p.initial.model_dump(), **changes})
        except ValueError:
            self.report(Level.ERROR, "references", f"references {changes} are impossible: nothing is solved")
            return None

    def _tables(self, solution: Solution) -> dict[str, tuple[float, ...]]:
        z = self.p.network.z_se
        i12, i34 = solution.v12 / z, solution.v34 / z
        injected = {
            "1": solution.s_sh - solution.bus["1"] * i12.conjugate(),
            "2": solution.bus["2"] * i12.conjugate(),
            "3": -solution.bus["3"] * i34.conjugate(),
            "4": solution.bus["4"] * i34.conjugate(),
        }
        bus = [(*cmath.polar(solution.bus[b]), injected.get(b, 0j).real, injected.get(b, 0j).imag) for b in BUSES]
        device = (
            *cmath.polar(solution.v12),
            *cmath.polar(solution.v34),
            *cmath.polar(solution.v_sh),
            solution.p12,
            solution.p34,
            solution.s_sh.real,
            solution.s_sh.imag,
        )
        return {"bus": tuple(value for row in bus for value in row), "device": device}
