"""How punctual the induction motor's drive is in real time, all its nodes in one container."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from rich.live import Live
from rich.table import Table
from softrig_core import RunError, ScenarioError, rig_of
from softrig_nodes import run_processes
from softrig_nodes.below.uses import VARIABLE
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment
from softrig_nodes.processes.placement import Placement
from softrig_nodes.processes.processes import Outcome

from .console import console
from .page import ROOT, Begin, page, write as write_tables

RATES = (2_000, 5_000, 10_000, 20_000)  # Hz, of plant, law and monitor
# How ticks run and publish, with the value of VARIABLE: natively; in Python with a native publishing thread; in
# Python, publishing in bursts.
WAYS = {"native": "", "thread": "ticking", "bursts": "carrier"}
# Topics that another process reads; the last one is published at the rate of the plant.
READERS = ("", "torque_ref", "joint_states")
DURATION = 10.0  # s
LONG = 60.0  # s, at the highest rate with each reader
PAGE = page("nodes", "placements_measured", "Wall clock; recorded. The load is also that of the bench itself.")
FLOOR = Path(__file__).with_name("floor.c")
TIMES = {
    "lateness us p50": "lateness_p50_ms",
    "lateness p99": "lateness_p99_ms",
    "round trip us p50": "round_trip_p50_ms",
    "round trip p99": "round_trip_p99_ms",
}
READER = """
import sys, rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
rclpy.init()
node = Node("reader")
node.create_subscription(JointState, sys.argv[1], lambda message: None, 10)
rclpy.spin(node)
"""


class Row(NamedTuple):
    """A run: rate (Hz), topic that another process reads, duration (s), and one of `WAYS`."""

    rate: int
    topic: str
    duration: float = DURATION
    way: str = "native"


SHORT = (
    Row(5_000, ""),
    Row(5_000, "joint_states"),
    Row(20_000, ""),
    Row(20_000, "torque_ref"),
    Row(20_000, "joint_states", 30.0),
    Row(20_000, "joint_states", way="thread"),
    Row(20_000, "joint_states", way="bursts"),
)
# At the highest rate, all ways are measured in turn.
ALL = tuple(
    Row(rate, topic, duration, way)
    for rate, duration in [*((rate, DURATION) for rate in RATES), (RATES[-1], LONG)]
    for topic in READERS
    for way in (WAYS if rate == RATES[-1] else ["native"])
)


def realtime(rows: Sequence[Row] = SHORT, write: bool = False) -> None:
    """Deadlines missed by the induction motor's drive in one container, with a reader of a topic in another process."""
    begun, columns = Begin.now(), ("Hz", "s", "read outside", "ticks", "missed", "late", *TIMES, "recorded")
    table, broke = Table(*columns, box=None, pad_edge=False), []
    lines: list[tuple[str, ...]] = [columns]

    def add(*cells: str) -> None:
        table.add_row(*cells)
        lines.append((*cells, *[""] * (len(columns) - len(cells))))

    with Live(table, console=console):  # shows each row when it is measured, even if a later one fails
        for row in rows:
            try:
                results = _figures(drive(*row))
            except (RunError, ScenarioError) as error:
                results = ["broke"]
                broke.append(f"{row.rate:,} Hz, {row.duration:.0f} s, {row.topic or 'nothing'} read: {error}")
            add(f"{row.rate:,}", f"{row.duration:.0f}", row.topic or "nothing", row.way, *results)
        add(f"{RATES[-1]:,}", f"{DURATION:.0f}", "nothing", "none, in C", "", *_floor(RATES[-1], DURATION))
    if write:
        write_tables(PAGE, {"realtime": lines}, "scripts/softrig bench realtime --write", begun)
    if broke:
        raise SystemExit("\n".join(broke))


def main(arguments: Sequence[str]) -> int:
    """Measure how punctual the induction motor's drive is in real time, all its nodes in one container."""
    parser = argparse.ArgumentParser(prog="scripts/softrig bench realtime", description=main.__doc__)
    parser.add_argument("--all", action="store_true", help="each rate and reader, also for a minute (12 min, not 2.5)")
    parser.add_argument("--rate", type=int, choices=RATES, help="only the rows of this rate, Hz")
    parser.add_argument("--write", action="store_true", help=f"write the table to {PAGE.path.relative_to(ROOT)}")
    options = parser.parse_args(arguments)
    rows = [row for row in (ALL if options.all else SHORT) if options.rate in (None, row.rate)]
    if not rows:
        parser.error(f"no row of {options.rate} Hz without --all")
    realtime(rows, options.write)
    return 0


def _floor(rate: int, duration: float) -> list[str]:
    """Return late ticks and lateness of an empty loop in C.

    It publishes nothing, so a reader would wait for messages and take no processor time: none is started.
    """
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "floor")
        try:
            subprocess.run(["cc", "-O2", "-o", program, FLOOR], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            return ["no C compiler"]
        words = [str(program), str(10**9 // rate), str(round(rate * duration))]
        late, *times = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    return [f"{float(late):.2%}", *(f"{float(time):.0f}" for time in times)]


def _figures(outcome: Outcome) -> list[str]:
    """Return the cells of a row about a run: a tick is late if it begins when the next one is due."""
    plant = outcome.status["im_plant"]
    due = plant["ticks"] + plant["missed_deadlines"]
    recorded = len(outcome.recording.topics["joint_states"].data)
    times = [f"{plant[key] * 1e3:.0f}" for key in TIMES.values()]
    shares = plant["missed_deadlines"] / due, plant.get("late_ticks", 0) / due
    return [*(f"{share:.2%}" for share in shares), *times, f"{recorded / plant['ticks']:.2%}"]


def drive(rate: int, topic: str, duration: float, way: str = "native") -> Outcome:
    """Run the drive at a rate (Hz) for a time (s), with a reader of a topic if one is named, by one of `WAYS`."""
    periods = {f"{node}.period": 1.0 / rate for node in ("im_plant", "dtc_controller", "flux_monitor")}
    rig = rig_of("induction_dtc", duration=duration, overrides=periods)
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain, _reader(topic, domain, Path(folder)):
        placement = Placement("container", "realtime", domain)
        with patch.dict(os.environ, {VARIABLE: WAYS[way]}):
            outcome = run_processes(rig, rig.scenario.seed, Path(folder), placement)
    if outcome.error:
        raise ScenarioError(outcome.error)
    return outcome


@contextmanager
def _reader(topic: str, domain: int, folder: Path) -> Iterator[None]:
    if not topic:
        yield
        return
    reader = subprocess.Popen([sys.executable, "-c", READER, topic], env=environment(domain, folder))
    try:
        yield
    finally:
        reader.kill()
        reader.wait()
