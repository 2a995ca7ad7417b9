"""Plugin of pytest: mutants are put into the loaded functions, each in a fork of a session that has collected.

Ten times as quick as `scripts/mutants`, which writes each mutant into its file and imports everything again; code
outside of functions, and compiled or cached functions, are left out. The kinds take turns. Run it in a separate
worktree::

    PYTHONPATH=tests/mutants MUTANTS_LINES="FILE ..." MUTANTS_UNDER="ros_pkgs/softrig_core/" MUTANTS_OUT=found.jsonl \
        scripts/softrig python -m pytest -q -p loaded tests/core tests/bags

FILE is the file that ``scripts/mutants --lines FILE`` has written at this commit; MUTANTS_SEED, MUTANTS_COUNT,
MUTANTS_SECONDS (of tests for each mutant, the quickest first) and MUTANTS_KINDS are optional. MUTANTS_OUT gets a line
of JSON for each mutant; an existing file is continued.
"""

import ast
import gc
import importlib
import json
import linecache
import os
import pkgutil
import random
import signal
import sys
import time
import types
from collections import Counter, defaultdict
from contextlib import suppress
from pathlib import Path

from draw import KINDS, mutants

ROOT = Path(__file__).resolve().parents[2]
UNAPPLIED, BROKE, LATE = 78, 77, -99
failed = []


def pytest_runtest_logreport(report):
    if report.outcome == "failed":
        failed.append(report.nodeid)


def known_tests(files):
    """Seconds of each test, and the tests of each line."""
    seconds, of_line = {}, defaultdict(lambda: defaultdict(list))
    for file in files:
        for text in Path(file).read_text().splitlines()[1:]:
            content = json.loads(text)
            if content["outcome"] == "passed" and content["test"] not in seconds:
                seconds[content["test"]] = content["seconds"]
                for place, lines in content["lines"].items():
                    for line in lines:
                        of_line[place][line].append(content["test"])
    return seconds, of_line


def loaded_functions(packages):
    """All loaded functions of some packages, by file, first line and name."""
    for package in packages:
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            with suppress(Exception, SystemExit):  # the module needs an optional package that is not installed
                importlib.import_module(module.name)
    result = defaultdict(list)
    for each in gc.get_objects():
        if type(each) is types.FunctionType:
            code = each.__code__
            result[os.path.realpath(code.co_filename), code.co_firstlineno, code.co_qualname].append(each)
    return result


def codes(code):
    """All code objects within one, outer before inner."""
    for one in code.co_consts:
        if isinstance(one, types.CodeType):
            yield one
            yield from codes(one)


def put_in(file, mutant, source, functions):
    """Put a mutant into the functions of its file; return whether that was possible."""
    new = mutant.applied(source)
    for name in {
        str(file),
        *(f.__code__.co_filename for (p, _, _), fs in functions.items() if p == str(file) for f in fs),
    }:
        linecache.cache[name] = (len(new), None, new.splitlines(keepends=True), name)
    if mutant.kind == "default":
        return _put_default(str(file), mutant, source, functions)
    before, after = (list(codes(compile(text, str(file), "exec"))) for text in (source, new))
    if len(before) != len(after):
        return False
    done = False
    for old, code in zip(before, after, strict=True):
        for function in functions.get((str(file), old.co_firstlineno, old.co_qualname), ()) if old != code else ():
            try:
                function.__code__ = code
            except ValueError:  # the function has other closure variables than before
                return False
            done = True
    return done


def _put_default(file, mutant, source, functions):
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef):
            continue
        named = zip([a.arg for a in node.args.kwonlyargs], node.args.kw_defaults, strict=True)
        for place, default in [*enumerate(node.args.defaults), *named]:
            if default is None or (default.lineno, default.col_offset) != mutant.start:
                continue
            first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
            value = ast.literal_eval(mutant.text)
            result = [
                f
                for (p, line, name), fs in functions.items()
                if (p, line) == (file, first) and name.rpartition(".")[2] == node.name
                for f in fs
            ]
            for function in result:
                if isinstance(place, int):
                    defaults = list(function.__defaults__)
                    defaults[place] = value
                    function.__defaults__ = tuple(defaults)
                else:
                    function.__kwdefaults__ = function.__kwdefaults__ | {place: value}
            return bool(result)
    return False


