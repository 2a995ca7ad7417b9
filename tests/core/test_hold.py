"""A rig at the pace of the wall clock, held and stepped, over simulated nodes: when ticks are taken, the same bits."""

from functools import partial

import pytest
from conftest import differences, in_process
from simulated import SimulatedRig, World
from softrig_core import load_scenario, rig_of

RIG = rig_of(load_scenario("dc_motor_smc_b2").changed(duration=0.6))
CLOCK = RIG.clock.name


@pytest.mark.parametrize("groups", [(), [[m.name for m in RIG.members]]])
@pytest.mark.parametrize(("pace", "least", "most"), [(0.0, 0.0, 0.55), (0.1, 5.9, 6.4), (1.0, 0.59, 0.7)])
def test_a_run_takes_as_long_as_its_pace_says_and_has_the_same_bits(groups, pace, least, most):
    world = World()
    run, start = SimulatedRig(RIG, world, "lockstep", groups=groups, pace=pace), world.now
    assert set(run.run(60.0).values()) == {"done"}
    assert least <= (world.now - start) / 1e9 <= most
    assert not differences(run.recording, in_process(RIG))


def test_pace_pause_and_step_may_change_at_any_moment():
    world, seen = World(), []
    run, start = SimulatedRig(RIG, world, "lockstep", pace=1.0), world.now
    adapter = run.adapters[CLOCK]
    hold = adapter.hold
    assert not run.adapters["dc_motor_smc"].hold.go_at(1.0)  # not the node of the clock
    for moment, call in (
        (0.22, partial(hold.go_at, 0.1)),
        (2.22, partial(hold.ask, "pause")),
        (9.0, partial(hold.ask, "step")),
        (20.0, partial(hold.ask, "resume")),
        (21.0, partial(hold.go_at, 0.0)),
    ):
        world.at(start + round(moment * 1e9), lambda call=call: (seen.append(adapter.t / 1e9), call()))
    assert set(run.run(60.0).values()) == {"done"}
    full, slow, held, stepped, again = seen
    assert 0.18 <= full <= 0.22
    assert slow - full == pytest.approx(0.2, abs=0.012)
    assert 0.0 <= held - slow <= 0.002
    assert stepped - held == pytest.approx(float(RIG.clock.schedule.period))
    assert again - stepped == pytest.approx(0.1, abs=0.012)
    assert world.now - start < 21.2e9
    assert not differences(run.recording, in_process(RIG))


def test_who_waits_for_a_slow_pace_is_told_and_does_not_give_up():
    """The plant's period takes 20 s of the wall's time: twice as long as any peer waits without a word."""
    rig = rig_of(load_scenario("dc_motor_smc_b2").changed(duration=2 * float(RIG.clock.schedule.period)))
    run = SimulatedRig(rig, World(), "lockstep", pace=float(RIG.clock.schedule.period) / 20.0)
    assert set(run.run(100.0).values()) == {"done"}
