"""Functions that compute the ticks of one step, generated for it with all that they read and write bound in advance.

A function that iterates over tables of ports at each tick takes a third longer than one whose text names the ports.
"""

from __future__ import annotations

import linecache
import zlib
from collections.abc import Callable, Iterable
from functools import lru_cache
from keyword import iskeyword
from types import CodeType
from typing import TYPE_CHECKING, Any

from ..errors import FAILURES
from .answer import only_floats, sum_of_products
from .fill import value_text
from .port import Port, Sample

if TYPE_CHECKING:
    from .step import Step

ANSWER = """
def answer(t):
    step.t = t
    try:
        if step.bad or t >= step.change_at:
            {asked} = step.asked(t)
        else:
            {answer} = respond(step.x, t{inputs})
{checked}
        step.last_answer = rows
{failed}
{kept}
    if events:
        step.store_reports()
{handed}
"""

ADVANCE = """
def advance(t, values=values):
    step.t = t
    try:
        step.x = move(step.x, t{inputs})
{failed}
    if events:
        step.store_reports()
{over}
"""

FAILED = """
    except FAILURES as error:
        step.fail(error)
"""

# For a block that publishes on each output at each tick. Nearly always these are the right number of valid floats, and
# one sum of squares shows that: if it is at most `bound`, each value is within its limit, and NaN fails the comparison.
# Only if this test fails are the values checked one by one, which also describes what is wrong.
PLAIN = """
        try:
            {rows} = rows = {found}
            step.numbers = numbers = {numbers}
            fits = len(found) == {count} and {sizes}
            fits = fits and only_floats(map(type, numbers)) and sum_of_products(numbers, numbers) <= bound
        except (KeyError, TypeError, OverflowError):  # reported by `checked`
            fits = False
        if not fits:
            {rows} = rows = step.checked(found)
            numbers = step.numbers
"""


def answerer(step: Step) -> Callable[[int], None]:
    """Create the function that answers a tick (ns) of a step with its present wiring; see `Step.answer`."""
    fills = step.readers
    known: dict[str, Any] = {"respond": step.respond, "bound": min([port.bound for port in step.outputs], default=0.0)}
    for number, fill in enumerate(fills):
        reader = fill.reader
        known |= {f"values{number}": reader.values, f"reader{number}": reader, f"port{number}": fill.port}
    wires = tuple([(f.output, f.port.name, value_text(f"row{f.output}", f.pick, f.stamp), f.checked) for f in fills])
    text = _answer_text(step.plain, step.plant, step.outputs, step.asked_for, wires, _ends(step, known))
    return _function_of("answer", text, step, known)


def _ends(step: Step, known: dict[str, Any]) -> tuple[str, ...]:
    """Write the calls to a step's links after its answer: only those methods that have an effect."""
    sends, over = step.overriding("send"), step.overriding("over")
    results: list[str] = []
    # A plain step always publishes the same numbers, so the rows need not be passed to a recorder.
    if sends is not None and sends.add_row is not None and step.plain:
        known["add_row"] = sends.add_row
        results.append("    add_row(t, numbers)")
    elif sends is not None:
        known["send"] = sends.send
        results.append("    send(t, rows, numbers)")
    # The tick of a plant is over only after it has advanced; `mover` writes that call.
    if over is not None and not step.plant:
        known["over"] = over.over
        results.append("    over(t)")
    return tuple(results)


# The text depends on the form of a step only, so the runs of a study share it.
@lru_cache(maxsize=256)
def _answer_text(
    plain: bool,
    plant: bool,
    outputs: tuple[Port, ...],
    asked_for: tuple[str, ...],
    wires: tuple[tuple[int, str, str, bool], ...],
    ends: tuple[str, ...],
) -> str:
    rows = [f"row{k}" for k, _ in enumerate(outputs)]
    all_rows = "".join(f"{row}, " for row in rows)
    checked, handed = "        rows = numbers = ()", []
    if outputs and plain:
        sizes = [f"type({row}) is tuple and len({row}) == {p.size}" for row, p in zip(rows, outputs, strict=True)]
        checked = PLAIN.format(
            rows=all_rows,
            found="".join(f"found[{port.name!r}], " for port in outputs),
            numbers=rows[0] if len(rows) == 1 else f"({', '.join(f'*{row}' for row in rows)})",
            sizes=" and ".join(sizes),
            count=len(outputs),
        )
    elif outputs:
        checked = f"        {all_rows} = rows = step.checked(found)\n        numbers = ()"
        published = [f"before[{k}] if row{k} is None else t" if p.sporadic else "t" for k, p in enumerate(outputs)]
        handed += ["    before = step.published_at", f"    step.published_at = [{', '.join(published)}]"]
    for number, (output, name, used, checks) in enumerate(wires):
        silent = "" if plain else f"if {rows[output]} is not None: "
        if checks:
            handed.append(f"    {silent}reader{number}.receive_unchecked(t, port{number}, {used})")
        else:
            handed.append(f"    {silent}values{number}[{name!r}] = {used}")
    handed += ends
    answer, kept = ("found", "") if plant else ("x, found", "    step.x = x")
    return ANSWER.format(
        asked="_, found" if plant else answer,
        answer=answer,
        inputs=_inputs(asked_for),
        checked=checked,
        failed=FAILED,
        kept=kept,
        handed="\n".join(handed),
    )


def mover(step: Step) -> Callable[..., None]:
    """Create the function that advances a plant; see `Step.advance`."""
    over = step.overriding("over")
    known = {"move": step.move} | ({} if over is None else {"over": over.over})
    return _function_of("advance", _move_text(tuple(step.values), over is not None), step, known)


@lru_cache(maxsize=256)
def _move_text(inputs: tuple[str, ...], ends: bool) -> str:
    return ADVANCE.format(inputs=_inputs(inputs), failed=FAILED, over="    over(t)" * ends)


def _inputs(names: Iterable[str]) -> str:
    """Write the keywords of a call; a name that is not a Python identifier is passed as a string."""
    return "".join(
        f", {name}=values[{name!r}]"
        if name.isidentifier() and not iskeyword(name)
        else f", **{{{name!r}: values[{name!r}]}}"
        for name in names
    )


def _function_of(name: str, text: str, step: Step, known: dict[str, Any]) -> Callable[..., None]:
    known |= {
        "step": step,
        "values": step.values,
        "events": step.block.events,
        "only_floats": only_floats,
        "sum_of_products": sum_of_products,
        "Sample": Sample,
        "FAILURES": FAILURES,
    }
    # Names of the step become globals of the generated function: a lookup there is faster than an attribute's.
    exec(code_of(text, "tick"), known)
    result: Callable[..., None] = known[name]
    return result


@lru_cache(maxsize=256)
def code_of(text: str, name: str) -> CodeType:
    """Compile a generated text, so that a debugger and a traceback show its lines."""
    filename = f"<{name} {zlib.crc32(text.encode()):08x}>"
    linecache.cache[filename] = len(text), None, text.splitlines(keepends=True), filename
    return compile(text, filename, "exec")
