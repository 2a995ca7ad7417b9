"""The services of simulation_interfaces on the node of a clock: their answers and effects, with stand-ins for
messages.
"""

import math
from types import SimpleNamespace

import pytest
from conftest import in_process
from simulated import SimulatedNode, SimulatedRig, World
from softrig_core import Level, load_scenario, rig_of
from softrig_nodes.face import faces, simulation
from softrig_nodes.face.simulation import FEATURES, SERVICES, Simulation, turned
from softrig_nodes.seam.monitor import Monitor

RESULTS = {"RESULT_FEATURE_UNSUPPORTED": 0, "RESULT_OK": 1, "RESULT_NOT_FOUND": 2, "RESULT_INCORRECT_STATE": 3,
           "RESULT_OPERATION_FAILED": 4}  # fmt: skip
STOPPED, PLAYING, PAUSED, QUITTING = range(4)
STATES = {"STATE_STOPPED": STOPPED, "STATE_PLAYING": PLAYING, "STATE_PAUSED": PAUSED, "STATE_QUITTING": QUITTING}
TYPES = {name: name for name in (*SERVICES, "SimulateSteps")}
TYPES |= {"Result": SimpleNamespace(**RESULTS), "SimulationState": SimpleNamespace(**STATES)}
Features = type("Features", (), {name: k for k, name in enumerate((*FEATURES, "ENTITY_STATE_GETTING"))})


def message(**fields):
    return SimpleNamespace(result=SimpleNamespace(result=None, error_message=None), **fields)


class Caller:
    """Calls the services of one node as its executor does; later answers are in `late`."""

    def __init__(self, monkeypatch, name, **options):
        self.world, self.services, self.late = World(), {}, []
        rig = rig_of(load_scenario(name).model_copy(update={"duration": 0.2}))
        self.run = SimulatedRig(rig, self.world, "lockstep", **options)
        self.rig, self.adapter = rig, self.run.adapters[rig.clock.name]
        node = SimpleNamespace(
            create_service=self._create, monitor=Monitor(lambda: None), get_fully_qualified_name=lambda: "/plant"
        )
        monkeypatch.setattr(simulation, "ActionServer", lambda node, kind, name, execute: None)
        self.simulation = Simulation(node, self.adapter, TYPES)
        self.world.match()

    def _create(self, kind, name, answer):
        service = SimpleNamespace(send_response=lambda response, header: self.late.append((header, response)))
        self.services[name] = service, answer
        return service

    def __call__(self, name, response=None, header=None, **request):
        service, answer = self.services[name]
        response = answer(SimpleNamespace(**request), message() if response is None else response)
        before = len(self.late)
        service.send_response(response, header)
        assert [text for _, text in self.late[before:]] in ([], [response])
        return response if len(self.late) > before else None

    def state(self):
        return self("get_simulation_state", message(state=SimpleNamespace())).state.state

    def set(self, state):
        answer = message(ALREADY_IN_TARGET_STATE=101, STATE_TRANSITION_ERROR=102)
        result = self("set_simulation_state", answer, state=SimpleNamespace(state=state)).result
        return result.result, result.error_message

    def until(self, condition):
        self.world.run(self.world.now + 10**12, condition)
        assert condition()


