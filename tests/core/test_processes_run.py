"""A whole run in processes, with a stand-in for each of its parts; and what its nodes know of each other."""

import os
import signal
import struct
import subprocess
import time
from contextlib import contextmanager, nullcontext, suppress
from types import SimpleNamespace

import pytest
from conftest import make_scenario
from expected_text import check_expected
from softrig_core import Recording, RunError, ScenarioError, rig_of
from softrig_nodes.processes import domain, peers, processes, shared_memory, spawning
from softrig_nodes.processes.placement import Listener, Placement
from softrig_nodes.processes.stopping import Stopped
from test_processes_parts import BASIC, Child


class Stage:
    """A run through processes whose parts record their calls."""

    def __init__(self, monkeypatch, folder, nodes=BASIC, error="", failing=None, late=(), **keys):
        self.asked, self.announced, self.error, self.failing, self.late = [], [], error, failing, [*late]
        self.rig = rig_of(make_scenario(nodes, 0.5, timeout=7.0, start_timeout=31.0, **keys))
        self.folder, self.children = folder, []
        stand_ins = {"need_ros": lambda: None, "require_loopback": lambda: self.asked.append("loopback"),
                     "free_domain": self._free,
                     "remove_leftovers": lambda domain=None: self.asked.append(("leftovers", domain)),
                     "lacking": lambda n: self.asked.append(("memory for", n)) or self.short,
                     "environment": lambda *arguments, **named: self.asked.append((arguments, named)) or {},
                     "start": self._start, "supervise": self._supervise,
                     "stop": lambda children: self.asked.append("stop"), "holders": lambda domains: " (by x)",
                     "gathered": lambda rig, folder, names: (Recording([]), {n: dict(self.status) for n in names}),
                     "last_line": lambda log: "law: k is no number"}  # fmt: skip
        for name, stand_in in stand_ins.items():
            monkeypatch.setattr(processes, name, stand_in)
        self.domain, self.short, self.status, self.codes = 17, "", {"ticks": 5, "epoch": 9}, {}

    @contextmanager
    def _free(self):
        self.asked.append("reserved")
        yield self.domain
        self.asked.append("let go")

    def _start(self, run, group, again=False):
        self.started = run
        self.asked.append(("start", [m.name for m in group], again))
        made = []
        for member in group:
            child = Child(member.name)
            child.member, child.end, child.process.returncode = (
                member,
                os.open(os.devnull, 0),
                self.codes.get(member.name),
            )
            made.append(child)
        return made

    def _supervise(self, rig, children, progress, guests, realtime, stopping, restarts, clock, domain, announce):
        self.asked.append(("watch", [c.member.name for c in children], realtime, restarts.most))
        if self.failing:
            raise self.failing
        for k in self.late:
            restarts._again(k)
            restarts.counts[children[k].member.name] = 1
        return self.error

    def run(self, **placement):
        return processes.run_processes(
            self.rig,
            3,
            self.folder,
            Placement(**placement),
            Listener(announce=self.announced.append, opened=self.asked.append),
        )


@pytest.fixture
def stage(monkeypatch, tmp_path):
    return lambda *arguments, **keys: Stage(monkeypatch, tmp_path, *arguments, **keys)


def test_a_run_goes_through_its_stages_in_order(stage, tmp_path):
    one = stage()
    outcome = one.run(pace=2.0, paused=True)
    started = [("start", [name], False) for name in BASIC]
    assert one.asked == [
        "loopback",
        "reserved",
        ((17, tmp_path), {"discovery": "LOCALHOST", "silence": 7.0}),
        ("memory for", 3),
        17,
        *started,
        ("watch", [*BASIC], False, 0),
        "stop",
        ("leftovers", 17),
        "let go",
    ]
    assert (one.started.seed, one.started.record, one.started.recorders, one.started.returns) == (3, True, None, False)
    assert one.started.options == {
        "run.mode": "lockstep",
        "run.start_timeout": 31.0,
        "run.paused": True,
        "run.pace": 2.0,
    }
    assert (outcome.domain, outcome.epoch, outcome.error, outcome.stopped) == (17, 9, "", 0)
    assert one.announced == []
    assert set(outcome.status) == set(BASIC)


