"""A rig on two hosts: two network namespaces with a virtual link between them, made and removed by the test."""

import os
import shutil
import subprocess
from contextlib import contextmanager

import pytest
from conftest import differences, in_process
from softrig_core.rig.domain import free_domain
from softrig_core.rig.processes import container_arguments, environment, find_executable, groups, node_parameters
from softrig_core.wire.recording import Recording
from test_processes import BASIC, rig

pytestmark = pytest.mark.processes
DISTURBED = "delay 2ms 1ms loss 2% reorder 20%"


def command(*words, **keys):
    return subprocess.run([*" ".join(words).split()], check=True, capture_output=True, text=True, timeout=20, **keys)


@contextmanager
def two_hosts(disturbance=""):
    """Names of two network namespaces that reach each other."""
    if shutil.which("ip") is None:
        pytest.skip("no `ip` on this machine")
    hosts = [f"softrig{os.getpid()}{end}" for end in "ab"]
    made = []
    try:
        try:
            for host in hosts:
                command("ip netns add", host)
                made.append(host)
            a, b = hosts
            command(f"ip link add va{os.getpid()} netns {a} type veth peer name vb{os.getpid()} netns {b}")
            for number, (host, end) in enumerate(zip(hosts, "ab", strict=True), 1):
                link = f"v{end}{os.getpid()}"
                command(f"ip -n {host} link set lo up")
                command(f"ip -n {host} addr add 10.213.7.{number}/24 dev {link}")
                command(f"ip -n {host} link set {link} up")
                command(f"ip -n {host} route add 224.0.0.0/4 dev {link}")
        except subprocess.CalledProcessError as error:
            pytest.skip(f"network namespaces are not permitted here: {error.stderr.strip()}")
        for host, end in zip(hosts, "ab", strict=True) if disturbance else ():
            try:
                command(f"ip netns exec {host} tc qdisc add dev v{end}{os.getpid()} root netem", disturbance)
            except (subprocess.CalledProcessError, FileNotFoundError) as error:
                pytest.skip(f"no delay and loss on a link here: {getattr(error, 'stderr', '').strip() or error}")
        yield hosts
    finally:
        for host in made:
            command("ip netns del", host)


def run_on(hosts, domain, wired, parts, directory):
    """Run each part of a rig in a container on its host; gives exit statuses and what was recorded."""
    variables = environment(domain, directory) | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    running = []
    for host, group in zip(hosts, groups(wired, parts), strict=True):
        given = {
            m.name: node_parameters(wired, m, 0, "lockstep") | {"run.shard": str(directory / f"{m.name}.shard")}
            for m in group
        }
        start = ["ip", "netns", "exec", host, str(find_executable("softrig_core", "container"))]
        running.append(subprocess.Popen([*start, *container_arguments(group, given, directory)], env=variables))
    try:
        statuses = [process.wait(120) for process in running]
    finally:
        for process in running:
            process.kill()
            process.wait()
    recording = Recording((t, p.msgtype) for t, p in wired.topics.items())
    for shard in directory.glob("*.shard"):
        recording.read_shard(shard)
    return statuses, recording


@pytest.mark.parametrize("disturbance", ["", DISTURBED])
def test_two_hosts_give_the_bytes_of_one(disturbance, tmp_path):
    wired = rig(BASIC, 1.0, timeout=30.0)
    # reserved although the hosts have networks of their own: /dev/shm is one for all
    with free_domain() as domain, two_hosts(disturbance) as hosts:
        statuses, recording = run_on(hosts, domain, wired, [["plant", "source"], ["gain"]], tmp_path)
    assert statuses == [0, 0]
    assert differences(in_process(wired), recording) == []
