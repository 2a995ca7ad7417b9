"""The command lines of recorder, player, compare and bag; also the executables `recorder` and `player`."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softrig_core.command_line import Number, Parser, repeated
from softrig_core.extras import need
from softrig_core.guard import guarded, plain
from softrig_core.wire.recording import relative
from softrig_nodes.below.leave import leave

from .errors import BagError

if TYPE_CHECKING:
    from softrig_core.block.params import Declaration

Main = Callable[[Sequence[str] | None], int]


def _command(function: Callable[[list[str]], int]) -> Main:
    """Create a main function: errors become one line and an exit status."""

    @wraps(function)
    def main(argv: Sequence[str] | None = None) -> int:
        return guarded(lambda: function(list(sys.argv[1:] if argv is None else argv)))

    return main


def _leaving(tool: Main) -> Main:
    """End the process with the node that a tool has opened; without one the tool returns its status."""

    @wraps(tool)
    def main(argv: Sequence[str] | None = None) -> int:
        status = tool(argv)
        # Looked up and not imported: without an open session the tool needs no ROS.
        ros = sys.modules.get(f"{__package__}.ros")
        if ros is not None and ros.Session.opened is not None:
            leave([ros.Session.opened.node], status)
        return status

    return main


def _ros_arguments(argv: list[str]) -> tuple[list[str], list[str]]:
    """Separate the tool's own arguments from ``--ros-args ... --``."""
    arguments: list[str] = []
    ros: list[str] = []
    target = arguments
    for item in argv:
        if item == "--ros-args":
            target = ros
        target.append(item)
        if item == "--" and target is ros:
            target = arguments
    return arguments, ros


def _parameters(parser: Parser, options: argparse.Namespace) -> list[tuple[Declaration, Any]]:
    """Return the options as ROS parameters, so that a user can query the node for what it is doing."""
    from softrig_core.block.params import Declaration  # with pydantic, which only nodes need

    result = []
    for action in parser._actions:
        value = getattr(options, action.dest, None)
        # An empty list has no type in ROS, and every node declares `use_sim_time` by itself.
        if value is None or value == [] or action.dest == "use_sim_time":
            continue
        value = str(value) if isinstance(value, Path) else value
        bounds = (action.type.low, action.type.high) if isinstance(action.type, Number) else (None, None)
        text = action.help or action.dest
        result.append((Declaration(action.dest, value, type(value), text, "", *bounds), value))
    return result


def _selection_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--regex", "-e", default="", metavar="RE", help="topics whose names match RE")
    parser.add_argument("--exclude", "-x", default="", metavar="RE", help="leave out topics whose names match RE")


