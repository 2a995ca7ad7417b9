"""Controllers and plants of the robots over random inputs, against independent code.

Sources: the equations on the pages manipulator_adsmc and rehab_impedance, in loops, with products of polynomials for
the surfaces and sums over all errors for their integrals; the work over a small turn of each joint for the impedance;
the plant itself, moved by a little, for the sampled leg.
"""

import itertools
import math
from random import Random

import numpy as np
import pytest
from conftest import few
from helpers import near
from softrig_core import ByHand, Level, ParameterError, RunError, Sample, to_ns
from softrig_core.block.params import build
from softrig_robots.joints import JointGains, PerJoint, motor_names, require_positive, spread
from softrig_robots.manipulator.controller import VcsController
from softrig_robots.manipulator.plant import ManipulatorPlant
from softrig_robots.manipulator.trajectory import TrajectorySource
from softrig_robots.rehab import computation, tuner
from softrig_robots.rehab.controller import VoltageController
from softrig_robots.rehab.figures import repeatability
from softrig_robots.rehab.impedance import Impedance
from softrig_robots.rehab.patient import Patient
from softrig_robots.rehab.plant import RehabPlant
from softrig_robots.rehab.prom import PromReference
from softrig_robots.rehab.stability import LinearRobot, _sampled, alpha_hat_limit, is_stable
from softrig_robots.rehab.tuner import Tuner
from softrig_robots.urdf import check_inertia, for_pinocchio, root_link

MS = 1_000_000


def sign(x):
    return (x > 0.0) - (x < 0.0)


def clipped(x, top):
    return min(max(x, -top), top)


# laws of the arm -------------------------------------------------------------------------------------------------

T = 0.01
GAINS = {"a1": 3.0, "a2": 0.5, "b1": 4.0, "b2": 0.7}


class Surfaces:
    """Both surfaces of one joint, each integral summed again from all errors so far; mu by multiplying polynomials."""

    def __init__(self, printed):
        _, *self.mu = np.polymul([1.0, 3.0, 0.5], [1.0, 4.0, 0.7]).tolist()
        if printed:
            self.mu[0] = 3.0 + 0.7
        self.e, self.s, self.inner = [], [], []

    def take(self, e, ed):
        self.e_int, self.s_int, self.s_int2 = T * sum(self.e), T * sum(self.s), T * sum(self.inner)
        now = ed + 3.0 * e + 0.5 * self.e_int
        self.e.append(e)
        self.s.append(now)
        self.inner.append(self.s_int)
        return now

    def rate(self, qdd, v, e, ed):
        return sum(m * x for m, x in zip(self.mu, (qdd - v, ed, e, self.e_int), strict=True))


@pytest.mark.parametrize("law", ["adsmc", "dsmc", "smc"])
@pytest.mark.parametrize("option", ["", "use_printed_mu1", "adapt_at_limit"])
def test_the_voltage_controllers_of_the_arm_equal_their_formulas(law, option):
    """Two joints with gains of their own: that of the second switching and adapting gain is twice that of the first."""
    own = {"adsmc": {"gamma": (50.0, 100.0), "k": 2.0}, "dsmc": {"rho": (30.0, 60.0)}, "smc": {"rho": (2.0, 4.0)}}[law]
    surface = {k: v for k, v in GAINS.items() if law != "smc" or k[0] == "a"}
    arm = ByHand(
        VcsController(
            joints=("x", "y"),
            law=law,
            period=T,
            v_max=6.0,
            **({option: True} if option else {}),
            **{law: surface | own},
        )
    )
    draw, both = Random(law), [Surfaces(option == "use_printed_mu1") for _ in range(2)]
    v, f, before = [0.0, 0.0], [0.0, 0.0], [None, None]
    limited = 0
    for k in range(60):
        q, qd, ref, rate, acceleration = ([draw.uniform(-0.4, 0.4) for _ in range(2)] for _ in range(5))
        outputs = arm.update(k, joint_states=(*q, *qd), reference=(*ref, *rate, *acceleration))
        shown = []
        for j in range(2):
            e, ed, qdd = ref[j] - q[j], rate[j] - qd[j], acceleration[j]
            s, sigma = both[j].take(e, ed), 0.0
            if law == "smc":
                v[j] = clipped(qdd + 3.0 * ed + 0.5 * e + own["rho"][j] * sign(s), 6.0)
            elif law == "dsmc":
                if before[j]:
                    sigma = (ed - before[j][1]) / T + 3.0 * ed + 0.5 * e + 4.0 * s + 0.7 * both[j].s_int
                    v[j] += qdd - before[j][0] + T * (both[j].rate(qdd, v[j], e, ed) + own["rho"][j] * sign(sigma))
                    v[j] = clipped(v[j], 6.0)
                before[j] = qdd, ed
            else:
                total = s + 4.0 * both[j].s_int + 0.7 * both[j].s_int2
                if before[j]:
                    step = total - before[j][1]
                    new = f[j] + own["gamma"][j] * step
                    free = v[j] + qdd - before[j][0] + 2.0 * step + T * (both[j].rate(qdd, v[j], e, ed) + new)
                    limited += abs(free) > 6.0 and step * free > 0.0
                    if abs(free) <= 6.0 or step * free <= 0.0 or option == "adapt_at_limit":
                        f[j] = new
                    v[j], sigma = clipped(free, 6.0), step / T
                before[j] = qdd, total
            shown.append((e, s, sigma, f[j]))
        assert outputs["motor_command"] == near(tuple(v))
        assert outputs["controller_state"] == near(tuple(x for kind in zip(*shown, strict=True) for x in kind))
    assert limited > 5 or law != "adsmc"


