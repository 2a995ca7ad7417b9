"""Structured text (IEC 61131-3, as CODESYS and TwinCAT have it) from the C of a block.

The C that is printed for a block is read again as a tree, and each declaration and statement of it becomes one of
structured text: an expression of C without a counterpart (a struct made of its parts, a choice) becomes named
statements.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

from ..extras import need
from ..native.value import NotNative
from ..rig.members import Member
from .kinds import identifier, remark
from .unit import reached

need("pycparser", "structured text")
from pycparser import c_ast, c_parser  # noqa: E402

TYPES = {"real_t": "LREAL", "double": "LREAL", "int64_t": "LINT", "bool": "BOOL", "_Bool": "BOOL", "uint8_t": "USINT",
         "uint32_t": "UDINT", "unsigned": "UDINT", "unsigned int": "UDINT", "int": "DINT"}  # fmt: skip
HEAD = """typedef double real_t; typedef long int64_t; typedef _Bool bool; typedef unsigned char uint8_t;
typedef unsigned uint32_t;
"""
OPERATORS = {"==": "=", "!=": "<>", "&&": "AND", "||": "OR", "%": "MOD"}
COMPARE = ("==", "!=", "<", "<=", ">", ">=")
MATH = {"sqrt": "SQRT", "sin": "SIN", "cos": "COS", "tan": "TAN", "asin": "ASIN", "acos": "ACOS", "atan": "ATAN",
        "exp": "EXP", "log": "LN", "log10": "LOG", "pow": "EXPT", "fabs": "ABS"}  # fmt: skip
OWN = {"floor": "SR_FLOOR", "ceil": "SR_CEIL", "trunc": "SR_TRUNC", "rint": "SR_RINT", "fmod": "SR_FMOD",
       "copysign": "SR_COPYSIGN", "atan2": "SR_ATAN2", "hypot": "SR_HYPOT"}  # fmt: skip
CONVERSIONS = {("LINT", "LREAL"), ("BOOL", "LREAL"), ("BOOL", "LINT"), ("UDINT", "LINT"), ("DINT", "LINT")}
_WORDS = """
abs abstract action and array at begin bool by byte case configuration constant continue date dint do dword else elsif
end exit extends false final for function ge gt if implements in int interface internal le len limit lint lreal lt lword
max method min mod move mul mux ne not of on or out override pi pointer private program property protected public
r_edge f_edge real ref reference repeat resource retain return sel sint step string struct sub super task then this time
to transition true type udint uint ulint until usint var while with word wstring xor ramp integral derivative pid s r n
l d p q t eq add div exp ln log sin cos tan asin acos atan sqrt trunc expt adr sizeof new delete
"""
KEYWORDS = frozenset(_WORDS.split())


@dataclass
class Unit:
    """Declaration in structured text: a struct, a function, or the function block."""

    kind: str
    name: str
    head: list[str]  # declarations
    body: list[str] = field(default_factory=list)
    fields: list[tuple[str, str]] = field(default_factory=list)  # names and types of the members of a struct
    result: str = ""

    def text(self) -> str:
        """Return the declaration as structured text."""
        if self.kind == "TYPE":
            inner = "".join(f"    {n} : {t};\n" for n, t in self.fields)
            return f"TYPE {self.name} :\nSTRUCT\n{inner}END_STRUCT;\nEND_TYPE\n"
        colon = f" : {self.result}" if self.result else ""
        return "\n".join([f"{self.kind} {self.name}{colon}", *self.head, *self.body, f"END_{self.kind}", ""])


@dataclass(frozen=True)
class Typed:
    """An expression and its type, a name of structured text or a tuple (element, size) or ("POINTER", element)."""

    text: str
    type: Any


def structured_text(name: str, header: str, source: str, support: str, member: Member) -> list[Unit]:
    """Return a block in structured text, ordered so that each part is declared before its use.

    Parameters
    ----------
    name : str
        Prefix of all names in C.
    header, source, support : str
        The text of its files.
    member : Member
        The node; its ports become inputs and outputs of the function block.

    Raises
    ------
    NotNative
        Part of it has no structured text.
    """
    if f"int {name}_step(" not in source:
        raise NotNative("structured text is for controllers; this is a plant")
    if "sr_draw" in source:
        raise NotNative("random numbers have no structured text: whole numbers of 128 bits")
    if f"{name}_casadi" in source:
        raise NotNative("CasADi's C has no structured text")
    text = HEAD + _plain(support) + _plain(header) + _plain(source)
    params = re.findall(rf"#define {name.upper()}_PARAMS {{ (.*) }}", header)[0]
    titles = {fn: title for title, fn in re.findall(r"^/\* (.*) \*/\nstatic inline .*?(\w+)\(", source, re.MULTILINE)}
    printer = _Printer(name, c_parser.CParser().parse(text), titles)
    units = printer.units()
    return [*units, printer.block_of(member, _numbers(params))]


def _numbers(text: str) -> list[str]:
    """Return the numbers of an initialiser of C in structured text."""
    plain = re.sub(r"\b(?:SR_REAL|INT64_C)\(([^()]*)\)", r"\1", _plain(text))
    words = [number.strip().strip("()") for number in plain.split(",")]
    return [{"true": "TRUE", "false": "FALSE"}.get(number, number) for number in words]


def _plain(text: str) -> str:
    """Return C without comments and directives."""
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    # pycparser has no preprocessor: constants are put in place of their names before the directives are removed.
    for name, value in re.findall(r"^#define (\w+_K_\w+) (.*?) *$", text, re.MULTILINE):
        text = re.sub(rf"\b{name}\b(?! S)", value, text)
    text = re.sub(r"#ifdef __cplusplus.*?#endif", "", text, flags=re.DOTALL)
    text = re.sub(r"^#.*$", "", text, flags=re.MULTILINE)
    text = text.replace("static SR_TABLE", "static const")
    text = re.sub(r"\bSR_(?:RARELY|MOSTLY)\(", "(", text)  # hints for a compiler of C
    text = re.sub(r"(?<![\w.])(\d+)(?=e[+-]?\d)", r"\1.0", text)  # 1e-09 is no number of IEC 61131-3
    return re.sub(r"\bNULL\b", "0", text)


class _Printer:
    def __init__(self, name: str, tree: Any, titles: Mapping[str, str]) -> None:
        self.name, self.tree, self.titles = name, tree, titles
        self.structs: dict[str, dict[str, Any]] = {}
        self.functions: dict[str, tuple[Any, list[tuple[str, Any, bool]]]] = {}
        self.tables: dict[str, tuple[Any, str]] = {}
        self.known: dict[str, str] = {}
        self.used_names: set[str] = set(KEYWORDS)
        self.done: list[Unit] = []
        self.lines: list[str] = []
        self.vars: dict[str, Any] = {}
        self.depth = 0
        self.count = 0
        self.result: Any = None
        self.increments: list[str] = []
        self.own = ""
        self.newest: dict[str, str] = {}  # newest name of each variable of C

    # names and types ----------------------------------------------------------------------------------------------

    def word(self, c: str) -> str:
        """Return the name in structured text, which ignores case and does not allow double underscores."""
        if c not in self.known:
            plain = re.sub(r"_+", "_", c).strip("_") or "x"
            text, k = plain, 2
            while text.lower() in self.used_names:
                text, k = f"{plain}_{k}", k + 1
            self.used_names.add(text.lower())
            self.known[c] = text
        return self.known[c]

    def type_of(self, node: Any) -> Any:
        """Return a type of a declaration."""
        if isinstance(node, c_ast.TypeDecl):
            return self.type_of(node.type)
        if isinstance(node, c_ast.IdentifierType):
            word = " ".join(node.names)
            return TYPES.get(word) or word
        if isinstance(node, c_ast.PtrDecl):
            return "POINTER", self.type_of(node.type)
        if isinstance(node, c_ast.ArrayDecl):
            size = int(str(self.expression(node.dim).text)) if node.dim is not None else 0
            return "ARRAY", self.type_of(node.type), size
        if isinstance(node, (c_ast.Struct, c_ast.Union)):
            title = f"{self.name}_{node.name or f'part{len(self.structs)}'}_t"
            self.struct(title, node)
            return title
        raise NotNative(f"structured text of {type(node).__name__}")

    def written(self, kind: Any) -> str:
        """Return the spelling of a type."""
        if isinstance(kind, tuple) and kind[0] == "ARRAY":
            return f"ARRAY [0..{kind[2] - 1}] OF {self.written(kind[1])}"
        if isinstance(kind, tuple):
            return f"POINTER TO {self.written(kind[1])}"
        return kind if kind in TYPES.values() else self.word(kind)

    def struct(self, name: str, node: Any) -> None:
        """Declare a struct; a union is a struct with all its parts."""
        if name in self.structs:
            return
        self.structs[name] = fields = {}
        for member in node.decls or ():
            fields[member.name] = self.type_of(member.type)
        self.done.append(
            Unit("TYPE", self.word(name), [], fields=[(self.word(n), self.written(t)) for n, t in fields.items()])
        )

    # declarations -------------------------------------------------------------------------------------------------

    def units(self) -> list[Unit]:
        """Return all that the block needs."""
        for node in self.tree.ext:
            if isinstance(node, c_ast.Typedef) and isinstance(node.type.type, (c_ast.Struct, c_ast.Union)):
                self.struct(node.name, node.type.type)
            elif isinstance(node, c_ast.Decl) and isinstance(node.type, c_ast.FuncDecl):
                self.signature(node)
            elif isinstance(node, c_ast.Decl) and node.init is not None and isinstance(node.type, c_ast.ArrayDecl):
                values = [self.expression(v).text for v in node.init.exprs]
                # matiec refuses negative numbers in parentheses in the initial values of a table.
                numbers = ", ".join(re.sub(r"^\((-[\d.e+-]+)\)$", r"\1", v) for v in values)
                self.tables[node.name] = self.type_of(node.type), f"[{numbers}]"
            elif isinstance(node, c_ast.FuncDef):
                self.signature(node.decl)
                try:
                    self.function(node)
                except NotNative as reason:
                    title = self.titles.get(node.decl.name, "")
                    raise NotNative(f"{title}: {reason}" if "." in title else str(reason)) from None
        known = {u.name: "\n".join(u.body) for u in self.done if u.kind == "FUNCTION"}
        needed = reached([self.word(f"{self.name}_init"), *(self.word(f) for f in self.steps())], known)
        used = [u for u in self.done if u.kind == "TYPE" or u.name in needed]
        return [*_library(used), *used]

    def block_of(self, member: Member, params: Sequence[str]) -> Unit:
        """Return the function block: its inputs and outputs by topic and unit, then the call."""
        n, node = self.name, self.word(f"{self.name}_node")
        inputs, answer, settings = (self.word(f"{n}_{w}_now") for w in ("in", "out", "params"))
        rows: dict[str, list[str]] = {"VAR_INPUT": [], "VAR_OUTPUT": []}
        before, after = list[str](), list[str]()
        for title, ports, struct, lines in (
            ("VAR_INPUT", member.inputs, inputs, before),
            ("VAR_OUTPUT", member.outputs, answer, after),
        ):
            for port in ports:
                ident = identifier(port.name)
                pairs = []
                if port.held if title == "VAR_INPUT" else port.sporadic:
                    pairs.append((f"has_{ident}", f"has_{ident}", "BOOL", f"whether {port.topic} has a value"))
                if port.delayed:
                    pairs.append((f"{ident}_stamp_ns", f"{ident}_stamp_ns", "LINT", "when it was acquired, ns"))
                for k, (label, unit) in enumerate(zip(port.labels, port.units, strict=True)):
                    pairs.append(
                        (f"{ident}[{k}]", f"{ident}_{identifier(label)}", "LREAL", f"{port.topic}/{label}, {unit}")
                    )
                for variable, name, kind, comment in pairs:
                    field_, _, index = variable.partition("[")
                    inner = f"{struct}.{self.word(field_)}{'[' + index if index else ''}"
                    outer = self.word(name)
                    rows[title].append(f"    {outer} : {kind}; (* {remark(comment)} *)")
                    lines.append(f"    {inner} := {outer};" if title == "VAR_INPUT" else f"    {outer} := {inner};")
        fields = list(self.structs[f"{n}_params"])
        settings_ = [f"    {settings}.{self.word(f)} := {v};" for f, v in zip(fields, params, strict=True)]
        call = ", ".join(
            f"{self.word(w)} := {v}"
            for (w, _, _), v in zip(self.functions[f"{n}_step"][1], (node, inputs, answer, "t_ns"), strict=True)
        )
        begin = ", ".join(
            f"{self.word(w)} := {v}"
            for (w, _, _), v in zip(self.functions[f"{n}_init"][1], (node, settings), strict=True)
        )
        head = [
            "VAR_INPUT", "    restart : BOOL; (* the tick begins with the first state *)",
            "    t_ns : LINT; (* time of the tick, ns *)", *rows["VAR_INPUT"], "END_VAR",
            "VAR_OUTPUT", "    gave_up : BOOL; (* the outputs have their safe values *)",
            *rows["VAR_OUTPUT"], "END_VAR",
            "VAR", f"    {node} : {self.word(n)};", f"    {inputs} : {self.word(f'{n}_in')};",
            f"    {answer} : {self.word(f'{n}_out')};", f"    {settings} : {self.word(f'{n}_params')};",
            "    begun : BOOL;", "    done : BOOL;", "END_VAR",
        ]  # fmt: skip
        init, step = self.word(f"{n}_init"), self.word(f"{n}_step")
        body = [
            "    IF restart OR NOT begun THEN",
            *(f"    {line}" for line in settings_),
            f"        done := {init}({begin});",
            "        begun := TRUE;",
            "    END_IF;",
            *before,
            f"    gave_up := ({step}({call}) <> 0);",
            *after,
        ]
        return Unit("FUNCTION_BLOCK", self.word(f"FB_{n}"), head, body)

    def steps(self) -> list[str]:
        """Return the functions of C that a user calls at a tick."""
        return [n for w in ("step", "outputs", "advance") if (n := f"{self.name}_{w}") in self.functions]

    def signature(self, decl: Any) -> None:
        """Register a function."""
        parameters: list[tuple[str, Any, bool]] = []
        for parameter in decl.type.args.params if decl.type.args else ():
            kind = self.type_of(parameter.type)
            by_reference = isinstance(kind, tuple) and kind[0] == "POINTER" and kind[1] in self.structs
            parameters.append((parameter.name or "", kind[1] if by_reference else kind, by_reference))
        self.functions[decl.name] = self.type_of(decl.type.type), parameters

    def function(self, node: Any) -> None:
        """Print a function."""
        name = node.decl.name
        if name.startswith("sr_") and name in OWN.values():
            return
        self.result, parameters = self.functions[name]
        self.lines, self.vars, self.depth, self.count, self.increments = [], {}, 0, 0, []
        self.own, self.newest = self.word(name), {}
        for word, kind, _ in parameters:
            self.vars[word] = kind
        declared = set(self.vars)
        for statement in node.body.block_items or ():
            self.statement(statement)
        body = "\n".join(self.lines)
        head: list[str] = []
        # A struct behind a pointer of C is changed by the function, and an input of structured text is a copy.
        for title, by_reference in (("VAR_IN_OUT", True), ("VAR_INPUT", False)):
            rows = [f"    {self.word(w)} : {self.written(k)};" for w, k, r in parameters if r is by_reference]
            head += [title, *rows, "END_VAR"] if rows else []
        rows = [f"    {self.word(w)} : {self.written(k)};" for w, k in self.vars.items() if w not in declared]
        rows += [
            f"    {self.word(w)} : {self.written(k)} := {v};"
            for w, (k, v) in self.tables.items()
            if re.search(rf"\b{self.word(w)}\b", body)
        ]
        head += ["VAR", *rows, "END_VAR"] if rows else []
        result = "BOOL" if self.result == "void" else self.written(self.result)
        # Each function of IEC 61131-3 has a result and, for matiec, at least one statement.
        self.done.append(Unit("FUNCTION", self.own, head, self.lines or [f"    {self.own} := FALSE;"], result=result))

    # statements ---------------------------------------------------------------------------------------------------

    def emit(self, line: str) -> None:
        """Add a line."""
        self.lines.append("    " * (self.depth + 1) + line)

    def block(self, node: Any) -> None:
        """Print the statements between braces."""
        self.depth += 1
        items = node.block_items or () if isinstance(node, c_ast.Compound) else (node,)
        start = len(self.lines)
        for statement in items:
            self.statement(statement)
        if len(self.lines) == start:
            self.emit(";")
        self.depth -= 1

    def statement(self, node: Any) -> None:
        """Print one statement."""
        method = getattr(self, f"_{type(node).__name__.lower()}", None)
        if method is None:
            raise NotNative(f"structured text of a C statement {type(node).__name__}")
        method(node)

    def _decl(self, node: Any) -> None:
        kind, name, k = self.type_of(node.type), node.name, 2
        # Another block of C may have a variable of this name and of another type.
        while self.vars.get(name, kind) != kind:
            name, k = f"{node.name}_{k}", k + 1
        self.vars[name] = kind
        self.newest[node.name] = name
        if node.init is not None:
            self.assign(Typed(self.word(name), kind), node.init)

    def _compound(self, node: Any) -> None:
        for statement in node.block_items or ():
            self.statement(statement)

    def _cast(self, node: Any) -> None:
        # A cast to void, of a call whose result is not needed.
        if isinstance(node.expr, c_ast.FuncCall):
            self.expression(node.expr, named=True)

    def _emptystatement(self, node: Any) -> None:
        pass

    def _assignment(self, node: Any) -> None:
        target = self.expression(node.lvalue)
        if node.op == "=":
            self.assign(target, node.rvalue)
        else:
            value = self.expression(c_ast.BinaryOp(node.op[:-1], node.lvalue, node.rvalue))
            self.emit(f"{target.text} := {value.text};")

    def assign(self, target: Typed, node: Any) -> None:
        """Print an assignment."""
        value = self.expression(node, wanted=target.type)
        self.emit(f"{target.text} := {self.converted(value, target.type).text};")

    def _unaryop(self, node: Any) -> None:
        target = self.expression(node.expr)
        self.emit(f"{target.text} := {target.text} {node.op[-1]} 1;")

    def _funccall(self, node: Any) -> None:
        if isinstance(node.name, c_ast.ID) and node.name.name in ("memcpy", "memset"):
            self._copied(node)
        else:
            self.expression(node, named=True)

    def _copied(self, node: Any) -> None:
        """Print a copy of an array, number by number; all of a node is zero when it begins."""
        target, source, _ = node.args.exprs
        if node.name.name == "memset":
            return
        goal, frm = self.expression(target), self.expression(source)
        size = min(k[2] for k in (goal.type, frm.type) if isinstance(k, tuple) and k[0] == "ARRAY")
        self.vars["copy_k"] = "LINT"
        k = self.word("copy_k")
        self.emit(f"{k} := 0;")
        self.emit(f"WHILE {k} < {size} DO")
        self.emit(f"    {goal.text}[{k}] := {frm.text}[{k}];")
        self.emit(f"    {k} := {k} + 1;")
        self.emit("END_WHILE;")

    def _return(self, node: Any) -> None:
        # C returns zero from a call that discards the tick, and nothing reads the result of such a call.
        zero = (
            isinstance(node.expr, c_ast.CompoundLiteral)
            and len(node.expr.init.exprs) == 1
            and isinstance(node.expr.init.exprs[0], c_ast.Constant)
        )
        if node.expr is not None and not zero:
            self.assign(Typed(self.own, self.result), node.expr)
        self.emit("RETURN;")

    def _if(self, node: Any) -> None:
        self.emit(f"IF {self.condition(node.cond)} THEN")
        self.block(node.iftrue)
        if node.iffalse is not None:
            self.emit("ELSE")
            self.block(node.iffalse)
        self.emit("END_IF;")

    def _for(self, node: Any) -> None:
        """Print a loop as WHILE, because one compiler does not run a FOR loop whose ends are equal."""
        if isinstance(node.init, c_ast.DeclList):
            for declaration in node.init.decls:
                self._decl(declaration)
        elif node.init is not None:
            self.statement(node.init)
        self.emit(f"WHILE {'TRUE' if node.cond is None else self.condition(node.cond)} DO")
        outer, lines = self.increments, self.lines
        if node.next is not None:
            self.lines, self.depth = [], self.depth + 1
            self.statement(node.next)
            self.increments, self.depth = self.lines, self.depth - 1
        else:
            self.increments = []
        self.lines = lines
        self.block(node.stmt)
        self.lines += self.increments
        self.increments = outer
        self.emit("END_WHILE;")

    def _break(self, node: Any) -> None:
        self.emit("EXIT;")

    def _continue(self, node: Any) -> None:
        # The loop is a WHILE, whose CONTINUE would leave out the step of C's `for`.
        self.lines += ["    " * (self.depth + 1) + line.strip() for line in self.increments]
        self.emit("CONTINUE;")

    # expressions --------------------------------------------------------------------------------------------------

    def condition(self, node: Any) -> str:
        """Return an expression as a truth."""
        value = self.expression(node)
        return value.text if value.type == "BOOL" else f"({value.text} <> 0)"

    def temporary(self, kind: Any) -> Typed:
        """Return a variable of its own."""
        name = f"h{self.count}"
        self.count += 1
        while self.vars.get(name, kind) != kind:
            name = f"h{self.count}"
            self.count += 1
        self.vars[name] = kind
        return Typed(self.word(name), kind)

    def converted(self, value: Typed, kind: Any) -> Typed:
        """Return a value as one of another type."""
        if value.type == kind:
            return value
        if value.type == "NUMBER":
            text = f"{value.text}.0" if value.type == "NUMBER" and kind == "LREAL" else value.text
            if value.type == "NUMBER" and kind == "BOOL":
                text = "FALSE" if value.text == "0" else "TRUE"
            return Typed("0" if isinstance(kind, tuple) else text, kind)
        if (
            isinstance(kind, tuple)
            and isinstance(value.type, tuple)
            and value.type[0] == "ARRAY"
            and kind[0] == "POINTER"
        ):
            return Typed(f"ADR({value.text})", kind)
        if (value.type, kind) in CONVERSIONS:
            return Typed(f"{value.type}_TO_{kind}({value.text})", kind)
        if {value.type, kind} <= {"USINT", "UDINT", "DINT", "LINT"}:
            return Typed(value.text, kind)
        raise NotNative(f"structured text of a C conversion from {value.type} to {kind}")

    def expression(self, node: Any, wanted: Any = None, named: bool = False) -> Typed:
        """Return an expression; statements that it needs are printed before it."""
        method = getattr(self, f"_e_{type(node).__name__.lower()}", None)
        if method is None:
            raise NotNative(f"structured text of a C expression {type(node).__name__}")
        result: Typed = method(node, named) if isinstance(node, c_ast.FuncCall) else method(node)
        return result

    def _e_constant(self, node: Any) -> Typed:
        return Typed(node.value.rstrip("uUlL"), "LREAL" if node.type == "double" else "NUMBER")

    def _e_id(self, node: Any) -> Typed:
        name = self.newest.get(node.name, node.name)
        fixed = {"true": ("TRUE", "BOOL"), "false": ("FALSE", "BOOL"), "SR_DONE": ("0", "DINT"),
                 "SR_GAVE_UP": ("1", "DINT"),
                 "INT64_MIN": ("(-9223372036854775807 - 1)", "LINT")}  # fmt: skip
        if name in fixed:
            return Typed(*fixed[name])
        if name in ("SR_INFINITY", "SR_NAN"):
            # IEC 61131-3 has no literals of infinity and NaN.
            large = "SR_INF(10.0)"
            return Typed(large if name == "SR_INFINITY" else f"({large} - {large})", "LREAL")
        if name in self.tables:
            return Typed(self.word(name), self.tables[name][0])
        if name not in self.vars:
            raise NotNative(f"structured text of C's {name}")
        return Typed(self.word(name), self.vars[name])

    def _e_structref(self, node: Any) -> Typed:
        base = self.expression(node.name)
        return Typed(f"{base.text}.{self.word(node.field.name)}", self.structs[base.type][node.field.name])

    def _e_arrayref(self, node: Any) -> Typed:
        base, index = self.expression(node.name), self.expression(node.subscript)
        kind = base.type[1] if isinstance(base.type, tuple) else None
        if kind is None:
            raise NotNative("structured text of an item of something that is not an array")
        return Typed(f"{base.text}[{index.text}]", kind)

    def _e_unaryop(self, node: Any) -> Typed:
        # Only the size that `memcpy` and `memset` get is one, and `_copied` does not need it.
        if node.op == "sizeof":
            return Typed("0", "NUMBER")
        if node.op == "&":
            raise NotNative("a row of an array has no structured text")
        value = self.expression(node.expr)
        if node.op == "!":
            return Typed(f"(NOT {self.condition(node.expr)})", "BOOL")
        if node.op not in "+-":
            raise NotNative(f"structured text of C's {node.op}")
        return Typed(f"({node.op}{value.text})" if node.op == "-" else value.text, value.type)

    def _e_binaryop(self, node: Any) -> Typed:
        op = node.op
        if op in ("&&", "||"):
            return Typed(f"({self.condition(node.left)} {OPERATORS[op]} {self.condition(node.right)})", "BOOL")
        a, b = self.expression(node.left), self.expression(node.right)
        # C compares a pointer with NULL; a struct that is passed by reference is always there.
        if a.type in self.structs:
            return Typed("TRUE" if op == "!=" else "FALSE", "BOOL")
        if op in ("&", "|", "^", "<<", ">>"):
            if (a.type, b.type) == ("BOOL", "BOOL") and op in "&|^":
                return Typed(f"({a.text} { {'&': 'AND', '|': 'OR', '^': 'XOR'}[op] } {b.text})", "BOOL")
            # IEC 61131-3 has these operations for bit strings, not for integers.
            raise NotNative(f"structured text of C's {op} of whole numbers")
        order = ("NUMBER", "BOOL", "USINT", "DINT", "UDINT", "LINT", "LREAL")
        if a.type not in order or b.type not in order:
            raise NotNative(f"structured text of C's {op} of {a.type} and {b.type}")
        both = max((a.type, b.type), key=order.index)
        # C computes with truth values as with whole numbers.
        if both == "BOOL" and op not in COMPARE:
            both = "LINT"
        a, b = self.converted(a, both), self.converted(b, both)
        return Typed(f"({a.text} {OPERATORS.get(op, op)} {b.text})", "BOOL" if op in COMPARE else both)

    def _e_ternaryop(self, node: Any) -> Typed:
        """Print a choice as IF: only the selected expression is computed."""
        condition = self.condition(node.cond)
        results: list[tuple[Typed, list[str]]] = []
        lines = self.lines
        self.depth += 1
        for branch in (node.iftrue, node.iffalse):
            self.lines = []
            results.append((self.expression(branch), self.lines))
        (a, then), (b, orelse) = results
        kind = b.type if a.type == "NUMBER" else a.type
        target = self.temporary("LINT" if kind == "NUMBER" else kind)
        for value, body in ((a, then), (b, orelse)):
            self.lines = body
            self.emit(f"{target.text} := {self.converted(value, target.type).text};")
        self.depth -= 1
        self.lines = lines
        self.emit(f"IF {condition} THEN")
        self.lines += then
        self.emit("ELSE")
        self.lines += orelse
        self.emit("END_IF;")
        return target

    def _e_cast(self, node: Any) -> Typed:
        kind, value = self.type_of(node.to_type.type), self.expression(node.expr)
        # C cuts the fraction off, LREAL_TO_LINT rounds.
        if kind == "LINT" and value.type == "LREAL":
            return Typed(f"SR_WHOLE({value.text})", "LINT")
        if kind == value.type or value.type == "NUMBER" or not isinstance(kind, tuple):
            return self.converted(value, kind)
        return Typed(value.text, value.type)  # a pointer that C takes for one to constant numbers

    def _e_compoundliteral(self, node: Any) -> Typed:
        """Print a struct of its parts: assignments to a variable of its own."""
        return self._made(self.type_of(node.type.type), node.init)

    def _made(self, kind: Any, init: Any) -> Typed:
        target = self.temporary(kind)
        fields = list(self.structs[kind].items())
        values = {}
        for k, item in enumerate(init.exprs):
            if isinstance(item, c_ast.NamedInitializer):
                values[item.name[0].name] = item.expr
            elif not (isinstance(item, c_ast.Constant) and len(init.exprs) == 1):
                values[fields[k][0]] = item
        for name, inner in fields:
            element = f"{target.text}.{self.word(name)}"
            if name not in values:
                self._zero(element, inner)
            elif isinstance(values[name], c_ast.InitList):
                self.emit(f"{element} := {self._made(inner, values[name]).text};")
            else:
                self.assign(Typed(element, inner), values[name])
        return target

    def _zero(self, variable: str, kind: Any) -> None:
        if kind in self.structs:
            for name, inner in self.structs[kind].items():
                self._zero(f"{variable}.{self.word(name)}", inner)
        elif not isinstance(kind, tuple) or kind[0] == "POINTER":
            zero = {"LREAL": "0.0", "BOOL": "FALSE"}.get(str(kind), "0")
            self.emit(f"{variable} := {zero};")

    def _e_funccall(self, node: Any, named: bool = False) -> Typed:
        arguments = node.args.exprs if node.args is not None else []
        if isinstance(node.name, c_ast.FuncCall):  # SR_MATH(name)(...)
            return self._math(node.name.args.exprs[0].name, arguments)
        name = node.name.name
        if name == "SR_REAL":
            value = self.expression(arguments[0])
            return self.converted(value, "LREAL")
        if name in ("INT64_C", "UINT64_C"):
            return Typed(self.expression(arguments[0]).text, "LINT")
        if name not in self.functions:
            raise NotNative(f"structured text of C's {name}")
        result, parameters = self.functions[name]
        args = []
        for (word, kind, by_reference), argument in zip(parameters, arguments, strict=True):
            if by_reference and isinstance(argument, c_ast.UnaryOp):
                argument = argument.expr
            value = self.expression(argument)
            args.append(f"{self.word(word)} := {value.text if by_reference else self.converted(value, kind).text}")
        text = f"{self.word(name)}({', '.join(args)})"
        if result == "void":  # in IEC 61131-3 each function has a result, and a call is no statement
            result, named = "BOOL", True
        if named:
            target = self.temporary(result)
            self.emit(f"{target.text} := {text};")
            return target
        return Typed(text, result)

    def _math(self, name: str, arguments: Sequence[Any]) -> Typed:
        word = MATH.get(name) or OWN.get(name)
        if word is None:
            raise NotNative(f"{name} is not a function of IEC 61131-3")
        args = [self.converted(self.expression(a), "LREAL").text for a in arguments]
        return Typed(f"{word}({', '.join(args)})", "LREAL")


def _library(units: Sequence[Unit]) -> list[Unit]:
    """Return the functions of the library that others use."""
    text = (resources.files(__package__) / "softrig.st").read_text()
    known: dict[str, Unit] = {}
    for result in re.finditer(r"FUNCTION (\w+) : (\w+)\n(.*?)END_FUNCTION\n", text, re.DOTALL):
        *heads, body = re.split(r"(?<=END_VAR)\n", result[3])
        head = "\n".join(heads).splitlines()
        known[result[1]] = Unit("FUNCTION", result[1], head, body.rstrip("\n").splitlines(), result=result[2])
    wanted: list[str] = []
    open_ = ["\n".join(u.body) for u in units]
    while open_:
        for name in re.findall(r"\bSR_\w+(?=\()", open_.pop()):
            if name in known and name not in wanted:
                wanted.append(name)
                open_.append("\n".join(known[name].body))
    return [u for name, u in known.items() if name in wanted]


def ordered(units: Sequence[Unit]) -> str:
    """Return all parts as one text."""
    return "\n".join(u.text() for u in units)
