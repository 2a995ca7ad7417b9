"""Damaged bags through every tool that opens one."""

import json
import random
import shutil
import sqlite3
from contextlib import closing, suppress
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import yaml
from softrig_bags.cli import main_bag, main_compare
from softrig_bags.files.reader import BagReader
from softrig_bags.write import write_bag
from softrig_core import Recording
from softrig_core.wire.cdr import Layout

STATE, VECTOR, NUMBER = "sensor_msgs/msg/JointState", "geometry_msgs/msg/Vector3Stamped", "std_msgs/msg/Float64"


@cache
def whole(storage: str, compression: str) -> Path:
    """An undamaged bag of three topics."""
    recording = Recording([("a/state", STATE), ("b", VECTOR), ("c", NUMBER)])
    layouts = [Layout(STATE, "", ["x", "y"], {"position": 2}), Layout(VECTOR, "abc"), Layout(NUMBER)]
    for k in range(200):
        for i, layout in enumerate(layouts):
            recording.add(i, k * 10**6, layout.encode(k * 10**6, [0.1 * k] * layout.size))
    directory = Path(mkdtemp()) / "bag"
    write_bag(directory, recording, storage=storage, compression=compression, custom_data={"seed": "7"})
    return directory


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Truncate, zero, overwrite, double or blow up a part of a file."""
    at = chance.randrange(len(content) + 1)
    size = chance.choice((1, 4, 8, 64, 512))
    match chance.randrange(7):
        case 0:
            return content[:at]
        case 1:
            return content[:at] + bytes(size) + content[at + size :]
        case 2:
            return content[:at] + chance.randbytes(size) + content[at + size :]
        case 3:
            return content[:at] + b"\xff" * size + content[at + size :]
        case 4:
            return content[:at] + content[at : at + size] * 2 + content[at + size :]
        case 5:
            return content[:at] + content[at + size :]
    return b""


def retyped(victim: Path, chance: random.Random) -> None:
    """Put values of another type into a bag's metadata or a cell of its database."""
    other = [None, {"a": 1}, ["x"], -1, 2**70, 1.5, "text", "", True, {}]
    if victim.suffix == ".db3":
        with closing(sqlite3.connect(victim)) as db:
            table = chance.choice([row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")])
            column = chance.choice([row[1] for row in db.execute(f"PRAGMA table_info({table})")])
            value = chance.choice([None, -1, 1.5, 2**62, "text", "", b"", b"\xff" * 9])
            with suppress(sqlite3.Error):  # SQLite refuses some values in some columns
                db.execute(f"UPDATE {table} SET {column} = ? WHERE rowid % ? = 0", (value, chance.choice((1, 7))))
            db.commit()
    elif victim.suffix == ".yaml":
        content = yaml.safe_load(victim.read_text())
        places = [(content, key) for key in content]
        for holder, key in places:  # `places` grows during the loop
            inner = holder[key]
            places += (
                [(inner, k) for k in (inner if isinstance(inner, dict) else range(len(inner)))]
                if isinstance(inner, dict | list)
                else []
            )
        holder, key = chance.choice(places)
        holder[key] = chance.choice(other)
        victim.write_text(yaml.safe_dump(content))


def attack(seed: int, directory: Path) -> None:
    """Damage a bag, its metadata or its run's metrics.json, and open it with every tool."""
    chance = random.Random(seed)
    source = whole(*chance.choice((("mcap", "none"), ("mcap", "zstd"), ("sqlite3", "none"))))
    bag = directory / "run" / "bag"
    shutil.copytree(source, bag)
    for _ in range(chance.choice((1, 1, 2, 5))):
        victim = chance.choice(sorted(p for p in bag.iterdir() if p.is_file()))
        if chance.random() < 0.1:
            victim.unlink()
            break
        if chance.random() < 0.3 and victim.stat().st_size:
            # An earlier step may have damaged the file.
            with suppress(yaml.YAMLError, sqlite3.Error, UnicodeDecodeError, TypeError):
                retyped(victim, chance)
            continue
        victim.write_bytes(damaged(victim.read_bytes(), chance))
    copy = directory / "copy"
    shutil.copytree(bag, copy)
    statuses = [
        main_bag(["info", str(bag)]),
        main_compare([str(source), str(bag)]),
        main_compare([str(bag), str(bag)]),
        main_bag(["export", str(bag), "--format", "csv", "--out", str(directory / "tables")]),
    ]
    assert set(statuses) <= {0, 1, 2, 3}, statuses
    status = main_bag(["repair", str(copy)])
    assert status in (0, 1, 2, 3), status
    if status == 0:
        with BagReader(copy) as reader:
            assert sum(1 for _ in reader.messages()) == reader.count
    _report(chance, directory)


def _report(chance: random.Random, directory: Path) -> None:
    from softrig_bringup.cli import main

    run = directory / "run"
    texts = dict.fromkeys(("scenario", "title", "system", "source", "error", "command"), "x")
    numbers = dict.fromkeys(("seed", "duration_s", "ticks", "wall_s"), 1)
    maps: dict = {name: {} for name in ("parameters", "versions", "units", "nodes")}
    content = json.dumps({**texts, **numbers, **maps, "mode": "inprocess", "metrics": [], "plots": []})
    (run / "metrics.json").write_bytes(damaged(content.encode(), chance) if chance.random() < 0.7 else content.encode())
    status = main(["report", str(run), "--out", str(directory / "report.html")])
    assert status in (0, 2, 3), status
