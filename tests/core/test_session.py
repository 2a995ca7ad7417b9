"""Runs in this process against independent code: a loop of the difference equation, message by message, lists of
requests.
"""

import gc
import math
import pickle
import random
import signal as signals_of_the_system
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import in_process, make_scenario
from faultrig import COMMAND, REFERENCE, STATE, Lag, Source
from softrig_core import (
    Block,
    BlockParams,
    Plant,
    Recording,
    Rig,
    RunError,
    Sample,
    ScenarioError,
    Session,
    array,
    command,
    feed,
    joint_state,
    param,
    rig_of,
    run_inprocess,
    scalars,
    simulate,
)
from softrig_core.block.codec import encoder
from softrig_core.block.loop import YOUNG
from softrig_core.block.schedule import Schedule
from softrig_core.run import session as module
from softrig_core.run.branch import branched, parted
from softrig_core.run.expand import FIGURES
from softrig_core.run.inprocess import keeper
from softrig_core.run.simulate import Run
from softrig_core.wire.parameter_event import encode
from softrig_core.wire.recording import Recording as Kept

MS = 1_000_000
BASIC = {"plant": "plant", "source": "source", "gain": "gain"}


class LiveParams(BlockParams):
    k: float = param(2.0, "gain", live=True)


class Live(Block[LiveParams]):
    """A gain that may be changed during a run."""

    INPUTS = (STATE, REFERENCE)
    OUTPUTS = (COMMAND,)

    def update(self, x, t, state, reference):
        return x, {"command": (self.p.k * (reference[0] - state[0]),)}


LAST = 20  # number of the last tick


def wired():
    blocks = {"plant": Lag(period=0.01), "source": Source(period=0.01), "law": Live(period=0.01)}
    return Rig.from_blocks(blocks, 0.01 * LAST)


def by_hand(until, turned):
    """The commands of the ticks before `until`; the gain is the value that was last set at or before a tick."""
    x, messages = 0.0, []
    for k in range(min(until, LAST)):
        gain = ([2.0] + [value for at, value in turned if at <= k])[-1]
        u = gain * (0.001 * (10 * k % 2000) - x)
        messages.append(u)
        x = x + 0.01 * 1.0 * (max(-10.0, min(10.0, u)) - x)
    return messages


class Model:
    """The state of a session: its next tick, and which values were set when."""

    def __init__(self, at=0, turned=()):
        self.at, self.turned = at, [*turned]

    def agrees(self, session):
        assert session.t == pytest.approx(0.01 * min(self.at, LAST))
        assert session.over == (self.at > LAST)
        assert session.ticks == LAST
        topics = session.recording.topics
        assert len(topics["lag/state"].times) == len(topics["/clock"].times) == self.at
        signals = session.run.signals
        if self.at:
            assert signals["lag/command/u/effort"].x == pytest.approx(by_hand(self.at, self.turned), abs=1e-12)
        assert session.run.reached_s == pytest.approx(0.01 * max(self.at - 1, 0))


@pytest.mark.parametrize("kept", [3, 256])
@pytest.mark.parametrize("seed", range(4))
def test_a_session_that_goes_back_and_branches_at_random_is_the_run_with_the_same_changes(seed, kept, monkeypatch):
    monkeypatch.setattr(module, "KEPT", kept)
    draw, session, model = random.Random(seed), Session(wired()), Model()
    for _ in range(25):
        act = draw.choice(["step", "go", "set", "set", "rewind", "branch"])
        if act == "step":
            n = draw.choice([1, 1, 2, 5])
            session.step(n)
            model.at = min(model.at + n, LAST + 1)
        elif act == "go":
            k = draw.randrange(LAST + 2)
            session.go(0.01 * k - draw.choice([0.0, 0.004]) if k else 0.0)
            model.at = max(model.at, min(k, LAST + 1))
        elif act == "set":
            value = draw.choice([0.5, 1.0, 3.0])
            session.set({"law.k": value})
            model.turned.append((model.at, value))
        elif act == "rewind":
            k = draw.randrange(LAST + 2)
            if k > min(model.at, LAST):
                with pytest.raises(ScenarioError, match="expected a time that the run has reached, at most"):
                    session.rewind(0.01 * k)
            else:
                undone = [value for at, value in model.turned if at >= k]
                assert session.rewind(0.01 * k) == ({"law.k": undone[-1]} if undone else {})
                model = Model(k, [t for t in model.turned if t[0] < k])
        else:
            k = draw.choice([None, draw.randrange(min(model.at, LAST) + 1)])
            other = session.branch() if k is None else session.branch(0.01 * k)
            model_before = (
                Model(model.at, model.turned) if k is None else Model(k, [t for t in model.turned if t[0] < k])
            )
            model_before.agrees(other)
            other.go()
            model_before.at = LAST + 1
            model_before.agrees(other)
        model.agrees(session)
        assert len(session._kept) <= max(kept, 2)
    session.go()
    model.at = LAST + 1
    model.agrees(session)


