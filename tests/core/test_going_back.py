"""Back to any tick and on from there: in every scenario the same messages, reports and states."""

import dataclasses
import re
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from board_by_hand import UNO
from conftest import make_scenario
from faultrig import Gain, Lag, Source
from softrig_core import Level, Rig, RunError, ScenarioError, Session, array, list_scenarios, rig_of, simulate
from softrig_core.block.loop import Loop
from softrig_core.block.tables import Tables
from softrig_core.run import session as module
from softrig_core.run.inprocess import record, wired
from softrig_core.wire.recording import Recording

BEFORE, AFTER = 40, 50  # ticks before and after the instant to which the run goes back
# One rig for each kind of state: tuples, delay lines, solutions of delay equations, searches, packets.
DAILY = ("dc_motor_smc_b2", "dc_motor_fsfb_s1", "induction_dtc", "lsrm_fuzzy_b5", "manipulator_adsmc_s3", "pv_mppt_pso",
         "pwa_delay_p3", "rectifier_mpc_certificate", "rehab_impedance_b9", "tcp_aqm_smc_delay", "tcp_aqm_smc_s4",
         "gupfc_s5")  # fmt: skip
MEASURED = re.compile(r"[\d.]+ s of CPU time")


def same(a: Any, b: Any) -> bool:
    """Return whether two states are equal to the last bit; internal buffers and caches do not count."""
    if isinstance(a, str):
        return isinstance(b, str) and MEASURED.sub("", a) == MEASURED.sub("", b)
    if isinstance(a, float | np.floating):
        return type(a) is type(b) and float(a).hex() == float(b).hex()
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and same(a.tolist(), b.tolist())
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a) if f.compare
        )
    if type(a).__eq__ is not object.__eq__ or a is b:
        return bool(a == b)
    return type(a) is type(b) and same(a.__getstate__(), b.__getstate__())


def held_against(one: Session, other: Session) -> None:
    assert one.error == other.error
    assert other.recording.topics == one.recording.topics
    states, others = Tables(one.steps.values()).keep(), Tables(other.steps.values()).keep()
    assert [name for name in states if not same(states[name], others[name])] == []


def goes_back(name: str) -> None:
    """Run on from a tick, and once more from its state in a rig that is wired again."""
    session = Session(name)
    before = min(BEFORE, session.ticks // 2)
    session.step(before)
    other = session.branch()
    for run in (session, other):
        with suppress(RunError):  # some scenarios end with an error on purpose
            run.step(AFTER)
    held_against(session, other)


@pytest.mark.parametrize("name", DAILY)
def test_a_rig_wired_again_continues_from_a_stored_state(name):
    goes_back(name)


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(list_scenarios()) - set(DAILY) - {*UNO}))
def test_every_rig_wired_again_continues_from_a_stored_state(name):
    goes_back(name)


# a session -------------------------------------------------------------------------------------------------------

SOFTER = {"dc_motor_smc.delta": 0.5}


def short():
    return Session("dc_motor_smc", duration=0.1)


def test_a_rewound_run_with_other_gains_equals_one_that_changes_them_at_that_time():
    session = short()
    session.go()
    assert (session.over, session.t) == (True, 0.1)
    plain = session.run
    assert plain.recording.topics == simulate("dc_motor_smc", duration=0.1).recording.topics
    session.rewind(0.04)
    assert (session.over, session.t, session.run.reached_s) == (False, 0.04, 0.0399)
    session.set(SOFTER)
    session.go()
    scripted = rig_of("dc_motor_smc", duration=0.1).scenario.having(changes=[{"at": 0.04, "set": SOFTER}])
    assert session.recording.topics == simulate(scripted).recording.topics
    session.rewind(0.06)  # a change made before that instant stays
    session.go()
    assert session.recording.topics == simulate(scripted).recording.topics
    session.rewind(0.04)  # a change made at that instant is undone
    session.go()
    assert session.recording.topics == plain.recording.topics != simulate(scripted).recording.topics


def test_changes_of_the_scenario_are_applied_once_however_often_it_goes_back():
    own = [{"at": 0.02, "set": {"dc_motor_smc.delta": 0.3}}, {"at": 0.07, "set": {"dc_motor_smc.delta": 0.8}}]
    scenario = rig_of("dc_motor_smc", duration=0.1).scenario.having(changes=own)
    session = Session(scenario)
    for t in (0.01, 0.08, 0.05):
        session.go()
        session.rewind(t)
    session.go()
    assert session.recording.topics == simulate(scenario).recording.topics


