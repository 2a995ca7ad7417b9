"""The step and the runner: which values may leave a block, ages, ticks one by one; alike in every placement."""

import gc
import math
import re
import subprocess
import sys

import numpy as np
import pytest
from conftest import make_scenario
from faultrig import Gain, Lag, Source
from simulated import SimulatedRig, World
from softrig_core import Block, Recording, Rig, RunError, Signals, rig_of, run_inprocess, scalars
from softrig_core.block import step as step_module
from softrig_core.block.link import Link
from softrig_core.block.loop import Loop, answer, move
from softrig_core.block.schedule import Schedule
from softrig_core.block.step import Step
from softrig_core.block.tables import Tables
from softrig_core.run.inprocess import record, wired


def overdriven(values, period=0.01):
    """A stable plant under a command; the unit of both is the volt, whose plausible range ends at 1e7."""
    nodes = {
        "linear_plant": {
            "package": "softrig_control",
            "executable": "linear_plant",
            "parameters": {"period": period, "num": [1.0], "den": [1.0, 1.0], "command": "command/u/effort"},
        },
        "command_source": {
            "package": "softrig_control",
            "executable": "command_source",
            "parameters": {"period": period, "channels": ["u"], "values": [values]},
        },
    }
    return rig_of(make_scenario(nodes, 1.0))


def test_a_value_beyond_its_range_ends_the_run_and_names_its_publisher_in_every_placement():
    text = "command_source: command u/effort became 2e+07 V, expected at most 1e+07 in magnitude at t = 0 s"
    with pytest.raises(RunError) as error:
        run_inprocess(overdriven(2e7), 0)
    assert str(error.value) == text
    run = SimulatedRig(overdriven(2e7), World(), "lockstep")
    assert run.run()["command_source"] == "failed"
    assert f"command_source: {run.adapters['command_source'].error}" == text
    assert set(SimulatedRig(overdriven(0.99e7), World(), "lockstep").run().values()) == {"done"}
    run_inprocess(overdriven(0.99e7), 0)


def test_in_real_time_a_controller_beyond_its_range_publishes_its_safe_value_and_reports_it():
    run = SimulatedRig(overdriven(2e7), World(), "realtime")
    assert set(run.run().values()) == {"done"}
    assert "became 2e+07 V" in run.adapters["command_source"].step.reports["failed"][1]
    command = run.recording.topics["command"].data
    layout = run.adapters["command_source"].outgoing.outputs[0].layout
    assert {layout.decode(data)[1] for data in command} == {(0.0,)}


@pytest.mark.parametrize("text", [(0.5, 2.0), [0.5, 2.0], (0.5, 2)])
def test_values_that_are_almost_a_row_of_floats_are_converted(text):
    step, rows = _alone({"out": text})
    step.answer(0)
    assert rows == [((0.5, 2.0),)]
    assert step.numbers == (0.5, 2.0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ((0.5,), "out has 1 values, expected 2"),
        ((0.5, math.nan), "out b/position became nan"),
        ((0.5, -1e9), "out b/position became -1e"),
        (("x", 0.0), "out is not a sequence of numbers"),
        (None, "returned no out at t = 0 s; the outputs it returned: none"),
        ((math.inf, -math.inf), "out a/position became inf"),
    ],
)
def test_an_output_that_may_not_leave_a_block_is_reported(text, reason):
    step, rows = _alone({"out": text} if text else {})
    with pytest.raises(RunError, match=reason) as error:
        step.answer(0)
    assert error.value.node == "odd"
    assert rows == []


@pytest.mark.parametrize(
    ("returned", "reason"),
    [
        ({"oot": (0.5, 2.0)}, "returned no out at t = 0 s; the outputs it returned: oot"),
        (
            {"out": (0.5, 2.0), "oot": (1.0,)},
            r"odd returned 'oot' at t = 0 s, which is not an output of it \(did you mean 'out'\?\); its outputs: out",
        ),
        ((0.5, 2.0), "returned no out at t = 0 s; the outputs it returned: a tuple"),
    ],
)
def test_an_output_that_a_block_does_not_have_is_refused(returned, reason):
    step, rows = _alone(returned)
    with pytest.raises(RunError, match=reason):
        step.answer(0)
    assert rows == []


