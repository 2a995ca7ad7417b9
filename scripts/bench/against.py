"""Compare this checkout with another commit by the CPU time of commands that a user waits for, in turn."""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from rich.table import Table
from softrig_core import ScenarioError
from softrig_core.kit.compiled import cache_folder

from .console import console

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "ros_pkgs/softrig_bringup/doc/lab/against.md"
MARKS = r"(<!-- {} -->\n).*?(<!-- end -->)"
RUN = "run dc_motor_smc_b2 --mode inprocess --out"
# commands that a person waits for: words after scripts/softrig; OUT is a new place, made is the result of `PREPARED`
COMMANDS = {
    "list": "list",
    "help": "--help",
    "run in process, 25 s of dc_motor_smc_b2": f"{RUN} OUT",
    "run through processes, 0.01 s": "run dc_motor_smc_b2 --mode processes --duration 0.01 --out OUT",
    "run in a container, 20 s of induction_dtc": "run induction_dtc --mode container --duration 20 --out OUT",
    "report": "report made",
    "bag info": "bag info made/bag",
    "bag compare": "bag compare made/bag made/bag",
    "study, 2 runs": "study dc_motor_smc_b2 --grid dc_motor_smc.delta=1,5 --out OUT",
    "study, 400 runs of 2 s of induction_dtc": "study induction_dtc --duration 2 --draw im_plant.U_dc=500..560 "
    "--draws 400 --out OUT",
    "falsify, 100 runs of 2 s of induction_dtc": "falsify induction_dtc --duration 2 --requirement tracks "
    "--requirement flux_band --over im_plant.R_s=3.5..3.9 --budget 100 --out OUT",
}
PREPARED = f"{RUN} made"
# One scenario of each system, at its full length.
SCENARIOS = (
    "dc_motor_smc", "dc_motor_fsfb", "induction_dtc", "lsrm_fuzzy", "tcp_aqm_smc", "manipulator_adsmc",
    "rehab_impedance", "gupfc", "pv_mppt", "rectifier_mpc", "pwa_delay", "fault_location", "optimal_control_mvim",
    "economic_dispatch",
)  # fmt: skip
MODES = {"plain": {"SOFTRIG_JIT": "0"}, "default": {}}  # of Python alone, and as it is chosen
WHOLE = """
import sys, time
from softrig_core import simulate
begun = time.process_time()
simulate(sys.argv[1])
print(time.process_time() - begun)
"""


def built(commit: str) -> Path:
    """Return a checkout of a commit with a set-up of its own, made on first use in the cache of softrig.

    Raises
    ------
    ScenarioError
        No such commit, or its set-up fails.
    """
    asked = ["git", "-C", str(ROOT), "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}"]
    result = subprocess.run(asked, capture_output=True, text=True)
    if result.returncode:
        raise ScenarioError(f"bench against {commit!r}: no such commit in {ROOT}, expected one that `git log` lists")
    place = cache_folder() / "builds" / result.stdout.strip()[:12]
    if not (place / ".git").exists():
        place.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=place.parent) as scratch:
            whole = Path(scratch, "checkout")
            subprocess.run(["git", "clone", "--quiet", "--no-checkout", ROOT, whole], check=True)
            subprocess.run(["git", "-C", whole, "checkout", "--quiet", result.stdout.strip()], check=True)
            whole.rename(place)
    if subprocess.run([place / "scripts/softrig", "setup"], env=plain()).returncode:
        raise ScenarioError(f"bench against {commit!r}: the set-up of {place} failed, as told above")
    return place


def plain() -> dict[str, str]:
    """Return the environment without the additions of this checkout's script."""
    ours = ("AMENT_", "PYTHON", "VIRTUAL_ENV", "SOFTRIG_", "_ROS_", "LD_PRELOAD", "OMP_", "OPENBLAS_", "NPY_")
    path = [p for p in os.environ["PATH"].split(os.pathsep) if p != f"{os.environ.get('VIRTUAL_ENV')}/bin"]
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    return kept | {"PATH": os.pathsep.join(path), "SOFTRIG_WORKSPACE": "none"}


def cost(checkout: Path, words: str, folder: Path) -> float:
    """Run a command of a checkout and return the CPU time of it and of its processes in s.

    Raises
    ------
    ScenarioError
        It failed; with the end of what it wrote.
    """
    place = Path(tempfile.mkdtemp(dir=folder))
    command = [str(checkout / "scripts/softrig"), *words.replace("OUT", str(place / "out")).split()]
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(command, cwd=folder, env=plain(), stdout=output, stderr=output)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        if process.returncode not in (0, 1):  # 1: a figure of a changed run misses
            raise ScenarioError(f"{' '.join(command)}: status {process.returncode}: {output.read()[-500:]}")
    return used.ru_utime + used.ru_stime


