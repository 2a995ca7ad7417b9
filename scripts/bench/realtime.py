"""How punctual the induction motor's drive is in real time, all its nodes in one container."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
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

RATES = (2_000, 5_000, 10_000, 20_000)  # Hz, of plant, law and monitor
WAYS = {"thread": "", "bursts": "carrier"}  # how messages leave a tick, and the value of VARIABLE
READERS = ("", "torque_ref", "joint_states")  # topics read by another process; the last one at the rate of the plant
DURATION = 10.0  # s
LONG = 60.0  # s, at the highest rate with each reader
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


def realtime() -> None:
    """Deadlines missed by the induction motor's drive in one container, with a reader of a topic in another process."""
    columns = ("Hz", "s", "read outside", "by", "missed", "late", *TIMES, "recorded")
    table = Table(*columns, box=None, pad_edge=False)
    broke = []
    with Live(table, console=console):  # shows what is done, whatever becomes of the rest
        for rate, duration in [*((rate, DURATION) for rate in RATES), (RATES[-1], LONG)]:
            # At the highest rate both ways take turns.
            both = [(topic, way) for topic in READERS for way in (WAYS if topic and rate == RATES[-1] else ["thread"])]
            for topic, way in both:
                try:
                    results = _figures(drive(rate, topic, duration, way))
                except (RunError, ScenarioError) as error:
                    results = ["broke"]
                    broke.append(f"{rate:,} Hz, {duration:.0f} s, {topic or 'nothing'} read: {error}")
                table.add_row(f"{rate:,}", f"{duration:.0f}", topic or "nothing", way if topic else "", *results)
    if broke:
        raise SystemExit("\n".join(broke))


def _figures(outcome: Outcome) -> list[str]:
    """Return the cells of a row about a run: a tick is late if it begins when the next one is due."""
    plant = outcome.status["im_plant"]
    due = plant["ticks"] + plant["missed_deadlines"]
    recorded = len(outcome.recording.topics["joint_states"].data)
    times = [f"{plant[key] * 1e3:.0f}" for key in TIMES.values()]
    shares = plant["missed_deadlines"] / due, plant.get("late_ticks", 0) / due
    return [*(f"{share:.2%}" for share in shares), *times, f"{recorded / plant['ticks']:.2%}"]


def drive(rate: int, topic: str, duration: float, way: str = "thread") -> Outcome:
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
