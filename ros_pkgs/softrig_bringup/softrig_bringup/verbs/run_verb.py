"""The verb `run`: the folder of results, the printed output, the exit status."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from softrig_core import Rig, Run, ScenarioError
from softrig_core.command_line import check_text
from softrig_core.extras import need
from softrig_core.guard import plain, print_line
from softrig_core.rig.agreement import assumptions
from softrig_core.solver.solver import UNFINISHED
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment
from softrig_nodes.processes.fork_server import prepare
from softrig_nodes.processes.placement import Listener
from softrig_nodes.processes.stopping import stoppable, unstopped

from ..folder import ResultsFolder
from ..options.repeat import words
from ..options.run_options import begun, changed_words, folder_name, placement_of, repeat, scenario_of
from ..pack.packed import opened
from ..pack.parts import BAG, METRICS, is_pack
from ..pack.trust import admitted
from ..page.wording import NEVER, accepted, in_words, short, spans
from ..run.run import checked, execute, illustrate, once_broken_off, save, summary, tripped, turned
from ..terminal.console import console as make_console, styled
from ..terminal.progress import busy, progress
from ..terminal.tables import Cell, print_judged
from ..view.run_pages import page

if TYPE_CHECKING:
    from rich.console import Console

MISSED = 10.0  # per cent of missed deadlines that are reported


def run(options: argparse.Namespace) -> int:
    """Run a scenario; returns the exit status."""
    # before anything of an earlier run is replaced: two runs in one domain would read each other's messages
    begun: list[ResultsFolder] = []
    try:
        with stoppable(), nullcontext() if options.domain is None or options.only else free_domain(options.domain):
            return _run_reserved(options, begun)
    except KeyboardInterrupt as interrupt:
        # A part of a rig (--only) leaves its shards only.
        if not hasattr(interrupt, "__notes__") and not options.only:
            interrupt.add_note(_lacking(options, begun[0]) if begun else "nothing was run or written")
        raise


def _run_reserved(options: argparse.Namespace, begun: list[ResultsFolder]) -> int:
    if options.realtime and options.mode == "inprocess":
        raise ScenarioError("--realtime: runs in process have no wall clock; expected --mode processes or container")
    if options.view:
        _check_view(options)
    if (status := admitted(options)) is not None:  # packages of a pack have to be installed before any process starts
        return status
    if options.mode != "inprocess":
        # The process starts on another core, while this one reads and checks the scenario.
        prepare(environment(0, Path()))
    scenario = scenario_of(options)
    rig = checked(scenario)  # errors are reported before an earlier run is replaced
    check_text(repeat(options))  # the folder of the call is also checked
    if options.only:
        from ..run.part import run_part

        return run_part(rig, options)
    folder = results_folder(options, rig)
    begun.append(folder)
    log = folder.path / "log"
    placement = placement_of(options)
    if options.view and options.mode == "inprocess":
        from ..view.here import show_here

        return show_here(rig, placement, options.address, folder, lambda run, into: conclude(options, run, into))
    beside = page(scenario, log, placement, options.address)
    with folder.keeping(), beside as shown:

        def opened(domain: int) -> None:
            if options.connect:
                _announce(_how_to_connect(domain, log))
            if options.view:
                shown.open(domain)

        with progress(scenario.name, scenario.duration) as tell:
            done = execute(rig, placement, log, Listener(tell, _announce, opened))
        status = conclude(options, done, folder)
        shown.over(done, folder.path)
        return status


def _check_view(options: argparse.Namespace) -> None:
    """Refuse a rig without a page; import the library."""
    if options.only:
        raise ScenarioError("--only: view needs a whole rig")
    need("bokeh", "view")
    from ..view.serve import free_address

    free_address(options.address)  # errors are reported before an earlier run is replaced


def _how_to_connect(domain: int, directory: Path) -> str:
    """Describe the environment that nodes outside need."""
    result = environment(domain, directory)
    names = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION")
    return "to connect: export " + " ".join(f"{name}={result[name]}" for name in names)


def results_folder(options: argparse.Namespace, rig: Rig) -> ResultsFolder:
    """Clear the folder for the results of a run, and report which files they replace."""
    out = (options.out or Path("runs") / folder_name(rig.scenario.name, options)).absolute()
    before = options.like if options.origin is None else options.origin[0]
    if before is not None and out in (before.absolute(), before.absolute().parent):
        if options.out is not None:
            origin = "--like repeats" if options.origin is None else "--from continues"
            raise ScenarioError(f"--out {options.out}: it holds the run that {origin}, expected another folder")
        out = out.with_name(f"{out.name}-again")
    folder, number = ResultsFolder(out), 1
    if options.out is not None and not options.force and folder.hold() is None and folder.broke:
        folder = _without_broken_run(folder, rig)
    while why := _refusal(folder, rig, options.force):
        if options.out is not None:
            # --force does not replace a folder in which a run still writes.
            forced = ", or --force" if why.endswith(")") else ""
            raise ScenarioError(f"--out {options.out}: {why}; expected another folder{forced}")
        number += 1
        beside = ResultsFolder(out.with_name(f"{out.name}-{number}"))
        print_line(f"{_shown(folder.path)} stays, {why}; this run goes to {_shown(beside.path)}")
        folder = beside
    if folder.replaced:
        print_line(f"replacing {folder.replaced} in {_shown(folder.path)}")
    outside = ", ".join(m.name for m in rig.members if m.external)
    realtime = placement_of(options).clock == "realtime"
    folder.clear(f"{outside} from outside" if outside else "in real time" if realtime else "")
    return folder


def _without_broken_run(folder: ResultsFolder, rig: Rig) -> ResultsFolder:
    """Move a broken run that cannot be repeated out of the way of the next one; return the folder."""
    if not folder.once(lambda shards: once_broken_off(rig, shards)):
        return folder
    number = 1
    while (aside := folder.path.with_name(f"{folder.path.name}-broke-{number}")).exists():
        number += 1
    folder.path.rename(aside)
    folder.let_go()
    print_line(f"the run that broke in {_shown(folder.path)} is kept as {_shown(aside)}")
    return ResultsFolder(folder.path)


def _refusal(folder: ResultsFolder, rig: Rig, force: bool) -> str:
    """Describe why the folder must not be written to; empty if it may be."""
    if (holder := folder.hold()) is not None:
        return f"{holder} is writing there"
    if folder.replaced and not force and (once := folder.once(lambda shards: once_broken_off(rig, shards))):
        folder.let_go()
        return f"its run cannot be made again ({once})"
    return ""


class _Results(NamedTuple):
    """Results of a run: content of metrics.json, whether it repeats another run, and the description of that."""

    content: Mapping[str, Any]
    same: bool
    remarks: Sequence[str]


def conclude(options: argparse.Namespace, done: Run, folder: ResultsFolder | None) -> int:
    """Write the results of a run, print its figures, and judge it.

    Parameters
    ----------
    options : argparse.Namespace
        Of the verb `run`.
    folder : ResultsFolder or None
        Target folder; None: nothing is written.

    Returns
    -------
    int
        Exit status.

    Raises
    ------
    KeyboardInterrupt
        A signal was received; a note of the exception names the results that are missing because of it.
    """
    try:
        with stoppable():
            results = _keep(options, done, folder)
            if slow := too_slow(options, done.rig, done.status, bool(done.error)):
                print_line(slow)
            _print_results(results, done, folder.path if folder is not None else None)
    except KeyboardInterrupt as interrupt:
        interrupt.add_note(_lacking(options, folder))
        raise
    return _judged(options, results, done)


def _lacking(options: argparse.Namespace, folder: ResultsFolder | None) -> str:
    """Describe which results of an interrupted run are missing, and how to make them.

    Parameters
    ----------
    folder : ResultsFolder or None
        None: nothing was to be written.
    """
    if folder is None:
        return "its figures are not judged; run it again"
    path = _shown(folder.path)
    if not (folder.path / METRICS).exists():
        shards = any((folder.path / "log").glob("*.shard"))
        log = shlex.quote(_shown(folder.path / "log"))
        advice = f"; `softrig bag repair {log}` makes a bag of what was recorded" if shards else ""
        return f"no bag, no figures and no pictures are in {path}{advice or '; run it again'}"
    if options.no_plots or (folder.path / "report.html").exists():
        return f"the table was not printed; it is in {path}"
    command = shlex.join(("softrig", "report", path, "--out", f"{path}/report.html"))
    return f"figures and bag are in {path}, pictures and report are not; `{command}` makes a report with them"


def _keep(options: argparse.Namespace, done: Run, folder: ResultsFolder | None) -> _Results:
    """Write the folder and the report for continuous integration."""
    changed = changed_words(options) + turned(done) + ([done.stopped_at] if done.stopped else [])
    changed += [f"branched at {b['at_s']:.9g} s" for b in done.branched]
    done.strict, done.changed = options.strict, ", ".join(text for text in changed if text != done.stopped_at)
    with unstopped():  # a second signal must not lose a recording that is complete
        with busy(f"computing {len(done.rig.scenario.figures)} figures"):
            figures = [] if done.error else done.results
        command = shlex.join([*words((m.package for m in done.rig.members), "run"), *repeat(options)])
        content = summary(done, figures, command, options.label) | {"changed": changed}
        if options.external:  # nodes of the scenario did not run, so its title does not apply
            content["title"] = f"{done.rig.scenario.name} with {', '.join(options.external)} from outside"
        same, messages = True, list[str]()
        if options.origin is not None:
            from ..options.branch import began_as

            same, messages = began_as(options.recalled, done, options.origin[1], content)
            messages = [*_contradictions(options.origin[0]), *messages]
            content["from"] = begun(options)
        elif options.like is not None:
            from ..options.like import compared

            same, messages = compared(options.recalled, done, content)
            messages = [*_contradictions(options.like), *messages]
        if options.recalled is not None:
            content["repeats"] = messages
            same = same or bool(options.recalled.late) or bool(done.epoch)
        if folder is not None:
            with busy(_writing(done, folder)):
                health = options.record_all or done.rig.scenario.record == "all"
                save(done, content, folder, not options.no_record, health)
        if options.junit is not None:
            _write_junit(options, done)
    if folder is not None and not options.no_plots:
        with busy(f"drawing {len(done.rig.scenario.plots)} pictures and the report into {_shown(folder.path)}"):
            illustrate(done, folder, options.format)
    return _Results(content, same, messages)


def _writing(done: Run, folder: ResultsFolder) -> str:
    """Describe which files are written, and what remains of them if this process is killed."""
    messages = sum(topic.number for topic in done.recording.topics.values())
    log = folder.path / "log"
    note = f"; if it is killed, softrig bag repair {_shown(log)} makes the bag" if any(log.glob("*.shard")) else ""
    return f"writing {messages} messages into {_shown(folder.path)}{note}"


def _write_junit(options: argparse.Namespace, done: Run) -> None:
    from ..page.junit import write_junit
    from .check import outcome_of, suite_of

    suite = suite_of(outcome_of(done, done.wall_s))
    if done.stopped:  # a stopped run is not judged
        suite = replace(suite, cases=[replace(case, failure="") for case in suite.cases])
    write_junit(options.junit, [replace(suite, error=suite.error or done.stopped_at)])


def _contradictions(like: Path) -> list[str]:
    """Describe what a pack or a run states about itself that its own bag contradicts."""
    from ..options.identity import contradictions
    from ..report.looked import record_of_pack

    if not is_pack(like):
        return [f"{like}: {contradiction}" for contradiction in contradictions(like)]
    folder = opened(like)
    if not ((folder / BAG).is_dir() and (folder / METRICS).is_file()):
        return []
    try:
        return [f"{like}: {contradiction}" for contradiction in record_of_pack(folder).contradictions]
    except ScenarioError as error:  # the record of the other run is unreadable, but the new run is kept
        return [f"{like}: {error}"]


def _print_results(results: _Results, done: Run, out: Path | None) -> None:
    """Print the figures and the remarks on the run."""
    if done.error:
        print_line(f"the run broke: {done.error}")
        if out is not None:
            print_line(f"what was recorded up to there is in {_shown(out)}, the output of the nodes in its log/")
        return
    _print_figures(results.content, done, out)
    for line in (*assumptions(done.rig.members), *results.remarks):
        print_line(line)
    if done.stopped:
        print_line(done.stopped_at)


def _judged(options: argparse.Namespace, results: _Results, done: Run) -> int:
    """Return the exit status."""
    if done.error:
        return 3
    if done.stopped:
        return 128 + done.stopped
    if options.max_missed is not None and any(share > options.max_missed for share in _missed(done.status).values()):
        return 1
    if not results.same:
        return 1
    return 0 if all(f.passed for f in done.results) and all(c.holds is not False for c in done.claims) else 1


def too_slow(
    options: argparse.Namespace,
    rig: Rig,
    status: Mapping[str, Mapping[str, Any]],
    broken: bool = False,
    container: str = "--mode container",
) -> str:
    """Report that the machine did not keep up, in ticks or in a solver's work.

    If a rig has tripped or failed, every missed deadline counts.
    """
    trips = tripped(rig, status)
    most = MISSED if options.max_missed is None else options.max_missed
    most = 0.0 if trips or broken else most
    late = [f"{node} missed {share:.3g} % of its deadlines" for node, share in _missed(status).items() if share > most]
    faster = f", {container} is faster" if late and options.mode == "processes" else ""
    for node, s in status.items():
        if UNFINISHED in s.get("reports", ()):
            late.append(f"the result of {node} was late at {s['reports'][UNFINISHED][2]} of its ticks")
    if not late:
        return ""
    why = "".join(f", {node}: {text}" for node, text in trips.items())
    return f"the machine did not keep up: {', '.join(late)}{why}; the figures are of a slower loop{faster}"


def _missed(status: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Share of its deadlines that each node has missed in real time, per cent."""
    return {
        name: 100.0 * s["missed_deadlines"] / (s.get("ticks", 0) + s["missed_deadlines"])
        for name, s in status.items()
        if s.get("missed_deadlines")
    }


