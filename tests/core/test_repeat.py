"""`run --like`: a run is repeated from its bag, with what people did during it and with its external messages."""

import json
import random
import shutil
from functools import partial

import pytest
from conftest import differences
from simulated import SimulatedRig, World
from softrig_bags.read import read_bag
from softrig_bags.tape import port_of, written
from softrig_bringup.cli import main
from softrig_bringup.folder import ResultsFolder
from softrig_bringup.run.run import save, summary
from softrig_core import Run, rig_of, simulate

MS = 1_000_000


MINE = """
extends: dc_motor_fsfb_s1
title: The axis under buttons that people press
nodes: {step_buttons: null}
duration: 1.0
"""
FAULTS = """
faults:
  offset: {link: axis/state -> fieldbus_delay, kind: offset, value: [0.05], active: false}
  loss: {link: axis/state -> fieldbus_delay, kind: loss, probability: 0.2}
"""


def pressed(folder, mode="lockstep", delay=None, faults=""):
    """The folder of a run in which somebody presses a button, sends a reference, changes a gain, switches a fault."""
    folder.mkdir()
    name = folder.parent / "mine.yaml"
    name.write_text(MINE + faults)
    rig = rig_of(name)
    world = World(delay) if delay else World()
    run = SimulatedRig(rig, world, mode, seed=3)
    law = run.adapters["fsfb_controller"]
    button = next(i for i in law.inputs if i.name == "reverse")
    reference = next(i for i in law.inputs if i.name == "reference")
    start = run.epoch or world.now

    def send(value):
        data = reference.port.layout().encode(run.epoch and world.now, (value,))
        for reader in world.readers:
            if reader.topic == "/axis/reference":
                reader.receive(data)

    # The simulated lockstep starts after 20 ms and then runs as fast as its messages.
    moments = (500 * MS, 503 * MS, 505 * MS) if mode == "realtime" else (20_030_000, 20_150_000, 20_250_000)
    people = (partial(law.buttons.press, button.port), partial(send, 12.5), partial(law.step.set, {"kp": 50.0}))
    for moment, act in zip(moments, people, strict=True):
        world.at(start + moment, act)
    if faults:
        switch = next(i for i in run.adapters["offset"].inputs if i.name == "toggle")
        world.at(start + 601 * MS, partial(run.adapters["offset"].buttons.press, switch.port))
        world.at(start + 703 * MS, partial(run.adapters["offset"].step.set, {"value": [0.1]}))
    assert set(run.run().values()) == {"done"}
    status = {name: {"missed_deadlines": 0, **_figures(a)} for name, a in run.adapters.items()}
    done = Run(rig, 3, run.recording, status=status, mode="realtime" if run.epoch else "processes", epoch=run.epoch)
    command = f"softrig run {name} --mode processes --seed 3"
    save(done, summary(done, done.results, command), ResultsFolder(folder))
    return run.recording


def _figures(adapter):
    return adapter.drive.statistics() if adapter.options.mode == "realtime" else {}


def repeat(tmp_path, capsys, *arguments):
    """Exit status and output of a repetition."""
    status = main(["run", *arguments, "--no-plots", "--out", str(tmp_path / "again")])
    return status, capsys.readouterr().err


@pytest.mark.parametrize(
    "mode", ["inprocess", pytest.param("container", marks=[pytest.mark.processes, pytest.mark.long])]
)
def test_buttons_and_external_messages_are_repeated(mode, tmp_path, capsys):
    """From the bag alone, moved to another place."""
    first = pressed(tmp_path / "first")
    assert len(first.topics["reverse"].times) == 2
    assert len(first.topics["axis/reference"].times) == 1
    shutil.move(tmp_path / "first" / "bag", tmp_path / "alone")
    status, text = repeat(tmp_path, capsys, "--like", str(tmp_path / "alone"), "--mode", mode)
    assert status == 0
    assert "alone number for number: " in text
    again = read_bag(tmp_path / "again" / "bag")
    assert differences(first, again) == ["axis/reference"]  # the publisher sent this message without a stamp
    assert again.topics["axis/controller_state"].data[-1] != again.topics["axis/controller_state"].data[0]
    # Repeat the repetition.
    capsys.readouterr()
    assert main(["run", "--like", str(tmp_path / "again"), "--mode", "inprocess", "--no-plots", "--out",
                 str(tmp_path / "third")]) == 0  # fmt: skip
    assert not differences(again, read_bag(tmp_path / "third" / "bag"))


