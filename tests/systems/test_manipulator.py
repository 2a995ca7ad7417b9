"""3-link manipulator: dynamics against independent methods, the acceptance numbers, bad input."""

import functools
import math
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
import softrig_robots
from conftest import differences, few, in_process
from scipy.integrate import solve_ivp
from simulated import SimulatedRig, World
from softrig_core import (
    ByHand,
    RunError,
    ScenarioError,
    Signals,
    evaluate,
    list_scenarios,
    load_scenario,
    rig_of,
)
from softrig_core.judge import measures
from softrig_core.kit import compiled
from softrig_core.kit.floats import numbers
from softrig_nodes.ros.messages import marker_array
from softrig_robots.driven_robot import compile_robot
from softrig_robots.dynamics import RobotDynamics
from softrig_robots.manipulator.controller import VcsController
from softrig_robots.manipulator.model import Links, manipulator_urdf
from softrig_robots.manipulator.plant import ManipulatorPlant
from softrig_robots.rigid_body import SymbolicRobot, load_model
from softrig_robots.urdf import read_urdf

URDF = Path(softrig_robots.__file__).parent / "urdf"
TWO_LINK = "package://softrig_robots/urdf/two_link.urdf"
Q, V = np.array([0.3, -0.7, 0.9]), np.array([0.4, -0.5, 0.6])
G = 9.81
HIGH = {"a1": 40.0, "a2": 200.0, "b1": 80.0, "b2": 400.0, "gamma": 20000.0, "k": 100.0}
E_SIGNAL = [f"controller_state/e{i}/position" for i in (1, 2, 3)]
V_SIGNAL = [f"motor_command/motor{i}/effort" for i in (1, 2, 3)]


# D and G in closed form, with Coriolis terms from Christoffel symbols; neither the URDF nor pinocchio.


@functools.cache
def lagrangian():
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    (m1, m2, m3), (_, iyy1, _) = (19.0, 18.18, 10.99), (0.34, 0.36, 0.31)
    (ixx2, iyy2, izz2), (ixx3, iyy3, izz3) = (0.18, 1.32, 1.31), (0.07, 0.92, 0.93)
    a2, r2, r3 = 0.76, 0.25, 0.26
    s2, c2, s23, c23, c3 = ca.sin(q[1]), ca.cos(q[1]), ca.sin(q[1] + q[2]), ca.cos(q[1] + q[2]), ca.cos(q[2])
    reach = a2 * c2 + r3 * c23
    d11 = iyy1 + ixx2 * s2**2 + iyy2 * c2**2 + m2 * r2**2 * c2**2 + ixx3 * s23**2 + iyy3 * c23**2 + m3 * reach**2
    d22 = izz2 + m2 * r2**2 + izz3 + m3 * (a2**2 + r3**2 + 2 * a2 * r3 * c3)
    d23, d33 = izz3 + m3 * (r3**2 + a2 * r3 * c3), izz3 + m3 * r3**2
    D = ca.blockcat([[d11, 0, 0], [0, d22, d23], [0, d23, d33]])
    gravity = G * ca.vertcat(0, m2 * r2 * c2 + m3 * reach, m3 * r3 * c23)
    height = G * (m1 * 0.06 + m2 * (0.28 + r2 * s2) + m3 * (0.28 + a2 * s2 + r3 * s23))
    slopes = [ca.reshape(ca.jacobian(D, q[k]), 3, 3) for k in range(3)]  # derivative dD/dq_k
    C = ca.SX.zeros(3, 3)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                C[i, j] += 0.5 * (slopes[k][i, j] + slopes[j][i, k] - slopes[i][j, k]) * v[k]
    D_dot = sum((slopes[k] * v[k] for k in range(3)), ca.SX.zeros(3, 3))
    energy = 0.5 * v.T @ D @ v + height
    return ca.Function("lagrangian", [q, v], [D, C, gravity, D_dot, energy])


def random_states(n, seed=0, joints=3):
    rng = np.random.default_rng(seed)
    return zip(
        rng.uniform(-math.pi, math.pi, (n, joints)),
        rng.uniform(-3, 3, (n, joints)),
        rng.uniform(-100, 100, (n, joints)),
        strict=True,
    )


