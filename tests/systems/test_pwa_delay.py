"""Piecewise affine systems with delay: certificates, their checks, simulated margins, nodes, bad input."""

import functools
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import few
from pages import generated as pages
from softrig_core import (
    ByHand,
    Jobs,
    Level,
    Result,
    Rig,
    RunError,
    ScenarioError,
    list_scenarios,
    load_scenario,
    rig_of,
    simulate,
)
from softrig_core.kit.dde import trajectory
from softrig_core.verdict.findings import findings, values
from softrig_systems.pwa_delay import search
from softrig_systems.pwa_delay.certificate import CertificateNode, CriterionParams
from softrig_systems.pwa_delay.controllers import DelayLine, PendulumController, TankController
from softrig_systems.pwa_delay.lyapunov import LyapunovMonitor
from softrig_systems.pwa_delay.motion import FREE, PendulumConstants, TankConstants, constants, run_pendulum, run_tank
from softrig_systems.pwa_delay.params import BENCHMARK
from softrig_systems.pwa_delay.plants import PendulumPlant, SwitchedDelayPlant, TankPlant
from softrig_systems.pwa_delay.profiles import profile
from softrig_systems.pwa_delay.proof.applicability import NotApplicable, require_no_sliding
from softrig_systems.pwa_delay.proof.bessel_legendre import bessel_legendre
from softrig_systems.pwa_delay.proof.certify import Criterion, certified_margin, certify
from softrig_systems.pwa_delay.proof.level import level_bound, level_margin
from softrig_systems.pwa_delay.proof.lmi import Problem
from softrig_systems.pwa_delay.proof.theorem1 import theorem1
from softrig_systems.pwa_delay.search import (
    find_margin,
    growth_rate,
    pwa_margin,
    run_of,
    simulate_pwa,
)
from softrig_systems.pwa_delay.system import (
    TANK_C,
    PwaSystem,
    continuous_tank,
    from_lines,
    linear,
    pendulum,
    switched,
    tank,
)

NAMES = sorted(n for n in list_scenarios() if n.startswith("pwa_delay"))
EXACT = 6.17258  # delay margin of the linear benchmark


@functools.cache
def margin(name, low, high, mu=0.0, cell_terms=False, order=0, width=1e-4):
    system = {
        "switched": switched,
        "pendulum": pendulum,
        "tank": continuous_tank,
        "benchmark": lambda: linear(*BENCHMARK),
        "scalar": lambda: linear(0.0, -1.0),
    }[name]()
    criterion = Criterion("constant" if order else "theorem1", mu, order or 2, cell_terms)
    certificate = certified_margin(system, criterion, low=low, high=high, width=width)
    assert certificate.valid
    assert all(e.positive for e in certificate.eigenvalues)  # checks C4 for every certificate of this file
    return certificate.h


@functools.cache
def run(name):
    return simulate(name)


# C1, C2, C3, C5: certified margins


@pytest.mark.long
def test_theorem_1_on_the_switched_system():
    assert 0.01925 <= margin("switched", 0.0190, 0.0196) <= 0.01930
    assert round(margin("switched", 0.0190, 0.0196), 4) >= 0.0193


TABLE = [
    ("switched", 0.1, False, 0.01824, 5e-5), ("switched", 0.3, False, 0.01728, 5e-5),
    ("switched", 0.5, False, 0.01691, 5e-5), ("switched", 0.9, False, 0.01671, 5e-5),
    ("switched", 0.0, True, 0.019283, 5e-5),
    ("pendulum", 0.0, False, 0.2630, 0.0026), ("pendulum", 0.1, False, 0.2580, 0.0026),
    ("pendulum", 0.3, False, 0.2451, 0.0025), ("pendulum", 0.5, False, 0.2370, 0.0024),
    ("pendulum", 0.9, False, 0.2288, 0.0023), ("pendulum", 0.1, True, 0.2600, 0.0026),
    ("pendulum", 0.3, True, 0.2471, 0.0025), ("pendulum", 0.5, True, 0.2395, 0.0024),
    ("pendulum", 0.9, True, 0.2308, 0.0023),
    ("tank", 0.0, False, 7.849, 0.039), ("tank", 0.1, False, 7.576, 0.038), ("tank", 0.3, False, 7.154, 0.036),
    ("tank", 0.6, False, 6.951, 0.035), ("tank", 0.0, True, 7.849, 0.039), ("tank", 0.1, True, 7.713, 0.039),
    ("tank", 0.3, True, 7.535, 0.038), ("tank", 0.6, True, 7.31, 0.037),
    ("benchmark", 0.0, False, 6.058, 0.006), ("benchmark", 0.1, False, 4.816, 0.005),
    ("benchmark", 0.5, False, 3.082, 0.003), ("benchmark", 0.8, False, 2.673, 0.003),
    ("scalar", 0.0, False, 1.567, 0.001), ("scalar", 0.1, False, 1.513, 0.001), ("scalar", 0.3, False, 1.429, 0.001),
    ("scalar", 0.6, False, 1.389, 0.001),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "mu", "cell_terms", "expected", "tolerance"),
    [pytest.param(*row, marks=[pytest.mark.long] * (row[:3] != ("scalar", 0.3, False))) for row in TABLE],
)
def test_theorem_1_table(name, mu, cell_terms, expected, tolerance):
    result = margin(name, 0.98 * expected, 1.02 * expected, mu, cell_terms)
    assert result == pytest.approx(expected, abs=tolerance)


