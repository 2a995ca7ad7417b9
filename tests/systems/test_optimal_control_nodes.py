"""Optimal control in a rig: expectations and claims of the scenario files, the nodes on bad input, processes, speed."""

import functools

import numpy as np
import pytest
from conftest import few
from softrig_core import (
    ByHand,
    Level,
    Marker,
    Result,
    RunError,
    list_scenarios,
    load_scenario,
    simulate,
)
from softrig_core.block.answer import admit
from softrig_systems.optimal_control.collocation_planner import CollocationPlanner
from softrig_systems.optimal_control.evaluator import FIGURES, OcpEvaluator
from softrig_systems.optimal_control.method import collocation
from softrig_systems.optimal_control.method.mvim import solve
from softrig_systems.optimal_control.mvim_planner import MvimPlanner
from softrig_systems.optimal_control.plants import OcpPlant, ScalarPlant, SpacecraftPlant, TwoStatePlant
from softrig_systems.optimal_control.player import OcpPlayer
from softrig_systems.optimal_control.problem import ProblemError
from softrig_systems.optimal_control.problems import find

S = 10**9
W0 = (0.01, 0.005, 0.001)
STATE = (*W0, 0.0, 0.0, 0.0)
NAMES = sorted(n for n in list_scenarios() if n.startswith("optimal_control_mvim"))
LATER = {f"optimal_control_mvim_{n}" for n in (
    "n4", "n12", "dt01", "s1", "s3", "s3_n6", "s4", "s4_5s", "s4_bias", "s4_bias_5s", "s6", "s6_n24", "start", "a2_5s",
    "a4_dt01_bias", "a4_dt01_inertia", "wie",
)}  # fmt: skip


@functools.cache
def run(name):
    return simulate(name)


@pytest.mark.parametrize("name", few([pytest.param(n, marks=[pytest.mark.long] * (n in LATER)) for n in NAMES], 2))
def test_figures_of_the_scenarios(name):
    assert [f"{r.name} = {r.number} {r.error}" for r in run(name).missed] == []
    assert [(f.key, f.measured_text) for f in run(name).claims if f.holds is False] == []


def test_the_verdicts_on_the_paper():
    results = [f for n in ("", "_printed", "_s3_n2", "_s1_n5") for f in run(f"optimal_control_mvim{n}").claims]
    assert all(f.holds for f in results)
    assert sorted(f.verdict for f in results) == ["refuted"] * 4 + ["reproduced"] * 3


def end_error(name):
    return run(f"optimal_control_mvim_{name}").figures["end_error"]


def test_the_exact_feedback_beats_the_plan_made_again():
    assert end_error("a4_inertia") < end_error("s4_1s") < end_error("s4_5s")
    assert end_error("a4_bias") < end_error("s4_bias_5s")


# Bad input of the plants


@pytest.mark.parametrize("kind", [ScalarPlant, TwoStatePlant])
def test_a_diverging_state_may_not_be_published(kind):
    plant = ByHand(kind())
    (port,) = plant.block.ports(plant.block.p)[1]
    while max(map(abs, plant.x)) <= 1e3:
        admit(plant.outputs(0), port, "plant", 0)
        plant.advance(0, command=(1e6,))
    with pytest.raises(
        RunError, match=r"plant: state .* became (inf|nan|.* expected at most 1000 in magnitude) at t = "
    ):
        admit(plant.outputs(0), port, "plant", 0)


@pytest.mark.parametrize("name", ["scalar", "spacecraft", "two_state", "reactor"])
def test_half_the_step_changes_nothing(name):
    period = find(name).horizon / 100.0
    ends = []
    for substeps in (4, 8):
        plant = ByHand(OcpPlant(problem=name, period=period, substeps=substeps))
        for k in range(100):
            plant.advance(k, command=(0.2,) * len(find(name).controls))
        ends.append(np.array(plant.outputs(0)["state"]))
    assert ends[0] == pytest.approx(ends[1], rel=1e-6 if name == "reactor" else 1e-9)


# Planner


