"""Economic dispatch: the model, both stages, the proof and its independent checks, the node."""

import numpy as np
import pytest
from softrig_core import ByHand, ParameterError, list_scenarios, simulate
from softrig_power.dispatch.baselines import lambda_iteration, without_ripples
from softrig_power.dispatch.branch import branch_and_bound
from softrig_power.dispatch.certify import InfeasibleError, Optimiser
from softrig_power.dispatch.enumeration import TooManyError, enumerate_kinks
from softrig_power.dispatch.fleet import UnitFleet
from softrig_power.dispatch.solver import DispatchSolver
from softrig_power.dispatch.two_stage import breakpoints, milp, nlp
from softrig_power.dispatch.units import Units, balanced, marginal_cost

# Table, demand (MW), optimal cost ($/h) and its tolerance; cases of Sharifzadeh 2020, Tables II to VI, corrected.
CASES = {
    "I": ("units_3", 850.0, 8234.071730, 1e-4),
    "II": ("units_13", 1800.0, 17963.829201, 1e-3),
    "II, e_3 = 150": ("units_13_e3_150", 1800.0, 17960.366122, 1e-3),
    "III": ("units_40", 10500.0, 121412.535519, 1e-3),
}
UNITS_13 = [628.3185, 149.5997, 222.7491, 109.8666, 109.8666, 109.8666, 109.8666, 109.8666, 60, 40, 40, 55, 55]


@pytest.fixture(params=CASES.values(), ids=CASES.keys(), scope="module")
def case(request):
    table, demand, cost, tolerance = request.param
    units = Units.read(table)
    return units, demand, cost, tolerance, Optimiser(units).certified(demand)


def feasible(units, P, demand):
    return (abs(P.sum() - demand) <= 1e-6) and (units.p_min <= P).all() and (units.p_max >= P).all()


# Model ----------------------------------------------------------------------------------------------


def test_unusual_units_have_no_arches_or_merged_ones():
    ranges = [(100, 100), (0, 200), (0, 200), (0, 2 * np.pi / 0.03 + 5e-7)]
    ripples = [(300, 0.03), (0, 0.03), (300, 0), (300, 0.03)]
    table = np.array([[*limits, 0.001, 8, 5, *ripple] for limits, ripple in zip(ranges, ripples, strict=True)])
    units = Units(("fixed", "no e", "no f", "sliver"), table)
    assert [len(units.valve_points(j)) for j in range(4)] == [1, 2, 2, 3]
    assert units.valve_points(3)[-1] == table[3, 1]
    with np.errstate(all="raise"):
        assert [len(p) for p in breakpoints(units, 4)] == [1, 5, 5, 9]
    result = Optimiser(units).certified(400.0)
    assert feasible(units, result.P, 400.0)
    assert result.P[0] == 100.0
    assert result.gap <= 1e-3


# The published cases ----------------------------------------------------------------------------------------------


def test_cost_bound_and_balance_of_the_published_cases(case):
    """The reported cost is F at the dispatch, and the bound proves the optimum to the tolerance."""
    units, demand, cost, tolerance, result = case
    assert result.cost == pytest.approx(cost, abs=tolerance)
    assert result.cost == units.total(result.P)
    assert result.bound <= result.cost
    assert result.bound <= cost + 1e-6
    assert result.gap <= 1e-3
    assert result.reason == "proven"
    assert feasible(units, result.P, demand)


def test_dispatch_of_the_published_cases(case):
    units, _, _, _, result = case
    P = units.sorted_copies(result.P)
    if len(units) == 3:
        assert P.tolist() == pytest.approx([300.2669, 149.7331, 400.0], abs=1e-3)
    elif len(units) == 13:
        assert P.tolist() == pytest.approx(UNITS_13, abs=1e-3)
    else:
        assert P[[34, 35]] == pytest.approx([200.0, 194.3978], abs=1e-3)


@pytest.mark.long
def test_kink_enumeration_agrees_with_the_proof():
    """An independent method that is exact if at most one unit is off its valve points."""
    for table in ("units_13", "units_13_e3_150"):
        units = Units.read(table)
        for demand in range(1500, 2501, 250):
            result = Optimiser(units).certified(float(demand))
            assert result.reason == "proven"
            assert units.total(enumerate_kinks(units, float(demand))) == pytest.approx(result.cost, abs=1e-3)
    with pytest.raises(TooManyError, match="more than 1000 combinations"):
        enumerate_kinks(units, 1800.0, most=1000)


