"""The options of the verb `run`: how they change a scenario and name a run, and how a command repeats them."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from softrig_core import ScenarioError
from softrig_core.command_line import Number, pair, repeated
from softrig_core.kit.file_format import number_of

from .naming import elsewhere, folder_of, from_here, scenario_file

if TYPE_CHECKING:
    from softrig_core import Scenario
    from softrig_core.scenario.scenario import NodeEntry
    from softrig_nodes.processes.placement import Placement


def arguments(parser: argparse.ArgumentParser, scenario: str = "name or YAML file") -> None:
    """Declare the options; `scenario` is the help text of the argument that names the scenario."""
    parser.add_argument("scenario", nargs="?", default="", help=scenario)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument(
        "--like",
        type=Path,
        metavar="RUN",
        help="repeat this run instead of a scenario (its folder, bag or `pack` file), with the changes made "
        "while it ran",
    )
    kind.add_argument(
        "--from",
        type=_moment,
        dest="origin",
        metavar="RUN@T",
        help="continue this run from time T (s) on, with the changes of --set",
    )
    parser.add_argument(
        "--mode",
        choices=("processes", "container", "inprocess"),
        default="processes",
        type=_mode,
        help="each node in a process of its own, all nodes in one container, or blocks in process without ROS",
    )
    parser.add_argument("--realtime", action="store_true", help="run against the wall clock instead of in lockstep")
    repeated(parser, "--set", "NAME=VALUE", "change a parameter (node.parameter) or a shared value", pair)
    parser.add_argument(
        "--params-file", type=Path, metavar="FILE", help="change parameters, in the form of ros2 param dump"
    )
    parser.add_argument(
        "--namespace",
        default="",
        metavar="NS",
        help="namespace of the nodes in --params-file; for a bag: only topics in this namespace",
    )
    parser.add_argument("--duration", type=Number(float, 1e-9, 1e9), metavar="S", help="instead of the scenario's")
    parser.add_argument("--seed", type=Number(int, 0, 2**63 - 1), metavar="N", help="instead of the scenario's")
    repeated(parser, "--external", "NODE", "another process starts this node, not softrig")
    repeated(parser, "--only", "NODE", "start only this node here, the others on another machine; needs --domain")
    parser.add_argument(
        "--wait", type=Number(float, 0, 1e9), metavar="S", help="limit of the wait for these nodes (default: none)"
    )
    parser.add_argument(
        "--restart",
        type=Number(int, 0, 1000),
        default=0,
        metavar="N",
        help="restart a killed node at its last tick, at most N times; needs lockstep and --mode processes",
    )
    parser.add_argument("--domain", type=Number(int, 0, 232), metavar="N", help="ROS_DOMAIN_ID (default: a free one)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results (default: runs/SCENARIO and the changes)"
    )
    parser.add_argument("--force", action="store_true", help="replace a run in DIR even if it cannot be repeated")
    parser.add_argument(
        "--strict", action="store_true", help="judge a changed run also by values published for the unchanged machine"
    )
    parser.add_argument(
        "--max-missed",
        type=Number(float, 0, 100),
        metavar="PERCENT",
        help="in real time: exit with status 1 if a node misses more of its deadlines",
    )
    parser.add_argument("--label", default="", metavar="TEXT", help="name of this run in reports")
    recorded = parser.add_mutually_exclusive_group()
    recorded.add_argument("--no-record", action="store_true", help="do not record a bag")
    recorded.add_argument(
        "--record-all",
        action="store_true",
        help="also record robot_description, diagnostics and figures of observers",
    )
    parser.add_argument(
        "--format", choices=("pdf", "png"), default="", help="write pictures in this format as well as SVG"
    )
    parser.add_argument("--junit", type=Path, metavar="FILE", help="write the verdicts as JUnit XML")
    parser.add_argument("--no-plots", action="store_true", help="write only metrics.json and the bag")
    parser.add_argument("--connect", action="store_true", help="print how to connect your own nodes to the rig")
    parser.add_argument(
        "--trust", action="store_true", help="with --like FILE or --from FILE@T: allow the code in that file to run"
    )
    parser.set_defaults(
        words=(), view=False, paused=False, pace=0.0, address="", recalled=None
    )  # the defaults of options that only the verb `view` declares


def _moment(text: str) -> tuple[Path, float]:
    """Read ``RUN@T``: the folder of a run or its bag, and a time in s."""
    run, _, t = text.rpartition("@")
    start = number_of(t)
    if not run or not 0.0 <= start <= 1e9:
        raise argparse.ArgumentTypeError(f"{text!r}: expected RUN@T, the folder of a run and a time from 0 to 1e9 s")
    return Path(run), start


def _mode(word: str) -> str:
    if word == "realtime":
        raise argparse.ArgumentTypeError("realtime is --realtime now, beside --mode processes or container")
    return word


class Again(argparse.ArgumentParser):
    """Parses a stored command of any version; raises ArgumentError if it does not match.

    Before Python 3.12 argparse ends the process on unknown words, even if `exit_on_error` is false.
    """

    def __init__(self) -> None:
        super().__init__()
        arguments(self)

    def error(self, message: str) -> NoReturn:
        """Raise an ArgumentError."""
        raise argparse.ArgumentError(None, message)


def scenario_of(options: argparse.Namespace) -> Scenario:
    """Return the scenario with the changes of the options."""
    from softrig_core import ScenarioError, load_scenario

    from .grammar import settings

    if options.like is not None or options.origin is not None:
        return _repeated(options)
    if not options.scenario:
        raise ScenarioError("expected a scenario, --like RUN, or --from RUN@T")
    from_file = {}
    if options.params_file is not None:
        from .params_file import params_of

        nodes = load_scenario(options.scenario).nodes
        from_file = params_of(options.params_file, nodes, options.namespace, lambda node, name: _has(nodes[node], name))
    scenario = load_scenario(options.scenario, from_file | settings(options.set, options.scenario))
    changes: dict[str, Any] = {k: v for k in ("duration", "seed") if (v := getattr(options, k)) is not None}
    if options.external:
        changes["nodes"] = scenario.nodes | {n: _external(scenario.nodes, n) for n in options.external}
    return scenario.having(**changes) if changes else scenario


def _external(nodes: Mapping[str, NodeEntry], name: str) -> dict[str, Any]:
    """Return the entry of a node that runs outside."""
    from softrig_core.errors import closest

    if name not in nodes:
        raise ScenarioError(f"--external {name}: no such node{closest(name, nodes)}; the nodes are {', '.join(nodes)}")
    return nodes[name].model_dump(exclude_unset=True) | {"external": True}


def _has(node: NodeEntry, parameter: str) -> bool:
    """Return whether a node declares a parameter; True if its block is not installed here."""
    from softrig_core.block.params import declarations
    from softrig_core.rig.installed import load_block

    try:
        block = load_block(node.package, node.executable)
    except ScenarioError:
        return True
    return any(d.name == parameter for d in declarations(block.Params))


def _repeated(options: argparse.Namespace) -> Scenario:
    """Return the scenario of the run that --like or --from names, with all changes before and during that run."""
    from .branch import continued
    from .grammar import settings
    from .like import recall, repeated

    origin, free = ("--like", ()) if options.origin is None else ("--from", ("set", "duration"))
    for name in ("scenario", "set", "params_file", "namespace", "duration", "seed", "external", "only"):
        if name not in free and getattr(options, name) not in ("", None, []):
            option = name if name == "scenario" else f"--{name.replace('_', '-')}"
            raise ScenarioError(f"{origin} repeats a run as it was: expected no {option} beside it")
    parser = Again()
    if options.origin is None:
        options.recalled = recall(options.like, parser.parse_args)
        return repeated(scenario_of(options.recalled.options), options.recalled)
    path, start = options.origin
    if options.duration is not None and options.duration <= start:
        raise ScenarioError(
            f"--from {path}@{start:g} --duration {options.duration:g}: the run would end before the branch; expected a "
            f"duration above {start:g} s"
        )
    run = options.recalled = recall(path, parser.parse_args)
    scenario = continued(scenario_of(run.options), run, start, settings(options.set))
    return scenario if options.duration is None else scenario.having(duration=options.duration)


def begun(options: argparse.Namespace) -> dict[str, Any]:
    """Describe the run that a run of --from continues, and the command that made the first of them."""
    path, start = options.origin
    first = argparse.Namespace(**vars(options.recalled.options))
    first.duration = first.duration if options.duration is None else options.duration
    return {"run": str(path), "at_s": start, "command": shlex.join(["run", *repeat(first)])}


def placement_of(options: argparse.Namespace) -> Placement:
    """Return the placement of the nodes and their kind of time."""
    from softrig_nodes.processes.placement import Placement

    return Placement(
        options.mode,
        "realtime" if options.realtime else "lockstep",
        options.domain,
        only=options.only,
        wait=options.wait,
        paused=options.paused,
        pace=options.pace,
        restart=options.restart,
    )


def changed_words(options: argparse.Namespace) -> list[str]:
    """Describe the changes of a scenario on the command line."""
    results = [str(options.params_file)] if options.params_file is not None else []
    results += [f"like {options.like}"] if options.like is not None else []
    results += [f"from {options.origin[0]} at {options.origin[1]:.9g} s"] if options.origin is not None else []
    results += [*options.set, *(f"{name} outside, its parameters unknown" for name in options.external)]
    return results + [
        f"{name} {value}" for name in ("duration", "seed") if (value := getattr(options, name)) is not None
    ]


def folder_name(scenario: str, options: argparse.Namespace, only: Sequence[str] = ()) -> str:
    """Name the folder of a run, or of some nodes of one, so that runs that differ do not replace each other."""
    parts = [scenario, *only] + (["realtime"] if options.realtime else [])
    parts += [options.params_file.stem] if options.params_file is not None else []
    parts += [options.namespace.strip("/")] if options.namespace else []
    parts += ["again"] if options.like is not None else []
    parts += [f"from_{options.origin[1]:.9g}"] if options.origin is not None else []
    parts += [*options.set, *(f"external_{name}" for name in options.external)]
    parts += [f"{name}_{value}" for name in ("duration", "seed") if (value := getattr(options, name)) is not None]
    apart = [*elsewhere(options.params_file), *elsewhere(scenario_file(options.scenario))]
    apart += [from_here(options.like)] if options.like is not None else []
    apart += [from_here(options.origin[0]), repr(options.origin[1])] if options.origin is not None else []
    return folder_of(parts, apart)


def repeat(options: argparse.Namespace) -> list[str]:
    """Command-line arguments that repeat a run."""
    from .repeat import scenario_word

    again = [scenario_word(options.scenario)] if options.scenario else []
    again += ["--like", str(options.like.absolute())] if options.like is not None else []
    again += ["--from", f"{options.origin[0].absolute()}@{options.origin[1]!r}"] if options.origin is not None else []
    arguments = [*again, "--mode", options.mode, *(["--realtime"] if options.realtime else [])]
    arguments += ["--params-file", str(options.params_file.absolute())] if options.params_file is not None else []
    arguments += ["--namespace", options.namespace] if options.namespace and options.params_file is not None else []
    for text in options.set:
        arguments += ["--set", text]
    for name in options.external:
        arguments += ["--external", name]
    for name in ("duration", "seed", "domain", "label"):
        if getattr(options, name) not in (None, ""):
            arguments += [f"--{name}", str(getattr(options, name))]
    return arguments + (["--out", str(options.out.absolute())] if options.out else [])