def test_changed_gains_of_the_adaptive_law_cause_no_jump():
    """Under a constant error the voltage creeps; a Sigma of the old gains would make it jump by k times theirs."""
    made = {"joints": ("x",), "period": 1e-6, "v_max": 1e3}
    before = VcsController(**made, adsmc={"a1": 10.0, "k": 10.0})
    after = VcsController(**made, adsmc={"a1": 20.0, "a2": 3.0, "b1": 5.0, "k": 10.0})
    inputs = {"joint_states": (0.0, 0.0), "reference": (0.5, 0.1, 0.3)}
    fresh = after.go_on(before.first(), before.p)
    assert fresh == before.first()
    x, volts = before.first(), []
    for k in range(6):
        block = before if k < 3 else after
        x = after.go_on(x, before.p) if k == 3 else x
        x, outputs = block.update(x, k, **inputs)
        volts.append(outputs["motor_command"][0])
    assert max(abs(b - a) for a, b in itertools.pairwise(volts)) < 2e-3


def test_the_reference_of_the_arm_swings_up_and_back():
    source = ByHand(TrajectorySource(joints=("a", "b"), amplitude=(0.5, 2.0), cycle=8.0))
    w = 2.0 * math.pi / 8.0
    for t in (0.0, 1.0, 3.3, 8.0, 12.7):
        c, s = math.cos(w * t), math.sin(w * t)
        rows = [(A * (1.0 - c), A * w * s, A * w * w * c) for A in (0.5, 2.0)]
        assert source.update(to_ns(t))["reference"] == near(tuple(v for kind in zip(*rows, strict=True) for v in kind))


# laws of the rehabilitation robot --------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["emvc", "tsarc", "arsc"])
@pytest.mark.parametrize("use_applied", [True, False])
def test_the_voltage_controllers_of_the_rehabilitation_robot_equal_their_formulas(law, use_applied):
    gains = {
        "emvc": {"alpha_hat": (3.0, 2.0), "lam": 5.0, "resistance": 3.0},
        "tsarc": {
            "alpha_hat": (3.0, 2.0),
            "lam": 5.0,
            "resistance": 3.0,
            "gamma_a": 9.0,
            "gamma_b": 40.0,
            "rho": 2.0,
            "phi": 0.3,
            "window": 0.07,
        },
        "arsc": {"k1": (3.0, 2.0), "k2": 1.5, "h": 0.8, "gamma1": 5.0, "gamma2": 90.0, "gamma3": 20.0, "gamma4": 400.0},
    }[law]
    robot = ByHand(VoltageController(law=law, period=T, v_max=9.0, use_applied=use_applied, **{law: gains}))
    draw, first, sent = Random(5), next(iter(gains.values())), (0.0, 0.0)
    theta = [[0.1, 4.592, 0.0, 0.0] for _ in range(2)]
    series = [[0.0, 0.0] for _ in range(2)]
    ends = set()
    for k in range(120):
        q, qd, i, r, rd, rdd, applied = ([draw.uniform(-0.9, 0.9) for _ in range(2)] for _ in range(7))
        inputs = {"applied_voltage": tuple(applied)} if use_applied else {}
        outputs = robot.update(k, joint_states=(*q, *qd), motor_states=tuple(i), reference=(*r, *rd, *rdd), **inputs)
        volts, shown = [], []
        for j in range(2):
            e, last = r[j] - q[j], (applied if use_applied else sent)[j]
            if law == "emvc":
                psi = (last - 3.0 * i[j]) / first[j] - qd[j]
                u = last + first[j] * (rd[j] - qd[j] + 5.0 * e)
                shown.append((psi,))
            elif law == "tsarc":
                tau = T * (k % 7)
                a, b = series[j]
                u = first[j] * (rd[j] + 5.0 * e) + 3.0 * i[j] + a + b * tau + 2.0 * math.tanh(e / 0.3)
                a, b = a + T * 9.0 * e, b + T * 40.0 * e * tau
                series[j] = [a + b * 0.07 if k % 7 == 6 else a, b]
                shown.append(tuple(series[j]))
            else:
                z = qd[j] - rd[j] + first[j] * (q[j] - r[j])
                phi = (rdd[j] - first[j] * (qd[j] - rd[j]), qd[j], math.tanh(qd[j] / 0.05), 1.0)
                u = sum(p * th for p, th in zip(phi, theta[j], strict=True)) - 1.5 * z - 0.8 * math.tanh(z / 0.05)
                limits = zip((5.0, 90.0, 20.0, 400.0), (0.02, 2.0, 0.0, -8.0), (0.6, 8.0, 1.0, 8.0), strict=True)
                theta[j] = [
                    min(max(th - T * g * p * z, low), high)
                    for th, p, (g, low, high) in zip(theta[j], phi, limits, strict=True)
                ]
                ends |= set(theta[j])
                shown.append(tuple(theta[j]))
            volts.append(clipped(u, 9.0))
        sent = tuple(volts)
        assert outputs["motor_command"] == near(sent)
        errors = [b - a for a, b in zip(q, r, strict=True)]
        assert outputs["controller_state"] == near((*errors, *(x for row in zip(*shown, strict=True) for x in row)))
    assert law != "arsc" or {0.02, 2.0, 0.0, -8.0, 0.6, 8.0, 1.0} <= ends