def test_a_run_in_a_chosen_domain_leaves_the_ports_of_others_alone(stage, tmp_path):
    one = stage()
    one.run(domain=4, wait=5.0, record=False, clock="realtime")
    assert one.asked[:2] == ["loopback", ("leftovers", None)]
    assert one.asked[-1] == ("leftovers", None)
    assert one.started.recorders == ()  # other nodes may exist in the domain, so no recorder is awaited
    assert (one.started.options["run.start_timeout"], one.started.record) == (5.0, False)
    assert ("watch", [*BASIC], True, 0) in one.asked
    part = stage()
    part.run(only=("gain",))
    assert "loopback" not in part.asked  # this run uses the network
    assert ((17, tmp_path), {"discovery": "SUBNET", "silence": 7.0}) in part.asked
    assert [a for a in part.asked if isinstance(a, tuple) and a[0] == "start"] == [("start", ["gain"], False)]
    guest = stage(BASIC | {"gain": {"executable": "gain", "external": True}})
    guest.run()
    assert guest.started.options["run.start_timeout"] == 0.0  # no limit, since the other part may start later
    assert ("leftovers", None) in guest.asked
    assert guest.announced[0].startswith("waiting for gain")
    together = stage()
    together.run(mode="container")
    assert [a for a in together.asked if isinstance(a, tuple) and a[0] == "start"] == [("start", [*BASIC], False)]


def test_facts_that_a_user_should_know_of_a_run_are_logged(stage):
    one = stage()
    one.domain, one.short = 120, "/dev/shm has 1 MB left"
    one.run()
    assert one.announced == [
        "domain 120: 1 to 100 are taken (by x)",
        "/dev/shm has 1 MB left: messages use UDP, which is slower",
    ]
    # So that nodes do not use shared memory, of which there is too little.
    assert one.started.variables == {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    started = stage()
    started.run(domain=120)
    assert (started.announced, started.started.variables) == ([], {})


def test_the_end_of_a_run_is_reported_once_and_a_refused_parameter_is_an_error_of_the_scenario(stage, monkeypatch):
    assert stage(error="node law: broken").run().error == "node law: broken"
    monkeypatch.setattr(processes.SystemClock, "set_back", lambda clock: "; the clock was set back")
    assert stage(error="node law: broken").run().error == "node law: broken; the clock was set back"
    assert stage().run().error == ""
    monkeypatch.setattr(processes.SystemClock, "set_back", lambda clock: "")
    idle_one = stage()
    idle_one.status = {"ticks": 0}
    outcome = idle_one.run()
    assert (outcome.error, outcome.epoch) == ("all nodes have ended, and none of them has answered a tick", 0)
    stopped = stage(failing=Stopped(signal.SIGTERM))
    stopped.status = {"ticks": 0}
    outcome = stopped.run()
    assert (outcome.stopped, outcome.error) == (signal.SIGTERM, "")
    assert "stop" in stopped.asked
    refused = stage()
    refused.codes = {"gain": 2}
    with pytest.raises(ScenarioError, match=r"^law: k is no number$"):
        refused.run()
    other = stage()
    other.codes = {"gain": 3}
    assert other.run().error == ""
    again = stage(late=[2])
    outcome = again.run(restart=1)
    assert ("start", ["gain"], True) in again.asked
    assert again.started.returns
    assert {name: s.get("restarts") for name, s in outcome.status.items()} == {"plant": None, "source": None, "gain": 1}
    broken = stage(failing=ValueError("no"))
    with pytest.raises(ValueError, match="no"):
        broken.run()
    assert broken.asked[-1] == "stop"


def test_nodes_are_started_with_their_own_files_by_the_server_or_by_themselves(tmp_path, monkeypatch):
    forked, started, opened = [], [], []

    def fork(package, executable, command, variables, output):
        forked.append((package, executable, command, variables))
        os.write(output, b"x")
        return by_server

    def popen(command, **how):
        started.append((command, how.pop("stdout").name, how))
        return SimpleNamespace(pid=8)

    monkeypatch.setattr(spawning, "start_node", fork)
    monkeypatch.setattr(spawning.subprocess, "Popen", popen)
    monkeypatch.setattr(spawning, "find_executable", lambda package, executable: tmp_path / package / executable)
    monkeypatch.setattr(os, "pidfd_open", lambda pid: opened.append(pid) or 9)
    rig = rig_of(make_scenario(BASIC, 0.5))
    members = {m.name: m for m in rig.members}
    options = {"run.mode": "lockstep", "run.paused": True}
    run = spawning.Started(rig, 3, tmp_path, options, True, {"A": "1"}, None, False)
    for end in ("status", "shard"):
        (tmp_path / f"gain.{end}").write_text("of a run before")
    by_server = SimpleNamespace(pid=5)
    (child,) = spawning.start(run, [members["gain"]])
    gain = [str(tmp_path / "faultrig" / "gain"), "--ros-args", "-r", "__node:=gain"]
    gain += ["--params-file", str(tmp_path / "gain.params.yaml")]
    assert forked == [("faultrig", "gain", gain, {"A": "1"})]
    assert (child.process, child.end, opened) == (by_server, 9, [5])
    assert (child.log, child.status, child.shard) == tuple(
        tmp_path / f"gain.{end}" for end in ("log", "status", "shard")
    )
    assert not child.status.exists()
    assert not child.shard.exists()
    content = (tmp_path / "gain.params.yaml").read_text()
    for line in (f'run.shard: "{child.shard}"', f'run.status: "{child.status}"', "run.paused: true", "run.seed: 3"):
        assert line in content
    assert "run.again" not in content
    by_server = None
    spawning.start(run, [members["gain"]])
    assert child.log.read_text() == "x"  # the log is that of this start only
    ((command, log, how),) = started
    assert (command, log) == (gain, str(child.log))
    assert how == {
        "stdin": subprocess.DEVNULL,
        "stderr": subprocess.STDOUT,
        "env": {"A": "1"},
        "process_group": 0,
        "preexec_fn": spawning._die_with_parent,
    }
    child.shard.write_text("what it said")
    spawning.start(run._replace(record=False), [members["gain"]], again=True)
    assert child.log.read_text() == "xx"  # appended to the log of the node that has died
    assert (tmp_path / "gain.shard.died").read_text() == "what it said"
    content = (tmp_path / "gain.params.yaml").read_text()
    for line in ('run.shard: ""', f'run.again: "{tmp_path}"', "run.paused: false"):
        assert line in content
    both = spawning.start(run, [members["plant"], members["source"]])
    assert [c.log.name for c in both] == ["plant+source.log"] * 2
    assert [c.status.name for c in both] == ["plant.status", "source.status"]
    assert forked[-1][:2] == ("softrig_nodes", "container")
    assert forked[-1][2][1:3] == ["faultrig", "plant"]


def test_room_in_shared_memory_is_enough_to_the_byte(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "statvfs", lambda folder: SimpleNamespace(f_bavail=10, f_frsize=375_000))
    assert shared_memory.lacking(3, tmp_path) == ""  # each node needs 1.25 MB
    assert shared_memory.lacking(4, tmp_path) == f"{tmp_path} has 3.8 MB left, 4 nodes take 5.0"
    for text, number in (("7", 7), ("", 0), ("x", 0), ("-1", 0)):
        monkeypatch.setenv("ROS_DOMAIN_ID", text)
        assert shared_memory.domain_id() == number
    for name in (
        "fastrtps_port7411",
        "fastrtps_port7411_el",
        "sem.fastrtps_port9_mutex",
        "fastrtps_port12",
        "fastrtps_1",
    ):
        (tmp_path / name).touch()
    assert shared_memory.numbers(tmp_path) == {7411, 12}
    assert shared_memory.numbers(tmp_path / "none") == set()


def test_a_link_in_place_of_a_lock_is_not_followed(tmp_path):
    for name in ("target", "fastrtps_00aa", "fastrtps_00bb", "fastrtps_00bb_el"):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / "fastrtps_00aa_el").symlink_to(tmp_path / "target")
    assert shared_memory.remove_leftovers(folder=tmp_path) == 2
    assert {p.name for p in tmp_path.iterdir()} == {"target", "fastrtps_00aa", "fastrtps_00aa_el"}


