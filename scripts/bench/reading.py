"""Benchmark of reading bags: CPU time and memory of the verbs, beside the readers of rosbags and mcap."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from softrig_bags.content.topics import BagTopic, qos
from softrig_bags.files.bag import BagWriter
from softrig_core.wire.cdr import Layout

from .page import Table, Tables

MESSAGES = 5_000_000
SAMPLE = 100_000  # messages for the other readers, whose time is proportional to the number
TOPICS, JOINTS, BLOCK = 4, 6, 4096
STATE = "sensor_msgs/msg/JointState"
START = 1_764_000_000_000_000_000
OURS = {
    "bag info": "from softrig_bags.info import describe; work = lambda: describe(path)",
    "signals: arrays": "from softrig_bags.read import signals; work = lambda: signals(path)",
    "bag export: parquet": "import pyarrow.parquet; from softrig_bags.export import export; "
    "work = lambda: export(path, out, 'parquet')",
    "bag compare, two bags": "from softrig_bags.compare import compare; work = lambda: compare(path, path)",
}
THEIRS = {
    "rosbags, deserialised": """
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
store = get_typestore(Stores.ROS2_JAZZY)
def messages():
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            yield store.deserialize_cdr(data, connection.msgtype)
""",
    "mcap with mcap-ros2-support": """
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
def messages():
    with next(path.glob("*.mcap")).open("rb") as file:
        for *_, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            yield message
""",
}
HEAD = "import json, sys, time; from itertools import islice; from pathlib import Path\n"
HEAD += "path, out, count = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])\n"
TAIL = """
begin = time.process_time()
work()
spent = time.process_time() - begin
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))  # of this program alone
print(json.dumps([spent, int(peak.split()[1]) / 1024]))
"""


class Cost(NamedTuple):
    """CPU time of a million messages in s, and the largest resident memory in MB."""

    seconds: float
    memory: float


def make(folder: Path, count: int, compression: str) -> float:
    """Write a bag of joint states, 1 kHz on each of the topics; return its size in MB."""
    names = [f"joint_{i}" for i in range(JOINTS)]
    layout = Layout(STATE, "base_link", names, dict.fromkeys(("position", "velocity", "effort"), JOINTS))
    writer = BagWriter(folder, compression=compression)
    topics = [writer.add_topic(BagTopic.known(f"/robot_{k}/joint_states", STATE, [qos()])) for k in range(TOPICS)]
    write = writer.write
    for first in range(0, count // TOPICS, BLOCK):
        ticks = np.arange(first, min(first + BLOCK, count // TOPICS))
        times = START + 1_000_000 * ticks
        x = np.sin(1e-3 * ticks[:, None] + np.arange(layout.size))
        rows = [layout.encode_block(times + k, x + k) for k in range(TOPICS)]
        for i, t in enumerate(times.tolist()):
            for k, topic in enumerate(topics):
                write(topic, t + 1000 * k, rows[k][i].tobytes())
    writer.close()
    return sum(file.stat().st_size for file in folder.iterdir()) / 1e6


def measure(code: str, bag: Path, out: Path, count: int) -> Cost | None:
    """Run a reader in a process of its own; None where its library is not installed."""
    done = subprocess.run(
        [sys.executable, "-c", HEAD + code + TAIL, bag, out, str(count)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        if "ModuleNotFoundError" in done.stderr:
            return None
        raise RuntimeError(done.stderr)
    seconds, memory = json.loads(done.stdout)
    return Cost(seconds / count * 1e6, memory)


def costs(folder: Path, compression: str, count: int = MESSAGES, sample: int = SAMPLE) -> dict[str, Cost | None]:
    """Measure all readers on one bag, and the cost of all messages as objects."""
    bag = folder / compression
    make(bag, count, compression)
    result = {name: measure(code, bag, folder / "out", count) for name, code in OURS.items()}
    for name, code in THEIRS.items():
        each = "\ndef work():\n    for _ in islice(messages(), count): pass\n"
        result[name] = measure(code + each, bag, folder / "out", sample)
    holding = "\ndef work():\n    global held\n    held = list(islice(messages(), count))\n"
    one, two = (
        measure(THEIRS["rosbags, deserialised"] + holding, bag, folder / "out", n) for n in (sample // 2, sample)
    )
    if one is not None and two is not None:  # the difference of both excludes the memory of everything else
        result["all messages held, rosbags"] = Cost(two.seconds, (two.memory - one.memory) * count / (sample / 2))
    return result


def reading() -> Tables:
    """Reading bags: CPU time of a million messages and memory, beside rosbags and mcap-ros2-support."""
    tables: Tables = {}
    for compression in ("none", "zstd"):
        with tempfile.TemporaryDirectory() as folder:
            result = costs(Path(folder), compression)
        beside = [name for name in THEIRS if result[name] is not None]
        heads = (f"{MESSAGES / 1e6:g} M JointState, {compression}", "CPU s a million messages", "peak MB")
        rows: Table = [(*heads, *(f"times {name.split(',')[0]}" for name in beside))]
        for name, cost in result.items():
            if cost is None:
                rows.append((name, "not installed", *[""] * (1 + len(beside))))
                continue
            read = cost.seconds / (2 if "two" in name else 1)  # s for each bag
            ratios = [f"{other.seconds / read:.1f}" for peer in beside if (other := result[peer]) is not None]
            own = ratios if name in OURS else [""] * len(beside)
            rows.append((name, f"{cost.seconds:.2f}", f"{cost.memory:,.0f}", *own))
        tables[f"reading {compression}"] = rows
    return tables
