"""The main entry: run a scenario or a rig in this process and read its results."""

from __future__ import annotations

import importlib.metadata
import math
import signal
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from ..bits import kernels
from ..block.held import RunningBlock
from ..errors import Impure, RunError, ScenarioError, closest
from ..extras import need
from ..judge.words import NEVER
from ..rig.members import other_names, signal_units
from ..rig.rig import Rig
from ..scenario.scenario import Draft, Scenario
from ..timebase import SECOND
from ..verdict.figures import Figure, changed_from, evaluate, figures_of, read_by
from ..verdict.findings import Finding, findings, values
from ..verdict.result import Result
from ..wire.recording import Recording
from ..wire.signals import Signals, full_name, topic_of
from .branch import branched, parted
from .expand import rig_of
from .inprocess import run_inprocess
from .live_figures import Measured, is_recorded
from .purity import check_pure, check_same, is_suspect


def _view(name: str) -> Callable[..., Any]:
    """Return a function of the package that draws; the core itself draws nothing."""
    point = next(iter(importlib.metadata.entry_points(group="softrig_views", name=name)), None)
    if point is None:
        raise ScenarioError("pictures need the package softrig_bringup, which is not installed")
    view: Callable[..., Any] = point.load()
    return view


@dataclass(repr=False)
class Run:
    """A finished run.

    Parameters
    ----------
    recording : Recording
        All messages, as a bag holds them: ``softrig_bags.write.write_bag(folder, run.recording)``.
    wall_s : float
        Wall-clock time, with the start and end of processes, s.
    epoch : int
        Wall-clock ns of t = 0 in realtime, else 0.
    status : dict
        The status that each node reported.
    error : str
        Why the run failed; empty when it did not.
    stopped : int
        Number of the signal that ended it before its time; 0 when none did.
    blocks : dict of str to RunningBlock
        The blocks with their final states, after a run in process.
    begun : Rig or None
        For a run that `branch` returned: the rig of the first run, whose changes are the scenario's own.
    wanted : list of Figure, optional
        What `figures_of` returns for the rig, where that is known.
    kernels : mapping of str to str
        After a run in process: those of numpy that this process has, see `softrig_core.bits.kernels`.
    strict : bool
        Whether a changed run is judged by all expectations, including those published for the unchanged machine.
    changed : str
        Description of other changes to the scenario as it is written.
    branched : list of dict
        Times at which the run was rewound: ``at_s``, ``from_s``, and ``left``, where the abandoned branch is stored.
    """

    rig: Rig
    seed: int
    recording: Recording
    wall_s: float = 0.0
    mode: str = "inprocess"
    epoch: int = 0
    status: dict[str, dict[str, Any]] = field(default_factory=dict)
    error: str = ""
    stopped: int = 0
    blocks: Mapping[str, RunningBlock] = field(default_factory=dict)
    begun: Rig | None = None
    wanted: list[Figure] | None = None
    strict: bool = False
    changed: str = ""
    branched: list[dict[str, Any]] = field(default_factory=list)
    kernels: Mapping[str, str] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        """Return the pickled form: the rigs as scenario and classes, without blocks and without values computed
        on demand.
        """
        state = {f.name: getattr(self, f.name) for f in fields(self)} | {"blocks": {}, "wanted": None}
        for name in ("rig", "begun"):
            if (rig := state[name]) is not None:
                state[name] = rig.scenario, rig.classes
        return state

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        rigs = {n: rig_of(stored[0], classes=stored[1]) for n in ("rig", "begun") if (stored := state[n]) is not None}
        self.__dict__.update({**state, **rigs})

    @property
    def stopped_at(self) -> str:
        """Describe the time that an interrupted run reached; empty if it was not interrupted."""
        if not self.stopped:
            return ""
        return f"stopped by {signal.Signals(self.stopped).name} at t = {self.reached_s:.9g} s"

    @property
    def reached_s(self) -> float:
        """Return the time of the newest message, s."""
        return (self.recording.newest(self.epoch) - self.epoch) / SECOND

    @cached_property
    def signals(self) -> Signals:
        """Signals by name ``topic/channel/field``; decoded once."""
        return Signals(self.recording, self.epoch).known_as(other_names(self.rig))

    @cached_property
    def results(self) -> list[Result]:
        """Measure and judge the figures of the scenario; a run that was stopped cannot prove "never".

        For a run that was changed, only figures that follow the machine are judged. The expectations of the others
        are published for the unchanged machine.
        """
        result = evaluate(self.rig, self.signals, self.wanted)
        if not self.strict:
            result = [r.not_judged(self.published_for) for r in result]
        if not self.stopped:
            return result
        late = f"not until {self.reached_s:.9g} s, when the run was stopped"
        return [r.having(error=late, number=math.nan) if r.error == NEVER else r for r in result]

    @cached_property
    def published_for(self) -> str:
        """Return the machine's values for which the scenario's numbers are published; empty for an unchanged run."""
        before = changed_from(self.rig)
        return before or (f"the scenario without {self.changed}" if self.changed else "")

    @property
    def figures(self) -> dict[str, float | None]:
        """Measured value of each figure by name; None for one that could not be measured."""
        return {r.name: r.value for r in self.results}

    @cached_property
    def claims(self) -> list[Finding]:
        """Check the scenario's claims in this run; claims that need another scenario's figures stay open.

        All claims of a changed run stay open as well, because a paper describes its own machine.
        """
        figures, units = values(self.results), {r.name: r.unit for r in self.results}
        name = self.rig.scenario.name
        result = findings(self.rig.scenario, lambda scenario: figures if scenario == name else None, units)
        open_ = bool(self.published_for) and not self.strict
        return [c.having(holds=None) for c in result] if open_ else result

    def __repr__(self) -> str:
        """Describe the run, the time that it reached and the results of its figures."""
        end = self.error or self.stopped_at or f"{self.reached_s:g} s in {self.wall_s:.3g} s"
        judged = [r for r in self.results if r.judged] if not self.error else []
        passed = f", {sum(r.passed for r in judged)} of {len(judged)} figures pass" if judged else ""
        return f"<Run of {self.rig.scenario.name} ({self.mode}, seed {self.seed}): {end}{passed}>"

    def _repr_html_(self) -> str:
        """Figures and pictures, for a notebook."""
        return str(_view("html")(self))

    def plot(self, *names: str, window: tuple[float, float] | None = None) -> Any:
        """Draw signals over time.

        Parameters
        ----------
        *names : str
            Signals, each unit in its own axes; those of the scenario's first plot when there are none.
        window : (float, float), optional
            First and last time, s.

        Returns
        -------
        matplotlib.figure.Figure
            Shown by a notebook; ``figure.savefig("speed.pdf")`` keeps it.

        Raises
        ------
        ScenarioError
            No such signal, or softrig_bringup, which draws, is not installed.
        """
        return _view("plot")(self, names, window)

    def to_pandas(self, topic: str = "") -> Any:
        """Return the signals of a topic, or each signal's newest value at all times of the clock, as a data frame.

        Parameters
        ----------
        topic : str
            All topics when empty.

        Returns
        -------
        pandas.DataFrame
            Index: time in s. Columns: signals by name; ``attrs["units"]`` has their units.

        Raises
        ------
        ScenarioError
            pandas is not installed and could not be added.
        KeyError
            No such topic.
        """
        need("pandas", "to_pandas")
        import pandas

        names = [name for name in self.signals if not topic or name.startswith(f"{topic}/")]
        if not names:
            self.signals.table(topic)
        units = signal_units(self.rig)
        columns = {name: pandas.Series(x, index=t) for name in names for t, x in [self.signals[name]] if t.size}
        frame = pandas.DataFrame(columns).rename_axis("t, s").ffill()
        frame.attrs["units"] = {name: units.get(name, "") for name in columns}
        return frame

    def branch(
        self,
        at: float,
        values: Mapping[str, Any],
        *,
        duration: float | None = None,
        progress: Callable[[int], object] | bool | None = None,
        runs: int = 1,
    ) -> Run:
        """Go back to a time, and continue from there with other parameters.

        Parameters
        ----------
        at, values
            See `softrig_core.run.branch.branched`.
        duration : float, optional
            In s, in place of this run's.
        progress, runs
            See `simulate`.

        Returns
        -------
        Run
            The complete run from t = 0: before `at` its messages are those of this run.

        Raises
        ------
        ScenarioError
            This run did not reach `at`, or a parameter may not change while running.
        RunError
            The new run failed, or differs from this one before `at`: the error names the topic and the time.

        Examples
        --------
        >>> run = simulate("dc_motor_smc")
        >>> softer = run.branch(0.5, {"dc_motor_smc.delta": 0.5})
        """
        begun = self.begun or self.rig
        scenario = begun.scenario.having(changes=branched(begun, self.recording, at, values, self.epoch))
        scenario = scenario.changed(duration=self.rig.scenario.duration if duration is None else duration)
        rig = rig_of(scenario, classes=self.rig.classes)
        result = simulate(rig, seed=self.seed, progress=progress, runs=runs)
        # A run in real time is not repeatable, so only runs in simulated time are compared.
        if diff := "" if self.epoch else parted(self.recording, result.recording, at):
            raise RunError(f"{rig.scenario.name}: what ran up to t = {at:.9g} s is not what had run, first {diff}")
        result.begun = begun
        return result

    @property
    def missed(self) -> list[Result]:
        """The figures that miss their expectations."""
        return [r for r in self.results if not r.passed]