@pytest.mark.long
def test_cells_by_both_instants_certify_a_little_more():
    """The stretch: 16 cells by x and x_d; test_pwa_exact.py certifies 0.0195 with N = 5."""
    tall, wide = [[0.0, 5.0], [-1.0, 0.0]], [[0.0, 1.0], [-5.0, 0.0]]
    lines = [[1.0, -1.0], [1.0, 1.0]]
    system = from_lines([-0.1 * np.eye(2)] * 16, [m for m in (tall, wide, wide, tall) for _ in range(4)], lines, lines)
    assert certify(system, 0.01949, Criterion("constant", order=3, cell_terms=True)).valid
    assert not certify(switched(), 0.01949, Criterion("constant", order=3, cell_terms=True)).valid
    assert certify(system, 0.01951, Criterion("constant", order=4, cell_terms=True)).t < 0.0


@pytest.mark.long
def test_theorem_1_on_the_pendulum_with_cell_terms():
    assert margin("pendulum", 0.262, 0.27) >= 0.262
    assert 0.265 <= margin("pendulum", 0.262, 0.27, 0.0, True) <= 0.4192


@pytest.mark.parametrize(
    ("name", "order", "cell_terms", "low", "high", "least", "most"),
    few(
        [
            pytest.param("switched", 2, False, 0.0193, 0.0196, 0.01940, 0.020005, marks=pytest.mark.long),
            pytest.param("pendulum", 2, True, 0.26, 0.27, 0.2655, 0.4192, marks=pytest.mark.long),
            pytest.param("switched", 1, False, 0.019, 0.020, 0.01936, 0.01938, marks=pytest.mark.long),
            pytest.param("switched", 3, False, 0.019, 0.020, 0.01942, 0.01944, marks=pytest.mark.long),
            pytest.param("pendulum", 1, True, 0.26, 0.27, 0.2655, 0.2660, marks=pytest.mark.long),
            pytest.param("pendulum", 3, True, 0.26, 0.27, 0.2657, 0.26617, marks=pytest.mark.long),
            ("tank", 2, False, 7.5, 8.2, 7.82, 7.90),
            ("benchmark", 1, False, 6.0, 6.1, 6.0583, 6.0593),
            ("benchmark", 2, False, 6.1, 6.2, 6.1677, 6.1697),
        ],
        1,
    ),
)
def test_constant_delay_criterion(name, order, cell_terms, low, high, least, most):
    assert least <= margin(name, low, high, 0.0, cell_terms, order) <= most


@pytest.mark.long
def test_constant_delay_criterion_approaches_the_exact_margin_from_below():
    result = margin("benchmark", 6.17, 6.18, order=3, width=1e-6)
    assert result == pytest.approx(6.172, abs=0.001)
    assert result < EXACT + 1e-5


def test_the_exact_margin_of_the_benchmark():
    """s = i w: only the second state, -0.9 - exp(-s h) = s, decides."""
    w = math.sqrt(1.0 - 0.81)
    assert (math.pi - math.atan2(w, 0.9)) / w == pytest.approx(EXACT, abs=2e-5)


@pytest.mark.parametrize(("make", "h"), few([(switched, 0.0201), (lambda: linear(*BENCHMARK), 6.2)], 2))
@pytest.mark.parametrize("method", ["theorem1", "constant"])
def test_no_certificate_beyond_the_true_margin(make, h, method):
    assert not certify(make(), h, Criterion(method, order=3)).valid


# Unstable for delays from 0.81677 to 1.735 s.
OSCILLATOR = linear([[0.0, 1.0], [-4.0, -0.8]], [[0.0, 0.0], [-1.5, -0.6]])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_no_constant_delay_is_certified_for_a_growing_system(order):
    criterion = Criterion("constant", order=order)
    for A, Ad in ((0.5, 0.2), (1.0, 0.0), (-1.0, 2.0), (0.1, 0.1), (0.0, 0.5), (-0.2, 0.3)):
        assert not certify(linear(A, Ad), 0.1, criterion).valid
        assert not certify(linear(A, Ad), 0.1, criterion, shortest=0.0).valid
    for h in (0.817, 0.83, 1.2, 1.7):
        assert not certify(OSCILLATOR, h, criterion).valid


@pytest.mark.parametrize(
    ("k", "cell_terms", "valid", "not_valid"), few([(3.0, False, 0.379, 0.381), (3.0, True, 0.387, 0.389)], 1)
)
def test_constant_delay_of_a_pendulum_with_a_weaker_gain(k, cell_terms, valid, not_valid):
    criterion = Criterion("constant", cell_terms=cell_terms)
    assert certify(pendulum(1.0, k), valid, criterion).valid
    assert not certify(pendulum(1.0, k), not_valid, criterion).valid


def test_windows_of_the_oscillator():
    """s = i w on s^2 + 0.8 s + 4 + (0.6 s + 1.5) exp(-s h): from 0.81677 s to 1.735 s a pair is in the right half-
    plane.
    """
    delays = []
    for w in np.sqrt(np.roots([1.0, -8.0 + 0.64 - 0.36, 16.0 - 2.25])).tolist():
        turned = -(0.6j * w + 1.5) / (4.0 - w * w + 0.8j * w)
        delays.append(math.atan2(turned.imag, turned.real) % (2.0 * math.pi) / w)
    assert sorted(delays) == pytest.approx([0.81677, 1.735], rel=2e-4)