def answer(block, q, v, tau, acceleration=None):
    n = len(q)
    outputs = block.update(0, joint_query=(*q, *v, *tau), reference=acceleration)
    return {
        k: np.reshape(x, (n, n) if k == "mass_matrix" else (6, n) if k == "jacobian" else -1)
        for k, x in outputs.items()
    }


# dynamics node, A1 -----------------------------------------------------------------------------------------------


def test_dynamics_node_gives_the_reference_values():
    result = answer(ByHand(RobotDynamics()), Q, V, np.zeros(3))
    M = [[10.440676, 0, 0], [0, 13.166804, 3.022827], [0, 3.022827, 1.672924]]
    np.testing.assert_allclose(result["mass_matrix"], M, atol=1e-5)
    np.testing.assert_allclose(result["bias"], [-2.299374, 123.854263, 28.000033], atol=1e-5)
    np.testing.assert_allclose(result["gravity"], [0, 124.242844, 27.472338], atol=1e-5)
    np.testing.assert_allclose(
        answer(ByHand(RobotDynamics()), np.zeros(3), V, V)["tool_pose"][:3], [1.69, 0, 0.28], atol=1e-12
    )


def test_the_dynamics_of_the_arm_are_requested_at_each_of_its_samples():
    assert RobotDynamics().p.period == ManipulatorPlant().p.period == VcsController().p.period


