"""Parameters of a running node by ROS services and by the command: checked, and applied if all of a call are valid."""

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
import yaml
from conftest import PATIENCE, Bench, fork, in_process
from outside import script
from rcl_interfaces.msg import ParameterType
from softrig_bags.read import read_bag
from softrig_bags.write import write_bag
from softrig_core import load_scenario, rig_of
from softrig_core.block.params import flatten
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import find_executable

sys.path.insert(0, str(Path(__file__).parents[1] / "campaign"))
import services

pytestmark = pytest.mark.processes

ASKING = """
import json, sys, rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
rclpy.init()
node = Node("person")
client = AsyncParameterClient(node, sys.argv[1])
client.wait_for_services()

def ask(future):
    rclpy.spin_until_future_complete(node, future)
    return future.result()
"""

PERSON = (
    ASKING
    + """
def setting(**values):
    results = ask(client.set_parameters([Parameter(k, value=v) for k, v in values.items()])).results
    return [(r.successful, r.reason) for r in results]

def TYPES():
    return [v.type for v in ask(client.get_parameters(["delta", "period"])).values]

PERIOD = ask(client.get_parameters(["period"])).values[0].double_value
found = ask(client.describe_parameters(["k", "period"])).descriptors
told = {d.name: [d.read_only, d.additional_constraints] for d in found}
print(json.dumps({
    "told": told, "k": setting(k=60), "period": setting(period=0.1), "c": setting(c=-1.0),
    "wrong": setting(delta="much"),
    "both": setting(delta=3.0, set_point=30.0), "in one": setting(set_point=30.0, reference_limit=40.0),
    "whole": setting(delta=4), "as it is": setting(period=PERIOD, delta=4), "types": TYPES(),
}))
"""
)


def asked(bench, code, *arguments):
    """The output for the user."""
    answer = bench.directory / "answer.json"
    with answer.open("wb") as output:
        status = script(code, bench.environment, *arguments, output=output.fileno()).wait(PATIENCE)
    assert status == 0, answer.read_text()
    return json.loads(answer.read_text())


@pytest.mark.long
def test_parameters_set_by_services_and_by_the_command_are_checked(tmp_path):
    with free_domain() as domain:
        bench = Bench(tmp_path, domain)
        try:
            bench.start("law", "dc_motor_smc", package="softrig_drives")
            text = asked(bench, PERSON, "law")
            command = [sys.executable, "-m", "softrig_bringup", "set", "law.delta", "0.5"]
            first = subprocess.run(command, env=bench.environment, timeout=60, capture_output=True, text=True)
            assert (first.returncode, first.stderr) == (0, "")
            second = subprocess.run(
                [*command, "law.c", "-1.0"], env=bench.environment, timeout=60, capture_output=True, text=True
            )
            assert second.returncode == 1
            assert "law refuses delta, c: " in second.stderr
            # No message can hold this number.
            for number in ("99999999999999999999999", "[99999999999999999999999]"):
                third = subprocess.run([*command[:-2], "law.delta", number], env=bench.environment, timeout=60,
                                       capture_output=True, text=True)  # fmt: skip
                assert third.returncode == 1, third.stderr
                assert "law refuses delta: a whole number of 77 bits, expected at most 63" in third.stderr
        finally:
            for name in list(bench.nodes):
                bench.kill(name)
    assert text["told"] == {
        "k": [False, "may change while running, from the next tick on"],
        "period": [True, "fixed from the start on"],
    }
    assert text["k"] == [[True, ""]]
    assert not text["period"][0][0]
    assert "c out of range" in text["c"][0][1]
    assert "parameter delta = 'much'" in text["wrong"][0][1]
    # Each value is applied separately, so the valid one is set.
    assert [ok for ok, _ in text["both"]] == [True, False]
    assert "beyond reference_limit" in text["both"][1][1]
    assert [ok for ok, _ in text["in one"]] == [True, True]
    assert [ok for ok, _ in text["whole"] + text["as it is"]] == [True, True, True]
    assert text["types"] == [ParameterType.PARAMETER_DOUBLE] * 2


FLOOD = (
    ASKING
    + """
from collections import deque
from itertools import count
from time import monotonic
values = count(500)
found, asked, end = [], deque(), monotonic() + 3.0
while asked or monotonic() < end:
    while len(asked) < 8 and monotonic() < end:
        asked.append(client.set_parameters([Parameter("U_dc", value=float(next(values)))]))
    found.append(ask(asked.popleft()).results[0])
print(json.dumps([[r.successful, r.reason] for r in found]))
"""
)


