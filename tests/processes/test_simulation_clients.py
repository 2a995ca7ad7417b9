"""The services of simulation_interfaces on a real node, called by a real client; if that package is installed."""

import math
import threading

import pytest
from conftest import differences, in_process, until
from softrig_core import load_scenario, rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import PROFILE
from softrig_nodes.processes.placement import Listener, Placement

pytest.importorskip("simulation_interfaces")
pytestmark = [pytest.mark.processes, pytest.mark.long]


class Caller:
    """A client in this process."""

    def __init__(self, domain, monkeypatch):
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
        self.context = rclpy.Context()
        self.context.init(domain_id=domain)
        self.node = rclpy.create_node("caller", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def done(self, future):
        until(lambda: self.executor.spin_once(timeout_sec=0.05) or future.done(), "an answer")
        return future.result()

    def __call__(self, kind, name, **fields):
        import simulation_interfaces.srv as kinds

        kind = getattr(kinds, kind)
        client = self.node.create_client(kind, name)
        until(lambda: self.executor.spin_once(timeout_sec=0.05) or client.service_is_ready(), name)
        answer = self.done(client.call_async(kind.Request(**fields)))
        self.node.destroy_client(client)
        return answer


@pytest.mark.parametrize("mode", ["processes", "container"])
def test_a_client_pauses_steps_reads_and_resumes(mode, tmp_path, monkeypatch):
    from rclpy.action import ActionClient
    from simulation_interfaces.action import SimulateSteps
    from simulation_interfaces.msg import EntityFilters, SimulationState

    rig = rig_of(load_scenario("manipulator_adsmc").model_copy(update={"duration": 0.5}))
    with free_domain() as domain:
        results = []
        place = Placement(mode, domain=domain, paused=True)
        run = threading.Thread(target=lambda: results.append(run_processes(rig, 0, tmp_path, place, Listener())))
        run.start()
        call = Caller(domain, monkeypatch)
        features = call("GetSimulatorFeatures", "get_simulator_features").features
        assert [*features.features] == [10, 24, 25, 26, 31, 32, 33]
        until(lambda: call("StepSimulation", "step_simulation", steps=1).result.result == 1, "the first step")
        state = call("GetSimulationState", "get_simulation_state").state.state
        assert state == SimulationState.STATE_PAUSED
        assert call("StepSimulation", "step_simulation", steps=99).result.result == 1
        names = call("GetEntities", "get_entities", filters=EntityFilters(filter="")).entities
        reported = call("GetEntityState", "get_entity_state", entity=names[-1])
        assert reported.result.result == 1
        assert reported.state.header.stamp.nanosec == 100 * round(rig.clock.params.period * 1e9)
        r = reported.state.pose.orientation
        assert math.hypot(r.x, r.y, r.z, r.w) == pytest.approx(1.0)
        received = []
        client = ActionClient(call.node, SimulateSteps, "simulate_steps")
        until(lambda: call.executor.spin_once(timeout_sec=0.05) or client.server_is_ready(), "simulate_steps")
        goal = call.done(client.send_goal_async(SimulateSteps.Goal(steps=50), lambda f: received.append(f.feedback)))
        assert call.done(goal.get_result_async()).result.result.result == 1
        assert {f.completed_steps + f.remaining_steps for f in received} == {50}
        assert call("ResetSimulation", "reset_simulation").result.result == 0
        playing = SimulationState(state=SimulationState.STATE_PLAYING)
        assert call("SetSimulationState", "set_simulation_state", state=playing).result.result == 1
        run.join()
        call.context.shutdown()
    assert results[0].error == ""
    assert not differences(results[0].recording, in_process(rig))


def test_a_client_that_quits_ends_the_run_with_the_recording_so_far(tmp_path, monkeypatch):
    from simulation_interfaces.msg import SimulationState

    rig = rig_of("dc_motor_smc_b2")
    with free_domain() as domain:
        results = []
        place = Placement(domain=domain, paused=True)
        run = threading.Thread(target=lambda: results.append(run_processes(rig, 0, tmp_path, place, Listener())))
        run.start()
        call = Caller(domain, monkeypatch)
        until(lambda: call("StepSimulation", "step_simulation", steps=9).result.result == 1, "the first steps")
        quitting = SimulationState(state=SimulationState.STATE_QUITTING)
        assert call("SetSimulationState", "set_simulation_state", state=quitting).result.result == 1
        run.join()
        call.context.shutdown()
    assert "by set_simulation_state" in results[0].error
    assert len(next(iter(results[0].recording.topics.values())).data) > 0