def _announce(text: str) -> None:
    """Report what a run waits for, complete and with its line breaks: it contains instructions."""
    with suppress(OSError):
        print(f"softrig: {plain(text)}", file=sys.stderr, flush=True)


def _print_figures(content: Mapping[str, Any], run: Run, out: Path | None) -> None:
    console = make_console()
    changed: Sequence[str] = content["changed"]
    title = f"{content['scenario']}: {content['label'] or content['title']}"
    title += f", changed: {', '.join(changed)}" if changed else ""
    console.print(styled((title, "italic")))  # as wide as the terminal, not as the table
    _print_table(console, run)
    _print_remarks(console, run)
    reached, duration = content["reached_s"], content["duration_s"]
    speed = "" if run.epoch or not reached else f" ({reached / run.wall_s:.3g} x real time)"
    share = f" of {duration:g}" if run.stopped else ""
    console.print(
        f"{run.mode}: {content['ticks']} ticks, {reached:.6g}{share} s simulated in {run.wall_s:.2f} s with "
        f"start-up{speed}"
    )
    _print_nodes(console, run)
    if out is not None:
        console.print(f"results in {_shown(out)}")


def _print_table(console: Console, run: Run) -> None:
    published = any(f.published is not None for f in run.results)
    heads = [*(["published"] if published else []), "measured", "expected", "unit"]
    rows: list[list[Cell]] = []
    for f in run.results:
        mark = styled(("pass" if f.judged else "", "green") if f.passed else ("MISS", "red"))
        mark = styled(("not judged", "yellow")) if f.published_for else mark
        row = [*([short(f.published)] if published else []), in_words(f) or short(f.value), accepted(f), f.unit]
        rows.append([f.name, *row, styled("") if run.stopped else mark])
    print_judged(console, ("figure", *heads, ""), rows)


