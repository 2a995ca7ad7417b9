"""One FMU that runs in this process: co-simulation, or model exchange with a fixed-step integrator."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

Cell = tuple[str, int, int, int]  # type as FMPy calls it, value reference, which of how many values
Numbers = tuple[float, ...]
REAL = ("Real", "Float64", "Float32")
DISCARDED, LAST_TIME, TERMINATED = 2, 2, 3  # constants of FMI 2.0: a status, and kinds of fmi2StatusKind
EVENTS = 1000  # iterations of one event


class Plan(NamedTuple):
    """Instructions for the child process of an FMU: what to run, and how.

    Attributes
    ----------
    folder : str
        Where the FMU is unpacked.
    exchange : bool
        Model exchange in place of co-simulation.
    start : tuple of (type, value reference, values)
        Parameters and start values, set before the initialisation.
    steps : int
        Communication steps, or steps of the integrator, in one period.
    log : bool
        Whether the FMU is asked to log what it does.
    """

    folder: str
    exchange: bool
    inputs: tuple[Cell, ...]
    outputs: tuple[Cell, ...]
    start: tuple[tuple[str, int, tuple[Any, ...]], ...]
    steps: int
    log: bool


class Refusal(RuntimeError):
    """The FMU refused a call or requested to end; the text names the call and has the FMU's last log message."""


