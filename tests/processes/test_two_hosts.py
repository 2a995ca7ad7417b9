"""A rig on two hosts: parts of it started one by one, and in two network namespaces with a virtual link between them,
made and removed by the test."""

import os
import re
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import link
import pytest
from conftest import PATIENCE, differences, in_process
from softrig_bags.read import read_bag
from softrig_bags.repair import repair
from softrig_bringup.cli import main
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import (
    LOOPBACK,
    NETWORK,
    PROFILE,
    default_profile,
    environment,
    find_executable,
)
from softrig_nodes.ros.profile import joining
from test_processes import BASIC, rig

pytestmark = pytest.mark.processes
DISTURBED = ("5", "5", "5")  # delay in ms, jitter in ms (which reorders frames), loss in %


def command(*words, **keys):
    done = {"check": True, "capture_output": True, "text": True, "timeout": PATIENCE}
    return subprocess.run(" ".join(words).split(), **done, **keys)


@contextmanager
def two_hosts(disturbance=()):
    """Names of two network namespaces that reach each other, through a link between them that may be bad."""
    if shutil.which("ip") is None:
        pytest.skip("no `ip` on this machine")
    number = os.getpid()
    a, b, between = hosts = [f"softrig{number}{end}" for end in ("a", "b", "link")]
    made, relay = [], None
    try:
        try:
            for host in hosts:
                command("ip netns add", host)
                made.append(host)
            for k, (host, end) in enumerate(zip((a, b), "ab", strict=True), 1):
                command(f"ip link add v{end}{number} netns {host} type veth peer name w{end}{number} netns {between}")
                command(f"ip -n {between} link set w{end}{number} up")
                command(f"ip -n {host} link set lo up")
                command(f"ip -n {host} addr add 10.213.7.{k}/24 dev v{end}{number}")
                command(f"ip -n {host} link set v{end}{number} up")
                command(f"ip -n {host} route add 224.0.0.0/4 dev v{end}{number}")
        except subprocess.CalledProcessError as error:
            pytest.skip(f"network namespaces are not permitted here: {error.stderr.strip()}")
        enter = ["ip", "netns", "exec", between, sys.executable, link.__file__, f"wa{number}", f"wb{number}"]
        relay = subprocess.Popen([*enter, *(disturbance or ("0", "0", "0"))], stdout=subprocess.PIPE, text=True)
        assert relay.stdout.readline() == "ready\n"
        yield [a, b]
        assert relay.poll() is None, "the link broke"
    finally:
        if relay is not None:
            relay.kill()
            relay.communicate()
        for host in made:
            command("ip netns del", host)


def run_parts(parts, domain, directory, prefix=(), *more):
    """Run each part of the rig as `softrig run --only` does; return exit statuses, outputs and the shards."""
    scenario = directory / "two.yaml"
    nodes = "".join(f"  {name}: {{package: faultrig, executable: {name}}}\n" for name in BASIC)
    scenario.write_text(f"title: t\nsystem: lag\nsource: s\nduration: 1.0\ntimeout: 60.0\nnodes:\n{nodes}")
    running = []
    for k, part in enumerate(parts):
        only = [word for name in part for word in ("--only", name)]
        command = [sys.executable, "-m", "softrig_bringup", "run", str(scenario), "--mode", "container", *only,
                   "--domain", str(domain), "--wait", str(PATIENCE), "--out",
                   str(directory / str(k)), *more]  # fmt: skip
        before = prefix[k] if prefix else []
        running.append(subprocess.Popen([*before, *command], stderr=subprocess.PIPE, text=True))
    try:
        messages = [process.communicate(timeout=PATIENCE)[1] for process in running]
    finally:
        for process in running:
            process.kill()
            process.wait()
    (directory / "all").mkdir()
    for shard in directory.glob("*/log/*.shard"):
        shard.rename(directory / "all" / shard.name)
    return [process.returncode for process in running], messages


PARTS = [["plant", "source"], ["gain"]]


@pytest.mark.long
def test_two_parts_of_a_rig_make_the_bag_of_the_whole(tmp_path):
    with free_domain() as domain:
        statuses, text = run_parts(PARTS, domain, tmp_path)
    assert statuses == [0, 0], text
    assert f"plant, source here, domain {domain}; elsewhere: gain" in text[0]
    assert len(list((tmp_path / "0/log").glob("*.log"))) == 1  # both nodes are in one container, which has one log
    bag = read_bag(repair(tmp_path / "all").bag)
    assert differences(in_process(rig(BASIC, 1.0)), bag) == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--only", "gian", "--domain", "3"], "--only gian: no such node (did you mean 'gain'?)"),
        (["--only", "gain"], "--only: expected --domain N"),
        (["--only", "gain", "--domain", "3", "--mode", "inprocess"], "--only: in process all blocks"),
    ],
)
def test_an_impossible_part_is_reported(arguments, text, tmp_path, capsys):
    scenario = tmp_path / "two.yaml"
    nodes = "".join(f"  {name}: {{package: faultrig, executable: {name}}}\n" for name in BASIC)
    scenario.write_text(f"title: t\nsystem: lag\nsource: s\nduration: 1.0\nnodes:\n{nodes}")
    assert main(["run", str(scenario), *arguments]) == 2
    assert text in capsys.readouterr().err


