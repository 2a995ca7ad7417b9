"""The parts of a run in processes, each alone and without a process: ports, profiles, parameters, watching, waiting."""

import functools
import json
import operator
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
import yaml
from conftest import make_scenario
from faultrig import Gain, Lag, Source
from rclpy.parameter import Parameter
from softrig_core import RunError, ScenarioError, rig_of
from softrig_core.block.params import ParameterError
from softrig_core.rig.options import RunOptions
from softrig_nodes import main
from softrig_nodes.processes import (
    children,
    executables,
    fork_server,
    ports,
    processes,
    restarting,
    spawning,
    supervision,
)
from softrig_nodes.processes.children import last_line, read_status, stop
from softrig_nodes.processes.guests import CYCLONE, UNSEEN, Guests
from softrig_nodes.processes.placement import Placement
from softrig_nodes.processes.restarting import Restarts, check_restart
from softrig_nodes.processes.stopping import Stopped
from softrig_nodes.processes.supervision import SystemClock, idle
from softrig_nodes.ros import profile

BASIC = {"plant": "plant", "source": "source", "gain": "gain"}

# ---- port numbers ----


@pytest.mark.parametrize(
    ("domain", "now", "pid", "used", "others", "base", "user"),
    [
        # The search for a discovery port begins 400 below the base, that for a user port at number 76 of the domain.
        (3, 0.0, 7, (), 0, 6607, 76),
        (3, 0.0, 57, (), 0, 6607, 76),  # each process begins at one of fifty places
        (3, 0.0, 49, (), 0, 6649, 76),
        (3, 18.0, 7, (), 0, 6607, 76),  # the sequence repeats after 18 s
        # An eighth of 18 s later, the search begins fifty ports (and an eighth of 112) further.
        (3, 2.25, 7, (), 0, 6657, 90),
        (3, 17.99, 0, (), 0, 6950, 187),
        (3, 9.0, 7, (6407, 6408), 0, 6809, 132),
        (3, 0.0, 7, (8226, 8227), 0, 6607, 78),
        (3, 0.0, 7, (8226,), 1, 6607, 76),  # participant 1 listens two ports further, at 8228
        (3, 0.0, 7, (8228,), 1, 6607, 77),
        (3, 0.0, 7, (8230,), 2, 6607, 77),
        (3, 17.99, 0, (8337,), 0, 6950, 76),  # after the last port the search continues with the first
        (3, 0.0, 7, (*range(6200, 6600), *range(8226, 8338)), 0, 6607, 76),  # no port is free, so the first one is used
        (0, 0.0, 7, (7476,), 0, 6607, 77),
        (231, 0.0, 7, (65226,), 0, 6607, 77),
        (232, 9.0, 7, (), 0, 6807, 11),  # the last domain has no free range, so the standard's ports hold
    ],
)
def test_a_participant_has_ports_that_no_process_had_lately(domain, now, pid, used, others, base, user, monkeypatch):
    monkeypatch.setattr(os, "getpid", lambda: pid)
    first = 7400 + 250 * domain
    monkeypatch.setattr(ports, "udp_ports", lambda: {first + 10 + 2 * k for k in range(others)} | {first + 1})
    assert ports.chosen(domain, used, now) == {
        "portBase": base,
        "offsetd0": 7400 - base,
        "offsetd1": 7410 - base,
        "offsetd2": 7401 - base,
        "offsetd3": 7400 - base + user,
    }
    assert ports.of_domain(domain) == range(first, first + 250)


def test_ports_that_are_bound_are_seen():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one, ExitStack() as stack:
        one.bind(("127.0.0.1", 0))
        bound = {one.getsockname()[1]}
        with suppress(OSError):  # skipped without IPv6
            two = stack.enter_context(socket.socket(socket.AF_INET6, socket.SOCK_DGRAM))
            two.bind(("::1", 0))
            bound.add(two.getsockname()[1])
        assert bound <= ports.udp_ports()
    assert set(ports.chosen(5)) == {"portBase", "offsetd0", "offsetd1", "offsetd2", "offsetd3"}


# ---- profiles of Fast DDS ----

