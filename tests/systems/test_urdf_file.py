"""URDF of users: each tag and attribute of the table has its effect, is reported, or is refused; joints against
pinocchio.
"""

import math

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from softrig_core import ByHand
from softrig_robots.driven_robot import compile_robot
from softrig_robots.dynamics import RobotDynamics
from softrig_robots.manipulator.plant import ManipulatorParams, ManipulatorPlant
from softrig_robots.rigid_body import SymbolicRobot, frame_id, load_model, ties
from softrig_robots.urdf import read_urdf
from softrig_robots.urdf_file import URDF, read_robot

FULL = """<robot name="arm" version="1.1">
<link name="base"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 1" rpy="0 0.1 0"/>
<axis xyz="0 1 0"/><dynamics damping="0.5" friction="0.2"/>
<limit lower="-1" upper="1.5" effort="20" velocity="3"/></joint>
<link name="a"><inertial><origin xyz="0 0 -0.2" rpy="0.1 0 0"/><mass value="2"/>
<inertia ixx="0.020" ixy="0.001" ixz="0.002" iyy="0.030" iyz="0.003" izz="0.040"/></inertial></link>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0.1 -0.4"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="10" velocity="4"/><mimic joint="j1" multiplier="-1.5" offset="0.2"/></joint>
<link name="b"><inertial><origin xyz="0.1 0 -0.1"/><mass value="1"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
<joint name="j3" type="prismatic"><parent link="b"/><child link="tool"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="10" velocity="4"/></joint>
<link name="tool"><inertial><mass value="0.5"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link></robot>"""
JOINTS = ("j1", "j2", "j3")

# : For each used name: a part of `FULL`, and a replacement with another meaning.
CHANGES = {
    "robot@version": ('version="1.1"', 'version="3"'),
    "link@name": ('<link name="b">', '<link name="c">'),
    "link/inertial": (FULL[FULL.index("<inertial>") : FULL.index("</inertial>") + 11], ""),
    "link/inertial/origin": ('<origin xyz="0 0 -0.2" rpy="0.1 0 0"/>', ""),
    "link/inertial/origin@xyz": ('xyz="0 0 -0.2"', 'xyz="0 0 -0.3"'),
    "link/inertial/origin@rpy": ('rpy="0.1 0 0"', 'rpy="0.2 0 0"'),
    "link/inertial/origin@quat_xyzw": ('rpy="0.1 0 0"', 'quat_xyzw="0 0 0.6 0.8"'),
    "link/inertial/mass": ('<mass value="2"/>', ""),
    "link/inertial/mass@value": ('<mass value="2"', '<mass value="3"'),
    "link/inertial/inertia": ('<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>', ""),
    **{
        f"link/inertial/inertia@{key}": (f'{key}="{value}"', f'{key}="{2 * float(value) / 1.9}"')
        for key, value in zip(
            ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
            ("0.020", "0.001", "0.002", "0.030", "0.003", "0.040"),
            strict=True,
        )
    },
    "joint": ('<joint name="j3"', '<gelenk name="j3"'),
    "joint@name": ('"j3"', '"j4"'),
    "joint@type": ('name="j1" type="revolute"', 'name="j1" type="continuous"'),
    "joint/parent": ('<parent link="a"/>', ""),
    "joint/parent@link": ('<parent link="a"/>', '<parent link="base"/>'),
    "joint/child": ('<child link="b"/>', ""),
    "joint/child@link": ('<child link="b"/>', '<child link="x"/>'),
    "joint/origin": ('<origin xyz="0 0 1" rpy="0 0.1 0"/>', ""),
    "joint/origin@xyz": ('xyz="0 0 1"', 'xyz="0 1 1"'),
    "joint/origin@rpy": ('rpy="0 0.1 0"', 'rpy="0 0.2 0"'),
    "joint/origin@quat_xyzw": ('rpy="0 0.1 0"', 'quat_xyzw="0.6 0 0 0.8"'),
    "joint/axis": ('<axis xyz="0 0 1"/>', ""),
    "joint/axis@xyz": ('<axis xyz="0 0 1"', '<axis xyz="0 1 1"'),
    "joint/dynamics": ('<dynamics damping="0.5" friction="0.2"/>', ""),
    "joint/dynamics@damping": ('damping="0.5"', 'damping="0.6"'),
    "joint/dynamics@friction": ('friction="0.2"', 'friction="0.3"'),
    "joint/limit": ('<limit lower="-1" upper="1.5" effort="20" velocity="3"/>', ""),
    "joint/limit@lower": ('lower="-1"', 'lower="-1.1"'),
    "joint/limit@upper": ('upper="1.5"', 'upper="1.6"'),
    "joint/limit@effort": ('effort="20"', 'effort="21"'),
    "joint/limit@velocity": ('velocity="3"', 'velocity="5"'),
    "joint/mimic": ('<mimic joint="j1" multiplier="-1.5" offset="0.2"/>', ""),
    "joint/mimic@joint": ('mimic joint="j1"', 'mimic joint="j3"'),
    "joint/mimic@multiplier": ('multiplier="-1.5"', 'multiplier="2"'),
    "joint/mimic@offset": ('offset="0.2"', 'offset="0.3"'),
}
# Published with the file, but not used by any number.
FOR_VIEWERS = {"robot@name", "link", "link/visual/**", "material/**", "ros2_control/**"}  # fmt: skip