def test_a_session_stores_a_state_every_few_ticks_and_half_of_them_if_there_are_too_many(monkeypatch):
    monkeypatch.setattr(module, "KEPT", 4)
    session = Session(wired())
    seen = []
    for _ in range(LAST):
        session.step()
        seen.append(sorted(session._kept))
    assert seen[0] == [0]  # with room for four states of twenty ticks, every fifth is kept
    assert seen[4] == [0, 5]
    assert seen[14] == [0, 5, 10, 15]
    assert seen[19] == [0, 10, 20]


def test_changes_of_several_nodes_are_undone_by_their_newest_values():
    rig = Rig.from_blocks({"plant": Lag(period=0.01), "source": Source(period=0.01), "law": Live(period=0.01)}, 0.2)
    session = Session(rig)
    session.set({"law.k": 1.0})
    session.step(3)
    session.set({"law.k": 4.0})
    session.set({"law.k": 5.0})
    session.step(2)
    assert session.rewind(0.03) == {"law.k": 5.0}
    for bad in ({"law": 1.0}, {"": 1.0}, {"lav.k": 1.0}, {"law.": 1.0}):
        with pytest.raises(ScenarioError, match=r"expected node\.parameter with node one of plant, source, law"):
            session.set(bad)
    assert session.rewind(0.0) == {"law.k": 1.0}


# ---- a run that went another way ----


def test_changes_of_a_branch_are_those_before_its_time_those_of_the_scenario_and_its_own():
    scenario = rig_of(wired()).scenario
    assert scenario.name
    run = simulate(wired())
    for t, node, values in (
        (20 * MS, "law", {"k": 1.0}),
        (30 * MS, "law", {"k": 4.0}),
        (50 * MS, "plant", {"gain": 3.0}),
    ):
        run.recording.note(t, encode(t, f"/{node}", values))
    rig = run.rig

    def changes(at, values, epoch=0):
        return [(c["at"], c["set"]) for c in branched(rig, run.recording, at, values, epoch)]

    assert changes(0.03, {}) == [(0.02, {"law.k": 1.0})]
    assert changes(0.030000001, {"law.k": 9.0}) == [
        (0.02, {"law.k": 1.0}),
        (0.03, {"law.k": 4.0}),
        (0.030000001, {"law.k": 9.0}),
    ]
    assert changes(0.0, {"law.k": 9.0}) == [(0.0, {"law.k": 9.0})]
    assert len(changes(0.2, {})) == 3
    for at, text in ((0.2000001, "0.2000001"), (-0.1, "-0.1"), (math.nan, "nan")):
        with pytest.raises(ScenarioError) as error:
            changes(at, {})
        assert str(error.value) == f"t = {text} s: expected a time that the run has reached, 0 to 0.2 s"
    with pytest.raises(ScenarioError, match=r"0 to 0 s$"):
        branched(rig, Recording([]), 0.1, {}, 7)
    later = Kept([("lag/state", STATE.msgtype)])
    later.add(0, 70 * MS + 500, b"")
    later.note(20 * MS + 500, encode(20 * MS + 500, "/law", {"k": 1.0}))
    result = branched(rig, later, 0.07, {}, 500)
    assert result == [{"at": 0.02, "set": {"law.k": 1.0}}]


