"""Each part of the dispatch against independent code: loops over the published formulas, brute force, scipy, tables of
limits.
"""

from __future__ import annotations

import itertools
import math
import types

import casadi
import numpy as np
import pytest
from helpers import interpreted
from scipy.optimize import linprog, minimize_scalar
from softrig_core import ByHand, Level, ParameterError
from softrig_core.solver.solver import Result
from softrig_power.dispatch import branch, table_file
from softrig_power.dispatch.baselines import lambda_iteration, repaired, swarm
from softrig_power.dispatch.certify import Dispatch, InfeasibleError, Optimiser, lowering
from softrig_power.dispatch.conditions import Conditions, Losses
from softrig_power.dispatch.enumeration import TooManyError, enumerate_kinks
from softrig_power.dispatch.fleet import UnitFleet
from softrig_power.dispatch.solver import DispatchSolver, Request
from softrig_power.dispatch.two_stage import NoDispatch, _as_columns, arch_bounds, breakpoints, milp, nlp
from softrig_power.dispatch.units import (
    BALANCE,
    COLUMNS,
    MORE,
    NARROW,
    TableError,
    Units,
    balanced,
    infeasible,
    marginal_cost,
)

PI = math.pi
# p_min, p_max (MW), a, b, c, e ($/h), f (rad/MW). Units with three arches of 100 MW, with two and a half of 40 MW,
# without ripple, and with a fixed output.
ROWS = {
    "three": (100.0, 400.0, 0.002, 8.0, 300.0, 200.0, PI / 100.0),
    "half": (20.0, 120.0, 0.004, 7.0, 100.0, 60.0, PI / 40.0),
    "smooth": (50.0, 150.0, 0.01, 6.0, 80.0, 0.0, 0.05),
    "fixed": (70.0, 70.0, 0.003, 9.0, 50.0, 40.0, 0.02),
}
FOUR = Units(tuple(ROWS), np.array(list(ROWS.values())))
PAIR = Units(("three", "half"), FOUR.table[:2])


def cost(row, p):
    """Equation (1)."""
    p_min, _, a, b, c, e, f = row
    return a * p**2 + b * p + c + abs(e * math.sin(f * (p - p_min)))


# The table ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ids", "table", "text"),
    [
        ((), np.empty((0, 7)), "a table of shape (0, 7): expected one row or more of " + ", ".join(COLUMNS)),
        (("a",), np.ones((1, 6)), "a table of shape (1, 6): expected one row or more of " + ", ".join(COLUMNS)),
        (("a",), np.ones(7), "a table of shape (7,): expected one row or more of " + ", ".join(COLUMNS)),
        (("a", "b"), np.ones((1, 7)), "2 names for 1 rows"),
        (("a", "a"), np.ones((2, 7)), "unit a: its name occurs twice"),
        (("a",), [[0, 1, 0, 0, np.inf, 0, 0]], "unit a, column c_usd_per_h: inf, expected a finite number"),
        (("a",), [[0, 1, -1, 0, 0, 0, 0]], "unit a, column a_usd_per_MW2h: -1, expected at least 0"),
        (("a",), [[0, 1, 0, 0, 0, -2, 0]], "unit a, column e_usd_per_h: -2, expected at least 0"),
        (("a",), [[0, 1, 0, 0, 0, 0, -3]], "unit a, column f_rad_per_MW: -3, expected at least 0"),
        (("a",), [[2, 1, 0, 0, 0, 0, 0]], "unit a: p_min_MW 2 is above p_max_MW 1"),
    ],
)
def test_a_wrong_table_is_refused_with_the_expected_message(ids, table, text):
    with pytest.raises(TableError) as refused:
        Units(ids, table)
    assert str(refused.value) == text


def test_values_at_the_limits_of_a_table_are_accepted():
    units = Units(("a",), [[1, 1, 0, -5, -6, 0, 0]])  # unusual but valid: negative b and c, a single output
    assert units.table.dtype == float
    assert not units.table.flags.writeable
    assert (units.p_min.tolist(), units.p_max.tolist(), len(units)) == ([1.0], [1.0], 1)
    assert PAIR.agreed() == {
        "dispatch/units": ("three", "half"),
        "dispatch/unit three": ROWS["three"],
        "dispatch/unit half": ROWS["half"],
    }


HEAD = ",".join(("unit", *COLUMNS))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{HEAD}\n", "units.csv: no unit in it"),
        ("unit,p_min_MW\n", f"units.csv: no column {', '.join(COLUMNS[1:])}"),
        ("", f"units.csv: no column unit, {', '.join(COLUMNS)}"),
        (f"{HEAD}\na,1,2,3,4,5,6,7\nb,1,2,3,x,5,6,7\n", "units.csv, line 3, column b_usd_per_MWh: 'x' is not a number"),
        (f"{HEAD}\na,1,2\n", "units.csv, line 2: 3 fields, but the head has 8"),
        (f"{HEAD},ramp_up_MW\na,1,2,3,4,5,6,7,-1\n", "units.csv, line 2, column ramp_up_MW: -1, expected at least 0"),
        (
            f"{HEAD},reserve_MW\na,1,2,3,4,5,6,7,nan\n",
            "units.csv, line 2, column reserve_MW: nan, expected a finite number",
        ),
    ],
)
def test_a_wrong_file_is_refused_by_line_and_column(tmp_path, text, words):
    (tmp_path / "units.csv").write_text(text)
    with pytest.raises(TableError) as refused:
        Units.read(str(tmp_path / "units.csv"))
    assert str(refused.value) == words


ROW = "a,1,2,3,4,5,6,7"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{HEAD},ramp_up_MW\n{ROW},1\n", "line 2: ramp_up_MW needs p_now_MW, from which it counts"),
        (f"{HEAD},ramp_up_MWh\n{ROW},1\n", "ramp_up_MWh is not part of a table of units (did you mean 'ramp_up_MW'?)"),
        (f"{HEAD},prohibited zones\n{ROW},1\n", "prohibited zones is refused: no method of dispatch supports them"),
        (f"{HEAD},zone_1_MW\n{ROW},1\n", "zone_1_MW is not part of a table of units; remove it"),
        (f"{HEAD},unit\n{ROW},a\n", "column unit occurs twice"),
        (f"{HEAD},\n{ROW},8\n", "a column has no name"),
        (f"{HEAD}\na,1,2,0,003,4,5,6,7\n", "line 2: 9 fields, but the head has 8; write decimal points, or separate"),
        (f'{HEAD}\na,1,2,"0,003",4,5,6,7\n', "'0,003' is not a number; it has a decimal comma"),
        (f"{HEAD}\n# b\n", "line 2: 1 fields, but the head has 8"),
        (f"{HEAD}\na,1,2,3,1_0,5,6,7\n", "column b_usd_per_MWh: 1_0, expected a finite number"),
        (HEAD.replace("p_min_MW", "p_min_kW"), "no column p_min_MW (did you mean 'p_min_kW'?)"),
        (HEAD.replace(",", ";") + "\na;1.000,5;2;3;4;5;6;7\n", "column p_min_MW: '1.000,5' is not a number"),
    ],
)
def test_columns_that_would_be_misread_or_ignored_are_refused(tmp_path, text, words):
    (tmp_path / "units.csv").write_text(text)
    with pytest.raises(TableError) as refused:
        Units.read(str(tmp_path / "units.csv"))
    assert words in str(refused.value)


def test_a_file_may_have_more_columns_for_some_units(tmp_path):
    (tmp_path / "u.csv").write_text(
        f"{HEAD},reserve_MW,ramp_up_MW,p_now_MW\na,1,9,3,4,5,6,7,0,2,5\nb,2,8,1,1,1,1,1,,,3\n"
    )
    units = Units.read(str(tmp_path / "u.csv"))
    assert units.table.tolist() == [[1, 9, 3, 4, 5, 6, 7], [2, 8, 1, 1, 1, 1, 1]]
    assert units.now.tolist() == [5.0, 3.0]
    assert units.ramp_up.tolist() == [2.0, np.inf]
    assert units.ramp_down.tolist() == [np.inf, np.inf]
    assert units.ready.tolist() == [0.0, 6.0]  # without an entry the reserve is the whole range
    twice = Units.read(f"2*{tmp_path / 'u.csv'}")
    assert twice.ids == ("a", "b", "a_2", "b_2")
    assert np.array_equal(twice.more, np.vstack([units.more, units.more]), equal_nan=True)
    assert Units.read("units_3").more is None
    assert Units.read("1*units_3").ids == Units.read("units_3").ids


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "cp1252"])
def test_tables_of_other_countries_are_read_with_their_commas_and_reported(tmp_path, separator, coding, capfd):
    """As spreadsheets write them: semicolons or tabs, decimal commas, empty columns and rows, a code page."""
    rows = [HEAD, "Süd,100,600,0.001562,7.92,561,300,0.0315", "b,50.5,200,0.00482,7.97,78,150,0.063"]
    text = (
        "\r\n".join(r.replace(",", separator).replace(".", ",") + separator for r in rows) + f"\r\n{separator * 8}\r\n"
    )
    name = f"{coding}{ord(separator)}.csv"
    (tmp_path / name).write_bytes(text.encode(coding))
    units = Units.read(str(tmp_path / name))
    Units.read(str(tmp_path / name))
    assert units.ids == ("Süd", "b")
    assert units.table.tolist() == [
        [100, 600, 0.001562, 7.92, 561, 300, 0.0315],
        [50.5, 200, 0.00482, 7.97, 78, 150, 0.063],
    ]
    assert capfd.readouterr().err.count(f"{name}: read with decimal commas") == 1


