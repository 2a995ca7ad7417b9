"""The sources of the numbers in the hand-written text of a page, and whether they are right.

Each number of three or more significant digits, outside of code and of the generated parts, either stands in a
generated part of its page too (parameters, published values, titles), or is named in a comment of its section::

    <!-- numbers
    0.607, 0.1830: dc_motor_smc.rise_time       figure of a scenario or a study
    31: 1000 * rectifier_mpc.settling_time      the same in another unit
    1153: test_economic_dispatch.py::CASES      stands in that test, or in a table of its file
    1.31: scenario fault_location               stands in that scenario
    0.75: = 3/4                                 arithmetic
    0.0193: paper Table 2                       printed there
    2.5: bench gupfc                            time, memory or speed, by that command on the machine it names
    rest: bench placements                      all others of the section
    11.4: study dc_motor_smc --draw ...         time or memory of that command
    3.11: version of Python
    -->

A figure is held against the measured tables of the pages, else against what its scenario expects, as far as the number
is rounded; with a run, against the run.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from softrig_bringup.study.definition import list_studies, load_study
from softrig_core import load_scenario, rig_of
from softrig_core.judge.expectation import Expected
from softrig_core.scenario.scenario_file import find

FORMS = "scenario.figure, test_file.py::test, scenario NAME, = ..., paper ..., bench ..., study ... or version ..."
DIGITS = 3  # numbers with fewer digits need no source
_GENERATED = re.compile(r"<!-- (\w+): [^>]*? -->.*?<!-- end -->", re.DOTALL)
_COMMENT = re.compile(r"<!-- numbers\n(.*?)-->", re.DOTALL)
_CODE = re.compile(
    r"```.*?```|^(?:    [^\n]*\n)+|`[^`\n]*`|\]\([^)]*\)|<!--.*?-->|https?://\S+", re.DOTALL | re.MULTILINE
)
_NUMBER = re.compile(
    r"(?<![\w.^])(?:(?<![\w)]-)(?<![\w)])[+-])?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[+-]?\d+)?(?!\w|\.\d)"
)
_FACTOR = r"(?:([-\d.e/*() ]+?) \* )?"
_FIGURE = re.compile(_FACTOR + r"(\w+)\.(\w+)")
_TEST = re.compile(_FACTOR + r"(test_\w+\.py)::(\w+)")


Runs = Callable[[str], dict[str, float]]  # returns the figures of a scenario by its name


@dataclass(frozen=True)
class Tie:
    """A number of a page as written, and its stated source."""

    number: str
    source: str = ""

    @property
    def value(self) -> float:
        """The number itself."""
        return float(self.number.replace(",", ""))

    @property
    def half(self) -> float:
        """Half a unit of its last digit."""
        mantissa, _, exponent = self.number.partition("e")
        return 0.5 * 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))

    def near(self, value: float, slack: float = 0.0) -> bool:
        """Return whether it is `value` as far as it is rounded."""
        return math.isfinite(value) and abs(value - self.value) <= self.half * (1.0 + 1e-6) + slack

    def is_one_of(self, values: Iterable[float]) -> bool:
        """Return whether it equals one of some numbers exactly, except for the sign."""
        return any(math.isclose(abs(self.value), abs(x), rel_tol=1e-12) for x in values)


def faults(page: str, tests: Path, run: Runs | None = None, others: str = "") -> Iterator[str]:
    """Describe which numbers of a page have no source, which are wrong, and which sources have no number any more.

    Parameters
    ----------
    page : str
    tests : Path
        Where the test files are.
    run : callable, optional
        Gives the figures of a scenario by a run; without it, those that a page or the scenario states.
    others : str
        Pages whose measured tables count, too.
    """
    known = [Tie(n).value for part in _GENERATED.finditer(page) if part[1] != "measured" for n in _in(part[0])]
    table = _measured(others) | _measured(page)
    for heading, section in _sections(page):
        ties = list(_ties(section))
        written = list(dict.fromkeys(_in(_CODE.sub(" ", _COMMENT.sub("", _GENERATED.sub("", section))))))
        tied = {tie.number for tie in ties}
        for number in written:
            if digits(number) >= DIGITS and not {number, "rest"} & tied and not Tie(number).is_one_of(known):
                yield f"{heading}: {number} has no source"
        for tie in ties:
            if tie.number == "rest" and tie.source.startswith("bench "):
                continue
            if not _NUMBER.fullmatch(tie.number):
                yield f"{heading}: {tie.number!r} is no number"
            elif tie.number not in written:
                yield f"{heading}: {tie.number} is not in this section"
            elif problem := _wrong(tie, table, tests, run):
                yield f"{heading}: {tie.number}: {problem}"


def digits(number: str) -> int:
    """Return the significant digits of a number as written; zeros at the end of an integer do not count."""
    mantissa = number.partition("e")[0].lstrip("+-").replace(",", "")
    plain = mantissa.replace(".", "").lstrip("0")
    return len(plain if "." in mantissa else plain.rstrip("0"))


def _in(text: str) -> Iterator[str]:
    return (result[0] for result in _NUMBER.finditer(text))


def _sections(page: str) -> Iterator[tuple[str, str]]:
    heads = re.finditer(r"^```.*?^```|^#+ ", page, re.DOTALL | re.MULTILINE)  # a comment in code is not a heading
    starts = [m.start() for m in heads if m[0][0] == "#"] or [0]
    for start, end in zip(starts, [*starts[1:], len(page)], strict=True):
        yield page[start:end].partition("\n")[0].lstrip("# "), page[start:end]


def _ties(section: str) -> Iterator[Tie]:
    for comment in _COMMENT.finditer(section):
        for line in filter(None, map(str.strip, comment[1].splitlines())):
            numbers, _, source = line.partition(": ")
            yield from (Tie(number, source.strip()) for number in numbers.split(", "))


@lru_cache(4)  # the pages of a set share the other pages
def _measured(page: str) -> dict[tuple[str, str], float]:
    """Read the measured tables of pages: (scenario, figure) to value."""
    result: dict[tuple[str, str], float] = {}
    for part in re.finditer(r"<!-- measured: ([^>]*?) of [^>]*? -->\n(.*?)<!-- end -->", page, re.DOTALL):
        for row in re.findall(r"^\| `(\w+)` (.*)\|$", part[2], re.MULTILINE):
            cells = [cell.strip() for cell in row[1].split(" | ")][-len(part[1].split()) :]
            for figure, cell in zip(part[1].split(), cells, strict=True):
                if cell.strip("| ") not in ("", "never"):
                    result[row[0], figure] = float(cell.split()[0])
    return result


def _wrong(tie: Tie, table: dict[tuple[str, str], float], tests: Path, run: Runs | None) -> str:
    """Describe what is wrong with a number; None if it is right."""
    try:
        return _differs(tie, table, tests, run)
    except (ArithmeticError, NameError, SyntaxError, TypeError, ValueError) as error:
        return f"{tie.source}: {error}"


def _differs(tie: Tie, table: dict[tuple[str, str], float], tests: Path, run: Runs | None) -> str:
    kind, _, remaining = tie.source.partition(" ")
    if kind in ("paper", "bench", "study", "version") and remaining:
        return ""
    if kind == "=":
        return "" if tie.near(_computed(remaining)) else f"{remaining} is {_computed(remaining):g}"
    if kind == "scenario":
        return (
            ""
            if tie.is_one_of(_values(load_scenario(remaining).model_dump()))
            else f"does not stand in scenario {remaining}"
        )
    if match := _TEST.fullmatch(tie.source):
        held = (_computed(match[1] or "1") * x for x in _literals(tests, match[2], match[3]))
        return "" if any(tie.near(x) or tie.near(-x) for x in held) else f"does not stand in {tie.source}"
    if match := _FIGURE.fullmatch(tie.source):
        return _unlike(tie, _computed(match[1] or "1"), (match[2], match[3]), table, run)
    return f"source {tie.source!r}: expected {FORMS}"


def _unlike(
    tie: Tie, factor: float, what: tuple[str, str], table: dict[tuple[str, str], float], run: Runs | None
) -> str:
    """Describe how a number differs from the figure of a scenario or of a study; None if it does not."""
    name, figure = what
    if (published := _published(name)) is None:
        return f"no scenario or study {name}"
    expect, figures, is_study = published
    if is_study:
        run = None  # a study has hundreds of runs, so `softrig study` checks its expectation
    if figure not in figures:
        return f"{name} has no figure {figure}"
    if run is not None:
        value = factor * run(name)[figure]
        return "" if tie.near(value) else f"a run gives {value:.6g}"
    if what in table:
        value = factor * table[what]
        return "" if tie.near(value, 5e-5 * abs(value)) else f"the table has {value:.6g}"  # the table has five digits
    expected = expect.get(figure)
    # Values that round to the number on the page.
    grid = (tie.value + share * tie.half for share in (-1.0, -0.5, 0.0, 0.5, 1.0))
    return "" if expected is None or any(expected.holds(x / factor) for x in grid) else f"{name} expects {expected}"


@cache
def _published(name: str) -> tuple[Mapping[str, Expected], frozenset[str], bool] | None:
    """Return the expectations of a study or a scenario, the names of its figures, and whether it is a study."""
    if name in list_studies():
        expect = load_study(name).expect
        return expect, frozenset(expect), True
    if find(name) is None:
        return None
    scenario = rig_of(name, live=False).scenario  # reads expectations with their references resolved
    return scenario.expect, frozenset(scenario.figures), False


def _computed(expression: str) -> float:
    names = {k: v for k, v in vars(math).items() if not k.startswith("_")}
    return float(eval(expression, {"__builtins__": {}}, names))


def _values(given: Any) -> Iterator[float]:
    """Return all numbers in nested data."""
    if isinstance(given, dict):
        given = list(given.values())
    if isinstance(given, list | tuple):
        for item in given:
            yield from _values(item)
    elif isinstance(given, int | float):
        yield float(given)


@cache
def _parsed(tests: Path, file: str) -> list[ast.stmt]:
    trees = (ast.parse(result.read_text(encoding="utf-8")) for result in sorted(tests.rglob(file)))
    return [node for tree in trees for node in tree.body]


def _literals(tests: Path, file: str, name: str) -> Iterator[float]:
    """Return all numbers in a function of a test file and in its decorators, or in an assignment to a name there."""
    for node in _parsed(tests, file):
        targets = [n.id for n in getattr(node, "targets", []) if isinstance(n, ast.Name)]
        if getattr(node, "name", None) == name or name in targets:
            yield from _values([n.value for n in ast.walk(node) if isinstance(n, ast.Constant)])