def in_fork(work, limit):
    """Exit status of some work in a separate process; `LATE` after `limit` s."""
    child = os.fork()
    if not child:
        os.setsid()
        try:
            null = os.open(os.devnull, os.O_RDWR)
            for number in range(3):
                os.dup2(null, number)
            os._exit(work())
        except BaseException:
            os._exit(BROKE)
    end = time.monotonic() + limit
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            with suppress(OSError):
                os.killpg(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return LATE


def failing(items):
    """Run tests until one fails; return 0, or its number from 1 on."""
    for number, (item, following) in enumerate(zip(items, [*items[1:], None], strict=True), 1):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if failed:
            return min(number, 60)
    return 0


def drawn(seed, kinds, places, of_line):
    """Mutants that a test executes, one kind after the other."""
    result = defaultdict(list)
    for place in places:
        for mutant in mutants((ROOT / place).read_text()):
            if mutant.kind in kinds and any(line in of_line[place] for line in mutant.runs):
                result[mutant.kind].append((place, mutant))
    generator = random.Random(seed)
    for of_kind in result.values():
        generator.shuffle(of_kind)
    while any(result.values()):
        for kind in kinds:
            if result[kind]:
                yield result[kind].pop()


def pytest_runtestloop(session):
    asked = {name: os.environ.get(f"MUTANTS_{name}", "") for name in ("UNDER", "KINDS", "SEED", "COUNT", "SECONDS")}
    under, most = tuple(asked["UNDER"].split() or ["ros_pkgs/"]), float(asked["SECONDS"] or 6.0)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    seconds, of_line = known_tests(os.environ["MUTANTS_LINES"].split())
    places = sorted(p for p in of_line if p.startswith(under) and "/test/" not in p)
    functions = loaded_functions(sorted({Path(p).parts[1] for p in places}))
    gc.freeze()
    items, sound, tally = {i.nodeid: i for i in session.items}, {}, Counter()
    file = Path(os.environ["MUTANTS_OUT"])
    done = {json.loads(line)["told"] for line in file.read_text().splitlines()} if file.exists() else set()
    for place, mutant in drawn(int(asked["SEED"] or 0), asked["KINDS"].split() or KINDS, places, of_line):
        if tally.total() >= int(asked["COUNT"] or 80):
            break
        source = (ROOT / place).read_text()
        text = f"{place}:{mutant.start[0]}:{mutant.start[1]} {mutant.description(source)}"
        if text in done:
            continue
        meeting = {t for line in mutant.runs for t in of_line[place].get(line, ()) if t in items and sound.get(t, True)}
        chosen, whole = [], 0.0
        for test in sorted(meeting, key=lambda t: (seconds[t], t)):
            if chosen and whole + seconds[test] > most:
                break
            chosen.append(test)
            whole += seconds[test]
        outcome, by, ran = "survived", "", len(chosen)
        while chosen:

            def work(place=place, mutant=mutant, source=source, tests=tuple(chosen)):
                return (
                    failing([items[t] for t in tests]) if put_in(ROOT / place, mutant, source, functions) else UNAPPLIED
                )

            status = in_fork(work, 60.0 + 20.0 * whole)
            if status in (0, UNAPPLIED):
                outcome = "survived" if status == 0 else "not tried"
                break
            by = chosen[status - 1] if 0 < status <= len(chosen) else f"status {status}"
            if by in items and by not in sound:  # the test may fail without the mutant, too
                sound[by] = in_fork(lambda by=by: failing([items[by]]), 60.0 + 20.0 * whole) == 0
            if sound.get(by, True):
                outcome = "killed"
                break
            chosen.remove(by)
        tally[outcome] += 1
        row = {"told": text, "outcome": outcome, "by": by, "ran": ran, "meeting": len(meeting)}
        with file.open("a") as out:
            out.write(f"{json.dumps(row)}\n")
    print(dict(tally), file=sys.__stderr__)
    return True
