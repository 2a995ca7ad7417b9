"""The nodes: an FMU as a plant, an FMU as a law."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

from softrig_core import Block, BlockParams, Level, ParameterError, Plant, Port, RunError, Values, param
from softrig_core.block.schedule import Schedule, rational
from softrig_core.kit.confined import STRANGE

from ..channels import frames_of
from .description import Description, Variable, describe, unpacked
from .instance import Cell, Instance, Plan, Refusal
from .mapping import Mapped, mapped, start_values

Method = Literal["co_simulation", "model_exchange"]


class FmuParams(BlockParams):
    """Parameters of an FMU node: the file, the channel of each variable, start values and step sizes."""

    fmu: str = param("", "file of the FMU, or package://PACKAGE/path")
    inputs: tuple[str, ...] = param(
        (), "what it reads, each TOPIC/CHANNEL/FIELD [UNIT] = VARIABLE; without a unit that of the variable holds"
    )
    outputs: tuple[str, ...] = param((), "what it publishes, in the same form")
    values: tuple[str, ...] = param(
        (),
        "its parameters and start values, each VARIABLE = VALUE in the FMU's units; "
        "those that it calls tunable may change",
        live=True,
    )
    trajectories: tuple[str, ...] = param((), "topics above that carry JointTrajectory messages (references)")
    vectors: tuple[str, ...] = param((), "topics above that carry Vector3Stamped messages, each TOPIC = FRAME")
    method: Method = param(
        "co_simulation",
        "interface that is used; model_exchange: with the Runge-Kutta method of fourth order, `steps` a period",
    )
    steps: int = param(1, "communication steps, or steps of the integrator, in one period", ge=1, le=100_000)
    log: bool = param(False, "ask the FMU to write its log: some explain only there why they refuse a step")
    isolated: bool = param(True, "run it in a process of its own: a crash of the FMU then ends the run by name")
    timeout: float = param(
        60.0, "wall-clock time after which a call of an isolated FMU is aborted", "s", gt=0.0, le=1e6
    )

    def _check(self) -> None:
        if self.fmu:
            unit = self.unit
            if self.method not in unit.interfaces:
                has = ", ".join(unit.interfaces) or "none that is known"
                raise ValueError(f"{unit.path.name} has no interface {self.method}; it has {has}")
            start_values(unit, self.values)
            if shared := {p.topic for p in self.reads.ports} & {p.topic for p in self.publishes.ports}:
                raise ValueError(f"{min(shared)} is both an input and an output")

    @cached_property
    def unit(self) -> Description:
        """Return the FMU's model description."""
        return describe(self.fmu)

    @cached_property
    def reads(self) -> Mapped:
        """Ports and places of the inputs."""
        return self._mapped(self.inputs, False)

    @cached_property
    def publishes(self) -> Mapped:
        """Ports and places of the outputs."""
        return self._mapped(self.outputs, True)

    def _mapped(self, entries: tuple[str, ...], outward: bool) -> Mapped:
        return mapped(self.unit, entries, outward, self.trajectories, frames_of(self.vectors))


def _cell(variable: Variable) -> Cell:
    return variable.kind, variable.reference, variable.element or 0, variable.count


def _values(
    pairs: Sequence[tuple[Variable, Any]], only: Set[int] | None = None
) -> tuple[tuple[str, int, tuple[Any, ...]], ...]:
    """Return type, reference and values of the variables to set; for an array also those that keep their start
    values.
    """
    results: dict[int, tuple[Variable, list[Any]]] = {}
    for variable, value in pairs:
        if variable.element is None:
            results[variable.reference] = variable, [value]
            continue
        _, values = results.setdefault(variable.reference, (variable, variable.starts()))
        values[variable.element] = value
    return tuple((v.kind, r, tuple(values)) for r, (v, values) in results.items() if only is None or r in only)


class Call:
    """A call of an FMU, linked to the calls before it: an immutable chain."""

    __slots__ = ("arguments", "before", "name")

    def __init__(self, before: Call | None, name: str, arguments: tuple[Any, ...]) -> None:
        self.before, self.name, self.arguments = before, name, arguments


