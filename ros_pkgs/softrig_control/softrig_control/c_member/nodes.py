"""The nodes: a law and a plant in C, by the contract of `softrig export c`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from softrig_core import Block, BlockParams, Level, ParameterError, Plant, Port, RunError, param, resource, state_type
from softrig_core.kit.confined import STRANGE
from softrig_core.run.purity import HIDDEN

from ..channels import frames_of
from .build import PLANT, STEP, Built, built, compiled
from .history import Call, History, Row
from .law import Apart, Called, Here, wrong
from .layout import Struct
from .ports import Described, Side, described, fitted, table, values_of
from .trial import tried

_NONE = Struct((), ())


class CParams(BlockParams):
    """Parameters of a node in C: library or sources, the channel of each struct member, values of its parameters."""

    library: str = param("", "shared library, or package://PACKAGE/path; or name its sources instead")
    sources: tuple[str, ...] = param((), "C, C++ or Fortran files that softrig compiles itself, -O2 -ffp-contract=off")
    header: str = param("", "header with the structs NODE, NODE_in, NODE_out, NODE_params and the functions")
    prefix: str = param(
        "", "NODE: what the names in the header begin with; by default the header's name", pattern=r"\w*"
    )
    flags: tuple[str, ...] = param((), "further flags of the compiler, such as -DREAL=float or -Iinclude")
    description: str = param("", "NODE.json of `softrig export c`, which lists ports and parameters")
    inputs: tuple[str, ...] = param(
        (), "without a description: what it reads, each TOPIC/CHANNEL/FIELD [UNIT] = MEMBER of NODE_in"
    )
    outputs: tuple[str, ...] = param((), "without a description: what it publishes, likewise of NODE_out")
    values: tuple[str, ...] = param((), "parameters, each MEMBER [UNIT] (LOW..HIGH) = VALUE of NODE_params", live=True)
    trajectories: tuple[str, ...] = param((), "topics above that carry JointTrajectory messages (references)")
    vectors: tuple[str, ...] = param((), "topics above that carry Vector3Stamped messages, each TOPIC = FRAME")
    held: tuple[str, ...] = param(
        (),
        "topics of inputs that may not have a value yet; NODE_in's member has_TOPIC is true once it has one",
    )
    isolated: bool = param(
        False, "run it in a process of its own in any case: one that hides state runs there by itself"
    )
    timeout: float = param(
        10.0, "wall-clock time after which a call of an isolated library is aborted", "s", gt=0.0, le=1e6
    )

    @property
    def named(self) -> bool:
        """Return whether anything is named: without, a node has no ports."""
        return bool(self.library or self.sources or self.header)

    def _check(self) -> None:
        if not self.named:
            return
        if bool(self.library) == bool(self.sources):
            raise ValueError("expected either library, which is built, or sources, which softrig compiles")
        if not self.header:
            raise ValueError("header = '': expected the header of the library")
        if self.described is not None and (self.inputs or self.outputs):
            raise ValueError("description already lists inputs and outputs; remove them, or description")
        if self.described is not None and abs(self.described.period - self.period) > 1e-9 * self.period:
            raise ValueError(
                f"period = {self.period:g} s, but {Path(self.description).name} is of a node with "
                f"{self.described.period:g} s; its constants follow from it"
            )
        self.constants  # noqa: B018 - checks them
        if shared := {p.topic for p in self.reads.ports} & {p.topic for p in self.publishes.ports}:
            raise ValueError(f"{min(shared)} is both read and published")

    @property
    def plant(self) -> bool:
        """Return whether it is a plant."""
        return False

    @property
    def methods(self) -> tuple[str, ...]:
        """Return the functions besides NODE_init."""
        return PLANT if self.plant else STEP

    @cached_property
    def node(self) -> str:
        """Return the prefix of the names in the header."""
        return self.prefix or (self.described.node if self.described else Path(self.header).stem)

    @cached_property
    def described(self) -> Described | None:
        """Return the contents of its NODE.json."""
        return described(resource(self.description, "description")) if self.description else None

    @cached_property
    def built(self) -> Built:
        """Return the library and the object that calls it."""
        flags, header = tuple(_full_include(flag) for flag in self.flags), resource(self.header, "header").resolve()
        library = (
            compiled([resource(s, "source").resolve() for s in self.sources], (*flags, f"-I{header.parent}"))
            if self.sources
            else resource(self.library, "library").resolve()
        )
        return built(library, header, self.node, self.plant, flags)

    def struct(self, role: str) -> Struct:
        """Return a struct of the header: state, in, out or params."""
        return self.built.structs.get(role, _NONE)

    @cached_property
    def constants(self) -> dict[str, float]:
        """The parameters, in the order of NODE_params."""
        defaults = {} if self.described is None else self.described.parameters
        return values_of(self.values, self.struct("params").leaves, f"{self.node}_params", defaults)

    @cached_property
    def reads(self) -> Side:
        """Ports of the inputs, and the place of each member of NODE_in."""
        return self._side("in", self.inputs)

    @cached_property
    def publishes(self) -> Side:
        """Ports of the outputs, and the place of each member of NODE_out."""
        return self._side("out", self.outputs)

    def _side(self, role: str, entries: tuple[str, ...]) -> Side:
        leaves, struct = self.struct(role).leaves, f"{self.node}_{role}"
        if self.described is not None:
            return fitted(self.described.outputs if role == "out" else self.described.inputs, leaves, struct)
        return table(entries, leaves, struct, role == "out", self.trajectories, frames_of(self.vectors), self.held)


class CPlantParams(CParams):
    """As of a law."""

    @property
    def plant(self) -> bool:
        """Return whether it is a plant."""
        return True


def _full_include(flag: str) -> str:
    """Create the folder of -I whole: the compiler runs elsewhere."""
    return f"-I{Path(flag[2:]).resolve()}" if flag.startswith("-I") else flag


class Secret(NamedTuple):
    """The state of a library that hides its own state: all its calls."""

    calls: History


class Process:
    """The process of a library that hides state, and the calls that it has received."""

    def __init__(self) -> None:
        self.apart: Apart | None = None
        self.calls: History | None = None


class _C(Block[CParams]):
    """Base of plant and controller in C: the library, and the mapping from ports to struct members."""

    SCRATCH = frozenset({"_process", "_here"})  # a process follows from x; the memory holds constants, by address

    @classmethod
    def ports(cls, params: CParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return the ports that the parameters name."""
        return (params.reads.ports, params.publishes.ports) if params.named else ((), ())

    @classmethod
    def contents(cls, params: CParams) -> Mapping[str, str]:
        """The library, by the hash of its file."""
        if not params.named:
            return {}
        return {Path(params.library or params.sources[0]).name: f"sha256:{params.built.digest}"}

    def setup(self) -> None:
        """Load the library, and have NODE_init make its constants."""
        p = self.p
        if not p.named:
            raise ParameterError("parameter library = '': expected a shared library, or sources, and their header")
        if "_built" not in self.__dict__:
            self._load(p)
        self._rebuilt = p.built.digest != self._built.digest
        if self._rebuilt and p.struct("params") != self._built.structs.get("params", _NONE):
            raise ParameterError(f"{self._file} was built again with other parameters; begin a new run")
        self._params = tuple(p.constants.values())
        self._process = Process()
        if self._apart:
            self._begin: Row = self._begun().first
        else:
            self._here = Here(self._built, self._params)
            self._begin, self._place = self._here.first, self._here.place

    def _load(self, p: CParams) -> None:
        """Read everything that stays constant for the whole run, even if the library is built again."""
        self._built, self._node, self._file = p.built, p.node, Path(p.library or p.sources[0]).name
        leaves = p.struct("state").leaves
        self._state = state_type(("", [leaf.name for leaf in leaves]))
        self._wholes = tuple(leaf.whole for leaf in leaves)
        self._names = [leaf.access for leaf in leaves]
        self._reads = tuple((p.reads.ports[k].name, i) for k, i in p.reads.places)
        self._publishes, self._width = _rows(p.publishes), 1 + len(leaves)
        trial = tried(self._built, p.methods, tuple(p.constants.values()), p.timeout)
        if trial.wrong:
            raise ParameterError(f"{self._file}: {trial.wrong}")
        self._hidden = trial.hidden
        self._calls = self._built.intrusive
        self._apart = bool(self._hidden or self._calls) or p.isolated or bool(os.environ.get(STRANGE))
        called = {} if self._apart else {m: Called(self._built, m) for m in p.methods}
        self._step: Any = called.get("step")
        self._outputs: Any = called.get("outputs")
        self._advance: Any = called.get("advance")

    def first(self) -> Any:
        """Return the state that NODE_init makes; report hidden state."""
        if self._hidden:
            self.report(Level.WARN, HIDDEN, self._hint())
            return Secret(History())
        if self._calls and not self.p.isolated:
            self.report(
                Level.WARN,
                "apart",
                f"{self._file} calls {', '.join(self._calls)}, which would affect all of softrig, so it runs in a "
                "process of its own, tick by tick; return a status instead, or set `isolated`",
            )
        return self._made(self._begin)

    def go_on(self, x: Any, before: CParams) -> Any:
        """Continue with the same state and other constants; a library with hidden state gets all inputs again."""
        if self._rebuilt:
            self.report(
                Level.WARN, "rebuilt", f"{self._file} was built again; this run continues with the build of its start"
            )
        return x

    def _hint(self) -> str:
        return (
            f"{self._file} keeps state outside of {self._node}: {self._hidden}; it runs in a process of its own, "
            f"tick by tick, and a rewind replays all its inputs; make it members of the struct {self._node}"
        )

    def _made(self, numbers: Sequence[float]) -> Any:
        return self._state(*(int(v) if w else v for v, w in zip(numbers, self._wholes, strict=True)))

    # a tick in this process ---------------------------------------------------------------------------------------

    def _next(self, values: Row) -> Any:
        """Return the state in the result of a call."""
        return self._state(*(int(values[1 + k]) if w else values[1 + k] for k, w in enumerate(self._wholes)))

    def _values(self, inputs: Mapping[str, Any]) -> Row:
        """Return the members of NODE_in, in their order."""
        return tuple(_value(inputs[name], i) for name, i in self._reads)

    def _answer(self, values: Row, first: int) -> dict[str, Row]:
        """Return the outputs in the result of a call; `first` is the start of NODE_out."""
        return {name: tuple(values[first + k] for k in indices) for name, indices in self._publishes}

    # a tick in another process ------------------------------------------------------------------------------------

    def _begun(self) -> Apart:
        return Apart(self._built, self.p.methods, self._params, self.p.timeout)

    def _call(self, x: Any, method: str, t: int, values: Row) -> tuple[Any, Row]:
        """Call the library in its process; if it hides state, its calls are first repeated until its state is x."""
        process = self._process
        if process.apart is None or (self._hidden and not x.calls.is_same(process.calls)):
            process.apart, process.calls = self._begun(), None
            if self._hidden:
                for call in x.calls.rows():
                    process.apart.call(call.method, call.values)
        try:
            state = (x.calls.rows()[-1].state if x.calls.length else self._begin) if self._hidden else tuple(x)
            row = (float(t), *state, *values)
            result = process.apart.call(method, row)
        except RunError as error:
            process.apart = None
            raise self._failure(t, str(error)) from None
        self._check(t, method, result)
        if not self._hidden:
            return (x if method == "outputs" else self._next(result)), result
        after = state if method == "outputs" or result[0] else result[1 : self._width]
        process.calls = x.calls.after(Call(method, row, after))
        return Secret(process.calls), result

    # what goes wrong ----------------------------------------------------------------------------------------------

    def _check(self, t: int, method: str, values: Row) -> None:
        if values[0] != 0.0 and (reason := wrong(values[0], f"{self._node}_{method}", self._names)):
            raise self._failure(t, reason)

    def _failure(self, t: int, reason: str) -> RunError:
        return RunError(f"{self.name or self._node}: {self._file} at t = {t / 1e9:.9g} s: {reason}")

    def _report_status(self, t: int, method: str, values: Row) -> None:
        """Report that the library has answered by a status of its own, or end the run."""
        self._check(t, method, values)
        self.report(
            Level.WARN,
            "gave_up",
            f"{self._node}_{method} answers {values[0]:.0f} (gave up): its outputs are published, its state stays",
        )


