"""Faults of every kind on the links of the fourteen systems give the same bytes in each placement."""

import pytest
from conftest import differences, in_process
from softrig_control.nodes.fault import FaultParams
from softrig_core import rig_of
from softrig_core.wire import types
from test_container import run, short

pytestmark = [pytest.mark.processes, pytest.mark.long]

SYSTEMS = [
    "dc_motor_smc", "dc_motor_fsfb", "economic_dispatch", "fault_location", "gupfc", "induction_dtc", "lsrm_fuzzy",
    "manipulator_adsmc", "optimal_control_mvim", "pv_mppt", "pwa_delay", "rectifier_mpc", "rehab_impedance",
    "tcp_aqm_smc",
]  # fmt: skip
KINDS = FaultParams.model_fields["kind"].annotation.__args__
SMALL = 1e-6  # so small that the controllers keep working
NUMBERS = {
    "scale": {"value": [1.0 + SMALL]},
    "saturate": {"value": [1e6]},
    "delay": {"overtaking": False},
    "add": {"points": [0.0, SMALL], "linear": True},
    "replace": {"points": [0.5], "probability": 0.0},
    "loss": {"probability": 0.1},
    "repeat": {"probability": 0.1},
    "spike": {"probability": 0.1, "value": [SMALL]},
    "invalid": {"probability": 0.05},
}


def faulty(name, shift):
    """A system with a fault on every link, the k-th of the (k + shift)-th kind."""
    rig = short(name, 200)
    links = [
        (m, p, reader)
        for m in rig.members
        for p in m.outputs
        for reader, _ in rig.readers(m, p)
        if reader.executable != "figures"
    ]
    faults = {}
    for k, (source, port, reader) in enumerate(links):
        kind = KINDS[(k + shift) % len(KINDS)]
        if kind == "replace" or (kind == "invalid" and (reader.is_plant or port.msgtype == types.BUTTON.name)):
            kind = "noise"
        numbers = {"value": [SMALL]} | NUMBERS.get(kind, {})
        period = source.params.period
        if kind == "delay":
            numbers |= {"delay": period, "jitter": period}
        if kind == "silence":
            numbers |= {"every": 5.0 * period, "lasts": 2.0 * period}
        faults[f"fault_{k}"] = {"link": f"{port.topic} -> {reader.name}", "kind": kind, **numbers}
    return rig_of(rig.scenario.having(faults=faults))


@pytest.mark.parametrize("shift", [0, 7])
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_system_with_a_fault_on_every_link_gives_the_same_bytes(name, shift, tmp_path):
    rig = faulty(name, shift)
    seed = rig.scenario.seed
    expected = in_process(rig, seed)
    contained = run(faulty(name, shift), tmp_path / "container", seed)
    assert contained.error == ""
    assert differences(expected, contained.recording) == []
    if shift == 0 and len(rig.members) < 16:
        apart = run(faulty(name, shift), tmp_path / "processes", seed, groups=[])
        assert apart.error == ""
        assert differences(expected, apart.recording) == []