def calls_before(call: Call | None) -> Iterator[Call]:
    """Yield the calls of a chain, the newest first."""
    while call is not None:
        yield call
        call = call.before


class State(NamedTuple):
    """Periods since the start; outputs, in the FMU's units; of an FMU that cannot write its state, all its calls.

    The remaining state is in the FMU, which is opaque; see `save` and `load`.
    """

    k: int
    outputs: tuple[float, ...]
    calls: Call | None


class Running:
    """The FMU of a block, which continues across live changes."""

    def __init__(self) -> None:
        self._fmu: Any = None
        self._make: Callable[[], Any] | None = None
        # Outputs of an instance that has begun and done nothing else, so that it need not begin again.
        self._fresh: tuple[float, ...] | None = None

    def begin(self, make: Callable[[], Any]) -> tuple[float, ...]:
        """Start the FMU; `make` creates an instance."""
        if self._make is not make:
            self._fmu, self._make, self._fresh = make(), make, None
        if self._fresh is None:
            self._fresh = self._fmu.begin()
        return self._fresh

    def call(self, name: str, *arguments: Any) -> Any:
        """Call one of its methods."""
        if name == "begin":
            return self.begin(*arguments)
        if name != "keep":
            self._fresh = None
        return getattr(self._fmu, name)(*arguments)


