"""The parts behind a page: the data of a run, where they come from, the address of the page, and its end."""

import json
import math
import os
import queue
import random
import select
import subprocess
import sys
import threading
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import PATIENCE, few
from softrig_bringup.folder import ResultsFolder
from softrig_bringup.view import here as here_module, remote, run_pages as run_pages_module, serve, sources
from softrig_bringup.view.control import Control
from softrig_bringup.view.here import SessionSource, show_here
from softrig_bringup.view.run_pages import RunPages, page
from softrig_bringup.view.serve import Pages, Watched, _Token, free_address, new_token
from softrig_bringup.view.sources import Growing, Live, Recorded
from softrig_bringup.view.tracks import Pane, Track
from softrig_core import Recording, ScenarioError, Session, Signals, load_scenario, rig_of, simulate
from softrig_core.timebase import SECOND
from softrig_core.wire.parameter_event import encode
from softrig_core.wire.recording import ShardWriter
from softrig_core.wire.signals import Table
from softrig_nodes.processes.placement import Placement
from tornado.ioloop import IOLoop

# what is kept ---------------------------------------------------------------------------------------------------------


class Rows:
    """A track as its documentation describes it: rows in a list, four reduced to one."""

    def __init__(self, limit):
        self.limit, self.rows, self.labels, self.thinned = limit, [], [], False

    def append(self, t, columns):
        self.labels += [label for label in columns if label not in self.labels]
        new = [(float(a), {n: float(x[k]) for n, x in columns.items()}) for k, a in enumerate(t)]
        for first in range(0, len(new), self.limit // 5):
            part = new[first : first + self.limit // 5]
            if len(self.rows) + len(part) > self.limit:
                self.thin()
            self.rows += part

    def thin(self):
        self.thinned = True
        old = len(self.rows) // 2 // 4 * 4
        kept = []
        for k in range(0, old, 4):
            four = self.rows[k : k + 4]
            pair = [(four[0][0], {}), (four[2][0], {})]
            for label in self.labels:
                values = [row.get(label, math.nan) for _, row in four]
                known = [v for v in values if not math.isnan(v)] or [math.nan]
                low, high = min(known), max(known)
                falls = not any(map(math.isnan, values)) and values.index(high) < values.index(low)
                for row, v in zip(pair, (high, low) if falls else (low, high), strict=True):
                    row[1][label] = v
            kept += pair
        self.rows = kept + self.rows[old:]

    def table(self, first, last):
        i = max([k for k, (t, _) in enumerate(self.rows) if t <= first], default=0)
        rows = [row for row in self.rows[i:] if row[0] <= last]
        return [t for t, _ in rows], {n: [row.get(n, math.nan) for _, row in rows] for n in self.labels}


@pytest.mark.parametrize("seed", few(range(4), 2))
def test_a_track_is_its_rows_reduced_four_to_one(seed):
    rng, now = random.Random(seed), 0.0
    limit = [40, 41, 64, 5000][seed]
    track, rows = Track(limit), Rows(limit)
    for k in range(60 if limit < 100 else 9):
        n = rng.choice([1, 3, limit // 4 - 1, limit // 4, limit // 4 + 1, limit])
        t = now + 0.5 * np.arange(1.0, n + 1)
        now = t[-1]
        columns = {
            name: np.array([rng.randrange(-9, 9) for _ in t], float) for name in "abc"[: 1 + k % 3 if k > 5 else 1]
        }
        track.append(t, columns)
        rows.append(t, columns)
        assert (len(track), track.thinned, track.labels) == (len(rows.rows), rows.thinned, rows.labels)
        if limit > 100 and k < 8:
            continue
        for first, last in (
            (0.0, math.inf),
            (now / 3, now / 2),
            (-1.0, 0.0),
            (t[0], t[-1]),
            (now, now),
            (now + 1, now + 2),
        ):
            table, (times, values) = track.table(first, last), rows.table(first, last)
            assert table.t.tolist() == table.stamp.tolist() == times
            assert {n: [str(v) for v in x] for n, x in table.columns.items()} == {
                n: [str(v) for v in x] for n, x in values.items()
            }


def test_a_track_stores_two_hundred_thousand_messages():
    track = Track()
    for _ in range(2):
        track.append(np.arange(100_000.0), {"x": np.zeros(100_000)})
    assert (len(track), track.thinned) == (200_000, False)
    track.append(np.arange(1.0), {"x": np.zeros(1)})
    assert (len(track), track.thinned) == (150_001, True)


def test_a_pane_has_the_signals_of_its_topics():
    t = np.array([0.0, 1.0])
    pane = Pane({"a/b": Table(t, t, {"x/position": t + 1, "y/position": t + 2}), "c": Table(t[:0], t[:0], {})})
    assert list(pane) == ["a/b/x/position", "a/b/y/position"]
    assert len(pane) == 2
    assert pane["a/b/y/position"].x.tolist() == [2.0, 3.0]
    assert pane["a/b/x"].x.tolist() == [1.0, 2.0]
    assert pane.recording.topics["a/b"].number == 2
    assert pane.table("a/b").columns.keys() == {"x/position", "y/position"}
    assert (len(pane.table("nowhere").t), pane.table("nowhere").columns) == (0, {})
    for name, why in (("q/x", "no topic for signal 'q/x'"), ("c/x", "no samples yet of c/x")):
        with pytest.raises(KeyError, match=why):
            pane[name]


# where it comes from --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run():
    return simulate("dc_motor_smc_b2", duration=0.2)


@pytest.fixture
def clock(monkeypatch):
    result = SimpleNamespace(now=0.0)
    result.monotonic = result.perf_counter = lambda: result.now
    monkeypatch.setattr(sources, "time", result)
    monkeypatch.setattr(here_module, "time", result)
    return result


@pytest.mark.parametrize("held", [True, False])
def test_the_time_of_a_run_is_that_up_to_which_all_nodes_have_published(run, clock, held):
    """In lockstep a message is valid for a period of its node; in real time the newest one counts."""
    rig, rng = run.rig, random.Random(3)
    source = Growing(rig) if held else Growing(rig, False)
    periods = {p.topic: m.params.period for m in rig.members for p in m.outputs if not p.sporadic}
    assert source.length == rig.scenario.duration
    assert (source.end, source.version, source.outcome, source.live) == (0.0, 0, "", True)
    published, ends, version = Counter(), [(0.0, 0.0)], 0
    for k in range(20):
        clock.now += 0.25
        part = Recording((t, p.msgtype) for t, p in rig.topics.items())
        for name in part.topics:
            whole, n = run.recording.topics[name].since(published[name]), rng.choice([0, 1, 5])
            part.topics[name].times.extend(whole.times[:n])
            part.topics[name].data.extend(map(bytes, whole.data[:n]))
            published[name] += len(whole.times[:n])
        source.append(part)
        version += sum(bool(t.times and rig.topics[n].labels) for n, t in part.topics.items())
        newest = {n: run.recording.topics[n].times[c - 1] / SECOND for n, c in published.items() if c}
        held_up = [t + periods[n] for n, t in newest.items() if n in periods] if held else []
        assert source.end == pytest.approx(min([max(newest.values()), *held_up]))
        ends.append((clock.now, source.end))
        (t0, a), (t1, b) = ends[max(1, k + 2 - 12)], ends[-1]
        assert source.speed == pytest.approx((b - a) / (t1 - t0) if t1 > t0 else 0.0)
    assert source.version == version
    for name, count in published.items():
        times = [t / SECOND for t in run.recording.topics[name].times[:count] if rig.topics[name].labels]
        assert source.pane(0.0, math.inf).table(name).t.tolist() == times
    source.finish("ended", None)
    assert (source.outcome, source.version, source.results) == ("ended", version + 1, [])
    assert source.end == pytest.approx(max(newest.values()))


def test_silent_nodes_are_awaited_before_those_that_wait_for_others(run, clock):
    source = Growing(run.rig)
    names = [m.name for m in run.rig.members]
    assert source.awaited == names
    source.status = {name: {"state": "starting"} for name in names} | {names[1]: {}}
    assert source.awaited == [names[1]]
    source.status[names[1]] = {"state": "running"}
    assert source.awaited == [n for n in names if n != names[1]]
    clock.now = 7.0
    assert source.waited == 7.0


def written(folder, run, upto, epoch=0, status=None):
    """Files as the nodes of a run leave them: what they recorded up to a time, ns, and their status."""
    for m in run.rig.members:
        ports = [p for p in m.outputs if p.topic in run.recording.topics]
        shard = ShardWriter(folder / f"{m.name}.shard", [(p.topic, p.msgtype) for p in ports])
        for number, p in enumerate(ports):
            topic = run.recording.topics[p.topic]
            for t, data in zip(topic.times, topic.data, strict=True):
                if t <= upto:
                    shard.add(number, epoch + t, bytes(data))
        if m.name == "dc_motor_smc":
            shard.note(epoch + 50_000_000, encode(epoch + 50_000_000, "/dc_motor_smc", {"delta": 1.5}))
        shard.flush()
        (folder / f"{m.name}.status").write_text(json.dumps({"state": "running", "epoch": epoch} | (status or {})))


def test_a_running_run_is_read_from_the_files_of_its_nodes(run, tmp_path, clock):
    source = Live(run.rig, tmp_path, False)
    source.read_new()
    assert (source.end, source.changes) == (0.0, [])
    assert len(source.pane(0.0, 1.0)) == 0
    clock.now = 3.0
    assert source.waited == 3.0
    written(tmp_path, run, 100_000_000)
    version = source.version
    source.read_new()
    published = sum(bool(run.recording.topics[t].times and p.labels) for t, p in run.rig.topics.items())
    assert source.version == version + published + 1  # each published topic counts once, and so does the change
    source.read_new()
    assert source.waited == 0.0  # all nodes have started
    assert source.end == pytest.approx(0.1)
    assert source.changes == [(0.05, "dc_motor_smc", {"delta": 1.5})]
    speed = source.pane(0.0, 1.0)["motor/state/shaft/velocity"]
    assert speed.x.tolist() == run.signals["motor/state/shaft/velocity"].x[: len(speed.t)].tolist()
    assert speed.t[-1] == 0.1
    (tmp_path / "metrics.json").write_text(json.dumps({"metrics": [{"name": "a"}], "nodes": {"b": {}}}))
    (tmp_path / "dc_motor_plant.status").write_text('{"state": "done"}')
    other = Live(run.rig, tmp_path, False)
    other.finish("ended", None)
    assert (other.status["dc_motor_plant"], other.outcome, other.end) == ({"state": "done"}, "ended", 0.1)
    source.finish("ended", tmp_path)
    assert (source.results, source.status, source.outcome) == ([{"name": "a"}], {"b": {}}, "ended")
    source.read_new()  # without a new message nothing changes
    assert source.status == {"b": {}}


def test_in_real_time_nothing_is_shown_before_the_plant_reports_its_start(run, tmp_path):
    epoch = 1_700_000_000_000_000_000
    source = Live(run.rig, tmp_path, True)
    written(tmp_path, run, 100_000_000, epoch)
    assert source.read() is False
    assert source.end == 0.0
    source.read_new()  # the first call reads the status
    source.read_new()
    assert source.end == pytest.approx(0.1)
    assert source.pane(0.0, 1.0)["motor/state/shaft/velocity"].t[0] == 0.0


def test_a_recording_is_cut_to_a_window_with_the_message_before_it(run):
    content = {"nodes": {"a": {}}, "metrics": [1], "changes": [{"at_s": 0.1, "node": "n", "set": {"k": 2}}]}
    source = Recorded(run.rig, run.signals, content)
    assert (source.status, source.results, source.changes) == ({"a": {}}, [1], [(0.1, "n", {"k": 2})])
    assert (source.end, source.length, source.outcome, source.version) == (0.2, 0.2, "recorded", 1)
    assert (source.live, source.thinned, source.speed, source.waited, [*source.awaited]) == (False, False, 0.0, 0.0, [])
    for key in ("error", "stopped"):
        assert Recorded(run.rig, run.signals, {key: f"{key} so"}).outcome == f"{key} so"
    whole = run.signals["motor/state/shaft/velocity"]
    for first, last in ((0.0, math.inf), (-1.0, 0.1), (0.05, 0.1), (0.05002, 0.05003), (0.2, 0.3), (0.0, 0.2)):
        result = source.pane(first, last)["motor/state/shaft/velocity"]
        i = max([k for k, t in enumerate(whole.t) if t <= first], default=0)
        assert result.t.tolist() == [t for t in whole.t[i:] if t <= last]
        assert result.x.tolist() == whole.x[i : i + len(result.t)].tolist()
    empty = Recorded(run.rig, Signals(Recording([])), {})
    assert (empty.end, empty.length, len(empty.pane(0.0, 1.0))) == (0.0, 1e-9, 0)


# in the process of its page -------------------------------------------------------------------------------------------


def test_a_slice_of_ticks_ends_in_time_and_the_pace_is_kept(clock, monkeypatch):
    source = SessionSource(Session("dc_motor_smc", duration=0.01), False, 0.0)
    step = source._step
    monkeypatch.setattr(source, "_step", lambda: (step(), setattr(clock, "now", clock.now + 0.02)))
    before = source.session.t
    assert source.turn() == 0.0  # run on at once: the slice only ended after 0.05 s to serve the page
    assert source.session.t - before == pytest.approx(3e-4)
    source.control.hold("me", "pause")
    assert source.turn() == 0.01  # no work is left
    source.control.hold("me", "resume")
    source.control.go_at("me", 1e-9)
    source.turn()
    assert source.turn() == 0.01
    source.control.go_at("me", 0.0)
    while not source.session.over:
        source.turn()
    assert source.turn() == 0.01


def test_the_elapsed_part_of_a_tick_survives_a_pause(clock):
    """A tick begins with each second of wall-clock time; 0.9 s of one have passed when somebody pauses for 5 s."""
    source = SessionSource(Session("dc_motor_smc", duration=0.1), False, 1e-4)
    source.turn()
    first, results = source.session.t, []
    for now, what in ((0.05, ""), (0.9, "pause"), (5.9, "resume"), (5.95, ""), (6.05, "")):
        clock.now = now
        source.turn()
        results.append(round((source.session.t - first) / 1e-4))
        if what:
            source.control.hold("me", what)
    assert results == [1, 1, 1, 1, 2]


def test_actions_on_a_rig_in_the_process_of_its_page_are_reported(tmp_path, clock):
    source = SessionSource(Session("dc_motor_smc", duration=0.01), False, 1.0)
    control = source.control
    assert (control.goes_back, control.buttons, control.held, control.pace) == (True, [], False, 1.0)
    assert (
        SessionSource(Session("dc_motor_smc_faults", duration=0.01), True, 0.0).control.buttons == []
    )  # a button sends messages from outside, which this run does not receive
    messages = []
    for act in (
        lambda: control.hold("me", "step"),
        lambda: control.hold("me", "pause"),
        lambda: control.hold("me", "step"),
        lambda: control.hold("me", "resume"),
        lambda: control.turn("me", "dc_motor_smc.delta", -1.0),
        lambda: control.turn("me", "dc_motor_smc.delta", 0.5),
        lambda: control.go_back("me", 5.0),
        lambda: control.go_back("me", 0.0001),
    ):
        act()
        messages.append((control.entries[-1].text, control.entries[-1].wrong, round(source.session.t, 9)))
    assert messages[:4] == [
        ("step refused: the run is not paused; pause it first", True, 1e-4),
        ("pause: paused", False, 1e-4),
        ("step: one step", False, 2e-4),
        ("resume: goes on", False, 2e-4),
    ]
    assert messages[4][0].startswith("dc_motor_smc.delta = -1 ")
    assert messages[4][1:] == (True, 2e-4)
    assert messages[5][0].startswith("dc_motor_smc.delta = 0.5")
    assert messages[6][1:] == (True, 2e-4)
    assert messages[7] == ("back to 0.0001 s from 0.0002 s: changes made now apply from there on", False, 1e-4)
    assert control.held
    assert source.status["dc_motor_plant"]["state"] == "running"
    assert source.branched == [{"at_s": 1e-4, "from_s": 2e-4, "left": ""}]  # without a folder the branch is not saved
    source.session.go()
    source.read_new()
    assert {s["state"] for s in source.status.values()} == {"done"}
    assert source.status["dc_motor_plant"]["ticks"] == 100
    assert [c[1:] for c in source.changes] == [("dc_motor_smc", {"delta": 0.5})]


class NoPages:
    """Pages without a visitor, or with one that leaves when the run has ended."""

    url, made = "http://here", []

    def __init__(self, source, control, how, address, token, loop):
        self.source, self.control, self.loop = source, control, loop
        self.about, self.measured, self.closed = (how, address), 0, False
        NoPages.made.append(self)

    def measure(self):
        self.measured += 1

    def left(self):
        return True

    def close(self):
        self.closed = True


@pytest.fixture
def quiet(monkeypatch, tmp_path):
    monkeypatch.setattr(here_module, "Pages", NoPages)
    monkeypatch.setattr(here_module, "FRAME", 5)
    monkeypatch.setattr(here_module, "REST", 0.001)
    NoPages.made.clear()
    folder = ResultsFolder(tmp_path / "run")
    folder.clear()
    loop = IOLoop(make_current=False)  # the page schedules callbacks in its loop, which must end with the test
    monkeypatch.setattr(IOLoop, "current", staticmethod(lambda *_: loop))
    yield folder
    loop.close()


def concluding(result, status=7):
    def conclude(run, folder):
        result.append((folder.path.name, run))
        (folder.path / "metrics.json").write_text(json.dumps({"metrics": [], "nodes": {}}))
        return status

    return conclude


def test_a_run_in_the_process_of_its_page_is_concluded_once_and_returns_its_status(quiet, capsys):
    done = []
    rig = rig_of("dc_motor_smc", duration=0.02)
    placement = Placement("inprocess", paused=False, pace=0.0)
    assert show_here(rig, placement, "127.0.0.1:0", quiet, concluding(done)) == 7
    ((name, run),) = done
    assert (name, run.mode, run.error, run.stopped, run.branched) == ("run", "inprocess", "", 0, [])
    assert run.recording.topics == simulate(rig).recording.topics
    assert run.wall_s > 0.0
    (pages,) = NoPages.made
    assert pages.about == ("inprocess", "127.0.0.1:0")
    assert pages.closed
    assert pages.measured
    assert (pages.source.outcome, pages.control.entries[-1].text) == ("ended", "ended")
    assert "the page is http://here" in capsys.readouterr().err


def test_a_branch_of_a_completed_run_is_written_beside_it_and_ctrl_c_ends_it(quiet, monkeypatch, tmp_path):
    """One action at a time: back, a parameter and a step, and Ctrl-C, which leaves the loop as a signal does."""
    done, messages = [], []

    def left(pages):
        control, outcome = pages.control, pages.source.outcome
        if len(done) == 1 and outcome and not messages:
            messages.append(control.go_back("me", 0.01))
        elif len(messages) == 1 and not outcome:
            messages.append(control.turn("me", "dc_motor_smc.delta", 0.5))
            control.hold("me", "step")
        elif len(messages) == 2:
            pages.loop.add_callback(struck)
        return False

    def struck():
        raise KeyboardInterrupt

    monkeypatch.setattr(NoPages, "left", left)
    (tmp_path / "run-2").mkdir()
    placement = Placement("inprocess", paused=False, pace=0.0)
    assert show_here(rig_of("dc_motor_smc", duration=0.02), placement, "127.0.0.1:0", quiet, concluding(done)) == 7
    assert [(name, run.stopped) for name, run in done] == [("run", 0), ("run-3", 2)]
    assert done[1][1].branched == [{"at_s": 0.01, "from_s": 0.02, "left": str(tmp_path / "run")}]
    assert done[1][1].recording.topics["motor/state"].times[-1] == 10_000_000
    assert NoPages.made[0].source.branched == []


def test_ctrl_c_after_going_back_and_before_a_tick_leaves_nothing_beside(quiet, monkeypatch, tmp_path):
    done, messages = [], []

    def left(pages):
        if done and not messages:
            messages.append(pages.control.go_back("me", 0.01))
        elif messages and not pages.source.outcome:
            pages.loop.add_callback(struck)
        return False

    def struck():
        raise KeyboardInterrupt

    monkeypatch.setattr(NoPages, "left", left)
    placement = Placement("inprocess", paused=False, pace=0.0)
    assert show_here(rig_of("dc_motor_smc", duration=0.02), placement, "127.0.0.1:0", quiet, concluding(done, 1)) == 1
    assert [name for name, _ in done] == ["run"]


# its address and its end ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "host"),
    [("127.0.0.1:0", "127.0.0.1"), (":0", "127.0.0.1"), ("localhost:0", "localhost"), ("[::1]:0", "::1")],
)
def test_a_free_port_is_found_at_an_address(address, host):
    try:
        result, port = free_address(address)
    except ScenarioError:
        assert host == "::1"  # a machine without IPv6 has no such address
        return
    assert result == host
    assert 1023 < port < 65536


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.1:x", "127.0.0.1:65536", "127.0.0.1:-1", ""])
def test_an_address_without_a_port_is_refused(address):
    with pytest.raises(ScenarioError, match="expected HOST:PORT, port 0 for a free one"):
        free_address(address)


def test_an_address_that_does_not_exist_is_refused_with_the_systems_reason():
    with pytest.raises(ScenarioError, match=r"--address 192\.0\.2\.1:0: "):
        free_address("192.0.2.1:0")


def test_tokens_cannot_be_guessed():
    tokens = {new_token() for _ in range(50)}
    assert len(tokens) == 50
    assert {len(t) for t in tokens} == {22}  # 16 bytes


def asked(host="127.0.0.1", token="", cookie=""):
    """A request as a browser makes it, and the cookies that it gets."""
    answer = {}
    handler = SimpleNamespace(
        request=SimpleNamespace(host_name=host),
        get_argument=lambda name, default: token if name == "token" else default,
        get_cookie=lambda name, default=None: cookie if name == "softrig_token" else default,
        set_cookie=lambda name, value, **how: answer.update({name: (value, how)}),
    )
    return handler, answer


@pytest.mark.parametrize(
    ("names", "request_of", "refused", "kept"),
    [
        (("localhost",), {"host": "localhost", "token": "right"}, "", True),
        (("localhost", "::1"), {"host": "[::1]", "cookie": "right"}, "", False),
        ((), {"host": "anywhere.example", "token": "right"}, "", True),
        (("localhost",), {"host": "evil.example", "token": "right"}, "the page is served to this host only", False),
        (("localhost",), {"host": "localhost"}, "expected the address of the page with its token", False),
        (
            ("localhost",),
            {"host": "localhost", "token": "wrong", "cookie": "right"},
            "expected the address of the page with its token",
            False,
        ),
        (
            ("localhost",),
            {"host": "localhost", "cookie": "wrong"},
            "expected the address of the page with its token",
            False,
        ),
    ],
)
def test_a_request_with_the_token_is_accepted_and_a_cookie_keeps_it(names, request_of, refused, kept):
    handler, answer = asked(**request_of)
    guard = _Token("right", names)
    arrived = guard.get_user_async(handler)
    if refused:
        with pytest.raises(serve.HTTPError, match=refused) as error:
            arrived.send(None)
        assert error.value.status_code == 403
    else:
        with pytest.raises(StopIteration) as result:
            arrived.send(None)
        assert result.value.value == "token"
    assert answer == ({"softrig_token": ("right", {"httponly": True, "samesite": "Strict"})} if kept else {})
    assert guard.login_url == "/"


class Loop:
    """An artificial event loop."""

    def __init__(self):
        self.calls, self.stopped = [], False

    def add_callback(self, call, *words):
        self.calls.append((call, words))

    def stop(self):
        self.stopped = True


class NoServer:
    """Replaces Bokeh's server: its configuration and its connections."""

    def __init__(self, applications, io_loop, **asked):
        self.applications, self.io_loop, self.asked = applications, io_loop, asked
        self.port, self.sessions, self.started = asked["port"], [], False

    def start(self):
        self.started = True

    def get_sessions(self, page):
        assert page == "/view"
        return self.sessions

    def unlisten(self):
        self.started = False


@pytest.fixture
def pages(run, monkeypatch):
    monkeypatch.setattr(serve, "Server", NoServer)
    source = Recorded(run.rig, run.signals, {})
    result = Pages(source, "control", "inprocess", "127.0.0.1:0", "word", Loop())
    yield result
    result.close()
    assert not result.server.started


def test_a_server_is_configured_for_its_address(pages, monkeypatch):
    about = dict(pages.server.asked)
    about.pop("extra_patterns")
    port, guard = about.pop("port"), about.pop("auth_provider")
    assert about == {
        "address": "127.0.0.1",
        "check_unused_sessions_milliseconds": 1000,
        "unused_session_lifetime_milliseconds": 5000,
        "allow_websocket_origin": [f"localhost:{port}", f"127.0.0.1:{port}"],
        "websocket_max_message_size": 1 << 20,
        "websocket_ping_interval": 30.0,
    }
    assert (guard._token, guard._names) == ("word", serve.LOOPBACK)
    assert pages.url == f"http://127.0.0.1:{port}/?token=word"
    assert pages.server.started
    other = Pages(pages._source, None, "x", "0.0.0.0:0", "word", Loop())
    assert (other.server.asked["allow_websocket_origin"], other.server.asked["auth_provider"]._names) == (["*"], ())
    other.close()


def test_a_completed_run_is_shown_until_the_last_browser_has_gone(pages):
    results = []
    for connections in ([], [0], [], [0, 1], [1], [0], []):
        pages.server.sessions = [SimpleNamespace(connection_count=n) for n in connections]
        results.append(pages.left())
    # Only after a page was connected; a session without a connection may be a request or a reload.
    assert results == [False] * 6 + [True]


def test_figures_are_measured_now_and_then_during_a_run(pages, monkeypatch, run):
    clock = SimpleNamespace(now=50.0)
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr(serve, "time", clock)
    measured = []
    one = SimpleNamespace(not_judged=lambda why: "a result")
    monkeypatch.setattr(serve, "evaluate", lambda rig, pane, under_way: measured.append(len(pane)) or [one])
    pages.measure()
    assert not measured  # figures of a recording exist already
    pages._source.live = True

    def done(seconds):
        pages._worker.submit(lambda: None).result()  # the only worker thread has finished all earlier measurements
        clock.now += seconds
        (call, words) = pages.server.io_loop.calls.pop()
        call(*words)

    for elapsed, pause in ((0.05, 1.0), (0.3, 3.0)):
        before = len(measured)
        pages.measure()
        pages.measure()  # a second measurement waits for the first
        assert pages._figures() == (["a result"] if before else (), True)
        done(elapsed)
        assert len(measured) == before + 1
        clock.now += pause - 0.01
        pages.measure()
        assert len(measured) == before + 1
        clock.now = pages._next
    assert pages._figures() == (["a result"], True)
    pages._source.thinned = True
    pages.measure()
    assert len(measured) == 2  # a recording that was thinned is not measured
    del pages._source.thinned
    pages._source.results = [r.plain() for r in run.results]
    pages.measure()
    assert len(measured) == 2
    for outcome, so_far in (("ended", False), ("stopped by a signal", True)):
        pages._source.outcome = outcome
        results, result = pages._figures()
        assert ([r.name for r in results], result) == ([r.name for r in run.results], so_far)


def test_each_browser_has_a_number_and_the_style_that_it_asks_for(pages, monkeypatch):
    made = []
    monkeypatch.setattr(
        serve, "Page", lambda document, source, control, figures, user, how, style: made.append((user, how, style))
    )

    def document(**arguments):
        return SimpleNamespace(session_context=SimpleNamespace(request=SimpleNamespace(arguments=arguments)))

    for each in (document(), document(look=[b"dark"]), document(look=[b"pink"]), SimpleNamespace(session_context=None)):
        pages._page(each)
    assert made == [
        (f"browser {k}", "inprocess", style) for k, style in enumerate(("light", "dark", "light", "light"), 1)
    ]


def test_a_page_that_cannot_be_made_is_reported_and_its_head_remains(pages, monkeypatch, capsys):
    def fails(*_):
        raise ValueError("no such plot")

    left = []
    monkeypatch.setattr(serve, "Page", fails)
    monkeypatch.setattr(serve, "bare", lambda document, *of: left.append((document.name, of[0], of[1], str(of[2]))))
    cleared = []
    document = SimpleNamespace(name="page", session_context=None, clear=lambda: cleared.append(True))
    pages._page(document)
    assert (left, cleared) == ([("page", pages._control, "browser 1", "no such plot")], [True])
    assert capsys.readouterr().err == "softrig: a page cannot be shown: ValueError: no such plot\n"


# beside a run -------------------------------------------------------------------------------------------------------

WATCHED = {"domain": 3, "realtime": False, "paused": True, "pace": 2.0, "how": "container", "address": "127.0.0.1:0",
           "token": "word"}  # fmt: skip


@pytest.mark.parametrize(
    ("more", "held", "pace"),
    [({}, True, 2.0), ({"paused": False}, False, 2.0), ({"realtime": True}, True, None), ({"pace": 0.0}, True, 0.0)],
)
def test_a_page_beside_a_run_follows_the_files_of_the_nodes_until_it_ends(
    run, tmp_path, monkeypatch, capsys, more, held, pace
):
    """The process of a page, stepped by the test: its updates one by one, and the lines of the run."""
    seen, remotes = [], []

    class Beside(NoPages):
        def left(self):
            return True

    class Asks:
        def __init__(self, domain, directory, call):
            remotes.append((domain, directory))

        def ask(self, request, answered):
            remotes.append(request)

        def close(self):
            remotes.append("closed")

    class Hand(Loop):
        def start(self):
            (page,), (style,) = made, styles

            def state():
                return page.control.held, page.control.pace, page.source.outcome, self.stopped

            seen.append(state())
            epoch = 1_700_000_000_000_000_000 if more.get("realtime") else 0
            written(tmp_path, run, 200_000_000, epoch, {"held": not held, "pace": 9.0} if not epoch else None)
            style()
            style()
            seen.append(state())
            lines.put(json.dumps({"over": "broke: so", "folder": "", "wrong": True}))
            lines.put(None)
            listeners[0].join()
            for call, words in self.calls:
                call(*words)
            seen.append(state())
            style()
            seen.append(page.control.entries[-1][1:])
            seen.append([s.text for s in page.control.entries if s.author == "dc_motor_smc"])

    made, styles, listeners, lines = [], [], [], queue.Queue()
    monkeypatch.setattr(serve, "Pages", lambda *words: made.append(Beside(*words)) or made[-1])
    monkeypatch.setattr(serve, "Remote", Asks)
    monkeypatch.setattr(serve, "IOLoop", SimpleNamespace(current=Hand))
    monkeypatch.setattr(serve.os, "nice", lambda n: seen.append(n))
    monkeypatch.setattr(
        "tornado.ioloop.PeriodicCallback",
        lambda style, every: seen.append(every) or styles.append(style) or SimpleNamespace(start=lambda: None),
    )

    def thread(target, daemon):
        listeners.append(threading.Thread(target=target, daemon=daemon))
        return listeners[-1]

    monkeypatch.setattr(serve, "threading", SimpleNamespace(Thread=thread))
    scenario = load_scenario("dc_motor_smc_b2").model_dump(mode="json", exclude_unset=True)
    about = WATCHED | {"directory": str(tmp_path), "scenario": scenario} | more
    serve.serve_run(Watched(**about), iter(lines.get, None))
    nice, every, first, going, over, last, changes = seen
    assert (nice, every) == (10, 250)
    assert first == (held, pace, "", False)
    assert going == ((held, None) if more.get("realtime") else (not held, 9.0)) + ("", False)
    assert over[2:] == ("broke: so", True)
    assert last == ("the run", "broke: so", True)
    assert changes == ["delta = 1.5 from this tick on"]  # a change is reported once
    assert remotes == [(3, tmp_path), "closed"]
    assert made[0].about == ("container", "127.0.0.1:0")
    assert made[0].closed
    assert made[0].measured == 3
    assert listeners[0].daemon
    assert "the page is http://here" in capsys.readouterr().err


def told_of(page):
    return json.loads((page._directory / "view.json").read_text())


@pytest.mark.parametrize(
    ("run_of", "line", "waits"),
    [
        ({}, {"over": "ended", "wrong": False}, True),
        ({"error": "so"}, {"over": "broke: so", "wrong": True}, True),
        ({"stopped": 2}, {"over": "stopped by SIGINT at t = 0.1 s", "wrong": False}, False),
    ],
)
def test_the_page_is_informed_how_the_run_ended_and_waited_for(tmp_path, capsys, run_of, line, waits):
    with page(load_scenario("dc_motor_smc"), tmp_path, Placement("container"), "127.0.0.1:0") as beside:
        wrote, ended = [], []
        beside._process = SimpleNamespace(
            poll=lambda: None,
            stdin=SimpleNamespace(write=wrote.append, flush=lambda: wrote.append("flushed"), close=lambda: None),
            wait=lambda patience=None: ended.append(patience) or (3 if patience is None else 0),
        )
        about = SimpleNamespace(
            **{"error": "", "stopped": 0, "stopped_at": line["over"] if "stopped" in run_of else ""} | run_of
        )
        beside.over(about, tmp_path / "out")
        assert wrote == [
            json.dumps({"over": line["over"], "folder": str(tmp_path / "out"), "wrong": line["wrong"]}) + "\n",
            "flushed",
        ]
        printed = capsys.readouterr().err
        stays = "softrig: the page stays until it is closed, or Ctrl-C\n"
        stays += "softrig: the page has broken (status 3); the results are there\n"
        assert printed == (stays if waits else "")
    assert ended == ([None] if waits else []) + [5.0]
    assert beside._ends


def test_a_page_that_was_never_opened_or_has_ended_is_not_informed(tmp_path, capsys):
    beside = RunPages(load_scenario("dc_motor_smc"), tmp_path, Placement("container"), "127.0.0.1:0")
    beside.over(None, tmp_path)
    beside._process = SimpleNamespace(poll=lambda: 0)
    beside.over(None, tmp_path)
    assert capsys.readouterr().err == ""


def test_the_process_of_a_page_gets_its_configuration(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(run_pages_module.subprocess, "Popen", lambda command, **how: started.append((command, how)))
    placement = Placement("processes", "realtime", paused=True, pace=0.5)
    beside = RunPages(load_scenario("dc_motor_smc"), tmp_path, placement, ":0")
    monkeypatch.setattr(beside.keeper, "start", lambda: started.append("kept"))
    beside.open(7)
    reported = told_of(beside)
    assert (reported["domain"], reported["realtime"], reported["paused"], reported["pace"], reported["how"]) == (
        7,
        True,
        True,
        0.5,
        str(placement),
    )
    assert (reported["directory"], reported["scenario"]["title"]) == (
        str(tmp_path),
        load_scenario("dc_motor_smc").title,
    )
    assert reported["address"].startswith("127.0.0.1:")
    assert not reported["address"].endswith(":0")
    assert len(reported["token"]) == 22
    assert Watched.model_validate(reported).domain == 7
    (command, how), kept = started
    assert command[1:] == ["-P", "-m", "softrig_bringup.view.serve", str(tmp_path / "view.json")]
    assert (how["text"], how["process_group"], kept) == (True, 0, "kept")
    assert beside.keeper.daemon


# processes beside it, as stand-ins -----------------------------------------------------------------------------


class Piped:
    """A process with its streams in memory; `lines` is what it prints."""

    def __init__(self, command, **asked):
        self.command, self.asked, self.wrote, self.ended = command, asked, [], []
        self.stdout = iter(Piped.lines)
        self.stdin = SimpleNamespace(
            write=self.wrote.append, flush=lambda: None, close=lambda: self.ended.append("closed")
        )

    def wait(self, patience=None):
        self.ended.append(patience)
        if Piped.stays and patience is not None:
            raise subprocess.TimeoutExpired("x", patience)

    pid = 1 << 30  # no process has this number

    def kill(self):
        self.ended.append("killed")


@pytest.fixture
def piped(monkeypatch, tmp_path):
    made = []
    Piped.lines, Piped.stays = [], False
    monkeypatch.setattr(remote.subprocess, "Popen", lambda *what, **how: made.append(Piped(*what, **how)) or made[-1])
    monkeypatch.setattr(remote, "environment", lambda domain, directory: {"D": str(domain), "F": str(directory)})
    threads = []
    monkeypatch.setattr(
        remote.threading,
        "Thread",
        lambda target, daemon: threads.append((target, daemon)) or SimpleNamespace(start=lambda: None),
    )

    def make(call=lambda do: do()):
        asks = remote.Remote(3, tmp_path, call)
        return asks, made[-1], threads[-1]

    return make


def test_answers_of_nodes_go_to_whoever_asked(piped, tmp_path):
    asks, process, (listen, daemon) = piped()
    assert process.command[1:] == ["-P", "-m", "softrig_nodes.ros.remote"]
    assert process.asked["env"] == {"D": "3", "F": str(tmp_path)}
    assert (process.asked["text"], process.asked.get("process_group"), daemon) == (True, None, True)
    results = []
    for k in range(3):
        asks.ask({"node": f"n{k}"}, lambda ok, why, k=k: results.append((k, ok, why)))
    assert [json.loads(line) for line in process.wrote] == [{"id": k, "node": f"n{k}"} for k in range(3)]
    assert all(line.endswith("}\n") for line in process.wrote)
    process.stdout = iter(
        ['{"id": 2, "ok": false, "reason": "no"}\n', "a library says hello\n", '{"id": 0, "ok": true, "reason": ""}\n']
    )
    listen()
    assert results == [(2, False, "no"), (0, True, "")]

    def broken(text):
        raise BrokenPipeError

    process.stdin.write = broken
    asks.ask({"node": "n"}, lambda ok, why: results.append((9, ok, why)))
    assert results[-1] == (9, False, "the process that sends requests to the nodes has ended")
    assert list(asks._asked) == [1]


def test_a_process_that_is_released_ends_by_itself_or_by_force(piped):
    asks, process, _ = piped()
    asks.close()
    assert process.ended == ["closed", 2.0]
    Piped.stays = True
    asks, process, _ = piped()
    asks.close()
    assert process.ended == ["closed", 2.0, "killed", None]


def test_processes_started_by_a_page_end_with_it_by_force():
    code = "import subprocess, time; print(subprocess.Popen(['sleep', '60']).pid, flush=True); time.sleep(60)"
    page = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, process_group=0
    )
    child = os.pidfd_open(int(page.stdout.readline()))
    try:
        remote.let_go(page, 0.0)
        assert select.select([child], [], [], PATIENCE)[0] == [child]
    finally:
        os.close(child)
        page.stdout.close()


def test_the_process_of_a_page_reads_its_configuration_and_ignores_ctrl_c(tmp_path, monkeypatch, capsys):
    messages, asked = [], []
    (tmp_path / "view.json").write_text(json.dumps(WATCHED | {"directory": str(tmp_path), "scenario": {}}))
    monkeypatch.setattr(serve.sys, "argv", ["serve", str(tmp_path / "view.json")])
    monkeypatch.setattr(serve.signal, "signal", lambda *what: messages.append(what))
    monkeypatch.setattr(serve.asyncio, "set_event_loop", lambda loop: loop.close())
    monkeypatch.setattr(
        serve, "serve_run", lambda watched, lines: asked.append((watched.domain, lines is serve.sys.stdin))
    )
    assert serve.main() == 0
    assert (messages, asked) == ([(serve.signal.SIGINT, serve.signal.SIG_IGN)], [(3, True)])

    def refused(watched, lines):
        raise ScenarioError("no such address")

    monkeypatch.setattr(serve, "serve_run", refused)
    assert serve.main() == 2
    assert capsys.readouterr().err == "softrig: no such address\n"
    with pytest.raises(ValueError, match="extra_forbidden"):
        Watched.model_validate(WATCHED | {"directory": "", "scenario": {}, "more": 1})


def test_a_recording_is_shown_until_it_is_interrupted(run, monkeypatch, capsys):
    NoPages.made.clear()
    ended = []

    class Struck(Loop):
        def start(self):
            ended.append("begun")
            raise KeyboardInterrupt

    monkeypatch.setattr(serve, "Pages", NoPages)
    monkeypatch.setattr(serve, "IOLoop", SimpleNamespace(current=Struck))
    source = Recorded(run.rig, run.signals, {})
    with pytest.raises(KeyboardInterrupt):
        serve.serve(source, "container", ":0")
    (made,) = NoPages.made
    assert (made.about, made.closed, made.source, made.control.knobs, ended) == (
        ("container", ":0"),
        True,
        source,
        {},
        ["begun"],
    )
    assert (made.control._now(), made.control._over()) == (0.2, "recorded")
    assert capsys.readouterr().err == "softrig: the page is http://here; Ctrl-C ends it\n"


@pytest.mark.parametrize(("ends", "starts"), [(False, 3), (True, 0)])
def test_a_page_that_ends_with_its_run_is_not_restarted(tmp_path, monkeypatch, capsys, ends, starts):
    page_of = RunPages(load_scenario("dc_motor_smc"), tmp_path, Placement("container", paused=False), "127.0.0.1:0")
    page_of._watched["domain"], page_of._ends = 7, ends
    made = []
    monkeypatch.setattr(page_of, "_start", lambda: made.append(1) or SimpleNamespace(wait=lambda: 5))
    monkeypatch.setattr(run_pages_module, "Remote", lambda *what: pytest.fail("nobody is held"))
    page_of._process = SimpleNamespace(wait=lambda: 5)
    page_of._keep()
    assert len(made) == starts
    assert capsys.readouterr().err.count("the page has broken (status 5)") == (0 if ends else 4)


@pytest.mark.parametrize(
    ("scenario", "node", "used", "idle"),
    [  # A link is recognised by the words before a colon, by nested names and by words in backquotes.
        ("tcp_aqm_smc", "aqm_controller", {"k1", "boundary", "anti_windup"}, {"l1", "pid_gain", "a"}),
        ("manipulator_adsmc", "vcs_controller", {"v_max", "adsmc.a1"}, {"dsmc.a1", "smc.rho"}),
        ("dc_motor_smc_faults", "noise", {"value", "active"}, {"points", "delay"}),
    ],
)
def test_parameters_of_unselected_controllers_are_idle(scenario, node, used, idle):
    control = Control(rig_of(load_scenario(scenario)), lambda *_: None, lambda: 0.0, lambda: "")
    results = {knob.name: knob.idle for knob in control.knobs.values() if knob.node == node}
    assert {name for name in used | idle if results[name]} == idle
