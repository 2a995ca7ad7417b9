"""All rigs in process, and their ticks a second in every placement."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from softrig_core import Block, Recording, Rig, ScenarioError, list_scenarios, rig_of, run_inprocess
from softrig_core.block.loop import Loop
from softrig_core.block.port import CLOCK
from softrig_core.rig.members import Member
from softrig_core.run.inprocess import wired
from softrig_core.wire.cdr import Layout
from softrig_nodes import run_processes
from softrig_nodes.processes.placement import Placement
from softrig_nodes.rehearsal import rehearse

from .console import console
from .loop import dc_motor_rig
from .page import Table as Lines, Tables
from .timing import cpu


def inprocess() -> None:
    """Block updates a second of the DC motor rig in one process, with and without recording."""
    rig = dc_motor_rig(1, 20_000)
    updates = 2 * 20_000
    for name, sink in (("no recording", None), ("recording", Recording((t, p.msgtype) for t, p in rig.topics.items()))):
        start = time.perf_counter()
        run_inprocess(rig, 0, sink)
        console.print(f"{name}: {updates / (time.perf_counter() - start):,.0f} block updates/s")


def rigs() -> None:
    """CPU time of each rig in process, the first run and the second; how a tick splits, its members one by one."""
    table = Table("scenario", "simulated s", "cold CPU s", "warm CPU s", "x real time, cold", "warm", "ticks/s, warm",
                  "plant us", "laws us", "runner us", box=None, pad_edge=False)  # fmt: skip
    for name in RIGS:
        rig = rig_of(name)
        spent = {"plant": 0, "laws": 0}
        cold, warm = (cpu(lambda rig=rig: run_inprocess(rig, rig.scenario.seed)) for _ in range(2))  # type: ignore[misc]
        for member in rig.members:
            _timed(member, spent)
        slower = cpu(lambda rig=rig: _one_by_one(rig))  # type: ignore[misc]
        ticks, simulated = rig.ticks, rig.end / 1e9
        plant, laws = (spent[key] / ticks / 1e3 for key in ("plant", "laws"))
        table.add_row(
            name,
            f"{simulated:g}",
            f"{cold:.2f}",
            f"{warm:.2f}",
            f"{simulated / cold:.1f}",
            f"{simulated / warm:.1f}",
            f"{ticks / warm:,.0f}",
            f"{plant:.1f}",
            f"{laws:.1f}",
            f"{slower / ticks * 1e6 - plant - laws:.1f}",
        )
    console.print(table)


RIGS = ("dc_motor_smc", "dc_motor_smc_b1", "dc_motor_fsfb", "induction_dtc", "manipulator_adsmc", "rehab_impedance",
        "pv_mppt", "lsrm_fuzzy", "rectifier_mpc", "gupfc", "fault_location", "tcp_aqm_smc", "pwa_delay")  # fmt: skip


def containers() -> Tables:
    """Lockstep ticks a second of every system, recorded: through processes, in one container, and in memory."""
    table: Lines = [
        ("scenario", "nodes", "processes", "container", "in process", "container / processes", "container / in process")
    ]
    for name in sorted({scenario_of(n) for n in list_scenarios()}):
        result = ticks_a_second(name)
        row = [f"{result[k]:,.0f}" for k in ("processes", "container", "inprocess")]
        ratios = f"{result['container'] / result['processes']:.1f}", f"{result['container'] / result['inprocess']:.2f}"
        table.append((name, f"{result['nodes']:.0f}", *row, *ratios))
    return {"containers": table}


def scenario_of(name: str) -> str:
    """Name of the headline scenario that a scenario extends."""
    shorter = [n for n in list_scenarios() if name.startswith(f"{n}_")]
    return min(shorter, key=len, default=name)


def ticks_a_second(name: str, rounds: int = 3) -> dict[str, float]:
    """Measure one scenario: ticks of its clock a second between the first and the last, for each placement.

    Container and in memory, whose ratio counts, in turn and the best of some rounds: others on the machine only slow
    them down. Each run is that of a new process: what it loads, or starts for a solver, at its first ticks counts.
    """
    whole = rig_of(name)
    result = dict.fromkeys(("processes", "container", "inprocess"), 0.0)
    result["nodes"] = len([m for m in whole.members if not m.external])
    places: list[tuple[Any, int]] = [("processes", 1000), *rounds * [("container", 10_000), ("inprocess", 10_000)]]
    for place, ticks in places:
        least = max(ticks * whole.clock.schedule.period, 2 * max(m.schedule.period for m in whole.members))
        rig = rig_of(whole, duration=min(whole.scenario.duration, float(least)))
        if place == "inprocess":
            command = [sys.executable, "-P", "-m", "bench.rigs", name, str(rig.scenario.duration)]
            rate = float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        else:
            with tempfile.TemporaryDirectory() as folder:
                outcome = run_processes(rig, rig.scenario.seed, Path(folder), Placement(place))
            if outcome.error:
                raise ScenarioError(outcome.error)
            clock = outcome.status[rig.clock.name]
            rate = clock["ticks"] / clock["running_s"]
        result[place] = max(result[place], rate)
    return result


def in_memory(name: str, duration: float) -> float:
    """Return the ticks a second of a scenario in this process, prepared, recorded and counted as in a container."""
    rig = rig_of(name, duration=duration)
    for member in rig.members:
        rehearse(member.block_class, member.params, member.name)
    recording = Timed((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, rig.scenario.seed, recording)
    return rig.ticks / (recording.published_at[-1] - recording.published_at[0])


class Timed(Recording):
    """A recording that notes the time of each clock message, s."""

    def __init__(self, topics: Iterable[tuple[str, str]]) -> None:
        super().__init__(topics)
        self.clock = list(self.topics).index(CLOCK.topic)
        self.published_at: list[float] = []

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message."""
        super().add(topic, t, data)
        if topic == self.clock:
            self.published_at.append(time.perf_counter())

    def row(self, layouts: Mapping[int, Layout]) -> Callable[[int, Sequence[float]], object]:
        """Return a function that appends one message to each of some topics."""
        add = super().row(layouts)
        if self.clock not in layouts:
            return add

        def noted(t: int, values: Sequence[float]) -> None:
            add(t, values)
            self.published_at.append(time.perf_counter())

        return noted


def _one_by_one(rig: Rig) -> None:
    """Run a rig without the common text of its nodes, which would call none of them."""
    for _ in Loop(list(wired(rig, {m.name: m.block(rig.scenario.seed) for m in rig.members}).values())).run():
        pass


def _timed(member: Member, spent: dict[str, int]) -> None:
    """Create a member's block add up the time of its calls."""
    make, key, clock = member.block, "plant" if member.is_plant else "laws", time.process_time_ns

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            start = clock()
            result = function(*arguments, **keywords)
            spent[key] += clock() - start
            return result

        return call

    def build(seed: int) -> Block:
        block: Any = make(seed)
        for method in ("outputs", "advance") if member.is_plant else ("update",):
            setattr(block, method, timed(getattr(block, method)))
        return block

    member.block = build  # type: ignore[method-assign]


if __name__ == "__main__":
    print(in_memory(sys.argv[1], float(sys.argv[2])))