@pytest.mark.parametrize(
    ("seed", "faults"),
    [(0, ""), (2, FAULTS), *(pytest.param(s, f, marks=pytest.mark.long) for s in range(3, 12) for f in ("", FAULTS))],
)
def test_a_run_in_real_time_that_was_never_late_is_repeated_in_lockstep(seed, faults, tmp_path, capsys):
    """Messages take up to a fifth of the law's period, with two faults on the way a seventh, in any order; a button, a
    message and a gain in between, and faults on what the law measures, one of which is switched on by its button.
    """
    rng = random.Random(seed)
    longest = 10 * MS // (7 if faults else 5)  # so that plant, controller and figures answer within one period
    first = pressed(tmp_path / "first", "realtime", lambda *_: rng.randrange(1_000, longest), faults)
    metrics = json.loads((tmp_path / "first" / "metrics.json").read_text())
    assert [c["node"] for c in metrics["changes"]] == ["fsfb_controller", *(["offset"] if faults else [])]
    if faults:
        assert len(first.topics["axis/state/offset/toggle"].times) == 2
        assert 60 < len(first.topics["axis/state/loss"].times) < 95
    status, text = repeat(tmp_path, capsys, "--like", str(tmp_path / "first"), "--mode", "inprocess")
    assert status == 0, text
    assert "first number for number: " in text
    assert "was late" not in text


def test_a_run_in_real_time_that_was_late_reports_it_and_the_differences(tmp_path, capsys):
    rng = random.Random(0)  # one message in five arrives only after the next tick
    pressed(tmp_path / "first", "realtime", lambda *_: rng.choice([MS, MS, MS, MS, 15 * MS]))
    status, text = repeat(tmp_path, capsys, "--like", str(tmp_path / "first"), "--mode", "inprocess")
    assert status == 0
    assert "differs from" in text
    assert "axis/command from t = 0." in text
    assert "that run was late: " in text
    assert "messages after their tick" in text


def test_a_repetition_that_differs_names_the_place(tmp_path, capsys, monkeypatch):
    pressed(tmp_path / "first")
    monkeypatch.setattr(
        "softrig_bringup.options.like.from_outside", lambda rig, recording: []
    )  # the repetition is not told which node was external
    status, text = repeat(tmp_path, capsys, "--like", str(tmp_path / "first"), "--mode", "inprocess")
    assert status == 1
    assert "differs from" in text
    assert "axis/command from t = 0." in text


def test_a_run_is_not_replaced_by_its_own_repetition(tmp_path, capsys):
    pressed(tmp_path / "first")
    assert main(["run", "--like", str(tmp_path / "first" / "bag"), "--out", str(tmp_path / "first")]) == 2
    assert "it holds the run that --like repeats" in capsys.readouterr().err


# another way from a time on --------------------------------------------------------------------------------------

KP = ("--set", "fsfb_controller.kp=30.0")


def from_there(tmp_path, capsys, run, at, *arguments, out="other"):
    """Exit status, output, and the recording."""
    status = main(
        ["run", "--from", f"{run}@{at}", *arguments, "--mode", "inprocess", "--no-plots", "--out", str(tmp_path / out)]
    )
    printed = capsys.readouterr().err
    return status, printed, json.loads((tmp_path / out / "metrics.json").read_text()) if not status else {}


def test_external_messages_before_a_branch_are_repeated_and_later_ones_are_not(tmp_path, capsys):
    first = pressed(tmp_path / "first")
    down, up = first.topics["reverse"].times
    assert down < up
    status, text, record = from_there(tmp_path, capsys, tmp_path / "first", up / 1e9, *KP, "--duration", "0.9")
    assert (status, f"up to t = {up / 1e9:.9g} s: repeats {tmp_path / 'first'} number for number: " in text) == (
        0,
        True,
    )
    assert record["changes"] == [{"at_s": up / 1e9, "node": "fsfb_controller", "set": {"kp": 30.0}}]
    assert record["changed"] == [
        f"from {tmp_path / 'first'} at {up / 1e9:.9g} s",
        "fsfb_controller.kp=30.0",
        "duration 0.9",
    ]
    assert (record["from"]["run"], record["duration_s"]) == (str(tmp_path / "first"), 0.9)
    other = read_bag(tmp_path / "other" / "bag")
    assert other.topics["reverse"].times == [down]
    assert not differences(first.before(up), other.before(up))
    assert differences(first, other)


