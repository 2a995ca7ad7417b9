"""A rig at the pace of wall-clock time, paused and stepped, over simulated nodes: when ticks run, and the same bits."""

from functools import partial

import pytest
from conftest import differences, in_process, make_scenario
from simulated import SimulatedRig, World
from softrig_core import Signals, load_scenario, rig_of
from softrig_nodes.seam.hold import Hold

RIG = rig_of(load_scenario("dc_motor_smc_b2").changed(duration=0.6))
CLOCK = RIG.clock.name
PERIOD = float(RIG.clock.schedule.period)


@pytest.mark.parametrize("groups", [(), [[m.name for m in RIG.members]]])
@pytest.mark.parametrize(("pace", "least", "most"), [(0.0, 0.0, 0.55), (0.1, 5.9, 6.4), (1.0, 0.59, 0.7)])
def test_a_run_takes_the_time_of_its_pace_and_has_the_same_bits(groups, pace, least, most):
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
    assert not run.adapters["dc_motor_smc"].hold.go_at(1.0)  # only the node of the clock has a pace
    assert adapter.account.status()["pace"] == 1.0
    for moment, call in (
        (0.22, partial(hold.go_at, 0.1)),
        (2.22, partial(hold.ask, "pause")),
        (9.0, partial(hold.ask, "step")),
        (20.0, partial(hold.ask, "resume")),
        (21.0, partial(hold.go_at, 0.0)),
    ):
        world.at(start + round(moment * 1e9), lambda call=call: (seen.append(adapter.t / 1e9), call()))
    assert set(run.run(60.0).values()) == {"done"}
    full, slow, paused, stepped, again = seen
    assert 0.18 <= full <= 0.22
    assert slow - full == pytest.approx(0.2, abs=0.012)
    assert 0.0 <= paused - slow <= 0.002
    assert stepped - paused == pytest.approx(float(RIG.clock.schedule.period))
    assert again - stepped == pytest.approx(0.1, abs=0.012)
    assert world.now - start < 21.2e9
    assert adapter.account.status()["pace"] == 0.0
    assert not differences(run.recording, in_process(RIG))


def test_at_a_pace_of_zero_nothing_runs_however_often_it_is_asked():
    world, seen = World(), []
    run, start = SimulatedRig(RIG, world, "lockstep", pace=1e-12), world.now
    adapter = run.adapters[CLOCK]
    for k in range(1, 11):
        world.at(start + k * 100_000_000, partial(adapter.hold.go_at, 1e-12))
    world.at(start + 2_000_000_000, lambda: (seen.append(adapter.t), adapter.hold.go_at(0.0)))
    assert set(run.run(10.0).values()) == {"done"}
    assert seen == [0]


