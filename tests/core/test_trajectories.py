"""Trajectories for a reference: the motion through points, what is refused, the action with a stand-in of its type."""

from fractions import Fraction
from itertools import pairwise
from types import SimpleNamespace

import pytest
from builtin_interfaces.msg import Duration, Time
from rclpy.serialization import serialize_message
from simulated import SimulatedRig, World
from softrig_core import Level, load_scenario, rig_of
from softrig_core.block.params import ParameterError
from softrig_core.motion import Goal, Path
from softrig_core.timebase import SECOND, to_ns
from softrig_nodes.face import following
from softrig_nodes.face.following import Following, followed
from softrig_nodes.face.goals import BadGoal, hold, motion
from softrig_nodes.ros.requests import Credit
from softrig_nodes.ros.ros import plain
from softrig_robots.manipulator.trajectory import TrajectorySource
from softrig_robots.rehab.prom import PromReference
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

JOINTS = ("joint1", "joint2", "joint3")
MS = SECOND // 1000
FAR = 10 * SECOND


def duration(ns):
    return Duration(sec=ns // SECOND, nanosec=ns % SECOND)


def point(ns, positions=(), velocities=(), accelerations=(), effort=()):
    fields = {"positions": positions, "velocities": velocities, "accelerations": accelerations, "effort": effort}
    return JointTrajectoryPoint(time_from_start=duration(ns), **{k: [*map(float, v)] for k, v in fields.items()})


def trajectory(*points, names=JOINTS, stamp=0):
    header = Header(stamp=Time(sec=stamp // SECOND, nanosec=stamp % SECOND))
    return JointTrajectory(header=header, joint_names=[*names], points=[*points])


# the motion through points --------------------------------------------------------------------------------------------

POINTS = {
    "positions": ((0.25, -1.0), (1.0, 0.5), (-2.0, 0.75)),
    "velocities": ((0.5, 0.0), (-0.25, 1.0), (0.0, 0.0)),
    "accelerations": ((0.0, 2.0), (1.0, -0.5), (0.0, 0.0)),
}


@pytest.mark.parametrize("fields", [1, 2, 3])
def test_between_points_the_motion_is_the_polynomial_that_meets_both(fields):
    """There is only one of that degree (Hermite), so the conditions are enough; sums in fractions are exact."""
    names = [*POINTS][:fields]
    goal = Goal(start=0.5, times=(0.25, 0.75, 2.75), **{n: tuple(x for row in POINTS[n] for x in row) for n in names})
    path = Path(goal, 2)
    for k, (begin, end) in enumerate(pairwise(path.begins)):
        T = Fraction(end - begin, SECOND)
        for joint, row in enumerate(path.polynomials[k]):
            assert not any(row[2 * fields :])
            coefficients = [Fraction(c) for c in row]
            for order, name in enumerate(names):
                scale = [1, 1, 2][order]
                assert float(coefficients[order] * scale) == POINTS[name][k][joint]
                at_end = sum(
                    c * T ** (i - order) * [1, i, i * (i - 1)][order] for i, c in enumerate(coefficients) if i >= order
                )
                assert float(at_end) == pytest.approx(POINTS[name][k + 1][joint], abs=1e-13)
    assert path.at(to_ns(0.75)) == (0.25, -1.0, *(path.at(to_ns(0.75))[2:]))
    assert path.at(to_ns(3.25)) == path.at(FAR) == (-2.0, 0.75, 0.0, 0.0, 0.0, 0.0)
    assert path.at(0)[:2] == (0.25, -1.0)


def test_velocities_and_accelerations_are_derivatives_of_the_positions():
    goal = Goal(times=(0.0, 2.0), **{n: tuple(x for row in rows[:2] for x in row) for n, rows in POINTS.items()})
    path, h = Path(goal, 2), to_ns(1e-4)
    for t in range(to_ns(0.1), to_ns(1.9), to_ns(0.3)):
        before, at_t, after = path.at(t - h), path.at(t), path.at(t + h)
        for k in range(4):
            assert at_t[k + 2] == pytest.approx((after[k] - before[k]) / 2e-4, abs=1e-6)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"times": (1.0,), "positions": (1.0,)}, "goal.positions has 1 values, expected 3 .1 points, 3 joints"),
        ({"times": (1.0, 1.0), "positions": (0.0,) * 6}, "expected each later than the one before"),
        ({"positions": (1.0,)}, "goal.positions has 1 values, expected 0"),
        ({"times": (1.0,), "positions": (0.0,) * 3, "accelerations": (0.0,) * 3}, "accelerations without velocities"),
        (
            {"times": (1.0,), "positions": (0.0,) * 3, "velocities": (0.0,) * 2},
            "goal.velocities has 2 values, expected 3",
        ),
    ],
)
def test_points_that_do_not_fit_are_refused(values, reason):
    with pytest.raises(ParameterError, match=reason):
        TrajectorySource(goal=values)


