"""A run while the clock of the machine is stepped back and forth: in lockstep the same bits, in real time the same
pace.
"""

import hashlib
import mmap
import os
import random
import struct
import subprocess
import sys
import tempfile
import threading
from functools import cache
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from conftest import differences, in_process
from softrig_bags.read import read_bag
from softrig_core import load_scenario, rig_of
from traces import orphans

RIGS = ("dc_motor_smc_b2", "induction_dtc", "dc_motor_fsfb_s1_none", "manipulator_adsmc")
# Rigs that may not keep up with the wall clock on a busy machine.
SLOW = ("manipulator_adsmc", "rehab_impedance", "optimal_control_mvim")
LENGTHS = (1e-3, 0.5, 10.0, 3600.0, 86400.0, 1e8)  # s, by which the clock jumps in either direction
SHIM = Path(__file__).with_name("clock.c")


@cache
def shim() -> Path:
    """Compile the preloaded library, once."""
    made = Path(tempfile.gettempdir()) / f"clock-{os.getuid()}-{hashlib.sha256(SHIM.read_bytes()).hexdigest()[:16]}.so"
    if not made.exists():
        new = made.with_suffix(f".{os.getpid()}")
        subprocess.run(["cc", "-O2", "-shared", "-fPIC", str(SHIM), "-o", str(new), "-ldl", "-lpthread"], check=True)
        new.replace(made)
    return made


def attack(seed: int, directory: Path) -> None:
    """Start one run as the command line does, and step the clock of all its processes some times a second."""
    chance = random.Random(seed)
    mode, realtime = chance.choice(("processes", "container")), chance.random() < 0.4
    name, duration = (chance.choice(SLOW), 5.0) if realtime else (chance.choice(RIGS), chance.choice((0.5, 2.0)))
    command = ["run", name, "--mode", mode, "--no-plots", "--seed", str(seed), "--duration", str(duration)]
    command += ["--realtime"] if realtime else []
    ahead, out = directory / "ahead", directory / "out"
    ahead.write_bytes(bytes(8))
    variables = os.environ | {"LD_PRELOAD": str(shim()), "FAKE_CLOCK": str(ahead)}
    (directory / "case").write_text(" ".join(command) + "\n")
    over = threading.Event()
    stepping = threading.Thread(target=step, args=(chance, ahead, over))
    stepping.start()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "softrig_bringup", *command, "--out", str(out)],
            env=variables, capture_output=True, text=True, timeout=200.0, check=False,
        )  # fmt: skip
    finally:
        over.set()
        stepping.join()
        left = orphans(directory)
    text = done.stderr[-1500:]
    assert done.returncode in (0, 1), f"status {done.returncode}: {text}"
    assert "Traceback" not in done.stderr, text
    assert left == [], f"{len(left)} processes live on"
    recording = read_bag(out / "bag")
    if realtime:
        for topic in recording.topics.values():
            assert topic.times == sorted(topic.times), f"{topic.name}: goes back"
        times = [t for topic in recording.topics.values() for t in topic.times]
        assert abs(max(times) - min(times) - duration * 1e9) < 0.2e9, f"{(max(times) - min(times)) / 1e9} s recorded"
        return
    rig = rig_of(load_scenario(name).model_copy(update={"duration": duration}))
    different = differences(in_process(rig, seed), recording)
    assert not different, f"other bits on {different}"


def step(chance: random.Random, ahead: Path, over: threading.Event) -> None:
    """Step the clock now and then until the run has ended; processes started during the run see one or two steps."""
    with ahead.open("r+b") as file, mmap.mmap(file.fileno(), 8) as shared:
        while not over.wait(chance.uniform(0.5, 5.0)):
            struct.pack_into("q", shared, 0, int(chance.choice((-1, 1)) * chance.choice(LENGTHS) * 1e9))