class _Fmu(Block[FmuParams]):
    """Base of plant and controller from an FMU: the FMU, its time, and the mapping from ports to variables."""

    # The FMU has a state of its own outside of x. x lists what the FMU was given, by which `load` restores it.
    SCRATCH = frozenset({"_running"})

    @classmethod
    def ports(cls, params: FmuParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return the ports that the parameters name."""
        return (params.reads.ports, params.publishes.ports) if params.fmu else ((), ())

    @classmethod
    def fixed(cls, params: FmuParams) -> Any:
        """Return the parameters that the FMU does not declare tunable."""
        starts = start_values(params.unit, params.values) if params.fmu else ()
        return {v.name: value for v, value in starts if not v.tunable}, {v.name for v, _ in starts}

    @classmethod
    def contents(cls, params: FmuParams) -> Mapping[str, str]:
        """The FMU, by the hash of its file."""
        return {Path(params.fmu).name: f"sha256:{params.unit.digest}"} if params.fmu else {}

    def setup(self) -> None:
        """Unpack the FMU and load it."""
        p = self.p
        if not p.fmu:
            raise ParameterError("parameter fmu = '': expected the file of an FMU")
        before: Running | None = self.__dict__.get("_running")  # after a live change: the FMU goes on
        self._time = Schedule(rational(p.period)).time
        plan = Plan(
            str(unpacked(p.unit.path)),
            p.method == "model_exchange",
            tuple(_cell(x.variable) for x in p.reads.places),
            tuple(_cell(x.variable) for x in p.publishes.places),
            _values(start_values(p.unit, p.values)),
            p.steps,
            p.log,
        )
        self._make: Callable[[], Any] = lambda: Instance(plan)
        # In a foreign pack the scenario is foreign too, so its `isolated: false` must not be trusted.
        strange = bool(os.environ.get(STRANGE))
        if p.isolated or strange:
            from .child import Isolated

            self._make = lambda: Isolated(plan, p.timeout, strange)
        self._keys = [port.name for port in p.reads.ports]
        self._running = Running() if before is None else before

    def first(self) -> State:
        """Instantiate the FMU again and initialise it; report parts of its description without effect."""
        for note in self.p.unit.notes:
            self.report(Level.WARN, note, note)
        result = self._asked(0, self._running.begin, self._make)
        call = None if self.p.unit.serialises or self.realtime else Call(None, "begin", (self._make,))
        return State(0, self._checked(0, result), call)

    def go_on(self, x: State, before: FmuParams) -> State:
        """Set changed parameters between two steps; the state of the FMU continues."""
        was = dict(start_values(before.unit, before.values))
        starts = dict(start_values(self.p.unit, self.p.values))
        changed = {v.reference for v, value in starts.items() if value != was[v]}
        return self._call(x, "tune", _values(tuple(starts.items()), changed))[0] if changed else x

    def _step(self, x: State, inputs: Mapping[str, tuple[float, ...]]) -> State:
        """Advance the FMU over one period with the inputs held; the outputs are then those of its end."""
        rows = [inputs[key] for key in self._keys]
        values = tuple(place.into(rows[place.port][place.at]) for place in self.p.reads.places)
        k = x.k + 1
        x, result = self._call(x, "advance", self._now(x.k), self._now(k), values)
        return State(k, self._checked(k, result), x.calls)

    def _call(self, x: State, name: str, *arguments: Any) -> tuple[State, Any]:
        """Call the FMU; return the state that remembers it, and the answer."""
        result = self._asked(x.k, self._running.call, name, *arguments)
        return x if x.calls is None else State(x.k, x.outputs, Call(x.calls, name, arguments)), result

    def _now(self, k: int) -> float:
        return self._time(k) / 1e9

    def _checked(self, k: int, values: tuple[float, ...]) -> tuple[float, ...]:
        for place, value in zip(self.p.publishes.places, values, strict=True):
            if not math.isfinite(value):
                raise RunError(
                    f"{self._label()}: {place.variable.name} = {value} at {self._now(k):.9g} s of its time, "
                    "expected a finite number"
                )
        return values

    def _outputs(self, x: State) -> Values:
        ports = self.p.publishes.ports
        rows = [[0.0] * port.size for port in ports]
        for place, value in zip(self.p.publishes.places, x.outputs, strict=True):
            rows[place.port][place.at] = place.out(value)
        return {port.name: tuple(row) for port, row in zip(ports, rows, strict=True)}

    def _asked(self, k: int, call: Any, *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except Refusal as error:
            raise RunError(f"{self._label()} at {self._now(k):.9g} s of its time: {error}") from None

    def _label(self) -> str:
        return f"{self.name or type(self).__name__}: the FMU {self.p.unit.path.name}"

    def save(self, x: State) -> tuple[State, bytes | None]:
        """Return also the FMU's serialised state; an FMU without serialisation is restored by repeating all its calls.

        Raises
        ------
        RunError
            The FMU cannot serialise its state and runs in real time, where its calls are not stored.
        """
        if self.p.unit.serialises:
            return x, self._asked(x.k, self._running.call, "keep")
        if x.calls is None:
            raise RunError(f"{self._label()} cannot keep its state (canGetAndSetFMUstate, canSerializeFMUstate)")
        return x, None

    def load(self, saved: tuple[State, bytes | None]) -> State:
        """Continue from a stored state, in this or another block of the same FMU."""
        x, memory = saved
        if memory is not None:
            self._asked(x.k, self._running.call, "restore", memory)
        else:
            # Each call refers to the one before it, so they are listed from the last to the first.
            for call in reversed([*calls_before(x.calls)]):
                self._asked(x.k, self._running.call, call.name, *call.arguments)
        return x


class FmuPlant(_Fmu, Plant[FmuParams]):
    """An FMU as a plant: outputs at t_k, then one period with the inputs of t_k held.

    Outputs that depend directly on inputs show the inputs of the previous period. In every mode its time counts its own
    steps from 0.
    """

    def outputs(self, x: State, t: int) -> Values:
        """Return the outputs."""
        return self._outputs(x)

    def advance(self, x: State, t: int, **inputs: tuple[float, ...]) -> State:
        """Move over one period."""
        return self._step(x, inputs)


class FmuLaw(_Fmu):
    """An FMU as a controller: it reads the inputs of t_k, makes the step from t_k on, and returns the output for t_k.

    A sampled controller in an FMU works in this way: its step is one sample. An FMU with continuous states returns its
    outputs at the end of the period.
    """

    def update(self, x: State, t: int, **inputs: tuple[float, ...]) -> tuple[State, Values]:
        """Answer one tick."""
        x = self._step(x, inputs)
        return x, self._outputs(x)