# how a trajectory message is processed --------------------------------------------------------------------------------

ROW = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.01, 0.02, 0.03)


def test_a_motion_begins_at_the_reference_with_the_fields_of_the_points():
    result = motion(trajectory(point(SECOND, (4, 5, 6), (0, 0, 0))), JOINTS, 7 * MS, ROW, 0, None)
    assert result.values["goal.start"] == 0.007
    assert result.values["goal.times"] == [0.0, 1.0]
    assert result.values["goal.positions"] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert result.values["goal.velocities"] == [0.1, 0.2, 0.3, 0.0, 0.0, 0.0]
    assert result.values["goal.accelerations"] == []
    assert result.end == SECOND + 7 * MS


def test_joints_may_have_any_order_and_missing_ones_stay():
    result = motion(trajectory(point(SECOND, (6, 4)), names=("joint3", "joint1")), JOINTS, 0, ROW, 0, None)
    assert result.values["goal.positions"] == [1.0, 2.0, 3.0, 4.0, 2.0, 6.0]


def test_a_stamp_is_the_time_of_the_rig_and_points_of_the_past_are_left_out():
    epoch, points = 50 * SECOND, [point(k * SECOND, (k, k, k)) for k in range(4)]
    result = motion(trajectory(*points, stamp=epoch + SECOND), JOINTS, 3 * SECOND, ROW, epoch, None)
    assert result.values["goal.start"] == 3.0
    assert result.values["goal.times"] == [0.0, 1.0]
    assert result.values["goal.positions"] == [2.0] * 3 + [3.0] * 3
    assert result.end == 4 * SECOND


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("message", "reason", "code"),
    [
        (trajectory(), "no points", "INVALID_GOAL"),
        (trajectory(point(1, (0,)), names=("jointx",)), "no joint 'jointx'; the joints are", "INVALID_JOINTS"),
        (trajectory(point(1, (0, 0)), names=("joint1", "joint1")), "a joint twice", "INVALID_JOINTS"),
        (trajectory(point(1), names=()), "no joint names", "INVALID_JOINTS"),
        (trajectory(point(1, (0, 0))), "positions: expected 3 values in every point, or in none", "INVALID_GOAL"),
        (trajectory(point(1, (0, 0, 0)), point(2)), "positions: expected 3 values", "INVALID_GOAL"),
        (trajectory(point(1, (), (0, 0, 0))), "no positions", "INVALID_GOAL"),
        (trajectory(point(1, (0, 0, 0), (), (0, 0, 0))), "accelerations without velocities", "INVALID_GOAL"),
        (trajectory(point(1, (0, 0, 0), effort=(0, 0, 0))), "efforts, expected none", "INVALID_GOAL"),
        (trajectory(point(1, (0, NAN, 0))), "not finite", "INVALID_GOAL"),
        (trajectory(point(1, (0, 0, 0), (0, INF, 0))), "not finite", "INVALID_GOAL"),
        (trajectory(point(1, (0, 0, 0)), point(1, (0, 0, 0))), "does not increase", "INVALID_GOAL"),
        (trajectory(point(-1, (0, 0, 0))), "is negative", "INVALID_GOAL"),
        (trajectory(point(1, (0, 0, 0), (0, 0.5, 0))), "the last point has a velocity", "INVALID_GOAL"),
        (trajectory(point(1, (0, 0, 0)), stamp=SECOND), "ended 1 s ago", "OLD_HEADER_TIMESTAMP"),
        (trajectory(point(FAR, (0, 0, 0))), "ends at t = 12 s, expected at most 5 s", "INVALID_GOAL"),
    ],
)  # fmt: skip
def test_a_trajectory_that_cannot_be_followed_is_refused(message, reason, code):
    with pytest.raises(BadGoal, match=reason) as caught:
        motion(message, JOINTS, 2 * SECOND, ROW, 0, 5 * SECOND)
    assert caught.value.code == code


def test_a_hold_stays_at_the_present_positions():
    block = TrajectorySource(goal={n.removeprefix("goal."): v for n, v in hold(3, 5 * MS, ROW).items()})
    assert block.update((), 9 * SECOND)[1]["reference"] == (1.0, 2.0, 3.0, *[0.0] * 6)