def reading(text):
    """All numbers that are read from a robot, or the refusal."""
    try:
        robot, model = read_robot(text), load_model(text)
    except ValueError as error:
        return str(error)
    names = [*model.names, *(f.name for f in model.frames)]
    places = [*model.jointPlacements, *(f.placement for f in model.frames)]
    axes = np.reshape(pin.computeJointJacobians(model, model.createData(), np.full(model.nq, 0.3)), -1).tolist()
    bodies = [i.matrix().tolist() for i in model.inertias]
    return dict(robot.joints), names, [p.homogeneous.tolist() for p in places], bodies, axes


def test_the_table_is_complete():
    used = {name for name, (use, _) in URDF.table.items() if use == "used"}
    assert used == set(CHANGES) | FOR_VIEWERS


@pytest.mark.parametrize("name", CHANGES)
def test_used_items_change_the_robot(name):
    old, new = CHANGES[name]
    assert FULL.count(old) >= 1
    assert reading(FULL.replace(old, new, 1)) != reading(FULL)


def placed(name, body="<x y='1'/>"):
    """`FULL` with an element or attribute."""
    path, _, key = name.removesuffix("/**").partition("@")
    tags = path.split("/")
    if key and len(tags) == 1:
        return FULL.replace(f"<{tags[0]} name=", f"<{tags[0]} {key}='1' name=", 1)
    attribute = f" {key}='1'" if key else ""
    if tags[-1] in ("limit", "mimic"):
        return FULL.replace(f"<{tags[-1]} ", f"<{tags[-1]}{attribute} ", 1)
    inside = body if name.endswith("/**") else ""
    element = f"<{tags[-1]}{attribute}>{inside}</{tags[-1]}>"
    anchor = {"joint": "</joint>", "link": "</link>"}.get(tags[0] if len(tags) > 1 else "", "</robot>")
    return FULL.replace(anchor, element + anchor, 1)


