"""The services of simulation_interfaces, as other simulators offer them, on the node of a lockstep rig's clock.

They do the same as ``~/pause``, ``~/resume`` and ``~/step``, which need no such package (`seam.hold`). They also
report the poses of the bodies in the node's scene. A run cannot be reset; such a request is answered as not supported.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rclpy.action import ActionServer
from rclpy.task import Future
from rclpy.type_support import check_for_type_support
from softrig_core.block.scene import Pose, scene_of
from softrig_core.timebase import SECOND

from ..adapter.adapter import Adapter
from ..ros.messages import message_class
from ..ros.ros import ServingNode

PACKAGE = "simulation_interfaces"
LOOK = SECOND // 200  # ns of the wall between two looks whether steps have been taken
MOST = 100  # requests of steps that wait at a time, each of a client that may have left
APART = 1e-6  # s: between two places of a body, for its velocity
FEATURES = (
    "SIMULATION_STATE_GETTING",
    "SIMULATION_STATE_SETTING",
    "SIMULATION_STATE_PAUSE",
    "STEP_SIMULATION_SINGLE",
    "STEP_SIMULATION_MULTIPLE",
    "STEP_SIMULATION_ACTION",
)
ONCE = "a run begins once: quit it and start another"


SERVICES = (
    "GetSimulatorFeatures",
    "GetSimulationState",
    "SetSimulationState",
    "ResetSimulation",
    "GetEntities",
    "GetEntityState",
    "StepSimulation",
)


def types() -> dict[str, Any]:
    """Import the types of the package, by name, with the libraries that they need.

    Raises
    ------
    Exception
        Some types are not available; Python or rosidl raises the error, rosidl a plain Exception.
    """
    names = {"Result": "msg", "SimulationState": "msg", **dict.fromkeys(SERVICES, "srv"), "SimulateSteps": "action"}
    result = {name: message_class(f"{PACKAGE}/{kind}/{name}") for name, kind in names.items()}
    for msgtype in result.values():
        check_for_type_support(msgtype)
    return result


@dataclass
class _Steps:
    """Steps that a client waits for: the last tick, and the callbacks for their end or failure."""

    first: int
    last: int
    on_step: Callable[[int], object]  # called with the number of completed steps when it has grown
    over: Callable[[str], object]  # called with the reason of a failure


class Simulation:
    """Offers the services below the namespace of the rig: ``get_simulation_state`` and so on.

    Parameters
    ----------
    adapter : Adapter
        Of the node that owns the clock, in lockstep.
    types : mapping of str to class
        See `types`.
    """

    def __init__(self, node: ServingNode, adapter: Adapter, types: Mapping[str, Any]) -> None:
        self._node, self._adapter = node, adapter
        self._scene = scene_of(type(adapter.block), adapter.block.p)
        self._result, self._state, self._simulating = (types[n] for n in ("Result", "SimulationState", "SimulateSteps"))
        self._steps: list[_Steps] = []
        self._late: dict[int, tuple[Any, Any]] = {}  # answers that are not given yet: response, header
        self._timer = adapter.middleware.timer(LOOK, self._check)
        self._timer.cancel()
        answers = (
            self._features,
            self._get_state,
            self._set_state,
            self._reset,
            self._entities,
            self._entity,
            self._step,
        )
        for name, answer in zip(SERVICES, answers, strict=True):
            service = node.create_service(types[name], re.sub("(?<=.)([A-Z])", r"_\1", name).lower(), answer)
        # `service` is the last one, StepSimulation, whose answer is due only when all of its steps have been taken.
        self._send, service.send_response = service.send_response, self._send_unless_late
        self._action = ActionServer(node, self._simulating, "simulate_steps", self._simulate)

    def _answer(self, result: Any, code: str = "RESULT_OK", text: str = "") -> None:
        result.result, result.error_message = getattr(self._result, code), text

    # state -----------------------------------------------------------------------------------------------------

    def _features(self, request: Any, response: Any) -> Any:
        names = FEATURES if self._scene is None else (*FEATURES, "ENTITY_STATE_GETTING")
        kind = type(response.features)
        response.features.features = sorted(getattr(kind, name) for name in names)
        response.features.custom_info = f"{self._node.get_fully_qualified_name()}, a node of softrig, in lockstep"
        return response

    def _now(self) -> int:
        adapter, state = self._adapter, self._state
        if adapter.state in ("done", "failed"):
            return int(state.STATE_QUITTING)
        if adapter.hold.held:
            return int(state.STATE_PAUSED)
        return int(state.STATE_STOPPED if adapter.state == "starting" else state.STATE_PLAYING)

    def _get_state(self, request: Any, response: Any) -> Any:
        response.state.state = self._now()
        self._answer(response.result)
        return response

    def _set_state(self, request: Any, response: Any) -> Any:
        state, wanted, adapter = self._state, request.state.state, self._adapter
        done, text = True, ""
        if wanted == self._now():
            response.result.result = response.ALREADY_IN_TARGET_STATE
            return response
        if wanted == state.STATE_QUITTING:
            end = f"stopped at t = {adapter.t / SECOND:.9g} s by set_simulation_state"
            adapter.middleware.post(lambda: adapter.fail(end))
        elif wanted in (state.STATE_PLAYING, state.STATE_PAUSED):
            done, text = adapter.hold.ask("resume" if wanted == state.STATE_PLAYING else "pause")
        else:
            done, text = False, ONCE if wanted == state.STATE_STOPPED else f"no state {wanted} can be set"
        self._answer(response.result)
        if not done:
            response.result.result, response.result.error_message = response.STATE_TRANSITION_ERROR, text
        return response

    def _reset(self, request: Any, response: Any) -> Any:
        self._answer(response.result, "RESULT_FEATURE_UNSUPPORTED", ONCE)
        return response

    # steps -----------------------------------------------------------------------------------------------------

    def _begin_steps(self, count: int, callback: Callable[[int], object], over: Callable[[str], object]) -> str:
        """Start to run steps; return the reason for a refusal."""
        adapter = self._adapter
        if adapter.state != "running" or not adapter.hold.held:
            return f"steps are taken of a paused run: this one is {'running' if adapter.ticks else adapter.state}"
        if len(self._steps) >= MOST:
            return f"{len(self._steps)} requests of steps wait already, expected at most {MOST}"
        first = adapter.ticks + adapter.hold.steps
        left = adapter.schedule.count() - 1 - first if adapter.schedule.last is not None else count + 1
        # After the last step the run ends, and with it the service that would answer.
        if count >= left:
            return f"{count} steps, expected less than the {left} to the end of the run"
        if not count:
            over("")
            return ""
        adapter.hold.ask("step", count)
        self._steps.append(_Steps(first, first + count, callback, over))
        self._timer.again(LOOK)
        return ""

    def _check(self) -> None:
        adapter = self._adapter
        for steps in self._steps[:]:
            used = min(adapter.ticks, steps.last) - steps.first
            steps.on_step(max(0, used))
            if adapter.ticks < steps.last and adapter.hold.held:
                continue
            self._steps.remove(steps)
            steps.over("" if adapter.ticks >= steps.last else f"it was resumed after {max(0, used)} steps")
        if not self._steps:
            self._timer.cancel()

    def _step(self, request: Any, response: Any) -> Any:
        def over(text: str) -> None:
            self._answer(response.result, "RESULT_OPERATION_FAILED" if text else "RESULT_OK", text)
            if id(response) in self._late:
                self._send(*self._late.pop(id(response)))

        wrong = self._begin_steps(request.steps, lambda used: None, over)
        if wrong:
            over(wrong)
        elif self._steps and request.steps:
            self._late[id(response)] = response, None
        return response

    def _send_unless_late(self, response: Any, header: Any) -> None:
        """Send the answer to a request, or keep it for a request that is answered later."""
        if id(response) in self._late:
            self._late[id(response)] = response, header
        else:
            self._send(response, header)

    async def _simulate(self, goal: Any) -> Any:
        kind, count = self._simulating, goal.request.steps
        result, feedback, end = kind.Result(), kind.Feedback(), Future()

        def on_step(used: int) -> None:
            if used != feedback.completed_steps:
                feedback.completed_steps, feedback.remaining_steps = used, count - used
                goal.publish_feedback(feedback)

        with self._node.monitor:
            wrong = self._begin_steps(count, on_step, end.set_result)
        wrong = wrong or await end
        self._answer(result.result, "RESULT_OPERATION_FAILED" if wrong else "RESULT_OK", wrong)
        (goal.abort if wrong else goal.succeed)()
        return result

    # entities --------------------------------------------------------------------------------------------------

    def _poses(self, q: list[float]) -> dict[str, Pose]:
        """Return the poses of the bodies for joint positions q."""
        scene = self._scene
        return {} if scene is None else {pose.child: pose for pose in (*scene.fixed(), *scene.moving(q))}

    def _values(self, quantity: str) -> list[float]:
        """Return the last published values of a quantity, one a joint; zero before the scene's port has published."""
        if self._scene is None:
            return []
        step = self._adapter.step
        port = next(p for p in step.outputs if p.name == self._scene.port)
        newest = step.newest(port.name) or [0.0] * len(port.labels)
        return [float(newest[k]) for k, label in enumerate(port.labels) if label.endswith(f"/{quantity}")]

    def _entities(self, request: Any, response: Any) -> Any:
        filters = request.filters
        if filters.categories or filters.tags.tags or filters.bounds.type:
            self._answer(response.result, "RESULT_FEATURE_UNSUPPORTED", "bodies have names only: filter by these")
            return response
        try:
            wanted = re.compile(filters.filter)
        except re.error as error:
            self._answer(response.result, "RESULT_OPERATION_FAILED", f"filter {filters.filter!r}: {error}")
            return response
        response.entities = [*filter(wanted.search, self._poses(self._values("position")))]
        self._answer(response.result)
        return response

    def _entity(self, request: Any, response: Any) -> Any:
        q, v = self._values("position"), self._values("velocity")
        pose = self._poses(q).get(request.entity)
        if pose is None:
            self._answer(response.result, "RESULT_NOT_FOUND", f"no body {request.entity!r}: see get_entities")
            return response
        adapter, state = self._adapter, response.state
        if adapter.state == "starting":
            self._answer(response.result, "RESULT_INCORRECT_STATE", "it has not begun: no body has a place yet")
            return response
        stamp = adapter.epoch + adapter.step.t
        state.header.frame_id = pose.parent
        state.header.stamp.sec, state.header.stamp.nanosec = stamp // SECOND, stamp % SECOND
        _fill(state.pose.position, "xyz", pose.position)
        _fill(state.pose.orientation, "xyzw", pose.rotation)
        before, after = (
            self._poses([a + far * b for a, b in zip(q, v, strict=True)])[request.entity]
            for far in (-APART / 2, APART / 2)
        )
        linear = [(b - a) / APART for a, b in zip(before.position, after.position, strict=True)]
        _fill(state.twist.linear, "xyz", linear)
        _fill(state.twist.angular, "xyz", [w / APART for w in turned(before.rotation, after.rotation)])
        self._answer(response.result, text="accelerations are not reported")
        return response


def turned(before: tuple[float, ...], after: tuple[float, ...]) -> list[float]:
    """Return the small rotation from one unit quaternion (x, y, z, w) to another, rad about the axes of the parent."""
    x, y, z, w = before
    a, b, c, d = after if sum(p * q for p, q in zip(before, after, strict=True)) > 0.0 else [-p for p in after]
    return [
        2.0 * (w * a - d * x + c * y - b * z),
        2.0 * (w * b - d * y + a * z - c * x),
        2.0 * (w * c - d * z + b * x - a * y),
    ]


def _fill(message: Any, names: str, values: Any) -> None:
    for name, value in zip(names, values, strict=True):
        setattr(message, name, float(value))