@pytest.mark.long
def test_the_search_of_constant_delays_ends_with_the_first_window():
    """A second window ends at 3.4576 s, and a bracket of 0.05 to 3 s finds both."""
    criterion = Criterion("constant")
    again = Criterion("constant", order=3)
    assert certify(OSCILLATOR, 3.4, again).valid
    assert certify(OSCILLATOR, 3.4, again).shortest == 3.4
    tried = []
    certificate = certified_margin(OSCILLATOR, criterion, low=0.05, high=3.0, width=1e-2, tell=tried.append)
    assert 0.808 < certificate.h < 0.81677
    assert certificate.shortest == 0.0
    # The steps cover all delays, and each has matrices that satisfy the inequalities at both ends and between.
    steps, covered = [c for c in tried if c.valid], 0.0
    for step in steps:
        assert step.shortest <= covered < step.h
        covered = step.h
        for share in (0.0, 0.3, 0.7):
            d = step.shortest + share * (step.h - step.shortest)
            if step.shortest > 0.0:
                again = bessel_legendre(OSCILLATOR.scaled(d), 2).eigenvalues(step.matrices)
                assert all(e.positive for e in again), (step.shortest, d)
    assert covered == certificate.h
    # For delays beyond the first window: the search starts at `low` if nothing is certified from 0 on.
    late = linear([[0.0, 1.0], [-2.0, 0.1]], [[0.0, 0.0], [1.0, 0.0]])
    assert certified_margin(late, criterion) is None  # `low` is not set, so the search starts at 0
    late = certified_margin(late, criterion, low=1.0, width=0.1)
    assert late.shortest == 1.0
    assert certified_margin(linear(0.5, 0.2), criterion, low=0.1) is None
    with pytest.raises(ValueError, match=r"shortest = 2.0: expected from 0 to h = 1.0"):
        certify(OSCILLATOR, 1.0, criterion, shortest=2.0)


def test_a_delay_of_microseconds_is_certified_as_one_of_seconds():
    """Time has no scale of its own: x' = -x(t - h)/h is the same system in t/h."""
    for h in (1e-6, 1e-3, 9e-3, 1.0):
        for method in ("theorem1", "constant"):
            assert certify(linear(0.0, -1.0 / h), h, Criterion(method)).valid
            assert not certify(linear(0.0, -1.6 / h), h, Criterion(method)).valid
    for h in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="expected a positive time"):
            certify(linear(0.0, -1.0), h)


def test_the_node_reports_which_delays_its_certificate_covers():
    own = {"system": "user", "n": 1, "A": [0.0], "Ad": [-1.0], "method": "constant"}
    for asked, text in (
        ({"h": 1.5}, "a constant delay of 1.5 s alone, no shorter one"),
        ({"low": 1.0, "width": 0.1}, r"delays from 0 s to 1\.[45]\d* s, without a gap"),
        ({"h": 1.5, "method": "theorem1"}, "delays from 0 s to 1.5 s, without a gap"),
        ({"h": 1.6}, "nothing"),
    ):
        node = CertificateNode(**{**own, **asked})
        x, request = node.request(node.first(), 0)
        answer = CertificateNode.solve(request, SimpleNamespace(status=lambda **_: None))
        x = x._replace(jobs=Jobs(result=Result(0, request, answer, True)))
        assert re.fullmatch(text, node.health(x)["covers"])


def test_a_damaged_certificate_fails_its_check():
    certificate = certify(switched(), 0.0185)
    assert certificate.valid
    problem = theorem1(switched().scaled(0.0185), 0.0)
    assert all(e.positive for e in problem.eigenvalues(certificate.matrices))
    for name in ("R", "L1", "H0"):
        broken = {**certificate.matrices, name: -certificate.matrices[name]}
        assert not all(e.positive for e in problem.eigenvalues(broken)), name
    # The matrices of one delay do not certify another one far beyond it.
    assert not all(e.positive for e in theorem1(switched().scaled(0.0300), 0.0).eigenvalues(certificate.matrices))


@pytest.mark.parametrize(("least", "reported"), [(0.0, []), (-1e-12, ["entries of X"])])
def test_an_entry_of_zero_is_not_a_negative_one(least, reported):
    problem = Problem()
    problem.symmetric("X", 2, positive=True)
    assert [e.name for e in problem.eigenvalues({"X": np.array([[1.0, least], [least, 1.0]])})] == reported


@pytest.mark.parametrize("level", [0.25, 0.75])
def test_the_two_slopes_of_the_drain_touch_the_root(level):
    """Each is its tangent in the middle of its range: the paper's four numbers, of five digits."""

    def falls(model, x0):
        plant = ByHand(TankPlant(model=model, x0=x0, delay=0.0, k_low=0.0, k_high=0.0))
        plant.advance(0, inflow=(0.0,))
        return x0 - plant.x.x

    for x0, far in ((level, 5e-5), (level + 0.01, 5e-4), (level - 0.01, 5e-4)):
        assert falls("pwa", x0) == pytest.approx(falls("nonlinear", x0), rel=far)


def test_level_of_the_tank():
    assert level_margin() == pytest.approx(5.9716, abs=0.001)
    for h, lowest in ((2.0, 0.3846), (4.0, 0.2251), (5.0, 0.1212)):
        assert level_bound(h).lowest == pytest.approx(lowest, abs=1e-4)
    assert level_bound(5.97).certified
    assert not level_bound(5.98).certified


@pytest.mark.parametrize("seed", range(6))
def test_no_delay_empties_the_tank_below_its_certified_level(seed):
    """Adversarial: the delay jumps between zero and its maximum, in the tank's own loop, from the highest level."""
    h = 5.97
    bound = level_bound(h)
    plant = ByHand(
        TankPlant(delay=h, profile="telegraph", seed=seed, x0=min(bound.highest, 0.99), period=0.05, step=0.05)
    )
    controller, lowest = ByHand(TankController(period=0.05)), 1.0
    for k in range(4000):
        level = plant.outputs(k)["level"]
        lowest = min(lowest, level[0])
        plant.advance(k, inflow=controller.update(k, level=level)["inflow"])
    assert bound.lowest - 1e-3 <= lowest < 0.5