TICK = {
    "joint_states": (0.2, -0.5, 0.1, 0.2),
    "motor_states": (0.5, 0.2),
    "reference": (0.21, -0.49, 0.1, 0.1, 0.0, 0.0),
    "applied_voltage": (2.0, 1.0),
}


@pytest.mark.parametrize("name", ["reference", "joint_states", "motor_states"])
@pytest.mark.parametrize("answer", ["safe", "hold"])
def test_an_input_of_the_largest_allowed_age_is_not_lost(name, answer):
    robot = ByHand(VoltageController(stale_after=5, reference_lost=answer))
    robot.block.ages = {name: 5 * MS}.get
    fresh = robot.update(0, **TICK)
    assert (fresh["motor_command"] != (0.0, 0.0), "SAFE" in robot.reports, "reference" in robot.reports) == (
        True,
        False,
        False,
    )
    robot.block.ages = {name: 5 * MS + 1}.get
    late = robot.update(MS, **TICK)
    assert late["controller_state"][:2] == near((0.01, 0.01))
    if name == "reference" and answer == "hold":  # the joint holds its last position with zero speed
        still = ByHand(VoltageController()).update(0, **TICK | {"reference": (0.21, -0.49, 0.0, 0.0, 0.0, 0.0)})
        assert late["motor_command"] == still["motor_command"]
        assert robot.reports["reference"][:2] == (
            Level.ERROR,
            "no new reference for more than 5 periods: its position is held with speed zero",
        )
    else:
        assert late["motor_command"] == (0.0, 0.0)
        assert robot.reports["SAFE"][1] == f"SAFE: no new {name} for more than 5 periods: 0 V"


def test_ticks_that_are_rejected_before_the_first_good_one_are_not_answered():
    robot = ByHand(VoltageController(stale_after=2))
    assert [robot.refused(k) for k in range(4)] == [None] * 4
    assert robot.reports["SAFE"][:2] == (Level.ERROR, "SAFE: 2 ticks with a rejected input: 0 V")
    robot.update(5, **TICK)  # a valid sample resets the count of invalid ones
    assert [robot.refused(k) is None for k in range(6, 10)] == [True, True, False, False]
    bent = ByHand(Impedance(stale_after=2))
    assert [bent.refused(k) for k in range(4)] == [None] * 4
    assert bent.reports == {}


def foot(q1, q2):
    return (0.5 * math.sin(q1) + 0.45 * math.sin(q1 + q2), -0.5 * math.cos(q1) - 0.45 * math.cos(q1 + q2))


