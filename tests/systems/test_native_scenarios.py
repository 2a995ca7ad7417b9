"""Native code on every scenario: which run natively, why the others do not, and that the results equal Python's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
from board_by_hand import UNO
from hypothesis import assume, given, settings, strategies as st
from softrig_core import Observer, Recording, Rig, RunError, Scenario, ScenarioError, Solver, load_scenario, rig_of
from softrig_core.block.change import changeable
from softrig_core.block.params import flatten
from softrig_core.native import fitted
from softrig_core.native.compile import plain
from softrig_core.native.engine import Engine, Native, compiled
from softrig_core.run.inprocess import record, wired
from softrig_core.scenario.scenario_file import list_scenarios

Make = Callable[..., Any]
TICKS = 150  # ticks of the clock
SLOWEST = 4  # ticks of the slowest node


def typed(made: Any) -> Any:
    """Run in Python the text that numba gets."""
    return plain(made)


def short(rig: Rig) -> float:
    """Return a duration in which each node except observers answers some ticks, s."""
    periods = [m.schedule.period for m in rig.members if not issubclass(m.block_class, Observer)]
    wanted = float(max(TICKS * rig.clock.schedule.clock, SLOWEST * max(periods)))
    return min(wanted, rig.scenario.duration or wanted)


def ran(rig: Rig, make: Make | None) -> tuple[Recording, Mapping[str, Any], str, Native]:
    """Run a rig in Python, tick by tick, or with the text that `make` returns."""
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    steps = wired(rig, {m.name: m.block(rig.scenario.seed) for m in rig.members})
    record(rig, steps, recording)
    answers = Engine(list(steps.values()), make or plain)
    error = ""
    try:
        for _ in answers.run() if make else answers.loop.run():
            pass
    except RunError as broken:
        error = str(broken)
    return recording, steps, error, answers.native


def compared(scenario: Any, make: Make = plain) -> Native:
    """Compare both: messages, reports, errors, states, times."""
    result, others, other_error, native = ran(rig_of(scenario), make)
    if not native.ticks:
        return native
    wanted, steps, error, _ = ran(rig_of(scenario), None)
    assert other_error == error
    assert result.topics == wanted.topics
    for name, step in steps.items():
        other = others[name]
        if not isinstance(step.block, Solver):  # the state of a solver has its computation time
            assert repr(other.x) == repr(step.x) or other.x == step.x, name
        assert (other.reports, other.t, repr(other.values), repr(other.last_answer)) == (
            step.reports,
            step.t,
            repr(step.values),
            repr(step.last_answer),
        ), name
    return native


def scenario(name: str, **more: Any) -> Scenario:
    """Return a scenario with a short duration."""
    result = load_scenario(name)
    return result.having(duration=short(rig_of(name)), **more)


STAYS = {
    "a solver at each tick": """
        economic_dispatch economic_dispatch_e3_150 economic_dispatch_case1 economic_dispatch_case3
        economic_dispatch_two_stage economic_dispatch_pso economic_dispatch_80_units
        economic_dispatch_1000_units economic_dispatch_e2 economic_dispatch_e2_cold economic_dispatch_ieee30
        economic_dispatch_wood economic_dispatch_wood_losses optimal_control_mvim optimal_control_mvim_n4
        optimal_control_mvim_n12 optimal_control_mvim_start optimal_control_mvim_dt01
        optimal_control_mvim_printed optimal_control_mvim_a2 optimal_control_mvim_a2_5s
        optimal_control_mvim_reactor optimal_control_mvim_s1 optimal_control_mvim_s1_n5
        optimal_control_mvim_s3 optimal_control_mvim_s3_n2 optimal_control_mvim_s3_n6 optimal_control_mvim_s4
        optimal_control_mvim_s4_5s optimal_control_mvim_s4_1s optimal_control_mvim_s4_bias
        optimal_control_mvim_s4_bias_5s optimal_control_mvim_s6 optimal_control_mvim_s6_n24
        optimal_control_mvim_wie""",
    "CertificateNode.update: an answer that is not written out": """
        rectifier_mpc_certificate rectifier_mpc_certificate_plus rectifier_mpc_certificate_minus
        rectifier_mpc_certificate_signs""",
    "GupfcPlant.outputs: slice": "gupfc_s2",
    "pulses.gates: an array of something else than numbers": "gupfc_s5 gupfc_s5_sweep",
    "many ticks are discarded": "manipulator_adsmc_stretch_minus manipulator_adsmc_stretch_plus",
    # These searches read each sample, so the runs stay in Python until the search has ended.
    "gives up": "pv_mppt_certified_transients pv_mppt_s2_certified_transients pv_mppt_s5_certified_transients",
    "Track.open: an assignment to a part of something": """
        pwa_delay_p3 pwa_delay_p3_unstable pwa_delay_p3_sine pwa_delay_p3_nonlinear""",
    "MoveSolver.solve: slice": """
        rectifier_mpc_dc_motor rectifier_mpc_n1_qp1 rectifier_mpc_n1_qp2 rectifier_mpc_n1_qp2_x2""",
    "TcpPackets.seen: .inside of Traffic": """
        tcp_aqm_smc_s4 tcp_aqm_smc_s4_windup tcp_aqm_smc_s4_sspd tcp_aqm_smc_s4_detuned tcp_aqm_smc_s4_robust
        tcp_aqm_smc_s4_sspid tcp_aqm_smc_s4_pid""",
}
REASONS = {name: reason for reason, names in STAYS.items() for name in names.split()}


def cause(reason: str) -> str:
    """Return a reason without module, line and values."""
    where, _, what = reason.rpartition(", line ")
    return f"{'.'.join(where.split('.')[-2:])}: {what.partition(': ')[2]}" if where else reason


def why_not(rig: Rig) -> str:
    """Return the reason, known without a tick, why a rig stays in Python; a tick may take a minute of a solver."""
    if any(m.external for m in rig.members):
        return "external"
    often = min(m.schedule.every for m in rig.members)
    solvers = [m for m in rig.members if issubclass(m.block_class, Solver) and m.schedule.every == often]
    return "a solver at each tick" if solvers else ""


@pytest.fixture(autouse=True)
def _each_its_own_text(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make sure that no text of one scenario is used for another."""
    monkeypatch.setattr(fitted, "RUNS_A_TEXT", 0)


