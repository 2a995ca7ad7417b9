"""The command line: `softrig VERB ...`.

Exit status 0 pass, 1 a metric misses, 2 bad input, 3 the run broke, 4 an error of softrig itself.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from softrig_core.command_line import Number, Parser, without_ros
from softrig_core.guard import guarded

from .options import run_options
from .verbs import animate, layouts, run_verb, set_verb

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: sums must not depend on the number of cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb and turn every failure into one line and its exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    return guarded(lambda: _verb(arguments))


def _verb(arguments: list[str]) -> int:
    asks = "_ARGCOMPLETE" in os.environ  # a shell, with nothing but this: what may the last word become?
    if asks:
        from .terminal import completion

        arguments = completion.asked(_FOREIGN)
    if arguments and arguments[0] in _FOREIGN:
        import importlib

        module, function, _ = _FOREIGN[arguments[0]]
        return int(getattr(importlib.import_module(module), function)(arguments[1:]))
    if arguments[:1] != ["node"]:
        arguments = without_ros(arguments)
    parser = _parser()
    if asks:
        completion.complete(parser)
    options = parser.parse_args(arguments)
    return int(options.verb(options))


# verbs with their own command line
_FOREIGN = {
    "record": ("softrig_bags.cli", "main_record", "record topics of a running graph into a bag"),
    "play": ("softrig_bags.cli", "main_play", "play a bag back"),
    "compare": ("softrig_bags.cli", "main_compare", "find the first difference between two bags"),
    "bag": ("softrig_bags.cli", "main_bag", "info, repair, export of a bag"),
    "export": ("softrig_control.fmu.export", "main", "nodes of a scenario as FMUs, for other tools"),
    "locate": (
        "softrig_power.fault_location.locate_tool",
        "main",
        "locate the fault in a record of a transmission line",
    ),
}
_STOPPABLE = (
    "verbs.results",
    "study.page",
    "verbs.check",
    "falsify.outcome",
)  # others listen to signals where they run a rig
# verbs of scripts/softrig itself, which never get here
_SCRIPT = {
    "setup": "only set up what is missing: .venv from the lock files, .ws from ros_pkgs",
    "add": "add sets to .venv (tables, frames, search, learning, dask, fmu, view, osqp, docs, colcon, test)",
    "fetch": "fetch DIR: download all packages; SOFTRIG_WHEELS=DIR then sets up without a network",
    "colcon": "colcon of the set-up, for packages of your own: scripts/softrig colcon build",
    "env": 'print the environment, for a shell of your own: eval "$(scripts/softrig env)"',
    "python": "the Python of the set-up, with everything importable: scripts/softrig python my_script.py",
    "docs": "build the pages as a site with a search, in runs/docs; --serve shows it on this host",
    "pages": "make the generated parts, figures and pictures of the doc pages, or check them",
    "bench": "what the suite costs, as ratios to baselines of the same run; --help names its parts",
}


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="softrig", description="Closed loops over ROS 2 topics that come out the same every time.",
        epilog="Before the verb: --workspace DIR, also the packages in DIR; remembered, until --workspace none.",
    )  # fmt: skip
    parser.add_argument("--version", action=_Version, nargs=0, help="print version and commit")
    verbs = parser.add_subparsers(required=True, metavar="VERB")

    def verb(name: str, function: Callable[[argparse.Namespace], int] | str, text: str) -> argparse.ArgumentParser:
        sub = verbs.add_parser(name, help=text, description=text)
        sub.set_defaults(verb=partial(_late, function) if isinstance(function, str) else function)
        return sub

    verb("list", "terminal.listing:main", "list scenarios by system, with duration and title").add_argument(
        "filter", nargs="?", default="", help="only scenarios or systems with this in their name"
    )
    verb(
        "signals",
        "terminal.listing:list_signals",
        "signals of a scenario: unit, message type, who publishes and who reads them",
    ).add_argument("scenario", help="name or YAML file")
    verb(
        "figures", "terminal.listing:list_figures", "functions that figures of a scenario may name, or all about one"
    ).add_argument("name", nargs="?", default="", help="of a function")
    run_options.arguments(verb("run", run_verb.run, "run a scenario: metrics, bag, plots, report"))
    look = verb(
        "view",
        "verbs.view_verb:view",
        "look at a run or a bag in the browser, or run a scenario that begins paused there",
    )
    run_options.arguments(look)
    look.set_defaults(mode="container")
    set_verb.arguments(verb("set", set_verb.set_values, "change live parameters of running nodes: NODE.PARAM VALUE"))
    node = verb("node", _node, "start one executable, as `ros2 run` does")
    node.add_argument("package")
    node.add_argument("executable")
    node.add_argument("arguments", nargs=argparse.REMAINDER, help="--ros-args ...")
    report = verb("report", "report.report:main", "one self-contained HTML page from one or more runs")
    report.add_argument("runs", nargs="+", type=Path, metavar="DIR")
    report.add_argument("--out", type=Path, default=Path("report.html"))
    report.add_argument("--label", action="append", default=[], metavar="TEXT",
                        help="name of a run, in their order (default: its own, or its folder)")  # fmt: skip
    plot = verb("plot", "report.redraw:main", "pictures of a run that is over, for a paper: size, letters, data")
    plot.add_argument("run", type=Path, metavar="DIR", help="of a run, or a bag that a run has written")
    plot.add_argument(
        "signals", nargs="*", metavar="SIGNAL", help="one picture of these (default: the scenario's plots)"
    )
    plot.add_argument("--out", type=Path, default=Path("pictures"), metavar="DIR", help="they go here (pictures)")
    plot.add_argument("--format", choices=("pdf", "svg", "png", "pgf"), default="pdf")
    plot.add_argument("--width", type=Number(float, 20, 1000), metavar="MM", help="width; the height follows")
    plot.add_argument("--font", type=Number(float, 3, 40), metavar="PT", help="size of the letters")
    plot.add_argument("--no-title", action="store_true", help="as figures of a paper have their captions")
    plot.add_argument("--window", type=float, nargs=2, metavar=("FROM", "TO"), help="s")
    plot.add_argument("--csv", action="store_true", help="the data beside each picture, units in the head")
    animate.arguments(verb("animate", animate.animate, "a run's plant in motion: a short SVG, GIF, WebP or PNG"))
    layouts.arguments(verb("layouts", layouts.layouts, "a scenario's plots as layouts for PlotJuggler, Foxglove, RViz"))
    results = verb("results", "verbs.results:main", "hold every claim of the papers against what is measured now")
    results.add_argument("systems", nargs="*", metavar="SYSTEM", help="default: all")
    results.add_argument("--out", type=Path, default=Path("runs/results"), metavar="DIR",
                         help="results.html and results.md go here (default runs/results)")  # fmt: skip
    results.add_argument("--studies", action="store_true", help="the claims of studies too: hundreds of runs")
    results.add_argument("--workers", type=Number(int, 1), metavar="N", help="processes (default: all cores)")
    results.add_argument("--junit", type=Path, metavar="FILE", help="report as JUnit XML")
    results.add_argument("--json", type=Path, metavar="FILE", help="report as JSON")
    study = verb(
        "study",
        "study.page:main",
        "a scenario over grids, draws, seeds or a search; interrupted, the next call goes on",
    )
    study.add_argument("study", help="name or file of a study, or a scenario; `study list` shows the studies")
    study.add_argument("--grid", action="extend", nargs="+", default=[], metavar="NODE.PARAM=A,B,C",
                       help="every combination; also LOW:HIGH:STEP with both ends")  # fmt: skip
    study.add_argument(
        "--draw", action="extend", nargs="+", default=[], metavar="NODE.PARAM=LOW..HIGH", help="drawn uniformly"
    )
    study.add_argument("--draws", type=Number(int, 1), default=100, metavar="N", help="how many points are drawn (100)")
    study.add_argument("--method", choices=("random", "latin_hypercube"), default="latin_hypercube")
    study.add_argument("--search", metavar="FIGURE", help="minimise this figure over what --draw names")
    study.add_argument("--subject-to", action="append", default=[], metavar="'FIGURE <= X'",
                       help="with --search: only runs that keep to it; also >=")  # fmt: skip
    study.add_argument("--maximise", action="store_true", help="with --search: maximise instead")
    study.add_argument("--seeds", type=Number(int, 1), metavar="N", help="rig seeds 0 to N - 1 of each point")
    study.add_argument("--duration", type=float, metavar="S", help="instead of the scenario's")
    study.add_argument("--figures", nargs="+", default=[], metavar="FIGURE", help="only these")
    study.add_argument("--signals", nargs="+", default=[], metavar="SIGNAL", help="keep and draw these")
    study.add_argument("--out", type=Path, metavar="DIR", help="results go here (default runs/study_NAME)")
    study.add_argument("--workers", type=Number(int, 1), metavar="N", help="processes (default: all cores)")
    study.add_argument("--scheduler", default="", metavar="ADDRESS", help="a Dask cluster instead (tcp://host:8786)")
    check = verb(
        "check", "verbs.check:main", "figures, requirements and claims of many scenarios, for continuous integration"
    )
    check.add_argument("scenarios", nargs="+", metavar="SCENARIO", help="names or files")
    check.add_argument("--junit", type=Path, metavar="FILE", help="report as JUnit XML")
    check.add_argument("--json", type=Path, metavar="FILE", help="report as JSON")
    check.add_argument("--workers", type=Number(int, 1), metavar="N", help="processes (default: all cores)")
    falsify = verb(
        "falsify", "falsify.outcome:main", "look for the run that violates a requirement, made small and kept"
    )
    falsify.add_argument("what", metavar="SCENARIO", help="or the name of a falsification in config/studies; `list`")
    falsify.add_argument("--requirement", action="append", default=[], metavar="NAME", help="default: all")
    falsify.add_argument("--over", action="append", default=[], metavar="KEY=A..B",
                         help="NODE.PARAM=a..b, FAULT.PARAM=a..b, 'log a..b', a list or SIGNAL=a..b*6 (steps), "
                              "SIGNAL=a..b~6 (lines), SIGNAL+=a..b*6 (added to it)")  # fmt: skip
    falsify.add_argument("--budget", type=Number(int, 1), metavar="N", help="runs (200)")
    falsify.add_argument("--seed", type=Number(int, 0), metavar="N", help="of the search (0)")
    falsify.add_argument("--sampler", choices=("cmaes", "tpe", "random"), help="after the corners (cmaes)")
    falsify.add_argument("--duration", type=float, metavar="S", help="instead of the scenario's")
    falsify.add_argument("--first", action="store_true", default=None, help="end at the first violation")
    falsify.add_argument("--no-plots", action="store_true", help="scenario files and bags only")
    falsify.add_argument("--out", type=Path, metavar="DIR", help="results go here (default runs/falsify_NAME)")
    falsify.add_argument("--workers", type=Number(int, 1), metavar="N", help="processes (default: all cores)")
    falsify.add_argument("--scheduler", default="", metavar="ADDRESS", help="a Dask cluster instead (tcp://host:8786)")
    linear = verb("linearise", "verbs.linear:linearise", "state space, poles and margins, where a run of a scenario is")
    linear.add_argument("--open", metavar="LINK", help="signal at which to open a loop (the only command of a plant)")
    linear.add_argument(
        "--input", action="append", metavar="SIGNAL", help="input of the state space (what sources say)"
    )
    linear.add_argument("--out", type=Path, metavar="DIR", help="numbers and pictures go here")
    rest = verb("steady", "verbs.linear:print_steady", "the operating point of a scenario; status 1 when there is none")
    for sub in (linear, rest):
        sub.add_argument("scenario", help="name or YAML file")
        sub.add_argument("--at", type=Number(float, 0), metavar="S", help="when (the scenario's end)")
        sub.add_argument("--output", action="append", metavar="SIGNAL", help="signal that counts (what plants say)")
        sub.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="as in run")
    golden = verb("golden", _golden, "make golden bags anew and show the difference to the old, or check them")
    golden.add_argument("names", nargs="*", metavar="SCENARIO", help="default: all that are there")
    golden.add_argument("--check", action="store_true", help="only compare; exit status 1 when one differs")
    golden.add_argument("--duration", type=float, metavar="S", help="another length of the golden run")
    golden.add_argument("--seed", type=int, metavar="N", help="another seed")
    golden.add_argument("--bags", type=Path, default=Path("bags"), metavar="DIR", help="where they are")
    golden.add_argument("--junit", type=Path, metavar="FILE", help="with --check: report as JUnit XML")
    golden.add_argument("--json", type=Path, metavar="FILE", help="with --check: report as JSON")
    new = verb("new", "verbs.new:main", "write a package with a plant, a law, a scenario and tests, to begin with")
    new.add_argument("name", metavar="NAME", help="of the package: lower-case letters, digits and _")
    new.add_argument("--into", type=Path, default=Path(), metavar="DIR", help="where its folder is made (here)")
    words = verb("completion", _completion, 'completion in a shell: eval "$(scripts/softrig completion)"')
    words.add_argument("shell", nargs="?", choices=("bash", "zsh", "fish"), default="bash")
    for name, (_, _, text) in _FOREIGN.items():
        verbs.add_parser(name, help=text)
    for name, text in _SCRIPT.items():
        verb(name, _script, text)
    return parser


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from .run.run import checkout, versions

        commit = checkout().get("commit", "")
        print(f"softrig {versions()['softrig_core']}" + (f", commit {commit}" if commit else ""))
        parser.exit()


def _late(target: str, options: argparse.Namespace) -> int:
    """Call a verb's function, ``module:function``, imported no sooner."""
    from importlib import import_module

    module, _, name = target.partition(":")
    function = getattr(import_module(f"{__package__}.{module}"), name)
    if module not in _STOPPABLE:
        return int(function(options))
    from softrig_core.processes.stopping import stoppable

    with stoppable():
        return int(function(options))


def _script(options: argparse.Namespace) -> int:
    from softrig_core import ScenarioError

    raise ScenarioError(f"{', '.join(_SCRIPT)} are verbs of scripts/softrig, which has not been used here")


def _completion(options: argparse.Namespace) -> int:
    from argcomplete.shell_integration import shellcode

    print(shellcode(["softrig"], shell=options.shell))
    return 0


def _node(options: argparse.Namespace) -> int:
    from softrig_core.processes.executables import node_main

    return node_main(options.package, options.executable, options.arguments)


def _golden(options: argparse.Namespace) -> int:
    from .verbs.golden import main as golden

    return golden(options.names, options.bags, duration=options.duration, seed=options.seed, check=options.check,
                  junit=options.junit, as_json=options.json)  # fmt: skip
