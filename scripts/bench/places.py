"""Where the parts of a tick are stated: functions that read or compute each part, counted in the syntax trees."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from .page import Table, Tables

ROOT = Path(__file__).resolve().parents[2] / "ros_pkgs"
# Rooms with the code of a tick, in this version and in those before the packages were split.
ROOMS = (
    *(f"softrig_core/softrig_core/{room}" for room in ("block", "native", "run", "rig/rig.py", "solver", "node")),
    *(f"softrig_nodes/softrig_nodes/{room}" for room in ("adapter", "lockstep", "realtime", "seam", "group.py")),
)
# A function states a part if its code computes it or reads what declares it, as detected by these patterns. A call of
# the function that owns the part does not count (`plan.due(...)`, `step.note(...)`, `fill.bring(...)`); otherwise the
# count would grow whenever a function is split. Names of both versions are listed where they differ.
KINDS = {
    "order: plants publish, others answer, plants move": r"\bplants\b|for \w+ in \w+ if (not )?\w+\.(is_)?plant\b",
    "greatest common divisor of the periods": r"\bgcd\(",
    "which nodes are due": r"(%|//|//=) \(?(\w+\.)*\w*every\b|%+ \{(\w+\.)*\w*every",
    "the end": r"\bat_end\b|(schedule|self|clock)\.(last|end)\b|\.ticks is None",
    "an output fills an input": r"\.pick\b|\bpick(ed)?\b|\b(taking|taken|value_text)\(",
    "which node subscribes to which": r"\.(readers|doubters|fed|sources)\b(?! <)|\b(_readings|links|_source|fed)\(",
    "an answer is checked": r"\.bound\b|\.limits\b|\b(sum_of_products|sumprod)\(",
    "a port of a fault, which may be bad": r"\.unchecked\b",
    "rejected input, what is held": r"\.bad\b",
    "sporadic silence": r"\bp(ort)?\.sporadic\b|self\.sporadic and|\.(spoken|published_at)\b",
    "delayed": r"\.delayed\b",
    "partial": r"\.partial\b|\.kept\b.*\bpartial|decode\.kept\b",
    "ages": r"\.(ages|held_stamp)\b|\b_ages?\(|def age",
    "ticks without an answer": r"\.unanswered\b",
    "last word": r"\.finish\(\w|\bFinishing\b|\bblock\.finish\b|\bFINISHES\b|\bfinishes\(",
    "parameter changes that are due": r"\.(change_at|changes)\b",
    "reports": r"\.events\b|\breports\[|\.anew\b",
    "observers in batches": r"\bat_once\(",
    "what is recorded": r"\b(sink|shard)\.(add|row)|\b_?add_rows?\(|\badd\(number|\brecord_batch\b",
    "numbers of messages": r"\b_?counts\[[\w.]*name\]|\.said \+= 1|\bnext\([\w.]*numbers\)",
    "solver in two halves": r"\.begun\b|\.begin\((step\.)?x|\.end\(x",
    "decides, discarded ticks": r"\.decides\b|\.given_up\b|\.discarded\b|\"decides\"",
    "buttons": r"\.buttons\b",
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
    """Return the functions that state each part of a tick, as ``module.function``, in the packages of a checkout."""
    results = [packages / room for room in ROOMS]
    files = [file for room in results for file in (sorted(room.rglob("*.py")) if room.is_dir() else [room])]
    code = [one for file in files if file.exists() for one in _functions(file)]
    return {kind: [name for name, text in code if re.search(pattern, text)] for kind, pattern in KINDS.items()}


def table() -> Tables:
    """Count the functions that state each part of a tick (who is due, silence, ages, ...)."""
    rows: Table = [("part of a tick", "functions", "modules")]
    result = places()
    for kind, names in result.items():
        rows.append((kind, str(len(names)), ", ".join(dict.fromkeys(name.partition(".")[0] for name in names))))
    rows.append(("all", str(sum(map(len, result.values()))), ""))
    return {"places": rows}