@pytest.mark.long
def test_scip_confirms_the_13_units():
    """An independent global solver, with the sine kept as it is."""
    from pyscipopt import Model, quicksum, sin as scip_sin

    for table, _, _, _ in list(CASES.values())[:3]:
        units = Units.read(table)
        demand = {3: 850.0, 13: 1800.0}[len(units)]
        model = Model()
        model.hideOutput()
        P = [model.addVar(lb=row[0], ub=row[1]) for row in units.table]
        s = [model.addVar(lb=0.0) for _ in P]
        y = [model.addVar(lb=None) for _ in P]
        for p, ripple, cost, (p_min, _, a, b, c, e, f) in zip(P, s, y, units.table, strict=True):
            model.addCons(ripple >= e * scip_sin(f * (p - p_min)))
            model.addCons(ripple >= -e * scip_sin(f * (p - p_min)))
            model.addCons(cost >= a * p * p + b * p + c + ripple)
        model.addCons(quicksum(P) == demand)
        model.setObjective(quicksum(y))
        model.setParam("limits/absgap", 1e-3)
        model.setParam("limits/time", 120)
        model.optimize()
        result = Optimiser(units).certified(demand)
        assert model.getDualbound() <= result.cost + 1e-3
        assert model.getObjVal() == pytest.approx(result.cost, abs=2e-3)


@pytest.mark.long
def test_the_plain_two_stages_are_no_proof():
    """With one segment for each arch the result is in other arches: the method of the paper finds the optimum only by
    chance.
    """
    units = Units.read("units_3")
    assert Optimiser(units, nseg=1).two_stage(850.0).cost == pytest.approx(8343.936, abs=1e-2)
    assert Optimiser(units, nseg=4).two_stage(850.0).cost == pytest.approx(8234.071730, abs=1e-4)
    first = milp(units, 850.0, breakpoints(units, 4))
    assert first.objective == pytest.approx(8233.03, abs=0.01)  # the chords are 1 $/h below any dispatch
    assert first.binaries == 51
    assert units.total(first.P) > 8234.07
    forty = Units.read("units_40")
    assert Optimiser(forty, nseg=2).two_stage(10500.0).cost == pytest.approx(121412.535519, abs=1e-3)
    thirteen = Units.read("units_13")
    assert Optimiser(thirteen, nseg=1).two_stage(1800.0).cost == pytest.approx(18222.932, abs=1e-2)


# The proof ----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_bound_holds_for_random_units():
    """Against brute force on a fine grid: three random units, the third takes the residual."""
    chance = np.random.default_rng(1)
    for _ in range(20):
        p_min = chance.uniform(0, 50, 3)
        table = np.column_stack(
            [
                p_min,
                p_min + chance.uniform(20, 300, 3),
                chance.uniform(0, 0.02, 3),
                chance.uniform(2, 10, 3),
                chance.uniform(0, 500, 3),
                chance.uniform(0, 300, 3),
                chance.uniform(0.0, 0.1, 3),
            ]
        )
        units = Units(("a", "b", "c"), table)
        demand = float(units.p_min.sum() + chance.uniform(0.1, 0.9) * (units.p_max - units.p_min).sum())
        result = Optimiser(units).certified(demand)
        x, y = np.meshgrid(np.linspace(table[0, 0], table[0, 1], 700), np.linspace(table[1, 0], table[1, 1], 700))
        z = demand - x - y
        inside = (z >= table[2, 0]) & (z <= table[2, 1])
        brute = units.cost(np.stack([x[inside], y[inside], z[inside]], -1)).sum(-1).min()
        assert result.bound <= brute + 1e-9
        assert result.gap <= 1e-3
        assert result.cost <= brute + 1e-3


def test_order_and_copies_of_units_change_nothing():
    units = Units.read("units_13")
    cost = Optimiser(units).certified(1800.0).cost
    shuffled = np.random.default_rng(3).permutation(13)
    other = Units(tuple(units.ids[j] for j in shuffled), units.table[shuffled])
    result = Optimiser(other).certified(1800.0)
    assert result.cost == pytest.approx(cost, abs=1e-6)
    assert feasible(other, result.P, 1800.0)
    twice = Units(tuple(f"{c}{i}" for c in "ab" for i in units.ids), np.tile(units.table, (2, 1)))
    double = Optimiser(twice).certified(3600.0)
    assert double.reason == "proven"
    assert double.cost <= 2 * cost + 1e-6  # twice the demand for twice the units costs at most twice as much
    assert double.cost == pytest.approx(2 * cost, rel=2e-3)


@pytest.mark.parametrize(("name", "boxes"), [("I", 41), ("II", 629), ("II, e_3 = 150", 477), ("III", 1153)])
def test_the_proof_takes_few_boxes(name, boxes):
    table, demand, *_ = CASES[name]
    assert Optimiser(Units.read(table)).certified(demand).nodes == pytest.approx(boxes, rel=0.05)


@pytest.mark.long
def test_if_boxes_run_out_the_adaptive_milps_prove_it():
    """The certificate of the paper's own machinery: chords lowered below the cost and split where they are too low."""
    units = Units.read("units_3")
    optimiser = Optimiser(units, max_nodes=1, nseg=2)
    result = optimiser.certified(850.0)
    assert result.stage == "adaptive MILP"
    assert result.reason == "proven"
    assert result.cost == pytest.approx(8234.071730, abs=1e-4)
    assert [b for _, _, b in result.trace] == sorted(b for _, _, b in result.trace)


