"""The verb ``softrig export st``: controllers as function blocks in structured text, compared with golden rows."""

from __future__ import annotations

import math
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, register_namespace, tostring

from ..block.port import Port
from ..command_line import export_parser
from ..errors import ScenarioError
from ..guard import write_files
from ..native.value import NotNative
from ..rig.members import Member
from ..rig.rig import Rig
from ..run.expand import rig_of
from .c_files import Exported
from .command import c_of
from .golden import member_of
from .kinds import identifier
from .st import Unit, structured_text
from .st_run import Program

FORMATS = ("st", "tcpou", "plcopen")
ROWS, DRAWN = 500, 300  # calls that become golden rows
NEAR = 1e-12  # relative difference of numbers, because the last bit of another library may differ


@dataclass(frozen=True)
class Executed:
    """Comparison of structured text with golden rows: calls, numbers that differ, statuses that differ."""

    rows: int
    differing: int
    wrong_status: int

    @property
    def same(self) -> bool:
        """Return whether there were rows and none differs."""
        return self.rows > 0 and not self.differing and not self.wrong_status


def st_of(rig: Rig, node: str, *, rows: int = ROWS, drawn: int = DRAWN) -> tuple[list[Unit], Exported]:
    """Return a controller of a rig in structured text and in C; the golden rows of the C apply to both.

    Raises
    ------
    ScenarioError
        There is no such node, or part of it has no structured text; the message has the reason.
    """
    done = c_of(rig, node, rows=rows, drawn=drawn)
    n, files = done.name, done.files
    try:
        return structured_text(n, files[f"{n}.h"], files[f"{n}.c"], files["softrig_c.h"], member_of(rig, node)), done
    except NotNative as reason:
        raise ScenarioError(f"{node} cannot be exported as structured text: {reason}") from None


def written(units: Sequence[Unit], name: str, form: str) -> dict[str, str]:
    """Return the files of one of `FORMATS`, text by name."""
    if form == "tcpou":
        return {f"{u.name}.{'TcDUT' if u.kind == 'TYPE' else 'TcPOU'}": _twincat(u) for u in units}
    if form == "plcopen":
        return {f"{name}.xml": _plcopen(units, name)}
    return {f"{name}.st": "\n".join(u.text() for u in units)}


def executed(text: str, done: Exported, member: Member) -> Executed:
    """Run structured text on the golden rows of the C.

    Parameters
    ----------
    text : str
        Of format ``st``.
    done : Exported
        The C, with its rows.
    member : Member
        The node.
    """
    program, count, differing, wrong = Program(text), 0, 0, 0
    block = program.block()
    names = {**{f.lower(): f for f in vars(block)}}
    angles = {
        _plain(f"{identifier(port.name)}_{identifier(label)}")
        for port in member.outputs
        for label, unit in zip(port.labels, port.units, strict=True)
        if unit == "rad"
    }
    for line in done.files[f"{done.name}_rows.txt"].splitlines():
        words = iter(line.split())
        if (first := next(words)) == "init":
            block = program.block()
            continue
        if first == "set":
            break
        status = int(next(words))
        setattr(block, "t_ns", int(next(words)))  # noqa: B010 - its variables are those of the text
        for name, value in _named(member.inputs, words, "held"):
            setattr(block, names[name.lower()], value)
        program.call(block)
        count += 1
        if status == 2 and vars(block)["gave_up"]:  # an input that its port refuses
            continue
        wrong += vars(block)["gave_up"] != (status == 1)
        for name, value in _named(member.outputs, words, "sporadic"):
            result = getattr(block, names[name.lower()])
            silent = isinstance(value, float) and not getattr(block, _flag(name, member.outputs), True)
            same = result == value or (result != result and value != value)
            near = isinstance(value, float) and done.libm and _is_near(result, value, name in angles)
            differing += not (silent or same or near)
    return Executed(count, differing, wrong)


def _is_near(result: float, value: float, is_angle: bool) -> bool:
    """Return whether numbers differ by the last bits of a library, by which an angle may also wrap at half a turn."""
    turns = (0.0, 2 * math.pi) if is_angle else (0.0,)
    return any(abs(abs(result - value) - turn) <= NEAR * max(1.0, abs(value)) for turn in turns)


def _flag(name: str, ports: Sequence[Port]) -> str:
    flags = [f"has_{identifier(p.name)}" for p in ports if p.sporadic and name.startswith(f"{identifier(p.name)}_")]
    return flags[0] if flags else ""


def _named(ports: Sequence[Port], words: Iterator[str], flag: str) -> Iterator[tuple[str, float | int | bool]]:
    """Name the values of a row by the ports of the function block."""
    for port in ports:
        field = identifier(port.name)
        if getattr(port, flag):
            yield f"has_{field}", next(words) != "0"
        if port.delayed:
            yield f"{field}_stamp_ns", int(next(words))
        for label in port.labels:
            yield _plain(f"{field}_{identifier(label)}"), float.fromhex(next(words))


def _plain(name: str) -> str:
    return "_".join(part for part in name.split("_") if part)


def _data(text: str) -> str:
    """Return a text as CDATA; a blank separates ``]]>`` that indices before a comparison may form."""
    return text.replace("]]>", "]]]]><![CDATA[>")