def test_every_column_of_the_table_is_read_or_refused():
    used = {name for name, (use, _) in table_file.UNITS.table.items() if use == "used"}
    assert used == {"unit", *COLUMNS, *MORE}


# The cost ----------------------------------------------------------------------------------------------


def test_the_cost_and_its_one_sided_slopes_agree_with_differences():
    for P in ([150.0, 47.0, 93.0, 70.0], [200.0, 60.0, 50.0, 70.0], [400.0, 100.0, 150.0, 70.0]):
        assert FOUR.cost(P).tolist() == pytest.approx([cost(r, p) for r, p in zip(FOUR.table, P, strict=True)])
        assert FOUR.total(P) == pytest.approx(sum(cost(r, p) for r, p in zip(FOUR.table, P, strict=True)))
        left, right = FOUR.slopes(P)
        for row, p, below, above in zip(FOUR.table, P, left, right, strict=True):
            h = 1e-5
            down, up = (cost(row, p) - cost(row, p - h)) / h, (cost(row, p + h) - cost(row, p)) / h
            assert below == (-np.inf if p == row[0] else pytest.approx(down, abs=1e-3))
            assert above == (np.inf if p == row[1] else pytest.approx(up, abs=1e-3))
    assert FOUR.cost(np.tile(FOUR.p_min, (2, 1))).shape == (2, 4)


def test_outputs_near_an_end_count_as_at_it_within_the_tolerance():
    # Its slope is 1 +- 3, with valve points at multiples of pi.
    one = Units(("a",), [[0.0, 100.0, 0.0, 1.0, 0.0, 3.0, 1.0]])

    def slopes(p):
        return [float(s[0]) for s in one.slopes([p])]

    assert slopes(NARROW)[0] == -np.inf
    assert slopes(np.nextafter(NARROW, 1.0))[0] > -np.inf
    assert slopes(100.0 - NARROW)[1] == np.inf
    assert slopes(np.nextafter(100.0 - NARROW, 0.0))[1] < np.inf
    assert slopes(PI + 0.9e-6) == [-2.0, 4.0]
    assert slopes(PI - 0.9e-6) == [-2.0, 4.0]
    assert slopes(PI + 1.1e-6) == pytest.approx([4.0, 4.0])
    assert slopes(PI - 1.1e-6) == pytest.approx([-2.0, -2.0])


def test_valve_points_are_counted_independently():
    def counted(p_min, p_max, e, f):
        results = [p_min]
        k = 1
        while e > 0 and f > 0 and p_min + k * PI / f < p_max - 1e-6:
            results.append(p_min + k * PI / f)
            k += 1
        return [*results, p_max] if p_max > p_min else results

    chance = np.random.default_rng(4)
    cases = [(p_min, p_min + w, e, f) for p_min, w, e, f in chance.uniform([0, 0, 1, 0.01], [50, 300, 9, 0.3], (40, 4))]
    cases += [
        (0.0, 3 * PI, 1.0, 1.0),
        (0.0, PI, 1.0, 1.0),
        (0.0, 9.0, 0.0, 1.0),
        (0.0, 9.0, 1.0, 0.0),
        (5.0, 5.0, 1.0, 1.0),
    ]
    for p_min, p_max, e, f in cases:
        units = Units(("a",), [[p_min, p_max, 0.0, 0.0, 0.0, e, f]])
        assert units.valve_points(0).tolist() == pytest.approx(counted(p_min, p_max, e, f), abs=1e-9)


def test_equal_units_are_grouped():
    table = FOUR.table[[1, 0, 1, 2, 0, 1]]
    units = Units(tuple("abcdef"), table)
    assert units.order.tolist() == [0, 2, 5, 3, 1, 4]  # sorted by p_min, then by the other columns
    assert units.groups.tolist() == [0, 2, 0, 1, 2, 0]
    P = np.array([30.0, 100.0, 50.0, 80.0, 200.0, 40.0])
    assert units.sorted_copies(P).tolist() == [50.0, 200.0, 40.0, 80.0, 100.0, 30.0]
    assert P.tolist() == [30.0, 100.0, 50.0, 80.0, 200.0, 40.0]  # the argument does not change


def linear(*rows):
    """Units with p_min, p_max and a price each."""
    return Units(tuple("abcdefg"[: len(rows)]), [[low, high, 0, price, 0, 0, 0] for low, high, price in rows])


@pytest.mark.parametrize(
    ("start", "demand", "wanted"),
    [
        ((5.0, 5.0, 5.0), 17.0, (5.0, 7.0, 5.0)),  # the cheapest unit that can supply all of the difference
        ((5.0, 5.0, 5.0), 13.0, (3.0, 5.0, 5.0)),  # the excess is removed from the most expensive unit
        ((5.0, 9.0, 5.0), 21.0, (5.0, 9.0, 7.0)),  # the cheapest unit has too little room
        # No unit has enough room, so the one with the most moves to its limit first.
        ((9.0, 8.0, 9.5), 29.5, (10.0, 10.0, 9.5)),
        ((11.0, -1.0, 5.0), 15.0, (10.0, 0.0, 5.0)),  # outputs beyond a limit are moved to it first
        ((5.0, 5.0, 5.0), 15.0 + 1.4e-8, (5.0, 5.0, 5.0)),  # a difference below a billionth of the demand is ignored
        ((5.0, 5.0, 5.0), 15.0 + 1.6e-8, (5.0, 5.0 + 1.6e-8, 5.0)),
        ((0.1, 0.1, 0.1), 0.3 + 2e-9, (0.1, 0.1 + 2e-9, 0.1)),  # a difference below 1e-9 MW is ignored, too
        ((0.1, 0.1, 0.1), 0.3 + 0.9e-9, (0.1, 0.1, 0.1)),
        ((0.0, 0.0, 0.0), 30.0, (10.0, 10.0, 10.0)),
    ],
)
def test_the_rest_of_the_balance_is_assigned_where_it_costs_least(start, demand, wanted):
    units = linear((0.0, 10.0, 3.0), (0.0, 10.0, 1.0), (0.0, 10.0, 2.0))
    assert balanced(units, start, demand).tolist() == pytest.approx(wanted, abs=1e-13)


def test_the_range_of_units_is_exact_to_a_millionth():
    units = linear((1.0, 4.0, 1.0), (2.0, 6.0, 1.0))
    low, high = 3.0 - BALANCE, 10.0 + BALANCE
    assert [infeasible(units, d) for d in (low, 3.0, 10.0, high)] == [""] * 4
    for d in (np.nextafter(low, 0.0), np.nextafter(high, 99.0)):
        assert infeasible(units, d) == f"infeasible: demand {d:g} MW, but the units give 3 to 10 MW"


def test_the_price_is_between_the_dearest_running_unit_and_the_cheapest_with_room():
    units = linear((0.0, 10.0, 3.0), (0.0, 10.0, 1.0), (0.0, 10.0, 2.0))
    assert marginal_cost(units, np.array([0.0, 10.0, 5.0])) == (2.0, 2.0)
    assert marginal_cost(units, np.array([0.0, 10.0, 10.0])) == (2.0, 3.0)
    assert marginal_cost(units, np.array([0.0, 0.0, 0.0])) == (-np.inf, 1.0)
    assert marginal_cost(units, np.array([10.0, 10.0, 10.0])) == (3.0, np.inf)


# Baselines ----------------------------------------------------------------------------------------------


