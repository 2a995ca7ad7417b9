"""Check that ticks of a rig's blocks depend only on x, t and inputs: each of the first ones is computed twice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..block.block import Block, Observer, Plant
from ..block.loop import Loop
from ..block.port import Port, Sample
from ..errors import Impure, RunError
from ..kit.floats import others, read
from ..rig.members import Member
from ..rig.outside import is_foreign
from ..rig.rig import Rig
from ..solver.solver import Solver
from ..wire.recording import Recording
from ..wire.signals import Signals
from .inprocess import check_here, wired
from .stuck import watched

# Hidden state shows in the first ticks of the rig's clock, and each of them costs twice the time.
TICKS = 20
ADVICE = (
    "its state must be in x, not in a variable of a module, a closure, a list or a library, and random numbers "
    "come from self.uniform(k)"
)
HIDDEN = "hidden_state"  # key of the report of a block whose library keeps state outside of x
_pure: set[Any] = set()


@watched()
def check_pure(rig: Rig, seed: int | None = None) -> None:
    """Run the first ticks of a rig, and compute each answer twice from the same state and inputs.

    This detects state that a block stores outside of x: a variable of a module or a closure, a list, a static variable
    of a library. A class, with the files that define its behaviour, is checked once a process. Rigs with a solver,
    whose ticks are work of another process, are left out.

    Parameters
    ----------
    seed : int, optional
        Seed of the rig; the scenario's when absent.

    Raises
    ------
    Impure
        Two answers differ; the error names node, output, time and both values.
    ScenarioError
        A node of the rig is external.
    """
    check_here(rig)
    new = {m.name: _key(m) for m in rig.members if _key(m) not in _pure}
    if not new or any(issubclass(m.block_class, Solver) for m in rig.members):
        return
    blocks = {m.name: m.block(rig.scenario.seed_of(seed)) for m in rig.members}
    copies = [name for m in rig.members if m.name in new for name in _watched(m, blocks[m.name])]
    try:
        ticks = Loop(list(wired(rig, blocks).values())).run()
        for _, _ in zip(range(TICKS), ticks, strict=False):
            pass
    except Impure:
        raise
    # Any other error will be raised by the run itself, with its own message.
    except RunError:
        return
    finally:
        for block, method in copies:
            vars(block).pop(method, None)
    _pure.update(new.values())


def is_suspect(rig: Rig) -> bool:
    """Return whether a run of a rig may depend on those before it: it has blocks that are not softrig's own.

    Rigs with a solver, whose ticks are work of another process, are left out.
    """
    classes = [m.block_class for m in rig.members]
    return any(map(is_foreign, classes)) and not any(issubclass(cls, Solver) for cls in classes)


def check_same(rig: Rig, before: Recording, after: Recording) -> None:
    """Compare two runs of a rig with the same parameters and seed.

    Raises
    ------
    Impure
        They differ; names the first signal that does, its time, and both values.
    """
    if all(topic == after.topics[name] for name, topic in before.topics.items()):
        return
    publishers = {port.topic: member.name for member in rig.members for port in member.outputs}
    order = {topic: k for k, topic in enumerate(publishers)}
    differences = []
    first, again = Signals(before), Signals(after)
    for name in first:
        (t, x), (_, y) = first[name], again[name]
        for k, (a, b) in enumerate(zip(x.tolist(), y.tolist(), strict=False)):
            if repr(a) != repr(b):
                topic = max((known for known in order if name.startswith(f"{known}/")), key=len, default="")
                differences.append((t[k], order.get(topic, len(order)), name, a, b, publishers.get(topic, "")))
                break
    if not differences:
        raise Impure(f"{rig.scenario.name}: a second run of the same parameters and seed publishes other messages")
    t0, _, name, a, b, node = min(differences)
    error = Impure(
        f"{node or rig.scenario.name}: {name} = {a} at t = {t0:.9g} s, and {b} in a second run of the same parameters "
        f"and seed; {ADVICE}"
    )
    error.node = node
    raise error


def _key(member: Member) -> Any:
    return member.block_class, tuple(sorted(member.files.items()))


def _watched(member: Member, block: Block) -> list[tuple[Block, str]]:
    """Let the methods of a block compute each answer twice."""
    methods = ("outputs", "advance") if isinstance(block, Plant) else ("update",)
    if isinstance(block, Observer) and not member.outputs:
        return []
    for method in methods:
        _watch(member, block, method)
    return [(block, method) for method in methods]


def _watch(member: Member, block: Block, method: str) -> None:
    once = getattr(block, method)
    is_value = type(block).save is Block.save

    def twice(x: Any, t: int, **inputs: Any) -> Any:
        saved = None if is_value else block.save(x)
        first = once(x, t, **inputs)
        events = list(block.events)
        answer = _parts(method, first)
        after = None if is_value or method == "outputs" else block.save(answer[0])
        second = once(x if is_value else block.load(saved), t, **inputs)
        # The second computation must not report everything twice.
        block.events[:] = events
        if difference := _differing(member.outputs, answer, _parts(method, second), is_value):
            error = Impure(
                f"{member.name}: the tick at t = {t / 1e9:.9g} s, computed twice from the same state and inputs, gives "
                f"{difference}; {ADVICE}"
            )
            error.node = member.name
            raise error
        if is_value:
            return first
        # The second computation has moved the objects within the state, so they are put back to where the first one
        # left them.
        block.load(saved if method == "outputs" else after)
        return first

    setattr(block, method, twice)


def _parts(method: str, value: Any) -> tuple[Any, Mapping[str, Any]]:
    """Return the state after a call, None if it is unchanged, and the published values."""
    return (None, value) if method == "outputs" else (value, {}) if method == "advance" else value


def _differing(ports: Sequence[Port], first: tuple[Any, Any], second: tuple[Any, Any], is_value: bool) -> str:
    """Name the first output, else the first number of the state, that differs; with both values."""
    for port in ports:
        rows = [_row(result[1], port.name) for result in (first, second)]
        # Texts tell -0.0 from 0.0 and find NaN equal to itself, as a comparison of bits does.
        if repr(rows[0]) != repr(rows[1]):
            for label, a, b in zip(port.labels, *(row or [None] * port.size for row in rows), strict=False):
                if repr(a) != repr(b):
                    return f"{port.topic}/{label} = {a} and then {b}"
            return f"{port.topic} = {rows[0]} and then {rows[1]}"
    # Objects in a state are compared by their numbers, because the second call may have copied a buffer.
    if is_value:
        for (name, a), (_, b) in zip(_known(first[0]), _known(second[0]), strict=False):
            if a != b:
                return f"its state {name} = {a} and then {b}"
    return ""


def _known(x: Any) -> list[tuple[str, str]]:
    return [(name, repr(row.tolist())) for name, row in read(x)] + [(name, repr(value)) for name, value in others(x)]


def _row(values: Mapping[str, Any], name: str) -> Any:
    row = values.get(name)
    return row.data if isinstance(row, Sample) else row
