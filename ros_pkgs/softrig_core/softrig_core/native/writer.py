"""The text of one function: its statements, read with what is known about its names."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ..block.port import Sample
from .calls import Calls
from .translate import (
    GIVEN_UP,
    NUMBERS,
)
from .value import (
    NONE,
    UNKNOWN,
    Dynamic,
    GivesUp,
    Group,
    NotNative,
    Record,
    Static,
    Value,
    forms,
    is_sure,
    sample_of,
)
from .ways import alike


class Writer(Calls):
    """Writes a function of Python as one of native code; see `Ways`."""

    def body(self, statements: Sequence[ast.stmt]) -> list[str]:
        """Write the body of the function."""
        self.run(statements)
        if not self.ended:
            self._return(NONE)
        return self.lines

    def result(self) -> Value:
        """Return the result of the function; a fixed value if it has no other."""
        result = self.returned
        if len(self.lines) == 1 and len(result) == 1 and isinstance(result[0], Static):
            return result[0]
        values = [self.dynamic(v) for v in result]
        first = values[0]
        for value in values[1:]:
            if (value.keys, forms(value)) != (first.keys, forms(first)):
                raise self.unknown("answers of several forms")
        known = [v for v in values if v.sample is not UNKNOWN]
        sure = len(known) == len(values) and all(is_sure(v) and alike(v.sample, first.sample) for v in values)
        return Dynamic("", known[0].sample if known else UNKNOWN, sure, first.keys, first.parts)

    def run(self, statements: Sequence[ast.stmt]) -> None:
        """Write statements up to the first that ends the function; those that always report may discard the tick."""
        aside = self.program.aside
        try:
            self._run(statements)
        finally:
            self.program.aside = aside

    def _run(self, statements: Sequence[ast.stmt]) -> None:
        left: tuple[int, int] | None = None  # where the samples' branch has left, as far as is known
        for k, statement in enumerate(statements):
            if self.ended:
                return
            if _reporting(statements[k:]):
                self._reporting(statements[k:])
                return
            try:
                self._one(statement)
            except NotNative as reason:
                if left is None:
                    raise
                self.program.seldom.append(str(reason))
                del self.lines[left[0] :], self.returned[left[1] :]
                self._give_up()
            # The usual tick has left the function or the loop in this `if`. What follows runs rarely, so a construct
            # there that is not supported discards its tick and does not keep the block from being native.
            if isinstance(statement, ast.If) and self.left and left is None:
                left = len(self.lines), len(self.returned)
                self.program.aside = True

    def _one(self, statement: ast.stmt) -> None:
        try:
            self.statement(statement)
        except GivesUp:
            self._give_up()

    def _reporting(self, statements: Sequence[ast.stmt]) -> None:
        """Write statements that report; if native code does not support them, they discard the tick immediately."""
        env, lines = dict(self.env), list(self.lines)
        try:
            if self.program.reports is None:
                raise self.unknown("a report", statements[0])
            for statement in statements:
                if not self.ended:
                    self._one(statement)
        except NotNative as reason:
            self.program.seldom.append(str(reason))
            self.env, self.lines[:] = env, lines
            self._give_up()

    def statement(self, node: ast.stmt) -> None:
        """Write one statement."""
        method = getattr(self, f"_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.unknown(f"{type(node).__name__.lower()}", node)
        method(node)

    def _pass(self, node: ast.Pass) -> None:
        pass

    def _expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        call = node.value
        if (
            isinstance(call, ast.Call)
            and isinstance(call.func, ast.Attribute)
            and call.func.attr == "append"
            and (isinstance(call.func.value, ast.Name) and call.func.value.id in self.env)
        ):
            # A list becomes a tuple, so one with one more item has another type.
            self._check_own_list(call.func.value.id, node)
            before = self.parts(self.env[call.func.value.id], node)
            self.assign(
                ast.Name(call.func.value.id, ast.Store()),
                Group((*(self._held(v) for v in before), self.value(call.args[0]))),
            )
            return
        result = self.value(node.value)
        if isinstance(result, Dynamic) and not self.ended:
            self.emit(result.code)

    def _check_own_list(self, name: str, node: ast.AST) -> None:
        """Refuse to add to a list that has another name: that one would not grow with it."""
        if not self.has_one_name(name):
            raise self.unknown(f"{name} may be a list with another name, which grows with it", node)

    def _raise(self, node: ast.Raise) -> None:
        self._give_up()

    def _assert(self, node: ast.Assert) -> None:
        test = self.test(node.test)
        if test is False:
            self._give_up()
        elif test is not True:
            self.emit(f"if not ({test}):")
            self.emit(f"    {GIVEN_UP}")

    def _return(self, node: ast.Return | Static) -> None:
        value = node if isinstance(node, Static) else NONE if node.value is None else self.value(node.value)
        if self.ended:
            return
        value = self._with_silence(value, node)
        self.returned.append(value)
        keep = isinstance(value, Static) and not self.lines
        try:
            self.emit(f"return {self.code(value)}")
        except NotNative:
            if not keep:
                raise
            # An object has no text; the caller knows it without a call.
            self.emit("return None")
        self.ended = True

    def _with_silence(self, value: Value, node: Any) -> Value:
        """Return the answer of a block with a flag before the row of each output that may be silent."""
        block = self.env.get("self")
        if not isinstance(block, Static) or block.path is None or len(block.path) > 1 or not self.program.silent:
            return value
        answers = [getattr(type(block.value), name, None) for name in ("update", "outputs")]
        ports = [port for k, port in self.program.silent if k == block.path[0]]
        if self.function not in answers or not ports:
            return value
        x, record = self.parts(value, node) if self.function is answers[0] else (None, value)
        if isinstance(record, Static) and not record.value:
            record = Record({})
        if not isinstance(record, Record):
            raise self.unknown("an answer that is not written out")
        rows: dict[str, Value] = dict(record.items)
        for port in ports:
            row = rows.get(port.name, NONE)
            silent = isinstance(row, Static) and row.value is None
            # numba needs one type for all answers, so a silent output has zeros behind a flag of 0.
            if silent:
                row = Static((0.0,) * (port.size if self.program.inferred else port.width))
                row = self.named(Sample, [Static(0), row], node) if port.delayed else row
            elif port.width < port.size and not self.program.inferred:
                raise self.unknown(f"{port.size} numbers that are rarely published", node)
            rows[port.name] = Group((Static(0.0 if silent else 1.0), row))
        return Record(rows) if x is None else Group((x, Record(rows)))

    def _annassign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.assign(node.target, self.value(node.value))

    def _assign(self, node: ast.Assign) -> None:
        value = self.value(node.value)
        if self.ended:
            return
        # Python computes the value once for all targets.
        if len(node.targets) > 1 and isinstance(value, Dynamic):
            value = self.simple(value)
        for target in node.targets:
            self.assign(target, value)

    def _augassign(self, node: ast.AugAssign) -> None:
        if not isinstance(node.target, ast.Name):
            raise self.unknown("an assignment to a part of something", node)
        left = self.value(ast.Name(node.target.id, ast.Load()))
        if isinstance(sample_of(left), (list, tuple)) and isinstance(node.op, ast.Add):
            self._check_own_list(node.target.id, node)
        self.assign(node.target, self.binary(node.op, left, self.value(node.value), node))

    def _if(self, node: ast.If) -> None:
        self.left = False
        test = self.test(node.test)
        if self.ended:
            return
        if isinstance(test, bool):
            self.run(node.body if test else node.orelse)
            self.left = False
            return
        used = self.sampled
        self._fork(test, used, lambda: self.run(node.body), lambda: self.run(node.orelse))

    def _while(self, node: ast.While) -> None:
        if node.orelse:
            raise self.unknown("else of a loop", node)
        # The statements that a test needs have to run at each turn, so the test is written into the loop.
        self._loop("while True:", node.body, node, node.test)

    def _for(self, node: ast.For) -> None:
        if node.orelse:
            raise self.unknown("else of a loop", node)
        # A loop that is written out turn after turn has no place to which a break or continue could jump.
        leaves = any(isinstance(n, (ast.Break, ast.Continue)) for statement in node.body for n in ast.walk(statement))
        values = None if leaves else self.listed(node.iter)
        if values is not None:
            for value in [self._held(v) for v in values]:
                self.assign(node.target, value)
                self.run(node.body)
                if self.ended:
                    return
            return
        turns = self._range(node.iter)
        if turns is None or not isinstance(node.target, ast.Name):
            raise self.unknown("a loop over something of no fixed length", node)
        known, name = self.env.get(node.target.id), f"v_{node.target.id}"
        # If there is no turn, the name keeps its value.
        if known is not None and (result := self.dynamic(known)).code != name:
            self.emit(f"{name} = {result.code}")
        self.env[node.target.id] = Dynamic(name, 0)
        self._loop(f"for {name} in range({turns}):", node.body, node)

    def _range(self, node: ast.expr) -> str | None:
        if isinstance(node, ast.Call) and self.of_builtins(node.func) == "range":
            return ", ".join(self.code(self.value(a)) for a in node.args)
        return None

    def _loop(self, head: str, body: Sequence[ast.stmt], node: ast.stmt, test: ast.expr | None = None) -> None:
        names = {
            n.id
            for statement in [*body, node]
            for n in ast.walk(statement)
            if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        }
        leaves = any(isinstance(n, (ast.Break, ast.Continue)) for statement in body for n in ast.walk(statement))
        assumed: dict[str, Any] = {}  # tuples that are as long after a turn as before it
        for name in names:
            was_sure = (known := self.env.get(name)) is not None and is_sure(known)
            if known is not None and not (isinstance(known, Dynamic) and known.code == f"v_{name}"):
                try:
                    result = self.dynamic(known)
                except NotNative:
                    continue
                self.emit(f"v_{name} = {result.code}")
                known = replace(result, code=f"v_{name}", sure=False)
            if isinstance(known, Dynamic):
                # What a name is at `break` or `continue` is not compared, so with them the length of a tuple is not
                # certain.
                fixed = isinstance(known.sample, tuple) and was_sure and not leaves
                if fixed:
                    assumed[name] = known.sample
                numbers = isinstance(known.sample, NUMBERS)
                self.env[name] = replace(known, sure=numbers or fixed)
        before, lines = dict(self.env), self.lines
        self.lines, self._inside = [], self._inside + 1
        if test is not None:
            code = self.test(test)
            if code is not True:
                self.emit(f"if not ({code}):")
                self.emit("    break")
        self.run(body)
        inner, self.lines = self.lines, lines
        self._inside -= 1
        after, self.env, self.ended = self.env, before, False
        for name, value in after.items():
            if name in before:
                if name in names and not (isinstance(value, Dynamic) and value.code == f"v_{name}"):
                    # The body is written once for all turns, so a name must be of one type in each of them.
                    raise self.unknown(f"{name} changes what it is in a loop", node)
                if name in assumed and not (is_sure(value) and alike(sample_of(value), assumed[name])):
                    raise self.unknown(f"{name} changes what it is in a loop", node)
            elif isinstance(value, Dynamic):
                # The loop may have no turn, and the name then no value.
                self.env[name] = replace(value, sure=False)
        self.emit(head)
        self.lines += [f"    {line}" for line in inner or ["pass"]]

    def _break(self, node: ast.Break | ast.Continue) -> None:
        self.emit(type(node).__name__.lower())
        self.ended = True

    _continue = _break


def _reports(node: ast.stmt) -> bool:
    call = node.value if isinstance(node, ast.Expr) else None
    return isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "report"


def _reporting(statements: Sequence[ast.stmt]) -> bool:
    """Return whether something is reported, whatever the earlier statements do."""
    for statement in statements:
        if _reports(statement):
            return True
        if any(isinstance(n, (ast.Return, ast.Break, ast.Continue)) for n in ast.walk(statement)):
            return False
    return False
