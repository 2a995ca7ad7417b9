"""Mutants: small changes of the suite's code, each of a kind and at a place."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

KINDS = ("operator", "bound", "constant", "sign", "condition", "statement", "default", "argument")
_OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
              ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}  # fmt: skip
_BOUNDS = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_CONDITIONS = {ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot,
               ast.IsNot: ast.Is, ast.And: ast.Or, ast.Or: ast.And}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change: the text between two places of a file (line, column in bytes; lines from 1) becomes another."""

    kind: str
    start: tuple[int, int]
    end: tuple[int, int]
    text: str
    # The mutant counts as run if one of these lines was; empty if they run once a process or are not traced.
    runs: tuple[int, ...]

    def applied(self, source: str) -> str:
        """Return the file with the mutant."""
        lines = source.encode().splitlines(keepends=True)
        (first, a), (last, b) = self.start, self.end
        changed = lines[first - 1][:a] + self.text.encode() + lines[last - 1][b:]
        return b"".join([*lines[: first - 1], changed, *lines[last:]]).decode()

    def description(self, source: str) -> str:
        """Return a line that describes the change."""
        lines = source.encode().splitlines(keepends=True)
        (first, a), (last, b) = self.start, self.end
        chosen = lines[first - 1 : last]
        chosen[-1] = chosen[-1][:b]
        chosen[0] = chosen[0][a:]
        return f"{self.kind}: {' '.join(b''.join(chosen).decode().split())[:70]} -> {self.text[:70]}"


def mutants(source: str) -> Iterator[Mutant]:
    """All mutants of a module, except in annotations, documentation or messages."""
    yield from _within(ast.parse(source), ())


def _of(kind: str, node: ast.AST, new: ast.AST | str, runs: tuple[int, ...]) -> Mutant:
    text = new if isinstance(new, str) else f"({ast.unparse(new)})"
    return Mutant(kind, (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset), text, runs)


def _number(value: object) -> ast.Constant | None:
    if isinstance(value, bool):
        return ast.Constant(not value)
    if isinstance(value, int):
        return ast.Constant(value + 1)
    if isinstance(value, float):
        return ast.Constant(1.1 * value if value else 1.0)
    return None


def _within(node: ast.AST, runs: tuple[int, ...]) -> Iterator[Mutant]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr_context | ast.operator | ast.JoinedStr | ast.Import | ast.ImportFrom):
            continue
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            body = tuple(range(child.body[0].lineno, child.end_lineno + 1))
            for default in (*child.args.defaults, *child.args.kw_defaults):
                new = _number(default.value) if isinstance(default, ast.Constant) else None
                if new:
                    yield _of("default", default, new, body)
            unseen = any("jit" in ast.unparse(d) or "cache" in ast.unparse(d) for d in child.decorator_list)
            for statement in child.body:
                yield from _statement(statement, () if unseen else (statement.lineno,))
            continue
        if isinstance(child, ast.ClassDef):
            for statement in child.body:
                yield from _statement(statement, ())
            continue
        if isinstance(child, ast.stmt):
            yield from _statement(child, runs and (child.lineno,))
        else:
            yield from _expression(child, runs)


def _statement(node: ast.stmt, runs: tuple[int, ...]) -> Iterator[Mutant]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Import | ast.ImportFrom):
        yield from _within(ast.Module([node], []), runs)
        return
    if isinstance(node, ast.Raise):
        yield _of("statement", node, "pass", runs)
        return
    if isinstance(node, ast.Expr):
        if isinstance(node.value, ast.Constant):  # skip docstrings
            return
        yield _of("statement", node, "pass", runs)
    elif isinstance(node, ast.Continue | ast.AugAssign | ast.Delete) or (
        isinstance(node, ast.Assign) and not any(isinstance(t, ast.Name | ast.Tuple) for t in node.targets)
    ):
        yield _of("statement", node, "pass", runs)
    if isinstance(node, ast.If | ast.While):
        if ast.unparse(node.test) == "TYPE_CHECKING":
            return
        yield _of("condition", node.test, ast.UnaryOp(ast.Not(), node.test), runs)
    if isinstance(node, ast.AugAssign) and type(node.op) in _OPERATORS:
        new = ast.AugAssign(node.target, _OPERATORS[type(node.op)](), node.value)
        yield _of("operator", node, ast.unparse(new), runs)
    if isinstance(node, ast.AnnAssign):
        if node.value is not None:
            yield from _expression(node.value, runs)
        return
    yield from _within(node, runs)


def _expression(node: ast.AST, runs: tuple[int, ...]) -> Iterator[Mutant]:
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS and not _words(node):
        yield _of("operator", node, ast.BinOp(node.left, _OPERATORS[type(node.op)](), node.right), runs)
    if isinstance(node, ast.Compare):
        for table, kind in ((_BOUNDS, "bound"), (_CONDITIONS, "condition")):
            if type(node.ops[0]) in table:
                new = ast.Compare(node.left, [table[type(node.ops[0])](), *node.ops[1:]], node.comparators)
                yield _of(kind, node, new, runs)
    if isinstance(node, ast.BoolOp):
        yield _of("condition", node, ast.BoolOp(_CONDITIONS[type(node.op)](), node.values), runs)
    if isinstance(node, ast.IfExp):
        yield _of("condition", node.test, ast.UnaryOp(ast.Not(), node.test), runs)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield _of("sign", node, node.operand, runs)
    if isinstance(node, ast.Constant) and (new := _number(node.value)):
        yield _of("constant", node, new, runs)
    if isinstance(node, ast.Call):
        first = node.args[0] if node.args else None
        # The default of a parameter; its other arguments are texts.
        if isinstance(node.func, ast.Name) and node.func.id == "param":
            if isinstance(first, ast.Constant) and (new := _number(first.value)):
                yield _of("default", first, new, runs)
            node = ast.Call(node.func, node.args[1:], node.keywords)
        elif len(node.args) > 1 and not (getattr(node.func, "attr", "") == "add_argument" or _starred(node)):
            new = ast.Call(node.func, [node.args[1], node.args[0], *node.args[2:]], node.keywords)
            if ast.unparse(new) != ast.unparse(node):
                yield _of("argument", node, new, runs)
        elif node.keywords and node.keywords[-1].arg not in (None, "help", "metavar"):
            # Skip texts of the command line's help.
            yield _of("argument", node, ast.Call(node.func, node.args, node.keywords[:-1]), runs)
    yield from _within(node, runs)


def _starred(node: ast.Call) -> bool:
    return any(isinstance(a, ast.Starred) for a in node.args[:2])


def _words(node: ast.BinOp) -> bool:
    return any(
        isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in ast.walk(node)
    )