def _namespace_argument(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--namespace", default="", metavar="NS", help=text)


def _bag(text: str) -> Path:
    """Return the bag of an argument; that of a run whose folder is named."""
    path = Path(text)
    folder = path / "bag"
    return folder if (path / "metrics.json").is_file() and folder.exists() else path


# verbs and options of other tools, and what they are called here
MEANT = {
    "ls": "softrig bag info BAG",
    "list": "softrig bag info BAG",
    "show": "softrig view BAG",
    "view": "softrig view BAG",
    "plot": "softrig draw plot BAG",
    "convert": "softrig bag export BAG",
    "reindex": "softrig bag repair BAG",
    "diff": "softrig bag compare A B",
}


@_leaving
@_command
def main_record(argv: list[str]) -> int:
    """Record topics into a bag until SIGINT or SIGTERM; exit status 1 when messages are missing, or may be."""
    parser = Parser(
        prog="softrig bag record",
        description="Record topics into a rosbag2 bag until Ctrl-C. Topics are picked up as they appear.",
    )
    parser.add_argument("topics", nargs="*", metavar="TOPIC", help="names (default: all but hidden ones)")
    _selection_arguments(parser)
    _namespace_argument(parser, "only topics in this namespace; TOPIC without a leading slash belongs to it")
    parser.add_argument("--output", "-o", type=Path, metavar="DIR", help="the bag (default rosbag2_DATE-TIME)")
    parser.add_argument("--storage", "-s", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument("--compression", choices=("none", "zstd"), default="none", help="zstd: mcap only")
    parser.add_argument(
        "--max-size", type=Number(float, 0, 1e9), default=0.0, metavar="MB", help="start a new file at this size"
    )
    parser.add_argument(
        "--max-duration", type=Number(float, 0, 1e9), default=0.0, metavar="S", help="start a new file after this time"
    )
    parser.add_argument(
        "--use-sim-time", action="store_true", help="bag time is the header stamp instead of the time of arrival"
    )
    arguments, ros = _ros_arguments(argv)
    options = parser.parse_args(arguments)

    from .files.bag import BagWriter
    from .live.recorder import RESERVE, Recorder
    from .live.ros import Session
    from .live.selection import Selection

    selection = Selection.of(options.topics, options.regex, options.exclude, options.namespace)
    directory = (options.output or Path(time.strftime("rosbag2_%Y_%m_%d-%H_%M_%S"))).absolute()
    writer = BagWriter(
        directory,
        storage=options.storage,
        compression=options.compression,
        reserve=RESERVE,
        split_bytes=round(options.max_size * 1e6),
        split_ns=round(options.max_duration * 1e9),
    )
    try:
        session = Session("recorder", ros, _parameters(parser, options))
    except BagError:
        writer.abort()
        shutil.rmtree(directory)
        raise
    recorder = Recorder(session, writer, selection, options.use_sim_time)
    print(f"recording into {directory}", flush=True)
    recorder.run()
    print(f"{writer.count} messages of {len(writer.topics)} topics in {directory}, {recorder.losses()}")
    return 1 if recorder.lost or recorder.missed or recorder.refused or recorder.holds.gaps else 0


@_leaving
@_command
def main_play(argv: list[str]) -> int:
    """Play a bag against the wall clock, or in lockstep with a node."""
    parser = Parser(
        prog="softrig bag play",
        description="Play a rosbag2 bag: against the wall clock, or in lockstep with a node that answers.",
        epilog="Services while playing: ~/pause, ~/resume, ~/step (std_srvs/Trigger).",
    )
    parser.add_argument("bag", type=_bag)
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC", help="only these (default: all)")
    _selection_arguments(parser)
    parser.add_argument("--remap", nargs="+", default=[], metavar="OLD:=NEW", help="publish under another name")
    parser.add_argument("--start-offset", type=Number(float, 0, 1e9), default=0.0, metavar="S", help="bag time to skip")
    parser.add_argument("--duration", type=Number(float, 1e-9, 1e9), metavar="S", help="bag time to play")
    parser.add_argument("--paused", action="store_true", help="wait for ~/resume or ~/step")
    clocked = parser.add_argument_group("against the wall clock")
    clocked.add_argument("--rate", type=Number(float, 1e-6, 1e6), default=1.0, metavar="R", help="bag seconds a second")
    clocked.add_argument("--loop", action="store_true", help="begin again at the end")
    clocked.add_argument("--clock", action="store_true", help="publish bag time on /clock")
    clocked.add_argument("--wait", action="store_true", help="do not start before every topic has a subscriber")
    lockstep = parser.add_argument_group("in lockstep, as fast as the node answers")
    lockstep.add_argument(
        "--lockstep",
        nargs="+",
        default=[],
        metavar="NODE_TOPIC",
        help="topics that the node under test publishes; the next tick waits for them",
    )
    lockstep.add_argument("--answers", type=Path, metavar="DIR", help="write the node's answers as a bag")
    lockstep.add_argument(
        "--timeout", type=Number(float, 0.1, 1e6), default=30.0, metavar="S", help="wall-clock time without an answer"
    )
    arguments, ros = _ros_arguments(argv)
    options = parser.parse_args(arguments)
    if options.lockstep and (options.loop or options.clock or options.rate != 1.0):
        raise BagError("--rate, --loop and --clock have no meaning with --lockstep: the node sets the pace")
    if options.answers and not options.lockstep:
        raise BagError("--answers needs --lockstep")
    if options.answers and options.answers.exists():
        raise BagError(f"{options.answers} exists already; a bag is never overwritten")

    from .live.play import play

    return play(options, ros, _parameters(parser, options))


@_command
def main_compare(argv: list[str]) -> int:
    """Compare two bags; exit status 0 when they agree, 1 when not."""
    parser = Parser(
        prog="softrig bag compare",
        description="Compare bag B with its reference A, messages paired by stamp; a run in real time with one in "
        "lockstep signal by signal. Exit status 0: they agree, 1: not.",
    )
    parser.add_argument("a", type=_bag, metavar="A")
    parser.add_argument("b", type=_bag, metavar="B")
    parser.add_argument("--abs", type=Number(float, 0), default=0.0, metavar="TOL", help="|b - a| may be up to this")
    parser.add_argument("--rel", type=Number(float, 0), default=0.0, metavar="TOL", help="or up to this times |a|")
    repeated(
        parser,
        "--field",
        "PATTERN=ABS[,REL]",
        "tolerance of the matching signals topic/channel/field; the first match counts",
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these (default: all)")
    repeated(
        parser,
        "--namespace",
        "NS",
        "only topics in this namespace, without its name; twice: for A and for B, / for full names",
    )
    parser.add_argument("--ignore", nargs="+", default=[], metavar="PATTERN", help="topics to leave out")
    parser.add_argument("--bitwise", action="store_true", help="demand equal bytes and bag times")
    parser.add_argument(
        "--align",
        action="store_true",
        help="compare signals over the time since the start: largest and rms deviation, time shift; automatic "
        "if no stamp of A is in B (real time against lockstep)",
    )
    parser.add_argument("--json", action="store_true", help="print everything as JSON")
    options = parser.parse_args(argv)

    from .align import Alignment, align
    from .compare import Comparison, Tolerance, compare
    from .read import signals

    tolerances = {}
    for text in options.field:
        pattern, _, numbers = text.rpartition("=")
        try:
            tolerances[pattern] = Tolerance(*map(Number(float, 0), numbers.split(",")))
        except (argparse.ArgumentTypeError, TypeError):
            raise BagError(
                f"--field {text!r}: expected PATTERN=ABS or PATTERN=ABS,REL, finite and not negative"
            ) from None
    topics = None if options.topics is None else [relative(t) for t in options.topics]
    default = Tolerance(options.abs, options.rel)
    if len(options.namespace) > 2:
        raise BagError("--namespace is expected once, for both bags, or twice, for A and B")
    namespace_a, namespace_b = (options.namespace * 2)[:2] or ("", "")
    if options.align and options.bitwise:
        raise BagError("--align with --bitwise: signals over time have no bytes; expected one of the two")
    result: Alignment | Comparison | None = None
    if not options.align:
        paired = compare(
            options.a,
            options.b,
            default=default,
            tolerances=tolerances,
            bitwise=options.bitwise,
            topics=topics,
            ignore=options.ignore,
            namespaces=(namespace_a, namespace_b),
        )
        result = None if paired.unrelated and not options.bitwise else paired
    if result is None:
        a, b = signals(options.a, namespace_a), signals(options.b, namespace_b)
        result = align(a, b, default=default, tolerances=tolerances, topics=topics, ignore=options.ignore)
    print(result.to_json() if options.json else plain(str(result)))
    return 0 if result.equal else 1


TOOLS = {
    "record": (main_record, "record topics of a running graph"),
    "play": (main_play, "play a bag back"),
    "compare": (main_compare, "find the first difference between two bags"),
}


@_command
def main_bag(argv: list[str]) -> int:
    """Tools for a bag: info, repair, export; record, play and compare have parsers of their own."""
    parser = Parser(
        prog="softrig bag",
        description="Record, play, compare, inspect, repair or export rosbag2 bags.",
        meant=MEANT,
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB", dest="verb")
    for name, (_, text) in TOOLS.items():
        verbs.add_parser(name, help=text)
    if argv and argv[0] in TOOLS:
        return TOOLS[argv[0]][0](argv[1:])
    info = verbs.add_parser("info", help="show the content of a bag")
    info.add_argument("bag", type=_bag)
    mend = verbs.add_parser(
        "repair", help="save the messages after a crash, restore index and metadata; status 1: some are lost"
    )
    mend.add_argument("bag", type=Path, help="bag directory, single file, or directory with shards of a killed run")
    mend.add_argument(
        "--out", type=Path, metavar="DIR", help="new bag (default: repair in place and keep the old one beside it)"
    )
    table = verbs.add_parser("export", help="write signals as tables, one file for each topic")
    table.add_argument("bag", type=_bag)
    _namespace_argument(table, "only topics in this namespace, which file names leave out")
    table.add_argument("--format", choices=("csv", "parquet", "mat"), default="csv")
    table.add_argument("--out", type=Path, metavar="DIR", help="default: BAG_csv, BAG_NS_csv and so on beside the bag")
    options = parser.parse_args(argv)
    if options.verb == "info":
        from .info import describe

        print(plain(describe(options.bag)))
    elif options.verb == "repair":
        need("mcap", "a repair")
        from .repair import repair

        repaired = repair(options.bag, options.out)
        print(plain(str(repaired)))
        return 0 if repaired.complete else 1
    else:
        from .export import export

        bag = options.bag.resolve()
        words = [bag.stem if bag.is_file() else bag.name, *options.namespace.split("/"), options.format]
        target = options.out or bag.with_name("_".join(filter(None, words)))
        for path in export(bag, target, options.format, options.namespace):
            print(os.path.relpath(path))
    return 0