def test_the_impedance_controller_equals_its_formula():
    """The torque of a force at the foot is computed from its work over a small rotation of each joint."""
    law = ByHand(Impedance(period=T, inertia=(2.0, 0.5), damping=(8.0, 3.0), stiffness=(50.0, 30.0), force_limit=15.0))
    draw, q, v = Random(3), None, None
    K, B = [50.0, 30.0], [8.0, 3.0]
    for k in range(80):
        ref = [draw.uniform(-0.5, 0.5) for _ in range(6)]
        joints = [draw.uniform(-1.0, 1.0) for _ in range(2)]
        force = [draw.uniform(-12.0, 12.0) for _ in range(3)] if draw.random() < 0.8 else None
        stiff, damp = draw.choice((None, None, 0.0, 44.0, -1.0)), draw.choice((None, None, 0.0, 6.0, -1.0))
        wrench = None if force is None else Sample(k, (*force, 1.0, 2.0, 3.0))
        outputs = law.update(
            k,
            reference=tuple(ref),
            patient_force=wrench,
            joint_states=tuple(joints),
            stiffness=None if stiff is None else (stiff,),
            damping=None if damp is None else (damp,),
        )
        K = [stiff] * 2 if stiff is not None and stiff >= 0.0 else K
        B = [damp] * 2 if damp is not None and damp >= 0.0 else B
        if q is None:
            q, v = ref[:2], ref[2:4]
        share = 0.0 if force is None else min(1.0, 15.0 / math.hypot(*force))
        torque = []
        for j in range(2):
            ahead, behind = (foot(*(x + s * 1e-6 * (i == j) for i, x in enumerate(joints))) for s in (1.0, -1.0))
            turn = [(a - b) / 2e-6 for a, b in zip(ahead, behind, strict=True)]
            torque.append(share * (force[0] * turn[0] + force[2] * turn[1]) if force else 0.0)
        a = [
            ref[4 + j] + (B[j] * (ref[2 + j] - v[j]) + K[j] * (ref[j] - q[j]) - torque[j]) / (2.0, 0.5)[j]
            for j in range(2)
        ]
        assert outputs["regenerated"] == pytest.approx((*q, *v, *a), rel=1e-7, abs=1e-7)
        v = [x + T * y for x, y in zip(v, a, strict=True)]
        q = [x + T * y for x, y in zip(q, v, strict=True)]


def test_the_impedance_controller_waits_for_its_time_limit():
    """A force or reference as old as 20 periods is accepted; without any message the parameter counts."""
    inputs = {"reference": (0.5, -0.5, 0.1, 0.2, 0.3, 0.4), "joint_states": (0.5, -0.5)}
    for late, stands in ((20 * MS, False), (20 * MS + 1, True)):
        law = ByHand(Impedance())
        outputs = law.update(late, patient_force=Sample(0, (0.0,) * 6), **inputs)["regenerated"]
        assert outputs == ((0.5, -0.5, 0.0, 0.0, 0.0, 0.0) if stands else inputs["reference"])
        law = ByHand(Impedance())
        law.block.ages = {"reference": late}.get
        outputs = law.update(0, patient_force=None, **inputs)["regenerated"]
        assert outputs == ((0.5, -0.5, 0.0, 0.0, 0.0, 0.0) if stands else inputs["reference"])
    before, after = Impedance(damping=4.0, stiffness=7.0), Impedance(damping=4.0, stiffness=9.0)
    x = before.first()._replace(damping=(1.0, 1.0), stiffness=(2.0, 2.0))
    assert after.go_on(x, before.p)[:2] == ((1.0, 1.0), (9.0, 9.0))
    assert before.go_on(x, Impedance(damping=5.0, stiffness=7.0).p)[:2] == ((4.0, 4.0), (2.0, 2.0))


def test_the_force_at_the_foot_is_limited_only_beyond_its_limit():
    for size, text in ((10.0, []), (10.001, ["force"])):
        plant = ByHand(RehabPlant(force_limit=10.0))
        force = (0.6 * size, 0.48 * size, -0.64 * size)
        plant.advance(0, motor_command=(0.0, 0.0), patient_force=(*force, 0.0, 0.0, 0.0))
        assert [name for name in plant.reports if name != "torque_constant"] == text
        assert plant.x.force == near((6.0, 4.8, -6.4))


def test_the_patient_pushes_from_its_start_for_its_duration():
    patient = ByHand(Patient(force_x=10.0, force_z=-4.0, begin=1.0, duration=0.5, cycle=3.0))
    for t in (0.0, 0.999, 1.0, 1.1, 1.25, 1.499, 1.5, 4.25, 7.1):
        since = t % 3.0 - 1.0
        share = math.sin(math.pi * since / 0.5) ** 2 if 0.0 <= since < 0.5 else 0.0
        assert patient.update(to_ns(t))["patient_force"] == near((10.0 * share, 0.0, -4.0 * share, 0.0, 0.0, 0.0))


def test_the_exercise_goes_up_and_back_on_sigmoids():
    source = ByHand(
        PromReference(lower=(-0.5, -1.5), upper=(2.0, 0.0), speed=(0.5, 0.4), cycle=30.0, eta1=8.0, eta2=21.0)
    )

    def place(t, low, span, speed):
        width = span / (4.0 * speed)
        return low + 0.5 * span * (math.tanh((t - 8.0) / (2.0 * width)) - math.tanh((t - 21.0) / (2.0 * width)))

    for t in (0.0, 5.0, 8.0, 15.0, 22.0, 38.0, 61.0):
        result, h = source.update(to_ns(t))["reference"], 1e-4
        for j, of in enumerate(((-0.5, 2.5, 0.5), (-1.5, 1.5, 0.4))):
            before, now, after = (place(t % 30.0 + d, *of) for d in (-h, 0.0, h))
            assert result[j] == near(now)
            assert result[2 + j] == pytest.approx((after - before) / (2.0 * h), abs=1e-7)
            assert result[4 + j] == pytest.approx((after - 2.0 * now + before) / h**2, abs=1e-6)


