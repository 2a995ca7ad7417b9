"""Every kind of fault on every topic of the fourteen systems: it starts, and changes each message as documented."""

import math
import random
from datetime import date

import numpy as np
import pytest
from conftest import few
from softrig_control.nodes.fault import FaultParams
from softrig_core import Block, BlockParams, RunError, load_scenario, param, rig_of, simulate
from softrig_core.scenario.port_text import ports_of, ports_text, reader
from softrig_core.wire import types

# Duration of each run in s: some ticks of its controllers, and a message of each rare publisher.
SYSTEMS = {"dc_motor_smc": 0.003, "dc_motor_fsfb": 0.3, "induction_dtc": 0.003, "lsrm_fuzzy": 0.003, "pv_mppt": 0.02,
           "rectifier_mpc": 0.01, "fault_location": 0.001, "gupfc": 0.004, "economic_dispatch": 2.0,
           "manipulator_adsmc": 0.01, "rehab_impedance": 0.01, "pwa_delay": 0.003, "tcp_aqm_smc": 0.02,
           "optimal_control_mvim": 8.0}  # fmt: skip
# Topics without a message in this time.
LATER = {"fault_location": {"verdict", "location", "objective"}, "pwa_delay": {"lyapunov"}}
KINDS = FaultParams.model_fields["kind"].annotation.__args__
NUMBERS = {
    "scale": {"value": [-2.0]},
    "drift": {"value": [3.0]},
    "quantise": {"value": [0.25]},
    "add": {"points": [0.5]},
    "replace": {"points": [0.75]},
    "invalid": {"probability": 1.0},
}


class TapParams(BlockParams):
    """The messages to read."""

    ports: str = param("[]", "as JSON", max_length=10_000_000)


class Tap(Block[TapParams]):
    """Reads links, so that every fault has a subscriber."""

    @classmethod
    def ports(cls, params):
        return ports_of(params.ports), ()

    def update(self, x, t, **inputs):
        return x, {}


def tapped(name, duration, kinds=KINDS):
    """A rig with a reader for each kind of fault, and that fault between it and every topic."""
    rig = rig_of(load_scenario(name).changed(duration=duration))
    outputs = [(m.params.period, p) for m in rig.members for p in m.outputs]
    nodes, faults = {n: e.model_dump() for n, e in rig.scenario.nodes.items()}, {}
    for kind in kinds:
        some = [(period, p) for period, p in outputs if (kind, p.msgtype) != ("invalid", types.BUTTON.name)]
        text = ports_text([reader(p, f"in{k}") for k, (_, p) in enumerate(some)])
        parameters = {"ports": text, "period": rig.clock.params.period}
        nodes[f"tap_{kind}"] = {"package": "tests", "executable": "tap", "parameters": parameters}
        for k, (period, p) in enumerate(some):
            numbers = {"delay": 2.0 * period} if kind == "delay" else NUMBERS.get(kind, {})
            faults[f"{kind}_{k}"] = {"link": f"{p.topic} -> tap_{kind}", "kind": kind, **numbers}
    unasked = {"figures": {}, "expect": {}, "claims": {}, "requirements": {}, "plots": ()}
    scenario = rig.scenario.having(nodes=nodes, faults=faults, **unasked)
    return rig_of(scenario, classes={f"tap_{kind}": Tap for kind in kinds}), scenario.faults


def published(run, topic):
    """The messages of a topic: time, stamp and values of each."""
    layout, record = run.rig.topics[topic].layout(), run.recording.topics[topic]
    return [(t, *layout.decode(bytes(data))) for t, data in zip(record.times, record.data, strict=True)]


def expected(kind, sent):
    """The output of a fault that is active from the start: (time, stamp, values) of each message."""
    if kind in ("silence", "loss"):
        return []
    rows = {
        "offset": lambda t, x: x + 1.0,
        "spike": lambda t, x: x + 1.0,
        "scale": lambda t, x: -2.0 * x,
        "drift": lambda t, x: x + 3.0 * ((t - sent[0][0]) / 1e9),
        "quantise": lambda t, x: np.floor(x / 0.25 + 0.5) * 0.25,
        "saturate": lambda t, x: np.clip(x, -1.0, 1.0),
        "stuck": lambda t, x: np.array(sent[0][2]),
        "add": lambda t, x: x + 0.5,
        "replace": lambda t, x: np.full(len(x), 0.75),
        "invalid": lambda t, x: np.full(len(x), math.nan),
    }
    if kind in rows:
        return [(t, stamp, tuple(rows[kind](t, np.array(row)))) for t, stamp, row in sent]
    if kind == "repeat":
        return [(t, *sent[max(k - 1, 0)][1:]) for k, (t, _, _) in enumerate(sent)]
    raise AssertionError(kind)


HEAVY = ("economic_dispatch", "optimal_control_mvim", "pwa_delay")  # their solvers take seconds