@pytest.mark.long
@pytest.mark.parametrize(("mode", "duration"), [("processes", "1"), ("container", "100")])
def test_a_flood_of_sets_does_not_keep_a_rig_from_its_ticks(mode, duration, tmp_path):
    """For a plant that takes milliseconds to be set up again: each set is answered, and each change recorded."""
    with free_domain() as domain:
        pass  # only find a free domain; the run reserves it itself
    variables = Bench(tmp_path, domain).environment
    person = subprocess.Popen([sys.executable, "-c", FLOOD, "im_plant"], env=variables, stdout=subprocess.PIPE)
    command = ["run", "induction_dtc", "--duration", duration, "--mode", mode, "--no-plots", "--domain", str(domain),
               "--out", str(tmp_path / "run")]  # fmt: skip
    try:
        done = subprocess.run(
            [sys.executable, "-m", "softrig_bringup", *command], timeout=PATIENCE, capture_output=True, text=True
        )
        answers = json.loads(person.communicate(timeout=10.0)[0])
    finally:
        person.kill()
        person.wait()
    assert done.returncode in (0, 1), done.stderr
    replaced = sum(reason.startswith("in place of U_dc") for ok, reason in answers if ok)
    assert all("expected a pause of" in reason for ok, reason in answers if not ok)
    changes = json.loads((tmp_path / "run/metrics.json").read_text())["changes"]
    assert len(changes) + replaced == sum(ok for ok, _ in answers) > 2


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *range(3, 297, 25)])
def test_no_call_of_a_live_node_changes_type_range_or_existence(seed, tmp_path, monkeypatch):
    """Each executable started alone and in a rig in turn; `scripts/campaign services` tries all.

    The node that is started alone waits for no other: its ticks never end, and its services answer during them.
    """
    for name, value in os.environ.items():
        monkeypatch.setenv(name, value)  # the test itself sets some of these
    services.attack(seed, tmp_path)


LISTER = (
    ASKING
    + """
names = ask(client.list_parameters([], 0)).result.names
values = ask(client.get_parameters(names)).values
print(json.dumps({name: [v.type, v.string_value, list(v.double_array_value)] for name, v in zip(names, values)}))
"""
)


@pytest.mark.long
def test_listed_and_dumped_parameters_suit_another_run(tmp_path):
    """Without paths of this run, and with empty lists of the type of their elements."""
    with free_domain() as domain:
        bench = Bench(tmp_path, domain)
        try:
            bench.start("steps", "reference_source", package="softrig_control")
            message = asked(bench, LISTER, "steps")
        finally:
            bench.kill("steps")
    assert message["accelerations"] == [ParameterType.PARAMETER_DOUBLE_ARRAY, "", []]
    assert message["run.mode"][1] == "realtime"
    assert not [name for name, (_, text, _) in message.items() if str(tmp_path) in text]


def test_a_replay_into_one_node_sets_what_the_bag_has_changed(tmp_path):
    """Scripted for the recording, set by services in the replay: the same messages."""
    entries = [
        {"at": 0.05, "set": {"dc_motor_smc.k": 60.0}},
        {"at": 0.1011, "set": {"dc_motor_smc.delta": 0.5, "dc_motor_smc.c": 6.0}},
    ]
    scenario = load_scenario("dc_motor_smc_b2").changed(duration=0.3)
    rig = rig_of(type(scenario).model_validate({**dict(scenario), "changes": entries}))
    recording = in_process(rig)
    write_bag(tmp_path / "bag", recording)
    law = next(m for m in rig.members if m.name == "dc_motor_smc")
    (tmp_path / "law.yaml").write_text(
        yaml.safe_dump(
            {
                "dc_motor_smc": {
                    "ros__parameters": {name: value for name, value in flatten(law.params).items() if value is not None}
                }
            }
        )
    )
    with free_domain() as domain:
        bench = Bench(tmp_path, domain)
        try:
            bench.start("dc_motor_smc", "dc_motor_smc", "--params-file", str(tmp_path / "law.yaml"), "-p",
                        "run.mode:=lockstep", "-p", "run.paired:=[reference]", package="softrig_drives")  # fmt: skip
            command = [
                find_executable("softrig_bags", "player"),
                "bag",
                "--lockstep",
                "motor/command",
                "--exclude",
                "motor/surface",
                "--answers",
                "answers",
            ]
            with ExitStack() as stack:
                played = fork(stack, "softrig_bags", "player", command, bench.environment, tmp_path)
                printed = played.communicate(PATIENCE)[0]
        finally:
            for name in list(bench.nodes):
                bench.kill(name)
    assert played.returncode == 0, printed
    answers = read_bag(tmp_path / "answers")
    assert answers.topics["motor/command"].data == recording.topics["motor/command"].data
