"""The TwinCAT files of a program that answers the ticks of a node over ADS on a PLC, and the verb that writes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..block.block import Plant
from ..block.port import Port
from ..board.dbc import build_of
from ..command_line import export_parser
from ..errors import ScenarioError
from ..export.golden import member_of
from ..export.kinds import identifier
from ..export.st import Unit
from ..export.st_files import st_of, written
from ..guard import write_files
from ..rig.members import Member
from ..run.expand import rig_of

OWN = [
    "        (* Your code: compute the fields of answer from those of request.",
    "           Begin with the first state where request.first is TRUE. *)",
]


class Packed(Unit):
    """A struct without gaps, as softrig reads and writes it."""

    def text(self) -> str:
        """Return it as structured text."""
        return "{attribute 'pack_mode' := '1'}\n" + super().text()


def link_units(member: Member, block: Unit | None) -> list[Unit]:
    """Return the structs of request and answer, and the program that uses them.

    Parameters
    ----------
    member : Member
        The node.
    block : Unit or None
        Its function block; None: the user writes the computation.
    """
    n, plant = identifier(member.name), issubclass(member.block_class, Plant)
    times = [("moves", "BOOL"), ("from_ns", "LINT"), ("t_ns", "LINT")] if plant else [("t_ns", "LINT")]
    inputs, back = _fields(member.inputs, "held"), _fields(member.outputs, "sporadic")
    ends = [("number", "UDINT"), ("session", "UDINT")], [("again", "UDINT")]
    request = [*ends[0], ("first", "BOOL"), *times, *inputs, *ends[1]]
    answer = [*ends[0], ("gave_up", "BOOL"), *back, *ends[1]]
    types = [
        Packed("TYPE", f"{n}_{word}", [], fields=fields) for word, fields in (("request", request), ("answer", answer))
    ]
    return [*types, _program(n, member, block, [name for name, _ in inputs], [name for name, _ in back])]


def _program(n: str, member: Member, block: Unit | None, received: Sequence[str], back: Sequence[str]) -> Unit:
    head = [
        "VAR",
        f"    request : {n}_request; (* softrig writes it *)",
        f"    answer : {n}_answer; (* softrig reads it *)",
        f"    build : STRING(16) := '{build_of(member.block_class, member.params)}'; (* of the node; do not edit *)",
        *([f"    block : {block.name};"] if block is not None else []),
        "END_VAR",
    ]
    work = OWN
    if block is not None:
        inputs, outputs = _declared(block, "VAR_INPUT"), _declared(block, "VAR_OUTPUT")
        work = [
            "        block.restart := request.first;",
            "        block.t_ns := request.t_ns;",
            *(f"        block.{field} := request.{name};" for field, name in zip(inputs[2:], received, strict=True)),
            "        block();",
            "        answer.gave_up := block.gave_up;",
            *(f"        answer.{name} := block.{field};" for field, name in zip(outputs[1:], back, strict=True)),
        ]
    body = [
        "IF (request.number = request.again) AND (request.number <> answer.number) THEN",
        "    IF request.first THEN",
        "        answer.session := request.session;",
        "    END_IF",
        "    IF request.session = answer.session THEN",
        *work,
        "        answer.again := request.number;",
        "        answer.number := request.number;",
        "    END_IF",
        "END_IF",
    ]
    return Unit("PROGRAM", f"{n}_link", head, body)


def _declared(block: Unit, section: str) -> list[str]:
    """Return the names of the inputs or outputs of a function block, in order."""
    start = block.head.index(section) + 1
    return [line.split(":")[0].strip() for line in block.head[start : block.head.index("END_VAR", start)]]


def _fields(ports: Sequence[Port], flag: str) -> list[tuple[str, str]]:
    """Return the fields of ports, in the order of `Layout`."""
    result: list[tuple[str, str]] = []
    for port in ports:
        field = identifier(port.name)
        result += [(f"has_{field}", "BOOL")] if getattr(port, flag) else []
        result += [(f"{field}_stamp_ns", "LINT")] if port.delayed else []
        result += [(f"{field}_{identifier(label)}", "LREAL") for label in port.labels]
    names = [name.lower() for name, _ in result]
    for name in names:
        if names.count(name) > 1:
            raise ScenarioError(f"two values would be the field {name}; rename a port or a channel")
    return result


def main(arguments: Sequence[str]) -> int:
    """Run the verb ``export ads``."""
    parser = export_parser("ads", "The program by which a PLC (TwinCAT) answers the ticks of a node of a rig over ADS.")
    parser.add_argument("node", metavar="NODE", help="of the scenario, with its parameters there")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the files (./NODE)")
    parser.add_argument(
        "--empty",
        action="store_true",
        help="without the function block: you write what the PLC computes (plants always)",
    )
    options = parser.parse_args(arguments)
    rig = rig_of(options.scenario)
    member = member_of(rig, options.node)
    empty = options.empty or issubclass(member.block_class, Plant)
    units = [] if empty else st_of(rig, options.node)[0]
    link = link_units(member, units[-1] if units else None)
    folder = options.out or Path(options.node)
    write_files(folder, written([*units, *link], member.name, "tcpou"))
    note = "add your code to it" if empty else f"calls {units[-1].name}"
    print(f"{folder}: {len(units) + len(link)} files; {link[-1].name}.TcPOU {note} and is the firmware of a link")
    return 0
