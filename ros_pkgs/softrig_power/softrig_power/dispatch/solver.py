"""The dispatch node: a demand in, set points, their cost and a proven bound out; the work in a process of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from softrig_core import (
    Jobs,
    Level,
    Port,
    Result,
    Solver,
    SolverParams,
    Values,
    Work,
    array,
    button,
    command,
    param,
    scalars,
)

from .baselines import Baseline, lambda_iteration, swarm, without_ripples
from .certify import Dispatch, InfeasibleError, Method, Optimiser
from .conditions import Conditions, Losses
from .enumeration import TooManyError, enumerate_kinks
from .table_file import TableError
from .two_stage import NoDispatch, arch_bounds
from .units import Units, UnitTable, infeasible, marginal_cost


class DispatchParams(UnitTable, SolverParams):
    """Units, method and limits."""

    period: float = param(1.0, "sampling period: how often a demand is looked for", "s", gt=0.0, le=86400.0)
    demand: float = param(0.0, "demand until a message arrives; 0: none", "MW", ge=0.0, le=1e7)
    method: Method = param("certified", "two_stage (the paper's), certified, enumeration or baseline")
    algorithm: Baseline = param("pso", "search of the baseline")
    n_pop: int = param(50, "population of the baseline", ge=4, le=10_000)
    n_iter: int = param(300, "iterations of the baseline", ge=1, le=100_000)
    seed: int = param(0, "of the baseline, added to the seed of the run", ge=0, le=2**31 - 1)
    nseg: int = param(4, "segments of a whole arch in the MILPs", ge=1, le=64)
    tol: float = param(1e-3, "gap to prove", "$/h", gt=0.0, le=1e6)
    mip_gap: float = param(1e-7, "relative gap at which the MILP of the two stages ends", ge=0.0, le=1.0)
    time_limit: float = param(
        120.0, "wall-clock time of a solve; then the best so far with its true gap", "s", gt=0.0, le=86400.0
    )
    loss_table: str = param("", "table of B coefficients (a file or a package:// URI); empty: no losses")
    reserve: float = param(0.0, "spinning reserve asked for", "MW", ge=0.0, le=1e7)
    warm_start: bool = param(True, "begin with the last dispatch")

    def _check(self) -> None:
        units = Units.read(self.unit_table)
        if self.loss_table:
            Losses.read(self.loss_table, units.ids)
        if self.conditioned(units) and self.method != "certified":
            raise ValueError(f"method = {self.method}: losses, ramps and reserve are for the method certified")

    def conditioned(self, units: Units) -> bool:
        """Return whether there is more to meet than limits and demand."""
        ramps = np.isfinite(units.now) & (np.isfinite(units.ramp_up) | np.isfinite(units.ramp_down))
        return bool(self.loss_table) or self.reserve > 0.0 or bool(ramps.any())


class Request(NamedTuple):
    """Input of the worker process."""

    p: DispatchParams
    units: Units
    demand: float
    start: Any
    conditions: Conditions | None
    drawn: int  # random number of the baseline


class State(NamedTuple):
    """State from tick to tick."""

    units: Units
    """Those of now."""

    asked: tuple[float, Any] | None = None
    """Demand (MW) and table of the newest request."""

    pressed: bool = False
    """Whether `solve` is."""

    last: Dispatch | None = None
    requests: int = 0
    """How many there were: index of the next random number."""

    jobs: Jobs = Jobs()


class DispatchSolver(Solver[DispatchParams]):
    """Economic dispatch on request.

    A changed demand, changed units or a press on `solve` requests a dispatch. While one is being computed, the newest
    request waits. A demand that no dispatch can meet is reported as an error, and the last set points are held.

    Notes
    -----
    ``dispatch/summary`` has only reproducible values; computation times and progress are in /diagnostics.
    """

    @classmethod
    def agreed(cls, params: DispatchParams) -> Mapping[str, Any]:
        """The units: the proof is of these."""
        return Units.read(params.unit_table).agreed()

    @classmethod
    def ports(cls, params: DispatchParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one channel per unit."""
        units = Units.read(params.unit_table)
        n = len(units)
        inputs = (
            scalars("demand", "dispatch/demand", {"demand_MW": "MW"}, held=True),
            array(
                "units",
                "dispatch/units",
                {"unit": n, "column": 7},
                ["MW", "MW", "", "", "$/h", "$/h", "rad"] * n,
                held=True,
            ),
            button("solve", "dispatch/solve", held=True),
        )
        summary = {
            "demand": "MW",
            "cost": "$/h",
            "bound": "$/h",
            "gap": "$/h",
            "price_less": "$/MWh",
            "price_more": "$/MWh",
            "nodes": "",
            "binaries": "",
            "repeatable": "",
        }
        outputs = (
            command("setpoints", "dispatch/setpoints", units.ids, "MW", sporadic=True),
            array(
                "result",
                "dispatch/result",
                {"unit": n, "P_MW cost arch at_valve": 4},
                ["MW", "$/h", "", ""] * n,
                sporadic=True,
            ),
            scalars("summary", "dispatch/summary", summary, sporadic=True),
        )
        return inputs, outputs

    def first(self) -> State:
        """Return the initial state without demand and dispatch."""
        return State(Units.read(self.p.unit_table))

    def request(
        self, x: State, t: int, *, demand: Any = None, units: Any = None, solve: Any = None
    ) -> tuple[State, Request | None]:
        """Ask when the demand or the table has changed, or at a press."""
        down = solve == (1.0,)
        pressed = down and not x.pressed
        x = x._replace(pressed=down)
        wanted = demand[0] if demand is not None else self.p.demand
        if demand is None and not wanted:
            return x, None
        if (wanted, units) == x.asked and not pressed:
            return x, None
        before = x.asked
        x = x._replace(asked=(wanted, units))
        if units is not None and (before is None or units != before[1]):
            try:
                x = x._replace(units=Units(x.units.ids, np.reshape(units, (-1, 7)), x.units.more))
            except TableError as error:
                self.report(Level.ERROR, "units", f"dispatch/units: {error}; the last table stays", anew=True)
                if before is not None and before[0] == wanted and not pressed:
                    return x, None  # the table remains, so no request is needed
            else:
                self.withdraw("units")
        last = x.last.P if x.last is not None else None
        conditions = self._conditions(x.units, last)
        why = conditions.infeasible(x.units, wanted) if conditions else infeasible(x.units, wanted)
        if why:
            self.report(Level.ERROR, "infeasible", f"{why}; the last set points stay", anew=True)
            return x, None
        drawn = int(self.generator().integers(2**32, size=x.requests + 1)[-1])
        start = last if self.p.warm_start else None
        return x._replace(requests=x.requests + 1), Request(self.p, x.units, wanted, start, conditions, drawn)

    def _conditions(self, units: Units, last: Any) -> Conditions | None:
        """Return the conditions to meet now: ramps count from the last dispatch, at first from the table's outputs."""
        if not self.p.conditioned(units):
            return None
        losses = Losses.read(self.p.loss_table, units.ids) if self.p.loss_table else None
        return Conditions.of(units, losses, self.p.reserve, last)

    @staticmethod
    def solve(request: Request, work: Work) -> Dispatch | str:
        """Solve one demand by the requested method; return a text with the reason if there is no dispatch."""
        p, units, demand, start, conditions, drawn = request
        optimiser = Optimiser(units, nseg=p.nseg, tol=p.tol, mip_gap=p.mip_gap, time_limit=p.time_limit)
        try:
            if conditions is not None:
                return optimiser.conditioned(demand, conditions, start)
            if p.method == "certified":
                return optimiser.certified(demand, start, lambda cost, bound: work.status(cost=cost, bound=bound))
            if p.method == "two_stage":
                result = optimiser.two_stage(demand, start)
            else:
                if p.method == "enumeration":
                    P = enumerate_kinks(units, demand)
                else:
                    P = swarm(units, demand, p.algorithm, [p.seed, drawn], p.n_pop, p.n_iter)
                result = Dispatch(P, units.total(P), price=marginal_cost(units, P), stage=p.method)
        except (InfeasibleError, NoDispatch, TooManyError) as error:
            return str(error)
        # These methods prove nothing, but the cost of the same units without ripples is a lower bound.
        plain = without_ripples(units)
        result.bound = plain.total(lambda_iteration(plain, demand))
        return result

    def answer(self, x: State, t: int, result: Result | None, new: bool) -> tuple[State, Values]:
        """Return a new dispatch once, nothing at other ticks."""
        if not new or result is None:
            return x, {}
        answer = result.answer
        if answer is None or isinstance(answer, str):
            self.report(
                Level.ERROR, "no dispatch", f"{answer or 'no dispatch in time'}; the last set points stay", anew=True
            )
            return x, {}
        # A dispatch was found, so the faults of earlier demands are over.
        for key in ("infeasible", "no dispatch", "NLP", "time limit"):
            self.withdraw(key)
        if "failed" in answer.reason:
            self.report(Level.WARN, "NLP", answer.reason)
        if answer.limited:
            self.report(Level.WARN, "time limit", f"{answer.reason}: gap {answer.gap:.6g} $/h, not repeatable")
        # The units of the request, because newer ones may have come since.
        units, demand = result.request.units, result.request.demand
        low, high = arch_bounds(units, answer.P)
        arches = [int(np.searchsorted(units.valve_points(j), low[j] + 1e-9, "right")) for j in range(len(units))]
        at_valve = (np.abs(answer.P - low) < 1e-6) | (np.abs(answer.P - high) < 1e-6)
        rows = np.column_stack([answer.P, units.cost(answer.P), arches, at_valve])
        price = np.nan_to_num(answer.price, posinf=1e9, neginf=-1e9)
        repeatable = float(result.repeatable and not answer.limited)
        summary = (
            demand,
            answer.cost,
            answer.bound,
            answer.gap,
            float(price[0]),
            float(price[1]),
            float(answer.nodes),
            float(answer.binaries),
            repeatable,
        )
        values = {"setpoints": tuple(answer.P.tolist()), "result": tuple(rows.ravel().tolist()), "summary": summary}
        return x._replace(last=answer), values

    def health(self, x: State) -> Mapping[str, str]:
        """Add the stages of the last dispatch."""
        last = x.last
        if last is None:
            return super().health(x)
        met = (
            {} if math.isnan(last.losses) else {"losses": f"{last.losses:.6g} MW", "reserve": f"{last.reserve:.6g} MW"}
        )
        figures = {f"stage {name}": f"{seconds:.3g} s" for name, seconds in last.stages.items()}
        return {
            **super().health(x),
            "cost": f"{last.cost:.9g} $/h",
            "lower bound": f"{last.bound:.9g} $/h",
            "gap": f"{last.gap:.3g} $/h",
            "stage reached": last.stage,
            "stop reason": last.reason,
            "nodes": str(last.nodes),
            "binaries": str(last.binaries),
            **met,
            **figures,
        }
