"""The benchmark: ratios against baselines of the same run, because machines differ and are shared."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from softrig_core.errors import ScenarioError
from softrig_core.model.block import Block
from softrig_core.rig.domain import free_domain
from softrig_core.rig.inprocess import run_inprocess
from softrig_core.rig.processes import environment, placed, run_processes
from softrig_core.rig.rig import Member, Rig
from softrig_core.rig.scenario import NodeEntry, Scenario, list_scenarios, load_scenario
from softrig_core.wire.recording import Recording, ShardWriter

ROUNDS = 3
LOOPS = 5000
console = Console(width=None if sys.stdout.isatty() else 120, highlight=False)


def main(parts: Sequence[str]) -> int:
    """Run the named parts, all when none is named."""
    if list(parts) == ["list"]:
        for name, part in PARTS.items():
            print(f"{name:12} {(part.__doc__ or '').splitlines()[0]}")
        return 0
    for name in parts or PARTS:
        if name not in PARTS:
            raise ScenarioError(f"bench part {name!r} is unknown; there are {', '.join(PARTS)}")
        console.print(f"\n[bold]{name}[/]: {(PARTS[name].__doc__ or '').splitlines()[0]}")
        PARTS[name]()
    return 0


def dc_motor_rig(controllers: int = 1, ticks: int = LOOPS) -> Rig:
    """The DC motor with sliding mode control; further controllers read the same sensors and command nothing."""
    motor = {"package": "softrig_drives", "parameters": {"period": 0.001}}
    nodes = {"dc_motor_plant": NodeEntry(executable="dc_motor_plant", **motor)}
    for i in range(controllers):
        remap = {"motor/command": f"motor/command_{i}"} if i else {}
        nodes[f"dc_motor_smc_{i}"] = NodeEntry(executable="dc_motor_smc", remap=remap, **motor)
    return Rig.from_scenario(
        Scenario(name="bench", title="", system="dc_motor", source="", duration=ticks * 0.001, nodes=nodes)
    )


def ping_pong(kind: str, loops: int = LOOPS) -> dict[str, float]:
    """Measure the bare ping-pong between two processes: loops/s, p50 and p99 in us."""
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        variables = environment(domain, Path(folder))
        command = [sys.executable, "-m", "softrig_bringup.bench_peers", kind]
        pong = subprocess.Popen([*command, "pong", str(loops)], env=variables)
        try:
            ping = subprocess.run([*command, "ping", str(loops)], env=variables, capture_output=True, text=True,
                                  check=True, timeout=120)  # fmt: skip
        finally:
            pong.kill()
            pong.wait()
    return json.loads(ping.stdout)


def lockstep(controllers: int = 1, *, record: bool = False) -> dict[str, float]:
    """Measure our loop through processes: the same figures, from the plant's own tick times."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = run_processes(dc_motor_rig(controllers), 0, Path(folder), record=record)
    if outcome.error:
        raise ScenarioError(outcome.error)
    status = outcome.status["dc_motor_plant"]
    return {"loops_s": LOOPS / status["running_s"], "p50_us": status["tick_p50_ms"] * 1e3,
            "p99_us": status["tick_p99_ms"] * 1e3}  # fmt: skip