class Instance:
    """An FMU; see `Plan`.

    Raises
    ------
    Refusal
        By every method.
    """

    def __init__(self, plan: Plan) -> None:
        from fmpy import read_model_description

        self.plan = plan
        self._model: Any = read_model_description(plan.folder, validate=False)
        self._three = self._model.fmiVersion.startswith("3")
        self._fmu: Any = None
        self._log_lines: deque[str] = deque(maxlen=2)
        self._get = _grouped(plan.outputs)
        self._set = _grouped(plan.inputs)

    def _log(self, *arguments: Any) -> None:
        self._log_lines.append(arguments[-1].decode(errors="replace") if arguments[-1] else "")

    def begin(self) -> Numbers:
        """Instantiate again, set the start values, initialise at time 0, and return the outputs."""
        return self._checked_call(self._begin)

    def advance(self, start: float, end: float, values: Numbers) -> Numbers:
        """Set the inputs, simulate from `start` to `end` (s) with the inputs held, and return the outputs."""
        return self._checked_call(self._advance, start, end, values)

    def tune(self, values: Sequence[tuple[str, int, tuple[Any, ...]]]) -> None:
        """Set parameters that may change while it runs, each as in `Plan.start`."""
        self._checked_call(self._tune, values)

    def keep(self) -> bytes:
        """Return the whole state as bytes; of the same FMU in another process, too."""
        return self._checked_call(self._keep)

    def restore(self, state: bytes) -> Numbers:
        """Continue from a stored state, and return the outputs."""
        return self._checked_call(self._restore, state)

    def _checked_call(self, call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        # FMPy raises bare Exceptions, too.
        except Exception as error:
            # The state of the FMU is unknown, so that not even freeing it is safe.
            self._fmu = None
            message = "".join(f"; it says: {text}" for text in self._log_lines if text)
            if isinstance(error, Refusal):
                raise Refusal(f"{error}{message}") from None
            name, status = getattr(error, "function", ""), getattr(error, "status", 0)
            texts = {2: "discarded it", 3: "error", 4: "fatal error"}
            reason = f"{name}: {texts.get(status, f'status {status}')}" if name else f"{type(error).__name__}: {error}"
            raise Refusal(reason + message) from None

    def _begin(self) -> Numbers:
        from fmpy.simulation import instantiate_fmu

        if self._fmu is not None:
            self._fmu.terminate()
            self._fmu.freeInstance()
        kind = "ModelExchange" if self.plan.exchange else "CoSimulation"
        fmu: Any = instantiate_fmu(self.plan.folder, self._model, kind, debug_logging=self.plan.log, logger=self._log)
        self._fmu = fmu
        experiment = self._model.defaultExperiment
        stated = experiment.tolerance if experiment is not None else None
        # The FMU's own solver uses the tolerance with which its author checked it.
        tolerance = None if stated is None else float(stated)
        if not self._three:
            fmu.setupExperiment(tolerance=tolerance, startTime=0.0)
        self._tune(self.plan.start)
        if self._three:
            fmu.enterInitializationMode(tolerance=tolerance, startTime=0.0)
        else:
            fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        if self.plan.exchange:
            self._begin_exchange()
        return self._outputs()

    def _tune(self, values: Sequence[tuple[str, int, tuple[Any, ...]]]) -> None:
        for name, reference, new in values:
            getattr(self._fmu, f"set{name}")([reference], list(new))

    def _put(self, values: Sequence[float]) -> None:
        for name, cells in self._set.items():
            # An array is set as a whole, so its elements without a port keep the values that they have.
            array = self._read(name, cells) if cells.arrays else [0.0] * cells.total
            for k, index in cells.where:
                array[index] = _typed(name, values[k])
            getattr(self._fmu, f"set{name}")(cells.references, array)

    def _read(self, name: str, cells: Cells) -> list[Any]:
        get = getattr(self._fmu, f"get{name}")
        result: list[Any] = get(cells.references, cells.total) if cells.arrays else get(cells.references)
        return result

    def _outputs(self) -> Numbers:
        result = [0.0] * len(self.plan.outputs)
        for name, cells in self._get.items():
            values = self._read(name, cells)
            for k, index in cells.where:
                result[k] = float(values[index])
        return tuple(result)

    def _advance(self, start: float, end: float, values: Numbers) -> Numbers:
        n = self.plan.steps
        if self.plan.exchange:
            self._event(start, values)
        else:
            self._put(values)
        for k in range(n):
            a = start + (end - start) * k / n
            # The last step ends exactly at `end`, without the rounding of the division.
            b = end if k == n - 1 else start + (end - start) * (k + 1) / n
            if self.plan.exchange:
                self._integrate(a, b)
            else:
                self._do_step(a, b - a)
        return self._outputs()

    def _do_step(self, t: float, h: float) -> None:
        if not self._three:
            try:
                self._fmu.doStep(t, h)
            except Exception as error:
                if getattr(error, "status", None) == DISCARDED and (last := self._ended()) is not None:
                    raise Refusal(f"fmi2DoStep: asks to end the simulation at {last:.9g} s") from None
                raise
            return
        _, ends, early, last = self._fmu.doStep(t, h)
        if ends or early:
            raise Refusal(f"fmi3DoStep: {'asks to end the simulation' if ends else 'returned early'} at {last:.9g} s")

    def _ended(self) -> float | None:
        """Time at which an FMU of FMI 2.0 has ended its simulation, s; None if it has not or does not report it."""
        try:
            return float(self._fmu.getRealStatus(LAST_TIME)) if self._fmu.getBooleanStatus(TERMINATED) else None
        # Both calls are optional in FMI 2.0.
        except Exception:
            return None

    def _keep(self) -> bytes:
        state = self._fmu.getFMUState()
        try:
            result = self._fmu.serializeFMUState(state) if self._three else self._fmu.serializeFMUstate(state)
        finally:
            self._fmu.freeFMUState(state)
        return bytes(result)

    def _restore(self, data: bytes) -> Numbers:
        fmu = self._fmu
        state = fmu.deserializeFMUState(data) if self._three else fmu.deSerializeFMUstate(data)
        try:
            fmu.setFMUState(state)
        finally:
            fmu.freeFMUState(state)
        return self._outputs()

    # model exchange -----------------------------------------------------------------------------------------------

    def _begin_exchange(self) -> None:
        import ctypes

        if self._three:
            self._states = self._fmu.getNumberOfContinuousStates()
            self._count = self._fmu.getNumberOfEventIndicators()
        else:
            self._states = self._model.numberOfContinuousStates
            self._count = self._model.numberOfEventIndicators
        self._x = (ctypes.c_double * self._states)()
        self._dx = (ctypes.c_double * self._states)()
        self._z = (ctypes.c_double * self._count)()
        self._next = float("inf")
        self._discrete()

    def _event(self, t: float, values: Sequence[float] | None = None) -> None:
        """Process an event at `t`, or the jump of the inputs to `values`; discrete inputs jump only at events."""
        self._fmu.setTime(t)
        self._fmu.enterEventMode()
        if values is not None:
            self._put(values)
        self._discrete()

    def _discrete(self) -> None:
        """Settle the discrete states of an event, then return to continuous time."""
        update = self._fmu.updateDiscreteStates if self._three else self._fmu.newDiscreteStates
        for _ in range(EVENTS):
            more, ends, _, _, defined, next_event = update()
            if ends:
                raise Refusal("asks to end the simulation")
            if not more:
                break
        else:
            raise Refusal(f"an event does not settle in {EVENTS} iterations")
        self._next = next_event if defined else float("inf")
        self._fmu.enterContinuousTimeMode()
        if self._states:
            self._fmu.getContinuousStates(self._x, self._states)

    def _signs(self) -> list[bool]:
        if self._count:
            self._fmu.getEventIndicators(self._z, self._count)
        return [z > 0.0 for z in self._z]

    def _integrate(self, a: float, b: float) -> None:
        """Advance by one integrator step, split at time events; a state event takes effect at its end."""
        while a < b:
            end = self._next if a < self._next < b else b
            before = self._signs()
            self._rk4(a, end)
            wants, ends = self._fmu.completedIntegratorStep()
            if ends:
                raise Refusal("asks to end the simulation")
            if wants or end >= self._next or self._signs() != before:
                self._event(end)
            a = end

    def _rk4(self, a: float, b: float) -> None:
        h, n = b - a, self._states
        fmu = self._fmu
        if not n:
            fmu.setTime(b)
            return
        derivatives = fmu.getContinuousStateDerivatives if self._three else fmu.getDerivatives
        x0 = list(self._x)

        def slope(t: float, x: list[float]) -> list[float]:
            fmu.setTime(t)
            self._x[:] = x
            fmu.setContinuousStates(self._x, n)
            derivatives(self._dx, n)
            return list(self._dx)

        k1 = slope(a, x0)
        k2 = slope(a + h / 2, [x + h / 2 * k for x, k in zip(x0, k1, strict=True)])
        k3 = slope(a + h / 2, [x + h / 2 * k for x, k in zip(x0, k2, strict=True)])
        k4 = slope(b, [x + h * k for x, k in zip(x0, k3, strict=True)])
        self._x[:] = [x + h / 6 * (p + 2 * q + 2 * r + s) for x, p, q, r, s in zip(x0, k1, k2, k3, k4, strict=True)]
        fmu.setTime(b)
        fmu.setContinuousStates(self._x, n)


class Cells(NamedTuple):
    """Variables of one type that are read or set in one call.

    Attributes
    ----------
    total : int
        Number of their values, those of arrays one after the other.
    where : list of (int, int)
        Of each cell: its place among all, and that of its value.
    arrays : bool
        Whether one of them is an array.
    """

    references: list[int]
    total: int
    where: list[tuple[int, int]]
    arrays: bool


def _grouped(cells: Sequence[Cell]) -> dict[str, Cells]:
    """Sort by type."""
    result: dict[str, Cells] = {}
    for name in dict.fromkeys(cell[0] for cell in cells):
        counts: dict[int, int] = {}
        for kind, reference, _, count in cells:
            if kind == name:
                counts.setdefault(reference, count)
        begins = dict(zip(counts, accumulate(counts.values(), initial=0), strict=False))
        indices = [(k, begins[r] + element) for k, (kind, r, element, _) in enumerate(cells) if kind == name]
        result[name] = Cells(list(counts), sum(counts.values()), indices, any(n > 1 for n in counts.values()))
    return result


def _typed(name: str, x: float) -> Any:
    """Return a number as the type of a variable."""
    if name == "Boolean":
        return x != 0.0
    if name in REAL:
        return x
    if x != int(x):
        raise Refusal(f"an input is a whole number, got {x!r}")
    return int(x)