def port_of_fast_dds(at, number=7411, limit=20_000, third=6_666, ago=1e3, size=None):
    """The bytes of a port in shared memory with a description at a place: time of its last check, number, limits."""
    last = round((time.time() - ago) * 1e3)
    described = struct.pack("=qIIIIIII", last, 1, 2, 3, number, 5, limit, third)
    return (bytes(at) + described + bytes(40))[: at + 36 if size is None else size]


def test_the_place_of_the_last_check_of_a_port_is_found_or_nothing_is_written(tmp_path, monkeypatch):
    path = tmp_path / "fastrtps_port7411"
    for segment, place in (
        (port_of_fast_dds(0), 0),
        (port_of_fast_dds(16), 16),
        (port_of_fast_dds(12), -1),  # the entry is not aligned
        (port_of_fast_dds(8, number=7412), -1),
        (port_of_fast_dds(8, third=6_667), -1),
        (port_of_fast_dds(8, limit=0, third=0), -1),
        (port_of_fast_dds(8, ago=2e9), -1),  # a time far from now
        (port_of_fast_dds(8, ago=-2e9), -1),
        (port_of_fast_dds(8, size=43), -1),  # the file is cut
        (struct.pack("=I", 7411) + port_of_fast_dds(12), 16),  # the number of the port occurs at another place, too
    ):
        assert shared_memory.judged(segment, path) == place
        path.write_bytes(segment)
        ears = shared_memory.Ears()
        ears._good = {path: path.stat().st_ino}
        before = path.read_bytes()
        ears._judge()
        after = path.read_bytes()
        changed = [k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a != b]
        if place >= 0:
            assert abs(struct.unpack_from("=q", after, place)[0] / 1e3 - time.time()) < 100.0
            assert all(place <= k < place + 8 for k in changed)
        else:
            assert changed == []