# A changed parameter of the tank or its law; all others are in FREE_OF_THE_LEVEL.
TANKS = {
    "tank_controller.switch": 0.7,
    "tank_controller.k_low": 0.1,
    "tank_controller.k_high": 0.15,
    "tank_plant.c": 0.02,
    "tank_controller.A": 20.0,
    "tank_controller.phi": 500.0,
    "tank_plant.x0": 1.5,
}
REFUSED_OF_THE_LEVEL = {"tank_plant.model": "pwa", "tank_plant.A": 20.0, "tank_plant.phi": 500.0,
                        "tank_plant.switch": 0.7, "tank_plant.k_low": 0.1, "tank_plant.k_high": 0.15}  # fmt: skip
FREE_OF_THE_LEVEL = {  # the bound holds for all delays up to h; the others only affect how a run is computed
    "tank_plant.delay",
    "tank_plant.max_delay",
    "tank_plant.profile",
    "tank_plant.mu",
    "tank_plant.seed",
    "tank_plant.horizon",
    "tank_plant.period",
    "tank_plant.step",
    "tank_controller.period",
}


def test_every_parameter_of_the_tank_is_compared_with_its_certificate():
    nodes = {"tank_plant": TankPlant, "tank_controller": TankController}
    fields = {f"{node}.{name}" for node, block in nodes.items() for name in block.Params.model_fields}
    assert fields == {*TANKS, *REFUSED_OF_THE_LEVEL, *FREE_OF_THE_LEVEL}


@pytest.mark.long
@pytest.mark.parametrize(
    ("parameter", "value"),
    [pytest.param(*row, marks=[pytest.mark.long] * (row[0] != "tank_controller.k_high")) for row in TANKS.items()],
)
def test_a_level_certificate_belongs_to_the_tank_and_the_controller_of_the_rig(parameter, value):
    """With each changed value the tank does not run empty, however the delay jumps below the certified one."""
    rig = rig_of(load_scenario("pwa_delay_p2", {parameter: value}))
    asked = next(m.params for m in rig.members if m.name == "certificate")
    h = CertificateNode.solve(asked, None).certificate.h
    assert h == pytest.approx(level_margin(**asked.tank))
    assert (abs(h - 5.9716) > 1e-3) == (parameter.split(".")[1] not in ("A", "phi"))
    for profile_of in ("constant", "telegraph"):
        changes = {parameter: value, "tank_plant.delay": h - 0.01, "tank_plant.profile": profile_of}
        result = simulate("pwa_delay_p2", overrides=changes, duration=20.0 * h)
        assert (result.figures["h"], result.figures["covered"]) == (h, 1.0)
        assert result.figures["lowest_level"] >= level_bound(h, **asked.tank).lowest - 1e-6


def test_a_certificate_does_not_cover_a_tank_that_runs_dry():
    """The shipped one: valid, h = 5.9716 beside a dry tank."""
    result = simulate("pwa_delay_p2", overrides={"tank_plant.delay": 5.9, "tank_controller.k_high": 0.15}).figures
    assert result["lowest_level"] == 0.0
    assert result["h"] == pytest.approx(4.2645, abs=1e-4)
    assert result["covered"] == 0.0


@pytest.mark.parametrize(("parameter", "value"), REFUSED_OF_THE_LEVEL.items())
def test_certificate_of_another_tank_is_refused_by_name(parameter, value):
    with pytest.raises(ScenarioError, match=r"must agree on tank/.*but tank_plant has "):
        rig_of(load_scenario("pwa_delay_p2", {parameter: value}))


def test_no_level_is_certified_if_the_drain_outweighs_the_inflow():
    for tank_of in ({"c": 0.2}, {"kL": 0.0}, {"s": 0.0}):
        assert level_margin(**tank_of) == 0.0
        assert not level_bound(1e3, **tank_of).certified
    answer = CertificateNode.solve(CertificateNode.Params(system="tank", method="level", c=0.2), None)
    assert (answer.certificate.valid, answer.reason) == (False, "no certificate: the tank may run empty")


@pytest.mark.parametrize(
    ("scenario", "changes", "quantity"),
    [
        ("pwa_delay", {"certificate.system": "benchmark"}, "pwa/system"),
        ("pwa_delay", {"certificate.mu": 0.5}, "certificate/mu"),
        ("pwa_delay_margin_user", {"switched_delay_plant.Ad": [-1.0, 0.0, -1.0, -2.0]}, "pwa/Ad"),
        ("pwa_delay_margin_scalar", {"margin_search.A": [0.1]}, "pwa/A"),
        ("pwa_delay_p2c", {"switched_delay_plant.system": "scalar"}, "pwa/system"),
    ],
)
def test_certificate_of_another_system_is_refused_by_name(scenario, changes, quantity):
    with pytest.raises(ScenarioError, match=f"must agree on {quantity}"):
        rig_of(load_scenario(scenario, changes))


def test_a_certificate_of_the_pendulum_belongs_to_its_gains():
    """With a weaker gain on the right the margin differs, and the simulated motion agrees."""
    weak = CriterionParams(system="pendulum", k_positive=2.0, cell_terms=True).build()
    certificate = certify(weak, 0.45, Criterion("constant", order=2, cell_terms=True))
    assert certificate.valid
    assert not certify(pendulum(), 0.45, Criterion("constant", order=2, cell_terms=True)).valid
    assert growth_rate(simulate_pwa(weak, profile("constant", 0.45), (1.0, 0.0), 200.0)) < 0.0
    assert growth_rate(simulate_pwa(pendulum(), profile("constant", 0.45), (1.0, 0.0), 200.0)) > 0.0
    nodes = {"pendulum_plant": PendulumPlant(model="nonlinear"), "certificate": CertificateNode(system="pendulum")}
    with pytest.raises(ScenarioError, match="must agree on pendulum/model"):
        Rig.from_blocks(
            {**nodes, "pendulum_controller": PendulumController()},
            1.0,
            remap={"pendulum_controller": {"pendulum/delayed_state": "pendulum/state"}},
        )


