"""The generated function that advances many instances of a rig with an agent, each by one period of the agent.

The state of an instance between two calls is stored in a row of two tables, one for real numbers and one for integers,
as it is before the agent's tick. Outputs of members that run before the agent are computed again at the beginning of
the next call.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

from ..block.step import Step
from .rig_text import RigText, written_out
from .translate import Program
from .turns import Turns
from .twins import packed
from .value import NotNative


class Form:
    """The places of the parts of a state in a row of the two tables.

    Parameters
    ----------
    sample : tuple
        A state.

    Raises
    ------
    NotNative
        Part of it is not a number.
    """

    def __init__(self, sample: Any) -> None:
        self.sizes = [0, 0]
        self.parts: list[tuple[tuple[int, ...], str, int, type]] = []
        self.tree = self._placed(sample, ())

    def _placed(self, value: Any, path: tuple[int, ...]) -> Any:
        if isinstance(value, tuple):
            return type(value), [self._placed(v, (*path, k)) for k, v in enumerate(value)]
        if value is None:
            return None
        kind = type(value)
        if kind not in (float, int, bool, complex):
            raise NotNative(f"{kind.__name__} in a state: an instance is a row of numbers")
        table = kind in (int, bool)
        self.parts.append((path, "FI"[table], self.sizes[table], kind))
        self.sizes[table] += 1 + (kind is complex)
        return self.parts[-1]

    def read(self, program: Program, tree: Any) -> str:
        """Write code that reads a state, or a part of one, from row i."""
        if tree is None:
            return "None"
        if len(tree) == 2:
            kind, parts = tree
            inner = "".join(f"{self.read(program, part)}, " for part in parts)
            return f"{program.name(kind, kind.__name__) if hasattr(kind, '_fields') else ''}({inner})"
        _, table, col, kind = tree
        if kind is complex:
            return f"complex(F[i, {col}], F[i, {col + 1}])"
        return f"({table}[i, {col}] != 0)" if kind is bool else f"{table}[i, {col}]"

    def write(self, name: str) -> list[str]:
        """Write code that stores a state in row i."""
        result = []
        for path, table, col, kind in self.parts:
            value = f"{name}{''.join(f'[{k}]' for k in path)}"
            parts = [f"{value}.real", f"{value}.imag"] if kind is complex else [value]
            result += [f"{table}[i, {col + j}] = {part}" for j, part in enumerate(parts)]
        return result

    def put(self, state: Any, numbers: Any, ints: Any) -> None:
        """Write a state of this form into a row."""
        for path, table, col, kind in self.parts:
            value = state
            for k in path:
                value = value[k]
            if table == "I":
                ints[col] = value
            else:
                parts = (value.real, value.imag) if kind is complex else (value,)
                numbers[col : col + len(parts)] = parts

    def get(self, numbers: Any, ints: Any, tree: Any = ()) -> Any:
        """Return the state that is in a row."""
        tree = self.tree if tree == () else tree
        if tree is None:
            return None
        if len(tree) == 2:
            kind, parts = tree
            results = [self.get(numbers, ints, part) for part in parts]
            return kind(*results) if hasattr(kind, "_fields") else tuple(results)
        _, table, col, kind = tree
        return complex(*numbers[col : col + 2]) if kind is complex else kind((numbers if table == "F" else ints)[col])


def remembered(agent: Step, steps: Sequence[Step], before: Sequence[tuple[Any, tuple[float, ...]]]) -> tuple[Any, Any]:
    """Return the values of an instance that must be stored before a tick.

    Parameters
    ----------
    agent, steps
        See `batch_text`.
    before : sequence of (x, numbers)
        State and last outputs of each step.
    """
    states = tuple(() if s is agent else packed(x) for s, (x, _) in zip(steps, before, strict=True))
    return states, tuple(tuple(map(float, numbers)) for _, numbers in before)


def batch_text(steps: Sequence[Step], agent: Step, texts: Sequence[str], form: Form) -> RigText:
    """Create the text of the function.

    Parameters
    ----------
    steps : sequence of Step
        Steps of one instance, as for `rig_text`; each has answered a tick.
    agent : Step
        One of them; not a plant.
    texts : sequence of str
        Its outputs, number after number, as expressions of action row `a`.
    form : Form
        Form of the result of `remembered`.

    Returns
    -------
    RigText
        ``rig(begin, end, n, c, F, I, R, A, K, *arrays)`` advances instances begin to end - 1 whose tick K is not
        negative by one period of the agent. It changes their rows of F and I and their columns of R (the last outputs
        up to the agent's next tick). n[0] is the current instance; if an exception is raised, its tick is discarded.
        Random numbers have a row an instance.

    Raises
    ------
    NotNative
        Part of the steps is not supported by native code.
    """
    turns = Turns(steps)
    if odd := [holding.fill.port.name for holding in turns.kept]:
        raise NotNative(f"{odd[0]}: outputs that are silent at times, or late, are not supported in batches yet")
    turns.check_times()
    program = turns.program
    before: list[str] = []
    body: list[str] = []
    for k, act in turns.acts():
        if steps[k] is agent:
            before = list(body)
        body += turns.given(k, texts) if steps[k] is agent else turns.turn(k, act)
    states, last = form.tree[1]
    handed = sorted(turns.arrays)
    offsets = [0, *accumulate(len(s.numbers) for s in steps)]
    every = turns.plan.every(agent.schedule)
    names = ", ".join(["begin", "end", "n", "c", "F", "I", "R", "A", "K", *(_all_draws(a, program) for a in handed)])
    results = ", ".join(f"({''.join(f'{name}{k}, ' for k, _ in enumerate(steps))})" for name in "xr")
    text = [
        f"def rig({names}):",
        "    for i in range(begin, end):",
        "        n[0] = i",
        # Python advances such an instance: its episode has begun just now, or the text does not fit it.
        "        if K[i] < 0:",
        "            continue",
        *(f"        {name} = {name}_all[i]" for name in program.draws.values()),
        *(f"        x{k} = {form.read(program, tree)}" for k, tree in enumerate(states[1])),
        *(f"        r{k} = {form.read(program, tree)}" for k, tree in enumerate(last[1])),
        "        a = A[i]",
        f"        for k in range(K[i], K[i] + {every}):",
        f"            t = {turns.time('k')}",
        *(f"            {line}" for line in body),
        # A row keeps what is before the agent's tick; what follows is only for R and is computed again in the next
        # call.
        f"        z_ = ({results})",
        f"        k = K[i] + {every}",
        f"        t = {turns.time('k')}",
        *(f"        {line}" for line in before),
        "        K[i] = k",
        *(f"        R[{offsets[k] + j}, i] = r{k}[{j}]" for k, s in enumerate(steps) for j, _ in enumerate(s.numbers)),
        *(f"        {line}" for line in form.write("z_")),
    ]
    rig = "\n".join(text)
    return RigText(written_out(program, rig), program, tuple(handed), ())


def _all_draws(name: str, program: Program) -> str:
    return f"{name}_all" if name in program.draws.values() else name
