"""A rig in this process: all its members in one runner, no DDS, the same numbers and bytes."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

from ..block.answer import Rows, slots_of
from ..block.block import Block, Observer
from ..block.codec import encoder
from ..block.link import Link
from ..block.loop import YOUNG
from ..block.port import CLOCK, Port, Sample
from ..block.step import Step
from ..errors import ScenarioError
from ..rig.contents import StartContents
from ..rig.members import Member
from ..rig.rig import Rig
from ..solver.solver import Solver
from ..wire import parameter_event
from ..wire.cdr import Layout
from ..wire.recording import Sink
from .choice import ticks_of
from .stuck import watched

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@watched()
def run_inprocess(
    rig: Rig,
    seed: int,
    sink: Sink | None = None,
    progress: Callable[[int], object] | None = None,
    runs: int = 1,
    topics: Container[str] | None = None,
    thorough: bool = False,
    without: Container[str] = (),
) -> dict[str, Step]:
    """Run a rig in this process.

    Parameters
    ----------
    seed : int
        Rig seed.
    sink : Sink, optional
        Gets every message as the bytes that DDS would carry.
    progress : callable, optional
        Called with the time in ns about a hundred times.
    runs : int
        Number of such runs that will follow. Compiling native code takes seconds, which pays for long or many runs.
        If there are several, observers that publish nothing are left out.
    topics : container of str, optional
        The sink gets the messages of nodes that publish one of these; of all nodes when absent.
    thorough : bool
        Compare what the blocks hold beside x also after the run, not only after the first ticks of a class. Of several
        runs this is done for blocks that are not softrig's own.
    without : container of str
        Observers that are left out, too.

    Returns
    -------
    dict of str to Step
        The members with their final states: `Step.x`, `Step.block`, `Step.status`, `Step.reports`.

    Raises
    ------
    ScenarioError
        A node of the rig is external.
    RunError
        A block raised, returned an invalid output (NaN, infinity, beyond `Port.limits`, a wrong number of values), or
        changed what it holds beside x. The error names node, port and time.
    """
    check_here(rig)
    if runs > 1:
        _keep_memory()
    idle = {m.name for m in rig.members if runs > 1 and issubclass(m.block_class, Observer) and not m.outputs}
    idle |= {m.name for m in rig.members if m.name in without}
    steps = wired(rig, {m.name: m.block(seed) for m in rig.members if m.name not in idle})
    if sink is not None:
        record(
            rig, {n: s for n, s in steps.items() if topics is None or any(p.topic in topics for p in s.outputs)}, sink
        )
    purity = StartContents(steps, thorough, runs > 1)
    due, end = 0, rig.clock.schedule.end or 0
    try:
        with _searched_seldom():
            for t in ticks_of(list(steps.values()), runs)[0]:
                if t is not None and t >= purity.due:
                    purity.check(t)
                if progress is not None and t is not None and (t >= due or t == end):
                    progress(t)
                    # About a hundred calls are enough to show the progress.
                    due = t + end // 100
            purity.check()
    finally:
        for step in steps.values():
            if step.link is not None:
                step.link.settle()
            # The step may continue without a sink, and it must not hold the memory of the recording.
            step.link = None
            # Its process can serve the next run, which saves a second of imports.
            if isinstance(step.block, Solver):
                step.block.release()
    return steps


def check_here(rig: Rig) -> None:
    """Ensure that a rig can run in one process; a ScenarioError names a node that cannot."""
    for member in rig.members:
        if member.external:
            raise ScenarioError(f"node {member.name} is external: in-process runs have no place for it")


@cache
def _keep_memory() -> None:
    """Let glibc keep freed memory for the next run: fresh pages are a third of a short run's time."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(-3, 1 << 25)  # M_MMAP_THRESHOLD
        libc.mallopt(-1, 1 << 30)  # M_TRIM_THRESHOLD


@contextmanager
def _searched_seldom() -> Iterator[None]:
    """Run the garbage collector less often (it can take a tenth of a tick); no effect if collection is disabled."""
    usual = gc.get_threshold()
    if usual[0]:
        gc.set_threshold(max(YOUNG, usual[0]), *usual[1:])
    try:
        yield
    finally:
        gc.set_threshold(*usual)


