"""Parameters that change while a rig runs: checked like those of the start, applied between two ticks, alike in every
placement.
"""

import json
import random
from argparse import Namespace
from functools import partial

import pytest
from conftest import differences, in_process, make_scenario
from hypothesis import given, settings, strategies as st
from simulated import SimulatedRig, World
from softrig_bags.content.topics import typestore
from softrig_bags.read import read_bag
from softrig_bringup.cli import main
from softrig_bringup.folder import ResultsFolder
from softrig_bringup.options.like import Recalled, compared
from softrig_bringup.report.report import write_report
from softrig_bringup.run.run import save, summary, turned
from softrig_core import (
    Block,
    BlockParams,
    ByHand,
    ParameterError,
    Recording,
    Run,
    ScenarioError,
    Signals,
    feed,
    load_scenario,
    param,
    rig_of,
    scalars,
    simulate,
)
from softrig_core.block.change import permit
from softrig_core.rig.installed import load_block
from softrig_core.wire.cdr import CdrError
from softrig_core.wire.parameter_event import decode, encode, recorded


def changed_rig(name, duration, changes, overrides=None, **keys):
    """A scenario with changes, ``{time: {node.parameter: value}}``."""
    result = load_scenario(name, overrides).changed(duration=duration)
    entries = [{"at": at, "set": values} for at, values in changes.items()]
    return rig_of(type(result).model_validate({**dict(result), **keys, "changes": entries}))


OFFSET = {"offset": {"link": "motor/state -> dc_motor_smc", "kind": "offset", "value": [2.0], "active": False}}
CASES = {  # scenario, duration, changes, further keys of the scenario
    "sliding mode": (
        "dc_motor_smc_b2",
        0.15,
        {0.05: {"dc_motor_smc.k": 60.0}, 0.1011: {"dc_motor_smc.delta": 0.5}},
        {},
    ),
    "pid": ("dc_motor_smc_b5_pid", 0.15, {0.05: {"dc_motor_pid.kp": 3.0}, 0.1: {"dc_motor_pid.ki": 90.0}}, {}),
    "gpc": ("rectifier_mpc_seed19", 0.03, {0.01: {"gpc_controller.set_point": 300.0, "gpc_controller.lam": 50.0}}, {}),
    "fault": ("dc_motor_smc_b2", 0.1, {0.05: {"offset.active": True}, 0.08: {"offset.to": 0.09}}, {"faults": OFFSET}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_scripted_change_gives_the_same_bytes_in_every_placement(case):
    name, duration, changes, keys = CASES[case]
    rig = changed_rig(name, duration, changes, **keys)
    second = in_process(rig)
    unchanged = in_process(changed_rig(name, duration, {}, **keys))
    assert differences(unchanged, second)
    first = min(changes)
    # Nothing differs before the first change, and the change acts without a tick of delay.
    for topic in unchanged.topics:
        k = sum(t < first * 1e9 for t in second.topics[topic].times)
        assert second.topics[topic].data[:k] == unchanged.topics[topic].data[:k]
    names = [m.name for m in rig.members]
    for groups in ((), [names], [names[::2]]):
        run = SimulatedRig(rig, World(), "lockstep", groups=groups)
        assert set(run.run().values()) == {"done"}
        assert not differences(second, run.recording), groups


def test_a_change_takes_effect_at_the_first_tick_that_is_not_earlier():
    rig = changed_rig("dc_motor_smc_b2", 0.1, {0.0501: {"dc_motor_smc.set_point": 5.0, "dc_motor_smc.k": 60.0}})
    a, b = (
        Signals(in_process(r))["motor/command/armature/effort"] for r in (rig, changed_rig("dc_motor_smc_b2", 0.1, {}))
    )
    law = next(m for m in rig.members if m.name == "dc_motor_smc")
    k = next(k for k in range(len(a[0])) if a[1][k] != b[1][k])
    assert a[0][k] >= 0.0501 > a[0][k] - float(law.schedule.period)


def test_replay_into_one_node_applies_the_changes():
    rig = changed_rig(*CASES["sliding mode"][:3])
    recording = in_process(rig)
    law = next(m for m in rig.members if m.name == "dc_motor_smc")
    answers = feed(law, 0, recording)
    assert answers.topics["motor/command"].data == recording.topics["motor/command"].data


def test_other_gains_of_a_pid_do_not_move_its_output():
    pid = ByHand(load_block("softrig_drives", "dc_motor_pid")(kp=2.0, ki=5.0, kd=0.1))
    for k in range(50):
        before = pid.update(k, state=(0.1 * k,), reference=(10.0,))["command"][0]
    integral = pid.x.pid.integral
    pid.change(permit(type(pid.block), pid.block.p, {"kp": 4.0, "kd": 0.3}))
    assert pid.x.pid.integral != integral
    after = pid.update(50, state=(0.1 * 49,), reference=(10.0,))["command"][0]  # the same control error again
    period = pid.block.p.period
    drift = 5.0 * period * (10.0 - 4.9)  # change of the integral in one period
    derivative = pid.x.pid.derivative
    assert after == pytest.approx(before + drift + derivative - derivative * (1.0 + 100.0 * period), abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"dc_motor_smc.period": 0.1}, "parameter period may not change while running; these may: "),
        ({"dc_motor_smc.kk": 0.1}, "parameter kk is unknown"),
        ({"dc_motor_smc.k": -1.0}, "parameter k = -1.0: input should be greater than 0"),
        ({"dc_motor_smc.k": "much"}, "parameter k = 'much'"),
        ({"dc_motor_smc.k": 60.0, "dc_motor_smc.set_point": 30.0}, "beyond reference_limit = 21.8 rad/s"),
        ({"dc_motor_smcc.k": 60.0}, "expected node.parameter with node one of"),
        ({"dc_motor_smc": 60.0}, "expected node.parameter with node one of"),
    ],
)
def test_an_impossible_change_is_refused_before_the_run(changes, text):
    with pytest.raises(ScenarioError, match=r"^dc_motor_smc_b2: change at 0\.05 s: ") as error:
        changed_rig("dc_motor_smc_b2", 0.1, {0.05: changes})
    assert text in str(error.value)


