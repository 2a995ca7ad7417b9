"""The search for a violation: right for known answers, repeatable, with reduced cases, and honest if it finds none."""

import json
import random
import re
import shutil
import sys

import numpy as np
import pytest
from conftest import differences, in_process
from expected_text import check_expected, figure_lines, on_paper
from softrig_bringup.cli import main
from softrig_bringup.falsify import engine, picture
from softrig_bringup.falsify.definition import falsification_of
from softrig_bringup.falsify.search import search
from softrig_bringup.falsify.shrink import shrink
from softrig_bringup.falsify.space import parse, space_of
from softrig_bringup.run.run import checked
from softrig_bringup.study.work import run, trial
from softrig_core import RunError, Scenario, ScenarioError, load_scenario, rig_of, simulate
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc

PIECES, PERIOD, LOAD = 15, 0.01, 1e-3


def loop(torques, times=None):
    """The ideal motor under PID, linear, with a load torque in steps."""
    times = times or [0.1 * k for k in range(len(torques))]
    nodes = {
        "plant": {
            "package": "softrig_drives",
            "executable": "dc_motor_plant",
            "parameters": {"period": PERIOD, "load_times": times, "load_torques": torques},
        },
        "reference": {
            "package": "softrig_control",
            "executable": "reference_source",
            "parameters": {"period": 0.1, "velocities": [0.0]},
            "remap": {"reference": "motor/reference"},
        },
        "pid": {
            "package": "softrig_drives",
            "executable": "dc_motor_pid",
            "parameters": {"period": PERIOD, "kp": 1.0, "ki": 10.0, "kd": 0.0},
        },
    }
    return Scenario.model_validate(
        {
            "name": "loop",
            "title": "loop",
            "system": "dc_motor",
            "source": "",
            "duration": 1.5,
            "nodes": nodes,
            "shared": {"speed": "motor/state/shaft/velocity", "voltage": "motor/command/armature/effort"},
            "requirements": {"deviation": "always abs(speed) <= 1"},
        }
    )


def measure_of(space, name):
    return lambda points: [run(trial(space.scenario, space.overrides(p), (name,)))["figures"][name] for p in points]


@pytest.mark.long
def test_the_worst_deviation_of_a_linear_loop_is_the_l1_norm_of_its_impulse_response():
    response = simulate(loop([LOAD, 0.0], [0.0, PERIOD])).signals["motor/state/shaft/velocity"].x
    bound = np.abs(response).sum()  # the largest response to any load torque bounded by LOAD
    space = space_of(loop([0.0] * PIECES), [parse("plant.load_torques", f"{-LOAD}..{LOAD}*{PIECES}")])
    match = search([o.size for o in space.overs], measure_of(space, "deviation"), 300, seed=1)
    assert 0.98 * bound < 1.0 - match.least < bound * (1.0 + 1e-9)
    assert match.runs <= 300
    at_random = search([o.size for o in space.overs], measure_of(space, "deviation"), 300, seed=1, sampler="random")
    assert (1.0 - at_random.least) < 0.8 * bound  # random search alone does not come near the bound
    assert match.trace == sorted(match.trace, reverse=True)


def test_cma_es_imports_without_the_other_optimisers_of_its_package(monkeypatch):
    for name in [name for name in sys.modules if name.startswith(("cmaes", "scipy.stats"))]:
        monkeypatch.delitem(sys.modules, name)
    search([3], lambda points: [sum(point) for point in points], 30)
    assert "cmaes" in sys.modules
    assert "scipy.stats" not in sys.modules


