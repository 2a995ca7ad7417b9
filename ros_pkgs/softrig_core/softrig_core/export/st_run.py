"""Run structured text: an interpreter of the text that `st` prints, which compares it with golden rows without a PLC.

It reads only the printed text, line by line, independently of the C and the Python that the text was made from.
"""

from __future__ import annotations

import ast
import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from typing import Any

_NAMES = {"AND": "and", "OR": "or", "NOT": "not", "TRUE": "True", "FALSE": "False", "MOD": "%", "XOR": "^"}
_ZERO = {"LREAL": 0.0, "BOOL": False, "LINT": 0, "DINT": 0, "UDINT": 0, "USINT": 0}


class Struct:
    """A value of a struct type: assigned by value."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def copy(self) -> Struct:
        """Return another one with the same values."""
        return Struct(**{name: copied(value) for name, value in self.__dict__.items()})


class Pointer:
    """Reference to an array: an assignment copies the reference, not the array."""

    def __init__(self, array: list[Any] | None = None) -> None:
        self.array = array

    def __getitem__(self, k: int) -> Any:
        if self.array is None or not 0 <= k < len(self.array):
            raise IndexError(f"place {k} of an array")
        return self.array[k]

    def __setitem__(self, k: int, value: Any) -> None:
        self[k]
        assert self.array is not None
        self.array[k] = value


def copied(value: Any) -> Any:
    """Return a value as an assignment copies it."""
    if isinstance(value, Struct):
        return value.copy()
    return [copied(v) for v in value] if isinstance(value, list) else value


def pointer(value: Any) -> Pointer:
    """Return the reference to an array, or the bits of a number."""
    if isinstance(value, float):
        return Pointer(list(struct.unpack("q", struct.pack("d", value))))
    return value if isinstance(value, Pointer) else Pointer(value)


def quotient(a: Any, b: Any) -> Any:
    """Divide: whole numbers towards zero, others by IEEE 754."""
    if isinstance(a, int) and isinstance(b, int):
        result = abs(a) // abs(b)
        return result if (a < 0) == (b < 0) else -result
    if b == 0.0:
        return math.nan if a == 0.0 or a != a else math.copysign(math.inf, a) * math.copysign(1.0, b)
    return a / b


def remainder(a: int, b: int) -> int:
    """Return the remainder of an integer division, with the sign of the dividend."""
    return int(a - b * quotient(a, b))


def _quiet(function: Callable[..., float]) -> Callable[..., float]:
    def quiet(*values: float) -> float:
        try:
            return function(*values)
        except (ValueError, OverflowError):
            return math.nan

    return quiet


FUNCTIONS: Mapping[str, Any] = {
    **{f.upper(): _quiet(getattr(math, f)) for f in ("sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "exp")},
    "ABS": abs, "LN": _quiet(math.log), "LOG": _quiet(math.log10), "EXPT": _quiet(math.pow), "LINT_TO_LREAL": float,
    "LREAL_TO_LINT": lambda x: round(x) if math.isfinite(x) and abs(x) < 9.2e18 else -(1 << 63),
    "BOOL_TO_LREAL": float, "BOOL_TO_LINT": int, "UDINT_TO_LINT": int, "DINT_TO_LINT": int, "ADR": pointer,
    "quotient": quotient, "remainder": remainder, "copied": copied,
}  # fmt: skip


class Program:
    """A text of structured text: its types, functions and one function block.

    Parameters
    ----------
    text : str
        As `st` prints it.
    """

    def __init__(self, text: str) -> None:
        self.types: dict[str, list[tuple[str, str]]] = {}
        self.scope: dict[str, Any] = dict(FUNCTIONS)
        self.scope["new"] = self.new
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
        for name, inner in re.findall(r"TYPE (\w+) :\nSTRUCT\n(.*?)END_STRUCT", text, re.DOTALL):
            self.types[name] = re.findall(r"(\w+) : (.*?);", inner)
        for kind, name, result, body in re.findall(
            r"^(FUNCTION|FUNCTION_BLOCK) (\w+)(?: : ([^\n]*))?\n(.*?)^END_\1$", text, re.DOTALL | re.MULTILINE
        ):
            self._function(kind, name, result, body.splitlines())

    def new(self, kind: str) -> Any:
        """Return the first value of a type."""
        kind = kind.strip()
        if kind.startswith("POINTER"):
            return Pointer()
        if match := re.fullmatch(r"ARRAY \[0\.\.(\d+)\] OF (.*)", kind):
            return [self.new(match[2]) for _ in range(int(match[1]) + 1)]
        if kind in self.types:
            return Struct(**{name: self.new(inner) for name, inner in self.types[kind]})
        return _ZERO[kind]

    def block(self) -> Struct:
        """Return an instance of the function block: its variables, before its first call."""
        return Struct(**{name: self.value(first, kind) for name, kind, first in self.variables})

    def value(self, first: str, kind: str) -> Any:
        """Return the value with which a variable begins."""
        return eval(_expression(first), dict(self.scope)) if first else self.new(kind)

    def call(self, instance: Struct) -> None:
        """Call the function block once."""
        self.scope["BLOCK"](instance)

    def _function(self, kind: str, name: str, result: str, lines: Iterable[str]) -> None:
        variables: list[tuple[str, str, str, str]] = []
        section, body = "", list[str]()
        for line in map(str.rstrip, lines):
            if re.fullmatch(r"VAR(_\w+)?", line):
                section = line
            elif line == "END_VAR":
                section = ""
            elif section:
                match = re.fullmatch(r"\s*(\w+) : (.*?)(?: := (.*))?;", line)
                if match is None:
                    raise ValueError(f"{name}: {line!r} is not a declaration")
                variables.append((section, match[1], match[2], match[3] or ""))
            elif line.strip():
                body.append(line.strip())
        block = kind == "FUNCTION_BLOCK"
        members = {v[1] for v in variables} if block else set()
        code = [f"def {'BLOCK' if block else name}({'me' if block else '**given'}):"]
        if block:
            self.variables = [(v, t, first) for _, v, t, first in variables]
        else:
            for section, v, t, first in variables:
                if section == "VAR":
                    code.append(f"    {v} = {_expression(first) if first else f'new({t!r})'}")
                else:
                    by_value = section != "VAR_IN_OUT"
                    code.append(f"    {v} = {f'copied(given[{v!r}])' if by_value else f'given[{v!r}]'}")
            code.append(f"    {name} = new({result!r})")
        depth = 1
        for line in body:
            depth = _line(line, code, depth, members, "" if block else name)
        if not block:
            code.append(f"    return {name}")
        text = "\n".join(code)
        exec(compile(text, f"<structured text of {name}>", "exec"), self.scope)
        if not block:
            function, positional = self.scope[name], [v for s, v, _, _ in variables if s == "VAR_INPUT"]
            self.scope[name] = _by_place(function, positional)


def _by_place(function: Any, names: list[str]) -> Any:
    return lambda *args, **kwargs: function(**dict(zip(names, args, strict=False)), **kwargs)


def _line(line: str, code: list[str], depth: int, members: set[str], name: str) -> int:
    """Translate one line; return the indentation depth of the next one."""
    pad = "    " * depth
    if match := re.fullmatch(r"(IF|ELSIF) (.*) THEN", line):
        pad = pad if match[1] == "IF" else pad[4:]
        code.append(f"{pad}{'if' if match[1] == 'IF' else 'elif'} {_expression(match[2], members)}:")
        return depth + (match[1] == "IF")
    if line == "ELSE":
        code.append(f"{pad[4:]}else:")
        return depth
    if match := re.fullmatch(r"WHILE (.*) DO", line):
        code.append(f"{pad}while {_expression(match[1], members)}:")
        return depth + 1
    if line.rstrip(";") in ("END_IF", "END_WHILE"):
        return depth - 1
    if line == ";":
        code.append(f"{pad}pass")
        return depth
    statements = {"EXIT;": "break", "CONTINUE;": "continue", "RETURN;": f"return {name}"}
    if line in statements:
        code.append(f"{pad}{statements[line]}")
        return depth
    if not line.endswith(";"):
        raise ValueError(f"{line!r} is not a statement")
    target, assigned, value = line[:-1].partition(" := ")
    if assigned and re.fullmatch(r"[\w.\[\]() +*-]+", target) and "(" not in target.partition("[")[0]:
        code.append(f"{pad}{_expression(target, members)} = copied({_expression(value, members)})")
    else:
        code.append(f"{pad}{_expression(line[:-1], members)}")
    return depth


class _Changes(ast.NodeTransformer):
    def __init__(self, members: set[str]) -> None:
        self.own = members

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        word = {ast.Div: "quotient", ast.Mod: "remainder"}.get(type(node.op))
        return node if word is None else ast.Call(ast.Name(word, ast.Load()), [node.left, node.right], [])

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return ast.Attribute(ast.Name("me", ast.Load()), node.id, node.ctx) if node.id in self.own else node


def _expression(text: str, members: set[str] | None = None) -> str:
    """Return an expression in Python."""
    text = text.replace(":=", "\0").replace("<>", "!=")
    text = re.sub(r"(?<![<>!=])=(?!=)", "==", text).replace("\0", "=")
    text = re.sub(r"\b[A-Z]+\b", lambda match: _NAMES.get(match[0], match[0]), text)
    tree = ast.fix_missing_locations(_Changes(members or set()).visit(ast.parse(text.strip(), mode="eval")))
    return ast.unparse(tree)
