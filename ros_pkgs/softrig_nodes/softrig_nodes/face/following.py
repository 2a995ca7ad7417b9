"""Trajectories that people and planners send to a reference: a topic and, where control_msgs is installed, an action.

Both have the names, types and rules of ros2_controllers' joint_trajectory_controller (see `goals`). An accepted
trajectory becomes a change of the block's live parameters ``goal.*``, which is recorded and repeated like any other
change.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from rclpy.type_support import check_for_type_support
from softrig_core.block.block import Level
from softrig_core.block.port import Port
from softrig_core.motion import FIELDS, Goal, Path
from softrig_core.timebase import SECOND

from ..adapter.adapter import Adapter
from ..ros.messages import message_class
from ..ros.ros import QOS, ServingNode, quiet_after_shutdown
from ..seam.middleware import Reader
from .goals import BadGoal, Motion, Tolerances, allowed_delay, hold, motion, nanoseconds

PACKAGE = "control_msgs"
ACTION = f"{PACKAGE}/action/FollowJointTrajectory"
TRAJECTORY, STATES = "trajectory_msgs/msg/JointTrajectory", "sensor_msgs/msg/JointState"
LOOK = SECOND // 50  # ns of the wall between two looks at a goal whose joints are not measured
FEEDBACK = SECOND // 20  # ns of the wall between two messages of feedback, as action_monitor_rate is by default
LEAVE = SECOND // 10  # ns of the run: before its end, so that the result of a goal is sent while the node is there
WAITING = 10  # trajectories of the topic that may wait for their share of the time; the oldest are dropped
# s for a client that requests the result of a goal later. It is short, because each change of a goal publishes the
# status of all goals that are kept.
KEPT = 10
OVERDRAWN = "more arrive than fit between the ticks"


def followed(adapter: Adapter) -> Port | None:
    """Return the output of a node that follows trajectories; None where it does not."""
    if not isinstance(getattr(adapter.block.p, "goal", None), Goal):
        return None
    return next(p for p in adapter.step.outputs if p.msgtype == TRAJECTORY)


def action_type() -> Any:
    """Import the type of the action with the libraries that it needs.

    Raises
    ------
    Exception
        The type is not available; Python or rosidl raises the error, rosidl a plain Exception.
    """
    kind = message_class(ACTION)
    check_for_type_support(kind)
    return kind


@dataclass
class _Active:
    """A goal that is followed."""

    handle: Any
    begin: int  # ns of the run: the tick after which it was begun
    motion: Motion
    path: Path
    on_way: Tolerances
    at_end: Tolerances
    until: int | None  # ns of the run: when its joints must have arrived
    # Name of the error code and its text; an empty name: canceled.
    over: Future[tuple[str, str]] = field(default_factory=Future)
    feedback_at: int = 0  # ns of the wall: the newest feedback


class Following(Reader):
    """Accepts trajectories for a reference, on ``~/joint_trajectory`` and by ``~/follow_joint_trajectory``.

    They share the time of the node with its services: in a flood, the newest messages of the topic wait and goals are
    refused.

    Parameters
    ----------
    port : Port
        See `followed`.
    kind : class or None
        See `action_type`; without it there is the topic only.
    """

    def __init__(self, node: ServingNode, adapter: Adapter, port: Port, kind: Any) -> None:
        self._node, self._adapter, self._port = node, adapter, port
        self._joints = list(port.channels)
        self._active: _Active | None = None
        self._sources: int | None = None  # publishers of joint states; None: not subscribed yet
        self._timer = adapter.middleware.timer(LOOK, self._check)
        self._timer.cancel()
        self._waiting: deque[bytes] = deque(maxlen=WAITING)
        self._later = adapter.middleware.timer(LOOK, self._follow_waiting)
        self._later.cancel()
        accept = quiet_after_shutdown(self._accept)
        node.create_subscription(message_class(TRAJECTORY), "~/joint_trajectory", accept, QOS, raw=True)
        if kind is not None:
            self._kind = kind
            self._server = ActionServer(
                node,
                kind,
                "~/follow_joint_trajectory",
                self._follow,
                goal_callback=self._asked,
                cancel_callback=self._cancel,
                result_timeout=KEPT,
            )

    # what is followed --------------------------------------------------------------------------------------------

    def _now(self) -> tuple[int, Sequence[float]]:
        """Return the newest tick, ns, and the reference's values at it; a BadGoal if it does not run."""
        step, state = self._adapter.step, self._adapter.state
        if state != "running" or not self._adapter.ticks:
            raise BadGoal("the run has not begun" if state in ("starting", "running") else "the run is over")
        step.settle()
        return step.t, step.block.update(step.x, step.t)[1][self._port.name]  # type: ignore[attr-defined]

    def _motion(self, message: Any) -> tuple[int, Motion]:
        now, row = self._now()
        last = self._adapter.schedule.last
        end = None if last is None else last - LEAVE
        return now, motion(message, self._joints, now, row, self._adapter.epoch, end)

    def _set(self, values: Mapping[str, Any]) -> None:
        types = dict.fromkeys(values, Parameter.Type.DOUBLE_ARRAY) | {"goal.start": Parameter.Type.DOUBLE}
        wanted = [Parameter(name, types[name], value) for name, value in values.items()]
        result = self._node.set_parameters_atomically(wanted)
        if not result.successful:
            raise BadGoal(result.reason)

    def _hold(self) -> None:
        """Hold the reference at its present values."""
        self._set(hold(len(self._joints), *self._now()))

    def _accept(self, data: bytes) -> None:
        """Follow a published trajectory as soon as there is time; a topic has no answer."""
        with self._node.monitor:
            if len(self._waiting) == WAITING:
                self._report("joint_trajectory", f"a trajectory is dropped: {OVERDRAWN}")
            self._waiting.append(data)
            self._follow_waiting()

    def _follow_waiting(self) -> None:
        self._later.cancel()
        while self._waiting:
            if wait := self._node.wanting():
                self._later.again(max(LOOK, round(wait * SECOND)))
                return
            with self._node.credit.spent():
                self._follow_message(deserialize_message(self._waiting.popleft(), message_class(TRAJECTORY)))

    def _follow_message(self, message: Any) -> None:
        try:
            _, result = self._motion(message)
            self._set(result.values)
        except BadGoal as error:
            self._report("joint_trajectory", f"a trajectory is refused: {error}")
        else:
            self._end("INVALID_GOAL", "replaced by a trajectory from ~/joint_trajectory")

    def _report(self, key: str, text: str) -> None:
        self._adapter.step.note(Level.WARN, key, text, anew=True)

    # the action --------------------------------------------------------------------------------------------------

    def _asked(self, goal: Any) -> GoalResponse:
        """Refuse an impossible goal: the message of a refusal has no reason, so it is reported."""
        with self._node.monitor:
            try:
                if self._node.wanting():
                    raise BadGoal(OVERDRAWN)
                with self._node.credit.spent():
                    self._checked(goal)
            except BadGoal as error:
                self._report("follow_joint_trajectory", f"follow_joint_trajectory: a goal is refused: {error}")
                return GoalResponse.REJECT
            return GoalResponse.ACCEPT

    def _checked(self, goal: Any) -> tuple[int, Motion, Tolerances, Tolerances, int | None]:
        if len(goal.multi_dof_trajectory.points):
            raise BadGoal("multi_dof_trajectory has points, expected none: the joints have one axis each")
        on_way = Tolerances(goal.path_tolerance, self._joints, "path_tolerance")
        at_end = Tolerances(goal.goal_tolerance, self._joints, "goal_tolerance")
        delay = allowed_delay(goal.goal_time_tolerance)
        now, result = self._motion(goal.trajectory)
        last = self._adapter.schedule.last
        until = [result.end + delay] if delay is not None else []
        until += [max(result.end, last - LEAVE)] if last is not None else []
        return now, result, on_way, at_end, min(until, default=None)

    async def _follow(self, handle: Any) -> Any:
        with self._node.monitor, self._node.credit.spent():
            code, text, over = self._begin(handle)
        if over is not None:
            code, text = await over
        result = self._kind.Result()
        result.error_code, result.error_string = getattr(self._kind.Result, code or "SUCCESSFUL"), text
        end: Callable[[], object] = handle.canceled if not code else handle.abort if text else handle.succeed
        end()
        return result

    def _begin(self, handle: Any) -> tuple[str, str, Future[tuple[str, str]] | None]:
        """Start to follow a trajectory; return the reason for a refusal, or the event that signals its end."""
        try:
            now, result, on_way, at_end, until = self._checked(handle.request)
            self._set(result.values)
        except BadGoal as error:
            return error.code, str(error), None
        self._end("INVALID_GOAL", "replaced by a new goal")
        goal = Goal(**{name.removeprefix("goal."): value for name, value in result.values.items()})
        path = Path(goal, len(self._joints))
        self._active = _Active(handle, now, result, path, on_way, at_end, until)
        if self._sources is None:
            self._sources = 0
            self._adapter.middleware.subscribe("joint_states", STATES, self)
        self._timer.again(LOOK, LOOK)
        return "", "", self._active.over

    def _end(self, code: str, text: str) -> None:
        if self._active is not None:
            self._active.over.set_result((code, text))
            self._active = None
            self._timer.cancel()

    def _cancel(self, handle: Any) -> CancelResponse:
        with self._node.monitor:
            if self._active is not None and self._active.handle.goal_id == handle.goal_id:
                try:
                    self._hold()
                except BadGoal as error:
                    self._adapter.middleware.log(Level.WARN, f"follow_joint_trajectory: not canceled: {error}")
                    return CancelResponse.REJECT
                self._end("", "canceled; the reference stays where it was")
            return CancelResponse.ACCEPT

    def _stop(self, code: str, text: str) -> None:
        """End the goal because a bound is violated, and hold the present position."""
        try:
            self._hold()
        except BadGoal as error:
            text += f"; {error}"
        self._end(code, text)

    # how far it is -----------------------------------------------------------------------------------------------

    def matched(self, count: int) -> None:
        """Store the number of publishers of measured joints."""
        self._sources = count

    def _check(self) -> None:
        """End goals that no message ends, and measure the joints of a node in this process, whose messages do
        not pass DDS.
        """
        adapter, topic = self._adapter, self._adapter.middleware.resolve("joint_states")
        if self._active is not None and adapter.state != "running":
            self._end("INVALID_GOAL", "the run has ended")
        beside = [
            (n, o)
            for n in adapter.neighbours
            for o in n.outgoing.outputs
            if (o.topic, o.port.msgtype) == (topic, STATES)
        ]
        for neighbour, output in beside if self._active is not None else ():
            values = dict(zip(output.port.labels, neighbour.step.newest(output.name) or (), strict=False))
            measured = [
                [values.get(f"{joint}/{field}") for joint in self._joints] for field in ("position", "velocity")
            ]
            self._compare(neighbour.step.t, [[] if None in row else row for row in measured])
        active = self._active
        if active is None or beside or self._sources or adapter.step.t < active.motion.end:
            return
        if active.on_way or active.at_end:
            self._end("GOAL_TOLERANCE_VIOLATED", f"no node publishes {topic}, so that no tolerance was checked")
        else:
            self._end("SUCCESSFUL", "")

    def receive(self, data: bytes) -> None:
        """Compare a message of measured joints with the trajectory."""
        if self._active is None:
            return
        message = deserialize_message(data, message_class(STATES))
        index_of = {name: k for k, name in enumerate(message.name)}
        if not all(joint in index_of for joint in self._joints):
            return
        fields = (message.position, message.velocity)
        order = [index_of[joint] for joint in self._joints]
        rows = [[float(row[k]) for k in order] if len(row) == len(index_of) else [] for row in fields]
        self._compare(nanoseconds(message.header.stamp) - self._adapter.epoch, rows)

    def _compare(self, t: int, measured: Sequence[Sequence[Any]]) -> None:
        """Compare positions and velocities measured at t (ns of the run) with the trajectory there."""
        active = self._active
        if active is None or t <= active.begin:
            return
        row, n = active.path.at(t), len(self._joints)
        desired, actual = [row[k * n : (k + 1) * n] for k in range(3)], [*measured, []]
        error = [[d - a for d, a in zip(want, got, strict=False)] for want, got in zip(desired, actual, strict=True)]
        self._publish_feedback(active, t, (desired, actual, error))
        if t < active.motion.end:
            if wrong := active.on_way.beyond(error):
                self._stop("PATH_TOLERANCE_VIOLATED", wrong)
        elif not (wrong := active.at_end.beyond(error)):
            self._end("SUCCESSFUL", "")
        elif active.until is not None and t >= active.until:
            late = (t - active.motion.end) / SECOND
            self._stop("GOAL_TOLERANCE_VIOLATED", f"{wrong}, {late:g} s after the end of the trajectory")

    def _publish_feedback(self, active: _Active, t: int, rows: Sequence[Sequence[Sequence[float]]]) -> None:
        """Publish feedback, at most every `FEEDBACK`."""
        if (now := time.monotonic_ns()) - active.feedback_at < FEEDBACK:
            return
        active.feedback_at = now
        feedback = self._kind.Feedback(joint_names=self._joints)
        stamp = feedback.header.stamp
        stamp.sec, stamp.nanosec = divmod(t + self._adapter.epoch, SECOND)
        for point, values in zip((feedback.desired, feedback.actual, feedback.error), rows, strict=True):
            for name, row in zip(FIELDS, values, strict=True):
                setattr(point, name, [*row])
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(t - active.begin, SECOND)
        active.handle.publish_feedback(feedback)