def test_equal_incremental_costs_are_found_as_by_bisection():
    for demand in (250.0, 301.0, 388.8, 500.0, 650.0, 739.0):
        low, high = 0.0, 100.0
        for _ in range(100):  # bisect the price; each unit runs at 2 a P + b = price
            price = 0.5 * (low + high)
            P = [min(max((price - r[3]) / (2 * r[2]), r[0]), r[1]) for r in FOUR.table]
            low, high = (price, high) if sum(P) < demand else (low, price)
        assert lambda_iteration(FOUR, demand).tolist() == pytest.approx(P, abs=1e-6)
    # Units without curvature are used in the order of their price.
    order = linear((0.0, 10.0, 3.0), (0.0, 10.0, 1.0), (0.0, 10.0, 2.0))
    assert lambda_iteration(order, 14.0).tolist() == pytest.approx([0.0, 10.0, 4.0])
    assert lambda_iteration(linear((2.0, 2.0, 1.0)), 2.0).tolist() == [2.0]


def test_a_candidate_is_repaired_in_proportion_to_the_remaining_range():
    units = linear((0.0, 10.0, 1.0), (0.0, 20.0, 1.0), (5.0, 5.0, 1.0))
    assert repaired(units, np.array([4.0, 8.0, 5.0]), 26.0).tolist() == [7.0, 14.0, 5.0]
    assert repaired(units, np.array([4.0, 8.0, 5.0]), 11.0).tolist() == [2.0, 4.0, 5.0]
    assert repaired(units, np.array([99.0, -9.0, 0.0]), 15.0).tolist() == [10.0, 0.0, 5.0]
    assert repaired(units, np.array([10.0, 20.0, 5.0]), 40.0).tolist() == [10.0, 20.0, 5.0]


def test_a_swarm_searches_over_the_free_units():
    three = Units(tuple("abc"), FOUR.table[:3])
    result = swarm(FOUR, 500.0, "pso", 3, 6, 4)
    assert result.tolist() == pytest.approx([*swarm(three, 430.0, "pso", 3, 6, 4), 70.0])
    assert swarm(linear((2.0, 2.0, 1.0)), 2.0, "pso", 3, 6, 4).tolist() == [2.0]


# Losses, ramps and reserve -------------------------------------------------------------------------------


B3 = 1e-4 * np.array([[2.0, 0.5, -0.2], [0.5, 3.0, 0.1], [-0.2, 0.1, 4.0]])
B0, B00 = np.array([0.01, -0.02, 0.03]), 0.7
LOSSES = Losses(B3, B0, B00)


def lost(P):
    """P_L = P'BP + B0'P + B00, in loops."""
    return sum(P[i] * B3[i, j] * P[j] for i in range(3) for j in range(3)) + sum(B0[i] * P[i] for i in range(3)) + B00


def test_losses_and_their_slopes_agree_with_loops():
    P = np.array([120.0, 80.0, 33.0])
    assert LOSSES.of(P) == pytest.approx(lost(P), rel=1e-13)
    steps = 1e-3 * np.eye(3)
    assert LOSSES.slopes(P) == pytest.approx([(lost(P + h) - lost(P - h)) / 2e-3 for h in steps], rel=1e-7)
    none = Losses.none(2)
    assert (none.of(P[:2]), none.slopes(P[:2]).tolist(), none.B.shape) == (0.0, [0.0, 0.0], (2, 2))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("unit,a,b\na,1,2\nb,2,x\n", "l.csv, line 3, column b: 'x' is not a number"),
        ("unit,a,b\na,1,2\nb,2\n", "l.csv, line 3: 2 fields, but the head has 3"),
        ("unit,a,b\na,1,inf\nb,2,3\n", "l.csv, line 2, column b: inf, expected a finite number"),
        ("unit,a,b,b0\na,1,2,y\nb,2,3,1\n", "l.csv, line 2, column b0: 'y' is not a number"),
        ("unit,a,b\nb,1,2\na,2,3\n", "l.csv: losses of the units b, a, expected a, b"),
        ("unit,a,b,B0\na,1,2,0\nb,2,3,0\n", "l.csv: B0 is not a column of a table of losses (did you mean 'b0'?)"),
        ("unit,a,b,b00_MW\na,1,2,\nb,2,3,9\n", "l.csv, line 3: b00_MW belongs into the first row"),
        ("name,a,b\na,1,2\nb,2,3\n", "l.csv: losses of the units , , expected a, b"),
    ],
)
def test_wrong_losses_are_refused_with_the_expected_message(tmp_path, text, words):
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(TableError) as refused:
        Losses.read(str(tmp_path / "l.csv"), ("a", "b"))
    assert str(refused.value) == words


def test_losses_of_a_table_are_made_symmetric(tmp_path):
    (tmp_path / "l.csv").write_text("unit,a,b,b0,b00_MW\na,1,2,0.5,0.25\nb,4,3,,\n")
    losses = Losses.read(str(tmp_path / "l.csv"), ("a", "b"))
    assert (losses.B.tolist(), losses.B0.tolist(), losses.B00) == ([[1, 3], [3, 3]], [0.5, 0.0], 0.25)


def test_ramp_windows_start_at_the_present_outputs():
    more = np.array([[50.0, 20.0, 10.0, 5.0], [np.nan, 3.0, 3.0, np.nan], [90.0, 20.0, np.nan, 200.0]])
    units = Units(("a", "b", "c"), [[45.0, 100.0, 0, 1, 0, 0, 0]] * 3, more)
    of = Conditions.of(units)
    assert (of.low.tolist(), of.high.tolist()) == ([45.0, 45.0, 45.0], [70.0, 100.0, 100.0])
    assert (of.ready.tolist(), of.reserve, of.losses.of(np.ones(3))) == ([5.0, 55.0, 55.0], 0.0, 0.0)
    again = Conditions.of(units, LOSSES, 7.0, np.array([80.0, 60.0, np.nan]))
    assert (again.low.tolist(), again.high.tolist()) == ([70.0, 57.0, 45.0], [100.0, 63.0, 100.0])
    assert (again.losses, again.reserve) == (LOSSES, 7.0)
    assert again.spinning(units, np.array([98.0, 60.0, 40.0])) == 2.0 + 40.0 + 55.0


def test_conditions_forbid_and_just_allow_the_expected_outputs():
    units = linear((0.0, 100.0, 1.0), (0.0, 60.0, 1.0))

    def why(demand, low=(10.0, 10.0), high=(100.0, 60.0), losses=None, reserve=0.0):
        losses_used = losses or Losses.none(2)
        return Conditions(np.array(low), np.array(high), losses_used, reserve, np.array([30.0, 70.0])).infeasible(
            units, demand
        )

    give = "infeasible: demand {:g} MW, but within limits and ramps, less losses, the units give 20 to 160 MW"
    assert why(20.0 - 1e-6) == why(160.0 + 1e-6) == why(100.0) == ""
    for demand in (19.9, 160.1):
        assert why(demand) == give.format(demand)
    assert why(np.nextafter(20.0 - 1e-6, 0.0)) != ""
    assert why(np.nextafter(160.0 + 1e-6, 999.0)) != ""
    assert why(70.0, low=(60.0, 10.0), high=(60.0, 60.0)) == ""
    ramps = "infeasible: unit b is so far outside its limits that its ramps do not lead into them"
    assert why(70.0, low=(10.0, 61.0)) == ramps
    steep = "infeasible: an incremental loss of 1 or more: the B coefficients are not those of these units"
    # The incremental loss is 2 * 0.005 * 100.
    assert why(80.0, losses=Losses(np.diag([0.005, 0.0]), np.zeros(2))) == steep
    assert why(80.0, losses=Losses(np.diag([0.0049, 0.0]), np.zeros(2))) == ""
    assert why(80.0, reserve=80.0) == ""  # the first unit has 30 MW of reserve and the second 50 MW
    short = "infeasible: reserve 80.5 MW, but the units have 80 MW at their lowest outputs"
    assert why(80.0, reserve=80.5) == short


# The two stages -----------------------------------------------------------------------------------------


def test_break_points_are_evenly_spaced_in_each_arch():
    for nseg in (1, 2, 3, 4):
        three, half, smooth, fixed = breakpoints(FOUR, nseg)
        assert three.tolist() == pytest.approx(np.linspace(100.0, 400.0, 3 * nseg + 1).tolist())
        partial = max(1, round(nseg / 2))  # segments of the half arch from 100 to 120 MW
        wanted = [*np.linspace(20.0, 100.0, 2 * nseg + 1)[:-1], *np.linspace(100.0, 120.0, partial + 1)]
        assert half.tolist() == pytest.approx(wanted)
        assert smooth.tolist() == pytest.approx(np.linspace(50.0, 150.0, nseg + 1).tolist())
        assert fixed.tolist() == [70.0]


