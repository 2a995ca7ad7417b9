"""The command line: `softrig VERB ...`.

Exit status 0 pass, 1 a metric misses, 2 bad input, 3 the run broke, 4 an error of softrig itself.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

from softrig_core import ScenarioError
from softrig_core.bits import pin
from softrig_core.command_line import Parser, check_text, without_ros
from softrig_core.errors import RunError, describe
from softrig_core.guard import guarded, print_line, quietly
from softrig_core.needs import join_prefix

from .verbs import declared

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: sums must not depend on the number of cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
pin()  # nor on the type of CPU
join_prefix()

# with a command line of their own: (module, function, text)
FOREIGN = {
    "bag record": ("softrig_bags.cli", "main_record", "record topics of a running graph into a bag"),
    "bag play": ("softrig_bags.cli", "main_play", "play a bag back"),
    "bag compare": ("softrig_bags.cli", "main_compare", "find the first difference between two bags"),
    "bag": ("softrig_bags.cli", "main_bag", "record, play, compare, info, repair, export"),
    "export c": (
        "softrig_core.export.command",
        "main",
        "nodes of a scenario as C99, compared with Python bit for bit",
    ),
    "export arduino": ("softrig_core.firmware.command", "arduino", "a node as an Arduino sketch that joins a rig"),
    "export cortex-m": (
        "softrig_core.firmware.command",
        "cortex_m",
        "a node as firmware of a Cortex-M that joins a rig",
    ),
    "export ads": ("softrig_core.firmware.ads_files", "main", "a program by which a PLC answers the ticks of a node"),
    "export dbc": ("softrig_core.firmware.command", "dbc", "the ports of a node as signals of a CAN bus (a DBC)"),
    "export st": (
        "softrig_core.export.st_files",
        "main",
        "controllers of a scenario as function blocks in structured text, for a PLC",
    ),
    "export": ("softrig_control.fmu.export", "main", "nodes of a scenario as FMUs or C, for other tools"),
}
# of scripts/softrig itself, which never get here
SCRIPT = {
    "setup": "set up what is missing; `setup SET ...` adds to .venv (tables, frames, search, learning, dask, fmu, "
    "view, docs, colcon, test), `setup --fetch DIR` downloads for a set-up without a network",
    "python": "the Python of the set-up, with everything importable: scripts/softrig python my_script.py",
    "docs": "the pages as a site with a search, --serve shows it here; `docs pages` makes their generated parts",
    "bench": "measure what the suite costs, relative to baselines of the same run; --help lists the parts",
}
GROUPS = {
    "run and look": ("run", "view", "report", "draw", "list"),
    "vary": ("study", "falsify"),
    "judge": ("check", "golden"),
    "analyse": ("linearise", "steady"),
    "ROS and bags": ("node", "set", "bag"),
    "own work": ("new", "export", "pack"),
    "set-up": ("setup", "env", "python", "docs", "bench"),
}
VERBS = {verb for verbs in GROUPS.values() for verb in verbs}
# Commands of earlier versions, and those that replace them.
FORMER = {
    "locate": "node softrig_power locate",
    "signals": "list --signals SCENARIO",
    "figures": "list --figures [NAME]",
    "plot": "draw plot RUN",
    "animate": "draw animate RUN|SCENARIO",
    "layouts": "draw layouts SCENARIO",
    "record": "bag record",
    "play": "bag play",
    "compare": "bag compare",
    "completion": "env --completion [bash|zsh|fish]",
    "add": "setup SET",
    "fetch": "setup --fetch DIR",
    "colcon": "env colcon",
    "pages": "docs pages",
}
# verbs and options of other tools, and what they are called here
MEANT = {
    "show": "softrig view RUN",
    "open": "softrig view RUN",
    "info": "softrig bag info RUN",
    "ls": "softrig list",
    "scenarios": "softrig list",
    "topics": "softrig list --signals SCENARIO",
    "params": "softrig list --parameters SCENARIO",
    "test": "softrig check SCENARIO",
    "judge": "softrig check SCENARIO",
    "claims": "softrig check --claims",
    "simulate": "softrig run SCENARIO",
    "sim": "softrig run SCENARIO",
    "start": "softrig run SCENARIO",
    "launch": "softrig run SCENARIO",
    "sweep": "softrig study SCENARIO",
    "optimise": "softrig study SCENARIO --search FIGURE",
    "optimize": "softrig study SCENARIO --search FIGURE",
    "tune": "softrig study SCENARIO --search FIGURE",
    "create": "softrig new NAME",
    "init": "softrig new NAME",
    "zip": "softrig pack RUN",
    "repeat": "softrig run --like RUN",
    "linearize": "softrig linearise SCENARIO",
    "install": "softrig setup",
    "ros2": "softrig env ros2",
}
# These verbs stop in order; others react to signals only where they run a rig.
_STOPPABLE = ("verbs.study_verb", "verbs.check", "verbs.falsify_verb")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb and turn every failure into one line and its exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    # pydantic would read the metadata of all installed packages for plugins, which takes 0.05 s of each command.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    return guarded(lambda: _verb(arguments))


def _verb(arguments: list[str]) -> int:
    asks = "_ARGCOMPLETE" in os.environ  # the shell asks for completions of the last word
    if asks:
        from .terminal import completion

        arguments = completion.asked(FOREIGN)
    check_text(arguments)
    for words in (2, 1):
        if (name := " ".join(arguments[:words])) in FOREIGN:
            import importlib

            module, function, _ = FOREIGN[name]
            remaining = arguments[words:]
            asked = {"-q", "--quiet"} & set(remaining)
            with quietly() if asked else nullcontext():
                return int(getattr(importlib.import_module(module), function)([a for a in remaining if a not in asked]))
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    if arguments == ["version"]:
        arguments = ["--version"]
    if arguments and arguments[0] in FORMER:
        raise ScenarioError(f"`softrig {arguments[0]}` is `softrig {FORMER[arguments[0]]}` now")
    arguments = _judging(arguments)
    if not asks and arguments and not arguments[0].startswith("-") and arguments[0] not in VERBS:
        _check_verb(arguments[0])
    if not asks and arguments[:1] == ["draw"] and len(arguments) > 1:
        _check_drawn(arguments[1])
    if not asks and _of_the_script(arguments):
        return of_the_script()
    if arguments[:1] != ["node"]:
        arguments = without_ros(arguments)
    parser = make_parser("" if asks else arguments[0] if arguments and arguments[0] in VERBS else "none")
    if asks:
        completion.complete(parser)
    options = parser.parse_args(arguments)
    options.words = arguments
    with quietly() if getattr(options, "quiet", False) else nullcontext():
        try:
            return int(options.verb(options))
        except SystemExit as error:  # code of a user may raise it, and its status would then be that of this command
            raise RunError(f"code that `softrig {options.words[0]}` called has ended it: {describe(error)}") from error


def _judging(arguments: list[str]) -> list[str]:
    """Return the present form of the old commands `results` and `golden --check`, which work until 0.4."""
    if arguments[:1] == ["results"]:
        now = ["check", "--claims", *arguments[1:]]
    elif arguments[:1] == ["golden"] and "--check" in arguments:
        now = ["check", "--golden", *(word for word in arguments[1:] if word != "--check")]
    else:
        return arguments
    old = "results" if arguments[0] == "results" else "golden --check"
    print_line(f"`{old}` is `check {now[1]}` now; the old form works until softrig 0.4")
    return now


def _check_verb(word: str) -> None:
    """Refuse a scenario or other name in place of a verb; the message names the verb that accepts it."""
    from difflib import get_close_matches
    from pathlib import Path

    from softrig_core.scenario.scenario_file import find, list_scenarios

    from .folder import kind_of

    path = Path(word)
    kind = kind_of(path)
    if kind == "run":
        raise ScenarioError(f"{word!r} is a run, expected a verb before it: `softrig report {word}`")
    if kind:
        raise ScenarioError(f"{word!r} is a {kind}; its page is {path / 'report.html'}")
    if (path.suffix in (".yaml", ".yml") and path.is_file()) or find(word) is not None:
        raise ScenarioError(f"{word!r} is a scenario, expected a verb before it: `softrig run {word}`")
    if "_" in word and (near := get_close_matches(word, list_scenarios([]), 1)):
        raise ScenarioError(f"{word!r} is no verb and no scenario; did you mean `softrig run {near[0]}`?")


def _check_drawn(word: str) -> None:
    """Refuse `draw RUN` without the kind of drawing, and name the kinds."""
    from pathlib import Path

    from .folder import kind_of

    if kind_of(Path(word)) == "run":
        raise ScenarioError(f"draw: {word!r} is a run; `softrig draw plot {word}` draws its signals")


class _Unasked:
    """Stands for the options of verbs that were not called; declaring those of all verbs takes 10 ms."""

    def __getattr__(self, _: str) -> Any:
        return lambda *_, **__: self


def make_parser(asked: str = "") -> argparse.ArgumentParser:
    """Create the parser of all verbs; those with a command line of their own, or of scripts/softrig, only by name.

    Parameters
    ----------
    asked : str
        The verb whose options are needed, or another word if none are; those of all verbs when empty.
    """
    parser = Parser(
        prog="softrig",
        description="Run closed loops over ROS 2 topics, with the same numbers every time.",
        epilog="Before the verb: --workspace DIR, also the packages in DIR; remembered, until --workspace none.",
        formatter_class=_InGroups,
        meant=MEANT,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print version and commit")
    verbs = parser.add_subparsers(required=True, metavar="VERB")

    def verb(name: str, function: str, text: str, among: Any = verbs, **options: str) -> Any:
        if isinstance(among, _Unasked):
            return among
        if among is verbs and asked not in ("", name):
            among.add_parser(name, help=text, add_help=False)
            return _Unasked()
        sub: argparse.ArgumentParser = among.add_parser(name, help=text, description=text, **options)
        sub.set_defaults(verb=partial(_late, function))
        if name != "node":  # the arguments of `node` belong to the executable
            sub.add_argument(
                "-q",
                "--quiet",
                action="store_true",
                default=argparse.SUPPRESS,
                help="print errors only; the exit status shows the result",
            )
        return sub

    declared.verbs(verb)
    for name, (_, _, text) in FOREIGN.items():
        if " " not in name:
            verbs.add_parser(name, help=text)
    for name, text in SCRIPT.items():
        verb(name, "cli:of_the_script", text)
    return parser


class _InGroups(argparse.HelpFormatter):
    """Lists verbs by group."""

    def _format_action(self, action: argparse.Action) -> str:
        if not isinstance(action, argparse._SubParsersAction):
            return super()._format_action(action)
        by_name = {choice.dest: choice for choice in action._get_subactions()}
        self._indent()
        text = "".join(
            f"\n  {group}\n" + "".join(super(_InGroups, self)._format_action(by_name[name]) for name in names)
            for group, names in GROUPS.items()
        )
        self._dedent()
        return text


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from .run.run import checkout, versions

        commit = checkout().get("commit", "")
        print(f"softrig {versions()['softrig_core']}" + (f", commit {commit}" if commit else ""))
        parser.exit()


def _late(target: str, options: argparse.Namespace) -> int:
    """Import the function of a verb, ``module:function``, and call it."""
    from importlib import import_module

    module, _, name = target.partition(":")
    function = getattr(import_module(f"{__package__}.{module}"), name)
    if module not in _STOPPABLE:
        return int(function(options))
    from softrig_nodes.processes.stopping import stoppable

    with stoppable():
        return int(function(options))


def _of_the_script(arguments: list[str]) -> bool:
    """Return whether a command belongs to scripts/softrig, whatever words follow."""
    word, *more = arguments or [""]
    if word == "env":
        return bool(more) and not more[0].startswith("-")  # `env COMMAND`
    return word.partition("=")[0] == "--workspace" or (word in SCRIPT and not {"-h", "--help"} & set(more))


def of_the_script(_: object = None) -> int:
    """Refuse a command that exists only in a checkout, as part of scripts/softrig."""
    raise ScenarioError(
        f"{', '.join(SCRIPT)}, `env COMMAND` and --workspace need scripts/softrig, which was not used here; "
        "a package of your own must be installed: pip install ./my_rig"
    )


def node(options: argparse.Namespace) -> int:
    """Replace this process by an executable of a package."""
    from softrig_nodes.processes.executables import node_main

    return node_main(options.package, options.executable, options.arguments)


def env(options: argparse.Namespace) -> int:
    """Print the shell code that completes our words; scripts/softrig prints the environment itself."""
    if options.completion is None:
        return of_the_script(options)
    from argcomplete.shell_integration import shellcode

    print(shellcode(["softrig"], shell=options.completion))
    return 0
