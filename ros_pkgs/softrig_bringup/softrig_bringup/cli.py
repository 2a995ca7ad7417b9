"""The command line: `softrig VERB ...`.

Exit status 0 pass, 1 a metric misses, 2 bad input, 3 the run broke, 4 an error of softrig itself.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softrig_core.guard import guarded, say

if TYPE_CHECKING:
    from collections.abc import Iterator

    from softrig_core.rig.scenario import Scenario
    from softrig_core.rig.simulate import Run

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: sums must not depend on the number of cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb and turn every failure into one line and its exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    return guarded(lambda: _verb(arguments))


def _verb(arguments: list[str]) -> int:
    if arguments and arguments[0] in _FOREIGN:
        import importlib

        module, function, _ = _FOREIGN[arguments[0]]
        return int(getattr(importlib.import_module(module), function)(arguments[1:]))
    options = _parser().parse_args(arguments)
    return int(options.verb(options))


# verbs with their own command line
_FOREIGN = {
    "record": ("softrig_bags.cli", "main_record", "record topics of a running graph into a bag"),
    "play": ("softrig_bags.cli", "main_play", "play a bag back"),
    "compare": ("softrig_bags.cli", "main_compare", "find the first difference between two bags"),
    "bag": ("softrig_bags.cli", "main_bag", "info, repair, export of a bag"),
    "locate": ("softrig_bringup.locate", "main", "locate the fault in a COMTRADE record of a transmission line"),
}
# verbs of scripts/softrig itself, which never get here
_SCRIPT = {
    "setup": "only set up what is missing: .venv from the lock file, .ws by colcon",
    "env": 'print the environment, for a shell of your own: eval "$(scripts/softrig env)"',
    "python": "the Python of the set-up, with everything importable: scripts/softrig python my_script.py",
    "bench": "what the suite costs, as ratios to baselines of the same run; --help names its parts",
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="softrig", description="Closed loops over ROS 2 topics that come out the same every time.",
        epilog="Before the verb: --workspace DIR, also the packages that colcon has built in DIR.",
    )  # fmt: skip
    verbs = parser.add_subparsers(required=True, metavar="VERB")

    def verb(name: str, function: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        sub = verbs.add_parser(name, help=text, description=text)
        sub.set_defaults(verb=function)
        return sub

    verb("list", _list, "list scenarios by system, with duration and title").add_argument(
        "filter", nargs="?", default="", help="only scenarios or systems with this in their name"
    )
    run = verb("run", _run, "run a scenario: metrics, bag, plots, report")
    run.add_argument("scenario", help="name or YAML file")
    run.add_argument("--mode", choices=("processes", "container", "inprocess", "realtime"), default="processes",
                     help="where the nodes live; realtime: processes --realtime")  # fmt: skip
    run.add_argument("--realtime", action="store_true", help="against the wall clock, not in lockstep")
    run.add_argument("--set", action="append", default=[], metavar="NODE.PARAM=VALUE", help="change a parameter")
    run.add_argument("--duration", type=float, metavar="S", help="instead of the scenario's")
    run.add_argument("--seed", type=int, metavar="N", help="instead of the scenario's")
    run.add_argument("--external", action="append", default=[], metavar="NODE", help="somebody else starts this node")
    run.add_argument("--wait", type=float, metavar="S", help="limit of the wait for external nodes (default: none)")
    run.add_argument("--domain", type=int, metavar="N", help="ROS_DOMAIN_ID (default: a free one)")
    run.add_argument(
        "--out", type=Path, metavar="DIR", help="results go here (default runs/SCENARIO and what was changed)"
    )
    run.add_argument("--no-record", action="store_true", help="no bag")
    run.add_argument("--no-plots", action="store_true", help="only metrics.json and the bag")
    node = verb("node", _node, "start one executable, as `ros2 run` does")
    node.add_argument("package")
    node.add_argument("executable")
    node.add_argument("arguments", nargs=argparse.REMAINDER, help="--ros-args ...")
    report = verb("report", _report, "one self-contained HTML page from one or more runs")
    report.add_argument("runs", nargs="+", type=Path, metavar="DIR")
    report.add_argument("--out", type=Path, default=Path("report.html"))
    results = verb("results", _results, "hold every claim of the papers against what is measured now")
    results.add_argument("systems", nargs="*", metavar="SYSTEM", help="default: all")
    results.add_argument("--out", type=Path, default=Path("runs/results"), metavar="DIR",
                         help="results.html and results.md go here (default runs/results)")  # fmt: skip
    results.add_argument("--studies", action="store_true", help="the claims of studies too: hundreds of runs")
    results.add_argument("--workers", type=int, metavar="N", help="processes (default: all cores)")
    study = verb("study", _study, "a scenario over grids, draws, seeds or a search; interrupted, the next call goes on")
    study.add_argument("study", help="name or file of a study, or a scenario; `study list` shows the studies")
    study.add_argument("--grid", action="append", default=[], metavar="NODE.PARAM=A,B,C", help="every combination")
    study.add_argument("--draw", action="append", default=[], metavar="NODE.PARAM=LOW..HIGH", help="drawn uniformly")
    study.add_argument("--draws", type=int, default=100, metavar="N", help="how many points are drawn (100)")
    study.add_argument("--method", choices=("random", "latin_hypercube"), default="latin_hypercube")
    study.add_argument("--search", metavar="FIGURE", help="minimise this figure over what --draw names")
    study.add_argument("--maximise", action="store_true", help="with --search: maximise instead")
    study.add_argument("--seeds", type=int, metavar="N", help="rig seeds 0 to N - 1 of each point")
    study.add_argument("--duration", type=float, metavar="S", help="instead of the scenario's")
    study.add_argument("--figures", nargs="+", default=[], metavar="FIGURE", help="only these")
    study.add_argument("--signals", nargs="+", default=[], metavar="SIGNAL", help="keep and draw these")
    study.add_argument("--out", type=Path, metavar="DIR", help="results go here (default runs/study_NAME)")
    study.add_argument("--workers", type=int, metavar="N", help="processes (default: all cores)")
    study.add_argument("--scheduler", default="", metavar="ADDRESS", help="a Dask cluster instead (tcp://host:8786)")
    golden = verb("golden", _golden, "make golden bags anew and show the difference to the old, or check them")
    golden.add_argument("names", nargs="*", metavar="SCENARIO", help="default: all that are there")
    golden.add_argument("--check", action="store_true", help="only compare; exit status 1 when one differs")
    golden.add_argument("--duration", type=float, metavar="S", help="another length of the golden run")
    golden.add_argument("--seed", type=int, metavar="N", help="another seed")
    golden.add_argument("--bags", type=Path, default=Path("bags"), metavar="DIR", help="where they are")
    new = verb("new", _new, "write a package with a plant, a law, a scenario and tests, to begin with")
    new.add_argument("name", metavar="NAME", help="of the package: lower-case letters, digits and _")
    new.add_argument("--into", type=Path, default=Path(), metavar="DIR", help="where its folder is made (here)")
    completion = verb("completion", _completion, 'completion for bash: eval "$(scripts/softrig completion)"')
    completion.add_argument("--words", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    for name, (_, _, text) in _FOREIGN.items():
        verbs.add_parser(name, help=text)
    for name, text in _SCRIPT.items():
        verb(name, _script, text)
    return parser


def _script(options: argparse.Namespace) -> int:
    from softrig_core.errors import ScenarioError

    raise ScenarioError(f"{', '.join(_SCRIPT)} are verbs of scripts/softrig, which has not been used here")


def _new(options: argparse.Namespace) -> int:
    from .new import main as new

    return new(options.name, options.into)


def _list(options: argparse.Namespace) -> int:
    from .listing import main as listing

    return listing(options.filter)


def _completion(options: argparse.Namespace) -> int:
    from .completion import SCRIPT, candidates

    print(SCRIPT if options.words is None else "\n".join(candidates(_parser(), options.words)))
    return 0


def _run(options: argparse.Namespace) -> int:
    from softrig_core.rig.domain import free_domain

    # before anything of an earlier run is replaced: two runs in one domain would read each other's messages
    with nullcontext() if options.domain is None else free_domain(options.domain):
        return _run_reserved(options)


def _run_reserved(options: argparse.Namespace) -> int:
    from softrig_core.errors import ScenarioError
    from softrig_core.rig.scenario import load_scenario, merge

    from .folder import ResultsFolder
    from .run import checked, execute, save, summary

    if options.realtime and options.mode == "inprocess":
        raise ScenarioError("--realtime: blocks in process know no wall clock; expected --mode processes or container")
    scenario = load_scenario(options.scenario, dict(_assignment(text) for text in options.set))
    changes: dict[str, Any] = {}
    for key in ("duration", "seed"):
        if getattr(options, key) is not None:
            changes[key] = getattr(options, key)
    for name in options.external:
        changes = merge(changes, {"nodes": {name: {"external": True}}})
    if changes:
        scenario = _changed(scenario, changes)
    checked(scenario)  # before anything of an earlier run is replaced
    changed = _changes(options)
    out = (options.out or Path("runs") / _folder_name(scenario.name, options, changed)).absolute()
    folder = ResultsFolder(out)
    if folder.replaced:
        say(f"replacing {folder.replaced} in {os.path.relpath(out)}")
    folder.clear()
    with _progress(scenario) as progress:
        run = execute(scenario, options.mode, out / "log", realtime=options.realtime, domain=options.domain,
                      progress=progress, wait=options.wait,
                      announce=lambda text: print(f"softrig: {text}", file=sys.stderr))  # fmt: skip
    changed += [run.stopped_at] if run.stopped else []
    figures = [] if run.error else run.results
    command = shlex.join(["scripts/softrig", "run", *_repeat(options)])
    content = summary(run, figures, command) | {"changed": changed}
    save(run, content, folder, record=not options.no_record, plots=not options.no_plots)
    if run.error:
        print(f"softrig: the run broke: {run.error}", file=sys.stderr)
        print(f"softrig: what was recorded up to there is in {out}, what the nodes said in its log/", file=sys.stderr)
        return 3
    _print_figures(scenario, run, out, changed)
    if run.stopped:
        say(run.stopped_at)
        return 128 + run.stopped
    if changed:  # the paper's numbers are for its own set-up: shown for comparison, not judged
        return 0
    return 0 if all(f.passed for f in figures) and all(c.holds is not False for c in run.claims) else 1


def _changes(options: argparse.Namespace) -> list[str]:
    """Say what of a scenario was changed on the command line, in words."""
    found = [*options.set, *(f"{name} outside, its parameters unknown" for name in options.external)]
    return found + [f"{name} {value}" for name in ("duration", "seed") if (value := getattr(options, name)) is not None]


def _folder_name(scenario: str, options: argparse.Namespace, changed: Sequence[str]) -> str:
    """Name the folder of a run so that runs that differ do not replace each other."""
    parts = [scenario] + (["realtime"] if options.mode == "realtime" else []) + list(changed)
    return re.sub(r"[^A-Za-z0-9_.=+-]+", "_", "-".join(parts))[:120]


def _repeat(options: argparse.Namespace) -> list[str]:
    """Command-line arguments that repeat a run."""
    arguments = [options.scenario, "--mode", options.mode, *(["--realtime"] if options.realtime else [])]
    for text in options.set:
        arguments += ["--set", text]
    for name in options.external:
        arguments += ["--external", name]
    for name in ("duration", "seed", "domain", "out"):
        if getattr(options, name) is not None:
            arguments += [f"--{name}", str(getattr(options, name))]
    return arguments


def _assignment(text: str) -> tuple[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from softrig_core.errors import ScenarioError

    key, separator, value = text.partition("=")
    if not separator or "." not in key:
        raise ScenarioError(f"--set {text!r}: expected node.parameter=value")
    try:
        return key, YAML(typ="safe", pure=True).load(value)
    except YAMLError as error:
        why = " ".join(str(getattr(error, "problem", error)).split())
        raise ScenarioError(f"--set {text!r}: the value is not valid YAML: {why}") from None


def _changed(scenario: Scenario, changes: dict[str, Any]) -> Scenario:
    from pydantic import ValidationError
    from softrig_core.errors import ScenarioError
    from softrig_core.rig.scenario import merge

    unknown = [n for n in changes.get("nodes", {}) if n not in scenario.nodes]
    if unknown:
        raise ScenarioError(f"--external {unknown[0]}: the nodes are {', '.join(scenario.nodes)}")
    try:
        return type(scenario).model_validate(merge(scenario.model_dump(exclude_unset=True), changes))
    except ValidationError as error:
        first = error.errors()[0]
        raise ScenarioError(f"--{'.'.join(map(str, first['loc']))}: {first['msg']}, got {first['input']!r}") from None


@contextmanager
def _progress(scenario: Scenario) -> Iterator[Callable[[int], None] | None]:
    """A progress bar on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from .listing import console

    columns = (TextColumn(scenario.name), BarColumn(), TextColumn("{task.completed:.3g} of {task.total:.3g} s"),
               TimeElapsedColumn(), TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=console(stderr=True, width=None), transient=True) as bar:
        task = bar.add_task("", total=scenario.duration)
        yield lambda t: bar.update(task, completed=t / 1e9)