SPACE = {"d": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
CHOSEN = {"portBase": 6607, "offsetd0": 793, "offsetd1": 803, "offsetd2": 794, "offsetd3": 869}


@pytest.fixture
def fixed(monkeypatch):
    """A process that gets fixed ports and finds no port file in its way."""
    asked = []
    monkeypatch.setattr(profile, "chosen", lambda domain, used: asked.append((domain, used)) or CHOSEN)
    monkeypatch.setattr(profile, "numbers", lambda: {7})
    monkeypatch.setattr(profile, "clear_ports", lambda domain: asked.append(domain))
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    return asked


@pytest.mark.parametrize("exclusive", [False, True])
@pytest.mark.parametrize("bare", [False, True], ids=["ours", "bare"])
def test_a_participant_gets_its_ports_and_in_a_container_the_property(exclusive, bare, fixed):
    profile_text = executables.PROFILE.read_bytes()
    if bare:
        profile_text = b"<profiles><participant/></profiles>"
    root = ElementTree.fromstring(profile.own_profile(profile_text, exclusive=exclusive))
    space = "" if bare else "d:"
    (participant,) = root.iter(f"{{{SPACE['d']}}}participant" if not bare else "participant")
    (rtps,) = participant.findall(f"{space}rtps", SPACE)
    (result,) = rtps.findall(f"{space}port", SPACE)
    assert {e.tag.rpartition("}")[2]: e.text for e in result} == {k: str(n) for k, n in CHOSEN.items()}
    entries = [
        {e.tag.rpartition("}")[2]: e.text for e in one}
        for one in rtps.findall(f"{space}propertiesPolicy/{space}properties/{space}property", SPACE)
    ]
    assert entries == ([{"name": "fastdds.ignore_local_endpoints", "value": "true"}] if exclusive else [])
    assert fixed == [(42, {7})]
    if not bare:
        assert rtps.find("d:builtin/d:discovery_config/d:leaseDuration/d:sec", SPACE).text == "3"


def test_ports_and_properties_of_a_users_profile_stay(fixed):
    rtps = "<rtps><port><portBase>1</portBase></port><propertiesPolicy><properties><property><name>a</name></property>"
    profile_text = f"<profiles><participant>{rtps}</properties></propertiesPolicy></rtps></participant></profiles>"
    root = ElementTree.fromstring(profile.own_profile(profile_text.encode(), exclusive=True))
    assert [e.text for e in root.iter("portBase")] == ["1"]
    assert [e.text for e in root.iter("name")] == ["a", "fastdds.ignore_local_endpoints"]
    assert len([*root.iter("properties")]) == 1
    for text, message in ((b"<a", "not XML: "), (b"<a/>", "no participant in the profile, expected one")):
        with pytest.raises(ValueError, match=f"FASTRTPS_DEFAULT_PROFILES_FILE: {message}"):
            profile.own_profile(text)


@pytest.mark.parametrize("profile_of", [None, "ours", "theirs"])
def test_while_a_participant_starts_its_profile_is_that_of_the_environment(profile_of, fixed, tmp_path, monkeypatch):
    user_file = tmp_path / "given.xml"
    user_file.write_bytes(executables.PROFILE.read_bytes())
    monkeypatch.delenv(profile.VARIABLE, raising=False)
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    if profile_of:
        monkeypatch.setenv(profile.VARIABLE, str(user_file if profile_of == "theirs" else executables.LOOPBACK))
    before = os.environ.get(profile.VARIABLE)
    # A lease of 3 s by default; for a longer silence, a longer one.
    for silence, lease in ((None, "3"), (7.2, "3" if profile_of == "theirs" else "10")):
        with profile.joining(silence=silence):
            file = Path(os.environ[profile.VARIABLE])
            assert (file.name[:8], file.suffix) == ("softrig-", ".xml")
            root = ElementTree.parse(file).getroot()
            assert file.read_bytes().startswith(b"<?xml ")
            assert root.find(".//d:leaseDuration/d:sec", SPACE).text == lease
            assert root.find(".//d:port", SPACE) is not None
            assert (root.find(".//d:userTransports", SPACE) is None) is (profile_of == "theirs")
            assert root.find(".//d:property", SPACE) is None
        assert os.environ.get(profile.VARIABLE) == before
        assert not file.exists()
    assert fixed[::2] == [42, 42]  # removed first, because ports left there would block the node
    with suppress(KeyError), profile.joining(exclusive=True):
        assert ElementTree.parse(os.environ[profile.VARIABLE]).getroot().find(".//d:property", SPACE) is not None
        raise KeyError
    assert os.environ.get(profile.VARIABLE) == before


@pytest.mark.parametrize("reach", ["LOCALHOST", "SUBNET"])
@pytest.mark.parametrize("asked", ["", "UDPv4"])
def test_without_room_in_shared_memory_no_transport_uses_it(reach, asked, fixed, monkeypatch):
    variables = {"ROS_AUTOMATIC_DISCOVERY_RANGE": reach, profile.TRANSPORTS: asked}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv(profile.VARIABLE, raising=False)
    monkeypatch.setattr(profile, "lacking", lambda nodes: "" if asked else f"no room for {nodes}")
    with profile.joining():
        root = ElementTree.parse(os.environ[profile.VARIABLE]).getroot()
        assert os.environ[profile.TRANSPORTS] == "UDPv4"  # this variable applies if the profile sets no transports
        # rmw_fastrtps adds shared memory to every profile if the discovery range is LOCALHOST.
        assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == {"LOCALHOST": "SYSTEM_DEFAULT"}.get(reach, reach)
    local = reach == "LOCALHOST"
    assert [e.text for e in root.iter(f"{{{profile.SPACE}}}transport_id")] == ["softrig_loopback"] * 2 * local
    assert [e.text for e in root.iter(f"{{{profile.SPACE}}}type")] == ["UDPv4"] * local
    assert {name: os.environ[name] for name in variables} == variables
    assert profile.VARIABLE not in os.environ


def test_a_node_is_reachable_from_other_hosts_only_on_request(monkeypatch, tmp_path):
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", *executables.NETWORK, "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.delenv(name, raising=False)
    for name, value, reach in (
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET", True),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "SYSTEM_DEFAULT", True),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST", False),
        ("ROS_STATIC_PEERS", "1.2.3.4", True),
        ("ROS_DISCOVERY_SERVER", "1.2.3.4:11811", True),
        ("ROS_STATIC_PEERS", "", False),
    ):
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            name = "fastdds_profile.xml" if reach else "fastdds_loopback.xml"
            assert executables.default_profile().name == executables.given_profile().name == name
            patch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "/other.xml")
            assert executables.given_profile() == Path("/other.xml")
    always_set = ("ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "ROS_LOG_DIR", "PYTHONUNBUFFERED", "OMP_NUM_THREADS")
    for name in (*always_set, "OPENBLAS_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("OTHER", "kept")
    for discovery, file in (("LOCALHOST", executables.LOOPBACK), ("SUBNET", executables.PROFILE)):
        result = executables.environment(17, tmp_path, discovery=discovery)
        assert {k: v for k, v in result.items() if os.environ.get(k) != v} == {
            "ROS_DOMAIN_ID": "17",
            "ROS_AUTOMATIC_DISCOVERY_RANGE": discovery,
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            "ROS_LOG_DIR": str(tmp_path / "log"),
            "PYTHONUNBUFFERED": "1",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(file),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        assert (result["OTHER"], "ROS_LOCALHOST_ONLY" in result) == ("kept", False)
    file = Path(executables.environment(17, tmp_path, silence=10.0)["FASTRTPS_DEFAULT_PROFILES_FILE"])
    assert file == tmp_path / "profile.xml"
    assert "<leaseDuration><sec>12</sec></leaseDuration>" in file.read_text()
    assert file.read_text().count("<sec>") == executables.LOOPBACK.read_text().count("<sec>")
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "/other.xml")
    assert executables.environment(17, tmp_path, silence=10.0)["FASTRTPS_DEFAULT_PROFILES_FILE"] == "/other.xml"


def test_a_missing_executable_is_reported_with_the_existing_ones(tmp_path, monkeypatch):
    folder = tmp_path / "lib" / "own"
    folder.mkdir(parents=True)
    for name, mode in (("plant", 0o755), ("notes", 0o644)):
        (folder / name).touch(mode)
    (folder / "sub").mkdir()
    monkeypatch.setattr(executables, "prefixes", lambda: [Path("/nowhere"), tmp_path])
    assert executables.find_executable("own", "plant") == folder / "plant"
    for package, executable, text in (
        ("own", "plent", "package own has no executable 'plent' (did you mean 'plant'?); it has notes, plant"),
        ("own", "notes", "package own has no executable 'notes' (did you mean 'notes'?); it has notes, plant"),
        ("own", "sub", "package own has no executable 'sub'; it has notes, plant"),
        (
            "owm",
            "plant",
            "package 'owm' has no executables here (did you mean 'own'?); one of your own is in the folder"
            " that --workspace DIR names before the verb",
        ),
    ):
        with pytest.raises(ScenarioError) as error:
            executables.find_executable(package, executable)
        assert str(error.value) == text


# ---- what a node is started with ----


def test_nodes_share_processes_as_their_containers_say_and_only_requested_ones_start():
    rig = rig_of(make_scenario(BASIC | {"watcher": {"executable": "watcher", "external": True}}))

    def names(*text):
        return [[m.name for m in group] for group in spawning.groups(rig, *text)]

    assert names(()) == [["plant"], ["source"], ["gain"]]
    assert names([["gain", "plant"], ["watcher"]]) == [["gain", "plant"], ["source"]]
    assert names([["gain", "plant"], ["gain", "source"]]) == [["gain", "plant"], ["source"]]
    assert names([["gain", "plant"]], ("plant", "source")) == [["plant"], ["source"]]
    for placement, word, shared in (
        (Placement(), "processes", ()),
        (Placement("container"), "container", [["plant", "source", "gain", "watcher"]]),
        (Placement("container", "realtime"), "container, realtime", [["plant", "source", "gain", "watcher"]]),
        (Placement(clock="realtime"), "realtime", ()),
        (Placement("inprocess"), "inprocess", ()),
        (Placement(containers=[["gain"]]), "processes", [["gain"]]),
        (Placement("container", containers=()), "container", ()),
    ):
        assert (str(placement), [*map(list, placement.shared(rig))]) == (word, [*map(list, shared)])
    two = rig_of(make_scenario(BASIC, containers=[["plant", "gain"]]))
    assert Placement("container").shared(two) == (("plant", "gain"),)
    assert Placement().shared(two) == ()


def test_a_node_is_passed_its_changed_parameters_and_how_it_runs(tmp_path):
    plant = {"executable": "plant", "parameters": {"gain": 2.5}, "remap": {"lag/applied": "other"}}
    rig = rig_of(make_scenario(BASIC | {"plant": plant}, 0.5, timeout=7.0, start_timeout=31.0))
    member = rig.members[0]
    result = spawning.node_parameters(rig, member, 9, "realtime")
    links = json.loads(result.pop("run.links"))
    assert result == {
        "gain": 2.5,
        "run.mode": "realtime",
        "run.seed": 9,
        "run.duration": 0.5,
        "run.timeout": 7.0,
        "run.start_timeout": 31.0,
        "run.changes": "",
    }
    assert (links["returns"], links["public"], links["recorders"]) == (False, False, [])
    again = spawning.node_parameters(rig, member, 9, "lockstep", recorders=("bag",), returns=True)
    links = json.loads(again["run.links"])
    assert (links["returns"], links["public"], links["recorders"], links["followers"]) == (True, True, ["bag"], [])
    parameters = {m.name: {"k": 1, "text": 'a "b"', "list": [1.0, 2.0]} for m in rig.members}
    arguments = spawning.container_arguments(rig.members[:2], parameters, tmp_path, {"/clock": "/c"})
    file = tmp_path / "plant.params.yaml"
    assert arguments == [
        *("faultrig", "plant", "--ros-args", "-r", "__node:=plant", "--params-file", str(file)),
        *("-r", "lag/applied:=other", "-r", "/clock:=/c", "--"),
        *("faultrig", "source", "--ros-args", "-r", "__node:=source"),
        *("--params-file", str(tmp_path / "source.params.yaml"), "-r", "/clock:=/c"),
    ]
    assert yaml.safe_load(file.read_text()) == {"/**": {"ros__parameters": parameters["plant"]}}


def test_the_longer_recording_of_a_node_that_dies_twice_is_kept(tmp_path):
    stem, shard, died = tmp_path / "a", tmp_path / "a.shard", tmp_path / "a.shard.died"
    spawning._keep_record(stem)
    assert not died.exists()
    for written, kept in (("12", "12"), ("1", "12"), ("34", "12"), ("123", "123")):
        shard.write_text(written)
        spawning._keep_record(stem)
        assert died.read_text() == kept


# ---- watching ----


class Process:
    """A process that the test controls."""

    def __init__(self, pid=1, stubborn=()):
        self.pid, self.returncode, self.sent, self.stubborn = pid, None, [], stubborn

    def poll(self):
        return self.returncode

    def send_signal(self, number):
        self.sent.append(number)
        if number not in self.stubborn and number != signal.SIGCONT:
            self.returncode = -number

    def wait(self, timeout):
        self.sent.append(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("x", timeout)


class Child(SimpleNamespace):
    def __init__(self, name, pid=1, **more):
        super().__init__(member=SimpleNamespace(name=name), process=Process(pid), end=pid, log=Path("/x"), status=name,
                         held=False, interrupted=False, **more)  # fmt: skip


def test_a_process_that_does_not_end_is_asked_again_and_killed(monkeypatch):
    monkeypatch.setattr(children, "time", SimpleNamespace(monotonic=lambda: 5.0))
    ended, kind, deaf, twin = (Child(name, pid) for pid, name in enumerate(("ended", "kind", "deaf", "twin"), 1))
    ended.process.returncode = 3
    deaf.process.stubborn = (signal.SIGINT, signal.SIGTERM)
    twin.process = kind.process  # both nodes are in one container
    stop([ended, kind, deaf, twin])
    assert [c.interrupted for c in (ended, kind, deaf, twin)] == [False, True, True, True]
    assert ended.process.sent == []
    assert kind.process.sent == [signal.SIGCONT, signal.SIGINT, 3.0]
    steps = [[signal.SIGCONT, number, 3.0] for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)]
    assert deaf.process.sent == functools.reduce(operator.iadd, steps, [])
    stop([ended])


def test_the_status_of_a_node_is_read_from_its_files(tmp_path):
    assert read_status(tmp_path / "none") == {}
    (tmp_path / "status").write_text('{"t": 1}')
    assert read_status(tmp_path / "status") == {"t": 1}
    log = tmp_path / "log"
    for text, last in (("", ""), ("a\n\nb c\n \n", "b c"), ("a", "a")):
        log.write_text(text)
        assert last_line(log) == last
    log.write_bytes(b"\xff\n")
    assert last_line(log) == "\ufffd"
    assert not children.is_held(SimpleNamespace(process=SimpleNamespace(pid=os.getpid())))
    assert not children.is_held(SimpleNamespace(process=SimpleNamespace(pid=0)))


class Watched:
    """A run of three nodes as its supervisor sees it; at each check a tenth of a second has passed."""

    def __init__(self, monkeypatch, realtime=False, most=0):
        self.now, self.realtime, self.progress, self.script = 100.0, realtime, [], {}
        self.children = [Child(name, pid) for pid, name in enumerate(("plant", "law", "source"), 1)]
        self.states = {c.member.name: {"t": 0, "state": "running"} for c in self.children}
        self.restarts = SimpleNamespace(
            most=most, counts={}, check=lambda children: self.failed, why=lambda member: "; again"
        )
        self.announced = []
        self.domains = []
        monkeypatch.setattr(supervision, "DeadLocks", lambda: SimpleNamespace(release=self.domains.append))
        self.failed, self.looks, self.stopping, self.logs = [], [], SimpleNamespace(number=0, check=lambda: None), {}
        self.rig = SimpleNamespace(scenario=SimpleNamespace(start_timeout=30.0, timeout=10.0, duration=5.0))
        clock = SimpleNamespace(monotonic=lambda: self.now, time=lambda: 1000.0 + self.now, sleep=self._pass)
        monkeypatch.setattr(supervision, "time", clock)
        monkeypatch.setattr(supervision, "select", SimpleNamespace(select=self._select))
        monkeypatch.setattr(supervision, "read_status", lambda name: self.states[name])
        monkeypatch.setattr(supervision, "is_held", lambda child: child.held)
        monkeypatch.setattr(supervision, "last_line", lambda log: self.logs.get("last", ""))
        monkeypatch.setattr(supervision, "starter", lambda rig: self.children[0].member)

    def _pass(self, seconds):
        self.now = round(self.now + seconds, 6)

    def _select(self, ends, *_):
        assert ends == [c.end for c in self.children if c.process.returncode is None]
        assert _ == ([], [], 0.1)
        self._pass(0.1)
        for at in sorted(self.script):
            if at <= self.now - 100.0 + 1e-9:
                self.script.pop(at)()
        assert self.now < 1000.0, "it would go on for ever"

    def at(self, seconds, change):
        self.script[seconds] = change
        return self

    def says(self, name, **what):
        return lambda: self.states.update({name: self.states[name] | what})

    def ends(self, name, code=0, state="done"):
        def end():
            if code == 0:
                self.says(name, state=state)()
            next(c for c in self.children if c.member.name == name).process.returncode = code

        return end

    def run(self):
        """The result, and after how many seconds."""
        text = supervision.supervise(
            self.rig, self.children, self.progress.append, SimpleNamespace(check=self.looks.append), self.realtime,
            self.stopping, self.restarts, SimpleNamespace(update=lambda: None), 7, self.announced.append)  # fmt: skip
        assert set(self.domains) == {7}
        return text, round(self.now - 100.0, 1)


LOST = "node {} did not reach the end of the run within 10 s after it"


@pytest.fixture
def watched(monkeypatch):
    return lambda **options: Watched(monkeypatch, **options)


def test_a_call_that_does_not_return_is_reported_once_when_the_rig_waits(watched):
    run = watched()
    line = "law: `update` at t = 0.1 s has not returned for 5 s; Ctrl-C ends the run (law.py, line 3)"
    run.at(1.0, lambda: run.logs.update(last=line)).at(1.9, lambda: run.announced.append("until then nothing"))
    all_end(run, 9.0).run()
    assert run.announced == ["until then nothing", line]
    run = all_end(watched(), 9.0)
    for k in range(80):
        run.at(k / 10 + 0.05, run.says("plant", t=k))
    run.logs["last"] = line
    run.run()
    assert run.announced == []  # no error is announced, as the run continues


def all_end(run, seconds):
    return run.at(seconds, lambda: [run.ends(child.member.name)() for child in run.children])


def test_a_run_that_ends_in_order_reports_the_progress_of_its_plant(watched):
    run = watched()
    for at, t in ((0.2, 5), (0.4, 5), (0.7, 9)):
        run.at(at, run.says("plant", t=t))
    run.at(0.3, run.says("law", t=100))
    assert all_end(run, 50.0).run() == ("", 50.0)  # while all nodes run, none of them is late
    assert run.progress == [0, 5, 9]
    assert run.looks[0] == {name: {"t": 0, "state": "running"} for name in ("plant", "law", "source")}


def test_a_node_whose_code_ends_its_process_with_0_before_its_last_tick_is_named(watched):
    run = watched()
    run.at(1.0, run.says("law", t=500_000_000)).at(2.0, run.ends("law", state="running"))
    assert run.run() == ("code of node law after t = 0.5 s has ended its process with status 0", 2.0)
    run = watched()
    run.at(1.0, run.says("law", left_early=True)).at(2.0, run.ends("law", state="running"))
    # The node was killed by a signal, which is reported at the end.
    assert run.run() == (LOST.format("plant, source"), 12.0)


def test_in_lockstep_remaining_nodes_have_the_timeout_from_the_last_progress(watched):
    run = watched().at(1.0, lambda: None)
    run.at(2.0, run.ends("law"))
    assert run.run() == (LOST.format("plant, source"), 12.0)
    run = watched()
    run.at(2.0, run.ends("law")).at(8.0, run.says("plant", t=7)).at(9.0, run.says("source", t=7))
    assert run.run() == (LOST.format("plant, source"), 18.1)
    run = watched()
    run.at(2.0, run.ends("law")).at(8.0, run.says("source", busy=True)).at(20.0, run.says("source", busy=False))
    assert run.run() == (LOST.format("plant, source"), 30.0)
    run = watched()
    run.at(2.0, lambda: setattr(run.children[1], "held", True))
    asleep = "node law: its process is stopped (SIGSTOP); it was waited for until the timeout"
    assert run.run() == (asleep, 12.0)


def test_a_node_without_a_status_has_the_time_of_the_start(watched):
    run = watched()
    run.states["law"] = run.states["source"] = {}
    run.at(29.0, run.says("source", t=0))
    assert run.run() == ("node law has reported nothing within 30 s of its start", 30.1)
    run = watched()
    run.states["law"] = {}
    # The node is restarted at 120 s.
    run.restarts.check = lambda children: run.now >= 120.0 and run.restarts.counts.update(law=1)
    assert run.run()[1] == 50.1


def test_in_real_time_all_nodes_have_the_timeout_after_the_end_of_the_run(watched):
    run = watched(realtime=True)
    run.at(3.0, run.says("plant", epoch=round((1000.0 + 100.0 + 3.0 + 2.0) * 1e9)))  # 2 s later than now
    assert run.run() == (LOST.format("plant, law, source"), 20.1)
    run = watched(realtime=True)
    run.at(3.0, run.says("plant", epoch=1)).at(6.0, run.says("plant", held=True)).at(9.0, run.says("plant", held=False))
    assert run.run() == (LOST.format("plant, law, source"), 24.0)
    run = watched(realtime=True)
    run.at(3.0, run.says("plant", epoch=10**30))  # the clock was changed, so the limit is that of a start
    assert run.run() == (LOST.format("plant, law, source"), 48.1)


def test_with_restarts_a_rig_without_progress_is_lost_after_the_time_of_a_start(watched):
    run = watched(most=1)
    run.at(4.0, run.says("law", t=5)).at(6.0, run.says("source", state="done")).at(7.0, run.says("law", ticks=9))
    run.at(8.0, run.says("law", busy=True)).at(9.0, run.says("law", busy=False))
    text, after = run.run()
    assert (text, after) == (LOST.format("plant, law, source"), 39.0)


def test_a_signal_ends_the_watch(watched):
    run = watched()

    def check():
        if run.now > 101.0:
            raise Stopped(signal.SIGTERM)

    run.stopping.check = check
    with pytest.raises(Stopped):
        run.run()


def test_failed_nodes_are_named_with_the_reason(watched):
    def outcome(codes, states, last="", most=0, later=()):
        run = watched(most=most)
        run.logs["last"] = last
        for child, code in zip(run.children, codes, strict=True):
            child.process.returncode = code
            run.states[child.member.name] = states.get(child.member.name, {"state": "running"})
        run.failed = [c for c in run.children if c.process.returncode not in (None, 0)]
        original = run._pass

        def passing(seconds):
            original(seconds)
            for name, at, code in later:
                if run.now - 100.0 >= at:
                    run.ends(name, code)()

        supervision.time.sleep = passing
        return run.run()

    failed = {"state": "failed", "error": "nothing on x"}
    assert outcome((None, 3, None), {"law": failed}) == ("node law: nothing on x", 1.5)
    assert outcome((0, 3, 0), {"law": failed}) == ("node law: nothing on x", 0.0)
    assert outcome((0, 3, 0), {}, last="law: broken") == ("node law: broken", 0.0)
    assert outcome((0, 3, 0), {}) == ("node law ended with status 3", 0.0)
    assert outcome((None, -9, None), {"law": {"t": 1_500_000_000}}) == (
        "node law was killed by SIGKILL after t = 1.5 s; again",
        0.0,
    )
    waits = {"law": failed | {"waits_for": ["plant"]}, "plant": failed | {"error": "broken", "waits_for": []}}
    assert outcome((3, 3, 0), waits) == ("node plant: broken", 0.0)
    late = (("plant", 0.5, 3),)
    assert outcome((None, 3, 0), waits, later=late)[0] == "node plant: broken"
    assert outcome((None, 3, 0), waits)[0] == "node plant: broken"  # the node has reported an error but still runs
    done = {"law": {"state": "done"}, "plant": failed, "source": {"state": "done"}}
    assert outcome((3, 3, 3), done) == ("node plant: nothing on x", 0.0)
    assert outcome((3, 0, 3), {"plant": failed, "source": failed | {"error": "b"}})[0] == (
        "node plant: nothing on x; node source: b"
    )


def test_a_system_clock_that_is_set_back_is_reported(monkeypatch):
    wall = SimpleNamespace(ahead=500.0)
    monkeypatch.setattr(supervision, "time", SimpleNamespace(time=lambda: 7.0 + wall.ahead, monotonic=lambda: 7.0))
    clock = SystemClock()
    assert clock.set_back() == ""
    for ahead in (600.0, 599.0, 600.0):
        wall.ahead = ahead
        assert clock.set_back() == ""  # a change by one second does not count
    wall.ahead = 570.0
    clock.update()
    wall.ahead = 640.0
    assert clock.set_back() == "; the system's clock was set back by 30 s meanwhile, and Fast DDS waits by it"
    assert idle({"a": {"ticks": 0}, "b": {}}) == "all nodes have ended, and none of them has answered a tick"
    assert idle({"a": {"ticks": 0}, "b": {"ticks": 1}}) == ""


# ---- restarted nodes ----


def test_a_node_that_was_killed_is_restarted_when_all_others_wait(tmp_path, monkeypatch):
    """After two of their status files with the same tick, and without work in progress."""
    messages = []
    nodes = [Child(name, pid) for pid, name in enumerate(("dead", "one", "two"), 1)]
    written = {}
    for node in nodes:
        node.status = SimpleNamespace(
            stat=lambda n=node: SimpleNamespace(st_mtime_ns=written[n.member.name][0]), name=node.member.name
        )
    monkeypatch.setattr(restarting, "read_status", lambda path: written[path.name][1])
    started = []

    def again(k):
        started.append(k)
        nodes[k].process.returncode = None

    restarts = Restarts(2, again, messages.append)
    nodes[0].process.returncode = -9

    def look(**states):
        written.update(dead=(0, {}), **states)
        assert restarts.check(nodes) == []
        return len(started)

    assert look(one=(1, {"ticks": 5}), two=(1, {"ticks": 4})) == 0
    # One of the nodes has not written its status since.
    assert look(one=(1, {"ticks": 5}), two=(2, {"ticks": 4})) == 0
    assert look(one=(2, {"ticks": 6}), two=(3, {"ticks": 4})) == 0  # one node has advanced
    assert look(one=(3, {"ticks": 6, "busy": True}), two=(3, {"ticks": 4})) == 0
    assert look(one=(4, {"ticks": 6}), two=(3, {"ticks": 4})) == 1
    assert restarts.counts == {"dead": 1}
    assert messages == ["node dead was killed by SIGKILL after t = 0 s; it is started again (1 of 2)"]
    assert restarts.why(nodes[0].member) == "; it was started again 1 of 2 times"
    nodes[0].process.returncode = -11
    nodes[1].process.returncode = 0  # a node that has ended need not have paused
    assert look(one=(9, {}), two=(3, {"ticks": 4})) == 1  # the next check counts from one again
    assert look(one=(9, {}), two=(4, {"ticks": 4})) == 2
    nodes[0].process.returncode = -9
    assert restarts.check(nodes) == [nodes[0]]
    nodes[0].process.returncode = 3
    assert Restarts(9, again).check(nodes) == [nodes[0]]
    assert Restarts(0, again).check(nodes) == [nodes[0]]
    assert Restarts(0, again).why(nodes[0].member) == ""
    assert Restarts(1, again).why(nodes[0].member) == "; it was started again 0 of 1 times"


def test_impossible_restarts_are_refused():
    rig = rig_of(make_scenario(BASIC))
    guest = rig_of(make_scenario(BASIC | {"gain": {"executable": "gain", "external": True}}))
    check_restart(rig, Placement(restart=1))
    check_restart(guest, Placement("container", "realtime", record=False))  # without `restart` any rig is accepted
    whole = "--restart: expected a run in lockstep whose nodes have a process each, all on this host"
    for made, placement, text in (
        (rig, Placement(clock="realtime", restart=1), whole),
        (rig, Placement("container", restart=1), whole),
        (rig, Placement(containers=[["plant", "gain"]], restart=1), whole),
        (rig, Placement(only=("plant",), restart=1), whole),
        (guest, Placement(restart=1), "--restart: gain is an outside node, whose past messages are unknown"),
        (
            rig,
            Placement(restart=1, record=False),
            "--restart: a node restarts from the recordings of the others, expected --restart without --no-record",
        ),
    ):
        with pytest.raises(ScenarioError) as error:
            check_restart(made, placement)
        assert str(error.value) == text


# ---- external nodes ----


def test_missing_external_nodes_are_reported_with_what_to_do_and_present_ones_are_logged(monkeypatch):
    nodes = BASIC | {
        "gain": {"executable": "gain", "external": True},
        "watcher": {"executable": "watcher", "external": True},
    }
    messages = []
    guests = Guests(rig_of(make_scenario(nodes)), messages.append)
    guests.invite(7)
    assert messages.pop().splitlines() == [
        "waiting for gain (without limit, or for --wait S; Ctrl-C ends); in another terminal:",
        "  export ROS_DOMAIN_ID=7 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
        "  gain must publish lag/command (sensor_msgs/msg/JointState, u/effort)",
        "  gain can read lag/state (sensor_msgs/msg/JointState)",
        "  gain can read lag/reference (trajectory_msgs/msg/JointTrajectory)",
        "  watcher can read lag/state (sensor_msgs/msg/JointState)",
        "  watcher can read lag/command (sensor_msgs/msg/JointState)",
    ]

    def look(**states):
        before = len(messages)
        guests.check(states)
        return messages[before:]

    lacks = {"lacking": ["lag/command"]}
    assert look(plant={"refused": {"lag/command": [1, "bad"]}}, source={}) == [
        "plant refused a message on lag/command: bad"
    ]
    assert look(plant={"refused": {"lag/command": [2, "worse"]}}, source=lacks) == []
    wrong = {"reports": {"type of lag/command": [2, "lag/command exists with type x", 1], "other": [2, "no", 1]}}
    assert look(plant=lacks | wrong, source=lacks) == ["lag/command exists with type x"]
    stray = {
        "/lag/comand": [["sensor_msgs/msg/JointState", "/theirs"]],
        "/lag/state": [["sensor_msgs/msg/JointState", "/theirs"]],  # an external publisher of a topic of the rig
        "/tf": [["tf2_msgs/msg/TFMessage", "/theirs"]],
        "/plant/more": [["sensor_msgs/msg/JointState", "/plant"]],  # a topic of a node of softrig
    }
    text = "/theirs publishes /lag/comand, which nobody in the rig reads; lag/command is awaited from gain"
    assert look(plant=lacks | {"published": stray}, source=lacks) == [text]
    assert look(plant=lacks | {"published": stray}, source=lacks) == []
    later = time.monotonic() + 2 * UNSEEN
    monkeypatch.setattr("softrig_nodes.processes.guests.time", SimpleNamespace(monotonic=lambda: later))
    (hint,) = look(plant=lacks, source=lacks)
    assert hint.startswith("gain: not seen for 10 s; where it runs on Cyclone DDS: export CYCLONEDDS_URI='<CycloneDDS>")
    assert CYCLONE in (Path(__file__).parents[2] / "ros_pkgs/softrig_bringup/doc/set_up.md").read_text()
    assert look(plant=lacks, source=lacks) == []
    assert look(plant={"lacking": []}, source={"lacking": []}) == ["gain is there"]
    assert look(plant={"lacking": []}, source={"lacking": []}) == []
    Guests(rig_of(make_scenario(nodes)), None).invite(7)
    nobody = Guests(rig_of(make_scenario(BASIC)), messages.append)
    nobody.invite(7)
    nobody.check({"plant": {"refused": {"lag/command": [1, "bad"]}}})
    assert messages[-1] == "gain is there"


def test_a_fork_server_serves_settings_that_a_node_reads_when_it_starts():
    base = {"A": "1", "ROS_DOMAIN_ID": "3", "COLUMNS": "80"}
    assert fork_server._key(base) == fork_server._key(base | {"ROS_DOMAIN_ID": "4", "LINES": "5", "COLUMNS": "9"})
    assert fork_server._key(base) != fork_server._key(base | {"A": "2"})
    assert fork_server._key(base) != fork_server._key(base | {"B": "2"})
    server = SimpleNamespace(_owner=os.getpid(), _key=fork_server._key(base))
    serves = fork_server.ForkServer.serves
    assert serves(server, base | {"ROS_LOG_DIR": "/x"})
    assert not serves(server, base | {"A": "2"})
    server._owner = -1
    assert not serves(server, base)


def test_an_answer_of_the_server_belongs_to_the_newest_request_and_a_dead_process_was_killed(monkeypatch):
    near_end, far_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    server = object.__new__(fork_server.ForkServer)
    server._lock, server._asked, server._link, server._owner = threading.Lock(), 0, near_end, -1
    # The first reply is late: it belongs to a request that a signal has interrupted.
    for number, status in ((1, 7), (1, 8), (2, 9)):
        far_end.send(json.dumps({"number": number, "status": status}).encode())
    assert [server.status(5), server.status(6)] == [7, 9]
    asked = [json.loads(far_end.recv(999)) for _ in range(2)]
    assert asked == [{"status": 5, "number": 1}, {"status": 6, "number": 2}]
    far_end.send(b'{"number": 3}')
    assert server.status(5) == -signal.SIGKILL
    size = len(json.dumps({"status": 5, "number": 4}))
    monkeypatch.setattr(fork_server, "LARGEST", size - 1)
    far_end.send(b'{"number": 4, "status": 1}')
    assert server.status(5) == -9  # the request is longer than the limit
    monkeypatch.setattr(fork_server, "LARGEST", size)
    far_end.send(b'{"number": 5, "status": 6}')
    assert server.status(5) == 6
    far_end.close()
    assert server.status(5) == -9


def test_a_failing_server_is_replaced_once_and_then_the_executable_starts_by_itself(monkeypatch):
    asked = []
    for answers, started in (([5], 5), ([None, 6], 6), ([None, None, 7], None)):
        replies = iter(answers)
        server = SimpleNamespace(start=lambda *what, replies=replies: asked.append(what) or next(replies))
        monkeypatch.setattr(fork_server, "prepare", lambda variables, server=server: server)
        monkeypatch.setattr(fork_server, "_server", "old")
        assert fork_server.start_node("p", "e", ["c"], {"A": "1"}, 2) == started
        assert fork_server._server == ("old" if started == 5 else None)
    assert asked == [("p", "e", ["c"], {"A": "1"}, 2)] * 5


def test_an_edited_module_is_noticed_once(tmp_path, monkeypatch):
    file = tmp_path / "edited.py"
    file.write_text("")
    os.utime(file, ns=(1, 10**18))
    monkeypatch.setitem(sys.modules, "edited", SimpleNamespace(__file__=str(file)))
    monkeypatch.setattr(fork_server.sys, "modules", {"edited": sys.modules["edited"], "bare": SimpleNamespace()})
    edited = fork_server._Edited()
    os.utime(file, ns=(1, 2 * 10**18))
    assert edited
    assert not edited
    file.unlink()
    assert edited
    assert not edited
    monkeypatch.setattr(fork_server, "_LIBRARIES", (str(tmp_path),))
    file.touch()
    assert not edited  # edits of Python's own libraries are not checked


def test_a_missing_folder_of_a_run_is_created(tmp_path, monkeypatch, lag_rig):
    def down():
        raise RunError("lo is down")

    monkeypatch.setattr(processes, "require_loopback", down)
    for _ in range(2):
        with pytest.raises(RunError, match="lo is down"):
            processes.run_processes(lag_rig, 0, tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    recording, status = processes.gathered(lag_rig, tmp_path, ["plant"])
    assert (set(recording.topics), status) == (set(lag_rig.topics), {"plant": {}})


# ---- parameters and status of a node ----


class Declares:
    """A node that is passed parameters and records what is declared."""

    def __init__(self, **keywords):
        kinds = {k.replace("__", "."): v for k, v in keywords.items()}
        self._parameter_overrides = {
            k: SimpleNamespace(value=v, type_=Parameter.Type.NOT_SET if v is None else None) for k, v in kinds.items()
        }
        self._parameters, self._described, self.declared = {}, {}, {}

    def declare_parameter(self, name, value, descriptor, ignore_override):
        assert ignore_override
        self.declared[name], self._described[name] = (value, descriptor.read_only), descriptor

    def describe_parameter(self, name):
        return self._described[name]


def test_a_node_declares_its_parameters_and_those_of_its_run_that_belong_to_others():
    node = Declares(k=3.0, run__seed=5, run__shard="x", use_sim_time=True, qos_overrides__x=1, run__paired=None)
    params, options = main._parameters(node, Gain)
    assert (params.k, options.seed, options.shard, options.paired) == (3.0, 5, "x", ())
    own = {"k": (3.0, True), "noise": (0.0, True), "period": (0.01, True)}
    assert {k: v for k, v in node.declared.items() if not k.startswith("run.")} == own
    assert {k.removeprefix("run."): v[0] for k, v in node.declared.items() if k.startswith("run.")} == {
        "mode": "realtime",
        "seed": 5,
        "duration": 0.0,
        "timeout": 10.0,
        "patience": 0.8,
        "stamp_window": 1.0,
        "start_timeout": 30.0,
        "paired": [],
        "watchdog": 0.0,
        "frames": True,
        "epoch": 0,
        "paused": False,
        "pace": 0.0,
        "link": "",
    }
    assert not node.declared["run.pace"][1]  # this parameter is live
    assert node._parameters["run.paired"].type_ == Parameter.Type.STRING_ARRAY
    assert node.describe_parameter("run.paired").type == Parameter.Type.STRING_ARRAY.value
    with pytest.raises(ParameterError):
        main._parameters(Declares(kk=3.0), Gain)


def test_a_node_describes_itself_and_how_it_is_started():
    assert main.introduction(Gain(), RunOptions()) == (
        "u = k (r - x) + noise; the state is the number of its ticks; realtime, every 0.01 s; "
        "waits for lag/state, lag/reference; publishes lag/command"
    )
    assert main.introduction(Source(), RunOptions(mode="lockstep")) == (
        "A sine of the tick number; lockstep, every 0.01 s; waits for no message; publishes lag/reference"
    )
    lines = main.usage("gain", Gain).splitlines()
    assert lines[:9] == [
        "gain: u = k (r - x) + noise; the state is the number of its ticks.",
        "",
        "  reads lag/state (sensor_msgs/msg/JointState: x/position, x/velocity)",
        "  reads lag/reference (trajectory_msgs/msg/JointTrajectory: x/position)",
        "  publishes lag/command (sensor_msgs/msg/JointState: u/effort)",
        "",
        "At a tick of which an input is refused: Its last outputs are held.",
        "",
        "Parameters, each as `--ros-args -p NAME:=VALUE` (node name, remaps and files as in any ROS 2 node):",
    ]
    assert lines[9].startswith("  period = 0.01 s: ")
    assert "  k = 2.0: gain" in lines
    assert any(line.startswith("  run.pace = 0.0: ") and line.endswith("; may change while running") for line in lines)
    assert not any("refused" in line for line in main.usage("source", Source).splitlines()[:6])
    assert "refused: " not in main.usage("plant", Lag)


def test_a_profile_has_the_names_of_the_installed_fast_dds(monkeypatch):
    """Fast DDS 3 (Kilted) refuses a whole file for one element of Fast DDS 2: then nothing of it would hold."""
    for third, name in ((False, b"<heartbeatPeriod>"), (True, b"<heartbeat_period>")):
        monkeypatch.setattr(profile, "third", lambda result=third: result)
        made = profile.own_profile(executables.PROFILE.read_bytes())
        assert name in made
        assert (b"nackSupressionDuration" in made, b"nack_supression_duration" in made) == (not third, third)