def _rows(side: Side) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Return of each port the members of its values, in their order."""
    results = []
    for k, port in enumerate(side.ports):
        index_of = {i: index for index, (port_number, i) in enumerate(side.places) if port_number == k}
        results.append((port.name, tuple(index_of[i] for i in range(port.size))))
    return tuple(results)


def _value(value: Any, i: int) -> float:
    """Return a member of NODE_in: a value of a port, or whether it has one."""
    if i < 0:
        return 0.0 if value is None else 1.0
    return 0.0 if value is None else value[i]


class CController(_C, Block[CParams]):
    """A control law in C: `NODE_step` answers each tick, and the struct NODE is its state.

    After a status other than 0 the state is unchanged, and the values that the function has written into NODE_out are
    published.
    """

    def update(self, x: Any, t: int, **inputs: Any) -> tuple[Any, Mapping[str, Row]]:
        """Answer one tick by the C function."""
        values = self._values(inputs)
        if self._apart:
            x, result = self._call(x, "step", t, values)
            if result[0] != 0.0:
                self._report_status(t, "step", result)
            return x, self._answer(result, self._width)
        result = self._step((self._place, t, *x, *values))
        if result[0] != 0.0:
            self._report_status(t, "step", result)
            return x, self._answer(result, self._width)
        return self._next(result), self._answer(result, self._width)


class CPlant(_C, Plant[CPlantParams]):
    """A plant in C: `NODE_outputs` at t_k, then `NODE_advance` over one period with the inputs held."""

    def outputs(self, x: Any, t: int) -> Mapping[str, Row]:
        """Return the outputs."""
        if self._apart:
            result = self._call(x, "outputs", t, ())[1]
        else:
            result = self._outputs((self._place, t, *x))
        if result[0] != 0.0:
            raise self._failure(t, f"{self._node}_outputs answers {result[0]:.0f} (gave up)")
        return self._answer(result, 1)

    def advance(self, x: Any, t: int, **inputs: Any) -> Any:
        """Move over one period."""
        values = self._values(inputs)
        if self._apart:
            x, result = self._call(x, "advance", t, values)
        else:
            result = self._advance((self._place, t, *x, *values))
        if result[0] != 0.0:
            self._check(t, "advance", result)
            raise self._failure(t, f"{self._node}_advance answers {result[0]:.0f} (gave up)")
        return x if self._apart else self._next(result)