@pytest.mark.parametrize("name", [name for name, (use, _) in URDF.table.items() if use == "ignored"])
def test_ignored_items_are_reported_once_and_change_nothing(name):
    text = placed(name)
    assert reading(text) == reading(FULL)
    shown = name.removesuffix("/**")
    notes = [note for note in read_robot(text).notes if f": {shown} is ignored: " in note]
    assert len(notes) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (placed("xacro/**"), "xacro is refused: expand it first"),
        (placed("loop_joint/**"), "loop_joint is refused"),
        (FULL.replace("<dynamics damping", "<dynamics dampening"), r"dynamics@dampening is no.*/dynamics@damping'"),
        (FULL.replace('<axis xyz="0 0 1"/>', '<axes xyz="0 0 1"/>'), "joint/axes is not part.*mean 'joint/axis'"),
        (FULL.replace('<axis xyz="0 0 1"', '<axis xyz="0 0 0"'), "joint j3: axis@xyz is 0 0 0"),
        (FULL.replace('damping="0.5"', 'damping="0,5"'), "dynamics@damping is '0,5', expected a number"),
        (FULL.replace('<mass value="2"', '<mass value="１"'), "mass@value is '１', expected a number"),
        (FULL.replace('xyz="0 0 1"', 'xyz="0 0 1_0"', 1), "origin@xyz is '0 0 1_0', expected 3 numbers"),
        (FULL.replace('damping="0.5"', 'damping="1e308"'), "'1e308', expected at most 1e\\+12 in magnitude"),
        (FULL.replace('<mass value="2"', '<mass value="1e300"'), "mass@value is '1e300', expected at most"),
        (FULL.replace('xyz="0 0 1"', 'xyz="0 0 -1e200"', 1), "origin@xyz is '0 0 -1e200', expected at most"),
        (FULL.replace('damping="0.5"', 'damping="-0.5"'), "no negative values"),
        (FULL.replace('lower="-1"', 'lower="2"'), "expected lower <= upper"),
        (FULL.replace('mimic joint="j1"', 'mimic joint="nix"'), "j2 mimics 'nix', which is not a moving joint"),
        (FULL.replace('mimic joint="j1"', 'mimic joint="j2"'), "in a circle"),
        (FULL.replace('type="prismatic"', 'type="planar"'), "joint j3 is of type 'planar', expected one of revolute"),
        (FULL.replace('version="1.1"', "").replace('rpy="0 0.1 0"', 'quat_xyzw="0 0 0 1"'), "quat_xyzw needs"),
        (FULL.replace('<limit lower="-1" upper="1.5" effort="20" velocity="3"/>', ""), "needs <limit>"),
        (FULL.replace("<limit lower=", '<limit lower="0" upper="1"/><limit lower=', 1), "<limit> occurs twice"),
        (FULL.replace('<child link="tool"/>', '<child link="b"/>'), "child of two joints"),
        (FULL.replace('izz="0.040"', 'izz="0.400"'), "link a: inertia .*triangle"),
        (FULL.replace('<mass value="2"', '<mass value="-2"'), "link a: mass = -2 kg"),
        ("<robot", "not a URDF"),
        ("<sdf/>", "first tag is <sdf>"),
    ],
)  # fmt: skip
def test_impossible_items_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        read_robot(text)


@pytest.mark.parametrize("number", [" 2", "2 ", "+2", "+2.0e0 ", "&#10;2\t", "0.2E+1"])
def test_a_number_is_the_same_in_every_form(number):
    """urdfdom drops the whole inertial of a link if its mass is followed by a space."""
    assert reading(FULL.replace('<mass value="2"/>', f'<mass value="{number}"/>')) == reading(FULL)


@pytest.mark.parametrize(
    ("encoding", "declared"),
    [("utf-16", "utf-16"), ("utf-8-sig", ""), ("latin-1", "ISO-8859-1"), ("cp1251", "windows-1251")],
)
def test_a_file_is_read_in_the_encoding_that_it_declares(tmp_path, encoding, declared):
    word = "Ж" if encoding == "cp1251" else "Ä"
    text = f"<?xml version='1.0'{f' encoding={declared!r}' if declared else ''}?><!-- {word} -->{FULL}"
    (tmp_path / "a.urdf").write_text(text, encoding=encoding)
    result = read_urdf(str(tmp_path / "a.urdf"))
    assert result == f"<?xml version='1.0'?><!-- {word} -->{FULL}"
    assert reading(result) == reading(FULL)
    (tmp_path / "a.urdf").write_bytes("<!-- Ä -->".encode("latin-1") + FULL.encode())
    with pytest.raises(ValueError, match=r"a\.urdf: its bytes are not utf-8-sig; name it in"):
        read_urdf(str(tmp_path / "a.urdf"))


def test_a_link_is_found_beside_a_joint_of_its_name():
    model = load_model(FULL.replace('"j3"', '"tool"'))
    assert model.frames[frame_id(model, "tool")].type == pin.FrameType.BODY


def test_a_disc_of_rounded_decimals_and_a_rod_without_thickness_are_accepted():
    """r = 0.05 m, 0.333 kg: m r^2/2 = 0.00041625, m r^2/4 = 0.000208125."""
    disc = FULL.replace('ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"', "{}")
    rounded = 'ixx="0.000208" ixy="0" ixz="0" iyy="0.000208" iyz="0" izz="0.000417"'
    read_robot(disc.format(rounded, rounded))
    rod = 'ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0"'
    read_robot(disc.format(rod, rod))
    wrong = 'ixx="0.000208" ixy="0" ixz="0" iyy="0.000208" iyz="0" izz="0.000427"'
    with pytest.raises(ValueError, match="triangle"):
        read_robot(disc.format(wrong, wrong))


