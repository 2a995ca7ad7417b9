"""Plain rclpy nodes in place of each node of each system: our nodes publish the same bytes as without them."""

import json
import math
import random
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import in_process
from outside import busy
from softrig_core import Signals, rig_of
from softrig_core.rig.rig import CLOCK_NODE
from softrig_nodes import run_processes
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment
from softrig_nodes.processes.placement import Listener, Placement
from softrig_nodes.seam.tick import TICK

pytestmark = pytest.mark.processes

SYSTEMS = ["dc_motor_fsfb", "dc_motor_smc", "dc_motor_smc_b2", "economic_dispatch", "fault_location", "gupfc",
           "induction_dtc", "lsrm_fuzzy", "manipulator_adsmc", "optimal_control_mvim", "pv_mppt", "pwa_delay",
           "rectifier_mpc", "rehab_impedance", "tcp_aqm_smc"]  # fmt: skip
CLOCK = {"topic": "/clock", "type": "rosgraph_msgs/msg/Clock"}


def short(name):
    """A scenario shortened to some ticks of its slowest node."""
    rig = rig_of(name)
    slowest = max(m.schedule.period for m in rig.members)
    duration = min(rig.scenario.duration, float(max(60 * rig.clock.schedule.period, 3 * slowest)))
    return rig_of(rig.scenario.changed(duration=duration))


def relay(rig, member, expected, reads, names, realtime=False):
    """The arguments of `relay.py` in place of a node, one of some names, that reads some of its topics."""
    calls = min(reads, key=lambda p: member.links[p.name].source.schedule.every, default=None)
    caller = rig.clock if calls is None else member.links[calls.name].source
    topics = [CLOCK]
    if calls is not None:
        topics = [{"topic": p.topic, "type": p.msgtype} for p in [calls, *(p for p in reads if p is not calls)]]
    elif member is rig.clock:
        # The clock has no command to wait for, so it follows the node that acknowledges its ticks.
        caller = next(m for m in rig.leaves() if member in [k.source for k in m.links.values()])
        topics = [{"topic": f"{caller.name}/tick", "type": TICK}]
    schedule = caller.schedule
    return {
        "name": member.name,
        "plant": member.is_plant,
        "realtime": realtime,
        "ticks": [schedule.time(k) for k in range(schedule.count())],
        "by_order": calls is not None and (calls.delayed or not calls.stamped),
        "outputs": [
            {
                "topic": p.topic,
                "type": p.msgtype,
                "stamped": p.stamped,
                "times": expected.topics[p.topic].times,
                # What no node of ours reads is recorded by one of them.
                "readers": max(1, sum(m.name not in names for m, _ in rig.readers(member, p))),
                "data": [bytes(d).hex() for d in expected.topics[p.topic].data],
            }
            for p in member.outputs
        ],
        "reads": topics,
    }


def with_outside(rig, names, directory, seed=0, realtime=False):
    """Run a rig with a relay in place of each of some nodes; return the rig, its expected messages and the real
    ones.
    """
    expected = in_process(rig, rig.scenario.seed)
    rng = random.Random(seed)
    commands = []
    for member in (m for m in rig.members if m.name in names):
        linked = [p for p in member.inputs if p.name in member.links and member.links[p.name].source.name not in names]
        fastest = min(linked, key=lambda p: member.links[p.name].source.schedule.every, default=None)
        reads = [p for p in linked if p is fastest or rng.random() < 0.5]
        about = directory / f"{member.name}.relay.json"
        about.write_text(json.dumps(relay(rig, member, expected, reads, names, realtime)))
        commands.append([sys.executable, str(Path(__file__).parents[1] / "relay.py"), str(about)])
    nodes = {n: e.model_copy(update={"external": True} if n in names else {}) for n, e in rig.scenario.nodes.items()}
    patience = 60.0 * busy()
    own_rig = rig_of(
        rig.scenario.model_copy(update={"nodes": nodes, "timeout": patience, "start_timeout": 2 * patience})
    )
    outside, home = [], directory / "outside"
    home.mkdir()
    with free_domain() as domain:

        def announce(text):
            if not outside:  # other nodes have the same time limit for a silent node
                variables = environment(domain, home, silence=patience)
                outside.extend(subprocess.Popen(c, env=variables) for c in commands)

        try:
            placement = Placement(domain=domain, wait=patience, clock="realtime" if realtime else "lockstep")
            outcome = run_processes(own_rig, rig.scenario.seed, directory, placement, Listener(announce=announce))
        finally:
            for process in outside:
                process.kill()
                process.wait()
    return own_rig, expected, outcome


def by_chance(rig):
    """Nodes that read sporadic messages of an outside node, which does not announce its silence, and the subscribers of
    these nodes.
    """
    result = set()
    while True:
        more = {
            m.name
            for m in rig.members
            for k in m.links.values()
            if k.source.name in result or (k.source.external and k.port.sporadic)
        }
        if more <= result:
            return result
        result |= more


