"""Random rigs in random placements, two or three started at a time: the bits are those of a run in process."""

import os
import random
import signal
import sys
import time
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from conftest import differences, in_process, make_scenario
from softrig_core import Rig, rig_of
from softrig_core.rig.installed import load_block
from softrig_nodes import run_processes
from softrig_nodes.processes.placement import Placement
from traces import orphans

TICKS = 1500  # upper limit for a run
NANO = 10**9


def loop(chance: random.Random, prefix: str, period: int) -> dict:
    """Make one closed loop around a first-order plant: its nodes with their topics under a prefix; period in ns."""
    faster, slower = chance.choice((1, 1, 2, 5)), chance.choice((1, 2, 10, 40))

    def node(executable: str, every: int = 1, remap: dict | None = None, **parameters: object) -> dict:
        block = load_block("faultrig", executable)
        ports = [p for side in block.ports(block.Params()) for p in side]
        own = {p.topic: p.topic.replace("lag/", f"{prefix}/") for p in ports if prefix != "lag"}
        own |= {old: f"{prefix}/{new}" for old, new in (remap or {}).items()}
        return {"executable": executable, "parameters": {"period": period * every / NANO, **parameters}, "remap": own}

    nodes = {"plant": node("plant", gain=chance.uniform(0.1, 20.0)), "source": node("source", faster * slower)}
    inner = {"lag/reference": "inner_reference"}
    match chance.randrange(6):
        case 0:
            nodes["law"] = node("gain", faster, noise=chance.choice((0.0, 0.3)))
        case 1:
            nodes["outer"] = node("outer", faster * slower)
            nodes["law"] = node("gain", faster, remap=inner)
        case 2:
            nodes["link"] = node("link", samples=chance.randrange(6))
            nodes["law"] = node("late_gain", faster)
        case 3:
            nodes["burst"] = node("burst", at=[k * period / NANO for k in sorted(chance.sample(range(2, 90), 3))])
            nodes["law"] = node("burst_gain")
        case 4:
            nodes["planner"] = node("planner", faster * slower)
            nodes["law"] = node("gain", faster, remap=inner)
        case _:
            nodes["law"] = node("gain", faster)
            nodes["record"] = node("record", faster)
            nodes["analyst"] = node("analyst", faster)
    if chance.random() < 0.4:
        nodes["watcher"] = node("watcher", chance.choice((1, faster)))
    return {name if prefix == "lag" else f"{prefix}_{name}": entry for name, entry in nodes.items()}


def drawn_rig(chance: random.Random) -> tuple[Rig, list[list[str]], int]:
    """Draw a rig of one to three loops, its containers and its seed."""
    period = chance.choice((200_000, 500_000, 1_000_000, 10_000_000))
    nodes: dict = {}
    for k, prefix in enumerate(("lag", "b", "c")[: chance.choice((1, 1, 2, 3))]):
        nodes |= loop(chance, prefix, period * (1 if k == 0 else chance.choice((1, 2, 3))))
    length = chance.choice((20, 100, TICKS))
    rig = rig_of(make_scenario(nodes, length * period / NANO))
    places: list[list[str]] = [[], [], []]
    for name in nodes:
        place = chance.randrange(5)  # two of five cases start a node alone
        if place < 3:
            places[place].append(name)
    return rig, [p for p in places if len(p) > 1], chance.randrange(2**31)


def attack(seed: int, directory: Path) -> None:
    """Start two or three rigs together."""
    chance = random.Random(seed)
    drawn = [drawn_rig(chance) for _ in range(chance.choice((2, 2, 3)))]
    (directory / "case").write_text("\n".join(f"{r.scenario.model_dump(mode='json')} in {c}" for r, c, _ in drawn))
    started = [_fork(directory / str(k), *case) for k, case in enumerate(drawn)]
    wrong = []
    deadline = time.monotonic() + 150.0
    for k, runner in enumerate(started):
        while not (result := os.waitpid(runner, os.WNOHANG))[0] and time.monotonic() < deadline:
            time.sleep(0.02)
        if not result[0]:
            os.kill(runner, signal.SIGKILL)
            os.waitpid(runner, 0)
        if not result[0] or result[1]:
            text = (directory / f"{k}.said").read_text(errors="replace")
            wrong.append(f"rig {k}: {text[-1500:] if result[0] else 'no end within 150 s'}")
    assert not wrong, "\n".join(wrong)
    assert (left := orphans(directory)) == [], f"{len(left)} processes live on"


def _fork(directory: Path, rig: Rig, containers: list[list[str]], seed: int) -> int:
    runner = os.fork()
    if runner:
        return runner
    status = 1
    try:
        signal.alarm(0)
        output = os.open(f"{directory}.said", os.O_WRONLY | os.O_CREAT)
        os.dup2(output, 1)
        os.dup2(output, 2)
        outcome = run_processes(rig, seed, directory, Placement(containers=containers))
        assert outcome.error == "", outcome.error
        assert (result := differences(in_process(rig, seed), outcome.recording)) == [], f"other bits on {result}"
        status = 0
    except BaseException:
        os.write(2, traceback.format_exc().encode())
    os._exit(status)
