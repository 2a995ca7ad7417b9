"""Dispatch with B-matrix losses, ramp limits and reserve: against enumeration, with proof, through the node."""

from __future__ import annotations

import re

import numpy as np
import pytest
from softrig_core import Level, ParameterError, load_scenario, simulate
from softrig_core.kit.resource import resource
from softrig_power.dispatch.certify import InfeasibleError, Optimiser
from softrig_power.dispatch.conditions import Conditions, Losses
from softrig_power.dispatch.solver import DispatchSolver
from softrig_power.dispatch.units import COLUMNS, MORE, TableError, Units

B = 1e-5 * np.array([[7.1, 3.0, 2.5], [3.0, 6.9, 3.2], [2.5, 3.2, 8.0]])  # B coefficients of three units, 1/MW
THREE = Units.read("units_3")


def enumerated(units, demand, conditions, step):
    """The least cost on a fine grid over two units, with the third one balancing; the grid is finer at valve points."""
    axes = []
    for j in (0, 1):
        low, high = conditions.low[j], conditions.high[j]
        valves = units.valve_points(j)
        axes.append(
            np.unique(np.concatenate([np.arange(low, high, step), valves[(valves >= low) & (valves <= high)], [high]]))
        )
    p0, p1 = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    p2 = np.maximum(demand - p0 - p1, 0.0)
    b, b0 = conditions.losses.B, conditions.losses.B0
    for _ in range(12):
        P = np.column_stack([p0, p1, p2])
        p2 = demand + np.sum(P * (P @ b), axis=1) + P @ b0 + conditions.losses.B00 - p0 - p1
    P = np.column_stack([p0, p1, p2])
    left = np.sum(np.minimum(conditions.ready, units.p_max - P), axis=1)
    good = (p2 >= conditions.low[2]) & (p2 <= conditions.high[2]) & (left >= conditions.reserve)
    return float(units.cost(P[good]).sum(axis=1).min()) if good.any() else np.inf


def with_more(**columns):
    """The three units with further columns of common tables."""
    more = np.full((3, 4), np.nan)
    for name, values in columns.items():
        more[:, MORE.index(f"{name}_MW")] = values
    return Units(THREE.ids, THREE.table, more)


