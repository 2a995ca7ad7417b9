"""A run in this process that advances on request, and can return to any tick and continue with other parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from ..block.block import Block
from ..block.loop import Loop
from ..block.params import ParameterError
from ..block.tables import Moment, Tables
from ..errors import RunError, ScenarioError, closest
from ..rig.contents import StartContents
from ..rig.rig import Rig
from ..scenario.scenario import Scenario
from ..solver.solver import Solver
from ..timebase import SECOND, to_ns
from ..wire.recording import Recording
from .expand import rig_of
from .inprocess import check_here, record, wired
from .simulate import Run

# So many states at most are kept to go back to; the ticks from the nearest one are computed again.
KEPT = 256


class _Turned(NamedTuple):
    """New values of parameters of a node, set before tick k."""

    k: int
    node: str
    values: Mapping[str, Any]


class Session:
    """A run in progress.

    Parameters
    ----------
    what, duration, overrides
        See `rig_of`.
    seed : int, optional
        Instead of the scenario's.

    Attributes
    ----------
    rig : Rig
    seed : int
    recording : Recording
        All messages up to here.
    steps : dict of str to Step
        The current steps of the members.
    error : str
        Why the run failed; empty while it has not.

    Raises
    ------
    ScenarioError
        Bad input, or a node of the rig is external.

    Examples
    --------
    >>> session = Session("dc_motor_smc")
    >>> session.go(0.5)
    >>> session.set({"dc_motor_smc.delta": 0.5})
    >>> session.go()
    >>> softer = session.run
    >>> session.rewind(0.5)
    >>> session.go()  # as if nothing had been set
    """

    def __init__(
        self,
        what: str | Scenario | Rig,
        *,
        seed: int | None = None,
        duration: float | None = None,
        overrides: Mapping[str, Any] | None = None,
    ) -> None:
        self.rig = rig_of(what, duration=duration, overrides=overrides)
        check_here(self.rig)
        self.seed = self.rig.scenario.seed_of(seed)
        self._turned: list[_Turned] = []
        self._kept: dict[int, Moment] = {}
        # The reason why no state can be kept, if so; the run itself is not affected.
        self._why = ""
        self._begin(
            {m.name: m.block(self.seed) for m in self.rig.members},
            Recording((topic, port.msgtype) for topic, port in self.rig.topics.items()),
        )
        self._contents = StartContents(self.steps)
        self._every = max(1, self.ticks // KEPT)
        self._keep()

    def _begin(self, blocks: dict[str, Block], recording: Recording, k: int = 0, moment: Moment | None = None) -> None:
        """Wire the blocks, and continue from tick k."""
        self.recording, self._k, self.error = recording, k, ""
        self.steps = wired(self.rig, blocks)
        record(self.rig, self.steps, recording)
        self._tables = Tables(self.steps.values())
        if moment is not None:
            self._tables.go_back(moment)
        self._loop = Loop(list(self.steps.values()))
        self._answered: Iterator[int | None] = self._loop.run(k)

    @property
    def ticks(self) -> int:
        """Number of the last tick; ticks at which no node is due are not counted."""
        assert self._loop.plan.ticks is not None
        return self._loop.plan.ticks

    @property
    def t(self) -> float:
        """Time of the next tick, s; of the last one when the run is over."""
        return self._loop.plan.clock.time(min(self._k, self.ticks)) / SECOND

    @property
    def over(self) -> bool:
        """Return whether the run has ended: the last tick is answered, or a block failed."""
        return bool(self.error) or self._k > self.ticks

    @property
    def run(self) -> Run:
        """Return the run up to the current time; later ticks are not added to it."""
        t = self._loop.plan.clock.time(self._k)
        return Run(self.rig, self.seed, self.recording.before(t), error=self.error, blocks=dict(self.steps))

    def step(self, ticks: int = 1) -> None:
        """Run a number of ticks, fewer if the run ends before.

        Raises
        ------
        RunError
            A block failed, or returned an invalid output. The run is over then; `rewind` restores an earlier tick.
        """
        self._answer(min(self._k + ticks, self.ticks + 1))

    def go(self, t: float | None = None) -> None:
        """Run all ticks before t (s), by default all that remain; see `step`."""
        self._answer(self.ticks + 1 if t is None else self._tick(t))

    def _answer(self, until: int) -> None:
        try:
            while self._k < until and not self.error:
                t = next(self._answered)
                self._k += 1
                if t is not None and t >= self._contents.due:
                    self._contents.check(t)
                if self._k % self._every == 0:
                    self._keep()
        except RunError as error:
            self.error = str(error)
            raise
        finally:
            if self.over:
                self._release_solvers()

    def _release_solvers(self) -> None:
        for step in self.steps.values():
            if isinstance(step.block, Solver):
                step.block.release()

    def set(self, values: Mapping[str, Any]) -> None:
        """Change parameters from the next tick on, all or none of each node.

        Parameters
        ----------
        values : mapping
            ``node.parameter`` to value; only of parameters that may change while running.

        Raises
        ------
        ScenarioError
            No such node or parameter, a bad value, or one that may not change.
        """
        by_node: dict[str, dict[str, Any]] = {}
        for key, value in values.items():
            node, _, name = key.partition(".")
            if node not in self.steps or not name:
                raise ScenarioError(
                    f"{key!r}{closest(node, self.steps)}: expected node.parameter with node one of "
                    f"{', '.join(self.steps)}"
                )
            by_node.setdefault(node, {})[name] = value
        for node, params in by_node.items():
            try:
                self.steps[node].set(params)
            except (ParameterError, ValueError) as error:
                raise ScenarioError(f"node {node}: {error}") from None
            self._turned.append(_Turned(self._k, node, params))

    def undone(self, t: float) -> dict[str, Any]:
        """Return what going back to t (s) would undo: ``node.parameter`` to its newest value, in the form of `set`.

        Raises
        ------
        ScenarioError
            The run has not reached that time.
        """
        k = self._past(t)
        return {
            f"{turned.node}.{name}": value
            for turned in self._turned
            if turned.k >= k
            for name, value in turned.values.items()
        }

    def rewind(self, t: float) -> dict[str, Any]:
        """Go back to t (s): undo all ticks and all changes from then on.

        Returns
        -------
        dict
            The changes that were undone; see `undone`.

        Raises
        ------
        ScenarioError
            The run has not reached that time.
        RunError
            A block has a state that cannot be stored or restored; the error names the block and the reason.
        """
        k, undone = self._past(t), self.undone(t)
        self._turned = [turned for turned in self._turned if turned.k < k]
        self._kept = {tick: moment for tick, moment in self._kept.items() if tick <= k}
        self._release_solvers()
        self._restore({name: step.block for name, step in self.steps.items()}, k)
        return undone

    def branch(self, t: float | None = None) -> Session:
        """Return an independent run that continues from t (s), by default from the current time, with new blocks.

        Raises
        ------
        ScenarioError, RunError
            See `rewind`.
        """
        k = self._k if t is None else self._past(t)
        session = object.__new__(Session)
        session.rig, session.seed, session._every, session._why = self.rig, self.seed, self._every, self._why
        # A branch from the current time keeps the changes that wait for the next tick; one from an earlier time undoes
        # them.
        session._turned = [turned for turned in self._turned if turned.k < k + (t is None)]
        session._kept = {tick: moment for tick, moment in self._kept.items() if tick <= k}
        # The blocks are of classes that this run has checked already.
        session._contents = StartContents({})
        # `_restore` takes the messages before the branch from this recording and replaces it.
        session.recording, session._loop = self.recording, self._loop
        session._restore({m.name: m.block(self.seed) for m in self.rig.members}, k)
        return session

    def _past(self, t: float) -> int:
        """Return the first tick that is not before t; the run must have reached t."""
        k = self._tick(t)
        if k > min(self._k, self.ticks):
            raise ScenarioError(f"t = {t:.9g} s: expected a time that the run has reached, at most {self.t:.9g} s")
        return k

    def _tick(self, t: float) -> int:
        """Return the first tick that is not before t, s."""
        if not t >= 0.0:
            raise ScenarioError(f"t = {t} s: expected a time of at least 0")
        # Infinity has no number of nanoseconds, and any time beyond the end means the end.
        schedule, t_ns = self._loop.plan.clock, to_ns(min(t, self.rig.scenario.duration + 1.0))
        # `tick` rounds to the nearest tick, which may lie before t.
        k = schedule.tick(t_ns)
        return min(k + (schedule.time(k) < t_ns), self.ticks + 1)

    def _restore(self, blocks: dict[str, Block], k: int) -> None:
        """Restore the blocks before tick k: from the newest stored state, and by ticks from there."""
        begin = max(self._kept, default=None)
        if begin is None:
            raise RunError(f"this run cannot go back: {self._why}")
        recording = self.recording.before(self._loop.plan.clock.time(begin))
        self._begin(blocks, recording, begin, self._kept[begin])
        for turned in self._turned:
            # The kept state was taken before this change, so the change is made again at its tick.
            if turned.k >= begin:
                self._answer(turned.k)
                self.steps[turned.node].set(turned.values)
        self._answer(k)

    def _keep(self) -> None:
        """Store the state before the next tick; if there are many, thin out the stored states."""
        if self._why:
            return
        try:
            self._kept[self._k] = self._tables.keep()
        except RunError as error:
            self._why = str(error)
            self._kept.clear()
            return
        if len(self._kept) > KEPT:
            # Every other state goes, so that memory stays bounded and the distance to the nearest one grows with the
            # run.
            self._every *= 2
            self._kept = {k: moment for k, moment in self._kept.items() if k % self._every == 0}
