"""Long runs in process: recordings are on the disk while the run goes on, and do not stay in memory."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from softrig_bags.read import read_bag
from softrig_bags.repair import repair
from softrig_bringup.cli import main
from softrig_core import simulate
from softrig_core.wire import recording as module

RUN = "import sys; from softrig_bringup.cli import main; sys.exit(main(sys.argv[1:]))"
PEAK = (
    "import sys; from softrig_bringup.cli import main; assert main(sys.argv[1:]) in (0, 1); "
    "print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')))"
)
WORDS = ["run", "induction_dtc", "--mode", "inprocess", "--no-plots"]


def test_a_run_with_messages_on_disk_gives_the_same_files(tmp_path, monkeypatch):
    """Byte for byte: the bag, the pictures and the figures."""
    results = []
    for name, held in (("memory", module.HELD), ("disk", 0)):
        monkeypatch.setattr(module, "HELD", held)
        monkeypatch.chdir(tmp_path)
        main(["run", "induction_dtc", "--mode", "inprocess", "--duration", "0.02", "--out", "r"])
        files = {p.relative_to("r"): p.read_bytes() for p in sorted(Path("r").rglob("*")) if p.is_file()}
        results.append({p: data for p, data in files.items() if p.name != "metrics.json" and p.suffix != ".html"})
        Path("r").rename(name)
    assert results[0] == results[1]
    assert {p.suffix for p in results[0]} == {".mcap", ".yaml", ".svg", ".json"}
    assert not (tmp_path / "disk" / "log").exists()


@pytest.mark.long
@pytest.mark.parametrize("size", [8_000, 1 << 20, 30 << 20])
def test_a_killed_run_leaves_the_first_part_of_its_messages(size, tmp_path):
    """Once its shards have reached a size; the messages are those of the whole run."""
    out = tmp_path / "r"
    child = subprocess.Popen([sys.executable, "-c", RUN, *WORDS, "--duration", "20", "--out", str(out)])
    try:
        while sum(p.stat().st_size for p in out.glob("log/*.shard")) < size:
            assert child.poll() is None
            time.sleep(0.001)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    repair(out / "log")
    kept = read_bag(out / "bag")
    reached = kept.topics["/clock"].times[-1] / 1e9
    whole = simulate("induction_dtc", duration=reached + 0.01).recording
    for name, topic in kept.topics.items():
        n = len(topic.times)
        assert topic.times == whole.topics[name].times[:n]
        assert topic.data == whole.topics[name].data[:n]
    assert sum(map(len, (d for topic in kept.topics.values() for d in topic.data))) > size / 2


@pytest.mark.long
def test_memory_does_not_grow_with_the_messages(tmp_path):
    """A run of 60 s has 6.4 million messages more than one of 25 s; all of them would take 770 MB.

    The first run compiles its native code, which takes memory of its own. A shorter one would stay in Python, without
    the memory of LLVM. The process reads its own peak: what `wait4` returns has that of the process that forked it.
    """
    peak = []
    for duration in ("25", "25", "60"):
        command = [sys.executable, "-c", PEAK, *WORDS, "--duration", duration, "--out", str(tmp_path / duration)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        peak.append(int(done.stdout.split()[-2]) / 1024)
    assert peak[2] < min(peak[1] + 40.0, 300.0)
