"""A plain rclpy node in place of each node of each system: our nodes say the same bytes as without it."""

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import differences, in_process
from softrig_core.rig.domain import free_domain
from softrig_core.rig.processes import environment, run_processes
from softrig_core.rig.rig import CLOCK_NODE, Rig
from softrig_core.rig.scenario import load_scenario

pytestmark = pytest.mark.processes

SYSTEMS = ["dc_motor_fsfb", "dc_motor_smc", "dc_motor_smc_b2", "economic_dispatch", "fault_location", "gupfc",
           "induction_dtc", "lsrm_fuzzy", "manipulator_adsmc", "optimal_control_mvim", "pv_mppt", "pwa_delay",
           "rectifier_mpc", "rehab_impedance", "tcp_aqm_smc"]  # fmt: skip
CLOCK = {"topic": "/clock", "type": "rosgraph_msgs/msg/Clock"}


def short(name):
    """A scenario over some ticks of its slowest node."""
    rig = Rig.from_scenario(load_scenario(name))
    slowest = max(m.schedule.period for m in rig.members)
    duration = min(rig.scenario.duration, float(max(60 * rig.clock.schedule.period, 3 * slowest)))
    return Rig.from_scenario(rig.scenario.changed(duration=duration))


def relay(rig, member, expected, reads):
    """What `relay.py` is to do in place of a member that reads some of its topics."""
    calls = min(reads, key=lambda p: member.links[p.name].source.schedule.every, default=None)
    caller = rig.clock if calls is None else member.links[calls.name].source
    schedule = caller.schedule
    return {
        "name": member.name,
        "plant": member.is_plant,
        "ticks": [schedule.time(k) for k in range(schedule.count())],
        "by_order": calls is not None and (calls.delayed or not calls.stamped),
        "outputs": [
            {"topic": p.topic, "type": p.msgtype, "readers": len(rig.readers(member, p)),
             "times": expected.topics[p.topic].times, "data": [bytes(d).hex() for d in expected.topics[p.topic].data]}
            for p in member.outputs
        ],
        "reads": [CLOCK] if calls is None else [
            {"topic": p.topic, "type": p.msgtype} for p in [calls, *(p for p in reads if p is not calls)]
        ],
    }  # fmt: skip


def replaced(rig, name, directory, seed=0):
    """Run a rig with a relay in place of a node; gives what is wrong."""
    expected = in_process(rig, rig.scenario.seed)
    rng = random.Random(seed)
    member = next(m for m in rig.members if m.name == name)
    linked = [p for p in member.inputs if p.name in member.links]
    about = directory / "relay.json"
    fastest = min(linked, key=lambda p: member.links[p.name].source.schedule.every, default=None)
    reads = [p for p in linked if p is fastest or rng.random() < 0.5]
    about.write_text(json.dumps(relay(rig, member, expected, reads)))
    nodes = dict(rig.scenario.nodes)
    nodes[name] = nodes[name].model_copy(update={"external": True})
    ours = Rig.from_scenario(rig.scenario.model_copy(update={"nodes": nodes, "timeout": 60.0}))
    outside = []
    with free_domain() as domain:

        def announce(text):
            if not outside:
                command = [sys.executable, str(Path(__file__).with_name("relay.py")), str(about)]
                outside.append(subprocess.Popen(command, env=environment(domain, directory)))

        try:
            outcome = run_processes(ours, rig.scenario.seed, directory, domain=domain, announce=announce, wait=60.0)
        finally:
            for process in outside:
                process.kill()
                process.wait()
    said = {p.topic for m in ours.members if not m.external for p in m.outputs}
    wrong = [outcome.error] if outcome.error else []
    wrong += [t for t in differences(expected, outcome.recording) if t in said]
    return wrong + [f"{n} refused {s['refused']}" for n, s in outcome.status.items() if s.get("refused")]


def replaceable(rig):
    """Members whose silence nobody needs to be told of, who do not end the run, and whom something calls."""
    members = [m for m in rig.members if m.outputs and m.name != CLOCK_NODE and not m.block_class.ENDS]
    members = [m for m in members if m.links or not m.is_plant]
    return [m.name for m in members if not any(p.sporadic for p in m.outputs)]


@pytest.mark.parametrize("name", ["dc_motor_plant", "dc_motor_smc", "motor_reference"])
def test_a_plain_node_takes_the_place_of_ours(name, tmp_path):
    assert replaced(short("dc_motor_smc"), name, tmp_path) == []


@pytest.mark.long
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_plain_node_takes_the_place_of_each(system, tmp_path):
    rig = short(system)
    found = {}
    for name in replaceable(rig):
        directory = tmp_path / name
        directory.mkdir()
        found[name] = replaced(rig, name, directory)
    assert {n: wrong for n, wrong in found.items() if wrong} == {}
