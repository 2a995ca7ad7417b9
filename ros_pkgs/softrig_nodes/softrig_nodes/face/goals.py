"""Trajectories for a reference: accepted messages, and the parameters that they become.

The rules are those of ros2_controllers' joint_trajectory_controller (Jazzy) with its defaults. Nothing here needs ROS:
messages are read by the names of their fields.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from softrig_core.motion import FIELDS
from softrig_core.timebase import SECOND, to_s

ERASED = -1.0  # in a control_msgs/JointTolerance: the default does not hold either
QUANTITIES = ("position", "velocity", "acceleration")


class BadGoal(ValueError):
    """A trajectory cannot be followed; the message contains the reason.

    Attributes
    ----------
    code : str
        Name of the error code of control_msgs/FollowJointTrajectory.
    """

    def __init__(self, text: str, code: str = "INVALID_GOAL") -> None:
        super().__init__(text)
        self.code = code


class Motion(NamedTuple):
    """A trajectory that a reference can follow from the next tick on."""

    end: int  # ns of the run: time of the last point
    times: tuple[int, ...]  # ns of the run: of the points of the message
    values: Mapping[str, Any]  # values of the parameters ``goal.*``


def nanoseconds(time: Any) -> int:
    """Return a builtin_interfaces Time or Duration in ns."""
    return int(time.sec) * SECOND + int(time.nanosec)


def motion(message: Any, joints: Sequence[str], now: int, row: Sequence[float], epoch: int, last: int | None) -> Motion:
    """Return the motion of a trajectory_msgs/JointTrajectory.

    It begins where the reference is now, with its speed and acceleration as far as the points have these fields. A
    joint that the message does not name stays where it is.

    Parameters
    ----------
    message : JointTrajectory
        Its stamp 0 means: from now on.
    joints : sequence of str
        Of the reference.
    now : int
        ns of the run: the newest tick.
    row : sequence of float
        Values of the reference at that tick: positions, velocities, accelerations of all joints.
    epoch : int
        Stamp of t = 0, ns.
    last : int, optional
        Last tick of the run, ns.

    Raises
    ------
    BadGoal
        The message has no points or joints, others than the reference, fields of another size, numbers that are not
        finite, times that do not increase, or an end in the past, behind that of the run, or in motion.
    """
    names, points = list(message.joint_names), list(message.points)
    if not points:
        raise BadGoal("the trajectory has no points")
    strange = [name for name in names if name not in joints]
    if strange or not names or len(set(names)) < len(names):
        fault = f"no joint {strange[0]!r}" if strange else "a joint twice" if names else "no joint names"
        raise BadGoal(f"the trajectory has {fault}; the joints are {', '.join(joints)}", "INVALID_JOINTS")
    fields = _fields(points, len(names))
    stamp = nanoseconds(message.header.stamp)
    start = stamp - epoch if stamp else now
    times = tuple(start + nanoseconds(point.time_from_start) for point in points)
    if any(b <= a for a, b in pairwise(times)) or times[0] < start:
        raise BadGoal("time_from_start does not increase from point to point, or is negative")
    if times[-1] < now:
        raise BadGoal(f"the trajectory ended {to_s(now - times[-1]):g} s ago", "OLD_HEADER_TIMESTAMP")
    if last is not None and times[-1] > last:
        raise BadGoal(f"the trajectory ends at t = {to_s(times[-1]):g} s, expected at most {to_s(last):g} s")
    rows = [_spread(point, names, joints, fields, row) for point in points]
    if "velocities" in fields and any(rows[-1]["velocities"]):
        raise BadGoal("the last point has a velocity, expected zero: the joints are to stay there")
    # Points of the past are left out but for the newest, from which the motion of this moment begins.
    k = max((k for k, t in enumerate(times) if t <= now), default=-1)
    if k < 0:
        n = len(joints)
        present = {field: list(row[i * n : (i + 1) * n]) for i, field in enumerate(FIELDS)}
        remaining = [(now, present), *zip(times, rows, strict=True)]
    else:
        remaining = list(zip(times[k:], rows[k:], strict=True))
    begin = remaining[0][0]
    values: dict[str, Any] = {"goal.start": to_s(begin), "goal.times": [to_s(t - begin) for t, _ in remaining]}
    for field in FIELDS:
        values[f"goal.{field}"] = [x for _, r in remaining for x in r[field]] if field in fields else []
    return Motion(times[-1], times, values)


def hold(joints: int, now: int, row: Sequence[float]) -> Mapping[str, Any]:
    """Return the parameters that hold a reference at its present position."""
    values: dict[str, Any] = {"goal.start": to_s(now), "goal.times": [0.0], "goal.positions": [*row[:joints]]}
    return values | {"goal.velocities": [], "goal.accelerations": []}


def _fields(points: Sequence[Any], count: int) -> list[str]:
    """Return which fields all points have; a BadGoal if some have them and others not, or of another size."""
    used = []
    for field in FIELDS:
        sizes = {len(getattr(point, field)) for point in points}
        if sizes == {count}:
            used.append(field)
        elif sizes != {0}:
            raise BadGoal(f"{field}: expected {count} values in every point, or in none; got {sorted(sizes)}")
    if "positions" not in used:
        raise BadGoal("the points have no positions")
    if "accelerations" in used and "velocities" not in used:
        raise BadGoal("the points have accelerations without velocities, expected both or positions alone")
    if any(len(point.effort) for point in points):
        raise BadGoal("the points have efforts, expected none: they are references of position")
    if not all(math.isfinite(x) for point in points for field in used for x in getattr(point, field)):
        raise BadGoal("a value of the trajectory is not finite")
    return used


def _spread(
    point: Any, names: Sequence[str], joints: Sequence[str], fields: Sequence[str], row: Sequence[float]
) -> dict[str, list[float]]:
    """Return a point with the joints in the order of the reference; those that are missing stay where they are."""
    results: dict[str, list[float]] = {}
    for field in FIELDS:
        stated = dict(zip(names, getattr(point, field), strict=False)) if field in fields else {}
        still = row[: len(joints)] if field == "positions" else [0.0] * len(joints)
        results[field] = [float(stated.get(joint, remaining)) for joint, remaining in zip(joints, still, strict=True)]
    return results


class Tolerances:
    """Bounds on the errors of a motion: a missing, zero or erased one is not checked.

    Parameters
    ----------
    joints : sequence of str
        Of the reference.

    Raises
    ------
    BadGoal
        Another joint, or a bound that is negative and not -1.
    """

    def __init__(self, tolerances: Sequence[Any], joints: Sequence[str], label: str) -> None:
        self._bounds: list[tuple[int, int, float]] = []  # quantity, joint, bound
        self._joints, self._what = joints, label
        for tolerance in tolerances:
            if tolerance.name not in joints:
                raise BadGoal(f"{label}: no joint {tolerance.name!r}; the joints are {', '.join(joints)}")
            for k, quantity in enumerate(QUANTITIES):
                bound = float(getattr(tolerance, quantity))
                if not (bound >= 0.0 or bound == ERASED):
                    raise BadGoal(f"{label}: {tolerance.name}: {quantity} = {bound:g}, expected a bound, 0 or -1")
                if bound > 0.0:
                    self._bounds.append((k, joints.index(tolerance.name), bound))

    def __bool__(self) -> bool:
        return bool(self._bounds)

    def beyond(self, error: Sequence[Sequence[float]]) -> str:
        """Describe the first error that exceeds its bound; empty if none does.

        Parameters
        ----------
        error : sequence of sequence of float
            Of positions, velocities, accelerations; one that was not measured is empty.
        """
        for quantity, joint, bound in self._bounds:
            values = error[quantity]
            if not len(values):
                if quantity < 2:
                    return f"{self._joints[joint]}: {QUANTITIES[quantity]} was not measured, expected within {bound:g}"
                # Accelerations are not measured; joint_trajectory_controller does not check them then, either.
                continue
            if not abs(values[joint]) <= bound:
                return (
                    f"{self._joints[joint]}: {QUANTITIES[quantity]} is {abs(values[joint]):.6g} from the trajectory, "
                    f"expected within {bound:g} ({self._what})"
                )
        return ""


def allowed_delay(duration: Any) -> int | None:
    """Return a goal_time_tolerance in ns; None: the goal is waited for without limit.

    Raises
    ------
    BadGoal
        Negative and not -1 s.
    """
    ns = nanoseconds(duration)
    if ns < 0 and ns != -SECOND:
        raise BadGoal(f"goal_time_tolerance is {to_s(ns):g} s, expected a time, 0 or -1")
    return ns if ns > 0 else None