def _print_figures(scenario: Scenario, run: Run, out: Path, changed: Sequence[str]) -> None:
    from rich.table import Table

    from .listing import console as make_console
    from .report import accepted

    console = make_console()
    title = f"{scenario.name}: {scenario.title}" + (f", changed: {', '.join(changed)}" if changed else "")
    table = Table("figure", title=title, title_justify="left", box=None, pad_edge=False)
    for name in ("published", "measured", "expected", "unit", ""):
        table.add_column(name, justify="left" if name in ("unit", "") else "right")
    for f in run.results:
        missed = f"[yellow]differs[/] {f.error}" if changed else f"[red]MISS[/] {f.error}"
        mark = ("[green]pass[/]" if f.judged else f.error) if f.passed else missed
        table.add_row(f.name, _number(f.published), _number(f.value), accepted(f), f.unit, mark)
    console.print(table)
    for claim in run.claims:
        if claim.holds is False and not changed:
            console.print(f"[red]claim {claim.key}[/]: {claim.false}")
    ticks = run.rig.ticks
    speed = "" if run.epoch else f" ({scenario.duration / run.wall_s:.3g} x real time)"
    console.print(f"{run.mode}: {ticks} ticks, {scenario.duration:g} s simulated in {run.wall_s:.2f} s with start-up"
                  f"{speed}")  # fmt: skip
    for name, status in run.status.items():
        for _, text, count in status.get("reports", {}).values():
            console.print(f"{name}: {text} ({count} x)")
        for topic, (count, text) in status.get("refused", {}).items():
            console.print(f"{name}: {count} messages refused on {topic}: {text}")
        if "missed_deadlines" in status:
            figures = {k: v for k, v in status.items() if k.endswith("_ms") or k == "missed_deadlines"}
            console.print(f"{name}: " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()))
    console.print(f"results in {os.path.relpath(out)}")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _node(options: argparse.Namespace) -> int:
    from softrig_core.rig.processes import node_main

    return node_main(options.package, options.executable, options.arguments)


def _report(options: argparse.Namespace) -> int:
    from .report import write_report

    write_report(options.runs, options.out)
    print(f"wrote {options.out}")
    return 0


def _results(options: argparse.Namespace) -> int:
    from .results import main as results

    return results(options.systems, options.out, options.workers, studies=options.studies)


def _study(options: argparse.Namespace) -> int:
    from .study.definition import list_studies
    from .study.options import study_of
    from .study.page import main as study

    if options.study == "list":
        print("\n".join(sorted(list_studies())))
        return 0
    chosen = study_of(options)
    out = options.out or Path("runs") / f"study_{chosen.name}"
    return study(chosen, out, workers=options.workers, scheduler=options.scheduler)


def _golden(options: argparse.Namespace) -> int:
    from .golden import main as golden

    return golden(options.names, options.bags, duration=options.duration, seed=options.seed, check=options.check)