UNIVERSAL = (
    FULL.replace('<mimic joint="j1" multiplier="-1.5" offset="0.2"/>', "")
    .replace('<inertial><origin xyz="0 0 -0.2" rpy="0.1 0 0"/>', "<inertial>")
    .replace('<mass value="2"/>', '<mass value="0"/>')
    .replace('ixx="0.020" ixy="0.001" ixz="0.002" iyy="0.030" iyz="0.003" izz="0.040"',
             'ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"')
    .replace('<axis xyz="0 1 0"/>', '<axis xyz="1 0 0"/>', 1)
)  # fmt: skip


def test_a_massless_link_between_two_joints_moves_as_in_pinocchio(tmp_path):
    q, v, tau = [0.3, -0.2, 0.1], [0.4, -1.0, 0.2], [1.0, 2.0, 3.0]
    got = ask(tmp_path, UNIVERSAL.replace('damping="0.5" friction="0.2"', 'damping="0"'), JOINTS, q, v, tau)
    model = pin.buildModelFromXML(UNIVERSAL)
    right = pin.aba(model, model.createData(), np.array(q), np.array(v), np.array(tau))
    assert got["forward_dynamics"] == pytest.approx(right.tolist(), rel=1e-12)
    last = UNIVERSAL.replace('<mass value="0.5"/>', '<mass value="0"/>').replace('"0.01"', '"0"')
    with pytest.raises(ValueError, match="joint j3 moves no mass"):
        ask(tmp_path, last, JOINTS, q, v, tau)


def ask(tmp_path, text, joints, q, v, tau, **more):
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    block = ByHand(RobotDynamics(urdf=str(file), joints=joints, **more))
    return block.update(0, joint_query=(*q, *v, *tau), reference=(0.5,) * len(joints))


def tied(urdf=FULL):
    """S and q0 with q = S q' + q0, of joints without those that follow."""
    model = pin.buildModelFromXML(urdf)
    S, q0 = np.array([[1.0, 0.0], [-1.5, 0.0], [0.0, 1.0]]), np.array([0.0, 0.2, 0.0])
    return model, S, q0


def test_a_mimic_joint_is_a_constraint_in_mass_matrix_and_bias(tmp_path):
    """S'MS and S'h, with M and h of pinocchio's model without the constraint; damping and friction added."""
    model, S, q0 = tied()
    data = model.createData()
    q, v, tau, edge = np.array([0.3, 0.1]), np.array([0.7, -0.2]), np.array([2.0, 3.0]), 0.1
    got = ask(tmp_path, FULL, ("j1", "j3"), q, v, tau, edge_speed=edge)
    M = S.T @ pin.crba(model, data, S @ q + q0) @ S
    rubbing = np.array([0.5 * 0.7 + 0.2 * math.tanh(0.7 / edge), 0.0])
    h = S.T @ pin.nonLinearEffects(model, data, S @ q + q0, S @ v) + rubbing
    assert got["mass_matrix"] == pytest.approx(M.ravel().tolist(), rel=1e-12)
    assert got["bias"] == pytest.approx(h.tolist(), rel=1e-12)
    assert got["forward_dynamics"] == pytest.approx(np.linalg.solve(M, tau - h).tolist(), rel=1e-10)
    assert got["inverse_dynamics"] == pytest.approx((M @ [0.5, 0.5] + h).tolist(), rel=1e-12)
    full = pin.computeFrameJacobian(
        model, data, S @ q + q0, model.getFrameId("tool"), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    )
    assert got["jacobian"] == pytest.approx((full @ S).ravel().tolist(), abs=1e-12)
    pin.framesForwardKinematics(model, data, S @ q + q0)
    assert got["tool_pose"][:3] == pytest.approx(data.oMf[model.getFrameId("tool")].translation.tolist(), abs=1e-12)