def test_a_branch_does_not_change_its_run():
    session = short()
    session.go(0.03)
    session.set(SOFTER)
    session.go(0.05)
    session.set({"dc_motor_smc.delta": 0.7})
    branch, earlier_branch = session.branch(), session.branch(0.03)
    for run in (branch, earlier_branch, session):
        run.go()
    assert branch.recording.topics == session.recording.topics
    assert earlier_branch.recording.topics == simulate("dc_motor_smc", duration=0.1).recording.topics
    assert session.recording.topics != earlier_branch.recording.topics


def test_few_states_of_many_ticks_are_stored_and_any_tick_is_reached(monkeypatch):
    monkeypatch.setattr(module, "KEPT", 4)
    session = short()
    session.set({"dc_motor_smc.delta": 0.6})  # at a tick whose state has just been saved
    session.go(0.02)
    session.set(SOFTER)
    session.go()
    assert len(session._kept) <= 4
    whole = session.recording
    for t in (0.0999, 0.0501, 0.0203, 0.02, 0.0):
        session.rewind(t)
        assert session.t == t
        assert session.recording.topics == whole.before(round(t * 1e9)).topics
    assert session.step() is None
    assert session.t == 0.0001


@pytest.mark.parametrize(
    "nodes",
    [
        # Messages of arrays, which are numbered.
        {"plant": "plant", "spread": "spread", "peaks": "peaks", "weigh": "weigh"},
        {"plant": "plant", "source": "source", "link": "link", "law": "late_gain"},
        {"plant": "plant", "source": "source", "gain": {"executable": "gain", "parameters": {"noise": 1.0}}},
    ],
)
def test_every_kind_of_port_continues_where_it_was(nodes):
    session = Session(make_scenario(nodes, duration=0.5))
    session.go(0.2)
    other = session.branch()
    for run in (session, other):
        run.go()
    held_against(session, other)


class Locked(Gain):
    """Contains something that cannot be copied."""

    def save(self, x):
        raise RuntimeError("the lock is taken")


class Failing(Gain):
    """Fails at its sixth tick."""

    def update(self, x, t, state, reference):
        if x == 5:
            raise ArithmeticError("deliberate")
        return super().update(x, t, state, reference)


def session_with(law):
    return Session(Rig.from_blocks({"plant": Lag(), "law": law, "source": Source()}, 1.0))


def test_a_state_that_cannot_be_stored_is_named_with_the_reason():
    session = session_with(Locked())
    session.go(0.5)  # the run itself needs no saved state
    text = r"^this run cannot go back: law: its state at t = 0 s cannot be kept: RuntimeError: the lock is taken"
    with pytest.raises(RunError, match=text):
        session.rewind(0.1)
    session.go()
    assert session.over


def test_a_run_that_broke_can_go_back():
    session = session_with(Failing())
    with pytest.raises(RunError, match=r"^law: failed at t = 0.05 s: ArithmeticError: deliberate"):
        session.go()
    assert (session.over, session.t) == (True, 0.05)
    assert session.run.error.startswith("law: failed")
    session.rewind(0.03)
    assert (session.over, session.error) == (False, "")
    session.go(0.05)
    with pytest.raises(RunError, match=r"^law: failed at t = 0.05 s"):
        session.step()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda s: s.rewind(0.06), r"^t = 0.06 s: expected a time that the run has reached, at most 0.05 s$"),
        (lambda s: s.rewind(-1.0), r"^t = -1.0 s: expected a time of at least 0$"),
        (lambda s: s.go(float("nan")), r"^t = nan s: expected a time of at least 0$"),
        (lambda s: s.set({"nobody.delta": 1.0}), r"^'nobody.delta': expected node.parameter with node one of "),
        (lambda s: s.set({"dc_motor_smc.delta": -1.0}), r"^node dc_motor_smc: "),
        (lambda s: s.set({"dc_motor_plant.J": 1.0}), r"^node dc_motor_plant: parameter J may not change while running"),
    ],
)
def test_a_refused_change_of_a_session_changes_nothing(act, message):
    session = short()
    session.go(0.05)
    with pytest.raises(ScenarioError, match=message):
        act(session)
    session.go()
    assert session.recording.topics == simulate("dc_motor_smc", duration=0.1).recording.topics


# a finished run ----------------------------------------------------------------------------------------------------


