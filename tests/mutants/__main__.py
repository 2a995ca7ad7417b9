"""How strong are the tests? Random mutants, each against the daily tests that execute its line.

First the tests given (files or folders; all take an hour) run once, traced line by line to see which test runs which
line: `--lines FILE` keeps the result, or reads FILE if it exists. Then mutants are drawn among the executed lines,
and each runs against its tests, the quickest first, until one fails. All this happens at low priority in a worktree of
HEAD, or of the commit of FILE. A mutant that survives is equivalent, as a person decides, or shows a hole in the tests.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

from draw import KINDS, Mutant, mutants

ROOT = Path(__file__).resolve().parents[2]
TRACED = "tests/mutants/traced"
# variables of this checkout, which the worktree must not inherit
OURS = ("PYTHONPATH", "AMENT_PREFIX_PATH", "VIRTUAL_ENV", "SOFTRIG_SCENARIOS")
BARE = {name: value for name, value in os.environ.items() if name not in OURS}


class Tests:
    """The seconds of each test, and the tests that execute each line."""

    def __init__(self, file: Path) -> None:
        self.seconds: dict[str, float] = {}
        self.of_line: dict[str, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
        self.failed: list[str] = []
        for text in file.read_text().splitlines()[1:]:
            content = json.loads(text)
            if content["outcome"] != "passed":
                self.failed += [content["test"]] if content["outcome"] == "failed" else []
                continue
            self.seconds[content["test"]] = content["seconds"]
            for place, lines in content["lines"].items():
                for line in lines:
                    self.of_line[place][line].append(content["test"])

    def meeting(self, place: str, mutant: Mutant) -> list[str]:
        """The tests that a mutant can fail, the quickest first; those of its folder if the executing tests are
        unknown.
        """
        beside = [p for p in self.of_line if Path(p).parent == Path(place).parent] if not mutant.runs else [place]
        lines = [self.of_line[p] for p in beside]
        results = {test for of in lines for line in mutant.runs or of for test in of.get(line, ())}
        return sorted(results, key=lambda test: (self.seconds[test], test))

    def silent(self, tree: Path) -> list[str]:
        """Tests in which no asserting line was executed."""
        places = [place for place in self.of_line if place.startswith("tests/")]
        asserting = set()
        for place in places:
            lines = _asserting((tree / place).read_text())
            asserting |= {test for line in lines for test in self.of_line[place].get(line, ())}
        return sorted(set(self.seconds) - asserting)


def _asserting(source: str) -> set[int]:
    """Lines of a test's module that assert something."""
    claims = ("raises", "warns", "fail", "exit")
    result = set()
    for node in ast.walk(ast.parse(source)):
        name = getattr(getattr(node, "func", None), "attr", getattr(getattr(node, "func", None), "id", ""))
        if isinstance(node, ast.Assert) or name in claims or name.startswith(("assert_", "check_", "until")):
            result.add(node.lineno)
    return result