def test_a_rig_that_was_paused_stepped_and_resumed_has_the_bytes_of_an_undisturbed_run(monkeypatch):
    call = Caller(monkeypatch, "dc_motor_smc_b2")
    assert call("get_simulator_features", message(features=Features())).features.features == [0, 1, 2, 3, 4, 5]
    assert call.state() == STOPPED
    call.until(lambda: call.adapter.ticks == 3)
    assert call.state() == PLAYING
    refused = call("step_simulation", steps=1).result
    assert (refused.result, refused.error_message) == (4, "steps are taken of a paused run: this one is running")
    assert call.set(PLAYING) == (101, None)
    assert call.set(PAUSED) == (1, "")
    assert call.set(STOPPED) == (102, simulation.ONCE)
    assert call.set(9)[1] == "no state 9 can be set"
    reset = call("reset_simulation", scope=0).result
    assert (reset.result, reset.error_message) == (0, simulation.ONCE)
    first = call.adapter.ticks
    assert call("step_simulation", steps=5, header="a") is None
    assert call("step_simulation", steps=2, header="b") is None
    assert call("step_simulation", steps=0, header="c").result.result == 1
    call.until(lambda: any(header == "b" for header, _ in call.late))
    assert [(h, r.result.result) for h, r in call.late if h in ("a", "b")] == [("a", 1), ("b", 1)]
    assert (call.adapter.ticks, call.state()) == (first + 7, PAUSED)
    left = call.adapter.schedule.count() - 1 - call.adapter.ticks
    assert call("step_simulation", steps=left).result.error_message == (
        f"{left} steps, expected less than the {left} to the end of the run"
    )
    assert call("step_simulation", steps=left - 1, header="d") is None
    assert call.set(PLAYING) == (1, "")
    call.simulation._check()
    assert call.late[-1][0] == "d"
    assert call.late[-1][1].result.error_message == "it was resumed after 0 steps"
    assert set(call.run.run().values()) == {"done"}
    assert call.state() == QUITTING
    in_process_run = in_process(call.rig)
    assert {n: t.data for n, t in call.run.recording.topics.items()} == {
        n: t.data for n, t in in_process_run.topics.items()
    }


@pytest.mark.parametrize("fault", [ImportError("no library"), Exception("no 'rosidl_typesupport_c'")])
def test_a_package_with_missing_libraries_is_reported_in_one_line(fault, monkeypatch):
    def types():
        raise fault

    monkeypatch.setattr(simulation, "types", types)
    node = SimulatedNode(World(), "plant", {})
    faces._offer_simulation(SimpleNamespace(), SimpleNamespace(middleware=node))
    assert node.logs == [(Level.WARN, f"the services of simulation_interfaces are not offered: {fault}")]


def test_a_client_that_waits_for_steps_is_informed_how_many_of_its_own_have_run(monkeypatch):
    call, messages = Caller(monkeypatch, "dc_motor_smc_b2", paused=True), []
    call.until(lambda: call.adapter.state == "running")
    for name, count in (("a", 3), ("b", 2)):
        published = call.simulation._begin_steps(
            count, lambda n, name=name: messages.append((name, n)), lambda text: messages.append(text)
        )
        assert published == ""
    waiting = call.simulation._steps[:]
    call.simulation._steps += waiting * 49
    assert call.simulation._begin_steps(1, print, print) == "100 requests of steps wait already, expected at most 100"
    call.simulation._steps[:] = waiting
    for ticks in (1, 3, 4, 5):
        call.adapter.ticks = ticks
        call.simulation._check()
    first = [("a", 1), ("b", 0), ("a", 3), "", ("b", 0)]
    assert messages == [*first, ("b", 1), ("b", 2), ""]
    assert call.simulation._steps == []


def test_a_run_without_an_end_accepts_any_number_of_steps(monkeypatch):
    call = Caller(monkeypatch, "dc_motor_smc_b2", paused=True)
    call.until(lambda: call.adapter.state == "running")
    call.adapter.schedule = SimpleNamespace(last=None, count=lambda: 0)
    assert call.simulation._begin_steps(10**9, lambda n: None, lambda text: None) == ""
    assert call.adapter.hold.steps == 10**9


def test_quitting_ends_the_run_with_its_reason(monkeypatch):
    call = Caller(monkeypatch, "dc_motor_smc_b2")
    call.until(lambda: call.adapter.ticks == 3)
    assert call.set(QUITTING) == (1, "")
    call.until(lambda: call.adapter.state == "failed")
    assert str(call.adapter.error).endswith("s by set_simulation_state")


