"""The DC motor's loop through processes, its tick, its recording, beside a bare ping-pong of the same messages."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.table import Table
from softrig_bags.write import write_bag
from softrig_core import ByHand, Rig, Scenario, ScenarioError, rig_of
from softrig_core.block.codec import Decoder
from softrig_core.scenario.scenario import NodeEntry
from softrig_core.wire.recording import ShardWriter
from softrig_nodes import run_processes
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment
from softrig_nodes.processes.placement import Placement

from .console import console
from .page import Table as Lines, Tables

ROUNDS = 3
LOOPS = 5000


def dc_motor_rig(controllers: int = 1, ticks: int = LOOPS) -> Rig:
    """Return the rig of the DC motor with sliding mode control; further controllers only read the same sensors."""
    motor = {"package": "softrig_drives", "parameters": {"period": 0.001}}
    nodes = {"dc_motor_plant": NodeEntry(executable="dc_motor_plant", **motor)}
    for i in range(controllers):
        remap = {"motor/command": f"motor/command_{i}"} if i else {}
        nodes[f"dc_motor_smc_{i}"] = NodeEntry(executable="dc_motor_smc", remap=remap, **motor)
    return rig_of(Scenario(name="bench", title="", system="dc_motor", source="", duration=ticks * 0.001, nodes=nodes))


def ping_pong(kind: str, loops: int = LOOPS) -> dict[str, float]:
    """Measure the bare ping-pong between two processes: loops/s, p50 and p99 in us."""
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        variables = environment(domain, Path(folder))
        command = [sys.executable, "-P", "-m", "bench.ping_pong", kind]
        pong = subprocess.Popen([*command, "pong", str(loops)], env=variables)
        try:
            ping = subprocess.run(
                [*command, "ping", str(loops)], env=variables, capture_output=True, text=True, check=True, timeout=120
            )
        finally:
            pong.kill()
            pong.wait()
    return json.loads(ping.stdout)


def lockstep(controllers: int = 1, *, record: bool = False) -> dict[str, float]:
    """Measure our loop through processes: the same figures, from the plant's own tick times."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = run_processes(dc_motor_rig(controllers), 0, Path(folder), Placement(record=record))
    if outcome.error:
        raise ScenarioError(outcome.error)
    status = outcome.status["dc_motor_plant"]
    return {
        "loops_s": LOOPS / status["running_s"],
        "p50_us": status["tick_p50_ms"] * 1e3,
        "p99_us": status["tick_p99_ms"] * 1e3,
    }


