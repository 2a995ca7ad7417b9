"""The launch file: one start and one end of all nodes, a status, and no remaining node."""

import json
import random
import signal
import subprocess
import sys
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import PATIENCE, differences, in_process, until
from launching import AsyncSafeSignalManager, launch, nodes_of
from softrig_bags.read import read_bag
from softrig_bringup.cli import main
from softrig_bringup.launched import strange
from softrig_bringup.run.run import status_of, tripped
from softrig_core import ScenarioError, load_scenario, rig_of, run_inprocess
from softrig_core.scenario.scenario_file import list_scenarios
from softrig_core.wire.recording import relative
from softrig_nodes import run_processes
from softrig_nodes.container import split
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment, find_executable
from softrig_nodes.processes.placement import Listener, Placement
from test_outside import SYSTEMS, short

SCENARIO = """
title: First-order lag
system: lag
source: none
duration: 0.5
timeout: 60.0
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain, parameters: {noise: 0.01}}
figures:
  last: {function: final_value, arguments: {signal: lag/state/x/position}}
claims:
  last: {published: 7.0, tolerance: 1 %, where: nowhere, verdict: reproduced}
variants:
  long: {duration: 1000.0}
"""


@pytest.fixture
def lag(tmp_path, monkeypatch):
    (tmp_path / "lag.yaml").write_text(SCENARIO)
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))


def drawn_today(count):
    """Names of published scenarios, different ones each day."""
    return random.Random(datetime.now(UTC).toordinal()).sample(sorted(list_scenarios()), count)


def test_nodes_and_parameters_are_those_of_the_scenario(lag):
    nodes = nodes_of({"scenario": "lag", "mode": "lockstep"})
    assert [n.executable for n in nodes] == ["plant", "source", "gain"]
    with open(nodes[2].parameters[0]) as file:
        assert {"    noise: 0.01", '    run.mode: "lockstep"'} <= set(file.read().splitlines())
    (one,) = nodes_of({"scenario": "lag", "place": "container"})
    groups = split(one.arguments)
    assert [g[:2] for g in groups] == [["faultrig", "plant"], ["faultrig", "source"], ["faultrig", "gain"]]
    with open(groups[2][-1]) as file:
        assert '    run.mode: "realtime"' in file.read().splitlines()
    with pytest.raises(RuntimeError, match="argument 'mode': 'lock', expected one of"):
        nodes_of({"scenario": "lag", "mode": "lock"})


@pytest.mark.parametrize("place", ["processes", "container"])
def test_the_lease_of_launched_nodes_follows_the_timeout(place, lag, monkeypatch):
    """With the lease of the default profile a node stopped for 3 s ended the rig, because others took it for dead."""
    values = {"scenario": "lag", "mode": "lockstep", "place": place}
    for profile_path in ("", "/their/own.xml"):
        monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", profile_path)
        for node in nodes_of(values):
            if profile_path:  # arguments that the launch file passes on
                assert node.variables == {}
            else:
                (profile,) = node.variables.values()
                assert "<leaseDuration><sec>62</sec></leaseDuration>" in Path(profile).read_text()


@pytest.mark.processes
@pytest.mark.parametrize(("mode", "place"), [("lockstep", "processes"), ("realtime", "container")])
def test_a_launch_ends_by_itself(mode, place, lag, tmp_path):
    with free_domain() as domain:
        values = {"scenario": "lag", "mode": mode, "place": place}
        assert launch(values, environment(domain, tmp_path))[0] == 0