def test_a_change_that_another_change_permits_is_checked_in_order_of_time():
    allowed = {0.05: {"dc_motor_smc.reference_limit": 40.0}, 0.06: {"dc_motor_smc.set_point": 30.0}}
    changed_rig("dc_motor_smc_b2", 0.1, dict(reversed(allowed.items())))
    with pytest.raises(ScenarioError, match=r"change at 0\.04 s: .*beyond reference_limit"):
        changed_rig("dc_motor_smc_b2", 0.1, {**allowed, 0.04: {"dc_motor_smc.set_point": 30.0}})


def test_ports_and_agreed_quantities_do_not_change():
    class OfParams(BlockParams):
        """Parameters with wrong declarations."""

        size: int = param(1, "channels", live=True)
        limit: float = param(1.0, "of the plant", live=True)

    class Odd(Block[OfParams]):
        """Declares as live what cannot change."""

        @classmethod
        def ports(cls, params):
            return (), tuple(scalars(f"p{k}", f"t{k}", {"x": ""}) for k in range(params.size))

        @classmethod
        def agreed(cls, params):
            return {"tank/limit": params.limit}

    with pytest.raises(ParameterError, match="size: this would change the ports"):
        permit(Odd, OfParams(), {"size": 2})
    with pytest.raises(ParameterError, match="limit: tank/limit would change, but all nodes of a rig must agree on it"):
        permit(Odd, OfParams(), {"limit": 2.0})


