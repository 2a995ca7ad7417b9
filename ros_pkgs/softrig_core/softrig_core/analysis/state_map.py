r"""A rig as a map: from the states of its blocks at a tick to their states one common period later.

.. math:: x_{k+1} = F(x_k, u_k), \quad y_k = h(x_k, u_k)

It can be evaluated at the state of a run any number of times, because the states of blocks can be restored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array
from ..block.link import Link
from ..block.loop import Loop
from ..block.port import Port, Sample
from ..block.step import Step
from ..block.tables import Tables
from ..errors import RunError, ScenarioError, closest
from ..kit.floats import numbers as numbers_of, others, put, read, split
from ..rig.members import Member, signal_units
from ..rig.rig import Rig
from ..run.expand import rig_of
from ..run.inprocess import wired
from ..verdict.requirements import names_of
from ..wire.signals import full_name

LONGEST = 20_000  # ticks that one period of the whole may have
LATER = 10  # periods that an effect may take to be seen, besides those of the values that it passes
LOOKS = 20  # times before that are looked at to see how large states are


INPUT = "input "  # before the names of inputs, because a state may have the name of an input


class Place(NamedTuple):
    """The source of a signal: the member, its output, and the place among the values of the output."""

    member: Member
    port: Port
    k: int


def signal_of(rig: Rig, name: str) -> str:
    """Return the full name of a signal that a member publishes, found by its own or a shared name.

    Raises
    ------
    ScenarioError
        There is none.
    """
    known = {f"{p.topic}/{label}" for m in rig.members for p in m.outputs for label in p.labels}
    shared = names_of(rig, signal_units(rig))[1]
    result = full_name(shared.get(name, name), known)
    if result not in known:
        raise ScenarioError(f"{rig.scenario.name}: no signal {name!r}{closest(name, [*known, *shared])}")
    return result


def place_of(rig: Rig, signal: str) -> Place:
    """Find the publisher of a signal by its full name."""
    return next(
        Place(m, p, k)
        for m in rig.members
        for p in m.outputs
        for k, label in enumerate(p.labels)
        if f"{p.topic}/{label}" == signal
    )


def upstream(member: Member, seen: dict[str, Member] | None = None) -> dict[str, Member]:
    """Return a member and all members that it depends on, by name."""
    seen = {} if seen is None else seen
    if member.name not in seen:
        seen[member.name] = member
        for link in member.links.values():
            upstream(link.source, seen)
    return seen


def is_source(member: Member) -> bool:
    """Return whether a member has no publishers and is not a plant: a reference, a disturbance."""
    return not member.is_plant and not member.links


class _Known(NamedTuple):
    """The state of a member and the present values of its inputs."""

    x: Any
    inputs: tuple[Any, ...]


class _Probe(Link):
    """Reads one value of an output at each tick, and changes the value that other members receive."""

    value: float = math.nan
    fixed: float | None = None
    added: float = 0.0

    def __init__(self, step: Step, place: Place) -> None:
        super().__init__(step)
        _, self._port, self._k = place

    def respond(self, x: Any, t: int, **inputs: Any) -> Any:
        """Return the answer with one value replaced."""
        if self.step.plant:
            return self._changed(super().respond(x, t))
        x, result = super().respond(x, t, **inputs)
        return x, self._changed(result)

    def _changed(self, value: Any) -> Any:
        name, k = self._port.name, self._k
        row: Any = value.get(name)
        if row is None:
            return value
        data = tuple(row.data if isinstance(row, Sample) else row)
        # The linear view is about the first message of a period; NaN marks that it has not arrived.
        if math.isnan(self.value):
            self.value = data[k]
        new = (data[k] if self.fixed is None else self.fixed) + self.added
        if new == data[k]:
            return value
        data = (*data[:k], new, *data[k + 1 :])
        return {**value, name: Sample(row.stamp, data) if isinstance(row, Sample) else data}


class StateMap:
    """The map from the state of a rig to its state one period later, at a point of a run.

    Parameters
    ----------
    at : float
        Time of the point, s; the map starts at the first tick from then on at which all members that count are due.
    outputs : sequence of str
        Full names of signals. Members that none of them depends on are left out.
    inputs : sequence of str
        Full names of signals to which something may be added, or which may be held.
    periods : int
        Number of periods of the rig that may be run from there in one call.

    Attributes
    ----------
    names : list of str
        Names of all numbers in the states of blocks and in their inputs, whether they are states or not.
    start : array
        Values of these numbers at the start.
    sizes : array
        Largest magnitude of each before the start; 0 if it was always 0.
    moved : array of bool
        Which of them have changed before the start.
    resting : array of bool
        Which of them belong to a plant and have not changed: the plant may rest at an unstable equilibrium.
    t : float
        Time of the start, s.
    period : float
        Period of the rig, s: the shortest after which all members that count are due again.

    Raises
    ------
    ScenarioError
        The period is too long, or a signal is published less often.
    RunError
        The rig failed, or the state of a member cannot be restored.
    """

    def __init__(
        self, rig: Rig, at: float, seed: int, outputs: Sequence[str], inputs: Sequence[str], periods: int
    ) -> None:
        self.places = {name: place_of(rig, name) for name in (*outputs, *inputs)}
        involved: dict[str, Member] = {}
        for name in (*outputs, *inputs):
            upstream(self.places[name].member, involved)
        names = {self.places[n].member.name for n in (*outputs, *inputs)}
        due = [m for m in involved.values() if m.name in names or not is_source(m)]
        every = math.lcm(*(m.schedule.every for m in due))
        clock = rig.clock.params.period
        self.period = every * clock
        if every > LONGEST:
            rates = ", ".join(f"{m.name} {m.params.period:g} s" for m in sorted(due, key=lambda m: -m.schedule.every))
            raise ScenarioError(
                f"{rig.scenario.name}: all nodes are due together only every {self.period:g} s only, {every} ticks, "
                f"expected at most {LONGEST}: choose periods that divide each other with --set ({rates})"
            )
        # Rounding keeps a time that is a whole number of periods from the next period.
        first = math.ceil(round(at / self.period, 9))
        # No plant moves beyond the end of a run, so the rig runs one period longer than the map needs.
        rig = rig_of(rig, duration=max((first + periods + 1) * self.period, rig.scenario.duration))
        self.rig, self.t = rig, first * self.period
        self._wire(seed, [m.name for m in rig.members if m.name in involved])
        self._every = every // self._loop.plan.stride
        self._first = first * self._every
        self._run_to_start()
        self._check()

    def _wire(self, seed: int, names: Sequence[str]) -> None:
        members = {m.name: m for m in self.rig.members if m.name in names}
        self._steps = wired(self.rig, {name: m.block(seed) for name, m in members.items()})
        self._loop, self._tables = Loop(list(self._steps.values())), Tables(self._steps.values())
        self.probes = {name: _Probe(self._steps[place.member.name], place) for name, place in self.places.items()}

    def _run_to_start(self) -> None:
        """Run to the start of the map, and record on the way which values change."""
        # A state's size and whether it moves are seen only along the run, since it may pass zero or rest where the view
        # is.
        readings: list[tuple[list[str], Array]] = [self._read()]
        often = max(1, self._first // LOOKS)
        if self._first:
            for k, _ in enumerate(self._loop.run()):
                if k % often == 0 or k == self._first - 1:
                    readings.append(self._read())
                if k == self._first - 1:
                    break
        self._saved = self._tables.keep()
        self.names, self.start = self._read()
        ends = np.cumsum([len(row) for row in self._now()]).tolist()
        self._kept, self._slices = self.start, list(map(slice, [0, *ends], ends))
        self._labels = {
            f"{n}.{INPUT}{p.name}{'.data' * p.delayed}" + (f"[{k}]" if p.size > 1 else ""): f"{n}.{p.name}.{label}"
            for n, s in self._steps.items()
            for p in s.inputs
            for k, label in enumerate(p.labels)
        }
        last: dict[str, float] = {}
        size = dict.fromkeys(self.names, 0.0)
        moved = dict.fromkeys(self.names, False)
        for names, numbers in readings:
            for name, x in zip(names, numbers.tolist(), strict=True):
                # A list in a state may have been longer before; only the numbers that exist at the start belong to the
                # map.
                if name in size:
                    size[name] = max(size[name], abs(x))
                    moved[name] |= last.setdefault(name, x) != x
        self.names = [self._labels.get(name, name) for name in self.names]
        sizes = np.array(list(size.values()))
        # An infinite limit has no size that a step could be a part of.
        self.sizes, self.moved = np.where(np.isfinite(sizes), sizes, 0.0), np.array(list(moved.values()), bool)

    def _check(self) -> None:
        """Compare two runs from the same state."""
        once, _ = self(self.start, {})
        self.moved = self.moved | (once != self.start)
        plants = {m.name for m in self.rig.members if m.is_plant}
        self.resting = np.zeros(len(self.start), bool)
        for (name, step), span in zip(self._steps.items(), self._slices, strict=True):
            # The numbers of a member are those of its state, then those of its inputs; only a state can rest.
            size = sum(len(row) for _, row in read(step.x))
            self.resting[span.start : span.start + size] = name in plants
        self.resting &= ~self.moved
        # A block that keeps something outside of its state continues differently the second time.
        again, _ = self(self.start, {})
        if not np.array_equal(once, again):
            bad = sorted({n.partition(".")[0] for n, a, b in zip(self.names, once, again, strict=True) if a != b})
            raise RunError(
                f"{self.rig.scenario.name}: {', '.join(bad)} cannot be put back to where it was at "
                f"{self.t:g} s: part of its state is not in x"
            )

    def step_names(self) -> list[str]:
        """Return the names of the members that count."""
        return list(self._steps)

    def _read(self) -> tuple[list[str], Array]:
        """Return the names and values of all numbers as they are now."""
        names: list[str] = []
        rows: list[Array] = [np.empty(0)]
        for name, step in self._steps.items():
            parts = [read(step.x), *(read(value, INPUT + port) for port, value in step.values.items())]
            for path, row in (pair for part in parts for pair in part):
                label = f"{name}.{path}" if path else name
                names.extend([label] if len(row) == 1 else [f"{label}[{k}]" for k in range(len(row))])
                rows.append(row)
        return names, np.concatenate(rows)

    def _now(self) -> list[Array]:
        """Return the present values without names, one row for each member."""
        return [numbers_of(_Known(step.x, tuple(step.values.values()))) for step in self._steps.values()]

    def others(self) -> list[tuple[str, Any]]:
        """Return names and values of all that is not a float after the last period; the linear view leaves it out."""
        return [
            (f"{name}.{path}" if path else name, value)
            for name, step in self._steps.items()
            for part in (others(step.x), *(others(value, INPUT + port) for port, value in step.values.items()))
            for path, value in part
        ]

    def follows(self, numbers: Array, added: Mapping[str, float], fixed: Mapping[str, float] | None = None) -> bool:
        """Return whether anything depends on non-float values that differ a period after `numbers` and `start`.

        It is restored to its value after `start`, and the floats must then evolve as they do without this. The check
        covers as many periods as such values need to pass something on among themselves, and some more, but not beyond
        the end of the run.
        """
        periods = LATER + sum(np.size(value) for _, value in self.others())
        periods = min(periods, round(self.rig.scenario.duration / self.period) - self._first // self._every)
        try:
            true = list(self.go_on(numbers, periods, added, fixed))
            # The second run has the moved floats but the original other values, so a difference from the first run
            # comes from these alone.
            without = self.go_on(self.start, periods, {}, fixed)
            next(without)
            self._write(true[0][0], np.concatenate(self._now()))
            for name, probe in self.probes.items():
                probe.added = added.get(name, 0.0)
            return any(
                changed != unchanged or not np.array_equal(x, y, equal_nan=True)
                for (x, changed), (y, unchanged) in zip(true[1:], without, strict=True)
            )
        # A rig that breaks, or whose state has become longer, does depend on it.
        except RunError:
            return True

    def _write(self, numbers: Array, before: Array) -> None:
        """Replace the numbers of the nodes' states."""
        for step, span in zip(self._steps.values(), self._slices, strict=True):
            if not np.array_equal(numbers[span], before[span]):
                both = _Known(step.x, tuple(step.values.values()))
                step.x, inputs = put(both, split(both, numbers[span]))
                step.values.update(zip(step.values, inputs, strict=True))

    def __call__(
        self, numbers: Array, added: Mapping[str, float], fixed: Mapping[str, float] | None = None
    ) -> tuple[Array, dict[str, float]]:
        """Advance the rig by one period.

        Parameters
        ----------
        numbers : array
            Values of `names` at the beginning.
        added : mapping
            Values that are added to inputs over the period.
        fixed : mapping, optional
            Values that replace published ones.

        Returns
        -------
        array
            The numbers after the period.
        dict
            The value of each signal at the beginning, before anything was added.
        """
        return next(self.go_on(numbers, 1, added, fixed))

    def go_on(
        self,
        numbers: Array,
        periods: int,
        added: Mapping[str, float] | None = None,
        fixed: Mapping[str, float] | None = None,
    ) -> Iterator[tuple[Array, dict[str, float]]]:
        """Advance the rig by some periods; return the result of `__call__` after each of them."""
        self._tables.go_back(self._saved)
        self._write(numbers, self._kept)
        added, fixed = added or {}, fixed or {}
        for name, probe in self.probes.items():
            probe.value, probe.added, probe.fixed = math.nan, added.get(name, 0.0), fixed.get(name)
        ticks = self._loop.run(self._first)
        for _ in range(periods):
            for probe in self.probes.values():
                probe.value = math.nan
            for _ in range(self._every):
                if next(ticks, None) is None:
                    raise RunError(f"{self.rig.scenario.name}: the run ends before {periods} periods of the rig")
            result = np.concatenate(self._now())
            if len(result) != len(self.start):
                raise RunError(
                    f"{self._grown()}: its state has another length one period after {self.t:g} s; choose a later time"
                )
            yield result, {name: probe.value for name, probe in self.probes.items()}

    def advance(self) -> None:
        """Move the start of the map one period of the rig later, along the undisturbed run."""
        next(self.go_on(self.start, 1))
        self._saved = self._tables.keep()
        self._first += self._every
        self.t = self._first / self._every * self.period
        self.start = self._kept = np.concatenate(self._now())

    def _grown(self) -> str:
        odd = set(self.names) ^ {self._labels.get(name, name) for name in self._read()[0]}
        members = sorted({name.partition(".")[0] for name in odd})
        return f"{self.rig.scenario.name}: {', '.join(members)}"
