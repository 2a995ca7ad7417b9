"""The options of all verbs that import nothing until they are called."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from datetime import date
from pathlib import Path

from softrig_core.command_line import Number, pair, repeated

from ..options import run_options
from ..pack.publication import license_of, person, publisher
from ..study import RUNS

ONE = {"surplus": "one scenario at a time; `softrig study ONE --against OTHER` compares two"}
# Called with a name, a function and a text, and with the verb to which a part belongs.
Verb = Callable[..., argparse.ArgumentParser]


def verbs(verb: Verb) -> None:
    """Declare the verbs, in the order of their groups."""
    _run_and_view(verb)
    _vary(verb)
    _judge(verb)
    _analyse(verb)
    _ros(verb)
    new = verb("new", "verbs.new:main", "write a package with a plant, a controller or both, a scenario and tests")
    new.add_argument("name", metavar="NAME", help="of the package: lower-case letters, digits and _")
    new.add_argument(
        "--only", choices=("law", "plant"), help="only a controller (law) for an existing plant, or only a plant"
    )
    new.add_argument(
        "--for",
        dest="scenario",
        metavar="SCENARIO",
        help="with --only law: replace the controller of this scenario, or its node SCENARIO/NODE",
    )
    new.add_argument(
        "--language", choices=("c", "c++", "fortran", "rust"), help="write the controller in this language"
    )
    new.add_argument("--plant", metavar="KIND", help="a rig from a data sheet: pmsm, im, bldc, buck")
    new.add_argument(
        "--rated", nargs="+", default=[], metavar="NAME=VALUE", help="with --plant: its rated values, as speed=3000"
    )
    new.add_argument(
        "--into",
        type=Path,
        default=Path(),
        metavar="DIR",
        help="folder in which the package is created (default: here)",
    )
    pack = verb(
        "pack",
        "verbs.pack:main",
        "write a run and your own packages into one file, which `run --like FILE` repeats elsewhere",
    )
    pack.add_argument("run", type=Path, metavar="RUN", help="folder or bag of a run, or folder of a study")
    pack.add_argument("--out", type=Path, metavar="FILE", help="the new file (SCENARIO.softrig.zip, here)")
    pack.add_argument(
        "--published",
        type=_day,
        default="1980-01-01",  # the date of the files in a pack: packs of the same run have the same bytes
        metavar="DATE",
        help="for archives (RO-Crate): date of publication (1980-01-01)",
    )
    repeated(pack, "--author", "NAME [ORCID]", "for archives: author; repeat it for each one", person)
    pack.add_argument("--publisher", type=publisher, metavar="NAME [URL]", help="for archives: publisher")
    pack.add_argument("--license", type=license_of, metavar="SPDX", help="for archives: licence, as CC-BY-4.0")
    pack.add_argument(
        "--no-bag", action="store_true", help="leave out the recording; a repeated run is then compared by digests"
    )
    pack.add_argument("--sign", type=Path, metavar="KEY", help="sign it with an SSH key (ssh-keygen -Y), as FILE.sig")
    env = verb(
        "env",
        "cli:env",
        'an environment for your shell: eval "$(scripts/softrig env)"; `env COMMAND` runs one '
        "command in it, colcon too; `env --completion`: completion for your shell",
    )
    env.add_argument("--completion", nargs="?", const="bash", choices=("bash", "zsh", "fish"))


def _run_and_view(verb: Verb) -> None:
    run_options.arguments(verb("run", "verbs.run_verb:run", "run a scenario: metrics, bag, plots, report", **ONE))
    view = verb(
        "view",
        "verbs.view_verb:view",
        "show a run or a bag in the browser, or run a scenario there that starts paused",
        **ONE,
    )
    run_options.arguments(view, "name or YAML file; or a run: its folder, its bag, or a file of `pack`")
    view.add_argument(
        "--address",
        default="127.0.0.1:0",
        metavar="HOST:PORT",
        help="address of the page (default: this host, a free port); the page needs the token that its "
        "address contains",
    )
    view.add_argument("--running", action="store_true", help="start the run without a pause")
    view.add_argument(
        "--pace",
        type=_pace,
        default=1.0,
        metavar="X",
        help="ratio of simulated to wall-clock time: 1 (default), "
        "0.1, 10, ..., or full: as fast as possible; the page can change it",
    )
    view.set_defaults(mode="container")
    report = verb("report", "verbs.report_verb:main", "one self-contained HTML page from one or more runs")
    report.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of a run, or a file of `pack`")
    report.add_argument("--out", type=Path, default=Path("report.html"))
    report.add_argument(
        "--table", type=Path, metavar="FILE", help="figures of the runs as LaTeX (.tex, booktabs) or .csv, for a paper"
    )
    repeated(report, "--label", "TEXT", "name of a run, in the order of the runs (default: its own, or its folder)")
    draw = verb("draw", "cli:main", "pictures of a run for a paper, its plant in motion, layouts for other viewers")
    drawings = draw.add_subparsers(required=True, metavar="WHAT")
    text = "pictures of a finished run for a paper, with a given size and font"
    plot = verb("plot", "verbs.plot_verb:main", text, drawings)
    plot.add_argument(
        "what",
        nargs="+",
        metavar="RUN|SIGNAL",
        help="folder of a run, its bag, or a file of `pack`; of several runs the common plots, overlaid. Signals: "
        "one picture of these (default: the scenario's plots)",
    )
    plot.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for the pictures (default: RUN/pictures; for several runs: pictures/NAMES)",
    )
    plot.add_argument(
        "--style",
        choices=("ieee", "elsevier", "springer", "serif"),
        default="",
        help="width, font and title as the publisher requires",
    )
    plot.add_argument("--columns", choices=("1", "2"), default="1", help="with --style: width in columns (1)")
    plot.add_argument("--namespace", default="", metavar="NS", help="of a bag: only topics in it, named without it")
    repeated(plot, "--label", "TEXT", "name of a run, in the order of the runs")
    plot.add_argument("--format", choices=("pdf", "svg", "png", "pgf"), default="pdf")
    plot.add_argument("--width", type=Number(float, 20, 1000), metavar="MM", help="width; the height follows")
    plot.add_argument("--font", type=Number(float, 3, 40), metavar="PT", help="font size")
    plot.add_argument(
        "--no-title", action="store_true", help="leave out the title, as figures of a paper have captions"
    )
    plot.add_argument("--window", type=Number(float, -1e9, 1e9), nargs=2, metavar=("FROM", "TO"), help="s")
    plot.add_argument(
        "--csv", action="store_true", help="write the data of each picture as well, with units in the header"
    )
    animate = verb(
        "animate", "verbs.animate:animate", "animation of a run's plant: a short SVG, GIF, WebP or PNG", drawings
    )
    animate.add_argument(
        "what",
        metavar="RUN|SCENARIO",
        help="folder or bag of a run, or a scenario, which is then run in process",
    )
    animate.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="FILE",
        help="default: SCENARIO.svg; .gif, .webp or .png (animated) for programs without SVG",
    )
    animate.add_argument(
        "--from", dest="start", type=Number(float, 0, 1e9), metavar="S", default=0.0, help="first time, s"
    )
    animate.add_argument("--to", dest="end", type=Number(float, 0, 1e9), metavar="S", help="last time, s (the end)")
    animate.add_argument(
        "--speed",
        type=Number(float, 1e-9, 1e9),
        metavar="X",
        help="simulated seconds for one second of film (default: a film of 4 to 8 s)",
    )
    text = "a scenario's plots as layouts for PlotJuggler, Foxglove, RViz"
    layouts = verb("layouts", "verbs.layouts:layouts", text, drawings)
    layouts.add_argument("scenarios", nargs="+", metavar="SCENARIO", help="names or files")
    layouts.add_argument(
        "--out", type=Path, default=Path("layouts"), metavar="DIR", help="folder for the layouts (layouts)"
    )
    listed = verb("list", "verbs.list_verb:main", "scenarios by system, with duration and title; signals, figures")
    listed.add_argument("filter", nargs="?", default="", help="only scenarios or systems with this in their name")
    listed.add_argument(
        "--signals",
        metavar="SCENARIO",
        help="signals of a scenario: unit, message type, publisher and subscribers",
    )
    listed.add_argument(
        "--parameters",
        metavar="SCENARIO",
        help="parameters of a scenario: value, unit, bounds, whether they may change during a run, description",
    )
    listed.add_argument(
        "--figures",
        nargs="?",
        const="",
        metavar="NAME",
        help="figure functions for scenarios, or the documentation of one",
    )


def _day(text: str) -> str:
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a date as 2026-11-28, got {text!r}") from None


def _pace(word: str) -> float:
    return 0.0 if word == "full" else Number(float, 0.001, 1000)(word)


def _vary(verb: Verb) -> None:
    study = verb(
        "study",
        "verbs.study_verb:main",
        "a scenario over grids, draws, seeds or a search; the next call resumes an interrupted study",
        **ONE,
    )
    study.add_argument(
        "study", nargs="?", default="", help="name or file of a study, or a scenario; `study list` shows the studies"
    )
    study.add_argument("--like", type=Path, metavar="FILE", help="repeat the study of a `pack` file, row by row")
    study.add_argument("--trust", action="store_true", help="with --like FILE: allow the code in that file to run")
    repeated(
        study,
        "--grid",
        "NAME=A,B,C",
        "run every combination of these values; also LOW:HIGH:STEP, both ends included",
        pair,
    )
    repeated(
        study,
        "--draw",
        "NAME=LOW..HIGH",
        "draw values uniformly; also 'log LOW..HIGH', LOW..HIGH*N for a list, or one of A,B,C",
        pair,
    )
    repeated(
        study,
        "--against",
        "SCENARIO|NAME=VALUE",
        "compare with another scenario, or with this one changed, at the same draws and seeds",
        pair,
    )
    study.add_argument("--draws", type=Number(int, 1, RUNS), metavar="N", help="number of points to draw (100)")
    study.add_argument(
        "--method",
        choices=("random", "latin_hypercube", "sobol"),
        default="latin_hypercube",
        help="how to draw; sobol needs a power of two of points (128)",
    )
    study.add_argument(
        "--sensitivity",
        action="store_true",
        help="estimate Sobol' indices of the parameters of --draw by N (parameters + 2) runs; N is a power of "
        "two (128)",
    )
    study.add_argument("--search", metavar="FIGURE", help="minimise this figure over the parameters of --draw")
    repeated(
        study,
        "--subject-to",
        "'FIGURE <= X'",
        "report how often this holds; with --search: accept only runs that satisfy it; also >=",
    )
    study.add_argument("--maximise", action="store_true", help="with --search: maximise instead")
    study.add_argument("--seeds", type=Number(int, 1, RUNS), metavar="N", help="run each point with seeds 0 to N - 1")
    repeated(
        study,
        "--width",
        "FIGURE=W",
        "report how many runs a 95 %% interval of this width needs; also for a requirement or a --subject-to",
        pair,
    )
    study.add_argument("--force", action="store_true", help="run several seeds even if no random number has an effect")
    study.add_argument(
        "--strict", action="store_true", help="judge changed runs also by values published for the unchanged machine"
    )
    study.add_argument("--duration", type=Number(float, 1e-9, 1e9), metavar="S", help="instead of the scenario's")
    study.add_argument("--figures", nargs="+", default=[], metavar="FIGURE", help="only these")
    study.add_argument("--signals", nargs="+", default=[], metavar="SIGNAL", help="keep and plot these signals")
    study.add_argument(
        "--format", choices=("pdf", "png"), default="", help="write pictures in this format as well as SVG"
    )
    study.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results (runs/study_NAME and the varied parameters)"
    )
    _workers(study)
    falsify = verb(
        "falsify",
        "verbs.falsify_verb:main",
        "search for a run that violates a requirement; the violation is reduced and stored",
    )
    falsify.add_argument("what", metavar="SCENARIO", help="or the name of a falsification in config/studies; `list`")
    repeated(
        falsify,
        "--requirement",
        "NAME",
        "requirement to violate, or a figure with an expected bound (default: all requirements that "
        "follow the machine)",
    )
    falsify.add_argument(
        "--strict",
        action="store_true",
        default=None,
        help="also requirements with values published for the unchanged machine",
    )
    repeated(
        falsify,
        "--over",
        "NAME=LOW..HIGH",
        "search over a parameter of a node or fault, or over a signal; also 'log LOW..HIGH'; LOW..HIGH*N "
        "for a list or the steps of a signal, LOW..HIGH~N for its lines, SIGNAL+=LOW..HIGH*N to add to it",
        pair,
    )
    falsify.add_argument("--budget", type=Number(int, 1, RUNS), metavar="N", help="runs (200)")
    falsify.add_argument("--seed", type=Number(int, 0, 2**63 - 1), metavar="N", help="seed of the search (0)")
    falsify.add_argument(
        "--sampler", choices=("cmaes", "tpe", "random"), help="search method after the corners (cmaes)"
    )
    falsify.add_argument("--duration", type=Number(float, 1e-9, 1e9), metavar="S", help="instead of the scenario's")
    falsify.add_argument("--first", action="store_true", default=None, help="stop at the first violation")
    falsify.add_argument(
        "--format", choices=("pdf", "png"), default="", help="write pictures in this format as well as SVG"
    )
    falsify.add_argument("--no-plots", action="store_true", help="write only scenario files and bags")
    falsify.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: runs/falsify_NAME)")
    _workers(falsify)


def _workers(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--workers", type=Number(int, 1, 1000), metavar="N", help="processes (default: all cores)")
    parser.add_argument(
        "--scheduler", default="", metavar="ADDRESS", help="use a Dask cluster instead (tcp://host:8786)"
    )


def _judge(verb: Verb) -> None:
    check = verb(
        "check",
        "verbs.check:main",
        "judge many scenarios, for continuous integration: their expectations, claims of papers, golden bags",
    )
    check.add_argument(
        "scenarios",
        nargs="*",
        metavar="SCENARIO",
        help="names or files; with --claims systems or shipped scenarios",
    )
    group = check.add_mutually_exclusive_group()
    group.add_argument("--claims", action="store_true", help="check the claims of the papers (default: of all systems)")
    group.add_argument("--golden", action="store_true", help="check golden bags, see `golden` (default: all)")
    check.add_argument(
        "--against",
        default="",
        metavar="FILE",
        help="judge by the figures and expectations of this scenario; also names other differences",
    )
    check.add_argument(
        "--marks", type=Path, metavar="FILE", help="write a CSV row for each scenario: how much holds, and each value"
    )
    check.add_argument(
        "--html", type=Path, metavar="FILE", help="write the report as an HTML page, with the reason of each failure"
    )
    check.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="with --claims: folder for results.html and .md, or results_SYSTEM.html (runs/results)",
    )
    check.add_argument(
        "--studies", action="store_true", help="with --claims: also claims of studies (hundreds of runs)"
    )
    golden = verb("golden", "verbs.golden:main", "record golden bags and show the difference; `check --golden` judges")
    golden.add_argument("names", nargs="*", metavar="SCENARIO", help="scenarios (default: all with a golden bag)")
    golden.add_argument("--differing", action="store_true", help="record again only the bags that differ")
    golden.add_argument(
        "--duration", type=Number(float, 1e-9, 1e9), metavar="S", help="another duration of the golden run"
    )
    golden.add_argument("--seed", type=Number(int, 0, 2**63 - 1), metavar="N", help="another seed")
    for parser, prefix in ((check, "with --golden: "), (golden, "")):
        parser.add_argument(
            "--with", dest="node", metavar="NODE", help=f"{prefix}only scenarios with a node of this name or executable"
        )
        parser.add_argument("--bags", type=Path, metavar="DIR", help="folder of the bags (bags)")
    check.add_argument("--workers", type=Number(int, 1, 1000), metavar="N", help="processes (default: all cores)")
    check.add_argument("--junit", type=Path, metavar="FILE", help="write the report as JUnit XML")
    check.add_argument("--json", type=Path, metavar="FILE", help="write the report as JSON")


def _analyse(verb: Verb) -> None:
    linear = verb("linearise", "verbs.linear:linearise", "state space, poles and margins at a time of a scenario's run")
    linear.add_argument("--open", metavar="LINK", help="signal at which to open a loop (the only command of a plant)")
    linear.add_argument(
        "--input", action="append", metavar="SIGNAL", help="input of the state space (outputs of sources)"
    )
    linear.add_argument("--out", type=Path, metavar="DIR", help="folder for numbers and pictures")
    linear.add_argument(
        "--along",
        type=Number(int, 1, 10_000),
        metavar="N",
        help="matrices at each of N periods from --at on, for a rig in motion or outputs that rotate",
    )
    remaining = verb(
        "steady",
        "verbs.linear:print_steady",
        "find the operating point of a scenario; exits with status 1 if there is none",
    )
    for sub in (linear, remaining):
        sub.add_argument("scenario", help="name or YAML file")
        sub.add_argument(
            "--at", type=Number(float, 0, 1e9), metavar="S", help="time in s (default: the scenario's end)"
        )
        sub.add_argument(
            "--output",
            action="append",
            metavar="SIGNAL",
            help="output signal (default: outputs of plants)",
        )
        repeated(sub, "--set", "NAME=VALUE", "as in run", pair)


def _ros(verb: Verb) -> None:
    node = verb("node", "cli:node", "start one executable, as `ros2 run` does")
    node.add_argument("package")
    node.add_argument("executable")
    node.add_argument("arguments", nargs=argparse.REMAINDER, help="--ros-args ...")
    live = verb("set", "verbs.set_verb:set_values", "change live parameters of running nodes: NODE.PARAM VALUE")
    live.add_argument(
        "values", nargs="+", metavar="NODE.PARAM VALUE", help="several values of one node: all are set, or none"
    )
    live.add_argument(
        "--domain", type=Number(int, 0, 232), metavar="N", help="ROS_DOMAIN_ID (default: that of the environment)"
    )
    live.add_argument(
        "--wait", type=Number(float, 0, 1e9), default=10.0, metavar="S", help="how long to wait for the node, s (10)"
    )