def test_metrics_and_report_show_what_changed_and_when(tmp_path):
    changes = {0.0501: {"dc_motor_smc.k": 60.0}, 0.5: {"dc_motor_smc.delta": 0.5}}
    run = simulate(changed_rig("dc_motor_smc_b2", 0.1, changes))
    result = summary(run, run.results, "softrig run dc_motor_smc_b2")
    # The change waits for the next tick, which is 10 ms after the last.
    assert result["changes"] == [{"at_s": 0.06, "node": "dc_motor_smc", "set": {"k": 60.0}}]
    (tmp_path / "metrics.json").write_text(json.dumps(result))
    write_report([tmp_path], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "Changed while it ran" in page
    assert "<code>dc_motor_smc.k</code>" in page
    assert "dc_motor_smc.delta" not in page


def events(recording):
    """The changes in a recording, in the form of a scenario."""
    return [
        (t / 1e9, {f"{node}.{name}": value for name, value in values.items()})
        for t, node, values in recorded(recording)
    ]


@pytest.mark.parametrize("groups", [(), [["dc_motor_plant", "dc_motor_smc"]]])
@pytest.mark.parametrize("seed", range(3))
def test_a_manually_tuned_run_is_repeated_from_its_recording(seed, groups):
    """Somebody sets parameters at any moment; a script made from the recording gives the same bytes."""
    rig = changed_rig("dc_motor_smc_b2", 0.3, {0.2: {"dc_motor_smc.set_point": 8.0}}, faults=OFFSET)
    world, rng = World(), random.Random(seed)
    run = SimulatedRig(rig, world, "lockstep", seed, groups=groups)

    def turn(node, values):
        run.adapters[node].step.set(values)

    start = world.now
    world.at(start, partial(turn, "dc_motor_smc", {"c": 6}))  # before the first tick
    for _ in range(5):
        values = {"k": rng.uniform(10.0, 90.0), "delta": rng.choice([0.0, 1.0])}
        world.at(start + rng.randrange(20_002_000, 20_085_000), partial(turn, "dc_motor_smc", values))
    world.at(start + 20_040_000, partial(turn, "offset", {"active": True, "value": [0.5]}))
    assert set(run.run().values()) == {"done"}
    result = events(run.recording)
    assert result[0] == (0.0, {"dc_motor_smc.c": 6.0})
    assert {k for _, values in result for k in values} >= {"dc_motor_smc.k", "offset.active", "dc_motor_smc.set_point"}
    script = {}
    for at, values in result:
        script.setdefault(at, {}).update(values)
    assert not differences(run.recording, in_process(changed_rig("dc_motor_smc_b2", 0.3, script, faults=OFFSET), seed))


@pytest.mark.parametrize("late", [-1, 0, 1])
def test_sets_at_the_very_moment_of_a_tick_hold_from_one_tick_and_repeat_with_the_same_bytes(late):
    """If two people change one parameter between the same two ticks, the later value counts, and the other person is
    informed.
    """
    rig, world, messages = changed_rig("dc_motor_smc_b2", 0.1, {}), World(), []
    run = SimulatedRig(rig, world, "lockstep")
    law = run.adapters["dc_motor_smc"]
    publish, seen = law.outgoing.publish, []

    def tick(t, rows, numbers):
        publish(t, rows, numbers)
        if len(seen) == 4:
            for value in (30.0, 40.0):
                world.at(world.now + max(late, 0), lambda value=value: messages.append(law.step.set({"k": value})))
            if late < 0:  # the change arrives within the tick
                messages.append(law.step.set({"k": 20.0}))
        seen.append(t)

    law.outgoing.publish = tick
    assert set(run.run().values()) == {"done"}
    script = dict(events(run.recording))
    assert [*script.values()][-1] == {"dc_motor_smc.k": 40.0}
    assert sum(map(bool, messages)) == len(messages) - len(script)
    assert not differences(run.recording, in_process(changed_rig("dc_motor_smc_b2", 0.1, script)))


def test_in_a_flood_of_sets_each_takes_effect_or_is_named_as_replaced():
    """Also before the first tick, where each set once checked all pending ones, so that a flooded rig never began."""
    rig, world, rng, messages = changed_rig("dc_motor_smc_b2", 0.3, {}), World(), random.Random(1), []
    run = SimulatedRig(rig, world, "lockstep")

    def turn(k):
        messages.append((k, run.adapters["dc_motor_smc"].step.set({"k": k})))

    moments = [0] * 300 + [rng.randrange(20_002_000, 20_085_000) for _ in range(300)]
    for k, moment in enumerate(moments):
        world.at(world.now + moment, partial(turn, 10.0 + k / 10))
    assert set(run.run().values()) == {"done"}
    held = [values["dc_motor_smc.k"] for _, values in events(run.recording)]
    expected = [k for (k, _), (_, replaced) in zip(messages, [*messages[1:], (0.0, [])], strict=True) if not replaced]
    assert held == expected
    assert 2 < len(held) < 300
    script = dict(events(run.recording))
    assert not differences(run.recording, in_process(changed_rig("dc_motor_smc_b2", 0.3, script)))


def tuned(folder, duration="0.3"):
    """The folder of a run whose controller somebody has tuned while it ran."""
    world = World()
    run = SimulatedRig(changed_rig("dc_motor_smc_b2", float(duration), {}), world, "lockstep", seed=5)
    for at, values in ((20_030_000, {"k": 60.0}), (20_050_000, {"delta": 1.0, "k": 30.0})):
        world.at(world.now + at, partial(run.adapters["dc_motor_smc"].step.set, values))
    assert set(run.run().values()) == {"done"}
    done = Run(run.rig, 5, run.recording, mode="processes")
    command = f"softrig run dc_motor_smc_b2 --mode processes --seed 5 --duration {duration}"
    content = summary(done, done.results, command) | {"changed": turned(done)}
    save(done, content, ResultsFolder(folder))
    return content


@pytest.mark.long
def test_run_like_repeats_a_tuned_run_and_its_repetition(tmp_path, capsys):
    content = tuned(tmp_path / "tuned")
    assert len(content["changes"]) == 2
    assert content["changed"][0].startswith("dc_motor_smc.k=60.0 from 0.")
    bag = read_bag(tmp_path / "tuned" / "bag")
    for like, out in (("tuned/bag", "again"), ("again", "once_more")):
        assert main(["run", "--like", str(tmp_path / like), "--mode", "inprocess", "--no-plots",
                     "--out", str(tmp_path / out)]) == 0  # fmt: skip
        again = read_bag(tmp_path / out / "bag")
        assert again.topics.keys() == bag.topics.keys() >= {"parameter_events"}
        assert not differences(bag, again)
    capsys.readouterr()
    assert main(["run", "--like", str(tmp_path / "tuned"), "--seed", "3"]) == 2
    assert "--like repeats a run as it was: expected no --seed beside it" in capsys.readouterr().err
    assert main(["run", "--like", str(tmp_path)]) == 2
    assert "expected the directory of a run" in capsys.readouterr().err
    assert main(["run"]) == 2
    assert "expected a scenario, --like RUN, or --from RUN@T" in capsys.readouterr().err


def test_an_empty_repetition_is_not_reported(tmp_path):
    run = simulate("dc_motor_smc_b2", duration=0.1)
    before = Recalled(tmp_path, Namespace(), tmp_path, Recording(()), 0, {}, {})
    same, reported = compared(before, run, {})
    assert not same
    assert reported == [f"nothing of {tmp_path} could be compared: no message of any node that runs here"]


@pytest.mark.parametrize(("at", "reported"), [(0.17, True), (0.18, True), (0.19, False)])
def test_a_sporadic_sender_is_compared_up_to_two_of_its_ticks_before_the_end(tmp_path, at, reported):
    """In real time the run may end before it has answered its last ticks."""
    nodes = {"plant": "plant", "burst": {"executable": "burst", "parameters": {"at": [0.05, at]}}, "gain": "burst_gain"}
    rig = rig_of(make_scenario(nodes, 0.2))
    whole, cut = in_process(rig), in_process(rig)
    assert max(t.times[-1] for t in whole.topics.values() if t.times) == 200_000_000
    del cut.topics["lag/burst"].times[-1], cut.topics["lag/burst"].data[-1]
    for first, second in ((whole, cut), (cut, whole)):
        before = Recalled(tmp_path, Namespace(), tmp_path, first, 0, {}, {})
        same, text = compared(before, Run(rig, 0, second), {})
        assert same is not reported, text
        assert (f"differs from {tmp_path}: lag/burst from t = {at:g} s; " in text[0]) is reported


def test_a_refused_change_during_a_run_changes_nothing():
    rig = changed_rig("dc_motor_smc_b2", 0.3, {})
    run = SimulatedRig(rig, World(), "lockstep")
    step = run.adapters["dc_motor_smc"].step
    for values, text in (({"k": 5.0, "c": -1.0}, "c = -1.0"), ({"k": 5.0, "period": 0.1}, "period may not change")):
        with pytest.raises(ParameterError, match=text):
            step.set(values)
    assert set(run.run().values()) == {"done"}
    assert not differences(run.recording, in_process(rig))
    assert "parameter_events" not in run.recording.topics


@pytest.mark.long
@settings(max_examples=40)
@given(st.dictionaries(st.text(max_size=5), st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), st.text(max_size=9),
    st.lists(st.booleans(), max_size=3), st.lists(st.integers(-9, 9), max_size=3),
    st.lists(st.floats(0, 1), max_size=3),
    st.lists(st.text(max_size=3), max_size=3)), max_size=3), st.integers(0, 2**60))  # fmt: skip