def compared(other: Path, names: Sequence[str], rounds: int) -> dict[str, tuple[list[float], list[float]]]:
    """Run commands of another checkout and of this one in turn; the first round, which compiles, is left out."""
    result: dict[str, tuple[list[float], list[float]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folders = {checkout: Path(scratch, name) for checkout, name in ((other, "before"), (ROOT, "now"))}
        for checkout, folder in folders.items():
            folder.mkdir()
            cost(checkout, PREPARED, folder)
        for name in names:
            costs: dict[Path, list[float]] = {other: [], ROOT: []}
            for _ in range(rounds + 1):
                for checkout, folder in folders.items():
                    costs[checkout].append(cost(checkout, COMMANDS[name], folder))
            result[name] = (costs[other][1:], costs[ROOT][1:])
    return result


def rows(values: dict[str, tuple[list[float], list[float]]]) -> list[tuple[str, ...]]:
    """Return name, CPU time before and now, and their ratio, each the median over rounds."""
    return [
        (
            name,
            f"{median(before):.2f}",
            f"{median(now):.2f}",
            f"{median(n / b for b, n in zip(before, now, strict=True)):.2f}",
        )
        for name, (before, now) in values.items()
    ]


def whole(checkout: Path, scenario: str, settings: Mapping[str, str]) -> float:
    """Run a scenario in a fresh process of a checkout and return the CPU time from its file to its verdict in s.

    Raises
    ------
    ScenarioError
        It failed; with the end of what it wrote.
    """
    command = [str(checkout / "scripts/softrig"), "python", "-c", WHOLE, scenario]
    result = subprocess.run(command, cwd=checkout, env=plain() | dict(settings), capture_output=True, text=True)
    if result.returncode:
        raise ScenarioError(f"{scenario} in {checkout}: status {result.returncode}: {result.stderr[-500:]}")
    return float(result.stdout.split()[-1])


def run_rows(places: tuple[Path, Path], names: Sequence[str], mode: str, rounds: int) -> list[tuple[str, ...]]:
    """Run scenarios in two checkouts in turn.

    Returns
    -------
    list of tuple of str
        Scenario, the least CPU time before and now, and their ratio.
    """
    result: list[tuple[str, ...]] = []
    warm = mode == "default"  # its first round compiles
    for name in names:
        actual = [[whole(place, name, MODES[mode]) for place in places] for _ in range(rounds + warm)][warm:]
        before, now = (min(costs) for costs in zip(*actual, strict=True))
        result.append((name, f"{before:.3f}", f"{now:.3f}", f"{now / before:.2f}"))
        console.print(*result[-1])
    return result


def written(mark: str, lines: Sequence[tuple[str, ...]]) -> str:
    """Return the page of measurements with a table in place of the one that has this mark."""
    text = "\n".join(f"| {' | '.join(line)} |" for line in (lines[0], ("---",) * len(lines[0]), *lines[1:]))
    return re.sub(MARKS.format(mark), lambda m: f"{m[1]}{text}\n{m[2]}", PAGE.read_text(), flags=re.DOTALL)


def main(arguments: Sequence[str]) -> int:
    """Build a commit beside this checkout, run the same commands in both in turn, and print the table."""
    parser = argparse.ArgumentParser(
        prog="scripts/softrig bench against",
        description=main.__doc__,
        epilog="commands:\n" + "\n".join(f"  {name:42}{words}" for name, words in COMMANDS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("commit", metavar="COMMIT", help="what to compare with")
    parser.add_argument("names", nargs="*", metavar="NAME", help="beginnings of the commands to run (default: all)")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="of each command, in turn (default: 3)")
    parser.add_argument("--runs", choices=MODES, help="whole runs of scenarios in place of commands, least times")
    parser.add_argument("--write", action="store_true", help=f"write the table to {PAGE.relative_to(ROOT)}")
    options = parser.parse_args(arguments)
    if options.rounds < 1:
        parser.error(f"--rounds {options.rounds}: expected at least 1")
    kind, known = ("scenario", SCENARIOS) if options.runs else ("command", tuple(COMMANDS))
    names = [n for n in known if not options.names or n.startswith(tuple(options.names))]
    if not names:
        parser.error(f"no {kind} begins with {', '.join(options.names)}; there are {', '.join(known)}")
    other, heads = built(options.commit), (kind, "CPU s before", "CPU s now", "ratio")
    if options.runs:
        # A build of the newest commit: numba imports packages of a set-up for tests (coverage), which takes 0.2 s.
        result = run_rows((other, built("HEAD")), names, options.runs, options.rounds)
    else:
        result = rows(compared(other, names, options.rounds))
    lines = [heads, *result]
    table = Table(*lines[0])
    for line in lines[1:]:
        table.add_row(*line)
    console.print(table)
    if options.write:
        PAGE.write_text(written(options.runs or "against", lines))
    return 0