def test_a_disturbance_added_to_a_signal_is_a_fault_and_its_worst_profile_is_found_too():
    space = space_of(loop([0.0]), [parse("motor/command/armature/effort+", "-0.5..0.5*6")])
    (target,) = space.targets
    point = [0.0, 1.0, 0.25, 1.0, 0.5, 0.0]
    assert space.overrides(point)[target] == [-0.5, 0.5, -0.25, 0.5, 0.0, -0.5]
    rig = rig_of(space.scenario.changed(overrides=space.overrides(point)))
    signals = simulate(rig).signals
    t, u = signals["motor/command/armature/effort"]
    added = signals["motor/command/profile_0/armature/effort"].x - u
    steps = np.minimum((t / 0.25 + 1e-9).astype(int), 5)
    assert added == pytest.approx(np.array([-0.5, 0.5, -0.25, 0.5, 0.0, -0.5])[steps], abs=1e-12)


@pytest.mark.parametrize(
    ("key", "text", "reason"),
    [
        ("plant.R", "3..1", "3 is above 1"),
        ("plant.R", "log -1..1", "a logarithm needs a range above 0"),
        ("plant.R", "1", r"expected LOW\.\.HIGH"),
        ("motor/state/shaft/velocity", "0..1", "a signal needs a profile, such as 0..1.6"),
        ("plant.load_torques", "0..1*0", "expected 1 to 50 numbers, got 0"),
        ("plant.R+", "0..1", "only signals can be added to"),
        ("plnt.R", "0..1", "did you mean plant.R"),
        ("plant.Rr", "0..1", "plant has no parameter 'Rr' .did you mean 'R'"),
        ("plant.load_torques", "0..1", "a list of 1: a number is searched"),
        ("plant.R", "0..1*3", "plant.R is 0"),
        ("plant.rig", "0..1", "plant.rig is False"),
        ("plant.R", "-1..1", "parameter R"),
        ("motor/stat/shaft/velocity", "0..1*3", "did you mean 'motor/state/shaft/velocity'"),
    ],
)
def test_an_impossible_range_is_refused_before_the_first_run(key, text, reason):
    with pytest.raises(ScenarioError, match=reason):
        space_of(loop([0.0]), [parse(key, text)])


def test_a_violation_is_reduced_parameter_by_parameter_fault_by_fault_step_by_step():
    scenario = loop([0.0] * 4)
    faults = {"noise": {"link": "motor/state -> pid", "kind": "noise", "value": [0.001]}}
    scenario = Scenario.model_validate({**dict(scenario), "faults": faults})
    overs = [parse("plant.load_torques", "-0.01..0.01*4"), parse("pid.kp", "0.5..2"), parse("noise.value", "0..0.01*1")]
    space = space_of(scenario, overs)
    worst = space.overrides([1.0, 0.0, 1.0, 1.0, 0.0, 1.0])
    limit = 1.0 - run(trial(space.scenario, worst, ("deviation",)))["figures"]["deviation"]

    def violates(case):
        return 1.0 - run(trial(*case, ("deviation",)))["figures"]["deviation"] > 0.4 * limit

    (small, changes), runs = shrink(space, worst, violates, 100)
    assert violates((small, changes))
    assert small.faults == {}  # the search removed the noise, which the violation does not need
    assert "noise.value" not in changes
    assert len(set(changes["plant.load_torques"])) < 3
    assert runs <= 100


@pytest.mark.parametrize(("margin", "violates"), [(-1e-300, True), (0.0, False), (1e-300, False), (None, False)])
def test_a_margin_of_zero_is_not_a_violation(monkeypatch, margin, violates):
    """Neither at first nor while a case is reduced."""
    monkeypatch.setattr(engine, "trial", lambda *case, runs: case)
    monkeypatch.setattr(engine, "run", lambda _: {"figures": {"a": margin, "b": 1.0}})
    assert engine._violates((None, {}), ("a", "b")) == violates


