"""Node: both ends' samples or a whole record to the place of the fault."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from softrig_core import Block, BlockParams, Level, Port, array, button, param

from .method.confidence import ErrorBudget, confidence
from .method.equations import TAPS, model, objectives
from .method.location import Location, Locator
from .method.objective import LocatorParams, check_travel
from .ports import LOCATION, OBJECTIVE, VERDICT, location_port, record_port, streams
from .records.record import COLUMNS, Record, RecordError, Status
from .records.rows import Rows

Answer = Mapping[str, "tuple[float, ...] | None"]
NO_BUDGET = ErrorBudget(sync_us=0.0, ratio=0.0, reactance=0.0, resistance=0.0)


class FaultLocatorParams(LocatorParams, BlockParams):
    """Parameters of the locator: the source of the record, and the method of location."""

    period: float = param(5e-5, "sampling period", "s", gt=0.0, le=1.0)
    form: Literal["streams", "record"] = param("streams", "sample by sample from four topics, or one whole record")
    samples: int = param(1200, "samples of a record; of streams the newest so many are kept", ge=2, le=10_000_000)
    truth_km: float | None = param(None, "true distance, for the error in the diagnostics", "km", ge=0.0, le=3000.0)

    def _check(self) -> None:
        try:
            check_travel(self.line.aerial.tau / self.period, 1.0 / self.period, self)
        except RecordError as error:
            raise ValueError(str(error)) from None


class State(NamedTuple):
    """Received parts of the record, and the results computed from them."""

    rows: Rows  # streams: t (s) and the twelve channels (V, A) of the newest samples
    record: tuple[float, ...]  # or the whole record that has come last
    pressed: bool = False  # whether `locate` was pressed
    answers: int = 0  # number of answers so far, each with random numbers of its own
    result: Location | None = None  # the newest result


class FaultLocator(Block[FaultLocatorParams]):
    """Two-terminal fault locator in the time domain; see `equations`, `location.Locator` and `search`.

    Publishes at the end of the run and whenever `locate` is pressed: ``verdict`` always, ``location`` and ``objective``
    only if there is a position. At a tick with a rejected input (NaN) the node is silent. The record then has a gap;
    the node reports the gap and computes no location. Computation times are published in the diagnostics; no number on
    a topic depends on them.
    """

    @classmethod
    def agreed(cls, params: FaultLocatorParams) -> Mapping[str, Any]:
        """The true place, if it receives it; its model of the line is its own."""
        return {} if params.truth_km is None else {"fault_location/x_km": params.truth_km}

    @classmethod
    def ports(cls, params: FaultLocatorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Either form, and the button; the answers are sent only when there is one."""
        inputs = streams() if params.form == "streams" else (record_port(params.samples),)
        dims = {", ".join(OBJECTIVE): len(OBJECTIVE), "point": params.n_grid}
        units = ("km",) * params.n_grid + ("V",) * (3 * params.n_grid)
        verdict = array("verdict", "verdict", {", ".join(VERDICT): len(VERDICT)}, ("", "", "V"), sporadic=True)
        objective = array("objective", "objective", dims, units, sporadic=True)
        return (*inputs, button("locate", "locate", held=True)), (verdict, location_port(), objective)

    def setup(self) -> None:
        """Compile and import everything that an answer needs, before the first tick."""
        import scipy.optimize  # noqa: F401

        line, rate = model(self.p.line.aerial, self.p.equations), 1.0 / self.p.period
        reach = int(self.p.line.aerial.tau * rate) + TAPS
        objectives(line, np.zeros((4, 2 * reach + 1)), rate, reach, 1, np.zeros(1), np.empty(1))

    def first(self) -> State:
        """No samples yet."""
        return State(Rows(self.p.samples, len(COLUMNS)), ())

    def update(
        self, x: State, t: int, *, locate: tuple[float, ...] | None, **inputs: tuple[float, ...]
    ) -> tuple[State, Answer]:
        """Process a sample or a record; publish a result when the button is pressed."""
        pressed = locate is not None and locate[0] != 0.0
        down = pressed and not x.pressed
        x = self._with_sample(x, t, inputs, pressed)
        return self._answer(x) if down else (x, {})

    def finish(
        self, x: State, t: int, *, locate: tuple[float, ...] | None, **inputs: tuple[float, ...]
    ) -> tuple[State, Answer]:
        """Process the last sample and answer."""
        return self._answer(self._with_sample(x, t, inputs, x.pressed))

    def _with_sample(self, x: State, t: int, inputs: Mapping[str, tuple[float, ...]], pressed: bool) -> State:
        rows, record = x.rows, x.record
        if self.p.form == "record":
            if self.age("record") == 0:
                record = inputs["record"]
        else:
            rows = rows.put((t / 1e9, *inputs["u_s"], *inputs["i_s"], *inputs["u_r"], *inputs["i_r"]))
        return State(rows, record, pressed, x.answers, x.result)

    def read(self, x: State) -> Record:
        """Return the record so far.

        Raises
        ------
        RecordError
            The record has a defect, see `Record`.
        """
        table = x.record if self.p.form == "record" else x.rows.newest()
        return Record.from_table(np.array(table).reshape(-1, len(COLUMNS)))

    def _answer(self, x: State) -> tuple[State, Answer]:
        work = None
        try:
            drawn = int(self.generator().integers(2**32, size=x.answers + 1)[-1])
            work = Locator(self.read(x), self.p, np.random.default_rng([self.p.seed, drawn]))
            location = work.locate()
        except RecordError as error:
            location = Location(error.status, text=str(error))
        x = x._replace(answers=x.answers + 1, result=location)
        self._report_location(location, work)
        verdict = (float(location.status), float(location.mode), 0.0 if work is None else location.f_max)
        if work is None or location.x_km is None:
            return x, {"verdict": verdict}
        scatter = confidence(work.record, self.p, location, NO_BUDGET).scatter_km
        values = {
            "x_km": location.x_km,
            "f_min": location.f_min,
            "f_max": location.f_max,
            "mode": float(location.mode),
            "n_eval": float(location.evaluations),
            "scatter_km": scatter,
        }
        objective = (*work.grid.tolist(), *work.curves.ravel().tolist())
        position = tuple(values[name] for name in LOCATION)
        return x, {"verdict": verdict, "location": position, "objective": objective}

    def _report_location(self, location: Location, work: Locator | None) -> None:
        good = location.status in (Status.OK, Status.NO_FAULT)
        text = location.text
        if location.x_km is not None and self.p.truth_km is not None:
            error = location.x_km - self.p.truth_km
            text += f"; error {100.0 * error / self.p.line.length:.4f} % of the line ({1e3 * error:.1f} m)"
        self.report(Level.OK if good else Level.WARN, location.status.name.lower(), text)
        if work is not None and work.warning:
            self.report(Level.WARN, "rate", work.warning)
