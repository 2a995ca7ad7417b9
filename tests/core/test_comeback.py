"""A node that is killed restarts with its state and its tick: the run is the same as without the kill."""

import json
import os
import random
from dataclasses import replace
from functools import cache, partial

import pytest
from conftest import differences, few, in_process, make_scenario
from simulated import Discovery, SimulatedRig, World
from softrig_core import ScenarioError, rig_of
from softrig_nodes.processes.children import Child
from softrig_nodes.processes.placement import Placement
from softrig_nodes.processes.restarting import Restarts, check_restart
from test_discovery import BASIC, KINDS, MS, perhaps_prompt, slow


def fieldbus(topic_in, topic_out, **parameters):
    """A link with a delay: its messages have other stamps than their ticks, and often repeat one."""
    state = {"channels": ["x"], "fields": ["position", "velocity"], "units": ["m", "m/s"]}
    parameters |= state | {"topic_in": f"lag/{topic_in}", "topic_out": f"lag/{topic_out}"}
    return {"package": "softrig_control", "executable": "fieldbus_delay", "parameters": parameters}


LATE = BASIC | {"gain": "late_gain"}
DELAYED = {
    "a fieldbus": LATE | {"bus": fieldbus("state", "late_state", delay=0.02, jitter=0.03, loss=0.3)},
    "a slow and a fast fieldbus, one after the other": LATE
    | {
        "first": fieldbus("state", "first", period=0.02, delay=0.02, loss=0.3),
        "second": fieldbus("first", "late_state", delay=0.01, jitter=0.01),
        "law": slow(0.05, executable="late_gain", remap={"lag/late_state": "lag/first", "lag/command": "lag/unread"}),
    },
    "losses behind a fieldbus": LATE | {"bus": fieldbus("state", "late_state", delay=0.02, jitter=0.02)},
}
LOST = {"lost": {"link": "lag/late_state -> gain", "kind": "loss", "probability": 0.5}}
COUNTED = {
    kind: make_scenario(nodes, 0.2, faults=LOST if kind.startswith("losses") else {}) for kind, nodes in DELAYED.items()
}


@cache
def rig_and_record(kind):
    """The rig and its expected recording."""
    rig = rig_of((KINDS | COUNTED)[kind])
    return rig, in_process(rig)


