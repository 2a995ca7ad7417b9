"""The nodes: an FMU as a plant, an FMU as a law."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import model_validator
from softrig_core import Block, BlockParams, ParameterError, Plant, Port, RunError, executable, param
from softrig_core.block.schedule import Schedule, rational

from .description import Description, Variable, describe, unpacked
from .instance import Cell, Instance, Plan, Refusal
from .mapping import Mapped, mapped, start_values

Method = Literal["co_simulation", "model_exchange"]


class FmuParams(BlockParams):
    """Which FMU, which of its variables are which channels, its start values and steps."""

    fmu: str = param("", "file of the FMU, or package://PACKAGE/path")
    inputs: tuple[str, ...] = param((), "what it reads, each TOPIC/CHANNEL/FIELD [UNIT] = VARIABLE; without a unit "
                                    "that of the variable holds")  # fmt: skip
    outputs: tuple[str, ...] = param((), "what it says, likewise")
    values: tuple[str, ...] = param((), "its parameters and start values, each VARIABLE = VALUE in the FMU's units; "
                                    "those that it calls tunable may change", live=True)  # fmt: skip
    trajectories: tuple[str, ...] = param((), "topics above that carry JointTrajectory messages (references)")
    vectors: tuple[str, ...] = param((), "topics above that carry Vector3Stamped messages, each TOPIC = FRAME")
    method: Method = param("co_simulation", "interface that is used; model_exchange: with the Runge-Kutta method of "
                           "fourth order, `steps` a period")  # fmt: skip
    steps: int = param(1, "communication steps, or steps of the integrator, in one period", ge=1, le=100_000)
    log: bool = param(False, "ask the FMU to log what it does: some say only then why they refuse a step")
    isolated: bool = param(True, "run it in a process of its own: a crash of the FMU then ends the run by name")
    timeout: float = param(60.0, "wall-clock time after which a call of an isolated FMU is given up", "s", gt=0.0,
                           le=1e6)  # fmt: skip

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.fmu:
            unit = self.unit
            if self.method not in unit.interfaces:
                has = ", ".join(unit.interfaces) or "none that is known"
                raise ValueError(f"{unit.path.name} has no interface {self.method}; it has {has}")
            start_values(unit, self.values)
            if shared := {p.topic for p in self.reads.ports} & {p.topic for p in self.says.ports}:
                raise ValueError(f"{min(shared)} is both read and said")
        return self

    @cached_property
    def unit(self) -> Description:
        """What the FMU says of itself."""
        return describe(self.fmu)

    @cached_property
    def reads(self) -> Mapped:
        """Ports and places of the inputs."""
        return self._mapped(self.inputs, False)

    @cached_property
    def says(self) -> Mapped:
        """Ports and places of the outputs."""
        return self._mapped(self.outputs, True)

    def _mapped(self, entries: tuple[str, ...], outward: bool) -> Mapped:
        frames = {}
        for entry in self.vectors:
            topic, equals, frame = (part.strip() for part in entry.partition("="))
            if not equals:
                raise ValueError(f"vectors: {entry!r}: expected TOPIC = FRAME")
            frames[topic] = frame
        return mapped(self.unit, entries, outward, self.trajectories, frames)


def _cell(variable: Variable) -> Cell:
    return variable.kind, variable.reference, variable.element or 0, variable.count


def _values(
    given: Sequence[tuple[Variable, Any]], only: Set[int] | None = None
) -> tuple[tuple[str, int, tuple[Any, ...]], ...]:
    """Give type, reference and values of what is set; of an array also those that keep their start."""
    found: dict[int, tuple[Variable, list[Any]]] = {}
    for variable, value in given:
        if variable.element is None:
            found[variable.reference] = variable, [value]
            continue
        _, values = found.setdefault(variable.reference, (variable, variable.starts()))
        values[variable.element] = value
    return tuple((v.kind, r, tuple(values)) for r, (v, values) in found.items() if only is None or r in only)


class _Fmu(Block[FmuParams]):
    """What both have: the FMU, its time, and the way from ports to variables."""

    @classmethod
    def ports(cls, params: FmuParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Give the ports that the parameters name."""
        return (params.reads.ports, params.says.ports) if params.fmu else ((), ())

    @classmethod
    def fixed(cls, params: FmuParams) -> Any:
        """What the FMU does not call tunable stays as it is."""
        given = start_values(params.unit, params.values) if params.fmu else ()
        return {v.name: value for v, value in given if not v.tunable}, {v.name for v, _ in given}

    @classmethod
    def contents(cls, params: FmuParams) -> Mapping[str, str]:
        """The FMU, by the hash of its file."""
        return {Path(params.fmu).name: f"sha256:{params.unit.digest}"} if params.fmu else {}

    def change(self, params: FmuParams) -> None:
        """Set the parameters that differ between two steps; the state of the FMU goes on."""
        before = dict(start_values(self.p.unit, self.p.values))
        given = dict(start_values(params.unit, params.values))
        if other := {v.reference for v, value in given.items() if value != before[v]}:
            self._asked(self._fmu.tune, _values(tuple(given.items()), other))
        self.p = params

    def setup(self) -> None:
        """Unpack the FMU and load it."""
        p = self.p
        if not p.fmu:
            raise ParameterError("parameter fmu = '': expected the file of an FMU")
        self._time = Schedule(rational(p.period)).time
        plan = Plan(
            str(unpacked(p.unit.path)),
            p.method == "model_exchange",
            tuple(_cell(x.variable) for x in p.reads.places),
            tuple(_cell(x.variable) for x in p.says.places),
            _values(start_values(p.unit, p.values)),
            p.steps,
            p.log,
        )
        self._fmu: Any = None
        if p.isolated:
            from .child import Isolated

            self._make: Callable[[], Any] = lambda: Isolated(plan, p.timeout)
        else:
            self._make = lambda: Instance(plan)
        self._keys = [port.name for port in p.reads.ports]
        self._fresh = False

    def start(self) -> None:
        """Instantiate the FMU anew and initialise it."""
        self._k = 0
        if not self._fresh:
            if self._fmu is None:
                self._fmu = self._asked(self._make)
            self._first = self._asked(self._fmu.begin)
        self._fresh = True
        self._answer = self._said(self._first)

    def _step(self, inputs: Mapping[str, tuple[float, ...]]) -> None:
        """Move the FMU over one period with the inputs held; the outputs are then those of its end."""
        rows = [inputs[key] for key in self._keys]
        values = tuple(x.into(rows[x.port][x.at]) for x in self.p.reads.places)
        self._fresh = False
        found = self._asked(self._fmu.advance, self._now(self._k), self._now(self._k + 1), values)
        self._k += 1
        self._answer = self._said(found)

    def _now(self, k: int) -> float:
        return self._time(k) / 1e9

    def _said(self, found: tuple[float, ...]) -> Mapping[str, tuple[float, ...]]:
        ports = self.p.says.ports
        rows = [[0.0] * port.size for port in ports]
        for place, x in zip(self.p.says.places, found, strict=True):
            if not math.isfinite(x):
                raise RunError(f"{self._who()}: {place.variable.name} = {x} at {self._now(self._k):.9g} s of its time, "
                               "expected a finite number")  # fmt: skip
            rows[place.port][place.at] = place.out(x)
        return {port.name: tuple(row) for port, row in zip(ports, rows, strict=True)}

    def _asked(self, call: Any, *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except Refusal as error:
            raise RunError(f"{self._who()} at {self._now(self._k):.9g} s of its time: {error}") from None

    def _who(self) -> str:
        return f"{self.name or type(self).__name__}: the FMU {self.p.unit.path.name}"

    def keep(self) -> tuple[int, bytes]:
        """Give the whole state: periods since the start, and what the FMU wrote.

        Raises
        ------
        RunError
            The FMU cannot.
        """
        if not self.p.unit.serialises:
            raise RunError(f"{self._who()} cannot keep its state (canGetAndSetFMUstate, canSerializeFMUstate)")
        return self._k, self._asked(self._fmu.keep)

    def restore(self, kept: tuple[int, bytes]) -> None:
        """Go on from a state that `keep` gave, here or in another block of the same FMU."""
        self._fresh = False
        self._k = kept[0]
        self._answer = self._said(self._asked(self._fmu.restore, kept[1]))


class FmuPlant(_Fmu, Plant[FmuParams]):
    """An FMU as a plant: outputs at t_k, then one period with the inputs of t_k held.

    Outputs that depend on the inputs at once show those of the period before. Its time is that of its own steps, from
    0 on, in every mode.
    """

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give the outputs."""
        return self._answer

    def advance(self, t: int, **inputs: tuple[float, ...]) -> None:
        """Move over one period."""
        self._step(inputs)


class FmuLaw(_Fmu):
    """An FMU as a law: it gets the inputs of t_k, makes the step from t_k on, and then says the answer of t_k.

    This is how a sampled law in an FMU works: its step is one sample. One with continuous states answers with what it
    has at the end of the period.
    """

    def update(self, t: int, **inputs: tuple[float, ...]) -> Mapping[str, tuple[float, ...]]:
        """Answer one tick."""
        self._step(inputs)
        return self._answer


plant = executable(FmuPlant)
law = executable(FmuLaw)
