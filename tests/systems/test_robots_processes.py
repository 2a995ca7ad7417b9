"""The robots through real node processes: the same bytes as in-process, and their safety behaviour."""

import pytest
from softrig_core import Signals, load_scenario, rig_of
from softrig_nodes import run_processes

pytestmark = pytest.mark.processes


def rig(name, duration, overrides=None):
    return rig_of(load_scenario(name, overrides).model_copy(update={"duration": duration}))


@pytest.mark.long
def test_overspeed_ends_the_run_naming_plant_and_limit(tmp_path):
    wired = rig("manipulator_adsmc_s2", 2.0, {"manipulator_plant.speed_limit": 0.3})
    outcome = run_processes(wired, 0, tmp_path)
    assert "manipulator_plant" in outcome.error
    assert "limit 0.3: integration stopped" in outcome.error
    signals = Signals(outcome.recording)
    speeds = [signals[f"joint_states/joint{i}/velocity"].x for i in (1, 2, 3)]
    assert 10 < speeds[0].size < 2000
    assert max(abs(x).max() for x in speeds) <= 0.3


VIEWER = """
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
rclpy.init()
node, seen = rclpy.create_node("viewer"), {}
def take(message):
    seen.update({v.key: v.value for s in message.status for v in s.values})
subscription = node.create_subscription(DiagnosticArray, "/figures/metrics", take, 10)
while not {"mac_hip", "mav_knee", "mse_hip"} <= seen.keys():
    rclpy.spin_once(node)
assert seen["mse_hip"].endswith(" deg^2") and seen["mac_hip"].endswith(" A"), seen
"""


@pytest.mark.long
def test_leg_started_by_hand_long_before_its_controller(bench):
    def start(name):
        bench.start(name, name, package="softrig_robots")

    start("rehab_plant")
    bench.wait(lambda: bench.status("rehab_plant")["ticks"] > 1000)
    start("prom_reference")
    start("voltage_controller")
    bench.wait(lambda: bench.status("voltage_controller")["ticks"] > 300)
    bench.start("figures", "figures", "-p", "scenario:=rehab_impedance", package="softrig_core")
    bench.python("viewer", VIEWER)
    assert bench.ends("viewer") == 0
    assert "safe" not in bench.status("rehab_plant")["reports"]
    bench.kill("voltage_controller")
    bench.wait(lambda: "stale motor_command" in bench.status("rehab_plant")["reports"])
    assert "for 0.02 s: safe input" in bench.status("rehab_plant")["reports"]["stale motor_command"][1]


@pytest.mark.long
def test_a_leg_outside_its_range_is_stopped_and_reported(tmp_path):
    wired = rig("rehab_impedance", 0.6, {"rehab_plant.lower": [0.0, -1.5], "rehab_plant.position": [0.1, -1.0]})
    outcome = run_processes(wired, 0, tmp_path)
    assert outcome.error == ""
    level, text, _ = outcome.status["rehab_plant"]["reports"]["safe"]
    assert level == 2
    assert text.startswith("SAFE from t = ")
    signals = Signals(outcome.recording)
    assert signals["applied_voltage/hip/effort"].x[-1] == 0.0
    assert signals["motor_command/hip/effort"].x[-1] != 0.0
