"""A rig on two hosts: parts of it started one by one, and in two network namespaces with a virtual link between them,
made and removed by the test."""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest
from conftest import PATIENCE, differences, in_process
from softrig_bags.read import read_bag
from softrig_bags.repair import repair
from softrig_bringup.cli import main
from softrig_core.rig.domain import free_domain
from test_processes import BASIC, rig

pytestmark = pytest.mark.processes
DISTURBED = "delay 2ms 1ms loss 2% reorder 20%"


def command(*words, **keys):
    done = {"check": True, "capture_output": True, "text": True, "timeout": PATIENCE}
    return subprocess.run(" ".join(words).split(), **done, **keys)


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


def run_parts(parts, domain, directory, prefix=()):
    """Run each part of the rig as `softrig run --only` does; gives exit statuses, what was said and the shards."""
    scenario = directory / "two.yaml"
    nodes = "".join(f"  {name}: {{package: faultrig, executable: {name}}}\n" for name in BASIC)
    scenario.write_text(f"title: t\nsystem: lag\nsource: s\nduration: 1.0\ntimeout: 60.0\nnodes:\n{nodes}")
    running = []
    for k, part in enumerate(parts):
        only = [word for name in part for word in ("--only", name)]
        command = [sys.executable, "-m", "softrig_bringup", "run", str(scenario), "--mode", "container", *only,
                   "--domain", str(domain), "--wait", str(PATIENCE), "--out", str(directory / str(k))]  # fmt: skip
        before = prefix[k] if prefix else []
        running.append(subprocess.Popen([*before, *command], stderr=subprocess.PIPE, text=True))
    try:
        said = [process.communicate(timeout=PATIENCE)[1] for process in running]
    finally:
        for process in running:
            process.kill()
            process.wait()
    (directory / "all").mkdir()
    for shard in directory.glob("*/log/*.shard"):
        shard.rename(directory / "all" / shard.name)
    return [process.returncode for process in running], said


PARTS = [["plant", "source"], ["gain"]]


def test_two_parts_of_a_rig_make_the_bag_of_the_whole(tmp_path):
    with free_domain() as domain:
        statuses, said = run_parts(PARTS, domain, tmp_path)
    assert statuses == [0, 0], said
    assert f"plant, source here, domain {domain}; elsewhere: gain" in said[0]
    assert len(list((tmp_path / "0/log").glob("*.log"))) == 1  # both in one container
    bag = read_bag(repair(tmp_path / "all").bag)
    assert differences(in_process(rig(BASIC, 1.0)), bag) == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--only", "gian", "--domain", "3"], "--only gian: no such node (did you mean 'gain'?)"),
        (["--only", "gain"], "--only: expected --domain N"),
        (["--only", "gain", "--domain", "3", "--mode", "inprocess"], "--only: blocks in process"),
    ],
)
def test_a_part_that_cannot_be_is_told(arguments, text, tmp_path, capsys):
    scenario = tmp_path / "two.yaml"
    nodes = "".join(f"  {name}: {{package: faultrig, executable: {name}}}\n" for name in BASIC)
    scenario.write_text(f"title: t\nsystem: lag\nsource: s\nduration: 1.0\nnodes:\n{nodes}")
    assert main(["run", str(scenario), *arguments]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize("disturbance", ["", DISTURBED])
def test_two_hosts_give_the_bytes_of_one(disturbance, tmp_path):
    # reserved although the hosts have networks of their own: /dev/shm is one for all
    with free_domain() as domain, two_hosts(disturbance) as hosts:
        statuses, said = run_parts(PARTS, domain, tmp_path, [["ip", "netns", "exec", host] for host in hosts])
    assert statuses == [0, 0], said
    assert differences(in_process(rig(BASIC, 1.0)), read_bag(repair(tmp_path / "all").bag)) == []