# C6: simulated margins


@pytest.mark.long
def test_margin_of_the_switched_system():
    result = pwa_margin(switched(), 0.0195, 0.021, (-2.0, 0.0), 60.0)
    assert result.h == pytest.approx(0.020005, abs=3e-5)


@pytest.mark.parametrize(
    ("h", "rate"), [(0.0193, -0.00351), (0.020, -2.5e-5), (0.0205, 0.00246), (0.021, 0.00494), (0.022, 0.0099)]
)
def test_growth_of_the_switched_system(h, rate):
    result = growth_rate(simulate_pwa(switched(), profile("constant", h), (-2.0, 0.0), 60.0, steps=25))
    assert result == pytest.approx(rate, abs=6e-5)


def test_the_margin_by_simulation_is_the_first():
    """Stable again at 1.8 s, and unstable from 3.47 s on: a bracket of 0.3 to 4 s contains both ends."""
    result = pwa_margin(OSCILLATOR, 0.3, 4.0, (1.0, 0.0), 150.0, steps=40, width=1e-3)
    assert result.h == pytest.approx(0.81677, abs=2e-3)
    assert result.low <= result.h <= result.high < 1.3


def test_located_switches_converge_and_unlocated_do_not():
    ends = [simulate_pwa(switched(), profile("constant", 0.02), (-2.0, 0.0), 2.0, steps=n).x for n in (50, 200)]
    assert ends[0] == pytest.approx(ends[1], abs=1e-6)
    # From 6400 steps without event location, accurate to 1e-5.
    assert ends[1] == pytest.approx([1.9811344, 0.1155911], abs=2e-5)
    assert ends[1] == pytest.approx([1.98112413, 0.11559048], abs=3e-7)  # from 25,600 steps without event location
    from softrig_core.kit.dde import integrator
    from softrig_systems.pwa_delay.motion import pwa_slopes

    free, x = constants(switched(), profile("constant", 0.02)), np.array([-2.0, 0.0])
    integrator(pwa_slopes)(trajectory(1e-4, 0.021, (-2.0, 0.0)), 0.0, x, 1e-4, 20000, free)
    assert 1e-5 < abs(x[0] - ends[1][0]) < 4e-4


@pytest.mark.parametrize("sine", [False, pytest.param(True, marks=pytest.mark.long)])
def test_margin_of_the_pendulum(sine):
    if sine:
        p = {h: PendulumConstants(1.0, 1.0, np.array([FREE]), profile("constant", h)) for h in (0.40, 0.42)}
        runs = [search._run(run_pendulum, c, [1.0, 0.0, 0.0], h, 400.0, 100) for h, c in p.items()]
        rates = [growth_rate(run) for run in runs]
        assert rates[0] < -0.01 < rates[1]  # beyond 0.4149 the amplitude stays constant, as sin bounds it
        return
    result = pwa_margin(pendulum(), 0.40, 0.43, (1.0, 0.0), 200.0, width=1e-4)
    assert result.h == pytest.approx(0.4192, abs=0.001)


@pytest.mark.long
def test_margin_of_the_pendulum_by_growth():
    result = pwa_margin(pendulum(), 0.417, 0.421, (1.0, 0.0), 3200.0, width=1e-7)
    assert result.h == pytest.approx(0.4192648, abs=1e-6)  # approaches 0.4192653 for longer runs


def test_margins_of_linear_systems_are_exact():
    # The published matrices; the margin depends only on the second state.
    assert BENCHMARK == ([[-2.0, 0.0], [0.0, -0.9]], [[-1.0, 0.0], [-1.0, -1.0]])
    result = pwa_margin(linear(*BENCHMARK), 6.0, 6.4, (1.0, 1.0), 1500.0, width=1e-4)
    assert result.h == pytest.approx(EXACT, abs=2e-4)
    assert pwa_margin(linear(0.0, -1.0), 1.5, 1.65, (1.0,), 400.0).h == pytest.approx(math.pi / 2.0, abs=1e-5)
    assert pwa_margin(continuous_tank(), 11.0, 12.0, (1.0,), 3000.0, width=1e-3).h == pytest.approx(11.49, abs=0.005)


def simulate_tank(h, level, duration, steps=400, pwa=False):
    """P2 under its own law with a constant delay, from a constant level."""
    p = TankConstants(TANK_C, 0.5, 0.2, 0.1, 1.0, float(pwa), np.array([FREE]), profile("constant", h))
    return run_of(run_tank, p, [level, 0.0], h, duration, steps)


@pytest.mark.long
@pytest.mark.parametrize(("level", "pwa", "h"), [(0.2, False, 6.531), (0.2, True, 6.5303), (1.0, False, 6.219)])
def test_delay_at_which_the_tank_runs_empty(level, pwa, h):
    for delay, runs_dry in ((h - 0.005, False), (h + 0.005, True)):
        run = simulate_tank(delay, level, 30.0 * delay, steps=4000, pwa=pwa)
        assert (np.min(run.sizes) <= 1e-5) == runs_dry