def asked(planner, t=0, state=STATE, **more):
    planner.x, request = planner.block.request(planner.x, t, state=state, **more)
    return request


def answered(planner, request, t=0):
    return taken(planner, Result(t, request, planner.block.solve(request, None), True))


def taken(planner, result):
    planner.x, values = planner.block.answer(planner.x, result.stamp, result, True)
    planner.store_reports()
    return values


def test_diagnostics_name_alpha_and_the_costs_of_all_orders():
    planner = ByHand(MvimPlanner())
    answered(planner, asked(planner))
    health = planner.health()
    assert len(health["alpha"].split()) == 3
    assert len(health["J per order"].split()) == len(health["ratio per order"].split()) == 8
    assert health["order of the paper's rule"] == "5"
    assert "converged" in health["reason"]
    assert "stages" not in health["reason"]  # the last order meets the tolerance, though the first orders do not


def test_orders_rise_until_the_rule_is_met():
    planner = ByHand(MvimPlanner(order=2, order_max=20))
    values = answered(planner, asked(planner))
    assert dict(zip(("start", "horizon", "order"), values["summary"], strict=False))["order"] == 6.0
    table = np.reshape(values["plan"], (9, 21))
    assert np.all(table[:, 7:] == 0.0)
    assert np.any(table[:, 6] != 0.0)


def test_a_planner_without_an_answer_keeps_the_last_plan():
    planner = ByHand(CollocationPlanner())
    assert taken(planner, Result(0, None, None, False)) == {}
    assert planner.reports["limit"][0] is Level.ERROR


SLED = """
from softrig_systems.optimal_control.problem import Problem

SLED = Problem("sled", {"q": "m", "v": "m/s"}, {"u": "m/s^2"}, lambda x, u: [x[1], u[0] - 0.1 * x[1] ** 2],
               lambda x, u: u[0] ** 2 / 2, x0=(0.0, 0.0), horizon=2.0, x_end=(1.0, 0.0))
"""


def register(folder, *points):
    """Stand in for an installed package that has these entry points."""
    (folder / "own-1.0.dist-info").mkdir()
    (folder / "own-1.0.dist-info" / "METADATA").write_text("Name: own\nVersion: 1.0\n")
    (folder / "own-1.0.dist-info" / "entry_points.txt").write_text("\n".join(["[softrig_problems]", *points]) + "\n")


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("trap:SLED", "expected one of scalar, spacecraft, two_state, reactor, broken, number; a package registers"),
        ("trap", "expected one of scalar"),
        ("", "expected one of scalar"),
        ("broken", r"\(nowhere:SLED\) cannot be loaded: No module named 'nowhere'"),
        ("number", "math:pi is a float, expected a Problem"),
    ],
)
def test_only_problems_that_are_registered_are_imported(name, why, tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text(f"open({str(tmp_path / 'sprung')!r}, 'w').close()\n{SLED}")
    register(tmp_path, "broken = nowhere:SLED", "number = math:pi")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ProblemError, match=why):
        find(name)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.long
def test_a_users_problem_gets_plant_planner_and_evaluator(tmp_path, monkeypatch):
    """The page's example; one power series does not reach its end and is not played, eight stages do."""
    (tmp_path / "sleds.py").write_text(SLED)
    register(tmp_path, "sled = sleds:SLED")
    monkeypatch.syspath_prepend(tmp_path)
    scenario = load_scenario("optimal_control_mvim_reactor")

    def flown(stages):
        nodes = {
            name: entry.model_copy(
                update={
                    "parameters": entry.parameters
                    | {"problem": "sled"}
                    | ({"order": 16, "stages": stages} if name != "plant" else {})
                }
            )
            for name, entry in scenario.nodes.items()
        }
        changes = {"nodes": nodes, "duration": 2.0, "plots": (), "expect": {}, "claims": {}}
        return simulate(scenario.model_copy(update=changes)).figures

    assert flown(1)["infeasible"] == 1.0
    result = flown(8)
    assert result["infeasible"] == 0.0
    assert result["J_series"] == pytest.approx(result["J_exact"], rel=1e-7)
    assert result["J_plant"] == pytest.approx(result["J_exact"], rel=1e-4)