def piecewise(points, row, lowered=0.0):
    """Segments of a unit: begin, width, cost at the begin, slope."""
    if len(points) == 1:
        return [(points[0], 0.0, cost(row, points[0]) - lowered, 0.0)]
    ys = [cost(row, x) - lowered for x in points]
    pairs = itertools.pairwise(zip(points, ys, strict=True))
    return [(x0, x1 - x0, y0, (y1 - y0) / (x1 - x0)) for (x0, y0), (x1, y1) in pairs]


def cheapest(units, demand, points, lowered):
    """Every choice of one segment for each unit, filled by rising slope."""
    best = (np.inf, None)
    of = [piecewise(p, r, d) for p, r, d in zip(points, units.table.tolist(), lowered, strict=True)]
    for choice in itertools.product(*of):
        P, total = [x for x, *_ in choice], sum(y for _, _, y, _ in choice)
        remaining = demand - sum(P)
        if remaining < -1e-9:
            continue
        for j in sorted(range(len(P)), key=lambda j: choice[j][3]):
            more = min(remaining, choice[j][1])
            P[j] += more
            total += choice[j][3] * more
            remaining -= more
        if remaining <= 1e-9:
            best = min(best, (total, P), key=lambda result: result[0])
    return best


@pytest.mark.parametrize("lowered", [(0.0, 0.0, 0.0, 0.0), (30.0, 0.0, 7.0, 2.0)])
@pytest.mark.parametrize(("demand", "start"), [(400.0, None), (612.5, [250.0, 100.0, 150.0, 70.0])])
def test_the_milp_is_the_cheapest_choice_of_segments(demand, start, lowered):
    points = breakpoints(FOUR, 2)
    lowerings = (
        None if not any(lowered) else [np.full(max(1, len(p) - 1), d) for p, d in zip(points, lowered, strict=True)]
    )
    result = milp(FOUR, demand, points, lowerings, start=None if start is None else np.array(start))
    objective, P = cheapest(FOUR, demand, points, lowered)
    assert result.objective == pytest.approx(objective, abs=1e-5)
    assert result.P.tolist() == pytest.approx(P, abs=1e-5)
    assert result.bound <= result.objective + 1e-9
    assert result.bound == pytest.approx(objective, abs=1e-5)
    assert result.binaries == 6 + 5 + 2 + 1
    assert result.optimal
    assert result.nodes >= 0


def test_a_milp_without_a_solution_is_reported():
    with pytest.raises(NoDispatch, match=r"^the MILP ended without a dispatch: Infeasible$"):
        milp(FOUR, 900.0, breakpoints(FOUR, 1))


@pytest.mark.parametrize("P", [(150.0, 60.0, 75.0, 70.0), (200.0, 120.0, 50.0, 70.0), (400.0, 20.0, 150.0, 70.0)])
def test_a_dispatch_in_the_columns_of_the_milp_is_that_dispatch(P):
    points = breakpoints(FOUR, 2)
    segments = sum(max(1, len(p) - 1) for p in points)
    z, w = np.array(_as_columns(np.array(P), points, segments)).reshape(2, segments)
    at = 0
    for p, ends in zip(P, points, strict=True):
        n = max(1, len(ends) - 1)
        k = int(np.argmax(z[at : at + n]))
        assert z[at : at + n].tolist() == [float(i == k) for i in range(n)]
        assert np.flatnonzero(w[at : at + n]).tolist() in ([], [k])
        assert ends[k] + w[at + k] == p
        width = ends[k + 1] - ends[k] if len(ends) > 1 else 0.0
        assert 0.0 <= w[at + k] <= width
        assert w[at + k] < width or k == n - 1  # a point on a break point belongs to the segment that starts there
        at += n


def test_the_arch_of_an_output_is_the_one_above_a_valve_point():
    for P, low, high in [
        ((150.0, 60.0), (100.0, 60.0), (200.0, 100.0)),
        ((200.0, 59.9), (200.0, 20.0), (300.0, 60.0)),
        ((200.0 - 1e-7, 100.0), (200.0, 100.0), (300.0, 120.0)),
        ((200.0 - 1.1e-7, 119.0), (100.0, 100.0), (200.0, 120.0)),
        ((100.0, 20.0), (100.0, 20.0), (200.0, 60.0)),
        ((400.0, 120.0), (300.0, 100.0), (400.0, 120.0)),
    ]:
        result = arch_bounds(PAIR, np.array(P))
        assert [ends.tolist() for ends in result] == [pytest.approx(low), pytest.approx(high)]
    fixed = arch_bounds(FOUR, np.array([150.0, 60.0, 99.0, 70.0]))
    assert (fixed[0][2:].tolist(), fixed[1][2:].tolist()) == ([50.0, 70.0], [150.0, 70.0])


@pytest.mark.parametrize("P", [(150.0, 80.0), (250.0, 40.0), (330.0, 110.0)])
def test_the_nlp_is_the_best_of_its_arches(P):
    """Of two units one number is free: a bounded search over a fine grid of it."""
    demand, (low, high) = sum(P), arch_bounds(PAIR, np.array(P))
    least, most = max(low[0], demand - high[1]), min(high[0], demand - low[1])

    def total(x):
        return cost(PAIR.table[0], x) + cost(PAIR.table[1], demand - x)

    grid = np.linspace(least, most, 2001)
    k = int(np.argmin([total(x) for x in grid]))
    ends = grid[max(k - 1, 0)], grid[min(k + 1, 2000)]
    best = minimize_scalar(total, bounds=ends, method="bounded", options={"xatol": 1e-9})
    result, succeeded = nlp(PAIR, demand, np.array(P))
    assert succeeded
    assert PAIR.total(result) <= min(best.fun, total(least), total(most)) + 1e-6
    assert result.sum() == pytest.approx(demand, abs=1e-9)
    assert (low <= result).all()
    assert (result <= high).all()


@pytest.mark.parametrize(
    ("success", "answer", "raises", "used"),
    [
        (True, (200.0, 100.0), False, True),
        (False, (200.0, 100.0), False, False),
        (True, (math.nan, 100.0), False, False),
        (True, (200.0, 100.0), True, False),
        (True, (250.0, 50.0), False, None),  # costs more than the schedule at hand
        # Solutions may exceed their bounds by less than the tolerance.
        (True, (200.0 + 0.9e-5, 100.0 - 0.9e-5), False, True),
    ],
)
def test_results_of_ipopt_are_accepted_as_expected(monkeypatch, success, answer, raises, used):
    start, asked = np.array([220.0, 80.0]), []

    class Solver:
        def __call__(self, **bounds):
            asked.append(bounds)
            if raises:
                raise RuntimeError
            return {"x": np.array(answer)}

        def stats(self):
            return {"success": success}

    monkeypatch.setattr(casadi, "nlpsol", lambda *_: Solver())
    P, succeeded = nlp(PAIR, 300.0, start)
    assert succeeded == (used is not False)
    assert P.tolist() == ([200.0, 100.0] if used else start.tolist())
    assert asked[0]["lbx"].tolist() == [200.0, 60.0]
    assert asked[0]["ubx"].tolist() == [300.0, 100.0]
    assert (asked[0]["x0"].tolist(), asked[0]["lbg"], asked[0]["ubg"]) == (start.tolist(), 300.0, 300.0)


# The proof ----------------------------------------------------------------------------------------------


@pytest.fixture
def plain(monkeypatch):
    return interpreted(monkeypatch, branch, "unit_cost", "chord_excess", "_surplus", "_meets", "_order", "_value")


def excess(row, x0, x1):
    """The bound on chord minus cost by the rule of `chord_excess`, with slopes by differences of the cost."""
    p_min, _, a, _, _, e, f = row
    h, d = x1 - x0, 1e-7
    whole = a * h * h / 4.0
    if e * f * f <= 2 * a:
        return whole
    weak = 2 * a / (e * f * f)  # smallest |sin| at which the ripple outweighs the parabola
    chord = (cost(row, x1) - cost(row, x0)) / h
    down = abs(math.sin(f * (x0 - p_min))) < weak and (cost(row, x0 + d) - cost(row, x0)) / d < chord
    up = abs(math.sin(f * (x1 - p_min))) < weak and (cost(row, x1) - cost(row, x1 - d)) / d > chord
    return min(whole, a * (math.asin(weak) / f) ** 2) if down or up else 0.0