def _print_remarks(console: Console, run: Run) -> None:
    """Print the remarks of figures, requirements and claims that are not in the table."""
    if any(f.published_for for f in run.results):
        console.print(f"not judged: published for {run.published_for} (--strict judges them)")
    for f in run.results:
        if f.error and f.error != NEVER:
            console.print(f"{f.name}: {f.error}")
        if f.violated_s:
            console.print(f"{f.name}: violated {spans(f.violated_s)}; its margin is least at {f.at_s:.6g} s")
        if f.open_from_s is not None:
            console.print(f"{f.name}: from {f.open_from_s:.6g} s on judged as far as the run decides it")
    for claim in run.claims:
        if claim.holds is False:
            console.print(styled((f"claim {claim.key}", "red"), f": {claim.false}"))


def _print_nodes(console: Console, run: Run) -> None:
    """Print the reports, rejections and missed ticks of the nodes."""
    for name, status in run.status.items():
        for _, text, count in status.get("reports", {}).values():
            console.print(f"{name}: {text} ({count} x)")
        for topic, (count, text) in status.get("refused", {}).items():
            console.print(f"{name}: {count} messages refused on {topic}: {text}")
        if "missed_deadlines" in status:
            figures = {k: v for k, v in status.items() if k.endswith("_ms") or k in ("missed_deadlines", "late_ticks")}
            console.print(f"{name}: " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()))


def _shown(path: Path) -> str:
    """Return a path as the reader would type it."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative
