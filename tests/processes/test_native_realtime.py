"""Native ticks in real time: the numbers of lockstep, every message in order, and Python where it is needed."""

import ctypes
import time
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import in_process
from softrig_core import Recording, Signals, load_scenario, rig_of
from softrig_core.kit.jit import our_numba
from softrig_core.rig.options import RunOptions
from softrig_core.wire.parameter_event import TOPIC as EVENTS
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.below import _ticking
from softrig_nodes.below.carrier import _PUBLISH, SLOTS, Carrier
from softrig_nodes.group import Group
from softrig_nodes.processes.spawning import node_parameters
from softrig_nodes.realtime import beat, native, realtime
from softrig_nodes.ros import ros
from softrig_nodes.ros.contained import ContainedMiddleware
from softrig_nodes.seam.exchange import Exchange
from softrig_nodes.seam.monitor import Monitor

SECOND = 1_000_000_000
STATE, COMMAND = "motor/state", "motor/command"
SCENARIO = load_scenario("dc_motor_smc").changed(duration=0.6)


def changed(*changes):
    entries = [{"at": at, "set": {"dc_motor_smc.delta": delta}} for at, delta in changes]
    return SCENARIO.having(changes=entries)


class Ticking:
    """The nodes of `dc_motor_smc` in one process, against the wall clock; what the carrier publishes is in `carried`.

    However late a loaded machine is, no tick is skipped.
    """

    def __init__(self, folder, monkeypatch, scenario=SCENARIO):
        monkeypatch.setattr(native, "SHARE", 0.0)
        monkeypatch.setattr(native, "CATCH_UP", 1 << 50)
        monkeypatch.setattr(beat, "BEHIND", 1 << 50)
        monkeypatch.setattr(realtime, "END_GRACE", 1 << 50)
        self.rig = rig_of(scenario)
        self.folder, self.carried, self.matched = folder, {}, {}

        def publish(publisher, message, allocation):
            given = message.contents
            self.carried[publisher].append(ctypes.string_at(given.buffer, given.length))
            return 0

        self.carrier = Carrier(_PUBLISH(publish))
        self.carrier.start()

        def publisher(middleware, topic, msgtype, matched):
            name = middleware.resolve(topic)
            self.carrier.handles[name] = handle = len(self.carried) + 1
            self.matched[name], self.carried[handle] = matched, []
            return lambda data: self.carrier.put(handle, data)

        for name, instead in (
            ("publisher", publisher),
            ("subscribe", lambda *_: None),
            ("log", lambda *_: None),
            ("topics", lambda m: {}),
        ):
            monkeypatch.setattr(ros.RosMiddleware, name, instead)
        self.exchange, prepare = Exchange(), native.Native.prepare

        def prepare_and_start(made):
            self.ticking = made
            prepare(made)  # compiling may take seconds
            self.epoch = (time.time_ns() // SECOND + 1) * SECOND
            for drive in made._drives:
                drive.node.epoch = self.epoch

        monkeypatch.setattr(native.Native, "prepare", prepare_and_start)
        self.adapters = {m.name: self._adapter(m) for m in self.rig.members}
        Group([*self.adapters.values()])
        self.plant, self.law = self.adapters["dc_motor_plant"], self.adapters["dc_motor_smc"]

    def _adapter(self, member):
        def resolve(topic):
            topic = member.remap.get(topic, topic).replace("~", f"/{member.name}")
            return topic if topic.startswith("/") else f"/{topic}"

        node = SimpleNamespace(
            get_name=lambda: member.name,
            get_fully_qualified_name=lambda: f"/{member.name}",
            resolve_topic_name=resolve,
            monitor=Monitor(lambda: None),
            _parameter_overrides={},
            serve_by=lambda timer: None,
        )
        given = node_parameters(self.rig, member, 0, "realtime")
        options = {k.removeprefix("run."): v for k, v in given.items() if k.startswith("run.")}
        options |= {"epoch": SECOND, "shard": str(self.folder / f"{member.name}.shard")}
        return Adapter(ContainedMiddleware(node, self.exchange, self.carrier), member.block(0), RunOptions(**options))

    def on(self, ticks=1 << 40):
        """Run to a number of ticks of the plant, or to the end."""
        limit = time.monotonic() + 60.0
        while self.plant.ticks < ticks and any(a.state == "running" for a in self.adapters.values()):
            rest = self.exchange.serve(time.monotonic_ns() + SECOND // 100)
            time.sleep(min(max(rest, 0), SECOND // 500) / SECOND)
            assert time.monotonic() < limit

    def result(self):
        """The recordings after the run, all messages of which are published."""
        assert {(a.state, a.error) for a in self.adapters.values()} == {("done", None)}
        self.carrier.drain()
        self.carrier.put(0, b"")  # an empty message ends the thread
        recording = Recording((t, p.msgtype) for t, p in self.rig.topics.items())
        for name, adapter in self.adapters.items():
            adapter.record.shard.close()
            recording.read_shard(self.folder / f"{name}.shard")
        return recording

    def has_the_numbers_of(self, rig):
        recording = self.result()
        expected, found = Signals(in_process(rig)), Signals(recording, self.epoch)
        assert expected.keys() <= found.keys()
        for name, (t, x) in expected.items():
            n = len(x)
            assert np.array_equal(found[name].x[:n], x, equal_nan=True), name
            assert np.array_equal(found[name].t[:n], t), name
        return recording

    def native(self):
        return self.plant.step.native[0]


def test_ticks_are_native_with_the_numbers_of_lockstep_and_a_subscriber_receives_each_message(tmp_path, monkeypatch):
    run = Ticking(tmp_path, monkeypatch)
    run.matched[f"/{STATE}"](1)
    run.on(500)
    run.matched[f"/{COMMAND}"](1)
    run.on(2500)
    run.matched[f"/{STATE}"](0)
    before = run.plant.ticks
    run.on()
    topics = run.has_the_numbers_of(run.rig).topics
    data = topics[STATE].data
    first, second = (run.carried[run.carrier.handles[f"/{topic}"]] for topic in (STATE, COMMAND))
    assert first == data[: len(first)]
    assert len(first) >= before
    assert second == topics[COMMAND].data[-len(second) :]
    assert second
    assert [sent for sent in run.carried.values() if sent] == [first, second]
    statistics = run.plant.drive.statistics()
    assert statistics["native"][0] > 5000
    assert statistics["missed_deadlines"] == 0
    assert run.plant.ticks == run.law.ticks == len(data)
    assert run.adapters["dc_motor_metrics"].ticks == len(data)
    assert 0.0 <= statistics["lateness_p50_ms"] <= statistics["lateness_max_ms"]
    assert len(run.plant.drive._round_trip) == 5000  # only the newest are kept
    # The observer has seen all messages.
    assert run.adapters["dc_motor_metrics"].account.status()["figures"]


def test_changes_of_parameters_and_reads_of_the_state_end_native_ticks_at_the_next_one(tmp_path, monkeypatch):
    run = Ticking(tmp_path, monkeypatch, changed((0.55, 0.7)))
    run.on(500)
    run.law.step.set({"delta": 0.5})
    set_at = run.plant.ticks
    run.on(set_at + 1)
    run.plant.step.health()
    assert run.law.step.params.delta == 0.5
    assert run.plant.step.t == run.plant.schedule.time(run.plant.ticks - 1)
    run.on()
    recording = run.result()
    first, second = (t - run.epoch for t in recording.topics[EVENTS].times)
    assert second == 550_000_000
    assert first >= run.plant.schedule.time(set_at)
    expected = Signals(in_process(rig_of(changed((first / 1e9, 0.5), (0.55, 0.7)))))
    found = Signals(recording, run.epoch)
    for name, (_, x) in expected.items():
        assert np.array_equal(found[name].x[: len(x)], x), name
    assert run.native() > 4000


def test_no_native_tick_runs_while_the_clock_stands(tmp_path, monkeypatch):
    run = Ticking(tmp_path, monkeypatch)
    while not run.ticking.active:
        run.on(run.plant.ticks + 1)

    def stops(until):
        for adapter in run.adapters.values():
            adapter.drive._stand.receive(["ahead=0", "from=0", f"until={until}"])

    stops(run.epoch + 1000 * SECOND)
    # A loaded host may not run Python's thread before the stop, and native code would not notice it.
    assert not run.ticking.active
    stop = run.epoch + run.plant.schedule.time(run.plant.ticks) + SECOND // 10
    stops(stop)
    while time.time_ns() < stop + SECOND // 10:
        time.sleep(0.001)
    limit = time.monotonic() + 60.0
    while run.epoch + run.plant.t <= stop - SECOND // 1000:
        run.exchange.serve(time.monotonic_ns() + SECOND // 100)
        assert time.monotonic() < limit
    for _ in range(100):
        run.exchange.serve(time.monotonic_ns() + SECOND // 1000)
    assert run.epoch + run.plant.t <= stop
    ahead = stop - time.time_ns()
    for adapter in run.adapters.values():
        adapter.drive._stand.receive([f"ahead={ahead}", f"from={stop}", f"until={1 << 62}"])
        adapter.drive._stand._until = (1 << 63) - 1
    run.on()
    run.has_the_numbers_of(run.rig)
    assert run.native() > 2000


# ---- the loop itself ----


def counting(first, last, n, c, s, out):
    """A rig of one counter that discards tick 5."""
    (x,) = s
    for k in range(first, last):
        n[0] = k
        if k == 5:
            raise ValueError
        out[k - n[2], 0] = x
        x += c
    return (x,)


counting.__qualname__ = "counting_1"  # the code is cached under this name


@pytest.fixture(scope="module")
def loop():
    return _ticking.made(our_numba().njit(nogil=True)(counting))


class Once:
    """One call of the loop, with a period of 1/3 us or another one."""

    def __init__(self, loop, first, last, start=0, over=1000, lap=4, behind=1 << 50):
        self.carrier, self.sent = Carrier(_PUBLISH(lambda *_: 0)), []
        self.live = np.array([0, first, first, 0, 7, SLOTS], np.int64)
        out, self.spans = np.zeros((lap, 1)), np.zeros((lap, 2), np.int64)
        template = np.full(3, -1, np.int64)
        slots, ring, *_ = self.carrier.lend(24)
        publishers = np.array([[9, template.ctypes.data, 24, 0, 2, 0, 1]])
        numbers = np.array([[out.ctypes.data, 8, 16]], np.int64)
        kept = np.zeros(1, np.int64), np.zeros(1), np.zeros(1, np.int64), np.zeros(1)
        grid = start or time.monotonic_ns(), over, 3, behind, lap, 5 * SECOND
        self.n = np.array([0, 0, first])
        given = self.n, 2.0, (10.0,)
        rest = publishers, numbers, self.spans, kept, given, (out,)
        self.result = loop(first, last, self.live, grid, np.zeros(2, np.int64), self.carrier.calls, slots, ring, *rest)
        self.out, self.slots = out, slots
        self.why, self.reached = self.live[_ticking.WHY], self.live[_ticking.REACHED]


def test_the_loop_runs_each_tick_at_its_time_and_fills_the_ring(loop):
    begun = time.monotonic_ns()
    once = Once(loop, 0, 4, over=30_000_000)  # the period is 10 ms
    assert time.monotonic_ns() - begun >= 30_000_000
    assert (once.why, once.reached, once.result) == (_ticking.ASKED, 4, (18.0,))
    assert once.out[:, 0].tolist() == [10.0, 12.0, 14.0, 16.0]
    assert (once.spans[:, 0] >= 0).all()
    # The publisher is due at every second tick, so stamps are 5 s and 5.02 s. The message ends with the number of its
    # row.
    assert once.slots[7:9, ::2].tolist() == [[9, 24]] * 2
    for k, slot in enumerate(once.slots[7:9]):
        message = (ctypes.c_int64 * 3).from_address(int(slot[1]))
        # The number is that of the row at the node's own tick.
        assert list(message) == [5 + (20_000_000 * k << 32), -1, int(once.out[k : k + 1].view(np.int64)[0, 0])]
    assert once.live[_ticking.NEXT] == 9
    assert once.live[_ticking.ROOM] == SLOTS - 2


def test_a_discarded_tick_leaves_the_state_before_it(loop):
    once = Once(loop, 3, 9, lap=9)
    assert (once.why, once.reached, once.result) == (_ticking.DISCARDED, 5, (14.0,))


def test_the_loop_ends_before_it_overwrites_rows_and_where_the_clock_is_too_far_ahead(loop):
    once = Once(loop, 6, 20)
    assert (once.why, once.reached) == (_ticking.FULL, 10)
    once = Once(loop, 6, 20, start=time.monotonic_ns() - SECOND, behind=SECOND // 2)
    assert (once.why, once.reached, once.result) == (_ticking.BEHIND, 6, (10.0,))
