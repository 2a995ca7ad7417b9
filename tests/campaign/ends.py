"""Each phase of `run` and `view` is interrupted by signals of another process: its report is true, and nothing stays
behind.
"""

import json
import os
import random
import re
import shlex
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from kills import drawn, ended, fork, judge_record
from softrig_bringup.cli import main
from softrig_core import load_scenario, rig_of
from softrig_core.timebase import SECOND
from traces import left_in_memory, of_run, orphans, segments

VERB, RUN = "softrig_bringup.verbs.run_verb", "softrig_bringup.run.run"
NOTHING, AGAIN = "nothing was run or written", "no bag, no figures and no pictures are in "
MIDWAY = "stopped by {} at t = "
PICTURES, TABLE = "pictures and report are not; `softrig report ", "the table was not printed; it is in "
PHASES = {  # the function that is called in each phase, and the text of the line
    "start": (f"{VERB}.checked", NOTHING),
    "folder": (f"{VERB}.execute", AGAIN),
    "nodes": ("", MIDWAY),
    "loop": ("", MIDWAY),
    "figures": (f"{VERB}.summary", PICTURES),
    "bag": (f"{RUN}.write_bag", PICTURES),
    "pictures": (f"{RUN}.plot_run", PICTURES),
    "report": (f"{RUN}.write_report", PICTURES),
    "table": (f"{VERB}.print_judged", TABLE),
    "page": ("", ""),
    "any": ("", ""),
}
DOORS = [(door, mode) for door in ("run", "view") for mode in ("inprocess", "processes", "container")]
CASES = [
    (door, mode, phase)
    for phase in PHASES
    for door, mode in DOORS
    if (phase != "page" or door == "view")
    and (phase not in ("folder", "nodes") or (door, mode) != ("view", "inprocess"))
]
SIGNALS = [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT,) * 2, (signal.SIGTERM,) * 2,
           (signal.SIGINT, signal.SIGTERM), (signal.SIGHUP,), (signal.SIGQUIT,) * 2]  # fmt: skip
TICKS = 400
LATEST = 6.0  # s from the signal to the end of the process