# Player


def planned(horizon=100.0, start=0.0, x=W0):
    problem = find("spacecraft").changed(x0=x, horizon=horizon)
    solution = solve(problem, 8)
    return tuple(solution.coefficients.ravel()), (start, horizon, 8.0, solution.J[-1], 1e-7, 0.0, 1.0, 1.0)


def test_a_plan_that_arrives_ticks_after_its_stamp_is_played():
    solution = solve(find("spacecraft"), 8)
    plan, summary = planned()
    player = ByHand(OcpPlayer())
    player.block.ages = lambda name: {"plan": None, "summary": 2 * S}.get(name)
    # Of plan and summary only the summary has arrived.
    assert player.update(2 * S, state=STATE, plan=plan, summary=summary)["command"] == (0.0, 0.0, 0.0)
    player.block.ages = lambda name: 3 * S
    elsewhere = (0.02, *STATE[1:])  # the state at 3 s
    command = player.update(3 * S, state=elsewhere, plan=plan, summary=summary)["command"]
    assert command == pytest.approx(solution(3.5)[6:], rel=1e-12)


def test_markers_show_the_momentum():
    line, ball = ByHand(SpacecraftPlant()).markers()
    assert line.points[1] == ball.points[0] == pytest.approx((0.8624, 0.42535, 0.11359))
    tip = line.points[1]
    assert line == Marker("body", "momentum", "line_strip", ((0.0, 0.0, 0.0), tip), 0.02)
    assert ball == Marker("body", "tip", "sphere_list", (tip,), 0.05, (0.9, 0.4, 0.1, 1.0))


def test_ports_refuse_plans_and_states_of_another_length():
    problem_ports = {p.name: p for p in OcpPlayer.ports(OcpPlayer(problem="scalar", order=8).p)[0]}
    ports = {p.name: p for p in OcpPlayer.ports(OcpPlayer().p)[0]}
    assert problem_ports["plan"].size != ports["plan"].size
    assert problem_ports["state"].channels != ports["state"].channels


# Evaluator


def evaluated(problem, order, **mode):
    """The evaluator's reports about a plan of a given order."""
    solution = solve(find(problem), order, **mode)
    about = (0.0, solution.horizon, float(order), solution.J[-1], solution.residual[-1], solution.end_error, 0.0, 0.0)
    evaluator = ByHand(OcpEvaluator(problem=problem, order=order))
    n = len(find(problem).states)
    state = (*find(problem).x0, *((0.0,) * n if problem == "spacecraft" else ()))
    control = (0.0,) * len(find(problem).controls)
    answer = evaluator.update(0, state=state, command=control, plan=tuple(solution.coefficients.ravel()), summary=about)
    return dict(zip(FIGURES, answer["evaluation"], strict=True)), evaluator


@pytest.mark.parametrize(
    ("problem", "order", "mode", "flag"),
    [
        ("spacecraft", 4, {"alpha_mode": "frozen", "frozen_alpha": (0.7436866718, 0.3617355350, 0.1206193519)}, 1.0),
        ("two_state", 2, {}, 1.0),
        ("scalar", 5, {}, 1.0),
        ("spacecraft", 8, {}, 0.0),
        ("two_state", 30, {}, 0.0),
        ("scalar", 20, {}, 0.0),
    ],
)
def test_impossible_optima_are_flagged(problem, order, mode, flag):
    result, evaluator = evaluated(problem, order, **mode)
    assert result["infeasible"] == flag
    assert ("infeasible" in evaluator.reports) == bool(flag)
    if flag:
        assert evaluator.reports["infeasible"][1].startswith("infeasible: not an optimum")


def test_a_plan_for_the_remaining_time_starts_warm():
    problem = find("spacecraft")
    cold = collocation.solve(problem)
    guess = collocation.sampled(cold.rows, 100.0, 90.0, 3)
    assert collocation.solve(problem.changed(x0=cold.rows[:3, 10], horizon=90.0), guess=guess).iterations <= 2


# Through processes
