"""The function of a rig: all its members in their order, tick after tick, as one text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ..block.step import Step
from .reports import Reports
from .translate import Program
from .turns import WHEN, Turns
from .words import OWN, TEXTS

WORD = re.compile(r"\b\w+(?=\()")


@dataclass(frozen=True)
class RigText:
    """A rig's text.

    Attributes
    ----------
    text : str
    program : Program
    arrays : tuple of str
        Its arguments besides the state, in order: tables, random numbers, memory for calls, places for answers.
    stamped : tuple of int
        Steps with delayed outputs, whose stamps are at the end of the state.
    """

    text: str
    program: Program
    arrays: tuple[str, ...]
    stamped: tuple[int, ...]


def rig_text(steps: Sequence[Step], recorded: Sequence[Step], typed: bool = True, reports: bool = True) -> RigText:
    """Create the text of the members that are native.

    Parameters
    ----------
    steps : sequence of Step
        Plants first, then the others, each after those that it reads; each has answered a tick.
    recorded : sequence of Step
        Steps whose answers are written into tables.
    typed : bool
        Whether a state keeps its type and a table its shape, as numba needs it; else tables are lists of rows.
    reports : bool
        Whether ticks with reports also run natively.

    Raises
    ------
    NotNative
        Part of the members is not supported by native code.
    """
    turns = Turns(steps, recorded, typed)
    program, kept = turns.program, turns.kept
    program.reports = Reports() if reports else None
    body = [line for k, act in turns.acts() for line in turns.turn(k, act)]
    stamped = tuple(k for k, s in enumerate(steps) if any(p.delayed for p in s.outputs))
    state = ", ".join(
        [
            *(f"x{k}" for k, _ in enumerate(steps)),
            *(f"r{k}" for k, _ in enumerate(steps)),
            *(f"z{k}" for k in stamped),
            *(f"h{i}" for i, _ in enumerate(kept)),
        ]
    )
    written = [k for s in recorded for k, step in enumerate(steps) if step is s]
    arrays = turns.arrays | ({WHEN} if kept or turns.sporadic else set())
    turns.check_times()
    decided = turns.decided(state)
    handed = [*sorted(arrays), *(f"o{k}" for k in written), *(f"p{k}" for k in written if k in stamped)]
    head = [f"def rig({', '.join(['first', 'last', 'n', 'c', 's', *handed])}):", f"    {state}, = s"]
    # The tables of a call begin with the first tick of each member from n[2] on.
    head += [f"    e{k} = (n[2] + {turns.every(k) - 1}) // {turns.every(k)}" for k in written]
    head += [
        "    for k in range(first, last):",
        # Read when an exception has ended the call, and by a thread that describes a call which does not return.
        "        n[0] = k",
        f"        t = {turns.time('k')}",
        *([f"        {WHEN}[0] = t"] if WHEN in arrays else []),
    ]
    lines = (f"        {line}" for line in (*decided, *body))
    rig = "\n".join([*head, *lines, "    n[0] = last", f"    return ({state},)"])
    return RigText(written_out(program, rig), program, tuple(handed), stamped)


def written_out(program: Program, rig: str) -> str:
    """Return a text with the words and functions that it needs before it."""
    # Text that Python runs uses Python's own functions for words that have one.
    texts = TEXTS if program.typed else {w: text for w, text in TEXTS.items() if w not in OWN}
    words = [texts[w] for w in sorted(program.words) if w in texts]
    return "\n\n".join([*words, *_reached(program.functions, rig), rig]) + "\n"


def _reached(functions: Sequence[str], rig: str) -> list[str]:
    """Return the functions that the rig's calls, directly or not; others belong to abandoned translations."""
    known = {text[4 : text.index("(")]: text for text in functions}
    results: dict[str, str] = {}
    open_ = [rig]
    while open_:
        for name in WORD.findall(open_.pop()):
            if name in known and name not in results:
                results[name] = known[name]
                open_.append(known[name])
    return [text for text in functions if text in results.values()]