def test_after_a_rejected_input_the_last_accepted_row_is_held():
    """A block publishes arrays, one of them its own memory: neither their type nor their later changes are kept."""
    row = np.array([0.5, 2.0])
    answer = {"out": row}
    step, rows = _alone(answer)
    step.answer(0)
    row[:] = 9.0
    answer["out"] = [7.0, 7.0]
    step.bad = True
    step.answer(10_000_000)
    assert rows == [((0.5, 2.0),), ((0.5, 2.0),)]
    assert step.last_answer == ((0.5, 2.0),)
    assert not step.bad


def _alone(answer):
    """A step whose input has a name that is not a word of Python, and what it has published."""

    class Odd(Block):
        """Publishes the values that the test sets."""

        INPUTS = (scalars("for", "for", {"x": ""}), scalars("of-all", "all", {"x": ""}))
        OUTPUTS = (scalars("out", "out", {"a": "V", "b": "V"}),)

        def update(self, x, t, **inputs):
            assert inputs == {"for": (0.0,), "of-all": (0.0,)}
            return x, answer

    block, rows = Odd(name="odd"), []
    step = Step("odd", block, Schedule(0.1), *block.ports(block.p))

    class Sending(Link):
        def send(self, t, text, numbers):
            rows.append(text)

    Sending(step)
    return step, rows


def test_a_rig_is_stepped_tick_by_tick_with_one_node_played_by_python():
    class Agent(Block):
        """A controller that is set from outside between two ticks."""

        INPUTS, OUTPUTS = Gain.INPUTS, Gain.OUTPUTS
        action = 0.0

        def update(self, x, t, state, reference):
            return state[0], {"command": (self.action,)}

    rig = Rig.from_blocks({"plant": Lag(), "law": Agent(), "source": Source()}, 0.1)
    blocks = {m.name: m.block(0) for m in rig.members}
    steps = wired(rig, blocks)
    ticks = Loop(list(steps.values())).run()
    x = 0.0
    for k in range(11):
        blocks["law"].action = float(k)
        assert next(ticks) == 10_000_000 * k
        if k < 10:  # without an output at the end, the controller has no last tick
            assert steps["law"].x == x
            x += 0.01 * (k - x)
    assert steps["plant"].x.x == x
    assert next(ticks, "over") == "over"


KINDS = (
    rig_of("dc_motor_smc_faults", duration=0.05),  # its messages can be silent, late or invalid
    rig_of("dc_motor_fsfb_stretch_jitter", duration=0.3),
    rig_of("lsrm_fuzzy_b5_trip", duration=0.01),
    *(
        rig_of(make_scenario(nodes, duration=0.4))
        for nodes in (
            # Messages of arrays, which are numbered.
            {"plant": "plant", "spread": "spread", "peaks": "peaks", "weigh": "weigh"},
            {"plant": "plant", "source": "source", "link": "link", "law": "late_gain"},
            {"plant": "plant", "source": "source", "gain": {"executable": "gain", "parameters": {"noise": 1.0}}},
        )
    ),
)


@pytest.mark.parametrize("rig", KINDS, ids=lambda rig: rig.scenario.name)
def test_ticks_whose_text_is_generated_equal_those_of_the_loop(rig, monkeypatch):
    """Messages, states, held inputs, reports: of the functions that a page shows, and of their generated form."""

    def ran():
        steps = wired(rig, {m.name: m.block(3) for m in rig.members})
        recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
        record(rig, steps, recording)
        times = list(Loop(list(steps.values())).run())
        kept = Tables(steps.values()).keep()
        states = {n: (re.sub(r" at 0x\w+", "", repr(k.x)), k.tables, k.values) for n, k in kept.items()}
        return times, recording.topics, states

    written = ran()
    monkeypatch.setattr(step_module, "answerer", lambda step: lambda t: answer(step, t))
    monkeypatch.setattr(step_module, "mover", lambda step: lambda t: move(step, t))
    assert ran() == written
    assert written[0][-1] == rig.end


