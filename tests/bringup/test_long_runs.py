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


def test_pages_and_pictures_of_bags_are_the_same_with_columns_on_disk(tmp_path, monkeypatch):
    """Byte for byte: the page of a run, that of two runs, and pictures by matplotlib."""
    monkeypatch.chdir(tmp_path)
    for seed in "12":
        main(
            [
                "run",
                "induction_dtc",
                "--mode",
                "inprocess",
                "--duration",
                "0.02",
                "--no-plots",
                "--seed",
                seed,
                "--out",
                f"r{seed}",
            ]
        )
    results = []
    for stretch in (1 << 15, 50):
        for name in ("softrig_bags.tables.STRETCH", "softrig_core.wire.long.STRETCH"):
            monkeypatch.setattr(name, stretch)
        out = Path(f"out{stretch}")
        out.mkdir()
        assert main(["report", "r1", "--out", str(out / "one.html")]) == 0
        assert main(["report", "r1", "r2", "--out", str(out / "two.html")]) == 0
        assert main(["draw", "plot", "r1", "--out", str(out / "plots")]) == 0
        results.append({p.relative_to(out): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()})
    assert results[0] == results[1]
    assert len(results[0]) > 3


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
    the memory of LLVM. Native calls have their full length: on a busy machine they would be shorter in one of the runs,
    and their tables smaller, by up to 40 MB. The process reads its own peak: what `wait4` returns has that of the
    process that forked it.
    """
    code, peak = f"from softrig_core.native import engine; engine.GO = 3600.0; {PEAK}", []
    for duration in ("25", "25", "60"):
        command = [sys.executable, "-c", code, *WORDS, "--duration", duration, "--out", str(tmp_path / duration)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        peak.append(int(done.stdout.split()[-2]) / 1024)
    assert peak[2] < min(peak[1] + 40.0, 300.0), peak
