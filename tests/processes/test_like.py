"""A drive in a container in real time, with changes by a person, and that run repeated in lockstep."""

import json
import subprocess
import sys

import pytest
from conftest import SLOW_DRIVE
from softrig_bags.read import read_bag
from softrig_bringup.cli import main
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment

pytestmark = pytest.mark.processes

DRIVE = (
    """
extends: induction_dtc
title: The drive at 250 Hz, with a fault to switch
duration: 3.0
"""
    + SLOW_DRIVE
    + """plots: []
faults:
  offset: {link: joint_states -> speed_controller, kind: offset, value: [3.0], affects: [shaft/velocity], active: false}
"""
)

PERSON = """
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import Trigger
rclpy.init()
node = Node("person")

def ask(future):
    rclpy.spin_until_future_complete(node, future)
    return future.result()

for name, values in (("speed_controller", {"kp": 2.5, "ki": 40.0}), ("offset", {"active": True, "value": [4.0]})):
    client = AsyncParameterClient(node, name)
    client.wait_for_services()
    for result in ask(client.set_parameters([Parameter(k, value=v) for k, v in values.items()])).results:
        assert result.successful, result.reason
button = node.create_client(Trigger, "offset/toggle")
button.wait_for_service()
assert ask(button.call_async(Trigger.Request())).success
"""


@pytest.mark.long
def test_a_gain_a_fault_and_a_button_in_real_time_are_repeated_in_lockstep(tmp_path, capsys):
    scenario = tmp_path / "drive.yaml"
    scenario.write_text(DRIVE)
    command = [sys.executable, "-m", "softrig_bringup", "run", str(scenario), "--mode", "container", "--realtime",
               "--no-plots", "--out", str(tmp_path / "run")]  # fmt: skip
    with free_domain() as domain:
        pass
    run = subprocess.Popen([*command, "--domain", str(domain)], stdout=subprocess.DEVNULL)
    person = subprocess.Popen([sys.executable, "-c", PERSON], env=environment(domain, tmp_path))
    try:
        assert run.wait(100) == 0
        assert person.wait(100) == 0
    finally:
        run.kill()
        person.kill()
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    turned = {name for change in metrics["changes"] for name in change["set"]}
    assert turned == {"kp", "ki", "active", "value"}
    bag = read_bag(tmp_path / "run" / "bag")
    assert len(bag.topics["joint_states/offset/toggle"].times) == 2  # the press and its release
    assert main(["run", "--like", str(tmp_path / "run"), "--mode", "inprocess", "--no-plots", "--out",
                 str(tmp_path / "again")]) == 0  # fmt: skip
    printed = capsys.readouterr().err
    late = "that run was late: " in printed  # the machine was too slow for real time
    assert ("run number for number: " in printed) or (late and "differs from" in printed), printed
    again = json.loads((tmp_path / "again" / "metrics.json").read_text())
    assert [(c["at_s"], c["set"]) for c in again["changes"]] == [(c["at_s"], c["set"]) for c in metrics["changes"]]