def test_a_run_continues_differently_from_a_time():
    run = simulate("dc_motor_smc", duration=0.1)
    softer = run.branch(0.04, SOFTER)
    stiffer = softer.branch(0.06, {"dc_motor_smc.delta": 0.9}, duration=0.08)
    session = short()
    session.go(0.04)
    session.set(SOFTER)
    session.go()
    assert softer.recording.topics == session.recording.topics
    session.rewind(0.06)
    session.set({"dc_motor_smc.delta": 0.9})
    session.go(0.08)
    assert stiffer.recording.before(80_000_000).topics == session.run.recording.topics
    assert stiffer.reached_s == 0.08
    undone = softer.branch(0.04, {})
    assert undone.recording.topics == run.recording.topics


def test_changes_of_the_scenario_itself_stay():
    own = [{"at": 0.02, "set": {"dc_motor_smc.delta": 0.3}}, {"at": 0.07, "set": {"dc_motor_smc.delta": 0.8}}]
    scenario = rig_of("dc_motor_smc", duration=0.1).scenario.having(changes=own)
    run = simulate(scenario)
    assert run.branch(0.07, {}).recording.topics == run.recording.topics
    with_mine = [own[0], {"at": 0.05, "set": SOFTER}, own[1]]
    assert run.branch(0.05, SOFTER).recording.topics == simulate(scenario.having(changes=with_mine)).recording.topics


def test_a_branch_of_another_run_reports_where_the_runs_differ():
    run = simulate("dc_motor_smc", duration=0.1)
    other = simulate("dc_motor_smc", duration=0.1, overrides={"dc_motor_smc.delta": 0.5})
    other.rig = run.rig
    text = r"^dc_motor_smc: what ran up to t = 0.05 s is not what had run, first motor/\S+ at t = \S+ s"
    with pytest.raises(RunError, match=text):
        other.branch(0.05, {})


@pytest.mark.parametrize("t", [0.2, -0.1, float("nan")])
def test_a_branch_from_a_time_outside_the_run_is_refused(t):
    with pytest.raises(ScenarioError, match=r"expected a time that the run has reached, 0 to 0\.1 s$"):
        simulate("dc_motor_smc", duration=0.1).branch(t, SOFTER)


FIXED = (
    "answer",
    "advance",
    "block",
    "_link",
    "_asking",
    "waits",
    "readers",
    "fed",
    "stamps",
    "name",
    "schedule",
)


def everything(steps: Any) -> dict[str, dict[str, Any]]:
    """Return all attributes of steps that may change, whether the tables list them or not."""
    return {
        name: {key: repr(value) for key, value in vars(step).items() if key not in FIXED}
        | {"params": repr(step.params), "unanswered": step.unanswered}
        for name, step in steps.items()
    }


class Numbered(Gain):
    """A law that publishes a numbered array, and reports at times."""

    OUTPUTS = (*Gain.OUTPUTS, array("row", "row", {"a": 2}, "V", sporadic=True))

    def update(self, x, t, state, reference):
        x, outputs = super().update(x, t, state, reference)
        if t % 30_000_000 == 0:
            self.report(Level.WARN, "third", f"{t}")
            return x, {**outputs, "row": (t * 1e-9, state[0])}
        return x, outputs


@pytest.mark.parametrize("seed", range(3))
def test_tables_restore_everything_that_a_step_holds_however_often(seed: int) -> None:
    """Random ticks, changes and rewinds; a value outside of the tables is found."""
    draw = np.random.default_rng(seed)
    blocks = {"plant": Lag(), "law": Numbered(), "source": Source()}
    rig = Rig.from_blocks(blocks, 3.0)
    steps, recording = wired(rig, blocks), Recording((n, p.msgtype) for n, p in rig.topics.items())
    record(rig, steps, recording)
    tables, loop, k = Tables(steps.values()), Loop(list(steps.values())), 0
    kept: dict[int, Any] = {}
    known: dict[int, Any] = {}
    for _ in range(60):
        kept[k], now = tables.keep(), everything(steps)
        assert known.setdefault(k, now) == now
        if draw.random() < 0.4:
            k = int(draw.choice(list(kept)))
            tables.go_back(kept[k])
            assert everything(steps) == known[k]
        ticks = loop.run(k)
        for _ in range(int(draw.integers(1, 6))):
            # Fields that the wall clock and the link of a solver set.
            steps["law"].unanswered, steps["law"].begun = k % 3, k
            next(ticks)
            k += 1
    assert steps["law"].counts["row"] == 1 + (k - 1) // 3
