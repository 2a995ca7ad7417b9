"""The part of OMG IDL that ROS 2 generates and accepts for messages: modules, structs, typedefs, enums, constants.

The library's grammar is complete but takes half a second for a file; a bag may have dozens.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from rosbags.interfaces import Nodetype

_TOKEN = re.compile(
    r"\s+|//[^\n]*|/\*.*?\*/|^[ \t]*\#[^\n]*"  # comments and directives of the preprocessor, which the reader skips
    r'|(?P<token>"(?:\\.|[^"\\])*"|\'(?:\\.|[^\'\\])+\'|::|[A-Za-z_]\w*|[-+]?(?:\d|\.\d)[\w.]*(?:(?<=[eE])[-+]\d+)?|.)',
    re.DOTALL | re.MULTILINE,
)
_WORDS = {"unsigned", "long", "short", "double", "float"}
_BASE = {
    "short": "int16", "long": "int32", "long long": "int64", "unsigned short": "uint16", "unsigned long": "uint32",
    "unsigned long long": "uint64", "float": "float32", "double": "float64", "long double": "float128",
    "boolean": "bool", "octet": "byte", "char": "char", "wchar": "wchar", "string": "string", "wstring": "wstring",
    **{name: name for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")},
}  # fmt: skip


class IdlError(ValueError):
    """A text is outside the supported subset of IDL; the message names the place."""


class IdlReader:
    """Reads a text; `structs` has the fields of each by its whole name, ``package/msg/Type``."""

    def __init__(self, text: str) -> None:
        self._tokens = [m["token"] for m in _TOKEN.finditer(text) if m["token"]]
        self._at = 0
        self._constants: dict[str, int] = {}
        self._aliases: dict[str, Any] = {}
        self.structs: dict[str, list[tuple[str, Any]]] = {}
        while self._at < len(self._tokens):
            self._definition("")

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _next(self) -> str:
        token = self._peek()
        if not token:
            raise IdlError("the text ends within a definition")
        self._at += 1
        return token

    def _want(self, wanted: str) -> None:
        if (token := self._next()) != wanted:
            before = " ".join(self._tokens[max(self._at - 5, 0) : self._at - 1])
            raise IdlError(f"{token!r} after {before!r}, expected {wanted!r}")

    def _accept(self, wanted: str) -> bool:
        result = self._peek() == wanted
        self._at += result
        return result

    def _annotations(self) -> None:
        while self._accept("@"):
            self._scoped()
            if self._accept("("):
                depth = 1
                while depth:
                    token = self._next()
                    depth += (token == "(") - (token == ")")

    def _definition(self, scope: str) -> None:
        self._annotations()
        kind = self._next()
        read: Callable[[str], None] | None = {
            "module": self._module,
            "struct": self._struct,
            "typedef": self._typedef,
            "const": self._const,
            "enum": self._enum,
        }.get(kind)
        if read is None:
            raise IdlError(f"{kind!r}, expected module, struct, typedef, const or enum")
        read(scope)
        self._accept(";")

    def _module(self, scope: str) -> None:
        name = self._next()
        self._want("{")
        while not self._accept("}"):
            self._definition(f"{scope}{name}/")

    def _struct(self, scope: str) -> None:
        name = self._next()
        if self._peek() == ";":  # a forward declaration has no fields
            return
        self._want("{")
        fields: list[tuple[str, Any]] = []
        while not self._accept("}"):
            self._annotations()
            fields += self._declared(scope)
            self._want(";")
        self.structs[scope + name] = fields

    def _typedef(self, scope: str) -> None:
        self._aliases |= {scope + name: kind for name, kind in self._declared(scope)}

    def _enum(self, scope: str) -> None:
        self._aliases[scope + self._next()] = Nodetype.BASE, ("uint32", 0)
        while self._next() != "}":
            pass

    def _const(self, scope: str) -> None:
        self._type(scope)
        name = self._next()
        self._want("=")
        value = self._next()
        if re.fullmatch(r"\d+|0[xX][0-9a-fA-F]+", value):
            self._constants[name] = int(value, 0 if value[:2].lower() == "0x" else 10)
        while self._peek() not in (";", ""):
            self._next()

    def _declared(self, scope: str) -> list[tuple[str, Any]]:
        """Read a type and the names declared with it, which may be arrays."""
        kind, result = self._type(scope), []
        while True:
            name, sizes = self._next(), []
            while self._accept("["):
                sizes.append(self._number())
                self._want("]")
            declared = kind
            for size in reversed(sizes):
                declared = Nodetype.ARRAY, (declared, size)
            result.append((name, declared))
            if not self._accept(","):
                return result

    def _type(self, scope: str) -> Any:
        if self._accept("sequence"):
            self._want("<")
            kind = self._type(scope)
            bound = self._number() if self._accept(",") else 0
            self._want(">")
            return Nodetype.SEQUENCE, (kind, bound)
        words = [self._scoped()]
        while words[0] in _WORDS and self._peek() in _WORDS:
            words.append(self._next())
        name = " ".join(words)
        if name not in _BASE:
            return self._named(name, scope)
        bound = 0
        if name in ("string", "wstring") and self._accept("<"):
            bound = self._number()
            self._want(">")
        return Nodetype.BASE, (_BASE[name], bound)

    def _named(self, name: str, scope: str) -> Any:
        while True:  # search from this scope outwards
            if scope + name in self._aliases:
                return self._aliases[scope + name]
            if scope + name in self.structs:
                return Nodetype.NAME, scope + name
            if not scope:
                return Nodetype.NAME, name
            scope = scope[:-1].rpartition("/")[0] + "/" if "/" in scope[:-1] else ""

    def _scoped(self) -> str:
        self._accept("::")
        name = self._next()
        while self._accept("::"):
            name += "/" + self._next()
        return name

    def _number(self) -> int:
        token = self._scoped().rpartition("/")[2]
        if token.isdecimal():
            return int(token)
        if token not in self._constants:
            raise IdlError(f"{token!r}, expected a number")
        return self._constants[token]