class Warm:
    """Runs pytest in a worktree repeatedly, without importing everything each time."""

    def __init__(self, tree: Path) -> None:
        command = ["nice", "scripts/softrig", "python", str(Path(__file__).with_name("warm.py"))]
        self._process = subprocess.Popen(
            command, cwd=tree, env=BARE, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def __call__(self, arguments: list[str], limit: float) -> int | None:
        """Return pytest's exit status; None if it took more than `limit` s."""
        self._process.stdin.write(json.dumps([arguments, limit]) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def trace(tree: Path, what: list[str], out: Path) -> None:
    """Run tests once; write a line of JSON for each to `out`, after a line with their commit."""
    out.write_text(f"{_head(tree)}\n")
    with tempfile.TemporaryDirectory() as folder:
        results = {
            "PYTHONPATH": str(tree / TRACED),
            "SOFTRIG_TRACED": folder,
            "SOFTRIG_TRACED_TESTS": str(out.resolve()),
        }
        command = ["nice", "scripts/softrig", "python", "-m", "pytest", "-q", "-p", "lines_of_tests", *what]
        status = subprocess.run(command, cwd=tree, env=BARE | results, stdout=sys.stderr, check=False).returncode
    if status not in (0, 1):
        raise SystemExit("the tests could not be run")


def _head(tree: Path) -> str:
    return subprocess.run(["git", "rev-parse", "HEAD"], cwd=tree, check=True, capture_output=True, text=True).stdout[
        :-1
    ]


def met(tree: Path, known: Tests, under: tuple[str, ...]) -> dict[str, list[tuple[str, Mutant]]]:
    """Mutants that a test meets, by kind."""
    result = defaultdict(list)
    for place in sorted(known.of_line):
        if place.startswith(under) and "/test/" not in place:
            for mutant in mutants((tree / place).read_text()):
                if any(line in known.of_line[place] for line in mutant.runs or (0, *known.of_line[place])):
                    result[mutant.kind].append((place, mutant))
    return result


def main() -> int:
    """Draw, run, print."""
    parser = argparse.ArgumentParser(prog="scripts/mutants", description=__doc__.splitlines()[0])
    parser.add_argument("tests", nargs="*", default=["tests/core", "tests/bags"])
    parser.add_argument("--lines", type=Path, metavar="FILE", help="which test runs which line, kept or read")
    parser.add_argument("--count", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=30.0, help="begin no further mutant after")
    parser.add_argument("--under", nargs="+", default=["ros_pkgs/"], metavar="PATH", help="mutants of these files only")
    parser.add_argument(
        "--kinds", nargs="+", default=KINDS, choices=KINDS, metavar="KIND", help=f"of {', '.join(KINDS)}"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of tests a mutant, the quickest first")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # exits so that the worktree is removed
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        tree, lines = Path(folder) / "tree", options.lines or Path(folder) / "lines.jsonl"
        commit = lines.read_text().split("\n", 1)[0] if lines.exists() else "HEAD"
        subprocess.run(["git", "worktree", "add", "--detach", tree, commit], cwd=ROOT, check=True, capture_output=True)
        try:
            subprocess.run(
                ["nice", "scripts/softrig", "setup", "test"], cwd=tree, env=BARE, check=True, capture_output=True
            )
            if not lines.exists():
                trace(tree, options.tests, lines)
            known = Tests(lines)
            for test in known.failed:
                print(f"fails by itself: {test}")
            for test in known.silent(tree):
                print(f"asserts nothing: {test}")
            print(f"{len(known.seconds)} tests, {sum(known.seconds.values()):.0f} s", flush=True)
            return _campaign(tree, known, options)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=False)


def _campaign(tree: Path, known: Tests, options: argparse.Namespace) -> int:
    all_of = met(tree, known, tuple(options.under))
    generator, tally, started = random.Random(options.seed), Counter(), time.monotonic()
    done, run = set(), Warm(tree)
    while tally["killed"] + tally["survived"] < options.count and time.monotonic() - started < 60 * options.minutes:
        kind = generator.choice([kind for kind in KINDS if kind in options.kinds and all_of[kind]])
        place, mutant = generator.choice(all_of[kind])
        if (place, mutant) in done:
            continue
        done.add((place, mutant))
        source = (tree / place).read_text()
        try:
            compile(mutant.applied(source), place, "exec")
        except SyntaxError:
            continue
        outcome, text = _tried(tree, run, known, place, mutant, options.seconds)
        tally[outcome] += 1
        print(f"{sum(tally.values())}: {outcome} {place}:{mutant.start[0]} {mutant.kind}", file=sys.stderr, flush=True)
        if outcome != "killed":
            print(f"{outcome}: {place}:{mutant.start[0]} {mutant.description(source)} ({text})", flush=True)
    total = tally["killed"] + tally["survived"]
    print(
        f"{total} mutants, seed {options.seed}: {tally['killed']} killed, {tally['survived']} survived "
        f"({100 * tally['killed'] / max(1, total):.0f} %), {(time.monotonic() - started) / 60:.0f} min"
    )
    return int(tally["survived"] > 0)


def _tried(tree: Path, run: Warm, known: Tests, place: str, mutant: Mutant, most: float) -> tuple[str, str]:
    """Run the tests of a mutant; return whether one killed it, and how many there were."""
    tests = known.meeting(place, mutant)
    chosen, seconds = [], 0.0
    for test in tests:
        if chosen and seconds + known.seconds[test] > most:
            break
        chosen.append(test)
        seconds += known.seconds[test]
    file = tree / place
    source = file.read_text()
    asked = tree / ".ws" / "tests"
    asked.write_text("\n".join(chosen))
    try:
        file.write_text(mutant.applied(source))
        status = run(["-x", f"@{asked}"], 120.0 + 10.0 * seconds)
    finally:
        file.write_text(source)
    # Another cause than a mutant that cannot be imported.
    if status == 4 and run(["--collect-only", f"@{asked}"], 120.0):
        return "not tried", "pytest does not find these tests by their names"
    return "survived" if status == 0 else "killed", f"{len(chosen)} of {len(tests)} tests, {seconds:.0f} s"


if __name__ == "__main__":
    sys.exit(main())