def test_a_recorded_change_is_a_parameter_event_of_ros(values, t):
    data = encode(t, "/a/node", values)
    assert decode(data) == (t, "/a/node", values)
    message = typestore().deserialize_cdr(data, "rcl_interfaces/msg/ParameterEvent")
    assert bytes(typestore().serialize_cdr(message, "rcl_interfaces/msg/ParameterEvent")) == data
    assert [p.name for p in message.changed_parameters] == list(values)


def test_a_truncated_recorded_change_is_reported():
    data = encode(0, "/node", {"k": 1.0})
    for n in range(len(data)):
        with pytest.raises(CdrError, match=r"rcl_interfaces/msg/ParameterEvent"):
            decode(data[:n])


def test_a_fault_that_is_switched_off_is_off_whoever_switched_it_on():
    params = {"topic_in": "axis/state", "fields": ("position",), "kind": "offset", "value": (2.0,), "active": False}
    fault = ByHand(load_block("softrig_control", "fault")(**params))

    def published(t, pressed=False):
        return fault.update(t, sent=(1.0,), toggle=(float(pressed),))["arrived"][0]

    assert published(0) == 1.0
    assert published(1, pressed=True) == 3.0
    assert fault.params.active
    assert published(2) == 3.0
    # The value that the fault has from the start.
    fault.change(permit(type(fault.block), fault.params, {"active": False}))
    assert published(3) == 1.0
    fault.change(permit(type(fault.block), fault.params, {"active": True}))
    assert [published(4), published(5, pressed=True)] == [3.0, 1.0]
    fault.reset(0)
    assert published(6) == 3.0  # a reset keeps the live parameters, but not the press of the button


def test_references_in_changes_refer_to_the_parameters_at_the_start(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(
        "extends: dc_motor_smc_b2\ntitle: t\nduration: 0.1\nshared: {gain: 60.0}\nchanges:\n"
        "  - {at: 0.02, set: {dc_motor_smc.k: $gain, dc_motor_smc.delta: 1.0}}\n"
        "  - {at: 0.05, set: {dc_motor_smc.delta: $dc_motor_smc.delta}}\n"
    )
    law = next(m for m in rig_of(file).members if m.name == "dc_motor_smc")
    file.write_text(file.read_text().replace("$dc_motor_smc.delta", "$dc_motor_smc.deltaa"))
    with pytest.raises(ScenarioError, match=r"change at 0\.05 s: \$dc_motor_smc\.deltaa: dc_motor_smc has period"):
        rig_of(file)
    assert [dict(c.values) for c in law.changes] == [{"k": 60.0, "delta": 1.0}, {"delta": law.params.delta}]