def wired(rig: Rig, blocks: dict[str, Block]) -> dict[str, Step]:
    """Create the steps of a rig's members; each passes its outputs to the steps that read them.

    Parameters
    ----------
    blocks : dict of str to Block
        Blocks of the members in this process, by name.
    """
    members = [m for m in rig.members if m.name in blocks]
    steps = {m.name: step_of(m, blocks[m.name]) for m in members}
    for member in members:
        for name, link in member.links.items():
            if link.source.name in steps:
                steps[link.source.name].hands_to(link.port.name, steps[member.name], name, link.pick)
    return steps


def step_of(member: Member, block: Block) -> Step:
    """Create the step of a member."""
    return Step(member.name, block, member.schedule, member.inputs, member.outputs, member.changes)


def record(rig: Rig, steps: Mapping[str, Step], sink: Sink) -> None:
    """Write every message of the steps of a rig to a sink."""
    numbers = {topic: number for number, topic in enumerate(rig.topics)}
    for step in steps.values():
        ports = [*step.outputs, CLOCK] if step.name == rig.clock.name else step.outputs
        if ports:
            keeper(step, sink, ports, [numbers[p.topic] for p in ports])


def keeper(step: Step, sink: Sink, ports: Sequence[Port], numbers: Sequence[int]) -> Link:
    """Send the messages of a step to a sink.

    Parameters
    ----------
    ports : sequence of Port
        Its outputs; with /clock after them when it is the clock.
    numbers : sequence of int
        Of their topics in the sink.
    """
    layouts = dict(zip(numbers, [p.layout() for p in ports], strict=True))
    return _RowKeeper(step, sink, layouts) if step.plain else _Keeper(step, sink, ports, layouts)


class _ToSink(Link):
    """Records the parameter changes of a step."""

    def __init__(self, step: Step, sink: Sink) -> None:
        super().__init__(step)
        self._sink = sink

    def changed(self, t: int, values: Mapping[str, Any]) -> None:
        """Record changed parameters."""
        self._sink.note(t, parameter_event.encode(t, f"/{self.step.name}", values))


class _RowKeeper(_ToSink):
    """Records a step that publishes on each output at each tick."""

    def __init__(self, step: Step, sink: Sink, layouts: Mapping[int, Layout]) -> None:
        super().__init__(step, sink)
        # The methods are looked up once, because `send` runs at each tick.
        self.add_row = self._add_row = sink.row(layouts)
        self._add_rows = sink.rows(layouts)

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Record an answer."""
        self._add_row(t, numbers)

    def send_all(self, times: NDArray[np.int64], numbers: NDArray[np.float64], stamps: NDArray[np.int64]) -> None:
        """Record many."""
        self._add_rows(times, numbers)


class _Keeper(_ToSink):
    """Records a step with sporadic or delayed outputs."""

    def __init__(self, step: Step, sink: Sink, ports: Sequence[Port], layouts: Mapping[int, Layout]) -> None:
        super().__init__(step, sink)
        self._ports, self._layouts = ports, layouts
        self._encoders = [encoder(p.layout(), step.counts, p.name) for p in ports]
        self._silent = ((),) * (len(ports) - len(step.outputs))
        self._numbered = any(layout.numbered for layout in layouts.values())

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Record an answer."""
        add = self._sink.add
        for number, encode, row in zip(self._layouts, self._encoders, (*rows, *self._silent), strict=True):
            if row is not None:
                add(number, t, encode(row.stamp, row.data) if isinstance(row, Sample) else encode(t, row))

    def send_all(self, times: NDArray[np.int64], numbers: NDArray[np.float64], stamps: NDArray[np.int64]) -> None:
        """Record many messages; numbered ones singly, by their encoder."""
        slots = slots_of(self._ports)
        if all(p.sporadic for p in self._ports):
            # Most ticks of such a node are silent; whether each output publishes is in the last columns.
            published = numbers[:, slots[0][3] :].any(axis=1)
            times, numbers, stamps = times[published], numbers[published], stamps[published]
        if self._numbered:
            super().send_all(times, numbers, stamps)
            return
        for (low, high, late, flag), (number, layout) in zip(slots, self._layouts.items(), strict=True):
            rows, marks, published_at = numbers[:, low:high], times if late is None else stamps[:, late], times
            if flag is not None:
                announced = numbers[:, flag] != 0.0
                rows, marks, published_at = rows[announced], marks[announced], times[announced]
            raw, n = layout.encode_block(marks, rows).tobytes(), layout.length
            for k, t in enumerate(published_at.tolist()):
                self._sink.add(number, t, raw[n * k : n * (k + 1)])