@pytest.mark.parametrize(
    "name",
    few([pytest.param(n, marks=pytest.mark.long) if n in HEAVY else n for n in SYSTEMS], 3),
)
def test_each_kind_of_fault_changes_each_topic_as_documented(name):
    rig, faults = tapped(name, SYSTEMS[name])
    run = simulate(rig)
    assert not run.error
    checked = set()
    for fault, entry in faults.items():
        kind, topic = entry.parameters["kind"], entry.link.split(" -> ")[0]
        port = rig.topics[topic]
        # A plant also publishes its final state, which no node answers.
        last = next(m.schedule.last for m in rig.members if m.name == fault)
        sent, arrived = [m for m in published(run, topic) if m[0] <= last], published(run, f"{topic}/{fault}")
        if port.delayed:  # a delayed link repeats its message until a newer one arrives
            sent = [m for k, m in enumerate(sent) if not k or m[1] > sent[k - 1][1]]
        at = f"{fault} on {topic}"
        if not sent:
            assert not arrived, at
            continue
        checked.add(topic)
        if kind == "noise":
            assert [m[0] for m in arrived] == [m[0] for m in sent], at
            if port.msgtype != types.BUTTON.name:
                added = np.ravel([np.subtract(b[2], a[2]) for a, b in zip(sent, arrived, strict=True)])
                assert np.abs(added).max() < 6.0, at
                assert abs(np.mean(added)) < 6.0 / math.sqrt(len(added)), at
                assert np.all(added != 0.0), at
            continue
        if kind == "delay":
            late = round(2e9 * rig.scenario.nodes[fault].parameters["period"])
            want = [(t + late, stamp, row) for t, stamp, row in sent if t + late <= last]
        else:
            want = expected(kind, sent)
        if port.msgtype == types.BUTTON.name:
            want = [(t, stamp, tuple(float(x > 0.5) for x in row)) for t, stamp, row in want]
        assert [m[0] for m in arrived] == pytest.approx([m[0] for m in want], abs=1), at
        if port.delayed:
            assert [m[1] for m in arrived] == [m[1] for m in want], at
        np.testing.assert_array_equal([m[2] for m in arrived], [m[2] for m in want], err_msg=at)
    links = {entry.link.split(" -> ")[0] for entry in faults.values()}
    assert links - checked == LATER.get(name, set())


def links_of(name):
    """The topics of a system that some node of it reads."""
    rig = rig_of(load_scenario(name), live=False)
    return [p.topic for m in rig.members for p in m.outputs if rig.readers(m, p)], rig


def trials(name):
    """Each kind of fault on each link of a system, with its readers."""
    topics, rig = links_of(name)
    for topic in topics:
        kinds = [kind for kind in KINDS if (kind, rig.topics[topic].msgtype) != ("invalid", types.BUTTON.name)]
        yield from ((name, SYSTEMS[name], topic, kind) for kind in kinds)


def numbers_said(run, topic):
    """All numbers published on a topic."""
    return np.concatenate([np.empty(0), *(np.ravel(row) for _, _, row in published(run, topic))])


def suffered(name, duration, topic, kind):
    """Run a system with a large fault on a link; return what is wrong with its reaction, or an empty text."""
    value = {"scale": [-1e9], "offset": [1e9], "spike": [-1e9], "drift": [1e12], "delay": []}.get(kind)
    numbers = NUMBERS.get(kind, {}) | ({"value": value} if value else {})
    if kind == "delay":
        numbers = {"delay": 2.0 * next(m.params.period for m in links_of(name)[1].members
                                       for p in m.outputs if p.topic == topic)}  # fmt: skip
    scenario = load_scenario(name).changed(duration=duration)
    fault = {"link": topic, "kind": kind, **numbers}
    try:
        run = simulate(scenario.having(faults={"broken": fault}, figures={}, expect={}, claims={}, requirements={}))
    except RunError as error:  # a plant that trips or leaves its limits ends the run with its own error
        cause = error.__cause__
        return "" if cause is None or isinstance(cause, ValueError | RunError) else f"{type(cause).__name__}: {error}"
    odd = [
        topic
        for topic in run.recording.topics
        if topic in run.rig.topics and not topic.endswith("/broken") and not np.isfinite(numbers_said(run, topic)).all()
    ]
    return f"no number on {', '.join(odd)}" if odd else run.error


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", SYSTEMS)
def test_each_kind_of_fault_on_each_link_is_handled_by_its_readers(name):
    wrong = {each: result for each in trials(name) if (result := suffered(*each))}
    assert wrong == {}


QUICK = [
    each for each in SYSTEMS if each not in ("optimal_control_mvim", "economic_dispatch", "fault_location", "pwa_delay")
]


@pytest.mark.parametrize("name", QUICK)
def test_some_faults_of_the_day_are_handled_by_the_readers_of_the_link(name):
    drawn = random.Random(f"{date.today()} {name}").sample(list(trials(name)), 6)
    assert {each: result for each in drawn if (result := suffered(*each))} == {}
