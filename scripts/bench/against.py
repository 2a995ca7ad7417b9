"""Compare this checkout with another commit by what a user waits for: both builds in turn."""

from __future__ import annotations

import argparse
import shlex
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from softrig_core import ScenarioError
from softrig_core.kit.compiled import cache_folder

from .against_rows import PREPARED, ROWS, Values, cost, plain
from .console import console
from .page import ROOT, Begin, Table, page, show, write

PAGE = page(
    "bringup",
    "against",
    "CPU s is the user and system time of a command and its processes, with compiled code in the cache and fresh "
    "memory pages in each process.",
)
HEADS = ("what", "unit", "before", "now", "ratio", "target")
# One scenario of each system, with its full length.
SCENARIOS = (
    "dc_motor_smc", "dc_motor_fsfb", "induction_dtc", "lsrm_fuzzy", "tcp_aqm_smc", "manipulator_adsmc",
    "rehab_impedance", "gupfc", "pv_mppt", "rectifier_mpc", "pwa_delay", "fault_location", "optimal_control_mvim",
    "economic_dispatch",
)  # fmt: skip
MODES = {"plain": {"SOFTRIG_JIT": "0"}, "default": {}}  # in Python only, and with the default choice
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


def compared(other: Path, names: Sequence[str], rounds: int | None = None) -> dict[str, tuple[list[Values], ...]]:
    """Measure rows in another checkout and in this one in turn, and return the values of each round of both.

    Parameters
    ----------
    rounds : int, optional
        Of each row; absent: its own number.
    """
    result: dict[str, tuple[list[Values], ...]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folders = {checkout: Path(scratch, name) for checkout, name in ((other, "before"), (ROOT, "now"))}
        for checkout, folder in folders.items():
            folder.mkdir()
            cost(PREPARED, checkout, folder)
        for name in names:
            row = ROWS[name]
            values: dict[Path, list[Values]] = {other: [], ROOT: []}
            for _ in range((rounds or row.rounds) + row.warm):
                for checkout, folder in folders.items():
                    values[checkout].append(row.measure(checkout, folder))
            result[name] = tuple(values[checkout][row.warm :] for checkout in (other, ROOT))
            for line in rows({name: result[name]}):
                console.print(*line, sep="  ")
    return result


def rows(values: Mapping[str, tuple[list[Values], ...]]) -> Table:
    """Return name, unit, value before and now, their ratio, each the median over rounds, and the target."""
    result: Table = []
    for name, (before, now) in values.items():
        for k, (part, unit, target) in enumerate(ROWS[name].parts):
            old, new = ([round_[k] for round_ in rounds] for rounds in (before, now))
            ratio = median(n / b for b, n in zip(old, new, strict=True))
            result.append((name + part, unit, three(median(old)), three(median(new)), f"{ratio:.2f}", target))
    return result


def three(value: float) -> str:
    """Return a number with three digits, or all before its point."""
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


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


def run_rows(places: tuple[Path, Path], names: Sequence[str], mode: str, rounds: int) -> Table:
    """Run scenarios in two checkouts in turn.

    Returns
    -------
    list of tuple of str
        Scenario, the least CPU time before and now, and their ratio.
    """
    result: Table = []
    warm = mode == "default"  # the first round compiles
    for name in names:
        actual = [[whole(place, name, MODES[mode]) for place in places] for _ in range(rounds + warm)][warm:]
        before, now = (min(costs) for costs in zip(*actual, strict=True))
        result.append((name, f"{before:.3f}", f"{now:.3f}", f"{now / before:.2f}"))
        console.print(*result[-1])
    return result


def main(arguments: Sequence[str]) -> int:
    """Build a commit beside this checkout, measure the same things in both in turn, and print the table."""
    listed = "\n".join(f"  {name}{' (only if it is named)' if row.slow else ''}" for name, row in ROWS.items())
    parser = argparse.ArgumentParser(
        prog="scripts/softrig bench against",
        description=main.__doc__,
        epilog=f"rows:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("commit", metavar="COMMIT", help="what to compare with")
    parser.add_argument("names", nargs="*", metavar="NAME", help="beginnings of the rows (default: all quick ones)")
    parser.add_argument("--rounds", type=int, metavar="N", help="of each row, in turn (default: 1 to 3)")
    parser.add_argument("--runs", choices=MODES, help="whole runs of scenarios in place of rows, least times")
    parser.add_argument("--write", action="store_true", help=f"write the table to doc/lab/{PAGE.path.name}")
    options = parser.parse_args(arguments)
    if options.rounds is not None and options.rounds < 1:
        parser.error(f"--rounds {options.rounds}: expected at least 1")
    kind, known = ("scenario", SCENARIOS) if options.runs else ("row", tuple(ROWS))
    named = [n for n in known if n.startswith(tuple(options.names))]
    names = named if options.names else [n for n in known if options.runs or not ROWS[n].slow]
    if not names:
        parser.error(f"no {kind} begins with {', '.join(options.names)}; there are {'; '.join(known)}")
    other, begun = built(options.commit), Begin.now()
    if options.runs:
        # Build HEAD instead of using this checkout: in a test environment numba imports further packages (coverage),
        # which takes 0.2 s.
        result = run_rows((other, built("HEAD")), names, options.runs, options.rounds or 3)
        table = [("scenario", "CPU s before", "CPU s now", "ratio"), *result]
    else:
        table = [HEADS, *rows(compared(other, names, options.rounds))]
    show(table)
    if options.write:
        mark = options.runs or ("slow" if all(ROWS[n].slow for n in names) else "rows")
        write(PAGE, {mark: table}, f"scripts/softrig bench against {shlex.join(arguments)}", begun)
    return 0
