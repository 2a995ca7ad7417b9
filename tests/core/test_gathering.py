"""An observer that processes some ticks together in real time has the same result as one that is called at each
tick.
"""

import random

import pytest
from conftest import few
from softrig_core import RunError, Sample, rig_of
from softrig_core.block.gathering import MANY, STRETCH, gather
from softrig_core.run import choice
from softrig_core.run.inprocess import run_inprocess, step_of
from softrig_core.wire.recording import Recording
from softrig_drives.dc_motor.plant import DcMotorPlant

PERIOD = 0.0005


def watchers():
    """Two equal observers: one that gathers ticks, one that is called at each tick."""
    rig = rig_of(
        "induction_dtc", overrides={f"{n}.period": PERIOD for n in ("im_plant", "dtc_controller", "flux_monitor")}
    )
    (member,) = (m for m in rig.members if m.name == "flux_monitor")
    steps = [step_of(member, member.block(0)) for _ in range(2)]
    gather(steps[0], STRETCH // steps[0].schedule.time(1))
    return steps


def kept(step):
    """The state of an observer, for any division into blocks."""
    sizes = [port.size for port in step.inputs]
    columns = []
    for k, size in zip(step.x.seen, sizes, strict=True):
        stamps = k.stamps(size)
        columns.append([stamps.tolist(), [k.column(size, i, len(stamps)).tolist() for i in range(size)]])
    return columns, [(k.stamp, k.forgot) for k in step.x.seen]


@pytest.mark.parametrize("seed", few(range(4), 2))
def test_its_state_is_that_of_its_single_ticks(seed):
    chance, (gathering, plain) = random.Random(seed), watchers()
    newest = {}
    for step in (gathering, plain):
        step.stamps = {p.name: (lambda name=p.name: newest.get(name)) for p in step.inputs}
    every = {p.name: chance.choice((1, 1, 2, 7, 20, 1000)) for p in plain.inputs}
    late = {p.name for p in plain.inputs if chance.random() < 0.3}
    stretch, used = STRETCH // plain.schedule.time(1), 0
    for k in range(400):
        t = plain.schedule.time(k)
        for port in plain.inputs:
            if k % every[port.name] == 0 or chance.random() < 0.05:
                stamp = max(0, t - chance.choice((0, 0, 300_000, 2_000_000)))
                newest[port.name] = stamp if chance.random() < 0.95 else t + 1  # a publisher that is ahead
                values = tuple(chance.gauss(0.0, 1.0) for _ in range(port.size))
                for step in (gathering, plain):
                    step.values[port.name] = Sample(stamp, values) if port.name in late else values
        bad = chance.random() < 0.02
        for step in (gathering, plain):
            step.bad = bad
            step.answer(t)
        used += bad or kept(gathering) == kept(plain)
        if chance.random() < 0.02 or k == 399:
            assert gathering.status() == plain.status()
            assert kept(gathering) == kept(plain)
    assert 400 / stretch <= used < 200  # both have the same state at the end of each stretch, and rarely in between


def test_ticks_within_a_hundredth_of_a_second_are_processed_at_the_last_one():
    gathering, plain = watchers()
    for step in (gathering, plain):
        step.stamps = {p.name: (lambda: None) for p in step.inputs}
    used, accept = [], gathering.block.at_once
    gathering.block.at_once = lambda x, t, messages: used.append(t) or accept(x, t, messages)
    for k in range(65):
        gathering.answer(plain.schedule.time(k))
    # Each tick lasts half a millisecond, so a stretch has twenty.
    assert used == [plain.schedule.time(k) for k in (19, 39, 59)]


@pytest.mark.parametrize(("period", "gathers"), [(0.0001, True), (0.006, False)])
def test_a_slow_or_publishing_node_is_called_at_each_tick(period, gathers):
    rig = rig_of("induction_dtc", overrides={"flux_monitor.period": period})
    results = set()
    for member in rig.members:
        step = step_of(member, member.block(0))
        before = step.respond
        gather(step, STRETCH // step.schedule.time(1))
        if step.respond != before:
            results.add(member.name)
    assert results == ({"flux_monitor"} if gathers else set())


class Breaking(DcMotorPlant):
    """Fails after half of the run."""

    def advance(self, x, t, **inputs):
        return 1.0 / 0.0 if t == 250_000_000 else super().advance(x, t, **inputs)


@pytest.mark.parametrize(
    ("name", "duration", "breaks"),
    [
        ("dc_motor_smc_b2", 0.5, False),
        ("dc_motor_smc_b2", 0.5, True),
        ("dc_motor_fsfb_s2", 0.3, False),  # its outputs are silent at times, or late
        ("dc_motor_smc_faults", 0.5, False),  # its outputs can be invalid
    ],
)
def test_a_run_in_process_that_gathers_ends_as_one_that_does_not(name, duration, breaks, monkeypatch):
    monkeypatch.setattr(choice, "unwanted", lambda steps, left, runs: "a test")
    monkeypatch.setattr(choice, "writes", lambda steps, left: False)
    monkeypatch.setattr(choice, "cost", lambda steps: 0.0)
    rig = rig_of(name, duration=duration)
    figures = next(m.name for m in rig.members if m.block_class.__name__ == "Figures")
    rig = rig_of(name, duration=duration, overrides={f"{figures}.window": 0.1})
    if breaks:
        rig.members[0].block_class = Breaking
    results = []
    for ticks in (1, 7, MANY):
        steps, recording, error = {}, Recording((n, port.msgtype) for n, port in rig.topics.items()), ""
        monkeypatch.setattr(
            choice, "gather", lambda s, _, ticks=ticks, steps=steps: (steps.update({s.name: s}), gather(s, ticks))
        )
        try:
            run_inprocess(rig, 1, recording)
        except RunError as raised:
            error = str(raised)
        ends = {n: (s.t, repr(s.values), s.reports) for n, s in steps.items()}
        results.append((recording.topics, error, ends, kept(steps[figures]), steps[figures].status()))
    assert bool(results[0][1]) == breaks
    assert results[0] == results[1] == results[2]