def stretches(n=60):
    """Random units, and a part of one arch of each; some begin or end at valve points."""
    chance = np.random.default_rng(8)
    for k in range(n):
        a, b, e, f = chance.uniform([0.0, -3.0, 0.0, 0.01], [0.3, 9.0, 300.0, 0.1])
        row = (10.0, 500.0, a, b, 20.0, e * (k % 4 > 0), f)
        arch = 10.0 + (k % 3) * PI / f
        s = np.sort(chance.uniform(0.0, 1.0, 2))
        s[0], s[1] = (0.0 if k % 5 == 0 else s[0]), (1.0 if k % 2 == 0 else s[1])
        yield row, *(arch + s * PI / f)
    for e in (1.9, 2.0, 2.1, 2.3):  # ripples about as strong as the parabola
        yield (0.0, 9.0, 1.0, 0.0, 0.0, e, 1.0), 0.0, PI


def test_a_chord_is_lowered_by_its_rule_and_is_then_below_the_cost(plain):
    tight = 0
    for row, x0, x1 in stretches():
        down = plain.chord_excess(row, x0, x1)
        assert down == pytest.approx(excess(row, x0, x1), abs=1e-9)
        x = np.linspace(x0, x1, 60)
        over = np.interp(x, [x0, x1], [cost(row, x0), cost(row, x1)]) - [cost(row, p) for p in x]
        assert over.max() <= down + 1e-9
        tight += down == 0.0
        assert plain.unit_cost(row, x1) == pytest.approx(cost(row, x1), rel=1e-12)
    assert 5 < tight < 50


def test_each_chord_of_a_unit_is_lowered_separately():
    down = [excess(PAIR.table[0], 100.0, 150.0), excess(PAIR.table[0], 150.0, 300.0)]
    assert lowering(PAIR, 0, np.array([100.0, 150.0, 300.0])).tolist() == pytest.approx(down)
    assert lowering(FOUR, 3, np.array([70.0])).tolist() == [0.0]


def envelope(points):
    """Corners of the lower convex envelope: no point is above a line through one before and one after it."""

    def above(k):
        x, y = points[k]
        return any(
            y >= y0 + (y1 - y0) * (x - x0) / (x1 - x0) - 1e-12
            for (x0, y0), (x1, y1) in itertools.product(points[:k], points[k + 1 :])
        )

    return [p for k, p in enumerate(points) if not above(k)]


@pytest.mark.parametrize(
    "row", [ROWS["three"], ROWS["half"], ROWS["smooth"], (10.0, 400.0, 0.05, 2.0, 9.0, 150.0, 0.08)]
)
def test_a_hull_is_the_envelope_of_the_lowered_chords(plain, row):
    chance = np.random.default_rng(2)
    x, y = np.empty(40), np.empty(40)
    boxes = np.sort(chance.uniform(row[0], row[1], (4, 2)))
    if row[5] == 0.0:
        boxes[:, 0] = row[0]
    for lo, hi in [(row[0], row[1]), *boxes]:
        n = plain._hull.py_func(row, lo, hi, NARROW, x, y)
        inside = [row[0] + k * PI / row[6] for k in range(99)] if row[5] > 0.0 else []
        ends = [lo, *(p for p in inside if lo + 1e-6 < p < hi - 1e-6), hi]
        low = [excess(row, *pair) for pair in itertools.pairwise(ends)]
        ys = [
            cost(row, p) - max(pair) for p, pair in zip(ends, zip([0.0, *low], [*low, 0.0], strict=True), strict=True)
        ]
        wanted = envelope(list(zip(ends, ys, strict=True)))
        assert x[:n].tolist() == pytest.approx([p for p, _ in wanted])
        assert y[:n].tolist() == pytest.approx([v for _, v in wanted], abs=1e-7)
        for p in np.linspace(lo, hi, 17):
            assert plain._value(x, y, n, p) == pytest.approx(np.interp(p, x[:n], y[:n]))
            assert plain._value(x, y, n, p) <= cost(row, p) + 1e-7


def test_a_narrow_box_is_one_point_below_all_of_it(plain):
    row, x, y = ROWS["three"], np.empty(9), np.empty(9)
    lo, hi = 150.0, 150.0 + NARROW
    assert plain._hull.py_func(row, lo, hi, hi - lo, x, y) == 1
    steepest = 8.0 + 2 * 0.002 * hi + 200.0 * PI / 100.0
    assert (x[0], y[0]) == (lo, pytest.approx(cost(row, lo) - (hi - lo) * steepest, abs=1e-12))
    assert cost(row, lo) - y[0] == pytest.approx(1e-6 * steepest, rel=1e-5)
    assert plain._value(x, y, 1, 150.0) == y[0]
    assert plain._hull.py_func(row, lo, hi, 0.9 * NARROW, x, y) == 2


def problem(units, demand, reserve=0.0, losses=None, ready=None, conditioned=True, groups=None):
    """The problem of the search."""
    n = len(units)
    losses_used = losses or Losses.none(n)
    return branch.Problem(units.table, np.arange(n) if groups is None else groups, demand, 1e-3, NARROW, units.p_min,
                          units.p_max, losses_used.B, losses_used.B0, losses_used.B00, reserve,
                          units.p_max - units.p_min if ready is None else ready, conditioned)  # fmt: skip


def test_pieces_are_filled_as_a_linear_programme_fills_them(plain):
    chance = np.random.default_rng(5)
    for k in range(12):
        n, pieces = 3, 8
        slope, width = chance.uniform(-2.0, 9.0, pieces), chance.uniform(1.0, 9.0, pieces)
        owner, beyond = chance.integers(0, n, pieces), chance.integers(0, 2, pieces).astype(float)
        weight, multiplier = chance.uniform(0.8, 1.2, n), float(k % 3)
        room = float((weight[owner] * width).sum())
        remaining, more = np.sort(chance.uniform(0.0, room, 2))
        if k % 2:
            more = remaining  # without losses both sides of the balance are equal
        P = np.zeros(n)
        relaxed = branch.Relaxed(
            np.empty(n), np.empty(n), weight, P, slope, width, owner, beyond, np.empty(pieces), np.empty(pieces, int)
        )
        lower, left = plain._fill.py_func(relaxed, (remaining, more, pieces), 10.0, multiplier)
        priced, rows = slope + multiplier * beyond, weight[owner]
        best = linprog(
            priced, [-rows, rows], [-remaining, more], bounds=list(zip(np.zeros(pieces), width, strict=True))
        )
        assert lower == pytest.approx(10.0 + best.fun, abs=1e-9)
        assert P.tolist() == pytest.approx(np.bincount(owner, best.x, n).tolist(), abs=1e-7)
        assert left == pytest.approx(remaining - rows @ best.x, abs=1e-7)


def test_the_order_of_pieces_is_that_of_their_values(plain):
    chance = np.random.default_rng(6)
    for n in (0, 1, 2, 3, 7, 20, 33):
        values, index = chance.permutation(40).astype(float), np.full(40, -1)
        plain._order(values, n, index)
        assert index[:n].tolist() == np.argsort(values[:n]).tolist()
        assert index[n:].tolist() == [-1] * (40 - n)


THREE = Units(("a", "b", "c"), FOUR.table[:3])


def test_the_balance_of_a_box_is_its_tangent_and_the_bound_of_its_error(plain):
    p = problem(THREE, 400.0, losses=LOSSES)
    centre, half = np.array([200.0, 70.0, 100.0]), np.array([30.0, 10.0, 20.0])
    relaxed = types.SimpleNamespace(centre=centre, half=half, weight=np.empty(3))
    least, most = plain._tangent.py_func(p, relaxed)
    assert relaxed.weight.tolist() == pytest.approx((1.0 - 2.0 * B3 @ centre - B0).tolist())
    wrong = sum(abs(B3[i, j]) * half[i] * half[j] for i in range(3) for j in range(3))
    middle = 400.0 + B00 - sum(centre[i] * B3[i, j] * centre[j] for i in range(3) for j in range(3))
    assert (least, most) == (pytest.approx(middle - wrong), pytest.approx(middle + wrong))
    for corner in itertools.product((-1.0, 1.0), repeat=3):  # the bounds contain all balanced points of the box
        P = centre + np.array(corner) * half
        assert plain._surplus(p, P) == pytest.approx(P.sum() - lost(P) - 400.0)
        weighed = relaxed.weight @ P
        assert least - 1e-9 <= weighed - (P.sum() - lost(P) - 400.0) <= most + 1e-9