@pytest.mark.parametrize(
    ("hands", "ticks"),
    [
        (lambda hold, k: hold.go_at(PERIOD * (1 + k % 2)), 15),  # a dragged slider sends ten changes a second
        (lambda hold, k: hold.ask(("resume", "pause")[k % 2]), 5),
        (lambda hold, k: hold.ask(("pause", "pause", "resume", "resume")[k % 4]), 6),
        (lambda hold, k: hold.ask(("pause", "resume")[k % 4 // 3]) and hold.go_at(PERIOD * (1 + k % 2)), 4),
        (lambda hold, k: hold.ask("resume"), 10),
    ],
)
def test_the_elapsed_time_of_a_tick_survives_changes_of_the_pace(hands, ticks):
    """A tick takes a second of wall-clock time, or half of one; ten actions within it must not trigger a tick each."""
    world, seen = World(), []
    run, start = SimulatedRig(RIG, world, "lockstep", pace=PERIOD), world.now
    adapter = run.adapters[CLOCK]
    for k in range(100):
        world.at(start + (k + 1) * 100_000_000, partial(hands, adapter.hold, k))
    world.at(start + 10_050_000_000, lambda: (seen.append(adapter.t), adapter.hold.ask("resume")))
    world.at(start + 10_060_000_000, partial(adapter.hold.go_at, 0.0))
    assert set(run.run(60.0).values()) == {"done"}
    assert seen[0] / 1e9 / PERIOD == pytest.approx(ticks, abs=1.01)


def test_a_run_that_was_stepped_continues_from_where_it_is():
    world, seen = World(), []
    run, start = SimulatedRig(RIG, world, "lockstep", pace=PERIOD), world.now
    adapter = run.adapters[CLOCK]
    for at, call in (
        (1.5, partial(adapter.hold.ask, "pause")),
        (2.0, partial(adapter.hold.ask, "step", 20)),
        (3.0, partial(adapter.hold.ask, "resume")),
        (5.5, lambda: seen.append(adapter.t)),
        (5.6, partial(adapter.hold.go_at, 0.0)),
    ):
        world.at(start + round(at * 1e9), call)
    assert set(run.run(60.0).values()) == {"done"}
    assert seen[0] / 1e9 / PERIOD == pytest.approx(24, abs=1.01)


def test_a_node_that_waits_for_a_slow_pace_is_informed_and_does_not_time_out():
    """The plant's period takes 20 s of wall-clock time: twice the time that a peer waits for a sign of life."""
    rig = rig_of(load_scenario("dc_motor_smc_b2").changed(duration=2 * float(RIG.clock.schedule.period)))
    run = SimulatedRig(rig, World(), "lockstep", pace=float(RIG.clock.schedule.period) / 20.0)
    assert set(run.run(100.0).values()) == {"done"}


@pytest.mark.parametrize("apart", [0.0, 7.0], ids=["", "clocks apart"])
@pytest.mark.parametrize("groups", [(), [["dc_motor_plant", "dc_motor_smc"]], [[m.name for m in RIG.members]]])
def test_in_real_time_the_clock_of_a_paused_rig_stops_and_nothing_is_late(groups, apart):
    """Paused at t = 0, three single steps, a pause of a minute, one that ends immediately: the bits of lockstep."""
    world, seen = World(), []
    run = SimulatedRig(RIG, world, "realtime", groups=groups, departs=True, paused=True)
    nodes = list(run.adapters.values())
    run.nodes["dc_motor_smc"].ahead = round(apart * 1e9)
    hold, start = run.adapters[CLOCK].hold, world.now
    asks = [(5.0, "step"), (6.0, "step"), (6.0, "step"), (9.0, "resume"), (9.2, "pause"), (60.0, "resume")]
    for moment, what in [*asks, (60.1, "pause"), (60.11, "resume")]:
        call = partial(hold.ask, what)
        world.at(start + round(moment * 1e9), lambda call=call: (seen.append({a.t / 1e9 for a in nodes}), call()))
    assert set(run.run(90.0).values()) == {"done"}
    period = float(RIG.clock.schedule.period)
    assert [max(t) for t in seen[:4]] == pytest.approx([0.0, period, period, 3 * period])
    # Counts nodes that are due at every second tick as well.
    assert all(max(t) - min(t) <= 2 * period for t in seen), seen
    assert max(seen[4]) - max(seen[3]) == pytest.approx(0.2 - 0.05, abs=2 * period)
    assert max(seen[5]) - max(seen[4]) == pytest.approx(0.05, abs=2 * period)
    assert world.now - start == pytest.approx(60.0e9 + (0.6 - max(seen[5])) * 1e9, abs=0.2e9)
    for adapter in nodes:
        assert not {k: v for k, v in adapter.drive.counts().items() if v}
        assert set(adapter.step.reports) <= {"clock"}
    expected, signals = Signals(in_process(RIG)), Signals(run.recording, run.adapters[CLOCK].epoch)
    for name in (f"{p.topic}/{label}" for m in RIG.members for p in m.outputs for label in p.labels):
        x = expected[name].x.tolist()
        assert signals[name].x.tolist()[: len(x)] == x, name  # in real time, sources publish at the end as well


def test_in_real_time_a_rig_with_hardware_cannot_pause_and_has_no_pace():
    run = SimulatedRig(RIG, World(), "realtime", departs=True)
    assert run.run(0.5)
    assert not run.adapters[CLOCK].hold.go_at(1.0)
    assert run.adapters["dc_motor_smc"].hold.ask("pause") == (False, "this node has not begun")
    guest = {"plant": "plant", "source": "source", "gain": {"executable": "gain", "external": True}}
    run = SimulatedRig(rig_of(make_scenario(guest)), World(), "realtime", departs=True)
    assert not any(adapter.pauses for adapter in run.adapters.values())


class Wall:
    """A middleware that only has a clock, s."""

    now = 0.0

    def steady(self):
        return self.now

    def timer(self, ns, call):
        return self

    def again(self, ns, period=0):
        pass

    def publisher(self, *_):
        return lambda data: None

    full_name = "/clock"


@pytest.mark.parametrize(("late", "forgotten"), [(0.25, False), (0.250001, True)])
def test_a_quarter_of_a_second_is_caught_up_and_more_is_dropped(late, forgotten):
    wall, hold = Wall(), Hold(pace=2.0)
    hold.begin(wall, lambda: None)
    assert hold.holds(0)  # the pace counts from here on
    wall.now = 0.5 + late
    assert not hold.holds(1_000_000_000)  # the tick is due at 0.5 s
    # The tick was due at 0.7 s; missed ticks are made up at once, or skipped.
    assert hold.holds(1_400_000_000) == forgotten
