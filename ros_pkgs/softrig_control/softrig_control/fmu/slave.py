"""A node of a rig as the inside of an FMU, called by PythonFMU in any tool."""

from __future__ import annotations

import base64
import json
import math
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from xml.etree.ElementTree import Element, SubElement

from softrig_core import Plant, Port
from softrig_core.block.answer import Rows
from softrig_core.block.link import Link
from softrig_core.block.params import build, declarations, flatten
from softrig_core.block.schedule import Schedule
from softrig_core.block.step import Step
from softrig_core.export.kinds import one_line
from softrig_core.judge.units import base
from softrig_core.rig.installed import load_block

if TYPE_CHECKING:
    from pythonfmu import Fmi2Slave as Base
else:
    Base = object  # the class in the FMU has Fmi2Slave as its second base: PythonFMU is an extra


LARGEST = (1 << 31) - 1  # largest Integer of FMI 2.0


def variable(topic: str, label: str) -> str:
    """Name the variable of a signal: ``motor.state.shaft.velocity``."""
    return f"{topic}/{label}".strip("/").replace("/", ".")


def unit_definitions(units: Iterable[str]) -> list[Element]:
    """Return the element that defines the units, in a list that is empty if there are no units."""
    element = Element("UnitDefinitions")
    for unit in sorted(units):
        factor, powers = base(unit)
        entry = SubElement(element, "Unit", name=unit)
        if set(powers) <= {"kg", "m", "s", "A", "K", "mol", "cd", "rad"}:
            SubElement(entry, "BaseUnit", {k: str(v) for k, v in powers.items()} | {"factor": repr(factor)})
    return [element] if len(element) else []