def test_recorded_numbers_have_the_bytes_of_each_message(monkeypatch):
    monkeypatch.setenv("SOFTRIG_JIT", "0")  # native code would skip calls that this test counts
    rig = Rig.from_blocks({"plant": Lag(), "law": Gain(), "source": Source()}, 0.1)
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    halves = []
    run_inprocess(rig, 0, recording, lambda t: halves.append(len(recording.topics["lag/state"].data)))
    assert halves == list(range(1, 12))  # read while the run records
    port = next(p for m in rig.members for p in m.outputs if p.topic == "lag/state")
    topic = recording.topics["lag/state"]
    results = [port.layout().decode(data) for data in topic.data]
    assert [stamp for stamp, _ in results] == topic.times == [10_000_000 * k for k in range(11)]
    assert [port.layout().encode(*message) for message in results] == topic.data


def test_a_recording_keeps_numbers_until_bytes_are_needed_and_both_are_equal():
    rig = Rig.from_blocks({"plant": Lag(), "law": Gain(), "source": Source()}, 1.0)

    def record():
        recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
        run_inprocess(rig, 0, recording)
        return recording

    numbers, made = record(), record()
    assert all(topic.data for topic in made.topics.values() if topic.times)  # encodes the bytes of all messages
    signals, expected = Signals(numbers), Signals(made)
    assert [t for t, topic in numbers.topics.items() if topic.columns() is None] == ["lag/offset", "lag/kick"]
    assert list(signals) == list(expected)
    for name, signal in expected.items():
        assert (signals[name].t == signal.t).all()
        assert (signals[name].x == signal.x).all()
    assert [(t, topic.name, data) for t, topic, data in numbers.messages()] == [
        (t, topic.name, data) for t, topic, data in made.messages()
    ]
    assert not numbers.topics["lag/state"]._data
    numbers.topics["lag/state"].times.pop()  # the caller changes the times
    assert numbers.topics["lag/state"].columns() is None


@pytest.mark.parametrize(
    ("package", "executable"), [("softrig_systems", "aqm_controller"), ("softrig_control", "gpc_certificate")]
)
def test_nothing_is_imported_in_the_first_tick_of_a_node_in_real_time(package, executable):
    code = f"""
import sys
from softrig_core import ByHand, Plant
from softrig_nodes.rehearsal import rehearse
from softrig_core.rig.installed import load_block
kind = load_block({package!r}, {executable!r})
rehearse(kind, kind.Params(), "node", always=True)
block = ByHand(kind(kind.Params(), "node"))
values = {{p.name: p.initial for p in kind.ports(block.block.p)[0]}}
before = set(sys.modules)
if isinstance(block.block, Plant):
    block.outputs(0)
    block.advance(0, **values)
else:
    block.update(0, **values)
print(sorted(set(sys.modules) - before))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("[]\n", "")


@pytest.mark.parametrize(("usual", "during"), [((700, 9, 9), 200_000), ((300_000, 9, 9), 300_000), ((0, 9, 9), 0)])
def test_a_run_in_process_leaves_the_garbage_collector_as_it_was(usual, during):
    before, seen = gc.get_threshold(), []
    gc.set_threshold(*usual)
    try:
        run_inprocess(overdriven(1.0), 0, progress=lambda t: seen.append(gc.get_threshold()[0]))
        assert set(seen) == {during}
        assert gc.get_threshold() == usual
        with pytest.raises(RunError):
            run_inprocess(overdriven(2e7), 0)
        assert gc.get_threshold() == usual
    finally:
        gc.set_threshold(*before)