@pytest.mark.processes
def test_a_node_that_dies_ends_the_launch_with_a_status(lag, tmp_path):
    """Immediately, and not after the timeout of the nodes that wait for it."""

    def meddle(processes):
        if "source" in processes and processes["source"].poll() is None:
            processes["source"].kill()

    with free_domain() as domain:
        values = {"scenario": "lag_long", "mode": "lockstep"}
        status, printed = launch(values, environment(domain, tmp_path), meddle)
    assert status == 1
    assert "source ended with status -9" in printed


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@pytest.mark.parametrize("system", SYSTEMS)
def test_every_system_ends_by_itself(system, mode, tmp_path, monkeypatch):
    file = tmp_path / "launched.yaml"
    duration = short(system).scenario.duration
    file.write_text(f"extends: {system}\ntitle: launched\nduration: {duration!r}\n")
    monkeypatch.chdir(tmp_path)
    assert load_scenario(str(file)).duration == duration
    # Thousands of ticks a second over DDS exceed two cores, and late commands trip these plants.
    place = "container" if mode == "realtime" and system in ("gupfc", "rectifier_mpc") else "processes"
    with free_domain() as domain:
        values = {"scenario": str(file), "mode": mode, "place": place}
        status, printed = launch(values, environment(domain, tmp_path))
    assert status == 0, printed


