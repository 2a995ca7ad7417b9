"""Which classes and whole rigs of the shipped scenarios have C, each exported and compared with its run in Python."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Literal

from softrig_core import Rig, RunError, ScenarioError, list_scenarios, rig_of
from softrig_core.export.c_files import Exported
from softrig_core.export.check import replayed
from softrig_core.export.command import export_c, export_rig
from softrig_core.export.golden import member_of
from softrig_core.export.st import ordered, structured_text
from softrig_core.export.st_files import executed
from softrig_core.firmware.check import checked
from softrig_core.firmware.files import export_firmware
from softrig_core.native.value import NotNative

SAME = "same bits"
ROWS = 500  # calls recorded in the run, and as many with random inputs
FOLDED = "<details>\n<summary>{count} classes, {c} as C, {st} as structured text</summary>\n\n{table}\n</details>\n"
TICKS = 300  # ticks of a whole rig
GROUPED = "<details>\n<summary>{same} of {count} scenarios have the same bits</summary>\n\n{table}\n</details>\n"

BOARD_ROWS = 200  # calls on a board
BOARDS: tuple[Literal["arduino"], Literal["cortex-m4"]] = ("arduino", "cortex-m4")
MOST = 90  # letters of a reason
ON_BOARDS = "<details>\n<summary>All {count} classes</summary>\n\n{table}\n</details>\n"


def rigs(names: list[str]) -> str:
    """Return the table of whole rigs: results, and the scenarios with each."""
    results: dict[str, list[str]] = {}
    for name in names or list_scenarios():
        results.setdefault(whole(name), []).append(name)
    rows = sorted(results.items(), key=lambda row: (row[0] != SAME, -len(row[1]), row[0]))
    lines = ["| whole rig as C | scenarios | |", "|---|---|---|"]
    lines += [f"| {result} | {len(row)} | {', '.join(f'`{n}`' for n in row)} |" for result, row in rows]
    count = sum(map(len, results.values()))
    return GROUPED.format(same=len(results.get(SAME, ())), count=count, table="\n".join(lines))


def whole(name: str) -> str:
    """Return how the C of a whole scenario compares with its run in Python over `TICKS` ticks."""
    with tempfile.TemporaryDirectory() as place:
        try:
            done, _ = export_rig(rig_of(name), Path(place), rows=TICKS)
            result = replayed(Path(place), done.name)
        except ScenarioError as reason:
            return _short(str(reason))
    if result.same:
        return SAME
    return f"{result.differing} numbers differ, {result.gave_up} ticks were not answered"


def boards(names: list[str]) -> str:
    """Return the table of classes on boards: longest step and sizes under simulators."""
    lines = ["| class | node, scenario | Uno: cycles | flash | RAM | stack | M4: instructions | flash | RAM | stack |"]
    lines.append("|---" * 10 + "|")
    for kind, (node, rig) in sorted(_first(names).items()):
        cells = [_on_board(node, rig, board) for board in BOARDS]
        if all(cells):
            lines.append(f"| `{kind}` | `{node}`, `{rig.scenario.name}` | {' | '.join(cells)} |")
    return ON_BOARDS.format(count=len(lines) - 2, table="\n".join(lines))


def _on_board(node: str, rig: Rig, board: Literal["arduino", "cortex-m4"]) -> str:
    """Return four cells: longest step, flash, RAM, stack; empty if the class has no C."""
    with tempfile.TemporaryDirectory() as place:
        try:
            name, layout = export_firmware(rig, node, Path(place), board, rows=BOARD_ROWS, drawn=BOARD_ROWS)
        except ScenarioError:
            return ""
        try:
            result = checked(Path(place), name, layout, board)
        except ScenarioError as reason:
            missing = re.search(r"undefined reference to `(\w+)'", str(reason))
            text = f"its C library lacks `{missing[1]}`" if missing else str(reason).partition(f"{name} ")[2]
            return f"{text[:MOST].rstrip()} |  |  | "
        except RunError as reason:  # such as a stack that overwrites the state, which only the simulated board shows
            return f"{str(reason).rpartition(': ')[2][:MOST].rstrip()} |  |  | "
    differ = f" ({result.differing} of {result.rows} differ)" if result.differing else ""
    return f"{result.longest}{differ} | {result.flash} | {result.ram} | {result.stack}"


def _first(names: list[str]) -> dict[str, tuple[str, Rig]]:
    """Return each class with the first node that has it, and its rig."""
    seen: dict[str, tuple[str, Rig]] = {}
    for name in names or list_scenarios():
        rig = rig_of(name)
        for member in rig.members:
            seen.setdefault(member.block_class.__name__, (member.name, rig))
    return seen


def classes(names: list[str]) -> str:
    """Return the table: of each class the first scenario that has it."""
    rows = [_row(kind, node, rig) for kind, (node, rig) in _first(names).items()]
    rows.sort(key=lambda row: (row[2] != "same bits", row[0]))
    head = "| class | node, scenario | C | bits depend on the C library's | may be set | structured text |"
    lines = [head, "|---|---|---|---|---|---|", *(f"| {' | '.join(row)} |" for row in rows)]
    c, st = (sum(row[k] in ("same bits", "same numbers") for row in rows) for k in (2, 5))
    return FOLDED.format(count=len(rows), c=c, st=st, table="\n".join(lines))


def _row(kind: str, node: str, rig: Rig) -> tuple[str, ...]:
    about = f"`{kind}`", f"`{node}`, `{rig.scenario.name}`"
    with tempfile.TemporaryDirectory() as place:
        try:
            done = export_c(rig, node, Path(place), rows=ROWS, drawn=ROWS)
        except ScenarioError as reason:
            return *about, _short(str(reason)), "", "", ""
        result = replayed(Path(place), done.name)
    words = [", ".join(f"`{name}`" for name in names) or "-" for names in (done.libm, done.settable)]
    differ = f"{result.differing} numbers, {result.wrong_status} statuses differ"
    return *about, "same bits" if result.same else differ, *words, _structured(done, node, rig)


def _structured(done: Exported, node: str, rig: Rig) -> str:
    n, files, member = done.name, done.files, member_of(rig, node)
    try:
        text = ordered(structured_text(n, files[f"{n}.h"], files[f"{n}.c"], files["softrig_c.h"], member))
    except NotNative as reason:
        return _short(str(reason))
    result = executed(text, done, member)
    return "same numbers" if result.same else f"{result.differing} numbers, {result.wrong_status} statuses differ"


def _short(reason: str) -> str:
    """Return a reason without paths and line numbers."""
    reason = (reason.partition("cannot be exported as C: ")[2] or reason).partition("; instead, ")[0]
    match = re.fullmatch(r"[\w.]*?(\w+\.\w+|\w+), line \d+: (.*)", reason)
    return (f"{match[1]}: {match[2]}" if match else reason).replace("|", "/")


EXPORTED = {"classes": classes, "rigs": rigs, "boards": boards}