@pytest.mark.parametrize(
    ("P", "reserve", "meets"),
    [
        ((200.0, 70.0, 130.0), 0.0, True),
        ((200.0, 70.0, 130.0 + 0.9e-7), 0.0, True),
        ((200.0, 70.0, 130.0 + 1.1e-7), 0.0, False),
        ((200.0, 70.0, 130.0 - 1.1e-7), 0.0, False),
        ((100.0 - 0.9e-9, 120.0, 150.0), 0.0, True),
        ((100.0 - 1.1e-9, 120.0, 150.0), 0.0, False),
        ((300.0, 50.0, 50.0 - 1.1e-9), 0.0, False),
        ((129.9, 120.0 + 0.9e-9, 150.0), 0.0, True),
        ((129.9, 120.0 + 1.1e-9, 150.0), 0.0, False),
        ((200.0, 70.0, 130.0), 60.0, True),  # reserves of 30 of 200 MW, 10 of 50 MW and 20 of 20 MW
        ((200.0, 70.0, 130.0), 60.0 + 0.9e-7, True),
        ((200.0, 70.0, 130.0), 60.0 + 1.1e-7, False),
        ((180.0, 70.0, 150.0), 41.0, False),
    ],
)
def test_conditions_are_met_within_their_tolerances(plain, P, reserve, meets):
    case = problem(
        THREE, math.fsum(P) if abs(math.fsum(P) - 400.0) > 1e-3 else 400.0, reserve, ready=np.array([30.0, 10.0, 20.0])
    )
    assert plain._meets(case, np.array(P)) == meets


def test_a_nearly_balanced_dispatch_is_repaired_by_the_cheapest_unit(plain):
    case = problem(THREE, 380.0, losses=LOSSES)
    for start in ([200.0, 70.0, 130.0], [210.0, 119.0, 60.0], [130.0, 110.0, 149.5], [399.0, 21.0, 50.0]):
        choices = []
        for j in range(3):
            P = np.array(start)
            for _ in range(60):  # the output of one unit by Newton's method
                P[j] += (380.0 - P.sum() + lost(P)) / (1.0 - 2.0 * B3[j] @ P - B0[j])
            if THREE.p_min[j] <= P[j] <= THREE.p_max[j]:
                choices.append((THREE.total(P), P.tolist()))
        P = np.array(start)
        result = plain._mended.py_func(case, P)
        if choices:
            assert (result, P.tolist()) == (pytest.approx(min(choices)[0]), pytest.approx(min(choices)[1]))
        else:
            assert (result, P.tolist()) == (np.inf, start)
    P = np.array([100.0, 20.0, 50.0])
    assert plain._mended.py_func(problem(THREE, 600.0), P) == np.inf  # no single unit can supply the difference
    assert P.tolist() == [100.0, 20.0, 50.0]


def brute(units, demand, losses=None, reserve=0.0, ready=None, low=None, high=None, step=2.0):
    """The least cost over a grid of two of three units, the third balancing."""
    losses = losses or Losses.none(3)
    low, high = units.p_min if low is None else low, units.p_max if high is None else high
    axes = [np.unique([*np.arange(low[j], high[j], step), *units.valve_points(j), high[j]]) for j in (0, 1)]
    axes = [a[(a >= low[j]) & (a <= high[j])] for j, a in enumerate(axes)]
    p0, p1 = (a.ravel() for a in np.meshgrid(*axes))
    p2 = np.maximum(demand - p0 - p1, 0.0)
    for _ in range(15):
        P = np.column_stack([p0, p1, p2])
        p2 = demand + np.einsum("ki,ij,kj->k", P, losses.B, P) + P @ losses.B0 + losses.B00 - p0 - p1
    P = np.column_stack([p0, p1, p2])
    good = (p2 >= low[2]) & (p2 <= high[2])
    if reserve:
        good &= np.minimum(ready, units.p_max - P).sum(axis=1) >= reserve
    return float(units.cost(P[good]).sum(axis=1).min()) if good.any() else np.inf


CONDITIONS = {
    "losses": (Losses(0.1 * B3, 0.1 * B0, B00), 0.0, None, None, None),
    "reserve": (None, 45.0, (30.0, 10.0, 20.0), None, None),
    "windows": (None, 0.0, None, (150.0, 30.0, 60.0), (320.0, 90.0, 140.0)),
    "all": (Losses(0.1 * B3, 0.1 * B0, B00), 52.0, (30.0, 10.0, 20.0), (150.0, 30.0, 60.0), (320.0, 90.0, 140.0)),
}


@pytest.mark.parametrize(
    ("case", "demand", "boxes"),
    [
        ("losses", 380.0, 285),
        ("losses", 500.0, 285),
        ("reserve", 400.0, 3),
        ("reserve", 560.0, 387),
        ("windows", 330.0, 25),
        ("all", 380.0, 285),
        ("all", 440.0, 237),
    ],
)
def test_a_proof_with_conditions_is_a_lower_bound_and_reaches_the_best_within_its_boxes(case, demand, boxes):
    losses, reserve, ready, low, high = CONDITIONS[case]
    conditions = Conditions(
        THREE.p_min if low is None else np.array(low),
        THREE.p_max if high is None else np.array(high),
        losses or Losses.none(3),
        reserve,
        np.array(ready) if ready else THREE.p_max - THREE.p_min,
    )
    best = brute(THREE, demand, losses, reserve, conditions.ready, conditions.low, conditions.high)
    result = Optimiser(THREE).conditioned(demand, conditions)
    assert result.bound <= best + 1e-9
    assert result.cost <= best + 1e-3
    assert result.gap <= 1e-3
    assert result.nodes == pytest.approx(boxes, rel=0.05)
    assert (result.losses, result.reserve) == (conditions.losses.of(result.P), conditions.spinning(THREE, result.P))
    assert (result.stage, result.reason) == ("branch and bound", "proven")
    share = 1.0 - conditions.losses.slopes(result.P)  # of each further MW of a unit, this share is delivered
    left, right = (s / share for s in THREE.slopes(result.P))
    assert result.price == (max(left), min(right))


@pytest.mark.parametrize("reserve", [0.0, 45.0])
def test_the_starting_point_of_a_proof_counts_if_it_meets_the_conditions(reserve):
    conditions = Conditions(THREE.p_min, THREE.p_max, Losses.none(3), reserve, np.array([30.0, 10.0, 20.0]))
    for P, good in (((200.0, 70.0, 130.0), True), ((200.0, 70.0, 131.0), False), ((130.0, 120.0, 150.0), not reserve)):
        proof = branch.branch_and_bound(THREE, 400.0, np.array(P), 1e-3, 0, conditions)
        assert (proof.cost, proof.nodes) == (pytest.approx(THREE.total(P)) if good else np.inf, 0)
        assert proof.P.tolist() == list(P)
        assert proof.bound == -np.inf
    plain = branch.branch_and_bound(THREE, 400.0, np.array([200.0, 70.0, 131.0]), 1e-3, 0)
    assert plain.cost == pytest.approx(THREE.total([200.0, 70.0, 131.0]))  # this method does not check the balance


# The answer ---------------------------------------------------------------------------------------------


def test_an_answer_without_a_proof_claims_none():
    dispatch = Dispatch(np.ones(1), 5.0)
    assert (dispatch.bound, dispatch.price, dispatch.gap) == (-np.inf, (-np.inf, np.inf), np.inf)
    assert (dispatch.stages, dispatch.nodes, dispatch.binaries, dispatch.stage, dispatch.reason) == ({}, 0, 0, "", "")
    assert (dispatch.trace, dispatch.limited) == ([], False)
    assert np.isnan([dispatch.losses, dispatch.reserve]).all()


def test_the_search_begins_with_equal_shares_of_the_ranges_or_with_the_given_point():
    work = Optimiser(PAIR)
    for start, arches in [
        (None, [(200.0, 60.0), (300.0, 100.0)]),  # at 180 of 400 MW: 100 + 135 and 20 + 45
        ((250.0, 50.0), [(200.0, 20.0), (300.0, 60.0)]),
        ((150.0, 110.0), [(100.0, 100.0), (200.0, 120.0)]),  # 40 MW are missing
    ]:
        result = work.start(300.0, None if start is None else np.array(start))
        for p, low, high in zip(result, *arches, strict=True):
            assert low - 1e-9 <= p <= high + 1e-9
        assert result.sum() == pytest.approx(300.0)
    fixed = Optimiser(Units(("a",), [[5.0, 5.0, 0.0, 1.0, 0.0, 0.0, 0.0]]))
    assert fixed.start(5.0).tolist() == [5.0]