@pytest.mark.parametrize(
    ("h", "low", "high"), [(2.0, 0.386, 0.671), (4.0, 0.241, 0.790), (5.0, 0.149, 0.890), (6.0, 0.052, 0.954)]
)
def test_limit_cycles_of_the_tank(h, low, high):
    result = simulate_tank(h, 0.2, 60.0 * h)
    late = result.sizes[result.sizes.size // 2 :]
    assert late.min() == pytest.approx(low, abs=0.003)
    assert late.max() == pytest.approx(high, abs=0.003)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_motion_agrees_with_an_adaptive_solver_of_delay_equations(tmp_path, monkeypatch):
    """The scalar system and the benchmark, which have no switches to smooth."""
    monkeypatch.chdir(tmp_path)
    module = pytest.importorskip("jitcdde")
    for system, h, x0 in ((linear(0.0, -1.0), 1.5, [1.0]), (linear(*BENCHMARK), 6.0, [1.0, 1.0])):
        A, Ad, n = system.A[0], system.Ad[0], system.n
        slopes = [sum(A[i, j] * module.y(j) + Ad[i, j] * module.y(j, module.t - h) for j in range(n)) for i in range(n)]
        solver = module.jitcdde(slopes, verbose=False)
        solver.constant_past(x0)
        solver.set_integration_parameters(rtol=1e-9, atol=1e-10)
        solver.step_on_discontinuities()
        exact = solver.integrate(5.0 * h)
        result = simulate_pwa(system, profile("constant", h), x0, 5.0 * h, steps=200)
        assert result.x == pytest.approx(exact, abs=1e-6)


# C7: over topics; C8


# The rigless test above judges the certified margin; the tank under other delays differs only in numbers.
SLOW = {f"pwa_delay_{n}" for n in (
    "growth_pendulum", "margin", "margin_certified", "margin_constant", "margin_scalar", "margin_user", "p2_d4",
    "p2_sine", "p2_telegraph", "p2c_constant", "p3", "p3_nonlinear", "p3_sine", "p3_unstable", "hayes", "hayes_beyond",
)}  # fmt: skip


@pytest.mark.parametrize("name", few([pytest.param(n, marks=[pytest.mark.long] * (n in SLOW)) for n in NAMES], 2))
def test_figures_of_the_scenarios(name):
    assert [f"{r.name} = {r.value}" for r in run(name).missed] == []


@pytest.mark.parametrize(
    ("system", "x0", "stable", "unstable", "mu", "seconds"),
    few(
        [
            pytest.param("switched", (-2.0, 0.0), 0.0192, 1.03 * 0.020005, 0.0, 60.0, marks=pytest.mark.long),
            ("switched", (-2.0, 0.0), 0.01728, 1.03 * 0.020005, 0.3, 60.0),
            ("continuous_tank", (0.3,), 7.84, 1.03 * 11.49, 0.0, 1000.0),
            ("continuous_tank", (0.3,), 7.5, 1.03 * 11.49, 0.3, 1000.0),
            ("pendulum", (1.0, 0.0), 0.2657, 1.03 * 0.4192, 0.0, 60.0),
            ("pendulum", (1.0, 0.0), 0.2451, 1.03 * 0.4192, 0.3, 60.0),
        ],
        2,
    ),
)
def test_plants_fall_at_the_certified_delay_and_grow_beyond_their_margin(system, x0, stable, unstable, mu, seconds):
    def sizes(delay, kind):
        plant = ByHand(
            SwitchedDelayPlant(
                system=system, x0=x0, delay=delay, period=delay / 2.0, step=delay / 50.0, profile=kind, mu=mu
            )
        )
        results = []
        for k in range(round(seconds / plant.params.period)):
            plant.advance(k)
            results.append(max(map(abs, plant.outputs(k)["state"])))
        quarters = np.array_split(np.array(results), 4)
        return quarters[1].max(), quarters[3].max()

    before, after = sizes(stable, "sine" if mu else "constant")
    assert after < 0.95 * before
    before, after = sizes(unstable, "constant")
    assert after > 1.03 * before


@pytest.mark.long
def test_functional_falls_along_the_certified_trajectory_and_rises_beyond():
    assert run("pwa_delay").figures["largest_rise"] < 7e-4
    warned = run("pwa_delay_beyond").blocks["lyapunov_monitor"]
    assert warned.reports["rises"][0] is Level.WARN
    assert "rises" not in run("pwa_delay").blocks["lyapunov_monitor"].reports


@pytest.mark.long
def test_a_finer_monitor_sees_a_smoother_fall():
    result = simulate("pwa_delay", overrides={"switched_delay_plant.period": 1e-4, "lyapunov_monitor.period": 1e-4})
    assert result.figures["largest_rise"] == 0.0
    assert result.figures["fall"] == pytest.approx(1.5e-4, abs=0.3e-4)


def test_asymptotic_stability_of_the_tank_is_refused():
    with pytest.raises(NotApplicable, match=r"no equilibrium: the offset .* of cell 0"):
        certify(tank(), 1.0)
    with pytest.raises(NotApplicable, match="no equilibrium"):
        certified_margin(tank())
    with pytest.raises(NotApplicable, match=r"sliding on the face .* of cells 0 and 1"):
        require_no_sliding(tank(), 1.0)
    assert (
        "not applicable: no equilibrium"
        in run("pwa_delay_margin_tank_refused").blocks["certificate"].reports["no_certificate"][1]
    )


def test_sliding_is_found_and_crossing_is_not():
    into = from_lines([[[0.0, 1.0], [0.0, 0.0]]] * 2, [[[-1.0, 0.0], [0.0, -1.0]]] * 2, [[1.0, 0.0]])
    require_no_sliding(into, 0.1)
    slides = from_lines([np.zeros((2, 2))] * 2, [[[0.0, 1.0], [-1.0, 0.0]], [[0.0, -1.0], [-1.0, 0.0]]], [[1.0, 0.0]])
    with pytest.raises(NotApplicable, match="on the face"):
        certify(slides, 0.1)
    require_no_sliding(switched(), 0.02)
    along = from_lines([np.zeros((2, 2))] * 2, [[[0.0, 0.0], [-1.0, 0.0]]] * 2, [[1.0, 0.0]])
    require_no_sliding(along, 0.1)  # the motion is parallel to the face


def test_an_offset_that_a_shift_removes_is_accepted():
    shifted = PwaSystem((np.array([[-2.0]]),), (np.array([[-1.0]]),), (np.array([3.0]),), (np.zeros((0, 2)),),
                        (np.zeros(0),), (np.eye(2),), np.zeros((0, 1)), np.zeros((0, 1)))  # fmt: skip
    assert certify(shifted, 1.0).valid


@pytest.mark.long
def test_verdicts_on_the_paper_hold():
    def measured(name):
        return values(run(name).results)

    names = [n for n in NAMES if n not in SLOW]
    results = [f for n in names for f in findings(run(n).rig.scenario, measured, {})]
    assert [f"{f.scenario}.{f.key}: {f.false}" for f in results if f.holds is not True] == []
    assert {f.verdict for f in results} == {"reproduced", "refuted"}


@pytest.mark.long
@pytest.mark.parametrize("name", ["pwa_delay_margin", "pwa_delay_p3"])
def test_verdicts_of_long_scenarios_hold(name):
    result = findings(run(name).rig.scenario, lambda other: values(run(other).results), {})
    assert result
    assert all(f.holds for f in result)


@pytest.mark.parametrize("page", ["pwa_delay.md", "tcp_aqm.md"])
def test_generated_parts_of_the_pages_are_as_the_code_says(page):
    text = (Path(__file__).parents[2] / "ros_pkgs/softrig_systems/doc" / page).read_text()
    assert pages.generate(text) == text


# Bad input


def cells(**changes):
    s = switched()
    parts = {k: getattr(s, k) for k in ("A", "Ad", "a", "E", "e", "F", "lines", "lines_delayed")} | changes
    return PwaSystem(**parts)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_faces_of_cells_do_not_depend_on_the_scaling_of_inequalities(scale):
    """Three strips, the middle one 0.5 wide: a face is between two neighbours, and no check skips a strip."""
    three = tuple(np.eye(2) for _ in range(3))
    E = ([[-1.0, 0.0]], [[1.0, 0.0], [-1.0, 0.0]], [[1.0, 0.0]])
    strips = cells(A=tuple(-np.eye(1) for _ in range(3)), Ad=tuple(np.zeros((1, 1)) for _ in range(3)),
                   a=tuple(np.zeros(1) for _ in range(3)), E=tuple(scale * np.array(rows) for rows in E),
                   e=tuple(scale * np.array(offsets) for offsets in ([-0.25], [0.25, 0.25], [-0.25])), F=three,
                   lines=np.zeros((0, 1)), lines_delayed=np.zeros((0, 1)))  # fmt: skip
    assert strips.faces() == [(0, 0, 1), (1, 0, 0), (1, 1, 2), (2, 0, 1)]


@pytest.mark.parametrize(
    ("h", "mu", "named"),
    [(0.0, 0.0, "h"), (-1.0, 0.0, "h"), (math.nan, 0.0, "h"), (1.0, -0.1, "mu"), (1.0, math.inf, "mu")],
)
def test_bad_delays_are_refused(h, mu, named):
    with pytest.raises(ValueError, match=f"{named} = "):
        certify(switched(), h, Criterion(mu=mu))


def test_rates_from_1_on_are_allowed_but_never_certified():
    """The block of x_d' alone in (10) is g (Z22 - Q22), and g takes both signs: no certificate can exist."""
    for mu in (1.0, 1.5):
        assert not certify(linear(-2.0, -0.5), 0.5, Criterion(mu=mu)).valid
    assert certify(linear(-2.0, -0.5), 0.5, Criterion(mu=0.95)).valid


def test_an_empty_tank_stays_empty_and_reports_it():
    plant = ByHand(TankPlant(x0=0.001, delay=1.0))
    for k in range(400):
        plant.advance(k, inflow=(-1000.0,))
    assert plant.outputs(0)["level"] == (0.0,)
    assert plant.reports["dry"][0] is Level.ERROR
    for k in range(400):
        plant.advance(k, inflow=(1000.0,))
    assert plant.outputs(0)["level"][0] > 0.1


@pytest.mark.parametrize(("start", "a"), [(0.3, 0.4875), (-0.3, 0.825)])
def test_a_pendulum_without_commands_swings_by_its_slope(start, a):
    plant, w = ByHand(PendulumPlant(x0=(start, 0.0))), math.sqrt(a)
    seconds = 0.9 * math.pi / 2.0 / w  # the motion stays in one cell
    for k in range(round(seconds / plant.params.period)):
        plant.advance(k, torque=(0.0,))
        t = (k + 1) * plant.params.period
        expected = start * math.cos(w * t), -start * w * math.sin(w * t)
        assert plant.outputs(k)["state"] == pytest.approx(expected, abs=1e-9)


def test_a_state_out_of_range_ends_the_run():
    plant = SwitchedDelayPlant(system="user", n=1, A=[50.0], Ad=[0.0], x0=(1.0,))
    with pytest.raises(RunError, match=r"plant: state x1/position became 1.\d+e\+06 1, expected at most 1e\+06"):
        simulate(Rig.from_blocks({"plant": plant}, 0.4))


def test_a_delay_beyond_its_limit_is_clamped():
    for block in (SwitchedDelayPlant(delay=0.1, max_delay=0.05), DelayLine(delay=0.1, max_delay=0.05)):
        assert ByHand(block).reports["delay"][0] is Level.WARN
    assert ByHand(SwitchedDelayPlant(delay=0.1, max_delay=0.05)).outputs(0)["mode"][1] == 0.05


def test_a_delay_that_changes_during_a_run_reads_the_stored_past():
    """Beside the lines of the two delays; beyond twice the first delay nothing is stored."""
    line = ByHand(DelayLine(delay=0.002))
    ramp = [line.update(k * 10**6, state=(float(k), 0.0))["delayed"][0] for k in range(10)]
    for delay, result in ((0.004, 6.0), (0.0, 11.0), (0.1, 8.0)):
        before = line.block.p
        line.block.change(before.model_copy(update={"delay": delay}))
        line.x = line.block.go_on(line.x, before)
        k = len(ramp)
        ramp.append(line.update(k * 10**6, state=(float(k), 0.0))["delayed"][0])
        assert ramp[-1] == pytest.approx(result)
    assert line.reports["delay"][1] == "delay 0.1 s clamped to what is remembered = 0.004 s"


@pytest.mark.long
def test_a_change_of_the_delay_moves_the_margin():
    """x' = -x(t - d): from 1.5 s, just stable, to 1.65 s, where its oscillations grow at the rate Re W_0(-d)/d."""
    scenario = load_scenario("pwa_delay_hayes").changed(duration=120.0)
    run = simulate(scenario.having(changes=({"at": 5.0, "set": {"switched_delay_plant.delay": 1.65}},)))
    t, x = run.signals["pwa/state/x1/position"]
    assert run.signals["pwa/mode/delay/position"].x[[0, -1]].tolist() == [1.5, 1.65]
    early, late = (np.abs(x[(t > at) & (t < at + 10.0)]).max() for at in (60.0, 100.0))
    # The peaks grow at this rate from one window to the next.
    assert math.log(late / early) / 40.0 == pytest.approx(0.021239, abs=2e-3)


@pytest.mark.parametrize("controller", [TankController, PendulumController])
def test_controllers_hold_their_command_without_a_state(controller):
    law = ByHand(controller())
    law.update(0, **({"level": (0.4,)} if controller is TankController else {"state": (0.2, 0.1)}))
    assert law.refused(0) is None  # the controller holds its last output
    what, held = ("level", "inflow") if controller is TankController else ("state", "torque")
    assert law.reports == {f"bad_{what}": (Level.ERROR, f"no valid {what}: the last {held} is held", 1)}


def test_a_monitor_that_is_too_coarse_reports_it():
    monitor = ByHand(LyapunovMonitor(period=1e-3))
    size = int(np.prod(monitor.block.p.padded()))
    verdict = (0.0192, 1.0, 1e-4, 1e-6, 20.0)
    assert monitor.update(0, state=(1.0, 0.0), mode=(0.0, 0.02), matrices=(0.0,) * size, verdict=verdict) == {}
    assert monitor.reports["coarse"][0] is Level.ERROR


def test_a_negative_delay_does_not_index_into_the_record():
    """A delay of -1 sample would index the oldest one, and -100 samples none: in both cases the record begins again."""
    monitor = ByHand(LyapunovMonitor(period=1e-4))
    size = int(np.prod(monitor.block.p.padded()))
    inputs = {"state": (1.0, 0.0), "matrices": (1.0,) * size, "verdict": (0.0192, 1.0, 1e-4, 1e-6, 20.0)}
    age = 0
    monitor.block.ages = lambda name: age
    for k in range(3):
        age = k * 100_000
        monitor.update(age, mode=(0.0, 0.01), **inputs)
    assert monitor.x.watch.counts[0] == 3
    for delay in (-1e-4, -1e-2):
        assert monitor.update(400_000, mode=(0.0, delay), **inputs) == {}
        assert monitor.x.watch.counts[0] == 0
        monitor.update(500_000, mode=(0.0, 0.01), **inputs)
    assert monitor.reports["delay"][:2] == (
        Level.ERROR,
        "pwa/mode delay became -0.01 s, expected 0 or more: the record of V begins again",
    )


def test_matrices_are_transferred_by_their_topic():
    p = CriterionParams()
    certificate = certify(switched(), 0.018)
    back = p.unpad(p.pad(certificate.matrices))
    assert all(np.array_equal(back[name], m) for name, m in certificate.matrices.items())
    assert set(back) == set(certificate.matrices)


def test_a_bracket_without_a_margin_is_reported():
    with pytest.raises(ValueError, match="no margin between"):
        find_margin(lambda h: -1.0, 0.1, 0.2)
    with pytest.raises(ValueError, match=r"growth 1 1/s at 0.1 s and 1 1/s at 0.1 s: no margin between"):
        find_margin(lambda h: 1.0, 0.1, 0.2)
    with pytest.raises(ValueError, match=r"growth -1 1/s at 0.1 s and nan 1/s at 0.2 s: no margin between"):
        find_margin(lambda h: -1.0 if h < 0.2 else math.nan, 0.1, 0.2)
    with pytest.raises(ValueError, match="too short"):
        growth_rate(simulate_pwa(linear(-1.0, 0.0), profile("constant", 1.0), (1.0,), 5.0))


@pytest.mark.long
@pytest.mark.parametrize("n", range(1, 7))
def test_constant_criterion_grows_with_the_state(n):
    rng = np.random.default_rng(n)
    system = linear(-2.0 * np.eye(n) + 0.1 * rng.normal(size=(n, n)), -0.5 * np.eye(n) + 0.1 * rng.normal(size=(n, n)))
    assert certify(system, 0.5, Criterion("constant", order=2)).valid
    assert bessel_legendre(system, 2).size < theorem1(system, 0.1).size