def _twincat(unit: Unit) -> str:
    """Return a part as a file of TwinCAT 3."""
    guid = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, unit.name + unit.text())}}}"
    head = '<?xml version="1.0" encoding="utf-8"?>\n<TcPlcObject Version="1.1.0.1" ProductVersion="3.1.4024.0">\n'
    if unit.kind == "TYPE":
        inner = (
            f'  <DUT Name="{unit.name}" Id="{guid}">\n    <Declaration><![CDATA[{_data(unit.text())}]]></Declaration>\n'
        )
        inner += "  </DUT>\n"
    else:
        colon = f" : {unit.result}" if unit.result else ""
        head_of = "\n".join([f"{unit.kind} {unit.name}{colon}", *unit.head])
        inner = (
            f'  <POU Name="{unit.name}" Id="{guid}" SpecialFunc="None">\n'
            f"    <Declaration><![CDATA[{_data(head_of)}\n]]></Declaration>\n"
            "    <Implementation>\n      <ST><![CDATA["
            + _data("\n".join(unit.body))
            + "\n]]></ST>\n    </Implementation>\n  </POU>\n"
        )
    return f"{head}{inner}</TcPlcObject>\n"


_TC6 = "http://www.plcopen.org/xml/tc6_0201"
_SECTIONS = {"VAR_INPUT": "inputVars", "VAR_OUTPUT": "outputVars", "VAR_IN_OUT": "inOutVars", "VAR": "localVars"}


def _plcopen(units: Sequence[Unit], name: str) -> str:
    """Return all parts as a project of PLCopen's XML (TC6, 2.01)."""
    register_namespace("", _TC6)
    stamp = "2000-01-01T00:00:00"  # a fixed date, so that the same node gives the same file
    root = Element(f"{{{_TC6}}}project")
    _sub(root, "fileHeader", companyName="", productName="softrig", productVersion="1", creationDateTime=stamp)
    content = _sub(_sub(root, "contentHeader", name=name), "coordinateInfo")
    for kind in ("fbd", "ld", "sfc"):
        _sub(_sub(content, kind), "scaling", x="1", y="1")
    types = _sub(root, "types")
    data, pous = _sub(types, "dataTypes"), _sub(types, "pous")
    for unit in units:
        if unit.kind == "TYPE":
            struct = _sub(_sub(_sub(data, "dataType", name=unit.name), "baseType"), "struct")
            for field, kind in unit.fields:
                _type(_sub(_sub(struct, "variable", name=field), "type"), kind)
        else:
            kind = "function" if unit.kind == "FUNCTION" else "functionBlock"
            _pou(_sub(pous, "pou", name=unit.name, pouType=kind), unit)
    _sub(_sub(root, "instances"), "configurations")
    indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _sub(parent: Element, tag: str, **attributes: str) -> Element:
    return SubElement(parent, f"{{{_TC6}}}{tag}", attributes)


def _pou(pou: Element, unit: Unit) -> None:
    interface = _sub(pou, "interface")
    if unit.result:
        _type(_sub(interface, "returnType"), unit.result)
    section: Element | None = None
    for line in unit.head:
        if line in _SECTIONS:
            section = _sub(interface, _SECTIONS[line])
        elif line != "END_VAR" and section is not None:
            declared, _, _ = line.partition("(*")
            field, _, kind = declared.strip().rstrip(";").partition(" : ")
            kind, _, first = kind.rstrip("; ").partition(" := ")
            variable = _sub(section, "variable", name=field.strip())
            _type(_sub(variable, "type"), kind)
            if first:
                _initial(_sub(variable, "initialValue"), first)
    text = SubElement(_sub(_sub(pou, "body"), "ST"), "{http://www.w3.org/1999/xhtml}p")
    text.text = "\n".join(unit.body)


def _initial(parent: Element, first: str) -> None:
    if not first.startswith("["):
        _sub(parent, "simpleValue", value=first)
        return
    array = _sub(parent, "arrayValue")
    for number in first.strip("[]").split(", "):
        _sub(_sub(array, "value"), "simpleValue", value=number)


def _type(parent: Element, kind: str) -> None:
    """Write a type."""
    if kind.startswith("POINTER TO "):
        _type(_sub(_sub(parent, "pointer"), "baseType"), kind.removeprefix("POINTER TO "))
    elif kind.startswith("ARRAY [0.."):
        upper, _, inner = kind.removeprefix("ARRAY [0..").partition("] OF ")
        array = _sub(parent, "array")
        _sub(array, "dimension", lower="0", upper=upper)
        _type(_sub(array, "baseType"), inner)
    elif kind in ("LREAL", "LINT", "BOOL", "USINT", "UDINT", "DINT"):
        _sub(parent, kind)
    else:
        _sub(parent, "derived", name=escape(kind, quote=False))


def main(arguments: Sequence[str]) -> int:
    """Run the verb."""
    parser = export_parser(
        "st", "Controllers of a scenario as function blocks in structured text (IEC 61131-3), for a PLC."
    )
    parser.add_argument("nodes", nargs="+", metavar="NODE", help="controllers, with their parameters in the scenario")
    parser.add_argument("--format", choices=FORMATS, default="st", help="text, TwinCAT's files or PLCopen XML (st)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the files (./NODE)")
    parser.add_argument("--check", action="store_true", help="run the text and compare with Python's golden rows")
    options = parser.parse_args(arguments)
    rig = rig_of(options.scenario)
    status = 0
    for node in options.nodes:
        units, done = st_of(rig, node)
        folder = options.out or Path(node)
        files = written(units, done.name, options.format)
        write_files(folder, files)
        print(f"{folder}: {', '.join(files)}")
        if options.check:
            result = executed(written(units, done.name, "st")[f"{done.name}.st"], done, member_of(rig, node))
            differ = f"{result.differing} numbers and {result.wrong_status} statuses differ"
            print(f"{node}: {result.rows} calls, {'the numbers of Python' if result.same else differ}")
            status = status or int(not result.same)
    return status