def test_changes_of_the_scenario_stay_from_their_tick_on():
    own = [{"at": 0.015, "set": {"gain.k": 3.0}}, {"at": 0.03, "set": {"gain.k": 5.0}}]

    made = [SimpleNamespace(at=15 * MS, values={"k": 3.0}), SimpleNamespace(at=30 * MS, values={"k": 5.0})]
    member = SimpleNamespace(name="gain", changes=made, schedule=Schedule("0.01"))
    recording = Kept([("a", "b")])
    recording.add(0, 100 * MS, b"")
    for at, kept in ((0.02, own), (0.020000001, own[1:]), (0.03, own[1:]), (0.030000001, [])):
        assert branched(SimpleNamespace(members=[member]), recording, at, {}) == kept


def test_the_first_difference_of_two_runs_is_reported_for_up_to_three_topics_earliest_first():
    def recording(**topics):
        made = Kept((name, "x") for name in topics)
        for k, times in enumerate(topics.values()):
            for t, data in times:
                made.add(k, t * MS, data)
        return made

    same = [(0, b"a"), (10, b"b"), (20, b"c")]
    one = recording(a=same, b=same, c=same, d=same, e=same)
    assert parted(one, one, 1.0) == ""
    two = recording(a=[*same[:2], (20, b"x")], b=[(0, b"x"), *same[1:]], c=same[:1], d=[*same, (25, b"d")], e=same)
    assert parted(one, two, 1.0) == "b at t = 0 s, c at t = 0.01 s, a at t = 0.02 s"
    assert parted(one, two, 0.02) == "b at t = 0 s, c at t = 0.01 s"
    assert parted(two, one, 0.01) == "b at t = 0 s"
    assert parted(one, recording(d=[*same, (25, b"d")]), 1.0) == "d at t = 0.025 s"
    assert parted(one, recording(z=same), 1.0) == ""
    assert parted(one, recording(a=[(0, b"a"), (11, b"b")]), 1.0) == "a at t = 0.01 s"


# ---- a single node, fed by a recording ----


def test_a_single_node_is_fed_with_the_messages_that_had_arrived_at_each_of_its_ticks():
    rig = rig_of(make_scenario(BASIC, 0.1))
    gain = next(m for m in rig.members if m.name == "gain")
    recording = in_process(rig)
    whole = feed(gain, 0, recording)
    assert whole.topics["lag/command"].data == recording.topics["lag/command"].data
    for lacking in ("lag/state", "lag/reference"):
        other = in_process(rig)
        del other.topics[lacking]
        with pytest.raises(RunError, match=f"^the recording has nothing on {lacking}, which gain reads$"):
            feed(gain, 0, other)
        other = in_process(rig)
        other.topics[lacking] = other.topics[lacking].since(1)
        with pytest.raises(RunError, match=f"^the recording of {lacking} begins after t = 0 s$"):
            feed(gain, 0, other)
    late = in_process(rig)  # a missing message leaves the one before in effect
    topic = late.topics["lag/reference"]
    del topic.times[3], topic.data[3]
    messages = [parse(d) for d in feed(gain, 0, late).topics["lag/command"].data]
    was = [parse(d) for d in recording.topics["lag/command"].data]
    assert [a == b for a, b in zip(messages, was, strict=True)] == [k != 3 for k in range(10)]
    assert messages[3] == pytest.approx(was[3] - 2.0 * 0.01)


def parse(data):
    return COMMAND.layout().decode(data)[1][0]


# ---- many answers in one batch ----


PORTS = [
    joint_state("a", "a", ["x", "y"], position="m"),
    joint_state("b", "b", ["x"], position="m", delayed=True),
    command("c", "c", ["u"], "N", sporadic=True),
    joint_state("d", "d", ["x"], position="m", delayed=True, sporadic=True),
]


