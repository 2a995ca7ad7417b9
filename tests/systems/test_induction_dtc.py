"""Induction motor under direct torque control: the acceptance numbers, the model, the controllers, bad input."""

import math
from itertools import groupby

import numpy as np
import pytest
from conftest import differences, few, in_process
from scipy.integrate import solve_ivp
from softrig_bringup.plots import pictures as plots
from softrig_bringup.run.run import checked, execute
from softrig_core import (
    ByHand,
    Level,
    Refused,
    Scenario,
    ScenarioError,
    Signals,
    evaluate,
    list_scenarios,
    load_scenario,
    rig_of,
    run_inprocess,
)
from softrig_core.block.codec import Decoder
from softrig_core.kit import compiled
from softrig_core.wire.cdr import Layout
from softrig_drives.induction_dtc.dtc import DtcController
from softrig_drives.induction_dtc.figures import largest, leg_transitions
from softrig_drives.induction_dtc.machine import STATES, MachineConstants
from softrig_drives.induction_dtc.plant import ImPlant
from softrig_drives.induction_dtc.ports import SWITCHES
from softrig_drives.induction_dtc.switching import (
    TABLES,
    VECTORS,
    voltage,
)
from softrig_nodes.processes.placement import Placement

T_S = 5e-5
Q = 1 / 32  # A, resolution of a current
R_S = 3.7


def recorded(scenario):
    return Signals(in_process(rig_of(scenario), scenario.seed))


# Runs of 10 s, and those that differ from others only in a number. Ideal, truncating and dithered converters run
# daily.
LATER = ("e1", "e2", "e2_3_lsb", "s1", "s4", "s5", "s6_offset", "s7", "s8_half", "s8_matched", "s9_minus", "s9_plus",
         "s9_plus_2", "ts_25", "4kw")  # fmt: skip


@pytest.mark.parametrize(
    "name",
    few(
        [
            pytest.param(n, marks=pytest.mark.long) if n[14:] in LATER else n
            for n in sorted(list_scenarios())
            if n.startswith("induction_dtc")
        ],
        1,
    ),
)
def test_scenario_meets_its_numbers(name):
    scenario = load_scenario(name)
    rows = {row.name: row for row in evaluate(rig_of(scenario), recorded(scenario))}
    assert [name for name, row in rows.items() if not row.passed] == []


def end_errors(name, runs):
    """|e| in Wb at the last control instant of 2 s runs; `runs` has (seed, load torque)."""
    scenario = load_scenario(name)
    source = scenario.nodes["load_source"]
    errors = []
    for seed, load in runs:
        loaded = source.model_copy(update={"parameters": source.parameters | {"values": [0.0, load]}})
        rig = rig_of(scenario.model_copy(update={"nodes": scenario.nodes | {"load_source": loaded}}))
        errors.append(run_inprocess(rig, seed)["flux_monitor"].status()["flux_error_end"][0])
    return np.array(errors)


def random_walk(variance, t=2.0):
    """rms |e| in Wb of a converter error of this variance in LSB^2: i_beta = (i_a + 2 i_b)/sqrt 3."""
    return R_S * Q * math.sqrt(T_S * t * (1 + 5 / 3) * variance)


@pytest.mark.long  # 70 runs; daily, the scenario expects the drift of a single one
def test_quantisation_is_a_random_walk_and_dither_doubles_it():
    loads = np.linspace(6.0, 12.0, 30)
    dithered = end_errors("induction_dtc", [(seed, 10.0) for seed in range(30)])
    rounded = end_errors("induction_dtc_s1", [(0, load) for load in loads])
    corrected = end_errors("induction_dtc_e1", [(0, load) for load in loads[::3]])
    rms = {k: math.sqrt((e**2).mean()) for k, e in (("d", dithered), ("r", rounded), ("c", corrected))}
    assert random_walk(1 / 3) == pytest.approx(1.09e-3, rel=1e-2)
    assert random_walk(1 / 12) == pytest.approx(5.45e-4, rel=1e-2)
    assert rms["d"] == pytest.approx(1.09e-3, rel=0.25)
    assert rms["r"] == pytest.approx(5.45e-4, rel=0.25)
    assert rms["d"] / rms["r"] == pytest.approx(2.0, abs=0.4)
    assert rms["c"] <= 6.5e-4
    assert dithered.max() <= 4.5e-3