def _in_turn(cases: dict[str, Callable[[], dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Run all cases in turn, `ROUNDS` times, and return the medians."""
    results: dict[str, list[dict[str, float]]] = {name: [] for name in cases}
    for _ in range(ROUNDS):
        for name, case in cases.items():
            results[name].append(case())
    return {name: {k: statistics.median(r[k] for r in rows) for k in rows[0]} for name, rows in results.items()}


def loop() -> Tables:
    """Lockstep between processes against a bare rclpy ping-pong of the same messages."""
    cases: dict[str, Callable[[], dict[str, float]]] = {
        "ping-pong, serialized bytes, EventsExecutor": lambda: ping_pong("bytes"),
        "ping-pong, answered where it arrives": lambda: ping_pong("arrival"),
        "ping-pong, message objects, rclpy.spin": lambda: ping_pong("objects", LOOPS // 5),
        "softrig lockstep, 1 controller": lambda: lockstep(1),
        "softrig lockstep, 1 controller, recorded": lambda: lockstep(1, record=True),
        "softrig lockstep, 2 controllers": lambda: lockstep(2),
        "softrig lockstep, 3 controllers": lambda: lockstep(3),
    }
    result = _in_turn(cases)
    base, possible, usual = (result[name]["loops_s"] for name in list(cases)[:3])
    peers = ("of the ping-pong of bytes", "of the one answered where it arrives", "of the one of objects")
    table: Lines = [("loop", "loops/s", "p50 us", "p99 us", *peers)]
    for name, row in result.items():
        figures = [f"{row[k]:,.0f}" for k in ("loops_s", "p50_us", "p99_us")]
        table.append((name, *figures, *(f"{row['loops_s'] / of:.2f}" for of in (base, possible, usual))))
    return {"loop": table}


def tick() -> None:
    """How one tick between two processes is spent: plant, controller, codec, recording, and the middleware as
    the rest.
    """
    rig = dc_motor_rig()
    plant_member, law_member = rig.members
    plant: Any = ByHand(plant_member.block(0))
    law = ByHand(law_member.block(0))
    state, sensors = (p.layout() for p in plant_member.outputs)
    command = law_member.outputs[0].layout()
    out = plant.outputs(0)
    inputs = {"state": (out["state"][1],), "sensors": out["sensors"], "reference": None}
    data = [state.encode(0, out["state"]), sensors.encode(0, out["sensors"]), command.encode(0, (1.0,))]
    decoders = [Decoder(p) for p in (*law_member.inputs[:2], plant_member.inputs[0])]

    def record(shard: ShardWriter) -> None:
        for message in (*data, data[0]):
            shard.add(0, 0, message)

    with tempfile.TemporaryDirectory() as folder:
        shard = ShardWriter(Path(folder) / "x", [("a", "b")])
        costs = {
            "plant": _time(lambda: (plant.outputs(0), plant.advance(0, command=(1.0,)))),
            "law": _time(lambda: law.update(0, **inputs)),
            "codec": _time(
                lambda: (
                    state.encode(0, out["state"]),
                    sensors.encode(0, out["sensors"]),
                    command.encode(0, (1.0,)),
                    [d(b) for d, b in zip(decoders, data, strict=True)],
                )
            ),
            "recording": _time(lambda: record(shard)),
        }
    whole = statistics.median(lockstep(1, record=True)["p50_us"] for _ in range(ROUNDS))
    costs["middleware and the rest"] = whole - sum(costs.values())
    table = Table("part", "us", "share", box=None, pad_edge=False)
    for name, cost in (*costs.items(), ("tick (p50)", whole)):
        table.add_row(name, f"{cost:.1f}", f"{cost / whole:.0%}")
    console.print(table)


def _time(function: Callable[[], object], calls: int = 20_000) -> float:
    """Return the time of one call in us, the best of three passes."""
    best = float("inf")
    for _ in range(3):
        start = time.perf_counter()
        for _ in range(calls):
            function()
        best = min(best, time.perf_counter() - start)
    return best / calls * 1e6


def recording() -> None:
    """Measure the cost of recording a run through processes, from start to finished bag."""

    def whole(record: bool) -> dict[str, float]:
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            outcome = run_processes(dc_motor_rig(1, 4 * LOOPS), 0, Path(folder), Placement(record=record))
            if record:
                write_bag(Path(folder) / "bag", outcome.recording)
            return {"s": time.perf_counter() - start}

    result = _in_turn({"without": lambda: whole(False), "with": lambda: whole(True)})
    with_bag, without = result["with"]["s"], result["without"]["s"]
    console.print(
        f"{4 * LOOPS} ticks without {without:.2f} s, with {with_bag:.2f} s: recording takes "
        f"{1 - without / with_bag:.0%} of the run"
    )


def processes() -> None:
    """Start-up time and memory of a node process."""
    with tempfile.TemporaryDirectory() as folder:
        rig = dc_motor_rig(1, 1)
        start = time.perf_counter()
        outcome = run_processes(rig, 0, Path(folder))
        wall = time.perf_counter() - start
    for name, status in outcome.status.items():
        console.print(f"{name}: peak {status['peak_memory_mb']:.0f} MB resident, {status['cpu_s']:.2f} s CPU")
    console.print(f"two nodes started, one tick, stopped: {wall:.2f} s")