def test_many_answers_recorded_together_equal_those_of_single_ticks():
    """Silence is a flag of zero after the numbers; the stamps of delayed outputs are stored beside."""
    draw = np.random.default_rng(2)
    n, size = 7, sum(p.size for p in PORTS)
    late, silent = ([p for p in PORTS if getattr(p, what)] for what in ("delayed", "sporadic"))
    times, stamps = np.arange(n) * 10 * MS, draw.integers(0, 10**9, (n, len(late)))
    values = np.hstack([draw.normal(size=(n, size)), draw.integers(0, 2, (n, len(silent)))])
    numbers = [5, 3, 8, 1]
    at_once, singly = [], []
    counts: dict[str, int] = {p.name: 0 for p in PORTS}
    step = SimpleNamespace(plain=False, outputs=PORTS, link=None, name="law", counts=dict(counts))
    keep = keeper(step, SimpleNamespace(add=lambda *m: at_once.append(m)), PORTS, numbers)
    keep.send_all(times, values, stamps)
    encoders = [encoder(p.layout(), counts, p.name) for p in PORTS]
    for k in range(n):
        first = 0
        for port, number, encode_one in zip(PORTS, numbers, encoders, strict=True):
            own = values[k, first : first + port.size].tolist()
            first += port.size
            if port in silent and not values[k, size + silent.index(port)]:
                continue
            stamp = int(stamps[k, late.index(port)]) if port in late else int(times[k])
            singly.append((number, int(times[k]), encode_one(stamp, own)))
    assert sorted(at_once) == sorted(singly)
    assert [m for m in at_once if m[0] == 5] == [m for m in singly if m[0] == 5]
    step = SimpleNamespace(plain=False, outputs=PORTS[:2], link=None, name="law", counts={})
    kept = []
    keep = keeper(step, SimpleNamespace(add=lambda *m: kept.append(m)), [*PORTS[:2]], [4, 2])
    assert step.link is keep
    rows = ((1.0, 2.0), Sample(7, (3.0,)))
    keep.send(5, rows, ())
    keep.send(6, (None, rows[1]), ())
    a, b = (p.layout().encode for p in PORTS[:2])
    assert kept == [(4, 5, a(5, rows[0])), (2, 5, b(7, (3.0,))), (2, 6, b(7, (3.0,)))]


def test_arrays_continue_with_the_numbers_of_the_step():
    port = array("m", "m", {"row": 2}, "V")
    kept = []
    step = SimpleNamespace(plain=False, outputs=[port], link=None, name="law", counts={"m": 3})
    keep = keeper(step, SimpleNamespace(add=lambda *m: kept.append(m)), [port], [0])
    for t in (1, 2):
        keep.send(t, ((1.0, 2.0),), ())
    keep.send_all(np.array([3, 4]), np.array([[1.0, 2.0]] * 2), np.empty((2, 0), np.int64))  # each answer alone
    assert [data for _, _, data in kept] == [port.layout().encode(n, (1.0, 2.0)) for n in (3, 4, 5, 6)]


def test_the_garbage_collector_runs_rarely_during_a_run_and_as_before_after_it():
    before, seen = gc.get_threshold(), []
    try:
        for threshold, during in ((700, YOUNG), (10**6, 10**6), (0, 0)):
            gc.set_threshold(threshold, 10, 9)
            usual = gc.get_threshold()  # some versions of Python do not keep all three thresholds
            run_inprocess(wired(), 0, progress=lambda t: seen.append(gc.get_threshold()))
            assert set(seen) == {(during, *usual[1:])}
            assert gc.get_threshold() == usual
            seen.clear()
    finally:
        gc.set_threshold(*before)