def test_the_profile_of_this_host_differs_only_in_its_sockets(tmp_path, monkeypatch):
    transports = "|".join(
        (
            r" *<transport_descriptors>.*</transport_descriptors>\n",
            r" *<userTransports>.*</useBuiltinTransports>\n",
            "<!--.*?-->",
        )
    )
    own, other = (re.sub(transports, "", file.read_text(), flags=re.S) for file in (LOOPBACK, PROFILE))
    assert own == other
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    for discovery, local in (("LOCALHOST", True), ("SUBNET", False)):  # as `run` writes the profile
        result = environment(1, tmp_path, discovery=discovery, silence=10.0)["FASTRTPS_DEFAULT_PROFILES_FILE"]
        assert ("<address>127.0.0.1</address>" in Path(result).read_text()) == local


INTRUDER = """
import time, rclpy
from rclpy.node import Node
rclpy.init()
node = Node("intruder")
end = time.monotonic() + float(PATIENCE)
while time.monotonic() < end and "plant" not in node.get_node_names():
    time.sleep(0.1)
print(*node.get_node_names())
"""


@pytest.mark.parametrize(
    ("variables", "profile"),
    [
        ({}, LOOPBACK),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, LOOPBACK),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, PROFILE),
        ({"ROS_STATIC_PEERS": "10.0.0.7"}, PROFILE),
        ({"ROS_DISCOVERY_SERVER": "first:11811"}, PROFILE),
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": ""}, LOOPBACK),
        ({"ROS_STATIC_PEERS": "", "ROS_DISCOVERY_SERVER": ""}, LOOPBACK),
    ],
)
def test_a_node_that_does_not_ask_for_other_hosts_is_not_reachable_from_them(variables, profile, monkeypatch):
    for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_AUTOMATIC_DISCOVERY_RANGE", *NETWORK):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert default_profile() == profile
    with joining():
        text = Path(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert ("<address>127.0.0.1</address>" in text) == (profile == LOOPBACK)
    with joining(silence=10.0):  # a node started alone: it counts as dead only after its patience
        text = Path(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<leaseDuration><sec>12</sec></leaseDuration>" in text.replace("\n", "").replace(" ", "")
    left = os.environ.get("FASTRTPS_DEFAULT_PROFILES_FILE")
    # Later runs of this process write a profile of their own.
    assert left == variables.get("FASTRTPS_DEFAULT_PROFILES_FILE")


@pytest.mark.long
@pytest.mark.parametrize("how", [LOOPBACK, PROFILE, "by hand"])
def test_a_node_on_another_host_finds_no_local_node(how, tmp_path):
    """By the address, which discovery on this host alone would not prevent; with sockets on all interfaces it finds
    one.
    """
    with free_domain() as domain, two_hosts() as (a, b):
        local = environment(domain, tmp_path)
        assert local["FASTRTPS_DEFAULT_PROFILES_FILE"] == str(LOOPBACK)
        local["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(how)
        if how == "by hand":
            del local["FASTRTPS_DEFAULT_PROFILES_FILE"], local["ROS_AUTOMATIC_DISCOVERY_RANGE"]
        second_host = local | {
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
            "ROS_STATIC_PEERS": "10.213.7.1",
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "FASTRTPS_DEFAULT_PROFILES_FILE": "",
        }
        enter = ["ip", "netns", "exec"]
        plant = subprocess.Popen(
            [*enter, a, find_executable("faultrig", "plant"), "--ros-args", "-r", "__node:=plant"], env=local
        )
        try:
            code = INTRUDER.replace("PATIENCE", str(PATIENCE) if how == PROFILE else "8")
            seen = subprocess.run(
                [*enter, b, sys.executable, "-c", code],
                env=second_host,
                capture_output=True,
                text=True,
                timeout=PATIENCE,
            )
            neighbour = local | {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4", "FASTRTPS_DEFAULT_PROFILES_FILE": ""}
            near = subprocess.run([*enter, a, sys.executable, "-c", INTRUDER.replace("PATIENCE", "60")], env=neighbour,
                                  capture_output=True, text=True, timeout=PATIENCE)  # fmt: skip
        finally:
            plant.kill()
            plant.wait()
    assert "plant" in near.stdout.split(), near.stderr
    assert ("plant" in seen.stdout.split()) == (how == PROFILE), seen.stdout + seen.stderr


@pytest.mark.long
@pytest.mark.parametrize("disturbance", [(), DISTURBED])
def test_two_hosts_give_the_bytes_of_one(disturbance, tmp_path):
    # The hosts have separate networks but share /dev/shm, so the domain is reserved.
    with free_domain() as domain, two_hosts(disturbance) as hosts:
        statuses, text = run_parts(PARTS, domain, tmp_path, [["ip", "netns", "exec", host] for host in hosts])
    assert statuses == [0, 0], text
    assert differences(in_process(rig(BASIC, 1.0)), read_bag(repair(tmp_path / "all").bag)) == []