def test_the_limit_of_a_single_parameter_is_found_by_bisection():
    scenario = loop([LOAD])
    scenario = Scenario.model_validate({**dict(scenario), "requirements": {"deviation": "always abs(speed) <= 0.7"}})
    space = space_of(scenario, [parse("plant.load_torques", f"{LOAD}..{LOAD}*1"), parse("pid.kp", "0.01..1")])
    nominal = run(trial(space.scenario, {}, ("deviation",)))["figures"]["deviation"]
    worst = space.overrides([0.0, 0.0])
    case, _ = shrink(space, worst, lambda c: run(trial(*c, ("deviation",)))["figures"]["deviation"] < 0.0, 60)
    assert nominal > 0.0
    gain = case[1]["pid.kp"]
    inside = run(trial(space.scenario, case[1] | {"pid.kp": gain + 1e-3}, ("deviation",)))["figures"]["deviation"]
    at = run(trial(space.scenario, case[1], ("deviation",)))["figures"]["deviation"]
    assert at < 0.0 < inside


FILE = """
extends: dc_motor_smc_b2
title: Motor with a requirement
duration: 2.0
requirements:
  tracking: always[1.6, 2] abs(speed - set_point) <= 0.05 * set_point
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(FILE)
    return path


def outcome(folder):
    return json.loads((folder / "outcome.json").read_text())


def test_a_violation_is_a_scenario_file_that_repeats_with_the_same_bits(file, tmp_path, capsys):
    command = ["falsify", str(file), "--strict", "--over", "dc_motor_plant.R=0.5..2.5", "--budget", "12",
             "--workers", "1", "--over", "dc_motor_smc.delta=log 0.5..20", "--no-plots"]  # fmt: skip
    assert main([*command, "--out", str(tmp_path / "a")]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    result = outcome(tmp_path / "a")
    assert result["violated"] == ["tracking"]
    assert f"violated: tracking, least margin {result['least']:.6g}" in printed
    worst = load_scenario(str(tmp_path / "a" / "mine_worst.yaml"))
    again = simulate(worst)
    assert again.figures["tracking"] == result["worst"]["tracking"] == result["least"]
    assert load_scenario(str(tmp_path / "a" / "mine_small.yaml")).nodes
    from softrig_bags.read import read_bag

    assert differences(read_bag(tmp_path / "a" / "worst" / "bag"), in_process(rig_of(worst))) == []
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    rows = (tmp_path / "b" / "rows.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "b" / "rows.jsonl").write_text("".join(rows[:5]))  # as if the search had been killed after five runs
    assert main([*command, "--out", str(tmp_path / "b")]) == 1
    assert outcome(tmp_path / "b")["trace"] == result["trace"]
    other = [*command, "--seed", "7", "--out", str(tmp_path / "b")]
    assert main(other) == 2
    assert "holds another falsification" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["falsify", "--strict", "--over", "dc_motor_plant.R=0.5..2.5"],
        ["study", "--search", "overshoot", "--draw", "dc_motor_plant.R=0.5..2.5"],
    ],
)
def test_a_rig_that_does_not_repeat_is_not_searched(file, words, tmp_path, capsys, monkeypatch):
    update = DcMotorSmc.update

    def moody(self, x, t, **inputs):
        x, values = update(self, x, t, **inputs)
        # The first ticks are computed twice, which would end the run already (`softrig_core.run.purity`).
        scale = 1.0 if t < 500_000_000 else random.uniform(0.5, 1.0)
        return x, {name: (scale * volts,) for name, (volts,) in values.items()}

    monkeypatch.setattr(DcMotorSmc, "update", moody)
    assert main([words[0], str(file), *words[1:], "--workers", "1", "--out", str(tmp_path / "a")]) == 2
    assert "two runs with the same parameters and seed differ, first on motor/" in capsys.readouterr().err
    assert not (tmp_path / "a" / "rows.jsonl").exists()


def test_without_a_violation_the_nearest_case_is_reported(file, tmp_path, capsys):
    assert main(["falsify", str(file), "--over", "dc_motor_plant.R=0.6..0.7", "--budget", "8", "--workers", "1",
                 "--no-plots", "--requirement", "tracking", "--out", str(tmp_path / "a")]) == 0  # fmt: skip
    result = outcome(tmp_path / "a")
    assert (result["violated"], result["runs"]) == ([], 8)
    printed = " ".join(capsys.readouterr().out.split())
    assert f"no violation in {result['runs']} runs; least margin {result['least']:.6g}" in printed
    assert "dc_motor_plant.R = " in printed
    assert "asked by name: tracking, published for dc_motor_plant.R = 0.4" in printed


def test_bounds_of_another_machine_are_judged_only_on_request(file, tmp_path, capsys):
    few = ["--over", "dc_motor_plant.R=0.6..0.7", "--budget", "2", "--workers", "1", "--no-plots"]
    assert main(["falsify", str(file), *few, "--out", str(tmp_path / "a")]) == 2
    error = capsys.readouterr().err
    assert "all requirements (tracking) are published for dc_motor_plant.R = 0.4; expected --str" in error
    assert not (tmp_path / "a").exists()
    file.write_text(f"{FILE}  limited: always abs(speed) <= 10 * set_point\n")
    assert main(["falsify", str(file), *few, "--out", str(tmp_path / "a")]) == 0
    assert "not judged: tracking, published for dc_motor_plant.R = 0.4" in capsys.readouterr().out
    result = outcome(tmp_path / "a")
    assert (result["requirements"], result["not_judged"]) == (["limited"], ["tracking"])
    assert list(result["worst"]) == ["limited"]
    assert result["published_for"] == "dc_motor_plant.R = 0.4"
    assert main(["falsify", str(file), *few, "--strict", "--out", str(tmp_path / "b")]) == 0
    assert outcome(tmp_path / "b")["requirements"] == ["tracking", "limited"]


def test_a_search_without_a_completed_run_has_no_verdict(file, tmp_path, monkeypatch):
    def breaks(*_, **__):
        raise RunError("gone")

    task = falsification_of(str(file), {"over": {"dc_motor_plant.R": "0.6..0.7"}, "strict": True, "budget": 2})
    prepared = engine.prepare(task)
    monkeypatch.setattr("softrig_bringup.study.work.simulate", breaks)
    monkeypatch.setattr("softrig_bringup.verbs.falsify_verb.prepare", lambda _: prepared)
    few = ["--over", "dc_motor_plant.R=0.6..0.7", "--budget", "2", "--workers", "1", "--no-plots", "--strict"]
    assert main(["falsify", str(file), *few, "--out", str(tmp_path / "a")]) == 3


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([], "nothing to search over"),
        (["--over", "dc_motor_plant.R=2..1"], "2 is above 1"),
        (["--over", "dc_motor_plant.R=1..2", "--budget", "0"], "--budget"),
        (["--over", "dc_motor_plant.R=1..2", "--requirement", "trackin"], "did you mean 'tracking'"),
        (["--over", "nonsense"], "--over 'nonsense': expected NAME=LOW..HIGH"),
    ],
)
def test_bad_input_is_one_line_before_the_first_run(file, arguments, reason, tmp_path, capsys):
    try:
        status = main(["falsify", str(file), *arguments, "--out", str(tmp_path / "a")])
    except SystemExit as end:
        status = end.code
    assert status == 2
    error = capsys.readouterr().err
    assert reason in error
    assert not (tmp_path / "a").exists()


FEW = ("--strict", "--over", "dc_motor_plant.R=0.6..0.7", "--budget", "4", "--workers", "1", "--no-plots")


def test_a_package_that_a_range_needs_is_named_before_anything_is_written(file, tmp_path, capsys, monkeypatch):
    command = ["falsify", str(file), *FEW]
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.delenv("SOFTRIG_COMMAND", raising=False)
    assert main([*command, "--out", str(tmp_path / "a")]) == 2
    assert "falsify needs the package 'optuna'" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()
    # random sampling needs no optimiser
    assert main([*command, "--sampler", "random", "--out", str(tmp_path / "a")]) == 0


@pytest.mark.parametrize("wrong", ["figures: {peak: {arguments: {signal: motor/nowhere}}}", "cites: [nobody1999]"])
def test_expectations_that_the_runs_do_not_measure_are_judged_before_the_first_one(wrong, file, tmp_path, capsys):
    """A trial measures only its requirements: other errors would be found only after the search."""
    file.write_text(f"{FILE}{wrong}\n")
    command = ["falsify", str(file), *FEW]
    assert main([*command, "--out", str(tmp_path / "a")]) == 2
    assert re.search(r"no signal 'motor/nowhere'|nobody1999", capsys.readouterr().err)
    assert not (tmp_path / "a").exists()


@pytest.mark.long
def test_a_reduced_case_without_the_faults_that_pictures_name_runs(tmp_path):
    assert main(["falsify", "dc_motor_smc_faults", "--strict", "--over", "dc_motor_plant.R=0.9..1.3", "--over",
                 "dc_motor_smc.delta=1..20", "--budget", "8", "--workers", "1", "--no-plots", "--out",
                 str(tmp_path / "a")]) == 1  # fmt: skip
    small = load_scenario(str(tmp_path / "a" / "dc_motor_smc_faults_small.yaml"))
    assert small.faults == {}  # the violation does not need the faults
    drawn = [signal for plot in small.plots for signal in plot.signals]
    assert "motor/sensors/current_a/position" in drawn
    assert not [signal for signal in drawn if "/drift/" in signal]
    checked(small)
    assert simulate(small).figures["settles"] == outcome(tmp_path / "a")["small"]["settles"] < 0.0


def test_the_picture_of_the_worst_run_is_as_expected(monkeypatch, tmp_path):
    """For a requirement over two signals, one of them equal in both runs; for one over a command; for a figure."""
    drawn = []
    saved = picture.save_figure

    def save(figure, path, *about):
        saved(figure, path, *about)
        drawn.append((path.name, on_paper(figure)))

    monkeypatch.setattr(picture, "save_figure", save)
    scenario = load_scenario("dc_motor_smc_b2").changed(duration=0.4)
    about = {
        "speed": "motor/state/shaft/velocity",
        "set_point": "motor/reference/shaft/velocity",
        "u": "motor/command/armature/effort",
    }
    follows = {"follows": {"formula": "always[0.1, 0.3] speed >= 0.6 + 0 * set_point"}, "strong": "always abs(u) <= 3"}
    nominal = scenario.having(shared=about, requirements=follows)
    runs = {"as it is": simulate(nominal), "worst": simulate(nominal.changed(overrides={"dc_motor_plant.J": 0.03}))}
    for name in ("follows", "strong", "overshoot"):
        picture.draw_worst(runs, name, tmp_path / name, f"Worst of {name}")
    check_expected("pictures/worst", (line for path, f in drawn for line in (path, *figure_lines(f))))


def test_a_scenario_without_requirements_reports_what_it_needs(tmp_path, capsys):
    assert main(["falsify", "dc_motor_smc_b6", "--over", "dc_motor_plant.R=1..2", "--out", str(tmp_path)]) == 2
    assert "has no requirements" in capsys.readouterr().err
    asked = ["falsify", "dc_motor_smc_b6", "--over", "dc_motor_plant.R=1..2", "--out", str(tmp_path), "--requirement"]
    scenario = load_scenario("dc_motor_smc_b6")
    for name, why in (
        (next(n for n in scenario.expect if n in scenario.figures), "an expectation on both sides"),
        (next(n for n in scenario.figures if n not in scenario.expect), "no expectation"),
    ):
        assert main([*asked, name]) == 2
        printed = capsys.readouterr().err
        assert f"figure {name} has {why}, no bound that a run could violate; it needs an entry" in printed
