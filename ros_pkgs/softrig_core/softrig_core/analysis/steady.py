r"""Find operating points of a rig, where its map leaves the states unchanged, by Newton's method.

.. math:: F(x) - x = 0, \quad (I - A)\, \delta = F(x) - x

A state that drifts without affecting others (the angle of a motor that turns) has no such value; its rate is reported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import RunError, ScenarioError
from ..rig.members import Member, signal_units
from ..rig.rig import Rig
from ..run.expand import rig_of
from ..scenario.scenario import Scenario
from .linear_view import Differences, plant_outputs
from .state_map import StateMap, is_source, place_of, signal_of, upstream

STEPS = 25
AT_REST = 1e-9  # share of the size of a state that it may move in a period at rest
CHECKED = 200  # periods of the whole over which a run from the point is watched
STAYS = 1e-6  # share of the size of a state that it may have moved after these periods


class NoOperatingPoint(RunError):
    """There is no operating point near the state of the run, or none was found; the message contains the reason."""


@dataclass(frozen=True)
class OperatingPoint:
    """The equilibrium of a rig for the references and disturbances of one time.

    Parameters
    ----------
    at : float
        Time of these references and disturbances, s.
    period : float
        Period of the whole rig, s.
    states, signals : dict of str to float
        Values at the operating point.
    units : dict of str to str
        Units of the signals.
    drifting : dict of str to float
        Rate of states that drift without affecting others, in their unit a second.
    steps : int
        Number of steps of Newton's method.
    slowest : float
        Magnitude of the largest pole of the states that affect others; above 1 the point is unstable.
    moved : float
        Largest change of a state in a run of 200 periods of the rig from the point, relative to the state's size.
    """

    rig: str
    at: float
    period: float
    states: Mapping[str, float]
    signals: Mapping[str, float]
    units: Mapping[str, str]
    drifting: Mapping[str, float]
    steps: int
    slowest: float
    moved: float

    @property
    def stable(self) -> bool:
        """Return whether a run that begins near it converges to it."""
        return self.slowest < 1.0


def steady(
    what: str | Scenario | Rig,
    *,
    at: float | None = None,
    outputs: Sequence[str] | None = None,
    overrides: Mapping[str, Any] | None = None,
    seed: int | None = None,
) -> OperatingPoint:
    """Find the operating point of a rig near the state of a run.

    Parameters
    ----------
    what, overrides
        See `rig_of`.
    at : float, optional
        Time at which Newton's method starts, s. Values that depend on time stay as they are then. Default: the end of
        the scenario.
    outputs : sequence of str, optional
        Signals that must be at rest; default: what the plants publish. States that do not affect them may change.
    seed : int, optional
        Seed of the rig.

    Raises
    ------
    ScenarioError
        No such signal, or the rig's periods do not fit each other.
    NoOperatingPoint
        There is none, or none was found; the reason names the state that moves most.
    RunError
        The rig failed.
    """
    rig = rig_of(what, overrides=overrides)
    at = rig.scenario.duration if at is None else at
    if not (math.isfinite(at) and at >= 0.0):
        raise ScenarioError(f"at = {at:g} s: expected 0 or more")
    observed = plant_outputs(rig) if outputs is None else [signal_of(rig, name) for name in outputs]
    if not observed:
        raise ScenarioError(f"{rig.scenario.name}: no plant publishes at each of its ticks; name outputs")
    number = rig.scenario.seed_of(seed)
    involved: dict[str, Member] = {}
    for name in observed:
        upstream(place_of(rig, name).member, involved)
    # Commands of controllers count as observed, so that an integrator which moves a plant is not taken for one that
    # drifts unread.
    commands = [
        f"{p.topic}/{x}"
        for n, member in involved.items()
        if not member.is_plant and not is_source(member)
        for p in member.outputs
        if not p.sporadic
        for x in p.labels
    ]
    received = list(dict.fromkeys([*commands, *observed]))
    m = StateMap(rig, at, number, received, (), CHECKED)
    differences = Differences(m, received, (), "")
    kept, A, C = differences.states()
    on = _core(A, (C[: len(commands)] != 0.0).any(axis=0))
    core, loose = [i for i, x in zip(kept, on, strict=True) if x], [i for i, x in zip(kept, on, strict=True) if not x]
    A, sizes = A[np.ix_(on, on)], m.sizes[core]
    # A state that was zero all the way has no size of its own.
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    steps, move = 0, _move(m, core)
    while steps < STEPS:
        step = _least_squares(A, move, sizes)
        if np.abs(step / sizes).max(initial=0.0) <= AT_REST and np.abs(move / sizes).max(initial=0.0) <= AT_REST:
            break
        steps += 1
        _go(m, core, step)
        move, A = _move(m, core), differences.again(core)
    # Newton's method has moved the core alone; states that follow from it take one period to do so.
    m.start = m(m.start, {})[0]
    begin, moved, off = m.start, 0.0, np.zeros(len(m.start))
    messages: dict[str, float] = {}
    for x, says in m.go_on(begin, CHECKED):
        messages = messages or says
        off[kept] = x[kept] - begin[kept]
        moved = max(moved, float(np.abs(off[core] / sizes).max(initial=0.0)))
    slowest = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0)) if core else 0.0
    span = CHECKED * m.period
    # A run leaves an unstable point by rounding alone, so leaving counts against stable ones only.
    if steps == STEPS or (moved > STAYS and slowest < 1.0 + AT_REST):
        worst = core[int(np.argmax(np.abs(off[core]) / sizes))]
        how = "Newton's method does not converge" if steps == STEPS else "the point found is not steady"
        raise NoOperatingPoint(
            f"{rig.scenario.name}: no operating point near t = {m.t:g} s: {how}; {m.names[worst]} = "
            f"{begin[worst]:.6g} moves by {off[worst]:.3g} within {span:g} s"
        )
    units = signal_units(rig)
    return OperatingPoint(
        rig.scenario.name,
        m.t,
        m.period,
        {m.names[i]: float(begin[i]) for i in kept},
        messages,
        {s: units.get(s, "") for s in messages},
        {m.names[i]: float(off[i]) / span for i in loose if abs(off[i]) > STAYS * (m.sizes[i] or 1.0)},
        steps,
        slowest,
        moved,
    )


def _core(A: Array, received: Any) -> Any:
    """Return the states with a lasting effect on others; a counter or an integral that nothing reads is left out."""
    on = np.ones(len(A), dtype=bool)
    diagonal = np.diag(A)
    # A state with a pole at 0 or 1 only copies or integrates others; unread, it may drift without any effect.
    ends = ~received & ((diagonal == 0.0) | (np.abs(diagonal - 1.0) < 1e-9))
    moves = (A != 0.0) & ~np.eye(len(A), dtype=bool)
    while True:
        left = on & ~(ends & ~moves[on].any(axis=0))
        if (left == on).all():
            return on
        on = left


def _move(m: StateMap, kept: list[int]) -> Array:
    after, _ = m(m.start, {})
    # Other numbers may be infinite for good, and their difference would be NaN.
    result: Array = after[kept] - m.start[kept]
    return result


def _least_squares(A: Array, move: Array, sizes: Array) -> Array:
    """Return the shortest least-squares solution of (I - A) step = move, with each state scaled by its size."""
    # I - A is singular where a state may rest anywhere, so the shortest step is taken instead of a solution.
    scaled = (np.eye(len(A)) - A) * sizes[None, :] / sizes[:, None]
    result: Array = np.linalg.lstsq(scaled, move / sizes, rcond=1e-11)[0] * sizes
    return result


def _go(m: StateMap, kept: list[int], step: Array) -> None:
    """Try a Newton step, then half of it, and so on, until the rig accepts it."""
    # A full step may leave the domain of a block far from the point.
    for share in 0.5 ** np.arange(8.0):
        trial = m.start.copy()
        trial[kept] += share * step
        try:
            m(trial, {})
        except RunError:
            continue
        m.start = trial
        return
    raise NoOperatingPoint(
        f"{m.rig.scenario.name}: no operating point near t = {m.t:g} s: the iteration leaves the limits"
    )