def test_a_time_limit_gives_the_best_so_far_with_its_true_gap():
    units = Units.read("2*units_40")
    result = Optimiser(units, max_nodes=1, time_limit=1.0, nseg=2).certified(21000.0)
    assert result.limited
    assert "time limit" in result.reason
    assert feasible(units, result.P, 21000.0)
    assert result.cost == units.total(result.P)
    assert 240000 < result.bound < result.cost < 275000


def test_fewer_boxes_give_a_lower_bound_never_a_wrong_one():
    units = Units.read("units_13")
    start = balanced(units, lambda_iteration(units, 1800.0), 1800.0)
    bounds = [branch_and_bound(units, 1800.0, start, 1e-3, n).bound for n in (1, 10, 100, 5000)]
    assert bounds == sorted(bounds)
    assert bounds[0] < 17950
    assert bounds[-1] == pytest.approx(17963.829201, abs=1e-3)


# Prices and baselines ----------------------------------------------------------------------------------------------


def test_lambda_iteration_meets_equal_slopes_and_bounds_the_cost():
    units = Units.read("units_40")
    plain = without_ripples(units)
    P = lambda_iteration(units, 10500.0)
    assert feasible(units, P, 10500.0)
    left, right = plain.slopes(P)
    assert left.max() == pytest.approx(right.min(), abs=1e-6)
    # An independent solver for the same quadratic problem.
    assert plain.total(P) == pytest.approx(plain.total(nlp(plain, 10500.0, P * 0 + units.p_min)[0]), abs=1e-5)
    assert plain.total(P) < 121412.5


def test_a_demand_beyond_the_units_is_infeasible_with_both_sums():
    units = Units.read("units_3")
    for demand in (249.0, 1201.0):
        with pytest.raises(InfeasibleError, match=f"demand {demand:g} MW, but the units give 250 to 1200 MW"):
            Optimiser(units).certified(demand)
    assert Optimiser(units).certified(250.0).P.tolist() == units.p_min.tolist()
    assert Optimiser(units).certified(1200.0).P.tolist() == units.p_max.tolist()
    assert marginal_cost(units, units.p_min)[0] == -np.inf


def test_a_table_repeated_several_times_is_solved():
    units = Units.read("3*units_13")
    one = Units.read("units_13")
    assert len(set(units.ids)) == 39
    assert units.ids[:13] == one.ids
    assert units.ids[13:15] == ("1_2", "2_2")
    assert units.table.tolist() == one.table.tolist() * 3
    assert units.more is None
    for wrong in ("0*units_13", "*units_13", "x*units_13", "2*nothing"):
        with pytest.raises((OSError, ValueError)):
            Units.read(wrong)


# Node ----------------------------------------------------------------------------------------------


SCENARIOS = [n for n in list_scenarios() if n.startswith("economic_dispatch")]


SLOW = tuple(f"economic_dispatch_{n}" for n in ("two_stage", "80_units", "1000_units", "wood"))  # MILPs of ten seconds


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.long] * n.startswith(SLOW)) for n in SCENARIOS])
def test_every_scenario_meets_its_expectations(name):
    run = simulate(name)
    assert not run.error
    assert [f"{r.name} {r.value} {r.error}" for r in run.results if not r.passed] == []
    assert any(r.judged for r in run.results)


@pytest.fixture
def node():
    block = ByHand(DispatchSolver(unit_table="units_3"))
    block.reset(0)
    yield block
    block.reset(0)  # ends the process of the solver


def ask(node, t, demand, **inputs):
    return node.update(
        t * 10**9, demand=None if demand is None else (demand,), **{"units": None, "solve": None} | inputs
    )


def test_a_result_is_published_once_with_its_cost_and_rows(node):
    result = ask(node, 0, 850.0)
    assert sum(result["setpoints"]) == pytest.approx(850.0, abs=1e-6)
    rows = np.reshape(result["result"], (3, 4))
    units = Units.read("units_3")
    assert rows[:, 0].tolist() == list(result["setpoints"])
    assert rows[:, 1] == pytest.approx(units.cost(rows[:, 0]))
    # The arch, and whether the unit is at its end; unit 1 supplies the rest.
    assert rows[:, 2:].tolist() == [[3, 0], [3, 1], [5, 1]]
    demand, cost, bound, gap, *_ = result["summary"]
    assert (demand, cost) == (850.0, units.total(rows[:, 0]))
    assert gap == cost - bound
    assert ask(node, 1, 850.0) == {}
    assert ask(node, 2, 850.0, solve=(1.0,))["summary"][1] == cost  # pressed, so it solves again
    assert ask(node, 3, 850.0, solve=(1.0,)) == {}  # still pressed, so it does not


def test_a_bad_table_stops_the_node_and_the_scenario(tmp_path):
    (tmp_path / "bad.csv").write_text("unit,p_min_MW\na,1\n")
    with pytest.raises(ParameterError, match=r"unit_table.*bad.csv: no column p_max_MW"):
        DispatchSolver(unit_table=str(tmp_path / "bad.csv"))
    with pytest.raises(
        ParameterError, match=r"unit_table.*no file 'package://softrig_power/dispatch/tables/units_4.csv'"
    ):
        UnitFleet(unit_table="units_4")
