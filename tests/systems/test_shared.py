"""Values shared by several nodes of a rig: one place to change them, and nodes that must agree."""

import numpy as np
import pytest
from softrig_core import ByHand, ScenarioError, load_scenario, rig_of, simulate
from softrig_power.gupfc.power_flow_node import PowerFlowNode

SHARED = [
    ("tcp_aqm_smc", "N", 48, {"tcp_fluid", "aqm_controller"}),
    ("tcp_aqm_smc", "C", 3000.0, {"tcp_fluid", "aqm_controller"}),
    ("tcp_aqm_smc", "tau_p", 0.25, {"tcp_fluid", "aqm_controller"}),
    ("tcp_aqm_smc_s5", "q_max", 250.0, {"tcp_fluid", "aqm_controller"}),
    ("tcp_aqm_smc_s4", "N", 50, {"tcp_packets", "aqm_controller"}),
    ("tcp_aqm_smc_s4", "set_point", 100.0, {"aqm_controller"}),
    ("optimal_control_mvim", "inertia", (90.0, 85.0, 110.0), {"spacecraft_plant", "mvim_planner", "ocp_evaluator"}),
    ("optimal_control_mvim", "horizon", 50.0, {"spacecraft_plant", "mvim_planner", "ocp_evaluator"}),
    ("optimal_control_mvim_a2", "horizon", 50.0, {"spacecraft_plant", "collocation_planner", "ocp_evaluator"}),
    ("optimal_control_mvim_a4", "horizon", 50.0, {"spacecraft_plant", "momentum_feedback", "ocp_evaluator"}),
    ("optimal_control_mvim", "x0", (0.02, 0.005, 0.001), {"spacecraft_plant", "ocp_evaluator"}),
    (
        "gupfc",
        "network.half_length",
        210.0,
        {"gupfc_plant", "shunt_controller", "series_controller_1", "series_controller_2"},
    ),
    ("gupfc", "initial.p1", 1.1, {"gupfc_plant", "shunt_controller", "series_controller_1", "series_controller_2"}),
    ("economic_dispatch", "table", "units_3", {"unit_fleet", "dispatch_solver"}),
]


@pytest.mark.parametrize(("scenario", "name", "value", "nodes"), SHARED)
def test_a_shared_value_reaches_all_that_have_it(scenario, name, value, nodes):
    value_as_read = list(value) if isinstance(value, tuple) else value
    rig = rig_of(load_scenario(scenario, {name: value_as_read}))
    first, _, last = name.partition(".")
    parameter = {"table": "unit_table"}.get(first, first)
    results = {}
    for m in rig.members:
        had = getattr(m.params, parameter, None)
        results |= {m.name: getattr(had, last) if last else had} if had is not None else {}
    assert {node for node, had in results.items() if had == value} == nodes


@pytest.mark.parametrize(
    ("scenario", "change", "quantity"),
    [
        ("optimal_control_mvim", {"ocp_evaluator.inertia": [90.0, 85.0, 110.0]}, "ocp/inertia"),
        ("optimal_control_mvim", {"ocp_evaluator.x0": [0.02, 0.005, 0.001]}, "ocp/x0"),
        ("optimal_control_mvim", {"mvim_planner.horizon": 90.0}, "ocp/horizon"),
        ("optimal_control_mvim_a2", {"collocation_planner.x_end": [0.001, 0.0, 0.0]}, "ocp/x_end"),
        ("optimal_control_mvim_a4", {"momentum_feedback.horizon": 90.0}, "ocp/horizon"),
        ("gupfc", {"series_controller_2.network.r1": 0.03}, r"gupfc/network\.r1"),
        ("gupfc", {"shunt_controller.initial.v": 1.01}, r"gupfc/initial\.v"),
        ("gupfc", {"gupfc_plant.waveform": "pulse"}, "gupfc/waveform"),
        ("economic_dispatch", {"dispatch_solver.unit_table": "units_13_e3_150"}, "dispatch/unit 3"),
        ("economic_dispatch", {"unit_fleet.unit_table": "units_3"}, "dispatch/units"),
    ],
)
def test_nodes_that_must_agree_are_refused_by_name(scenario, change, quantity):
    with pytest.raises(ScenarioError, match=f"must agree on {quantity}, but "):
        rig_of(load_scenario(scenario, change))


def test_an_assumption_of_a_controller_about_its_plant_may_be_wrong():
    for scenario, change in (
        ("tcp_aqm_smc", {"tcp_fluid.N": 54}),
        ("optimal_control_mvim_s4", {}),
        ("tcp_aqm_smc", {"aqm_controller.C": 3000.0}),
    ):
        rig = rig_of(load_scenario(scenario, change))
        assert all(rig.parameter(*name.split(".")) == value for name, value in change.items())


def test_figures_of_the_queue_follow_the_set_point_and_the_network():
    """Before a fix: 120 packets, 14.5 packets and 3750 packet/s, whatever the scenario was."""
    run = simulate("tcp_aqm_smc", overrides={"set_point": 90.0, "N": 50, "C": 3000.0}, duration=8.0)
    q, w = (run.signals[f"network/state/{name}/position"].x for name in ("queue", "window"))
    served = run.signals["network/truth/served/position"].x
    # A reference is not published at the end.
    assert run.figures["J_q"] == pytest.approx(np.mean((q[:-1] - 90.0) ** 2))
    assert run.figures["J_w"] == pytest.approx(np.mean((w[:-1] - (90.0 / 3000.0 + 0.2) * 3000.0 / 50) ** 2))
    assert run.figures["utilisation"] == pytest.approx((served[-1] - served[0]) / (3000.0 * 8.0))
    assert run.figures["queue_end"] == pytest.approx(90.0, abs=0.5)
    status = {name: value for name, (value, _) in run.blocks["aqm_metrics"].status().items()}
    assert status["J_w"] == pytest.approx(run.figures["J_w"], rel=0.05)
    assert status["J_q"] == pytest.approx(run.figures["J_q"], rel=0.05)


@pytest.mark.long
def test_the_evaluator_judges_the_actual_plant():
    """With a tenth more inertia than the planner assumes its promise cannot be met, and the evaluator reports it."""
    run = simulate("optimal_control_mvim_s4")
    inertia, w = np.array([94.864, 93.577, 124.949]), np.array([0.01, 0.005, 0.001])
    assert run.figures["J_exact"] == pytest.approx(np.sum((inertia * w) ** 2) / 200.0)
    assert run.figures["infeasible"] == 1.0


def test_an_operating_point_that_a_flat_start_misses_is_held_by_the_rig():
    """The reference of circuit 1 and 2 that diverged from a flat start: the rig starts there and stays."""
    flows = {"p1": 1.3, "q1": 0.15, "p2": 0.85, "q2": -0.1, "v": 1.02}
    run = simulate(
        "gupfc", overrides={"initial": flows, "flows_1": [1.3, 0.15] * 3, "flows_2": [0.85, -0.1] * 3}, duration=0.5
    )
    for name, value in flows.items():
        result = run.signals[f"gupfc/status/{'v1' if name == 'v' else name}/position"].x
        assert np.abs(result - value).max() < 1e-3


def test_the_power_flow_reports_the_number_of_operating_points():
    node = ByHand(PowerFlowNode())
    node.update(0, request=None, series_1=(1.3, 0.15), series_2=(0.85, -0.1), shunt=(1.02,))
    text = node.health()["operating points"]
    assert text == "8; taken: the one with the smallest series voltage, 0.2363 pu, the next needs 1.022 pu"