def test_dynamics_node_agrees_with_the_lagrangian():
    block = ByHand(RobotDynamics())
    for q, v, tau in random_states(200):
        D, C, gravity, D_dot, _ = (np.array(x) for x in lagrangian()(q, v))
        bias = (C @ v) + gravity.ravel()
        result = answer(block, q, v, tau, tuple(tau / 10))
        np.testing.assert_allclose(result["mass_matrix"], D, atol=1e-9)
        np.testing.assert_allclose(result["bias"], bias, atol=1e-9 * (1 + np.abs(bias).max()))
        np.testing.assert_allclose(result["gravity"], gravity.ravel(), atol=1e-9 * 200)
        np.testing.assert_allclose(result["forward_dynamics"], np.linalg.solve(D, tau - bias), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(result["inverse_dynamics"], D @ tau / 10 + bias, rtol=1e-9, atol=1e-7)
        skew = D_dot - 2 * C
        np.testing.assert_allclose(skew, -skew.T, atol=1e-9)


def test_jacobian_is_the_rate_of_the_tool_pose():
    block, h = ByHand(RobotDynamics()), 1e-6
    before, now, after = (answer(block, Q + k * h * V, V, V) for k in (-1, 0, 1))
    rate = (after["tool_pose"][:3] - before["tool_pose"][:3]) / (2 * h)
    np.testing.assert_allclose(now["jacobian"][:3] @ V, rate, atol=1e-8)
    orientations = [pin.Quaternion(*np.roll(x["tool_pose"][3:], 1)).toRotationMatrix() for x in (before, after)]
    turned = pin.log3(orientations[1] @ orientations[0].T) / (2 * h)
    np.testing.assert_allclose(now["jacobian"][3:] @ V, turned, atol=1e-8)


def test_armature_adds_to_the_diagonal():
    plain, geared = (
        answer(ByHand(RobotDynamics()), Q, V, V, (1.0, 2.0, 3.0)),
        ByHand(RobotDynamics(armature=[2.0, 3.0, 4.0])),
    )
    result = answer(geared, Q, V, V, (1.0, 2.0, 3.0))
    np.testing.assert_allclose(result["mass_matrix"] - plain["mass_matrix"], np.diag([2.0, 3.0, 4.0]), atol=1e-12)
    np.testing.assert_allclose(result["inverse_dynamics"] - plain["inverse_dynamics"], [2, 6, 12], atol=1e-12)
    np.testing.assert_allclose(result["mass_matrix"] @ result["forward_dynamics"], V - result["bias"], atol=1e-11)


def test_a_rejected_query_is_not_answered():
    """Nothing is published with its stamp: a subscriber would take it for the answer."""
    rig, world = rig_of("manipulator_adsmc_two_link"), World()
    others = [m.name for m in rig.members if m.name != "robot_dynamics"]
    run = SimulatedRig(rig, world, "realtime", without=others)
    world.match()
    (reader,) = [r for r in world.readers if r.topic == "/joint_states"]
    layout = run.adapters["robot_dynamics"].inputs[0].port.layout()
    answers = []
    for k, q in enumerate((0.1, math.nan, 0.3)):
        stamp = run.epoch + k * 20_000_000
        world.run(stamp)
        world.now = stamp
        reader.receive(layout.encode(stamp, (q, 0.2, 0.0, 0.0, 0.0, 0.0)))
        world.run(stamp + 19_000_000)
        answers.append({name: len(topic.data) for name, topic in run.recording.topics.items() if topic.data})
    topics = {p.topic for p in run.adapters["robot_dynamics"].block.ports(run.adapters["robot_dynamics"].block.p)[1]}
    assert answers == [dict.fromkeys(topics, n) for n in (1, 1, 2)]
    assert run.adapters["robot_dynamics"].inputs[0].refused == 1


def test_description_and_markers_for_viewers():
    block = ByHand(RobotDynamics())
    answer(block, np.zeros(3), V, V)
    assert block.block.latched() == {"robot_description": (URDF / "manipulator.urdf").read_text()}
    lines, balls = marker_array(2_500_000_000, block.markers()).markers
    assert (lines.ns, balls.ns, lines.header.frame_id, lines.header.stamp.sec) == ("links", "joints", "base_link", 2)
    assert len(lines.points) == 8
    assert [(p.x, p.y, p.z) for p in balls.points] == [(0, 0, 0), (0, 0, 0.28), (0.76, 0, 0.28), (1.69, 0, 0.28)]


# the robot as casadi and as compiled plant -----------------------------------------------------------------------


def test_committed_urdf_is_what_the_tables_give():
    assert (URDF / "manipulator.urdf").read_text() == manipulator_urdf()


SLIDER = """<robot name="slider"><link name="base_link"/>
<joint name="rail" type="prismatic"><parent link="base_link"/><child link="cart"/><axis xyz="0.6 0 0.8"/>
<origin xyz="0 0.1 0" rpy="0.1 0.2 0.3"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="cart"><inertial><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="left" type="revolute"><parent link="cart"/><child link="arm"/><axis xyz="0 0.6 0.8"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="arm"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="0" iyz="0.002"/></inertial></link>
<joint name="right" type="revolute"><parent link="cart"/><child link="tool"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="tool"><inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>
<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.mark.parametrize("urdf", [manipulator_urdf(), read_urdf(TWO_LINK), SLIDER], ids=["arm", "two_link", "tree"])
def test_symbolic_dynamics_equal_pinocchios(urdf):
    model = load_model(urdf)
    n, tool = model.nv, model.getFrameId("tool")
    q, v, tau, armature, load = (ca.SX.sym(s, k) for s, k in zip("qvtal", (n, n, n, n, 1), strict=True))
    robot = SymbolicRobot(model, "tool")
    f = ca.Function(
        "f", [q, v, tau, armature, load], [robot.forward_dynamics(q, v, tau, armature, load), robot.tool_position(q)]
    )
    frame = model.frames[tool]
    ball = pin.Inertia(1.7, np.zeros(3), np.zeros((3, 3)))
    model.inertias[frame.parentJoint] += frame.placement.act(ball)
    model.armature = np.arange(1.0, n + 1.0)
    data = model.createData()
    for qk, vk, tk in random_states(200, joints=n):
        acceleration, place = f(qk, vk, tk, model.armature, 1.7)
        np.testing.assert_allclose(
            np.array(acceleration).ravel(), pin.aba(model, data, qk, vk, tk), rtol=1e-10, atol=1e-10
        )
        pin.framesForwardKinematics(model, data, qk)
        np.testing.assert_allclose(np.array(place).ravel(), data.oMf[tool].translation, atol=1e-12)


def free_swing(h, duration=2.0):
    """Trajectory of the arm without motors by the compiled step."""
    step, _, n = compile_robot(manipulator_urdf(), "tool")
    circuit = (1.0,) * n + (1.0,) * n  # R and L; no torque constant, inertia, damping or friction
    plant = (*circuit, *(0.0,) * (7 * n), 1.0, 1.0, 0.0)
    x = (0.3, 0.5, -0.4, 0.5, -0.2, 0.3, 0.0, 0.0, 0.0)
    states = [x]
    for _ in range(round(duration / h)):
        x = step((*x, *(0.0,) * (2 * n + 3), *plant, h))
        states.append(x)
    return np.array(states)


def test_free_swing_meets_its_numbers_and_keeps_its_energy():
    x = free_swing(1e-3)
    np.testing.assert_allclose(x[-1, :3], [3.367422, -1.287106, 1.218483], atol=1e-6)
    np.testing.assert_allclose(x[-1, 3:6], [1.545265, 3.488168, 7.522601], atol=2e-6)
    energy = np.array([float(lagrangian()(s[:3], s[3:6])[4]) for s in x[::20]])
    assert energy[0] == pytest.approx(156.486508, abs=1e-6)
    assert np.abs(energy - energy[0]).max() <= 1e-6


def test_plant_agrees_with_an_independent_integrator():
    plant = ByHand(
        ManipulatorPlant(
            position=[0.2, -0.4, 0.6], velocity=[0.5, 0.1, -0.3], disturbance={"time": 0.05}, payload=1.5, substeps=8
        )
    )
    model = load_model(manipulator_urdf())
    model.inertias[3] += pin.SE3(np.eye(3), np.array([0.93, 0, 0])).act(pin.Inertia(1.5, np.zeros(3), np.zeros((3, 3))))
    model.armature = np.full(3, 2.0)
    data = model.createData()
    volts = np.array([5.0, -8.0, 3.0])

    def derivative(t, x, drop):
        q, v, i = x[:3], x[3:6], x[6:]
        rate = pin.aba(model, data, q, v, 26.0 * i - 10.0 * v)
        return np.concatenate([v, rate, (volts - drop - 1.26 * i - 26.0 * v) / 1e-3])

    x = np.array([0.2, -0.4, 0.6, 0.5, 0.1, -0.3, 0, 0, 0])
    for begin, end, drop in ((0.0, 0.05, 0.0), (0.05, 0.2, 2.0)):
        x = solve_ivp(derivative, (begin, end), x, args=(drop,), method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    for k in range(200):
        plant.advance(k * 1_000_000, motor_command=tuple(volts))
    np.testing.assert_allclose(numbers(plant.x), x, atol=2e-9)


def test_substeps_converge_with_fourth_order():
    def positions(substeps):
        plant = ByHand(ManipulatorPlant(position=-0.1, substeps=substeps))
        for k in range(200):
            plant.advance(k * 1_000_000, motor_command=(10.0 * math.sin(k / 20), 20.0, -5.0))
        return np.array(plant.x.q)

    exact = positions(32)
    error = {n: np.abs(positions(n) - exact).max() for n in (1, 2, 4)}
    assert error[1] < 1e-6
    assert error[2] < 5e-8
    assert 10 < error[1] / error[2] < 40
    assert 10 < error[2] / error[4] < 30


def test_without_a_compiler_the_same_numbers(monkeypatch, tmp_path):
    fast = ByHand(ManipulatorPlant(position=-0.1))
    monkeypatch.setattr(compiled, "build", lambda function: None)
    compile_robot.cache_clear()
    slow = ByHand(ManipulatorPlant(position=-0.1))
    compile_robot.cache_clear()
    assert fast.block._step.native
    assert not slow.block._step.native
    for k in range(100):
        fast.advance(k * 1_000_000, motor_command=(10.0, -20.0, 5.0))
        slow.advance(k * 1_000_000, motor_command=(10.0, -20.0, 5.0))
    np.testing.assert_allclose(numbers(fast.x), numbers(slow.x), rtol=1e-12)


def test_outputs_are_the_reference_values():
    plant = ByHand(ManipulatorPlant(position=0.1, velocity=0.2))
    plant.x = plant.x._replace(i=(1.0, 2.0, 3.0))
    outputs = plant.outputs(0)
    assert outputs["joint_states"] == pytest.approx((0.1,) * 3 + (0.2,) * 3 + (26.0, 52.0, 78.0))
    assert outputs["motor_states"] == pytest.approx((10.0,) * 3 + (20.0,) * 3 + (1.0, 2.0, 3.0))


# laws ------------------------------------------------------------------------------------------------------------


# scenarios, A2 to A6 and stretch ---------------------------------------------------------------------------------


@functools.cache
def run(name, duration=None, **overrides):
    scenario = load_scenario(name, {k.replace("__", "."): v for k, v in overrides.items()})
    if duration:
        scenario = scenario.model_copy(update={"duration": duration})
    return Signals(in_process(rig_of(scenario)))


# Each law, the published voltages, two links and the stretch run daily; the others differ only in numbers.
LATER = {f"manipulator_adsmc_{n}" for n in ("s2", "s2b", "s3", "s4_printed_mu1", "s6_large_a2_b2", "s6_small_a1_b1",
                                            "stretch_minus", "stretch_plus", "siciliano")}  # fmt: skip
NAMES = sorted(n for n in list_scenarios() if n.startswith("manipulator_adsmc"))


@pytest.mark.parametrize("name", few([pytest.param(n, marks=[pytest.mark.long] * (n in LATER)) for n in NAMES], 1))
def test_scenario_meets_its_numbers(name):
    result = evaluate(rig_of(name), run(name))
    assert any(m.judged for m in result)
    assert [f"{m.name} = {m.value}" for m in result if not m.passed] == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("period", "substeps"), [*(pytest.param(T, 1, marks=pytest.mark.long) for T in (1e-4, 5e-4)), (2e-3, 4), (4e-3, 8)]
)
def test_control_period_hardly_matters(period, substeps):
    nodes = ("manipulator_plant", "trajectory_source", "vcs_controller")
    overrides = {f"{n}__period": period for n in nodes} | {"manipulator_plant__substeps": substeps}
    other, nominal = (run("manipulator_adsmc", 7.0, **o) for o in (overrides, {}))
    for signal in E_SIGNAL:
        assert measures.peak(other, signal) == pytest.approx(measures.peak(nominal, signal), rel=0.05)


@pytest.mark.long
def test_the_laws_rank_as_published():
    adsmc, dsmc, smc = (run(f"manipulator_adsmc{s}") for s in ("", "_s4", "_s5"))
    for e, v in zip(E_SIGNAL, V_SIGNAL, strict=True):
        assert measures.rms(adsmc, e) < measures.rms(dsmc, e) / 10
        assert measures.total_variation(smc, v, start=2.5) > 500 * measures.total_variation(adsmc, v, start=2.5)


@pytest.mark.long
@pytest.mark.parametrize("position", [-0.1, 0.1])
def test_high_gains_run_away_only_if_the_estimate_may_wind_up(position):
    options = {f"vcs_controller__adsmc__{k}": v for k, v in HIGH.items()} | {"manipulator_plant__position": position}
    guarded = run("manipulator_adsmc", **options)
    free = run("manipulator_adsmc", vcs_controller__adapt_at_limit=True, **options)
    worst = 0.0
    for e in E_SIGNAL:
        assert measures.peak(guarded, e) <= 0.1002
        assert measures.peak(guarded, e, start=2.0) <= 0.00011
        worst = max(worst, measures.peak(free, e))
    assert worst > 1.0


def test_replayed_commands_reproduce_the_motion():
    signals = run("manipulator_adsmc_s4", 3.0)
    commands = np.array([signals[v].x for v in V_SIGNAL]).T.tolist()
    positions = np.array([signals[f"joint_states/joint{i}/position"].x for i in (1, 2, 3)]).T
    plant = ByHand(ManipulatorPlant())
    for k, command in enumerate(commands):
        np.testing.assert_allclose(plant.x.q, positions[k], atol=1e-9)
        plant.advance(k * 1_000_000, motor_command=tuple(command))


def test_equal_runs_are_equal_bit_for_bit():
    scenario = load_scenario("manipulator_adsmc").model_copy(update={"duration": 0.5})
    first, second = (in_process(rig_of(scenario)) for _ in range(2))
    assert differences(first, second) == []


# bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('type="revolute"', 'type="planar"'), "joint elbow is of type 'planar'"),
        (('<mass value="1.2"/>', '<mass value="-1"/>'), "link forearm: mass = -1 kg"),
        (('iyy="0.012"', 'iyy="0.12"'), "link forearm: inertia .*triangle"),
        (("<robot", "<rabot"), "URDF"),
    ],
)
def test_impossible_urdf_is_refused(change, message):
    text = read_urdf(TWO_LINK)
    at = text.rindex(change[0])
    with pytest.raises(ValueError, match=message):
        load_model(text[:at] + text[at:].replace(*change, 1))


def test_a_continuous_joint_has_its_angle_and_poses_are_in_the_frame_of_the_robots_root(tmp_path):
    text = read_urdf(TWO_LINK)
    file = tmp_path / "endless.urdf"
    file.write_text(text.replace('type="revolute"', 'type="continuous"').replace("base_link", "pedestal"))
    names = tuple(load_model(text).names)[1:]
    limited, endless = (ByHand(RobotDynamics(urdf=source, joints=names)) for source in (TWO_LINK, str(file)))
    query = {"joint_query": (0.3, -1.1, 0.2, 0.4, 1.0, -2.0), "reference": None}
    assert endless.update(0, **query) == limited.update(0, **query)
    pose = next(p for p in endless.block.ports(endless.block.p)[1] if p.name == "tool_pose")
    assert pose.frame_id == "pedestal"
    assert {m.frame_id for m in endless.markers()} == {"pedestal"}


def test_reference_without_accelerations_is_refused():
    scenario = load_scenario("manipulator_adsmc")
    source = scenario.nodes["trajectory_source"].model_copy(
        update={
            "package": "softrig_control",
            "executable": "reference_source",
            "parameters": {"channels": ["joint1", "joint2", "joint3"], "positions": [0.0] * 3, "velocities": [0.0] * 3},
        }
    )
    nodes = scenario.nodes | {"trajectory_source": source}
    with pytest.raises(ScenarioError, match="lack acceleration"):
        rig_of(scenario.model_copy(update={"nodes": nodes}))


def test_overspeed_ends_the_run_at_the_last_good_state():
    plant = ByHand(ManipulatorPlant(speed_limit=0.2))
    states = [plant.x]

    def drive():
        for k in range(1000):
            plant.advance(k * 1_000_000, motor_command=(40.0, 40.0, 40.0))
            states.append(plant.x)

    with pytest.raises(RunError, match=r"limit 0\.2: integration stopped at t = 0\.\d+ s"):
        drive()
    assert plant.x == states[-1]
    assert max(map(abs, plant.x.v)) <= 0.2


def test_state_that_is_not_finite_ends_the_run():
    plant = ByHand(ManipulatorPlant(speed_limit=1e12))
    plant.x = plant.x._replace(v=(1e200,) * 3)
    before = plant.x
    with pytest.raises(RunError, match="integration stopped"):
        plant.advance(0, motor_command=(0.0, 0.0, 0.0))
    assert plant.x == before


def test_links_given_as_parameters_change_the_robot():
    heavy = ByHand(ManipulatorPlant(links=Links(mass=(19.0, 18.18, 30.0))))
    light = ByHand(ManipulatorPlant())
    for plant in (heavy, light):
        for k in range(50):
            plant.advance(k * 1_000_000, motor_command=(0.0, 0.0, 0.0))
    assert heavy.x.q[1] < 1.2 * light.x.q[1] < 0.0
