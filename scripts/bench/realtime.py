"""How punctual the induction motor's drive is in real time, all its nodes in one container."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.table import Table
from softrig_core import ScenarioError, rig_of, run_processes
from softrig_core.processes.domain import free_domain
from softrig_core.processes.executables import environment
from softrig_core.processes.placement import Placement
from softrig_core.processes.processes import Outcome

from .console import console

RATES = (2_000, 5_000, 10_000, 20_000)  # Hz, of plant, law and monitor
READERS = ("", "torque_ref", "joint_states")  # topics read by another process; the last one at the rate of the plant
DURATION = 10.0  # s
LONG = 60.0  # s, at the highest rate with each reader
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
    table = Table(
        "Hz",
        "s",
        "read outside",
        "missed",
        "lateness us p50",
        "p99",
        "round trip us p50",
        "p99",
        "recorded",
        box=None,
        pad_edge=False,
    )
    for rate, duration in [*((rate, DURATION) for rate in RATES), (RATES[-1], LONG)]:
        for topic in READERS:
            outcome = drive(rate, topic, duration)
            plant = outcome.status["im_plant"]
            due = plant["ticks"] + plant["missed_deadlines"]
            recorded = len(outcome.recording.topics["joint_states"].data)
            times = [
                f"{plant[f'{name}_ms'] * 1e3:.0f}"
                for name in ("lateness_p50", "lateness_p99", "round_trip_p50", "round_trip_p99")
            ]
            table.add_row(
                f"{rate:,}",
                f"{duration:.0f}",
                topic or "nothing",
                f"{plant['missed_deadlines'] / due:.2%}",
                *times,
                f"{recorded / plant['ticks']:.2%}",
            )
    console.print(table)


def drive(rate: int, topic: str, duration: float) -> Outcome:
    """Run the drive at a rate (Hz) for a time (s), with a reader of a topic if one is named."""
    periods = {f"{node}.period": 1.0 / rate for node in ("im_plant", "dtc_controller", "flux_monitor")}
    rig = rig_of("induction_dtc", duration=duration, overrides=periods)
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain, _reader(topic, domain, Path(folder)):
        placement = Placement("container", "realtime", domain)
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