@pytest.mark.long  # a test below checks the entries against the rules of the field
@pytest.mark.parametrize("size", [1.0, 1e-200, 1e200, 1e-320])
def test_the_largest_magnitude_is_that_of_all_phases(size):
    rng = np.random.default_rng(1)
    for spread in (1.0, 1e-15):
        psi = size * (1.0 + spread * rng.standard_normal(500)) * np.exp(2j * np.pi * rng.random(500))
        assert largest(psi.real, psi.imag) == np.abs(psi).max() > 0.0
    assert np.isnan(largest(np.array([1.0, np.nan]), np.zeros(2)))


def test_tables_give_the_same_states_with_fewer_transitions():
    printed, minimal = (recorded(load_scenario(n)) for n in ("induction_dtc_s0", "induction_dtc_s7"))
    for topic in ("joint_states", "flux_true", "flux_estimate", "currents_true", "torque_ref"):
        assert printed.recording.topics[topic].data == minimal.recording.topics[topic].data
    transitions = [leg_transitions(legs(s)) for s in (printed, minimal)]
    assert transitions[0] / transitions[1] == pytest.approx(1.27, abs=0.03)


def legs(signals):
    return np.column_stack([signals[f"switches/{leg}/effort"].x for leg in ("Sa", "Sb", "Sc")])


def independent(x, u, load, h, m):
    """The equations implemented again, as space vectors, by an adaptive solver over one interval of constant
    voltage.
    """

    def derivative(_, x):
        psi_s, psi_R = complex(x[0], x[1]), complex(x[2], x[3])
        i = (psi_s - psi_R) / m.L_sigma
        d_s = u - m.R_s * i
        d_R = m.R_R * i - (m.R_R / m.L_M - 1j * m.pole_pairs * x[4]) * psi_R
        torque = 1.5 * m.pole_pairs * (psi_s.conjugate() * i).imag
        return d_s.real, d_s.imag, d_R.real, d_R.imag, (torque - load - m.B * x[4]) / m.J, x[4]

    return solve_ivp(derivative, (0.0, h), x, method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]


@pytest.mark.long  # a golden bag checks the bytes of the plant daily
def test_recorded_switching_agrees_with_finer_steps_and_an_independent_solver():
    scenario = load_scenario("induction_dtc_s0")
    scenario = scenario.model_copy(update={"duration": 0.75})
    signals = recorded(scenario)
    switches = [tuple(row) for row in legs(signals).tolist()]
    loads = [0.0 if k * T_S < 0.6 - 1e-9 else 10.0 for k in range(len(switches))]
    states = []
    for substeps in (1, 10):
        plant = ByHand(ImPlant(substeps=substeps, adc_mode="none"))
        for k, (vector, load) in enumerate(zip(switches, loads, strict=True)):
            plant.advance(k, switches=vector, load_torque=(load,))
        states.append(np.array(plant.x[:STATES]))
    x = np.zeros(6)
    m = MachineConstants()
    for (vector, load), same in groupby(zip(switches, loads, strict=True)):
        x = independent(x, 540.0 * voltage(vector), load, T_S * len(list(same)), m)
    assert states[0][0] == signals["flux_true/x"].x[-1]
    for state in states:
        assert np.abs(state - x)[:2].max() < 1e-7
        assert abs(state - x)[4] < 1e-5
    assert np.abs(x[:4]).max() > 0.5
    assert x[4] == pytest.approx(100, abs=7)


