"""FollowJointTrajectory on real nodes, with requests as MoveIt makes them; if control_msgs is installed."""

import threading

import pytest
from conftest import until
from softrig_core import load_scenario, rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import PROFILE
from softrig_nodes.processes.placement import Listener, Placement

control_msgs = pytest.importorskip("control_msgs.msg")
pytestmark = [pytest.mark.processes, pytest.mark.long]
REACHED, CANCELED, ABORTED = 4, 5, 6  # action_msgs/GoalStatus


class Client:
    """A client of the action in this process."""

    def __init__(self, domain, node, joints):
        import rclpy
        from control_msgs.action import FollowJointTrajectory
        from rclpy.action import ActionClient
        from rclpy.executors import SingleThreadedExecutor

        self.kind, self.joints, self.received = FollowJointTrajectory, joints, []
        self.context = rclpy.Context()
        self.context.init(domain_id=domain)
        self.node = rclpy.create_node("caller", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.action = ActionClient(self.node, FollowJointTrajectory, f"/{node}/follow_joint_trajectory")
        until(lambda: self.executor.spin_once(timeout_sec=0.05) or self.action.server_is_ready(), "the action")

    def done(self, future):
        until(lambda: self.executor.spin_once(timeout_sec=0.05) or future.done(), "an answer")
        return future.result()

    def send(self, *points, **tolerances):
        """Send a goal of points (s, position of all joints), at rest at each."""
        from builtin_interfaces.msg import Duration
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        n = len(self.joints)
        at = [(Duration(sec=int(t), nanosec=round(t % 1 * 1e9)), [q] * n) for t, q in points]
        rows = [JointTrajectoryPoint(time_from_start=t, positions=q, velocities=[0.0] * n) for t, q in at]
        goal = self.kind.Goal(trajectory=JointTrajectory(joint_names=self.joints, points=rows), **tolerances)
        return self.done(self.action.send_goal_async(goal, lambda text: self.received.append(text.feedback)))

    def result(self, handle):
        answer = self.done(handle.get_result_async())
        return answer.status, answer.result.error_code


@pytest.mark.parametrize("mode", ["processes", "container"])
@pytest.mark.parametrize("clock", ["realtime", "lockstep"])
@pytest.mark.parametrize(
    ("scenario", "node"), [("manipulator_adsmc", "trajectory_source"), ("rehab_impedance", "prom_reference")]
)
def test_goals_are_followed_canceled_replaced_and_judged(scenario, node, mode, clock, tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    rig = rig_of(load_scenario(scenario).model_copy(update={"duration": 12.0}))
    joints = list(next(p for p in rig.topics.values() if p.msgtype.endswith("JointTrajectory")).channels)
    bound = control_msgs.JointTolerance
    with free_domain() as domain:
        results = []
        place = Placement(mode, clock, domain=domain, **({"pace": 1.0} if clock == "lockstep" else {}))
        run = threading.Thread(target=lambda: results.append(run_processes(rig, 0, tmp_path, place, Listener())))
        run.start()
        client = Client(domain, node, joints)
        handles = []
        wide = [bound(name=joint, position=0.3) for joint in joints]
        until(lambda: handles.append(client.send((1.0, 0.1), goal_tolerance=wide)) or handles[-1].accepted, "the start")
        assert client.result(handles[-1]) == (REACHED, 0)
        assert client.received[-1].joint_names == joints
        assert not client.send((99.0, 0.1)).accepted
        jump = client.send((0.001, 1.5), (1.0, 0.1), path_tolerance=[bound(name=joints[0], position=0.3)])
        assert client.result(jump) == (ABORTED, -4)
        slow = client.send((3.0, 0.3))
        assert len(client.done(slow.cancel_goal_async()).goals_canceling) == 1
        assert client.result(slow) == (CANCELED, 0)
        first, second = client.send((3.0, 0.3)), client.send((0.5, 0.2))
        assert [client.result(first), client.result(second)] == [(ABORTED, -1), (REACHED, 0)]
        tight = client.send((0.3, 0.1), goal_tolerance=[bound(name=joints[0], position=1e-12)])
        assert client.result(tight) == (ABORTED, -5)
        run.join()
        client.context.shutdown()
    assert results[0].error == ""
    assert "parameter_events" in results[0].recording.topics
