"""The torque-driven arm and its controllers: against pinocchio, and against the closed form of the error."""

import math

import numpy as np
import pinocchio as pin
import pytest
from softrig_core import ByHand, ScenarioError, rig_of, simulate
from softrig_core.rig.members import signal_units
from softrig_robots.arm.controller import ArmController, ArmControllerParams
from softrig_robots.arm.model import compile_arm
from softrig_robots.arm.plant import ArmPlant, ArmPlantParams
from softrig_robots.rigid_body import load_model
from softrig_robots.urdf import read_urdf

TWO = "package://softrig_robots/urdf/two_link.urdf"
THREE = "package://softrig_robots/urdf/manipulator.urdf"


@pytest.mark.parametrize(("urdf", "joints"), [(TWO, ("shoulder", "elbow")), (THREE, ("joint1", "joint2", "joint3"))])
def test_the_functions_equal_those_of_pinocchio(urdf, joints):
    """Torques by rnea, the tool and its Jacobian by frames, rotor inertias in both."""
    text = read_urdf(urdf)
    arm, model = compile_arm(text, "tool", joints, 0.05), load_model(text)
    n, draw, data = len(joints), np.random.default_rng(3), model.createData()
    armature = np.full(n, 0.07)
    model.armature = armature
    for _ in range(5):
        q, v, a = draw.uniform(-2.0, 2.0, (3, n))
        wanted = pin.rnea(model, data, q, v, a)
        assert arm.inverse((*q, *v, *a, *armature, 0.0)) == pytest.approx(wanted, rel=1e-10, abs=1e-10)
        result = arm.tool(tuple(q))
        pin.framesForwardKinematics(model, data, q)
        frame = model.getFrameId("tool")
        assert result[:3] == pytest.approx(data.oMf[frame].translation, abs=1e-12)
        jacobian = pin.computeFrameJacobian(model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3]
        assert result[3:] == pytest.approx(jacobian.ravel(), abs=1e-12)
        moved = arm.step((*q, *v, *wanted, 0.0, 0.0, 0.0, 1e-6, *armature, 0.0))
        assert (np.array(moved[n:]) - v) / 1e-6 == pytest.approx(a, abs=1e-3)


def closed(law, position, wanted, ticks, force=None, **gains):
    plant = ByHand(ArmPlant(ArmPlantParams(position=position, payload=0.3)))
    control = ByHand(ArmController(ArmControllerParams(law=law, payload=0.3, **gains)))
    rows = []
    for k in range(ticks):
        t = k * 1_000_000
        states = plant.outputs(t)["joint_states"]
        rows.append(states[:2])
        torques = control.update(t, joint_states=states[:4], reference=(*wanted, 0.0, 0.0, 0.0, 0.0))["joint_torques"]
        plant.advance(t, joint_torques=torques, tool_force=None if force is None else (*force, 0.0, 0.0, 0.0))
    return np.array(rows), plant


def test_computed_torque_leaves_a_linear_error():
    """e = e_0 (1 + w t) exp(-w t) of each joint by itself, for K_p = w^2, K_d = 2 w."""
    rows, _ = closed("computed_torque", (0.5, -0.3), (0.0, 0.4), 600, kp=100.0, kd=20.0)
    t = 1e-3 * np.arange(600)
    shape = (1.0 + 10.0 * t) * np.exp(-10.0 * t)
    assert rows[:, 0] == pytest.approx(0.5 * shape, abs=4e-3)
    assert rows[:, 1] - 0.4 == pytest.approx(-0.7 * shape, abs=6e-3)


def test_pd_with_gravity_rests_at_its_reference():
    rows, _ = closed("pd_gravity", (0.4, 0.3), (0.5, 0.2), 3000, kp=(150.0, 60.0), kd=(30.0, 8.0))
    assert rows[-1] == pytest.approx((0.5, 0.2), abs=1e-4)


def test_the_tool_is_displaced_by_force_over_stiffness():
    q = (0.5, 0.9)
    rows, _ = closed("impedance", q, q, 3000, force=(0.0, 0.0, 0.0), stiffness=2000.0, damping=100.0, kd=1.0)
    assert rows[-1] == pytest.approx(q, abs=1e-6)
    arm = compile_arm(read_urdf(TWO), "tool", ("shoulder", "elbow"), 0.05)
    place = np.array(arm.tool(q))
    jacobian = place[3:].reshape(3, 2)
    # This force lies in the plane of the arm.
    force = jacobian @ np.linalg.solve(jacobian.T @ jacobian, np.array([1.0, 0.5]))
    force *= 4.0 / np.linalg.norm(force)
    rows, _ = closed("impedance", q, q, 4000, force=tuple(force), stiffness=2000.0, damping=100.0, kd=1.0)
    shift = np.array(arm.tool(tuple(rows[-1]))[:3]) - place[:3]
    assert shift == pytest.approx(force / 2000.0, abs=2e-5)


def test_limits_hold_and_impossible_parameters_are_refused():
    plant = ByHand(ArmPlant(ArmPlantParams(torque_limit=(5.0, 1.0))))
    plant.advance(0, joint_torques=(100.0, -100.0), tool_force=None)
    assert plant.outputs(0)["joint_states"][4:] == (5.0, -1.0)
    for params, values, text in (
        (ArmPlantParams, {"position": (0.0, 0.0, 0.0)}, "position"),
        (ArmPlantParams, {"joints": ("a", "b")}, "shoulder"),
        (ArmPlantParams, {"tool": "hand"}, "no frame 'hand'"),
        (ArmControllerParams, {"kp": (-1.0,)}, "kp"),
    ):
        with pytest.raises(ValueError, match=text):
            params(**values)
    law = ByHand(ArmController(ArmControllerParams()))
    assert law.refused(0)["joint_torques"] == (0.0, 0.0)


def test_the_scenario_settles_as_the_closed_form_says():
    run = simulate("arm_computed_torque")
    assert not run.missed
    x = 3.8897201698674  # (1 + x) exp(-x) = 0.1
    assert (1.0 + x) * math.exp(-x) == pytest.approx(0.1)
    assert run.figures["settling_1"] == pytest.approx(x / 10.0, abs=2e-3)


def test_a_linear_joint_has_its_own_units(tmp_path):
    """By the joint's kind in the URDF; a reference in rad is refused, one that declares it linear is accepted."""
    text = read_urdf(TWO)
    at = text.index('name="elbow"')
    (tmp_path / "lift.urdf").write_text(text[:at] + text[at:].replace('type="revolute"', 'type="prismatic"', 1))
    changes = {f"{node}.urdf": str(tmp_path / "lift.urdf") for node in ("arm_plant", "arm_controller")}
    with pytest.raises(ScenarioError, match="reference from trajectory_source does not fit arm_controller: elbow/pos"):
        rig_of("arm_computed_torque", overrides=changes)
    with pytest.raises(ScenarioError, match="linear: lift: no such joint; expected some of shoulder, elbow"):
        rig_of("arm_computed_torque", overrides=changes | {"trajectory_source.linear": ["lift"]})
    units = signal_units(rig_of("arm_computed_torque", overrides=changes | {"trajectory_source.linear": ["elbow"]}))
    assert [units[f"joint_states/elbow/{field}"] for field in ("position", "velocity", "effort")] == ["m", "m/s", "N"]
    assert [units[f"joint_states/shoulder/{field}"] for field in ("position", "velocity")] == ["rad", "rad/s"]
    assert units["reference/elbow/acceleration"] == "m/s^2"
    assert units["joint_torques/elbow/effort"] == "N"