@pytest.mark.long
def test_a_branch_is_repeated_from_its_bag_alone(tmp_path, capsys):
    plain = ["dc_motor_smc", "--duration", "0.1", "--mode", "inprocess", "--no-plots"]
    assert main(["run", *plain, "--out", str(tmp_path / "first")]) == 0
    softer, stiffer = ("--set", "dc_motor_smc.delta=0.5"), ("--set", "dc_motor_smc.delta=0.9")
    from_there(tmp_path, capsys, tmp_path / "first", 0.04, *softer)
    from_there(tmp_path, capsys, tmp_path / "other" / "bag", 0.06, *stiffer, "--duration", "0.12", out="third")
    shutil.rmtree(tmp_path / "first")
    shutil.rmtree(tmp_path / "other")
    status, text = repeat(tmp_path, capsys, "--like", str(tmp_path / "third"), "--mode", "inprocess")
    assert (status, "third number for number: " in text) == (0, True)
    assert main(["draw", "plot", str(tmp_path / "third"), "--out", str(tmp_path / "drawn")]) == 0
    run = simulate("dc_motor_smc", duration=0.1).branch(0.04, {"dc_motor_smc.delta": 0.5})
    run = run.branch(0.06, {"dc_motor_smc.delta": 0.9}, duration=0.12)
    assert not differences(run.recording, read_bag(tmp_path / "third" / "bag"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--from", "first"], "argument --from: 'first': expected RUN@T, the folder of a run and a time from 0 to 1e9"),
        (["--from", "first@x"], "argument --from: 'first@x': expected RUN@T"),
        (["--from", "first@-1"], "argument --from: 'first@-1': expected RUN@T"),
        (["--from", "nowhere@1"], "softrig: nowhere: expected the directory of a run"),
        (["--from", "first@0.2"], "--from first: t = 0.2 s: expected a time that the run has reached, 0 to 0.1 s"),
        (["--from", "first@0.05", "dc_motor_smc"], "--from repeats a run as it was: expected no scenario beside it"),
        (["--from", "first@0.05", "--seed", "3"], "--from repeats a run as it was: expected no --seed beside it"),
        (["--from", "first@0.05", "--set", "dc_motor_plant.J=1"], "parameter J may not change while running"),
        (["--from", "first@0.05", "--set", "nobody.k=1"], "expected node.parameter with node one of"),
        (["--from", "first@0.05", "--out", "first"], "--out first: it holds the run that --from continues"),
        (["--from", "first@0.05", "--like", "first"], "not allowed with argument"),
    ],
)
def test_an_impossible_branch_is_refused(arguments, message, branched_from, capsys, monkeypatch):
    monkeypatch.chdir(branched_from)
    assert main(["run", "--mode", "inprocess", "--no-plots", *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.fixture(scope="module")
def branched_from(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    plain = ["dc_motor_smc", "--duration", "0.1", "--mode", "inprocess", "--no-plots"]
    assert main(["run", *plain, "--out", str(folder / "first")]) == 0
    return folder


def test_a_branch_of_a_run_that_cannot_be_repeated_names_the_first_difference(tmp_path, capsys, monkeypatch):
    pressed(tmp_path / "first")
    monkeypatch.setattr("softrig_bringup.options.like.from_outside", lambda rig, recording: [])
    status, text, _ = from_there(tmp_path, capsys, tmp_path / "first", 0.9, *KP)
    assert status == 1
    assert "up to t = 0.9 s: differs from" in text
    assert "axis/command from t = 0." in text


def test_a_port_is_written_and_read():
    rig = rig_of("gupfc")
    for member in rig.members:
        for port in member.inputs:
            result = port_of(written(port))
            for what in ("msgtype", "labels", "units", "safe", "limits", "frame_id", "dims"):
                assert getattr(result, what) == getattr(port, what), what
            assert result.sporadic
            assert not result.held
