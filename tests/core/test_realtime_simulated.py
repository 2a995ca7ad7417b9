"""Real time and lockstep over a simulated middleware: which tick's inputs a law uses, with a clock the test moves."""

import math
import random

import numpy as np
import pytest
from conftest import differences, in_process, make_scenario
from faultrig import COMMAND, STATE, Lag
from simulated import SimulatedNode, SimulatedRig, World, some
from softrig_core import Block, Rig, Signals, array, load_scenario, rig_of
from softrig_nodes.seam.tick import TickWriter
from test_ports import RIGS

BASIC = {"plant": "plant", "source": "source", "gain": "gain"}
MS, SECOND = 1_000_000, 1_000_000_000


def basic(duration=0.5, **changes):
    return rig_of(make_scenario(BASIC | changes, duration))


def shortened(name, duration):
    scenario = load_scenario(name)
    return rig_of(scenario.changed(duration=duration))


def jitter(seed, low, high):
    rng = random.Random(seed)
    return lambda topic, writer, reader: rng.randrange(low, high)


@pytest.mark.parametrize(("seed", "shared"), [(0, False), (1, False), (2, True), (3, True)])
@pytest.mark.parametrize("name", ["dc_motor_smc_b2", "rehab_impedance"])
def test_a_controller_uses_the_inputs_of_its_tick(name, seed, shared):
    """Messages of one tick arrive in any order: real time gives the numbers of lockstep, bit for bit."""
    rig = shortened(name, 0.3)
    expected = Signals(in_process(rig))
    fastest = rig.clock.schedule.time(1)
    groups = [[m.name for m in rig.members]] if shared else ()
    run = SimulatedRig(rig, World(jitter(seed, 1_000, fastest // 8)), "realtime", groups=groups)
    assert set(run.run().values()) == {"done"}
    signals = Signals(run.recording, run.epoch)
    for member in rig.members:
        adapter = run.adapters[member.name]
        assert adapter.drive.missed == adapter.drive.incomplete == 0, member.name
        for port in member.outputs:
            if port.held:
                continue
            for label in port.labels:
                a, b = expected[f"{port.topic}/{label}"], signals[f"{port.topic}/{label}"]
                n = min(len(a.x), len(b.x))
                assert n >= len(a.x) - 1
                assert np.array_equal(a.x[:n], b.x[:n]), f"{port.topic}/{label}"


FAULTS = {
    "offset": {"value": [0.25]},
    "loss": {"probability": 0.3},
    "silence": {"every": 0.05, "lasts": 0.02},
    "delay": {"delay": 0.02, "jitter": 0.03},
    "repeat": {"probability": 0.5},
    "invalid": {"probability": 0.3},
}


@pytest.mark.parametrize("places", ["alone", "some together", "all together"])
@pytest.mark.parametrize("kind", FAULTS)
def test_a_controller_waits_for_a_fault_also_at_a_tick_at_which_that_is_silent(kind, places):
    """One fault after another before a controller, one before its reference: ticks and numbers are those of
    lockstep.
    """
    faults = {
        "a": {"link": "lag/state -> gain", "kind": kind, **FAULTS[kind]},
        "b": {"link": "lag/state -> gain", "kind": "noise", "value": [0.1]},
        "c": {"link": "lag/reference", "kind": "loss", "probability": 0.2},
    }
    rig = rig_of(make_scenario(BASIC | {"watcher": "watcher"}, 0.4, faults=faults))
    names, rng = [m.name for m in rig.members], random.Random(kind)
    groups = {"alone": (), "some together": (rng.sample(names, 3),), "all together": (names,)}[places]
    run = SimulatedRig(rig, World(lambda *_: rng.randrange(1_000, MS)), "realtime", groups=groups, departs=True)
    assert set(run.run().values()) == {"done"}
    for name, adapter in run.adapters.items():
        assert not any(adapter.drive.counts().values()), name
    epoch, expected = run.adapters["gain"].epoch, in_process(rig)
    for name in {p.topic for m in rig.members for p in m.outputs}:
        ticks, signals = expected.topics[name].times, [t - epoch for t in run.recording.topics[name].times]
        common = min(len(ticks), len(signals))
        assert ticks[:common] == signals[:common], name
        assert common >= len(ticks) - 1, name
    signals = Signals(run.recording, epoch)
    for label, (_, x) in Signals(expected).items():
        common = min(len(x), len(signals[label].x))
        assert np.array_equal(x[:common], signals[label].x[:common], equal_nan=True), label


def test_a_delay_uses_the_stamp_of_a_plants_message():
    """Its port accepts other times as well, but this sender stamps with the tick, which is answered however late."""
    rng = random.Random(0)
    late = {"/axis/state": [MS, MS, MS, 12 * MS]}
    rig = shortened("dc_motor_fsfb_s1", 0.5)
    run = SimulatedRig(rig, World(lambda t, *_: rng.choice(late.get(t, [MS]))), "realtime")
    run.run()
    assert run.adapters["fieldbus_delay"].drive.counts() == {"missed_deadlines": 0, "incomplete_ticks": 0}


def test_acknowledgements_that_no_node_can_have_sent_are_refused():
    rig = rig_of(make_scenario(BASIC, 0.3, faults={"gone": {"link": "lag/state", "kind": "silence"}}))
    run = SimulatedRig(rig, World(), "realtime")
    run.world.match()
    run.world.run(run.epoch + 95 * MS)
    for data in (TickWriter()(run.epoch + 3600 * SECOND, ()), b"\0\1\0\0\1\2\3"):
        send(run, "/gone/tick", "std_msgs/msg/Header", data)
    run.run()
    gain = run.adapters["gain"]
    assert (gain.paces[0].refused, gain.drive.incomplete, gain.ticks) == (2, 0, 31)


def test_a_tick_without_all_its_inputs_is_answered_after_a_part_of_the_period_and_counted():
    def late(topic, writer, reader):
        return 9 * MS if topic == "/lag/reference" else MS // 10  # each message is 9 ms late, of a period of 10 ms

    rig = basic()
    run = SimulatedRig(rig, World(late), "realtime", patience=0.5)
    run.run()
    gain = run.adapters["gain"]
    assert gain.drive.incomplete >= 48
    assert gain.step.reports["incomplete"][1] == "answered without what was due on lag/reference"
    assert gain.drive.statistics()["incomplete_ticks"] == gain.drive.incomplete
    signals = Signals(run.recording, run.epoch)
    x, r, u = (
        dict(zip((signals[f"lag/{s}"].t * 100).round(), signals[f"lag/{s}"].x, strict=True))
        for s in ("state/x/position", "reference/x/position", "command/u/effort")
    )
    assert list(u)[:40] == list(range(40))
    assert u[0] == 2.0 * (r[0] - x[0])  # before the first reference the controller cannot answer
    for k in range(1, 50):
        assert u[k] == 2.0 * (r[k - 1] - x[k])  # the late reference counts for the next tick


def test_with_a_longer_time_limit_the_late_reference_is_waited_for():
    late = {"/lag/reference": 7 * MS}
    rig = basic()
    run = SimulatedRig(rig, World(lambda topic, *_: late.get(topic, MS // 10)), "realtime", patience=0.8)
    run.run()
    assert run.adapters["gain"].drive.incomplete == 0
    signals = Signals(run.recording, run.epoch)
    assert np.array_equal(signals["lag/state/x/position"].x, Signals(in_process(rig))["lag/state/x/position"].x)


def send(run, topic, msgtype, data):
    node = next(iter(run.nodes.values()))
    for reader in node.world.readers:
        if reader.topic == topic and reader.msgtype == msgtype:
            reader.receive(data)


def test_a_stamp_from_the_future_is_refused_and_the_next_good_one_is_used():
    rig = basic(1.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime")
    world.match()
    world.run(run.epoch + 100 * MS)
    gain, ticks = run.adapters["gain"], run.adapters["gain"].ticks
    port = next(p for p in rig.clock.outputs if p.name == "state")
    for off, text in ((3600, "+3.6e+03 s from now"), (-3600, "-3.6e+03 s from now")):
        send(run, "/lag/state", port.msgtype, port.layout().encode(world.now + off * 1_000_000_000, (7.0, 7.0)))
        assert text in gain.inputs[0].last_refusal
    assert gain.inputs[0].refused == 2
    assert any("stamp is" in text for _, text in run.nodes["gain"].logs)
    world.run(run.epoch + 300 * MS)
    assert gain.ticks == ticks + 20
    run.run()
    assert np.array_equal(
        Signals(run.recording, run.epoch)["lag/state/x/position"].x, Signals(in_process(rig))["lag/state/x/position"].x
    )


def test_a_rejected_measurement_is_answered_at_its_tick_by_the_previous_command():
    rig = basic(1.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime", without=("plant",))
    world.match()
    port = next(p for p in rig.clock.outputs if p.name == "state")
    world.run(run.epoch - 1)
    for k in range(10):
        world.run(run.epoch + k * 10 * MS + MS)
        data = port.layout().encode(run.epoch + k * 10 * MS, (float("nan") if k == 6 else float(k), 0.0))
        send(run, "/lag/state", port.msgtype, data)
    world.run(run.epoch + 99 * MS)
    u = Signals(run.recording, run.epoch)["lag/command/u/effort"].x
    assert list(u) == pytest.approx([2.0 * (0.01 * k - k) for k in (0, 1, 2, 3, 4, 5, 5, 7, 8, 9)])


@pytest.mark.parametrize(
    ("x", "reported"),
    [
        (1e300, "x/position is 1e+300 m, expected at most 1e+09 in magnitude"),
        (1e4, "OverflowError: math range error"),
    ],
)
def test_absurd_numbers_are_rejected_and_an_overflow_gives_the_safe_output(x, reported):
    """The controller takes the exponential of its input: plausible values overflow, too."""

    class Exponential(Block):
        INPUTS = (STATE,)
        OUTPUTS = (COMMAND,)

        def update(self, x, t, state):
            return x, {"command": (math.exp(state[0]),)}

    rig = Rig.from_blocks({"plant": Lag(), "law": Exponential()}, 1.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime", without=("plant",))
    world.match()
    world.run(run.epoch - 1)
    for k in range(10):
        world.run(run.epoch + k * 10 * MS + MS)
        send(
            run,
            "/lag/state",
            STATE.msgtype,
            STATE.layout().encode(run.epoch + k * 10 * MS, (x if k == 5 else 0.0, 0.0)),
        )
    world.run(run.epoch + 99 * MS)
    law = run.adapters["law"]
    messages = [law.inputs[0].last_refusal, *(text for _, text, _ in law.step.reports.values())]
    assert any(reported in text for text in messages)
    u = Signals(run.recording, run.epoch)["lag/command/u/effort"].x
    assert list(u) == [1.0] * 5 + [1.0 if x > 1e9 else 0.0] + [1.0] * 4
    assert law.state == "running"


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_publisher_with_another_type_is_named_and_not_taken_for_the_expected_one(mode):
    nodes = BASIC | {"gain": {"executable": "gain", "external": True}}
    world = World()
    run = SimulatedRig(rig_of(make_scenario(nodes, 0.1)), world, mode, departs=True, start_timeout=0.0)
    SimulatedNode(world, "stranger", {}).publisher("lag/command", "std_msgs/msg/Float64", lambda count: None)
    world.match()
    world.run(world.now + 3000 * MS)
    plant = run.adapters["plant"]
    text = "lag/command exists with type std_msgs/msg/Float64, expected sensor_msgs/msg/JointState"
    assert [t for _, t in run.nodes["plant"].logs] == [text]
    assert plant.step.reports["type of lag/command"] == (2, text, 1)
    assert plant.lacking == ["lag/command"]
    assert plant.state == "starting"


def test_a_node_whose_senders_have_ended_ends_too():
    run = SimulatedRig(basic(0.5), World(), "realtime", without=("plant",))
    assert run.run(5.0)["gain"] == "done"


@pytest.mark.parametrize("shared", [False, True])
def test_a_node_that_is_stopped_over_the_end_of_a_run_publishes_its_last_tick_and_none_after_it(shared):
    rig = basic(0.25)
    run = SimulatedRig(rig, World(), "realtime", groups=[list(BASIC)] if shared else ())
    run.world.match()
    run.world.run(run.epoch + 100 * MS)
    for node in run.nodes.values():
        node.stalled = run.epoch + 900 * MS
    assert set(run.run().values()) == {"done"}
    text = run.recording.topics["lag/state"].times
    assert (text[-2] - run.epoch, text[-1] - run.epoch) == (100 * MS, rig.end)
    assert all(t <= run.epoch + rig.end for topic in run.recording.topics.values() for t in topic.times)


def test_a_ready_node_reports_it_ten_times_a_second_until_the_start_once_all_its_peers_are_there():
    world = World()
    run = SimulatedRig(basic(), world, "realtime", departs=True)
    departures = {name: adapter.drive.departure for name, adapter in run.adapters.items()}
    (starter,) = (name for name, d in departures.items() if d.is_starter)
    begun, send, messages = world.now, world.send, {name: [] for name in departures}

    def noted(writer, data):
        if writer.topic == "/softrig/ready":
            messages[writer.node.name].append((world.now - begun) // MS)
        send(writer, data)

    world.send = noted
    for name, d in departures.items():
        until = begun + (2_000 if name == starter else 1_000) * MS
        d.handshake.absent = lambda until=until: [] if world.now >= until else ["somebody"]
    world.match()
    world.run(begun + 1_900 * MS)
    assert not any(d.absent for name, d in departures.items() if name != starter)
    world.run(begun + 2_400 * MS)
    often = [*range(1_000, 2_001, 100)]  # repeated at each fifth check, and checks are 20 ms apart
    assert messages == {name: [] if name == starter else often for name in departures}


def test_a_controller_notices_a_source_that_has_stopped():
    rig = basic(2.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime", without=("source",))
    source = SimulatedRig(basic(0.5), world, "realtime", without=("plant", "gain"))
    assert source.epoch == run.epoch
    run.run()
    reports = run.adapters["gain"].step.reports
    assert "no message on lag/reference for 0.05 s: the last one is held" in reports["stale lag/reference"][1]
    assert run.adapters["gain"].ticks > 190


@pytest.mark.parametrize("name", RIGS)
def test_the_ports_of_the_rigs_work_in_lockstep_in_any_order_of_delivery(name):
    nodes, duration, options = RIGS[name]
    rig = rig_of(make_scenario(nodes, duration, **options))
    expected = in_process(rig)
    for seed in range(20):
        run = SimulatedRig(rig, World(jitter(seed, 1_000, 5 * MS)), "lockstep", groups=some(rig, random.Random(seed)))
        assert set(run.run(1000.0).values()) == {"done"}, (seed, {n: str(a.error) for n, a in run.adapters.items()})
        assert differences(expected, run.recording) == [], seed


@pytest.mark.parametrize("name", ["arrays", "events"])
def test_a_repeated_acknowledgement_of_a_sporadic_sender_counts_once(name):
    """Its messages are counted (arrays) or have the stamp of their tick (events)."""
    nodes, duration, options = RIGS[name]
    rig = rig_of(make_scenario(nodes, duration, **options))
    world = World()
    run = SimulatedRig(rig, world, "lockstep")
    ticks = [reader for reader in world.readers if reader.topic.endswith("/tick")]
    for reader in ticks:
        reader.receive = lambda data, receive=reader.receive: (receive(data), receive(data))
    assert ticks
    assert set(run.run().values()) == {"done"}, {n: str(a.error) for n, a in run.adapters.items()}
    assert differences(in_process(rig), run.recording) == []


def test_a_plant_waits_for_a_good_command_also_if_commands_have_no_stamp():
    force = array("force", "lag/force", {"u": 1}, "N")

    class Pushed(Lag):
        INPUTS = (force,)

        def advance(self, x, t, force):
            return super().advance(x, t, force, None, None)

    class Push(Block):
        INPUTS = (STATE,)
        OUTPUTS = (force,)

        def update(self, x, t, state):
            return x, {"force": (1.0 - state[0],)}

    rig = Rig.from_blocks({"plant": Pushed(), "law": Push()}, 0.2)
    world = World()
    run = SimulatedRig(rig, world, "lockstep")
    world.match()
    world.run(world.now + 3000 * MS, lambda: run.adapters["plant"].t >= 50 * MS)
    send(run, "/lag/force", force.msgtype, force.layout().encode(0, (math.nan,)))
    assert set(run.run().values()) == {"done"}
    assert run.adapters["plant"].inputs[0].refused == 1
    assert differences(in_process(rig), run.recording) == []


def test_malformed_clocks_and_ticks_are_counted_and_do_no_harm():
    rig = basic(0.2, watcher="watcher")
    world = World()
    run = SimulatedRig(rig, world, "lockstep")
    world.match()
    world.run(world.now + 30 * MS, lambda: run.adapters["plant"].t > 50 * MS)
    send(run, "/clock", "rosgraph_msgs/msg/Clock", b"\0\1\0\0\1")
    send(run, "/watcher/tick", "std_msgs/msg/Header", b"\0\1\0\0\1\2\3")
    run.run()
    assert differences(in_process(rig), run.recording) == []
    refused = [i.refused for name in ("source", "plant") for i in run.adapters[name].paces]
    assert refused == [1, 1]


@pytest.mark.parametrize("step", [-3600, 0, 2, 3600])
def test_a_restarted_node_rejoins_also_after_the_clock_was_set(step):
    rig = basic(4.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime", departs=True)
    world.match()
    world.run(world.now + 2000 * MS)
    first = run.adapters["gain"]
    assert first.ticks > 100
    run.nodes["gain"].dead = world.now
    for ends in (world.writers, world.readers):
        ends[:] = [end for end in ends if end.node is not run.nodes["gain"]]
    member = next(m for m in rig.members if m.name == "gain")
    run._start([member], "realtime", 0, {"epoch": 0})
    run.nodes["gain"].ahead = step * SECOND
    world.match()
    assert set(run.run().values()) == {"done"}
    again = run.adapters["gain"]
    assert again is not first
    assert again.ticks > 150
    assert not any(i.refused for a in run.adapters.values() for i in a.inputs)
    assert ("clock" in again.step.reports) == (step != 0)
    assert not any("stale" in key for key in run.adapters["source"].step.reports)


def test_the_newest_of_reordered_commands_is_used_and_the_others_are_counted():
    """Three commands at a time, by a controller with stamps of its own, in reverse; and each one twice."""
    rig = basic(1.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime", without=("gain",))
    world.match()
    plant, layout = run.adapters["plant"], COMMAND.layout()
    for k in range(1, 40):
        world.run(run.epoch + k * 20 * MS)
        for j in (2, 2, 1, 0):
            send(
                run,
                "/lag/command",
                COMMAND.msgtype,
                layout.encode(world.now - (2 - j) * MS, (float(10 * k + j) / 100,)),
            )
        row = next(r for r in plant.drive.senders.rows if r.name == "command")
        assert row.recent[-1][1] == (float(10 * k + 2) / 100,)
    assert plant.inputs[0].late == 3 * 39
    assert plant.drive.statistics()["late_messages"] == 3 * 39


@pytest.fixture
def beside_a_dead_law():
    """A plant whose controller was killed 2 s ago and is still matched, and another in its place; publishes and
    reports.
    """
    world = World()
    run = SimulatedRig(basic(60.0), world, "realtime", without=("gain", "source"))
    laws = [SimulatedNode(world, name, {}) for name in ("gain", "again")]
    say = [law.publisher("lag/command", COMMAND.msgtype, lambda count: None) for law in laws]
    layout, row = COMMAND.layout(), run.adapters["plant"].inputs[0]
    world.match()
    row.matched(1)

    def speak(node, until, every=10):
        """Commands of one of the two until a time in ms, with its number each; returns the newest one that the plant
        has.
        """
        for t in range(world.now, run.epoch + until * MS, every * MS):
            world.run(t)
            world.now = t
            say[node](layout.encode(t, (float(node + 1),)))
        world.run(world.now + MS)
        return run.adapters["plant"].values["command"] if row.arrived is not None else None

    world.run(run.epoch)
    assert speak(0, 1000, every=2) == (1.0,)
    world.run(run.epoch + 3000 * MS)
    world.match()  # the second publisher is discovered before the loss of the first is reported
    assert row.publishers == 2
    return run, speak


def test_the_replacement_of_a_killed_controller_is_accepted_after_a_long_silence_of_the_first(beside_a_dead_law):
    run, speak = beside_a_dead_law
    row = run.adapters["plant"].inputs[0]
    assert speak(1, 3990) is None
    assert row.last_refusal == "2 publishers at the same time (again, gain), expected one"
    assert speak(1, 4050) == (2.0,)
    text = "of 2 publishers only one has published for 1 s: accepted"
    assert run.adapters["plant"].step.reports["rivals lag/command"][1:] == (text, 1)
    refused = row.refused
    row.matched(1)  # the lease of the first publisher has expired
    run.adapters["plant"].drive.on_matched(row)
    assert (speak(1, 6000), row.refused) == ((2.0,), refused)


# Before the new publisher is accepted, and with fewer or more messages than the dead one.
@pytest.mark.parametrize("at", [3500, 4500, 9000])
def test_neither_of_two_publishing_controllers_is_ever_accepted(beside_a_dead_law, at):
    """The first one was stopped, not killed: at its first message the other one is no longer accepted, either."""
    run, speak = beside_a_dead_law
    row = run.adapters["plant"].inputs[0]
    speak(1, at)
    assert row.disputed == (at < 4000)
    newest = row.recent[-1]
    speak(0, at + 1)
    assert row.recent[-1] == newest, "its command counts for nothing"
    speak(1, at + 20_000)
    assert row.disputed, "two have been heard"
    assert row.recent[-1] == newest


def test_a_controller_far_behind_drops_messages_older_than_the_window_and_reports_it():
    rig = basic(10.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime")
    world.match()
    world.run(run.epoch + 500 * MS)
    gain = run.adapters["gain"]
    for reader in [r for r in world.readers if r.node.name == "gain" and r.topic == "/lag/reference"]:
        accept = reader.receive
        reader.receive = lambda data: None  # the message never arrives, so the tick waits
    gain.drive._answering._patience = 3600 * SECOND
    world.run(world.now + 30 * MS)
    gain.drive._answering._deadline.cancel()
    world.run(world.now + 3000 * MS)
    before = gain.ticks
    gain.drive._answering._patience = 8 * MS
    for reader in [r for r in world.readers if r.node.name == "gain" and r.topic == "/lag/reference"]:
        reader.receive = accept
    gain.drive._answering._deadline.again(8 * MS)
    world.run(world.now + 1000 * MS)
    stamps = [t - run.epoch for t in run.recording.topics["lag/command"].times][before:]
    assert stamps[0] >= world.now - run.epoch - 2000 * MS
    assert stamps[-1] > world.now - run.epoch - 30 * MS
    dropped = gain.drive.statistics()["dropped_ticks"]
    assert dropped > 190
    assert gain.step.reports["dropped"][1] == f"{dropped} ticks dropped: the controller is too slow, or was stopped"
    assert gain.drive.missed >= dropped


def test_a_plant_without_commands_reports_it_repeatedly():
    rig = basic(60.0)
    world = World()
    run = SimulatedRig(rig, world, "realtime", without=("source",))
    world.match()
    command = COMMAND.layout().encode
    world.run(run.epoch + 100 * MS)
    send(run, "/lag/command", COMMAND.msgtype, command(world.now, (1.0,)))
    world.run(run.epoch + 35 * SECOND)
    messages = [text for _, text in run.nodes["plant"].logs if text.startswith("no command on lag/command")]
    assert 3 <= len(messages) <= 5


@pytest.mark.long
def test_a_controller_that_receives_nothing_of_what_is_published_reports_it_repeatedly():
    """If the middleware has lost a reader, its node would otherwise wait silently."""
    world = World(lambda topic, *_: 25 * SECOND if topic == "/lag/reference" else MS // 10)
    run = SimulatedRig(basic(60.0), world, "realtime")
    world.match()
    world.run(run.epoch + 24 * SECOND)
    gain = run.adapters["gain"]
    messages = [text for _, text in run.nodes["gain"].logs if "has received nothing" in text]
    assert gain.ticks == 0
    assert messages == ["has received nothing on lag/reference for 10 s, though it is published"] * 2
    assert not any("has received nothing" in text for name in ("plant", "source") for _, text in run.nodes[name].logs)


def test_a_node_without_a_status_breaks_the_run_at_its_end():
    run = SimulatedRig(basic(0.1), World(jitter(1, 1_000, 20_000)), "realtime")
    run.adapters["gain"].step.block.void = lambda x: f"no answer after {x}"
    assert run.run() == {"plant": "done", "source": "done", "gain": "failed"}
    assert str(run.adapters["gain"].error).startswith("no answer after ")