def test_the_plants_mimic_joint_has_the_accelerations_of_the_reduced_equations():
    model, S, q0 = tied()
    data = model.createData()
    names = ca.SX.sym
    q, v, tau = names("q", 3), names("v", 3), names("t", 3)
    rotors = np.array([0.1, 0.2, 0.3])
    robot = SymbolicRobot(load_model(FULL), "tool", ties(FULL, JOINTS))
    f = ca.Function("f", [q, v, tau], [robot.forward_dynamics(q, v, tau, ca.SX(rotors), ca.SX(0.0))])
    for k in range(20):
        qk, vk = np.sin([k, 2.0 + k]), np.cos([3.0 * k, k])
        torque = 5.0 * np.sin([k, 2.0 * k, 3.0 * k])
        full = pin.crba(model, data, S @ qk + q0)
        M = S.T @ (np.triu(full) + np.triu(full, 1).T + np.diag(rotors)) @ S
        h = S.T @ pin.nonLinearEffects(model, data, S @ qk + q0, S @ vk)
        right = S @ np.linalg.solve(M, S.T @ torque - h)
        np.testing.assert_allclose(f(S @ qk + q0, S @ vk, torque).full().ravel(), right, rtol=1e-9, atol=1e-9)


def plant(tmp_path, text=FULL, **more):
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    return ByHand(ManipulatorPlant(urdf=str(file), joints=JOINTS, **more))


def test_mimic_joints_stay_together_over_a_run(tmp_path):
    p = plant(tmp_path, position=[0.1], velocity=[0.3], limits="act")
    assert p.x.q[1] == pytest.approx(-1.5 * 0.1 + 0.2)
    for k in range(500):
        p.advance(k * 10**6, motor_command=(30.0, 0.0, 5.0))
    assert p.x.q[1] == pytest.approx(-1.5 * p.x.q[0] + 0.2, abs=1e-9)
    assert p.x.q[0] > 0.15
    with pytest.raises(ValueError, match=r"j2 mimics j1 and begins at 0.05"):
        plant(tmp_path, position=[0.1, 0.1, 0.0])


PENDULUM = """<robot name="p"><link name="base"/><joint name="hinge" type="revolute"><parent link="base"/>
<child link="tool"/><axis xyz="0 1 0"/>{}<limit lower="-1" upper="1" effort="{}" velocity="2"/></joint>
<link name="tool"><inertial><mass value="2"/><inertia ixx="0.5" iyy="0.5" izz="0.5" ixy="0" ixz="0" iyz="0"/>
</inertial></link></robot>"""


def pendulum(tmp_path, dynamics="", effort=1e3, **more):
    file = tmp_path / "p.urdf"
    file.write_text(PENDULUM.format(dynamics, effort))
    motors = {"inertia": [0.0], "damping": [0.0], "torque_constant": [1.0], "back_emf_constant": [1e-9], "gear": [1.0]}
    return ByHand(ManipulatorPlant(urdf=str(file), joints=("hinge",), motors=motors, **more))


@pytest.mark.parametrize(
    ("dynamics", "v0", "v"),
    [('damping="0.4"', 0.5, 0.5 * math.exp(-0.4 / 0.5)), ('friction="0.1"', 0.9, 0.9 - 0.1 / 0.5)],
)
def test_damping_and_friction_of_the_file_slow_a_wheel_down(tmp_path, dynamics, v0, v):
    """I v' = -d v: v = v0 exp(-d t/I), and I v' = -F above the edge speed: v = v0 - F t/I; I = 0.5 kg m^2."""
    p = pendulum(tmp_path, f"<dynamics {dynamics}/>", velocity=[v0], edge_speed=0.02)
    for k in range(1000):
        p.advance(k * 10**6, motor_command=(0.0,))
    assert p.x.v[0] == pytest.approx(v, rel=1e-7)


def test_friction_too_steep_for_the_step_is_refused_with_the_needed_substeps(tmp_path):
    with pytest.raises(ValueError, match=r"substeps = 2: expected at least 4 for damping and friction"):
        # The friction needs 50/0.01/0.5 = 10,000 1/s.
        pendulum(tmp_path, '<dynamics friction="50"/>', edge_speed=0.01)