# topic and action -----------------------------------------------------------------------------------------------------

CODES = {"SUCCESSFUL": 0, "INVALID_GOAL": -1, "INVALID_JOINTS": -2, "OLD_HEADER_TIMESTAMP": -3}
CODES |= {"PATH_TOLERANCE_VIOLATED": -4, "GOAL_TOLERANCE_VIOLATED": -5}


class Result(SimpleNamespace):
    pass


for name, code in CODES.items():
    setattr(Result, name, code)


def feedback(**fields):
    points = {name: JointTrajectoryPoint() for name in ("desired", "actual", "error")}
    return SimpleNamespace(header=Header(), **fields, **points)


TYPE = SimpleNamespace(Result=Result, Feedback=feedback)


def bound(name, position=0.0, velocity=0.0, acceleration=0.0):
    return SimpleNamespace(name=name, position=position, velocity=velocity, acceleration=acceleration)


def goal(message, path=(), end=(), delay=0):
    none = SimpleNamespace(points=[])
    return SimpleNamespace(
        trajectory=message, multi_dof_trajectory=none, path_tolerance=path, goal_tolerance=end,
        goal_time_tolerance=duration(delay),
    )  # fmt: skip


class Handle:
    """The handle that rclpy passes to code that follows a goal."""

    def __init__(self, request, number):
        self.request, self.goal_id, self.feedback, self.state = request, number, [], "executing"

    def publish_feedback(self, message):
        self.feedback.append(message)

    def __getattr__(self, name):
        if name not in ("succeed", "abort", "canceled"):
            raise AttributeError(name)
        return lambda: setattr(self, "state", name)


class Rig:
    """A rig in simulated time, and a client of its reference."""

    def __init__(self, monkeypatch, scenario="manipulator_adsmc", seconds=0.3, groups=(), kind=TYPE):
        self.world = World()
        rig = rig_of(load_scenario(scenario).model_copy(update={"duration": seconds}))
        self.run = SimulatedRig(rig, self.world, "lockstep", groups=groups)
        self.name = next(n for n, a in self.run.adapters.items() if followed(a) is not None)
        self.adapter, self.node = self.run.adapters[self.name], self.run.nodes[self.name]
        self.served, self.flights = {}, []
        monkeypatch.setattr(
            following, "ActionServer", lambda node, kind, name, run, **calls: self.served.update(calls, run=run)
        )
        self.wait = 0.0
        node = SimpleNamespace(
            monitor=self.node.monitor,
            credit=Credit(),
            wanting=lambda: self.wait,
            create_subscription=lambda kind, topic, accept, qos, raw: self.served.update({topic: accept}),
            set_parameters_atomically=self.set,
        )
        self.following = Following(node, self.adapter, followed(self.adapter), kind)
        self.world.match()

    def set(self, parameters):
        try:
            self.adapter.step.set({p.name: plain(p) for p in parameters})
        except ParameterError as error:
            return SimpleNamespace(successful=False, reason=str(error))
        return SimpleNamespace(successful=True, reason="")

    def until(self, t):
        self.world.run(self.world.now + 10**12, lambda: self.adapter.step.t >= t or self.adapter.state == "done")
        for flight in self.flights:
            if flight.answer is None:
                flight.go_on()

    def send(self, request):
        """Send a goal; None: it was refused."""
        if self.served["goal_callback"](request).name == "REJECT":
            return None
        flight = Flight(Handle(request, len(self.flights)), self.served["run"])
        self.flights.append(flight)
        self.world.match()  # lets the rig subscribe to the topic of the first flight
        return flight

    def publish(self, message):
        self.served["~/joint_trajectory"](serialize_message(message))

    def reference(self):
        return self.adapter.step.newest("reference")


class Flight:
    """A goal that is being followed."""

    def __init__(self, handle, run):
        self.handle, self.answer, self._run = handle, None, run(handle)
        self.go_on()

    def go_on(self):
        """Continue as an executor does: the code that follows the goal checks by itself whether it has ended."""
        try:
            self._run.send(None)
        except StopIteration as end:
            self.answer = end.value

    @property
    def code(self):
        return self.answer.error_code, self.handle.state


