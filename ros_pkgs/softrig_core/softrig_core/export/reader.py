"""From the text of one block, specialised for native code, to statements of C99.

The text is the one that numba compiles (`softrig_core.native`). Its types follow from those of its arguments: a
function is read again until no variable changes its type. A call that may discard the tick is a separate statement, so
that its flag is checked before anything else is computed.
"""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .calls import Calls
from .expressions import STRIDED
from .kinds import (
    ABSENT,
    INT,
    Absent,
    Number,
    Table,
    remark,
    united,
    used_as,
)
from .unit import WHOLE, Signature, Value, bare, reads

ROUNDS = 12  # passes over a function until its types no longer change
ASSIGNED = re.compile(r"( *)(\w+) = (.*);")


class Reader(Calls):
    """Reads one function of the text, or of Python, for given types of its arguments."""

    def whole(self, name: str) -> tuple[str, Signature]:
        """Return the text of the function and how it is called."""
        names = [a.arg for a in self.tree.args.args]
        if len(names) != len(self.kinds):
            raise self.unknown(f"{len(self.kinds)} arguments, expected {len(names)}", self.tree)
        self.name = name
        for _ in range(ROUNDS):
            before = dict(self.kinds_of), self.result
            self.lines = []
            self.local_tables = {}
            self.env = {}
            self.discards = self.ended = False
            self.temporaries = 0
            self.loops = []
            for k, (argument, kind) in enumerate(zip(names, self.kinds, strict=True)):
                c = self.handed[k] if self.handed[k] is not None else _argument(argument)
                self.env[argument] = Value(kind, c, self.unit.by_name.get(c))
            self.block(self.tree.body)
            if not self.ended:
                self._returned(Value(ABSENT, "0"))
            if (self.kinds_of, self.result) == before:
                break
        else:
            raise self.unknown("types that do not settle", self.tree)
        result = self.result if self.result is not None else ABSENT
        heads = [
            f"{self.unit.c(k)} {_argument(n)}"
            for n, k, h in zip(names, self.kinds, self.handed, strict=True)
            if h is None and not isinstance(k, Absent)
        ]
        head = f"/* {remark(self.origin)} */\nstatic inline {self.unit.c(result)} {name}"
        head += f"({', '.join([f'{self.unit.prefix} *s', *heads])})\n"
        self._without_unread()
        text = "\n".join(self.lines)
        if STRIDED in text:
            raise self.unknown("an array that is not contiguous", self.tree)
        variables = [
            f"    {self.unit.c(kind)} {variable};" for variable, kind in self.kinds_of.items() if reads(variable, text)
        ]
        for n, t in self.local_tables.items():
            if n.startswith("s->m."):
                self.unit.rooms[n.removeprefix("s->m.")] = t
            elif reads(n, text):
                variables.append(f"    {self.unit.c(t.item)} {n}[{max(t.size, 1)}];")
        zero = "0" if isinstance(result, (Number, Absent)) else f"({self.unit.c(result)}){{ 0 }}"
        words = ["s", *(g.rpartition(" ")[2].lstrip("*") for g in heads)]
        # A field may have the name of an argument.
        unused = [f"    (void){w};" for w in words if not re.search(rf"(?<![.\w]){w}\b", text)]
        body = [*variables, *unused, *(f"    {line.replace('@ZERO@', zero)}" for line in self.lines)]
        return head + "{\n" + "\n".join(body) + "\n}\n", Signature(name, result, self.discards)

    def _without_unread(self) -> None:
        """Remove assignments that are never read, and unused results of calls."""
        while True:
            lines: list[str] = []
            for line in self.lines:
                # `-Wall` warns of variables that are set and not read.
                match = ASSIGNED.fullmatch(line)
                var = match.group(2) if match and match.group(2) in self.kinds_of else ""
                if (
                    match
                    and var
                    and not any(reads(var, code) for code in self.lines if not code.lstrip().startswith(f"{var} = "))
                ):
                    if re.match(rf"{self.unit.prefix}_\w+\(s\b", match.group(3)):
                        lines.append(f"{match.group(1)}(void){match.group(3)};")
                    continue
                lines.append(line)
            if lines == self.lines:
                return
            self.lines = lines

    # statements ---------------------------------------------------------------------------------------------------

    def block(self, statements: Sequence[ast.stmt]) -> None:
        """Write statements up to the first that ends the function."""
        for statement in statements:
            if self.ended:
                return
            method = getattr(self, f"_{type(statement).__name__.lower()}", None)
            if method is None:
                raise self.unknown(f"a statement `{type(statement).__name__.lower()}`", statement)
            method(statement)

    def _pass(self, node: ast.Pass) -> None:
        pass

    def _import(self, node: ast.Import) -> None:
        for alias in node.names:
            self.env[alias.asname or alias.name] = Value(ABSENT, "0", importlib.import_module(alias.name))

    def _raise(self, node: ast.Raise) -> None:
        self.give_up()

    def _expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self.value(node.value)

    def _return(self, node: ast.Return) -> None:
        self._returned(Value(ABSENT, "0") if node.value is None else self.value(node.value))

    def _returned(self, value: Value) -> None:
        both = united(self.result, value.kind) if self.result is not None else value.kind
        if both is None:
            raise self.unknown("answers of several forms")
        self.result = both
        self.emit(f"return {self.coerced(value, both).c};")
        self.ended = True

    def _assign(self, node: ast.Assign) -> None:
        value = self.value(node.value)
        if len(node.targets) > 1:
            value = self.named(value)
        for target in node.targets:
            self.bind(target, value)

    def _annassign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.bind(node.target, self.value(node.value))

    def _augassign(self, node: ast.AugAssign) -> None:
        load: Any = ast.parse(ast.unparse(node.target), mode="eval").body
        self.bind(node.target, self.binary(node.op, self.value(load), self.value(node.value), node))

    def bind(self, target: ast.expr, value: Value) -> None:
        """Assign a value to a name, names, or an element of an array."""
        if isinstance(target, ast.Name):
            fixed = isinstance(value.kind, Absent) or value.thing is not None or self.is_room(value)
            # A whole number that is written out may be the size of an array, which C has to know.
            if fixed or (value.kind == INT and WHOLE.fullmatch(value.c)):
                self.env[target.id] = value
                return
            c = self._variable(target.id, value.kind)
            kind = self.kinds_of[c]
            self.emit(f"{c} = {self.coerced(value, kind).c};")
            self.env[target.id] = Value(kind, c)
        elif isinstance(target, (ast.Tuple, ast.List)):
            parts = [self.named(p) for p in self.parts(value, target)]
            if len(parts) != len(target.elts):
                raise self.unknown(f"{len(parts)} values for {len(target.elts)} names", target)
            for name, item in zip(target.elts, parts, strict=True):
                self.bind(name, item)
        elif isinstance(target, ast.Subscript):
            table = self.value(target.value)
            if not isinstance(table.kind, Table) or isinstance(table.thing, np.ndarray):
                raise self.unknown("an assignment to a part of a tuple", target)
            if isinstance(target.slice, ast.Slice):
                self._filled_whole(self.view(table, self._ends(target.slice), target), value, target)
                return
            element = self._place_of(table, target)
            if isinstance(element.kind, Table):
                self._filled_whole(element, value, target)
                return
            self.emit(f"{element.c} = {self.coerced(value, element.kind).c};")
        else:
            raise self.unknown("an assignment to a part of something", target)

    def _place_of(self, table: Value, target: ast.Subscript) -> Value:
        """Return the element or row of an array that an assignment names."""
        if isinstance(target.slice, ast.Tuple) and any(isinstance(e, ast.Slice) for e in target.slice.elts):
            load: Any = ast.parse(ast.unparse(target), mode="eval").body
            return self.value(load)
        return self.place(table, self.value(target.slice), target)

    def _filled_whole(self, table: Value, value: Value, node: ast.AST) -> None:
        """Write all items of an array."""
        assert isinstance(table.kind, Table)
        if isinstance(value.kind, Table):
            if value.kind.shape != table.kind.shape:
                raise self.unknown("an array of another shape", node)
            self.filled(table, f"{value.c}[i]")
        else:
            self.filled(table, self.named(self.coerced(value, table.kind.item)).c)

    def _if(self, node: ast.If) -> None:
        test = self.truth(self.value(node.test), node)
        if test in ("true", "false"):
            self.block(node.body if test == "true" else node.orelse)
            return
        self.fork(test, lambda: self.block(node.body), lambda: self.block(node.orelse))

    def fork(self, test: str, if_true: Callable[[], Any], if_false: Callable[[], Any]) -> None:
        """Write both branches of a test, and merge the values of names after them."""
        lines, before = self.lines, dict(self.env)
        branches = []
        for branch in (if_true, if_false):
            self.lines, self.env, self.ended = [], dict(before), False
            branch()
            branches.append((self.lines, self.env, self.ended))
        (then, env_then, over_then), (orelse, env_else, over_else) = branches
        if over_then or over_else:
            env = env_else if over_then else env_then
        else:
            env = self._joined(env_then, then, env_else, orelse)
        self.lines, self.env, self.ended = lines, env, over_then and over_else
        hint = _hint(test, then, orelse)
        self.emit(f"if ({f'{hint}({bare(test)})' if hint else bare(test)}) {{")
        self.lines += [f"    {line}" for line in then]
        if orelse:
            self.emit("} else {")
            self.lines += [f"    {line}" for line in orelse]
        self.emit("}")

    def _joined(
        self, env_then: dict[str, Value], then: list[str], env_else: dict[str, Value], orelse: list[str]
    ) -> dict[str, Value]:
        env: dict[str, Value] = {}
        for name in {**env_then, **env_else}:
            a, b = env_then.get(name), env_else.get(name)
            if a is None or b is None:
                # Python raises where a name without a value is read, and C would read a variable that is not set:
                # reading it is refused.
                env[name] = replace(env_then[name] if b is None else env_else[name], partly=True)
                continue
            if a == b:
                env[name] = a
                continue
            kind = united(a.kind, b.kind)
            if kind is None or isinstance(kind, Absent):
                continue  # a line that reads the name is refused
            c = self._variable(name, kind, "j")
            kind = self.kinds_of[c]
            for value, lines in ((a, then), (b, orelse)):
                self.lines = lines
                if value.c != c:
                    self.emit(f"{c} = {self.coerced(value, kind).c};")
            env[name] = Value(kind, c, partly=a.partly or b.partly)
        return env

    def _while(self, node: ast.While) -> None:
        def inside() -> None:
            test = self.truth(self.value(node.test), node)
            if test != "true":
                self.emit(f"if (!({test})) {{")
                self.emit("    break;")
                self.emit("}")
            self.block(node.body)

        self._loop("for (;;) {", inside, node)

    def _for(self, node: ast.For) -> None:
        call = node.iter
        if not (isinstance(call, ast.Call) and self.of_builtins(call.func) == "range"):
            self._each(node)
            return
        ends = [self.named(self.coerced(self.value(a), INT)) for a in call.args]
        first, last = (Value(INT, "INT64_C(0)"), ends[0]) if len(ends) == 1 else ends[:2]
        step = ends[2] if len(ends) == 3 else Value(INT, "INT64_C(1)")
        if len(ends) == 3 and not isinstance(call.args[2], (ast.Constant, ast.UnaryOp)):
            raise self.unknown("a loop whose step is computed", node)
        down = len(ends) == 3 and isinstance(call.args[2], ast.UnaryOp)
        assert isinstance(node.target, ast.Name)
        # A loop in another one may have the same name.
        counter = self._variable(node.target.id, INT, f"k{len(self.loops)}")
        # Python's name is apart from the counter: the body may bind it, and it keeps its last value after the loop.
        variable = self._variable(node.target.id, INT)
        head = f"for ({counter} = {first.c}; {counter} {'>' if down else '<'} {last.c}; {counter} += {step.c}) {{"

        def inside() -> None:
            self.emit(f"{variable} = {counter};")
            self.env[node.target.id] = Value(self.kinds_of[variable], variable)  # type: ignore[attr-defined]
            self.block(node.body)

        self._loop(head, inside, node)

    def _each(self, node: ast.For) -> None:
        """Write a loop over a tuple as one copy of its body for each part."""
        if any(isinstance(n, (ast.Break, ast.Continue)) for statement in node.body for n in ast.walk(statement)):
            raise self.unknown("a loop over a tuple that is left", node)
        for item in [self.named(v) for v in self.listed(node.iter)]:
            self.bind(node.target, item)
            self.block(node.body)
            if self.ended:
                return

    def _loop(self, head: str, inside: Callable[[], None], node: ast.stmt) -> None:
        """Write a loop. A name that it binds has one variable, which is up to date at the end of each turn."""
        stored = sorted({n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)})
        for name in stored:
            value = self.env.get(name)
            c = self._carried(name)
            if value is not None and not isinstance(value.kind, Absent):
                self._carry(name, value)
                self.env[name] = Value(self.kinds_of[c], c)
            # A name that is first bound in a turn: without a turn C would read a variable that is not set.
            elif value is None and c in self.kinds_of:
                kind = self.kinds_of[c]
                self.emit(f"{c} = {'0' if isinstance(kind, Number) else f'({self.unit.c(kind)}){{ 0 }}'};")
        lines, before = self.lines, dict(self.env)
        self.lines = []
        self.loops.append([(name, name in before) for name in stored])
        inside()
        if not self.ended:
            self._turn_over()
        self.loops.pop()
        inner, self.lines = self.lines, lines
        self.ended, self.env = False, before
        for name in stored:
            c = self._carried(name)
            if name not in before and c in self.kinds_of:
                self.env[name] = Value(self.kinds_of[c], c)
        self.emit(head)
        self.lines += [f"    {line}" for line in inner]
        self.emit("}")

    def _carry(self, name: str, value: Value) -> None:
        c = self._variable(name, value.kind, "l")
        if c != self._carried(name):
            raise self.unknown(f"{name} changes its type in a loop")
        if value.c != c:
            self.emit(f"{c} = {self.coerced(value, self.kinds_of[c]).c};")

    def _turn_over(self) -> None:
        """Update the variables of the innermost loop at the end of a turn."""
        for name, was_there in self.loops[-1]:
            value = self.env.get(name)
            if value is None or isinstance(value.kind, Absent):
                continue
            if was_there or united(self.kinds_of.get(self._carried(name)), value.kind) is not None:
                self._carry(name, value)

    def _break(self, node: ast.Break) -> None:
        self._turn_over()
        self.emit("break;")
        self.ended = True

    def _continue(self, node: ast.Continue) -> None:
        self._turn_over()
        self.emit("continue;")
        self.ended = True


def _argument(name: str) -> str:
    return used_as("p", name.removeprefix("v_"))


def _hint(test: str, then: Sequence[str], orelse: Sequence[str]) -> str:
    """Return C's hint for a test that has none: a branch that itself reports or discards is rarely taken."""
    rare = ["s->reported = true;" in branch or "s->discarded = true;" in branch for branch in (then, orelse)]
    return "" if test.startswith("SR_") or rare[0] is rare[1] else "SR_RARELY" if rare[0] else "SR_MOSTLY"