def test_runs_of_a_study_leave_observers_out_and_record_selected_topics():
    rig = rig_of(make_scenario(BASIC | {"watcher": "watcher"}, 0.1))
    assert list(run_inprocess(rig, 0)) == ["plant", "source", "gain", "watcher"]
    assert list(run_inprocess(rig, 0, runs=2)) == ["plant", "source", "gain"]
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, 0, recording, topics=["lag/command"])
    assert {name for name, topic in recording.topics.items() if topic.times} == {"lag/command"}
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, 0, recording, topics=["lag/applied"])
    assert {name for name, topic in recording.topics.items() if topic.times} == {"lag/state", "lag/applied", "/clock"}
    guest = rig_of(make_scenario(BASIC | {"gain": {"executable": "gain", "external": True}}, 0.1))
    with pytest.raises(ScenarioError, match=r"^node gain is external: in-process runs have no place for it$"):
        run_inprocess(guest, 0)


# ---- a finished run ----


FIGURE = {"function": "mean", "arguments": {"signal": "lag/state/x/position"}, "unit": "m"}
EXPECT = {"mean_x": "at least 0", "top": "at most -1"}


def judged():
    figures = {"mean_x": FIGURE, "top": FIGURE | {"function": "maximum"}}
    return rig_of(make_scenario(BASIC, 0.1, figures=figures, expect=EXPECT))


def test_a_run_reports_its_progress_and_the_result_of_its_figures():
    run = simulate(judged(), seed=3)
    run.wall_s = 0.0123456
    assert repr(run) == "<Run of test (inprocess, seed 3): 0.1 s in 0.0123 s, 1 of 2 figures pass>"
    assert (run.stopped_at, run.reached_s) == ("", 0.1)
    assert [r.name for r in run.missed] == ["top"]
    assert set(run.figures) == {"mean_x", "top"}
    run.stopped = signals_of_the_system.SIGTERM
    assert repr(run) == ("<Run of test (inprocess, seed 3): stopped by SIGTERM at t = 0.1 s, 1 of 2 figures pass>")
    run.error = "law: broken"
    assert repr(run) == "<Run of test (inprocess, seed 3): law: broken>"
    empty = Run(run.rig, 0, Recording([]), epoch=5)
    assert (empty.reached_s, empty.mode, empty.status, empty.blocks) == (0.0, "inprocess", {}, {})
    shifted = Run(run.rig, 0, run.recording, epoch=-(10**8))
    assert shifted.reached_s == pytest.approx(0.2)


def test_a_stopped_run_cannot_report_never():
    late = {"function": "reach_time", "arguments": {"signal": "lag/state/x/position", "level": 99.0}, "unit": "s"}
    rig = rig_of(make_scenario(BASIC, 0.1, figures={"rise": late}, expect={"rise": "at most 1"}))
    run = simulate(rig)
    (result,) = run.results
    stopped = Run(rig, 0, run.recording, stopped=2)
    (late,) = stopped.results
    assert late.error == "not until 0.1 s, when the run was stopped"
    assert math.isnan(late.number)
    assert result.error == "never"


def test_a_branch_of_a_run_lasts_as_long_as_the_run_or_as_stated():
    run = simulate(wired())
    for duration, reached in ((None, 0.2), (0.1, 0.1)):
        other = run.branch(0.05, {"law.k": 1.0}, duration=duration)
        assert (other.reached_s, other.begun is run.rig) == (reached, True)
        x = other.signals["lag/command/u/effort"].x
        assert x == pytest.approx(by_hand(LAST, [(5, 1.0)])[: len(x)], abs=1e-12)


def test_requested_signals_are_recorded_with_those_that_figures_read():
    run = simulate(judged(), signals=["lag/command/u"])
    assert {name for name, topic in run.recording.topics.items() if topic.times} >= {"lag/command", "lag/state"}
    assert not run.recording.topics["lag/reference"].times
    none = simulate(wired(), signals=[])
    assert not any(topic.times for topic in none.recording.topics.values())


