"""Real time on a container's exchange, with a clock in place of the machine's: nothing depends on speed."""

import json
import time
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import in_process, make_scenario
from faultrig import COMMAND, STATE, Lag
from simulated import _Sink
from softrig_core import Block, Recording, Rig, Signals, command, load_scenario, rig_of
from softrig_core.rig.options import RunOptions
from softrig_nodes import container as container_module
from softrig_nodes.adapter import account
from softrig_nodes.adapter.account import Account
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.container import Container
from softrig_nodes.group import Group
from softrig_nodes.processes.spawning import node_parameters
from softrig_nodes.realtime.answering import Answering
from softrig_nodes.realtime.live import Live
from softrig_nodes.ros import ros
from softrig_nodes.ros.contained import ContainedMiddleware
from softrig_nodes.ros.garbage import CLEAN, UNCLEAN, YOUNG, Garbage
from softrig_nodes.seam import exchange as exchange_module
from softrig_nodes.seam.exchange import Exchange
from softrig_nodes.seam.monitor import Monitor

SECOND = 1_000_000_000


class StandIn:
    """A clock that moves only when a thread waits; computation takes no time."""

    def __init__(self):
        self.t = time.monotonic_ns()

    def monotonic_ns(self):
        return self.t

    def time_ns(self):
        return self.t

    def monotonic(self):
        return self.t / 1e9


class PatientExchange(Exchange):
    """Waits by moving the clock."""

    def _wait(self, limit):
        clock = exchange_module.time
        clock.t = max(clock.t, limit) + 1