# plants ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("volts", [4.0, -4.0])
def test_a_voltage_at_its_limit_is_saturation_and_below_it_is_not(volts):
    arm = ByHand(ManipulatorPlant(v_max=4.0, period=0.002, substeps=3))
    arm.advance(0, motor_command=(0.999 * volts, 0.0, 0.0))
    assert (arm.x.saturated, arm.reports) == ((0, 0, 0), {})
    arm.advance(1, motor_command=(0.0, volts, 0.0))
    arm.advance(2, motor_command=(0.0, 5.0 * volts, -volts))
    assert arm.x.saturated == (0, 2, 1)
    assert arm.reports["saturation"][:2] == (
        Level.WARN,
        "motor voltages at their limit of 4 V for [0.0, 0.004, 0.002] s (motor after motor)",
    )
    assert arm.block.clip((0, 0, 0), (9.0, -9.0, 1.0)) == ((1, 1, 0), (4.0, -4.0, 1.0))


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_joint_at_the_speed_limit_continues_and_one_beyond_it_ends_the_run(way):
    block = ManipulatorPlant(speed_limit=2.0, period=1e-9, substeps=1, motors={"inductance": 1.0})
    for speed, ends in ((2.0, False), (2.0001, True)):
        x = block.first()
        x = x._replace(v=(0.0, way * speed, 0.0))
        block._step = lambda flat, x=x: (*x.q, *x.v, *x.i)
        if not ends:
            assert block.advance(x, 0, motor_command=(0.0,) * 3).v == x.v
            continue
        with pytest.raises(RunError, match=rf"^joint speeds \[0.0, {way * speed:g}, 0.0\] rad/s, limit 2: integration"):
            block.advance(x, 0, motor_command=(0.0,) * 3)


def test_the_disturbance_of_the_arm_begins_at_its_time():
    block = ManipulatorPlant(disturbance={"amplitude": (1.0, 2.0, 3.0), "time": 0.5})
    assert block.loads(to_ns(0.5) - 1) == ((0.0,) * 3, (0.0,) * 3)
    assert block.loads(to_ns(0.5)) == ((1.0, 2.0, 3.0), (0.0,) * 3)


def test_disturbances_of_the_leg_and_drifts_of_its_motors():
    block = RehabPlant(
        disturbance={"torque": (1.0, 2.0), "begin": 1.0, "end": 2.0},
        drift={"resistance": 0.5, "constants": -0.25, "duration": 10.0},
    )
    for t, torque in ((0, 0.0), (10**9 - 1, 0.0), (10**9, 1.0), (2 * 10**9 - 1, 1.0), (2 * 10**9, 0.0)):
        assert block.loads(t) == ((0.0, 0.0), (torque, 2.0 * torque))
    assert block.drifted(None)[:2] == (4.0, 4.0)
    for t, done in ((0, 0.0), (5 * 10**9, 0.5), (10**10, 1.0), (10**11, 1.0)):
        R, _, L, _, per_ampere, _, emf, *_ = block.drifted(t)
        assert (R, L, per_ampere, emf) == near(
            (4.0 * (1.0 + 0.5 * done), 2.5e-3, 4.32 * 16 * (1.0 - 0.25 * done), 0.287 * 16 * (1.0 - 0.25 * done))
        )


def test_the_watch_of_the_leg_is_exact_at_its_limits():
    """Range with its margin, speed after the start: at each limit nothing, beyond it a permanent stop."""
    block = RehabPlant(startup=0.5, lower=(-0.5, -1.5), upper=(2.0, 0.0), rom_margin=0.25, rom_speed=1.0)
    x = block.first()._replace(entered=(True, True))
    half = 500 * MS

    def watched(q=(0.0, -1.0), v=(0.0, 0.0), t=half, live=0, **more):
        return block._watch(x._replace(q=q, v=v, **more), t, live)

    for q in ((2.25, -1.0), (-0.75, -1.0), (0.0, 0.25), (0.0, -1.75)):
        assert watched(q) == ((True, True), False)
    for q in ((2.2501, -1.0), (-0.7501, -1.0), (0.0, 0.2501), (0.0, -1.7501)):
        assert watched(q) == ((True, True), True)
        # the joint has not been within its range yet
        assert watched(q, entered=(False, False)) == ((q[0] == 0.0, q[1] == -1.0), False)
    for v, t, live, stops in (
        ((1.0, -1.0), half, 0, False),
        ((1.0001, 0.0), half, 0, True),
        ((0.0, -1.0001), half, 0, True),
        ((2.0, 2.0), half - 1, 0, False),
        ((2.0, 2.0), half, None, False),
        ((2.0, 2.0), half, 1, False),
    ):
        assert watched(v=v, t=t, live=live)[1] is stops
    assert watched(safe=True)[1]
    block.events.clear()
    watched((2.3, -1.0), (5.0, 5.0))
    watched(v=(0.0, 3.0))
    assert [key for _, key, _, _ in block.events] == ["safe"] * 2
    assert block.events[-1][2] == "SAFE from t = 0.5 s, motors at 0 V: knee at 3 rad/s, limit 1 rad/s"


