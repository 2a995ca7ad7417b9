"""A node of a scenario as an FMU: ``softrig export fmu SCENARIO NODE...``."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from softrig_core import Block, Rig, ScenarioError, rig_of, simulate
from softrig_core.block.codec import Decoder
from softrig_core.block.params import flatten
from softrig_core.command_line import Parser
from softrig_core.errors import closest
from softrig_core.extras import need
from softrig_core.guard import naming
from softrig_core.rig.members import Member

_NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_SCRIPT = '''"""What runs in this FMU is {node}, {package}/{executable} of softrig."""

from pythonfmu import Fmi2Slave
from softrig_control.fmu.slave import Node


class {node}(Node, Fmi2Slave):
    """See node.json."""

    def __init__(self, **keywords):  # without one of its own PythonFMU 0.7 releases the class once too often
        super().__init__(**keywords)
'''


def export(rig: Rig, node: str, folder: Path, native: int = 0) -> Path:
    """Write a node of a rig as an FMU for co-simulation.

    Parameters
    ----------
    node : str
        Its name.
    folder : Path
        The file ``NODE.fmu`` goes here.
    native : int
        2 or 3: the node's C, by that version of the FMI, which runs without Python. 0: its Python, by FMI 2.0.

    Returns
    -------
    Path
        Of the FMU. That with Python runs where softrig is installed: it holds the node's parameters, not its code.

    Raises
    ------
    ScenarioError
        There is no such node, or it has a link that an FMU cannot have.
    """
    members = {m.name: m for m in rig.members}
    if node not in members:
        raise ScenarioError(
            f"{rig.scenario.name} has no node {node!r}{closest(node, members)}; it has {', '.join(members)}"
        )
    member = members[node]
    _check(member)
    start = _first(rig, member)
    if native:
        need("fmpy", "an export as an FMU")
        from .native import export_native

        return export_native(rig, node, folder, start, native)
    need("pythonfmu", "an export as an FMU")
    from .slave import content

    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="softrig_fmu_") as scratch:
        script = Path(scratch, f"softrig_{node}.py")
        script.write_text(_SCRIPT.format(node=node, package=member.package, executable=member.executable))
        description = Path(scratch, "node.json")
        description.write_text(json.dumps(content(member, rig.scenario.seed, start), indent=1), encoding="utf-8")
        path, fmu = folder / f"{node}.fmu", Path(scratch, f"{node}.fmu")
        code = "import sys; from pythonfmu import FmuBuilder; FmuBuilder.build_FMU(*sys.argv[1:3], [sys.argv[3]], "
        code += "**dict.fromkeys(sys.argv[4:], True))"
        # The builder imports the script by its name and leaves its folder on `sys.path`, so it has its own process.
        command = [sys.executable, "-P", "-c", code, str(script), str(fmu), str(description), *_can(member)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ScenarioError(f"node {node}: no FMU: {(done.stderr.strip().splitlines() or ['no reason given'])[-1]}")
        with naming(path):
            # Moved into place, so that a reader never finds half of the file.
            shutil.move(fmu, path)
    return path


def _can(member: Member) -> tuple[str, ...]:
    """Return the optional abilities of the FMU: save its state and write it, if nothing in it is opaque."""
    plain = member.block_class.save is Block.save
    return ("canGetAndSetFMUstate", "canSerializeFMUstate") if plain else ()


def _first(rig: Rig, member: Member) -> dict[str, list[float]]:
    """Return each input's first value in the scenario, if its publisher sends a message at its first tick."""
    bare = rig.scenario.having(figures={}, expect={}, claims={}, requirements={}, plots=())
    short = rig_of(bare, duration=float(rig.clock.schedule.period), classes=rig.classes)
    recording = simulate(short, seed=rig.scenario.seed).recording
    result = {}
    for port in member.inputs:
        link = member.links.get(port.name)
        if link is not None and (text := recording.topics[port.topic].data):
            _, row = Decoder(port)(bytes(text[0]))
            result[port.name] = list(row)
    return result


def _check_text(member: Member, label: str, text: str) -> None:
    if _NOT_IN_XML.search(text):
        raise ScenarioError(
            f"node {member.name}: {label}: {text[:100]!r} has a character that XML does not allow; expected printable "
            "text"
        )


def _check(member: Member) -> None:
    for port in (*member.inputs, *member.outputs):
        if port.delayed:
            raise ScenarioError(
                f"node {member.name}: {port.topic} carries acquisition times of its own, which an FMU cannot"
            )
        for text in (port.topic, *port.labels, *port.units):
            _check_text(member, f"port {port.name}", text)
    for name, value in flatten(member.params).items():
        _check_text(member, f"parameter {name}", value if isinstance(value, str) else "")
    if member.external:
        raise ScenarioError(f"node {member.name} is external: its code is not here")


# Kinds of the verb `export`; all but the first have a parser of their own.
KINDS = ("fmu", "c", "st", "arduino", "cortex-m")


def main(arguments: Sequence[str]) -> int:
    """Run the verb."""
    parser = Parser(
        prog="softrig export",
        description="Nodes of a scenario for other tools.",
        epilog="Other kinds have a help of their own: export c, st, arduino, cortex-m --help.",
    )
    if arguments and not arguments[0].startswith("-") and arguments[0] not in KINDS:
        parser.error(f"kind {arguments[0]!r} is unknown{closest(arguments[0], KINDS)}; expected {', '.join(KINDS)}")
    parser.add_argument("kind", choices=["fmu"], help="a Functional Mock-up Unit for co-simulation")
    parser.add_argument("scenario", help="name or YAML file")
    parser.add_argument("nodes", nargs="+", metavar="NODE", help="of the scenario, with its parameters there")
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder for NODE.fmu (.)")
    parser.add_argument(
        "--native", action="store_true", help="FMU of the node's C code, with sources; it runs without Python"
    )
    parser.add_argument("--fmi", type=int, choices=[2, 3], help="version of the FMI (2); 3 with --native")
    options = parser.parse_args(arguments)
    if options.fmi == 3 and not options.native:
        parser.error("--fmi 3 needs --native: only FMUs without Python have it")
    rig = rig_of(options.scenario)
    for node in options.nodes:
        print(export(rig, node, options.out, (options.fmi or 2) if options.native else 0))
    return 0