def replaced(rig, name, directory, seed=0):
    """Run a rig in lockstep with a relay in place of one node or several; return what is wrong."""
    own_rig, expected, outcome = with_outside(rig, (name,) if isinstance(name, str) else name, directory, seed)
    chance = by_chance(own_rig)
    wrong = [outcome.error] if outcome.error else []
    for member in own_rig.members:
        for port in member.outputs:
            result, wanted = outcome.recording.topics[port.topic], expected.topics[port.topic]
            awaited = any(not m.external for p in member.outputs for m, _ in own_rig.readers(member, p))
            # The run waits a bounded time for the last sporadic messages, and for a node that none of ours reads.
            if member.external and (port.sporadic or not awaited):
                same = set(result.data) <= set(wanted.data)
            elif member.external or member.name not in chance:
                same = (result.times, result.data) == (wanted.times, wanted.data)
            else:  # messages arrive at random ticks, but the node publishes at each of its ticks
                same = port.sporadic or result.times == wanted.times
            wrong += [] if same else [port.topic]
    return wrong + [f"{n} refused {s['refused']}" for n, s in outcome.status.items() if s.get("refused")]


def replaceable(rig):
    """All nodes except the rig's own clock."""
    return [m.name for m in rig.members if m.name != CLOCK_NODE]


@pytest.mark.long  # the daily tests have the same run in real time, and the plain plant below
@pytest.mark.parametrize("name", ["dc_motor_smc", "dc_motor_plant", "motor_reference"])
def test_a_plain_node_replaces_a_softrig_node(name, tmp_path):
    assert replaced(short("dc_motor_smc"), name, tmp_path) == []


def test_a_plain_plant_without_commands_follows_acknowledgements(tmp_path):
    assert replaced(short("fault_location"), "line_plant", tmp_path) == []


@pytest.mark.long
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_plain_node_replaces_each(system, tmp_path):
    rig = short(system)
    results = {}
    for name in replaceable(rig):
        directory = tmp_path / name
        directory.mkdir()
        results[name] = replaced(rig, name, directory)
    assert {n: wrong for n, wrong in results.items() if wrong} == {}


TOGETHER = [
    ("dc_motor_smc_b2", ("motor_reference", "dc_motor_smc", "dc_motor_metrics")),
    ("gupfc", ("shunt_controller", "references_1", "series_controller_2")),
    ("optimal_control_mvim", ("mvim_planner", "ocp_evaluator")),
    ("tcp_aqm_smc", ("tcp_fluid", "aqm_metrics")),
]


@pytest.mark.long
@pytest.mark.parametrize(("system", "names"), TOGETHER, ids=[system for system, _ in TOGETHER])
def test_plain_nodes_take_the_places_of_several_together(system, names, tmp_path):
    assert replaced(short(system), names, tmp_path) == []


def unaccounted(rig, outcome):
    """The ticks that our nodes neither published nor counted in real time, from the first to the last message
    of each.
    """
    wrong = [outcome.error] if outcome.error else []
    for member in (m for m in rig.members if not m.external):
        state = outcome.status[member.name]
        if state["state"] != "done" or not member.outputs:
            wrong += [] if state["state"] == "done" else [f"{member.name} is {state['state']}: {state['error']}"]
            continue
        for port in (p for p in member.outputs if not p.sporadic and p.stamped and not p.delayed):
            ticks = [member.schedule.tick(t - outcome.epoch) for t in outcome.recording.topics[port.topic].times]
            due = range(ticks[0], ticks[-1] + 1) if ticks else ()
            if not ticks or sorted(set(ticks)) != ticks or len(due) - len(ticks) != state["missed_deadlines"]:
                missed = state["missed_deadlines"]
                wrong.append(f"{port.topic}: {len(ticks)} messages in {len(due)} ticks, {missed} counted as missed")
    signals = Signals(outcome.recording, outcome.epoch)
    return wrong + [name for name in signals if not all(map(math.isfinite, signals[name].x))]


IN_REAL_TIME = [
    pytest.param("dc_motor_smc", "dc_motor_smc"),
    *(
        pytest.param(system, name, marks=pytest.mark.long)
        for system, name in (
            ("dc_motor_fsfb", "fsfb_controller"),
            ("gupfc", "shunt_controller"),
            ("manipulator_adsmc", "vcs_controller"),
            ("pv_mppt", "mppt_optimizer"),
            ("rehab_impedance", "voltage_controller"),
            ("tcp_aqm_smc", "aqm_controller"),
        )
    ),
]


@pytest.mark.long
@pytest.mark.parametrize(("system", "name"), IN_REAL_TIME)
def test_in_real_time_every_tick_is_answered_or_counted_beside_a_plain_node(system, name, tmp_path):
    rig, _, outcome = with_outside(short(system), (name,), tmp_path, realtime=True)
    assert unaccounted(rig, outcome) == []
