"""Every kind of fault on every topic of the fourteen systems: it starts, and does to each message what it says."""

import math

import numpy as np
import pytest
from softrig_control.nodes.fault import FaultParams
from softrig_core import Block, BlockParams, load_scenario, param, rig_of, simulate
from softrig_core.scenario.port_text import ports_of, ports_text, reader
from softrig_core.wire import types

# how long each runs here, s: some ticks of its laws, and at least one message of what seldom speaks
SYSTEMS = {
    "dc_motor_smc": 0.003,
    "dc_motor_fsfb": 0.3,
    "induction_dtc": 0.003,
    "lsrm_fuzzy": 0.003,
    "pv_mppt": 0.02,
    "rectifier_mpc": 0.01,
    "fault_location": 0.001,
    "gupfc": 0.004,
    "economic_dispatch": 2.0,
    "manipulator_adsmc": 0.01,
    "rehab_impedance": 0.01,
    "pwa_delay": 0.003,
    "tcp_aqm_smc": 0.02,
    "optimal_control_mvim": 8.0,
}
LATER = {"fault_location": {"verdict", "location", "objective"}, "pwa_delay": {"lyapunov"}}  # not spoken until then
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
    """What is read."""

    ports: str = param("[]", "as JSON", max_length=10_000_000)


class Tap(Block[TapParams]):
    """Reads links, so that there is somebody behind a fault."""

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
    scenario = rig.scenario.having(nodes=nodes, faults=faults, figures={}, expect={}, claims={}, plots=())
    return rig_of(scenario, classes={f"tap_{kind}": Tap for kind in kinds}), scenario.faults


def said(run, topic):
    """What a topic said: time, stamp and values of each message."""
    layout, record = run.rig.topics[topic].layout(), run.recording.topics[topic]
    return [(t, *layout.decode(bytes(data))) for t, data in zip(record.times, record.data, strict=True)]


def expected(kind, sent):
    """What a fault that is there from the begin makes of messages: (time, stamp, values) of each."""
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


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.long) if n in ("optimal_control_mvim", "pwa_delay") else n for n in SYSTEMS],
)
def test_each_kind_of_fault_does_on_each_topic_what_it_says(name):
    rig, faults = tapped(name, SYSTEMS[name])
    run = simulate(rig)
    assert not run.error
    checked = set()
    for fault, entry in faults.items():
        kind, topic = entry.parameters["kind"], entry.link.split(" -> ")[0]
        port = rig.topics[topic]
        # a plant also says how it ends, which nobody answers
        last = next(m.schedule.last for m in rig.members if m.name == fault)
        sent, came = [m for m in said(run, topic) if m[0] <= last], said(run, f"{topic}/{fault}")
        if port.delayed:  # such a link says what it has again until something newer has arrived
            sent = [m for k, m in enumerate(sent) if not k or m[1] > sent[k - 1][1]]
        at = f"{fault} on {topic}"
        if not sent:
            assert not came, at
            continue
        checked.add(topic)
        if kind == "noise":
            assert [m[0] for m in came] == [m[0] for m in sent], at
            if port.msgtype != types.BUTTON.name:
                added = np.ravel([np.subtract(b[2], a[2]) for a, b in zip(sent, came, strict=True)])
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
        assert [m[0] for m in came] == pytest.approx([m[0] for m in want], abs=1), at
        if port.delayed:
            assert [m[1] for m in came] == [m[1] for m in want], at
        np.testing.assert_array_equal([m[2] for m in came], [m[2] for m in want], err_msg=at)
    links = {entry.link.split(" -> ")[0] for entry in faults.values()}
    assert links - checked == LATER.get(name, set())
