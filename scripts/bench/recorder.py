"""Benchmark of the recorder: messages and MB a second without loss, against a bare raw subscription."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.table import Table
from softrig_bags.content.stamps import stamp
from softrig_core import SECOND
from softrig_core.wire.cdr import Layout
from softrig_nodes.below.leave import leave
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment

from .console import console

TOPIC, STATE = "bench", "sensor_msgs/msg/JointState"
STAGE = 0.5  # s of publishing at each rate
SIZES = {
    "140 bytes": (3, (5_000, 10_000, 20_000, 40_000, 80_000)),
    "10 kB": (400, (1_000, 2_000, 4_000, 8_000, 16_000)),
}
RECORDERS = {
    "recorder, mcap": ("--storage", "mcap"),
    "recorder, mcap zstd": ("--storage", "mcap", "--compression", "zstd"),
    "recorder, sqlite3": ("--storage", "sqlite3"),
}


@dataclass(frozen=True)
class Rate:
    """The highest rate that was received without loss, and the one at which losses began (0: none did)."""

    messages: float
    megabytes: float
    lossy: float


def recorder_rate() -> None:
    """The recorder node: messages and MB a second without loss, against a bare raw subscription."""
    for name, (channels, rates) in SIZES.items():
        heads = (f"{name}, reliable, depth 10", "messages/s", "MB/s", "of the bare one", "losses from messages/s on")
        table = Table(*heads, box=None, pad_edge=False)
        bare = _measure(channels, rates, _bare)
        results = {"bare raw subscription, EventsExecutor": bare}
        for label, options in RECORDERS.items():
            results[label] = _measure(channels, rates, partial(_record, options))
        for label, rate in results.items():
            share = f"{rate.messages / bare.messages:.2f}" if bare.messages else "-"
            lossy = f"{rate.lossy:,.0f}" if rate.lossy else "none"
            table.add_row(label, f"{rate.messages:,.0f}", f"{rate.megabytes:.1f}", share, lossy)
        console.print(table)


Listener = Callable[[Path, dict[str, str]], tuple["subprocess.Popen[str]", Callable[[str], Counter[int]]]]


def _measure(channels: int, rates: Sequence[int], listen: Listener) -> Rate:
    """Publish at rising rates to a listener and see which rates it receives completely."""
    with free_domain() as domain, tempfile.TemporaryDirectory() as folder:
        variables = environment(domain, Path(folder))
        listener, counts = listen(Path(folder), variables)
        try:
            publisher = subprocess.run(
                [sys.executable, "-P", "-m", "bench.recorder", "publish", str(channels), *map(str, rates)],
                env=variables,
                capture_output=True,
                text=True,
                check=True,
                timeout=120,
            )
            listener.send_signal(signal.SIGINT)
            output = listener.communicate(timeout=60)[0]
        finally:
            listener.kill()
            listener.wait()
        received = counts(output)
    size = Layout(STATE, "", "abc", dict.fromkeys(("position", "velocity", "effort"), channels)).length
    best = 0.0
    for stage, (sent, rate) in enumerate(json.loads(publisher.stdout)):
        if received[stage] != sent:
            return Rate(best, best * size / 1e6, rate)
        best = rate
    return Rate(best, best * size / 1e6, 0.0)


def _bare(folder: Path, variables: dict[str, str]) -> tuple[subprocess.Popen[str], Callable[[str], Counter[int]]]:
    command = [sys.executable, "-P", "-m", "bench.recorder", "listen"]
    process = subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, text=True)
    return process, lambda output: Counter({int(k): v for k, v in json.loads(output).items()})


def _record(
    options: Sequence[str], folder: Path, variables: dict[str, str]
) -> tuple[subprocess.Popen[str], Callable[[str], Counter[int]]]:
    from softrig_bags.files.reader import BagReader

    bag = folder / "bag"
    command = [
        sys.executable,
        "-c",
        "import sys; from softrig_bags.cli import main_record; sys.exit(main_record())",
        f"/{TOPIC}",
        "--output",
        str(bag),
        *options,
    ]
    process = subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)

    def counts(output: str) -> Counter[int]:
        with BagReader(bag) as reader:
            return Counter(stamp(data) // SECOND for _, _, data in reader.messages())

    return process, counts


def _publish(channels: int, rates: Sequence[int]) -> None:
    """Publish a stage at each rate; stamps carry the stage in their seconds. Prints (messages, rate reached)."""
    from rclpy.duration import Duration
    from rclpy.qos import QoSProfile
    from softrig_bags.live.ros import Session
    from softrig_nodes.ros.messages import message_class

    session = Session("bench_publisher", [])
    publisher = session.node.create_publisher(message_class(STATE), TOPIC, QoSProfile(depth=10))
    layout = Layout(STATE, "", "abc", dict.fromkeys(("position", "velocity", "effort"), channels))
    values = (0.5,) * layout.size
    while not publisher.get_subscription_count():
        session.spin(0.02)
    # Unmeasured, since the first message initialises both sides.
    publisher.publish(layout.encode(1000 * SECOND, values))
    publisher.wait_for_all_acked(Duration(seconds=5))
    stages = []
    for stage, rate in enumerate(rates):
        count = round(rate * STAGE)
        start = time.perf_counter()
        for k in range(count):
            while time.perf_counter() - start < k / rate:
                pass
            publisher.publish(layout.encode(stage * SECOND + k, values))
        stages.append((count, count / (time.perf_counter() - start)))
        publisher.wait_for_all_acked(Duration(seconds=5))
    print(json.dumps(stages))
    leave([session.node], 0)


def _listen() -> None:
    """Count messages by stage until SIGINT."""
    from rclpy.qos import QoSProfile
    from softrig_bags.live.ros import Session, subscription_profile
    from softrig_nodes.ros.messages import message_class

    session = Session("bench_listener", [])
    received: Counter[int] = Counter()

    def receive(data: bytes) -> None:
        received[stamp(data) // SECOND] += 1

    profile = subscription_profile([QoSProfile(depth=10)])
    session.node.create_subscription(message_class(STATE), TOPIC, receive, profile, raw=True)
    while not session.stopped:
        session.spin(1.0)
    session.settle()
    print(json.dumps(received))
    leave([session.node], 0)


if __name__ == "__main__":
    if sys.argv[1] == "publish":
        _publish(int(sys.argv[2]), [int(r) for r in sys.argv[3:]])
    else:
        _listen()