def test_a_goal_is_followed_reported_and_reached(monkeypatch):
    rig = Rig(monkeypatch)
    assert rig.send(goal(trajectory(point(20 * MS, (0, 0, 0))))) is None  # the run has not started
    rig.until(10 * MS)
    refused = "follow_joint_trajectory: a goal is refused: the run has not begun"
    assert rig.adapter.step.reports["follow_joint_trajectory"] == (Level.WARN, refused, 1)
    before = rig.reference()
    tolerance = [bound(joint, 0.01) for joint in JOINTS]
    flight = rig.send(goal(trajectory(point(50 * MS, (0.001, 0.002, 0.003), (0, 0, 0))), tolerance, tolerance, 50 * MS))
    rig.until(11 * MS)
    assert rig.reference()[:3] == pytest.approx(before[:3], abs=1e-3)
    rig.until(90 * MS)
    assert flight.code == (0, "succeed")
    assert rig.reference() == (0.001, 0.002, 0.003, *[0.0] * 6)
    reported = flight.handle.feedback[0]
    assert reported.joint_names == [*JOINTS]
    assert [len(reported.actual.positions), len(reported.actual.velocities), len(reported.actual.accelerations)] == [
        3,
        3,
        0,
    ]
    assert reported.error.positions == pytest.approx(
        [d - a for d, a in zip(reported.desired.positions, reported.actual.positions, strict=True)]
    )
    # The run can be repeated, because the changes are recorded.
    assert rig.run.recording.topics["parameter_events"].data


def test_a_path_tolerance_that_is_violated_ends_the_goal_and_the_reference_stays(monkeypatch):
    rig = Rig(monkeypatch)
    rig.until(10 * MS)
    flight = rig.send(goal(trajectory(point(MS, (2, 2, 2)), point(90 * MS, (1, 1, 1))), path=[bound("joint2", 0.5)]))
    rig.until(30 * MS)
    assert flight.code == (-4, "abort")
    assert "joint2: position is" in flight.answer.error_string
    assert "expected within 0.5 (path_tolerance)" in flight.answer.error_string
    assert rig.reference()[3:] == (0.0,) * 6
    stays = rig.reference()
    rig.until(90 * MS)
    assert rig.reference() == stays


def test_a_goal_tolerance_is_waited_for_within_its_time(monkeypatch):
    rig = Rig(monkeypatch)
    rig.until(10 * MS)
    late = rig.send(goal(trajectory(point(20 * MS, (1, 1, 1))), end=[bound("joint1", 1e-12)], delay=10 * MS))
    rig.until(50 * MS)
    assert late.code == (-5, "abort")
    assert "0.01 s after the end of the trajectory" in late.answer.error_string
    unbounded = rig.send(goal(trajectory(point(20 * MS, (1, 1, 1))), end=[bound("joint1", 1e-12)]))
    rig.until(190 * MS)
    assert unbounded.answer is None
    rig.until(215 * MS)  # before the end of the run at 0.3 s, so that the node can still answer
    assert unbounded.code == (-5, "abort")


def test_a_goal_is_canceled_and_the_reference_stays_where_it_is(monkeypatch):
    rig = Rig(monkeypatch)
    rig.until(10 * MS)
    flight = rig.send(goal(trajectory(point(90 * MS, (1, 1, 1), (0, 0, 0)))))
    rig.until(30 * MS)
    at_t = rig.reference()
    assert rig.served["cancel_callback"](flight.handle).name == "ACCEPT"
    rig.until(50 * MS)
    assert flight.code == (0, "canceled")
    assert rig.reference() == (*at_t[:3], *[0.0] * 6)


def test_a_new_trajectory_replaces_the_goal_from_where_the_reference_is(monkeypatch):
    rig = Rig(monkeypatch)
    rig.until(10 * MS)
    first = rig.send(goal(trajectory(point(90 * MS, (1, 1, 1), (0, 0, 0)))))
    rig.until(30 * MS)
    second = rig.send(goal(trajectory(point(90 * MS, (0, 0, 0), (0, 0, 0)))))
    before = rig.reference()
    rig.until(31 * MS)
    assert rig.reference()[:3] == pytest.approx(before[:3], abs=2e-2)
    assert rig.reference()[3:6] == pytest.approx(before[3:6], rel=0.1)
    rig.until(50 * MS)
    assert first.code == (-1, "abort")
    assert first.answer.error_string == "replaced by a new goal"
    rig.publish(trajectory(point(10 * MS, (0.5, 0.5, 0.5))))
    rig.until(70 * MS)
    assert second.code == (-1, "abort")
    assert rig.reference() == (0.5, 0.5, 0.5, *[0.0] * 6)
    rig.publish(trajectory())
    rig.until(71 * MS)
    assert rig.adapter.step.reports["joint_trajectory"][1] == "a trajectory is refused: the trajectory has no points"


