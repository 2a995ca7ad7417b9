"""A node or the runner of a rig is killed at some moment: recordings are exact, the status is right, nothing
remains.
"""

import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

from softrig_bags.read import read_bag
from softrig_bringup.cli import main
from softrig_core import Recording, Scenario, list_scenarios, load_scenario, rig_of, run_inprocess
from traces import left_in_memory, of_run, orphans, segments

ENDINGS = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}
LATEST = 4.0  # s from the kill to the end of all nodes


class Enough(Exception):
    """The reference recording is as long as the compared one."""


@cache
def names() -> list[str]:
    """Return the names of all scenarios."""
    return sorted(list_scenarios())


def drawn(chance: random.Random) -> str:
    """Draw a scenario of at most six nodes, all of them ours, that takes some time."""
    while True:
        scenario = load_scenario(name := chance.choice(names()))
        small = len(scenario.nodes) <= 6 and not any(n.external for n in scenario.nodes.values())
        if small and rig_of(scenario).ticks >= 500:
            return name


def attack(seed: int, directory: Path) -> None:
    """Start one run as the command line does, kill a process, and examine everything that it leaves."""
    chance = random.Random(seed)
    name = drawn(chance)
    mode = chance.choice(("processes", "processes", "container"))
    out, text = directory / "out", directory / "said"
    command = ["run", name, "--mode", mode, "--no-plots", "--seed", str(seed), "--out", str(out)]
    (directory / "case").write_text(" ".join(command) + "\n")
    before = segments()
    runner = fork(command, text)
    handle = os.pidfd_open(runner)  # the pid may be reused by then
    try:
        strike_and_judge(chance, runner, name, seed, directory, before)
    finally:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(handle, signal.SIGKILL)
            os.waitpid(runner, 0)
        os.close(handle)


def strike_and_judge(
    chance: random.Random, runner: int, name: str, seed: int, directory: Path, before: set[str]
) -> None:
    """Kill at some moment and examine everything that remains."""
    out, message = directory / "out", directory / "said"
    if chance.random() < 0.7:  # mostly while nodes record, sometimes at any moment
        deadline = time.monotonic() + 60.0
        while not any((out / "log").glob("*.shard")) and time.monotonic() < deadline:
            time.sleep(0.02)
    time.sleep(chance.uniform(0.0, LATEST))
    victim, number = strike(chance, runner, directory)
    with (directory / "case").open("a") as case:
        case.write(f"{victim} {signal.Signals(number).name}\n")
    domain = next((int(v["ROS_DOMAIN_ID"]) for _, v in of_run(directory) if "ROS_DOMAIN_ID" in v), None)
    status = ended(runner)
    text = message.read_text(errors="replace")
    assert "Traceback" not in text, text[-2000:]
    assert (left := orphans(directory)) == [], f"{len(left)} processes of the run live on"
    judge_status(status, victim, number, text, out)
    judge_record(load_scenario(name), seed, out, directory)
    assert (files := left_in_memory(before, domain)) == [], f"left in shared memory: {files[:3]}"


def fork(command: list[str], path: Path, begin: Callable[[], None] = lambda: None) -> int:
    """Run the command line in a separate process without importing everything again; `begin` is called in it."""
    runner = os.fork()
    if runner:
        return runner
    try:
        signal.alarm(0)
        for number in ENDINGS:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        output = os.open(path, os.O_WRONLY | os.O_CREAT)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
        begin()
        status = main(command)
        sys.stdout.flush()
    except BaseException:
        os.write(2, traceback.format_exc().encode())
        status = 99
    os._exit(status)


def strike(chance: random.Random, runner: int, directory: Path) -> tuple[str, int]:
    """Kill a process; return which and by which signal."""
    nodes = [number for number, _ in of_run(directory) if number != runner]
    if nodes and chance.random() < 0.6:
        number = chance.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM, signal.SIGSTOP))
        victim, kind = chance.choice(nodes), "node"
    else:
        number, victim, kind = chance.choice((signal.SIGKILL, *ENDINGS)), runner, "runner"
    try:
        if number == signal.SIGSTOP and b"model.worker" in Path(f"/proc/{victim}/cmdline").read_bytes():
            number = signal.SIGKILL  # a solver has no time limit: the run would wait for a stopped one forever
        os.kill(victim, number)
    except (ProcessLookupError, FileNotFoundError):
        return "nobody", signal.SIGKILL
    return kind, number


def ended(runner: int) -> int:
    """Wait for the runner; return its exit status, negative for a signal."""
    deadline = time.monotonic() + 150.0
    while time.monotonic() < deadline:
        number, status = os.waitpid(runner, os.WNOHANG)
        if number:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.kill(runner, signal.SIGKILL)
    os.waitpid(runner, 0)
    raise AssertionError("the runner did not end within 150 s")


def judge_status(status: int, victim: str, number: int, text: str, out: Path) -> None:
    """Compare the exit status with what was done."""
    over = (0, 1)  # the run may have ended before the signal
    if victim == "runner":
        allowed = (-number,) if number == signal.SIGKILL else (ENDINGS[number],)
        if not out.exists():  # the command line was still being parsed
            allowed = (*allowed, -number)
    else:
        allowed = (3,)
    assert status in (*allowed, *over), f"{victim} {signal.Signals(number).name}: status {status}: {text[-500:]}"
    if status == 3:
        assert "softrig: the run broke: " in text, text[-500:]
        assert (out / "metrics.json").exists(), "no metrics.json says why"


def judge_record(scenario: Scenario, seed: int, out: Path, directory: Path) -> None:
    """Check that the bag, or the shards of a killed runner, are the beginning of the recording in process."""
    bag = out / "bag"
    if not bag.exists():
        if not any((out / "log").glob("*.shard")):
            return  # killed before anything was recorded
        bag = directory / "repaired"
        if (status := main(["bag", "repair", str(out / "log"), "--out", str(bag)])) == 2:
            return  # no complete message has been recorded yet
        assert status == 0, "the shards of a killed run cannot be repaired"
    recording = read_bag(bag)
    reference = expected(scenario, seed, max((t.times[-1] for t in recording.topics.values() if t.times), default=0))
    for name, whole in reference.topics.items():  # compare the topics; all other values derive from them
        if (topic := recording.topics.get(name)) is None:
            continue
        n = len(topic.times)
        assert topic.times == whole.times[:n], f"{name}: other times than in process"
        assert topic.data == whole.data[:n], f"{name}: other bytes than in process"


def expected(scenario: Scenario, seed: int, end: int) -> Recording:
    """Record a run in process up to a time in ns."""

    def progress(t: int) -> None:
        if t > end:
            raise Enough

    rig = rig_of(scenario)
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    with suppress(Enough):
        run_inprocess(rig, seed, recording, progress)
    return recording