def test_one_joint_behaves_as_a_pendulum(tmp_path):
    """I = 0.5 kg m^2 about its axis: the centre of mass is on it, so there is no gravity; I a + d v = tau."""
    got = ask(tmp_path, PENDULUM.format('<dynamics damping="0.4"/>', 1.0), ("hinge",), [0.3], [2.0], [1.0])
    assert got["mass_matrix"] == (0.5,)
    assert got["bias"] == pytest.approx((0.4 * 2.0,))
    assert got["forward_dynamics"] == pytest.approx(((1.0 - 0.8) / 0.5,))
    assert got["jacobian"] == pytest.approx((0, 0, 0, 0, 1, 0))


def test_limits_are_reported_or_enforced(tmp_path):
    p = pendulum(tmp_path, effort=1.5)
    for k in range(1000):
        p.advance(k * 10**6, motor_command=(2.6,))
    entries = {key: text for key, (_, text, _) in p.reports.items()}
    assert set(entries) == {"position limit of hinge", "velocity limit of hinge", "effort limit of hinge"}
    assert "is outside of -1 to 1, the limits of " in entries["position limit of hinge"]
    assert p.x.q[0] > 1.5
    p = pendulum(tmp_path, effort=1.5, limits="act")
    for k in range(600):
        p.advance(k * 10**6, motor_command=(2.6,))
    assert p.x.v[0] == pytest.approx(1.5 / 0.5 * 0.6, rel=2e-2)  # the drive is limited to 1.5 N m
    assert p.block.outputs(p.x, 0)["joint_states"][2] == 1.5
    for k in range(600, 1200):
        p.advance(k * 10**6, motor_command=(2.6,))
    assert (p.x.q[0], p.x.v[0]) == (1.0, 0.0)  # at rest at its end stop
    for k in range(1200, 1300):
        p.advance(k * 10**6, motor_command=(-2.6,))
    assert p.x.q[0] < 1.0  # moves away from its end stop
    with pytest.raises(ValueError, match="limits: act needs joint hinge within its limits"):
        pendulum(tmp_path, limits="act", position=[1.2])


def test_a_joint_may_have_an_end_on_one_side(tmp_path, monkeypatch):
    monkeypatch.setattr("test_urdf_file.PENDULUM", PENDULUM.replace('lower="-1"', 'lower="-inf"'))
    for speed, place in ((1.9, 1.0), (-1.9, -1.9 * 0.8)):
        p = pendulum(tmp_path, limits="act", velocity=[speed])
        for k in range(800):
            p.advance(k * 10**6, motor_command=(0.0,))
        assert p.x.q[0] == pytest.approx(place, rel=1e-6)


def test_an_impact_on_an_end_stop_has_the_impulse_of_the_mass_matrix():
    """v+ = v - M^-1 e_i v_i/(M^-1)_ii, M of pinocchio, and the speed of the stopped joint 0."""
    text = FULL.replace('<mimic joint="j1" multiplier="-1.5" offset="0.2"/>', "").replace('upper="1.5"', 'upper="0.3"')
    step, _, n = compile_robot(text, "tool", True)
    model = pin.buildModelFromXML(text)
    q, v = np.array([0.3, 0.2, 0.1]), np.array([0.8, -0.5, 0.4])
    circuit = (1.0,) * n + (1.0,) * n + (0.0,) * (7 * n) + (1.0, 1.0, 0.0)
    h = 1e-9
    after = np.array(step((*q, *v, *(0.0,) * n, *(0.0,) * (2 * n + 3), *circuit, h)))[n : 2 * n]
    M = pin.crba(model, model.createData(), q)
    inverse = np.linalg.inv(np.triu(M) + np.triu(M, 1).T)
    np.testing.assert_allclose(after, v - inverse[:, 0] * v[0] / inverse[0, 0], atol=1e-6)
    assert after[0] == pytest.approx(0.0, abs=1e-12)


def test_notes_of_a_file_are_reported_by_the_nodes_that_read_it(tmp_path):
    text = placed("gazebo/**")
    block = plant(tmp_path, text)
    assert any("gazebo is ignored: settings of another simulator" in text for _, text, _ in block.reports.values())
    file = tmp_path / "robot.urdf"
    block = ByHand(RobotDynamics(urdf=str(file), joints=("j1", "j3")))
    assert any("gazebo is ignored" in text for _, text, _ in block.reports.values())
    assert ManipulatorParams().start("position") == (0.0, 0.0, 0.0)