@contextmanager
def recording(bag, variables, *words):
    """A recorder that has begun."""
    command = [find_executable("softrig_bags", "recorder"), *words, "--use-sim-time", "-o", bag]
    with subprocess.Popen(
        command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as recorder:
        try:
            until(bag.exists)
            yield recorder
        finally:
            recorder.kill()


def of_a_run(words, out):
    """The bag and the figures of `softrig run` with these options."""
    main(["run", *words, "--mode", "inprocess", "--out", str(out), "--no-plots"])
    return read_bag(out / "bag"), json.loads((out / "metrics.json").read_text())["metrics"]


FILE_OF_THREE = """
/a/gain: {ros__parameters: {noise: 0.02, use_sim_time: false}}
/b: {plant: {ros__parameters: {gain: 0.4}}, gain: {ros__parameters: {noise: 0.03}}}
/*/gain: {ros__parameters: {k: 1.5}}
/elsewhere/gain: {ros__parameters: {noise: 0.9}}
"""


@pytest.mark.long
@pytest.mark.processes
def test_launches_in_one_domain_accept_the_options_of_runs_and_leave_the_same_files(lag, tmp_path, capsys):
    """Three rigs of one parameter file in namespaces, in two placements; none reads another or its values."""
    (tmp_path / "given.yaml").write_text(FILE_OF_THREE)
    options = {"a": {"seed": "5"}, "b": {"duration": "0.3", "place": "container"}, "c": {}}
    common = {"scenario": "lag", "mode": "lockstep", "record": "true", "params_file": str(tmp_path / "given.yaml")}
    with free_domain() as domain:
        variables = environment(domain, tmp_path, silence=PATIENCE)
        with recording(tmp_path / "of_a", variables, "--namespace", "a") as recorder:
            each = [common | {"namespace": name, "out": str(tmp_path / name)} | own for name, own in options.items()]
            status, printed = launch(each, variables)
            recorder.send_signal(signal.SIGINT)
            assert "none lost" in recorder.communicate()[0]
    assert status == 0, printed
    changed = {
        "a": ["gain.noise=0.02", "gain.k=1.5"],
        "b": ["plant.gain=0.4", "gain.noise=0.03", "gain.k=1.5"],
        "c": ["gain.k=1.5"],
    }
    for name, words in (("a", ["lag", "--seed", "5"]), ("b", ["lag", "--duration", "0.3"]), ("c", ["lag"])):
        sets = [word for change in changed[name] for word in ("--set", change)]
        bag, metrics = of_a_run([*words, *sets], tmp_path / f"run_{name}")
        assert differences(read_bag(tmp_path / name / "bag"), bag) == []
        assert json.loads((tmp_path / name / "metrics.json").read_text())["metrics"] == metrics
        assert (tmp_path / name / "report.html").exists()
    assert "last" in capsys.readouterr().out
    compared = ["bag", "compare", str(tmp_path / "a"), str(tmp_path / "of_a"), "--namespace", "/", "--namespace", "a"]
    assert main(compared) == 0
    assert main([*compared[:2], str(tmp_path / "b"), *compared[3:]]) == 1
    assert all(name.startswith("a/") for name in read_bag(tmp_path / "of_a").topics)


@pytest.mark.processes
def test_a_launch_that_is_judged_ends_with_a_status(lag, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with free_domain() as domain:
        values = {"scenario": "lag", "mode": "lockstep", "place": "container", "judge": "true"}
        status, printed = launch(values, environment(domain, tmp_path))
    assert (status, printed.splitlines()[-1]) == (1, "judged: status 1")
    assert "claim last" in capsys.readouterr().out
    assert not (tmp_path / "runs").exists()  # the launch file did not request a recording


@pytest.mark.processes
def test_a_rig_that_trips_ends_its_launch_with_a_status_unless_the_scenario_expects_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("surprise.yaml").write_text("extends: lsrm_fuzzy_b5_trip\ntrips: []\n")
    with free_domain() as domain:
        values = {"scenario": "surprise.yaml", "mode": "lockstep", "place": "container"}
        status, printed = launch(values, environment(domain, tmp_path))
    assert status == 1, printed
    assert printed.splitlines()[-1].startswith("lsrm_plant: phase currents")
    for scenario, result in (("surprise.yaml", ["lsrm_plant"]), ("lsrm_fuzzy_b5_trip", [])):
        rig = rig_of(scenario)
        held = run_inprocess(rig, 0)
        assert list(tripped(rig, {name: status_of(h) for name, h in held.items()})) == result
    with pytest.raises(ScenarioError, match="trips: no node 'motor'"):
        rig_of("surprise.yaml").scenario.having(trips=["motor"])


def test_a_launch_that_is_terminated_ends_in_order(lag, monkeypatch):
    """With its own handler launch would exit immediately; SIGTERM goes to the launch only, so it must interrupt its
    nodes.
    """
    handlers, events = {}, []
    manager = SimpleNamespace(handle=handlers.__setitem__)
    monkeypatch.setattr(AsyncSafeSignalManager, "_AsyncSafeSignalManager__current", manager, raising=False)
    before = signal.getsignal(signal.SIGTERM)
    try:
        nodes = nodes_of({"scenario": "lag"}, emit_event_sync=events.append)
        signal.raise_signal(signal.SIGTERM)  # launch receives the signal through its file descriptor
    finally:
        signal.signal(signal.SIGTERM, before)
    (launched,) = {node.on_exit.args[0] for node in nodes}
    assert launched.sent is signal.SIGINT
    handlers[signal.SIGTERM](signal.SIGTERM)
    assert launched.sent is signal.SIGTERM
    assert [(e.reason, e.due_to_sigint) for e in events] == [("SIGTERM", False)]


def test_nodes_end_with_a_launch_that_is_killed(tmp_path):
    node = (  # the node must not end for another reason than the end of the launch
        "import time\nfrom softrig_core.interrupt import interrupt\n"
        "interrupt.install(); print('up', flush=True); time.sleep(1e3)"
    )
    launch = (
        "import os, subprocess, sys, time\nfrom softrig_core.interrupt import PARENT\n"
        "os.environ[PARENT] = str(os.getpid())\n"
        f"subprocess.Popen([sys.executable, '-c', {node!r}]); time.sleep(1e3)"
    )
    with subprocess.Popen([sys.executable, "-c", launch], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"up\n"
        process.kill()
        assert process.communicate(timeout=PATIENCE)[0] == b""  # the pipe ends when no process holds it any more


def test_an_unknown_argument_of_our_launch_file_is_reported():
    words = ["ros2", "launch", "softrig_bringup", "rig.launch.py", "scenarioo:=1"]
    assert strange(words).startswith("scenarioo: no argument of rig.launch.py (did you mean 'scenario'?); expected")
    assert strange([*words[:4], "scenario:=lag", "seed:=1"]) == ""
    # Another launch file may pass its arguments on to softrig's.
    assert strange(["ros2", "launch", "theirs.launch.py", "scenarioo:=1"]) == ""


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        ("gian: {ros__parameters: {noise: 1.0}}", "/gian: no such node .did you mean '/gain'"),
        ("gain: {noise: 1.0}", "line 1: noise: expected ros__parameters"),
        ("- gain", "expected NODE"),
        ("gain: {ros__parameters: {nose: 1.0}}", "nose"),
        ("gain: [", "given.yaml"),
    ],
)
def test_a_wrong_params_file_is_refused_in_one_line(content, reported, lag, tmp_path):
    (tmp_path / "given.yaml").write_text(content)
    with pytest.raises(ScenarioError, match=reported):
        nodes_of({"scenario": "lag", "params_file": str(tmp_path / "given.yaml")})


@pytest.mark.parametrize(("name", "value"), [("external", "gian"), ("duration", "long"), ("seed", "-1")])
def test_a_wrong_argument_is_refused_in_one_line(name, value, lag):
    with pytest.raises(ScenarioError, match=f"{name}.*{value}"):
        nodes_of({"scenario": "lag", name: value})


def test_a_viewer_is_not_a_node_of_the_rig_and_its_end_ends_the_launch(lag):
    *nodes, viewer = nodes_of({"scenario": "lag", "use_rviz": "true"})
    assert [n.name for n in nodes] == ["plant", "source", "gain"]
    assert (viewer.package, viewer.on_exit.reason) == ("rviz2", "the viewer is closed")


def test_external_nodes_are_not_launched_and_waited_for_without_limit(lag):
    nodes = nodes_of({"scenario": "lag", "external": "gain source"})
    assert [n.name for n in nodes] == ["plant"]
    with open(nodes[0].parameters[0]) as file:
        assert "    run.start_timeout: 0.0" in file.read().splitlines()


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize(
    "topics", [(), pytest.param(("/lag/state", "/clock"), marks=pytest.mark.long)], ids=["all", "some"]
)
def test_a_launched_rig_waits_for_a_recorder_that_asks_for_it(topics, lag, tmp_path):
    """The recording equals that of the same run in process, from t = 0 on, whatever the recorder leaves out."""
    with free_domain() as domain:
        variables = environment(domain, tmp_path, silence=PATIENCE)  # on a busy host the recorder may pause for long
        with recording(tmp_path / "bag", variables, *topics) as recorder:
            status, printed = launch({"scenario": "lag", "mode": "lockstep"}, variables)
            recorder.send_signal(signal.SIGINT)
            printed = recorder.communicate()[0]
    assert status == 0, printed
    assert recorder.returncode == 0, printed
    assert "none lost" in printed
    rig = rig_of("lag")
    whole = in_process(rig)
    bag = read_bag(tmp_path / "bag")
    for name in map(relative, topics or [name for name, topic in whole.topics.items() if topic.times]):
        assert bag.topics[name].times == whole.topics[name].times
    if topics:
        assert set(bag.topics) == {relative(topic) for topic in topics}


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("place", ["processes", "container"])
@pytest.mark.parametrize("name", drawn_today(3))
def test_a_recorder_has_all_of_any_scenario_and_infers_no_loss(name, place, tmp_path):
    """Of 300 ticks, the acknowledgements of followers among them, whose first is not that of t = 0."""
    whole = rig_of(name)
    rig = rig_of(name, duration=min(whole.scenario.duration, 300 * whole.clock.params.period))
    with free_domain() as domain:
        variables = environment(domain, tmp_path, silence=PATIENCE)
        with recording(tmp_path / "bag", variables) as recorder:
            run = run_processes(rig, rig.scenario.seed, tmp_path / "log", Placement(place, domain=domain), Listener())
            recorder.send_signal(signal.SIGINT)
            printed = recorder.communicate()[0]
    assert run.error == "", run.error
    assert recorder.returncode == 0, printed
    assert "none lost" in printed
    assert "JOINED LATE" not in printed
    bag = read_bag(tmp_path / "bag")
    for topic, text in run.recording.topics.items():
        assert (bag.topics[topic].times if topic in bag.topics else []) == text.times