def _in_turn(cases: dict[str, Callable[[], dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Run all cases in turn, `ROUNDS` times, and give the medians."""
    results: dict[str, list[dict[str, float]]] = {name: [] for name in cases}
    for _ in range(ROUNDS):
        for name, case in cases.items():
            results[name].append(case())
    return {name: {k: statistics.median(r[k] for r in rows) for k in rows[0]} for name, rows in results.items()}


def loop() -> None:
    """Lockstep between processes against a bare rclpy ping-pong of the same messages."""
    cases: dict[str, Callable[[], dict[str, float]]] = {
        "ping-pong, serialized bytes, EventsExecutor": lambda: ping_pong("bytes"),
        "ping-pong, message objects, rclpy.spin": lambda: ping_pong("objects", LOOPS // 5),
        "softrig lockstep, 1 controller": lambda: lockstep(1),
        "softrig lockstep, 1 controller, recorded": lambda: lockstep(1, record=True),
        "softrig lockstep, 2 controllers": lambda: lockstep(2),
        "softrig lockstep, 3 controllers": lambda: lockstep(3),
    }
    found = _in_turn(cases)
    base, usual = (found[name]["loops_s"] for name in list(cases)[:2])
    table = Table("loop", "loops/s", "p50 us", "p99 us", "of bytes", "of objects", box=None, pad_edge=False)
    for name, row in found.items():
        figures = [f"{row[k]:.0f}" for k in ("loops_s", "p50_us", "p99_us")]
        table.add_row(name, *figures, f"{row['loops_s'] / base:.2f}", f"{row['loops_s'] / usual:.2f}")
    console.print(table)


def tick() -> None:
    """How one tick between two processes splits: plant, law, codec, recording, and the middleware as the rest."""
    rig = dc_motor_rig()
    plant_member, law_member = rig.members
    plant: Any = plant_member.block(0)
    law: Any = law_member.block(0)
    state, sensors = (p.layout() for p in plant_member.outputs)
    command = law_member.outputs[0].layout()
    out = plant.outputs(0)
    inputs = {"state": (out["state"][1],), "sensors": out["sensors"], "reference": None}
    data = [state.encode(0, out["state"]), sensors.encode(0, out["sensors"]), command.encode(0, (1.0,))]
    from softrig_core.wire.codec import Decoder

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
                lambda: (state.encode(0, out["state"]), sensors.encode(0, out["sensors"]), command.encode(0, (1.0,)),
                         [d(b) for d, b in zip(decoders, data, strict=True)])
            ),
            "recording": _time(lambda: record(shard)),
        }  # fmt: skip
    whole = statistics.median(lockstep(1, record=True)["p50_us"] for _ in range(ROUNDS))
    costs["middleware and the rest"] = whole - sum(costs.values())
    table = Table("part", "us", "share", box=None, pad_edge=False)
    for name, cost in (*costs.items(), ("tick (p50)", whole)):
        table.add_row(name, f"{cost:.1f}", f"{cost / whole:.0%}")
    console.print(table)


def _time(function: Callable[[], object], calls: int = 20_000) -> float:
    """Give the time of one call in us, the best of three passes."""
    best = float("inf")
    for _ in range(3):
        start = time.perf_counter()
        for _ in range(calls):
            function()
        best = min(best, time.perf_counter() - start)
    return best / calls * 1e6


def recording() -> None:
    """What recording costs a run through processes, start to finished bag."""
    from softrig_bags.write import write_bag

    def whole(record: bool) -> dict[str, float]:
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            outcome = run_processes(dc_motor_rig(1, 4 * LOOPS), 0, Path(folder), record=record)
            if record:
                write_bag(Path(folder) / "bag", outcome.recording)
            return {"s": time.perf_counter() - start}

    found = _in_turn({"without": lambda: whole(False), "with": lambda: whole(True)})
    with_bag, without = found["with"]["s"], found["without"]["s"]
    console.print(f"{4 * LOOPS} ticks without {without:.2f} s, with {with_bag:.2f} s: recording takes "
                  f"{1 - without / with_bag:.0%} of the run")  # fmt: skip


def inprocess() -> None:
    """Block updates a second of the DC motor rig in one process, with and without recording."""
    rig = dc_motor_rig(1, 20_000)
    updates = 2 * 20_000
    for name, sink in (("no recording", None), ("recording", Recording((t, p.msgtype) for t, p in rig.topics.items()))):
        start = time.perf_counter()
        run_inprocess(rig, 0, sink)
        console.print(f"{name}: {updates / (time.perf_counter() - start):,.0f} block updates/s")


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


def bags() -> None:
    """The recorder node: messages and MB a second without loss, against a bare raw subscription."""
    from softrig_bags.bench import recorder_rate

    recorder_rate(console)


def rigs() -> None:
    """CPU time of each rig in process: simulated against real time, and how a tick splits between plant and laws."""
    table = Table("scenario", "simulated s", "CPU s", "x real time", "ticks/s", "plant us", "laws us", "runner us",
                  box=None, pad_edge=False)  # fmt: skip
    for name in RIGS:
        rig = Rig.from_scenario(load_scenario(name))
        spent = {"plant": 0, "laws": 0}
        start = time.process_time()
        run_inprocess(rig, rig.scenario.seed)
        cpu = time.process_time() - start
        for member in rig.members:
            _timed(member, spent)
        start = time.process_time()
        run_inprocess(rig, rig.scenario.seed)
        slower = time.process_time() - start
        ticks, simulated = rig.ticks, rig.end / 1e9
        plant, laws = (spent[key] / ticks / 1e3 for key in ("plant", "laws"))
        table.add_row(name, f"{simulated:g}", f"{cpu:.2f}", f"{simulated / cpu:.1f}", f"{ticks / cpu:,.0f}",
                      f"{plant:.1f}", f"{laws:.1f}", f"{slower / ticks * 1e6 - plant - laws:.1f}")  # fmt: skip
    console.print(table)


RIGS = ("dc_motor_smc", "dc_motor_smc_b1", "dc_motor_fsfb", "induction_dtc", "manipulator_adsmc", "rehab_impedance",
        "pv_mppt", "lsrm_fuzzy", "rectifier_mpc", "gupfc", "fault_location", "tcp_aqm_smc", "pwa_delay")  # fmt: skip


def containers() -> None:
    """Lockstep ticks a second of every system, recorded: through processes, in one container, and in memory."""
    table = Table("scenario", "nodes", "processes", "container", "in memory", "x processes", "of in memory",
                  box=None, pad_edge=False)  # fmt: skip
    for name in sorted({scenario_of(n) for n in list_scenarios()}):
        found = ticks_a_second(name)
        row = [f"{found[k]:,.0f}" for k in ("processes", "container", "inprocess")]
        table.add_row(name, f"{found['nodes']:.0f}", *row, f"{found['container'] / found['processes']:.1f}",
                      f"{found['container'] / found['inprocess']:.2f}")  # fmt: skip
    console.print(table)


def scenario_of(name: str) -> str:
    """Name of the headline scenario that a scenario extends."""
    shorter = [n for n in list_scenarios() if name.startswith(f"{n}_")]
    return min(shorter, key=len, default=name)


def ticks_a_second(name: str) -> dict[str, float]:
    """Measure one scenario: ticks of its clock a second between the first and the last, for each placement."""
    found: dict[str, float] = {}
    for place, ticks in (("processes", 1000), ("container", 10_000), ("inprocess", 10_000)):
        rig = Rig.from_scenario(load_scenario(name))
        least = max(ticks * rig.clock.schedule.period, 2 * max(m.schedule.period for m in rig.members))
        rig = rig.changed(duration=min(rig.scenario.duration, float(least)))
        if place == "inprocess":
            recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
            run_inprocess(rig, rig.scenario.seed)  # what is compiled on first use
            start = time.perf_counter()
            run_inprocess(rig, rig.scenario.seed, recording)
            found[place] = rig.ticks / (time.perf_counter() - start)
            continue
        with tempfile.TemporaryDirectory() as folder:
            outcome = run_processes(rig, rig.scenario.seed, Path(folder), containers=placed(rig, place))
        if outcome.error:
            raise ScenarioError(outcome.error)
        clock = outcome.status[rig.clock.name]
        found[place] = clock["ticks"] / clock["running_s"]
        found["nodes"] = len(outcome.status)
    return found


def _timed(member: Member, spent: dict[str, int]) -> None:
    """Make a member's block add up the time of its calls."""
    make, key, clock = member.block, "plant" if member.is_plant else "laws", time.process_time_ns

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            start = clock()
            found = function(*arguments, **keywords)
            spent[key] += clock() - start
            return found

        return call

    def build(seed: int) -> Block:
        block: Any = make(seed)
        for method in ("outputs", "advance") if member.is_plant else ("update",):
            setattr(block, method, timed(getattr(block, method)))
        return block

    member.block = build  # type: ignore[method-assign]


def induction() -> None:
    """One simulated second of the induction motor drive beside motulator and gym-electric-motor, where installed."""
    from softrig_drives.induction_dtc.bench import print_table

    print_table()


def fault_location() -> None:
    """A 60 ms line fault simulated in steps of 1 us, and the same record located by each algorithm, CPU time."""
    from softrig_power.fault_location.bench import print_table

    print_table()


def systems() -> None:
    """Plants alone, controller steps, searches and proofs: CPU time against real time and a fixed piece of Python."""
    from .bench_systems import print_table

    print_table(console)


def optimal_control() -> None:
    """One plan for the spacecraft by series, collocation and as a boundary value problem, CPU time."""
    from softrig_systems.optimal_control.bench import print_table

    print_table()


PARTS: dict[str, Callable[[], None]] = {
    "loop": loop, "tick": tick, "recording": recording, "inprocess": inprocess, "processes": processes, "bags": bags,
    "rigs": rigs, "containers": containers, "induction": induction, "fault_location": fault_location,
    "systems": systems, "optimal_control": optimal_control,
}  # fmt: skip