def simulate(
    what: str | Draft | Scenario | Rig,
    *,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Mapping[str, Any] | None = None,
    progress: Callable[[int], object] | bool | None = None,
    runs: int = 1,
    signals: Collection[str] | None = None,
    thorough: bool = False,
) -> Run:
    """Run a scenario or rig in this process: the same numbers and bytes as with nodes over DDS.

    Parameters
    ----------
    what : str, Draft, Scenario or Rig
        Name, file or draft of a scenario, a scenario, or a rig (`Rig.from_blocks` wires one from block objects).
    seed : int, optional
        Instead of the scenario's.
    duration, overrides
        See `rig_of`.
    progress : callable or bool, optional
        Called with the time in ns about a hundred times. True: a bar on a terminal or in a notebook, drawn by
        softrig_bringup.
    runs : int
        Number of runs of this kind that will follow. Many runs, or a very long one, are run natively.
        ``SOFTRIG_JIT=0`` runs all of them in Python; the numbers and bytes are the same.
    signals : collection of str, optional
        Record only nodes that publish one of these or a signal that a figure or requirement reads; all when absent.
    thorough : bool
        Compute the first ticks twice from the same states, and compare also after the run what each block holds beside
        its state x, which no tick may change; a rig with blocks that are not softrig's own runs twice and is compared.
        By default only what blocks hold is compared, after the first ticks of each block class in this process.

    Raises
    ------
    ScenarioError
        Bad input; nothing has run.
    RunError
        A block raised, returned NaN, infinity or a wrong number of values, or changed what it holds beside x.

    Examples
    --------
    >>> run = simulate("dc_motor_smc", overrides={"dc_motor_smc.delta": 0.5})
    >>> run.figures["rise_time"]
    0.6941...
    >>> t, speed = run.signals["motor/state/shaft/velocity"]
    """
    # Observers without outputs are left out of many runs, since these are not watched.
    rig = rig_of(what, duration=duration, overrides=overrides, live=runs == 1)
    number = rig.scenario.seed_of(seed)
    recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
    # A figure that does not fit the rig is an error before the run, not after it.
    wanted = figures_of(rig)
    topics = None if signals is None else _topics(rig, wanted, signals)
    if thorough:
        check_pure(rig, number)
    run = Run(rig, number, recording, wanted=wanted)
    # These nodes would only keep a second copy of what is recorded.
    measured = {m.name: m for m in rig.members if topics is None and runs == 1 and is_recorded(m)}
    started = time.perf_counter()
    bar = _view("progress")(rig.scenario.name, rig.scenario.duration) if progress is True else nullcontext(progress)
    with bar as tell:
        steps = run_inprocess(rig, number, recording, tell or None, runs, topics, thorough, measured)
    run.blocks = steps | {name: Measured(m, number, lambda: run.signals) for name, m in measured.items()}
    run.wall_s = time.perf_counter() - started
    run.kernels = kernels()
    if thorough and is_suspect(rig):
        again = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
        try:
            run_inprocess(rig, number, again, None, runs, topics, without=measured)
        except RunError as error:
            raise Impure(f"a second run of the same parameters and seed does not end as the first: {error}") from None
        check_same(rig, recording, again)
    return run


def _topics(rig: Rig, figures: list[Figure], signals: Collection[str]) -> set[str]:
    """Return the topics of signals, and those that figures and requirements read."""
    units = signal_units(rig)
    # A text is a collection of its letters, so a single name is put into a list.
    wanted = {full_name(name, units) for name in ([signals] if isinstance(signals, str) else signals)}
    if unknown := sorted(wanted - units.keys()):
        near = closest(unknown[0], units)
        raise ScenarioError(f"signals: no signal {unknown[0]!r}{near}; {rig.scenario.name} has {', '.join(units)}")
    read, topics = read_by(figures, units) | wanted, rig.topics
    return {topic_of(name, topics) for name in read}
