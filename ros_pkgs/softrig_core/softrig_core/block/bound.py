"""The functions by which a step answers its ticks and moves on, made for it: what they read and write is bound once.

A function that goes through tables of ports at each tick takes a third longer than one whose text names them.
"""

from __future__ import annotations

import linecache
import zlib
from collections.abc import Callable, Iterable
from functools import lru_cache
from keyword import iskeyword
from types import CodeType
from typing import Any

from .answer import sum_of_products
from .link import Link
from .port import Sample

Step = Any  # `softrig_core.block.step.Step`, which imports this

SAY = """
def say(t):
    step.t = t
    try:
        if step.bad or t >= step.change_at:
            {asked} = step.asked(t)
        else:
            {answer} = respond(step.x, t{inputs})
{checked}
        step.said = {said}
{failed}
{kept}
    if events:
        step.tell()
{handed}
"""

ADVANCE = """
def advance(t, values=values):
    step.t = t
    try:
        step.x = move(step.x, t{inputs})
{failed}
    if events:
        step.tell()
{over}
"""

FAILED = """
    except Exception as error:
        step.fail(error)
"""

# of a block that says something on each output at each tick: nearly always the right number of floats
PLAIN = """
        try:
            {rows} = rows = {found}
            step.numbers = numbers = {numbers}
            fits = {sizes} and type(size := sum_of_products(numbers, numbers)) is float and size <= bound
        except (KeyError, TypeError, OverflowError):  # told by `checked`
            fits = False
        if not fits:
            {rows} = rows = step.checked(found)
            numbers = step.numbers
"""


def sayer(step: Step) -> Callable[[int], None]:
    """Make the function that answers a tick (ns) of a step as it is wired by now; see `Step.say`."""
    known: dict[str, Any] = {"respond": step.respond}
    rows = [f"row{k}" for k, _ in enumerate(step.outputs)]
    all_rows = "".join(f"{row}, " for row in rows)
    said = f"{{{', '.join(f'{p.name!r}: {row}' for p, row in zip(step.outputs, rows, strict=True))}}}"
    checked, handed = "        rows = numbers = ()", []
    if step.outputs and step.plain:
        sizes = [f"type({row}) is tuple and len({row}) == {p.size}" for row, p in zip(rows, step.outputs, strict=True)]
        checked = PLAIN.format(
            rows=all_rows,
            found="".join(f"found[{port.name!r}], " for port in step.outputs),
            numbers=rows[0] if len(rows) == 1 else f"({', '.join(f'*{row}' for row in rows)})",
            sizes=" and ".join(sizes),
        )
        known["bound"] = min(port.bound for port in step.outputs)
    elif step.outputs:
        checked = f"        {all_rows} = rows = step.checked(found)\n        numbers = ()"
        if any(port.sporadic for port in step.outputs):
            said = f"{{name: row for name, row in {said}.items() if row is not None}}"
        spoke = [f"before[{k}] if row{k} is None else t" if p.sporadic else "t" for k, p in enumerate(step.outputs)]
        handed += ["    before = step.spoken", f"    step.spoken = [{', '.join(spoke)}]"]
    for number, fill in enumerate([*step.readers, *step.doubters]):
        row, port = rows[fill.output], fill.port
        known |= {f"values{number}": fill.reader.values, f"reader{number}": fill.reader, f"port{number}": port}
        silent = "" if step.plain else f"if {row} is not None: "
        if step.outputs[fill.output].unchecked:
            handed.append(f"    {silent}reader{number}.doubt(t, port{number}, {fill.text(row)})")
        else:
            handed.append(f"    {silent}values{number}[{port.name!r}] = {fill.text(row)}")
    if step.link is not None:
        known["send"] = step.link.send
        handed.append("    send(t, rows, numbers)")
    if not step.plant:
        handed += _over(step, known)
    inputs = _inputs(step.asked_for)
    answer, kept = ("found", "") if step.plant else ("x, found", "    step.x = x")
    text = SAY.format(
        asked="_, found" if step.plant else answer,
        answer=answer,
        inputs=inputs,
        checked=checked,
        said=said,
        failed=FAILED,
        kept=kept,
        handed="\n".join(handed),
    )
    return _made("say", text, step, known)


def mover(step: Step) -> Callable[..., None]:
    """Make the function that moves a plant on; see `Step.advance`."""
    known = {"move": step.block.advance}
    over = "\n".join(_over(step, known))
    return _made("advance", ADVANCE.format(inputs=_inputs(step.values), failed=FAILED, over=over), step, known)


def _over(step: Step, known: dict[str, Any]) -> list[str]:
    """Write what is to be done when a tick is over, where there is anything."""
    links, link = [], step.link
    while link is not None:
        links.append(type(link).over)
        link = link.inner
    if set(links) <= {Link.over}:
        return []
    known["over"] = step.link.over
    return ["    over(t)"]


def _inputs(names: Iterable[str]) -> str:
    """Write the keywords of a call; a name that is no word of Python goes in as a text."""
    return "".join(
        f", {name}=values[{name!r}]"
        if name.isidentifier() and not iskeyword(name)
        else f", **{{{name!r}: values[{name!r}]}}"
        for name in names
    )


def _made(name: str, text: str, step: Step, known: dict[str, Any]) -> Callable[..., None]:
    known |= {
        "step": step,
        "values": step.values,
        "events": step.block.events,
        "sum_of_products": sum_of_products,
        "Sample": Sample,
    }
    exec(code_of(text, "tick"), known)
    found: Callable[..., None] = known[name]
    return found


@lru_cache(maxsize=256)
def code_of(text: str, name: str) -> CodeType:
    """Compile a text that was made here, so that a debugger and a traceback show its lines."""
    where = f"<{name} {zlib.crc32(text.encode()):08x}>"
    linecache.cache[where] = len(text), None, text.splitlines(keepends=True), where
    return compile(text, where, "exec")