class Contained:
    """All nodes of a rig on one exchange, without ROS: `carried` gets the messages for other processes, by topic."""

    def __init__(self, rig, monkeypatch, seed=0):
        self.clock = StandIn()
        self.exchange = PatientExchange()
        self.carried, self.logs = {}, []
        monkeypatch.setattr(exchange_module, "time", self.clock)
        monkeypatch.setattr(ros, "time", self.clock)
        # Functions that return the number of matched endpoints in other processes, by topic.
        self.readers, self.writers = {}, {}
        self.receivers = {}

        def publisher(middleware, topic, msgtype, matched):
            name = middleware.resolve(topic)
            self.readers[name] = matched
            return self.carried.setdefault(name, []).append

        def subscribe(middleware, topic, msgtype, reader):
            self.writers[middleware.name, middleware.resolve(topic)] = reader.matched
            self.receivers[middleware.name, middleware.resolve(topic)] = reader.receive

        monkeypatch.setattr(ros.RosMiddleware, "publisher", publisher)
        monkeypatch.setattr(ros.RosMiddleware, "subscribe", subscribe)
        monkeypatch.setattr(ros.RosMiddleware, "log", lambda m, level, text: self.logs.append(text))
        monkeypatch.setattr(ros.RosMiddleware, "topics", lambda m: {})
        monkeypatch.setattr(ros.RosMiddleware, "publishers", lambda m, topic: [])
        self.recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
        slowest = max((m.schedule for m in rig.members), key=lambda s: s.period)
        self.epoch = slowest.held(self.clock.t + SECOND)
        self.adapters = {m.name: self._adapter(rig, m, seed) for m in rig.members}
        Group(list(self.adapters.values()))

    def _adapter(self, rig, member, seed):
        def resolve(topic):
            topic = member.remap.get(topic, topic).replace("~", f"/{member.name}")
            return topic if topic.startswith("/") else f"/{topic}"

        node = SimpleNamespace(get_name=lambda: member.name, get_fully_qualified_name=lambda: f"/{member.name}",
                               resolve_topic_name=resolve, monitor=Monitor(lambda: None), _parameter_overrides={},
                               serve_by=lambda timer: None)  # fmt: skip
        parameters = {
            k.removeprefix("run."): v
            for k, v in node_parameters(rig, member, seed, "realtime").items()
            if k.startswith("run.")
        } | {"epoch": self.epoch}
        sink = _Sink.__new__(_Sink)
        adapter = Adapter(ContainedMiddleware(node, self.exchange), member.block(seed), RunOptions(**parameters), sink)
        sink.__init__(self.recording, adapter.record.topics)
        return adapter

    def run(self, until=1 << 62):
        while self.clock.t < until and any(a.state == "running" for a in self.adapters.values()):
            remaining = self.exchange.serve(min(until, self.clock.t + SECOND // 10), awake=SECOND)
            self.clock.t += max(1, remaining)
        return {a.state for a in self.adapters.values()}

    def numbers(self):
        return Signals(self.recording, self.epoch)


def shortened(name, duration):
    return rig_of(load_scenario(name).changed(duration=duration))


@pytest.mark.parametrize(
    ("name", "duration"),
    [
        ("induction_dtc", 0.03),
        ("dc_motor_smc_b2", 0.3),
        ("rehab_impedance", 0.1),
        pytest.param("lsrm_fuzzy", 0.02, marks=pytest.mark.long),
    ],
)
def test_messages_that_a_node_publishes_together_give_the_numbers_of_lockstep(name, duration, monkeypatch):
    rig = shortened(name, duration)
    expected = Signals(in_process(rig))
    run = Contained(rig, monkeypatch)
    assert run.run() == {"done"}
    result = run.numbers()
    for member in rig.members:
        adapter = run.adapters[member.name]
        assert adapter.drive.missed == adapter.drive.incomplete == 0, member.name
        assert not adapter.drive.senders.stale, member.name
        for port in member.outputs:
            for label in port.labels if not port.held else ():
                a, b = expected[f"{port.topic}/{label}"], result[f"{port.topic}/{label}"]
                n = min(len(a.x), len(b.x))
                assert n >= len(a.x) - 1
                assert np.array_equal(a.x[:n], b.x[:n]), f"{port.topic}/{label}"


def test_a_held_input_published_together_with_an_awaited_one_belongs_to_the_same_tick(monkeypatch):
    extra = command("extra", "lag/extra", ("u",), "N", held=True)

    class Both(Lag):
        OUTPUTS = (STATE, extra)

        def outputs(self, x, t):
            return {"state": super().outputs(x, t)["state"], "extra": (t * 1e-9,)}

    class Law(Block):
        INPUTS = (STATE, extra)
        OUTPUTS = (COMMAND,)

        def update(self, x, t, state, extra):
            return x, {"command": extra}

    run = Contained(Rig.from_blocks({"plant": Both(), "law": Law()}, 0.5), monkeypatch)
    assert run.run() == {"done"}
    u = run.numbers()["lag/command/u/effort"]
    assert len(u.x) >= 50
    assert list(u.x) == [k * 10_000_000 * 1e-9 for k in range(len(u.x))]


@pytest.mark.parametrize(
    ("held", "missed", "without", "used"),
    [
        pytest.param(30_000_000, (0, 0), (), {}, id="a bit late: as if it were in time"),
        pytest.param(70_000_000, (6, 1), (0.12,), {0.15: 0.10}, id="too late to say all of it"),
    ],
)
def test_a_late_node_answers_with_the_messages_published_by_its_tick(held, missed, without, used, monkeypatch):
    """Some ticks of the plant are skipped, and with them one or two of the controller."""
    extra = command("extra", "lag/extra", ("u",), "N")

    class Both(Lag):
        OUTPUTS = (STATE, extra)

        def outputs(self, x, t):
            return {"state": super().outputs(x, t)["state"], "extra": (t * 1e-9,)}

    class Slow(Block):
        INPUTS = (extra,)
        OUTPUTS = (COMMAND,)

        def update(self, x, t, extra):
            return x, {"command": extra}

    run = Contained(Rig.from_blocks({"plant": Both(), "law": Slow(Slow.Params(period=0.03))}, 0.3), monkeypatch)
    run.run(run.epoch + 105_000_000)
    plant, law = run.adapters["plant"], run.adapters["law"]
    plant.drive._lateness = deque(maxlen=3)  # few values are kept, but the largest is that of all ticks
    run.clock.t += held
    assert run.run() == {"done"}
    assert (plant.drive.missed, law.drive.missed) == missed
    assert plant.drive.statistics()["lateness_max_ms"] >= 5.0
    result = run.numbers()["lag/command/u/effort"]
    assert [round(t, 3) for t in result.t] == [t for k in range(11) if (t := round(0.03 * k, 3)) not in without]
    assert list(result.x) == pytest.approx([used.get(round(t, 3), t) for t in result.t])


@pytest.mark.parametrize(("periods", "missed", "late"), [(6, 0, 5), (12, 11, 0)])
def test_a_controller_that_was_slow_once_does_not_count_as_silent(periods, missed, late, monkeypatch):
    """Its command arrives after more periods of the plant than a timeout has; a few of them are published late."""
    slow = []

    class Slow(Block):
        INPUTS = (STATE,)
        OUTPUTS = (COMMAND,)

        def update(self, x, t, state):
            if t == 100_000_000:
                slow.append(t)
                run.clock.t += periods * 10_000_000
            return x, {"command": (1.0,)}

    run = Contained(Rig.from_blocks({"plant": Lag(), "law": Slow()}, 0.3), monkeypatch)
    assert run.run() == {"done"}
    plant = run.adapters["plant"]
    assert (len(slow), plant.drive.missed, list(plant.step.reports)) == (1, missed, [])
    assert plant.drive.statistics().get("late_ticks", 0) == late


def test_messages_with_an_external_subscriber_are_also_sent(monkeypatch):
    run = Contained(shortened("induction_dtc", 0.02), monkeypatch)
    run.readers["/currents_meas"](1)
    run.run()
    recorded = run.recording.topics["currents_meas"].data
    assert len(recorded) > 390
    assert run.carried["/currents_meas"] == recorded
    assert not any(data for topic, data in run.carried.items() if topic != "/currents_meas")


def test_neither_of_two_writers_is_accepted_until_one_has_left(monkeypatch):
    run = Contained(shortened("induction_dtc", 0.05), monkeypatch)
    controller = run.adapters["dtc_controller"]
    item = next(i for i in controller.inputs if i.name == "currents_meas")
    run.run(run.epoch + SECOND // 100)
    assert controller.ticks > 190
    tell = run.writers["dtc_controller", "/currents_meas"]
    tell(1)
    before = run.adapters["im_plant"].ticks
    run.run(run.epoch + SECOND // 50)
    during = run.adapters["im_plant"].ticks - before
    assert item.refused == during + 1  # plus the message at which the publisher changed
    assert "2 publishers at the same time" in item.last_refusal
    tell(0)
    refused, ticks = item.refused, controller.ticks
    run.run(run.epoch + 3 * SECOND // 100)
    assert item.refused <= refused + 1
    assert controller.ticks > ticks + 190


def test_a_message_that_fails_is_answered_by_the_previous_one_and_its_neighbours_are_used(monkeypatch):
    rig = rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 1.0))
    run = Contained(rig, monkeypatch)
    run.run(run.epoch + SECOND // 10)
    gain = run.adapters["gain"]
    ticks = gain.ticks
    stamp = run.epoch + SECOND // 10
    port = next(p for p in rig.clock.outputs if p.name == "state")
    run.receivers["gain", "/lag/state"](port.layout().encode(stamp + 3600 * SECOND, (7.0, 7.0)))
    run.run(run.epoch + 2 * SECOND // 10)
    assert gain.inputs[0].refused == 1
    assert "from now" in gain.inputs[0].last_refusal
    assert gain.ticks == ticks + 10
    assert gain.drive.missed == gain.drive.incomplete == 0


# what keeps a loop from its ticks ----------------------------------------------------------------------------------


class Collector:
    """Stands in for `gc`: reports what the test sets."""

    def __init__(self):
        self.garbage_found, self.searches, self.frozen = 0, 0, 0

    def collect(self, generation=2):
        self.searches += generation == 0
        return self.garbage_found

    def freeze(self):
        self.frozen += 1

    def set_threshold(self, number):
        self.threshold = number


def test_the_garbage_collector_runs_rarely_while_it_finds_nothing_and_as_usual_otherwise():
    collector = Collector()
    garbage = Garbage(collector)
    assert collector.threshold == YOUNG
    for _ in range(UNCLEAN - 1):
        garbage.step()
    assert (collector.searches, collector.frozen) == (0, 1)  # at first no search is made, as the load is unknown
    for _ in range(CLEAN):
        garbage.step()
    assert (collector.searches, collector.frozen) == (1, 1 + CLEAN)
    collector.garbage_found = 1
    garbage.step()
    assert (collector.searches, collector.frozen) == (2, 1 + CLEAN)
    for _ in range(3 * UNCLEAN):
        garbage.step()
    assert (collector.searches, collector.frozen) == (5, 1 + CLEAN)


def test_a_status_is_complete_while_it_is_changed_in_place(tmp_path, monkeypatch):
    run = Contained(shortened("induction_dtc", 0.02), monkeypatch)
    plant = run.adapters["im_plant"]
    path = tmp_path / "im_plant.status"
    object.__setattr__(plant.options, "status", str(path))
    plant.account = Account(plant)
    plant.account.write_status()
    number, before = path.stat().st_ino, json.loads(path.read_text())
    plant.error, plant.step.t = RuntimeError("x" * 3000), 7
    plant.account.write_status()  # longer than the content before
    assert json.loads(path.read_text())["error"] == "x" * 3000
    plant.error = None
    plant.account.write_status()  # shorter than the content before
    assert json.loads(path.read_text()) == before | {"t": 7, "cpu_s": json.loads(path.read_text())["cpu_s"]}
    assert path.stat().st_ino == number
    plant.state, worked = "done", []
    monkeypatch.setattr(account, "figures", lambda step: worked.append(step) or {"figures": {"a": [1.0, ""]}})
    for _ in range(3):
        plant.account.write_status()
    assert path.stat().st_ino != number
    assert json.loads(path.read_text())["missed_deadlines"] == 0
    assert json.loads(path.read_text())["figures"] == {"a": [1.0, ""]}
    assert len(worked) == 1, "figures of a long run take a second"


@pytest.mark.parametrize("states", [("failed", "done"), ("done", "done"), ("failed", "failed")])
def test_a_container_whose_nodes_have_all_ended_does_not_wait(monkeypatch, states):
    """The container waits a second after a failure only if another node still runs."""
    asked, now = [], time.monotonic_ns()
    monkeypatch.setattr(container_module.rclpy, "ok", lambda: True)
    container = object.__new__(Container)
    container.exchange = SimpleNamespace(serve=lambda until, awake: asked.append((until, awake)), listens=False)
    container.adapters = [SimpleNamespace(state=state) for state in states]
    assert container._loop(SimpleNamespace(spin_once=lambda _: pytest.fail("it went on")))
    ((until, awake),) = asked
    assert until > now + container_module.LOOK - 1
    assert awake == container_module.SPIN  # the loop sleeps through a longer wait


def test_ticks_older_than_the_window_are_dropped_except_the_newest():
    """One that is exactly as old as the window is still answered."""
    answered, timer = [], SimpleNamespace(cancel=lambda: None, again=lambda _: None)
    node = SimpleNamespace(
        schedule=SimpleNamespace(time=lambda k: 10 * k, next=lambda t: t // 10 * 10 + 10, tick=lambda t: t // 10),
        options=SimpleNamespace(patience=0.5),
        middleware=SimpleNamespace(timer=lambda *_: timer),
        block=SimpleNamespace(),
        step=SimpleNamespace(note=lambda *_: None),
        epoch=0,
        state="running",
    )
    table = SimpleNamespace(node=node, rows=[], clock=lambda: 100, window=50, grid_time=lambda due: due)
    answering, row = Answering(table, answered.append), SimpleNamespace(awaited=True)
    for stamps, kept in (((40, 50, 60), [50, 60]), ((70, 80), [70, 80])):
        answered.clear()
        for stamp in stamps:
            answering.process(row, stamp, stamp, None, stamp)
        answering.act()
        assert answered == kept
    table.clock, answered[:] = lambda: 1000, []
    for stamp in (90, 100):
        answering.process(row, stamp, stamp, None, stamp)
    answering.act()
    assert (answered, answering.dropped) == ([100], 2)


def test_a_controller_started_alone_begins_with_the_tick_of_its_first_message():
    node = SimpleNamespace(epoch=0, is_plant=False, schedule=SimpleNamespace(held=lambda stamp: stamp // 10 * 10))
    row = object.__new__(Live)
    row.node, row.port, row.table = node, SimpleNamespace(stamped=True, held=False), SimpleNamespace(clock=lambda: 130)
    row.by_arrival, row.paired, row._number = False, False, None
    row.value, row._keep = (lambda stamp, result: result), (lambda *_: None)
    for stamp in (123, 135):  # only the first message sets the start
        row.accept(stamp, (1.0,), b"")
        assert node.epoch == 120
