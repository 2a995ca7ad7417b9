"""Native code on every scenario: which go, why the others do not, and that what goes is what Python computes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from hypothesis import assume, given, settings, strategies as st
from softrig_core import Observer, Recording, Rig, RunError, Scenario, ScenarioError, load_scenario, rig_of
from softrig_core.block.change import changeable
from softrig_core.block.params import flatten
from softrig_core.native.compile import plain
from softrig_core.native.engine import Engine, Native, compiled
from softrig_core.run.inprocess import record, wired
from softrig_core.scenario.scenario_file import list_scenarios

Make = Callable[..., Any]
TICKS = 150  # of the clock
SLOWEST = 4  # of the slowest member
PATIENT = 1.0  # s of Python for a tick: who takes longer is no member of native code, and not waited for


def typed(made: Any) -> Any:
    """Run in Python the text that numba gets."""
    return plain(made)


def short(rig: Rig) -> float:
    """Give a duration in which each member but those that watch answers some ticks, s."""
    periods = [m.schedule.period for m in rig.members if not issubclass(m.block_class, Observer)]
    wanted = float(max(TICKS * rig.clock.schedule.clock, SLOWEST * max(periods)))
    return min(wanted, rig.scenario.duration or wanted)


def ran(rig: Rig, make: Make | None) -> tuple[Recording, Mapping[str, Any], str, Native]:
    """Run a rig in Python, tick by tick, or by a text as `make` makes it."""
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    steps = wired(rig, {m.name: m.block(rig.scenario.seed) for m in rig.members})
    record(rig, steps, recording)
    engine = Engine(list(steps.values()), make or plain)
    error = ""
    try:
        for _ in engine.run() if make else engine.runner.run():
            pass
    except RunError as broken:
        error = str(broken)
    return recording, steps, error, engine.native


def held(scenario: Any, make: Make = plain) -> Native:
    """Hold both against each other: messages, reports, errors, states, times."""
    found, others, other_error, native = ran(rig_of(scenario), make)
    if not native.ticks:
        return native
    wanted, steps, error, _ = ran(rig_of(scenario), None)
    assert other_error == error
    assert found.topics == wanted.topics
    for name, step in steps.items():
        other = others[name]
        assert repr(other.x) == repr(step.x) or other.x == step.x, name
        assert (other.reports, other.t, repr(other.values), repr(other.said)) == (
            step.reports, step.t, repr(step.values), repr(step.said)), name  # fmt: skip
    return native


def scenario(name: str, **more: Any) -> Scenario:
    """Give a scenario of a short duration."""
    found = load_scenario(name)
    return found.having(duration=short(rig_of(name)), **more)


# of each system: scenarios that go natively; the others by what is in the way
GOES: dict[str, int] = {}
STAYS: dict[str, int] = {}


def cause(reason: str) -> str:
    """Give a reason without the line of a file and the name of a node."""
    where, _, what = reason.rpartition(", line ")
    return (
        f"{where.rpartition('.')[0].rpartition('.')[2]}.{where.rpartition('.')[2]}{what[what.find(':') :]}"
        if where
        else reason
    )


def silent(rig: Rig) -> str:
    """Say who of a rig does not speak at each tick: that is known without a tick, which may take a minute of a solver."""
    return next((m.name for m in rig.members if any(p.sporadic for p in m.outputs)), "")