class _Shown(Link):
    """Sets the variables of the FMU to the outputs of the block."""

    def __init__(self, step: Step, numbers: dict[str, list[float]]) -> None:
        super().__init__(step)
        self._numbers = numbers

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Receive an answer."""
        for port, row in zip(self.step.outputs, rows, strict=True):
            # A row is never a `Sample`, because nodes with delayed ports cannot be exported.
            if row is not None:
                self._numbers[port.name][:] = cast(tuple[float, ...], row)


class Node(Base):  # type: ignore[misc,unused-ignore]
    """The contents of ``node.json`` in the FMU's resources: block, parameters, topics, seed.

    A step of the FMU is one period of the block, or a whole number of them with the inputs held. A plant's outputs are
    those at the end of the step. The outputs of a controller are those of its (last) tick. Before the first tick they
    are the ports' safe values or, if it has no inputs, its first outputs. Ticks are at times of the tool's clock, which
    may start later than at 0. Inputs begin with their first values in the scenario.
    """

    def __init__(self, **keywords: Any) -> None:
        from pythonfmu import DefaultExperiment, Fmi2Causality

        super().__init__(**keywords)
        self._what = json.loads(Path(self.resources, "node.json").read_text(encoding="utf-8"))
        self._class = load_block(self._what["package"], self._what["executable"])
        self._values: dict[str, Any] = dict(self._what["parameters"])
        self.modelName = self._what["node"]
        self.description = one_line((self._class.__doc__ or "").split("\n\n")[0])
        self._params: Any = build(self._class.Params, self._values)
        self._inputs, self._outputs = self._class.ports(self._params)
        self.default_experiment = DefaultExperiment(start_time=0.0, step_size=self._what["parameters"]["period"])
        self._start = 0.0
        self._extra: dict[str, dict[str, str]] = {}
        self._numbers = {p.name: list(p.safe) for p in (*self._inputs, *self._outputs)}
        for name, row in self._what["start"].items():
            self._numbers[name][:] = row
        # An optional input that no node of the scenario publishes has no value until the tool sets it.
        self._silent = {p.name for p in self._inputs if p.held} - self._what["start"].keys()
        for port in self._inputs:
            self._register(port, Fmi2Causality.input)
        for port in self._outputs:
            self._register(port, Fmi2Causality.output)
        self._declare()
        self._begin()

    def _register(self, port: Port, causality: Any) -> None:
        from pythonfmu import Fmi2Causality, Real

        row = self._numbers[port.name]
        topic = self._what["topics"].get(port.topic, port.topic)
        for k, (label, unit) in enumerate(zip(port.labels, port.units, strict=True)):
            name = variable(topic, label)
            self._extra[name] = {"unit": unit} if unit not in ("", "1") else {}
            if causality is Fmi2Causality.input:
                limit = repr(port.limits[k])
                self._extra[name] |= {"min": f"-{limit}", "max": limit}
            self.register_variable(
                Real(
                    name,
                    causality=causality,
                    description=f"{topic}/{label}",
                    getter=lambda k=k: row[k],
                    setter=lambda x, k=k: self._put(port.name, k, x),
                ),
                nested=False,
            )

    def _put(self, name: str, k: int, x: float) -> None:
        self._numbers[name][k] = x
        self._silent.discard(name)

    def _declare(self) -> None:
        """Parameters that are single numbers or texts; lists stay as they were exported."""
        from pythonfmu import Boolean, Fmi2Causality, Fmi2Variability, Integer, Real, String

        types = {float: Real, int: Integer, bool: Boolean, str: String}
        for d in declarations(self._class.Params):
            if d.name == "period" or d.type not in types or isinstance(self._values.get(d.name), list | None):
                continue
            bounds = {"min": d.lower, "max": d.upper} if d.type in (float, int) else {}
            largest = LARGEST if d.type is int else math.inf
            self._extra[d.name] = {k: repr(d.type(v)) for k, v in bounds.items() if v is not None and abs(v) <= largest}
            if d.type is float and d.unit:
                self._extra[d.name]["unit"] = d.unit
            self.register_variable(
                types[d.type](
                    d.name,
                    causality=Fmi2Causality.parameter,
                    variability=Fmi2Variability.fixed,
                    description=one_line(d.doc),
                    getter=lambda n=d.name: self._values[n],
                    setter=lambda x, n=d.name: self._values.__setitem__(n, x),
                ),
                nested=False,
            )

    def to_xml(self, model_options: Any = None) -> Element:
        """Return the model description, with the units and bounds that PythonFMU does not support."""
        root = super().to_xml(model_options or {})
        for result in unit_definitions({e["unit"] for e in self._extra.values() if "unit" in e}):
            root.insert(1, result)
        outputs = [v.attrib for v in root.iter("Unknown")]
        if outputs:
            initial = SubElement(root.find("ModelStructure"), "InitialUnknowns")
            for index in outputs:
                SubElement(initial, "Unknown", index)
        for scalar in root.iter("ScalarVariable"):
            scalar[0].attrib.update(self._extra[scalar.attrib["name"]])
        return root

    def _begin(self) -> None:
        self._params = build(self._class.Params, self._values)
        block = self._class(self._params, self._what["node"])
        block.reset(self._what["seed"])
        self._schedule = Schedule(self._params.period)
        self._step = Step(self._what["node"], block, self._schedule, self._inputs, self._outputs)
        _Shown(self._step, self._numbers)
        period = float(self._schedule.period)
        self._k = round(self._start / period)
        if self._k < 0 or abs(self._k * period - self._start) > 1e-6 * period:
            raise ValueError(f"a start at {self._start!r} s, expected a whole number of periods of {period!r} s")
        if isinstance(block, Plant):
            self._step.answer(self._schedule.time(self._k))

    def _get_fmu_state(self) -> dict[str, Any]:
        """Return the complete state, in the form that PythonFMU stores and writes."""
        state = self._step.save(), self._k, self._numbers
        return {"kept": base64.b64encode(pickle.dumps(state)).decode()}

    def _set_fmu_state(self, state: dict[str, Any]) -> None:
        """Continue from a stored state; the bytes come from the tool in whose process this runs."""
        block_state, self._k, numbers = pickle.loads(base64.b64decode(state["kept"]))
        self._step.load(block_state)
        for name, row in numbers.items():
            self._numbers[name][:] = row

    def setup_experiment(
        self, start_time: float, stop_time: float | None = None, tolerance: float | None = None
    ) -> None:
        """Keep the start time: profiles and steps of the node are at times of the tool's clock."""
        self._start = start_time

    def exit_initialization_mode(self) -> None:
        """Set the block up with the tool's parameters and start time.

        Raises
        ------
        ValueError
            They do not fit; the tool receives fmi2Fatal and the text by its logger.
        """
        if self._values != self._what["parameters"] or self._start:
            self._begin()
        step = self._step
        # A tool reads the outputs before the first step, and a source has a value then. Its state is loaded back
        # because the first step answers the same tick again.
        if not self._inputs and not isinstance(step.block, Plant):
            saved = step.save()
            step.answer(self._schedule.time(self._k))
            step.load(saved)

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Move on by whole periods.

        Raises
        ------
        ValueError
            The step or an input is refused, or the block raises an error. PythonFMU turns it into fmi2Fatal, which
            tools report. It would turn a step that returns False into fmi2Discard, after which some tools continue with
            rows of zeros.
        """
        try:
            self._do(current_time, step_size)
        except Exception as error:
            raise ValueError(f"{self._what['node']}: {error}") from error
        return True

    def _do(self, current_time: float, step_size: float) -> None:
        period = float(self._schedule.period)
        count = round(step_size / period)
        if count < 1 or abs(count * period - step_size) > 1e-6 * period:
            raise ValueError(f"a step of {step_size!r} s, expected a whole number of periods of {period!r} s")
        if abs(self._k * period - current_time) > 0.5 * period:
            raise ValueError(f"a step from {current_time!r} s, expected one from {self._k * period!r} s")
        for port in self._inputs:
            if port.name in self._silent:
                continue
            row = tuple(self._numbers[port.name])
            if reason := port.beyond(row):
                raise ValueError(f"{port.topic}: {reason}")
            self._step.values[port.name] = row
        time: Callable[[int], int] = self._schedule.time
        for _ in range(count):
            if isinstance(self._step.block, Plant):
                self._step.advance(time(self._k))
                self._step.answer(time(self._k + 1))
            else:
                self._step.answer(time(self._k))
            self._k += 1


def content(member: Any, seed: int, start: dict[str, list[float]]) -> dict[str, Any]:
    """Return the contents of ``node.json`` for a node of a rig, with the initial values of its inputs."""
    return {
        "node": member.name,
        "package": member.package,
        "executable": member.executable,
        "seed": seed,
        "parameters": flatten(member.params),
        "topics": dict(member.remap),
        "start": start,
    }
