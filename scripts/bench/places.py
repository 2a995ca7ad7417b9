"""Where the parts of a tick are defined: the functions that name each part, counted in the syntax trees of the code."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

from .console import console

ROOT = Path(__file__).resolve().parents[2] / "ros_pkgs"
# The rooms that a tick runs through, of this version and of those before the packages were parted.
ROOMS = (
    *(f"softrig_core/softrig_core/{room}" for room in ("block", "native", "run", "rig/rig.py", "solver", "node")),
    *(f"softrig_nodes/softrig_nodes/{room}" for room in ("adapter", "lockstep", "realtime", "seam", "group.py")),
)
# A function names a part if this pattern is found in its code; names of both versions where they differ.
KINDS = {
    "order: plants publish, others answer, plants move": r"if (not )?\w+(\.\w+)*\.(is_)?plant\b|\bplants\b",
    "greatest common divisor of the periods": r"\bgcd\(",
    "which nodes are due, computed": r"(%|//|//=) \(?\w*(\.\w+)*_?every\b|%+ \{\w*(\.\w+)*every",
    "which nodes are due, asked for": r"\.(due|following|newest|own)\((\w+\.)?schedule",
    "the end": r"\b(at_end|speaks_at_end|ticks_at_end|answers|moves)\(|schedule\.(last|end)\b|\.ticks is None",
    "an output fills an input": r"\.(take|bring|value_of|set_value)\("
    r"|\b(taking|value_text|picked|taken|take|pick|fill)\(",
    "which node subscribes to which": r"\.(readers|doubters|checked_readers|fed|sources|links|hands_to)\b"
    r"|\b_(readings|links|source)\(",
    "an answer is checked": r"\b(admit|usual|checked|sum_of_products|sumprod)\(|\.beyond\(",
    "a port of a fault, which may be bad": r"\.unchecked\b|\.(doubt|receive_unchecked|whole)\(",
    "rejected input, what is held": r"\.bad\b|\brefused\(",
    "sporadic silence": r"\.sporadic\b|\.(spoken|published_at)\b|\.silent\b",
    "delayed": r"\.delayed\b",
    "partial": r"\.partial\b|\.kept\b.*\bpartial|decode\.kept\b",
    "ages": r"\.(age|ages|held_stamp)\b|\b_ages\(",
    "ticks without an answer": r"\.unanswered\b",
    "last word": r"\bfinishes\(|\.finish\(\w|\bFinishing\b|block\.finish\b",
    "parameter changes that are due": r"\.(change_at|changes)\b",
    "reports": r"\.(tell|store_reports|drop|note|take_down|withdraw)\(",
    "observers in batches": r"\bat_once\(|\btakes_batches\(|\bgather\(",
    "what is recorded": r"\b(send_all|add_row|record_batch|many_keeper|keeper|\w*sink)\b",
    "numbers of messages": r"\.counts\[|\bcounts\[|\bNumbering\b|\bencoder\(",
    "solver in two halves": r"\.begun\b|\.begin\(|\.end\(x|\bSolving\b",
    "decides, discarded ticks": r"\bdecides\(|\b_decided\(|\.given_up\b|\.discarded\b",
    "buttons": r"\.buttons\b",
    "everything that changes": r"\b(TABLES|VALUES|Kept|Moment)\b|\.(keep|go_back)\(|\.(save|load)\(",
    "slots that other code fills": r"\.(send|respond|lacks|say|answer|advance|moved|make_anew) = ",
}


def _functions(file: Path) -> Iterator[tuple[str, str]]:
    """Yield name and code of each function or method and of the module's own statements, without comments."""
    tree = ast.parse(file.read_text())
    homes: list[ast.Module | ast.ClassDef] = [
        tree,
        *(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)),
    ]
    for home in homes:
        for node in home.body:
            if isinstance(node, ast.FunctionDef):
                body = node.body[1:] if ast.get_docstring(node) is not None else node.body
                yield f"{file.stem}.{node.name}", "\n".join(map(ast.unparse, body))
            elif home is tree and isinstance(node, ast.Assign):
                yield f"{file.stem}.{ast.unparse(node.targets[0])}", ast.unparse(node)


def places(packages: Path = ROOT) -> dict[str, list[str]]:
    """Return the functions that name each part of a tick, as ``module.function``, in the packages of a checkout."""
    results = [packages / room for room in ROOMS]
    files = [file for room in results for file in (sorted(room.rglob("*.py")) if room.is_dir() else [room])]
    code = [one for file in files if file.exists() for one in _functions(file)]
    return {kind: [name for name, text in code if re.search(pattern, text)] for kind, pattern in KINDS.items()}


def print_table() -> None:
    """Count the functions that name each part of a tick (who is due, silence, ages, ...)."""
    table = Table("part of a tick", "functions", "modules", "in")
    for kind, names in places().items():
        modules = list(dict.fromkeys(name.partition(".")[0] for name in names))
        table.add_row(kind, str(len(names)), str(len(modules)), ", ".join(modules))
    console.print(table)