def test_bodies_are_placed_as_in_the_scene_and_move_as_the_joints_do(monkeypatch):
    call = Caller(monkeypatch, "manipulator_adsmc")
    anything = {"categories": [], "tags": SimpleNamespace(tags=[]), "bounds": SimpleNamespace(type=0)}

    def entities(**filters):
        return call("get_entities", message(entities=None), filters=SimpleNamespace(**(anything | filters)))

    names = entities(filter="").entities
    assert len(names) > 3
    assert entities(filter=f"^{names[-1]}$").entities == [names[-1]]
    assert "unterminated" in entities(filter="[").result.error_message
    assert entities(filter="", bounds=SimpleNamespace(type=3)).result.result == 0

    def entity(name):
        place = {k: SimpleNamespace() for k in ("position", "orientation")}
        twist = {k: SimpleNamespace() for k in ("linear", "angular")}
        header = SimpleNamespace(stamp=SimpleNamespace(), frame_id=None)
        state = SimpleNamespace(header=header, pose=SimpleNamespace(**place), twist=SimpleNamespace(**twist))
        return call("get_entity_state", message(state=state), entity=name)

    assert entity("nothing").result.result == 2
    assert entity(names[-1]).result.result == 3
    call.until(lambda: call.adapter.ticks == 150)
    call.set(PAUSED)
    scene, step = call.adapter.block.scene(call.adapter.block.p), call.adapter.step
    place, port = next((k, p) for k, p in enumerate(step.outputs) if p.name == scene.port)
    fast = [
        1.0 + k if name.endswith("/velocity") else v
        for k, (name, v) in enumerate(zip(port.labels, step.newest(scene.port), strict=True))
    ]
    step.last_answer = (*step.last_answer[:place], tuple(fast), *step.last_answer[place + 1 :])
    messages = dict(zip(port.labels, step.newest(scene.port), strict=True))
    q = [v for k, v in messages.items() if k.endswith("/position")]
    rates = [v for k, v in messages.items() if k.endswith("/velocity")]
    assert max(map(abs, rates)) > 0.01
    for pose in scene.moving(q):
        reported = entity(pose.child)
        assert reported.result.result == 1
        p, r = reported.state.pose.position, reported.state.pose.orientation
        assert ((p.x, p.y, p.z), (r.x, r.y, r.z, r.w)) == (pose.position, pose.rotation)
        assert reported.state.header.frame_id == pose.parent
        stamp = reported.state.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == step.t > 0
        later = next(
            x for x in scene.moving([a + 1e-6 * b for a, b in zip(q, rates, strict=True)]) if x.child == pose.child
        )
        v, w = reported.state.twist.linear, reported.state.twist.angular
        moved = [(b - a) / 1e-6 for a, b in zip(pose.position, later.position, strict=True)]
        assert (v.x, v.y, v.z) == pytest.approx(moved, abs=1e-3)
        turns = [angle / 1e-6 for angle in turned(pose.rotation, later.rotation)]
        assert (w.x, w.y, w.z) == pytest.approx(turns, abs=1e-3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_small_turn_is_about_its_axis_in_the_parents_frame(axis):
    def quaternion(axis, angle):
        return tuple(math.sin(angle / 2) if k == axis else 0.0 for k in range(3)) + (math.cos(angle / 2),)

    def times(p, q):
        (a, b, c, d), (x, y, z, w) = p, q
        return (
            d * x + a * w + b * z - c * y,
            d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w,
            d * w - a * x - b * y - c * z,
        )

    before = times(quaternion(0, 0.7), quaternion(2, -1.1))
    after = times(quaternion(axis, 1e-5), before)
    wanted = [1e-5 if k == axis else 0.0 for k in range(3)]
    assert turned(before, after) == pytest.approx(wanted, abs=1e-14)
    assert turned(before, tuple(-x for x in after)) == pytest.approx(wanted, abs=1e-14)
