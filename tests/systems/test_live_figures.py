"""The node `figures`: its results during a run equal those of the recording."""

from collections import deque

import pytest
from conftest import few
from softrig_core import (
    ByHand,
    RunError,
    Sample,
    Scenario,
    ScenarioError,
    list_scenarios,
    load_scenario,
    rig_of,
    simulate,
)
from softrig_core.run.live_figures import Figures, Measured
from softrig_core.verdict.watch import MANY, Kept, row_of

SPEED = "motor/true_state/shaft/velocity"
NODE = {"package": "softrig_core", "executable": "figures"}


def with_figures(name, duration):
    """The scenario with a node `figures`, whatever the names of its nodes."""
    scenario = load_scenario(name).changed(duration=duration)
    others = {n: e.model_dump() for n, e in scenario.nodes.items()}
    own = [others.pop(n) for n, e in scenario.nodes.items() if e.executable == "figures"]
    return Scenario.model_validate({**dict(scenario), "nodes": {**others, "figures": own[0] if own else NODE}})


def live(run):
    return dict(run.blocks["figures"].status())


@pytest.mark.parametrize(
    ("name", "duration", "least"),
    few(
        [
            ("dc_motor_smc_b1", 4.0, 7),
            ("dc_motor_smc_faults", 4.0, 6),
            ("rehab_impedance", 4.0, 18),
            ("dc_motor_fsfb_s1_none", 8.0, 7),
            ("dc_motor_fsfb_s2", 8.0, 9),
            ("manipulator_adsmc_s2", 4.0, 12),
            ("induction_dtc_s2", 2.0, 12),
            ("lsrm_fuzzy_n2", 2.0, 4),
            ("pv_mppt", 3.0, 8),
            ("rectifier_mpc", 0.6, 5),
            ("gupfc_stretch", 1.5, 40),
        ],
        2,
    ),
)
def test_figures_during_a_run_equal_those_of_the_recording(name, duration, least):
    run = simulate(with_figures(name, duration))
    measured = {r.name: (r.value, r.unit) for r in run.results if r.value is not None}
    known = {n: x for n, x in measured.items() if n in run.rig.scenario.figures}
    assert len(known) >= least
    assert live(run) == known


def of_a_study(name, duration):
    """Return the results of a run of many, and the number of topics that it did not record."""
    run = simulate(name, duration=duration, runs=2, signals=())
    return run.results, sum(not topic.times for topic in run.recording.topics.values())


@pytest.mark.parametrize(
    ("name", "duration", "silent"),
    [
        ("dc_motor_smc", 0.02, 0),
        ("dc_motor_smc_faults", 0.1, 6),
        ("dc_motor_fsfb_s2", 0.1, 4),
        ("induction_dtc_s2", 0.01, 1),
        ("lsrm_fuzzy_n2", 0.01, 3),
        ("lsrm_fuzzy_n4", 0.02, 7),
        ("rehab_impedance", 0.02, 2),
    ],
)
def test_a_run_of_many_records_what_its_figures_read_and_measures_the_same_as_a_whole_one(
    name, duration, silent, monkeypatch
):
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    result, unread = of_a_study(name, duration)
    assert repr(result) == repr(simulate(name, duration=duration).results)
    assert unread == silent


def read_alike(scenario):
    """Return what decides which topics a run of many records: scenarios that differ only in numbers share it."""
    texts = [
        (name, f.function, {k: v for k, v in f.arguments.items() if isinstance(v, str)}, f.since)
        for name, f in scenario.figures.items()
    ]
    nodes = {name: (entry.executable, entry.remap) for name, entry in scenario.nodes.items()}
    return repr((scenario.system, nodes, texts, sorted(scenario.requirements), scenario.faults.keys(), scenario.record))


KINDS = {read_alike(s): s.name for s in map(load_scenario, reversed(list_scenarios()))}.values()


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(KINDS))
def test_one_run_of_each_kind_measures_the_same(name, monkeypatch):
    """Each run lasts twenty ticks of the clock and five of the slowest node."""
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    rig = rig_of(name)
    if any(entry.external for entry in rig.scenario.nodes.values()):
        pytest.skip("it has a node from outside")
    most = max(20 * rig.clock.params.period, *(5 * m.schedule.clock * m.schedule.every for m in rig.members))
    duration = float(max(min(rig.scenario.duration, most), rig.clock.params.period))
    whole = text_of(lambda: simulate(name, duration=duration).results)
    assert text_of(lambda: of_a_study(name, duration)[0]) == whole


def text_of(results):
    """Return the result: a planner with such a short horizon may break, in both runs in the same way."""
    try:
        return repr(results())
    except RunError as error:
        return str(error)


STEPS = {"motor_reference.times": [0.0, 2.0], "motor_reference.velocities": [10.0, 4.0]}


def test_figures_are_those_of_the_newest_step_of_their_reference():
    """Down from 10 to 4 rad/s at 2 s: the mirror image of a step up by 6, counted from there."""
    run = simulate("dc_motor_smc_b2", overrides=STEPS, duration=5.5)
    up = simulate("dc_motor_smc_b2", overrides={"motor_reference.velocities": [6.0]}, duration=3.5)
    t, w = run.signals[SPEED]
    late = w[t > 5.0 - 1e-9]
    assert run.figures["mean_error"] == pytest.approx(4.0 - late[:-1].mean(), abs=1e-3)
    assert run.figures["peak_to_peak"] == late.max() - late.min()
    assert 0.0 < run.figures["rise_time"] < up.figures["rise_time"] * 2.0
    assert run.figures["overshoot"] < 5.0
    # A recorded run leaves out the node of figures, and computes its figures on request.
    assert isinstance(run.blocks["dc_motor_metrics"], Measured)
    assert run.blocks["dc_motor_metrics"].status()["rise_time"] == (run.figures["rise_time"], "s")


