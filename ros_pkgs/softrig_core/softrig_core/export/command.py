"""The verb ``softrig export c``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..command_line import export_parser
from ..errors import ScenarioError
from ..guard import write_files
from ..native.value import NotNative
from ..rig.rig import Rig
from ..run.expand import rig_of
from .c_files import Exported, c_of_member, check_class
from .check import BOARDS, TOOLS, Replayed, replayed
from .golden import golden_calls, member_of
from .rig_c import rig_files

ROWS, DRAWN = 5000, 2000  # calls of the run, and of drawn inputs
NOTED = 1e-3  # share of a channel's scale from which on a difference of single precision is reported
# What to write in place of Python that has no C. The first pattern that a reason has decides.
ADVICE = {
    r": its state": "keep numbers, named tuples and arrays of numbers in the state",
    r"sum of numbers": "add them with + in a loop, because `sum` compensates errors of rounding",
    r"no place in 64 bits": "keep whole numbers below 2**63, or compute with floats",
    r"no value on every way": "assign it before the test",
    r"with another name": "make a new list or tuple instead of changing one",
    r"its arguments alone": "use the time `t`, and random numbers that the block draws by index",
    r"rounded to digits|a text|str as a value": "use whole numbers for texts, and numbers that are not rounded",
    r"else of a loop": "set a variable in the loop and test it after the loop",
    r"\*\* of whole": "multiply, or write one of the two as a float",
    r"step is computed": "use `while`",
    r"`is` of": "compare with ==",
    r"with words": "pass the arguments by position, or write out what it computes",
    r": match\b": "use `if` and `elif`",
    r": try\b": "test for the case before it occurs",
    r": (lambda|functiondef)\b": "define the function in its module or class",
    r": import\b": "import at the top of the module",
    r": global\b": "keep the value in the state",
    r": set\b": "use a tuple",
    r"length|slice|something else than numbers|whole arrays": "compute the elements one by one",
    r"\w\(\)|numpy\.\w+$": "compute it by arithmetic, functions of `math` and loops",
}


def export_c(
    rig: Rig, node: str, folder: Path, *, rows: int = ROWS, drawn: int = DRAWN, single: bool = False
) -> Exported:
    """Write a node of a rig as C99, with golden rows and a program that replays them.

    Parameters
    ----------
    node : str
        Its name.
    folder : Path
        The files go here.
    rows, drawn : int
        Most calls of the scenario's run, and of drawn inputs, that become golden rows.
    single : bool
        ``real_t`` is float.

    Returns
    -------
    Exported

    Raises
    ------
    ScenarioError
        There is no such node, or part of it has no C; the message names the line.
    """
    done = c_of(rig, node, rows=rows, drawn=drawn, single=single)
    write_files(folder, done.files)
    return done


def c_of(rig: Rig, node: str, *, rows: int = ROWS, drawn: int = DRAWN, single: bool = False) -> Exported:
    """Return a node of a rig as C99; see `export_c`."""
    seed = rig.scenario.seed
    member = member_of(rig, node)
    try:
        check_class(member)
        golden = golden_calls(rig, node, seed, rows)
        if not golden:
            raise NotNative(f"it has no tick in {rig.scenario.name}, so there is nothing to compare its C with")
        return c_of_member(member, golden, drawn, seed, single)
    except NotNative as reason:
        raise ScenarioError(f"{node} cannot be exported as C: {advised(str(reason))}") from None


def advised(reason: str) -> str:
    """Return the reason of a refusal; if it is known what to write instead, that is added."""
    return next(
        (f"{reason}; instead, {text}" for pattern, text in ADVICE.items() if re.search(pattern, reason)), reason
    )


def export_rig(rig: Rig, folder: Path, *, rows: int = ROWS, single: bool = False) -> tuple[Exported, dict[str, str]]:
    """Write all nodes of a rig as C99: one struct, one step a tick, with golden rows of all outputs.

    Parameters
    ----------
    folder : Path
        The files go here.
    rows : int
        Largest number of ticks of the scenario's run that become golden rows.
    single : bool
        ``real_t`` is float.

    Returns
    -------
    Exported
    dict of str to str
        Nodes without readers that were left out because they have no C, and why.

    Raises
    ------
    ScenarioError
        A node that others read has no C.
    """
    try:
        done, left = rig_files(rig, rows, single=single)
    except ScenarioError as reason:
        raise ScenarioError(advised(str(reason))) from None
    write_files(folder, done.files)
    return done, left


def main(arguments: Sequence[str]) -> int:
    """Run the verb."""
    parser = export_parser("c", "Nodes of a scenario as C99, with golden rows and a program that replays them.")
    parser.add_argument(
        "nodes", nargs="*", metavar="NODE", help="of the scenario, with its parameters there; none: the whole rig"
    )
    parser.add_argument("--real", choices=["double", "float"], default="double", help="number type (double)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the files (./NODE)")
    parser.add_argument(
        "--check", action="store_true", help="compile with this machine's compiler and compare bit for bit with Python"
    )
    parser.add_argument("--board", choices=sorted(BOARDS), help=f"check on this core under qemu (Debian: {TOOLS})")
    options = parser.parse_args(arguments)
    rig = rig_of(options.scenario)
    single = options.real == "float"
    status = 0
    for node in options.nodes or [rig.scenario.name]:
        folder = options.out or Path(node)
        if options.nodes:
            done = export_c(rig, node, folder, single=single)
        else:
            done, left = export_rig(rig, folder, single=single)
            for name, reason in left.items():
                print(f"{node}: without {name}, which nobody reads: {reason}")
        print(f"{folder}: {', '.join(done.files)}")
        if done.libm:
            print(f"{node}: bits depend on the C library's {', '.join(done.libm)}")
        if done.ends:
            print(f"{node}: {done.ends}")
        for reason in done.discards:
            print(f"{node}: answers SR_GAVE_UP at {reason}")
        for board in [""] * options.check + [options.board] * bool(options.board):
            result = replayed(folder, done.name, board)
            target = f" on {board}, {result.flash} bytes of flash" if board else ""
            print(f"{node}{target}: {_summary(done, result, single)}")
            status = status or int(not (single or result.same))
    return status


def _summary(done: Exported, result: Replayed, single: bool) -> str:
    if not single:
        differ = f"{result.differing} numbers and {result.wrong_status} statuses differ"
        return f"{result.rows} calls, " + ("the bits of Python" if result.same else differ)
    worst = [
        f"{channel} {error:.2g} of {scale:.2g}"
        for channel, (error, scale) in zip(done.channels, result.errors, strict=True)
        if not error <= NOTED * scale
    ]
    return f"{result.rows} calls in single precision: " + (
        "beyond 1e-3 of their scale are " + ", ".join(worst) if worst else "each channel within 1e-3 of its scale"
    )