def test_leftovers_are_removed_in_an_unused_domain_and_its_locks_belong_to_the_user(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(domain, "remove_leftovers", asked.append)
    with domain.free_domain() as number:
        assert asked == [number]
        lock = tmp_path / "softrig" / "domains" / f"{number}.lock"
        assert (lock.stat().st_mode & 0o777, lock.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    with domain.free_domain(number):
        assert asked[1:] == [None]  # other nodes may exist in the domain, so its ports stay


def test_the_search_for_a_domain_begins_at_the_process_id_and_wraps_around(monkeypatch):
    """So two runs in a row rarely share one; then the further ones, the highest first."""
    tried = []

    def taken(number):
        tried.append(number)
        raise KeyError

    monkeypatch.setattr(domain, "_open", taken)
    monkeypatch.setattr(os, "getpid", lambda: 298)  # this process starts to search at place 98 of 100
    for busy, first in (
        ({}, 99),
        ({99}, 100),
        ({99, 100}, 1),
        ({*range(1, 101)}, 215),
        ({*range(1, 101), *range(215, 232)}, 101),
    ):
        monkeypatch.setattr(domain, "inhabited", lambda busy=busy: busy)
        with pytest.raises(KeyError), domain.free_domain():
            pass
        assert tried.pop() == first
    with pytest.raises(KeyError), domain.free_domain(17):
        pass
    assert tried == [17]
    monkeypatch.undo()
    monkeypatch.setattr(domain, "udp_ports", lambda: {7399, 7400, 7649, 7650, 65_399})
    assert domain.inhabited() == {-1, 0, 1, 231}


def test_nodes_need_a_loopback_interface_that_is_up(monkeypatch):
    for flags, fits in ((0x49, True), (0x48, False), (0, False)):
        asked = []
        answer = struct.pack("16sH14x", b"lo", flags)
        monkeypatch.setattr(
            domain.fcntl, "ioctl", lambda of, what, name, a=answer, log=asked: log.append((what, name)) or a
        )
        with suppress(RunError) if not fits else nullcontext():
            domain.require_loopback()
            assert fits
        assert asked == [(0x8913, b"lo" + bytes(254))]

    def unknown(*_):
        raise OSError

    monkeypatch.setattr(domain.fcntl, "ioctl", unknown)
    domain.require_loopback()  # in this test the loopback interface has another name


# ---- discovery ----


LINKED = {
    "a plant, a source, a law": BASIC,
    "a second plant": BASIC
    | {
        "second": {
            "executable": "plant",
            "parameters": {"period": 0.02},
            "remap": {"lag/state": "second/state", "lag/applied": "second/applied"},
        }
    },
    "who speaks at times": {"plant": "plant", "burst": "burst", "gain": "burst_gain"},
    "a watcher": BASIC | {"watcher": "watcher"},
    "a plant that is outside": BASIC | {"plant": {"executable": "plant", "external": True}},
    "a law that is outside": BASIC | {"gain": {"executable": "gain", "external": True}},
    "a plant that is outside and commanded by nobody of ours": {
        "plant": {"executable": "plant", "external": True},
        "gain": {"executable": "gain", "external": True},
        "source": "source",
    },
    "a source that is outside and silent at times": {
        "plant": "plant",
        "burst": {"executable": "burst", "external": True},
        "gain": "burst_gain",
    },
    "a late link": {"plant": "plant", "source": "source", "link": "link", "law": "late_gain"},
    "no plant": {"source": "source"},
    "who works for long": BASIC | {"planner": "planner", "watcher": "watcher"},
}


def knows():
    """What nodes are passed beyond the usual: first what all nodes of a rig get, then what each alone gets."""
    for kind, nodes in LINKED.items():
        rig = rig_of(make_scenario(nodes, 0.2))
        entries = {m.name: peers.links(rig, m).model_dump(exclude_defaults=True) for m in rig.members if not m.external}
        first = next(iter(entries.values()))
        alike = (
            {k: v for k, v in first.items() if all(t.get(k) == v for t in entries.values())} if len(entries) > 1 else {}
        )
        yield f"{kind}: {', '.join(f'{k} {v}' for k, v in alike.items() if v not in ([], {}))}"
        for node, about in entries.items():
            yield f"  {node}"
            for name, value in about.items():
                if name == "inputs":
                    for port, way in value.items():
                        yield f"    reads {port}: {', '.join(f'{k} {v}' for k, v in way.items())}"
                elif value not in ([], {}) and name not in alike:
                    yield f"    {name} {value}"


def test_facts_that_nodes_know_of_their_peers_are_as_expected():
    check_expected("peers", knows())
