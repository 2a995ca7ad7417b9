"""From demand to an answer that can be trusted: two stages, then a proof of how far the optimum can be."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from softrig_core import Array

from .branch import branch_and_bound, chord_excess
from .conditions import Conditions
from .two_stage import NoDispatch, breakpoints, milp, nlp
from .units import Units, balanced, cost_of, infeasible, marginal_cost

Method = Literal["two_stage", "certified", "enumeration", "baseline"]
Progress = Callable[[float, float], object]


class InfeasibleError(ValueError):
    """No dispatch meets the demand; the text has both sums."""


@dataclass
class Dispatch:
    """An answer.

    Parameters
    ----------
    P : ndarray, shape (n,)
        MW; limits kept exactly, balance to 1e-6 MW.
    cost : float
        F at P, $/h: never the objective of a model.
    bound : float
        Proven lower bound of every dispatch's cost, $/h; -inf when the method proves nothing.
    price : (float, float)
        Saving by one MW less and cost of one MW more, $/MWh.
    stages : dict of str to float
        Wall-clock s of each stage.
    nodes, binaries : int
        Boxes or nodes searched; binaries of the largest MILP.
    stage : str
        The last stage that ran.
    reason : str
        Why it ended.
    trace : list of (float, float, float)
        Wall-clock s, best cost and bound, as the proof closed.
    limited : bool
        Whether the wall-clock limit was reached; another run may then have another result.
    losses, reserve : float
        Losses of the network at P and spinning reserve that it leaves, MW; NaN without conditions.
    """

    P: Array
    cost: float
    bound: float = -np.inf
    price: tuple[float, float] = (-np.inf, np.inf)
    stages: dict[str, float] = field(default_factory=dict, compare=False)
    nodes: int = 0
    binaries: int = 0
    stage: str = ""
    reason: str = ""
    trace: list[tuple[float, float, float]] = field(default_factory=list, compare=False)
    limited: bool = False
    losses: float = np.nan
    reserve: float = np.nan

    @property
    def gap(self) -> float:
        """Cost less bound, $/h."""
        return self.cost - self.bound


class Optimiser:
    """Dispatches one set of units.

    Parameters
    ----------
    nseg : int
        Segments of a whole arch in the MILPs.
    tol : float
        Gap to prove, $/h.
    mip_gap : float
        Relative gap at which a MILP of the two-stage method stops.
    time_limit : float
        Wall-clock s; when it is reached, the answer is the best so far with its true gap.
    max_nodes : int
        Boxes of the branch and bound before the adaptive MILPs take over.
    """

    def __init__(
        self,
        units: Units,
        *,
        nseg: int = 4,
        tol: float = 1e-3,
        mip_gap: float = 1e-7,
        time_limit: float = 120.0,
        max_nodes: int = 1_000_000,
    ) -> None:
        self.units, self.nseg, self.tol, self.mip_gap = units, nseg, tol, mip_gap
        self.time_limit, self.max_nodes = time_limit, max_nodes

    def two_stage(self, demand: float, start: Array | None = None) -> Dispatch:
        """Run stages 1 and 2 of the paper, without a proof.

        Raises
        ------
        InfeasibleError, NoDispatch
        """
        self._check(demand)
        begun = time.perf_counter()
        first = milp(
            self.units,
            demand,
            breakpoints(self.units, self.nseg),
            gap=self.mip_gap,
            time_limit=self.time_limit,
            start=start,
        )
        between = time.perf_counter()
        P, succeeded = nlp(self.units, demand, first.P)
        result = self._answer(P)
        result.stages = {"milp": between - begun, "nlp": time.perf_counter() - between}
        result.nodes, result.binaries = first.nodes, first.binaries
        result.stage, result.limited = "nlp" if succeeded else "milp", not first.optimal
        result.reason = ("two stages" if first.optimal else "time limit in the MILP") + (
            "" if succeeded else "; the NLP failed: the MILP's dispatch"
        )
        return result

    def certified(self, demand: float, start: Array | None = None, progress: Progress | None = None) -> Dispatch:
        """Two stages, then a proof by branch and bound and, if that needs too many boxes, by adaptive MILPs.

        Parameters
        ----------
        demand : float
            MW.
        start : ndarray, optional
            A dispatch to begin with, such as that of the last demand.
        progress : callable, optional
            Called with the best cost and the bound.
        """
        self._check(demand)
        begun = time.perf_counter()
        result = self._answer(self.start(demand, start))

        def note(stage: str, bound: float) -> None:
            result.stage, result.bound = stage, max(result.bound, min(bound, result.cost))
            result.stages[stage] = time.perf_counter() - begun - sum(t for s, t in result.stages.items() if s != stage)
            result.trace.append((time.perf_counter() - begun, result.cost, result.bound))
            if progress is not None:
                progress(result.cost, result.bound)

        # Half of the tolerance, because the proven value is the search's own best, which the NLP then improves a
        # little. Of many units only the first box: its bound costs nothing, the further boxes would be too many.
        boxes = self.max_nodes if len(self.units) <= SMALL else 1
        proof = branch_and_bound(self.units, demand, result.P, 0.5 * self.tol, boxes)
        self._better(result, nlp(self.units, demand, proof.P)[0])
        result.nodes += proof.nodes
        note("branch and bound", proof.bound)
        if result.gap > self.tol:
            try:
                plain = self.two_stage(demand, result.P)
                self._better(result, plain.P)
                result.nodes, result.binaries = result.nodes + plain.nodes, plain.binaries
            except NoDispatch as error:
                result.reason = str(error)
            note("two stages", result.bound)
            self._adapt(demand, result, begun, note)
        result.reason = "proven" if result.gap <= self.tol else result.reason
        return result

    def conditioned(self, demand: float, conditions: Conditions, start: Array | None = None) -> Dispatch:
        """Branch and bound with losses, ramps and reserve, with at most `max_nodes` boxes and no time limit.

        Raises
        ------
        InfeasibleError
            No dispatch meets all conditions.
        """
        why = conditions.infeasible(self.units, demand)
        if why:
            raise InfeasibleError(why)
        begun = time.perf_counter()
        first = np.clip(self.units.p_min if start is None else start, conditions.low, conditions.high)
        proof = branch_and_bound(self.units, demand, first, self.tol, self.max_nodes, conditions)
        if not np.isfinite(proof.cost):
            done = proof.bound == np.inf
            raise InfeasibleError(
                f"infeasible: no dispatch meets demand {demand:g} MW and reserve {conditions.reserve:g} MW"
                if done
                else f"no dispatch found in {proof.nodes} boxes for demand {demand:g} MW with its conditions"
            )
        result = self._answer(proof.P)
        result.bound, result.nodes, result.stage = min(proof.bound, result.cost), proof.nodes, "branch and bound"
        result.stages = {"branch and bound": time.perf_counter() - begun}
        result.reason = "proven" if result.gap <= self.tol else f"{proof.nodes} boxes"
        weight = 1.0 - conditions.losses.slopes(proof.P)
        left, right = self.units.slopes(proof.P)
        result.price = (float(np.max(left / weight)), float(np.min(right / weight)))
        result.losses, result.reserve = conditions.losses.of(proof.P), conditions.spinning(self.units, proof.P)
        return result

    def _adapt(self, demand: float, dispatch: Dispatch, begun: float, note: Callable[[str, float], None]) -> None:
        """Lower every chord below the cost, solve, split where the model is too low at its own optimum, repeat."""
        points = [p.copy() for p in breakpoints(self.units, self.nseg)]
        groups = self.units.groups
        while dispatch.gap > self.tol:
            left = self.time_limit - (time.perf_counter() - begun)
            if left <= 0.0:
                dispatch.reason, dispatch.limited = "time limit", True
                return
            low = [lowering(self.units, j, p) for j, p in enumerate(points)]
            try:
                # While the model is coarse, an exact optimum of it is worth little, so the solver may stop early.
                gap = max(0.25 * self.tol, 0.1 * dispatch.gap) if np.isfinite(dispatch.gap) else 1.0
                model = milp(self.units, demand, points, low, gap=0.0, gap_abs=gap, time_limit=left, start=dispatch.P)
            except NoDispatch as error:
                dispatch.reason = str(error)
                return
            dispatch.nodes += model.nodes
            dispatch.binaries = max(dispatch.binaries, model.binaries)
            self._better(dispatch, nlp(self.units, demand, model.P)[0])
            note("adaptive MILP", model.bound)
            if not model.optimal:
                dispatch.reason, dispatch.limited = "time limit in the MILP", True
                return
            missing = [self._missing(j, model.P[j], points[j], low[j]) for j in range(len(self.units))]
            splits = [(j, cut) for j, (cut, below) in enumerate(missing) if below > self.tol / (2 * len(self.units))]
            for j, cut in splits:
                # Identical units share their points.
                for k in np.flatnonzero(groups == groups[j]):
                    if cut not in points[k]:
                        points[k] = np.sort(np.append(points[k], cut))
            if not splits:
                dispatch.reason = "the model is as exact as its numbers"
                return

    def _missing(self, j: int, p: float, points: Array, low: Array) -> tuple[float, float]:
        """Return where to split the segment of p, and how far the model is below the cost there, $/h."""
        if len(points) < 2:
            return p, 0.0
        k = max(0, min(int(np.searchsorted(points, p, "right")) - 1, len(points) - 2))
        x0, x1 = points[k], points[k + 1]
        y0, y, y1 = cost_of(self.units.table[j], [x0, p, x1]).tolist()
        below = y - (y0 + (y1 - y0) * (p - x0) / (x1 - x0)) + float(low[k])
        if x1 - x0 < 1e-5:
            return p, 0.0
        near_end = min(p - x0, x1 - p) < 0.15 * (x1 - x0)
        return (0.5 * (x0 + x1) if near_end else p), below

    def _check(self, demand: float) -> None:
        why = infeasible(self.units, demand)
        if why:
            raise InfeasibleError(why)

    def start(self, demand: float, guess: Array | None = None) -> Array:
        """Return a feasible dispatch as a start: the given one, or each unit at the same share of its range.

        Returns
        -------
        ndarray, shape (n,)
            MW; the best inside its own arches.
        """
        low, high = self.units.p_min, self.units.p_max
        room = float((high - low).sum())
        even = low + (high - low) * ((demand - low.sum()) / room if room else 0.0)
        return nlp(self.units, demand, balanced(self.units, even if guess is None else guess, demand))[0]

    def _answer(self, P: Array) -> Dispatch:
        return Dispatch(P, self.units.total(P), price=marginal_cost(self.units, P))

    def _better(self, dispatch: Dispatch, P: Array) -> None:
        cost = self.units.total(P)
        if cost < dispatch.cost:
            dispatch.P, dispatch.cost, dispatch.price = P, cost, marginal_cost(self.units, P)


SMALL = 64  # units up to which the branch and bound goes beyond its first box


def lowering(units: Units, j: int, points: Array) -> Array:
    """Return by how much each chord of unit j must be lowered to be below the cost, $/h, shape (segments,)."""
    ends: Sequence[float] = points.tolist()
    if len(ends) < 2:
        return np.zeros(1)
    row = units.table[j]
    return np.array([chord_excess(row, x0, x1) for x0, x1 in pairwise(ends)])