@pytest.mark.long
@pytest.mark.parametrize("name", sorted({*list_scenarios(), *REASONS} - {*UNO}))
def test_a_scenario_gives_the_same_as_in_python(name: str) -> None:
    """By the text that numba gets and by the one that Python runs, on 150 ticks each."""
    reason = why_not(rig_of(name))
    if not reason:
        natives = [compared(scenario(name), make) for make in (typed, plain)]
        reason = next((cause(n.reason) or "gives up" for n in natives if n.ticks <= n.given_up), "")
    assert reason == REASONS.get(name, "")


# One scenario of each kind, and what may change during the run.
SOME = ("dc_motor_smc_b2", "dc_motor_fsfb_s1", "rehab_impedance_r5", "tcp_aqm_smc_pid", "rectifier_mpc_l1",
        "manipulator_adsmc", "induction_dtc", "lsrm_fuzzy", "pv_mppt_s5", "gupfc_short")  # fmt: skip

FAULTS: tuple[dict[str, Any], ...] = (
    {"kind": "offset", "value": [0.1]},
    {"kind": "scale", "value": [0.9]},
    {"kind": "noise", "value": [0.01]},
    {"kind": "drift", "value": [0.1]},
    {"kind": "quantise", "value": [0.1]},
    {"kind": "saturate", "value": [1.0]},
    {"kind": "stuck"},
    {"kind": "spike", "value": [1.0], "probability": 0.2},
    {"kind": "delay", "delay": 0.03},
    {"kind": "loss", "probability": 0.3},
    {"kind": "loss", "burst_begins": 0.1, "burst_ends": 0.3},
    {"kind": "repeat", "probability": 0.3},
    {"kind": "silence"},
    {"kind": "invalid", "probability": 0.02},
    {"kind": "add", "points": [0.0, 0.1, 0.2], "span": 0.5},
)