def attack(seed: int, directory: Path) -> None:
    """Interrupt one run in one phase, and compare its report with its files."""
    chance = random.Random(seed)
    door, mode, phase = CASES[seed % len(CASES)]
    signals = SIGNALS[(seed // len(CASES)) % len(SIGNALS)]
    name, out, text = drawn(chance), directory / "out", directory / "said"
    rig = rig_of(name)
    duration = rig.clock.schedule.time(min(TICKS, rig.ticks - 1)) / SECOND
    # Its nodes run natively, so a shorter run would end before its first report of progress.
    if (mode, phase) == ("container", "loop"):
        duration *= 100.0
    command = [door, name, "--mode", mode, "--duration", repr(duration), "--seed", str(seed), "--out", str(out)]
    command += ["--running", "--pace", "full"] if door == "view" else []
    words = " ".join(s.name for s in signals)
    (directory / "case").write_text(f"{words} in {phase}: {' '.join(command)}\n")
    before = segments()
    (marked_end, marks), (go_read, go) = os.pipe(), os.pipe()
    runner = fork(command, text, lambda: marked(phase, duration, marks, go_read, go))
    for end in (marks, go_read):
        os.close(end)
    try:
        strike(chance, runner, phase, signals, marked_end)
        os.close(go)
        status = ended(runner)
        domain = next((int(v["ROS_DOMAIN_ID"]) for _, v in of_run(directory) if "ROS_DOMAIN_ID" in v), None)
        printed = text.read_text(errors="replace")
        assert "Traceback" not in printed, printed[-2000:]
        assert (left := orphans(directory)) == [], f"{len(left)} processes of the run live on"
        judge(status, phase, signals, printed, out)
        scenario = load_scenario(name).having(duration=duration)
        judge_record(scenario, seed, out, directory)
        assert (files := left_in_memory(before, domain)) == [], f"left in shared memory: {files[:3]}"
    finally:
        os.close(marked_end)
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(runner, signal.SIGKILL)
            os.waitpid(runner, 0)


def marked(phase: str, duration: float, marks: int, go_read: int, go: int) -> None:
    """Make the run report the beginning of a phase, and wait there until it has been interrupted."""
    os.close(go)  # otherwise the read below would not end when the other process closes the pipe
    if phase == "any":
        os.write(marks, b"x")
        return

    def mark() -> None:
        nonlocal phase
        if phase:
            phase = ""
            os.write(marks, b"x")
            os.read(go_read, 1)

    def before(where: str, when: Callable[..., bool] = lambda *_: True) -> None:
        owner, _, name = where.rpartition(".")
        try:
            place: Any = import_module(owner)
        except ModuleNotFoundError:
            module, _, inner = owner.rpartition(".")
            place = getattr(import_module(module), inner)
        real = getattr(place, name)

        def called(*arguments: Any, **options: Any) -> Any:
            if when(*arguments):
                mark()
            return real(*arguments, **options)

        setattr(place, name, called)

    if phase == "nodes":
        before(f"{RUN}.run_inprocess")
        before("softrig_nodes.processes.processes.supervise")
    elif phase == "loop":
        half = duration / 2 * SECOND
        before("softrig_bringup.view.here.SessionSource._step", lambda page: page.session.t > duration / 2)
        verb: Any = import_module(VERB)
        progress = verb.progress

        @contextmanager
        def watched(*arguments: Any) -> Iterator[Callable[[int], None]]:
            with progress(*arguments) as tell:

                def reached(t: int) -> None:
                    if t > half:
                        mark()
                    tell(t)

                yield reached

        verb.progress = watched
    elif phase == "page":
        before("softrig_bringup.view.here.Pages.left", lambda pages: pages._source.outcome)
        before("softrig_bringup.view.run_pages.print_line", lambda text: text.startswith("the page stays"))
    else:
        before(PHASES[phase][0])


def strike(
    chance: random.Random, runner: int, phase: str, signals: tuple[signal.Signals, ...], marked_end: int
) -> None:
    """Send the signals when the run has reported its phase."""
    assert os.read(marked_end, 1), "the run ended before that phase"
    if phase == "any":
        time.sleep(chance.uniform(0.0, LATEST))
    for number in signals:
        with suppress(ProcessLookupError):
            os.kill(runner, number)
        time.sleep(chance.choice((0.0, 0.01, 0.3)))


def judge(status: int, phase: str, signals: tuple[signal.Signals, ...], printed: str, out: Path) -> None:
    """Compare status and report with the files."""
    lines = [line for line in printed.splitlines() if line.startswith("softrig: stopped")]
    written = (out / "metrics.json").exists() and (out / "report.html").exists()
    if phase == "page" or (phase == "any" and status in (0, 1)):  # the run may have ended before the signal
        assert status in (0, 1), f"status {status}: {printed[-500:]}"
        assert written, "judged, but not all is written"
        assert not lines, lines
        return
    if phase == "any" and not out.exists() and status < 0:  # the signal arrived before the command line was parsed
        return
    # A second, different signal may interrupt the writing of results that the first one has caused.
    ends = signals if phase in ("nodes", "loop", "any") else signals[:1]
    number = next((s for s in ends if status == 128 + s), None)
    assert number is not None, f"status {status}: {printed[-500:]}"
    assert len(lines) == 1, lines or printed[-500:]
    assert f"stopped by {number.name}" in lines[0], lines
    if phase != "any":
        allowed = [PHASES[phase][1].format(number.name)]
        if len(signals) > 1 and phase in ("nodes", "loop"):  # the second signal may arrive while results are written
            allowed += [AGAIN, PICTURES, TABLE]
        assert any(text in lines[0] for text in allowed), lines
    keep(lines[0], out)


def keep(line: str, out: Path) -> None:
    """Check that the command in the report makes what is missing."""
    if NOTHING in line:
        assert not out.exists() or not [p for p in out.iterdir() if p.name not in ("log", ".softrig")], [*out.iterdir()]
        return
    for made in re.findall(r"`softrig ([^`]*)`", line):
        assert main(shlex.split(made)) == 0, made
    metrics = json.loads((out / "metrics.json").read_text()) if (out / "metrics.json").exists() else None
    if metrics is not None:
        assert (out / "bag").is_dir(), "figures without a bag"
        assert (out / "report.html").exists(), f"no report after: {line}"
        assert metrics["stopped"] or "at t = " not in line, line