def killed(kind, seed, kills=1):
    """One run in which nodes are killed at random times; returns what is wrong with it, and which were killed."""
    rng = random.Random(seed)
    rig, expected = rig_and_record(kind)
    longest = rng.choice((1, 5, 20)) * MS
    world = World(lambda *_: rng.randrange(1_000, longest), prompt=perhaps_prompt(seed))
    Discovery(world, rng)
    run = SimulatedRig(rig, world, "lockstep", after=lambda name: rng.randrange(300 * MS), returns=True)
    may = [m.name for m in rig.members]
    victims = []

    def watch(name, at):
        adapter = run.adapters.get(name)
        if adapter is not None and adapter.t >= at and run.kill(name, rng):
            victims.append((name, adapter.t))
        elif adapter is None or adapter.state != "done":
            world.at(world.now + rng.randrange(1_000, MS // 10), partial(watch, name, at))

    for _ in range(kills):
        world.at(world.now, partial(watch, rng.choice(may), rng.choice((0, rng.randrange(rig.end)))))
    states = run.run(100.0)
    wrong = [f"{m.name} has not come" for m in rig.members if m.name not in states]
    wrong += [f"{n}: {a.state} at {a.t}: {a.error}" for n, a in run.adapters.items() if a.state != "done"]
    wrong += differences(expected, run.recording)
    wrong += [
        f"{n} refused {i.port.topic}: {i.last_refusal}"
        for n, a in run.adapters.items()
        for i in (*a.inputs, *a.paces)
        if i.refused
    ]
    return wrong, victims


@pytest.mark.parametrize("kind", few([*KINDS, *COUNTED], 9))
def test_a_killed_node_restarts(kind):
    """It is killed at its start, in the middle or at the end, with or without the messages it had just sent."""
    met = []
    for seed in range(3):
        wrong, victims = killed(kind, seed)
        assert wrong == [], seed
        met += victims
    assert met


@pytest.mark.long
@pytest.mark.parametrize("kind", [*KINDS, *COUNTED])
def test_killed_nodes_restart(kind):
    """Up to three nodes are killed; one may die while another one restarts, or twice."""
    for seed in range(3, 60):
        assert killed(kind, seed, kills=1 + seed % 3)[0] == [], seed


# the command that restarts nodes ---------------------------------------------------------------------------------


class Process:
    """The part of a process that the watch of a run needs."""

    code = None
    pid = 0

    def poll(self):
        return self.code


@pytest.fixture
def watched(tmp_path):
    """The nodes of a rig as children that write their status on request (below 0: busy), and the watch."""
    rig = rig_of(make_scenario({"plant": "plant", "source": "source", "watcher": "watcher", "gain": "gain"}))
    children = [
        Child(
            m,
            Process(),
            os.open(os.devnull, os.O_RDONLY),
            tmp_path / "log",
            tmp_path / f"{m.name}.status",
            tmp_path / f"{m.name}.shard",
        )
        for m in rig.members
    ]
    again, messages = [], []

    def start(k):
        again.append(children[k].member.name)
        children[k] = replace(children[k], process=Process())

    def write(**ticks):
        for child in children:
            if child.member.name in ticks and child.process.code is None:
                k = ticks[child.member.name]
                child.status.write_text(json.dumps({"ticks": abs(k), "busy": k < 0, "t": 0}))
                os.utime(child.status, ns=(clock := next(times), clock))

    times = iter(range(10**18, 2 * 10**18, 10**9))
    yield {c.member.name: c for c in children}, children, Restarts(1, start, messages.append), write, again, messages
    for child in children:
        os.close(child.end)


def test_a_node_is_restarted_when_all_others_wait(watched):
    by_name, children, restarts, write, again, text = watched
    write(plant=3, source=3, watcher=3)
    by_name["gain"].process.code = -9
    all_of_them = {"plant": 4, "source": 4, "watcher": 4}
    styles = [all_of_them, {"plant": 4, "source": 4}, {"watcher": -4}, {"watcher": 4}]
    for ticks in styles:
        assert restarts.check(children) == []
        assert again == []
        write(**ticks)
    assert restarts.check(children) == []
    assert again == ["gain"]
    assert text == ["node gain was killed by SIGKILL after t = 0 s; it is started again (1 of 1)"]
    assert restarts.counts == {"gain": 1}
    new = next(c for c in children if c.member.name == "gain")
    assert restarts.check(children) == []
    new.process.code = -11
    assert restarts.check(children) == [new]
    assert restarts.why(new.member) == "; it was started again 1 of 1 times"


def test_a_node_that_failed_by_itself_is_not_restarted(watched):
    by_name, children, restarts, _, again, _ = watched
    by_name["gain"].process.code = 3
    assert restarts.check(children) == [by_name["gain"]]
    assert again == []
    assert Restarts(0, lambda member: None).why(by_name["gain"].member) == ""


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"clock": "realtime"}, "expected a run in lockstep whose nodes have a process each"),
        ({"mode": "container"}, "expected a run in lockstep whose nodes have a process each"),
        ({"mode": "inprocess"}, "expected a run in lockstep whose nodes have a process each"),
        ({"containers": [["plant", "gain"]]}, "expected a run in lockstep whose nodes have a process each"),
        ({"only": ["gain"]}, "expected a run in lockstep whose nodes have a process each"),
        ({"record": False}, "expected --restart without --no-record"),
    ],
)
def test_impossible_restarts_are_refused_before_the_run(keys, message, lag_rig):
    with pytest.raises(ScenarioError, match=f"^--restart: .*{message}"):
        check_restart(lag_rig, Placement(**keys, restart=1))
    check_restart(lag_rig, Placement(**keys))


def test_with_an_outside_node_no_node_can_be_restarted():
    nodes = {"plant": "plant", "source": "source", "gain": {"executable": "gain", "external": True}}
    with pytest.raises(ScenarioError, match=r"^--restart: gain is an outside node"):
        check_restart(rig_of(make_scenario(nodes)), Placement(restart=1))
