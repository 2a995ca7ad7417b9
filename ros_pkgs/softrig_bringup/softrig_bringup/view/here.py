"""A rig in the process of its page: a `Session` that can be paced, paused, stepped, tuned and moved back in time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from softrig_core import Recording, Rig, Run, RunError, ScenarioError, Session
from softrig_core.block.params import flatten
from softrig_core.guard import print_line, replace
from softrig_core.run.branch import branched
from softrig_core.run.stuck import watched
from softrig_core.scenario.yaml_file import write_yaml
from softrig_core.timebase import Pace, to_ns, to_s
from softrig_core.wire.parameter_event import TOPIC as EVENTS, recorded
from softrig_core.wire.recording import ShardWriter
from softrig_nodes.processes.placement import Placement
from softrig_nodes.processes.stopping import signal_of, unstopped

from ..folder import ResultsFolder
from ..run.run import gaps, status_of
from .control import Answer, Control
from .page import FRAME
from .serve import Pages, new_token
from .sources import Growing, Turned

SLICE = 0.05  # s of ticks before the page is served
REST = 0.01  # s between two checks of the wall clock while ticks wait for it

Conclude = Callable[[Run, ResultsFolder], int]


class SessionSource(Growing):
    """A session as a page shows it.

    Parameters
    ----------
    held : bool
        Whether the run is paused at the start.
    pace : float
        Ratio of simulated to wall-clock time; 0: as fast as possible.
    call : callable
        Called with a function that must run in the thread of the ticks, because Bokeh handles browsers in its own
        threads.
    folder : callable, optional
        Returns the folder of the run; it is called again after the run has gone back to an earlier time. The folder's
        `log` is written while the run continues. If the process is killed, the abandoned branches are also stored
        there. Without `folder` nothing is stored.

    Attributes
    ----------
    branched : list of dict
        Each return to an earlier time, as in `Run.branched`. The abandoned branch is stored as a folder or, if it had
        not ended and was tuned by hand, as a scenario in the folder of the run.
    """

    def __init__(
        self,
        session: Session,
        held: bool,
        pace: float,
        call: Callable[[Callable[[], None]], object] = lambda do: do(),
        folder: Callable[[], Path] | None = None,
    ) -> None:
        super().__init__(session.rig)
        self.session, self._call, self._place = session, call, folder
        self._shard: ShardWriter | None = None
        self._full: OSError | None = None  # why writing into the folder has ended
        self._written: Counter[str] = Counter()  # messages by topic
        self._pace = Pace(pace)
        self._seen: Counter[str] = Counter()  # messages by topic
        self.branched: list[dict[str, Any]] = []
        self._folder = ""  # folder of the newest completed run
        self.control = Control(session.rig, self._ask, lambda: self.end, lambda: self.outcome, held, pace)
        self.control.buttons.clear()  # a press is a message from outside, and a session has no input for it
        self.control.goes_back = True
        session.step()
        self.read_new()

    # requests of the page ------------------------------------------------------------------------------------------

    def _ask(self, request: Mapping[str, Any], answered: Answer) -> None:
        def do() -> None:
            try:
                answered(True, self._do(**request))
            except (ScenarioError, RunError, OSError) as error:
                answered(False, str(error))

        self._call(do)

    def _do(self, node: str, set: Mapping[str, Any] | None = None, call: str = "", back: float | None = None) -> str:
        if back is not None:
            return self._back(back)
        if set is not None and "run.pace" in set:
            self._pace.change(set["run.pace"], time.monotonic())
        elif set is not None:
            self.session.set({f"{node}.{name}": value for name, value in set.items()})
        elif call == "step":
            if not self.control.held:
                raise ScenarioError("the run is not paused; pause it first")
            self._step()
            self._pace.begin()
            return "one step"
        elif call:
            (self._pace.stop if call == "pause" else self._pace.go_on)(time.monotonic())
        return {"pause": "paused", "resume": "goes on"}.get(call, "")

    def _back(self, t: float) -> str:
        """Return to a time (s) and pause there, with the knobs as they are set."""
        session, before = self.session, self.session.t
        left, branch = self._folder if self.outcome else "", None
        if session.undone(t) and not self.outcome and self._place is not None:
            branch = self._keep_branch(self._place())  # written first: if that fails, the run does not go back
            left = branch.name
        try:
            turned = session.rewind(t)
        except RunError:
            if branch:
                branch.unlink()
            raise
        session.set(turned)
        self.branched.append({"at_s": session.t, "from_s": before, "left": left})
        self._pace.begin()
        self.outcome, self.results, self.control.held = "", [], True
        self._tracks, self._newest = {topic: type(track)() for topic, track in self._tracks.items()}, {}
        self._seen.clear()
        self._end_log()
        self.version += 1
        self.read_new()
        for knob in self.control.knobs.values():
            known = flatten(session.steps[knob.node].params)[knob.name]
            knob.value = turned.get(knob.key, known)
        return f"back to {session.t:.9g} s from {before:.9g} s: changes made now apply from there on"

    def _keep_branch(self, folder: Path) -> Path:
        """Write the abandoned branch as a scenario; OSError if it cannot be written."""
        session, path = self.session, folder / f"left_{len(self.branched) + 1}.yaml"
        changes = branched(session.rig, session.recording, self.end, {})
        scenario = session.rig.scenario.having(changes=changes).model_dump(
            mode="json", exclude_defaults=True, exclude={"name", "expect", "claims", "requirements"}
        )  # a run with changed parameters is not judged
        replace(path, write_yaml(scenario))
        return path

    def finish(self, outcome: str, folder: Path | None) -> None:
        """Note that the run is over, and its outcome."""
        super().finish(outcome, folder)
        self._end_log()
        self._folder = str(folder or "")
        self.control.add_entry("the run", outcome)

    # ticks ---------------------------------------------------------------------------------------------------------

    def turn(self) -> float:
        """Run the due ticks for a limited time; return how long the next ones may wait, s."""
        session, until = self.session, time.monotonic() + SLICE
        while not session.over and not self.control.held:
            now = time.monotonic()
            if self._pace.pace and self._pace.reach(now, to_ns(session.t)) is None:
                return REST
            if now > until:
                return 0.0
            self._step()
        return REST

    def _step(self) -> None:
        with suppress(RunError):  # the session has then ended, and reports why
            self.session.step()

    def read_new(self) -> None:
        """Copy new recorded data."""
        session = self.session
        new = Recording(())
        for name, topic in session.recording.topics.items():
            new.topics[name] = topic.since(self._seen[name])
            self._seen[name] += len(new.topics[name].times)
        self.append(new)
        results: list[Turned] = [(to_s(t), node, values) for t, node, values in recorded(session.recording)]
        for change in results:
            if change not in self.changes:
                self.control.log_change(*change)
        self.changes = results
        self.status = {
            name: {
                "state": "failed" if session.error else "done" if session.over else "running",
                "ticks": step.t // step.schedule.time(1),
                **status_of(step),
            }
            for name, step in session.steps.items()
        }
        back = self.branched and session.t <= self.branched[-1]["at_s"]
        # After going back nothing is written until the run has passed the place where it branched.
        if self._place is not None and self._full is None and not back:
            try:
                self._write(self._place)
            except OSError as error:
                self._full = error
                text = f"from here on nothing can be repaired if this process is killed: {error}"
                print_line(text)
                self.control.add_entry("the run", text, True)

    def _write(self, folder: Callable[[], Path]) -> None:
        """Append new messages to a file as nodes do, so that `bag repair` finds them if the process is killed."""
        topics = [topic for name, topic in self.session.recording.topics.items() if name != EVENTS]
        events = self.session.recording.topics.get(EVENTS)
        if self._shard is None:
            (log := folder() / "log").mkdir(exist_ok=True)
            self._shard = ShardWriter(log / "rig.shard", [(topic.name, topic.msgtype) for topic in topics])
        # Changes have the number after those of the topics.
        for number, topic in enumerate([*topics, *([events] if events else [])]):
            new, written = topic.since(self._written[topic.name]), self._written[topic.name]
            messages = [data for part in new.parts() for data in part.messages(written)] or new.data
            for t, data in zip(new.times, messages, strict=True):
                self._shard.add(number, t, data)
            self._written[topic.name] += len(messages)
        self._shard.flush()

    def _end_log(self) -> None:
        if self._shard is not None:
            with suppress(OSError):  # the error has been reported
                self._shard.close()
        self._shard = self._full = None
        self._written.clear()


@watched()
def show_here(rig: Rig, placement: Placement, address: str, folder: ResultsFolder, conclude: Conclude) -> int:
    """Show a rig that runs in this process, until it is over and no browser is connected, or until Ctrl-C.

    A finished run is not overwritten: if the user goes back from its end, the new branch is written to a folder beside
    it.

    Parameters
    ----------
    address : str
        ``host:port``.
    folder : ResultsFolder
        The locked folder of the first run.
    conclude : callable
        Writes a run into a folder and judges it; returns the exit status.
    """
    from tornado.ioloop import IOLoop, PeriodicCallback

    started = time.perf_counter()
    loop = IOLoop.current()
    target_folder: ResultsFolder | None = folder

    def target() -> ResultsFolder:
        nonlocal target_folder
        target_folder = target_folder or _branch_folder(folder.path)
        return target_folder

    source = SessionSource(
        session := Session(rig), placement.paused, placement.pace, loop.add_callback, lambda: target().path
    )
    pages = Pages(source, source.control, str(placement), address, new_token(), loop)
    print_line(f"the page is {pages.url}")
    status, ended = 0, False
    wrong: BaseException | None = None

    def end(stopped: int = 0) -> None:
        nonlocal status, ended, target_folder, wrong
        into = target()
        with unstopped(), into.keeping():
            source.read_new()
            run = session.run
            run.mode, run.wall_s, run.stopped = str(placement), time.perf_counter() - started, stopped
            run.status, run.branched, source.branched = source.status, source.branched, []
            run.error = run.error or ("" if stopped else gaps(rig, run.recording))
            outcome = f"broke: {run.error}" if run.error else run.stopped_at or "ended"
            written: Path | None = into.path
            try:
                status = conclude(run, into)
            except OSError as error:
                # The run is still in memory: with more space, and after going back a little, it can be written.
                status, written = 3, None
                outcome = f"it is not written: {error}; free some space, go back a little and let it end again"
                print_line(outcome)
            except KeyboardInterrupt as interrupt:
                wrong, outcome = interrupt, "stopped while it was written"
                loop.add_callback(loop.stop)
            ended, target_folder = True, None
            source.finish(outcome, written)

    def turn() -> None:
        nonlocal wrong
        try:
            remaining = source.turn()
            if session.over and not source.outcome:
                end()
        except Exception as error:  # the loop would only log the exception, and wait forever
            wrong = error
            loop.stop()
        else:
            loop.call_later(remaining, turn)

    def refresh() -> None:
        if not source.outcome:
            source.read_new()
        pages.measure()
        if pages.left() and source.outcome:
            loop.stop()

    PeriodicCallback(refresh, FRAME).start()
    loop.add_callback(turn)
    try:
        loop.start()
    except KeyboardInterrupt as interrupt:
        if not source.outcome and not (ended and session.t == source.branched[-1]["at_s"]):
            end(signal_of(interrupt))
    finally:
        pages.close()
    if wrong is not None:
        raise wrong
    return status


def _branch_folder(path: Path) -> ResultsFolder:
    """Return a separate folder for a branch of the run in this one."""
    number = 2
    while (candidate := path.with_name(f"{path.name}-{number}")).exists():
        number += 1
    folder = ResultsFolder(candidate)
    folder.clear()
    return folder
