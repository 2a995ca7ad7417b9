"""Which daily tests execute a file: `scripts/test --touching FILE...` runs these and no others.

A table in `.ws/touching.json` holds, for each test, the Python files of which it executes lines in functions, also
natively and in the processes that it starts. The first call runs all daily tests once, traced. Every later call traces
the tests that it runs and writes their entries again. Tests of a new or changed test file run, too, as the table does
not know them. `scripts/test --touching` without a file makes the whole table again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / ".ws" / "touching.json"
CHOSEN = "SOFTRIG_TOUCHING"  # a file that lists tests and whole test files, one a line


def pytest_collection_modifyitems(config, items):
    """Plugin of pytest: leave out the tests that are not chosen."""
    if name := os.environ.get(CHOSEN):
        chosen = set(Path(name).read_text().splitlines())
        kept = [item for item in items if item.nodeid in chosen or _file_of(item.nodeid) in chosen]
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = kept


def _file_of(test: str) -> str:
    return test.partition("::")[0]


def _digest(file: str) -> str:
    return hashlib.sha256((ROOT / file).read_bytes()).hexdigest()[:12]


class Table:
    """Tests by name: their seconds and the files that they execute; test files by name: their digest when traced."""

    def __init__(self) -> None:
        self.commit, self.made = "", time.time()
        self.tests: dict[str, tuple[float, list[str]]] = {}
        self.digests: dict[str, str] = {}

    @classmethod
    def read(cls) -> Table | None:
        """Return the table, if there is one."""
        if not TABLE.exists():
            return None
        content = json.loads(TABLE.read_text())
        table, names = cls(), content["files"]
        table.commit, table.made, table.digests = content["commit"], content["made"], content["digests"]
        table.tests = {test: (s, [names[k] for k in files]) for test, (s, files) in content["tests"].items()}
        return table

    def write(self) -> None:
        """Write the table whole, beside the old one first."""
        names = sorted({file for _, files in self.tests.values() for file in files})
        number = {name: k for k, name in enumerate(names)}
        tests = {test: (s, [number[file] for file in files]) for test, (s, files) in sorted(self.tests.items())}
        content = {"commit": self.commit, "made": self.made, "files": names, "digests": self.digests, "tests": tests}
        aside = TABLE.with_suffix(".new")
        aside.write_text(json.dumps(content))
        aside.replace(TABLE)

    def update(self, rows: Iterable[str], whole: Iterable[str]) -> None:
        """Update with what has been traced; `whole` names the test files of which all tests have been run."""
        digests = {file: _digest(file) for file in whole}
        self.tests = {test: entry for test, entry in self.tests.items() if _file_of(test) not in digests}
        self.digests |= digests
        for row in map(json.loads, rows):
            files = set(row["lines"])
            if row["outcome"] == "failed":  # a failed test may have missed some of its lines
                files |= set(self.tests.get(row["test"], (0.0, []))[1])
            self.tests[row["test"]] = (row["seconds"], sorted(files))

    def of(self, file: str) -> set[str]:
        """Return the tests that execute a file; those of its folder if none of its functions is known to run."""
        tests = {test for test, (_, files) in self.tests.items() if file in files}
        if not tests:
            folder = str(Path(file).parent)
            tests = {t for t, (_, files) in self.tests.items() if any(str(Path(f).parent) == folder for f in files)}
            print(f"{file}: no test runs a function of it; the {len(tests)} that run its folder instead")
        return tests


def _git(*words: str) -> list[str]:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.splitlines()


def _age(table: Table) -> str:
    """Return how far the table may be out of date."""
    changed = [f for f in _git("diff", "--name-only", table.commit, "--", "ros_pkgs") if f.endswith(".py")]
    days = (time.time() - table.made) / 86400
    since = f"made {days:.1f} days ago at {table.commit[:8]}, {len(changed)} files of ros_pkgs have changed since"
    return f"table of tests: {since}" + ("; `scripts/test --touching` makes it again" if changed else "")


def _choice(table: Table, files: list[str]) -> tuple[set[str], list[str]]:
    """Return the tests that execute the files, and the test files that are to run whole."""
    test_files = sorted(str(p.relative_to(ROOT)) for p in (ROOT / "tests").rglob("test_*.py"))
    stale = [file for file in test_files if table.digests.get(file) != _digest(file)]
    asked = [file for file in files if file in test_files]
    whole = sorted({*stale, *asked})
    tests = {t for file in files if file not in asked for t in table.of(file)}
    tests = {t for t in tests if _file_of(t) in test_files and _file_of(t) not in whole}
    seconds = sum(table.tests[test][0] for test in tests)
    print(_age(table))
    print(f"{len(tests)} tests in {len({*map(_file_of, tests)})} files execute {', '.join(files)} ({seconds:.0f} s)")
    if stale:
        print(f"{len(stale)} test files are new or have changed since they were traced: they run whole")
    return tests, whole


def _traced(tests: set[str], whole: list[str], workers: int, more: list[str]) -> tuple[int, list[str]]:
    """Run tests, all if none is named; return pytest's status and the trace, one line for each test."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows, processes, chosen = folder / "rows", folder / "processes", folder / "chosen"
        processes.mkdir()
        own_folder = Path(__file__).parent
        path = os.pathsep.join([str(own_folder), str(own_folder / "traced"), os.environ.get("PYTHONPATH", "")])
        variables = {"PYTHONPATH": path, "SOFTRIG_TRACED": str(processes), "SOFTRIG_TRACED_TESTS": str(rows)}
        if tests or whole:
            chosen.write_text("\n".join([*tests, *whole]))
            variables[CHOSEN] = str(chosen)
        command = [sys.executable, "-m", "pytest", "-n", str(workers), "-p", "lines_of_tests", "-p", "touching", *more]
        command += sorted({*map(_file_of, tests), *whole})
        status = subprocess.run(command, cwd=ROOT, env=os.environ | variables, check=False).returncode
        return status, rows.read_text().splitlines() if rows.exists() else []


def _named(name: str) -> str:
    path = Path(name).resolve()
    if not path.is_file() or not path.is_relative_to(ROOT):
        raise argparse.ArgumentTypeError(f"{name} is no file of {ROOT}")
    if path.suffix != ".py":
        raise argparse.ArgumentTypeError(f"{name}: the table knows Python files only; name a test file")
    return str(path.relative_to(ROOT))


def main() -> int:
    """Choose, run, store the trace; return pytest's status."""
    parser = argparse.ArgumentParser(
        prog="scripts/test --touching", description="Run the daily tests that execute these files.",
        epilog="Without a file all daily tests run and the table is made again. Options behind -- go to pytest.",
    )  # fmt: skip
    parser.add_argument("files", nargs="*", type=_named, metavar="FILE")
    parser.add_argument("-n", type=int, default=3, metavar="N", help="workers (3)")
    words, _, more = "\0".join(sys.argv[1:]).partition("\0--\0")
    options = parser.parse_args([word for word in words.split("\0") if word])
    if not hasattr(sys, "monitoring"):
        parser.error("needs Python 3.12 or newer (SOFTRIG_PYTHON)")
    table = Table.read()
    extra = [word for word in more.split("\0") if word]
    if table is None or not options.files:
        print("the daily tests run once with tracing, which takes about ten minutes on two cores", flush=True)
        table, tests, whole = Table(), set[str](), list[str]()
        table.commit = "".join(_git("rev-parse", "HEAD"))
    else:
        tests, whole = _choice(table, options.files)
        if not tests and not whole:
            return 0
    sys.stdout.flush()
    status, rows = _traced(tests, whole, options.n, extra)
    if status in (0, 1):  # status 5: no test was run; 2: interrupted
        all_run = whole if tests or whole else sorted({_file_of(json.loads(row)["test"]) for row in rows})
        table.update(rows, [] if extra else all_run)
        table.write()
    return status


if __name__ == "__main__":
    sys.exit(main())
