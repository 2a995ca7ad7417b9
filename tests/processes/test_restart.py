"""`--restart N`: nodes that are killed at any tick of a run through processes restart, and its bag is the same."""

import os
import random
import signal

import pytest
from conftest import differences, in_process, make_scenario
from softrig_bags.read import read_bag
from softrig_bringup.cli import main
from softrig_core import rig_of, simulate
from softrig_nodes import run_processes
from softrig_nodes.processes import processes
from softrig_nodes.processes.placement import Listener, Placement
from test_comeback import fieldbus

pytestmark = [pytest.mark.processes, pytest.mark.long]
NODES = {"plant": "plant", "source": "source", "gain": {"executable": "gain", "parameters": {"noise": 0.3}}}


@pytest.fixture
def killer(monkeypatch):
    """Kills the process of a node, whichever process that is now."""
    pids, start = {}, processes.start

    def started(*args, **options):
        children = start(*args, **options)
        pids.update({c.member.name: c.process.pid for c in children})
        return children

    monkeypatch.setattr(processes, "start", started)
    return lambda name: os.kill(pids[name], signal.SIGKILL)


def from_then_on(acts):
    """A progress function that runs some actions once each, when the run has reached their times (ns)."""
    left = sorted(acts, key=lambda act: act[0])

    def progress(t):
        if left and t >= left[0][0]:
            left.pop(0)[1]()

    return progress


@pytest.mark.parametrize("seed", range(10))
def test_a_node_killed_at_any_tick_restarts_and_the_bag_is_the_same(seed, killer, tmp_path):
    rng = random.Random(seed)
    rig = rig_of(make_scenario(NODES, 100.0))
    name, at, messages = rng.choice(list(NODES)), rng.randrange(rig.end // 2), []
    progress = from_then_on([(at, lambda: killer(name))])
    outcome = run_processes(rig, 7, tmp_path, Placement(restart=1), Listener(progress, messages.append))
    assert outcome.error == ""
    assert len(messages) == 1
    assert messages[0].startswith(f"node {name} was killed by SIGKILL after t = ")
    assert outcome.status[name]["restarts"] == 1
    assert not any(status["refused"] for status in outcome.status.values())
    assert not differences(in_process(rig, 7), outcome.recording)


@pytest.mark.parametrize("name", ["plant", "bus", "gain"])
def test_a_node_with_delayed_messages_restarts(name, killer, tmp_path):
    """Counted messages have their number if nodes can restart; the bag has it removed."""
    bus = fieldbus("state", "late_state", delay=0.02, jitter=0.03, loss=0.3)
    rig = rig_of(make_scenario({**NODES, "gain": "late_gain", "bus": bus}, 100.0))
    acts = [(rig.end // 10, lambda: killer(name)), (rig.end // 2, lambda: killer("bus"))]
    outcome = run_processes(rig, 7, tmp_path, Placement(restart=2), Listener(from_then_on(acts)))
    assert outcome.error == ""
    assert sum(status.get("restarts", 0) for status in outcome.status.values()) == 2
    assert not any(status["refused"] for status in outcome.status.values())
    assert not differences(in_process(rig, 7), outcome.recording)


def test_after_the_allowed_restarts_the_run_ends_and_names_the_node(killer, tmp_path):
    rig = rig_of(make_scenario(NODES, 100.0))
    acts = [(rig.end // 10, lambda: killer("gain")), (rig.end // 2, lambda: killer("gain"))]
    outcome = run_processes(rig, 7, tmp_path, Placement(restart=1), Listener(from_then_on(acts)))
    assert outcome.error.startswith("node gain was killed by SIGKILL after t = ")
    assert outcome.error.endswith("; it was started again 1 of 1 times")
    assert outcome.recording.topics["lag/command"].times


def test_the_command_line_reports_that_a_node_was_restarted(killer, tmp_path, capsys, monkeypatch):
    run = processes.run_processes

    def killing(rig, seed, directory, placement, listener):
        kill = from_then_on([(rig.end // 20, lambda: killer("dc_motor_smc"))])
        return run(rig, seed, directory, placement, Listener(kill, listener.announce, listener.opened))

    monkeypatch.setattr("softrig_nodes.run_processes", killing)
    assert (
        main(
            ["run", "dc_motor_smc", "--duration", "1.5", "--restart", "1", "--no-plots", "--out", str(tmp_path / "run")]
        )
        == 0
    )
    assert "node dc_motor_smc was killed by SIGKILL" in capsys.readouterr().err
    assert not differences(simulate("dc_motor_smc", duration=1.5).recording, read_bag(tmp_path / "run" / "bag"))
