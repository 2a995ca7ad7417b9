"""Node: both ends' samples or a whole record to the place of the fault."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from pydantic import model_validator
from softrig_core import Block, BlockParams, Level, Port, array, button, executable, param

from .confidence import ErrorBudget, confidence
from .equations import TAPS, model, objectives
from .location import Location, Locator
from .objective import LocatorParams, check_travel
from .ports import LOCATION, OBJECTIVE, VERDICT, location_port, record_port, streams
from .record import COLUMNS, GROUPS, Record, RecordError, Status

Answer = Mapping[str, "tuple[float, ...] | None"]
NO_BUDGET = ErrorBudget(sync_us=0.0, ratio=0.0, reactance=0.0, resistance=0.0)


class FaultLocatorParams(LocatorParams, BlockParams):
    """How a record comes and how it is located."""

    period: float = param(5e-5, "sampling period", "s", gt=0.0, le=1.0)
    form: Literal["streams", "record"] = param("streams", "sample by sample from four topics, or one whole record")
    samples: int = param(1200, "samples of a record; of streams the newest so many are kept", ge=2, le=10_000_000)
    truth_km: float | None = param(None, "true distance, for the error in the diagnostics", "km", ge=0.0, le=3000.0)

    @model_validator(mode="after")
    def _fast_enough(self) -> Self:
        try:
            check_travel(self.line.aerial.tau / self.period, 1.0 / self.period, self)
        except RecordError as error:
            raise ValueError(str(error)) from None
        return self


class FaultLocator(Block[FaultLocatorParams]):
    """Two-terminal fault locator in the time domain; see `equations`, `location.Locator` and `search`.

    Answers once, at the end of the run, and whenever `locate` is pressed: ``verdict`` always, ``location`` and
    ``objective`` only when there is a position. A tick that the node has refused (NaN) is silent and a gap of the
    record, which is told and not located. Computation times go to the diagnostics; no number of a topic depends on
    them.
    """

    @classmethod
    def agreed(cls, params: FaultLocatorParams) -> Mapping[str, Any]:
        """The true place, where it is told it; its idea of the line is its own."""
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
        """Compile and import what an answer needs, before the first tick."""
        import scipy.optimize  # noqa: F401

        line, rate = model(self.p.line.aerial, self.p.equations), 1.0 / self.p.period
        reach = int(self.p.line.aerial.tau * rate) + TAPS
        objectives(line, np.zeros((4, 2 * reach + 1)), rate, reach, 1, np.zeros(1), np.empty(1))

    def start(self) -> None:
        """No samples yet."""
        self._rows: deque[tuple[float, ...]] = deque(maxlen=self.p.samples)
        self._record: tuple[float, ...] = ()
        self._pressed = False
        self.result: Location | None = None

    def update(self, t: int, locate: tuple[float, ...] | None, **inputs: tuple[float, ...]) -> Answer:
        """Take a sample or a record in; answer when the button goes down."""
        self._take(t, inputs)
        pressed = locate is not None and locate[0] != 0.0
        down, self._pressed = pressed and not self._pressed, pressed
        return self._answer() if down else {}

    def finish(self, t: int, locate: tuple[float, ...] | None, **inputs: tuple[float, ...]) -> Answer:
        """Take the last sample in and answer."""
        self._take(t, inputs)
        return self._answer()

    def _take(self, t: int, inputs: Mapping[str, tuple[float, ...]]) -> None:
        if self.p.form == "record":
            if self.age("record") == 0:
                self._record = inputs["record"]
        else:
            self._rows.append((t / 1e9, *(x for name in GROUPS for x in inputs[name])))

    def read(self) -> Record:
        """Give the record so far.

        Raises
        ------
        RecordError
            It is unfit.
        """
        if self.p.form == "record":
            return Record.from_table(np.array(self._record).reshape(-1, len(COLUMNS)))
        table = np.array(self._rows).reshape(-1, len(COLUMNS))
        return Record.from_table(table)

    def _answer(self) -> Answer:
        begin = time.process_time()
        work = None
        try:
            drawn = np.random.default_rng([self.p.seed, int(self.rng.integers(2**32))])
            work = Locator(self.read(), self.p, drawn)
            found = work.locate()
        except RecordError as error:
            found = Location(error.status, text=str(error))
        spent = time.process_time() - begin
        self.result = found
        self._tell(found, work, spent)
        verdict = (float(found.status), float(found.mode), 0.0 if work is None else found.f_max)
        if work is None or found.x_km is None:
            return {"verdict": verdict}
        scatter = confidence(work.record, self.p, found, NO_BUDGET).scatter_km
        values = {"x_km": found.x_km, "f_min": found.f_min, "f_max": found.f_max, "mode": float(found.mode),
                  "n_eval": float(found.evaluations), "scatter_km": scatter}  # fmt: skip
        objective = (*work.grid.tolist(), *work.curves.ravel().tolist())
        return {"verdict": verdict, "location": tuple(values[name] for name in LOCATION), "objective": objective}

    def _tell(self, found: Location, work: Locator | None, spent: float) -> None:
        good = found.status in (Status.OK, Status.NO_FAULT)
        text = f"{found.text}; {spent:.4f} s of CPU time"
        if found.x_km is not None and self.p.truth_km is not None:
            error = found.x_km - self.p.truth_km
            text += f"; error {100.0 * error / self.p.line.length:.4f} % of the line ({1e3 * error:.1f} m)"
        self.report(Level.OK if good else Level.WARN, found.status.name.lower(), text)
        if work is not None and work.warning:
            self.report(Level.WARN, "rate", work.warning)


main = executable(FaultLocator)