@pytest.mark.parametrize("seed", ["1", -1, 1.5, True, 2**63, [1]])
def test_what_is_no_seed_is_refused(seed):
    for begin in (simulate, Session):
        with pytest.raises(ScenarioError, match=r"seed = .*: expected a whole number from 0 to 2\^63 - 1"):
            begin(wired(), seed=seed)
    assert simulate(wired(), seed=np.int64(3)).seed == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"what": 3}, "expected a scenario's name or file, a draft, a scenario or a rig, got int"),
        ({"overrides": ["law.gain=1"]}, "overrides: expected a mapping of 'node.parameter' to value, got"),
        ({"overrides": {1: 2}}, "overrides: expected a mapping"),
        ({"signals": ["lag/command/v"]}, r"no signal 'lag/command/v' \(did you mean 'lag/command/u/effort'\?\)"),
    ],
)
def test_a_wrong_argument_of_simulate_is_named(arguments, message):
    with pytest.raises(ScenarioError, match=message):
        simulate(**{"what": wired(), **arguments})


def test_signals_cannot_be_changed_in_place():
    """Times are those of other signals, too, and bags and figures are made of the same columns."""
    for part in simulate(wired()).signals["lag/state/x/position"]:
        with pytest.raises(ValueError, match="read-only"):
            part *= 60.0
        assert part.copy().flags.writeable


def test_one_signal_may_be_a_text():
    topics = [
        {name for name, topic in simulate(judged(), signals=s).recording.topics.items() if topic.times}
        for s in ("lag/command/u", ["lag/command/u"])
    ]
    assert topics[0] == topics[1]


def test_a_node_of_figures_knows_what_to_measure_and_how_often():
    """Unless its parameters say otherwise, or no subscriber asks."""
    live = dict(zip(("package", "executable"), FIGURES, strict=True))
    own = {"ports": "[]", "figures": "[]"}
    nodes = {name: {"package": "faultrig", "executable": e} for name, e in BASIC.items()}
    scenario = make_scenario(BASIC, 0.1, figures={"mean_x": FIGURE}, expect={"mean_x": "at least 0"})
    for parameters, asked, reported in (({}, True, True), ({}, False, False), (own, True, False)):
        rig = rig_of(scenario.having(nodes=nodes | {"shown": live | {"parameters": parameters}}), live=asked)
        member = next(m for m in rig.members if m.name == "shown")
        assert (member.params.figures != "[]") is reported
        assert [p.topic for p in member.inputs] == (["lag/state"] if reported else [])
        if reported:
            assert member.params.period == 0.01
        assert rig.scenario.nodes["shown"].parameters == parameters


def test_a_run_is_returned_whole_from_another_process():
    """As joblib and multiprocessing return it."""
    run = simulate(judged(), seed=3)
    back = pickle.loads(pickle.dumps(run))
    assert back.recording.topics == run.recording.topics
    assert (back.figures, back.results, back.seed, back.reached_s) == (run.figures, run.results, 3, run.reached_s)
    restored = pickle.loads(pickle.dumps(simulate(wired()))).branch(0.05, {"law.k": 1.0})
    assert restored.recording.topics == simulate(wired()).branch(0.05, {"law.k": 1.0}).recording.topics
    assert pickle.loads(pickle.dumps(back)).figures == run.figures


class Whole(Plant):
    """A plant that returns a whole number beside a float."""

    OUTPUTS = (scalars("level", "tank/level", {"height": "m", "depth": "m"}),)

    def outputs(self, x, t):
        return {"level": (0, 0.5)}

    def advance(self, x, t):
        return x


class Turned(Block):
    """A law whose answer depends on the sign of a zero."""

    INPUTS, OUTPUTS = Whole.OUTPUTS, (command("pump", "tank/pump", ["pump"], "V"),)

    def update(self, x, t, level):
        return x, {"pump": (math.atan2(-level[0], -1.0),)}


@pytest.mark.parametrize("runs", [1, 10**6])
def test_a_whole_number_beside_a_float_reaches_its_reader_as_a_float(runs):
    """Over ROS it is a float, too. The integer -0 is 0 and -0.0 is not, so Python and native code would differ
    otherwise.
    """
    run = simulate(Rig.from_blocks({"tank": Whole(), "law": Turned()}, duration=0.1), runs=runs)
    assert set(run.signals["tank/pump/pump/effort"].x.tolist()) == {-math.pi}