@pytest.mark.parametrize(("constant", "warns"), [(0.287 * 1.2, False), (0.287 * 1.21, True), (0.287 * 0.79, True)])
def test_motors_whose_constants_differ_by_a_fifth_are_reported(constant, warns):
    plant = ByHand(RehabPlant(motors={"torque_constant": constant}))
    assert ("torque_constant" in plant.reports) is warns


def test_the_sampled_leg_equals_the_plant_near_a_pose():
    """One period of the plant itself, with each state and voltage changed slightly around currents that carry
    the leg.
    """
    motors = {"inertia": (3e-4, 2e-4), "damping": (2e-3, 1e-3), "inductance": (2.5e-3, 5e-3), "gear": (0.1, 0.05)}
    robot = build(LinearRobot, {"motors": motors, "payload": 1.5, "viscous": (1.3, 0.6)})
    plant = RehabPlant(motors=motors, payload=1.5, friction={"coulomb": 0.0, "static": 0.0, "viscous": (1.3, 0.6)},
                       v_max=1e3, rom_margin=9.0, rom_speed=90.0, substeps=4, disturbance={"torque": 0.0})  # fmt: skip
    pose, eps = np.array([0.4, -0.7]), 1e-5

    def potential(q):
        thigh, shank = -0.45 * math.cos(q[0]), -0.5 * math.cos(q[0]) - 0.40 * math.cos(q[0] + q[1])
        return 9.81 * (5.5 * thigh + 5.0 * shank + 1.5 * foot(*q)[1])

    pull = [(potential(pose + 1e-6 * d) - potential(pose - 1e-6 * d)) / 2e-6 for d in np.eye(2)]
    remaining = np.array([*pose, 0.0, 0.0, *(g / (4.32 / r) for g, r in zip(pull, (0.1, 0.05), strict=True))])

    def moved(change, volts):
        flat = (remaining + change).tolist()
        x = plant.first()._replace(q=tuple(flat[:2]), v=tuple(flat[2:4]), i=tuple(flat[4:]))
        after = plant.advance(x, 0, motor_command=tuple(4.0 * remaining[4:] + volts))
        return np.array([*after.q, *after.v, *after.i])

    columns = [(moved(eps * d, 0.0) - moved(-eps * d, 0.0)) / (2 * eps) for d in np.eye(6)]
    pushes = [(moved(0.0, eps * d) - moved(0.0, -eps * d)) / (2 * eps) for d in np.eye(2)]
    A, B = _sampled(*pose, 1e-3, robot, 1.0, 1.0)
    np.testing.assert_allclose(moved(0.0, 0.0), remaining, atol=1e-9)
    np.testing.assert_allclose(np.array(columns).T, A, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(np.array(pushes).T, B, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("delayed", "applied"), few([(False, False), (True, False), (True, True)], 1))
def test_below_its_limit_the_sampled_loop_decays_and_above_it_grows(delayed, applied):
    """The law written as what it does in a tick."""
    limit = alpha_hat_limit(1e-3, 4.0, delayed, applied)

    def after(A, B, alpha, x, acts, sent):
        volts = (acts if applied else sent) - alpha * (x[2:4] + 4.0 * x[:2])
        now = sent if delayed else volts
        return np.concatenate([A @ x + B @ now, now, volts])

    def radius(alpha):
        """Spectral radius of the map of one tick, column by column, over all poses."""
        result = 0.0
        for q1 in np.radians((-30, 20, 70, 120)):
            for q2 in np.radians((-90, -60, -30, 0)):
                A, B = _sampled(q1, q2, 1e-3, LinearRobot(), 1.0, 1.0)
                tick = np.array([after(A, B, alpha, d[:6], d[6:8], d[8:]) for d in np.eye(10)]).T
                result = max(result, np.abs(np.linalg.eigvals(tick)).max())
        return result

    assert radius(0.999 * limit) < 1.0 < radius(1.001 * limit)
    for share, stable in ((0.99, True), (1.01, False)):
        assert is_stable(1e-3, (share * limit,) * 2, (4.0, 4.0), delayed, applied) is stable


@pytest.mark.parametrize(
    "drift", few([{"resistance": 0.5, "constants": -0.3}, {"resistance": -0.4, "constants": 0.2}], 1)
)
def test_the_limit_of_motors_that_drift_is_that_of_the_worse_end(drift):
    """One of these motors is worse before its drift, the other after it."""
    R, K = 1.0 + drift["resistance"], 1.0 + drift["constants"]
    after = {"resistance": 4.0 * R, "torque_constant": 4.32 * K, "back_emf_constant": 0.287 * K}
    limits = [
        alpha_hat_limit(1e-3, 4.0, False, False, build(LinearRobot, made))
        for made in ({}, {"motors": after}, {"drift": drift})
    ]
    assert limits[2] == pytest.approx(min(limits[:2]), rel=1e-5)
    assert limits[0] != pytest.approx(limits[1], rel=1e-2)


# small things ----------------------------------------------------------------------------------------------------


def test_a_value_is_given_for_each_joint():
    assert spread("x", (2,), 3) == (2.0, 2.0, 2.0)
    assert spread("x", (1, 2), 2) == (1.0, 2.0)
    assert motor_names(("hip", "knee")) == ("motor1", "motor2")
    require_positive("x", (0.1, 2.0))
    require_positive("x", (0.0, 2.0), or_zero=True)
    for values, or_zero, kind in (((0.0,), False, "only positive"), ((1.0, -0.1), True, "no negative")):
        with pytest.raises(ValueError, match=rf"^x = .*: expected {kind} values$"):
            require_positive("x", values, or_zero=or_zero)
    assert build(Tuned, {"a": 2}).of_joint("law", 1, 2).a == 2.0
    assert build(Tuned, {"a": [1.0, 3.0]}).of_joint("law", 1, 2).a == 3.0
    for flag in (True, "2"):
        with pytest.raises(ParameterError):
            build(Tuned, {"a": flag})


class Tuned(JointGains):
    """A law's gains."""

    a: PerJoint = (1.0,)


def test_no_body_has_a_moment_beyond_the_sum_of_the_others():
    check_inertia("m", 1.0, "I", (1.0, 2.0, 3.0))
    check_inertia("m", 1.0, "I", (3.0 * (1.0 + 0.9e-9), 1.0, 2.0))  # deviates by a rounding error only
    for mass, moments, text in (
        (0.0, (1.0, 1.0, 1.0), "^m = 0 kg: expected a positive mass$"),
        (1.0, (1.0, 0.0, 1.0), r"^I = \[1.0, 0.0, 1.0\] kg m\^2: expected a positive definite inertia$"),
        (
            1.0,
            (1.0, 3.0 * (1.0 + 1.05e-9), 2.0),
            r"^I = .*: no body has one moment larger than the sum of the other two",
        ),
    ):
        with pytest.raises(ValueError, match=text):
            check_inertia("m", mass, "I", moments)


def test_urdf_of_a_continuous_joint():
    text = (
        '<robot name="r"><link name="b"/><link name="a"/><link name="tip"/>'
        '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
        '<joint name="k" type="continuous"><parent link="b"/><child link="tip"/>'
        '<limit effort="3" velocity="4"/></joint>'
        "</robot>"
    )
    assert root_link(text) == "a"
    turned = for_pinocchio(text)
    assert "continuous" not in turned
    assert (
        '<limit effort="1000000000.0" velocity="1000000000.0" lower="-1000000000.0" upper="1000000000.0" />' in turned
    )
    assert '<limit effort="3.0" velocity="4.0" lower="-1000000000.0" upper="1000000000.0" />' in turned
    zero = '<inertial><mass value="0"/><inertia ixx="0" iyy="0.0"/></inertial>'
    assert "inertial" not in for_pinocchio(f'<robot><link name="a">{zero}</link></robot>')
    assert "inertial" in for_pinocchio(f'<robot><link name="a">{zero.replace("0.0", "0.1")}</link></robot>')


def test_repeatability_is_the_change_of_an_error_over_its_square():
    t = np.arange(3.0)
    first, second = {"e": (t, np.array([1.0, 2.0, 3.0]))}, {"e": (t, np.array([2.0, 0.0, 3.0]))}
    assert repeatability(first, second, "e") == pytest.approx((1.0 + 4.0 + 0.0) / 14.0)


def test_the_computing_time_of_a_law_is_that_of_an_update_over_changing_states(monkeypatch, capsys):
    """The clock is replaced by one of 3 ms a reading, the laws by one that records its inputs."""
    seen = []

    class Law:
        def __init__(self, law):
            self.law = law

        def first(self):
            return 0

        def update(self, x, k, **inputs):
            seen.append((x, k, inputs))
            return x + 1, {}

    clock = itertools.count()
    monkeypatch.setattr(computation, "VoltageController", Law)
    monkeypatch.setattr(computation.time, "process_time", lambda: 3e-3 * next(clock))
    assert computation._mean_time(Law("emvc"), 1500) == near(2.0)  # us, from 3 ms for 1500 updates
    assert [row[:2] for row in seen] == [(k, k) for k in range(1500)]
    for k in (0, 700, 1499):
        x = math.sin(1e-3 * k)
        assert seen[k][2] == {
            "joint_states": (x, -x, 0.2, -0.1),
            "motor_states": (0.1 * x, 0.2),
            "reference": (x + 0.01, 0.01 - x, 0.2, -0.1, 0.0, x),
            "applied_voltage": (x, -x),
        }
    elapsed = itertools.count(1)
    monkeypatch.setattr(computation, "_mean_time", lambda controller, updates: float(next(elapsed)) + updates)
    # The best of three rounds counts.
    assert computation.computation_times(10) == {"emvc": 11.0, "tsarc": 12.0, "arsc": 13.0}
    assert next(elapsed) == 10
    monkeypatch.setattr(computation, "computation_times", lambda: {"emvc": 1.0, "tsarc": 2.5, "arsc": 30.0})
    computation.main()
    assert capsys.readouterr().out.splitlines() == [
        "ACT, us   paper   here",
        "emvc       12.2   1.00",
        "tsarc      37.8   2.50",
        "arsc      160.0  30.00",
    ]


# the tuner -------------------------------------------------------------------------------------------------------


def test_the_cost_of_an_exercise_is_its_error_and_in_the_guarded_search_its_chatter(monkeypatch):
    monkeypatch.setattr(tuner, "exercise", lambda alpha, duration: tuner.Exercise(alpha * duration, 2000.0))
    assert tuner.cost((3.0,)) == near(3.0 * 15.0 + 1e-7 * 2000.0**2)
    assert tuner.cost((3.0,), 2.0, False) == 6.0
    assert tuner.guarded_limit() == near(0.9 * alpha_hat_limit(0.001, 4.0, False))


def test_an_exercise_in_a_plain_loop_has_the_figures_of_its_definition():
    """40 ticks, with each joint's error and voltage collected by the controller itself."""
    seen = []
    update = VoltageController.update

    def watched(self, x, t, **inputs):
        x, text = update(self, x, t, **inputs)
        seen.append((text["controller_state"][:2], text["motor_command"]))
        return x, text

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VoltageController, "update", watched)
        result = tuner.exercise(3.0, 0.04)
    assert len(seen) == 40
    squares = [math.degrees(e) ** 2 for errors, _ in seen for e in errors]
    steps = [abs(b - a) for (_, x), (_, y) in itertools.pairwise(seen) for a, b in zip(x, y, strict=True)]
    assert result == near((sum(squares) / 80, sum(steps) / (2 * 39 * 0.001)))