@st.composite
def changed(draw: st.DrawFn, names: tuple[str, ...]) -> Scenario:
    """Draw a scenario with parameters that change during the run, and with a fault on a link."""
    name = draw(st.sampled_from(names))
    rig, changes = rig_of(name), []
    live = {
        f"{m.name}.{p}": v
        for m in rig.members
        for p in changeable(type(m.params))
        if isinstance(v := flatten(m.params).get(p), (bool, float))
    }
    duration = short(rig)
    for key in draw(st.lists(st.sampled_from(sorted(live)), max_size=3, unique=True)) if live else ():
        value = live[key]
        to = (
            not value
            if isinstance(value, bool)
            else value * draw(st.floats(0.5, 1.5)) + draw(st.sampled_from((0.0, 0.1)))
        )
        changes.append({"at": draw(st.floats(0.01, 0.99)) * duration, "set": {key: to}})
    faults: dict[str, Any] = {}
    if draw(st.booleans()):
        topic = draw(
            st.sampled_from(
                sorted(
                    p.topic
                    for m in rig.members
                    for p in m.outputs
                    if any(link.port.topic == p.topic for other in rig.members for link in other.links.values())
                )
            )
        )
        faults["fault"] = {"link": topic, "from": duration / 3, **draw(st.sampled_from(FAULTS))}
    try:
        result = scenario(name, changes=sorted(changes, key=lambda c: c["at"]), faults=faults)
        rig_of(result)
    except (ScenarioError, ValueError):
        assume(False)
    return result


def test_a_text_made_elsewhere_appears_in_the_report() -> None:
    """A reason is passed to a method, which puts it into its report: the tick stays in Python."""
    compared(scenario("rectifier_mpc_l1", changes=[{"at": 0.0015625, "set": {"gpc_controller.set_point": 600.0}}]))


def test_an_array_that_has_grown_is_appended_to_the_previous_one() -> None:
    fault = {"link": "axis/state", "from": 0.5, "kind": "delay", "delay": 0.03}
    compared(scenario("dc_motor_fsfb_s1", faults={"fault": fault}), typed)


def test_a_rejection_between_two_ticks_counts_at_the_next() -> None:
    """The plant publishes twenty times as often as the speed controller, which has the message held at its next
    tick.
    """
    fault = {"link": "joint_states", "from": 0.0025, "kind": "invalid", "probability": 0.02}
    compared(scenario("lsrm_fuzzy", faults={"fault": fault}))


@given(changed(SOME))
@settings(max_examples=6, deadline=None, derandomize=True)
def test_changes_during_a_run_are_the_same(case: Scenario) -> None:
    compared(case)


@pytest.mark.long
@pytest.mark.parametrize("make", [typed, plain])
@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_changes_during_a_long_run_are_the_same(make: Make, data: st.DataObject) -> None:
    compared(data.draw(changed(SOME)), make)


@pytest.mark.long
@pytest.mark.parametrize("name", SOME)
def test_numba_computes_the_same_as_python(name: str) -> None:
    native = compared(scenario(name), compiled)
    assert native.ticks > native.given_up


def test_a_text_belongs_to_rigs_with_equal_wiring() -> None:
    """Two rigs of the same nodes, in which an event reaches another channel and a port has another bound."""
    event = {"channels": ["grid_amplitude"], "units": ["V"], "times": [0.0, 0.02], "values": [180.0, 150.0]}
    others = {f"event_source.{key}": value for key, value in event.items()}
    fitted._texts.clear()
    for overrides in ({}, others, {}):
        native = compared(load_scenario("rectifier_mpc").changed(duration=0.06, overrides=overrides))
        assert native.ticks > 0
    assert len(fitted._texts) == 2