def test_progress_reports_the_best_cost_then_its_bound():
    messages = []
    result = Optimiser(FOUR, tol=40.0).certified(611.0, progress=lambda best, bound: messages.append((best, bound)))
    assert messages[-1] == (result.cost, result.bound)
    assert all(bound <= best for best, bound in messages)
    assert result.bound < result.cost
    assert list(result.stages) == ["branch and bound"]
    assert [(best, bound) for _, best, bound in result.trace] == messages
    assert result.gap == result.cost - result.bound


def test_the_stages_of_a_proof_that_runs_out_of_boxes_are_as_expected():
    messages = []
    work = Optimiser(PAIR, max_nodes=1, nseg=2, tol=1e-2)
    result = work.certified(333.0, progress=lambda best, bound: messages.append((best, bound)))
    assert list(result.stages) == ["branch and bound", "two stages", "adaptive MILP"]
    assert (result.stage, result.reason, result.limited) == ("adaptive MILP", "proven", False)
    assert len(result.trace) == len(messages) > 2
    assert result.trace[0][2] == result.trace[1][2]  # the two stages do not raise the bound
    assert [t for t, *_ in result.trace] == sorted(t for t, *_ in result.trace)
    assert result.binaries >= 6 + 5
    assert result.nodes >= 1
    proven = Optimiser(PAIR).certified(333.0)
    assert (proven.binaries, proven.reason) == (0, "proven")
    assert result.cost == pytest.approx(proven.cost, abs=1e-2)


def test_a_segment_is_split_where_its_chord_is_too_low():
    work, row = Optimiser(PAIR), PAIR.table[0]
    points, low = np.array([100.0, 200.0, 300.0, 400.0]), np.array([1.0, 2.0, 3.0])

    def below(x0, x1, p, down):
        return cost(row, p) - (cost(row, x0) + (cost(row, x1) - cost(row, x0)) * (p - x0) / (x1 - x0)) + down

    for p, at, ends, down in [
        (160.0, 160.0, (100.0, 200.0), 1.0),
        (114.0, 150.0, (100.0, 200.0), 1.0),  # close to an end, the range is split in the middle
        (116.0, 116.0, (100.0, 200.0), 1.0),
        (286.0, 250.0, (200.0, 300.0), 2.0),
        (300.0, 350.0, (300.0, 400.0), 3.0),
        (400.0, 350.0, (300.0, 400.0), 3.0),
        (100.0, 150.0, (100.0, 200.0), 1.0),
    ]:
        assert work._missing(0, p, points, low) == (at, pytest.approx(below(*ends, p, down)))
    assert work._missing(0, 100.0, np.array([100.0]), low) == (100.0, 0.0)
    assert work._missing(0, 150.0, np.array([150.0, 150.0 + 0.9e-5]), low) == (150.0, 0.0)
    at, missing = work._missing(0, 150.0, np.array([150.0, 150.0 + 1.1e-5]), low)
    assert (at, missing) == (pytest.approx(150.0 + 0.55e-5, abs=1e-7), pytest.approx(1.0))


def test_impossible_problems_are_reported_with_their_numbers():
    def conditioned(demand, reserve=0.0, nodes=1000, losses=None):
        conditions = Conditions.of(PAIR, losses, reserve)
        return Optimiser(PAIR, max_nodes=nodes).conditioned(demand, conditions)

    with pytest.raises(InfeasibleError, match=r"^infeasible: no dispatch meets demand 515 MW and reserve 20 MW$"):
        conditioned(515.0, 20.0)
    some = Losses(1e-4 * np.eye(2), np.zeros(2))
    text = r"^no dispatch found in 0 boxes for demand 300 MW with its conditions$"
    with pytest.raises(InfeasibleError, match=text):
        conditioned(300.0, nodes=0, losses=some)
    open_end = Optimiser(PAIR, max_nodes=3).conditioned(300.0, Conditions.of(PAIR, some))
    assert (open_end.reason, open_end.nodes) == ("3 boxes", 3)
    assert open_end.gap > 1e-3


# Kinks --------------------------------------------------------------------------------------------------


def kinks(units, demand):
    """All but one unit on valve points or limits, with every one of them free in turn."""
    best, count = (np.inf, None), 0
    points = [units.valve_points(j).tolist() for j in range(len(units))]
    for free in range(len(units)):
        others = [[p] if j == free else ps for j, (p, ps) in enumerate(zip(units.p_min, points, strict=True))]
        for P in map(list, itertools.product(*others)):
            P[free] = demand - sum(P) + P[free]
            if units.p_min[free] - 1e-9 <= P[free] <= units.p_max[free] + 1e-9:
                count += 1
                best = min(best, (units.total(np.clip(P, units.p_min, units.p_max)), P), key=lambda f: f[0])
    return *best, count


@pytest.mark.parametrize("demand", [240.0, 333.0, 480.0, 611.0, 740.0])
def test_kinks_equal_those_of_brute_force(demand):
    least, P, count = kinks(FOUR, demand)
    result = enumerate_kinks(FOUR, demand)
    assert FOUR.total(result) == pytest.approx(least)
    assert result.tolist() == pytest.approx(P)
    assert enumerate_kinks(FOUR, demand, most=count + 1).tolist() == result.tolist()
    with pytest.raises(
        TooManyError, match=f"^more than {count} combinations of valve points; expected at most about 13"
    ):
        enumerate_kinks(FOUR, demand, most=count)


def test_copies_are_counted_once_and_what_kinks_cannot_meet_is_reported():
    twins = Units(("a", "b", "c"), FOUR.table[[1, 1, 1]])
    for demand in (130.0, 222.0, 300.0):
        result = enumerate_kinks(twins, demand)
        assert twins.total(result) == pytest.approx(kinks(twins, demand)[0])
    text = "^infeasible: demand 59 MW, but the units give 60 to 360 MW$"
    with pytest.raises(InfeasibleError, match=text):
        enumerate_kinks(twins, 59.0)
    apart = Units(("a", "b"), [[0.0, 1.0, 0, 0, 0, 1.0, PI], [0.0, 0.5, 0, 0, 0, 0, 0]])
    assert enumerate_kinks(apart, 0.75).tolist() == [0.25, 0.5]  # the second unit is at its limit


# The fleet ----------------------------------------------------------------------------------------------


def test_the_fleet_goes_to_its_set_points_within_limits_and_ramp():
    fleet = ByHand(UnitFleet(unit_table="units_3", period=2.0))
    fleet.advance(0, setpoints=(700.0, 60.0, 0.0))  # limits of 100 to 600, 50 to 200 and 100 to 400 MW; no ramp
    output = fleet.outputs(1)["state"][:3]
    assert output == (600.0, 60.0, 100.0)
    slow = ByHand(UnitFleet(unit_table="units_3", period=2.0, ramp=5.0))
    slow.advance(0, setpoints=(700.0, 55.0, 0.0))
    assert slow.outputs(1)["state"][:3] == (110.0, 55.0, 100.0)
    slow.advance(1, setpoints=(100.0, 200.0, 104.0))
    assert slow.outputs(2)["state"][:3] == (100.0, 65.0, 104.0)


# The node -----------------------------------------------------------------------------------------------


def test_a_dispatch_is_requested_at_the_expected_ticks():
    solver = DispatchSolver(unit_table="units_3")
    table = tuple(Units.read("units_3").table.ravel().tolist())
    dear = tuple(x + (1.0 if k % 7 == 4 else 0.0) for k, x in enumerate(table))
    broken = (99999.0, *table[1:])
    x, asked = solver.first(), []
    for demand, units, solve, wanted in [
        (None, None, None, None),  # no demand has arrived yet
        (None, None, 1.0, None),
        (850.0, None, 1.0, 850.0),
        (850.0, None, 1.0, None),  # the button is still pressed
        (850.0, None, 0.0, None),
        (850.0, None, 1.0, 850.0),  # the button is pressed again
        (900.0, None, 1.0, 900.0),
        (900.0, table, None, 900.0),
        (900.0, table, None, None),
        (900.0, dear, None, 900.0),
        (900.0, broken, None, None),  # an invalid table is the only new message
        (900.0, broken, None, None),
        (910.0, broken, None, 910.0),
        (2000.0, broken, None, None),  # the demand exceeds the units
        (910.0, dear, None, 910.0),
    ]:
        inputs = {"demand": None if demand is None else (demand,), "solve": None if solve is None else (solve,)}
        x, request = solver.request(x, 0, units=units, **inputs)
        assert (request and request.demand) == wanted
        if request:
            asked.append(request)
            assert (request.conditions, request.start, request.p) == (None, None, solver.p)
    assert x.requests == len(asked) == 7
    assert asked[0].units.ids == Units.read("units_3").ids
    assert [r.units.table.ravel().tolist() == list(dear) for r in asked] == [
        False,
        False,
        False,
        False,
        True,
        True,
        True,
    ]
    assert len({r.drawn for r in asked}) == 7
    assert [r.drawn for r in asked] == solver.generator().integers(2**32, size=7).tolist()
    assert "units" not in solver.reports
    text = "infeasible: demand 2000 MW, but the units give 250 to 1200 MW; the last set points stay"
    assert solver.reports["infeasible"][1] == text