def test_the_tuner_requests_when_its_button_is_pressed_and_reports_the_best():
    block = Tuner(n_pop=3, n_iter=1, guarded=False, duration=2.0)
    x = block.first()
    assert block.answer(x, 0, None, False)[1] == {"result": (0.0, 0.0, 0.0)}
    asked = []
    for t, pressed in enumerate((None, (0.0,), (1.0,), (1.0,), (0.0,), (1.0,))):
        x, request = block.request(x, t, start=pressed)
        asked.append(request is not None)
    assert asked == [False, False, True, False, False, True]
    assert request[1:] == (2.0, False)
    best = math.inf
    for k in range(60):
        value = math.inf if k == 0 else (request[0][0] - 3.0) ** 2
        before = x
        x, outputs = block.answer(x, k, Reply(request, None if k == 0 else value), True)
        best = min(best, value)
        if math.isinf(best):
            assert outputs["result"][1:] == (0.0, 0.0)
        else:
            assert outputs["result"][2] == best
        # Without a new value the state is unchanged.
        assert block.answer(before, k, Reply(request, value), False)[0] == before
        # The reply belongs to an earlier search.
        assert block.answer(before, k, Reply(((-1.0,), 0, 0), value), True)[0] == before
        x, request = block.request(x, k, start=(1.0,))
        if request is None:
            break
    assert x.search.now.done
    assert x.search.now.iteration == outputs["result"][0] == 1.0
    assert Tuner(autostart=True).first().search is not None


class Reply:
    """A result as a solver's process returns it."""

    stamp = 0

    def __init__(self, request, answer):
        self.request, self.answer = request, answer