def test_a_step_before_the_window_has_no_figures():
    overrides = STEPS | {"dc_motor_metrics.window": 2.0}
    assert (
        "rise_time"
        in simulate("dc_motor_smc_b2", overrides=overrides, duration=3.5).blocks["dc_motor_metrics"].status()
    )
    assert simulate("dc_motor_smc_b2", overrides=overrides, duration=5.5).blocks["dc_motor_metrics"].status() == {}


def rows(kept):
    """Stamp and some values of each message."""
    stamps = kept.stamps(WIDE)
    columns = [kept.column(WIDE, k, len(stamps)).tolist() for k in SOME]
    return list(zip(stamps.tolist(), zip(*columns, strict=True), strict=True))


WIDE = 100  # numbers in a message, so that the samples fill four blocks
SOME = (0, 57, WIDE - 1)


@pytest.mark.parametrize("window", few([5, 700, pytest.param(5000, marks=pytest.mark.long)], 1))
def test_a_window_is_a_queue(window):
    """Over many blocks, with repeated messages and pauses that empty it."""
    kept, queue, forgot = Kept(), deque(), False
    at_once, new, row = Kept(), [], row_of(WIDE)
    for t in range(2000):
        stamp, values = t - t % 3, (float(t), *range(1, WIDE))
        if 900 < t < 1800:
            continue
        if stamp > kept.stamp:
            new.append((stamp, values))
        kept = kept.with_message(row, stamp, values, t, window)
        if not queue or stamp > queue[-1][0]:
            queue.append((stamp, values))
        while queue and queue[0][0] < t - window:
            queue.popleft()
            forgot = True
        assert rows(kept) == [(when, tuple(row[k] for k in SOME)) for when, row in queue]
        assert kept.forgot == forgot
        if t in (3, 100, 899, 900, 1801, 1999):
            at_once, new = at_once.with_messages(new, t, window), []
            assert at_once == kept
    stale = kept.with_message(row, 0, (0.0,) * WIDE, 10**6, window)
    assert (rows(stale), stale.forgot) == ([], True)


def test_stored_messages_take_the_memory_of_their_numbers_in_the_window():
    kept, row = Kept(), row_of(2)
    for t in range(20_000):
        kept = kept.with_message(row, t, Sample(0, (1.0, 2.0)), t, 6_000)
    room = sum(map(len, kept.blocks)) + len(kept.filling) + len(kept.newest)
    assert 6_000 * 24 <= room < 6_000 * 24 + 2 * MANY
    assert kept.with_messages((), 40_000, 6_000).stamps(2).size == 0
    # Samples that have left the window do not return.
    longer = kept.with_message(row, 20_000, (1.0, 2.0), 20_000, 15_000)
    assert longer.stamps(2)[0] == 13_999


def test_a_node_started_alone_reads_only_the_topics_of_a_scenario():
    node = Figures(scenario="dc_motor_smc_b1")
    topics = {p.topic for p in node.ports(node.p)[0]}
    assert topics == {"motor/true_state", "motor/applied", "motor/sensors", "motor/reference"}
    assert ByHand(node).status() == {}
    inside = next(m for m in rig_of("dc_motor_smc_b1").members if m.name == "dc_motor_metrics")
    assert inside.params.given() == node.p.given()


def test_it_follows_a_parameter_that_its_figures_refer_to():
    rig = rig_of("dc_motor_smc_stretch_b")
    # The values are not stored in the scenario, only received.
    assert rig.scenario.nodes["dc_motor_metrics"].parameters == {}
    node = next(
        m for m in rig_of(rig, overrides={"dc_motor_plant.load_times": [0.0, 2.5]}).members if m.name[-7:] == "metrics"
    )
    assert {f.name: f.arguments["start"] for f in Figures(node.params).figures(None) if f.name == "load_dip"} == {
        "load_dip": 2.5
    }


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"since": "motor/reference/shaft/velocty"}, "no signal 'motor/reference/shaft/velocty'.*did you mean"),
        ({"since": "motor/sensors/current_a/position"}, "a signal in 'rad/s' and a reference in 'A'"),
        (
            {"since": f"{SPEED}, motor/reference/shaft/velocity"},
            "with several signals the final",
        ),
        ({"since": "motor/reference/shaft/velocity, nothing"}, "no signal 'nothing'"),
        ({"arguments": {"signal": SPEED, "initial": 1.0}}, "with initial the final value must be given, too"),
        (
            {"function": "lsrm_arrival", "arguments": {"v_d": 1.0}},
            "since: arrival has no start, since it covers a whole run",
        ),
    ],
)
def test_figures_that_cannot_count_from_a_step_are_refused_before_the_run(changes, text):
    scenario = load_scenario("dc_motor_smc_b1")
    entry = scenario.figures["rise_time"].model_copy(update=changes)
    with pytest.raises(ScenarioError, match=text):
        rig_of(scenario.model_copy(update={"figures": {**scenario.figures, "rise_time": entry}}))