def test_halving_the_step_divides_the_error_by_sixteen():
    ends = {}
    for substeps in (1, 2, 16):
        plant = ByHand(ImPlant(substeps=substeps, period=1e-3, adc_mode="none", trip_current=1e3))
        for k in range(20):
            plant.advance(k, switches=VECTORS[1 + k // 3 % 6], load_torque=None)
        ends[substeps] = np.array(plant.x[:STATES])
    coarse, fine = (np.abs(ends[n] - ends[16]).max() for n in (1, 2))
    assert coarse / fine == pytest.approx(16, rel=0.2)


def test_virtual_machine_gives_the_same_bits_as_compiled_code(monkeypatch):
    rig = rig_of("induction_dtc", duration=0.3)
    native = run_inprocess(rig, 1)["im_plant"]
    monkeypatch.setattr(compiled, "build", lambda function: None)
    assert run_inprocess(rig, 1)["im_plant"].x == native.x


def test_dither_depends_on_the_seed():
    runs = []
    for seed in (1, 1, 2):
        plant = ByHand(ImPlant(name="im_plant"))
        plant.reset(seed)
        runs.append([])
        for k in range(50):
            runs[-1].append(plant.outputs(k)["currents_meas"])
            plant.advance(k, switches=VECTORS[1], load_torque=None)
    assert runs[0] == runs[1] != runs[2]
    codes = np.array(runs[0])[0] / Q
    assert set(np.round(codes[:2], 9)) <= {0.0, 1.0}, "no current yet: nothing but the dither bits"
    assert any(a != b for a, b, _ in runs[0][:8]), "two converters, two streams"


def test_voltage_vectors_are_sixty_degrees_apart():
    for n, vector in enumerate(VECTORS[1:7]):
        assert voltage(vector) == pytest.approx(2 / 3 * np.exp(1j * np.pi / 3 * n), abs=1e-15)
    assert voltage(VECTORS[0]) == voltage(VECTORS[7]) == 0


@pytest.mark.parametrize("name", list(TABLES))
@pytest.mark.parametrize("n", range(1, 7))
def test_table_moves_flux_and_torque_the_right_way(name, n):
    direction = np.exp(1j * np.pi / 3 * (n - 1))
    for flux, torque in ((f, t) for f in (0, 1) for t in (-1, 0, 1)):
        vector = TABLES[name][flux][torque][n - 1]
        along, across = (z := voltage(VECTORS[vector]) / direction).real, z.imag
        if torque == 0:
            assert vector in (0, 7)
        else:
            assert np.sign(along) == (1 if flux else -1)
            assert np.sign(across) == torque
            zero = TABLES[name][flux][0][n - 1]
            toggled = sum(a != b for a, b in zip(VECTORS[vector], VECTORS[zero], strict=True))
            assert toggled == {"printed": 2, "minimal_switching": 1}[name]


def test_tables_are_as_printed():
    increase, decrease = TABLES["printed"][1], TABLES["printed"][0]
    assert increase == ((0, 7, 0, 7, 0, 7), (2, 3, 4, 5, 6, 1), (6, 1, 2, 3, 4, 5))
    assert decrease == ((7, 0, 7, 0, 7, 0), (3, 4, 5, 6, 1, 2), (5, 6, 1, 2, 3, 4))


def test_controller_reproduces_its_record():
    scenario = load_scenario("induction_dtc_short")
    signals = recorded(scenario)
    params = next(m.params for m in rig_of(scenario).members if m.name == "dtc_controller")
    controller = ByHand(DtcController(params, "another name"))
    currents = np.column_stack([signals[f"currents_meas/{c}"].x for c in "xyz"]).tolist()
    torque_ref = signals["torque_ref/shaft/effort"].x.tolist()
    for k, row in enumerate(legs(signals).tolist()):
        outputs = controller.update(
            k * 50_000, currents_meas=tuple(currents[k]), dc_link=(540.0,), torque_ref=(torque_ref[k // 20],)
        )
        assert outputs["switches"] == tuple(row)
        assert outputs["flux_estimate"][0] == signals["flux_estimate/x"].x[k]


def test_flux_error_is_drawn_as_a_difference(monkeypatch, tmp_path):
    scenario = load_scenario("induction_dtc_short", {"im_plant.adc_mode": "offset"})
    entry = next(p for p in load_scenario("induction_dtc").plots if p.title == "Flux error")
    rig = rig_of(scenario.model_copy(update={"plots": (entry,)}))
    signals = Signals(in_process(rig, 1))
    figures = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, *_: figures.append(figure))
    plots.plot_run(signals, rig, tmp_path)
    (axes,) = figures[0].axes
    assert axes.titles["y"] == "Flux error, Wb"
    for line, axis in zip(axes.lines, "xy", strict=True):
        expected = signals[f"flux_estimate/{axis}"].x - signals[f"flux_true/{axis}"].x[:-1]
        np.testing.assert_array_equal(line.get_ydata(), expected)
        assert expected[-1] > 0.004


# bad input


def test_periods_that_do_not_fit_are_refused():
    with pytest.raises(ScenarioError, match=r"speed_controller: period 0\.00103 s is not a multiple"):
        rig_of(load_scenario("induction_dtc", {"speed_controller.period": 0.00103}))


def test_seed_is_a_whole_number():
    raw = load_scenario("induction_dtc").model_dump() | {"seed": 1.5}
    with pytest.raises(ValueError, match="seed"):
        Scenario(**raw)


@pytest.mark.parametrize(
    ("names", "values", "text"),
    [
        (("Sa", "Sb"), (1.0, 0.0), "names"),
        (("Sa", "Sb", "Sb"), (1.0, 0.0, 0.0), "names"),
        (("Sa", "Sb", "Sc"), (1.0, math.nan, 0.0), "Sb/effort is nan"),
    ],
)
def test_malformed_switches_never_reach_the_plant(names, values, text):
    data = Layout(SWITCHES.msgtype, "", names, {"effort": len(values)}).encode(0, values)
    with pytest.raises(Refused, match=text):
        Decoder(SWITCHES)(data)


def test_switch_that_is_neither_0_nor_1_is_held_once_then_a_fault():
    plant = ByHand(ImPlant(adc_mode="none"))
    good, near, bad = VECTORS[1], (1.0 - 5e-10, 5e-10, 0.0), (1.0, 0.5, 0.0)
    twin = ByHand(ImPlant(adc_mode="none"))

    def advance(switches, same):
        plant.advance(0, switches=switches, load_torque=None)
        twin.advance(0, switches=same, load_torque=None)
        assert plant.x[:STATES] == twin.x[:STATES]

    for switches in (good, near, bad, good, bad):
        advance(switches, good)
    assert plant.reports["bad_switches"][0] == Level.ERROR
    assert not plant.x.fault
    advance(bad, VECTORS[0])
    assert plant.reports["switch_fault"][0] == Level.ERROR
    advance(good, VECTORS[0])  # a fault stays until the reset
    plant.reset(0)
    assert not plant.x.fault
    assert plant.reports == {}


def test_overcurrent_trips_permanently():
    plant = ByHand(ImPlant())
    while not plant.x.fault:
        plant.advance(0, switches=VECTORS[1], load_torque=None)
    assert 28.0 < plant.outputs(0)["currents_true"][0] < 30.0
    for _ in range(4000):
        plant.advance(0, switches=VECTORS[1], load_torque=None)
    assert abs(plant.outputs(0)["currents_true"][0]) < 5.0
    assert plant.reports["overcurrent"][0] == Level.ERROR
    assert plant.reports["overcurrent"][2] == 1


@pytest.mark.long  # runs in a container daily
@pytest.mark.processes
def test_the_same_bits_over_topics(tmp_path):
    scenario = load_scenario("induction_dtc_short")
    run = execute(checked(scenario), Placement(), tmp_path)
    assert run.error == ""
    assert differences(in_process(rig_of(scenario), scenario.seed), run.recording) == []