CASES = {
    "losses": (THREE, Losses(B, np.zeros(3)), 0.0),
    "linear and constant losses": (THREE, Losses(B, np.array([1e-3, -2e-3, 5e-4]), 0.4), 0.0),
    "ramps": (with_more(p_now=[300.0, 120.0, 300.0], ramp_up=[80.0, 70.0, 50.0], ramp_down=[100.0, 40.0, 60.0]),
              None, 0.0),
    "reserve": (with_more(reserve=[60.0, 50.0, 100.0]), None, 150.0),
    "all": (with_more(p_now=[400.0, 120.0, 300.0], ramp_up=[80.0, 70.0, 80.0], ramp_down=[200.0, 80.0, 60.0],
                      reserve=[60.0, 50.0, 70.0]), Losses(B, np.zeros(3)), 178.0),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("demand", [700.0, 850.0])
def test_the_proven_optimum_equals_the_enumerated_one(case, demand):
    units, losses, reserve = CASES[case]
    conditions = Conditions.of(units, losses, reserve)
    grid = enumerated(units, demand, conditions, 4.0)
    if grid == np.inf:
        with pytest.raises(InfeasibleError):
            Optimiser(units).conditioned(demand, conditions)
        return
    result = Optimiser(units).conditioned(demand, conditions)
    assert result.reason == "proven"
    assert result.gap <= 1e-3
    assert result.P.sum() - conditions.losses.of(result.P) == pytest.approx(demand, abs=1e-6)
    assert np.all(conditions.low - 1e-9 <= result.P)
    assert np.all(conditions.high + 1e-9 >= result.P)
    assert conditions.spinning(units, result.P) >= reserve - 1e-6
    assert result.bound <= grid + 1e-9  # no dispatch of the grid is below the bound
    assert grid - 60.0 < result.cost <= grid + 1e-3  # the grid comes close to the optimum
    plain = Optimiser(THREE).certified(demand)
    assert result.cost >= plain.cost - 1e-3


def test_each_condition_is_active_somewhere():
    """Otherwise the enumeration above would compare the same thing five times."""
    plain = Optimiser(THREE).certified(850.0).cost
    costs = {}
    for case, (units, losses, reserve) in CASES.items():
        costs[case] = Optimiser(units).conditioned(850.0, Conditions.of(units, losses, reserve)).cost
    assert all(cost > plain + 1.0 for cost in costs.values())
    assert costs["all"] > max(costs["losses"], plain)


def test_without_conditions_the_dispatch_is_unchanged():
    none = Conditions.of(THREE)
    assert Optimiser(THREE).conditioned(850.0, none).cost == pytest.approx(8234.07173, abs=1e-3)


def test_thirteen_units_with_losses_are_proven():
    units = Units.read("units_13")
    losses = Losses(np.diag(np.linspace(1e-5, 4e-5, 13)), np.zeros(13))
    result = Optimiser(units, tol=2.0, max_nodes=200_000).conditioned(1800.0, Conditions.of(units, losses))
    assert result.P.sum() - result.losses == pytest.approx(1800.0, abs=1e-6)
    assert result.cost > 17963.8
    assert result.bound > 17963.8
    assert result.gap < 40.0
    assert (result.reason == "proven") == (result.gap <= 2.0)


@pytest.mark.parametrize(
    ("conditions", "why"),
    [
        (Conditions.of(THREE, Losses(B, np.zeros(3)), 0.0, np.array([600.0, 200.0, 400.0])), ""),
        (Conditions.of(CASES["ramps"][0], None, 0.0, np.array([300.0, 350.0, 300.0])), "unit 2 is so far outside its"),
        # The ramps just suffice to reach the limits.
        (Conditions.of(CASES["ramps"][0], None, 0.0, np.array([300.0, 240.0, 300.0])), ""),
        (Conditions.of(CASES["ramps"][0]), "within limits and ramps, less losses, the units give"),
        (Conditions.of(THREE, None, 2000.0), "reserve 2000 MW, but the units have"),
        (Conditions.of(THREE, Losses(100.0 * B, np.zeros(3))), "an incremental loss of 1 or more"),
    ],
)
def test_impossible_conditions_are_reported(conditions, why):
    if not why:
        assert conditions.infeasible(THREE, 850.0) == ""
        return
    with pytest.raises(InfeasibleError, match=why):
        Optimiser(THREE).conditioned(1100.0, conditions)


def write(path, units, columns=(), head=b""):
    rows = [",".join(("unit", *COLUMNS, *columns))]
    for k, name in enumerate(units.ids):
        more = [] if units.more is None else [units.more[k, MORE.index(c)] for c in columns]
        rows.append(",".join([name, *(repr(float(v)) for v in (*units.table[k], *more))]))
    path.write_bytes(head + "\n".join(rows).encode())
    return str(path)


def test_tables_of_common_formats_are_read(tmp_path):
    """Further columns, a byte order mark, any number of units: ports and set points follow the table."""
    units = CASES["ramps"][0]
    again = Units.read(write(tmp_path / "units.csv", units, MORE[:3], b"\xef\xbb\xbf"))
    np.testing.assert_array_equal(again.table, units.table)
    np.testing.assert_array_equal(again.more, units.more)
    losses = tmp_path / "losses.csv"
    lines = [
        ",".join([name, *map(str, row), "0.001", "0.3" if k == 0 else ""])
        for k, (name, row) in enumerate(zip(units.ids, B.tolist(), strict=True))
    ]
    losses.write_bytes(b"\xef\xbb\xbf" + "\n".join([",".join(["unit", *units.ids, "b0", "b00_MW"]), *lines]).encode())
    read = Losses.read(str(losses), units.ids)
    np.testing.assert_allclose(read.B, B)
    assert (read.B0.tolist(), read.B00) == ([0.001] * 3, 0.3)
    with pytest.raises(TableError, match="losses of the units"):
        Losses.read(str(losses), (*units.ids, "4"))
    solver = DispatchSolver(unit_table=str(tmp_path / "units.csv"), loss_table=str(losses), demand=850.0)
    outputs = {p.name: p for p in solver.ports(solver.p)[1]}
    assert outputs["setpoints"].size == 3
    _, request = solver.request(solver.first(), 0, demand=None)
    solution = solver.solve(request, None)
    assert solution.reason == "proven"
    assert solution.losses == pytest.approx(read.of(solution.P))
    with pytest.raises(ParameterError, match="for the method certified"):
        DispatchSolver(unit_table="units_3", loss_table=str(losses), method="two_stage")
    (tmp_path / "bad.csv").write_text((tmp_path / "units.csv").read_text("utf-8-sig").replace("80.0", "-80.0", 1))
    with pytest.raises(TableError, match="expected at least 0"):
        Units.read(str(tmp_path / "bad.csv"))


@pytest.mark.long
def test_the_scenario_accepts_any_table_whatever_the_names_of_its_units(tmp_path):
    """Its pictures and its first unit once required a unit called 1."""
    table = resource("package://softrig_power/dispatch/tables/units_3.csv").read_text("utf-8")
    for number, name in enumerate(("coal", "gas", "oil"), 1):
        table = re.sub(rf"^{number},", f"{name},", table, flags=re.M)
    (tmp_path / "own.csv").write_text(table)
    run = simulate("economic_dispatch", overrides={"table": str(tmp_path / "own.csv"), "demand": 850.0})
    assert run.figures["cost"] == pytest.approx(8234.07173, abs=1e-3)
    assert run.figures["first_unit"] == pytest.approx(300.2669, abs=1e-3)
    shown = [name for plot in load_scenario("economic_dispatch").plots for name in plot.signals]
    assert all(len(run.signals[name].x) for name in shown)


def test_ramps_count_from_the_last_dispatch(tmp_path):
    table = write(tmp_path / "units.csv", CASES["ramps"][0], MORE[:3])
    solver = DispatchSolver(unit_table=table)
    x, request = solver.request(solver.first(), 0, demand=(850.0,))
    first = solver.solve(request, None)
    x, second = solver.request(x._replace(last=first), 1, demand=(900.0,))
    np.testing.assert_allclose(second.conditions.high, np.minimum(THREE.p_max, first.P + [80.0, 70.0, 50.0]))
    assert solver.request(x, 2, demand=(1190.0,))[1] is None
    assert solver.reports["infeasible"][0] == Level.ERROR