def test_in_a_flood_the_newest_trajectories_wait_and_goals_are_refused(monkeypatch):
    monkeypatch.setattr(following, "LOOK", 1_000)  # each message takes some simulated time
    rig = Rig(monkeypatch)
    rig.until(10 * MS)
    rig.wait = 1e-6
    for k in range(following.WAITING + 5):
        rig.publish(trajectory(point(MS, (0.1 * k, 0.0, 0.0))))
    assert rig.send(goal(trajectory(point(90 * MS, (1, 1, 1))))) is None
    rig.until(30 * MS)
    reports = rig.adapter.step.reports
    assert reports["joint_trajectory"] == (Level.WARN, f"a trajectory is dropped: {following.OVERDRAWN}", 5)
    assert following.OVERDRAWN in reports["follow_joint_trajectory"][1]
    assert rig.reference() != (0.1 * (following.WAITING + 4), *[0.0] * 8)
    rig.wait = 0.0
    rig.until(60 * MS)
    assert rig.reference() == (0.1 * (following.WAITING + 4), *[0.0] * 8)
    assert rig.send(goal(trajectory(point(90 * MS, (1, 1, 1))))) is not None


def test_an_unmeasured_joint_is_not_reported_as_within_a_tolerance(monkeypatch):
    monkeypatch.setattr(following, "LOOK", 1_000)  # each message takes some simulated time
    rig = Rig(monkeypatch)
    monkeypatch.setattr(rig.node, "resolve", lambda topic: f"/elsewhere/{topic}")
    rig.until(10 * MS)
    for tolerance, answer in (([], (0, "succeed")), ([bound("joint1", 0.1)], (-5, "abort"))):
        flight = rig.send(goal(trajectory(point(10 * MS, (0, 0, 0))), end=tolerance))
        rig.until(rig.adapter.step.t + 40 * MS)
        assert flight.code == answer
    assert flight.answer.error_string == "no node publishes /elsewhere/joint_states, so that no tolerance was checked"


def test_in_a_container_the_joints_are_those_of_the_neighbour_node(monkeypatch):
    """None of its messages passes DDS; the goal's data are polled now and then."""
    rig = Rig(monkeypatch, seconds=3.0, groups=[["manipulator_plant", "trajectory_source", "vcs_controller"]])
    rig.until(10 * MS)
    within = rig.send(goal(trajectory(point(20 * MS, (0, 0, 0))), end=[bound(joint, 0.1) for joint in JOINTS]))
    rig.until(rig.adapter.step.t + 60 * MS)
    rig.following._check()
    rig.until(0)
    assert within.code == (0, "succeed")
    assert len(within.handle.feedback[0].actual.velocities) == 3
    beyond = rig.send(goal(trajectory(point(MS, (2, 2, 2)), point(SECOND, (1, 1, 1))), path=[bound("joint2", 0.5)]))
    rig.until(rig.adapter.step.t + 5 * MS)  # in process, several ticks run before the next check
    rig.following._check()
    rig.until(0)
    assert beyond.code == (-4, "abort")


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (goal(trajectory(point(90 * MS, (0, 0, 0))), path=[bound("jointx")]), "path_tolerance: no joint 'jointx'"),
        (goal(trajectory(point(90 * MS, (0, 0, 0))), end=[bound("joint1", -0.5)]), "position = -0.5, expected a bound"),
        (goal(trajectory(point(90 * MS, (0, 0, 0))), delay=-2 * SECOND), "goal_time_tolerance is -2 s"),
        (goal(trajectory(point(9 * SECOND, (0, 0, 0)))), "expected at most 0.199 s"),
    ],
)
def test_a_goal_that_cannot_be_followed_is_refused_with_its_reason_in_the_log(request_, reason, monkeypatch):
    rig = Rig(monkeypatch)
    rig.until(10 * MS)
    assert rig.send(request_) is None
    rig.until(100 * MS)
    assert reason in rig.adapter.step.reports["follow_joint_trajectory"][1]


def test_the_reference_of_the_rehabilitation_robot_follows_a_trajectory_as_well(monkeypatch):
    rig = Rig(monkeypatch, "rehab_impedance", 0.2)
    names = [*followed(rig.adapter).channels]
    rig.until(50 * MS)
    where = [q + 0.01 for q in rig.reference()[:2]]
    flight = rig.send(goal(trajectory(point(10 * MS, where), names=names)))
    rig.until(90 * MS)
    assert flight.code == (0, "succeed")
    assert [*rig.reference()] == [*where, 0.0, 0.0, 0.0, 0.0]
    assert isinstance(rig.adapter.block, PromReference)