def test_a_press_requests_again_an_invalid_table_does_not_count_and_the_default_demand_counts():
    solver = DispatchSolver(unit_table="units_3", demand=700.0)
    table = Units.read("units_3").table.ravel().tolist()
    x, request = solver.request(solver.first(), 0)
    assert request.demand == 700.0
    x, request = solver.request(x, 0, units=(99999.0, *table[1:]), solve=(1.0,))
    assert request.demand == 700.0
    assert solver.request(x, 0, units=(99999.0, *table[1:]))[1] is None
    text = f"dispatch/units: unit {x.units.ids[0]}: p_min_MW 99999 is above p_max_MW {table[1]:g}; the last table stays"
    assert solver.reports["units"][1] == text
    best = Dispatch(np.array([300.0, 150.0, 250.0]), 1.0)
    assert solver.request(x._replace(last=best), 0, demand=(800.0,))[1].start.tolist() == [300.0, 150.0, 250.0]
    cold = DispatchSolver(unit_table="units_3", warm_start=False)
    assert cold.request(cold.first()._replace(last=best), 0, demand=(800.0,))[1].start is None


def solved(demand, units="units_3", conditions=None, start=None, drawn=5, **values):
    """The result of the working process."""
    p = DispatchSolver(unit_table=units, **values).p
    messages = []
    work = types.SimpleNamespace(status=lambda **figures: messages.append(figures))
    return DispatchSolver.solve(Request(p, Units.read(units), demand, start, conditions, drawn), work), messages


def test_each_method_runs_in_the_working_process():
    units = Units.read("units_3")
    proven, reported = solved(850.0)
    assert (proven.reason, proven.nodes) == ("proven", 41)
    assert reported[-1] == {"cost": proven.cost, "bound": proven.bound}
    floor = lambda_cost(units, 850.0)
    for method, within in (("two_stage", 1e-3), ("enumeration", 1e-3), ("baseline", 200.0)):
        result, _ = solved(850.0, method=method, n_pop=8, n_iter=5)
        assert result.cost == pytest.approx(8234.07173, abs=within)
        assert result.bound == pytest.approx(floor, abs=1e-6)
        assert result.price == marginal_cost(units, result.P)
        assert result.stage == ("nlp" if method == "two_stage" else method)
    swarms = [
        solved(850.0, method="baseline", n_pop=8, n_iter=5, seed=s, drawn=d)[0].P.tolist()
        for s, d in ((0, 5), (1, 5), (0, 6))
    ]
    assert len({tuple(P) for P in swarms}) == 3  # both the node's seed and the run's seed matter
    assert solved(849.0, "40*units_13", method="enumeration")[0] == (
        "infeasible: demand 849 MW, but the units give 22000 to 118400 MW"
    )


def lambda_cost(units, demand):
    """Least cost without ripples: equal slopes, by bisection."""
    low, high = 0.0, 100.0
    for _ in range(200):
        price = 0.5 * (low + high)
        P = [min(max((price - r[3]) / (2 * r[2]), r[0]), r[1]) for r in units.table]
        low, high = (price, high) if sum(P) < demand else (low, price)
    return sum(cost((*r[:5], 0.0, r[6]), p) for r, p in zip(units.table, P, strict=True))


def answered(result, repeatable=True, units=PAIR, x=None):
    """Reports and values for an answer."""
    solver = DispatchSolver(unit_table="units_3")
    request = Request(solver.p, units, 300.0, None, None, 0)
    x, values = solver.answer(x or solver.first(), 0, Result(0, request, result, repeatable), True)
    return solver, x, values


def test_reports_of_a_dispatch_are_as_expected():
    dispatch = Dispatch(np.array([200.0, 99.0]), 10.0, 7.0, (-np.inf, 5.0), {"nlp": 1.0}, 3, 4, "nlp", "two stages")
    solver, x, values = answered(dispatch)
    assert values["setpoints"] == (200.0, 99.0)
    of = [cost(r, p) for r, p in zip(PAIR.table, dispatch.P, strict=True)]
    # Both ends of an arch belong to it.
    assert values["result"] == pytest.approx((200.0, of[0], 2.0, 1.0, 99.0, of[1], 2.0, 0.0))
    assert values["summary"] == (300.0, 10.0, 7.0, 3.0, -1e9, 5.0, 3.0, 4.0, 1.0)
    assert x.last is dispatch
    assert solver.reports == {}
    ends = answered(Dispatch(np.array([400.0 - 0.9e-6, 20.0 + 1.1e-6]), 10.0))[2]
    assert ends["result"][2:4] + ends["result"][6:] == (3.0, 1.0, 1.0, 0.0)
    assert ends["summary"][4:6] == (-1e9, 1e9)
    assert answered(dispatch, repeatable=False)[2]["summary"][8] == 0.0
    limited = Dispatch(np.array([200.0, 99.0]), 10.0, 7.0, reason="time limit; the NLP failed: x", limited=True)
    solver, _, values = answered(limited)
    assert values["summary"][8] == 0.0
    assert [(level, text) for level, text, *_ in solver.reports.values()] == [
        (Level.WARN, "time limit; the NLP failed: x"),
        (Level.WARN, "time limit; the NLP failed: x: gap 3 $/h, not repeatable"),
    ]
    assert solver.answer(x, 0, Result(0, None, dispatch, True), False) == (x, {})


def test_an_answer_withdraws_an_earlier_error():
    solver = DispatchSolver(unit_table="units_3")
    for key in ("infeasible", "no dispatch", "NLP", "time limit", "units"):
        solver.report(Level.ERROR, key, "so")
    request = Request(solver.p, PAIR, 300.0, None, None, 0)
    solver.answer(solver.first(), 0, Result(0, request, Dispatch(np.array([200.0, 100.0]), 10.0), True), True)
    assert list(solver.reports) == ["units"]


def test_the_health_of_the_node_is_described_as_expected():
    solver = DispatchSolver(unit_table="units_3")
    assert solver.health(solver.first()) == {"work": "idle"}
    dispatch = Dispatch(np.ones(2), 10.123456789, 7.0, (1.0, 5.0), {"nlp": 1.2345}, 3, 4, "nlp", "two stages")
    wanted = {
        "work": "idle",
        "cost": "10.1234568 $/h",
        "lower bound": "7 $/h",
        "gap": "3.12 $/h",
        "stage reached": "nlp",
        "stop reason": "two stages",
        "nodes": "3",
        "binaries": "4",
        "stage nlp": "1.23 s",
    }
    assert solver.health(solver.first()._replace(last=dispatch)) == wanted
    dispatch.losses, dispatch.reserve = 1.5, 2.5
    more = {"losses": "1.5 MW", "reserve": "2.5 MW"}
    assert solver.health(solver.first()._replace(last=dispatch)) == wanted | more


def test_methods_accept_conditions_as_expected(tmp_path):
    head = f"{HEAD},p_now_MW,ramp_up_MW,ramp_down_MW\n"

    def conditioned(now="", up="", down="", **values):
        (tmp_path / "u.csv").write_text(f"{head}a,1,9,3,4,5,6,7,{now},{up},{down}\n")
        solver = DispatchSolver(unit_table=str(tmp_path / "u.csv"), **values)
        return solver.p.conditioned(Units.read(solver.p.unit_table))

    assert not conditioned()
    assert not conditioned(now="5")
    # Ramps without a present output would have no effect.
    with pytest.raises(ParameterError, match="ramp_up_MW needs p_now_MW"):
        conditioned(up="5", down="5")
    assert conditioned(now="5", up="5")
    assert conditioned(now="5", down="5")
    assert conditioned(reserve=1.0)
    with pytest.raises(
        ParameterError, match="method = enumeration: losses, ramps and reserve are for the method certified"
    ):
        conditioned(reserve=1.0, method="enumeration")
